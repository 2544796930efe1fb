"""Convolutional autoencoder of grid velocity, plain or variational, in 2D and 3D.

    ℓ = mean (u − û)² + β · mean Σ ½ (m² + s² − 1 − log s²)        (L1)   u: picture / scale; m, s: mean and deviation of z

Kingma & Welling 2014, "Auto-encoding variational Bayes". Layers and channels are our choice: the 2019 paper states none.
"""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

QUIET = 0.1
"""A trained latent that deviates less than this, in units of the prior, is not blown up to deviation 1: it says next to nothing."""
FAINT = 1e-4
"""The same for one that is not trained, whose deviation is a matter of the first weights: 0.002 to 0.02 in a run of the biped."""


def _halvings(shape: tuple[int, ...], times: int) -> list[tuple[int, ...]]:
    sizes = [tuple(shape)]
    for _ in range(times):
        sizes.append(tuple((n + 1) // 2 for n in sizes[-1]))
    return sizes


def upsample_nearest(h: Tensor, size: Sequence[int]) -> Tensor:
    """Pictures (picture, channel, *nodes) with each node twice along each axis, cut to ``size``.

    The same values as ``functional.interpolate``, whose backward pass took a third of a learning phase of 80 learners on an H200.
    """
    for axis, nodes in enumerate(size, start=2):
        h = torch.stack((h, h), dim=axis + 1).flatten(axis, axis + 1).narrow(axis, 0, nodes)
    return h


class Encoder(nn.Module):
    """Picture → latent. Each convolution halves the picture; smooth activations, because a policy's gradient passes here.

    Velocities are divided by ``scale``, and the latent that a policy sees is standardised: ``centre`` and ``spread`` bring
    it to mean 0 and deviation 1 on the pictures learned from. Our choice: with the small weight of the divergence in (L1)
    the latent of a fresh network and of a trained one differ tenfold, and a policy between them saturates.
    """

    scale: Tensor
    centre: Tensor
    spread: Tensor

    def __init__(
        self,
        dim: int,
        shape: tuple[int, ...],
        latent_size: int,
        channels: Sequence[int],
        scale: float,
        seen: int,
    ):
        super().__init__()
        conv = nn.Conv2d if dim == 2 else nn.Conv3d
        widths = [seen, *channels]
        self.convs = nn.ModuleList(
            conv(a, b, kernel_size=3, stride=2, padding=1) for a, b in itertools.pairwise(widths)
        )
        corner = _halvings(shape, len(channels))[-1]
        self.head = nn.Linear(channels[-1] * torch.Size(corner).numel(), 2 * latent_size)
        self.register_buffer("scale", torch.tensor(float(scale)))
        self.register_buffer("centre", torch.zeros(latent_size))
        self.register_buffer("spread", torch.ones(latent_size))

    def _convolved(self, picture: Tensor) -> Tensor:
        h = picture / self.scale
        for conv in self.convs:
            h = functional.silu(conv(h))
        return h.flatten(start_dim=1)

    def moments(self, picture: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of the latent, each (picture, latent_size), of velocities [m/s] (picture, dim, *nodes)."""
        return self.head(self._convolved(picture)).chunk(2, dim=-1)

    def forward(self, picture: Tensor) -> Tensor:
        """Standardised mean of the latent, shape (picture, latent_size)."""
        weight, bias = (part.chunk(2)[0] for part in (self.head.weight, self.head.bias))
        return (functional.linear(self._convolved(picture), weight, bias) - self.centre) / self.spread


class Decoder(nn.Module):
    """Latent → picture in units of the scale: the encoder mirrored."""

    def __init__(
        self, dim: int, shape: tuple[int, ...], latent_size: int, channels: Sequence[int], seen: int
    ):
        super().__init__()
        conv = nn.Conv2d if dim == 2 else nn.Conv3d
        *self.sizes, self.corner = _halvings(shape, len(channels))
        self.tail = nn.Linear(latent_size, channels[-1] * torch.Size(self.corner).numel())
        widths = [*reversed(channels), seen]
        self.convs = nn.ModuleList(
            conv(a, b, kernel_size=3, padding=1) for a, b in itertools.pairwise(widths)
        )

    def forward(self, z: Tensor) -> Tensor:
        h = self.tail(z).unflatten(1, (-1, *self.corner))
        for conv, size in zip(self.convs, reversed(self.sizes), strict=True):
            h = conv(upsample_nearest(functional.silu(h), size))
        return h


class Autoencoder(nn.Module):
    """Encoder and decoder of pictures of grid velocity.

    Args:
        dim: 2 or 3.
        shape: Nodes of a picture.
        latent_size, channels: See :class:`softmpm_learn.settings.ObserverConf`.
        scale: Typical velocity [m/s], until :meth:`rescale` has seen some.
        seen: Channels of a picture, None for those of a velocity.
    """

    def __init__(
        self,
        dim: int,
        shape: tuple[int, ...],
        latent_size: int,
        channels: Sequence[int],
        scale: float = 1.0,
        seen: int | None = None,
    ):
        super().__init__()
        self.encoder = Encoder(dim, shape, latent_size, channels, scale, seen or dim)
        self.decoder = Decoder(dim, shape, latent_size, channels, seen or dim)

    def decode(self, z: Tensor) -> Tensor:
        """Picture [m/s], shape (picture, channels, *nodes), that a standardised latent (picture, latent_size) stands for."""
        encoder = self.encoder
        return self.decoder(encoder.centre + encoder.spread * z) * encoder.scale

    def rescale(self, pictures: Tensor) -> None:
        """Take the root mean square of the velocities that are not zero as the scale."""
        moving = pictures[pictures != 0]
        if moving.numel():
            self.encoder.scale.copy_(moving.square().mean().sqrt())

    @torch.no_grad()
    def standardise(self, pictures: Tensor, quiet: float = QUIET) -> None:
        """Bring the latent of these pictures to mean 0 and deviation 1, one that deviates by less than ``quiet`` to less."""
        mean = self.encoder.moments(pictures)[0]
        self.encoder.centre.copy_(mean.mean(dim=0))
        self.encoder.spread.copy_(mean.std(dim=0, correction=0).clamp(min=quiet))

    def loss(
        self, pictures: Tensor, kl: float | None, *, noise: Tensor | None = None, share: Tensor | None = None
    ) -> Tensor:
        """(L1); ``kl`` is β, or None for a plain autoencoder.

        Args:
            noise: Standard normal numbers, shape (picture, latent_size); without them the latent is its mean.
            share: Weight of each picture in the means, shape (picture,); None for equal ones.
        """
        mean, log_variance = self.encoder.moments(pictures)
        z = mean if noise is None else mean + noise * (0.5 * log_variance).exp()
        got, want = self.decoder(z), pictures / self.encoder.scale
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(dim=-1)
        if share is None:
            loss, divergence = functional.mse_loss(got, want), divergence.mean()
        else:
            loss = (share * (got - want).square().flatten(start_dim=1).mean(dim=1)).sum()
            divergence = (share * divergence).sum()
        return loss if kl is None else loss + kl * divergence
