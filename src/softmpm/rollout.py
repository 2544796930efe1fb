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
from softmpm.schemes.capture import defer_status_check, exclusive_capture, is_capturing, keep_alive
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.failure_report import Report, raise_gradient_failure
from softmpm.schemes.inputs import InputsAdj, Values
from softmpm.schemes.scheme import Run
from softmpm.state import Nodal, State, chosen


@dataclass
class Trail:
    """Checkpoints of a call for its backward pass."""

    plan: Plan
    chunks: tuple[Chunk, ...]
    start: State | Nodal
    """The user's initial state, which is never written to."""
    runs: list[Run] = field(default_factory=list)
    """All chunks, if every state is retained."""
    states: dict[int, Any] = field(default_factory=dict)
    """Otherwise the checkpointed states, by the number of the chunk that starts from them, until a backward pass takes them."""
    lock: threading.Lock = field(default_factory=threading.Lock)
    """Acquired by the backward pass that is running."""
    frozen: dict[int, int] = field(default_factory=dict)
    """Worlds that failed, and the substep from which they were inactive."""
    failed: Tensor | None = None
    """Of a captured call that collects failures: worlds that failed, shape (world,)."""

    def without(self, model: Model) -> Tensor | None:
        """Worlds that contribute no gradient, shape (world,), None if all do."""
        if self.failed is not None or not self.frozen:
            return self.failed
        return torch.tensor([world in self.frozen for world in range(model.worlds)], device=model.device)

    def keep(self, run: Run) -> None:
        """Retain a run without its final state: the last one is the result of the call, which refers to this trail."""
        run.release()
        self.runs.append(run)

    @property
    def checkpointed(self) -> tuple[int, ...]:
        """Chunks whose initial state is checkpointed."""
        return (
            checkpointing.initial_checkpoints(len(self.chunks), self.plan.checkpoints)
            if self.plan.checkpoints
            else ()
        )


@on_its_gpu
def rollout(
    model: Model,
    horizon: Horizon,
    start: State | Nodal,
    values: Values,
    keep: bool,
    failures: Failures | None = None,
) -> tuple[Any, Trail | None]:
    """Integrate from ``start``. Each chunk is launched before the status of the previous one is read.

    Args:
        values: Inputs that the call sets; those with rows have one row for each control step.
        keep: Whether a backward pass will follow.
        failures: Collects the failures of single worlds; None raises the first one.

    Returns:
        The final state, of the type of the initial one, and the :class:`Trail` if ``keep``, else None.

    Raises:
        UnstableError: A world failed.
    """
    sizes = model.sizes()
    chosen = plan(horizon, sizes, model.budget) if keep else Plan(sizes.longest, 0, 0, 0)
    trail = Trail(chosen, horizon.chunks(chosen.longest), start)
    runner, inside = Runner(model, values, failures), keep and chosen.keep_all
    trail.frozen = runner.frozen
    check = runner.check(start)
    if is_capturing(model):
        return _captured(runner, trail, inside), trail if keep else None
    checkpointed = trail.checkpointed
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
        if k in checkpointed:
            trail.states[k] = runner.scheme.checkpoint(state)
        if ahead is not None:
            state, k = ahead[0].end, k + 1
        before = ahead
    return _returned(model, runner.scheme.to_user(state), start, runner), trail if keep else None


def _returned(model: Model, end: Any, start: Any, runner: Runner) -> Any:
    """The final state, in which the failure policy has frozen or reset the worlds that failed."""
    if runner.failures is None or not runner.frozen:
        return end
    reset = runner.failures.policy == "reset"
    # Worlds that never ran are returned as they were given: the fast scheme cannot represent particles off the grid.
    frozen = [runner.frozen.get(world) for world in range(model.worlds)]
    worlds = [first is not None and (reset or first == 0) for first in frozen]
    there = runner.scheme.rest() if reset else start.detach()
    return chosen(torch.tensor(worlds, device=model.device), there, end)


def _captured(runner: Runner, trail: Trail, inside: bool) -> Any:
    """:func:`rollout` while PyTorch captures a graph, without reading anything back."""
    keep_alive(runner.model)
    state: Any = trail.start
    checkpointed = trail.checkpointed
    for k, chunk in enumerate(trail.chunks):
        if k in checkpointed:
            trail.states[k] = runner.scheme.checkpoint(state)
        run = runner.settle(chunk, state, inside)
        state = run.end
        if inside:
            trail.keep(run)
    end = runner.captured(runner.scheme.to_user(state))
    trail.failed = runner.failed
    return end


@on_its_gpu
def rollout_adj(
    model: Model, horizon: Horizon, trail: Trail, values: Values, adj_end: Any, wanted: RequestedGrads
) -> tuple[Any, InputsAdj]:
    """Adjoint of :func:`rollout`.

    Returns:
        Adjoint of the initial state, and those of the inputs for which gradients are requested.

    Raises:
        UnstableError: An adjoint is not finite.
    """
    adj_inputs = InputsAdj(model, wanted, horizon.control_steps)
    failed = trail.without(model)
    adj: Any = _contiguous(adj_end, failed)
    reports, runner = [], Runner(model, values)
    runner.frozen, runner.failed = trail.frozen, trail.failed
    with trail.lock:
        for run in _inside_out(trail, runner):
            adj = run.vjp(adj, adj_inputs, wanted)
            words = run.words[: model.worlds]  # another backward pass overwrites them
            words = words.clone() if failed is None else words.masked_fill(failed, NEVER)
            if is_capturing(model):
                defer_status_check(words)
            else:
                reports.append((Report(words), run.chunk.first + run.chunk.length - 1))
            del run  # release its buffers before the previous chunk is recomputed
    for report, last in reports:
        raise_gradient_failure(model, report.read(), last, adj_end, horizon.total)
    adj = runner.scheme.to_user(adj)
    if failed is not None:  # a state off the grid has no adjoint
        adj = _contiguous(adj, failed)
        adj_inputs.clear(failed)
    return adj, adj_inputs


def _contiguous(adj: Any, failed: Tensor | None) -> Any:
    """The adjoint of a state, contiguous, and zero for worlds that failed."""
    tensors = [a.contiguous() for a in adj.differentiable()]
    if failed is not None:
        tensors = [a.masked_fill(failed.view(-1, *(1,) * (a.dim() - 1)), 0.0) for a in tensors]
    return type(adj).of(tensors)


def _taken(trail: Trail, runner: Runner) -> dict[int, Any]:
    """Take the checkpoints out of the trail, so that each state is freed as soon as it is dropped.

    A second backward pass finds none and recomputes them first.
    """
    states = dict(trail.states)
    trail.states.clear()
    if states:
        return states
    state: Any = trail.start
    checkpointed = trail.checkpointed
    for k in range(checkpointed[-1] + 1):
        if k > 0:
            state = runner.settle(trail.chunks[k - 1], state, keep=False).end
        if k in checkpointed:
            states[k] = runner.scheme.checkpoint(state)
    return states


def _inside_out(trail: Trail, runner: Runner) -> Iterator[Run]:
    """All chunks as runs that store their states, from the last to the first."""
    if trail.plan.keep_all:
        yield from reversed(trail.runs)
        return
    states = _taken(trail, runner)
    nothing = torch.empty(0)
    current: Any = State(nothing, nothing, nothing, nothing)
    for action, k in checkpointing.backward_schedule(len(trail.chunks), trail.plan.checkpoints):
        if action == "restore":
            current = states[k]
        elif action == "advance":
            current = runner.settle(trail.chunks[k], current, keep=False).end
        elif action == "keep":
            states[k] = runner.scheme.checkpoint(current)
        elif action == "drop":
            del states[k]
        else:
            yield runner.settle(trail.chunks[k], current, keep=True)


@contextmanager
def explain_out_of_memory(model: Model, horizon: Horizon, gradient: bool) -> Iterator[None]:
    """On ``OutOfMemoryError``, free the cached buffers and add a note with the estimated requirement."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        with exclusive_capture(
            wait=False
        ) as acquired:  # else destroying a graph could invalidate another thread's capture
            if acquired and not is_capturing(model):
                model.workspace.release()
        error.add_note(_needs(model, horizon, gradient))
        raise


def _needs(model: Model, horizon: Horizon, gradient: bool) -> str:
    """A sentence with the estimated memory of a call, and how to reduce it."""
    calls = f"{model.calls} calls" if gradient and model.calls > 1 else "a call"
    call = f"{calls} of {horizon.total} substeps with {model.particle_count:,} particles in {model.worlds} world(s)"
    less = "Fewer particles or worlds take less"
    try:
        forward, kept, backward = (f"{size / 2**20:,.1f} MiB" for size in memory(model, horizon)[:3])
    except ValueError as error:  # the budget is too small for a gradient, which was not requested
        return f"softmpm: {call} did not fit; {error} {less}."
    if not gradient:
        return f"softmpm: {call} takes {forward}, by the formula of docs/memory.md. {less}."
    hint = (
        ""
        if model.calls > 1
        else " Calls of one backward pass share it once build knows how many they are (calls)."
    )
    return (
        f"softmpm: {call} and the backward pass take {backward}, {kept} of it kept in between, by the formula of docs/memory.md. "
        f"{less}; a smaller memory_budget (softmpm.build) takes time instead.{hint}"
    )
