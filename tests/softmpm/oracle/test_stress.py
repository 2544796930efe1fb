"""Rotation and stress of the float64 oracle against energies and central differences."""

import math

import helpers
import pytest
import torch
from oracle_scenes import DIMS, difference, f64, randn

from softmpm.oracle import stress
from softmpm.scene.materials import StableNeoHookean

LAWS = {name: stress.LAWS[law] for name, law in helpers.LAWS.items()}
SURVIVES_INVERSION = {name for name, law in helpers.LAWS.items() if law.survives_inversion}


MU, LAM = f64(3.0), f64(5.0)


def rotation(dim: int, seed: int) -> torch.Tensor:
    Q = torch.linalg.qr(randn(dim, dim, seed=seed))[0]
    return Q if torch.linalg.det(Q) > 0 else Q @ torch.diag(f64([-1.0] + [1.0] * (dim - 1)))


def stretched(dim: int, *stretches: float) -> torch.Tensor:
    """U diag(stretches) Vᵀ with rotations U and V."""
    middle = torch.diag(f64(stretches[:dim]))
    return rotation(dim, 1) @ middle @ rotation(dim, 2).T


def special_points(dim: int) -> dict[str, torch.Tensor]:
    """Deformations where the derivative of an SVD is undefined or commonly wrong, and others."""
    return {
        "identity": torch.eye(dim, dtype=torch.float64),
        "rotation": rotation(dim, 3),
        "half turn": torch.diag(f64([-1.0, -1.0, 1.0][:dim])),
        "equal stretches": stretched(dim, 2.0, 1.0, 1.0),
        "other equal stretches": stretched(dim, 2.0, 2.0, 1.0),
        "uniform stretch": stretched(dim, 1.5, 1.5, 1.5),
        "inverted": stretched(dim, 1.1, -0.4, 0.9),
        "inverted, equal stretches": stretched(dim, 1.2, -0.4, 1.2),
        "random": randn(dim, dim, seed=4) + torch.eye(dim),
    }


def assert_derivative(f, at: torch.Tensor, what: str) -> None:
    """The Jacobian that PyTorch finds agrees with central differences along random directions: ≤ 1e-9."""
    jacobian = torch.autograd.functional.jacobian(f, at)
    for seed in range(3):
        d = randn(*at.shape, seed=10 + seed)
        got, want = (jacobian * d).flatten(-at.dim()).sum(-1), difference(f, at, d, 1e-3)
        assert (got - want).abs().max() <= 1e-9 * max(1.0, want.abs().max().item()), what


@DIMS
def test_polar_is_the_best_proper_rotation(dim):
    """RᵀR = I, det R = 1, RᵀF is symmetric, and no other rotation has a larger tr(RᵀF); also if det F < 0."""
    for name, F in special_points(dim).items():
        R = stress.polar(F)
        torch.testing.assert_close(R.T @ R, torch.eye(dim, dtype=torch.float64), rtol=0, atol=1e-14)
        assert torch.linalg.det(R) > 0, name
        torch.testing.assert_close(R.T @ F, F.T @ R, rtol=0, atol=1e-14)
        for seed in range(50):
            assert ((rotation(dim, 100 + seed) @ R - R) * F).sum() <= 1e-12, name


@DIMS
def test_polar_of_a_product(dim):
    """polar(Q S) = Q for a rotation Q and a symmetric positive S, in batches of any leading shape."""
    Q = torch.stack([rotation(dim, seed) for seed in range(6)]).view(2, 3, dim, dim)
    S = torch.matrix_exp(0.5 * (lambda A: A + A.mT)(randn(2, 3, dim, dim, seed=5)))
    torch.testing.assert_close(stress.polar(Q @ S), Q, rtol=0, atol=1e-13)


@DIMS
def test_derivatives_at_special_points(dim):
    """Rotation, stresses and the muscle's, at F = I, rotations, equal stretches and det F < 0."""
    fibre = torch.nn.functional.normalize(randn(dim, seed=6), dim=0)
    for name, F in special_points(dim).items():
        assert_derivative(stress.polar, F, f"polar, {name}")
        assert_derivative(lambda F: stress.fixed_corotated(F, MU, LAM), F, f"fixed corotated, {name}")
        assert_derivative(lambda F: stress.stable_neo_hookean(F, MU, LAM), F, f"stable neo-Hookean, {name}")
        assert_derivative(lambda F: stress.muscle_stress(F, fibre, MU), F, f"muscle, {name}")
        if torch.linalg.det(F) > 0:
            assert_derivative(lambda F: stress.neo_hookean(F, MU, LAM), F, f"neo-Hookean, {name}")


@DIMS
def test_second_derivative_of_polar(dim):
    """The derivative of R is itself differentiable, at F = I too; a silent zero would go unseen elsewhere."""
    weights, d = randn(dim, dim, seed=7), randn(dim, dim, seed=8)

    def first(F):
        F = F.detach().requires_grad_()
        return torch.autograd.grad((weights * stress.polar(F)).sum(), F)[0]

    for name in ("identity", "equal stretches", "inverted"):
        F = special_points(dim)[name].requires_grad_()
        (slope,) = torch.autograd.grad((weights * stress.polar(F)).sum(), F, create_graph=True)
        (got,) = torch.autograd.grad((slope * d).sum(), F)  # the Hessian is symmetric
        torch.testing.assert_close(got, difference(first, F.detach(), d, 1e-3), rtol=1e-7, atol=1e-8)


@DIMS
def test_polar_never_raises(dim):
    """If R is not unique, it is a rotation and its derivative is NaN; NaN gives NaN; other particles are unaffected."""
    mirror = torch.diag(f64([1.0, -1.0, 1.0][:dim]))
    sound = special_points(dim)["random"]
    F = torch.stack(
        [mirror, torch.zeros_like(mirror), torch.full_like(mirror, math.nan), sound]
    ).requires_grad_()
    R = stress.polar(F)
    (slope,) = torch.autograd.grad((R * randn(*R.shape)).sum(), F)
    torch.testing.assert_close(
        R[:2].mT @ R[:2], torch.eye(dim).double().expand(2, dim, dim), rtol=0, atol=1e-14
    )
    assert R[2].isnan().all()
    assert slope[:3].isnan().all()
    # To rounding: in a batch of another size, LAPACK may take its sums in another order.
    torch.testing.assert_close(R[3], stress.polar(sound), rtol=0, atol=1e-15)
    assert slope[3].isfinite().all()


def energy(law: str, F: torch.Tensor) -> torch.Tensor:
    """Stored energy per rest volume, from singular values and the determinant alone."""
    J = torch.linalg.det(F)
    if law == "neo_hookean":
        return MU / 2 * ((F**2).sum() - len(F)) - MU * J.log() + LAM / 2 * J.log() ** 2
    if (
        law == "stable_neo_hookean"
    ):  # Smith et al. 2018, equations 14 and 16, with the third stretch of plane strain
        m, l, squared = 4 / 3 * MU, LAM + 5 / 6 * MU, (F**2).sum() + 3 - len(F)
        alpha = 1 + m / l - m / (4 * l)
        return m / 2 * (squared - 3) + l / 2 * (J - alpha) ** 2 - m / 2 * (squared + 1).log()
    s = torch.linalg.svdvals(F)
    s[-1] *= J.sign()
    volumetric = {"fixed_corotated": (J - 1) ** 2 / 2, "barrier_corotated": (J - 1 / J) ** 2 / 8}
    return MU * ((s - 1) ** 2).sum() + LAM * volumetric[law]


@DIMS
@pytest.mark.parametrize("law", LAWS)
def test_stress_is_the_derivative_of_an_energy(dim, law):
    """τ : A = d/dh ψ((I + hA) F), so that no work is gained on a closed path; where a law is defined there also at det F < 0."""
    for name, F in special_points(dim).items():
        if law not in SURVIVES_INVERSION and torch.linalg.det(F) < 0:
            continue
        tau = LAWS[law](F, MU, LAM)
        for seed in range(3):
            A = randn(dim, dim, seed=20 + seed)
            want = difference(lambda H: energy(law, F + H @ F), torch.zeros_like(A), A, 1e-3)  # noqa: B023
            assert abs((tau * A).sum() - want) <= 1e-9 * max(1.0, abs(want)), name


@DIMS
def test_stress_turns_with_the_body(dim):
    """τ is zero at rest, and of QF it is Q τ Qᵀ; τ is symmetric: laws and muscle."""
    fibre, F, Q = torch.eye(dim, dtype=torch.float64)[1], stretched(dim, 1.4, 0.8, 1.1), rotation(dim, 9)
    for law in LAWS.values():
        torch.testing.assert_close(law(Q, MU, LAM), torch.zeros_like(Q), rtol=0, atol=1e-14)
        torch.testing.assert_close(law(Q @ F, MU, LAM), Q @ law(F, MU, LAM) @ Q.T, rtol=0, atol=1e-13)
        torch.testing.assert_close(law(F, MU, LAM), law(F, MU, LAM).T, rtol=0, atol=1e-13)
    pulled = stress.muscle_stress(Q, fibre, MU)
    torch.testing.assert_close(pulled, MU * torch.outer(Q[:, 1], Q[:, 1]), rtol=0, atol=1e-14)


def test_lame_gives_back_the_constants_of_engineers():
    """E = μ(3λ + 2μ)/(λ + μ) and ν = λ/(2(λ + μ))."""
    young, poisson = f64([100.0, 7.0, 1e6]), f64([0.3, 0.0, 0.49])
    mu, lam = stress.lame(young, poisson)
    torch.testing.assert_close(mu * (3 * lam + 2 * mu) / (lam + mu), young, rtol=1e-13, atol=0)
    torch.testing.assert_close(lam / (2 * (lam + mu)), poisson, rtol=1e-13, atol=0)


def cofactor(F: torch.Tensor) -> torch.Tensor:
    """∂J/∂F."""
    with torch.enable_grad():
        leaf = F.detach().requires_grad_()
        return torch.autograd.grad(stress.det(leaf).sum(), leaf)[0]


def parts(F: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """B = FFᵀ, s = |F|² − d, k = s / (12 + 3s), k' and J of (E5), each with two axes for a matrix."""
    s = ((F**2).sum((-2, -1)) - F.shape[-1])[..., None, None]
    return F @ F.mT, s, s / (12 + 3 * s), 4 / (3 * (4 + s) ** 2), stress.det(F)[..., None, None]


def wild(dim: int, count: int, seed=30) -> torch.Tensor:
    """Random F of all sizes, about half of them inverted, and F = 0."""
    F = randn(count, dim, dim, seed=seed) * torch.logspace(-2, 1, count, dtype=torch.float64)[:, None, None]
    return torch.cat([F, torch.zeros(1, dim, dim, dtype=torch.float64)])


@DIMS
def test_stable_neo_hookean_without_cancellation(dim):
    """(E5), from E, k and j, equals the direct form, also for inverted and flattened F; it is symmetric and finite there."""
    F, eye = wild(dim, 400), torch.eye(dim, dtype=torch.float64)
    B, _, k, _, J = parts(F)
    got = stress.stable_neo_hookean(F, MU, LAM)
    want = MU * (B - eye + k * B) + ((LAM + 5 / 6 * MU) * J - MU) * (J - 1) * eye
    torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(got, got.mT, rtol=1e-12, atol=1e-12)
    assert got.isfinite().all() and (J < 0).sum() > 100


@DIMS
@pytest.mark.parametrize("poisson", [-0.9, -0.3, 0.0, 0.3, 0.49])
def test_stable_neo_hookean_is_linear_elasticity_at_rest(dim, poisson):
    """A[G] = 2μ G + λ tr(G) I at F = I, for every Poisson's ratio: ≤ 1e-13."""
    mu, lam = stress.lame(f64(100.0), f64(poisson))
    basis, eye = stress.strains(dim), torch.eye(dim, dtype=torch.float64)
    A = stress.tangent(StableNeoHookean(density=1.0, young=1.0), eye, mu, lam)
    trace = basis.diagonal(dim1=-2, dim2=-1).sum(-1)
    want = 2 * mu * torch.eye(len(basis), dtype=torch.float64) + lam * torch.outer(trace, trace)
    torch.testing.assert_close(A, want, rtol=0, atol=1e-12 * mu.item())


@DIMS
@pytest.mark.parametrize("poisson", [-0.9, 0.0, 0.3, 0.49])
def test_bound_of_the_stiffness_of_stable_neo_hookean(dim, poisson):
    """K ≤ 2μ [(1 + k) S + k' S tr B] + d max(p' J, 0) for the largest eigenvalue K of A, inverted F included; K itself at rest."""
    mu, lam = stress.lame(f64(100.0), f64(poisson))
    F = torch.cat([wild(dim, 1000), torch.eye(dim, dtype=torch.float64)[None]])
    A = stress.tangent(StableNeoHookean(density=1.0, young=1.0), F, mu.expand(len(F)), lam.expand(len(F)))
    K = torch.linalg.eigvalsh(A)[:, -1]
    B, _, k, slope, J = (t.squeeze() if t.shape[-2:] == (1, 1) else t for t in parts(F))
    largest, trace = torch.linalg.eigvalsh(B)[:, -1], B.diagonal(dim1=-2, dim2=-1).sum(-1)
    volumetric = (lam + 5 / 6 * mu) * (2 * J - 1) - mu
    bound = 2 * mu * ((1 + k) * largest + slope * largest * trace) + dim * (volumetric * J).clamp(min=0)
    assert (bound * (1 + 1e-12) + 1e-12 * mu >= K).all()
    if lam >= mu / 6:
        assert bound[-1] == pytest.approx(K[-1].item(), rel=1e-13)


@DIMS
def test_adjoint_of_stable_neo_hookean(dim):
    """(E5) of docs/math/elasticity.md for F̄, μ̄ and λ̄ equals autograd, for a cotangent that is not symmetric."""
    F, eye = wild(dim, 200).requires_grad_(), torch.eye(dim, dtype=torch.float64)
    mu, lam = (value.expand(len(F)).clone().requires_grad_() for value in (MU, LAM))
    adj_tau = randn(*F.shape, seed=31)
    want = torch.autograd.grad(stress.stable_neo_hookean(F, mu, lam), (F, mu, lam), adj_tau)
    with torch.no_grad():
        B, _, k, slope, J = parts(F)
        T, trace = (adj_tau + adj_tau.mT) / 2, adj_tau.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        m, l = mu[:, None, None], lam[:, None, None]
        adj_F = 2 * m * (1 + k) * T @ F + 2 * m * slope * (T * B).sum((-2, -1), keepdim=True) * F
        adj_F = adj_F + ((l + 5 / 6 * m) * (2 * J - 1) - m) * trace * cofactor(F)
        adj_mu = (T * (B - eye + k * B)).sum((-2, -1)) + (trace * (5 / 6 * J - 1) * (J - 1)).squeeze()
        adj_lam = (trace * J * (J - 1)).squeeze()
    for got, value in zip((adj_F, adj_mu, adj_lam), want, strict=True):
        torch.testing.assert_close(got, value, rtol=1e-11, atol=1e-11)


@DIMS
def test_viscous_stress_is_that_of_the_strain_rate(dim):
    """(E6) is F S Fᵀ with S = 2η d/dt (FᵀF − I)/2 for Ḟ = C F, turns with the body, and dissipates 2η |Ė|² ≥ 0; inverted F included."""
    F, C, Q = wild(dim, 50), randn(51, dim, dim, seed=32), rotation(dim, 9)
    eta = torch.full((51,), 3.0, dtype=torch.float64)
    rate = ((C @ F).mT @ F + F.mT @ (C @ F)) / 2
    tau = stress.viscous_stress(F, C, eta)
    torch.testing.assert_close(tau, 6 * F @ rate @ F.mT, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(tau, tau.mT, rtol=1e-12, atol=1e-12)
    turned = stress.viscous_stress(Q @ F, Q @ C @ Q.T, eta)
    torch.testing.assert_close(turned, Q @ tau @ Q.T, rtol=1e-12, atol=1e-12)
    power = (tau * C).sum((-2, -1))
    torch.testing.assert_close(power, 6 * (rate**2).sum((-2, -1)), rtol=1e-11, atol=1e-11)
    spinning = stress.viscous_stress(F, C - C.mT, eta)
    assert spinning.abs().max() == 0


@DIMS
def test_adjoint_of_viscosity(dim):
    """(E6.adj) of docs/math/elasticity.md equals autograd, for a cotangent that is not symmetric; V[G] is C̄ for T = G."""
    leaves = [wild(dim, 50), randn(51, dim, dim, seed=33), randn(51, seed=34).abs()]
    F, C, eta = (leaf.requires_grad_() for leaf in leaves)
    adj_tau = randn(51, dim, dim, seed=35)
    want = torch.autograd.grad(stress.viscous_stress(F, C, eta), (F, C, eta), adj_tau)
    with torch.no_grad():
        B, D, T, e = F @ F.mT, (C + C.mT) / 2, (adj_tau + adj_tau.mT) / 2, eta[:, None, None]
        adj_F = 4 * e * (T @ B @ D + D @ B @ T) @ F
        got = adj_F, 2 * e * B @ T @ B, 2 * (T * (B @ D @ B)).sum((-2, -1))
        for mine, value in zip(got, want, strict=True):
            torch.testing.assert_close(mine, value, rtol=1e-11, atol=1e-11)
        V, basis = stress.viscous_tangent(F), stress.strains(dim)
        for column, G in enumerate(basis):
            damping = 2 * B @ G @ B
            torch.testing.assert_close(V[..., column], torch.einsum("kij,pij->pk", basis, damping))


@DIMS
def test_pressure_is_the_derivative_of_its_work(dim):
    """(M2): τ : A = d/dh −p J((I + hA) F), its adjoint and its tangent; inverted F included."""
    F, p = wild(dim, 60).requires_grad_(), randn(61, seed=36).requires_grad_()
    tau, eye = stress.pressure_stress(F, None, p), torch.eye(dim, dtype=torch.float64)
    A = randn(dim, dim, seed=37)
    work = difference(lambda h: -p * stress.det((eye + h * A) @ F), f64(0.0), f64(1.0), 1e-3)
    torch.testing.assert_close((tau * A).sum((-2, -1)), work, rtol=1e-9, atol=1e-9)
    adj_tau = randn(61, dim, dim, seed=38)
    adj_F, adj_p = torch.autograd.grad(tau, (F, p), adj_tau)
    trace, J = adj_tau.diagonal(dim1=-2, dim2=-1).sum(-1), stress.det(F)
    torch.testing.assert_close(adj_p, -J * trace)
    torch.testing.assert_close(adj_F, -(p * trace)[:, None, None] * cofactor(F))
    T, basis = stress.pressure_tangent(F), stress.strains(dim)
    for column, G in enumerate(basis):
        want = -J[:, None] * torch.einsum("kii->k", basis) * G.trace()
        torch.testing.assert_close(T[..., column], want)
    top = torch.linalg.eigvalsh(p[:, None, None] * T)[:, -1]
    torch.testing.assert_close(top, dim * (-p * J).clamp(min=0), rtol=1e-12, atol=1e-12)
