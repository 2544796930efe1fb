"""Checkpoints that survive a kill at any instant and notice a flipped bit.

A file is what ``torch.save`` writes, a zip archive, with the SHA-256 of everything before it as the archive's comment: so
``torch.load(path, weights_only=True)`` still reads it. It replaces the one before in one step, and that one is kept.
"""

import hashlib
import io
import logging
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

NAME, PREVIOUS = "checkpoint.pt", "checkpoint.previous.pt"
FORMAT = 1
_MARK = b"sha256="
_FOOTER = len(_MARK) + 64

logger = logging.getLogger("softmpm_learn")


class CheckpointError(RuntimeError):
    """No checkpoint could be read; says why each one could not."""


def save(folder: Path, content: dict) -> Path:
    """Write ``folder/checkpoint.pt``; the one before it, if it is intact, becomes ``checkpoint.previous.pt``.

    Args:
        content: Tensors, numbers, strings, lists and dicts: what ``torch.load(weights_only=True)`` reads.
    """
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, **content}, buffer)
    body = buffer.getvalue()
    body = body[:-2] + struct.pack("<H", _FOOTER)  # a zip archive ends with the length of its comment
    path, draft = folder / NAME, folder / (NAME + ".new")
    with open(draft, "wb") as file:
        file.write(body + _MARK + hashlib.sha256(body).hexdigest().encode())
        file.flush()
        os.fsync(file.fileno())
    if path.exists() and _intact(path.read_bytes()):
        os.replace(path, folder / PREVIOUS)
    os.replace(draft, path)
    _sync(folder)
    return path


def exists(folder: Path) -> bool:
    """Whether there is something to resume from."""
    return (folder / NAME).exists() or (folder / PREVIOUS).exists()


def load(folder: Path) -> dict:
    """The newest checkpoint of a folder that is intact; tensors on the CPU.

    Raises:
        CheckpointError: There is none.
    """
    problems = []
    for path in (folder / NAME, folder / PREVIOUS):
        try:
            content = read(path)
        except CheckpointError as error:
            problems.append(str(error))
            continue
        for problem in problems:
            logger.warning("%s Falling back to %s.", problem, path.name)
        return content
    raise CheckpointError(" ".join(problems))


def read(path: Path) -> dict:
    """One checkpoint file, verified before it is parsed."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{path} cannot be read: {error.strerror}.") from error
    if not _intact(data):
        raise CheckpointError(f"{path} is damaged: its SHA-256 does not match.")
    try:
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # PyTorch raises many kinds, all of which mean this
        raise CheckpointError(f"{path} is no checkpoint of tensors, numbers and texts: {error}") from error
    if content.get("format") != FORMAT:
        raise CheckpointError(f"{path} has format {content.get('format')!r}, this version reads {FORMAT}.")
    return content


def _intact(data: bytes) -> bool:
    body, footer = data[:-_FOOTER], data[-_FOOTER:]
    return footer == _MARK + hashlib.sha256(body).hexdigest().encode()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """One run at a time in a folder; the lock goes with the process, also if it is killed. No lock on Windows."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with open(folder / ".lock", "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            message = f"another run is writing to {folder}; choose another folder or wait for it."
            raise RuntimeError(message) from error
        yield


def _sync(folder: Path) -> None:
    """Make renames durable, where the system can."""
    if hasattr(os, "O_DIRECTORY"):
        descriptor = os.open(folder, os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
