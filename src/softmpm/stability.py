"""The largest stable step: of a scene at rest, of a stretched one, of one particle in a run.

A particle alone on the grid obeys Ḟ = C F, Ċ = −4τ/(ρ dx²) in MLS-MPM, wherever it lies between the nodes.
Symplectic Euler is stable for an oscillation ω while ω dt ≤ 2; ω² = 4K/(ρ dx²) for the stiffness K of (W3):

    dt ≤ dx · √(ρ / K)                                                                              (W2)
    K = largest eigenvalue of A,  A[G] = d/dε τ((I + εG) F) over symmetric G, muscles included       (W3)

A viscosity adds damping V[G] = 2η B G B, B = FFᵀ, and takes the step below that. With the damping force of the beginning of the step,

    dt² A + 2 dt V ≤ ρ dx², so (W2) with the largest eigenvalue K of A + (2/dt) V                    (W4)

At rest and without muscles K = 2μ + dim·λ, or 2μ where λ < 0. Particles that share nodes oscillate no faster than the fastest of
them would alone: the grid's kinetic energy is at least Σ m dx²/8 |C|², the particles' elastic energy at most Σ V K/2 |G|². The limit
shrinks with stretch; half of that at rest leaves room for a stretch of 1.7 (fixed corotated) or 2.5 (neo-Hookean).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from softmpm.checks import demand
from softmpm.inputs import QUANTITIES
from softmpm.oracle.stress import actuator_tangent, lame, law_of, tangent, viscous_tangent
from softmpm.scene.actuators import title
from softmpm.scene.check_scene import check_scene
from softmpm.scene.materials import Material
from softmpm.scene.scene import Scene
from softmpm.state import Params
from softmpm.validate import need


class StableDt(float):
    """Largest stable step [s]; ``limit`` says in words what sets it."""

    limit: str

    def __new__(cls, dt: float, limit: str = ""):
        self = super().__new__(cls, dt)
        self.limit = limit
        return self

    @property
    def dt(self) -> float:
        """The step as a plain number [s]."""
        return float(self)


def stable_dt(
    scene: Scene,
    params: Params | None = None,
    stretch: float | Tensor | np.ndarray = 1.0,
    activation: float = 1.0,
) -> StableDt:
    """Largest stable step of a scene. At rest with its muscles fully active, unless told otherwise; use about half of that.

    The scene's own ``dt`` plays no part: ``dataclasses.replace(scene, dt=0.5 * stable_dt(scene))``.

    Args:
        scene: What to simulate.
        params: Material of each particle, shapes that broadcast to (world, particle); None takes the scene's.
        stretch: Principal stretch along one axis [-], that of the muscles where there are any, the others being 1. Or the
            deformation gradient of all particles, shape (dim, dim), or of each, shape (particle, dim, dim).
        activation: Largest size of the activation [-], of either sign.

    Raises:
        ValueError: The scene breaks a rule, a stretch is not positive or a deformation not finite or inverted beyond the law, or a
            material is outside its bounds.
    """
    check_scene(scene)
    need(math.isfinite(activation), f"activation must be finite, got {activation}.")
    with torch.inference_mode(False), torch.device("cpu"):
        given = None if params is None else _rows(params, scene.particle_count)
        limits = [
            (*_limit(scene, group, given, F, activation), group)
            for group in _groups(scene)
            for F in _deformations(scene, group, stretch)
        ]
    dt, stiffness, particle, group = min(limits, key=lambda limit: limit[0])
    return StableDt(dt, _describe(scene, group, particle, stiffness, params, (stretch, activation)))


def running_limit(
    scene: Scene,
    particle: int,
    mu: float,
    lam: float,
    density: float,
    F: Tensor,
    active_stress: list[float],
    viscosity: float = 0.0,
    directions: Tensor | None = None,
) -> float:
    """Stable step [s] of one particle alone on the grid, as it is at a moment of a run (W2), (W4).

    Args:
        F: Its deformation gradient, shape (dim, dim).
        active_stress: Activation times strength of each muscle and pressure of the scene [Pa].
        viscosity: Its viscosity η [Pa s].
        directions: Unit fibre direction of each muscle and pressure, shape (muscle, dim); None takes the scene's.
    """
    with torch.inference_mode(False), torch.device("cpu"):
        F = F.detach().cpu().double()
        fibres = [None] * len(scene.muscles) if directions is None else directions.detach().cpu().double()
        material = scene.bodies[scene.body_index[particle]].material
        A = tangent(material, F, *(torch.tensor(v, dtype=torch.float64) for v in (mu, lam)))
        for muscle, stress, fibre in zip(scene.muscles, active_stress, fibres, strict=True):
            if particle in muscle.particles:
                A = A + stress * actuator_tangent(muscle, F, fibre)
        inertia = torch.tensor(density * scene.grid.spacing**2, dtype=torch.float64)
        K = _stiffness(A, viscosity * viscous_tangent(F), inertia).item()
    return math.inf if K <= 0 else scene.grid.spacing * math.sqrt(density / K)  # NaN stays NaN


def stiffening_signs(scene: Scene) -> list[float]:
    """For each actuator of the scene, the sign of the active stress that stiffens: 1 for a muscle, -1 for a pressure (suction)."""
    with torch.inference_mode(False), torch.device("cpu"):
        at_rest = torch.eye(scene.grid.dim, dtype=torch.float64)
        return [_stiffening_sign(actuator_tangent(actuator, at_rest)).item() for actuator in scene.muscles]


def need_stable(scene: Scene, most: float) -> None:
    """Raise ValueError if the scene's dt is more than ``most`` times :func:`stable_dt`."""
    limit = stable_dt(scene)
    need(
        scene.dt <= most * limit,
        f"dt = {scene.dt:.4g} s is {scene.dt / limit:.7g} times the largest stable one, {limit.dt:.4g} s, set by {limit.limit}; "
        f"that ratio must stay within {most:.7g}. Use a dt of about {0.5 * most * limit:.2g} s, which leaves room for stretch, "
        "or a coarser grid; build(..., alarms=softmpm.Alarms(step=None)) runs it all the same.",
    )


class _Group(NamedTuple):
    """Particles of one body that are in the same muscles."""

    particles: np.ndarray
    body: int
    muscles: tuple[int, ...]


def _groups(scene: Scene) -> list[_Group]:
    keys: list[tuple[int, tuple[int, ...]]] = [(b, ()) for b in range(len(scene.bodies))]
    label = scene.body_index
    for m, muscle in enumerate(scene.muscles):
        old, place = np.unique(label[muscle.particles], return_inverse=True)
        label[muscle.particles] = len(keys) + place
        keys += [(keys[k][0], (*keys[k][1], m)) for k in old]
    return [_Group(np.flatnonzero(label == k), *keys[k]) for k in np.unique(label)]


def _rows(params: Params, particles: int) -> Params:
    """Material as float64 on the CPU, shape (world, particle) each."""
    rows = []
    for name, value in zip(Params._fields, params, strict=True):
        value = torch.atleast_2d(torch.as_tensor(value, dtype=torch.float64).detach().cpu())
        need(
            value.ndim == 2 and value.shape[1] in (1, particles),
            f"params.{name} must broadcast to (world, {particles}), got shape {tuple(value.shape)}.",
        )
        known = QUANTITIES[name]
        demand(f"params.{name}", value, (value > known.low) & (value < known.high), known.rule)
        rows.append(value)
    worlds = max(len(value) for value in rows)
    return Params(*(value.expand(worlds, particles) for value in rows))


def _deformations(scene: Scene, group: _Group, stretch: float | Tensor | np.ndarray) -> list[Tensor]:
    """Deformation gradients to look at, shape (dim, dim) or (particle of the group, dim, dim)."""
    dim, given = scene.grid.dim, torch.as_tensor(stretch, dtype=torch.float64).detach().cpu()
    if given.ndim == 0:
        need(bool(0 < given < math.inf), f"stretch must be finite and > 0, got {stretch}.")
        muscles = [scene.muscles[m] for m in group.muscles]
        axes = [getattr(muscle, "direction") for muscle in muscles if hasattr(muscle, "direction")]  # noqa: B009
        axes = axes or [(1.0,) + (0.0,) * (dim - 1)]
        columns = (torch.tensor(axis, dtype=torch.float64)[:, None] for axis in axes)
        return [torch.eye(dim, dtype=torch.float64) + (given - 1) * column @ column.T for column in columns]
    total, material = scene.particle_count, scene.bodies[group.body].material
    need(
        given.shape in ((dim, dim), (total, dim, dim)),
        f"stretch must be one number or have shape ({dim}, {dim}) or ({total}, {dim}, {dim}), got {tuple(given.shape)}.",
    )
    odd = given[~given.isfinite()]
    need(not len(odd), f"stretch must be finite, got {odd[:1].tolist()}.")
    F = given[None] if given.ndim == 2 else given[torch.from_numpy(group.particles)]
    least = torch.linalg.det(F).min()
    need(
        material.survives_inversion or bool(least > 0),
        f"stretch must have a positive determinant for {type(material).__name__}, which has no stress beyond, got {least:.4g}.",
    )
    return [F]


def _limit(
    scene: Scene, group: _Group, given: Params | None, F: Tensor, activation: float
) -> tuple[float, float, int]:
    """Stable step [s] of a group of particles, the stiffness [Pa] that sets it, and the particle."""
    material = scene.bodies[group.body].material
    A_mu, A_lam = _unit_tangents(material, F)
    A_active, active = torch.zeros_like(A_mu), [0.0]
    for m in group.muscles:
        A_unit = actuator_tangent(scene.muscles[m], F)
        active.append(abs(activation * scene.muscles[m].strength))
        A_active = A_active + active[-1] * _stiffening_sign(A_unit)[..., None, None] * A_unit
    if given is None:
        rows = Params(
            *(torch.tensor([[getattr(material, name)]], dtype=torch.float64) for name in Params._fields)
        )
    else:
        rows = Params(*(value[:, torch.from_numpy(group.particles)] for value in given))
    mu, lam = (value[..., None, None] for value in lame(rows.young, rows.poisson))
    A, V = mu * A_mu + lam * A_lam + A_active, material.viscosity * viscous_tangent(F)
    K = _stiffness(A, V, rows.density * scene.grid.spacing**2)  # (world, particle)
    K, density = torch.broadcast_tensors(K, rows.density)
    squared = torch.where(K <= 0, math.inf, density / K)
    need(
        bool((squared > 0).all()),
        f"the stiffness of body {group.body}, or that by its density, is beyond what a number holds; use a smaller young's modulus, "
        f"strength of its muscles, activation or viscosity, or other units, got young {rows.young.max():.4g} Pa, viscosity "
        f"{material.viscosity:.4g} Pa s, an active stress of up to {max(active):.4g} Pa, density {rows.density.min():.4g} kg/m³ "
        f"and cells of {scene.grid.spacing:.4g} m.",
    )
    world, particle = divmod(int(squared.argmin()), squared.shape[1])
    dt = scene.grid.spacing * math.sqrt(squared[world, particle].item())
    return dt, K[world, particle].item(), int(group.particles[particle])


def _unit_tangents(material: Material, F: Tensor) -> tuple[Tensor, Tensor]:
    """Stiffness of the law with μ = 1 Pa, λ = 0 and with μ = 0, λ = 1 Pa; that at rest is computed once for each law."""
    law, dim = law_of(material), F.shape[-1]
    at_rest = F.ndim == 2 and torch.equal(F, torch.eye(dim, dtype=torch.float64))
    known = _at_rest if at_rest else {}
    if (law, dim) not in known:
        one = torch.ones(F.shape[:-2], dtype=torch.float64)
        known[law, dim] = tangent(material, F, one, 0 * one), tangent(material, F, 0 * one, one)
    return known[law, dim]


_at_rest: dict[tuple[Callable, int], tuple[Tensor, Tensor]] = {}
"""Results of :func:`_unit_tangents` at rest: a scene has a group of particles for each muscle, and a program builds many models."""


def _stiffening_sign(A_unit: Tensor) -> Tensor:
    """Sign of the active stress that stiffens, by the tangent of unit active stress; shape (..., k, k) to (...)."""
    return A_unit.diagonal(dim1=-2, dim2=-1).sum(-1).sign()


def _stiffness(A: Tensor, V: Tensor, inertia: Tensor) -> Tensor:
    """Largest eigenvalue K [Pa] of A + (2/dt) V where dt is the largest stable step √(ρ dx²/K) itself (W4).

    The rate 1/dt is the largest fixed point of a function that does not decrease. From a rate above it, with the largest eigenvalues
    of A and V apart, the iteration comes down to it, and halves the distance at least where A has no negative eigenvalue.

    Args:
        A, V: Stiffness [Pa] and damping [Pa s], shapes (..., k, k) that broadcast.
        inertia: ρ dx² [Pa s²], shape that broadcasts to (...).

    Returns:
        K, NaN where it is beyond what a number holds.
    """
    K, damping = _largest(A), _largest(V)
    if not bool((damping > 0).any()):
        return K + damping  # 0, or NaN
    rate = (damping + torch.hypot(damping, (K.clamp(min=0) * inertia).sqrt())) / inertia
    for _ in range(200):
        K = _largest(A + 2 * rate[..., None, None] * V)
        last, rate = rate, (K.clamp(min=0) / inertia).sqrt()
        if not bool((last - rate > 1e-14 * last).any()):
            break
    return K


def _largest(matrix: Tensor) -> Tensor:
    """Largest eigenvalue of symmetric matrices, NaN where one is not finite; shape (..., k, k) to (...)."""
    finite = torch.isfinite(matrix).all(-1).all(-1)
    return torch.linalg.eigvalsh(matrix.where(finite[..., None, None], 0.0))[..., -1].where(finite, math.nan)


def _describe(
    scene: Scene, group: _Group, particle: int, stiffness: float, params: Params | None, loads: tuple
) -> str:
    material = scene.bodies[group.body].material
    text = f"body {group.body} ({type(material).__name__}"
    if params is None:
        text += f", young {material.young:.4g} Pa, poisson {material.poisson:.4g}, density {material.density:.4g} kg/m³"
    else:
        text += f", the given params of particle {particle}"
    if material.viscosity > 0:
        text += f", viscosity {material.viscosity:.4g} Pa s"
    text += ")"
    stretch, activation = loads
    if group.muscles:
        muscles = [(title(scene.muscles[m], m), scene.muscles[m].strength) for m in group.muscles]
        names = " + ".join(f"{name} ({strength:.4g} Pa)" for name, strength in muscles)
        how = "full activation" if activation == 1.0 else f"activation {activation:.4g}"
        text += f" under {names} at {how}, as at particle {particle}"
    if np.ndim(stretch) > 0:
        text += ", deformed as given"
    elif stretch != 1.0:
        text += f", stretched to {stretch:.4g}"
    kind = "stiffness and damping equivalent to" if material.viscosity > 0 else "stiffness"
    return f"{text}: {kind} {stiffness:.4g} Pa on cells of {scene.grid.spacing:.4g} m"
