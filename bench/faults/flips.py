"""Damaged recordings of a killed run, with one bit flipped or truncated: each is read or refused without delay.

python -m bench.faults.flips [--share 0.1]
"""

import random
import time
from pathlib import Path

from bench.faults import common

import softmpm

FLIPS, CUTS = 60, 30
SECONDS = 5.0
"""Time limit of reading [s], beyond which it counts as hung."""


def read_all(path: Path) -> None:
    """Read every number of a recording; print one sentence if it is refused."""
    try:
        with softmpm.Recording(path) as recording:
            for iteration in recording.episodes:
                recording.frames(iteration)
                recording.attributes(iteration)
    except (OSError, ValueError) as error:
        print(f"refused: {error}")


def main(share: float = 1.0) -> common.Table:
    """All trials, or a share of them."""
    chance, table = random.Random(0), common.Table("damaged recordings of a killed run", ["hang", "unclear"])
    with common.workshop() as folder:
        common.killed_run(folder / "run")
        whole, path = (folder / "run" / "run.h5").read_bytes(), folder / "damaged.h5"
        head = [bytes([*whole[:k], whole[k] ^ 1, *whole[k + 1 :]]) for k in range(48)]
        kinds = {
            "flipped bit": [common.damaged(whole, chance) for _ in range(round(FLIPS * share))],
            "flipped bit of the superblock": head[:: round(1 / share)],
            "cut short": [whole[: chance.randrange(len(whole))] for _ in range(round(CUTS * share))],
        }
        for kind, files in kinds.items():
            for data in files:
                path.write_bytes(data)
                table.add(kind, *outcome(path))
    return table


def outcome(path: Path) -> tuple[str, str]:
    began = time.monotonic()
    ended = common.forked(lambda: read_all(path), limit=SECONDS)
    if ended.hung or time.monotonic() - began > SECONDS:
        return "hang", ended.output
    if ended.code or common.unclear(ended.output) or (ended.output and path.name not in ended.output):
        return "unclear", ended.output
    return ("refused" if "refused" in ended.output else "read"), ""


if __name__ == "__main__":
    common.report(main)
