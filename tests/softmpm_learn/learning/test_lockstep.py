"""Epochs on a GPU: captured as a CUDA graph they do what they do without one; memory does not grow."""

import copy

import pytest
import torch
from learners import learn, make_learner, waves

from softmpm_learn.learning.learner import Learner
from softmpm_learn.learning.lockstep import LockStep
from softmpm_learn.learning.phase import learn_together
from softmpm_learn.settings import LearningConf

CONF = LearningConf(epochs=6, batches=4, batch=8, rate=3e-3, patience=3)


def made(folder, count=1, device="cuda", conf=CONF) -> list[Learner]:
    return [
        make_learner(
            folder / str(seed),
            conf,
            {number: waves(16, seed=10 * seed + number) for number in (0, 2, 4)},
            seed=seed,
            device=device,
        )
        for seed in range(count)
    ]


@pytest.fixture
def exact():
    """Convolutions that repeat their bits and do not round their factors."""
    with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
        yield


def assert_alike(one: Learner, two: Learner) -> None:
    """Weights, moments, what the policy sees, and random streams."""
    for network, other in zip(one.networks, two.networks, strict=True):
        for a, b in zip(network.state_dict().values(), other.state_dict().values(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5)
    states = (learner.optimizer.state_dict()["state"] for learner in (one, two))
    for a, b in zip(*(state.values() for state in states), strict=True):
        for name, tensor in a.items():
            torch.testing.assert_close(tensor.cpu(), b[name].cpu(), rtol=1e-5, atol=1e-5)
    for name, stream in one.streams.items():
        assert torch.equal(stream.get_state(), two.streams[name].get_state())


@pytest.mark.gpu
@pytest.mark.parametrize("count", [1, 3])
def test_a_captured_epoch_is_an_epoch(tmp_path, exact, count):
    """Three phases, the second and third of which only replay, give what they give without a graph."""
    captured, eager = made(tmp_path / "captured", count), made(tmp_path / "eager", count)
    for _ in range(3):
        figures = learn_together(captured)
        for ours, theirs in zip(figures, learn_together(eager, capture=False), strict=True):
            assert ours == pytest.approx(theirs, rel=1e-4)
        for one, two in zip(captured, eager, strict=True):
            assert_alike(one, two)


@pytest.mark.gpu
def test_a_graph_outlives_a_change_of_the_learner(tmp_path, exact):
    """A learner that goes back to an earlier state, and another one that begins there, both learn on as it did; a state that was made
    without a graph will do."""
    (subject,), (other,) = made(tmp_path / "subject"), made(tmp_path / "other")
    learn_together([subject], capture=False)
    state = copy.deepcopy(subject.state_dict())
    (want,) = made(tmp_path / "want")
    for learner in (want, subject, other):
        if learner is subject:
            learn(learner)  # captures
        learner.replay.folder = subject.replay.folder
        learner.load_state_dict(copy.deepcopy(state))
    learn_together([want], capture=False)
    for learner in (subject, other):
        learn(learner)
        assert_alike(learner, want)


@pytest.mark.gpu
def test_memory_of_the_device_is_bounded(tmp_path):
    """Simulations and phases beyond the first two that use a full buffer take no more of it."""
    (subject,) = made(tmp_path)
    used = []
    for number in range(5, 25):
        subject.replay.add(number, waves(16))
        learn(subject)
        torch.cuda.synchronize()
        used.append(torch.cuda.memory_allocated())
    assert subject.replay.memory.device.type == "cuda"
    assert subject.replay.memory.nbytes == 8 * 16 * 4 * 2 * 11 * 6
    assert max(used[8:]) <= max(used[:8])


@pytest.mark.gpu
@pytest.mark.filterwarnings("ignore:Synchronization debug mode")  # PyTorch: a prototype
def test_an_epoch_waits_for_no_number(tmp_path):
    """The device's part of an epoch does not synchronise with the host, which a capture would not survive."""
    learners = made(tmp_path, 2)
    learn_together(learners, capture=False)
    try:
        torch.cuda.set_sync_debug_mode("error")
        learners[0].workspace._epoch()
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("count", [1, 3])
def test_held_out_pictures_of_any_number_have_fixed_addresses(tmp_path, monkeypatch, count):
    """What a graph validates on is as long as the buffer, filled up with pictures that do not count."""
    free, fixed = (made(tmp_path / name, count, "cpu") for name in ("free", "fixed"))
    addresses = set()
    for number in (None, 6):
        if number:
            for learner in free + fixed:
                learner.replay.add(number, waves(16, seed=number))
        figures = learn_together(free)
        with monkeypatch.context() as patch:
            patch.setattr(LockStep, "_capturing", True)
            patch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
            for ours, theirs in zip(learn_together(fixed), figures, strict=True):
                assert ours == pytest.approx(theirs, rel=1e-5)
        pictures, terms = fixed[0].workspace._validation
        addresses.add((pictures.data_ptr(), terms["share"].data_ptr()))
        assert pictures.shape[1] == 8 * 16
    assert len(addresses) == 1


def test_training_state_is_reused(tmp_path):
    """The learners of the last phase train in the same tensors again; others do not."""
    learners = made(tmp_path, 2, "cpu")
    learn_together(learners)
    lockstep = learners[0].workspace
    learn_together(learners)
    assert learners[0].workspace is lockstep and lockstep.fits(learners, True)
    assert not lockstep.fits(learners[::-1], True) and not lockstep.fits(learners[:1], True)
    assert not lockstep.fits(learners, False)


def test_rows_begin_where_products_are_fast(tmp_path):
    """Each parameter in a row begins at a multiple of 64 bytes, and what is between them stays 0."""
    learners = made(tmp_path, 2, "cpu")
    learn_together(learners)
    rows, start, used = (
        learners[0].workspace.rows,
        0,
        torch.zeros(2, learners[0].workspace.rows.shape[-1], dtype=bool),
    )
    for parameters in zip(*(learner.autoencoder.parameters() for learner in learners), strict=True):
        for k in range(2):
            used[k, start : start + parameters[k].numel()] = True
        assert rows[0, 0, start:].data_ptr() % 64 == rows[0, 1, start:].data_ptr() % 64 == 0
        start += -(-parameters[0].numel() // 16) * 16
    assert rows[:, used].count_nonzero() and not rows[:, ~used].any()
