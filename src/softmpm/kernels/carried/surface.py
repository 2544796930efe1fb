"""Contact of surface points with separating walls on the moving grid. Derivation: docs/math/contact.md.

    b_si of (K8), l_i = Σ |b_si| A_s,  D_s = Σ m_i |b_si| l_i,  v_s = Σ m_i b_si v*_i                 (K9)
    wall by wall: the anchor goes along by (K6), J by (K3), (K4), then v_s += D_s J
    f_s += A_s J / T, the mean force of a wall on a point in a control step of T                     (K7)
    v'_i = v*_i + Σ b_si A_s J,  x'_s = x_s + Δt Σ m_i b_si v'_i                                     (K10)

``share`` is (K8), l and v_s, after x'_s of the substep before, whose velocities must still be there; ``press`` is D, the walls and v';
``carry`` is x' alone. Places are in float64 in every precision: a point moves by 1e-5 of a cell in a substep.

Nodes are those of a window, the whole grid in the plain scheme. Arrays of them may have strides: the fast scheme has load and
velocity in one. A GPU waits for a load only where its value is used, so all loads of a stencil precede the stores and sums.
The adjoint is in surface_adj.py.
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
def point_types(dim: int, dtype: str) -> SimpleNamespace:
    """Structs on the surface points."""
    t = types(dim, dtype)

    class Outline:
        """Constants of the surface points, see :class:`softmpm.surface_points.SurfacePoints`."""

        areas: wp.array(dtype=t.real)
        newtons: wp.array(dtype=t.real)  # areas in the units of force
        deepest: wp.array(dtype=t.real)
        stiffness: wp.array(dtype=t.real)  # in units of the heaviest particle's mass

    class Stencils:
        """What the nodes around each point are to it in a substep."""

        base: wp.array2d(dtype=t.ivec)  # (world, point), counted from the first node of the window
        shares: wp.array3d(dtype=t.real)  # b, (world, point, node)
        weights: wp.array3d(dtype=t.real)  # m b; zero if the point does not move
        velocity: wp.array2d(dtype=t.vec)  # v

    def struct(cls):
        return wp.struct(cls, module=f"softmpm.types.d{dim}.{dtype}.outline")

    return SimpleNamespace(Outline=struct(Outline), Stencils=struct(Stencils))


def unrolled(name: str) -> str:
    """Let the loops over the nodes of a stencil be written out in the Warp module of this name; returns the name."""
    wp.set_module_options({"max_unroll": 27}, module=wp.get_module(name))
    return name


@kernel_factory
def surface(spec: Spec) -> SimpleNamespace:
    dim, t, s = spec.dim, types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype)
    real, vec, ivec, node_vec, Constants, Window = t.real, t.vec, t.ivec, t.node, t.Constants, t.Window
    exact_vec, GridInputs = types(dim, "float64").vec, input_types(spec).GridInputs
    structs, shared, one = point_types(dim, spec.dtype), point_share(dim, spec.dtype), wall_face(spec)
    Outline, Stencils, Table = structs.Outline, structs.Stencils, shared.Table
    place, masses_of, fit, share_of = shared.place, shared.masses_of, shared.fit, shared.share_of
    weights, offset, node_index, size = s.weights, s.offset, s.node_index, s.count
    face, depth, friction_of = one.face, one.depth, one.friction_of
    block = surface_contact(dim, spec.dtype)
    touch, Touch = block.touch, block.Touch
    running, report = status.report(dim, spec.dtype).running, status.report(dim, spec.dtype).report
    walls = spec.surface_walls
    count, number = len(walls), wp.types.vector(len(walls), wp.int32)(*walls)  # among all walls
    left_window, lost, in_wall = int(Kind.LEFT_WINDOW), int(Kind.LOST), int(Kind.IN_WALL)
    module = unrolled(spec.module + ".surface")

    @wp.struct
    class Weighed:
        base: ivec
        weights: Table  # m b

    @wp.func
    def at_point(stencils: Stencils, field: wp.array2d(dtype=vec), world: int, p: int, shape: ivec) -> vec:
        """Σ m b a of a nodal field."""
        base = stencils.base[world, p]
        total = vec()
        for n in range(size):
            i = node_index(base, offset(n), shape)
            total += stencils.weights[world, p, n] * field[world, i]
        return total

    @wp.func
    def weigh(
        constants: Constants,
        window: Window,
        outline: Outline,
        substep: int,
        world: int,
        p: int,
        x: exact_vec,
        node: wp.array2d(dtype=node_vec),
        velocity: wp.array2d(dtype=vec),
        words: wp.array(dtype=wp.int64),
        stencils: Stencils,
        load: wp.array2d(dtype=real),
    ) -> Weighed:
        """(K8), l and v of (K9)"""
        area = outline.areas[p]
        at = place(x, constants.exact_spacing, constants.shape, window.origin[world], window.shape)
        masses = masses_of(node, world, at.base, window.shape)
        w = weights(at.fx)
        around = fit(masses, w, at.fx)
        held = at.valid and around.mass > real(0.0)
        out = Weighed()
        out.base = at.base
        shares = Table()
        v = vec()
        for n in range(size):
            if held:
                shares[n] = share_of(around, w, at.fx, n)
            out.weights[n] = masses[n] * shares[n]
            v += out.weights[n] * velocity[world, node_index(at.base, offset(n), window.shape)]
        if not held and running(words, world):
            report(words, world, substep, wp.where(at.beyond, left_window, lost), p)
        stencils.base[world, p] = at.base
        stencils.velocity[world, p] = v
        for n in range(size):
            stencils.shares[world, p, n] = shares[n]
            stencils.weights[world, p, n] = out.weights[n]
            if held:
                i = node_index(at.base, offset(n), window.shape)
                wp.atomic_add(load, world, i, area * wp.abs(shares[n]))
        return out

    @wp.func
    def meet(
        constants: Constants,
        inputs: GridInputs,
        outline: Outline,
        smoothing: real,
        world: int,
        k: int,
        p: int,
        n: vec,
        y: real,
        x: exact_vec,
        v: vec,
        anchor: vec,
        D: real,
    ) -> Touch:
        """J and the new anchor of (K3), (K4) at wall ``k``."""
        friction = friction_of(inputs, world, k)
        return touch(n, y, vec(x), v, anchor, D, friction, outline.stiffness[p], constants.dt, smoothing)

    @wp.kernel(module=module, enable_backward=False)
    def share(
        # Parameters:
        constants: Constants,
        window: Window,
        outline: Outline,
        substep: int,
        there: int,  # 1 if x is that of this substep, 0 if it is that of the one before
        # In:
        x: wp.array2d(dtype=exact_vec),
        last_velocity: wp.array2d(dtype=vec),  # after contact in the substep before
        node: wp.array2d(dtype=node_vec),
        velocity: wp.array2d(dtype=vec),
        # In and out:
        words: wp.array(dtype=wp.int64),
        stencils: Stencils,
        # Out:
        new_x: wp.array2d(dtype=exact_vec),
        # Out, added into:
        load: wp.array2d(dtype=real),
    ):
        """x' of (K10) of the substep before; (K8), l and v of (K9)"""
        world, p = wp.tid()
        at = x[world, p]
        if there == 0:
            at += exact_vec(constants.dt * at_point(stencils, last_velocity, world, p, window.shape))
        new_x[world, p] = at
        weigh(constants, window, outline, substep, world, p, at, node, velocity, words, stencils, load)

    @wp.kernel(module=module, enable_backward=False)
    def press(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        outline: Outline,
        smoothing: real,
        substep: int,
        rate: wp.array(dtype=real),  # 1/T
        anew: int,  # 1 at the beginning of a control step
        # In:
        x: wp.array2d(dtype=exact_vec),
        anchor: wp.array3d(dtype=vec),
        load: wp.array2d(dtype=real),
        # In and out:
        words: wp.array(dtype=wp.int64),
        stencils: Stencils,
        force: wp.array3d(dtype=vec),
        # Out:
        new_anchor: wp.array3d(dtype=vec),
        # Out, added into:
        velocity: wp.array2d(dtype=vec),
    ):
        """D of (K9), (K3), (K4), (K6), (K7) and v' of (K10)"""
        world, p = wp.tid()
        alive = running(words, world)
        base = stencils.base[world, p]
        at = x[world, p]
        v = stencils.velocity[world, p]
        area = outline.areas[p]
        newtons = rate[0] * outline.newtons[p]
        deepest = outline.deepest[p]
        shares = Table()
        D = real(0.0)
        for n in range(size):
            i = node_index(base, offset(n), window.shape)
            shares[n] = stencils.shares[world, p, n]
            D += wp.abs(stencils.weights[world, p, n]) * load[world, i]
        total = vec()
        for q in range(count):
            k = number[q]
            before = anchor[world, q, p]
            pushed = force[world, q, p]
            wall = face(constants, inputs, world, k, at, before)
            found = meet(
                constants, inputs, outline, smoothing, world, k, p, wall.n, wall.y, at, v, wall.anchor, D
            )
            total += found.J
            v += D * found.J
            if anew == 1:
                pushed = vec()
            if alive:
                if wall.depth > deepest:
                    report(words, world, wp.max(substep - 1, 0), in_wall, q * x.shape[1] + p)
                new_anchor[world, q, p] = found.anchor
                force[world, q, p] = pushed + newtons * found.J
            else:
                new_anchor[world, q, p] = before
        if not alive:
            for n in range(size):
                stencils.weights[world, p, n] = real(0.0)
        elif wp.dot(total, total) > real(0.0):
            impulse = area * total
            for n in range(size):
                wp.atomic_add(velocity, world, node_index(base, offset(n), window.shape), shares[n] * impulse)

    @wp.kernel(module=module, enable_backward=False)
    def carry(
        # Parameters:
        constants: Constants,
        window: Window,
        # In:
        x: wp.array2d(dtype=exact_vec),
        velocity: wp.array2d(dtype=vec),
        stencils: Stencils,
        # Out:
        new_x: wp.array2d(dtype=exact_vec),
    ):
        """x' of (K10)"""
        world, p = wp.tid()
        way = constants.dt * at_point(stencils, velocity, world, p, window.shape)
        new_x[world, p] = x[world, p] + exact_vec(way)

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
        carry=carry,
        check_depth=check_depth,
        weigh=weigh,
        meet=meet,
        number=number,
    )
