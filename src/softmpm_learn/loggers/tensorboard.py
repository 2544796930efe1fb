"""TensorBoard: event files in the folder ``tensorboard`` of a run; ``tensorboard --logdir outputs`` shows those of all runs."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softmpm_learn import register

FOLDER = "tensorboard"


class TensorBoard:
    """Writes event files, in single precision as is their format; each row is handed to the system before :meth:`scalars` returns.

    Args:
        out: Folder of the run.
        first: TensorBoard drops what it has from this iteration on: of a run that was killed after it had written a row and before
            the checkpoint.
    """

    def __init__(self, out: Path, first: int):
        try:
            import tensorboard  # noqa: F401  the next import needs it, and says less about it
            from torch.utils.tensorboard.writer import SummaryWriter
        except ImportError as error:
            raise ImportError(
                f'train.log=[tensorboard] needs a package: pip install "softmpm[tensorboard]". {error}'
            ) from error
        _await_later_name(out / FOLDER)
        self._writer = SummaryWriter(str(out / FOLDER), purge_step=first)
        self._writer.flush()

    def scalars(self, iteration: int, row: Mapping[str, float]) -> None:
        for name, value in row.items():
            self._writer.add_scalar(name, value, iteration)
        self._writer.flush()

    def picture(self, iteration: int, name: str, path: Path) -> None:
        import numpy as np
        from PIL import Image

        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"))
        self._writer.add_image(f"pictures/{name}", pixels, iteration, dataformats="HWC")
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()


def _await_later_name(folder: Path) -> None:
    """Sleep until the name of a new event file sorts after those in the folder, at most 1 s: TensorBoard reads files in the order of
    their names, which have the second of their creation, then a number without leading zeros.
    """
    seconds = [int(path.name.split(".")[3]) for path in folder.glob("events.out.tfevents.*")]
    time.sleep(min(1.0, max(0.0, max(seconds, default=0) + 1 - time.time())))


@register.logger("tensorboard")
def tensorboard(out: Path, first: int, settings: Mapping[str, Any]) -> TensorBoard:
    """Scalars and pictures in event files."""
    return TensorBoard(out, first)
