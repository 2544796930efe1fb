"""Nodes that driven particles hold. Derivation: docs/math/lagrangian.md.

v'_i = V_i,   u'_i = u_i + Δt V_i                                                              (Q10)
V_i = Σ_p a_ip V_p                                                                             (Q11)
V̄_i += v̄'_i + Δt ū'_i,   then v̄'_i + Δt ū'_i = 0                                              (Q10.adj)
V̄_p = Σ_i a_ip V̄_i                                                                             (Q11.adj)
"""

from types import SimpleNamespace

import warp as wp

from softmpm.kernels.compile import kernel, kernel_factory
from softmpm.kernels.lagrangian.frame import frame
from softmpm.kernels.lagrangian.rest import LAGRANGIAN
from softmpm.kernels.physics import status
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def driven(spec: Spec) -> SimpleNamespace:
    t, f, GridInputs = types(spec.dim, spec.dtype), frame(spec.dim, spec.dtype), input_types(spec).GridInputs
    vec, Constants, Frame, recentring = t.vec, t.Constants, f.Frame, f.recentring
    running = status.report(spec.dim, spec.dtype).running

    @kernel(LAGRANGIAN)
    def drive(
        # Parameters:
        constants: Constants,
        inputs: GridInputs,
        body: Frame,
        nodes: wp.array(dtype=wp.int32),
        words: wp.array(dtype=wp.int64),
        # In:
        u: wp.array2d(dtype=vec),
        # Out:
        new_u: wp.array2d(dtype=vec),
        new_v: wp.array2d(dtype=vec),
    ):
        """(Q10)"""
        world, k = wp.tid()
        i = nodes[k]
        if running(words, world):
            given = inputs.driven_velocity[world, k]
            new_u[world, i] = (u[world, i] - recentring(body, u[world, body.middle])) + constants.dt * given
            new_v[world, i] = given

    return SimpleNamespace(drive=drive)


@kernel_factory
def driven_adj(spec: Spec, wanted: RequestedGrads) -> SimpleNamespace:
    t, GridInputsAdj = types(spec.dim, spec.dtype), input_adj_types(spec, wanted).GridInputsAdj
    real, vec = t.real, t.vec

    @kernel(LAGRANGIAN)
    def drive_adj(
        # Parameters:
        nodes: wp.array(dtype=wp.int32),
        moved: real,  # Δt if v' moved the nodes and (Q4.adj) is still to come, else 0
        # In:
        adj_u: wp.array2d(dtype=vec),
        # In and out:
        adj_v: wp.array2d(dtype=vec),
        # Out, added into:
        adj_inputs: GridInputsAdj,
    ):
        """(Q10.adj), less the Δt ū' that (Q4.adj) adds."""
        world, k = wp.tid()
        i = nodes[k]
        share = moved * adj_u[world, i]
        if wp.static("velocity" in wanted):
            total = adj_v[world, i] + share
            adj_inputs.driven_velocity[world, k] = adj_inputs.driven_velocity[world, k] + total
        adj_v[world, i] = -share

    return SimpleNamespace(drive_adj=drive_adj)


@kernel_factory
def spread(dim: int, dtype: str) -> wp.Kernel:
    vec, exact_vec, exact = types(dim, dtype).vec, types(dim, "float64").vec, frame(dim, dtype).exact

    @kernel(LAGRANGIAN)
    def spread(
        # Parameters:
        first: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.int32),
        value: wp.array(dtype=wp.float64),
        # In:
        given: wp.array2d(dtype=vec),
        # Out:
        out: wp.array2d(dtype=vec),
    ):
        """Product of a sparse matrix with vectors, in a fixed order and in float64, so that a common velocity stays the same (Q11)."""
        lead, row = wp.tid()
        total = exact_vec()
        for entry in range(first[row], first[row + 1]):
            total += value[entry] * exact(given[lead, column[entry]])
        out[lead, row] = vec(total)

    return spread
