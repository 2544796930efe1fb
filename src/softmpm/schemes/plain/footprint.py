"""Memory of the plain scheme: states in the user's order, and every node of the grid."""

from collections.abc import Sequence
from typing import ClassVar

from softmpm.planning.memory import Buffers, Plan, Sizes, sizes_of, state_bytes, surface_bytes


class PlainFootprint:
    """See :class:`softmpm.planning.memory.Footprint`."""

    numbers_per_node: ClassVar[dict[int, int]] = {2: 5, 3: 7}  # momentum and mass, velocity

    def obstacle(self, shape: Sequence[int], particles: int) -> str | None:
        return None

    def node_count(self, model) -> int:
        return model.node_count

    def sizes(self, model) -> Sizes:
        real, d, particles = model.dtype.itemsize, model.dim, model.worlds * model.particle_count
        inside = particles * (4 * d + real * ((d if real == 4 else 0) + 2 * d + 2 * d * d))
        points, between = surface_bytes(model), state_bytes(particles, d, real)
        return sizes_of(model, inside=inside + points, nodes=0, between=between + 2 * points)

    def buffers(self, model, horizon, chosen: Plan) -> Buffers:
        inside, terms = model.sizes().inside, term_bytes(model)
        number = 0 if model.surface is None else model.worlds * model.node_count * model.dtype.itemsize
        # Velocities before contact, and loads; their adjoint, and what contact adds to those of velocities and masses:
        contact, back = (model.dim + 1) * number, (model.dim + 2) * number
        return Buffers(2 * inside + terms + contact, 0, inside + terms + back)


def term_bytes(model) -> int:
    """Bytes of the terms that a deterministic model on a GPU sorts before it adds them up, see kernels/compile.py.

    Each has a key and an index, both twice for the sort, and the momentum and mass that a particle gives to a node.
    """
    if not model.deterministic or model.device.type == "cpu":
        return 0
    terms = model.worlds * model.particle_count * 3**model.dim
    return terms * (2 * (8 + 4) + (model.dim + 1) * model.dtype.itemsize)
