"""Shapes to particles: a box, a ball, a picture's silhouette or a closed mesh, on a regular lattice.

Every particle sits in the middle of its lattice cell and has the cell's volume; the last axis runs fastest.
A box is filled exactly: its mass is its density times its own volume. The other shapes keep the cells whose
middle lies in them: their mass is exact to the lattice, density · particle count · spacingᵈ.
"""

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from softmpm.scene.image import Inside, coverage, silhouette
from softmpm.scene.mesh import closed_surface, winding_inside
from softmpm.scene.scene import Particles
from softmpm.validate import need

if TYPE_CHECKING:
    import PIL.Image
    import trimesh

CELL_LIMIT = 200_000_000
"""Most lattice cells of one shape; a mesh in millimetres read as metres asks for far more."""


def box(lower: Sequence[float], upper: Sequence[float], spacing: float) -> Particles:
    """Fill the box from ``lower`` to ``upper`` [m].

    Sides that are no multiple of ``spacing`` [m] get the nearest whole number of particles and a step
    that fits them, so that the particles' total volume is the box's own.
    """
    low, high = _point("lower", lower), _point("upper", upper)
    need(len(low) == len(high), f"lower and upper need the same number of axes, got {lower} and {upper}.")
    need(bool((low < high).all()), f"upper must be above lower along each axis, got {lower} and {upper}.")
    count = _count(high - low, _spacing(spacing))
    need(
        bool((count > 0).all()),
        f"a box with sides of {_numbers(high - low)} m is thinner than half its spacing of {spacing} m: "
        "make the spacing smaller.",
    )
    step = (high - low) / count
    return Particles(_lattice((low + high) / 2, count, step), float(step.prod()))


def ball(center: Sequence[float], radius: float | Sequence[float], spacing: float) -> Particles:
    """Fill a disc (2D) or ball (3D); one ``radius`` [m] per axis makes an ellipse or ellipsoid.

    The lattice mirrors itself about ``center`` [m], so the centre of mass is exact.
    """
    middle, spacing = _point("center", center), _spacing(spacing)
    radii = np.asarray(radius, dtype=np.float64)
    need(
        radii.shape in ((), middle.shape) and bool(np.isfinite(radii).all() and (radii > 0).all()),
        f"radius must be one number > 0 m, or {len(middle)} of them, one per axis, got {radius}.",
    )
    radii = np.broadcast_to(radii, middle.shape)
    offset = _lattice(np.zeros_like(middle), 2 * _count(radii, spacing), spacing)
    offset = offset[((offset / radii) ** 2).sum(axis=1) <= 1.0]
    return Particles(_not_empty(middle + offset, spacing), spacing ** len(middle))


def image(
    source: "str | os.PathLike[str] | PIL.Image.Image | np.ndarray",
    lower: Sequence[float],
    *,
    height: float,
    spacing: float,
    inside: Inside = "dark",
    threshold: float = 0.5,
) -> Particles:
    """Fill the silhouette in a picture with 2D particles; the picture's top is up.

    Args:
        source: Path of a picture (needs Pillow), a Pillow image, or an array (row, column): boolean, where
            True is inside whatever ``inside`` says, or grey as uint8, uint16 or floats from 0, black, to 1.
        lower: Where the picture's lower left corner comes to lie [m].
        height: Height of the whole picture, margins included [m]; its width follows from its pixels.
        spacing: Distance of neighbouring particles [m]. A particle is made where at least half of its
            cell is inside: with spacing = height / rows, one for each pixel inside.
        inside: ``dark`` takes what is dark on white paper (transparent is paper), ``light`` what is light on
            black, ``opaque`` what is not transparent.
        threshold: Grey or opacity, between 0 and 1, that parts the inside from the outside.
    """
    corner, spacing = _point("lower", lower), _spacing(spacing)
    need(len(corner) == 2, f"a picture is flat: lower needs 2 numbers, got {lower}.")
    need(math.isfinite(height) and height > 0, f"height must be > 0 m, got {height}.")
    mask = silhouette(source, inside, threshold)
    pixel = height / len(mask)
    count = _count(np.array(mask.shape[::-1]) * pixel, spacing)  # (x, y)
    positions = _lattice(corner + count * spacing / 2, count, spacing)
    covered = coverage(mask, count, spacing / pixel).ravel()
    chosen = covered >= 0.5 - 1e-9  # a half-covered cell counts, whatever its rounding
    need(
        bool(chosen.any()),
        f"the picture leaves no particle: {mask.mean():.1%} of its pixels are inside (inside={inside!r}, "
        f"threshold={threshold}), a particle is {spacing / pixel:.3g} pixels wide; "
        "try another inside, another threshold or a smaller spacing.",
    )
    return Particles(positions[chosen], spacing**2)


def mesh(source: "str | os.PathLike[str] | trimesh.Trimesh", spacing: float) -> Particles:
    """Fill a closed triangle mesh with particles; needs trimesh (``pip install softmpm[mesh]``).

    Args:
        source: Path of a mesh file, or a ``trimesh.Trimesh``, in metres. A file in millimetres wants
            ``trimesh.load_mesh(path).apply_scale(1e-3)``.
        spacing: Distance of neighbouring particles [m]; the lattice is centred in the mesh's bounding box.
    """
    spacing = _spacing(spacing)
    vertices, faces = closed_surface(source)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    count = _whole(np.ceil((high - low) / spacing - 1e-9))
    positions = _lattice((low + high) / 2, count, spacing)
    inside = winding_inside(vertices, faces, positions)
    return Particles(_not_empty(positions[inside], spacing), spacing**3)


def _point(name: str, value: Sequence[float]) -> np.ndarray:
    point = np.asarray(value, dtype=np.float64)
    need(
        point.shape in ((2,), (3,)) and bool(np.isfinite(point).all()),
        f"{name} must be 2 or 3 finite numbers [m], got {value}.",
    )
    return point


def _spacing(spacing: float) -> float:
    need(math.isfinite(spacing) and spacing > 0, f"spacing must be > 0 m, got {spacing}.")
    return float(spacing)


def _numbers(values: np.ndarray) -> str:
    return " × ".join(f"{value:.4g}" for value in values)


def _not_empty(positions: np.ndarray, spacing: float) -> np.ndarray:
    need(
        len(positions) > 0,
        f"the shape lies between its particles: make it larger, or its spacing of {spacing} m smaller.",
    )
    return positions


def _count(extent: np.ndarray, spacing: float) -> np.ndarray:
    """Nearest whole number of cells along each axis; a tie goes up, whatever its rounding."""
    with np.errstate(over="ignore"):
        return _whole(np.floor(extent / spacing + 0.5 + 1e-9))


def _whole(count: np.ndarray) -> np.ndarray:
    """As integers, which overflow far above the limit of cells."""
    need(
        bool((count <= CELL_LIMIT).all()),
        f"the shape spans {count.max():.2g} lattice cells along an axis, at most {CELL_LIMIT:.2g} are allowed in all: "
        "make the spacing larger, and check that all lengths are in metres.",
    )
    return count.astype(np.int64)


def _lattice(center: np.ndarray, count: np.ndarray, step: np.ndarray | float) -> np.ndarray:
    """Middles of count cells of size step about a point, shape (prod(count), dim), the last axis fastest."""
    cells = math.prod(int(n) for n in count)
    need(
        cells <= CELL_LIMIT,
        f"the shape spans {cells:.2g} lattice cells, at most {CELL_LIMIT:.2g} are allowed: "
        "make the spacing larger, and check that all lengths are in metres.",
    )
    steps = np.broadcast_to(step, center.shape)
    axes = [c + (np.arange(n) + 0.5 - n / 2) * h for c, n, h in zip(center, count, steps, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(center))
