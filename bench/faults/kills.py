"""Interrupted runs: killed, stopped by a signal or out of disk space, then resumed. They must end bitwise equal to an undisturbed run.

Kills occur just before a file operation or at a random time, in forked children and in separate processes. A signal at a random time,
also while pictures are drawn, must lead to an explanatory message.

    python -m bench.faults.kills [--share 0.1]
"""

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from bench.faults import common

RANDOM, POINTS, REAL, SIGNALS, FULL = 72, 63, 8, 60, 18
BAD = ["differs", "unclear", "silent", "hang"]
_COUNTED = {"open", "os.rename", "os.remove", "os.truncate", "os.mkdir"}
"""Audit events of file operations; fsync has none and is wrapped."""


def main(share: float = 1.0) -> common.Table:
    """All trials, or a share of them."""
    table, chance = common.Table("kills, signals and full disks", BAD), random.Random(0)

    def times(count: int) -> range:
        return range(round(count * share))

    with common.workshop() as folder:
        began = time.monotonic()
        ended = common.forked(common.fresh(folder / "whole"))
        assert ended.code == 0, ended.output
        seconds, whole = time.monotonic() - began, common.fingerprint(folder / "whole")
        run = folder / "run"
        for _ in times(RANDOM):
            kill = after(chance.uniform(0.0, seconds), signal.SIGKILL)
            table.add("kill at a random time", *goes_on(run, common.forked(common.fresh(run), kill), whole))
        operations = counted(run)
        for place in random.Random(1).sample(range(operations), len(times(POINTS))):
            ended = common.forked(dying(common.fresh(run), run, place))
            table.add("kill at a file operation", *goes_on(run, ended, whole))
        for _ in times(REAL):
            table.add("kill of a real process", *goes_on(run, real(run, chance.uniform(4.0, 14.0)), whole))
        program = common.program(*common.TINY, f"hydra.run.dir={run}")
        began = time.monotonic()
        common.forked(program)
        seconds = time.monotonic() - began
        shutil.rmtree(run)
        for k in times(SIGNALS):
            number = (signal.SIGINT, signal.SIGTERM)[k % 2]
            ended = common.forked(program, after(chance.uniform(0.05, 1.05 * seconds), number))
            outcome = answered(ended)
            table.add(number.name, *(outcome if outcome[0] in BAD else goes_on(run, ended, whole)))
        for k in times(FULL):
            ended = common.forked(limited(common.fresh(run), 1000 * 2**k if k < 9 else 150_000 * (k - 8)))
            outcome = refused(ended, run)
            table.add("no room for a file", *(outcome if outcome[0] in BAD else goes_on(run, ended, whole)))
    return table


def after(seconds: float, number: int) -> Callable[[int], None]:
    """Function that sends a signal to a child after ``seconds``."""

    def during(pid: int) -> None:
        time.sleep(seconds)
        os.kill(pid, number)

    return during


def goes_on(run: Path, first: common.Ended, whole: dict[str, object]) -> tuple[str, str]:
    """Resume, compare with the undisturbed run, and remove the folder."""
    resumed = common.forked(common.resume(run) if (run / "config.yaml").exists() else common.fresh(run))
    try:
        if first.hung or resumed.hung:
            return "hang", first.output + resumed.output
        if resumed.code:
            return "differs", resumed.output
        found = common.same(run, whole)
        return ("same" if found == "same" else "differs"), found
    finally:
        shutil.rmtree(run, ignore_errors=True)


def watched(run: Path, touch: Callable[[], None]) -> None:
    """Call ``touch`` before every file operation in the folder."""
    name, sync = str(run), os.fsync

    def hook(event: str, arguments: tuple) -> None:
        if event in _COUNTED and str(arguments[0]).startswith(name):
            touch()

    def fsync(descriptor: int) -> None:
        touch()
        sync(descriptor)

    sys.addaudithook(hook)
    os.fsync = fsync


def counted(run: Path) -> int:
    """Number of file operations of an undisturbed run."""
    count = [0]

    def work() -> None:
        watched(run, lambda: count.__setitem__(0, count[0] + 1))
        common.fresh(run)()
        print(f"operations: {count[0]}")

    ended = common.forked(work)
    shutil.rmtree(run)
    return int(ended.output.rpartition("operations: ")[2])


def dying(work: Callable[[], None], run: Path, place: int) -> Callable[[], None]:
    """The work, killed just before the file operation with this number."""
    left = [place]

    def touch() -> None:
        if left[0] == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left[0] -= 1

    def dies() -> None:
        watched(run, touch)
        work()

    return dies


def real(run: Path, seconds: float) -> common.Ended:
    """``python -m softmpm_learn`` in a separate process, killed after ``seconds``."""
    words = [sys.executable, "-m", "softmpm_learn", *common.TINY, f"hydra.run.dir={run}"]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        time.sleep(seconds)
        process.kill()
    return common.Ended(process.returncode, "", False)


def answered(ended: common.Ended) -> tuple[str, str]:
    """Outcome of a signal: answered by a message (iterations done, state saved, or run finished), or not."""
    if ended.hung:
        return "hang", ended.output
    if common.unclear(ended.output) or "Exception ignored" in ended.output:
        return "unclear", ended.output
    words = ("To go on:", "interrupted. ", "Everything is in")
    return ("answered" if any(word in ended.output for word in words) else "silent"), ended.output


def limited(work: Callable[[], None], size: int) -> Callable[[], None]:
    """The work with files limited to ``size`` bytes: the write fails as on a full disk."""

    def runs() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
        work()

    return runs


def refused(ended: common.Ended, run: Path) -> tuple[str, str]:
    """Outcome of a run without disk space: a message that names the file, or no need of the space."""
    if ended.hung:
        return "hang", ended.output
    if ended.code and (common.unclear(ended.output) or str(run) not in ended.output):
        return "unclear", ended.output
    return "refused", ""


if __name__ == "__main__":
    common.report(main)
