"""Both formulations on one body: `python bench/formulations.py [--device cpu --threads 1 2] [--json FILE]`

Microseconds of a substep in calls without gradient, in calls that store their states, and of the backward pass; medians after a
warm-up, one formulation after the other. ``further`` and ``adjoint``: of one more substep in a call without gradient, and in a backward
pass, without what a call costs in any case; the median over pairs of a long and a short call. ``kept``: bytes that a gradient keeps for
each substep. ``ratio`` is the moving formulation's figure over that of the reference formulation.

All bodies breathe. ``cube``: particles on a lattice, without walls, in one world or several, with faces on knots of the splines.
``block`` has an outline; ``on a floor`` it also meets a wall with friction, at nodes in the moving and at surface points in the
reference formulation, and ``viscous`` it is of a viscous material. On a floor the moving formulation is timed with contact at surface
points as well. The last rows of the blocks are quotients of calls in turn, medians over the rounds: of both blocks over the block alone
in the reference formulation, and of contact at surface points over that at nodes in the moving one.

On a CPU the reference formulation runs with each number of threads; ``gain`` is its time with the first over that with this number,
and ``cores`` the processor time of a call without gradient over its duration: below ``threads`` if other processes had a part of the
cores.
"""

import statistics
import time
from collections.abc import Callable, Iterable, Iterator

import torch
from common import Table, arguments, cube, sync
from gradient import seconds, substeps_of

import softmpm

CASES = [
    (3, 8_000, 32, 1),
    (3, 64_000, 48, 1),
    (3, 8_000, 32, 64),
    (3, 1_000_000, 96, 1),
    (3, 8_000_000, 192, 1),
]
ON_A_CPU = [(2, 3_000, 96, 1), (2, 20_000, 192, 1), (3, 8_000, 32, 1)]
"""Dimension, particles of a world, nodes along an axis, worlds."""
BLOCKS: dict[str, dict] = {
    "block": {},
    "block on a floor": {"floor": True},
    "viscous block": {"viscosity": 100.0},
}
FIGURES = "forward", "further", "stored", "backward", "adjoint", "kept"

SHORTER = 5
"""Quotient of the lengths of two calls, whose difference is the cost of a further substep. The shorter one is added for it: in a longer
one the cube might fall off the grid."""

PAIRS = 4
"""Pairs of a long and a short call for each repeat: the difference of two calls scatters more than a call."""


def block(dim: int, cells: int, floor: bool = False, viscosity: float = 0.0) -> softmpm.Scene:
    """A box with an outline in the middle of the grid, ``cells`` wide; gravity presses it onto the floor if there is one."""
    dx = 0.5 / cells
    low, high, up = (0.25,) * dim, (0.75,) * dim, (0.0, 1.0) + (0.0,) * (dim - 2)
    rubber = softmpm.NeoHookean(density=1000.0, young=1e5, poisson=0.3, viscosity=viscosity)
    scene = dict(
        grid=softmpm.Grid(shape=(2 * cells,) * dim, spacing=dx),
        bodies=[softmpm.Body(softmpm.box(low, high, spacing=dx / 2), rubber)],
        walls=[softmpm.Wall(normal=up, offset=0.25, friction=0.5)] if floor else [],
        gravity=tuple(-0.5 * u for u in up),
    )
    return softmpm.Scene(**scene, dt=0.3 * softmpm.stable_dt(softmpm.Scene(**scene, dt=1.0)))


def cases(on_a_cpu: bool) -> Iterator[tuple[str, int, int, int, Callable[[], softmpm.Scene]]]:
    """Name, dimension, worlds, particles of a world, and the scene."""
    for dim, particles, nodes, worlds in ON_A_CPU if on_a_cpu else CASES:
        yield "cube", dim, worlds, particles, lambda d=dim, p=particles, n=nodes: cube(d, p, n, on_knots=True)
    for dim, cells in [(2, 32), (3, 10)] if on_a_cpu else [(2, 32), (3, 24)]:
        for name, has in BLOCKS.items():
            yield name, dim, 1, (2 * cells) ** dim, lambda d=dim, c=cells, has=has: block(d, c, **has)


def call(
    model: softmpm.Model, start: softmpm.State, params: softmpm.Params, substeps: int
) -> tuple[float, float]:
    """Microseconds of a call without gradient, and the cores that it used."""
    sync(model.device)
    begin, used = time.perf_counter(), time.process_time()
    with torch.no_grad():
        softmpm.simulate(model, start, None, params, substeps=substeps)
    sync(model.device)
    passed = time.perf_counter() - begin
    return 1e6 * passed, (time.process_time() - used) / passed


def breathing(model: softmpm.Model) -> softmpm.State:
    """The scene at rest but expanding, at 0.05 of its size in a second: undeformed particles would need no logarithm."""
    start = model.rest()
    start.v.add_(start.x - start.x.mean(dim=1, keepdim=True), alpha=0.05)
    return start


def call_with_gradient(
    model: softmpm.Model, start: softmpm.State, params: softmpm.Params, substeps: int
) -> tuple[float, float]:
    """Microseconds of a call that stores its states, and of its backward pass."""
    start.v.requires_grad_()
    ahead, back = seconds(model, start, None, params, substeps)
    return 1e6 * ahead, 1e6 * back


Times = tuple[float, float]
"""What these two return."""


def rounds(
    work: Callable[..., Times], models: list[softmpm.Model], substeps: int, repeats: int
) -> list[list[tuple[Times, Times]]]:
    """In each round, of each model in turn, the times of a long and a short call, after a round that compiles."""
    lengths = (substeps, substeps // SHORTER)

    def pair(model: softmpm.Model) -> tuple[Times, Times]:
        about = model, breathing(model), model.params()
        return work(*about, lengths[0]), work(*about, lengths[1])

    return [[pair(model) for model in models] for _ in range(PAIRS * repeats + 1)][1:]


def microseconds(
    alone: tuple[Times, Times], both: tuple[Times, Times], substeps: int, kept: int
) -> tuple[float, ...]:
    """Figures of a round, in the order of :data:`FIGURES`."""
    longer = substeps - substeps // SHORTER
    further, adjoint = (pair[0][which] - pair[1][which] for which, pair in ((0, alone), (1, both)))
    whole = [time / substeps for time in (alone[0][0], *both[0])]
    return whole[0], further / longer, *whole[1:], adjoint / longer, kept


def in_turn(
    models: list[softmpm.Model], substeps: int, repeats: int
) -> tuple[list[list[tuple[float, ...]]], list[float]]:
    """Of each model its figures in every round, and the cores that it used."""
    alone = rounds(call, models, substeps, repeats)
    both = rounds(call_with_gradient, models, substeps, repeats)
    found, cores = [], []
    for k, model in enumerate(models):
        kept = model.sizes().inside + model.sizes().nodes
        found.append([microseconds(a[k], b[k], substeps, kept) for a, b in zip(alone, both, strict=True)])
        cores.append(statistics.median(a[k][0][1] for a in alone))
    return found, cores


def medians(rows: Iterable[tuple[float, ...]]) -> tuple[float, ...]:
    return tuple(map(statistics.median, zip(*rows, strict=True)))


def figures(
    scene: softmpm.Scene, formulation: str, worlds: int, substeps: int, args, contact: str = "auto"
) -> tuple[tuple[float, ...], float]:
    """In the order of :data:`FIGURES`, and the cores that were used."""
    model = built(scene, formulation, worlds, args, contact)
    found, cores = in_turn([model], substeps, args.repeats)
    return medians(found[0]), cores[0]


def built(scene: softmpm.Scene, formulation: str, worlds: int, args, contact: str = "auto") -> softmpm.Model:
    return softmpm.build(
        scene,
        device=args.device,
        worlds=worlds,
        formulation=formulation,
        contact=contact,
        memory_budget=2**62,
    )


def main():
    args = arguments(__doc__, threads=True)
    device = torch.device(args.device)
    table = Table("Two formulations [us/substep], float32", device, args.json)
    runs = [("moving", args.threads[0]), *(("reference", count) for count in args.threads)]
    for name, dim, worlds, particles, scene in cases(device.type == "cpu"):
        if particles * worlds > (args.largest or particles * worlds):
            continue
        case, found = {"scene": name, "dim": dim, "worlds": worlds, "particles": particles}, []
        substeps = substeps_of(particles * worlds, device)["kept"]

        def add(kind: str, threads: int, values: tuple[float, ...], cores: float = 0.0, case=case) -> None:
            row = case | {"formulation": kind, "threads": threads}
            table.add(row | dict(zip(FIGURES, values, strict=True)) | {"cores": cores})

        for formulation, threads in runs:
            torch.set_num_threads(threads)
            contact = "nodes" if formulation == "moving" else "auto"
            values, cores = figures(scene(), formulation, worlds, substeps, args, contact)
            found.append(values)
            add(formulation, threads, values, cores)
            if device.type == "cuda":
                torch.cuda.empty_cache()
        add("ratio", runs[1][1], quotients(found[0], found[1]))
        for (_, threads), values in zip(runs[2:], found[2:], strict=True):
            add("gain", threads, quotients(found[1], values))
        if name == "block":
            alone = scene()
        elif name in BLOCKS:
            torch.set_num_threads(args.threads[0])
            models = [built(each, "reference", worlds, args) for each in (scene(), alone)]
            found, _ = in_turn(models, substeps, args.repeats)
            add("with over without", args.threads[0], medians(map(quotients, *found)))
        if name == "block on a floor":
            models = [built(scene(), "moving", worlds, args, kind) for kind in ("surface", "nodes")]
            found, cores = in_turn(models, substeps, args.repeats)
            add("moving, surface", args.threads[0], medians(found[0]), cores[0])
            add("surface over nodes", args.threads[0], medians(map(quotients, *found)))


def quotients(one: tuple[float, ...], other: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(a / b for a, b in zip(one, other, strict=True))


if __name__ == "__main__":
    main()
