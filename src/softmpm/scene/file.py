"""Scenes as files: a zip archive of ``scene.json``, the structure, and one ``.npy`` member per array, as in NumPy's ``.npz``.

    {"format": "softmpm scene", "version": 1, "scene": {"type": "Scene", "grid": {"type": "Grid", "shape": [64, 64], ...}, ...}}

An object is its type with its fields, an array ``{"array": "bodies/0/particles/positions"}`` the name of its member. The members are
not compressed, so that a file declares no more than it has. A scene may come from another person: only the types below are made, by
constructors that check their values, and nothing is unpickled.
"""

import io
import json
import math
import zipfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from softmpm.draft import draft
from softmpm.scene.actuators import Muscle, Pressure
from softmpm.scene.materials import BarrierCorotated, FixedCorotated, NeoHookean, StableNeoHookean
from softmpm.scene.outline import Outline
from softmpm.scene.scene import Body, Grid, Particles, Scene, Wall
from softmpm.validate import need

FORMAT, VERSION = "softmpm scene", 1
TYPES: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        *(Scene, Grid, Body, Particles, Outline, Muscle, Pressure, Wall),
        *(NeoHookean, StableNeoHookean, FixedCorotated, BarrierCorotated),
    )
}
"""All types of which a file may have objects, by name."""
_STRUCTURE, _ARRAY = "scene.json", ".npy"
_DTYPES = (np.dtype("<f8"), np.dtype("<i8"))
_DATE = (1980, 1, 1, 0, 0, 0)  # of all members, so that equal scenes have equal files


def save_scene(scene: Scene, path: str | Path) -> None:
    """Write a scene to a file, with every number to the last bit. A file of that name is replaced once the new one is complete.

    Args:
        scene: What :func:`softmpm.build` takes.
        path: The file, such as ``robot.scene``. ``numpy.load`` reads its arrays.

    Raises:
        TypeError: ``scene`` is no :class:`softmpm.Scene`, or has an object of a type that the format does not know.
        OSError: The file cannot be written.
    """
    if not isinstance(scene, Scene):
        raise TypeError(f"save_scene needs a softmpm.Scene, got {type(scene).__name__}.")
    path, arrays = Path(path), {}
    structure = {"format": FORMAT, "version": VERSION, "scene": _encoded(scene, "", arrays)}
    with draft(path) as place, zipfile.ZipFile(place, "w") as file:
        file.writestr(zipfile.ZipInfo(_STRUCTURE, _DATE), json.dumps(structure, indent=1))
        for name, values in arrays.items():
            data = io.BytesIO()
            np.lib.format.write_array(data, values, version=(1, 0), allow_pickle=False)
            file.writestr(zipfile.ZipInfo(name + _ARRAY, _DATE), data.getvalue())


def load_scene(path: str | Path) -> Scene:
    """Scene of a file that :func:`softmpm.save_scene` wrote.

    Rules that need the whole scene, such as bodies inside the grid, are checked by :func:`softmpm.build`, as for any other scene.

    Raises:
        FileNotFoundError, OSError: There is no such file, or it cannot be read.
        ValueError: The file is damaged, no scene, of a newer version, or has values that a scene must not have.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no scene file {path}.")
    data = path.read_bytes()
    try:
        return _loaded(data)
    except Exception as error:  # whatever a damaged archive makes of its readers
        raise ValueError(
            f"{path} is not a readable scene file: {str(error) or type(error).__name__}"
        ) from error


def _encoded(value: Any, where: str, arrays: dict[str, np.ndarray]) -> Any:
    """The value as JSON has it; its arrays are added to ``arrays``."""
    if type(value) in TYPES.values():
        names = [field.name for field in fields(value)]
        parts = {name: _encoded(getattr(value, name), f"{where}/{name}", arrays) for name in names}
        return {"type": type(value).__name__, **parts}
    if isinstance(value, np.ndarray) and value.dtype in _DTYPES:
        arrays[where[1:]] = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        return {"array": where[1:]}
    if isinstance(value, tuple):
        return [_encoded(part, f"{where}/{k}", arrays) for k, part in enumerate(value)]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.bool_):
        return bool(value)
    raise TypeError(
        f"scene{where} is a {type(value).__name__}, which a scene file cannot hold; it knows {', '.join(TYPES)}."
    )


def _loaded(data: bytes) -> Scene:
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = file.infolist()
        names = [member.filename for member in members]
        need(_STRUCTURE in names, f"it has no {_STRUCTURE}.")
        need(len(set(names)) == len(names), "it has two members of the same name.")
        stored = all(member.compress_type == zipfile.ZIP_STORED for member in members)
        need(
            stored and sum(member.file_size for member in members) <= len(data), "its members are compressed."
        )
        found = {name: file.read(name) for name in names}
    structure = json.loads(found.pop(_STRUCTURE))
    need(isinstance(structure, dict) and structure.get("format") == FORMAT, f"its format is not {FORMAT!r}.")
    version = structure.get("version")
    need(version == VERSION, f"it has version {version!r}; this softmpm reads version {VERSION}.")
    arrays = {name.removesuffix(_ARRAY): content for name, content in found.items()}
    scene = _decoded(structure.get("scene"), "scene", arrays)
    need(isinstance(scene, Scene), f"it must have a Scene, got {type(scene).__name__}.")
    need(not arrays, f"no object has the array {next(iter(arrays), '')!r}.")
    return scene


def _decoded(value: Any, where: str, arrays: dict[str, bytes]) -> Any:
    """Inverse of :func:`_encoded`; takes the arrays that it finds out of ``arrays``."""
    if isinstance(value, list):
        return [_decoded(part, f"{where}[{k}]", arrays) for k, part in enumerate(value)]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"array"}:
        content = arrays.pop(str(value["array"]), None)
        if content is None:
            raise ValueError(f"{where}: there is no array {value['array']!r}, or another object has it.")
        return _array(content, where)
    name = str(value.get("type"))
    need(name in TYPES, f"{where} has the unknown type {name!r}; known are {', '.join(TYPES)}.")
    kind = TYPES[name]
    unknown = value.keys() - {field.name for field in fields(kind)} - {"type"}
    need(not unknown, f"{where}: a {name} has no {', '.join(sorted(unknown))}.")
    parts = {
        part: _decoded(inner, f"{where}.{part}", arrays) for part, inner in value.items() if part != "type"
    }
    try:
        return kind(**parts)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def _array(content: bytes, where: str) -> np.ndarray:
    """Array of a member, of which all declared data are there."""
    stream = io.BytesIO(content)
    need(
        np.lib.format.read_magic(stream) == (1, 0),
        f"{where}: its array has another version of .npy than 1.0.",
    )
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(stream)
    need(
        dtype in _DTYPES and not by_columns,
        f"{where}: its array has the type {dtype}, or the order of Fortran.",
    )
    start = stream.tell()
    size = math.prod(shape) * dtype.itemsize
    need(
        size == len(content) - start,
        f"{where}: its array declares {size} bytes and has {len(content) - start}.",
    )
    return np.frombuffer(content, dtype, offset=start).reshape(shape)
