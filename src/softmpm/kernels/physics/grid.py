"""Grid stage: nodal momentum to nodal velocity. Derivation: docs/math/grid.md.

    u = p / m                                                                                        (G1)
    v = W_k(... W_1(exp(−γ Δt) (u + Δt g)))   with the walls W_1 … W_k in the order of the scene     (G2)

Empty nodes get zero in both directions; in the fast scheme they keep what they held (kernels/fast/g2p2g.py). The adjoint is in
grid_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.physics.contact import wall
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def grid(spec: Spec) -> SimpleNamespace:
    t = types(spec.dim, spec.dtype)
    real, vec, ivec, node_vec, Constants = t.real, t.vec, t.ivec, t.node, t.Constants
    GridInputs, dim, given = input_types(spec).GridInputs, spec.dim, spec.given
    exact_vec = types(spec.dim, "float64").vec
    nodes = spline(spec.dim, spec.dtype)
    node_coordinates, momentum = nodes.node_coordinates, nodes.momentum

    @wp.func
    def position(constants: Constants, node: ivec) -> exact_vec:
        """Position of a node at rest [m]; in float64, so that both precisions put it on the same side of a wall."""
        x = exact_vec()
        for axis in range(dim):
            x[axis] = wp.float64(node[axis]) * constants.exact_spacing
        return x

    @wp.func
    def gravity(constants: Constants, inputs: GridInputs, world: int) -> vec:
        if wp.static("gravity" in given):
            return inputs.gravity[world]
        else:
            return constants.gravity

    @wp.func
    def decay(constants: Constants, inputs: GridInputs, world: int) -> real:
        """exp(−γ Δt)."""
        if wp.static("damping" in given):
            return inputs.decay[world]
        else:
            return constants.decay

    @wp.func
    def accelerated(constants: Constants, inputs: GridInputs, world: int, u: vec) -> vec:
        """w = u + Δt g."""
        w = u
        if wp.static(spec.gravity):
            w += constants.dt * gravity(constants, inputs, world)
        return w

    @wp.func
    def damped(constants: Constants, inputs: GridInputs, world: int, w: vec) -> vec:
        v = w
        if wp.static(spec.damping):
            v = decay(constants, inputs, world) * w
        return v

    def after_walls(count: int) -> wp.Function:
        """v after the first ``count`` walls (G2)."""
        if count == 0:

            @wp.func
            def after(constants: Constants, inputs: GridInputs, world: int, x: exact_vec, v: vec) -> vec:
                return v
        elif count - 1 not in spec.node_walls:
            return after_walls(count - 1)
        else:
            before, last = after_walls(count - 1), wall(spec, count - 1)
            inside, meet = last.inside, last.meet

            @wp.func
            def after(constants: Constants, inputs: GridInputs, world: int, x: exact_vec, v: vec) -> vec:
                w = before(constants, inputs, world, x, v)
                if inside(inputs, world, x):
                    w = meet(inputs, world, x, w)
                return w

        return after

    after_all_walls = after_walls(len(spec.contacts))

    @wp.func
    def after_free(
        constants: Constants, inputs: GridInputs, world: int, x: exact_vec, w: vec, m: real
    ) -> vec:
        """Velocity of the node at ``x`` [m] from that without damping and walls."""
        v = vec()
        if m > real(0.0):
            v = after_all_walls(constants, inputs, world, x, damped(constants, inputs, world, w))  # (G2)
        return v

    @wp.func
    def node_velocity(
        constants: Constants, inputs: GridInputs, world: int, x: exact_vec, p: vec, m: real
    ) -> vec:
        """Velocity of the node at ``x`` [m] from its momentum and mass."""
        v = vec()
        if m > real(0.0):
            w = accelerated(constants, inputs, world, p / m)  # (G1)
            v = after_free(constants, inputs, world, x, w, m)
        return v

    @wp.func
    def increment(constants: Constants, inputs: GridInputs, world: int, impulse: vec, per_m: real) -> vec:
        """Change of the velocity of a node by the impulse of its forces [N s] and by gravity, with 1/m, or 0 without mass."""
        dv = per_m * impulse
        if wp.static(spec.gravity):
            if per_m > real(0.0):
                dv += constants.dt * gravity(constants, inputs, world)
        return dv

    @kernel()
    def grid_velocity(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        # In:
        node: wp.array2d(dtype=node_vec),
        # Out:
        velocity: wp.array2d(dtype=vec),
    ):
        world, n = wp.tid()
        node_n = node[world, n]
        x = position(constants, node_coordinates(n, constants.shape))
        velocity[world, n] = node_velocity(constants, inputs, world, x, momentum(node_n), node_n[dim])

    return SimpleNamespace(
        position=position,
        gravity=gravity,
        accelerated=accelerated,
        damped=damped,
        node_velocity=node_velocity,
        increment=increment,
        after_free=after_free,
        grid_velocity=grid_velocity,
    )
