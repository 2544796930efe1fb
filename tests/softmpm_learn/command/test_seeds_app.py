"""Seeds side by side from the command line: folders, table, failures, going on, sweeps and several processes."""

import csv
import math
import statistics
import subprocess
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import forked
import pytest

import softmpm
from softmpm_learn.command import experiment, jobs, seeds
from softmpm_learn.config import RunConf
from softmpm_learn.distributed import Group
from softmpm_learn.figures import __main__ as figures
from softmpm_learn.runs.saved import load
from softmpm_learn.settings import TrainConf
from softmpm_learn.storage import checkpoint

pytestmark = pytest.mark.usefixtures("in_folder")

TINY = [
    *("task=arm", "observer=centroids", "task.seconds=0.05", "task.control_period=0.025", "device=cpu"),
    *("policy=linear", "train.iterations=2", "train.examine=false", "device.dtype=float64"),
]

PLAIN = (*TINY, "train.pictures=false", "train.record_every=0")
"""For tests of numbers and rows: pictures and recordings take most of the time of such runs."""
MOVING = (*PLAIN, "policy.clock=true")
"""The arm moves from the first step on."""


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def losses(folder: Path) -> list[float]:
    return [float(row["loss"]) for row in rows(folder / "metrics.csv")]


def fails_in(monkeypatch, world: int) -> None:
    """Simulations fail in this world as long as its muscles are active."""
    real = softmpm.simulate

    def simulate(model, state, activation, *args, **kwargs):
        if model.worlds > world and activation[:, world].abs().max() > 0:
            what = dict(kind="inverted", world=world, particle=3, substep=1, value=-1.0, limit="det F > 0")
            raise softmpm.UnstableError("particle 3 is inverted.", **what)
        return real(model, state, activation, *args, **kwargs)

    monkeypatch.setattr(softmpm, "simulate", simulate)


def test_the_comparison_is_a_sweep(main):
    """One word runs it, without ``-m``; what the command line names replaces its values. Figures are made of what it leaves, and a seed
    that is resumed for it is drawn."""
    words = ("experiment=comparison", *TINY, "observer=nothing,untrained", "policy.clock=false")
    words += ("learning.every=1", "observer.channels=[4]", "train.seeds=2")
    assert main(*words)[0] == 0
    (folder,) = Path("outputs/sweep").iterdir()
    found = rows(folder / "sweep.csv")
    assert [(row["job"], row["seed"]) for row in found] == [
        (str(k), f"90{n}") for k in range(4) for n in (0, 1)
    ]
    assert {row["status"] for row in found} == {"finished"}
    conf = [load(folder / str(k)) for k in range(4)]
    assert [(one.design.enabled, one.observer.name) for one in conf] == [
        *((True, "nothing"), (True, "untrained"), (False, "nothing"), (False, "untrained"))
    ]
    assert {one.task.name for one in conf} == {"arm"} and not any(one.policy.clock for one in conf)
    assert {one.train.save_every for one in conf} == {10}
    assert not list(folder.rglob("run.h5")) and not list(folder.rglob("*.png"))
    figures.make([folder], folder / "figures")
    assert "| off | untrained |" in (folder / "figures" / "summary.md").read_text()
    one = folder / "1" / "seed_900"
    assert main(f"resume='{one}'", "train.record_every=1", "train.pictures=true")[0] == 0
    assert {path.name for path in one.glob("*.png")} == {"loss.png", "robot.png"}  # no latent was learned


def test_each_seed_has_the_folder_of_a_run(main):
    """What it leaves is what the seed alone leaves; the table has a row for each, and the objective is the median."""
    code, (objective,) = main(*TINY, "train.seeds=3", "train.seed=5", "hydra.run.dir=all")
    assert code == 0 and load(Path("all")).train.seeds == 3
    table = rows(Path("all/sweep.csv"))
    assert [row["seed"] for row in table] == ["5", "6", "7"]
    assert {row["status"] for row in table} == {"finished"}
    assert all(row["settings"] == " ".join([*TINY, f"train.seed={row['seed']}"]) for row in table)
    assert objective == statistics.median(float(row["loss"]) for row in table)
    for row in table[1:]:
        seed, place = row["seed"], Path(row["folder"])
        assert main(*TINY, f"train.seed={seed}", f"hydra.run.dir=one{seed}")[0] == 0
        names = {path.name for path in Path(f"one{seed}").iterdir()} - {"run.rrd", "softmpm_learn.log"}
        assert names - {path.name for path in place.iterdir()} == set()
        assert losses(place) == pytest.approx(losses(Path(f"one{seed}")), rel=1e-9)
        assert load(place).train == load(Path(f"one{seed}")).train
        evaluations = [float(one["evaluation"]) for one in rows(place / "metrics.csv") if one["evaluation"]]
        assert float(row["loss"]) == min(evaluations)
        sizes = [(folder / "checkpoint.pt").stat().st_size for folder in (place, Path(f"one{seed}"))]
        assert sizes[0] == pytest.approx(sizes[1], rel=0.01)  # not the weights of the others as well


@pytest.mark.parametrize(("endurance", "what"), [("1", "losses"), ("2", "evaluations")])
def test_the_last_lines_name_what_chose_the_best(main, caplog, endurance, what):
    """The best of each seed is that of its losses, or of its evaluations if there are any; the lines before show losses alone."""
    with caplog.at_level("INFO", logger="softmpm_learn"):
        main(
            *PLAIN,
            "train.seeds=2",
            f"train.endurance={endurance}",
            "hydra.run.dir=all",
        )
    values = [float(row["loss"]) for row in rows(Path("all/sweep.csv"))]
    middle, ends = statistics.median(values), f"{min(values):.5g} to {max(values):.5g}"
    assert f"Best {what} of 2 seeds: median {middle:.5g}, from {ends}." in caplog.text
    lowest = min(loss for k in range(2) for loss in losses(Path(f"all/seed_{k}")))
    assert f", lowest {lowest:.5g}, " in caplog.text


def test_they_go_on_with_resume(main):
    """All with the folder of all, or one with its own."""
    main(*PLAIN, "train.seeds=2", "train.iterations=1", "hydra.run.dir=all")
    assert main("resume=all/seed_1", "train.iterations=2")[0] == 0
    assert [len(losses(Path(f"all/seed_{k}"))) for k in range(2)] == [1, 2]
    assert main("resume=all", "train.iterations=3")[0] == 0
    assert [row["iterations"] for row in rows(Path("all/sweep.csv"))] == ["3", "3"]
    main(*PLAIN, "train.seeds=2", "train.iterations=3", "hydra.run.dir=whole")
    for k in range(2):
        assert losses(Path(f"all/seed_{k}")) == pytest.approx(losses(Path(f"whole/seed_{k}")), rel=1e-9)


def test_a_job_that_is_resumed_keeps_its_number_and_settings(main):
    """In the rows of its seeds, with what was changed; the same command of its sweep has them in its table."""
    words = ("-m", *PLAIN, "train.seeds=2", "train.iterations=1,2", "hydra.sweep.dir=sweep")
    assert main(*words)[0] == 0
    before = rows(Path("sweep/sweep.csv"))
    assert main("resume=sweep/1", "train.iterations=3")[0] == 0
    assert main(*words)[0] == 0
    after = rows(Path("sweep/sweep.csv"))
    assert [(row["job"], row["seed"]) for row in after] == [(row["job"], row["seed"]) for row in before]
    for one, other in zip(before, after, strict=True):
        assert other["settings"] == one["settings"].replace("iterations=2", "iterations=3")


def test_a_run_that_is_resumed_before_a_seed_ended_has_its_settings(main, monkeypatch, caplog):
    """Its rows have those of an unbroken run, with what was changed and the value of one that referred to another. The line on the
    table says that only seeds that have ended have a row."""
    real, words = experiment.train_side_by_side, [*PLAIN, "train.goal_spread=[0.1,${train.iterations}]"]
    with monkeypatch.context() as patch, caplog.at_level("INFO", logger="softmpm_learn"):
        patch.setattr(
            experiment, "train_side_by_side", lambda *a, **k: real(*a, **k | {"stop": lambda: True})
        )
        assert main(*words, "train.seeds=2", "hydra.run.dir=all")[0] == 0
    assert "a folder in all; those that have ended have a row in all/sweep.csv." in caplog.text
    assert main("resume=all", "train.side_by_side=3")[0] == 0
    known = " ".join([*PLAIN, "train.goal_spread=[0.1,2]", "train.side_by_side=3"])
    assert [row["settings"] for row in rows(Path("all/sweep.csv"))] == [
        f"{known} train.seed={k}" for k in range(2)
    ]


def test_a_seed_that_fails_is_a_row_that_says_so(main, monkeypatch, capsys):
    """The exit code tells it, the others finish; the same folder tries it again."""
    with monkeypatch.context() as patch:
        fails_in(patch, world=1)
        code, _ = main(*MOVING, "train.seeds=3", "hydra.run.dir=all")
    said = capsys.readouterr().err
    assert code == 1 and "of 3 seeds these failed: 1. Seed 1: iteration 0: particle 3 is inverted." in said
    table = rows(Path("all/sweep.csv"))
    assert [row["status"] for row in table] == ["finished", "failed", "finished"]
    assert table[1]["loss"] == "inf" and "particle 3 is inverted" in table[1]["error"]
    assert checkpoint.load(Path("all/seed_1"))["iteration"] == 0
    assert main("resume=all")[0] == 0
    assert [row["status"] for row in rows(Path("all/sweep.csv"))] == ["finished"] * 3


def test_a_job_that_fails_as_a_whole_is_a_row_among_older_seeds(main):
    """The outcomes of its seeds are of an earlier command: they are no longer shown as finished, here or in a summary."""
    words = ("-m", *PLAIN, "train.seeds=2", "optimizer.policy_rate=0.01,0.02", "hydra.sweep.dir=sweep")
    assert main(*words)[0] == 0
    for path in Path("sweep/0/seed_0").glob("checkpoint*.pt"):
        path.write_bytes(b"nothing")
    assert main(*words, "train.iterations=4")[0] == 1
    for table in ("sweep/sweep.csv", "sweep/0/sweep.csv"):
        first = rows(Path(table))[0]
        assert (first["status"], first["seed"], first["loss"]) == ("failed", "", "inf") and first["error"]
    assert [row["status"] for row in rows(Path("sweep/sweep.csv"))] == ["failed", "finished", "finished"]
    figures.make([Path("sweep")], Path("figures"))
    assert "2 of 2" in (Path("figures") / "summary.md").read_text()


def test_a_sweep_has_a_row_for_each_seed(main, monkeypatch):
    """A job whose seeds have finished is skipped; one in which a seed failed is tried again, and has no objective."""
    words = ("-m", *MOVING, "train.seeds=2", "optimizer.policy_rate=0.01,0.02", "hydra.sweep.dir=sweep")
    with monkeypatch.context() as patch:
        fails_in(patch, world=1)
        code, objectives = main(*words)
    assert code == 1 and objectives == [math.inf] * 2
    assert [row["status"] for row in rows(Path("sweep/sweep.csv"))] == ["finished", "failed"] * 2
    code, objectives = main(*words)
    table = rows(Path("sweep/sweep.csv"))
    assert code == 0 and [(row["job"], row["seed"]) for row in table] == [
        ("0", "0"),
        ("0", "1"),
        ("1", "0"),
        ("1", "1"),
    ]
    assert all(
        row["status"] == "finished" and "optimizer.policy_rate=0.0" in row["settings"] for row in table
    )
    for job, objective in enumerate(objectives):
        own = [float(row["loss"]) for row in table if row["job"] == str(job)]
        assert objective == pytest.approx(statistics.median(own))
    real = []
    monkeypatch.setattr(jobs, "run_experiment", lambda *args: real.append(args))
    assert main(*words) == (0, objectives) and not real


def test_seeds_that_were_stopped_are_no_outcome(main, monkeypatch):
    """A sweep that is asked to end does so, also where the seeds had finished a shorter run; the same command goes on."""
    words = (
        "-m",
        *(word for word in PLAIN if "iterations" not in word),
        "train.seeds=2",
        "optimizer.policy_rate=0.01,0.02",
        "hydra.sweep.dir=sweep",
    )
    assert main(*words, "train.iterations=1")[0] == 0
    real = experiment.train_side_by_side
    with monkeypatch.context() as patch:
        patch.setattr(
            experiment, "train_side_by_side", lambda *a, **k: real(*a, **k | {"stop": lambda: True})
        )
        code, objectives = main(*words, "train.iterations=2")
    assert code == 0 and objectives == []
    assert main(*words, "train.iterations=2")[0] == 0
    assert [row["iterations"] for row in rows(Path("sweep/sweep.csv"))] == ["2"] * 4


def torchrun(*words: str, cwd: Path) -> subprocess.CompletedProcess:
    start = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", "softmpm_learn")
    return forked.python(*start, *words, folder=cwd)


def test_processes_share_the_seeds(main, tmp_path):
    """Each has its own, without an exchange of gradients: three seeds in two processes are those of one. The last lines are of all."""
    # This run comes first, so that both processes find their kernels compiled.
    assert main(*PLAIN, "train.seeds=3", "hydra.run.dir=one")[0] == 0
    done = torchrun(*PLAIN, "train.seeds=3", "hydra.run.dir=two", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    best = [float(row["loss"]) for row in rows(Path("two/sweep.csv"))]
    middle, ends = statistics.median(best), f"{min(best):.5g} to {max(best):.5g}"
    assert f"Best evaluations of 3 seeds: median {middle:.5g}, from {ends}." in done.stdout
    assert "of the seeds of the first process: 0, 2." in done.stdout
    assert [row["seed"] for row in rows(Path("two/sweep.csv"))] == ["0", "1", "2"]
    for k in range(3):
        assert losses(Path(f"two/seed_{k}")) == pytest.approx(losses(Path(f"one/seed_{k}")), rel=1e-9)


def test_no_process_is_without_a_seed():
    """Two seeds in three processes are refused."""
    conf = RunConf(train=TrainConf(seeds=2))
    said = "train.seeds must be 1, or at least the 3 processes that share the seeds; got 2"
    with pytest.raises(ValueError, match=said):
        seeds.share(conf, Path("all"), SimpleNamespace(size=3, rank=0))


@pytest.mark.parametrize(("alone", "several"), [("1", 1), ("1", 2), ("1/seed_1", 2)])
def test_what_goes_on_alone_has_its_row_in_the_table_of_the_sweep(main, alone, several):
    """A job, with one seed or more, and a seed of one; the others stay as they are."""
    words = ("train.iterations=1", f"train.seeds={several}", "optimizer.policy_rate=0.01,0.02")
    assert main("-m", *PLAIN, *words, "hydra.sweep.dir=sweep")[0] == 0
    before = rows(Path("sweep/sweep.csv"))
    assert main(f"resume=sweep/{alone}", "train.iterations=3")[0] == 0
    after = rows(Path("sweep/sweep.csv"))
    assert [(row["job"], row["seed"]) for row in after] == [(row["job"], row["seed"]) for row in before]
    changed = [row["job"] == "1" and (row["seed"] == "1" or alone == "1") for row in after]
    assert [row["iterations"] for row in after] == ["3" if new else "1" for new in changed]
    assert [row for row, new in zip(after, changed, strict=True) if not new] == before[: changed.count(False)]
    assert main("-m", *PLAIN, *words, "hydra.sweep.dir=sweep")[0] == 0
    assert rows(Path("sweep/sweep.csv")) == after


def test_what_fails_alone_has_failed_in_the_table_of_the_sweep(main, monkeypatch):
    """A job that went on alone and failed is no longer finished; one that could not begin is what it was."""
    words = (*MOVING, "optimizer.retries=0", "train.iterations=1", "train.seed=0,1")
    assert main("-m", *words, "hydra.sweep.dir=sweep")[0] == 0
    before = rows(Path("sweep/sweep.csv"))
    with monkeypatch.context() as patch:
        patch.setattr(softmpm, "build", Mock(side_effect=ValueError("there is no such device.")))
        assert main("resume=sweep/1", "train.iterations=3")[0] == 1
    assert rows(Path("sweep/sweep.csv")) == before
    fails_in(monkeypatch, world=0)
    assert main("resume=sweep/1", "train.iterations=3")[0] == 1
    first, second = rows(Path("sweep/sweep.csv"))
    assert first == before[0] and second["settings"] == before[1]["settings"]
    assert (second["status"], second["iterations"], second["loss"]) == ("failed", "1", "inf")
    assert "particle 3 is inverted" in second["error"]


def test_a_run_without_a_sweep_has_no_table(main):
    """Nothing is written beside its folder."""
    assert main(*PLAIN, "hydra.run.dir=lone/run")[0] == 0
    assert [path.name for path in Path("lone").iterdir()] == ["run"]


def test_a_setting_with_spaces_stays_as_it_is(tmp_path):
    """In the rows of the seeds, where its own seed takes the place of theirs."""
    conf, file = RunConf(train=TrainConf(seeds=2)), "task.file='my  robot.png'"
    results: list = [
        SimpleNamespace(
            run=SimpleNamespace(settings=one, iteration=1),
            error=None,
            finished=True,
            best_loss=1.0,
            best_iteration=0,
            examination={},
        )
        for one in seeds.split(conf.settings)
    ]
    about = {"job": 0, "settings": f"task=image {file} train.seeds=2", "folder": str(tmp_path)}
    for one in (0, 1):
        seeds.folder(tmp_path, one).mkdir()
    seeds.record(conf, tmp_path, results, Group(), about)
    found = [row["settings"] for row in rows(tmp_path / "sweep.csv")]
    assert found == [f"task=image {file} train.seed={one}" for one in (0, 1)]
