"""Checkpoints that survive a kill at any instant and notice a flipped bit.

A file is what ``torch.save`` writes, a zip archive, with the SHA-256 of everything before it as the archive's comment: so
``torch.load(path, weights_only=True)`` still reads it. It replaces the one before in one step, and that one is kept.
"""

import hashlib
import io
import logging
import os
import struct
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from softmpm_learn.storage import files

NAME, PREVIOUS = "checkpoint.pt", "checkpoint.previous.pt"
FORMAT = 3
_MARK = b"sha256="
_FOOTER = len(_MARK) + 64

logger = logging.getLogger("softmpm_learn")


class CheckpointError(RuntimeError):
    """No checkpoint could be read; says why each one could not."""


class LockedError(RuntimeError):
    """Another run writes to the folder."""


def save(folder: Path, content: dict) -> Path:
    """Write ``folder/checkpoint.pt``; the one before it, if it is intact, becomes ``checkpoint.previous.pt``.

    Args:
        content: Tensors, numbers, strings, lists and dicts: what ``torch.load(weights_only=True)`` reads.

    Raises:
        CheckpointError: It could not be read again; the older files are as they were.
    """
    buffer = io.BytesIO()
    content = {"format": FORMAT, **_compact(content)}
    torch.save(content, buffer)
    body = buffer.getvalue()
    body = body[:-2] + struct.pack("<H", _FOOTER)  # a zip archive ends with the length of its comment
    path = folder / NAME
    _need_readable(content, body, path)
    draft = files.draft(path, body + _MARK + hashlib.sha256(body).hexdigest().encode())
    with files.named("write", path):
        if path.exists() and _intact(files.read(path)):
            os.replace(path, folder / PREVIOUS)
        os.replace(draft, path)
        _sync(folder)
    return path


def _need_readable(content: dict, body: bytes, path: Path) -> None:
    """Raise CheckpointError for what :func:`read` would refuse. Types are checked by reading the first two files: the second has the
    state of an optimizer that has taken a step."""
    try:
        _check_content(content)
        if not path.with_name(PREVIOUS).exists():
            torch.load(io.BytesIO(body), map_location="cpu", weights_only=True)
    except Exception as error:
        problem = str(error).split("WeightsUnpickler error:")[-1].strip().split("\n")[0]
        raise CheckpointError(
            f"no checkpoint was written to {path}, for it could not be read again: {problem}. Parts of a policy, an observer or "
            "an optimizer must be finite tensors, numbers and texts; a buffer with persistent=False is not saved."
        ) from error


def _compact(value: Any) -> Any:
    """The same with tensors that have their memory to themselves: of parts of larger ones PyTorch would write the rest as well, and one
    that is expanded has less than its numbers."""
    if isinstance(value, Tensor):
        return value.clone() if value.untyped_storage().nbytes() != value.nbytes else value
    if isinstance(value, dict):
        return {key: _compact(item) for key, item in value.items()}
    return [_compact(item) for item in value] if isinstance(value, list) else value


def exists(folder: Path) -> bool:
    """True if the folder has a checkpoint to resume from."""
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


def simulations(folder: Path) -> list[int]:
    """Numbers of the simulations of the replay buffer that a checkpoint of a folder names, the newest or the one before."""
    named = set()
    for path in (folder / NAME, folder / PREVIOUS):
        with suppress(CheckpointError):
            named |= set((read(path)["learner"] or {"replay": {}})["replay"])
    return sorted(named)


def read(path: Path) -> dict:
    """One checkpoint file, verified before it is parsed."""
    try:
        data = files.read(path)
    except OSError as error:
        reason = getattr(error.__cause__, "strerror", error)
        raise CheckpointError(f"{path} cannot be read: {reason}.") from error
    if not _intact(data):
        raise CheckpointError(f"{path} is damaged: its SHA-256 does not match.")
    try:
        _check_archive(data)
        content = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
        _check_content(content)
    except Exception as error:  # PyTorch raises many kinds, all of which mean this
        problem = " ".join(str(error).split())
        raise CheckpointError(f"{path} is no checkpoint of tensors, numbers and texts: {problem}") from error
    if content.get("format") != FORMAT:
        raise CheckpointError(
            f"{path} has format {content.get('format')!r}, this version reads {FORMAT}; the softmpm that wrote it can go on with it."
        )
    return content


def _intact(data: bytes) -> bool:
    body, footer = data[:-_FOOTER], data[-_FOOTER:]
    return footer == _MARK + hashlib.sha256(body).hexdigest().encode()


def _check_archive(data: bytes) -> None:
    """Raise ValueError for an archive that takes more memory than it has bytes: packed, or with parts that overlap."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = archive.infolist()
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise ValueError("its parts are compressed")
    if (size := sum(entry.file_size for entry in entries)) > len(data):
        raise ValueError(f"its parts declare {size} bytes, the file has {len(data)}")


def _check_content(content: object) -> None:
    """Raise ValueError for what is no dict, and for tensors that repeat few numbers many times or are not finite."""
    if not isinstance(content, dict):
        raise ValueError(f"it holds a {type(content).__name__}")
    for name, tensor in _tensors(content, ""):
        if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            raise ValueError(
                f"{name} of shape {tuple(tensor.shape)} stores only {tensor.untyped_storage().nbytes()} bytes"
            )
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise ValueError(f"{name} is not finite")


def _tensors(value: object, name: str) -> Iterable[tuple[str, Tensor]]:
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _tensors(item, f"{name}.{key}" if name else str(key))
    elif isinstance(value, (list, tuple)):
        for k, item in enumerate(value):
            yield from _tensors(item, f"{name}[{k}]")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """One run at a time in a folder; the lock goes with the process, also if it is killed. No lock on Windows.

    Raises:
        LockedError: Another run has it.
    """
    try:
        import fcntl
    except ImportError:
        yield
        return
    with files.opened_for_lock(folder / ".lock") as descriptor:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            message = f"another run is writing to {folder}; choose another folder or wait for it."
            raise LockedError(message) from error
        yield


def _sync(folder: Path) -> None:
    """Make renames durable, where the system can."""
    if hasattr(os, "O_DIRECTORY"):
        descriptor = os.open(folder, os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
