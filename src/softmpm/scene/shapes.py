"""Shapes to particles: a box, a ball, polygons, a picture's silhouette or a closed mesh, on a regular lattice.

Every particle sits in the middle of its lattice cell and has the cell's volume; the last axis runs fastest. A box is filled exactly:
its mass is its density times its own volume. The other shapes keep the cells whose middle lies in them: their mass is exact to the
lattice, density · particle count · spacingᵈ. With ``cut_cells`` they keep every cell that they cross, with the volume and the centroid
of its inner part.
"""

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from softmpm.scene.boundary import ball_outline, box_outline, polygon_outline
from softmpm.scene.cut_cells import SAMPLES, inner_parts, inward, merge_slivers, sample_points, share_inside
from softmpm.scene.image import Inside, coverage, mask_contours, silhouette
from softmpm.scene.mesh import closed_surface, mesh_coverage, mesh_outline, near_surface, winding_inside
from softmpm.scene.polygons import boundary_distance, inside_any, nearest_on, ray_length, union_boundary
from softmpm.scene.scene import Particles
from softmpm.validate import array, need

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
    sides = " × ".join(f"{side:.4g}" for side in high - low)
    need(
        bool((count > 0).all()),
        f"a box with sides of {sides} m is thinner than half its spacing of {spacing} m: make the spacing smaller.",
    )
    step = (high - low) / count
    positions = _lattice((low + high) / 2, count, step)
    return Particles(positions, float(step.prod()), box_outline(low, high, count))


def ball(
    center: Sequence[float], radius: float | Sequence[float], spacing: float, *, cut_cells: bool = False
) -> Particles:
    """Fill a disc (2D) or ball (3D); one ``radius`` [m] per axis makes an ellipse or ellipsoid.

    The lattice mirrors itself about ``center`` [m], so the centre of mass is exact. ``cut_cells`` makes the volume exact to
    spacing², with particles of different volumes.
    """
    middle, spacing = _point("center", center), _spacing(spacing)
    radii = array("radius", radius).astype(np.float64)
    need(
        radii.shape in ((), middle.shape) and bool(np.isfinite(radii).all() and (radii > 0).all()),
        f"radius must be one number > 0 m, or {len(middle)} of them, one per axis, got {radius}.",
    )
    radii = np.broadcast_to(radii, middle.shape)
    count = 2 * (_cover if cut_cells else _count)(radii, spacing)
    offset, volume = _lattice(np.zeros_like(middle), count, spacing), spacing ** len(middle)
    if cut_cells:
        offset, volume = merge_slivers(*_cut_ball(radii, offset, spacing), count, spacing)
    else:
        offset = offset[((offset / radii) ** 2).sum(axis=1) <= 1.0]
    return Particles(middle + _not_empty(offset, spacing), volume, ball_outline(middle, radii, spacing))


def _cut_ball(radii: np.ndarray, middles: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Share of each cell that is inside, and centroid of that part."""
    share, centroid = np.zeros(len(middles)), middles.copy()
    near = (((np.abs(middles) - spacing / 2) / radii) ** 2).sum(axis=1) < 1.0
    share[(((np.abs(middles) + spacing / 2) / radii) ** 2).sum(axis=1) <= 1.0] = 1.0
    cut = near & (share < 1.0)
    samples = sample_points(middles[cut], spacing) / radii
    level = np.linalg.norm(samples, axis=2)
    distance = (level - 1.0) * level / np.linalg.norm(samples / radii, axis=2)  # to first order
    weights = share_inside(distance, spacing / SAMPLES)
    share[cut], centroid[cut] = inner_parts(middles[cut], weights, spacing)
    if radii.min() < spacing:  # both sides cross the same samples, which know the nearer one only
        whole = math.prod(radii) * (math.pi if len(radii) == 2 else 4 / 3 * math.pi) / spacing ** len(radii)
        share[cut] *= (whole - share[~cut].sum()) / share[cut].sum()
    return share, centroid


def polygons(
    parts: Sequence[Sequence[Sequence[float]] | np.ndarray], spacing: float, *, cut_cells: bool = False
) -> Particles:
    """Fill the union of closed polygons with 2D particles; its outline keeps corners that turn by more than 20°.

    Lattice cells begin at multiples of the spacing from the origin, so sides that lie there are exact.

    Args:
        parts: Vertices [m] of each polygon, shape (vertex, 2), either way round. They may overlap, share sides and cross themselves;
            the inside of one that does follows the even-odd rule.
        spacing: Distance of neighbouring particles [m].
        cut_cells: Take every cell that the union crosses, with the volume and the centroid of the part inside.
    """
    spacing = _spacing(spacing)
    drawn = [array(f"polygon {k}", part).astype(np.float64) for k, part in enumerate(parts)]
    need(len(drawn) > 0, "polygons needs at least one polygon.")
    for k, part in enumerate(drawn):
        need(
            part.ndim == 2 and part.shape[1:] == (2,) and len(part) >= 3 and bool(np.isfinite(part).all()),
            f"each polygon needs at least three finite vertices, shape (vertex, 2), but polygon {k} has shape {part.shape}.",
        )
    every = np.concatenate(drawn)
    lower = np.floor(every.min(axis=0) / spacing)
    count = _whole(np.maximum(np.ceil(every.max(axis=0) / spacing) - lower, 1))
    middles = spacing * _lattice(lower + count / 2, count, 1.0)
    boundary = union_boundary(drawn)
    _not_empty(np.concatenate([middles[:0], *boundary]), spacing)
    if cut_cells:
        positions, volume = merge_slivers(*_cut_polygons(drawn, boundary, middles, spacing), count, spacing)
    else:
        positions, volume = middles[inside_any(middles, drawn)], spacing**2
    return Particles(
        _not_empty(positions, spacing), volume, polygon_outline(boundary, spacing, math.radians(20.0))
    )


def _cut_polygons(
    drawn: list[np.ndarray], boundary: list[np.ndarray], middles: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Share of each cell that is inside, and centroid of that part."""
    share, centroid = inside_any(middles, drawn).astype(float), middles.copy()
    cut = boundary_distance(middles, boundary) < spacing * math.sqrt(0.5)
    samples = sample_points(middles[cut], spacing)
    flat = samples.reshape(-1, 2)
    place, normal = nearest_on(flat, boundary)
    distance = np.linalg.norm(flat - place, axis=1) * np.where(inside_any(flat, drawn), -1.0, 1.0)
    thickness = ray_length(*inward(flat, place, normal, distance, 1e-6 * spacing), boundary)
    weights = share_inside(distance, spacing / SAMPLES, thickness).reshape(len(samples), -1)
    share[cut], centroid[cut] = inner_parts(middles[cut], weights, spacing)
    return share, centroid


def image(
    source: "str | os.PathLike[str] | PIL.Image.Image | np.ndarray",
    lower: Sequence[float],
    *,
    height: float,
    spacing: float,
    inside: Inside = "dark",
    threshold: float = 0.5,
    cut_cells: bool = False,
) -> Particles:
    """Fill the silhouette in a picture with 2D particles; the picture's top is up.

    Args:
        source: Path of a picture (needs Pillow), a Pillow image, or an array (row, column): boolean, where
            True is inside whatever ``inside`` says, or grey as uint8, uint16 or floats from 0, black, to 1.
        lower: Where the picture's lower left corner comes to lie [m].
        height: Height of the whole picture, margins included [m]; its width follows from its pixels.
        spacing: Distance of neighbouring particles [m]. A particle is made where at least half of its
            cell is inside: with spacing = height / rows, one for each pixel inside. The lattice begins at the bottom
            of the picture and is centred in its width, so that symmetric pictures have symmetric particles.
        inside: ``dark`` takes what is dark on white paper (transparent is paper), ``light`` what is light on
            black, ``opaque`` what is not transparent.
        threshold: Grey or opacity, between 0 and 1, that parts the inside from the outside.
        cut_cells: Take every cell that has something inside, with the volume and the centroid of that part: the volume is
            exact, and the particles differ in volume.
    """
    corner, spacing = _point("lower", lower), _spacing(spacing)
    need(len(corner) == 2, f"a picture is flat: lower needs 2 numbers, got {lower}.")
    need(math.isfinite(height) and height > 0, f"height must be > 0 m, got {height}.")
    mask = silhouette(source, inside, threshold)
    pixel = height / len(mask)
    size, width = np.array(mask.shape[::-1]) * pixel, spacing / pixel
    count = (_cover if cut_cells else _count)(size, spacing)  # (x, y)
    begin = np.array([(mask.shape[1] - width * count[0]) / 2, 0.0])  # of the lattice [pixels]
    middles = _lattice(corner + pixel * begin + count * spacing / 2, count, spacing)
    if cut_cells:
        parts = _cut_image(mask, middles, begin, count, spacing, width)
        positions, volume = merge_slivers(*parts, count, spacing)
    else:
        covered = coverage(mask, begin, count, width, width).ravel()
        half = covered >= 0.5 - 1e-9  # a half-covered cell counts, whatever its rounding
        positions, volume = middles[half], spacing**2
    need(
        len(positions) > 0,
        f"the picture leaves no particle: {mask.mean():.1%} of its pixels are inside (inside={inside!r}, "
        f"threshold={threshold}), a particle is {spacing / pixel:.3g} pixels wide; "
        "try another inside, another threshold or a smaller spacing.",
    )
    polygons = [corner + pixel * polygon for polygon in mask_contours(mask, width)]
    return Particles(positions, volume, polygon_outline(polygons, spacing))


def _cut_image(
    mask: np.ndarray, middles: np.ndarray, begin: np.ndarray, count: np.ndarray, spacing: float, width: float
) -> tuple[np.ndarray, np.ndarray]:
    """Share of each cell that is inside, and centroid of that part."""
    fine = width / SAMPLES
    covered = coverage(mask, begin, SAMPLES * count, fine, fine).reshape(count[0], SAMPLES, count[1], SAMPLES)
    weights = covered.transpose(0, 2, 1, 3).reshape(len(middles), -1)
    return inner_parts(middles, weights, spacing)


def mesh(
    source: "str | os.PathLike[str] | trimesh.Trimesh", spacing: float, *, cut_cells: bool = False
) -> Particles:
    """Fill a closed triangle mesh with particles; needs trimesh (``pip install "softmpm[mesh]"``).

    Parts of a mesh may overlap. A part whose faces turn inwards is a cavity and lies within the others.

    Args:
        source: Path of a mesh file, or a ``trimesh.Trimesh``, in metres. A file in millimetres wants
            ``trimesh.load_mesh(path).apply_scale(1e-3)``.
        spacing: Distance of neighbouring particles [m]; the lattice is centred in the mesh's bounding box.
        cut_cells: Take every cell that the mesh crosses, with the volume and the centroid of its inner part: the volume converges
            with spacing², and the particles differ in volume.
    """
    spacing = _spacing(spacing)
    vertices, faces = closed_surface(source)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    count = _cover(high - low, spacing)
    middles = _lattice((low + high) / 2, count, spacing)
    if cut_cells:
        parts = _cut_mesh(vertices, faces, middles, count, spacing)
        positions, volume = merge_slivers(*parts, count, spacing)
    else:
        positions, volume = middles[winding_inside(vertices, faces, middles)], spacing**3
    return Particles(_not_empty(positions, spacing), volume, mesh_outline(vertices, faces, spacing))


def _cut_mesh(
    vertices: np.ndarray, faces: np.ndarray, middles: np.ndarray, count: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Share of each cell that is inside, and centroid of that part."""
    cut = near_surface(vertices, faces, middles[0] - spacing / 2, count, spacing)
    share, centroid = np.zeros(len(middles)), middles.copy()
    share[~cut] = winding_inside(vertices, faces, middles[~cut])
    samples = sample_points(middles[cut], spacing)
    weights = mesh_coverage(vertices, faces, samples.reshape(-1, 3), spacing / SAMPLES)
    share[cut], centroid[cut] = inner_parts(middles[cut], weights.reshape(len(samples), -1), spacing)
    return share, centroid


def _point(name: str, value: Sequence[float]) -> np.ndarray:
    point = array(name, value).astype(np.float64)
    need(
        point.shape in ((2,), (3,)) and bool(np.isfinite(point).all()),
        f"{name} must be 2 or 3 finite numbers [m], got {value}.",
    )
    return point


def _spacing(spacing: float) -> float:
    need(math.isfinite(spacing) and spacing > 0, f"spacing must be > 0 m, got {spacing}.")
    return float(spacing)


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


def _cover(extent: np.ndarray, spacing: float) -> np.ndarray:
    """Whole number of cells that covers the extent along each axis, whatever its rounding, also in single precision."""
    with np.errstate(over="ignore"):
        return _whole(np.ceil(extent / spacing * (1.0 - 1e-6)))


def _whole(count: np.ndarray) -> np.ndarray:
    """As integers, which overflow far above the limit of cells."""
    _need_few(count.max(), " along an axis")
    return count.astype(np.int64)


def _need_few(cells: float, where: str = "") -> None:
    need(
        cells <= CELL_LIMIT,
        f"the shape spans {cells:.2g} lattice cells{where}, at most {CELL_LIMIT:.2g} are allowed in all: "
        "make the spacing larger, and check that all lengths are in metres.",
    )


def _lattice(center: np.ndarray, count: np.ndarray, step: np.ndarray | float) -> np.ndarray:
    """Middles of count cells of size step about a point, shape (prod(count), dim), the last axis fastest."""
    _need_few(math.prod(int(n) for n in count))
    steps = np.broadcast_to(step, center.shape)
    axes = [c + (np.arange(n) + 0.5 - n / 2) * h for c, n, h in zip(center, count, steps, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(center))
