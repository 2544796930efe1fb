"""Terms of objectives: values by hand, windows, names, and one that a user writes."""

import dataclasses
import math
import re
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

import softmpm
from softmpm import State
from softmpm_learn.objective import (
    AtMost,
    Effort,
    Low,
    Objective,
    Path,
    Progress,
    Reach,
    Still,
    Stretch,
    Term,
    Tilt,
)
from softmpm_learn.tasks import ArmConf, BipedConf, make_task


@pytest.fixture
def path() -> Path:
    """Five states, 0.5 s apart, of two worlds of five particles, at random."""
    random = torch.Generator().manual_seed(0)

    def state() -> State:
        x, v = torch.rand(2, 2, 5, 2, generator=random)
        return State(x, v, torch.zeros(2, 5, 2, 2), torch.zeros(2, 5, 2, 2))

    times = [0.0, 0.5, 1.0, 1.5, 2.0]
    return Path(times, [state() for _ in times], torch.rand(4, 2, 3, generator=random))


def test_progress_is_minus_the_way_of_the_mean_position(path):
    """From the first state of the window to its last one, of the particles and along the axis that are named."""
    x = path.x
    torch.testing.assert_close(Progress().value(path), (x[0] - x[4])[..., 0].mean(dim=1))
    some = Progress(axis=1, particles=np.array([1, 3]), begin=0.5, end=1.5)
    torch.testing.assert_close(some.value(path), (x[1] - x[3])[:, [1, 3], 1].mean(dim=1))


def test_reach_is_the_mean_squared_distance_in_the_window(path):
    """From the target or, where an episode has one, from its own goal; at the end alone if the window begins there."""
    centre = path.x[:, :, [0, 2]].mean(dim=2)
    reach = Reach(particles=np.array([0, 2]), target=np.array([0.3, 0.4]), begin=1.0)
    away = (centre[2:] - torch.tensor([0.3, 0.4])).square().sum(dim=-1)
    torch.testing.assert_close(reach.value(path), away.mean(dim=0))
    last = Reach(particles=np.array([0, 2]), target=np.zeros(2), begin=2.0)
    there = Path(path.times, path.states, path.activation, goal=centre[4] + torch.tensor([0.3, 0.4]))
    torch.testing.assert_close(last.value(there), torch.full((2,), 0.25))


@pytest.mark.parametrize("term", [Progress, Reach, Still, Effort, Low, Tilt, Stretch, AtMost, Term])
def test_values_are_documented_with_their_shape(term):
    """Of every term, and of the motion that it sees, for those who write their own."""
    assert "shape (world,)" in str(vars(term)["value"].__doc__)
    text = " ".join(str(Path.__doc__).split())
    assert "x: Positions [m], shape (state, world, particle, dim)" in text and "self.window(path)" in text


def test_still_is_the_mean_squared_speed_of_the_mean(path):
    """Particles that move against each other are still."""
    still = Still(particles=np.array([1, 4]), begin=1.5)
    want = path.v[3:, :, [1, 4]].mean(dim=2).square().sum(dim=-1).mean(dim=0)
    torch.testing.assert_close(still.value(path), want)


def test_stretch_is_what_is_beyond_the_limit():
    """By hand: four particles in a row whose pairs, 0.5, 0.25 and 1 m long at rest, are 1, 1.5 and 2 times as long, in any direction;
    what is shorter than the limit costs nothing, and a pair that is not named does not count."""
    rest = np.array([(0.0, 0.0), (0.5, 0.0), (0.5, 0.25), (0.5, 1.25)])
    turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]])
    moved = torch.tensor([(0.0, 0.0), (0.5, 0.0), (0.5, 0.375), (0.5, 2.375)]) @ turn.T + 3.0
    nothing = torch.zeros(1, 4, 2, 2)
    states = [
        State(x[None].float(), nothing[..., 0], nothing, nothing) for x in (torch.from_numpy(rest), moved)
    ]
    path = Path([0.0, 0.5], states, torch.zeros(1, 1, 1))
    pairs = np.array([(0, 1), (2, 1), (2, 3)])
    one = Stretch(pairs=pairs, rest=rest, most=1.2)
    torch.testing.assert_close(one.value(path), torch.tensor([(0.3**2 + 0.8**2) / 6]))
    late = Stretch(pairs=pairs[:2], rest=rest, most=1.2, begin=0.5)
    torch.testing.assert_close(late.value(path), torch.tensor([0.3**2 / 2]))


@pytest.mark.parametrize("conf", [BipedConf(), ArmConf()], ids=lambda conf: conf.name)
def test_a_crack_costs_what_strains_do_not(conf):
    """A robot torn in two rigid halves, which have no strain, pays for each pair across the crack; it costs nothing at rest, and a
    stretch by half costs nothing either. Without pairs there is nothing to pay for."""
    task = make_task(conf)
    (stretch,) = (term for term in task.objective.terms if isinstance(term, Stretch))
    rest = softmpm.build(task.scene, device="cpu").rest()
    right = rest.x[..., :1] > rest.x[..., :1].mean()
    torn = rest._replace(x=rest.x + torch.tensor([0.1, 0.0]) * right)
    longer = rest._replace(x=rest.x * 1.5)
    losses = [
        stretch.value(Path([0.0], [state], torch.zeros(1, 1, 1))).item() for state in (rest, longer, torn)
    ]
    across = right[0, stretch.pairs, 0]
    count = int((across[:, 0] != across[:, 1]).sum())
    spacing = task.scene.grid.spacing / 2
    assert losses[:2] == [0, 0] and count > 10
    assert losses[2] == pytest.approx(count * (0.1 / spacing + 1 - 1.6) ** 2 / len(across), rel=1e-3)
    with pytest.raises(ValueError, match="needs pairs of particles, got none: leave the term out"):
        Stretch(pairs=np.zeros((0, 2), dtype=int), rest=stretch.rest, most=1.6)


def test_effort_counts_the_control_steps_of_the_window(path):
    """Those that begin and end in it."""
    torch.testing.assert_close(Effort().value(path), path.activation.square().mean(dim=(0, 2)))
    late = Effort(begin=1.0, end=2.0)
    torch.testing.assert_close(late.value(path), path.activation[2:].square().mean(dim=(0, 2)))


def test_low_and_tilt(path):
    """The squared gap below the lowest height, and the squared change of slope from back to front, in the mean of the window."""
    height = path.x[..., 1].mean(dim=2)
    lowest = float(height.median())
    gap = (lowest - height).clamp(min=0).square().mean(dim=0)
    torch.testing.assert_close(Low(lowest=lowest).value(path), gap)
    assert gap.max() > 0
    front, back, rest = np.array([0, 3]), np.array([1, 2, 4]), path.x[0, 0].double().numpy()
    apart = rest[front].mean(axis=0) - rest[back].mean(axis=0)
    y = path.x[2:, ..., 1].double().numpy()
    rise = y[..., front].mean(axis=-1) - y[..., back].mean(axis=-1)
    tilt = Tilt(front=front, back=back, rest=rest, begin=1.0)
    want = torch.from_numpy(((rise - apart[1]) / apart[0]) ** 2).float().mean(dim=0)
    torch.testing.assert_close(tilt.value(path), want)
    at_rest = Tilt(front=front, back=back, rest=rest, end=0.0)
    torch.testing.assert_close(at_rest.value(path)[0], torch.tensor(0.0))


def test_a_robot_tilts_by_the_angle_that_it_has_turned_by():
    """In 2D by a pitch, upside down too, in 3D by a pitch or a roll, whichever axis is up; turning about the vertical is no tilt."""
    sides = np.linspace(3.0, 4.0, 6), np.linspace(1.0, 1.2, 3), np.linspace(2.0, 2.4, 4)
    rest = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 3)

    def seen(rest, turn, **axes):
        x = torch.from_numpy(rest @ turn.T).float()[None, None]
        parts = dict(front=np.flatnonzero(rest[:, 0] > 3.7), back=np.flatnonzero(rest[:, 0] < 3.3))
        tilt = Tilt(**parts, rest=rest, **axes)
        nothing = torch.zeros(0, 1, 1)
        path = Path(np.zeros(1), [softmpm.State(x[0], x[0], x[0], x[0])], nothing)
        return tilt.degrees(path), float(tilt.value(path))

    def about(axis, angle):
        turned, (i, j) = np.eye(3), [k for k in range(3) if k != axis]
        turned[[i, j], [i, j]], turned[i, j] = math.cos(angle), -math.sin(angle)
        turned[j, i] = math.sin(angle)
        return turned

    for angle in (-3.0, -0.6, 0.2, 2.5):
        want = pytest.approx(abs(math.degrees(angle)), abs=1e-3)
        assert seen(rest[:, :2], about(2, angle)[:2, :2])[0] == want
        assert seen(rest, about(2, angle))[0] == want and seen(rest, about(0, angle))[0] == want
        assert seen(rest, about(1, angle)) == pytest.approx((0.0, 0.0), abs=1e-3)
        assert seen(rest, about(0, angle))[1] == pytest.approx(math.sin(angle) ** 2, rel=1e-3)
        assert seen(rest[:, [0, 2, 1]], about(1, angle), up=2)[0] == want
    two = np.array([(3.0, 1.0), (4.0, 1.3)])
    assert seen(two, np.eye(2))[0] == pytest.approx(0.0, abs=1e-3)
    assert seen(two, about(2, 0.5)[:2, :2])[0] == pytest.approx(math.degrees(0.5), abs=1e-3)
    for thin in (
        rest * [1.0, 1.0, 0.0],
        rest[:, [0, 1, 0]],
        rest[:, [0, 0, 2]],
    ):  # no width, or a plane that is not level
        with pytest.raises(ValueError, match="extent along each horizontal axis"):
            seen(thin, np.eye(3))


def test_a_constraint_costs_what_is_beyond_it(path):
    """The square of the excess; nothing, and no gradient, within the limit."""
    effort = Effort(weight=7.0).value(path)
    most = float(effort.mean())
    constraint = AtMost(term=Effort(weight=7.0), most=most, weight=3.0)
    (got,) = Objective(constraint)(path).values()
    torch.testing.assert_close(got, 3.0 * (effort - most).clamp(min=0.0).square())
    assert (got > 0).sum() == 1 and constraint.name == "effort_beyond"


def test_an_objective_is_the_sum_of_its_terms(path):
    """Weighted and by name; a second term of a name has a number."""
    objective = Objective(Progress(), Effort(weight=2.0), Progress(axis=1, weight=0.5))
    parts = objective(path)
    assert list(parts) == objective.names == ["progress", "effort", "progress_2"]
    torch.testing.assert_close(parts["effort"], 2.0 * Effort().value(path))
    torch.testing.assert_close(parts["progress_2"], 0.5 * Progress(axis=1).value(path))


def test_what_is_no_objective():
    """Without terms, with a list or a class in place of terms, or with a weight that is no number: refused when it is made."""
    with pytest.raises(ValueError, match=r"an objective needs a term, such as Objective\(Progress\(\)\)"):
        Objective()
    for terms, got in ((([Effort()],), "list"), ((Progress(), Effort), "the class Effort")):
        with pytest.raises(TypeError, match=rf"terms one by one, .*, got {got}\."):
            Objective(*terms)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="weight of the objective's term effort must be finite, got nan"):
        Objective(Progress(), Effort(weight=math.nan))


def test_a_term_of_a_user(path):
    """A frozen dataclass with a value."""

    @dataclass(frozen=True, kw_only=True)
    class Spread(Term):
        def value(self, path: Path) -> Tensor:
            return path.x[self.window(path)].var(dim=2).sum(dim=-1).mean(dim=0)

    (got,) = Objective(Spread(weight=2.0, begin=1.5))(path).values()
    torch.testing.assert_close(got, 2.0 * path.x[3:].var(dim=2).sum(dim=-1).mean(dim=0))


@pytest.mark.parametrize("axes, got", [((0, 1, 2, 3), "()"), ((2, 3), "(5, 2)"), ((0, 2), "(2, 2)")])
def test_a_value_that_is_not_one_number_for_each_world(path, axes, got):
    """It would be broadcast, so that each world counts what others do; also where it is the term of a constraint."""

    @dataclass(frozen=True, kw_only=True)
    class Broad(Term):
        def value(self, path: Path) -> Tensor:
            return path.x[self.window(path)].mean(dim=axes)

    for term in (Broad(), AtMost(term=Broad(), most=0.0)):
        rule = rf"term {term.name} must be a tensor of shape \(world,\) = \(2,\).* got {re.escape(got)};"
        with pytest.raises(ValueError, match=rule):
            Objective(Effort(), term)(path)


def test_a_value_of_ones_own_declares_how_it_adds_up():
    """A term that declares nothing does not add up, even if the term that it is made from does; a wrong word is refused."""

    @dataclass(frozen=True, kw_only=True)
    class Nearest(Reach):
        def value(self, path: Path) -> Tensor:
            return self._away(path).norm(dim=-1).amin(dim=0)

    @dataclass(frozen=True, kw_only=True)
    class Named(Reach):
        """A reach by another name."""

    assert Nearest.adds_up is None and AtMost.adds_up is None and Named.adds_up == Reach.adds_up == "states"
    with pytest.raises(
        ValueError, match="adds_up of Wrong must be one of states, steps, way or None, got 'state'"
    ):

        class Wrong(Term):
            adds_up = "state"


def test_the_window_of_a_part_of_an_episode_is_that_of_the_whole(path):
    """Where a window begins at a rounded time too."""
    part = Path(path.times[:2], path.states[:2], path.activation[:1])
    for begin, want in ((0.5, 1), (0.5000004, 1), (0.5002, 1), (0.4, 1), (0.0, 0)):
        late = Effort(begin=begin)
        assert late.window(path).start == late.window(part).start == want


def test_a_window_without_states_is_refused(path):
    """The message has the window and the end of the episode."""
    with pytest.raises(ValueError, match="window from 2.5 to inf s without a state; the episode ends at 2 s"):
        Effort(begin=2.5).value(path)


@pytest.mark.parametrize(("begin", "end"), [(1.0, 0.5), (math.nan, 1.0), (0.0, math.nan)])
def test_a_window_that_ends_before_it_begins_is_refused(begin, end):
    """When the objective is made; one that ends where it begins has a state."""
    with pytest.raises(
        ValueError, match=f"effort must not end before it begins, got begin={begin:g} and end={end:g}"
    ):
        Objective(Progress(), Effort(begin=begin, end=end))
    Objective(Effort(begin=0.5, end=0.5))


def test_a_window_outside_of_the_episode_is_refused_when_the_task_is_made(task):
    """An episode of 0.096 s: a run would begin with a simulation, to no avail."""
    for window in ({"begin": 0.2}, {"begin": -0.2, "end": -0.1}):
        with pytest.raises(ValueError, match="without a state; the episode ends at 0.096 s"):
            dataclasses.replace(task, objective=Objective(Progress(), Effort(**window)))
    dataclasses.replace(task, objective=Objective(Effort(begin=0.096)))


def test_outcomes_in_words():
    """Of the first term that has one."""
    x = np.zeros((2, 3, 2))
    x[1, :, 0] = 0.6
    reach = Reach(particles=np.array([0]), target=np.array([0.6, 0.004]))
    assert Objective(Effort(), Progress()).outcome(x, 0.3) == "it travelled 0.600 m, 2.00 of its length"
    assert Objective(reach).outcome(x, math.nan) == "it ended 4 mm from the goal"
    assert Objective(Effort()).outcome(x, 0.3) == ""
