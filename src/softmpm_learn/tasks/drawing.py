"""A flat robot from masks: the pixels of each part of a picture, or the voxels of an array, become particles."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import softmpm
from softmpm_learn.tasks.own import Muscular, OwnConf, longer_axis, walker
from softmpm_learn.tasks.task import Task
from softmpm_learn.tasks.thinness import pieces, warn_of_thin_limbs


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
    label: str = ""
    """As of :class:`Muscular`."""


def drawn(conf: OwnConf, parts: Sequence[Part]) -> Task:
    """The walker made of the parts; those with the same stiffness are one body.

    Raises:
        ValueError: There is no pixel, or the robot is in several pieces.
    """
    whole = np.any([part.mask for part in parts], axis=0) if parts else np.zeros((1, 1), dtype=bool)
    _check_pieces(conf, whole)
    rows, columns = (np.flatnonzero(whole.any(axis=axis)) for axis in (1, 0))
    cut = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    height, width = whole[cut].shape
    pixel = conf.size / max(height, width)
    warn_of_thin_limbs(conf, whole[cut], pixel)
    stiffnesses = sorted({part.stiffness for part in parts if part.mask.any()})
    owners = [_owners(parts, stiffness)[cut] for stiffness in stiffnesses]
    shapes = _shapes(conf, parts, owners, pixel)
    of = np.concatenate(
        [_nearest(owner, shape.positions / pixel) for owner, shape in zip(owners, shapes, strict=True)]
    )
    muscles = [
        Muscular(part.name, np.flatnonzero(of == k), part.direction or _fibres(part.mask), part.label)
        for k, part in enumerate(parts)
        if part.muscle and part.mask.any()
    ]
    return walker(conf, list(zip(shapes, stiffnesses, strict=True)), muscles)


def _owners(parts: Sequence[Part], stiffness: float) -> np.ndarray:
    """Number of the part of this stiffness that has each pixel, -1 where none has it."""
    owner = np.full(parts[0].mask.shape, -1)
    for k, part in enumerate(parts):
        if part.stiffness == stiffness:
            owner[part.mask] = k
    return owner


def _nearest(owner: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Part of the pixel nearest to each place, shape (place,); places (place, 2) in pixels, y up.

    Of equally near pixels it is the inner one, which keeps muscles symmetric; in the middle of the picture the right one.
    """
    from scipy.spatial import KDTree

    row, column = np.nonzero(owner >= 0)
    centres = np.stack([column, len(owner) - 1 - row], axis=1) + 0.5
    inward = 1e-9 * (np.array(owner.shape[::-1]) / 2 + 0.1 - places)
    return owner[row, column][KDTree(centres).query(places + inward)[1]]


def _shapes(
    conf: OwnConf, parts: Sequence[Part], owners: Sequence[np.ndarray], pixel: float
) -> list[softmpm.Particles]:
    """Shape of each body. Where cells are not cut, a particle of the whole robot belongs to the body that covers most of its cell, of
    equal ones to the first: each body by itself would have one in a cell that two cover by halves, and none in a third of a cell.

    Raises:
        ValueError: No particle belongs to a body.
    """
    masks = [owner >= 0 for owner in owners]

    def filled(mask: np.ndarray, cut_cells: bool) -> softmpm.Particles:
        height = len(mask) * pixel
        return softmpm.image(mask, (0.0, 0.0), height=height, spacing=conf.spacing / 2, cut_cells=cut_cells)

    shapes = [filled(mask, cut_cells=True) for mask in masks]
    if conf.cut_cells:
        return shapes
    whole = filled(np.any(masks, axis=0), cut_cells=False)
    places, width = whole.positions / pixel, 0.5 * conf.spacing / pixel
    of = np.argmax([_coverage(mask, places, width).round(6) for mask in masks], axis=0)
    for k, owner in enumerate(owners):
        if not (of == k).any():
            names = ", ".join(parts[part].name for part in np.unique(owner[owner >= 0]))
            raise ValueError(
                f"{names} of {conf.file}: no cell of {conf.spacing / 2:.3g} m belongs mostly to this stiffness, so that it has no "
                "particle. Draw it larger, or increase task.size or task.cells."
            )
    return [
        softmpm.Particles(whole.positions[of == k], np.asarray(whole.volume)[of == k], shape.outline)
        for k, shape in enumerate(shapes)
    ]


def _coverage(mask: np.ndarray, places: np.ndarray, width: float) -> np.ndarray:
    """Share that a mask covers of the square around each place, shape (place,); in pixels, y up."""
    from scipy.ndimage import map_coordinates

    table = np.pad(mask[::-1].cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))).astype(float)  # (y, x)
    covered = np.zeros(len(places))
    for right, up in itertools.product((-1, 1), (-1, 1)):
        corner = (places + 0.5 * width * np.array((right, up)))[:, ::-1].T
        covered += right * up * map_coordinates(table, corner, order=1, mode="nearest")
    return covered / width**2


def _fibres(mask: np.ndarray) -> tuple[float, ...]:
    """The longer axis of the part, or of its pieces."""
    row, column = np.nonzero(mask)
    piece = pieces(mask, corners=True)[row, column]
    return longer_axis(np.stack([column, -row], axis=1).astype(float), piece)


def _check_pieces(conf: OwnConf, whole: np.ndarray) -> None:
    piece = pieces(whole)
    count = int(piece.max())
    if count == 0:
        raise ValueError(
            f"the robot of {conf.file} is empty: all of it is white, transparent or voxels of 0. Draw a body."
        )
    if count > 1:
        sizes = np.bincount(piece.ravel())[1:]
        smallest = int(sizes.argmin()) + 1
        row, column = (int(at) for at in np.argwhere(piece == smallest)[0])
        raise ValueError(
            f"the robot of {conf.file} is in {count} pieces, which would fall apart; the smallest has {sizes.min()} pixels or voxels "
            f"and begins in row {row}, column {column}, counted from 0 at the top left. Connect or erase it."
        )
