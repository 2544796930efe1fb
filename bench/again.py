"""The best walkers of finished runs, simulated again and again: `python bench/again.py FOLDER [--repeats 6] [--csv again.csv]`

FOLDER is that of a run, mostly of several seeds (train.seeds). Each best is simulated so often, as long as an evaluation, from rest and
with 0.05 m/s in turn; on a GPU the sums of each simulation round differently. For each seed and repeat a row:

    best, lasts   best evaluation of the run, and 1 if that motion lasted in it
    start         speed of the start along the first axis [m/s]
    way           way of the mean position until the end [m]; nothing of one that failed
    gap           largest distance of neighbours at rest, at the ends of control steps until it failed [cells]
    strain        largest von Mises strain of a particle, likewise
    failed        why the simulation failed, if it did: the kind of the failure, such as torn

The last line counts the seeds and simulations that failed.
"""

import argparse
import csv
import dataclasses
from pathlib import Path

import torch
import tqdm

import softmpm
from softmpm_learn.command import experiment, seeds
from softmpm_learn.distributed import Group
from softmpm_learn.episode import Frame, run_episode
from softmpm_learn.lasting import STARTS
from softmpm_learn.runs import saved
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.storage import checkpoint
from softmpm_learn.tasks import make_task


class Extremes:
    """Largest gap and strain of each world until it fails; called at each control step."""

    def __init__(self, model: softmpm.Model, failures: softmpm.Failures):
        self._pairs = torch.as_tensor(softmpm.neighbour_pairs(model.scene), device=model.device).T
        self._spacing, self._failures = model.scene.grid.spacing, failures
        self.found = torch.zeros(2, model.worlds, dtype=model.dtype, device=model.device)
        self.x: list[torch.Tensor] = []

    def __call__(self, frame: Frame) -> None:
        x, (one, other) = frame.state.x, self._pairs
        gap = (x[:, one] - x[:, other]).norm(dim=-1).amax(dim=1) / self._spacing
        now = torch.stack([gap, softmpm.von_mises_strain(frame.state).amax(dim=1)])
        now[:, self._failures.worlds] = 0.0
        self.found = torch.maximum(self.found, now)
        self.x.append(x[..., 0].mean(dim=1))


def finished(folder: Path, device: str | None) -> Runs:
    """The runs of a folder, at their best."""
    conf, group = saved.load(folder), Group()
    if device:
        conf = dataclasses.replace(conf, device=dataclasses.replace(conf.device, name=device))
    members, task = seeds.share(conf, folder, group), make_task(conf.task)
    model = experiment.make_model(task, conf, group, len(members))
    runs = [Run(task, model, one.settings, place, group, len(members)) for one, place in members]
    for run in runs:
        content = checkpoint.load(run.out)
        content["learner"] = content["learner"] and content["learner"] | {"replay": {}}
        run.load_state_dict(content)
        if run.best["iteration"] >= 0:
            run.load_policy(run.best)
    return Runs(runs)


@torch.no_grad()
def simulated(runs: Runs, speed: float) -> list[dict]:
    """A row for each run, from a start with this speed [m/s]."""
    model, failures, rest = runs.model, softmpm.Failures("reset"), runs.model.rest()
    episodes = runs.all[0].settings.train.endurance or 1
    longer = dataclasses.replace(runs.task, control_steps=episodes * runs.task.control_steps)
    rest.v[..., 0] += speed
    extremes, (params, inputs) = Extremes(model, failures), runs.design()
    about = dict(inputs=inputs, start=rest, failures=failures, on_frame=extremes)
    run_episode(longer, model, runs.observer, runs.policy, params, **about)
    failed, way = runs.failed(failures.errors), extremes.x[-1] - extremes.x[0]
    return [
        {
            "seed": run.settings.train.seed,
            "best": run.best["loss"],
            "lasts": int(run.best["lasts"]),
            "start": speed,
            "way": "" if k in failed else way[k].item(),
            "gap": extremes.found[0, k].item(),
            "strain": extremes.found[1, k].item(),
            "failed": failed[k].kind if k in failed else "",
        }
        for k, run in enumerate(runs.all)
    ]


def main():
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("folder", type=Path)
    options.add_argument("--repeats", type=int, default=6)
    options.add_argument("--device", default=None, help="cpu or cuda; else that of the run")
    options.add_argument("--csv", type=Path, default=Path("again.csv"))
    args = options.parse_args()
    runs, rows = finished(args.folder, args.device), []
    if runs.share != 1:
        raise SystemExit("bench/again.py is for runs with train.worlds=1.")
    runs.move(range(len(runs.all)))
    for repeat in tqdm.trange(args.repeats, unit="simulation"):
        rows += simulated(runs, STARTS[repeat % len(STARTS)])
    with open(args.csv, "w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    failed = [row for row in rows if row["failed"]]
    print(f"{len({row['seed'] for row in failed})} of {len(runs.all)} seeds failed,", end=" ")
    print(f"in {len(failed)} of {len(rows)} simulations; every one is in {args.csv}")


if __name__ == "__main__":
    main()
