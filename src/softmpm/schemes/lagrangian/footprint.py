"""Memory of the reference formulation: displacement and velocities of the nodes around the particles at rest."""

import math
from collections.abc import Sequence
from typing import ClassVar

from softmpm.planning.memory import Buffers, Plan, Sizes, input_bytes, sizes_of
from softmpm.schemes.lagrangian.overlap import overlap_bytes


class LagrangianFootprint:
    """See :class:`softmpm.planning.memory.Footprint`."""

    numbers_per_node: ClassVar[dict[int, int]] = {2: 13, 3: 19}  # mass; u, v twice; low

    def obstacle(self, shape: Sequence[int], particles: int) -> str | None:
        return None

    def node_count(self, model) -> int:
        return model.rest_grid.count

    def sizes(self, model) -> Sizes:
        field = model.worlds * model.rest_grid.count * model.dim * model.dtype.itemsize
        anchors = math.prod(model.anchor_shape) * model.dtype.itemsize + 8 * model.worlds * model.dim
        held = math.prod(model.reaction_shape) * model.dtype.itemsize
        return sizes_of(model, inside=3 * field + anchors, nodes=0, between=4 * field + 2 * anchors + held)

    def buffers(self, model, horizon, chosen: Plan) -> Buffers:
        real, nodal = model.dtype.itemsize, model.sizes().inside
        sums = model.worlds * model.rest_grid.window.numel() * model.dim * real
        low = 2 * model.worlds * model.rest_grid.count * model.dim * real
        forward = 2 * nodal + low + sums + input_bytes(model, 1) + overlap_bytes(model)
        kept = 0 if not chosen.keep_all else model.worlds * model.rest_grid.count * real
        return Buffers(forward, kept, 2 * nodal + 2 * sums)
