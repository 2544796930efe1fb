"""Storage of the nodes in each substep, for a gradient.

It has the velocity v, and the velocity w before damping, walls and contact (nodes.py); where none of these acts, w is the new velocity
and is not stored. Displacements are recomputed from the velocities (displacements.py), except in scenes with constraints, which may set
both.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.rows import rows
from softmpm.kernels.structs import Spec, types


def stores_all(spec: Spec) -> bool:
    """True if w is stored at all nodes, because damping, walls or constraints may act on any of them."""
    return spec.damping or spec.constrained or bool(spec.node_walls)


def stores_u(spec: Spec) -> bool:
    """True if the displacements are stored, because constraints may act on them."""
    return spec.constrained


@kernel_factory
def record(spec: Spec) -> SimpleNamespace:
    vec, Chunk = types(spec.dim, spec.dtype).vec, chunk(spec.dim, spec.dtype).Chunk
    row, all_nodes, surface = rows(spec.dim, spec.dtype), stores_all(spec), bool(spec.surface_walls)

    @wp.func
    def store(at: Chunk, world: int, i: int, touched: int, s: int, w: vec):
        """Store w of node ``i`` in substep ``s``; ``touched`` is its number among those that surface points act on, or -1."""
        if wp.static(all_nodes or surface):
            place = touched
            if wp.static(all_nodes):
                place = i
            if at.keep == 1 and place >= 0:
                row(at.w, s, world)[place] = w

    @wp.func
    def stored(at: Chunk, world: int, i: int, touched: int, s: int) -> vec:
        """w of node ``i`` in substep ``s``."""
        if wp.static(all_nodes):
            return row(at.w, s, world)[i]
        else:
            w = row(at.v, s + 1, world)[i]
            if wp.static(surface):
                if touched >= 0:
                    w = row(at.w, s, world)[touched]
            return w

    return SimpleNamespace(store=store, stored=stored)
