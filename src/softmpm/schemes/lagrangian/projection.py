"""The kernels between nodes and the particles that show them, as differentiable functions of tensors.

Equations: kernels/lagrangian/projection.py.
"""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from softmpm.batches import FirstOrder, FirstOrderAdjoint
from softmpm.kernels.lagrangian.node_sums import node_sums
from softmpm.kernels.lagrangian.projection import masses, projection
from softmpm.kernels.lagrangian.shown import shown as shown_by
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import cleared, passing
from softmpm.schemes.device import on_its_gpu
from softmpm.schemes.lagrangian.bricks import brick_launch, empty_partial, node_launch, rest_struct
from softmpm.schemes.lagrangian.kernels import compile_first
from softmpm.schemes.launch import KernelLauncher, launcher
from softmpm.state import State


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


class Show(FirstOrder):
    """x, v, C and F of the particles (Q5), of displacement, velocity and shift of the nodes."""

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


def apart(model: Model, ours: State, theirs: State) -> Tensor:
    """Largest differences of x, v, C and F between two states, shape (4,), without a gradient."""
    return _Apart.apply(model, *ours.detach()[:4], *theirs.detach()[:4])


class _Apart(FirstOrder):
    """A function for the transforms of ``torch.func``, whose wrappers have no memory that a kernel could read."""

    @staticmethod
    def forward(model, *fields):
        return _apart(model, *fields)

    @staticmethod
    def setup_context(ctx, inputs, output):
        ctx.mark_non_differentiable(output)


@on_its_gpu
def _apart(model: Model, *given: Tensor) -> Tensor:
    one, found = _Arrays(model), torch.zeros(4, dtype=model.dtype, device=model.device)
    lead, fields = (model.worlds, model.particle_count), one.views(*given)
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


class Project(FirstOrder):
    """Mass, displacement and velocity of the nodes (Q6), of displacement, v, C, F − I and mass of the particles."""

    @staticmethod
    def forward(model, moved, v, C, H, mass):
        return tuple(_project(model, moved, v, C, H, mass))

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
def _project(model: Model, moved: Tensor, v: Tensor, C: Tensor, H: Tensor, mass: Tensor) -> list[Tensor]:
    compile_first(model)
    one = _Arrays(model)
    partials, found, node_mass = one.partials(), one.nodal(), one.node_masses(mass)
    given = one.views(mass, moved, v, C, H)
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
    H: Tensor,
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
    arguments = one.views(mass, moved, v, C, H, *each, *found, adj_mass)
    brick_launch(model, one.launch, one.kernels.project_adj, model.constants, one.rest, *arguments)
    kernels = masses(model.spec.dim, model.spec.dtype, model.rest_grid.bricks)
    brick_launch(model, one.launch, kernels.masses_adj, one.rest, *one.views(adj_node_mass, adj_mass))
    return [*found, adj_mass]
