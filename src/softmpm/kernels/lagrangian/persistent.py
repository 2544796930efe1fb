"""Kernels that take all substeps of a control step in one launch, for small scenes on a GPU.

A cluster of blocks has a world; its multiprocessors wait for each other by a barrier of the hardware where the other form would begin
a launch. The stages are the functions of the kernels of single launches: results are the same to the last bit.

Groups of threads of a block have a brick each. On the CPU, for tests, one thread does everything.
"""

from typing import NamedTuple

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks, brick_module, meet_cluster
from softmpm.kernels.lagrangian.cells import cells, cells_adj
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.lattice import lattice_cells, lattice_cells_adj, layers
from softmpm.kernels.lagrangian.nodes import nodes, nodes_adj
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.lagrangian.surface import surface, surface_type
from softmpm.kernels.lagrangian.surface_adj import surface_adj
from softmpm.kernels.structs import RequestedGrads, Spec, adj_module, input_adj_types, input_types, types


class Cluster(NamedTuple):
    """Threads that have a world."""

    bricks: Bricks
    blocks: int
    """Blocks of the cluster."""
    groups: int
    """Bricks that a block has at a time."""

    @property
    def group_threads(self) -> int:
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
def arrays_type(dim: int, dtype: str):
    t, exact_vec = types(dim, dtype), types(dim, "float64").vec

    class Arrays:
        """See :class:`softmpm.schemes.lagrangian.buffers.ChunkBuffers`; the first axis of states counts substeps."""

        shift: wp.array2d(dtype=exact_vec)
        u: wp.array3d(dtype=t.vec)
        v: wp.array3d(dtype=t.vec)
        p: wp.array3d(dtype=t.vec)
        anchor: wp.array4d(dtype=t.vec)
        mass: wp.array2d(dtype=t.real)
        partial: wp.array2d(dtype=t.vec)
        words: wp.array(dtype=wp.int64)
        free: wp.array2d(dtype=t.vec)
        force: wp.array3d(dtype=t.vec)
        impulse: wp.array2d(dtype=t.vec)
        D: wp.array2d(dtype=t.real)
        rate: wp.array(dtype=t.real)

    class ArraysAdj:
        """See :class:`softmpm.schemes.lagrangian.buffers.SharedAdjoint`."""

        u: wp.array2d(dtype=t.vec)
        v: wp.array2d(dtype=t.vec)
        f: wp.array2d(dtype=t.vec)
        mass: wp.array2d(dtype=t.real)
        partial_u: wp.array2d(dtype=t.vec)
        partial_v: wp.array2d(dtype=t.vec)
        anchor: wp.array3d(dtype=t.vec)
        force: wp.array3d(dtype=t.vec)
        shared: wp.array2d(dtype=t.vec)
        x: wp.array2d(dtype=t.vec)
        free: wp.array2d(dtype=t.vec)
        D: wp.array2d(dtype=t.real)

    module = f"softmpm.types.d{dim}.{dtype}"
    return wp.struct(Arrays, module=module), wp.struct(ArraysAdj, module=module)


@kernel_factory
def march(spec: Spec, cluster: Cluster) -> wp.Kernel:
    t, bricks, Rest = types(spec.dim, spec.dtype), cluster.bricks, rest(spec.dim, spec.dtype).Rest
    Constants, Frame, Arrays = (
        t.Constants,
        frame(spec.dim, spec.dtype).Frame,
        arrays_type(spec.dim, spec.dtype)[0],
    )
    real, given, Surface = t.real, input_types(spec), surface_type(spec.dim, spec.dtype)
    ParticleInputs, GridInputs = given.ParticleInputs, given.GridInputs
    Lattice, lattice = layers(spec.dim, spec.dtype, bricks).Lattice, bricks.lattice
    forces_at = lattice_cells(spec, bricks).forces_at if lattice else cells(spec, bricks).forces_at
    advance_at, contact = nodes(spec).advance_at, bool(spec.surface_walls)
    press_at = settle_at = None
    if contact:
        press_at, settle_at = surface(spec).press_at, surface(spec).settle_at
    T, groups, blocks, threads = cluster.group_threads, cluster.groups, cluster.blocks, cluster.threads
    number = each_of(cluster)
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
        smoothing: real,
        lanes: int,
        a: Arrays,
        keep: bool,
        first: int,
        last: int,
        anew: int,  # 1 if a control step begins with the first substep, but not with the first one of the chunk
    ):
        world, block, thread = wp.tid()
        each = number(block, thread)
        for s in range(first, last):
            now = wp.where(keep, s, s % 2)
            then = wp.where(keep, s + 1, (s + 1) % 2)
            u = a.u[now]
            v = a.v[now]
            for brick in range(block + blocks * (thread / T), inside.corners.shape[0], blocks * groups):
                if wp.static(lattice):
                    forces_at(
                        world,
                        brick,
                        thread % T,
                        constants,
                        inputs,
                        inside,
                        weights,
                        s,
                        u,
                        v,
                        a.words,
                        a.partial,
                    )
                else:
                    forces_at(
                        world, brick, thread % T, constants, inputs, inside, s, u, v, a.words, a.partial
                    )
            meet_cluster()
            p = a.p[wp.where(keep, s, 0)]
            new_u = a.u[then]
            new_v = a.v[then]
            shift = a.shift[now]
            new_shift = a.shift[then]
            for i in range(each, inside.nodes.shape[0], blocks * threads):
                if wp.static(contact):
                    advance_at(
                        world,
                        i,
                        constants,
                        grid_inputs,
                        inside,
                        moving,
                        a.mass,
                        a.partial,
                        a.words,
                        shift,
                        u,
                        v,
                        p,
                        a.free,
                        new_shift,
                        new_u,
                        new_v,
                    )
                else:
                    advance_at(
                        world,
                        i,
                        constants,
                        grid_inputs,
                        inside,
                        moving,
                        a.mass,
                        a.partial,
                        a.words,
                        shift,
                        u,
                        v,
                        p,
                        new_v,
                        new_shift,
                        new_u,
                        new_v,
                    )
            meet_cluster()
            if wp.static(contact):
                anchor = a.anchor[now]
                new_anchor = a.anchor[then]
                begins = wp.where(s == first, anew, 0)
                for k in range(each, body.points.shape[0], blocks * threads):
                    press_at(
                        world,
                        k,
                        constants,
                        grid_inputs,
                        body,
                        moving,
                        smoothing,
                        a.D,
                        s,
                        a.rate,
                        begins,
                        shift,
                        u,
                        a.free,
                        anchor,
                        a.words,
                        a.force,
                        a.impulse,
                        new_anchor,
                    )
                meet_cluster()
                for n in range(each, body.nodes.shape[0] * lanes, blocks * threads):
                    settle_at(
                        world,
                        n / lanes,
                        n % lanes,
                        constants,
                        body,
                        moving,
                        a.mass,
                        lanes,
                        a.impulse,
                        a.words,
                        u,
                        v,
                        a.free,
                        new_u,
                        new_v,
                    )
                meet_cluster()

    return march


@kernel_factory
def march_adj(spec: Spec, wanted: RequestedGrads, cluster: Cluster) -> wp.Kernel:
    t, bricks, Rest = types(spec.dim, spec.dtype), cluster.bricks, rest(spec.dim, spec.dtype).Rest
    Constants, (Arrays, ArraysAdj) = t.Constants, arrays_type(spec.dim, spec.dtype)
    real, given, Surface = t.real, input_types(spec), surface_type(spec.dim, spec.dtype)
    ParticleInputs, GridInputs = given.ParticleInputs, given.GridInputs
    adjoints = input_adj_types(spec, wanted)
    ParticleInputsAdj, GridInputsAdj = adjoints.ParticleInputsAdj, adjoints.GridInputsAdj
    Lattice, lattice = layers(spec.dim, spec.dtype, bricks).Lattice, bricks.lattice
    of_cells = lattice_cells_adj(spec, wanted, bricks) if lattice else cells_adj(spec, wanted, bricks)
    forces_adj_at, advance_adj_at = of_cells.forces_adj_at, nodes_adj(spec, wanted).advance_adj_at
    contact = bool(spec.surface_walls)
    settle_adj_at = press_adj_at = spread_adj_at = None
    if contact:
        one = surface_adj(spec, wanted)
        settle_adj_at, press_adj_at, spread_adj_at = one.settle_adj_at, one.press_adj_at, one.spread_adj_at
    T, groups, blocks, threads = cluster.group_threads, cluster.groups, cluster.blocks, cluster.threads
    number = each_of(cluster)
    module = brick_module(f"{adj_module(spec, wanted)}.lagrangian.{cluster.name}", groups)

    @wp.kernel(module=module, **cluster.settings)
    def march_adj(
        constants: Constants,
        inputs: ParticleInputs,
        grid_inputs: GridInputs,
        inside: Rest,
        weights: Lattice,
        body: Surface,
        smoothing: real,
        lanes: int,
        held: int,  # accumulators of one world
        a: Arrays,
        b: ArraysAdj,
        adj_inputs: ParticleInputsAdj,
        adj_grid_inputs: GridInputsAdj,
        length: int,  # of the chunk
        first: int,
        last: int,
        anew: int,  # as in the forward pass
    ):
        world, block, thread = wp.tid()
        each = number(block, thread)
        for back in range(last - first):
            s = last - 1 - back
            u = a.u[s]
            v = a.v[s]
            p = a.p[s]
            shift = a.shift[s]
            pending = s < length - 1
            if wp.static(contact):
                new_v = a.v[s + 1]
                for i in range(each, inside.nodes.shape[0], blocks * threads):
                    settle_adj_at(
                        world,
                        i,
                        constants,
                        grid_inputs,
                        inside,
                        a.mass,
                        held,
                        shift,
                        u,
                        v,
                        p,
                        new_v,
                        pending,
                        b.partial_u,
                        b.partial_v,
                        b.u,
                        b.v,
                        a.free,
                        b.shared,
                        b.f,
                        b.mass,
                        adj_grid_inputs,
                    )
                meet_cluster()
                anchor = a.anchor[s]
                begins = wp.where(s == first, anew, 0)
                for k in range(each, body.points.shape[0], blocks * threads):
                    press_adj_at(
                        world,
                        k,
                        constants,
                        grid_inputs,
                        body,
                        smoothing,
                        a.D,
                        held,
                        a.rate,
                        begins,
                        shift,
                        u,
                        a.free,
                        anchor,
                        b.shared,
                        b.force,
                        b.anchor,
                        b.x,
                        b.free,
                        b.D,
                        adj_grid_inputs,
                    )
                meet_cluster()
                for n in range(each, body.nodes.shape[0] * lanes, blocks * threads):
                    spread_adj_at(
                        world,
                        n / lanes,
                        n % lanes,
                        constants,
                        grid_inputs,
                        inside,
                        body,
                        a.mass,
                        held,
                        lanes,
                        shift,
                        u,
                        v,
                        p,
                        b.x,
                        b.free,
                        b.u,
                        b.v,
                        b.f,
                        b.mass,
                        adj_grid_inputs,
                    )
            else:
                for i in range(each, inside.nodes.shape[0], blocks * threads):
                    advance_adj_at(
                        world,
                        i,
                        constants,
                        grid_inputs,
                        inside,
                        a.mass,
                        held,
                        shift,
                        u,
                        v,
                        p,
                        pending,
                        b.partial_u,
                        b.partial_v,
                        b.u,
                        b.v,
                        b.f,
                        b.mass,
                        adj_grid_inputs,
                    )
            meet_cluster()
            for brick in range(block + blocks * (thread / T), inside.corners.shape[0], blocks * groups):
                if wp.static(lattice):
                    forces_adj_at(
                        world,
                        brick,
                        thread % T,
                        constants,
                        inputs,
                        inside,
                        weights,
                        length - 1 - s,
                        u,
                        v,
                        b.f,
                        a.words,
                        adj_inputs,
                        b.partial_u,
                        b.partial_v,
                    )
                else:
                    forces_adj_at(
                        world,
                        brick,
                        thread % T,
                        constants,
                        inputs,
                        inside,
                        length - 1 - s,
                        u,
                        v,
                        b.f,
                        a.words,
                        adj_inputs,
                        b.partial_u,
                        b.partial_v,
                    )
            meet_cluster()

    return march_adj


@kernel_factory
def each_of(cluster: Cluster):
    blocks, serial = cluster.blocks, cluster.bricks.serial

    @wp.func
    def number(block: int, thread: int) -> int:
        """Number of a thread in its cluster; neighbouring warps are in different blocks."""
        if wp.static(serial):
            return 0
        else:
            return (thread / 32 * blocks + block) * 32 + thread % 32

    return number
