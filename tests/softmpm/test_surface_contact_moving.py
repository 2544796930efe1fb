"""Contact at surface points on the moving grid: every value and gradient against the float64 oracle, state, and mechanics."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
import warp as wp
from helpers import assert_relative, busy_inputs, cotangent, dot, given, little_memory
from surface_scenes import G, pressed, slab, velocity

import softmpm
from softmpm import Inputs
from softmpm.errors import NEVER, Kind, decode
from softmpm.inputs import QUANTITIES
from softmpm.kernels.physics import lanes
from softmpm.kernels.structs import types
from softmpm.oracle import moving_contact
from softmpm.planning import memory
from softmpm.planning.chunks import Horizon
from softmpm.schemes.carried import check_start
from softmpm.schemes.failure_report import failed_worlds
from softmpm.schemes.penetration import deepest
from softmpm.surface_points import CarriedPoints

WALLS = ("wall_offset", "wall_normal", "wall_velocity")
NAMES = ("gravity", "friction", "viscosity", *WALLS)
STEPS, SUBSTEPS = 3, 3
QUIET = softmpm.Alarms(collapse=None, depth=None, step=None, gap=None)


def build(made: softmpm.Scene, **settings) -> softmpm.Model:
    common = dict(device="cpu", dtype=torch.float64, scheme="fast", contact="surface", alarms=QUIET)
    return softmpm.build(made, **(common | settings))


def points_of(model: softmpm.Model) -> CarriedPoints:
    assert isinstance(model.surface, CarriedPoints)
    return model.surface


def leaves_of(model: softmpm.Model, seed=5) -> dict[str, torch.Tensor]:
    """Leaves of a body near rest, whose points adhere somewhere, and of two walls that turn and slide as they push into it, others in
    each world."""
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    found = busy_inputs(model, control_steps=STEPS) | given(model, NAMES, STEPS)
    for name, still in zip("xvCF", model.rest()[:4], strict=True):
        found[name] = still + 0.05 * (found[name].detach() - still)
    walls, rest = model.scene.walls, points_of(model).points.cpu()
    normal = torch.tensor([wall.normal for wall in walls], dtype=torch.float64)
    near = (rest @ normal.T).amin(0) + torch.tensor([1e-3, 1e-3, 0.0])
    near[2] = walls[2].offset
    rise = 6e-3 * torch.arange(STEPS + 1.0).double()[:, None, None] * torch.tensor([1.0, 1.0, 0.1])
    offset = near + rise + 2e-4 * random(STEPS + 1, model.worlds, 3)
    normal = normal + 2e-3 * random(STEPS + 1, model.worlds, 3, model.dim)
    found |= {"wall_offset": 1.3 * offset, "wall_normal": 1.3 * normal}
    shape = model.anchor_shape
    n = normal[0, :, :2]
    across = rest - torch.einsum("pd,wkd->wkp", rest, n)[..., None] * n[:, :, None]
    found["anchor"] = (across + 1e-3 * random(*shape)).to(model.dtype)
    return {name: tensor.detach().to(model.device).requires_grad_() for name, tensor in found.items()}


def start_of(leaves: dict[str, torch.Tensor]) -> softmpm.State:
    if "anchor" not in leaves:
        return softmpm.State(*(leaves[name] for name in "xvCF"))
    surface = softmpm.SurfaceState(leaves["anchor"], torch.zeros_like(leaves["anchor"]))
    return softmpm.State(*(leaves[name] for name in "xvCF"), surface=surface)


def run(model: softmpm.Model, leaves: dict[str, torch.Tensor], by_reference=False) -> list[torch.Tensor]:
    """x, v, C, F, anchors and forces at the end, by the model or by the oracle."""
    start = start_of(leaves)
    params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))
    inputs, activation = Inputs(**{name: leaves[name] for name in NAMES}), leaves["activation"]
    if not by_reference:
        end = softmpm.simulate(model, start, activation, params, substeps=SUBSTEPS, inputs=inputs)
        return list(end.differentiable())
    end, *surface = moving_contact.simulate(
        model.scene,
        start,
        activation,
        params,
        substeps=SUBSTEPS,
        inputs=inputs,
        points=moving_contact.surface_points(model.scene),
        anchor=leaves.get("anchor"),
        smoothing=model.contact_width * model.scene.grid.spacing,
    )
    return [*end[:4], *surface]


def loss_of(parts: list[torch.Tensor]) -> torch.Tensor:
    weights = [cotangent(softmpm.State(*4 * [part]), seed=k)[0] for k, part in enumerate(parts)]
    return sum(((w * part).sum() for w, part in zip(weights, parts, strict=True)), torch.zeros(()))


@pytest.mark.parametrize(
    "dim, dtype, width, scheme, limit",
    [
        (2, torch.float64, 0.0, "fast", 1e-10),
        (2, torch.float64, 0.05, "fast", 1e-10),
        (2, torch.float64, 0.05, "plain", 1e-10),
        (3, torch.float64, 0.05, "fast", 1e-10),
        (2, torch.float32, 0.05, "auto", 2e-3),
    ],
    ids=["2d", "smooth", "plain", "3d", "single"],
)
def test_contact_is_that_of_the_reference(dim, dtype, width, scheme, limit, device):
    """The state, the forces and the gradient of all of them with respect to every input and to anchors: points that stick,
    slip and hang free, some at two walls, which move."""
    settings = dict(device=device, dtype=dtype, worlds=2, inputs=NAMES, contact_width=width, scheme=scheme)
    model = build(pressed(dim), **settings)
    assert model.scheme == ("plain" if scheme == "plain" else "fast")
    leaves = leaves_of(model)
    copies = {name: t.detach().cpu().double().requires_grad_() for name, t in leaves.items()}
    found = []
    for tensors, exact in ((leaves, False), (copies, True)):
        parts = run(model, tensors, exact)
        found.append([*parts, *torch.autograd.grad(loss_of(parts), list(tensors.values()))])
    force = found[1][5]
    touches = (force != 0).any(-1)
    assert touches.any(2).any(0).all() and not touches.all() and (touches.all(1).any() or width == 0)
    for name, got, want in zip([*"xvCF", "anchor", "force", *leaves], *found, strict=True):
        assert want.abs().max() > 0, f"the test does not exercise {name}"
        assert_relative(got.detach().cpu().double(), want.detach(), limit, name)


@pytest.mark.gpu
@pytest.mark.parametrize("dim", [2, 3])
def test_contact_with_few_lanes_is_that_of_the_reference(dim, monkeypatch):
    """Many points have fewer lanes than nodes, so that a lane takes several nodes and a warp has points near and far."""
    monkeypatch.setattr(lanes, "THREADS", 1)
    test_contact_is_that_of_the_reference(dim, torch.float64, 0.05, "fast", 1e-10, "cuda")


def test_a_state_without_points_has_gradients_too():
    """Through the anchors, which are where x and F show the points, on walls that turn: ≤ 1e-10."""
    model = build(pressed(2), worlds=2, inputs=NAMES, contact_width=0.05)
    leaves = {name: leaf for name, leaf in leaves_of(model).items() if name != "anchor"}
    names = ["x", "F", "wall_normal"]
    found = []
    for exact in (False, True):
        parts = run(model, leaves, exact)
        found.append([*parts, *torch.autograd.grad(loss_of(parts), [leaves[name] for name in names])])
    for name, got, want in zip([*"xvCF", "anchor", "force", *names], *found, strict=True):
        assert_relative(got.detach(), want.detach(), 1e-10, name)


def test_gradients_are_central_differences():
    """Along one random direction of positions, deformations, masses and walls: ≤ 1e-6."""
    model = build(pressed(2), worlds=2, inputs=NAMES)
    leaves = leaves_of(model)
    names = ["x", "F", "v", "density", "friction", *WALLS]
    gradient = torch.autograd.grad(loss_of(run(model, leaves)), [leaves[name] for name in names])
    for name, slope in zip(names, gradient, strict=True):
        d = torch.randn(slope.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        h = 1e-8 if name in ("x", "wall_offset", "wall_normal") else 1e-6
        with torch.no_grad():
            ends = [loss_of(run(model, leaves | {name: leaves[name] + sign * h * d})) for sign in (1, -1)]
        want = (ends[0] - ends[1]).item() / (2 * h)
        assert (slope * d).sum().item() == pytest.approx(want, rel=1e-6), name


def test_a_tape_gives_the_gradients_of_simulate(device):
    """The end and the gradients of steps, each of which is a control step, with walls that move: ≤ 1e-12."""
    model = build(pressed(2), device=device, worlds=2, inputs=NAMES, contact_width=0.05, scheme="plain")
    leaves = {name: leaf.detach() for name, leaf in leaves_of(model).items()}
    leaves |= {name: leaves[name].requires_grad_() for name in ("x", "anchor", "friction", "viscosity")}
    given = {name: leaves[name][:2] for name in WALLS[:2]} | {"wall_velocity": leaves["wall_velocity"][:1]}
    given |= {name: leaves[name] for name in ("gravity", "friction", "viscosity")}
    params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))
    row, t = leaves["activation"][:1], types(2, "float64")
    end = softmpm.simulate(model, start_of(leaves), row, params, substeps=1, inputs=Inputs(**given))
    weights = [
        cotangent(softmpm.State(*4 * [part]), seed=k)[0] for k, part in enumerate(end.differentiable())
    ]
    names = ("x", "anchor", "friction", "viscosity")
    want = torch.autograd.grad(end.differentiable(), [leaves[name] for name in names], weights)

    still = Inputs(**{name: value.detach() for name, value in given.items()})
    solid = softmpm.warp_solid(model, params, row[0], still, requires_grad=True)
    start = start_of({name: leaf.detach() for name, leaf in leaves.items()})
    first = softmpm.warp_state(model, start, requires_grad=True)
    second, tape = softmpm.warp_state(model, requires_grad=True), wp.Tape()
    softmpm.step(model, first, second, solid, tape=tape)
    for got, one in zip(
        softmpm.torch_state(model, second).differentiable(), end.differentiable(), strict=True
    ):
        assert_relative(got, one.detach(), 1e-12)
    assert second.anchor is not None and second.force is not None
    weights[0] *= model.scene.grid.spacing
    arrays = zip((second.fx, second.v, second.C, second.H, second.anchor, second.force), weights, strict=True)
    kinds = (t.vec, t.vec, t.mat, t.mat, t.vec, t.vec)
    tape.backward(
        grads={
            array: wp.from_torch(weight.contiguous(), dtype=kind)
            for (array, weight), kind in zip(arrays, kinds, strict=True)
        }
    )
    assert first.anchor is not None
    found = (first.fx, first.anchor, solid.others["friction"], solid.others["viscosity"])
    for name, array, one in zip(names, found, want, strict=True):
        got = wp.to_torch(array.grad) / (model.scene.grid.spacing if name == "x" else 1.0)
        assert_relative(got, one, 1e-12, name)
    solid.raise_failure(model, second)


def test_calls_in_turn_are_one_call(scheme, monkeypatch):
    """Anchors and walls go on where they were, also where states are recomputed and where chunks end within control steps: the
    same end but for the rounding of particles between calls, ≤ 1e-13, and the same gradient."""
    settings = dict(worlds=2, inputs=NAMES, contact_width=0.05, scheme=scheme)
    model = build(pressed(2), **settings)
    leaves = leaves_of(model)
    whole = run(model, leaves)
    params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))
    others = {name: leaves[name] for name in NAMES if name not in WALLS}
    state = start_of(leaves)
    for c in range(STEPS):
        poses = {name: leaves[name][c : c + 2] for name in WALLS[:2]}
        inputs = Inputs(**poses, wall_velocity=leaves["wall_velocity"][c : c + 1], **others)
        row = leaves["activation"][c : c + 1]
        state = softmpm.simulate(model, state, row, params, substeps=SUBSTEPS, inputs=inputs)
    thrifty = build(pressed(2), **settings, **little_memory(model))
    wanted = torch.autograd.grad(loss_of(whole), list(leaves.values()))
    monkeypatch.setattr(memory, "LONGEST", 2)
    shorter = build(pressed(2), **settings)
    assert {chunk.length for chunk in Horizon(STEPS, SUBSTEPS).chunks(shorter.sizes().longest)} == {1, 2}
    for parts in (list(state.differentiable()), run(thrifty, leaves), run(shorter, leaves)):
        for got, want in zip(parts, whole, strict=True):
            assert_relative(got, want, 1e-13)
        gradient = torch.autograd.grad(loss_of(parts), list(leaves.values()))
        for name, got, want in zip(leaves, gradient, wanted, strict=True):
            assert_relative(got, want, 1e-10, name)


def test_worlds_are_those_of_runs_alone():
    """Each world of two is that of a model of one with its inputs: the same end, ≤ 1e-13."""
    settings = dict(inputs=NAMES, contact_width=0.05)
    both, alone = build(pressed(2), worlds=2, **settings), build(pressed(2), **settings)
    leaves = {name: leaf.detach() for name, leaf in leaves_of(both).items()}
    axes = dict.fromkeys(leaves, 0) | {"activation": 1}
    axes |= {name: QUANTITIES[name].axes.index("world") for name in NAMES}
    ends = run(both, leaves)
    for world in range(2):
        own = {name: leaf.narrow(axes[name], world, 1) for name, leaf in leaves.items()}
        for got, want in zip(run(alone, own), ends, strict=True):
            assert_relative(got[0], want[world], 1e-13)


def test_a_world_that_fails_does_not_touch_the_others(scheme):
    """A wall that jumps into one world stops it with `in_wall`; its state stays, its gradient is zero."""
    alarms = dataclasses.replace(QUIET, depth=1.0)
    model = build(pressed(2), worlds=2, inputs=NAMES, alarms=alarms, scheme=scheme)
    leaves = leaves_of(model)
    with torch.no_grad():
        leaves["wall_offset"][2:, 1] += 0.2
    params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))
    settings = dict(substeps=SUBSTEPS, inputs=Inputs(**{name: leaves[name] for name in NAMES}))
    start = start_of(leaves)
    with pytest.raises(softmpm.UnstableError, match="surface point .* inside wall") as raised:
        softmpm.simulate(model, start, leaves["activation"], params, **settings)
    assert (raised.value.kind, raised.value.world, raised.value.substep) == ("in_wall", 1, SUBSTEPS)
    assert raised.value.state is not None and raised.value.state.surface is not None
    for policy in ("reset", "freeze"):
        failures = softmpm.Failures(policy)
        end = softmpm.simulate(model, start, leaves["activation"], params, failures=failures, **settings)
        assert [error.world for error in failures.errors] == [1] and end.surface is not None
        assert torch.isfinite(end.surface.anchor).all()
    assert end.surface is not None
    gradient = torch.autograd.grad(
        dot(cotangent(end), end) + end.surface.force.sum(), [leaves["x"], leaves["anchor"]]
    )
    for one in gradient:
        assert one[0].abs().max() > 0 and not one[1].any()


@pytest.mark.gpu
def test_a_captured_call_is_one_that_is_not():
    """End, forces and gradient of a :class:`softmpm.Graph`, replayed twice, within what sums in another order change."""
    model = build(pressed(2), device="cuda", dtype=torch.float32, worlds=2, inputs=NAMES, contact_width=0.05)
    leaves = leaves_of(model)

    weights = [torch.randn_like(part) for part in run(model, leaves)]

    def work() -> list[torch.Tensor]:
        parts = run(model, leaves)
        gradient = torch.autograd.grad(parts, list(leaves.values()), weights)
        return [*(part.detach() for part in parts), *gradient]

    graph = softmpm.Graph(work, model.device)
    want = [tensor.clone() for tensor in graph()]
    for _ in range(2):
        for got, one in zip(graph(), want, strict=True):
            assert_relative(got, one, 2e-3)


def test_a_window_has_room_for_every_point():
    """The adjoints of walls have a place for each point among the nodes in memory: with more points than a window would have nodes, the
    gradients are those of the plain scheme, ≤ 1e-10."""
    made = dataclasses.replace(pressed(2), grid=softmpm.Grid(shape=(40, 40), spacing=0.1))
    shape, material = made.bodies[0].particles, made.bodies[0].material
    outline, many = shape.outline, 40
    assert outline is not None
    outline = softmpm.Outline(
        *(np.repeat(part, many, axis=0) for part in (outline.points, outline.normals)),
        np.repeat(outline.areas / many, many),
    )
    body = softmpm.Body(softmpm.Particles(shape.positions, shape.volume, outline), material)
    few, found = build(made).held_nodes, []
    for scheme in ("fast", "plain"):
        model = build(
            dataclasses.replace(made, bodies=[body]),
            worlds=2,
            inputs=NAMES,
            contact_width=0.05,
            scheme=scheme,
        )
        leaves = leaves_of(model)
        wanted = [leaves[name] for name in ("friction", *WALLS)]
        found.append(torch.autograd.grad(loss_of(run(model, leaves)), wanted))
        if scheme == "fast":
            assert few < points_of(model).count <= model.held_nodes < model.node_count
    for got, want in zip(*found, strict=True):
        assert_relative(got, want, 1e-10)


@pytest.fixture(scope="module")
def settled() -> tuple[softmpm.Model, softmpm.State]:
    model = build(slab(), alarms=None)
    return model, softmpm.simulate(model, model.rest(), None, model.params(), substeps=2500)


def test_a_block_rests_on_the_floor(settled):
    """Its sole is within 0.005 cells of the floor, half a cell with contact at nodes, and the floor bears its weight."""
    model, state = settled
    sole = points_of(model).points[:, 1] <= model.scene.walls[0].offset + 1e-9
    forces = softmpm.contact_forces(model, state)
    gap = forces.points[0, sole, 1] - model.scene.walls[0].offset
    assert gap.abs().max() < 0.005 * model.scene.grid.spacing
    weight = (model.mass.sum() * G).item()
    assert forces.total[0, 0, 1].item() == pytest.approx(weight, rel=1e-4)


def test_forces_are_means_of_control_steps_of_any_length(monkeypatch):
    """Those of 4 substeps are the means of those of 2 and 2, in calls that share their chunk graphs, but for the rounding of x between
    calls, 1e-16 m where a point is 1e-7 m inside the floor: ≤ 1e-11."""
    monkeypatch.setattr(memory, "LONGEST", 2)
    model = build(slab(), alarms=None)
    start, found = model.rest(), {}
    start = softmpm.simulate(model, start, None, model.params(), substeps=40)
    for substeps in (4, 2):
        found[substeps] = softmpm.simulate(model, start, None, model.params(), substeps=substeps)
    second = softmpm.simulate(model, found[2], None, model.params(), substeps=2)
    forces = [state.surface.force for state in (found[2], second)]
    assert (forces[0] - forces[1]).abs().max() > 1e-3 * forces[0].abs().max() > 0
    assert_relative((forces[0] + forces[1]) / 2, found[4].surface.force, 1e-11)


@pytest.mark.parametrize("degrees", [3.0, -0.5])
def test_a_block_on_an_incline(degrees, settled):
    """Above the angle of friction it slides as a rigid one, within 0.5 %; below it sticks."""
    angle = np.arctan(0.5) + np.radians(degrees)
    made = slab(gravity=(G * np.sin(angle), -G * np.cos(angle)))
    model, exact = build(made, alarms=None), G * (np.sin(angle) - 0.5 * np.cos(angle))
    before = softmpm.simulate(model, model.rest(), None, model.params(), substeps=1500)
    end = softmpm.simulate(model, before, None, model.params(), substeps=500)
    if degrees < 0:
        assert velocity(model, end)[0].abs() < 1e-5
    else:
        gained = (velocity(model, end) - velocity(model, before))[0].item() / (500 * made.dt)
        assert gained == pytest.approx(exact, rel=5e-3)


@pytest.mark.parametrize("scheme", ["plain", "fast"])
def test_a_point_out_of_reach_has_its_place_as_anchor(scheme):
    """Further than a cell from the floor a sliding point leaves x_t, nearer x_t + Δt v_t; it gets no impulse in either case."""
    scene = slab(gravity=(0.0, 0.0))
    above = dataclasses.replace(scene.walls[0], offset=scene.walls[0].offset - 0.3 * scene.grid.spacing)
    model = build(dataclasses.replace(scene, walls=[above]), scheme=scheme)
    start = model.rest()
    start.v[..., 0] = 2.0
    rest, end = points_of(model).points, softmpm.simulate(model, start, None, model.params(), substeps=1)
    far = rest[:, 1] - above.offset > scene.grid.spacing
    assert far.any() and not far.all() and end.surface is not None
    moved = end.surface.anchor[0, 0, :, 0] - rest[:, 0]
    torch.testing.assert_close(moved, (~far).double() * 2.0 * scene.dt, rtol=1e-9, atol=1e-15)
    assert (end.surface.force == 0).all()


def test_places_are_exact_for_affine_motion():
    """x = c + B X and F = B give c + B X_s, in float32 with the low-order parts too."""
    for dtype in (torch.float64, torch.float32):
        model = build(slab(), dtype=dtype, alarms=None)
        B = torch.tensor([[1.1, 0.3], [-0.2, 0.8]], dtype=torch.float64)
        exact = torch.from_numpy(model.exact_positions) @ B.T + 0.1
        x, F = exact.to(dtype)[None], B.to(dtype).expand(1, len(exact), 2, 2)
        low = softmpm.Low(
            (exact - x[0].double()).to(dtype)[None], (B - B.to(dtype).double()).to(dtype).expand_as(F)
        )
        state = softmpm.State(x, torch.zeros_like(x), torch.zeros_like(F), F, low)
        want = points_of(model).points @ B.T + 0.1
        torch.testing.assert_close(points_of(model).shown(state)[0], want, rtol=0, atol=1e-13)


def test_of_two_particles_equally_near_the_inner_one_carries_a_point():
    """Four by four particles and two points on each side, halfway between two of them: the carriers are as symmetric as the body."""
    coarse, fine = (softmpm.box((0.0, 0.0), (1.0, 1.0), spacing) for spacing in (0.5, 0.25))
    shape = softmpm.Particles(fine.positions, fine.volume, coarse.outline).moved((0.3, 0.4))
    scene = slab()
    body = dataclasses.replace(scene.bodies[0], particles=shape)
    carried = CarriedPoints(dataclasses.replace(scene, bodies=[body]), torch.device("cpu"))
    away = np.abs(shape.positions[carried.nearest] - (0.8, 0.9))
    np.testing.assert_allclose(np.sort(away, axis=1), [(0.125, 0.375)] * 8, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_depth_of_a_start_is_that_of_its_points(dtype, device):
    """Of a body that is turned and sheared: the alarm is that of the first point that is too deep, and of no point a little higher."""
    B = torch.tensor([[1.02, 0.1], [-0.15, 0.97]], dtype=torch.float64)
    # ``low`` is what the low-order parts have, as if x and F were rounded so.
    for above, low in itertools.product((-1e-4, 1e-4), (0.0, 2e-3)):
        model = build(slab(), dtype=dtype, alarms=softmpm.Alarms(), device=device)
        exact = torch.from_numpy(model.exact_positions).to(device) @ B.T.to(device) + 0.1
        x, F = (exact - low).to(dtype)[None], (B - low).to(device, dtype).expand(1, len(exact), 2, 2)
        rest = softmpm.Low(torch.full_like(x, low), torch.full_like(F, low)) if low else None
        state = softmpm.State(x, torch.zeros_like(x), torch.zeros_like(F), F, rest)
        height = (points_of(model).points @ B.T.to(device) + 0.1)[:, 1] + deepest(model)
        wall = softmpm.Wall(normal=(0.0, 1.0), offset=height.min().item() - above / 32)
        model = build(slab(walls=[wall]), dtype=dtype, alarms=softmpm.Alarms(), device=device)
        words = torch.full((1,), NEVER, dtype=torch.int64, device=device)
        check_start(model, state, {}, words)
        found = failed_worlds(words.tolist())
        assert found == ([] if above > 0 else [0])
        assert not found or decode(words.item())[1:] == (Kind.IN_WALL, int(height.argmin()))


@pytest.mark.parametrize("scheme", ["plain", "fast"])
def test_an_anchor_that_is_not_finite_is_refused(scheme, monkeypatch):
    """By its place; where values cannot be read, the kernels stop at what it does. It never switches contact off."""
    model = build(slab(), alarms=softmpm.Alarms(), scheme=scheme, worlds=2)
    args = (None, model.params())
    state = softmpm.simulate(model, model.rest(), *args, substeps=400)
    pressed = int(softmpm.contact_forces(model, state).traction[1, 0, :, 1].argmax())
    anchor = state.surface.anchor.clone()
    anchor[1, 0, pressed] = torch.nan
    bad = state._replace(surface=state.surface._replace(anchor=anchor))
    with pytest.raises(ValueError, match=rf"state.surface.anchor\[1, 0, {pressed}, 0\] is nan"):
        softmpm.simulate(model, bad, *args, substeps=1)
    monkeypatch.setattr("softmpm.autograd.check_finite", lambda *_: None)
    with pytest.raises(softmpm.UnstableError, match="of world 1") as caught:
        softmpm.simulate(model, bad, *args, substeps=20)
    assert caught.value.kind == "not_finite"


def test_what_cannot_be_is_refused(settled):
    """Fixed-point sums, and a state of another model."""
    model, state = settled
    with pytest.raises(ValueError, match="deterministic=True has no contact at surface points in the fast"):
        build(slab(), deterministic=True)
    ordered = build(slab(), dtype=torch.float32, deterministic=True, scheme="auto")
    assert "plain: deterministic contact at surface points" in ordered.describe()
    args = (None, model.params())
    at_nodes = softmpm.build(slab(), device="cpu", dtype=torch.float64, contact="nodes")
    with pytest.raises(ValueError, match="state.surface must be None"):
        softmpm.simulate(at_nodes, state, *args, substeps=1)
