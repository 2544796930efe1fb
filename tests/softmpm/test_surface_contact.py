"""Contact of surface points in the reference formulation: every value and gradient against the float64 oracle, and facts."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers import assert_relative, busy_inputs, cotangent, dot
from surface_scenes import block, build, compare

import softmpm
from softmpm.kernels.lagrangian.record import stores_all
from softmpm.planning.chunks import Chunk
from softmpm.schemes.lagrangian.buffers import ChunkBuffers
from softmpm.schemes.lagrangian.footprint import stored_nodes
from softmpm.surface_grid import SurfaceGrid, consistent

NAMES = ("gravity", "friction", "viscosity")


@pytest.mark.parametrize("width", [0.0, 0.05])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_end_and_all_gradients_are_those_of_the_reference(dim, width, device):
    """Two rough walls at once, points that stick, slip and hang free, with a sharp and a smooth hinge."""
    for dtype, limit in ((torch.float64, 1e-10), (torch.float32, 2e-3)):
        settings = dict(device=device, dtype=dtype, worlds=2, inputs=NAMES, contact_width=width)
        model = build(block(dim), **settings)
        compare(model, NAMES, limit)


@pytest.mark.parametrize("dim", [2, 3])
def test_velocities_are_stored_where_points_act_only(dim, device):
    """Without damping and other walls, w is stored only at nodes on which surface points act; gradients are those of the oracle."""
    shape = softmpm.box((0.33, 0.3, 0.34)[:dim], (0.68, 0.65, 0.69)[:dim], spacing=0.05)
    wide = softmpm.Body(shape, block(dim).bodies[0].material)
    made = block(dim, bodies=[wide], damping=0.0, walls=block(dim).walls[:2])
    model = build(made, device=device, dtype=torch.float64, worlds=2, inputs=("friction",))
    assert isinstance(model.surface, SurfaceGrid) and not stores_all(model.spec)
    assert 0 < stored_nodes(model) == len(model.surface.nodes) < model.rest_grid.count
    compare(model, ("friction",), 1e-10)


STORED = {
    "damping": (dict(walls=[]), {}),
    "damping of a body that meets walls": (dict(walls=block(2).walls[:2]), {}),
    "walls at nodes": (dict(damping=0.0), dict(contact="nodes")),
}
"""What may act on any node, one at a time: changes of the block, and settings of its model."""


@pytest.mark.parametrize("what", STORED)
def test_velocities_are_stored_where_anything_acts(what, device):
    """At all nodes; gradients are those of the oracle. Of walls at nodes only friction tells w from the new velocity."""
    changes, settings = STORED[what]
    names = ("friction",) if changes.get("walls") != [] else ("gravity",)
    model = build(block(2, **changes), device=device, dtype=torch.float64, worlds=2, inputs=names, **settings)
    assert stored_nodes(model) == model.rest_grid.count
    compare(model, names, 1e-9)


@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_the_plan_counts_what_is_stored(damping):
    """Bytes of a stored substep, from buffers of several."""
    made = block(3, damping=damping, walls=block(3).walls[:2])
    model, sizes = build(made), []
    for length in (3, 5):
        one = ChunkBuffers(model, Chunk(0, length, length), keep=True)
        sizes.append(sum(t.nbytes for t in (one.u, one.v, one.w, one.anchor, one.shift)))
    assert (sizes[1] - sizes[0]) / 2 == model.sizes().inside


def test_gradients_through_surface_points_have_the_same_bits(device):
    """To the particles of a state without nodes, from which the anchors follow: three runs, float32."""
    model, found = build(block(3), device=device), []
    for _ in range(3):
        start = model.rest()
        start.x.requires_grad_()
        end = softmpm.simulate(model, start, None, model.params(), substeps=4)
        found.append(torch.autograd.grad(end.x.square().sum() + end.v.sum(), start.x)[0])
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])


@pytest.mark.parametrize("dim", [2, 3])
def test_corrected_weights_are_exact_for_affine_fields(dim):
    """Σ w = 1 and Σ w r = 0 at every surface point, whatever nodes are left out."""
    made = block(dim)
    points = build(made).surface
    assert points is not None
    nodes = build(made).rest_grid.nodes.double()[points.stencil.long()] * made.grid.spacing
    weights = points.weights
    torch.testing.assert_close(weights.sum(1), torch.ones(points.count).double(), rtol=0, atol=1e-12)
    at = (weights[..., None] * nodes).sum(1)
    torch.testing.assert_close(at, points.points, rtol=0, atol=1e-12)
    arms = np.array([[[-1.0], [0.0], [1.0]]])
    assert np.allclose(consistent(np.array([[0.25, 0.5, 0.0]]), arms), [[0.0, 1.0, 0.0]])


def from_particles(model, particles, h):
    """Distances of all nodes from all particles in cells, shape (node, particle, dim), and their B-splines."""
    arms = (model.rest_grid.nodes.double().numpy()[:, None] * h - particles.positions) / h
    far = np.maximum(1.5 - np.abs(arms), 0.0)
    return arms, np.where(np.abs(arms) < 0.5, 0.75 - arms**2, 0.5 * far**2).prod(-1)


@pytest.mark.parametrize(
    "fine, place, error", [(2, 0.0, 0), (2, 0.25, 0), (2, 0.5, 0), (2, 0.3, 0.01), (3, 0.0, 0), (1, 0.0, 0)]
)
@pytest.mark.parametrize("dim", [2, 3])
def test_a_pressure_is_divided_as_the_stress_behind_it(dim, fine, place, error):
    """(K11): forces on all nodes from a pressure on the outline are those from the same pressure in the particles of a box, Σ V g.
    Where Σ r K does not vanish, the correction leaves less than a hundredth."""
    h = 0.1
    low = np.full(dim, (3 + place) * h)
    box = softmpm.box(low, low + 3 * h, spacing=h / fine)
    body = softmpm.Body(box, softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3))
    wall = softmpm.Wall(normal=(0.0,) * (dim - 1) + (1.0,), offset=low[0])
    made = softmpm.Scene(
        grid=softmpm.Grid(shape=(10,) * dim, spacing=h), bodies=[body], walls=[wall], dt=1e-5
    )
    model = build(made)
    assert isinstance(model.surface, SurfaceGrid) and box.outline is not None
    arms, splines = from_particles(model, box, h)
    inner = np.einsum("p,np,npa->na", box.volume, 4 / h * splines, arms)
    loads = (
        model.surface.weights.numpy()[..., None] * (box.outline.areas[:, None] * box.outline.normals)[:, None]
    )
    outer = np.zeros_like(inner)
    np.add.at(outer, model.surface.stencil.numpy(), loads)
    np.testing.assert_allclose(outer, inner, rtol=0, atol=(error + 1e-12) * h ** (dim - 1))
    assert np.abs(inner).max() > 0.4 * h ** (dim - 1)


@pytest.mark.parametrize("farthest, low, high", [(10.0, 3.0, 11.0), (np.inf, 1e3, np.inf)])
def test_nodes_that_would_move_far_take_no_part(farthest, low, high, monkeypatch):
    """How far a wall that touches a ball with cut cells moves the nodes, in units of the way of the point: about ten times at most,
    since those left out raise the loads of the others a little; without the limit some that hardly have mass a thousand times."""
    monkeypatch.setattr("softmpm.surface_grid.FARTHEST", farthest)
    h = 0.1
    shape = softmpm.ball((0.51, 0.52, 0.53), 0.3, spacing=h / 2, cut_cells=True)
    body = softmpm.Body(shape, softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3))
    wall = softmpm.Wall(normal=(0.0, 0.0, 1.0), offset=0.2)
    made = softmpm.Scene(grid=softmpm.Grid(shape=(12,) * 3, spacing=h), bodies=[body], walls=[wall], dt=1e-5)
    model = build(made)
    points = model.surface
    assert isinstance(points, SurfaceGrid)
    _, splines = from_particles(model, shape, h)
    ways = (points.loads.numpy() / (splines @ np.asarray(shape.volume)))[points.stencil.numpy()]
    weights = points.weights.numpy()
    most = np.where(weights != 0.0, ways, 0.0).max(axis=1) / (np.abs(weights) * ways).sum(axis=1)
    assert low < most.max() < high


def test_calls_in_turn_are_one_call(device):
    """The anchors travel with the state."""
    model = build(block(2), device=device, dtype=torch.float64)
    inputs = busy_inputs(model, control_steps=4)
    start = softmpm.State(*(inputs[name] for name in "xvCF"))
    params = softmpm.Params(*(inputs[name] for name in softmpm.Params._fields))
    rows = inputs["activation"]
    whole = softmpm.simulate(model, start, rows, params, substeps=5)
    first = softmpm.simulate(model, start, rows[:2], params, substeps=5)
    parts = softmpm.simulate(model, first, rows[2:], params, substeps=5)
    for got, want in zip(parts[:4], whole[:4], strict=True):
        assert torch.equal(got, want)
    found = [torch.autograd.grad(dot(cotangent(end), end), list(inputs.values())) for end in (whole, parts)]
    for name, want, got in zip(inputs, *found, strict=True):
        assert_relative(got, want, 1e-12, name)


def incline(degrees: float, contact: str) -> tuple[float, float]:
    """Acceleration between .4 and .6 s [m/s²] and final speed [m/s] of a viscous block that is put on an incline of the angle of
    friction plus ``degrees``, by its mean velocity.
    """
    h, friction, mu = 1 / 32, 0.5, 2e5 / 2.6
    angle, corner = np.arctan(friction) + np.radians(degrees), (3.5 * h, 3.5 * h)
    shape = softmpm.box(corner, (corner[0] + 10 * h, corner[1] + 3 * h), spacing=h / 2)
    material = softmpm.NeoHookean(density=1000.0, young=2e5, poisson=0.3, viscosity=4e-3 * mu)
    made = softmpm.Scene(
        grid=softmpm.Grid(shape=(24, 14), spacing=h),
        bodies=[softmpm.Body(shape, material)],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=corner[1], friction=friction)],
        gravity=(9.81 * np.sin(angle), -9.81 * np.cos(angle)),
        dt=2e-4,
    )
    model = softmpm.build(made, device="cpu", dtype=torch.float64, formulation="reference", contact=contact)
    before = softmpm.simulate(model, model.rest(), None, model.params(), substeps=2000)
    end = softmpm.simulate(model, before, None, model.params(), substeps=1000)
    speeds = [state.v.mean((0, 1))[0].item() for state in (before, end)]
    return (speeds[1] - speeds[0]) / 0.2, speeds[1]


@pytest.mark.parametrize("degrees", [3.0, 0.5])
def test_a_block_slides_as_a_rigid_one(degrees):
    """Above the angle of friction, within 0.5 % of g (sin − μ cos)."""
    angle = np.arctan(0.5) + np.radians(degrees)
    exact = 9.81 * (np.sin(angle) - 0.5 * np.cos(angle))
    assert abs(incline(degrees, "surface")[0] / exact - 1) < 5e-3


def test_a_block_sticks():
    """Half a degree below the angle of friction, without creeping."""
    assert abs(incline(-0.5, "surface")[1]) < 1e-6


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_a_smooth_wall_leaves_the_gradient_along_it(formulation, dim):
    """Nothing acts along a wall without friction: the derivative of the mean velocity along it with respect to that of the start is 1,
    also where no point has moved yet."""
    shape = softmpm.box((0.4,) * dim, (0.6,) * dim, spacing=0.05)
    made = softmpm.Scene(
        grid=softmpm.Grid(shape=(11,) * dim, spacing=0.1),
        bodies=[softmpm.Body(shape, softmpm.NeoHookean(density=1.3, young=100.0))],
        walls=[softmpm.Wall(normal=(0.0, 1.0, 0.0)[:dim], offset=0.4)],
        dt=1e-3,
    )
    model = softmpm.build(made, "cpu", torch.float64, formulation=formulation, contact="surface")
    start, along = model.rest(), torch.zeros(dim, dtype=torch.float64, requires_grad=True)
    down = torch.tensor([0.0, -0.2, 0.0][:dim], dtype=torch.float64)
    start = start._replace(v=start.v + down + along)
    end = softmpm.simulate(model, start, None, model.params(), substeps=2)
    assert softmpm.contact_forces(model, end).total[0, 0, 1] > 0
    softmpm.mean_velocity(model, end, model.params())[0, 0].backward()
    assert along.grad is not None
    assert along.grad[0].item() == pytest.approx(1.0, abs=1e-12)


def at_the_edge(made: softmpm.Scene) -> softmpm.Scene:
    """The scene with the block in a corner of the grid, where its particles have all their nodes and its outline has not."""
    shape = softmpm.box((0.03, 0.03), (0.23, 0.23), spacing=0.05)
    body = softmpm.Body(shape, made.bodies[0].material)
    return dataclasses.replace(made, bodies=[body], walls=made.walls[:1])


@pytest.mark.parametrize(
    ("upper", "contact", "said"),
    [(7.5, "surface", "surface points need the nodes"), (7.75, "nodes", "body 0 leaves the grid")],
)
def test_the_upper_edge_of_the_grid(upper, contact, said):
    """Surface points, or particles, below it by rounding alone are refused by name; those below it by 1e-9 cells are taken."""
    for below in (0.0, 1e-13, 1e-12, 1e-9):
        top = (upper - below) / 8
        body = softmpm.Body(softmpm.box((top - 0.375, 0.2), (top, 0.5), 1 / 16), block(2).bodies[0].material)
        floor = softmpm.Wall(normal=(0.0, 1.0), offset=0.1)
        grid = softmpm.Grid(shape=(9, 9), spacing=1 / 8)
        scene = softmpm.Scene(grid=grid, bodies=[body], walls=[floor], dt=1e-4)
        if below < 1e-10:
            with pytest.raises(ValueError, match=said):
                softmpm.build(scene, "cpu", formulation="reference", contact=contact)
        else:
            softmpm.build(scene, "cpu", formulation="reference", contact=contact)


def test_what_is_asked_for_must_be_possible():
    """Contact of surfaces needs outlines, a separating wall and, in the fast scheme, sums in any order; nodes are always possible."""
    made = block(2)
    bare = softmpm.Particles(made.bodies[0].particles.positions, made.bodies[0].particles.volume)
    without = dataclasses.replace(made, bodies=[softmpm.Body(bare, made.bodies[0].material)])
    assert build(without).surface is None and build(made, contact="nodes").surface is None
    for scene, settings, said in (
        (without, dict(formulation="reference", contact="surface"), "needs an outline of every body"),
        (
            made,
            dict(contact="surface", scheme="fast", deterministic=True),
            "has no contact at surface points in",
        ),
        (
            dataclasses.replace(made, walls=made.walls[2:]),
            dict(formulation="reference", contact="surface"),
            "needs a wall",
        ),
        (at_the_edge(made), dict(formulation="reference"), "surface points need the nodes around them"),
        (made, dict(contact="nodes", contact_width=0.01), "nodes meet the walls here"),
        (made, dict(contact="points"), "contact must be"),
        (made, dict(contact_width=-1.0), "contact_width must be"),
    ):
        with pytest.raises(ValueError, match=said):
            softmpm.build(scene, device="cpu", **settings)
