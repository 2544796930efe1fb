"""The device of a model, and the folder for its compiled kernels."""

import os
import subprocess
import sys

import pytest
import torch

from softmpm.devices import warp_device_of


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
