"""Sweeps: a row for each job, whatever becomes of it, and the same command again."""

import contextlib
import csv
import json
import math
import shutil
from pathlib import Path

import pytest

import softmpm
from softmpm_learn import train
from softmpm_learn.command import jobs
from softmpm_learn.runs.saved import load
from softmpm_learn.storage import checkpoint, sweep
from softmpm_learn.training import optimisation

pytestmark = pytest.mark.usefixtures("in_folder")

TINY = [
    *("task=arm", "observer=centroids", "task.seconds=0.05", "task.control_period=0.025", "device=cpu"),
    *(
        "policy=linear",
        "train.iterations=2",
        "train.examine=false",
        "train.record_every=0",
        "train.pictures=false",
    ),
]
FAILS, WORKS = "task.poisson=0.45", "task.poisson=0.3"
"""The design's bounds of Poisson's ratio end at 0.4."""
INVERTED = dict(kind="inverted", world=0, particle=3, substep=1, value=-1.0, limit="det F > 0")


@pytest.fixture
def run(main):
    """Runs a sweep in this process; gives the exit code and the numbers that Hydra's sweeper got."""
    return lambda *words: main("-m", *TINY, *words)


def table() -> list[dict[str, str]]:
    (path,) = Path("outputs/sweep").glob("*/sweep.csv")
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def losses(folder: Path) -> list[float]:
    with open(folder / "metrics.csv", newline="") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


def evaluations(folder: Path) -> list[float]:
    """Those of a run, which choose the best."""
    with open(folder / "metrics.csv", newline="") as file:
        return [float(row["evaluation"]) for row in csv.DictReader(file) if row["evaluation"]]


def test_a_failed_job_is_a_row_and_the_next_one_runs(run, capsys):
    """Its objective is infinite, the reason is in the table and on stderr, and the exit code tells that something failed."""
    code, objectives = run(f"task.poisson={FAILS[-4:]},{WORKS[-3:]}")
    failed, finished = table()
    assert (
        code == 1
        and objectives[0] == math.inf
        and objectives[1] == min(evaluations(Path(finished["folder"])))
    )
    assert (failed["status"], failed["loss"], failed["job"]) == ("failed", "inf", "0")
    assert "design.poisson_range" in failed["error"] and FAILS in failed["settings"]
    assert (finished["status"], finished["iterations"], finished["error"]) == ("finished", "2", "")
    assert float(finished["loss"]) == objectives[1] and WORKS in finished["settings"]
    said = capsys.readouterr().err
    assert "softmpm_learn: job 0: " in said and "failed: 0; the same command tries them again." in said
    assert "Traceback" in (Path(failed["folder"]) / "error.txt").read_text()


def test_a_failure_of_any_kind_says_how_many_iterations_were_done(run, monkeypatch):
    """The traceback of the first attempt goes away with the second, which finishes."""
    real, failed = optimisation.attempt, []

    def fails(runs, *args):
        if runs.all[0].iteration == 1 and not failed:
            failed.append(True)
            raise MemoryError("no room")
        return real(runs, *args)

    monkeypatch.setattr(optimisation, "attempt", fails)
    for code, status, iterations in ((1, "failed", "1"), (0, "finished", "2")):
        assert run("train.seed=0")[0] == code
        (row,) = table()
        assert (row["status"], row["iterations"]) == (status, iterations)
        assert (Path(row["folder"]) / "error.txt").exists() == (status == "failed")


def test_a_failed_job_says_how_many_iterations_it_has_done(run, monkeypatch):
    """Those in metrics.csv, before the one in which its simulation failed; tried again, it gives the same row."""
    real, words = optimisation.attempt, ("train.seed=0", "optimizer.retries=0")

    def fails(runs, *args):
        if runs.all[0].iteration == 1:
            raise softmpm.UnstableError("particle 3 is inverted.", **INVERTED)
        return real(runs, *args)

    monkeypatch.setattr(optimisation, "attempt", fails)
    for _ in range(2):
        assert run(*words)[0] == 1
        (row,) = table()
        assert (row["status"], row["iterations"]) == ("failed", "1") and len(losses(Path(row["folder"]))) == 1
        assert row["error"].startswith("iteration 1: particle 3 is inverted.")


def test_a_setting_that_no_run_accepts_is_a_row_too(run):
    """It fails before the run begins, in the schema."""
    assert run("task.seconds=-1,0.05")[0] == 1
    failed, finished = table()
    assert "task.seconds must be > 0" in failed["error"] and finished["status"] == "finished"


def test_the_same_command_writes_a_damaged_table_anew(run):
    """As the sentence on one says; nothing is run again."""
    run("train.seed=0")
    (path,) = Path("outputs/sweep").glob("*/sweep.csv")
    whole = path.read_text()
    path.write_text(whole[: len(whole) // 2])
    run("train.seed=0")
    assert path.read_text() == whole


def test_the_same_command_skips_what_has_finished(run, monkeypatch):
    """Finished jobs give their objective again without a run; a failed one is tried again, and its row replaced."""
    real, ran = jobs.run_experiment, []

    def fails_at_first(conf, out, *args):
        ran.append(conf.train.seed)
        if conf.train.seed == 1 and ran.count(1) == 1:
            raise RuntimeError("no memory just now.")
        return real(conf, out, *args)

    monkeypatch.setattr(jobs, "run_experiment", fails_at_first)
    (code, first), (again, second) = run("train.seed=0,1,2"), run("train.seed=0,1,2")
    assert (code, again) == (1, 0) and ran == [0, 1, 2, 1]
    assert first[1] == math.inf and second == [first[0], float(table()[1]["loss"]), first[2]]
    assert [row["status"] for row in table()] == ["finished"] * 3
    assert [row["job"] for row in table()] == ["0", "1", "2"]


class Killed(BaseException):
    """Stands for a kill: nothing of ours catches it."""


@pytest.mark.parametrize("where", ["first step", "second step", "before the outcome", "before the table"])
def test_the_same_command_goes_on_after_a_kill(run, monkeypatch, where):
    """The job that was killed is resumed from its checkpoint and ends as one that was not; those before are not run again."""
    run("train.seed=0,1", "hydra.sweep.dir=whole")
    owner, name, nth = {
        "first step": (train, "optimise", 2),
        "second step": (train, "optimise", 3),
        "before the outcome": (sweep, "record", 1),
        "before the table": (sweep, "tabulate", 1),
    }[where]
    real, calls = getattr(owner, name), []

    def dies(*args, **kwargs):
        calls.append(1)
        if len(calls) == nth + 1:
            raise Killed
        return real(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, dies)
        with pytest.raises(Killed):
            run("train.seed=0,1")
    steps, step = [], optimisation.attempt
    monkeypatch.setattr(
        optimisation, "attempt", lambda runs, *args: steps.append(runs.all[0].iteration) or step(runs, *args)
    )
    assert run("train.seed=0,1")[0] == 0
    assert steps == {"first step": [0, 1], "second step": [1]}.get(where, [])
    rows = table()
    assert [row["status"] for row in rows] == ["finished"] * 2
    for row in rows:
        other = Path("whole") / row["job"]
        assert losses(Path(row["folder"])) == losses(other)
        assert float(row["loss"]) == sweep.outcome(other).loss


def test_a_wish_to_stop_ends_the_sweep(run, monkeypatch):
    """The job in progress is saved and has no row; the next ones do not begin; the same command goes on."""
    real = jobs.run_experiment

    def stopped(conf, out, group, signals, begin):
        signals.awaited = lambda **_: contextlib.nullcontext(lambda: conf.train.seed == 1)
        return real(conf, out, group, signals, begin)

    with monkeypatch.context() as patch:
        patch.setattr(jobs, "run_experiment", stopped)
        code, objectives = run("train.seed=0,1,2")
    assert code == 0 and len(objectives) == 1 and [row["job"] for row in table()] == ["0"]
    (folder,) = Path("outputs/sweep").iterdir()
    assert checkpoint.load(folder / "1")["iteration"] == 0 and not (folder / "2").exists()
    assert run("train.seed=0,1,2")[0] == 0
    assert [row["status"] for row in table()] == ["finished"] * 3


def test_more_iterations_go_on_with_every_job(run):
    """What a resumed run may change, a sweep that goes on may too; other settings are refused, and nothing is touched."""
    into = "hydra.sweep.dir=outputs/sweep/all"
    run("train.seed=0,1", into)
    assert run("train.seed=0,1", "train.iterations=3", into)[0] == 0
    assert [row["iterations"] for row in table()] == ["3", "3"]
    assert load(Path("outputs/sweep/all/0")).train.iterations == 3
    before = {
        path: path.read_bytes() for path in Path("outputs").rglob("*.*") if path.name != "multirun.yaml"
    }
    code, objectives = run("train.seed=5,6", into)
    assert code == 1 and objectives == []
    assert before == {path: path.read_bytes() for path in before}


def test_a_run_in_progress_is_left_alone(run, capsys):
    """Another process that works on a job keeps it: the sweep ends, and no outcome is written over it."""
    run("train.seed=0")
    (path,) = Path("outputs/sweep").glob("*/0/outcome.json")
    path.unlink()
    with checkpoint.locked(path.parent):
        code, _ = run("train.seed=0")
    assert code == 1 and not path.exists() and "another run is writing" in capsys.readouterr().err


def test_a_sweep_does_not_resume_folders(run):
    """``resume`` is for one run: as a job it fails in a sentence."""
    run("train.seed=0")
    assert run("resume=outputs", "hydra.sweep.dir=other")[0] == 1
    assert "resume=FOLDER is for one run" in sweep.outcome(Path("other/0")).error


def test_a_spoilt_outcome_is_named(run, capsys):
    """Not taken for a finished job, and not written over."""
    run("train.seed=0")
    (path,) = Path("outputs/sweep").glob("*/0/outcome.json")
    content = json.loads(path.read_text())
    for spoilt in ("{", "[]", json.dumps(content | {"status": "well"}), json.dumps(content | {"more": 1})):
        path.write_text(spoilt)
        assert run("train.seed=0")[0] == 1
        assert "outcome.json is no outcome of a job" in capsys.readouterr().err and path.read_text() == spoilt


def test_the_last_seed_that_failed_finishes_its_job(tmp_path):
    """Resumed alone, it leaves a table with a row for each seed in the folder of the job and of the sweep, and a job that finished."""
    job, about = tmp_path / "0", dict(job=0, settings="")
    ends = [("finished", 0.1), ("finished", 0.3), ("failed", math.inf)]
    for seed, (status, loss) in enumerate(ends):
        (job / f"seed_{seed}").mkdir(parents=True)
        own = about | dict(seed=seed, folder=str(job / f"seed_{seed}"))
        sweep.record(job / f"seed_{seed}", sweep.Outcome(status=status, loss=loss, **own))
    sweep.record(job, sweep.Outcome(status="failed", error="seed 2 failed", folder=str(job), **about))
    for folder in (job, tmp_path):
        sweep.tabulate(folder)
    own = about | dict(seed=2, folder=str(job / "seed_2"))
    sweep.update(job / "seed_2", sweep.Outcome(status="finished", loss=0.2, **own))
    for folder in (job, tmp_path):
        with open(folder / sweep.TABLE, newline="") as file:
            rows = list(csv.DictReader(file))
        assert [(row["seed"], row["status"], row["loss"]) for row in rows] == [
            *(("0", "finished", "0.1"), ("1", "finished", "0.3"), ("2", "finished", "0.2"))
        ]
    whole = sweep.outcome(job)
    assert whole is not None and (whole.status, whole.loss, whole.error) == ("finished", 0.2, "")


def test_a_copy_of_a_job_is_no_job(tmp_path):
    """Such as a backup beside it; a copy of the whole sweep is one."""
    for name in ("0", "1"):
        (tmp_path / "sweep" / name).mkdir(parents=True)
        about = dict(job=int(name), settings="", folder=f"sweep/{name}")
        sweep.record(tmp_path / "sweep" / name, sweep.Outcome(status="finished", loss=0.1, **about))
    shutil.copytree(tmp_path / "sweep" / "0", tmp_path / "sweep" / "0_backup")
    shutil.copytree(tmp_path / "sweep", tmp_path / "copy")
    for folder in (tmp_path / "sweep", tmp_path / "copy"):
        sweep.tabulate(folder)
        with open(folder / sweep.TABLE, newline="") as file:
            assert [row["job"] for row in csv.DictReader(file)] == ["0", "1"]


def test_folders_are_named_by_the_command():
    """The same words, the same folder; others, another; never a name that a file system or a person stumbles over."""
    name = sweep.folder_name
    assert name(["task=arm", "train.seed=0,1,2"]) == "task=arm,train.seed=0,1,2"
    lists = [name([f"task.goal=[0.5,{y}]"]) for y in ("0.3", "0.4")]
    assert lists[0] != lists[1] and lists[0].startswith("task.goal=_0.5,0.3_-")
    assert len(name(["train.seed=" + ",".join(map(str, range(99)))])) == sweep.LONGEST + 9
    assert not {"/", " ", "$"} & set(name(["a=${b}", "../c= d"])) and name([".."]) != ".." and name([])
