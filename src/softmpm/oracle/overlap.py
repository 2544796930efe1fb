"""Particles in the volumes of others, in plain float64 PyTorch, pair by pair. Derivation: docs/math/alarms.md.

|F_q⁻¹ (x_p − x_q)|_∞ ≤ ½ o V_q^(1/dim)   for |X_p − X_q|_∞ > 3 dx                                  (W5)
"""

import numpy as np
import torch
from torch import Tensor

from softmpm.scene.scene import Scene


def intrusion(scene: Scene, x: Tensor, F: Tensor, p: int) -> Tensor:
    """Least o for which particle p is in the volume of each particle (W5), shape (particle,); infinite for those near it at rest.

    Args:
        x, F: Positions and deformation gradients of all particles of a world, shapes (particle, dim) and (particle, dim, dim).
    """
    particles = [body.particles for body in scene.bodies]
    X = torch.from_numpy(np.concatenate([one.positions for one in particles])).to(x.device)
    volume = torch.from_numpy(np.concatenate([one.volume for one in particles])).to(x.device)
    x, F = x.detach().double(), F.detach().double()
    local = (torch.linalg.inv_ex(F).inverse @ (x[p] - x)[..., None])[..., 0]
    found = 2.0 * local.abs().amax(1) / volume ** (1.0 / scene.grid.dim)
    far = (X - X[p]).abs().amax(1) > 3.0 * scene.grid.spacing
    return torch.where(far & (torch.linalg.det(F) != 0), found, torch.inf)
