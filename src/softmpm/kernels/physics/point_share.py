"""Affine fit to the nodes around a surface point, weighted by their mass: its share in each. Derivation: docs/math/contact.md.

With k_i = w_i m_i, M = Σ k_i, r = x_i − x_s in cells, r̂ = Σ k_i r_i / M, d_i = r_i − r̂:

    K = Σ k_i d_i d_iᵀ / M + ε I,  z = K⁻¹ r̂,  g_i = 1 − z·d_i,  b_i = w_i g_i / M                    (K8)

m_i b_i is the weight of a node: Σ m_i b_i = 1 and, but for ε, Σ m_i b_i r_i = 0. b_i itself stays bounded where m_i vanishes. The
adjoint is in kernels/carried/surface_adj.py.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.spline import spline
from softmpm.kernels.structs import types

SPREAD = 1e-6
"""ε [cells²]: where all mass lies on nodes in a line or a plane, the motion across it is taken to be constant."""


@kernel_factory
def point_share(dim: int, dtype: str) -> SimpleNamespace:
    t, s = types(dim, dtype), spline(dim, dtype)
    real, vec, mat, ivec, node_vec = t.real, t.vec, t.mat, t.ivec, t.node
    offset, position, weight, node_index = s.offset, s.position, s.weight, s.node_index
    exact_vec, count, weight_table = types(dim, "float64").vec, s.count, wp.types.matrix((3, dim), real)
    Table = wp.types.vector(count, real)  # one number for each node

    @wp.struct
    class Place:
        base: ivec  # counted from the first node of the window
        fx: vec
        valid: bool
        beyond: bool  # nodes around it are in the window, but not all

    @wp.struct
    class Fit:
        mass: real  # M
        mean: vec  # r̂
        inverse: mat  # K⁻¹
        lean: vec  # z

    @wp.func
    def place(x: exact_vec, spacing: wp.float64, shape: ivec, origin: ivec, held: ivec) -> Place:
        """Base node and fraction of a point, on a grid of which ``held`` nodes along each axis from ``origin`` on are in memory.

        Not valid if it is not finite or not all nodes around it are there, and then at the first node.
        """
        out = Place()
        on_grid = bool(True)
        inside = bool(True)
        near = bool(True)
        away = exact_vec()
        for axis in range(dim):
            cell = x[axis] / spacing
            first = wp.floor(cell - wp.float64(0.5))
            away[axis] = first - wp.float64(origin[axis])
            last = wp.float64(held[axis] - 3)
            on_grid = on_grid and first >= wp.float64(0.0) and first <= wp.float64(shape[axis] - 3)
            inside = inside and away[axis] >= wp.float64(0.0) and away[axis] <= last
            near = near and away[axis] >= wp.float64(-2.0) and away[axis] <= last + wp.float64(2.0)
            out.fx[axis] = real(cell - first)
        out.valid = on_grid and inside
        out.beyond = on_grid and near and not inside
        for axis in range(dim):
            if out.valid:
                out.base[axis] = int(away[axis])
        return out

    @wp.func
    def masses_of(node: wp.array2d(dtype=node_vec), world: int, base: ivec, shape: ivec) -> Table:
        """Masses of the nodes around a point."""
        masses = Table()
        for n in range(count):
            masses[n] = node[world, node_index(base, offset(n), shape)][dim]
        return masses

    @wp.func
    def fit(masses: Table, w: weight_table, fx: vec) -> Fit:
        """Mass, place and spread of the nodes around a point; a mass of zero if there is none."""
        out = Fit()
        moment = vec()
        for n in range(count):
            o = offset(n)
            k = weight(w, o) * masses[n]
            out.mass += k
            moment += k * (position(o) - fx)
        if out.mass > real(0.0):
            out.mean = moment / out.mass
            spread = mat()
            for n in range(count):
                o = offset(n)
                d = position(o) - fx - out.mean
                spread += wp.outer((weight(w, o) * masses[n]) * d, d)
            out.inverse = wp.inverse(spread / out.mass + real(SPREAD) * wp.identity(n=dim, dtype=real))
            out.lean = out.inverse * out.mean
        return out

    @wp.func
    def share_of(around: Fit, w: weight_table, fx: vec, n: int) -> real:
        """b of node ``n`` (K8)"""
        o = offset(n)
        arm = position(o) - fx - around.mean
        return weight(w, o) / around.mass * (real(1.0) - wp.dot(around.lean, arm))

    return SimpleNamespace(
        Place=Place, Fit=Fit, Table=Table, place=place, masses_of=masses_of, fit=fit, share_of=share_of
    )
