"""to_rerun: a recording as a Rerun file, to look at with ``rerun run.rrd``. The only module that imports rerun, inside.

Three time lines: ``time`` plays the recorded simulations one after the other at the speed of the simulation; ``frame``
counts their frames; ``iteration`` is that of the run. A number of an iteration between two recorded simulations stands on
``time`` at the same fraction of the way between them, so that the losses grow while the robots play.
"""

import os
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softmpm import appearance
from softmpm.playback import Recording

_BLOCK_BYTES = 2**26  # of positions converted at a time
_SAMPLE = 64  # frames that decide the colour scales and the framing


def to_rerun(
    recording: str | Path, rrd: str | Path | None = None, *, every: int = 1, max_particles: int | None = None
) -> Path:
    """Convert a recording to a Rerun file, on any machine, while the run goes on or after it ended in any way.

    Args:
        recording: HDF5 file of a :class:`softmpm.Recorder`.
        rrd: File to write; None puts it beside the recording. An older one is replaced.
        every: Convert each ``every``-th frame only.
        max_particles: Convert this many particles, chosen evenly at random; None for all that were recorded.

    Returns:
        The path of the Rerun file.

    Raises:
        ImportError: rerun is not installed. The recording can be converted later.
        FileNotFoundError, OSError, ValueError: The recording cannot be read; see :class:`softmpm.Recording`.
    """
    try:
        import rerun as rr
        from rerun.error_utils import RerunWarning
    except ImportError as error:
        raise ImportError(
            "a Rerun file needs the package rerun-sdk (pip install rerun-sdk). Nothing is lost without it: "
            f"{recording} can be converted later, on any machine, with: python -m softmpm {recording}"
        ) from error
    for name, value in (("every", every), ("max_particles", max_particles)):
        if value is not None and value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}.")
    rrd = Path(recording).with_suffix(".rrd") if rrd is None else Path(rrd)
    draft = rrd.with_name(f"{rrd.name}.new")
    with Recording(recording) as source, warnings.catch_warnings():
        warnings.simplefilter("error", RerunWarning)  # rerun would warn and leave data out
        show = _plan(source, every, max_particles)
        stream = rr.RecordingStream("softmpm")
        try:
            stream.save(draft, default_blueprint=_blueprint(source, show))
            _log_static(stream, source, show)
            for simulation in show.simulations:
                _log_simulation(stream, source, show, simulation)
            _log_scalars(stream, source, show)
            stream.flush()
        finally:
            stream.disconnect()
    os.replace(draft, rrd)
    return rrd


@dataclass(frozen=True)
class _Simulation:
    iteration: int
    rows: np.ndarray
    frame: np.ndarray  # of each row, counted over the file
    time: np.ndarray  # of each row, since the first simulation began [s]


@dataclass(frozen=True)
class _Show:
    """What is shown of a recording, and on which scales."""

    simulations: list[_Simulation]
    particle: np.ndarray
    strain: float
    speed: float
    low: np.ndarray
    high: np.ndarray
    has: dict[str, bool]


def _plan(source: Recording, every: int, max_particles: int | None) -> _Show:
    particle = np.arange(source.particle_count)
    if max_particles is not None and max_particles < len(particle):
        particle = np.sort(np.random.default_rng(0).choice(particle, max_particles, replace=False))
    simulations, frame, time = [], 0, 0.0
    for iteration in source.episodes:
        rows = source.rows(iteration)[::every]
        if len(rows):
            since = source.read("time", rows)[1]
            at = time + since - since[0]
            simulations.append(_Simulation(iteration, rows, frame + np.arange(len(rows)), at))
            frame, time = frame + len(rows), at[-1] + (at[-1] - at[0]) / max(len(rows) - 1, 1)
    rows = np.concatenate([s.rows for s in simulations]) if simulations else np.zeros(0, np.int64)
    sample = rows[:: -(-len(rows) // _SAMPLE) or 1]
    x = np.concatenate([source.read("x", sample)[1].reshape(-1, source.dim), source.static["positions"]])
    x = x[np.isfinite(x).all(-1)]
    fields = source.read("field", rows)[0]
    fields = source.read("field", fields[:: -(-len(fields) // _SAMPLE) or 1])[1]
    upper = (source.static["grid_shape"] - 1) * source.spacing
    low, high = appearance.frame_box(x.min(0), x.max(0), upper)
    has = {"field": len(fields) > 0, "latent": len(source.read("latent", rows[:1])[0]) > 0}
    has["activation"] = bool(np.isfinite(source.read("activation", sample)[1]).any())
    return _Show(
        simulations,
        particle,
        _scale(source.read("strain", sample)[1]),
        _scale(np.linalg.norm(fields, axis=-1)),
        low,
        high,
        has,
    )


def _scale(values: np.ndarray) -> float:
    """Top of a scale: nearly the largest value, of those that are not 0."""
    values = values[np.isfinite(values) & (values > 0)]
    return float(np.quantile(values, 0.99)) if len(values) else 1.0


def _log_static(stream, source: Recording, show: _Show) -> None:
    import rerun as rr

    if source.dim == 2:  # Rerun's y points down, a robot's up
        stream.log("scene", rr.Transform3D(mat3x3=np.diag([1.0, -1.0, 1.0])), static=True)
    points, order = (rr.Points2D, {"draw_order": 10.0}) if source.dim == 2 else (rr.Points3D, {})
    shown = len(show.particle) / source.particle_count
    # particles of the recording may already be a part of the model's; their volumes still tell the spacing of all
    shown *= source.particle_count / (source.static["particle"].max() + 1)
    radii = appearance.radii(source.static["volume"][show.particle], shown, source.dim)
    for name in ("activation", "strain"):
        stream.log(f"scene/robot/{name}", points.from_fields(radii=radii, **order), static=True)
    _log_walls(stream, source)
    for name, width in (("activation", len(source.static["muscle"])), ("latent", 0)):
        if width and show.has[name]:
            names = [f"muscle {k}" for k in range(width)]
            stream.log(name, rr.SeriesLines(names=names), static=True)


def _log_walls(stream, source: Recording) -> None:
    import rerun as rr

    static = source.static
    upper = (static["grid_shape"] - 1) * source.spacing
    for k, (normal, offset) in enumerate(zip(static["wall_normal"], static["wall_offset"], strict=True)):
        outline = appearance.wall_outline(normal.astype(float), float(offset), upper)
        colour = appearance.WALL.get(static["wall_contact"][k], (120, 120, 120))
        if len(outline) == 0:
            continue
        if source.dim == 2:
            strokes = appearance.hatch(outline, normal, 2 * source.spacing)
            lines = rr.LineStrips2D([outline, *strokes], colors=[colour], radii=0.12 * source.spacing, draw_order=0)
            stream.log(f"scene/walls/{k}", lines, static=True)
        else:
            fan = np.array([(0, i, i + 1) for i in range(1, len(outline) - 1)])
            sheet = rr.Mesh3D(vertex_positions=outline, triangle_indices=fan, albedo_factor=(*colour, 70))
            edge = rr.LineStrips3D([np.vstack([outline, outline[:1]])], colors=[colour], radii=0.15 * source.spacing)
            stream.log(f"scene/walls/{k}", sheet, static=True)
            stream.log(f"scene/walls/{k}/edge", edge, static=True)


def _times(simulation: _Simulation, at: np.ndarray):
    import rerun as rr

    return [
        rr.TimeColumn("time", duration=simulation.time[at]),
        rr.TimeColumn("frame", sequence=simulation.frame[at]),
        rr.TimeColumn("iteration", sequence=np.full(len(at), simulation.iteration)),
    ]


def _log_simulation(stream, source: Recording, show: _Show, simulation: _Simulation) -> None:
    import rerun as rr

    points = rr.Points2D if source.dim == 2 else rr.Points3D
    rows, count = simulation.rows, len(show.particle)
    block = max(1, _BLOCK_BYTES // (4 * source.dim * source.particle_count))
    for start in range(0, len(rows), block):
        at = np.arange(start, min(start + block, len(rows)))
        x = source.read("x", rows[at])[1][:, show.particle]
        activation = source.read("activation", rows[at])[1]
        colours = {
            "activation": appearance.activation_colours(source.static, activation)[:, show.particle],
            "strain": appearance.strain_colours(source.read("strain", rows[at])[1][:, show.particle], show.strain),
        }
        for name, colour in colours.items():
            columns = points.columns(positions=x.reshape(-1, source.dim), colors=colour.ravel())
            stream.send_columns(
                f"scene/robot/{name}", _times(simulation, at), columns.partition([count] * len(at))
            )
        if show.has["activation"]:
            _send_series(stream, "activation", _times(simulation, at), activation)
        _log_fields(stream, source, show, simulation, at)
        have, latent = source.read("latent", rows[at])
        if len(have):
            _send_series(stream, "latent", _times(simulation, np.searchsorted(rows, have)), latent)
    _log_caption(stream, source, simulation)


def _send_series(stream, name: str, times: list, values: np.ndarray) -> None:
    """Values (frame, series), drawn as lines over time."""
    import rerun as rr

    columns = rr.Scalars.columns(scalars=values.ravel().astype(np.float64))
    stream.send_columns(name, times, columns.partition([values.shape[1]] * len(values)))


def _log_fields(stream, source: Recording, show: _Show, simulation: _Simulation, at: np.ndarray) -> None:
    import rerun as rr

    kind = rr.Arrows2D if source.dim == 2 else rr.Arrows3D
    for k in at:
        have, field = source.read("field", simulation.rows[[k]])
        if len(have) == 0:
            continue
        origins, vectors, colours = appearance.arrows(field[0], source.spacing, show.speed)
        columns = kind.columns(origins=origins, vectors=vectors, colors=colours)
        stream.send_columns(
            "scene/grid/velocity", _times(simulation, np.array([k])), columns.partition([len(origins)])
        )


def _log_caption(stream, source: Recording, simulation: _Simulation) -> None:
    """What is playing: the iteration, its numbers, and what the run noted about it."""
    import rerun as rr

    lines = [f"# Iteration {simulation.iteration}", ""]
    for name, (iterations, values) in source.scalars.items():
        lines += [f"- {name}: {value:.6g}" for value in values[iterations == simulation.iteration][-1:]]
    lines += [f"- {name}: {value}" for name, value in source.attributes(simulation.iteration).items()]
    columns = rr.TextDocument.columns(text=["\n".join(lines)], media_type=["text/markdown"])
    stream.send_columns("caption", _times(simulation, np.array([0])), columns)


def _log_scalars(stream, source: Recording, show: _Show) -> None:
    import rerun as rr

    starts = [(s.iteration, s.time[0]) for s in show.simulations]
    starts += [(s.iteration + 1, s.time[-1]) for s in show.simulations[-1:]]
    known, time = np.array(sorted(starts)).T if starts else (np.zeros(1), np.zeros(1))
    for name, (iterations, values) in source.scalars.items():
        times = [
            rr.TimeColumn("iteration", sequence=iterations),
            rr.TimeColumn("time", duration=np.interp(iterations, known, time)),
        ]
        _send_series(stream, f"scalars/{name}", times, values[:, None])


def _blueprint(source: Recording, show: _Show):
    import rerun.blueprint as rrb

    robot, walls = "/scene/robot", "/scene/walls/**"
    main = _space(source, show, "muscles: red pulls, blue pushes", [f"{robot}/activation", walls])
    rest = [_space(source, show, f"strain, 0 to {show.strain:.2g}", [f"{robot}/strain", walls])]
    if show.has["field"]:
        name = f"grid velocity, up to {show.speed:.2g} m/s"
        rest.append(_space(source, show, name, ["/scene/grid/velocity", walls]))
    side = [rrb.TextDocumentView(origin="/caption", name="now playing")]
    curves = [rrb.TimeSeriesView(origin=f"/scalars/{name}", name=name) for name in source.scalars]
    if curves:
        side.append(rrb.Tabs(*curves, active_tab=0))
    for name in ("activation", "latent"):
        if show.has[name]:
            side.append(rrb.TimeSeriesView(origin=f"/{name}", name=name))
    left = rrb.Vertical(main, rrb.Horizontal(*rest), row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*side), column_shares=[5, 2]),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="playing", loop_mode="all"),
        collapse_panels=True,
    )


def _space(source: Recording, show: _Show, name: str, contents: list[str]):
    """A view of the scene that stands upright and shows the robot's whole way."""
    import rerun.blueprint as rrb

    white = rrb.Background(color=[252, 252, 252])
    if source.dim == 2:
        bounds = rrb.VisualBounds2D(
            x_range=[show.low[0], show.high[0]], y_range=[-show.high[1], -show.low[1]]
        )
        return rrb.Spatial2DView(
            origin="/", contents=contents, name=name, visual_bounds=bounds, background=white
        )
    gravity = source.static["gravity"].astype(float)
    up = -gravity / np.linalg.norm(gravity) if gravity.any() else np.array([0.0, 1.0, 0.0])
    position, target = appearance.eye(show.low, show.high, up)
    return rrb.Spatial3DView(
        origin="/",
        contents=contents,
        name=name,
        background=white,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=up),
    )
