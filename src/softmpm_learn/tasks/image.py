"""A flat robot from a picture, in which each colour is a material or a muscle."""

import math
import re
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from softmpm_learn.setting_checks import not_negative
from softmpm_learn.tasks.drawing import Part, drawn
from softmpm_learn.tasks.own import OwnConf
from softmpm_learn.tasks.task import Task

FORMATS = ("PNG", "JPEG", "BMP", "GIF", "TIFF", "WEBP")
LOSSY = ("JPEG", "WEBP")
"""Formats that change colours as they compress; WEBP can also be lossless."""
MOST_PIXELS = 2**22
PAPER = np.array([255, 255, 255])


@dataclass(kw_only=True)
class Colour:
    """Meaning of a colour in the picture."""

    colour: str
    """#rrggbb."""
    muscle: bool = False
    """True for a muscle: all pixels of the colour contract together."""
    angle: float | None = None
    """Direction of the fibres of a muscle, counter-clockwise from forward [°]; null for along the longer axis of the part."""
    stiffness: float = 1.0
    """Young's modulus in units of task.young."""

    def __post_init__(self):
        if not (isinstance(self.colour, str) and re.fullmatch("#[0-9a-fA-F]{6}", self.colour)):
            raise ValueError(f"a colour of task.legend must be #rrggbb, got {self.colour!r}.")
        if not isinstance(self.muscle, bool):
            raise ValueError(f"muscle in task.legend must be true or false, got {self.muscle!r}.")
        if not (_is_finite(self.stiffness) and self.stiffness > 0):
            raise ValueError(f"stiffness in task.legend must be a number > 0, got {self.stiffness!r}.")
        if not (self.angle is None or _is_finite(self.angle)):
            raise ValueError(f"angle in task.legend must be a number of degrees or null, got {self.angle!r}.")

    @property
    def rgb(self) -> np.ndarray:
        """Red, green and blue, 0 to 255."""
        return np.array(list(bytes.fromhex(self.colour[1:])))


def _is_finite(value: object) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _legend() -> dict[str, Any]:
    muscles = dict(red="#ff0000", green="#00c000", blue="#0000ff", yellow="#ffff00")
    muscles |= dict(cyan="#00ffff", magenta="#ff00ff", orange="#ff8000", purple="#8000ff")
    return {
        "passive": Colour(colour="#808080"),
        "stiff": Colour(colour="#202020", stiffness=10.0),
        **{name: Colour(colour=code, muscle=True) for name, code in muscles.items()},
    }


def unknown_colour(name: str, legend: Iterable[str]) -> str:
    """The sentence for a name that the legend lacks."""
    known = ", ".join(one for one in legend if one != name)
    return f"task.legend has no {name}; known are {known}. Add one with {_addition(name)}."


def _addition(name: str, colour: str = "#rrggbb") -> str:
    """Word of the command line, in quotes for any shell, that adds a colour to the legend."""
    return f"\"+task.legend.{name}={{colour:'{colour}',muscle:true}}\""


def _colour(name: str, entry: Any, legend: Iterable[str]) -> Colour:
    if isinstance(entry, Colour):
        return entry
    known = [one.name for one in fields(Colour)]
    wrong = [key for key in entry if key not in known] if isinstance(entry, Mapping) else []
    if wrong:
        raise ValueError(f"task.legend.{name} has no {wrong[0]}; known are {', '.join(known)}.")
    if not (isinstance(entry, Mapping) and "colour" in entry):
        raise ValueError(unknown_colour(name, legend))
    return Colour(**entry)


@dataclass(kw_only=True)
class ImageConf(OwnConf):
    """A walker drawn in a picture; white and transparent pixels are outside."""

    name: str = "image"
    legend: dict[str, Any] = field(default_factory=_legend)
    """Meaning of the colours by name, a :class:`Colour` each or a dict of its fields."""
    tolerance: float = 64.0
    """Largest distance of a pixel from a colour of the legend, of red, green and blue from 0 to 255 each."""

    def __post_init__(self):
        super().__post_init__()
        not_negative("task", self, "tolerance")
        self.legend = {name: _colour(name, entry, self.legend) for name, entry in self.legend.items()}


def image(conf: ImageConf) -> Task:
    """Build the walker that a picture shows.

    Raises:
        ValueError: The picture cannot be read, has an unknown colour, shows nothing, or a robot that does not fit.
    """
    pixels, kind = _read(conf.path("a picture of the robot"))
    label = _labels(conf, pixels, kind)
    parts = []
    for k, (name, colour) in enumerate(conf.legend.items()):
        angle = None if colour.angle is None else math.radians(colour.angle)
        direction = None if angle is None else (math.cos(angle), math.sin(angle))
        parts.append(Part(name, label == k, colour.muscle, direction, colour.stiffness))
    return drawn(conf, parts)


def _labels(conf: ImageConf, pixels: np.ndarray, kind: str) -> np.ndarray:
    """Number in the legend of each pixel, or the legend's length for paper; ``kind`` is the format of the file."""
    known = np.array([*(colour.rgb for colour in conf.legend.values()), PAPER], dtype=float)
    packed = pixels.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint32)
    codes, index = np.unique(packed, return_inverse=True)
    colours = np.stack([codes >> 16, codes >> 8 & 255, codes & 255], axis=1).astype(float)
    away = np.stack([np.linalg.norm(colours - one, axis=1) for one in known], axis=1)
    nearest = np.where(away.min(axis=1) <= conf.tolerance, away.argmin(axis=1), -1)
    label = _blended(nearest[index.reshape(packed.shape)], pixels, known)
    if (label < 0).any():
        found, count = np.unique(packed[label < 0], return_counts=True)
        code = f"#{found[count.argmax()]:06x}"
        pixel = "pixel" if count.max() == 1 else "pixels"
        has = f"{conf.file} has {count.max()} {pixel} of the colour {code}, which the legend lacks"
        if kind in LOSSY:
            raise ValueError(
                f"{has}; {kind} changes colours as it compresses: save the drawing itself as PNG, since a {kind} that is converted "
                "keeps the changed colours."
            )
        listed = ", ".join(f"{name} {colour.colour}" for name, colour in conf.legend.items())
        raise ValueError(f"{has}; it has {listed}. Repaint, or add the colour: {_addition('NAME', code)}.")
    return label


def _blended(label: np.ndarray, pixels: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Labels, in which an unknown pixel, -1, beside known ones has that of them whose colour is nearest: the blurred edge of a part."""
    row, column = np.nonzero(label < 0)
    around = np.pad(label, 1, constant_values=-1)
    beside = np.stack([around[row + i, column + j] for i in range(3) for j in range(3)], axis=1)
    away = np.linalg.norm(known[beside] - pixels[row, column, None], axis=2)
    chosen = np.where(beside < 0, np.inf, away).argmin(axis=1)
    label = label.copy()
    label[row, column] = beside[np.arange(len(row)), chosen]  # -1 if all are
    return label


def _read(path: Path) -> tuple[np.ndarray, str]:
    """Colours on white paper, shape (row, column, 3), and the format of the file."""
    import PIL.Image
    import PIL.ImageOps

    damaged = (
        ArithmeticError,
        EOFError,
        LookupError,
        OSError,
        SyntaxError,
        TypeError,
        ValueError,
        struct.error,
    )
    try:
        with PIL.Image.open(path, formats=FORMATS) as picture:
            if picture.mode[0] in "IF":
                raise ValueError("it has more than 8 bits for a colour; save it with 8")
            if picture.width * picture.height <= MOST_PIXELS:
                upright = PIL.ImageOps.exif_transpose(picture).convert("RGBA")  # as viewers show it
                paper = PIL.Image.new("RGBA", upright.size, "white")
                flat = PIL.Image.alpha_composite(paper, upright).convert("RGB")
                return np.asarray(flat), str(picture.format)
            size = f"{picture.width} x {picture.height}"
    except (*damaged, PIL.Image.DecompressionBombError) as error:
        raise ValueError(f"{path} cannot be read as a picture ({', '.join(FORMATS)}): {error}") from error
    raise ValueError(
        f"{path} must have at most {MOST_PIXELS} pixels, got {size}; a few for each particle are enough."
    )
