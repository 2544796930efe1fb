"""Lamé's constants and masses of the particles: the formulas to the last digit, and their gradients."""

import pytest
import torch
from helpers import busy_scene

import softmpm
from softmpm.material import material

SHAPES = [(), (1,), (2, 1), (1, 24), (2, 24)]
"""That broadcast to two worlds of 24 particles."""


def params_of(model: softmpm.Model, shape: tuple[int, ...]) -> softmpm.Params:
    """Random material, each of this shape, whose gradients are wanted."""
    generator = torch.Generator().manual_seed(3)

    def between(low: float, high: float) -> torch.Tensor:
        share = torch.rand(shape, generator=generator, dtype=torch.float64)
        return (low + (high - low) * share).to(model.device, model.dtype).requires_grad_()

    return softmpm.Params(between(50.0, 200.0), between(-0.3, 0.45), between(0.7, 2.0))


def two_worlds(device: str, dtype: torch.dtype) -> softmpm.Model:
    return softmpm.build(busy_scene(2), device=device, dtype=dtype, worlds=2)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_constants_are_those_of_the_formulas(shape, dtype, device):
    """With the same bits as in PyTorch's operations, of tensors that broadcast; gradients up to rounding."""
    model, limit = two_worlds(device, dtype), {torch.float32: 3e-6, torch.float64: 1e-13}[dtype]
    params, lead = params_of(model, shape), (2, 24)
    E, nu, rho = params
    by_hand = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu)), rho * model.volume / model.mass_unit
    found = material(model, params)
    for got, want in zip(found, by_hand, strict=True):
        assert torch.equal(got, want.expand(lead))
    weights = torch.linspace(-1.0, 2.0, 48, device=device, dtype=dtype).view(lead)
    sums = (torch.stack([(weights * one).sum() for one in three]) for three in (found, by_hand))
    got, want = (torch.autograd.grad(each.sum(), params) for each in sums)
    for one, other in zip(got, want, strict=True):
        assert one.shape == other.shape and (one - other).abs().max() <= limit * other.abs().max()


def test_a_material_that_needs_no_gradient_has_none(device):
    """And its constants are kept for the next call."""
    model = two_worlds(device, torch.float32)
    params = softmpm.Params(*(value.detach() for value in params_of(model, (24,))))
    first, again = material(model, params), material(model, params)
    assert not any(one.requires_grad for one in first)
    assert all(one is other for one, other in zip(first, again, strict=True))
