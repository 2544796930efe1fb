"""Gradients that fade on their way back through the states of an episode.

A walk amplifies small changes: the gradient of a distance with respect to what a muscle did seconds before is exact, but its norm
grows a thousandfold, and steps along it lead away from gaits (docs/learning.md). With the time constant τ a gradient that passes a
control step of T_c seconds is multiplied by γ = exp(−T_c/τ). What is taken off the gradient of the positions goes on as if the
robot were only displaced:

    s_k = γ s_k + (1 − γ) sg(s_k),   c_k = c_{k−1} + (1 − γ) (x_k − sg(x_k)),   x_k + c_{k−1} is what the objective sees

with sg for a value without its gradient: all values stay what they are, and c is zero. A distance counts every step, however long ago.
"""

import math

import torch
from torch import Tensor

from softmpm import State


class _Fade(torch.autograd.Function):
    """Tensors as they are, whose gradients are multiplied by a factor, or by one for each world."""

    @staticmethod
    def forward(ctx, factor: float | Tensor, *tensors: Tensor):
        ctx.factor = factor
        return tuple(tensor.view_as(tensor) for tensor in tensors)

    @staticmethod
    def backward(ctx, *adj: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, *(None if one is None else _times(ctx.factor, one) for one in adj)


def _times(factor: float | Tensor, adj: Tensor) -> Tensor:
    if isinstance(factor, Tensor):
        factor = factor.view(-1, *[1] * (adj.dim() - 1))
    return factor * adj


class Fading:
    """Fading along one episode.

    Args:
        time: τ [s], or that of each world, shape (world,); infinite for gradients that do not fade.
        period: Duration of a control step [s].
    """

    def __init__(self, time: float | Tensor, period: float):
        worlds = isinstance(time, Tensor)
        self.factor = torch.exp(-period / time) if worlds else math.exp(-period / time)
        self._carry: Tensor | None = None

    def __call__(self, state: State) -> tuple[State, State]:
        """The state from which the simulation goes on, and the state as the objective sees it."""
        if not state.x.requires_grad or (isinstance(self.factor, float) and self.factor == 1.0):
            return state, state
        seen = state if self._carry is None else state._replace(x=state.x + self._carry)
        lost = _Fade.apply(1.0 - self.factor, state.x)[0] - state.x.detach()
        self._carry = lost if self._carry is None else self._carry + lost
        return self._faded(state), seen

    def _faded(self, state: State) -> State:
        faded = State.of(_Fade.apply(self.factor, *state.differentiable()))._replace(low=state.low)
        if state.nodes is None:
            return faded
        u, v, anchor, force = _Fade.apply(self.factor, *state.nodes[:4])
        return faded._replace(nodes=state.nodes._replace(u=u, v=v, anchor=anchor, force=force))
