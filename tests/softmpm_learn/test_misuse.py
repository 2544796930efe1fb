"""What users do around and within the learner: modes of PyTorch, models of other scenes, terms and observers with side effects."""

import contextlib
import dataclasses
import threading
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from learners import changed, rows_of
from torch import nn

import softmpm
from softmpm_learn import register, train
from softmpm_learn.episode import need_model_of, run_episode
from softmpm_learn.objective import Objective, Reach, Term, Tilt
from softmpm_learn.observe import Centroids, Observer
from softmpm_learn.observer_check import check_observer
from softmpm_learn.seeding import seeded
from softmpm_learn.settings import DesignConf, ObserverConf, PolicyConf

PLAIN = ObserverConf(name="centroids")


@pytest.mark.parametrize(
    "mode",
    [
        lambda: torch.autocast("cpu", dtype=torch.bfloat16),
        torch.no_grad,
        torch.inference_mode,
        lambda: torch.device("meta"),
    ],
    ids=["autocast", "no_grad", "inference_mode", "device"],
)
def test_modes_of_the_caller_are_not_those_of_a_run(task, model, settings, tmp_path, mode):
    """The same rows as without: autocast would keep copies of weights that have changed, and the others have no gradient."""
    short = dataclasses.replace(changed(settings, train=dict(iterations=3)), observer=PLAIN)
    train.train(task, model, short, tmp_path / "plain")
    with mode():
        train.train(task, model, short, tmp_path / "within")
    assert rows_of(tmp_path / "within") == rows_of(tmp_path / "plain")


def test_weights_follow_from_the_seed_in_threads():
    """PyTorch has one stream of random numbers for all threads: two that draw at once would draw from each other's seeds."""
    with seeded(0):
        want = torch.randn(4)
    found, inside = [], threading.Barrier(2, timeout=30)

    def draw():
        with contextlib.suppress(threading.BrokenBarrierError):
            inside.wait()
        with seeded(0):
            found.append(torch.randn(4))

    threads = [threading.Thread(target=draw) for _ in range(2)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert all(torch.equal(one, want) for one in found)


def test_only_one_thread_draws_at_a_time():
    """The second waits until the first has left."""
    entered, order = threading.Event(), []

    def second():
        with seeded(1):
            order.append("second")

    with seeded(0):
        thread = threading.Thread(target=lambda: (entered.set(), second()))
        thread.start()
        entered.wait()
        thread.join(timeout=0.2)
        order.append("first")
    thread.join()
    assert order == ["first", "second"]


def test_a_model_of_another_scene_is_refused(task, model, settings, tmp_path):
    """Everything in a scene was read when the model was built; an equal scene is not another one."""
    heavy = dataclasses.replace(task, scene=dataclasses.replace(task.scene, gravity=(0.0, -9.0)))
    observer = Centroids(model, list(task.regions.values()), task.body_length)
    act = lambda z, time, goal: torch.zeros(1, 2)  # noqa: E731
    with pytest.raises(
        ValueError, match="built from another scene than that of task block; build it from this one"
    ):
        run_episode(heavy, model, observer, act, model.params())
    with pytest.raises(ValueError, match="built from another scene"):
        train.train(heavy, model, dataclasses.replace(settings, observer=PLAIN), tmp_path)
    equal = dataclasses.replace(task, scene=dataclasses.replace(task.scene))
    assert equal.scene is not task.scene
    need_model_of(equal, model)


def test_a_model_with_other_contact_than_the_task_is_refused(task, model):
    """Such as where task.build was forgotten."""
    other = dataclasses.replace(
        task, build={"formulation": "moving", "contact": "surface", "contact_width": 0.01}
    )
    with pytest.raises(
        ValueError, match=r"has contact='surface', but the model has 'nodes'; build it with .*\*\*task.build"
    ):
        need_model_of(other, model)


@dataclass(frozen=True, kw_only=True)
class Spread(Term):
    """Works in place on what all terms read."""

    of: str = "x"

    def value(self, path):
        x = getattr(path, self.of)[self.window(path)]
        x -= x.mean(dim=2, keepdim=True)
        return x[..., 0].square().mean(dim=(0, 2))


@pytest.mark.parametrize("of", ["x", "v"])
def test_a_term_that_works_in_place_is_refused(task, model, of):
    """The other terms would see what it left."""
    reach = Reach(particles=np.arange(3), target=np.zeros(2))
    spoilt = dataclasses.replace(task, objective=Objective(Spread(of=of), reach))
    observer = Centroids(model, list(task.regions.values()), task.body_length)
    with pytest.raises(ValueError, match="term spread changed the motion in place.*write x = x - y"):
        run_episode(spoilt, model, observer, lambda z, time, goal: torch.zeros(1, 2), model.params())


class Seen(Observer):
    """A mean velocity, seen in different ways."""

    size = 2

    def __init__(self, way: str):
        super().__init__()
        self.way, self.last = way, torch.zeros(1, 2)

    def observe(self, model, state):
        v = state.v
        if self.way == "in place":
            v *= 0.5
        now = v.mean(dim=1)
        if self.way == "memory":
            now, self.last = now - self.last, now
        if self.way == "noise":
            now = now + 0.1 * torch.randn_like(now)
        return now

    def encode(self, observation):
        return observation[:, : 1 if self.way == "size" else 2]


@pytest.mark.parametrize(
    "way, says",
    [
        ("in place", "the observer Seen changed the state in place"),
        ("memory", "the observer Seen must be a function of the state alone.*its memory would pass.*state.v"),
        ("size", r"features of shape \(world, size\) = \(1, 2\), got \(1, 1\)"),
    ],
)
def test_an_observer_with_side_effects_is_refused(task, model, settings, tmp_path, monkeypatch, way, says):
    """Before a run begins; the state is that of the simulation, and memory would pass from an episode to the next."""
    monkeypatch.setattr(register.OBSERVERS, "_entries", dict(register.OBSERVERS._entries))
    register.observer("seen")(lambda conf, model, task: Seen(way))
    with pytest.raises(ValueError, match=says):
        train.train(task, model, dataclasses.replace(settings, observer=ObserverConf(name="seen")), tmp_path)


def test_a_noisy_sensor_is_no_memory(model):
    """Noise of PyTorch's generator is allowed, and asking takes nothing from it."""
    torch.manual_seed(3)
    want = torch.randn(2)
    torch.manual_seed(3)
    check_observer(Seen("noise"), model)
    assert torch.equal(torch.randn(2), want)


def test_an_observer_that_works_in_place_is_refused_in_an_episode(task, model):
    """It would slow the robot down."""
    with pytest.raises(ValueError, match="Seen changed the state in place"):
        run_episode(task, model, Seen("in place"), lambda z, time, goal: torch.zeros(1, 2), model.params())


@pytest.mark.parametrize(
    "region, says",
    [
        (
            np.arange(32) < 12,
            "task region left must be a list of particle indices, .*got an array of bool.*np.flatnonzero",
        ),
        (np.arange(0), "not empty"),
        (np.array([1, 1]), "task region left names a particle twice"),
    ],
)
def test_regions_are_indices(task, region, says):
    """A mask would count all particles, and the features would tell where the robot is."""
    with pytest.raises(ValueError, match=says):
        dataclasses.replace(task, regions={"left": region})


def test_parts_of_a_tilt_are_indices(task):
    """As regions are."""
    mask = np.arange(32) < 12
    with pytest.raises(ValueError, match=r"Tilt.front must be a list of particle indices"):
        Tilt(front=mask, back=np.flatnonzero(~mask), rest=task.scene.bodies[0].particles.positions)


@pytest.mark.parametrize("length", [0.0, float("nan"), float("inf")])
def test_the_length_of_a_body_is_positive(task, length):
    """Observations are in units of it."""
    with pytest.raises(ValueError, match="task body_length must be > 0 m"):
        dataclasses.replace(task, body_length=length)


class Half(nn.Module):
    """A policy of which one layer is frozen, and one is not used."""

    def __init__(self, space):
        super().__init__()
        self.trunk, self.head = nn.Linear(space.features, 3), nn.Linear(3, space.muscles)
        self.unused = nn.Linear(2, 2)
        self.trunk.requires_grad_(False)

    def forward(self, z, time, goal=None):
        return torch.tanh(self.head(self.trunk(z)))


class Idle(nn.Module):
    """A policy without parameters."""

    def __init__(self, space):
        super().__init__()
        self.muscles = space.muscles

    def forward(self, z, time, goal=None):
        return 0.3 + 0.0 * z[..., : self.muscles]


@pytest.fixture
def policies(monkeypatch):
    """Both by name."""
    monkeypatch.setattr(register.POLICIES, "_entries", dict(register.POLICIES._entries))
    for name, kind in (("half", Half), ("idle", Idle)):
        register.policy(name)(lambda conf, space, kind=kind: kind(space))


@pytest.mark.usefixtures("policies")
@pytest.mark.parametrize("runs", [1, 2])
def test_frozen_and_unused_weights_stay(task, settings, tmp_path, runs):
    """Of a pretrained trunk; the head learns, of one run and of runs side by side."""
    model = softmpm.build(task.scene, device="cpu", worlds=runs)
    own = dataclasses.replace(settings, observer=PLAIN, policy=PolicyConf(name="half"))
    plans = [
        train.Plan(settings=changed(own, train=dict(iterations=2, seed=k)), out=tmp_path / str(k))
        for k in range(runs)
    ]
    for result in train.train_side_by_side(task, model, plans):
        assert result.error is None
        policy, first = result.run.policy, result.run._make_policy("policy")
        same = {name: torch.equal(p, first.state_dict()[name]) for name, p in policy.state_dict().items()}
        assert same == {
            **dict.fromkeys(["trunk.weight", "trunk.bias", "unused.weight", "unused.bias"], True),
            **dict.fromkeys(["head.weight", "head.bias"], False),
        }


@pytest.mark.usefixtures("policies")
def test_a_body_learns_without_a_policy_that_does(task, model, settings, tmp_path):
    """A policy without parameters: the design alone is optimised."""
    own = dataclasses.replace(
        settings, observer=PLAIN, policy=PolicyConf(name="idle"), design=DesignConf(enabled=True)
    )
    run = train.train(task, model, changed(own, train=dict(iterations=2)), tmp_path).run
    assert max(float(change) for change in run.design.change().values()) > 0


@pytest.mark.usefixtures("policies")
def test_a_loss_without_gradient_is_named(task, model, settings, tmp_path):
    """Nothing could be learned from it."""

    @dataclass(frozen=True, kw_only=True)
    class Counted(Term):
        def value(self, path):
            return torch.from_numpy(path.x.detach().numpy()[-1, :, :, 0].mean(axis=1))

    blind = dataclasses.replace(task, objective=Objective(Counted()))
    with pytest.raises(ValueError, match=r"the objective has no gradient .* operations of PyTorch"):
        train.train(blind, model, dataclasses.replace(settings, observer=PLAIN), tmp_path)
