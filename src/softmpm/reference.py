"""The whole method again in plain PyTorch: slow, readable, the truth in tests; no code shared with kernels.

Every function takes tensors with any leading axes and is differentiated by torch.autograd; meant for float64.
Derivations and labels: docs/math/.
"""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from softmpm.scene.materials import BarrierCorotated, FixedCorotated, Material, NeoHookean
from softmpm.scene.scene import Scene, Wall
from softmpm.state import GridField, Params, State


def lame(young: Tensor, poisson: Tensor) -> tuple[Tensor, Tensor]:
    """μ and λ [Pa] of Young's modulus [Pa] and Poisson's ratio [-]."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


class _Polar(torch.autograd.Function):
    """Rotation nearest to F by SVD; its derivative from the Sylvester equation Ω S + S Ω = RᵀdF − dFᵀR.

    The equation is solved as one linear system in the entries of the skew matrix Ω, so that repeated
    singular values, where the derivative of an SVD does not exist, are nothing special. Where R itself is
    not unique (two signed singular values add up to zero) it is one of the maximisers and its derivative
    NaN; a non-finite F gives NaN throughout.
    """

    @staticmethod
    def forward(ctx, F):
        finite = torch.isfinite(F).all(-1).all(-1)[..., None, None]
        U, _, Vh = torch.linalg.svd(torch.where(finite, F, torch.zeros_like(F)))
        sign = torch.ones(F.shape[:-1], dtype=F.dtype)
        sign[..., -1] = torch.sign(torch.linalg.det(U @ Vh))  # of the smallest singular value
        R = torch.where(finite, (U * sign[..., None, :]) @ Vh, torch.nan)
        ctx.save_for_backward(F, R)
        return R

    @staticmethod
    def backward(ctx, adj_R):
        F, R = ctx.saved_tensors
        dim = F.shape[-1]
        basis = []
        for i, j in itertools.combinations(range(dim), 2):
            skew = torch.zeros(dim, dim, dtype=F.dtype)
            skew[i, j], skew[j, i] = 1.0, -1.0
            basis.append(skew)
        E = torch.stack(basis)  # (k, dim, dim)
        S = (R.mT @ F)[..., None, :, :]
        # RᵀdF − dFᵀR = Ω S + S Ω; rows: the equation tested with each E, columns: Ω along each E
        system = torch.einsum("kij,...lij->...kl", E, E @ S + S @ E)
        # L = ⟨RᵀR̄, Ω⟩ = y · (system Ω) with systemᵀ y = ⟨RᵀR̄, E⟩, and F̄ = R (Σ y_k 2 E_k)
        y, failed = torch.linalg.solve_ex(system.mT, torch.einsum("kij,...ij->...k", E, R.mT @ adj_R))
        y = torch.where((failed == 0)[..., None], y, torch.nan)
        return R @ (2 * torch.einsum("...k,kij->...ij", y, E))


def polar(F: Tensor) -> Tensor:
    """Proper rotation R that maximises tr(RᵀF), shape (..., dim, dim); also for det F < 0."""
    return _Polar.apply(F)


def neo_hookean(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress τ = μ(FFᵀ − I) + λ log(J) I [Pa] (E1)."""
    eye, J = torch.eye(F.shape[-1], dtype=F.dtype), _det(F)
    return mu[..., None, None] * (F @ F.mT - eye) + (lam * torch.log(J))[..., None, None] * eye


def fixed_corotated(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress τ = 2μ(F − R)Fᵀ + λ(J − 1)J I [Pa] (E2)."""
    eye, J = torch.eye(F.shape[-1], dtype=F.dtype), _det(F)
    return 2 * mu[..., None, None] * (F - polar(F)) @ F.mT + (lam * (J - 1) * J)[..., None, None] * eye


def barrier_corotated(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress τ = 2μ(F − R)Fᵀ + λ/4 (J² − J⁻²) I [Pa] (E3)."""
    eye, J = torch.eye(F.shape[-1], dtype=F.dtype), _det(F)
    pressure = lam / 4 * (J**2 - J**-2)
    return 2 * mu[..., None, None] * (F - polar(F)) @ F.mT + pressure[..., None, None] * eye


LAWS = {NeoHookean: neo_hookean, FixedCorotated: fixed_corotated, BarrierCorotated: barrier_corotated}


def _law(material: Material) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    if type(material) not in LAWS:
        raise TypeError(f"the reference has no law {type(material).__name__}; add its stress to LAWS.")
    return LAWS[type(material)]


def tangent(material: Material, F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Stiffness of the law against velocity gradients, A[G] = d/dε τ((I + εG) F) (W3) [Pa].

    Args:
        material: Whose law it is; its numbers play no part.
        F: Deformation gradients, shape (..., dim, dim), float64.
        mu, lam: Lamé's constants [Pa], shape (...).

    Returns:
        ⟨E_k, A[E_l]⟩ for the symmetric basis of :func:`strains`, shape (..., k, l).
    """
    basis = strains(F.shape[-1])
    with torch.enable_grad():
        each = F.detach().unsqueeze(-3).expand(*F.shape[:-2], *basis.shape).clone().requires_grad_()
        tau = _law(material)(each, mu[..., None], lam[..., None])
        (adj_F,) = torch.autograd.grad((tau * basis).sum(), each)
    adj_G = adj_F @ F.unsqueeze(-3).mT
    return torch.einsum("...kij,lij->...kl", adj_G, basis)


def muscle_tangent(F: Tensor, direction: Tensor) -> Tensor:
    """The same for a muscle of unit pull: A[G] = G f fᵀ + f fᵀ Gᵀ with f = F d."""
    basis, f = strains(F.shape[-1]), (F @ direction[..., None])[..., 0]
    pulled = basis @ (f[..., :, None] * f[..., None, :]).unsqueeze(-3)
    return torch.einsum("kij,...lij->...kl", basis, pulled + pulled.mT)


def strains(dim: int) -> Tensor:
    """Orthonormal basis of the symmetric matrices, shape (k, dim, dim), float64."""
    basis = []
    for i, j in itertools.combinations_with_replacement(range(dim), 2):
        strain = torch.zeros(dim, dim, dtype=torch.float64)
        strain[i, j] = strain[j, i] = 1.0 if i == j else math.sqrt(0.5)
        basis.append(strain)
    return torch.stack(basis)


def _det(F: Tensor) -> Tensor:
    """det F by its polynomial, whose derivative also exists at det F = 0."""
    if F.shape[-1] == 2:
        return F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]
    return (F[..., 0, :] * torch.linalg.cross(F[..., 1, :], F[..., 2, :])).sum(-1)


def muscle_stress(F: Tensor, direction: Tensor, pull: Tensor) -> Tensor:
    """τ = p (Fd)(Fd)ᵀ [Pa] (M1)."""
    f = (F @ direction[..., None])[..., 0]
    return pull[..., None, None] * f[..., :, None] * f[..., None, :]


def stress(scene: Scene, F: Tensor, mu: Tensor, lam: Tensor, activation: Tensor | None) -> Tensor:
    """Total τ [Pa] of each particle, (world, particle, dim, dim); ``activation`` (world, muscle) or None."""
    parts, start = [], 0
    for body in scene.bodies:
        part = slice(start, start + len(body.particles))
        parts.append(_law(body.material)(F[:, part], mu[:, part], lam[:, part]))
        start = part.stop
    tau = torch.cat(parts, 1)
    if activation is not None:
        for k, muscle in enumerate(scene.muscles):
            index, d = torch.tensor(muscle.particles), torch.tensor(muscle.direction, dtype=F.dtype)
            pull = (activation[:, k, None] * muscle.strength).expand(-1, len(index))
            tau = tau.index_add(1, index, muscle_stress(F[:, index], d.expand(len(index), -1), pull))
    return tau


def stencil(scene: Scene, x: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
    """For each of the 3^dim nodes near every particle: flat node index, weight and r = x_i − x_p (S1)."""
    dx, shape = scene.grid.spacing, scene.grid.shape
    base = torch.floor(x.detach() / dx - 0.5)
    outside = ~((base >= 0) & (base <= torch.tensor(shape) - 3)).all(-1)  # also where x is not a number
    if outside.any():
        first = tuple(outside.nonzero()[0].tolist())
        raise ValueError(
            f"particle {first[-1]} of world {first[0]} must stay half a cell inside the grid, got "
            f"x = {x[first].tolist()} m; make the grid larger or dt smaller."
        )
    nodes = []
    for offset in itertools.product(range(3), repeat=len(shape)):
        node = base + torch.tensor(offset, dtype=x.dtype)
        r = node * dx - x
        weight = _spline(r / dx).prod(-1)
        flat = torch.zeros(x.shape[:-1], dtype=torch.int64)
        for axis, count in enumerate(shape):
            flat = flat * count + node[..., axis].long()
        nodes.append((flat, weight, r))
    return nodes


def _spline(distance: Tensor) -> Tensor:
    """Quadratic B-spline of a distance in cells; |distance| ≤ 3/2 by the choice of the stencil."""
    d = distance.abs()
    return torch.where(d < 0.5, 0.75 - d**2, 0.5 * (1.5 - d) ** 2)


def p2g(scene: Scene, x: Tensor, mass: Tensor, momentum: Tensor, affine: Tensor) -> tuple[Tensor, Tensor]:
    """m_i = Σ w m_p and (mv)_i = Σ w (p + A r) (T1), shapes (world, node) and (world, node, dim)."""
    count = math.prod(scene.grid.shape)
    node_mass = x.new_zeros(len(x), count)
    node_momentum = x.new_zeros(len(x), count, x.shape[-1])
    for node, weight, r in stencil(scene, x):
        node_mass = node_mass.scatter_add(1, node, weight * mass)
        share = weight[..., None] * (momentum + (affine @ r[..., None])[..., 0])
        node_momentum = node_momentum.scatter_add(1, node[..., None].expand_as(share), share)
    return node_mass, node_momentum


def grid_velocity(scene: Scene, mass: Tensor, momentum: Tensor) -> Tensor:
    """Velocity of the nodes after gravity, damping and walls (G2), zero where there is no mass."""
    present = (mass > 0)[..., None]
    v = momentum / torch.where(mass > 0, mass, torch.ones_like(mass))[..., None]
    v = (v + scene.dt * torch.tensor(scene.gravity, dtype=v.dtype)) * math.exp(-scene.damping * scene.dt)
    for wall in scene.walls:
        v = torch.where(inside(scene, wall)[:, None] & present, respond(wall, v), v)
    return torch.where(present, v, torch.zeros_like(v))


def inside(scene: Scene, wall: Wall) -> Tensor:
    """Nodes that a wall acts on: n·(i dx) ≤ offset, summed axis by axis in float64; shape (node,)."""
    reach = torch.zeros((), dtype=torch.float64)
    for n, count in zip(wall.normal, scene.grid.shape, strict=True):
        reach = reach[..., None] + n * (torch.arange(count, dtype=torch.float64) * scene.grid.spacing)
    return (reach <= wall.offset).flatten()


def respond(wall: Wall, v: Tensor) -> Tensor:
    """Velocity of a node inside a wall (C1 to C3)."""
    n = torch.tensor(wall.normal, dtype=v.dtype)
    if wall.contact == "stick":
        return torch.zeros_like(v)
    v_n = (v * n).sum(-1, keepdim=True)
    v_t = v - v_n * n
    if wall.contact == "slip":
        return v_t
    if wall.contact != "separate":
        raise ValueError(f"the reference has no contact {wall.contact!r}; add it to respond.")
    if wall.friction > 0:
        squared = (v_t**2).sum(-1, keepdim=True)
        moving = squared > (wall.friction * v_n) ** 2  # not stuck
        speed = torch.sqrt(torch.where(moving, squared, torch.ones_like(squared)))
        v_t = torch.where(moving, v_t * (1 + wall.friction * v_n / speed), torch.zeros_like(v_t))
    return torch.where(v_n < 0, v_t, v)


def g2p(scene: Scene, x: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
    """v = Σ w v_i and C = Σ w v_i rᵀ / D (T2)."""
    v, C, D = torch.zeros_like(x), x.new_zeros(*x.shape, x.shape[-1]), scene.grid.spacing**2 / 4
    for node, weight, r in stencil(scene, x):
        share = weight[..., None] * velocity.gather(1, node[..., None].expand_as(x))
        v = v + share
        C = C + share[..., :, None] * r[..., None, :] / D
    return v, C


def _volume(scene: Scene, dtype: torch.dtype) -> Tensor:
    """Rest volumes V⁰ [m³], in 2D [m²], shape (particle,)."""
    return torch.cat([torch.tensor(body.particles.volume, dtype=dtype) for body in scene.bodies])


def step(
    scene: Scene, state: State, activation: Tensor | None, mu: Tensor, lam: Tensor, mass: Tensor
) -> State:
    """One substep: P2G, grid, G2P. ``activation`` (world, muscle) or None; material (world, particle)."""
    tau, D = stress(scene, state.F, mu, lam, activation), scene.grid.spacing**2 / 4
    load = scene.dt * _volume(scene, mass.dtype) / D
    affine = mass[..., None, None] * state.C - load[:, None, None] * tau
    node_mass, momentum = p2g(scene, state.x, mass, mass[..., None] * state.v, affine)
    v, C = g2p(scene, state.x, grid_velocity(scene, node_mass, momentum))
    return State(state.x + scene.dt * v, v, C, state.F + scene.dt * C @ state.F)


def simulate(
    scene: Scene, start: State, activation: Tensor | None, params: Params, *, substeps: int
) -> State:
    """The contract of :func:`softmpm.simulate`, on a scene instead of a model."""
    lead = start.x.shape[:2]
    young, poisson, density = (value.expand(lead) for value in params)
    mu, lam = lame(young, poisson)
    mass, state = density * _volume(scene, density.dtype), start
    for row in [None] if activation is None else activation:
        for _ in range(substeps):
            state = step(scene, state, row, mu, lam, mass)
    return state


def rasterize(scene: Scene, state: State, density: Tensor) -> GridField:
    """Mass and velocity on the nodes without forces (O1); ``density`` broadcasts to (world, particle)."""
    mass = (density * _volume(scene, density.dtype)).expand(state.x.shape[:2])
    affine = mass[..., None, None] * state.C
    node_mass, momentum = p2g(scene, state.x, mass, mass[..., None] * state.v, affine)
    velocity = momentum / torch.where(node_mass > 0, node_mass, torch.ones_like(node_mass))[..., None]
    shape = scene.grid.shape
    return GridField(node_mass.view(-1, *shape), velocity.view(-1, *shape, len(shape)))
