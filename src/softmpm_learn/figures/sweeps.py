"""Sweeps as they lie on the disk: the table of each, the settings of its jobs, and the metrics of its runs."""

import csv
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from omegaconf import OmegaConf

from softmpm_learn.storage import sweep
from softmpm_learn.storage.sweep import EXAMINED

SEEDS = "train.seed", "train.seeds"
INDIFFERENT = (
    *(*SEEDS, "train.log", "train.record_every", "train.frame_every", "train.examine", "train.save_every"),
    *("train.pictures", "train.side_by_side", "device.threads", "device.memory", "resume"),
)
"""Settings by which runs do not become others, the seed apart."""
PIECE = re.compile(r"""'(?:\\.|[^'\\])*'|"(?:\\.|[^"\\])*"|\\[\\()[\]{}:=, \t]|.""", re.DOTALL)
"""A quoted text, an escaped character or another one."""


@dataclass(kw_only=True)
class SweptRun:
    """A run of a sweep."""

    sweep: str
    """Folder of the sweep, without the folders above."""
    job: int
    seed: int
    settings: dict[str, str]
    """From the command line, without those that make no difference."""
    status: str
    """finished or failed."""
    folder: Path
    error: str = ""
    examination: dict[str, float] = field(default_factory=dict)
    columns: list[str] = field(default_factory=list)
    """Of metrics.csv after ``iteration``, without the examination; empty where a run failed before it began."""
    rows: dict[int, dict[str, float]] = field(default_factory=dict)
    """Finite numbers of metrics.csv, by iteration and column."""


def read(folders: Sequence[Path]) -> list[SweptRun]:
    """All runs of some sweeps, with the settings that differ between them.

    Raises:
        ValueError: A folder is no sweep, or incomplete; two runs have the same settings and seed; no run has finished.
    """
    found = [run for folder in folders for run in _runs(folder)]
    varying = differing(found)
    for run in found:
        run.settings = {key: run.settings.get(key, "") for key in varying}
    if len({run.sweep for run in found}) > 1 and _repeated(found):
        for run in found:
            run.settings = {"sweep": run.sweep} | run.settings
    for one, other in _repeated(found)[:1]:
        raise ValueError(
            f"{one.folder} and {other.folder} have the same settings and the same seed, {one.seed}; leave one of them out."
        )
    if not any(run.status == "finished" for run in found):
        raise ValueError(
            f"none of {len(found)} runs has finished; see the column error of {folders[0] / sweep.TABLE}."
        )
    return found


def differing(runs: Sequence[SweptRun]) -> list[str]:
    """Settings that are not the same in all runs, in the order of the command line."""
    keys = dict.fromkeys(key for run in runs for key in run.settings)
    return [key for key in keys if len({run.settings.get(key) for run in runs}) > 1]


def by_task(runs: Sequence[SweptRun]) -> dict[str, list[SweptRun]]:
    """Runs of each task, whose losses cannot be compared with those of another; of one task alone under an empty name."""
    found: dict[str, list[SweptRun]] = {}
    for run in runs:
        found.setdefault(run.settings.get("task", ""), []).append(run)
    if len(found) == 1:
        return {"": list(runs)}
    for members in found.values():
        varying = differing(members)
        for run in members:
            run.settings = {key: run.settings[key] for key in varying}
    return {name or "default": members for name, members in found.items()}


def _repeated(runs: Sequence[SweptRun]) -> list[tuple[SweptRun, SweptRun]]:
    """Each run whose settings and seed an earlier one has, after that one."""
    first: dict[tuple, SweptRun] = {}
    found = []
    for run in runs:
        before = first.setdefault((tuple(run.settings.items()), run.seed), run)
        if before is not run:
            found.append((before, run))
    return found


def _runs(folder: Path, job: int | None = None) -> Iterator[SweptRun]:
    """Runs of a sweep; of a job with seeds side by side those of its seeds."""
    path = folder / sweep.TABLE
    if not path.is_file():
        raise ValueError(
            f"{folder} is no sweep: it has no {sweep.TABLE}. Give the folder of one, such as outputs/sweep/SETTINGS."
        )
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    need = {"job", "status", "settings", "folder"}
    if not rows or not need <= set(rows[0]):
        raise ValueError(f"{path} must have the columns {', '.join(sorted(need))} and a row for each job.")
    for line, row in enumerate(rows, 2):
        if None in row or None in row.values():
            raise ValueError(
                f"{path}, line {line}, is damaged; the command of the sweep, given again, writes the table anew."
            )
        number = int(row["job"]) if job is None else job
        place = _place(folder, Path(row["folder"]))
        if (place / sweep.TABLE).is_file() and place.resolve() != folder.resolve():
            yield from _runs(place, number)
            continue
        found = {path.parent.name[5:]: path.parent for path in place.glob("seed_*/metrics.csv")}
        seeds = {int(name): at for name, at in found.items() if name.isdigit()}
        if not seeds:
            yield _run(folder, number, row, place)
        for seed in sorted(seeds):
            yield _run(folder, number, row, seeds[seed], seed)


def _place(sweep: Path, folder: Path) -> Path:
    """Folder of a job, or of a seed in that of its job, also where the sweep was moved."""
    inside = (sweep.joinpath(*folder.parts[-count:]) for count in (1, 2))
    return next((place for place in inside if place.is_dir()), folder)


def _seed(place: Path) -> int:
    """Seed of a run by its configuration, which an experiment may have set; 0 where there is none."""
    path = place / "config.yaml"
    return OmegaConf.select(OmegaConf.load(path), "train.seed", default=0) if path.is_file() else 0


def _run(folder: Path, job: int, row: dict[str, str], place: Path, seed: int | None = None) -> SweptRun:
    settings = parse(row["settings"])
    try:
        own = int(row.get("seed") or settings.get("train.seed") or _seed(place)) if seed is None else seed
    except ValueError:
        own = 0  # such a job has failed
    run = SweptRun(
        sweep=folder.resolve().name,
        job=job,
        seed=own,
        settings={key: value for key, value in settings.items() if key not in INDIFFERENT},
        status=row["status"],
        folder=place,
        error=row.get("error") or "",
        examination={} if seed is not None else {name: _number(row.get(name)) for name in EXAMINED},
    )
    path = place / "metrics.csv"
    if path.is_file():
        _add_metrics(run, path)
    elif run.status == "finished":
        raise ValueError(f"job {job} of {folder} has finished, but {path} is missing; put it back.")
    return run


def _add_metrics(run: SweptRun, path: Path) -> None:
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        names = list(reader.fieldnames or [])
        if names[:2] != ["iteration", "loss"]:
            raise ValueError(f"{path} must have the columns iteration and loss first; it has {names}.")
        run.columns = [name for name in names[1:] if name not in EXAMINED]
        for line, row in enumerate(reader, 2):
            try:
                iteration, numbers = int(row["iteration"]), {name: _number(row[name]) for name in names[1:]}
            except ValueError as error:
                raise ValueError(f"{path}, line {line}: {error}.") from error
            if math.isfinite(numbers["loss"]):
                run.rows[iteration] = {name: numbers[name] for name in run.columns}
            elif not run.examination:
                run.examination = {name: numbers.get(name, math.nan) for name in EXAMINED}


def parse(words: str) -> dict[str, str]:
    """Settings from a command line, by key, in Hydra's grammar, whose parser reads one at a time; the last value counts.

    White space within brackets and quotes, and after a backslash, does not separate.
    """
    found, word, depth = [], "", 0
    for piece in PIECE.findall(f"{words}\n"):
        if piece.isspace() and not depth:
            found, word = found + [word] * bool(word), ""
            continue
        word += piece
        depth += (piece in "([{") - (piece in ")]}")
    pairs = (text.partition("=") for text in found)
    return {key.lstrip("+~"): value for key, _, value in pairs}


def _number(text: str | None) -> float:
    return float(text) if text else math.nan
