"""Many substeps: what is kept on the way forward, what is computed again on the way back, and how failures are raised."""

from dataclasses import dataclass

import torch
from torch import Tensor

from softmpm.buffers import Motion, MotionAdj, Solid, SolidAdj, clear
from softmpm.kernels.types import Wanted
from softmpm.memory import plan
from softmpm.model import Model
from softmpm.state import State
from softmpm.step import Substep
from softmpm.watch import NEVER, Kind, UnstableError, decode


@dataclass(frozen=True)
class Horizon:
    """Control steps of equally many substeps."""

    control_steps: int
    substeps: int

    @property
    def total(self) -> int:
        return self.control_steps * self.substeps


def rollout(model: Model, horizon: Horizon, start: State, pull: Tensor | None, solid: Solid, keep: bool):
    """Run from ``start``.

    Args:
        pull: Activation times strength [Pa], shape (control_step, world, muscle), or None without muscles.
        keep: Whether a backward pass will follow.

    Returns:
        The end as a :class:`State`, and the kept states as a :class:`Motion` with a first axis, or None.

    Raises:
        UnstableError: A world failed.
    """
    schedule = plan(horizon.total, model.state_bytes(), model.memory_budget)
    keep_all = keep and schedule.recomputed == 0
    row = None if pull is None else torch.empty_like(pull[0])
    step = Substep(model, Solid(solid.mass, solid.mu, solid.lam, row).struct(model))
    buffers = Motion.empty(model, horizon.total + 1 if keep_all else 2)
    kept = buffers if keep_all else (Motion.empty(model, schedule.kept) if keep else None)
    slots = [buffers[i].struct(model) for i in range(len(buffers.base))]
    step.enter(start, slots[0])
    for s in range(horizon.total):
        now, then = (s, s + 1) if keep_all else (s % 2, (s + 1) % 2)
        if row is not None and pull is not None and s % horizon.substeps == 0:
            row.copy_(pull[s // horizon.substeps])
        if kept is not None and not keep_all and s % schedule.segment == 0:
            kept[s // schedule.segment].copy_(buffers[now])
        step.advance(slots[now], slots[then], s)
    end = step.leave(slots[horizon.total if keep_all else horizon.total % 2])
    raise_failure(model, step.watch_words, end)
    return end, kept


def rollout_adj(
    model: Model,
    horizon: Horizon,
    kept: Motion,
    pull: Tensor | None,
    solid: Solid,
    adj_end: State,
    wanted: Wanted,
):
    """Adjoint of :func:`rollout`.

    Returns:
        Adjoint of the start as a :class:`State`, of the material as :class:`SolidAdj`, of ``pull`` or None.

    Raises:
        UnstableError: An adjoint is not finite.
    """
    schedule = plan(horizon.total, model.state_bytes(), model.memory_budget)
    row = None if pull is None else torch.empty_like(pull[0])
    step = Substep(model, Solid(solid.mass, solid.mu, solid.lam, row).struct(model))
    adj_solid = SolidAdj.zeros(model, wanted)
    adj_pull = torch.zeros_like(pull) if wanted.activation and pull is not None else None
    adjoints = MotionAdj.zeros(model), MotionAdj.zeros(model)
    structs = [adj.struct(model) for adj in adjoints]
    adj_solid_struct = adj_solid.struct(model)
    then = adjoints[horizon.total % 2]
    then.fx.copy_(adj_end.x).mul_(model.scene.grid.spacing)
    for name in ("v", "C"):
        getattr(then, name).copy_(getattr(adj_end, name))
    then.H.copy_(adj_end.F)

    segments = _Segments(model, horizon, kept, step, pull, row, schedule)
    for s in reversed(range(horizon.total)):
        now_slot, then_slot = segments.states(s)
        if row is not None and pull is not None:
            row.copy_(pull[s // horizon.substeps])
        clear(adjoints[s % 2].flat)
        back = horizon.total - 1 - s  # the first failure on the way back has the smallest word
        step.adjoint(
            wanted, now_slot, then_slot, structs[(s + 1) % 2], structs[s % 2], adj_solid_struct, back
        )
        if adj_pull is not None and s % horizon.substeps == 0:
            step.collect_pull(adj_solid, adj_pull[s // horizon.substeps])
    raise_gradient_failure(model, horizon, step.watch_words, adj_end)
    start = adjoints[0]
    return State(start.fx / model.scene.grid.spacing, start.v, start.C, start.H), adj_solid, adj_pull


class _Segments:
    """Hands out the states around a substep, going backward; recomputes a segment when it is first asked for."""

    def __init__(self, model: Model, horizon: Horizon, kept: Motion, step: Substep, pull, row, schedule):
        self.horizon, self.plan = horizon, schedule
        self.kept, self.step = kept, step
        self.pull, self.row = pull, row
        count = schedule.recomputed or schedule.kept
        self.buffers = Motion.empty(model, count) if schedule.recomputed else kept
        self.slots = [self.buffers[i].struct(model) for i in range(count)]
        self.first = 0 if schedule.recomputed == 0 else horizon.total

    def states(self, s: int):
        if s < self.first:
            self._recompute(s // self.plan.segment)
        return self.slots[s - self.first], self.slots[s - self.first + 1]

    def _recompute(self, segment: int) -> None:
        self.first = segment * self.plan.segment
        self.buffers[0].copy_(self.kept[segment])
        last = min(self.first + self.plan.segment, self.horizon.total)
        for s in range(self.first, last):
            if self.row is not None:
                self.row.copy_(self.pull[s // self.horizon.substeps])
            self.step.advance(self.slots[s - self.first], self.slots[s - self.first + 1], s)


def raise_failure(model: Model, watch: Tensor, end: State) -> None:
    """Raise what the kernels reported, if anything; waits for the device."""
    words = watch.tolist()
    failed = [world for world, word in enumerate(words) if word != NEVER]
    if not failed:
        return
    world = min(failed, key=lambda w: words[w])
    substep, kind, particle = decode(words[world])
    value, limit, advice = _explain(model, kind, world, particle, end)
    where = f"particle {particle} (body {int(model.body[particle])}) of world {world}"
    time = f"substep {substep} (t = {(substep + 1) * model.scene.dt:.6g} s after the start of the call)"
    others = f" ({len(failed) - 1} more world(s) failed too.)" if len(failed) > 1 else ""
    when = "in the start state" if kind is Kind.START else f"at {time}"
    raise UnstableError(
        f"{where} {value} {when}; {limit}. {advice}{others}",
        kind=kind,
        world=world,
        particle=particle,
        substep=substep,
        value=value,
        limit=limit,
        state=end,
    )


def raise_gradient_failure(model: Model, horizon: Horizon, watch: Tensor, adj_end: State) -> None:
    """Raise what the adjoint kernels reported, if anything; they count substeps from the last one."""
    words = watch.tolist()
    world = min(range(len(words)), key=lambda w: words[w])
    if words[world] == NEVER:
        return
    back, kind, particle = decode(words[world])
    substep, limit = horizon.total - 1 - back, "gradients must be finite"
    given = all(bool(torch.isfinite(adj[world]).all()) for adj in adj_end)
    cause = (
        "It overflowed on the way back: shorten the horizon or scale the loss"
        if given
        else ("The gradient of the loss with respect to the end state came in like that: look at the loss")
    )
    raise UnstableError(
        f"particle {particle} (body {int(model.body[particle])}) of world {world} has an adjoint that is not finite at substep "
        f"{substep} of {horizon.total}, counted from the start of the call; {limit}. {cause}.",
        kind=kind,
        world=world,
        particle=particle,
        substep=substep,
        value="not finite",
        limit=limit,
    )


def _explain(model: Model, kind: Kind, world: int, particle: int, end: State) -> tuple[str, str, str]:
    """What came, what must hold, what to do."""
    dx = model.scene.grid.spacing
    low = 0.5 * dx
    high = tuple((n - 1.5) * dx for n in model.scene.grid.shape)
    box = "a particle must stay in " + " x ".join(f"[{low:.4g}, {h:.4g})" for h in high) + " m"
    smaller = (
        "Use a smaller dt (softmpm.stable_dt gives a safe one), a weaker activation, or a softer material."
    )
    x, F = end.x[world, particle].tolist(), end.F[world, particle]
    if kind is Kind.LEFT_GRID or (
        kind is Kind.START and not all(low <= c < h for c, h in zip(x, high, strict=True))
    ):
        return (
            f"is at {_numbers(x)} m, off the grid",
            box,
            "Make the grid larger, add walls, or start further inside.",
        )
    if kind is Kind.INVERTED:
        J = torch.linalg.det(F.double()).item()
        return f"is inverted, det F = {J:.4g}", "a neo-Hookean particle needs det F > 0", smaller
    bad = [name for name in "xvCF" if not bool(torch.isfinite(getattr(end, name)[world, particle]).all())]
    return (
        f"has a value in {', '.join(bad) or 'its norm'} that is not finite",
        "every value must be finite",
        smaller,
    )


def _numbers(values) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
