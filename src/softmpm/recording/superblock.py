"""Superblock of an HDF5 file: presents a recording whose writer is active or was killed as a closed file.

HDF5 marks an open file in its superblock, and reads a marked file only in a mode that waits for the writer to
correct checksum mismatches, for ever if the writer is dead or the file is damaged. Read as if it were unmarked, a
damaged file is rejected at once; an intact one reads the same, because the recorder leaves the file consistent
after every write. Source: HDF5 File Format Specification 3.0, II.A, superblock version 3.
"""

import io
import os
import struct
from pathlib import Path

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_LENGTH = 48  # of the superblock with 8-byte addresses
_FLAGS, _END, _CHECKSUM = 11, slice(28, 36), slice(44, 48)
_WORD = 0xFFFFFFFF
_ROOM = 2**48
"""Size of a recording that is being written, as HDF5 is told: what the writer adds is at places that it may read."""


def readable(path: Path) -> "str | Unmarked":
    """The path for HDF5 to open, or the bytes of a file that is marked as open, without the mark.

    Raises:
        OSError: The superblock is damaged, or the file was cut short.
    """
    with open(path, "rb") as file:
        head, size = file.read(_LENGTH), os.fstat(file.fileno()).st_size
    if len(head) < _LENGTH or head[:9] != _SIGNATURE + b"\x03" or head[9:11] != b"\x08\x08":
        return str(path)  # another version or no HDF5 file: HDF5 knows
    if head[_CHECKSUM] != _checksum(head[:44]):
        raise OSError("its first 48 bytes do not match their checksum")
    end = int.from_bytes(head[_END], "little")
    if size < end:
        raise OSError(f"it was cut to {size} of at least {end} bytes")
    if not head[_FLAGS]:
        return str(path)
    new = bytearray(head)
    new[_FLAGS], new[_END] = (
        0,
        struct.pack("<Q", _ROOM),
    )  # the writer adds more than it noted, also while the file is read
    new[_CHECKSUM] = _checksum(bytes(new[:44]))
    return Unmarked(path, bytes(new))


class Unmarked(io.RawIOBase):
    """A file whose first bytes are replaced, for h5py's driver of Python files.

    Its size is that of the superblock, more than a file ever has: a read beyond the real end fails by itself.
    """

    def __init__(self, path: Path, head: bytes):
        self._file, self._head, self._at = open(path, "rb", buffering=0), head, 0  # noqa: SIM115

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: _ROOM}[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer) -> int:
        """Fill the whole buffer, since HDF5 would take unfilled bytes for data."""
        view, start, done = memoryview(buffer).cast("B"), self._at, 0
        self._file.seek(start)
        while done < len(view):
            count = self._file.readinto(view[done:])
            if not count:
                raise OSError(f"it ends at {start + done} bytes, where more should be")
            done += count
        head = self._head[start : start + len(view)]
        view[: len(head)] = head
        self._at += len(view)
        return len(view)

    def close(self) -> None:
        self._file.close()
        super().close()


def _checksum(data: bytes) -> bytes:
    """HDF5's checksum of metadata, for lengths that are a multiple of 4 and not of 12.

    Source: Bob Jenkins 2006, lookup3.c, hashlittle with the initial value 0.
    """
    a = b = c = (0xDEADBEEF + len(data)) & _WORD
    words = struct.unpack(f"<{len(data) // 4}I", data)
    whole = len(words) // 3 * 3
    for k in range(0, whole, 3):
        a, b, c = ((x + y) & _WORD for x, y in zip((a, b, c), words[k : k + 3], strict=True))
        a, b, c = _mix(a, b, c)
    rest = (*words[whole:], 0, 0)
    return struct.pack("<I", _final((a + rest[0]) & _WORD, (b + rest[1]) & _WORD, c))


def _turn(x: int, by: int) -> int:
    return (x << by | x >> (32 - by)) & _WORD


def _mix(a: int, b: int, c: int) -> tuple[int, int, int]:
    for by in (4, 6, 8, 16, 19, 4):
        a, c = ((a - c) & _WORD) ^ _turn(c, by), (c + b) & _WORD
        a, b, c = b, c, a
    return a, b, c


def _final(a: int, b: int, c: int) -> int:
    for by in (14, 11, 25, 16, 4, 14, 24):
        c = ((c ^ b) - _turn(b, by)) & _WORD
        a, b, c = b, c, a
    return b
