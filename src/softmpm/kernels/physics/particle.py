"""Update of one particle between two transfers, with its adjoint: the functions that every scheme is composed of.

    A = m C − Δt V⁰ τ / D,  D = dx²/4                                                                (T1)
    C' = B / D,  x' = x + Δt v',  H' = H + Δt C' (I + H)         given v' = Σ w v_i, B = Σ w v_i rᵀ  (T3)

    v̄ += m Σ w p̄_i,  Ā = Σ w p̄_i rᵀ,  C̄ += m Ā,  τ̄ = −(Δt V⁰ / D) Ā,  m̄ += Σ w (p̄_i·(v + C r) + m̄_i)   (T1.adj)
    v̄' += Δt x̄',  C̄' += Δt H̄' (I + H)ᵀ,  H̄ += H̄' + Δt C'ᵀ H̄',  x̄ += x̄'                              (T3.adj)

Lengths here are in cells: fx = x/dx − base, and B and A are per cell. The factors 4/dx and dx of C are chosen together
(specification.py), since their rounding would let a free body spin up or down. In float32 fx is a compensated sum: the rounding error
of adding Δt v'/dx is stored and added in the next step. Symbols and sources: kernels/plain/transfer.py. Derivation:
docs/math/transfer.md.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics import status
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.stress import material, total_stress, total_stress_adj
from softmpm.kernels.physics.viscosity import viscosity
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def particle(spec: Spec) -> SimpleNamespace:
    t, k = types(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype)
    real, vec, mat, ivec, Constants, divide = t.real, t.vec, t.mat, t.ivec, t.Constants, t.divide
    ParticleInputs, total = input_types(spec).ParticleInputs, total_stress(spec)
    rotation_of, stress, identity = total.rotation, total.stress, k.identity
    valid, dim, rounds = status.check(spec).valid, spec.dim, spec.dtype == "float32"
    viscous, forced, driven = spec.viscosity, "force" in spec.given, spec.driven
    viscous_stress, material_of = viscosity(spec.dim, spec.dtype).viscous_stress, material(spec).material_of

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
    def rotation(inputs: ParticleInputs, world: int, p: int, H: mat) -> mat:
        """Q of F, if the law of the particle asks for it."""
        return rotation_of(material_of(inputs, world, p), H)

    @wp.func
    def impulse(constants: Constants, inputs: ParticleInputs, world: int, p: int) -> real:
        """Δt V⁰ / D [m s]."""
        return divide(
            real(4.0) * constants.dt * inputs.volume[world, p], constants.spacing * constants.spacing
        )

    @wp.func
    def linear_momentum(constants: Constants, inputs: ParticleInputs, world: int, p: int, v: vec) -> vec:
        """m v + Δt f (T1)."""
        if wp.static(forced):
            return inputs.mass[world, p] * v + constants.dt * inputs.force[world, p]
        return inputs.mass[world, p] * v

    @wp.func
    def affine_momentum(
        constants: Constants, inputs: ParticleInputs, world: int, p: int, C: mat, H: mat, Q: mat
    ) -> mat:
        """A per cell [kg m/s] (T1)."""
        tau = stress(material_of(inputs, world, p), H, Q)
        if wp.static(viscous):
            tau += viscous_stress(identity() + H, C, inputs.viscosity[world, p])
        return constants.width * (inputs.mass[world, p] * C - impulse(constants, inputs, world, p) * tau)

    @wp.func
    def moved(
        constants: Constants,
        inputs: ParticleInputs,
        world: int,
        p: int,
        corner: ivec,
        shape: ivec,
        old: Particle,
        v: vec,
        B: mat,
    ) -> Particle:
        """(T3). The base must stay on the ``shape`` nodes from ``corner`` on; what is not valid keeps its base."""
        new = Particle()
        new.v = v
        if wp.static(driven):
            handle = inputs.driven[world, p]
            if handle >= 0:
                new.v = inputs.velocity[world, handle]
        new.C = constants.rate * B
        new.H = old.H + constants.dt * (new.C + new.C * old.H)
        step = divide(constants.dt, constants.spacing) * new.v
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
        linear_momentum=linear_momentum,
        affine_momentum=affine_momentum,
        moved=moved,
        identity=identity,
    )


@kernel_factory
def particle_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, one = types(spec.dim, spec.dtype), particle(spec)
    real, vec, mat, Constants, divide = t.real, t.vec, t.mat, t.Constants, t.divide
    ParticleInputs = input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    stress_adj, impulse, identity = total_stress_adj(spec, wanted).stress_adj, one.impulse, one.identity
    viscous_stress_adj = viscosity(spec.dim, spec.dtype).viscous_stress_adj
    moduli = "material" in wanted
    viscous = spec.viscosity
    driven = spec.driven
    material_of = material(spec).material_of
    forced, steered = "force" in wanted, "velocity" in wanted

    @wp.struct
    class ParticleAdj:
        fx: vec
        v: vec
        C: mat
        H: mat

    @wp.func
    def momentum_adj(
        constants: Constants,
        inputs: ParticleInputs,
        world: int,
        p: int,
        v: vec,
        C: mat,
        H: mat,
        Q: mat,
        adj_mv: vec,
        adj_m: real,
        B: mat,
        adj_inputs: ParticleInputsAdj,
    ) -> ParticleAdj:
        """(T1.adj) of v, C and H from Σ w p̄_i, Σ w m̄_i and B = Σ w p̄_i rᵀ; adds what is wanted into ``adj_inputs``."""
        m = inputs.mass[world, p]
        adj_A = constants.spacing * B
        adj = ParticleAdj()
        adj.v = m * adj_mv
        adj.C = m * adj_A
        adj_tau = -impulse(constants, inputs, world, p) * adj_A
        adj.H = stress_adj(material_of(inputs, world, p), H, Q, adj_tau, world, p, adj_inputs)
        if wp.static(viscous):
            adj_viscous = viscous_stress_adj(identity() + H, C, inputs.viscosity[world, p], adj_tau)
            adj.C += adj_viscous.C
            adj.H += adj_viscous.F
            if wp.static("viscosity" in wanted):
                adj_inputs.viscosity[world, p] = adj_inputs.viscosity[world, p] + adj_viscous.eta
        if wp.static(moduli):
            adj_inputs.mass[world, p] = (
                adj_inputs.mass[world, p] + adj_m + wp.dot(adj_mv, v) + wp.ddot(adj_A, C)
            )
        if wp.static(forced):
            adj_inputs.force[world, p] = adj_inputs.force[world, p] + constants.dt * adj_mv
        return adj

    @wp.func
    def moved_adj(
        constants: Constants,
        inputs: ParticleInputs,
        world: int,
        p: int,
        H: mat,
        new_C: mat,
        adj_new: ParticleAdj,
        adj_inputs: ParticleInputsAdj,
    ) -> ParticleAdj:
        """(T3.adj): adjoints of x and H before, and in ``v`` and ``C`` those of Σ w v_i and B.

        Uses 4/dx and dx instead of the rounded pair ``rate`` and ``width``: the pair would change an adjoint by 1e-7 only, and costs
        registers.
        """
        adj = ParticleAdj()
        adj.fx = adj_new.fx
        adj.v = adj_new.v + divide(constants.dt, constants.spacing) * adj_new.fx
        adj.C = divide(real(4.0), constants.spacing) * (
            adj_new.C + constants.dt * (adj_new.H * wp.transpose(identity() + H))
        )
        adj.H = adj_new.H + constants.dt * (wp.transpose(new_C) * adj_new.H)
        if wp.static(driven):
            handle = inputs.driven[world, p]
            if handle >= 0:
                if wp.static(steered):
                    adj_inputs.velocity[world, handle] = adj_inputs.velocity[world, handle] + adj.v
                adj.v = vec()
        return adj

    return SimpleNamespace(ParticleAdj=ParticleAdj, momentum_adj=momentum_adj, moved_adj=moved_adj)
