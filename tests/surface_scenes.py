"""Scenes and models with contact at surface points, for several tests."""

import numpy as np
import torch

import softmpm
from softmpm import reference_contact

G = 9.81


def block(dim: int, **changes) -> softmpm.Scene:
    """A block on a rough floor and at a rough side wall, with a muscle; the sides of the block stand off the grid lines."""
    lower, upper = (0.33, 0.3, 0.34)[:dim], (0.52, 0.49, 0.53)[:dim]
    shape = softmpm.box(lower, upper, spacing=0.05)
    material = softmpm.NeoHookean(density=1.2, young=80.0, poisson=0.3, viscosity=0.02)
    settings = dict(
        grid=softmpm.Grid(shape=(12, 11, 10)[:dim], spacing=0.1),
        bodies=[softmpm.Body(shape, material)],
        muscles=[softmpm.Muscle(particles=np.arange(6), direction=(1.0, 0.4, 0.2)[:dim], strength=10.0)],
        walls=[
            softmpm.Wall(normal=(0.1, 1.0, 0.05)[:dim], offset=0.35, friction=0.4),
            softmpm.Wall(normal=(1.0, 0.2, 0.0)[:dim], offset=0.4, friction=0.2),
            softmpm.Wall(normal=(-1.0, 0.0, 0.0)[:dim], offset=-0.5, contact="slip"),
        ],
        gravity=(0.3, -9.8, 0.2)[:dim],
        damping=0.7,
        dt=1e-3,
    )
    return softmpm.Scene(**(settings | changes))


def build(made: softmpm.Scene, **settings) -> softmpm.Model:
    alarms = softmpm.Alarms(collapse=None, depth=None)
    return softmpm.build(
        made, device=settings.pop("device", "cpu"), formulation="reference", alarms=alarms, **settings
    )


def surface_of(model: softmpm.Model) -> reference_contact.Surface:
    """The model's surface points for the reference, which does not compute weights."""
    points, rest = model.surface, model.rest_grid
    assert points is not None
    node = rest.index.cpu()[points.stencil.cpu().long()]
    return reference_contact.Surface(
        points.points.cpu(), node, points.weights.cpu(), points.areas.cpu(), points.stiffness.cpu()
    )


def slab(friction=0.5, gravity=(0.0, -G), width=8, **changes) -> softmpm.Scene:
    """A viscous block of ``width`` x 3 cells that touches the floor."""
    h, mu = 1 / 32, 2e5 / 2.6
    corner = (4.5 * h, 4.5 * h)
    shape = softmpm.box(corner, (corner[0] + width * h, corner[1] + 3 * h), spacing=h / 2)
    material = softmpm.NeoHookean(density=1000.0, young=2e5, poisson=0.3, viscosity=4e-3 * mu)
    settings = dict(
        grid=softmpm.Grid(shape=(28, 28), spacing=h),
        bodies=[softmpm.Body(shape, material)],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=corner[1], friction=friction)],
        gravity=gravity,
        dt=2e-4,
    )
    return softmpm.Scene(**(settings | changes))


def settled(model: softmpm.Model, substeps=2500) -> softmpm.State:
    """The block at rest on the floor."""
    return softmpm.simulate(model, model.rest(), None, model.params(), substeps=substeps)


def made(scene: softmpm.Scene, **settings) -> softmpm.Model:
    return softmpm.build(scene, device="cpu", dtype=torch.float64, formulation="reference", **settings)


def velocity(model: softmpm.Model, state: softmpm.State) -> torch.Tensor:
    return (model.mass[:, None] * state.v[0]).sum(0) / model.mass.sum()


def forces_of(model: softmpm.Model, seed: int, worlds=1) -> softmpm.ContactForces:
    """Random tractions at every third point, the forces that they give, and places near those at rest."""
    surface, generator = model.surface, torch.Generator().manual_seed(seed)
    shape = (worlds, len(model.spec.surface_walls), surface.count, model.dim)
    traction = torch.randn(shape, generator=generator, dtype=torch.float64)
    traction[:, :, torch.arange(surface.count) % 3 > 0] = 0.0
    places = surface.points + 0.01 * torch.randn(worlds, *surface.points.shape, generator=generator)
    return softmpm.ContactForces((traction * surface.areas[:, None]).sum(2), traction, places)


def record_forces(recorder: softmpm.Recorder, model: softmpm.Model, iteration: int) -> None:
    """Three frames, the first without forces."""
    with recorder.episode(iteration) as episode:
        for k in range(3):
            forces = forces_of(model, 10 * iteration + k, worlds=2) if k else None
            episode.frame(0.1 * k, model.rest(), forces=forces)
