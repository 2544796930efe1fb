"""Interpolation at the surface points of bodies in the reference formulation, found once when a model is built.

The weights divide a pressure among the nodes as the stress of the particles behind it is divided. Those of nodes that would move much
farther than the point at the touch of a wall are dropped, and the others corrected by an affine function of the distance, so that
affine fields stay exact. Derivation: docs/math/contact.md.
"""

import itertools

import numpy as np
import torch
from torch import Tensor

from softmpm.rest_grid import RestGrid, bases, flat, spline, stencils
from softmpm.scene.scene import MIRRORS, Scene
from softmpm.state import State
from softmpm.surface_points import SurfacePoints
from softmpm.validate import need

FARTHEST = 10.0
"""Largest displacement that the touch of a wall may give a node that takes part, in units of that of the point."""


class SurfaceGrid(SurfacePoints):
    """Surface points of all bodies and their nodes.

    Attributes:
        stencil: Nodes of each point, numbers in the grid at rest, shape (point, 3^dim), int32. One of them is repeated for those that
            take no part.
        weights: Their weights, 0 for nodes that take no part, shape (point, 3^dim), float64.
        loads: Area that each node carries [m²], L of (K1), shape (node,), float64.
        nodes: Nodes that the points act on, or all nodes if some are constrained, shape (touched,), int32.
        first: First entry of each of ``nodes`` in ``members``, and their count, shape (touched + 1,), int32.
        members: Points that act on a node, node by node, shape (entry,), int32.
        shares: Their weights, shape (entry,), float64.
    """

    def __init__(self, scene: Scene, rest: RestGrid, device: torch.device):
        super().__init__(scene, device)
        grid, dim = scene.grid, scene.grid.dim
        points, areas = self.points.cpu().numpy(), self.areas.cpu().numpy()
        outlines = [body.particles.outline for body in scene.bodies if body.particles.outline is not None]
        offsets = np.array(list(itertools.product(range(3), repeat=dim)))
        base, f = bases(points / grid.spacing)
        arms = offsets - f[:, None]
        normals = np.concatenate([outline.normals for outline in outlines])
        cells = [max(1, round(grid.spacing / body.particles.spacing)) for body in scene.bodies]
        layers = np.repeat(cells, [len(outline) for outline in outlines])
        weights = face_weights(arms, normals, layers)
        at = flat(base[:, None] + offsets, grid.shape)
        index = rest.index.cpu().numpy()
        sorting = np.argsort(index)
        index = index[sorting]
        numbers = np.searchsorted(index, at).clip(max=len(index) - 1)
        mass = np.zeros(len(index))
        for body in scene.bodies:
            near, _, share = stencils(body.particles.positions / grid.spacing, offsets)
            share *= body.material.density * np.asarray(body.particles.volume)[:, None]
            np.add.at(mass, np.searchsorted(index, flat(near[:, None] + offsets, grid.shape)), share)
        held = (index[numbers] == at) & (mass[numbers] > 0.0)
        weights = consistent(np.where(held, weights, 0.0), arms)
        ways = nodal_loads(weights, areas, numbers, len(index)) / np.where(mass > 0.0, mass, np.inf)
        ways = ways[numbers]  # of each node at the same pressure on all points
        held &= ways <= FARTHEST * (np.abs(weights) * ways).sum(axis=1, keepdims=True)
        weights = consistent(np.where(held, weights, 0.0), arms)
        main = np.take_along_axis(numbers, np.abs(weights).argmax(axis=1)[:, None], axis=1)
        numbers = sorting[
            np.where(weights != 0.0, numbers, main)
        ]  # no point reads a node that it does not act on
        far = np.abs(weights.sum(axis=1) - 1.0) > 1e-6
        need(
            not far.any(),
            f"surface points need particles near them, but the nodes around the one at {points[far][:1].tolist()} m hold next to none; "
            "give the body an outline that fits its particles, a finer spacing, or take contact='nodes'.",
        )
        members = np.flatnonzero(weights)
        owners = numbers.reshape(-1)[members]
        order = np.argsort(owners, kind="stable")
        loads = nodal_loads(weights, areas, numbers, len(index))
        members, owners = members[order], owners[order]
        constrained = len(scene.driven) > 0 or any(wall.contact in MIRRORS for wall in scene.walls)
        touched = np.arange(len(index)) if constrained else np.unique(owners)
        self.loads, self.weights = self._tensor(loads), self._tensor(weights)
        self.stencil, self.nodes = self._tensor(numbers, np.int32), self._tensor(touched, np.int32)
        self.members = self._tensor(members // len(offsets), np.int32)
        self.shares = self._tensor(weights.reshape(-1)[members])
        self.first = self._tensor(np.append(np.searchsorted(owners, touched), len(owners)), np.int32)

    def carried(self, nodes: Tensor) -> Tensor:
        """True for points with a weight on any of these nodes, shape (point,), from shape (node,)."""
        return (nodes[self.stencil.long()] & (self.weights != 0)).any(1)

    def shown(self, state: State) -> Tensor:
        """Places of the points in a state with nodes [m], shape (world, point, dim)."""
        assert state.nodes is not None
        return self.places(state.nodes.u, state.nodes.shift)

    def places(self, u: Tensor, shift: Tensor | None = None) -> Tensor:
        """Places of the points [m], shape (world, point, dim), from displacements of the nodes and a shift of each world (K2)."""
        if u.is_cuda:  # the adjoint of indexing sums in a fixed order, that of index_select does not; on a CPU indexing wakes threads
            near = u[:, self.stencil.long()]
        else:
            near = u.index_select(1, self.stencil.reshape(-1)).reshape(len(u), *self.stencil.shape, -1)
        x = self.points.to(u.dtype) + (self.weights.to(u.dtype)[..., None] * near).sum(2)
        return x if shift is None else (x + shift[:, None]).to(u.dtype)


def nodal_loads(weights: np.ndarray, areas: np.ndarray, numbers: np.ndarray, count: int) -> np.ndarray:
    """L of (K1) [m²], shape (node,); ``numbers`` are those of each point's nodes, shape (point, node)."""
    loads = np.zeros(count)
    np.add.at(loads, numbers, np.abs(weights) * areas[:, None])
    return loads


def face_weights(arms: np.ndarray, normals: np.ndarray, layers: np.ndarray) -> np.ndarray:
    """Shares of the nodes in a pressure on a face, (K11), shape (point, node). They sum to one.

    Args:
        arms: Distance of each node from the point in cells, shape (point, node, dim).
        normals: Unit normals of the face, shape (point, dim).
        layers: Layers of particles in a cell behind each point, shape (point,).
    """
    each = layers[:, None, None]
    across = np.zeros_like(arms)
    for k in range(3 * layers.max()):
        deep = arms + (k + 0.5) / each
        across += 4 / each * deep * spline(deep)
    axes = np.eye(arms.shape[-1], dtype=bool)
    shares = np.stack([np.where(axis, across, spline(arms)).prod(axis=-1) for axis in axes], axis=-1)
    return np.einsum("pna,pa->pn", shares, normals**2)


def consistent(weights: np.ndarray, arms: np.ndarray) -> np.ndarray:
    """Weights times an affine function of the arms, so that Σ w = 1 and Σ w r = 0.

    Args:
        weights: Shape (point, node); zero for nodes that take no part.
        arms: Distance of each node from the point in cells, shape (point, node, dim).
    """
    terms = np.concatenate([np.ones_like(arms[..., :1]), arms], axis=-1)
    moments = np.einsum("pn,pni,pnj->pij", weights, terms, terms)
    wanted = np.zeros(moments.shape[:2])
    wanted[:, 0] = 1.0
    solved = np.einsum("pij,pj->pi", np.linalg.pinv(moments, rcond=1e-9), wanted)
    return weights * np.einsum("pni,pi->pn", terms, solved)
