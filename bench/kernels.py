"""Durations of the kernels of a substep and of its adjoint, for robots on a GPU: `python bench/kernels.py [--json FILE]`

By the profiler of CUDA, in a call of 96 substeps that stores its states and in its backward pass, after two such calls: the median
duration of a kernel, and what its launches add up to in a substep. A kernel that begins while the previous one ends is timed from its
beginning, its wait included, so kernels that follow each other overlap; what the GPU does between two others is in neither figure.
"""

import collections
import re
import statistics

import torch
from common import Table, arguments
from episode import NODES, SURFACE, VISCOUS, task_of

import softmpm

SUBSTEPS = 96
LEAST = 0.1
"""Kernels that take less of a substep are left out [µs]."""
CONTACTS = {
    ("moving", "nodes"): NODES,
    ("moving", "surface points"): SURFACE,
    ("reference", "surface points"): SURFACE | dict(formulation="reference"),
}
NAME = re.compile(r"(\w+)__locals__(\w+)_[0-9a-f]{8}_")
"""A kernel of ours in the profile: factory, name, hash."""


def durations(model: softmpm.Model) -> dict[str, list[float]]:
    """Those of the launches of each kernel in a call with its backward pass [µs]."""
    start, found = model.rest(), collections.defaultdict[str, list[float]](list)
    params = softmpm.Params(*(value.clone().requires_grad_() for value in model.params()))
    activation = torch.full(
        (1, model.worlds, model.muscle_count), 0.2, device=model.device, requires_grad=True
    )

    def work() -> None:
        end = softmpm.simulate(model, start, activation, params, substeps=SUBSTEPS)
        end.x.sum().backward()
        torch.cuda.synchronize()

    for _ in range(2):
        work()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        work()
    for event in profile.events():
        if (named := NAME.match(event.name)) and event.device_type == torch.autograd.DeviceType.CUDA:
            found[".".join(named.groups())].append(event.time_range.elapsed_us())
    return found


def main():
    args = arguments(__doc__)
    if not torch.cuda.is_available():
        raise SystemExit("bench/kernels.py profiles a GPU, and there is none here.")
    device = torch.device("cuda")
    table = Table(f"Kernels of a substep and of its adjoint, {SUBSTEPS} substeps, float32", device, args.json)
    for robot in ("biped", "elephant"):
        for (formulation, contact), settings in CONTACTS.items():
            task = task_of(robot, 128, 0.0125, SUBSTEPS, VISCOUS | settings)
            model = softmpm.build(task.scene, device=device, **task.build)
            for kernel, times in durations(model).items():
                if sum(times) < LEAST * SUBSTEPS:
                    continue
                about = {"robot": robot, "formulation": formulation, "contact": contact}
                launches = {"particles": model.particle_count, "kernel": kernel, "launches": len(times)}
                spent = {"us": statistics.median(times), "us of a substep": sum(times) / SUBSTEPS}
                table.add(about | launches | spent)


if __name__ == "__main__":
    main()
