import contextlib
import hashlib
import math
import os
import zipfile

import numpy as np
import pytest
import torch

from softmpm_learn.storage import checkpoint


def content(value: float) -> dict:
    return {"value": value, "weights": torch.full((50,), value), "ids": [1, 2], "name": "block"}


def same(a: dict, b: dict) -> bool:
    return a["value"] == b["value"] and torch.equal(a["weights"], b["weights"]) and a["ids"] == b["ids"]


def test_what_is_saved_comes_back(tmp_path):
    """The newest checkpoint is loaded; the file is also a plain PyTorch file that loads without running code."""
    assert not checkpoint.exists(tmp_path)
    checkpoint.save(tmp_path, content(1.0))
    path = checkpoint.save(tmp_path, content(2.0))
    assert checkpoint.exists(tmp_path) and same(checkpoint.load(tmp_path), content(2.0))
    assert same(torch.load(path, weights_only=True), content(2.0))
    assert same(checkpoint.read(tmp_path / checkpoint.PREVIOUS), content(1.0))


def test_a_part_of_a_larger_tensor_takes_its_own_memory(tmp_path):
    """Also within lists and dicts; PyTorch alone would write the whole tensor with each part."""
    large = torch.arange(1e5)
    alone = checkpoint.save(tmp_path, {"a": {"b": [large[7:9].clone()]}}).stat().st_size
    path = checkpoint.save(tmp_path, {"a": {"b": [large[7:9]]}})
    assert path.stat().st_size == alone < 1e5
    assert torch.equal(checkpoint.load(tmp_path)["a"]["b"][0], large[7:9])


def test_an_expanded_tensor_comes_back(tmp_path):
    """It has less memory than numbers, by which a file would be refused."""
    checkpoint.save(tmp_path, {"mask": torch.ones(1).expand(3)})
    assert checkpoint.load(tmp_path)["mask"].tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    "value, said",
    [(torch.tensor([0.0, math.inf]), "limit is not finite"), (np.float64(1.0), "Unsupported global.*numpy")],
)
def test_what_could_not_be_read_again_is_not_written(tmp_path, value, said):
    """The older file stays as it was, and the sentence says what is wrong and what helps."""
    checkpoint.save(tmp_path, content(1.0))
    with pytest.raises(
        checkpoint.CheckpointError, match=f"could not be read again: {said}.*persistent=False"
    ):
        checkpoint.save(tmp_path, {"limit": value})
    assert same(checkpoint.load(tmp_path), content(1.0)) and not (tmp_path / checkpoint.PREVIOUS).exists()


def test_every_flipped_bit_is_noticed(tmp_path):
    """One bit anywhere, a file cut short or emptied: the one before is loaded instead, with a warning in the log."""
    checkpoint.save(tmp_path, content(1.0))
    path = checkpoint.save(tmp_path, content(2.0))
    whole = path.read_bytes()
    for place in range(0, len(whole), 13):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << (place % 8)
        path.write_bytes(spoilt)
        assert same(checkpoint.load(tmp_path), content(1.0)), place
    for length in (0, 1, 100, len(whole) - 1):
        path.write_bytes(whole[:length])
        assert same(checkpoint.load(tmp_path), content(1.0)), length


def test_falling_back_is_said(tmp_path, caplog):
    """The log names the damaged file; without an intact one the error names both."""
    checkpoint.save(tmp_path, content(1.0))
    checkpoint.save(tmp_path, content(2.0)).write_bytes(b"")
    checkpoint.load(tmp_path)
    assert (
        "checkpoint.pt is damaged" in caplog.text and "Falling back to checkpoint.previous.pt" in caplog.text
    )
    (tmp_path / checkpoint.PREVIOUS).unlink()
    with pytest.raises(
        checkpoint.CheckpointError, match=r"checkpoint\.pt is damaged.*previous\.pt cannot be read"
    ):
        checkpoint.load(tmp_path)


def test_a_damaged_checkpoint_does_not_push_out_a_good_one(tmp_path):
    """Saving over a damaged file keeps the intact one before it as the previous."""
    checkpoint.save(tmp_path, content(1.0))
    checkpoint.save(tmp_path, content(2.0)).write_bytes(b"spoilt")
    checkpoint.save(tmp_path, content(3.0)).write_bytes(b"spoilt too")
    assert same(checkpoint.load(tmp_path), content(1.0))


@pytest.mark.parametrize("call", ["replace", "fsync"])
@pytest.mark.parametrize("nth", [0, 1, 2])
def test_a_kill_at_any_step_of_writing_loses_one_checkpoint_at_most(tmp_path, monkeypatch, call, nth):
    """Ending at each system call of a save leaves either the new or the old content, whole."""
    checkpoint.save(tmp_path, content(1.0))
    checkpoint.save(tmp_path, content(2.0))
    real, count = getattr(os, call), iter(range(99))

    def dies(*args):
        if next(count) == nth:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(os, call, dies)
    with contextlib.suppress(KeyboardInterrupt):
        checkpoint.save(tmp_path, content(3.0))
    monkeypatch.undo()
    found = checkpoint.load(tmp_path)
    assert same(found, content(2.0)) or same(found, content(3.0))


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    """An error while writing reaches the caller and spoils nothing."""
    checkpoint.save(tmp_path, content(1.0))

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(tmp_path, content(2.0))
    monkeypatch.undo()
    assert same(checkpoint.load(tmp_path), content(1.0))


def test_other_formats_are_named(tmp_path, monkeypatch):
    """A file of another version says which one it is."""
    monkeypatch.setattr(checkpoint, "FORMAT", 99)
    path = checkpoint.save(tmp_path, content(1.0))
    monkeypatch.undo()
    with pytest.raises(checkpoint.CheckpointError, match="format 99, this version reads 3"):
        checkpoint.read(path)


def anything(monkeypatch) -> None:
    """Let ``save`` write whatever it is given, as another program may have."""
    monkeypatch.setattr(checkpoint, "_need_readable", lambda *_: None)
    monkeypatch.setattr(checkpoint, "_compact", lambda value: value)


def test_code_in_a_checkpoint_does_not_run(tmp_path, monkeypatch):
    """A pickle that calls a function is refused even if its digest is right."""

    class Evil:
        def __reduce__(self):
            return (os.mkdir, (str(tmp_path / "evil"),))

    anything(monkeypatch)
    path = checkpoint.save(tmp_path, {"evil": Evil()})
    with pytest.raises(checkpoint.CheckpointError, match="no checkpoint of tensors"):
        checkpoint.read(path)
    assert not (tmp_path / "evil").exists()


def test_one_run_at_a_time(tmp_path):
    """A second lock on the folder is refused while the first is held, and not after."""
    pytest.importorskip("fcntl")
    refused = pytest.raises(RuntimeError, match="another run is writing")
    with checkpoint.locked(tmp_path), refused, checkpoint.locked(tmp_path):
        pass
    with checkpoint.locked(tmp_path):
        pass


def test_a_checkpoint_takes_no_more_memory_than_it_has_bytes(tmp_path, monkeypatch):
    """Numbers repeated by a stride of 0, compressed parts, and what is not finite are refused although the hash is right."""
    anything(monkeypatch)
    for name, tensor in (("long", torch.zeros(1).expand(10**9)), ("nan", torch.tensor([1.0, float("nan")]))):
        path = checkpoint.save(tmp_path, {"list": [{name: tensor}]})
        with pytest.raises(checkpoint.CheckpointError, match=rf"list\[0\]\.{name} (of shape|is not finite)"):
            checkpoint.read(path)
    path = checkpoint.save(tmp_path, {"zeros": torch.zeros(10**6)})
    with (
        zipfile.ZipFile(path) as archive,
        zipfile.ZipFile(tmp_path / "packed", "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for entry in archive.namelist():
            packed.writestr(entry, archive.read(entry))
    body = (tmp_path / "packed").read_bytes()[:-2] + (71).to_bytes(2, "little")
    path.write_bytes(body + b"sha256=" + hashlib.sha256(body).hexdigest().encode())
    with pytest.raises(checkpoint.CheckpointError, match="its parts are compressed"):
        checkpoint.read(path)
