"""The PyTorch boundary: what users of torch expect of a differentiable function."""

import dataclasses
import warnings

import pytest
import torch
from helpers import INPUTS, assert_relative, busy_inputs, busy_scene, cotangent, dot, gradients, run
from helpers import given as given_inputs
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils.checkpoint import checkpoint

import softmpm


@pytest.fixture(scope="module")
def model():
    return softmpm.build(busy_scene(2, per_law=6), device="cpu", dtype=torch.float64)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradcheck_of_every_input(dim, device, scheme):
    """torch.autograd.gradcheck in float64, all inputs at once, contact and friction active."""
    model = softmpm.build(busy_scene(dim, per_law=5), device=device, dtype=torch.float64, scheme=scheme)
    inputs = busy_inputs(model)

    def function(*tensors):
        return tuple(run(softmpm.simulate, model, dict(zip(INPUTS, tensors, strict=True)), substeps=3)[:4])

    ordered = tuple(inputs[name] for name in INPUTS)
    repeatable = 0.0 if device == "cpu" else 1e-10  # atomics add in any order on a GPU
    assert torch.autograd.gradcheck(function, ordered, fast_mode=True, nondet_tol=repeatable)


def test_rasterize_gradcheck(model, device):
    """Mass and velocity with respect to x, v and C."""
    model = softmpm.build(busy_scene(3, per_law=4), device=device, dtype=torch.float64, worlds=2)
    inputs = busy_inputs(model)

    def function(x, v, C):
        return tuple(softmpm.rasterize(model, softmpm.State(x, v, C, inputs["F"])))

    repeatable = 0.0 if device == "cpu" else 1e-10
    assert torch.autograd.gradcheck(
        function, tuple(inputs[n] for n in "xvC"), fast_mode=True, nondet_tol=repeatable
    )


def test_rasterize_keeps_mass_and_momentum(model):
    """Sums over nodes equal sums over particles; a uniform velocity is seen as such wherever there is mass."""
    rest = model.rest()
    field = softmpm.rasterize(model, rest._replace(v=rest.v + torch.tensor([0.3, -0.2], dtype=torch.float64)))
    mass = model.params().density * model.volume
    torch.testing.assert_close(field.mass.sum(), mass.sum(), rtol=1e-13, atol=0)
    present = field.mass > 0
    assert 0 < present.sum() < present.numel()
    want = torch.tensor([0.3, -0.2], dtype=torch.float64).expand_as(field.velocity[present])
    torch.testing.assert_close(field.velocity[present], want, rtol=1e-12, atol=0)
    assert (field.velocity[~present] == 0).all()


def test_second_derivatives_raise(model):
    """Also for a loss that is linear in the end, where PyTorch alone would return silently without this term."""
    inputs = busy_inputs(model)
    for name in INPUTS:
        end = run(softmpm.simulate, model, inputs, 2)
        (first,) = torch.autograd.grad(end.x.sum(), inputs[name], create_graph=True)
        with pytest.raises(RuntimeError, match="second derivatives"):
            torch.autograd.grad(first.sum() + inputs["v"].sum(), inputs["v"])
    field = softmpm.rasterize(model, softmpm.State(*(inputs[n] for n in "xvCF")))
    (first,) = torch.autograd.grad(field.mass.sum(), inputs["x"], create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(first.sum() + inputs["x"].sum(), inputs["x"])


def test_arguments_are_never_changed_and_results_are_fresh(model):
    """Forward and backward leave inputs as they were; a second call does not overwrite the first result."""
    inputs = busy_inputs(model)
    before = {name: tensor.detach().clone() for name, tensor in inputs.items()}
    first = run(softmpm.simulate, model, inputs, 3)
    copy = [tensor.detach().clone() for tensor in first[:4]]
    second = run(softmpm.simulate, model, inputs, 4)
    dot(cotangent(second), second).backward()
    assert all(torch.equal(inputs[name], tensor) for name, tensor in before.items())
    assert all(torch.equal(tensor, kept) for tensor, kept in zip(first[:4], copy, strict=True))


def test_an_input_changed_in_place_before_backward_raises(model):
    """PyTorch's own guard sees it, because the inputs are saved with save_for_backward."""
    inputs = busy_inputs(model)
    end = run(softmpm.simulate, model, inputs, 2)
    with torch.no_grad():
        inputs["v"] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        end.x.sum().backward()


def test_rounding_of_a_start_changed_in_place_before_backward_raises(device):
    """The low-order parts of a state are guarded like its four tensors: the backward pass may recompute from them."""
    model = softmpm.build(busy_scene(2), device=device)
    inputs = busy_inputs(model)
    start = run(softmpm.simulate, model, inputs, 2)
    end = softmpm.simulate(model, start, None, model.params(), substeps=2)
    start.low.x.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        end.x.sum().backward()


def conjugate(tensor: torch.Tensor) -> torch.Tensor:
    """The same numbers, as the imaginary part of a conjugate: a view of memory that has them with the other sign."""
    return torch.complex(torch.zeros_like(tensor), -tensor).conj().imag


def negative(tensor: torch.Tensor) -> torch.Tensor:
    """The same, in contiguous memory."""
    return torch._neg_view((-tensor).contiguous())


@pytest.mark.parametrize("lazily", [conjugate, negative])
@pytest.mark.parametrize("settings", [{"scheme": "plain"}, {"scheme": "fast"}, {"formulation": "reference"}])
def test_lazily_negated_tensors_have_their_sign(lazily, settings, device):
    """Inputs and cotangents with PyTorch's negative bit, as a complex loss gives: end, rasterized field and gradients are those of
    ordinary tensors."""
    scene = dataclasses.replace(busy_scene(2), body_contact=False)
    model = softmpm.build(scene, device=device, inputs=("gravity", "friction"), **settings)
    leaves = [tensor.detach().requires_grad_() for tensor in model.rest()[:4]]
    leaves += [tensor.requires_grad_() for tensor in busy_inputs(model).values()][4:]
    leaves += [tensor.requires_grad_() for tensor in given_inputs(model, ("gravity", "friction"), 2).values()]

    def found(view) -> list[torch.Tensor]:
        x, v, C, F, activation, *others = map(view, leaves)
        params, inputs = softmpm.Params(*others[:3]), softmpm.Inputs(gravity=others[3], friction=others[4])
        start = softmpm.State(x, v, C, F)
        end = softmpm.simulate(model, start, activation, params, substeps=3, inputs=inputs)
        results = [*end[:4], *softmpm.rasterize(model, start)]
        weights = [view(torch.linspace(-1, 1, out.numel()).to(out).view_as(out)) for out in results]
        return [*results, *torch.autograd.grad(results, leaves, weights)]

    for got, want in zip(found(lazily), found(torch.clone), strict=True):
        assert torch.equal(got, want) if device == "cpu" else torch.allclose(got, want, rtol=1e-4, atol=1e-6)


def test_only_what_is_asked_for_is_computed(model):
    """The gradient of one input alone is the same as among all; the others get none."""
    inputs = busy_inputs(model)
    every = gradients(softmpm.simulate, model, inputs, 3)
    for name in INPUTS:
        alone = {k: (t if k == name else t.detach()) for k, t in inputs.items()}
        end = run(softmpm.simulate, model, alone, 3)
        (got,) = torch.autograd.grad(dot(cotangent(end), end), alone[name])
        assert torch.equal(got, every[name]), name


def test_broadcast_parameters_get_gradients_of_their_own_shape(model):
    """One Young's modulus for all particles gets the sum of the particles' gradients."""
    inputs = busy_inputs(model)
    per_particle = gradients(
        softmpm.simulate,
        model,
        inputs | {"young": torch.full_like(inputs["young"], 80.0).requires_grad_()},
        3,
    )
    one = torch.tensor(80.0, dtype=torch.float64, requires_grad=True)
    shared = gradients(softmpm.simulate, model, inputs | {"young": one}, 3)
    assert shared["young"].shape == ()
    assert_relative(shared["young"], per_particle["young"].sum(), 1e-12)


def test_it_works_under_func_grad_checkpoint_autocast_and_compile(model):
    """Each gives the gradient that plain autograd gives."""
    inputs = {name: tensor.detach() for name, tensor in busy_inputs(model).items()}

    def loss(activation):
        end = run(softmpm.simulate, model, inputs | {"activation": activation}, 3)
        return dot(cotangent(end), end)

    leaf = inputs["activation"].clone().requires_grad_()
    (want,) = torch.autograd.grad(loss(leaf), leaf)
    torch.testing.assert_close(torch.func.grad(loss)(inputs["activation"]), want, rtol=0, atol=0)
    (again,) = torch.autograd.grad(checkpoint(loss, leaf, use_reentrant=False), leaf)
    torch.testing.assert_close(again, want, rtol=0, atol=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch.compile itself warns about its back end
        compiled = torch.compile(loss, backend="eager")
        (again,) = torch.autograd.grad(compiled(leaf), leaf)
    torch.testing.assert_close(again, want, rtol=0, atol=0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = leaf.detach().bfloat16().requires_grad_()
        (again,) = torch.autograd.grad(loss(half), half)
    assert again.dtype == torch.bfloat16
    assert_relative(again.double(), want, 0.05)


def _by_jit(work, v):
    return torch.jit.trace(work, (v,), check_trace=False)


def _by_fx(work, v):
    return make_fx(work)(v)


def _with_fake_tensors(work, v):
    """As torch.export does."""
    with FakeTensorMode(allow_non_fake_inputs=True):
        return work(v)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")
@pytest.mark.parametrize("call", ["simulate", "rasterize"])
@pytest.mark.parametrize("trace", [_by_jit, _by_fx, _with_fake_tensors])
def test_tracing_is_refused(model, call, trace):
    """A trace has operations of PyTorch alone: its results would be memory that no kernel has written to."""
    start, params = model.rest(), model.params()

    def work(v):
        state = start._replace(v=v)
        if call == "rasterize":
            return softmpm.rasterize(model, state).velocity
        return softmpm.simulate(model, state, None, params, substeps=1).x

    with pytest.raises(RuntimeError, match="cannot be traced by torch.jit.trace, torch.export or make_fx"):
        trace(work, start.v)
    work(start.v)


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # by PyTorch itself, for forward mode
@pytest.mark.parametrize("name", ["x", "activation", "young"])
def test_no_other_derivative_is_lost(name, scheme):
    """Forward mode and vmap are not there: they raise, also where no gradient is needed and none could be asked for."""
    model = softmpm.build(busy_scene(2, per_law=6), device="cpu", scheme=scheme)
    inputs = {key: tensor.detach() for key, tensor in busy_inputs(model).items()}

    def end(tensor):
        return run(softmpm.simulate, model, inputs | {name: tensor}, 2).v

    for _ in range(2):
        with (
            torch.no_grad(),
            forward_ad.dual_level(),
            pytest.raises((NotImplementedError, RuntimeError), match="jvp"),
        ):
            end(forward_ad.make_dual(inputs[name], torch.ones_like(inputs[name])))
        with torch.no_grad(), pytest.raises(RuntimeError):
            torch.vmap(end)(torch.stack([inputs[name]] * 2))
        with pytest.raises((NotImplementedError, RuntimeError), match="jvp"):
            torch.func.jvp(end, (inputs[name],), (torch.ones_like(inputs[name]),))
        end(inputs[name])

    def weighted(tensor):
        with torch.no_grad():
            found = end(tensor)
        return (found.sum() * tensor).sum()

    got = torch.func.grad(weighted)(inputs[name])
    assert_relative(got, end(inputs[name]).sum().expand_as(got), 1e-6)


def test_hooks_for_saved_tensors(scheme):
    """One that stores tensors in another precision gives a gradient of that precision; one that does not convert them back raises."""
    model = softmpm.build(busy_scene(2, per_law=6), device="cpu", scheme=scheme)
    inputs = busy_inputs(model)
    want = gradients(softmpm.simulate, model, inputs, 5, cotangent(model.rest()))["v"]

    def stored(unpack):
        with torch.autograd.graph.saved_tensors_hooks(
            lambda tensor: (tensor.bfloat16(), tensor.dtype), unpack
        ):
            end = run(softmpm.simulate, model, inputs, 5)
        loss = dot(end[:4], cotangent(model.rest()))
        return torch.autograd.grad(loss, inputs["v"])[0]

    assert_relative(stored(lambda saved: saved[0].to(saved[1])), want, 0.1)
    with pytest.raises(RuntimeError, match=r"saved_tensors_hooks gave back .*bfloat16.* must restore"):
        stored(lambda saved: saved[0])


def test_no_grad_keeps_nothing(model):
    """Under no_grad the end has no history."""
    with torch.no_grad():
        end = run(softmpm.simulate, model, busy_inputs(model), 2)
    assert not any(tensor.requires_grad for tensor in end[:4])


def test_rasterize_has_finite_gradients_at_vanishing_mass():
    """A node with a mass of 1e-30 or less: p/m² would overflow in float32, and a gradient of zero turn into NaN."""
    particles = softmpm.Particles(torch.full((1, 2), 0.5).numpy(), 1e-12)
    body = softmpm.Body(particles, softmpm.NeoHookean(density=1e-9, young=1.0))
    model = softmpm.build(
        softmpm.Scene(grid=softmpm.Grid(shape=(12, 12), spacing=0.1), bodies=[body], dt=1e-9), device="cpu"
    )
    for off in (1e-3, 1e-6, 1e-8):
        x = (model.rest().x * 0 + 0.45 + off).requires_grad_()
        v = torch.ones_like(x).requires_grad_()
        field = softmpm.rasterize(model, model.rest()._replace(x=x, v=v))
        seen = field.velocity * (field.mass / (field.mass + 1e-25))[..., None]
        for gradient in torch.autograd.grad(seen.sum(), (x, v)):
            assert torch.isfinite(gradient).all(), off


@pytest.mark.parametrize("scheme", ["plain", "fast"])
def test_material_changed_in_place_is_seen(scheme):
    """Calls with the same tensors use what the call before made of them, but not once they were written to."""
    model = softmpm.build(busy_scene(2), device="cpu", scheme=scheme)
    inputs = {name: tensor.detach() for name, tensor in busy_inputs(model).items()}
    first, again = (run(softmpm.simulate, model, inputs, 5) for _ in range(2))
    assert torch.equal(first.x, again.x)
    for name in softmpm.Params._fields:
        inputs[name].mul_(0.9)
        fresh = run(softmpm.simulate, model, {key: tensor.clone() for key, tensor in inputs.items()}, 5)
        changed = run(softmpm.simulate, model, inputs, 5)
        assert torch.equal(changed.v, fresh.v) and not torch.equal(changed.v, first.v), name
        first = changed
    inputs["young"].data = 2 * inputs["young"]
    assert not torch.equal(run(softmpm.simulate, model, inputs, 5).v, first.v)


@pytest.mark.parametrize("name, bad", [("young", -1.0), ("poisson", 0.5), ("density", float("nan"))])
def test_material_that_turns_impossible_is_refused(name, bad, scheme, device):
    """Values are not read back for tensors without a write; a write is detected, also through a view."""
    model = softmpm.build(busy_scene(2), device=device, scheme=scheme)
    params = softmpm.Params(*(p.clone() for p in model.params()))
    for _ in range(2):
        softmpm.simulate(model, model.rest(), None, params, substeps=2)
    getattr(params, name)[3:5].select(0, 1).fill_(bad)
    for _ in range(2):
        with pytest.raises(ValueError, match=rf"params.{name} must be .*\[4\]"):
            softmpm.simulate(model, model.rest(), None, params, substeps=2)


def test_material_that_is_learned_is_checked_each_time(model):
    """Also after a step by hand through ``.data``, which PyTorch does not count."""
    young = torch.full((), 80.0, dtype=torch.float64, requires_grad=True)
    params = model.params()._replace(young=young)
    softmpm.simulate(model, model.rest(), None, params, substeps=2)
    young.data.sub_(100.0)
    with pytest.raises(ValueError, match=r"params.young must be finite and > 0, but params.young is -20"):
        softmpm.simulate(model, model.rest(), None, params, substeps=2)


def test_it_works_in_inference_mode(scheme):
    """Whose tensors do not count their writes; what a model keeps from there serves calls with gradient too."""
    model, other = (softmpm.build(busy_scene(2), device="cpu", scheme=scheme) for _ in range(2))
    outside = model.params()
    with torch.inference_mode():
        params = softmpm.Params(*(p.clone() for p in outside))
        first = softmpm.simulate(model, model.rest(), None, params, substeps=3)
        params.young.mul_(2.0)
        stiff = softmpm.simulate(model, model.rest(), None, params, substeps=3)
        softmpm.simulate(model, model.rest(), None, outside, substeps=3)
    want = softmpm.simulate(other, other.rest(), None, other.params(), substeps=3)
    assert torch.equal(first.v, want.v) and not torch.equal(stiff.v, want.v)
    found = []
    for built, material in ((model, outside), (other, other.params())):
        start = built.rest()
        start.v.requires_grad_()
        end = softmpm.simulate(built, start, None, material, substeps=3)
        found += torch.autograd.grad(dot(cotangent(end), end), start.v)
    assert torch.equal(*found)


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_a_model_built_in_inference_mode_has_gradients(formulation):
    """Outside of it, the same as of a model that was built there."""
    scene = busy_scene(2, per_law=4)
    with torch.inference_mode():
        inner = softmpm.build(scene, device="cpu", formulation=formulation)
        softmpm.simulate(inner, inner.rest(), None, inner.params(), substeps=2)
        softmpm.rasterize(inner, inner.rest())
    found = []
    for model in (inner, softmpm.build(scene, device="cpu", formulation=formulation)):
        start = model.rest()
        start.v.requires_grad_()
        end = softmpm.simulate(model, start, None, model.params(), substeps=2)
        loss = dot(cotangent(end), end) + softmpm.rasterize(model, end).velocity.square().sum()
        found += torch.autograd.grad(loss, start.v)
    assert torch.equal(*found)


@pytest.mark.parametrize(
    "number, cause",
    [(torch.nan, "look at the loss"), (torch.inf, "look at the loss"), (3e38, "scale the loss")],
)
def test_rasterize_stops_gradients_that_are_not_finite(number, cause, device):
    """As simulate does, with world and particle: a NaN from a loss, or a number that overflows in the adjoint."""
    model = softmpm.build(busy_scene(2, per_law=4), device=device, worlds=2)
    rest = model.rest()
    field = softmpm.rasterize(model, rest._replace(v=rest.v.requires_grad_()))
    weight = torch.zeros_like(field.velocity)
    weight[1] = number
    with pytest.raises(
        softmpm.UnstableError, match=f"particle 0 .* of world 1 .* of rasterize.*{cause}"
    ) as caught:
        (field.velocity * weight).sum().backward()
    assert (caught.value.kind, caught.value.world, caught.value.particle) == ("gradient", 1, 0)


def batched_gradients(f, v):
    v = v.clone().requires_grad_()
    y = f(v)
    return torch.autograd.grad(y, v, torch.stack([torch.ones_like(y)] * 2), is_grads_batched=True)


@pytest.mark.parametrize("name", ["simulate", "rasterize"])
@pytest.mark.parametrize(
    "call",
    [
        lambda f, v: torch.vmap(f)(torch.stack([v, v])),
        lambda f, v: torch.vmap(torch.func.grad(lambda v: f(v).sum()))(torch.stack([v, v])),
        lambda f, v: torch.func.jacrev(f)(v),
        lambda f, v: torch.func.jacfwd(f)(v),
        lambda f, v: torch.func.hessian(lambda v: f(v).sum())(v),
        lambda f, v: torch.autograd.functional.jacobian(f, v, vectorize=True),
        batched_gradients,
    ],
    ids=["vmap", "vmap of grad", "jacrev", "jacfwd", "hessian", "jacobian", "is_grads_batched"],
)
@pytest.mark.filterwarnings(
    "ignore:.torch.jit.script. is deprecated:DeprecationWarning"
)  # of PyTorch's own jacfwd
def test_batches_of_pytorch_lead_to_worlds(model, name, call):
    """One sentence names worlds=, instead of a tensor without storage somewhere inside."""
    rest, params = model.rest(), model.params()

    def moved(v):
        state = rest._replace(v=v)
        if name == "rasterize":
            return softmpm.rasterize(model, state).velocity
        return softmpm.simulate(model, state, None, params, substeps=1).x

    with pytest.raises(RuntimeError, match="softmpm: .* not available; .*build the model with worlds=N"):
        call(moved, rest.v)


def test_batches_of_material_and_activation_lead_to_worlds(model):
    """As those of the start."""
    rest, params = model.rest(), model.params()
    for given, call in (
        (torch.zeros(3, 1, 1, 2).double(), lambda a: softmpm.simulate(model, rest, a, params, substeps=1).x),
        (
            params.young.expand(3, -1),
            lambda e: softmpm.simulate(model, rest, None, params._replace(young=e), substeps=1).x,
        ),
    ):
        with pytest.raises(RuntimeError, match="build the model with worlds=N instead"):
            torch.vmap(call)(given)


def test_worlds_are_the_rows_of_a_jacobian(model):
    """The remedy of the message: a world for each output gives the rows that a loop gives."""
    scene, outputs = model.scene, 3
    many = softmpm.build(scene, device="cpu", dtype=torch.float64, worlds=outputs)
    v = many.rest().v.requires_grad_()
    end = softmpm.simulate(many, many.rest()._replace(v=v), None, many.params(), substeps=3)
    (rows,) = torch.autograd.grad(end.x[range(outputs), range(outputs), 0].sum(), v)
    v = model.rest().v.requires_grad_()
    end = softmpm.simulate(model, model.rest()._replace(v=v), None, model.params(), substeps=3)
    for k in range(outputs):
        (want,) = torch.autograd.grad(end.x[0, k, 0], v, retain_graph=True)
        torch.testing.assert_close(rows[k], want[0], rtol=1e-13, atol=1e-16)
