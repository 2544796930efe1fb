"""Stress of each law against NumPy; its adjoint against finite differences, for a random cotangent."""

import functools

import numpy as np
import pytest
import torch
import warp as wp
from blocks import apply, special_deformations, svd_rotation
from helpers import LAWS as LAW_CLASSES

from softmpm.kernels.physics.actuators import actuator
from softmpm.kernels.physics.kinematics import kinematics
from softmpm.kernels.physics.laws import law as law_of
from softmpm.kernels.physics.viscosity import viscosity
from softmpm.kernels.structs import types
from softmpm.oracle import stress as oracle_stress

MU, LAM = 3.0, 5.0
EXACT_AT_REST = "neo_hookean", "fixed_corotated", "barrier_corotated"
"""Laws whose bound is K at rest also for ν < 0.1; that of the stable neo-Hookean counts no pressure there."""


def numpy_stress(law: str, F: np.ndarray, mu=MU, lam=LAM) -> np.ndarray:
    J, eye = np.linalg.det(F), np.eye(len(F))
    if law == "stable_neo_hookean":  # P Fᵀ of Smith et al. 2018, whose moduli are 4/3 μ and λ + 5/6 μ
        mu_s, lam_s = 4 / 3 * mu, lam + 5 / 6 * mu
        square = (F**2).sum() + 3 - len(F)
        P = mu_s * (1 - 1 / (square + 1)) * F + lam_s * (J - 1 - 3 * mu_s / (4 * lam_s)) * cofactor(F)
        return P @ F.T
    if law == "neo_hookean":
        return mu * (F @ F.T - eye) + lam * np.log(J) * eye
    pressure = {"fixed_corotated": (J - 1) * J, "barrier_corotated": (J**2 - J**-2) / 4}[law]
    return 2 * mu * (F - svd_rotation(F)) @ F.T + lam * pressure * eye


def cofactor(F: np.ndarray) -> np.ndarray:
    """∂J/∂F, also where F is singular."""
    basis = np.eye(F.size).reshape(-1, *F.shape)
    # Exact: J is of first order in each entry.
    slopes = [(np.linalg.det(F + E) - np.linalg.det(F - E)) / 2 for E in basis]
    return np.array(slopes).reshape(F.shape)


def points(dim: int, law: str) -> dict[str, torch.Tensor]:
    """Deformations at which the law is defined and smooth."""
    found = special_deformations(dim)
    found.pop("nearly flat")
    return {
        name: F for name, F in found.items() if LAW_CLASSES[law].survives_inversion or torch.linalg.det(F) > 0
    }


@functools.cache
def blocks_of(law: str, dim: int, dtype: str) -> wp.Function:
    """Function of H, μ, λ and W: τ, P = τ F⁻ᵀ, and the adjoints of F, μ and λ for the cotangent W of τ, and of P."""
    t, blocks = types(dim, dtype), law_of(law, dim, dtype)
    rotation, stress, stress_adj, piola_adj = (
        blocks.rotation,
        blocks.stress,
        blocks.stress_adj,
        blocks.piola_adj,
    )
    inverse_transpose = kinematics(dim, dtype).inverse_transpose
    size = dim * dim
    flat = wp.types.vector(4 * size + 4, t.real)

    @wp.func
    def all_of(H: t.mat, mu: t.real, lam: t.real, W: t.mat) -> flat:
        Q = rotation(H)
        tau = stress(H, Q, mu, lam)
        P = tau * inverse_transpose(H)
        of_tau = stress_adj(H, Q, mu, lam, W)
        of_P = piola_adj(H, Q, mu, lam, W)
        out = flat()
        for i in range(dim):
            for j in range(dim):
                k = i * dim + j
                out[k] = tau[i, j]
                out[size + k] = P[i, j]
                out[2 * size + k] = of_tau.F[i, j]
                out[3 * size + 2 + k] = of_P.F[i, j]
        out[3 * size] = of_tau.mu
        out[3 * size + 1] = of_tau.lam
        out[4 * size + 2] = of_P.mu
        out[4 * size + 3] = of_P.lam
        return out

    return all_of


def law_at(law: str, dtype: str, H: torch.Tensor, W: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """``stress`` and ``piola`` in float64, flattened, and ``stress_adj`` and ``piola_adj``, those of F, then of μ and of λ."""
    dim, real = H.shape[-1], getattr(torch, dtype)
    t, size = types(dim, dtype), dim * dim
    moduli = [(torch.full((len(H),), value, dtype=real, device=H.device), t.real) for value in (MU, LAM)]
    given = (H.to(real), t.mat), *moduli, ((H if W is None else W).to(real), t.mat)
    flat = wp.types.vector(4 * size + 4, t.real)
    found = apply(blocks_of(law, dim, dtype), flat, (4 * size + 4,), *given).cpu().double()
    names = ("stress", "piola", "stress_adj", "piola_adj")
    return dict(zip(names, found.split((size, size, size + 2, size + 2), 1), strict=True))


LAWS = list(LAW_CLASSES)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype, limit", [("float64", 1e-13), ("float32", 2e-6)])
def test_stress_is_the_law(law, dim, dtype, limit, device):
    """τ of (E1) to (E3), at every special point."""
    given = points(dim, law)
    H = torch.stack(list(given.values())).to(device) - torch.eye(dim, dtype=torch.float64, device=device)
    got = law_at(law, dtype, H)["stress"]
    for (name, F), tau in zip(given.items(), got, strict=True):
        want = numpy_stress(law, F.numpy())
        assert np.abs(tau.numpy() - want.ravel()).max() <= limit * max(1.0, float((F**2).sum())) * 10, name


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
def test_small_strain_keeps_its_digits_in_float32(law, dim):
    """At strain 1e-6 the stress is Hooke's to 1e-5 relative: F − I and J − 1 are never formed by subtraction."""
    H = 1e-6 * torch.randn(10, dim, dim, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    got = law_at(law, "float32", H)["stress"].view(H.shape)
    trace = H.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    hooke = MU * (H + H.mT) + LAM * trace * torch.eye(dim, dtype=torch.float64)
    assert ((got - hooke).abs().max() / hooke.abs().max()).item() < 1e-5


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("measure", ["stress", "piola"])
def test_the_adjoint_of_a_law_is_the_finite_difference(law, dim, measure, device):
    """∂/∂F, ∂/∂μ and ∂/∂λ of ⟨W, τ⟩, and of ⟨W, P⟩ with P = τ F⁻ᵀ, for random W."""
    given, h = points(dim, law), 1e-6
    H = torch.stack(list(given.values())) - torch.eye(dim, dtype=torch.float64)
    W = torch.randn(H.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    got = law_at(law, "float64", H.to(device), W.to(device))[f"{measure}_adj"]
    for n, (name, F) in enumerate(given.items()):
        F, w = F.numpy(), W[n].numpy()

        def stress(F, mu, lam):
            tau = numpy_stress(law, F, mu, lam)
            return tau if measure == "stress" else tau @ np.linalg.inv(F).T

        def slope(change, F=F, w=w):
            dF, dmu, dlam = change
            ends = [stress(F + s * h * dF, MU + s * h * dmu, LAM + s * h * dlam) for s in (1, -1)]
            return (w * (ends[0] - ends[1])).sum() / (2 * h)

        basis = np.eye(dim * dim).reshape(-1, dim, dim)
        changes = [(dF, 0, 0) for dF in basis] + [(0 * basis[0], 1, 0), (0 * basis[0], 0, 1)]
        want = np.array([slope(change) for change in changes])
        assert np.abs(got[n].numpy() - want).max() / np.abs(want).max() < 1e-7, name


ROUNDING = {
    "neo_hookean": 1.3e-7,
    "fixed_corotated": 8e-8,
    "barrier_corotated": 2.6e-7,
    "stable_neo_hookean": 5e-8,
}
"""Median relative error of P for stretches (1, 1, J) in float32, times J."""


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("J", [0.1, 0.01, 0.001])
def test_rounding_near_collapse(law, J, device):
    """Median relative errors of P = τ F⁻ᵀ and of F̄ from P̄: the second does not grow where P is finite at J = 0."""
    generator = torch.Generator().manual_seed(3)
    Q = torch.linalg.qr(torch.randn(2, 4000, 3, 3, generator=generator, dtype=torch.float64))[0]
    U, V = Q * torch.linalg.det(Q).sign()[..., None, None]
    F = (U * torch.tensor([1.0, 1.0, J], dtype=torch.float64)) @ V.mT
    H = (F - torch.eye(3, dtype=torch.float64)).float().double().to(device)
    W = torch.randn(H.shape, generator=generator, dtype=torch.float64).float().double().to(device)

    single, double = (law_at(law, dtype, H, W) for dtype in ("float32", "float64"))

    def error(name: str):
        got, want = single[name][:, :9], double[name][:, :9]
        return ((got - want).norm(dim=1) / want.norm(dim=1)).median()

    assert error("piola") <= ROUNDING[law] / J
    finite = law in ("fixed_corotated", "stable_neo_hookean")
    assert error("piola_adj") <= (2e-7 if finite else 1.5 * ROUNDING[law] / J)


def pull_along(fibre, F, p):
    """τ = p (Fd)(Fd)ᵀ."""
    f = (F @ fibre[:, :, None])[..., 0]
    return p[:, None, None] * f[:, :, None] * f[:, None, :]


def push_from_inside(fibre, F, p):
    """τ = −p J I."""
    return -(p * torch.linalg.det(F))[:, None, None] * torch.eye(F.shape[-1], dtype=F.dtype)


ACTUATORS = {"muscle": pull_along, "pressure": push_from_inside}


@pytest.mark.parametrize("kind", ACTUATORS)
@pytest.mark.parametrize("dim", [2, 3])
def test_active_stress_and_its_adjoint(kind, dim, device):
    """The stress of each actuator, and the derivatives of ⟨W, τ⟩ and ⟨W, P⟩ for random W, as PyTorch finds them."""
    t, blocks = types(dim, "float64"), actuator(kind, dim, "float64")
    generator, eye = torch.Generator().manual_seed(2), torch.eye(dim, dtype=torch.float64)
    H, W = torch.randn(2, 6, dim, dim, generator=generator, dtype=torch.float64)
    d = torch.nn.functional.normalize(torch.randn(6, dim, generator=generator, dtype=torch.float64), dim=1)
    p = torch.tensor([1.5, -0.7, 0.0, 2.0, 1.0, -3.0], dtype=torch.float64)
    stress, stress_adj, piola_adj = blocks.stress, blocks.stress_adj, blocks.piola_adj
    size, row = dim * dim, dim * dim + 1 + dim
    flat = wp.types.vector(size + 2 * row, wp.float64)

    @wp.func
    def all_of(H: t.mat, fibre: t.vec, p: t.real, W: t.mat) -> flat:
        tau = stress(H, fibre, p)
        of_tau = stress_adj(H, fibre, p, W)
        of_P = piola_adj(H, fibre, p, W)
        out = flat()
        for i in range(dim):
            for j in range(dim):
                k = i * dim + j
                out[k] = tau[i, j]
                out[size + k] = of_tau.F[i, j]
                out[size + row + k] = of_P.F[i, j]
            out[2 * size + 1 + i] = of_tau.fibre[i]
            out[2 * size + row + 1 + i] = of_P.fibre[i]
        out[2 * size] = of_tau.active_stress
        out[2 * size + row] = of_P.active_stress
        return out

    given = ((H, t.mat), (d, t.vec), (p, t.real), (W, t.mat))
    found = apply(all_of, flat, (size + 2 * row,), *((one.to(device), kind) for one, kind in given)).cpu()
    tau, of_tau, of_P = found.split((size, row, row), 1)
    want = ACTUATORS[kind](d, eye + H, p)
    torch.testing.assert_close(tau, want.flatten(1), rtol=1e-12, atol=1e-12)
    for measure, adj in (("stress", of_tau), ("piola", of_P)):
        leaves = [value.clone().requires_grad_() for value in (eye + H, p, d)]
        value = ACTUATORS[kind](leaves[2], leaves[0], leaves[1])
        if measure == "piola":
            value = value @ torch.linalg.inv(leaves[0]).mT
        want = torch.autograd.grad((W * value).sum(), leaves, allow_unused=True, materialize_grads=True)
        wanted = torch.cat([want[0].flatten(1), want[1][:, None], want[2]], 1)
        torch.testing.assert_close(adj, wanted, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_first_piola_kirchhoff_stress_of_viscosity(dim, device):
    """P = τ F⁻ᵀ for C = Ḟ F⁻¹, and the derivatives of ⟨W, P⟩ for random W, as PyTorch finds them."""
    t, blocks = types(dim, "float64"), viscosity(dim, "float64")
    generator = torch.Generator().manual_seed(4)
    F, rate, W = torch.randn(3, 6, dim, dim, generator=generator, dtype=torch.float64)
    eta = torch.rand(6, generator=generator, dtype=torch.float64)
    piola, piola_adj, size = blocks.viscous_piola, blocks.viscous_piola_adj, dim * dim
    flat = wp.types.vector(3 * size + 1, wp.float64)

    @wp.func
    def all_of(F: t.mat, rate: t.mat, eta: t.real, W: t.mat) -> flat:
        P = piola(F, rate, eta)
        adj = piola_adj(F, rate, eta, W)
        out = flat()
        for i in range(dim):
            for j in range(dim):
                k = i * dim + j
                out[k] = P[i, j]
                out[size + k] = adj.F[i, j]
                out[2 * size + k] = adj.rate[i, j]
        out[3 * size] = adj.eta
        return out

    def P_of(F, rate, eta):
        inverse = torch.linalg.inv(F)
        return oracle_stress.viscous_stress(F, rate @ inverse, eta) @ inverse.mT

    given = ((F, t.mat), (rate, t.mat), (eta, t.real), (W, t.mat))
    found = apply(all_of, flat, (3 * size + 1,), *((one.to(device), kind) for one, kind in given)).cpu()
    got, adj = found.split((size, 2 * size + 1), 1)
    torch.testing.assert_close(got, P_of(F, rate, eta).flatten(1), rtol=1e-10, atol=1e-10)
    leaves = [tensor.clone().requires_grad_() for tensor in (F, rate, eta)]
    slopes = torch.autograd.grad((W * P_of(*leaves)).sum(), leaves)
    want = torch.cat([slopes[0].flatten(1), slopes[1].flatten(1), slopes[2][:, None]], 1)
    torch.testing.assert_close(adj, want, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("lam", [-1.5, 0.0, 5.0])
def test_the_bound_of_the_stiffness(law, dim, lam, device):
    """(E4) is nowhere below the largest eigenvalue of the tangent, and equals it at rest."""
    material = LAW_CLASSES[law]
    rng, real = np.random.default_rng(5), types(dim, "float64").real
    stretch = np.concatenate([np.ones((1, dim)), np.exp(rng.uniform(np.log(0.1), np.log(5.0), (400, dim)))])
    F = torch.from_numpy(stretch[..., None] * np.eye(dim))
    moduli = [torch.full((len(F),), value, dtype=torch.float64) for value in (MU, lam)]
    K = torch.linalg.eigvalsh(oracle_stress.tangent(material(density=1.0, young=1.0), F, *moduli))[
        :, -1
    ].clamp(min=0.0)
    square, j = torch.from_numpy((stretch**2).max(1)), torch.from_numpy(stretch.prod(1) - 1.0)
    trace = torch.from_numpy((stretch**2).sum(1))
    given = [(tensor.to(device), real) for tensor in (square, j, trace, *moduli)]
    got = apply(law_of(law, dim, "float64").bound, real, (), *given).cpu()
    assert (got >= K * (1 - 1e-12)).all()
    if lam >= MU / 4 or law in EXACT_AT_REST:
        torch.testing.assert_close(got[0], K[0], rtol=1e-12, atol=0)
