"""Two processes do what one does. Run as a script by torchrun, this file is one of the processes."""

import dataclasses
import datetime
import importlib.util
import itertools
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import forked
import pytest
import torch
from learners import metrics

import softmpm
from softmpm_learn import distributed, train
from softmpm_learn.command.experiment import make_model
from softmpm_learn.distributed import Group, OtherProcessError
from softmpm_learn.runs.saved import load
from softmpm_learn.settings import Settings
from softmpm_learn.storage import checkpoint
from softmpm_learn.tasks import make_task

SAME, SMALL = 1e-5, 1e-8
"""Relative and absolute: sums over the worlds have another order. A rounding of 1e-7, a few iterations on; and a loss is a difference
of positions of order one, whose rounding is 6e-8 [m]."""
ARM = [
    *("task=arm", "experiment=smoke", "task.seconds=0.05", "task.control_period=0.025"),
    *("train.worlds=4", "train.goal_spread=[0.05,0.05]", "train.record_every=2"),
]
"""Three iterations; goals of their own give each world a gradient of its own."""


def shared(settings: Settings, **changes) -> Settings:
    """Four worlds with goals of their own, three iterations, each with a learning phase and an evaluation but the last."""
    conf = (
        dict(worlds=4, iterations=3, goal_spread=[0.1, 0.05], evaluate_every=2, evaluation_goals=4) | changes
    )
    optimizer = dataclasses.replace(settings.optimizer, retries=1, max_norm=CLIPPED)
    return dataclasses.replace(
        settings, train=dataclasses.replace(settings.train, **conf), optimizer=optimizer
    )


def fails(real, at):
    """``simulate`` that reports an inverted particle in its world 1 at some of its calls; an iteration has six, an evaluation too."""
    calls = itertools.count()

    def simulate(*args, **kwargs):
        if next(calls) in at:
            what = dict(kind=KIND, world=1, particle=3, substep=1, value=-1.0, limit="det F > 0")
            raise softmpm.UnstableError("particle 3 of world 1 is inverted.", **what)
        return real(*args, **kwargs)

    return simulate


CLIPPED = 2e-3
"""Shorter than the mean gradient: each process has to shorten the same one."""
KIND = type("Kind", (), {"name": "INVERTED"})


def one_of_two(out: Path, group: Group) -> None:
    """Work of each process; writes to ``said.RANK.json`` how each run ended there."""
    import conftest

    torch.set_num_threads(1)
    task, settings = conftest.task.__wrapped__(), conftest.settings.__wrapped__()
    model, said, first = softmpm.build(task.scene, device="cpu", worlds=2), {}, group.first
    simulate, save = softmpm.simulate, checkpoint.save

    def go(name: str, into: str | None = None, **options):
        conf = shared(settings, **options.pop("change", {}))
        try:
            result = train.train(task, model, conf, out / (into or name), group=group, **options)
            said[name] = [result.finished, result.run.iteration]
            weights = [p.detach() for p in result.run.parameters]
            torch.save(weights, out / f"{name}.{group.rank}.pt")
        except Exception as error:
            said[name] = [type(error).__name__, str(error)]

    def full(*_):
        raise OSError("no space left.")

    go("two")
    ended = iter([False] if not first else itertools.repeat(False))
    go("stopped", stop=lambda: next(ended, True))
    go("resumed", into="stopped")
    for name, at in (("retried", {14}), ("failed", range(14, 999))):
        softmpm.simulate = simulate if first else fails(simulate, at)
        go(name)
    softmpm.simulate = simulate
    checkpoint.save = full if first else save
    go("full")
    checkpoint.save = save
    go("uneven", change=dict(worlds=3))
    (out / f"said.{group.rank}.json").write_text(json.dumps(said))


def torchrun(*words: str, cwd: Path) -> subprocess.CompletedProcess:
    start = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")
    return forked.python(*start, *words, folder=cwd)


@pytest.fixture(scope="module")
def four(task):
    """All four worlds in one process."""
    return softmpm.build(task.scene, device="cpu", worlds=4)


@pytest.fixture(scope="module")
def one(task, four, make_settings, tmp_path_factory):
    """Folder of the run of one process."""
    out = tmp_path_factory.mktemp("one")
    train.train(task, four, shared(make_settings()), out)
    return out


@pytest.fixture(scope="module")
def both(one, tmp_path_factory):
    """Folder of the runs of :func:`one_of_two`, and how they ended in the first and in the other process. Both find their kernels
    compiled, by the run of one process.
    """
    out = tmp_path_factory.mktemp("both")
    done = torchrun(str(Path(__file__)), str(out), cwd=out)
    assert done.returncode == 0, done.stderr
    return out, *(json.loads((out / f"said.{rank}.json").read_text()) for rank in range(2))


def assert_same(folder: Path, other: Path) -> None:
    """Every metric is equal, and so are the weights, the policy's encoder and the random stream of the goals in the checkpoint."""
    for row, want in zip(metrics(folder), metrics(other), strict=True):
        assert row == pytest.approx(want, rel=SAME, abs=SMALL, nan_ok=True)
    now, want = checkpoint.load(folder), checkpoint.load(other)
    for part in ("policy", "design"):
        torch.testing.assert_close(now[part], want[part], rtol=SAME, atol=SAME)
    for part in ("autoencoder", "target"):
        torch.testing.assert_close(now["learner"][part], want["learner"][part], rtol=SAME, atol=SAME)
    assert torch.equal(now["goals"], want["goals"]) and now["iteration"] == want["iteration"] == 3
    assert list(now["learner"]["replay"]) == list(want["learner"]["replay"]) == list(range(12))


def assert_in_step(out: Path, name: str) -> None:
    """Both processes end with the same weights, to the bit."""
    first, other = (torch.load(out / f"{name}.{rank}.pt") for rank in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, other, strict=True))


# What two processes do


def test_two_processes_give_the_run_of_one(one, both):
    """Metrics, weights, autoencoder and replay buffer of three iterations do not depend on the number of processes."""
    out, *said = both
    assert_same(out / "two", one)
    assert all(row["clipped"] for row in metrics(one))
    assert_in_step(out, "two")
    assert [s["two"] for s in said] == [[True, 3]] * 2


def test_a_wish_of_one_process_stops_both(both):
    """Both end after the same iteration; resumed, they give the very run that was not stopped."""
    out, *said = both
    assert [s["stopped"] for s in said] == [[False, 1]] * 2
    assert [s["resumed"] for s in said] == [[True, 3]] * 2
    assert (out / "stopped" / "metrics.csv").read_bytes() == (out / "two" / "metrics.csv").read_bytes()
    assert_in_step(out, "stopped")
    assert_in_step(out, "resumed")


def test_a_failure_in_one_process_is_a_retry_in_both(task, four, settings, both, tmp_path, monkeypatch):
    """Both go halfway back together, as one process would, and are still in step."""
    out, *_ = both
    monkeypatch.setattr(softmpm, "simulate", fails(softmpm.simulate, {14}))
    train.train(task, four, shared(settings), tmp_path)
    assert [row["retries"] for row in metrics(out / "retried")] == [0, 1, 0]
    assert_same(out / "retried", tmp_path)
    assert_in_step(out, "retried")


def test_a_failure_without_a_way_back_ends_both(both):
    """Both raise the same error, which names the world by its number in the run; what was done before is saved."""
    out, first, other = both
    assert first["failed"] == other["failed"] and first["failed"][0] == "TrainingError"
    message = "iteration 1: particle 3 of world 1 is inverted. In control step"
    assert first["failed"][1].startswith(message)
    assert "in process 1, whose world 1 is world 3 of the run" in first["failed"][1]
    assert checkpoint.load(out / "failed")["iteration"] == 1


def test_what_the_first_process_cannot_write_ends_both(both):
    """The error stays what it is where it happened; the other process says the same and does not wait."""
    _, first, other = both
    assert first["full"] == ["OSError", "no space left."]
    assert other["full"] == ["OtherProcessError", "no space left."]


def test_worlds_that_cannot_be_shared_are_refused(both):
    """The number of worlds must be a multiple of that of the processes; the message says which would do."""
    _, first, other = both
    assert first["uneven"][0] == "ValueError" and other["uneven"][0] == "OtherProcessError"
    assert first["uneven"][1] == other["uneven"][1]
    assert (
        "multiple of the 2 processes that share the worlds, got 3; take train.worlds=4" in first["uneven"][1]
    )


def test_one_process_goes_on_where_two_stopped(task, four, settings, both, tmp_path):
    """A run may be resumed by another number of processes."""
    out, *_ = both
    shutil.copytree(out / "failed", tmp_path / "failed")
    for name in ("failed", "whole"):
        train.train(task, four, shared(settings), tmp_path / name)
    assert_same(tmp_path / "failed", tmp_path / "whole")


@pytest.mark.parametrize(
    ("device", "dtype"),
    [("cpu", "float32"), pytest.param("cuda", "float64", marks=pytest.mark.gpu)],  # a GPU adds in any order
)
def test_the_command_line_through_torchrun(tmp_path, device, dtype):
    """One folder with everything in it, one log, and the metrics of the same settings in one process, the end included."""
    if device == "cuda" and torch.cuda.device_count() < 2:
        pytest.skip("needs two GPUs")
    words = (*ARM, f"device.name={device}", f"device.dtype={dtype}")
    done = torchrun("-m", "softmpm_learn", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("after 3 of 3 iterations: loss") == 1
    (out,) = (tmp_path / "outputs" / "arm").iterdir()
    left = {path.name for path in out.iterdir()}
    recordings = {"run.h5", "run.rrd"} if importlib.util.find_spec("rerun") else {"run.h5"}
    assert left >= recordings | {"loss.png", "latent.png", "robot.png"} and "error.txt" not in left
    conf = load(out)
    task, one = make_task(conf.task), tmp_path / "one"
    train.train(task, make_model(task, conf, Group()), conf.settings, one)
    (*rows, last), (*wanted, end) = metrics(out), metrics(one)
    for row, want in zip(rows, wanted, strict=True):
        assert row == pytest.approx(want, rel=SAME, abs=SMALL, nan_ok=True)
    assert last["end"] == pytest.approx(end["end"], rel=SAME) and math.isfinite(end["end"])


ODD = """
import torch
from softmpm_learn import register

class Odd(torch.nn.Linear):
    calls = 0

    def forward(self, z, time, goal=None):
        self.calls += 1
        if self.calls > 40 and torch.distributed.get_rank() == 1:
            raise ValueError("spikes of my own")
        return torch.tanh(super().forward(z))

@register.policy("odd")
def odd(conf, space):
    return Odd(space.features, space.muscles)
"""


def test_the_error_of_a_process_is_not_buried(tmp_path):
    """Where one fails alone, its own sentence is shown, and its traceback is kept; the other names no library and leaves none."""
    (tmp_path / "odd.py").write_text(ODD)
    words = ("odd.py", "policy=odd", *ARM, "train.iterations=30", "train.pictures=false", "hydra.run.dir=out")
    done = torchrun("-m", "softmpm_learn", *words, "observer=centroids", "device=cpu", cwd=tmp_path)
    assert done.returncode != 0 and "softmpm_learn: spikes of my own." in done.stderr
    assert "gloo" not in done.stderr
    assert "spikes" in (tmp_path / "out" / "error.1.txt").read_text()
    assert not (tmp_path / "out" / "error.txt").exists()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="native threads are listed by Linux only")
def test_no_thread_of_the_group_outlives_it(both):
    """A native thread that runs while the interpreter is torn down may end the process with SIGABRT, now and then."""
    out, *_ = both
    for rank in range(2):
        names = json.loads((out / f"threads.{rank}.json").read_text())
        assert any("gloo" in name for name in names["inside"]) and not any(
            "gloo" in name for name in names["after"]
        )


# One process alone


def test_alone_nothing_is_communicated():
    """A group of one has all worlds, averages and gathers nothing, and lets errors pass as they are."""
    group, tensor = Group(), torch.ones(2)
    assert group.split(5) == range(5) and group.any(True) and not group.any(False)
    assert group.average([tensor])[0] is tensor and group.gather(tensor, dim=0) is tensor
    assert group.broadcast("text") == "text" and group.collect(["text"]) == ["text"]
    assert group.once(max, 2, 3) == 3
    with pytest.raises(KeyError) as caught, group.fail_together():
        raise KeyError
    assert not isinstance(caught.value, OtherProcessError) and not torch.distributed.is_initialized()


def test_without_torchrun_there_is_no_process_group(monkeypatch):
    """``joined`` gives a group of one where torchrun has not been, or started one process only."""
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    with distributed.joined() as group:
        assert group == Group() and not torch.distributed.is_initialized()
    monkeypatch.setenv("WORLD_SIZE", "1")
    with distributed.joined() as group:
        assert group == Group() and not torch.distributed.is_initialized()


def test_a_process_waits_as_long_as_another_runs(monkeypatch):
    """Processes with other numbers of seeds end hours apart, and none gives up waiting for the others."""
    begun, group = {}, torch.distributed
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", "0")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    monkeypatch.setattr(group, "init_process_group", lambda name, **settings: begun.update(settings))
    monkeypatch.setattr(group, "destroy_process_group", lambda: None)
    monkeypatch.setattr(group, "get_rank", lambda: 0)
    monkeypatch.setattr(group, "get_world_size", lambda: 2)
    with distributed.joined():
        assert begun["timeout"] >= datetime.timedelta(days=30)


def test_worlds_are_split_evenly():
    """Shares are as large as each other, without gaps, in the order of the processes."""
    shares = [Group(rank=rank, size=3).split(6) for rank in range(3)]
    assert shares == [range(2), range(2, 4), range(4, 6)]


def test_each_process_has_its_own_gpu(monkeypatch):
    """A process takes the GPU of its number on its machine; too few GPUs are refused, with what to do."""
    alone, third = Group(), Group(rank=6, size=8, local_rank=2, local_size=4)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    assert [alone.device(name) for name in ("auto", "cpu", "cuda")] == [None, "cpu", "cuda"]
    assert [third.device(name) for name in ("auto", "cpu", "cuda")] == ["cuda:2", "cpu", "cuda:2"]
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(
        ValueError, match=r"4 processes, but PyTorch sees 1 GPUs; take torchrun --nproc-per-node=1"
    ):
        third.device("auto")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert third.device("auto") is None


def native_threads() -> list[str]:
    """Names of the threads of this process, those of libraries too."""
    return [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]


if __name__ == "__main__":
    with distributed.joined() as the_group:
        one_of_two(Path(sys.argv[1]), the_group)
        names = {"inside": native_threads()}
    names["after"] = native_threads()
    (Path(sys.argv[1]) / f"threads.{the_group.rank}.json").write_text(json.dumps(names))
