"""One kernel for all substeps of a control step gives what one launch after the other gives."""

import pytest
import torch
from helpers import busy_inputs, cotangent, dot, given
from surface_scenes import block, build

import softmpm
from softmpm.kernels.lagrangian.cluster import Cluster
from softmpm.schemes.lagrangian import launches

NAMES = {"lattice": ("friction",), "particles": ("friction", "force")}
"""Inputs: with forces of their own, particles are taken one by one."""


@pytest.mark.parametrize("kind", NAMES)
def test_the_same_as_single_launches(kind, device, monkeypatch):
    """Three control steps, of which the second begins inside a chunk; contact, a muscle, two worlds. The single kernel repeats its own
    bits, or its stages race. On a CPU they are those of single launches; on a GPU the forms agree to rounding."""
    made, found = block(2), []
    body = softmpm.Body(softmpm.box((0.3, 0.3), (0.5, 0.5), spacing=0.05), made.bodies[0].material)
    for persistent in (False, True, True):
        model = build(
            block(2, bodies=[body]), device=device, dtype=torch.float64, worlds=2, inputs=NAMES[kind]
        )
        assert model.rest_grid.bricks.lattice == (kind == "lattice")
        if not persistent:
            monkeypatch.setattr(launches, "cluster_of", lambda model: None)
        elif model.device.type == "cpu":  # where it is only used here
            monkeypatch.setattr(launches, "cluster_of", lambda model: Cluster(model.rest_grid.bricks, 1, 1))
        else:
            monkeypatch.undo()
            assert launches.cluster_of(model) is not None
        leaves = busy_inputs(model, control_steps=3) | given(model, NAMES[kind], 3)
        start = softmpm.State(*(leaves[name] for name in "xvCF"))
        params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))
        inputs = softmpm.Inputs(**{name: leaves[name] for name in NAMES[kind]})
        end = softmpm.simulate(model, start, leaves["activation"], params, substeps=10, inputs=inputs)
        assert end.nodes is not None and end.nodes.force.abs().max() > 0
        gradients = torch.autograd.grad(dot(cotangent(end), end), list(leaves.values()))
        found.append([*end[:4], *end.nodes, *gradients])
    for one, other, again in zip(*found, strict=True):
        assert torch.equal(other, again)
        if torch.device(device).type == "cpu":
            assert torch.equal(one, other)
        else:
            size = one.double().nan_to_num(0.0, 0.0, 0.0).norm()
            torch.testing.assert_close(other, one, rtol=0.0, atol=1e-12 * size.item())
