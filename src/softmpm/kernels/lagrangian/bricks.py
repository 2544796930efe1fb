"""Bricks of cells: boxes of cells with the window of their nodes.

On the CPU a thread has a brick, reads nodes where they are and adds to the partial sums directly (fours.h). On a GPU a block of threads
has a brick, with the nodes of its window in shared memory (bricks.h). There are no atomic additions: results are the same bits in every
run.

Particles anywhere: each thread has one particle of a row (interpolation.py). Particles on a lattice, the same in every cell: each
thread has a layer of a cell, whose particles share weights (lattice.py).
"""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.rest import UNROLLED
from softmpm.kernels.lagrangian.rows import ROWS_HEADER
from softmpm.kernels.parts import in_parts

HEADER, FOURS_HEADER = (Path(__file__).with_name(name) for name in ("bricks.h", "fours.h"))


class Bricks(NamedTuple):
    """Size of bricks."""

    cells: tuple[int, ...]
    """Cells along each axis."""
    parts: int
    """Particles of a cell in a row."""
    lattice: bool = False
    """True if all cells have the same ``parts`` places along each axis."""
    serial: bool = False
    """True if one thread has a brick, as on the CPU."""
    blocks: int = 1
    """Blocks that a multiprocessor is to hold at least: more of them leave fewer registers for each."""

    @property
    def dim(self) -> int:
        return len(self.cells)

    @property
    def cell_count(self) -> int:
        return math.prod(self.cells)

    @property
    def slots(self) -> int:
        """Particles of a row."""
        return self.cell_count * self.parts

    @property
    def threads(self) -> int:
        """Threads that have a brick."""
        return 1 if self.serial else max(self.slots, self.cell_count * self.dim)

    @property
    def turns(self) -> int:
        """Places in a row and idle threads beside them."""
        return self.slots if self.serial else self.threads

    @property
    def layer_threads(self) -> int:
        """Threads that have a brick of a lattice."""
        return 1 if self.serial else self.slots

    @property
    def layer(self) -> int:
        """Particles of a layer of a lattice."""
        return self.parts ** (self.dim - 1)

    @property
    def window(self) -> tuple[int, ...]:
        """Nodes along each axis."""
        return tuple(length + 2 for length in self.cells)

    @property
    def nodes(self) -> int:
        return math.prod(self.window)

    @property
    def cell_numbers(self) -> np.ndarray:
        """Number of each cell, shape ``cells``.

        Eight threads in a row read their nodes at once if these lie in different banks of shared memory. Four nodes along the last axis
        fill half of the banks; in bricks of 4 × 4 × 4 cells those of the next slice fill the other half, those of the next row do not.
        """
        numbers = np.arange(self.cell_count)
        if self.cells == (4, 4, 4) and not self.serial:
            numbers = numbers.reshape(2, 4, 2, 4).swapaxes(1, 2)
        return numbers.reshape(self.cells)

    def shared_bytes(self, number: int) -> int:
        """Bytes of shared memory of the adjoint kernel with viscosity, the largest, for numbers of this size (bricks.h)."""
        fields, count = 3 * self.nodes * (2 if self.dim == 2 else 4), 2 if self.pairs else 1
        if self.lattice:
            planes = 3 * self.parts * self.nodes * (2 if self.dim == 2 else 4)
        else:
            planes = self.terms((count * self.dim + 2) * self.dim, count)
        return number * (fields + planes)

    @property
    def pairs(self) -> bool:
        """True if threads suffice for the components of two fields at once."""
        return not self.serial and 2 * self.cell_count * self.dim <= self.threads

    def terms(self, given: int, fields: int) -> int:
        """Numbers in the memory of what the particles of a row give, and then of the sums of fields."""
        return max(given * self.slots, 3 * fields * self.nodes * self.dim)

    @property
    def settings(self) -> dict:
        """Of kernels that have bricks."""
        return dict(grid_stride=False, launch_bounds=(self.threads, self.blocks))

    def layer_settings(self, warps: int) -> dict:
        """Of kernels that have bricks of a lattice, with so many warps in a multiprocessor at least."""
        bounds = (self.layer_threads, max(self.blocks, warps // -(-self.layer_threads // 32)))
        return dict(grid_stride=False, launch_bounds=bounds)


FEW = {2: 50_000, 3: 20_000}
"""Below this number of particles bricks are small, so that more multiprocessors have one."""
LARGEST_LATTICE = 3
"""Places along each axis."""


def bricks_for(dim: int, particles: int, device: torch.device, dtype: torch.dtype, places: int) -> Bricks:
    """Size of the bricks.

    Args:
        particles: Of all worlds.
        places: Places along each axis if the particles are on a lattice, else 0.
    """
    lattice = 0 < places <= LARGEST_LATTICE
    serial, few = device.type == "cpu", particles < FEW[dim]
    if dim == 2:
        return Bricks((4, 4) if few and not serial else (8, 8), places if lattice else 4, lattice, serial)
    if serial:
        return Bricks((4, 4, 4), places if lattice else 4, lattice, serial)
    cells = (4, 4, 4) if not few else (4, 4, 2) if lattice else (2, 2, 2)
    if dtype == torch.float64:
        cells = (4, 2, 2)
    return Bricks(cells, places if lattice else 8 if few else 4, lattice)


def brick_options(groups: int = 1) -> dict:
    """Compile options of kernels of bricks, as native functions need them.

    Args:
        groups: Bricks that a block of threads has at a time.
    """
    source = (
        f"#define SOFTMPM_GROUPS {groups}\n" * (groups > 1) + ROWS_HEADER.read_text() + HEADER.read_text()
    )
    return {
        "extra_build_options": in_parts(source, FOURS_HEADER.read_text()),
        "max_unroll": UNROLLED,
        "cuda_output": "cubin",
    }


@kernel_factory
def window(bricks: Bricks, threads: int) -> SimpleNamespace:
    """Nodes of the window that a thread copies."""
    Window = wp.types.vector(1 if bricks.serial else -(-bricks.nodes // threads), wp.int32)

    @wp.func_native(f"return softmpm::window_nodes<{bricks.nodes}, {threads}>(window, brick, lane);")
    def read(window: wp.array2d(dtype=wp.int32), brick: int, lane: int) -> Window: ...

    @wp.func
    def window_of(window: wp.array2d(dtype=wp.int32), brick: int, lane: int) -> Window:
        if wp.static(bricks.serial):
            return Window()
        else:
            return read(window, brick, lane)

    return SimpleNamespace(Window=Window, window_of=window_of)


@wp.func_native("return softmpm::block_number();")
def block_number() -> int: ...


@wp.func_native("return softmpm::thread_number();")
def thread_number() -> int: ...


@wp.func_native("softmpm::meet();")
def meet(): ...


@wp.func_native("softmpm::meet_cluster<true>();")
def meet_cluster(): ...


@wp.func_native("softmpm::meet_cluster<false>();")
def meet_cluster_adj():
    """For the adjoint, which took 5 % longer with the other one in a trial (biped, H200, Warp 1.19); forward took 11 % less."""
