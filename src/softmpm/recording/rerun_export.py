"""to_rerun: a recording as a Rerun file, for ``rerun run.rrd``. Its views are those of :mod:`softmpm.recording.rerun_blueprint`.

Three time lines: ``time`` plays the recorded simulations one after the other at the speed of the simulation;
``frame`` counts their frames; ``iteration`` is that of the run. A number of an iteration between two recorded
simulations stands on ``time`` at the same fraction of the way between them, so that the losses grow while the
robots play.
"""

import os
import warnings
from pathlib import Path

import numpy as np

from softmpm.checks import check_whole
from softmpm.draft import draft
from softmpm.recording import style
from softmpm.recording.fibres import DARK, STROKES, Fibres
from softmpm.recording.reader import Recording
from softmpm.recording.rerun_blueprint import blueprint, curve
from softmpm.recording.rerun_walls import send_walls
from softmpm.recording.selection import Show, Simulation, plan
from softmpm.recording.surroundings import of_recording

_FOOTER = 12, b"RRF2FOOT"
"""Length of the end of a Rerun file, and what is in it, in the format RRF2 of rerun-sdk 0.41."""
_BLOCK_BYTES = 2**26  # of positions converted at a time


def to_rerun(
    recording: str | Path,
    rrd: str | Path | None = None,
    *,
    every: int = 1,
    max_particles: int | None = None,
) -> Path:
    """Convert a recording to a Rerun file, on any machine, during the run or after it ended in any way.

    Args:
        recording: HDF5 file of a :class:`softmpm.Recorder`.
        rrd: File to write; None puts it beside the recording. An older one is replaced.
        every: Convert each ``every``-th frame only.
        max_particles: Convert this many particles, chosen evenly at random; None for all that were recorded.

    Returns:
        The path of the Rerun file.

    Raises:
        ImportError: rerun is not installed. The recording can be converted later.
        FileNotFoundError, OSError, ValueError: The recording cannot be read, see :class:`softmpm.Recording`, or the Rerun file not be
            written; then an older one is as it was.
    """
    try:
        import rerun as rr
        from rerun.error_utils import RerunWarning
    except ImportError as error:
        raise ImportError(
            "a Rerun file needs the package rerun-sdk (pip install rerun-sdk). Nothing is lost without it: "
            f"{recording} can be converted later, on any machine, with: python -m softmpm {recording}"
        ) from error
    check_whole("every", every)
    if max_particles is not None:
        check_whole("max_particles", max_particles)
    rrd = Path(recording).with_suffix(".rrd") if rrd is None else Path(rrd)
    if rrd.resolve() == Path(recording).resolve():
        raise ValueError(
            f"the Rerun file would replace the recording {recording}; give it another name with rrd=."
        )
    stream = rr.RecordingStream("softmpm")
    with draft(rrd) as place:
        try:
            with Recording(recording) as source, warnings.catch_warnings():
                warnings.simplefilter("error", RerunWarning)  # rerun would warn and leave data out
                show = plan(source, every, max_particles)
                stream.save(place, default_blueprint=blueprint(source, show))
                _log_all(stream, source, show)
            stream.flush()
        except RuntimeError as error:  # Rerun's, where it cannot write
            raise OSError(f"{rrd} cannot be written: {error}") from error
        finally:
            stream.disconnect()
        _need_whole(place, rrd)
    return rrd


def _need_whole(place: Path, rrd: Path) -> None:
    """Raise OSError unless a Rerun file has its end, without which viewers refuse it: Rerun only logs that the disk was full."""
    length, magic = _FOOTER
    size = place.stat().st_size if place.is_file() else 0
    if size >= length:
        with open(place, "rb") as file:
            file.seek(-length, os.SEEK_END)
            if magic in file.read():
                return
    raise OSError(
        f"{rrd} cannot be written: Rerun left an unfinished file of {size} bytes; is there room on the disk, and is Rerun switched on?"
    )


def _log_all(stream, source: Recording, show: Show) -> None:
    _log_static(stream, source, show)
    size = float(np.ptp(source.static["positions"], axis=0).max())
    fibres = Fibres(of_recording(source), max(source.spacing, size / STROKES))
    if len(fibres.particle):
        _log_look_of_fibres(stream, source, fibres)
    for simulation in show.simulations:
        _log_simulation(stream, source, show, simulation, fibres)
    _log_scalars(stream, source, show)


def _log_static(stream, source: Recording, show: Show) -> None:
    import rerun as rr

    if source.dim == 2:  # Rerun's y points down, a robot's up
        stream.log("scene", rr.Transform3D(mat3x3=np.diag([1.0, -1.0, 1.0])), static=True)
    points = rr.Points2D if source.dim == 2 else rr.Points3D
    shown = source.share * len(show.particle) / source.particle_count
    radii = style.radii(source.static["volume"][show.particle], shown, source.dim)
    for name in ("activation", "strain"):
        stream.log(f"scene/robot/{name}", points.from_fields(radii=radii), static=True)
    if not show.has["offsets"]:
        walls = of_recording(source)
        send_walls(stream, source, [], walls.normals[None], walls.offsets[None])
    if source.muscle_names:
        stream.log("activation", rr.SeriesLines(names=source.muscle_names), static=True)
    if show.has["force"]:
        names = [f"wall {k} {axis}" for k in source.static["surface_wall"] for axis in "xyz"[: source.dim]]
        stream.log("force", rr.SeriesLines(names=names), static=True)
    if show.has["traction"]:
        look: dict = dict(colors=[style.TRACTION], radii=0.1 * source.spacing)
        if source.dim == 2:
            look["draw_order"] = 40.0  # before the particles, which have 30
        stream.log("scene/traction", _arrows(source).from_fields(**look), static=True)


def _log_look_of_fibres(stream, source: Recording, fibres: Fibres) -> None:
    look: dict = dict(colors=[DARK.astype(int)], radii=fibres.radius)
    if source.dim == 2:
        look["draw_order"] = 35.0  # between particles and tractions
    stream.log("scene/robot/fibres", _strips(source).from_fields(**look), static=True)


def _times(simulation: Simulation, at: np.ndarray):
    import rerun as rr

    return [
        rr.TimeColumn("time", duration=simulation.time[at]),
        rr.TimeColumn("frame", sequence=simulation.frame[at]),
        rr.TimeColumn("iteration", sequence=np.full(len(at), simulation.iteration)),
    ]


def _log_simulation(stream, source: Recording, show: Show, simulation: Simulation, fibres: Fibres) -> None:
    import rerun as rr

    points = rr.Points2D if source.dim == 2 else rr.Points3D
    rows, count = simulation.rows, len(show.particle)
    block = max(1, _BLOCK_BYTES // (4 * source.dim * source.particle_count))
    for start in range(0, len(rows), block):
        at = np.arange(start, min(start + block, len(rows)))
        every = source.read("x", rows[at])[1]
        x = every[:, show.particle]
        activation = source.read("activation", rows[at])[1]
        colours = {
            "activation": style.activation_colours(source.static, activation)[:, show.particle],
            "strain": style.strain_colours(source.read("strain", rows[at])[1][:, show.particle], show.strain),
        }
        for name, colour in colours.items():
            columns = points.columns(positions=x.reshape(-1, source.dim), colors=colour.ravel())
            stream.send_columns(
                f"scene/robot/{name}", _times(simulation, at), columns.partition([count] * len(at))
            )
        if len(fibres.particle):
            _send_fibres(stream, source, _times(simulation, at), fibres, every)
        if show.has["activation"]:
            _send_series(stream, "activation", _times(simulation, at), activation)
        _log_fields(stream, source, show, simulation, at)
        _log_forces(stream, source, show, simulation, at)
        if show.has["offsets"]:
            _log_poses(stream, source, simulation, at)
        have, latent = source.read("latent", rows[at])
        if len(have):
            _send_series(stream, "latent", _times(simulation, np.searchsorted(rows, have)), latent)
    _log_caption(stream, source, simulation)


def _send_series(stream, name: str, times: list, values: np.ndarray) -> None:
    """Values (frame, series), drawn as lines over time."""
    import rerun as rr

    columns = rr.Scalars.columns(scalars=values.ravel().astype(np.float64))
    stream.send_columns(name, times, columns.partition([values.shape[1]] * len(values)))


def _send_fibres(stream, source: Recording, times: list, fibres: Fibres, x: np.ndarray) -> None:
    """Strokes along the fibres of muscles in each frame; in 3D in front of the dots at the surface."""
    raised = 1.5 * float(style.radii(source.static["volume"].max(), source.share, source.dim))
    strips = np.concatenate([fibres.ends(one.astype(float), raised) for one in x])
    columns = _strips(source).columns(strips=strips)
    stream.send_columns("scene/robot/fibres", times, columns.partition([len(fibres.particle)] * len(x)))


def _log_fields(stream, source: Recording, show: Show, simulation: Simulation, at: np.ndarray) -> None:
    for k in at:
        have, field = source.read("field", simulation.rows[[k]])
        if len(have) == 0:
            if k > 0 or not show.has["field"]:
                continue
            field = np.zeros((1, *(2,) * source.dim, source.dim))  # no arrows of the simulation before
        origins, vectors, colours = style.arrows(field[0], source.spacing, show.speed)
        columns = _arrows(source).columns(origins=origins, vectors=vectors, colors=colours)
        stream.send_columns(
            "scene/grid/velocity", _times(simulation, np.array([k])), columns.partition([len(origins)])
        )


def _log_forces(stream, source: Recording, show: Show, simulation: Simulation, at: np.ndarray) -> None:
    """Forces of the walls as curves, tractions as arrows; no arrows in frames without them."""
    rows = simulation.rows
    have, force = source.read("force", rows[at])
    if len(have):
        when = _times(simulation, np.searchsorted(rows, have))
        _send_series(stream, "force", when, force.reshape(len(have), -1))
    if show.has["traction"]:
        arrows = [(np.zeros((0, source.dim)),) * 2] * len(at)
        have, traction = source.read("traction", rows[at])
        places = source.read("places", have)[1]
        for k, where, one in zip(np.searchsorted(rows[at], have), places, traction, strict=True):
            arrows[k] = style.traction_arrows(where, one, source.spacing, show.traction)
        origins, vectors = (np.concatenate(parts) for parts in zip(*arrows, strict=True))
        columns = _arrows(source).columns(origins=origins, vectors=vectors)
        lengths = [len(origins) for origins, _ in arrows]
        stream.send_columns("scene/traction", _times(simulation, at), columns.partition(lengths))


def _log_poses(stream, source: Recording, simulation: Simulation, at: np.ndarray) -> None:
    """Walls in each frame; in frames without a pose of their own where the scene has them."""
    place, rows = of_recording(source), simulation.rows[at]
    normals, offsets = (
        np.tile(values, (len(at), *[1] * values.ndim)) for values in (place.normals, place.offsets)
    )
    for name, values in (("normals", normals), ("offsets", offsets)):
        have, found = source.read(name, rows)
        values[np.searchsorted(rows, have)] = found
    send_walls(stream, source, _times(simulation, at), normals, offsets)


def _arrows(source: Recording):
    """Kind of arrows in this dimension."""
    import rerun as rr

    return rr.Arrows2D if source.dim == 2 else rr.Arrows3D


def _strips(source: Recording):
    """Kind of lines in this dimension."""
    import rerun as rr

    return rr.LineStrips2D if source.dim == 2 else rr.LineStrips3D


def _log_caption(stream, source: Recording, simulation: Simulation) -> None:
    """Text about the simulation on display: the iteration, its numbers, and the notes of the run."""
    import rerun as rr

    lines = [f"# Iteration {simulation.iteration}", ""]
    for name, (iterations, values) in source.scalars.items():
        lines += [f"- {name}: {value:.6g}" for value in values[iterations == simulation.iteration][-1:]]
    lines += [f"- {name}: {value}" for name, value in source.attributes(simulation.iteration).items()]
    columns = rr.TextDocument.columns(text=["\n".join(lines)], media_type=["text/markdown"])
    stream.send_columns("caption", _times(simulation, np.array([0])), columns)


def _log_scalars(stream, source: Recording, show: Show) -> None:
    import rerun as rr

    starts = [(s.iteration, s.time[0]) for s in show.simulations]
    starts += [(s.iteration + 1, s.time[-1]) for s in show.simulations[-1:]]
    known, time = np.array(sorted(starts)).T if starts else (np.zeros(1), np.zeros(1))
    for name, (iterations, values) in source.scalars.items():
        times = [
            rr.TimeColumn("iteration", sequence=iterations),
            rr.TimeColumn("time", duration=np.interp(iterations, known, time)),
        ]
        _send_series(stream, curve(name), times, values[:, None])
