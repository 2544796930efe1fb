"""Nodes at rest that clamps and planes of symmetry hold or reflect, found once when a model is built.

The images of a node in all planes are one group: they move as one, each with a sign for each axis. Derivation: docs/math/mirror.md.
"""

import numpy as np
import torch
from torch import Tensor

from softmpm.rest_grid import RestGrid
from softmpm.scene.check_mirrors import mirrors_of
from softmpm.scene.scene import Scene


class MirrorGrid:
    """Groups of nodes that are images of each other, or held.

    Attributes:
        walls: Number of each clamp and plane of symmetry in ``scene.walls``, for the axis ``wall`` of :func:`softmpm.clamp_forces`.
        count: Number of groups.
        group: Group of each node, -1 for none, shape (node,), int64.
        members: Nodes of each group, filled up with the number of nodes, shape (group, most), int32.
        present: True for nodes with mass, shape (node,).
        first: First node with mass of each node's group, or the node itself, shape (node,), int64.
        signs: Motion of each node along each axis over that of its group: 1 or -1, and 0 where it is held, shape (node, dim), float64.
        shares: Share of each of these walls in the force on each group along each axis (B3),
            shape (wall, group, dim), float64.
    """

    def __init__(self, scene: Scene, rest: RestGrid, device: torch.device):
        image = 2 * rest.nodes.cpu().numpy().astype(np.int64)  # in half cells
        signs = np.ones(image.shape)
        mirrors = mirrors_of(scene)
        self.walls = tuple(one.wall for one in mirrors)
        for one in mirrors:
            behind = one.side * (image[:, one.axis] - one.twice) < 0
            image[behind, one.axis] = 2 * one.twice - image[behind, one.axis]
            signs[behind] *= np.where(one.held, -1.0, 1.0)
        for one in mirrors:
            on = image[:, one.axis] == one.twice
            signs[on] *= np.where(one.held, 0.0, 1.0)
        _, owner, size = np.unique(image, axis=0, return_inverse=True, return_counts=True)
        owner = owner.reshape(-1)
        bound = (size[owner] > 1) | (signs != 1.0).any(axis=1)
        numbers, group = np.unique(owner[bound], return_inverse=True)
        nodes = np.append(np.flatnonzero(bound), rest.count)
        members = nodes[grouped(group.reshape(-1), len(numbers))]
        of_node = np.full(rest.count, -1)
        of_node[bound] = group.reshape(-1)
        self.count = len(numbers)
        self.group = torch.from_numpy(of_node).to(device)
        self.members = torch.from_numpy(members.astype(np.int32)).to(device)
        self.signs = torch.from_numpy(signs).to(device)
        mass = rest.weight.cpu().numpy()
        first = np.arange(rest.count)
        for row in members:
            row = row[row < rest.count]
            first[row] = row[np.argmax(mass[row] > 0)]
        self.present = torch.from_numpy(mass > 0).to(device)
        twice = 2 * rest.nodes.cpu().numpy().astype(np.int64)
        part = np.zeros((len(mirrors), self.count, scene.grid.dim))
        for k, one in enumerate(mirrors):
            reached = (one.side * (twice[:, one.axis] - one.twice) <= 0) & (mass > 0)
            # Groups with nodes on the plane or behind it:
            taking = np.append(reached, False)[members].any(axis=1)
            part[k] = np.outer(taking, one.held)
        self.shares = torch.from_numpy(part / part.sum(axis=0).clip(min=1.0)).to(device)
        self.first = torch.from_numpy(first).to(device)

    def reflected(self, mass: Tensor, *fields: Tensor) -> tuple[Tensor, ...]:
        """Fields on the nodes after (B1). Differentiable.

        Args:
            mass: Of the nodes in any unit, shape (world, node).
            fields: Displacements or velocities, shape (world, node, dim) each.
        """
        members, bound = self.members.long(), (self.group >= 0) & (mass > 0)
        of_groups = _padded(mass)[:, members]
        total = of_groups.sum(2)
        total = torch.where(total > 0, total, 1.0)[..., None]
        results = []
        for field in fields:
            signs = self.signs.to(field.dtype)
            near = _padded(mass[..., None] * signs * field)[:, members]
            w = near.sum(2) / total
            results.append(torch.where(bound[..., None], signs * w[:, self.group.clamp(min=0)], field))
        return tuple(results)

    def apart(self, *fields: Tensor) -> Tensor:
        """Largest difference of fields from ones that (B1) leaves as they are, shape ()."""
        found = []
        for field in fields:
            signs = self.signs.to(field.dtype)
            image = signs * signs[self.first] * field[:, self.first]
            found.append(torch.where(self.present[:, None], field - image, 0.0).abs().max())
        return torch.stack(found).max()


def _padded(values: Tensor) -> Tensor:
    """Values of the nodes, and a zero at the end."""
    return torch.cat([values, torch.zeros_like(values[:, :1])], 1)


def grouped(owners: np.ndarray, count: int) -> np.ndarray:
    """Positions of each owner 0 … count − 1 in a list of owners, one row each, filled up with the length of the list."""
    order, sizes = np.argsort(owners, kind="stable"), np.bincount(owners, minlength=count)
    rows = np.full((count, sizes.max()), len(owners))
    rows[np.arange(rows.shape[1]) < sizes[:, None]] = order
    return rows
