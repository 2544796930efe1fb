"""Native functions that Warp's language cannot express: 16-byte loads and reductions, sums over a warp. Code: scatter.h, fixed_point.h.

Each function also has a plain form for the CPU, for double precision and for GPUs before sm_90, selected at compile time.
"""

import enum
from pathlib import Path
from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.parts import in_parts
from softmpm.kernels.structs import types

SOURCE = "".join(Path(__file__).with_name(name).read_text() for name in ("scatter.h", "fixed_point.h"))
NATIVE = {
    "extra_build_options": in_parts(SOURCE),
    "cuda_output": "cubin",
}
"""Compile options of kernels with native functions. Machine code is compiled for each GPU ("cubin"): PTX would be that of the oldest
GPU in the machine, without 16-byte reductions."""
WARP = 32
"""Threads per warp, and particles per block of packed rows."""
BLOCK = 128
"""Threads per block."""
FEW, VERY_FEW, MANY = 20_000, 10_000, 250_000
"""Up to ``FEW`` particles: separate kernels with one-warp blocks. Up to ``VERY_FEW``: half-populated warps. Beyond ``MANY``: a separate
forward kernel, which does not begin early."""


class SizeClass(enum.Enum):
    """Classes of numbers of particles, in all worlds, for which a GPU has kernels of their own. A CPU takes those for ``SOME``."""

    FEW = enum.auto()
    SOME = enum.auto()
    MANY = enum.auto()


def padded(particles: int) -> int:
    """Number of places of the packed particles: their count rounded up to whole warps."""
    return -(-particles // WARP) * WARP


@kernel_factory
def native(dim: int, dtype: str) -> SimpleNamespace:
    t = types(dim, dtype)
    real, vec, mat, ivec, node_vec, rows = t.real, t.vec, t.mat, t.ivec, t.aligned, t.rows

    @wp.func_native(f"softmpm::scatter<{dim}>(node.data, shape, first, g, b, A, m);")
    def scatter(node: wp.array(dtype=node_vec), shape: ivec, first: int, g: vec, b: vec, A: mat, m: real): ...

    @wp.func_native(
        f"softmpm::add_each(reinterpret_cast<{t.c_name}*>(node.data), shape, first, g, b, A, m, begin, end);"
    )
    def scatter_planes(
        node: wp.array(dtype=node_vec),
        shape: ivec,
        first: int,
        g: vec,
        b: vec,
        A: mat,
        m: real,
        begin: int,
        end: int,
    ): ...

    @wp.func_native("return softmpm::load_node(node.data, i);")
    def load_node(node: wp.array(dtype=node_vec), i: int) -> node_vec: ...

    @wp.func_native("return softmpm::load_constant_node(node.data, i);")
    def load_constant_node(node: wp.array(dtype=node_vec), i: int) -> node_vec: ...

    @wp.func_native("softmpm::store_node(node.data, i, value);")
    def store_node(node: wp.array(dtype=node_vec), i: int, value: node_vec): ...

    def loads(early: bool) -> SimpleNamespace:
        """Functions that load the base, a vector and a matrix of a packed particle; early ones may do so before the wait."""
        template = f"softmpm::load_rows<{str(early).lower()}, {rows}"

        @wp.func_native(f"return {'softmpm::recent(base.data + i)' if early else 'wp::index(base, i)'};")
        def base(base: wp.array(dtype=wp.int32), i: int) -> int: ...

        @wp.func_native(
            f"wp::vec_t<{dim}, {t.c_name}> value; {template}, {dim}>(packed.data, i, r, value.c); return value;"
        )
        def vector(packed: wp.array(dtype=real), i: int, r: int) -> vec: ...

        @wp.func_native(
            f"wp::mat_t<{dim}, {dim}, {t.c_name}> value; "
            f"{template}, {dim * dim}>(packed.data, i, r, &value.data[0][0]); return value;"
        )
        def matrix(packed: wp.array(dtype=real), i: int, r: int) -> mat: ...

        return SimpleNamespace(base=base, vector=vector, matrix=matrix)

    early, plain = loads(early=True), loads(early=False)

    @wp.func_native(f"softmpm::store_rows<{rows}, {dim}>(packed.data, i, r, value.c);")
    def store_vec(packed: wp.array(dtype=real), i: int, r: int, value: vec): ...

    @wp.func_native(f"softmpm::store_rows<{rows}, {dim * dim}>(packed.data, i, r, &value.data[0][0]);")
    def store_mat(packed: wp.array(dtype=real), i: int, r: int, value: mat): ...

    @wp.func_native(f"softmpm::spread<{dim}>(&out.data->c[0], row, value.c, i, total);")
    def spread_vec(out: wp.array2d(dtype=vec), row: int, value: vec, i: int, total: int): ...

    @wp.func_native(f"softmpm::spread<{dim * dim}>(&out.data->data[0][0], row, &value.data[0][0], i, total);")
    def spread_mat(out: wp.array2d(dtype=mat), row: int, value: mat, i: int, total: int): ...

    @wp.func_native(f"softmpm::copy_rows<{rows}>(source.data, j, target.data, i);")
    def copy_rows(source: wp.array(dtype=real), j: int, target: wp.array(dtype=real), i: int): ...

    return SimpleNamespace(
        scatter=scatter,
        scatter_planes=scatter_planes,
        load_node=load_node,
        load_constant_node=load_constant_node,
        store_node=store_node,
        early=early,
        plain=plain,
        store_vec=store_vec,
        store_mat=store_mat,
        spread_vec=spread_vec,
        spread_mat=spread_mat,
        copy_rows=copy_rows,
    )
