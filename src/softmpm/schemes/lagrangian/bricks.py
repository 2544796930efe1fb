"""Launches over the bricks and the nodes at rest."""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.kernels.lagrangian.layers import layers
from softmpm.kernels.lagrangian.portions import PORTION
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import view
from softmpm.schemes.launch import KernelLauncher
from softmpm.surface_grid import SurfaceGrid


def rest_struct(model: Model) -> Any:
    """Struct on the nodes, bricks and particles at rest."""

    def make():
        t, grid = types(model.spec.dim, model.spec.dtype), model.rest_grid
        struct = rest(model.spec.dim, model.spec.dtype).Rest()
        struct.nodes, struct.fraction = view(grid.nodes, t.ivec), view(grid.fraction, t.vec)
        for name in ("shares", "window", "rows", "places", "corners", "order"):
            setattr(struct, name, view(getattr(grid, name), wp.int32))
        touched = torch.full((grid.count,), -1, dtype=torch.int32, device=model.device)
        if isinstance(model.surface, SurfaceGrid):
            nodes = model.surface.nodes
            touched[nodes.long()] = torch.arange(len(nodes), dtype=torch.int32, device=model.device)
        struct.touched = view(touched, wp.int32)
        return struct

    return model.workspace.get(rest_struct, make)


def lattice_struct(model: Model) -> Any:
    """Struct of the weights of a lattice."""

    def make():
        assert model.rest_grid.lattice is not None
        lattice = layers(model.spec.dim, model.spec.dtype, model.rest_grid.bricks).Lattice()
        f = torch.from_numpy(model.rest_grid.lattice.reshape(-1)).to(model.dtype)
        square = (f - 1.0) ** 2 + 0.5 - 0.5  # as in kernels/physics/spline.py
        outer = 0.125 + 0.5 * square
        w = torch.stack([outer - 0.5 * (f - 1.0), 0.75 - square, outer + 0.5 * (f - 1.0)], -1)
        e = 4.0 / model.scene.grid.spacing * w * (torch.arange(3) - f[:, None])
        e[:, 1] = -(e[:, 0] + e[:, 2])  # their sum is zero to the last bit
        lattice.w, lattice.e = w.flatten().tolist(), e.flatten().tolist()
        return lattice

    return model.workspace.get(lattice_struct, make)


def brick_launch(model: Model, launch: KernelLauncher, kernel, *inputs, layered: bool = False) -> None:
    """Launch a kernel of bricks: a block of threads for each on a GPU, one thread on the CPU."""
    grid = model.rest_grid
    threads = grid.bricks.layer_threads if layered else grid.bricks.threads
    launch(kernel, (model.worlds, grid.brick_count, threads), *inputs, block_dim=threads, part=1)


def node_launch(model: Model, launch: KernelLauncher, kernel, *inputs) -> None:
    """Launch a kernel of nodes."""
    dim = model.worlds, portions(model, model.rest_grid.count)
    launch(kernel, dim, *inputs, block_dim=NODE_BLOCK, part=NODE_PART // PORTION)


def portions(model: Model, count: int) -> int:
    """Threads that have so many nodes or surface points."""
    return count if model.device.type == "cuda" else -(-count // PORTION)


NODE_BLOCK, NODE_PART = 128, 512
"""Threads per block of kernels of nodes, and nodes in each of the parts into which a CPU divides the launch."""


def empty_partial(model: Model) -> Tensor:
    """Memory for the sums of all bricks for the nodes of their windows."""
    grid = model.rest_grid
    return torch.empty(model.worlds, grid.window.numel(), model.dim, dtype=model.dtype, device=model.device)
