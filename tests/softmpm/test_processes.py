"""A failure crosses the border of a process, as sweeps need it to."""

import copy
import multiprocessing
import os
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest
import torch
from helpers import thrown_out

import softmpm
from softmpm.devices import warp_device_of

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


def test_without_a_place_for_kernels_the_remedy_is_named(tmp_path):
    """Also when asked once more; with the remedy the same program runs."""
    (tmp_path / "file").write_text("")
    program = (
        "import softmpm\n"
        "body = softmpm.Body(softmpm.box((0.2, 0.2), (0.4, 0.4), 0.05), softmpm.NeoHookean(density=1.0, young=1.0, poisson=0.3))\n"
        "scene = softmpm.Scene(grid=softmpm.Grid(shape=(12, 12), spacing=0.1), bodies=[body], dt=1e-3)\n"
        "for _ in range(2):\n"
        "    try:\n"
        "        softmpm.build(scene, device='cpu')\n"
        "    except OSError as error:\n"
        "        print(error)\n"
    )

    def printed(folder) -> str:
        done = subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"WARP_CACHE_PATH": str(folder)},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert (
        printed(tmp_path / "file" / "cache").count("WARP_CACHE_PATH to a folder that can be written to") == 2
    )
    assert "WARP_CACHE_PATH" not in printed(tmp_path / "cache")


def test_other_errors_of_warp_are_its_own(monkeypatch):
    """Such as a library that is missing, which is no matter of a folder."""

    def fails():
        raise OSError("libx.so: cannot open shared object file")

    monkeypatch.setattr("warp.init", fails)
    with pytest.raises(OSError, match="^libx.so"):
        warp_device_of(torch.device("cpu"))
