"""Sums over a particle's nodes, and packed particles, against plain sums and plain indexing in NumPy."""

import functools
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from softmpm.kernels.compile import kernel
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.gather_adj import stencil_adj
from softmpm.kernels.fast.native import BLOCK, NATIVE, WARP, native
from softmpm.kernels.structs import BASE_BITS, packed_rows, types

COUNT = 41  # particles: one full block of packed rows, and part of another
LIMIT = 1e-13


@functools.lru_cache(maxsize=None)
def kernels(dim: int, dtype: str) -> SimpleNamespace:
    """One kernel for each function that is tested."""
    t, s, n = types(dim, dtype), stencil(dim, dtype), native(dim, dtype)
    real, vec, mat, ivec, node_vec = t.real, t.vec, t.mat, t.ivec, t.aligned
    gather, scatter, back = s.gather, n.scatter, stencil_adj(dim, dtype)
    gather_adj, slope_adj = back.gather_adj, back.slope_adj
    first_node, coordinates, particle_of = s.first_node, s.coordinates, s.particle_of
    pack_base, unpack_base = s.pack_base, s.unpack_base
    load_node, store_node, aligned, head = n.load_node, n.store_node, s.aligned, s.head
    load_vec, load_mat, store_vec, store_mat = n.early.vector, n.early.matrix, n.store_vec, n.store_mat

    @kernel(NATIVE)
    def sums(
        node: wp.array(dtype=node_vec),
        first: wp.array(dtype=int),
        shape: ivec,
        g: wp.array(dtype=vec),
        value: wp.array(dtype=vec),
        outer: wp.array(dtype=mat),
    ):
        i = wp.tid()
        found = gather(node, first[i], shape, g[i])
        value[i] = found.value
        outer[i] = found.outer

    @kernel(NATIVE)
    def sums_adj(
        node: wp.array(dtype=node_vec),
        first: wp.array(dtype=int),
        shape: ivec,
        g: wp.array(dtype=vec),
        b: wp.array(dtype=vec),
        A: wp.array(dtype=mat),
        mu: wp.array(dtype=real),
        value: wp.array(dtype=vec),
        outer: wp.array(dtype=mat),
        mass: wp.array(dtype=real),
        slope: wp.array(dtype=vec),
        slope_alone: wp.array(dtype=vec),
    ):
        i = wp.tid()
        found = gather_adj(node, first[i], shape, g[i], b[i], A[i], mu[i])
        value[i] = found.value
        outer[i] = found.outer
        mass[i] = found.mass
        slope[i] = found.slope
        alone = slope_adj(node, first[i], shape, g[i], b[i], A[i], mu[i])
        slope_alone[i] = alone.slope

    @kernel(NATIVE, grid_stride=False)
    def spread(
        node: wp.array(dtype=node_vec),
        shape: ivec,
        per_warp: int,
        count: int,
        first: wp.array(dtype=int),
        g: wp.array(dtype=vec),
        b: wp.array(dtype=vec),
        A: wp.array(dtype=mat),
        m: wp.array(dtype=real),
    ):
        i = particle_of(wp.tid(), per_warp, count)
        p = wp.min(i, count - 1)
        at = wp.where(i < count, first[p], -1)
        scatter(node, shape, at, g[p], b[p], A[p], m[p])

    @kernel(NATIVE)
    def bases(base: wp.array(dtype=ivec), packed: wp.array(dtype=int), back: wp.array(dtype=ivec)):
        i = wp.tid()
        packed[i] = pack_base(base[i])
        back[i] = unpack_base(packed[i])

    @kernel(NATIVE)
    def nodes(
        origin: ivec,
        shape: ivec,
        index: wp.array(dtype=int),
        place: wp.array(dtype=ivec),
        back: wp.array(dtype=int),
        node: wp.array(dtype=node_vec),
        copy: wp.array(dtype=node_vec),
    ):
        i = wp.tid()
        place[i] = coordinates(index[i], shape) + origin
        back[i] = first_node(place[i], origin, shape)
        full = load_node(node, index[i])
        store_node(copy, index[i], aligned(head(full), full[dim]))

    @kernel(NATIVE)
    def store(
        row_v: int, row_m: int, v: wp.array(dtype=vec), m: wp.array(dtype=mat), packed: wp.array(dtype=real)
    ):
        i = wp.tid()
        store_vec(packed, i, row_v, v[i])
        store_mat(packed, i, row_m, m[i])

    @kernel(NATIVE)
    def load(
        row_v: int, row_m: int, packed: wp.array(dtype=real), v: wp.array(dtype=vec), m: wp.array(dtype=mat)
    ):
        i = wp.tid()
        v[i] = load_vec(packed, i, row_v)
        m[i] = load_mat(packed, i, row_m)

    return SimpleNamespace(
        types=t, sums=sums, sums_adj=sums_adj, spread=spread, bases=bases, nodes=nodes, store=store, load=load
    )


class Bench:
    """Random particles in a random grid, in NumPy, and what runs a kernel on them."""

    def __init__(self, dim: int, device: str, dtype: str = "float64"):
        wp.init()
        rng = np.random.default_rng(dim)
        self.dim, self.dtype, self.device, self.rng = dim, dtype, device, rng
        self.kernels, self.t = kernels(dim, dtype), types(dim, dtype)
        self.shape = np.array((7, 6, 8)[:dim])
        self.g = rng.uniform(-0.5, 0.5, (COUNT, dim))
        corners = np.array(list(itertools.product((-0.5, 0.0, np.nextafter(0.5, 0)), repeat=dim)))
        self.g[: len(corners)] = corners  # both ends of the interval, and the middle node itself
        few = np.append(
            np.full(dim - 1, 2), self.shape[-1] - 2
        )  # cells along each axis: many share one, or follow
        self.base = rng.integers(0, few, (COUNT, dim))
        self.base[0], self.base[1] = 0, self.shape - 3  # the corners of the grid
        self.base = self.base[np.lexsort(self.base.T[::-1])]
        self.first = np.ravel_multi_index(tuple(self.base.T), self.shape)
        self.b, self.A, self.m = (rng.standard_normal((COUNT, *tail)) for tail in ((dim,), (dim, dim), ()))
        self.node = rng.standard_normal((self.shape.prod(), 4))  # in 2D the fourth number must not matter

    def array(self, values, dtype) -> wp.array:
        kind = np.int32 if dtype in (wp.int32, self.t.ivec) else self.dtype
        return wp.array(np.ascontiguousarray(values, dtype=kind), dtype=dtype, device=self.device)

    def empty(self, *tail, dtype=None) -> wp.array:
        kind = dtype or {(): self.t.real, (self.dim,): self.t.vec, (self.dim, self.dim): self.t.mat}[tail]
        return wp.zeros(COUNT, dtype=kind, device=self.device)

    def launch(self, kernel, dim, *arguments) -> None:
        wp.launch(kernel, dim=dim, inputs=arguments, device=self.device, block_dim=BLOCK)

    def particles(self) -> list[wp.array]:
        t = self.t
        pairs = ((self.g, t.vec), (self.b, t.vec), (self.A, t.mat), (self.m, t.real))
        return [self.array(values, dtype) for values, dtype in pairs]

    def neighbours(self):
        """(particle, offset o from the middle node, index of the node, weight, its gradient) of every pair.

        The textbook's spline of the distance, N(d) = ¾ − d² within half a cell, ½ (3/2 − |d|)² beyond, and its derivative.
        """
        for p, o in itertools.product(range(COUNT), itertools.product((-1, 0, 1), repeat=self.dim)):
            o = np.array(o)
            d = self.g[p] - o  # particle minus node
            near = np.abs(d) <= 0.5
            n = np.where(near, 0.75 - d**2, 0.5 * (1.5 - np.abs(d)) ** 2)
            slope = np.where(near, -2 * d, -np.sign(d) * (1.5 - np.abs(d)))
            gradient = [slope[a] * np.prod(np.delete(n, a)) for a in range(self.dim)]
            index = np.ravel_multi_index(tuple(self.base[p] + o + 1), self.shape)
            yield p, o, index, np.prod(n), np.array(gradient)


def close(got: wp.array, want: np.ndarray, limit: float = LIMIT) -> None:
    assert np.abs(want).max() > 0, "the test sees nothing"
    error = np.abs(got.numpy() - want).max() / np.abs(want).max()
    assert error <= limit, f"{error:.1e}"


@pytest.fixture(params=[2, 3], ids=["2D", "3D"])
def bench(request, device):
    return Bench(request.param, device)


def test_gather(bench):
    """Σ w v and Σ w v oᵀ (A4)."""
    value, outer = np.zeros((COUNT, bench.dim)), np.zeros((COUNT, bench.dim, bench.dim))
    for p, o, index, w, _ in bench.neighbours():
        v = bench.node[index, : bench.dim]
        value[p] += w * v
        outer[p] += w * np.outer(v, o)
    got = bench.empty(bench.dim), bench.empty(bench.dim, bench.dim)
    first, shape = bench.array(bench.first, wp.int32), bench.t.ivec(*bench.shape)
    node = bench.array(bench.node, bench.t.aligned)
    bench.launch(bench.kernels.sums, COUNT, node, first, shape, bench.particles()[0], *got)
    close(got[0], value)
    close(got[1], outer)


def test_gather_adj_and_slope_adj(bench):
    """Σ w p̄, Σ w p̄ oᵀ, Σ w m̄ and Σ (p̄·(b + A o) + μ m̄) ∇w (A5); the slope alone takes no m̄."""
    dim, mu = bench.dim, bench.m
    value, outer, mass = np.zeros((COUNT, dim)), np.zeros((COUNT, dim, dim)), np.zeros(COUNT)
    slope, slope_alone = np.zeros((COUNT, dim)), np.zeros((COUNT, dim))
    for p, o, index, w, gradient in bench.neighbours():
        v, m = bench.node[index, :dim], bench.node[index, dim]
        meets = v @ (bench.b[p] + bench.A[p] @ o)
        value[p] += w * v
        outer[p] += w * np.outer(v, o)
        mass[p] += w * m
        slope[p] += (meets + mu[p] * m) * gradient
        slope_alone[p] += meets * gradient
    tails = ((dim,), (dim, dim), (), (dim,), (dim,))
    got = [bench.empty(*tail) for tail in tails]
    first, shape = bench.array(bench.first, wp.int32), bench.t.ivec(*bench.shape)
    node = bench.array(bench.node, bench.t.aligned)
    bench.launch(bench.kernels.sums_adj, COUNT, node, first, shape, *bench.particles(), *got)
    for found, want in zip(got, (value, outer, mass, slope, slope_alone), strict=True):
        close(found, want)


def spread(bench) -> np.ndarray:
    """(A1) of every particle."""
    want = np.zeros_like(bench.node)
    for p, o, index, w, _ in bench.neighbours():
        want[index, : bench.dim] += w * (bench.b[p] + bench.A[p] @ o)
        want[index, bench.dim] += w * bench.m[p]
    return want


@pytest.mark.parametrize("dtype, limit", [("float64", LIMIT), ("float32", 1e-6)])
@pytest.mark.parametrize("per_warp", [WARP, 16, 7])
@pytest.mark.parametrize("dim", [2, 3])
def test_scatter(dim, per_warp, dtype, limit, device):
    """w (b + A o, m) of every particle on each of its nodes (A1), added to what is there; lanes without a particle give none."""
    bench = Bench(dim, device, dtype)
    if dtype == "float32":  # what is compared is what was given
        for name in ("g", "b", "A", "m"):
            setattr(bench, name, getattr(bench, name).astype(dtype).astype(float))
    there = np.arange(bench.node.size).reshape(bench.node.shape) / bench.node.size
    node, t = bench.array(there, bench.t.aligned), bench.t
    first, shape = bench.array(bench.first, wp.int32), t.ivec(*bench.shape)
    threads = -(-COUNT // per_warp) * WARP
    bench.launch(bench.kernels.spread, threads, node, shape, per_warp, COUNT, first, *bench.particles())
    close(node, there + spread(bench), limit)


@pytest.mark.parametrize("dim", [2, 3])
def test_scatter_keeps_mass_and_momentum(dim, device):
    """Summed over the nodes: Σ m and Σ (b + A g), since Σ w = 1 and Σ w o = g."""
    bench = Bench(dim, device)
    node, t = bench.array(0 * bench.node, bench.t.aligned), bench.t
    first, shape = bench.array(bench.first, wp.int32), t.ivec(*bench.shape)
    bench.launch(bench.kernels.spread, BLOCK, node, shape, WARP, COUNT, first, *bench.particles())
    total = node.numpy().sum(0)
    np.testing.assert_allclose(total[dim], bench.m.sum(), rtol=0, atol=LIMIT * COUNT)
    momentum = (bench.b + np.einsum("pij,pj->pi", bench.A, bench.g)).sum(0)
    np.testing.assert_allclose(total[:dim], momentum, rtol=0, atol=LIMIT * COUNT)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("dim", [2, 3])
def test_scatter_gains_nothing_by_rounding(dim, axis, device):
    """In float32, of one particle that lies anywhere along an axis: Σ m and Σ m o are exact."""
    bench, axis = Bench(dim, device, "float32"), axis % dim
    bench.g[:] = -0.5  # there the weights are 1/2, 1/2 and 0: products with them are exact
    bench.g[:, axis] = (
        bench.rng.uniform(0.5, 1.5, COUNT).astype(np.float32).astype(float) - 1
    )  # as the kernels have it
    first, shape = bench.array(bench.first, wp.int32), bench.t.ivec(*bench.shape)
    for p in range(COUNT):
        bench.b, bench.A, bench.m = 0 * bench.b, 0 * bench.A, (np.arange(COUNT) == p).astype(float)
        node = bench.array(0 * bench.node, bench.t.aligned)
        bench.launch(bench.kernels.spread, 2 * WARP, node, shape, WARP, COUNT, first, *bench.particles())
        mass = node.numpy()[:, dim].astype(float)
        place = np.unravel_index(np.arange(len(mass)), bench.shape)[axis] - bench.base[p, axis] - 1
        assert mass.sum() == 1.0
        assert (mass * place).sum() == np.float32(bench.g[p, axis])


@pytest.mark.parametrize("dim", [2, 3])
def test_a_base_is_packed_and_unpacked(dim, device):
    """Every axis alone and together, from the first node to the last base that a grid of 2^bits nodes has; all distinct."""
    bench, last = Bench(dim, device), 2 ** BASE_BITS[dim] - 3
    each = (0, 1, 2 ** (BASE_BITS[dim] - 1) - 1, 2 ** (BASE_BITS[dim] - 1), last)
    base = np.array(list(itertools.product(each, repeat=dim)), dtype=np.int32)
    packed = wp.zeros(len(base), dtype=wp.int32, device=device)
    back = wp.zeros(len(base), dtype=bench.t.ivec, device=device)
    bench.launch(bench.kernels.bases, len(base), bench.array(base, bench.t.ivec), packed, back)
    wrong = base[(back.numpy() != base).any(1)]
    assert len(wrong) == 0, f"{len(wrong)} bases come back changed, the first is {wrong[0]}"
    assert len(np.unique(packed.numpy())) == len(base)


def test_nodes_are_numbered_along_the_last_axis(bench):
    """Number → coordinates in the window → number; a node's vector and last number are what was stored."""
    dim, count = bench.dim, int(bench.shape.prod())
    origin, shape = np.array((5, 3, 9)[:dim]), bench.t.ivec(*bench.shape)
    node, copy = bench.array(bench.node, bench.t.aligned), bench.array(0 * bench.node, bench.t.aligned)
    place = wp.zeros(count, dtype=bench.t.ivec, device=bench.device)
    back = wp.zeros(count, dtype=wp.int32, device=bench.device)
    index = bench.array(np.arange(count), wp.int32)
    bench.launch(bench.kernels.nodes, count, bench.t.ivec(*origin), shape, index, place, back, node, copy)
    want = np.stack(np.unravel_index(np.arange(count), bench.shape), -1) + origin
    assert np.array_equal(place.numpy(), want)
    assert np.array_equal(back.numpy(), np.arange(count))
    expected = bench.node.copy()
    expected[:, dim + 1 :] = 0.0
    assert np.array_equal(copy.numpy(), expected)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("dim", [2, 3])
def test_rows_come_back(dim, dtype, device):
    """A row of 32 particles after the other in each block; nothing else is touched, and what was stored is loaded."""
    bench, t, layout = Bench(dim, device, dtype), types(dim, dtype), packed_rows(dim)
    values = bench.b.astype(dtype), bench.A.astype(dtype)
    blocks = -(-COUNT // 32)
    packed = wp.full(blocks * 32 * layout.rows, 7.0, dtype=t.real, device=device)
    given = bench.array(values[0], t.vec), bench.array(values[1], t.mat)
    bench.launch(bench.kernels.store, COUNT, layout.row_v, layout.row_c, *given, packed)
    expected = np.full((blocks, layout.rows, 32), 7.0, dtype=dtype)
    for i in range(COUNT):
        block, lane = divmod(i, 32)
        expected[block, layout.row_v : layout.row_v + dim, lane] = values[0][i]
        expected[block, layout.row_c : layout.row_c + dim * dim, lane] = values[1][i].ravel()
    assert np.array_equal(packed.numpy().reshape(expected.shape), expected)
    back = bench.empty(dim), bench.empty(dim, dim)
    bench.launch(bench.kernels.load, COUNT, layout.row_v, layout.row_c, packed, *back)
    assert np.array_equal(back[0].numpy(), values[0])
    assert np.array_equal(back[1].numpy(), values[1])


def test_the_rows_do_not_overlap():
    """Every quantity has rows of its own, and the last one ends with the rows."""
    for dim in (2, 3):
        rows = packed_rows(dim)
        starts = (rows.row_fx, rows.row_low, rows.row_v, rows.row_h, rows.row_c, rows.rows)
        assert np.diff(starts).tolist() == [dim, dim, dim, dim * dim, dim * dim]
