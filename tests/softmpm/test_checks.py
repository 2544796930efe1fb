"""Every rule of the tensors that meet a model, and what its message says."""

import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from softmpm.check_state import check_finite, check_state
from softmpm.checks import check_activation, check_bounds, check_params, check_whole
from softmpm.state import Low, Nodal, Params, State, SurfaceState

MODEL = SimpleNamespace(
    dim=2, worlds=2, particle_count=3, muscle_count=4, dtype=torch.float32, device=torch.device("cpu")
)
ONE = torch.tensor(1.0)


def state(**changes) -> State:
    lead = (2, 3)
    eye = torch.eye(2).expand(*lead, 2, 2).clone()
    return State(torch.ones(*lead, 2), torch.zeros(*lead, 2), torch.zeros(*lead, 2, 2), eye)._replace(
        **changes
    )


def params(**changes) -> Params:
    return Params(torch.full((3,), 10.0), torch.full((2, 1), 0.3), torch.ones(()))._replace(**changes)


def test_good_tensors_pass():
    """Everything of the model's shape, precision and device passes, and all broadcasts of a material."""
    check_state(MODEL, state())
    check_activation(MODEL, None)
    for control_steps in (1, 5):
        check_activation(MODEL, torch.zeros(control_steps, 2, 4))
    for shape in [(), (1,), (3,), (1, 3), (2, 1), (2, 3), (1, 1)]:
        check_params(MODEL, params(young=torch.ones(shape)))
    check_whole("substeps", 1)
    check_whole("substeps", np.int64(20))
    check_bounds(params(), torch.ones(2, 3), ONE)
    check_finite(state(), torch.zeros(1, 2, 4))
    check_finite(state(), None)
    check_state(MODEL, state(low=Low(state().v, state().C)))


@pytest.mark.parametrize("name", ["x", "v", "C", "F"])
def test_state_shape(name):
    """Each field's message says the shape that it must have and the one that came."""
    good = getattr(state(), name)
    want = re.escape(f"state.{name} must have shape {tuple(good.shape)}")
    for bad in (good[0], good[:1], good[:, :2], good[..., :1]):
        with pytest.raises(ValueError, match=want + ".*" + re.escape(f"got {tuple(bad.shape)}")):
            check_state(MODEL, state(**{name: bad}))


def test_low_order_parts():
    """The kernels read them as they read x and F: another shape or precision is refused."""
    good = Low(state().v, state().C)
    for bad in (good._replace(x=good.x[:1]), good._replace(F=good.F[..., :1])):
        with pytest.raises(ValueError, match=r"state.low.(x|F) must have shape"):
            check_state(MODEL, state(low=bad))
    with pytest.raises(ValueError, match=r"state.low.F must be torch.float32"):
        check_state(MODEL, state(low=good._replace(F=good.F.double())))
    exact = SimpleNamespace(**(vars(MODEL) | dict(dtype=torch.float64)))
    twice = State(*(part.double() for part in state()[:4]), low=Low(*(part.double() for part in good)))
    with pytest.raises(
        ValueError, match=r"state.low must be None in torch.float64.*take state.to\(torch.float64\)"
    ):
        check_state(exact, twice)
    check_state(exact, twice.to(torch.float64))


def test_activation_shape():
    """Rows, worlds and muscles are told apart; no row at all is refused."""
    for shape, remedy in {
        (2, 4): "one control step is activation[None]",
        (4,): "one control step of all worlds is activation.expand(1, 2, -1)",
        (5, 4): "one world is activation[:, None].expand(-1, 2, -1), the same in each",
        (5, 1, 4): "the same in each world is activation.expand(-1, 2, -1)",
        (5, 2, 3): "a number for each of the scene's 4 muscles and pressures",
        (5, 4, 2): "the axes are control steps, 2 worlds and 4 muscles, in this order",
        (): "the axes are control steps",
        (1, 5, 2, 4): "the axes are control steps",
    }.items():
        with pytest.raises(ValueError, match=rf"\(any, 2, 4\), got .*{re.escape(remedy)}"):
            check_activation(MODEL, torch.zeros(shape))
    with pytest.raises(ValueError, match="at least one control step"):
        check_activation(MODEL, torch.zeros(0, 2, 4))
    with pytest.raises(ValueError, match=r"\(any, 1, 4\), got \(5, 4\); one world is activation\[:, None\]"):
        check_activation(SimpleNamespace(**vars(MODEL) | {"worlds": 1}), torch.zeros(5, 4))


@pytest.mark.parametrize("shape", [(2,), (3, 2), (3, 1), (1, 2, 3), (4,), (0,)])
def test_params_shape(shape):
    """A material that does not broadcast to (world, particle) is refused; it says how to give one a world."""
    with pytest.raises(ValueError, match=r"params.poisson must broadcast to .* \(2, 3\).*\(world, 1\)"):
        check_params(MODEL, params(poisson=torch.ones(shape)))


CHECKS = {
    "state.C": lambda change: check_state(MODEL, state(C=change(state().C))),
    "activation": lambda change: check_activation(MODEL, change(torch.zeros(1, 2, 4))),
    "params.density": lambda change: check_params(MODEL, params(density=change(params().density))),
}


@pytest.mark.parametrize("name", CHECKS)
def test_kind_precision_and_device(name):
    """A tensor of another precision or device, or no tensor, is refused by its name with the cure."""
    with pytest.raises(
        ValueError, match=f"{name} must be torch.float32 like the model, got torch.float64; use .to"
    ):
        CHECKS[name](lambda tensor: tensor.double())
    with pytest.raises(ValueError, match=f"{name} must be on cpu like the model, got meta; use .to"):
        CHECKS[name](lambda tensor: tensor.to("meta"))
    with pytest.raises(TypeError, match=f"{name} must be a torch.Tensor, got ndarray"):
        CHECKS[name](lambda tensor: tensor.numpy())


def test_wrong_records():
    """An argument that is not a State or Params is named."""
    with pytest.raises(TypeError, match="state must be a softmpm.State, got Params"):
        check_state(MODEL, params())
    with pytest.raises(TypeError, match="params must be a softmpm.Params, got State"):
        check_params(MODEL, state())


@pytest.mark.parametrize("substeps", [0, -1, 2.0, True, None, "3"])
def test_substeps(substeps):
    """Substeps are a whole number of at least one."""
    with pytest.raises(ValueError, match="substeps must be a whole number of at least 1, got"):
        check_whole("substeps", substeps)


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", ["x", "v", "C", "F", "activation", "young", "poisson", "density"])
def test_not_finite(name, bad):
    """One bad number anywhere is found and named by its index."""
    start, activation, material = state(), torch.zeros(1, 2, 4), Params(*(p.clone() for p in params()))
    tensor = (start._asdict() | {"activation": activation} | material._asdict())[name]
    tensor.view(-1)[-1] = bad
    index = ", ".join(str(n - 1) for n in tensor.shape)
    check = partial(check_bounds, material, torch.ones(2, 3), ONE)
    if name not in Params._fields:
        check = partial(check_finite, start, activation)
    with pytest.raises(
        ValueError, match=re.escape(f"{name}[{index}] is {bad:g}" if index else f"{name} is {bad:g}")
    ):
        check()


@pytest.mark.parametrize(
    "name", ["low.x", "low.F", "nodes.u", "nodes.anchor", "nodes.shift", "surface.anchor"]
)
def test_other_parts_of_a_state_that_are_not_finite(name):
    """Everything that a call reads, and no force, which it does not."""
    d, few = torch.zeros(2, 3, 2), torch.zeros(2, 1, 3, 2)
    start = state(
        low=Low(d.clone(), torch.zeros(2, 3, 2, 2)),
        nodes=Nodal(d.clone(), d.clone(), few.clone(), few + torch.nan, torch.zeros(2, 2).double()),
        surface=SurfaceState(few.clone(), few + torch.nan),
    )
    check_finite(start, None)
    part, field = name.split(".")
    tensor = getattr(getattr(start, part), field)
    tensor.view(-1)[-1] = torch.nan
    index = ", ".join(str(n - 1) for n in tensor.shape)
    with pytest.raises(
        ValueError, match=re.escape(f"state.{name} must be finite, but state.{name}[{index}]")
    ):
        check_finite(start, None)


@pytest.mark.parametrize(
    "name, bad", [("young", 0.0), ("density", -1.0), ("poisson", 0.5), ("poisson", -1.0)]
)
def test_impossible_materials(name, bad):
    """A material outside its bounds is refused, also where it requires gradients."""
    tensors = params(**{name: torch.tensor([0.3, 0.3, bad], requires_grad=True)})
    with pytest.raises(ValueError, match=rf"params.{name} must be .*{name}\[2\] is {bad:g}"):
        check_bounds(tensors, torch.ones(2, 3), ONE)


@pytest.mark.parametrize("mass, index", [(1e-39, "[1, 2]"), (0.0, "[1, 2]"), (torch.inf, "[1, 2]")])
def test_a_mass_that_its_precision_cannot_hold(mass, index):
    """Legal density times legal volume may vanish or overflow: named with the particle."""
    masses = torch.ones(2, 3)
    masses[1, 2] = mass
    with pytest.raises(
        ValueError, match=r"mass = .* in \[1.18e-38, 3.4e\+38\] kg .*torch.float32.*" + re.escape(index)
    ):
        check_bounds(params(), masses, ONE)


@pytest.mark.parametrize("mass, unit", [(1e-30, 1e10), (1e30, 1e-10)])
def test_a_mass_that_its_precision_cannot_hold_in_units_of_the_heaviest(mass, unit):
    """Kernels count mass in units of the scene's heaviest particle: what fits in kilograms may not fit there."""
    with pytest.raises(ValueError, match=r"mass = .*to be exact in torch.float32"):
        check_bounds(params(), torch.full((2, 3), mass), torch.tensor(unit))


def test_sparse_tensors():
    """Said in place of an operator that PyTorch has not for them; .to_dense() helps."""
    for call in (
        lambda t: check_activation(MODEL, t(torch.zeros(1, 2, 4))),
        lambda t: check_params(MODEL, params(young=t(torch.ones(2, 3)))),
        lambda t: check_state(MODEL, state(v=t(state().v))),
    ):
        with pytest.raises(
            TypeError, match=r"must be a dense tensor, got torch.sparse_coo; use .to_dense\(\)"
        ):
            call(lambda dense: dense.to_sparse())
        call(lambda dense: dense.to_sparse().to_dense())
