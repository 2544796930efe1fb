"""Contact at surface points on the moving grid in plain float64 PyTorch, beside :mod:`softmpm.oracle.contact`.

A point of the outline belongs to the particle of the same body that is nearest at rest. It is where x and F of that particle show it
and moves with its affine velocity: (K1), (K2) and (K5) with the weights of each substep. Derivations: docs/math/contact.md.

    b_s = F_p (X_s − X_p),  x_s = x_p + b_s,  r_i = x_i − x_p,  W_si = w_i(x_p) (1 + (4/dx²) r_i·b_s)   (K8)
    D_s = Σ_i |W_si| L_i / m_i,  L_i = Σ_r |W_ri| A_r,  v_s = Σ_i W_si v*_i                             (K9)
    v'_i = v*_i + (1/m_i) Σ_s W_si A_s Σ_k J_k                                                          (K10)
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from softmpm.inputs import Inputs
from softmpm.oracle.contact import across_walls, meet_walls, per_mass
from softmpm.oracle.moving import (
    SCENE,
    control_steps,
    from_grid,
    of_control_step,
    rest_volume,
    to_grid,
)
from softmpm.oracle.stress import lame
from softmpm.oracle.transfer import stencil
from softmpm.oracle.walls import BESIDE_POINTS
from softmpm.scene.scene import Scene
from softmpm.state import Params, State


class Points(NamedTuple):
    """Surface points of all bodies at rest, the same in all worlds."""

    particle: Tensor
    """The particle p of the same body nearest at rest, shape (point,)."""
    arm: Tensor
    """Rest position from that of the particle, X_s − X_p [m], shape (point, dim)."""
    area: Tensor
    """Area of each point A [m²], in 2D [m] of unit depth, shape (point,)."""
    stiffness: Tensor
    """k of (K4) [Pa/m], shape (point,)."""


def surface_points(scene: Scene) -> Points:
    """Points of the outlines of all bodies."""
    parts, start = [], 0
    for body in scene.bodies:
        outline, material, positions = body.particles.outline, body.material, body.particles.positions
        assert outline is not None
        nearest = np.linalg.norm(outline.points[:, None] - positions, axis=-1).argmin(1)
        young, poisson = material.young, material.poisson
        modulus = young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
        stiffness = np.full(len(outline), 4 * modulus / scene.grid.spacing)
        parts.append((start + nearest, outline.points - positions[nearest], outline.areas, stiffness))
        start += len(positions)
    return Points(*(torch.from_numpy(np.concatenate(columns)) for columns in zip(*parts, strict=True)))


def arms(points: Points, state: State) -> Tensor:
    """b_s = F_p (X_s − X_p) [m], shape (world, point, dim)."""
    return (state.F[:, points.particle] @ points.arm[..., None])[..., 0]


def places(points: Points, state: State) -> Tensor:
    """x_s of (K8) [m], shape (world, point, dim)."""
    return state.x[:, points.particle] + arms(points, state)


def weights(scene: Scene, points: Points, state: State) -> tuple[Tensor, Tensor]:
    """Flat indices of the nodes around the particle of each point, and W of (K8), both (world, point, 3^dim)."""
    found = stencil(scene, state.x[:, points.particle])
    node, w = (torch.stack([one[k] for one in found], -1) for k in (0, 1))
    r = torch.stack([one[2] for one in found], -2)
    return node, w * (1 + 4 / scene.grid.spacing**2 * (r @ arms(points, state)[..., None])[..., 0])


def meet(
    scene: Scene,
    points: Points,
    state: State,
    anchor: Tensor,
    mass: Tensor,
    v: Tensor,
    inputs: Inputs = SCENE,
    smoothing: float = 0.0,
    time: float = 0.0,
    duration: float = 1.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Response of the separating walls to one substep (K8) to (K10), arguments as for :func:`softmpm.oracle.contact.contact`.

    Args:
        state: Of the particles at the beginning of the substep.

    Returns:
        Velocities of the nodes, anchors, impulses per area.
    """
    node, W = weights(scene, points, state)
    around = node.flatten(1)

    def near(field: Tensor) -> Tensor:
        return field.gather(1, around[..., None].expand(-1, -1, field.shape[-1])).view(*node.shape, -1)

    load = torch.zeros_like(mass).scatter_add(1, around, (W.abs() * points.area[:, None]).flatten(1))
    D = (W.abs()[..., None] * near(per_mass(load, mass)[..., None])).sum(-2)
    at_points = (W[..., None] * near(v)).sum(-2)
    anchor, J = meet_walls(
        scene,
        points.stiffness,
        D,
        places(points, state),
        at_points,
        anchor,
        inputs,
        smoothing,
        time,
        duration,
    )
    share = ((W * points.area[:, None])[..., None] * J.sum(1)[:, :, None]).flatten(1, 2)
    sums = torch.zeros_like(v).scatter_add(1, around[..., None].expand_as(share), share)
    return v + per_mass(sums, mass[..., None]), anchor, J


def simulate(
    scene: Scene,
    start: State,
    activation: Tensor | None,
    params: Params,
    *,
    substeps: int,
    inputs: Inputs = SCENE,
    points: Points,
    anchor: Tensor | None = None,
    smoothing: float = 0.0,
) -> tuple[State, Tensor, Tensor]:
    """Arguments and number of control steps as for :func:`softmpm.oracle.moving.simulate`.

    Args:
        points: That the separating walls act on, in place of the nodes.
        anchor: Anchors of friction [m], shape (world, separating wall, point, dim); None are those of the start.
        smoothing: Width of the onset of contact [m].

    Returns:
        State, anchors and the mean force of each wall on each point in the last control step [N].
    """
    lead = start.x.shape[:2]
    young, poisson, density = (value.expand(lead) for value in params)
    mu, lam = lame(young, poisson)
    mass, state = density * rest_volume(scene, density.dtype), start
    steps, duration = control_steps(activation, inputs), substeps * scene.dt
    if anchor is None:
        anchor = across_walls(scene, places(points, start), of_control_step(inputs, 0, steps))
    force = torch.zeros_like(anchor)
    for c in range(steps):
        row, now = None if activation is None else activation[c], of_control_step(inputs, c, steps)
        force = torch.zeros_like(anchor)
        for s in range(substeps):
            time = s * scene.dt
            of_nodes, v = to_grid(scene, state, row, mu, lam, mass, now, time, duration, BESIDE_POINTS)
            v, anchor, J = meet(scene, points, state, anchor, of_nodes, v, now, smoothing, time, duration)
            state = from_grid(scene, state, v, now)
            force = force + points.area[:, None] * J / duration
    return state, anchor, force
