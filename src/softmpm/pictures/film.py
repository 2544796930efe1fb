"""to_video: a recording, or the states of a simulation, as a GIF or an MP4."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from softmpm.check_state import check_state
from softmpm.draft import draft
from softmpm.inputs import Inputs
from softmpm.model import Model, check_model
from softmpm.pictures.colouring import QUANTITIES, coloured, values_of
from softmpm.pictures.encoders import WRITERS
from softmpm.pictures.figure import longest, panels_of
from softmpm.pictures.instant import Instant, Pose, framed, of_state, recorded
from softmpm.recording.reader import Recording
from softmpm.recording.surroundings import Surroundings, of_recording, of_scene
from softmpm.state import State
from softmpm.wall_poses import given_poses

DPI = 100
"""Pixels per inch: a film is 700 pixels wide, and wider with names of colours."""
MOST_OF_A_GIF = 50
"""Pictures per second: viewers slow down shorter ones than two hundredths of a second."""


def to_video(
    source: Recording | str | Path | Sequence[State] | State,
    path: str | Path,
    *,
    model: Model | None = None,
    activation: Tensor | None = None,
    inputs: Inputs | None = None,
    period: float | None = None,
    iteration: int | None = None,
    world: int = 0,
    colour: str | None = None,
    limits: tuple[float, float] | None = None,
    fps: int = 25,
    rate: float = 1.0,
) -> Path:
    """Make a film of a recorded simulation or of states.

    ::

        softmpm.to_video("run.h5", "run.gif")
        softmpm.to_video(states, "jump.mp4", model=model, period=20 * scene.dt, rate=0.2)

    Args:
        source: A recording, states one after the other, or the frames of a :func:`softmpm.trajectory`, which are a state each.
        path: File to write, ``.gif`` or ``.mp4`` (``pip install "softmpm[video]"``). An older one is replaced.
        model: What the states belong to.
        activation: Activation [-] of each state, shape (state, world, muscle).
        inputs: ``wall_offset`` and ``wall_normal`` of these are the pose of the walls at each state, shapes (state, world, wall) and
            (state, world, wall, dim), or one for all states. None draws the walls where the scene has them.
        period: Simulated time between two states [s]; None shows each state in one picture.
        iteration: Recorded simulation to show; None is the last.
        world: The world of the states to show.
        colour, limits: As for :func:`softmpm.show`, with one scale for the whole film. None for ``colour`` is the activation if there
            is any, else the speed.
        fps: Pictures per second, at most 50 in a ``.gif``, which counts in hundredths of a second.
        rate: Simulated time per time of the film; 0.1 is slow motion.

    Returns:
        The path of the film.

    Raises:
        ImportError: matplotlib, or the package that writes an MP4, is not installed; the message names it.
        TypeError, ValueError: An argument has another type or value, or there is nothing to show.
        FileNotFoundError, OSError: The recording cannot be read, see :class:`softmpm.Recording`, or the film not be written; then an
            older one is as it was.
    """
    path = Path(path)
    if path.suffix.lower() not in WRITERS:
        raise ValueError(f"a film is a .gif or .mp4, got {path.name!r}.")
    for name, value in (("fps", fps), ("rate", rate), ("period", 1.0 if period is None else period)):
        if not (np.isfinite(value) and value > 0):
            raise ValueError(f"{name} must be > 0, got {value}.")
    if path.suffix.lower() == ".gif" and fps > MOST_OF_A_GIF:
        raise ValueError(
            f"fps must be at most {MOST_OF_A_GIF} in a .gif, which viewers would play slowly, got {fps}; take an .mp4."
        )
    if colour is not None and colour not in QUANTITIES:
        raise ValueError(f"colour must be one of {', '.join(QUANTITIES)}, got {colour!r}.")
    if isinstance(source, (str, Path, Recording)):
        given = dict(model=model, activation=activation, inputs=inputs, period=period, world=world or None)
        foreign = [name for name, value in given.items() if value is not None]
        if foreign:
            raise ValueError(f"{foreign[0]} belongs to a film of states; a recording has its own.")
    if isinstance(source, str | Path):
        with Recording(source) as recording:
            place, instants = _of_recording(recording, iteration, fps, rate)
    elif isinstance(source, Recording):
        place, instants = _of_recording(source, iteration, fps, rate)
    else:
        place, instants = _of_states(_listed(source), model, activation, inputs, world, period, fps, rate)
    with draft(path) as film:
        WRITERS[path.suffix.lower()](film, _pictures(place, instants, colour, limits), fps)
    return path


def _of_recording(
    recording: Recording, iteration: int | None, fps: float, rate: float
) -> tuple[Surroundings, list[Instant]]:
    if not recording.episodes:
        raise ValueError(f"{recording.path} has no simulation to show.")
    iteration = recording.episodes[-1] if iteration is None else iteration
    rows = recording.rows(iteration)
    if len(rows) == 0:
        raise ValueError(f"{recording.path} has no frames of iteration {iteration} to show.")
    time = recording.read("time", rows)[1]
    if time[-1] < time[0]:
        raise ValueError(
            f"the times of the frames must not fall, got {time[0]:g} s first and {time[-1]:g} s last in {recording.path}."
        )
    chosen = resampled(time, fps, rate)
    found = dict(zip(np.unique(chosen), recorded(recording, rows[np.unique(chosen)]), strict=True))
    return of_recording(recording), _filled([found[k] for k in chosen])


def _filled(instants: list[Instant]) -> list[Instant]:
    """The final state of a simulation has no activation of its own and shows the last one."""
    for k in range(1, len(instants)):
        if instants[k].activation is None:
            instants[k] = replace(instants[k], activation=instants[k - 1].activation)
    return instants


def _listed(states: Sequence[State] | State) -> list[State]:
    """The states one after the other; frames of a trajectory are one state with an axis more."""
    if isinstance(states, State) and states.x.dim() == 4:
        return [states.of_frame(k) for k in range(len(states.x))]
    listed: list[Any] = list(states)
    if not listed or not all(isinstance(state, State) for state in listed):
        raise TypeError(
            "a film needs a recording, at least one softmpm.State in a list, or the frames of a softmpm.trajectory."
        )
    return listed


def _of_states(
    states: list[State],
    model: Model | None,
    activation: Tensor | None,
    inputs: Inputs | None,
    world: int,
    period: float | None,
    fps: float,
    rate: float,
) -> tuple[Surroundings, list[Instant]]:
    check_model(model, "a film of states")
    assert model is not None
    for state in states:
        check_state(model, state)
    if not 0 <= world < model.worlds:
        raise ValueError(f"world must be between 0 and {model.worlds - 1}, got {world}.")
    shape = (len(states), model.worlds, model.muscle_count)
    if activation is not None and tuple(activation.shape) != shape:
        raise ValueError(
            f"activation must have shape {shape}, one row for each state, got {tuple(activation.shape)}."
        )
    poses = _poses(model, inputs, len(states))
    step = rate / fps if period is None else period
    found = {}
    chosen = resampled(step * np.arange(len(states)), fps, rate)
    for k in np.unique(chosen):
        one = of_state(model, states[k], None if activation is None else activation[k], world, poses[k])
        found[k] = replace(one, time=None if period is None else k * step)
    return of_scene(model.scene), [found[k] for k in chosen]


def _poses(model: Model, inputs: Inputs | None, count: int) -> list[Pose | None]:
    """Pose of the walls at each state."""
    found = given_poses(model, inputs)
    if found is None:
        return [None] * count
    if len(found[0]) not in (1, count):
        raise ValueError(
            f"inputs must have one pose of the walls for each of the {count} states, or one for all, got {len(found[0])}; the frames "
            "of a trajectory follow each control step, so for them leave out the first pose: inputs.wall_offset[1:]."
        )
    return [
        (normal, offset)
        for normal, offset in zip(*(v.expand(count, *v.shape[1:]) for v in found), strict=True)
    ]


def resampled(time: np.ndarray, fps: float, rate: float) -> np.ndarray:
    """Frame to show in each picture of a film: the nearest in time."""
    count = int(np.floor((time[-1] - time[0]) * fps / rate + 1e-6)) + 1
    at = time[0] + np.arange(count) * rate / fps
    return np.abs(time[None] - at[:, None]).argmin(1)


def _pictures(
    place: Surroundings, instants: list[Instant], colour: str | None, limits: tuple[float, float] | None
) -> Iterator[np.ndarray]:
    """Pictures of the film, shape (height, width, 3), uint8."""
    if colour is None:
        has = all(instant.activation is not None for instant in instants) and len(place.muscle)
        colour = "activation" if has else "speed"
    values = [values_of(colour, place, instant) for instant in instants]
    colouring = coloured(colour, "", place, values, limits)
    low, high = framed(place, instants)
    figure, (panel,) = panels_of(place, low, high, 1, colouring, longest(instants))
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(DPI)
    times = [instant.time for instant in instants if instant.time is not None]
    span = max(times, default=0.0) - min(times, default=0.0)
    digits = max(2, 2 - math.floor(math.log10(span))) if span > 0 else 2
    canvas = FigureCanvasAgg(figure)
    for instant, one in zip(instants, values, strict=True):
        panel.draw(
            instant, colouring.rgb(one), "" if instant.time is None else f"{instant.time:.{digits}f} s"
        )
        if figure.get_layout_engine() is not None:  # the first picture decides the layout, see show
            figure.draw_without_rendering()
            figure.draw_without_rendering()
            figure.set_layout_engine("none")
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[..., :3]
        yield pixels[: pixels.shape[0] // 2 * 2, : pixels.shape[1] // 2 * 2]  # MP4 needs even sizes
