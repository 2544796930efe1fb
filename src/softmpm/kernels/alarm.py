"""Alarms between substeps: numerical fracture and the running step limit. Derivation: docs/math/alarms.md.

    gap    |x_q − x_p| ≤ g dx                   for rest neighbours p, q                                        (W1)
    step   Δt ≤ s dx √(ρ₀ / K)                  with the stiffness K of the present F, material and pull        (W2)
    K = max ⟨G, A[G]⟩ / ⟨G, G⟩  over symmetric G,  A[G] = d/dε τ((I + εG) F)                                     (W3)

A is symmetric, so A[G] = sym(F̄ Fᵀ) with the adjoint F̄ of the stress for τ̄ = G: no law needs a block of its own. Lanczos'
iteration makes A tridiagonal, T, and T − κ I has a positive pivot in its elimination exactly if an eigenvalue of T is above κ. Both
alarms stand at the start of a call and at the end of a chunk, where their price is shared by all its substeps; det F is checked in
every substep (failure.py).
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels import failure
from softmpm.kernels.elasticity import elasticity
from softmpm.kernels.native import native, native_module
from softmpm.kernels.solid import solid, solid_adj
from softmpm.kernels.stencil import stencil
from softmpm.kernels.turn import once
from softmpm.kernels.types import Spec, Wanted, solid_adj_type, solid_types, types
from softmpm.watch import Kind

STEPS = {2: 3, 3: 5}
"""Of Lanczos' iteration. In 2D there are three symmetric G, in 3D six, the last of which no longer moves K by 1 %."""


@once
def alarm(spec: Spec) -> SimpleNamespace:
    """Blocks of one particle: is its step stable, and is a neighbour too far away."""
    t, wanted = types(spec.dim, spec.dtype), Wanted(material=False, activation=False)
    real, vec, mat, ivec, Scale = t.real, t.vec, t.mat, t.ivec, t.Scale
    Solid, SolidAdj = solid_types(spec).Solid, solid_adj_type(spec, wanted)
    rotation, stiffness_bound = solid(spec).rotation, solid(spec).stiffness_bound
    stress_adj = solid_adj(spec, wanted).stress_adj
    identity, dim, steps = elasticity(spec.dim, spec.dtype).identity, spec.dim, STEPS[spec.dim]

    @wp.func
    def stiffer(body: Solid, world: int, p: int, H: mat, limit: real) -> bool:
        """Whether K > ``limit`` [Pa] (W3); false where K is not a number, which is another alarm's business."""
        F = identity() + H
        Q = rotation(body, world, p, H)
        G = F * wp.transpose(F)
        G = G / wp.sqrt(wp.ddot(G, G))
        for i in range(dim):
            for j in range(dim):  # a part in every direction
                G[i, j] += (
                    real(0.3)
                    * wp.where(i == 0, real(1.0), real(-0.4))
                    * wp.where(j == 0, real(1.0), real(-0.4))
                )
        G = G / wp.sqrt(wp.ddot(G, G))
        before = mat()
        beta = real(0.0)
        pivot = real(1.0)
        for _step in range(steps):
            A = stress_adj(body, world, p, H, Q, G, SolidAdj()) * wp.transpose(F)
            A = real(0.5) * (A + wp.transpose(A))
            alpha = wp.ddot(G, A)
            pivot = alpha - limit - beta * beta / pivot
            if pivot > real(0.0):
                return wp.isfinite(pivot)
            A = A - alpha * G - beta * before
            beta = wp.sqrt(wp.ddot(A, A))
            before = G
            G = A / beta
        return False

    @wp.func
    def step_is_stable(scale: Scale, body: Solid, world: int, p: int, H: mat) -> bool:
        """(W2), as K ≤ s² ρ₀ dx² / Δt²."""
        reach = scale.spacing / scale.dt
        limit = scale.step * body.mass[world, p] / body.volume[world, p] * reach * reach
        # Nearly all particles of a scene at half its stable step need no more than this:
        if not stiffness_bound(body, world, p, H) > limit:
            return True
        return not stiffer(body, world, p, H, limit)

    @wp.func
    def near(scale: Scale, cells: ivec, apart: vec) -> bool:
        """(W1) for two particles ``cells + apart`` from each other, in cells."""
        d = apart
        for axis in range(dim):
            d[axis] = apart[axis] + real(cells[axis])
        return not (wp.dot(d, d) > scale.gap)

    return SimpleNamespace(step_is_stable=step_is_stable, near=near)


@once
def state_alarms(spec: Spec):
    """Kernel that checks a state in the user's order, before any substep or after ``substep``."""
    t, one = types(spec.dim, spec.dtype), alarm(spec)
    real, vec, mat, ivec, Scale, Solid = t.real, t.vec, t.mat, t.ivec, t.Scale, solid_types(spec).Solid
    blocks = elasticity(spec.dim, spec.dtype)
    volume_change, identity = blocks.volume_change, blocks.identity
    step_is_stable, near = one.step_is_stable, one.near
    ran, report = failure.report(spec.dim, spec.dtype).ran, failure.report(spec.dim, spec.dtype).report
    start, torn, step = int(Kind.START), int(Kind.TORN), int(Kind.STEP)

    @wp.func
    def on_grid(scale: Scale, x: vec) -> bool:
        for axis in range(spec.dim):
            cell = x[axis] / scale.spacing
            if not (cell >= real(0.5) and cell < real(scale.shape[axis]) - real(1.5)):
                return False
        return True

    @wp.kernel(module=spec.module + ".alarms", enable_backward=False)
    def check(
        # Parameters:
        scale: Scale,
        body: Solid,
        neighbours: wp.array2d(dtype=wp.int32),
        substep: int,  # -1 before the first
        # In:
        x: wp.array2d(dtype=vec),
        F: wp.array2d(dtype=mat),
        # Out:
        watch: wp.array(dtype=wp.int64),
    ):
        world, p = wp.tid()
        if not ran(watch, world, wp.max(substep, 0)):
            return
        H = F[world, p] - identity()
        if not step_is_stable(scale, body, world, p, H):
            report(watch, world, wp.max(substep, 0), step, p)
        for k in range(neighbours.shape[1]):
            q = neighbours[p, k]
            if q >= 0 and not on_grid(scale, x[world, q]):
                q = -1  # that one is reported where it enters the kernels
            if (
                q >= 0
                and on_grid(scale, x[world, p])
                and not near(scale, ivec(), (x[world, q] - x[world, p]) / scale.spacing)
            ):
                report(watch, world, wp.max(substep, 0), wp.where(substep < 0, start, torn), p)
        if substep < 0 and not volume_change(H) > scale.collapse:
            report(watch, world, 0, start, p)

    return check


@once
def packed_alarms(spec: Spec) -> SimpleNamespace:
    """The same for the packed particles of the fast scheme, at the end of a chunk."""
    t, one = types(spec.dim, spec.dtype), alarm(spec)
    Scale, Packed, Solid = t.Scale, t.Packed, solid_types(spec).Solid
    s, n = stencil(spec.dim, spec.dtype), native(spec.dim, spec.dtype)
    unpack_base, world_of, load_vec, load_mat = s.unpack_base, s.world_of, n.load_vec, n.load_mat
    step_is_stable, near, row_fx, row_H = one.step_is_stable, one.near, t.row_fx, t.row_h
    ran, report = failure.report(spec.dim, spec.dtype).ran, failure.report(spec.dim, spec.dtype).report
    torn, step = int(Kind.TORN), int(Kind.STEP)
    module = native_module(spec.module + ".alarms.fused")

    @wp.kernel(module=module, enable_backward=False)
    def check(
        # Parameters:
        scale: Scale,
        body: Solid,
        neighbours: wp.array3d(dtype=wp.int32),  # by place
        substep: int,
        count: int,  # particles of one world
        total: int,  # particles of all worlds
        order: wp.array(dtype=wp.int32),
        # In:
        now: Packed,
        # Out:
        watch: wp.array(dtype=wp.int64),
    ):
        i = wp.tid()
        world = world_of(i, count, total)
        p = i - world * count
        if not ran(watch, world, substep):
            return
        if not step_is_stable(scale, body, world, p, load_mat(now.rows, i, row_H)):
            report(watch, world, substep, step, order[i])
        base = unpack_base(now.base[i])
        fx = load_vec(now.rows, i, row_fx)
        for k in range(neighbours.shape[2]):
            q = neighbours[world, p, k]
            if q >= 0:
                j = world * count + q
                if not near(scale, unpack_base(now.base[j]) - base, load_vec(now.rows, j, row_fx) - fx):
                    report(watch, world, substep, torn, order[i])

    @wp.kernel(module=module, enable_backward=False)
    def arrange(
        # In:
        order: wp.array2d(dtype=wp.int32),
        places: wp.array2d(dtype=wp.int32),  # inverse of the order
        neighbours: wp.array2d(dtype=wp.int32),  # by particle
        # Out:
        by_place: wp.array3d(dtype=wp.int32),
    ):
        """Put the neighbours into the order of the packed particles."""
        world, place = wp.tid()
        p = order[world, place]
        for k in range(neighbours.shape[1]):
            q = neighbours[p, k]
            if q >= 0:
                q = places[world, q]
            by_place[world, place, k] = q

    return SimpleNamespace(check=check, arrange=arrange)
