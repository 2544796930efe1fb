"""Figures without pyplot, so that nothing global changes; matplotlib is imported where it is used."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from softmpm_learn.storage.files import replace

COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"]
"""Colours that people with any colour vision tell apart (Okabe and Ito 2008)."""
DECADES = 100.0
"""Largest over smallest value from which on an axis has the scale of logarithms."""


def figure(width: float, height: float) -> Any:
    """An empty figure of a size [inch]."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def scale(values: Any) -> str:
    """Scale of an axis on which all of these can be told apart: that of logarithms where they are positive and span two decades."""
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    return "log" if known.size and known.min() > 0 and known.max() > DECADES * known.min() else "linear"


def save(figure: Any, path: Path, dpi: int) -> None:
    """Write a PNG file, whole or not at all: a run that is killed leaves the picture of the iteration before."""
    picture = io.BytesIO()
    figure.savefig(picture, dpi=dpi, format="png")
    replace(Path(path), picture.getvalue())
