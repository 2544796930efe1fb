"""What moves, and what it is made of, as named tuples of tensors that PyTorch owns."""

from typing import NamedTuple

from torch import Tensor


class _StateFields(NamedTuple):
    x: Tensor
    v: Tensor
    C: Tensor
    F: Tensor


class State(_StateFields):
    """State of every particle of every world.

    Attributes:
        x: Positions [m], shape (world, particle, dim).
        v: Velocities [m/s], shape (world, particle, dim).
        C: Affine velocity [1/s], shape (world, particle, dim, dim).
        F: Deformation gradient [-], shape (world, particle, dim, dim).
        low: What rounding to float32 took off ``x`` and ``F``, or None. :func:`softmpm.simulate` returns and takes it, so
            that a motion of 1e-5 survives being cut into many calls; it carries no gradient. Iteration, ``_replace`` and
            ``State(x, v, C, F)`` see the four fields only; a state without ``low`` stands for exactly what it holds.
    """

    low: "Low | None" = None

    def with_low(self, low: "Low | None") -> "State":
        state = State(*self)
        state.low = low
        return state


class Low(NamedTuple):
    """Low-order parts: the exact state is ``State.x + Low.x`` and ``State.F + Low.F``."""

    x: Tensor
    F: Tensor


class Params(NamedTuple):
    """Material of each particle; shapes that broadcast to (world, particle). Differentiable."""

    young: Tensor
    """Young's modulus E [Pa]."""
    poisson: Tensor
    """Poisson's ratio ν [-], in (-1, 0.5)."""
    density: Tensor
    """Rest density ρ₀ [kg/m³]."""


class GridField(NamedTuple):
    """Mass and velocity on the nodes of the grid."""

    mass: Tensor
    """Nodal mass [kg], shape (world, *nodes)."""
    velocity: Tensor
    """Nodal velocity [m/s], shape (world, *nodes, dim); zero on nodes without mass."""
