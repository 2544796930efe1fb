"""What the kernels are specialised for, and the types that follow from it."""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

DTYPES = {"float32": wp.float32, "float64": wp.float64}


@dataclass(frozen=True, kw_only=True)
class Spec:
    """What a scene requires. Whatever is absent here is not compiled, not stored and not passed."""

    dim: int
    dtype: str  # "float32" or "float64"
    laws: tuple[str, ...]  # of "neo_hookean", "fixed_corotated"
    muscle_slots: int  # muscles that overlap on one particle, at most; 0 is a passive scene
    contacts: tuple[str, ...]  # kinds present, of "stick", "slip", "separate"
    friction: bool
    gravity: bool
    damping: bool

    @property
    def module(self) -> str:
        """Name of the Warp module that holds every kernel of this specialisation."""
        features = [name for name in ("friction", "gravity", "damping") if getattr(self, name)]
        muscles = [f"muscles{self.muscle_slots}"] if self.muscle_slots else []
        return ".".join(
            ["softmpm", f"d{self.dim}", self.dtype, *self.laws, *muscles, *self.contacts, *features]
        )


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Which gradients a backward pass computes besides those of the start; the others are not compiled or stored."""

    material: bool
    activation: bool


@functools.lru_cache(maxsize=None)
def types(dim: int, dtype: str) -> SimpleNamespace:
    """Scalar, vector, matrix and struct types of one dimension and precision."""
    real: Any = DTYPES[dtype]
    vec = wp.types.vector(dim, real)
    mat = wp.types.matrix((dim, dim), real)
    node = wp.types.vector(dim + 1, real)  # momentum and mass of a grid node, packed
    ivec = wp.types.vector(dim, wp.int32)

    class Scale:
        shape: ivec  # nodes along each axis
        dt: real  # Δt [s]
        spacing: real  # dx [m]
        exact_spacing: wp.float64  # the same, for what must not depend on the precision
        gravity: vec  # g [m/s²]
        decay: real  # exp(-damping Δt) [-]

    class Motion:
        """State of particles as the kernels hold it: nothing small is added to something large and lost."""

        base: wp.array2d(dtype=ivec)  # first node of the 3^dim stencil
        fx: wp.array2d(dtype=vec)  # position from the base node, in cells: x = (base + fx) dx, 0.5 ≤ fx < 1.5
        v: wp.array2d(dtype=vec)
        C: wp.array2d(dtype=mat)
        H: wp.array2d(dtype=mat)  # F - I

    if dtype == "float32":
        Motion.__annotations__["fx_low"] = wp.array2d(
            dtype=vec
        )  # what rounding took off fx (compensated sum)

    class MotionAdj:
        fx: wp.array2d(dtype=vec)  # ∂L/∂fx = dx ∂L/∂x
        v: wp.array2d(dtype=vec)
        C: wp.array2d(dtype=mat)
        H: wp.array2d(dtype=mat)

    def struct(cls):
        return wp.struct(cls, module=f"softmpm.types.d{dim}.{dtype}")

    return SimpleNamespace(
        dim=dim,
        real=real,
        vec=vec,
        mat=mat,
        node=node,
        ivec=ivec,
        Scale=struct(Scale),
        Motion=struct(Motion),
        MotionAdj=struct(MotionAdj),
    )


def _struct(name: str, module: str, annotations: dict):
    return wp.struct(type(name, (), {"__annotations__": annotations}), module=module)


@functools.lru_cache(maxsize=None)
def solid_types(spec: Spec) -> SimpleNamespace:
    """Structs of the material and the walls: only the fields that this scene needs."""
    t = types(spec.dim, spec.dtype)
    solid = dict(
        mass=wp.array2d(dtype=t.real),  # m_p [kg], (world, particle)
        mu=wp.array2d(dtype=t.real),  # Lamé's μ [Pa], (world, particle)
        lam=wp.array2d(dtype=t.real),  # Lamé's λ [Pa], (world, particle)
        volume=wp.array(dtype=t.real),  # V⁰ [m³], (particle,)
    )
    if len(spec.laws) > 1:
        solid["law"] = wp.array(dtype=wp.int32)  # index into spec.laws, (particle,)
    if spec.muscle_slots:
        solid["muscle"] = wp.array2d(dtype=wp.int32)  # muscle of each slot or -1, (particle, slot)
        solid["fibre"] = wp.array(dtype=t.vec)  # unit direction d, (muscle,)
        solid["pull"] = wp.array2d(dtype=t.real)  # activation times strength [Pa], (world, muscle)

    walls = dict(count=int)
    if spec.contacts:
        walls["normal"] = wp.array(dtype=wp.types.vector(spec.dim, wp.float64))
        walls["offset"] = wp.array(dtype=wp.float64)
    if len(spec.contacts) > 1:
        walls["contact"] = wp.array(dtype=wp.int32)  # index into spec.contacts
    if spec.friction:
        walls["friction"] = wp.array(dtype=t.real)
    return SimpleNamespace(
        Solid=_struct("Solid", spec.module, solid), Walls=_struct("Walls", spec.module, walls)
    )


@functools.lru_cache(maxsize=None)
def solid_adj_type(spec: Spec, wanted: Wanted):
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


def adj_module(spec: Spec, wanted: Wanted) -> str:
    """Name of the Warp module that holds the adjoint kernels."""
    return ".".join(
        [spec.module, "adj", *(name for name in ("material", "activation") if getattr(wanted, name))]
    )
