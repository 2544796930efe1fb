"""Inside of a closed triangle mesh: where its winding number is above one half, so parts may overlap.

Source: Jacobson et al. 2013, "Robust inside-outside segmentation using generalized winding numbers". Warp
answers it on the CPU; trimesh's own test would need rtree.
"""

import os
from typing import Any

import numpy as np
import warp as wp

from softmpm.kernels.compile import launch
from softmpm.scene.boundary import split_triangles, triangle_outline
from softmpm.scene.cut_cells import inward, share_inside
from softmpm.scene.outline import Outline
from softmpm.validate import need

wp.set_module_options({"enable_backward": False})  # a shape is not differentiated


def closed_surface(source: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (vertex, 3) and outward faces (face, 3) of a mesh file or trimesh object with an inside."""
    if isinstance(source, (str, os.PathLike)):
        source = _load(source)
    need(
        np.ndim(getattr(source, "faces", ())) == 2 and len(source.faces) > 0,
        f"mesh needs a path or a trimesh.Trimesh with faces, got {type(source).__name__}.",
    )
    vertices, faces = np.asarray(source.vertices, np.float64), np.asarray(source.faces)
    need(
        0 <= faces.min() <= faces.max() < len(vertices),
        f"the mesh's faces must be made of its {len(vertices)} vertices, got vertex {faces.max()}.",
    )
    size = float(np.ptp(vertices, axis=0).min())
    need(
        bool(np.isfinite(vertices).all()) and size > 1e-6 * np.abs(vertices).max(),
        f"the mesh's vertices must be finite and not lie farther from the origin than a million times its smallest side, got "
        f"{np.abs(vertices).max():.4g} m and {size:.4g} m: check its units, or move it to the origin with "
        "apply_translation(-mesh.centroid).",
    )
    if not source.is_watertight:
        _, joined = np.unique(np.asarray(source.edges_sorted), axis=0, return_counts=True)
        raise ValueError(
            f"the mesh is not closed: {(joined != 2).sum()} of its {len(joined)} edges do not join two faces; "
            "try merge_vertices(), then trimesh.repair.fill_holes, or close it where it was drawn."
        )
    turned = (
        "the mesh's faces do not all turn the same way, so it has no inside: try trimesh.repair.fix_normals."
    )
    need(bool(source.is_winding_consistent), turned)
    part = _parts(faces)
    volume = _volumes(vertices, faces, part)
    if volume.sum() < 0.0:  # all faces may turn inwards
        faces, volume = faces[:, ::-1], -volume
    _refuse_inverted_parts(vertices, faces, part, volume)
    need(volume.sum() != 0.0, turned)
    return vertices, faces


def _refuse_inverted_parts(
    vertices: np.ndarray, faces: np.ndarray, part: np.ndarray, volume: np.ndarray
) -> None:
    """Refuse parts of negative volume, except cavities, which have material all around them."""
    if not (volume < 0.0).any():
        return
    negative, size = np.flatnonzero(volume < 0.0), float(np.ptp(vertices, axis=0).max())
    outlines = [triangle_outline(split_triangles(vertices[faces[part == k]], size / 32)) for k in negative]
    beside = np.concatenate([outline.points - 1e-5 * size * outline.normals for outline in outlines])
    start = np.cumsum([0] + [len(outline.points) for outline in outlines[:-1]])
    others = faces[volume[part] >= 0.0]
    enclosed = winding_inside(vertices, others, beside)  # and not flush with them
    material = winding_inside(vertices, faces, beside)  # nowhere for what lies in a cavity
    cavity = np.logical_and.reduceat(enclosed, start) & np.logical_or.reduceat(material, start)
    inverted = int((~cavity).sum())
    need(
        inverted == 0,
        f"{inverted} of the mesh's {len(volume)} parts {'is' if inverted == 1 else 'are'} turned inside out against the rest, and "
        "no cavity within it: try trimesh.repair.fix_normals(mesh, multibody=True), which turns every part outwards and fills "
        "cavities, or join the parts again with part.invert() for those that are wrong.",
    )


def _parts(faces: np.ndarray) -> np.ndarray:
    """Number of the part of each face, from 0; faces of a part are connected by edges, each of which joins two."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)  # the two faces of an edge become neighbours
    one, other = (order // 3).reshape(-1, 2).T
    links = coo_array((np.ones(len(one), dtype=bool), (one, other)), shape=(len(faces), len(faces)))
    return connected_components(links, directed=False)[1]


def _volumes(vertices: np.ndarray, faces: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Volume of each part, negative if it is turned inside out; 0 for a sheet without thickness, whatever its rounding."""
    corner = vertices[faces]
    middle = np.stack([np.bincount(part, x) for x in corner.mean(axis=1).T], axis=1)
    a, b, c = np.moveaxis(corner - (middle / np.bincount(part)[:, None])[part][:, None], 1, 0)
    volume = np.bincount(part, np.einsum("fi,fi->f", a, np.cross(b, c)) / 6)
    area = np.bincount(part, np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    return np.where(np.abs(volume) > 1e-9 * area**1.5, volume, 0.0)


def winding_inside(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Inside test of points (point, 3), as booleans."""
    return _nearest(vertices, faces, points)[0]


def mesh_coverage(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, width: float) -> np.ndarray:
    """Share of a small cube of this width around each point (point, 3) that lies inside."""
    inside, nearest, face = _nearest(vertices, faces, points)
    distance = np.linalg.norm(points - nearest, axis=1) * np.where(inside, -1.0, 1.0)
    share = share_inside(distance, width)
    close = np.flatnonzero((share > 0.0) & (np.abs(distance) < width / 2))
    corner = vertices[faces[face[close]]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    beyond = 0.05 * width  # of a surface, where the outside must be; else that face lies within another part
    shift = 0.01 * width
    start, direction = inward(points[close], nearest[close], -normal, distance[close], shift)
    thickness = shift + _ray_length(vertices, faces, start, direction, width)
    thin = np.flatnonzero(np.isfinite(thickness))
    opposite = nearest[close[thin]] + (thickness[thin] + beyond)[:, None] * direction[thin]
    thickness[thin[winding_inside(vertices, faces, opposite)]] = np.inf
    share[close] = share_inside(distance[close], width, thickness)
    covered = inside[close] & winding_inside(vertices, faces, nearest[close] + beyond * normal)
    share[close[covered]] = 1.0
    return share


def near_surface(
    vertices: np.ndarray, faces: np.ndarray, lower: np.ndarray, count: np.ndarray, spacing: float
) -> np.ndarray:
    """Cells of a lattice from ``lower`` that the surface may cross, as booleans (prod(count),)."""
    from scipy.ndimage import binary_dilation

    points = split_triangles(vertices[faces], spacing / 2).mean(
        axis=1
    )  # no part of a triangle is a cell away
    cell = np.clip(np.floor((points - lower) / spacing).astype(np.int64), 0, count - 1)
    near = np.zeros(count, dtype=bool)
    near[tuple(cell.T)] = True
    return binary_dilation(near, np.ones((3, 3, 3))).ravel()


def mesh_outline(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> Outline:
    """Outline of a closed surface: its triangles, split to the spacing, without those that lie within another part.

    Exact where no parts overlap.
    """
    outline = triangle_outline(split_triangles(vertices[faces], spacing))
    beyond = outline.points + 0.01 * spacing * outline.normals  # a surface has the outside there
    free = ~winding_inside(vertices, faces, beyond)
    return Outline(outline.points[free], outline.normals[free], outline.areas[free])


def _nearest(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inside test of points (point, 3), the nearest point of the surface, and its face."""
    surface, low, unit = _surface(vertices, faces)
    queries = wp.array((points - low) / unit, dtype=wp.vec3, device="cpu")
    inside = wp.zeros(len(points), dtype=wp.int32, device="cpu")
    nearest = wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    face = wp.zeros(len(points), dtype=wp.int32, device="cpu")
    launch(_query, len(points), [surface.id, queries, inside, nearest, face], wp.get_device("cpu"))
    return inside.numpy().astype(bool), low + unit * nearest.numpy().astype(np.float64), face.numpy()


def _ray_length(
    vertices: np.ndarray, faces: np.ndarray, points: np.ndarray, directions: np.ndarray, most: float
) -> np.ndarray:
    """Distance of each point from the surface along a unit vector (point, 3) [m], shape (point,); inf above ``most``."""
    surface, low, unit = _surface(vertices, faces)
    starts = wp.array((points - low) / unit, dtype=wp.vec3, device="cpu")
    along = wp.array(directions, dtype=wp.vec3, device="cpu")
    length = wp.full(len(points), np.inf, dtype=wp.float32, device="cpu")
    launch(_cast, len(points), [surface.id, starts, along, most / unit, length], wp.get_device("cpu"))
    return unit * length.numpy().astype(np.float64)


def _surface(vertices: np.ndarray, faces: np.ndarray) -> tuple[wp.Mesh, np.ndarray, float]:
    """The mesh shifted and scaled to span one, as queries are in float32; the shift and the unit [m]."""
    low, unit = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    surface = wp.Mesh(
        wp.array((vertices - low) / unit, dtype=wp.vec3, device="cpu"),
        wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )
    return surface, low, unit


@wp.kernel
def _cast(
    # In:
    surface: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # pyright: ignore
    directions: wp.array(dtype=wp.vec3),  # pyright: ignore
    most: float,
    # Out:
    length: wp.array(dtype=wp.float32),  # pyright: ignore
):
    i = wp.tid()
    query = wp.mesh_query_ray(surface, points[i], directions[i], most)
    if query.result:  # pyright: ignore
        length[i] = query.t  # pyright: ignore


@wp.kernel
def _query(
    # In:
    surface: wp.uint64,
    points: wp.array(dtype=wp.vec3),  # pyright: ignore
    # Out:
    inside: wp.array(dtype=wp.int32),  # pyright: ignore
    nearest: wp.array(dtype=wp.vec3),  # pyright: ignore
    face: wp.array(dtype=wp.int32),  # pyright: ignore
):
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(surface, points[i], 10.0)  # the mesh spans one
    if query.result:  # pyright: ignore
        nearest[i] = wp.mesh_eval_position(surface, query.face, query.u, query.v)  # pyright: ignore
        face[i] = query.face  # pyright: ignore
        if query.sign < 0.0:  # pyright: ignore
            inside[i] = 1


def _load(path: "str | os.PathLike[str]") -> Any:
    if not os.path.isfile(path):
        raise FileNotFoundError(f"there is no mesh file {os.fspath(path)!r}.")
    try:
        import trimesh

        return trimesh.load_mesh(path)
    except ImportError as error:
        raise ImportError(
            f'reading the mesh {os.fspath(path)!r} needs the package {error.name or "trimesh"}: pip install "softmpm[mesh]".'
        ) from error
    except Exception as error:  # a damaged file meets any error of trimesh's readers, their own mistakes too
        raise ValueError(
            f"{os.fspath(path)!r} cannot be read as a mesh: {type(error).__name__}: {error}; open it in a program for meshes and "
            "save it as STL."
        ) from error
