"""How a failure that the kernels reported reaches the user: read back, put into words, raised."""

import torch
from torch import Tensor

from softmpm.model import Model
from softmpm.scene import NeoHookean
from softmpm.state import State
from softmpm.watch import NEVER, Kind, UnstableError, decode

HOOKEAN = "a neo-Hookean particle needs det F > 0"


class Report:
    """Watch words on their way to the host, so that more work can be launched before they are read."""

    def __init__(self, words: Tensor):
        self._event = None
        if words.device.type == "cpu":
            self._words = words.clone()
        else:
            self._words = torch.empty(words.shape, dtype=words.dtype, device="cpu", pin_memory=True)
            self._words.copy_(words, non_blocking=True)
            self._event = torch.cuda.Event()
            # Unasked, PyTorch would take the stream of the current GPU:
            self._event.record(torch.cuda.current_stream(words.device))

    def read(self) -> list[int]:
        """Waits for the device to come to where the report was made."""
        if self._event is not None:
            self._event.synchronize()
        return self._words.tolist()


def outgrown(words: list[int]) -> bool:
    """Whether a particle left the part of the grid that is in memory."""
    return any(word != NEVER and decode(word)[1] is Kind.LEFT_WINDOW for word in words)


def raise_failure(
    model: Model, words: list[int], end: State, first: int = 0, start: State | None = None
) -> None:
    """Raise what the kernels reported, if anything.

    Args:
        words: One for each world.
        end: State in which the worlds stopped.
        first: Substep of the call that the kernels counted as 0.
        start: State of the call before it, if it is at hand: looked at for what was wrong from the beginning.
    """
    failed = [world for world, word in enumerate(words) if word != NEVER]
    if not failed:
        return
    world = min(failed, key=lambda w: words[w])
    substep, kind, particle = decode(words[world])
    substep += first
    if start is not None:
        end = _never_ran(end, start, [w for w in failed if decode(words[w])[1] is Kind.START])
    if substep == 0 and start is not None and (inverted := _inverted(model, start, world)) is not None:
        kind, particle = Kind.START, inverted
        advice = "Start from a deformation gradient F that is not inverted."
        value, limit = f"is inverted, det F = {_det(start, world, particle):.4g}", HOOKEAN
    else:
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


def raise_gradient_failure(model: Model, words: list[int], adj_end: State, last: int, total: int) -> None:
    """Raise what the adjoint kernels reported, if anything.

    Args:
        words: One for each world.
        adj_end: Adjoint of the end of the call.
        last: Substep of the call from which the kernels counted backward.
        total: Substeps of the call.
    """
    world = min(range(len(words)), key=lambda w: words[w])
    if words[world] == NEVER:
        return
    back, kind, particle = decode(words[world])
    substep, limit = last - back, "gradients must be finite"
    given = all(bool(torch.isfinite(adj[world]).all()) for adj in adj_end[:4])
    cause = (
        "It overflowed on the way back: shorten the horizon or scale the loss"
        if given
        else ("The gradient of the loss with respect to the end state came in like that: look at the loss")
    )
    raise UnstableError(
        f"particle {particle} (body {int(model.body[particle])}) of world {world} has an adjoint that is not finite at substep "
        f"{substep} of {total}, counted from the start of the call; {limit}. {cause}.",
        kind=kind,
        world=world,
        particle=particle,
        substep=substep,
        value="not finite",
        limit=limit,
    )


def _never_ran(end: State, start: State, worlds: list[int]) -> State:
    """These worlds as they were given: the fast scheme cannot hold what is off the grid."""
    if not worlds:
        return end
    given, start = end.clone(), start.detach()
    for tensor, from_start in zip(given[:4], start[:4], strict=True):
        tensor[worlds] = from_start[worlds]
    for name in () if given.low is None else ("x", "F"):
        getattr(given.low, name)[worlds] = 0.0 if start.low is None else getattr(start.low, name)[worlds]
    return given


def _explain(model: Model, kind: Kind, world: int, particle: int, end: State) -> tuple[str, str, str]:
    """What came, what must hold, what to do."""
    dx = model.scene.grid.spacing
    low = 0.5 * dx
    high = tuple((n - 1.5) * dx for n in model.scene.grid.shape)
    box = "a particle must stay in " + " x ".join(f"[{low:.4g}, {h:.4g})" for h in high) + " m"
    smaller = "Use a smaller dt (about half of softmpm.stable_dt), a weaker activation, or a softer material."
    x = end.x[world, particle].tolist()
    if kind is Kind.LEFT_GRID or (
        kind is Kind.START and not all(low <= c < h for c, h in zip(x, high, strict=True))
    ):
        away = max(max(low - c, c - h) for c, h in zip(x, high, strict=True))
        thrown = kind is Kind.LEFT_GRID and not away <= dx  # it was on the grid a substep before
        larger = "Make the grid larger, add walls, or start further inside."
        return (
            f"is at {_numbers(x)} m, off the grid",
            box,
            f"It was thrown out. {smaller}" if thrown else larger,
        )
    if kind is Kind.INVERTED:
        return f"is inverted, det F = {_det(end, world, particle):.4g}", HOOKEAN, smaller
    bad = [name for name in "xvCF" if not bool(torch.isfinite(getattr(end, name)[world, particle]).all())]
    what = f"has a value in {', '.join(bad)} that is not finite" if bad else "has values too large to square"
    advice = "Start from other values." if kind is Kind.START else smaller
    return what, "every value must be finite, and its square", advice


def _det(state: State, world: int, particle: int) -> float:
    return torch.linalg.det(state.F[world, particle].double()).item()


def _inverted(model: Model, start: State, world: int) -> int | None:
    """The first neo-Hookean particle of a start that is inverted."""
    laws = [isinstance(body.material, NeoHookean) for body in model.scene.bodies]
    hookean = torch.tensor(laws, device=model.device)[model.body]
    bad = ((torch.linalg.det(start.F[world].double()) <= 0) & hookean).nonzero()
    return int(bad[0]) if len(bad) else None


def _numbers(values) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
