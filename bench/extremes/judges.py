"""Judges of a returned state, independent of the library: NumPy in float64, written from the definitions.

Energies follow from the laws' densities, with J = det F, the principal stretches s of F and the Lamé parameters μ and λ:

    neo-Hookean            μ/2 (Σ s² − dim) − μ log J + λ/2 log²J
    fixed corotated        μ Σ (s − 1)² + λ/2 (J − 1)²
    barrier corotated      μ Σ (s − 1)² + λ/8 (J − 1/J)²
    stable neo-Hookean     2/3 μ (I − 3 − log((I + 1)/4)) + ℓ/2 ((J − α)² − (1 − α)²),  I = Σ s² over three stretches,
                           ℓ = λ + 5/6 μ,  α = 1 + μ/ℓ
    muscle, active stress p  p/2 |F d|²
    pressure p             −p (J − 1)

A particle carries the affine velocity C as well, so its kinetic energy is m/2 (|v|² + D |C|²) with D = dx²/4, and its angular
momentum has the part m D (C − Cᵀ). Velocities of a state are half a substep older than its positions; the energies are taken
where the velocities are, which removes the first-order error of symplectic Euler.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

import softmpm

NEIGHBOUR = 1.2
"""Rest spacings within which two particles of a body are neighbours: faces of the lattice, no diagonals."""


class Exact(NamedTuple):
    """One world of a state in float64, with the low-order parts of float32 added."""

    x: np.ndarray
    v: np.ndarray
    C: np.ndarray
    F: np.ndarray


def exact(state: softmpm.State, world: int = 0) -> Exact:
    arrays = {name: getattr(state, name)[world].detach().cpu().double().numpy() for name in "xvCF"}
    if state.low is not None:
        for name in "xF":
            arrays[name] = arrays[name] + getattr(state.low, name)[world].cpu().double().numpy()
    return Exact(**arrays)


def neo_hookean(s: np.ndarray, J: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    log = np.log(np.where(J > 0, J, np.nan))
    return mu * ((s**2 - 1).sum(-1) / 2 - log) + lam / 2 * log**2


def fixed_corotated(s: np.ndarray, J: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    return mu * ((s - 1) ** 2).sum(-1) + lam / 2 * (J - 1) ** 2


def barrier_corotated(s: np.ndarray, J: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    return mu * ((s - 1) ** 2).sum(-1) + lam / 8 * (J - 1 / np.where(J != 0, J, np.nan)) ** 2


def stable_neo_hookean(s: np.ndarray, J: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    square = (s**2 - 1).sum(-1)  # I - 3: in plane strain the third stretch is 1
    volumetric = lam + 5 / 6 * mu
    volume = volumetric / 2 * (J - 1) ** 2 - mu * (J - 1)
    return 2 / 3 * mu * (square - np.log1p(square / 4)) + volume


DENSITIES = {
    "NeoHookean": neo_hookean,
    "FixedCorotated": fixed_corotated,
    "BarrierCorotated": barrier_corotated,
    "StableNeoHookean": stable_neo_hookean,
}
"""Energy per unit of rest volume [J/m³], by the name of the law."""


def stretches(F: np.ndarray) -> np.ndarray:
    """Principal stretches, shape (particle, dim); the smallest one carries the sign of det F."""
    s = np.linalg.svd(F, compute_uv=False)
    s[:, -1] *= np.where(np.linalg.det(F) < 0, -1.0, 1.0)
    return s


@dataclass(frozen=True)
class Energy:
    """Energies of a body [J]; ``mechanical`` excludes the energy of the actuators, whose decrease is their work."""

    kinetic: float
    elastic: float
    gravity: float
    actuators: float

    @property
    def mechanical(self) -> float:
        return self.kinetic + self.elastic + self.gravity

    @property
    def total(self) -> float:
        return self.mechanical + self.actuators


class Matter:
    """Constants of a scene's particles, and the quantities that the judges compute of a state."""

    def __init__(self, scene: softmpm.Scene, activation: float = 0.0, young_factor: float = 1.0):
        self.scene, self.dim, self.dx = scene, scene.grid.dim, scene.grid.spacing
        bodies = scene.bodies
        sizes = [len(body.particles) for body in bodies]
        self.rest = np.concatenate([body.particles.positions for body in bodies])
        self.volume = np.concatenate([body.particles.volume for body in bodies])
        young, poisson, density = (
            np.repeat([getattr(body.material, name) for body in bodies], sizes)
            for name in ("young", "poisson", "density")
        )
        young = young * young_factor
        self.mass = density * self.volume
        self.mu = young / (2 * (1 + poisson))
        self.lam = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
        self.laws = np.repeat([type(body.material).__name__ for body in bodies], sizes)
        self.active_stresses = [(actuator, activation * actuator.strength) for actuator in scene.muscles]
        self.floor = min((wall.offset for wall in scene.walls), default=0.0)
        self.pairs = self._neighbours(np.cumsum([0, *sizes]))

    def _neighbours(self, first: np.ndarray) -> np.ndarray:
        """Pairs of neighbours at rest within each body; different bodies may separate."""
        reach = NEIGHBOUR * self.volume ** (1 / self.dim)
        found = [
            a + cKDTree(self.rest[a:b]).query_pairs(reach[a], output_type="ndarray")
            for a, b in pairwise(first)
        ]
        return np.concatenate(found)

    def energy(self, state: Exact) -> Energy:
        """Energies, with positions and F evaluated half a substep earlier, at the time of v and C."""
        half = 0.5 * self.scene.dt
        x = state.x - half * state.v
        F = state.F - half * state.C @ state.F
        s, J = stretches(F), np.linalg.det(F)
        density = np.zeros(len(s))
        for law in set(self.laws.tolist()):
            own = self.laws == law
            density[own] = DENSITIES[law](s[own], J[own], self.mu[own], self.lam[own])
        squares = (state.v**2).sum(-1) + self.dx**2 / 4 * (state.C**2).sum((-1, -2))
        height = (x - self.floor * np.eye(self.dim)[1]) @ np.array(self.scene.gravity)
        return Energy(
            kinetic=float((self.mass * squares).sum() / 2),
            elastic=float((self.volume * density).sum()),
            gravity=float(-(self.mass * height).sum()),
            actuators=self._energy_of_actuators(F, J),
        )

    def _energy_of_actuators(self, F: np.ndarray, J: np.ndarray) -> float:
        energy = 0.0
        for actuator, p in self.active_stresses:
            i = actuator.particles
            if isinstance(actuator, softmpm.Muscle):
                density = p / 2 * ((F[i] @ np.array(actuator.direction)) ** 2).sum(-1)
            else:
                density = -p * (J[i] - 1)
            energy += float((self.volume[i] * density).sum())
        return energy

    def center(self, state: Exact) -> np.ndarray:
        return self.mass @ state.x / self.mass.sum()

    def momentum(self, state: Exact) -> np.ndarray:
        return self.mass @ state.v

    def angular_momentum(self, state: Exact) -> np.ndarray:
        """About the centre of mass [kg m²/s], as a skew matrix (dim, dim)."""
        arm = state.x - self.center(state)
        moment = np.einsum("p,pi,pj->ij", self.mass, state.v, arm)
        moment += self.dx**2 / 4 * np.einsum("p,pij->ij", self.mass, state.C)
        return moment - moment.T

    def gap(self, state: Exact) -> float:
        """Largest distance of rest neighbours [cells]; 0 without neighbours."""
        if len(self.pairs) == 0:
            return 0.0
        i, j = self.pairs.T
        return float(np.linalg.norm(state.x[i] - state.x[j], axis=1).max() / self.dx)


def least_det(state: Exact) -> float:
    return float(np.linalg.det(state.F).min())
