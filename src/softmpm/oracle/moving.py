"""The moving grid once more in plain PyTorch: slow, readable, the truth in tests; no code shared with kernels.

Every function takes tensors with any leading axes and is differentiated by torch.autograd; meant for float64.
The stress of a particle stands in ``stress.py``, transfers in ``transfer.py``, walls in ``walls.py``, the total Lagrangian
formulation in ``lagrangian.py``. Derivations and labels: docs/math/.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from softmpm.inputs import QUANTITIES, Inputs
from softmpm.oracle.stress import actuator_stress, lame, law_of, viscous_stress
from softmpm.oracle.transfer import g2p, p2g
from softmpm.oracle.walls import inside, respond, surface, wall_velocity
from softmpm.scene.actuators import Actuator
from softmpm.scene.scene import CONTACTS, Scene
from softmpm.state import GridField, Params, State

SCENE = Inputs()
"""Every input is the scene's."""


def stress(
    scene: Scene,
    F: Tensor,
    mu: Tensor,
    lam: Tensor,
    activation: Tensor | None,
    C: Tensor | None = None,
    inputs: Inputs = SCENE,
) -> Tensor:
    """Total τ [Pa] of each particle, (world, particle, dim, dim); ``activation`` (world, muscle) or None.

    ``inputs`` are those of one control step, without that axis. ``C`` belongs to the same state as ``F``; None leaves out the viscous
    stress.
    """
    parts, start = [], 0
    for body in scene.bodies:
        part = slice(start, start + len(body.particles))
        parts.append(law_of(body.material)(F[:, part], mu[:, part], lam[:, part]))
        start = part.stop
    tau = torch.cat(parts, 1)
    if activation is not None:
        strengths = [muscle.strength for muscle in scene.muscles]
        strength = _given(inputs.strength, strengths, F, len(F), len(strengths))
        for k, muscle in enumerate(scene.muscles):
            index = torch.tensor(muscle.particles)
            active_stress = (activation[:, k, None] * strength[:, k, None]).expand(-1, len(index))
            direction = _direction(muscle, k, inputs, strength)[:, None]
            active = actuator_stress(muscle, F[:, index], direction, active_stress)
            tau = tau.index_add(1, index, active)
    if C is not None:
        eta = _given(inputs.viscosity, _of_materials(scene, "viscosity"), F, *F.shape[:2])
        tau = tau + viscous_stress(F, C, eta)
    return tau


def _direction(muscle: Actuator, k: int, inputs: Inputs, strength: Tensor) -> Tensor:
    """Unit fibre direction of actuator k in each world, shape (world, dim), if it has any; ``strength`` (world, muscle) of all."""
    if inputs.direction is None:
        return torch.tensor(getattr(muscle, "direction", ()), dtype=strength.dtype).expand(len(strength), -1)
    d = inputs.direction.expand(*strength.shape, -1)[:, k]
    return d / torch.linalg.vector_norm(d, dim=-1, keepdim=True)


def _given(value: Tensor | None, scenes: float | Sequence[float], like: Tensor, *shape: int) -> Tensor:
    """An input in full shape: that of the call, else the scene's."""
    value = torch.tensor(scenes, dtype=like.dtype) if value is None else value
    return value.expand(shape)


def grid_velocity(
    scene: Scene,
    mass: Tensor,
    momentum: Tensor,
    inputs: Inputs = SCENE,
    time: float = 0.0,
    duration: float = 1.0,
    displacement: Tensor | None = None,
    contacts: Sequence[str] = CONTACTS,
) -> Tensor:
    """Velocity of the nodes after gravity, damping and walls (G2), zero where there is no mass.

    Args:
        inputs: Of one control step, without that axis; one pose of the walls, or those at its two ends.
        time, duration: Since the beginning of the control step, and its length [s].
        displacement: Of the nodes [m], shape (world, node, dim), where a wall meets them elsewhere.
        contacts: Kinds of the walls that act on nodes.
    """
    present = (mass > 0)[..., None]
    v = momentum / torch.where(mass > 0, mass, torch.ones_like(mass))[..., None]
    worlds, dim = len(v), scene.grid.dim
    gravity = _given(inputs.gravity, scene.gravity or (0.0,) * dim, v, worlds, dim)
    damping = _given(inputs.damping, scene.damping, v, worlds)
    v = (v + scene.dt * gravity[:, None]) * torch.exp(-scene.dt * damping)[:, None, None]
    friction = _given(inputs.friction, [wall.friction for wall in scene.walls], v, worlds, len(scene.walls))
    for k, wall in enumerate(scene.walls):
        if wall.contact not in contacts:
            continue
        where = surface(scene, k, inputs, v, time, duration)
        u = wall_velocity(scene, where, displacement)
        response = u + respond(wall, v - u, friction[:, k, None, None], where.unit[:, None])  # (C5)
        v = torch.where(inside(scene, where, displacement)[..., None] & present, response, v)
    return torch.where(present, v, torch.zeros_like(v))


def _of_materials(scene: Scene, name: str) -> list[float]:
    """A constant of the material of each particle."""
    return [getattr(body.material, name) for body in scene.bodies for _ in range(len(body.particles))]


def rest_volume(scene: Scene, dtype: torch.dtype) -> Tensor:
    """Rest volumes V⁰ [m³], in 2D [m²], shape (particle,)."""
    return torch.cat([torch.tensor(body.particles.volume, dtype=dtype) for body in scene.bodies])


def step(
    scene: Scene,
    state: State,
    activation: Tensor | None,
    mu: Tensor,
    lam: Tensor,
    mass: Tensor,
    inputs: Inputs = SCENE,
    time: float = 0.0,
    duration: float = 1.0,
) -> State:
    """One substep: P2G, grid, G2P. ``activation`` (world, muscle) or None; material (world, particle)."""
    _, velocity = to_grid(scene, state, activation, mu, lam, mass, inputs, time, duration)
    return from_grid(scene, state, velocity, inputs)


def to_grid(
    scene: Scene,
    state: State,
    activation: Tensor | None,
    mu: Tensor,
    lam: Tensor,
    mass: Tensor,
    inputs: Inputs,
    time: float,
    duration: float,
    contacts: Sequence[str] = CONTACTS,
) -> tuple[Tensor, Tensor]:
    """Masses and velocities of the nodes after P2G and the grid stage, with the walls of the kinds ``contacts``."""
    tau, D = stress(scene, state.F, mu, lam, activation, state.C, inputs), scene.grid.spacing**2 / 4
    load = scene.dt * rest_volume(scene, mass.dtype) / D
    affine = mass[..., None, None] * state.C - load[:, None, None] * tau
    pushed = mass[..., None] * state.v
    if inputs.force is not None:
        pushed = pushed + scene.dt * inputs.force.expand(state.v.shape)  # (T4)
    node_mass, momentum = p2g(scene, state.x, mass, pushed, affine)
    return node_mass, grid_velocity(scene, node_mass, momentum, inputs, time, duration, contacts=contacts)


def from_grid(scene: Scene, state: State, velocity: Tensor, inputs: Inputs) -> State:
    """G2P: the state after the substep from the velocities of the nodes."""
    v, C = g2p(scene, state.x, velocity)
    if len(scene.driven):
        given = _given(inputs.velocity, 0.0, v, len(v), len(scene.driven), v.shape[-1])
        v = v.index_copy(1, torch.tensor(scene.driven), given)  # (T5)
    return State(state.x + scene.dt * v, v, C, state.F + scene.dt * C @ state.F)


def simulate(
    scene: Scene,
    start: State,
    activation: Tensor | None,
    params: Params,
    *,
    substeps: int,
    inputs: Inputs = SCENE,
) -> State:
    """The contract of :func:`softmpm.simulate`, on a scene instead of a model.

    There are as many control steps as rows of ``activation``, without it as ``inputs`` has, else one.
    """
    lead = start.x.shape[:2]
    young, poisson, density = (value.expand(lead) for value in params)
    mu, lam = lame(young, poisson)
    mass, state = density * rest_volume(scene, density.dtype), start
    steps = control_steps(activation, inputs)
    for c in range(steps):
        row, now = None if activation is None else activation[c], of_control_step(inputs, c, steps)
        if now.position is not None:
            way = now.position - state.x[:, torch.tensor(list(scene.driven))]
            now = now._replace(velocity=way / (substeps * scene.dt), position=None)
        for s in range(substeps):
            time, duration = s * scene.dt, substeps * scene.dt
            state = step(scene, state, row, mu, lam, mass, now, time, duration)
    return state


def control_steps(activation: Tensor | None, inputs: Inputs) -> int:
    """Number of control steps: rows of ``activation``, without it of ``inputs``, else one."""
    if activation is not None:
        return len(activation)
    counts = [1]
    for name, value in inputs._asdict().items():
        axes = QUANTITIES[name].axes
        if value is not None and value.ndim == len(axes) and axes[0] in ("control_step", "pose"):
            counts.append(len(value) - (axes[0] == "pose"))
    return max(counts)


def of_control_step(inputs: Inputs, c: int, steps: int) -> Inputs:
    """Inputs of one control step: those that have that axis without it, the poses at its two ends."""
    now = {}
    for name, value in inputs._asdict().items():
        axes = QUANTITIES[name].axes
        if value is None or value.ndim < len(axes) or axes[0] not in ("control_step", "pose"):
            continue
        count = steps + (axes[0] == "pose")
        if len(value) not in (1, count):
            raise ValueError(
                f"inputs.{name} needs 1 or {count} rows for {steps} control steps, got {len(value)}."
            )
        if axes[0] == "pose":
            now[name] = value[c : c + 2] if len(value) > 1 else value
        else:
            now[name] = value[c if len(value) > 1 else 0]
    return inputs._replace(**now)


def rasterize(scene: Scene, state: State, density: Tensor) -> GridField:
    """Mass and velocity on the nodes without forces (O1); ``density`` broadcasts to (world, particle)."""
    mass = (density * rest_volume(scene, density.dtype)).expand(state.x.shape[:2])
    affine = mass[..., None, None] * state.C
    node_mass, momentum = p2g(scene, state.x, mass, mass[..., None] * state.v, affine)
    velocity = momentum / torch.where(node_mass > 0, node_mass, torch.ones_like(node_mass))[..., None]
    shape = scene.grid.shape
    return GridField(node_mass.view(-1, *shape), velocity.view(-1, *shape, len(shape)))
