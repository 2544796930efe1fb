"""The plain scheme of a deterministic model, ``step`` and ``rasterize`` give the same bits from run to run, in each precision."""

import threading
from types import SimpleNamespace

import pytest
import torch
import warp as wp
from helpers import assert_relative, busy_inputs, busy_scene, cotangent, gradients, run

import softmpm
from softmpm.choices import in_fixed_point
from softmpm.kernels.structs import types
from softmpm.schemes.plain.footprint import term_bytes

PRECISIONS = [(torch.float32, 3e-5), (torch.float64, 1e-12)]
"""Difference that rounding may make between two orders of a sum, relative to the largest value: ten times that on a CPU."""
MANY = {"cpu": 40, "cuda": 2000}
"""Particles of each of two bodies, in about 40 cells: on a GPU enough to add to a node in an order that varies."""


def build(dim: int, device: str, deterministic=True, scheme="plain", **settings) -> softmpm.Model:
    scene, alarms = busy_scene(dim, per_law=MANY[device]), softmpm.Alarms(gap=None)  # the start is random
    settings = dict(worlds=2, alarms=alarms, scheme=scheme) | settings
    return softmpm.build(scene, device=device, deterministic=deterministic, **settings)


def simulated(model: softmpm.Model) -> dict[str, torch.Tensor]:
    """The end of 20 substeps, the gradient with respect to each input, and the field of an observer with its gradients."""
    inputs = busy_inputs(model)
    end = run(softmpm.simulate, model, inputs, 10)
    found = {f"end.{name}": t.detach() for name, t in zip("xvCF", end[:4], strict=True)}
    return found | gradients(softmpm.simulate, model, inputs, 10) | rasterized(model)


def rasterized(model: softmpm.Model) -> dict[str, torch.Tensor]:
    inputs = busy_inputs(model)
    field = softmpm.rasterize(model, softmpm.State(*(inputs[name] for name in "xvCF")))
    loss = (field.mass * torch.linspace(-1, 1, field.mass.numel()).to(field.mass).view_as(field.mass)).sum()
    loss = loss + field.velocity.square().sum()
    names = ("x", "v", "C")
    found = torch.autograd.grad(loss, [inputs[name] for name in names])
    adjoints = {f"field.adj_{name}": t for name, t in zip(names, found, strict=True)}
    return {"field.mass": field.mass.detach(), "field.velocity": field.velocity.detach()} | adjoints


def stepped(model: softmpm.Model) -> dict[str, torch.Tensor]:
    """The end of five steps, and gradients by their tape."""
    inputs = {name: tensor.detach() for name, tensor in busy_inputs(model, control_steps=1).items()}
    params = softmpm.Params(*(inputs[name] for name in softmpm.Params._fields))
    solid = softmpm.warp_solid(model, params, inputs["activation"][0], requires_grad=True)
    start = softmpm.State(*(inputs[name] for name in "xvCF"))
    states = [softmpm.warp_state(model, start, requires_grad=True)]
    states += [softmpm.warp_state(model, requires_grad=True) for _ in range(5)]
    tape = wp.Tape()
    for s in range(5):
        softmpm.step(model, states[s], states[s + 1], solid, substep=s, tape=tape)
    weights, t, end = cotangent(start), types(model.dim, model.spec.dtype), states[-1]
    pairs = ((end.fx, weights.x, t.vec), (end.v, weights.v, t.vec), (end.C, weights.C, t.mat))
    tape.backward(grads={array: wp.from_torch(g.contiguous(), dtype=dtype) for array, g, dtype in pairs})
    solid.raise_failure(model, end)
    found = {name: getattr(end, name) for name in ("fx", "v", "C", "H")}
    found |= {f"adj_{name}": getattr(states[0], name).grad for name in ("fx", "v", "C", "H")}
    found |= {f"adj_{name}": getattr(solid, name).grad for name in ("mu", "lam", "mass", "active_stress")}
    return {name: wp.to_torch(array, requires_grad=False).clone() for name, array in found.items()}


def assert_same_bits(runs: list[dict[str, torch.Tensor]]) -> None:
    for other in runs[1:]:
        for name, value in runs[0].items():
            assert torch.equal(value, other[name]), (
                f"{name} differs by {(value - other[name]).abs().max():.1e}"
            )


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype, limit", PRECISIONS, ids=str)
def test_simulate_and_rasterize(dim, dtype, limit, device):
    """The same bits in two models, and those of any order but for rounding."""
    runs = [simulated(build(dim, device, dtype=dtype)) for _ in range(2)]
    runs.append(simulated(build(dim, device, dtype=dtype)))
    assert_same_bits(runs)
    want = simulated(build(dim, device, deterministic=False, dtype=dtype))
    for name, value in runs[0].items():
        assert_relative(value, want[name], limit, name)


@pytest.mark.parametrize("scheme", ["plain", "auto"])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("dtype, limit", PRECISIONS, ids=str)
def test_step(dim, dtype, limit, scheme, device):
    """Steps and their tape: the same bits in two models, whichever scheme ``simulate`` has."""
    runs = [stepped(build(dim, device, dtype=dtype, scheme=scheme)) for _ in range(3)]
    assert_same_bits(runs)
    want = stepped(build(dim, device, deterministic=False, dtype=dtype, scheme=scheme))
    for name, value in runs[0].items():
        assert_relative(value, want[name], limit, name)


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_streams_and_threads_leave_no_trace(dtype):
    """Two threads at a time, each on a stream of its own: the same bits as alone on the default stream."""
    models = [build(2, "cuda", dtype=dtype) for _ in range(2)]
    want, found, errors = simulated(models[0]), {}, []

    def work(number: int) -> None:
        try:
            with torch.cuda.stream(torch.cuda.Stream()):
                found[number] = [simulated(models[number]) for _ in range(5)]
                torch.cuda.current_stream().synchronize()
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors, errors
    assert_same_bits([want, *found[0], *found[1]])


@pytest.mark.gpu
def test_a_graph_is_refused():
    """The first call of a Graph runs, the second would capture."""
    model = build(2, "cuda")
    inputs = {name: tensor.detach() for name, tensor in busy_inputs(model).items()}
    graph = softmpm.Graph(lambda: run(softmpm.simulate, model, inputs, 4).x, model.device)
    first = graph().clone()
    with pytest.raises(RuntimeError, match="cannot be captured in a CUDA graph"):
        graph()
    assert torch.equal(run(softmpm.simulate, model, inputs, 4).x, first)


def test_what_is_summed_how():
    """The fast scheme in fixed point, the plain one in order; only fast in double precision on a GPU is refused."""
    cpu, cuda = torch.device("cpu"), torch.device("cuda")
    for device in (cpu, cuda):
        assert in_fixed_point(device, torch.float32, "fast")
        assert not any(in_fixed_point(device, dtype, "plain") for dtype, _ in PRECISIONS)
    assert not in_fixed_point(cpu, torch.float64, "fast")
    with pytest.raises(ValueError, match=r"torch.float64; use scheme='auto' or 'plain'"):
        in_fixed_point(cuda, torch.float64, "fast")


def test_terms_are_counted_as_memory():
    """On a GPU 27 of each particle in 3D: a key and an index, twice, and four numbers; elsewhere none."""
    sizes = dict(deterministic=True, worlds=2, particle_count=100, dim=3, dtype=torch.float64)
    assert term_bytes(SimpleNamespace(device=torch.device("cuda"), **sizes)) == 2 * 100 * 27 * (24 + 32)
    assert term_bytes(SimpleNamespace(device=torch.device("cpu"), **sizes)) == 0


@pytest.mark.gpu
def test_fast_in_double_precision_is_refused_with_a_remedy_that_works():
    """The message names scheme='auto' and 'plain'; both build."""
    with pytest.raises(ValueError, match="use scheme='auto' or 'plain'"):
        build(2, "cuda", dtype=torch.float64, scheme="fast")
    for scheme in ("auto", "plain"):
        assert build(2, "cuda", dtype=torch.float64, scheme=scheme).scheme == "plain"
