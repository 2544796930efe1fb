"""Running step limit of one particle in the reference formulation (Q8). Derivation: docs/math/lagrangian.md."""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.actuators import actuator
from softmpm.kernels.physics.alarms import alarm
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.laws import law
from softmpm.kernels.physics.stress import material
from softmpm.kernels.physics.tangent import moduli_type, tangent
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def rest_step(spec: Spec) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    k = kinematics(spec.dim, spec.dtype)
    material_of = material(spec).material_of
    real, mat, Constants, ParticleInputs = t.real, t.mat, t.Constants, input_types(spec).ParticleInputs
    slots, Moduli = spec.muscle_slots, moduli_type(spec.dtype)
    identity, volume_change = k.identity, k.volume_change
    stiffer, viscous_rate = tangent(spec.dim, spec.dtype).stiffer, alarm(spec).viscous_rate
    laws = [law(name, spec.dim, spec.dtype) for name in spec.laws]
    actuators = [actuator(name, spec.dim, spec.dtype) for name in spec.actuators]

    def moduli_from(k: int) -> wp.Function:
        """Moduli by the laws from number ``k`` on."""
        own, last = laws[k].moduli, k + 1 == len(laws)
        others = None if last else moduli_from(k + 1)

        @wp.func
        def moduli_by(law: int, j: real, trace: real, mu: real, lam: real) -> Moduli:
            if wp.static(not last):
                if law != k:
                    return others(law, j, trace, mu, lam)
            return own(j, trace, mu, lam)

        return moduli_by

    def active_moduli_from(k: int) -> wp.Function:
        """Moduli by the kinds of actuators from number ``k`` on."""
        own, last = actuators[k].moduli, k + 1 == len(actuators)
        others = None if last else active_moduli_from(k + 1)

        @wp.func
        def active_moduli_by(kind: int, p: real) -> Moduli:
            if wp.static(not last):
                if kind != k:
                    return others(kind, p)
            return own(p)

        return active_moduli_by

    moduli_of, active_moduli_of = moduli_from(0), active_moduli_from(0) if slots else None

    @wp.func
    def step_is_stable(constants: Constants, inputs: ParticleInputs, world: int, p: int, H: mat) -> bool:
        """K ≤ s² ρ₀ dx²/Δt². True if K is not a number, which another alarm reports."""
        F = identity() + H
        j = volume_change(H)
        own = material_of(inputs, world, p)
        m = moduli_of(own.law, j, wp.ddot(F, F), own.mu, own.lam)
        if wp.static(slots > 0):
            for slot in range(slots):
                if own.muscle[slot] >= 0:
                    active = active_moduli_of(own.kind[slot], own.active_stress[slot])
                    m.shear += active.shear
                    m.slope += active.slope
        reach = constants.spacing / constants.dt
        limit = constants.step * inputs.mass[world, p] / inputs.volume[world, p] * reach * reach
        return not stiffer(F, j, m, viscous_rate(constants, inputs, world, p), limit)

    return SimpleNamespace(step_is_stable=step_is_stable)
