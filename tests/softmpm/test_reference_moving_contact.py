"""The float64 reference of contact at surface points on the moving grid: interpolation, momentum and energy."""

import math

import numpy as np
import pytest
import torch
from reference_scenes import DX, f64, randn, rest

from softmpm import reference, reference_moving_contact
from softmpm.reference_contact import across_walls
from softmpm.scene.materials import NeoHookean
from softmpm.scene.scene import Body, Grid, Scene, Wall
from softmpm.scene.shapes import box

DIMS = pytest.mark.parametrize("dim", [2, 3])


def floor(dim: int, friction=0.5) -> Scene:
    """A block over a rough floor and next to a rough side wall."""
    shape = box((0.33, 0.3, 0.34)[:dim], (0.62, 0.5, 0.63)[:dim], spacing=DX / 2)
    up, aside = (0.0, 1.0, 0.0)[:dim], (1.0, 0.2, 0.0)[:dim]
    walls = [Wall(normal=up, offset=0.3, friction=friction), Wall(normal=aside, offset=0.3945, friction=0.2)]
    body = Body(shape, NeoHookean(density=1.2, young=80.0, poisson=0.3))
    return Scene(grid=Grid(shape=(11, 10, 11)[:dim], spacing=DX), bodies=[body], walls=walls, dt=1e-3)


def nodes(scene: Scene) -> torch.Tensor:
    axes = [torch.arange(n, dtype=torch.float64) * DX for n in scene.grid.shape]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).flatten(0, -2)


def interpolated(scene: Scene, x: torch.Tensor, mass: torch.Tensor, field: torch.Tensor) -> torch.Tensor:
    node, b = reference_moving_contact.shares(scene, x, mass)
    weights = b * mass.gather(1, node.flatten(1)).view(node.shape)
    return torch.einsum("wpn,wpn...->wp...", weights, torch.stack([field[w][node[w]] for w in range(len(x))]))


@DIMS
def test_linear_fields_are_exact_whatever_the_masses(dim):
    """Constant ones to rounding, linear ones but for ε, with empty nodes and masses over twelve decades."""
    scene = floor(dim)
    count = math.prod(scene.grid.shape)
    mass = 10 ** (3 * randn(2, count))
    mass[:, ::7] = 0.0
    x = 0.45 + 0.05 * randn(2, 9, dim)
    ones, places = torch.ones(2, count, 1).double(), nodes(scene).expand(2, -1, -1)
    torch.testing.assert_close(
        interpolated(scene, x, mass, ones)[..., 0], torch.ones(2, 9).double(), rtol=0, atol=1e-9
    )
    even = torch.rand(2, count, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.1
    torch.testing.assert_close(interpolated(scene, x, even, places), x, rtol=0, atol=1e-5 * DX)
    _, b = reference_moving_contact.shares(scene, x, torch.full((2, count), 0.7).double())
    plain = torch.stack([weight for _, weight, _ in reference.stencil(scene, x)], -1)
    torch.testing.assert_close(0.7 * b, plain, rtol=0, atol=1e-5)


@DIMS
def test_shares_stay_bounded_where_mass_vanishes(dim):
    """The share of a node tends to a limit as it loses its mass, and its weight to zero."""
    scene = floor(dim)
    x = f64([[[0.42, 0.43, 0.44][:dim]]])
    mass = torch.ones(1, math.prod(scene.grid.shape)).double()
    found = []
    for lightest in (1e-6, 1e-12, 0.0):
        light = mass.clone()
        node, _ = reference_moving_contact.shares(scene, x, mass)
        light[0, node[0, 0, ::3]] = lightest
        found.append(reference_moving_contact.shares(scene, x, light)[1])
    assert torch.isfinite(found[2]).all()
    torch.testing.assert_close(found[1], found[2], rtol=0, atol=1e-9)
    torch.testing.assert_close(found[0], found[2], rtol=0, atol=1e-3)


def met(scene: Scene, speed: float, gap: float):
    """Masses, velocities and what the walls make of them, for a random motion of a block that is ``gap`` away from the floor."""
    state, params = rest(scene)
    points = reference_moving_contact.surface_points(scene)
    x = reference_moving_contact.places(scene, points, state)
    x = x + gap * f64([0.0, 1.0, 0.0][: scene.grid.dim])
    mass = params.density * torch.from_numpy(np.concatenate([b.particles.volume for b in scene.bodies]))
    push = mass[:, None] * speed * (randn(*state.v.shape) - f64([0.0, 2.0, 0.0][: scene.grid.dim]))
    of_nodes, momentum = reference.p2g(scene, state.x, mass.expand(1, -1), push, torch.zeros_like(state.C))
    v = momentum / torch.where(of_nodes > 0, of_nodes, torch.ones_like(of_nodes))[..., None]
    after = reference_moving_contact.meet(scene, points, x, across_walls(scene, x), of_nodes, v)
    return of_nodes[..., None], v, points, after


@DIMS
def test_contact_gives_the_momentum_of_its_impulses(dim):
    """Σ m (v' − v*) = Σ A J."""
    mass, v, points, (after, _, _, J) = met(floor(dim), speed=10.0, gap=0.0)
    assert (J != 0).any(-1).any(2).all()
    torch.testing.assert_close(
        (mass * (after - v)).sum(1), (points.area[:, None] * J).sum((1, 2)), rtol=1e-9, atol=0
    )


@DIMS
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_contact_takes_energy_from_the_moving_grid(dim, friction):
    """Points that are not inside a wall and whose anchors are where they are gain no kinetic energy."""
    for speed in (0.3, 3.0, 30.0):
        mass, v, _, (after, *_, J) = met(floor(dim, friction), speed, gap=1e-9)
        before, later = ((mass * one**2).sum() for one in (v, after))
        assert (J != 0).any() and later < before
