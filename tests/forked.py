"""Processes of their own that need not import PyTorch first: a server that has imported it forks them."""

import itertools
import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

import softmpm

PATH = os.pathsep.join([str(Path(__file__).parents[1] / "src"), str(Path(__file__).parent)])
METHOD = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
SERVER = multiprocessing.get_context(METHOD)
IMPORTED = [
    "pytest",
    "softmpm_learn.command.app",
    "softmpm_learn.command.experiment",
    "torch._dynamo",
    "torch.distributed.run",
]
"""By the server; any optimiser imports ``torch._dynamo``."""


def ensure_server() -> None:
    """Start it, unless it runs; it has the package of this checkout, and one thread."""
    if METHOD == "forkserver":
        from multiprocessing import forkserver

        SERVER.set_forkserver_preload(IMPORTED)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PYTHONPATH", PATH, prepend=os.pathsep)
            patch.setenv("OMP_NUM_THREADS", "1")
            patch.delenv("HYDRA_FULL_ERROR", raising=False)  # which softmpm_learn.command.app.main sets
            forkserver.ensure_running()


def exit_code(function: Callable, *arguments: object, timeout: float = 300.0) -> int:
    """Run a function of a module in a process of its own; gives how that ended, negative by a signal."""
    ensure_server()
    process = SERVER.Process(target=function, args=arguments)
    process.start()
    process.join(timeout)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise TimeoutError(f"{function.__name__} takes more than {timeout:g} s")
    code = process.exitcode
    process.close()
    return code


def said(function: Callable, *arguments: object, timeout: float = 300.0) -> subprocess.CompletedProcess:
    """The same with what it wrote, as :func:`subprocess.run` gives it."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, name) for name in ("stdout", "stderr")]
        code = exit_code(_redirected, paths, function, *arguments, timeout=timeout)
        return subprocess.CompletedProcess(function.__name__, code, *(path.read_text() for path in paths))


def _redirected(paths: Sequence[Path], function: Callable, *arguments: object) -> None:
    for number, path in enumerate(paths, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    function(*arguments)


def python(*words: str, folder: Path, timeout: float = 300.0) -> subprocess.CompletedProcess:
    """``python WORDS`` in a folder: the first word is a file, or the first two are ``-m`` and a module."""
    return said(_python, words, folder, timeout=timeout)


def _python(words: Sequence[str], folder: Path) -> None:
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    if words[0] == "-m":
        sys.argv[:] = words[1:]
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv[:] = words
        runpy.run_path(words[0], run_name="__main__")


def kill_at_simulation(number: int) -> None:
    """Let this process kill itself when the simulator is called for this time, counted from 0."""
    calls, real = itertools.count(), softmpm.simulate

    def simulate(*args, **kwargs):
        if next(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*args, **kwargs)

    softmpm.simulate = simulate
