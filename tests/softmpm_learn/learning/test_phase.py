"""Learning phases: when they end, what they keep, and many at once."""

import copy
import math

import pytest
import torch
from learners import HELD_OUT, TRAINING, learn, make_learner, spoil, waves

from softmpm_learn.learning.learner import Learner
from softmpm_learn.learning.phase import EarlyStopping, learn_together
from softmpm_learn.settings import LearningConf


def noise(frames: int, seed=0) -> torch.Tensor:
    return 5 * torch.randn(frames, 2, 11, 6, generator=torch.Generator().manual_seed(seed))


def unlike(folder, conf: LearningConf, **settings) -> Learner:
    """Trained on noise of other statistics than what is held out, so that the validation loss rises."""
    return make_learner(folder, conf, {0: noise(8), 2: torch.zeros(8, 2, 11, 6)}, **settings)


def run(conf: LearningConf, losses, validates=True) -> EarlyStopping:
    """Early stopping that is given these validation losses; the first is that before the first epoch."""
    stop = EarlyStopping(conf, next(losses), validates)
    while not stop.done:
        stop.add(1.0, next(losses), True)
    return stop


def falling(factor: float):
    return (factor**k for k in range(1000))


@pytest.mark.parametrize("improvement, epochs", [(0.01, 4), (0.0, 30)])
def test_early_stopping_ends_where_progress_is_slow(improvement, epochs):
    """A validation loss that falls in every epoch, but by less than the improvement, ends the phase at the lowest loss."""
    stop = run(LearningConf(epochs=30, patience=4, improvement=improvement), falling(0.9999))
    assert stop.epochs == stop.kept == epochs and stop.validation == 0.9999**epochs


def test_progress_that_adds_up_is_no_standstill():
    """Epochs that are slow one by one, but not over the patience, go on to the cap."""
    stop = run(LearningConf(epochs=20, patience=4), falling(0.995))
    assert stop.epochs == 20 and stop.validation == pytest.approx(0.995**20)


def test_the_lowest_loss_is_kept():
    """A loss that falls and then rises ends the phase after the patience; without early stopping the last one is kept."""
    losses = [5.0, 3.0, 2.0, *(4.0 for _ in range(99))]
    stop = run(LearningConf(epochs=30, patience=4), iter(losses))
    assert (stop.epochs, stop.kept, stop.validation) == (6, 2, 2.0)
    stop = run(LearningConf(epochs=30, patience=4, early_stopping=False), iter(losses))
    assert (stop.epochs, stop.kept, stop.validation) == (30, 30, 4.0)


@pytest.mark.parametrize("early_stopping, epochs", [(True, 4), (False, 30)])
def test_without_validation_a_phase_is_short(early_stopping, epochs):
    """Nothing could tell when to stop, so early stopping allows the patience."""
    conf = LearningConf(epochs=30, patience=4, early_stopping=early_stopping)
    stop = run(conf, (0.0 for _ in range(99)), validates=False)
    assert stop.epochs == stop.kept == epochs and math.isnan(stop.validation)


@pytest.mark.parametrize("variational", [False, True])
def test_it_learns(tmp_path, variational):
    """Two numbers suffice for pictures made of two numbers: the error on unseen ones falls below a tenth of their variance."""
    pictures = waves(200)
    conf = LearningConf(
        epochs=30, batches=10, batch=16, rate=1e-2, variational=variational, early_stopping=False
    )
    held_out = pictures[:50]
    subject = make_learner(
        tmp_path, conf, {2: held_out} | {4 * k: pictures[50 * k :][:50] for k in (1, 2, 3)}
    )
    assert learn(subject)["epochs"] == 30
    error = (subject.autoencoder.decode(subject.autoencoder.encoder(held_out)) - held_out).square().mean()
    assert error < 0.1 * held_out.square().mean()


def test_a_phase_goes_back_to_its_best_epoch(tmp_path):
    """Weights are those of the lowest validation loss, and moments and steps are of the same epoch."""
    conf = LearningConf(epochs=50, batches=2, batch=8, rate=1e-2, patience=3, variational=False)
    subject = unlike(tmp_path / "whole", conf)
    figures = learn(subject)
    best, held_out = figures["epochs"] - conf.patience, torch.zeros(8, 2, 11, 6)
    assert figures["epochs"] < 50
    assert subject.autoencoder.loss(held_out, None).item() == pytest.approx(
        figures["validation_loss"], rel=1e-6
    )
    steps = {int(state["step"]) for state in subject.optimizer.state.values()}
    assert steps == ({best * conf.batches} if best else set())
    subject = unlike(tmp_path / "always", LearningConf(epochs=8, batches=2, rate=1e-2, early_stopping=False))
    assert learn(subject)["epochs"] == 8
    assert {int(state["step"]) for state in subject.optimizer.state.values()} == {16}


@pytest.mark.parametrize("validated", [True, False])
@pytest.mark.parametrize("value", [math.nan, 1e17])
def test_an_epoch_that_is_not_finite_is_undone(tmp_path, value, validated, caplog):
    """A loss that is no number, or a second moment that is infinite after a finite loss, ends the phase; weights and moments are those
    after the epoch before, and the log says so."""
    settings = dict(batches=2, batch=8, rate=1e-2, variational=False)
    simulations = {0: waves(16)} | ({2: waves(16)} if validated else {})
    subject = make_learner(tmp_path / "spoilt", LearningConf(epochs=9, **settings), simulations)
    spoil(subject, 3, value)
    subject.finish_phase = lambda: None  # would look at the spoilt pictures
    figures = learn(subject)
    assert figures["epochs"] == 4 and "not finite after epoch 4" in caplog.text
    assert math.isfinite(figures["training_loss"]) == math.isfinite(value)
    want = make_learner(tmp_path / "short", LearningConf(epochs=3, **settings), simulations)
    learn(want)
    for one, two in zip(subject.autoencoder.parameters(), want.autoencoder.parameters(), strict=True):
        assert torch.equal(one, two)
        got = subject.optimizer.state[one]
        assert all(torch.equal(got[k], tensor) for k, tensor in want.optimizer.state[two].items())


def assert_close(got: object, want: object) -> None:
    if isinstance(want, dict):
        assert got.keys() == want.keys()
        for key in want:
            assert_close(got[key], want[key])
    elif isinstance(want, list | tuple):
        for one, two in zip(got, want, strict=True):
            assert_close(one, two)
    elif isinstance(want, torch.Tensor):
        torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)
    elif isinstance(want, float):
        assert got == pytest.approx(want, rel=1e-12, nan_ok=True)
    else:
        assert got == want


CONTENTS = (
    {TRAINING[0]: waves(12), TRAINING[1]: waves(12, seed=2), HELD_OUT[0]: waves(12, seed=3)},
    {TRAINING[0]: noise(12), HELD_OUT[0]: torch.zeros(12, 2, 11, 6), HELD_OUT[1]: noise(12, 1) / 50},
    {k: waves(12, seed=k) for k in (*TRAINING, *HELD_OUT)},
    {TRAINING[0]: waves(12, seed=4)},
    {HELD_OUT[0]: waves(12)},
)
"""Simulations of learners: one that goes on, one that stops early, one to be spoilt, one without validation, one without training."""


@pytest.mark.parametrize("variational", [True, False])
def test_together_each_learns_what_it_learns_alone(tmp_path, variational, caplog):
    """Learners with other pictures, held-out pictures in other numbers, other seeds and other ends, one of them not finite: figures,
    weights, moments, targets and random streams of two phases are those of single phases; the log names the spoilt one."""
    conf = LearningConf(
        epochs=12, batches=3, batch=5, rate=1e-2, patience=4, improvement=0.0, variational=variational
    )
    results = {}
    for name in ("alone", "together"):
        learners = [
            make_learner(tmp_path / name / str(k), conf, content, seed=k, dtype=torch.float64)
            for k, content in enumerate(CONTENTS)
        ]
        spoil(learners[2], 2, math.nan)
        learners[2].name = f"seed 5 {name}"
        learners[2].autoencoder.standardise = lambda pictures, quiet: None  # of spoilt pictures
        phases = []
        for phase in range(2):
            if phase:
                learners[2].replay.load(learners[2].replay.seal)
            one_by_one = [learn_together([learner])[0] for learner in learners] if name == "alone" else None
            phases.append(one_by_one or learn_together(learners))
        results[name] = phases, [copy.deepcopy(learner.state_dict()) for learner in learners]
    print(results["alone"][0], results["together"][0])
    assert_close(results["together"], results["alone"])
    for name in results:
        assert f"The weights of the autoencoder of seed 5 {name} are not finite after epoch 3" in caplog.text
    first = [figures.get("epochs") for figures in results["alone"][0][0]]
    lockstep = learners[0].workspace
    assert len(lockstep.memories) == 4 and torch.equal(lockstep.rows, lockstep.kept)  # nothing goes on alone
    assert first[0] == 12 and first[1] < 12 and first[2:] == [3, 4, None]


def test_learners_in_one_phase_are_alike(tmp_path):
    """Other settings or another architecture are an error."""
    conf = LearningConf(epochs=1, batches=1)
    one = unlike(tmp_path / "one", conf)
    other = unlike(tmp_path / "other", LearningConf(epochs=2, batches=1))
    with pytest.raises(ValueError, match="learner 1 differs"):
        learn_together([one, other])


def test_parameters_stay_where_they_are(tmp_path):
    """A phase writes into the storage of the parameters, which may be views of a larger tensor."""
    conf = LearningConf(epochs=2, batches=2, early_stopping=False)
    learners = [unlike(tmp_path / str(seed), conf, seed=seed) for seed in range(2)]
    parameters = [list(learner.autoencoder.parameters()) for learner in learners]
    stacks = [torch.stack([p.detach() for p in ps]) for ps in zip(*parameters, strict=True)]
    for s, own in enumerate(parameters):
        for p, stack in zip(own, stacks, strict=True):
            p.data = stack[s]
    before = [stack.clone() for stack in stacks]
    for _ in range(2):
        learn_together(learners)
    for stack, old, ps in zip(stacks, before, zip(*parameters, strict=True), strict=True):
        assert all(
            torch.equal(p, row) and not torch.equal(row, o) for p, row, o in zip(ps, stack, old, strict=True)
        )


def test_global_randomness_is_left_alone(tmp_path):
    """A phase neither reads nor moves PyTorch's own generator."""
    before = torch.get_rng_state()
    learn(unlike(tmp_path, LearningConf(epochs=1, batches=1)))
    assert torch.equal(before, torch.get_rng_state())
