"""Programmatic dependencies of captured graphs."""

import ctypes
from types import SimpleNamespace

import pytest
from helpers import cotangent, relative
from surface_scenes import block

import softmpm
from softmpm.kernels.fast.native import SizeClass
from softmpm.schemes import dependent_launch, launch
from softmpm.schemes.fast import launch_size
from softmpm.schemes.lagrangian import launches

KERNEL, MEMSET = 0, 2
WAITS, OTHER = 77, 78
NODES = {1: (KERNEL, OTHER), 2: (KERNEL, WAITS), 3: (KERNEL, WAITS), 4: (MEMSET, None), 5: (KERNEL, WAITS)}
"""Kind and function of each node of a graph; each depends on the one before."""


class Driver:
    """Functions on the graph above, with its dependencies as they are now."""

    arch = 90
    """For which the kernels were compiled."""

    def __init__(self):
        self.edges = {(a, a + 1): 0 for a in list(NODES)[:-1]}

    def cuGraphGetEdges_v2(self, graph, before, after, kinds, count):
        for k, ((a, b), kind) in enumerate(self.edges.items() if before else ()):
            before[k], after[k], kinds[k] = a, b, kind
        count._obj.value = len(self.edges)
        return 0

    def cuGraphRemoveDependencies_v2(self, graph, before, after, kinds, count):
        for k in range(count):
            assert self.edges.pop((before[k], after[k])) == kinds[k]
        return 0

    def cuGraphAddDependencies_v2(self, graph, before, after, kinds, count):
        self.edges |= {(before[k], after[k]): kinds[k] for k in range(count)}
        return 0

    def cuGraphNodeGetType(self, node, kind):
        kind._obj.value = NODES[node][0]
        return 0

    def cuGraphKernelNodeGetParams_v2(self, node, params):
        params._obj.function = NODES[node][1]
        return 0

    def cuFuncGetAttribute(self, value, attribute, function):
        value._obj.value = self.arch
        return 0


@pytest.fixture
def driver(monkeypatch) -> Driver:
    found = Driver()
    monkeypatch.setattr(dependent_launch, "driver", lambda: found)
    return found


GRAPH = SimpleNamespace(graph=ctypes.c_void_p(1))


def test_only_kernels_that_wait_begin_early(driver):
    """After another kernel: not the first of a graph, not one that does not wait, not one after a node of another kind."""
    assert dependent_launch.begin_early(GRAPH, {WAITS}) == 2
    assert driver.edges == {(1, 2): 0x10001, (2, 3): 0x10001, (3, 4): 0, (4, 5): 0}
    assert dependent_launch.begin_early(GRAPH, {WAITS}) == 0  # they do already


@pytest.mark.parametrize(
    "arch, waiting, lacking",
    [(80, {WAITS}, None), (90, set(), None), (90, {1}, None), (90, {WAITS}, "cuGraphGetEdges_v2")],
)
def test_a_graph_stays_as_it_is(driver, monkeypatch, arch, waiting, lacking):
    """With kernels that were compiled for an older device, without kernels that wait, or with a driver that lacks a function."""
    driver.arch = arch
    if lacking:
        monkeypatch.delattr(Driver, lacking)
    before = dict(driver.edges)
    assert dependent_launch.begin_early(GRAPH, waiting) == 0 and driver.edges == before


def test_an_error_of_the_driver_is_named(driver, monkeypatch):
    monkeypatch.setattr(Driver, "cuGraphAddDependencies_v2", lambda *_: 1)
    with pytest.raises(RuntimeError, match="programmatic dependencies.*error 1"):
        dependent_launch.begin_early(GRAPH, {WAITS})


FORMS = {
    "moving, nodes": dict(formulation="moving", contact="nodes", deterministic=True),
    "moving, points": dict(formulation="moving", contact="surface"),
    "reference, points": dict(formulation="reference", contact="surface"),
}


@pytest.mark.gpu
@pytest.mark.parametrize(
    "form, size_class",
    [
        *((form, None) for form in FORMS),
        *(
            (form, one)
            for form in ("moving, nodes", "moving, points")
            for one in (SizeClass.SOME, SizeClass.MANY)
        ),
    ],
)
def test_results_are_those_of_kernels_that_follow_one_another(form, size_class, monkeypatch):
    """State and gradients, of kernels that begin early and of kernels that do not: the same bits where sums have a fixed order, else
    the same up to rounding. Three calls each, so that buffers hold what was there before. Also with the kernels for more particles."""
    if size_class is not None:
        monkeypatch.setattr(launch_size, "size_class_of", lambda particles: size_class)
    monkeypatch.setattr(launches, "cluster_of", lambda model: None)  # else one kernel has many substeps
    changed, found = [], []
    real = dependent_launch.begin_early

    def counted(graph, waiting) -> int:
        changed.append(real(graph, waiting))
        return changed[-1]

    for begin in (counted, lambda *_: 0):
        monkeypatch.setattr(launch, "begin_early", begin)
        alarms = softmpm.Alarms(collapse=None, depth=None)
        model = softmpm.build(block(2), device="cuda", alarms=alarms, **FORMS[form])
        for k in range(3):
            params = softmpm.Params(*(value.clone().requires_grad_() for value in model.params()))
            start = model.rest()
            start.v.add_(0.01 * k)
            end = softmpm.simulate(model, start, None, params, substeps=60)
            weights = cotangent(end)
            sum((got * weight).sum() for got, weight in zip(end[:4], weights[:4], strict=True)).backward()
        found.append([*end[:4], *(value.grad for value in params)])
    assert len(changed) >= 2 and min(changed) > 100
    for early, late in zip(*found, strict=True):
        assert relative(early, late) <= (1e-4 if form == "moving, points" else 0.0)
