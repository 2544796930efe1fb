"""Limbs of a robot that are too thin for the cells of its grid: a warning with their width and the cells that would do."""

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
            "A limb of %s is at most %.2g m thick, %.1f cells of %.3g m; four or more are good. Draw it thicker, or make task.size or "
            "task.cells larger, such as task.cells=%d.",
            *(conf.file, thin, thin / conf.spacing, conf.spacing, math.ceil(4 / thin)),
        )


def thinnest(mask: np.ndarray, pixel: float, least: float) -> float | None:
    """Largest width along the thinnest limb or neck below a least width, to an eighth of that [m]; None if there is none.

    Discs, or balls, of the least width fill a robot but for what is thinner and for its corners. Only what is more than one such width
    away from them is a limb: corners of more than 40° are not.

    Args:
        mask, pixel: As for :func:`warn_of_thin_limbs`.
    """
    from scipy.ndimage import distance_transform_edt, label

    parts = 1 if 8 * pixel <= least else 2 * math.ceil(4 * pixel / least)  # an even width is exact
    fine, unit = np.pad(np.kron(mask, np.ones((parts,) * mask.ndim, dtype=bool)), 1), pixel / parts
    depth = unit * np.asarray(distance_transform_edt(fine))
    core = depth >= least / 2
    if core.any():
        fine &= unit * np.asarray(distance_transform_edt(~core)) > 1.5 * least
    pieces = np.empty(fine.shape, dtype=np.int32)
    label(fine, np.ones((3,) * mask.ndim), output=pieces)
    widest = np.zeros(pieces.max() + 1)
    np.maximum.at(widest, pieces[fine], depth[fine])
    return 2 * float(widest[1:].min()) if len(widest) > 1 else None
