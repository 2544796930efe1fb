"""Points of the outlines of all bodies, at which separating walls act, with constants of the material around them."""

import numpy as np
import torch
from torch import Tensor

from softmpm.scene.materials import Material
from softmpm.scene.scene import Scene
from softmpm.state import State


class SurfacePoints:
    """Surface points of all bodies.

    Attributes:
        count: Number of points.
        points: Rest positions [m], shape (point, dim), float64.
        areas: Area of each point [m²], shape (point,), float64.
        stiffness: Stiffness of the spring that a sticking point hangs on [Pa/m], shape (point,), float64.
        waves: Speed of pressure waves at each point [m/s], shape (point,), float64.
        walls: Number of each separating wall in ``scene.walls``, for the axis ``wall`` of :func:`softmpm.contact_forces`.
        normals: Unit normals of these walls, shape (wall, dim), float64.
    """

    def __init__(self, scene: Scene, device: torch.device):
        outlines = [body.particles.outline for body in scene.bodies if body.particles.outline is not None]
        counts = [len(outline) for outline in outlines]
        density = np.repeat([body.material.density for body in scene.bodies], counts)
        modulus = np.repeat([longitudinal_modulus(body.material) for body in scene.bodies], counts)
        self.walls = tuple(k for k, wall in enumerate(scene.walls) if wall.contact == "separate")
        normals = [scene.walls[k].normal for k in self.walls]
        self.device, self.count = device, sum(counts)
        self.points = self._tensor(np.concatenate([outline.points for outline in outlines]))
        self.areas = self._tensor(np.concatenate([outline.areas for outline in outlines]))
        self.stiffness = self._tensor(4.0 * modulus / scene.grid.spacing)
        self.waves = self._tensor(np.sqrt(modulus / density))
        self.normals = self._tensor(normals)

    def shown(self, state: State) -> Tensor:
        """Places of the points in a state [m], shape (world, point, dim)."""
        raise NotImplementedError

    def _tensor(self, values, dtype: type = np.float64) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, dtype=dtype)).to(self.device)


class CarriedPoints(SurfacePoints):
    """Surface points that particles carry, on the moving grid.

    Attributes:
        nearest: The particle of the same body nearest at rest to each point, shape (point,), int64. Of equally near ones it is the one
            closer to the middle of the body, which symmetric bodies share.
        arms: Positions of the points from these particles at rest [m], shape (point, dim), float64.
    """

    def __init__(self, scene: Scene, device: torch.device):
        from scipy.spatial import KDTree

        super().__init__(scene, device)
        nearest, arms, first = [], [], 0
        for body in scene.bodies:
            outline, positions = body.particles.outline, body.particles.positions
            assert outline is not None
            inward = 1e-6 * (positions.mean(axis=0) - outline.points)
            found = KDTree(positions).query(outline.points + inward)[1]
            nearest.append(first + found)
            arms.append(outline.points - positions[found])
            first += len(positions)
        self.nearest = self._tensor(np.concatenate(nearest), np.int64)
        self.arms = self._tensor(np.concatenate(arms))

    def shown(self, state: State) -> Tensor:
        """Places of the points in a state [m], shape (world, point, dim), float64: those of (K8)."""
        x, F = state.x.double(), state.F.double()
        if state.low is not None:
            x, F = x + state.low.x.double(), F + state.low.F.double()
        return x[:, self.nearest] + (F[:, self.nearest] @ self.arms[..., None])[..., 0]


def longitudinal_modulus(material: Material) -> float:
    """λ + 2μ [Pa]."""
    young, poisson = material.young, material.poisson
    return young * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))
