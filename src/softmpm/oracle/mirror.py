"""Clamps and planes of symmetry in plain float64 PyTorch: the truth in tests; no code shared with kernels or with mirror_grid.py.

Fields are those of every node of the grid, row by row over ``scene.grid.shape``. Derivation: docs/math/mirror.md, (B1) and (B3).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from softmpm.scene.scene import Scene


class Plane(NamedTuple):
    """A wall that reflects, and the images of the nodes in it, which differ along one axis only."""

    axis: int
    image: Tensor
    """Coordinate of the image of each coordinate along the axis; outside of the grid it is cut to it."""
    there: Tensor
    """1 where the image is on the grid, else 0."""
    reached: Tensor
    """True on the plane and behind it."""
    sign: Tensor
    """Motion of an image along each axis over that of the node: 1 or -1, shape (dim,)."""


def planes(scene: Scene) -> list[Plane]:
    """The clamps and planes of symmetry of a scene, in its order."""
    found = []
    for wall in scene.walls:
        if wall.contact not in ("clamp", "symmetry"):
            continue
        axis = [abs(n) for n in wall.normal].index(1.0)
        length, side = scene.grid.shape[axis], wall.normal[axis]
        twice, here = round(2 * wall.offset * side / scene.grid.spacing), torch.arange(length)
        image, sign = twice - here, torch.ones(scene.grid.dim, dtype=torch.float64)
        sign[slice(None) if wall.contact == "clamp" else axis] = -1.0
        there = ((image >= 0) & (image < length)).double()
        found.append(Plane(axis, image.clamp(0, length - 1), there, side * (2 * here - twice) <= 0, sign))
    return found


def with_image(plane: Plane, values: Tensor, sign: Tensor | float = 1.0) -> Tensor:
    """Sum of values (world, *nodes, ...) and ``sign`` times those at the images of their nodes."""
    trailing = (1,) * (values.ndim - 2 - plane.axis)
    image = values.index_select(1 + plane.axis, plane.image)
    return values + plane.there.view(-1, *trailing) * sign * image


def reflected(scene: Scene, mass: Tensor, field: Tensor) -> Tensor:
    """The mean of a field on the nodes and its images in clamps and symmetries, weighted by mass (B1).

    Planes that face each other must be three cells apart here.
    """
    mirrors, shape = planes(scene), scene.grid.shape
    if not mirrors:
        return field
    total, weighted = mass.unflatten(1, shape), (mass[..., None] * field).unflatten(1, shape)
    for plane in mirrors:
        total = with_image(plane, total)
        weighted = with_image(plane, weighted, plane.sign)
    total, weighted = total.flatten(1, scene.grid.dim), weighted.flatten(1, scene.grid.dim)
    mean = weighted / torch.where(total > 0, total, torch.ones_like(total))[..., None]
    return torch.where((mass > 0)[..., None], mean, torch.zeros_like(mean))


def pull(scene: Scene, mass: Tensor, change: Tensor) -> Tensor:
    """Impulse of each clamp and plane of symmetry (B3) [N s], shape (world, clamp or symmetry, dim), where (B1) changes velocities.

    Args:
        mass: Of the nodes [kg], shape (world, node).
        change: Of the velocities of the nodes [m/s], shape (world, node, dim).
    """
    mirrors, shape, dim = planes(scene), scene.grid.shape, scene.grid.dim
    shares = []
    for plane in mirrors:
        reached = plane.reached.view(-1, *(1,) * (dim - 1 - plane.axis))
        reached = reached & (mass.detach().unflatten(1, shape) > 0)
        for other in mirrors:  # a node takes part if one of its images does
            reached = with_image(other, reached.double()) > 0
        shares.append(reached[..., None] & (plane.sign < 0))
    share = torch.stack(shares, 1).double()
    share = share / share.sum(1, keepdim=True).clamp(min=1.0)
    momentum = (mass[..., None] * change).unflatten(1, shape)
    return (share * momentum[:, None]).flatten(2, 1 + dim).sum(2)
