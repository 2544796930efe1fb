"""Order of the particles and window of the grid: neither changes a result, whatever moves where."""

import contextlib
import itertools
import math
import time
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from helpers import LAWS, assert_relative, cotangent, dot, pretend_capture

import softmpm
from softmpm.planning.memory import MARGIN
from softmpm.schemes.fast import footprint, particle_order
from softmpm.schemes.fast import scheme as fast_scheme
from softmpm.schemes.fast.footprint import MANY_CALLS, SMALL, first_margin
from softmpm.schemes.fast.particle_order import STALE_FEW, ParticleLayout
from softmpm.schemes.sorted_inputs import Permutation

DX = 1 / 16  # a power of two: shifting by whole cells is exact


def robot(
    dim: int,
    corners,
    *,
    grid,
    cells=2,
    worlds=1,
    device="cpu",
    dtype=torch.float64,
    scheme="fast",
    young=80.0,
    **scene,
):
    """A model of cubes, ``cells`` wide with 2^dim particles in each, whose lower corners are given in cells."""
    lattice = np.stack(np.meshgrid(*dim * (np.arange(2 * cells),), indexing="ij"), -1).reshape(-1, dim)
    bodies = []
    for corner in corners:
        positions = (np.array(corner) + 0.25 + lattice / 2) * DX
        particles = softmpm.Particles(positions, (DX / 2) ** dim)
        bodies.append(softmpm.Body(particles, LAWS["neo_hookean"](density=1.0, young=young, poisson=0.3)))
    made = softmpm.Scene(grid=softmpm.Grid(shape=grid, spacing=DX), bodies=bodies, dt=1e-3, **scene)
    return softmpm.build(made, device=device, dtype=dtype, worlds=worlds, scheme=scheme)


def bases(model, x) -> np.ndarray:
    """First node of each stencil, (world, particle, dim)."""
    return np.floor(x.double().cpu().numpy() / DX - 0.5).astype(int)


def window(found: ParticleLayout) -> tuple[np.ndarray, np.ndarray]:
    """First node in memory and the first one beyond, (world, dim) each."""
    first = found.origin.cpu().numpy()
    return first, first + np.array(found.shape)


def test_a_material_is_sorted_once(monkeypatch):
    """Calls with the same parameters without a gradient permute nothing; a changed parameter is permuted again."""
    model = robot(2, [(6, 6)], grid=(20, 18), device="cpu")
    count, permute = [0], Permutation.__call__

    def counted(self, *arguments) -> None:
        count[0] += 1
        permute(self, *arguments)

    monkeypatch.setattr(Permutation, "__call__", counted)
    params, state, found = model.params(), model.rest(), []
    for k in range(4):
        if k == 3:
            params.young.mul_(1.5)
        count[0] = 0
        state = softmpm.simulate(model, state, None, params, substeps=3)
        found.append(count[0] > 0)
    assert found == [True, False, False, True]


# -- order and window ---------------------------------------------------------------------------------------------


def scattered(model, low: float, high: float, seed=0) -> torch.Tensor:
    """Positions between two numbers of cells, in every world differently."""
    generator = torch.Generator().manual_seed(seed)
    lead = (model.worlds, model.particle_count, model.dim)
    x = torch.rand(lead, generator=generator, dtype=torch.float64)
    return (DX * (low + (high - low) * x)).to(model.device, model.dtype)


@pytest.mark.parametrize("dim", [2, 3])
def test_the_order_is_a_stable_sort_by_cell(dim, device):
    """Along the order cells come in the order of their nodes in memory, their lower halves along gravity first.

    Particles of one half keep their own order.
    On a GPU by where they are; on the CPU, so that results depend on nothing else, by where they rest.
    """
    model = robot(
        dim,
        [(6,) * dim, (9,) * dim],
        grid=(20, 18, 22)[:dim],
        worlds=2,
        gravity=(0.0, -1.0, 0.0)[:dim],
        device=device,
    )
    x = scattered(model, 3.0, 12.0)
    found = ParticleLayout(model, x)
    followed = x if device == "cuda" else model.rest().x
    sorted_by = bases(model, followed)
    upper = (followed.double().cpu().numpy()[..., 1] / DX - 0.5) % 1 >= 0.5
    for world in range(2):
        keys = [upper[world], *(sorted_by[world, :, axis] for axis in reversed(range(dim)))]
        assert (
            found.order[world].tolist() == np.lexsort(keys).tolist()
        )  # stable; the last key is the first to look at
        assert not np.array_equal(found.order[world].cpu(), np.arange(model.particle_count))


@pytest.mark.parametrize("low, high", [(8.0, 14.0), (0.6, 4.0), (24.0, 28.4), (0.6, 28.4)])
def test_the_window_holds_every_stencil(low, high, device):
    """With a margin on each side, but for where the grid ends; and it never reaches beyond the grid."""
    model = robot(2, [(6, 6), (9, 9)], grid=(30, 30), worlds=2, device=device)
    x = scattered(model, low, high)
    found, base = ParticleLayout(model, x), bases(model, x)
    first, beyond = window(found)
    assert (first >= 0).all() and (beyond <= 30).all()
    below, above = base.min(1) - first, beyond - (base.max(1) + 3)
    assert ((below >= MARGIN[2]) | (first == 0)).all(), below
    assert ((above >= MARGIN[2]) | (beyond == 30)).all(), above
    assert found.node_count == math.prod(found.shape)


def test_a_window_is_as_small_as_its_particles_allow(device):
    """Not the grid but the reach of the widest world counts, along each axis by itself."""
    model = robot(2, [(6, 6)], grid=(500, 400), worlds=2, device=device)
    x = scattered(model, 100.0, 104.0)
    x[1, :, 0] += 150 * DX
    x[1, 0, 1] += 9 * DX
    found = ParticleLayout(model, x)
    reach = np.ptp(bases(model, x), axis=1).max(0)
    assert (np.array(found.shape) >= reach + 3 + 2 * MARGIN[2]).all()
    assert (np.array(found.shape) <= reach + 3 + 2 * MARGIN[2] + 3).all()  # rounded up to four
    assert found.shape[1] > found.shape[0]


def test_the_window_moves_with_the_robot(device):
    """Renewed where the robot has gone to: as large as before, its origin further by as many nodes in that world."""
    model = robot(2, [(20, 20)], grid=(80, 80), worlds=3, device=device)
    x = model.rest().x
    found = ParticleLayout(model, x)
    before, shape, version = found.origin.clone(), found.shape, found.version
    x[1, :, 0] += 30 * DX
    x[2, :, 1] -= 9 * DX
    found.resort(x)
    assert found.shape == shape and found.version == version + 1
    assert (found.origin - before).cpu().tolist() == [[0, 0], [30, 0], [0, -9]]


def test_a_grown_window_has_twice_the_margin(device):
    """Or is as large as the grid, or as the particles need by then; the old one stays as it is."""
    model = robot(2, [(20, 20)], grid=(80, 26), device=device)
    x = model.rest().x
    found = ParticleLayout(model, x)
    before = found.shape
    grown = found.grown(x)
    wider = 2 * (MARGIN[2] + 1)  # a margin of m becomes one of 2 m + 1
    assert grown.shape == (before[0] + wider, 26) and found.shape == before
    assert grown.grown(x).shape == (before[0] + wider + 2 * wider, 26)
    x[0, 0, 0] += 40 * DX
    assert found.grown(x).shape[0] >= 40 + 3 + 2 * MARGIN[2]
    assert found.grown(x).grown(x).shape == (80, 26)
    x[0, 0, 0] -= 40 * DX
    assert found.grown(x).grown(x).grown(x).shape == (80, 26)


@pytest.mark.parametrize(
    "device, dim, particles, calls, margin",
    [
        ("cuda", 2, SMALL, MANY_CALLS, 2 * MARGIN[2] + 1),
        ("cuda", 2, SMALL + 2, MANY_CALLS, MARGIN[2]),
        ("cuda", 2, SMALL, MANY_CALLS - 1, MARGIN[2]),
        ("cuda", 3, SMALL, MANY_CALLS, MARGIN[3]),
        ("cpu", 2, SMALL, MANY_CALLS, MARGIN[2]),
    ],
)
def test_the_window_of_a_small_loop_begins_as_if_it_had_grown(device, dim, particles, calls, margin):
    """A loop whose window grows is captured anew; in 3D, with many particles and on a CPU the nodes would cost more."""
    model = SimpleNamespace(
        device=torch.device(device), dim=dim, worlds=2, particle_count=particles // 2, calls=calls
    )
    assert first_margin(model) == margin


@pytest.mark.parametrize("margin", [MARGIN[2], 2 * MARGIN[2] + 1])
def test_the_margin_of_a_layout_is_that_of_the_plan(margin, monkeypatch):
    """The memory that is planned for is that of the window, whatever its margin."""
    for module in (particle_order, footprint):
        monkeypatch.setattr(module, "first_margin", lambda model: margin)
    model = robot(2, [(20, 20)], grid=(80, 80))
    found = ParticleLayout(model, model.rest().x)
    reach = np.ptp(bases(model, model.rest().x), axis=1).max(0)
    assert found.shape[0] == reach[0] + 3 + 2 * margin
    assert found.node_count == model.held_nodes


def test_a_layout_grows_stale_by_disorder_or_near_the_edge(device):
    """Measured by the cells it met when it was new; on the CPU, where the order is fixed, only the edge counts."""
    model = robot(2, [(20, 20)], grid=(80, 80), worlds=2, device=device)
    x = model.rest().x
    found = ParticleLayout(model, x)
    for apart in (1.0, 3.0):  # further apart, re-sorted: other cells, another measure
        x = x.mean(1, keepdim=True) + apart * (x - x.mean(1, keepdim=True))
        found.resort(x)
        followed = x if device == "cuda" else model.rest().x
        cells = sum(len(np.unique(base, axis=0)) for base in bases(model, followed))
        for met, near_edge, stale in (
            (cells, False, False),
            (int(STALE_FEW * cells), False, False),
            (int(STALE_FEW * cells) + 1, False, device == "cuda"),
            (cells, True, True),
        ):
            found.update_staleness(met, near_edge)
            assert found.stale == stale, (apart, met, near_edge)
    found.resort(x)
    assert not found.stale


# -- what a window must not change --------------------------------------------------------------------------------


class Watched(ParticleLayout):
    """Notes what becomes of windows."""

    made: list[tuple[int, ...]]
    grown_from: list[tuple[int, ...]]
    renewals: int

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        Watched.made.append(self.shape)

    def grown(self, x):
        Watched.grown_from.append(self.shape)
        return super().grown(x)

    def resort(self, x):
        Watched.renewals += 1
        super().resort(x)


@pytest.fixture
def watched(monkeypatch) -> type[Watched]:
    Watched.made, Watched.grown_from, Watched.renewals = [], [], 0
    monkeypatch.setattr(particle_order, "ParticleLayout", Watched)
    monkeypatch.setattr("softmpm.schemes.fast.scheme.ParticleLayout", Watched)
    return Watched


def flight(model, v: torch.Tensor, substeps: int, calls: int = 1, twist: float = 0.0):
    """A flight with velocity ``v`` [m/s] of each particle, turning at ``twist`` [1/s]: its start, and what gives its end and ∂L/∂v."""
    state, params = model.rest(), model.params()
    turn = torch.zeros_like(state.C)
    turn[..., 0, 1], turn[..., 1, 0] = -twist, twist
    start = state._replace(v=(state.v + v.to(state.v)).requires_grad_(), C=turn)
    weights = [w / w.abs().max() for w in cotangent(state)[:4]]

    def fly():
        end = start
        for _ in range(calls):
            end = softmpm.simulate(model, end, None, params, substeps=substeps)
        return end.detach()[:4], *torch.autograd.grad(dot(weights, end), start.v)

    return start, fly


def end_and_gradient(model, v: torch.Tensor, substeps: int, calls: int = 1, twist: float = 0.0):
    """Of one such flight."""
    _, fly = flight(model, v, substeps, calls, twist)
    end, gradient = fly()
    return [t.cpu() for t in end], gradient.cpu()


def assert_same(got, want, limit: float) -> None:
    """C is a difference of velocities in a cell, 4/dx Σ w v rᵀ: it is as exact as 4/dx times the largest of them."""
    fastest = want[0][1].abs().max()
    for name, a, b in zip("xvCF", got[0], want[0], strict=True):
        scale = 4 / DX * fastest / b.abs().max() if name == "C" else 1.0
        assert_relative(a, b, limit * max(1.0, scale), name)
    assert_relative(got[1], want[1], limit, "gradient")


def test_a_particle_that_flies_through_the_window(watched, device):
    """It crosses 40 cells in one chunk: the call starts again with larger windows, and gives what the plain scheme gives."""
    v = torch.zeros(1, 32, 2, dtype=torch.float64)
    v[0, :16, 0] = 25.0  # the first of two bodies: 0.4 cells a substep, over the margin after 15 of 100
    build = {"corners": [(30, 40), (28, 20)], "grid": (100, 64), "device": device}
    got = end_and_gradient(robot(2, **build), v, 100, twist=3.0)
    assert len(watched.grown_from) >= 2 and watched.made[-1][0] >= 40
    assert all(a[0] < b[0] for a, b in itertools.pairwise(watched.made))
    assert_same(got, end_and_gradient(robot(2, **build, scheme="plain"), v, 100, twist=3.0), 1e-13)


def test_a_window_that_must_grow_in_the_second_chunk(watched, monkeypatch, device):
    """The chunk launched after a void one is void too; earlier chunks remain valid."""
    monkeypatch.setattr("softmpm.planning.memory.LONGEST", 16)
    v = torch.zeros(1, 32, 2, dtype=torch.float64)
    v[0, :16, 0] = 14.0  # 3.6 cells in each chunk of 16
    build = {"corners": [(30, 40), (30, 20)], "grid": (100, 64), "device": device}
    got = end_and_gradient(robot(2, **build), v, 80, twist=3.0)
    assert len(watched.made) >= 2 and watched.made[-1][0] > watched.made[0][0]
    assert_same(got, end_and_gradient(robot(2, **build, scheme="plain"), v, 80, twist=3.0), 1e-13)


def test_a_window_that_is_left_again_and_again_grows(watched, monkeypatch, device):
    """A motion leaves it in every call: chunks are repeated at first, later none."""
    monkeypatch.setattr("softmpm.planning.memory.LONGEST", 16)
    model = robot(2, [(30, 30)], grid=(100, 64), device=device)
    v, runs, found = torch.tensor([14.0, 0.0], dtype=torch.float64), [], []  # 3.6 cells in each chunk of 16
    run = fast_scheme.Fast.run
    monkeypatch.setattr(
        "softmpm.schemes.fast.scheme.Fast.run", lambda *given: runs.append(given[1].first) or run(*given)
    )
    for _ in range(5):
        runs.clear()
        end_and_gradient(model, v, 80)
        found.append(len(runs))
    assert found[0] > 5 and found[-2:] == [5, 5] and 1 <= len(watched.grown_from) <= 2


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_robot_that_wanders_takes_its_window_along(sign, watched, device):
    """Over 14 calls it goes 25 cells: the window follows, none is made larger, and the result is the plain scheme's."""
    v = sign * torch.tensor([4.5, 1.0], dtype=torch.float64)  # 1.8 cells in a call
    build = {"corners": [(40 - 25 * sign, 28)], "grid": (80, 64), "device": device}
    got = end_and_gradient(robot(2, **build), v, 25, calls=14, twist=3.0)
    assert len(watched.made) == 1 and not watched.grown_from and 4 <= watched.renewals <= 9
    want = end_and_gradient(robot(2, **build, scheme="plain"), v, 25, calls=14, twist=3.0)
    assert_same(got, want, 1e-12)  # 350 substeps


def test_episodes_that_begin_anew_leave_the_window_as_large_as_it_is(watched, device):
    """Each begins 25 cells from where the one before ended: the window goes back, and memory does not grow with the episodes."""
    v = torch.tensor([4.5, 1.0], dtype=torch.float64)
    _, fly = flight(robot(2, [(15, 28)], grid=(80, 64), device=device), v, 25, calls=14)
    first, *later = [fly() for _ in range(5)]
    assert len(watched.made) == 1 and not watched.grown_from
    for got in later:
        assert_same(got, first, 1e-12)


def test_programs_that_are_used_again_see_where_the_window_went(watched, device):
    """Without gradients every call takes the same program: it follows the robot without growing, as the plain scheme does."""
    ends = []
    for scheme in ("fast", "plain"):
        model = robot(2, [(15, 27)], grid=(80, 64), device=device, scheme=scheme)
        state, v = model.rest(), torch.tensor([4.5, 1.0], dtype=torch.float64)
        state = state._replace(v=state.v + v.to(state.v))
        for _ in range(14):
            state = softmpm.simulate(model, state, None, model.params(), substeps=25)
        ends.append(state)
    assert len(watched.made) == 1 and not watched.grown_from and watched.renewals >= 4
    for name, got, want in zip("xv", *(end[:2] for end in ends), strict=True):
        assert_relative(got, want, 1e-12, name)


def test_worlds_far_apart_have_windows_of_their_own(watched, device):
    """Each world's robot in another corner of a large grid, one of them fast: as the plain scheme, with few nodes in memory."""
    starts = torch.tensor([[0.0, 0.0], [380.0, 5.0], [200.0, 260.0]], dtype=torch.float64)[:, None] * DX
    v = torch.tensor([[1.0, 0.0], [-2.0, 1.0], [0.5, 20.0]], dtype=torch.float64)[:, None]
    ends = []
    for scheme in ("fast", "plain"):
        model = robot(2, [(10, 10)], grid=(420, 300), worlds=3, device=device, scheme=scheme)
        rest = model.rest()
        start = rest._replace(x=rest.x + starts.to(rest.x), v=(rest.v + v.to(rest.v)).requires_grad_())
        end = softmpm.simulate(model, start, None, model.params(), substeps=40)
        (gradient,) = torch.autograd.grad(dot(cotangent(end), end), start.v)
        ends.append(([t.detach().cpu() for t in end[:4]], gradient.cpu()))
    assert math.prod(watched.made[-1]) < 0.02 * 420 * 300
    assert len(watched.grown_from) >= 1
    assert_same(*ends, 1e-13)


def test_two_bodies_far_apart_share_a_window(watched, device):
    """One window from the one to the other, as narrow as both allow; the result is the plain scheme's."""
    v = torch.zeros(1, 32, 2, dtype=torch.float64)
    v[0, 16:, 0] = -1.0
    build = {"corners": [(12, 100), (150, 103)], "grid": (180, 200), "device": device}
    got = end_and_gradient(robot(2, **build), v, 40, twist=2.0)
    (shape,) = watched.made
    assert shape[0] >= 140 + 3 and shape[1] <= 40
    assert_same(got, end_and_gradient(robot(2, **build, scheme="plain"), v, 40, twist=2.0), 1e-13)


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_stand_still_while_windows_move(dim, watched, device):
    """A robot slides on a rough floor, far from the grid's origin, and its window with it: as the plain scheme."""
    v = torch.tensor([6.0, -0.3, 2.0][:dim], dtype=torch.float64)
    corner, up = np.array((20.0, 57.0, 20.0)[:dim]), np.array((-0.1, 1.0, 0.1)[:dim])  # it slides uphill
    up /= np.linalg.norm(up)
    floor = softmpm.Wall(normal=tuple(up), offset=float(up @ corner * DX), friction=0.2)
    build = {"corners": [corner], "grid": (64, 80, 40)[:dim], "walls": [floor]}
    build |= {"gravity": (0.0, -9.8, 0.0)[:dim], "device": device}
    got = end_and_gradient(robot(dim, **build), v, 25, calls=4)
    assert watched.renewals >= 2 and watched.made[0][0] < 40
    want = end_and_gradient(robot(dim, **build, scheme="plain"), v, 25, calls=4)
    free = v[1] - 9.8 * 100 * 1e-3  # upwards, without the floor
    assert want[0][1][..., 1].mean() - free > 0.1, "the floor is not felt"
    assert_same(got, want, 1e-11)  # friction amplifies rounding


@pytest.mark.parametrize("dtype, limit", [(torch.float64, 1e-13), (torch.float32, 2e-6)])
def test_the_size_of_the_grid_costs_nothing(dtype, limit, watched, device):
    """64 particles on 1024³ nodes: built and run at once, with less than a thousandth of the nodes, as in a small grid."""
    clock, found = time.perf_counter(), []
    for shape, corner in ((3 * (1024,), (900, 500, 40)), (3 * (24,), (10, 10, 10))):
        model = robot(3, [corner], grid=shape, device=device, dtype=dtype)
        (x, *rest), gradient = end_and_gradient(model, torch.tensor([0.5, 0.0, 0.2]), 40, twist=3.0)
        shift = torch.tensor(corner, dtype=torch.float64) * DX
        found.append(([x.double() - shift, *rest], gradient))
        assert math.prod(watched.made[-1]) == model.held_nodes < 20_000
    assert model.node_count == 24**3 and time.perf_counter() - clock < 30
    (large, *_), (small, *_) = found[0][0], found[1][0]
    found[0][0][0] = small  # compared here: x in the large grid has fewer digits of a cell
    assert (large - small).abs().max() <= limit * 1024 * DX
    assert_same(*found, limit)


# -- a window inside a captured graph ------------------------------------------------------------------------------


@pytest.fixture
def recordings(monkeypatch, device) -> list[softmpm.Graph]:
    """Graphs, once for each time that they were recorded. On the CPU what is recorded runs, reading nothing back."""
    recorded, record = [], softmpm.Graph._capture
    monkeypatch.setattr(softmpm.Graph, "_capture", lambda *args: recorded.append(args[0]) or record(*args))
    if device == "cpu":

        @contextlib.contextmanager
        def blindly(*_, **__):
            with monkeypatch.context() as patch:
                pretend_capture(patch)
                yield

        pretended = SimpleNamespace(
            cat=torch.cat,
            device=torch.device,
            cuda=MagicMock(graph=blindly, is_current_stream_capturing=bool),
        )
        monkeypatch.setattr("softmpm.cuda_graph.torch", pretended)
    return recorded


CUDA = torch.device("cuda")
WANDERS = torch.tensor([4.0, 1.0], dtype=torch.float64)
"""1.6 cells in a call of 25 substeps [m/s]; 8.1 at half of it in one of 250, which is run as two chunks."""
ALL_THE_WAY = {
    "follows": (1.0, 25, 14, ((0, 0), (1, 0), (1, 0))),
    "grows once": (0.5, 250, 1, ((0, 0), (1, 1), (2, 1), (2, 1))),
}
"""Speed, substeps of a call, calls, and after each use of the graph how often it was captured and the window enlarged."""


@pytest.mark.parametrize("speed, substeps, calls, counts", ALL_THE_WAY.values(), ids=ALL_THE_WAY)
def test_a_window_in_a_recording(watched, recordings, device, speed, substeps, calls, counts):
    """It follows the robot from call to call. Within a call it cannot, as one outside does between two chunks: the recording is
    repeated with a larger window and captured once more, then never."""
    build = {"corners": [(15, 28)], "grid": (80, 64), "device": device}
    about = speed * WANDERS, substeps, calls, 3.0
    _, fly = flight(robot(2, **build), *about)
    graph, found = softmpm.Graph(fly, CUDA), []
    for recorded, grown in counts:
        end, gradient = graph()
        found.append(([t.cpu() for t in end], gradient.cpu()))
        assert (len(recordings), len(watched.grown_from)) == (recorded, grown)
    want = end_and_gradient(robot(2, **build, scheme="plain"), *about)
    for got in found:
        assert_same(got, want, 1e-12)  # up to 350 substeps


def test_a_replay_that_fails_otherwise_leaves_the_window_as_it_is(watched, recordings, device):
    """A robot that leaves the grid itself raises, and once it is slow again the same window and the same recording serve."""
    model = robot(2, [(3, 28)], grid=(80, 64), device=device)
    start, fly = flight(model, -0.01 * WANDERS, 25, calls=4)
    graph = softmpm.Graph(fly, CUDA)
    want = [t.cpu().clone() for t in graph()[0]]
    start.v.detach().mul_(100)
    with pytest.raises(softmpm.UnstableError, match="off the grid"):
        graph()
    start.v.detach().div_(100)
    for _ in range(2):
        for got, wanted in zip(graph()[0], want, strict=True):
            torch.testing.assert_close(got.cpu(), wanted, rtol=1e-12, atol=1e-12)
    assert len(recordings) == 1 and len(watched.made) == 1


@pytest.mark.parametrize("device", ["cpu"])
def test_a_call_after_a_replay_has_neighbours_in_its_own_order(recordings, device):
    """A replay sorts the particles on the device: the lists of neighbours at rest that a later call finds are in another order."""
    model = robot(2, [(15, 28)], grid=(80, 64), device=device)
    _, fly = flight(model, WANDERS, 25, calls=2)
    graph = softmpm.Graph(fly, CUDA)
    for _ in range(2):
        graph()
    fly()
    pool = fast_scheme.Fast.of(model)._pool
    assert pool is not None and graph._graph is not None

    def replay():  # what the graph does on a GPU, where no Python runs
        pool.layout.order.copy_(pool.layout.order.roll(6, dims=1))
        pool.layout.place_neighbours()

    graph._graph.replay = replay
    graph()
    assert_same(fly(), end_and_gradient(model, WANDERS, 25, calls=2), 1e-12)
