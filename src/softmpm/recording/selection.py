"""Selection of the part of a recording to show, its times and its scales."""

from dataclasses import dataclass

import numpy as np

from softmpm.recording import style
from softmpm.recording.format import PARTS, chosen
from softmpm.recording.reader import Recording

_SAMPLE = 64  # frames that decide the scales and the framing
ALONE = 0.04
"""Time for which a simulation of one frame is on display [s]."""


@dataclass(frozen=True)
class Simulation:
    """One recorded simulation, shown after those before it."""

    iteration: int
    rows: np.ndarray
    """Rows of the recording, shape (frame,)."""
    frame: np.ndarray
    """Number of each frame, counted through all simulations."""
    time: np.ndarray
    """Time of each frame since the first simulation began [s]."""


@dataclass(frozen=True)
class Show:
    """The part of a recording to show."""

    simulations: list[Simulation]
    particle: np.ndarray
    """Indices of the recorded particles that are shown."""
    strain: float
    """Strain at the top of its colour scale [-]."""
    speed: float
    """Speed of the longest arrow [m/s]."""
    traction: float
    """Traction of the longest arrow [Pa]."""
    low: np.ndarray
    """Lower corner of the box to frame [m], shape (dim,)."""
    high: np.ndarray
    """Upper corner of that box [m]."""
    has: dict[str, bool]
    """True for ``activation`` and each quantity of only some frames, such as ``field``, that was recorded."""


def plan(source: Recording, every: int, max_particles: int | None) -> Show:
    """Select each ``every``-th frame and at most ``max_particles`` particles, and choose the scales."""
    particle = chosen(source.particle_count, max_particles)
    simulations = _in_sequence(source, every)
    rows = np.concatenate([np.zeros(0, np.int64), *(simulation.rows for simulation in simulations)])
    some = _spread(rows)
    x = np.concatenate([source.static["positions"], source.read("x", some)[1].reshape(-1, source.dim)])
    x = x[np.isfinite(x).all(-1)]
    low, high = style.frame_box(x.min(0), x.max(0), (source.static["grid_shape"] - 1) * source.spacing)
    has = {name: len(source.recorded(name, rows)) > 0 for name in PARTS}
    has["activation"] = bool(np.isfinite(source.read("activation", some)[1]).any())
    speed, traction = (_longest(source, name, rows) for name in ("field", "traction"))
    strain = _top(source.read("strain", some)[1])
    return Show(simulations, particle, strain or 1.0, speed or 1.0, traction or 1.0, low, high, has)


def _longest(source: Recording, name: str, rows: np.ndarray) -> float:
    """Top of the scale of a field of vectors."""
    some = _spread(source.recorded(name, rows))[:, None]
    return max((_top(np.linalg.norm(source.read(name, row)[1], axis=-1)) for row in some), default=0.0)


def _in_sequence(source: Recording, every: int) -> list[Simulation]:
    simulations, frame, time = [], 0, 0.0
    for iteration in source.episodes:
        rows = source.rows(iteration)[::every]
        if len(rows):
            since = source.read("time", rows)[1]
            at = time + since - since[0]
            simulations.append(Simulation(iteration, rows, frame + np.arange(len(rows)), at))
            pause = (at[-1] - at[0]) / (len(rows) - 1) if len(rows) > 1 else ALONE
            frame, time = frame + len(rows), at[-1] + pause
    return simulations


def _spread(rows: np.ndarray) -> np.ndarray:
    """An evenly spaced sample of the rows."""
    return rows[:: -(-len(rows) // _SAMPLE) or 1]


def _top(values: np.ndarray) -> float:
    """Top of a scale: the 99th percentile of the positive values, or 0 if there are none."""
    values = values[np.isfinite(values) & (values > 0)]
    return float(np.quantile(values, 0.99)) if len(values) else 0.0
