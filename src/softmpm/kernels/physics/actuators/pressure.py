"""Stress of a chamber under pressure and its adjoint. Derivation: docs/math/elasticity.md.

    τ = −p J I                                                                                       (M2)
    p̄ = −J tr(τ̄),  F̄ = −p tr(τ̄) cof(F)                                                              (M2.adj)
    P = −p C,  C = cof F,  p̄ = −⟨P̄, C⟩,  F̄ = −p (P̄ × F)                                              (M2.P)

with the active stress p [Pa]: positive expands.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.actuators import actuator_adj_type
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.tangent import moduli_type
from softmpm.kernels.structs import types


@kernel_factory
def actuator(dim: int, dtype: str) -> SimpleNamespace:
    t, k, ActuatorAdj = types(dim, dtype), kinematics(dim, dtype), actuator_adj_type(dim, dtype)
    real, vec, mat, Moduli = t.real, t.vec, t.mat, moduli_type(dtype)
    identity, cofactor, volume_change = k.identity, k.cofactor, k.volume_change
    shifted, cofactor_change, cofactor_adj = k.shifted, k.cofactor_change, k.cofactor_adj

    @wp.func
    def stress(H: mat, fibre: vec, p: real) -> mat:
        return (-p * (real(1.0) + volume_change(H))) * identity()

    @wp.func
    def stress_adj(H: mat, fibre: vec, p: real, adj_tau: mat) -> ActuatorAdj:
        trace = wp.trace(adj_tau)
        adj = ActuatorAdj()
        adj.F = (-p * trace) * cofactor(identity() + H)
        adj.active_stress = -(real(1.0) + volume_change(H)) * trace
        return adj

    @wp.func
    def piola_adj(H: mat, fibre: vec, p: real, adj_P: mat) -> ActuatorAdj:
        adj = ActuatorAdj()
        adj.F = -p * cofactor_adj(H, adj_P)
        adj.active_stress = -wp.ddot(adj_P, shifted(cofactor_change(H), real(1.0)))
        return adj

    @wp.func
    def bound(F: mat, j: real, fibre: vec, p: real) -> real:
        return real(dim) * wp.max(-p * (real(1.0) + j), real(0.0))

    @wp.func
    def moduli(p: real) -> Moduli:
        m = Moduli()
        m.slope = -p
        return m

    return SimpleNamespace(
        stress=stress, stress_adj=stress_adj, piola_adj=piola_adj, bound=bound, moduli=moduli
    )
