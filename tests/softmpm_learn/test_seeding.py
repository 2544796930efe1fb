"""Random streams: what one part of a run draws does not depend on the others."""

import itertools

import pytest
import torch
from learners import changed

from softmpm_learn.runs.goals import Goals
from softmpm_learn.runs.run import Run
from softmpm_learn.seeding import seeded, stream, stream_seed
from softmpm_learn.train import train


def test_streams_differ_by_name_and_by_seed():
    """Each is repeated by the same name and seed only."""
    pairs = [(seed, name) for seed in range(3) for name in ("goals", "noise")]
    drawn = [torch.rand(4, generator=stream(*pair)) for pair in pairs]
    assert len({tuple(numbers.tolist()) for numbers in drawn}) == 6
    assert torch.equal(drawn[0], torch.rand(4, generator=stream(0, "goals")))
    assert all(0 <= stream_seed(*pair) < 2**63 for pair in pairs)


def test_global_randomness_is_left_alone():
    """Layers made from a seed neither read nor move PyTorch's own generator."""
    before = torch.get_rng_state()
    with seeded(3):
        first = torch.rand(2)
    assert torch.equal(before, torch.get_rng_state())
    with seeded(3):
        assert torch.equal(first, torch.rand(2))


CHANGES = {
    "observer": dict(observer=dict(name="centroids")),
    "epochs": dict(learning=dict(epochs=1)),
    "variational": dict(learning=dict(variational=False)),
    "policy": dict(policy=dict(name="mlp", hidden=[3])),
}


@pytest.mark.parametrize("part", CHANGES)
def test_another_part_leaves_the_goals_as_they_are(task, model, settings, tmp_path, monkeypatch, part):
    """Runs with one seed draw the same goals whatever observes, learns or acts, so that they can be compared in pairs."""
    drawn, real = [], Goals.draw
    monkeypatch.setattr(Goals, "draw", lambda goals: drawn.append(real(goals)) or drawn[-1])
    settings = changed(settings, train=dict(goal_spread=[0.1, 0.1], iterations=3, evaluation_goals=1))
    for number, conf in enumerate((settings, changed(settings, **CHANGES[part]))):
        train(task, model, conf, tmp_path / str(number))
    assert torch.equal(torch.stack(drawn[:3]), torch.stack(drawn[3:]))
    assert torch.stack(drawn).unique(dim=0).shape[0] == 3


def test_another_part_leaves_the_minibatches_as_they_are(task, model, settings, tmp_path, monkeypatch):
    """Neither random goals nor the noise of the autoencoder shift which pictures it learns from."""
    drawn, real = [], torch.randint

    def recorded(*args, **kwargs):
        drawn.append(real(*args, **kwargs))
        return drawn[-1]

    monkeypatch.setattr("softmpm_learn.learning.replay.torch.randint", recorded)
    settings, counts = changed(settings, train=dict(iterations=2), learning=dict(early_stopping=False)), []
    goals = dict(goal_spread=[0.1, 0.1], evaluation_goals=1)
    for number, groups in enumerate(({}, dict(train=goals), dict(learning=dict(variational=False)))):
        train(task, model, changed(settings, **groups), tmp_path / str(number))
        counts.append(len(drawn))
    runs = [torch.cat(drawn[start:end]) for start, end in itertools.pairwise([0, *counts])]
    assert len(runs[0]) > 0 and all(torch.equal(run, runs[0]) for run in runs)


def test_weights_of_the_policy_do_not_depend_on_the_autoencoder(task, model, settings, tmp_path):
    """Other channels, other weights of the encoder; the same of the policy."""
    runs = [
        Run(task, model, changed(settings, observer=dict(channels=channels)), tmp_path)
        for channels in ([4, 4], [2])
    ]
    for one, other in zip(*(run.policy.parameters() for run in runs), strict=True):
        assert torch.equal(one, other)
