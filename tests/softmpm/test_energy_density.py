"""Energy densities against the stress of the float64 oracle, which is written down independently of them."""

import numpy as np
import pytest
import torch
from helpers import LAWS
from oracle_scenes import DIMS, randn

from softmpm.energy_density import DENSITIES, rotation_change, volume_change
from softmpm.oracle import stress

MU, LAM = torch.tensor(3.0, dtype=torch.float64), torch.tensor(5.0, dtype=torch.float64)


def rotations(count: int, dim: int, seed: int) -> torch.Tensor:
    Q = torch.linalg.qr(randn(count, dim, dim, seed=seed))[0]
    return Q * torch.cat(
        [torch.ones(count, 1, dim - 1), torch.linalg.det(Q)[:, None, None].expand(-1, 1, 1)], -1
    )


def stretched(dim: int) -> torch.Tensor:
    """U diag(s) Vᵀ with all rotations: at rest, rotated, half turns, equal stretches, a flat and a long one, shape (case, dim, dim)."""
    stretches = [
        (1.0, 1.0, 1.0),
        (2.0, 1.0, 1.0),
        (2.0, 2.0, 1.0),
        (1.5, 0.6, 0.9),
        (0.2, 0.1, 0.15),
        (3.0, 1e-2, 2e-2),
    ]
    s = torch.tensor(stretches, dtype=torch.float64)[:, :dim].repeat_interleave(4, 0)
    F = rotations(len(s), dim, 1) @ torch.diag_embed(s) @ rotations(len(s), dim, 2).mT
    special = [
        torch.eye(dim),
        torch.diag(torch.tensor([-1.0, -1.0, 1.0])[:dim]),
        torch.eye(dim) + 1e-9 * randn(dim, dim),
    ]
    return torch.cat([F, torch.stack([one.double() for one in special])])


def inverted(dim: int) -> torch.Tensor:
    s = torch.tensor([(1.1, -0.4, 0.9), (1.2, -0.4, 1.2), (0.5, -0.1, 0.5)], dtype=torch.float64)[:, :dim]
    return rotations(len(s), dim, 3) @ torch.diag_embed(s) @ rotations(len(s), dim, 4).mT


@DIMS
@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_the_derivative_is_the_stress(law, dim):
    """P Fᵀ = τ to 1e-11 of the size of the stress, also for det F < 0 where the law has a stress there; ψ = 0 at rest."""
    F = torch.cat([stretched(dim), inverted(dim)]) if law.survives_inversion else stretched(dim)
    F.requires_grad_()
    eye = torch.eye(dim, dtype=torch.float64)
    density = DENSITIES[law](F - eye, MU, LAM)
    (P,) = torch.autograd.grad(density.sum(), F)
    F = F.detach()
    want = stress.LAWS[law](F, MU, LAM)
    size = (want.abs().amax((-2, -1)) + MU)[:, None, None]
    assert (((P @ F.mT - want) / size).abs() <= 1e-11).all()
    rigid = DENSITIES[law](rotations(5, dim, 7) - eye, MU, LAM)
    assert (rigid.abs() <= 1e-14).all() and (density > -1e-14).all()


@DIMS
@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_the_derivative_by_the_material_follows_the_stress(law, dim):
    """∂/∂μ and ∂/∂λ of ψ are the works of ∂τ/∂μ and ∂τ/∂λ on the way from rest, by Gauss's rule with 40 points: ≤ 1e-12."""
    H, eye = 0.3 * randn(dim, dim, seed=5), torch.eye(dim, dtype=torch.float64)
    constants = [MU.clone().requires_grad_(), LAM.clone().requires_grad_()]
    got = torch.autograd.grad(DENSITIES[law](H, *constants), constants)
    places, weights = map(torch.from_numpy, np.polynomial.legendre.leggauss(40))
    F = eye + (places + 1)[:, None, None] / 2 * H
    tau = stress.LAWS[law](F, *constants)
    work = ((tau @ torch.linalg.inv(F).mT * H).sum((-2, -1)) * weights / 2).sum()
    for one, other in zip(got, torch.autograd.grad(work, constants), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-13)


@DIMS
@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_small_strains_keep_their_digits(law, dim):
    """ψ is μ |e|² + λ/2 tr² e of the symmetric part e of H, at strains of 1e-8: ≤ 1e-6 relative."""
    H = 1e-8 * randn(20, dim, dim, seed=6)
    e = (H + H.mT) / 2
    want = MU * (e**2).sum((-2, -1)) + LAM / 2 * e.diagonal(dim1=-2, dim2=-1).sum(-1) ** 2
    torch.testing.assert_close(DENSITIES[law](H, MU, LAM), want, rtol=1e-6, atol=0)


@DIMS
def test_the_rotation_is_the_nearest_one(dim):
    """That of a singular value decomposition, also for det F < 0; of a nearly flat particle to 1e-9."""
    F = torch.cat([stretched(dim), inverted(dim)])
    eye = torch.eye(dim, dtype=torch.float64)
    torch.testing.assert_close(rotation_change(F - eye) + eye, stress.polar(F), rtol=0, atol=1e-9)


@DIMS
def test_the_change_of_volume(dim):
    """det(I + H) − 1."""
    H = randn(10, dim, dim, seed=8)
    want = torch.linalg.det(H + torch.eye(dim, dtype=torch.float64)) - 1
    torch.testing.assert_close(volume_change(H), want, rtol=1e-12, atol=1e-12)
