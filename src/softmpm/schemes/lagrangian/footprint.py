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
        real, field, anchors = model.dtype.itemsize, _field_bytes(model), _anchor_bytes(model)
        w = model.worlds * stored_nodes(model) * model.dim * real
        u = field if stores_u(model.spec) else 0
        inside, between = field + u + w + anchors, 4 * field + 2 * anchors + _reaction_bytes(model)
        shown = 2 * real * model.worlds * model.particle_count * (model.dim + model.dim**2)
        sizes = sizes_of(model, inside=inside, nodes=0, between=between)
        apart = 2 * (field - u) + chunk_bytes(model)  # two displacements that take turns
        return sizes._replace(start=shown + between, derived=field - u, apart=apart, passed_on=between)

    def buffers(self, model, horizon, chosen: Plan) -> Buffers:
        field, anchors, sums, contact = (
            part(model) for part in (_field_bytes, _anchor_bytes, _sum_bytes, _contact_bytes)
        )
        (chunks, lengths), overlap = horizon.counted(chosen.longest), overlap_bytes(model)
        # One runs, one is launched ahead, and one of another shape may be cached.
        at_once = min(chunks, 2 + (len(lengths) > 1))
        graphs = at_once * (4 * field + 2 * anchors + chunk_bytes(model))
        low = 0 if stores_u(model.spec) else field
        reflected = 0 if model.mirror is None else 2 * field
        passed = 2 * (3 * field + anchors)  # adjoints of two states
        backward = passed + low + 2 * sums + 2 * contact + reflected
        return Buffers(graphs + overlap, overlap + (0 if chosen.keep_all else graphs), backward)


def chunk_bytes(model, control_steps: int = 1) -> int:
    """Bytes of the buffers of a chunk of so many control steps besides its states: low, masses, sums, inputs and their order, forces,
    contact."""
    order = 4 * model.worlds * model.particle_count
    nodes = 2 * _field_bytes(model) + _field_bytes(model) // model.dim + _sum_bytes(model)
    points = _anchor_bytes(model) + _contact_bytes(model)
    return nodes + input_bytes(model, control_steps) + order + points


def _reaction_bytes(model) -> int:
    """Bytes of the mean forces of clamps and planes of symmetry."""
    return math.prod(model.reaction_shape) * model.dtype.itemsize


def _field_bytes(model) -> int:
    """Bytes of a vector at each node."""
    return model.worlds * model.rest_grid.count * model.dim * model.dtype.itemsize


def _sum_bytes(model) -> int:
    """Bytes of the sums of the bricks."""
    return model.worlds * model.rest_grid.window.numel() * model.dim * model.dtype.itemsize


def _contact_bytes(model) -> int:
    """Bytes of the velocities without contact, and of the impulse and the mobility of each surface point."""
    if model.surface is None:
        return 0
    points = model.worlds * model.anchor_shape[2] * (model.dim + 1) * model.dtype.itemsize
    return _field_bytes(model) + points


def _anchor_bytes(model) -> int:
    """Bytes of the anchors of the surface points and of the shifts."""
    return math.prod(model.anchor_shape) * model.dtype.itemsize + 8 * model.worlds * model.dim
