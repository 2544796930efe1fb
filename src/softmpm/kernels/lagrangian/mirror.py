"""Clamps and planes of symmetry: the images of a node move as one. Derivation: docs/math/mirror.md.

    w = Σ m_i s_i v_i / M,  M = Σ m_i  over the nodes of a group,  v'_i = s_i w,  u'_i = u_i + Δt v'_i    (B1)
    R = (1/T) Σ m_i (v'_i − v_i),  the mean force of the constraint in a control step of T seconds           (B3)
    ā_i = v̄'_i + m_i R̄/T,  w̄ = Σ s_i ā_i,  v̄_i = m_i (s_i w̄/M − R̄/T)
    m̄_i += (s_i v_i − w)·w̄ / M + (v'_i − v_i)·R̄/T                                               (B1.adj), (B3.adj)

with the signs s_i axis by axis.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.nodes import nodes
from softmpm.kernels.lagrangian.rest import LAGRANGIAN, rest
from softmpm.kernels.physics import status
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.structs import Spec, input_types, types


@kernel_factory
def mirror_type(dim: int, dtype: str):
    class Mirror:
        """See :class:`softmpm.mirror_grid.MirrorGrid`."""

        members: wp.array2d(dtype=wp.int32)
        signs: wp.array(dtype=types(dim, dtype).vec)

    return wp.struct(Mirror, module=f"softmpm.types.d{dim}.{dtype}")


@kernel_factory
def mirror(spec: Spec) -> SimpleNamespace:
    t, Mirror = types(spec.dim, spec.dtype), mirror_type(spec.dim, spec.dtype)
    real, vec, Constants = t.real, t.vec, t.Constants
    running = status.report(spec.dim, spec.dtype).running

    @wp.func
    def total_mass(groups: Mirror, mass: wp.array2d(dtype=real), world: int, g: int) -> real:
        """M of (B1)."""
        total = real(0.0)
        for k in range(groups.members.shape[1]):
            i = groups.members[g, k]
            if i < mass.shape[1]:
                total += mass[world, i]
        return total

    @wp.func
    def mean(
        groups: Mirror,
        mass: wp.array2d(dtype=real),
        nodal: wp.array2d(dtype=vec),
        total: real,
        world: int,
        g: int,
    ) -> vec:
        """w of (B1)."""
        w = vec()
        for k in range(groups.members.shape[1]):
            i = groups.members[g, k]
            if i < mass.shape[1]:
                w += (mass[world, i] / total) * wp.cw_mul(groups.signs[i], nodal[world, i])
        return w

    @kernel(LAGRANGIAN)
    def reflect(
        # Parameters:
        constants: Constants,
        groups: Mirror,
        mass: wp.array2d(dtype=real),
        rate: wp.array(dtype=real),  # 1/T, in the unit of force
        anew: int,  # 1 at the beginning of a control step
        words: wp.array(dtype=wp.int64),
        # In:
        u: wp.array2d(dtype=vec),
        # In and out:
        reaction: wp.array2d(dtype=vec),
        v: wp.array2d(dtype=vec),
        # Out:
        new_u: wp.array2d(dtype=vec),
    ):
        world, g = wp.tid()
        total = total_mass(groups, mass, world, g)
        if running(words, world) and total > real(0.0):
            w = mean(groups, mass, v, total, world, g)
            impulse = vec()
            for k in range(groups.members.shape[1]):
                i = groups.members[g, k]
                if i < mass.shape[1]:
                    if mass[world, i] > real(0.0):
                        new = wp.cw_mul(groups.signs[i], w)
                        impulse += mass[world, i] * (new - v[world, i])
                        v[world, i] = new
                        new_u[world, i] = u[world, i] + constants.dt * new
            pulled = rate[0] * impulse
            if anew == 0:
                pulled += reaction[world, g]
            reaction[world, g] = pulled

    return SimpleNamespace(total_mass=total_mass, mean=mean, reflect=reflect)


@kernel_factory
def mirror_adj(spec: Spec) -> SimpleNamespace:
    t, one, Mirror = types(spec.dim, spec.dtype), mirror(spec), mirror_type(spec.dim, spec.dtype)
    real, vec, Constants, Rest = t.real, t.vec, t.Constants, rest(spec.dim, spec.dtype).Rest
    GridInputs, after_free = input_types(spec).GridInputs, grid(spec).after_free
    node_of, exact = nodes(spec).node_of, frame(spec.dim, spec.dtype).exact
    total_mass, mean = one.total_mass, one.mean

    @kernel(LAGRANGIAN)
    def free_again(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        inside: Rest,
        mass: wp.array2d(dtype=real),
        # In:
        u: wp.array2d(dtype=vec),
        w: wp.array2d(dtype=vec),
        # Out:
        v: wp.array2d(dtype=vec),
    ):
        """Velocity before the reflection."""
        world, i = wp.tid()
        node = node_of(constants, inside, mass, world, i)
        here = node.rest + exact(u[world, i])  # such worlds have no shift
        v[world, i] = after_free(constants, inputs, world, here, w[world, i], node.m)

    @kernel(LAGRANGIAN)
    def reflect_adj(
        # Parameters:
        groups: Mirror,
        mass: wp.array2d(dtype=real),
        moved: real,  # Δt if v' moved the nodes and (Q4.adj) is still to come, else 0
        rate: wp.array(dtype=real),
        anew: int,
        # In:
        v: wp.array2d(dtype=vec),
        adj_u: wp.array2d(dtype=vec),
        # In and out:
        adj_reaction: wp.array2d(dtype=vec),
        adj_v: wp.array2d(dtype=vec),
        # Out, added into:
        adj_mass: wp.array2d(dtype=real),
    ):
        """(B1.adj) of v̄' + Δt ū', less the Δt ū' that (Q4.adj) adds."""
        world, g = wp.tid()
        total = total_mass(groups, mass, world, g)
        if total > real(0.0):
            w = mean(groups, mass, v, total, world, g)
            pull = rate[0] * adj_reaction[world, g]
            adj_w = vec()
            for k in range(groups.members.shape[1]):
                i = groups.members[g, k]
                if i < mass.shape[1]:
                    if mass[world, i] > real(0.0):
                        adj_new = adj_v[world, i] + moved * adj_u[world, i] + mass[world, i] * pull
                        adj_w += wp.cw_mul(groups.signs[i], adj_new)
            adj_w = adj_w / total
            for k in range(groups.members.shape[1]):
                i = groups.members[g, k]
                if i < mass.shape[1]:
                    s = groups.signs[i]
                    old = v[world, i]
                    adj_v[world, i] = mass[world, i] * (wp.cw_mul(s, adj_w) - pull) - moved * adj_u[world, i]
                    from_mass = wp.dot(wp.cw_mul(s, old) - w, adj_w) + wp.dot(wp.cw_mul(s, w) - old, pull)
                    adj_mass[world, i] = adj_mass[world, i] + from_mass
            if anew == 1:  # the mean before is dropped
                adj_reaction[world, g] = vec()

    return SimpleNamespace(free_again=free_again, reflect_adj=reflect_adj)
