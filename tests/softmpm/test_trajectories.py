"""Trajectories: the frames are those of single calls, the end and every gradient those of one long call."""

import pytest
import torch
from helpers import assert_relative, busy_inputs, busy_scene, cotangent, dot, full_scene, given

import softmpm
from softmpm import Inputs, Params, State

STEPS, SUBSTEPS = 6, 3
NAMES = (
    "gravity",
    "damping",
    "friction",
    "direction",
    "viscosity",
    "force",
    "wall_offset",
    "wall_normal",
    "wall_velocity",
)


def build(made: softmpm.Scene, **settings) -> softmpm.Model:
    alarms = softmpm.Alarms(gap=None)
    return softmpm.build(made, device=settings.pop("device", "cpu"), alarms=alarms, **settings)


def leaves_of(model: softmpm.Model, names=()) -> dict[str, torch.Tensor]:
    return busy_inputs(model, STEPS) | given(model, names, STEPS)


def arguments(leaves: dict[str, torch.Tensor]) -> tuple[State, torch.Tensor, Params, Inputs]:
    return (
        State(*(leaves[name] for name in "xvCF")),
        leaves["activation"],
        Params(*(leaves[name] for name in Params._fields)),
        Inputs(**{name: value for name, value in leaves.items() if name in Inputs._fields}),
    )


@pytest.mark.parametrize("every", [1, 2, 3])
@pytest.mark.parametrize("handles", ["velocity", "position"])
def test_all_inputs(every, handles):
    """With every input and other values in each of two worlds, walls that move among them: the end and all gradients are those of one
    call: ≤ 1e-10."""
    model = build(full_scene(2), dtype=torch.float64, worlds=2, inputs=NAMES)
    leaves = leaves_of(model, (*NAMES, "strength", handles))
    start, activation, params, inputs = arguments(leaves)
    found = softmpm.trajectory(
        model, start, activation, params, substeps=SUBSTEPS, every=every, inputs=inputs
    )
    want = softmpm.simulate(model, start, activation, params, substeps=SUBSTEPS, inputs=inputs)
    assert found.frames.x.shape == (STEPS // every, *start.x.shape)
    weights = cotangent(want)
    gradients = []
    for end in (found.end, want):
        gradients.append(torch.autograd.grad(dot(weights, end), list(leaves.values())))
    for name, a, b in zip("xvCF", found.end[:4], want[:4], strict=True):
        assert_relative(a.detach(), b.detach(), 1e-10, name)
    for name, got, one in zip(leaves, *gradients, strict=True):
        assert one.abs().max() > 0, name
        assert_relative(got, one, 1e-10, name)


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_frames_are_ends_of_calls(formulation):
    """Each frame equals the end of one call over the control steps before it, in every tensor of a state, to the last bit when the
    calls are the same; also its gradient with respect to the activation before it, and none to the one after."""
    box = softmpm.box((0.33, 0.42), (0.62, 0.6), spacing=0.05)
    body = softmpm.Body(box, softmpm.NeoHookean(density=1.2, young=80.0))
    made = busy_scene(
        2, bodies=[body], muscles=[softmpm.Muscle(particles=range(9), direction=(0, 1), strength=9)]
    )
    model = build(made, formulation=formulation, worlds=2)
    activation = 0.3 * torch.rand(STEPS, 2, 1, generator=torch.Generator().manual_seed(1))
    activation.requires_grad_()
    rest, params = model.rest(), model.params()
    found = softmpm.trajectory(model, rest, activation, params, substeps=SUBSTEPS, every=2)
    state = rest
    for k in range(3):
        state = softmpm.simulate(model, state, activation[2 * k : 2 * k + 2], params, substeps=SUBSTEPS)
        for name, frames, single in zip(State._fields, found.frames, state, strict=True):
            parts = (
                [(frames, single)]
                if isinstance(single, torch.Tensor)
                else zip(frames or (), single or (), strict=True)
            )
            assert all(torch.equal(a[k], b) for a, b in parts if b is not None), name
    assert (found.frames.nodes is None) == (formulation == "moving")
    assert found.frames.surface is not None or found.frames.nodes is not None
    assert torch.equal(found.end.x, state.x)
    (slope,) = torch.autograd.grad(found.frames.x[1].square().sum(), activation, retain_graph=True)
    assert (slope[:4] != 0).all() and (slope[4:] == 0).all()


def test_observations():
    """Tensors, named tuples, dictionaries and lists of them are stacked; their gradient is that of observing single calls."""
    model = build(busy_scene(2), dtype=torch.float64, worlds=2)
    start, activation, params, _ = arguments(leaves_of(model))

    def observe(state):
        center = softmpm.center_of_mass(model, state, params)
        return {"center": center, "parts": [softmpm.GridField(state.x, state.v), None]}

    frames = softmpm.trajectory(model, start, activation, params, substeps=2, every=3, observe=observe).frames
    assert frames["center"].shape == (2, 2, 2)
    field, nothing = frames["parts"]
    assert isinstance(field, softmpm.GridField) and nothing is None
    middle = softmpm.simulate(model, start, activation[:3], params, substeps=2)
    assert torch.equal(field.velocity[0], middle.v)
    want = torch.autograd.grad(softmpm.center_of_mass(model, middle, params).sum(), activation)
    got = torch.autograd.grad(frames["center"][0].sum(), activation)
    assert_relative(got[0], want[0], 1e-12)


def test_a_passive_body():
    """Without activation the number of control steps is stated, or that of the rows of an input; muscles then rest."""
    model = build(busy_scene(2), dtype=torch.float64, inputs=("force", "wall_offset"))
    start, params = model.rest(), model.params()
    found = softmpm.trajectory(model, start, None, params, substeps=2, control_steps=4, every=2)
    want = softmpm.simulate(model, start, None, params, substeps=8)
    torch.testing.assert_close(found.end.x, want.x, rtol=0, atol=1e-13)
    assert found.frames.v.shape[0] == 2
    force = 1e-3 * torch.ones(4, 1, model.particle_count, 2, dtype=torch.float64)
    offset = (
        torch.linspace(0.41, 0.412, 5, dtype=torch.float64)[:, None, None] * torch.tensor([1.0, 0.0]).double()
    )
    inputs = Inputs(force=force, wall_offset=offset - torch.tensor([0.0, 0.45]).double())
    found = softmpm.trajectory(model, start, None, params, substeps=2, inputs=inputs)
    want = softmpm.simulate(model, start, None, params, substeps=2, inputs=inputs)
    assert found.frames.x.shape[0] == 4
    torch.testing.assert_close(found.end.x, want.x, rtol=0, atol=1e-13)


def test_failures_are_passed_on():
    """A world that leaves the grid is frozen in each call and counted; without failures the error names its control step."""
    model = build(busy_scene(2, walls=[]), worlds=2)
    start, params = model.rest(), model.params()
    start.v[1, :, 0] = 30.0
    failures = softmpm.Failures("freeze")
    found = softmpm.trajectory(model, start, None, params, substeps=5, control_steps=6, failures=failures)
    assert failures.worlds == [1] and found.frames.x.shape[0] == 6
    assert "from the beginning of control step" in failures.errors[0].__notes__[0]
    alone = softmpm.trajectory(model, model.rest(), None, params, substeps=5, control_steps=6)
    assert torch.equal(found.end.x[0], alone.end.x[0])
    with pytest.raises(softmpm.UnstableError) as caught:
        softmpm.trajectory(model, start, None, params, substeps=5, control_steps=6)
    first = failures.errors[0]
    assert caught.value.substep == first.substep and caught.value.__notes__ == first.__notes__


def test_what_does_not_fit_is_refused():
    """Numbers of control steps that contradict each other, and observations that are no tensors."""
    model = build(busy_scene(2))
    start, params = model.rest(), model.params()
    activation = torch.zeros(4, 1, 2)
    for options, kind, message in (
        (dict(every=3), ValueError, "every must divide the number of control steps, got every=3 and 4"),
        (dict(every=0), ValueError, "every must be a whole number"),
        (
            dict(control_steps=5),
            ValueError,
            "control_steps must be the number of rows of activation and inputs, 4, got 5",
        ),
        (dict(control_steps=0), ValueError, "control_steps must be a whole number"),
        (dict(observe=lambda state: 1.0), TypeError, "observe must return tensors, .* got float"),
    ):
        with pytest.raises(kind, match=message):
            softmpm.trajectory(model, start, activation, params, substeps=1, **options)
    with pytest.raises(ValueError, match="substeps must be a whole number"):
        softmpm.trajectory(model, start, activation, params, substeps=0)
    with pytest.raises(TypeError, match="trajectory needs a model"):
        softmpm.trajectory(model.scene, start, activation, params, substeps=1)


@pytest.mark.parametrize(
    ("first", "later", "message"),
    [
        (None, torch.zeros(2), "None and later a tensor of shape \\(2,\\)"),
        ({"a": torch.zeros(2)}, {"a": torch.zeros(2), "b": None}, "a dictionary of a and later .* of a, b"),
        (torch.zeros(2), torch.zeros(3), "a tensor of shape \\(2,\\) and later .* \\(3,\\)"),
        ([torch.zeros(2)], [], "a list of length 1 and later .* 0"),
    ],
)
def test_observations_that_change_their_structure(first, later, message):
    """They are refused: what the first frame has not was left out of all."""
    model = build(busy_scene(2))
    start, activation, params, _ = arguments(leaves_of(model))
    frames = iter([first])
    with pytest.raises(
        ValueError, match=f"observe must return values of one structure in all frames, got {message}"
    ):
        softmpm.trajectory(
            model, start, activation, params, substeps=1, observe=lambda _: next(frames, later)
        )


@pytest.mark.parametrize("name", ["activation", "force", "position"])
def test_a_number_that_is_not_finite_is_refused_at_once(name):
    """By its name and its row in the whole trajectory, before the first frame."""
    model = build(full_scene(2), inputs=("force",))
    leaves = {key: leaf.detach() for key, leaf in leaves_of(model, ("force", "position")).items()}
    leaves[name][4].view(-1)[1] = torch.nan
    start, activation, params, inputs = arguments(leaves)
    frames = []
    place = rf"{name}\[4, 0, {'1' if name == 'activation' else '0, 1'}\] is nan"
    with pytest.raises(ValueError, match=place):
        softmpm.trajectory(model, start, activation, params, substeps=1, inputs=inputs, observe=frames.append)
    assert not frames


def test_in_a_graph(device):
    """Captured with its gradient and its energies, replayed on new values: as without a graph."""
    model = build(busy_scene(2), device=device, worlds=2, deterministic=True)
    start, params = model.rest(), model.params()
    activation = torch.zeros(4, 2, 2, device=device, requires_grad=True)

    def work():
        def observe(state):
            return softmpm.elastic_energy(model, state, params) + softmpm.kinetic_energy(model, state, params)

        found = softmpm.trajectory(model, start, activation, params, substeps=3, every=2, observe=observe)
        (slope,) = torch.autograd.grad(found.frames.sum(), activation)
        return found.frames.detach(), slope

    graph = softmpm.Graph(work, model.device)
    for k in range(4):
        with torch.no_grad():
            activation.fill_(0.1 * k)
        frames, slope = (tensor.clone() for tensor in graph())
        want_frames, want_slope = work()
        torch.testing.assert_close(frames, want_frames, rtol=1e-5, atol=0)
        torch.testing.assert_close(slope, want_slope, rtol=1e-3, atol=1e-7)


def test_half_precision_under_autocast():
    """The activation that a policy gives there is taken, as by ``simulate``, with the same bits."""
    model = build(busy_scene(2))
    start, activation, params, _ = arguments(leaves_of(model))
    half = activation.detach().bfloat16()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = softmpm.trajectory(model, start, half, params, substeps=SUBSTEPS).end
        want = softmpm.simulate(model, start, half, params, substeps=SUBSTEPS)
    assert all(torch.equal(a, b) for a, b in zip(found[:4], want[:4], strict=True))
