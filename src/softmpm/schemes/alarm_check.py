"""Alarms of a state in the user's order: before the first substep of a call, and after a chunk of the plain scheme."""

import torch
import warp as wp
from torch import Tensor

from softmpm.errors import NEVER
from softmpm.kernels.compile import launch
from softmpm.kernels.plain.alarms import state_alarms
from softmpm.kernels.structs import types
from softmpm.model import Model
from softmpm.schemes.buffers import Solid, slot, slots_in, view
from softmpm.schemes.device import stream_of
from softmpm.schemes.launch import RebindableLaunch
from softmpm.state import State


def armed(model: Model) -> bool:
    """True if a model has alarms that are checked between chunks."""
    return model.neighbours.shape[1] > 0 or model.alarms.step is not None


class StartCheck:
    """Checks the starts of calls: det F, neighbours at rest and the step limit, with the material and the pull of the call.

    Attributes:
        words: What the kernel reported, one word for each world.
    """

    def __init__(self, model: Model):
        self.model, t = model, types(model.spec.dim, model.spec.dtype)
        self.words = torch.full((model.worlds,), NEVER, dtype=torch.int64, device=model.device)
        solid, places = Solid.fixed(model), [slot(model, t.vec), slot(model, t.mat)]
        slots = slots_in(solid, ("mass", "mu", "lam"), model, t.real)
        if model.muscle_count:
            slots += slots_in(solid, ("pull",), model, t.real, model.worlds, model.muscle_count)
        neighbours, words = view(model.neighbours, wp.int32), view(self.words, wp.int64)
        inputs = (model.constants, solid, neighbours, -1, *places, words)
        lead = (model.worlds, model.particle_count)
        self._check = RebindableLaunch(model, state_alarms(model.spec), lead, inputs, [*slots, *places])

    def __call__(self, start: State, pull: Tensor | None, solid: Solid) -> Tensor:
        """The words, after the check has been launched.

        Args:
            pull: Activation times strength [Pa], shape (control_step, world, muscle): the largest of each muscle counts.
        """
        self.words.fill_(NEVER)
        given = [solid.mass, solid.mu, solid.lam]
        if pull is not None:
            given.append(pull[0].contiguous() if len(pull) == 1 else pull.amax(0))
        self._check(stream_of(self.model.device), *given, start.x.contiguous(), start.F.contiguous())
        return self.words


def check_end(model: Model, solid, end: State, words: wp.array, substep: int) -> None:
    """Launch the check of a state after ``substep``, with the struct of the material that drove it."""
    t = types(model.spec.dim, model.spec.dtype)
    x, F, neighbours = view(end.x, t.vec), view(end.F, t.mat), view(model.neighbours, wp.int32)
    inputs = (model.constants, solid, neighbours, substep, x, F, words)
    lead, stream = (model.worlds, model.particle_count), stream_of(model.device)
    launch(state_alarms(model.spec), lead, inputs, device=model.wp_device, stream=stream)
