"""A Rerun file shows what the recording holds, when it happened, the right way up."""

import os
import sys

import numpy as np
import pytest
import torch
from surface_scenes import block, forces_of, made, record_forces

import softmpm
from softmpm.__main__ import main
from softmpm.recording import rerun_blueprint, style
from softmpm.recording.selection import ALONE, plan

chunk = pytest.importorskip("rerun.chunk")


def make(path, dim=2, frames=3, name="loss"):
    """Two simulations of iterations 0 and 10, the second without fields; a scalar of iterations 0 to 10."""
    positions = np.random.default_rng(0).uniform(0.3, 0.6, (50, dim))
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(8, 9, 10)[:dim], spacing=0.125),
        bodies=[
            softmpm.Body(softmpm.Particles(positions, 1e-4), softmpm.NeoHookean(density=1.0, young=10.0))
        ],
        muscles=[softmpm.Muscle(particles=np.arange(9), direction=np.eye(dim)[0], strength=1.0)],
        walls=[
            softmpm.Wall(normal=np.eye(dim)[1], offset=0.25),
            softmpm.Wall(normal=np.eye(dim)[1], offset=0.15),
        ],
        dt=1e-3,
    )
    model = softmpm.build(scene, device="cpu")
    with softmpm.Recorder(path, model) as recorder:
        for iteration in (0, 10):
            with recorder.episode(iteration, note="x") as episode:
                for k in range(frames):
                    state = model.rest()
                    state = state._replace(x=state.x + 0.01 * k + 0.001 * iteration)
                    field = torch.ones(scene.grid.shape + (dim,)) if iteration == 0 else None
                    episode.frame(0.1 * k, state, torch.tensor([0.5 * k]), field, torch.ones(2))
        for iteration in range(11):
            recorder.scalars(iteration, {name: float(iteration)})
    return path


def read(path, entity: str) -> list[dict[str, np.ndarray]]:
    """Columns of each chunk of an entity that is not static."""
    found = []
    for one in chunk.RrdReader(path).stream().filter(content=entity):
        if not one.is_static:
            batch = one.to_record_batch()
            found.append({name: batch.column(name) for name in batch.schema.names})
    return found


def flat(column) -> np.ndarray:
    while hasattr(column, "flatten") and column.type.num_fields:
        column = column.flatten()
    return column.to_numpy(zero_copy_only=False)


def column(path, entity: str, name: str) -> np.ndarray:
    return np.concatenate([flat(part[name]) for part in read(path, entity)])


@pytest.mark.parametrize("dim", [2, 3])
def test_particles_are_shown_twice(tmp_path, dim):
    """Positions as recorded, under both colourings, on three time lines; colours from activation and strain."""
    source = make(tmp_path / "run.h5", dim)
    rrd = softmpm.to_rerun(source)
    assert rrd == tmp_path / "run.rrd" and sorted(p.name for p in tmp_path.iterdir()) == ["run.h5", "run.rrd"]
    with softmpm.Recording(source) as recording:
        frames = [recording.frames(iteration) for iteration in recording.episodes]
        static = recording.static
    points = f"Points{dim}D"
    for entity in ("activation", "strain"):
        entity = f"/scene/robot/{entity}"
        got = column(rrd, entity, f"{points}:positions").reshape(6, 50, dim)
        assert np.array_equal(got, np.concatenate([one["x"] for one in frames]))
        assert column(rrd, entity, "iteration").tolist() == [0, 0, 0, 10, 10, 10]
        assert column(rrd, entity, "frame").tolist() == [0, 1, 2, 3, 4, 5]
        seconds = column(rrd, entity, "time").astype(float) / 1e9
        assert np.allclose(seconds, [0, 0.1, 0.2, 0.3, 0.4, 0.5], atol=1e-8)  # one simulation after the other
    want = style.activation_colours(static, np.concatenate([one["activation"] for one in frames]))
    got = column(rrd, "/scene/robot/activation", f"{points}:colors")
    assert np.array_equal(got, want.ravel()) and len(np.unique(got)) == 4  # grey, muscle at 0, 0.5 and 1


@pytest.mark.parametrize("dim", [2, 3])
def test_strokes_show_the_fibres(tmp_path, dim):
    """Along the axis x of the muscle, as far as it goes, in every frame where its particles are; a pressure has none."""
    rrd = softmpm.to_rerun(make(tmp_path / "run.h5", dim))
    parts = read(rrd, "/scene/robot/fibres")
    ends = np.array([frame for part in parts for frame in part[f"LineStrips{dim}D:strips"].to_pylist()])
    assert ends.shape[0] == 6 and ends.shape[2:] == (2, dim)
    along = ends[0, :, 1] - ends[0, :, 0]
    assert len(along) and (along[:, 0] > 0.01).all() and np.allclose(along[:, 1:], 0.0, atol=1e-6)
    want = [0.0, 0.01, 0.02, 0.01, 0.02, 0.03]  # of each frame the way since the first
    assert np.allclose(ends - ends[0], np.reshape(want, (6, 1, 1, 1)), atol=1e-6)


def test_2d_stands_upright(tmp_path):
    """Rerun's 2D y axis points down, so that the scene is mirrored; a 3D scene is not."""
    for dim in (2, 3):
        rrd = softmpm.to_rerun(make(tmp_path / f"{dim}.h5", dim))
        mirrors = [one.to_record_batch() for one in chunk.RrdReader(rrd).stream().filter(content="/scene")]
        found = [
            batch.column("Transform3D:mat3x3")
            for batch in mirrors
            if "Transform3D:mat3x3" in batch.schema.names
        ]
        assert len(found) == (dim == 2)
        if found:
            assert np.array_equal(flat(found[0]).reshape(3, 3), np.diag([1, -1, 1]))


def test_fields_walls_latent_and_curves(tmp_path):
    """Arrows while there are fields and none after; walls that can be seen; series over time; scalars on their iteration."""
    rrd = softmpm.to_rerun(make(tmp_path / "run.h5", name="odd/name: ü"))
    arrows = [len(flat(part["Arrows2D:vectors"])) // 2 for part in read(rrd, "/scene/grid/velocity")]
    assert sorted(arrows) == [0, 72, 72, 72]
    entities = {str(one.entity_path) for one in chunk.RrdReader(rrd).stream()}
    assert "/scene/walls/0" in entities and "/scene/walls/1" not in entities
    assert column(rrd, "/activation", "Scalars:scalars").tolist() == [0, 0.5, 1] * 2
    assert column(rrd, "/latent", "Scalars:scalars").tolist() == [1] * 12
    (curve,) = (entity for entity in entities if entity.startswith("/scalars"))
    assert column(rrd, curve, "Scalars:scalars").tolist() == list(range(11))
    assert column(rrd, curve, "iteration").tolist() == list(range(11))
    seconds = column(rrd, curve, "time").astype(float) / 1e9
    assert np.allclose(seconds, np.linspace(0, 0.3, 11))  # iteration 10 begins to play at 0.3 s
    captions = column(rrd, "/caption", "TextDocument:text").tolist()
    assert ["Iteration 0" in captions[0], "Iteration 10" in captions[1]] == [True, True]
    assert "odd/name: ü: 10" in captions[1] and "note: x" in captions[1]


@pytest.mark.parametrize(
    "kinds, names, title",
    [
        ("m", ["muscle 0"], "muscles: red pulls, blue pushes, strokes are fibres"),
        ("p", ["pressure 0"], "pressures: red expands, blue contracts"),
        (
            "mp",
            ["leg", "pressure 1"],
            "muscles: red pulls, blue pushes, strokes are fibres; pressures: red expands, blue contracts",
        ),
    ],
)
def test_pressures_are_no_muscles(tmp_path, monkeypatch, kinds, names, title):
    """A pressure is called one, and its positive activation expands; curves have the names of the scene."""
    titles, space = [], rerun_blueprint._space
    monkeypatch.setattr(rerun_blueprint, "_space", lambda *given: titles.append(given[2]) or space(*given))
    body = softmpm.Body(
        softmpm.box((0.3, 0.3), (0.6, 0.6), spacing=0.1), softmpm.NeoHookean(density=1.0, young=1.0)
    )
    actuators = [
        softmpm.Muscle(particles=[k], direction=(0.0, -1.0), strength=1.0, name="leg" * (kinds == "mp"))
        if kind == "m"
        else softmpm.Pressure(particles=[k], strength=1.0)
        for k, kind in enumerate(kinds)
    ]
    grid = softmpm.Grid(shape=(9, 9), spacing=0.125)
    model = softmpm.build(softmpm.Scene(grid=grid, bodies=[body], muscles=actuators, dt=1e-3), device="cpu")
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder:
        recorder.episode(0).frame(0.0, model.rest(), torch.ones(len(kinds)))
    rrd = softmpm.to_rerun(tmp_path / "run.h5")
    found = [
        flat(batch.column("SeriesLines:names")).tolist()
        for one in chunk.RrdReader(rrd).stream().filter(content="/activation")
        if "SeriesLines:names" in (batch := one.to_record_batch()).schema.names
    ]
    assert found == [names] and titles[0] == title


def test_less_can_be_shown(tmp_path):
    """``every`` and ``max_particles`` thin out frames and particles."""
    rrd = softmpm.to_rerun(make(tmp_path / "run.h5"), tmp_path / "less.rrd", every=2, max_particles=10)
    assert len(column(rrd, "/scene/robot/strain", "Points2D:positions")) == 2 * 2 * 10 * 2
    with pytest.raises(ValueError, match="max_particles must be a whole number of at least 1"):
        softmpm.to_rerun(tmp_path / "run.h5", max_particles=0)


def test_a_run_that_has_only_begun_can_be_shown(tmp_path):
    """No frames, no scalars, no muscles, no walls, positions that are not numbers: the file is made all the same."""
    body = softmpm.Body(
        softmpm.box((0.3, 0.3), (0.6, 0.6), spacing=0.1), softmpm.NeoHookean(density=1.0, young=1.0)
    )
    scene = softmpm.Scene(grid=softmpm.Grid(shape=(9, 9), spacing=0.125), bodies=[body], dt=1e-3)
    model = softmpm.build(scene, device="cpu")
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder:
        softmpm.to_rerun(tmp_path / "run.h5")
        episode = recorder.episode(0)
        softmpm.to_rerun(tmp_path / "run.h5")
        rest = model.rest()
        episode.frame(0.0, rest._replace(x=rest.x * float("nan"), F=rest.F * float("nan")))
        rrd = softmpm.to_rerun(tmp_path / "run.h5")
    assert np.isnan(column(rrd, "/scene/robot/strain", "Points2D:positions")).all()


def test_without_rerun_the_error_says_what_to_do(tmp_path, monkeypatch, capsys):
    """Recording needs no rerun; conversion without it names the package and the command for later."""
    monkeypatch.setitem(sys.modules, "rerun", None)
    source = make(tmp_path / "run.h5")
    with pytest.raises(ImportError, match=r"pip install rerun-sdk.*python -m softmpm .*run\.h5"):
        softmpm.to_rerun(source)
    monkeypatch.setattr(sys, "argv", ["softmpm", str(source)])
    assert main() == 1 and "pip install rerun-sdk" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [source]


def test_from_the_command_line(tmp_path, monkeypatch, capsys):
    """``python -m softmpm run.h5`` says how to open the result; an error is one sentence and exit code 1."""
    source = make(tmp_path / "run.h5")
    monkeypatch.setattr(sys, "argv", ["softmpm", str(source), str(tmp_path / "a.rrd"), "--every", "2"])
    assert main() == 0 and capsys.readouterr().out == f"rerun {tmp_path / 'a.rrd'}\n"
    monkeypatch.setattr(sys, "argv", ["softmpm", str(tmp_path / "none.h5")])
    assert main() == 1 and "there is no recording" in capsys.readouterr().err


def test_a_failed_conversion_keeps_the_old_file(tmp_path):
    """The previous conversion remains until the new file is complete."""
    source, rrd = make(tmp_path / "run.h5"), tmp_path / "run.rrd"
    before = softmpm.to_rerun(source).read_bytes()
    whole = source.read_bytes()
    with softmpm.Recording(source) as recording:
        place = recording._tables["frame/x"].id.get_chunk_info(5).byte_offset
    source.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
    with pytest.raises(OSError, match="is damaged: row 5 of frame/x"):
        softmpm.to_rerun(source)
    assert rrd.read_bytes() == before and sorted(p.name for p in tmp_path.iterdir()) == ["run.h5", "run.rrd"]


@pytest.mark.parametrize("dim", [2, 3])
def test_forces_are_drawn(tmp_path, dim):
    """Arrows at the points that a wall touches, none in the frame without forces; a curve for each wall and axis."""
    model = made(block(dim))
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder:
        record_forces(recorder, model, 3)
    rrd = softmpm.to_rerun(tmp_path / "run.h5")
    kind, wanted = f"Arrows{dim}D", [forces_of(model, 30 + k, worlds=2) for k in (1, 2)]
    (part,) = read(rrd, "/scene/traction")
    per_frame = [[len(one) for one in part[f"{kind}:{name}"]] for name in ("origins", "vectors")]
    touched = [(one.traction[0].sum(0).norm(dim=-1) > 0).sum().item() for one in wanted]
    assert per_frame[0] == per_frame[1] and per_frame[0][0] == 0
    assert all(0.9 * most <= count <= most for count, most in zip(per_frame[0][1:], touched, strict=True))
    vectors = flat(part[f"{kind}:vectors"]).reshape(-1, dim)
    assert np.linalg.norm(vectors, axis=-1).max() == pytest.approx(3 * model.scene.grid.spacing, rel=1e-5)
    first, origins = wanted[0], flat(part[f"{kind}:origins"]).reshape(-1, dim)
    at = [np.abs(first.points[0].numpy() - origin).sum(-1).argmin() for origin in origins[: per_frame[0][1]]]
    pulled = first.traction[0].sum(0).numpy()[at]
    along = (pulled * vectors[: len(at)]).sum(-1)
    lengths = np.linalg.norm(pulled, axis=-1) * np.linalg.norm(vectors[: len(at)], axis=-1)
    np.testing.assert_allclose(along, lengths, rtol=1e-5)
    curves = column(rrd, "/force", "Scalars:scalars").reshape(2, -1)
    np.testing.assert_allclose(curves, [one.total[0].flatten() for one in wanted], rtol=1e-6)
    assert column(rrd, "/force", "frame").tolist() == [1, 2]
    names = [
        flat(batch.column("SeriesLines:names")).tolist()
        for one in chunk.RrdReader(rrd).stream().filter(content="/force")
        if "SeriesLines:names" in (batch := one.to_record_batch()).schema.names
    ]
    assert names == [[f"wall {k} {axis}" for k in (0, 1) for axis in "xyz"[:dim]]]


@pytest.mark.parametrize("name", ["run.h5", "run.rrd"])
def test_a_recording_is_not_replaced(tmp_path, name):
    """By its own Rerun file, whatever it is called."""
    path = make(tmp_path / name)
    before = path.read_bytes()
    for rrd in (path, None) if name == "run.rrd" else (path,):
        with pytest.raises(ValueError, match="would replace the recording"):
            softmpm.to_rerun(path, rrd)
    assert path.read_bytes() == before


def test_an_unfinished_file_is_an_error(tmp_path, monkeypatch):
    """As of a full disk, which Rerun only logs: the older file is as it was. So is a folder that is not there."""
    import rerun as rr

    path = make(tmp_path / "run.h5")
    rrd = softmpm.to_rerun(path)
    whole, real = rrd.read_bytes(), rr.RecordingStream.disconnect

    def cut(stream):
        real(stream)
        for draft in tmp_path.glob("*.unfinished-*"):
            os.truncate(draft, draft.stat().st_size - 5)

    monkeypatch.setattr(rr.RecordingStream, "disconnect", cut)
    with pytest.raises(
        OSError, match=r"cannot be written: Rerun left an unfinished file of .* room on the disk"
    ):
        softmpm.to_rerun(path)
    assert rrd.read_bytes() == whole and not list(tmp_path.glob("*unfinished*"))
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        softmpm.to_rerun(path, tmp_path / "nowhere" / "run.rrd")


def test_simulations_of_one_frame_follow_each_other(tmp_path):
    """Such as the last posture of each iteration: each is on display for a while."""
    with softmpm.Recording(make(tmp_path / "run.h5", frames=1)) as source:
        times = [one.time.item() for one in plan(source, 1, None).simulations]
    assert times == pytest.approx([0.0, ALONE])
