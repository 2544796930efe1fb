"""Affine fit to the nodes around a surface point, weighted by their mass: its share in each. Derivation: docs/math/contact.md.

With k_i = w_i m_i, M = Σ k_i, r = x_i − x_s in cells, r̂ = Σ k_i r_i / M, d_i = r_i − r̂:

    K = Σ k_i d_i d_iᵀ / M + ε I,  z = K⁻¹ r̂,  g_i = 1 − z·d_i,  b_i = w_i g_i / M                    (K8)

m_i b_i is the weight of a node: Σ m_i b_i = 1 and, but for ε, Σ m_i b_i r_i = 0. b_i itself stays bounded where m_i vanishes. The
adjoint is in kernels/plain/surface_adj.py.
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
    weights, offset, position, weight, node_index = s.weights, s.offset, s.position, s.weight, s.node_index
    exact_vec, count = types(dim, "float64").vec, s.count

    @wp.struct
    class Place:
        base: ivec
        fx: vec
        valid: bool

    @wp.struct
    class Fit:
        mass: real  # M
        mean: vec  # r̂
        inverse: mat  # K⁻¹
        lean: vec  # z

    @wp.func
    def place(x: exact_vec, spacing: wp.float64, shape: ivec) -> Place:
        """Base node and fraction of a point; not valid if it is not finite or off the grid, and then at the first node."""
        out = Place()
        out.valid = True
        for axis in range(dim):
            cell = x[axis] / spacing
            first = wp.floor(cell - wp.float64(0.5))
            if first >= wp.float64(0.0) and first <= wp.float64(shape[axis] - 3):
                out.base[axis] = int(first)
            else:
                out.valid = False
            out.fx[axis] = real(cell - wp.float64(out.base[axis]))
        return out

    @wp.func
    def fit(node: wp.array2d(dtype=node_vec), world: int, at: Place, shape: ivec) -> Fit:
        """Mass, place and spread of the nodes around a point; a mass of zero if there is none."""
        w = weights(at.fx)
        out = Fit()
        moment = vec()
        for n in range(count):
            o = offset(n)
            k = weight(w, o) * node[world, node_index(at.base, o, shape)][dim]
            out.mass += k
            moment += k * (position(o) - at.fx)
        if out.mass > real(0.0):
            out.mean = moment / out.mass
            spread = real(SPREAD) * wp.identity(n=dim, dtype=real)
            for n in range(count):
                o = offset(n)
                k = weight(w, o) * node[world, node_index(at.base, o, shape)][dim]
                d = position(o) - at.fx - out.mean
                spread += wp.outer((k / out.mass) * d, d)
            out.inverse = wp.inverse(spread)
            out.lean = out.inverse * out.mean
        return out

    return SimpleNamespace(Place=Place, place=place, fit=fit)
