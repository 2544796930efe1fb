"""Sums over particles by slabs of nodes, against sums with B-spline weights in NumPy, particle by particle."""

import functools
import itertools

import numpy as np
import pytest
import warp as wp

from softmpm.kernels.compile import kernel
from softmpm.kernels.fast.native import NATIVE, WARP, padded
from softmpm.kernels.fast.slabs import LINE, WIDTH, slabs
from softmpm.kernels.structs import packed_rows, types

WORLDS, COUNT = 2, 75  # the third block of packed particles is of both worlds
LIMITS = {"float32": 1e-6, "float64": 1e-14}


@functools.lru_cache(maxsize=None)
def giver(dim: int, dtype: str) -> wp.Kernel:
    """Kernel that stores the contributions of all particles."""
    t, one = types(dim, dtype), slabs(dim, dtype)
    give, Shares = one.give, one.Shares

    @kernel(NATIVE)
    def store(plane: wp.array(dtype=int), b: wp.array(dtype=t.vec), A: wp.array(dtype=t.mat), shares: Shares):
        i = wp.tid()
        give(shares, i, plane[i], b[i], A[i])

    return store


def spline(r: np.ndarray) -> np.ndarray:
    """Quadratic B-spline at a distance in cells."""
    r = np.abs(r)
    return np.where(r < 0.5, 0.75 - r**2, np.where(r < 1.5, 0.5 * (1.5 - r) ** 2, 0.0))


def expected(shape, base, fx, b, A, m) -> np.ndarray:
    """Σ w (b + A o, m) with o counted from the middle node, at all nodes of each world."""
    dim = len(shape)
    nodes = np.zeros((WORLDS, *shape, dim + 1))
    for i, world in enumerate(np.repeat(np.arange(WORLDS), COUNT)):
        for o in itertools.product(range(3), repeat=dim):
            w = np.prod(spline(np.array(o) - fx[i]))
            nodes[world][tuple(base[i] + o)] += w * np.append(b[i] + A[i] @ (np.array(o) - 1.0), m[i])
    return nodes.reshape(-1, dim + 1)


@pytest.mark.parametrize("order", ["sorted", "stale", "random"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("dim", [2, 3])
def test_slabs_add_up_all_contributions(dim, dtype, order):
    rng, shape = np.random.default_rng(dim), (3 * WIDTH + 2, 7, 6)[:dim]
    total, t, rows = WORLDS * COUNT, types(dim, dtype), packed_rows(dim)
    base = rng.integers(0, np.array(shape) - 2, (WORLDS, COUNT, dim))
    if order != "random":
        base = np.take_along_axis(base, base[..., :1].argsort(axis=1), axis=1)
    if order == "stale":
        base[..., 0] = np.clip(base[..., 0] + rng.integers(-2, 3, (WORLDS, COUNT)), 0, shape[0] - 3)
    base = base.reshape(total, dim)
    fx, b = rng.uniform(0.5, 1.5, (total, dim)), rng.normal(size=(total, dim))
    A, m = rng.normal(size=(total, dim, dim)), rng.uniform(1.0, 2.0, total)
    origin = np.array([[1, 4, 2], [5, 0, 3]])[:, :dim]

    def array(values, kind=t.real) -> wp.array:
        return wp.array(values, dtype=kind, device="cpu")

    one, states, shares, window = slabs(dim, dtype), t.Packed(), slabs(dim, dtype).Shares(), t.Window()
    numbers = np.zeros((padded(total) // WARP, rows.rows, WARP))
    places = np.arange(total)
    for axis in range(dim):
        numbers[places // WARP, rows.row_fx + axis, places % WARP] = fx[:, axis]
    bits = {2: (0, 16), 3: (0, 10, 20)}[dim]
    global_base = base + np.repeat(origin, COUNT, axis=0)
    states.base = array(sum(global_base[:, axis] << bits[axis] for axis in range(dim)), wp.int32)
    states.rows, shares.rows = array(numbers.ravel()), array(np.full(numbers.size, np.nan))
    shares.ends = array(np.full(LINE * padded(total) // WARP, 10**6), wp.int32)
    window.shape, window.count, window.origin = t.ivec(*shape), int(np.prod(shape)), array(origin, t.ivec)
    given = array(base[:, 0], int), array(b, t.vec), array(A, t.mat)
    wp.launch(giver(dim, dtype), total, (*given, shares), device="cpu")
    found = []
    for mass in (array(m.reshape(WORLDS, COUNT)), array(np.zeros((0, 0)))):
        node = wp.zeros(WORLDS * window.count, dtype=t.aligned, device="cpu")
        arguments = (window, COUNT, states, shares, mass, node)
        wp.launch(one.collect, (WORLDS, -(-shape[0] // WIDTH)), arguments, device="cpu")
        found.append(node.numpy()[:, : dim + 1])
    want = expected(shape, base, fx, b, A, m)
    assert np.abs(found[0] - want).max() < LIMITS[dtype] * np.abs(want).max()
    assert np.array_equal(found[1][:, :dim], found[0][:, :dim]) and not found[1][:, dim].any()
