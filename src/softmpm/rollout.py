"""Time integration over chunks of substeps: checkpointing in the forward pass, recomputation in the backward pass."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from softmpm.alarms import Failures
from softmpm.errors import NEVER
from softmpm.kernels.structs import RequestedGrads
from softmpm.model import Model
from softmpm.planning import checkpointing
from softmpm.planning.chunks import Chunk, Horizon
from softmpm.planning.memory import Plan, memory, plan
from softmpm.runner import Runner
from softmpm.schemes.buffers import Solid, SolidAdj
from softmpm.schemes.capture import defer_status_check, exclusive_capture, is_capturing, keep_alive
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.failure_report import Report, raise_gradient_failure
from softmpm.schemes.scheme import Run
from softmpm.state import State


@dataclass
class Trail:
    """Checkpoints of a call for its backward pass."""

    plan: Plan
    chunks: tuple[Chunk, ...]
    start: State
    """The user's initial state, which is never written to."""
    runs: list[Run] = field(default_factory=list)
    """All chunks, if every state is retained."""
    states: dict[int, Any] = field(default_factory=dict)
    """Otherwise the checkpointed states, by the chunk that they precede, until a backward pass takes them."""
    turn: threading.Lock = field(default_factory=threading.Lock)
    """Held by the backward pass that is running."""
    frozen: dict[int, int] = field(default_factory=dict)
    """Worlds that failed, and the substep from which they were inactive."""

    def keep(self, run: Run) -> None:
        """Retain a run without its final state: the last one is the result of the call, which refers to this trail."""
        del run.end
        self.runs.append(run)

    @property
    def stays(self) -> tuple[int, ...]:
        """Chunks whose initial state is checkpointed."""
        return checkpointing.initial_checkpoints(len(self.chunks), self.plan.slots) if self.plan.slots else ()


@on_its_gpu
def rollout(
    model: Model,
    horizon: Horizon,
    start: State,
    pull: Tensor | None,
    solid: Solid,
    keep: bool,
    failures: Failures | None = None,
) -> tuple[State, Trail | None]:
    """Integrate from ``start``. Each chunk is launched before the status of the previous one is read.

    Args:
        pull: Activation times strength [Pa], shape (control_step, world, muscle), or None without muscles.
        keep: Whether a backward pass will follow.
        failures: Takes the failures of single worlds; None raises them.

    Returns:
        The end as a :class:`State`, and a :class:`Trail`, or None.

    Raises:
        UnstableError: A world failed.
    """
    sizes = model.sizes()
    chosen = plan(horizon, sizes, model.budget) if keep else Plan(sizes.longest, 0, 0, 0)
    trail = Trail(chosen, horizon.chunks(chosen.longest), start)
    runner, inside = Runner(model, pull, solid, failures), keep and chosen.keep_all
    trail.frozen = runner.frozen
    check = runner.check(start)
    if is_capturing(model):
        return _captured(runner, trail, inside), trail if keep else None
    stays = trail.stays
    state: Any = start
    k, before = 0, None
    while k < len(trail.chunks) or before is not None:
        ahead = None
        if k < len(trail.chunks):
            run = runner.run(trail.chunks[k], state, inside)
            ahead = run, Report(run.words)
        if check is not None:
            started, check = runner.passed(start, check), None
            if not started:
                k = 0
                del run, ahead
                continue
        if before is not None and not runner.settled(*before):
            k, state, before = k - 1, before[0].start, None
            del run, ahead  # the chunk launched ahead is void
            continue
        if before is not None and inside:
            trail.keep(before[0])
        if k in stays:
            trail.states[k] = runner.scheme.checkpoint(state)
        if ahead is not None:
            state, k = ahead[0].end, k + 1
        before = ahead
    return _returned(model, runner.scheme.to_user(state), start, runner), trail if keep else None


def _returned(model: Model, end: State, start: State, runner: Runner) -> State:
    """The end, with the worlds that failed where the policy puts them."""
    if runner.failures is None or not runner.frozen:
        return end
    reset = runner.failures.policy == "reset"
    # Worlds that never ran return as they were given: the fast scheme cannot hold what is off the grid.
    worlds = sorted(world for world, substep in runner.frozen.items() if reset or substep == 0)
    there, end = model.rest() if reset else start.detach(), end.clone()
    for tensor, wanted in zip(end[:4], there[:4], strict=True):
        tensor[worlds] = wanted[worlds]
    for name in () if end.low is None else ("x", "F"):
        getattr(end.low, name)[worlds] = 0.0 if there.low is None else getattr(there.low, name)[worlds]
    return end


def _captured(runner: Runner, trail: Trail, inside: bool) -> State:
    """:func:`rollout` while PyTorch captures a graph: nothing is read back."""
    keep_alive(runner.model)
    state: Any = trail.start
    stays = trail.stays
    for k, chunk in enumerate(trail.chunks):
        if k in stays:
            trail.states[k] = runner.scheme.checkpoint(state)
        run = runner.settle(chunk, state, inside)
        state = run.end
        if inside:
            trail.keep(run)
    return runner.scheme.to_user(state)


@on_its_gpu
def rollout_adj(
    model: Model,
    horizon: Horizon,
    trail: Trail,
    pull: Tensor | None,
    solid: Solid,
    adj_end: State,
    wanted: RequestedGrads,
):
    """Adjoint of :func:`rollout`.

    Returns:
        Adjoint of the start as a :class:`State`, of the material as :class:`SolidAdj`, of ``pull`` or None.

    Raises:
        UnstableError: An adjoint is not finite.
    """
    adj_solid = SolidAdj.zeros(model, wanted)
    adj_pull = torch.zeros_like(pull) if wanted.activation and pull is not None else None
    adj: Any = _without(trail.frozen, adj_end)
    reports, runner = [], Runner(model, pull, solid)
    runner.frozen = trail.frozen
    with trail.turn:
        for run in _inside_out(trail, runner):
            adj, part = run.vjp(adj, adj_solid, wanted)
            if adj_pull is not None and part is not None:
                adj_pull[run.chunk.rows] += part
            if is_capturing(model):
                defer_status_check(run.words[: model.worlds].clone())  # a second backward pass uses them anew
            else:
                reports.append((Report(run.words), run.chunk.first + run.chunk.length - 1))
            del run  # release its buffers before the previous chunk is recomputed
    for report, last in reports:
        words = report.read()[: model.worlds]
        for world in trail.frozen:
            words[world] = NEVER
        raise_gradient_failure(model, words, adj_end, last, horizon.total)
    adj = runner.scheme.to_user(adj)
    found = (*adj[:4], adj_solid.mass, adj_solid.mu, adj_solid.lam)
    for world in trail.frozen:  # a state off the grid has no adjoint
        for tensor in found:
            if tensor is not None:
                tensor[world] = 0
        if adj_pull is not None:
            adj_pull[:, world] = 0
    return adj, adj_solid, adj_pull


def _without(frozen: dict[int, int], adj_end: State) -> State:
    """The adjoint of the end, contiguous, and zero for worlds that failed."""
    x, v, C, F = (a.clone() if frozen else a.contiguous() for a in adj_end[:4])
    for tensor in (x, v, C, F) if frozen else ():
        tensor[sorted(frozen)] = 0
    return State(x, v, C, F)


def _taken(trail: Trail, runner: Runner) -> dict[int, Any]:
    """Take the checkpoints out of the trail, so that each state is freed as soon as it is dropped.

    A second backward pass finds none and recomputes them first.
    """
    states = dict(trail.states)
    trail.states.clear()
    if states:
        return states
    state: Any = trail.start
    stays = trail.stays
    for k in range(stays[-1] + 1):
        if k > 0:
            state = runner.settle(trail.chunks[k - 1], state, keep=False).end
        if k in stays:
            states[k] = runner.scheme.checkpoint(state)
    return states


def _inside_out(trail: Trail, runner: Runner) -> Iterator[Run]:
    """All chunks as runs that store their states, from the last to the first."""
    if trail.plan.keep_all:
        yield from reversed(trail.runs)
        return
    states = _taken(trail, runner)
    nothing = torch.empty(0)
    hand: Any = State(nothing, nothing, nothing, nothing)
    for action, k in checkpointing.backward_schedule(len(trail.chunks), trail.plan.slots):
        if action == "restore":
            hand = states[k]
        elif action == "advance":
            hand = runner.settle(trail.chunks[k], hand, keep=False).end
        elif action == "keep":
            states[k] = runner.scheme.checkpoint(hand)
        elif action == "drop":
            del states[k]
        else:
            yield runner.settle(trail.chunks[k], hand, keep=True)


@contextmanager
def explain_out_of_memory(model: Model, horizon: Horizon, gradient: bool) -> Iterator[None]:
    """On ``OutOfMemoryError``, free the cached buffers and add a note with the estimated requirement."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        with exclusive_capture(
            wait=False
        ) as turn:  # else destroying a graph could invalidate another thread's capture
            if turn and not is_capturing(model):
                model.workspace.release()
        error.add_note(_needs(model, horizon, gradient))
        raise


def _needs(model: Model, horizon: Horizon, gradient: bool) -> str:
    calls = f"{model.calls} calls" if gradient and model.calls > 1 else "a call"
    call = f"{calls} of {horizon.total} substeps with {model.particle_count:,} particles in {model.worlds} world(s)"
    less = "Fewer particles or worlds take less"
    try:
        forward, kept, backward = (f"{size / 2**20:,.1f} MiB" for size in memory(model, horizon)[:3])
    except ValueError as error:  # the budget is too small for a gradient, which was not asked for
        return f"softmpm: {call} did not fit; {error} {less}."
    if not gradient:
        return f"softmpm: {call} takes {forward}, by the formula of docs/memory.md. {less}."
    untold = (
        ""
        if model.calls > 1
        else " Calls of one backward pass share it once build knows how many they are (calls)."
    )
    return (
        f"softmpm: {call} and the backward pass take {backward}, {kept} of it kept in between, by the formula of docs/memory.md. "
        f"{less}; a smaller memory_budget (softmpm.build) takes time instead.{untold}"
    )
