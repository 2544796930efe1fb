"""Total stress of one particle: its law plus its actuators, as the scene has them."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.actuators import actuator, actuator_adj_type
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.laws import law, law_adj_type
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def total_stress(spec: Spec) -> SimpleNamespace:
    t, k = types(spec.dim, spec.dtype), kinematics(spec.dim, spec.dtype)
    real, vec, mat, ParticleInputs = t.real, t.vec, t.mat, input_types(spec).ParticleInputs
    laws = [law(name, spec.dim, spec.dtype) for name in spec.laws]
    actuators = [actuator(name, spec.dim, spec.dtype) for name in spec.actuators]
    choose, slots, dim = choices(spec), spec.muscle_slots, spec.dim
    law_of, actuator_of, fibre_of = choose.law_of, choose.actuator_of, choose.fibre_of
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
    def rotation(inputs: ParticleInputs, world: int, p: int, H: mat) -> mat:
        """Q of F, if the law of this particle asks for it."""
        return rotation_of(law_of(inputs, world, p), H)

    @wp.func
    def stress(inputs: ParticleInputs, world: int, p: int, H: mat, Q: mat) -> mat:
        """Kirchhoff stress τ [Pa]."""
        tau = stress_of(law_of(inputs, world, p), H, Q, inputs.mu[world, p], inputs.lam[world, p])
        if wp.static(slots > 0):
            for slot in range(slots):
                k = inputs.muscle[world, p, slot]
                if k >= 0:
                    tau += active_stress_of(
                        actuator_of(inputs, k), H, fibre_of(inputs, world, k), inputs.active_stress[world, k]
                    )
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
    def stiffness_bound(inputs: ParticleInputs, world: int, p: int, H: mat) -> real:
        """At least the stiffness K of (W3) [Pa], at a small part of its price; K itself at rest (E4)."""
        F = identity() + H
        B = F * wp.transpose(F)
        j = volume_change(H)
        law = law_of(inputs, world, p)
        mu = inputs.mu[world, p]
        K = bound_of(law, largest_square(B), j, wp.trace(B), mu, inputs.lam[world, p])
        if wp.static(slots > 0):
            for slot in range(slots):
                k = inputs.muscle[world, p, slot]
                if k >= 0:
                    K += active_bound_of(
                        actuator_of(inputs, k),
                        F,
                        j,
                        fibre_of(inputs, world, k),
                        inputs.active_stress[world, k],
                    )
        return K

    return SimpleNamespace(
        rotation=rotation, stress=stress, stiffness_bound=stiffness_bound, largest_square=largest_square
    )


@kernel_factory
def choices(spec: Spec) -> SimpleNamespace:
    """Functions for the law of a particle and the kind and fibre direction of an actuator; a single law or kind needs no index."""
    vec, ParticleInputs = types(spec.dim, spec.dtype).vec, input_types(spec).ParticleInputs
    several_laws, several_kinds = len(spec.laws) > 1, len(spec.actuators) > 1
    fibres, each_world = spec.fibres, "direction" in spec.given

    @wp.func
    def law_of(inputs: ParticleInputs, world: int, p: int) -> int:
        """Index into ``spec.laws``."""
        if wp.static(several_laws):
            return inputs.law[world, p]
        else:
            return 0

    @wp.func
    def actuator_of(inputs: ParticleInputs, k: int) -> int:
        """Index into ``spec.actuators``."""
        if wp.static(several_kinds):
            return inputs.actuator[k]
        else:
            return 0

    @wp.func
    def fibre_of(inputs: ParticleInputs, world: int, k: int) -> vec:
        if wp.static(fibres and each_world):
            return inputs.fibre[world, k]
        elif wp.static(fibres):
            return inputs.fibre[k]
        else:
            return vec()

    return SimpleNamespace(law_of=law_of, actuator_of=actuator_of, fibre_of=fibre_of)


@kernel_factory
def total_stress_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, vec, mat, ParticleInputs = t.real, t.vec, t.mat, input_types(spec).ParticleInputs
    ParticleInputsAdj = input_adj_types(spec, wanted).ParticleInputsAdj
    LawAdj, ActuatorAdj = law_adj_type(spec.dim, spec.dtype), actuator_adj_type(spec.dim, spec.dtype)
    laws = [law(name, spec.dim, spec.dtype) for name in spec.laws]
    actuators = [actuator(name, spec.dim, spec.dtype) for name in spec.actuators]
    choose, slots = choices(spec), spec.muscle_slots
    law_of, actuator_of, fibre_of = choose.law_of, choose.actuator_of, choose.fibre_of
    material, activation = "material" in wanted, "activation" in wanted
    direction = "direction" in wanted and "direction" in spec.given

    def stress_adj_from(k: int) -> wp.Function:
        """Adjoint of τ by the laws from number ``k`` on."""
        own, last = laws[k].stress_adj, k + 1 == len(laws)
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
        own, last = actuators[k].stress_adj, k + 1 == len(actuators)
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
        inputs: ParticleInputs,
        world: int,
        p: int,
        H: mat,
        Q: mat,
        adj_tau: mat,
        adj_inputs: ParticleInputsAdj,
    ) -> mat:
        """∂L/∂F; adds what is wanted of the material and of the actuators into ``adj_inputs``."""
        law = law_of(inputs, world, p)
        adj = stress_adj_of(law, H, Q, inputs.mu[world, p], inputs.lam[world, p], adj_tau)
        adj_F = adj.F
        if wp.static(material):
            adj_inputs.mu[world, p] = adj_inputs.mu[world, p] + adj.mu
            adj_inputs.lam[world, p] = adj_inputs.lam[world, p] + adj.lam
        if wp.static(slots > 0):
            for slot in range(slots):
                k = inputs.muscle[world, p, slot]
                if k >= 0:
                    adj_active = active_stress_adj_of(
                        actuator_of(inputs, k),
                        H,
                        fibre_of(inputs, world, k),
                        inputs.active_stress[world, k],
                        adj_tau,
                    )
                    adj_F += adj_active.F
                    if wp.static(activation):
                        adj_inputs.active_stress[world, p, slot] = (
                            adj_inputs.active_stress[world, p, slot] + adj_active.active_stress
                        )
                    if wp.static(direction):
                        adj_inputs.fibre[world, p, slot] = adj_inputs.fibre[world, p, slot] + adj_active.fibre
        return adj_F

    return SimpleNamespace(stress_adj=stress_adj)
