"""A wall that holds the nodes inside it: v' = 0                                                      (C1)"""

import warp as wp

from softmpm.kernels.compile import kernel_factory
from softmpm.kernels.physics.contacts import contact_adj_type
from softmpm.kernels.structs import RequestedGrads, Spec, input_adj_types, input_types, types


@kernel_factory
def response(spec: Spec, k: int) -> wp.Function:
    vec, GridInputs = types(spec.dim, spec.dtype).vec, input_types(spec).GridInputs

    @wp.func
    def respond(inputs: GridInputs, world: int, n: vec, v: vec) -> vec:
        return vec()  # (C1)

    return respond


@kernel_factory
def response_adj(spec: Spec, wanted: RequestedGrads, k: int) -> wp.Function:
    vec, ContactAdj = types(spec.dim, spec.dtype).vec, contact_adj_type(spec.dim, spec.dtype)
    GridInputs, GridInputsAdj = input_types(spec).GridInputs, input_adj_types(spec, wanted).GridInputsAdj

    @wp.func
    def respond_adj(
        inputs: GridInputs, world: int, n: vec, v: vec, adj: vec, i: int, adj_inputs: GridInputsAdj
    ) -> ContactAdj:
        return ContactAdj()

    return respond_adj
