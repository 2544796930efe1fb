"""What a substep depends on besides the state: one table for users, one for the kernels, from which the rest of the package follows.

A new input is a row in each: structs, adjoints, buffers, sorting, checks, memory and the interfaces to PyTorch and Warp read them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from torch import Tensor


class Inputs(NamedTuple):
    """Physical quantities that a call may give besides the state, the activation and :class:`softmpm.Params`. Differentiable.

    None takes the scene's value. Shapes broadcast to those below, so that one number for all worlds is a tensor without the axis
    ``world``. An input that the scene alone would not compile is named when the model is built: ``build(scene, inputs=("friction",))``.
    """

    gravity: Tensor | None = None
    """g [m/s²], shape (world, dim)."""
    damping: Tensor | None = None
    """Rate at which grid velocity decays [1/s], shape (world,)."""
    friction: Tensor | None = None
    """Coulomb coefficient of each wall [-], shape (world, wall)."""
    wall_offset: Tensor | None = None
    """Offset of each wall [m], shape (pose, world, wall), in float64. One pose is a wall at rest; else there is one at the beginning
    and one at the end of every control step, and the wall moves between them at a constant speed."""
    wall_normal: Tensor | None = None
    """Normal of each wall, shape (pose, world, wall, dim), in float64; normalised together with the offset."""
    wall_velocity: Tensor | None = None
    """Velocity of the surface of each wall [m/s], shape (control_step, world, wall, dim), beyond that of its pose: a conveyor belt."""
    direction: Tensor | None = None
    """Fibre direction of each muscle in the rest shape, shape (world, muscle, dim); normalised here."""
    strength: Tensor | None = None
    """Stress of each actuator at full activation [Pa], shape (world, muscle)."""
    viscosity: Tensor | None = None
    """Viscosity η of the material [Pa s], shape (world, particle)."""
    velocity: Tensor | None = None
    """Velocity of the driven particles [m/s], shape (control_step, world, driven, dim)."""
    force: Tensor | None = None
    """External force on each particle [N], shape (control_step, world, particle, dim)."""


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """What users give: the shape that it broadcasts to, by names of axes, and the bounds that it keeps."""

    axes: tuple[str, ...]
    low: float = -math.inf
    high: float = math.inf
    closed: bool = False
    """Whether the bounds themselves are allowed."""
    double: bool = False
    """Whether it is in float64 in every precision: which side of a wall a node is on must not depend on it."""

    @property
    def rule(self) -> str:
        """The bounds in words."""
        if self.high < math.inf:
            return f"in ({self.low:g}, {self.high:g})"
        return "finite" if self.low == -math.inf else f"finite and {'≥' if self.closed else '>'} {self.low:g}"


QUANTITIES = {
    "young": Quantity(axes=("world", "particle"), low=0.0),
    "poisson": Quantity(axes=("world", "particle"), low=-1.0, high=0.5),
    "density": Quantity(axes=("world", "particle"), low=0.0),
    "gravity": Quantity(axes=("world", "dim")),
    "damping": Quantity(axes=("world",), low=0.0, closed=True),
    "friction": Quantity(axes=("world", "wall"), low=0.0, closed=True),
    "wall_offset": Quantity(axes=("pose", "world", "wall"), double=True),
    "wall_normal": Quantity(axes=("pose", "world", "wall", "dim"), double=True),
    "wall_velocity": Quantity(axes=("control_step", "world", "wall", "dim")),
    "direction": Quantity(axes=("world", "muscle", "dim")),
    "strength": Quantity(axes=("world", "muscle")),
    "viscosity": Quantity(axes=("world", "particle"), low=0.0, closed=True),
    "velocity": Quantity(axes=("control_step", "world", "driven", "dim")),
    "force": Quantity(axes=("control_step", "world", "particle", "dim")),
}
"""Of :class:`softmpm.Params` and :class:`Inputs`, by name."""
