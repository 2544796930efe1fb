"""Total stress of one particle: its law plus its actuators, as the scene has them.

Laws and actuators are dispatched by nested functions. A loop with ``wp.static`` would be shorter, but Warp 1.19 leaves functions that a
loop variable selects out of the hash of a kernel: scenes that have their laws in another order would silently share one.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.accumulate import accumulate
from softmpm.kernels.physics.actuators import actuator, actuator_adj_type
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.laws import law, law_adj_type
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def total_stress(spec: Spec) -> SimpleNamespace:
    t, k = types(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype)
    real, vec, mat, Material = t.real, t.vec, t.mat, material(spec).Material
    laws = [law(name, spec.dim, spec.dtype) for name in spec.laws]
    actuators = [actuator(name, spec.dim, spec.dtype) for name in spec.actuators]
    slots, dim = spec.muscle_slots, spec.dim
    identity, volume_change = k.identity, k.volume_change

    def rotation_from(k: int) -> wp.Function:
        """Q by the laws from number ``k`` on."""
        own, last = laws[k].rotation, k + 1 == len(laws)
        others = None if last else rotation_from(k + 1)

        @wp.func
        def rotation_by(law: int, H: mat) -> mat:
            if wp.static(not last):
                if law != k:
                    return others(law, H)
            return own(H)

        return rotation_by

    def stress_from(k: int) -> wp.Function:
        """τ by the laws from number ``k`` on."""
        own, last = laws[k].stress, k + 1 == len(laws)
        others = None if last else stress_from(k + 1)

        @wp.func
        def stress_by(law: int, H: mat, Q: mat, mu: real, lam: real) -> mat:
            if wp.static(not last):
                if law != k:
                    return others(law, H, Q, mu, lam)
            return own(H, Q, mu, lam)

        return stress_by

    def bound_from(k: int) -> wp.Function:
        """Bound of the stiffness by the laws from number ``k`` on."""
        own, last = laws[k].bound, k + 1 == len(laws)
        others = None if last else bound_from(k + 1)

        @wp.func
        def bound_by(law: int, square: real, j: real, trace: real, mu: real, lam: real) -> real:
            if wp.static(not last):
                if law != k:
                    return others(law, square, j, trace, mu, lam)
            return own(square, j, trace, mu, lam)

        return bound_by

    def active_stress_from(k: int) -> wp.Function:
        """Active stress by the kinds of actuators from number ``k`` on."""
        own, last = actuators[k].stress, k + 1 == len(actuators)
        others = None if last else active_stress_from(k + 1)

        @wp.func
        def active_stress_by(kind: int, H: mat, fibre: vec, p: real) -> mat:
            if wp.static(not last):
                if kind != k:
                    return others(kind, H, fibre, p)
            return own(H, fibre, p)

        return active_stress_by

    def active_bound_from(k: int) -> wp.Function:
        """Bound of what actuators add to the stiffness, by their kinds from number ``k`` on."""
        own, last = actuators[k].bound, k + 1 == len(actuators)
        others = None if last else active_bound_from(k + 1)

        @wp.func
        def active_bound_by(kind: int, F: mat, j: real, fibre: vec, p: real) -> real:
            if wp.static(not last):
                if kind != k:
                    return others(kind, F, j, fibre, p)
            return own(F, j, fibre, p)

        return active_bound_by

    rotation_of, stress_of, bound_of = rotation_from(0), stress_from(0), bound_from(0)
    active_stress_of, active_bound_of = (
        (active_stress_from(0), active_bound_from(0)) if slots else (None, None)
    )

    @wp.func
    def rotation(own: Material, H: mat) -> mat:
        """Q of F, if the law of this particle asks for it."""
        return rotation_of(own.law, H)

    @wp.func
    def stress(own: Material, H: mat, Q: mat) -> mat:
        """Kirchhoff stress τ [Pa]."""
        tau = stress_of(own.law, H, Q, own.mu, own.lam)
        if wp.static(slots > 0):
            for slot in range(slots):
                if own.muscle[slot] >= 0:
                    tau += active_stress_of(own.kind[slot], H, own.fibre[slot], own.active_stress[slot])
        return tau

    @wp.func
    def largest_square(B: mat) -> real:
        """At least the square of the largest principal stretch: the largest sum of a row of B = F Fᵀ."""
        square = real(0.0)
        for i in range(dim):
            row = real(0.0)
            for k in range(dim):
                row += wp.abs(B[i, k])
            square = wp.max(square, row)
        return square

    @wp.func
    def stiffness_bound(own: Material, H: mat) -> real:
        """At least the stiffness K of (W3) [Pa], at a small part of its price; K itself at rest (E4)."""
        F = identity() + H
        B = F * wp.transpose(F)
        j = volume_change(H)
        K = bound_of(own.law, largest_square(B), j, wp.trace(B), own.mu, own.lam)
        if wp.static(slots > 0):
            for slot in range(slots):
                if own.muscle[slot] >= 0:
                    K += active_bound_of(own.kind[slot], F, j, own.fibre[slot], own.active_stress[slot])
        return K

    return SimpleNamespace(
        rotation=rotation, stress=stress, stiffness_bound=stiffness_bound, largest_square=largest_square
    )


@kernel_factory
def material(spec: Spec) -> SimpleNamespace:
    """Material of a particle: its law with the moduli, and its actuators."""
    t, ParticleInputs = types(spec.dim, spec.dtype), input_types(spec).ParticleInputs
    real, slots, dim = t.real, spec.muscle_slots, spec.dim
    several_laws, several_kinds = len(spec.laws) > 1, len(spec.actuators) > 1
    fibres, each_world = spec.fibres, "direction" in spec.given

    class Material:
        law: int  # index into ``spec.laws``
        mu: real
        lam: real

    if slots:
        numbers, reals = wp.types.vector(slots, wp.int32), wp.types.vector(slots, real)
        Material.__annotations__ |= {
            "muscle": numbers,  # actuator of each slot, or -1
            "kind": numbers,  # index into ``spec.actuators``
            "active_stress": reals,
            "fibre": wp.types.matrix((slots, dim), real),
        }
    Material = wp.struct(Material)

    @wp.func
    def with_actuator(own: Material, inputs: ParticleInputs, world: int, slot: int, k: int) -> Material:
        out = own
        out.active_stress[slot] = inputs.active_stress[world, k]
        if wp.static(several_kinds):
            out.kind[slot] = inputs.actuator[k]
        if wp.static(fibres and each_world):
            out.fibre[slot] = inputs.fibre[world, k]
        elif wp.static(fibres):
            out.fibre[slot] = inputs.fibre[k]
        return out

    def reader(ahead: bool) -> wp.Function:
        """Loads ``ahead`` are without branches, so that they wait for memory together; others take fewer registers."""

        @wp.func
        def material_of(inputs: ParticleInputs, world: int, p: int) -> Material:
            own = Material()
            own.mu = inputs.mu[world, p]
            own.lam = inputs.lam[world, p]
            if wp.static(several_laws):
                own.law = inputs.law[world, p]
            if wp.static(slots > 0):
                for slot in range(slots):
                    k = inputs.muscle[world, p, slot]
                    own.muscle[slot] = k
                    if wp.static(ahead):
                        own = with_actuator(own, inputs, world, slot, wp.max(k, 0))
                    else:
                        if k >= 0:
                            own = with_actuator(own, inputs, world, slot, k)
            return own

        return material_of

    return SimpleNamespace(Material=Material, material_of=reader(False), material_ahead=reader(True))


@kernel_factory
def total_stress_adj(spec: Spec, wanted: RequestedGrads, measure: str = "stress") -> SimpleNamespace:
    """Adjoint of the total stress: of τ (``stress``), or of P = τ F⁻ᵀ (``piola``); ``adj_tau`` is then P̄."""
    t = types(spec.dim, spec.dtype)
    real, vec, mat, Material = t.real, t.vec, t.mat, material(spec).Material
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    LawAdj, ActuatorAdj = law_adj_type(spec.dim, spec.dtype), actuator_adj_type(spec.dim, spec.dtype)
    laws = [law(name, spec.dim, spec.dtype) for name in spec.laws]
    actuators = [actuator(name, spec.dim, spec.dtype) for name in spec.actuators]
    slots, moduli, activation = spec.muscle_slots, "material" in wanted, "activation" in wanted
    direction = "direction" in wanted and "direction" in spec.given
    to_particle, to_slot = accumulate(spec.dtype).to_particle, accumulate(spec.dtype).to_slot

    def stress_adj_from(k: int) -> wp.Function:
        """Adjoint of the stress by the laws from number ``k`` on."""
        own, last = getattr(laws[k], f"{measure}_adj"), k + 1 == len(laws)
        others = None if last else stress_adj_from(k + 1)

        @wp.func
        def stress_adj_by(law: int, H: mat, Q: mat, mu: real, lam: real, adj_tau: mat) -> LawAdj:
            if wp.static(not last):
                if law != k:
                    return others(law, H, Q, mu, lam, adj_tau)
            return own(H, Q, mu, lam, adj_tau)

        return stress_adj_by

    def active_stress_adj_from(k: int) -> wp.Function:
        """Adjoint of the active stress by the kinds of actuators from number ``k`` on."""
        own, last = getattr(actuators[k], f"{measure}_adj"), k + 1 == len(actuators)
        others = None if last else active_stress_adj_from(k + 1)

        @wp.func
        def active_stress_adj_by(kind: int, H: mat, fibre: vec, p: real, adj_tau: mat) -> ActuatorAdj:
            if wp.static(not last):
                if kind != k:
                    return others(kind, H, fibre, p, adj_tau)
            return own(H, fibre, p, adj_tau)

        return active_stress_adj_by

    stress_adj_of = stress_adj_from(0)
    active_stress_adj_of = active_stress_adj_from(0) if slots else None

    @wp.func
    def stress_adj(
        own: Material, H: mat, Q: mat, adj_tau: mat, world: int, p: int, adj_inputs: ParticleInputsAdj
    ) -> mat:
        """∂L/∂F; adds what is wanted of the material and of the actuators of particle ``p`` into ``adj_inputs``."""
        adj = stress_adj_of(own.law, H, Q, own.mu, own.lam, adj_tau)
        adj_F = adj.F
        if wp.static(moduli):
            to_particle(adj_inputs.mu, world, p, adj.mu)
            to_particle(adj_inputs.lam, world, p, adj.lam)
        if wp.static(slots > 0):
            for slot in range(slots):
                if own.muscle[slot] >= 0:
                    adj_active = active_stress_adj_of(
                        own.kind[slot], H, own.fibre[slot], own.active_stress[slot], adj_tau
                    )
                    adj_F += adj_active.F
                    if wp.static(activation):
                        to_slot(adj_inputs.active_stress, world, p, slot, adj_active.active_stress)
                    if wp.static(direction):
                        adj_inputs.fibre[world, p, slot] = adj_inputs.fibre[world, p, slot] + adj_active.fibre
        return adj_F

    return SimpleNamespace(stress_adj=stress_adj)
