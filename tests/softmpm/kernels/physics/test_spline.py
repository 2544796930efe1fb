"""Moments of the quadratic B-spline, and its slopes."""

import pytest
import torch
import warp as wp
from blocks import apply

from softmpm.kernels.fast.gather import stencil as stencil_sums
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import types


def stencil(dim: int, fx: torch.Tensor, device: str):
    """Weights (particle, node), their derivative (particle, node, dim), r in cells (particle, node, dim)."""
    t, s = types(dim, "float64"), spline(dim, "float64")
    count, vec, _ivec, _real = s.count, t.vec, t.ivec, t.real
    offset, position, weights, slopes, weight, weight_slope = (
        getattr(s, name) for name in ("offset", "position", "weights", "slopes", "weight", "weight_slope")
    )
    values = wp.types.vector(count, wp.float64)
    rows = wp.types.matrix((count, dim), wp.float64)

    @wp.func
    def all_weights(fx: vec) -> values:
        out = values()
        for n in range(count):
            out[n] = weight(weights(fx), offset(n))
        return out

    @wp.func
    def all_slopes(fx: vec) -> rows:
        out = rows()
        for n in range(count):
            out[n] = weight_slope(weights(fx), slopes(fx), offset(n))
        return out

    @wp.func
    def all_distances(fx: vec) -> rows:
        out = rows()
        for n in range(count):
            out[n] = position(offset(n)) - fx
        return out

    given = (fx.to(device), t.vec)
    return (
        apply(all_weights, values, (count,), given).cpu(),
        apply(all_slopes, rows, (count, dim), given).cpu(),
        apply(all_distances, rows, (count, dim), given).cpu(),
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_moments(dim, device):
    """Σ w = 1, Σ w r = 0 and Σ w r rᵀ = I/4 in cells (hence D = dx²/4), edges of the cell included."""
    fx = 0.5 + torch.rand(20, dim, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    fx[0], fx[1] = 0.5, 1.0
    w, slope, r = stencil(dim, fx, device)
    ones, eye = torch.ones(20, dtype=torch.float64), torch.eye(dim, dtype=torch.float64)
    torch.testing.assert_close(w.sum(1), ones, rtol=0, atol=1e-15)
    torch.testing.assert_close((w[..., None] * r).sum(1), torch.zeros_like(fx), rtol=0, atol=1e-15)
    second = torch.einsum("pn,pni,pnj->pij", w, r, r)
    torch.testing.assert_close(second, (eye / 4).expand_as(second), rtol=0, atol=1e-15)
    torch.testing.assert_close(slope.sum(1), torch.zeros_like(fx), rtol=0, atol=1e-14)
    gradient = torch.einsum("pni,pnj->pij", r, slope)  # ∂/∂x of Σ w x_i, in cells: the identity
    torch.testing.assert_close(gradient, eye.expand_as(gradient), rtol=0, atol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
def test_slopes_are_the_derivative(dim):
    """Central differences of the weights; piecewise quadratic, so exact but for rounding."""
    fx, h = (
        0.6 + 0.8 * torch.rand(10, dim, generator=torch.Generator().manual_seed(1), dtype=torch.float64),
        1e-3,
    )
    _, slope, _ = stencil(dim, fx, "cpu")
    for axis in range(dim):
        step = torch.zeros(dim, dtype=torch.float64)
        step[axis] = h
        ahead, behind = stencil(dim, fx + step, "cpu")[0], stencil(dim, fx - step, "cpu")[0]
        torch.testing.assert_close(slope[..., axis], (ahead - behind) / (2 * h), rtol=0, atol=1e-12)


@pytest.mark.parametrize("block", ["spline", "stencil"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_nothing_is_gained_by_rounding(block, dtype, device):
    """Of the weights along an axis Σ w = 1 and Σ w o = g are no sums of rounded numbers, but exact, and none is negative."""
    real, kind = types(2, dtype).real, getattr(torch, dtype)
    triple = wp.types.vector(3, real)
    if block == "stencil":
        along = stencil_sums(2, dtype).weights
    else:
        weights, vec = spline(2, dtype).weights, types(2, dtype).vec

        @wp.func
        def along(g: real) -> triple:
            w = weights(vec(g + real(1.0), real(1.0)))
            return triple(w[0, 0], w[1, 0], w[2, 0])

    fx = 0.5 + torch.rand(5000, generator=torch.Generator().manual_seed(2), dtype=kind)
    ends = torch.tensor([0.5, 1.0, 1.5], dtype=kind)
    near = [torch.nextafter(ends, towards * torch.ones(3, dtype=kind)) for towards in (1.0, 0.0, 2.0)]
    fx = torch.cat([fx, ends, *near])
    g = fx[(fx >= 0.5) & (fx < 1.5)] - 1
    w = apply(along, triple, (3,), (g.to(device), real)).cpu()
    assert torch.equal((w[:, 0] + w[:, 2]) + w[:, 1], torch.ones_like(g))
    assert torch.equal(w[:, 2] - w[:, 0], g)
    assert (w >= 0).all()
    torch.testing.assert_close(w[:, 1], 0.75 - g * g, rtol=0, atol=torch.finfo(kind).eps / 2)
