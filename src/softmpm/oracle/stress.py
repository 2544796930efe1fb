"""Stress of a particle in plain float64 PyTorch, and its tangents: the part of :mod:`softmpm.oracle.moving` that knows no grid.

Derivations and labels: docs/math/elasticity.md, docs/math/alarms.md.
"""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from softmpm.scene.actuators import Actuator, Muscle, Pressure
from softmpm.scene.materials import BarrierCorotated, FixedCorotated, Material, NeoHookean, StableNeoHookean


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
    eye, J = torch.eye(F.shape[-1], dtype=F.dtype), det(F)
    return mu[..., None, None] * (F @ F.mT - eye) + (lam * torch.log(J))[..., None, None] * eye


def fixed_corotated(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress τ = 2μ(F − R)Fᵀ + λ(J − 1)J I [Pa] (E2)."""
    eye, J = torch.eye(F.shape[-1], dtype=F.dtype), det(F)
    return 2 * mu[..., None, None] * (F - polar(F)) @ F.mT + (lam * (J - 1) * J)[..., None, None] * eye


def barrier_corotated(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress τ = 2μ(F − R)Fᵀ + λ/4 (J² − J⁻²) I [Pa] (E3)."""
    eye, J = torch.eye(F.shape[-1], dtype=F.dtype), det(F)
    pressure = lam / 4 * (J**2 - J**-2)
    return 2 * mu[..., None, None] * (F - polar(F)) @ F.mT + pressure[..., None, None] * eye


def stable_neo_hookean(F: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Kirchhoff stress P Fᵀ [Pa] of the energy of Smith et al. 2018, with their constants of (μ, λ) (E5).

    ψ = m/2 (I − 3) + l/2 (J − a)² − m/2 log(I + 1), where I is the squared norm of the deformation gradient in three dimensions:
    in plane strain the third stretch is 1.
    """
    m, l = 4 / 3 * mu, lam + 5 / 6 * mu
    a, J = 1 + 3 / 4 * m / l, det(F)
    squared = (F**2).sum((-2, -1)) + (3 - F.shape[-1])
    P_F = (m * (1 - 1 / (squared + 1)))[..., None, None] * F @ F.mT
    return P_F + (l * (J - a) * J)[..., None, None] * torch.eye(F.shape[-1], dtype=F.dtype)


LAWS = {
    NeoHookean: neo_hookean,
    StableNeoHookean: stable_neo_hookean,
    FixedCorotated: fixed_corotated,
    BarrierCorotated: barrier_corotated,
}


def law_of(material: Material) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    if type(material) not in LAWS:
        known = ", ".join(law.__name__ for law in LAWS)
        raise TypeError(
            f"softmpm has no law {type(material).__name__}, only {known}; docs/extending.md says how a further one is added."
        )
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
        tau = law_of(material)(each, mu[..., None], lam[..., None])
        (adj_F,) = torch.autograd.grad((tau * basis).sum(), each)
    adj_G = adj_F @ F.unsqueeze(-3).mT
    return torch.einsum("...kij,lij->...kl", adj_G, basis)


def muscle_tangent(F: Tensor, direction: Tensor) -> Tensor:
    """The same for a muscle of unit active stress: A[G] = G f fᵀ + f fᵀ Gᵀ with f = F d."""
    basis, f = strains(F.shape[-1]), (F @ direction[..., None])[..., 0]
    turned = basis @ (f[..., :, None] * f[..., None, :]).unsqueeze(-3)
    return torch.einsum("kij,...lij->...kl", basis, turned + turned.mT)


def pressure_tangent(F: Tensor, direction: Tensor | None = None) -> Tensor:
    """The same for a unit pressure: A[G] = −J tr(G) I."""
    trace = strains(F.shape[-1]).diagonal(dim1=-2, dim2=-1).sum(-1)
    return -det(F)[..., None, None] * torch.outer(trace, trace)


def viscous_stress(F: Tensor, C: Tensor, viscosity: Tensor) -> Tensor:
    """τ = F S Fᵀ = 2η B D B [Pa] for the second Piola-Kirchhoff stress S = 2η Ė, with B = FFᵀ and D = sym(C) (E6)."""
    B, D = F @ F.mT, (C + C.mT) / 2
    return 2 * viscosity[..., None, None] * B @ D @ B


def viscous_tangent(F: Tensor) -> Tensor:
    """Damping of unit viscosity against velocity gradients, V[G] = 2 B G B (W4), in the form of :func:`tangent`."""
    basis, B = strains(F.shape[-1]), (F @ F.mT).unsqueeze(-3)
    return 2 * torch.einsum("kij,...lij->...kl", basis, B @ basis @ B)


def strains(dim: int) -> Tensor:
    """Orthonormal basis of the symmetric matrices, shape (k, dim, dim), float64."""
    basis = []
    for i, j in itertools.combinations_with_replacement(range(dim), 2):
        strain = torch.zeros(dim, dim, dtype=torch.float64)
        strain[i, j] = strain[j, i] = 1.0 if i == j else math.sqrt(0.5)
        basis.append(strain)
    return torch.stack(basis)


def det(F: Tensor) -> Tensor:
    """det F by its polynomial, whose derivative also exists at det F = 0."""
    if F.shape[-1] == 2:
        return F[..., 0, 0] * F[..., 1, 1] - F[..., 0, 1] * F[..., 1, 0]
    return (F[..., 0, :] * torch.linalg.cross(F[..., 1, :], F[..., 2, :])).sum(-1)


def muscle_stress(F: Tensor, direction: Tensor, active_stress: Tensor) -> Tensor:
    """τ = p (Fd)(Fd)ᵀ [Pa] (M1)."""
    f = (F @ direction[..., None])[..., 0]
    return active_stress[..., None, None] * f[..., :, None] * f[..., None, :]


def pressure_stress(F: Tensor, direction: Tensor | None, pressure: Tensor) -> Tensor:
    """τ = −p J I [Pa] (M2)."""
    return -(pressure * det(F))[..., None, None] * torch.eye(F.shape[-1], dtype=F.dtype)


ACTUATORS = {Muscle: (muscle_stress, muscle_tangent), Pressure: (pressure_stress, pressure_tangent)}
"""Stress and tangent of each kind, which may not look at the fibre direction."""


def actuator_stress(actuator: Actuator, F: Tensor, direction: Tensor, p: Tensor) -> Tensor:
    """Active stress [Pa] for the product p of activation and strength [Pa]."""
    return _kind(actuator)[0](F, direction, p)


def actuator_tangent(actuator: Actuator, F: Tensor, direction: Tensor | None = None) -> Tensor:
    """As :func:`tangent` for an actuator of unit activation times strength; a unit ``direction`` replaces that of the actuator."""
    if direction is None:
        direction = torch.tensor(getattr(actuator, "direction", ()), dtype=torch.float64)
    return _kind(actuator)[1](F, direction)


def _kind(actuator: Actuator) -> tuple[Callable[..., Tensor], Callable[..., Tensor]]:
    if type(actuator) not in ACTUATORS:
        raise TypeError(f"the oracle has no actuator {type(actuator).__name__}; add it to ACTUATORS.")
    return ACTUATORS[type(actuator)]
