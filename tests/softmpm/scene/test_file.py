"""Scenes as files: every bit of every scene comes back, and a damaged file gives one kind of error."""

import dataclasses
import io
import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from helpers import full_scene

import softmpm
from softmpm.scene.actuators import Actuator
from softmpm.scene.file import TYPES
from softmpm.scene.materials import Material


def drawn(**changes) -> softmpm.Scene:
    """Bodies of shapes with outlines and presets, clamps and planes of symmetry, slanted directions, no gravity."""
    walls = [
        softmpm.Wall(normal=(0.3, 0.7), offset=0.1234567, friction=1 / 3),
        softmpm.Wall(normal=(1.0, 0.0), offset=0.25, contact="clamp"),
        softmpm.Wall(normal=(0.0, -1.0), offset=-0.9, contact="symmetry"),
        *(softmpm.Wall(normal=(k, 10.0), offset=0.1, contact="slip") for k in range(1, 20)),
    ]
    square = np.array([(0.1, 0.1), (0.2, 0.1), (0.2, 0.23), (0.1, 0.2)])
    bodies = [
        softmpm.Body(softmpm.ball((0.5, 0.5), 0.07, spacing=0.02), softmpm.presets.ECOFLEX_00_30.material()),
        softmpm.Body(
            softmpm.ball((0.5, 0.7), (0.09, 0.03), spacing=0.02, cut_cells=True),
            softmpm.presets.MUSCLE.material(softmpm.StableNeoHookean, viscosity=0.1 + 0.2),
        ),
        softmpm.Body(
            softmpm.polygons([square], spacing=0.02).moved((0.1, 1e-9)),
            softmpm.FixedCorotated(density=1 / 3, young=7.0),
        ),
        softmpm.Body(
            softmpm.box((0.7, 0.7), (0.8, 0.8), spacing=0.03),
            softmpm.BarrierCorotated(density=1.0, young=5e-324),
        ),
    ]
    muscles = [
        softmpm.Muscle(particles=[5, 2, 9], direction=(k, 3.0), strength=-0.1 * k, name=f"№ {k % 3} 'a'")
        for k in range(1, 20)
    ]
    settings = dict(
        grid=softmpm.Grid(shape=(33, 40), spacing=1 / 30),
        bodies=bodies,
        muscles=[*muscles, softmpm.Pressure(particles=range(3), strength=2.0)],
        walls=walls,
        driven=np.array([7, 3], dtype=np.int32),
        body_contact=np.bool_(False),
        damping=-0.0,
        dt=1e-5,
    )
    return softmpm.Scene(**(settings | changes))


SCENES = {
    "2D with every law": lambda: full_scene(2),
    "3D with every law": lambda: full_scene(3),
    "drawn": drawn,
    "3D with an outline": lambda: dataclasses.replace(
        full_scene(3, driven=()),
        bodies=[
            softmpm.Body(
                softmpm.ball((0.5, 0.5, 0.5), (0.1, 0.2, 0.15), spacing=0.05),
                softmpm.NeoHookean(density=1, young=9),
            )
        ],
        muscles=[],
    ),
    "plain": lambda: drawn(muscles=[], walls=[], driven=(), gravity=(-0.0, 1e-310), body_contact=True),
}


def assert_same(a, b, where="scene") -> None:
    """Equal types, fields and bits; arrays are read-only in both."""
    assert type(a) is type(b), where
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, tuple):
        assert len(a) == len(b), where
        for k, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_same(one, other, f"{where}[{k}]")
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), where
        assert not a.flags.writeable and not b.flags.writeable, where
    else:
        assert repr(a) == repr(b), where  # -0.0 is not 0.0


@pytest.mark.parametrize("make", SCENES.values(), ids=SCENES)
def test_round_trip(make, tmp_path):
    """Every number to the last bit, in a second file equal to the first, which NumPy reads."""
    scene, path, again = make(), tmp_path / "a.scene", tmp_path / "b.scene"
    if isinstance(scene.body_contact, np.bool_):
        scene = dataclasses.replace(scene, body_contact=bool(scene.body_contact))
    softmpm.save_scene(scene, str(path))
    loaded = softmpm.load_scene(path)
    assert_same(loaded, scene)
    softmpm.save_scene(loaded, again)
    assert again.read_bytes() == path.read_bytes()
    assert sorted(tmp_path.iterdir()) == [path, again]
    with np.load(path) as arrays:
        assert np.array_equal(arrays["bodies/0/particles/positions"], scene.bodies[0].particles.positions)


def test_numpy_truth_values_become_plain(tmp_path):
    """JSON has none of NumPy's."""
    softmpm.save_scene(drawn(), tmp_path / "a.scene")
    assert softmpm.load_scene(tmp_path / "a.scene").body_contact is False


def test_every_law_and_actuator_has_a_place():
    """Each that the package defines."""
    for base in (Material, Actuator):
        for kind in base.__subclasses__():
            assert not kind.__module__.startswith("softmpm.") or kind.__name__ in TYPES


def test_a_file_is_replaced_only_by_a_complete_one(tmp_path, monkeypatch):
    """A write that fails leaves the old file, and nothing besides."""
    path = tmp_path / "a.scene"
    softmpm.save_scene(full_scene(2), path)
    before = path.read_bytes()

    def fails(*args, **settings):
        raise OSError("the disk is full")

    monkeypatch.setattr(np.lib.format, "write_array", fails)
    with pytest.raises(OSError, match="the disk is full"):
        softmpm.save_scene(full_scene(3), path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_what_no_file_can_hold_is_refused(tmp_path):
    """Something else than a scene, and a law of the user's own; nothing is written."""

    class Jelly(softmpm.NeoHookean):
        pass

    body = softmpm.Body(softmpm.Particles([[0.5, 0.5]], 0.01), Jelly(density=1, young=1))
    with pytest.raises(TypeError, match="scene/bodies/0/material is a Jelly, which a scene file cannot hold"):
        softmpm.save_scene(
            dataclasses.replace(drawn(muscles=[], driven=()), bodies=[body]), tmp_path / "a.scene"
        )
    with pytest.raises(TypeError, match=r"save_scene needs a softmpm\.Scene, got Body"):
        softmpm.save_scene(body, tmp_path / "a.scene")  # pyright: ignore[reportArgumentType]
    with pytest.raises(FileNotFoundError, match="there is no scene file"):
        softmpm.load_scene(tmp_path / "a.scene")
    assert not list(tmp_path.iterdir())


def small() -> softmpm.Scene:
    body = softmpm.Body(
        softmpm.Particles([[0.5, 0.5], [0.55, 0.5]], 0.01), softmpm.NeoHookean(density=1, young=1)
    )
    return softmpm.Scene(
        grid=softmpm.Grid(shape=(8, 8), spacing=0.1),
        bodies=[body],
        walls=[softmpm.Wall(normal=(0, 1), offset=0.1)],
        dt=1e-3,
    )


def members_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def write(path: Path, members: dict[str, bytes], **settings) -> None:
    with zipfile.ZipFile(path, "w", **settings) as file:
        for name, content in members.items():
            file.writestr(name, content)


def npy(values) -> bytes:
    data = io.BytesIO()
    np.save(data, values, allow_pickle=True)
    return data.getvalue()


POSITIONS = "bodies/0/particles/positions.npy"
BROKEN_ARRAYS = {
    "pickled": (npy(np.array([[object()]])), "type object"),
    "of another type": (npy(np.zeros((2, 2), np.float32)), "type float32"),
    "by columns": (npy(np.asfortranarray(np.arange(4.0).reshape(2, 2))), "order of Fortran"),
    "of another shape": (npy(np.zeros((2, 4))), "positions must have shape"),
    "not finite": (npy(np.full((2, 2), np.nan)), "positions must be finite; particle 0 is not"),
    "cut": (npy(np.zeros((2, 2)))[:-1], "declares 32 bytes and has 31"),
    "longer": (npy(np.zeros((2, 2))) + b" ", "declares 32 bytes and has 33"),
    "huge": (npy(np.zeros((2, 2))).replace(b"(2, 2), }          ", b"(9999999, 9999999)}"), "declares"),
    "empty": (b"", "EOF"),
    "no array": (b"hello, this is text", "magic string"),
}


@pytest.mark.parametrize("content, message", BROKEN_ARRAYS.values(), ids=BROKEN_ARRAYS)
def test_arrays_that_are_not_what_they_should_be(content, message, tmp_path):
    """A ValueError that names the file and the rule, before memory is taken."""
    path = tmp_path / "a.scene"
    softmpm.save_scene(small(), path)
    write(path, members_of(path) | {POSITIONS: content})
    with pytest.raises(ValueError, match=message) as caught:
        softmpm.load_scene(path)
    assert str(path) in str(caught.value)


def at(structure: dict, *keys):
    for key in keys:
        structure = structure[key]
    return structure


CHANGES = {
    "newer": (lambda s: s.update(version=2), "it has version 2; this softmpm reads version 1"),
    "no version": (lambda s: s.pop("version"), "it has version None"),
    "other format": (lambda s: s.update(format="x"), "its format is not 'softmpm scene'"),
    "no scene": (lambda s: s.pop("scene"), "it must have a Scene, got NoneType"),
    "another object": (lambda s: s.update(scene=s["scene"]["grid"]), "it must have a Scene, got Grid"),
    "unknown type": (
        lambda s: at(s, "scene", "bodies", 0, "material").update(type="Jelly"),
        r"scene.bodies\[0\].material has the unknown type 'Jelly'; known are Scene, Grid",
    ),
    "abstract type": (
        lambda s: at(s, "scene", "bodies", 0, "material").update(type="Material"),
        "unknown type",
    ),
    "type of another kind": (lambda s: at(s, "scene", "grid").update(type=["Grid"]), "unknown type"),
    "no type": (lambda s: at(s, "scene", "grid").pop("type"), "scene.grid has the unknown type"),
    "unknown field": (lambda s: at(s, "scene", "grid").update(colour=1), "scene.grid: a Grid has no colour"),
    "missing field": (lambda s: at(s, "scene", "walls", 0).pop("offset"), r"scene.walls\[0\]: .*offset"),
    "wrong value": (
        lambda s: at(s, "scene", "bodies", 0, "material").update(poisson=0.5),
        r"scene.bodies\[0\].material: poisson must lie in",
    ),
    "text for a number": (lambda s: s["scene"].update(dt="1e-3"), "scene: scene dt must be one number"),
    "infinite": (lambda s: s["scene"].update(dt=float("inf")), "dt must be finite"),
    "an array twice": (
        lambda s: at(s, "scene", "bodies").append(at(s, "scene", "bodies", 0)),
        "or another object has it",
    ),
    "no such array": (
        lambda s: at(s, "scene", "bodies", 0, "particles", "volume").update(array="/etc/passwd"),
        "there is no array '/etc/passwd'",
    ),
    "an array too many": (
        lambda s: at(s, "scene", "bodies", 0, "particles").update(volume=0.01),
        "no object has the array 'bodies/0/particles/volume'",
    ),
    "objects in the wrong place": (
        lambda s: s["scene"].update(bodies=[s["scene"]["grid"]]),
        "must be a Body",
    ),
}


@pytest.mark.parametrize("change, message", CHANGES.values(), ids=CHANGES)
def test_structures_that_no_scene_has(change, message, tmp_path):
    """A ValueError that names the file, the place and the rule."""
    path = tmp_path / "a.scene"
    softmpm.save_scene(small(), path)
    members = members_of(path)
    structure = json.loads(members["scene.json"])
    change(structure)
    write(path, members | {"scene.json": json.dumps(structure).encode()})
    with pytest.raises(ValueError, match=message) as caught:
        softmpm.load_scene(path)
    assert str(caught.value).startswith(f"{path} is not a readable scene file: ")


def test_a_file_by_hand(tmp_path):
    """JSON alone suffices: lists in place of arrays, fields left out, a normal of another length."""
    path = tmp_path / "a.scene"
    softmpm.save_scene(small(), path)
    structure = json.loads(members_of(path)["scene.json"])
    structure["scene"]["bodies"][0]["particles"] = {
        "type": "Particles",
        "positions": [[0.5, 0.5]],
        "volume": 0.01,
    }
    structure["scene"]["walls"] = [{"type": "Wall", "normal": [0, 2], "offset": 0.2}]
    structure["scene"]["muscles"] = [{"type": "Pressure", "particles": {"array": "p"}, "strength": 1}]
    del structure["scene"]["gravity"], structure["scene"]["driven"]
    write(path, {"scene.json": json.dumps(structure).encode(), "p.npy": npy(np.array([0]))})
    loaded = softmpm.load_scene(path)
    assert loaded.muscle_names == ("pressure 0",)
    assert loaded.walls[0] == softmpm.Wall(normal=(0, 1), offset=0.1) and loaded.gravity == (0, 0)
    assert len(loaded.bodies[0].particles) == 1


def test_archives_that_are_none_of_ours(tmp_path):
    """Other files, other archives, compressed ones, structures that are deep, no JSON, or no text."""
    path = tmp_path / "a.scene"
    softmpm.save_scene(small(), path)
    members = members_of(path)
    deep = b"[" * 100_000
    for content in (b"", b"PK", b"hello" * 100):
        path.write_bytes(content)
        assert_unreadable(path)
    for other in (
        {"x": b""},
        {"scene.json": b"{"},
        {"scene.json": deep},
        {"scene.json": b"\xff\xfe\x00"},
        {"scene.json": b"3"},
    ):
        write(path, members | other if "scene.json" in other else other)
        assert_unreadable(path)
    write(path, members, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(ValueError, match="its members are compressed"):
        softmpm.load_scene(path)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("scene.json", members["scene.json"])
        file.filelist *= 2
    with pytest.raises(ValueError, match="two members of the same name"):
        softmpm.load_scene(path)


def assert_unreadable(path: Path) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))} is not a readable scene file: .+"):
        softmpm.load_scene(path)


def test_truncated_files(tmp_path):
    """Every length that is shorter than the file."""
    path = tmp_path / "a.scene"
    softmpm.save_scene(small(), path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        assert_unreadable(path)


def test_damaged_files(tmp_path):
    """Bytes that are changed, left out or repeated: a ValueError with the path, or, where nothing of it mattered, the same scene."""
    path, rng = tmp_path / "a.scene", np.random.default_rng(0)
    scene = small()
    softmpm.save_scene(scene, path)
    whole, refused = path.read_bytes(), 0
    for trial in range(1500):
        damaged = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            place = rng.integers(len(damaged))
            if trial % 3 == 0:
                damaged[place] = rng.integers(256)
            elif trial % 3 == 1:
                damaged[place] ^= 1 << rng.integers(8)
            else:
                size = rng.integers(1, 40)
                damaged[place : place + size] = b"" if rng.integers(2) else 2 * damaged[place : place + size]
        path.write_bytes(damaged)
        try:
            loaded = softmpm.load_scene(path)
        except Exception:
            assert_unreadable(path)
            refused += 1
        else:
            assert_same(loaded, scene)
    assert refused > 1000
