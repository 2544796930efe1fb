"""Total stress of one particle: its law plus its muscles, as the scene has them."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.elasticity import elasticity
from softmpm.kernels.physics.muscle import muscle
from softmpm.kernels.structs import RequestedGrads, Spec, solid_adj_type, solid_types, types


@kernel_factory
def solid(spec: Spec) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, mat, Solid = t.real, t.mat, solid_types(spec).Solid
    laws, law_of = elasticity(spec.dim, spec.dtype), _law_of(spec)
    muscle_stress, slots, dim = muscle(spec.dim, spec.dtype).muscle_stress, spec.muscle_slots, spec.dim

    def rotation_from(k: int) -> wp.Function:
        """Q by the laws from number ``k`` on."""
        own, last = laws.rotation[spec.laws[k]], k + 1 == len(spec.laws)
        others = None if last else rotation_from(k + 1)

        @wp.func
        def rotation_of(law: int, H: mat) -> mat:
            if wp.static(not last):
                if law != k:
                    return others(law, H)
            return own(H)

        return rotation_of

    def stress_from(k: int) -> wp.Function:
        """τ by the laws from number ``k`` on."""
        own, last = laws.stress[spec.laws[k]], k + 1 == len(spec.laws)
        others = None if last else stress_from(k + 1)

        @wp.func
        def stress_of(law: int, H: mat, Q: mat, mu: real, lam: real) -> mat:
            if wp.static(not last):
                if law != k:
                    return others(law, H, Q, mu, lam)
            return own(H, Q, mu, lam)

        return stress_of

    def bound_from(k: int) -> wp.Function:
        """Bound of the stiffness by the laws from number ``k`` on."""
        own, last = laws.bound[spec.laws[k]], k + 1 == len(spec.laws)
        others = None if last else bound_from(k + 1)

        @wp.func
        def bound_of(law: int, square: real, j: real, mu: real, lam: real) -> real:
            if wp.static(not last):
                if law != k:
                    return others(law, square, j, mu, lam)
            return own(square, j, mu, lam)

        return bound_of

    rotation_of, stress_of, bound_of = rotation_from(0), stress_from(0), bound_from(0)

    @wp.func
    def rotation(body: Solid, world: int, p: int, H: mat) -> mat:
        """Q of F, if the law of this particle asks for it."""
        return rotation_of(law_of(body, world, p), H)

    @wp.func
    def stress(body: Solid, world: int, p: int, H: mat, Q: mat) -> mat:
        """Kirchhoff stress τ [Pa]."""
        tau = stress_of(law_of(body, world, p), H, Q, body.mu[world, p], body.lam[world, p])
        if wp.static(slots > 0):
            for slot in range(slots):
                k = body.muscle[world, p, slot]
                if k >= 0:
                    tau += muscle_stress(H, body.fibre[k], body.pull[world, k])
        return tau

    @wp.func
    def stiffness_bound(body: Solid, world: int, p: int, H: mat) -> real:
        """At least the stiffness K of (W3) [Pa], at a small part of its price; K itself at rest."""
        F = laws.identity() + H
        B = F * wp.transpose(F)
        square = real(0.0)  # of the largest stretch, at most the largest sum of a row
        for i in range(dim):
            row = real(0.0)
            for k in range(dim):
                row += wp.abs(B[i, k])
            square = wp.max(square, row)
        law = law_of(body, world, p)
        K = bound_of(law, square, laws.volume_change(H), body.mu[world, p], body.lam[world, p])
        if wp.static(slots > 0):
            for slot in range(slots):
                k = body.muscle[world, p, slot]
                if k >= 0:
                    f = F * body.fibre[k]
                    K += real(2.0) * wp.max(body.pull[world, k], real(0.0)) * wp.dot(f, f)
        return K

    return SimpleNamespace(rotation=rotation, stress=stress, stiffness_bound=stiffness_bound)


def _law_of(spec: Spec) -> wp.Function:
    """Index of a particle's law into ``spec.laws``; a scene of one law does not store it."""
    Solid = solid_types(spec).Solid
    if len(spec.laws) == 1:

        @wp.func
        def law_of(body: Solid, world: int, p: int) -> int:
            return 0
    else:

        @wp.func
        def law_of(body: Solid, world: int, p: int) -> int:
            return body.law[world, p]

    return law_of


@kernel_factory
def solid_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, mat, Solid, SolidAdj = t.real, t.mat, solid_types(spec).Solid, solid_adj_type(spec, wanted)
    laws, fibres, law_of = elasticity(spec.dim, spec.dtype), muscle(spec.dim, spec.dtype), _law_of(spec)
    muscle_stress_adj, ElasticAdj, slots = fibres.muscle_stress_adj, laws.Adj, spec.muscle_slots

    def stress_adj_from(k: int) -> wp.Function:
        """Adjoint of τ by the laws from number ``k`` on."""
        own, last = laws.stress_adj[spec.laws[k]], k + 1 == len(spec.laws)
        others = None if last else stress_adj_from(k + 1)

        @wp.func
        def stress_adj_of(law: int, H: mat, Q: mat, mu: real, lam: real, adj_tau: mat) -> ElasticAdj:
            if wp.static(not last):
                if law != k:
                    return others(law, H, Q, mu, lam, adj_tau)
            return own(H, Q, mu, lam, adj_tau)

        return stress_adj_of

    stress_adj_of = stress_adj_from(0)

    @wp.func
    def stress_adj(body: Solid, world: int, p: int, H: mat, Q: mat, adj_tau: mat, adj_body: SolidAdj) -> mat:
        """∂L/∂F; adds what is wanted of the material and of the muscles' pull into ``adj_body``."""
        law = law_of(body, world, p)
        adj = stress_adj_of(law, H, Q, body.mu[world, p], body.lam[world, p], adj_tau)
        adj_F = adj.F
        if wp.static(wanted.material):
            adj_body.mu[world, p] = adj_body.mu[world, p] + adj.mu
            adj_body.lam[world, p] = adj_body.lam[world, p] + adj.lam
        if wp.static(slots > 0):
            for slot in range(slots):
                k = body.muscle[world, p, slot]
                if k >= 0:
                    adj_muscle = muscle_stress_adj(H, body.fibre[k], body.pull[world, k], adj_tau)
                    adj_F += adj_muscle.F
                    if wp.static(wanted.activation):
                        adj_body.pull[world, p, slot] = adj_body.pull[world, p, slot] + adj_muscle.pull
        return adj_F

    return SimpleNamespace(stress_adj=stress_adj)
