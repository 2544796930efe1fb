"""Contact of surface points with separating walls on the moving grid. Derivation: docs/math/contact.md.

    W_si of (K8), L_i = Σ |W_si| A_s,  D_s = Σ |W_si| L_i / m_i,  v_s = Σ W_si v*_i                  (K9)
    wall by wall: the anchor goes along by (K6), J by (K3), (K4), then v_s += D_s J
    f_s += A_s J / T, the mean force of a wall on a point in a control step of T                     (K7)
    v'_i = v*_i + (1/m_i) Σ W_si A_s J                                                               (K10)

``add_loads`` is L, ``press`` the rest. Nodes are those of a window, the whole grid in the plain scheme. Their arrays may have strides:
the fast scheme has several quantities in one. v* and v' are two arrays, since points read the one while others add to the other. The
adjoint is in surface_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.errors import Kind
from softmpm.kernels.carried.point import module_of, outline_type, surface_point
from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics import status
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.physics.surface_contact import surface_contact
from softmpm.kernels.physics.wall_face import wall_face
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def surface(spec: Spec, packed: bool) -> SimpleNamespace:
    """Kernels on particles that are ``packed`` as in the fast scheme, or not."""
    dim, t, s = spec.dim, types(spec.dim, spec.dtype), spline(spec.dim, spec.dtype)
    real, vec, node_vec, Constants, Window = t.real, t.vec, t.node, t.Constants, t.Window
    exact_vec, GridInputs = types(dim, "float64").vec, input_types(spec).GridInputs
    point, Outline, one = (
        surface_point(dim, spec.dtype, packed),
        outline_type(dim, spec.dtype),
        wall_face(spec),
    )
    Particles, Table, point_of, share = point.Particles, point.Table, point.point_of, point.share
    weights, offset, node_index, size = s.weights, s.offset, s.node_index, s.count
    face, depth, friction_of = one.face, one.depth, one.friction_of
    block = surface_contact(dim, spec.dtype)
    touch, Touch = block.touch, block.Touch
    running, report = status.report(dim, spec.dtype).running, status.report(dim, spec.dtype).report
    walls = spec.surface_walls
    count, number = len(walls), wp.types.vector(len(walls), wp.int32)(*walls)  # among all walls
    in_wall, module = int(Kind.IN_WALL), module_of(spec.module + ".surface", packed)

    @wp.func
    def add_load(
        constants: Constants,
        window: Window,
        outline: Outline,
        now: Particles,
        world: int,
        p: int,
        owner: int,
        load: wp.array2d(dtype=real),
    ):
        """The point's part of L (K9)"""
        at = point_of(constants, window, outline, now, world, p, owner)
        w = weights(at.fx)
        area = outline.areas[p]
        for n in range(size):
            i = node_index(at.base, offset(n), window.shape)
            wp.atomic_add(load, world, i, area * wp.abs(share(at, w, n)))

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
    def add_loads(
        # Parameters:
        constants: Constants,
        window: Window,
        outline: Outline,
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        # Out, added into:
        load: wp.array2d(dtype=real),
    ):
        world, p = wp.tid()
        add_load(constants, window, outline, now, world, p, owner[world, p], load)

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
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        anchor: wp.array3d(dtype=vec),
        node: wp.array2d(dtype=node_vec),
        free: wp.array2d(dtype=vec),  # v*
        load: wp.array2d(dtype=real),
        # In and out:
        words: wp.array(dtype=wp.int64),
        force: wp.array3d(dtype=vec),
        # Out:
        new_anchor: wp.array3d(dtype=vec),
        # Out, added into:
        velocity: wp.array2d(dtype=vec),  # v'
    ):
        world, p = wp.tid()
        alive = running(words, world)
        at = point_of(constants, window, outline, now, world, p, owner[world, p])
        w = weights(at.fx)
        heaviness = Table()  # masses
        v = vec()
        D = real(0.0)
        for n in range(size):
            i = node_index(at.base, offset(n), window.shape)
            heaviness[n] = node[world, i][dim]
            b = share(at, w, n)
            v += b * free[world, i]
            if heaviness[n] > real(0.0):
                D += wp.abs(b) * load[world, i] / heaviness[n]
        total = vec()
        for q in range(count):
            k = number[q]
            before = anchor[world, q, p]
            pushed = force[world, q, p]
            wall = face(constants, inputs, world, k, at.x, before)
            found = meet(
                constants, inputs, outline, smoothing, world, k, p, wall.n, wall.y, at.x, v, wall.anchor, D
            )
            total += found.J
            v += D * found.J
            if anew == 1:
                pushed = vec()
            if alive:
                if wall.depth > outline.deepest[p]:
                    report(words, world, wp.max(substep - 1, 0), in_wall, q * owner.shape[1] + p)
                new_anchor[world, q, p] = found.anchor
                force[world, q, p] = pushed + (rate[0] * outline.newtons[p]) * found.J
            else:
                new_anchor[world, q, p] = before
        if alive and wp.dot(total, total) > real(0.0):
            impulse = outline.areas[p] * total
            for n in range(size):
                if heaviness[n] > real(0.0):
                    i = node_index(at.base, offset(n), window.shape)
                    wp.atomic_add(velocity, world, i, (share(at, w, n) / heaviness[n]) * impulse)

    @wp.kernel(module=module, enable_backward=False)
    def check_end(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        window: Window,
        outline: Outline,
        later: wp.float64,  # than the inputs [s]
        substep: int,
        owner: wp.array2d(dtype=wp.int32),
        # In:
        now: Particles,
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        """Check the depth of the points in the final state of a chunk, with the inputs of its last substep."""
        world, p = wp.tid()
        at = point_of(constants, window, outline, now, world, p, owner[world, p])
        for q in range(count):
            if depth(inputs, world, number[q], later, at.x) > outline.deepest[p]:
                report(words, world, substep, in_wall, q * owner.shape[1] + p)

    return SimpleNamespace(
        add_loads=add_loads,
        press=press,
        check_end=check_end,
        add_load=add_load,
        meet=meet,
        number=number,
    )


@kernel_factory
def start_depth(spec: Spec) -> wp.Kernel:
    """Kernel that checks the depth of the points in the initial state of a call."""
    exact_vec, Outline = types(spec.dim, "float64").vec, outline_type(spec.dim, spec.dtype)
    depth, GridInputs = wall_face(spec).depth, input_types(spec).GridInputs
    report, in_wall = status.report(spec.dim, spec.dtype).report, int(Kind.IN_WALL)
    walls = spec.surface_walls
    count, number = len(walls), wp.types.vector(len(walls), wp.int32)(*walls)

    @wp.kernel(module=module_of(spec.module + ".surface.start", packed=False), enable_backward=False)
    def check_start(
        # Parameters:
        inputs: GridInputs,
        outline: Outline,
        # In:
        x: wp.array2d(dtype=exact_vec),
        # Out:
        words: wp.array(dtype=wp.int64),
    ):
        world, p = wp.tid()
        for q in range(count):
            if depth(inputs, world, number[q], wp.float64(0.0), x[world, p]) > outline.deepest[p]:
                report(words, world, 0, in_wall, q * x.shape[1] + p)

    return check_start
