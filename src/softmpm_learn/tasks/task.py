"""Parts of every task: its settings, the robot's scene, the observed regions and the objective."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple, Self

import numpy as np
import torch

import softmpm
from softmpm_learn.lasting import Lasting
from softmpm_learn.objective import Objective
from softmpm_learn.setting_checks import not_negative, one_of, particles, positive, replaces_nothing, typed
from softmpm_learn.term import Path

FORMULATIONS = ("moving", "reference")
CONTACTS = ("auto", "nodes", "surface")
Solid = softmpm.NeoHookean | softmpm.StableNeoHookean | softmpm.FixedCorotated | softmpm.BarrierCorotated
LAWS: dict[str, type[Solid]] = {
    "neo_hookean": softmpm.NeoHookean,
    "stable_neo_hookean": softmpm.StableNeoHookean,
    "fixed_corotated": softmpm.FixedCorotated,
    "barrier_corotated": softmpm.BarrierCorotated,
}
WIDTH = 0.01
"""Distance over which surface contact sets in while a robot learns [cells]."""
LASTING = 3
"""Number of episodes in a row over which a motion is evaluated, to choose the best."""
STRETCH = 1.6
"""Stretch of neighbouring particles of a robot that costs nothing. Those on the lattice part for good at 2.8, with 1.4 cells between
them (:class:`softmpm.Alarms`)."""


class Source(NamedTuple):
    """A file that a robot was read from."""

    path: str
    digest: str
    """SHA-256 of its bytes."""


class Resolution(Enum):
    """Cells of the background grid per metre; two particles per cell along each axis."""

    draft = 80
    standard = 128
    fine = 192


@dataclass(kw_only=True)
class TaskConf:
    """Settings that every task has. SI units; each task's own values are our choice."""

    name: str
    resolution: Resolution = Resolution.draft
    """Cells per metre: draft 80, standard 128, fine 192."""
    seconds: float = 1.0
    """Length of an episode [s], rounded to whole control periods."""
    control_period: float = 0.0125
    """Time between two decisions of the policy [s]."""
    law: str = "neo_hookean"
    """Elastic law of the material: neo_hookean, stable_neo_hookean, fixed_corotated or barrier_corotated; all results in docs/ are of
    the first."""
    young: float = 5e4
    """Young's modulus E [Pa]; where co-design starts."""
    poisson: float = 0.3
    """Poisson's ratio ν [-]; where co-design starts."""
    density: float = 1000.0
    """Rest density ρ₀ [kg/m³]; where co-design starts."""
    viscosity: float = 0.0
    """Viscosity η of the material [Pa s]; co-design starts there if it is > 0."""
    retardation: float = 0.0
    """Retardation time η/μ of the material [s], instead of ``viscosity``. Good value in the reference formulation: 4e-3, with which its
    gradients were usable (docs/gait.md)."""
    strength: float = 1.2e4
    """Stress of a muscle at full activation [Pa]."""
    gravity: float = 9.81
    """Downward acceleration [m/s²]; 0 is weightless."""
    damping: float = 0.0
    """Rate at which velocity decays [1/s]."""
    safety: float = 0.4
    """Substep over the largest stable one at rest; leaves room for stretch and co-design."""
    effort: float = 1e-3
    """Weight of the mean squared activation in the loss; decides between motions that are equally good."""
    formulation: str = "moving"
    """moving, or reference: as in :func:`softmpm.build`. In the reference formulation nothing keeps limbs from passing through each
    other."""
    overlap: bool = False
    """reference: whether limbs may pass through each other; else the simulation stops by name where they do."""
    contact: str = "auto"
    """Part that meets separating walls: the surface of the robot, or the nodes around it. auto is the surface for robots on legs, in
    both formulations; the arm meets no such wall. A robot in the reference formulation or with a surface has cut cells."""
    contact_width: float | None = None
    """Distance over which surface contact sets in [cells]; 0 to evaluate. null is 0.01 where the surface meets the floor, with which
    gradients were usable (docs/gait.md)."""

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        replaces_nothing(cls)

    def __post_init__(self):
        typed("task", self)
        if not isinstance(self.resolution, Resolution):
            known = ", ".join(map(str, Resolution))
            raise ValueError(f"task.resolution must be one of {known}; got {self.resolution!r}.")
        one_of("task.formulation", self.formulation, FORMULATIONS)
        one_of("task.contact", self.contact, CONTACTS)
        one_of("task.law", self.law, tuple(LAWS))
        if self.viscosity > 0 and self.retardation > 0:
            raise ValueError(
                f"task.viscosity = {self.viscosity} and task.retardation = {self.retardation} are two names for one thing; "
                "set one of them to 0."
            )
        if not -1.0 < self.poisson < 0.5:
            raise ValueError(f"task.poisson must lie in (-1, 0.5), got {self.poisson}.")
        positive("task", self, "seconds", "control_period", "young", "density", "strength", "safety")
        not_negative(
            "task", self, "viscosity", "retardation", "gravity", "damping", "effort", "contact_width"
        )
        if self.safety > 1.0:
            raise ValueError(
                f"task.safety must be at most 1, with which the substep is the stable one, got {self.safety}."
            )
        if self.control_period > self.seconds:
            raise ValueError(
                f"task.control_period must be at most task.seconds = {self.seconds}, got {self.control_period}."
            )

    def refined(self) -> Self | None:
        """Settings of the same task on the next finer grid, None if there is none."""
        known = list(Resolution)
        if self.resolution is known[-1]:
            return None
        return dataclasses.replace(self, resolution=known[known.index(self.resolution) + 1])

    @property
    def cells_per_metre(self) -> int:
        """Cells of the grid per metre."""
        return self.resolution.value

    @property
    def spacing(self) -> float:
        """Distance of neighbouring grid nodes [m]."""
        return 1.0 / self.cells_per_metre

    @property
    def on_surface(self) -> bool:
        """True if the surface of the robot meets the walls that separate."""
        return self.contact == "surface"

    @property
    def cut_cells(self) -> bool:
        """True if the outline or the mass at rest counts, so that shapes are filled with cut cells."""
        return self.on_surface or self.formulation == "reference"

    @property
    def build(self) -> dict[str, Any]:
        """Arguments of :func:`softmpm.build`."""
        width = self.contact_width
        if width is None:
            width = WIDTH if self.on_surface else 0.0
        contact = "surface" if self.on_surface else "nodes"
        found = {"formulation": self.formulation, "contact": contact, "contact_width": width}
        return found | {"alarms": self.alarms}

    @property
    def alarms(self) -> softmpm.Alarms:
        """Limits beyond which a simulation is stopped by name."""
        return softmpm.Alarms(overlap=None) if self.overlap else softmpm.Alarms()


@dataclass(frozen=True, kw_only=True, eq=False)
class Task:
    """A robot, its world and what it should do."""

    name: str
    scene: softmpm.Scene
    control_steps: int
    """Decisions of the policy in an episode."""
    substeps: int
    """Simulated substeps for each decision."""
    regions: dict[str, np.ndarray]
    """Hand-picked clusters of particles by name; they do not overlap. Indices into the model's particles."""
    objective: Objective
    body_length: float
    """Scale of displacements: of a walker the extent of its particles at rest along x, which is a particle's spacing less than the body
    is long, of an arm its reach [m]."""
    goal: np.ndarray | None = None
    """Goal position [m], shape (dim,), if the task has one."""
    fade: float = math.inf
    """Time after which the robot has forgotten what a muscle did [s]; see ``optimizer.fade``, which goes before."""
    gain: float = 1.0
    """Size of the first activations; see ``policy.gain``, which goes before."""
    feature_gain: float = 1.0
    """Influence of an encoder's features on them, in units of the clock's; see ``policy.feature_gain``, which goes before."""
    clock: bool = True
    """True if policies see the time; see ``policy.clock``, which goes before."""
    rate: float = 5e-3
    """Learning rate of the policy, for the mlp and adam; see ``optimizer.policy_rate``, which goes before."""
    worth: float = math.inf
    """Loss of a motion that is worth going on with: a run that stays above begins anew; see ``optimizer.restart_above``, which goes
    before."""
    endurance: int = 1
    """Length of the evaluations that choose the best policy, in episodes; see ``train.endurance``, which goes before."""
    lasting: Lasting | None = None
    """Decides in those that are longer than an episode whether a motion lasts; that is better than one that does not."""
    build: dict[str, Any] = field(default_factory=dict)
    """Arguments of :func:`softmpm.build` that the task decides: formulation and contact."""
    source: Source | None = None
    """File of the robot, None if it is made by code."""

    def __post_init__(self):
        for name, region in self.regions.items():
            particles(f"task region {name}", region)
        if not (math.isfinite(self.body_length) and self.body_length > 0):
            raise ValueError(f"task body_length must be > 0 m, got {self.body_length}.")
        path = Path([k * self.control_period for k in range(self.control_steps + 1)], [], torch.empty(0))
        for term in self.objective.terms:
            term.window(path)  # raises if no state of the episode lies in it

    @property
    def seconds(self) -> float:
        """Length of an episode [s]."""
        return self.control_steps * self.substeps * self.scene.dt

    @property
    def control_period(self) -> float:
        """Time between two decisions [s]."""
        return self.substeps * self.scene.dt


def clock(conf: TaskConf, scene: softmpm.Scene) -> tuple[softmpm.Scene, int, int]:
    """Choose the substep: the scene with its ``dt``, control steps, substeps in each."""
    substeps = math.ceil(conf.control_period / (conf.safety * softmpm.stable_dt(scene)))
    scene = dataclasses.replace(scene, dt=conf.control_period / substeps)
    return scene, max(1, round(conf.seconds / conf.control_period)), substeps


def material(conf: TaskConf) -> Solid:
    """The material that the settings describe."""
    shear = conf.young / (2 * (1 + conf.poisson))
    viscosity = conf.viscosity or conf.retardation * shear
    law = LAWS[conf.law]
    return law(density=conf.density, young=conf.young, poisson=conf.poisson, viscosity=viscosity)


def filled(conf: TaskConf, polygons: Sequence[np.ndarray]) -> softmpm.Particles:
    """Particles half a cell apart in the union of polygons."""
    return softmpm.polygons(polygons, conf.spacing / 2, cut_cells=conf.cut_cells)
