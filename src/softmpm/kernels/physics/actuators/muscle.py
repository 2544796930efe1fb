"""Stress of a muscle and its adjoint. Derivation: docs/math/elasticity.md.

    τ = p f fᵀ,  f = F d = d + H d                                                                   (M1)
    p̄ = fᵀ τ̄ f,  F̄ = p (τ̄ + τ̄ᵀ) f dᵀ,  d̄ = p Fᵀ (τ̄ + τ̄ᵀ) f                                         (M1.adj)
    P = p f dᵀ,  p̄ = f·P̄ d,  F̄ = p P̄ d dᵀ,  d̄ = p (Fᵀ P̄ d + P̄ᵀ f)                                   (M1.P)

with the unit direction d in the rest shape and the active stress p [Pa]: positive contracts. Source: Spielberg et al. 2021 (Robotica).
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.actuators import actuator_adj_type
from softmpm.kernels.physics.tangent import moduli_type
from softmpm.kernels.structs import types


@kernel_factory
def actuator(dim: int, dtype: str) -> SimpleNamespace:
    t, ActuatorAdj = types(dim, dtype), actuator_adj_type(dim, dtype)
    real, vec, mat, Moduli = t.real, t.vec, t.mat, moduli_type(dtype)

    @wp.func
    def stress(H: mat, fibre: vec, p: real) -> mat:
        f = fibre + H * fibre
        return p * wp.outer(f, f)

    @wp.func
    def stress_adj(H: mat, fibre: vec, p: real, adj_tau: mat) -> ActuatorAdj:
        f = fibre + H * fibre
        adj = ActuatorAdj()
        adj.F = p * wp.outer((adj_tau + wp.transpose(adj_tau)) * f, fibre)
        adj.active_stress = wp.dot(f, adj_tau * f)
        adj_f = p * ((adj_tau + wp.transpose(adj_tau)) * f)
        adj.fibre = adj_f + wp.transpose(H) * adj_f
        return adj

    @wp.func
    def piola_adj(H: mat, fibre: vec, p: real, adj_P: mat) -> ActuatorAdj:
        f = fibre + H * fibre
        pull = adj_P * fibre
        adj = ActuatorAdj()
        adj.F = p * wp.outer(pull, fibre)
        adj.active_stress = wp.dot(f, pull)
        adj.fibre = p * (pull + wp.transpose(H) * pull + wp.transpose(adj_P) * f)
        return adj

    @wp.func
    def bound(F: mat, j: real, fibre: vec, p: real) -> real:
        f = F * fibre
        return real(2.0) * wp.max(p, real(0.0)) * wp.dot(f, f)

    @wp.func
    def moduli(p: real) -> Moduli:
        m = Moduli()
        m.shear = wp.max(p, real(0.0))
        return m

    return SimpleNamespace(
        stress=stress, stress_adj=stress_adj, piola_adj=piola_adj, bound=bound, moduli=moduli
    )
