"""Kinds of contact: one file each, named as :attr:`softmpm.Wall.contact`. Derivation: docs/math/grid.md.

A file has two factories for wall number k, which give Warp functions

    response(spec, k)              respond(inputs, world, n, v) → v'       of a node inside the wall, n being the outward normal
    response_adj(spec, wanted, k)  respond_adj(inputs, world, n, v, v̄', i, adj_inputs) → ContactAdj
                                   adjoints of v and n; adds those of the wall's own inputs at node i into ``adj_inputs``

The adjoints differentiate the branch that was taken. That of n may leave out what is along n, which has unit length.
Velocities are relative to the wall. With vₙ = v·n, v_t = v − vₙ n.
"""

import importlib

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import RequestedGrads, Spec, types


def response(spec: Spec, k: int) -> wp.Function:
    """``respond`` of wall number ``k``."""
    return _kind(spec, k).response(spec, k)


def response_adj(spec: Spec, wanted: RequestedGrads, k: int) -> wp.Function:
    """``respond_adj`` of wall number ``k``."""
    return _kind(spec, k).response_adj(spec, wanted, k)


def _kind(spec: Spec, k: int):
    return importlib.import_module(f"{__name__}.{spec.contacts[k]}")


@kernel_factory
def contact_adj_type(dim: int, dtype: str):
    vec = types(dim, dtype).vec

    @wp.struct
    class ContactAdj:
        v: vec
        n: vec

    return ContactAdj
