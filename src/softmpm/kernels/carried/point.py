"""Surface points on the moving grid: each has its place and its weights from a particle. Derivation: docs/math/contact.md.

With b = F_p (X_s − X_p) and the distance r_i of node i from the particle, both in cells,

    x_s = x_p + dx b,  W_si = w_i (1 + 4 r_i·b)                                                      (K8)

    x̄_p += x̄_s + Σ W̄_si [(1 + 4 r_i·b) ∇w_i − 4 w_i b / dx]
    F̄_p += (x̄_s + Σ W̄_si 4 w_i r_i / dx) (X_s − X_p)ᵀ                                                (K8.adj)

Places are in float64 in every precision: a point moves by 1e-5 of a cell in a substep.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.dependent import recent
from softmpm.kernels.fast.gather import stencil
from softmpm.kernels.fast.native import NATIVE, WARP, native
from softmpm.kernels.physics.lanes import lane_sum
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import types


@kernel_factory
def outline_type(dim: int, dtype: str):
    """Struct of the constants of the surface points."""
    t = types(dim, dtype)

    class Outline:
        """See :class:`softmpm.surface_points.SurfacePoints`."""

        lanes: int  # threads of a point
        arms: wp.array(dtype=t.vec)  # X_s − X_p [m]
        areas: wp.array(dtype=t.real)
        newtons: wp.array(dtype=t.real)  # areas in the units of force
        deepest: wp.array(dtype=t.real)
        stiffness: wp.array(dtype=t.real)  # in units of the heaviest particle's mass

    return wp.struct(Outline, module=f"softmpm.types.d{dim}.{dtype}.outline")


def options_of(packed: bool) -> dict:
    """Compile options of a kernel, as native functions need them if it is for packed particles."""
    return NATIVE if packed else {}


@kernel_factory
def surface_point(dim: int, dtype: str, packed: bool) -> SimpleNamespace:
    """Functions of a surface point.

    Args:
        packed: Whether particles are packed as in the fast scheme; ``owner`` then is the place of a point's particle, else its number.
    """
    t, s = types(dim, dtype), spline(dim, dtype)
    real, vec, mat, ivec, Constants, Window = t.real, t.vec, t.mat, t.ivec, t.Constants, t.Window
    offset, position, weight_at, slope_at = s.offset, s.position, s.weight_at, s.slope_at
    exact_vec, Outline = types(dim, "float64").vec, outline_type(dim, dtype)
    both, both_summed = wp.types.vector(2 * dim, real), lane_sum(2 * dim, real)
    Particles = t.Packed if packed else t.Motion
    ParticlesAdj = wp.array(dtype=real) if packed else t.MotionAdj

    vector = f"wp::vec_t<{dim}, {t.c_name}>"

    @wp.func_native(recent(vector, "i, j, k"))
    def load_state(values: wp.array3d(dtype=vec), i: int, j: int, k: int) -> vec: ...

    @wp.func_native(recent(vector, "i, j"))
    def load_velocity(values: wp.array2d(dtype=vec), i: int, j: int) -> vec: ...

    @wp.func_native(recent(t.c_name, "i, j"))
    def load_number(values: wp.array2d(dtype=real), i: int, j: int) -> real: ...

    @wp.struct
    class Point:
        base: ivec  # first node of the particle's stencil, counted from the first of the window
        fx: vec
        arm: vec  # b
        x: exact_vec

    @wp.struct
    class PlaceAdj:
        fx: vec
        arm: vec

    @wp.func
    def put(
        constants: Constants, window: Window, world: int, base: ivec, fx: vec, low: vec, arm: vec
    ) -> Point:
        """The point with this arm [m] of a particle."""
        out = Point()
        out.fx = fx
        out.arm = arm / constants.spacing
        for axis in range(dim):
            out.base[axis] = base[axis] - window.origin[world][axis]
            cells = wp.float64(base[axis]) + wp.float64(fx[axis]) + wp.float64(low[axis])
            out.x[axis] = constants.exact_spacing * cells + wp.float64(arm[axis])
        return out

    if packed:
        n = native(dim, dtype)
        unpack_base = stencil(dim, dtype).unpack_base
        row_fx = t.row_fx
        row_low = t.row_low
        row_H = t.row_h
        load_vec, load_mat, load_base, rows = n.early.vector, n.early.matrix, n.early.base, t.rows

        @wp.func
        def point_of(
            constants: Constants,
            window: Window,
            outline: Outline,
            now: Particles,
            world: int,
            p: int,
            owner: int,
        ) -> Point:
            """Point ``p`` of a world (K8)."""
            arm = outline.arms[p]
            H = load_mat(now.rows, owner, row_H)
            fx = load_vec(now.rows, owner, row_fx)
            low = load_vec(now.rows, owner, row_low)
            return put(
                constants, window, world, unpack_base(load_base(now.base, owner)), fx, low, arm + H * arm
            )

        @wp.func
        def add_adj(adj: ParticlesAdj, world: int, owner: int, fx: vec, H: mat):
            """Add to the adjoint of a particle."""
            first = (owner / WARP * rows) * WARP + owner % WARP
            for i in range(dim):
                wp.atomic_add(adj, first + (row_fx + i) * WARP, fx[i])
                for j in range(dim):
                    wp.atomic_add(adj, first + (row_H + i * dim + j) * WARP, H[i, j])
    else:
        rounds = dtype == "float32"

        @wp.func
        def point_of(
            constants: Constants,
            window: Window,
            outline: Outline,
            now: Particles,
            world: int,
            p: int,
            owner: int,
        ) -> Point:
            """Point ``p`` of a world (K8)."""
            arm = outline.arms[p]
            low = vec()
            if wp.static(rounds):
                low = now.fx_low[world, owner]
            arm += now.H[world, owner] * arm
            return put(constants, window, world, now.base[world, owner], now.fx[world, owner], low, arm)

        @wp.func
        def add_adj(adj: ParticlesAdj, world: int, owner: int, fx: vec, H: mat):
            """Add to the adjoint of a particle."""
            wp.atomic_add(adj.fx, world, owner, fx)
            wp.atomic_add(adj.H, world, owner, H)

    @wp.func
    def share(at: Point, n: int) -> real:
        """W of node ``n`` (K8)"""
        o = offset(n)
        return weight_at(at.fx, o) * (real(1.0) + real(4.0) * wp.dot(position(o) - at.fx, at.arm))

    @wp.func
    def with_share_adj(so_far: PlaceAdj, at: Point, n: int, adj_share: real) -> PlaceAdj:
        """The sums of (K8.adj) with the term of node ``n``."""
        o = offset(n)
        r = position(o) - at.fx
        lean = real(4.0) * adj_share * weight_at(at.fx, o)
        new = so_far
        new.fx += adj_share * (real(1.0) + real(4.0) * wp.dot(r, at.arm)) * slope_at(at.fx, o)
        new.fx -= lean * at.arm
        new.arm += lean * r
        return new

    @wp.func
    def add_place_adj(
        constants: Constants,
        outline: Outline,
        found: PlaceAdj,  # by this lane
        adj_x: vec,
        world: int,
        p: int,
        owner: int,
        lane: int,
        adj: ParticlesAdj,
    ):
        """(K8.adj)"""
        parts = both()
        for axis in range(dim):
            parts[axis] = found.fx[axis]
            parts[dim + axis] = found.arm[axis]
        sums = both_summed(parts, outline.lanes)
        fx = constants.spacing * adj_x
        arm = adj_x
        idle = bool(True)  # as most points, which no wall is near
        for axis in range(dim):
            fx[axis] = fx[axis] + sums[axis]
            arm[axis] = arm[axis] + sums[dim + axis] / constants.spacing
            idle = idle and fx[axis] == real(0.0) and arm[axis] == real(0.0)
        if lane == 0 and not idle:
            add_adj(adj, world, owner, fx, wp.outer(arm, outline.arms[p]))

    return SimpleNamespace(
        Point=Point,
        PlaceAdj=PlaceAdj,
        Particles=Particles,
        ParticlesAdj=ParticlesAdj,
        load_state=load_state,
        load_velocity=load_velocity,
        load_number=load_number,
        point_of=point_of,
        share=share,
        with_share_adj=with_share_adj,
        add_place_adj=add_place_adj,
    )
