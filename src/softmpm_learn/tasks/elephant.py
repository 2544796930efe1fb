"""An elephant in 2D that learns to walk to the right. Outline, sizes and materials are our own choice.

As soft as a gel, so that it sinks a little under its own weight. Each leg is split into a front and a back
half: when one shortens and the other lengthens, the leg swings. Two more pairs of muscles bend the trunk.
"""

from dataclasses import dataclass

import numpy as np

from softmpm import Body, Muscle
from softmpm_learn.tasks.outline import HALVES, Limb, foot, legs, smooth, smooth_line
from softmpm_learn.tasks.task import Task, filled, material
from softmpm_learn.tasks.walker import EDGE, WalkerConf, track, walker_task

LENGTH = 0.44  # tail to trunk [m]; all that follows is in body lengths, feet at y = 0
TORSO = (
    *((0.050, 0.320), (0.030, 0.420), (0.048, 0.515), (0.110, 0.590), (0.210, 0.630), (0.330, 0.637)),
    *((0.440, 0.615), (0.510, 0.590), (0.560, 0.600), (0.620, 0.640), (0.690, 0.652), (0.755, 0.622)),
    *((0.800, 0.555), (0.815, 0.480), (0.790, 0.410), (0.740, 0.385), (0.690, 0.360), (0.655, 0.310)),
    *((0.590, 0.270), (0.480, 0.255), (0.330, 0.245), (0.200, 0.255), (0.100, 0.270)),
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
LEG_WIDTH = np.array(
    [(0.0, 0.130), (0.5, 0.100), (0.8, 0.095), (0.94, 0.103), (1.0, 0.106), (1.1, 0.106)]
)  # way down from the hip, width; below the sole it is cut off
LEG = (0.10, 1.01)  # way along a leg, from below the hip to the sole
MUSCLES = {
    "leg1": {"hind leg 1": LEG},
    "leg2": {"hind leg 2": LEG},
    "leg3": {"foreleg 1": LEG},
    "leg4": {"foreleg 2": LEG},
    "trunk": {"upper trunk": (0.25, 0.60), "lower trunk": (0.60, 1.01)},
}  # parts of each limb that have a pair of muscles, and their ways along it


@dataclass(kw_only=True)
class ElephantConf(WalkerConf):
    """An elephant that walks to the right."""

    name: str = "elephant"


def elephant(conf: ElephantConf) -> Task:
    """Build the elephant: about 2,000 particles as a draft, 5,200 at the standard resolution."""
    limbs, outlines = limbs_and_outlines()
    shape = filled(conf, [LENGTH * outline for outline in outlines])
    rest = shape.positions
    regions, muscles = actuate(rest, limbs, conf.strength)
    grid, walls, height = track(conf)
    body = Body(shape.moved((0.22, height)), material(conf))
    return walker_task(conf, grid, walls, [body], muscles, rest=rest, regions=regions, torso=regions["body"])


def actuate(
    rest: np.ndarray, limbs: dict[str, Limb], strength: float
) -> tuple[dict[str, np.ndarray], list[Muscle]]:
    """A region for each limb and one for the rest of the body; muscles in pairs, in the front and the back half of a limb."""
    regions, muscles, free = {}, [], np.ones(len(rest), dtype=bool)
    for name, limb in limbs.items():
        for part, way in MUSCLES[name].items():
            for side, half in HALVES.items():
                index = limb.part(rest, *way, side)
                index = index[free[index]]  # at the hips two legs meet
                muscles.append(
                    Muscle(
                        particles=index,
                        direction=limb.direction(*way),
                        strength=strength,
                        name=f"{part}, {half}",
                    )
                )
        taken = limb.part(rest, min(start for start, _ in MUSCLES[name].values()), 1.01)
        regions[name] = taken[free[taken]]
        free[taken] = False
    return regions | {"body": np.flatnonzero(free)}, muscles


def limbs_and_outlines() -> tuple[dict[str, Limb], list[np.ndarray]]:
    """Legs and trunk [m] for the muscles; outlines of everything, in body lengths, for the particles."""
    trunk, tail = smooth_line(TRUNK), smooth_line(TAIL)
    limbs = legs(LEGS, LEG_WIDTH)
    limbs["trunk"] = Limb(trunk[:, :2], trunk[:, 2], round_tip=True)
    outlines = [smooth(TORSO), Limb(tail[:, :2], tail[:, 2], round_tip=True).outline()]
    for name, limb in limbs.items():
        outline = limb.outline()
        outlines.append(outline if name == "trunk" else foot(outline, EDGE / LENGTH))
    return {
        name: Limb(LENGTH * limb.line, LENGTH * limb.width, limb.round_tip) for name, limb in limbs.items()
    }, outlines
