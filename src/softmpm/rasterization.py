"""Particles to grid for an observer, on tensors: launches of kernels/rasterize.py."""

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import NEVER, UnstableError, decode
from softmpm.kernels.rasterize import raster
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import passing, view
from softmpm.schemes.capture import defer_status_check, is_capturing, keep_alive
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.failure_report import failed_worlds, raise_failure
from softmpm.schemes.launch import launcher
from softmpm.state import GridField, State


def _particles(model: Model, *tensors: Tensor) -> list:
    """Vectors and matrices of the particles as the kernels take them."""
    t = types(model.dim, model.spec.dtype)
    return [passing(tensor, t.vec if tensor.ndim == 3 else t.mat) for tensor in tensors]


def _nodes(model: Model, *tensors: Tensor) -> list:
    """Numbers of the nodes as the kernels take them, the axes of the grid as one."""
    return [
        passing(tensor.flatten(1, model.dim), types(model.dim, model.spec.dtype).real) for tensor in tensors
    ]


def _units(model: Model, mass: Tensor, state: State) -> Tensor:
    """Units of momentum and mass in which no sum over a world's particles overflows 62 bits, powers of two, (world, 2)."""
    speed = state.v.abs().amax(-1) + 2 * model.scene.grid.spacing * state.C.abs().sum(-1).amax(-1)
    largest = torch.stack([(mass * speed).amax(1), mass.amax().expand(model.worlds)], 1).double()
    return torch.frexp(largest * model.particle_count / 2.0**62).exponent.double().exp2()


def _sums(model: Model, state: State, words: Tensor) -> Tensor:
    """Momentum and mass of the nodes, (world, node, dim + 1)."""
    launch, kernels = launcher(model), raster(model.dim, model.spec.dtype)
    t, lead = types(model.dim, model.spec.dtype), (model.worlds, model.particle_count)
    mass, status = passing(model.mass, t.real), passing(words, wp.int64)
    moving = _particles(model, *(tensor.contiguous() for tensor in (state.x, state.v, state.C)))
    shape = (model.worlds, model.node_count, model.dim + 1)
    if not model.deterministic or model.dtype == torch.float64:
        splat = kernels.splat_in_order if model.deterministic else kernels.splat
        node = torch.zeros(shape, dtype=model.dtype, device=model.device)
        launch(splat, lead, model.constants, mass, *moving, status, view(node, t.node))
        return node
    node, units = torch.zeros(shape, dtype=torch.int64, device=model.device), _units(model, model.mass, state)
    inputs = (mass, passing(units, wp.float64), *moving)
    launch(kernels.splat_fixed, lead, model.constants, *inputs, status, passing(node, wp.int64))
    momentum, mass = (unit[:, None, None] for unit in units.unbind(1))
    return torch.cat([node[..., :-1] * momentum, node[..., -1:] * mass], -1).to(model.dtype)


def _no_failure(model: Model) -> Tensor:
    """Status words, one for each world."""
    return torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)


@on_its_gpu
def rasterize_nodes(model: Model, state: State) -> GridField:
    """Mass (world, *nodes) and velocity (world, *nodes, dim) of what :func:`softmpm.rasterize` sees."""
    words = _no_failure(model)
    node = _sums(model, state, words)
    if is_capturing(model):
        defer_status_check(words)
        keep_alive(model)
    else:
        raise_failure(model, words.tolist(), state)
    grid = model.scene.grid.shape
    velocity = node.new_empty(model.worlds, model.dim, *grid).movedim(1, -1)  # in memory as in a picture
    field = GridField(node.new_empty(model.worlds, *grid), velocity)
    launch, kernels = launcher(model), raster(model.dim, model.spec.dtype)
    nodes = passing(node, types(model.dim, model.spec.dtype).node)
    launch(kernels.divide, (model.worlds, model.node_count), nodes, *_nodes(model, *field))
    return field


@on_its_gpu
def rasterize_nodes_adj(model: Model, state: State, field: GridField, adj: GridField) -> State:
    """Adjoint of :func:`rasterize_nodes`, of x, v and C.

    Raises:
        UnstableError: An adjoint is not finite.
    """
    launch, kernels = launcher(model), raster(model.dim, model.spec.dtype)
    t, lead = types(model.dim, model.spec.dtype), (model.worlds, model.node_count)
    adj_node = passing(field.mass.new_empty(*lead, model.dim + 1), t.node)
    launch(kernels.divide_adj, lead, *_nodes(model, *field, *adj), adj_node)
    moving = [tensor.contiguous() for tensor in (state.x, state.v, state.C)]
    adj_moving = [torch.empty_like(tensor) for tensor in moving]
    inputs = (passing(model.mass, t.real), *_particles(model, *moving), adj_node)
    lead, words = (model.worlds, model.particle_count), _no_failure(model)
    found = (passing(words, wp.int64), *_particles(model, *adj_moving))
    launch(kernels.splat_adj, lead, model.constants, *inputs, *found)
    if is_capturing(model):
        defer_status_check(words)
    else:
        _raise_gradient_failure(model, words.tolist(), adj)
    return State(*adj_moving, F=torch.empty(0))  # nothing: F does not enter


def _raise_gradient_failure(model: Model, words: list[int], adj: GridField) -> None:
    """Raise for the first particle whose adjoint is not finite, if any."""
    failed = failed_worlds(words)
    if not failed:
        return
    world, particle = failed[0], decode(words[failed[0]])[2]
    given = all(bool(torch.isfinite(tensor[world]).all()) for tensor in adj)
    cause = (
        "It overflowed in the backward pass: scale the loss"
        if given
        else "The gradient of the loss with respect to the field came in like that: look at the loss"
    )
    limit = "gradients must be finite"
    raise UnstableError(
        f"particle {particle} (body {int(model.body[particle])}) of world {world} has an adjoint that is not finite in the backward "
        f"pass of rasterize; {limit}. {cause}.",
        kind="gradient",
        world=world,
        particle=particle,
        substep=0,
        value="not finite",
        limit=limit,
    )
