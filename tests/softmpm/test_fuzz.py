"""A short round of random scenes and calls; bench/fuzz.py runs thousands."""

import json

import pytest
from fuzzing.calls import simulations
from fuzzing.judge import judge
from fuzzing.legal import judged
from fuzzing.warp_way import steps
from fuzzing.worker import Worker
from hypothesis import HealthCheck, given, settings

short = settings(
    max_examples=100,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)


@short
@given(plan=simulations)
def test_a_call_is_right_or_refused_by_name(plan):
    """Whatever the scene, the start, the material and the call: finite and right, or an error that names what was wrong."""
    verdict = judge(json.loads(json.dumps(plan)))
    assert verdict.good, verdict


@pytest.mark.parametrize("seed", range(12))
def test_a_sensible_scene_runs(seed):
    """At 0.95 of the stable step, with no more energy than it had and was given."""
    verdict = judged(seed)
    assert verdict.good, verdict


@pytest.fixture(scope="module")
def worker():
    """A crash would end the tests."""
    worker = Worker()
    yield worker
    worker.stop()


@short
@given(plan=steps)
def test_the_warp_way_in_is_right_or_refused_by_name(worker, plan):
    """``step`` is ``simulate`` to the last bit, and refuses arrays, tensors and models that do not belong together."""
    verdict = worker.judge(json.loads(json.dumps(plan)))
    assert verdict.good, verdict
