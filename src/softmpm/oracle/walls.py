"""Walls in plain float64 PyTorch: poses that move, the nodes inside, their response. Part of :mod:`softmpm.oracle.moving`.

Derivations and labels: docs/math/grid.md.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from softmpm.inputs import Inputs
from softmpm.scene.scene import CONTACTS, MIRRORS, Scene, Wall

ON_NODES = tuple(kind for kind in CONTACTS if kind not in MIRRORS)
"""Kinds of walls that act on nodes."""
BESIDE_POINTS = tuple(kind for kind in ON_NODES if kind != "separate")
"""Those that do so where separating walls act on surface points."""


class Surface(NamedTuple):
    """A wall at the beginning of a substep, in each world (C4)."""

    normal: Tensor
    """a(t), not of unit length between two poses, shape (world, dim)."""
    offset: Tensor
    """o(t) [m], shape (world,)."""
    unit: Tensor
    """Unit normal a/|a|, shape (world, dim)."""
    normal_rate: Tensor
    """da/dt [1/s], shape (world, dim)."""
    offset_rate: Tensor
    """do/dt [m/s], shape (world,)."""
    slide: Tensor
    """Velocity w of the surface beyond that of the pose [m/s], shape (world, dim)."""


def surface(scene: Scene, k: int, inputs: Inputs, like: Tensor, time: float, duration: float) -> Surface:
    """Wall ``k`` at ``time`` [s] after the beginning of a control step of ``duration`` [s] (C4)."""
    normal, offset = _poses(scene, k, inputs, len(like))
    zero = like.new_zeros(len(like), scene.grid.dim)
    slide = zero
    if inputs.wall_velocity is not None:
        slide = inputs.wall_velocity.expand(len(like), len(scene.walls), scene.grid.dim)[:, k]
    if len(offset) == 1:
        return Surface(normal[0], offset[0], normal[0], zero, zero[:, 0], slide)
    normal_rate, offset_rate = (normal[1] - normal[0]) / duration, (offset[1] - offset[0]) / duration
    a, o = normal[0] + time * normal_rate, offset[0] + time * offset_rate
    return Surface(a, o, a / _length(a), normal_rate, offset_rate, slide)


def _poses(scene: Scene, k: int, inputs: Inputs, worlds: int) -> tuple[Tensor, Tensor]:
    """Normals (pose, world, dim) and offsets (pose, world) at both ends of a control step, or the only ones, divided by |n|."""
    dim, walls = scene.grid.dim, len(scene.walls)
    normal, offset = inputs.wall_normal, inputs.wall_offset
    if normal is None:
        normal = torch.tensor([scene.walls[k].normal], dtype=torch.float64)[:, None].expand(1, worlds, dim)
    else:
        normal = normal if normal.ndim == 4 else normal[None]
        normal = normal.expand(len(normal), worlds, walls, dim)[:, :, k]
    if offset is None:
        offset = torch.full((1, worlds), scene.walls[k].offset, dtype=torch.float64)
    else:
        offset = offset if offset.ndim == 3 else offset[None]
        offset = offset.expand(len(offset), worlds, walls)[:, :, k]
    if inputs.wall_normal is not None:  # the scene's are unit vectors, and its offsets are theirs
        length = _length(normal)
        normal = normal / length
        offset = offset if inputs.wall_offset is None else offset / length[..., 0]
    count = max(len(normal), len(offset))
    return normal.expand(count, -1, -1), offset.expand(count, -1)


def _length(vectors: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vectors, dim=-1, keepdim=True)


def nodes(scene: Scene) -> Tensor:
    """Places of the nodes [m], shape (node, dim), float64."""
    axes = (torch.arange(n, dtype=torch.float64) * scene.grid.spacing for n in scene.grid.shape)
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flatten(0, -2)


def inside(scene: Scene, wall: Surface, displacement: Tensor | None = None) -> Tensor:
    """Nodes that a wall acts on: a·x ≤ o, summed axis by axis in float64; shape (world, node). Not differentiable.

    ``displacement`` [m] of the nodes, shape (world, node, dim), where they are not at their places in the grid.
    """
    x, a = nodes(scene)[None], wall.normal.detach().double()
    if displacement is not None:
        x = x + displacement.detach().double()
    reach = a[:, :1] * x[..., 0]
    for axis in range(1, scene.grid.dim):
        reach = reach + a[:, axis, None] * x[..., axis]
    return reach <= wall.offset.detach().double()[:, None]


def wall_velocity(scene: Scene, wall: Surface, displacement: Tensor | None = None) -> Tensor:
    """Velocity u of a wall at each node [m/s], shape (world, node, dim) (C4); ``displacement`` as for :func:`inside`."""
    x = nodes(scene)[None] if displacement is None else nodes(scene) + displacement
    approach = wall.offset_rate[:, None] - (x * wall.normal_rate[:, None]).sum(-1)
    return (approach / _length(wall.normal))[..., None] * wall.unit[:, None] + wall.slide[:, None]


def respond(wall: Wall, v: Tensor, friction: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
    """Velocity of a node inside a wall at rest (C1 to C3); ``friction`` and ``normal`` broadcast to v, None is the wall's."""
    n = torch.tensor(wall.normal, dtype=v.dtype) if normal is None else normal
    if wall.contact == "stick":
        return torch.zeros_like(v)
    v_n = (v * n).sum(-1, keepdim=True)
    v_t = v - v_n * n
    if wall.contact == "slip":
        return v_t
    if wall.contact != "separate":
        raise ValueError(f"the oracle has no contact {wall.contact!r}; add it to respond.")
    c = torch.tensor(wall.friction, dtype=v.dtype) if friction is None else friction
    squared = (v_t**2).sum(-1, keepdim=True)
    sliding = squared > (c * v_n) ** 2
    speed = torch.sqrt(torch.where(sliding, squared, torch.ones_like(squared)))
    held = torch.where(c > 0, torch.zeros_like(v_t), v_t)  # a smooth wall holds no node
    v_t = torch.where(sliding, v_t * (1 + c * v_n / speed), held)
    return torch.where(v_n < 0, v_t, v)
