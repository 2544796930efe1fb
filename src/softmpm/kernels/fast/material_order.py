"""Material of the particles in the order of the cells, and its adjoint back in the user's order."""

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, solid_adj_type, solid_types


@kernel_factory
def sorted_solid(spec: Spec):
    """Kernel that puts the material into the order of the packed particles."""
    Solid, mixed, slots = solid_types(spec).Solid, len(spec.laws) > 1, spec.muscle_slots

    @wp.kernel(module=spec.module + ".sorted", enable_backward=False)
    def sort(
        # Parameters:
        order: wp.array2d(dtype=wp.int32),
        # In:
        body: Solid,
        # Out:
        packed: Solid,
    ):
        world, place = wp.tid()
        p = order[world, place]
        packed.mass[world, place] = body.mass[world, p]
        packed.mu[world, place] = body.mu[world, p]
        packed.lam[world, place] = body.lam[world, p]
        packed.volume[world, place] = body.volume[world, p]
        if wp.static(mixed):
            packed.law[world, place] = body.law[world, p]
        if wp.static(slots > 0):
            for slot in range(slots):
                packed.muscle[world, place, slot] = body.muscle[world, p, slot]

    return sort


@kernel_factory
def sorted_solid_adj(spec: Spec, wanted: RequestedGrads):
    """Adjoint of :func:`sorted_solid`: adds the material gradients of each place to those of its particle."""
    SolidAdj = solid_adj_type(spec, wanted)

    @wp.kernel(module=adj_module(spec, wanted) + ".sorted", enable_backward=False)
    def sort_adj(
        # Parameters:
        order: wp.array2d(dtype=wp.int32),
        # In:
        adj_packed: SolidAdj,
        # Out, added into:
        adj_body: SolidAdj,
    ):
        world, place = wp.tid()
        p = order[world, place]
        adj_body.mass[world, p] = adj_body.mass[world, p] + adj_packed.mass[world, place]
        adj_body.mu[world, p] = adj_body.mu[world, p] + adj_packed.mu[world, place]
        adj_body.lam[world, p] = adj_body.lam[world, p] + adj_packed.lam[world, place]

    return sort_adj
