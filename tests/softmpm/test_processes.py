"""A failure crosses the border of a process, as sweeps need it to."""

import copy
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor

import pytest
import torch
from helpers import thrown_out

import softmpm

FIELDS = ("kind", "world", "particle", "substep", "value", "limit")


@pytest.fixture(scope="module")
def failed() -> softmpm.UnstableError:
    with pytest.raises(softmpm.UnstableError) as caught:
        thrown_out()
    return caught.value


def assert_same(got: Exception, want: softmpm.UnstableError) -> None:
    assert type(got) is softmpm.UnstableError and str(got) == str(want)
    assert all(getattr(got, name) == getattr(want, name) for name in FIELDS)
    assert isinstance(got.state, softmpm.State)
    assert got.state.low is not None and want.state.low is not None
    for a, b in zip((*got.state[:4], *got.state.low), (*want.state[:4], *want.state.low), strict=True):
        assert torch.equal(a, b) and a.device.type == "cpu"


@pytest.mark.parametrize("again", [lambda e: pickle.loads(pickle.dumps(e)), copy.copy, copy.deepcopy])
def test_an_error_can_be_copied(failed, again):
    """Message, attributes, notes and state are those of the error itself."""
    failed.add_note("In control step 3.")
    got = again(failed)
    assert_same(got, failed)
    assert got.__notes__ == failed.__notes__
    del failed.__notes__


def test_an_error_without_a_state_can_be_copied(failed):
    """As that of a backward pass; a state that carries a gradient arrives without it."""
    bare = copy.copy(failed)
    bare.state = None
    assert copy.copy(bare).state is None and str(copy.copy(bare)) == str(failed)
    bare.state = failed.state._replace(x=failed.state.x.clone().requires_grad_())
    assert not pickle.loads(pickle.dumps(bare)).state.x.requires_grad


def in_a_pool() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        pool.apply_async(thrown_out).get(timeout=300)


def in_an_executor() -> None:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as executor:
        executor.submit(thrown_out).result(timeout=300)


@pytest.mark.parametrize("work", [in_a_pool, in_an_executor])
def test_an_error_arrives_from_another_process(failed, work):
    """In the caller, whole, after the worker has ended; it took the executor down, or was waited for without end."""
    with pytest.raises(softmpm.UnstableError) as caught:
        work()
    assert_same(caught.value, failed)
