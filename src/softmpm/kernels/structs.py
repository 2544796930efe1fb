"""Specification of the kernels of a scene, and the Warp structs that follow from it."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import warp as wp

from softmpm.kernels.compile import kernel_factory

DTYPES = {"float32": wp.float32, "float64": wp.float64}
LETTER = {"stick": "k", "slip": "l", "separate": "s"}
"""Of a wall in the name of a module, which becomes that of a file: many walls must fit."""


@dataclass(frozen=True, kw_only=True)
class Spec:
    """Features that a scene requires. A feature that is absent is not compiled, not stored and not passed."""

    dim: int
    dtype: str  # "float32" or "float64"
    laws: tuple[str, ...]  # of "neo_hookean", "fixed_corotated", "barrier_corotated"
    muscle_slots: int  # muscles that overlap on one particle, at most; 0 is a passive scene
    contacts: tuple[str, ...]  # of each wall: "stick", "slip" or "separate"
    friction: bool
    gravity: bool
    damping: bool
    deterministic: bool = False  # sums over particles in fixed point

    @property
    def module(self) -> str:
        """Name of the Warp module that holds every kernel of this specialisation."""
        features = [
            name for name in ("friction", "gravity", "damping", "deterministic") if getattr(self, name)
        ]
        muscles = [f"muscles{self.muscle_slots}"] if self.muscle_slots else []
        walls = ["walls_" + "".join(LETTER[kind] for kind in self.contacts)] if self.contacts else []
        return ".".join(["softmpm", f"d{self.dim}", self.dtype, *self.laws, *muscles, *walls, *features])


@dataclass(frozen=True, kw_only=True)
class RequestedGrads:
    """Gradients that a backward pass computes besides those of the initial state; the others are not compiled or stored."""

    material: bool
    activation: bool


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
    return wp.struct(type(name, (), {"__annotations__": annotations}), module=module)


@kernel_factory
def solid_types(spec: Spec) -> SimpleNamespace:
    """Structs of the material and the walls: only the fields that this scene needs."""
    t = types(spec.dim, spec.dtype)
    solid = dict(
        mass=wp.array2d(dtype=t.real),  # m_p / m₀, m₀ that of the heaviest particle, (world, particle)
        mu=wp.array2d(dtype=t.real),  # Lamé's μ [Pa], (world, particle)
        lam=wp.array2d(dtype=t.real),  # Lamé's λ [Pa], (world, particle)
        volume=wp.array2d(dtype=t.real),  # V⁰ / m₀ [m³/kg], (world, particle)
    )
    if len(spec.laws) > 1:
        solid["law"] = wp.array2d(dtype=wp.int32)  # index into spec.laws, (world, particle)
    if spec.muscle_slots:
        solid["muscle"] = wp.array3d(dtype=wp.int32)  # of each slot or -1, (world, particle, slot)
        solid["fibre"] = wp.array(dtype=t.vec)  # unit direction d, (muscle,)
        solid["pull"] = wp.array2d(dtype=t.real)  # activation times strength [Pa], (world, muscle)

    # Walls lie in the parameters of a launch, not in memory that a kernel would have to wait for.
    count, walls = len(spec.contacts), {}
    if count:
        walls["normal"] = wp.types.matrix((count, spec.dim), wp.float64)
        walls["offset"] = wp.types.vector(count, wp.float64)
    if spec.friction:
        walls["friction"] = wp.types.vector(count, t.real)
    if not walls:
        walls["nothing"] = int  # Warp has no empty struct
    return SimpleNamespace(
        Solid=_struct("Solid", spec.module, solid), Walls=_struct("Walls", spec.module, walls)
    )


@kernel_factory
def solid_adj_type(spec: Spec, wanted: RequestedGrads):
    """Struct of the gradients that are wanted besides those of the start."""
    t = types(spec.dim, spec.dtype)
    fields = {}
    if wanted.material:
        fields |= {name: wp.array2d(dtype=t.real) for name in ("mass", "mu", "lam")}
    if wanted.activation and spec.muscle_slots:
        fields["pull"] = wp.array3d(dtype=t.real)  # of each slot, (world, particle, slot)
    if not fields:
        fields["nothing"] = int  # Warp has no empty struct
    return _struct("SolidAdj", adj_module(spec, wanted), fields)


def adj_module(spec: Spec, wanted: RequestedGrads) -> str:
    """Name of the Warp module that holds the adjoint kernels."""
    return ".".join(
        [spec.module, "adj", *(name for name in ("material", "activation") if getattr(wanted, name))]
    )
