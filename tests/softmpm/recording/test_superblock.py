"""A recording whose writer was killed is read like one that was closed, and at once refused if it is damaged."""

import shutil

import h5py
import numpy as np
import pytest

import softmpm
from softmpm.recording.superblock import Unmarked, readable


@pytest.fixture
def killed(tmp_path):
    """A recording as a killed writer leaves it: marked as open."""
    body = softmpm.Body(
        softmpm.Particles(np.random.default_rng(0).uniform(0.2, 0.6, (90, 2)), 1e-4),
        softmpm.NeoHookean(density=1.0, young=10.0),
    )
    scene = softmpm.Scene(grid=softmpm.Grid(shape=(8, 8), spacing=0.125), bodies=[body], dt=1e-3)
    model = softmpm.build(scene, device="cpu")
    with softmpm.Recorder(tmp_path / "live.h5", model) as recorder:
        for k in range(3):
            recorder.episode(k).frame(0.1 * k, model.rest())
            recorder.scalars(k, {"loss": 1.0 + k})
        shutil.copy(tmp_path / "live.h5", tmp_path / "run.h5")
    return tmp_path / "run.h5"


def read_all(path) -> None:
    with softmpm.Recording(path) as recording:
        for iteration in recording.episodes:
            recording.frames(iteration)


def test_only_a_marked_file_is_disguised(killed):
    """HDF5 itself refuses the file of a killed writer; a closed one goes to HDF5 as it is."""
    with pytest.raises(OSError, match="already open for write"):
        h5py.File(killed, "r")
    assert isinstance(readable(killed), Unmarked)
    assert readable(killed.with_name("live.h5")) == str(killed.with_name("live.h5"))


def test_a_sound_file_reads_the_same(killed):
    """Every number of the killed writer's file is that of the file that was closed; neither is changed."""
    before = killed.read_bytes()
    with softmpm.Recording(killed) as got, softmpm.Recording(killed.with_name("live.h5")) as want:
        assert got.episodes == want.episodes == (0, 1, 2)
        for iteration in want.episodes:
            for name, values in want.frames(iteration).items():
                np.testing.assert_array_equal(got.frames(iteration)[name], values)
        assert list(got.scalars["loss"][1]) == [1.0, 2.0, 3.0]
    assert killed.read_bytes() == before


@pytest.mark.parametrize("where", [b"OHDR", b"EAHD", b"EAIB"])
def test_a_flipped_bit_is_refused_at_once(killed, where):
    """HDF5's own mode for such files waits for the dead writer to mend the bit, for ever."""
    data = bytearray(killed.read_bytes())
    data[data.index(where) + 12] ^= 1
    killed.write_bytes(data)
    with pytest.raises(OSError, match=r"run\.h5 is (damaged|not a readable)"):
        read_all(killed)


@pytest.mark.parametrize("flags", [1, 4, 5, 255])
def test_a_damaged_mark_is_refused(killed, flags):
    """A closed file with damaged flags, which mark it as open, does not match its checksum."""
    data = bytearray(killed.with_name("live.h5").read_bytes())
    data[11] = flags
    killed.write_bytes(data)
    with pytest.raises(OSError, match=r"run\.h5 .*do not match their checksum"):
        softmpm.Recording(killed)
