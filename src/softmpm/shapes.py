"""Shapes to particles: a box, a ball, a picture's silhouette or a closed mesh, on a regular lattice.

Every shape puts its particles half a spacing off its lower corner (or its centre), the last axis running fastest, and gives
each the volume of its lattice cell. A box is filled exactly: its mass is density times the box's own volume. The other
shapes keep the cells that lie in them, so their mass is exact to the lattice: particle count · spacingᵈ.
"""

import math
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import warp as wp

from softmpm.scene import Particles

if TYPE_CHECKING:
    import PIL.Image
    import trimesh

Inside = Literal["dark", "light", "opaque"]
CELL_LIMIT = 200_000_000
"""Most lattice cells of one shape; a mesh in millimetres read as metres asks for far more."""

wp.set_module_options({"enable_backward": False})  # a shape is not differentiated


def box(lower: Sequence[float], upper: Sequence[float], spacing: float) -> Particles:
    """Fill the box from ``lower`` to ``upper`` [m].

    Sides that are no multiple of ``spacing`` [m] get the nearest whole number of particles and a step that fits them, so the
    particles' total volume is the box's own.
    """
    lower, upper = _point("lower", lower), _point("upper", upper)
    _need(len(lower) == len(upper), f"lower and upper need the same number of axes, got {lower} and {upper}.")
    _need(bool((lower < upper).all()), f"upper must be above lower along each axis, got {lower} and {upper}.")
    count = _count(upper - lower, _spacing(spacing))
    _need(
        bool((count > 0).all()),
        f"a box of {upper - lower} m is thinner than half its spacing of {spacing} m: make the spacing smaller.",
    )
    step = (upper - lower) / count
    return Particles(_lattice((lower + upper) / 2, count, step), float(step.prod()))


def ball(center: Sequence[float], radius: float | Sequence[float], spacing: float) -> Particles:
    """Fill a disc (2D) or ball (3D); one ``radius`` [m] per axis makes an ellipse or ellipsoid.

    The lattice is the mirror image of itself about ``center`` [m], so the centre of mass is exact.
    """
    center, spacing = _point("center", center), _spacing(spacing)
    radii = np.asarray(radius, dtype=np.float64)
    _need(
        radii.shape in ((), center.shape) and bool(np.isfinite(radii).all() and (radii > 0).all()),
        f"radius must be one number > 0 m or {len(center)}, one per axis, got {radius}.",
    )
    radii = np.broadcast_to(radii, center.shape)
    offset = _lattice(np.zeros_like(center), 2 * _count(radii, spacing), spacing)
    offset = offset[((offset / radii) ** 2).sum(axis=1) <= 1.0]
    return Particles(center + offset, spacing ** len(center))


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
        source: Path of a picture (needs Pillow), a Pillow image, or an array (row, column): boolean, where True is inside
            whatever ``inside`` says, or grey as uint8, uint16 or floats from 0 (black) to 1 (white).
        lower: Where the picture's lower left corner comes to lie [m].
        height: Height of the whole picture, margins included [m]; its width follows from its pixels.
        spacing: Distance of neighbouring particles [m]. A particle is made where at least half of its cell is inside, so
            with spacing = height / rows each pixel inside makes one particle.
        inside: ``dark`` takes what is dark on white paper (transparent is paper), ``light`` what is light on black,
            ``opaque`` what is not transparent.
        threshold: Grey or opacity between 0 and 1 that parts the inside from the outside.
    """
    lower, spacing = _point("lower", lower), _spacing(spacing)
    _need(len(lower) == 2, f"a picture is flat: lower needs 2 numbers, got {lower}.")
    _need(math.isfinite(height) and height > 0, f"height must be > 0 m, got {height}.")
    mask = _silhouette(source, inside, threshold)
    pixel = height / len(mask)
    size = np.array(mask.shape[::-1])  # columns, rows
    count = _count(size * pixel, spacing)
    across, up = (_overlap(cells, pixels, spacing / pixel) for cells, pixels in zip(count, size, strict=True))
    covered = across @ mask[::-1].T @ up.T  # share of each cell that is inside, (x, y)
    chosen = covered.ravel() >= 0.5 - 1e-9  # a half-covered cell counts, whatever its rounding
    _need(
        bool(chosen.any()),
        f"the picture has nothing inside ({mask.mean():.1%} of its pixels are {inside} at threshold {threshold}): "
        "try another inside or threshold, or a smaller spacing.",
    )
    return Particles(_lattice(lower + count * spacing / 2, count, spacing)[chosen], spacing**2)


def mesh(source: "str | os.PathLike[str] | trimesh.Trimesh", spacing: float) -> Particles:
    """Fill a closed triangle mesh with particles; needs trimesh (``pip install softmpm[mesh]``).

    Args:
        source: Path of a mesh file, or a ``trimesh.Trimesh``, in metres. A file in millimetres wants
            ``trimesh.load_mesh(path).apply_scale(1e-3)``. A face may turn out or in, as long as all do alike.
        spacing: Distance of neighbouring particles [m]; the lattice is centred in the mesh's bounding box.

    A particle is inside where the winding number is above one half (Jacobson et al. 2013), so parts may overlap.
    """
    spacing = _spacing(spacing)
    vertices, faces = _closed_surface(source)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    count = np.ceil((high - low) / spacing - 1e-9).astype(np.int64)
    points = _lattice((low + high) / 2, count, spacing)
    unit = float((high - low).max())  # the query is float32: keep its numbers near one
    inside = _winding_inside((vertices - low) / unit, faces, (points - low) / unit)
    return Particles(points[inside], spacing**3)


def _need(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _point(name: str, value: Sequence[float]) -> np.ndarray:
    point = np.asarray(value, dtype=np.float64)
    _need(
        point.shape in ((2,), (3,)) and bool(np.isfinite(point).all()),
        f"{name} must be 2 or 3 finite numbers [m], got {value}.",
    )
    return point


def _spacing(spacing: float) -> float:
    _need(math.isfinite(spacing) and spacing > 0, f"spacing must be > 0 m, got {spacing}.")
    return float(spacing)


def _count(extent: np.ndarray, spacing: float) -> np.ndarray:
    """Nearest whole number of cells; a tie goes up, whatever its rounding."""
    return np.floor(extent / spacing + 0.5 + 1e-9).astype(np.int64)


def _lattice(center: np.ndarray, count: np.ndarray, step: np.ndarray | float) -> np.ndarray:
    """Centres of count cells of size step about a point, shape (prod(count), dim), the last axis fastest."""
    cells = math.prod(int(n) for n in count)
    _need(
        cells <= CELL_LIMIT,
        f"the shape spans {cells:.2g} lattice cells, at most {CELL_LIMIT:.2g} are allowed: "
        "make the spacing larger, and check that lengths are in metres.",
    )
    steps = np.broadcast_to(step, center.shape)
    axes = [c + (np.arange(n) + 0.5 - n / 2) * h for c, n, h in zip(center, count, steps, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(center))


def _silhouette(source: Any, inside: Inside, threshold: float) -> np.ndarray:
    """What is inside, as booleans (row, column), the top row first."""
    _need(inside in ("dark", "light", "opaque"), f"inside must be dark, light or opaque, got {inside!r}.")
    _need(0 < threshold < 1, f"threshold must lie between 0 and 1, got {threshold}.")
    if isinstance(source, (str, os.PathLike)):
        with _pillow().open(source) as picture:
            values = _grey(picture, inside)
    elif hasattr(source, "convert"):
        values = _grey(source, inside)
    else:
        values = np.asarray(source)
        _need(inside != "opaque", "an array has no transparency: use inside='dark' or 'light', or a boolean array.")
    _need(
        values.ndim == 2 and values.size > 0,
        f"a picture as an array needs shape (row, column), got {values.shape}; for colours pass a Pillow image.",
    )
    if values.dtype == bool:
        return values
    values = _unit(values)
    return values < threshold if inside == "dark" else values > threshold


def _grey(picture: "PIL.Image.Image", inside: Inside) -> np.ndarray:
    if picture.mode.startswith("I") or picture.mode == "F":  # 16 bits, or floats: has neither colour nor transparency
        _need(inside != "opaque", "the picture has no transparency: use inside='dark' or 'light'.")
        return np.asarray(picture).astype(np.float64 if picture.mode == "F" else np.uint16)
    rgba = picture.convert("RGBA")
    if inside == "opaque":
        _need(picture.has_transparency_data, "the picture has no transparency: use inside='dark' or 'light'.")
        return np.asarray(rgba.getchannel("A"))
    image_module = _pillow()
    paper = image_module.new("RGBA", rgba.size, "white" if inside == "dark" else "black")
    return np.asarray(image_module.alpha_composite(paper, rgba).convert("L"))


def _pillow() -> Any:
    try:
        import PIL.Image
    except ImportError as error:
        raise ImportError("reading a picture needs Pillow: pip install pillow, or pass an array.") from error
    return PIL.Image


def _unit(values: np.ndarray) -> np.ndarray:
    if values.dtype in (np.uint8, np.uint16):
        return values / np.iinfo(values.dtype).max
    _need(
        np.issubdtype(values.dtype, np.floating) and bool(((values >= 0) & (values <= 1)).all()),
        f"grey values must be uint8, uint16 or floats from 0 to 1, got {values.dtype} "
        f"from {values.min()} to {values.max()}.",
    )
    return values


def _overlap(cells: int, pixels: int, width: float) -> np.ndarray:
    """Share of each cell (``width`` pixels wide) that each pixel covers, along one axis: (cell, pixel)."""
    left = np.arange(cells)[:, None] * width
    edge = np.arange(pixels)[None, :]
    return np.clip(np.minimum(left + width, edge + 1) - np.maximum(left, edge), 0.0, None) / width


def _closed_surface(source: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (vertex, 3) and outward faces (face, 3) of a mesh that has an inside."""
    if isinstance(source, (str, os.PathLike)):
        if not os.path.isfile(source):
            raise FileNotFoundError(f"there is no mesh file {os.fspath(source)!r}.")
        try:
            import trimesh
        except ImportError as error:
            raise ImportError("reading a mesh needs trimesh: pip install softmpm[mesh].") from error
        source = trimesh.load_mesh(source)
    _need(
        hasattr(source, "is_watertight") and len(getattr(source, "faces", ())) > 0,
        f"mesh needs a path or a trimesh.Trimesh with faces, got {type(source).__name__}.",
    )
    vertices, faces = np.asarray(source.vertices, np.float64), np.asarray(source.faces)
    if not source.is_watertight:
        _, uses = np.unique(np.asarray(source.edges_sorted), axis=0, return_counts=True)
        raise ValueError(
            f"the mesh is not closed: {(uses != 2).sum()} of its {len(uses)} edges do not join two faces; try "
            "merge_vertices(), then trimesh.repair.fill_holes(), or close it in the program that made it."
        )
    _need(
        bool(source.is_winding_consistent) and source.volume != 0,
        "the mesh's faces do not all turn the same way, so it has no inside: call trimesh.repair.fix_normals on it.",
    )
    return vertices, faces if source.volume > 0 else faces[:, ::-1]


def _winding_inside(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    surface = wp.Mesh(
        wp.array(vertices, dtype=wp.vec3, device="cpu"),
        wp.array(np.ascontiguousarray(faces, dtype=np.int32).ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    queries = wp.array(points, dtype=wp.vec3, device="cpu")
    inside = wp.zeros(len(points), dtype=wp.int32, device="cpu")
    wp.launch(_inside, dim=len(points), inputs=[surface.id, queries], outputs=[inside], device="cpu")
    return inside.numpy().astype(bool)


@wp.kernel
def _inside(
    # In:
    surface: wp.uint64,
    points: wp.array[wp.vec3],
    # Out:
    inside: wp.array[wp.int32],
):
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(surface, points[i], 10.0)  # the mesh spans 1
    if query.result and query.sign < 0.0:
        inside[i] = 1
