"""The learning phase of one learner, or of many side by side, with early stopping for each.

A learner has its own pictures, random streams, weights and moments, and ends at its own epoch; the others go on without it.
"""

import logging
import math
from collections.abc import Sequence

from softmpm_learn.learning.learner import Learner
from softmpm_learn.learning.lockstep import LockStep
from softmpm_learn.settings import LearningConf

logger = logging.getLogger("softmpm_learn")


class EarlyStopping:
    """Decides where a learner's phase ends and to which epoch it goes back.

    It ends where the validation loss has not fallen by ``conf.improvement`` for ``conf.patience`` epochs, and goes back to the lowest
    one, even to the beginning. An epoch after which a weight or a moment is not finite ends the phase too, and is undone.

    Args:
        loss: Validation loss before the first epoch.
        validates: False if nothing is held out yet: early stopping then allows ``conf.patience`` epochs, because more would fit the
            few pictures of the beginning alone.
        name: That of the run among those beside it, for the log.

    Attributes:
        epochs: Epochs that were run.
        kept: The epoch to go back to; 0 is the beginning.
        training: Mean loss of the last epoch; nan if it was undone because of such a loss.
        validation: Loss of the weights to go back to; nan if nothing is held out.
    """

    def __init__(self, conf: LearningConf, loss: float, validates: bool, name: str = ""):
        self.name, self.stops = name, conf.early_stopping and validates
        self.most = min(conf.epochs, conf.patience) if conf.early_stopping and not validates else conf.epochs
        self.conf, self.validates = conf, validates
        self.training = math.nan
        self.validation = self._level = loss if validates else math.nan
        self.epochs = self.kept = self._waited = 0
        self._finite = True

    @property
    def done(self) -> bool:
        return self.epochs >= self.most or self._waited >= self.conf.patience or not self._finite

    def add(self, training: float, validation: float, finite: bool) -> bool:
        """Take the result of an epoch; True if its weights are to be kept."""
        self.epochs, self.training, self._finite = self.epochs + 1, training, finite
        if not finite:
            logger.warning(
                "The weights of the autoencoder%s are not finite after epoch %d; going back.",
                f" of {self.name}" if self.name else "",
                self.epochs,
            )
            return False
        better = not self.stops or validation < self.validation
        if better:
            self.validation, self.kept = validation if self.validates else math.nan, self.epochs
        if self.stops and validation < (1 - self.conf.improvement) * self._level:
            self._level, self._waited = validation, 0
        elif self.stops:
            self._waited += 1
        return better

    @property
    def figures(self) -> dict[str, float]:
        """For metrics.csv."""
        return {"epochs": self.epochs, "training_loss": self.training, "validation_loss": self.validation}


def learn_side_by_side(learners: Sequence[Learner]) -> list[dict[str, float]]:
    """One learning phase of each learner, on a GPU those with equal settings and architectures in lock step.

    On a CPU that is no faster; one after another, each learns the same to the last bit, whoever learns beside it.
    """
    if not (learners and learners[0].replay.memory.is_cuda):
        return [figures for learner in learners for figures in learn_together([learner])]
    kinds, found = [_kind(learner) for learner in learners], dict[int, dict[str, float]]()
    for first in (k for k, kind in enumerate(kinds) if kind not in kinds[:k]):
        alike = [k for k, kind in enumerate(kinds) if kind == kinds[first]]
        found |= dict(zip(alike, learn_together([learners[k] for k in alike]), strict=True))
    return [found[k] for k in range(len(learners))]


def learn_together(learners: Sequence[Learner], *, capture: bool = True) -> list[dict[str, float]]:
    """One learning phase of each learner, in lock step; each learns what it would learn alone.

    Args:
        learners: Of one architecture and with equal settings; seeds, pictures and pasts may differ.
        capture: On a GPU, replay epochs as a CUDA graph, captured in the first phase of these learners.

    Returns:
        The figures of each learner for metrics.csv; none of one that has no pictures yet.

    Raises:
        ValueError: Settings or architectures differ.
    """
    _check_alike(learners)
    taught = {k: learner for k, learner in enumerate(learners) if learner.can_learn}
    stops = _train(list(taught.values()), capture) if taught else []
    figures = {k: stop.figures for k, stop in zip(taught, stops, strict=True)}
    return [figures.get(k, {}) for k in range(len(learners))]


def _train(learners: Sequence[Learner], capture: bool) -> list[EarlyStopping]:
    for learner in learners:
        learner.autoencoder.rescale(learner.pictures("training"))
    lockstep = learners[0].workspace
    if not (isinstance(lockstep, LockStep) and lockstep.fits(learners, capture)):
        lockstep = learners[0].workspace = LockStep(learners, capture)
    lockstep.load(learners)
    stops = [
        EarlyStopping(learner.conf, loss, len(learner.replay.places("validation")) > 0, learner.name)
        for learner, loss in zip(learners, lockstep.validation_losses(), strict=True)
    ]
    while not all(stop.done for stop in stops):
        going = [k for k, stop in enumerate(stops) if not stop.done]
        for k in going:
            lockstep.draw(k, learners[k])
        results = lockstep.epoch()
        for k in range(len(learners)):
            if k in going and stops[k].add(*results[k]):
                lockstep.keep(k)
            if stops[k].done:
                lockstep.reset(k)
    for k, (learner, stop) in enumerate(zip(learners, stops, strict=True)):
        lockstep.unload(k, learner, stop.kept)
        learner.finish_phase()
    return stops


def _kind(learner: Learner) -> tuple:
    """Properties that learners in lock step have in common."""
    return learner.conf, learner.replay.shape, [p.shape for p in learner.autoencoder.parameters()]


def _check_alike(learners: Sequence[Learner]) -> None:
    for k, learner in enumerate(learners):
        if _kind(learner) != _kind(learners[0]):
            raise ValueError(
                f"learners in one phase must have equal settings and architectures; learner {k} differs from learner 0."
            )
