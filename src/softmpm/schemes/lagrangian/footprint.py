"""Memory of the reference formulation: displacement and velocities of the nodes around the particles at rest."""

import math
from collections.abc import Sequence
from typing import ClassVar

from softmpm.kernels.lagrangian.record import stores_all, stores_u
from softmpm.planning.memory import Buffers, Plan, Sizes, input_bytes, sizes_of
from softmpm.schemes.lagrangian.overlap import overlap_bytes
from softmpm.surface_grid import SurfaceGrid


def stored_nodes(model) -> int:
    """Number of nodes of which a gradient stores w (kernels/lagrangian/record.py)."""
    if stores_all(model.spec):
        return model.rest_grid.count
    return len(model.surface.nodes) if isinstance(model.surface, SurfaceGrid) else 0


class LagrangianFootprint:
    """See :class:`softmpm.planning.memory.Footprint`."""

    numbers_per_node: ClassVar[dict[int, int]] = {2: 13, 3: 19}  # mass; u, v twice; low

    def obstacle(self, shape: Sequence[int], particles: int) -> str | None:
        return None

    def node_count(self, model) -> int:
        return model.rest_grid.count

    def sizes(self, model) -> Sizes:
        field, anchors = _field_bytes(model), _anchor_bytes(model)
        w = model.worlds * stored_nodes(model) * model.dim * model.dtype.itemsize
        held = math.prod(model.reaction_shape) * model.dtype.itemsize
        u = field if stores_u(model.spec) else 0
        inside, between = field + u + w + anchors, 4 * field + 2 * anchors + held
        apart = 2 * (field - u) + 2 * field + _sum_bytes(model)  # two displacements that take turns; low
        return sizes_of(model, inside=inside, nodes=0, between=between, derived=field - u, apart=apart)

    def buffers(self, model, horizon, chosen: Plan) -> Buffers:
        real, nodal = model.dtype.itemsize, 3 * _field_bytes(model) + _anchor_bytes(model)
        sums = _sum_bytes(model)
        forward = 2 * nodal + 2 * _field_bytes(model) + sums + input_bytes(model, 1) + overlap_bytes(model)
        kept = 0 if not chosen.keep_all else model.worlds * model.rest_grid.count * real
        low = 0 if stores_u(model.spec) else _field_bytes(model)
        return Buffers(forward, kept, 2 * nodal + low + 2 * sums)


def _field_bytes(model) -> int:
    """Bytes of a vector at each node."""
    return model.worlds * model.rest_grid.count * model.dim * model.dtype.itemsize


def _sum_bytes(model) -> int:
    """Bytes of the sums of the bricks."""
    return model.worlds * model.rest_grid.window.numel() * model.dim * model.dtype.itemsize


def _anchor_bytes(model) -> int:
    """Bytes of the anchors of the surface points and of the shifts."""
    return math.prod(model.anchor_shape) * model.dtype.itemsize + 8 * model.worlds * model.dim
