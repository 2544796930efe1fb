"""The pictures of a run: the loss, the latent space and the robot. Plain arrays in, PNG files out."""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from softmpm import Scene, fibre_strokes
from softmpm_learn.figures import canvas

VALUES = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Values of each latent feature in ``latent_figure``, the others being 0."""
STILL = 0.1
"""Nodes that never move at this share of the highest speed are cut off around a latent picture."""
AROUND = 0.3
"""Margin around the places where a robot comes, over the height of the picture."""
EQUAL = 0.1
"""Change of a decoded velocity with its feature, over the largest speed, below which the columns of the feature look equal."""
GAP = 0.08
"""Gap between two latent pictures, over their longer side."""
STROKES, WIDTH = 24, 0.05
"""Number of strokes along fibres that would follow each other along the longer side of a picture of the robot, and the width of one in
distances between two."""
PALE = 0.6
"""Activation from which on strokes are light, since the colours of muscles are dark."""
LINE = 0.15
"""Height of a further line of words below the pictures of a robot [inch]."""
UNIFORM = 1e-5
"""Relative difference of a material below which it is uniform: rounding in single precision."""
PASSIVE = "#8d99a6"
"""Colour of particles of no muscle."""
SIGNED = "RdBu"
"""Red is negative, blue is positive, as in the workshop paper's Fig. 5."""


def loss_figure(path: Path, curves: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> None:
    """Draw curves over the iterations, one panel each; that of the loss also shows its lowest value so far. A few values that would
    flatten the others are marked at the edge, and the farthest stands above it.

    Args:
        curves: For each name the iterations and the values; values that are not finite leave gaps.
    """
    names = [
        name for name, (_, values) in curves.items() if np.isfinite(np.asarray(values, dtype=float)).any()
    ]
    figure, first = canvas.figure(7.0, 1.2 + 2.0 * max(1, len(names))), None
    for place, name in enumerate(names):
        iteration, value = (np.asarray(array, dtype=float) for array in curves[name])
        axes = figure.add_subplot(len(names), 1, place + 1, sharex=first)
        first = first or axes
        if name == "loss":  # wide and below, since it is the curve itself where that falls
            axes.plot(
                iteration, np.fmin.accumulate(value), color="#f2bd6b", linewidth=6, label="lowest so far"
            )
        axes.plot(iteration, value, color="#1f5fa8", label=name)
        alone = canvas.alone(value)
        axes.plot(iteration[alone], value[alone], "o", color="#1f5fa8", markersize=4)
        if name == "loss":
            axes.legend(frameon=False)
        axes.set_title(name, fontsize=9, loc="left")
        scale = canvas.scale(value)
        axes.set_yscale(scale)
        canvas.limit(axes, canvas.limits(value, scale), [(iteration, value, "#1f5fa8")])
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0.01)
        if place == len(names) - 1:
            axes.set_xlabel("iteration")
            axes.xaxis.get_major_locator().set_params(integer=True)
    canvas.save(figure, path, dpi=120)


def latent_figure(path: Path, fields: np.ndarray) -> None:
    """Draw what each latent feature means, one row each: decoded from −1 to 1; x velocity left, y right.

    Args:
        fields: Decoded velocity with the feature set to each of ``VALUES``, in any unit, shape
            (feature, value, *nodes, dim). Of a 3D field the middle slice along its last axis is drawn.
    """
    if fields.ndim == 6:
        fields = fields[:, :, :, :, fields.shape[4] // 2]
    fields = _moving(fields)
    features, steps, nx, ny, _ = fields.shape
    plane = fields[..., :2]
    limit = np.abs(plane).max(axis=(1, 2, 3, 4), keepdims=True)  # each feature has a scale of its own
    shares = np.moveaxis(plane / np.maximum(limit, 1e-12), 4, 1).reshape(features, 2 * steps, nx, ny)
    gap = max(1, round(GAP * max(nx, ny)))
    framed = np.pad(shares, ((0, 0), (0, 0), (0, gap), (0, gap)), constant_values=np.nan)
    # From left to right the columns, from below the features, the last one first:
    mosaic = framed[::-1].transpose(0, 3, 1, 2).reshape(features * (ny + gap), -1)[:-gap, :-gap]
    width = 2 * steps * 1.1 * (nx / ny) ** 0.5
    figure = canvas.figure(width + 0.4, width * mosaic.shape[0] / mosaic.shape[1] + 0.5)
    panel = figure.add_subplot()
    panel.imshow(mosaic, origin="lower", cmap=SIGNED, vmin=-1.0, vmax=1.0, interpolation="nearest")
    titles = [f"{axis}, {_value(step, steps):g}".replace("-", "−") for axis in "xy" for step in range(steps)]
    panel.set_xticks((nx - 1) / 2 + (nx + gap) * np.arange(2 * steps), titles, fontsize=7)
    rows = [f"feature {features - k}" for k in range(features)]
    panel.set_yticks(
        (ny - 1) / 2 + (ny + gap) * np.arange(features), rows, fontsize=8, rotation=90, va="center"
    )
    panel.tick_params(length=0, labeltop=True, labelbottom=False)
    panel.spines[:].set_visible(False)
    what = (
        "velocity along x or y where the feature has this value and the others are 0; red: to the left, down; blue: to the right, up; "
        "a scale for each feature"
    )
    changes = np.ptp(plane, axis=1).max(axis=(1, 2, 3))  # with the value of the feature
    equal = np.flatnonzero(changes <= EQUAL * limit.ravel())
    if len(equal):
        which = ("features " if len(equal) > 1 else "feature ") + ", ".join(str(1 + k) for k in equal)
        what += f"\nnearly equal columns: the velocity hardly depends on {which}"
    figure.supxlabel(what, fontsize=7)
    canvas.save(figure, path, dpi=120)


def _moving(fields: np.ndarray) -> np.ndarray:
    """The part of the grid where anything moves, with a margin."""
    speed = np.abs(fields).max(axis=(0, 1, 4))
    for axis in (0, 1):
        moving = np.flatnonzero(speed.max(axis=1 - axis) > STILL * speed.max())
        if moving.size:
            part = slice(max(moving[0] - 1, 0), moving[-1] + 2)
            fields = fields[:, :, part] if axis == 0 else fields[:, :, :, part]
    return fields


def _value(step: int, steps: int) -> float:
    return VALUES[step] if steps == len(VALUES) else -1.0 + 2.0 * step / max(1, steps - 1)


def robot_figure(
    path: Path,
    scene: Scene,
    frames: Sequence[tuple[str, np.ndarray, np.ndarray | None]],
    design: Mapping[str, tuple[np.ndarray, str]],
    *,
    goal: np.ndarray | None = None,
) -> None:
    """Draw the robot along an episode, and what co-design made of its materials.

    Args:
        frames: Of each picture the title, positions (particle, dim) and activation (muscle,) or None.
        design: Of each material its value on each particle (particle,) and its unit; drawn at rest, a uniform one is written below.
        goal: Where the robot should go, drawn as a black cross.
    """
    drawn = {name: both for name, both in design.items() if not _is_uniform(both[0])}
    words = _words(design, goal is not None)
    way = np.concatenate(
        [positions[:, 0] for _, positions, _ in frames] + ([goal[:1]] if goal is not None else [])
    )
    low, high = _window(scene, way)
    ratio = (high[1] - low[1]) / (high[0] - low[0])
    columns = 1 if ratio < 0.45 else 2  # a high world is drawn half as wide
    rows = -(-len(frames) // columns)
    above = rows * (7.4 / columns * ratio + 0.25) + LINE * words.count("\n")
    below = _height(scene, len(drawn)) if drawn else 0.0
    figure = canvas.figure(8.0, above + below + 0.3)
    parts = figure.subfigures(2, 1, height_ratios=[above, below]) if drawn else np.array([figure])
    panels = parts[0].subplots(rows, columns, squeeze=False).ravel()
    for panel, (title, positions, activation) in zip(panels, frames, strict=False):
        _draw_robot(panel, scene, positions, activation, (low, high), inches=7.4 / columns)
        if goal is not None:
            panel.plot(goal[0], goal[1], marker="X", color="black", markersize=9, markeredgecolor="white")
        panel.set_title(title, fontsize=8, loc="left")
    for panel in panels[len(frames) :]:
        panel.set_axis_off()
    parts[0].supxlabel(words, fontsize=7)
    if drawn:
        _draw_design(parts[1], scene, drawn)
    canvas.save(figure, path, dpi=130)


def _words(design: Mapping[str, tuple[np.ndarray, str]], goal: bool) -> str:
    """Words below the pictures of the robot: what they show, and in further lines the uniform materials."""
    what = (
        "x and y [m]; muscles are red where they pull, blue where they push; strokes: fibres"
        + "; cross: goal" * goal
    )
    known = [(name, np.nanmax(value), unit) for name, (value, unit) in design.items() if _is_uniform(value)]
    uniform = ", ".join(f"{name} {value:.5g} {unit}".rstrip() for name, value, unit in known)
    return "\n".join([what, *textwrap.wrap(f"uniform: {uniform}" * bool(known), 130)])


def _is_uniform(value: np.ndarray) -> bool:
    """True of a material that is the same on all particles that have it."""
    return bool(np.nanmax(value) - np.nanmin(value) <= UNIFORM * np.nanmax(np.abs(value)))


def _height(scene: Scene, panels: int) -> float:
    """Height of so many pictures of the materials beside each other, with titles and scales [inch]."""
    extent = np.ptp(scene.positions, axis=0)
    return min(2.3, 0.9 + 8.0 / panels * extent[1] / extent[0])


def _draw_design(part, scene: Scene, design: Mapping[str, tuple[np.ndarray, str]]) -> None:
    """Each material on the shape at rest, with a scale of its own; grey where there is none, as of strengths outside of muscles."""
    from matplotlib import colormaps

    rest = scene.positions
    order, extent = _from_behind(rest), np.ptp(rest, axis=0)
    size = _dot(scene, rest, min(2.2 if extent[0] > extent[1] else 1.6, 7.4 / len(design)))
    look: dict = dict(s=size, cmap=colormaps["viridis"].with_extremes(bad=PASSIVE), linewidths=0)
    panels = part.subplots(1, len(design), squeeze=False)[0]
    for panel, (name, (value, unit)) in zip(panels, design.items(), strict=True):
        dots = panel.scatter(*rest[order, :2].T, c=value[order], plotnonfinite=True, **look)
        panel.set(xticks=[], yticks=[], aspect="equal")
        title = f"{name} [{unit}]" if unit else name
        panel.set_title(textwrap.fill(title, 120 // len(design)), fontsize=8)
        bar = part.colorbar(dots, ax=panel, location="bottom", shrink=0.8).ax
        bar.tick_params(labelsize=6)
        bar.xaxis.get_offset_text().set_fontsize(6)


def _depth(positions: np.ndarray) -> np.ndarray:
    """Place along z, which points out of the picture [m], shape (particle,); 0 in 2D."""
    return positions[:, 2:].sum(axis=1)


def _from_behind(positions: np.ndarray) -> np.ndarray:
    """Order in which particles are drawn, so that near ones cover those behind."""
    return np.argsort(_depth(positions), kind="stable")


def _seen(positions: np.ndarray, spacing: float) -> np.ndarray:
    """Particles that no other one covers, shape (particle,), boolean: the nearest in each column of cells, and those less than a cell
    behind it."""
    depth = _depth(positions)
    columns, column = np.unique(np.floor(positions[:, :2] / spacing), axis=0, return_inverse=True)
    nearest = np.full(len(columns), -np.inf)
    np.fmax.at(nearest, column.ravel(), depth)
    return depth > nearest[column.ravel()] - spacing


def _window(scene: Scene, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the part of the world that is drawn: all of its height and, of its length, these places with a margin."""
    high = (np.array(scene.grid.shape[:2]) - 1) * scene.grid.spacing
    margin = AROUND * high[1]
    return np.array([max(0.0, way.min() - margin), 0.0]), np.array(
        [min(high[0], way.max() + margin), high[1]]
    )


def _dot(scene: Scene, positions: np.ndarray, inches: float) -> float:
    """Size of a dot [points²] that about fills the distance of two particles, in a picture of so many inches."""
    extent = max(float(np.ptp(positions[:, 0])), float(np.ptp(positions[:, 1])), scene.grid.spacing)
    return (72.0 * inches * 0.62 * scene.grid.spacing / extent) ** 2


def _draw_robot(
    panel,
    scene: Scene,
    positions: np.ndarray,
    activation: np.ndarray | None,
    window: tuple[np.ndarray, np.ndarray],
    *,
    inches: float,
) -> None:
    """Particles in grey, muscles red where they pull and blue where they push, with strokes along their fibres, and walls."""
    from matplotlib import colormaps
    from matplotlib.colors import to_rgba

    low, high = window
    value, muscular = np.zeros(len(positions)), np.zeros(len(positions), dtype=bool)
    for k, muscle in enumerate(scene.muscles):
        value[muscle.particles] += 0.0 if activation is None else activation[k]
        muscular[muscle.particles] = True
    colours = colormaps["coolwarm"]((1.0 + value) / 2)
    colours[~muscular] = to_rgba(PASSIVE)
    order, size = _from_behind(positions), _dot(scene, np.stack([low, high]), inches)
    panel.scatter(*positions[order, :2].T, s=size, color=colours[order], linewidths=0)
    gap = max(scene.grid.spacing, float((high - low).max()) / STROKES)
    strokes, particle = fibre_strokes(scene, positions, gap)
    seen = _seen(positions, scene.grid.spacing)[particle]
    strong, width = np.abs(value[particle]) > PALE, 72.0 * inches * WIDTH / STROKES
    for some, colour in ((strong, "#fafafa"), (~strong, "#2c2c34")):
        panel.plot(*strokes[some & seen, :, :2].transpose(2, 1, 0), color=colour, linewidth=width)
    for wall in scene.walls:
        if any(wall.normal[:2]):  # not beside the picture
            _draw_wall(panel, wall, low, high)
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    panel.tick_params(labelsize=6)


def _draw_wall(panel, wall, low: np.ndarray, high: np.ndarray) -> None:
    """Shade what of the picture lies inside a half space n·x ≤ offset."""
    x, y = np.meshgrid((low[0], high[0]), (low[1], high[1]))  # a plane needs no more
    depth = wall.offset - (wall.normal[0] * x + wall.normal[1] * y)
    panel.contourf(x, y, depth, levels=[0.0, max(float(depth.max()), 1e-9)], colors=["#e3e0da"], zorder=0)
