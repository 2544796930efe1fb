"""Masses, displacements and velocities of the nodes from the sums of the bricks around them. Equations: projection.py; derivation:
docs/math/lagrangian.md.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.lagrangian.portions import end_of, first_of
from softmpm.kernels.lagrangian.rest import LAGRANGIAN, rest
from softmpm.kernels.lagrangian.rows import rows
from softmpm.kernels.structs import types


@kernel_factory
def gathering(dim: int, dtype: str) -> SimpleNamespace:
    vec, Rest, most = types(dim, dtype).vec, rest(dim, dtype).Rest, 2**dim
    Entries = wp.types.vector(most, wp.int32)

    @wp.func
    def entries_of(inside: Rest, i: int) -> Entries:
        """Places of the partial sums for a node, or -1."""
        out = Entries()
        for n in range(most):
            out[n] = inside.shares[n, i]
        return out

    @wp.func
    def gathered(partial: wp.array(dtype=vec), entries: Entries) -> vec:
        """Sum of what the bricks around a node have for it, in a fixed order. Loads without branches wait for memory together."""
        total = vec()
        for n in range(most):
            share = partial[wp.max(entries[n], 0)]
            if entries[n] >= 0:
                total += share
        return total

    return SimpleNamespace(Entries=Entries, entries_of=entries_of, gathered=gathered)


@kernel_factory
def node_sums(dim: int, dtype: str) -> SimpleNamespace:
    t, Rest, one = types(dim, dtype), rest(dim, dtype).Rest, gathering(dim, dtype)
    real, vec, entries_of, gathered = t.real, t.vec, one.entries_of, one.gathered
    row = rows(dim, dtype)

    @kernel(LAGRANGIAN)
    def mass(inside: Rest, partial: wp.array2d(dtype=vec), out: wp.array2d(dtype=real)):
        """(Q2)"""
        world, k = wp.tid()
        for i in range(first_of(k), end_of(k, inside.nodes.shape[0])):
            out[world, i] = gathered(row(partial, world), entries_of(inside, i))[0]

    @kernel(LAGRANGIAN)
    def fields(
        inside: Rest,
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
    ):
        """(Q5.adj)"""
        world, k = wp.tid()
        for i in range(first_of(k), end_of(k, inside.nodes.shape[0])):
            entries = entries_of(inside, i)
            u[world, i] = gathered(row(partial_u, world), entries)
            v[world, i] = gathered(row(partial_v, world), entries)

    @kernel(LAGRANGIAN)
    def means(
        inside: Rest,
        mass: wp.array2d(dtype=real),
        partial_u: wp.array2d(dtype=vec),
        partial_v: wp.array2d(dtype=vec),
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
    ):
        """(Q6); nodes at the very edge of a spline have no mass."""
        world, k = wp.tid()
        for i in range(first_of(k), end_of(k, inside.nodes.shape[0])):
            m = mass[world, i]
            entries = entries_of(inside, i)
            if m > real(0.0):
                u[world, i] = gathered(row(partial_u, world), entries) / m
                v[world, i] = gathered(row(partial_v, world), entries) / m
            else:
                u[world, i] = vec()
                v[world, i] = vec()

    @kernel(LAGRANGIAN)
    def means_adj(
        mass: wp.array2d(dtype=real),
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        # In and out:
        adj_u: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        # Out:
        adj_mass: wp.array2d(dtype=real),
    ):
        """ũ, ṽ and the last term of the mass in (Q6.adj)"""
        world, k = wp.tid()
        for i in range(first_of(k), end_of(k, mass.shape[1])):
            m = mass[world, i]
            each_u = vec()
            each_v = vec()
            if m > real(0.0):
                each_u = adj_u[world, i] / m
                each_v = adj_v[world, i] / m
            adj_u[world, i] = each_u
            adj_v[world, i] = each_v
            adj_mass[world, i] = -wp.dot(each_u, u[world, i]) - wp.dot(each_v, v[world, i])

    return SimpleNamespace(mass=mass, fields=fields, means=means, means_adj=means_adj)
