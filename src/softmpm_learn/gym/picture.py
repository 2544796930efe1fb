"""Picture of one world: particles, muscles coloured by activation, walls and the goal, in a window that follows the robot.

matplotlib is imported where it is used and without pyplot, so that nothing global changes.
"""

import numpy as np

from softmpm import Scene

WIDTH, HEIGHT = 480, 320
"""Size of a picture [pixels]."""
WINDOW = 3.0
"""Width of the window, in largest extents of the bodies at rest."""
BELOW = 0.2
"""Share of the height of the picture below the surface of the floor, unless the robot is so high that the window leaves it."""
STEEP = 0.5
"""Least component of a floor's normal along the second axis; steeper walls are no floor."""
LINES = 6
"""Most lines that mark round lengths along the width."""


def picture(scene: Scene, x: np.ndarray, activation: np.ndarray, goal: np.ndarray | None) -> np.ndarray:
    """Pixels of the first two axes, shape (HEIGHT, WIDTH, 3), uint8. Lines at round lengths move past the robot as it moves.

    Args:
        x: Positions of the particles [m], shape (particle, dim).
        activation: Activation of each muscle [-], shape (muscle,); red pulls, blue pushes.
        goal: Goal [m], shape (dim,), drawn as a cross, or None.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    low, high = window(scene, x)
    figure = Figure(figsize=(WIDTH / 100, HEIGHT / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    _draw_walls(axes, scene, x.mean(axis=0), low, high)
    _draw_lines(axes)
    value = np.zeros(len(x))
    for muscle, a in zip(scene.muscles, activation, strict=True):
        value[muscle.particles] += a
    distance = 0.62 * 72.0 / 100 * WIDTH * scene.grid.spacing / (high[0] - low[0])  # of particles, in points
    look: dict = dict(cmap="coolwarm", vmin=-1.0, vmax=1.0, linewidths=0, zorder=2)
    order = np.argsort(x[:, 2:].sum(axis=1), kind="stable")  # near ones cover those behind
    axes.scatter(*x[order, :2].T, c=value[order], s=distance**2, **look)
    if goal is not None:
        axes.plot(goal[0], goal[1], marker="x", color="black", markersize=8, markeredgewidth=2, zorder=3)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def window(scene: Scene, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the part of the world that is shown [m], shape (2,): around the mean position, with the floor near its lower edge."""
    rest = scene.positions
    width = WINDOW * float(np.ptp(rest[:, :2], axis=0).max())
    size = np.array([width, width * HEIGHT / WIDTH])
    centre = x.mean(axis=0)
    low = centre[:2] - size / 2
    floors = [wall for wall in scene.walls if wall.normal[1] > STEEP]
    if floors:
        surface = max(_surface(wall, centre) for wall in floors)
        low[1] = max(low[1], surface - BELOW * size[1])
    return low, low + size


def _surface(wall, centre: np.ndarray) -> float:
    """Height of a wall's surface above or below a place [m]."""
    normal = np.asarray(wall.normal)
    return float(centre[1] - (normal @ centre - wall.offset) / normal[1])


def _draw_lines(axes) -> None:
    """Lines at round lengths, with the length at those across the way."""
    from matplotlib.ticker import MaxNLocator

    across = MaxNLocator(LINES, steps=[1, 2, 5, 10])
    axes.xaxis.set_major_locator(across)
    axes.yaxis.set_major_locator(across)
    axes.xaxis.set_major_formatter("{x:g} m")
    axes.tick_params(axis="x", direction="in", pad=-14, length=0, labelsize=8, labelcolor="0.3")
    axes.tick_params(axis="y", length=0, labelleft=False)
    axes.grid(color="0.8", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[:].set_visible(False)


def _draw_walls(axes, scene: Scene, centre: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Shade the half spaces n·x ≤ offset; a wall along a third axis is left out."""
    x, y = np.meshgrid((low[0], high[0]), (low[1], high[1]))  # a plane needs no more
    for wall in scene.walls:
        normal = np.asarray(wall.normal)
        depth = wall.offset - (normal[0] * x + normal[1] * y + normal[2:] @ centre[2:])
        if normal[:2].any() and depth.max() > 0:
            axes.contourf(x, y, depth, levels=[0.0, float(depth.max())], colors=["#e3e0da"], zorder=0)
            axes.contour(x, y, depth, levels=[0.0], colors=["0.35"], linewidths=1.0, zorder=1)
