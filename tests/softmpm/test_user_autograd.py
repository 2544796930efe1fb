"""What users of PyTorch do with a call: transforms, autocast, second derivatives, retained losses, and gradients of changed states."""

import dataclasses
import gc

import pytest
import torch

import softmpm

GRID = softmpm.Grid(shape=(10, 10), spacing=0.1)


def built(law=softmpm.NeoHookean, **settings) -> softmpm.Model:
    """A block with a muscle, in float64."""
    block = softmpm.box((0.3, 0.3), (0.5, 0.5), spacing=0.05)
    muscle = softmpm.Muscle(particles=range(len(block)), direction=(0.0, 1.0), strength=4.0)
    body = softmpm.Body(block, law(density=1.0, young=50.0, poisson=0.3))
    scene = softmpm.Scene(grid=GRID, bodies=[body], muscles=[muscle], gravity=(0.0, -1.0), dt=1e-4)
    return softmpm.build(scene, **{"device": "cpu", "dtype": torch.float64, **settings})


@pytest.mark.filterwarnings("ignore:.*torch.jit.script:DeprecationWarning")  # of torch.func.jvp itself
@pytest.mark.parametrize("law", [softmpm.FixedCorotated, softmpm.BarrierCorotated])
def test_a_second_derivative_of_the_energy_raises_where_it_is_not_known(law):
    """An infinitesimal rotation would cost energy. First derivatives, of a batch and forward too, agree with differences."""
    model = built(law)
    rest, params = model.rest(), model.params()
    random = torch.randn(rest.F.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def energy(H: torch.Tensor) -> torch.Tensor:
        return softmpm.elastic_energy(model, rest._replace(F=rest.F + H), params).sum()

    H = (0.1 * random).requires_grad_()
    (slope,) = torch.autograd.grad(energy(H), H)
    assert torch.equal(torch.func.grad(energy)(H.detach()), slope)
    step = 1e-6 * random
    difference = (energy(H.detach() + step) - energy(H.detach() - step)) / 2e-6
    assert (slope * random).sum().item() == pytest.approx(difference.item(), rel=1e-8)
    batch = torch.stack([H.detach(), 2 * H.detach()])
    rows = torch.vmap(torch.func.grad(energy))(batch)
    for one, row in zip(batch, rows, strict=True):
        torch.testing.assert_close(row, torch.func.grad(energy)(one))
    (_, along) = torch.func.jvp(energy, (H.detach(),), (random,))
    assert along.item() == pytest.approx((slope * random).sum().item(), rel=1e-10)
    with pytest.raises(RuntimeError, match="second derivatives are not available"):
        torch.func.grad(lambda H: torch.func.jvp(energy, (H,), (random,))[1])(H.detach())
    (slope,) = torch.autograd.grad(energy(H), H, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives are not available"):
        slope.sum().backward()


def test_a_second_derivative_of_the_energy_is_right_where_it_is_known():
    """A rotation costs none."""
    model = built()
    rest, params = model.rest(), model.params()
    turn = torch.tensor([[0.0, -1.0], [1.0, 0.0]]).double()

    def energy(angle: torch.Tensor) -> torch.Tensor:
        return softmpm.elastic_energy(model, rest._replace(F=rest.F + angle * turn), params).sum()

    hessian = torch.autograd.functional.hessian(energy, torch.zeros((), dtype=torch.float64))
    assert isinstance(hessian, torch.Tensor) and abs(hessian.item()) < 1e-9


@pytest.mark.parametrize("name", ["x", "v", "C", "F"])
def test_a_leaf_among_the_particles_of_nodes_is_refused(name, device):
    """Also where the nodes have a history: their gradient would pass it by."""
    model = built(formulation="reference", device=device)
    young = torch.full((), 50.0, dtype=torch.float64, device=device, requires_grad=True)
    params = model.params()._replace(young=young)
    state = softmpm.simulate(model, model.rest(), None, params, substeps=2)
    leaf = getattr(state, name).detach().requires_grad_()
    with pytest.raises(ValueError, match=rf"state\.{name} requires a gradient.*does not reach it; take"):
        softmpm.simulate(model, state._replace(**{name: leaf}), None, params, substeps=2)
    softmpm.simulate(model, state, None, params, substeps=2)


def test_forces_of_clamps_are_exact_under_autocast(device):
    """As everything else that a model gives."""
    scene = built().scene
    scene = dataclasses.replace(scene, walls=[softmpm.Wall(normal=(1.0, 0.0), offset=0.3, contact="clamp")])
    model = softmpm.build(scene, device=device, dtype=torch.float32, formulation="reference")
    state = softmpm.simulate(
        model, model.rest(), torch.ones(1, 1, 1, device=device), model.params(), substeps=20
    )
    want = softmpm.clamp_forces(model, state)
    with torch.autocast(device, dtype=torch.bfloat16):
        found = softmpm.clamp_forces(model, state)
    assert found.dtype == torch.float32 and want.abs().max() > 0
    torch.testing.assert_close(found, want, rtol=1e-6, atol=0)


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_torch_func_differentiates_closed_loops(formulation, device):
    """Calls that go on from others, whose states carry wrappers of the transform."""
    model = built(formulation=formulation, device=device)
    params = model.params()

    def loss(activation: torch.Tensor) -> torch.Tensor:
        state = model.rest()
        for row in activation:
            state = softmpm.simulate(model, state, row[None], params, substeps=2)
        film = softmpm.trajectory(model, state, activation, params, substeps=2)
        return film.end.x.square().sum() + softmpm.kinetic_energy(model, state, params).sum()

    activation = torch.full((3, 1, 1), 0.3, dtype=torch.float64, device=device)
    found = torch.func.grad(loss)(activation)
    activation.requires_grad_()
    (want,) = torch.autograd.grad(loss(activation), activation)
    torch.testing.assert_close(found, want, rtol=1e-10, atol=1e-15)
    assert want.abs().max() > 0


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_torch_compile_leaves_what_it_cannot_trace(formulation, device):
    """Energies of states with nodes, and states in Warp arrays."""
    model = built(formulation=formulation, device=device)
    params = model.params()
    state = softmpm.simulate(
        model, model.rest(), torch.ones(1, 1, 1, dtype=torch.float64, device=device), params, substeps=2
    )

    def work(state: softmpm.State) -> tuple[torch.Tensor, torch.Tensor]:
        energy = softmpm.kinetic_energy(model, state, params)
        return energy, softmpm.torch_state(model, softmpm.warp_state(model, state)).x

    found, want = torch.compile(work, backend="eager")(state), work(state)
    torch.testing.assert_close(found, want, rtol=1e-12, atol=0)


@pytest.mark.parametrize("formulation", ["moving", "reference"])
def test_a_loss_keeps_no_states_after_its_gradient(formulation, device):
    """Whoever keeps losses for a curve would keep those of all iterations; with retain_graph they are needed again."""
    model = built(formulation=formulation, device=device)
    young = torch.full((), 50.0, dtype=torch.float64, device=device, requires_grad=True)
    params = model.params()._replace(young=young)

    def loss() -> torch.Tensor:
        return softmpm.simulate(model, model.rest(), None, params, substeps=50).x.sum()

    def trails() -> int:
        gc.collect()
        kind = softmpm.rollout.Trail
        return sum(isinstance(one, kind) for one in gc.get_objects())

    before, losses = trails(), []
    for _ in range(3):
        losses.append(loss())
        losses[-1].backward()
    assert trails() == before
    again = loss()
    first, second = (torch.autograd.grad(again, young, retain_graph=keep)[0] for keep in (True, False))
    torch.testing.assert_close(first, second, rtol=1e-10, atol=0)  # sums are in any order on a GPU
    assert trails() == before
    with pytest.raises(RuntimeError, match="second time"):
        again.backward()


@pytest.mark.parametrize(
    "start, params, says",
    [
        (3, None, "state"),
        (None, {"young": 1}, "params"),
    ],
)
def test_wrong_types_are_named_under_autocast(start, params, says):
    """As without it."""
    model = built(dtype=torch.float32)
    given = model.rest() if start is None else start, None, model.params() if params is None else params
    messages = []
    for enabled in (False, True):
        with (
            torch.autocast("cpu", dtype=torch.bfloat16, enabled=enabled),
            pytest.raises(TypeError, match=says) as error,
        ):
            softmpm.simulate(model, *given, substeps=1)
        messages.append(str(error.value))
    assert messages[0] == messages[1]


def test_an_empty_input_is_named():
    """In place of an error of PyTorch's reductions."""
    model = built(inputs=["force"])
    inputs = softmpm.Inputs(force=torch.zeros(0, 1, model.particle_count, 2, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"inputs\.force is empty, got shape \(0, 1, .*\); leave it out"):
        softmpm.simulate(model, model.rest(), None, model.params(), substeps=1, inputs=inputs)
