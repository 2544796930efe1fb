"""The fast scheme: it is chosen where it applies, agrees with the plain scheme, and reuses its chunk graphs in many calls."""

import itertools
import queue
import sys
import threading

import numpy as np
import pytest
import torch
import warp as wp
from helpers import (
    INPUTS,
    KINDS,
    assert_relative,
    busy_inputs,
    busy_scene,
    cotangent,
    dot,
    gradients,
    little_memory,
    run,
)

import softmpm
from softmpm.choices import choose_scheme
from softmpm.kernels.fast.native import WARP
from softmpm.kernels.structs import BASE_BITS, packed_rows
from softmpm.material import material
from softmpm.planning import memory
from softmpm.planning.chunks import Chunk, Horizon
from softmpm.planning.memory import plan
from softmpm.schemes import launch
from softmpm.schemes.fast import adjoint_buffers, chunk_buffers, chunk_graph
from softmpm.schemes.fast import scheme as fast_scheme
from softmpm.schemes.fast.particle_order import ParticleLayout

SHORT = 8


@pytest.fixture
def short_chunks(monkeypatch):
    """At most 8 substeps in a chunk."""
    monkeypatch.setattr(memory, "LONGEST", SHORT)


def model(dim=2, device="cpu", dtype=torch.float32, scheme="fast", **settings) -> softmpm.Model:
    return softmpm.build(busy_scene(dim), device=device, dtype=dtype, scheme=scheme, **settings)


def same_on(device: str) -> float:
    """On the CPU a result never depends on what ran before; on a GPU sums are taken in any order."""
    return 0.0 if device == "cpu" else 2e-5


# -- choice -------------------------------------------------------------------------------------------------------


def tiny(shape) -> softmpm.Scene:
    """One particle, exactly halfway between two nodes along each axis."""
    body = softmpm.Body(
        softmpm.Particles(np.full((1, len(shape)), 0.4375), 1e-3),
        softmpm.NeoHookean(density=1.0, young=10.0, poisson=0.3),
    )
    return softmpm.Scene(grid=softmpm.Grid(shape=shape, spacing=0.125), bodies=[body], dt=1e-3)


def test_auto_takes_the_fast_scheme_in_single_precision():
    """And the plain one in double precision; what is asked for is taken; ``describe`` says which and why."""
    for asked, dtype, scheme, reason in (
        ("auto", torch.float32, "fast", "single precision"),
        ("auto", torch.float64, "plain", "double precision"),
        ("fast", torch.float64, "fast", "as asked for"),
        ("plain", torch.float32, "plain", "as asked for"),
    ):
        built = softmpm.build(busy_scene(2), device="cpu", dtype=dtype, scheme=asked)
        assert built.scheme == scheme and reason in built.scheme_reason
        (line,) = (line for line in built.describe().splitlines() if line.startswith("  scheme"))
        assert line.split()[1] == f"{scheme}:" and reason in line and f"{built.held_nodes} nodes" in line
    assert softmpm.build(busy_scene(2), device="cpu").scheme == "fast", "auto is what is taken unasked"


@pytest.mark.parametrize("dim", [2, 3])
def test_a_grid_too_large_for_packed_coordinates_takes_the_plain_scheme(dim):
    """Said in ``describe``; an error if the fast scheme was asked for. One node fewer and it is taken."""
    largest = 2 ** BASE_BITS[dim]
    scene = tiny((largest + 1, *(dim - 1) * (8,)))
    built = softmpm.build(scene, device="cpu")
    assert built.scheme == "plain" and f"more than {largest} nodes along an axis" in built.describe()
    with pytest.raises(
        ValueError, match=rf"'fast' cannot hold this scene: .*{largest} nodes.*use scheme='plain'"
    ):
        softmpm.build(scene, device="cpu", scheme="fast")
    assert softmpm.build(tiny((largest, *(dim - 1) * (8,))), device="cpu").scheme == "fast"


def test_more_numbers_than_indices_reach_take_the_plain_scheme():
    """Particles of all worlds, in whole warps, times the numbers of each must stay below 2³¹."""
    most = 2**31 // packed_rows(2).rows // WARP * WARP
    for worlds, scheme in ((most + 1, "plain"), (most, "fast")):
        chosen, reason = choose_scheme(tiny((8, 8)), torch.float32, worlds, "auto", points_in_order=False)
        assert chosen == scheme
        assert scheme == "fast" or "32-bit indices" in reason
    with pytest.raises(ValueError, match="scheme must be 'auto', 'fast' or 'plain', got 'quick'"):
        softmpm.build(tiny((8, 8)), device="cpu", scheme="quick")


# -- the same as the plain scheme ---------------------------------------------------------------------------------


def end_and_gradients(built, control_steps: int, substeps: int, seed=1):
    inputs = busy_inputs(built, control_steps=control_steps, seed=seed)
    end = run(softmpm.simulate, built, inputs, substeps)
    weights = [w / w.abs().max() for w in cotangent(end)[:4]]
    found = torch.autograd.grad(dot(weights, end), list(inputs.values()))
    return dict(zip((*"xvCF", *(f"gradient of {name}" for name in inputs)), (*end[:4], *found), strict=True))


@pytest.mark.parametrize("control_steps, substeps", [(5, 3), (2, 20)])
@pytest.mark.parametrize(
    "dtype, limit, limit_adj",
    # a gradient comes of twice as many operations, and of differences between them
    [(torch.float32, 2e-6, 5e-6), (torch.float64, 1e-13, 1e-13)],
)
@pytest.mark.parametrize("dim", [2, 3])
def test_fast_and_plain_agree(dim, dtype, limit, limit_adj, control_steps, substeps, short_chunks, device):
    """End and every gradient, with two worlds, over chunks of unequal length that hold several control steps or a part of one."""
    built = [model(dim, device, dtype, scheme, worlds=2) for scheme in ("fast", "plain")]
    lengths = {chunk.length for chunk in Horizon(control_steps, substeps).chunks(SHORT)}
    assert len(lengths) == 2 and built[0].scheme == "fast" and built[1].scheme == "plain"
    got, want = (end_and_gradients(m, control_steps, substeps) for m in built)
    for name in want:
        assert_relative(got[name], want[name], limit if name in "xvCF" else limit_adj, name)


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("dim", [2, 3])
def test_what_new_memory_holds_leaves_no_trace(dim, deterministic, device, monkeypatch):
    """A particle halfway between two nodes meets others with weight zero, and nothing sets their velocity."""

    def full_of(number: float, buffers: type) -> type:
        class Full(buffers):
            def __init__(self, *args, **kwargs):
                super().__init__(*args, **kwargs)
                self.nodes.fill_(number)
                self.velocity.fill_(number)

        return Full

    found = []
    for number in (0.0, torch.nan):
        monkeypatch.setattr(chunk_graph, "ChunkBuffers", full_of(number, chunk_buffers.ChunkBuffers))
        monkeypatch.setattr(fast_scheme, "SharedAdjoint", full_of(number, adjoint_buffers.SharedAdjoint))
        built = softmpm.build(tiny((16,) * dim), device=device, scheme="fast", deterministic=deterministic)
        start = built.rest()
        start.v.add_(torch.tensor([0.3, 0.2, 0.1][:dim], device=device))
        inputs = [part.requires_grad_() for part in start[:3]]
        end = softmpm.simulate(built, start, None, built.params(), substeps=1)
        loss = sum(part.square().sum() for part in end[:4])
        found.append([*end.detach()[:4], *torch.autograd.grad(loss, inputs)])
    for clean, dirty in zip(*found, strict=True):
        assert torch.equal(clean, dirty)


@pytest.mark.parametrize("scene", ["passive", "many blocks"])
def test_fast_and_plain_agree_in(scene, device):
    """A scene without muscles and walls; more particles than a block has threads, in worlds that share a block."""
    passive = dict(laws=("neo_hookean",), muscles=[], walls=[], gravity=None, damping=0.0)
    changes = passive if scene == "passive" else dict(per_law=75)
    built = [
        softmpm.build(busy_scene(2, **changes), device=device, worlds=3, scheme=s, dtype=torch.float64)
        for s in ("fast", "plain")
    ]
    results = []
    for m in built:
        inputs = busy_inputs(m)
        if scene == "passive":
            inputs["activation"] = inputs["activation"].detach()
        end = run(softmpm.simulate, m, inputs, 6)
        wanted = [name for name, tensor in inputs.items() if tensor.requires_grad]
        found = torch.autograd.grad(dot(cotangent(end), end), [inputs[name] for name in wanted])
        results.append(dict(zip((*"xvCF", *wanted), (*end[:4], *found), strict=False)))
    for name, want in results[1].items():
        assert_relative(results[0][name], want, 1e-12, name)


def test_each_gradient_can_be_wanted_alone(device):
    """Whatever else is differentiated, the gradient of an input is the same: kernels are compiled for what is wanted."""
    built = model(device=device, worlds=2)
    every = gradients(softmpm.simulate, built, busy_inputs(built), 6)
    for name in ("v", "activation", "young"):
        inputs = {n: t.detach() for n, t in busy_inputs(built).items()}
        inputs[name].requires_grad_()
        end = run(softmpm.simulate, built, inputs, 6)
        (alone,) = torch.autograd.grad(dot(cotangent(end), end), inputs[name])
        assert_relative(alone, every[name], 1e-6, name)


# -- one graph, many calls ----------------------------------------------------------------------------------------


@pytest.fixture
def made(monkeypatch) -> list:
    """Every chunk graph that is built."""
    graphs = []

    class Counted(chunk_graph.ChunkGraph):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            graphs.append((self.buffers.chunk, self.buffers.keep))

    monkeypatch.setattr(fast_scheme, "ChunkGraph", Counted)
    return graphs


def calls(built, seeds, substeps=7):
    """Ends of simulations from different starts, that wait for their backward pass: (end, inputs)."""
    for seed in seeds:
        inputs = busy_inputs(built, control_steps=3, seed=seed)
        yield run(softmpm.simulate, built, inputs, substeps), inputs


def pull(end, inputs, **options) -> dict[str, torch.Tensor]:
    found = torch.autograd.grad(dot(cotangent(end), end), list(inputs.values()), **options)
    return dict(zip(inputs, found, strict=True))


def alone(seed: int, device: str, **settings) -> dict[str, torch.Tensor]:
    """The gradient of a call that a model of its own made."""
    return pull(*next(calls(model(device=device, **settings), [seed])))


def assert_gradient(got, want, device) -> None:
    for name in INPUTS:
        assert_relative(got[name], want[name], same_on(device), name)


def at_once(*threads: threading.Thread) -> None:
    """Run them all, and let each be interrupted as often as can be."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)


@pytest.fixture(params=["kept", "recomputed"])
def budget(request) -> dict:
    """Settings with which a call stores all intermediate states, and with which it stores one state and recomputes chunks."""
    return {} if request.param == "kept" else little_memory(model())


def test_repeated_calls_build_no_new_chunk_graphs(made, short_chunks, budget, device):
    """After the first call, with and without gradient, every chunk graph is reused."""
    built = model(device=device, **budget)

    def both():
        with torch.no_grad():
            list(calls(built, [1]))
        for end, inputs in calls(built, [2]):
            pull(end, inputs)
            del end, inputs

    both()
    count = len(made)
    assert count >= 2
    for _ in range(4):
        both()
    assert len(made) == count, made[count:]


def test_chunks_of_a_long_control_step_share_chunk_graphs(made, short_chunks, device):
    """Three graphs serve the forward pass, one launched ahead and one that contains an initial state; one serves the backward pass."""
    sizes = model().sizes()
    built = model(device=device, memory_budget=9 * (sizes.inside + sizes.nodes) + 20 * sizes.between)
    inputs = busy_inputs(built, control_steps=1, seed=1)
    pull(run(softmpm.simulate, built, inputs, 8 * SHORT), inputs)
    assert [keep for _, keep in made].count(False) <= 3 and [keep for _, keep in made].count(True) == 1, made


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_starts_of_any_layout(dtype, device):
    """Transposed, spread out or broadcast in memory, with low-order parts or without, one after the other: as its copy."""
    built = model(device=device, dtype=dtype, worlds=2)
    inputs = {name: tensor.detach() for name, tensor in busy_inputs(built).items()}
    params = softmpm.Params(*(inputs[name] for name in softmpm.Params._fields))
    copy = softmpm.State(*(inputs[name] for name in "xvCF"))
    layouts = {
        "transposed": lambda t: t.transpose(0, -1).contiguous().transpose(0, -1),
        "spread out": lambda t: torch.stack((t, torch.full_like(t, torch.nan)), -1)[..., 0],
        "as it is": lambda t: t,
    }
    low = built.rest().low
    for parts in (None, None if low is None else softmpm.Low(low.x + 1e-8, low.F + 1e-8)):
        fresh = model(device=device, dtype=dtype, worlds=2)
        want = softmpm.simulate(fresh, copy._replace(low=parts), inputs["activation"], params, substeps=3)
        for name, laid in layouts.items():
            given = softmpm.State(*map(laid, copy[:4]), low=parts and softmpm.Low(*map(laid, parts)))
            got = softmpm.simulate(built, given, laid(inputs["activation"]), params, substeps=3)
            for field, a, b in zip("xvCF", got[:4], want[:4], strict=True):
                assert_relative(a, b, same_on(device), f"{field}, {name}")
    one = copy._replace(v=copy.v[:, :1].expand_as(copy.v))  # no memory of its own
    got, want = (
        softmpm.simulate(m, start, None, params, substeps=3)
        for m, start in (
            (built, one),
            (model(device=device, dtype=dtype, worlds=2), one._replace(v=one.v.clone())),
        )
    )
    assert_relative(got.v, want.v, same_on(device))


def test_gradients_of_any_layout(device):
    """Cotangents that are transposed or broadcast, as PyTorch may pass them, give the gradient of their copies."""
    built = model(device=device, worlds=2)
    weights = [w.transpose(0, 1).contiguous().transpose(0, 1) for w in cotangent(built.rest())[:4]]
    found = []
    for given in (weights, [w.contiguous() for w in weights]):
        ((end, inputs),) = calls(built, [1])
        found.append(torch.autograd.grad(end[:4], list(inputs.values()), given))
    ((end, inputs),) = calls(built, [1])
    for one, other in zip(*found, strict=True):
        assert_relative(one, other, same_on(device))
    total = sum(t.sum() for t in end[:4])
    ones = torch.autograd.grad(total, list(inputs.values()), retain_graph=True)
    want = torch.autograd.grad(end[:4], list(inputs.values()), [torch.ones_like(t) for t in end[:4]])
    for one, other in zip(ones, want, strict=True):
        assert_relative(one, other, same_on(device))


def test_material_is_not_mixed_up_when_the_order_is_renewed(device):
    """One material, another while the order is new, the first again: the same tensors, and the result they gave at first."""
    built = model(device=device)
    start, soft = built.rest(), built.params()
    stiff = soft._replace(young=3.0 * soft.young)
    start.v.add_(0.3)

    def speed(params):
        with torch.no_grad():
            return softmpm.simulate(built, start, None, params, substeps=5).v

    masses = [material(built, params) for params in (soft, stiff)]
    runner, chunk = fast_scheme.Fast(built), Chunk(0, 5, 5)

    def chunk_of(k):
        values = dict(zip(("mu", "lam", "mass"), masses[k], strict=True))
        values["active_stress"] = torch.zeros(1, 1, built.muscle_count, device=device)
        return runner.run(chunk, start, values, False).end.state().v

    first, _ = chunk_of(0), chunk_of(0)  # the second takes note of a material that was already in order
    runner._pool.layout.resort(start.x)
    other, again = chunk_of(1), chunk_of(0)
    assert_relative(again, first, same_on(device))
    assert not torch.allclose(other, first)
    assert_relative(speed(soft), first, same_on(device))


def test_outstanding_gradients_keep_their_own_states(made, short_chunks, budget, device):
    """Five calls wait for their backward pass: each gets its gradient, in any order; five more need nothing new."""
    built = model(device=device, **budget)
    want = {seed: alone(seed, device) for seed in range(5)}
    made.clear()
    counts = []
    for order in ((0, 1, 2, 3, 4), (3, 0, 4, 2, 1)):
        waiting = dict(enumerate(calls(built, range(5))))
        for seed in order:
            got = pull(*waiting.pop(seed))
            if not budget:
                assert_gradient(got, want[seed], device)
            else:  # chunks of other lengths, other rounding in between
                for name in INPUTS:
                    assert_relative(got[name], want[seed][name], 2e-6, name)
        counts.append(len(made))
    assert counts[0] == counts[1]


@pytest.fixture(params=itertools.product(KINDS, ["kept", "recomputed"]), ids=", ".join)
def kind(request) -> dict:
    """Settings of a model with which its calls store all intermediate states, or recompute chunks."""
    name, memory = request.param
    return KINDS[name] | ({} if memory == "kept" else little_memory(model(**KINDS[name])))


def test_backward_twice(kind, short_chunks, device):
    """With ``retain_graph`` the second gradient is the first, also when another call ran in between."""
    built = model(device=device, **kind)
    ((end, inputs),) = calls(built, [1])
    first = pull(end, inputs, retain_graph=True)
    second = pull(end, inputs, retain_graph=True)
    for other, others in calls(built, [2]):
        pull(other, others)
    third = pull(end, inputs)
    for again in (second, third):
        assert_gradient(again, first, device)


@pytest.mark.gpu
def test_backward_twice_inside_a_graph(budget, short_chunks):
    """Captured, and with little memory recomputed for the second gradient: both are equal to those without a graph."""
    built = model(device="cuda", **budget)
    inputs, weights = busy_inputs(built, control_steps=3, seed=1), cotangent(built.rest())

    def work():
        loss = dot(weights, run(softmpm.simulate, built, inputs, 7))
        return [torch.autograd.grad(loss, list(inputs.values()), retain_graph=True) for _ in range(2)]

    want, graph = work()[0], softmpm.Graph(work, built.device)
    for _ in range(3):  # without recording, recorded, replayed
        for found in graph():
            for name, got, wanted in zip(inputs, found, want, strict=True):
                assert_relative(got, wanted, 2e-5, name)


@pytest.mark.parametrize("seeds", [(1, 1, 1), (1, 2, 3)], ids=["one call", "three calls"])
def test_threads_go_back_through_calls_of_another(kind, seeds, short_chunks):
    """At the same time, through one call or one each: each thread gets the result that it gets alone."""
    built, together, found = model(**kind), threading.Barrier(len(seeds)), queue.Queue()
    waiting = {seed: next(calls(built, [seed])) for seed in set(seeds)}
    want = {seed: pull(*call, retain_graph=True) for seed, call in waiting.items()}

    def work(seed):
        together.wait()
        try:
            found.put((seed, pull(*waiting[seed], retain_graph=True)))
        except Exception as error:
            found.put((seed, error))

    for _ in range(5):
        at_once(*(threading.Thread(target=work, args=(seed,)) for seed in seeds))
    for seed, got in (found.get() for _ in range(5 * len(seeds))):
        assert not isinstance(got, Exception), got
        assert_gradient(got, want[seed], "cpu")


def test_interleaved_calls(budget, device):
    """Forward A, forward B, a call without gradient, backward A, backward B: each as if it were alone."""
    built = model(device=device, **budget)
    a, b = calls(built, [1, 2])
    with torch.no_grad():
        list(calls(built, [3]))
    got = pull(*a)
    with torch.no_grad():
        list(calls(built, [4]))
    assert_gradient(got, alone(1, device, **budget), device)
    assert_gradient(pull(*b), alone(2, device, **budget), device)


def test_a_result_outlives_what_runs_after_it(short_chunks, device):
    """The end of a call is not written to by later calls, with or without a gradient of its own."""
    built = model(device=device)
    with torch.no_grad():
        ((bare, _),) = calls(built, [1])
    ((end, _),) = calls(built, [1])
    copies = [t.detach().clone() for t in (*bare[:4], *end[:4])]
    with torch.no_grad():
        list(calls(built, [2, 3]))
    for other, others in calls(built, [2]):
        pull(other, others)
    for tensor, copy in zip((*bare[:4], *end[:4]), copies, strict=True):
        assert torch.equal(tensor, copy)
    for one, other in zip(bare[:4], end[:4], strict=True):
        assert_relative(one, other.detach(), same_on(device))


def test_threads_share_a_model(short_chunks, device):
    """Three threads, each with gradients and calls without, recording and replaying at once: each gets what it gets alone."""
    built, want = model(device=device), {seed: alone(seed, device) for seed in range(3)}
    got: dict[int, list] = {seed: [] for seed in want}
    together, errors = threading.Barrier(len(want)), []

    def work(seed):
        try:
            together.wait()
            for _ in range(4):
                for end, inputs in calls(built, [seed]):
                    got[seed].append(pull(end, inputs))
                with torch.no_grad():
                    list(calls(built, [seed + 10]))
        except Exception as error:
            errors.append(error)

    at_once(*(threading.Thread(target=work, args=(seed,)) for seed in want))
    assert not errors, errors
    for seed, found in got.items():
        for gradient in found:
            assert_gradient(gradient, want[seed], device)


def test_a_backward_pass_in_another_thread(short_chunks, device, monkeypatch):
    """One thread simulates while another runs a backward pass: both use the launches that permute states between chunks."""
    monkeypatch.setattr(memory, "LONGEST", 1)
    built, want, rounds = model(device=device), alone(1, device), 30
    waiting, errors = queue.Queue(4), []
    list(calls(built, [1]))

    def simulate():
        try:
            for _ in range(rounds):
                for call in calls(built, [1]):
                    waiting.put(call)
        except Exception as error:
            errors.append(error)
        finally:
            waiting.put(None)

    def backward():
        while (call := waiting.get()) is not None:
            try:
                assert_gradient(pull(*call), want, device)
            except Exception as error:
                errors.append(error)

    at_once(*(threading.Thread(target=work) for work in (simulate, backward)))
    assert not errors, errors


# -- from chunk to chunk --------------------------------------------------------------------------------------------


def test_a_start_stays_until_nothing_needs_it(device):
    """Chunks launched ahead do not overwrite the initial state of an earlier one, which may have to be repeated."""
    built = model(device=device)
    mu, lam, mass = material(built, built.params())
    runner, chunk, state = fast_scheme.Fast(built), Chunk(0, 2, 2), built.rest()
    state.v.add_(0.3)
    active = torch.zeros(1, 1, built.muscle_count, device=device)
    values = dict(mu=mu, lam=lam, mass=mass, active_stress=active)

    def after(start):
        return runner.run(chunk, start, values, False).end

    first = after(state)
    want, later = first.state(), first
    for _ in range(4):
        later = after(later)
    for got, held in zip(first.state()[:4], want[:4], strict=True):
        assert torch.equal(got, held)


@pytest.fixture
def shuffled(monkeypatch):
    """Before each chunk another order is drawn at random."""
    resort = ParticleLayout.resort

    def shuffle(self, x):
        resort(self, x)
        for order in self.order:
            order.copy_(order[torch.randperm(len(order)).to(order.device)])

    monkeypatch.setattr(ParticleLayout, "resort", shuffle)
    monkeypatch.setattr(ParticleLayout, "update_staleness", lambda self, *_: setattr(self, "stale", True))


@pytest.mark.parametrize("kept", ["all", "some"])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_order_may_change_from_chunk_to_chunk(dim, kept, shuffled, short_chunks, device):
    """End and gradients are those of the plain scheme when particles of two worlds change their places before each chunk."""
    settings = {"dim": dim, "device": device, "dtype": torch.float64, "worlds": 2}
    sizes = model(**settings).sizes()
    budget = 2**30 if kept == "all" else 9 * (sizes.inside + sizes.nodes) + 3 * sizes.between
    built = [model(scheme="fast", memory_budget=budget, **settings), model(scheme="plain", **settings)]
    assert plan(Horizon(2, 20), built[0].sizes(), built[0].budget).keep_all == (kept == "all")
    got, want = (
        gradients(softmpm.simulate, m, busy_inputs(m, control_steps=2, seed=1), substeps=20) for m in built
    )
    for name in INPUTS:
        assert_relative(got[name], want[name], 1e-12, name)


# -- failures -----------------------------------------------------------------------------------------------------


def failure(built, seed=1, **changes) -> softmpm.UnstableError:
    inputs = {name: t.detach().clone() for name, t in busy_inputs(built, seed=seed).items()}
    for name, edit in changes.items():
        edit(inputs[name])
    with pytest.raises(softmpm.UnstableError) as caught:
        run(softmpm.simulate, built, inputs, 20)
    return caught.value


ALIKE = {torch.float32: 2e-6, torch.float64: 1e-14}
"""Limits of differences by their rounding; on a GPU the order of sums made up to 5e-7 in single precision (80 runs, H200)."""


def assert_same_failure(one, other, built) -> None:
    """Kind, place and time are equal; worlds that did not fail end alike, and so does the particle that did.

    The others of its world stop in that substep, before or after it: they run at the same time.
    """
    limit = ALIKE[built.dtype]
    for name in ("kind", "world", "particle", "substep"):
        assert getattr(one, name) == getattr(other, name), name
    healthy = [world for world in range(built.worlds) if world != other.world]
    for name in "xvCF":
        got, want = getattr(one.state, name), getattr(other.state, name)
        assert_relative(got[healthy], want[healthy], limit, name)
        at = other.world, other.particle
        if (
            name == "C"
        ):  # a difference of velocities over a cell: their rounding, not its own size, is the measure
            rounding = other.state.v[at].norm() / built.scene.grid.spacing
            assert (got[at] - want[at]).norm() <= 0.5 * limit * rounding
        else:
            assert_relative(got[at], want[at], limit, f"{name} of the particle")


@pytest.mark.parametrize("dtype", list(ALIKE))
def test_a_failure_is_that_of_the_plain_scheme(dtype, short_chunks, device):
    """In the second chunk, a world that moves off leaves the grid; the two others stay and go on."""

    def kick(v):
        v[1] += torch.tensor([-20.0, 3.0]).to(v)

    errors = []
    for scheme in ("fast", "plain"):
        built = model(device=device, dtype=dtype, scheme=scheme, worlds=3)
        errors.append(failure(built, v=kick))
    assert errors[1].kind == "left_grid" and errors[1].world == 1 and errors[1].substep > SHORT
    assert_same_failure(*errors, built)


def test_a_failing_call_leaves_the_model_as_it_was(short_chunks, device):
    """The next call is what it is on a fresh model, and one that waited for its gradient gets it."""

    def kick(v):
        v += torch.tensor([-50.0, 9.0]).to(v)

    built = model(device=device)
    ((end, inputs),) = calls(built, [1])
    failure(built, v=kick)
    assert_gradient(pull(end, inputs), alone(1, device), device)
    assert_gradient(pull(*next(calls(built, [2]))), alone(2, device), device)


class Interruption(BaseException):
    """As Ctrl-C is none of the errors that a program expects."""


@pytest.fixture
def interrupted(monkeypatch):
    """Does some work again and again, and each time stops it somewhere else: at a launch, which may compile, or at a new buffer."""
    places = (torch, "empty"), (wp, "launch"), (wp.Launch, "launch"), (launch.RebindableLaunch, "__call__")

    def attempts(make, work, every: int):
        """Objects made for each attempt, after its work was stopped."""
        for point in itertools.count(0, every):
            made, steps = make(), itertools.count()

            def stopping(go, steps=steps, point=point):
                def gone(*args, **kwargs):
                    if next(steps) == point:
                        raise Interruption
                    return go(*args, **kwargs)

                return gone

            with monkeypatch.context() as patch:
                for owner, name in places:
                    patch.setattr(owner, name, stopping(getattr(owner, name)))
                try:
                    work(made)
                except Interruption:
                    pass
                else:
                    return
            yield made

    return attempts


def test_an_interrupted_call_leaves_the_model_as_it_was(kind, short_chunks, interrupted):
    """The next call is what it is on a fresh model, and so is the gradient of one that waited."""
    want = [alone(seed, "cpu", **kind) for seed in (1, 2)]

    def prepared():
        built = model(**kind)
        return built, next(calls(built, [1]))

    every, points = 13 if model(**kind).scheme == "fast" else 101, 0  # the plain one launches so much more
    for built, waiting in interrupted(prepared, lambda made: pull(*next(calls(made[0], [3]))), every):
        assert_gradient(pull(*waiting), want[0], "cpu")
        assert_gradient(pull(*next(calls(built, [2]))), want[1], "cpu")
        points += 1
    assert points > 2


@pytest.mark.parametrize("settings", [{}, {"deterministic": True}], ids=["ordinary", "deterministic"])
def test_an_interrupted_call_leaves_material_that_comes_again(settings, short_chunks, interrupted, device):
    """It is sorted once for calls that share it, unless one was stopped before it was."""

    def prepared():
        built = model(device=device, **settings)
        return built, built.params(), built.rest()

    def go(made):
        built, params, start = made
        return softmpm.simulate(built, start, None, params, substeps=20)

    want = go(prepared())
    points = 0
    for made in interrupted(prepared, go, every=1 if device == "cpu" else 5):
        for got, wanted in zip(go(made)[:4], want[:4], strict=True):
            assert_relative(got, wanted, same_on(device))
        points += 1
    assert points > 20


@pytest.mark.parametrize("away", [-3.0, -0.05, 2.0])
def test_a_failure_in_the_start_is_reported_as_such(away, device):
    """Off the grid before the first substep: the fast scheme refuses as the plain one does, and says where it is."""

    def outside(x):
        x[0, 7] = torch.tensor([away, 0.5])

    errors = [failure(model(device=device, scheme=scheme), x=outside) for scheme in ("fast", "plain")]
    for error in errors:
        assert (error.kind, error.particle, error.world) == ("start", 7, 0)
        assert f"({away:.4g}, 0.5) m" in str(error) and error.state.x[0, 7, 0] == torch.tensor(away)
    assert str(errors[0]) == str(errors[1])


def test_a_gradient_that_failed_does_not_fail_again(device):
    """After a loss that overflows, a finite one has its gradient."""
    built = model(device=device)
    ((end, inputs),) = calls(built, [1])
    with pytest.raises(softmpm.UnstableError, match="not finite"):
        (end.x[0, 1] * 3e38 * 10).sum().backward(retain_graph=True)
    assert_gradient(pull(end, inputs), alone(1, device), device)
