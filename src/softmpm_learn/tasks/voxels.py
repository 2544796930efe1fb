"""A flat robot from an array of voxels, as Evolution Gym has them (Bhatia et al. 2021)."""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softmpm_learn.setting_checks import positive
from softmpm_learn.tasks.drawing import Part, drawn
from softmpm_learn.tasks.own import OwnConf
from softmpm_learn.tasks.task import Task

EMPTY, RIGID, SOFT, HORIZONTAL, VERTICAL = range(5)
ACTUATORS = {HORIZONTAL: ("horizontal", (1.0, 0.0)), VERTICAL: ("vertical", (0.0, 1.0))}
"""Word and fibre direction of each kind of actuator."""
MOST = 100
"""Most voxels along an axis."""


@dataclass(kw_only=True)
class VoxelsConf(OwnConf):
    """A walker made of voxels: 0 empty, 1 rigid, 2 soft, 3 horizontal and 4 vertical actuator; each actuator is a muscle."""

    name: str = "voxels"
    strength: float = 1.2e4
    """Stress of an actuator at full activation [Pa]: voxels are as high as wide, and with half of it many such robots stand still
    (docs/results.md)."""
    stiffness: float = 10.0
    """Young's modulus of rigid voxels in units of task.young. Our choice: the step shrinks with its root."""

    def __post_init__(self):
        super().__post_init__()
        positive("task", self, "stiffness")


def voxels(conf: VoxelsConf) -> Task:
    """Build the walker of an array (row, column), the top row first, in a .npy or .json file.

    Raises:
        ValueError: The file cannot be read, or holds something else.
    """
    array = _read(conf.path("an array of voxels, .npy or .json"))
    parts = [
        Part("rigid", array == RIGID, stiffness=conf.stiffness),
        Part("soft", array == SOFT),
    ]
    for row, column in np.argwhere(array >= HORIZONTAL):
        mask = np.zeros(array.shape, dtype=bool)
        mask[row, column] = True
        word, direction = ACTUATORS[int(array[row, column])]
        label = f"{word} actuator [{row}, {column}]"
        parts.append(Part(f"voxel_{row}_{column}", mask, True, direction, label=label))
    return drawn(conf, parts)


def _read(path: Path) -> np.ndarray:
    if path.suffix == ".json":
        try:
            array = np.array(json.loads(path.read_text()))
        except ValueError as error:
            raise ValueError(f"{path} cannot be read as lists of numbers: {error}") from error
    else:
        try:
            with path.open("rb") as file:
                array = np.load(file, allow_pickle=False)
        except (
            ValueError,
            EOFError,
            zipfile.BadZipFile,
        ) as error:  # NumPy's message recommends to unpickle the file
            raise ValueError(
                f"{path} must be an array of numbers in a .npy file, as numpy.save writes it, or lists in a .json file; "
                "task=image reads pictures."
            ) from error
    if not isinstance(array, np.ndarray) or array.ndim != 2 or array.dtype.kind not in "iuf":
        raise ValueError(f"{path} must hold an array of numbers of shape (row, column).")
    if max(array.shape) > MOST:
        raise ValueError(f"{path} must have at most {MOST} voxels along an axis, got {array.shape}.")
    wrong = array[~np.isin(array, range(5))]
    if len(wrong):
        count = "1 voxel" if len(wrong) == 1 else f"{len(wrong)} voxels"
        raise ValueError(
            f"{path} has {count} other than 0 empty, 1 rigid, 2 soft, 3 horizontal and 4 vertical actuator; "
            f"the first is {wrong[0]}."
        )
    return array.astype(int)
