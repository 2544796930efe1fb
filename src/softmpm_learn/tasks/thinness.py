"""Limbs and necks of a robot that are too thin for the cells of its grid: a warning with their width and the cells that would do."""

import logging
import math

import numpy as np

from softmpm_learn.tasks.own import OwnConf

logger = logging.getLogger("softmpm_learn")


def warn_of_thin_limbs(conf: OwnConf, mask: np.ndarray, pixel: float) -> None:
    """Log a warning if a limb or a neck is thinner than two cells.

    Args:
        mask: Pixels or voxels of the robot, booleans along 2 or 3 axes.
        pixel: Width of one [m].
    """
    thin = thinnest(mask, pixel, 2 * conf.spacing)
    if thin is not None:
        logger.warning(
            "A limb or a neck of %s is at most %.2g m thick, %.1f cells of %.3g m; four or more are good. Draw it thicker, or make "
            "task.size or task.cells larger, such as task.cells=%d.",
            *(conf.file, thin, thin / conf.spacing, conf.spacing, math.ceil(4 / thin)),
        )


def thinnest(mask: np.ndarray, pixel: float, least: float) -> float | None:
    """Upper bound of the width of the thinnest limb or neck below a least width, within an eighth of that [m]; None if there is none.

    Discs, or balls, of the least width fill a robot but for what is thinner and for its corners. Only what is more than one such width
    away from them is a limb, which is as wide as its widest place: corners of more than 40° are not. Shorter necks are found by
    :func:`_has_neck`, and smaller discs find their width.

    Args:
        mask, pixel: As for :func:`warn_of_thin_limbs`.
    """
    from scipy.ndimage import distance_transform_edt

    parts = 1 if 8 * pixel <= least else 2 * math.ceil(4 * pixel / least)  # an even width is exact
    fine, unit = np.pad(np.kron(mask, np.ones((parts,) * mask.ndim, dtype=bool)), 1), pixel / parts
    depth = unit * np.asarray(distance_transform_edt(fine))

    def away(width: float) -> np.ndarray:
        """Distance from the centres of the discs of this width [m]."""
        return unit * np.asarray(distance_transform_edt(depth < width / 2))

    widths = []
    if (depth >= least / 2).any():
        distance = away(least)
        fine &= distance > 1.5 * least
        if _has_neck(depth, distance, least):
            low, high = 0.0, least
            for _ in range(3):
                middle = (low + high) / 2
                low, high = (low, middle) if _has_neck(depth, away(middle), middle) else (middle, high)
            widths.append(high)
    piece = pieces(fine, corners=True)
    widest = np.zeros(piece.max() + 1)
    np.maximum.at(widest, piece[fine], depth[fine])
    widths += (2 * widest[1:]).tolist()
    return min(widths, default=None)


def _has_neck(depth: np.ndarray, away: np.ndarray, width: float) -> bool:
    """True if a neck is thinner than the discs of a width.

    They do not pass through it: the inner halves of those on either side are apart, or what the discs fill has another number of holes,
    of handles or of cavities than the robot. At edges and in narrow notches these numbers depend on whether pixels that share a
    corner alone touch, at a neck they do not.

    Args:
        depth: Distance from the outside [m].
        away: Distance from the centres of the discs [m].
    """
    piece = pieces(depth > 0)
    with_disc = np.zeros(piece.max() + 1, dtype=bool)
    with_disc[piece[away == 0]] = True
    whole, opened = with_disc[piece], away < width / 2
    if pieces(away < width / 4).max() > np.count_nonzero(with_disc):
        return True
    axes = depth.ndim
    return _euler(whole, axes) != _euler(opened, axes) and _euler(~whole, axes) != _euler(~opened, axes)


def pieces(mask: np.ndarray, corners: bool = False) -> np.ndarray:
    """Number of the piece of each pixel, counted from 1, and 0 outside; with ``corners`` pixels touch that share a corner alone."""
    from scipy.ndimage import label

    found = np.empty(mask.shape, dtype=np.int32)
    label(mask, np.ones((3,) * mask.ndim) if corners else None, output=found)
    return found


def _euler(mask: np.ndarray, axes: int) -> int:
    """Euler characteristic along the first axes: pieces less holes in 2D, pieces less handles plus cavities in 3D.

    Pixels that share a corner alone do not touch.
    """
    if axes == 0:
        return int(np.count_nonzero(mask))
    one, pairs = (np.moveaxis(cells, 0, -1) for cells in (mask, mask[1:] & mask[:-1]))
    return _euler(one, axes - 1) - _euler(pairs, axes - 1)
