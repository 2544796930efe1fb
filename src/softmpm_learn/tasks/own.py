"""Parts of the tasks that read a robot from a file: common settings, size, track and the walker made of the parts.

Positions begin at the lower corner of the robot, x forward and y up; in 3D z is sideways.
"""

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

import softmpm
from softmpm_learn.setting_checks import positive
from softmpm_learn.tasks.task import Resolution, Source, Task, material
from softmpm_learn.tasks.walker import WalkerConf, track, walker_task

START = 0.2
"""Rear end of the robot on the track, to a quarter of a cell [m]."""
HEADROOM = 0.1
"""Free height above the robot [m]."""
RUNWAY = 1.0
"""Least length of the track beyond the robot [m]."""
SIDES = 0.1
"""Free width on either side of a robot in 3D [m]."""
ROUND = 1.1
"""A part whose variance along its longest axis is below this multiple of the next has no longer axis; its fibres lie along x."""


@dataclass(kw_only=True)
class OwnConf(WalkerConf):
    """Settings of a walker that is read from a file."""

    file: str = ""
    """File of the robot. A relative path begins where the program runs; it becomes absolute, so that a run is resumed from anywhere."""
    size: float = 0.3
    """Longer side of the robot, its length or its height [m]."""
    cells: int | None = None
    """Cells of the grid per metre, at least 20; null for those of task.resolution. Good value: four cells or more across the thinnest
    limb."""

    def __post_init__(self):
        super().__post_init__()
        if self.file:
            self.file = str(Path(self.file).absolute())
        positive("task", self, "size", "cells")
        if self.cells_per_metre < 20:
            raise ValueError(f"task.cells must be at least 20 per metre, got {self.cells}.")
        if self.resolution is not Resolution.draft and self.cells_per_metre != self.resolution.value:
            raise ValueError(
                f"task.resolution={self.resolution.name} and task.cells={self.cells} both say how fine the grid is; leave out "
                "task.resolution, or take task.cells=null."
            )

    @property
    def cells_per_metre(self) -> int:
        return self.resolution.value if self.cells is None else self.cells

    def refined(self) -> Self:
        """The same robot on a grid with half as many cells more."""
        return dataclasses.replace(self, cells=math.ceil(1.5 / self.spacing), resolution=Resolution.draft)

    def path(self, what: str) -> Path:
        """The file.

        Raises:
            ValueError: None is named, or it is not there.
        """
        if not self.file:
            raise ValueError(f"task {self.name} reads {what}: task.file=FILE.")
        path = Path(self.file)
        if path.is_dir():
            raise ValueError(f"task.file = {self.file} is a folder; name the file in it.")
        if not path.is_file():
            raise ValueError(
                f"task.file = {self.file}: there is no such file; put it there, or correct the path, of a run in its config.yaml."
            )
        return path


@dataclass(frozen=True, eq=False)
class Muscular:
    """A part of the robot that is a muscle."""

    name: str
    particles: np.ndarray
    """Indices into all particles."""
    direction: tuple[float, ...]
    """Unit fibre direction."""
    label: str = ""
    """Name of the muscle in pictures and recordings; empty for that of the part."""


def walker(
    conf: OwnConf, shapes: Sequence[tuple[softmpm.Particles, float]], muscles: Sequence[Muscular]
) -> Task:
    """A walker on the track.

    Args:
        shapes: Particles with the lower corner of the robot at the origin, and their Young's modulus in units of the setting's; all
            have its viscosity, because a higher one takes a smaller step.
        muscles: Its muscles, which are its regions too; they do not overlap.

    Raises:
        ValueError: There is no muscle, one has no particle, or the robot does not fit the track.
    """
    rest = np.concatenate([shape.positions for shape, _ in shapes])
    grid, walls, height = track(conf)
    _check_size(conf, rest, grid, height)
    if not muscles:
        raise ValueError(
            f"{conf.file} has no muscle, so nothing would move: draw a part in the colour of a muscle of task.legend, such as red "
            "#ff0000, or give voxels the number 3 or 4."
        )
    for muscle in muscles:
        if not len(muscle.particles):
            raise ValueError(
                f"the muscle {muscle.name} of {conf.file} is smaller than a particle, {conf.spacing / 2:.3g} m: "
                "make it or task.size larger, or increase task.cells."
            )
    half, middle = conf.spacing / 2, (rest.min(axis=0) + rest.max(axis=0)) / 2
    # The grid is symmetric about a multiple of half a cell; about another place it would turn the robot.
    forward = half * round((START + middle[0]) / half)
    place = [forward - middle[0], height]
    if rest.shape[1] == 3:
        grid, walls, sideways = _widened(grid, walls, float(np.ptp(rest[:, 2])))
        place.append(sideways - middle[2])
    solid = material(conf)
    bodies = [
        softmpm.Body(shape.moved(place), dataclasses.replace(solid, young=factor * solid.young))
        for shape, factor in shapes
    ]
    regions = {muscle.name: muscle.particles for muscle in muscles}
    passive = np.setdiff1d(np.arange(len(rest)), np.concatenate(list(regions.values())))
    if len(passive):
        regions["body"] = passive
    task = walker_task(
        conf,
        grid,
        walls,
        bodies,
        [
            softmpm.Muscle(
                particles=m.particles, direction=m.direction, strength=conf.strength, name=m.label or m.name
            )
            for m in muscles
        ],
        rest=rest,
        regions=regions,
        torso=np.flatnonzero(rest[:, 1] > np.median(rest[:, 1]) - 1e-3 * conf.spacing),  # whole rows
    )
    digest = hashlib.sha256(Path(conf.file).read_bytes()).hexdigest()
    return dataclasses.replace(task, source=Source(conf.file, digest))


def longer_axis(points: np.ndarray, piece: np.ndarray | None = None) -> tuple[float, ...]:
    """Unit vector along the longest axis of a part, from points (point, dim) spread evenly over it.

    Args:
        piece: Number of the piece that each point belongs to, if the part has several, such as two legs: the axis of their shapes
            counts, not that of their places.
    """
    centred = points - points.mean(axis=0)
    for number in np.unique(piece) if piece is not None else ():
        centred[piece == number] -= centred[piece == number].mean(axis=0)
    variance, axes = np.linalg.eigh(centred.T @ centred)
    if variance[-1] < ROUND * variance[-2]:
        return tuple(np.eye(points.shape[1])[0].tolist())
    axis = axes[:, -1]
    return tuple((axis * np.sign(axis[np.abs(axis).argmax()])).tolist())


def _check_size(conf: OwnConf, rest: np.ndarray, grid: softmpm.Grid, height: float) -> None:
    length, tall = np.ptp(rest[:, :2], axis=0) + conf.spacing / 2
    most = conf.track_length - RUNWAY, (grid.shape[1] - 1) * grid.spacing - height - HEADROOM
    if length > most[0] or tall > most[1]:
        raise ValueError(
            f"the robot of {conf.file} is {length:.3g} m long and {tall:.3g} m high; the track of {conf.track_length:g} m has room for "
            f"{most[0]:.3g} m and {most[1]:.3g} m: make task.size = {conf.size:g} smaller."
        )
    if len(np.unique(np.round(rest[:, 0] / conf.spacing))) < 4 or tall < 2 * conf.spacing:
        raise ValueError(
            f"the robot of {conf.file} is {length:.3g} m long and {tall:.3g} m high, too small for cells of {conf.spacing:.3g} m: "
            "make task.size larger or increase task.cells."
        )


def _widened(
    grid: softmpm.Grid, walls: Sequence[softmpm.Wall], width: float
) -> tuple[softmpm.Grid, list[softmpm.Wall], float]:
    """The track in 3D, for a robot whose particles span this width [m], with a wall on either side: its grid, its walls, and the place
    of its middle along z [m], on a plane of nodes.
    """
    margin = 4 * grid.spacing
    side = math.ceil(((width + grid.spacing) / 2 + SIDES + margin) / grid.spacing) * grid.spacing
    wide = softmpm.Grid(shape=(*grid.shape, round(2 * side / grid.spacing) + 1), spacing=grid.spacing)
    found = [dataclasses.replace(wall, normal=(*wall.normal, 0.0)) for wall in walls]
    found.append(softmpm.Wall(normal=(0.0, 0.0, 1.0), offset=margin))
    found.append(softmpm.Wall(normal=(0.0, 0.0, -1.0), offset=margin - 2 * side))
    return wide, found, side
