"""The rotation of F against NumPy's SVD; its adjoint against finite differences, for a random cotangent."""

import numpy as np
import pytest
import torch
from blocks import apply, special_deformations, svd_rotation

from softmpm.kernels.physics.polar import polar
from softmpm.kernels.structs import types

DTYPES = {"float32": torch.float32, "float64": torch.float64}


def rotation(dim, dtype, H):
    mat = types(dim, dtype).mat
    return apply(polar(dim, dtype).rotation, mat, (dim, dim), (H.to(DTYPES[dtype]), mat)).double()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype, limit", [("float64", 1e-14), ("float32", 4e-7)])
def test_rotation_is_that_of_the_svd(dim, dtype, limit, device):
    """At every special point, including det F < 0 and half turns."""
    points = special_deformations(dim)
    H = torch.stack(list(points.values())).to(device) - torch.eye(dim, dtype=torch.float64, device=device)
    got = rotation(dim, dtype, H).cpu() + torch.eye(dim, dtype=torch.float64)
    for (name, F), R in zip(points.items(), got, strict=True):
        scale = 1 if dtype == "float64" else max(1.0, F.norm().item())
        assert np.abs(R.numpy() - svd_rotation(F.numpy())).max() < limit * scale * 10, name


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype, limit", [("float64", 4e-14), ("float32", 3e-6)])
def test_rotation_of_many(dim, dtype, limit, device):
    """Stretches of 1 : 50, half of them turned inside out, two cancelling to a hundredth at most; the error over their sum."""
    generator = torch.Generator().manual_seed(4)
    turn = torch.linalg.qr(torch.randn(2, 20_000, dim, dim, generator=generator, dtype=torch.float64))[0]
    stretch = torch.exp(4 * torch.rand(20_000, dim, generator=generator, dtype=torch.float64)).sort(1, True)[
        0
    ]
    U, V = (Q * torch.linalg.det(Q)[:, None, None].sign() if dim == 3 else Q for Q in turn)
    stretch[::2, -1] *= -1
    F = (U * stretch[:, None, :]) @ V
    sums = (stretch[:, -2] + torch.linalg.det(U @ V).sign() * stretch[:, -1]) / stretch[:, 0]
    F, sums = F[sums > 0.01], sums[sums > 0.01]
    H = (F - torch.eye(dim)).to(DTYPES[dtype]).double()
    R = rotation(dim, dtype, H.to(device)).cpu() + torch.eye(dim)
    error = (R - torch.from_numpy(svd_rotation((H + torch.eye(dim)).numpy()))).abs().amax((1, 2))
    assert (error * sums).max() < limit


@pytest.mark.parametrize("size", [1e-6, 1e-9])
@pytest.mark.parametrize("dim", [2, 3])
def test_rotation_keeps_the_digits_of_a_small_deformation(dim, size):
    """R − I is right to the last digits of float32 when H is 1e-6: it is not the difference of two large numbers."""
    generator = torch.Generator().manual_seed(0)
    H = size * torch.randn(20, dim, dim, generator=generator)
    got, exact = rotation(dim, "float32", H), rotation(dim, "float64", H.double())
    skew = 0.5 * (H - H.mT).double()
    assert (
        exact - skew
    ).abs().max() < 10 * size**2 + 1e-15  # so that `exact` is not only compared with itself
    assert (got - exact).abs().max() < 3e-7 * size


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("of", ["rotation", "strain"])
def test_the_adjoint_is_the_finite_difference(dim, of, device):
    """⟨W, R⟩ and ⟨W, F − R⟩ for random W, central differences along every entry of F, at every special point."""
    points = {k: F for k, F in special_deformations(dim).items() if k not in ("nearly flat",)}
    generator = torch.Generator().manual_seed(1)
    mat, eye, h = types(dim, "float64").mat, torch.eye(dim, dtype=torch.float64), 1e-6
    H = torch.stack(list(points.values())) - eye
    W = torch.randn(H.shape, generator=generator, dtype=torch.float64)
    adjoint = getattr(polar(dim, "float64"), f"{of}_adj")
    Q = rotation(dim, "float64", H.to(device))
    got = apply(adjoint, mat, (dim, dim), (H.to(device), mat), (Q, mat), (W.to(device), mat)).cpu()
    for n, (name, F) in enumerate(points.items()):
        want = torch.zeros(dim, dim, dtype=torch.float64)
        for i in range(dim):
            for j in range(dim):
                step = np.zeros((dim, dim))
                step[i, j] = h
                change = svd_rotation(F.numpy() + step) - svd_rotation(F.numpy() - step)
                if of == "strain":
                    change = 2 * step - change
                want[i, j] = float((W[n].numpy() * change).sum() / (2 * h))
        error = (got[n] - want).abs().max() / want.abs().max().clamp_min(1.0)
        assert error < 1e-8, (name, error.item())


@pytest.mark.parametrize("dim", [2, 3])
def test_rounding_of_the_adjoint_of_the_strain_turns_nothing(dim):
    """For a cotangent W F, which turns the body, ⟨W, F̄ Fᵀ⟩ in float32 is that in float64 to 1e-9 where strains are 1e-3."""
    generator = torch.Generator().manual_seed(2)
    R = torch.linalg.qr(torch.randn(500, dim, dim, generator=generator, dtype=torch.float64))[0]
    R[:, :, 0] *= torch.linalg.det(R)[:, None]
    E, W = torch.randn(2, 500, dim, dim, generator=generator, dtype=torch.float64)
    eye = torch.eye(dim, dtype=torch.float64)
    H, skew = (
        (R @ (eye + 5e-4 * (E + E.mT)) - eye).float(),
        (W - W.mT) / (W - W.mT).norm(dim=(1, 2))[:, None, None],
    )
    Q, turned = rotation(dim, "float32", H), (skew @ (eye + H)).float()

    def power(dtype):
        mat, real = types(dim, dtype).mat, DTYPES[dtype]
        given = (H.to(real), mat), (Q.to(real), mat), (turned.to(real), mat)
        adj = apply(polar(dim, dtype).strain_adj, mat, (dim, dim), *given).double()
        return (skew * (adj @ (eye + H).mT)).sum((1, 2))

    assert (power("float32") - power("float64")).abs().mean() < 1e-9


def test_rotation_adj_is_not_finite_where_the_rotation_is_not_unique():
    """s₂ + s₃ = 0 has no derivative: the adjoint is not finite there."""
    F = torch.diag(torch.tensor([1.0, 0.5, -0.5], dtype=torch.float64))
    mat, eye = types(3, "float64").mat, torch.eye(3, dtype=torch.float64)
    H = (F - eye)[None]
    Q = torch.zeros_like(H)  # R = I is one of the maximisers
    W = torch.ones_like(H).triu()
    got = apply(polar(3, "float64").rotation_adj, mat, (3, 3), (H, mat), (Q, mat), (W, mat))
    assert not torch.isfinite(got).all()
