"""Forces of walls in recordings: written, read, resumed; and files of the version that had none."""

import dataclasses

import h5py
import numpy as np
import pytest
from surface_scenes import block, forces_of, made, record_forces, slab

import softmpm

ROUND = dict(rtol=1e-6, atol=0)


def check(frames: dict[str, np.ndarray], model: softmpm.Model, iteration: int, points, world=0) -> None:
    for name in ("force", "traction", "places"):
        assert list(frames[f"{name}_frame"]) == [1, 2]
    for k in (1, 2):
        total, traction, places = forces_of(model, 10 * iteration + k, worlds=2)
        np.testing.assert_allclose(frames["force"][k - 1], total[world], **ROUND)
        np.testing.assert_allclose(frames["traction"][k - 1], traction[world][:, points], **ROUND)
        np.testing.assert_allclose(frames["places"][k - 1], places[world][points], **ROUND)


@pytest.mark.parametrize("dim", [2, 3])
def test_forces_are_read_as_they_were_recorded(tmp_path, dim):
    """Total, traction and places of two walls, with what is needed to read them; resumed with the same digest."""
    model = made(block(dim))
    path, surface = tmp_path / "run.h5", model.surface
    with softmpm.Recorder(path, model) as recorder:
        record_forces(recorder, model, 0)
        digest = recorder.digest
        record_forces(recorder, model, 1)
        assert recorder.digest != digest
    with softmpm.Recorder(path, model, resume_before=1, resume_digest=digest) as recorder:
        record_forces(recorder, model, 2)
    with softmpm.Recording(path) as recording:
        assert recording.episodes == (0, 2) and recording.version == 4
        for iteration in recording.episodes:
            check(recording.frames(iteration), model, iteration, np.arange(surface.count))
        assert list(recording.static["surface_wall"]) == [0, 1]  # the third one slips
        assert np.array_equal(recording.static["surface_point"], np.arange(surface.count))
        np.testing.assert_allclose(recording.static["surface_area"], surface.areas, **ROUND)
        rows = recording.rows(0)
        assert list(recording.recorded("force", rows)) == list(rows[1:])


def test_tractions_of_some_points(tmp_path):
    """As many points as asked for, the same in every run, and the whole force of each wall in any case."""
    model = made(block(2))
    for most in (5, 0):
        with softmpm.Recorder(tmp_path / f"{most}.h5", model, max_points=most) as recorder:
            record_forces(recorder, model, 0)
        with softmpm.Recording(tmp_path / f"{most}.h5") as recording:
            frames, points = recording.frames(0), recording.static["surface_point"]
            assert len(points) == most and (np.diff(points) > 0).all()
            if most:
                check(frames, model, 0, points)
            else:
                assert "traction" not in frames and "places" not in frames
                np.testing.assert_allclose(
                    frames["force"][1], forces_of(model, 2, worlds=2).total[0], **ROUND
                )


def test_the_forces_of_a_simulation(tmp_path):
    """Of the second of two worlds, as contact_forces returns them, with their history."""
    model = made(slab(), worlds=2)
    params = softmpm.Params(*(tensor.clone().requires_grad_() for tensor in model.params()))
    state = softmpm.simulate(model, model.rest(), None, params, substeps=20)
    forces = softmpm.contact_forces(model, state)
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(0) as episode:
        episode.frame(0.0, state, forces=forces, world=1)
    with softmpm.Recording(tmp_path / "run.h5") as recording:
        total = recording.frames(0)["force"][0]
    np.testing.assert_allclose(total, forces.total[1].detach(), **ROUND)
    assert total[0, 1] > 0


def test_forces_that_do_not_fit_are_refused(tmp_path):
    """Another number of points, a model without surface contact, a negative number of points; nothing is written."""
    model, nodes = made(block(2)), made(block(2), contact="nodes")
    forces, rest = forces_of(model, 0), model.rest()
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(0) as episode:
        for name in forces._fields:
            wrong = forces._replace(**{name: getattr(forces, name)[..., 1:]})
            with pytest.raises(ValueError, match=f"forces.{name} must have shape"):
                episode.frame(0.0, rest, forces=wrong)
    with softmpm.Recorder(tmp_path / "nodes.h5", nodes) as recorder, recorder.episode(0) as episode:
        with pytest.raises(ValueError, match="forces need contact at surface points"):
            episode.frame(0.0, rest, forces=forces)
        episode.frame(0.0, rest)
    with softmpm.Recording(tmp_path / "run.h5") as first, softmpm.Recording(tmp_path / "nodes.h5") as second:
        assert len(first.rows(0)) == 0 and set(second.frames(0)) == {"time", "x", "v", "strain", "activation"}
    with pytest.raises(ValueError, match="max_points must be a whole number of at least 0"):
        softmpm.Recorder(tmp_path / "new.h5", model, max_points=-1)


FIRST_FRAME = np.dtype([("episode", "<i8"), ("time", "<f8"), ("field", "<i8"), ("latent", "<i8")])


def write_version_1(path, model: softmpm.Model) -> None:
    """A file in the layout of version 1: an episode of iteration 4 with two frames, the second with a latent."""
    scene, n, dim = model.scene, model.particle_count, model.dim
    index = [(0, 0.0, -1, -1), (0, 0.5, -1, 0)]
    x = np.stack([model.positions.numpy() + k for k in range(2)]).astype("<f4")
    walls = {name: [getattr(wall, name) for wall in scene.walls] for name in ("normal", "offset", "friction")}
    static = dict(
        positions=model.positions.numpy().astype("<f4"),
        volume=model.volume.numpy().astype("<f4"),
        body=np.zeros(n, "<i8"),
        particle=np.arange(n),
        gravity=np.array(scene.gravity, "<f4"),
        muscle=np.zeros((0, n), "u1"),
        muscle_direction=np.zeros((0, dim), "<f4"),
        muscle_strength=np.zeros(0, "<f4"),
        wall_contact=np.array([wall.contact.encode() for wall in scene.walls], "S8"),
        grid_shape=np.array(scene.grid.shape),
        **{f"wall_{name}": np.array(values, "<f4") for name, values in walls.items()},
    )
    tables = {
        "episode": np.array([(4, b"{}")], [("iteration", "<i8"), ("attributes", "S4096")]),
        "scalar": np.array([(4, b"loss", 0.5)], [("iteration", "<i8"), ("name", "S64"), ("value", "<f8")]),
        "frame/index": np.array(index, FIRST_FRAME),
        "frame/x": x,
        "frame/v": np.zeros((2, n, dim), "<f4"),
        "frame/strain": np.zeros((2, n), "<f4"),
        "frame/activation": np.zeros((2, 0), "<f4"),
        "field/velocity": np.zeros((0, *scene.grid.shape, dim), "<f4"),
        "latent/value": np.ones((1, 3), "<f4"),
    }
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        file.attrs["format"], file.attrs["version"] = np.bytes_("softmpm recording"), 1
        file.attrs["dt"], file.attrs["spacing"], file.attrs["share"] = scene.dt, scene.grid.spacing, 1.0
        for name, values in static.items():
            file[f"static/{name}"] = values
        for name, rows in tables.items():
            chunk = tuple(max(size, 1) for size in rows.shape[1:])
            file.create_dataset(name, data=rows, maxshape=(None, *chunk), chunks=(1, *chunk), fletcher32=True)


def test_files_of_version_1_are_read_drawn_and_resumed(tmp_path):
    """They have no forces; what a recorder adds to one has."""
    model = made(dataclasses.replace(block(2), muscles=[]))
    path = tmp_path / "run.h5"
    write_version_1(path, model)
    with softmpm.Recording(path) as recording:
        frames = recording.frames(4)
        assert recording.version == 1 and recording.episodes == (4,) and recording.scalars["loss"][1] == [0.5]
        assert np.array_equal(frames["x"][1], (model.positions.numpy() + 1).astype("<f4"))
        assert list(frames["latent_frame"]) == [1] and "force" not in frames
        assert len(recording.static["surface_wall"]) == 0 and len(recording.read("traction", [0, 1])[1]) == 0
    pytest.importorskip("rerun")
    softmpm.to_rerun(path)
    with softmpm.Recorder(path, model, resume_before=5) as recorder:
        record_forces(recorder, model, 6)
    with softmpm.Recording(path) as recording:
        assert recording.version == 4 and recording.episodes == (4, 6)
        old = recording.frames(4)
        assert np.array_equal(old["x"], frames["x"]) and "force" not in old
        check(recording.frames(6), model, 6, np.arange(model.surface.count))
