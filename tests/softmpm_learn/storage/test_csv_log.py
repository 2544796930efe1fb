import dataclasses
import logging
import math

import pytest

import softmpm
from softmpm_learn.objective import Effort, Objective
from softmpm_learn.register import TASKS
from softmpm_learn.runs.run import Run
from softmpm_learn.storage.csv_log import Table
from softmpm_learn.tasks import make_task
from softmpm_learn.training.run_files import metrics


def test_numbers_read_back_to_the_last_bit(tmp_path):
    """Floats are written so that they come back equal; nan and missing values are empty cells."""
    table = Table(tmp_path / "t.csv", ["a", "b", "c"])
    table.append(0, {"a": 0.1 + 0.2, "b": math.nan})
    table.flush()
    header, row = (tmp_path / "t.csv").read_text().splitlines()
    assert header == "iteration,a,b,c"
    assert float(row.split(",")[1]) == 0.1 + 0.2 and row.split(",")[2:] == ["", ""]


def test_resuming_cuts_back_whole_and_broken_rows(tmp_path):
    """Rows of repeated iterations are removed, as is an incomplete row; what follows equals a file never cut."""
    path, other = tmp_path / "t.csv", tmp_path / "other.csv"
    table, unbroken = Table(path, ["a"]), Table(other, ["a"])
    for k in range(4):
        table.append(k, {"a": k / 3})
        unbroken.append(k, {"a": k / 3})
        table.flush()
        unbroken.flush()
        if k == 1:
            seal = table.seal
    path.write_text(path.read_text()[:-5])
    table = Table(path, ["a"], seal)
    for k in (2, 3):
        table.append(k, {"a": k / 3})
    table.flush()
    assert path.read_bytes() == other.read_bytes() and table.seal == unbroken.seal


def test_rows_are_written_when_they_are_flushed(tmp_path):
    """Until then neither the file nor its seal has them, and a row that is flushed is not written again."""
    path = tmp_path / "t.csv"
    table = Table(path, ["a"])
    empty = table.seal
    for k in range(2):
        table.append(k, {"a": k / 3})
    assert path.read_text() == "iteration,a\n" and table.seal == empty
    for _ in range(2):
        table.flush()
        assert path.read_text().splitlines() == ["iteration,a", "0,0.0", "1,0.3333333333333333"]
    assert table.seal["bytes"] == path.stat().st_size and Table(path, ["a"], table.seal).seal == table.seal


def test_another_file_is_refused(tmp_path):
    """One other digit before the seal, too few bytes, other columns: errors that name the file; it stays as it is."""
    path = tmp_path / "t.csv"
    table = Table(path, ["a"])
    table.append(0, {"a": 1.25})
    table.flush()
    for content in (b"iteration,a\n0,1.26\n", b"iteration,a\n", b"", b"iteration,a\n0,\xff.25\n"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"t\.csv is damaged or of another run.* move it away"):
            Table(path, ["a"], table.seal)
        assert path.read_bytes() == content
    path.write_bytes(b"iteration,a\n0,1.25\n")
    with pytest.raises(ValueError, match=r"t\.csv should have the columns iteration,a,b"):
        Table(path, ["a", "b"], table.seal)


def test_a_file_that_was_moved_away_begins_anew(tmp_path, caplog):
    """The remedy of the error above works, and the log says what is lost."""
    table = Table(tmp_path / "t.csv", ["a"])
    table.append(0, {"a": 1.0})
    table.flush()
    (tmp_path / "t.csv").unlink()
    with caplog.at_level(logging.WARNING):
        again = Table(tmp_path / "t.csv", ["a"], table.seal)
    again.append(1, {"a": 2.0})
    again.flush()
    assert (tmp_path / "t.csv").read_text() == "iteration,a\n1,2.0\n" and "t.csv is missing" in caplog.text


def test_mistakes_are_named(tmp_path):
    """A column that is not there is an error."""
    with pytest.raises(ValueError, match="no column typo"):
        Table(tmp_path / "t.csv", ["a"]).append(0, {"typo": 1.0})


@pytest.mark.parametrize("name", ["elephant", "arm"])
def test_columns_of_a_run_are_distinct(name, settings, tmp_path):
    """The tilt of the objective and the largest tilt of the examination were both called tilt."""
    task = make_task(TASKS[name].kind(seconds=0.05))
    columns = metrics(Run(task, softmpm.build(task.scene, device="cpu", **task.build), settings, tmp_path))
    assert len(set(columns)) == len(columns) and set(task.objective.names) < set(columns)


@pytest.mark.parametrize("name", ["Loss", "Later", "Iteration", "Run", "Error"])
def test_a_term_with_the_name_of_another_column_is_refused(name, task, model, settings, tmp_path):
    """It would take the place of the other one for whoever reads the file."""
    kind = dataclasses.make_dataclass(name, [], bases=(Effort,), frozen=True, kw_only=True)
    task = dataclasses.replace(task, objective=Objective(kind(), Effort()))
    with pytest.raises(
        ValueError,
        match=f"has a term '{name.lower()}', but metrics.csv or a table of sweeps has another column",
    ):
        metrics(Run(task, model, settings, tmp_path))
