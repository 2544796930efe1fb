"""Contact of surface points with separating walls on the moving grid. Derivation: docs/math/contact.md.

    b_si of (K8), l_i = Σ |b_si| A_s,  D_s = Σ m_i |b_si| l_i,  v_s = Σ m_i b_si v*_i                 (K9)
    wall by wall: the anchor goes along by (K6), J by (K3), (K4), then v_s += D_s J
    f_s += A_s J / T, the mean force of a wall on a point in a control step of T                     (K7)
    v'_i = v*_i + Σ b_si A_s J,  x'_s = x_s + Δt Σ m_i b_si v'_i                                     (K10)

Places are in float64 in every precision: a point moves by 1e-5 of a cell in a substep. The adjoint is in surface_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics import status
from softmpm.kernels.physics.point_share import point_share
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def outline_type(dim: int, dtype: str):
    t = types(dim, dtype)

    class Outline:
        """Constants of the surface points, see :class:`softmpm.surface_points.SurfacePoints`."""

        areas: wp.array(dtype=t.real)
        newtons: wp.array(dtype=t.real)  # areas in the units of force
        deepest: wp.array(dtype=t.real)
        stiffness: wp.array(dtype=t.real)  # in units of the heaviest particle's mass

    return wp.struct(Outline, module=f"softmpm.types.d{dim}.{dtype}.outline")


@kernel_factory
def surface(spec: Spec) -> SimpleNamespace:
    dim, t, s = spec.dim, types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype)
    real, vec, ivec, node_vec, Constants = t.real, t.vec, t.ivec, t.node, t.Constants
    exact_vec, GridInputs = types(dim, "float64").vec, input_types(spec).GridInputs
    Outline, shared = outline_type(dim, spec.dtype), point_share(dim, spec.dtype)
    place, fit, one = shared.place, shared.fit, wall_face(spec)
    weights, offset, position, weight, node_index = s.weights, s.offset, s.position, s.weight, s.node_index
    face, depth, touch = one.face, one.depth, surface_contact(dim, spec.dtype).touch
    running, report = status.report(dim, spec.dtype).running, status.report(dim, spec.dtype).report
    walls = spec.surface_walls
    count, number = len(walls), wp.types.vector(len(walls), wp.int32)(*walls)  # among all walls
    each_world, rough = "friction" in spec.given, spec.friction
    lost, in_wall = int(Kind.LOST), int(Kind.IN_WALL)
    module = spec.module + ".surface"

    @wp.func
    def friction_of(inputs: GridInputs, world: int, k: int) -> real:
        if wp.static(rough and each_world):
            return inputs.friction[world, k]
        elif wp.static(rough):
            return inputs.friction[k]
        else:
            return real(0.0)

    @wp.func
    def at_point(
        node: wp.array2d(dtype=node_vec),
        shares: wp.array3d(dtype=real),
        field: wp.array2d(dtype=vec),
        world: int,
        p: int,
        base: ivec,
        shape: ivec,
    ) -> vec:
        """Σ m b a of a nodal field."""
        total = vec()
        for n in range(s.count):
            i = node_index(base, offset(n), shape)
            total += (node[world, i][dim] * shares[world, p, n]) * field[world, i]
        return total

    @wp.kernel(module=module, enable_backward=False)
    def share(
        # Parameters:
        constants: Constants,
        outline: Outline,
        substep: int,
        # In:
        x: wp.array2d(dtype=exact_vec),
        node: wp.array2d(dtype=node_vec),
        # In and out:
        words: wp.array(dtype=wp.int64),
        # Out:
        base: wp.array2d(dtype=ivec),
        shares: wp.array3d(dtype=real),
        # Out, added into:
        load: wp.array2d(dtype=real),
    ):
        """(K8), and l of (K9)"""
        world, p = wp.tid()
        at = place(x[world, p], constants.exact_spacing, constants.shape)
        around = fit(node, world, at, constants.shape)
        held = at.valid and around.mass > real(0.0)
        if not held and running(words, world):
            report(words, world, substep, lost, p)
        base[world, p] = at.base
        w = weights(at.fx)
        for n in range(s.count):
            b = real(0.0)
            if held:
                o = offset(n)
                arm = position(o) - at.fx - around.mean
                b = weight(w, o) / around.mass * (real(1.0) - wp.dot(around.lean, arm))
                i = node_index(at.base, o, constants.shape)
                wp.atomic_add(load, world, i, outline.areas[p] * wp.abs(b))
            shares[world, p, n] = b

    @wp.kernel(module=module, enable_backward=False)
    def press(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        outline: Outline,
        smoothing: real,
        substep: int,
        rate: real,  # 1/T
        anew: int,  # 1 at the beginning of a control step
        # In:
        x: wp.array2d(dtype=exact_vec),
        anchor: wp.array3d(dtype=vec),
        node: wp.array2d(dtype=node_vec),
        free: wp.array2d(dtype=vec),
        base: wp.array2d(dtype=ivec),
        shares: wp.array3d(dtype=real),
        load: wp.array2d(dtype=real),
        # In and out:
        words: wp.array(dtype=wp.int64),
        force: wp.array3d(dtype=vec),
        # Out:
        new_anchor: wp.array3d(dtype=vec),
        # Out, added into:
        velocity: wp.array2d(dtype=vec),
    ):
        """D and v of (K9), (K3), (K4), (K6), (K7) and v' of (K10)"""
        world, p = wp.tid()
        first = base[world, p]
        if running(words, world):
            D = real(0.0)
            for n in range(s.count):
                i = node_index(first, offset(n), constants.shape)
                D += node[world, i][dim] * wp.abs(shares[world, p, n]) * load[world, i]
            v = at_point(node, shares, free, world, p, first, constants.shape)
            at = x[world, p]
            total = vec()
            for q in range(count):
                k = number[q]
                wall = face(constants, inputs, world, k, at, anchor[world, q, p])
                if wall.depth > outline.deepest[p]:
                    report(words, world, wp.max(substep - 1, 0), in_wall, q * x.shape[1] + p)
                found = touch(
                    wall.n,
                    wall.y,
                    vec(at),
                    v,
                    wall.anchor,
                    D,
                    friction_of(inputs, world, k),
                    outline.stiffness[p],
                    constants.dt,
                    smoothing,
                )
                new_anchor[world, q, p] = found.anchor
                total += found.J
                v += D * found.J
                pushed = (rate * outline.newtons[p]) * found.J
                if anew == 0:
                    pushed += force[world, q, p]
                force[world, q, p] = pushed
            impulse = outline.areas[p] * total
            if wp.dot(total, total) > real(0.0):
                for n in range(s.count):
                    i = node_index(first, offset(n), constants.shape)
                    wp.atomic_add(velocity, world, i, shares[world, p, n] * impulse)
        else:
            for q in range(count):
                new_anchor[world, q, p] = anchor[world, q, p]

    @wp.kernel(module=module, enable_backward=False)
    def advance(
        # Parameters:
        constants: Constants,
        words: wp.array(dtype=wp.int64),
        # In:
        x: wp.array2d(dtype=exact_vec),
        node: wp.array2d(dtype=node_vec),
        velocity: wp.array2d(dtype=vec),
        base: wp.array2d(dtype=ivec),
        shares: wp.array3d(dtype=real),
        # Out:
        new_x: wp.array2d(dtype=exact_vec),
    ):
        """x' of (K10)"""
        world, p = wp.tid()
        there = x[world, p]
        if running(words, world):
            v = at_point(node, shares, velocity, world, p, base[world, p], constants.shape)
            there += exact_vec(constants.dt * v)
        new_x[world, p] = there

    @wp.kernel(module=module, enable_backward=False)
    def check_depth(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        outline: Outline,
        later: wp.float64,  # than the inputs [s]
        substep: int,
        # In:
        x: wp.array2d(dtype=exact_vec),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check a state that no contact is computed of: the final one of a chunk, or the initial one of a call."""
        world, p = wp.tid()
        for q in range(count):
            if depth(inputs, world, number[q], later, x[world, p]) > outline.deepest[p]:
                report(words, world, substep, in_wall, q * x.shape[1] + p)

    return SimpleNamespace(
        share=share,
        press=press,
        advance=advance,
        check_depth=check_depth,
        friction_of=friction_of,
        at_point=at_point,
        number=number,
    )
