"""Specification of the kernels of a scene, and the Warp structs that follow from it."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import warp as wp

from softmpm.inputs import Input, differentiable, present
from softmpm.kernels.compile import kernel_factory

DTYPES = {"float32": wp.float32, "float64": wp.float64}


@dataclass(frozen=True, kw_only=True)
class Spec:
    """Features that a scene requires. A feature that is absent is not compiled, not stored and not passed."""

    dim: int
    dtype: str  # "float32" or "float64"
    laws: tuple[str, ...]  # files of kernels/physics/laws
    muscle_slots: int  # actuators that overlap on one particle, at most; 0 is a passive scene
    contacts: tuple[str, ...]  # of each wall, files of kernels/physics/contacts
    friction: bool
    gravity: bool
    damping: bool
    actuators: tuple[str, ...] = ()  # files of kernels/physics/actuators
    fibres: bool = False  # whether an actuator has a direction
    viscosity: bool = False
    driven: bool = False  # particles, in the moving formulation
    driven_nodes: bool = False  # nodes that driven particles hold, in the reference formulation
    given: tuple[str, ...] = ()  # fields of softmpm.Inputs that calls give
    deterministic: bool = False  # sums over particles in fixed point
    slabs: bool = False  # sums over particles by slabs of nodes, for the threads of a CPU
    surface: bool = False  # separating walls act on surface points, not on nodes
    mirrors: tuple[int, ...] = ()  # numbers of the walls that reflect the motion of the nodes at rest

    @property
    def moving(self) -> bool:
        """True if walls may move."""
        return any(name.startswith("wall_") for name in self.given)

    @property
    def surface_walls(self) -> tuple[int, ...]:
        """Numbers of the walls that act on surface points."""
        return tuple(k for k, kind in enumerate(self.contacts) if self.surface and kind == "separate")

    @property
    def node_walls(self) -> tuple[int, ...]:
        """Numbers of the walls that act on the nodes inside them."""
        others = (*self.surface_walls, *self.mirrors)
        return tuple(k for k in range(len(self.contacts)) if k not in others)

    @property
    def constrained(self) -> bool:
        """True if some nodes of the reference formulation are held or mirrored after the walls acted on them."""
        return bool(self.mirrors) or self.driven_nodes


@dataclass(frozen=True)
class RequestedGrads:
    """Groups of inputs whose gradients are computed besides that of the initial state; others are not compiled or stored."""

    groups: tuple[str, ...] = ()  # of softmpm.inputs.groups, in their order

    def __contains__(self, group: str) -> bool:
        return group in self.groups


BASE_BITS = {2: 15, 3: 10}
"""Bits of a node's coordinate in packed particles."""


class Rows(NamedTuple):
    """First row of each quantity in packed particles, and how many rows there are."""

    row_fx: int
    row_low: int
    row_v: int
    row_h: int
    row_c: int
    rows: int


def packed_rows(dim: int) -> Rows:
    return Rows(0, dim, 2 * dim, 3 * dim, 3 * dim + dim * dim, 3 * dim + 2 * dim * dim)


@kernel_factory
def types(dim: int, dtype: str) -> SimpleNamespace:
    """Scalar, vector, matrix and struct types of one dimension and precision."""
    real: Any = DTYPES[dtype]
    vec = wp.types.vector(dim, real)
    mat = wp.types.matrix((dim, dim), real)
    node = wp.types.vector(dim + 1, real)  # momentum and mass of a grid node, packed
    aligned = wp.types.vector(4, real)  # the same in the fast scheme: 16 bytes in float32, padded in 2D
    ivec = wp.types.vector(dim, wp.int32)

    if dtype == "float32":

        @wp.func
        def divide(a: real, b: real) -> real:
            """a / b to two units in the last place, without branches."""
            return wp.div_approx(a, b)
    else:

        @wp.func
        def divide(a: real, b: real) -> real:
            return a / b

    class Constants:
        shape: ivec  # nodes along each axis
        dt: real  # Δt [s]
        spacing: real  # dx [m]
        rate: real  # 4 / dx [1/m] and
        width: real  # dx [m], but for an ulp or so: rate · width is 4 as nearly as can be
        exact_spacing: wp.float64  # the same, for what must not depend on the precision
        gravity: vec  # g [m/s²]
        decay: real  # exp(-damping Δt) [-]
        collapse: real  # least det F − 1 [-]
        gap: real  # square of the largest distance of rest neighbours [cells²]
        step: real  # square of the largest Δt over the running stable step [-]

    class Motion:
        """State of particles as the kernels hold it: nothing small is added to something large and lost."""

        base: wp.array2d(dtype=ivec)  # first node of the 3^dim stencil
        fx: wp.array2d(dtype=vec)  # position from the base node, in cells: x = (base + fx) dx, 0.5 ≤ fx < 1.5
        v: wp.array2d(dtype=vec)
        C: wp.array2d(dtype=mat)
        H: wp.array2d(dtype=mat)  # F - I

    if dtype == "float32":
        # What rounding took off fx (compensated sum):
        Motion.__annotations__["fx_low"] = wp.array2d(dtype=vec)

    class MotionAdj:
        fx: wp.array2d(dtype=vec)  # ∂L/∂fx = dx ∂L/∂x
        v: wp.array2d(dtype=vec)
        C: wp.array2d(dtype=mat)
        H: wp.array2d(dtype=mat)

    class Packed:
        """The same in the fast scheme: rows of blocks of 32 particles, sorted by cell (kernels/fast/scatter.h)."""

        # First node of the stencil, its coordinates in 10 (3D) or 15 (2D) bits each:
        base: wp.array(dtype=wp.int32)
        rows: wp.array(dtype=real)  # fx, fx_low, v, H, C

    class Window:
        """The nodes that are held in memory: ``shape`` of them along each axis from ``origin`` on, in each world."""

        shape: ivec
        count: int  # nodes of one world
        origin: wp.array(dtype=ivec)  # (world,)

    def struct(cls):
        return wp.struct(cls, module=f"softmpm.types.d{dim}.{dtype}")

    return SimpleNamespace(
        dim=dim,
        real=real,
        vec=vec,
        mat=mat,
        node=node,
        aligned=aligned,
        c_name={"float32": "float", "float64": "double"}[dtype],
        divide=divide,
        Packed=struct(Packed),
        Window=struct(Window),
        **packed_rows(dim)._asdict(),
        ivec=ivec,
        Constants=struct(Constants),
        Motion=struct(Motion),
        MotionAdj=struct(MotionAdj),
    )


def _struct(name: str, module: str, annotations: dict):
    # Warp has no empty struct:
    return wp.struct(type(name, (), {"__annotations__": annotations or {"nothing": int}}), module=module)


def element_type(spec: Spec, one: Input):
    """Warp type of one value of an input."""
    t = types(spec.dim, "float64" if one.double else spec.dtype)
    return {"scalar": t.real, "vector": t.vec, "index": wp.int32}[one.kind]


def constant_type(spec: Spec, one: Input):
    """Warp type of an input of all walls that lies in the struct itself."""
    real, count = types(spec.dim, "float64" if one.double else spec.dtype).real, len(spec.contacts)
    return wp.types.matrix((count, spec.dim), real) if one.kind == "vector" else wp.types.vector(count, real)


AXES = {
    "particle": 2,
    "slot": 3,
    "muscle": 2,
    "driven": 2,
    "driven_node": 2,
    "world": 1,
    "wall": 2,
    "substep": 1,
}
"""Of an input: (world, particle), (world, particle, slot), (world, muscle), (world, driven), (world, driven node), (world,),
(world, wall), (1,)."""
ACCUMULATOR_AXES = {"particle": 2, "muscle": 3, "driven": 2, "driven_node": 2, "world": 1, "wall": 2}
"""Of its adjoint: (world, particle), (world, particle, slot), (world, driven), (world, driven node), (node,), (wall, node), so that no
two threads of a launch add to the same number; nodes of all worlds count on."""


@kernel_factory
def input_types(spec: Spec) -> SimpleNamespace:
    """Structs of the inputs of particles and of nodes: only the fields that this scene needs, by :data:`softmpm.inputs.INPUTS`."""
    fields = {"particle": {}, "grid": {}}
    for one in present(spec):
        array = wp.array(dtype=element_type(spec, one), ndim=AXES[one.per] - one.shared(spec))
        kind = constant_type(spec, one) if one.constant(spec) else array
        fields["grid" if one.stage == "grid" else "particle"][one.name] = kind
    module = f"softmpm.types.{spec}"
    return SimpleNamespace(
        ParticleInputs=_struct("ParticleInputs", module, fields["particle"]),
        GridInputs=_struct("GridInputs", module, fields["grid"]),
    )


@kernel_factory
def input_adj_types(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    """Structs of the gradients that are wanted besides those of the start."""
    t = types(spec.dim, spec.dtype)
    fields = {"particle": {}, "grid": {}}
    for one in differentiable(spec):
        if one.group in wanted:
            dtype = t.vec if one.kind == "vector" else t.real
            array = wp.array(dtype=dtype, ndim=ACCUMULATOR_AXES[one.per])
            fields["grid" if one.stage == "grid" else "particle"][one.name] = array
    module = f"softmpm.types.{spec}.{wanted}"
    return SimpleNamespace(
        ParticleInputsAdj=_struct("ParticleInputsAdj", module, fields["particle"]),
        GridInputsAdj=_struct("GridInputsAdj", module, fields["grid"]),
    )
