"""A file that is damaged, or made to do harm, is refused with a sentence and reads nothing outside itself."""

import shutil

import h5py
import numpy as np
import pytest
import torch

import softmpm
from softmpm.recording import reader


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A small recording: two simulations of three frames."""
    positions = np.random.default_rng(0).uniform(0.2, 0.6, (300, 2))
    body = softmpm.Body(softmpm.Particles(positions, 1e-4), softmpm.NeoHookean(density=1.0, young=10.0))
    muscle = softmpm.Muscle(particles=np.arange(9), direction=(0, 1), strength=1.0)
    grid = softmpm.Grid(shape=(8, 8), spacing=0.125)
    model = softmpm.build(softmpm.Scene(grid=grid, bodies=[body], muscles=[muscle], dt=1e-3), device="cpu")
    path = tmp_path_factory.mktemp("recorded") / "run.h5"
    with softmpm.Recorder(path, model) as recorder:
        for iteration in range(2):
            with recorder.episode(iteration) as episode:
                for k in range(3):
                    field = torch.rand(8, 8, 2) if k == 1 else None
                    episode.frame(k, model.rest(), torch.rand(1), field, torch.rand(2))
            recorder.scalars(iteration, {"loss": 1.0})
    return path


@pytest.fixture
def copy(recorded, tmp_path):
    return shutil.copy(recorded, tmp_path / "copy.h5")


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    """No writer is at work that a reader of a damaged file should wait for."""
    monkeypatch.setattr(reader, "_PAUSE", 1e-4)


def read_all(path) -> int:
    with softmpm.Recording(path) as recording:
        return sum(len(recording.frames(iteration)["x"]) for iteration in recording.episodes)


def test_one_quantity_of_some_frames(recorded):
    """``read`` gives the rows that have a quantity, and only their values."""
    with softmpm.Recording(recorded) as recording:
        rows = recording.rows(1)
        assert list(rows) == [3, 4, 5]
        have, field = recording.read("field", rows)
        assert list(have) == list(recording.recorded("field", rows)) == [4] and field.shape == (1, 8, 8, 2)
        assert [len(part) for part in recording.read("x", [5])] == [1, 1]
        with pytest.raises(KeyError, match=r"no simulation of iteration 7; it has \[0, 1\]"):
            recording.rows(7)


def test_the_newer_of_two_simulations_of_an_iteration(tmp_path, recorded):
    """An iteration that was recorded twice gives its newer simulation."""
    with softmpm.Recording(recorded) as recording:
        positions = recording.static["positions"].astype(float)
    body = softmpm.Body(softmpm.Particles(positions, 1e-4), softmpm.NeoHookean(density=1.0, young=10.0))
    scene = softmpm.Scene(grid=softmpm.Grid(shape=(8, 8), spacing=0.125), bodies=[body], dt=1e-3)
    model = softmpm.build(scene, device="cpu")
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder:
        for take in (1, 2):
            recorder.episode(4, take=take).frame(take, model.rest())
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        assert recording.episodes == (4,) and recording.attributes(4) == {"take": 2}
        assert list(recording.frames(4)["time"]) == [2]


def test_other_files_are_named(tmp_path):
    """Missing, not HDF5, not a recording: each says which."""
    with pytest.raises(FileNotFoundError, match=r"there is no recording .*none\.h5"):
        softmpm.Recording(tmp_path / "none.h5")
    (tmp_path / "text.h5").write_text("hello")
    with pytest.raises(OSError, match="not a readable recording"):
        softmpm.Recording(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = [1, 2]
    with pytest.raises(ValueError, match="no softmpm recording"):
        softmpm.Recording(tmp_path / "other.h5")


def replace(path, name, make) -> None:
    """Put what ``make(file, group, leaf, old data)`` makes in the place of a dataset."""
    with h5py.File(path, "r+") as file:
        data, (group, leaf) = file[name][()], (f"/{name}").rsplit("/", 1)
        del file[name]
        make(file, file[group or "/"], leaf, data)


def external_link(file, group, leaf, data):
    group[leaf] = h5py.ExternalLink("secret.h5", "/secret")


def soft_link(file, group, leaf, data):
    file["elsewhere"] = data
    group[leaf] = h5py.SoftLink("/elsewhere")


def virtual(file, group, leaf, data):
    layout = h5py.VirtualLayout(data.shape, data.dtype)
    layout[:] = h5py.VirtualSource("secret.h5", "secret", data.shape, data.dtype)
    group.create_virtual_dataset(leaf, layout)


def external_storage(file, group, leaf, data):
    group.create_dataset(leaf, data.shape, data.dtype, external=[("secret.bin", 0, data.nbytes)])


def huge(file, group, leaf, data):
    group.create_dataset(leaf, (10**9, *data.shape[1:]), data.dtype, chunks=(1, *data.shape[1:]))


def huge_chunk(file, group, leaf, data):
    shape = (2**22, *data.shape[1:])
    group.create_dataset(
        leaf, (0, *data.shape[1:]), data.dtype, chunks=shape, maxshape=(None, *data.shape[1:])
    )


def objects(file, group, leaf, data):
    group.create_dataset(leaf, data.shape, h5py.string_dtype())


def wrong_shape(file, group, leaf, data):
    group[leaf] = np.zeros((len(data), 7, 2), data.dtype)


def foreign_filter(file, group, leaf, data):
    group.create_dataset(leaf, data=data, compression="lzf")


def a_group(file, group, leaf, data):
    group.create_group(leaf)


def nothing(file, group, leaf, data):
    pass


HARM = (external_link, soft_link, virtual, external_storage, huge, huge_chunk, objects, wrong_shape)


@pytest.mark.parametrize("make", [*HARM, foreign_filter, a_group, nothing])
@pytest.mark.parametrize("name", ["frame/x", "static/positions"])
def test_harmful_files_are_refused(copy, name, make):
    """Links, data of other files, sizes beyond the file, objects, other filters: refused before anything is read."""
    secret = copy.parent / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["secret"] = np.ones((6, 300, 2), np.float32)
    replace(copy, name, make)
    with pytest.raises(ValueError, match=str(copy)):
        softmpm.Recording(copy)


def declared_only(file, group, leaf, data):
    chunk = (1, *data.shape[1:])
    made = group.create_dataset(leaf, (2**14, *data.shape[1:]), data.dtype, chunks=chunk)
    made[: len(data)] = data


def packed(file, group, leaf, data):
    group.create_dataset(leaf, data=data, chunks=data.shape, compression="gzip")


@pytest.mark.parametrize(
    "make, name", [(declared_only, "frame/x"), (declared_only, "frame/v"), (packed, "static/volume")]
)
def test_what_is_declared_must_be_stored(copy, make, name):
    """Rows that were never written and packed zeros would take memory that the file does not."""
    replace(copy, name, make)
    with pytest.raises(ValueError, match=f"{name} (declares|uses HDF5 filters)"):
        softmpm.Recording(copy)


def put(path, table, row, **values) -> None:
    """Overwrite fields of one row, or of all."""
    with h5py.File(path, "r+") as file:
        rows = file[table][()]
        for name, value in values.items():
            rows[name][row] = value
        file[table][()] = rows


@pytest.mark.parametrize("text", [b"[1, 2]", b"[" * 4000, b"{", b"\xff", b"7"])
def test_attributes_that_are_no_object_are_named(copy, text):
    """A list, brackets without end, half an object, no UTF-8: an error that names the file, also from ``to_rerun``."""
    put(copy, "episode", 1, attributes=text)
    with softmpm.Recording(copy) as recording:
        assert recording.attributes(0) == {}
        with pytest.raises(OSError, match=r"copy\.h5 is damaged: the attributes of iteration 1"):
            recording.attributes(1)
    with pytest.raises(OSError, match=r"copy\.h5 is damaged: the attributes"):
        softmpm.to_rerun(copy)


@pytest.mark.parametrize(
    "table, values, message",
    [
        ("scalar", dict(name=b"\xff\xfe"), "the name of a scalar is not UTF-8"),
        ("frame/index", dict(field=99), "rows of field beyond the 2"),
        ("frame/index", dict(latent=-7), "rows of latent beyond"),
        ("frame/index", dict(field=1), "a row of field twice, or after a later one"),
        ("frame/index", dict(time=np.nan), "times in frame/index must be finite"),
    ],
)
def test_rows_that_name_nothing_are_refused(copy, table, values, message):
    """Names that are no text, rows beyond a table, times that are not finite: refused with the name of the file."""
    put(copy, table, 0, **values)
    with pytest.raises((OSError, ValueError), match=rf"copy\.h5.*{message}"):
        softmpm.Recording(copy)


def test_a_scene_that_is_not_finite_is_refused(copy):
    """Neither nan among the positions nor a step of nan nor a spacing of two numbers reaches a picture."""
    with h5py.File(copy, "r+") as file:
        file["static/positions"][3] = np.nan
    with pytest.raises(ValueError, match=r"copy\.h5: static/positions must be finite"):
        softmpm.Recording(copy)
    for value in (np.nan, [1.0, 2.0], "x", -1.0):
        with h5py.File(copy, "r+") as file:
            file.attrs["spacing"] = value
        with pytest.raises(ValueError, match=r"copy\.h5: the attribute spacing must be a number > 0"):
            softmpm.Recording(copy)


@pytest.mark.parametrize("name", [b"\xff\xfe", b"two\nlines", b" ", 65 * b"x"])
def test_a_name_that_no_muscle_has_is_refused(copy, name):
    """No UTF-8, a line end, spaces, too long: it would spoil the texts that show it."""
    with h5py.File(copy, "r+") as file:
        file["static/muscle_name"][0] = name
    with pytest.raises(
        ValueError, match=r"copy\.h5: each row of static/muscle_name must have at most 64 printable"
    ):
        softmpm.Recording(copy)


@pytest.mark.parametrize("group", ["frame", "static"])
def test_a_group_of_another_file_is_refused(recorded, copy, group):
    """A whole group cannot come from elsewhere either."""
    with h5py.File(copy, "r+") as file:
        del file[group]
        file[group] = h5py.ExternalLink(str(recorded), group)
    with pytest.raises(ValueError, match="leads out of the file"):
        softmpm.Recording(copy)


def test_another_version_is_named(copy):
    """A file of a later softmpm says so."""
    with h5py.File(copy, "r+") as file:
        file.attrs["version"] = 99
    with pytest.raises(ValueError, match="format version 99; this softmpm reads 1"):
        softmpm.Recording(copy)


def test_a_shortened_file_is_an_error(copy):
    """Cut anywhere, the file is refused or the missing frame is named; never a crash, never wrong numbers."""
    whole = copy.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 40).astype(int):
        copy.write_bytes(whole[:length])
        with pytest.raises((OSError, ValueError), match=r"copy\.h5"):
            read_all(copy)


@pytest.mark.parametrize("name", ["frame/x", "frame/index", "field/velocity", "scalar", "static/positions"])
def test_a_flipped_bit_is_found(copy, name):
    """Data carries checksums: one flipped bit is an error that names the file, and the row if it is in a frame."""
    with h5py.File(copy, "r") as file:
        chunk = file[name].id.get_chunk_info(0)
    whole = copy.read_bytes()
    for at in np.linspace(chunk.byte_offset, chunk.byte_offset + chunk.size - 1, 9).astype(int):
        damaged = bytearray(whole)
        damaged[at] ^= 4
        copy.write_bytes(damaged)
        with pytest.raises(
            OSError, match=r"copy\.h5 is damaged: " + ("row 0 of " + name if "/x" in name else "")
        ):
            read_all(copy)
    copy.write_bytes(whole)
    assert read_all(copy) == 6
