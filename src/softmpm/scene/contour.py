"""Contours of a sampled field by marching squares (Lorensen and Cline 1987, in two dimensions)."""

import numpy as np

LEVEL_SLACK = 1e-9
"""A node within this of the level counts as inside, whatever its rounding."""


def contours(field: np.ndarray, level: float) -> list[np.ndarray]:
    """Closed polygons around the nodes where a field (x, y) reaches a level, the inside to their left, in units of the nodes.

    Outside of the array the field is taken as 0. Where four nodes leave open which of them are joined, their mean decides.
    """
    field = np.pad(np.asarray(field, dtype=np.float64), 1)
    inside = field >= level - LEVEL_SLACK
    start, end = _segments(field, inside, level)
    follows = dict(zip(start.tolist(), end.tolist(), strict=True))
    polygons = []
    while follows:
        first, edge = follows.popitem()
        walk = [first]
        while edge != first:
            walk.append(edge)
            edge = follows.pop(edge)
        polygons.append(_crossings(field, level, np.array(walk)) - 1.0)
    return polygons[::-1]


def _segments(field: np.ndarray, inside: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Edges of cells that are joined by a segment of a contour: start and end of each.

    An edge is numbered 2 (node) + axis by its lower node. Each crossed edge is once a start and once an end.
    """
    node = np.arange(field.size).reshape(field.shape)
    low, right, above = node[:-1, :-1], node[1:, :-1], node[:-1, 1:]
    edges = np.stack([2 * low, 2 * right + 1, 2 * above, 2 * low + 1])  # around a cell, to the left
    a, b, c, d = inside[:-1, :-1], inside[1:, :-1], inside[1:, 1:], inside[:-1, 1:]
    corners = np.stack([a, b, c, d])
    after = np.roll(corners, -1, axis=0)
    leaves, enters = corners & ~after, ~corners & after
    mean = (field[:-1, :-1] + field[1:, :-1] + field[1:, 1:] + field[:-1, 1:]) / 4
    saddle = (
        leaves.sum(axis=0) == 2
    )  # two segments: around the outer corners if the inner ones are joined, else around these
    saddle_turn = np.where(mean >= level - LEVEL_SLACK, 1, 3)
    starts, ends = [], []
    for k in range(4):
        for turn in (1, 2, 3):  # edges further around the cell
            end = (k + turn) % 4
            chosen = leaves[k] & enters[end] & (~saddle | (saddle_turn == turn))
            starts.append(edges[k][chosen])
            ends.append(edges[end][chosen])
    return np.concatenate(starts), np.concatenate(ends)


def _crossings(field: np.ndarray, level: float, edges: np.ndarray) -> np.ndarray:
    """Places where the field crosses the level on edges, linear between their nodes, shape (edge, 2)."""
    node, axis = edges // 2, edges % 2
    flat, step = field.ravel(), np.where(axis == 0, field.shape[1], 1)
    low, high = flat[node], flat[node + step]
    share = np.clip((level - low) / (high - low), 0.0, 1.0)
    places = np.stack(np.divmod(node, field.shape[1]), axis=-1).astype(np.float64)
    places[np.arange(len(edges)), axis] += share
    return places
