import math

import pytest

from softmpm_learn.table import Table


def test_numbers_read_back_to_the_last_bit(tmp_path):
    """Floats are written so that they come back equal; nan and missing values are empty cells."""
    table = Table(tmp_path / "t.csv", ["a", "b", "c"])
    table.append(0, {"a": 0.1 + 0.2, "b": math.nan})
    header, row = (tmp_path / "t.csv").read_text().splitlines()
    assert header == "iteration,a,b,c"
    assert float(row.split(",")[1]) == 0.1 + 0.2 and row.split(",")[2:] == ["", ""]


def test_resuming_cuts_back_whole_and_broken_rows(tmp_path):
    """Rows of iterations that are done again go, a row cut short goes; what follows equals a file never cut."""
    path, other = tmp_path / "t.csv", tmp_path / "other.csv"
    table, unbroken = Table(path, ["a"]), Table(other, ["a"])
    for k in range(4):
        table.append(k, {"a": k / 3})
        unbroken.append(k, {"a": k / 3})
    path.write_text(path.read_text()[:-5])
    table = Table(path, ["a"], rows=2)
    for k in (2, 3):
        table.append(k, {"a": k / 3})
    assert path.read_bytes() == other.read_bytes()


def test_mistakes_are_named(tmp_path):
    """A column that is not there, and a file with too few rows or other columns, are errors."""
    path = tmp_path / "t.csv"
    table = Table(path, ["a"])
    with pytest.raises(ValueError, match="no column typo"):
        table.append(0, {"typo": 1.0})
    with pytest.raises(ValueError, match="should have 3 rows"):
        Table(path, ["a"], rows=3)
    table.append(0, {"a": 1.0})
    with pytest.raises(ValueError, match="should have 1 rows"):
        Table(path, ["a", "b"], rows=1)
