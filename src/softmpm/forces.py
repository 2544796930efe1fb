"""Forces of the walls on surface points, as a function of a state. Derivation: docs/math/contact.md, (K7)."""

from softmpm.checks import check_state
from softmpm.compiling import opaque
from softmpm.model import Model, check_model
from softmpm.state import ContactForces, State
from softmpm.surface_grid import SurfaceGrid


def contact_forces(model: Model, state: State) -> ContactForces:
    """Forces of the separating walls on the surface points in the control step that ended in ``state``.

    The mean over a control step of T seconds is the sum of its impulses over T, so T times the total force is the momentum that the
    walls transferred. For the mean over a whole call, give the call one control step.

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
        assert isinstance(surface, SurfaceGrid)
        force, points = state.nodes.force, surface.places(state.nodes.u, state.nodes.shift)
    elif state.surface is not None:
        force, points = state.surface.force, state.surface.x.to(state.x.dtype)
    else:
        raise ValueError(
            "contact_forces needs a state that simulate returned, got one without nodes or surface points; simulate from it first."
        )
    traction = force / surface.areas.to(force.dtype)[:, None]
    return ContactForces(force.sum(2), traction, points)
