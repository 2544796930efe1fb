"""MLS-MPM in Warp as it is usually written: three kernels, one atomic addition per node, Warp's generated adjoint.

A peer in bench/peers.py, with the physics of docs/math/transfer.md: neo-Hookean, APIC, quadratic B-splines, float32. Every state
of a run is stored; the backward pass recomputes the grid of each substep. Forward and backward are one CUDA graph each.
"""

import functools
from types import SimpleNamespace

import numpy as np
import warp as wp

LIGHT = wp.constant(1e-18)
"""Nodes up to this mass [kg] count as empty: the generated adjoint divides by its square, and their content is below rounding."""


@functools.lru_cache(maxsize=None)
def kernels(dim: int) -> SimpleNamespace:
    vec, mat = wp.types.vector(dim, float), wp.types.matrix((dim, dim), float)
    ivec = wp.types.vector(dim, int)
    table = wp.types.matrix((3, dim), float)  # [offset, axis]
    count = 3**dim
    kernel = functools.partial(wp.kernel, module="unique", module_options={"max_unroll": 27})

    @wp.func
    def base_node(x: vec, dx: float) -> ivec:
        base = ivec()
        for axis in range(dim):
            base[axis] = int(x[axis] / dx - 0.5)
        return base

    @wp.func
    def from_base(x: vec, dx: float, base: ivec) -> vec:
        fx = vec()
        for axis in range(dim):
            fx[axis] = x[axis] / dx - float(base[axis])
        return fx

    @wp.func
    def weights(fx: vec) -> table:
        w = table()
        for axis in range(dim):
            f = fx[axis]
            w[0, axis] = 0.5 * (1.5 - f) * (1.5 - f)
            w[1, axis] = 0.75 - (f - 1.0) * (f - 1.0)
            w[2, axis] = 0.5 * (f - 0.5) * (f - 0.5)
        return w

    if dim == 2:

        @wp.func
        def offset(n: int) -> ivec:
            return ivec(n / 3, n % 3)

        @wp.func
        def weight(w: table, o: ivec) -> float:
            return w[o[0], 0] * w[o[1], 1]

        @wp.func
        def node(base: ivec, o: ivec, nodes: int) -> int:
            return (base[0] + o[0]) * nodes + base[1] + o[1]
    else:

        @wp.func
        def offset(n: int) -> ivec:
            return ivec(n / 9, (n / 3) % 3, n % 3)

        @wp.func
        def weight(w: table, o: ivec) -> float:
            return w[o[0], 0] * w[o[1], 1] * w[o[2], 2]

        @wp.func
        def node(base: ivec, o: ivec, nodes: int) -> int:
            return ((base[0] + o[0]) * nodes + base[1] + o[1]) * nodes + base[2] + o[2]

    @wp.func
    def distance(o: ivec, fx: vec, dx: float) -> vec:
        r = vec()
        for axis in range(dim):
            r[axis] = (float(o[axis]) - fx[axis]) * dx
        return r

    @kernel
    def p2g(
        # Parameters:
        nodes: int,
        dx: float,
        dt: float,
        mass: float,
        volume: float,
        mu: float,
        lam: float,
        # In:
        x: wp.array(dtype=vec),
        v: wp.array(dtype=vec),
        C: wp.array(dtype=mat),
        F: wp.array(dtype=mat),
        # Out, added into:
        node_momentum: wp.array(dtype=vec),
        node_mass: wp.array(dtype=float),
    ):
        p = wp.tid()
        base = base_node(x[p], dx)
        fx = from_base(x[p], dx, base)
        w = weights(fx)
        eye = wp.identity(n=dim, dtype=float)
        tau = mu * (F[p] * wp.transpose(F[p]) - eye) + lam * wp.log(wp.determinant(F[p])) * eye
        A = mass * C[p] - (4.0 * dt * volume / (dx * dx)) * tau
        for n in range(count):
            o = offset(n)
            share = weight(w, o)
            i = node(base, o, nodes)
            wp.atomic_add(node_momentum, i, share * (mass * v[p] + A * distance(o, fx, dx)))
            wp.atomic_add(node_mass, i, share * mass)

    @kernel
    def grid(
        # Parameters:
        dt: float,
        gravity: vec,
        # In:
        node_momentum: wp.array(dtype=vec),
        node_mass: wp.array(dtype=float),
        # Out:
        velocity: wp.array(dtype=vec),
    ):
        i = wp.tid()
        if node_mass[i] > LIGHT:
            velocity[i] = node_momentum[i] / node_mass[i] + dt * gravity

    @kernel
    def g2p(
        # Parameters:
        nodes: int,
        dx: float,
        dt: float,
        # In:
        velocity: wp.array(dtype=vec),
        x: wp.array(dtype=vec),
        F: wp.array(dtype=mat),
        # Out:
        new_x: wp.array(dtype=vec),
        new_v: wp.array(dtype=vec),
        new_C: wp.array(dtype=mat),
        new_F: wp.array(dtype=mat),
    ):
        p = wp.tid()
        base = base_node(x[p], dx)
        fx = from_base(x[p], dx, base)
        w = weights(fx)
        v = vec()
        B = mat()
        for n in range(count):
            o = offset(n)
            share = weight(w, o) * velocity[node(base, o, nodes)]
            v += share
            B += wp.outer(share, distance(o, fx, dx))
        C = (4.0 / (dx * dx)) * B
        new_x[p] = x[p] + dt * v
        new_v[p] = v
        new_C[p] = C
        new_F[p] = F[p] + dt * (C * F[p])

    return SimpleNamespace(vec=vec, mat=mat, p2g=p2g, grid=grid, g2p=g2p)


class NaiveWarp:
    """One run of ``substeps`` substeps of a case of bench/peers.py, and its gradient.

    Attributes:
        states: x, v, C, F of every substep.
        adj: Adjoints of two states, used alternately; the adjoint of the start is ``adj[0]``.
    """

    def __init__(self, case: dict[str, np.ndarray], substeps: int, device: str):
        self.dim, self.substeps, self.device = int(case["dim"]), substeps, wp.get_device(device)
        self.nodes, self.count = int(case["nodes"]), len(case["x"])
        self.dx, self.dt = float(case["dx"]), float(case["dt"])
        self.material = [float(case[name]) for name in ("mass", "volume", "mu", "lam")]
        self.k = kernels(self.dim)
        self.gravity = self.k.vec(*case["gravity"].tolist())
        self.states = [self._state() for _ in range(substeps + 1)]
        self.adj = [self._state(), self._state()]
        eye = np.broadcast_to(np.eye(self.dim, dtype=np.float32), (self.count, self.dim, self.dim))
        for name, value in (("x", case["x"]), ("v", case["v"]), ("F", eye)):
            getattr(self.states[0], name).assign(np.ascontiguousarray(value))
        self.seed = wp.array(case["seed"], dtype=self.k.vec, device=self.device)
        self.grid, self.adj_grid = self._grid(), self._grid()
        self.forward = self._recorded(self._forward)
        self.backward = self._recorded(self._backward)

    def end(self) -> np.ndarray:
        return self.states[-1].x.numpy()

    def adj_v(self) -> np.ndarray:
        return self.adj[0].v.numpy()

    def _zeros(self, count: int, dtype) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=self.device)

    def _state(self) -> SimpleNamespace:
        shapes = {"x": self.k.vec, "v": self.k.vec, "C": self.k.mat, "F": self.k.mat}
        return SimpleNamespace(**{name: self._zeros(self.count, dtype) for name, dtype in shapes.items()})

    def _grid(self) -> SimpleNamespace:
        count = self.nodes**self.dim
        return SimpleNamespace(
            momentum=self._zeros(count, self.k.vec),
            mass=self._zeros(count, float),
            velocity=self._zeros(count, self.k.vec),
        )

    def _recorded(self, work):
        """``work`` as a CUDA graph; on the CPU as it is."""
        work()
        if not self.device.is_cuda:
            return work
        with wp.ScopedCapture(self.device) as capture:
            work()
        return functools.partial(wp.capture_launch, capture.graph)

    def _launch(self, kernel, count: int, inputs: list, outputs: list, adj: tuple[list, list] | None = None):
        """The kernel, or its generated adjoint."""
        given = {} if adj is None else {"adj_inputs": adj[0], "adj_outputs": adj[1], "adjoint": True}
        wp.launch(kernel, count, inputs=inputs, outputs=outputs, device=self.device, **given)

    def _scatter(self, now):
        """P2G and grid of one substep."""
        grid = self.grid
        grid.momentum.zero_()
        grid.mass.zero_()
        scale = [self.nodes, self.dx, self.dt]
        inputs = [*scale, *self.material, now.x, now.v, now.C, now.F]
        self._launch(self.k.p2g, self.count, inputs, [grid.momentum, grid.mass])
        inputs = [self.dt, self.gravity, grid.momentum, grid.mass]
        self._launch(self.k.grid, len(grid.mass), inputs, [grid.velocity])

    def _forward(self):
        for now, then in zip(self.states, self.states[1:], strict=False):
            self._scatter(now)
            inputs = [self.nodes, self.dx, self.dt, self.grid.velocity, now.x, now.F]
            self._launch(self.k.g2p, self.count, inputs, [then.x, then.v, then.C, then.F])

    def _backward(self):
        first = self.adj[self.substeps % 2]
        for array in vars(first).values():
            array.zero_()
        wp.copy(first.x, self.seed)
        for substep in reversed(range(self.substeps)):
            now, then = self.states[substep], self.states[substep + 1]
            adj_now, adj_then = self.adj[substep % 2], self.adj[(substep + 1) % 2]
            self._scatter(now)
            self._scatter_adj(now, then, adj_now, adj_then)

    def _scatter_adj(self, now, then, adj_now, adj_then):
        """The adjoints of G2P, grid and P2G of one substep."""
        grid, adj = self.grid, self.adj_grid
        for array in (*vars(adj).values(), *vars(adj_now).values()):
            array.zero_()
        scale = [self.nodes, self.dx, self.dt]
        self._launch(
            self.k.g2p,
            self.count,
            [*scale, grid.velocity, now.x, now.F],
            [then.x, then.v, then.C, then.F],
            ([0, 0.0, 0.0, adj.velocity, adj_now.x, adj_now.F], list(vars(adj_then).values())),
        )
        self._launch(
            self.k.grid,
            len(grid.mass),
            [self.dt, self.gravity, grid.momentum, grid.mass],
            [grid.velocity],
            ([0.0, self.k.vec(), adj.momentum, adj.mass], [adj.velocity]),
        )
        self._launch(
            self.k.p2g,
            self.count,
            [*scale, *self.material, now.x, now.v, now.C, now.F],
            [grid.momentum, grid.mass],
            ([0, *[0.0] * 6, *vars(adj_now).values()], [adj.momentum, adj.mass]),
        )
