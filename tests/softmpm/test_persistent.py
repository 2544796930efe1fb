"""One kernel for all substeps of a control step gives what one launch after the other gives."""

import pytest
import torch
from helpers import busy_inputs, cotangent, dot, given
from surface_scenes import block, build

import softmpm
from softmpm.kernels.lagrangian.cluster import Cluster
from softmpm.schemes.lagrangian import launches
from softmpm.schemes.lagrangian.persistent import cluster_of

NAMES = {"lattice": ("friction",), "particles": ("friction", "force"), "undamped": ("friction",)}
"""Inputs: with forces of their own, particles are taken one by one."""
UNDAMPED = dict(damping=0.0, walls=[softmpm.Wall(normal=(0.1, 1.0), offset=0.36, friction=0.4)])
"""With these a gradient stores some velocities only of nodes that surface points act on (kernels/lagrangian/record.py)."""


@pytest.mark.parametrize("kind", NAMES)
def test_the_same_as_single_launches(kind, device, monkeypatch):
    """Three control steps, of which the second begins inside a chunk; contact, a muscle, two worlds. The single kernel repeats its own
    bits, or its stages race. On a CPU they are those of single launches; on a GPU the forms agree to rounding, also that whose threads
    may have several bricks, nodes and points."""
    made, found, remainders = block(2), [], []
    body = softmpm.Body(softmpm.box((0.325, 0.325), (0.525, 0.525), spacing=0.05), made.bodies[0].material)
    on_cpu = torch.device(device).type == "cpu"
    for form in ("launches", "kernel", "kernel", *([] if on_cpu else ["loops"])):
        scene = block(2, bodies=[body], **(UNDAMPED if kind == "undamped" else {}))
        model = build(scene, device=device, dtype=torch.float64, worlds=2, inputs=NAMES[kind])
        assert model.rest_grid.bricks.lattice == (kind != "particles")
        cluster = Cluster(model.rest_grid.bricks, 1, 1) if on_cpu else cluster_of(model)
        assert cluster is not None and cluster.alone != on_cpu
        if form != "kernel":
            cluster = None if form == "launches" else cluster._replace(alone=False)
        monkeypatch.setattr(launches, "cluster_of", lambda model, cluster=cluster: cluster)
        leaves = busy_inputs(model, control_steps=3) | given(model, NAMES[kind], 3)
        start = softmpm.State(*(leaves[name] for name in "xvCF"))
        params = softmpm.Params(*(leaves[name] for name in softmpm.Params._fields))
        inputs = softmpm.Inputs(**{name: leaves[name] for name in NAMES[kind]})
        end = softmpm.simulate(model, start, leaves["activation"], params, substeps=10, inputs=inputs)
        assert end.nodes is not None and end.nodes.force.abs().max() > 0
        gradients = torch.autograd.grad(dot(cotangent(end), end), list(leaves.values()))
        found.append([*end[:4], *end.nodes[:-1], *gradients])
        remainders.append(end.nodes.low)  # the last field
    assert torch.equal(remainders[1], remainders[2])
    if on_cpu:  # on a GPU the forms differ in rounding
        assert torch.equal(remainders[0], remainders[1])
    for one, other, again, *others in zip(*found, strict=True):
        assert torch.equal(other, again)
        if on_cpu:
            assert torch.equal(one, other)
        for each in (other, *others):
            size = one.double().nan_to_num(0.0, 0.0, 0.0).norm()
            torch.testing.assert_close(each, one, rtol=0.0, atol=1e-12 * size.item())
