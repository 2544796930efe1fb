"""Loggers: what they receive is what metrics.csv and timing.csv have, each row once, whatever becomes of the run or of them."""

import csv
import dataclasses
import itertools
import logging
import math
import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer import event_file_writer

from softmpm_learn import register, train
from softmpm_learn.command import app
from softmpm_learn.command.pictures import DRAWN
from softmpm_learn.loggers import Loggers
from softmpm_learn.register import LOGGERS
from softmpm_learn.settings import TrainConf
from softmpm_learn.storage import checkpoint


class Killed(BaseException):
    """Stands for a kill: nothing of ours catches it."""


@pytest.fixture(autouse=True)
def fresh_table(monkeypatch):
    """What a test registers is forgotten after it."""
    monkeypatch.setattr(LOGGERS, "_entries", dict(LOGGERS._all()))


def numbers(path: Path, prefix: str = "") -> dict[tuple[str, int], float]:
    """All cells of a table that are not empty, by column and iteration."""
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        (prefix + name, int(row["iteration"])): float(value)
        for row in rows
        for name, value in row.items()
        if value and name != "iteration"
    }


def written(out: Path) -> dict[tuple[str, int], float]:
    """What the files of a run have."""
    return numbers(out / "metrics.csv") | numbers(out / "timing.csv", "seconds/")


def rounded(cells: dict[tuple[str, int], float]) -> dict[tuple[str, int], float]:
    """In single precision."""
    return {key: float(np.float32(value)) for key, value in cells.items()}


def events(out: Path) -> EventAccumulator:
    found = EventAccumulator(str(out / "tensorboard"), size_guidance={"scalars": 0, "images": 0})
    return found.Reload()


def shown(out: Path) -> dict[tuple[str, int], float]:
    """What TensorBoard shows, as often as it does."""
    found = events(out)
    pairs = []
    for name in found.Tags()["scalars"]:
        pairs += [((name, event.step), event.value) for event in found.Scalars(name)]
    assert len(pairs) == len(dict(pairs)), "a step is there twice"
    return dict(pairs)


def logged(settings, *names, **changes):
    """The settings with these loggers, and with changes of those of the training."""
    conf = dataclasses.replace(settings.train, log=list(names), **changes)
    return dataclasses.replace(settings, train=conf)


def test_tensorboard_has_what_the_tables_have(task, model, settings, tmp_path):
    """Every number, rounded to single precision; empty cells are left out; the run is the same as without."""
    train.train(task, model, logged(settings, "tensorboard"), tmp_path / "a")
    assert shown(tmp_path / "a") == rounded(written(tmp_path / "a"))
    assert ("loss", 4) in shown(tmp_path / "a") and ("seconds/learn", 4) in shown(tmp_path / "a")
    assert ("epochs", 2) not in shown(tmp_path / "a")
    train.train(task, model, settings, tmp_path / "b")
    tables = [(tmp_path / name / "metrics.csv").read_bytes() for name in "ab"]
    assert tables[0] == tables[1] and not (tmp_path / "b" / "tensorboard").exists()


@pytest.mark.parametrize("where", ["row", "checkpoint"])
def test_tensorboard_of_a_killed_run_that_goes_on(task, model, settings, tmp_path, monkeypatch, where):
    """Killed after a row was shown and before the checkpoint, or after it: no step is lost, none is there twice."""
    settings, calls = logged(settings, "tensorboard"), iter(range(99))
    owner, name = {"row": (train.RunFiles, "save"), "checkpoint": (train, "optimise")}[where]
    real = getattr(owner, name)

    def dies(*args):
        if next(calls) == 3:
            raise Killed
        return real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, dies)
        with pytest.raises(Killed):
            train.train(task, model, settings, tmp_path)
    assert ("loss", 2) in shown(tmp_path) and checkpoint.load(tmp_path)["iteration"] == (
        2 if where == "row" else 3
    )
    train.train(task, model, settings, tmp_path)
    assert shown(tmp_path) == rounded(written(tmp_path))
    assert {k for name, k in shown(tmp_path) if name == "loss"} == set(range(5))


def test_tensorboard_reads_sessions_in_their_order(tmp_path, monkeypatch):
    """Also where two begin in the same second, as the tenth and the eleventh of a process, whose names sort the other way round."""
    numbers = itertools.count(9)
    monkeypatch.setattr(event_file_writer._global_uid, "get", lambda: next(numbers))
    for iteration in range(2):
        with Loggers(["tensorboard"], tmp_path) as loggers:
            loggers.open(iteration, {"tensorboard": iteration}, {})
            loggers.scalars(iteration, {"loss": 0.5}, None)
    assert shown(tmp_path) == {("loss", 0): 0.5, ("loss", 1): 0.5}


def test_a_logger_that_comes_later_gets_what_was_before(task, model, settings, tmp_path):
    """Resumed with TensorBoard, then without, then with it again: it has all rows."""
    for count, names in ((2, ()), (3, ("tensorboard",)), (4, ()), (5, ("tensorboard",))):
        train.train(task, model, logged(settings, *names, iterations=count), tmp_path)
    assert shown(tmp_path) == rounded(written(tmp_path))


def test_tensorboard_has_the_pictures(tmp_path):
    """With the pixels of the file; one that was not drawn is left out."""
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    Image.fromarray(pixels).save(tmp_path / "robot.png")
    with Loggers(["tensorboard"], tmp_path) as loggers:
        loggers.open(0, {}, {"task": "block"})
        loggers.pictures(7, [tmp_path / "robot.png", tmp_path / "latent.png"])
    found = events(tmp_path)
    assert found.Tags()["images"] == ["pictures/robot"]
    (image,) = found.Images("pictures/robot")
    (tmp_path / "again.png").write_bytes(image.encoded_image_string)
    assert image.step == 7 and (np.asarray(Image.open(tmp_path / "again.png")) == pixels).all()


class FakeRun:
    """Stands for a run of wandb: rows by step. The real one ignores a step that is not above the last."""

    def __init__(self, server: dict, options: dict):
        self.options, self.rows, self.finished = options, server.setdefault(options["id"], {}), False
        self.starting_step = max(self.rows, default=-1) + 1

    def define_metric(self, *names, **options): ...

    def log(self, row, *, step, commit):
        assert commit and step > max(self.rows, default=-1), "what wandb would ignore"
        self.rows[step] = row

    def finish(self):
        self.finished = True


@pytest.fixture
def wandb(monkeypatch):
    """A module in the place of wandb: runs that began, and what the server has."""
    module = types.ModuleType("wandb")
    module.server, module.runs = {}, []

    def init(**options):
        module.runs.append(FakeRun(module.server, options))
        return module.runs[-1]

    module.init, module.Image = init, lambda path: ("picture", Path(path).name)
    monkeypatch.setitem(sys.modules, "wandb", module)
    return module


def cells(module) -> dict[tuple[str, int], object]:
    """What the only run of the server has."""
    (rows,) = module.server.values()
    pairs = [((name, row["iteration"]), row[name]) for row in rows.values() for name in row]
    pairs = [pair for pair in pairs if pair[0][0] != "iteration"]
    assert len(pairs) == len(dict(pairs)), "a value is there twice"
    return dict(pairs)


@pytest.mark.parametrize("sent", ["all", "late", "nothing"])
@pytest.mark.parametrize("where", ["row", "checkpoint"])
def test_wandb_has_each_row_once(task, model, settings, tmp_path, monkeypatch, wandb, where, sent):
    """Killed after a row and before its checkpoint, or after it, when wandb had sent everything, had not sent the last rows, or was
    offline, where every session begins anew."""
    settings, calls = logged(settings, "wandb"), iter(range(99))
    owner, name = {"row": (train.RunFiles, "save"), "checkpoint": (train, "optimise")}[where]
    real = getattr(owner, name)

    def dies(*args):
        if next(calls) == 3:
            raise Killed
        return real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, dies)
        with pytest.raises(Killed):
            train.train(task, model, settings, tmp_path)
    (rows,) = wandb.server.values()
    for step in sorted(rows)[{"all": 3, "late": 1, "nothing": 0}[sent] :]:
        del rows[step]
    train.train(task, model, settings, tmp_path)
    first, second = wandb.runs
    assert (
        first.options["id"] == second.options["id"]
        and second.options["resume"] == "allow"
        and second.finished
    )
    assert second.options["config"]["task"] == "block" and "mode" not in second.options
    found, expected = cells(wandb), written(tmp_path)
    assert found.keys() == expected.keys()
    assert all(found[key] == expected[key] for key in expected if not key[0].startswith("seconds/"))


def test_wandb_has_pictures_and_examination_once(tmp_path, wandb):
    """A finished run that is resumed examines and draws again; one with more iterations has a row where the examination was, and
    pictures after it."""
    Image.new("RGB", (4, 4)).save(tmp_path / "loss.png")

    def ends(*rows, iteration=0):
        with Loggers(["wandb"], tmp_path) as loggers:
            loggers.open(iteration, {"wandb": iteration}, {"task": "block"})
            for row in rows:
                loggers.scalars(iteration, row, None)
            loggers.pictures(iteration, [tmp_path / "loss.png"])

    ends({"later": 0.9, "finer": math.nan})
    ends({"later": 0.9})
    picture = ("picture", "loss.png")
    assert cells(wandb) == {("later", 0): 0.9, ("pictures/loss", 0): picture}
    ends({"loss": 1.0})
    (rows,) = wandb.server.values()
    assert list(rows.values())[2:] == [
        {"iteration": 0, "loss": 1.0},
        {"iteration": 0, "pictures/loss": picture},
    ]


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_missing_package_ends_the_run_before_it_begins(task, model, settings, tmp_path, monkeypatch, name):
    """With the command that installs it; nothing was simulated, and the same folder works without the logger."""
    monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(train, "optimise", lambda *_: pytest.fail("simulated"))
    begun = []
    with pytest.raises(ImportError, match=rf'pip install "softmpm\[{name}\]"'):
        train.train(task, model, logged(settings, name), tmp_path, begin=lambda: begun.append(1))
    assert not begun and not checkpoint.exists(tmp_path)
    monkeypatch.undo()
    train.train(task, model, logged(settings, iterations=1), tmp_path)


class Fragile:
    """A logger that fails in an iteration, in its first session."""

    def __init__(self, rows: list, fails: int):
        self.rows, self.fails = rows, fails

    def scalars(self, iteration, row):
        if iteration == self.fails:
            raise OSError("no room")
        self.rows.append((iteration, row["loss"]))

    def picture(self, iteration, name, path): ...

    def close(self):
        raise OSError("still none")


def test_a_logger_that_fails_is_switched_off(task, model, settings, tmp_path, caplog):
    """One warning; the run goes on as if it were not there, and a resumed run hands it what it has missed."""
    rows, begins = [], []

    @register.logger("fragile")
    def fragile(out, first, settings):
        begins.append(first)
        return Fragile(rows, 2 if len(begins) == 1 else -1)

    with caplog.at_level(logging.WARNING, "softmpm_learn"):
        train.train(task, model, logged(settings, "fragile", iterations=4), tmp_path)
    (said,) = [record.getMessage() for record in caplog.records]
    assert "fragile failed in iteration 2 and is switched off" in said and "OSError: no room" in said
    train.train(task, model, logged(settings, "fragile"), tmp_path)
    losses = {k: value for (name, k), value in numbers(tmp_path / "metrics.csv").items() if name == "loss"}
    assert begins == [0, 2] and rows == sorted(losses.items())


def test_a_logger_that_cannot_begin_ends_the_run(task, model, settings, tmp_path):
    """In a sentence with its name, whatever it raises; the recording is closed."""

    @register.logger("broken")
    def broken(out, first, settings):
        raise KeyError("token")

    with pytest.raises(
        RuntimeError, match=r"the logger broken of train\.log cannot begin: KeyError: 'token'"
    ):
        train.train(task, model, logged(settings, "broken", record_every=1), tmp_path)
    train.train(task, model, logged(settings, iterations=1, record_every=1), tmp_path)


def test_names_are_checked():
    """With the settings, before anything is built."""
    for names in (["tensorbord"], ["wandb", "wandb"]):
        with pytest.raises(ValueError, match=r"train\.log must have names of loggers.*tensorboard, wandb"):
            TrainConf(log=names)
    with pytest.raises(ValueError, match=r"logger 'mine' must take \(out, first, settings\)"):
        register.logger("mine")(lambda out: None)


@pytest.fixture
def main(monkeypatch):
    """``python -m softmpm_learn`` in this process, with a tiny task unless a run is resumed."""
    monkeypatch.setattr(logging.getLogger(), "handlers", logging.getLogger().handlers[:])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    tiny = "task=arm task.seconds=0.05 task.control_period=0.025 device=cpu policy=linear learning.epochs=1"

    def go(*words: str) -> None:
        words = (*tiny.split(), *words) if not words[0].startswith("resume=") else words
        quiet = ["hydra/job_logging=none", "hydra/hydra_logging=none"]
        monkeypatch.setattr(sys, "argv", ["softmpm_learn", *words, *quiet])
        GlobalHydra.instance().clear()
        app.main()

    yield go
    GlobalHydra.instance().clear()


@pytest.mark.parametrize("seeds", [1, 2])
def test_an_experiment_shows_its_pictures(tmp_path, main, seeds):
    """From the command line: tables, examination and the three pictures, at the iteration after the last; each of several seeds its
    own, the first one alone also while it learns.
    """
    out = tmp_path / "run"
    main("train.iterations=2", "train.log=[tensorboard]", f"train.seeds={seeds}", f"hydra.run.dir={out}")
    places = [out] if seeds == 1 else [out / f"seed_{k}" for k in range(seeds)]
    for k, place in enumerate(places):
        assert shown(place) == rounded(written(place)) and ("later", 2) in shown(place)
        found = events(place)
        steps = {name: [one.step for one in found.Images(f"pictures/{name}")] for name in DRAWN}
        sketched = [] if k else [0]
        assert steps == {"loss": [*sketched, 2], "robot": [*sketched, 2], "latent": [2]}
    assert len({shown(place)["loss", 0] for place in places}) == seeds
    assert seeds == 1 or not (out / "tensorboard").exists()


def test_seeds_that_go_on_with_a_logger_have_all_rows(tmp_path, main):
    """It may come when all of them are resumed, or one alone."""
    words = "train.seeds=2", "train.examine=false", "train.record_every=0", "train.pictures=false"
    main("train.iterations=1", *words, f"hydra.run.dir={tmp_path}")
    main(f"resume={tmp_path}/seed_1", "train.iterations=2", "train.log=[tensorboard]")
    main(f"resume={tmp_path}", "train.iterations=3", "train.log=[tensorboard]")
    for k in range(2):
        place = tmp_path / f"seed_{k}"
        assert shown(place) == rounded(written(place)) and ("loss", 2) in shown(place)


def test_the_logger_of_the_documentation_works(task, model, settings, tmp_path, capsys):
    """It is registered, and prints what it is there for."""
    page = (Path(__file__).parents[3] / "docs" / "learning.md").read_text()
    (code,) = [
        block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "register.logger" in block
    ]
    exec(code, {})
    train.train(task, model, logged(settings, "alarm", iterations=1), tmp_path)
    assert not capsys.readouterr().out
    LOGGERS.build("alarm", {}, tmp_path, 0, {}).scalars(3, {"retries": 4.0})
    assert capsys.readouterr().out == "iteration 3 needed 4 retries\n"
