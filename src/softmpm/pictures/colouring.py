"""Colours of particles: the quantity that they show, its scale, and its colour map. NumPy only."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softmpm.pictures.instant import Instant
from softmpm.recording import style
from softmpm.recording.surroundings import Surroundings

QUANTITIES = ("speed", "strain", "activation", "muscle", "body")
LABELS = {"speed": "speed [m/s]", "strain": "size of the Green strain [-]", "activation": "activation [-]"}
PASSIVE = style.BODY[0]
"""Particles without a value, such as those of no muscle."""
SPEED = np.array([(206, 212, 220), (136, 186, 214), (48, 124, 188), (22, 64, 134), (12, 22, 64)], float)
ACTIVATION = np.array([style.EXTEND, style.MUSCLE_SHADE * PASSIVE, style.CONTRACT])
VALUES = np.array([(38, 14, 96), (134, 24, 146), (214, 74, 108), (248, 150, 58), (246, 228, 90)], float)
CATEGORIES = np.array(
    [
        *((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167), (86, 180, 233), (213, 94, 0)),
        *((240, 228, 66), (94, 60, 153), (120, 70, 20), (0, 90, 70), (150, 20, 60), (90, 90, 96)),
    ],
    float,
)
"""The colours of Okabe and Ito (2008), which colour-blind people can tell apart, and darker ones; :func:`categories` has more."""
NAMED = {
    **dict(red=(214, 39, 40), green=(44, 160, 44), blue=(31, 90, 200), yellow=(240, 228, 66)),
    **dict(cyan=(23, 190, 207), magenta=(220, 50, 200), orange=(255, 127, 14), purple=(110, 60, 170)),
    **dict(brown=(120, 70, 20), pink=(247, 160, 200), black=(20, 20, 24)),
}
"""Colours of categories that are called by one: a muscle called red must not be drawn blue."""


@dataclass(frozen=True)
class Colouring:
    """Map from values to colours."""

    label: str
    """Quantity and unit; empty for categories."""
    ramp: np.ndarray
    """Colours from the lower to the upper end of the scale, or those of the categories, shape (stop, 3), 0 to 255."""
    limits: tuple[float, float] = (0.0, 1.0)
    """Ends of the scale."""
    names: tuple[str, ...] = ()
    """Of categories; their values are 0, 1, ..."""
    with_fibres: bool = False
    """True for a quantity of muscles, with which their fibres are drawn."""

    def rgb(self, values: np.ndarray) -> np.ndarray:
        """Colours of values, shape (particle, 3), 0 to 255; what is not finite is passive."""
        known = np.isfinite(values)
        if self.names:
            colours = self.ramp[np.where(known, values, 0).astype(int)]
        else:
            low, high = self.limits
            at = np.clip((np.where(known, values, low) - low) / (high - low), 0.0, 1.0) * (len(self.ramp) - 1)
            stops = np.arange(len(self.ramp))
            colours = np.stack([np.interp(at, stops, channel) for channel in self.ramp.T], -1)
        return np.where(known[:, None], colours, PASSIVE)


def of_names(names: Sequence[str]) -> np.ndarray:
    """Different colours of categories, shape (name, 3), 0 to 255; those called by a colour have it."""
    words = [name.lower() for name in names]
    own = [NAMED.get(word) if words.count(word) == 1 else None for word in words]
    given = np.array([colour for colour in own if colour], float)
    others = iter(categories(len(names), given if len(given) else CATEGORIES)[len(given) :])
    return np.array([colour or next(others) for colour in own], float).reshape(-1, 3)


def categories(count: int, first: np.ndarray = CATEGORIES) -> np.ndarray:
    """Different colours, shape (count, 3), 0 to 255: the first ones, then the farthest from all before, paper and grey."""
    taken = first[:count]
    if count <= len(first):
        return taken
    levels = np.linspace(0.0, 255.0, max(9, math.ceil((8 * count) ** (1 / 3))))
    every = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(-1, 3)
    apart = np.full(len(every), np.inf)
    for colour in (np.full(3, 255.0), PASSIVE, *taken):
        apart = np.minimum(apart, _difference(every, colour))
    while len(taken) < count:
        taken = np.vstack([taken, every[apart.argmax()]])
        apart = np.minimum(apart, _difference(every, taken[-1]))
    return taken


def _difference(colours: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Square of a distance, shape (colour,): of red, green and blue, of which the eye tells green apart best."""
    return (colours - colour) ** 2 @ np.array((2.0, 4.0, 3.0))


def values_of(colour: str, place: Surroundings, instant: Instant) -> np.ndarray:
    """Values of one of :data:`QUANTITIES` at each particle, shape (particle,); NaN where there is none."""
    if colour == "speed":
        return instant.speed
    if colour == "strain":
        return instant.strain
    if colour == "body":
        return place.body.astype(float)
    found = np.full(len(instant.positions), np.nan)
    if colour == "muscle":
        for k, members in enumerate(place.muscle):
            found[members] = k
        return found
    if instant.activation is None:
        raise ValueError("colour='activation' needs the activation of each muscle; give activation=….")
    active = place.muscle.any(0)
    found[active] = (instant.activation @ place.muscle.astype(float))[active]
    return found


def coloured(
    colour: str | None,
    label: str,
    place: Surroundings,
    values: Sequence[np.ndarray],
    limits: tuple[float, float] | None,
) -> Colouring:
    """Colours of values that are shown together; None for ``colour`` is an array of the user's own."""
    with_fibres = colour in ("muscle", "activation") and bool(place.fibre.any())
    if colour in ("muscle", "body"):
        bodies = (f"body {k}" for k in range(int(place.body.max()) + 1))
        names = place.actuators if colour == "muscle" else tuple(bodies)
        if not names:
            raise ValueError("colour 'muscle' needs a scene with muscles or pressures; take 'body'.")
        return Colouring("", of_names(names), names=names, with_fibres=with_fibres)
    if limits is not None:
        ends = [float(end) for end in limits]
        if not (len(ends) == 2 and np.isfinite(ends).all() and ends[0] < ends[1]):
            raise ValueError(f"limits must be two numbers in ascending order, got {limits}.")
        limits = ends[0], ends[1]
    if colour == "activation":
        return Colouring(LABELS[colour], ACTIVATION, limits or (-1.0, 1.0), with_fibres=with_fibres)
    ramp = {"speed": SPEED, "strain": style.STRAIN, None: VALUES}[colour]
    return Colouring(LABELS.get(colour or "", label), ramp, limits or _span(values, colour is None))


def _span(values: Sequence[np.ndarray], from_lowest: bool) -> tuple[float, float]:
    """Ends of a scale that has all values, from the lowest or from 0; of length one if there is nothing to tell apart."""
    every = np.concatenate([np.ravel(one) for one in values])
    every = every[np.isfinite(every)]
    if every.size == 0:
        return 0.0, 1.0
    low, high = float(every.min()) if from_lowest else 0.0, float(every.max())
    return (low, high) if high > low else (low, low + 1.0)
