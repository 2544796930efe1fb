"""Walls of a Rerun file: of the whole recording, or in each frame where they move."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from softmpm.recording import style
from softmpm.recording.reader import Recording


def send_walls(
    stream, source: Recording, times: Sequence[Any], normals: np.ndarray, offsets: np.ndarray
) -> None:
    """Send the walls of some frames.

    Args:
        times: Time columns of the frames; empty for one pose that the whole recording shows.
        normals, offsets: Of the walls, shapes (frame, wall, dim) and (frame, wall) [m].
    """
    upper = (source.static["grid_shape"] - 1) * source.spacing
    frames = [style.wall_outlines(*pose, upper) for pose in zip(normals, offsets, strict=True)]
    for k, outlines in enumerate(zip(*frames, strict=True)):
        colour = style.WALL.get(source.static["wall_contact"][k], style.WALL[b"stick"])
        seen = [outline if len(outline) >= source.dim else outline[:0] for outline in outlines]
        if not times and not len(seen[0]):
            continue
        if source.dim == 2:
            _send_lines(stream, f"scene/walls/{k}", times, seen, normals[:, k], colour, source.spacing)
        else:
            _send_sheets(stream, f"scene/walls/{k}", times, seen, colour, source.spacing)


def _send_lines(
    stream,
    name: str,
    times: Sequence[Any],
    outlines: list[np.ndarray],
    normals: np.ndarray,
    colour: tuple[int, int, int],
    spacing: float,
) -> None:
    """Surface and hatching of a wall in 2D."""
    import rerun as rr

    look: dict = dict(colors=[colour], radii=0.12 * spacing, draw_order=0)
    stream.log(name, rr.LineStrips2D.from_fields(**look), static=True)
    strips = [
        [outline, *style.hatch(outline, normal, 2 * spacing)] if len(outline) else []
        for outline, normal in zip(outlines, normals, strict=True)
    ]
    columns = rr.LineStrips2D.columns(strips=list(itertools.chain(*strips)))
    stream.send_columns(name, times, columns.partition([len(frame) for frame in strips]))


def _send_sheets(
    stream,
    name: str,
    times: Sequence[Any],
    outlines: list[np.ndarray],
    colour: tuple[int, int, int],
    spacing: float,
) -> None:
    """Surface and edge of a wall in 3D."""
    import rerun as rr

    stream.log(name, rr.Mesh3D.from_fields(albedo_factor=(*colour, 70)), static=True)
    corners = [len(outline) for outline in outlines]
    sheet = rr.Mesh3D.columns(vertex_positions=np.concatenate(outlines)).partition(corners)
    fans = [[(0, i, i + 1) for i in range(1, count - 1)] for count in corners]
    triangles = np.array(list(itertools.chain(*fans)), np.uint32).reshape(-1, 3)
    faces = rr.Mesh3D.columns(triangle_indices=triangles).partition([len(fan) for fan in fans])
    stream.send_columns(name, times, [*sheet, *faces])
    look: dict = dict(colors=[colour], radii=0.15 * spacing)
    stream.log(f"{name}/edge", rr.LineStrips3D.from_fields(**look), static=True)
    edges = [np.vstack([outline, outline[:1]]) for outline in outlines if len(outline)]
    columns = rr.LineStrips3D.columns(strips=edges)
    stream.send_columns(f"{name}/edge", times, columns.partition([int(count > 0) for count in corners]))
