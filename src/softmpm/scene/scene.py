"""Scene description: grid, bodies with a material, walls, and the actuators of ``actuators.py``. Plain SI numbers, checked at once.

A scene holds no tensors and knows no device; :func:`softmpm.build` turns it into a :class:`softmpm.Model`.
Rules that need the whole scene (particles inside the grid, muscle indices) live in ``check_scene.py``.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from softmpm.scene.actuators import Actuator, kind_of, labels
from softmpm.scene.materials import Material
from softmpm.scene.outline import Outline
from softmpm.summary import counted, table
from softmpm.validate import array, indices, need, need_kind, numbers, read_only, restore, store_numbers, unit

Contact = Literal["stick", "slip", "separate", "clamp", "symmetry"]
CONTACTS: tuple[Contact, ...] = ("stick", "slip", "separate", "clamp", "symmetry")
MIRRORS: tuple[Contact, ...] = ("clamp", "symmetry")
"""Kinds of a wall in whose plane a body begins and is reflected."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Grid:
    """Background grid of nodes; node (i, j, k) sits at (i, j, k) · spacing."""

    shape: tuple[int, ...]
    """Nodes along each axis; two axes make a plane-strain scene, three a solid one."""
    spacing: float
    """Distance of neighbouring nodes, dx [m]. Good values: several cells across the thinnest limb."""

    def __post_init__(self):
        need(np.shape(self.shape) in ((2,), (3,)), f"grid shape must have 2 or 3 axes, got {self.shape!r}.")
        shape = numbers("grid shape", self.shape)
        need(
            all(n.is_integer() and n >= 4 for n in shape),
            f"grid shape needs whole numbers of at least 4 nodes along each axis, got {self.shape}.",
        )
        need(
            all(n < 2**31 for n in shape),
            f"grid shape must be below 2,147,483,648 nodes along each axis, which 32-bit indices reach, got {self.shape}.",
        )
        object.__setattr__(self, "shape", tuple(int(n) for n in shape))
        store_numbers(self, "grid", "spacing")
        need(self.spacing > 0, f"grid spacing must be > 0 m, got {self.spacing}.")

    @property
    def dim(self) -> int:
        return len(self.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """Material points of a shape at rest."""

    positions: np.ndarray
    """Rest positions X [m], shape (particle, dim); copied, read-only."""
    volume: np.ndarray | float
    """Rest volume of each particle V⁰ [m³], in 2D [m²] of unit depth; one number or shape (particle,); copied, read-only."""
    outline: Outline | None = None
    """The true surface of the shape; None if it is not known, and then walls meet all bodies of the scene at the nodes."""

    def __post_init__(self):
        positions = np.array(array("positions", self.positions), dtype=np.float64, ndmin=2)
        need(
            positions.ndim == 2 and positions.shape[1] in (2, 3),
            f"positions must have shape (particle, 2) or (particle, 3), got {positions.shape}.",
        )
        need(len(positions) > 0, "a shape has no particles: make it larger or its spacing smaller.")
        volume = array("volume", self.volume).astype(np.float64)
        need(
            volume.shape in ((), (len(positions),)),
            f"volume must be one number or have shape ({len(positions)},), got {volume.shape}.",
        )
        for name, values in (("positions", positions), ("volume", volume)):
            if not np.isfinite(values).all():
                particle = np.argwhere(~np.isfinite(np.atleast_1d(values)))[0][0]
                raise ValueError(f"{name} must be finite; particle {particle} is not.")
        need(bool((volume > 0).all()), f"volume must be > 0, got {volume.min()}.")
        if self.outline is not None:
            need_kind("particles outline", self.outline, Outline)
            need(
                self.outline.dim == positions.shape[1],
                f"an outline has as many axes as its particles, got {self.outline.dim}D and {positions.shape[1]}D.",
            )
        object.__setattr__(self, "positions", read_only(positions))
        object.__setattr__(self, "volume", read_only(np.broadcast_to(volume, (len(positions),)).copy()))

    @property
    def spacing(self) -> float:
        """Mean distance of neighbours [m], that of a lattice as dense as the particles on average."""
        return float(np.mean(self.volume)) ** (1 / self.positions.shape[1])

    def moved(self, by: Sequence[float]) -> "Particles":
        """The same shape, with its outline, displaced by a vector [m]."""
        shift, outline = array("by", by).astype(np.float64), self.outline
        need(
            shift.shape == self.positions.shape[1:],
            f"a shape moves by {self.positions.shape[1]} numbers, one per axis, got {by}.",
        )
        if outline is not None:
            outline = Outline(outline.points + shift, outline.normals, outline.areas)
        return Particles(self.positions + shift, self.volume, outline)

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        return f"Particles({len(self):,} in {self.positions.shape[1]}D)"

    __setstate__ = restore


@dataclass(frozen=True, slots=True)
class Body:
    """Particles made of one material."""

    particles: Particles
    """From :func:`softmpm.box`, ``ball``, ``polygons``, ``image`` or ``mesh``. Good spacing: half a cell, 4 particles per cell in 2D, 8
    in 3D."""
    material: Material
    """One of the laws, such as :class:`softmpm.NeoHookean`."""

    def __post_init__(self):
        need_kind("body particles", self.particles, Particles)
        if callable(getattr(self.material, "material", None)):
            raise TypeError(
                f"body material must be a Material, got a {type(self.material).__name__}; its method material() makes one."
            )
        need_kind("body material", self.material, Material)


@dataclass(frozen=True, kw_only=True, slots=True)
class Wall:
    """Half space n·x ≤ offset that a body cannot enter.

    ``separate`` stops motion into the wall, with Coulomb friction. It acts on the points of the outlines if every body has one, as the
    shapes do, else on the grid's nodes inside it (``contact`` of :func:`softmpm.build`). Nodes keep a body up to 0.9 cells away, and
    do not push out one that begins inside the wall.

    ``stick`` holds the nodes inside it, and ``slip`` removes their normal velocity.

    ``clamp`` holds the face with which a body begins at the wall's plane, and ``symmetry`` leaves it free to slide in that plane: both
    reflect the body's motion there, and converge with spacing² where ``stick`` and ``slip`` converge with the spacing. They need
    ``formulation="reference"``, and a plane along the grid's axes that lies on nodes or midway between them. They never move.
    """

    normal: Sequence[float]
    """Normal n, pointing out of the wall into the free space; normalised here together with the offset."""
    offset: float
    """The wall's surface is n·x = offset [m]."""
    contact: Contact = "separate"
    """Kind of the wall, see above."""
    friction: float = 0.0
    """Coulomb coefficient [-], for ``separate`` only. Good values: 0.3 to 1.0 for a floor that is walked on."""

    def __post_init__(self):
        need(
            self.contact in CONTACTS,
            f"wall contact must be one of {', '.join(CONTACTS)}, got {self.contact!r}.",
        )
        store_numbers(self, "wall", "offset", "friction")
        need(self.friction >= 0, f"wall friction must be ≥ 0, got {self.friction}.")
        need(
            self.friction == 0.0 or self.contact == "separate",
            f"a {self.contact} wall has no friction, got {self.friction}; use contact='separate'.",
        )
        normal, length = unit("wall normal", self.normal)
        object.__setattr__(self, "offset", self.offset / length)
        object.__setattr__(self, "normal", normal)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Scene:
    """A soft robot and its surroundings: everything that does not change while it moves."""

    grid: Grid
    """Background grid; a particle that leaves it is an error in the moving formulation, and at rest in both."""
    bodies: Sequence[Body]
    """At least one; their particles are numbered in this order."""
    muscles: Sequence[Actuator] = ()
    """Actuators, each a :class:`Muscle` or a :class:`Pressure`, in the order of the last axis of ``activation``; they may overlap."""
    walls: Sequence[Wall] = ()
    """Applied in this order; at most 64."""
    driven: Sequence[int] | np.ndarray = ()
    """Particles that move as ``Inputs.velocity`` says, in its order, and stand still without it (a clamp). On the moving grid each has
    its velocity; in the reference formulation they hold the nodes around them, which smooths velocities that are not those of a rigid
    motion (docs/inputs.md). Indices into the model's particles, in any order; copied, read-only."""
    gravity: Sequence[float] | None = None
    """Gravity g [m/s²], one number per axis, such as (0.0, -9.8) in 2D, where axis 1 points up; None is weightless."""
    body_contact: bool = True
    """Bodies may touch themselves or each other. False states that they meet walls only, which allows ``formulation="auto"`` of
    ``build`` to take the reference formulation. There they pass through each other, until the alarm ``overlap`` stops the run."""
    damping: float = 0.0
    """Rate at which grid velocity decays [1/s]; the same for every dt. 0 for free motion; an arm that should come to rest takes 6."""
    dt: float
    """Length of one substep, Δt [s]. Good values: half of :func:`softmpm.stable_dt`, which leaves room for stretch; above it ``build``
    refuses. Far below it contact of curved bodies is less accurate (docs/accuracy.md)."""

    def __post_init__(self):
        need_kind("scene grid", self.grid, Grid)
        for name, kind, called in (
            ("bodies", Body, "Body"),
            ("muscles", Actuator, "Muscle or Pressure"),
            ("walls", Wall, "Wall"),
        ):
            parts = getattr(self, name)
            if isinstance(parts, kind) or not isinstance(parts, Iterable):
                raise TypeError(f"scene {name} must be a list of {called}, got {type(parts).__name__}.")
            parts = tuple(parts)
            for k, part in enumerate(parts):
                if not isinstance(part, kind):
                    raise TypeError(f"scene {name}[{k}] must be a {called}, got {type(part).__name__}.")
            object.__setattr__(self, name, parts)
        need(len(self.bodies) > 0, "a scene needs at least one body.")
        driven = self.driven if np.size(self.driven) else np.zeros(0, dtype=np.int64)
        object.__setattr__(self, "driven", indices("scene driven", driven, least=0))
        dim = self.grid.dim
        gravity = (0.0,) * dim if self.gravity is None else numbers("gravity", self.gravity)
        need(len(gravity) == dim, f"gravity needs {dim} numbers, one per axis, got {self.gravity}.")
        object.__setattr__(self, "gravity", gravity)
        if not isinstance(self.body_contact, (bool, np.bool_)):
            raise TypeError(f"scene body_contact must be True or False, got {self.body_contact!r}.")
        store_numbers(self, "scene", "damping", "dt")
        need(self.damping >= 0, f"damping must be ≥ 0 1/s, got {self.damping}.")
        need(self.dt > 0, f"dt must be > 0 s, got {self.dt}.")

    __setstate__ = restore

    @property
    def particle_count(self) -> int:
        """Particles of all bodies."""
        return sum(len(body.particles) for body in self.bodies)

    @property
    def positions(self) -> np.ndarray:
        """Positions of all particles at rest [m], shape (particle, dim)."""
        return np.concatenate([body.particles.positions for body in self.bodies])

    @property
    def body_index(self) -> np.ndarray:
        """Index of the body of each particle, shape (particle,)."""
        return np.repeat(np.arange(len(self.bodies)), [len(body.particles) for body in self.bodies])

    @property
    def muscle_names(self) -> tuple[str, ...]:
        """Labels of the muscles and pressures in pictures, all different: names, and "muscle 3" or "pressure 3" for those without one.
        Of equal names each is followed by its place, "leg (3)"."""
        return labels(map(kind_of, self.muscles), (actuator.name for actuator in self.muscles))

    def __repr__(self) -> str:
        return f"Scene({', '.join(f'{name}: {text}' for name, text in self._rows().items())})"

    def _repr_html_(self) -> str:
        return table("softmpm.Scene", self._rows())

    def _rows(self) -> dict[str, str]:
        laws = {type(body.material).__name__: None for body in self.bodies}
        driven = {"driven": counted(len(self.driven), "particle")} if len(self.driven) else {}
        return {
            "grid": f"{' x '.join(map(str, self.grid.shape))} nodes, {self.grid.spacing:.4g} m apart",
            "bodies": f"{counted(len(self.bodies), 'body', 'bodies')} of {counted(self.particle_count, 'particle')}, {', '.join(laws)}",
            "muscles": str(len(self.muscles)),
            "walls": ", ".join(wall.contact for wall in self.walls) or "0",
            **driven,
            "gravity": f"{self.gravity} m/s²",
            "damping": f"{self.damping:g} 1/s",
            "dt": f"{self.dt:.4g} s",
        }
