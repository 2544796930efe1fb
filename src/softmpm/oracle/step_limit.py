"""Step limit of the total Lagrangian formulation in plain float64 PyTorch, by principal stretches; no code shared with kernels.

    K = σ + mean of the eigenvalues of M + √(d − 1) times their standard deviation ≥ λ_max(𝔸 + (2s/Δt) 𝕍)         (Q8)
    M = f'' c cᵀ + f' N + κ s sᵀ + v diag(s²),   c_i = J/s_i,   N_ij = ∂²J/∂s_i∂s_j

The energies are g(|F|²) + f(J), and their derivatives those that PyTorch finds. Derivation: docs/math/lagrangian.md.
"""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from softmpm.scene.actuators import Actuator, Muscle, Pressure
from softmpm.scene.materials import BarrierCorotated, FixedCorotated, Material, NeoHookean, StableNeoHookean
from softmpm.scene.scene import Scene


def _no_volume(J: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    return lam / 2 * (J - 1) ** 2


def _barrier(J: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    return lam / 8 * (J - 1 / J) ** 2


def _logarithm(J: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    return lam / 2 * torch.log(J) ** 2 - mu * torch.log(J)


def _smith(J: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    l = lam + 5 / 6 * mu
    return l / 2 * J**2 - (l + mu) * J


def _quadratic(squared: Tensor, mu: Tensor, dim: int) -> Tensor:
    return mu / 2 * squared


def _corotated(squared: Tensor, mu: Tensor, dim: int) -> Tensor:
    """μ |F|², of which μ |F − R|² is only part: the rest, −2μ tr S, has no positive curvature."""
    return mu * squared


def _smith_shape(squared: Tensor, mu: Tensor, dim: int) -> Tensor:
    squared = squared + (3 - dim)
    return 2 / 3 * mu * (squared - torch.log(squared + 1))


ENERGIES: dict[type[Material], tuple[Callable[..., Tensor], Callable[..., Tensor]]] = {
    NeoHookean: (_quadratic, _logarithm),
    StableNeoHookean: (_smith_shape, _smith),
    FixedCorotated: (_corotated, _no_volume),
    BarrierCorotated: (_corotated, _barrier),
}
"""g(|F|²) and f(J) of each law [Pa]; both are linear in μ and λ."""
STIFFENING: dict[type[Actuator], Callable[[float], tuple[float, float]]] = {
    Muscle: lambda stress: (max(stress, 0.0), 0.0),
    Pressure: lambda stress: (0.0, stress),
}
"""Contribution of an actuator of each kind with an active stress to ``pull`` and to ``pressure`` of :func:`stiffness` [Pa]."""


def stiffness(
    material: Material,
    F: Tensor,
    mu: Tensor,
    lam: Tensor,
    pull: Tensor | float = 0.0,
    pressure: Tensor | float = 0.0,
    damping: Tensor | float = 0.0,
) -> Tensor:
    """K of (Q8) [Pa], shape (...).

    Args:
        material: Whose law it is; its numbers play no part.
        F: Deformation gradients, shape (..., dim, dim), float64.
        mu, lam: Lamé's constants [Pa], shape (...).
        pull: Sum of the positive active stresses of muscles [Pa].
        pressure: Sum of the active stresses of pressures [Pa].
        damping: v = 4 η s/Δt [Pa].
    """
    dim, (shape, volume) = F.shape[-1], ENERGIES[type(material)]
    stretches = torch.linalg.svdvals(F)
    signs = torch.ones_like(stretches)
    signs[..., -1] = torch.linalg.det(F).sign()
    s = stretches * signs
    J = s.prod(-1)
    none = torch.zeros_like(J)
    slope, of_mu = _derivatives(lambda J: volume(J, mu, none), J)
    of_lam_slope, of_lam = _derivatives(lambda J: volume(J, none, lam), J)
    slope = slope + of_lam_slope - pressure
    curvature = of_mu.clamp(min=0) + of_lam.clamp(min=0)
    first, second = _derivatives(lambda squared: shape(squared, mu, dim), (s**2).sum(-1))
    c = torch.stack([_product(s, (i,)) for i in range(dim)], -1)
    N = torch.zeros(*s.shape, dim, dtype=s.dtype)
    for i, k in itertools.permutations(range(dim), 2):
        N[..., i, k] = _product(s, (i, k))
    M = _outer(curvature, c) + slope[..., None, None] * N + _outer(4 * second, s)
    M = M + torch.diag_embed(torch.as_tensor(damping)[..., None] * s**2)
    found = torch.linalg.eigvalsh(M)
    return 2 * first + pull + found.mean(-1) + math.sqrt(dim - 1) * found.std(-1, correction=0)


def _derivatives(f: Callable[[Tensor], Tensor], at: Tensor) -> tuple[Tensor, Tensor]:
    """First and second derivative of a function of each number."""
    with torch.enable_grad():
        at = at.detach().clone().requires_grad_()
        curved = 0 * (at**3).sum()  # else a linear function had no second derivative
        (first,) = torch.autograd.grad(f(at).sum() + curved, at, create_graph=True)
        (second,) = torch.autograd.grad(first.sum(), at)
    return first.detach(), second


def _product(s: Tensor, without: tuple[int, ...]) -> Tensor:
    """Product of the stretches but for some."""
    return s[..., [k for k in range(s.shape[-1]) if k not in without]].prod(-1)


def _outer(factor: Tensor, a: Tensor) -> Tensor:
    return factor[..., None, None] * a[..., :, None] * a[..., None, :]


def running_limit(
    scene: Scene,
    particle: int,
    mu: float,
    lam: float,
    density: float,
    F: Tensor,
    active_stress: list[float],
    viscosity: float = 0.0,
) -> float:
    """Stable step [s] of one particle of the reference formulation as it is at a moment of a run, by (Q8) and (W4).

    Arguments as for :func:`softmpm.stability.running_limit`; a fibre's direction plays no part.
    """
    with torch.inference_mode(False), torch.device("cpu"):
        F = F.detach().cpu().double()
        of_mu, of_lam = torch.tensor([mu, lam], dtype=torch.float64).unbind()
        material = scene.bodies[scene.body_index[particle]].material
        acting = [
            STIFFENING[type(muscle)](stress)
            for muscle, stress in zip(scene.muscles, active_stress, strict=True)
            if particle in muscle.particles
        ]
        pull, pressure = (sum(terms) for terms in zip((0.0, 0.0), *acting, strict=True))
        if not bool(torch.isfinite(F).all()):
            return math.nan

        def K(rate: float) -> float:
            damping = 4 * viscosity * rate
            return max(stiffness(material, F, of_mu, of_lam, pull, pressure, damping).item(), 0.0)

        inertia, most = density * scene.grid.spacing**2, 4 * viscosity * float((F**2).sum())
        rate = (most + math.hypot(most, math.sqrt(4 * K(0.0) * inertia))) / inertia  # above the fixed point
        for _ in range(200 if viscosity > 0 else 1):
            last, rate = rate, math.sqrt(K(rate) / inertia)
            if last - rate <= 1e-14 * last:
                break
    return 1 / rate if rate > 0 else math.inf
