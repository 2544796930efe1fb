import h5py
import numpy as np
import pytest
import torch

from softmpm_learn.replay import Replay


def pictures(number: int, frames=3) -> torch.Tensor:
    """Every picture tells which simulation and frame it is."""
    return (torch.arange(frames) + 100.0 * number).view(-1, 1, 1, 1).expand(frames, 2, 5, 4)


def filled(folder, count: int, **settings) -> Replay:
    replay = Replay(folder, **({"simulations": 10} | settings))
    for number in range(count):
        replay.add(number, pictures(number))
    return replay


def test_validation_is_split_off_by_simulation(tmp_path):
    """No simulation is in both splits, none changes sides as others come and go, and samples come from their split only."""
    replay = filled(tmp_path, 10, validation=0.2)
    held_out = {int(p[0, 0, 0, 0]) // 100 for p in replay.split("validation")}
    assert held_out == {4, 9}
    drawn = replay.sample(torch.Generator().manual_seed(0), 500)
    assert {int(v) // 100 for v in drawn[:, 0, 0, 0]} == set(range(10)) - held_out
    assert {int(v) % 100 for v in drawn[:, 0, 0, 0]} == {0, 1, 2}
    drawn = replay.sample(torch.Generator().manual_seed(0), 50, "validation")
    assert {int(v) // 100 for v in drawn[:, 0, 0, 0]} == held_out
    later = filled(tmp_path / "later", 12, validation=0.2, simulations=6)
    assert {int(p[0, 0, 0, 0]) // 100 for p in later.split("validation")} == {9}


def test_sampling_is_even_over_pictures(tmp_path):
    """A simulation with three times the pictures is drawn three times as often."""
    replay = Replay(tmp_path, simulations=5, validation=0.1)
    replay.add(0, pictures(0, frames=3))
    replay.add(1, pictures(1, frames=9))
    drawn = replay.sample(torch.Generator().manual_seed(0), 4000)[:, 0, 0, 0] >= 100
    assert abs(drawn.float().mean() - 0.75) < 0.02


def test_memory_is_bounded(tmp_path):
    """The oldest simulations go first, by number and by megabytes; the newest always stays."""
    assert filled(tmp_path / "a", 7, simulations=4).ids == [3, 4, 5, 6]
    size = pictures(0).contiguous().nbytes
    replay = filled(tmp_path / "b", 7, megabytes=2.5e-6 * size)
    assert replay.ids == [5, 6] and replay.nbytes == 2 * size
    assert filled(tmp_path / "c", 3, megabytes=1e-9).ids == [2]


def test_comes_back_from_disk_exactly(tmp_path):
    """A replay loaded by ids holds the same bits of the same simulations."""
    replay = Replay(tmp_path, simulations=10)
    generator = torch.Generator().manual_seed(0)
    for number in range(4):
        replay.add(number, torch.randn(3, 2, 5, 4, generator=generator))
    other = Replay(tmp_path, simulations=10)
    other.load([1, 2, 3])
    assert other.ids == [1, 2, 3]
    for a, b in zip(replay.split("training")[1:], other.split("training"), strict=True):
        assert torch.equal(a, b)


def test_prune_keeps_what_a_checkpoint_may_name(tmp_path):
    """Eviction leaves the file; prune removes it once it is not named, and what an interrupted write left behind."""
    replay = filled(tmp_path, 5, simulations=2)
    assert len(list(tmp_path.iterdir())) == 5
    (tmp_path / "00000009.h5.new").write_bytes(b"half a file")
    replay.prune([2, 3, 4])
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"0000000{k}.h5" for k in (2, 3, 4)]


def test_numbers_go_up_and_empty_splits_say_so(tmp_path):
    """A number used twice and a sample from nothing are errors."""
    replay = filled(tmp_path, 2)
    with pytest.raises(ValueError, match="1 cannot follow 1"):
        replay.add(1, pictures(1))
    with pytest.raises(ValueError, match="no validation simulation"):
        replay.sample(torch.Generator(), 1, "validation")
    with pytest.raises(ValueError, match="training or validation"):
        replay.split("test")


def test_damaged_and_foreign_files_are_refused(tmp_path):
    """A missing file, a flipped byte, and a file that points elsewhere or declares too much are named, not read."""
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["velocity"] = np.zeros((3, 2, 5, 4), np.float32)
    replay = filled(tmp_path / "replay", 4)
    damaged, linked, huge = (replay.folder / f"0000000{k}.h5" for k in (0, 1, 2))
    data = bytearray(damaged.read_bytes())
    where = data.index(b"TREE")  # spoil the compressed data behind the chunk tree
    data[-20] ^= 1
    data[where + 600 :: 50] = bytes(b ^ 1 for b in data[where + 600 :: 50])
    damaged.write_bytes(data)
    with h5py.File(linked, "w") as file:
        file["velocity"] = h5py.ExternalLink(str(secret), "velocity")
    with h5py.File(huge, "w") as file:
        file.create_dataset("velocity", (10**9, 2, 100, 100), np.float32, chunks=True)
    for number in (0, 1, 2, 77):
        with pytest.raises(ValueError, match=f"{number:08d}.h5 is not a readable simulation"):
            Replay(replay.folder, simulations=5).load([number])
