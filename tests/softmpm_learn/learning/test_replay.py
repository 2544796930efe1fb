import hashlib
import itertools
import math
import shutil

import h5py
import numpy as np
import pytest
import torch

from softmpm_learn.learning.replay import MANY, Replay, ReplayError, split_of
from softmpm_learn.settings import LearningConf

SHAPE = (3, 2, 5, 4)


def pictures(number: int, frames=3) -> torch.Tensor:
    """Every picture tells which simulation and frame it is."""
    return (torch.arange(frames) + 100.0 * number).view(-1, 1, 1, 1).expand(frames, 2, 5, 4)


def filled(folder, count: int, **settings) -> Replay:
    replay = Replay(folder, SHAPE, **({"simulations": 10} | settings))
    for number in range(count):
        replay.add(number, pictures(number))
    return replay


def split(replay: Replay, name: str) -> list[torch.Tensor]:
    """Pictures of each simulation of a split."""
    return list(replay.pictures[replay.places(name)].split(replay.shape[0]))


def sample(replay: Replay, seed: int, count: int, *name: str) -> torch.Tensor:
    return replay.pictures[replay.draw(torch.Generator().manual_seed(seed), count, *name)]


def number_of(simulation: torch.Tensor) -> int:
    return int(simulation.flatten()[0]) // 100


def test_the_split_is_kept_and_samples_come_from_it(tmp_path):
    """No simulation changes sides as others come and go, and samples come from their split only."""
    replay = filled(tmp_path, 10, validation=0.2)
    held_out = {number_of(p) for p in split(replay, "validation")}
    training = {number_of(p) for p in split(replay, "training")}
    assert held_out == {2, 7} and training == {0, 4, 5, 9}
    drawn = sample(replay, 0, 500)
    assert {int(v) // 100 for v in drawn[:, 0, 0, 0]} == training
    assert {int(v) % 100 for v in drawn[:, 0, 0, 0]} == {0, 1, 2}
    drawn = sample(replay, 0, 50, "validation")
    assert {int(v) // 100 for v in drawn[:, 0, 0, 0]} == held_out
    later = filled(tmp_path / "later", 22, validation=0.2, simulations=6)
    assert [number_of(p) for p in split(later, "validation")] == [17]


@pytest.mark.parametrize("validation", [0.05, 0.1, 0.2, 0.25])
def test_no_neighbours_on_both_sides(validation):
    """An iteration and the next are never one in training and one in validation; the share is exact, and training has a quarter."""
    sides = [split_of(k, validation) for k in range(200)]
    for side, after in itertools.pairwise(sides):
        assert {side, after} != {"training", "validation"}
    assert sides.count("validation") == round(200 * validation) and sides.count("training") >= 50


def test_validation_is_as_new_as_training():
    """With the usual settings every phase but the first learns from the newest motion and is tested on one two iterations old."""
    conf = LearningConf()
    for phase in range(conf.every - 1, 100, conf.every):
        assert split_of(phase, conf.validation) == "training"
        assert split_of(phase - 2, conf.validation) == "validation"


@pytest.mark.parametrize("every", range(1, 21))
def test_every_phase_has_pictures_to_learn_from(every):
    """Whatever the period of the phases, training begins with the first one, and the newest motion is not always held out."""
    assert split_of(0, 0.2) == "training"
    assert "training" in {split_of(phase, 0.2) for phase in range(every - 1, 300, every)}


def test_worlds_of_an_iteration_are_on_one_side(tmp_path):
    """Worlds that move alike, as with one goal for all, give validation no picture that training has."""
    replay = Replay(tmp_path, SHAPE, simulations=99, validation=0.2, worlds=4)
    for iteration in range(8):
        for world in range(4):
            replay.add(4 * iteration + world, pictures(iteration))
    training, validation = (torch.cat(split(replay, name)) for name in ("training", "validation"))
    assert len(training) == 4 * 3 * 3 and len(validation) == 4 * 2 * 3  # iterations 0, 4, 5 and 2, 7
    assert not torch.isin(training.flatten(), validation.flatten()).any()


def test_many_worlds_leave_room_for_both_sides(tmp_path):
    """An iteration takes at most a fifth of the buffer, by number or by memory."""
    size = 1e-6 * pictures(0).contiguous().nbytes
    cases = (
        (dict(simulations=50), 10),
        (dict(simulations=50, megabytes=31 * size), 6),
        (dict(simulations=4), 1),
        (dict(simulations=8, worlds=4, iterations=2), 4),  # without replay: all that a phase learns from
        (dict(simulations=40, worlds=4, iterations=10), 8),
    )
    for limits, most in cases:
        assert filled(tmp_path, 0, **limits).per_iteration == most


def test_sampling_is_even_over_pictures(tmp_path):
    """Each frame of each simulation is drawn equally often."""
    replay = filled(tmp_path, 10, validation=0.2)
    drawn = sample(replay, 0, 4000)[:, 0, 0, 0].long()
    counts = torch.bincount(100 * (drawn // 100) + drawn % 100)
    assert (counts > 0).sum() == 12 and (counts[counts > 0] / 4000 - 1 / 12).abs().max() < 0.02


def test_memory_is_bounded(tmp_path):
    """The oldest simulations go first, by number and by megabytes; the newest always stays. The memory is never more or another."""
    assert filled(tmp_path / "a", 7, simulations=4).ids == [3, 4, 5, 6]
    size = pictures(0).contiguous().nbytes
    replay = filled(tmp_path / "b", 1, megabytes=2.5e-6 * size)
    memory = replay.memory
    for number in range(1, 7):
        replay.add(number, pictures(number))
    assert replay.ids == [5, 6] and replay.memory is memory and memory.nbytes == 2 * size
    assert filled(tmp_path / "c", 3, megabytes=1e-9).ids == [2]


def test_pictures_are_those_of_the_newest_simulations(tmp_path):
    """Whatever was overwritten in the ring, a place leads to the picture of its simulation and frame, oldest first."""
    replay = Replay(tmp_path, SHAPE, simulations=5, validation=0.25, worlds=99)  # all are of one iteration
    for number in range(13):
        replay.add(number, pictures(number))
        held = range(max(0, number - 4), number + 1)
        assert replay.ids == list(held)
        assert torch.equal(replay.pictures[replay.places("training")], torch.cat([pictures(k) for k in held]))
    replay.clear()
    assert replay.ids == [] and not len(replay.places("training")) and replay.seal == {}
    replay.add(13, pictures(13))
    assert torch.equal(replay.some("training"), pictures(13))


def test_some_pictures_are_evenly_chosen(tmp_path):
    """At most 509, at distances that differ by one picture at most, from the first on."""
    replay = Replay(tmp_path, (300, 1, 1), simulations=5)
    for number in (0, 4, 5):
        replay.add(number, 300.0 * (0, 4, 5).index(number) + torch.arange(300.0).view(300, 1, 1))
    some = replay.some("training").flatten()
    assert len(some) == MANY == 509 and some[0] == 0
    assert set(some.diff().tolist()) == {1.0, 2.0} and some[-1] >= 898
    assert len(replay.some("validation")) == 0


def test_some_pictures_show_all_phases_of_a_gait(tmp_path):
    """As often as all pictures do: of a walker with 20 simulations for training, of 80 pictures each, and a gait of 16 pictures."""
    replay = Replay(tmp_path, (80, 1, 1), simulations=50)
    phase = torch.arange(80.0) % 16
    for number in range(50):
        replay.add(number, phase.view(80, 1, 1))
    assert len(replay.places("training")) == 1600
    _, counts = replay.some("training").unique(return_counts=True)
    assert len(counts) == 16 and counts.min() >= 0.9 * MANY / 16


def test_comes_back_from_disk_exactly(tmp_path):
    """A replay loaded by ids holds the same bits of the same simulations."""
    replay = Replay(tmp_path, SHAPE, simulations=10, worlds=9)  # all are for training
    generator = torch.Generator().manual_seed(0)
    for number in range(4):
        replay.add(number, torch.randn(3, 2, 5, 4, generator=generator))
    other = Replay(tmp_path, SHAPE, simulations=10, worlds=9)
    seal = replay.seal
    del seal[0]
    other.load(seal)
    assert other.ids == [1, 2, 3] and other.seal == seal
    assert torch.equal(other.some("training"), replay.some("training")[SHAPE[0] :])


def test_prune_keeps_what_a_checkpoint_may_name(tmp_path):
    """Eviction leaves the file; prune removes it once it is not named, what an interrupted write left, and no other files."""
    replay = filled(tmp_path, 5, simulations=2)
    assert len(list(tmp_path.iterdir())) == 5
    (tmp_path / "00000009.h5.new").write_bytes(b"half a file")
    others = ["1.h5", "notes.new", "run.h5", "x00000001.h5"]
    for name in others:
        (tmp_path / name).write_bytes(b"somebody's")
    replay.prune([2, 3, 4])
    assert sorted(p.name for p in tmp_path.iterdir()) == [*(f"0000000{k}.h5" for k in (2, 3, 4)), *others]


def test_numbers_go_up_and_empty_splits_say_so(tmp_path):
    """A number used twice and a sample from nothing are errors."""
    replay = filled(tmp_path, 2)
    with pytest.raises(ValueError, match="1 cannot follow 1"):
        replay.add(1, pictures(1))
    with pytest.raises(ValueError, match="no validation simulation"):
        replay.draw(torch.Generator(), 1, "validation")
    with pytest.raises(ValueError, match="training or validation"):
        replay.places("test")


def sealed(path, **content) -> dict[int, str]:
    """Write a hostile file, and the seal that its maker would put into a checkpoint."""
    with h5py.File(path, "w") as file:
        for name, value in content.items():
            file[name] = value
    return {int(path.stem): hashlib.sha256(path.read_bytes()).hexdigest()}


def test_another_file_than_the_sealed_one_is_refused(tmp_path):
    """A missing file, one flipped bit anywhere, the file of another simulation: named, before HDF5 sees it."""
    replay = filled(tmp_path, 2)
    seal, whole = replay.seal, (tmp_path / "00000000.h5").read_bytes()
    for place in range(0, len(whole), 97):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1
        (tmp_path / "00000000.h5").write_bytes(spoilt)
        with pytest.raises(
            ReplayError, match=r"00000000\.h5 is not the simulation that the checkpoint names"
        ):
            Replay(tmp_path, SHAPE, simulations=5).load(seal)
    shutil.copy(tmp_path / "00000001.h5", tmp_path / "00000000.h5")
    with pytest.raises(ReplayError, match=r"00000000\.h5 .* damaged or of another run"):
        Replay(tmp_path, SHAPE, simulations=5).load(seal)
    with pytest.raises(ReplayError, match=r"00000077\.h5: No such file"):
        Replay(tmp_path, SHAPE, simulations=5).load({77: ""})


def test_hostile_files_are_refused(tmp_path):
    """A file with the right hash that points elsewhere, declares too much, has another shape or no finite numbers is not read."""
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["velocity"] = np.zeros(SHAPE, np.float32)
    path = tmp_path / "00000000.h5"
    for message, content in {
        "no plain dataset": {"velocity": h5py.ExternalLink(str(tmp_path / "secret.h5"), "velocity")},
        "float64 of shape": {"velocity": np.zeros(SHAPE)},
        r"shape \(3, 2, 5, 5\)": {"velocity": np.zeros((3, 2, 5, 5), np.float32)},
        r"shape \(\)": {"velocity": np.float32(1)},
        "not finite": {"velocity": np.full(SHAPE, np.nan, np.float32)},
    }.items():
        with pytest.raises(ReplayError, match=rf"00000000\.h5 .*{message}"):
            Replay(tmp_path, SHAPE, simulations=5).load(sealed(path, **content))
    with h5py.File(path, "w") as file:
        file.create_dataset("velocity", (10**6, 2, 5, 4), np.float32, chunks=True)
    with pytest.raises(ReplayError, match=r"shape \(1000000, 2, 5, 4\)"):
        Replay(tmp_path, SHAPE, simulations=5).load({0: hashlib.sha256(path.read_bytes()).hexdigest()})


def test_limits_of_memory_hold_when_loading(tmp_path):
    """More simulations than the buffer may hold, by number or by megabytes, are refused before a file is opened."""
    seal = filled(tmp_path, 4).seal
    size = 4e-6 * math.prod(SHAPE)
    for limits in (dict(simulations=3), dict(simulations=9, megabytes=3.5 * size)):
        with pytest.raises(ReplayError, match="names 4 simulations"):
            Replay(tmp_path, SHAPE, **limits).load(seal)
    Replay(tmp_path, SHAPE, simulations=4, megabytes=4 * size).load(seal)
