"""Actuators of a scene: muscles and pressures. Plain SI numbers, checked at once; the scene checks their indices."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softmpm.summary import counted
from softmpm.validate import indices, need, restore, store_numbers, unit


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Actuator:
    """Particles with a stress that follows an activation. Use one of its kinds, the subclasses below; their stresses add."""

    particles: np.ndarray
    """Indices into the model's particles: the bodies' particles in the order of the bodies; copied, read-only. PyTorch warns of
    indices that are read-only: ``params.young[..., torch.tensor(muscle.particles)]``."""
    strength: float
    """Stress at full activation, s [Pa]. Good values: activation times strength below a quarter of Young's modulus; stronger ones
    stretch a body until it fractures (docs/results.md, Lessons). Differentiable."""

    def __post_init__(self):
        need(type(self) is not Actuator, "an actuator needs a kind: use Muscle or Pressure.")
        object.__setattr__(self, "particles", indices(f"a {self._name}", self.particles))
        store_numbers(self, self._name, "strength")

    @property
    def _name(self) -> str:
        return type(self).__name__.lower()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({counted(len(self.particles), 'particle')}, strength={self.strength:g} Pa)"

    __setstate__ = restore


@dataclass(frozen=True, kw_only=True, slots=True, eq=False, repr=False)
class Muscle(Actuator):
    """Fibres that pull (activation > 0) or push (< 0) along one material direction: τ += a s (Fd)(Fd)ᵀ.

    Muscles may overlap: their stresses add. Source: Spielberg et al. 2021 (Robotica), section on actuation.
    """

    direction: Sequence[float]
    """Fibre direction d in the rest shape; normalised here. Differentiable."""

    def __post_init__(self):
        Actuator.__post_init__(self)  # super() does not know a class with slots
        object.__setattr__(self, "direction", unit("muscle direction", self.direction)[0])

    def __repr__(self) -> str:
        count = counted(len(self.particles), "particle")
        return f"Muscle({count}, direction={self.direction}, strength={self.strength:g} Pa)"

    __setstate__ = restore


@dataclass(frozen=True, kw_only=True, slots=True, eq=False, repr=False)
class Pressure(Actuator):
    """Pressure that expands (activation > 0) or contracts (< 0) alike in all directions: τ −= a s J I, a Cauchy stress of −a s.

    A pneumatic chamber filled with a soft material, or tissue that swells. In a plane-strain scene it also presses out of the plane.
    It acts against the bulk modulus of its particles: a free body swells by the small strain (1 − 2ν) p/E of p = a s, in plane strain
    by 1 + ν times that. So a chamber needs a small Poisson's ratio, as a body of its own that shares nodes with the wall around it, or
    in ``params``.
    """

    __setstate__ = restore
