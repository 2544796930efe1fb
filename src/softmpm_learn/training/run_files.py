"""Files that a run writes while it trains: metrics.csv and timing.csv, recording, checkpoint and replay buffer."""

import contextlib
import dataclasses
import itertools
import logging
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType

import numpy as np
import torch
from torch import Tensor

import softmpm
from softmpm_learn.episode import Frame
from softmpm_learn.loggers import Loggers
from softmpm_learn.runs.loops import OnFrames
from softmpm_learn.runs.run import Run
from softmpm_learn.runs.runs import Runs
from softmpm_learn.storage import checkpoint
from softmpm_learn.storage.csv_log import Table, kept
from softmpm_learn.storage.sweep import EXAMINED
from softmpm_learn.training.timing import TIMING, clock

logger = logging.getLogger("softmpm_learn")
OF_SWEEPS = "run", "sweep", "job", "seed", "status", "quantity", "term", "folder", "error"
"""Columns of the tables of :mod:`softmpm_learn.figures` beside those of metrics.csv."""


def metrics(run: Run) -> list[str]:
    """Columns of metrics.csv; nothing in it depends on the clock.

    Raises:
        ValueError: A term of the objective has the name of another column.
    """
    terms, others = run.task.objective.names, ["evaluation", "lasts", "best", "activation"]
    others += ["gradient_policy", "gradient_design", "clipped", "retries", "fallbacks", "restarts"]
    others += [f"{name}_change" for name in run.design.change()]
    others += ["epochs", "training_loss", "validation_loss", "replay", *EXAMINED]
    taken = [name for name in terms if name in ("iteration", "loss", *others, *OF_SWEEPS)]
    if taken:
        raise ValueError(
            f"the objective has a term {taken[0]!r}, but metrics.csv or a table of sweeps has another column of that name; give the "
            "class of the term another name."
        )
    return ["loss", *terms, *others]


class RunFiles:
    """Goes on where the run is, and begins with a checkpoint of a new one. Of several processes the first keeps it; it shows
    the first of its worlds. Use as a context manager.

    Args:
        run: The run, as it is after its checkpoint was loaded.
        out: Its folder.
        seals: What the checkpoint knows of the other files, see :attr:`seals`; empty for a new run.
        begin: Called once they are found to be those of the run, before the first checkpoint.
        loggers: Loggers of the run, still to be opened; who made them closes them.

    Attributes:
        frames: Time, positions and activation of the first world in the episode that was recorded last, until they are taken.

    Raises:
        ValueError: A file is not the one that the checkpoint knows.
    """

    def __init__(
        self,
        run: Run,
        out: Path,
        seals: dict,
        begin: Callable[[], None] = lambda: None,
        loggers: Loggers | None = None,
    ):
        self.run, self.out, self._loggers = run, out, loggers or Loggers([], out)
        self._named = run.learner.replay.ids if run.learner else []
        tables = {"metrics.csv": metrics(run), "timing.csv": TIMING}
        # What is refused comes before anything is cut back to the checkpoint:
        for name, columns in tables.items():
            kept(out / name, columns, seals.get(name))
        settings = {"task": run.task.name} | dataclasses.asdict(run.settings)
        self._loggers.open(run.iteration, seals.get("loggers", {}), settings)
        self._recorded = seals.get("run.h5")
        self._recorder = self._open_recorder() if run.settings.train.record_every else None
        self._seal_recording(run.iteration)
        self._saved = self._stage if seals else None
        self.frames: list[tuple[float, Tensor, Tensor | None]] = []
        try:
            self._metrics, self._timing = (
                Table(out / name, columns, seals.get(name)) for name, columns in tables.items()
            )
        except BaseException:
            self.__exit__(None, None, None)
            raise
        begin()
        if run.iteration == 0:
            self.save()
        elif (
            run.learner is not None
        ):  # the run may have been killed before it dropped what it no longer needs
            run.learner.replay.prune(checkpoint.simulations(out))

    def _open_recorder(self) -> softmpm.Recorder:
        """Go on with the recording, if it is the one that the checkpoint knows; begin one where there is none."""
        path, known = self.out / "run.h5", self._recorded
        if known is not None and not path.exists():
            logger.warning("%s is missing; what was recorded up to here is lost, and a new one begins.", path)
            known = None
        before, digest = (known["before"], known["sha256"]) if known else (0, None)
        try:
            return softmpm.Recorder(path, self.run.model, resume_before=before, resume_digest=digest)
        except (OSError, ValueError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise  # no room on the disk
            raise ValueError(
                f"{str(error).rstrip('.')}. Move {path} away to go on without what was recorded, or put the right file there."
            ) from error

    def _seal_recording(self, iteration: int) -> None:
        """Seal the recording as it is before an iteration; an episode of it may fail and be recorded again."""
        if self._recorder:
            self._recorded = {"before": iteration, "sha256": self._recorder.digest}

    @property
    def seals(self) -> dict:
        """Seals of the other files of the run, for the checkpoint."""
        return {
            "metrics.csv": self._metrics.seal,
            "timing.csv": self._timing.seal,
            "run.h5": self._recorded,
            "loggers": self._loggers.known(self.run.iteration),
        }

    def add(self, iteration: int, row: dict[str, float], seconds: dict[str, float]) -> None:
        """End an iteration: a row of either table, for :meth:`flush`, and the figures to the recording and the loggers."""
        times = {name: seconds[name] for name in TIMING}
        self._timing.append(iteration, times)
        self.add_figures(iteration, row, times)
        self._seal_recording(iteration + 1)

    def add_figures(
        self, iteration: int, row: dict[str, float], seconds: dict[str, float] | None = None
    ) -> None:
        """A row of metrics.csv alone, and its figures to the recording and, with times [s], to the loggers."""
        self._metrics.append(iteration, row)
        if self._recorder:
            known = {name: value for name, value in row.items() if math.isfinite(value)}
            self._recorder.scalars(iteration, known)
        self._loggers.scalars(iteration, row, seconds)

    def flush(self) -> None:
        """Force the rows of both tables to the disk."""
        self._timing.flush()
        self._metrics.flush()

    @property
    def is_saved(self) -> bool:
        """True if the checkpoint is that of the iterations done, and of the end if there was one."""
        return self._saved == self._stage

    @property
    def _stage(self) -> tuple:
        return self.run.iteration, self.run.end

    @property
    def is_due(self) -> bool:
        """True if a checkpoint is due now: every so many iterations and after the last."""
        conf, done = self.run.settings.train, self.run.iteration
        return not self.is_saved and (done % conf.save_every == 0 or done >= conf.iterations)

    def save(self) -> None:
        """Write the rows and a checkpoint, then drop the simulations that neither it nor the one before names."""
        self.flush()
        checkpoint.save(self.out, self.run.state_dict() | {"seals": self.seals})
        if self.run.learner is not None:
            ids = self.run.learner.replay.ids
            self.run.learner.replay.prune(self._named + ids)
            self._named = ids
        self._saved = self._stage

    @property
    def records(self) -> bool:
        """True if there is a recording."""
        return self._recorder is not None

    def due(self, iteration: int) -> bool:
        """True if the episode of this iteration is recorded."""
        conf = self.run.settings.train
        return bool(conf.record_every) and (
            iteration % conf.record_every == 0 or iteration == conf.iterations - 1
        )

    def together(self) -> contextlib.AbstractContextManager[None]:
        """Frames recorded inside count together, see :meth:`softmpm.Recorder.together`."""
        assert self._recorder is not None
        return self._recorder.together()

    @contextlib.contextmanager
    def episode(self, world: int, **about) -> Iterator[Callable[..., None]]:
        """Record an episode of this world: gives what to call at each frame, with grid velocity and contact forces. The last frame,
        which has no activation, is recorded in any case."""
        assert self._recorder is not None
        self.frames.clear()
        every, number = self.run.settings.train.frame_every, itertools.count()
        with self._recorder.episode(self.run.iteration, task=self.run.task.name, **about) as episode:

            def keep(frame: Frame, velocity: Tensor, forces: softmpm.ContactForces | None) -> None:
                features = frame.features[:, : self.run.observer.size]  # beside it may be a run with more
                seen = frame.state, frame.activation, velocity, features, forces
                if next(number) % every == 0 or frame.activation is None:
                    episode.frame(frame.time, *seen, world=world)
                activation = None if frame.activation is None else frame.activation[world].detach()
                self.frames.append((frame.time, frame.state.x[world].detach(), activation))

            yield keep

    def take_frames(self) -> dict[str, np.ndarray]:
        """Time [s], positions [m] and activation [-] of each of these frames, by the names of a recording."""
        (time, x, activation), self.frames = zip(*self.frames, strict=True), []
        nothing = torch.full_like(next(a for a in activation if a is not None), math.nan)
        active = [nothing if a is None else a for a in activation]
        return {
            "time": np.array(time),
            "x": torch.stack(x).cpu().numpy(),
            "activation": torch.stack(active).cpu().numpy(),
        }

    def __enter__(self) -> "RunFiles":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._recorder:
            self._recorder.close()


@contextlib.contextmanager
def recorded(
    runs: Runs,
    files: Sequence[RunFiles],
    about: Sequence[dict] = (),
    seconds: dict[str, float] | None = None,
) -> Iterator[OnFrames | None]:
    """Record an episode of some runs: gives what to call with its frames, or None if nothing is recorded.

    Args:
        about: What to keep with the episode of each.
        seconds: The time that it takes is added to ``record`` [s].
    """
    seconds = {} if seconds is None else seconds
    notes = zip(files, about or [{}] * len(files), strict=True)
    recording = [(one, note) for one, note in notes if one.records]
    with contextlib.ExitStack() as open_episodes:
        keep = [
            open_episodes.enter_context(one.episode(runs.worlds(runs.all.index(one.run)).start, **note))
            for one, note in recording
        ]

        @torch.no_grad()
        def on_frames(frames: Sequence[Frame]) -> None:
            model = runs.model
            if model.device.type == "cuda":
                torch.cuda.synchronize(model.device)  # what is waited for is not the recording
            with clock(seconds, "record"), contextlib.ExitStack() as together:
                for one, _ in recording:
                    together.enter_context(one.together())
                for frame in frames:
                    state, forces = frame.state, None
                    velocity = softmpm.rasterize(model, state).velocity
                    if state.surface is not None or (model.surface is not None and state.nodes is not None):
                        forces = softmpm.contact_forces(model, state)
                    for one in keep:
                        one(frame, velocity, forces)

        yield on_frames if keep else None
