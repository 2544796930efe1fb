"""Cost of the alarms: `python bench/alarms.py [--device cuda] [--json bench/results/alarms.json]`

Time of a substep with all alarms, without the alarms between chunks (distance of rest neighbours, running step limit), and with kernels
compiled without the checks of kernels/physics/status.py; the three are timed in turn within one run. Reported are medians and their
ratios. Kernels without checks exist in this benchmark only. The cube falls; in every second row it also turns, so that its particles
are re-sorted.
"""

import dataclasses
import functools
import itertools
import statistics
from types import SimpleNamespace

import torch
import warp as wp
from common import Table, arguments, cube, median_seconds, turning
from step import CASES

import softmpm
from softmpm.kernels.fast.g2p2g import fused
from softmpm.kernels.physics import status
from softmpm.kernels.plain.transfer import transfer
from softmpm.kernels.structs import types


def unchecked(model: softmpm.Model):
    """Compile the kernels of a model with checks that always succeed, under a specification that differs only in its class."""
    spec = model.spec
    t = types(spec.dim, spec.dtype)
    ivec, vec, mat, Constants = t.ivec, t.vec, t.mat, t.Constants

    @wp.func
    def running(words: wp.array(dtype=wp.int64), world: int) -> bool:
        return True

    @wp.func
    def valid(constants: Constants, corner: ivec, shape: ivec, fx: vec, base: ivec, H: mat) -> bool:
        return True

    report_of, check_of = status.report, status.check
    status.report = lambda *_: SimpleNamespace(running=running, report=report_of(spec.dim, spec.dtype).report)
    # Every state is valid, so this function is never called:
    status.check = lambda *_: SimpleNamespace(valid=valid, report_invalid=check_of(spec).report_invalid)
    transfer(spec) if model.scheme == "plain" else fused(spec)
    status.report, status.check = report_of, check_of


def variants(scene: softmpm.Scene, device: torch.device, scheme: str) -> dict[str, softmpm.Model]:
    """One model with all alarms, one with the alarms of each substep only, and one without any."""
    few = softmpm.Alarms(gap=None, step=None)
    settings = {"all": None, "substep": few, "none": few}
    models = {
        name: softmpm.build(scene, device=device, scheme=scheme, alarms=alarms)
        for name, alarms in settings.items()
    }

    class Unchecked(type(models["none"].spec)):
        """Another specification to the caches of kernels."""

    models["none"].spec = Unchecked(**dataclasses.asdict(models["none"].spec))
    unchecked(models["none"])
    return models


@torch.no_grad()
def run(model: softmpm.Model, start: softmpm.State, substeps: int) -> None:
    softmpm.simulate(model, start, None, model.params(), substeps=substeps)


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("Cost of alarms, float32", device, args.json)
    for (dim, particles, nodes), scheme in itertools.product(CASES[:-1], ("plain", "fast")):
        if particles > (args.largest or (8_000 if device.type == "cpu" else particles)):
            continue
        substeps = 64 if device.type == "cpu" else 512 if particles < 500_000 else 256
        models = variants(cube(dim, particles, nodes), device, scheme)
        for motion in ("falling", "turning"):
            start = models["all"].rest() if motion == "falling" else turning(models["all"])
            seconds = {name: [] for name in models}
            for _ in range(args.repeats):
                for name, model in models.items():
                    work = functools.partial(run, model, start, substeps)
                    seconds[name].append(median_seconds(work, device, 3))
            row = {"dim": dim, "particles": particles, "scheme": scheme, "motion": motion}
            row |= {f"{name} us": statistics.median(s) / substeps * 1e6 for name, s in seconds.items()}
            for over in ("substep", "none"):
                ratios = (a / b for a, b in zip(seconds["all"], seconds[over], strict=True))
                row[f"all / {over}"] = statistics.median(ratios)
            table.add(row)


if __name__ == "__main__":
    main()
