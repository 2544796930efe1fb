"""What does watching for failures cost? `python bench/watch.py [--device cuda]`

The same substeps with the checks of kernels/failure.py and with kernels compiled without them, in turn, in one run: ratio of
medians. The second kind of kernel exists only here.
"""

import dataclasses
import itertools
import statistics
from types import SimpleNamespace

import torch
import warp as wp
from common import Table, arguments, cube, median_seconds
from step import CASES

import softmpm
from softmpm.kernels import failure
from softmpm.kernels.fused import fused
from softmpm.kernels.transfer import transfer
from softmpm.kernels.types import solid_types, types


def unchecked(model: softmpm.Model):
    """Replace the checks by functions that say yes, for a specification that differs in its name only."""
    spec = model.spec
    t, Solid = types(spec.dim, spec.dtype), solid_types(spec).Solid
    ivec, vec, mat = t.ivec, t.vec, t.mat

    @wp.func
    def running(watch: wp.array(dtype=wp.int64), world: int) -> bool:
        return True

    @wp.func
    def sound(
        body: Solid, corner: ivec, shape: ivec, world: int, p: int, fx: vec, base: ivec, H: mat
    ) -> bool:
        return True

    report_of, check_of = failure.report, failure.check
    failure.report = lambda *_: SimpleNamespace(
        running=running, report=report_of(spec.dim, spec.dtype).report
    )
    # Nobody complains of a state that is sound:
    failure.check = lambda *_: SimpleNamespace(sound=sound, complain=check_of(spec).complain)
    transfer(spec) if model.scheme == "plain" else fused(spec)
    failure.report, failure.check = report_of, check_of


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("Cost of watching for failures, float32", device, args.json)
    substeps = 20 if device.type == "cpu" else 200
    for (dim, particles, nodes), scheme in itertools.product(CASES[:-1], ("plain", "fast")):
        if particles > (args.largest or (8_000 if device.type == "cpu" else particles)):
            continue
        scene = cube(dim, particles, nodes)
        models = [softmpm.build(scene, device=device, scheme=scheme) for _ in range(2)]

        class Unchecked(type(models[1].spec)):
            module = models[1].spec.module + ".unchecked"

        models[1].spec = Unchecked(**dataclasses.asdict(models[1].spec))
        unchecked(models[1])
        start, params = models[0].rest(), models[0].params()
        seconds = [[], []]
        for _ in range(args.repeats):
            for k, model in enumerate(models):

                def work(model=model, start=start, params=params):
                    with torch.no_grad():
                        softmpm.simulate(model, start, None, params, substeps=substeps)

                seconds[k].append(median_seconds(work, device, 3))
        with_watch, without = (statistics.median(s) / substeps * 1e6 for s in seconds)
        ratio = statistics.median(a / b for a, b in zip(*seconds, strict=True))
        table.add(
            {
                "dim": dim,
                "particles": particles,
                "scheme": scheme,
                "watched us": with_watch,
                "unwatched us": without,
                "ratio": ratio,
            }
        )


if __name__ == "__main__":
    main()
