"""Stable-Baselines3 and skrl train on the vectorised worlds; the adapter has the interface that the first expects."""

import numpy as np
import pytest
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from softmpm_learn.gym import make, make_vec
from softmpm_learn.gym.stable_baselines import StableBaselinesVecEnv

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
SHORT = dict(seconds=0.05, control_period=0.0125, device="cpu")


def test_the_adapter_resets_in_the_last_step():
    """Seeds, last observations and the kind of the end are those of single environments."""
    env = StableBaselinesVecEnv(make_vec("arm", 2, autoreset_mode="SameStep", kick=0.1, **SHORT))
    single = [make("arm", kick=0.1, **SHORT) for _ in range(2)]
    env.seed(7)
    first = env.reset()
    for k, one in enumerate(single):
        np.testing.assert_array_equal(first[k], one.reset(seed=7 + k)[0])
    for step in range(4):
        row = np.full((2, 6), 0.2 * step, dtype=np.float32)
        observation, reward, done, infos = env.step(row)
        for k, one in enumerate(single):
            last, gain, _, truncated, info = one.step(row[k])
            assert reward[k] == pytest.approx(gain) and done[k] == truncated == (step == 3)
            if truncated:
                np.testing.assert_array_equal(infos[k]["terminal_observation"], last)
                assert infos[k]["TimeLimit.truncated"] and infos[k]["loss"] == pytest.approx(info["loss"])
                last = one.reset()[0]
            else:
                assert infos[k] == {}
            np.testing.assert_array_equal(observation[k], last)
    assert env.get_attr("render_mode") == [None, None]


def test_the_adapter_needs_worlds_that_reset_in_the_same_step():
    """Any other mode is refused with the remedy."""
    with pytest.raises(ValueError, match="autoreset_mode='SameStep', got 'NextStep'; give it to make_vec"):
        StableBaselinesVecEnv(make_vec("arm", 2, **SHORT))


def test_both_libraries_train():
    """PPO of each completes a rollout, an update and another rollout, with a finite return of every episode."""
    from bench.reinforcement import ROLLOUT, train_sb3, train_skrl

    steps = 2 * ROLLOUT
    found = train_sb3(minutes=1.0, steps=2 * steps, worlds=2, **SHORT)
    assert len(found) == 2 * steps // 4 and np.isfinite(found).all() and np.ptp(found) > 0
    found = train_skrl(minutes=1.0, steps=steps, worlds=2, **SHORT)
    assert len(found) == 2 * steps // 5 and np.isfinite(found).all() and np.ptp(found) > 0


def test_the_adapter_takes_no_wrapper():
    """It reads what a wrapper hides, and wrappers of Stable-Baselines3 go around it."""
    wrapped = RecordEpisodeStatistics(make_vec("arm", 2, autoreset_mode="SameStep", **SHORT))
    with pytest.raises(TypeError, match=r"got RecordEpisodeStatistics; wrap the adapter, as in VecMonitor\("):
        StableBaselinesVecEnv(wrapped)
