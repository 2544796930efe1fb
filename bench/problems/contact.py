"""Bodies at rest on a smooth floor that acts on their surface points: Hertz' disc, and a block."""

import math

import numpy as np
import torch

import softmpm
from softmpm.oracle import contact, lagrangian, moving, stress
from softmpm.surface_grid import SurfaceGrid

from . import exact
from .running import Simulation, result, scene_of

YOUNG, POISSON, DENSITY, GRAVITY = 2e5, 0.3, 1000.0, 9.81


def pressures(one: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Places of the surface points in the present state [m], and the pressure of the first wall on each [Pa]: in the reference
    formulation that of the next substep by the float64 oracle, on the moving grid the mean over the last call.
    """
    model, scene, nodes = one.model, one.model.scene, one.state.nodes
    normal = torch.tensor(scene.walls[0].normal, dtype=torch.float64)
    decay = math.exp(
        -scene.damping * scene.dt
    )  # acts on the forces, but not on the contact that balances them
    if model.formulation == "moving":
        forces = softmpm.contact_forces(model, one.state)
        return forces.points[0].numpy(), (forces.traction[0, 0] @ normal / decay).numpy()
    assert isinstance(model.surface, SurfaceGrid) and nodes is not None
    points, index = model.surface, model.rest_grid.index.cpu()
    surface = contact.Surface(
        points.points.cpu(),
        index[points.stencil.cpu().long()],
        points.weights.cpu(),
        points.areas.cpu(),
        points.stiffness.cpu(),
    )
    u, v = (torch.zeros(1, model.node_count, model.dim, dtype=torch.float64) for _ in range(2))
    u[:, index], v[:, index] = nodes.u.cpu(), nodes.v.cpu()
    rest = lagrangian.quadrature(scene)
    params = softmpm.Params(*(value.cpu()[None] for value in model.params()))
    mass = lagrangian.node_mass(scene, rest, model.mass.cpu()[None])
    force = lagrangian.node_force(scene, rest, u, v, None, *stress.lame(params.young, params.poisson))
    free = moving.grid_velocity(scene, mass, mass[..., None] * v + scene.dt * force, contacts=())
    _, _, impulses = contact.contact(scene, surface, u, free, nodes.anchor.cpu(), mass)
    places = surface.X + contact.gather(surface, u)[0]
    return places.numpy(), (impulses[0, 0] @ normal / scene.dt / decay).numpy()


def hertz(cells: int, per_cell: int, formulation: str = "reference") -> dict[str, dict]:
    """A disc of the radius 1/4 that is put on the floor and comes to rest: its largest pressure, against Hertz' at the place of that
    point, and how far its centre sinks.
    """
    radius, h, weight = 0.25, 1.0 / cells, DENSITY * GRAVITY
    floor = 3.5 * h
    center = ((math.ceil(radius / h) + 3) * h, floor + radius)
    shape = softmpm.ball(center, radius, spacing=h / per_cell, cut_cells=True)
    material = softmpm.NeoHookean(density=DENSITY, young=YOUNG, poisson=POISSON)
    want = exact.hertz(radius, YOUNG, POISSON, weight)
    frequency = math.sqrt(GRAVITY / want.sinking)
    wall = softmpm.Wall(normal=(0.0, 1.0), offset=floor)
    settings = dict(gravity=(0.0, -GRAVITY), damping=1.8 * frequency, step=0.8)
    one = Simulation(scene_of(h, shape, material, walls=[wall], **settings), formulation, contact="surface")
    X = one.model.exact_positions - center
    near = np.linalg.norm(X, axis=1) < 1.5 * h / per_cell  # symmetric about the centre

    def sunk(state: softmpm.State) -> float:
        return -float((state.x[0].cpu().numpy() - center)[near, 1].mean())

    sinking = result(one, one.settled(16 / frequency, sunk), want.sinking)
    places, pressure = pressures(one)
    most = pressure.argmax()
    there = want.pressure * math.sqrt(1.0 - ((places[most, 0] - center[0]) / want.width) ** 2)
    return {"sinking": sinking, "pressure": result(one, (pressure[most], 0.0), there)}


def gap(cells: int, per_cell: int, formulation: str = "reference") -> dict:
    """A block of so many cells of height, twice as wide, that is put on the floor: the largest distance of its sole from the floor, in
    cells, as its error.
    """
    height, h = 1 / 16, 1 / 16 / cells
    corner = 3.5 * h
    shape = softmpm.box((corner, corner), (corner + 2 * height, corner + height), spacing=h / per_cell)
    material = softmpm.NeoHookean(density=DENSITY, young=YOUNG, poisson=POISSON)
    frequency = math.sqrt(YOUNG / DENSITY) / height
    wall = softmpm.Wall(normal=(0.0, 1.0), offset=corner)
    settings = dict(gravity=(0.0, -GRAVITY), damping=1.8 * frequency, step=0.8)
    one = Simulation(scene_of(h, shape, material, walls=[wall], **settings), formulation, contact="surface")
    assert one.model.surface is not None
    sole = np.isclose(one.model.surface.points.cpu().numpy()[:, 1], corner)

    def apart(state: softmpm.State) -> float:
        return float(np.abs(pressures(one)[0][sole, 1] - corner).max()) / h

    found, drift = one.settled(30 / frequency, apart)
    return result(one, (1.0 + found, drift), 1.0)
