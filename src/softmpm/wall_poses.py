"""Poses of the walls that a call's inputs give, differentiable."""

from collections.abc import Mapping

from torch import Tensor

from softmpm.check_inputs import check_inputs, check_inputs_bounds, control_steps
from softmpm.inputs import QUANTITIES, Inputs
from softmpm.model import Model

POSES = ("wall_normal", "wall_offset")
"""Fields of :class:`softmpm.Inputs` that make up a pose."""


def wall_poses(model: Model, given: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Unit normals and offsets of all walls; those of the scene where they are not given.

    Args:
        model: Of a scene whose walls may move.
        given: Fields of :class:`softmpm.Inputs` that are not None, already checked (check_inputs.py).

    Returns:
        Normals, shape (pose, world, wall, dim), and offsets [m], shape (pose, world, wall); either has a single pose if it is at rest.
    """
    normal, offset = (_expanded(model, name, given.get(name, model.defaults[name])) for name in POSES)
    length = normal.norm(dim=-1)
    normal = (normal / length[..., None]).contiguous()
    return normal, offset / length if "wall_offset" in given else offset  # the scene's is of a unit normal


def _expanded(model: Model, name: str, value: Tensor) -> Tensor:
    value = value[(None,) * (len(QUANTITIES[name].axes) - value.ndim)]
    return value.expand(len(value), *model.shape_of(name, 0)[1:])


def given_poses(model: Model, inputs: Inputs | None) -> tuple[Tensor, Tensor] | None:
    """Unit normals and offsets as of :func:`wall_poses`, as many of one as of the other and without history; None if the inputs have no
    poses."""
    given = check_inputs(model, inputs)
    if not given.keys() & set(POSES):
        return None
    check_inputs_bounds(model, given)
    control_steps(None, given)
    normal, offset = (values.detach() for values in wall_poses(model, given))
    count = max(len(normal), len(offset))
    return normal.expand(count, *normal.shape[1:]), offset.expand(count, *offset.shape[1:])
