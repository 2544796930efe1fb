"""Walls that move, in recordings, pictures, films and Rerun files: where the inputs have them, in each world."""

import io

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

import softmpm
from softmpm.recording.style import WALL

COUNT = 5
"""States in a row."""


def build(dim: int = 2) -> softmpm.Model:
    """A block above a floor and beside a wall, in two worlds. Nothing here runs a kernel."""
    up = (0.0, 1.0) + (0.0,) * (dim - 2)
    block = softmpm.box((0.5,) * dim, (1.0,) * dim, 0.1)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(21,) * dim, spacing=0.1),
        bodies=[softmpm.Body(block, softmpm.NeoHookean(density=1.0, young=10.0))],
        walls=[
            softmpm.Wall(normal=up, offset=0.4, contact="slip"),
            softmpm.Wall(normal=up[::-1], offset=0.2),
        ],
        dt=1e-3,
    )
    return softmpm.build(scene, worlds=2, device="cpu", inputs=("wall_offset",))


@pytest.fixture(scope="module")
def model() -> softmpm.Model:
    return build()


def lowered(count: int = COUNT) -> softmpm.Inputs:
    """The floor sinks by 0.03 m from pose to pose, in world 1 from 0.1 m lower on; the normal is not of unit length."""
    depth = 0.03 * torch.arange(count, dtype=torch.float64)[:, None] + torch.tensor([0.0, 0.1]).double()
    other = torch.full_like(depth, 0.2)
    offset = 2.0 * torch.stack([0.4 - depth, other], dim=-1)
    return softmpm.Inputs(
        wall_offset=offset, wall_normal=2.0 * torch.eye(2, dtype=torch.float64).flip(0)[None, None]
    )


def floor_of(image: np.ndarray) -> int:
    """Row of the floor's surface in a picture: the uppermost one with many pixels of its colour."""
    near = (np.abs(image.astype(int) - np.array(WALL[b"slip"])) <= 10).all(-1)
    return int(np.flatnonzero(near.sum(1) > image.shape[1] / 4)[0])


def pixels(figure: Figure) -> np.ndarray:
    figure.savefig(png := io.BytesIO(), dpi=100)
    return np.asarray(Image.open(png).convert("RGB"))


def test_a_picture_shows_the_last_pose(model):
    """World 1 has its floor 0.1 m below that of world 0, in pixels as in metres; without inputs both stand as in the scene."""
    figure = softmpm.show(model, model.rest(), world=(0, 1), inputs=lowered())
    image, height = pixels(figure), []
    for axes in figure.axes[:2]:
        box = axes.get_window_extent()
        part = image[:, int(box.x0) : int(box.x1)]
        pixel = len(image) - floor_of(part) - 0.5
        height.append(axes.transData.inverted().transform((box.x0, pixel))[1])
    want = 0.4 - 0.03 * (COUNT - 1)
    assert height == pytest.approx([want, want - 0.1], abs=0.006)


def test_a_film_follows_the_walls(model, tmp_path):
    """Of states and of a recording, in which each frame has the last pose of its inputs; frames without any have the scene's."""
    states, inputs = [model.rest()] * COUNT, lowered()
    assert inputs.wall_offset is not None
    film = softmpm.to_video(states, tmp_path / "states.gif", model=model, inputs=inputs, world=1, period=0.04)
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(0) as episode:
        for k in range(COUNT):
            upto = inputs._replace(wall_offset=inputs.wall_offset[: k + 1])
            episode.frame(0.04 * k, model.rest(), inputs=None if k == 3 else upto, world=1)
    other = softmpm.to_video(tmp_path / "run.h5", tmp_path / "run.gif")
    rows = [_floors(film), _floors(other)]
    assert (np.diff(rows[0]) > 0).all() and rows[0][[0, 1, 2, 4]].tolist() == rows[1][[0, 1, 2, 4]].tolist()
    assert rows[1][3] < rows[1][0]


def _floors(path) -> np.ndarray:
    with Image.open(path) as film:
        found = []
        for k in range(film.n_frames):  # type: ignore[attr-defined]
            film.seek(k)
            found.append(floor_of(np.asarray(film.convert("RGB"))))
        return np.array(found)


def test_a_recording_has_the_poses(model, tmp_path):
    """Unit normals and offsets, in frames whose inputs have them; a resumed recording retains them."""
    path = tmp_path / "run.h5"
    with softmpm.Recorder(path, model) as recorder, recorder.episode(0) as episode:
        episode.frame(0.0, model.rest())
        episode.frame(0.1, model.rest(), inputs=lowered(2), world=1)
        episode.frame(0.2, model.rest(), inputs=softmpm.Inputs())
        digest = recorder.digest
    with softmpm.Recorder(path, model, resume_before=1, resume_digest=digest):
        pass
    with softmpm.Recording(path) as recording:
        frames = recording.frames(0)
    assert frames["normals_frame"].tolist() == frames["offsets_frame"].tolist() == [1]
    np.testing.assert_allclose(frames["normals"], [[[0, 1], [1, 0]]], atol=1e-7)
    np.testing.assert_allclose(frames["offsets"], [[0.27, 0.2]], atol=1e-7)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_rerun_file_has_walls_in_each_frame(tmp_path, dim):
    """Where they move; else one of the whole recording."""
    chunk = pytest.importorskip("rerun.chunk")
    model, found = build(dim), []
    normal = torch.zeros(1, 2, 2, dim, dtype=torch.float64)
    normal[..., 0, 1] = normal[..., 1, -1 if dim == 3 else 0] = 1.0
    poses = [
        softmpm.Inputs(wall_normal=normal, wall_offset=torch.full((1, 2, 2), 0.4 - 0.01 * k).double())
        for k in range(3)
    ]
    for moving in (False, True):
        path = tmp_path / f"{moving}.h5"
        with softmpm.Recorder(path, model) as recorder, recorder.episode(0) as episode:
            for k, pose in enumerate(poses):
                episode.frame(0.1 * k, model.rest(), inputs=pose if moving else None)
        chunks = chunk.RrdReader(softmpm.to_rerun(path)).stream().filter(content="/scene/walls/0")
        found.append(sum(one.num_rows for one in chunks if not one.is_static))
    assert found == [0, 3]


def test_wrong_poses_are_refused(model):
    """By sentences that name the remedy."""
    states = [model.rest()] * COUNT
    with pytest.raises(
        ValueError, match="one pose of the walls for each of the 5 states, or one for all, got 6"
    ):
        softmpm.to_video(states, "film.gif", model=model, inputs=lowered(COUNT + 1))
    with pytest.raises(
        ValueError, match=r"inputs belongs to a state; of a model at rest that is model\.rest"
    ):
        softmpm.show(model, inputs=lowered())
    with pytest.raises(ValueError, match=r"inputs\.wall_offset must broadcast"):
        softmpm.show(model, model.rest(), inputs=softmpm.Inputs(wall_offset=torch.zeros(3).double()))
    with pytest.raises(ValueError, match="inputs belongs to a film of states"):
        softmpm.to_video("run.h5", "film.gif", inputs=lowered())
