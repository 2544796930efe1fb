"""Surface points of an initial state in the moving formulation."""

import torch

from softmpm.model import Model
from softmpm.schemes.carried import points_of
from softmpm.schemes.inputs import Values, of_surface_walls
from softmpm.state import State, SurfaceState


def with_surface(model: Model, start: State, values: Values) -> State:
    """The state with what it has of its surface points, or with points that adhere where they are.

    Args:
        values: Inputs of the call; those of walls that move have a first axis of control steps. Without them walls are the scene's.
    """
    if start.surface is not None:
        return start
    points = points_of(model)
    x = points.shown(start)
    if "normal" in values:
        n = of_surface_walls(model, values["normal"][0])  # at the beginning of the call
    else:
        n = points.normals.expand(model.worlds, -1, -1)
    height = (x[:, None] * n[:, :, None]).sum(-1)
    anchor = (x[:, None] - height[..., None] * n[:, :, None]).to(model.dtype)
    return start._replace(surface=SurfaceState(anchor, torch.zeros_like(anchor)))
