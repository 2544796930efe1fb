"""Views of a Rerun file have what the recording has, under titles that name it."""

from typing import Any

import numpy as np
import pytest

from softmpm.recording.rerun_blueprint import blueprint, curve, legend
from softmpm.recording.selection import Show

rrb = pytest.importorskip("rerun.blueprint")


class Recorded:
    """What a blueprint reads of a recording."""

    dim = 2
    scalars = dict.fromkeys(("loss", "odd/name"))

    def __init__(self, directions):
        self.static = {"muscle_direction": np.array(directions, dtype=float)}


@pytest.mark.parametrize(
    ("directions", "title"),
    [
        ([(0, 1), (1, 0)], "muscles: red pulls, blue pushes, strokes are fibres"),
        ([(0, 0)], "pressures: red expands, blue contracts"),
        (
            [(0, 0), (1, 0)],
            "muscles: red pulls, blue pushes, strokes are fibres; pressures: red expands, blue contracts",
        ),
    ],
)
def test_the_legend_names_the_actuators(directions, title):
    """A pressure has no direction."""
    recorded: Any = Recorded(directions)
    assert legend(recorded) == title


@pytest.mark.parametrize("has", [(), ("field",), ("field", "traction", "latent")])
def test_there_is_a_view_of_all_that_was_recorded(has):
    """And none of what was not; each scalar has its own, under a path of two parts whatever its name."""
    recorded: Any = Recorded([(0, 1)])
    names = ("activation", "field", "force", "latent", "traction")
    about = dict(
        low=np.zeros(2),
        high=np.ones(2),
        strain=0.5,
        speed=2.0,
        traction=3.0,
        has={n: n in has for n in names},
    )
    show: Any = type("Shown", (), about)
    assert set(about) <= set(Show.__annotations__)
    titles = [view.name for view in views(blueprint(recorded, show).root_container)]
    want = ["muscles: red pulls, blue pushes, strokes are fibres", "strain, 0 to 0.5"]
    want += ["grid velocity, up to 2 m/s"] * ("field" in has)
    want += ["traction of the walls, up to 3 Pa"] * ("traction" in has)
    want += ["now playing", "loss", "odd/name"] + ["latent"] * ("latent" in has)
    assert titles == want
    assert curve("loss") == "/scalars/loss" and curve("odd/name") == r"/scalars/odd\/name"


def views(part) -> list:
    """All views of a container, in their order."""
    parts = [views(one) if isinstance(one, rrb.Container) else [one] for one in part.contents]
    return [view for some in parts for view in some]
