"""Jobs of a sweep side by side: what each gives is what it gives alone."""

import csv
import dataclasses
import gc
import math
import signal
import sys
import types
import weakref
from pathlib import Path

import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper

from softmpm_learn import train
from softmpm_learn.command import app, experiment, jobs
from softmpm_learn.command.jobs import Job, side_by_side
from softmpm_learn.command.stop import Signals
from softmpm_learn.config import RunConf
from softmpm_learn.settings import ObserverConf, OptimizerConf, TrainConf
from softmpm_learn.storage.sweep import Outcome
from softmpm_learn.tasks import ArmConf, BipedConf

pytestmark = pytest.mark.usefixtures("in_folder")

TINY = [
    *("task=arm", "task.seconds=0.05", "task.control_period=0.025", "task.hold=0.05", "device=cpu"),
    *("device.dtype=float64", "policy=linear", "train.iterations=2", "train.examine=false"),
    *("train.record_every=0", "train.pictures=false", "hydra/job_logging=none", "hydra/hydra_logging=none"),
    "policy.clock=true",  # so that the arm moves from the first step on
]
CHOICES = ("observer=centroids,nothing", "design=off,particle", "train.seeds=2")


@pytest.fixture
def run(monkeypatch):
    """Runs a sweep in this process; gives the exit code and the rows of its table."""

    def go(folder: str, *words: str) -> tuple[int, list[dict[str, str]]]:
        words = (*TINY, *words, f"hydra.sweep.dir={folder}")
        monkeypatch.setattr(sys, "argv", ["softmpm_learn", "-m", *words])
        GlobalHydra.instance().clear()
        code = 0
        try:
            app.main()
        except SystemExit as stop:
            code = stop.code
        path = Path(folder) / "sweep.csv"
        return code, list(csv.DictReader(path.read_text().splitlines())) if path.exists() else []

    return go


@pytest.fixture
def begun(monkeypatch) -> list[int]:
    """Numbers of jobs in each simulation that was begun."""
    real, found = jobs.experiments, []
    monkeypatch.setattr(
        jobs, "experiments", lambda chosen, *rest: found.append(len(chosen)) or real(chosen, *rest)
    )
    return found


def assert_same(rows: list[dict[str, str]], want: list[dict[str, str]]) -> None:
    assert [(row["job"], row["seed"], row["status"]) for row in rows] == [
        (row["job"], row["seed"], row["status"]) for row in want
    ]
    for row, other in zip(rows, want, strict=True):
        assert float(row["loss"]) == pytest.approx(float(other["loss"]), rel=1e-9)
        for name in ("config.yaml", "metrics.csv"):
            texts = [(Path(one["folder"]) / name).read_text() for one in (row, other)]
            assert len(texts[0].splitlines()) == len(texts[1].splitlines())


def test_jobs_side_by_side_are_jobs_one_after_another(run, begun):
    """Four jobs of two seeds in one simulation: rows, losses and files of each; the same command begins nothing again."""
    code, want = run("apart", *CHOICES, "train.side_by_side=1")
    again, found = run("together", *CHOICES, "train.side_by_side=9")
    assert (code, again, begun) == (0, 0, [1, 1, 1, 1, 4]) and len(found) == 8
    assert_same(found, want)
    assert len({(Path(row["folder"]) / "metrics.csv").read_text() for row in found}) == 8
    assert run("together", *CHOICES, "train.side_by_side=9") == (0, found) and len(begun) == 5


def test_a_job_that_cannot_begin_leaves_the_others(run, begun, capsys):
    """What fails side by side goes on one after another, so that only the job with the wrong settings has failed."""
    choices = ("observer=kmeans", "observer.clusters=100000,3", "train.side_by_side=2")
    code, (failed, finished) = run("sweep", *choices)
    assert code == 1 and begun == [2, 1, 1]
    assert (failed["status"], finished["status"]) == ("failed", "finished")
    assert failed["seed"] == finished["seed"] == "0"
    assert "observer.clusters must not be above" in failed["error"] and math.isfinite(float(finished["loss"]))
    assert "softmpm_learn: job 0: observer.clusters" in capsys.readouterr().err


def test_what_failed_side_by_side_is_freed_before_the_jobs_go_on(run, monkeypatch):
    """Or a GPU on which all of them had no room would have none for one of them either."""
    real, build, models, alive = jobs.experiments, experiment.make_model, [], []

    def built(*args):
        model = build(*args)
        models.append(weakref.ref(model))
        return model

    def noted(*args):
        alive.append(sum(model() is not None for model in models))
        return real(*args)

    monkeypatch.setattr(experiment, "make_model", built)
    monkeypatch.setattr(jobs, "experiments", noted)
    gc.disable()
    try:
        run("sweep", "observer=kmeans", "observer.clusters=100000,3", "train.side_by_side=2")
    finally:
        gc.enable()
    assert alive[:2] == [0, 0] and len(models) == 3


class Killed(BaseException):
    """Stands for a kill: nothing of ours catches it."""


def test_the_same_command_goes_on_after_a_kill(run, begun, monkeypatch):
    """Jobs that were killed side by side are resumed side by side."""
    choices = ("observer=centroids,nothing", "train.side_by_side=2")
    _, want = run("whole", *choices)
    real, calls = train.optimise, iter(range(99))

    def dies(*args):
        if next(calls) == 1:
            raise Killed
        return real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(train, "optimise", dies)
        with pytest.raises(Killed):
            run("killed", *choices)
    code, found = run("killed", *choices)
    assert code == 0 and begun == [2, 2, 2]
    assert_same(found, want)


def test_what_is_part_of_the_simulation_is_in_common(tmp_path):
    """Other tasks and other fades are other simulations, and so are more jobs than may go together."""

    def made(number: int, task, **settings) -> Job:
        conf = RunConf(task=task, train=TrainConf(side_by_side=3), **settings)
        return Job(number=number, settings="", out=tmp_path, table=tmp_path, conf=conf)

    fade = OptimizerConf(fade=0.5)
    some = [made(k, ArmConf() if k < 5 else BipedConf()) for k in range(7)]
    some += [
        made(7, BipedConf(), optimizer=fade),
        made(8, BipedConf(), observer=ObserverConf(name="nothing")),
    ]
    assert [[one.number for one in group] for group in side_by_side(some)] == [
        [0, 1, 2],
        [3, 4],
        [5, 6, 8],
        [7],
    ]


class Choosy(Sweeper):
    """Stands for a sweeper that chooses a job by the losses of those before."""

    __module__ = "hydra_plugins.choosy"  # where Hydra has its plugins

    def setup(self, **about):
        self.launcher = Plugins.instance().instantiate_launcher(**about)

    def sweep(self, arguments):
        return self.launcher.launch([arguments], 0)


def test_a_sweeper_that_needs_each_loss_is_told(run, monkeypatch, capsys):
    """Before anything begins."""
    place = types.ModuleType(Choosy.__module__)
    place.Choosy = Choosy
    plugins = Plugins.instance()  # it looks for plugins when it is made, in the real package
    monkeypatch.setitem(sys.modules, "hydra_plugins", types.ModuleType("hydra_plugins"))
    monkeypatch.setitem(sys.modules, Choosy.__module__, place)
    plugins.register(Choosy)
    about = {"_target_": f"{Choosy.__module__}.Choosy"}
    ConfigStore.instance().store(group="hydra/sweeper", name="choosy", node=about, provider="test")
    code, rows = run("sweep", "hydra/sweeper=choosy", "train.side_by_side=2")
    assert code == 1 and rows == []
    assert "this sweeper needs the loss of one to choose the next; set it to 1" in capsys.readouterr().err


def test_jobs_side_by_side_are_of_one_kind_of_run(tmp_path):
    """Settings of different simulations are refused, with the setting by name."""
    conf = RunConf(task=ArmConf(seconds=0.05, hold=0.05))
    other = dataclasses.replace(conf, optimizer=OptimizerConf(fade=0.5))
    with pytest.raises(ValueError, match=r"runs side by side share optimizer\.fade"):
        jobs.run_side_by_side([(conf, tmp_path / "a"), (other, tmp_path / "b")])


def test_processes_in_step_record_each_job(tmp_path, monkeypatch):
    """Results are of processes in step: of two jobs side by side, the one that failed ends neither the command nor the other's row."""
    table = tmp_path / "sweep.csv"
    ended = [Outcome(job=0, status="failed", error="no way back", settings="", folder="0")]
    ended += [Outcome(job=1, status="finished", loss=1.5, settings="", folder="1")]
    some = [Job(number=k, settings="", out=tmp_path / str(k), table=table) for k in range(2)]
    for one in some:
        one.out.mkdir()
    failed, group = {}, types.SimpleNamespace(size=2, rank=0, first=True)
    monkeypatch.setattr(jobs, "experiments", lambda *_: [[None], [None]])
    monkeypatch.setattr(jobs, "outcome", lambda conf, out, *_: ended[int(out.name)])
    assert jobs.run_jobs(some, group, Signals(), failed) == [math.inf, 1.5]
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [row["status"] for row in rows] == ["failed", "finished"] and failed == {0: table}


def test_a_wish_to_stop_in_the_last_iteration_ends_the_sweep(tmp_path, monkeypatch):
    """The job that was about to end is recorded, and no other begins."""
    one, signals = Job(number=0, settings="", out=tmp_path / "0", table=tmp_path / "sweep.csv"), Signals()
    one.out.mkdir()

    def meanwhile(*_):
        with signals.awaited():
            signals._handle(signal.SIGTERM, None)
        return [[None]]

    monkeypatch.setattr(jobs, "experiments", meanwhile)
    done = Outcome(job=0, status="finished", loss=1.5, settings="", folder="0")
    monkeypatch.setattr(jobs, "outcome", lambda *_: done)
    with pytest.raises(SystemExit):
        jobs.run_jobs([one], types.SimpleNamespace(size=1, rank=0, first=True), signals, {})
    (row,) = csv.DictReader(one.table.read_text().splitlines())
    assert row["status"] == "finished"


def test_processes_out_of_step_end_with_the_job(tmp_path, monkeypatch):
    """After an error the processes may wait for each other: the job has its row, and the command ends."""
    one = Job(number=0, settings="", out=tmp_path / "0", table=tmp_path / "sweep.csv")
    one.out.mkdir()

    def fails(*_):
        raise jobs.JobError("lost")

    monkeypatch.setattr(jobs, "experiments", fails)
    with pytest.raises(SystemExit):
        jobs.run_jobs([one], types.SimpleNamespace(size=2, rank=0, first=True), Signals(), {})
    (row,) = csv.DictReader(one.table.read_text().splitlines())
    assert (row["status"], row["error"]) == ("failed", "lost")
