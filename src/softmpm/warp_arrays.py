"""States and material in Warp arrays, for users of Warp: made from tensors, read back, checked once when they are made."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
import warp as wp
from torch import Tensor

from softmpm.check_inputs import check_inputs, check_inputs_bounds, control_steps
from softmpm.check_state import check_finite, check_state
from softmpm.checks import check_params, check_row
from softmpm.compiling import opaque
from softmpm.errors import MAX_SUBSTEP, NEVER
from softmpm.inputs import INPUTS, Input, Inputs, differentiable, stored
from softmpm.kernel_inputs import derive
from softmpm.kernels.structs import element_type
from softmpm.model import Model, check_model
from softmpm.planning.chunks import Horizon
from softmpm.schemes.alarm_check import armed, check_end
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.device import on_its_gpu, stream_of
from softmpm.schemes.failure_report import raise_failure, raise_gradient_failure
from softmpm.schemes.inputs import Values, grid_struct, particle_struct, shape_of
from softmpm.schemes.lagrangian.nodal import particles_of, start_of
from softmpm.schemes.lagrangian.nodal_step import NodalStep
from softmpm.schemes.plain.particle_step import ParticleStep
from softmpm.schemes.surface_start import with_surface
from softmpm.state import Params, State
from softmpm.warp_nodal import WarpNodal, check_array, owned, warp_nodal
from softmpm.warp_particles import WarpState, torch_particles, warp_particles


@dataclass(eq=False, frozen=True, kw_only=True)
class WarpSolid:
    """Inputs of a step in Warp arrays, with the buffers that steps share: material, active stress, and what the scene has besides.

    Arrays are written into (``wp.copy``), not replaced. The adjoint of a step reads them as they are then: between two steps on one
    tape they keep their values, so a control signal that changes takes a further ``WarpSolid`` for each value.
    """

    model: Model
    """The model that it was made for, and works with."""
    mass: wp.array
    """m_p in units of ``model.mass_unit``, (world, particle)."""
    mu: wp.array
    """Lamé's μ [Pa], (world, particle)."""
    lam: wp.array
    """Lamé's λ [Pa], (world, particle)."""
    active_stress: wp.array | None = None
    """Activation times strength [Pa], (world, muscle); None without muscles."""
    others: Mapping[str, wp.array] = field(default_factory=dict)
    """The other inputs that the kernels take, by their names in softmpm/inputs.py."""
    work: ParticleStep | NodalStep = field(init=False)

    def __post_init__(self):
        model, arrays, given = self.model, self.arrays(), {}
        for one in stored(model.spec):
            if one.name in model.derived:
                kind = element_type(model.spec, one)
                given[one] = check_array(model, one.name, arrays.get(one.name), _lead(model, one), kind)
        if model.formulation == "reference":
            work = NodalStep(model)
        else:
            work = ParticleStep(model)
            _bind(work, given)
        object.__setattr__(self, "work", work)

    def differentiable(self) -> list[wp.array]:
        arrays = self.arrays()
        return [arrays[one.name] for one in differentiable(self.model.spec)]

    def arrays(self) -> dict[str, wp.array]:
        """Every array by its name."""
        own = {"mass": self.mass, "mu": self.mu, "lam": self.lam}
        own |= {} if self.active_stress is None else {"active_stress": self.active_stress}
        return own | dict(self.others)

    def values(self) -> Values:
        """As the schemes take them: one row of what has rows."""
        rows = {one.name for one in INPUTS if one.rows}
        tensors = {name: wp.to_torch(array, requires_grad=False) for name, array in self.arrays().items()}
        return {name: tensor[None] if name in rows else tensor for name, tensor in tensors.items()}

    def fingerprint(self) -> Tensor:
        """A number for each array, another one if a number in it changes, shape (array,), int64."""
        return torch.stack([_fingerprint(self.model, tensor) for tensor in self.values().values()])

    def check_unchanged(self, then: Tensor) -> None:
        """Raise RuntimeError for an array that was written since it had this fingerprint. Waits for the device."""
        changed = (self.fingerprint() != then).tolist()
        names = [name for name, other in zip(self.arrays(), changed, strict=True) if other]
        if names:
            raise RuntimeError(
                f"{', '.join(names)} of a WarpSolid was written after a step on the tape, whose adjoint reads it; take a solid for "
                "each value, from softmpm.warp_solid."
            )

    def raise_failure(self, model: Model, state: WarpState | WarpNodal) -> None:
        """Raise :class:`softmpm.UnstableError` if a step so far failed, or an adjoint since the last such error. Waits for the device.

        Checks ``state``, which the last step gave, for torn bodies and the running step limit as well.
        """
        check_own(model, "raise_failure", solid=self, state=state)
        self.work.stream = stream_of(model.device)
        _raise_failure(model, state, self.work, self.values())
        adj_words = self.work.adj_words.tolist()
        self.work.adj_words.fill_(NEVER)
        raise_gradient_failure(model, adj_words, MAX_SUBSTEP)


def _fingerprint(model: Model, tensor: Tensor) -> Tensor:
    """Sum of all numbers as integers, each times an odd number of its own."""
    bits = tensor.reshape(-1).view(torch.int32 if tensor.element_size() == 4 else torch.int64)
    count = bits.numel()
    odd = model.workspace.get((_fingerprint, count), lambda: 2 * torch.arange(count, device=bits.device) + 1)
    return (bits * odd).sum()


def _bind(work: ParticleStep, given: Mapping[Input, wp.array]) -> None:
    """Set the structs of the inputs of a substep of the moving formulation."""
    model = work.model
    work.particle_inputs, work.grid_inputs = particle_struct(model, model.fixed), grid_struct(model, {})
    if model.spec.moving:
        work.grid_inputs.elapsed = wp.zeros(1, dtype=wp.float64, device=model.wp_device)
    for one, array in given.items():
        setattr(work.grid_inputs if one.stage == "grid" else work.particle_inputs, one.name, array)


@on_its_gpu
def _raise_failure(
    model: Model, state: WarpState | WarpNodal, work: ParticleStep | NodalStep, values: Values
) -> None:
    if isinstance(work, NodalStep):
        assert isinstance(state, WarpNodal)
        nodes = state.nodal()
        words, end = work.checked(nodes, values), particles_of(model, nodes)
        raise_failure(model, words.tolist(), end, values=values, time=model.scene.dt)
        return
    assert isinstance(state, WarpState)
    end = work.leave(state.struct(model))
    if armed(model):
        check_end(model, work.particle_inputs, end, work.words_array, work.last)
    work.check_depth(state.struct(model))
    raise_failure(model, work.words.tolist(), end, values=values, time=model.scene.dt)


def check_own(model: Model, wants: str, **given: WarpState | WarpNodal | WarpSolid) -> None:
    """Raise unless these are the model's own: the kernels trust shapes and types."""
    check_model(model, wants)
    of_states = WarpNodal if model.formulation == "reference" else WarpState
    for name, held in given.items():
        kind, make = (WarpSolid, "warp_solid") if name == "solid" else (of_states, "warp_state")
        if not isinstance(held, kind):
            raise TypeError(
                f"{name} must be a softmpm.{kind.__name__}, as softmpm.{make} gives it, got {type(held).__name__}."
            )
        if held.model is not model:
            raise ValueError(f"{name} belongs to another model; make one with softmpm.{make}(model).")


def _lead(model: Model, one: Input) -> tuple[int, ...]:
    """Axes of an input in a step, without that of a vector."""
    shape = shape_of(model, one, 1)[1 if one.rows else 0 :]
    return shape[:-1] if one.kind == "vector" else shape


def warp_state(
    model: Model, state: State | None = None, solid: WarpSolid | None = None, *, requires_grad: bool = False
) -> WarpState | WarpNodal:
    """A :class:`WarpState` that holds ``state``, or the rest state if None; in the reference formulation a :class:`WarpNodal`.

    Args:
        solid: Masses and walls by which nodes, in the reference formulation, or anchors of surface points are computed from a state
            without any; None takes the scene's.

    Raises:
        TypeError, ValueError: As :func:`softmpm.simulate`, for the model and the state.
        UnstableError: A particle is off the grid.
    """
    return _warp_state(model, state, solid, requires_grad)


@opaque
def _warp_state(
    model: Model, state: State | None, solid: WarpSolid | None, requires_grad: bool
) -> WarpState | WarpNodal:
    check_model(model, "warp_state")
    if state is not None:
        check_state(model, state)
        if not is_capturing(model):
            check_finite(state, None)
    if solid is not None:
        check_own(model, "warp_state", solid=solid)
    start = model.rest() if state is None else state
    if model.formulation == "reference":
        return _warp_nodal(model, start, solid, requires_grad)
    if model.surface is not None:
        start = with_surface(model, start, {} if solid is None else solid.values())
    return warp_particles(model, start.detach(), requires_grad)


@torch.no_grad()
def _warp_nodal(model: Model, state: State, solid: WarpSolid | None, requires_grad: bool) -> WarpNodal:
    mass, normals = model.mass.expand(model.worlds, -1), None
    if solid is not None:
        values = solid.values()
        mass, normals = values["mass"], values["normal"][0] if model.spec.moving else None
    return warp_nodal(model, start_of(model, state, mass, normals), requires_grad)


def torch_state(model: Model, state: WarpState | WarpNodal) -> State:
    """The :class:`softmpm.State` that a state of this model in Warp arrays holds, in new tensors."""
    return _torch_state(model, state)


@opaque
def _torch_state(model: Model, state: WarpState | WarpNodal) -> State:
    check_own(model, "torch_state", state=state)
    if isinstance(state, WarpNodal):
        return particles_of(model, state.nodal().clone())
    return torch_particles(model, state)


def warp_solid(
    model: Model,
    params: Params | None = None,
    activation: Tensor | None = None,
    inputs: Inputs | None = None,
    *,
    requires_grad: bool = False,
) -> WarpSolid:
    """Material, actuators and other inputs for :func:`step`.

    Args:
        params: As in :func:`softmpm.simulate`; None takes the scene's.
        activation: Muscle activation [-], shape (world, muscle); None is zero.
        inputs: As in :func:`softmpm.simulate`, in one control step of one substep.

    Raises:
        TypeError, ValueError: As :func:`softmpm.simulate`, for the model, the material, the activation and the inputs.
    """
    check_model(model, "warp_solid")
    params = model.params() if params is None else params
    check_params(model, params)
    check_row(model, activation)
    given = check_inputs(model, inputs)
    row = None if activation is None else activation[None]
    steps = control_steps(None, given)
    if steps != 1:
        raise ValueError(
            f"a step takes inputs of one control step, got {steps}; take one row of each, two poses."
        )
    if "position" in given:
        raise ValueError(
            "a step takes inputs.velocity of the driven particles, since it does not know their start."
        )
    if not is_capturing(model):
        check_finite(None, activation)
        check_inputs_bounds(model, given)
    return _warp_solid(model, derive(model, model.rest(), row, params, given, Horizon(1, 1)), requires_grad)


@on_its_gpu
def _warp_solid(model: Model, values: Values, requires_grad: bool) -> WarpSolid:
    arrays = {}
    for one in stored(model.spec):
        if one.name in values:
            value = values[one.name][0] if one.rows else values[one.name]
            needs = requires_grad and bool(one.group)
            arrays[one.name] = owned(value.detach(), element_type(model.spec, one), needs)
    own = {name: arrays.pop(name) for name in ("mass", "mu", "lam", "active_stress") if name in arrays}
    return WarpSolid(model=model, others=arrays, **own)
