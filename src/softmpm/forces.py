"""Forces of the walls as functions of a state. Derivation: (K7) of docs/math/contact.md and (B3) of docs/math/mirror.md."""

from torch import Tensor

from softmpm.check_state import check_state
from softmpm.compiling import opaque
from softmpm.model import Model, check_model
from softmpm.state import ContactForces, State


def contact_forces(model: Model, state: State) -> ContactForces:
    """Forces of the separating walls on the surface points in the control step that ended in ``state``.

    The mean over a control step of T seconds is the sum of its impulses over T, so T times the total force is the momentum that the
    walls transferred. For the mean over a whole call, give the call one control step. Other walls have no row: that of the wall k of
    the scene is ``model.surface.walls.index(k)``.

    Args:
        model: From :func:`softmpm.build`, with contact at surface points (docs/formulations.md).
        state: Result of :func:`softmpm.simulate`. Differentiable, through ``state.nodes`` or ``state.surface``.

    Raises:
        TypeError: ``model`` or ``state`` are of another type.
        ValueError: The model has no contact at surface points, or the state neither nodes nor surface points.
    """
    return _contact_forces(model, state)


@opaque
def _contact_forces(model: Model, state: State) -> ContactForces:
    check_model(model, "contact_forces")
    check_state(model, state)
    surface = model.surface
    if surface is None:
        raise ValueError(
            "contact_forces needs contact at surface points, which this model has not; build it with contact='surface'."
        )
    if state.nodes is not None:
        force = state.nodes.force
    elif state.surface is not None:
        force = state.surface.force
    else:
        raise ValueError(
            "contact_forces needs a state that simulate returned, got one without nodes or surface points; simulate from it first."
        )
    traction = force / surface.areas.to(force.dtype)[:, None]
    return ContactForces(force.sum(2), traction, surface.shown(state).to(force.dtype))


def clamp_forces(model: Model, state: State) -> Tensor:
    """Force of each clamp and plane of symmetry on the bodies in the control step that ended in ``state``.

    The mean over a control step of T seconds, as with :func:`contact_forces`: T times the sum of the forces of all walls, gravity
    and other loads is what the bodies gain in momentum, without damping; a damping of γ takes e^(−γΔt) of each force. A plane of
    symmetry has the force of the half that is not simulated. Where planes meet, the force on the nodes near the edge is divided
    equally among those that hold the component.

    Args:
        model: From :func:`softmpm.build`, of a scene with walls of the kinds ``clamp`` or ``symmetry``.
        state: Result of :func:`softmpm.simulate`. Differentiable, through ``state.nodes``.

    Returns:
        Forces [N], in 2D N per metre of depth, shape (world, wall, dim), of the walls of these kinds alone, in the order of the scene:
        row k is that of ``scene.walls[model.mirror.walls[k]]``.

    Raises:
        TypeError: ``model`` or ``state`` are of another type.
        ValueError: The scene has no such walls, or the state no nodes with their forces.
    """
    return _clamp_forces(model, state)


@opaque
def _clamp_forces(model: Model, state: State) -> Tensor:
    check_model(model, "clamp_forces")
    check_state(model, state)
    if model.mirror is None:
        kinds = sorted({wall.contact for wall in model.scene.walls})
        raise ValueError(
            f"clamp_forces needs a wall of the kind clamp or symmetry, got {', '.join(kinds) or 'no walls'}; contact_forces has the "
            "forces of separating walls at surface points."
        )
    if state.nodes is None or state.nodes.reaction is None:
        raise ValueError(
            "clamp_forces needs a state that simulate returned, got one without nodes or their reaction; simulate from it first."
        )
    # A product of matrices would be in half precision under autocast:
    reaction = state.nodes.reaction.double()
    return (model.mirror.shares.double()[None] * reaction[:, None]).sum(dim=2).to(model.dtype)
