"""Jobs of a sweep: the outcome of each in its own folder, and one table of all. The same command finds them again and goes on."""

import csv
import dataclasses
import hashlib
import io
import json
import math
import re
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from softmpm_learn.storage import files

OUTCOME, TABLE = "outcome.json", "sweep.csv"
SEED = "seed_"
"""Folder of a seed that learns beside others, without its number."""
LONGEST = 80
"""Characters of a folder's name, without its digest."""
_MOST = 2**16  # bytes of an outcome


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a job; the fields are the columns of the table."""

    job: int
    """Number in the sweep."""
    seed: int | None = None
    """Seed; None of a job with several side by side before any of them began, or with settings that could not be read."""
    status: str
    """finished or failed."""
    loss: float = math.inf
    """Objective of the sweep: the loss of the best motion, of its evaluation if there are any; infinite if the run failed."""
    iteration: int = -1
    """Iteration of the best motion."""
    iterations: int = 0
    """Iterations done."""
    end: float = math.nan
    """This and the next seven: see examination.py; nan where a job has no answer."""
    later: float = math.nan
    kicked: float = math.nan
    friction: float = math.nan
    finer: float = math.nan
    largest_tilt: float = math.nan
    largest_miss: float = math.nan
    largest_speed: float = math.nan
    settings: str
    """Settings of the job, as on the command line."""
    folder: str
    error: str = ""
    """Reason why it failed."""


EXAMINED = [field.name for field in dataclasses.fields(Outcome) if field.default is math.nan]
"""Answers of the examination, as the columns of sweep.csv and of metrics.csv are called."""


def folder_name(overrides: Sequence[str]) -> str:
    """Name of the folder of a sweep, from its command line: the same for the same words."""
    text = ",".join(overrides)
    name = re.sub(r"[^\w.=,+-]", "_", text, flags=re.ASCII)[:LONGEST]
    if name == text and name.strip("."):
        return name
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def outcome(folder: Path) -> Outcome | None:
    """Outcome in the folder of a job, None if there is none yet.

    Raises:
        ValueError: It cannot be read; names the file.
    """
    path = folder / OUTCOME
    if not path.exists():
        return None
    try:
        found = Outcome(**json.loads(files.read(path, _MOST)))
        if found.status not in ("finished", "failed") or not isinstance(found.loss, float):
            raise ValueError("its values are others")
        return found
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{path} is no outcome of a job: {error}; remove it to run the job again."
        ) from error


def record(folder: Path, found: Outcome) -> None:
    """Write the outcome of a job into its folder."""
    files.replace(folder / OUTCOME, json.dumps(dataclasses.asdict(found), indent=1).encode())


def update(folder: Path, found: Outcome) -> None:
    """Replace the outcome in the folder of a job, or of a seed, by that of the run that went on alone, in the tables above it too; one
    without an outcome is left to the command of its sweep."""
    before = outcome(folder)
    if before is None:
        return
    own = dict(job=before.job, seed=before.seed, settings=before.settings, folder=before.folder)
    record(folder, dataclasses.replace(found, **own))
    if folder.name.startswith(SEED):
        _update_job(folder.parent)
    for above in (folder, folder.parent, folder.parent.parent):
        if (above / TABLE).exists():
            tabulate(above)


def _update_job(folder: Path) -> None:
    """A job that failed has finished with the last of its seeds."""
    job = outcome(folder)
    its = [found for one in folder.glob(f"{SEED}*") if (found := outcome(one))]
    if job and job.status == "failed" and its and all(one.status == "finished" for one in its):
        loss = statistics.median(one.loss for one in its)
        record(folder, dataclasses.replace(job, status="finished", loss=loss, error=""))


def tabulate(sweep: Path) -> None:
    """Write the table of all jobs of the sweep that have an outcome; of a job with several seeds, a row for each of them, unless it
    failed before any of them did: then they have the outcomes of an earlier command, and the job's own takes their place."""
    known = {}
    for path in sweep.rglob(OUTCOME):
        at, found = path.parent, outcome(path.parent)
        inside = at.relative_to(sweep).parts
        if found and (
            not inside or Path(found.folder).parts[-len(inside) :] == inside
        ):  # else a copy of a job's folder
            known[at] = found
    seeds: dict[Path, list[Path]] = {}
    for folder in known:
        if folder.name.startswith(SEED):
            seeds.setdefault(folder.parent, []).append(folder)
    hidden = set[Path]()
    for job, its in seeds.items():
        whole = job in known and known[job].status == "failed"
        hidden |= set(its) if whole and all(known[one].status == "finished" for one in its) else {job}
    shown = [one for folder, one in known.items() if folder not in hidden]
    rows = sorted(shown, key=lambda one: (one.job, one.seed or 0))
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, [field.name for field in dataclasses.fields(Outcome)], lineterminator="\n")
    table.writeheader()
    table.writerows(dataclasses.asdict(row) for row in rows)
    files.replace(sweep / TABLE, text.getvalue().encode())
