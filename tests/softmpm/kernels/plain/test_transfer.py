"""Each kernel of the plain scheme and its adjoint against the oracle, one at a time, for random cotangents."""

import pytest
import torch
import warp as wp
from helpers import assert_relative, busy_inputs, busy_scene

import softmpm
from softmpm.kernel_inputs import derive
from softmpm.kernels.physics.slot_sum import (
    COLLECTORS,
    PARTS,
    collect_slots,
    collect_slots_in_order,
    collectors,
)
from softmpm.kernels.structs import RequestedGrads
from softmpm.oracle import moving, stress, transfer
from softmpm.planning.chunks import Horizon
from softmpm.schemes.buffers import Motion, MotionAdj
from softmpm.schemes.device import stream_of
from softmpm.schemes.inputs import Accumulators, InputsAdj, grid_struct, particle_struct
from softmpm.schemes.launch import KernelLauncher
from softmpm.schemes.plain.substep import Substep

LIMIT = 1e-13
EVERYTHING = RequestedGrads(("material", "activation"))


class Bench:
    """One substep taken apart: the model, its inputs on the device, and the oracle's copies on the CPU."""

    def __init__(self, dim: int, device: str, **changes):
        self.scene = busy_scene(dim, **changes)
        self.model = softmpm.build(self.scene, device=device, dtype=torch.float64, worlds=2)
        inputs = busy_inputs(self.model, control_steps=1)
        self.cpu = {k: t.detach().cpu().requires_grad_() for k, t in inputs.items()}
        state = softmpm.State(*(inputs[name].detach() for name in "xvCF"))
        params = softmpm.Params(*(inputs[name].detach() for name in softmpm.Params._fields))
        values = derive(self.model, state, inputs["activation"].detach(), params, {}, Horizon(1, 1))
        self.step = Substep(self.model)
        self.step.particle_inputs = particle_struct(self.model, self.model.fixed | values)
        self.step.grid_inputs = grid_struct(self.model, values)
        self.motion, self.end = Motion.empty(self.model), Motion.empty(self.model)
        self.now, self.then = self.motion.struct(self.model), self.end.struct(self.model)
        self.step.enter(state, self.now)
        self.dx = self.scene.grid.spacing

    def random(self, like: torch.Tensor, seed: int) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    def reference_p2g(self):
        c, volume = self.cpu, self.model.specific_volume.cpu()
        mu, lam = stress.lame(c["young"], c["poisson"])
        mass = c["density"] * volume
        tau = moving.stress(self.scene, c["F"], mu, lam, c["activation"][0])
        affine = (
            mass[..., None, None] * c["C"] - (4 * self.scene.dt / self.dx**2 * volume)[:, None, None] * tau
        )
        return transfer.p2g(self.scene, c["x"], mass, mass[..., None] * c["v"], affine)


@pytest.fixture(params=[2, 3], ids=["2D", "3D"])
def bench(request, device):
    return Bench(request.param, device)


@pytest.fixture(params=["few walls", "many walls", "no walls"])
def walled(request, bench, device):
    """The same, with other walls: five that overlap, of each kind and not sorted by kind, or none.

    No node lies on an oblique one: rounding would say on which side, and a GPU fuses products with sums.
    """
    if request.param == "few walls":
        return bench
    dim = bench.model.dim
    normals = [(0.0, 1.0, 0.0), (-1.0, 0.3, 0.1), (0.2, 1.0, 0.3), (0.1, -1.0, 0.2), (1.0, 0.4, -0.1)]
    kinds = [("separate", 0.4), ("slip", 0.0), ("separate", 0.0), ("stick", 0.0), ("separate", 0.2)]
    offsets = [0.45, -0.403, 0.553, -0.523, 0.503]
    walls = [
        softmpm.Wall(normal=normal[:dim], offset=offset, contact=kind, friction=friction)
        for normal, offset, (kind, friction) in zip(normals, offsets, kinds, strict=True)
    ]
    return Bench(dim, device, walls=walls if request.param == "many walls" else ())


def test_p2g(bench):
    """Mass and momentum of every node (T1)."""
    bench.step.to_grid(bench.now)
    mass, momentum = bench.reference_p2g()
    node = bench.step.node.cpu()
    assert_relative(node[..., -1], mass.detach(), LIMIT, "mass")
    assert_relative(node[..., :-1], momentum.detach(), LIMIT, "momentum")


def test_grid_velocity(walled):
    """Gravity, damping and walls (G2)."""
    bench = walled
    bench.step.to_grid(bench.now)
    want = moving.grid_velocity(bench.scene, *bench.reference_p2g())
    assert_relative(bench.step.velocity.cpu(), want.detach(), 1e-12, "velocity")


def test_g2p(bench):
    """v, C, x and F after the substep (T2, T3)."""
    bench.step.advance(bench.now, bench.then, 0)
    v, C = transfer.g2p(
        bench.scene, bench.cpu["x"], moving.grid_velocity(bench.scene, *bench.reference_p2g())
    )
    end = bench.step.leave(bench.then)
    dt, F = bench.scene.dt, bench.cpu["F"]
    for name, got, want in zip("xvCF", end[:4], (bench.cpu["x"] + dt * v, v, C, F + dt * C @ F), strict=True):
        assert_relative(got.cpu(), want.detach(), 1e-12, name)


def test_g2p_adj(bench):
    """Adjoint of the grid velocity, and what reaches x and F directly (T2.adj, T3.adj)."""
    model, c, dt = bench.model, bench.cpu, bench.scene.dt
    bench.step.advance(bench.now, bench.then, 0)
    velocity = bench.step.velocity.cpu().requires_grad_()
    v, C = transfer.g2p(bench.scene, c["x"], velocity)
    end = (c["x"] + dt * v, v, C, c["F"] + dt * C @ c["F"])
    weights = [bench.random(tensor, n) for n, tensor in enumerate(end)]
    loss = sum((w * t).sum() for w, t in zip(weights, end, strict=True))
    want = torch.autograd.grad(loss, (velocity, c["x"], c["F"]))

    then, now = MotionAdj.zeros(model), MotionAdj.zeros(model)
    for name, weight, scale in zip(("fx", "v", "C", "H"), weights, (bench.dx, 1, 1, 1), strict=True):
        getattr(then, name).copy_(weight * scale)
    bench.step.adj_velocity.zero_()
    found = Accumulators(model, EVERYTHING, 1, model.node_count)
    structs = then.struct(model), now.struct(model)
    bench.step.g2p_adj(EVERYTHING, bench.now, bench.then, *structs, found.particle_struct())
    assert_relative(bench.step.adj_velocity.cpu(), want[0], LIMIT, "velocity")
    assert_relative(now.fx.cpu() / bench.dx, want[1], 1e-12, "x")
    assert_relative(now.H.cpu(), want[2], LIMIT, "F")
    assert (now.v == 0).all() and (now.C == 0).all()


def test_grid_velocity_adj(walled):
    """Adjoint of momentum and mass (G1.adj), through the walls."""
    bench = walled
    bench.step.to_grid(bench.now)
    mass, momentum = (tensor.detach().requires_grad_() for tensor in bench.reference_p2g())
    velocity = moving.grid_velocity(bench.scene, mass, momentum)
    weight = bench.random(velocity, 3)
    adj_momentum, adj_mass = torch.autograd.grad((weight * velocity).sum(), (momentum, mass))
    bench.step.adj_velocity.copy_(weight)
    found = Accumulators(bench.model, EVERYTHING, 1, bench.model.node_count)
    bench.step.grid_adj(EVERYTHING, found.grid_struct())
    got = bench.step.adj_node.cpu()
    assert_relative(got[..., :-1], adj_momentum, 1e-12, "momentum")
    assert_relative(got[..., -1], adj_mass, 1e-12, "mass")


def test_p2g_adj(bench):
    """Adjoint of the state, the material and the muscles (T1.adj, E1, E2, M1)."""
    model, c, step = bench.model, bench.cpu, bench.step
    mass, momentum = bench.reference_p2g()
    weights = bench.random(mass, 4), bench.random(momentum, 5)
    names = ("x", "v", "C", "F", "activation", "young", "poisson", "density")
    loss = (weights[0] * mass).sum() + (weights[1] * momentum).sum()
    want = dict(zip(names, torch.autograd.grad(loss, [c[n] for n in names]), strict=True))

    adj, found = MotionAdj.zeros(model), Accumulators(model, EVERYTHING, 1, model.node_count)
    step.adj_node.copy_(torch.cat([weights[1], weights[0][..., None]], -1))
    step.p2g_adj(EVERYTHING, bench.now, adj.struct(model), found.particle_struct(), 0)
    found.collect(0, model.fixed, KernelLauncher(model, stream_of(model.device)))
    adj_inputs = InputsAdj(model, EVERYTHING, 1)
    adj_inputs.add(found, slice(0, 1))
    adj_inputs.add_particles(found, slice(0, 1))
    adj_mass, adj_mu, adj_lam = (adj_inputs.tensors[name].cpu() for name in ("mass", "mu", "lam"))
    assert_relative(adj.fx.cpu() / bench.dx, want["x"], LIMIT, "x")
    assert_relative(adj.v.cpu(), want["v"], LIMIT, "v")
    assert_relative(adj.C.cpu(), want["C"], LIMIT, "C")
    assert_relative(adj.H.cpu(), want["F"], LIMIT, "F")
    assert_relative(adj_mass * model.specific_volume.cpu(), want["density"], LIMIT, "density")
    young, poisson = (c[n].detach().requires_grad_() for n in ("young", "poisson"))
    by_lame = torch.autograd.grad(stress.lame(young, poisson), (young, poisson), (adj_mu, adj_lam))
    assert_relative(by_lame[0], want["young"], LIMIT, "young")
    assert_relative(by_lame[1], want["poisson"], LIMIT, "poisson")
    adj_active = adj_inputs.tensors["active_stress"]
    assert_relative((adj_active * model.strength).cpu(), want["activation"], LIMIT, "activation")
    assert (found.tensors["active_stress"] == 0).all(), "collecting must clear what it took"


@pytest.mark.parametrize("in_order", [False, True])
def test_collecting_from_many_particles(in_order, device):
    """More than there are threads or partial sums: every slot counts once, for its own muscle, is added to the sum, and cleared."""
    spec = softmpm.build(busy_scene(2), device="cpu", dtype=torch.float64).spec
    random, many = torch.Generator().manual_seed(0), 2 * max(COLLECTORS, PARTS) + 7
    muscle = torch.randint(-1, 3, (2, many, spec.muscle_slots), generator=random).int()
    found = torch.randn(muscle.shape, generator=random, dtype=torch.float64)
    want = torch.stack([((muscle == k) * found).sum((1, 2)) for k in range(3)], 1)
    summed, slot = torch.ones(2, 3, dtype=torch.float64, device=device), found.to(device)
    given = [muscle.to(device), slot]
    if in_order:
        part, kernels = summed.new_empty(2, 3, PARTS), collect_slots_in_order(spec)
        launches = [(kernels.parts, (2, 3, PARTS), [*given, part]), (kernels.total, (2, 3), [part, summed])]
    else:
        launches = [(collect_slots(spec), collectors(muscle.shape), [*given, summed])]
    for kernel, size, tensors in launches:
        arrays = [wp.from_torch(tensor, requires_grad=False) for tensor in tensors]
        wp.launch(kernel, size, arrays, device=wp.device_from_torch(summed.device))
    assert_relative(summed.cpu() - 1, want, 1e-12)
    assert (slot.cpu() == torch.where(muscle < 0, found, 0.0)).all()


def test_adjoints_add_into_their_outputs(bench):
    """Running an adjoint twice doubles the adjoint of the state."""
    model, step = bench.model, bench.step
    step.advance(bench.now, bench.then, 0)
    then, now = MotionAdj.zeros(model), MotionAdj.zeros(model)
    found = Accumulators(model, EVERYTHING, 1, model.node_count)
    inputs = found.particle_struct(), found.grid_struct()
    then.flat.copy_(bench.random(then.flat, 6))
    once = None
    for _ in range(2):
        step.adjoint(EVERYTHING, bench.now, bench.then, then.struct(model), now.struct(model), inputs, 0)
        once = now.flat.clone() if once is None else once
    torch.testing.assert_close(now.flat, 2 * once, rtol=1e-12, atol=1e-12)


def test_raster_and_its_twin(bench):
    """Mass and velocity on the nodes, and their adjoint, are the oracle's (O1)."""
    model, c = bench.model, bench.cpu
    density = model.params().density.cpu()
    want = moving.rasterize(bench.scene, softmpm.State(*(c[n] for n in "xvCF")), density)
    there = {n: c[n].detach().to(model.device).requires_grad_() for n in "xvCF"}
    got = softmpm.rasterize(model, softmpm.State(**there))
    weights = [bench.random(tensor, n) for n, tensor in enumerate(want)]
    losses = [sum((w.to(t) * t).sum() for w, t in zip(weights, field, strict=True)) for field in (got, want)]
    found = torch.autograd.grad(losses[0], [there[n] for n in "xvC"])
    wanted = torch.autograd.grad(losses[1], [c[n] for n in "xvC"])
    assert_relative(got.mass.cpu(), want.mass.detach(), LIMIT, "mass")
    assert_relative(got.velocity.cpu(), want.velocity.detach(), 1e-12, "velocity")
    for name, a, b in zip("xvC", found, wanted, strict=True):
        assert_relative(a.cpu(), b, 1e-11, name)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dim", [2, 3])
def test_entering_and_leaving_is_exact(dim, dtype, device):
    """State → kernels → State gives the same tensors, and the low-order parts in float32."""
    model = softmpm.build(busy_scene(dim), device=device, dtype=dtype)
    inputs = busy_inputs(model)
    state = softmpm.State(*(inputs[name].detach() for name in "xvCF"))
    motion, step = Motion.empty(model), Substep(model)
    step.enter(state, motion.struct(model))
    back = step.leave(motion.struct(model))
    for name in "vCF":
        assert torch.equal(getattr(back, name), getattr(state, name)), name
    torch.testing.assert_close(back.x, state.x, rtol=0, atol=1e-15 if dtype == torch.float64 else 0)
    assert ((motion.fx >= 0.5) & (motion.fx <= 1.5)).all()
