"""A scene made ready to run: fixed arrays on one device, and what was specialised for it."""

import functools
import html
import math

import numpy as np
import torch
from torch import Tensor

from softmpm.alarms import Alarms
from softmpm.describe import describe
from softmpm.devices import warp_device_of
from softmpm.driven_grid import DrivenGrid
from softmpm.inputs import QUANTITIES, direction_of, stored
from softmpm.mirror_grid import MirrorGrid
from softmpm.overlap_grid import overlap_grid
from softmpm.planning.memory import Footprint, Sizes, check_room, default_budget
from softmpm.rest_grid import RestGrid
from softmpm.scene.neighbours import rest_neighbours
from softmpm.scene.scene import Scene
from softmpm.specification import ACTUATORS, LAWS, constants_of, kernel_of, muscle_slots, specification
from softmpm.stability import stiffening_signs
from softmpm.state import Low, Params, State
from softmpm.summary import counted
from softmpm.surface_grid import SurfaceGrid
from softmpm.surface_points import CarriedPoints
from softmpm.workspace import Workspace


class Model:
    """A scene prepared for one device. From :func:`softmpm.build`; never modified, its workspace apart.

    Attributes:
        scene: The scene it was built from.
        device, dtype: Where it runs and in which precision.
        worlds, particle_count, muscle_count, wall_count, driven_count, dim: Sizes.
        calls: How many calls of ``simulate`` share the memory budget.
        threads: CPU threads that share a simulation; None: those of PyTorch.
        alarms: Limits beyond which a simulation is stopped.
        neighbours: Neighbours at rest of each particle, -1 for none, shape (particle, at most dim).
        positions: Rest positions X [m], shape (particle, dim); ``exact_positions`` are the scene's, a NumPy array.
        volume: Rest volumes V⁰ [m³], shape (particle,).
        mass: Mass [kg] as the scene gives it, shape (particle,).
        mass_unit: Mass of the heaviest particle [kg], in which the kernels count, shape ().
        specific_volume: Rest volume per unit of mass [m³/kg], shape (particle,).
        stiffening: Sign of the active stress that stiffens, of each actuator, shape (muscle,).
        driven: Indices of the driven particles, shape (driven,).
        body: Index of each particle's body, shape (particle,).
        wall_constants: Numbers of the walls that lie in the parameters of a launch, by the names of the inputs.
        fixed: What the scene alone decides of the kernels' inputs, by name.
        defaults: Fields of :class:`softmpm.Inputs` that the kernels take, where a call leaves them out.
        derived: Names of the kernels' inputs that a call decides, in their order.
        spec: What the kernels are specialised for.
        deterministic: Whether results are the same bits from run to run.
        formulation, formulation_reason: "moving" or "reference", and why it was chosen.
        surface: Surface points that meet the separating walls, or None if the nodes do.
        driven_grid: Nodes that driven particles hold in the reference formulation, or None.
        mirror: Nodes that clamps and planes of symmetry hold or reflect, or None if the scene has neither.
        overlap: Volumes of the particles, to find bodies that pass through each other, or None if nothing has to be found.
        contact_width: Width over which surface contact sets in [cells].
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
        formulation: str,
        formulation_reason: str,
        surface: bool,
        contact_width: float,
        given: tuple[str, ...],
        deterministic: bool,
        fixed_point: bool,
        worlds: int,
        memory_budget: int | None,
        calls: int,
        threads: int | None,
    ):
        self.scene, self.device, self.dtype, self.worlds = scene, device, dtype, worlds
        self.memory_budget, self.calls, self.alarms = memory_budget, calls, alarms
        self.threads = threads
        self.dim = scene.grid.dim
        self.particle_count = scene.particle_count
        self.muscle_count, self.wall_count = len(scene.muscles), len(scene.walls)
        self.driven_count = len(scene.driven)
        self.driven = torch.tensor(np.array(scene.driven, dtype=np.int64), device=device)
        self.node_count = math.prod(scene.grid.shape)
        self.body = torch.from_numpy(scene.body_index).to(device)
        self.exact_positions = scene.positions
        self.positions = self._tensor(self.exact_positions)
        self.volume = self._tensor(np.concatenate([body.particles.volume for body in scene.bodies]))
        slots = muscle_slots(scene, self.particle_count)
        self.scheme, self.scheme_reason, self.footprint = scheme, scheme_reason, footprint
        self.deterministic, self.workspace = deterministic, Workspace()
        self.formulation, self.formulation_reason = formulation, formulation_reason
        self._rest_grid, self.overlap = None, None
        if formulation == "reference":
            self._rest_grid = RestGrid(scene, device, dtype, worlds, "force" in given)
            self.overlap = overlap_grid(scene, self.rest_grid, alarms.overlap, device)
        self.surface = None
        if surface:
            reference = formulation == "reference"
            self.surface = (
                SurfaceGrid(scene, self.rest_grid, device) if reference else CarriedPoints(scene, device)
            )
        self.contact_width, precision = contact_width, str(dtype).removeprefix("torch.")
        slabs = scheme == "fast" and device.type == "cpu" and not fixed_point
        self.spec = specification(
            scene, precision, slots.shape[1], given, fixed_point, slabs, surface, formulation
        )
        self.mirror = MirrorGrid(scene, self.rest_grid, device) if self.spec.mirrors else None
        self.driven_grid = (
            DrivenGrid(scene, self.rest_grid, self.mirror, device) if self.spec.driven_nodes else None
        )
        self.strength = self._tensor([m.strength for m in scene.muscles])
        self.stiffening = self._tensor(stiffening_signs(scene))
        # Computed now, not on first use: that may be during a capture, which runs nothing.
        self._params, self._low = self._given(), self._rounded() if dtype == torch.float32 else None
        self.mass = (self._params.density * self.volume).contiguous()
        self.mass_unit = self.mass.max()
        self.specific_volume = self.volume / self.mass_unit
        self.fixed, self.defaults = self._fixed(slots), self._defaults()
        self.derived = tuple(
            one.name for one in stored(self.spec) if one.name not in self.fixed and one.per != "substep"
        )
        self.wall_constants = {
            "normal": [number for wall in scene.walls for number in wall.normal],
            "offset": [wall.offset for wall in scene.walls],
            "friction": [wall.friction for wall in scene.walls],
        }
        self.wp_device = warp_device_of(device)
        self.constants = constants_of(scene, self.spec, alarms)
        check_room(self)
        self.neighbours = self._neighbours()

    def _tensor(self, values) -> Tensor:
        return torch.tensor(np.asarray(values, dtype=np.float64), dtype=self.dtype, device=self.device)

    def _neighbours(self) -> Tensor:
        """Neighbours at rest of each particle, -1 for none, shape (particle, at most dim); without columns if no alarm needs them."""
        if self.alarms.gap is None:
            return torch.empty(self.particle_count, 0, dtype=torch.int32, device=self.device)
        longest = self.alarms.gap * self.scene.grid.spacing
        return torch.from_numpy(rest_neighbours(self.scene, longest)).to(self.device)

    def _fixed(self, slots: np.ndarray) -> dict[str, Tensor]:
        """See :attr:`fixed`; in all worlds the same."""
        scene, spec, lead = self.scene, self.spec, (self.worlds, self.particle_count)

        def integers(values) -> Tensor:
            return torch.from_numpy(np.asarray(values, dtype=np.int32)).to(self.device)

        fixed = {"volume": self.specific_volume.expand(lead)}
        if len(spec.laws) > 1:
            laws = integers([spec.laws.index(kernel_of(body.material, LAWS)) for body in scene.bodies])
            fixed["law"] = laws[self.body].expand(lead)
        if spec.muscle_slots:
            fixed["muscle"] = integers(slots).expand(*lead, -1)
        if len(spec.actuators) > 1:
            fixed["actuator"] = integers(
                [spec.actuators.index(kernel_of(m, ACTUATORS)) for m in scene.muscles]
            )
        if spec.fibres and "direction" not in spec.given:
            fixed["fibre"] = self._tensor([direction_of(muscle, scene) for muscle in scene.muscles])
        if spec.driven:
            handles = np.full(self.particle_count, -1)
            handles[scene.driven] = np.arange(len(scene.driven))
            fixed["driven"] = integers(handles).expand(lead)
        return fixed

    def _defaults(self) -> dict[str, Tensor]:
        """See :attr:`defaults`."""
        found = {}
        for name, known in QUANTITIES.items():
            if known.default is not None and (name in self.spec.given or known.needed(self.spec)):
                dtype = torch.float64 if known.double else self.dtype
                values = np.asarray(known.default(self.scene), dtype=np.float64)
                found[name] = torch.tensor(values, dtype=dtype, device=self.device)
        return found

    def shape_of(self, name: str, control_steps: int) -> tuple[int, ...]:
        """Full shape of a field of :class:`Params` or :class:`Inputs` in a call of so many control steps."""
        sizes = {
            "control_step": control_steps,
            "pose": control_steps + 1,
            "world": self.worlds,
            "particle": self.particle_count,
            "muscle": self.muscle_count,
            "wall": self.wall_count,
            "driven": self.driven_count,
            "dim": self.dim,
        }
        return tuple(sizes[axis] for axis in QUANTITIES[name].axes)

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

    @property
    def rest_grid(self) -> RestGrid:
        """Nodes and weights of the reference formulation."""
        assert self._rest_grid is not None, "the moving formulation has no grid at rest"
        return self._rest_grid

    @property
    def anchor_shape(self) -> tuple[int, ...]:
        """Shape of the anchors of a state."""
        points = 0 if self.surface is None else self.surface.count
        return self.worlds, len(self.spec.surface_walls), points, self.dim

    @property
    def reaction_shape(self) -> tuple[int, ...]:
        """Shape of the mean forces of clamps and planes of symmetry in a state."""
        return self.worlds, 0 if self.mirror is None else self.mirror.count, self.dim

    @property
    def rest_low(self) -> Tensor:
        """Remainders of rounding the rest positions [m], shape (particle, dim); zeros in float64."""
        return torch.zeros_like(self.positions) if self._low is None else self._low

    def sizes(self) -> Sizes:
        """Bytes of what a call may keep, see planning/memory.py."""
        return self.footprint.sizes(self)

    def __reduce__(self):
        raise TypeError(
            "a model cannot be copied or pickled, it holds kernels and buffers: take its scene, and build it again."
        )

    def __repr__(self) -> str:
        particles = counted(self.particle_count, "particle")
        muscles = counted(self.muscle_count, "muscle")
        sizes = f"{counted(self.worlds, 'world')} of {particles} and {muscles}"
        return f"Model({self.dim}D, {self.spec.dtype} on {self.device}, {sizes}, {self.scheme} scheme, dt {self.scene.dt:.4g} s)"

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(self.describe())}</pre>"

    def describe(self, substeps: int = 1000) -> str:
        """Summary of the compiled features, the features left out, and the memory of calls of this many substeps."""
        return describe(self, substeps)


def check_model(model: object, wants: str) -> None:
    """Raise TypeError unless this is a model; ``wants`` names the function that needs it."""
    if not isinstance(model, Model):
        raise TypeError(
            f"{wants} needs a model, as softmpm.build(scene) gives it, got {type(model).__name__}."
        )
