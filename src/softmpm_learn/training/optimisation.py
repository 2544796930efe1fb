"""The optimisation step: simulate, differentiate, update policy and design; a step that fails is halved and tried again."""

import logging
import math
from collections.abc import Sequence

import torch
from torch import Tensor

import softmpm
from softmpm_learn.distributed import OtherProcessError, in_full
from softmpm_learn.episode import Episode
from softmpm_learn.recovery.fallback import limits
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.training.evaluation import Evaluation, due, evaluate, evaluate_best
from softmpm_learn.training.run_files import RunFiles, recorded
from softmpm_learn.training.timing import clock

SATURATED = 0.98
"""Root mean square of the activations from which on they are at their bounds: the gradient through tanh is a twenty-fifth there."""

logger = logging.getLogger("softmpm_learn")


class TrainingError(RuntimeError):
    """A simulation failed or a gradient is not finite; the checkpoint of the iterations before is on the disk."""

    def __init__(self, iteration: int, problem: Exception):
        helps = "weaker muscles (task.strength), a smaller time step (task.safety), smaller learning rates (optimizer.policy_rate), "
        helps += "or tighter bounds of the design"
        if isinstance(problem, softmpm.UnstableError) and problem.kind == "overlap":
            helps = "task.overlap=true, with which a robot may pass through itself"
        super().__init__(
            f"iteration {iteration}: {in_full(problem)} The run up to there is saved; what helps is {helps}."
        )
        self.iteration = iteration
        self.__cause__ = problem


class NotFiniteError(RuntimeError):
    """The loss or its gradient is infinite or no number."""


def optimise(
    runs: Runs, files: Sequence[RunFiles], seconds: dict[str, float]
) -> tuple[dict[int, dict[str, float]], Tensor | None]:
    """One optimisation step of every run that goes on: simulate, differentiate, update policy and design.

    After a failure policy and design of the run in which it was go halfway back to the last simulation that succeeded, and all try
    again. A run that has no retry left goes back to its best, or begins anew; if that fails too, it has failed and rests. Before it
    goes back for the first time it is saved as it was: from there it is resumed if it fails.

    Args:
        files: One for each run, or none.

    Returns:
        A row of metrics.csv for each run that goes on, by its number, and the observations of all worlds.

    Raises:
        TrainingError: The robot of a run failed that was at rest.
    """
    streams = {k: runs.all[k].goals.stream.get_state() for k in runs.active}
    goals, retries = runs.goals(runs.active), dict.fromkeys(runs.active, 0)
    returns = {k: runs.all[k].returns for k in runs.active}
    while runs.active:
        runs.move(runs.active)
        try:
            episode, rows = attempt(runs, goals, files, seconds)
            failed = {k: error for k, error in rows.items() if isinstance(error, NotFiniteError)}
        except softmpm.UnstableError as error:
            failed = runs.failed([error, *runs.loop.errors])
            runs.loop.errors.clear()  # they refer to the loop through their tracebacks
        except OtherProcessError as error:
            failed = {0: error}
        if not failed:
            found = {k: row | {"retries": retries[k]} for k, row in rows.items() if isinstance(row, dict)}
            for k, row in found.items():
                warn_of_saturation(runs.all[k], row["activation"])
            with clock(seconds, "evaluate"):
                update(runs, found)
            for k, row in found.items():  # after failed attempts or after the step
                row |= {name: count - returns[k][name] for name, count in runs.all[k].returns.items()}
            return found, episode.observations
        ends = any(k not in runs.active for k in failed)
        with clock(seconds, "save"), runs.group.fail_together():
            save_before(runs, files, {k: s for k, s in streams.items() if ends or k in failed})
        for k, error in failed.items():
            go_back(runs, k, error, retries.get(k, 0))
            retries[k] += 1
    return {}, None


def warn_of_saturation(run: Run, activation: float) -> None:
    """Log a warning, once, if the activations of an episode are at their bounds, by their root mean square."""
    if activation < SATURATED or run.saturated:
        return
    run.saturated = True
    logger.warning(
        "%s: the activations are at their bounds (root mean square %.3f), where the policy has hardly any gradient and stays "
        "as it is. If the loss falls no further, begin again with a lower optimizer.policy_rate, which is %g here.",
        run.now,
        activation,
        run.settings.optimizer.policy_rate,
    )


def save_before(runs: Runs, files: Sequence[RunFiles], streams: dict[int, Tensor]) -> None:
    """Write checkpoints of some runs as they were before this iteration drew their goals, unless there are such.

    Args:
        streams: State of the random stream of the goals at that time, by the number of the run.
    """
    for k, before in streams.items() if files else ():
        if not files[k].is_saved:
            goals = runs.all[k].goals.stream
            now = goals.get_state()
            goals.set_state(before)
            files[k].save()
            goals.set_state(now)


def go_back(runs: Runs, k: int, error: Exception, retries: int) -> None:
    """Halve the last step of a run whose simulation or gradient failed; after the last retry go back to its best, or begin anew. A run
    without a way back, or that fails there too, has failed.

    Raises:
        TrainingError: It was at rest.
    """
    run, most = runs.all[k], runs.all[k].settings.optimizer.retries
    if run.safe and most and retries <= most and k in runs.active:
        if retries < most:
            logger.warning("%s: %s Going halfway back.", run.now, in_full(error))
            run.backtrack()
        else:
            logger.warning("%s: %s The run is %s.", run.now, in_full(error), run.fall_back())
        return
    ended = TrainingError(run.iteration, error)
    if k not in runs.active:
        raise ended
    runs.errors[k] = ended
    if len(runs.all) > 1:
        logger.warning("The run of %s has failed in %s", runs.name(k), ended)


def update(runs: Runs, rows: dict[int, dict[str, float]]) -> None:
    """Take the step of each run along its gradient, go back to its best, or begin anew; keeps the best, and completes the rows."""
    asked = [k for k in rows if due(runs.all[k])]
    evaluations, values = evaluate(runs, asked) if asked else {}, dict[int, float]()
    for k, row in rows.items():
        run, found = runs.all[k], Evaluation(row["loss"], lasts=True)
        if run.evaluated:
            found = evaluations[k] if k in asked else Evaluation(math.nan, lasts=False)
            known = math.isfinite(found.loss)
            row["evaluation"], row["lasts"] = (
                (found.loss, int(found.lasts)) if known else (math.nan, math.nan)
            )
        run.keep(found.loss, found.lasts)
        values[k] = found.loss
    begin = [k for k in rows if runs.all[k].begins_to_settle()]
    evaluate_best(runs, [k for k in begin if runs.all[k].evaluated])
    for k, row in rows.items():
        step(runs.all[k], row["loss"], values[k], k in begin)
        row["best"] = runs.all[k].best["loss"]


def step(run: Run, loss: float, value: float, begins: bool = False) -> None:
    """Take the step along the gradient, go back to the best, or begin anew.

    Args:
        loss: That of the episode.
        value: By which the best is chosen; nan where it is not known.
        begins: The run begins to settle.
    """
    conf, low = run.settings.optimizer, ""
    is_far = run.fallback.is_due(value, run.best["loss"], conf, run.settles)
    if settle(run, begins):
        return
    if not run.settles and run.restart.is_due(loss, conf):
        low = f"in {run.restart.iterations} iterations no loss was below {conf.restart_above:g}; {run.begin_anew()}"
    elif is_far:
        share, after = limits(conf, run.settles)
        low = f"for {after} iterations " if after > 1 else ""
        low += f"the progress was below {share:g} of the best; {run.fall_back()}"
    if low:
        logger.warning("%s: %s.", run.now, low)
    else:
        run.step()


def settle(run: Run, begins: bool) -> bool:
    """Begin or end to settle, in the first and the last iteration of those; True if the run takes no step then."""
    ends = run.settles and run.left == 1
    elsewhere = run.best["iteration"] < run.iteration
    if begins and elsewhere:
        back = run.return_to_best(run.settings.optimizer.fallback_rate)
        logger.info("%s: the run settles; %s.", run.now, back)
    elif ends and elsewhere:
        logger.info("%s: the run ends; %s.", run.now, run.return_to_best())
    return ends or (begins and elsewhere)


def attempt(
    runs: Runs, goals: Tensor | None, files: Sequence[RunFiles], seconds: dict[str, float]
) -> tuple[Episode, dict[int, dict[str, float] | NotFiniteError]]:
    """Simulate and differentiate policies and designs as they are, in every process, or fail in every one.

    Gives the figures of each run that goes on, or an error in their place.
    """
    recording = [files[k] for k in runs.active if files and files[k].due(runs.all[k].iteration)]
    with clock(seconds, "episode"):
        with runs.failing_together(), recorded(runs, recording, seconds=seconds) as on_frames:
            episode, gradients = runs.loop(goals, on_frames)
        return episode, take_gradients(runs, episode, gradients)


def take_gradients(
    runs: Runs, episode: Episode, gradients: Sequence[Tensor]
) -> dict[int, dict[str, float] | NotFiniteError]:
    """Put the mean gradient of the worlds of each run into ``.grad`` of its policy and design; gives its length and the losses.

    The encoder is left out: it learns from pictures, not from the loss. All processes find the same, because the means are the same
    everywhere. The numbers of all runs are read from the device at once.
    """
    parts, measured = runs.split(runs.group.average(gradients)), {}
    for k in runs.active:
        run = runs.all[k]
        for parameter, gradient in zip(run.parameters, parts[k], strict=True):
            parameter.grad = gradient
        measured[k] = _losses(runs, episode, k) | {
            f"{name}_change": change for name, change in run.design.change().items()
        }
        measured[k] |= {
            f"square_{n}": gradient.double().square().sum() for n, gradient in enumerate(parts[k])
        }
    numbers = iter(
        torch.stack([t.double() for figures in measured.values() for t in figures.values()]).tolist()
    )
    read = {k: {name: next(numbers) for name in figures} for k, figures in measured.items()}
    return {k: _row(runs.all[k], figures) for k, figures in read.items()}


def _row(run: Run, figures: dict[str, float]) -> dict[str, float] | NotFiniteError:
    """Row of a run, whose gradient is shortened if it is longer than ``max_norm``."""
    squares = [figures.pop(f"square_{n}") for n in range(len(run.parameters))]
    count = len(list(run.policy.parameters()))
    lengths = {
        "gradient_policy": math.sqrt(sum(squares[:count])),
        "gradient_design": math.sqrt(sum(squares[count:])),
    }
    if not all(math.isfinite(value) for value in (figures["loss"], *lengths.values())):
        both = f"{figures['loss']:g} and {math.hypot(*lengths.values()):g}"
        return NotFiniteError(f"the loss or the norm of its gradient is not finite: {both}.")
    limit, clipped = run.settings.optimizer.max_norm, 0
    if limit is not None and math.hypot(*lengths.values()) > limit:
        torch.nn.utils.clip_grad_norm_(run.parameters, limit)
        clipped = 1
    return figures | lengths | {"clipped": clipped}


def _losses(runs: Runs, episode: Episode, k: int) -> dict[str, Tensor]:
    """Means over all worlds of a run; the activation is a root mean square."""
    own = {name: term[runs.worlds(k)] for name, term in ({"loss": episode.loss} | episode.terms).items()}
    means = [term.mean() for term in own.values()]
    *losses, square = runs.group.average([*means, episode.activation[:, runs.worlds(k)].square().mean()])
    return dict(zip(own, losses, strict=True)) | {"activation": square.sqrt()}
