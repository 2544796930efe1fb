"""Quantities of a state: centre of mass, momentum, strain, energies. Differentiable in the state and in the material.

Sums are taken in float64, with the low-order parts of float32 (``State.low``), and returned in the precision of the model.
"""

import itertools
from collections.abc import Iterator

import torch
from torch import Tensor

from softmpm.check_state import check_state
from softmpm.checks import check_broadcasts, check_params, check_tensor
from softmpm.energy_density import DENSITIES
from softmpm.model import Model, check_model
from softmpm.oracle.stress import lame
from softmpm.rest_grid import nodes_around
from softmpm.schemes.lagrangian.nodal import check_their_nodes
from softmpm.state import Params, State
from softmpm.validate import need


def displacement(model: Model, state: State) -> Tensor:
    """Displacement x − X of each particle from its rest position [m], shape (world, particle, dim).

    In float32 it has the digits that a difference of positions has lost: those of the low-order parts.
    """
    _check(model, state, "displacement")
    moved = _exact(state.x, None if state.low is None else state.low.x) - model.positions.double()
    moved = moved if state.low is None else moved - model.rest_low.double()
    return moved.to(model.dtype)


def body_mean(model: Model, field: Tensor, weight: Tensor | None = None) -> Tensor:
    """Mean of a field of the particles over each body.

    Args:
        model: From :func:`softmpm.build`.
        field: One value, vector or matrix for each particle, shape (world, particle, ...). Differentiable.
        weight: Weight of each particle, shapes that broadcast to (world, particle); None takes the volumes at rest. The weights
            ``params.density * model.volume`` make it the mean by mass. Differentiable.

    Returns:
        Means in the unit of the field, shape (world, body, ...), bodies in the order of the scene.
    """
    check_model(model, "body_mean")
    check_tensor(model, "field", field)
    lead = (model.worlds, model.particle_count)
    need(
        field.shape[:2] == lead,
        f"field must have shape (world, particle, ...) = ({lead[0]}, {lead[1]}, ...), got {tuple(field.shape)}.",
    )
    weight = model.volume if weight is None else weight
    check_tensor(model, "weight", weight)
    check_broadcasts("weight", weight, "particle", lead)
    return _mean(model, field.double(), weight.double().expand(lead), per_body=True)


def center_of_mass(model: Model, state: State, params: Params, *, per_body: bool = False) -> Tensor:
    """Centre of mass [m].

    Args:
        model: From :func:`softmpm.build`.
        state: Differentiable.
        params: Their densities weigh the particles. Differentiable.
        per_body: Whether to return that of each body.

    Returns:
        Shape (world, dim), or (world, body, dim) with ``per_body``.
    """
    mass = _masses(model, state, params, "center_of_mass")
    return _mean(model, _exact(state.x, None if state.low is None else state.low.x), mass, per_body)


def mean_velocity(model: Model, state: State, params: Params, *, per_body: bool = False) -> Tensor:
    """Velocity of the centre of mass [m/s], the mean by mass; arguments and shape as of :func:`center_of_mass`.

    Like all velocities of a state it is half a substep older than the positions.
    """
    return _mean(model, state.v.double(), _masses(model, state, params, "mean_velocity"), per_body)


def momentum(model: Model, state: State, params: Params, *, per_body: bool = False) -> Tensor:
    """Linear momentum [kg m/s], in 2D per metre of depth; arguments and shape as of :func:`center_of_mass`."""
    mass = _masses(model, state, params, "momentum")
    return _total(model, mass[..., None] * state.v.double(), per_body)


def green_strain(state: State) -> Tensor:
    """Green strain E = (FᵀF − I)/2 of each particle [-], shape (world, particle, dim, dim), from H = F − I without cancellation."""
    return _green_strain(state).to(state.F.dtype)


def von_mises_strain(state: State) -> Tensor:
    """Equivalent strain √(2/3 E':E') of each particle [-], shape (world, particle), with the deviator E' of the Green strain.

    In plane strain E has a third row and column of zeros. A small uniaxial strain ε without a change of volume has the value ε. The
    derivative where E' = 0, which does not exist, is taken as zero.
    """
    E = _green_strain(state)
    normal = E.diagonal(dim1=-2, dim2=-1)
    shear = E - torch.diag_embed(normal)
    normal = torch.nn.functional.pad(normal, (0, 3 - E.shape[-1]))
    apart = normal - normal.roll(1, -1)  # E:E minus the square of the trace would cancel
    square = 2 / 3 * ((shear**2).sum((-2, -1)) + (apart**2).sum(-1) / 3)
    positive = square > 0
    return torch.where(positive, torch.where(positive, square, 1.0).sqrt(), 0.0).to(state.F.dtype)


def kinetic_energy(model: Model, state: State, params: Params, *, per_body: bool = False) -> Tensor:
    """Kinetic energy [J], in 2D per metre of depth.

    A particle of the moving formulation has m/2 (|v|² + dx²/4 |C|²), since it carries the affine velocity field of its surroundings
    (Jiang et al. 2015). In the reference formulation it is that of the nodes, Σ m_i |v_i|²/2, for a state that has them.

    Velocities of a state are half a substep older than its positions. Hence the sum of kinetic and elastic energy of a free body swings
    by a part of the order of its frequency times dt. The mean of this energy before and after a substep, in place of the one before,
    leaves an error of second order in the reference formulation; the transfers of the moving grid damp in addition.

    Args:
        model: From :func:`softmpm.build`.
        state: Differentiable, through ``state.nodes`` if there are any, which its particles then must show.
        params: Their densities weigh the particles. Differentiable.
        per_body: Whether to return that of each body.

    Returns:
        Shape (world,), or (world, body) with ``per_body``.
    """
    mass = _masses(model, state, params, "kinetic_energy")
    if state.nodes is not None:
        check_their_nodes(model, state)
    if state.nodes is None:
        quarter = model.scene.grid.spacing**2 / 4
        square = (state.v.double() ** 2).sum(-1) + quarter * (state.C.double() ** 2).sum((-2, -1))
    else:
        square = torch.zeros_like(mass)
        speed = (state.nodes.v.double() ** 2).sum(-1)
        places = model.positions.double() + model.rest_low.double()
        for node, weight in nodes_around(model.rest_grid, places, model.scene.grid):
            square = square + weight * speed[:, node]
    return _total(model, mass / 2 * square, per_body)


def elastic_energy(model: Model, state: State, params: Params, *, per_body: bool = False) -> Tensor:
    """Elastic energy [J], in 2D per metre of depth: the integral of (E7) to (E10) over the volume at rest.

    The work of actuators and viscosity is not part of it. In the reference formulation it is taken from F, whose rounding in float32
    shows at strains below 1e-5; take float64 there.

    Args:
        model: From :func:`softmpm.build`.
        state: Differentiable, through F.
        params: ``young`` and ``poisson`` of each particle. Differentiable.
        per_body: Whether to return that of each body.

    Returns:
        Shape (world,), or (world, body) with ``per_body``. Neo-Hookean bodies have NaN where det F < 0.
    """
    _check(model, state, "elastic_energy")
    check_params(model, params)
    lead = (model.worlds, model.particle_count)
    H = _displacement_gradient(state)
    constants = lame(params.young.double(), params.poisson.double())
    mu, lam = (constant.expand(lead) for constant in constants)
    density = [DENSITIES[law](H[:, part], mu[:, part], lam[:, part]) for law, part in _laws(model)]
    return _total(model, model.volume.double() * torch.cat(density, 1), per_body)


def gravitational_energy(
    model: Model, state: State, params: Params, gravity: Tensor | None = None, *, per_body: bool = False
) -> Tensor:
    """Potential energy −Σ m g·x in the field of gravity [J], in 2D per metre of depth; zero at the origin of the grid.

    Args:
        model: From :func:`softmpm.build`.
        state: Differentiable.
        params: Their densities weigh the particles. Differentiable.
        gravity: g [m/s²] of the call, as in :class:`softmpm.Inputs`, shapes that broadcast to (world, dim); None takes the scene's.
            Differentiable.
        per_body: Whether to return that of each body.

    Returns:
        Shape (world,), or (world, body) with ``per_body``.
    """
    mass = _masses(model, state, params, "gravitational_energy")
    x = _exact(state.x, None if state.low is None else state.low.x)
    if gravity is None:  # numbers, since a tensor of them could not be made while a graph is captured
        height = sum(g * x[..., axis] for axis, g in enumerate(model.scene.gravity or ()))
    else:
        check_tensor(model, "gravity", gravity)
        check_broadcasts("gravity", gravity, "dim", (model.worlds, model.dim))
        height = (gravity.double().expand(model.worlds, model.dim)[:, None] * x).sum(-1)
    return _total(model, -mass * height, per_body)


def _check(model: Model, state: State, wants: str) -> None:
    check_model(model, wants)
    check_state(model, state)


def _masses(model: Model, state: State, params: Params, wants: str) -> Tensor:
    """Mass of each particle [kg], shape (world, particle), float64, after the arguments are checked."""
    _check(model, state, wants)
    check_params(model, params)
    return (params.density.double() * model.volume.double()).expand(model.worlds, model.particle_count)


def _exact(high: Tensor, low: Tensor | None) -> Tensor:
    return high.double() if low is None else high.double() + low.double()


def _displacement_gradient(state: State) -> Tensor:
    """H = F − I in float64."""
    eye = torch.eye(state.F.shape[-1], dtype=torch.float64, device=state.F.device)
    H = state.F.double() - eye
    return H if state.low is None else H + state.low.F.double()


def _green_strain(state: State) -> Tensor:
    if not isinstance(state, State):
        raise TypeError(f"state must be a softmpm.State, got {type(state).__name__}.")
    H = _displacement_gradient(state)
    # HᵀH, for which a GPU takes long as a product of many small matrices
    square = (H.unsqueeze(-1) * H.unsqueeze(-2)).sum(-3)
    return (H + H.mT + square) / 2


def _laws(model: Model) -> Iterator[tuple[type, slice]]:
    """Laws of consecutive bodies, each with the range of their particles."""
    first = 0
    for law, bodies in itertools.groupby(model.scene.bodies, lambda body: type(body.material)):
        count = sum(len(body.particles) for body in bodies)
        yield law, slice(first, first + count)
        first += count


def _sum(model: Model, values: Tensor, per_body: bool) -> Tensor:
    """Sum over the particles, shape (world, ...), or over those of each body, shape (world, body, ...)."""
    if not per_body:
        return values.sum(1)
    sizes = [len(body.particles) for body in model.scene.bodies]
    return torch.stack([part.sum(1) for part in values.split(sizes, 1)], 1)


def _total(model: Model, values: Tensor, per_body: bool) -> Tensor:
    return _sum(model, values, per_body).to(model.dtype)


def _mean(model: Model, values: Tensor, weight: Tensor, per_body: bool) -> Tensor:
    weight = weight.reshape(*weight.shape, *(1,) * (values.ndim - 2))
    return (_sum(model, weight * values, per_body) / _sum(model, weight, per_body)).to(model.dtype)
