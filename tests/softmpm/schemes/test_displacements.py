"""A gradient of the reference formulation stores velocities, and computes the displacements from them with the same bits."""

import pytest
import torch
from surface_scenes import block, build

import softmpm
from softmpm.kernel_inputs import derive
from softmpm.kernels.structs import RequestedGrads
from softmpm.planning.chunks import Chunk, Horizon
from softmpm.schemes.inputs import InputsAdj
from softmpm.schemes.lagrangian import launches
from softmpm.schemes.lagrangian.nodal import start_of
from softmpm.schemes.lagrangian.scheme import Lagrangian

LENGTH = 40


def thrown(model: softmpm.Model) -> softmpm.Nodal:
    """A body that turns, pulses, and flies so fast that its world is translated several times, in each world another way."""
    state = model.rest()
    x = state.x - state.x.mean(1, keepdim=True)
    state.C[..., 0, 1], state.C[..., 1, 0], state.C[..., 1, 1] = 2.0, -2.0, 1.0
    state.v[:] = (state.C @ x[..., None])[..., 0]
    state.v[..., 0] += torch.tensor([[9.0], [-4.0]]).to(state.v)
    state.v[..., 1] -= 0.5
    start = start_of(model, state, model.mass.expand(2, -1))
    low = 1e-9 * torch.arange(start.u.numel() * 2).view(2, 2, *start.u.shape[1:]).sin()
    return start._replace(low=low.to(start.u))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", ["floor", "free", "launches"])
def test_they_have_the_bits_of_substeps_that_run_one_by_one(kind, dim, dtype, device, monkeypatch):
    """With contact, friction, damping, two translated worlds, and remainders of rounding at the start; without walls; and on a GPU also
    where single launches take the place of one kernel for a control step."""
    floor = softmpm.Wall(normal=(0.0, 1.0, 0.0)[:dim], offset=0.29, friction=0.2)
    if kind == "launches":
        monkeypatch.setattr(launches, "cluster_of", lambda model: None)
    made = block(dim, walls=[] if kind == "free" else [floor], muscles=[], dt=2e-3)
    model = build(made, device=device, dtype=dtype, worlds=2)
    start, scheme = thrown(model), Lagrangian.of(model)
    values = derive(model, model.rest(), None, model.params(), {}, Horizon(1, LENGTH))
    state, want = start, []
    for s in range(LENGTH):
        want.append(state.u)
        state = scheme.run(Chunk(s, 1, LENGTH), state, values, keep=False).end
    assert (state.shift[0] - state.shift[1]).abs().max() > 0.5
    assert kind == "free" or state.force.abs().max() > 0
    whole, wanted = scheme.run(Chunk(0, LENGTH, LENGTH), start, values, keep=True), RequestedGrads()
    assert whole._lease.cached.graph.buffers.u.shape[0] == 2
    adj = softmpm.Nodal(*(torch.zeros_like(one) for one in state[:4]), low=None)
    whole.vjp(adj, InputsAdj(model, wanted, 1), wanted)
    found = whole.pool.adjoint(whole._lease.cached, wanted).buffers.u
    assert torch.equal(found, torch.stack(want))
