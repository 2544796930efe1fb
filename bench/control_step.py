"""Parts of a replayed control step of a closed loop, on a GPU: `python bench/control_step.py [--json FILE]`

By the profiler of CUDA, in a replay of some control steps of the standard elephant with their gradient, after four others: launches of
a control step, and the time in which the GPU works on them. Where kernels overlap, the time counts for the one that began first;
``idle`` is what lies between them. What a replay does once, such as setting out and the last gradients, is included.
"""

import collections
import tempfile
from collections.abc import Iterable
from pathlib import Path

import torch
from common import Table, arguments
from episode import ELASTIC
from kernels import NAME

import softmpm
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.settings import Settings
from softmpm_learn.tasks.elephant import ElephantConf, elephant
from softmpm_learn.tasks.task import Resolution

CASES = {"default": {}, "contact at nodes, elastic": ELASTIC}
SECONDS = 0.2
"""Duration of the episode: 16 control steps."""
OF_A_SUBSTEP = {
    *("grid_velocity", "g2p2g", "grid_and_loads", "press"),
    *("grid_velocity_adj", "g2p2g_adj", "grid_and_loads_adj", "press_adj"),
}
"""Kernels of the moving grid that run in each substep or in its adjoint."""

Event = tuple[float, float, str]
"""Begin and end [µs], and the name of what the GPU did."""


def part_of(name: str) -> str:
    if name.lower().startswith("memcpy"):
        return "copies"
    named = NAME.match(name)
    return "kernels of substeps" if named and named[2] in OF_A_SUBSTEP else "other launches"


def parts(events: Iterable[Event]) -> dict[str, tuple[int, float]]:
    """Launches and microseconds of each part, and those in which nothing ran."""
    count, busy = collections.Counter[str](), collections.Counter[str]()
    last = None
    for begin, end, name in sorted(events):
        last = begin if last is None else last
        part = part_of(name)
        busy["idle"] += max(0.0, begin - last)
        busy[part] += max(0.0, end - max(begin, last))
        count[part] += 1
        last = max(last, end)
    return {part: (count[part], busy[part]) for part in busy}


def replayed(settings: dict) -> tuple[int, list[Event]]:
    """Control steps of an episode, and what the GPU did in a replay of it."""
    task = elephant(ElephantConf(resolution=Resolution.standard, seconds=SECONDS, **settings))
    model = softmpm.build(task.scene, device="cuda", calls=task.control_steps, **task.build)
    with tempfile.TemporaryDirectory() as folder:
        loop = Runs([Run(task, model, Settings(), Path(folder))]).loop
        for _ in range(4):
            loop(None)
        torch.cuda.synchronize()
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
            loop(None)
            torch.cuda.synchronize()
    on_gpu = (one for one in profile.events() if one.device_type == torch.autograd.DeviceType.CUDA)
    return task.control_steps, [(one.time_range.start, one.time_range.end, one.name) for one in on_gpu]


def main():
    args = arguments(__doc__)
    if not torch.cuda.is_available():
        raise SystemExit("bench/control_step.py profiles a GPU, and there is none here.")
    table = Table("A replayed control step with its gradient, float32", torch.device("cuda"), args.json)
    for case, settings in CASES.items():
        steps, events = replayed(settings)
        for part, (count, busy) in parts(events).items():
            table.add({"elephant": case, "part": part, "launches": count / steps, "us": busy / steps})


if __name__ == "__main__":
    main()
