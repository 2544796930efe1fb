"""Contact of the surface points of bodies with separating walls, in one pass. Derivation: docs/math/contact.md.

    D_s = Σ |w_si| L_i / m_i                                                                         (K1)
    x_s = X_s + shift + Σ w_si u_i,  v_s = Σ w_si v*_i                                               (K2)
    wall by wall: the anchor goes along by (K6), J by (K3), (K4), then v_s += D_s J
    f_s += A_s J / T, the mean force of a wall on a point in a control step of T                     (K7)
    v'_i = v*_i + Σ w_si A_s J / m_i,  u'_i = u_i + Δt v'_i                                          (K5)

Nodes gather what the points give them in a fixed order, as in nodes.py. Only the height over a wall sees the shift; anchors move with
the frame. The adjoint is in surface_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.rest import lagrangian_module, rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def surface_type(dim: int, dtype: str):
    t, exact_vec = types(dim, dtype), types(dim, "float64").vec

    class Surface:
        """See :class:`softmpm.surface_grid.SurfaceGrid`."""

        points: wp.array(dtype=exact_vec)
        areas: wp.array(dtype=t.real)
        newtons: wp.array(dtype=t.real)  # areas in the units of force
        deepest: wp.array(dtype=t.real)
        stiffness: wp.array(dtype=t.real)  # in units of the heaviest particle's mass
        loads: wp.array(dtype=t.real)
        stencil: wp.array2d(dtype=wp.int32)
        weights: wp.array2d(dtype=t.real)
        first: wp.array(dtype=wp.int32)
        members: wp.array(dtype=wp.int32)

    return wp.struct(Surface, module=f"softmpm.types.d{dim}.{dtype}")


@kernel_factory
def surface(spec: Spec) -> SimpleNamespace:
    t, r, block = (
        types(spec.dim, spec.dtype),
        rest(spec.dim, spec.dtype),
        surface_contact(spec.dim, spec.dtype),
    )
    real, vec, Constants, dim = t.real, t.vec, t.Constants, spec.dim
    exact_vec, GridInputs, Surface = (
        types(dim, "float64").vec,
        input_types(spec).GridInputs,
        surface_type(dim, spec.dtype),
    )
    walls = spec.surface_walls
    number = wp.types.vector(len(walls), wp.int32)(*walls)  # of each separating wall among all walls
    count, each_world, rough, arms = len(walls), "friction" in spec.given, spec.friction, r.count
    touch, across, in_wall, f = block.touch, block.across, int(Kind.IN_WALL), frame(dim, spec.dtype)
    Frame, recentring, exact_of = f.Frame, f.recentring, f.exact
    face, depth = wall_face(spec).face, wall_face(spec).depth
    running, was_running, report = (
        getattr(status.report(dim, spec.dtype), name) for name in ("running", "was_running", "report")
    )
    module = lagrangian_module(spec.module + ".lagrangian")

    @wp.func
    def friction_of(inputs: GridInputs, world: int, k: int) -> real:
        if wp.static(rough and each_world):
            return inputs.friction[world, k]
        elif wp.static(rough):
            return inputs.friction[k]
        else:
            return real(0.0)

    @wp.func
    def at_point(body: Surface, nodal: wp.array2d(dtype=vec), world: int, p: int) -> vec:
        """Σ w a of a nodal field."""
        total = vec()
        for n in range(r.count):
            total += body.weights[p, n] * nodal[world, body.stencil[p, n]]
        return total

    @wp.func
    def from_points(body: Surface, values: wp.array2d(dtype=vec), world: int, i: int) -> vec:
        """Σ w a of a field of the surface points, at a node, in a fixed order."""
        total = vec()
        for m in range(body.first[i], body.first[i + 1]):
            entry = body.members[m]
            p = entry / arms
            total += body.weights[p, entry - p * arms] * values[world, p]
        return total

    @wp.func
    def present(body: Surface, p: int, u: vec) -> exact_vec:
        """x of (K2) without the shift."""
        return body.points[p] + exact_of(u)

    @wp.kernel(module=module, enable_backward=False)
    def delassus(body: Surface, mass: wp.array2d(dtype=real), D: wp.array2d(dtype=real)):
        """(K1)"""
        world, p = wp.tid()
        total = real(0.0)
        for n in range(r.count):
            i = body.stencil[p, n]
            if body.weights[p, n] != real(0.0):
                total += wp.abs(body.weights[p, n]) * body.loads[i] / mass[world, i]
        D[world, p] = total

    @wp.kernel(module=module, enable_backward=False)
    def press(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        moving: Frame,
        smoothing: real,
        D: wp.array2d(dtype=real),
        substep: int,
        rate: wp.array(dtype=real),  # 1/T
        anew: int,  # 1 at the beginning of a control step
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        anchor: wp.array3d(dtype=vec),
        # In and out:
        words: wp.array(dtype=wp.int64),
        force: wp.array3d(dtype=vec),
        # Out:
        impulse: wp.array2d(dtype=vec),
        new_anchor: wp.array3d(dtype=vec),
    ):
        """(K2) to (K4), (K6), (K7): impulse A J of each point."""
        world, p = wp.tid()
        total = vec()
        last = wp.max(substep - 1, 0)
        if was_running(words, world, last, in_wall):
            d = recentring(moving, u, world)
            x = present(body, p, at_point(body, u, world, p))
            v = at_point(body, free, world, p)
            for q in range(count):
                k = number[q]
                wall = face(constants, inputs, world, k, x + shift[world], anchor[world, q, p])
                if wall.depth > body.deepest[p]:
                    report(words, world, last, in_wall, q * body.points.shape[0] + p)
                found = touch(
                    wall.n,
                    wall.y,
                    vec(x),
                    v,
                    wall.anchor,
                    D[world, p],
                    friction_of(inputs, world, k),
                    body.stiffness[p],
                    constants.dt,
                    smoothing,
                )
                new_anchor[world, q, p] = found.anchor - across(wall.n, d)
                total += found.J
                v += D[world, p] * found.J
                pushed = (rate[0] * body.newtons[p]) * found.J
                if anew == 0:
                    pushed += force[world, q, p]
                force[world, q, p] = pushed
        else:
            for q in range(count):
                new_anchor[world, q, p] = anchor[world, q, p]
        impulse[world, p] = body.areas[p] * total

    @wp.kernel(module=module, enable_backward=False)
    def settle(
        # Parameters:
        constants: Constants,
        body: Surface,
        moving: Frame,
        mass: wp.array2d(dtype=real),
        impulse: wp.array2d(dtype=vec),
        words: wp.array(dtype=wp.int64),
        # In:
        u: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        free: wp.array2d(dtype=vec),
        # Out:
        new_u: wp.array2d(dtype=vec),
        new_v: wp.array2d(dtype=vec),
    ):
        """(K5)"""
        world, i = wp.tid()
        here = u[world, i]
        new = v[world, i]
        if running(words, world):
            new = free[world, i]
            if body.first[i + 1] > body.first[i]:
                new += from_points(body, impulse, world, i) / mass[world, i]
            here = (here - recentring(moving, u, world)) + constants.dt * new
        new_u[world, i] = here
        new_v[world, i] = new

    @wp.kernel(module=module, enable_backward=False)
    def check_depth(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        body: Surface,
        later: wp.float64,  # than the inputs [s]
        substep: int,
        # In:
        shift: wp.array(dtype=exact_vec),
        u: wp.array2d(dtype=vec),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check a state that no contact is computed of: the final one of a chunk, or the initial one of a call."""
        world, p = wp.tid()
        x = present(body, p, at_point(body, u, world, p)) + shift[world]
        for q in range(count):
            if depth(inputs, world, number[q], later, x) > body.deepest[p]:
                report(words, world, substep, in_wall, q * body.points.shape[0] + p)

    return SimpleNamespace(
        delassus=delassus,
        press=press,
        settle=settle,
        check_depth=check_depth,
        friction_of=friction_of,
        at_point=at_point,
        from_points=from_points,
        present=present,
        number=number,
    )
