"""Elastic laws: one file each, named as the class of the material in snake case. Derivation: docs/math/elasticity.md.

A file has a factory ``law(dim, dtype)``, which gives the Warp functions

    rotation(H) → Q                         what the stress needs of the rotation R = I + Q; zero if nothing
    stress(H, Q, mu, lam) → τ               Kirchhoff stress [Pa]
    stress_adj(H, Q, mu, lam, τ̄) → LawAdj   adjoints of F, μ and λ
    piola_adj(H, Q, mu, lam, P̄) → LawAdj    the same for P = τ F⁻ᵀ, without a quotient by J where P has none
    bound(square, j, trace, mu, lam) → K    at least the stiffness of (W3) [Pa], and equal to it at rest, from the square of the largest
                                            principal stretch or more, j = J − 1 and the trace of F Fᵀ
    moduli(j, trace, mu, lam) → Moduli      those of (Q8), for the step limit of the reference formulation
"""

import importlib
from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


def law(name: str, dim: int, dtype: str) -> SimpleNamespace:
    """Functions of the law that stands in the file ``name``."""
    return importlib.import_module(f"{__name__}.{name}").law(dim, dtype)


@kernel_factory
def law_adj_type(dim: int, dtype: str):
    t = types(dim, dtype)

    @wp.struct
    class LawAdj:
        F: t.mat
        mu: t.real
        lam: t.real

    return LawAdj


@kernel_factory
def no_rotation(dim: int, dtype: str) -> wp.Function:
    """For laws that need no rotation."""
    mat = types(dim, dtype).mat

    @wp.func
    def rotation(H: mat) -> mat:
        return mat()

    return rotation
