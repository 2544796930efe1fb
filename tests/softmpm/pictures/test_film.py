"""Films: the files open, have the right pictures at the right times, and errors name the remedy."""

import os
import sys

import numpy as np
import pytest
import torch
from PIL import Image

import softmpm
from softmpm.pictures.film import resampled


@pytest.fixture(scope="module")
def model() -> softmpm.Model:
    """A block that can be moved by hand."""
    block = softmpm.box((0.3, 0.2), (0.5, 0.4), 1 / 20)
    muscle = softmpm.Muscle(particles=np.arange(len(block)), direction=(0.0, 1.0), strength=1.0)
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=(21, 11), spacing=0.1),
        bodies=[softmpm.Body(block, softmpm.NeoHookean(density=1.0, young=10.0))],
        muscles=[muscle],
        walls=[softmpm.Wall(normal=(0.0, 1.0), offset=0.15)],
        dt=1e-3,
    )
    return softmpm.build(scene, device="cpu")


@pytest.fixture(scope="module")
def states(model) -> list[softmpm.State]:
    """Ten states, each 0.1 m further to the right and faster."""
    found = []
    for k in range(10):
        state = model.rest()
        state.x[..., 0] += 0.1 * k
        state.v[..., 0] = 0.1 * k
        found.append(state)
    return found


@pytest.fixture(scope="module")
def recording(model, states, tmp_path_factory):
    """The same states, 0.1 s apart, as iteration 3; iteration 5 has only two of them."""
    path = tmp_path_factory.mktemp("recording") / "run.h5"
    with softmpm.Recorder(path, model) as recorder:
        for iteration, count in ((3, 10), (5, 2)):
            with recorder.episode(iteration) as episode:
                for k, state in enumerate(states[:count]):
                    episode.frame(0.1 * k, state, torch.tensor([k / 10]))
    return path


def pictures(path) -> np.ndarray:
    """All pictures of a GIF."""
    with Image.open(path) as film:
        found = []
        for k in range(film.n_frames):
            film.seek(k)
            found.append(np.asarray(film.convert("RGB")).astype(int))
        return np.stack(found)


def middle(picture: np.ndarray) -> float:
    """Mean column of the body, which is neither white nor grey, left of the scale."""
    colour = np.ptp(picture, axis=-1) > 40
    colour[:, int(0.8 * picture.shape[1]) :] = False
    return float(colour.nonzero()[1].mean())


def test_a_gif_has_a_picture_for_each_state(model, states, tmp_path):
    """Without a period; the body moves evenly to the right, in a frame that stays."""
    film = softmpm.to_video(states, tmp_path / "run.gif", model=model, fps=20, colour="body")
    with Image.open(film) as file:
        assert file.format == "GIF" and file.n_frames == 10 and file.info["duration"] == 50
    found = pictures(film)
    assert found.shape[2] >= 600
    steps = np.diff([middle(picture) for picture in found])
    assert steps.min() > 10 and np.ptp(steps) < 3


def test_the_frames_of_a_trajectory_become_a_film(model, tmp_path):
    """The pictures are those of the states one by one."""
    way = softmpm.trajectory(model, model.rest(), torch.ones(3, 1, 1), model.params(), substeps=5)
    states = [model.rest()]
    for row in torch.ones(3, 1, 1):
        states.append(softmpm.simulate(model, states[-1], row[None], model.params(), substeps=5))
    torch.testing.assert_close(way.frames.of_frame(1).surface, states[2].surface)
    films = [
        softmpm.to_video(one, tmp_path / "block.gif", model=model).read_bytes()
        for one in (way.frames, states[1:])
    ]
    assert films[0] == films[1]


def test_plain_areas_do_not_flicker(model, states, tmp_path):
    """The inside of a wall has one colour in all pictures of a GIF, though each picture has colours of its own."""
    speeds = torch.linspace(0.0, 3.0, len(states))
    waves = [
        state._replace(v=state.v + speed * torch.rand_like(state.v))
        for state, speed in zip(states, speeds, strict=True)
    ]
    film = pictures(softmpm.to_video(waves, tmp_path / "block.gif", model=model))
    commonest = set()
    for picture in film:
        colours, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
        plain = colours[counts.argsort()[-2:]]  # the background and the inside of the wall
        commonest.add(tuple(map(tuple, plain.tolist())))
    assert len(commonest) == 1


def test_a_film_plays_at_its_rate(model, states, tmp_path):
    """States 0.1 s apart last 0.9 s; at half the rate twice as long, with each state in two pictures."""
    times = resampled(0.1 * np.arange(10), fps=10, rate=1.0)
    assert times.tolist() == list(range(10))
    slow = resampled(0.1 * np.arange(10), fps=10, rate=0.5)
    assert len(slow) == 19 and np.bincount(slow, minlength=10).max() <= 3 and set(slow) == set(range(10))
    assert resampled(0.1 * np.arange(10), fps=5, rate=1.0).tolist() == [0, 2, 4, 6, 8]
    film = softmpm.to_video(states, tmp_path / "a.gif", model=model, fps=5, period=0.1)
    assert len(pictures(film)) == 5
    for fps in (15, 24, 30, 50):
        with Image.open(softmpm.to_video(states, tmp_path / "a.gif", model=model, fps=fps)) as file:
            lasting = [file.info["duration"] for k in range(10) if file.seek(k) is None]
        assert sum(lasting) == pytest.approx(10_000 / fps, abs=5) and min(lasting) >= 20


def test_the_end_of_an_episode_shows_the_last_activation(model, states, tmp_path):
    """Its final state has none, in every recording of the learner; the film had no activations for that."""
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(0) as episode:
        for k, state in enumerate(states[:3]):
            episode.frame(0.1 * k, state, torch.tensor([0.9]) if k < 2 else None)
    for colour in (None, "activation"):
        found = pictures(softmpm.to_video(tmp_path / "run.h5", tmp_path / "a.gif", fps=10, colour=colour))
        red = [(picture[..., 0] > picture[..., 2] + 60)[:, :500].sum() for picture in found]
        assert len(red) == 3 and min(red) > 1000


def test_a_recording_becomes_a_film(recording, tmp_path):
    """The last simulation, or the one that is named; muscles grow red with their activation."""
    whole = pictures(softmpm.to_video(recording, tmp_path / "a.gif", iteration=3, fps=10))
    assert len(whole) == 10
    red = [(picture[..., 0] > picture[..., 2] + 60)[:, :500].sum() for picture in whole]
    assert red[0] < 50 < 1000 < red[-1]
    with softmpm.Recording(recording) as opened:
        assert len(pictures(softmpm.to_video(opened, tmp_path / "b.gif", fps=10))) == 2


def test_a_film_shows_the_recorded_times(model, states, tmp_path):
    """Those of Rerun and of the file, where the first frame is that after the first control step."""
    films = []
    for begin in (0.0, 0.5, 0.5):
        path = tmp_path / f"{len(films)}.h5"
        with softmpm.Recorder(path, model) as recorder, recorder.episode(0) as episode:
            for k, state in enumerate(states[:2]):
                episode.frame(begin + 0.1 * k, state)
        films.append(pictures(softmpm.to_video(path, tmp_path / "a.gif", fps=10)))
    assert (films[1] == films[2]).all() and [len(film) for film in films] == [2, 2, 2]
    apart = (films[0] != films[1]).any(-1)
    assert apart[:, :40].any((1, 2)).all() and not apart[:, 40:].any()  # the words above the axes


def test_an_mp4_opens(model, states, tmp_path):
    """With as many pictures and the size and rate that were asked for."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    film = softmpm.to_video(states, str(tmp_path / "run.mp4"), model=model, fps=10)
    frames, seconds = ffmpeg.count_frames_and_secs(str(film))
    assert frames == 10 and seconds == pytest.approx(1.0, abs=0.06)
    reader = ffmpeg.read_frames(str(film))
    width, height = next(reader)["size"]
    first = np.frombuffer(next(reader), np.uint8).reshape(height, width, 3)
    reader.close()
    assert width >= 600 and first.std() > 10


def test_the_scale_is_that_of_the_whole_film(model, states, tmp_path):
    """The slow body of the second picture is lighter than the fast one of the last."""
    found = pictures(softmpm.to_video(states, tmp_path / "a.gif", model=model, limits=(0.0, 0.9)))
    dark = [((picture.sum(-1) < 300) & (np.ptp(picture, axis=-1) > 30))[:, :550].sum() for picture in found]
    assert dark[1] < 0.1 * dark[-1]


def test_an_older_film_is_replaced_and_no_draft_is_left(model, states, tmp_path):
    """Also when the film fails half way: then the older one stays."""
    path = tmp_path / "run.gif"
    softmpm.to_video(states[:2], path, model=model)
    before = path.read_bytes()
    softmpm.to_video(states[:3], path, model=model)
    assert path.read_bytes() != before and list(tmp_path.iterdir()) == [path]
    before = path.read_bytes()
    with pytest.raises(ValueError, match="limits"):
        softmpm.to_video(states, path, model=model, limits=(1.0, 1.0))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "changes, message",
    [
        (dict(path="run.avi"), "a .gif or .mp4"),
        (dict(fps=0), "fps must be > 0"),
        (dict(fps=60), "fps must be at most 50 in a .gif"),
        (dict(rate=-1.0), "rate must be > 0"),
        (dict(period=0.0), "period must be > 0"),
        (dict(world=1), "world must be between 0 and 0"),
        (dict(colour="heat"), "colour must be one of"),
        (dict(activation=torch.zeros(3, 1, 1)), "one row for each state"),
    ],
)
def test_wrong_arguments_are_refused(model, states, tmp_path, changes, message):
    """By a sentence, before anything is drawn."""
    changes = dict(path="run.gif", model=model) | changes
    with pytest.raises(ValueError, match=message):
        softmpm.to_video(states, tmp_path / changes.pop("path"), **changes)


def test_wrong_sources_are_refused(model, states, recording, tmp_path):
    """States without a model, no states, a recording that is not there or lacks the simulation."""
    with pytest.raises(TypeError, match="needs a model"):
        softmpm.to_video(states, tmp_path / "a.gif")
    with pytest.raises(TypeError, match="at least one"):
        softmpm.to_video([], tmp_path / "a.gif", model=model)
    with pytest.raises(FileNotFoundError):
        softmpm.to_video(tmp_path / "none.h5", tmp_path / "a.gif")
    with pytest.raises(KeyError, match="iteration 4"):
        softmpm.to_video(recording, tmp_path / "a.gif", iteration=4)


def test_without_the_package_of_mp4_the_remedy_is_named(model, states, tmp_path, monkeypatch):
    """And no file is left."""
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"softmpm\[video\]"):
        softmpm.to_video(states, tmp_path / "a.mp4", model=model)
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_mp4_is_an_error(model, states, tmp_path, monkeypatch):
    """Such as on a full disk, where ffmpeg may end well; the older film is as it was."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    path, real = tmp_path / "old.mp4", ffmpeg.write_frames
    path.write_bytes(b"an older film")

    def cut(place, *settings, **others):
        writer = real(place, *settings, **others)
        yield next(writer)
        try:
            while True:
                writer.send((yield))
        finally:
            writer.close()
            os.truncate(place, os.path.getsize(place) // 2)

    monkeypatch.setattr(ffmpeg, "write_frames", cut)
    with pytest.raises(
        OSError, match="ffmpeg could not write the film, .* room on the disk: it has 0 of 10 pictures"
    ):
        softmpm.to_video(states, path, model=model)
    assert path.read_bytes() == b"an older film" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_any_name_is_a_file(model, states, tmp_path, monkeypatch, suffix):
    """Names with a colon or a dash, which ffmpeg would read otherwise; a draft takes no file of the user's."""
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.chdir(tmp_path)
    own = [f"-a.new{suffix}", f"-a{suffix}.new"]
    for name in own:
        (tmp_path / name).write_bytes(b"precious")
    for name in (f"2026-01-01T10:30:00{suffix}", f"-a{suffix}"):
        assert softmpm.to_video(states[:2], name, model=model, period=0.1).is_file()
    assert all((tmp_path / name).read_bytes() == b"precious" for name in own)
    with pytest.raises(FileNotFoundError, match="there is no such folder: 'nowhere'"):
        softmpm.to_video(states, f"nowhere/film{suffix}", model=model)


@pytest.mark.parametrize(
    "changes",
    [dict(world=1), dict(period=0.1), dict(activation=torch.zeros(10, 1, 1))],
    ids=lambda one: next(iter(one)),
)
def test_a_recording_has_its_own(recording, tmp_path, changes):
    """What belongs to states would be ignored."""
    with pytest.raises(
        ValueError, match=f"{next(iter(changes))} belongs to a film of states; a recording has its own"
    ):
        softmpm.to_video(recording, tmp_path / "film.gif", **changes)


def test_frames_whose_times_fall_are_refused(model, states, tmp_path):
    """They have no order to be shown in."""
    with softmpm.Recorder(tmp_path / "run.h5", model) as recorder, recorder.episode(0) as episode:
        for k in (1, 0):
            episode.frame(0.1 * k, states[k])
    with pytest.raises(ValueError, match=r"times of the frames must not fall, got 0.1 s first and 0 s last"):
        softmpm.to_video(tmp_path / "run.h5", tmp_path / "film.gif")
