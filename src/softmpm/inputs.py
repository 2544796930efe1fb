"""Inputs of a substep besides the state: one table of what users pass, and one of what the kernels take.

A new input is a row in each table. Structs, adjoints, buffers, sorting, checks, memory and the interfaces to PyTorch and Warp are
derived from them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor


class Inputs(NamedTuple):
    """Physical quantities that a call may give besides the state, the activation and :class:`softmpm.Params`. Differentiable.

    None takes the scene's value. Shapes broadcast to those below, so that one number for all worlds is a tensor without the axis
    ``world``. What starts with ``control_step`` or ``pose`` has all axes, of size 1 where a value is shared, or neither that axis nor
    ``world``: a force (5, 1, particle, dim) or (particle, dim). A tensor that lacks exactly one axis is refused. An input that the
    scene alone would not compile is named when the model is built: ``build(scene, inputs=("friction",))``.
    """

    gravity: Tensor | None = None
    """g [m/s²], shape (world, dim)."""
    damping: Tensor | None = None
    """Rate at which grid velocity decays [1/s], shape (world,)."""
    friction: Tensor | None = None
    """Coulomb coefficient of each wall [-], ≥ 0, shape (world, wall); read by ``separate`` walls only. With contact at nodes, those
    that friction holds give it no gradient."""
    wall_offset: Tensor | None = None
    """Offset of each wall [m], shape (pose, world, wall), in float64. One pose is a wall at rest; else there is one at the beginning
    and one at the end of every control step, and the wall moves between them at a constant speed. Clamps and planes of symmetry stay
    where the scene has them. With contact at nodes only the speed has a gradient: that of a wall at rest is zero."""
    wall_normal: Tensor | None = None
    """Normal of each wall, shape (pose, world, wall, dim), in float64; normalised together with the offset, if that is given too."""
    wall_velocity: Tensor | None = None
    """Velocity of the surface of each wall [m/s], shape (control_step, world, wall, dim), beyond that of its pose: a conveyor belt."""
    direction: Tensor | None = None
    """Fibre direction of each muscle in the rest shape, shape (world, muscle, dim); normalised here."""
    strength: Tensor | None = None
    """Stress of each actuator at full activation [Pa], shape (world, muscle)."""
    viscosity: Tensor | None = None
    """Viscosity η of the material [Pa s], shape (world, particle)."""
    velocity: Tensor | None = None
    """Velocity of the driven particles [m/s], shape (control_step, world, driven, dim); smoothed in the reference formulation, see
    :attr:`Scene.driven`."""
    position: Tensor | None = None
    """Position of the driven particles at the end of each control step [m], shape (control_step, world, driven, dim); they move there
    at a constant velocity. In place of ``velocity``."""
    force: Tensor | None = None
    """External force on each particle [N], shape (control_step, world, particle, dim)."""


torch.serialization.add_safe_globals([Inputs])  # torch.load reads them with weights_only=True


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """Quantity that users pass: names of the axes that it broadcasts to, and the bounds of its values."""

    axes: tuple[str, ...]
    low: float = -math.inf
    high: float = math.inf
    closed: bool = False
    """True if the bounds themselves are allowed."""
    double: bool = False
    """True if it is float64 in every precision: the side of a wall that a node lies on must not depend on the precision."""
    default: Callable[[Any], Any] | None = None
    """Value of a scene, in a shape that broadcasts; None for the material, which the bodies have."""
    needed: Callable[[Any], bool] = lambda spec: False
    """True if the kernels of a :class:`softmpm.kernels.structs.Spec` take it although no call gives it."""

    @property
    def rule(self) -> str:
        """The bounds in words."""
        if self.high < math.inf:
            left, right = "[]" if self.closed else "()"
            return f"in {left}{self.low:g}, {self.high:g}{right}"
        return "finite" if self.low == -math.inf else f"finite and {'≥' if self.closed else '>'} {self.low:g}"


QUANTITIES = {
    "young": Quantity(axes=("world", "particle"), low=0.0),
    "poisson": Quantity(axes=("world", "particle"), low=-1.0, high=0.5),
    "density": Quantity(axes=("world", "particle"), low=0.0),
    "gravity": Quantity(axes=("world", "dim"), default=lambda scene: scene.gravity),
    "damping": Quantity(axes=("world",), low=0.0, closed=True, default=lambda scene: scene.damping),
    "friction": Quantity(
        axes=("world", "wall"), low=0.0, closed=True, default=lambda scene: [w.friction for w in scene.walls]
    ),
    "wall_offset": Quantity(
        axes=("pose", "world", "wall"),
        double=True,
        default=lambda scene: [[[w.offset for w in scene.walls]]],
        needed=lambda spec: spec.moving,
    ),
    "wall_normal": Quantity(
        axes=("pose", "world", "wall", "dim"),
        double=True,
        default=lambda scene: [[[w.normal for w in scene.walls]]],
        needed=lambda spec: spec.moving,
    ),
    "wall_velocity": Quantity(
        axes=("control_step", "world", "wall", "dim"),
        default=lambda scene: [0.0] * scene.grid.dim,
        needed=lambda spec: spec.moving,
    ),
    "direction": Quantity(
        axes=("world", "muscle", "dim"), default=lambda scene: [direction_of(m, scene) for m in scene.muscles]
    ),
    "strength": Quantity(axes=("world", "muscle"), default=lambda scene: [m.strength for m in scene.muscles]),
    "viscosity": Quantity(
        axes=("world", "particle"),
        low=0.0,
        closed=True,
        default=lambda scene: [b.material.viscosity for b in scene.bodies for _ in range(len(b.particles))],
        needed=lambda spec: spec.viscosity,
    ),
    "velocity": Quantity(
        axes=("control_step", "world", "driven", "dim"),
        default=lambda scene: [0.0] * scene.grid.dim,
        needed=lambda spec: spec.driven or spec.driven_nodes,
    ),
    "position": Quantity(axes=("control_step", "world", "driven", "dim")),
    "force": Quantity(
        axes=("control_step", "world", "particle", "dim"), default=lambda scene: [0.0] * scene.grid.dim
    ),
}
"""Fields of :class:`softmpm.Params` and :class:`Inputs`, by name."""


def direction_of(actuator, scene) -> tuple[float, ...]:
    """Unit direction of an actuator, along the first axis for one without fibres."""
    return getattr(actuator, "direction", (1.0,) + (0.0,) * (scene.grid.dim - 1))


@dataclass(frozen=True, kw_only=True)
class Input:
    """Input of the kernels: its count and type, the scenes that have it, and the group of gradients that it belongs to."""

    name: str = field(kw_only=False)
    per: Literal["particle", "slot", "muscle", "driven", "driven_node", "world", "wall", "substep"] = field(
        kw_only=False
    )
    kind: Literal["scalar", "vector", "index"] = "scalar"
    present: Callable[[Any], bool] = lambda spec: True
    """True if the kernels of a :class:`softmpm.kernels.structs.Spec` take it."""
    group: str = ""
    """Gradients of one group are computed together; an input without a group is not differentiable."""
    rows: bool = False
    """True if each control step has its own values."""
    stage: Literal["p2g", "grid", "g2p"] = "p2g"
    """Stage of a substep that reads it."""
    double: bool = False
    """True if it is float64 in every precision."""
    shared: Callable[[Any], bool] = lambda spec: False
    """True if all worlds share it."""
    constant: Callable[[Any], bool] = lambda spec: False
    """True if it is passed by value with a launch, as the walls at rest are, so that no kernel waits for memory."""
    branches: Callable[[Any], bool] = lambda spec: False
    """True if it only selects branches, and its gradient is zero: nodes are inside a wall or not, surface points have a gap."""

    def __post_init__(self):
        if self.per == "particle" and self.rows != (self.kind == "vector"):
            raise ValueError(
                f"input {self.name!r}: vectors of particles need rows=True, their scalars and indices rows=False, got "
                f"kind={self.kind!r} and rows={self.rows}."
            )

    @property
    def sorted(self) -> bool:
        """True if it is permuted with the particles when they are sorted."""
        return self.per in ("particle", "slot")


def _moving(spec) -> bool:
    return spec.moving


def _given(name: str) -> Callable[[Any], bool]:
    return lambda spec: name in spec.given


INPUTS = (
    Input("mass", "particle", group="material"),  # m_p / m₀, m₀ that of the heaviest particle
    Input("mu", "particle", group="material"),  # Lamé's μ [Pa]
    Input("lam", "particle", group="material"),  # Lamé's λ [Pa]
    Input("volume", "particle"),  # V⁰ / m₀ [m³/kg]
    Input("law", "particle", kind="index", present=lambda spec: len(spec.laws) > 1),  # into spec.laws
    Input("muscle", "slot", kind="index", present=lambda spec: spec.muscle_slots > 0),  # or -1
    Input(  # unit direction d
        "fibre",
        "muscle",
        kind="vector",
        present=lambda spec: spec.fibres,
        group="direction",
        shared=lambda spec: "direction" not in spec.given,
    ),
    Input(  # activation times strength [Pa]
        "active_stress", "muscle", present=lambda spec: spec.muscle_slots > 0, group="activation", rows=True
    ),
    Input(  # index into spec.actuators
        "actuator",
        "muscle",
        kind="index",
        present=lambda spec: len(spec.actuators) > 1,
        shared=lambda spec: True,
    ),
    Input("viscosity", "particle", present=lambda spec: spec.viscosity, group="viscosity"),  # η [Pa s]
    # f / m₀ [m/s²]
    Input("force", "particle", kind="vector", present=_given("force"), group="force", rows=True),
    Input("driven", "particle", kind="index", present=lambda spec: spec.driven, stage="g2p"),  # or -1
    Input(  # of the driven particles [m/s]
        "velocity",
        "driven",
        kind="vector",
        present=lambda spec: spec.driven,
        group="velocity",
        rows=True,
        stage="g2p",
    ),
    Input(  # of the nodes that driven particles hold in the reference formulation [m/s]
        "driven_velocity",
        "driven_node",
        kind="vector",
        present=lambda spec: spec.driven_nodes,
        group="velocity",
        rows=True,
        stage="grid",
    ),
    # g [m/s²]
    Input("gravity", "world", kind="vector", present=_given("gravity"), group="gravity", stage="grid"),
    # exp(−damping Δt)
    Input("decay", "world", present=_given("damping"), group="damping", stage="grid"),
    Input(
        "normal",
        "wall",
        kind="vector",
        present=lambda spec: len(spec.contacts) > 0,
        group="wall",
        rows=True,
        stage="grid",
        double=True,
        constant=lambda spec: not spec.moving,
    ),
    Input(
        "offset",
        "wall",
        present=lambda spec: len(spec.contacts) > 0,
        group="wall",
        branches=lambda spec: not spec.surface_walls,
        rows=True,
        stage="grid",
        double=True,
        constant=lambda spec: not spec.moving,
    ),
    Input(
        "friction",
        "wall",
        present=lambda spec: spec.friction,
        group="friction",
        stage="grid",
        constant=lambda spec: "friction" not in spec.given,
    ),
    # How the pose of a moving wall changes in a control step, see contact.py:
    Input("offset_rate", "wall", present=_moving, group="wall", rows=True, stage="grid", double=True),
    Input(
        "normal_rate",
        "wall",
        kind="vector",
        present=_moving,
        group="wall",
        rows=True,
        stage="grid",
        double=True,
    ),
    Input("surface_velocity", "wall", kind="vector", present=_moving, group="wall", rows=True, stage="grid"),
    Input("elapsed", "substep", present=_moving, stage="grid", double=True),  # of the control step [s]
)
"""All inputs of the kernels, in the order of the fields of the kernels' structs."""


def present(spec) -> tuple[Input, ...]:
    """Inputs that the kernels of this :class:`softmpm.kernels.structs.Spec` take."""
    return tuple(one for one in INPUTS if one.present(spec))


def stored(spec) -> tuple[Input, ...]:
    """Inputs of :func:`present` that are stored in memory."""
    return tuple(one for one in present(spec) if not one.constant(spec))


def differentiable(spec) -> tuple[Input, ...]:
    """Inputs of :func:`present` that have a gradient."""
    return tuple(one for one in stored(spec) if one.group and not one.shared(spec) and not one.branches(spec))


def groups(spec) -> tuple[str, ...]:
    """Groups of the :func:`differentiable` inputs, in the order of the table."""
    return tuple(dict.fromkeys(one.group for one in differentiable(spec)))
