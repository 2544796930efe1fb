"""Actuators of a scene: muscles and pressures. Plain SI numbers, checked at once; the scene checks their indices."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from softmpm.summary import counted
from softmpm.validate import indices, need, restore, store_numbers, unit

LONGEST_NAME = 64
"""Most characters of the name of an actuator."""
NAMES = f"at most {LONGEST_NAME} printable characters, and no space at either end"
"""Rule of :func:`is_name` in words."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Actuator:
    """Particles with a stress that follows an activation. Use one of its kinds, the subclasses below; their stresses add."""

    particles: np.ndarray
    """Indices into the model's particles: the bodies' particles in the order of the bodies; copied, read-only. PyTorch warns of
    indices that are read-only: ``params.young[..., torch.tensor(muscle.particles)]``."""
    strength: float
    """Stress at full activation, s [Pa]. Good values: activation times strength below a quarter of Young's modulus; stronger ones
    stretch a body until it fractures (docs/results.md, Lessons). Differentiable as ``Inputs.strength``."""
    name: str = ""
    """Label in pictures, recordings and messages, such as "left hind leg, front": at most 64 characters. It changes no number. Several
    actuators may have the same; one without is "muscle 3" or "pressure 3", by its place in the scene, counted from 0."""

    def __post_init__(self):
        need(type(self) is not Actuator, "an actuator needs a kind: use Muscle or Pressure.")
        kind = kind_of(self)
        object.__setattr__(self, "particles", indices(f"a {kind}", self.particles))
        store_numbers(self, kind, "strength")
        if not isinstance(self.name, str):
            raise TypeError(f"{kind} name must be a text, got {self.name!r}; leave it out for none.")
        need(is_name(self.name), f"{kind} name must have {NAMES}, got {self.name!r:.100}.")
        object.__setattr__(self, "name", str(self.name))  # not one of NumPy's

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._summary()}, strength={self.strength:g} Pa)"

    def _summary(self) -> str:
        """The name, if there is one, and the number of particles."""
        return f"{self.name!r}, " * bool(self.name) + counted(len(self.particles), "particle")

    __setstate__ = restore


@dataclass(frozen=True, kw_only=True, slots=True, eq=False, repr=False)
class Muscle(Actuator):
    """Fibres that pull (activation > 0) or push (< 0) along one material direction: τ += a s (Fd)(Fd)ᵀ.

    Muscles may overlap: their stresses add. Source: Spielberg et al. 2021 (Robotica), section on actuation.
    """

    direction: Sequence[float]
    """Fibre direction d in the rest shape; normalised here. Differentiable as ``Inputs.direction``."""

    def __post_init__(self):
        Actuator.__post_init__(self)  # super() does not know a class with slots
        object.__setattr__(self, "direction", unit("muscle direction", self.direction)[0])

    def __repr__(self) -> str:
        return f"Muscle({self._summary()}, direction={self.direction}, strength={self.strength:g} Pa)"

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


def is_name(text: str) -> bool:
    """True for a text that may be the name of an actuator; the empty one is none."""
    return len(text) <= LONGEST_NAME and text.isprintable() and text == text.strip()


def kind_of(actuator: Actuator) -> str:
    """Kind of an actuator in words, such as "muscle"."""
    return type(actuator).__name__.lower()


def title(actuator: Actuator, place: int) -> str:
    """Kind, place in the scene and name of an actuator, for messages: "muscle 3", or "muscle 3 'left leg'"."""
    return f"{kind_of(actuator)} {place}" + f" {actuator.name!r}" * bool(actuator.name)


def labels(kinds: Iterable[str], names: Iterable[str]) -> tuple[str, ...]:
    """Different labels for all actuators of a scene: each one's name, or kind and place such as "muscle 3"; to equal ones the place is
    added, "leg (3)"."""
    found = [name or f"{kind} {place}" for place, (kind, name) in enumerate(zip(kinds, names, strict=True))]
    while len(count := Counter(found)) < len(found):
        found = [f"{label} ({place})" if count[label] > 1 else label for place, label in enumerate(found)]
    return tuple(found)
