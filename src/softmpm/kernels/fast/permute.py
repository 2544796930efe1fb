"""Permutation of the inputs of particles to the order of the cells, and of their adjoints to the user's order."""

from types import SimpleNamespace
from typing import Any

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory

DTYPES: dict[str, Any] = {"float32": wp.float32, "float64": wp.float64, "int32": wp.int32}


@kernel_factory
def permute(dtype: str) -> SimpleNamespace:
    """Kernels on arrays (quantity, world, particle, component); ``order`` contains the particle at each place."""
    kind = DTYPES[dtype]

    @kernel()
    def sort(
        # Parameters:
        order: wp.array2d(dtype=wp.int32),
        # In:
        given: wp.array4d(dtype=kind),
        # Out:
        placed: wp.array4d(dtype=kind),
    ):
        quantity, world, place, component = wp.tid()
        placed[quantity, world, place, component] = given[quantity, world, order[world, place], component]

    @kernel()
    def sort_adj(
        # Parameters:
        order: wp.array2d(dtype=wp.int32),
        # In:
        adj_placed: wp.array4d(dtype=kind),
        # Out, added into:
        adj: wp.array4d(dtype=kind),
    ):
        """Adjoint of ``sort``."""
        quantity, world, place, component = wp.tid()
        p = order[world, place]
        adj[quantity, world, p, component] = (
            adj[quantity, world, p, component] + adj_placed[quantity, world, place, component]
        )

    return SimpleNamespace(sort=sort, sort_adj=sort_adj)
