"""Inputs of a call besides state, activation and material: every value and gradient against the float64 oracle."""

import pytest
import torch
from helpers import (
    GIVEN,
    WALL_INPUTS,
    assert_relative,
    busy_inputs,
    busy_scene,
    cotangent,
    dot,
    full_scene,
    given,
    little_memory,
)

import softmpm
from softmpm import Inputs
from softmpm.oracle import moving

TIMED = {"activation", "velocity", "position", "force", *WALL_INPUTS}
"""Inputs with a first axis of control steps or poses."""
STEPS = 3


def build(made: softmpm.Scene, **settings) -> softmpm.Model:
    alarms = softmpm.Alarms(gap=None)
    return softmpm.build(made, device=settings.pop("device", "cpu"), alarms=alarms, **settings)


def scene_for(name: str) -> softmpm.Scene:
    """:func:`full_scene` for calls that give this input alone, with driven particles where it moves them."""
    return full_scene(2) if name in ("velocity", "position") else full_scene(2, driven=())


def both(model: softmpm.Model, names, substeps=2, steps=STEPS):
    """Ends and gradients of ⟨weights, end⟩ by the model and by the oracle, with the leaves they belong to."""
    base, extra = busy_inputs(model, control_steps=steps), given(model, names, steps)
    leaves = base | extra
    copies = {name: t.detach().cpu().double().requires_grad_() for name, t in leaves.items()}
    weights = cotangent(softmpm.State(*(copies[name] for name in "xvCF")))
    found = []
    for simulate, on, tensors in (
        (softmpm.simulate, model, leaves),
        (moving.simulate, model.scene, copies),
    ):
        start = softmpm.State(*(tensors[name] for name in "xvCF"))
        params = softmpm.Params(*(tensors[name] for name in softmpm.Params._fields))
        inputs = Inputs(**{name: tensors[name] for name in names})
        end = simulate(on, start, tensors["activation"], params, substeps=substeps, inputs=inputs)
        loss = dot(softmpm.State(*(w.to(end.x) for w in weights[:4])), end)
        gradients = torch.autograd.grad(loss, list(tensors.values()))
        found.append((end, dict(zip(tensors, gradients, strict=True))))
    return found


def assert_equal(model: softmpm.Model, names, limit: float, **options) -> None:
    (end, got), (wanted_end, want) = both(model, names, **options)
    for name, a, b in zip("xvCF", end[:4], wanted_end[:4], strict=True):
        assert_relative(a.detach().cpu().double(), b.detach(), limit, f"the end's {name}")
    for name in want:
        assert want[name].abs().max() > 0, f"the test does not exercise {name}"
        assert_relative(got[name].cpu().double(), want[name], limit, name)


@pytest.mark.parametrize("dim", [2, 3])
def test_every_input_is_the_references(dim, scheme, device):
    """All inputs at once, other ones in each of two worlds, with muscles and every kind of wall at work: ≤ 1e-10."""
    names = (*GIVEN, *WALL_INPUTS)
    model = build(full_scene(dim), device=device, dtype=torch.float64, scheme=scheme, worlds=2, inputs=names)
    assert_equal(model, (*names, "strength", "velocity"), 1e-10)


@pytest.mark.parametrize("name", [*GIVEN, "wall_velocity", "wall_offset", "strength", "velocity", "position"])
def test_each_input_alone_is_the_references(name, scheme):
    """Kernels compiled for a single input: ≤ 1e-10."""
    model = build(scene_for(name), dtype=torch.float64, scheme=scheme, worlds=2, inputs=(name,))
    assert_equal(model, (name,), 1e-10)


@pytest.mark.parametrize("deterministic", [False, True])
def test_inputs_in_single_precision(deterministic, device):
    """The fast scheme in float32, in floating and in fixed point: ≤ 5e-4 of every gradient."""
    names = (*GIVEN, *WALL_INPUTS)
    model = build(full_scene(2), device=device, worlds=2, inputs=names, deterministic=deterministic)
    assert_equal(model, (*names, "strength", "velocity"), 5e-4)


def test_inputs_over_chunks_that_begin_within_a_control_step(scheme):
    """Few states are checkpointed, chunks begin in the middle of control steps: walls are where they are: ≤ 1e-9."""
    names = (*GIVEN, *WALL_INPUTS)
    settings = dict(dtype=torch.float64, scheme=scheme, worlds=2, inputs=names)
    model = build(full_scene(2), **settings)
    model = build(full_scene(2), **settings, **little_memory(model))
    assert_equal(model, (*names, "strength", "velocity"), 1e-9, substeps=7)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradcheck_of_inputs(dim):
    """PyTorch's own finite differences in float64."""
    names = (
        "gravity",
        "damping",
        "friction",
        "direction",
        "strength",
        "velocity",
        "wall_velocity",
        "wall_offset",
    )
    model = build(full_scene(dim, driven=(1,)), dtype=torch.float64, inputs=names)
    base, extra = busy_inputs(model, control_steps=2), given(model, names, steps=2)
    start = softmpm.State(*(base[name].detach() for name in "xvCF"))
    activation, params = base["activation"].detach(), model.params()

    def end(*tensors):
        inputs = Inputs(**dict(zip(names, tensors, strict=True)))
        found = softmpm.simulate(model, start, activation, params, substeps=2, inputs=inputs)
        return found.x, found.v

    assert torch.autograd.gradcheck(
        end, tuple(extra.values()), eps=1e-7, atol=1e-6, rtol=1e-4, fast_mode=True
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_worlds_equal_single_runs(dtype, scheme):
    """Three worlds, each with inputs of its own, give what each gives alone."""
    names = (*GIVEN, *WALL_INPUTS)
    many = build(full_scene(2), dtype=dtype, scheme=scheme, worlds=3, inputs=names)
    one = build(full_scene(2), dtype=dtype, scheme=scheme, inputs=names)
    base, extra = busy_inputs(many, STEPS), given(many, (*names, "strength", "velocity"), STEPS)
    limit = 2e-5 if dtype == torch.float32 else 1e-12

    def run(model, pick):
        start = softmpm.State(*(pick(name, base[name]) for name in "xvCF"))
        params = softmpm.Params(*(pick(name, base[name]) for name in softmpm.Params._fields))
        inputs = Inputs(**{name: pick(name, tensor) for name, tensor in extra.items()})
        activation = pick("activation", base["activation"])
        end = softmpm.simulate(model, start, activation, params, substeps=3, inputs=inputs)
        loss = sum((t**2).sum() for t in end[:4])
        return end, dict(zip(extra, torch.autograd.grad(loss, list(extra.values())), strict=True))

    def world(w):
        return lambda name, tensor: tensor[:, w : w + 1] if name in TIMED else tensor[w : w + 1]

    end, gradients = run(many, lambda name, tensor: tensor)
    for w in range(3):
        alone, own = run(one, world(w))
        for got, want in zip(end[:4], alone[:4], strict=True):
            assert_relative(got[w : w + 1].detach(), want.detach(), limit)
        for name in extra:
            pick = world(w)
            assert_relative(pick(name, gradients[name]), pick(name, own[name]), 50 * limit, name)


def test_one_number_serves_every_world_and_control_step():
    """Inputs broadcast; their gradients are the sums."""
    model = build(full_scene(2), dtype=torch.float64, worlds=2, inputs=("gravity", "force"))
    gravity = torch.tensor([0.5, -3.0], dtype=torch.float64, requires_grad=True)
    force = torch.full((2,), 0.01, dtype=torch.float64, requires_grad=True)
    base = busy_inputs(model, STEPS)
    start = softmpm.State(*(base[name].detach() for name in "xvCF"))
    few = Inputs(gravity=gravity, force=force)
    full = Inputs(
        gravity=gravity.expand(model.shape_of("gravity", STEPS)),
        force=force.expand(model.shape_of("force", STEPS)),
    )
    found = []
    for inputs in (few, full):
        end = softmpm.simulate(model, start, base["activation"], model.params(), substeps=2, inputs=inputs)
        found.append(torch.autograd.grad((end.x**2).sum(), (gravity, force)))
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=0)


@pytest.mark.parametrize("formulation", ["moving", "reference"])
@pytest.mark.parametrize("name", ["gravity", "wall_velocity", "direction", "force", "velocity"])
def test_one_number_serves_every_component(name, formulation):
    """Along the axes of space a vector broadcasts too."""
    model = build(scene_for(name), dtype=torch.float64, worlds=2, inputs=(name,), formulation=formulation)
    shape, params, found = model.shape_of(name, 1), model.params(), []
    activation = torch.full((1, 2, model.muscle_count), 0.3, dtype=torch.float64)
    number = torch.tensor(0.02, dtype=torch.float64, requires_grad=True)
    for value in (number, number.view(1), number.expand(*shape[:-1], 1), number.expand(shape).contiguous()):
        inputs = Inputs(**{name: value})
        end = softmpm.simulate(model, model.rest(), activation, params, substeps=2, inputs=inputs)
        found.append([end.x.detach(), *torch.autograd.grad((end.x**2).sum() + end.v.sum(), number)])
    for few in found[:-1]:
        for got, want in zip(few, found[-1], strict=True):
            torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    "formulation, scheme", [("moving", "plain"), ("moving", "fast"), ("reference", "auto")]
)
def test_inputs_of_any_layout(formulation, scheme):
    """Vectors whose numbers do not lie side by side, as after a transposition, have the values and gradients of copies."""
    names = ("gravity", "direction", "force", "wall_velocity", "wall_normal")
    settings = dict(dtype=torch.float64, formulation=formulation, scheme=scheme, inputs=names)
    model = build(full_scene(2, driven=()), **settings)
    made = {name: value.detach() for name, value in given(model, names, 1).items()} | {
        "gravity": torch.full((2,), -1.0).double()
    }
    turned = {name: value.mT.contiguous().mT for name, value in made.items() if name != "gravity"}
    turned["gravity"] = torch.tensor(-1.0, dtype=torch.float64).expand(2)
    assert all(value.stride(-1) != 1 for value in turned.values())
    found = []
    for inputs in (turned, made):
        leaves = {name: value.detach().requires_grad_() for name, value in inputs.items()}
        shape = 1, model.worlds, model.muscle_count
        activation = torch.full(shape, 0.3, dtype=torch.float64)
        end = softmpm.simulate(
            model, model.rest(), activation, model.params(), substeps=3, inputs=Inputs(**leaves)
        )
        found.append(
            [
                end.x.detach(),
                *torch.autograd.grad((end.x**2).sum() + end.v.sum(), [leaves[name] for name in names]),
            ]
        )
    for name, got, want in zip(("x", *names), *found, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=0, msg=name)


@pytest.mark.parametrize("with_offset", [True, False])
def test_the_length_of_a_normal_moves_no_wall(with_offset):
    """Normals of another length are the same walls: alone at the offsets of the scene, with offsets of that length."""
    model = build(full_scene(2, driven=()), inputs=("wall_normal",))
    normal, offset = (model.defaults[f"wall_{name}"] for name in ("normal", "offset"))
    ends = []
    for length in (1.0, 4.0):  # powers of two round nothing
        inputs = Inputs(wall_normal=length * normal, wall_offset=length * offset if with_offset else None)
        ends.append(softmpm.simulate(model, model.rest(), None, model.params(), substeps=20, inputs=inputs))
    for name, one, other in zip("xvCF", ends[0][:4], ends[1][:4], strict=True):
        assert torch.equal(one, other), name


def test_inputs_that_a_model_cannot_take():
    """Each message says the rule, what was given and a remedy."""
    model = build(full_scene(2, driven=()), worlds=2, inputs=("friction", "wall_offset"))
    wall = model.wall_count

    def call(**inputs):
        softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, inputs=Inputs(**inputs))

    call(friction=torch.full((wall,), 0.2))
    for inputs, said in (
        (
            {"gravity": torch.zeros(2)},
            r"inputs.gravity was given, .* build the model with inputs=\('gravity',\)",
        ),
        (
            {"friction": torch.zeros(2, wall + 1)},
            r"must broadcast to \(world, wall\) = \(2, 3\), got shape \(2, 4\); one value for each world has shape \(2, 1\)",
        ),
        (
            {"friction": -torch.ones(wall)},
            r"inputs.friction must be finite and ≥ 0, but inputs.friction\[0\] is -1",
        ),
        ({"friction": torch.zeros(wall).double()}, "inputs.friction must be torch.float32 like the model"),
        (
            {"wall_offset": torch.zeros(2, wall).double()},
            r"got shape \(2, 3\); give the first two axes both or neither",
        ),
        ({"wall_offset": torch.zeros(wall)}, "inputs.wall_offset must be torch.float64 in every precision"),
        ({"strength": torch.full((3,), torch.nan)}, "inputs.strength must be finite"),
    ):
        with pytest.raises(ValueError, match=said):
            call(**inputs)
    for name in ("wall_normal", "direction"):
        steered = build(full_scene(2, driven=()), inputs=(name,))
        zero = torch.zeros(steered.shape_of(name, 1), dtype=torch.float64 if name == "wall_normal" else None)
        inputs = Inputs(**{name: zero})
        with pytest.raises(ValueError, match=rf"the length of inputs.{name} must be > 0, but .* is 0"):
            softmpm.simulate(steered, steered.rest(), None, steered.params(), substeps=1, inputs=inputs)
    offsets = torch.zeros(4, 1, wall, dtype=torch.float64)
    activation = torch.zeros(2, 2, model.muscle_count)
    inputs = Inputs(wall_offset=offsets)
    with pytest.raises(ValueError, match="2 in activation, 3 in inputs.wall_offset"):
        softmpm.simulate(model, model.rest(), activation, model.params(), substeps=1, inputs=inputs)
    with pytest.raises(ValueError, match="inputs must be among gravity"):
        build(full_scene(2), inputs=("wind",))
    with pytest.raises(ValueError, match="inputs has 'friction', but the scene has no walls"):
        build(busy_scene(2, walls=()), inputs=("friction",))


def test_what_rounding_or_interpolation_loses_is_refused():
    """A damping that changes the velocity by less than 16 of its last digits, and a wall that turns by 90° or more at once."""
    model = build(full_scene(2, driven=()), inputs=("damping", "wall_normal"))
    least = 16 * torch.finfo(torch.float32).eps / model.scene.dt
    turn = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)[:, None, None].expand(
        -1, 1, model.wall_count, -1
    )
    for inputs, said in (
        (
            Inputs(damping=torch.tensor([0.9 * least])),
            r"inputs\.damping must be 0 or at least .* lost in the rounding",
        ),
        (Inputs(wall_normal=turn), "must be > 0: a wall turns by less than 90° in a control step"),
    ):
        with pytest.raises(ValueError, match=said):
            softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, inputs=inputs)
    for damping in (0.0, 1.1 * least):
        inputs = Inputs(damping=torch.tensor([damping]))
        softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, inputs=inputs)


@pytest.mark.gpu
@pytest.mark.parametrize("names", [(*GIVEN, *WALL_INPUTS), ("friction", "gravity")], ids=["all", "two"])
def test_a_graph_takes_inputs(names):
    """Two calls and their gradients, captured and replayed: ≤ 1e-5 of the same calls, also after gravity changed in place."""
    model = build(full_scene(2), device="cuda", worlds=2, inputs=names)
    more = given(model, (*names, *(("strength", "position") if "force" in names else ())), STEPS)
    leaves = busy_inputs(model, STEPS) | more
    params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))

    def work():
        end = softmpm.State(*(leaves[name] for name in "xvCF"))
        for substeps, left_out in ((7, ()), (5, ("position",))):
            inputs = Inputs(**{name: tensor for name, tensor in more.items() if name not in left_out})
            end = softmpm.simulate(model, end, leaves["activation"], params, substeps=substeps, inputs=inputs)
        loss = sum((tensor**2).sum() for tensor in end[:4])
        return loss.detach(), *torch.autograd.grad(loss, list(leaves.values()))

    graph = softmpm.Graph(work, model.device)
    for change in (0.0, 1.0):
        with torch.no_grad():
            leaves["gravity"] += change
        want = [tensor.clone() for tensor in work()]
        for _ in range(3):
            got = graph()
        for name, a, b in zip(("loss", *leaves), got, want, strict=True):
            assert_relative(a.double(), b.double(), 1e-5, name)
