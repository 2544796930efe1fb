"""An observer is asked about examples before it is used: what a policy sees must follow from the state alone."""

import torch
from torch import Tensor

from softmpm import Model, State
from softmpm_learn.observe import Observer
from softmpm_learn.seeding import seeded
from softmpm_learn.unchanged import need_unchanged, versions

AGAIN = 1e3
"""Largest difference of an observer's answers to one question, relative to the largest number, in units of the precision: a GPU adds up
the particles at a node in any order."""
DENT = 0.1
"""Largest share of the way to a corner by which the robots of a :func:`probe` are displaced: no particle turns inside out."""


@torch.no_grad()
def check_observer(observer: Observer, model: Model) -> None:
    """Ask an observer about a state, another one, and the first again. Random numbers that it draws, such as the noise of a sensor, are
    the same for each question, and none of a run.

    Raises:
        ValueError: Its features have another shape than (world, size), or differ from one time to the other; or it changes the state in
            place.
    """
    kind, wanted = type(observer).__name__, (model.worlds, observer.size)
    moved, answers = probe(model), list[Tensor]()
    for state in (moved, model.rest()._replace(v=moved.v / 2), moved):
        before = versions(state[:4])
        with seeded(0, model.device):
            features = observer(model, state)
        need_unchanged(f"the observer {kind}", "the state", before, versions(state[:4]))
        if features.shape != wanted:
            raise ValueError(
                f"the observer must return features of shape (world, size) = {wanted}, got {tuple(features.shape)}; size is an "
                f"attribute of {kind}."
            )
        answers.append(features)
    away, largest = (answers[2] - answers[0]).abs().max().item(), answers[0].abs().max().item()
    if away > AGAIN * torch.finfo(answers[0].dtype).eps * largest:
        raise ValueError(
            f"the observer {kind} must be a function of the state alone; asked about one state again, after another, it has "
            f"features that differ by {away:.2g} (largest {largest:.2g}): its memory would pass from an episode to the next. "
            "Velocities are in state.v."
        )


def probe(model: Model) -> State:
    """A smooth state in which robots are displaced, deformed and moving, in each world differently. A robot stays in its box at rest:
    its points X move towards the lowest corner of the box, by a share of the way of up to :data:`DENT`.
    """
    rest = model.rest()
    place = {"dtype": model.dtype, "device": model.device}
    away = rest.x - model.positions.amin(dim=0)
    wave = torch.arange(1.0, model.dim + 1, **place) / away.max()  # [1/m]
    phase = away @ wave + torch.arange(model.worlds, **place)[:, None]
    share = 1 - DENT * (1 + phase.sin()) / 2
    slope = -DENT / 2 * phase.cos()[..., None] * wave  # of the share, along each axis
    phases = phase[..., None] + torch.arange(model.dim, **place)
    return rest._replace(
        x=rest.x + (share - 1)[..., None] * away,
        v=phases.sin(),
        C=phases.cos()[..., None] * wave,
        F=share[..., None, None] * rest.F + away[..., None] * slope[..., None, :],
    )
