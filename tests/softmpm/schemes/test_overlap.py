"""The alarm on bodies that pass through themselves or each other in the reference formulation."""

import itertools
import math
import re

import numpy as np
import pytest
import torch
import warp as wp

import softmpm
from softmpm.errors import NEVER, Kind, decode
from softmpm.kernels.structs import types
from softmpm.oracle.overlap import intrusion
from softmpm.schemes.buffers import view
from softmpm.schemes.device import stream_of
from softmpm.schemes.lagrangian.nodal import particles_of
from softmpm.schemes.lagrangian.overlap import OverlapCheck, overlap_bytes
from softmpm.schemes.launch import KernelLauncher
from softmpm.state import Nodal

H = 1 / 16


def scene(dim: int, *shapes: softmpm.Particles, **settings) -> softmpm.Scene:
    material = softmpm.NeoHookean(density=1.0, young=100.0, poisson=0.3)
    bodies = [softmpm.Body(shape, material) for shape in shapes]
    settings = dict(grid=softmpm.Grid(shape=(40, 24, 16)[:dim], spacing=H), dt=1e-3) | settings
    return softmpm.Scene(bodies=bodies, **settings)


def cells(*numbers: float) -> tuple[float, ...]:
    return tuple(number * H for number in numbers)


def slab(*lower_upper: tuple[float, ...], spacing=0.5) -> softmpm.Particles:
    lower, upper = lower_upper
    return softmpm.box(cells(*lower), cells(*upper), spacing=spacing * H)


def build(made: softmpm.Scene, **settings) -> softmpm.Model:
    settings = dict(device="cpu", dtype=torch.float64) | settings
    return softmpm.build(made, formulation="reference", **settings)


def run(model: softmpm.Model, start: softmpm.State, substeps: int, **settings) -> softmpm.State:
    return softmpm.simulate(model, start, None, model.params(), substeps=substeps, **settings)


def touching(model: softmpm.Model, state: softmpm.State) -> bool:
    """True if a particle of the first body is in the volume of one of another, or the other way round, by the oracle."""
    x, F = state.x[0], state.F[0]
    return any(intrusion(model.scene, x, F, p).min().item() <= 1.0 for p in range(model.particle_count))


def at_the_surface(positions: np.ndarray) -> np.ndarray:
    """Particles in cells with an empty neighbour, by a set of cells."""
    own = np.floor(positions / H).astype(int)
    full = {tuple(cell) for cell in own}
    around = list(itertools.product((-1, 0, 1), repeat=own.shape[1]))
    return np.array([any(tuple(cell + step) not in full for step in around) for cell in own])


@pytest.mark.parametrize("dim", [2, 3])
def test_the_particle_is_that_of_the_reference(dim, device):
    """The first one in the volume of another, of all pairs, in random states: rigid motions of each body with noise, some far away."""
    first, second = (
        slab((3.0,) * dim, (6.5,) * dim),
        slab((10.0,) + (3.3,) * (dim - 1), (14.0,) + (5.3,) * (dim - 1)),
    )
    model = build(scene(dim, first, second), device=device, worlds=12)
    grid, generator = model.rest_grid, np.random.default_rng(dim)
    X = grid.nodes.cpu().double().numpy() * H
    u, left = np.empty((model.worlds, *X.shape)), X[:, 0] < 8.2 * H
    for world, apart in enumerate(np.linspace(2.5, 6.0, model.worlds)):
        for k, part in enumerate((left, ~left)):
            A, middle = np.eye(dim) + generator.normal(0.0, 0.2, (dim, dim)), X[part].mean(0)
            place = H * (generator.normal(0.0, 0.5, dim) + apart * k * np.eye(dim)[0])
            u[world, part] = (X[part] - middle) @ A.T + place - X[part]
        u[world] += generator.normal(0.0, 0.02 * H, X.shape) + world % 2 * 1e3 * H
    u = torch.from_numpy(u).to(model.device)
    state = particles_of(model, Nodal(u, torch.zeros_like(u), u, u)).to("cpu")
    words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
    launch = KernelLauncher(model, stream_of(model.device))
    vectors = view(u, types(model.spec.dim, model.spec.dtype).vec)
    OverlapCheck(model).check(launch, 7, vectors, view(words, wp.int64))
    outer, found = np.flatnonzero(at_the_surface(model.exact_positions)), []
    for world, word in enumerate(words.tolist()):
        least = {p: intrusion(model.scene, state.x[world], state.F[world], p).min().item() for p in outer}
        inside = [p for p, number in least.items() if number <= 1.0]
        assert not any(abs(number - 1.0) < 1e-9 for number in least.values())
        found.append(bool(inside))
        assert decode(word) == (7, Kind.OVERLAP, inside[0]) if inside else word == NEVER
    assert 3 <= sum(found) <= 9


def rolled(model: softmpm.Model, turns: float) -> softmpm.State:
    """A strip along x, bent to so many turns of a circle."""
    X = model.positions - model.positions.mean(0)
    length = 20 * H
    R = length / (2 * math.pi * turns)
    angle, r = X[:, 0] / R, R - X[:, 1]
    state = model.rest()
    state.x[:] = 0.75 + torch.stack([r * angle.sin(), -r * angle.cos()], -1)
    along = (r / R)[:, None] * torch.stack([angle.cos(), angle.sin()], -1)
    state.F[:] = torch.stack([along, torch.stack([-angle.sin(), angle.cos()], -1)], -1)
    return state


def test_a_strip_whose_ends_cross_is_named():
    """Of two worlds the one whose strip has more than one turn; at 0.9 turns, where it is bent by 30 %, nothing is raised."""
    made = scene(2, slab((10.0, 6.0), (30.0, 8.0)))
    model, loose = (build(made, worlds=2, alarms=softmpm.Alarms(overlap=o, step=None)) for o in (1.0, None))
    start, crossed = rolled(model, 0.9), rolled(model, 1.15)
    run(model, start, 20)
    start = softmpm.State(*(torch.stack([a[0], b[0]]) for a, b in zip(start[:4], crossed[:4], strict=True)))
    with pytest.raises(softmpm.UnstableError) as caught:
        run(model, start, 1)
    error, text = caught.value, str(caught.value)
    assert (error.kind, error.world, error.substep) == ("overlap", 1, 0)
    assert f"particle {error.particle} (body 0) of world 1 is in the volume of particle" in text
    p, q = error.particle, int(re.findall(r"volume of particle (\d+)", text)[0])
    apart, x = float(re.findall(r"\(([\d.]+) cells\) from it", text)[0]), error.state.x[1]
    assert apart == pytest.approx((x[p] - x[q]).norm().item() / H, rel=1e-3)
    at_rest = float(re.findall(r"at rest they are ([\d.]+) cells apart", text)[0])
    assert at_rest == pytest.approx((model.positions[p] - model.positions[q]).norm().item() / H, rel=1e-3)
    assert at_rest > 15 and "at rest 0.5 cells wide" in text and "formulation='moving'" in text
    v = (
        start.v.clone().requires_grad_()
    )  # a call with a gradient stops as well, of a longer chunk in the same substep
    with pytest.raises(softmpm.UnstableError) as caught:
        run(model, start._replace(v=v), 20)
    assert str(caught.value) == text
    failures = softmpm.Failures("freeze")
    end = run(model, start, 20, failures=failures)
    assert failures.worlds == [1] and (end.x[1] - start.x[1]).abs().max() < 0.1 * H  # as its nodes show it
    quiet = run(loose, start, 20)
    assert loose.overlap is None and torch.equal(quiet.x[0], end.x[0])


@pytest.mark.parametrize("dim", [2, 3])
def test_balls_that_collide_are_named_at_their_substep(dim, device):
    """No particle is in the volume of another before the substep of the error, and one is after it; the moving grid parts them."""
    balls = [
        softmpm.ball(cells(*c[:dim]), 2.4 * H, spacing=H / 2) for c in ((6.5, 8.1, 8.2), (18.0, 8.5, 8.0))
    ]
    model = build(scene(dim, *balls), device=device)
    loose = build(scene(dim, *balls), device=device, alarms=softmpm.Alarms(overlap=None))
    start = model.rest()
    start.v[:, : len(balls[0]), 0] = 2.0
    with pytest.raises(softmpm.UnstableError) as caught:
        run(model, start, 400)
    error = caught.value
    assert error.kind == "overlap" and (model.body == 0).sum() > error.particle
    before, after = (run(loose, start, error.substep + k).to("cpu") for k in (0, 1))
    assert not touching(loose, before) and touching(loose, after)
    front = [after.x[0, model.body.cpu() == k, 0] for k in (0, 1)]
    overlap = (front[0].max() - front[1].min()).item() / H
    assert 0.0 <= overlap + 0.5 <= 1.0  # of the surfaces, half a cell and no more
    if dim == 2:  # the remedy: they bounce off each other
        moving = softmpm.build(scene(dim, *balls), device=device)
        end = run(moving, softmpm.State(*(tensor.float() for tensor in start[:4])), 400)
        assert end.v[0, moving.body == 1, 0].mean() > 0.5


def test_a_leg_that_passes_the_other_is_named(tmp_path):
    """An arch whose feet fly towards each other, recorded until then; one whose feet stay apart is left alone."""
    arch = [
        slab((10.0, 4.0), (12.0, 14.0)),
        slab((18.0, 4.0), (20.0, 14.0)),
        slab((12.0, 12.0), (18.0, 14.0)),
    ]
    whole = softmpm.Particles(np.concatenate([part.positions for part in arch]), arch[0].volume[0])
    model = build(scene(2, whole), alarms=softmpm.Alarms(step=None))
    assert model.surface is None  # without an outline
    X, state = model.positions, model.rest()
    state.v[0, :, 0] = 0.4 * (12.0 - X[:, 1] / H).clamp(min=0.0) * torch.sign(15 * H - X[:, 0])
    times = []

    def recorded(end: softmpm.State) -> None:
        with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(0) as episode:
            for k in range(8):
                episode.frame(float(k), end)
                times.append(k)
                end = run(model, end, 50)

    with pytest.raises(softmpm.UnstableError) as caught:
        recorded(state)
    assert caught.value.kind == "overlap" and X[caught.value.particle, 1] < 8 * H
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        assert list(recording.frames(0)["time"]) == times and 1 < len(times) < 8
    state.v.mul_(0.1)
    run(model, state, 400)


@pytest.mark.parametrize("stretch", [0.3, 0.07, 2.5])
def test_bodies_that_are_one_overlap_nothing(stretch):
    """Two bodies that share nodes, and a hole narrower than three cells, compressed and stretched along both axes in turn."""
    parts = slab((10.0, 6.0), (16.0, 8.0)), slab((16.0, 5.0), (22.0, 9.0)), slab((24.0, 5.0), (30.0, 9.0))
    model = build(scene(2, *parts, dt=1e-5), alarms=softmpm.Alarms(step=None))
    assert model.overlap is not None
    for axis in (0, 1):
        state = model.rest()
        state.x[..., axis] = 0.8 + stretch * (state.x[..., axis] - 0.8)
        state.F[..., axis, axis] = stretch
        run(model, state, 1)


def test_nothing_is_checked_where_nothing_can_overlap():
    """Particles within three cells, models without the alarm, and the moving formulation have no lists of particles."""
    small, large = scene(2, slab((6.0, 6.0), (9.5, 9.0))), scene(2, slab((6.0, 6.0), (10.0, 9.0)))
    assert build(small).overlap is None and build(large).overlap is not None
    assert softmpm.build(large, device="cpu").alarms.overlap is None
    for model in (build(small), build(large)):
        assert overlap_bytes(model) == (0 if model.overlap is None else OverlapCheck(model).bytes)
