"""Scenes and models of the reference formulation with contact at surface points, and their comparison with the float64 oracle."""

import numpy as np
import torch
from helpers import assert_relative, busy_inputs, cotangent, dot, given, surface_of

import softmpm
from softmpm import Inputs
from softmpm.oracle import contact, lagrangian

G = 9.81


def block(dim: int, **changes) -> softmpm.Scene:
    """A block on a rough floor and at a rough side wall, with a muscle; the sides of the block stand off the grid lines."""
    lower, upper = (0.33, 0.3, 0.34)[:dim], (0.52, 0.49, 0.53)[:dim]
    shape = softmpm.box(lower, upper, spacing=0.05)
    material = softmpm.NeoHookean(density=1.2, young=80.0, poisson=0.3, viscosity=0.02)
    settings = dict(
        grid=softmpm.Grid(shape=(12, 11, 10)[:dim], spacing=0.1),
        bodies=[softmpm.Body(shape, material)],
        muscles=[softmpm.Muscle(particles=np.arange(6), direction=(1.0, 0.4, 0.2)[:dim], strength=10.0)],
        walls=[
            softmpm.Wall(normal=(0.1, 1.0, 0.05)[:dim], offset=0.35, friction=0.4),
            softmpm.Wall(normal=(1.0, 0.2, 0.0)[:dim], offset=0.4, friction=0.2),
            softmpm.Wall(normal=(-1.0, 0.0, 0.0)[:dim], offset=-0.5, contact="slip"),
        ],
        gravity=(0.3, -9.8, 0.2)[:dim],
        damping=0.7,
        dt=1e-3,
    )
    return softmpm.Scene(**(settings | changes))


def pressed(dim: int) -> softmpm.Scene:
    """A block with an edge at which two rough walls meet the same points; a third wall acts on nodes."""
    first, _, third = block(dim).walls
    second = softmpm.Wall(normal=(0.5, 1.0, 0.2)[:dim], offset=0.4, friction=0.2)
    return block(dim, walls=[first, second, third])


def build(made: softmpm.Scene, **settings) -> softmpm.Model:
    alarms = softmpm.Alarms(collapse=None, depth=None)
    return softmpm.build(
        made, device=settings.pop("device", "cpu"), formulation="reference", alarms=alarms, **settings
    )


def by_kernels(model: softmpm.Model, *arguments, **call) -> tuple[softmpm.State, torch.Tensor]:
    """End of :func:`softmpm.simulate`, and the forces of clamps and planes of symmetry, if there are any."""
    end = softmpm.simulate(model, *arguments, **call)
    return end, torch.zeros(0) if model.mirror is None else softmpm.clamp_forces(model, end)


def by_reference(
    model: softmpm.Model, start, activation, params, **call
) -> tuple[softmpm.State, torch.Tensor]:
    """The same by the float64 oracle, with contact at surface points if the model has it."""
    made, settings = model.scene, {}
    u, v = lagrangian.project(made, start, params)
    if model.surface is not None:
        surface, width = surface_of(model), model.contact_width * made.grid.spacing
        anchor = contact.start_anchor(made, surface, u)
        settings = dict(surface=surface, anchor=anchor, smoothing=width)
    u, v, *others = lagrangian.simulate(made, u, v, activation, params, **call, **settings)
    return lagrangian.evaluate(made, u, v), torch.zeros(0) if model.mirror is None else others[-1]


def compare(model: softmpm.Model, names, limit: float, steps=3) -> None:
    """Assert that the end of a call of ``steps`` control steps, the forces of clamps and all gradients are those of the oracle.

    Args:
        names: Inputs that the call gives.
        limit: Of the relative difference.
    """
    leaves = busy_inputs(model, control_steps=steps) | given(model, names, steps)
    copies = {name: t.detach().cpu().double().requires_grad_() for name, t in leaves.items()}
    found = []
    for simulate, tensors in ((by_kernels, leaves), (by_reference, copies)):
        start = softmpm.State(*(tensors[name] for name in "xvCF"))
        params = softmpm.Params(*(tensors[name] for name in softmpm.Params._fields))
        inputs = Inputs(**{name: tensors[name] for name in names})
        end, forces = simulate(model, start, tensors["activation"], params, substeps=2, inputs=inputs)
        loss = dot(cotangent(end), end) + dot(cotangent(softmpm.State(*4 * [forces]), seed=3)[:1], [forces])
        shown = [*end[:4], *([forces] if model.mirror else [])]
        found.append([*shown, *torch.autograd.grad(loss, list(tensors.values()))])
    names_shown = [*"xvCF", *(["forces of clamps"] if model.mirror else [])]
    for name, got, want in zip([*names_shown, *leaves], *found, strict=True):
        assert want.abs().max() > 0, f"the test does not exercise {name}"
        assert_relative(got.detach().cpu().double(), want.detach(), limit, f"{name} in {model.dtype}")


def slab(friction=0.5, gravity=(0.0, -G), width=8, **changes) -> softmpm.Scene:
    """A viscous block of ``width`` x 3 cells that touches the floor."""
    h, mu = 1 / 32, 2e5 / 2.6
    corner = (4.5 * h, 4.5 * h)
    shape = softmpm.box(corner, (corner[0] + width * h, corner[1] + 3 * h), spacing=h / 2)
    material = softmpm.NeoHookean(density=1000.0, young=2e5, poisson=0.3, viscosity=4e-3 * mu)
    settings = dict(
        grid=softmpm.Grid(shape=(28, 28), spacing=h),
        bodies=[softmpm.Body(shape, material)],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=corner[1], friction=friction)],
        gravity=gravity,
        dt=2e-4,
    )
    return softmpm.Scene(**(settings | changes))


def settled(model: softmpm.Model, substeps=2500) -> softmpm.State:
    """The block at rest on the floor."""
    return softmpm.simulate(model, model.rest(), None, model.params(), substeps=substeps)


def made(scene: softmpm.Scene, **settings) -> softmpm.Model:
    return softmpm.build(scene, device="cpu", dtype=torch.float64, formulation="reference", **settings)


def velocity(model: softmpm.Model, state: softmpm.State) -> torch.Tensor:
    return (model.mass[:, None] * state.v[0]).sum(0) / model.mass.sum()


def forces_of(model: softmpm.Model, seed: int, worlds=1) -> softmpm.ContactForces:
    """Random tractions at every third point, the forces that they give, and places near those at rest."""
    surface, generator = model.surface, torch.Generator().manual_seed(seed)
    shape = (worlds, len(model.spec.surface_walls), surface.count, model.dim)
    traction = torch.randn(shape, generator=generator, dtype=torch.float64)
    traction[:, :, torch.arange(surface.count) % 3 > 0] = 0.0
    places = surface.points + 0.01 * torch.randn(worlds, *surface.points.shape, generator=generator)
    return softmpm.ContactForces((traction * surface.areas[:, None]).sum(2), traction, places)


def record_forces(recorder: softmpm.Recorder, model: softmpm.Model, iteration: int) -> None:
    """Three frames, the first without forces."""
    with recorder.episode(iteration) as episode:
        for k in range(3):
            forces = forces_of(model, 10 * iteration + k, worlds=2) if k else None
            episode.frame(0.1 * k, model.rest(), forces=forces)
