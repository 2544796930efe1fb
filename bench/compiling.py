"""Seconds until the first gradient of a scene: `python bench/compiling.py [--json bench/results/compiling.json]`

A call of 20 substeps and its gradient, in a program of its own: with an empty cache of kernels, which compiles them, and again with a
full one. ``compiled`` counts the modules. The cache of the CUDA compiler is off. The import of softmpm and the building of the model
are not counted.
"""

import json
import os
import subprocess
import sys
import tempfile
import time

import torch
from common import Table, arguments, sync
from episode import ELASTIC, SURFACE, VISCOUS, task_of
from formulations import block

import softmpm

CASES = {
    "2D block on a floor": lambda: block(2, 32, True),
    "3D block on a floor": lambda: block(3, 24, True),
    "elephant": lambda: task_of("elephant", 128, 0.0125, 2000, VISCOUS | SURFACE).scene,
    "elastic biped": lambda: task_of("biped", 128, 0.0125, 2000, ELASTIC).scene,
}


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    table = Table("First gradient, float32", device, args.json)
    for case in CASES:
        for formulation in ("moving", "reference"):
            with tempfile.TemporaryDirectory() as cache:
                (empty, compiled), (full, _) = (run(case, formulation, device, cache) for _ in range(2))
            row = {"case": case, "formulation": formulation, "compiled": compiled}
            table.add(row | {"empty cache s": empty, "full cache s": full})


def run(case: str, formulation: str, device: torch.device, cache: str) -> tuple[float, int]:
    """Seconds, and modules that were compiled, of this case in a program of its own."""
    environment = os.environ | {"WARP_CACHE_PATH": cache, "CUDA_CACHE_DISABLE": "1"}
    words = [sys.executable, __file__, json.dumps([case, formulation, str(device)])]
    done = subprocess.run(words, capture_output=True, text=True, env=environment)
    if done.returncode:
        sys.exit(done.stdout + done.stderr)
    return float(done.stdout.splitlines()[-1]), done.stdout.count("(compiled)")


def first_gradient(case: str, formulation: str, device: str) -> None:
    """Print the seconds of the call and its gradient."""
    model = softmpm.build(CASES[case](), device=device, formulation=formulation)
    params = softmpm.Params(*(one.detach().clone().requires_grad_() for one in model.params()))
    activation = torch.zeros(1, 1, model.muscle_count, device=device, requires_grad=model.muscle_count > 0)
    begin = time.perf_counter()
    end = softmpm.simulate(model, model.rest(), activation, params, substeps=20)
    end.x.sum().backward()
    sync(model.device)
    print(time.perf_counter() - begin)


if __name__ == "__main__":
    if sys.argv[1:] and sys.argv[1].startswith("["):
        first_gradient(*json.loads(sys.argv[1]))
    else:
        main()
