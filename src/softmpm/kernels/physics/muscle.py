"""Stress of a muscle and its adjoint. Derivation: docs/math/elasticity.md.

    τ = p f fᵀ,  f = F d = d + H d                                                                   (M1)
    p̄ = fᵀ τ̄ f,  F̄ = p (τ̄ + τ̄ᵀ) f dᵀ                                                              (M1.adj)

with the unit direction d in the rest shape and the pull p = activation · strength [Pa]: positive contracts.
Source: Spielberg et al. 2021 (Robotica).
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


@kernel_factory
def muscle(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, mat = t.real, t.vec, t.mat

    @wp.struct
    class MuscleAdj:
        F: mat
        pull: real

    @wp.func
    def muscle_stress(H: mat, fibre: vec, pull: real) -> mat:
        f = fibre + H * fibre
        return pull * wp.outer(f, f)

    @wp.func
    def muscle_stress_adj(H: mat, fibre: vec, pull: real, adj_tau: mat) -> MuscleAdj:
        f = fibre + H * fibre
        adj = MuscleAdj()
        adj.F = pull * wp.outer((adj_tau + wp.transpose(adj_tau)) * f, fibre)
        adj.pull = wp.dot(f, adj_tau * f)
        return adj

    return SimpleNamespace(Adj=MuscleAdj, muscle_stress=muscle_stress, muscle_stress_adj=muscle_stress_adj)
