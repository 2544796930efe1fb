"""Clamps and planes of symmetry: every value and gradient against the float64 oracle, and what they promise."""

import ast
import dataclasses
import re

import numpy as np
import pytest
import torch
import warp as wp
from helpers import assert_relative, busy_inputs, cotangent, dot, little_memory, surface_of
from surface_scenes import build, compare

import softmpm
from softmpm.oracle import lagrangian
from softmpm.schemes.lagrangian.nodal import particles_of

NAMES = ("gravity", "damping", "friction", "viscosity", "force")


def corner(dim: int, **changes) -> softmpm.Scene:
    """A block in a clamp on the left, between two planes of symmetry in front, on two rough floors and at a slipping side wall. No node
    lies on a wall: rounding would decide its side."""
    lower, upper = (0.2, 0.33, 0.15)[:dim], (0.42, 0.52, 0.45)[:dim]
    shape = softmpm.box(lower, upper, spacing=0.05)
    material = softmpm.NeoHookean(density=1.2, young=80.0, poisson=0.3, viscosity=0.02)
    settings = dict(
        grid=softmpm.Grid(shape=(9, 10, 8)[:dim], spacing=0.1),
        bodies=[softmpm.Body(shape, material)],
        muscles=[softmpm.Muscle(particles=np.arange(6), direction=(1.0, 0.4, 0.2)[:dim], strength=10.0)],
        walls=[
            softmpm.Wall(normal=(1.0, 0.0, 0.0)[:dim], offset=0.2, contact="clamp"),
            softmpm.Wall(normal=(0.1, 1.0, 0.05)[:dim], offset=0.3501, friction=0.4),
            softmpm.Wall(normal=(-0.4, 1.0, 0.0)[:dim], offset=0.2201, friction=0.2),
            softmpm.Wall(normal=(-1.0, 0.2, 0.0)[:dim], offset=-0.35, contact="slip"),
            *[
                softmpm.Wall(normal=(0.0, 0.0, side), offset=side * place, contact="symmetry")
                for side, place in ((1.0, 0.15), (-1.0, 0.45))[: 2 * (dim - 2)]
            ],
        ],
        gravity=(0.3, -9.8, 0.2)[:dim],
        damping=0.7,
        dt=3e-3,
    )
    return softmpm.Scene(**(settings | changes))


@pytest.mark.parametrize("contact", ["nodes", "surface"])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_end_and_all_gradients_are_those_of_the_reference(dim, contact, device):
    """A clamp, planes of symmetry, walls on nodes and at surface points at once, in two worlds."""
    for dtype, limit in ((torch.float64, 1e-10), (torch.float32, 2e-3)):
        settings = dict(device=device, dtype=dtype, worlds=2, inputs=NAMES, contact=contact)
        model = build(corner(dim), **settings)
        compare(model, NAMES, limit)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_reference_agrees_with_central_differences(dim):
    """Through four substeps with both reflections, along one random direction of the nodes and of the density."""
    made = corner(dim)
    model = build(made, dtype=torch.float64, contact="surface")
    surface, params = surface_of(model), model.params()
    generator = torch.Generator().manual_seed(3)
    state = model.rest()
    state = state._replace(v=torch.randn(state.v.shape, generator=generator, dtype=torch.float64))
    u, v = lagrangian.project(made, state, params)
    ways = [torch.randn(t.shape, generator=generator, dtype=torch.float64) for t in (v, params.density)]
    mass = lagrangian.node_mass(made, lagrangian.quadrature(made), params.density * model.volume[None])
    ways[0] *= (mass > 0)[..., None]

    def loss(v, density):
        end = lagrangian.simulate(
            made, u, v, None, params._replace(density=density), substeps=4, surface=surface
        )
        forces = (torch.arange(1.0, 1 + end[-1].numel()).view_as(end[-1]) * end[-1]).sum()
        return dot(cotangent(softmpm.State(*end[:2], *end[:2])), softmpm.State(*end[:2], *end[:2])) + forces

    leaves = [v.clone().requires_grad_(), params.density.clone().requires_grad_()]
    gradient = dot(ways, torch.autograd.grad(loss(*leaves), leaves)).item()
    h = 1e-6
    up, down = (
        loss(*(t + step * way for t, way in zip((v, params.density), ways, strict=True))).item()
        for step in (h, -h)
    )
    assert abs((up - down) / (2 * h) - gradient) <= 1e-7 * abs(gradient)


def test_a_reflection_is_a_projection_that_takes_energy(device):
    """(B1) twice is (B1) once, the field is its own image, and the kinetic energy does not grow."""
    model = build(corner(3), device=device, dtype=torch.float64)
    mirror, rest = model.mirror, model.rest_grid
    assert mirror is not None
    mass = float(model.mass[0]) * rest.weight[None]
    v = torch.randn(1, rest.count, 3, dtype=torch.float64).to(model.device)
    (once,) = mirror.reflected(mass, v)
    (twice,) = mirror.reflected(mass, once)
    torch.testing.assert_close(twice, once, rtol=1e-13, atol=1e-14)
    assert mirror.apart(once) == 0.0 and mirror.apart(v) > 0.1
    energy, before = ((mass[..., None] * field.square()).sum() for field in (once, v))
    torch.testing.assert_close(
        before - energy, (mass[..., None] * (v - once).square()).sum(), rtol=1e-12, atol=0
    )
    on = rest.nodes[:, 0] == 2
    assert on.any() and (once[:, on] == 0).all()  # the clamp at 0.2 m
    between = rest.nodes[:, 2] == 3  # not near a plane of symmetry, nor the clamp
    free = between & (rest.nodes[:, 0] > 3)
    assert free.any() and torch.equal(once[:, free], v[:, free])


def test_calls_in_turn_and_short_chunks_are_one_call(device):
    """A state with nodes continues to the bit, with its gradient; forces of clamps also where a chunk ends within a control step."""
    model = build(corner(2), device=device, dtype=torch.float64)
    short = build(corner(2), device=device, dtype=torch.float64, **little_memory(model))
    inputs = busy_inputs(model, control_steps=3)
    start, rows = softmpm.State(*(inputs[name] for name in "xvCF")), inputs["activation"]
    whole = softmpm.simulate(model, start, rows, model.params(), substeps=7)
    first = softmpm.simulate(model, start, rows[:2], model.params(), substeps=7)
    parts = softmpm.simulate(model, first, rows[2:], model.params(), substeps=7)
    little = softmpm.simulate(short, start, rows, short.params(), substeps=7)
    found = []
    for end in (whole, parts, little):
        forces = softmpm.clamp_forces(model, end)
        assert torch.equal(forces, softmpm.clamp_forces(model, whole))
        for got, want in zip(end[:4], whole[:4], strict=True):
            assert torch.equal(got, want)
        loss = dot(cotangent(end), end) + (forces * torch.tensor([1.0, -2.0]).to(forces)).sum()
        found.append(torch.autograd.grad(loss, list(inputs.values())[:5]))
    for other in found[1:]:
        for name, want, got in zip(inputs, found[0], other, strict=False):
            assert_relative(got, want, 1e-12, name)


def test_the_force_of_a_clamp_is_the_weight_at_rest(device):
    """Of a block that hangs in a clamp, to 1e-6, with the gradient of a weight: the mass."""
    body = corner(2).bodies[0]
    bodies = [softmpm.Body(body.particles, dataclasses.replace(body.material, viscosity=0.5))]
    made = corner(2, bodies=bodies, walls=corner(2).walls[:1], muscles=[], gravity=(9.8, 0.0), damping=0.0)
    model = build(made, device=device, dtype=torch.float64, inputs=("gravity",))
    rest = softmpm.simulate(model, model.rest(), None, model.params(), substeps=1000).detach()
    gravity = torch.tensor([9.8, 0.0], dtype=torch.float64, device=model.device, requires_grad=True)
    inputs = softmpm.Inputs(gravity=gravity)
    end = softmpm.simulate(model, rest, None, model.params(), substeps=1000, inputs=inputs)
    force, mass = softmpm.clamp_forces(model, end)[0, 0], model.mass.sum().item()
    assert force.tolist() == pytest.approx([-9.8 * mass, 0.0], abs=1e-6 * 9.8 * mass)
    (slope,) = torch.autograd.grad(force[0], gravity)
    assert slope.tolist() == pytest.approx([-mass, 0.0], abs=1e-6 * mass)


@pytest.mark.parametrize("contact", ["nodes", "surface"])
def test_forces_of_clamps_are_the_change_of_momentum(contact, device):
    """Of a moving block between a clamp and a plane of symmetry that meet, T times their forces, those of the floor and the weight:
    ≤ 1e-12. The plane of symmetry pulls along its normal only."""
    symmetry = softmpm.Wall(normal=(0.0, -1.0), offset=-0.5, contact="symmetry")
    floor = [softmpm.Wall(normal=(0.0, 1.0), offset=0.331, friction=0.4)] if contact == "surface" else []
    shape = softmpm.box((0.2, 0.33), (0.42, 0.5), spacing=0.05)
    bodies = [softmpm.Body(shape, corner(2).bodies[0].material)]
    walls = [corner(2).walls[0], *floor, symmetry]
    made = corner(2, bodies=bodies, walls=walls, muscles=[], damping=0.0)
    model = build(made, device=device, dtype=torch.float64, contact=contact)
    state, T = model.rest(), 20 * made.dt
    for _ in range(3):
        before = (model.mass[:, None] * state.v[0]).sum(0)
        state = softmpm.simulate(model, state, None, model.params(), substeps=20)
        gained = (model.mass[:, None] * state.v[0]).sum(0) - before
        forces = softmpm.clamp_forces(model, state)[0]
        total = forces.sum(0) + model.mass.sum() * torch.tensor(made.gravity, dtype=torch.float64).to(gained)
        if floor:
            touched = softmpm.contact_forces(model, state).total[0, 0]
            total = total + touched
        torch.testing.assert_close(T * total, gained, rtol=0, atol=1e-12)
        assert (forces[0] != 0).all() and forces[1, 0] == 0 and forces[1, 1] != 0
    assert not floor or (touched != 0).all()


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_rows_of_forces_lead_to_walls_of_the_scene(formulation):
    """Contact forces and clamp forces count walls of their kinds alone; the model has the number of each in the scene."""
    clamp, floor = corner(2).walls[:2]
    slip = softmpm.Wall(normal=(-1.0, 0.0), offset=-0.7, contact="slip")
    ceiling = softmpm.Wall(normal=(0.0, -1.0), offset=-0.8)
    walls = [slip, clamp, floor, ceiling] if formulation == "reference" else [slip, floor, ceiling]
    model = softmpm.build(
        corner(2, walls=walls, muscles=[]), device="cpu", formulation=formulation, contact="surface"
    )
    state = softmpm.simulate(model, model.rest(), None, model.params(), substeps=40)
    assert model.surface is not None
    total, numbers = softmpm.contact_forces(model, state).total, model.surface.walls
    assert [walls[k] for k in numbers] == [floor, ceiling] and total.shape == (1, 2, 2)
    assert total[0, numbers.index(walls.index(floor)), 1] > 0 and not total[0, 1].any()
    if formulation == "reference":
        assert model.mirror is not None and model.mirror.walls == (1,)
        assert softmpm.clamp_forces(model, state).shape == (1, 1, 2)


def test_a_step_on_warp_arrays_has_the_forces_of_simulate(device):
    """Forces and their gradient with respect to the state, to the bit."""
    model = build(corner(2), device=device, dtype=torch.float64)
    start = softmpm.State(*(t.detach() for t in list(busy_inputs(model).values())[:4]))
    solid = softmpm.warp_solid(model, requires_grad=True)
    now, then = (softmpm.warp_state(model, start, solid, requires_grad=True) for _ in range(2))
    assert isinstance(now, softmpm.WarpNodal) and isinstance(then, softmpm.WarpNodal)
    nodes = now.nodal().clone()
    nodes = nodes._replace(u=nodes.u.requires_grad_(), v=nodes.v.requires_grad_())
    end = softmpm.simulate(model, particles_of(model, nodes), None, model.params(), substeps=1)
    assert end.nodes is not None and end.nodes.reaction is not None
    reaction = end.nodes.reaction
    weights = cotangent(softmpm.State(*4 * [reaction]), seed=3)[0]
    want = torch.autograd.grad((weights * reaction).sum(), [nodes.u, nodes.v])
    tape = wp.Tape()
    softmpm.step(model, now, then, solid, tape=tape)
    tape.backward(grads={then.reaction: wp.from_torch(weights, dtype=wp.vec2d)})
    assert torch.equal(then.nodal().reaction, reaction.detach())
    for got, there in zip(now.adj(), want, strict=False):
        assert there.abs().max() > 0 and torch.equal(got, there)


def test_what_has_no_forces_of_clamps_is_refused():
    """A scene without clamps, and a state that simulate did not return."""
    model = build(corner(2), dtype=torch.float64)
    with pytest.raises(ValueError, match="got one without nodes or their reaction; simulate from it first"):
        softmpm.clamp_forces(model, model.rest())
    other = build(corner(2, walls=corner(2).walls[1:3]), dtype=torch.float64)
    with pytest.raises(ValueError, match="needs a wall of the kind clamp or symmetry, got separate"):
        softmpm.clamp_forces(other, other.rest())


def test_nodes_that_are_not_images_are_refused():
    """A change of state.nodes that a clamp does not allow, shown by the particles too."""
    model = build(corner(2), dtype=torch.float64)
    state = softmpm.simulate(model, model.rest(), None, model.params(), substeps=2)
    assert state.nodes is not None
    for nodes in (state.nodes._replace(u=state.nodes.u + 1e-3), state.nodes._replace(v=0.5 + state.nodes.v)):
        with pytest.raises(ValueError, match="must be zero or reflected at clamps"):
            softmpm.simulate(model, particles_of(model, nodes), None, model.params(), substeps=1)


def test_a_slab_between_planes_of_symmetry_is_plane_strain(device):
    """One cell thick, in 3D, with a clamp at one end: the motion of the plane scene, to rounding."""
    ends = []
    for dim in (2, 3):
        shape = softmpm.box((0.2, 0.3, 0.3)[:dim], (0.6, 0.5, 0.4)[:dim], spacing=0.05)
        sides = [
            softmpm.Wall(normal=(0.0, 0.0, side), offset=side * place, contact="symmetry")
            for side, place in ((1.0, 0.3), (-1.0, 0.4))[: 2 * (dim - 2)]
        ]
        clamp = softmpm.Wall(normal=(1.0, 0.0, 0.0)[:dim], offset=0.2, contact="clamp")
        material = softmpm.NeoHookean(density=1.0, young=200.0, poisson=0.3)
        made = softmpm.Scene(
            grid=softmpm.Grid(shape=(9, 9, 7)[:dim], spacing=0.1),
            bodies=[softmpm.Body(shape, material)],
            walls=[clamp, *sides],
            gravity=(0.0, -9.8, 0.0)[:dim],
            dt=2e-3,
        )
        model = build(made, device=device, dtype=torch.float64)
        end = softmpm.simulate(model, model.rest(), None, model.params(), substeps=50)
        if dim == 3:
            torch.testing.assert_close(end.x[..., 2], model.rest().x[..., 2], rtol=0, atol=1e-14)
            assert end.x.shape[1] == 2 * len(ends[0])
        ends.append((end.x - model.rest().x)[0, :: dim - 1, :2])
    assert ends[0].abs().max() > 0.01
    torch.testing.assert_close(ends[1], ends[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("wall", "said"),
    [
        (dict(normal=(1.0, 0.1), offset=0.2), "normal along an axis of the grid"),
        (dict(offset=0.21), "must lie on nodes or midway"),
        (dict(offset=0.25), "cut the body off there"),
        (dict(offset=0.1), "nearest particle is 0.1275 m in front"),
        (dict(friction=0.1), "a clamp wall has no friction"),
    ],
)
def test_clamps_that_cannot_be_are_refused(wall, said):
    """With the rule, the value and a remedy."""

    def make():
        return build(corner(2, walls=[softmpm.Wall(**(settings | wall))]))

    settings = dict(normal=(1.0, 0.0), offset=0.2, contact="clamp")
    with pytest.raises(ValueError, match=said):
        make()


@pytest.mark.parametrize(
    ("name", "changes"), [("wall_offset", 0.01), ("wall_normal", (0.0, 0.1)), ("wall_velocity", (0.0, 0.1))]
)
def test_walls_that_reflect_do_not_move(name, changes):
    """In no pose: nothing would follow. The other walls may, and the scene's own pose may have any length of the normal."""
    made = corner(2)
    model = build(made, inputs=("wall_offset",))
    offset = torch.tensor([wall.offset for wall in made.walls], dtype=torch.float64)
    normal = torch.tensor([wall.normal for wall in made.walls], dtype=torch.float64)
    values = {
        "wall_offset": 2 * offset,
        "wall_normal": 2 * normal,
        "wall_velocity": torch.zeros(4, 2).to(model.dtype),
    }
    for wall, refused in ((0, True), (1, False)):
        given = {key: value[None, None].repeat(2, *(1,) * (value.ndim + 1)) for key, value in values.items()}
        given["wall_velocity"] = given["wall_velocity"][:1]
        given[name][-1, 0, wall] += torch.tensor(changes, dtype=given[name].dtype)

        def call(given=given):
            inputs = softmpm.Inputs(**given)
            softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, inputs=inputs)

        if refused:
            with pytest.raises(
                ValueError, match=rf"inputs\.{name} must leave wall 0 .* a clamp, .* Scene\.driven"
            ):
                call()
        else:
            call()


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_that_reflect_know_inputs_of_any_shape(dim):
    """One number or vector for all walls has neither the axis of the walls nor those before."""
    model = build(corner(dim), inputs=("wall_offset",))

    def call(**given):
        inputs = softmpm.Inputs(**given)
        softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, inputs=inputs)

    for shape in ((), (1,), (dim,)):
        call(wall_velocity=torch.zeros(shape, dtype=model.dtype))
        with pytest.raises(ValueError, match=r"inputs\.wall_velocity must leave wall 0"):
            call(wall_velocity=torch.ones(shape, dtype=model.dtype))
    for name in ("wall_offset", "wall_normal"):
        with pytest.raises(ValueError, match=rf"inputs\.{name} must leave wall 0"):
            call(**{name: torch.tensor(0.5, dtype=torch.float64)})


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("away", [0.4, -0.4])
def test_a_face_off_the_plane_is_refused(side, away):
    """Before or behind the plane by less than half a spacing; moved as the message says, or without an outline, the body is taken."""
    made, shape = corner(2), softmpm.box((0.2, 0.33), (0.45, 0.53), spacing=0.05)
    plane = 0.2 if side > 0 else 0.45
    wall = softmpm.Wall(normal=(side, 0.0), offset=side * plane, contact="clamp")

    def make(particles: softmpm.Particles):
        body = softmpm.Body(particles, made.bodies[0].material)
        return build(dataclasses.replace(made, bodies=[body], walls=[wall], muscles=[]))

    off = shape.moved((side * away * 0.05, 0.0))
    where = "in front of" if away > 0 else "behind"
    with pytest.raises(
        ValueError, match=rf"begins 0\.02 m {where} the plane .* 0\.4 particle spacings"
    ) as refused:
        make(off)
    (shift,) = re.findall(r"moved\((.*)\)\.$", str(refused.value))
    make(off.moved(ast.literal_eval(shift)))
    make(softmpm.Particles(off.positions, off.volume))


@pytest.mark.parametrize("kind", ["clamp", "symmetry"])
@pytest.mark.parametrize("offset, reach", [(4, 1.5), (4.5, 1.0)])
@pytest.mark.parametrize("one_body", [True, False])
def test_what_lies_close_in_front_of_a_reflection_without_touching_it_is_refused(
    kind, offset, reach, one_body
):
    """A second body, or a recess, that shares nodes with the images behind the plane; it was held there without touching anything."""
    h = 1 / 16
    rubber = softmpm.NeoHookean(density=1.0, young=2000.0, poisson=0.3)

    def scene(gap: float) -> softmpm.Scene:
        low = offset * h
        lower = softmpm.box((low, 4 * h), (low + 6 * h, 8 * h), spacing=h / 2)
        upper = softmpm.box(
            (low + gap * h, (8 if one_body else 12) * h), (low + 6 * h, 16 * h), spacing=h / 2
        )
        bodies = [softmpm.Body(part, rubber) for part in (lower, upper)]
        if one_body:
            places = np.concatenate([part.positions for part in (lower, upper)])
            bodies = [softmpm.Body(softmpm.Particles(places, (h / 2) ** 2), rubber)]
        return softmpm.Scene(
            grid=softmpm.Grid(shape=(24, 24), spacing=h),
            bodies=bodies,
            walls=[softmpm.Wall(normal=(1.0, 0.0), offset=low, contact=kind)],
            dt=1e-4,
        )

    for gap in (0.0, reach, 3.0):
        softmpm.build(scene(gap), device="cpu", formulation="reference")
    for gap in (0.4, reach - 0.4):  # the nearest particles are about a quarter of a cell farther
        with pytest.raises(
            ValueError,
            match=rf"less than {reach:g} cells in front .*, with nothing between; let the body reach",
        ):
            softmpm.build(scene(gap), device="cpu", formulation="reference")


def test_walls_that_reflect_leave_room_and_need_the_reference_formulation():
    """Two that face the same way or are too close, and any of them on a moving grid."""
    made = corner(2)
    clamp = made.walls[0]
    for others, said in (
        ([dataclasses.replace(clamp, contact="symmetry")], "face the same way"),
        ([softmpm.Wall(normal=(0.0, 1.0), offset=0.4, contact="symmetry")], "cut the body off there"),
    ):
        with pytest.raises(ValueError, match=said):
            build(dataclasses.replace(made, walls=[clamp, *others]))
    body = softmpm.Body(softmpm.box((0.2, 0.3), (0.25, 0.5), spacing=0.05), made.bodies[0].material)
    back = softmpm.Wall(normal=(-1.0, 0.0), offset=-0.25, contact="clamp")
    thin = dataclasses.replace(made, bodies=[body], walls=[clamp, back], muscles=[])
    with pytest.raises(ValueError, match=r"face each other at 0\.5 cells"):
        build(thin)
    for kind, other in (("clamp", "stick"), ("symmetry", "slip")):
        walls = [dataclasses.replace(clamp, contact=kind)]
        with pytest.raises(
            ValueError, match=f"needs formulation='reference'; take that, or contact='{other}'"
        ):
            softmpm.build(dataclasses.replace(made, walls=walls), device="cpu")
