"""State, material and grid fields as named tuples of tensors that PyTorch owns."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from softmpm.summary import table


def _rows(fields: dict[str, Any]) -> dict[str, str]:
    """Shape, precision and device of each tensor, by its name."""
    texts = {}
    for name, value in fields.items():
        if isinstance(value, Tensor):
            texts[name] = f"{tuple(value.shape)} {str(value.dtype).removeprefix('torch.')} on {value.device}"
        else:
            texts[name] = type(value).__name__ if value is not None else "None"
    return texts


def _text(fields: Any) -> str:
    inside = ", ".join(f"{name}: {text}" for name, text in _rows(fields._asdict()).items())
    return f"{type(fields).__name__}({inside})"


class Low(NamedTuple):
    """Low-order parts: the exact state is ``State.x + Low.x`` and ``State.F + Low.F``."""

    x: Tensor
    F: Tensor

    def __repr__(self) -> str:
        return _text(self)

    def detach(self) -> "Low":
        """The same parts without their history."""
        return Low(*(tensor.detach() for tensor in self))

    def clone(self) -> "Low":
        """The same parts in memory of their own."""
        return Low(*(tensor.clone() for tensor in self))

    def to(self, *args: Any, **kwargs: Any) -> "Low":
        """Every tensor on another device or in another precision; arguments as for ``torch.Tensor.to``."""
        return Low(*(tensor.to(*args, **kwargs) for tensor in self))


class Nodal(NamedTuple):
    """State of the nodes in the reference formulation (docs/formulations.md). Differentiable."""

    u: Tensor
    """Displacements in addition to the shift [m], shape (world, node, dim)."""
    v: Tensor
    """Velocities [m/s], shape (world, node, dim)."""
    anchor: Tensor
    """Places on the walls where surface points adhere, in addition to the shift [m], shape (world, wall, point, dim), of the separating
    walls; no walls or no points without surface contact."""
    force: Tensor
    """Mean force of each of these walls on each surface point in the last control step [N], of the same shape; see
    :func:`softmpm.contact_forces`. A call does not read it."""
    shift: Tensor | None = None
    """Translation of all nodes of a world [m], shape (world, dim), in float64 in every precision; None is none. It follows the bodies,
    so that u keeps its digits over long ways. A constant of the gradient: that with respect to u is that with respect to the sum."""
    reaction: Tensor | None = None
    """Mean force of clamps and planes of symmetry on each group of nodes that are images of each other, in the last control step [N],
    shape (world, group, dim); see :func:`softmpm.clamp_forces`. A call does not read it."""
    low: Tensor | None = None
    """Accumulated rounding errors of u [m] and v [m/s], shape (world, 2, node, dim); None is nothing. The next substep adds it. A
    constant of the gradient."""

    @staticmethod
    def of(tensors: Sequence[Tensor]) -> "Nodal":
        """The state of which :meth:`differentiable` gives these tensors."""
        return Nodal(*tensors[:4], reaction=tensors[4])

    def differentiable(self) -> tuple[Tensor, ...]:
        """u, v, the anchors and the forces, of a state that has all of them."""
        assert self.reaction is not None
        return *self[:4], self.reaction

    def __repr__(self) -> str:
        return _text(self)

    def detach(self) -> "Nodal":
        """The same state without its history."""
        return self._each(lambda tensor: tensor.detach())

    def clone(self) -> "Nodal":
        """The same state in memory of its own. Differentiable."""
        return self._each(lambda tensor: tensor.clone())

    def to(self, *args: Any, **kwargs: Any) -> "Nodal":
        """Every tensor on another device or in another precision, but for the shift's; arguments as for ``torch.Tensor.to``."""
        moved = self._each(lambda tensor: tensor.to(*args, **kwargs))
        return moved if self.shift is None else moved._replace(shift=self.shift.to(moved.u.device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> "Nodal":
        u, v, anchor, force = (change(tensor) for tensor in self[:4])
        others = (None if part is None else change(part) for part in self[4:])
        return Nodal(u, v, anchor, force, *others)


class SurfaceState(NamedTuple):
    """State of the surface points in the moving formulation with ``contact="surface"`` (docs/formulations.md). Differentiable."""

    anchor: Tensor
    """Places on the walls where surface points adhere [m], shape (world, wall, point, dim), of the separating walls."""
    force: Tensor
    """Mean force of each of these walls on each surface point in the last control step [N], of the same shape; see
    :func:`softmpm.contact_forces`. A call does not read it."""

    def __repr__(self) -> str:
        return _text(self)

    def detach(self) -> "SurfaceState":
        """The same state without its history."""
        return SurfaceState(*(tensor.detach() for tensor in self))

    def clone(self) -> "SurfaceState":
        """The same state in memory of its own. Differentiable."""
        return SurfaceState(*(tensor.clone() for tensor in self))

    def to(self, *args: Any, **kwargs: Any) -> "SurfaceState":
        """Every tensor on another device or in another precision; arguments as for ``torch.Tensor.to``."""
        return SurfaceState(*(tensor.to(*args, **kwargs) for tensor in self))


class State(NamedTuple):
    """State of every particle of every world."""

    x: Tensor
    """Positions [m], shape (world, particle, dim)."""
    v: Tensor
    """Velocities [m/s], shape (world, particle, dim)."""
    C: Tensor
    """Affine velocity [1/s], shape (world, particle, dim, dim)."""
    F: Tensor
    """Deformation gradient [-], shape (world, particle, dim, dim)."""
    low: Low | None = None
    """Remainders of rounding ``x`` and ``F`` to float32, or None. :func:`softmpm.simulate` returns and takes them, so that a motion
    of 1e-5 of a cell survives a division into many calls; they carry no gradient. A state without them stands for exactly its
    four tensors."""
    nodes: Nodal | None = None
    """Nodal state, in the reference formulation; None in the moving one. A state with nodes continues without loss; for
    one without, the nodes are computed from the four tensors."""
    surface: SurfaceState | None = None
    """Surface points in the moving formulation with contact at them, else None. A state with them continues without loss; in one
    without, they adhere to the walls nowhere."""

    @staticmethod
    def of(tensors: Sequence[Tensor]) -> "State":
        """The state of which :meth:`differentiable` gives these tensors."""
        x, v, C, F, *others = tensors
        return State(x, v, C, F, surface=SurfaceState(*others) if others else None)

    def differentiable(self) -> tuple[Tensor, ...]:
        """x, v, C, F and, if there are any, the tensors of the surface points."""
        return *self[:4], *(self.surface or ())

    def __repr__(self) -> str:
        return _text(self)

    def _repr_html_(self) -> str:
        return table("softmpm.State", _rows(self._asdict()))

    def detach(self) -> "State":
        """The same state without its history, the low-order parts included."""
        return self._each(lambda part: part.detach())

    def clone(self) -> "State":
        """The same state in memory of its own, the low-order parts included. Differentiable."""
        return self._each(lambda part: part.clone())

    def to(self, *args: Any, **kwargs: Any) -> "State":
        """Every tensor on another device or in another precision; arguments as for ``torch.Tensor.to``. In float64 the low-order parts
        are added to x and F, which have room for them."""
        moved = self._each(lambda part: part.to(*args, **kwargs))
        if moved.low is None or moved.x.dtype != torch.float64:
            return moved
        return moved._replace(x=moved.x + moved.low.x, F=moved.F + moved.low.F, low=None)

    def of_worlds(self, worlds: slice | Sequence[int] | Tensor) -> "State":
        """The state of some worlds, nodes and surface points included: a slice, or numbers or a mask of worlds. Differentiable."""
        return self._at(worlds)

    def of_frame(self, frame: int) -> "State":
        """The state in one of the frames of a :func:`softmpm.trajectory`, nodes and surface points included. Differentiable."""
        return self._at(frame)

    def _at(self, index: Any) -> "State":
        """The state at an index of the first axis."""

        def some(part: Any) -> Any:
            if isinstance(part, Tensor):
                return part[index]
            return type(part)(*(None if tensor is None else tensor[index] for tensor in part))

        return self._each(some)

    def _each(self, change: Callable[[Any], Any]) -> "State":
        x, v, C, F = (change(tensor) for tensor in self[:4])
        others = (None if part is None else change(part) for part in self[4:])
        return State(x, v, C, F, *others)


Kind = TypeVar("Kind", Nodal, State)


def chosen(worlds: Tensor, there: Kind, elsewhere: Kind) -> Kind:
    """One state in some worlds and another one of the same kind in the rest.

    Args:
        worlds: True where ``there`` is chosen, shape (world,).
        there: May have no low-order parts and no shift, which then are zero.
    """

    def mixed(one: Any, other: Any) -> Any:
        if other is None:
            return None
        return torch.where(worlds.view(-1, *(1,) * (other.dim() - 1)), 0.0 if one is None else one, other)

    pairs = zip(there.differentiable(), elsewhere.differentiable(), strict=True)
    found: Any = type(elsewhere).of([mixed(*pair) for pair in pairs])
    if isinstance(elsewhere, Nodal):
        constants = {
            name: mixed(getattr(there, name, None), getattr(elsewhere, name)) for name in ("shift", "low")
        }
        return found._replace(**constants)
    if elsewhere.low is None:
        return found
    low = getattr(there, "low", None) or (None, None)
    return found._replace(low=Low(*(mixed(*pair) for pair in zip(low, elsewhere.low, strict=True))))


class Params(NamedTuple):
    """Material of each particle; shapes that broadcast to (world, particle). Differentiable."""

    young: Tensor
    """Young's modulus E [Pa]."""
    poisson: Tensor
    """Poisson's ratio ν [-], in (-1, 0.5)."""
    density: Tensor
    """Rest density ρ₀ [kg/m³]."""

    def __repr__(self) -> str:
        return _text(self)


class GridField(NamedTuple):
    """Mass and velocity on the nodes of the grid."""

    mass: Tensor
    """Nodal mass [kg], shape (world, *nodes)."""
    velocity: Tensor
    """Nodal velocity [m/s], shape (world, *nodes, dim); zero on nodes without mass."""

    def __repr__(self) -> str:
        return _text(self)


class ContactForces(NamedTuple):
    """Forces of the separating walls on the bodies, mean values over the last control step. Differentiable.

    The axis ``wall`` counts the walls of the kind ``separate`` alone, in the order of the scene: row k is that of
    ``scene.walls[model.surface.walls[k]]``. Clamps and planes of symmetry are in :func:`softmpm.clamp_forces`. In 2D a force is per
    metre of depth.
    """

    total: Tensor
    """Force of each wall [N], shape (world, wall, dim)."""
    traction: Tensor
    """Force per area at rest at each surface point [Pa], shape (world, wall, point, dim)."""
    points: Tensor
    """Places of the surface points [m], shape (world, point, dim)."""

    def __repr__(self) -> str:
        return _text(self)


torch.serialization.add_safe_globals(
    [State, Low, Nodal, SurfaceState, Params]
)  # torch.load reads them with weights_only=True
