"""A robot in 3D from a closed triangle mesh; muscles are the particles in boxes, or in vertical slabs along its length."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import softmpm
from softmpm_learn.tasks.own import Muscular, OwnConf, longer_axis, walker
from softmpm_learn.tasks.task import Task
from softmpm_learn.tasks.thinness import warn_of_thin_limbs

TURNS = {
    "z": np.array([(1, 0, 0), (0, 0, 1), (0, -1, 0)]),
    "y": np.eye(3, dtype=int),
}
"""Rotations that bring an axis of the file up, to y, and leave x forward."""
SLACK = 1e-4
"""A particle within this share of the bounding box of a face of a muscle lies on it, whatever its rounding: that of float32 in a file
and of centroids of cut cells is below 1e-6."""


@dataclass(kw_only=True)
class MeshConf(OwnConf):
    """A walker in 3D from a mesh file, whose x axis points forward."""

    name: str = "mesh"
    up: str = "z"
    """Axis of the file that points up: z or y."""
    cells: int | None = 40  # pyright: ignore[reportIncompatibleVariableOverride, reportAssignmentType]
    """Cells of the grid per metre, at least 20, or null for those of task.resolution; work grows with its fourth power."""
    seconds: float = 1.0
    """Length of an episode [s]."""
    slabs: int = 4
    """Number of vertical slabs of equal thickness along x, each a muscle with fibres along x, unless there are boxes."""
    boxes: dict[str, list[float]] = field(default_factory=dict)
    """Muscles by name, with fibres along their longer axes: boxes from x0, y0, z0 to x1, y1, z1 in shares of the bounding box, x
    forward and y up. Of boxes that overlap, the first has the particles."""

    def __post_init__(self):
        super().__post_init__()
        if self.up not in TURNS:
            raise ValueError(f"task.up must be one of {', '.join(TURNS)}; got {self.up!r}.")
        if self.slabs < 1:
            raise ValueError(f"task.slabs must be at least 1, got {self.slabs}.")
        for name, box in self.boxes.items():
            low, high = np.array(box[:3]), np.array(box[3:])
            if len(box) != 6 or not (np.isfinite(box).all() and (low < high).all()):
                raise ValueError(
                    f"task.boxes.{name} must be six numbers, x0, y0, z0 below x1, y1, z1, got {list(box)}."
                )


def mesh(conf: MeshConf) -> Task:
    """Build the walker of a mesh file.

    Raises:
        ValueError: The file cannot be read, is not closed, or holds a robot that does not fit.
    """
    surface = _read(conf.path("a closed mesh, such as an STL file"))
    surface.vertices = np.asarray(surface.vertices, dtype=float) @ TURNS[conf.up].T
    extent = np.ptp(surface.vertices, axis=0)
    if not extent.max() > 0:
        raise ValueError(f"the mesh of {conf.file} is empty.")
    surface.vertices = (surface.vertices - surface.vertices.min(axis=0)) * (conf.size / extent[:2].max())
    try:
        shape = softmpm.mesh(surface, conf.spacing / 2, cut_cells=conf.cut_cells)
    except ValueError as error:
        raise ValueError(f"{conf.file}: {error}") from error
    warn_of_thin_limbs(conf, _voxels(shape.positions, conf.spacing / 2), conf.spacing / 2)
    return walker(conf, [(shape, 1.0)], _muscles(conf, shape.positions))


def _voxels(positions: np.ndarray, width: float) -> np.ndarray:
    """Cells of the lattice that particles were taken from; most lie at the centres of theirs."""
    places = positions / width
    cells = np.rint(places - np.median(places % 1, axis=0)).astype(int)
    cells -= cells.min(axis=0)
    mask = np.zeros(cells.max(axis=0) + 1, dtype=bool)
    mask[tuple(cells.T)] = True
    return mask


def _muscles(conf: MeshConf, rest: np.ndarray) -> list[Muscular]:
    low, high = rest.min(axis=0), rest.max(axis=0)
    share = (rest - low) / (high - low)
    edges = np.linspace(0, 1, conf.slabs + 1)
    slabs = {f"slab{k}": [edges[k], 0.0, 0.0, edges[k + 1], math.inf, math.inf] for k in range(conf.slabs)}
    found, free = [], np.ones(len(rest), dtype=bool)
    for name, box in (conf.boxes or slabs).items():
        lower, upper = np.array(box, dtype=float).reshape(2, 3) - SLACK  # an upper face belongs to the next
        upper[np.array(box[3:]) >= 1.0] = math.inf  # but the far one to the last
        chosen = np.flatnonzero(free & (share >= lower).all(axis=1) & (share < upper).all(axis=1))
        free[chosen] = False
        direction = longer_axis(rest[chosen]) if conf.boxes and len(chosen) else (1.0, 0.0, 0.0)
        found.append(Muscular(name, chosen, direction))
    return found


def _read(path: Path) -> Any:
    try:
        import trimesh

        surface: Any = trimesh.load_mesh(path)
        if not len(surface.faces):
            raise ValueError("it has no triangles")
    except ImportError as error:
        raise ImportError(f'reading {path} needs {error.name}: pip install "softmpm[mesh]".') from error
    except Exception as error:  # a damaged file meets any error of trimesh's readers
        raise ValueError(f"{path} cannot be read as a mesh: {type(error).__name__}: {error}") from error
    return surface
