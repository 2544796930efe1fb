"""Environments whose robot has another body in each episode."""

import re
from pathlib import Path

import numpy as np
import torch

import softmpm
from softmpm_learn.gym import make, make_vec

PAGE = Path(__file__).parents[3] / "docs" / "gym.md"
SHORT = dict(seconds=0.05, device="cpu")


def test_the_wrapper_of_the_page_draws_a_body():
    """The reward is that of an environment which was made with this body; the seed decides it, and the next episode has another."""
    (code,) = re.findall(
        r"## Another body in each episode.*?```python\n(.*?)```", PAGE.read_text(), re.DOTALL
    )
    names: dict = {}
    exec(code, names)
    env, factor = names["env"], names["info"]["young"]
    body = env.params._replace(young=factor * env.params.young), softmpm.Inputs()
    same = make("arm", seconds=0.1, device="cpu", body=body)
    same.reset(seed=0)
    assert same.step(np.full(6, 0.5))[1] == names["reward"]
    plain = make("arm", seconds=0.1, device="cpu")
    plain.reset(seed=0)
    assert plain.step(np.full(6, 0.5))[1] != names["reward"]
    assert env.reset()[1]["young"] != factor and env.reset(seed=0)[1]["young"] == factor


def test_rows_of_many_worlds():
    """A world whose row is replaced where it begins anew moves like a single robot of this material; others go on as they were."""
    many, one, act = (
        make_vec("arm", 2, autoreset_mode="Disabled", **SHORT),
        make("arm", **SHORT),
        np.full(6, 0.5),
    )
    material = one.worlds.params
    many.reset(seed=0)
    many.step(np.stack([act, act]))
    many.reset(options={"reset_mask": np.array([False, True])})
    factors = torch.tensor([[1.0], [0.8]])
    many.worlds.params = material._replace(young=factors * material.young)
    observation = many.step(np.stack([act, act]))[0]
    one.reset(seed=0)
    one.step(act)
    assert np.array_equal(one.step(act)[0], observation[0])
    one.worlds.params = material._replace(young=0.8 * material.young)
    one.reset(seed=1)
    assert np.array_equal(one.step(act)[0], observation[1])
