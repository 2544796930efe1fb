"""show: a picture of a scene or of a state as a matplotlib figure, without pyplot, so that nothing global changes."""

import io
import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from softmpm.check_state import check_state
from softmpm.inputs import Inputs
from softmpm.model import Model
from softmpm.pictures.camera import Camera
from softmpm.pictures.colouring import QUANTITIES, Colouring, coloured, values_of
from softmpm.pictures.instant import Instant, array, at_rest, framed, of_state
from softmpm.pictures.panel import Panel
from softmpm.recording.surroundings import Surroundings, of_scene
from softmpm.scene.scene import Scene
from softmpm.state import State
from softmpm.wall_poses import given_poses

WIDTH, TALLEST = 7.0, 6.0
"""Most width of a figure, and most height of its panels together [inch]."""
NARROWEST, LOWEST = 3.6, 1.6
"""Least width of a figure, and least height of its panels together [inch]."""
LABELS = (1.55, 0.45)
"""Room for the labels of the axes and the names of the colours [inch], across and above each other."""
COLOUR_BAR = 0.35
"""Further room across for a colour bar with numbers of six digits and a label [inch]; without it the layout cuts off the label of the y
axis."""
NAMES = 0.65
"""Room across for the names of the colours within that for labels [inch]; a figure with wider ones is wider."""
SQUARE = 1.15
"""Most height of all panels over their width: four worlds that are nearly square are two by two."""
TYPE = (8, 6)
"""Size of the names of colours [point], of up to two columns and of more."""
STROKE = "strokes: fibres"
"""Words beside the colours where fibres are drawn."""


def show(
    model: Model | Scene,
    state: State | None = None,
    *,
    colour: str | Tensor | np.ndarray | None = None,
    activation: Tensor | None = None,
    inputs: Inputs | None = None,
    world: int | Sequence[int] = 0,
    limits: tuple[float, float] | None = None,
    label: str = "",
    axes: Any = None,
) -> Any:
    """Draw a scene or a state: particles, walls, and where there are any surface points and the tractions of the walls.

    ::

        softmpm.show(scene)  # the design, before anything is built
        softmpm.show(model, state, colour="strain").savefig("strain.png")
        softmpm.show(model, state, world=range(4))  # four worlds side by side

    The figure shows itself in a notebook. An arrow above the figure is the scale of the walls' tractions. Driven particles have dark
    edges. Over the colours "muscle" and "activation" strokes show the fibres of muscles, which deform with the body; in 3D those at
    the surface. A 3D scene stands upright: against gravity, or without any with y up.

    Args:
        model: What ``state`` belongs to; a scene is drawn at rest.
        state: State of all worlds; None is the scene at rest. The tractions are those of :func:`softmpm.contact_forces`.
        colour: "speed", "strain" (size of the Green strain), "activation", "muscle", "body", or an array of one number per particle,
            shape (particle,) or (world, particle). None takes the activation if it is given, else the speed, and of a scene at rest the
            muscles, or the bodies if there are none.
        activation: Activation [-], shape (muscle,) or (world, muscle).
        inputs: Of the call that led to ``state``, of which a picture shows the walls at their last pose; None draws them where the
            scene has them.
        world: The world to draw, or several, side by side.
        limits: Ends of the colour scale. None: -1 and 1 for the activation, 0 and the largest value for speed and strain, the lowest
            and the highest of an array.
        label: Of the colour bar, for an array of one's own.
        axes: matplotlib axes to draw into, or one for each world, in place of a figure of its own.

    Returns:
        The ``matplotlib.figure.Figure``.

    Raises:
        ImportError: matplotlib is not installed.
        TypeError, ValueError: An argument has another type or shape; the message names the remedy.
    """
    if not isinstance(model, Model | Scene):
        raise TypeError(f"show needs a model or a scene, got {type(model).__name__}.")
    scene = model if isinstance(model, Scene) else model.scene
    place = of_scene(scene)
    worlds = _whole(world)
    instants = _instants(model, state, activation, inputs, worlds)
    if colour is None:
        at_work = "activation" if activation is not None else "speed"
        colour = at_work if state is not None else ("muscle" if scene.muscles else "body")
    if isinstance(colour, str):
        if colour not in QUANTITIES:
            raise ValueError(f"colour must be one of {', '.join(QUANTITIES)}, or an array, got {colour!r}.")
        values = [values_of(colour, place, instant) for instant in instants]
    else:
        values = _own(colour, worlds, len(place.rest))
    colouring = coloured(colour if isinstance(colour, str) else None, label, place, values, limits)
    titles = [f"world {k}" if len(worlds) > 1 else "" for k in worlds]
    low, high = framed(place, instants)
    figure, panels = panels_of(place, low, high, len(worlds), colouring, longest(instants), axes)
    for panel, instant, one, title in zip(panels, instants, values, titles, strict=True):
        panel.draw(instant, colouring.rgb(one), title)
    if axes is None:
        figure.draw_without_rendering()  # the ticks decide the layout, which decides the ticks: once is not enough
    return figure


def _whole(world: Any) -> tuple[int, ...]:
    """Worlds as integers, of whatever whole numbers."""
    try:
        return tuple(operator.index(k) for k in (world if np.ndim(world) else (world,)))
    except TypeError as error:
        raise TypeError(f"world must be a whole number, or several of these, got {world!r}.") from error


def _instants(
    model: Model | Scene,
    state: State | None,
    activation: Tensor | None,
    inputs: Inputs | None,
    worlds: tuple[int, ...],
) -> list[Instant]:
    """Instant of each world that is drawn."""
    for name, value in {"activation": activation, "inputs": inputs}.items():
        if state is None and value is not None:
            raise ValueError(f"{name} belongs to a state; of a model at rest that is model.rest().")
    if state is None:
        scene = model if isinstance(model, Scene) else model.scene
        return [at_rest(scene)] * len(worlds)
    if isinstance(model, Scene):
        raise TypeError("a state is drawn with its model, got a scene; give softmpm.build(scene).")
    check_state(model, state)
    if not worlds or not all(0 <= k < model.worlds for k in worlds):
        raise ValueError(
            f"world must be between 0 and {model.worlds - 1}, or several of these, got {worlds}."
        )
    shapes = ((model.muscle_count,), (model.worlds, model.muscle_count))
    if activation is not None and tuple(activation.shape) not in shapes:
        raise ValueError(
            f"activation must have shape {shapes[0]} or {shapes[1]}, got {tuple(activation.shape)}; a picture is one instant, so of "
            "many control steps it takes one."
        )
    poses = given_poses(model, inputs)
    pose = None if poses is None else (poses[0][-1], poses[1][-1])
    return [of_state(model, state, activation, k, pose) for k in worlds]


def _own(colour: Tensor | np.ndarray, worlds: tuple[int, ...], count: int) -> list[np.ndarray]:
    """A number for each particle of each world, of the user's own."""
    values = array(colour) if isinstance(colour, Tensor) else np.asarray(colour, dtype=float)
    if values.shape == (count,):
        return [values] * len(worlds)
    if values.ndim != 2 or values.shape[1] != count or len(values) <= max(worlds):
        raise ValueError(f"colour must have shape ({count},) or (world, {count}), got {values.shape}.")
    return [values[k] for k in worlds]


def longest(instants: Sequence[Instant]) -> float:
    """Traction at the top of its scale [Pa]; 0 without any."""
    sizes = (np.linalg.norm(one.traction.sum(0), axis=-1) for one in instants if one.traction is not None)
    return max((float(size[np.isfinite(size)].max(initial=0.0)) for size in sizes), default=0.0)


def panels_of(
    place: Surroundings,
    low: np.ndarray,
    high: np.ndarray,
    count: int,
    colouring: Colouring,
    traction: float,
    axes: Any = None,
) -> tuple[Any, list[Panel]]:
    """A figure, or that of given axes, with a panel for each world and the key of the colours."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("a picture needs the package matplotlib: pip install matplotlib") from error

    class Picture(Figure):
        """Figure that shows itself in a notebook."""

        def _repr_png_(self) -> bytes:
            png = io.BytesIO()
            self.savefig(png, format="png", dpi=110)
            return png.getvalue()

    with _on_white(axes is None):
        if axes is None:
            corners = (low, high) if place.dim == 2 else Camera(low, high, place.up).frame(low, high)
            width, height = corners[1] - corners[0]
            rows, columns = _grid(count, float(height / width))
            size = _size(float(rows * height), float(columns * width), rows, columns, not colouring.names)
            room = size[1]
            figure = Picture(figsize=size, layout="constrained", facecolor="white")
            axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
            for spare in axes[count:]:
                spare.set_axis_off()
            axes = axes[:count]
            lowest = axes[-columns:]
        else:
            axes = np.ravel(np.asarray(axes, dtype=object))
            if len(axes) != count:
                raise ValueError(f"axes must be one for each world, {count}, got {len(axes)}.")
            figure = axes[0].get_figure()
            size, room = None, axes[-1].get_window_extent().height / figure.dpi
            lowest = axes[:0]
        panels = [Panel(one, place, low, high, traction, colouring.with_fibres) for one in axes]
        if traction > 0.0:
            panels[0].draw_scale("traction" if count == 1 else "")  # beside the name of a world
        if place.dim == 2 and count > 1:
            for one in axes:
                one.label_outer()
            for one in lowest:  # also above an empty place
                one.tick_params(labelbottom=True)
                one.set_xlabel("x [m]")
        key = _key(figure, list(axes), colouring, room)
        if size is not None and key is not None:
            _widen(figure, key, size[0] - NAMES)
    return figure, panels


def _on_white(own: bool) -> Any:
    """The look of a figure of our own inside, dark letters on white, whatever style is chosen; of given axes that of their figure."""
    from matplotlib import rc_context

    dark = "text.color", "axes.labelcolor", "axes.edgecolor", "axes.titlecolor", "xtick.color", "ytick.color"
    look: dict[Any, Any] = {**dict.fromkeys(dark, "black"), "axes.grid": False, "lines.linestyle": "-"}
    look |= {"xtick.labelcolor": "inherit", "ytick.labelcolor": "inherit"}
    return rc_context(look if own else {})


def _grid(count: int, ratio: float) -> tuple[int, int]:
    """Rows and columns of panels with this ratio of height to width, so that the figure is about as high as it is wide, or less."""
    columns = next(n for n in range(1, count + 1) if math.ceil(count / n) * ratio / n <= SQUARE or n == count)
    return math.ceil(count / columns), columns


def _size(height: float, width: float, rows: int, columns: int, bar: bool) -> tuple[float, float]:
    """Size of a figure [inch] whose panels, of these sizes together in any unit, leave no empty space; with room for a colour bar."""
    across, above = LABELS[0] + COLOUR_BAR * bar + 0.1 * columns, LABELS[1] + 0.25 * rows
    scale = min((WIDTH - across) / width, TALLEST / height)
    return max(scale * width + across, NARROWEST), max(scale * height, LOWEST) + above


def _widen(figure: Any, key: Any, width: float) -> None:
    """Place the names of the colours beside the panels, which have this width [inch]; the figure becomes as wide as both."""
    across = 1.05 * key.get_window_extent().width / figure.dpi + 0.15  # letters vary with the resolution
    figure.set_figwidth(width + across)
    key.set_in_layout(False)  # the layout of panels of a fixed aspect would not settle
    figure.get_layout_engine().set(rect=(0.0, 0.0, width / (width + across), 1.0))
    key.set_bbox_to_anchor((width / (width + across), 0.5), transform=figure.transFigure)


def _key(figure: Any, axes: list[Any], colouring: Colouring, room: float) -> Any:
    """The colour bar, or the names of the categories in columns of this height [inch], which are returned."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize
    from matplotlib.patches import Patch

    if colouring.names:
        patches = [Patch(facecolor=colour / 255) for colour in colouring.ramp]
        title = STROKE if colouring.with_fibres else None
        lines = [int((72 * room / points - 1.0) / 1.6) for points in TYPE]  # with the space between
        rows = [max(1, count - bool(title)) for count in lines]
        columns = [math.ceil(len(patches) / most) for most in rows]
        small = columns[0] > 2
        look: dict = dict(frameon=False, fontsize=TYPE[small], ncols=columns[small], columnspacing=1.0)
        look |= dict(title=title, title_fontsize=TYPE[small], alignment="left")
        key = axes[-1].legend(handles=patches, loc="center left", bbox_to_anchor=(1.01, 0.5), **look)
        for text, name in zip(key.get_texts(), colouring.names, strict=True):
            text.set(text=name, parse_math=False)  # a name may have the signs that matplotlib gives a meaning
        return key
    ramp = LinearSegmentedColormap.from_list(colouring.label or "values", colouring.ramp / 255)
    bar = figure.colorbar(
        ScalarMappable(Normalize(*colouring.limits), ramp), ax=axes, shrink=0.85, pad=0.02, aspect=25
    )
    bar.set_label(colouring.label + f"; {STROKE}" * colouring.with_fibres, fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.ax.ticklabel_format(useOffset=False)  # values that are nearly equal stand there in full
    return None
