"""Times of the parts of a run: a row of timing.csv for each iteration, and a line of the log at the end."""

import contextlib
import time
from collections.abc import Iterator, Mapping

TIMING = ["episode", "evaluate", "learn", "save", "draw"]
"""Columns of timing.csv [s]:

- ``episode``: simulation, gradient and its mean over the processes, also of attempts that failed, with their recording;
- ``evaluate``: evaluations, and the step along the gradient;
- ``learn``: learning phases, and adding observations to the replay buffer;
- ``save``: checkpoints, that of the iteration before and those before a run goes back;
- ``draw``: pictures of the iteration before.

What follows the last iteration is in no row.
"""
PARTS = {
    "episode": "episodes",
    "evaluate": "evaluations",
    "learn": "learning",
    "save": "checkpoints",
    "draw": "pictures",
    "end": "the best motion",
}
"""Names of the parts in :func:`account`. ``end`` is what follows the last iteration: the best motion is evaluated, recorded and
examined. The recording of episodes, ``record``, is a part of ``episode``."""


@contextlib.contextmanager
def clock(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Add the time that the block takes [s] to ``seconds[name]``, also if it raises an error."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - begin


def duration(seconds: float) -> str:
    """Seconds as text, in minutes from 90 s on."""
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.0f} s"


def account(seconds: Mapping[str, float], whole: float) -> str:
    """The time that a run took since it began or was resumed, and that of its parts; parts below a second are left out.

    Args:
        seconds: Those of the parts.
        whole: All seconds.
    """
    parts = {name: seconds.get(part, 0.0) for part, name in PARTS.items()}
    parts["all else"] = whole - sum(parts.values())
    shown = {name: f"{name} {duration(passed)}" for name, passed in parts.items() if passed >= 1}
    if "episodes" in shown and seconds.get("record", 0.0) >= 1:
        shown["episodes"] += f" ({duration(seconds['record'])} of it recording)"
    return f"The run took {duration(whole)}{': ' if shown else ''}{', '.join(shown.values())}."
