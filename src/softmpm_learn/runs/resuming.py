"""Folders of runs: entered by one run at a time, which goes on where the checkpoint in it ends."""

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

from softmpm_learn.learning.replay import ReplayError
from softmpm_learn.optimizers import moments
from softmpm_learn.runs.identity import SettingsError
from softmpm_learn.runs.run import Run
from softmpm_learn.storage import checkpoint, files

logger = logging.getLogger("softmpm_learn")


@contextlib.contextmanager
def entered(out: Path) -> Iterator[None]:
    """The folder is there, has no links in it, and no other run writes to it."""
    with files.named("make the folder", out):
        out.mkdir(parents=True, exist_ok=True)
    files.check_folder(out)
    with checkpoint.locked(out):
        yield


def resume(run: Run, out: Path) -> dict:
    """Go on where the checkpoint ends, if there is one; the replay buffer is for the first process. Gives what the checkpoint knows of
    the other files.
    """
    group = run.group
    content = group.broadcast(group.once(lambda: checkpoint.load(out) if checkpoint.exists(out) else None))
    if content is None:
        return {}
    with group.fail_together():
        seals = restore(run, content, out)
    logger.info("Going on with the run in %s, of which %d iterations are done.", out, run.iteration)
    return seals


def restore(run: Run, content: dict, out: Path) -> dict:
    """Set a run to the checkpoint of a folder; gives what the checkpoint knows of the other files.

    Raises:
        SettingsError: It was made with other settings.
        CheckpointError: It does not hold this run.
    """
    try:
        if content["learner"] and not run.group.first:
            content["learner"]["replay"] = {}
        run.load_state_dict(content)
        _check_loaded(run)
        return dict(content["seals"])
    except SettingsError as error:
        raise SettingsError(f"the checkpoint in {out} was {error}") from error
    except ReplayError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, RuntimeError) as error:
        text = " ".join(str(error).split())
        raise checkpoint.CheckpointError(
            f"the checkpoint in {out} does not hold this run: {text}."
        ) from error


def _check_loaded(run: Run) -> None:
    """Raise ValueError for what PyTorch does not compare when it loads: shapes of what belongs to a parameter, and iterations."""
    parameters = run.parameters
    of = [(p.shape, moment.shape) for p in parameters for moment in moments(run.optimizer, p)]
    of += [(p.shape, safe.shape) for p, safe in zip(parameters, run.safe, strict=bool(run.safe))]
    for want, got in of:
        if want != got:
            raise ValueError(f"something of shape {tuple(got)} belongs to a parameter of shape {tuple(want)}")
    done, best = run.iteration, run.best["iteration"]
    if not (isinstance(done, int) and done >= 0 and best < done):
        raise ValueError(f"the iteration is {done!r}, that of the best loss {best!r}")
