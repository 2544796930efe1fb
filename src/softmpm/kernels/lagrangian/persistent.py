"""One kernel for all substeps of a control step, for small scenes on a GPU.

A cluster of blocks has a world. Where the launches of launches.py follow each other, its multiprocessors wait for each other at a
barrier of the hardware. The stages are the functions of the kernels that are launched one by one, and the results are theirs up to
rounding, see docs/decisions/0010-reference-formulation.md. On the CPU, for tests, one thread does everything.
"""

from types import SimpleNamespace
from typing import NamedTuple

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, brick_module, meet_cluster
from softmpm.kernels.lagrangian.cells import cells, cells_adj
from softmpm.kernels.lagrangian.chunk import chunk
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.lattice import lattice_cells, lattice_cells_adj, layers
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.lagrangian.surface import LANES, surface, surface_type
from softmpm.kernels.lagrangian.surface_adj import surface_adj
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


class Cluster(NamedTuple):
    """Blocks of threads that have a world."""

    bricks: Bricks
    blocks: int
    groups: int
    """Groups of threads in a block; each has a brick."""

    @property
    def group_threads(self) -> int:
        """Threads of a group."""
        return self.bricks.layer_threads if self.bricks.lattice else self.bricks.threads

    @property
    def threads(self) -> int:
        """Of a block."""
        return self.groups * self.group_threads

    @property
    def settings(self) -> dict:
        """Of the kernels."""
        bounds = dict(enable_backward=False, grid_stride=False, launch_bounds=(self.threads, 1))
        return bounds if self.bricks.serial else bounds | dict(cluster_dim=self.blocks)

    @property
    def name(self) -> str:
        return f"{self.bricks.name}.c{self.blocks}x{self.groups}"


@kernel_factory
def march(spec: Spec, cluster: Cluster) -> wp.Kernel:
    """Kernel of the substeps from ``first`` to before ``last``."""
    bricks, given, memory = cluster.bricks, input_types(spec), chunk(spec.dim, spec.dtype)
    ParticleInputs, GridInputs, Chunk = given.ParticleInputs, given.GridInputs, memory.Chunk
    Constants, Rest = types(spec.dim, spec.dtype).Constants, rest(spec.dim, spec.dtype).Rest
    Frame, Surface = frame(spec.dim, spec.dtype).Frame, surface_type(spec.dim, spec.dtype)
    Lattice, lattice = layers(spec.dim, spec.dtype, bricks).Lattice, bricks.lattice
    forces_at = lattice_cells(spec, bricks).forces_at if lattice else cells(spec, bricks).forces_at
    advance_at, contact = nodes(spec).advance_at, bool(spec.surface_walls)
    press_at = surface(spec).press_at if contact else None
    settle_at = surface(spec).settle_at if contact else None
    size, groups, blocks, threads = cluster.group_threads, cluster.groups, cluster.blocks, cluster.threads
    numbers, lanes = numbering(cluster), 1 if bricks.serial else LANES[spec.dim]
    number, rounded = numbers.number, numbers.rounded
    module = brick_module(f"{spec.module}.lagrangian.{cluster.name}", groups)

    @wp.kernel(module=module, **cluster.settings)
    def march(
        constants: Constants,
        inputs: ParticleInputs,
        grid_inputs: GridInputs,
        inside: Rest,
        weights: Lattice,
        moving: Frame,
        body: Surface,
        at: Chunk,
        first: int,
        last: int,
        anew: int,  # 1 if a control step begins with the first substep, but not with the chunk
    ):
        world, block, thread = wp.tid()
        own = number(block, thread)
        lane = thread % size
        for s in range(first, last):
            for brick in range(block + blocks * (thread / size), inside.corners.shape[0], blocks * groups):
                if wp.static(lattice):
                    forces_at(world, brick, lane, constants, inputs, inside, weights, at, s)
                else:
                    forces_at(world, brick, lane, constants, inputs, inside, at, s)
            meet_cluster()
            for i in range(own, inside.nodes.shape[0], blocks * threads):
                advance_at(world, i, constants, grid_inputs, inside, moving, at, s)
            meet_cluster()
            if wp.static(contact):
                begins = wp.where(s == first, anew, 0)
                for p in range(own, body.points.shape[0], blocks * threads):
                    press_at(world, p, constants, grid_inputs, body, moving, at, s, begins)
                meet_cluster()
                count = body.nodes.shape[0]
                for k in range(own, rounded(count * lanes), blocks * threads):
                    n = wp.min(k / lanes, count - 1)
                    settle_at(world, n, k - n * lanes, constants, body, moving, at, s)
                meet_cluster()

    return march


@kernel_factory
def march_adj(spec: Spec, wanted: RequestedGrads, cluster: Cluster) -> wp.Kernel:
    """Adjoint of :func:`march`; the sums of the bricks in substep ``first`` are still to be added to the adjoint of the state."""
    bricks, given, memory = cluster.bricks, input_types(spec), chunk(spec.dim, spec.dtype)
    ParticleInputs, GridInputs = given.ParticleInputs, given.GridInputs
    Chunk, Adjoint, adjoints = memory.Chunk, memory.Adjoint, input_adj_types(spec, wanted)
    ParticleInputsAdj, GridInputsAdj = adjoints.ParticleInputsAdj, adjoints.GridInputsAdj
    Constants, Rest = types(spec.dim, spec.dtype).Constants, rest(spec.dim, spec.dtype).Rest
    Surface, contact = surface_type(spec.dim, spec.dtype), bool(spec.surface_walls)
    Lattice, lattice = layers(spec.dim, spec.dtype, bricks).Lattice, bricks.lattice
    of_cells = lattice_cells_adj(spec, wanted, bricks) if lattice else cells_adj(spec, wanted, bricks)
    forces_adj_at, advance_adj_at = of_cells.forces_adj_at, nodes_adj(spec, wanted).advance_adj_at
    settle_adj_at = surface_adj(spec, wanted).settle_adj_at if contact else None
    press_adj_at = surface_adj(spec, wanted).press_adj_at if contact else None
    spread_adj_at = surface_adj(spec, wanted).spread_adj_at if contact else None
    size, groups, blocks, threads = cluster.group_threads, cluster.groups, cluster.blocks, cluster.threads
    numbers, lanes = numbering(cluster), 1 if bricks.serial else LANES[spec.dim]
    number, rounded = numbers.number, numbers.rounded
    module = brick_module(f"{adj_module(spec, wanted)}.lagrangian.{cluster.name}", groups)

    @wp.kernel(module=module, **cluster.settings)
    def march_adj(
        constants: Constants,
        inputs: ParticleInputs,
        grid_inputs: GridInputs,
        inside: Rest,
        weights: Lattice,
        body: Surface,
        at: Chunk,
        bar: Adjoint,
        adj_inputs: ParticleInputsAdj,
        adj_grid_inputs: GridInputsAdj,
        first: int,
        last: int,
        anew: int,
    ):
        world, block, thread = wp.tid()
        own = number(block, thread)
        lane = thread % size
        for back in range(last - first):
            s = last - 1 - back
            if wp.static(contact):
                for i in range(own, inside.nodes.shape[0], blocks * threads):
                    settle_adj_at(world, i, constants, grid_inputs, inside, at, bar, adj_grid_inputs, s)
                meet_cluster()
                begins = wp.where(s == first, anew, 0)
                for p in range(own, body.points.shape[0], blocks * threads):
                    press_adj_at(world, p, constants, grid_inputs, body, at, bar, adj_grid_inputs, s, begins)
                meet_cluster()
                count = body.nodes.shape[0]
                for k in range(own, rounded(count * lanes), blocks * threads):
                    n = wp.min(k / lanes, count - 1)
                    turn = k - n * lanes
                    spread_adj_at(
                        world, n, turn, constants, grid_inputs, inside, body, at, bar, adj_grid_inputs, s
                    )
            else:
                for i in range(own, inside.nodes.shape[0], blocks * threads):
                    advance_adj_at(world, i, constants, grid_inputs, inside, at, bar, adj_grid_inputs, s)
            meet_cluster()
            for brick in range(block + blocks * (thread / size), inside.corners.shape[0], blocks * groups):
                if wp.static(lattice):
                    forces_adj_at(
                        world, brick, lane, constants, inputs, inside, weights, at, bar, adj_inputs, s
                    )
                else:
                    forces_adj_at(world, brick, lane, constants, inputs, inside, at, bar, adj_inputs, s)
            meet_cluster()

    return march_adj


@kernel_factory
def numbering(cluster: Cluster) -> SimpleNamespace:
    blocks, serial = cluster.blocks, cluster.bricks.serial

    @wp.func
    def number(block: int, thread: int) -> int:
        """Number of a thread in its cluster; warps take turns among the blocks."""
        if wp.static(serial):
            return 0
        else:
            return (thread / 32 * blocks + block) * 32 + thread % 32

    @wp.func
    def rounded(count: int) -> int:
        """Number of threads, in whole warps: those that sum together must all be there."""
        if wp.static(serial):
            return count
        else:
            return (count + 31) / 32 * 32

    return SimpleNamespace(number=number, rounded=rounded)
