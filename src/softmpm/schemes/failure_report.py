"""Errors from status words: reads the words back, composes the message and raises."""

import torch
from torch import Tensor

from softmpm.errors import FROZEN, NEVER, Kind, UnstableError, decode
from softmpm.model import Model
from softmpm.schemes.failure_messages import Case
from softmpm.schemes.inputs import Values
from softmpm.schemes.overlap import Overlap
from softmpm.schemes.penetration import Penetration
from softmpm.state import State


class Report:
    """Asynchronous copy of status words to the host, so that more work can be launched before they are read."""

    def __init__(self, words: Tensor):
        self._event = None
        if words.device.type == "cpu":
            self._words = words.clone()
        else:
            self._words = torch.empty(words.shape, dtype=words.dtype, device="cpu", pin_memory=True)
            self._words.copy_(words, non_blocking=True)
            self._event = torch.cuda.Event()
            # By default PyTorch would take the stream of the current GPU:
            self._event.record(torch.cuda.current_stream(words.device))

    def read(self) -> list[int]:
        """Wait until the device has reached the report, and return the words."""
        if self._event is not None:
            self._event.synchronize()
        return self._words.tolist()


def outgrown(words: list[int]) -> bool:
    """True if a particle left the allocated part of the grid."""
    return any(decode(words[world])[1] is Kind.LEFT_WINDOW for world in failed_worlds(words))


def began_outside(words: list[int]) -> bool:
    """True if a particle was outside of the allocated part of the grid as soon as the chunk began."""
    found = (decode(words[world]) for world in failed_worlds(words))
    return any(kind is Kind.LEFT_WINDOW and substep == 0 for substep, kind, _ in found)


def failed_worlds(words: list[int]) -> list[int]:
    """Worlds whose status word reports a failure."""
    return [world for world, word in enumerate(words) if word not in (NEVER, FROZEN)]


def failure(
    model: Model,
    words: list[int],
    world: int,
    end: State,
    *,
    first: int = 0,
    start: State | None = None,
    values: Values | None = None,
    state: State | None = None,
    before: bool = False,
    time: float = 0.0,
) -> UnstableError:
    """The failure of a world as an error.

    Args:
        words: Status words, one for each world.
        end: State in which the worlds stopped.
        first: Substep of the call that the kernels counted as 0.
        start: Initial state of the call, if available: the state of worlds that never ran.
        values: Inputs of the call in one control step, if available.
        state: State that the error carries; ``end`` if None.
        before: True if the initial state itself was checked, before any substep.
        time: Of ``end`` since the beginning of the control step of ``values`` [s].
    """
    substep, kind, particle = decode(words[world])
    substep += first
    if start is not None:
        unmoved = [w for w in failed_worlds(words) if decode(words[w])[1] is Kind.START]
        end, state = (
            _never_ran(end, start, unmoved),
            None if state is None else _never_ran(state, start, unmoved),
        )
    if kind is Kind.IN_WALL:
        case = Penetration(model, world, particle, end, values, time)
        particle, where = case.particle, f"{case.where} of world {world}"
    else:
        about = model, world, particle, end
        case = Overlap(*about) if kind is Kind.OVERLAP else Case(model, kind, world, particle, end, values)
        where = f"particle {particle} (body {int(model.body[particle])}) of world {world}"
    name, value, limit, advice = case.explain()
    at = f"substep {substep} (t = {(substep + 1) * model.scene.dt:.6g} s after the start of the call)"
    more = len(failed_worlds(words)) - 1
    others = f" ({more} more world(s) failed too.)" if more else ""
    when = "in the start state" if kind is Kind.START or before else f"at {at}"
    return UnstableError(
        f"{where} {value} {when}; {limit}. {advice}{others}",
        kind=name,
        world=world,
        particle=particle,
        substep=substep,
        value=value,
        limit=limit,
        state=end if state is None else state,
    )


def raise_failure(model: Model, words: list[int], end: State, **about) -> None:
    """Raise the first failure that the kernels reported, if any; ``about`` as for :func:`failure`."""
    failed = failed_worlds(words)
    if failed:
        raise failure(model, words, min(failed, key=lambda world: words[world]), end, **about)


def raise_gradient_failure(
    model: Model, words: list[int], last: int, adj_end: State | None = None, total: int | None = None
) -> None:
    """Raise the first failure that the adjoint kernels reported, if any.

    Args:
        words: Status words, one for each world.
        last: Substep from which the kernels counted backward.
        adj_end: Adjoint of the final state of the call; None if it is not at hand.
        total: Substeps of the call; None if there is no call.
    """
    world = min(range(len(words)), key=lambda w: words[w])
    if words[world] == NEVER:
        return
    back, kind, particle = decode(words[world])
    substep, limit = last - back, "gradients must be finite"
    where = f"at substep {substep}" + (
        "" if total is None else f" of {total}, counted from the start of the call"
    )
    came_in = "the gradient of the loss with respect to the end state came in like that: look at the loss"
    overflowed = "it overflowed in the backward pass: shorten the horizon or scale the loss"
    if adj_end is None:
        cause = f"Either {came_in}; or {overflowed}"
    else:
        given = all(bool(torch.isfinite(adj[world]).all()) for adj in adj_end.differentiable())
        cause = overflowed if given else came_in
        cause = cause[0].upper() + cause[1:]
    raise UnstableError(
        f"particle {particle} (body {int(model.body[particle])}) of world {world} has an adjoint that is not finite {where}; "
        f"{limit}. {cause}.",
        kind=kind.name.lower(),
        world=world,
        particle=particle,
        substep=substep,
        value="not finite",
        limit=limit,
    )


def _never_ran(end: State, start: State, worlds: list[int]) -> State:
    """The final state, with the initial one for these worlds: the fast scheme cannot represent particles off the grid."""
    if not worlds:
        return end
    given, start = end.clone(), start.detach()
    for tensor, from_start in zip(given[:4], start[:4], strict=True):
        tensor[worlds] = from_start[worlds]
    for name in () if given.low is None else ("x", "F"):
        getattr(given.low, name)[worlds] = 0.0 if start.low is None else getattr(start.low, name)[worlds]
    return given
