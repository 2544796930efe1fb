"""The moving part of a picture: one world at one instant, of a state or of a recorded simulation. NumPy arrays."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softmpm.forces import contact_forces
from softmpm.model import Model
from softmpm.recording.frame_values import strain
from softmpm.recording.reader import Recording
from softmpm.recording.surroundings import Surroundings
from softmpm.scene.scene import Scene
from softmpm.state import State

Pose = tuple[Tensor, Tensor]
"""Normals, shape (world, wall, dim), and offsets [m], shape (world, wall), of all walls."""


@dataclass(frozen=True)
class Instant:
    """One world at one instant."""

    positions: np.ndarray
    """[m], shape (particle, dim)."""
    speed: np.ndarray
    """[m/s], shape (particle,)."""
    strain: np.ndarray
    """Size of the Green strain [-], shape (particle,)."""
    activation: np.ndarray | None = None
    """[-], shape (muscle,)."""
    places: np.ndarray | None = None
    """Surface points [m], shape (point, dim)."""
    traction: np.ndarray | None = None
    """Of the separating walls at these points [Pa], shape (wall, point, dim)."""
    time: float | None = None
    """[s], as recorded."""
    normals: np.ndarray | None = None
    """Of all walls, shape (wall, dim); None where they stand as in the scene."""
    offsets: np.ndarray | None = None
    """Of all walls [m], shape (wall,), likewise."""


def at_rest(scene: Scene) -> Instant:
    """A scene at rest, with the outlines that are known."""
    parts = [body.particles for body in scene.bodies]
    positions = np.concatenate([part.positions for part in parts])
    still = np.zeros(len(positions))
    outlines = [part.outline.points for part in parts if part.outline is not None]
    places = np.concatenate(outlines) if outlines else None
    return Instant(positions, still, still, places=places)


def of_state(
    model: Model, state: State, activation: Tensor | None, world: int, pose: Pose | None = None
) -> Instant:
    """One world of a state, with its surface points and the tractions there if the state has them."""
    x, v, F = (array(tensor[world]) for tensor in (state.x, state.v, state.F))
    places = traction = None
    if model.surface is not None and (state.nodes is not None or state.surface is not None):
        with torch.no_grad():
            forces = contact_forces(model, state)
        places, traction = array(forces.points[world]), array(forces.traction[world])
    normals, offsets = (None, None) if pose is None else (array(values[world]) for values in pose)
    if activation is not None:
        activation = activation if activation.ndim == 1 else activation[world]
    return Instant(
        positions=x,
        speed=np.linalg.norm(v, axis=-1),
        strain=strain(torch.from_numpy(F)).numpy(),
        activation=None if activation is None else array(activation),
        places=places,
        traction=traction,
        normals=normals,
        offsets=offsets,
    )


def framed(place: Surroundings, instants: Sequence[Instant]) -> tuple[np.ndarray, np.ndarray]:
    """Box to frame [m]: around the particles of some instants, with the walls that are near, wherever these have been."""
    walls = [np.column_stack(walls_of(place, instant)) for instant in instants]
    each = np.unique(np.concatenate(walls), axis=0)
    return place.window(
        np.concatenate([instant.positions for instant in instants]), each[:, :-1], each[:, -1]
    )


def walls_of(place: Surroundings, instant: Instant) -> tuple[np.ndarray, np.ndarray]:
    """Normals and offsets of the walls at an instant."""
    if instant.normals is None or instant.offsets is None:
        return place.normals, place.offsets
    return instant.normals, instant.offsets


def recorded(recording: Recording, rows: np.ndarray) -> Iterator[Instant]:
    """Frames of one recorded simulation."""
    for row in rows[:, None]:
        found = {name: recording.read(name, row)[1] for name in ("time", "x", "v", "strain", "activation")}
        parts = {name: recording.read(name, row)[1] for name in ("places", "traction", "normals", "offsets")}
        activation = found["activation"][0]
        yield Instant(
            positions=found["x"][0].astype(float),
            speed=np.linalg.norm(found["v"][0], axis=-1),
            strain=found["strain"][0],
            activation=activation if activation.size and np.isfinite(activation).all() else None,
            time=float(found["time"][0]),
            **{name: values[0].astype(float) for name, values in parts.items() if len(values)},
        )


def array(tensor: Tensor) -> np.ndarray:
    """Values of a tensor without its history, in float64."""
    return tensor.detach().to("cpu", torch.float64).numpy()
