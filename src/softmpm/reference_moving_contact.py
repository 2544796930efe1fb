"""Contact at surface points on the moving grid in plain float64 PyTorch, beside :mod:`softmpm.reference_contact`.

The points of the outline are carried with the grid. Their velocity is that of the affine motion which fits the velocities of the nodes
around them best, weighted by spline and mass, so light nodes need not be left out. Derivations: docs/math/contact.md.

    k_i = w_i(x_s) m_i,  M = Σ k_i,  r = x_i − x_s in cells,  r̂ = Σ k_i r_i / M
    K = Σ k_i (r_i − r̂)(r_i − r̂)ᵀ / M + ε I,   b_si = (w_i / M) (1 − r̂ᵀ K⁻¹ (r_i − r̂))            (K8)
    D_s = Σ_i m_i |b_si| l_i,   l_i = Σ_r |b_ri| A_r,   v_s = Σ_i m_i b_si v*_i                       (K9)
    v'_i = v*_i + Σ_s b_si A_s Σ_k J_k,   x'_s = x_s + Δt Σ_i m_i b_si v'_i                           (K10)
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from softmpm.inputs import Inputs
from softmpm.reference import (
    SCENE,
    control_steps,
    from_grid,
    lame,
    of_control_step,
    rest_volume,
    stencil,
    to_grid,
)
from softmpm.reference_contact import across_walls, meet_walls
from softmpm.scene.scene import Scene
from softmpm.state import Params, State

SPREAD = 1e-6
"""ε [cells²]: where all mass lies on nodes in a line or a plane, the motion across it is taken to be constant."""


class Points(NamedTuple):
    """Surface points of all bodies at rest, and what they carry."""

    X: Tensor
    """Rest positions [m], shape (point, dim)."""
    area: Tensor
    """Area of each point A [m²], shape (point,)."""
    stiffness: Tensor
    """k of (K4) [Pa/m], shape (point,)."""
    particle: Tensor
    """The particle of the same body nearest at rest, shape (point,)."""


def surface_points(scene: Scene) -> Points:
    """Points of the outlines of all bodies."""
    parts, start = [], 0
    for body in scene.bodies:
        outline, material, positions = body.particles.outline, body.material, body.particles.positions
        assert outline is not None
        apart = np.linalg.norm(outline.points[:, None] - positions, axis=-1)
        young, poisson = material.young, material.poisson
        modulus = young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
        stiffness = np.full(len(outline), 4 * modulus / scene.grid.spacing)
        parts.append((outline.points, outline.areas, stiffness, start + apart.argmin(1)))
        start += len(positions)
    return Points(*(torch.from_numpy(np.concatenate(columns)) for columns in zip(*parts, strict=True)))


def places(scene: Scene, points: Points, state: State) -> Tensor:
    """Places of the points [m], shape (world, point, dim), by x and F of the nearest particle: exact for affine motion."""
    X = torch.from_numpy(np.concatenate([body.particles.positions for body in scene.bodies]))
    arms = (points.X - X[points.particle])[..., None]
    return state.x[:, points.particle] + (state.F[:, points.particle] @ arms)[..., 0]


def shares(scene: Scene, x: Tensor, mass: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes around the points at ``x`` (world, point, dim) and b of (K8) [1/kg], both (world, point, 3^dim); ``mass`` (world, node)."""
    found = stencil(scene, x)
    node, w = (torch.stack([one[k] for one in found], -1) for k in (0, 1))
    r = torch.stack([one[2] for one in found], -2) / scene.grid.spacing
    k = w * mass.gather(1, node.flatten(1)).view(node.shape)
    total = k.sum(-1, keepdim=True)
    share = (k / total)[..., None]
    mean = (share * r).sum(-2, keepdim=True)
    d = r - mean
    spread = d.mT @ (share * d) + SPREAD * torch.eye(x.shape[-1], dtype=x.dtype)
    lean = torch.linalg.solve(spread, mean[..., 0, :])
    return node, w / total * (1 - (d * lean[..., None, :]).sum(-1))


def meet(
    scene: Scene,
    points: Points,
    x: Tensor,
    anchor: Tensor,
    mass: Tensor,
    v: Tensor,
    inputs: Inputs = SCENE,
    smoothing: float = 0.0,
    time: float = 0.0,
    duration: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Response of the separating walls to one substep (K9), (K10), arguments as for :func:`softmpm.reference_contact.contact`.

    Args:
        x: Places of the points at the beginning of the substep [m], shape (world, point, dim).

    Returns:
        Velocities of the nodes, places of the points, anchors, impulses per area.
    """
    node, b = shares(scene, x, mass)
    around = node.flatten(1)

    def of_nodes(values: Tensor) -> Tensor:
        return values.gather(1, around).view(node.shape)

    def at_points(field: Tensor) -> Tensor:
        near = field.gather(1, around[..., None].expand(-1, -1, field.shape[-1]))
        return ((of_nodes(mass) * b)[..., None] * near.view(*node.shape, -1)).sum(-2)

    load = torch.zeros_like(mass).scatter_add(1, around, (b.abs() * points.area[:, None]).flatten(1))
    D = (of_nodes(mass) * b.abs() * of_nodes(load)).sum(-1, keepdim=True)
    anchor, J = meet_walls(
        scene, points.stiffness, D, x, at_points(v), anchor, inputs, smoothing, time, duration
    )
    push = ((b * points.area[:, None])[..., None] * J.sum(1)[:, :, None]).flatten(1, 2)
    v = v.scatter_add(1, around[..., None].expand_as(push), push)
    return v, x + scene.dt * at_points(v), anchor, J


def simulate(
    scene: Scene,
    start: State,
    activation: Tensor | None,
    params: Params,
    *,
    substeps: int,
    inputs: Inputs = SCENE,
    points: Points,
    x: Tensor | None = None,
    anchor: Tensor | None = None,
    smoothing: float = 0.0,
) -> tuple[State, Tensor, Tensor, Tensor]:
    """Arguments and number of control steps as for :func:`softmpm.reference.simulate`.

    Args:
        points: That the separating walls act on, in place of the nodes.
        x, anchor: Places of the points and anchors of friction [m]; None are those of the start.
        smoothing: Width of the onset of contact [m].

    Returns:
        State, places, anchors and the mean force of each wall on each point in the last control step [N].
    """
    lead = start.x.shape[:2]
    young, poisson, density = (value.expand(lead) for value in params)
    mu, lam = lame(young, poisson)
    mass, state = density * rest_volume(scene, density.dtype), start
    steps, duration = control_steps(activation, inputs), substeps * scene.dt
    x = places(scene, points, start) if x is None else x
    if anchor is None:
        anchor = across_walls(scene, x, of_control_step(inputs, 0, steps))
    force = torch.zeros_like(anchor)
    for c in range(steps):
        row, now = None if activation is None else activation[c], of_control_step(inputs, c, steps)
        force = torch.zeros_like(anchor)
        for s in range(substeps):
            time = s * scene.dt
            of_nodes, v = to_grid(scene, state, row, mu, lam, mass, now, time, duration, ("slip", "stick"))
            v, x, anchor, J = meet(scene, points, x, anchor, of_nodes, v, now, smoothing, time, duration)
            state = from_grid(scene, state, v, now)
            force = force + points.area[:, None] * J / duration
    return state, x, anchor, force
