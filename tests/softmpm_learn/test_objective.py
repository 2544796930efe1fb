import numpy as np
import torch

from softmpm import State
from softmpm_learn.objective import Effort, Height, Progress, Reach

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
    got = Progress(terms=(Effort(2.0), Height(3.0, lowest))).running(state, activation)
    torch.testing.assert_close(got, 2 * torch.tensor([0.25, 0.5]) + 3 * (lowest - height) ** 2)
    torch.testing.assert_close(
        Progress(terms=(Height(3.0, -9.0),)).running(state, activation), torch.zeros(2)
    )
    torch.testing.assert_close(Progress().running(state, activation), torch.zeros(2))
