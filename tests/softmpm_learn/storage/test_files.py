"""Files are replaced whole, links are not followed, and errors name the file."""

import errno
import os

import pytest

from softmpm_learn.storage import files


def test_a_file_is_replaced_and_its_links_are_not_followed(tmp_path):
    """A draft or a file that is a link, symbolic or hard, is replaced itself; what it named stays as it was."""
    other, path = tmp_path / "other", tmp_path / "file"
    for link in (os.symlink, os.link):
        other.write_bytes(b"precious")
        link(other, tmp_path / "file.new")
        files.replace(path, b"first")
        path.unlink()
        link(other, path)
        files.replace(path, b"second")
        assert path.read_bytes() == b"second" and other.read_bytes() == b"precious"
        assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "other"]
        path.unlink()


def test_links_are_not_read_appended_to_or_locked(tmp_path):
    """Each refusal names the link."""
    (tmp_path / "other").write_bytes(b"precious")
    (tmp_path / "link").symlink_to(tmp_path / "other")
    for work in (files.read, lambda path: files.append(path, b"x"), lock):
        with pytest.raises(OSError, match=r"cannot (read|write|open) .*link: "):
            work(tmp_path / "link")
    assert (tmp_path / "other").read_bytes() == b"precious"


def lock(path) -> None:
    with files.opened_for_lock(path):
        pass


def test_a_lock_is_not_emptied(tmp_path):
    """The contents of the file remain; a missing file is created."""
    (tmp_path / "full").write_bytes(b"text")
    lock(tmp_path / "full")
    lock(tmp_path / "new")
    assert (tmp_path / "full").read_bytes() == b"text" and (tmp_path / "new").read_bytes() == b""


def test_a_full_disk_names_the_file(tmp_path, monkeypatch):
    """The number of the error is for programs; people get the path. The old file stays."""
    files.replace(tmp_path / "file", b"old")

    def full(_descriptor):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    for work in (files.replace, files.append):
        with pytest.raises(OSError, match=r"^cannot write .*file(\.new)?: No space left on device\.$"):
            work(tmp_path / "file", b"")
    assert files.read(tmp_path / "file") == b"old" and files.read(tmp_path / "file", 2) == b"ol"
