"""Contact with friction at surface points in plain float64 PyTorch. Part of :mod:`softmpm.oracle.lagrangian`.

The outline of a body at rest has points with an area and constant weights on the nodes. One pass over the separating walls finds an
impulse per area at each point from the predicted penetration, with an anchored friction, and the nodes gather it. A wall that moves
does so first, from its pose n°, o° at the beginning of the substep to n, o at its end, and takes the anchors along. Derivations:
docs/math/contact.md.

    D_s = Σ_i |w_si| L_i / m_i,   L_i = Σ_r |w_ri| A_r                                       (K1)
    x_s = X_s + Σ w_si u_i,   v_s = Σ w_si v*_i                                              (K2)
    a° ← R a° + (o° + o) (n° − (n·n°) n) / (1 + n·n°) + Δt w_t                               (K6)
    d = −(y + Δt (v_n − w_n)),   P = H(d) / (Δt D_s),   y = n·x_s − o                        (K3)
    T = −c e, |T| ≤ μ P,   e = x_t + Δt v_t − a,   c = k Δt / (1 + D_s k Δt²)                (K4)
    further than a cell from the wall, y − Δt w_n > dx:  J = 0,  a = x_t                     (K4)
    v'_i = v*_i + (1/m_i) Σ_s w_si A_s Σ_k J_k,   J_k = P n + T                              (K5)
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from softmpm.inputs import Inputs
from softmpm.oracle.moving import SCENE
from softmpm.oracle.walls import Surface as Wall
from softmpm.oracle.walls import surface as wall_at
from softmpm.scene.scene import Scene


class Surface(NamedTuple):
    """Points of the outline at rest and their weights on the nodes, the same in all worlds."""

    X: Tensor
    """Rest positions [m], shape (point, dim)."""
    node: Tensor
    """Flat index of each node in the grid, shape (point, 3^dim)."""
    w: Tensor
    """Weights, shape (point, 3^dim): their sum is 1 and they reproduce linear fields."""
    area: Tensor
    """Area of each point A [m²], in 2D [m] of unit depth, shape (point,)."""
    stiffness: Tensor
    """Tangential stiffness k = 4 (λ + 2μ) / dx of the body of each point [Pa/m], shape (point,). A constant."""
    free: Tensor | float = 1.0
    """0 for points that get no force because driven particles hold all of their nodes, else 1, shape (point,)."""


def separating(scene: Scene) -> list[int]:
    """Numbers of the walls that act on surface points."""
    return [k for k, wall in enumerate(scene.walls) if wall.contact == "separate"]


def gather(surface: Surface, values: Tensor) -> Tensor:
    """Σ w a at the surface points of a field a on the nodes, (world, node, ...)."""
    return torch.einsum("wsk...,sk->ws...", values[:, surface.node], surface.w)


def delassus(scene: Scene, surface: Surface, mass: Tensor) -> Tensor:
    """D_s (K1) [m²/kg], shape (world, point), of ``mass`` (world, node)."""
    w = surface.w.abs()
    load = w.new_zeros(math.prod(scene.grid.shape))
    load = load.index_add(0, surface.node.flatten(), (w * surface.area[:, None]).flatten())
    return (w * per_mass(load.expand_as(mass), mass)[:, surface.node]).sum(-1)


def per_mass(values: Tensor, mass: Tensor) -> Tensor:
    """Values divided by the mass of the nodes, zero where there is none."""
    return torch.where(mass > 0, values / torch.where(mass > 0, mass, torch.ones_like(mass)), 0.0)


def contact(
    scene: Scene,
    surface: Surface,
    u: Tensor,
    v: Tensor,
    anchor: Tensor,
    mass: Tensor,
    inputs: Inputs = SCENE,
    smoothing: float = 0.0,
    time: float = 0.0,
    duration: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Response of the separating walls to one substep (K2) to (K5).

    Args:
        u: Displacement of the nodes at the beginning of the substep [m], shape (world, node, dim).
        v: Their velocity v* after forces and the other walls [m/s].
        anchor: Anchors a [m], shape (world, separating wall, point, dim).
        mass: Of the nodes [kg], shape (world, node).
        inputs: Of one control step, without that axis; one pose of the walls, or those at its two ends.
        smoothing: Width s of the hinge H [m].
        time, duration: Since the beginning of the control step, and its length [s].

    Returns:
        Velocity of the nodes [m/s], anchors, and impulses per area J [N s/m²], shaped like the anchors.
    """
    D = delassus(scene, surface, mass)[..., None]
    x, at_points = surface.X + gather(surface, u), gather(surface, v)
    anchors, J = meet_walls(
        scene, surface.stiffness, D, x, at_points, anchor, inputs, smoothing, time, duration
    )
    J = J * torch.as_tensor(surface.free, dtype=v.dtype)[..., None]
    share = (surface.w * surface.area[:, None])[..., None] * J.sum(1)[:, :, None]
    sums = torch.zeros_like(v).index_add(1, surface.node.flatten(), share.flatten(1, 2))
    return v + per_mass(sums, mass[..., None]), anchors, J


def meet_walls(
    scene: Scene,
    stiffness: Tensor,
    D: Tensor,
    x: Tensor,
    v: Tensor,
    anchor: Tensor,
    inputs: Inputs,
    smoothing: float,
    time: float,
    duration: float,
) -> tuple[Tensor, Tensor]:
    """Anchors and impulses per area J of the separating walls, both (world, wall, point, dim), by (K3), (K4), (K6).

    Args:
        stiffness: k of each point [Pa/m], shape (point,).
        D: Of each point [m²/kg], shape (world, point, 1).
        x, v: Places [m] and velocities v_s [m/s] of the points, shape (world, point, dim).
    """
    friction = inputs.friction
    if friction is None:
        friction = torch.tensor([wall.friction for wall in scene.walls], dtype=v.dtype)
    friction = friction.expand(len(v), len(scene.walls))
    anchors, impulses = [], []
    for number, k in enumerate(separating(scene)):
        before, wall = (wall_at(scene, k, inputs, v, at, duration) for at in (time, time + scene.dt))
        n, mu, slide = wall.unit[:, None], friction[:, k, None, None], wall.slide[:, None]
        y, v_n = (x * n).sum(-1, keepdim=True) - level(wall), (v * n).sum(-1, keepdim=True)
        x_t, v_t = _tangential(x, n), v - v_n * n
        height = y - scene.dt * (slide * n).sum(-1, keepdim=True)
        near = height <= scene.grid.spacing
        P = torch.where(near, hinge(-(height + scene.dt * v_n), smoothing) / (scene.dt * D), 0.0)
        carried = carry(before, wall, anchor[:, number]) + scene.dt * _tangential(slide, n)
        T, moved = _friction(stiffness, scene.dt, D, P, mu, x_t, v_t, carried)
        moved = torch.where(near, moved, x_t)
        impulses.append(P * n + T)
        anchors.append(moved)
        v = v + D * impulses[-1]
    if not impulses:
        return anchor, torch.zeros_like(anchor)
    return torch.stack(anchors, 1), torch.stack(impulses, 1)


def level(wall: Wall) -> Tensor:
    """Offset o of the unit normal [m], shape (world, 1, 1)."""
    return (wall.offset / torch.linalg.vector_norm(wall.normal, dim=-1))[:, None, None]


def carry(before: Wall, after: Wall, anchor: Tensor) -> Tensor:
    """Anchors (world, point, dim) after the wall turned about the line that both of its planes share (K6)."""
    old, n = before.unit[:, None], after.unit[:, None]
    cosine = (old * n).sum(-1, keepdim=True)
    turned = anchor - (n * anchor).sum(-1, keepdim=True) / (1 + cosine) * (old + n)
    return turned + (level(before) + level(after)) / (1 + cosine) * (old - cosine * n)


def hinge(d: Tensor, smoothing: float) -> Tensor:
    """H(d) of (K3) [m]."""
    if smoothing == 0:
        return torch.where(d > 0, d, 0.0)
    above = torch.where(d < 2 * smoothing, d**2 / (4 * smoothing), d - smoothing)
    return torch.where(d > 0, above, 0.0)


def _friction(
    stiffness: Tensor, dt: float, D: Tensor, P: Tensor, mu: Tensor, x_t: Tensor, v_t: Tensor, anchor: Tensor
) -> tuple[Tensor, Tensor]:
    """Tangential impulse per area T and the anchor after the substep (K4)."""
    k = stiffness[:, None]
    T = -k * dt / (1 + D * k * dt**2) * (x_t + dt * v_t - anchor)
    squared, touches = (T**2).sum(-1, keepdim=True), P > 0
    sliding = touches & ((squared > (mu * P) ** 2) | (mu == 0))  # a smooth wall holds no point
    size = torch.sqrt(torch.where(sliding & (squared > 0), squared, 1.0))
    T = torch.where(sliding, mu * P * T / size, torch.where(touches, T, 0.0))
    slipped = x_t + dt * (v_t + D * T) + T / (k * dt)
    return T, torch.where(sliding, slipped, torch.where(touches, anchor, x_t + dt * v_t))


def _tangential(vectors: Tensor, n: Tensor) -> Tensor:
    return vectors - (vectors * n).sum(-1, keepdim=True) * n


def start_anchor(scene: Scene, surface: Surface, u: Tensor, inputs: Inputs = SCENE) -> Tensor:
    """Anchors x_t of the displacement ``u`` (world, node, dim), shape (world, separating wall, point, dim).

    ``inputs`` are those of the first control step.
    """
    return across_walls(scene, surface.X + gather(surface, u), inputs)


def across_walls(scene: Scene, x: Tensor, inputs: Inputs = SCENE) -> Tensor:
    """x_t of places ``x`` (world, point, dim) by the first pose, shape (world, separating wall, point, dim)."""
    normals = [wall_at(scene, k, inputs, x, 0.0, 1.0).unit[:, None] for k in separating(scene)]
    return torch.stack([_tangential(x, n) for n in normals], 1) if normals else x[:, None][:, :0]
