"""Moving walls and forces at surface points: every value and gradient against the float64 oracle, and mechanics."""

import math

import pytest
import torch
from helpers import assert_relative, busy_inputs, cotangent, dot, given, surface_of
from surface_scenes import G, block, build, made, pressed, settled, slab, velocity

import softmpm
from softmpm import Inputs
from softmpm.oracle import lagrangian

WALLS = ("wall_offset", "wall_normal", "wall_velocity")
NAMES = ("gravity", "friction", "viscosity", *WALLS)
STEPS, SUBSTEPS = 3, 2


def leaves_of(model: softmpm.Model, seed=5) -> dict[str, torch.Tensor]:
    """Leaves of a body near rest and of two walls that push into it as they turn and slide, other ones in each world."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    found = busy_inputs(model, control_steps=STEPS) | given(model, NAMES, STEPS)
    for name, still in zip("xvCF", model.rest()[:4], strict=True):
        found[name] = still + 0.05 * (found[name].detach() - still)
    walls, points = model.scene.walls, model.surface
    assert points is not None
    normal = torch.tensor([wall.normal for wall in walls], dtype=torch.float64)
    near = (points.points.cpu() @ normal.T).amin(0) - 2e-3
    near[2] = walls[2].offset
    rise = 3e-3 * torch.arange(STEPS + 1.0).double()[:, None, None] * torch.tensor([1.0, 1.0, 0.3])
    offset = near + rise + 2e-4 * random(STEPS + 1, model.worlds, 3)
    normal = normal + 2e-3 * random(STEPS + 1, model.worlds, 3, model.dim)
    found |= {"wall_offset": 1.3 * offset, "wall_normal": 1.3 * normal}
    return {name: tensor.detach().to(model.device).requires_grad_() for name, tensor in found.items()}


def run(model: softmpm.Model, leaves: dict[str, torch.Tensor], by_reference=False):
    """End and mean forces on the points by the model or by the oracle."""
    start = softmpm.State(*(leaves[name] for name in "xvCF"))
    params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))
    inputs, activation = Inputs(**{name: leaves[name] for name in NAMES}), leaves["activation"]
    if not by_reference:
        end = softmpm.simulate(model, start, activation, params, substeps=SUBSTEPS, inputs=inputs)
        assert end.nodes is not None
        return end, end.nodes.force
    made = model.scene
    settings = dict(surface=surface_of(model), smoothing=model.contact_width * made.grid.spacing)
    u, v = lagrangian.project(made, start, params)
    u, v, _, force = lagrangian.simulate(
        made, u, v, activation, params, substeps=SUBSTEPS, inputs=inputs, **settings
    )
    return lagrangian.evaluate(made, u, v), force


@pytest.mark.parametrize(
    "dtype, limit", [(torch.float64, 1e-10), (torch.float32, 2e-3)], ids=["double", "single"]
)
@pytest.mark.parametrize("width", [0.0, 0.05])
@pytest.mark.parametrize("dim", [2, 3])
def test_moving_walls_and_forces_are_those_of_the_reference(dim, width, dtype, limit, device):
    """State, forces and the gradient of both with respect to every input."""
    model = build(pressed(dim), device=device, dtype=dtype, worlds=2, inputs=NAMES, contact_width=width)
    leaves = leaves_of(model)
    copies = {name: t.detach().cpu().double().requires_grad_() for name, t in leaves.items()}
    found = []
    for tensors, exact in ((leaves, False), (copies, True)):
        end, force = run(model, tensors, exact)
        weights = cotangent(softmpm.State(*4 * [force]), seed=3)[0]
        loss = dot(cotangent(end), end) + 0.1 * (weights * force).sum()
        found.append([*end[:4], force, *torch.autograd.grad(loss, list(tensors.values()))])
    touches = (found[1][4] != 0).any(-1)
    assert touches.any(2).any(0).all(), "a wall touches nothing in the last control step"
    assert touches.all(1).any(), "no point touches two walls"
    for name, got, want in zip([*"xvCF", "force", *leaves], *found, strict=True):
        assert want.abs().max() > 0, f"the test does not exercise {name}"
        assert_relative(got.detach().cpu().double(), want.detach(), limit, name)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_are_central_differences(dim):
    """Of state and forces, along one random direction of each input of the walls: ≤ 1e-6."""
    model = build(pressed(dim), dtype=torch.float64, worlds=2, inputs=NAMES)
    leaves = leaves_of(model)

    def loss(tensors) -> torch.Tensor:
        end, force = run(model, tensors)
        return dot(cotangent(end), end) + (cotangent(softmpm.State(*4 * [force]), seed=3)[0] * force).sum()

    names = [*WALLS, "friction", "x"]
    gradient = torch.autograd.grad(loss(leaves), [leaves[name] for name in names])
    for name, slope in zip(names, gradient, strict=True):
        d = torch.randn(slope.shape, generator=torch.Generator().manual_seed(1)).double()
        h = 1e-6 if name in ("friction", "wall_velocity") else 1e-8
        with torch.no_grad():
            ends = [loss(leaves | {name: leaves[name] + sign * h * d}) for sign in (1, -1)]
        want = (ends[0] - ends[1]).item() / (2 * h)
        assert (slope * d).sum().item() == pytest.approx(want, rel=1e-6), name


def test_calls_in_turn_and_worlds_alone_are_one_call():
    """Anchors and walls go on where they were: the same bits."""
    model = build(pressed(2), dtype=torch.float64, worlds=2, inputs=NAMES)
    leaves = {name: tensor.detach() for name, tensor in leaves_of(model).items()}
    whole, force = run(model, leaves)
    params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))
    state = softmpm.State(*(leaves[name] for name in "xvCF"))
    for c in range(STEPS):
        poses = {name: leaves[name][c : c + 2] for name in WALLS[:2]}
        others = {name: leaves[name] for name in NAMES if name not in WALLS}
        inputs = Inputs(**poses, wall_velocity=leaves["wall_velocity"][c : c + 1], **others)
        row = leaves["activation"][c : c + 1]
        state = softmpm.simulate(model, state, row, params, substeps=SUBSTEPS, inputs=inputs)
    assert state.nodes is not None and torch.equal(state.nodes.force, force)
    for got, want in zip(state[:4], whole[:4], strict=True):
        assert torch.equal(got, want)
    one = build(pressed(2), dtype=torch.float64, inputs=NAMES)
    timed = ("activation", *WALLS)
    own = {name: t[:, 1:] if name in timed else t[1:] for name, t in leaves.items()}
    alone, own_force = run(one, own)
    assert_relative(alone.v, whole.v[1:], 1e-12)
    assert_relative(own_force, force[1:], 1e-12)


def test_a_pose_at_rest_is_the_scenes():
    """Compiled for moving walls, walls that rest are those of a scene: ≤ 1e-13."""
    made = block(2)
    still = build(made, dtype=torch.float64)
    state = softmpm.simulate(still, still.rest(), None, still.params(), substeps=20)
    model = build(made, dtype=torch.float64, inputs=("wall_offset",))
    offset = torch.tensor([wall.offset for wall in made.walls], dtype=torch.float64)
    for pose in (offset, offset.expand(2, 1, -1)):
        inputs = Inputs(wall_offset=pose)
        got = softmpm.simulate(model, model.rest(), None, model.params(), substeps=20, inputs=inputs)
        for name, a, b in zip("xvCF", got[:4], state[:4], strict=True):
            assert_relative(a, b, 1e-13, name)


def test_a_conveyor_belt():
    """A block on a belt is accelerated with μ g, within 0.5 %, to the speed of the belt, with which it goes on: ≤ 1e-5."""
    model = made(slab(friction=0.3), inputs=("wall_velocity",))
    belt = Inputs(wall_velocity=torch.tensor([0.5, 0.0], dtype=torch.float64))
    start = settled(model)
    speeds, state = [], start
    for _ in range(5):
        state = softmpm.simulate(model, state, None, model.params(), substeps=200, inputs=belt)
        speeds.append(velocity(model, state)[0].item())
        if speeds[-1] < 0.4:
            total = softmpm.contact_forces(model, state).total[0, 0]
            assert total[0].item() == pytest.approx(0.3 * total[1].item(), rel=1e-9)
    assert (speeds[2] - speeds[0]) / 0.08 == pytest.approx(0.3 * G, rel=5e-3)
    state = softmpm.simulate(model, state, None, model.params(), substeps=2000, inputs=belt)
    assert velocity(model, state)[0].item() == pytest.approx(0.5, abs=1e-5)
    assert softmpm.contact_forces(model, state).total[0, 0, 0].abs() < 1e-3 * model.mass.sum() * G


def test_a_wall_that_rises_carries_the_block():
    """At a constant speed it bears the weight, while it accelerates m (g + a): the mean force of a control step, within 0.1 %."""
    model = made(slab(), inputs=("wall_offset",))
    start, weight = settled(model), (model.mass.sum() * G).item()
    height, steps, substeps = model.scene.walls[0].offset, 20, 100
    T = substeps * model.scene.dt
    for acceleration, speed in ((0.0, 0.1), (1.5, 0.0)):
        t = T * torch.arange(steps + 1.0).double()
        state = start._replace(nodes=None)
        state = state._replace(v=state.v + torch.tensor([0.0, speed], dtype=torch.float64))
        poses = height + speed * t + acceleration * t**2 / 2
        for c in range(steps):
            inputs = Inputs(wall_offset=poses[c : c + 2, None, None])
            state = softmpm.simulate(model, state, None, model.params(), substeps=substeps, inputs=inputs)
        total = softmpm.contact_forces(model, state).total[0, 0]
        assert total[1].item() == pytest.approx(weight * (1 + acceleration / G), rel=1e-3)
        want = speed + acceleration * (t[-1] - T / 2)
        assert velocity(model, state)[1].item() == pytest.approx(want.item(), rel=2e-2)


def turned(model: softmpm.Model, state: softmpm.State, angle: float, pivot: torch.Tensor) -> torch.Tensor:
    """Places of the surface points in the frame of a floor that has turned about the pivot."""
    c, s = math.cos(angle), math.sin(angle)
    back = torch.tensor([[c, s], [-s, c]], dtype=torch.float64)
    return pivot + (softmpm.contact_forces(model, state).points[0] - pivot) @ back.T


def test_a_block_sticks_to_a_floor_that_tilts():
    """Up to 20° of 26.6° its sole stays where it was in the frame of the floor: within 0.02 cells on a way of up to 2.9."""
    model = made(slab(friction=0.5), inputs=("wall_offset", "wall_normal"))
    pivot = torch.tensor([4 / 32, model.scene.walls[0].offset], dtype=torch.float64)
    state = settled(model)
    before, steps, angle = turned(model, state, 0.0, pivot), 40, math.radians(20.0)
    sole = before[:, 1] < pivot[1] + 1e-3
    for c in range(steps):
        angles = angle * torch.tensor([c, c + 1], dtype=torch.float64) / steps
        normal = torch.stack([-angles.sin(), angles.cos()], -1)
        inputs = Inputs(wall_normal=normal[:, None, None], wall_offset=(normal @ pivot)[:, None, None])
        state = softmpm.simulate(model, state, None, model.params(), substeps=50, inputs=inputs)
    after, cell = turned(model, state, angle, pivot), model.scene.grid.spacing
    way = (softmpm.contact_forces(model, state).points[0] - before).norm(dim=1)[sole]
    assert way.max() > cell and (after - before)[sole].abs().max() < 0.02 * cell
