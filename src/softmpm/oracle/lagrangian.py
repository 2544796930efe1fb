"""Total Lagrangian MPM in plain float64 PyTorch: the truth in tests of ``formulation="reference"``; no code shared with kernels.

The weights are those of the particles at rest, the nodes carry displacement and velocity, and the particles are quadrature points.
Source: de Vaucorbeil et al. 2020, "A Total-Lagrangian Material Point Method for solid mechanics problems involving large
deformations". Stress and walls are those of :mod:`softmpm.oracle.moving`, and so is the order of the nodes: row by row over
``scene.grid.shape``. Everything is differentiated by PyTorch. Derivations: docs/math/lagrangian.md.

    F_p = I + Σ u_i ⊗ g_ip,   Ḟ_p = Σ v_i ⊗ g_ip,   L = Ḟ F⁻¹            (Q1)
    f_i = −Σ V_p P_p g_ip + Σ N_i f_p,   P = τ F⁻ᵀ,   m_i = Σ m_p N_i                (Q2)
    v*_i = exp(−γ Δt) (v_i + Δt (f_i/m_i + g))                                       (Q3)
    v'_i = W(v*_i) by the walls at X_i + u_i,   u'_i = u_i + Δt v'_i                 (Q4)
    v'_i from Σ m_j s_j v'_j over the images of a node in clamps and symmetries      (B1), with its impulse (B3)
    v'_i = V_i on the nodes of driven particles                                      (Q10)
    x = X + Σ N u,   v = Σ N v,   C = L                                              (Q5)
    u_i = Σ m_p N_i [x_p − X_p + (F_p − I)(X_i − X_p)] / m_i
    v_i = Σ m_p N_i [v_p + C_p F_p (X_i − X_p)] / m_i                                (Q6)
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from softmpm.inputs import Inputs
from softmpm.oracle.contact import Surface, contact, start_anchor
from softmpm.oracle.driven import fit, held
from softmpm.oracle.mirror import pull, reflected
from softmpm.oracle.moving import (
    SCENE,
    control_steps,
    grid_velocity,
    of_control_step,
    rest_volume,
    stress,
)
from softmpm.oracle.stress import lame
from softmpm.oracle.transfer import stencil
from softmpm.oracle.walls import BESIDE_POINTS, ON_NODES
from softmpm.scene.scene import MIRRORS, Scene
from softmpm.state import Params, State


class Quadrature(NamedTuple):
    """Weights of the 3^dim nodes of each particle at rest, the same in all worlds."""

    X: Tensor
    """Rest positions [m], shape (particle, dim)."""
    node: Tensor
    """Flat index of each node, shape (particle, 3^dim)."""
    N: Tensor
    """B-spline N_i(X_p), shape (particle, 3^dim)."""
    slope: Tensor
    """g_ip = (4/dx²) N_i (X_i − X_p) [1/m], the gradient of MLS-MPM, shape (particle, 3^dim, dim)."""
    r: Tensor
    """X_i − X_p [m], shape (particle, 3^dim, dim)."""


def quadrature(scene: Scene) -> Quadrature:
    """Nodes and weights of the scene's particles."""
    X = torch.cat([torch.tensor(body.particles.positions) for body in scene.bodies])
    nodes = stencil(scene, X[None])
    node, N, r = (torch.stack([part[k][0] for part in nodes], 1) for k in range(3))
    slope = 4.0 / scene.grid.spacing**2 * N[..., None] * r
    return Quadrature(X, node, N, slope, r)


def gather(points: Quadrature, values: Tensor) -> tuple[Tensor, Tensor]:
    """Σ N a and Σ a ⊗ g at the particles of a field a on the nodes, (world, node, dim)."""
    near = values[:, points.node]
    return torch.einsum("wpki,pk->wpi", near, points.N), torch.einsum("wpki,pkj->wpij", near, points.slope)


def scatter(scene: Scene, points: Quadrature, share: Tensor) -> Tensor:
    """Sum over the particles of what each gives to its nodes, (world, particle, 3^dim, ...), shape (world, node, ...)."""
    sums = share.new_zeros(len(share), math.prod(scene.grid.shape), *share.shape[3:])
    return sums.index_add(1, points.node.flatten(), share.flatten(1, 2))


def node_mass(scene: Scene, points: Quadrature, mass: Tensor) -> Tensor:
    """m_i (Q2) [kg], shape (world, node), of ``mass`` (world, particle)."""
    return scatter(scene, points, mass[..., None] * points.N)


def node_force(
    scene: Scene,
    points: Quadrature,
    u: Tensor,
    v: Tensor,
    activation: Tensor | None,
    mu: Tensor,
    lam: Tensor,
    inputs: Inputs = SCENE,
) -> Tensor:
    """f_i (Q2) [N], without gravity, shape (world, node, dim).

    ``activation`` (world, muscle) or None; ``mu`` and ``lam`` [Pa] (world, particle).
    """
    F = torch.eye(u.shape[-1], dtype=u.dtype) + gather(points, u)[1]
    inverse = torch.linalg.inv(F)
    tau = stress(scene, F, mu, lam, activation, gather(points, v)[1] @ inverse, inputs)
    load = rest_volume(scene, u.dtype)[:, None, None] * tau @ inverse.mT
    share = -torch.einsum("wpij,pkj->wpki", load, points.slope)
    if inputs.force is not None:
        force = inputs.force.expand(*F.shape[:-1])
        share = share + points.N[..., None] * force[:, :, None]
    return scatter(scene, points, share)


def step(
    scene: Scene,
    points: Quadrature,
    u: Tensor,
    v: Tensor,
    activation: Tensor | None,
    mu: Tensor,
    lam: Tensor,
    mass: Tensor,
    inputs: Inputs = SCENE,
    surface: Surface | None = None,
    anchor: Tensor | None = None,
    smoothing: float = 0.0,
    time: float = 0.0,
    duration: float = 1.0,
    drive: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, ...]:
    """One substep (Q1) to (Q4), with a surface also (K2) to (K6); ``mass`` of the nodes. Nodes without mass have the velocity zero.

    ``drive`` are the nodes of driven particles and their velocities (Q10), shape (world, node, dim).

    Returns:
        u and v, with a surface also the anchors and the impulses per area J of :func:`softmpm.oracle.contact.contact`, and with
        clamps or planes of symmetry at last the impulse of each.
    """
    impulse = scene.dt * node_force(scene, points, u, v, activation, mu, lam, inputs)
    contacts = ON_NODES if surface is None else BESIDE_POINTS
    momentum = mass[..., None] * v + impulse
    v = grid_velocity(scene, mass, momentum, inputs, time, duration, displacement=u, contacts=contacts)
    free, v = v, reflected(scene, mass, v)
    change, v, rest = v - free, driven(v, drive), []
    if surface is not None:
        anchor = start_anchor(scene, surface, u, inputs) if anchor is None else anchor
        free, *rest = contact(scene, surface, u, v, anchor, mass, inputs, smoothing, time, duration)
        v = reflected(scene, mass, free)
        change, v = change + v - free, driven(v, drive)
    pulls = [pull(scene, mass, change)] if _mirrored(scene) else []
    return u + scene.dt * v, v, *rest, *pulls


def _mirrored(scene: Scene) -> bool:
    return any(wall.contact in MIRRORS for wall in scene.walls)


def driven(v: Tensor, drive: tuple[Tensor, Tensor] | None) -> Tensor:
    """(Q10)"""
    return v if drive is None else v.index_copy(1, *drive)


def simulate(
    scene: Scene,
    u: Tensor,
    v: Tensor,
    activation: Tensor | None,
    params: Params,
    *,
    substeps: int,
    inputs: Inputs = SCENE,
    surface: Surface | None = None,
    anchor: Tensor | None = None,
    smoothing: float = 0.0,
) -> tuple[Tensor, ...]:
    """Advance the nodes; arguments and number of control steps as for :func:`softmpm.oracle.moving.simulate`.

    Args:
        u: Displacement of every node of the grid [m], shape (world, node, dim).
        v: Velocity of every node [m/s], shape (world, node, dim).
        surface: Points that the separating walls act on, in place of the nodes.
        anchor: Anchors of friction [m], shape (world, separating wall, point, dim); None is their start.
        smoothing: Width of the onset of contact [m].

    Returns:
        u and v after ``control_step * substeps * dt`` seconds, with a surface also the anchors and the mean force of each wall on each
        point in the last control step [N], shape (world, separating wall, point, dim), and with clamps or planes of symmetry at last
        the mean force of each, shape (world, clamp or symmetry, dim).
    """
    if inputs.position is not None:
        raise NotImplementedError(
            "the total Lagrangian oracle takes velocities of driven particles, no positions."
        )
    points = quadrature(scene)
    young, poisson, density = (value.expand(len(u), len(points.X)) for value in params)
    mu, lam = lame(young, poisson)
    mass = node_mass(scene, points, density * rest_volume(scene, density.dtype))
    steps, duration = control_steps(activation, inputs), substeps * scene.dt
    if surface is not None and anchor is None:
        anchor = start_anchor(scene, surface, u, of_control_step(inputs, 0, steps))
    force, drive, spread, reaction = torch.zeros(0), None, torch.zeros(0), torch.zeros(0)
    if len(scene.driven):
        nodes = held(scene, points.node, points.N)
        spread = fit(scene, points.X, nodes)
        if surface is not None:
            free = ~torch.isin(surface.node, nodes) & (surface.w != 0)
            surface = surface._replace(free=free.any(1).to(u.dtype))
    for c in range(steps):
        row, now = None if activation is None else activation[c], of_control_step(inputs, c, steps)
        force, reaction = torch.zeros_like(u if anchor is None else anchor), torch.zeros(())
        if len(scene.driven):
            V = torch.zeros(1, dtype=u.dtype) if now.velocity is None else now.velocity
            drive = nodes, spread @ V.expand(len(u), len(scene.driven), u.shape[-1])
        for s in range(substeps):
            about = (row, mu, lam, mass, now, surface, anchor, smoothing, s * scene.dt, duration, drive)
            u, v, *contacts = step(scene, points, u, v, *about)
            if _mirrored(scene):
                reaction = reaction + contacts.pop() / duration
            if surface is not None:
                anchor, impulse = contacts
                force = force + surface.area[:, None] * impulse / duration
    found = (u, v) if anchor is None else (u, v, anchor, force)
    return (*found, reaction) if _mirrored(scene) else found


def evaluate(scene: Scene, u: Tensor, v: Tensor) -> State:
    """State of the particles (Q5) of nodes with displacement ``u`` [m] and velocity ``v`` [m/s], both (world, node, dim)."""
    points = quadrature(scene)
    (way, H), (velocity, rate) = gather(points, u), gather(points, v)
    F = torch.eye(u.shape[-1], dtype=u.dtype) + H
    return State(points.X + way, velocity, rate @ torch.linalg.inv(F), F)


def project(scene: Scene, state: State, params: Params) -> tuple[Tensor, Tensor]:
    """Displacement [m] and velocity [m/s] of the nodes, both (world, node, dim), from a state of the particles (Q6).

    Exact for affine fields; others are smoothed, so that :func:`evaluate` gives back another state. Zero on nodes without mass. Only
    the density of ``params`` counts.
    """
    points = quadrature(scene)
    mass = params.density.expand(state.x.shape[:2]) * rest_volume(scene, state.x.dtype)
    of_nodes = node_mass(scene, points, mass)
    eye = torch.eye(state.x.shape[-1], dtype=state.x.dtype)
    fields = ((state.x - points.X, state.F - eye), (state.v, state.C @ state.F))
    u, v = (_average(scene, points, mass, of_nodes, value, slope) for value, slope in fields)
    return reflected(scene, of_nodes, u), reflected(scene, of_nodes, v)


def _average(
    scene: Scene, points: Quadrature, mass: Tensor, of_nodes: Tensor, value: Tensor, slope: Tensor
) -> Tensor:
    """Average on the nodes, weighted by mass, of each particle's affine field; zero where there is no mass."""
    field = value[:, :, None] + torch.einsum("wpij,pkj->wpki", slope, points.r)
    sums = scatter(scene, points, mass[..., None, None] * points.N[..., None] * field)
    return sums / torch.where(of_nodes > 0, of_nodes, torch.ones_like(of_nodes))[..., None]
