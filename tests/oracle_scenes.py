"""Scenes, random states and differences for the tests of the float64 oracle."""

import itertools

import numpy as np
import pytest
import torch

from softmpm.scene.actuators import Muscle
from softmpm.scene.materials import FixedCorotated, NeoHookean
from softmpm.scene.scene import Body, Grid, Particles, Scene, Wall
from softmpm.state import Params, State

DX = 0.1
DIMS = pytest.mark.parametrize("dim", [2, 3])
MATERIALS = {"neo_hookean": NeoHookean, "fixed_corotated": FixedCorotated}


def f64(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def randn(*shape, seed=0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def difference(f, at: torch.Tensor, d: torch.Tensor, h: float) -> torch.Tensor:
    """Directional derivative by a central difference of sixth order."""
    terms = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))
    return sum(c * (f(at + k * h * d) - f(at - k * h * d)) for k, c in terms) / h


def assert_same(got: State, want: State, limit: float) -> None:
    """The particles of two states agree within this limit."""
    for a, b in zip(got[:4], want[:4], strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=limit)


def slopes(
    losses, inputs: dict, along: dict, h: float, worlds: dict | None = None
) -> dict[str, torch.Tensor]:
    """Directional derivative by each input, as :func:`difference` gives it, of one call in which all steps are worlds side by side.

    Args:
        losses: Function of inputs for copies of the worlds, one copy after the other; gives the loss of each copy.
        inputs: Values by name.
        along: Direction of each.
        worlds: Number of the axis ``world`` of those in which it is not the first.
    """
    steps = f64([1, -1, 2, -2, 3, -3])
    weights = f64([3 / 4, -3 / 4, -3 / 20, 3 / 20, 1 / 60, -1 / 60])
    given = {}
    for k, (name, value) in enumerate(inputs.items()):
        copies = torch.stack([value] * (len(inputs) * len(steps)))
        copies[k * len(steps) :][: len(steps)] += h * torch.einsum("k,...->k...", steps, along[name])
        given[name] = torch.cat(copies.unbind(), dim=(worlds or {}).get(name, 0))
    return dict(zip(inputs, losses(given).view(-1, len(steps)) @ weights / h, strict=True))


def tiny(dim: int, laws=("neo_hookean", "fixed_corotated"), **changes) -> Scene:
    """Two small bodies that share nodes; nothing else unless asked for."""
    lattice = np.array(list(itertools.product(*(range(n) for n in (3, 2, 2)[:dim]))), dtype=float)
    rng, bodies = np.random.default_rng(0), []
    for corner, law in ((0.37, laws[0]), (0.5, laws[-1])):
        material = MATERIALS[law](density=1.2, young=80.0, poisson=0.3)
        positions = corner + 0.05 * lattice + rng.uniform(-0.01, 0.01, lattice.shape)
        bodies.append(Body(Particles(positions, rng.uniform(0.5, 1.5, len(lattice)) * 0.05**dim), material))
    settings = dict(grid=Grid(shape=(11, 10, 12)[:dim], spacing=DX), bodies=bodies, dt=1e-3)
    return Scene(**(settings | changes))


def full(dim: int, laws=("neo_hookean", "fixed_corotated")) -> Scene:
    """:func:`tiny` with everything a scene may have: overlapping muscles, three kinds of wall, damping."""
    count, up = (12, 24)[dim - 2], (0.0, 1.0, 0.0)[:dim]
    return tiny(
        dim,
        laws,
        muscles=[
            Muscle(particles=np.arange(count * 2 // 3), direction=(0.0, 1.0, 0.3)[:dim], strength=10.0),
            Muscle(particles=np.arange(count // 3, count), direction=(1.0, 0.5, 0.2)[:dim], strength=8.0),
        ],
        walls=[
            Wall(normal=up, offset=0.41, contact="separate", friction=0.4),
            Wall(normal=(-1.0, 0.3, 0.1)[:dim], offset=-0.45, contact="slip"),
            Wall(normal=(1.0, 0.0, 0.0)[:dim], offset=0.3, contact="stick"),
        ],
        gravity=(0.3, -9.8, 0.2)[:dim],
        damping=0.7,
    )


def rest(scene: Scene, worlds=1) -> tuple[State, Params]:
    x = torch.from_numpy(np.concatenate([body.particles.positions for body in scene.bodies]))
    x = x.expand(worlds, *x.shape)
    F = torch.eye(x.shape[-1], dtype=torch.float64).expand(*x.shape, x.shape[-1])
    materials = [body.material for body in scene.bodies for _ in range(len(body.particles))]
    columns = ([getattr(m, name) for m in materials] for name in Params._fields)
    return State(x, torch.zeros_like(x), torch.zeros_like(F), F), Params(*(f64(c) for c in columns))


def shaken(scene: Scene, worlds=1, noise=1.0) -> tuple[State, Params]:
    """A random state and material near the scene's."""
    (x, v, C, F, *_), params = rest(scene, worlds)
    by = [noise * randn(*t.shape, seed=30 + k) for k, t in enumerate((x, v, C, F))]
    start = State(x + 0.01 * by[0], 0.5 * by[1], 2.0 * by[2], F + 0.1 * by[3])
    factor = 1 + 0.1 * randn(3, *x.shape[:2], seed=40)
    return start, Params(*(value * factor[k] for k, value in enumerate(params)))


def masses(scene: Scene, params: Params) -> torch.Tensor:
    return params.density * torch.from_numpy(np.concatenate([b.particles.volume for b in scene.bodies]))
