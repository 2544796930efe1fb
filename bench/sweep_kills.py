"""Sweeps that are killed and started again, against unbroken ones.

    python bench/sweep_kills.py [--sweeps jobs seeds] [--rounds 3] [--kills 3] [--seed 0] [--json bench/results/sweep_kills.json]

``jobs`` is a sweep of 24 small runs on the CPU, ``seeds`` one of 6 with two seeds side by side; in both the biped and the arm diverge
at a rate of 1e3. Each sweep is run once without a kill. Then, in each round, it is killed by SIGKILL at random moments and started
again by the same command until it ends: while Python imports, while a file is written, and in the midst of a job, or between the
checkpoints of its two seeds. The table has the number of rows of sweep.csv, of rows that are there twice, of rows that say "failed"
and why, and of files that differ from those of the unbroken sweep (same_files.py). The exit code is 1 if anything is not as it should
be.
"""

import argparse
import csv
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from common import Table
from same_files import compared, differences

from softmpm_learn.storage import checkpoint
from softmpm_learn.storage.sweep import OUTCOME, TABLE

ROOT = Path(__file__).resolve().parents[1]
COMMON = ["experiment=smoke", "task=biped,arm", "device=cpu", "task.strength=1.5e4", "optimizer.retries=0"]
RATES = ",".join(f"{k}e-3" for k in range(1, 12))
SWEEPS = {
    "jobs": [*COMMON, f"optimizer.policy_rate=1e3,{RATES}"],
    "seeds": [*COMMON, "optimizer.policy_rate=1e3,5e-3,1e-2", "train.seeds=2"],
}
JOBS, FAILED = {"jobs": 24, "seeds": 6}, {"jobs": 2, "seeds": 4}
SEEDS = {"jobs": [""], "seeds": ["seed_0", "seed_1"]}
"""Folders of the seeds of a job."""
WRITTEN = (checkpoint.NAME, "metrics.csv", "replay/00000001.h5", "config.yaml", OUTCOME, TABLE)
PAUSE = 2e-4
"""Time between two looks at the files [s]; a draft is there for about a millisecond."""


@dataclass(frozen=True)
class Sweep:
    """A sweep in a working folder of its own."""

    name: str
    place: Path

    @property
    def jobs(self) -> int:
        return JOBS[self.name]

    @property
    def folder(self) -> Path:
        """Folder of the sweep, which the program names."""
        return next(self.place.glob("outputs/sweep/*"), self.place / "nowhere")

    def start(self) -> subprocess.Popen:
        """Start the same command again, with one thread."""
        environment = os.environ | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "softmpm_learn", "-m", *SWEEPS[self.name]]
        with open(self.place / "said.txt", "ab") as said:
            return subprocess.Popen(command, cwd=self.place, env=environment, stdout=said, stderr=said)

    def finish(self) -> None:
        """Run it to its end; the job that diverges makes the exit code 1."""
        code = self.start().wait()
        if code != 1:
            text = (self.place / "said.txt").read_text(errors="replace")[-2000:]
            raise SystemExit(f"{text}\nThe sweep ended with exit code {code}, not 1.")

    def rows(self) -> list[dict[str, str]]:
        with open(self.folder / TABLE, newline="") as file:
            return list(csv.DictReader(file))


class Killer:
    """Kills a sweep at moments drawn from a seed.

    Args:
        whole: The same sweep, unbroken; gives the times among which the moments are drawn.
        began: When that was started [s].
    """

    def __init__(self, sweep: Sweep, whole: Sweep, began: float, seed: int):
        self.sweep, self.chance = sweep, random.Random(seed)
        first = (whole.folder / "0" / ".lock").stat().st_mtime
        last = (whole.folder / TABLE).stat().st_mtime
        self.start, self.job = first - began, (last - first) / sweep.jobs

    def plan(self, kills: int) -> list[tuple[Callable[[subprocess.Popen, int], str], int]]:
        """Ways to kill, the first not while importing, each with a job that has to begin before or a later one; jobs ascend."""
        later = [self.in_job if self.sweep.name == "jobs" else self.between_seeds, self.while_writing]
        first = later.pop(self.chance.randrange(2))
        later.append(self.while_importing)
        self.chance.shuffle(later)
        ways = [first, *later, *self.chance.choices([first, *later], k=kills)][:kills]
        return list(
            zip(ways, sorted(self.chance.choices(range(self.sweep.jobs * 3 // 4), k=kills)), strict=True)
        )

    def while_importing(self, process: subprocess.Popen, job: int) -> str:
        """Kill before the first job begins again; the job does not matter."""
        wait = self.chance.uniform(0.0, self.start)
        time.sleep(wait)
        end(process)
        return f"{wait:.1f} s after the start"

    def in_job(self, process: subprocess.Popen, job: int) -> str:
        """Kill within the time that a job takes."""
        job = self._begun(process, job)
        wait = self.chance.uniform(0.0, self.job)
        time.sleep(wait)
        end(process)
        return f"{wait:.1f} s into job {job}"

    def while_writing(self, process: subprocess.Popen, job: int) -> str:
        """Kill while the draft of a file is there, of this job or the next one that writes such a file."""
        name = self.chance.choice(WRITTEN)
        job = self._begun(process, job)
        folder, seeds = self.sweep.folder, SEEDS[self.sweep.name]
        own = [folder / str(k) / seed for k in range(job, self.sweep.jobs) for seed in seeds]
        drafts = [place / f"{name}.new" for place in ([folder] if name == TABLE else own)]
        draft = self._stopped(process, drafts, lambda draft: draft.exists())
        return f"while {draft.relative_to(folder).with_suffix('')} was written"

    def between_seeds(self, process: subprocess.Popen, job: int) -> str:
        """Kill where the checkpoint of one seed is an iteration ahead of that of the other."""
        first = self._begun(process, job)
        own = [
            self.sweep.folder / str(k) / seed
            for k in range(first, self.sweep.jobs)
            for seed in SEEDS["seeds"]
        ]

        def uneven(draft: Path) -> bool:
            return len({saved(draft.parents[1] / seed) for seed in SEEDS["seeds"]}) > 1

        draft = self._stopped(process, [place / f"{checkpoint.NAME}.new" for place in own], uneven)
        return "with checkpoints of iterations {} in job {}".format(
            " and ".join(str(saved(draft.parents[1] / seed)) for seed in SEEDS["seeds"]),
            draft.parents[1].name,
        )

    def _stopped(self, process: subprocess.Popen, drafts: list[Path], right: Callable[[Path], bool]) -> Path:
        """Stop the process where a draft is there, and kill it if the moment is right; gives the draft."""
        while True:
            draft = found(process, lambda: drafts)
            os.kill(process.pid, signal.SIGSTOP)
            os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
            if right(draft):
                end(process)
                return draft
            os.kill(process.pid, signal.SIGCONT)
            time.sleep(PAUSE)

    def _begun(self, process: subprocess.Popen, job: int) -> int:
        """Wait until a job begins that is new, this one or one after it; gives its number."""
        jobs = range(job, self.sweep.jobs)
        new = [k for k in jobs if not (self.sweep.folder / str(k)).exists()]
        return int(found(process, lambda: [self.sweep.folder / str(k) / ".lock" for k in new]).parent.name)


def saved(folder: Path) -> int:
    """Iterations in the checkpoint of a run."""
    return checkpoint.load(folder)["iteration"] if checkpoint.exists(folder) else 0


def found(process: subprocess.Popen, paths: Callable[[], list[Path]]) -> Path:
    """Wait until one of some files is there."""
    while process.poll() is None:
        for path in paths():
            if path.exists():
                return path
        time.sleep(PAUSE)
    raise SystemExit("the sweep ended before it could be killed; choose another seed.")


def end(process: subprocess.Popen) -> None:
    """Kill a process that is still going on."""
    if process.poll() is not None:
        raise SystemExit("the sweep ended before it could be killed; choose another seed.")
    process.kill()
    process.wait()


def row(name: str, killed: str, sweep: Sweep, different: list[str], seconds: float) -> dict:
    """Row of the table about a sweep that has ended."""
    rows = sweep.rows()
    return {
        "sweep": name,
        "killed": killed,
        "rows": len(rows),
        "twice": len(rows) - len({(one["job"], one["seed"]) for one in rows}),
        "failed": sum(one["status"] == "failed" and one["error"] != "" for one in rows),
        "files": len(compared(sweep.folder)),
        "different": len(different),
        "seconds": round(seconds, 1),
    }


def broken(sweep: Sweep, killer: Killer, kills: int) -> str:
    """Run a sweep that is killed; gives the moments in words."""
    moments = [way(sweep.start(), job) for way, job in killer.plan(kills)]
    sweep.finish()
    return ", ".join(moments)


def compare(name: str, place: Path, args: argparse.Namespace, table: Table) -> bool:
    """A sweep without a kill, then some with kills at the same path; True if all are as they should be."""
    sweep, whole, right = Sweep(name, place / "now"), Sweep(name, place / "whole"), True
    for number in range(args.rounds + 1):
        sweep.place.mkdir(parents=True)
        began = time.time()
        if number == 0:
            sweep.finish()
            start = began
            killed, different = "no", []
        else:
            killed = broken(sweep, Killer(sweep, whole, start, args.seed + number), args.kills)
            different = differences(whole.folder, sweep.folder)
        new = row(name, killed, sweep, different, time.time() - began)
        table.add(new)
        for path in different:
            print(f"    differs: {path}", flush=True)
        sweep.place.rename(whole.place if number == 0 else place / f"round_{number}")
        expected = {"rows": sweep.jobs * len(SEEDS[name]), "twice": 0, "failed": FAILED[name], "different": 0}
        right &= expected == {key: new[key] for key in expected}
    return right


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sweeps", nargs="+", default=list(SWEEPS), choices=list(SWEEPS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--kills", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=None, help="leave the sweeps there")
    parser.add_argument("--json", type=Path, default=None, help="also write the table to this file")
    args = parser.parse_args()
    table = Table("Sweeps killed and started again", torch.device("cpu"), args.json)
    with tempfile.TemporaryDirectory() as temporary:
        place = (args.folder or Path(temporary)).resolve()
        right = [compare(name, place / name, args, table) for name in args.sweeps]
    sys.exit(0 if all(right) else 1)


if __name__ == "__main__":
    main()
