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
