"""Hash table of the cells that hold particles: for each of them a list of its particles and a box around their rest positions.

Cells are entered by atomic operations. The bucket of a cell and the order of its list are those of the threads; what is in them is not.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types

PRIMES = (73856093, 19349663, 83492791)
"""Of the hash of a cell (Teschner et al. 2003)."""
BITS = 21
"""Of a coordinate in the key of a cell: cells 2,097,152 apart count as one."""
EMPTY = -1


@kernel_factory
def cell_table(dim: int) -> SimpleNamespace:
    ivec, primes = types(dim, "float32").ivec, wp.types.vector(3, wp.uint32)(*PRIMES)
    low_bits, most = 2**BITS - 1, 2**31 - 1

    class Table:
        """More buckets than particles, a power of two, in each world."""

        keys: wp.array2d(dtype=wp.int64)
        head: wp.array2d(dtype=wp.int32)  # first place of the list
        low: wp.array3d(dtype=wp.int32)
        high: wp.array3d(dtype=wp.int32)
        following: wp.array2d(dtype=wp.int32)  # next place of the list, or -1

    Table = wp.struct(Table, module=f"softmpm.types.cell_table.d{dim}")

    @wp.func
    def key_of(cell: ivec) -> wp.int64:
        key = wp.int64(0)
        for axis in range(dim):
            key = (key << wp.int64(BITS)) | (wp.int64(cell[axis]) & wp.int64(low_bits))
        return key

    @wp.func
    def hash_of(cell: ivec, buckets: int) -> int:
        mixed = wp.uint32(0)
        for axis in range(dim):
            mixed = mixed ^ (wp.uint32(cell[axis]) * primes[axis])
        return int(mixed & wp.uint32(buckets - 1))

    @wp.func
    def find(table: Table, world: int, cell: ivec) -> int:
        """Bucket of a cell, or -1."""
        key = key_of(cell)
        bucket = hash_of(cell, table.keys.shape[1])
        while table.keys[world, bucket] != key:
            if table.keys[world, bucket] == wp.int64(EMPTY):
                return -1
            bucket = (bucket + 1) & (table.keys.shape[1] - 1)
        return bucket

    @wp.func
    def enter(table: Table, world: int, cell: ivec, p: int, ticks: ivec):
        """Put place p with these rest coordinates into the list of a cell."""
        key = key_of(cell)
        bucket = hash_of(cell, table.keys.shape[1])
        known = wp.atomic_cas(table.keys, world, bucket, wp.int64(EMPTY), key)
        while known != wp.int64(EMPTY) and known != key:
            bucket = (bucket + 1) & (table.keys.shape[1] - 1)
            known = wp.atomic_cas(table.keys, world, bucket, wp.int64(EMPTY), key)
        table.following[world, p] = wp.atomic_exch(table.head, world, bucket, p)
        for axis in range(dim):
            wp.atomic_min(table.low, world, bucket, axis, ticks[axis])
            wp.atomic_max(table.high, world, bucket, axis, ticks[axis])

    @wp.func
    def farthest(table: Table, world: int, bucket: int, ticks: ivec) -> int:
        """Largest distance along an axis from a place at rest to the others of a bucket."""
        found = int(0)
        for axis in range(dim):
            below = ticks[axis] - table.low[world, bucket, axis]
            found = wp.max(found, wp.max(below, table.high[world, bucket, axis] - ticks[axis]))
        return found

    @wp.func
    def clear(table: Table, world: int, bucket: int):
        table.keys[world, bucket] = wp.int64(EMPTY)
        table.head[world, bucket] = -1
        for axis in range(dim):
            table.low[world, bucket, axis] = most
            table.high[world, bucket, axis] = -most

    return SimpleNamespace(Table=Table, clear=clear, find=find, enter=enter, farthest=farthest)
