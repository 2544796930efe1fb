"""The sum over a warp (docs/math/scatter.md) as a GPU takes it, run by 32 threads on the CPU, against a plain sum in NumPy."""

import ctypes
import itertools
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from softmpm.kernels.fast import native
from softmpm.kernels.fast.native import WARP

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def warp(tmp_path_factory):
    """``add2`` and ``add3`` of warp.cpp."""
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler here (g++)")
    library = tmp_path_factory.mktemp("warp") / "warp.so"
    flags = ["-std=c++20", "-O1", "-pthread", "-shared", "-fPIC", f"-I{Path(native.__file__).parent}"]
    built = subprocess.run(["g++", *flags, HERE / "warp.cpp", "-o", library], capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return ctypes.CDLL(str(library))


@pytest.mark.parametrize("count", [32, 27, 16, 11, 7, 2, 1, 0])
@pytest.mark.parametrize("order", ["sorted", "shuffled"])
@pytest.mark.parametrize("dim", [2, 3])
def test_sum_over_a_warp(warp, dim, order, count):
    """(A1) of a warp of which ``count`` lanes have a particle; in whatever order, fewer sums are sent than nodes are met."""
    random, shape = np.random.default_rng(0), np.array((6, 7, 9)[:dim])
    cell = np.stack(np.unravel_index(np.arange(WARP) // 4, (2,) * dim if dim == 3 else (2, 4)), -1)
    if order == "shuffled":
        random.shuffle(cell)
    first = np.where(np.arange(WARP) < count, np.ravel_multi_index(cell.T, shape), -1).astype(np.int32)
    g, b = 0.5 * random.uniform(-1, 1, (WARP, dim)), random.normal(size=(WARP, dim))
    A, m = random.normal(size=(WARP, dim, dim)), random.uniform(1, 2, WARP)
    given = [np.ascontiguousarray(values, dtype=np.float32) for values in (g, b, A, m)]
    node, want = np.zeros((shape.prod(), 4), np.float32), np.zeros((shape.prod(), 4))
    pointers = [
        values.ctypes.data_as(ctypes.c_void_p) for values in (shape.astype(np.int32), first, *given, node)
    ]
    sent = getattr(warp, f"add{dim}")(pointers[-1], pointers[0], *pointers[1:-1])
    for p, o in itertools.product(range(count), itertools.product((-1, 0, 1), repeat=dim)):
        d = np.abs(np.array(o) - given[0][p].astype(float))
        weight = np.where(d < 0.5, 0.75 - d**2, 0.5 * (1.5 - d) ** 2).prod()
        index = np.ravel_multi_index(cell[p] + 1 + o, shape)
        want[index, :dim] += weight * (given[1][p] + given[2][p].astype(float) @ o)
        want[index, dim] += weight * given[3][p]
    np.testing.assert_allclose(node, want, rtol=0, atol=1e-5)
    if count == WARP:
        assert sent < 3**dim * count / 3


@pytest.mark.parametrize("count", [32, 13, 1])
@pytest.mark.parametrize("farthest", [40, 2**26, 2**31 - 1])
def test_places_within_a_warp(warp, farthest, count):
    """A permutation in which lanes without a particle stay last and others are sorted; nodes too far away to be told apart follow."""
    random = np.random.default_rng(0)
    for _ in range(20):
        first, place = np.full(WARP, -1, np.int32), np.zeros(WARP, np.int32)
        first[:count] = random.integers(0, farthest, count, endpoint=True)
        first[: count // 2] %= 40
        warp.sorted_places(*(a.ctypes.data_as(ctypes.c_void_p) for a in (place, first)))
        assert sorted(place) == list(range(WARP))
        moved = np.empty_like(first)
        moved[place] = first
        assert (moved[count:] == -1).all()
        near = moved[:count] - first[:count].min() < 2**27 - 1
        assert (np.diff(moved[:count][near]) >= 0).all() and not (np.diff(near.astype(int)) > 0).any()


@pytest.mark.parametrize("count", [32, 13, 1])
def test_rows_in_the_order_of_the_user(warp, count):
    """Each lane's numbers come to its row, in a warp that is full or the last of many."""
    random = np.random.default_rng(0)
    row, value = (
        random.permutation(40)[:count].astype(np.int32),
        random.normal(size=(count, 9)).astype(np.float32),
    )
    out, want = (np.zeros((40, 9), np.float32) for _ in range(2))
    want[row] = value
    warp.spread9(*(a.ctypes.data_as(ctypes.c_void_p) for a in (out, row, value)), count)
    assert (out == want).all()
