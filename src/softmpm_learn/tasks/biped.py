"""A walker in 2D: a rounded body on a hind and a front leg. Sizes and materials are our own choice."""

from dataclasses import dataclass

import numpy as np

from softmpm import Body, Muscle
from softmpm_learn.tasks.outline import HALVES, foot, legs, smooth
from softmpm_learn.tasks.task import Task, filled, material
from softmpm_learn.tasks.walker import EDGE, WalkerConf, track, walker_task

TORSO = (
    *((0.000, 0.165), (0.018, 0.125), (0.075, 0.110), (0.150, 0.107), (0.225, 0.110), (0.282, 0.125)),
    *((0.300, 0.165), (0.275, 0.200), (0.210, 0.213), (0.150, 0.215), (0.090, 0.213), (0.025, 0.200)),
)  # x, y [m], feet at y = 0
LEGS = {"hind": ((0.065, 0.15), (0.050, 0.0)), "front": ((0.235, 0.15), (0.250, 0.0))}  # hip and sole [m]
LEG_WIDTH = np.array(
    [(0.0, 0.090), (0.4, 0.075), (0.85, 0.070), (1.0, 0.078), (1.1, 0.078)]
)  # way down from the hip, width [m]; below the sole it is cut off
LEG_MUSCLE = (0.12, 1.01)


@dataclass(kw_only=True)
class BipedConf(WalkerConf):
    """A two-legged walker that walks to the right."""

    name: str = "biped"


def biped(conf: BipedConf) -> Task:
    """Build the walker: about 1,200 particles as a draft, 3,000 at the standard resolution."""
    limbs = legs(LEGS, LEG_WIDTH)
    shape = filled(conf, [smooth(TORSO), *(foot(limb.outline(), EDGE) for limb in limbs.values())])
    rest = shape.positions
    regions = {name: limb.part(rest, *LEG_MUSCLE) for name, limb in limbs.items()}
    muscles = [
        Muscle(
            particles=limb.part(rest, *LEG_MUSCLE, side),
            direction=limb.direction(*LEG_MUSCLE),
            strength=conf.strength,
            name=f"{name} leg, {half}",
        )
        for name, limb in limbs.items()
        for side, half in HALVES.items()
    ]
    regions["body"] = np.setdiff1d(np.arange(len(rest)), np.concatenate(list(regions.values())))
    grid, walls, height = track(conf)
    body = Body(shape.moved((0.2, height)), material(conf))
    return walker_task(conf, grid, walls, [body], muscles, rest=rest, regions=regions, torso=regions["body"])
