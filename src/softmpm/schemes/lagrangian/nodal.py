"""The two representations of a state in the reference formulation: nodes, and the particles that show them. Differentiable.

Equations: kernels/lagrangian/projection.py. Clamps and planes of symmetry then hold and reflect the nodes by (B1).
"""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.batches import FirstOrder, FirstOrderAdjoint
from softmpm.checks import check_gradients_of_nodes, check_reflected, check_shown
from softmpm.kernels.lagrangian.node_sums import node_sums
from softmpm.kernels.lagrangian.projection import masses, projection
from softmpm.kernels.lagrangian.shown import shown as shown_by
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import cleared, passing
from softmpm.schemes.capture import is_capturing
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.inputs import of_surface_walls
from softmpm.schemes.lagrangian.bricks import brick_launch, empty_partial, node_launch, rest_struct
from softmpm.schemes.lagrangian.frame import quantum, shift_of
from softmpm.schemes.lagrangian.kernels import compile_first
from softmpm.schemes.launch import KernelLauncher, launcher
from softmpm.state import Nodal, State
from softmpm.surface_grid import SurfaceGrid


def particles_of(model: Model, nodes: Nodal) -> State:
    """State of the particles that belongs to a nodal state (Q5), which the result carries along."""
    shown: Any = _Show.apply(model, nodes.u, nodes.v, shift_of(model, nodes))
    return State(*shown, nodes=nodes)


def nodes_of(model: Model, state: State, mass: Tensor, normals: Tensor | None = None) -> Nodal:
    """Nodal state from the four fields of the particles (Q6).

    Args:
        mass: Mass of the particles in any unit, shape (world, particle).
        normals: Unit normals of all walls, shape (world, wall, dim); None takes the scene's.
    """
    moved = state.x - _rest_places(model, state.low is not None)
    moved = moved if state.low is None else moved + state.low.x
    mean, step = moved.detach().mean(1), quantum(model)
    shift = torch.where(mean.abs() > step, step * (mean / step).round(), 0.0)
    moved = (moved - shift[:, None]).to(model.dtype)
    placed = mass.index_select(1, model.rest_grid.order)
    found: Any = _Project.apply(model, moved, state.v, state.C, state.F, placed)
    of_nodes, u, v = found
    if model.mirror is not None:
        u, v = model.mirror.reflected(of_nodes, u, v)
    anchors = _anchors(model, u, normals)
    return with_reaction(model, Nodal(u, v, anchors, torch.zeros_like(anchors), shift))


def start_of(model: Model, state: State, mass: Tensor, normals: Tensor | None = None) -> Nodal:
    """Nodal state that a call starts from, with all parts: that of the state, or :func:`nodes_of` its particles if it has none.

    Raises:
        ValueError: The particles do not show the nodes of the state, a gradient is asked for that of particles only, or clamps do not
            allow the nodes; values are not checked during a capture.
    """
    nodes = state.nodes
    if nodes is None:
        nodes = nodes_of(model, state, mass, normals)
    else:
        check_gradients_of_nodes(state)
        if not is_capturing(model):
            check_shown(_apart(model, state, particles_of(model, nodes.detach())))
            if model.mirror is not None:
                check_reflected(model.mirror.apart(nodes.u.detach(), nodes.v.detach()))
    low = nodes.low
    if low is None:
        low = nodes.u.new_zeros(model.worlds, 2, *nodes.u.shape[1:])
    nodes = nodes._replace(shift=shift_of(model, nodes).detach(), low=low.detach())
    # Clamps and planes of symmetry are of the scene, so that no model of it gives a state a shift; moving walls are of the model.
    if model.spec.moving and model.mirror is None:
        nodes = _without_shift(model, nodes, normals)
    return with_reaction(model, nodes, nodes.reaction)


def _without_shift(model: Model, nodes: Nodal, normals: Tensor | None) -> Nodal:
    """The same state with displacements and anchors that contain the shift, for a model whose worlds are not translated."""
    shift, low = nodes.shift, nodes.low
    assert shift is not None and low is not None
    by = shift[:, None].to(nodes.u.dtype)
    u, before = nodes.u + by, nodes.u.detach()
    added = u.detach() - before
    rounded = (before - (u.detach() - added)) + (by - added)  # off the sum (Knuth's exact addition)
    low = torch.stack([low[:, 0] + rounded, low[:, 1]], dim=1)
    anchor = nodes.anchor
    if model.surface is not None:
        # Where the points adhere does not depend on the walls to come:
        n = _normals(model, normals, shift).detach()
        across = shift[:, None] - (shift[:, None] * n).sum(-1, keepdim=True) * n
        anchor = anchor + across[:, :, None].to(anchor.dtype)
    return nodes._replace(u=u, low=low, anchor=anchor, shift=torch.zeros_like(shift))


def _rest_places(model: Model, exact: bool) -> Tensor:
    """Places of the particles at rest in float64 [m], exact or as the model's precision rounds them."""

    def make() -> Tensor:
        rounded = model.positions.double()
        return rounded + model.rest_low.double() if exact else rounded

    return model.workspace.get((_rest_places, exact), make)


def with_reaction(model: Model, nodes: Nodal, reaction: Tensor | None = None) -> Nodal:
    """The state with these mean forces of clamps and planes of symmetry; None is zero."""
    return nodes._replace(reaction=nodes.u.new_zeros(model.reaction_shape) if reaction is None else reaction)


class _Arrays:
    """Warp arrays on tensors, and launches, of one model."""

    def __init__(self, model: Model):
        self.model, self.types = model, types(model.spec.dim, model.spec.dtype)
        self.rest, self.launch = rest_struct(model), launcher(model)
        self.kernels = projection(model.spec.dim, model.spec.dtype, model.rest_grid.bricks)
        self.sums = node_sums(model.spec.dim, model.spec.dtype)
        self._held: list[Tensor] = []  # until the launches

    def particles(self) -> list[Tensor]:
        """Tensors for the four fields of a state."""
        lead, d, device = (self.model.worlds, self.model.particle_count), self.model.dim, self.model.device
        return [
            torch.empty(*lead, *tail, dtype=self.model.dtype, device=device)
            for tail in ((d,), (d,), (d, d), (d, d))
        ]

    def nodal(self) -> list[Tensor]:
        """Tensors for displacements and velocities of the nodes."""
        shape = self.model.worlds, self.model.rest_grid.count, self.model.dim
        return [torch.empty(shape, dtype=self.model.dtype, device=self.model.device) for _ in range(2)]

    def partials(self) -> list:
        return self.views(*(empty_partial(self.model) for _ in range(2)))

    def views(self, *tensors: Tensor) -> list:
        """Scalars, vectors or matrices, by the number of axes."""
        kinds = {2: self.types.real, 3: self.types.vec, 4: self.types.mat}
        given = [tensor.contiguous() for tensor in tensors]
        self._held += given
        return [passing(tensor, kinds[tensor.ndim]) for tensor in given]

    def node_masses(self, mass: Tensor) -> Tensor:
        """Masses of the nodes, from those of the places."""
        out = torch.empty(self.model.worlds, self.model.rest_grid.count, dtype=mass.dtype, device=mass.device)
        given, found = self.views(mass, out)
        launch_masses(self.model, self.launch, self.rest, given, self.partials()[0], found)
        return out


def launch_masses(
    model: Model, launch: KernelLauncher, rest: Any, mass: wp.array, partial: wp.array, out: wp.array
):
    """Launch (Q2)."""
    kernels = masses(model.spec.dim, model.spec.dtype, model.rest_grid.bricks)
    brick_launch(model, launch, kernels.bricks_of_masses, rest, mass, partial)
    node_launch(model, launch, node_sums(model.spec.dim, model.spec.dtype).mass, rest, partial, out)


class _Show(FirstOrder):
    """(Q5)"""

    @staticmethod
    def forward(model, u, v, shift):
        return _show(model, u, v, shift)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.model = inputs[0]
        ctx.save_for_backward(*output[2:])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx, *adj):
        return None, *_ShowAdj.apply(ctx.model, *ctx.saved_tensors, *adj), None


class _ShowAdj(FirstOrderAdjoint):
    @staticmethod
    def forward(model, C, F, *adj):
        pairs = zip(adj, (C[..., 0], C[..., 0], C, F), strict=True)
        return tuple(_show_adj(model, C, F, *(cleared(like) if one is None else one for one, like in pairs)))


@on_its_gpu
def _apart(model: Model, ours: State, theirs: State) -> Tensor:
    """Largest differences of x, v, C and F between two states, shape (4,)."""
    one, found = _Arrays(model), torch.zeros(4, dtype=model.dtype, device=model.device)
    lead, fields = (model.worlds, model.particle_count), one.views(*ours.detach()[:4], *theirs.detach()[:4])
    kernel = shown_by(model.spec.dim, model.spec.dtype).apart
    # Not in parts, whose threads would share the result:
    one.launch(kernel, lead, *fields, passing(found, one.types.real))
    return found


@on_its_gpu
def _show(model: Model, u: Tensor, v: Tensor, shift: Tensor) -> tuple[Tensor, ...]:
    compile_first(model)
    one = _Arrays(model)
    found = one.particles()
    exact = types(model.spec.dim, "float64").vec
    given = passing(model.positions, one.types.vec), passing(shift, exact)
    arguments = (model.constants, one.rest, *given, *one.views(u, v, *found))
    brick_launch(model, one.launch, one.kernels.show, *arguments)
    return tuple(found)


@on_its_gpu
def _show_adj(model: Model, C: Tensor, F: Tensor, *adj: Tensor) -> list[Tensor]:
    compile_first(model, adjoint=True)
    one = _Arrays(model)
    partials, found = one.partials(), one.nodal()
    brick_launch(
        model, one.launch, one.kernels.show_adj, model.constants, one.rest, *one.views(C, F, *adj), *partials
    )
    node_launch(model, one.launch, one.sums.fields, one.rest, *partials, *one.views(*found))
    return found


class _Project(FirstOrder):
    """(Q6)"""

    @staticmethod
    def forward(model, moved, v, C, F, mass):
        return tuple(_project(model, moved, v, C, F, mass))

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.model = inputs[0]
        ctx.save_for_backward(*inputs[1:], *output)

    @staticmethod
    def backward(ctx, *adj):
        return None, *_ProjectAdj.apply(ctx.model, *ctx.saved_tensors, *adj)


class _ProjectAdj(FirstOrderAdjoint):
    @staticmethod
    def forward(model, *given):
        return tuple(_project_adj(model, *given))


@on_its_gpu
def _project(model: Model, moved: Tensor, v: Tensor, C: Tensor, F: Tensor, mass: Tensor) -> list[Tensor]:
    compile_first(model)
    one = _Arrays(model)
    partials, found, node_mass = one.partials(), one.nodal(), one.node_masses(mass)
    given = one.views(mass, moved, v, C, F)
    brick_launch(model, one.launch, one.kernels.project, model.constants, one.rest, *given, *partials)
    arguments = (one.rest, *one.views(node_mass), *partials, *one.views(*found))
    node_launch(model, one.launch, one.sums.means, *arguments)
    return [node_mass, *found]


@on_its_gpu
def _project_adj(
    model: Model,
    moved: Tensor,
    v: Tensor,
    C: Tensor,
    F: Tensor,
    mass: Tensor,
    node_mass: Tensor,
    nodal_u: Tensor,
    nodal_v: Tensor,
    adj_of_nodes: Tensor,
    adj_u: Tensor,
    adj_v: Tensor,
) -> list[Tensor]:
    compile_first(model, adjoint=True)
    one = _Arrays(model)
    each, adj_node_mass = [adj_u.clone(), adj_v.clone()], torch.empty_like(node_mass)
    arguments = one.views(node_mass, nodal_u, nodal_v, *each, adj_node_mass)
    node_launch(model, one.launch, one.sums.means_adj, *arguments)
    adj_node_mass += adj_of_nodes
    found, adj_mass = one.particles(), torch.zeros_like(mass)
    arguments = one.views(mass, moved, v, C, F, *each, *found, adj_mass)
    brick_launch(model, one.launch, one.kernels.project_adj, model.constants, one.rest, *arguments)
    kernels = masses(model.spec.dim, model.spec.dtype, model.rest_grid.bricks)
    brick_launch(model, one.launch, kernels.masses_adj, one.rest, *one.views(adj_node_mass, adj_mass))
    return [*found, adj_mass]


def _anchors(model: Model, u: Tensor, normals: Tensor | None) -> Tensor:
    """Anchors of surface points that touch nothing yet: their places across the normal of each separating wall."""
    surface = model.surface
    if surface is None:
        return u.new_zeros(model.anchor_shape)
    assert isinstance(surface, SurfaceGrid)
    x, n = surface.places(u), _normals(model, normals, u)
    return x[:, None] - (x[:, None] * n[:, :, None]).sum(-1, keepdim=True) * n[:, :, None]


def _normals(model: Model, normals: Tensor | None, like: Tensor) -> Tensor:
    """Unit normals of the walls that meet surface points, shape (world, wall, dim), from those of all walls or of the scene."""
    assert isinstance(model.surface, SurfaceGrid)
    if normals is None:
        return model.surface.normals.expand(model.worlds, -1, -1).to(like.dtype)
    return of_surface_walls(model, normals).to(like.dtype)
