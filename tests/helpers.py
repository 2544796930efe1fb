"""Scenes and comparisons that several tests share."""

import dataclasses

import numpy as np
import pytest
import torch

import softmpm
from softmpm import autograd, rollout, runner
from softmpm.oracle import contact
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import plan
from softmpm.schemes import graph_cache
from softmpm.schemes.fast import chunk_buffers, particle_order
from softmpm.schemes.fast import scheme as fast_scheme
from softmpm.schemes.lagrangian import nodal

LAWS = {
    "neo_hookean": softmpm.NeoHookean,
    "fixed_corotated": softmpm.FixedCorotated,
    "barrier_corotated": softmpm.BarrierCorotated,
    "stable_neo_hookean": softmpm.StableNeoHookean,
}
KINDS = {
    "single precision": dict(scheme="fast"),
    "double precision": dict(scheme="fast", dtype=torch.float64),
    "deterministic": dict(scheme="fast", deterministic=True),
    "plain": dict(scheme="plain"),
}
"""Settings of models that keep things in ways of their own."""
INPUTS = ("x", "v", "C", "F", "activation", "young", "poisson", "density")
GIVEN = ("gravity", "damping", "friction", "direction", "viscosity", "force")
WALL_INPUTS = ("wall_offset", "wall_normal", "wall_velocity")
"""Inputs of which each formulation is compared with the oracle, together with the strength and the driven particles."""


def busy_scene(
    dim: int, laws=("neo_hookean", "fixed_corotated"), *, per_law=12, dt=1e-3, seed=0, **changes
) -> softmpm.Scene:
    """Small and full: every law given, two overlapping muscles, a rough floor, a tilted wall, gravity and damping."""
    rng = np.random.default_rng(seed)
    bodies = []
    for law in laws:
        positions = rng.uniform(0.3, 0.62, (per_law, dim))
        volume = 0.05**dim * min(1.0, 30 / per_law)  # bodies share the space, which none of them may fill
        particles = softmpm.Particles(positions, rng.uniform(0.5, 1.5, per_law) * volume)
        bodies.append(softmpm.Body(particles, LAWS[law](density=1.2, young=80.0, poisson=0.3)))
    count = per_law * len(laws)
    up = (0.0, 1.0) + (0.0,) * (dim - 2)
    settings = dict(
        grid=softmpm.Grid(shape=(12, 11, 10)[:dim], spacing=0.1),
        bodies=bodies,
        muscles=[
            softmpm.Muscle(particles=np.arange(count * 2 // 3), direction=up, strength=10.0),
            softmpm.Muscle(
                particles=np.arange(count // 3, count), direction=(1.0, 0.5, 0.2)[:dim], strength=8.0
            ),
        ],
        walls=[
            softmpm.Wall(normal=up, offset=0.41, contact="separate", friction=0.4),
            softmpm.Wall(normal=(-1.0, 0.3, 0.1)[:dim], offset=-0.45, contact="slip"),
        ],
        gravity=(0.3, -9.8, 0.2)[:dim],
        damping=0.7,
        dt=dt,
    )
    return softmpm.Scene(**(settings | changes))


def full_scene(dim: int, *, driven=(1, 5), viscosity=0.02, **changes) -> softmpm.Scene:
    """:func:`busy_scene` with every law, a chamber under pressure, viscosity, driven particles and a wall of each kind."""
    full = busy_scene(dim, tuple(LAWS), per_law=8, **changes)
    bodies = [
        dataclasses.replace(body, material=dataclasses.replace(body.material, viscosity=viscosity))
        for body in full.bodies
    ]
    chamber = softmpm.Pressure(particles=np.arange(2, 14), strength=6.0)
    sticky = softmpm.Wall(normal=(1.0, 0.0, 0.1)[:dim], offset=0.33, contact="stick")
    return dataclasses.replace(
        full, bodies=bodies, driven=driven, walls=[*full.walls, sticky], muscles=[*full.muscles, chamber]
    )


def bar(law="neo_hookean", spacing=1 / 64, **changes) -> softmpm.Scene:
    """A free bar of 1/2 × 1/8 m, a muscle along each half, on cells of 1/32 m."""
    shape = softmpm.box((0.25, 0.45), (0.75, 0.575), spacing=spacing)
    x = shape.positions[:, 0]
    halves = [np.flatnonzero(x < 0.5), np.flatnonzero(x >= 0.5)]
    settings = dict(
        grid=softmpm.Grid(shape=(33, 33), spacing=1 / 32),
        bodies=[softmpm.Body(shape, LAWS[law](density=1.0, young=100.0, poisson=0.3))],
        muscles=[softmpm.Muscle(particles=half, direction=(1.0, 0.0), strength=30.0) for half in halves],
        dt=1.0,
    )
    scene = softmpm.Scene(**(settings | changes))
    return dataclasses.replace(scene, dt=0.4 * softmpm.stable_dt(scene))


def busy_inputs(model: softmpm.Model, control_steps=2, seed=1) -> dict[str, torch.Tensor]:
    """A random start, activation and material for :func:`busy_scene`, as leaves that require gradients."""
    generator = torch.Generator().manual_seed(seed)

    def noise(shape, scale):
        return (scale * torch.randn(shape, generator=generator, dtype=torch.float64)).to(
            model.device, model.dtype
        )

    rest, params = model.rest(), model.params()
    lead = (model.worlds, model.particle_count)
    inputs = dict(
        x=rest.x + noise(rest.x.shape, 0.01),
        v=noise(rest.v.shape, 0.5),
        C=noise(rest.C.shape, 2.0),
        F=rest.F + noise(rest.F.shape, 0.1),
        activation=noise((control_steps, model.worlds, model.muscle_count), 0.5),
        young=params.young * (1 + 0.3 * torch.rand(lead, generator=generator).to(params.young)),
        poisson=params.poisson - 0.2 * torch.rand(lead, generator=generator).to(params.young),
        density=params.density * (1 + 0.3 * torch.rand(lead, generator=generator).to(params.young)),
    )
    return {name: tensor.detach().requires_grad_() for name, tensor in inputs.items()}


def given(model: softmpm.Model, names, steps: int, seed=7) -> dict[str, torch.Tensor]:
    """Random values of these inputs, near those of the scene, for each world, as leaves that require gradients."""
    generator = torch.Generator().manual_seed(seed)

    def random(name, low, high):
        shape = model.shape_of(name, steps)
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    walls = model.scene.walls
    dtype = {"wall_offset": torch.float64, "wall_normal": torch.float64}
    made = {
        "gravity": lambda: random("gravity", -9.0, 3.0),
        "damping": lambda: random("damping", 0.2, 3.0),
        "friction": lambda: random("friction", 0.02, 0.2),
        "direction": lambda: random("direction", 0.2, 1.5),
        "strength": lambda: random("strength", 5.0, 12.0),
        "viscosity": lambda: random("viscosity", 0.01, 0.05),
        "velocity": lambda: random("velocity", -0.6, 0.6),
        "position": lambda: (
            torch.from_numpy(model.exact_positions[list(model.scene.driven)])
            + random("position", -5e-3, 5e-3)
        ),
        "force": lambda: random("force", -0.02, 0.02),
        "wall_offset": lambda: torch.tensor([w.offset for w in walls]) + random("wall_offset", -2e-3, 2e-3),
        "wall_normal": lambda: torch.tensor([w.normal for w in walls]) + random("wall_normal", -5e-3, 5e-3),
        "wall_velocity": lambda: random("wall_velocity", -0.5, 0.5),
    }
    found = {name: made[name]().to(model.device, dtype.get(name, model.dtype)) for name in names}
    return {name: tensor.detach().requires_grad_() for name, tensor in found.items()}


def run(simulate, model_or_scene, inputs: dict[str, torch.Tensor], substeps: int) -> softmpm.State:
    """``simulate`` (softmpm's or the oracle's) on inputs given by name."""
    start = softmpm.State(*(inputs[name] for name in "xvCF"))
    params = softmpm.Params(*(inputs[name] for name in softmpm.Params._fields))
    return simulate(model_or_scene, start, inputs.get("activation"), params, substeps=substeps)


def surface_of(model: softmpm.Model) -> contact.Surface:
    """The model's surface points for the oracle, which does not compute weights."""
    points, rest = model.surface, model.rest_grid
    assert points is not None
    node = rest.index.cpu()[points.stencil.cpu().long()]
    return contact.Surface(
        points.points.cpu(), node, points.weights.cpu(), points.areas.cpu(), points.stiffness.cpu()
    )


def cotangent(state: softmpm.State, seed=2) -> softmpm.State:
    """Random weights of a linear loss: unlike a square, it sees every direction, a wrong rotation among them."""
    generator = torch.Generator().manual_seed(seed)
    return softmpm.State(
        *(torch.randn(t.shape, generator=generator, dtype=torch.float64).to(t) for t in state[:4])
    )


def dot(a, b) -> torch.Tensor:
    """⟨a, b⟩ of lists of tensors, or of what is differentiable of states."""
    pairs = zip(*(s[:4] if isinstance(s, softmpm.State) else s for s in (a, b)), strict=True)
    return sum((x * y).sum() for x, y in pairs)


def gradients(simulate, model_or_scene, inputs, substeps, weights=None) -> dict[str, torch.Tensor]:
    """Gradient of ⟨weights, end⟩ with respect to each input."""
    end = run(simulate, model_or_scene, inputs, substeps)
    loss = dot(cotangent(end) if weights is None else weights, end)
    return dict(zip(inputs, torch.autograd.grad(loss, list(inputs.values())), strict=True))


def relative(got: torch.Tensor, want: torch.Tensor) -> float:
    """Largest difference over the largest wanted value."""
    return ((got - want).abs().max() / want.abs().max().clamp_min(1e-300)).item()


def assert_relative(got, want, limit: float, what: str = "") -> None:
    error = relative(torch.as_tensor(got), torch.as_tensor(want))
    assert error <= limit, f"{what} differs by {error:.2e} relative, limit {limit:.0e}"


def little_memory(model) -> dict[str, int]:
    """Settings with which a call of 3 times 7 substeps stores one state and recomputes chunks."""
    sizes = model.sizes()
    budget = 4 * (sizes.inside + sizes.derived + sizes.nodes) + sizes.apart + 3 * sizes.between
    assert not plan(Horizon(3, 7), sizes, budget).keep_all
    return {"memory_budget": budget}


def thrown_out() -> softmpm.State:
    """A simulation that fails, for a process of its own: one particle leaves the grid at substep 3."""
    body = softmpm.Body(
        softmpm.Particles([[0.5, 0.5], [0.7, 0.55]], 0.01), softmpm.NeoHookean(density=1, young=10)
    )
    grid = softmpm.Grid(shape=(12, 12), spacing=0.1)
    model = softmpm.build(softmpm.Scene(grid=grid, bodies=[body], dt=1e-3), device="cpu")
    start = model.rest()
    start.v[0, 1, 0] = 100.0
    return softmpm.simulate(model, start, None, model.params(), substeps=10)


def pretend_capture(patch: pytest.MonkeyPatch) -> None:
    """Let calls on a CPU behave as if PyTorch were capturing a CUDA graph."""
    for module in (
        autograd,
        chunk_buffers,
        fast_scheme,
        graph_cache,
        nodal,
        particle_order,
        rollout,
        runner,
    ):
        patch.setattr(module, "is_capturing", lambda model: True)
