"""A tapered arm in 2D, clamped at its foot, that reaches a place with its tip.

Three segments, each with a muscle on its left and on its right. It lies on a table: no gravity by default.
Sizes and materials are our own choice.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from softmpm import Body, Grid, Muscle, Scene, Wall, neighbour_pairs
from softmpm_learn.objective import Effort, Objective, Reach, Still, Stretch
from softmpm_learn.setting_checks import not_negative
from softmpm_learn.tasks.outline import Limb
from softmpm_learn.tasks.task import LASTING, STRETCH, Task, TaskConf, clock, filled, material

BASE = (0.45, 0.0625)  # where the arm leaves the clamp [m]
LENGTH = 0.36  # clamp to tip [m]
WIDTH = (0.075, 0.050)  # at the clamp and at the tip [m]
SEGMENTS = {"lower": (0.0, 0.34), "middle": (0.34, 0.67), "upper": (0.67, 1.01)}
FADE = 0.1  # what a muscle did longer ago counts less [s]
QUIET = 0.3  # size of the first activations
TIP = 0.92  # the tip's particles start this far along the arm


@dataclass(kw_only=True)
class ArmConf(TaskConf):
    """An arm that reaches a place."""

    name: str = "arm"
    seconds: float = 2.0
    """Length of an episode [s]: long enough to come to rest, or the arm drifts through the goal."""
    gravity: float = 0.0
    """Downward acceleration [m/s²]; 0: the arm lies on a table."""
    damping: float = 6.0
    """Rate at which velocity decays [1/s]: an arm that swings for long is hard to stop at its goal."""
    effort: float = 1e-5
    """Weight of the mean squared activation in the loss [m²]; decides between motions that are equally good."""
    strength: float = 8e3
    """Stress of a muscle at full activation [Pa]."""
    goal: list[float] = field(default_factory=lambda: [0.60, 0.35])
    """Goal of the tip: x and y [m]; at rest it is at (0.45, 0.41)."""
    hold: float = 1.2
    """Time at the end of the episode during which the tip should stay at the goal [s], at most all of it."""
    still: float = 5e-2
    """Weight of the tip's mean squared speed during that time in the loss [s²]."""
    stretch: float = 10.0
    """Weight of stretches beyond 1.6 in the loss [m²]: an arm at the limit of fracture cannot learn, since every step fails."""

    def __post_init__(self):
        super().__post_init__()
        not_negative("task", self, "hold", "still", "stretch")
        if len(self.goal) != 2 or not all(math.isfinite(c) for c in self.goal):
            raise ValueError(
                f"task.goal must be two numbers, x and y, such as task.goal=[0.6,0.35], got {self.goal}."
            )
        away = math.dist(self.goal, BASE)
        if away > LENGTH or self.goal[1] < BASE[1]:
            raise ValueError(
                f"task.goal must be above the clamp and at most the arm's {LENGTH} m from {BASE}, "
                f"got {self.goal}, which is {away:.2f} m away."
            )


def arm(conf: ArmConf) -> Task:
    """Build the arm: about 700 particles as a draft, 1,700 at the standard resolution."""
    root = 3 * conf.spacing  # so much of the arm is inside the clamp
    way = np.array([-root / LENGTH, 0.0, 1.0])
    line = np.array(BASE) + way[:, None] * np.array([0.0, LENGTH])
    limb = Limb(line[1:], np.array(WIDTH), round_tip=True)
    clamped = Limb(line[:2], np.array([WIDTH[0], WIDTH[0]]))
    shape = filled(conf, [limb.outline(), clamped.outline()])
    rest = shape.positions
    regions = {name: limb.part(rest, start, end) for name, (start, end) in SEGMENTS.items()}
    muscles = [
        Muscle(
            particles=limb.part(rest, start, end, side),
            direction=(0.0, 1.0),
            strength=conf.strength,
            name=f"{segment} segment, {half}",
        )
        for segment, (start, end) in SEGMENTS.items()
        for side, half in ((1, "left"), (-1, "right"))
    ]
    nodes = conf.cells_per_metre
    scene = Scene(
        grid=Grid(shape=(round(0.9 * nodes), round(0.7 * nodes)), spacing=conf.spacing),
        bodies=[Body(shape, material(conf))],
        muscles=muscles,
        walls=[Wall(normal=(0.0, 1.0), offset=BASE[1], contact="stick")],
        gravity=(0.0, -conf.gravity),
        damping=conf.damping,
        dt=conf.control_period,
    )
    scene, control_steps, substeps = clock(conf, scene)
    goal, tip = np.array(conf.goal, dtype=float), limb.part(rest, TIP, 1.01)
    held = max(0.0, conf.seconds - conf.hold)
    return Task(
        name="arm",
        scene=scene,
        control_steps=control_steps,
        substeps=substeps,
        regions=regions,
        objective=Objective(
            Reach(particles=tip, target=goal, begin=held),
            Still(particles=tip, weight=conf.still, begin=held),
            Effort(weight=conf.effort),
            Stretch(weight=conf.stretch, pairs=neighbour_pairs(scene), rest=rest, most=STRETCH),
        ),
        body_length=LENGTH,
        goal=goal,
        fade=FADE,
        gain=QUIET,
        clock=False,  # its rhythm would have to be unlearned: what sees it never quite rests
        endurance=LASTING,
        build=conf.build,
    )
