"""Outcomes of random scenes and calls: `python bench/fuzz.py --count 5000 --seed 0`, and `--legal --count 1000`

Cases are drawn from tests/fuzzing: scenes with extreme numbers, initial states of every kind, wrong arguments, mismatched Warp arrays.
Each case has a number, starting with ``--seed``, and runs in a separate process, so that a crash or a hang does not end the others. A
table counts the outcomes. Cases with a bad outcome are printed and, with all their numbers, written to the JSON file if one was given;
``--case`` runs a single case in this process. With `--legal` the scenes are plausible ones close to the stable step.
"""

import argparse
import collections
import json
import random
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import tqdm
from fuzzing.verdict import GOOD
from fuzzing.worker import Worker, verdict_of


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--way", choices=["all", "simulate", "step"], default="all", help="which calls to draw"
    )
    parser.add_argument(
        "--legal", action="store_true", help="plausible scenes, as a careful user would write them"
    )
    parser.add_argument("--share", type=float, default=0.95, help="of the stable step, in legal scenes")
    parser.add_argument("--case", type=int, default=None, help="only this number, in this process")
    parser.add_argument(
        "--json", type=Path, default=None, help="also write the table and the bad cases to this file"
    )
    return parser.parse_args()


def planner(args: argparse.Namespace) -> Callable[[int], dict]:
    """Function from the number of a case to its data; hypothesis draws it from random bytes."""
    if args.legal:
        return lambda seed: {"way": "legal", "seed": seed, "share": args.share}
    import hypothesis
    from fuzzing.calls import simulations
    from fuzzing.warp_way import steps

    found: list[dict] = []
    kinds = {"all": simulations | steps, "simulate": simulations, "step": steps}

    @hypothesis.settings(database=None, deadline=None)
    @hypothesis.given(kinds[args.way])
    def collect(plan):
        found.append(json.loads(json.dumps(plan)))

    def plan(seed: int) -> dict:
        collect.hypothesis.fuzz_one_input(random.Random(seed).randbytes(16_384))
        return found.pop() | {"case": seed}

    return plan


def table(counts: collections.Counter) -> list[dict]:
    """One row for each kind of call."""
    kinds = [*GOOD, *sorted({kind for _, kind in counts} - set(GOOD))]
    rows = []
    for way in sorted({way for way, _ in counts}):
        row = {kind: counts[way, kind] for kind in kinds}
        rows.append({"calls": way, **row, "all": sum(row.values())})
    return rows


def show(rows: list[dict]) -> None:
    for row in ({name: name for name in rows[0]}, *rows):
        print("  ".join(str(cell).rjust(max(9, len(name))) for name, cell in row.items()))


def main() -> None:
    args = arguments()
    plan_of = planner(args)
    if args.case is not None:
        plan = plan_of(args.case)
        print(json.dumps(plan), verdict_of(plan), sep="\n")
        return
    counts, bad, worker = collections.Counter(), [], Worker()
    for seed in tqdm.trange(args.seed, args.seed + args.count, unit="case", smoothing=0.1):
        plan = plan_of(seed)
        verdict = worker.judge(plan)
        counts[plan["way"], verdict.kind] += 1
        if not verdict.good:
            bad.append({"verdict": verdict.kind, "words": verdict.words, "plan": plan})
            tqdm.tqdm.write(
                f"{seed} {plan['way']} {plan.get('fault', '')}: {verdict.kind}, {verdict.words}"[:300]
            )
    worker.stop()
    rows = table(counts)
    show(rows)
    if args.json:
        args.json.write_text(
            json.dumps({"title": __doc__.splitlines()[0], "rows": rows, "bad": bad}, indent=1) + "\n"
        )
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
