"""A recording holds what was given, survives every end of its writer, and goes on after it."""

import dataclasses
import fcntl
import importlib.util
import math
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import forked
import h5py
import numpy as np
import pytest
import torch
from helpers import busy_scene

import softmpm
from softmpm.recording import file as recording_file
from softmpm.recording import reader
from softmpm.recording.format import FRAMES
from softmpm.recording.frame_values import strain
from softmpm.recording.superblock import readable

COUNT, NODES = 400, (16, 16)


def small_model(*names: str) -> softmpm.Model:
    """A cloud with two muscles that overlap, of these names. Nothing here runs a kernel."""
    positions = np.random.default_rng(0).uniform(0.2, 0.6, (COUNT, 2))
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=NODES, spacing=1 / 16),
        bodies=[
            softmpm.Body(softmpm.Particles(positions, 1e-4), softmpm.NeoHookean(density=1.0, young=10.0))
        ],
        muscles=[
            softmpm.Muscle(
                particles=np.arange(50 * k, 100 + 50 * k), direction=direction, strength=k + 1.0, name=name
            )
            for k, (direction, name) in enumerate(zip(((0, 1), (1, 0)), names or ("", ""), strict=True))
        ],
        walls=[softmpm.Wall(normal=(0, 1), offset=0.1)],
        gravity=(0, -9.8),
        dt=1e-3,
    )
    return softmpm.build(scene, device="cpu")


def moved(model: softmpm.Model, by: float, worlds: int = 1) -> softmpm.State:
    """Rest, shifted by ``by`` in the first world and by one more in each further one."""
    rest = model.rest()
    shift = by + torch.arange(worlds)[:, None, None]
    state = (t.expand(worlds, *t.shape[1:]) for t in rest[:4])
    return softmpm.State(*state)._replace(x=rest.x + shift)


def record(recorder: softmpm.Recorder, model: softmpm.Model, iteration: int, frames: int = 4) -> None:
    """Frame k is shifted by iteration + k / 16; every other frame has a field; scalars at the end."""
    with recorder.episode(iteration, seed=iteration) as episode:
        for k in range(frames):
            field = torch.full((*NODES, 2), float(k)) if k % 2 == 0 else None
            activation, latent = torch.tensor([0.1 * k, -1.0]), torch.arange(3.0) + k
            episode.frame(0.1 * k, moved(model, iteration + k / 16), activation, field, latent)
    recorder.scalars(iteration, {"loss": 1.0 / (1 + iteration), "norm": float(iteration)})


def check(recording: softmpm.Recording, model: softmpm.Model, iteration: int) -> int:
    """All frames of an iteration are as :func:`record` made them; gives their number."""
    frames = recording.frames(iteration)
    count = len(frames["time"])
    assert recording.attributes(iteration) == {"seed": iteration}
    assert set(frames) >= {"time", "x", "v", "strain", "activation"}
    for k in range(count):
        assert np.array_equal(frames["x"][k], moved(model, iteration + k / 16).x[0].numpy())
        assert np.allclose(frames["activation"][k], (0.1 * k, -1.0))
        assert np.array_equal(frames["latent"][k], np.arange(3.0) + k)
    if count:
        assert list(frames["field_frame"]) == list(range(0, count, 2))
        assert np.array_equal(frames["field"][:, 0, 0, 0], np.arange(0, count, 2))
        assert np.allclose(frames["time"], 0.1 * np.arange(count))
    return count


def test_what_was_recorded_is_read(tmp_path):
    """Frames, scalars, notes and the scene come back, in float32; a quantity not given is absent or NaN."""
    model = small_model()
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder:
        record(recorder, model, 3)
        record(recorder, model, 8, frames=2)
        with recorder.episode(9) as episode:
            episode.frame(0.0, model.rest())
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        assert recording.episodes == (3, 8, 9)
        assert check(recording, model, 3) == 4 and check(recording, model, 8) == 2
        bare = recording.frames(9)
        assert "field" not in bare and "latent" not in bare and np.isnan(bare["activation"]).all()
        assert [list(column) for column in recording.scalars["loss"]] == [[3, 8], [1 / 4, 1 / 9]]
        assert (recording.dt, recording.spacing, recording.share, recording.dim) == (1e-3, 1 / 16, 1.0, 2)
        static = recording.static
        assert np.array_equal(static["positions"], model.positions.numpy())
        assert static["muscle"].sum(0)[40:60].tolist() == [1] * 10 + [2] * 10
        assert static["wall_offset"] == np.float32(0.1) and static["wall_contact"] == b"separate"


def test_frames_that_are_recorded_together_count_together(tmp_path):
    """They are those recorded one by one, with the same digest; none is there before the block ends, or if it fails."""
    model = small_model()
    with softmpm.Recorder(tmp_path / "one by one.h5", model) as recorder:
        for iteration in (3, 4):
            record(recorder, model, iteration)
        digest = recorder.digest
    path = tmp_path / "run.h5"
    with softmpm.Recorder(path, model) as recorder:
        with recorder.together():
            record(recorder, model, 3)
            with softmpm.Recording(path) as recording:
                assert len(recording.rows(3)) == 0
            with pytest.raises(ValueError, match="together already"), recorder.together():
                pass
        with softmpm.Recording(path) as recording:
            assert check(recording, model, 3) == 4
        with pytest.raises(ValueError, match="shape"):
            together(recorder, [model.rest(), model.rest()._replace(x=torch.zeros(1, 3, 2))])
        with softmpm.Recording(path) as recording:
            assert recording.episodes == (3, 4) and len(recording.rows(4)) == 0
        with recorder.together():
            pass
        with recorder.together():
            record(recorder, model, 4)
    with softmpm.Recording(path) as recording:
        assert check(recording, model, 3) == 4 and check(recording, model, 4) == 4
    with softmpm.Recorder(path, model, resume_before=5) as recorder:
        assert recorder.digest == digest


def together(recorder: softmpm.Recorder, states: list[softmpm.State]) -> None:
    """Record these states together, as iteration 4, with a field each."""
    with recorder.together(), recorder.episode(4) as episode:
        for state in states:
            episode.frame(0.0, state, field=torch.rand(*NODES, 2))


@pytest.mark.parametrize("dim", [2, 3])
def test_one_world_of_a_simulation_is_recorded(tmp_path, dim):
    """Of states, activations and rasterized fields of many worlds in float64, the chosen world is kept."""
    model = softmpm.build(busy_scene(dim), device="cpu", dtype=torch.float64, worlds=2)
    generator = torch.Generator().manual_seed(0)
    activation = torch.randn(1, 2, 2, generator=generator, dtype=torch.float64, requires_grad=True)
    state = softmpm.simulate(model, model.rest(), activation, model.params(), substeps=5)
    field = softmpm.rasterize(model, state)
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(0) as episode:
        episode.frame(0.5, state, activation[0], field, torch.eye(2), world=1)
        episode.frame(0.6, state, activation[0], field.velocity, torch.eye(2))
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        frames = recording.frames(0)
    for k, world in enumerate((1, 0)):
        F = state.F[world].detach().numpy()
        green = (np.swapaxes(F, -1, -2) @ F - np.eye(dim)) / 2
        assert np.allclose(frames["strain"][k], np.sqrt((green**2).sum((-1, -2))), rtol=1e-6, atol=1e-9)
        for name, want in (("x", state.x), ("v", state.v), ("field", field.velocity)):
            assert np.array_equal(frames[name][k], want[world].detach().float().numpy()), name
        assert np.array_equal(frames["activation"][k], activation[0, world].detach().float().numpy())
        assert list(frames["latent"][k]) == [1 - world, world]


def test_strain_measures_the_change_of_shape_only():
    """A rotation has none; a stretch by s along one axis has (s² − 1)/2."""
    c, s = math.cos(0.7), math.sin(0.7)
    rotation = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    assert strain(rotation) < 1e-15
    stretch = rotation @ torch.diag(torch.tensor([1.2, 1.0], dtype=torch.float64))
    assert abs(strain(stretch) - 0.22) < 1e-15


def test_less_can_be_recorded(tmp_path):
    """``every`` keeps each second frame; ``max_particles`` keeps some particles, in order, with their muscles."""
    model = small_model()
    with softmpm.Recorder(tmp_path / "run.h5", model, every=2, max_particles=100) as recorder:
        episode = recorder.episode(0)
        for k in range(5):
            episode.frame(k, moved(model, k))
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        frames, kept = recording.frames(0), recording.static["particle"]
        assert list(frames["time"]) == [0, 2, 4]
        assert len(kept) == 100 and (np.diff(kept) > 0).all() and recording.share == 0.25
        assert np.array_equal(frames["x"][1], moved(model, 2).x[0, kept].numpy())
        assert np.array_equal(recording.static["muscle"][1], (kept >= 50) & (kept < 150))


def test_a_recording_is_read_while_it_is_written(tmp_path):
    """Another process, with plain h5py, sees each frame as soon as ``frame`` has returned."""
    model = small_model()
    code = "import sys, h5py; print(h5py.File(sys.argv[1], 'r', swmr=True)['frame/index'][-1]['time'])"
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(0) as episode:
        for k in range(3):
            episode.frame(k, model.rest())
            reader = [sys.executable, "-c", code, str(tmp_path / "run.h5")]
            assert float(subprocess.run(reader, check=True, capture_output=True).stdout) == k


def test_a_live_writer_never_disturbs_a_reader(tmp_path):
    """Read again and again while another process writes as fast as it can, all that is there is whole."""
    run_here(reading, tmp_path / "run.h5", 15)


def reading(path: Path, times: int) -> None:
    """Fork a writer, and read what it writes."""
    model, count = small_model(), 0
    with softmpm.Recorder(path, model) as recorder:
        record(recorder, model, 0)
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        write_for_ever(path, model, 1)
    try:
        while count < times:
            with softmpm.Recording(path) as recording:
                assert check(recording, model, 0) == 4 and recording.episodes[-1] >= count
                assert all(check(recording, model, k) == 3 for k in recording.episodes[-3:-1] if k)
                count = recording.episodes[-1]
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_file_may_become_shorter_while_it_is_opened(tmp_path):
    """By the disk space that a writer had reserved when the reader looked at its size."""
    model, path = small_model(), tmp_path / "run.h5"
    with softmpm.Recorder(path, model) as recorder:
        record(recorder, model, 0)
        size = path.stat().st_size
        os.truncate(path, size + 2**20)
        presented = readable(path)
        os.truncate(path, size)
        with h5py.File(presented, "r") as file:
            assert len(file["frame/index"]) == 4


def test_a_writer_waits_for_readers_that_open_the_file(tmp_path):
    """They hold a lock for a moment, which a writer that begins or resumes then would take for an error."""
    run_here(opening, tmp_path / "run.h5", 200)


def test_a_file_that_stays_locked_is_named(tmp_path, monkeypatch):
    """A writer does not wait for ever for a program that holds the file; once it is closed, it opens."""
    path = tmp_path / "run.h5"
    with softmpm.Recorder(path, small_model()) as recorder:
        record(recorder, small_model(), 0)
    monkeypatch.setattr(recording_file, "_PATIENCE", 0.05)
    with open(path, "rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(BlockingIOError, match="another program has had the file open"):
            recording_file.open_to_append(path)
    recording_file.open_to_append(path).close()


def opening(path: Path, times: int) -> None:
    """Fork a reader that opens the file all the time, and resume again and again."""
    model = small_model()
    with softmpm.Recorder(path, model) as recorder:
        record(recorder, model, 0)
    child = os.fork()
    while child == 0:
        with softmpm.Recording(path):
            pass
    try:
        for _ in range(times):
            softmpm.Recorder(path, model, resume_before=1).close()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_resume_keeps_what_came_before(tmp_path):
    """``resume_before=k`` drops iterations from k on, and what follows is as in a run without a break."""
    model, path, whole = small_model(), tmp_path / "run.h5", tmp_path / "whole.h5"
    with softmpm.Recorder(path, model, resume_before=0) as recorder:  # no file yet
        for iteration in (0, 5, 10):
            record(recorder, model, iteration)
    with softmpm.Recorder(path, model, resume_before=6) as recorder:
        with softmpm.Recording(path) as now:
            assert now.episodes == (0, 5) and list(now.scalars["norm"][0]) == [0, 5]
        record(recorder, model, 7, frames=3)
    with softmpm.Recorder(whole, model) as recorder:
        for iteration, frames in ((0, 4), (5, 4), (7, 3)):
            record(recorder, model, iteration, frames)
    with softmpm.Recording(path) as got, softmpm.Recording(whole) as want:
        assert got.episodes == want.episodes
        for iteration in want.episodes:
            assert check(got, model, iteration) == check(want, model, iteration)
        assert np.array_equal(got.scalar_rows, want.scalar_rows)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.h5", "whole.h5"]


def older(path, version: int) -> None:
    """Make a recording without poses of walls one of version 3, or of 2 without names of muscles."""
    with h5py.File(path, "r+") as file:
        index = file["frame/index"]
        names, fill = FRAMES[version].names or (), np.full((), -1, FRAMES[version])
        rows = np.array([tuple(row[name] for name in names) for row in index[()]], FRAMES[version])
        del file["frame/index"], file["wall"]
        file.create_dataset("frame/index", data=rows, maxshape=(None,), chunks=(1,), fillvalue=fill)
        if version == 2:
            del file["static/muscle_name"]
        file.attrs["version"] = version


def test_names_of_muscles_are_recorded(tmp_path):
    """Read as the scene has them, up to 64 characters of any script; files of version 2 have none, and say the place."""
    model, path = small_model("Vorderbein № 1", 64 * "脚"), tmp_path / "run.h5"
    with softmpm.Recorder(path, model) as recorder:
        record(recorder, model, 0)
    with softmpm.Recording(path) as recording:
        assert recording.muscle_names == model.scene.muscle_names == ("Vorderbein № 1", 64 * "脚")
    older(path, 2)
    with softmpm.Recording(path) as recording:
        assert recording.version == 2 and recording.muscle_names == ("muscle 0", "muscle 1")
        assert check(recording, model, 0) == 4


@pytest.mark.parametrize("before", [("a", "b"), ("", ""), None])
def test_other_names_do_not_hinder_resuming(tmp_path, before):
    """Nor does a file without any. The resumed file has the new names, and the digest of the old ones."""
    model, path = small_model("left", "right"), tmp_path / "run.h5"
    old = small_model(*(before or ("", "")))
    with softmpm.Recorder(path, old) as recorder:
        record(recorder, old, 0)
        digest = recorder.digest
    if before is None:
        older(path, 2)
    with softmpm.Recorder(path, model, resume_before=1, resume_digest=digest) as recorder:
        record(recorder, model, 1)
    with softmpm.Recording(path) as recording:
        assert recording.muscle_names == ("left", "right") and recording.version == 4
        assert [check(recording, model, iteration) for iteration in (0, 1)] == [4, 4]


def test_a_digest_tells_one_recording_from_another(tmp_path):
    """Equal contents have equal digests, however they came to be; with one a changed file is refused and stays as it is."""
    model, path = small_model(), tmp_path / "run.h5"
    with softmpm.Recorder(path, model) as recorder:
        empty = recorder.digest
        record(recorder, model, 0)
        record(recorder, model, 5)
        before = recorder.digest
        record(recorder, model, 6, frames=1)
        assert len({empty, before, recorder.digest}) == 3
    with softmpm.Recorder(path, model, resume_before=6, resume_digest=before) as recorder:
        assert recorder.digest == before
        record(recorder, model, 7)
        whole = recorder.digest
    with softmpm.Recorder(tmp_path / "whole.h5", model) as recorder:
        for iteration in (0, 5, 7):
            record(recorder, model, iteration)
        assert recorder.digest == whole
    for other in (tmp_path / "whole.h5", None):
        data = other.read_bytes() if other else b""
        path.write_bytes(data)
        with pytest.raises(
            (ValueError, OSError), match=r"run\.h5 (does not hold what was recorded|is not a readable)"
        ):
            softmpm.Recorder(path, model, resume_before=6, resume_digest=empty)
        assert path.read_bytes() == data


def test_links_are_not_followed(tmp_path):
    """A draft that is a link is removed; what it named stays as it was."""
    (tmp_path / "other").write_bytes(b"precious")
    (tmp_path / "run.h5.new").symlink_to(tmp_path / "other")
    softmpm.Recorder(tmp_path / "run.h5", small_model()).close()
    assert (tmp_path / "other").read_bytes() == b"precious" and not (tmp_path / "run.h5.new").is_symlink()


def test_nothing_is_overwritten_by_accident(tmp_path):
    """An existing file needs ``resume_before``, and a file of another scene is never touched."""
    model, path = small_model(), tmp_path / "run.h5"
    softmpm.Recorder(path, model).close()
    with pytest.raises(FileExistsError, match="resume_before"):
        softmpm.Recorder(path, model)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="another scene .positions differs"):
        softmpm.Recorder(path, model, resume_before=1, max_particles=10)
    slower = dataclasses.replace(model.scene, dt=model.scene.dt / 2)
    with pytest.raises(ValueError, match=r"another scene .dt was .* and is "):
        softmpm.Recorder(path, softmpm.build(slower, device="cpu"), resume_before=1)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(os.name == "nt", reason="Windows does not replace or delete files that are open")
@pytest.mark.parametrize("replace", [True, False])
def test_a_file_that_was_replaced_or_deleted(tmp_path, replace):
    """What a recorder writes then is lost: it says so, in the first frame; what replaced the file is recorded. A moved file goes on."""
    model, path, moved = small_model(), tmp_path / "run.h5", tmp_path / "moved.h5"
    with softmpm.Recorder(path, model) as recorder, recorder.episode(0) as episode:
        path.rename(moved)
        episode.frame(0.0, model.rest())
        if replace:
            with softmpm.Recorder(moved, model, resume_before=1) as other, other.episode(1) as second:
                second.frame(0.0, model.rest())
        else:
            moved.unlink()
        with pytest.raises(
            FileNotFoundError, match=r"cannot record: the file was deleted, or replaced by .*run\.h5"
        ):
            episode.frame(1.0, model.rest())
        with pytest.raises(FileNotFoundError, match="a path of its own"):
            recorder.scalars(0, {"loss": 1.0})
    if replace:
        assert [len(softmpm.Recording(moved).rows(k)) for k in (0, 1)] == [1, 1]


def test_a_scene_that_readers_would_refuse(tmp_path):
    """A strength beyond float32 is refused before there is a file, which no reader would open."""
    scene = small_model().scene
    strong = [dataclasses.replace(muscle, strength=1e39) for muscle in scene.muscles]
    scene = dataclasses.replace(scene, muscles=strong, dt=1e-30)
    model = softmpm.build(scene, device="cpu", dtype=torch.float64)
    with np.errstate(over="ignore"), pytest.raises(ValueError, match="static/muscle_strength must be finite"):
        softmpm.Recorder(tmp_path / "run.h5", model)
    assert not list(tmp_path.iterdir())


def test_wrong_use_is_explained(tmp_path):
    """Shapes, sizes and names that do not fit raise before anything is written."""
    model, path = small_model(), tmp_path / "run.h5"
    for name, value in (("every", 0), ("every", 2.5), ("max_particles", 10.0), ("max_points", -1)):
        with pytest.raises(ValueError, match=f"{name} must be a whole number of at least"):
            softmpm.Recorder(path, model, **{name: value})
    recorder = softmpm.Recorder(path, model)
    with pytest.raises(ValueError, match="4096 bytes"):
        recorder.episode(0, note="x" * 5000)
    for iteration in (-1, 0.5):
        with pytest.raises(ValueError, match="iteration must be a whole number"):
            recorder.episode(iteration)
    with pytest.raises(ValueError, match="1 to 64 bytes"):
        recorder.scalars(0, {"": 1.0})
    episode, rest = recorder.episode(0), model.rest()
    wrong = {
        "state.x": dict(state=rest._replace(x=rest.x[:, 1:])),
        "activation": dict(activation=torch.zeros(3)),
        "field": dict(field=torch.zeros(4, 4, 2)),
    }
    for name, arguments in wrong.items():
        with pytest.raises(ValueError, match=f"{name} must have shape"):
            episode.frame(0.0, **({"state": rest} | arguments))
    with pytest.raises(
        ValueError, match=r"\(2,\), or \(1, 2\) with a first axis world, got \(5, 2\); a frame is one instant"
    ):
        episode.frame(0.0, rest, torch.zeros(5, 2))  # of five control steps
    for when in (math.nan, math.inf):  # no reader would open the file any more
        with pytest.raises(ValueError, match=f"the time of a frame must be finite, got {when}"):
            episode.frame(when, rest)
    episode.frame(0.0, rest, latent=torch.zeros(8))
    with pytest.raises(ValueError, match=r"latent must have shape \(8,\)"):
        episode.frame(0.1, rest, latent=torch.zeros(9))
    recorder.close()
    with pytest.raises(ValueError, match="closed"):
        episode.frame(0.2, rest)
    with softmpm.Recording(path) as recording:
        assert len(recording.rows(0)) == 1 and recording.episodes == (0,) and recording.scalars == {}


KILLS = 12


def test_killed_at_any_instant(tmp_path):
    """After kill -9 at random instants every frame that was acknowledged is there, whole, and a resumed run goes on."""
    run_here(killing, tmp_path / "run.h5", KILLS)


def killing(path: Path, kills: int) -> None:
    """Fork a writer that goes on where the last one was killed, kill it, look; again and again."""
    model, start, frames_seen = small_model(), 0, 0
    for trial in range(kills):
        ears, mouth = os.pipe()
        child = os.fork()
        if child == 0:
            os.dup2(mouth, 1)
            write_for_ever(path, model, start)
        os.close(mouth)
        with os.fdopen(ears) as said:
            early = trial % 3 == 0
            if not early:  # from the first instant after the first episode was created
                said.readline()
            time.sleep(random.Random(trial).uniform(0, 0.03 if early or trial % 2 else 0.2))
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            heard = [line.split() for line in said if line.endswith("\n")]
        if not path.exists():
            assert not heard
            continue
        with softmpm.Recording(path) as recording:
            for iteration in recording.episodes:
                told = sum(line == ["frame", str(iteration)] for line in heard)
                assert check(recording, model, iteration) >= (told if iteration >= start else 3)
            frames_seen += len(recording.episodes)
            told = [int(line[1]) for line in heard if line[0] == "episode"]
            assert set(told) <= set(recording.episodes)
            told = [int(line[1]) for line in heard if line[0] == "scalars"]
            assert not told or recording.scalars["norm"][0][-1] >= told[-1]
            start = recording.episodes[-1] if 0 < len(recording.episodes) < 9 else 0
    assert frames_seen > kills


def test_dying_at_any_line(tmp_path):
    """Whichever line of the recorder was its last one, the file is there, readable, and holds what was acknowledged."""
    run_here(dying, tmp_path)


def dying(folder: Path) -> None:
    """Fork a writer that ends, as if killed, when it reaches its n-th new line; for every other n until it gets through."""
    model, begun, path = small_model(), folder / "begun.h5", folder / "run.h5"
    with softmpm.Recorder(begun, model) as recorder:
        record(recorder, model, 0)
    lines, code = 0, DIED
    while code == DIED:
        shutil.copy(begun, path)
        child = os.fork()
        if child == 0:
            sys.settrace(Countdown(lines))
            write_for_ever(path, model, 1, until=2)
            os._exit(0)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        with softmpm.Recording(path) as recording:
            assert check(recording, model, 0) == 4
            assert all(check(recording, model, k) <= 3 for k in recording.episodes[1:])
        lines += 2
    assert code == 0 and lines > 100 and recording.episodes == (0, 1), (code, lines)


DIED = 9


class Countdown:
    """A trace function that ends the process when it reaches the n-th different line of the modules that write."""

    def __init__(self, lines: int):
        self.lines, self.seen = lines, set()

    def __call__(self, frame, event, _argument):
        place = (frame.f_code.co_filename, frame.f_lineno)
        if not place[0].endswith(("recording/writer.py", "recording/file.py", "recording/format.py")):
            return None
        if event == "line" and place not in self.seen:
            if len(self.seen) == self.lines:
                os._exit(DIED)  # runs nothing of Python or HDF5 any more
            self.seen.add(place)
        return self


def write_for_ever(path: Path, model: softmpm.Model, start: int, until: int = 10**6) -> None:
    """Record three frames for each iteration, saying what is done."""
    recorder = softmpm.Recorder(path, model, resume_before=start)
    for iteration in range(start, until):
        with recorder.episode(iteration, seed=iteration) as episode:
            print("episode", iteration, flush=True)
            for k in range(3):
                field = torch.full((*NODES, 2), float(k)) if k % 2 == 0 else None
                activation, latent = torch.tensor([0.1 * k, -1.0]), torch.arange(3.0) + k
                episode.frame(0.1 * k, moved(model, iteration + k / 16), activation, field, latent)
                print("frame", iteration, flush=True)
        recorder.scalars(iteration, {"norm": float(iteration)})
        print("scalars", iteration, flush=True)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="needs posix_fallocate to claim room")
def test_a_full_disk_is_an_error_and_nothing_is_lost(tmp_path):
    """Without room ``frame`` raises OSError, also twice; the frames before are there, and the process lives."""
    run_here(filling, tmp_path, (60000, 61000, 100000, 123456))


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="needs posix_fallocate to claim room")
def test_a_full_disk_loses_all_frames_recorded_together_and_none_before(tmp_path):
    run_here(filling_together, tmp_path / "run.h5")


def filling_together(path: Path) -> None:
    """Record where there is room for one frame, but not for many."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    model = small_model()
    with softmpm.Recorder(path, model) as recorder:
        episode = recorder.episode(0)
        limit = path.stat().st_size + 2**20 + 123456
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        episode.frame(0.0, model.rest())
        with pytest.raises(OSError, match="no room to record"):
            together(recorder, [model.rest()] * 50)
        episode.frame(0.0, model.rest())
    with softmpm.Recording(path) as recording:
        assert len(recording.frames(0)["x"]) == 2


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="needs posix_fallocate to claim room")
def test_a_full_disk_at_the_start_is_an_error(tmp_path):
    """Without room for the beginning the file is named, and no draft stays."""
    run_here(starting, tmp_path)


def filling(folder: Path, rooms: Sequence[int]) -> None:
    """Record until the file meets a limit of the system on its size."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    for room in rooms:
        fill(folder / f"{room}.h5", room)


def starting(folder: Path) -> None:
    """Begin a recording where not even its beginning has room."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    model = small_model()
    for room in (1000, 4000, 20000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
        with pytest.raises(OSError, match=r"no room to record .*run\.h5\.new"):
            softmpm.Recorder(folder / "run.h5", model)
        assert not list(folder.iterdir())


def fill(path: Path, room: int) -> None:
    model, written = small_model(), 0
    recorder = softmpm.Recorder(path, model)
    limit = path.stat().st_size + 2**20 + room
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    episode = recorder.episode(0)
    for _ in range(2):
        failure = None
        while failure is None:
            try:
                episode.frame(0.0, model.rest(), field=torch.rand(*NODES, 2))
                written += 1
            except OSError as error:
                failure = str(error)
        assert "no room to record" in failure and str(path) in failure
    with softmpm.Recording(path) as recording:
        assert 0 < len(recording.rows(0)) == written < 100
    recorder.close()
    with softmpm.Recording(path) as recording:
        assert len(recording.frames(0)["x"]) == written
    assert path.stat().st_size <= limit - 2**20
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def run_here(function: Callable, *arguments: object) -> None:
    """Run a function of this file in a process of its own, to fork and die in."""
    done = forked.said(function, *arguments, timeout=100.0)
    assert done.returncode == 0, done.stderr


def test_the_name_of_a_contact_fits(monkeypatch):
    """However long the longest is: it was cut to 8 bytes, which is what "separate" has."""
    monkeypatch.setattr(softmpm.scene.scene, "CONTACTS", ("stick", "slip", "separate", "separate_slowly"))
    found = importlib.util.find_spec("softmpm.recording.format")
    layout = importlib.util.module_from_spec(found)
    found.loader.exec_module(layout)
    assert layout.STATIC["wall_contact"][0].itemsize == len("separate_slowly")


def test_frames_may_follow_while_a_recording_is_opened(tmp_path, monkeypatch):
    """Rows that came after the reader had looked at the file's size lie beyond that."""
    model, path = small_model(), tmp_path / "run.h5"
    real, frames = reader.readable, []
    with softmpm.Recorder(path, model) as recorder, recorder.episode(0) as episode:

        def one_more(path: Path):
            found = real(path)
            episode.frame(0.1 * len(frames), moved(model, len(frames)), field=torch.full((*NODES, 2), 1.0))
            frames.append(path)
            return found

        episode.frame(0.0, moved(model, -1.0))
        monkeypatch.setattr(reader, "readable", one_more)
        for _ in range(40):
            with softmpm.Recording(path) as recording:
                assert len(recording.frames(0)["x"]) == len(frames) + 1


@pytest.mark.parametrize("part", [True, False])
@pytest.mark.parametrize("when", ["before", "after"])
def test_a_recorder_goes_on_after_an_interrupt(tmp_path, monkeypatch, part, when):
    """Within a frame, as in a notebook: the frames before and after it are those that were given."""
    model, path = small_model(), tmp_path / "run.h5"
    field = torch.full((*NODES, 2), 1.0) if part else None
    with softmpm.Recorder(path, model) as recorder, recorder.episode(0) as episode:
        for k in range(3):
            episode.frame(0.1 * k, moved(model, k), field=field)
        real = recorder._write

        def interrupted(name: str, rows: np.ndarray) -> None:
            if when == "after":
                real(name, rows)
            raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(recorder, "_write", interrupted)
            with pytest.raises(KeyboardInterrupt):
                episode.frame(0.3, moved(model, 3), field=field)
        for k in (4, 5):
            episode.frame(0.1 * k, moved(model, k), field=field)
    with softmpm.Recording(path) as recording:
        found = recording.frames(0)
    given = [0, 1, 2, *([3] if when == "after" else []), 4, 5]
    np.testing.assert_allclose(found["time"], 0.1 * np.array(given))
    np.testing.assert_allclose(found["x"][:, 0, 0] - found["x"][0, 0, 0], given, atol=1e-5)
    assert not part or len(found["field"]) == len(given)


@pytest.mark.parametrize("before", [-1, 1.5, "3"])
def test_what_is_no_iteration_to_resume_before_is_refused(tmp_path, before):
    """It would drop the whole recording."""
    model, path = small_model(), tmp_path / "run.h5"
    with softmpm.Recorder(path, model) as recorder:
        record(recorder, model, 0)
    with pytest.raises((ValueError, TypeError), match="resume_before"):
        softmpm.Recorder(path, model, resume_before=before)
    with softmpm.Recording(path) as recording:
        assert recording.episodes == (0,)


def test_a_recording_is_open_where_it_was_opened(tmp_path, monkeypatch):
    """Also after a change of the folder, and of its name; a closed one says so."""
    model = small_model()
    monkeypatch.chdir(tmp_path)
    with softmpm.Recorder("run.h5", model) as recorder:
        record(recorder, model, 0)
    with softmpm.Recording("run.h5") as recording:
        (tmp_path / "sub").mkdir()
        monkeypatch.chdir(tmp_path / "sub")
        assert len(recording.frames(0)["x"]) == 4
        (tmp_path / "run.h5").rename(tmp_path / "other.h5")
        assert len(recording.frames(0)["x"]) == 4
    with pytest.raises(ValueError, match="run.h5: this recording is closed"):
        recording.frames(0)
