"""A policy is asked about examples before a run: the gradient is that of all control steps at once, whose activations must be those of
each step alone.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from softmpm_learn.seeding import seeded

AGAIN, AT_ONCE = 1e3, 1e5
"""Largest differences of a policy's answers, relative to the largest number, in units of the precision: of the same evaluation again,
and of one of all control steps from one after another, where convolutions in float32 have ten bits on a GPU (TF32)."""
STEPS = 8
"""Control steps, at most, about which a policy is asked."""


def check_policy(
    name: str,
    policy: nn.Module,
    size: int,
    muscles: int,
    times: Tensor,
    worlds: int,
    goal: Tensor | None = None,
) -> None:
    """Ask a policy about each control step alone, twice, and about all of them at once. Random numbers that it draws are not those
    of a run.

    Args:
        size, muscles: Number of features and of activations.
        times: Times at which control steps begin [s], shape (step,).
        goal: A goal of each world [m], shape (world, dim).

    Raises:
        ValueError: The activations have another shape than (world, muscle), or they or their gradients differ.
    """
    times = times[:: math.ceil(len(times) / STEPS)]
    z = torch.linspace(-1.0, 1.0, len(times) * worlds * size).to(times).view(-1, worlds, size)

    def at_once() -> Tensor:
        try:
            return policy(z, times[:, None], goal)
        except Exception as error:
            error.add_note(
                f"This was the policy {name}, asked for {len(times)} control steps at once, with features of shape {tuple(z.shape)} "
                f"and times of shape ({len(times)}, 1). A policy has no memory from step to step."
            )
            raise

    def in_turn() -> Tensor:
        return torch.stack([policy(features, time, goal) for features, time in zip(z, times, strict=True)])

    with seeded(0, z.device):
        one, wanted = policy(z[0], times[0], goal), (worlds, muscles)
        if one.shape != wanted:
            raise ValueError(
                f"policy {name} must give activations of shape (world, muscle) = {wanted} for one control step, got "
                f"{tuple(one.shape)}; an open loop, which sees a time of shape () or, of many control steps, (step, 1), ends with "
                ".expand(*z.shape[:-1], -1)."
            )
        answers = in_turn(), in_turn(), at_once()
    first, whole = answers[0], answers[2]
    if whole.shape != first.shape:
        raise ValueError(
            f"policy {name} must give activations of shape (step, world, muscle) = {tuple(first.shape)} for {len(times)} control steps "
            f"at once, got {tuple(whole.shape)}: write forward for any number of leading axes."
        )
    _need_equal(name, "activations", *([answer] for answer in answers))
    weights = [p for p in policy.parameters() if p.requires_grad]
    if weights and first.requires_grad:  # noise that does not show in activations yet does in these
        adj = torch.arange(1.0, first.numel() + 1).cos().to(first).view_as(first)
        options = dict(retain_graph=True, allow_unused=True, materialize_grads=True)
        gradients = [torch.autograd.grad(answer, weights, adj, **options) for answer in answers]
        _need_equal(name, "gradients", *gradients)


def _need_equal(
    name: str, what: str, once: Sequence[Tensor], again: Sequence[Tensor], at_once: Sequence[Tensor]
) -> None:
    """Raise ValueError unless three answers are the same, up to rounding."""
    first, *others = (torch.cat([t.detach().flatten() for t in answer]) for answer in (once, again, at_once))
    ways = ("asked twice", AGAIN), ("asked for all control steps at once", AT_ONCE)
    for (way, units), other in zip(ways, others, strict=True):
        away, largest = (other - first).abs().max().item(), first.abs().max().item()
        if away > units * torch.finfo(first.dtype).eps * largest:
            raise ValueError(
                f"policy {name} must be a function of features, time and goal alone, with the same values whether it is asked for one "
                f"control step or, as for the gradient, for all at once; {way}, it has {what} that differ by {away:.2g} (largest "
                f"{largest:.2g}). Keep noise and memory out of its forward: draw noise once, as a buffer, and switch dropout off "
                "with eval()."
            )
