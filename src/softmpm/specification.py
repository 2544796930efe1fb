"""Features for which the kernels of a scene are specialised, and the constants of their launches."""

import math
import pkgutil
import re
from pathlib import Path

import numpy as np

from softmpm.alarms import Alarms
from softmpm.inputs import QUANTITIES
from softmpm.kernels import physics
from softmpm.kernels.structs import Spec, types
from softmpm.scene.scene import MIRRORS, Scene

LAWS, ACTUATORS = "laws", "actuators"


def kernel_of(part: object, package: str) -> str:
    """Name of the file of kernels/physics that has the kernels of a material or an actuator: that of its class."""
    name = re.sub(r"(?<!^)(?=[A-Z])", "_", type(part).__name__).lower()
    known = [found.name for found in pkgutil.iter_modules([str(Path(physics.__file__).parent / package)])]
    if name not in known:
        raise TypeError(
            f"{type(part).__name__} has no kernels: kernels/physics/{package} has {', '.join(known)}, and no {name}."
        )
    return name


def specification(
    scene: Scene,
    dtype: str,
    slots: int,
    given: tuple[str, ...],
    fixed_point: bool,
    slabs: bool,
    surface: bool,
    formulation: str,
) -> Spec:
    """Features of a scene and of a call that kernels are compiled for.

    Args:
        slots: Actuators that overlap on one particle, at most.
        given: Inputs that calls may give.
        fixed_point: Whether sums are in fixed point.
        slabs: Whether sums over particles are taken by slabs of nodes.
        surface: Whether separating walls act on surface points.
    """

    def has(name: str) -> bool:
        """True if the scene has a quantity other than zero, or calls give it."""
        default = QUANTITIES[name].default
        return name in given or (default is not None and bool(np.any(default(scene))))

    return Spec(
        dim=scene.grid.dim,
        dtype=dtype,
        laws=tuple(sorted({kernel_of(body.material, LAWS) for body in scene.bodies})),
        muscle_slots=slots,
        contacts=tuple(wall.contact for wall in scene.walls),
        friction=has("friction"),
        gravity=has("gravity"),
        damping=has("damping"),
        actuators=tuple(sorted({kernel_of(muscle, ACTUATORS) for muscle in scene.muscles})),
        fibres=any(hasattr(muscle, "direction") for muscle in scene.muscles),
        viscosity=has("viscosity"),
        driven=len(scene.driven) > 0 and formulation == "moving",
        driven_nodes=len(scene.driven) > 0 and formulation == "reference",
        given=given,
        deterministic=fixed_point,
        slabs=slabs,
        surface=surface,
        mirrors=tuple(k for k, wall in enumerate(scene.walls) if wall.contact in MIRRORS),
    )


def muscle_slots(scene: Scene, particle_count: int) -> np.ndarray:
    """Muscles of each particle, shape (particle, most that overlap on one), filled up with -1."""
    members = np.zeros(particle_count, dtype=np.int64)
    for muscle in scene.muscles:
        members[muscle.particles] += 1
    slots = np.full((particle_count, int(members.max(initial=0))), -1, dtype=np.int32)
    members[:] = 0
    for k, muscle in enumerate(scene.muscles):
        slots[muscle.particles, members[muscle.particles]] = k
        members[muscle.particles] += 1
    return slots


def constants_of(scene: Scene, spec: Spec, alarms: Alarms):
    """The struct that every launch takes: grid, Δt, gravity, damping, and limits of the alarms."""
    t = types(spec.dim, spec.dtype)
    constants = t.Constants()
    constants.shape = t.ivec(*scene.grid.shape)
    constants.dt = scene.dt
    constants.spacing = constants.exact_spacing = scene.grid.spacing
    constants.rate, constants.width = _inverse_pair(scene.grid.spacing, spec.dtype)
    constants.gravity = t.vec(*(scene.gravity or ()))
    constants.decay = math.exp(-scene.damping * scene.dt)
    survives = all(body.material.survives_inversion for body in scene.bodies)
    least = -math.inf if survives else 0.0
    constants.collapse = (least if alarms.collapse is None else alarms.collapse) - 1.0
    constants.gap = math.inf if alarms.gap is None else alarms.gap**2
    constants.step = math.inf if alarms.step is None else alarms.step**2
    return constants


def _inverse_pair(spacing: float, dtype: str) -> tuple[float, float]:
    """4/dx and dx as numbers of a precision whose product is 4 as nearly as a few units in their last place allow.

    C goes through both in every substep: rounded one by one they let a free body spin up or down by 1e-4 in 10,000 substeps of float32.
    """
    real = np.float32 if dtype == "float32" else np.float64
    rate = real(4.0 / spacing)
    rates = [rate + k * np.spacing(rate) for k in sorted(range(-16, 17), key=abs)]
    pairs = [(float(r), float(real(4.0 / float(r)))) for r in rates]
    return min(pairs, key=lambda pair: abs(pair[0] * pair[1] - 4.0))
