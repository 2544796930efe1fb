"""Alarms on a state in the user's order: before the first substep of a call, and after a chunk of the plain scheme."""

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import NEVER
from softmpm.inputs import stored
from softmpm.kernels.compile import launch
from softmpm.kernels.plain.alarms import state_alarms
from softmpm.kernels.structs import element_type, types
from softmpm.model import Model
from softmpm.schemes.buffers import placeholder, placeholders_in, view
from softmpm.schemes.device import stream_of
from softmpm.schemes.inputs import Values, particle_struct, shape_of, stiffest
from softmpm.schemes.launch import RebindableLaunch
from softmpm.state import State


def armed(model: Model) -> bool:
    """True if a model has alarms that are checked between chunks."""
    return model.neighbours.shape[1] > 0 or model.alarms.step is not None


class StartCheck:
    """Checks the initial states of calls: det F, neighbours at rest and the step limit, with the inputs of the call.

    Attributes:
        words: Status words, one for each world.
    """

    def __init__(self, model: Model):
        self.model, t = model, types(model.spec.dim, model.spec.dtype)
        self.words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        inputs = particle_struct(model, model.fixed)
        places = [placeholder(model, t.vec), placeholder(model, t.mat)]
        self._open = [
            one for one in stored(model.spec) if one.stage != "grid" and one.name not in model.fixed
        ]
        given = []
        for one in self._open:
            shape = shape_of(model, one, 1)[1 if one.rows else 0 :]
            size = shape[:-1] if one.kind == "vector" else shape
            given += placeholders_in(inputs, (one.name,), model, element_type(model.spec, one), *size)
        neighbours, words = view(model.neighbours, wp.int32), view(self.words, wp.int64)
        arguments = (model.constants, inputs, neighbours, -1, *places, words)
        lead = (model.worlds, model.particle_count)
        self._check = RebindableLaunch(model, state_alarms(model.spec), lead, arguments, [*given, *places])

    def __call__(self, start: State, values: Values) -> Tensor:
        """Launch the check and return its status words. It uses the stiffest active stress of each actuator."""
        self.words.fill_(NEVER)
        values = stiffest(self.model, values)
        given = [(values[one.name][0] if one.rows else values[one.name]).contiguous() for one in self._open]
        self._check(stream_of(self.model.device), *given, start.x.contiguous(), start.F.contiguous())
        return self.words


def check_end(model: Model, inputs, end: State, words: wp.array, substep: int) -> None:
    """Launch the check of a state after ``substep`` with the struct of the particles' inputs."""
    t = types(model.spec.dim, model.spec.dtype)
    x, F = view(end.x, t.vec), view(end.F, t.mat)
    arguments = (model.constants, inputs, view(model.neighbours, wp.int32), substep, x, F, words)
    lead, stream = (model.worlds, model.particle_count), stream_of(model.device)
    launch(state_alarms(model.spec), lead, arguments, device=model.wp_device, stream=stream)
