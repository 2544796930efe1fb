"""Parts of every robot on legs: its settings, its track, its objective and the task made of them."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import softmpm
from softmpm_learn.lasting import Lasting
from softmpm_learn.objective import Effort, Objective, Progress, Stretch, Tilt
from softmpm_learn.setting_checks import not_negative
from softmpm_learn.tasks.task import LASTING, STRETCH, Task, TaskConf, clock

STEP = 0.1
"""Time after which a robot on legs has forgotten what a muscle did [s]: a part of a step."""
VIGOROUS = 3.0
"""Size of the first activations of a robot on legs, with which it steps from the beginning."""
FAINT = 0.3
"""Influence of an encoder's features on these, in units of the clock's: standardised, the features of a body that shakes would drown
its rhythm. Of twenty elephants fourteen got under way, with 1 eight (docs/defaults.md)."""
BRISK = 1e-2
"""Learning rate of a walker's policy. With half of it most of ten elephants still stood after 72 iterations (docs/defaults.md)."""
WORTH = -0.1
"""Loss of a walker that is worth going on with, in units of its length: it has come forward by more than it costs."""
ROOM = 1.0
"""Length of the track at its start and for the robot [m]."""
SOLES = 0.15
"""Part of a walker's height, from below, that belongs to its soles."""
EDGE = 0.012
"""Distance from the corner at which the bevelled edge of a sole begins [m]: one cell as a draft."""


@dataclass(kw_only=True)
class WalkerConf(TaskConf):
    """Settings that robots on legs have besides, and their own defaults: contact that converges (docs/gait.md)."""

    retardation: float = 2e-3
    """Retardation time η/μ of the material [s], instead of ``viscosity``; without it soles flutter. Good value in the reference
    formulation: 4e-3."""
    strength: float = 6e3
    """Stress of a muscle at full activation [Pa]."""
    effort: float = 5e-2
    """Weight of the mean squared activation in the loss [m]; with less, gaits stretch the robot until it breaks."""
    upright: float = 1.0
    """Weight of the squared slope of the torso in the loss [m]; without it a walker ends on its head."""
    stretch: float = 5e4
    """Weight of stretches beyond 1.6 in the loss [m]: a gait that overstretches the robot tears it sooner or later. It is large because
    the term is a mean over thousands of pairs of particles and all moments, of which a few are overstretched; a gait that overstretches
    none pays nothing (docs/learning.md)."""
    friction: float = 0.8
    """Coulomb friction of the floor [-]."""
    seconds: float = 2.0
    """Length of an episode [s]: four steps or five, so that what walks at its end goes on walking."""
    lead: float | None = None
    """Time before the distance counts, to get under way [s]; null is a quarter of the episode."""
    track: float | None = None
    """Length of the track [m], at whose end the simulation stops by name; null: 4 m, or room for three episodes at 1 m/s."""

    def __post_init__(self):
        super().__post_init__()
        not_negative("task", self, "friction", "upright", "stretch")
        last = (max(1, round(self.seconds / self.control_period)) - 1) * self.control_period
        if self.lead is not None and not 0 <= self.lead <= last * (1 + 1e-9):
            raise ValueError(
                f"task.lead must be ≥ 0 and at most {last:g} s, when the last control step of task.seconds begins, or no distance "
                f"counts; got {self.lead}."
            )
        if not (math.isfinite(self.track_length) and self.track_length >= ROOM):
            raise ValueError(f"task.track must be at least {ROOM:g} m, got {self.track}.")

    @property
    def track_length(self) -> float:
        """Length of the track [m]."""
        return max(4.0, ROOM + LASTING * self.seconds) if self.track is None else self.track

    @property
    def on_surface(self) -> bool:
        return self.contact != "nodes"

    @property
    def alarms(self) -> softmpm.Alarms:
        """On the surface without the alarm on the step: single particles in the inner corners of the hips are beyond the limit of a
        lone one, which falls under stretch, in the reference formulation under compression, and their neighbours are not. These
        simulations are stable (docs/gait.md)."""
        alarms = super().alarms
        return dataclasses.replace(alarms, step=None) if self.on_surface else alarms


def walking(conf: WalkerConf, scene: softmpm.Scene, rest: np.ndarray, torso: np.ndarray) -> Objective:
    """Bring the soles far, without effort or overstretching, while the hind and the front quarter of the torso stay level.

    The soles count because they have to step for it. The whole robot also gains by leaning forward, which a gradient that fades takes
    for a step.
    """
    low, high = np.quantile(rest[torso, 0], (0.25, 0.75))
    front, back = torso[rest[torso, 0] > high], torso[rest[torso, 0] < low]
    lead = conf.seconds / 4 if conf.lead is None else conf.lead
    height = rest[:, 1] - rest[:, 1].min()
    return Objective(
        Progress(begin=lead, particles=np.flatnonzero(height <= SOLES * height.max())),
        Effort(weight=conf.effort),
        Tilt(weight=conf.upright, front=front, back=back, rest=rest),
        Stretch(weight=conf.stretch, pairs=softmpm.neighbour_pairs(scene), rest=rest, most=STRETCH),
    )


def track(conf: WalkerConf) -> tuple[softmpm.Grid, list[softmpm.Wall], float]:
    """Grid of a walker, 0.5 m high, and its walls: a floor with friction and a smooth one behind it; and the height of the soles [m].

    The soles lie on spline knots, half a cell above a row of nodes. The floor is at the soles if surface points meet it, and at the
    nodes otherwise. There is no wall at the far end, which a fast walker would run into without a word: it leaves the grid instead, by
    name.
    """
    length, height, margin, nodes, spacing = conf.track_length, 0.5, 0.05, conf.cells_per_metre, conf.spacing
    floor = math.floor(0.0625 * nodes) * spacing
    soles = floor + 0.5 * spacing
    if conf.on_surface:
        floor = soles
    grid = softmpm.Grid(shape=(round(length * nodes), round(height * nodes)), spacing=spacing)
    walls = [
        softmpm.Wall(normal=(0.0, 1.0), offset=floor, friction=conf.friction),
        softmpm.Wall(normal=(1.0, 0.0), offset=margin),
    ]
    return grid, walls, soles


def walker_task(
    conf: WalkerConf,
    grid: softmpm.Grid,
    walls: Sequence[softmpm.Wall],
    bodies: Sequence[softmpm.Body],
    muscles: Sequence[softmpm.Muscle],
    *,
    rest: np.ndarray,
    regions: dict[str, np.ndarray],
    torso: np.ndarray,
) -> Task:
    """The task of a robot that stands on a track, with the hints for learning that all walkers share.

    Args:
        bodies: Its bodies, where they stand on the track.
        rest: Positions of all particles [m], shape (particle, dim), from any origin; the lowest are soles.
        regions: As in :class:`Task`.
        torso: Indices of the particles that should stay level.
    """
    scene = softmpm.Scene(
        grid=grid,
        bodies=bodies,
        muscles=muscles,
        walls=walls,
        gravity=(0.0, -conf.gravity, 0.0)[: grid.dim],
        damping=conf.damping,
        dt=conf.control_period,
    )
    scene, control_steps, substeps = clock(conf, scene)
    length, objective = float(np.ptp(rest[:, 0])), walking(conf, scene, rest, torso)
    progress, _, tilt, _ = objective.terms
    assert isinstance(progress, Progress) and isinstance(tilt, Tilt)
    seconds = control_steps * substeps * scene.dt
    return Task(
        name=conf.name,
        scene=scene,
        control_steps=control_steps,
        substeps=substeps,
        regions=regions,
        objective=objective,
        body_length=length,
        build=conf.build,
        fade=STEP,
        gain=VIGOROUS,
        feature_gain=FAINT,
        rate=BRISK,
        worth=WORTH * length,
        endurance=LASTING,
        lasting=Lasting(progress=progress, tilt=tilt, seconds=seconds),
    )
