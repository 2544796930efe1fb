"""Surface points of an initial state in the moving formulation."""

import torch

from softmpm.checks import check_carried
from softmpm.model import Model
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.inputs import Values
from softmpm.state import State, SurfaceState
from softmpm.surface_points import CarriedPoints


def with_surface(model: Model, start: State, values: Values) -> State:
    """The state with its surface points: its own, or those at the places that x and F show, which adhere nowhere.

    Args:
        values: Inputs of the call; those of walls that move have a first axis of control steps. Without them walls are the scene's.
    """
    points = model.surface
    assert isinstance(points, CarriedPoints)
    if start.surface is not None:
        if not is_capturing(model):
            apart = start.surface.x.detach() - points.shown(start.detach())
            # In root mean square: single points at sharp corners drift by a cell.
            distances = apart.square().sum(dim=-1).mean(dim=-1).sqrt()
            check_carried(distances.max(), model.scene.grid.spacing)
        return start
    x = points.shown(start)
    if "normal" in values:
        n = values["normal"][0][:, model.spec.surface_walls]  # at the beginning of the call
    else:
        n = points.normals.expand(model.worlds, -1, -1)
    height = torch.einsum("wpd,wkd->wkp", x, n)
    anchor = (x[:, None] - height[..., None] * n[:, :, None]).to(model.dtype)
    return start._replace(surface=SurfaceState(x, anchor, torch.zeros_like(anchor)))
