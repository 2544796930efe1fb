"""Memory of the plain scheme: states in the user's order, and every node of the grid."""

from collections.abc import Sequence
from typing import ClassVar

from softmpm.planning.memory import Buffers, Plan, Sizes, sizes_of, state_bytes


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
        return sizes_of(model, inside=inside, nodes=0, between=state_bytes(particles, d, real))

    def buffers(self, model, horizon, chosen: Plan) -> Buffers:
        inside, terms = model.sizes().inside, term_bytes(model)
        return Buffers(2 * inside + terms, 0, inside + terms)


def term_bytes(model) -> int:
    """Bytes of the terms that a deterministic model on a GPU sorts before it adds them up, see kernels/compile.py.

    Each has a key and an index, both twice for the sort, and the momentum and mass that a particle gives to a node.
    """
    if not model.deterministic or model.device.type == "cpu":
        return 0
    terms = model.worlds * model.particle_count * 3**model.dim
    return terms * (2 * (8 + 4) + (model.dim + 1) * model.dtype.itemsize)
