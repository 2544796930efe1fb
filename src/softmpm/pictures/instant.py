"""The moving part of a picture: one world at one instant, of a state or of a recorded simulation. NumPy arrays."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softmpm.forces import contact_forces
from softmpm.model import Model
from softmpm.recording.reader import Recording
from softmpm.recording.writer import strain
from softmpm.scene.scene import Scene
from softmpm.state import State


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


def at_rest(scene: Scene) -> Instant:
    """A scene at rest, with the outlines that are known."""
    parts = [body.particles for body in scene.bodies]
    positions = np.concatenate([part.positions for part in parts])
    still = np.zeros(len(positions))
    outlines = [part.outline.points for part in parts if part.outline is not None]
    places = np.concatenate(outlines) if outlines else None
    return Instant(positions, still, still, places=places)


def of_state(model: Model, state: State, activation: Tensor | None, world: int) -> Instant:
    """One world of a state, with its surface points and the tractions there if the state has them."""
    x, v, F = (array(tensor[world]) for tensor in (state.x, state.v, state.F))
    places = traction = None
    if model.surface is not None and (state.nodes is not None or state.surface is not None):
        with torch.no_grad():
            forces = contact_forces(model, state)
        places, traction = array(forces.points[world]), array(forces.traction[world])
    if activation is not None:
        activation = activation if activation.ndim == 1 else activation[world]
    return Instant(
        positions=x,
        speed=np.linalg.norm(v, axis=-1),
        strain=strain(torch.from_numpy(F)).numpy(),
        activation=None if activation is None else array(activation),
        places=places,
        traction=traction,
    )


def recorded(recording: Recording, rows: np.ndarray) -> Iterator[Instant]:
    """Frames of one recorded simulation."""
    for row in rows[:, None]:
        found = {name: recording.read(name, row)[1] for name in ("time", "x", "v", "strain", "activation")}
        parts = {name: recording.read(name, row)[1] for name in ("places", "traction")}
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
