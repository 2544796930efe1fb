"""Format of a recording: an HDF5 file of tables that only grow, one row at a time.

    episode           {iteration, attributes}       one row per recorded simulation
    scalar            {iteration, name, value}      one row per number, such as a loss
    frame/index       {episode, time, field, latent, force, traction, places, normals, offsets}
                                                    one row per frame; its rows of the last seven tables, or -1
    frame/x, frame/v  (frame, particle, dim)        [m], [m/s]
    frame/strain      (frame, particle)             size of the Green strain [-], see writer.py
    frame/activation  (frame, muscle)               [-], NaN where none was given
    field/velocity    (row, *nodes, dim)            grid velocity [m/s]
    latent/value      (row, size)                   what an observer saw
    force/total       (row, wall, dim)              force of each separating wall [N]
    force/traction    (row, wall, point, dim)       force per area at rest at surface points [Pa]
    force/places      (row, point, dim)             where these points are [m]
    wall/normals      (row, wall, dim)              of all walls, where they are not those of the scene
    wall/offsets      (row, wall)                   likewise [m]
    static/*                                        rest shape, muscles, walls, surface points

A row of a table with names is complete when its first number is not negative; HDF5 shows the fill value -1
until then. Version 1 has no forces and no surface points, before version 3 muscles have no names, and before version 4 walls no poses.
"""

from typing import cast

import h5py
import numpy as np

from softmpm.model import Model
from softmpm.scene.actuators import LONGEST_NAME
from softmpm.scene.scene import CONTACTS

FORMAT, VERSION = "softmpm recording", 4
EPISODE = np.dtype([("iteration", "<i8"), ("attributes", "S4096")])
SCALAR = np.dtype([("iteration", "<i8"), ("name", "S64"), ("value", "<f8")])
_FIRST_FRAME = [("episode", "<i8"), ("time", "<f8"), ("field", "<i8"), ("latent", "<i8")]
_WITH_FORCES = [*_FIRST_FRAME, ("force", "<i8"), ("traction", "<i8"), ("places", "<i8")]
FRAME = np.dtype([*_WITH_FORCES, ("normals", "<i8"), ("offsets", "<i8")])
FRAMES = {
    1: np.dtype(_FIRST_FRAME),
    **dict.fromkeys((2, 3), np.dtype(_WITH_FORCES)),
    4: FRAME,
}
"""Rows of ``frame/index`` by version."""
REAL, INDEX = np.dtype("<f4"), np.dtype("<i8")
Layout = tuple[np.dtype, str]
"""Type of the numbers, and the axes."""

STATIC = {  # name: type, axes. p particles, d dim, m muscles, w walls, k separating walls, s surface points
    "positions": (REAL, "pd"),
    "volume": (REAL, "p"),
    "body": (INDEX, "p"),
    "particle": (INDEX, "p"),
    "gravity": (REAL, "d"),
    "muscle": (np.dtype("u1"), "mp"),
    "muscle_direction": (REAL, "md"),
    "muscle_strength": (REAL, "m"),
    "muscle_name": (np.dtype(f"S{4 * LONGEST_NAME}"), "m"),  # UTF-8
    "wall_normal": (REAL, "wd"),
    "wall_offset": (REAL, "w"),
    "wall_friction": (REAL, "w"),
    "wall_contact": (np.dtype(f"S{max(map(len, CONTACTS))}"), "w"),
    "grid_shape": (INDEX, "d"),
    "surface_wall": (INDEX, "k"),
    "surface_point": (INDEX, "s"),
    "surface_area": (REAL, "s"),
}
TABLES = {  # as above; r rows, n the nodes of the grid (dim axes), l the size of the latent
    "episode": (EPISODE, "r"),
    "scalar": (SCALAR, "r"),
    "frame/index": (FRAME, "r"),
    "frame/x": (REAL, "rpd"),
    "frame/v": (REAL, "rpd"),
    "frame/strain": (REAL, "rp"),
    "frame/activation": (REAL, "rm"),
    "field/velocity": (REAL, "rnd"),
    "latent/value": (REAL, "rl"),
    "force/total": (REAL, "rkd"),
    "force/traction": (REAL, "rksd"),
    "force/places": (REAL, "rsd"),
    "wall/normals": (REAL, "rwd"),
    "wall/offsets": (REAL, "rw"),
}
SINCE = {
    **dict.fromkeys(("surface_wall", "surface_point", "surface_area"), 2),
    **dict.fromkeys(("force/total", "force/traction", "force/places"), 2),
    "muscle_name": 3,
    **dict.fromkeys(("wall/normals", "wall/offsets"), 4),
}
"""Version since which files have a name of :data:`STATIC` or :data:`TABLES`; others have been there from the first."""
PER_FRAME = ("x", "v", "strain", "activation")
PARTS = {
    "field": "field/velocity",
    "latent": "latent/value",
    "force": "force/total",
    "traction": "force/traction",
    "places": "force/places",
    "normals": "wall/normals",
    "offsets": "wall/offsets",
}
"""Tables with a row only for the frames that have one."""
_LATENT_CHUNK, _LATENT_MOST = 64, 65536


def stored(names: dict[str, Layout], version: int) -> dict[str, Layout]:
    """Those of :data:`STATIC` or :data:`TABLES` that files of a version have."""
    found = {name: layout for name, layout in names.items() if version >= SINCE.get(name, 1)}
    return found | ({"frame/index": (FRAMES[version], "r")} if "frame/index" in found else {})


def chosen(count: int, most: int | None) -> np.ndarray:
    """At most so many of ``count`` things, evenly at random, the same ones every time; in ascending order."""
    if most is None or most >= count:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def static_values(model: Model, max_particles: int | None, max_points: int | None) -> dict[str, np.ndarray]:
    """Constant data of the recorded particles and surface points."""
    scene, n, surface = model.scene, model.particle_count, model.surface
    particle = chosen(n, max_particles)
    point = chosen(0 if surface is None else surface.count, max_points)
    member = np.zeros((len(scene.muscles), n))
    for row, muscle in zip(member, scene.muscles, strict=True):
        row[muscle.particles] = 1
    bodies, dim = scene.bodies, scene.grid.dim
    none = (0.0,) * dim  # of an actuator without fibres
    values = {
        "positions": np.concatenate([b.particles.positions for b in bodies])[particle],
        "volume": np.concatenate([b.particles.volume for b in bodies])[particle],
        "body": np.repeat(np.arange(len(bodies)), [len(b.particles) for b in bodies])[particle],
        "particle": particle,
        "gravity": scene.gravity,
        "muscle": member[:, particle],
        "muscle_direction": np.array([getattr(m, "direction", none) for m in scene.muscles]).reshape(-1, dim),
        "muscle_strength": [m.strength for m in scene.muscles],
        "muscle_name": [m.name.encode() for m in scene.muscles],
        "wall_normal": np.array([w.normal for w in scene.walls]).reshape(-1, dim),
        "wall_offset": [w.offset for w in scene.walls],
        "wall_friction": [w.friction for w in scene.walls],
        "wall_contact": [w.contact for w in scene.walls],
        "grid_shape": scene.grid.shape,
        "surface_wall": model.spec.surface_walls,
        "surface_point": point,
        "surface_area": np.zeros(0) if surface is None else surface.areas.cpu().numpy()[point],
    }
    return {name: np.asarray(values[name]).astype(dtype) for name, (dtype, _) in STATIC.items()}


def create(file: h5py.File, model: Model, static: dict[str, np.ndarray]) -> None:
    """Create all attributes and tables of the file; afterwards only rows are added."""
    grid = model.scene.grid
    file.attrs["format"], file.attrs["version"] = np.bytes_(FORMAT), VERSION
    file.attrs["dt"], file.attrs["spacing"] = model.scene.dt, grid.spacing
    file.attrs["share"] = len(static["particle"]) / model.particle_count
    for name, values in static.items():
        checksum = {"fletcher32": True, "chunks": values.shape} if values.size else {}
        file.create_dataset(f"static/{name}", data=values, **checksum)
    size = {
        "p": (len(static["particle"]),),
        "d": (grid.dim,),
        "m": (len(model.scene.muscles),),
        "n": tuple(grid.shape),
        "w": static["wall_offset"].shape,
        "k": static["surface_wall"].shape,
        "s": static["surface_point"].shape,
    }
    for name, (dtype, axes) in TABLES.items():
        if axes == "rl":
            _create_table(file, name, dtype, (0,), (_LATENT_MOST,), (_LATENT_CHUNK,))
        else:
            row = sum((size[axis] for axis in axes[1:]), ())
            most = tuple(max(n, 1) for n in row)  # HDF5 has no chunks of size 0
            _create_table(file, name, dtype, row, most, most)


def _create_table(file: h5py.File, name: str, dtype: np.dtype, row: tuple, most: tuple, chunk: tuple) -> None:
    """Create an empty table. Each row is one HDF5 chunk, which is written once, so that a kill cannot damage older rows."""
    fill = np.zeros((), dtype)
    if dtype.names:
        fill[dtype.names[0]] = -1
    squeeze = (
        {} if dtype in (SCALAR, FRAME) else {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    )
    file.create_dataset(
        name,
        (0, *row),
        dtype,
        maxshape=(None, *most),
        chunks=(1, *chunk),
        fillvalue=fill,
        fletcher32=True,
        **squeeze,
    )


def tables(file: h5py.File) -> dict[str, h5py.Dataset]:
    """All tables of a file that :func:`create` made."""
    return {name: cast(h5py.Dataset, file[name]) for name in TABLES}


def put(table: h5py.Dataset, start: int, rows: np.ndarray) -> None:
    """Write rows at ``start``, which is the end of a table or the first row of a failed attempt."""
    shape = (max(len(table), start + len(rows)), *rows.shape[1:])
    if table.shape != shape:
        table.resize(shape)
    table[start : start + len(rows)] = rows


def complete(rows: np.ndarray) -> np.ndarray:
    """Rows of a table up to the first unfinished one, which a killed run may have left."""
    names = rows.dtype.names or ("",)
    unfinished = np.flatnonzero(rows[names[0]] < 0)
    return rows[: unfinished[0]] if len(unfinished) else rows
