"""Policies and their optimiser with weights, rates and snapshots for each world of one simulation."""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

HIDDEN = 64
"""Width of both hidden layers."""


class Policies(nn.Module):
    """tanh of a network of features and clock, or of a linear map, with weights for each world."""

    def __init__(self, size: int, muscles: int, each: dict[str, Tensor], seeds: int):
        super().__init__()
        self.features, self.linear = each["features"][:, None], each["linear"][:, None, None] > 0
        first = 2 * math.pi / each["period"]
        self.rate = torch.stack([first, 2 * first], dim=-1)
        gain, generator, size = each["gain"][:, None, None], torch.Generator().manual_seed(1), size + 4

        def drawn(draw: Callable[..., Tensor], rows: int, columns: int, size: float) -> Tensor:
            one = draw(seeds, rows, columns, generator=generator) * size
            return one.repeat(len(gain) // seeds, 1, 1).to(gain.device)

        def even(*shape: int, generator: torch.Generator) -> Tensor:
            return torch.rand(*shape, generator=generator) * 2 - 1

        near, far = 1 / math.sqrt(size), 1 / math.sqrt(HIDDEN)
        self.w1 = nn.Parameter(drawn(even, size, HIDDEN, near))
        self.b1 = nn.Parameter(drawn(even, 1, HIDDEN, near))
        self.w2 = nn.Parameter(drawn(even, HIDDEN, HIDDEN, far))
        self.b2 = nn.Parameter(drawn(even, 1, HIDDEN, far))
        self.w3 = nn.Parameter(drawn(torch.randn, HIDDEN, muscles, far) * gain)
        self.b3 = nn.Parameter(torch.zeros_like(self.w3[:, :1]))
        self.direct = nn.Parameter(drawn(torch.randn, size, muscles, near) * gain)

    def forward(self, z: Tensor, time: Tensor, goal: Tensor | None = None) -> Tensor:
        angle = time[..., None] * self.rate
        x = torch.cat([z * self.features, angle.sin(), angle.cos()], dim=-1)[..., None, :]
        h = nn.functional.elu(x @ self.w1 + self.b1)
        h = nn.functional.elu(h @ self.w2 + self.b2)
        y = torch.where(self.linear, x @ self.direct, h @ self.w3) + self.b3
        return torch.tanh(y[..., 0, :])


class Learners:
    """Adam with rates for each world, which goes back to its best where it stays below half of its best progress.

    Args:
        parameters: With a leading axis of the worlds.
        rates: Of each parameter, for each world or for all.

    Attributes:
        best: Lowest loss of each world.
        snapshot: Parameters of the lowest losses.
        longest: Largest norm of a finite gradient of each world.
        scale: Factor of the rates of each world, which falls by half at each return.
    """

    def __init__(self, parameters: list[Tensor], rates: list[Tensor]):
        self.parameters, self.rates = parameters, rates
        self.adam = torch.optim.Adam(parameters, lr=1.0)
        none = torch.zeros(len(parameters[0]), device=parameters[0].device)
        self.first, self.best, self.below, self.scale = none, none + math.inf, none, none + 1.0
        self.longest = none
        self.snapshot = [p.detach().clone() for p in parameters]
        self.iterations = 0

    @torch.no_grad()
    def step(self, loss: Tensor, gradients: list[Tensor]) -> None:
        """Learn from the loss of each world and from its gradient, shortened to a length of at most 1."""
        norm = torch.stack([g.flatten(1).double().square().sum(1) for g in gradients]).sum(0).sqrt()
        failed = ~(norm.isfinite() & loss.isfinite())
        loss = loss.masked_fill(failed, math.inf)
        self.longest = torch.maximum(self.longest, norm.masked_fill(failed, 0.0).to(loss.dtype))
        self.first = loss if self.iterations == 0 else self.first
        self._keep(loss < self.best)
        self.best = torch.minimum(loss, self.best)
        low = self.first - loss < 0.5 * (self.first - self.best)
        self.below = torch.where(low & (self.iterations > 20), self.below + 1, 0.0)
        back = failed | (self.below >= 5)
        self.below = self.below.masked_fill(back, 0.0)
        self.scale = torch.where(back, self.scale / 2, self.scale)
        shorter = (1 / norm.clamp(min=1e-12)).clamp(max=1.0).to(loss.dtype)
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = torch.where(_rows(failed, gradient), 0.0, gradient * _rows(shorter, gradient))
        before = [p.detach().clone() for p in self.parameters]
        self.adam.step()
        for p, old, rate, best in zip(self.parameters, before, self.rates, self.snapshot, strict=True):
            p.copy_(torch.where(_rows(back, p), best, old + (p - old) * _rows(rate * self.scale, p)))
        self.iterations += 1

    def _keep(self, better: Tensor) -> None:
        for parameter, best in zip(self.parameters, self.snapshot, strict=True):
            best.copy_(torch.where(_rows(better, parameter), parameter, best))

    @torch.no_grad()
    def back(self, world: int | slice, share: float) -> None:
        """Move a world by a share of the way to its best."""
        for parameter, best in zip(self.parameters, self.snapshot, strict=True):
            parameter[world] = parameter[world].lerp(best[world], share)


def _rows(each: Tensor, like: Tensor) -> Tensor:
    """A number for each world, which broadcasts to its row of ``like``."""
    return each.reshape(-1, *[1] * (like.dim() - 1))
