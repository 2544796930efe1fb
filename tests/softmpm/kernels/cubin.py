"""Resource usage of the kernels of a CUDA binary: registers and local memory, read from its ELF sections without the CUDA toolkit.

The section ``.nv.info`` is a list of attributes, each a format, a number, a size and the value; those below hold the index of a
symbol and what is said about it. A binary with line numbers (Warp's option ``lineinfo``) also contains the PTX it was assembled from.
"""

import re
import struct
from dataclasses import dataclass
from pathlib import Path

REGISTERS, FRAME, STACK = 0x2F, 0x11, 0x12
SIZED = 0x04  # a format: the size is followed by so many bytes


@dataclass
class Kernel:
    registers: int = 0
    """Of a thread."""
    frame: int = -1
    """Bytes of a thread in local memory: arrays of its own and spilled registers; -1 if nothing is said."""
    stack: int = -1
    """The same, with that of what it calls."""


def _text(table: bytes, start: int) -> str:
    return table[start : table.index(b"\0", start)].decode()


def _sections(data: bytes) -> dict[str, bytes]:
    (start,) = struct.unpack_from("<Q", data, 0x28)
    size, count, names = struct.unpack_from("<HHH", data, 0x3A)
    headers = [struct.unpack_from("<IIQQQQ", data, start + i * size) for i in range(count)]
    bodies = [data[place : place + length] for _, _, _, _, place, length in headers]
    return {_text(bodies[names], header[0]): body for header, body in zip(headers, bodies, strict=True)}


def kernels(path: Path) -> dict[str, Kernel]:
    """Each kernel of a cubin by its name."""
    sections = _sections(path.read_bytes())
    table = struct.iter_unpack("<IBBHQQ", sections[".symtab"])
    symbols = [_text(sections[".strtab"], entry[0]) for entry in table]
    found = {name.removeprefix(".nv.info."): Kernel() for name in sections if name.startswith(".nv.info.")}
    info, at = sections[".nv.info"], 0
    while at < len(info):
        form, attribute, size = struct.unpack_from("<BBH", info, at)
        at += 4
        if form != SIZED:
            continue
        if attribute in (REGISTERS, FRAME, STACK):
            symbol, value = struct.unpack_from("<II", info, at)
            if symbols[symbol] in found:
                name = {REGISTERS: "registers", FRAME: "frame", STACK: "stack"}[attribute]
                setattr(found[symbols[symbol]], name, value)
        at += size
    return found


def ptx(path: Path) -> str:
    """PTX of a cubin with line numbers; lines are not indented."""
    return _sections(path.read_bytes())[".nv_debug_ptx_txt"].replace(b"\0", b"\n").decode()


def entries(ptx: str) -> dict[str, str]:
    """Code of each kernel in a PTX module by its name."""
    _, *parts = re.split(r"\.visible \.entry ", ptx.rstrip("\0"))
    return {part[: part.index("(")]: part for part in parts}


def arrays(code: str) -> int:
    """Bytes of the local arrays that a PTX kernel itself declares; what a binary uses beyond them are spilled registers."""
    return sum(int(size) for size in re.findall(r"\.local .*__local_depot\d+\[(\d+)\]", code))
