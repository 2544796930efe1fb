"""Picture of one world: particles, muscles coloured by activation, walls and the goal.

matplotlib is imported where it is used and without pyplot, so that nothing global changes.
"""

import numpy as np

from softmpm import Scene

WIDTH = 480
"""Width of a picture [pixels]."""


def picture(scene: Scene, x: np.ndarray, activation: np.ndarray, goal: np.ndarray | None) -> np.ndarray:
    """Pixels of the first two axes, shape (height, WIDTH, 3), uint8.

    Args:
        x: Positions of the particles [m], shape (particle, dim).
        activation: Activation of each muscle [-], shape (muscle,); red pulls, blue pushes.
        goal: Goal [m], shape (dim,), drawn as a cross, or None.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = (scene.grid.spacing * (nodes - 1) for nodes in scene.grid.shape[:2])
    figure = Figure(figsize=(WIDTH / 100, round(WIDTH * height / width) / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(0.0, height))
    axes.set_axis_off()
    _draw_walls(axes, scene, width, height)
    value = np.zeros(len(x))
    for muscle, a in zip(scene.muscles, activation, strict=True):
        value[muscle.particles] += a
    size = (
        0.62 * 72.0 / 100 * WIDTH * scene.grid.spacing / width
    ) ** 2  # of a disc as wide as their distance
    axes.scatter(x[:, 0], x[:, 1], c=value, s=size, cmap="coolwarm", vmin=-1.0, vmax=1.0, linewidths=0)
    if goal is not None:
        axes.plot(goal[0], goal[1], marker="x", color="black", markersize=8, markeredgewidth=2)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_walls(axes, scene: Scene, width: float, height: float) -> None:
    """Shade the half spaces n·x ≤ offset; a wall along a third axis is left out."""
    x, y = np.meshgrid(np.linspace(0.0, width, 200), np.linspace(0.0, height, 200))
    for wall in scene.walls:
        depth = wall.offset - (wall.normal[0] * x + wall.normal[1] * y)
        if any(wall.normal[:2]) and depth.max() > 0:
            axes.contourf(x, y, depth, levels=[0.0, float(depth.max())], colors=["#e3e0da"])
