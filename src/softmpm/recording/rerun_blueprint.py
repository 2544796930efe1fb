"""Blueprint of a Rerun file: its views, their titles, and the entity paths that views and data share. Only this module,
:mod:`softmpm.recording.rerun_export` and :mod:`softmpm.recording.rerun_walls` import rerun.
"""

from softmpm.recording import style
from softmpm.recording.reader import Recording
from softmpm.recording.selection import Show


def blueprint(source: Recording, show: Show):
    """Robot and fields on the left; caption, scalars and curves of the episode on the right; time plays at once."""
    import rerun.blueprint as rrb

    robot, walls = "/scene/robot", "/scene/walls/**"
    main = _space(source, show, legend(source), [f"{robot}/activation", f"{robot}/fibres", walls])
    rest = [_space(source, show, f"strain, 0 to {show.strain:.2g}", [f"{robot}/strain", walls])]
    if show.has["field"]:
        name = f"grid velocity, up to {show.speed:.2g} m/s"
        rest.append(_space(source, show, name, ["/scene/grid/velocity", walls]))
    if show.has["traction"]:
        name = f"traction of the walls, up to {show.traction:.2g} Pa"
        rest.append(_space(source, show, name, [f"{robot}/activation", "/scene/traction", walls]))
    side: list = [rrb.TextDocumentView(origin="/caption", name="now playing")]
    quiet = rrb.PlotLegend(visible=False)
    curves = [rrb.TimeSeriesView(origin=curve(name), name=name, plot_legend=quiet) for name in source.scalars]
    if curves:
        side.append(rrb.Tabs(*curves, active_tab=0))
    for name in ("activation", "latent", "force"):
        if show.has[name]:
            title = "force of the walls [N]" if name == "force" else name
            side.append(rrb.TimeSeriesView(origin=f"/{name}", name=title, plot_legend=quiet))
    left = rrb.Vertical(main, rrb.Horizontal(*rest), row_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Horizontal(
            left, rrb.Vertical(*side, row_shares=[2] + [3] * (len(side) - 1)), column_shares=[5, 2]
        ),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="playing", loop_mode="all"),
        collapse_panels=True,
    )


def _space(source: Recording, show: Show, name: str, contents: list[str]):
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
    up = style.upward(source.static["gravity"].astype(float))
    position, target = style.eye(show.low, show.high, up)
    return rrb.Spatial3DView(
        origin="/",
        contents=contents,
        name=name,
        background=white,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=up),
    )


def legend(source: Recording) -> str:
    """Meaning of red and blue, and of strokes."""
    fibres = source.static["muscle_direction"].any(axis=1)  # zero for a pressure
    muscles = "muscles: red pulls, blue pushes, strokes are fibres"
    pressures = "pressures: red expands, blue contracts"
    if fibres.all():
        return muscles
    return f"{muscles}; {pressures}" if fibres.any() else pressures


def curve(name: str) -> str:
    """Entity of a scalar, whatever characters its name has."""
    import rerun as rr

    return rr.new_entity_path(["scalars", name])
