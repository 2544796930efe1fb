"""Random scenes as plain data, and the scene of such data.

A plan is a dictionary of numbers and names, so that a failing one can be printed, stored as JSON and repeated. Each names one of a
few specialisations, since every other combination of dimension, precision, laws, muscles and walls is compiled for seconds.
"""

import dataclasses
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st

import softmpm

Plan = dict[str, Any]
LAWS = {"neo_hookean": softmpm.NeoHookean, "fixed_corotated": softmpm.FixedCorotated}
BOTH = ("neo_hookean", "fixed_corotated")


@dataclasses.dataclass(frozen=True)
class Special:
    """Properties of a scene that its kernels are compiled for."""

    dim: int
    dtype: torch.dtype
    scheme: str
    laws: tuple[str, ...]
    slots: int = 0
    contacts: tuple[str, ...] = ()
    damping: bool = False


_FULL = dict(laws=BOTH, slots=2, contacts=("separate", "slip"), damping=True)
SPECIALS = {
    "fast": Special(2, torch.float32, "fast", **_FULL),
    "plain": Special(2, torch.float64, "plain", **_FULL),
    "fast double": Special(2, torch.float64, "fast", **_FULL),
    "solid": Special(3, torch.float32, "fast", **_FULL),
    "free": Special(2, torch.float64, "plain", ("fixed_corotated",)),
    "free damped": Special(2, torch.float32, "fast", ("neo_hookean",), damping=True),
    "free solid": Special(3, torch.float64, "plain", ("neo_hookean",)),
    "sticky": Special(2, torch.float32, "plain", ("fixed_corotated",), 1, ("stick", "separate")),
}
"""All have gravity; the first four are those of ``helpers.busy_scene``."""


def power(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers of every magnitude from 10^low to 10^high."""
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


unit = st.floats(0.0, 1.0)
seeds = st.integers(0, 2**32 - 1)

bodies = st.fixed_dictionaries(
    dict(
        shape=st.sampled_from(["box", "ball", "lone", "scattered"]),
        middle=st.tuples(unit, unit, unit),
        size=st.tuples(unit, unit, unit),
        cells=st.floats(0.3, 1.2),  # distance of neighbouring particles
        young=power(0, 9),
        poisson=st.floats(-0.9, 0.4999),
        density=power(-3, 5),
        seed=seeds,
    )
)
walls = st.fixed_dictionaries(
    dict(
        angle=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)),
        depth=unit,
        friction=power(-3, 2),
    )
)
muscles = st.fixed_dictionaries(dict(angle=st.floats(0, 6.3), strength=st.floats(-3, 10), share=unit))
scenes = st.fixed_dictionaries(
    dict(
        special=st.sampled_from(list(SPECIALS)),
        nodes=st.tuples(*3 * (st.integers(6, 13),)),
        spacing=power(-3, 2),
        bodies=st.tuples(bodies, bodies),
        walls=st.tuples(walls, walls),
        muscles=st.tuples(muscles, muscles),
        gravity=st.tuples(st.floats(-10, 10), power(-6, 3), st.floats(-10, 10)),
        damping=power(-3, 3),
        dt=unit.map(
            lambda share: 0.01 + 1.15 * share if share < 0.8 else 0.95 + 10 * (share - 0.8)
        ),  # of the stable step
    )
)


def scene_of(plan: Plan) -> softmpm.Scene:
    """The scene of a plan; raises what its parts raise."""
    special = SPECIALS[plan["special"]]
    dim, dx = special.dim, plan["spacing"]
    grid = softmpm.Grid(shape=tuple(plan["nodes"][:dim]), spacing=dx)
    nodes = grid.shape
    parts = [
        softmpm.Body(_particles(body, nodes, dx, (k, len(special.laws))), _material(body, law))
        for k, (body, law) in enumerate(zip(plan["bodies"], special.laws, strict=False))
    ]
    count = sum(len(part.particles) for part in parts)
    young = plan["bodies"][0]["young"]
    scene = softmpm.Scene(
        grid=grid,
        bodies=parts,
        muscles=[_muscle(m, k, count, dim, young) for k, m in enumerate(plan["muscles"][: special.slots])],
        walls=[_wall(w, kind, nodes, dx) for w, kind in zip(plan["walls"], special.contacts, strict=False)],
        gravity=tuple(plan["gravity"][:dim]),
        damping=plan["damping"] if special.damping else 0.0,
        dt=1.0,
    )
    return dataclasses.replace(scene, dt=plan["dt"] * softmpm.stable_dt(scene).dt)


def _particles(body: Plan, nodes: tuple[int, ...], dx: float, slab: tuple[int, int]) -> softmpm.Particles:
    """A shape of a few cells in its own slab of the grid, so that two bodies never overlap."""
    dim, apart = len(nodes), body["cells"] * dx
    low, high = 0.6 * np.ones(dim), np.array(nodes) - 1.6
    width = (high[0] - low[0]) / slab[1]
    low[0], high[0] = low[0] + slab[0] * width, low[0] + (slab[0] + 1) * width
    low, high = low * dx, high * dx
    half = np.minimum((0.3 + np.array(body["size"][:dim])) * dx, 0.49 * (high - low))
    middle = low + half + np.array(body["middle"][:dim]) * (high - low - 2 * half)
    if body["shape"] == "lone":
        return softmpm.Particles(middle[None], apart**dim)
    if body["shape"] == "scattered":
        random = np.random.default_rng(body["seed"])
        return softmpm.Particles(middle + half * random.uniform(-1, 1, (7, dim)), apart**dim)
    if body["shape"] == "ball":
        return softmpm.ball(middle, float(half.min()), min(apart, float(half.min())))
    return softmpm.box(middle - half, middle + half, min(apart, 2 * float(half.min())))


def _material(body: Plan, law: str) -> softmpm.NeoHookean | softmpm.FixedCorotated:
    return LAWS[law](density=body["density"], young=body["young"], poisson=body["poisson"])


def _muscle(muscle: Plan, k: int, count: int, dim: int, young: float) -> softmpm.Muscle:
    """All of them overlap on the middle particle."""
    reach = max(1, round(muscle["share"] * count))
    index = np.arange(count)[:reach] if k == 0 else np.arange(count)[-reach:]
    direction = (np.cos(muscle["angle"]), np.sin(muscle["angle"]), 0.3)[:dim]
    return softmpm.Muscle(
        particles=np.union1d(index, [count // 2]), direction=direction, strength=muscle["strength"] * young
    )


def _wall(wall: Plan, kind: str, nodes: tuple[int, ...], dx: float) -> softmpm.Wall:
    """Anywhere on the grid, at any angle; particles may start inside."""
    normal = np.array(wall["angle"][: len(nodes)])
    normal[1] += 0.0 if np.abs(normal).max() > 1e-3 else 1.0
    normal /= np.linalg.norm(normal)
    reach = normal * (np.array(nodes) - 1) * dx
    low, high = np.minimum(reach, 0).sum(), np.maximum(reach, 0).sum()
    friction = wall["friction"] if kind == "separate" else 0.0
    return softmpm.Wall(
        normal=normal, offset=low + 0.9 * wall["depth"] * (high - low), contact=kind, friction=friction
    )
