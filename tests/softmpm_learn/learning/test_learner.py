import copy

import torch
from learners import learn

from softmpm_learn.autoencoder import Autoencoder
from softmpm_learn.learning.learner import Learner
from softmpm_learn.learning.replay import Replay
from softmpm_learn.seeding import seeded
from softmpm_learn.settings import LearningConf


def learner(folder, **changes) -> Learner:
    conf = LearningConf(
        **(
            {"epochs": 2, "batches": 2, "batch": 4, "validation": 0.25, "target_rate": 0.5}
            | {"target_halving": None}
            | changes
        )
    )
    with seeded(0):
        autoencoder = Autoencoder(2, (6, 5), 2, [4])
    return Learner(conf, autoencoder, Replay(folder, (5, 2, 6, 5), simulations=8, validation=conf.validation))


def seen(number: int) -> torch.Tensor:
    return torch.randn(5, 1, 2, 6, 5, generator=torch.Generator().manual_seed(number))


def taught(folder, simulations=4, **changes) -> tuple[Learner, dict]:
    subject = learner(folder, **changes)
    for number in range(simulations):
        subject.add_observations(number, seen(number))
    return subject, learn(subject)


def test_the_policy_uses_the_target(tmp_path):
    """The target copies after the first phase and then follows at its rate; without it the policy uses the network itself."""
    subject, _ = taught(tmp_path / "with")
    online, x = subject.autoencoder.encoder, seen(9)[:, 0]
    assert torch.equal(subject.encoder(x), online(x))
    before = copy.deepcopy(subject.target.copy.state_dict())
    learn(subject)
    for name, tensor in subject.target.copy.state_dict().items():
        torch.testing.assert_close(tensor, 0.5 * (before[name] + online.state_dict()[name]))
    subject, _ = taught(tmp_path / "without", target_network=False)
    assert subject.encoder is subject.autoencoder.encoder


def test_the_target_follows_ever_more_slowly(tmp_path):
    """With a rate of 0.5 and a halving in two phases: after the first, which copies, it moves by 0.35, then by 0.25."""
    subject, _ = taught(tmp_path, target_halving=2.0)
    for share in (0.5 * 0.5**0.5, 0.25):
        before = copy.deepcopy(subject.target.copy.state_dict())
        learn(subject)
        source = subject.autoencoder.encoder.state_dict()
        for name, tensor in subject.target.copy.state_dict().items():
            torch.testing.assert_close(tensor, before[name] + share * (source[name] - before[name]))


def test_features_are_standardised(tmp_path):
    """After a phase the features of the training pictures have about mean 0 and deviation 1."""
    subject, _ = taught(tmp_path, simulations=8)
    z = subject.encoder(subject.pictures("training"))
    assert z.mean(dim=0).abs().max() < 0.7 and (z.std(dim=0) - 1).abs().max() < 0.5


def test_without_epochs_the_weights_stay(tmp_path):
    """A phase then changes scale and standardisation alone, of the network that the policy uses too; moments stay empty. However
    small the features of the first weights are, they become of order one."""
    subject = learner(tmp_path, epochs=0)
    with torch.no_grad():
        subject.autoencoder.encoder.head.weight.mul_(1e-2)
    first = copy.deepcopy(dict(subject.autoencoder.named_parameters()))
    for number in range(8):
        subject.add_observations(number, seen(number))
    assert learn(subject)["epochs"] == 0 and not subject.optimizer.state
    for name, parameter in subject.autoencoder.named_parameters():
        assert torch.equal(parameter, first[name]), name
    z = subject.encoder(subject.pictures("training"))
    assert z.mean(dim=0).abs().max() < 1e-3 and (z.std(dim=0, correction=0) - 1).abs().max() < 0.05
    assert subject.autoencoder.encoder.moments(subject.pictures("training"))[0].std(dim=0).max() < 0.05
    assert subject.encoder.copy.scale != 1.0


def test_validation_needs_an_iteration_held_out(tmp_path):
    """With one simulation there is no validation loss; with both splits filled there is one."""
    _, figures = taught(tmp_path / "one", simulations=1)
    assert figures["validation_loss"] != figures["validation_loss"]
    _, figures = taught(tmp_path / "four")
    assert figures["validation_loss"] > 0 and figures["epochs"] == 2


def test_without_replay_the_past_is_forgotten(tmp_path):
    """The switch empties the buffer after each phase; with replay it stays."""
    assert taught(tmp_path / "without", replay=False)[0].replay.ids == []
    assert taught(tmp_path / "with")[0].replay.ids == [0, 1, 2, 3]


def test_of_many_worlds_only_the_first_are_written(tmp_path):
    """Their numbers are those of the worlds, and no file is made of the others."""
    subject, pictures = learner(tmp_path), torch.cat([seen(number) for number in range(10)], dim=1)
    subject.replay.simulations, subject.replay.worlds = 12, 10
    for iteration in range(2):
        subject.add_observations(10 * iteration, pictures)
    assert subject.replay.ids == [0, 1, 2, 10, 11, 12] and len(list(tmp_path.iterdir())) == 6
    torch.testing.assert_close(subject.pictures("training")[:5], pictures[:, 0])


def test_goes_on_from_its_state(tmp_path):
    """A learner restored from a state learns on exactly as the one that was saved."""
    subject, _ = taught(tmp_path)
    state = copy.deepcopy(subject.state_dict())
    figures = learn(subject)
    other = learner(tmp_path)
    other.load_state_dict(state)
    assert learn(other) == figures
    assert torch.equal(other.encoder(seen(9)[:, 0]), subject.encoder(seen(9)[:, 0]))
