"""Damaged run folders: one file of a finished run is corrupted, emptied, deleted or replaced, and the run resumed.

The run must be refused with the name of the file, or report the loss, or end with the numbers of an undisturbed run.

    python -m bench.faults.corruption [--share 0.1]
"""

import random
import shutil
from pathlib import Path

from bench.faults import common

FILES = (
    *("checkpoint.pt", "checkpoint.previous.pt", "config.yaml", "metrics.csv", "timing.csv"),
    *("run.h5", "replay/00000002.h5", "replay/00000003.h5", ".lock", "softmpm_learn.log"),
)
FLIPS, CUTS = 15, 4
"""Corruptions of each file, besides emptying, deleting and replacing it: 22 in all for each of ten files."""


def main(share: float = 1.0) -> common.Table:
    """All trials, or a share of them."""
    table = common.Table("corrupted run folders", ["silently different", "unclear", "hang"])
    with common.workshop() as folder:
        whole = prepare(folder)
        trials = [(name, kind, data) for name in FILES for kind, data in harms(folder, name)]
        for name, kind, data in common.some(trials, share):
            table.add(name, *outcome(folder, name, kind, data, whole))
    return table


def prepare(folder: Path) -> dict[str, object]:
    """Run four iterations, the same with another seed, and five iterations without interruption."""
    for name, more in (("run", ()), ("other", ("train.seed=1",)), ("whole", ("train.iterations=5",))):
        ended = common.forked(common.fresh(folder / name, *more))
        assert ended.code == 0, ended.output
    return common.fingerprint(folder / "whole")


def harms(folder: Path, name: str) -> list[tuple[str, bytes | None]]:
    """Contents that replace the file; None deletes it."""
    data, chance = (folder / "run" / name).read_bytes(), random.Random(name)
    found: list[tuple[str, bytes | None]] = [("empty", b""), ("deleted", None)]
    found.append(("of another run", (folder / "other" / name).read_bytes()))
    found += [("flipped bit", common.damaged(data or b"\0", chance)) for _ in range(FLIPS)]
    return found + [("cut short", data[: chance.randrange(max(len(data), 1))]) for _ in range(CUTS)]


def outcome(
    folder: Path, name: str, kind: str, data: bytes | None, whole: dict[str, object]
) -> tuple[str, str]:
    run = folder / "harmed"
    shutil.copytree(folder / "run", run)
    (run / name).unlink() if data is None else (run / name).write_bytes(data)
    ended = common.forked(common.resume(run, iterations=5))
    try:
        return judged(run, name, ended, whole, kind)
    finally:
        shutil.rmtree(run)


def judged(run: Path, name: str, ended: common.Ended, whole: dict[str, object], kind: str) -> tuple[str, str]:
    if ended.hung:
        return "hang", kind
    if common.unclear(ended.output):
        return "unclear", f"{kind}: {ended.output}"
    named = str(run) in ended.output and Path(name).name.partition(".")[0] in ended.output
    if ended.code:
        return ("refused" if named else "unclear"), f"{kind}: {ended.output}"
    found = common.same(run, whole)
    if found == "same":
        return "same numbers", ""
    reported = named and "is missing" in ended.output
    return ("reported the loss" if reported else "silently different"), f"{kind}: {found}: {ended.output}"


if __name__ == "__main__":
    common.report(main)
