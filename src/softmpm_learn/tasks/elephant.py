"""An elephant in 2D that learns to walk to the right. Outline, sizes and materials are our own choice.

As soft as a gel, so that it sinks a little under its own weight. Each leg is split into a front and a back
half: when one shortens and the other lengthens, the leg swings. Two more pairs of muscles bend the trunk.
"""

from dataclasses import dataclass

import numpy as np

from softmpm import Body, Grid, Muscle, NeoHookean, Particles, Scene, Wall
from softmpm_learn.objective import Effort, Progress
from softmpm_learn.tasks.outline import Limb, fill, smooth, smooth_line
from softmpm_learn.tasks.task import Task, TaskConf, clock

LENGTH = 0.44  # tail to trunk [m]; all that follows is in body lengths, feet at y = 0
TORSO = (
    *(
        (0.050, 0.320),
        (0.030, 0.420),
        (0.048, 0.515),
        (0.110, 0.590),
        (0.210, 0.630),
        (0.330, 0.637),
        (0.440, 0.615),
    ),
    *(
        (0.510, 0.590),
        (0.560, 0.600),
        (0.620, 0.640),
        (0.690, 0.652),
        (0.755, 0.622),
        (0.800, 0.555),
        (0.815, 0.480),
    ),
    *(
        (0.790, 0.410),
        (0.740, 0.385),
        (0.690, 0.360),
        (0.655, 0.310),
        (0.590, 0.270),
        (0.480, 0.255),
        (0.330, 0.245),
    ),
    *((0.200, 0.255), (0.100, 0.270)),
)  # rump, back, neck, forehead, chin, chest, belly: x, y
TRUNK = (
    *((0.700, 0.560, 0.100), (0.770, 0.495, 0.130), (0.815, 0.410, 0.118), (0.842, 0.320, 0.096)),
    *((0.855, 0.215, 0.080), (0.885, 0.130, 0.072), (0.955, 0.110, 0.064)),
)  # x, y, width
TAIL = ((0.110, 0.530, 0.040), (0.045, 0.490, 0.048), (0.008, 0.410, 0.044), (-0.010, 0.310, 0.042))
LEGS = {
    "leg1": ((0.135, 0.36), (0.085, 0.0)),
    "leg2": ((0.215, 0.36), (0.262, 0.0)),
    "leg3": ((0.520, 0.36), (0.462, 0.0)),
    "leg4": ((0.595, 0.36), (0.640, 0.0)),
}  # hip and sole, from the back
LEG_WIDTH = (
    (0.0, 0.130),
    (0.5, 0.100),
    (0.8, 0.095),
    (0.94, 0.103),
    (1.0, 0.106),
    (1.1, 0.106),
)  # way down, width
LEG_MUSCLE = (0.10, 1.0)  # from just below the hip to the sole
TRUNK_MUSCLES = ((0.25, 0.60), (0.60, 1.0))  # way along the trunk


@dataclass(kw_only=True)
class ElephantConf(TaskConf):
    """An elephant that walks to the right."""

    name: str = "elephant"
    friction: float = 0.8
    """Coulomb friction of the floor [-]."""


def elephant(conf: ElephantConf) -> Task:
    """Build the elephant: about 2,100 particles as a draft, 5,400 at the standard resolution."""
    floor = 0.0625
    limbs, outlines = limbs_and_outlines()
    shift = np.array(
        [0.22, floor + 0.5 * conf.spacing]
    )  # the feet's particles half a cell over the floor's nodes
    rest = fill([LENGTH * outline for outline in outlines], conf.spacing / 2).positions
    regions, muscles = {}, []
    for name, limb in limbs.items():
        parts = TRUNK_MUSCLES if name == "trunk" else (LEG_MUSCLE,)
        regions[name] = limb.part(rest, parts[0][0], parts[-1][1] + 0.01)
        for start, end in parts:
            direction = limb.direction(start, end)
            for side in (1, -1):
                index = limb.part(rest, start, end + 0.01, side)
                muscles.append(Muscle(particles=index, direction=direction, strength=conf.strength))
    regions["body"] = np.setdiff1d(np.arange(len(rest)), np.concatenate(list(regions.values())))
    body = Body(
        Particles(rest + shift, (conf.spacing / 2) ** 2),
        NeoHookean(density=conf.density, young=conf.young, poisson=conf.poisson),
    )
    scene = Scene(
        grid=Grid(
            shape=(round(1.5 * conf.resolution.value), round(0.5 * conf.resolution.value)),
            spacing=conf.spacing,
        ),
        bodies=[body],
        muscles=muscles,
        walls=[
            Wall(normal=(0.0, 1.0), offset=floor, contact="separate", friction=conf.friction),
            Wall(normal=(1.0, 0.0), offset=0.05),
            Wall(normal=(-1.0, 0.0), offset=-1.45),
        ],
        gravity=(0.0, -conf.gravity),
        damping=conf.damping,
        dt=conf.control_period,
    )
    scene, control_steps, substeps = clock(conf, scene)
    return Task(
        name="elephant",
        scene=scene,
        control_steps=control_steps,
        substeps=substeps,
        regions=regions,
        objective=Progress(terms=(Effort(conf.effort),)),
        body_length=float(np.ptp(rest[:, 0])),
    )


def limbs_and_outlines() -> tuple[dict[str, Limb], list[np.ndarray]]:
    """Legs and trunk [m] for the muscles; outlines of everything, in body lengths, for the particles."""
    trunk, tail = smooth_line(TRUNK), smooth_line(TAIL)
    way, width = np.array(LEG_WIDTH).T
    limbs = {
        name: Limb(np.array(hip) + way[:, None] * (np.array(sole) - np.array(hip)), width)
        for name, (hip, sole) in LEGS.items()
    }
    limbs["trunk"] = Limb(trunk[:, :2], trunk[:, 2], round_tip=True)
    outlines = [smooth(TORSO), Limb(tail[:, :2], tail[:, 2], round_tip=True).outline()]
    for name, limb in limbs.items():
        outline = limb.outline()
        if name != "trunk":
            outline[:, 1] = np.maximum(outline[:, 1], 0.0)  # flat soles
        outlines.append(outline)
    return {
        name: Limb(LENGTH * limb.line, LENGTH * limb.width, limb.round_tip) for name, limb in limbs.items()
    }, outlines
