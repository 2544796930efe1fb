"""Every rule that needs more than one object: a whole scene, or the tensors that meet a model.

Each message says what must hold, what came instead and what to do. Rules of one object stand in ``scene.py``.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from softmpm.scene import Grid, Scene, need
from softmpm.state import Low, State

SAME_PLACE = 1e-6
"""Two particles nearer than this share of a cell are one particle twice."""
MOST_WALLS = 64
"""Each one is compiled into the kernels of the grid, and its numbers are passed with every launch."""
MIXERS = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)
"""Odd numbers without a pattern, that sums of multiples of them seldom agree modulo 2^64."""


def check_scene(scene: Scene) -> None:
    """Raise ValueError with the first rule that the scene breaks, TypeError if it is none."""
    if not isinstance(scene, Scene):
        raise TypeError(f"a model is built from a softmpm.Scene, got {type(scene).__name__}.")
    _check_bodies(scene)
    _check_distinct(scene)
    _check_muscles(scene)
    _check_walls(scene)


def _check_bodies(scene: Scene) -> None:
    grid = scene.grid
    for b, body in enumerate(scene.bodies):
        positions = body.particles.positions
        need(
            positions.shape[1] == grid.dim,
            f"body {b} has {positions.shape[1]}D particles, but the grid {grid.shape} has {grid.dim} axes; "
            "make both 2D or both 3D.",
        )
        base = np.floor(positions / grid.spacing - 0.5)  # first of the three nodes that a particle reaches
        outside = ((base < 0) | (base > np.array(grid.shape) - 3)).any(axis=1)
        if outside.any():
            particle = int(np.argmax(outside))
            raise ValueError(
                f"body {b} leaves the grid: particle {particle} at {_tuple(positions[particle])} m, and "
                f"{outside.sum() - 1} more of its {len(positions)}; all must lie in {_room(grid)} m, "
                "so that the nodes around them exist. Move the body or enlarge the grid."
            )


def _room(grid: Grid) -> str:
    return " × ".join(f"[{0.5 * grid.spacing:.5g}, {(n - 1.5) * grid.spacing:.5g})" for n in grid.shape)


def _check_distinct(scene: Scene) -> None:
    positions = np.concatenate([body.particles.positions for body in scene.bodies])
    # An offset that no lattice has keeps two copies, equal up to rounding, on the same side of a bin's edge.
    bins = np.floor(positions / (SAME_PLACE * scene.grid.spacing) + 0.381966).astype(np.int64)
    order = _suspects(bins)
    order = order[np.lexsort(bins[order].T)]
    twice = (np.diff(bins[order], axis=0) == 0).all(axis=1)
    if twice.any():
        first = int(np.argmax(twice))
        i, j = sorted(order[first : first + 2].tolist())
        bodies = np.repeat(np.arange(len(scene.bodies)), [len(body.particles) for body in scene.bodies])
        raise ValueError(
            f"particles {i} (body {bodies[i]}) and {j} (body {bodies[j]}) are at the same place, "
            f"{_tuple(positions[i])} m, and {twice.sum() - 1} more such pairs: bodies must not overlap. "
            "Move one, or keep only the particles that the other has not."
        )


def _suspects(bins: np.ndarray) -> np.ndarray:
    """Rows that may equal another one: numbers made of the rows do. To sort these is far quicker than to sort the rows."""
    mixed = (bins.astype(np.uint64) * np.array(MIXERS[: bins.shape[1]], dtype=np.uint64)).sum(axis=1)
    ordered = np.sort(mixed)
    return np.flatnonzero(np.isin(mixed, ordered[1:][ordered[1:] == ordered[:-1]]))


def _check_muscles(scene: Scene) -> None:
    count = sum(len(body.particles) for body in scene.bodies)
    for m, muscle in enumerate(scene.muscles):
        low, high = muscle.particles.min(), muscle.particles.max()
        need(
            low >= 0 and high < count,
            f"muscle {m} names particle {low if low < 0 else high}, but the scene's {count} particles are "
            f"0 to {count - 1}, counted through the bodies in their order.",
        )
        _check_axes(f"muscle {m} direction", muscle.direction, scene.grid)


def _check_walls(scene: Scene) -> None:
    grid = scene.grid
    need(
        len(scene.walls) <= MOST_WALLS,
        f"a scene has at most {MOST_WALLS} walls, since each is compiled into its kernels; got {len(scene.walls)}. "
        "Leave out those that no body reaches.",
    )
    for w, wall in enumerate(scene.walls):
        _check_axes(f"wall {w} normal", wall.normal, grid)
        # n·x along the grid's edges:
        reach = np.array(wall.normal) * (np.array(grid.shape) - 1) * grid.spacing
        low, high = np.minimum(reach, 0.0).sum(), np.maximum(reach, 0.0).sum()
        need(
            low <= wall.offset,
            f"wall {w} covers no node: n·x ≤ {wall.offset:.5g} m, but n·x is {low:.5g} to {high:.5g} m "
            "on the grid, so it would do nothing. Move it into the grid or leave it out.",
        )
        need(
            wall.offset < high,
            f"wall {w} covers every node: n·x ≤ {wall.offset:.5g} m, and n·x is {low:.5g} to {high:.5g} m "
            "on the grid. Its normal must point out of the wall, into the free space.",
        )


def _check_axes(name: str, vector: Sequence[float], grid: Grid) -> None:
    need(
        len(vector) == grid.dim,
        f"{name} needs {grid.dim} numbers, one per axis of the grid, got {_tuple(vector)}.",
    )


def _tuple(values: np.ndarray | Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.5g}" for value in values) + ")"


class Sizes(Protocol):
    """What a model says about the tensors that it takes."""

    @property
    def dim(self) -> int: ...
    @property
    def worlds(self) -> int: ...
    @property
    def particle_count(self) -> int: ...
    @property
    def muscle_count(self) -> int: ...
    @property
    def dtype(self) -> torch.dtype: ...
    @property
    def device(self) -> torch.device: ...


def check_state(model: Sizes, state: State) -> None:
    """Shape, dtype and device of x, v, C and F, and of the low-order parts if there are any."""
    if not isinstance(state, State):
        raise TypeError(f"state must be a softmpm.State, got {type(state).__name__}.")
    lead, d = (model.worlds, model.particle_count), model.dim
    shapes = {"x": (*lead, d), "v": (*lead, d), "C": (*lead, d, d), "F": (*lead, d, d)}
    for name in shapes:
        _check_tensor(model, f"state.{name}", getattr(state, name), shapes[name])
    if state.low is None:
        return
    if not isinstance(state.low, Low):
        raise TypeError(f"state.low must be a softmpm.Low or None, got {type(state.low).__name__}.")
    for name in ("x", "F"):
        _check_tensor(model, f"state.low.{name}", getattr(state.low, name), shapes[name])


def check_activation(model: Sizes, activation: Tensor | None) -> None:
    """Shape (control_step, world, muscle), dtype and device; None is no activation."""
    if activation is None:
        return
    _check_tensor(model, "activation", activation)
    want = (model.worlds, model.muscle_count)
    if activation.ndim != 3 or activation.shape[1:] != want:
        rows = activation.ndim == 2 and model.worlds == 1 and len(activation) > 1
        hint = "one world is activation[:, None]" if rows else "one control step is activation[None]"
        raise ValueError(
            f"activation must have shape (control_step, world, muscle) = (any, {want[0]}, {want[1]}), "
            f"got {tuple(activation.shape)}; {hint}."
        )
    need(
        len(activation) > 0, "activation needs at least one control step, got none; pass None to move freely."
    )


def check_row(model: Sizes, activation: Tensor | None) -> None:
    """Shape (world, muscle), dtype and device of one row of activation; None is no activation."""
    if activation is None:
        return
    _check_tensor(model, "activation", activation)
    want = (model.worlds, model.muscle_count)
    need(
        activation.shape == want,
        f"activation must have shape (world, muscle) = {want}, got {tuple(activation.shape)}; "
        "of several control steps take one row, activation[k].",
    )


def check_params(model: Sizes, params: NamedTuple) -> None:
    """Shapes that broadcast to (world, particle), dtype and device of young, poisson and density."""
    want = (model.worlds, model.particle_count)
    for name, value in _fields("params", params, tuple(BOUNDS)):
        _check_tensor(model, f"params.{name}", value)
        shape = tuple(value.shape)
        fits = all(n in (1, full) for n, full in zip(reversed(shape), reversed(want), strict=False))
        if not fits or len(shape) > 2:
            raise ValueError(
                f"params.{name} must broadcast to (world, particle) = {want}, got shape {shape}; "
                "one value for each world needs shape (world, 1)."
            )


def check_whole(name: str, value: Any) -> None:
    """A whole number of at least 1."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not whole or value < 1:
        raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}.")


@torch.no_grad()
def check_bounds(params: NamedTuple) -> None:
    """Whether a material can exist. Reads back once: a GPU has to wait."""
    given = list(_fields("params", params, tuple(BOUNDS)))
    ends = torch.stack([end for _, value in given for end in torch.aminmax(value)]).tolist()
    for (name, value), low, high in zip(given, ends[::2], ends[1::2], strict=True):
        least, most, rule = BOUNDS[name]
        if not (least < low and high < most):
            _demand(f"params.{name}", value, (value > least) & (value < most), rule)


@torch.no_grad()
def check_finite(state: State | None, activation: Tensor | None) -> None:
    """All numbers that move are finite. Reads back once: a GPU has to wait."""
    given = (
        [] if state is None else [(f"state.{name}", getattr(state, name)) for name in ("x", "v", "C", "F")]
    )
    given += [] if activation is None else [("activation", activation)]
    if not given:
        return
    # A sum is finite only if all of it is, and takes one pass; few sums of finite numbers are not.
    for (name, value), total in zip(given, torch.stack([v.sum() for _, v in given]).tolist(), strict=True):
        if not math.isfinite(total):
            _demand(name, value, torch.isfinite(value), "finite")


BOUNDS = {
    "young": (0.0, math.inf, "finite and > 0"),
    "poisson": (-1.0, 0.5, "in (-1, 0.5)"),
    "density": (0.0, math.inf, "finite and > 0"),
}
"""Limits that each material parameter lies between."""


def _demand(name: str, value: Tensor, holds: Tensor, rule: str) -> None:
    """Raise ValueError for the first value that breaks the rule."""
    if not bool(holds.all()):
        index = torch.nonzero(~holds)[0].tolist()
        place = f"[{', '.join(map(str, index))}]" if index else ""
        raise ValueError(f"{name} must be {rule}, but {name}{place} is {value[tuple(index)].item():g}.")


def _fields(what: str, record: NamedTuple, names: tuple[str, ...]) -> Iterator[tuple[str, Tensor]]:
    for name in names:
        if not hasattr(record, name):
            raise TypeError(f"{what} must be a softmpm.{what.capitalize()}, got {type(record).__name__}.")
        yield name, getattr(record, name)


def _check_tensor(model: Sizes, name: str, value: Tensor, shape: tuple[int, ...] | None = None) -> None:
    """Precision and device are the model's; and the shape, if it is one of particles. Texts are made only when needed."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}; use torch.as_tensor.")
    if value.dtype != model.dtype:
        raise ValueError(
            f"{name} must be {model.dtype} like the model, got {value.dtype}; use .to({model.dtype}), "
            "or build the model with another dtype."
        )
    if value.device != model.device:
        raise ValueError(
            f"{name} must be on {model.device} like the model, got {value.device}; use .to('{model.device}')."
        )
    if shape is not None and value.shape != shape:
        raise ValueError(
            f"{name} must have shape {shape} (world, particle, axes), got {tuple(value.shape)}; start from model.rest()."
        )
