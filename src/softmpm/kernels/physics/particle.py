"""Update of one particle between two transfers, with its adjoint: the functions that every scheme is composed of.

    A = m C − Δt V⁰ τ / D,  D = dx²/4                                                                (T1)
    C' = B / D,  x' = x + Δt v',  H' = H + Δt C' (I + H)         given v' = Σ w v_i, B = Σ w v_i rᵀ  (T3)

    v̄ += m Σ w p̄_i,  Ā = Σ w p̄_i rᵀ,  C̄ += m Ā,  τ̄ = −(Δt V⁰ / D) Ā,  m̄ += Σ w (p̄_i·(v + C r) + m̄_i)   (T1.adj)
    v̄' += Δt x̄',  C̄' += Δt H̄' (I + H)ᵀ,  H̄ += H̄' + Δt C'ᵀ H̄',  x̄ += x̄'                              (T3.adj)

Lengths in here count in cells: fx = x/dx − base, B and A are per cell. The factors 4/dx and dx on the way of C are chosen together
(model.py), since their rounding would let a free body spin up or down. In float32 fx is a compensated sum: what adding Δt v'/dx
loses is kept and added in the next step. Symbols and sources: kernels/plain/transfer.py. Derivation: docs/math/transfer.md.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics import status
from softmpm.kernels.physics.elasticity import elasticity
from softmpm.kernels.physics.stress import solid, solid_adj
from softmpm.kernels.structs import RequestedGrads, Spec, solid_adj_type, solid_types, types


@kernel_factory
def particle(spec: Spec) -> SimpleNamespace:
    t, laws = types(spec.dim, spec.dtype), elasticity(spec.dim, spec.dtype)
    real, vec, mat, ivec, Constants, divide = t.real, t.vec, t.mat, t.ivec, t.Constants, t.divide
    Solid, rotation, stress = solid_types(spec).Solid, solid(spec).rotation, solid(spec).stress
    valid, dim, rounds = status.check(spec).valid, spec.dim, spec.dtype == "float32"

    @wp.struct
    class Particle:
        base: ivec
        fx: vec
        low: vec  # what rounding took off fx
        v: vec
        C: mat
        H: mat
        valid: bool

    @wp.func
    def impulse(constants: Constants, body: Solid, world: int, p: int) -> real:
        """Δt V⁰ / D [m s]."""
        return divide(real(4.0) * constants.dt * body.volume[world, p], constants.spacing * constants.spacing)

    @wp.func
    def affine_momentum(constants: Constants, body: Solid, world: int, p: int, C: mat, H: mat, Q: mat) -> mat:
        """A per cell [kg m/s] (T1)."""
        return constants.width * (
            body.mass[world, p] * C - impulse(constants, body, world, p) * stress(body, world, p, H, Q)
        )

    @wp.func
    def moved(constants: Constants, corner: ivec, shape: ivec, old: Particle, v: vec, B: mat) -> Particle:
        """(T3). The base must stay on the ``shape`` nodes from ``corner`` on; what is not valid keeps its base."""
        new = Particle()
        new.v = v
        new.C = constants.rate * B
        new.H = old.H + constants.dt * (new.C + new.C * old.H)
        step = divide(constants.dt, constants.spacing) * v
        if wp.static(rounds):
            step += old.low
            new.low = step - ((old.fx + step) - old.fx)
        new.fx = old.fx + step
        new.base = old.base
        cells = vec()
        for axis in range(dim):
            cells[axis] = wp.floor(new.fx[axis] - real(0.5))
            new.base[axis] = old.base[axis] + int(cells[axis])
        new.valid = valid(constants, corner, shape, new.fx, new.base, new.H)
        if new.valid:
            new.fx = new.fx - cells
        return new

    return SimpleNamespace(
        Particle=Particle,
        impulse=impulse,
        rotation=rotation,
        affine_momentum=affine_momentum,
        moved=moved,
        identity=laws.identity,
    )


@kernel_factory
def particle_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, one = types(spec.dim, spec.dtype), particle(spec)
    real, vec, mat, Constants, divide = t.real, t.vec, t.mat, t.Constants, t.divide
    Solid, SolidAdj = solid_types(spec).Solid, solid_adj_type(spec, wanted)
    stress_adj, impulse, identity = solid_adj(spec, wanted).stress_adj, one.impulse, one.identity

    @wp.struct
    class ParticleAdj:
        fx: vec
        v: vec
        C: mat
        H: mat

    @wp.func
    def momentum_adj(
        constants: Constants,
        body: Solid,
        world: int,
        p: int,
        v: vec,
        C: mat,
        H: mat,
        Q: mat,
        adj_mv: vec,
        adj_m: real,
        B: mat,
        adj_body: SolidAdj,
    ) -> ParticleAdj:
        """(T1.adj) of v, C and H from Σ w p̄_i, Σ w m̄_i and B = Σ w p̄_i rᵀ; adds what is wanted into ``adj_body``."""
        m = body.mass[world, p]
        adj_A = constants.spacing * B
        adj = ParticleAdj()
        adj.v = m * adj_mv
        adj.C = m * adj_A
        adj.H = stress_adj(body, world, p, H, Q, -impulse(constants, body, world, p) * adj_A, adj_body)
        if wp.static(wanted.material):
            adj_body.mass[world, p] = adj_body.mass[world, p] + adj_m + wp.dot(adj_mv, v) + wp.ddot(adj_A, C)
        return adj

    @wp.func
    def moved_adj(constants: Constants, H: mat, new_C: mat, adj_new: ParticleAdj) -> ParticleAdj:
        """(T3.adj): adjoints of x and H before, and in ``v`` and ``C`` those of v' and B.

        With 4/dx and dx as they are: the paired factors cost registers, which spill, and change an adjoint by 1e-7.
        """
        adj = ParticleAdj()
        adj.fx = adj_new.fx
        adj.v = adj_new.v + divide(constants.dt, constants.spacing) * adj_new.fx
        adj.C = divide(real(4.0), constants.spacing) * (
            adj_new.C + constants.dt * (adj_new.H * wp.transpose(identity() + H))
        )
        adj.H = adj_new.H + constants.dt * (wp.transpose(new_C) * adj_new.H)
        return adj

    return SimpleNamespace(ParticleAdj=ParticleAdj, momentum_adj=momentum_adj, moved_adj=moved_adj)
