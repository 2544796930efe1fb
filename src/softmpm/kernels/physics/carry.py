"""Way of an anchor on a wall that turns from one pose to another about the line that both planes share, in float64.

With the unit normals and offsets n°, o° before and n, o after, and c = n·n°

    a = a° + [(o° + o)(n° − c n) − (n·a°)(n° + n)] / (1 + c)                                         (K6)

    with q = ((n° + n)·ā)/(1 + c),  r = ((n° − c n)·ā)/(1 + c),  h = (o° + o)/(1 + c),  l = (n·a°)/(1 + c):
    ā° += ā − q n,  ō° += r,  ō += r,  c̄ = l q − h r − h n·ā                                         (K6.adj)
    n̄° += (h − l) ā + c̄ n,  n̄ += c̄ n° − (c h + l) ā − q a°
    normal and offset before the division by |a|:  (n̄ − (n·n̄ + o ō) n)/|a|,  ō/|a|                   (C4.adj)

Derivation: docs/math/contact.md.
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.structs import types


@kernel_factory
def carry(dim: int) -> SimpleNamespace:
    real, vec = types(dim, "float64").real, types(dim, "float64").vec

    @wp.struct
    class Pose:
        n: vec  # of unit length
        o: real
        length: real  # |a| of (C4)

    @wp.struct
    class WayAdj:
        anchor: vec
        normal: vec  # of both poses
        offset: real
        late_normal: vec  # of the later pose alone
        late_offset: real

    @wp.func
    def way(before: Pose, now: Pose, anchor: vec) -> vec:
        cosine = wp.dot(now.n, before.n)
        turned = (before.o + now.o) * (before.n - cosine * now.n) - wp.dot(now.n, anchor) * (before.n + now.n)
        return turned / (real(1.0) + cosine)

    @wp.func
    def plane_adj(at: Pose, adj_n: vec, adj_o: real) -> vec:
        """(C4.adj) of the normal."""
        return (adj_n - (wp.dot(at.n, adj_n) + at.o * adj_o) * at.n) / at.length

    @wp.func
    def way_adj(before: Pose, now: Pose, anchor: vec, adj: vec, adj_n: vec, adj_o: real) -> WayAdj:
        """Adjoints of ``anchor`` and of the poses, of which the later one has ``adj_n`` and ``adj_o`` besides."""
        n = now.n
        cosine = wp.dot(n, before.n)
        size = real(1.0) + cosine
        q = wp.dot(before.n + n, adj) / size
        r = wp.dot(before.n - cosine * n, adj) / size
        h = (before.o + now.o) / size
        lean = wp.dot(n, anchor) / size
        adj_cosine = lean * q - h * r - h * wp.dot(n, adj)
        adj_before = (h - lean) * adj + adj_cosine * n
        adj_now = adj_n + adj_cosine * before.n - (cosine * h + lean) * adj - q * anchor
        out = WayAdj()
        out.anchor = adj - q * n
        out.late_normal = plane_adj(now, adj_now, adj_o + r)
        out.late_offset = (adj_o + r) / now.length
        out.normal = out.late_normal + plane_adj(before, adj_before, r)
        out.offset = out.late_offset + r / before.length
        return out

    return SimpleNamespace(Pose=Pose, way=way, way_adj=way_adj)
