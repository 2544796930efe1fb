"""Gradients that fade on their way back through the states of an episode.

A walk amplifies small changes: the gradient of a distance with respect to what a muscle did seconds before is exact, but its norm
grows a thousandfold, and steps along it lead away from gaits (docs/learning.md). With the time constant τ a gradient that passes a
control step of T_c seconds is multiplied by γ = exp(−T_c/τ). What is taken off the gradient of the positions goes on as if the
robot were only displaced:

    s_k = γ s_k + (1 − γ) sg(s_k),   c_k = c_{k−1} + (1 − γ) (x_k − sg(x_k)),   x_k + c_{k−1} is what the objective sees

with sg for a value without its gradient: all values stay what they are, and c is zero. A distance counts every step, however long ago.
So only gradients are computed: with the gradient ō_k of what the objective sees of x_k,

    x̄_k = ō_k + γ s̄_k + (1 − γ) c̄_k,   c̄_{k−1} = ō_k + c̄_k
"""

import math

import torch
from torch import Tensor

from softmpm import State


class _Fade(torch.autograd.Function):
    """A carry and tensors as they are. Their gradients are multiplied by γ, or by that of each world. That of the carry passes,
    and 1 − γ of it is added to that of the first tensor."""

    @staticmethod
    def forward(ctx, factor: float | Tensor, carry: Tensor, *tensors: Tensor):
        ctx.factor = factor
        return tuple(tensor.view_as(tensor) for tensor in (carry, *tensors))

    @staticmethod
    def backward(ctx, *adj: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        carried, first, *others = adj
        found = (_times(ctx.factor, one) for one in (first - carried, *others))
        return None, carried, carried + next(found), *found


class _Add(torch.autograd.Function):
    """A tensor as it is, with the gradient of a sum with a carry."""

    @staticmethod
    def forward(ctx, tensor: Tensor, carry: Tensor):
        return tensor.view_as(tensor)

    @staticmethod
    def backward(ctx, adj: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        return adj, adj


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
        if self._carry is None:
            self._carry, seen = state.x.new_zeros(()).expand_as(state.x), state
        else:
            seen = state._replace(x=_Add.apply(state.x, self._carry))
        return self._faded(state), seen

    def _faded(self, state: State) -> State:
        nodes = () if state.nodes is None else state.nodes[:4]
        self._carry, *found = _Fade.apply(self.factor, self._carry, *state.differentiable(), *nodes)
        faded = State.of(found[: len(found) - len(nodes)])._replace(low=state.low)
        if state.nodes is None:
            return faded
        u, v, anchor, force = found[-len(nodes) :]
        return faded._replace(nodes=state.nodes._replace(u=u, v=v, anchor=anchor, force=force))
