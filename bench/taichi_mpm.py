"""MLS-MPM in Taichi, the DiffTaichi scheme: `python bench/taichi_mpm.py folder --device cuda`. A peer in bench/peers.py.

The same physics as bench/naive_warp.py. Every state of a run is stored with its adjoint, the grid once; the backward pass
recomputes the grid of a substep and calls Taichi's generated gradients (Hu et al. 2020, "DiffTaichi"). Sizes are arguments of the
kernels, so that the cases of one dimension share them: in 3D their gradients take a minute to compile.

For each case.npz of the folder, case.result.npz gets the ends, the gradients and the seconds. Needs Taichi and NumPy only.
"""

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
import taichi as ti


@ti.func
def weights(fx):
    # Products: the generated gradient of a power takes the logarithm of its base.
    a, b, c = 1.5 - fx, fx - 1.0, fx - 0.5
    return 0.5 * a * a, 0.75 - b * b, 0.5 * c * c


@ti.func
def share_2d(w, offset: ti.template()):
    return w[offset[0]][0] * w[offset[1]][1]


@ti.func
def share_3d(w, offset: ti.template()):
    return w[offset[0]][0] * w[offset[1]][1] * w[offset[2]][2]


@ti.func
def node_2d(i, nodes):
    return i[0] * nodes + i[1]


@ti.func
def node_3d(i, nodes):
    return (i[0] * nodes + i[1]) * nodes + i[2]


# Not A @ B: after the loop of G2P, the generated gradient of Taichi 1.7.4 reads sums of it that it never stored.
@ti.func
def product_2d(A, B):
    return A[:, 0].outer_product(B[0, :]) + A[:, 1].outer_product(B[1, :])


@ti.func
def product_3d(A, B):
    return product_2d(A, B) + A[:, 2].outer_product(B[2, :])


# Not A @ r, and sums over offsets from the base node: in 3D the gradients compile in a fifth of the time.
@ti.func
def apply_2d(A, r):
    return A[:, 0] * r[0] + A[:, 1] * r[1]


@ti.func
def apply_3d(A, r):
    return apply_2d(A, r) + A[:, 2] * r[2]


BLOCKS = {2: (share_2d, node_2d, product_2d, apply_2d), 3: (share_3d, node_3d, product_3d, apply_3d)}


@ti.data_oriented
class TaichiMpm:
    """Kernels and fields for all cases of one dimension; state s of particle p is at s * count + p."""

    def __init__(self, dim: int, states: int, particles: int, node_count: int):
        self.dim = dim
        self.share, self.node, self.product, self.apply = BLOCKS[dim]
        vector = {"n": dim, "dtype": ti.f32}
        self.x = self._placed(ti.Vector.field(**vector, needs_grad=True), states)
        self.v = self._placed(ti.Vector.field(**vector, needs_grad=True), states)
        self.C = self._placed(ti.Matrix.field(**vector, m=dim, needs_grad=True), states)
        self.F = self._placed(ti.Matrix.field(**vector, m=dim, needs_grad=True), states)
        self.momentum = ti.Vector.field(**vector, shape=node_count, needs_grad=True)
        self.node_mass = ti.field(ti.f32, shape=node_count, needs_grad=True)
        self.velocity = ti.Vector.field(**vector, shape=node_count, needs_grad=True)
        self.seed = ti.Vector.field(**vector, shape=particles)

    @staticmethod
    def _placed(field, size: int):
        """A separate tree for each field and its adjoint: a single tree would exceed 2 GiB."""
        for part in (field, field.grad):
            builder = ti.FieldsBuilder()
            builder.dense(ti.i, size).place(part)
            builder.finalize()
        return field

    def start(self, case: dict[str, np.ndarray], order: int):
        """Load the sizes of a case and its particles in one order."""
        numbers = {name: float(case[name]) for name in ("dx", "dt", "mass", "volume", "mu", "lam")}
        dx, dt, mass, volume = (numbers[name] for name in ("dx", "dt", "mass", "volume"))
        self.count, self.nodes = case["x"].shape[1], int(case["nodes"])
        self.node_count, self.mass, self.gravity = self.nodes**self.dim, mass, float(case["gravity"][1])
        self.material = (mass, 4.0 * dt * volume / dx**2, numbers["mu"], numbers["lam"])
        self.scale = (self.nodes, dx, dt)
        self.enter(self.count, case["x"][order], case["v"][order], case["seed"][order])

    @ti.kernel
    def enter(self, count: ti.i32, x: ti.types.ndarray(), v: ti.types.ndarray(), seed: ti.types.ndarray()):
        for p in range(count):
            for axis in ti.static(range(self.dim)):
                self.x[p][axis] = x[p, axis]
                self.v[p][axis] = v[p, axis]
                self.seed[p][axis] = seed[p, axis]
            self.F[p] = ti.Matrix.identity(ti.f32, self.dim)
            self.C[p] = ti.Matrix.zero(ti.f32, self.dim, self.dim)

    @ti.kernel
    def clear_grid(self, node_count: ti.i32):
        for i in range(node_count):
            self.momentum[i] = ti.Vector.zero(ti.f32, self.dim)
            self.node_mass[i] = 0.0

    @ti.kernel
    def clear_grid_both(self, node_count: ti.i32):
        for i in range(node_count):
            self.momentum[i] = ti.Vector.zero(ti.f32, self.dim)
            self.node_mass[i] = 0.0
            self.momentum.grad[i] = ti.Vector.zero(ti.f32, self.dim)
            self.node_mass.grad[i] = 0.0
            self.velocity.grad[i] = ti.Vector.zero(ti.f32, self.dim)

    @ti.kernel
    def seed_adjoints(self, count: ti.i32, substeps: ti.i32):
        for i in range((substeps + 1) * count):
            self.x.grad[i] = ti.Vector.zero(ti.f32, self.dim)
            self.v.grad[i] = ti.Vector.zero(ti.f32, self.dim)
            self.C.grad[i] = ti.Matrix.zero(ti.f32, self.dim, self.dim)
            self.F.grad[i] = ti.Matrix.zero(ti.f32, self.dim, self.dim)
            if i >= substeps * count:
                self.x.grad[i] = self.seed[i - substeps * count]

    @ti.kernel
    def p2g(
        self,
        s: ti.i32,
        count: ti.i32,
        nodes: ti.i32,
        dx: ti.f32,
        dt: ti.f32,
        mass: ti.f32,
        impulse: ti.f32,
        mu: ti.f32,
        lam: ti.f32,
    ):
        for p in range(count):
            now = s * count + p
            base = ti.cast(self.x[now] / dx - 0.5, ti.i32)
            fx = self.x[now] / dx - ti.cast(base, ti.f32)
            w = weights(fx)
            F = self.F[now]
            eye = ti.Matrix.identity(ti.f32, self.dim)
            tau = mu * (self.product(F, F.transpose()) - eye) + lam * ti.log(F.determinant()) * eye
            A = dx * (mass * self.C[now] - impulse * tau)
            mv = mass * self.v[now] - self.apply(A, fx)
            for offset in ti.static(ti.grouped(ti.ndrange(*((3,) * self.dim)))):
                share = self.share(w, offset)
                i = self.node(base + offset, nodes)
                self.momentum[i] += share * (mv + self.apply(A, offset))
                self.node_mass[i] += share * mass

    @ti.kernel
    def grid(self, node_count: ti.i32, dt: ti.f32, gravity: ti.f32, mass: ti.f32):
        for i in range(node_count):
            # Not 0: the generated gradient divides by m², which underflows. DiffTaichi adds 1e-10 to masses near 1.
            if self.node_mass[i] > 1e-10 * mass:
                free_fall = dt * gravity * ti.Vector.unit(self.dim, 1, ti.f32)
                self.velocity[i] = self.momentum[i] / self.node_mass[i] + free_fall

    @ti.kernel
    def g2p(self, s: ti.i32, count: ti.i32, nodes: ti.i32, dx: ti.f32, dt: ti.f32):
        for p in range(count):
            now = s * count + p
            then = now + count
            base = ti.cast(self.x[now] / dx - 0.5, ti.i32)
            fx = self.x[now] / dx - ti.cast(base, ti.f32)
            w = weights(fx)
            v = ti.Vector.zero(ti.f32, self.dim)
            B = ti.Matrix.zero(ti.f32, self.dim, self.dim)
            for offset in ti.static(ti.grouped(ti.ndrange(*((3,) * self.dim)))):
                share = self.share(w, offset) * self.velocity[self.node(base + offset, nodes)]
                v += share
                B += share.outer_product(offset)
            self.v[then] = v
            self.C[then] = (4.0 / dx) * (B - self.v[then].outer_product(fx))
            self.x[then] = self.x[now] + dt * self.v[then]
            self.F[then] = self.F[now] + dt * self.product(self.C[then], self.F[now])

    @ti.kernel
    def read_x(self, count: ti.i32, s: ti.i32, out: ti.types.ndarray()):
        for p in range(count):
            for axis in ti.static(range(self.dim)):
                out[p, axis] = self.x[s * count + p][axis]

    @ti.kernel
    def read_adj_v(self, count: ti.i32, out: ti.types.ndarray()):
        for p in range(count):
            for axis in ti.static(range(self.dim)):
                out[p, axis] = self.v.grad[p][axis]

    def forward(self, substeps: int):
        for s in range(substeps):
            self.clear_grid(self.node_count)
            self.p2g(s, self.count, *self.scale, *self.material)
            self.grid(self.node_count, self.scale[2], self.gravity, self.mass)
            self.g2p(s, self.count, *self.scale)

    def backward(self, substeps: int):
        self.seed_adjoints(self.count, substeps)
        for s in reversed(range(substeps)):
            self.clear_grid_both(self.node_count)
            self.p2g(s, self.count, *self.scale, *self.material)
            self.grid(self.node_count, self.scale[2], self.gravity, self.mass)
            self.g2p.grad(s, self.count, *self.scale)
            self.grid.grad(self.node_count, self.scale[2], self.gravity, self.mass)
            self.p2g.grad(s, self.count, *self.scale, *self.material)


def median_seconds(work, repeats: int) -> float:
    work()
    seconds = []
    for _ in range(repeats):
        ti.sync()
        begin = time.perf_counter()
        work()
        ti.sync()
        seconds.append(time.perf_counter() - begin)
    return statistics.median(seconds)


def measure(mpm: TaichiMpm, case: dict[str, np.ndarray]) -> dict:
    """Compared results, and seconds of the forward and backward pass, for each order of the particles."""
    substeps, check, repeats = (int(case[name]) for name in ("substeps", "check", "repeats"))
    result = {}
    for order in range(len(case["x"])):
        mpm.start(case, order)
        mpm.forward(check)
        mpm.backward(check)
        end, adj_v = np.zeros_like(case["x"][order]), np.zeros_like(case["x"][order])
        mpm.read_x(mpm.count, check, end)
        mpm.read_adj_v(mpm.count, adj_v)
        forward = median_seconds(lambda: mpm.forward(substeps), repeats)
        backward = median_seconds(lambda: mpm.backward(substeps), repeats)
        found = {"end": end, "adj_v": adj_v, "forward": forward, "backward": backward}
        result |= {f"{name}{order}": value for name, value in found.items()}
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "folder",
        type=Path,
        help="cases that bench/peers.py wrote; the first axis of x, v and seed is the order",
    )
    parser.add_argument("--device", default="cuda")
    args = parser.parse_args()
    paths = sorted(args.folder.glob("*.case.npz"))
    cases = [dict(np.load(path)) for path in paths]
    for dim in sorted({int(case["dim"]) for case in cases}):
        # One thread on the CPU, as in Warp. No cache, so that a run leaves no files.
        arch = {"arch": ti.cuda} if args.device == "cuda" else {"arch": ti.cpu, "cpu_max_num_threads": 1}
        ti.init(**arch, default_fp=ti.f32, offline_cache=False, log_level=ti.WARN)
        same = [(path, case) for path, case in zip(paths, cases, strict=True) if case["dim"] == dim]
        sizes = [(c["x"].shape[1], max(int(c["substeps"]), int(c["check"])) + 1) for _, c in same]
        mpm = TaichiMpm(
            dim,
            states=max(count * states for count, states in sizes),
            particles=max(count for count, _ in sizes),
            node_count=max(int(case["nodes"]) ** dim for _, case in same),
        )
        for path, case in same:
            result = measure(mpm, case)
            np.savez(path.with_name(path.name.replace(".case.", ".result.")), arch=str(ti.cfg.arch), **result)


if __name__ == "__main__":
    main()
