import pytest
import torch
from learners import waves
from torch.nn import functional

from softmpm_learn.autoencoder import Autoencoder, upsample_nearest
from softmpm_learn.seeding import seeded


def make(dim=2, shape=(11, 6), variational_size=2, **kwargs) -> Autoencoder:
    with seeded(0):
        return Autoencoder(dim, shape, variational_size, [4, 8], **kwargs)


@pytest.mark.parametrize("fields", [1, 2])
@pytest.mark.parametrize("dim, shape", [(2, (11, 6)), (2, (16, 16)), (3, (5, 8, 7))])
def test_shapes_come_back(dim, shape, fields):
    """Any picture, odd sizes and several vectors at a node too, is encoded to the latent size and decoded to its own shape."""
    autoencoder, seen = make(dim, shape, seen=fields * dim), fields * dim
    z = autoencoder.encoder(torch.randn(3, seen, *shape))
    assert z.shape == (3, 2) and autoencoder.decode(z).shape == (3, seen, *shape)


@pytest.mark.parametrize("size", [(7, 4), (8, 3), (8, 4), (7, 3, 5), (1, 1, 1)])
def test_doubling_is_interpolation_by_nearest_neighbours(size):
    """Values and gradients, for even and odd sizes."""
    h = torch.randn(2, 3, *((n + 1) // 2 for n in size), dtype=torch.float64, requires_grad=True)
    got, want = upsample_nearest(h, size), functional.interpolate(h, size=size)
    assert torch.equal(got, want)
    adj = torch.randn_like(got)
    (a,), (b,) = (torch.autograd.grad(out, h, adj) for out in (got, want))
    torch.testing.assert_close(a, b, rtol=1e-14, atol=1e-14)


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


def test_shares_weight_the_means():
    """(L1) with a share of a third for each of three pictures, and none for the others, is the loss of those three."""
    autoencoder, pictures = make(), waves(5)
    share = torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0]) / 3
    want = autoencoder.loss(pictures[:3], 0.5)
    torch.testing.assert_close(autoencoder.loss(pictures, 0.5, share=share), want)


def test_noise_moves_the_latent_by_its_deviation():
    """The plain part of the loss is that of decoding mean + noise · deviation."""
    autoencoder, pictures = make(), waves(5)
    noise = torch.randn(5, 2, generator=torch.Generator().manual_seed(0))
    mean, log_variance = autoencoder.encoder.moments(pictures)
    got = autoencoder.decoder(
        torch.distributions.Normal(mean, (0.5 * log_variance).exp()).icdf(torch.special.ndtr(noise))
    )
    want = (got - pictures).square().mean()
    torch.testing.assert_close(autoencoder.loss(pictures, 0.0, noise=noise), want, rtol=1e-4, atol=0)


def test_global_randomness_is_left_alone():
    """Making a network neither reads nor moves PyTorch's own generator."""
    before = torch.get_rng_state()
    make()
    assert torch.equal(before, torch.get_rng_state())
    torch.manual_seed(5)
    assert all(torch.equal(a, b) for a, b in zip(make().parameters(), make().parameters(), strict=True))
