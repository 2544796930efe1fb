"""The failure of a surface point in words, as those of particles in failure_messages.py: deep inside a wall."""

import math

import torch
from torch import Tensor

from softmpm.model import Model
from softmpm.schemes.inputs import Values
from softmpm.state import State


def deepest(model: Model) -> Tensor:
    """Largest depth of each surface point under a wall [m], shape (point,); the smooth onset lets points sink in by its width."""
    assert model.surface is not None, "the nodes meet the walls here"
    most, width = model.alarms.depth, model.contact_width * model.scene.grid.spacing
    if most is None:
        return torch.full_like(model.surface.waves, math.inf)
    return most * model.scene.dt * model.surface.waves + width


class Penetration:
    """A surface point under a wall.

    Args:
        index: Number of the separating wall times the number of points, plus the point.
        end: State in which its world stopped, with its nodes or surface points.
        values: Inputs of the call in one control step, if they are at hand.
        time: Of the state since the beginning of that control step [s].

    Attributes:
        point: Its number.
        wall: Number of the wall in the scene.
        particle: Number of the particle next to the point at rest.
    """

    def __init__(self, model: Model, world: int, index: int, end: State, values: Values | None, time: float):
        assert model.surface is not None
        number, point = divmod(index, model.surface.count)
        self.model, self.world, self.point = model, world, point
        at_rest = model.surface.points[point]
        self.particle = int((model.positions.double() - at_rest).norm(dim=1).argmin())
        self._place = model.surface.shown(end.detach())[world, point].double()
        self.wall = model.spec.surface_walls[number]
        self._normal, self._offset = self._pose(values or {}, time)

    @property
    def where(self) -> str:
        body = int(self.model.body[self.particle])
        return f"surface point {self.point} (body {body}, next to particle {self.particle})"

    def _pose(self, values: Values, time: float) -> tuple[Tensor, Tensor]:
        """Normal and offset of the wall in that state (C4)."""
        wall = self.model.scene.walls[self.wall]
        if "normal" not in values:
            return self._place.new_tensor(wall.normal), self._place.new_tensor(wall.offset)
        poses = [values[name][0] + time * values[f"{name}_rate"][0] for name in ("normal", "offset")]
        normal, offset = (pose[self.world, self.wall].detach() for pose in poses)
        return normal, offset

    def explain(self) -> tuple[str, str, str, str]:
        """Kind of the failure, the value found, the limit and the remedy."""
        depth = ((self._offset - self._normal @ self._place) / self._normal.norm()).item()
        dx, most = self.model.scene.grid.spacing, deepest(self.model)[self.point].item()
        at = ", ".join(f"{c:.4g}" for c in self._place.tolist())
        value = f"is at ({at}) m, {depth:.4g} m ({depth / dx:.4g} cells) inside wall {self.wall}"
        limit = f"at most {most:.4g} m are allowed, since contact pushes a point out within one substep"
        advice = "Place body and wall apart at the start, and take a stiffer material or a weaker load or activation"
        if self.model.spec.moving:
            advice += ", begin with the pose in which the last call ended, or move the wall more slowly"
        advice += "; alarms=softmpm.Alarms(depth=None) pushes the point out all the same."
        return "in_wall", value, limit, advice
