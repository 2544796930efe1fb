"""Cluster of blocks of threads that has a world, and what each thread of it holds from one substep to the next.

After a barrier of the cluster a multiprocessor has forgotten what it has read, and loads go to the cache that all share. What is the
same in all substeps is therefore read once.
"""

from types import SimpleNamespace
from typing import NamedTuple

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.bricks import Bricks
from softmpm.kernels.lagrangian.layers import lattice_seats
from softmpm.kernels.lagrangian.nodes import nodes
from softmpm.kernels.lagrangian.rest import rest
from softmpm.kernels.lagrangian.seats import seats
from softmpm.kernels.lagrangian.surface_sums import LANES, surface_sums, surface_type
from softmpm.kernels.structs import Spec, input_types, types


class Cluster(NamedTuple):
    """Blocks of threads that have a world."""

    bricks: Bricks
    blocks: int
    groups: int
    """Groups of threads in a block; each has a brick."""
    alone: bool = False
    """True if no thread has more than one brick, node, surface point and touched node: no code is needed to read others."""

    @property
    def group_threads(self) -> int:
        """Threads of a group."""
        return self.bricks.layer_threads if self.bricks.lattice else self.bricks.threads

    @property
    def threads(self) -> int:
        """Of a block."""
        return self.groups * self.group_threads

    @property
    def roomy(self) -> bool:
        """True if threads have registers enough to keep a surface point from one substep to the next."""
        return self.threads <= 256

    @property
    def lanes(self) -> int:
        """Threads of a node that surface points act on."""
        return 1 if self.bricks.serial else LANES

    @property
    def settings(self) -> dict:
        """Of the kernels."""
        bounds = dict(grid_stride=False, launch_bounds=(self.threads, 1))
        return bounds if self.bricks.serial else bounds | dict(cluster_dim=self.blocks)


@kernel_factory
def numbering(cluster: Cluster) -> SimpleNamespace:
    blocks, serial, alone = cluster.blocks, cluster.bricks.serial, cluster.alone

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

    @wp.func
    def following(i: int, stride: int, count: int) -> int:
        """Brick, node or point of a thread after ``i``; ``count`` if it has no other."""
        if wp.static(alone):
            return count
        else:
            return i + stride

    return SimpleNamespace(number=number, rounded=rounded, following=following)


@kernel_factory
def holdings(spec: Spec, cluster: Cluster) -> SimpleNamespace:
    """Each thread holds the first of its bricks, nodes, points and touched nodes, which is mostly the only one, and rereads others."""
    t = types(spec.dim, spec.dtype)
    r = rest(spec.dim, spec.dtype)
    bricks = cluster.bricks
    contact = bool(spec.surface_walls)
    real, Constants, Rest, ParticleInputs = t.real, t.Constants, r.Rest, input_types(spec).ParticleInputs
    seat = lattice_seats(spec, bricks) if bricks.lattice else seats(spec, bricks)
    Seat, seat_of, Node, node_of = seat.Seat, seat.seat_of, nodes(spec).Node, nodes(spec).node_of
    Surface = surface_type(spec.dim, spec.dtype)
    sums = surface_sums(spec.dim, spec.dtype)
    lanes = cluster.lanes
    Point, point_of, Touched, touched_of = sums.Point, sums.point_of, sums.Touched, sums.touched_of
    number, size, blocks = numbering(cluster).number, cluster.group_threads, cluster.blocks
    roomy, alone = cluster.roomy, cluster.alone

    class Held:
        number: int  # of the thread
        brick: int
        seat: Seat
        node: Node

    if contact:
        Held.__annotations__ |= {"point": Point, "entry": Touched, "touched": Node}
    Held = wp.struct(Held)

    @wp.func
    def held_by(
        block: int,
        thread: int,
        constants: Constants,
        inputs: ParticleInputs,
        inside: Rest,
        body: Surface,
        mass: wp.array2d(dtype=real),
        world: int,
    ) -> Held:
        out = Held()
        out.number = number(block, thread)
        out.brick = block + blocks * (thread / size)
        brick = wp.min(out.brick, inside.corners.shape[0] - 1)
        out.seat = seat_of(inside, inputs, world, brick, thread % size)
        out.node = node_of(constants, inside, mass, world, wp.min(out.number, inside.nodes.shape[0] - 1))
        if wp.static(contact):
            n = wp.min(out.number / lanes, body.nodes.shape[0] - 1)
            out.entry = touched_of(body, n, out.number - n * lanes)
            out.touched = node_of(constants, inside, mass, world, out.entry.i)
            out.point = point_of(body, wp.min(out.number, body.points.shape[0] - 1))
        return out

    @wp.func
    def seat_at(held: Held, inputs: ParticleInputs, inside: Rest, world: int, brick: int, lane: int) -> Seat:
        seat = held.seat
        if wp.static(not alone):
            if brick > held.brick:
                seat = seat_of(inside, inputs, world, brick, lane)
        return seat

    @wp.func
    def node_at(
        held: Held, constants: Constants, inside: Rest, mass: wp.array2d(dtype=real), world: int, i: int
    ) -> Node:
        node = held.node
        if wp.static(not alone):
            if i > held.number:
                node = node_of(constants, inside, mass, world, i)
        return node

    @wp.func
    def point_at(held: Held, body: Surface, p: int) -> Point:
        if wp.static(roomy):
            point = held.point
            if wp.static(not alone):
                if p > held.number:
                    point = point_of(body, p)
            return point
        else:
            return point_of(body, p)

    @wp.func
    def entry_at(held: Held, body: Surface, k: int, n: int) -> Touched:
        """Touched node ``n``, as the thread sees it that is number ``k`` of theirs."""
        entry = held.entry
        if wp.static(not alone):
            if k > held.number:
                entry = touched_of(body, n, k - n * lanes)
        return entry

    @wp.func
    def touched_at(
        held: Held,
        constants: Constants,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        world: int,
        k: int,
        i: int,
    ) -> Node:
        node = held.touched
        if wp.static(not alone):
            if k > held.number:
                node = node_of(constants, inside, mass, world, i)
        return node

    found = SimpleNamespace(held_by=held_by, seat_at=seat_at, node_at=node_at)
    if contact:
        found.point_at, found.entry_at, found.touched_at = point_at, entry_at, touched_at
    return found
