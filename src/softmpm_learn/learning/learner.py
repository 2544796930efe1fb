"""The learning phase: replay buffer, autoencoder and target network, put together as the 2019 paper describes.

Its three refinements, early stopping, replay and target network, each have a switch in :class:`LearningConf`.
"""

import dataclasses
from pathlib import Path

import torch
from torch import Tensor, nn

from softmpm import Model
from softmpm_learn.autoencoder import FAINT, QUIET, Autoencoder
from softmpm_learn.learning.replay import Replay
from softmpm_learn.learning.target import TargetNetwork
from softmpm_learn.observe import Latent
from softmpm_learn.seeding import stream
from softmpm_learn.settings import LearningConf, Settings


class Learner:
    """Learns to encode images of grid velocity; the policy uses :attr:`encoder`."""

    def __init__(self, conf: LearningConf, autoencoder: Autoencoder, replay: Replay, seed: int = 0):
        self.conf, self.autoencoder, self.replay = conf, autoencoder, replay
        self.streams = {name: stream(seed, name) for name in ("minibatches", "noise")}
        # It stores the moments between phases; within one they are in the lock step:
        self.optimizer = torch.optim.Adam(autoencoder.parameters(), lr=conf.rate)
        self.target = TargetNetwork(autoencoder.encoder) if conf.target_network else None
        self.phases, self.name = 0, ""
        """Learning phases done, and the name of its run among those beside it."""
        self.workspace: object = None
        """Kept by a learning phase for the next one: the tensors and the CUDA graph for this learner and those beside it."""

    @property
    def encoder(self) -> nn.Module:
        return self.target or self.autoencoder.encoder

    @property
    def networks(self) -> list[nn.Module]:
        """Networks that a learning phase modifies."""
        return [self.autoencoder] if self.target is None else [self.autoencoder, self.target]

    def add_observations(self, first: int, observations: Tensor) -> None:
        """Add the simulations of an iteration, shape (frame, world, dim, *nodes), to the replay buffer, numbered from ``first`` on.

        Of many worlds only the first are written, see :attr:`softmpm_learn.learning.replay.Replay.per_iteration`.
        """
        for world in range(observations.shape[1])[: self.replay.per_iteration]:
            self.replay.add(first + world, observations[:, world])

    @property
    def can_learn(self) -> bool:
        """True if there are pictures to learn from."""
        return len(self.replay.places("training")) > 0

    def pictures(self, split: str) -> Tensor:
        """Evenly chosen pictures of a split, which suffice for means, in the precision of the autoencoder."""
        return self.replay.some(split).to(self.autoencoder.encoder.scale)

    def finish_phase(self) -> None:
        """Bring what the policy sees up to date with the autoencoder."""
        self.autoencoder.standardise(self.pictures("training"), QUIET if self.conf.epochs else FAINT)
        if self.target is not None:
            self.target.follow(self.autoencoder.encoder, self._target_rate())
        self.phases += 1
        if not self.conf.replay:
            self.replay.clear()

    def _target_rate(self) -> float:
        if self.phases == 0:
            return 1.0  # what it copies from is only noise
        halving = self.conf.target_halving
        return self.conf.target_rate * (1.0 if halving is None else 0.5 ** (self.phases / halving))

    def state_dict(self) -> dict:
        return {
            "autoencoder": self.autoencoder.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "target": None if self.target is None else self.target.state_dict(),
            "replay": self.replay.seal,
            "phases": self.phases,
            "streams": {name: generator.get_state() for name, generator in self.streams.items()},
        }

    def load_state_dict(self, content: dict) -> None:
        self.autoencoder.load_state_dict(content["autoencoder"])
        self.optimizer.load_state_dict(content["optimizer"])
        if self.target is not None:
            self.target.load_state_dict(content["target"])
        self.replay.load(content["replay"])
        self.phases = content["phases"]
        for name, generator in self.streams.items():
            generator.set_state(content["streams"][name])


def make_learner(
    settings: Settings, observer: Latent, control_steps: int, model: Model, folder: Path
) -> Learner:
    """Make the learner of an observer's autoencoder, moved to device and precision of the model. Without ``observer.trained`` its
    learning phases have no epochs.

    Args:
        control_steps: Decisions in an episode.
        folder: Where the replay buffer lies.

    Raises:
        TypeError: The observer's encoder is no :class:`softmpm_learn.autoencoder.Autoencoder`.
    """
    conf, worlds, autoencoder = settings.learning, settings.train.worlds, observer.encoder
    if not isinstance(autoencoder, Autoencoder):
        raise TypeError(
            f"the encoder of observer {settings.observer.name!r} must be a softmpm_learn.autoencoder.Autoencoder, which learning "
            f"phases train, got {type(autoencoder).__name__}; derive an observer without learning phases from Observer, not Latent."
        )
    if not observer.trained:
        conf = dataclasses.replace(conf, epochs=0)
    frames = -(-control_steps // conf.frame_every)
    replay = Replay(
        folder,
        (frames, observer.picture.channels, *observer.picture.shape),
        simulations=conf.simulations if conf.replay else conf.every * worlds,
        megabytes=conf.megabytes,
        validation=conf.validation,
        worlds=worlds,
        iterations=None if conf.replay else conf.every,
        device=model.device,
    )
    return Learner(conf, autoencoder.to(model.device, model.dtype), replay, settings.train.seed)
