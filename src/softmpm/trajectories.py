"""Trajectories: states of a simulation, or what is observed of them, at every so many control steps."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from softmpm.alarms import Failures
from softmpm.autograd import cast, simulate
from softmpm.batches import refuse_batches
from softmpm.check_inputs import check_inputs, check_inputs_bounds, steps_of
from softmpm.check_inputs import control_steps as steps_of_call
from softmpm.check_state import check_finite, check_state
from softmpm.checks import check_activation, check_horizon, check_whole
from softmpm.errors import noted
from softmpm.inputs import QUANTITIES, Inputs
from softmpm.kernel_inputs import expanded, velocity_to
from softmpm.model import Model, check_model
from softmpm.planning.chunks import Horizon
from softmpm.schemes.capture import is_capturing
from softmpm.state import Params, State
from softmpm.validate import need


class Trajectory(NamedTuple):
    """Result of :func:`softmpm.trajectory`."""

    end: State
    """State after the last control step, from which a simulation continues."""
    frames: Any
    """Observations after each ``every``-th control step, in tensors with a first axis ``frame``. Without ``observe`` a
    :class:`softmpm.State`, whose ``x`` has shape (frame, world, particle, dim)."""


def trajectory(
    model: Model,
    start: State,
    activation: Tensor | None,
    params: Params,
    *,
    substeps: int,
    every: int = 1,
    control_steps: int | None = None,
    observe: Callable[[State], Any] | None = None,
    inputs: Inputs | None = None,
    failures: Failures | None = None,
) -> Trajectory:
    """Advance a soft robot as :func:`softmpm.simulate` does, and observe it on the way, differentiably.

    Each frame is the end of one call of ``simulate`` over ``every`` control steps, ``every * substeps * dt`` seconds. For a gradient
    build the model with ``calls`` equal to the number of frames, which then share the memory budget.

    Args:
        model, start, activation, params, substeps, inputs: As of ``simulate``.
        every: Control steps from frame to frame; divides their number.
        control_steps: Their number, needed where neither ``activation`` nor an input with rows states it, as for a passive body.
        observe: Function of a state that returns a tensor, or tuples, lists, named tuples or dictionaries of tensors, all of the same
            shapes in each frame, such as ``lambda state: softmpm.center_of_mass(model, state, params)``; None returns the states.
        failures: As of ``simulate``, for each call: a world that was frozen starts again with the next frame.

    Returns:
        The final state and the frames.

    Raises:
        TypeError, ValueError: As of ``simulate``; ``every`` does not divide the number of control steps; ``observe`` returns something
            else.
        UnstableError: As of ``simulate``, with a note of the control step from which its ``substep`` counts.
    """
    check_model(model, "trajectory")
    start, activation = cast(model, start), cast(model, activation)
    check_state(model, start)
    check_activation(model, activation)
    check_whole("every", every)
    given = check_inputs(model, inputs)
    steps = _steps(activation, given, control_steps)
    horizon = check_horizon(steps, substeps)
    need(
        steps % every == 0,
        f"every must divide the number of control steps, got every={every} and {steps} control steps; leave out the last "
        f"{steps % every} or take another number.",
    )
    refuse_batches((*start.differentiable(), activation, *given.values()))
    if not is_capturing(model):  # before the first frame, by the rows of the whole trajectory
        check_finite(start, activation)
        check_inputs_bounds(model, given)
    given = _with_velocity(model, start, given, horizon)
    if activation is None and all(steps_of(name, value) is None for name, value in given.items()):
        activation = model.positions.new_zeros(steps, model.worlds, model.muscle_count)
    state, frames = start, []
    for first in range(0, steps, every):
        last = first + every
        part = Inputs(**{name: _rows(name, value, first, last) for name, value in given.items()})
        row = None if activation is None else activation[first:last]
        with noted(f"softmpm.trajectory: the substep counts from the beginning of control step {first}."):
            state = simulate(model, state, row, params, substeps=substeps, inputs=part, failures=failures)
        frames.append(state if observe is None else observe(state))
    return Trajectory(state, stacked(frames))


def _steps(activation: Tensor | None, given: dict[str, Tensor], stated: int | None) -> int:
    """Number of control steps, which must be that of the activation and the inputs if they have one."""
    found = steps_of_call(activation, given)
    if stated is None:
        return found
    check_whole("control_steps", stated)
    told = activation is not None or any(steps_of(name, value) is not None for name, value in given.items())
    need(
        not told or found == stated,
        f"control_steps must be the number of rows of activation and inputs, {found}, got {stated}; leave it out.",
    )
    return stated


def _with_velocity(
    model: Model, start: State, given: dict[str, Tensor], horizon: Horizon
) -> dict[str, Tensor]:
    """Positions of driven particles as velocities, which a call takes from where its first state is."""
    if "position" not in given:
        return given
    position = expanded(model, "position", given["position"], horizon)
    others = {name: value for name, value in given.items() if name != "position"}
    return others | {"velocity": velocity_to(model, start, position, horizon)}


def _rows(name: str, value: Tensor, first: int, last: int) -> Tensor:
    """Rows of an input for these control steps; poses have one more, and what has no rows serves all."""
    if steps_of(name, value) is None:
        return value
    return value[first : last + (QUANTITIES[name].axes[0] == "pose")]


def stacked(frames: Sequence[Any]) -> Any:
    """Values of the same structure as one, whose tensors have a first axis of these values."""
    one = frames[0]
    for other in frames:
        need(
            _form(other) == _form(one),
            f"observe must return values of one structure in all frames, got {_form(one)} and later {_form(other)}.",
        )
    if one is None:
        return None
    if isinstance(one, Tensor):
        return torch.stack(list(frames))
    if isinstance(one, dict):
        return {name: stacked([frame[name] for frame in frames]) for name in one}
    if isinstance(one, (tuple, list)):
        parts = [stacked(part) for part in zip(*frames, strict=True)]
        return type(one)(*parts) if hasattr(one, "_fields") else type(one)(parts)
    raise TypeError(
        f"observe must return tensors, or tuples, lists or dictionaries of tensors, got {type(one).__name__}; give numbers by "
        "torch.as_tensor."
    )


def _form(value: Any) -> str:
    """Type of a value, with the shape of a tensor, the keys of a dictionary or the length of a sequence."""
    if isinstance(value, Tensor):
        return f"a tensor of shape {tuple(value.shape)}"
    if isinstance(value, dict):
        return f"a dictionary of {', '.join(sorted(map(str, value))) or 'nothing'}"
    if isinstance(value, (tuple, list)):
        return f"a {type(value).__name__} of length {len(value)}"
    return "None" if value is None else f"a {type(value).__name__}"
