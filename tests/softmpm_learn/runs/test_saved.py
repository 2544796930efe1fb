"""A saved configuration is data: what could read, fill or run anything is refused, and the file is named."""

import os
import time

import pytest

from softmpm_learn.config import RunConf
from softmpm_learn.runs.saved import NAME, load, save
from softmpm_learn.tasks import ArmConf, BipedConf

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(9 * [f'*{a}'])}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.fixture
def text(tmp_path) -> str:
    save(RunConf(task=ArmConf()), tmp_path)
    return (tmp_path / NAME).read_text()


def test_it_reads_back(tmp_path):
    """Another task, other values: equal, and there is no draft left."""
    conf = RunConf(task=BipedConf(young=4e4, upright=2.0))
    save(conf, tmp_path)
    assert load(tmp_path) == conf and [path.name for path in tmp_path.iterdir()] == [NAME]


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("name: mlp", "name: ${oc.env:HOME}", r"interpolation, \$\{oc.env:HOME\}, in line"),
        ("effort: 1.0e-05", "effort: ${oc.env:X,0.5}", "interpolation"),
        ("resume: null", "resume: a/${task.name}", "interpolation"),
        ("effort: 1.0e-05", "effort: !!python/object/apply:os.getcwd []", "has a tag, tag:yaml.org,2002:python"),
        ("effort: 1.0e-05", "effort: &x 0.001", "anchor or an alias"),
        ("task:", BOMB + "task:", "anchor or an alias"),
        ("resume: null", "resume: " + 30 * "[" + 30 * "]", "more than 20 levels deep"),
        ("resume: null", "resume: " + 2**20 * "x", "more than 1048576 bytes"),
        ("resume: null", "resume: [", "it is no YAML in line"),
        ("resume: null", "resume: '\\0", "it is no YAML"),
        ("effort: 1.0e-05", "effort: much", "task.effort: Value 'much'"),
        ("effort: 1.0e-05", "effort: -1", "task.effort must be"),
        ("effort: 1.0e-05", "efort: 1", "efort"),
        ("name: arm", "name: leg", "names the task 'leg'"),
        ("name: arm", "name: [arm]", "names the task"),
    ],
)  # fmt: skip
def test_anything_else_is_refused_by_name(tmp_path, text, old, new, message):
    """Interpolations, tags, anchors, depth, size, damage and wrong values: at once, in a sentence with the file and the reason."""
    assert old in text
    (tmp_path / NAME).write_text(text.replace(old, new, 1))
    began = time.monotonic()
    with pytest.raises(ValueError, match=rf"config\.yaml is not the configuration of a run: .*{message}"):
        load(tmp_path)
    assert time.monotonic() - began < 5


@pytest.mark.parametrize("data", [b"", b"7", b"- a", b"\xff\xfe", b"\x00", b"{" * 5000, b"task: 3", b"null"])
def test_what_is_no_configuration_is_refused(tmp_path, data):
    """Nothing, a number, a list, no text, brackets without end."""
    (tmp_path / NAME).write_bytes(data)
    with pytest.raises(
        ValueError, match=r"config\.yaml is not the configuration of a run: .*Put the right file"
    ):
        load(tmp_path)


def test_a_link_or_a_pipe_is_refused(tmp_path, text):
    """In the place of the file or anywhere else in the folder; a pipe would wait for ever."""
    (tmp_path / "elsewhere").write_text(text)
    run = tmp_path / "run"
    for name, make in (
        (NAME, os.symlink),
        (".lock", os.symlink),
        ("metrics.csv", lambda _, path: os.mkfifo(path)),
    ):
        run.mkdir(exist_ok=True)
        (run / NAME).write_text(text)
        (run / name).unlink(missing_ok=True)
        make(tmp_path / "elsewhere", run / name)
        with pytest.raises(ValueError, match=f"{name} is (a link|neither a file nor a folder)"):
            load(run)
        (run / name).unlink()
    (run / NAME).unlink()
    with pytest.raises(ValueError, match="holds no run: there is no config.yaml in it"):
        load(run)
