"""A flat robot from masks: the pixels of each part of a picture, or the voxels of an array, become particles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import softmpm
from softmpm_learn.tasks.own import Muscular, OwnConf, longer_axis, walker
from softmpm_learn.tasks.task import Task
from softmpm_learn.tasks.thinness import warn_of_thin_limbs


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the robot."""

    name: str
    mask: np.ndarray
    """Its pixels, booleans (row, column), the top row first."""
    muscle: bool = False
    direction: tuple[float, ...] | None = None
    """Fibre direction of a muscle, None for along its longer axis."""
    stiffness: float = 1.0
    """Young's modulus in units of the setting's."""


def drawn(conf: OwnConf, parts: Sequence[Part]) -> Task:
    """The walker made of the parts; those with the same stiffness are one body.

    Raises:
        ValueError: There is no pixel, or the robot is in several pieces.
    """
    from scipy.ndimage import distance_transform_edt

    whole = np.any([part.mask for part in parts], axis=0) if parts else np.zeros((1, 1), dtype=bool)
    _check_pieces(conf, whole)
    rows, columns = (np.flatnonzero(whole.any(axis=axis)) for axis in (1, 0))
    cut = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    height, width = whole[cut].shape
    pixel = conf.size / max(height, width)
    warn_of_thin_limbs(conf, whole[cut], pixel)
    shapes, owners, taken = [], [], set[tuple[float, ...]]()
    for stiffness in sorted({part.stiffness for part in parts}):
        owner = np.full((height, width), -1)
        for k, part in enumerate(parts):
            if part.stiffness == stiffness:
                owner[part.mask[cut]] = k
        if (owner < 0).all():
            continue
        shape = softmpm.image(
            owner >= 0,
            (0.0, 0.0),
            height=height * pixel,
            spacing=conf.spacing / 2,
            cut_cells=conf.on_surface or conf.formulation == "reference",
        )
        shape = _without(shape, taken)
        near = np.asarray(distance_transform_edt(owner < 0, return_distances=False, return_indices=True))
        x, y = np.floor(shape.positions / pixel).astype(int).T
        column, row = np.clip(x, 0, width - 1), np.clip(height - 1 - y, 0, height - 1)
        shapes.append((shape, stiffness))
        owners.append(owner[tuple(near[:, row, column])])
    of = np.concatenate(owners)
    muscles = [
        Muscular(part.name, np.flatnonzero(of == k), part.direction or _fibres(part.mask))
        for k, part in enumerate(parts)
        if part.muscle and part.mask.any()
    ]
    return walker(conf, shapes, muscles)


def _without(shape: softmpm.Particles, taken: set[tuple[float, ...]]) -> softmpm.Particles:
    """The shape without particles at places that are taken: a lattice cell of which two bodies have half each is one particle, of the
    first. Its own places are taken from then on."""
    places = [tuple(place) for place in shape.positions.tolist()]
    free = [place not in taken for place in places]
    taken.update(places)
    return softmpm.Particles(shape.positions[free], np.asarray(shape.volume)[free], shape.outline)


def _fibres(mask: np.ndarray) -> tuple[float, ...]:
    """The longer axis of the part, or of its pieces."""
    from scipy.ndimage import label

    pieces = np.empty(mask.shape, dtype=np.int32)
    label(mask, np.ones((3, 3)), output=pieces)
    row, column = np.nonzero(mask)
    return longer_axis(np.stack([column, -row], axis=1).astype(float), pieces[row, column])


def _check_pieces(conf: OwnConf, whole: np.ndarray) -> None:
    from scipy.ndimage import label

    pieces = np.empty(whole.shape, dtype=np.int32)
    label(whole, output=pieces)
    count = int(pieces.max())
    if count == 0:
        raise ValueError(f"the robot of {conf.file} is empty.")
    if count > 1:
        sizes = np.bincount(pieces.ravel())[1:]
        smallest = int(sizes.argmin()) + 1
        row, column = (int(at) for at in np.argwhere(pieces == smallest)[0])
        raise ValueError(
            f"the robot of {conf.file} is in {count} pieces, which would fall apart; the smallest has {sizes.min()} pixels or voxels "
            f"and begins in row {row}, column {column}, counted from 0 at the top left. Connect or erase it."
        )
