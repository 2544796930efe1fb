"""Outline of a body: points on its true surface, each with an outward normal and the area that it stands for.

A lattice of particles ends half a spacing inside the surface and in steps; the outline says where the surface is.
"""

from dataclasses import dataclass

import numpy as np

from softmpm.validate import UNIT, array, need, read_only, restore

NEARLY_UNIT = 1e-6
"""A normal's length may differ from one by this much, which float32 normals do."""


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """Quadrature points of a closed surface at rest: Σ f(points) · areas is the integral of f over the surface."""

    points: np.ndarray
    """Rest positions on the surface [m], shape (point, dim); copied, read-only. Good distance: that of the particles."""
    normals: np.ndarray
    """Unit normals out of the body [-], shape (point, dim); copied, read-only."""
    areas: np.ndarray
    """Area of the surface around each point [m²], in 2D its length [m] for unit depth; shape (point,); copied, read-only."""

    def __post_init__(self):
        points, normals, areas = (
            array(f"outline {name}", getattr(self, name)).astype(np.float64) for name in _FIELDS
        )
        need(
            points.ndim == 2 and points.shape[1] in (2, 3) and len(points) > 0,
            f"outline points must have shape (point, 2) or (point, 3) with at least one point, got {points.shape}.",
        )
        need(
            normals.shape == points.shape,
            f"outline normals must have the shape {points.shape} of the points, one for each, got {normals.shape}.",
        )
        need(
            areas.shape == (len(points),),
            f"outline areas must have shape ({len(points)},), one for each point, got {areas.shape}; "
            "np.full(len(points), area) repeats one number.",
        )
        for name, values in zip(_FIELDS, (points, normals, areas), strict=True):
            if not np.isfinite(values).all():
                raise ValueError(
                    f"outline {name} must be finite; point {np.argwhere(~np.isfinite(values))[0][0]} is not."
                )
        length = np.linalg.norm(normals, axis=1)
        off = np.abs(length - 1.0)
        need(
            bool((off <= NEARLY_UNIT).all()),
            f"outline normals must have length 1, got {length[off.argmax()]:.6g} at point {off.argmax()}; "
            "divide them by np.linalg.norm(normals, axis=1, keepdims=True).",
        )
        need(
            bool((areas > 0).all()),
            f"outline areas must be > 0, got {areas.min()} at point {areas.argmin()}; leave out points without area.",
        )
        unit = np.where(off[:, None] <= UNIT, normals, normals / length[:, None])
        for name, values in zip(_FIELDS, (points, unit, areas), strict=True):
            object.__setattr__(self, name, read_only(values))

    @property
    def dim(self) -> int:
        return self.points.shape[1]

    @property
    def enclosed_volume(self) -> float:
        """Volume inside [m³], in 2D [m²], by the divergence theorem: Σ A (x − c)·n / dim. Negative if the normals point inwards."""
        center = self.points.mean(axis=0)  # of no effect on a closed surface
        heights = ((self.points - center) * self.normals).sum(axis=1)
        return float((self.areas * heights).sum() / self.dim)

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"Outline({len(self):,} points in {self.dim}D)"

    __setstate__ = restore


_FIELDS = ("points", "normals", "areas")
