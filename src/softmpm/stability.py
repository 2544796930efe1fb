"""The largest stable step, and the warning of a scene that is above it.

A particle alone on the grid obeys Ḟ = C, Ċ = −4τ/(ρ dx²) in MLS-MPM, wherever it lies between the nodes.
Symplectic Euler is stable for an oscillation ω while ω dt ≤ 2; ω² = 4K/(ρ dx²) for strains with τ(ε) = K ε:

    dt ≤ dx · √(ρ / K)                                  (S1)
    τ(ε) = λ tr(ε) I + 2μ ε + Σ |s| (ε ddᵀ + ddᵀ ε)     (S2)  both laws at F = I, muscles at |a| = 1

K is the largest eigenvalue of (S2); without muscles 2μ + dim·λ, or 2μ where λ < 0. Particles that share
nodes oscillate no faster than the fastest of them would alone: the grid's kinetic energy is at least
Σ m dx²/8 |C|², the particles' elastic energy at most Σ V K/2 |ε|². The limit holds at rest and shrinks with
stretch; half of it leaves room for a stretch of 1.7 (fixed corotated) or 2.5 (neo-Hookean).
"""

import math
import warnings
from typing import NamedTuple

import numpy as np

from softmpm.scene import Material, Muscle, Scene

APART = 1.4
"""Cells between particles beyond which they share too few nodes: at 4/3 a body that was stretched springs back, at 3/2 it does not."""


class StabilityWarning(UserWarning):
    """A scene's step is above the largest stable one, or its particles are so far apart that a body does not hold."""


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


def stable_dt(scene: Scene) -> StableDt:
    """Largest stable step of a scene at rest, its muscles fully active; use about half of it.

    The scene's own ``dt`` plays no part: ``dataclasses.replace(scene, dt=0.5 * stable_dt(scene))``.
    """
    limits = []
    for group in _groups(scene):
        material = scene.bodies[group.body].material
        muscles = [scene.muscles[m] for m in group.muscles]
        stiffness = _stiffness(material, muscles, scene.grid.dim)
        limits.append((scene.grid.spacing * math.sqrt(material.density / stiffness), stiffness, group))
    dt, stiffness, group = min(limits, key=lambda limit: limit[0])
    return StableDt(dt, _describe(scene, group, stiffness))


def warn_unstable(scene: Scene, *, stacklevel: int = 3) -> None:
    """Warn when the scene's dt is above :func:`stable_dt`; ``stacklevel`` 3 points at the caller's caller."""
    limit = stable_dt(scene)
    if scene.dt > limit:
        warnings.warn(
            f"dt = {scene.dt:.4g} s is above the largest stable one, {limit.dt:.4g} s, set by {limit.limit}. "
            f"Use a dt of about {0.5 * limit:.2g} s, which leaves room for stretch, or a coarser grid.",
            StabilityWarning,
            stacklevel=stacklevel,
        )


def warn_sparse(scene: Scene, *, stacklevel: int = 3) -> None:
    """Warn of bodies whose particles are too far apart to hold together."""
    for b, body in enumerate(scene.bodies):
        apart = float(np.mean(body.particles.volume)) ** (1 / scene.grid.dim)
        if len(body.particles) > 1 and apart > APART * scene.grid.spacing:
            warnings.warn(
                f"particles of body {b} are {apart / scene.grid.spacing:.3g} cells apart, by their volumes; beyond {APART} a body "
                f"does not hold together. Use a spacing of half a cell, {0.5 * scene.grid.spacing:.3g} m.",
                StabilityWarning,
                stacklevel=stacklevel,
            )


class _Group(NamedTuple):
    """Particles of one body that are in the same muscles."""

    particle: int  # the first of them
    body: int
    muscles: tuple[int, ...]


def _groups(scene: Scene) -> list[_Group]:
    keys: list[tuple[int, tuple[int, ...]]] = [(b, ()) for b in range(len(scene.bodies))]
    label = np.repeat(np.arange(len(scene.bodies)), [len(body.particles) for body in scene.bodies])
    for m, muscle in enumerate(scene.muscles):
        old, place = np.unique(label[muscle.particles], return_inverse=True)
        label[muscle.particles] = len(keys) + place
        keys += [(keys[k][0], (*keys[k][1], m)) for k in old]
    used, first = np.unique(label, return_index=True)
    return [_Group(int(particle), *keys[k]) for k, particle in zip(used, first, strict=True)]


def _stiffness(material: Material, muscles: list[Muscle], dim: int) -> float:
    """K of (S2): the largest eigenvalue of stress against strain, over symmetric strains."""
    mu = material.young / (2 * (1 + material.poisson))
    lam = material.young * material.poisson / ((1 + material.poisson) * (1 - 2 * material.poisson))
    pull = sum(
        (abs(muscle.strength) * np.outer(muscle.direction, muscle.direction) for muscle in muscles),
        np.zeros((dim, dim)),
    )
    strains = []
    for i, j in zip(*np.triu_indices(dim), strict=True):
        strain = np.zeros((dim, dim))
        strain[i, j] = strain[j, i] = 1.0 if i == j else math.sqrt(0.5)  # of length one
        strains.append(strain)
    stresses = [
        lam * np.trace(strain) * np.eye(dim) + 2 * mu * strain + strain @ pull + pull @ strain
        for strain in strains
    ]
    return float(np.linalg.eigvalsh([[np.vdot(e, t) for t in stresses] for e in strains])[-1])


def _describe(scene: Scene, group: _Group, stiffness: float) -> str:
    material = scene.bodies[group.body].material
    text = (
        f"body {group.body} ({type(material).__name__}, young {material.young:.4g} Pa, "
        f"poisson {material.poisson:.4g}, density {material.density:.4g} kg/m³)"
    )
    if group.muscles:
        names = " + ".join(f"muscle {m} ({scene.muscles[m].strength:.4g} Pa)" for m in group.muscles)
        text += f" under {names} at full activation, as at particle {group.particle}"
    return f"{text}: stiffness {stiffness:.4g} Pa on cells of {scene.grid.spacing:.4g} m"
