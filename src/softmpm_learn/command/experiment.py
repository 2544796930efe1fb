"""One experiment, from its settings to everything that it leaves in its folder. Nothing here knows Hydra."""

import contextlib
import logging
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
import warp as wp

import softmpm
from softmpm_learn import plugins
from softmpm_learn.command import seeds
from softmpm_learn.command.farewell import Ending, farewell, farewell_of_seeds
from softmpm_learn.command.pictures import DRAWN, Sketches, draw, no_sketch
from softmpm_learn.command.progress import ProgressBar
from softmpm_learn.command.stop import Signals
from softmpm_learn.config import RunConf
from softmpm_learn.design import declared_inputs
from softmpm_learn.distributed import Group
from softmpm_learn.loggers import Loggers
from softmpm_learn.runs.resuming import entered
from softmpm_learn.runs.saved import save
from softmpm_learn.tasks import Task, TaskConf, make_task
from softmpm_learn.train import Plan, Result, train_side_by_side
from softmpm_learn.training.timing import account, clock

logger = logging.getLogger("softmpm_learn")
THREADS = torch.get_num_threads()
"""Those that PyTorch begins with: one on each core, or as many as OMP_NUM_THREADS says."""


def run_experiment(
    conf: RunConf,
    out: Path,
    group: Group | None = None,
    signals: Signals | None = None,
    begin: Callable[[], None] = lambda: None,
) -> list[Result]:
    """Train, draw and convert; goes on where a checkpoint in ``out`` ends. The last line says what to do next.

    Of several processes, the first draws, converts and speaks. With several seeds each has a folder of its own in ``out``, and each
    process its share of them, of which it draws the pictures.

    Args:
        signals: What asks the run to end, None for nothing.
        begin: Called in the first process once ``out`` is locked and found to be this run's, before the configuration is saved.
    """
    return run_side_by_side([(conf, out)], group, signals, begin)[0]


def run_side_by_side(
    jobs: Sequence[tuple[RunConf, Path]],
    group: Group | None = None,
    signals: Signals | None = None,
    begin: Callable[[], None] = lambda: None,
) -> list[list[Result]]:
    """As :func:`run_experiment`, for several of one robot in one simulation; gives the results of each.

    Args:
        jobs: Settings and folder of each. They have task and device in common, and what :func:`softmpm_learn.runs.runs.shared` names.

    Raises:
        ValueError: Settings that do not go together, or fewer seeds than processes.
    """
    began, group, signals = time.perf_counter(), group or Group(), signals or Signals()
    (conf, out), alone = jobs[0], len(jobs) == 1 and jobs[0][0].train.seeds == 1
    if len(jobs) > 1 and conf.train.seeds < group.size:
        raise ValueError(
            f"jobs side by side need train.seeds ≥ {group.size}, so that each process has some of them; got {conf.train.seeds}."
        )
    wp.config.log_level = wp.LOG_ERROR
    torch.set_num_threads(1)  # several add up in another order
    need_determinism(conf.device.deterministic)
    with group.fail_together():
        shares = [seeds.share(own, place, group) for own, place in jobs]
        members, task = [member for share in shares for member in share], make_task(conf.task)
        model = make_model(task, conf, group, None if alone else len(members))
    logger.info("%s", model.describe(task.substeps))
    if not alone and group.size > 1:
        own = ", ".join(map(str, sorted({one.train.seed for one, _ in members})))
        logger.info("Progress is reported of the seeds of the first process: %s.", own)
    with contextlib.ExitStack() as open_loggers, contextlib.ExitStack() as held:
        loggers = [open_loggers.enter_context(Loggers(one.train.log, place)) for one, place in members]
        progress = held.enter_context(ProgressBar(conf.train.iterations)) if group.first else None
        stop = held.enter_context(signals.awaited(insist=group.size == 1))
        if conf.train.seeds > 1:
            for _, place in jobs:
                group.once(lambda place=place: held.enter_context(entered(place)))

        def begun(number: int) -> None:
            if group.first and number == 0:
                begin()
                for own, place in jobs:
                    save(own, place)
                signals.advice = advice(jobs)
            if not alone:
                save(*members[number])

        plans = [
            Plan(
                settings=one.settings,
                out=place,
                begin=lambda k=k: begun(k),
                sketch=no_sketch if k else Sketches(task, place, loggers[k]),
                loggers=loggers[k],
            )
            for k, (one, place) in enumerate(members)
        ]
        with contextlib.nullcontext() if alone else group.fail_together():
            results = train_side_by_side(
                task,
                model,
                plans,
                progress=progress and (lambda rows: report(progress, rows)),
                stop=stop,
                group=group if alone else Group(),
                finer=finer(conf.task) if conf.train.examine else None,
            )
        held.close()  # a signal now ends the program
        if alone and results[0].error:
            raise results[0].error
        seconds = dict(results[0].seconds)
        with clock(seconds, "draw"):
            for result, own, (_, place) in zip(results, loggers, members, strict=True):
                if conf.train.pictures and not result.error and (group.first or not alone):
                    draw(result, task, place)
                    own.pictures(result.run.iteration, [place / f"{name}.png" for name in DRAWN])
    rest = iter(results)
    found = [[next(rest) for _ in share] for share in shares]
    if alone:
        last = [farewell(results[0], task, out)] if group.first else []
    else:
        ends = [group.collect([Ending.of(result) for result in own]) for own in found]
        last = [farewell_of_seeds(own, place) for own, (_, place) in zip(ends, jobs, strict=True)]
    if group.first:
        for text in (account(seconds, time.perf_counter() - began), *last):
            logger.info("%s", text)
        signals.advice = f"The run had ended; everything is in {out if len(jobs) == 1 else out.parent}."
    return found


def advice(jobs: Sequence[tuple[RunConf, Path]]) -> str:
    """Action where a signal ends the program."""
    if len(jobs) > 1:
        return "Finished iterations are saved; the same command goes on."
    return f"Finished iterations are saved; to go on, or to draw the pictures: {plugins.resume(jobs[0][1])}"


def report(progress: ProgressBar, rows: dict[int, tuple[int, dict[str, float]]]) -> None:
    """Show the iteration and the losses of the runs."""
    progress(max(k for k, _ in rows.values()), *(row["loss"] for _, row in rows.values()))


def finer(conf: TaskConf) -> Task | None:
    """The same task on the next finer grid, None if there is none."""
    refined = conf.refined()
    return None if refined is None else make_task(refined)


def need_determinism(needed: bool) -> None:
    """Have PyTorch give the same bits in every run if needed; an operation that cannot then raises a RuntimeError that names it."""
    if needed:
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS reads it when it is first used
    torch.use_deterministic_algorithms(needed)


def make_model(task: Task, conf: RunConf, group: Group, runs: int | None = None) -> softmpm.Model:
    """The task's scene on the device of the settings, with this process's share of the worlds of one run, or all worlds of its runs."""
    device, memory = group.device(conf.device.name), conf.device.memory
    if device and device.startswith("cuda:"):
        torch.cuda.set_device(device)  # else every process takes memory of the first GPU too
    return softmpm.build(
        task.scene,
        device=device,
        dtype=getattr(torch, conf.device.dtype),
        worlds=len(group.split(conf.train.worlds)) if runs is None else runs * conf.train.worlds,
        memory_budget=None if memory is None else round(1e6 * memory),
        inputs=declared_inputs(conf.design),
        calls=task.control_steps,
        threads=conf.device.threads or THREADS,
        deterministic=conf.device.deterministic,
        **task.build,
    )
