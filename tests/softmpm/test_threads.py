"""Threads of a CPU that share launches."""

import time

import pytest
import torch
from surface_scenes import made, slab
from torch.utils._python_dispatch import TorchDispatchMode

import softmpm
from softmpm.check_state import ALONE
from softmpm.schemes import program
from softmpm.schemes.lagrangian.bricks import NODE_PART


@pytest.fixture
def threads(monkeypatch):
    """Function that sets PyTorch's number of threads; returns a list of the helpers that then take part.

    The thread of the call waits a little, so that they have come when it begins.
    """
    before, take_part = torch.get_num_threads(), program._take_part
    joined = []

    def patient(arguments):
        if arguments.helper:
            joined.append(arguments)
        elif arguments.first == 0:
            time.sleep(0.005)
        take_part(arguments)

    def set_threads(count: int) -> list:
        joined.clear()
        torch.set_num_threads(count)
        return joined

    monkeypatch.setattr(program, "_take_part", patient)
    yield set_threads
    torch.set_num_threads(before)


@pytest.fixture(scope="module", params=["reference", "moving", "moving 3D", "deterministic"])
def model(request) -> softmpm.Model:
    """Worlds with a block on a floor: launches over bricks or slabs, particles, nodes and surface points all have several parts."""
    if request.param == "reference":
        found = made(slab(width=20), worlds=12)
        assert found.worlds * found.rest_grid.count > 2 * NODE_PART
    elif request.param == "moving":
        found = softmpm.build(slab(width=20), device="cpu", formulation="moving", worlds=3)
        assert found.surface is not None and found.spec.slabs
    else:
        deterministic = request.param == "deterministic"
        dtype = torch.float32 if deterministic else torch.float64
        settings = dict(device="cpu", scheme="fast", contact="nodes", deterministic=deterministic)
        found = softmpm.build(cube(), dtype=dtype, **settings)
        assert found.surface is None and found.spec.slabs != deterministic
    return found


def cube() -> softmpm.Scene:
    """A block in 3D just above a floor."""
    rubber = softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3)
    body = softmpm.Body(softmpm.box((0.25,) * 3, (0.7, 0.5, 0.5), spacing=1 / 32), rubber)
    walls = [softmpm.Wall(normal=(0.0, 1.0, 0.0), offset=0.2, friction=0.4)]
    grid = softmpm.Grid(shape=(20,) * 3, spacing=1 / 16)
    return softmpm.Scene(grid=grid, bodies=[body], walls=walls, dt=5e-4)


def falling(model: softmpm.Model, speed: float) -> softmpm.State:
    start = model.rest()
    start.v[..., 1] = -speed
    start.v[..., 0] = start.x[..., 1]
    start.v.requires_grad_()
    return start


def run(model: softmpm.Model, start: softmpm.State) -> list[torch.Tensor]:
    """Forces of the walls on points or how much the floor has slowed the body down, end, and gradients of one call."""
    params = softmpm.Params(*(p.requires_grad_() for p in model.params()))
    end = softmpm.simulate(model, start, None, params, substeps=150)
    points = end.nodes or end.surface
    loss = (end.x**2).sum() + (end.F**2).sum()
    slowed = end.v[..., 1].max() - start.v[..., 1].max() if points is None else points.force
    return [slowed.detach(), *end[:4], *torch.autograd.grad(loss, [start.v, *params])]


def test_threads_do_not_change_a_bit(model, threads):
    """An impact with friction: end, forces and gradients are the same with one thread and with several."""
    threads(1)
    alone = run(model, falling(model, 0.3))
    assert alone[0].abs().max() > 1e-3, "nothing touches the floor"
    for count in (2, 3, 2):
        joined = threads(count)
        together = run(model, falling(model, 0.3))
        assert joined, "no helper came"
        for one, other in zip(alone, together, strict=True):
            assert torch.equal(one, other)


def test_a_model_may_have_threads_of_its_own(threads):
    """Then those of PyTorch do not count."""
    for count in (1, 2):
        joined, model = threads(3 - count), softmpm.build(slab(width=20), device="cpu", threads=count)
        softmpm.simulate(model, model.rest(), None, model.params(), substeps=20)
        assert bool(joined) == (count > 1)


@pytest.mark.parametrize("formulation", ["reference", "moving"])
def test_threads_report_the_same_failure(formulation, threads):
    """Many points are too deep in the floor at once: the message names the same one."""
    settings = dict(worlds=12, alarms=softmpm.Alarms(depth=1e-3), device="cpu", formulation=formulation)
    model, said = softmpm.build(slab(width=20), **settings), []
    for count in (1, 2, 2):
        joined = threads(count)
        with pytest.raises(softmpm.UnstableError) as failed:
            run(model, falling(model, 1.0))
        assert failed.value.kind == "in_wall" and bool(joined) == (count > 1)
        said.append(str(failed.value))
    assert len(set(said)) == 1, said


def test_threads_find_the_same_particle_invalid(threads):
    """Many particles leave the grid in one substep: the message names the same one, which is the first of them."""
    model, said = softmpm.build(cube(), device="cpu", contact="nodes"), []
    for count in (1, 2, 2):
        joined = threads(count)
        start = model.rest()
        start.v[..., 0] = 1.2 / (3 * model.scene.dt)
        with pytest.raises(softmpm.UnstableError) as failed:
            softmpm.simulate(model, start, None, model.params(), substeps=60)
        assert failed.value.kind == "left_grid" and bool(joined) == (count > 1)
        said.append(str(failed.value))
    assert len(set(said)) == 1, said


def test_an_interrupt_leaves_no_thread_at_work(model, threads, monkeypatch):
    """The helper stops with the call, and the next one is right."""
    threads(1)
    alone = run(model, falling(model, 0.3))
    threads(2)
    patient, calls = program._take_part, []

    def interrupted(arguments):
        calls.append(arguments)
        if not arguments.helper and arguments.first == program.INTERRUPTIBLE:
            raise KeyboardInterrupt
        patient(arguments)

    with monkeypatch.context() as patch:
        patch.setattr(program, "_take_part", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(model, falling(model, 0.3))
    for one, other in zip(alone, run(model, falling(model, 0.3)), strict=True):
        assert torch.equal(one, other)


def test_small_scenes_have_one_thread(threads):
    """A start of a thread takes longer than they do."""
    small = made(slab(width=4))
    joined = threads(2)
    softmpm.simulate(small, small.rest(), None, small.params(), substeps=2)
    assert not joined


class Watch(TorchDispatchMode):
    """Collects the operations that PyTorch may give to several threads: those on many numbers, lookups, and products of matrices."""

    def __init__(self):
        super().__init__()
        self.found = set()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        out = operation(*args, **(kwargs or {}))
        sizes = [one.numel() for one in (*args, out) if isinstance(one, torch.Tensor)]
        name = operation.name().split("::")[1].split(".")[0]
        allocates = operation.is_view or name in ("empty", "empty_like", "empty_strided")
        if not allocates and (max(sizes, default=0) > ALONE or name in ("index", "bmm", "mm")):
            self.found.add(name)
        return out


@pytest.mark.parametrize("dim", [2, 3])
def test_calls_leave_the_threads_of_pytorch_asleep(dim):
    """These would wait for further work in a loop, for milliseconds, on the cores of the threads of the simulation. In 2D a call from
    rest with contact; in 3D, with many numbers, one that goes on."""
    rubber, up = softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3), (0.0, 1.0) + (0.0,) * (dim - 2)
    body = softmpm.Body(softmpm.box((0.25,) * dim, (0.75,) * dim, spacing=1 / 32), rubber)
    walls = [softmpm.Wall(normal=up, offset=0.25)]
    grid = softmpm.Grid(shape=(24,) * dim, spacing=1 / 16)
    scene = softmpm.Scene(grid=grid, bodies=[body], walls=walls, dt=1e-4)
    model = softmpm.build(scene, formulation="reference", device="cpu")
    start, params = model.rest(), model.params()
    if dim == 3:
        assert model.particle_count * 9 > ALONE
        start = softmpm.simulate(model, start, None, params, substeps=2)
    young = params.young.clone().requires_grad_()
    with Watch() as watch:
        end = softmpm.simulate(model, start, None, params._replace(young=young), substeps=2)
        torch.autograd.grad(end.nodes.u.sum(), young)
    assert watch.found == set()
