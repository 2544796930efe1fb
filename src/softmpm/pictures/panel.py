"""One world drawn into matplotlib axes, from the front in 2D and in perspective in 3D. matplotlib is imported where it is used."""

from typing import Any

import numpy as np

from softmpm.pictures.camera import Camera, round_below, round_length, tiles
from softmpm.pictures.instant import Instant, walls_of
from softmpm.recording import style
from softmpm.recording.fibres import STROKES, Fibres, stroke_colours
from softmpm.recording.surroundings import Surroundings

POINT = (44, 44, 52)
"""Colour of surface points and of the edges of driven particles."""
POINT_RADIUS = 0.07
"""Of a surface point [cells]."""
RAISED = 8.0
"""Height of the reference arrow above a panel [point]."""
BEFORE = 4.0
"""Distance of strokes from their particles towards the camera, in radii of these: at a face seen at a low angle, neighbours are nearer
to the camera than a particle by 2 to 3."""


class Panel:
    """The picture of one world; :meth:`draw` replaces what moves.

    Args:
        axes: matplotlib axes.
        place: Everything that does not move.
        low, high: Box to frame [m], shape (dim,).
        traction: Traction of the longest arrow [Pa]; 0 for no arrows.
        with_fibres: Draw the fibres of the muscles.
    """

    def __init__(
        self,
        axes: Any,
        place: Surroundings,
        low: np.ndarray,
        high: np.ndarray,
        traction: float,
        with_fibres: bool = False,
    ):
        from matplotlib import rcParams

        self._axes, self._place, self._traction, self._ink = axes, place, traction, rcParams["text.color"]
        gap = max(place.spacing, float((high - low).max()) / STROKES)
        self._fibres = Fibres(place, gap) if with_fibres else None
        self._moving: list[Any] = []
        self._camera = Camera(low, high, place.up) if place.dim == 3 else None
        corners = (low, high) if self._camera is None else self._camera.frame(low, high)
        self._low, self._high = low, high
        axes.set(xlim=(corners[0][0], corners[1][0]), ylim=(corners[0][1], corners[1][1]), aspect="equal")
        axes.set_facecolor("white")
        if self._camera is None:
            axes.set(xlabel="x [m]", ylabel="y [m]")
            axes.tick_params(labelsize=8)
            axes.locator_params(nbins=7)
        else:
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            self._draw_axes(low, high)

    def draw(self, instant: Instant, rgb: np.ndarray, title: str = "") -> None:
        """Show an instant.

        Args:
            rgb: Colour of each particle, shape (particle, 3), 0 to 255.
        """
        for artist in self._moving:
            artist.remove()
        self._moving = []
        self._draw_walls(*walls_of(self._place, instant))
        x, radii, edge = instant.positions, self._place.radii, self._place.driven
        if self._camera is not None:
            rgb = rgb * self._camera.shading(self._place, x)[:, None]
        if self._fibres is not None:
            x, radii, rgb, edge = self._with_strokes(self._fibres, x, radii, rgb, edge)
        finite = np.isfinite(x).all(-1)
        x, radii, rgb, edge = x[finite], radii[finite], rgb[finite] / 255, edge[finite]
        if self._camera is not None:
            x, scale = self._camera.project(x)
            order = np.argsort(scale)  # from back to front
            x, radii, rgb, edge = x[order], (radii * scale)[order], rgb[order], edge[order]
        self._dots(x, radii, rgb, edge, zorder=2)
        if instant.places is not None:
            self._draw_points(instant.places, instant.traction)
        if title:
            self._axes.set_title(title, fontsize=9, loc="left", color=self._ink)

    def _with_strokes(
        self, strokes: Fibres, x: np.ndarray, radii: np.ndarray, rgb: np.ndarray, edge: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Particles, and after them the dots of the fibres' strokes: positions, radii, colours and dark edges."""
        dots = strokes.dots(x)
        if self._camera is not None:  # in front of the particles around them, on the faces that it sees
            dots = self._camera.nearer(dots, BEFORE * radii[strokes.particle, None, None])
            dots[~self._camera.sees(self._place, x)[strokes.particle]] = np.nan
        over = np.repeat(stroke_colours(rgb[strokes.particle]), dots.shape[1], axis=0)
        return (
            np.concatenate([x, dots.reshape(-1, self._place.dim)]),
            np.concatenate([radii, np.full(len(over), strokes.radius)]),
            np.concatenate([rgb, over]),
            np.concatenate([edge, np.zeros(len(over), bool)]),
        )

    def _dots(self, x: np.ndarray, radii: np.ndarray, rgb: np.ndarray, edge: np.ndarray, zorder: int) -> None:
        from matplotlib.collections import EllipseCollection

        lines = np.where(edge[:, None], np.array(POINT) / 255, rgb) if edge.any() else "none"
        dots = EllipseCollection(
            2 * radii,
            2 * radii,
            np.zeros(len(x)),
            units="xy",
            offsets=x,
            offset_transform=self._axes.transData,
            facecolors=rgb,
            edgecolors=lines,
            linewidths=np.where(edge, 0.7, 0.0),
            zorder=zorder,
        )
        self._moving.append(self._axes.add_collection(dots, autolim=False))

    def _draw_points(self, places: np.ndarray, traction: np.ndarray | None) -> None:
        """Surface points in 2D, and arrows of the tractions there."""
        radius = POINT_RADIUS * self._place.spacing
        if self._camera is None:
            colours = np.tile(np.array(POINT) / 255, (len(places), 1))
            self._dots(places, np.full(len(places), radius), colours, np.zeros(len(places), bool), zorder=3)
        if traction is None or self._traction == 0.0:
            return
        feet, arrows = style.traction_arrows(places, traction, self._place.spacing, self._traction)
        tips, zorder = feet + arrows, 4.0
        if (
            self._camera is not None
        ):  # from outside to the surface, and behind the particles, which would be hidden
            feet, tips, zorder = self._camera.project(feet - arrows)[0], self._camera.project(feet)[0], 1.5
        if len(feet):
            self._moving.append(self._arrows(feet, tips - feet, zorder=zorder))

    def draw_scale(self, name: str) -> None:
        """Draw an arrow for a round traction above the upper right corner, with this name and its value."""
        from matplotlib.transforms import ScaledTranslation

        traction = round_below(self._traction)
        length = style.LONGEST * self._place.spacing * traction / self._traction
        foot = np.array([[self._axes.get_xlim()[1] - length, self._axes.get_ylim()[1]]])
        raised = ScaledTranslation(0.0, RAISED / 72, self._axes.figure.dpi_scale_trans)
        self._arrows(foot, np.array([[length, 0.0]]), transform=self._axes.transData + raised, clip_on=False)
        self._axes.annotate(
            f"{name} {_pascal(traction)}".strip(),
            foot[0],
            (-4.0, RAISED),
            textcoords="offset points",
            fontsize=8,
            ha="right",
            va="center",
            annotation_clip=False,
        )

    def _arrows(self, feet: np.ndarray, vectors: np.ndarray, **look) -> Any:
        from matplotlib.patheffects import withStroke

        look |= dict(angles="xy", scale_units="xy", scale=1.0, units="xy", width=0.2 * self._place.spacing)
        edge = withStroke(linewidth=1.0, foreground="white")  # particles may be as dark as the arrows
        look |= dict(path_effects=[edge])
        return self._axes.quiver(*feet.T, *vectors.T, color=[tuple(np.array(style.TRACTION) / 255)], **look)

    def _draw_walls(self, normals: np.ndarray, offsets: np.ndarray) -> None:
        outlines = style.wall_outlines(normals, offsets, self._place.upper)
        for contact, normal, offset, outline in zip(
            self._place.contacts, normals, offsets, outlines, strict=True
        ):
            colour = tuple(np.array(style.WALL[contact]) / 255)
            if len(outline) < self._place.dim:
                continue
            if self._camera is None:
                self._moving += self._line_wall(normal, float(offset), outline, colour)
            else:
                for axis, sign in ((axis, sign) for axis in range(3) for sign in (1.0, -1.0)):
                    limit = self._low[axis] if sign > 0 else -self._high[axis]
                    outline = style.clip(outline, sign * np.eye(3)[axis], limit)
                if len(outline) >= 3:
                    behind = float(self._camera.position @ normal) > offset
                    self._moving += self._plane_wall(self._camera, behind, outline, colour)

    def _line_wall(self, normal: np.ndarray, offset: float, outline: np.ndarray, colour: tuple) -> list[Any]:
        """A wall of a 2D scene: its solid side, hatching and surface."""
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Polygon

        low, high, drawn = self._low, self._high, []
        room = high - low
        box = np.array(
            [
                low - room,
                (high[0] + room[0], low[1] - room[1]),
                high + room,
                (low[0] - room[0], high[1] + room[1]),
            ]
        )
        solid = style.clip(box, -normal, -offset)
        if len(solid) >= 3:
            pale = tuple(1.0 - 0.11 * (1.0 - np.array(colour)))
            drawn.append(self._axes.add_patch(Polygon(solid, facecolor=pale, edgecolor="none", zorder=0)))
        strokes = list(style.hatch(outline, normal, float(room.max()) / 50))
        lines = LineCollection(strokes, colors=[(*colour, 0.7)], linewidths=0.8, zorder=1)
        look: dict = dict(color=colour, linewidth=1.6, zorder=1, solid_capstyle="butt")
        return [*drawn, self._axes.add_collection(lines, autolim=False), *self._axes.plot(*outline.T, **look)]

    def _plane_wall(self, camera: Camera, behind: bool, outline: np.ndarray, colour: tuple) -> list[Any]:
        """A wall of a 3D scene, tiled; where it stands between the camera and the bodies, only its edge."""
        from matplotlib.collections import LineCollection
        from matplotlib.patches import Polygon

        corners, _ = camera.project(outline)
        face = (*colour, 0.22) if behind else "none"
        edge = Polygon(corners, facecolor=face, edgecolor=colour, linewidth=1.0, zorder=0 if behind else 3)
        drawn: list[Any] = [self._axes.add_patch(edge)]
        if behind:
            length = round_length(float((self._high - self._low).max()))
            ends = camera.project(tiles(outline, length).reshape(-1, 3))[0].reshape(-1, 2, 2)
            lines = LineCollection(list(ends), colors=[(*colour, 0.6)], linewidths=0.6, zorder=1)
            drawn.append(self._axes.add_collection(lines, autolim=False))
        return drawn

    def _draw_axes(self, low: np.ndarray, high: np.ndarray) -> None:
        """Arrows along x, y and z in the lower left corner, and the length of tiles and arrows."""
        assert self._camera is not None
        length = round_length(float((high - low).max()))
        middle = (low + high) / 2
        ends, _ = self._camera.project(middle + np.concatenate([np.zeros((1, 3)), length * np.eye(3)]))
        corner, _ = self._camera.frame(low, high)
        ends = ends + (corner - ends.min(0)) + 0.25 * length  # with room for a name
        for end, name in zip(ends[1:], "xyz", strict=True):
            self._axes.annotate(
                "", end, ends[0], arrowprops=dict(arrowstyle="->", color="0.25", linewidth=1.0)
            )
            away = end + 0.12 * (end - ends[0])
            self._axes.annotate(
                name, away, fontsize=8, color="0.25", ha="center", va="center", annotation_clip=False
            )
        self._axes.set_xlabel(f"arrows and tiles: {length:g} m", fontsize=8, loc="left")


def _pascal(stress: float) -> str:
    """A stress with its unit, of the prefixes the one with which the figure is at least 1."""
    size, unit = next((one for one in ((1e6, "MPa"), (1e3, "kPa")) if stress >= one[0]), (1.0, "Pa"))
    return f"{stress / size:g} {unit}"
