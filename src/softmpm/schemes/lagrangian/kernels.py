"""Kernels of a call and its gradient besides those of the chunks, compiled together before the first of them is launched."""

import warp as wp

from softmpm.kernels.compile import THREADS, compile_together
from softmpm.kernels.lagrangian.cells import cells
from softmpm.kernels.lagrangian.node_sums import node_sums
from softmpm.kernels.lagrangian.projection import masses, projection
from softmpm.kernels.lagrangian.surface import surface
from softmpm.model import Model
from softmpm.schemes.lagrangian.bricks import NODE_BLOCK


def compile_first(model: Model, adjoint: bool = False) -> None:
    """Compile those of a call, or of its gradient, unless this thread has done it for this model."""

    def compiled() -> bool:
        compile_together(first_kernels(model, adjoint), model.wp_device)
        return True

    model.workspace.get((compile_first, adjoint), compiled)


def first_kernels(model: Model, adjoint: bool) -> list[tuple[wp.Kernel, int]]:
    """The kernels, with the threads of a block."""
    spec, bricks = model.spec, model.rest_grid.bricks
    states, mass = projection(spec.dim, spec.dtype, bricks), masses(spec.dim, spec.dtype, bricks)
    sums = node_sums(spec.dim, spec.dtype)
    if adjoint:
        of_bricks = [states.project_adj, states.show_adj, mass.masses_adj]
        of_nodes = [sums.fields, sums.means_adj]
    else:
        of_bricks = [states.show, states.project, mass.bricks_of_masses, cells(spec, bricks).check_state]
        of_nodes = [sums.mass, sums.means]
    found = [(kernel, bricks.threads) for kernel in of_bricks] + [(kernel, NODE_BLOCK) for kernel in of_nodes]
    if model.surface is not None and not adjoint:
        found.append((surface(spec).check_depth, THREADS))
    return found
