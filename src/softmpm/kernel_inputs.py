"""Derivation of the kernels' inputs from those of users (inputs.py), in differentiable PyTorch operations."""

import torch
from torch import Tensor

from softmpm.checks import check_bounds, check_params
from softmpm.model import Model
from softmpm.planning.chunks import Horizon
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.inputs import Values
from softmpm.schemes.lagrangian.driven import of_nodes
from softmpm.state import Params, State


def lame(params: Params) -> tuple[Tensor, Tensor]:
    """Lamé's μ = E / 2(1 + ν) and λ = E ν / (1 + ν)(1 − 2ν) [Pa]."""
    young, poisson = params.young, params.poisson
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def masses(model: Model, params: Params) -> Tensor:
    """Mass of the particles in units of ``model.mass_unit``: exactly one in a uniform body, so that sums of masses are not biased."""
    mass = params.density * model.volume
    return mass / model.mass_unit  # a tensor: division by a number would multiply by the reciprocal on a GPU


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
    full = {name: expanded(model, name, value, horizon) for name, value in (model.defaults | given).items()}
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
        elif name not in ("strength", "wall_offset", "wall_normal"):
            found[name] = value
    if model.driven_grid is not None:
        found["driven_velocity"] = of_nodes(model, found["velocity"])
    if model.spec.moving:
        found |= _poses(model, full["wall_offset"], full["wall_normal"], horizon)
    return {name: found[name] for name in model.derived}


def expanded(model: Model, name: str, value: Tensor, horizon: Horizon) -> Tensor:
    """The input expanded to all of its axes; a wall at rest retains its single pose."""
    shape = model.shape_of(name, horizon.control_steps)
    if name in ("wall_offset", "wall_normal") and value.ndim == len(shape):
        shape = (len(value), *shape[1:])
    return value.expand(shape)


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


def _poses(model: Model, offset: Tensor, normal: Tensor, horizon: Horizon) -> Values:
    """Pose of the walls at the beginning of each control step, and its rate of change (C4)."""
    length = normal.norm(dim=-1)
    offset, normal = offset / length, normal / length[..., None]
    seconds, steps = horizon.substeps * model.scene.dt, horizon.control_steps
    found = {}
    for name, pose in (("offset", offset), ("normal", normal)):
        still = len(pose) == 1
        rows = pose.expand(steps, *pose.shape[1:]) if still else pose[:-1]
        rate = torch.zeros_like(rows) if still else (pose[1:] - pose[:-1]) / seconds
        found |= {name: rows, f"{name}_rate": rate}
    return found


def material(model: Model, params: Params) -> tuple[Tensor, Tensor, Tensor]:
    """μ, λ [Pa] and mass [model.mass_unit], each of shape (world, particle).

    The values of the previous call are reused if nothing changed and no gradient is needed; else ``params`` are checked.
    """
    last, seen = model.workspace.get(_Last, _Last), _seen(model, params)
    if seen and seen == last.seen:
        return last.found
    check_params(model, params)
    if not is_capturing(model):  # else nothing can be read back
        check_bounds(params, params.density * model.volume, model.mass_unit)
    lead = (model.worlds, model.particle_count)
    mu, lam = (term.expand(lead).contiguous() for term in lame(params))
    found = mu, lam, masses(model, params).expand(lead).contiguous()
    if seen:
        last.params, last.seen, last.found = params, seen, found
    return found


class _Last:
    """Material of this thread's previous call. Other threads use other streams, on which their values may not be complete yet."""

    params: Params | None = None  # referenced, so that no other tensor gets the identities in ``seen``
    seen: tuple = ()
    found: tuple[Tensor, Tensor, Tensor] = ()  # pyright: ignore[reportAssignmentType]


def _seen(model: Model, params: Params) -> tuple:
    """Identity, version and address of the parameters; empty if these could not reveal a change."""
    if is_capturing(model) or torch._C._are_functorch_transforms_active() or not isinstance(params, Params):
        return ()
    if not all(type(p) is Tensor and not p.requires_grad and not p.is_inference() for p in params):
        return ()
    return tuple((id(p), p._version, p.data_ptr()) for p in params)
