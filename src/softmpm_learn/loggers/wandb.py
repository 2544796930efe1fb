"""Weights & Biases. Account, project and mode are those of its environment variables: ``WANDB_MODE=offline`` sends nothing.

A resumed run goes on under the id in ``wandb.json``. What had not been sent before a kill is sent again from the tables; what had been
sent cannot be taken back, so where a run was killed between a row and its checkpoint, the first version of the row stays.
"""

import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softmpm_learn import register
from softmpm_learn.loggers.logger import rows
from softmpm_learn.storage import files

STATE, PROJECT = "wandb.json", "softmpm"
PICTURES = ["robot", "loss", "latent"]
STEPS, ROW = 10, 5
"""Steps of Weights & Biases for an iteration, and that of its row. Steps only grow, so what belongs to an iteration has them in this
order: examination and pictures of a run that ended before it, the row, pictures after it."""
_MOST = 2**16  # bytes of the state


class Wandb:
    """A run of Weights & Biases, or one that goes on; its axis is ``iteration``.

    Args:
        out: Folder of the run.
        first: First iteration that comes; rows before it that are missing there are sent.
        settings: Its configuration.
    """

    def __init__(self, out: Path, first: int, settings: Mapping[str, Any]):
        try:
            import wandb  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise ImportError(
                f'train.log=[wandb] needs a package: pip install "softmpm[wandb]". {error}'
            ) from error
        self._image = wandb.Image
        if not (out / STATE).exists():
            files.replace(out / STATE, json.dumps({"id": secrets.token_hex(4)}).encode())
        self._run = wandb.init(
            dir=str(out),
            id=json.loads(files.read(out / STATE, _MOST))["id"],
            name=f"{settings['task']} {out.name}",
            project=os.environ.get("WANDB_PROJECT", PROJECT),
            config=dict(settings),
            allow_val_change=True,
            resume="allow",
            reinit="create_new",  # seeds side by side are runs of one process
        )
        self._run.define_metric("iteration")
        self._run.define_metric("*", step_metric="iteration")
        self._step = int(self._run.starting_step)
        missing = (self._step + STEPS - ROW - 1) // STEPS
        for k, row in rows(out, missing, first):
            self.scalars(k, row)

    def scalars(self, iteration: int, row: Mapping[str, float]) -> None:
        self._send(iteration, ROW if "loss" in row else 0, dict(row))

    def picture(self, iteration: int, name: str, path: Path) -> None:
        after = self._step > STEPS * iteration + ROW
        place = 1 + PICTURES.index(name)
        self._send(iteration, place + ROW * after, {f"pictures/{name}": self._image(str(path))})

    def _send(self, iteration: int, place: int, values: dict[str, Any]) -> None:
        step = STEPS * iteration + place
        if step >= self._step:
            self._run.log({"iteration": iteration, **values}, step=step, commit=True)
            self._step = step + 1

    def close(self) -> None:
        self._run.finish()


@register.logger("wandb")
def wandb(out: Path, first: int, settings: Mapping[str, Any]) -> Wandb:
    """Scalars and pictures of a run in the project softmpm, or in that of the environment variable WANDB_PROJECT."""
    return Wandb(out, first, settings)
