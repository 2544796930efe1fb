"""Inside of a picture: its silhouette as booleans, how much of each lattice cell that covers, and its contours."""

import os
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from softmpm.scene.contour import contours
from softmpm.validate import need

if TYPE_CHECKING:
    import PIL.Image

Inside = Literal["dark", "light", "opaque"]
FORMATS = ("PNG", "JPEG", "BMP", "GIF", "TIFF", "WEBP")
"""Formats that are read. Pillow knows others; for some it starts another program with what the file says."""
MOST_PIXELS = 2**25
"""Larger pictures are refused before they are decoded; this many take about 0.7 GB while they are read."""


def silhouette(source: Any, inside: Inside, threshold: float) -> np.ndarray:
    """Read a path, Pillow image or array; booleans (row, column), the top row first."""
    need(inside in get_args(Inside), f"inside must be one of {', '.join(get_args(Inside))}, got {inside!r}.")
    need(0 < threshold < 1, f"threshold must lie between 0 and 1, got {threshold}.")
    if isinstance(source, (str, os.PathLike)):
        values = _read(source, inside)
    elif hasattr(source, "convert"):
        values = _grey(source, inside)
    else:
        values = np.asarray(source)
        need(
            inside != "opaque", "an array has no transparency: use inside='dark', 'light' or a boolean array."
        )
    need(
        values.ndim == 2 and values.size > 0,
        f"a picture as an array has shape (row, column), got {values.shape}; pass colours as a Pillow image.",
    )
    if values.dtype == bool:
        return values
    values = _unit(values)
    return values < threshold if inside == "dark" else values > threshold


def coverage(mask: np.ndarray, begin: np.ndarray, count: np.ndarray, step: float, width: float) -> np.ndarray:
    """Share of each square of a lattice that the mask covers, shape (x, y) with y up.

    The squares are ``width`` wide and ``step`` apart, ``count`` along each axis; the first has its lower corner at ``begin``. All in
    pixels.
    """
    left, bottom = (b + step * np.arange(n) for b, n in zip(begin, count, strict=True))
    across = _overlap(left, width, mask.shape[1])
    up = _overlap(bottom, width, mask.shape[0])
    return across @ mask[::-1].T @ up.T


def mask_contours(mask: np.ndarray, width: float) -> list[np.ndarray]:
    """Closed polygons around the places whose square of this width is at least half covered; all in pixels, y up.

    The square smooths the steps of the pixels and rounds corners at its own width; a straight edge along an axis stays where it is,
    because the coverage is linear within half a width of it and is sampled twice for each. Samples are symmetric about the middle of
    the picture.
    """
    step, size = width / 2, np.array(mask.shape[::-1])
    steps = np.ceil(size / step) + 2
    begin = (size - step * steps) / 2
    covered = coverage(mask, begin - width / 2, steps + 1, step, width)
    return [begin + step * polygon for polygon in contours(covered, 0.5)]


def _overlap(left: np.ndarray, width: float, pixels: int) -> np.ndarray:
    """Share of each interval that each pixel covers along one axis, shape (interval, pixel)."""
    left, edge = left[:, None], np.arange(pixels)[None, :]
    return np.clip(np.minimum(left + width, edge + 1) - np.maximum(left, edge), 0.0, None) / width


def _read(path: "str | os.PathLike[str]", inside: Inside) -> np.ndarray:
    pillow, name = _pillow(), os.fspath(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"there is no picture file {name!r}.")
    with _legible(name), warnings.catch_warnings():
        warnings.simplefilter("ignore", pillow.DecompressionBombWarning)  # the limit here is lower
        picture = pillow.open(path, formats=FORMATS)
    with picture:
        _check_size(picture, name)
        with _legible(name):
            picture.load()
        return _grey(picture, inside)


@contextmanager
def _legible(name: str) -> Iterator[None]:
    try:
        yield
    except (
        ArithmeticError,
        EOFError,
        LookupError,
        OSError,
        SyntaxError,
        TypeError,
        ValueError,
        struct.error,
    ) as error:
        raise ValueError(
            f"{name!r} cannot be read as a picture: {error}; it must be a {', '.join(FORMATS)}: open it in a program for pictures "
            "and save it as PNG."
        ) from error
    except _pillow().DecompressionBombError as error:
        raise ValueError(f"the picture {name!r} is too large: {error}") from error


def _check_size(picture: "PIL.Image.Image", name: str) -> None:
    width, height = picture.size
    need(
        width * height <= MOST_PIXELS,
        f"the picture {name!r} must have at most {MOST_PIXELS} pixels, got {width} x {height}; make it smaller: a silhouette "
        "needs no more than a few pixels for each particle.",
    )


def _grey(picture: "PIL.Image.Image", inside: Inside) -> np.ndarray:
    if (
        picture.mode.startswith("I") or picture.mode == "F"
    ):  # 16 bits or floats: neither colour nor transparency
        need(inside != "opaque", "the picture has no transparency: use inside='dark' or 'light'.")
        return np.asarray(picture).astype(np.float64 if picture.mode == "F" else np.uint16)
    rgba = picture.convert("RGBA")
    if inside == "opaque":
        need(picture.has_transparency_data, "the picture has no transparency: use inside='dark' or 'light'.")
        return np.asarray(rgba.getchannel("A"))
    pillow = _pillow()
    paper = pillow.new("RGBA", rgba.size, "white" if inside == "dark" else "black")
    return np.asarray(pillow.alpha_composite(paper, rgba).convert("L"))


def _pillow() -> Any:
    try:
        import PIL.Image
    except ImportError as error:
        raise ImportError("reading a picture needs Pillow: pip install pillow, or pass an array.") from error
    return PIL.Image


def _unit(values: np.ndarray) -> np.ndarray:
    if values.dtype in (np.uint8, np.uint16):
        return values / np.iinfo(values.dtype).max
    need(
        np.issubdtype(values.dtype, np.floating) and bool(((values >= 0) & (values <= 1)).all()),
        "grey values must be uint8, uint16 or floats from 0, black, to 1, white, "
        f"got {values.dtype} from {values.min()} to {values.max()}.",
    )
    return values
