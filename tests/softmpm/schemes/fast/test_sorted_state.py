"""States and adjoints passed from chunk to chunk: the order of the particles may change, nothing else does."""

import numpy as np
import pytest
import torch
import warp as wp
from helpers import busy_inputs, busy_scene

import softmpm
from softmpm.errors import NEVER, Kind, decode
from softmpm.kernels.fast.sorting import sorting
from softmpm.kernels.structs import RequestedGrads
from softmpm.planning.chunks import Chunk
from softmpm.schemes.buffers import view
from softmpm.schemes.device import stream_of
from softmpm.schemes.failure_report import outgrown
from softmpm.schemes.fast.adjoint_buffers import ChunkAdjoint, SharedAdjoint
from softmpm.schemes.fast.chunk_buffers import ChunkBuffers
from softmpm.schemes.fast.particle_order import ParticleLayout
from softmpm.schemes.fast.sorted_state import SortedAdj, SortedState, Unpacker

WORLDS = 2


@pytest.fixture(params=[2, 3])
def model(request, device):
    return softmpm.build(busy_scene(request.param), device=device, worlds=WORLDS, scheme="fast")


def state_of(model) -> softmpm.State:
    """A state with low-order parts of its own."""
    inputs = busy_inputs(model)
    with torch.no_grad():
        start = softmpm.State(*(inputs[name] for name in "xvCF"))
        return softmpm.simulate(model, start, None, model.params(), substeps=2)


def buffers_in(model, seed: int, x) -> ChunkBuffers:
    """Buffers whose particles stand in an order drawn at random, another one in each world."""
    buffers = ChunkBuffers(model, ParticleLayout(model, x), Chunk(0, 1, 1), keep=True)
    generator = torch.Generator().manual_seed(seed)
    for world in range(WORLDS):
        buffers.order[world] = torch.randperm(model.particle_count, generator=generator)
    buffers.origin.copy_(buffers.layout.origin)
    buffers.reset_status()
    return buffers


def start_of(model, buffers) -> SortedState:
    return SortedState(Unpacker(model), buffers.base[0], buffers.rows[0], buffers.order)


def test_a_state_changes_hands_unchanged(model):
    """User → one order → another → user gives the same bits, low-order parts included; so does a copy of what was between."""
    state, stream = state_of(model), stream_of(model.device)
    first, second = (buffers_in(model, seed, state.x) for seed in (1, 2))
    first.load_state(stream, state)
    between = start_of(model, first)
    kept = between.copy()
    second.load_state(stream, between)
    assert not torch.equal(first.order, second.order)
    for buffer in (first.base, first.rows, first.order):
        buffer.zero_()  # used for something else
    for found in (start_of(model, second), kept):
        back = found.state()
        assert back.low is not None and state.low is not None
        for name, got, want in zip(
            "x v C F low_x low_F".split(), (*back[:4], *back.low), (*state[:4], *state.low), strict=True
        ):
            assert torch.equal(got, want), name
        assert torch.equal(found.x, state.x)
    assert all(word == NEVER for word in second.words[:WORLDS].tolist())


def test_an_adjoint_changes_hands_unchanged(model):
    """The same for adjoints, from the buffers of one chunk to those of another."""
    state, stream, wanted = (
        state_of(model),
        stream_of(model.device),
        RequestedGrads(),
    )
    generator = torch.Generator().manual_seed(0)
    adj = softmpm.State(*(torch.randn(t.shape, generator=generator).to(t) for t in state[:4]))
    stored = [buffers_in(model, seed, state.x) for seed in (1, 2)]
    first, second = (ChunkAdjoint(buffers, SharedAdjoint(buffers, wanted)) for buffers in stored)
    first.load(stream, adj)
    between = SortedAdj(Unpacker(model), first.shared.adj, stored[0].order)
    second.load(stream, between)
    assert not torch.equal(stored[0].order, stored[1].order)
    back = SortedAdj(Unpacker(model), second.shared.adj, stored[1].order).state()
    for name, got, want in zip("xvCF", back[:4], adj[:4], strict=True):
        torch.testing.assert_close(
            got, want, rtol=3e-7, atol=0, msg=name
        )  # x is multiplied by the spacing and back


def test_a_window_that_does_not_hold_what_is_handed_over_is_reported(model):
    """With the particle's number, in its own world only, and what is written stays inside the window."""
    state, stream = state_of(model), stream_of(model.device)
    first, second = (buffers_in(model, seed, state.x) for seed in (1, 2))
    first.load_state(stream, state)
    base = torch.floor(state.x[1, :, 0].double() / model.scene.grid.spacing - 0.5).int()
    second.origin[1, 0] = base.min() + 1
    second.load_state(stream, start_of(model, first))
    words = second.words[:WORLDS].tolist()
    assert words[0] == NEVER and outgrown(words)
    assert decode(words[1]) == (0, Kind.LEFT_WINDOW, int((base == base.min()).nonzero()[0]))
    moved = start_of(model, second).state().x[1, :, 0]
    assert (moved >= (second.origin[1, 0].item() + 0.4) * model.scene.grid.spacing).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_what_a_chunk_reports_of_its_order(dim, device):
    """Cells met along the order, as NumPy counts them, and whether a particle is near an edge of the window behind which the grid
    goes on.
    """
    positions = np.random.default_rng(0).uniform(20.0, 23.0, (40, dim))  # in cells of one metre
    body = softmpm.Body(softmpm.Particles(positions, 0.1), softmpm.NeoHookean(density=1.0, young=1.0))
    scene = softmpm.Scene(grid=softmpm.Grid(shape=dim * (60,), spacing=1.0), bodies=[body], dt=1e-3)
    model = softmpm.build(scene, device=device, worlds=WORLDS, scheme="fast")
    state = model.rest()
    buffers = buffers_in(model, 1, state.x)
    buffers.load_state(stream_of(model.device), state)

    def report() -> list[int]:
        found = torch.zeros(2, dtype=torch.int64, device=model.device)
        window = buffers.layout.window(buffers.origin)
        inputs = [
            model.constants,
            window,
            model.particle_count,
            buffers.packed[0].base,
            view(found, wp.int64),
        ]
        kernel = sorting(model.dim, model.spec.dtype).survey
        wp.launch(
            kernel, buffers.size.particles, inputs, device=model.wp_device, stream=stream_of(model.device)
        )
        return found.tolist()

    base = np.floor(state.x.double().cpu().numpy() - 0.5).astype(int)
    along = np.take_along_axis(base, buffers.order.cpu().numpy()[..., None].astype(int), axis=1)
    cells = int((along[:, 1:] != along[:, :-1]).any(-1).sum()) + WORLDS
    assert report() == [cells, 0]
    middle = buffers.origin[0, 0].item()
    for first in (base[0, :, 0].min() - 1, base[0, :, 0].max() + 4 - buffers.layout.shape[0]):
        buffers.origin[0, 0] = int(first)  # one node of room is left, below or above
        assert report() == [cells, 1]
    buffers.origin[0, 0] = middle
    assert report() == [cells, 0]
