"""Elastic energy per volume at rest of each law, in plain PyTorch. Derivation: docs/math/elasticity.md.

In H = F − I, j = det F − 1 (a polynomial in H), s = |F|² − d and the rotation R = I + Q of F:

    neo-Hookean:         ψ = μ (s/2 − log(1 + j)) + λ/2 log²(1 + j)                                  (E7)
    fixed corotated:     ψ = μ |H − Q|² + λ/2 j²                                                     (E8)
    barrier corotated:   ψ = μ |H − Q|² + λ/8 (j (2 + j) / (1 + j))²                                 (E9)
    stable neo-Hookean:  ψ = 2/3 μ (s − log(1 + s/4)) + (λ + 5/6 μ)/2 j² − μ j                       (E10)

Each is zero at rest, and its derivative is the first Piola-Kirchhoff stress. The first terms of a density cancel at small strain, so H
should be float64.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from softmpm.batches import Adjoint
from softmpm.scene.materials import BarrierCorotated, FixedCorotated, Material, NeoHookean, StableNeoHookean

_SQUARINGS = 20
"""The largest eigenvalue of a matrix to the power 2^20 stands out even where it is 1e-5 of itself above the next one."""


def neo_hookean(H: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """(E7) [J/m³]; NaN for det F < 0."""
    log = torch.log1p(volume_change(H))
    return mu * (_square(H) / 2 - log) + lam / 2 * log**2


def fixed_corotated(H: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """(E8) [J/m³]."""
    return mu * _distance(H) + lam / 2 * volume_change(H) ** 2


def barrier_corotated(H: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """(E9) [J/m³]."""
    j = volume_change(H)
    return mu * _distance(H) + lam / 8 * (j * (2 + j) / (1 + j)) ** 2


def stable_neo_hookean(H: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """(E10) [J/m³]."""
    s, j = _square(H), volume_change(H)
    return 2 / 3 * mu * (s - torch.log1p(s / 4)) + (lam + 5 / 6 * mu) / 2 * j**2 - mu * j


DENSITIES: dict[type[Material], Callable[[Tensor, Tensor, Tensor], Tensor]] = {
    NeoHookean: neo_hookean,
    StableNeoHookean: stable_neo_hookean,
    FixedCorotated: fixed_corotated,
    BarrierCorotated: barrier_corotated,
}
"""Energy density of each law, a function of H (..., dim, dim), μ and λ [Pa] (...)."""


def volume_change(H: Tensor) -> Tensor:
    """j = det(I + H) − 1, shape (...)."""
    trace = H.diagonal(dim1=-2, dim2=-1).sum(-1)
    if H.shape[-1] == 2:
        return trace + H[..., 0, 0] * H[..., 1, 1] - H[..., 0, 1] * H[..., 1, 0]
    squared = (trace**2 - (H * H.mT).sum((-2, -1))) / 2
    a, b, c = H.unbind(-2)
    return trace + squared + (a * torch.linalg.cross(b, c)).sum(-1)


def _square(H: Tensor) -> Tensor:
    """s = |F|² − d."""
    return 2 * H.diagonal(dim1=-2, dim2=-1).sum(-1) + (H**2).sum((-2, -1))


def _distance(H: Tensor) -> Tensor:
    """|F − R|²."""
    return _Distance.apply(H)


class _Distance(torch.autograd.Function):
    """|F − R|². R is the nearest rotation, so that its derivative does not contribute to the first derivative, and only to that."""

    generate_vmap_rule = True

    @staticmethod
    def forward(H: Tensor) -> Tensor:
        return ((H - rotation_change(H)) ** 2).sum((-2, -1))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def backward(ctx, adj):
        return _DistanceAdj.apply(*ctx.saved_tensors, adj)

    @staticmethod
    def jvp(ctx, tangent):
        (H,) = ctx.saved_tensors
        return (_DistanceAdj.apply(H, torch.ones_like(H[..., 0, 0])) * tangent).sum((-2, -1))


class _DistanceAdj(Adjoint):
    generate_vmap_rule = True

    @staticmethod
    def forward(H: Tensor, adj: Tensor) -> Tensor:
        return 2 * adj[..., None, None] * (H - rotation_change(H))


def rotation_change(H: Tensor) -> Tensor:
    """Q = R − I of the proper rotation R nearest to F, also for det F < 0, shape (..., dim, dim).

    In three dimensions the unit quaternion of R is the eigenvector of the largest eigenvalue of Davenport's matrix K(F). Squaring
    K + c I time and again finds it without a factorisation, which a CUDA graph could not capture.
    """
    if H.shape[-1] == 2:
        a, b = 2 + H[..., 0, 0] + H[..., 1, 1], H[..., 1, 0] - H[..., 0, 1]
        r = torch.hypot(a, b)
        less = torch.where(a > 0, -(b**2) / (r * (r + a)), a / r - 1)  # cos − 1
        return torch.stack([less, -b / r, b / r, less], -1).unflatten(-1, (2, 2))
    power = _davenport(H)
    for _ in range(_SQUARINGS):
        power = power @ power
        power = power / power.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    largest = power.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = power.gather(-1, largest[..., None, None].expand(*largest.shape, 4, 1))[..., 0]
    w, x, y, z = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [-y * y - z * z, x * y - w * z, x * z + w * y]
    rows += [x * y + w * z, -x * x - z * z, y * z - w * x]
    rows += [x * z - w * y, y * z + w * x, -x * x - y * y]
    return 2 * torch.stack(rows, -1).unflatten(-1, (3, 3))


def _davenport(H: Tensor) -> Tensor:
    """K(F) + √3 |F| I, which has no negative eigenvalue; qᵀ K q = tr(RᵀF) for the rotation R of the unit quaternion q."""
    F = H + torch.eye(3, dtype=H.dtype, device=H.device)
    trace = F.diagonal(dim1=-2, dim2=-1).sum(-1)
    axis = torch.stack(
        [F[..., 2, 1] - F[..., 1, 2], F[..., 0, 2] - F[..., 2, 0], F[..., 1, 0] - F[..., 0, 1]], -1
    )
    eye = torch.eye(4, dtype=H.dtype, device=H.device)
    shift = 3**0.5 * F.norm(dim=(-2, -1))
    K = shift[..., None, None] * eye
    K[..., 0, 0] += trace
    K[..., 0, 1:] = K[..., 1:, 0] = axis
    K[..., 1:, 1:] += F + F.mT - trace[..., None, None] * eye[1:, 1:]
    return K
