"""Derivation of the kernels' inputs from those of users (inputs.py), differentiable."""

import torch
from torch import Tensor

from softmpm.inputs import QUANTITIES
from softmpm.material import material
from softmpm.model import Model
from softmpm.planning.chunks import Horizon
from softmpm.schemes.inputs import Values
from softmpm.schemes.lagrangian.driven import of_nodes
from softmpm.state import Params, State
from softmpm.wall_poses import POSES, wall_poses


def derive(
    model: Model,
    start: State,
    activation: Tensor | None,
    params: Params,
    given: Values,
    horizon: Horizon,
) -> Values:
    """Inputs of the kernels that a call sets, in the order of :data:`softmpm.inputs.INPUTS`; the others are in ``model.fixed``.

    Args:
        start, activation, params: As in :func:`softmpm.simulate`.
        given: Fields of :class:`softmpm.Inputs` that are not None, already checked (check_inputs.py).
        horizon: Length of the call; inputs that vary in time have a row for each of its control steps.
    """
    found: Values = dict(zip(("mu", "lam", "mass"), material(model, params), strict=True))
    if model.spec.muscle_slots:
        found["active_stress"] = _active_stress(model, activation, given.get("strength"), horizon)
    others = {name: value for name, value in (model.defaults | given).items() if name not in POSES}
    full = {name: expanded(model, name, value, horizon) for name, value in others.items()}
    for name, value in full.items():
        if name == "direction":
            found["fibre"] = value / value.norm(dim=-1, keepdim=True)
        elif name == "damping":
            found["decay"] = torch.exp(-value * model.scene.dt)
        elif name == "force":
            found["force"] = value / model.mass_unit
        elif name == "position":
            found["velocity"] = velocity_to(model, start, value, horizon)
        elif name == "wall_velocity":
            found["surface_velocity"] = value
        elif name != "strength":
            found[name] = value
    if model.driven_grid is not None:
        found["driven_velocity"] = of_nodes(model, found["velocity"])
    if model.spec.moving:
        found |= _in_motion(model, given, horizon)
    return {name: found[name] for name in model.derived}


def expanded(model: Model, name: str, value: Tensor, horizon: Horizon) -> Tensor:
    """The input expanded to all of its axes, with the numbers of a vector side by side."""
    if QUANTITIES[name].axes[-1] == "dim" and value.shape[-1:] != (model.dim,):
        value = value.expand(*value.shape[:-1], model.dim).contiguous()
    if QUANTITIES[name].axes[-1] == "dim" and value.stride(-1) != 1:
        value = value.contiguous()
    return value.expand(model.shape_of(name, horizon.control_steps))


def velocity_to(model: Model, start: State, position: Tensor, horizon: Horizon) -> Tensor:
    """Velocities at which driven particles reach their positions, shape (control_step, world, driven, dim)."""
    before = torch.cat([start.x[None, :, model.driven], position[:-1]])
    return (position - before) / (horizon.substeps * model.scene.dt)


def _active_stress(
    model: Model, activation: Tensor | None, strength: Tensor | None, horizon: Horizon
) -> Tensor:
    """Activation times strength [Pa], shape (control_step, world, muscle)."""
    if activation is None:
        shape = (horizon.control_steps, model.worlds, model.muscle_count)
        return torch.zeros(shape, dtype=model.dtype, device=model.device)
    return (activation * (model.strength if strength is None else strength)).contiguous()


def _in_motion(model: Model, given: Values, horizon: Horizon) -> Values:
    """Pose of the walls at the beginning of each control step, and its rate of change (C4)."""
    seconds, steps = horizon.substeps * model.scene.dt, horizon.control_steps
    found = {}
    for name, pose in zip(("normal", "offset"), wall_poses(model, given), strict=True):
        still = len(pose) == 1
        rows = pose.expand(steps, *pose.shape[1:]) if still else pose[:-1]
        rate = torch.zeros_like(rows) if still else (pose[1:] - pose[:-1]) / seconds
        found |= {name: rows, f"{name}_rate": rate}
    return found
