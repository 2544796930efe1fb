"""Peak memory of a gradient, measured, against the formula of docs/memory.md."""

import gc

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

import softmpm
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import memory

WORLDS, SUBSTEPS = 16, 150
FLOOR = softmpm.Wall(normal=(0.0, 1.0, 0.0), offset=0.3, friction=0.4)
CLAMP = softmpm.Wall(normal=(-1.0, 0.0, 0.0), offset=-0.7, contact="clamp")
SCENES = {
    "elastic": dict(),
    "surface contact": dict(walls=[FLOOR]),
    "clamp and surface contact": dict(walls=[FLOOR, CLAMP]),
}


def peak_bytes(work, device: str) -> int:
    """Most bytes that ``work`` allocates at a time through PyTorch."""
    gc.collect()  # memory of earlier tests that is freed meanwhile would count as negative
    if device == "cuda":
        torch.cuda.synchronize()
        before = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        work()
        return torch.cuda.max_memory_allocated() - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        work()
    changes, nodes = [], record.profiler.kineto_results.experimental_event_tree()
    while nodes:
        node = nodes.pop()
        nodes += node.children
        if hasattr(node.extra_fields, "alloc_size"):
            changes.append((node.start_time_ns, node.extra_fields.alloc_size))
    held = peak = 0
    for _, change in sorted(changes):
        held += change
        peak = max(peak, held)
    return peak


@pytest.mark.parametrize("budget", [2**32, 8 * 2**20])
@pytest.mark.parametrize("what", SCENES)
def test_a_gradient_takes_the_memory_that_is_stated(what, budget, device):
    """Of many small worlds, where what each chunk holds beside its states counts."""
    shape = softmpm.box((0.3, 0.3, 0.3), (0.7, 0.5, 0.7), spacing=0.05)
    body = softmpm.Body(shape, softmpm.NeoHookean(density=1.0, young=100.0, poisson=0.3, viscosity=0.02))
    grid = softmpm.Grid(shape=(10, 10, 10), spacing=0.1)
    forces = dict(gravity=(0.0, -0.1, 0.0), damping=0.7)
    scene = softmpm.Scene(grid=grid, bodies=[body], dt=1e-3, **forces, **SCENES[what])
    settings = dict(device=device, formulation="reference", worlds=WORLDS, memory_budget=budget)
    model, other = softmpm.build(scene, **settings), softmpm.build(scene, **settings)
    start = softmpm.simulate(other, other.rest(), None, other.params(), substeps=1)  # with nodes
    assert start.nodes is not None
    velocity = start.nodes.v.requires_grad_()

    def work():
        end = softmpm.simulate(model, start, None, model.params(), substeps=SUBSTEPS)
        torch.autograd.grad(end.x.sum(), velocity)

    stated = memory(model, Horizon(1, SUBSTEPS)).backward
    # The initial state, which is counted, exists before.
    assert 0.9 * stated < peak_bytes(work, device) < 1.05 * stated
