import itertools

import pytest
import torch

from softmpm_learn.autoencoder import Autoencoder, train_autoencoder
from softmpm_learn.seeding import seeded
from softmpm_learn.settings import LearningConf


def make(dim=2, shape=(11, 6), variational_size=2, **kwargs) -> Autoencoder:
    with seeded(0):
        return Autoencoder(dim, shape, variational_size, [4, 8], **kwargs)


def waves(count: int, shape=(11, 6)) -> torch.Tensor:
    """Pictures with two numbers in them: the strengths of two patterns."""
    generator = torch.Generator().manual_seed(1)
    x, y = (torch.linspace(0, 3, n) for n in shape)
    pattern = torch.stack([torch.sin(x)[:, None] * torch.cos(y), torch.cos(x)[:, None] * torch.sin(y)])
    pattern = torch.stack([pattern, pattern.flip(0)])
    return torch.einsum("bk,kcij->bcij", torch.randn(count, 2, generator=generator), pattern)


@pytest.mark.parametrize("dim, shape", [(2, (11, 6)), (2, (16, 16)), (3, (5, 8, 7))])
def test_shapes_come_back(dim, shape):
    """Any picture, odd sizes too, is encoded to the latent size and decoded to its own shape."""
    autoencoder = make(dim, shape)
    z = autoencoder.encoder(torch.randn(3, dim, *shape))
    assert z.shape == (3, 2) and autoencoder.decode(z).shape == (3, dim, *shape)


def test_scale_makes_units_vanish():
    """After rescale, pictures in mm/s give the features that pictures in m/s gave; an all-zero batch changes nothing."""
    autoencoder, pictures = make(), waves(8)
    autoencoder.rescale(pictures)
    z = autoencoder.encoder(pictures)
    autoencoder.rescale(1000 * pictures)
    torch.testing.assert_close(autoencoder.encoder(1000 * pictures), z, rtol=1e-5, atol=1e-6)
    scale = autoencoder.encoder.scale.item()
    autoencoder.rescale(torch.zeros(3))
    assert autoencoder.encoder.scale.item() == scale


def test_what_the_policy_sees_is_the_standardised_mean():
    """Of pictures that it was standardised on, mean 0 and deviation 1; of any, the mean of the moments so moved."""
    autoencoder, pictures = make(), 100 * waves(8)
    autoencoder.standardise(pictures)
    encoder, z = autoencoder.encoder, autoencoder.encoder(pictures)
    torch.testing.assert_close(z, (encoder.moments(pictures)[0] - encoder.centre) / encoder.spread)
    torch.testing.assert_close(z.mean(dim=0), torch.zeros(2), rtol=0, atol=1e-5)
    torch.testing.assert_close(z.std(dim=0, correction=0), torch.ones(2))


def test_kullback_leibler_term():
    """(L1): the variational loss exceeds the plain one by β times the divergence from the unit normal, computed by torch."""
    autoencoder, pictures = make(), waves(5)
    mean, log_variance = autoencoder.encoder.moments(pictures)
    normal = torch.distributions.Normal
    divergence = torch.distributions.kl_divergence(normal(mean, (0.5 * log_variance).exp()), normal(0.0, 1.0))
    extra = autoencoder.loss(pictures, kl=0.5) - autoencoder.loss(pictures, kl=None)
    torch.testing.assert_close(extra, 0.5 * divergence.sum(dim=-1).mean())


@pytest.mark.parametrize("variational", [False, True])
def test_it_learns(variational):
    """Two numbers suffice for pictures made of two numbers: the error on unseen ones falls below a tenth of their variance."""
    autoencoder, generator = make(), torch.Generator().manual_seed(2)
    training, held_out = waves(200)[:160], waves(200)[160:]
    autoencoder.rescale(training)
    conf = LearningConf(epochs=30, batches=10, rate=1e-2, variational=variational, early_stopping=False)
    sample = lambda: training[torch.randint(len(training), (16,), generator=generator)]  # noqa: E731
    optimizer = torch.optim.Adam(autoencoder.parameters(), lr=conf.rate)
    learned = train_autoencoder(autoencoder, optimizer, sample, held_out, conf, generator)
    error = (autoencoder.decode(autoencoder.encoder(held_out)) - held_out).square().mean()
    assert error < 0.1 * held_out.square().mean() and learned.epochs == 30


def test_early_stopping_keeps_the_best_weights():
    """Trained on noise of other statistics, the validation loss rises: training stops after the patience at the best weights."""
    autoencoder, generator = make(), torch.Generator().manual_seed(0)
    held_out = torch.zeros(4, 2, 11, 6)
    conf = LearningConf(epochs=50, batches=2, rate=1e-2, patience=3, variational=False)
    sample = lambda: 5 * torch.randn(8, 2, 11, 6, generator=generator)  # noqa: E731
    before = autoencoder.loss(held_out, None).item()
    learned = train_autoencoder(
        autoencoder, torch.optim.Adam(autoencoder.parameters(), lr=0.01), sample, held_out, conf, generator
    )
    assert learned.epochs < 50 and learned.validation <= before
    assert autoencoder.loss(held_out, None).item() == pytest.approx(learned.validation, rel=1e-6)
    always = LearningConf(epochs=8, batches=2, rate=1e-2, patience=3, variational=False, early_stopping=False)
    other = make()
    learned = train_autoencoder(
        other, torch.optim.Adam(other.parameters(), lr=0.01), sample, held_out, always, generator
    )
    assert learned.epochs == 8 and other.loss(held_out, None).item() == pytest.approx(
        learned.validation, rel=1e-6
    )


def trained(autoencoder, sample, conf, held_out=None):
    """Train with a new Adam; gives it and the result."""
    optimizer = torch.optim.Adam(autoencoder.parameters(), lr=conf.rate)
    generator = torch.Generator().manual_seed(0)
    return optimizer, train_autoencoder(autoencoder, optimizer, sample, held_out, conf, generator)


@pytest.mark.parametrize("improvement, epochs", [(0.01, 4), (0.0, 30)])
def test_early_stopping_ends_where_progress_is_slow(improvement, epochs):
    """A validation loss that falls in every epoch, but by less than the improvement, ends the phase at the lowest loss."""
    autoencoder, pictures = make(), waves(16)
    conf = LearningConf(
        epochs=30, batches=1, rate=1e-5, patience=4, variational=False, improvement=improvement
    )
    before = autoencoder.loss(pictures, None).item()
    _, learned = trained(autoencoder, lambda: pictures, conf, pictures)
    assert learned.epochs == epochs
    assert 0.99 * before < learned.validation < before
    assert autoencoder.loss(pictures, None).item() == pytest.approx(learned.validation, rel=1e-6)


def test_progress_that_adds_up_is_no_standstill():
    """Epochs that are slow one by one, but not over the patience, go on to the cap."""
    autoencoder, pictures, losses = make(), waves(16), iter([1.0 * 0.995**k for k in range(99)])
    real = autoencoder.loss
    autoencoder.loss = lambda p, kl, generator=None: (
        real(p, kl, generator) if generator else torch.tensor(next(losses))
    )
    conf = LearningConf(epochs=20, batches=1, patience=4, variational=False)
    _, learned = trained(autoencoder, lambda: pictures, conf, pictures)
    assert learned.epochs == 20 and learned.validation == pytest.approx(0.995**20)


def test_the_optimiser_goes_back_with_the_weights():
    """Its moments are those of the best epoch, so that the next phase goes on from there."""
    held_out = torch.zeros(4, 2, 11, 6)
    conf = LearningConf(batches=2, rate=1e-2, patience=3, variational=False)
    generator = torch.Generator().manual_seed(0)
    sample = lambda: 5 * torch.randn(8, 2, 11, 6, generator=generator)  # noqa: E731
    autoencoder = make()
    optimizer, learned = trained(autoencoder, sample, conf, held_out)
    best = learned.epochs - conf.patience
    steps = {int(state["step"]) for state in optimizer.state.values()}
    assert best * conf.batches == (steps.pop() if steps else 0) and learned.epochs < conf.epochs


@pytest.mark.parametrize("early_stopping, epochs", [(True, 4), (False, 30)])
def test_without_validation_a_phase_is_short(early_stopping, epochs):
    """Nothing could tell when to stop, so early stopping allows the patience."""
    conf = LearningConf(epochs=30, batches=1, patience=4, early_stopping=early_stopping)
    _, learned = trained(make(), lambda: waves(8), conf)
    assert learned.epochs == epochs and learned.validation != learned.validation


@pytest.mark.parametrize("validated", [True, False])
@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_a_gradient_that_is_not_finite_is_undone(validated, where, caplog):
    """The epoch ends the phase; weights and moments are those after the epoch before, and the log says so."""
    autoencoder, pictures, calls = make(), waves(16), itertools.count()

    def sample():
        bad = next(calls) == 7  # the second of the fourth epoch
        if bad and where == "gradient":
            autoencoder.decoder.tail.bias.register_hook(lambda gradient: gradient * float("inf"))
        return pictures * float("nan") if bad and where == "loss" else pictures

    conf = LearningConf(epochs=9, batches=2, rate=1e-2, variational=False)
    optimizer, learned = trained(autoencoder, sample, conf, pictures if validated else None)
    assert learned.epochs == 4 and "not finite after epoch 4" in caplog.text
    other = make()
    short = LearningConf(epochs=3, batches=2, rate=1e-2, variational=False)
    want, _ = trained(other, lambda: pictures, short, pictures if validated else None)
    for one, two in zip(autoencoder.parameters(), other.parameters(), strict=True):
        assert torch.equal(one, two)
        assert all(torch.equal(optimizer.state[one][k], want.state[two][k]) for k in want.state[two])


def test_global_randomness_is_left_alone():
    """Making and training a network neither reads nor moves PyTorch's own generator."""
    before = torch.get_rng_state()
    autoencoder, generator = make(), torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(autoencoder.parameters())
    conf = LearningConf(epochs=1, batches=1)
    train_autoencoder(autoencoder, optimizer, lambda: waves(4), None, conf, generator)
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(5)
    assert all(torch.equal(a, b) for a, b in zip(make().parameters(), make().parameters(), strict=True))
