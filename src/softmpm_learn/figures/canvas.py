"""Figures without pyplot, so that nothing global changes; matplotlib is imported where it is used."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softmpm_learn.storage.files import replace

COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000"]
"""Colours that people with any colour vision tell apart (Okabe and Ito 2008)."""
DECADES = 100.0
"""Largest over smallest value from which on an axis has the scale of logarithms."""

CENTRAL = 0.05, 0.95
"""Quantiles of the values that an axis shows in any case."""
MOST = 10.0
"""Range of all values over that of the central ones from which on an axis leaves out some."""
FAR = 3.0
"""Distance from the central values of what it leaves out, over their range; the fall at the beginning of a run is nearer."""
MARGIN = 0.05
"""Margin of such an axis, over its length."""


def figure(width: float, height: float) -> Any:
    """An empty figure of a size [inch]."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def scale(values: Any) -> str:
    """Scale of an axis on which all of these can be told apart: that of logarithms where they are positive and span two decades."""
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    return "log" if known.size and known.min() > 0 and known.max() > DECADES * known.min() else "linear"


def alone(values: np.ndarray) -> np.ndarray:
    """Finite values between two that are not, which a line does not show; shape (value,), boolean."""
    known = np.pad(np.isfinite(values), 1)
    return known[1:-1] & ~known[:-2] & ~known[2:]


def limits(values: Any, scale: str) -> tuple[float, float] | None:
    """Ends of an axis that a few values would flatten: around those in the central range and not far from it; else None."""
    known = np.asarray(values, dtype=float).ravel()
    known = known[np.isfinite(known)]
    if scale == "log":
        ends = limits(np.log10(known), "linear")
        return None if ends is None else (10.0 ** ends[0], 10.0 ** ends[1])
    low, high = np.quantile(known, CENTRAL) if known.size else (0.0, 0.0)
    if high == low or np.ptp(known) <= MOST * (high - low):
        return None
    reach = FAR * (high - low)
    near = known[(known >= low - reach) & (known <= high + reach)]
    low, high = near.min(), near.max()
    return low - MARGIN * (high - low), high + MARGIN * (high - low)


def limit(axes: Any, ends: tuple[float, float] | None, curves: Sequence[tuple[Any, Any, Any]]) -> None:
    """Set the ends of the vertical axis, and mark what lies outside of them: its place, and above the axes its most extreme value.

    Args:
        ends: From :func:`limits`.
        curves: Of each its places on the horizontal axis, its values and its colour.
    """
    if ends is None:
        return
    axes.set_ylim(*ends)
    look: dict = dict(transform=axes.get_xaxis_transform(), clip_on=False, in_layout=False, markersize=5)
    words = []
    for edge, end, sign, marker, text in (
        (1, ends[1], 1, "^", "▲ up to"),
        (0, ends[0], -1, "v", "▼ down to"),
    ):
        farthest = end
        for x, y, colour in curves:
            x, y = np.asarray(x), np.asarray(y, dtype=float)
            out = sign * y > sign * end
            if out.any():
                axes.plot(x[out], np.full(out.sum(), edge), marker, color=colour, **look)
                farthest = sign * max(sign * farthest, (sign * y[out]).max())
        if farthest != end:
            words.append(f"{text} {farthest:.3g}")
    axes.set_title("  ".join(words), fontsize=8, loc="right")


def save(figure: Any, path: Path, dpi: int) -> None:
    """Write a PNG file, whole or not at all: a run that is killed leaves the picture of the iteration before."""
    picture = io.BytesIO()
    figure.savefig(picture, dpi=dpi, format="png")
    replace(Path(path), picture.getvalue())
