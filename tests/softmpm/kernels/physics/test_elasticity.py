"""Stress of each law against NumPy; its adjoint against finite differences, for a random cotangent."""

import numpy as np
import pytest
import torch
import warp as wp
from blocks import apply, special_deformations, svd_rotation

from softmpm import BarrierCorotated, FixedCorotated, NeoHookean, reference
from softmpm.kernels.physics.elasticity import elasticity
from softmpm.kernels.physics.muscle import muscle
from softmpm.kernels.structs import types

MU, LAM = 3.0, 5.0


def numpy_stress(law: str, F: np.ndarray, mu=MU, lam=LAM) -> np.ndarray:
    J, eye = np.linalg.det(F), np.eye(len(F))
    if law == "neo_hookean":
        return mu * (F @ F.T - eye) + lam * np.log(J) * eye
    pressure = {"fixed_corotated": (J - 1) * J, "barrier_corotated": (J**2 - J**-2) / 4}[law]
    return 2 * mu * (F - svd_rotation(F)) @ F.T + lam * pressure * eye


def points(dim: int, law: str) -> dict[str, torch.Tensor]:
    """Where the law is defined and smooth."""
    found = special_deformations(dim)
    found.pop("nearly flat")
    return {name: F for name, F in found.items() if law == "fixed_corotated" or torch.linalg.det(F) > 0}


def arguments(law: str, dim: int, dtype: str, H: torch.Tensor):
    """H, and what else the blocks of the law take: its rotation, μ and λ."""
    t, real = types(dim, dtype), getattr(torch, dtype)
    Q = apply(elasticity(dim, dtype).rotation[law], t.mat, (dim, dim), (H.to(real), t.mat))
    mu, lam = (torch.full((len(H),), value, dtype=real, device=H.device) for value in (MU, LAM))
    return (H.to(real), t.mat), (Q, t.mat), (mu, t.real), (lam, t.real)


LAWS = ["neo_hookean", "fixed_corotated", "barrier_corotated"]


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype, limit", [("float64", 1e-13), ("float32", 2e-6)])
def test_stress_is_the_law(law, dim, dtype, limit, device):
    """τ of (E1) to (E3), at every special point."""
    given, mat = points(dim, law), types(dim, dtype).mat
    H = torch.stack(list(given.values())).to(device) - torch.eye(dim, dtype=torch.float64, device=device)
    got = (
        apply(elasticity(dim, dtype).stress[law], mat, (dim, dim), *arguments(law, dim, dtype, H))
        .cpu()
        .double()
    )
    for (name, F), tau in zip(given.items(), got, strict=True):
        want = numpy_stress(law, F.numpy())
        assert np.abs(tau.numpy() - want).max() <= limit * max(1.0, float((F**2).sum())) * 10, name


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
def test_small_strain_keeps_its_digits_in_float32(law, dim):
    """At strain 1e-6 the stress is Hooke's to 1e-5 relative: F − I and J − 1 are never formed by subtraction."""
    H = 1e-6 * torch.randn(10, dim, dim, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    mat = types(dim, "float32").mat
    got = apply(
        elasticity(dim, "float32").stress[law], mat, (dim, dim), *arguments(law, dim, "float32", H)
    ).double()
    trace = H.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    hooke = MU * (H + H.mT) + LAM * trace * torch.eye(dim, dtype=torch.float64)
    assert ((got - hooke).abs().max() / hooke.abs().max()).item() < 1e-5


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
def test_stress_adj_is_the_finite_difference(law, dim, device):
    """∂/∂F, ∂/∂μ and ∂/∂λ of ⟨W, τ⟩ for random W."""
    given, t = points(dim, law), types(dim, "float64")
    blocks, eye, h = elasticity(dim, "float64"), torch.eye(dim, dtype=torch.float64), 1e-6
    H = torch.stack(list(given.values())) - eye
    W = torch.randn(H.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    twin, flat = blocks.stress_adj[law], wp.types.vector(dim * dim + 2, wp.float64)

    @wp.func
    def flattened(H: t.mat, Q: t.mat, mu: t.real, lam: t.real, adj_tau: t.mat) -> flat:
        adj = twin(H, Q, mu, lam, adj_tau)
        out = flat()
        for i in range(dim):
            for j in range(dim):
                out[i * dim + j] = adj.F[i, j]
        out[dim * dim] = adj.mu
        out[dim * dim + 1] = adj.lam
        return out

    got = apply(
        flattened,
        flat,
        (dim * dim + 2,),
        *arguments(law, dim, "float64", H.to(device)),
        (W.to(device), t.mat),
    ).cpu()
    for n, (name, F) in enumerate(given.items()):
        F, w = F.numpy(), W[n].numpy()

        def slope(change, F=F, w=w):
            dF, dmu, dlam = change
            ends = [numpy_stress(law, F + s * h * dF, MU + s * h * dmu, LAM + s * h * dlam) for s in (1, -1)]
            return (w * (ends[0] - ends[1])).sum() / (2 * h)

        basis = np.eye(dim * dim).reshape(-1, dim, dim)
        changes = [(dF, 0, 0) for dF in basis] + [(0 * basis[0], 1, 0), (0 * basis[0], 0, 1)]
        want = np.array([slope(change) for change in changes])
        assert np.abs(got[n].numpy() - want).max() / np.abs(want).max() < 1e-7, name


@pytest.mark.parametrize("dim", [2, 3])
def test_muscle_stress_and_its_adjoint(dim, device):
    """τ = p (Fd)(Fd)ᵀ, and the derivatives of ⟨W, τ⟩ for random W, as PyTorch finds them."""
    t, blocks, eye = types(dim, "float64"), muscle(dim, "float64"), torch.eye(dim, dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    H, W = torch.randn(2, 6, dim, dim, generator=generator, dtype=torch.float64)
    d = torch.nn.functional.normalize(torch.randn(6, dim, generator=generator, dtype=torch.float64), dim=1)
    pull = torch.tensor([1.5, -0.7, 0.0, 2.0, 1.0, -3.0], dtype=torch.float64)
    given = ((H.to(device), t.mat), (d.to(device), t.vec), (pull.to(device), t.real))

    def stress(F, pull):
        f = (F @ d[:, :, None])[..., 0]
        return pull[:, None, None] * f[:, :, None] * f[:, None, :]

    got = apply(blocks.muscle_stress, t.mat, (dim, dim), *given).cpu()
    torch.testing.assert_close(got, stress(eye + H, pull), rtol=1e-13, atol=1e-13)

    twin, flat = blocks.muscle_stress_adj, wp.types.vector(dim * dim + 1, wp.float64)

    @wp.func
    def flattened(H: t.mat, fibre: t.vec, pull: t.real, adj_tau: t.mat) -> flat:
        adj = twin(H, fibre, pull, adj_tau)
        out = flat()
        for i in range(dim):
            for j in range(dim):
                out[i * dim + j] = adj.F[i, j]
        out[dim * dim] = adj.pull
        return out

    adj = apply(flattened, flat, (dim * dim + 1,), *given, (W.to(device), t.mat)).cpu()
    F, p = (eye + H).requires_grad_(), pull.clone().requires_grad_()
    want = torch.autograd.grad((W * stress(F, p)).sum(), (F, p))
    torch.testing.assert_close(
        adj, torch.cat([want[0].flatten(1), want[1][:, None]], 1), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("lam", [-1.5, 0.0, 5.0])
def test_the_bound_of_the_stiffness(law, dim, lam, device):
    """(E4) is nowhere below the largest eigenvalue of the tangent, and equals it at rest."""
    material = {"neo_hookean": NeoHookean, "fixed_corotated": FixedCorotated}.get(law, BarrierCorotated)
    rng, real = np.random.default_rng(5), types(dim, "float64").real
    stretch = np.concatenate([np.ones((1, dim)), np.exp(rng.uniform(np.log(0.1), np.log(5.0), (400, dim)))])
    F = torch.from_numpy(stretch[..., None] * np.eye(dim))
    moduli = [torch.full((len(F),), value, dtype=torch.float64) for value in (MU, lam)]
    K = torch.linalg.eigvalsh(reference.tangent(material(density=1.0, young=1.0), F, *moduli))[:, -1].clamp(
        min=0.0
    )
    square, j = torch.from_numpy((stretch**2).max(1)), torch.from_numpy(stretch.prod(1) - 1.0)
    given = [(tensor.to(device), real) for tensor in (square, j, *moduli)]
    got = apply(elasticity(dim, "float64").bound[law], real, (), *given).cpu()
    assert (got >= K * (1 - 1e-12)).all()
    torch.testing.assert_close(got[0], K[0], rtol=1e-12, atol=0)
