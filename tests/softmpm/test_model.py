"""A model compiles, stores and passes what its scene requires, and says so."""

import copy
import dataclasses
import logging
import os
import pickle
import re
import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest
import torch
import warp as wp
from helpers import assert_relative, busy_inputs, busy_scene, cotangent, gradients
from surface_scenes import block, slab

import softmpm
from softmpm import autograd
from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.fast.g2p2g_adj import fused_adj
from softmpm.kernels.fast.native import SizeClass
from softmpm.kernels.physics.grid import grid
from softmpm.kernels.plain.transfer import transfer
from softmpm.kernels.structs import RequestedGrads, input_types
from softmpm.planning.chunks import Horizon
from softmpm.schemes.buffers import passing
from softmpm.schemes.inputs import Accumulators
from softmpm.schemes.plain.substep import Substep


def plain_scene(**changes):
    """One law in empty space, nothing else."""
    return busy_scene(
        2, ("neo_hookean",), **({"muscles": (), "walls": (), "gravity": None, "damping": 0.0} | changes)
    )


def fields(struct) -> set[str]:
    return set(struct.vars)


def test_what_a_scene_lacks_is_not_passed():
    """No argument for muscles, laws, walls or friction that are not there."""
    plain = input_types(softmpm.build(plain_scene(), device="cpu").spec)
    assert fields(plain.ParticleInputs) == {"mass", "mu", "lam", "volume"}
    assert fields(plain.GridInputs) == {"nothing"}
    busy = input_types(softmpm.build(busy_scene(2), device="cpu").spec)
    assert fields(busy.ParticleInputs) - fields(plain.ParticleInputs) == {
        "law",
        "muscle",
        "fibre",
        "active_stress",
    }
    assert fields(busy.GridInputs) == {"normal", "offset", "friction"}
    one = softmpm.build(plain_scene(walls=[softmpm.Wall(normal=(0, 1), offset=0.3)]), device="cpu").spec
    assert fields(input_types(one).GridInputs) == {"normal", "offset"}


def test_what_a_scene_lacks_is_not_compiled(tmp_path):
    """The source of the kernels holds the words of a feature only if the scene has it."""
    words = {
        "log": "neo_hookean",
        "_polar2": "fixed_corotated",
        "active_stress_by": "muscles",
        "slide": "walls",
    }
    scenes = {
        "neo_hookean": plain_scene(),
        "fixed_corotated": busy_scene(
            2, ("fixed_corotated",), muscles=(), walls=(), gravity=None, damping=0.0
        ),
        "muscles": plain_scene(
            muscles=[softmpm.Muscle(particles=np.arange(5), direction=(0, 1), strength=1.0)]
        ),
        "walls": plain_scene(walls=[softmpm.Wall(normal=(0, 1), offset=0.3, friction=0.1)]),
    }
    for name, scene in scenes.items():
        source = _source(softmpm.build(scene, device="cpu"), tmp_path / name)
        for word, feature in words.items():
            wanted = feature == name or (feature == "neo_hookean" and name in ("muscles", "walls"))
            assert (word in source) == wanted, (name, word)


def _source(model, folder) -> str:
    """C++ that Warp generates for the kernels of a forward substep."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*-march=native")  # the binary is not kept
        for kernel in (transfer(model.spec).p2g, grid(model.spec).grid_velocity, transfer(model.spec).g2p):
            wp.compile_aot_module(kernel.module, device="cpu", module_dir=folder)
    return "".join(path.read_text() for path in folder.rglob("*.cpp"))


def test_what_a_scene_lacks_is_not_stored():
    """Bytes of the adjoint follow the requested gradients; a passive scene stores no active stress, a model of one law no index."""
    model = softmpm.build(busy_scene(2), device="cpu")
    wanted = RequestedGrads(), RequestedGrads(("material", "activation"))
    nothing, everything = (Accumulators(model, w, 1, model.node_count) for w in wanted)
    assert not nothing.tensors and len(nothing.scalars) == 0
    assert everything.tensors["active_stress"].shape == (1, model.particle_count, 2)
    passive = softmpm.build(plain_scene(), device="cpu")
    assert set(passive.fixed) == {"volume"} and passive.sizes().inside == 12 * (4 + 4 * (2 + 2 + 2 + 8))
    plain = softmpm.build(plain_scene(), device="cpu", scheme="plain")
    assert plain.sizes()[:3] == (12 * (4 * 2 + 4 * (2 + 4 + 8)), 0, 12 * 4 * 12 * 1.5)


def test_a_substep_is_three_launches_forward_and_five_backward(monkeypatch):
    """P2G, grid, G2P; the adjoint recomputes the grid and adds the adjoints of G2P, grid and P2G."""
    counted = []
    launch = Substep.launch
    monkeypatch.setattr(
        Substep,
        "launch",
        lambda self, kernel, *args: (counted.append(kernel.key), launch(self, kernel, *args)),
    )
    model = softmpm.build(plain_scene(), device="cpu", scheme="plain")
    start = model.rest()
    start.v.requires_grad_()
    end = softmpm.simulate(model, start, None, model.params(), substeps=7)
    assert len(counted) == 3 * 7 + 2  # and one to enter, one to leave
    counted.clear()
    end.x.sum().backward()
    assert len(counted) == 5 * 7


def test_modules_are_shared_by_scenes_alike_and_compiled_once():
    """Two scenes that differ in numbers only have the same kernels, and others those that are alike; each is a module of its own."""
    a = softmpm.build(busy_scene(2, seed=0), device="cpu").spec
    b = softmpm.build(busy_scene(2, seed=5, dt=2e-3), device="cpu").spec
    assert a == b
    passive = fused(softmpm.build(plain_scene(), device="cpu").spec)
    assert (
        passive.clear is fused(a).clear
        and passive.g2p2g[SizeClass.SOME] is not fused(a).g2p2g[SizeClass.SOME]
    )
    assert fused(a).g2p2g[SizeClass.SOME] is not fused(a).g2p2g[SizeClass.FEW]
    kernels = [fused(a).clear, fused(a).grid_velocity, fused(a).p2g_first, *fused(a).g2p2g.values()]
    assert all(list(kernel.module.kernels.values()) == [kernel] for kernel in kernels)
    named = busy_scene(2)
    muscles = [dataclasses.replace(muscle, name="leg") for muscle in named.muscles]
    assert softmpm.build(dataclasses.replace(named, muscles=muscles), device="cpu").spec == a
    less, more = (fused_adj(a, RequestedGrads(wanted)) for wanted in ((), ("material",)))
    assert less.g2p2g_adj[False] is not more.g2p2g_adj[False]


def test_describe_says_what_was_compiled_and_left_out():
    """Dimension, laws, muscles, walls, gradients, dt and memory, in words."""
    text = softmpm.build(plain_scene(), device="cpu").describe()
    for phrase in (
        "2D, float32",
        "neo_hookean; others left out",
        "muscles    left out",
        "walls      left out",
        "stable up to",
    ):
        assert phrase in text, phrase
    busy = softmpm.build(busy_scene(3), device="cpu", dtype=torch.float64, worlds=4).describe(substeps=500)
    for phrase in (
        "3D, float64",
        "4 world(s)",
        "at most 2 on one particle",
        "friction   compiled",
        "500 substeps",
    ):
        assert phrase in busy, phrase


def test_describe_warns_of_rigid_surface_points():
    """In 3D, where a pressure wave passes less than a fifth of a cell in a substep; not at half of the stable step."""
    said = []
    for dim, part, contact in (
        (3, 0.05, "surface"),
        (3, 0.05, "nodes"),
        (3, 0.5, "surface"),
        (2, 0.05, "surface"),
    ):
        scene = block(dim)
        short = dataclasses.replace(scene, dt=part * softmpm.stable_dt(scene))
        text = softmpm.build(short, device="cpu", formulation="reference", contact=contact).describe()
        said.append(len(re.findall(r"a pressure wave passes 0\.0\d+ cells in a substep", text)))
    assert said == [1, 0, 0, 0]


def test_describe_lists_the_names_of_muscles():
    """In their order, not broken, on lines of their own; a scene without names has no such line. The muscle that sets dt is named."""
    scene = busy_scene(2)
    plain = softmpm.build(scene, device="cpu").describe()
    muscles = [
        dataclasses.replace(scene.muscles[k % 2], name="left hind leg, front" * (k != 1)) for k in range(9)
    ]
    text = softmpm.build(dataclasses.replace(scene, muscles=muscles), device="cpu").describe()
    begin, end = text.index("on one particle\n") + len("on one particle\n"), text.index("  driven")
    lines = text[begin:end].splitlines()
    assert all(line.startswith(13 * " ") and len(line) < 136 for line in lines)
    names = [name.strip() for line in lines for name in line.removesuffix(";").split(";")]
    assert (
        names[:3] == ["left hind leg, front (0)", "muscle 1", "left hind leg, front (2)"] and len(names) == 9
    )
    assert "under muscle 0 'left hind leg, front' (10 Pa) + muscle 1 (8 Pa)" in text
    assert "on one particle\n  driven" in plain and "under muscle 0 (10 Pa) + muscle 1 (8 Pa)" in plain


def test_describe_names_every_alarm_and_the_order_of_sums():
    """Five alarms with their limits; sums of the reference formulation have one order on a GPU as well."""
    limits = {"collapse": 0.031, "gap": 1.32, "step": 0.97, "depth": 0.88, "overlap": 0.93}
    assert set(limits) == {field.name for field in dataclasses.fields(softmpm.Alarms)}
    alarms, said = softmpm.Alarms(**limits), set()
    for formulation in ("moving", "reference"):
        text = softmpm.build(slab(), device="cpu", formulation=formulation, alarms=alarms).describe()
        (line,) = [line for line in text.splitlines() if "det F below" in line]
        said |= set(re.findall(r"0\.\d+|1\.\d+", line))
    assert said == {f"{limit:g}" for limit in limits.values()}
    assert "in a fixed order" in text


def test_build_refuses_what_cannot_work():
    """Device, precision, worlds and budget are checked, with what came."""
    for wrong, message in (
        (dict(device="gpu"), "device must be 'cpu', 'cuda' or 'cuda:N', got 'gpu'"),
        (dict(device="mps"), "device must be .* got 'mps'"),
        (dict(dtype=torch.float16), "float16"),
        (dict(worlds=0), "worlds must be .* got 0"),
        (dict(threads=0), "threads must be .* got 0"),
        (dict(memory_budget=-1), "memory_budget"),
    ):
        with pytest.raises((ValueError, RuntimeError), match=message):
            softmpm.build(plain_scene(), **({"device": "cpu"} | wrong))
    with pytest.raises(TypeError, match=r"built from a softmpm.Scene, got dict"):
        softmpm.build({}, device="cpu")
    if not torch.cuda.is_available():
        with pytest.raises(RuntimeError, match="sees no GPU here; use device='cpu'"):
            softmpm.build(plain_scene(), device="cuda")


def test_the_chosen_device_is_said_in_the_log(caplog):
    """device=None takes CUDA if there is one, never silently."""
    with caplog.at_level(logging.INFO, "softmpm"):
        model = softmpm.build(plain_scene())
    assert f"runs on {model.device.type}" in caplog.text


def test_building_and_running_changes_no_global_state():
    """Default dtype, seeds, threads and Warp's settings stay as they were."""

    def settings():
        config = {
            name: getattr(wp.config, name) for name in ("mode", "verify_fp", "enable_backward", "log_level")
        }
        return (
            torch.get_default_dtype(),
            torch.initial_seed(),
            torch.get_num_threads(),
            torch.get_rng_state().sum(),
            config,
        )

    before = settings()
    model = softmpm.build(busy_scene(2), device="cpu")
    gradients(softmpm.simulate, model, busy_inputs(model), 2)
    assert str(settings()) == str(before)


def test_two_models_in_two_threads_give_what_they_give_alone(device):
    """Forward and backward of different scenes at the same time; on a GPU each thread on a stream of its own."""
    models = [softmpm.build(busy_scene(dim), device=device, dtype=torch.float64) for dim in (2, 3)]
    inputs = [busy_inputs(model) for model in models]
    alone = [
        gradients(softmpm.simulate, model, given, 10) for model, given in zip(models, inputs, strict=True)
    ]
    together = [[], []]

    def work(k):
        for _ in range(5):
            if device == "cuda":
                with torch.cuda.stream(torch.cuda.Stream()):
                    torch.cuda.current_stream().wait_stream(torch.cuda.default_stream())
                    found = gradients(softmpm.simulate, models[k], inputs[k], 10)
                    torch.cuda.current_stream().synchronize()
            else:
                found = gradients(softmpm.simulate, models[k], inputs[k], 10)
            together[k].append(found)

    threads = [threading.Thread(target=work, args=(k,)) for k in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k in (0, 1):
        assert len(together[k]) == 5
        for found in together[k]:
            for name, gradient in found.items():
                if device == "cpu":
                    assert torch.equal(gradient, alone[k][name]), name
                else:
                    assert_relative(gradient, alone[k][name], 1e-10, name)


@pytest.mark.parametrize("scheme", ["plain", "fast"])
def test_threads_may_all_be_the_first(scheme):
    """To define, compile and load the same kernels, which are not in use yet in their process."""
    code = f"""
import sys, threading, torch, softmpm
from helpers import busy_inputs, busy_scene, gradients
sys.setswitchinterval(1e-5)
model, found, together = softmpm.build(busy_scene(2), device="cpu", scheme="{scheme}"), [], threading.Barrier(3)
def work():
    inputs = busy_inputs(model)
    together.wait()
    found.append(gradients(softmpm.simulate, model, inputs, 5))
threads = [threading.Thread(target=work) for _ in range(3)]
for thread in threads: thread.start()
for thread in threads: thread.join()
assert len(found) == 3
assert all(torch.equal(one[name], found[0][name]) for one in found for name in one)
"""
    path = os.pathsep.join(sys.path)
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "settings", [{"scheme": "plain"}, {"scheme": "fast"}, {"deterministic": True}], ids=str
)
def test_what_pytorch_takes_unasked_does_not_matter(settings):
    """Neither its default device nor its default precision."""
    model = softmpm.build(busy_scene(2), device="cpu", **settings)
    inputs, weights = busy_inputs(model), cotangent(model.rest())
    want = gradients(softmpm.simulate, model, inputs, 5, weights)
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"):
            other = softmpm.build(busy_scene(2), device="cpu", **settings)
            got = gradients(softmpm.simulate, other, inputs, 5, weights)
            softmpm.rasterize(other, other.rest())
    finally:
        torch.set_default_dtype(torch.float32)
    for name, gradient in got.items():
        assert torch.equal(gradient, want[name]), name


def test_more_bytes_than_warp_counts_are_refused():
    """From one entry of an axis to the next, where there are two: it would go elsewhere, and say nothing."""
    for worlds, refused in ((1, False), (2, True)):
        far = torch.empty(worlds, 2**27, 4, device="meta")
        if refused:
            with pytest.raises(ValueError, match=r"2,147,483,648 bytes apart, Warp reaches less than"):
                passing(far, wp.vec4)
        else:
            passing(far, wp.vec4)


@pytest.mark.gpu
def test_work_runs_on_the_current_stream():
    """A result is ready once PyTorch's current stream is, without a device-wide wait: a long copy before it is seen."""
    model = softmpm.build(plain_scene(), device="cuda", dtype=torch.float64)
    want = softmpm.simulate(model, model.rest(), None, model.params(), substeps=5)
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        start = model.rest()
        torch.cuda._sleep(200_000_000)  # keeps the stream busy; work on another stream would read v too early
        start.v.add_(0.25)
        end = softmpm.simulate(model, start, None, model.params(), substeps=5)
    stream.synchronize()
    torch.testing.assert_close(end.v, want.v + 0.25, rtol=0, atol=1e-12)


@pytest.mark.gpu
def test_a_model_need_not_be_on_the_current_gpu(scheme, monkeypatch):
    """Results are the same there, a failure is seen though it is busy, and nothing comes to lie on the current one."""
    if torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    settings = dict(dtype=torch.float64, scheme=scheme)
    here, there = (softmpm.build(busy_scene(2), device=f"cuda:{k}", **settings) for k in (0, 1))
    want, inputs = gradients(softmpm.simulate, here, busy_inputs(here), 10), busy_inputs(there)
    before, weights = torch.cuda.memory_allocated(0), cotangent(there.rest())

    def work():
        return gradients(softmpm.simulate, there, inputs, 10, weights)

    graph = softmpm.Graph(work, there.device)
    for found in (work(), *(graph() for _ in range(3))):  # without recording, recorded, replayed
        for name, gradient in found.items():
            assert_relative(gradient.to(here.device), want[name], 1e-10, name)
    del found, gradient
    start = there.rest()
    start.F[0, 3, 0] *= -1.0
    for check in ("check_finite", "check_inputs_bounds"):  # which wait for the device
        monkeypatch.setattr(autograd, check, lambda *_: None)
    with torch.cuda.device(1):
        torch.cuda._sleep(200_000_000)  # who reads too early reads what the calls above left: nothing failed
    with pytest.raises(softmpm.UnstableError, match="particle 3 .* in the start state"):
        softmpm.simulate(there, start, None, there.params(), substeps=10)
    assert torch.cuda.current_device() == 0 and torch.cuda.memory_allocated(0) <= before


def square() -> softmpm.Scene:
    """10,000 particles in empty space."""
    side = np.arange(100) / 256 + 0.25
    positions = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    body = softmpm.Body(softmpm.Particles(positions, 1 / 256**2), softmpm.NeoHookean(density=1.0, young=10.0))
    return softmpm.Scene(grid=softmpm.Grid(shape=(128, 128), spacing=1 / 128), bodies=[body], dt=1e-4)


@pytest.mark.gpu
def test_memory_follows_the_formula():
    """Peak of a call with gradient against Model.describe's formula, for 1, 10, 100 and 1,000 substeps: within 20 %."""
    from softmpm.planning.memory import memory

    model = softmpm.build(square(), device="cuda")
    params = softmpm.Params(*(p.requires_grad_() for p in model.params()))
    for substeps in (1, 10, 100, 1000):
        start = model.rest()
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        end = softmpm.simulate(model, start, None, params, substeps=substeps)
        end.x.sum().backward()
        got, want = torch.cuda.max_memory_allocated() - before, memory(model, Horizon(1, substeps)).backward
        print(
            f"substeps {substeps}: measured {got / 2**20:.2f} MiB, formula {want / 2**20:.2f} MiB, {got / want - 1:+.1%}"
        )
        assert abs(got / want - 1) < 0.2, substeps


@pytest.mark.gpu
def test_what_does_not_fit_says_what_it_takes():
    """And what would take less; then the same call runs, on the GPU that had too little."""
    rich, poor = (softmpm.build(square(), device="cuda", memory_budget=budget) for budget in (2**33, 2**26))
    params = softmpm.Params(*(p.requires_grad_() for p in rich.params()))
    torch.cuda.empty_cache()
    room = torch.cuda.memory_reserved() + 2**28
    torch.cuda.set_per_process_memory_fraction(room / torch.cuda.mem_get_info()[1])
    try:
        with pytest.raises(torch.OutOfMemoryError) as caught:
            softmpm.simulate(rich, rich.rest(), None, params, substeps=2000)
        (note,) = caught.value.__notes__
        assert "2000 substeps with 10,000 particles" in note and "a smaller memory_budget" in note
        del caught
        for model, substeps in ((poor, 2000), (rich, 20)):
            softmpm.simulate(model, model.rest(), None, params, substeps=substeps).x.sum().backward()
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)


def test_shapes_of_what_a_model_gives():
    """rest() and params() are fresh tensors of the promised shapes; the bodies' particles stand in their order."""
    model = softmpm.build(busy_scene(3), device="cpu", worlds=3)
    rest, params = model.rest(), model.params()
    assert rest.x.shape == rest.v.shape == (3, 24, 3) and rest.C.shape == rest.F.shape == (3, 24, 3, 3)
    assert all(p.shape == (24,) for p in params)
    rest.x.zero_()
    assert model.rest().x.abs().sum() > 0
    assert model.body.tolist() == [0] * 12 + [1] * 12


def test_results_are_of_the_promised_types():
    """Types of returned objects are public: for annotations and for isinstance."""
    model = softmpm.build(busy_scene(2), device="cpu")
    end = softmpm.simulate(model, model.rest(), None, model.params(), substeps=1)
    assert isinstance(end, softmpm.State) and isinstance(end.low, softmpm.Low)
    assert isinstance(softmpm.rasterize(model, end), softmpm.GridField)
    assert isinstance(softmpm.stable_dt(model.scene), softmpm.StableDt)
    assert isinstance(softmpm.warp_state(model), softmpm.WarpState)
    assert isinstance(softmpm.warp_solid(model), softmpm.WarpSolid)


@pytest.mark.parametrize("budget", [0, -5, 1.5, float("nan"), "1GiB", True])
def test_a_budget_is_a_whole_number_of_bytes(budget):
    """Anything else is refused when the model is made; 1e6 means what it says, and worlds may be a NumPy integer."""
    with pytest.raises(
        ValueError, match="memory_budget, in bytes, must be a whole number of at least 1, got"
    ):
        softmpm.build(busy_scene(2), device="cpu", memory_budget=budget)
    built = softmpm.build(busy_scene(2), device="cpu", memory_budget=1e6, worlds=np.int64(2))
    assert built.budget == 1_000_000 and built.worlds == 2
    for name in ("worlds", "calls"):
        with pytest.raises(ValueError, match=f"{name} must be a whole number"):
            softmpm.build(busy_scene(2), device="cpu", **{name: 1.0})


def test_describe_says_how_often_a_substep_runs():
    """Once with memory for everything, more often with less; and what is missing where not even one fits."""

    def line(substeps=1000, **budget) -> str:
        text = softmpm.build(busy_scene(2), device="cpu", **budget).describe(substeps)
        return next(line for line in text.splitlines() if line.startswith("  memory"))

    assert line().endswith("each runs forward once")
    often = [float(line(memory_budget=n).split()[-2]) for n in (200_000, 60_000, 30_000)]
    assert 2 <= often[0] <= often[1] < often[2]
    assert "needs at least" in line(memory_budget=1000)
    assert "; 8 calls of 100 substeps with gradient: " in line(100, calls=8)
    with pytest.raises(ValueError, match="substeps must be a whole number of at least 1, got 0"):
        line(0)


def test_a_model_is_not_copied_or_pickled():
    """It says what to do instead."""
    model = softmpm.build(busy_scene(2), device="cpu")
    for take in (copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="take its scene, and build it again"):
            take(model)


def test_a_scene_is_no_model():
    model = softmpm.build(busy_scene(2), device="cpu")
    given = r"as softmpm.build\(scene\) gives it, got Scene"
    with pytest.raises(TypeError, match=f"simulate needs a model, {given}"):
        softmpm.simulate(model.scene, model.rest(), None, model.params(), substeps=1)
    with pytest.raises(TypeError, match=f"rasterize needs a model, {given}"):
        softmpm.rasterize(model.scene, model.rest())
