import numpy as np
import torch

from softmpm import State
from softmpm_learn.objective import Effort, Height, Progress, Reach, Upright

GENERATOR = torch.Generator().manual_seed(0)


def states() -> tuple[State, State]:
    start, end = (
        State(x, 0 * x, *(torch.zeros(2, 5, 2, 2) for _ in "CF"))
        for x in torch.rand(2, 2, 5, 2, generator=GENERATOR)
    )
    return start, end


def test_progress_is_minus_the_way_of_the_mean_position():
    """Shifting the end by d along the axis lowers the loss by d, in that world only; other axes do not count."""
    start, end = states()
    moved = end._replace(x=end.x + torch.tensor([[[0.25, 9.0]], [[0.0, 9.0]]]))
    change = Progress().final(start, moved, None) - Progress().final(start, end, None)
    torch.testing.assert_close(change, torch.tensor([-0.25, 0.0]))
    torch.testing.assert_close(Progress().final(start, start, None), torch.zeros(2))


def test_progress_of_some_particles():
    """Only the named particles count."""
    start, end = states()
    want = -(end.x - start.x)[:, [1, 3], 1].mean(dim=1)
    torch.testing.assert_close(Progress(axis=1, particles=np.array([1, 3])).final(start, end, None), want)


def test_reach_is_zero_at_the_place():
    """The loss is the squared distance, to the episode's own goal where it has one."""
    start, end = states()
    centre = end.x[:, [0, 2]].mean(dim=1)
    reach = Reach(particles=np.array([0, 2]), target=centre[0].double().numpy() + [0.3, 0.4])
    torch.testing.assert_close(reach.final(start, end, None)[0], torch.tensor(0.25))
    torch.testing.assert_close(reach.final(start, end, centre), torch.zeros(2))


def test_running_terms_add_up():
    """Effort is the mean squared activation, Height the squared gap below the lowest height; both weighted."""
    _, state = states()
    activation = torch.tensor([[0.5, -0.5], [1.0, 0.0]])
    height = state.x[..., 1].mean(dim=1)
    lowest = height.max().item() + 0.1
    got = Progress(terms=(Effort(2.0), Height(3.0, lowest))).running(state.x, activation)
    torch.testing.assert_close(got, 2 * torch.tensor([0.25, 0.5]) + 3 * (lowest - height) ** 2)
    torch.testing.assert_close(
        Progress(terms=(Height(3.0, -9.0),)).running(state.x, activation), torch.zeros(2)
    )
    torch.testing.assert_close(Progress().running(state.x, activation), torch.zeros(2))


def test_upright_is_the_squared_slope():
    """Of the line from the mean of the back to that of the front, beyond its slope at rest."""
    start, state = states()
    front, back, rest = np.array([0, 3]), np.array([1, 2, 4]), start.x[0].double().numpy()
    apart = rest[front].mean(axis=0) - rest[back].mean(axis=0)
    y = state.x[..., 1].double().numpy()
    rise = y[:, front].mean(axis=1) - y[:, back].mean(axis=1)
    want = 3 * torch.from_numpy(((rise - apart[1]) / apart[0]) ** 2).float()
    upright = Upright(3.0, front, back, rest)
    torch.testing.assert_close(upright(state.x, torch.zeros(2, 1)), want)
    torch.testing.assert_close(upright(start.x, torch.zeros(2, 1))[0], torch.tensor(0.0))


def test_running_costs_of_many_control_steps_are_each_alone():
    """A first axis of control steps gives one."""
    generator = torch.Generator().manual_seed(0)
    x, activation = torch.rand(3, 2, 5, 2, generator=generator), torch.rand(3, 2, 4, generator=generator)
    upright = Upright(1.0, np.array([0]), np.array([4]), x[0, 0].numpy())
    objective = Progress(terms=(Effort(2.0), Height(3.0, 0.5), upright))
    each = torch.stack([objective.running(*step) for step in zip(x, activation, strict=True)])
    torch.testing.assert_close(objective.running(x, activation), each)
