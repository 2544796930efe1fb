"""One file of a finished run is damaged, emptied, deleted or that of another run; then the run goes on.

It must be refused with the file's name, or say what is lost, or end with the numbers of an undisturbed run.

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
"""Of each file, beside an empty one, a deleted one and that of another run: 22 harms for each of ten files."""


def main(share: float = 1.0) -> common.Table:
    """The whole round, or a share of it."""
    table = common.Table("corrupted run folders", ["silently different", "unclear", "hang"])
    with common.workshop() as folder:
        whole = prepare(folder)
        trials = [(name, kind, data) for name in FILES for kind, data in harms(folder, name)]
        for name, kind, data in common.some(trials, share):
            table.add(name, *outcome(folder, name, kind, data, whole))
    return table


def prepare(folder: Path) -> dict[str, object]:
    """A run of four iterations, another one of another seed, and the first one's end after five."""
    for name, more in (("run", ()), ("other", ("train.seed=1",)), ("whole", ("train.iterations=5",))):
        ended = common.forked(common.fresh(folder / name, *more))
        assert ended.code == 0, ended.said
    return common.fingerprint(folder / "whole")


def harms(folder: Path, name: str) -> list[tuple[str, bytes | None]]:
    """What the file is replaced by; None deletes it."""
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
    if common.unclear(ended.said):
        return "unclear", f"{kind}: {ended.said}"
    named = str(run) in ended.said and Path(name).name.partition(".")[0] in ended.said
    if ended.code:
        return ("refused" if named else "unclear"), f"{kind}: {ended.said}"
    found = common.same(run, whole)
    if found == "same":
        return "same numbers", ""
    said = named and "is missing" in ended.said
    return ("said what is lost" if said else "silently different"), f"{kind}: {found}: {ended.said}"


if __name__ == "__main__":
    common.report(main)
