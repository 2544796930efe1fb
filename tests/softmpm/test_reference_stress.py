"""Rotation and stress of the float64 reference against energies and central differences."""

import math

import pytest
import torch

from softmpm import reference

DIMS = pytest.mark.parametrize("dim", [2, 3])
LAWS = {
    "neo_hookean": reference.neo_hookean,
    "fixed_corotated": reference.fixed_corotated,
    "barrier_corotated": reference.barrier_corotated,
}


def f64(values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


MU, LAM = f64(3.0), f64(5.0)


def randn(*shape, seed=0) -> torch.Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def rotation(dim: int, seed: int) -> torch.Tensor:
    Q = torch.linalg.qr(randn(dim, dim, seed=seed))[0]
    return Q if torch.linalg.det(Q) > 0 else Q @ torch.diag(f64([-1.0] + [1.0] * (dim - 1)))


def stretched(dim: int, *stretches: float) -> torch.Tensor:
    """U diag(stretches) Vᵀ with rotations U and V."""
    middle = torch.diag(f64(stretches[:dim]))
    return rotation(dim, 1) @ middle @ rotation(dim, 2).T


def special_points(dim: int) -> dict[str, torch.Tensor]:
    """Where the derivative of an SVD is undefined or commonly wrong; then where it is not."""
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


def difference(f, at: torch.Tensor, d: torch.Tensor, h: float) -> torch.Tensor:
    """Directional derivative by a central difference of sixth order."""
    terms = ((1, 3 / 4), (2, -3 / 20), (3, 1 / 60))
    return sum(c * (f(at + k * h * d) - f(at - k * h * d)) for k, c in terms) / h


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
        R = reference.polar(F)
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
    torch.testing.assert_close(reference.polar(Q @ S), Q, rtol=0, atol=1e-13)


@DIMS
def test_derivatives_at_special_points(dim):
    """Rotation, both stresses and the muscle's, at F = I, rotations, equal stretches and det F < 0."""
    fibre = torch.nn.functional.normalize(randn(dim, seed=6), dim=0)
    for name, F in special_points(dim).items():
        assert_derivative(reference.polar, F, f"polar, {name}")
        assert_derivative(lambda F: reference.fixed_corotated(F, MU, LAM), F, f"fixed corotated, {name}")
        assert_derivative(lambda F: reference.muscle_stress(F, fibre, MU), F, f"muscle, {name}")
        if torch.linalg.det(F) > 0:
            assert_derivative(lambda F: reference.neo_hookean(F, MU, LAM), F, f"neo-Hookean, {name}")


@DIMS
def test_second_derivative_of_polar(dim):
    """The derivative of R is itself differentiable, at F = I too; a silent zero would go unseen elsewhere."""
    weights, d = randn(dim, dim, seed=7), randn(dim, dim, seed=8)

    def first(F):
        F = F.detach().requires_grad_()
        return torch.autograd.grad((weights * reference.polar(F)).sum(), F)[0]

    for name in ("identity", "equal stretches", "inverted"):
        F = special_points(dim)[name].requires_grad_()
        (slope,) = torch.autograd.grad((weights * reference.polar(F)).sum(), F, create_graph=True)
        (got,) = torch.autograd.grad((slope * d).sum(), F)  # the Hessian is symmetric
        torch.testing.assert_close(got, difference(first, F.detach(), d, 1e-3), rtol=1e-7, atol=1e-8)


@DIMS
def test_polar_never_raises(dim):
    """Where R is not unique: a rotation, its derivative NaN; of NaN it is NaN; neighbours are sound."""
    mirror = torch.diag(f64([1.0, -1.0, 1.0][:dim]))
    sound = special_points(dim)["random"]
    F = torch.stack(
        [mirror, torch.zeros_like(mirror), torch.full_like(mirror, math.nan), sound]
    ).requires_grad_()
    R = reference.polar(F)
    (slope,) = torch.autograd.grad((R * randn(*R.shape)).sum(), F)
    torch.testing.assert_close(
        R[:2].mT @ R[:2], torch.eye(dim).double().expand(2, dim, dim), rtol=0, atol=1e-14
    )
    assert R[2].isnan().all()
    assert slope[:3].isnan().all()
    # To rounding: in a batch of another size, LAPACK may take its sums in another order.
    torch.testing.assert_close(R[3], reference.polar(sound), rtol=0, atol=1e-15)
    assert slope[3].isfinite().all()


def energy(law: str, F: torch.Tensor) -> torch.Tensor:
    """Stored energy per rest volume, from singular values and the determinant alone."""
    J = torch.linalg.det(F)
    if law == "neo_hookean":
        return MU / 2 * ((F**2).sum() - len(F)) - MU * J.log() + LAM / 2 * J.log() ** 2
    s = torch.linalg.svdvals(F)
    s[-1] *= J.sign()
    volumetric = {"fixed_corotated": (J - 1) ** 2 / 2, "barrier_corotated": (J - 1 / J) ** 2 / 8}
    return MU * ((s - 1) ** 2).sum() + LAM * volumetric[law]


@DIMS
@pytest.mark.parametrize("law", LAWS)
def test_stress_is_the_derivative_of_an_energy(dim, law):
    """τ : A = d/dh ψ((I + hA) F), so that no work is gained on a closed path; for FCR also at det F < 0."""
    for name, F in special_points(dim).items():
        if law != "fixed_corotated" and torch.linalg.det(F) < 0:
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
    pulled = reference.muscle_stress(Q, fibre, MU)
    torch.testing.assert_close(pulled, MU * torch.outer(Q[:, 1], Q[:, 1]), rtol=0, atol=1e-14)


def test_lame_gives_back_the_constants_of_engineers():
    """E = μ(3λ + 2μ)/(λ + μ) and ν = λ/(2(λ + μ))."""
    young, poisson = f64([100.0, 7.0, 1e6]), f64([0.3, 0.0, 0.49])
    mu, lam = reference.lame(young, poisson)
    torch.testing.assert_close(mu * (3 * lam + 2 * mu) / (lam + mu), young, rtol=1e-13, atol=0)
    torch.testing.assert_close(lam / (2 * (lam + mu)), poisson, rtol=1e-13, atol=0)
