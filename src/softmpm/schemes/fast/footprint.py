"""Memory of the fast scheme: packed particles, and the grid nodes near them."""

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from softmpm.kernels.fast.native import padded
from softmpm.kernels.structs import BASE_BITS, packed_rows
from softmpm.planning.memory import (
    MARGIN,
    Buffers,
    Plan,
    Sizes,
    grown_margin,
    input_bytes,
    sizes_of,
    surface_bytes,
    window_shape,
)

SMALL, MANY_CALLS = 16_384, 8
"""See :func:`is_small_loop`."""


def is_small_loop(model) -> bool:
    """True for a loop of many calls of a small scene on a GPU, where the host takes far longer to build a graph than the device to run
    it."""
    small = model.worlds * model.particle_count <= SMALL
    return model.device.type == "cuda" and small and model.calls >= MANY_CALLS


def copies(model) -> bool:
    """True if the stored states of a chunk are copied, so that its chunk graph is free for other calls.

    Without copies a loop builds a chunk graph for each call. In a small scene the copies take a fiftieth of the time of the substeps;
    with many particles it would be a sixth.
    """
    return is_small_loop(model) and not model.spec.deterministic


def first_margin(model) -> int:
    """Initial margin of the window around the particles' stencils, in nodes on each side.

    A window that grows costs a captured loop another call without the graph and another capture, seconds each, and further nodes cost a
    small scene in 2D hardly any time: there it begins as if it had grown once. In 3D it would have twice the nodes.
    """
    margin = MARGIN[model.dim]
    return grown_margin(margin) if model.dim == 2 and is_small_loop(model) else margin


class FastFootprint:
    """Memory of the fast scheme; see :class:`softmpm.planning.memory.Footprint`."""

    numbers_per_node: ClassVar[dict[int, int]] = {2: 8, 3: 8}  # momentum and mass, velocity: 4 each

    def obstacle(self, shape: Sequence[int], particles: int) -> str | None:
        largest = 2 ** BASE_BITS[len(shape)]
        if max(shape) > largest:
            return f"the grid has more than {largest} nodes along an axis"
        if padded(particles) * packed_rows(len(shape)).rows >= 2**31:
            return "there are more particles than 32-bit indices reach"
        return None

    def node_count(self, model) -> int:
        """Nodes of the window around the particles at rest."""
        cells = np.floor(model.exact_positions / model.scene.grid.spacing - 0.5)
        reach = np.ptp(cells, axis=0).astype(int).tolist()
        least = 0 if model.surface is None else model.surface.count
        return math.prod(window_shape(model.scene.grid.shape, reach, first_margin(model), least))

    def sizes(self, model) -> Sizes:
        real, d, particles = model.dtype.itemsize, model.dim, model.worlds * model.particle_count
        points = surface_bytes(model)
        pushes = 0 if model.surface is None else model.worlds * model.surface.count * d * real
        inside = particles * (4 + real * packed_rows(d).rows) + points + pushes
        between = inside - pushes + 4 * particles + points  # the order, and at most as much for the forces
        nodes = model.worlds * model.held_nodes * 4 * real
        return sizes_of(model, inside=inside, nodes=nodes, between=between)

    def buffers(self, model, horizon, chosen: Plan) -> Buffers:
        sizes = model.sizes()
        material = input_bytes(model, 1)
        fixed_point, slabs = model.spec.deterministic, model.spec.slabs
        apart = (fixed_point or slabs) * sizes.inside + fixed_point * 2 * sizes.nodes
        second = 0 if model.surface is None else 3 * sizes.nodes // 2  # velocities before contact, and loads
        graph = material + sizes.nodes + apart + second
        small = graph + sizes.inside + 2 * sizes.nodes
        forward = small * _at_once(horizon, sizes.longest)
        passed = 2 * sizes.inside  # adjoints in the order of the previous chunk, and their copy
        if model.surface is not None:
            # The same again, velocities of a second substep, and what contact adds to the adjoints of the nodes.
            passed += second + 2 * sizes.nodes
        chunks, lengths = horizon.counted(chosen.longest)
        if chosen.keep_all and copies(model):
            order = 4 * model.worlds * model.particle_count
            states = max(lengths, default=0) * (sizes.inside + sizes.nodes)
            kept = model.calls * order * chunks
            return Buffers(forward, kept + _at_once(horizon, chosen.longest) * (small + states), passed)
        if chosen.keep_all:
            kept = model.calls * graph * chunks
            return Buffers(forward, kept, passed)
        kept = graph * len(lengths) + small * _at_once(horizon, chosen.longest)
        # PyTorch runs backward passes on a GPU in a thread of their own, whose recomputed chunks have separate buffers.
        recomputed = 2 * small if model.device.type == "cuda" else 0
        return Buffers(forward, kept, passed + recomputed)


def _at_once(horizon, longest: int) -> int:
    """Number of chunk graphs in use at once that do not store their intermediate states.

    One is running, one has been launched ahead, one contains the initial state of the first, and one of another shape may be cached.
    """
    chunks, lengths = horizon.counted(longest)
    return min(chunks, 3 + (len(lengths) > 1))
