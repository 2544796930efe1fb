"""Cost of each feature and each input: `python bench/features.py [--device cuda] [--largest 1000000] [--json FILE]`

Microseconds of a substep without gradient (forward), and of a substep and its adjoint with all states stored (gradient); peak memory
of one such gradient, the model included. Each is also given as a ratio to the scene named under ``relative to``; the two are timed in
turn within one run, and the ratio of times is the median over the turns. The first row compares a scene with itself: its ratios are 1
but for the error of the measurement. Calls are replayed as a :class:`softmpm.Graph`, so the times on a GPU exclude the host.

Features that a scene lacks are not compiled (tests/softmpm/test_model.py), so an absent feature costs nothing. Rows named ``input``
declare one field of :class:`softmpm.Inputs`, give it in every control step and take its gradient. Its values are those of the scene,
so that the motion, which starts with a turn of the cube, is that of the reference. The row ``material`` takes the gradient of all
fields of :class:`softmpm.Params`. Two rows place the same cube in grids that are mostly empty.
"""

import functools
import statistics

import torch
from common import Table, arguments, cube, median_seconds, turning
from step import CASES

import softmpm
from softmpm.inputs import QUANTITIES

CONTROL_STEP = 32
"""Substeps of a control step."""
WARM = 4
"""Warm-up calls: the first compiles, the second captures; if a particle leaves the window, two more do so with a larger window."""
ALONE = "elastic cube"
BARE = {"gravity": None}
FLOOR = {"normal": (0.0, 1.0, 0.0), "offset": 0.3}
FEATURES = {
    ALONE: BARE,
    "stable neo-Hookean": BARE | {"law": softmpm.StableNeoHookean},
    "fixed corotated": BARE | {"law": softmpm.FixedCorotated},
    "barrier corotated": BARE | {"law": softmpm.BarrierCorotated},
    "viscosity": BARE | {"law": functools.partial(softmpm.NeoHookean, viscosity=0.1)},
    "gravity": {},
    "damping": BARE | {"damping": 0.1},
    "wall": BARE | {"walls": [softmpm.Wall(**FLOOR, contact="slip")]},
    "wall with friction": BARE | {"walls": [softmpm.Wall(**FLOOR, friction=0.5)]},
    "six walls with friction": BARE
    | {
        "walls": [
            softmpm.Wall(normal=tuple(s * (a == axis) for a in range(3)), offset=s * 0.5 - 0.4, friction=0.5)
            for axis in range(3)
            for s in (1.0, -1.0)
        ]
    },
    "muscle": BARE | {"muscles": True},
    "pressure": BARE | {"pressure": True},
    "clamp": BARE | {"clamp": True},
    "grid of 256³": BARE | {"domain": 256},
    "grid of 1024³": BARE | {"domain": 1024},
}
INPUTS = {
    "gravity": "gravity",
    "damping": "damping",
    "friction": "wall with friction",
    "wall_offset": "wall with friction",
    "wall_normal": "wall with friction",
    "wall_velocity": "wall with friction",
    "direction": "muscle",
    "strength": "muscle",
    "viscosity": "viscosity",
    "velocity": "clamp",
    "position": "clamp",
    "force": ALONE,
}
"""Scene that each field of :class:`softmpm.Inputs` is given to."""
ROWS = [
    *((name, ALONE, name, ()) for name in FEATURES),
    ("material", ALONE, ALONE, softmpm.Params._fields),
    *((f"input {name}", scene, scene, (name,)) for name, scene in INPUTS.items()),
]
"""Name of each row, its reference, its own scene and the quantities whose gradient it takes."""


def of_scene(model: softmpm.Model, name: str, control_steps: int) -> torch.Tensor:
    """An input with the values that it has in the scene, in full shape."""
    known = QUANTITIES[name]
    values = model.positions[model.driven] if known.default is None else known.default(model.scene)
    dtype = torch.float64 if known.double else model.dtype
    tensor = torch.as_tensor(values, dtype=dtype, device=model.device)
    return tensor.expand(model.shape_of(name, control_steps)).clone()


class Case:
    """A scene with some inputs, ready to be timed.

    Attributes:
        calls: A call without gradient, and one with it.
        memory: Peak memory of the model and of a call with gradient [MiB]; zero on the CPU, where it is not measured.
    """

    def __init__(self, scene: softmpm.Scene, names: tuple[str, ...], substeps: int, device: torch.device):
        gpu, fields = device.type == "cuda", [n for n in names if n in softmpm.Inputs._fields]
        before = torch.cuda.memory_allocated(device) if gpu else 0
        model = softmpm.build(scene, device=device, memory_budget=2**62, inputs=fields)
        start, params, steps = turning(model), model.params(), substeps // CONTROL_STEP
        activation = torch.full((steps, 1, model.muscle_count), 0.2, device=model.device)
        inputs = softmpm.Inputs(**{name: of_scene(model, name, steps) for name in fields})
        wanted = [start.v, *([activation] if model.muscle_count else [])]
        wanted += [value for value in inputs if value is not None]
        wanted += [getattr(params, name) for name in names if name in params._fields]
        for tensor in wanted:
            tensor.requires_grad_()

        def end() -> torch.Tensor:
            return softmpm.simulate(model, start, activation, params, substeps=CONTROL_STEP, inputs=inputs).x

        def gradient() -> tuple[torch.Tensor, ...]:
            return torch.autograd.grad(end().sum(), wanted)

        works = {"forward": torch.no_grad()(end), "gradient": gradient}
        self.calls = {name: softmpm.Graph(work, model.device) for name, work in works.items()}
        if gpu:
            torch.cuda.reset_peak_memory_stats(device)
        self.calls["gradient"]()
        self.memory = (torch.cuda.max_memory_allocated(device) - before) / 2**20 if gpu else 0.0
        for call in WARM * tuple(self.calls.values()):
            call()


def compare(case: Case, reference: Case, substeps: int, repeats: int, device: torch.device) -> dict:
    """Columns of a row: times, memory and their ratios to the reference."""
    times, ratios = {}, {}
    for name in case.calls:
        pairs = [
            [median_seconds(one.calls[name], device, 3) / substeps * 1e6 for one in (case, reference)]
            for _ in range(repeats)
        ]
        times[f"{name} us"] = statistics.median(own for own, _ in pairs)
        ratios[f"{name} ratio"] = statistics.median(own / other for own, other in pairs)
    if reference.memory:
        times["memory MiB"], ratios["memory ratio"] = case.memory, case.memory / reference.memory
    return times | ratios


def main():
    args = arguments(__doc__)
    device = torch.device(args.device)
    gpu = device.type == "cuda"
    table = Table("Cost of features and inputs, 3D, float32", device, args.json)
    for particles, nodes in [case[1:] for case in CASES if case[0] == 3] if gpu else [(1_000, 16)]:
        if particles > (args.largest or 1_000_000):
            continue
        substeps, references = 512 if gpu and particles < 500_000 else 64, {}
        for name, relative, scene, names in ROWS:
            if relative not in references:
                references = {
                    relative: Case(cube(3, particles, nodes, **FEATURES[relative]), (), substeps, device)
                }
            case = Case(cube(3, particles, nodes, **FEATURES[scene]), names, substeps, device)
            row = {"row": name, "relative to": relative, "particles": particles}
            table.add(row | compare(case, references[relative], substeps, args.repeats, device))
            del case
            if gpu:
                torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
