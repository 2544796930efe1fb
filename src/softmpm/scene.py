"""What a person designs: a grid, bodies with a material, muscles and walls. Plain SI numbers, checked when written down.

A scene holds no tensors and knows no device; :func:`softmpm.build` turns it into a :class:`softmpm.Model`.
Rules that need the whole scene (particles inside the grid, muscle indices) live in ``checks.py``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Contact = Literal["stick", "slip", "separate"]
CONTACTS: tuple[Contact, ...] = ("stick", "slip", "separate")


def _need(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _finite(*numbers: float) -> bool:
    return all(math.isfinite(number) for number in numbers)


@dataclass(frozen=True, kw_only=True, slots=True)
class Grid:
    """Background grid of nodes; node (i, j, k) sits at (i, j, k) · spacing."""

    shape: tuple[int, ...]
    """Nodes along each axis; two axes make a plane-strain scene, three a solid one."""
    spacing: float
    """Distance of neighbouring nodes, dx [m]."""

    def __post_init__(self):
        _need(len(self.shape) in (2, 3), f"grid.shape must have 2 or 3 axes, got {self.shape}.")
        _need(
            all(int(n) == n and n >= 4 for n in self.shape),
            f"grid.shape needs whole numbers of at least 4 nodes along each axis, got {self.shape}.",
        )
        _need(_finite(self.spacing) and self.spacing > 0, f"grid.spacing must be > 0 m, got {self.spacing}.")

    @property
    def dim(self) -> int:
        return len(self.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """Material points of a shape at rest."""

    positions: np.ndarray
    """Rest positions X [m], shape (particle, dim)."""
    volume: np.ndarray | float
    """Rest volume of each particle V⁰ [m³], in 2D [m²] of unit depth; one number or shape (particle,)."""

    def __post_init__(self):
        positions = np.array(self.positions, dtype=np.float64, ndmin=2)
        _need(
            positions.ndim == 2 and positions.shape[1] in (2, 3),
            f"positions must have shape (particle, 2) or (particle, 3), got {positions.shape}.",
        )
        _need(len(positions) > 0, "a shape has no particles: make it larger or its spacing smaller.")
        volume = np.asarray(self.volume, dtype=np.float64)
        _need(
            volume.shape in ((), (len(positions),)),
            f"volume must be one number or have shape ({len(positions)},), got {volume.shape}.",
        )
        for name, array in (("positions", positions), ("volume", volume)):
            bad = np.argwhere(~np.isfinite(np.atleast_1d(array)))
            _need(bad.size == 0, f"{name} must be finite; particle {bad[0][0] if bad.size else ''} is not.")
        _need(bool((volume > 0).all()), f"volume must be > 0, got {volume.min()}.")
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "volume", np.broadcast_to(volume, (len(positions),)).copy())

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True, kw_only=True, slots=True)
class Material:
    """Isotropic elastic solid. Use one of its laws: :class:`NeoHookean` or :class:`FixedCorotated`."""

    density: float
    """Rest density ρ₀ [kg/m³]. Differentiable."""
    young: float
    """Young's modulus E [Pa]. Differentiable."""
    poisson: float = 0.3
    """Poisson's ratio ν [-], in (-1, 0.5). Differentiable."""

    def __post_init__(self):
        _need(type(self) is not Material, "a material needs a law: use NeoHookean or FixedCorotated.")
        _need(_finite(self.density) and self.density > 0, f"density must be > 0 kg/m³, got {self.density}.")
        _need(_finite(self.young) and self.young > 0, f"young must be > 0 Pa, got {self.young}.")
        _need(
            -1.0 < self.poisson < 0.5, f"poisson must lie in (-1, 0.5), got {self.poisson}; rubber has 0.45 to 0.49."
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class NeoHookean(Material):
    """Neo-Hookean solid, τ = μ(FFᵀ − I) + λ log(J) I. Good for large stretch; an inverted particle is an error.

    Source: Hu et al. 2019, "ChainQueen", section III. Good values: E 10 to 1e6 Pa, ν 0.2 to 0.45.
    """


@dataclass(frozen=True, kw_only=True, slots=True)
class FixedCorotated(Material):
    """Fixed corotated solid, τ = 2μ(F − R)Fᵀ + λ(J − 1)J I. Survives inversion; softens when crushed below J = 0.5.

    Source: Stomakhin et al. 2012, "Energetically consistent invertible elasticity". Good values: as NeoHookean.
    """


@dataclass(frozen=True, slots=True)
class Body:
    """Particles made of one material."""

    particles: Particles
    material: Material


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Muscle:
    """Fibres that pull (activation > 0) or push (< 0) along one material direction: τ += a s (Fd)(Fd)ᵀ.

    Muscles may overlap: their stresses add. Source: Spielberg et al. 2021 (Robotica), section on actuation.
    """

    particles: np.ndarray
    """Indices into the model's particles: the bodies' particles in the order of the bodies."""
    direction: Sequence[float]
    """Fibre direction d in the rest shape; normalised here."""
    strength: float
    """Stress at full activation, s [Pa]."""

    def __post_init__(self):
        index = np.asarray(self.particles)
        _need(index.ndim == 1 and index.size > 0, "a muscle needs a list of particle indices that is not empty.")
        _need(
            np.issubdtype(index.dtype, np.integer),
            f"muscle particles must be whole numbers, got {index.dtype}; turn a mask into indices with np.flatnonzero.",
        )
        _need(len(np.unique(index)) == index.size, "a muscle names a particle twice; give each index once.")
        length = math.sqrt(sum(float(c) ** 2 for c in self.direction))
        _need(_finite(length) and length > 0, f"muscle direction must not be zero, got {tuple(self.direction)}.")
        _need(_finite(self.strength), f"muscle strength must be finite, got {self.strength}.")
        object.__setattr__(self, "particles", index.astype(np.int64))
        object.__setattr__(self, "direction", tuple(float(c) / length for c in self.direction))


@dataclass(frozen=True, kw_only=True, slots=True)
class Wall:
    """Half space n·x ≤ offset that a body cannot enter; acts on the nodes inside it.

    ``stick`` holds the nodes, ``slip`` removes the normal velocity, ``separate`` only stops motion into the wall and
    applies Coulomb friction to the rest.
    """

    normal: Sequence[float]
    """Outward normal n, pointing out of the wall into the free space; normalised here together with the offset."""
    offset: float
    """The wall's surface is n·x = offset [m]."""
    contact: Contact = "separate"
    friction: float = 0.0
    """Coulomb coefficient [-], for ``separate`` only."""

    def __post_init__(self):
        _need(self.contact in CONTACTS, f"wall contact must be one of {', '.join(CONTACTS)}, got {self.contact!r}.")
        _need(_finite(self.offset), f"wall offset must be finite, got {self.offset}.")
        _need(_finite(self.friction) and self.friction >= 0, f"wall friction must be ≥ 0, got {self.friction}.")
        _need(
            self.friction == 0.0 or self.contact == "separate",
            f"a {self.contact} wall has no friction, got {self.friction}; use contact='separate'.",
        )
        length = math.sqrt(sum(float(c) ** 2 for c in self.normal))
        _need(_finite(length) and length > 0, f"wall normal must not be zero, got {tuple(self.normal)}.")
        if abs(length - 1.0) > 1e-15:
            object.__setattr__(self, "offset", self.offset / length)
        object.__setattr__(self, "normal", tuple(float(c) / length for c in self.normal))


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Scene:
    """Everything that does not change while a robot moves."""

    grid: Grid
    bodies: Sequence[Body]
    muscles: Sequence[Muscle] = ()
    walls: Sequence[Wall] = ()
    gravity: Sequence[float] | None = None
    """Gravity g [m/s²], one number per axis; None is weightless."""
    damping: float = 0.0
    """Rate at which grid velocity decays [1/s]; the same for every dt."""
    dt: float
    """Length of one substep, Δt [s]; see :func:`softmpm.stable_dt`."""

    def __post_init__(self):
        dim = self.grid.dim
        gravity = (0.0,) * dim if self.gravity is None else tuple(float(g) for g in self.gravity)
        _need(_finite(*gravity) and len(gravity) == dim, f"gravity needs {dim} finite numbers, got {self.gravity}.")
        _need(_finite(self.damping) and self.damping >= 0, f"damping must be ≥ 0 1/s, got {self.damping}.")
        _need(_finite(self.dt) and self.dt > 0, f"dt must be > 0 s, got {self.dt}.")
        _need(len(self.bodies) > 0, "a scene needs at least one body.")
        object.__setattr__(self, "gravity", gravity)
        for name in ("bodies", "muscles", "walls"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
