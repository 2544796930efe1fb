"""Driven particles of the reference formulation: launches of a chunk, and the velocities of the nodes that they hold."""

from collections.abc import Callable
from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.batches import FirstOrder, FirstOrderAdjoint
from softmpm.driven_grid import DrivenGrid, Sparse
from softmpm.kernels.lagrangian.driven import driven, driven_adj, spread
from softmpm.kernels.structs import RequestedGrads, types
from softmpm.model import Model
from softmpm.schemes.buffers import view
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.lagrangian.frame import frame_struct
from softmpm.schemes.launch import launcher


def drive(
    model: Model,
    launch: Callable[..., None],
    inputs: Any,
    words: wp.array,
    u: wp.array,
    new_u: wp.array,
    new_v: wp.array,
) -> None:
    """Launch (Q10), if the scene has driven particles."""
    if model.driven_grid is not None:
        nodes = view(model.driven_grid.nodes, wp.int32)
        parameters = (model.constants, inputs, frame_struct(model), nodes, words)
        launch(driven(model.spec).drive, _lead(model.driven_grid, model), *parameters, u, new_u, new_v)


def drive_adj(
    model: Model,
    launch: Callable[..., None],
    wanted: RequestedGrads,
    moved: float,
    adj_u: wp.array,
    adj_v: wp.array,
    adj_inputs: Any,
) -> None:
    """Launch (Q10.adj), if the scene has driven particles; ``moved`` is Δt if the velocity moved the nodes, else 0."""
    if model.driven_grid is not None:
        nodes = view(model.driven_grid.nodes, wp.int32)
        kernel = driven_adj(model.spec, wanted).drive_adj
        launch(kernel, _lead(model.driven_grid, model), nodes, moved, adj_u, adj_v, adj_inputs)


def _lead(grid: DrivenGrid, model: Model) -> tuple[int, int]:
    return model.worlds, grid.count


def of_nodes(model: Model, velocity: Tensor) -> Tensor:
    """Velocities of the nodes that driven particles hold (Q11), from those of the particles. Differentiable.

    Args:
        velocity: Shape (control_step, world, driven, dim).
    """
    return _Spread.apply(model, velocity)  # pyright: ignore[reportReturnType]


class _Spread(FirstOrder):
    """(Q11)"""

    @staticmethod
    def forward(model, velocity):
        return _multiplied(model, model.driven_grid.spread, velocity)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.model = inputs[0]

    @staticmethod
    def backward(ctx, *adj):
        return None, _SpreadAdj.apply(ctx.model, *adj)


class _SpreadAdj(FirstOrderAdjoint):
    @staticmethod
    def forward(model, adj):
        return _multiplied(model, model.driven_grid.transposed, adj)


@on_its_gpu
def _multiplied(model: Model, matrix: Sparse, given: Tensor) -> Tensor:
    """Product with each row of ``given``, (control_step, world, column, dim)."""
    t, lead = types(model.spec.dim, model.spec.dtype), given.shape[0] * given.shape[1]
    out = torch.empty(*given.shape[:2], matrix.rows, model.dim, dtype=model.dtype, device=model.device)
    parts = view(matrix.first, wp.int32), view(matrix.column, wp.int32), view(matrix.value, wp.float64)
    arrays = (view(one.contiguous().flatten(0, 1), t.vec) for one in (given, out))
    launch = launcher(model)
    launch(spread(model.spec.dim, model.spec.dtype), (lead, matrix.rows), *parts, *arrays)
    return out
