"""A scene made ready to run: fixed arrays on one device, and what was specialised for it."""

import functools
import html
import math

import numpy as np
import torch
import warp as wp
from torch import Tensor

from softmpm.alarms import Alarms
from softmpm.describe import describe
from softmpm.kernels.structs import Spec, solid_types, types
from softmpm.planning.memory import Footprint, Sizes, check_room, default_budget
from softmpm.scene.materials import BarrierCorotated, FixedCorotated, Material, NeoHookean
from softmpm.scene.neighbours import rest_neighbours
from softmpm.scene.scene import Scene
from softmpm.state import Low, Params, State
from softmpm.summary import counted
from softmpm.workspace import Workspace

LAWS = {
    NeoHookean: "neo_hookean",
    FixedCorotated: "fixed_corotated",
    BarrierCorotated: "barrier_corotated",
}


class Model:
    """A scene prepared for one device. From :func:`softmpm.build`; never modified, its workspace apart.

    Attributes:
        scene: The scene it was built from.
        device, dtype: Where it runs and in which precision.
        worlds, particle_count, muscle_count, dim: Sizes.
        calls: How many calls of ``simulate`` share the memory budget.
        alarms: Limits beyond which a simulation is stopped.
        neighbours: Neighbours at rest of each particle, -1 for none, shape (particle, at most dim).
        positions: Rest positions X [m], shape (particle, dim); ``exact_positions`` are the scene's, a NumPy array.
        volume: Rest volumes V⁰ [m³], shape (particle,).
        mass: Mass [kg] as the scene gives it, shape (particle,).
        mass_unit: Mass of the heaviest particle [kg], in which the kernels count, shape ().
        specific_volume: Rest volume per unit of mass [m³/kg], shape (particle,).
        body: Index of each particle's body, shape (particle,).
        spec: What the kernels are specialised for.
        deterministic: Whether results are the same bits from run to run.
        scheme, scheme_reason: Name of the scheme, and why it was chosen.
        footprint: Memory of that scheme.
        workspace: What calls leave for later calls; no part of the model's value.
    """

    def __init__(
        self,
        scene: Scene,
        device: torch.device,
        dtype: torch.dtype,
        scheme: str,
        scheme_reason: str,
        footprint: Footprint,
        alarms: Alarms,
        *,
        deterministic: bool,
        fixed_point: bool,
        worlds: int,
        memory_budget: int | None,
        calls: int,
    ):
        self.scene, self.device, self.dtype, self.worlds = scene, device, dtype, worlds
        self.memory_budget, self.calls, self.alarms = memory_budget, calls, alarms
        self.dim = scene.grid.dim
        sizes = [len(body.particles) for body in scene.bodies]
        self.particle_count = sum(sizes)
        self.muscle_count = len(scene.muscles)
        self.node_count = math.prod(scene.grid.shape)
        self.body = torch.from_numpy(np.repeat(np.arange(len(sizes)), sizes)).to(device)
        self.exact_positions = np.concatenate([body.particles.positions for body in scene.bodies])
        self.positions = self._tensor(self.exact_positions)
        self.volume = self._tensor(np.concatenate([body.particles.volume for body in scene.bodies]))
        slots = _muscle_slots(scene, self.particle_count)
        self.scheme, self.scheme_reason, self.footprint = scheme, scheme_reason, footprint
        self.deterministic, self.workspace = deterministic, Workspace()
        self.spec = _spec(scene, dtype, slots.shape[1], fixed_point)
        self.muscle_slots = torch.from_numpy(slots).to(device)
        self.fibre = self._tensor([m.direction for m in scene.muscles]).reshape(-1, self.dim)
        self.strength = self._tensor([m.strength for m in scene.muscles])
        laws = np.array([self.spec.laws.index(_law(b.material)) for b in scene.bodies], dtype=np.int32)
        self.law = torch.from_numpy(np.repeat(laws, sizes)).to(device)
        # Computed now, not on first use: that may be during a capture, which runs nothing.
        self._params, self._low = self._given(), self._rounded() if dtype == torch.float32 else None
        self.mass = (self._params.density * self.volume).contiguous()
        self.mass_unit = self.mass.max()
        self.specific_volume = self.volume / self.mass_unit
        wp.init()
        self.wp_device = wp.device_from_torch(device)
        self.constants, self.walls = self._constants(), self._walls()
        check_room(self)
        self.neighbours = self._neighbours()

    def _tensor(self, values) -> Tensor:
        return torch.tensor(np.asarray(values, dtype=np.float64), dtype=self.dtype, device=self.device)

    def _constants(self):
        scene, t = self.scene, types(self.spec.dim, self.spec.dtype)
        constants = t.Constants()
        constants.shape = t.ivec(*scene.grid.shape)
        constants.dt = scene.dt
        constants.spacing = constants.exact_spacing = scene.grid.spacing
        constants.rate, constants.width = _inverse_pair(scene.grid.spacing, self.dtype)
        constants.gravity = t.vec(*(scene.gravity or ()))
        constants.decay = math.exp(-scene.damping * scene.dt)
        survives = all(body.material.survives_inversion for body in scene.bodies)
        alarms, least = self.alarms, -math.inf if survives else 0.0
        constants.collapse = (least if alarms.collapse is None else alarms.collapse) - 1.0
        constants.gap = math.inf if alarms.gap is None else alarms.gap**2
        constants.step = math.inf if alarms.step is None else alarms.step**2
        return constants

    def _neighbours(self) -> Tensor:
        """Neighbours at rest of each particle, -1 for none, shape (particle, dim); without a column if nobody looks at them."""
        if self.alarms.gap is None:
            return torch.empty(self.particle_count, 0, dtype=torch.int32, device=self.device)
        longest = self.alarms.gap * self.scene.grid.spacing
        return torch.from_numpy(rest_neighbours(self.scene, longest)).to(self.device)

    def _walls(self):
        walls, given = solid_types(self.spec).Walls(), self.scene.walls
        if given:
            walls.normal = [number for w in given for number in w.normal]
            walls.offset = [w.offset for w in given]
        if self.spec.friction:
            walls.friction = [w.friction for w in given]
        return walls

    def rest(self) -> State:
        """State at rest, in every world: x at the rest positions, v = C = 0, F = I. Fresh tensors."""
        lead = (self.worlds, self.particle_count)
        x = self.positions.expand(*lead, self.dim).clone()
        eye = (
            torch.eye(self.dim, dtype=self.dtype, device=self.device)
            .expand(*lead, self.dim, self.dim)
            .clone()
        )
        low = None if self._low is None else Low(self._low.expand_as(x).clone(), torch.zeros_like(eye))
        return State(x=x, v=torch.zeros_like(x), C=torch.zeros_like(eye), F=eye, low=low)

    def _rounded(self) -> Tensor:
        """Remainders of rounding the rest positions [m], shape (particle, dim)."""
        exact = torch.from_numpy(self.exact_positions).to(self.device)
        return (exact - self.positions.double()).to(self.dtype)

    def params(self) -> Params:
        """Material of each particle as the scene gives it, shape (particle,) each. Fresh tensors."""
        return Params(*(tensor.clone() for tensor in self._params))

    def _given(self) -> Params:
        materials = [body.material for body in self.scene.bodies]
        return Params(
            *(self._tensor([getattr(m, name) for m in materials])[self.body] for name in Params._fields)
        )

    @functools.cached_property
    def budget(self) -> int:
        """Bytes that all calls may keep for a backward pass."""
        return default_budget(self.device, self.sizes()) if self.memory_budget is None else self.memory_budget

    @functools.cached_property
    def held_nodes(self) -> int:
        """Nodes of one world in memory: all of them or, in the fast scheme, those around the particles, counted at rest."""
        return self.footprint.node_count(self)

    def sizes(self) -> Sizes:
        """Bytes of what a call may keep, see planning/memory.py."""
        return self.footprint.sizes(self)

    def __reduce__(self):
        raise TypeError(
            "a model cannot be copied or pickled, it holds kernels and buffers: take its scene, and build it again."
        )

    def __repr__(self) -> str:
        particles, muscles = (
            counted(self.particle_count, "particle"),
            counted(self.muscle_count, "muscle"),
        )
        sizes = f"{counted(self.worlds, 'world')} of {particles} and {muscles}"
        return f"Model({self.dim}D, {self.spec.dtype} on {self.device}, {sizes}, {self.scheme} scheme, dt {self.scene.dt:.4g} s)"

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.describe())}</pre>"

    def describe(self, substeps: int = 1000) -> str:
        """Summary of the compiled features, the features left out, and the memory of calls of this many substeps."""
        return describe(self, substeps)


def _inverse_pair(spacing: float, dtype: torch.dtype) -> tuple[float, float]:
    """4/dx and dx as numbers of a precision whose product is 4 as nearly as a few units in their last place allow.

    C goes through both in every substep: rounded one by one they let a free body spin up or down by 1e-4 in 10,000 substeps of float32.
    """
    real = np.float32 if dtype == torch.float32 else np.float64
    rate = real(4.0 / spacing)
    rates = [rate + k * np.spacing(rate) for k in sorted(range(-16, 17), key=abs)]
    pairs = [(float(r), float(real(4.0 / float(r)))) for r in rates]
    return min(pairs, key=lambda pair: abs(pair[0] * pair[1] - 4.0))


def _muscle_slots(scene: Scene, particle_count: int) -> np.ndarray:
    """Muscles of each particle, shape (particle, most that overlap on one), filled up with -1."""
    members = np.zeros(particle_count, dtype=np.int64)
    for muscle in scene.muscles:
        members[muscle.particles] += 1
    slots = np.full((particle_count, int(members.max(initial=0))), -1, dtype=np.int32)
    members[:] = 0
    for k, muscle in enumerate(scene.muscles):
        slots[muscle.particles, members[muscle.particles]] = k
        members[muscle.particles] += 1
    return slots


def _law(material: Material) -> str:
    if type(material) not in LAWS:
        known = ", ".join(kind.__name__ for kind in LAWS)
        raise TypeError(
            f"no kernel has the law {type(material).__name__}; a material must be one of {known}."
        )
    return LAWS[type(material)]


def _spec(scene: Scene, dtype: torch.dtype, slots: int, fixed_point: bool) -> Spec:
    laws = {_law(body.material) for body in scene.bodies}
    return Spec(
        dim=scene.grid.dim,
        dtype=str(dtype).removeprefix("torch."),
        laws=tuple(law for law in LAWS.values() if law in laws),
        muscle_slots=slots,
        contacts=tuple(wall.contact for wall in scene.walls),
        friction=any(wall.friction > 0 for wall in scene.walls),
        gravity=any(g != 0 for g in scene.gravity or ()),
        damping=scene.damping > 0,
        deterministic=fixed_point,
    )


def check_model(model: object, wants: str) -> None:
    """Raise TypeError unless this is a model; ``wants`` names the function that needs it."""
    if not isinstance(model, Model):
        raise TypeError(
            f"{wants} needs a model, as softmpm.build(scene) gives it, got {type(model).__name__}."
        )
