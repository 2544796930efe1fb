"""Identity of a run as one flat level of JSON: what a resumed run must share, or its numbers would be others."""

import dataclasses
import hashlib
from collections.abc import Iterator
from enum import Enum

import numpy as np

from softmpm import Model
from softmpm_learn.settings import Settings
from softmpm_learn.tasks.task import Task

MAY_CHANGE = (
    *("iterations", "save_every", "record_every", "frame_every"),
    *("examine", "pictures", "log", "side_by_side"),
)
"""Settings of TrainConf that a resumed run may have different. With more iterations it goes on from where it has settled."""

SOURCE = "source"
"""Path and digest of the robot's file. They may change, since the scene has the robot; if that is another, the file explains it."""

OLDER = {"optimizer.settle": 0.0}
"""Settings of checkpoints that do not name them, where these are not the defaults."""


class SettingsError(ValueError):
    """A run cannot go on with other settings than its own."""


def identity(task: Task, model: Model, settings: Settings) -> dict[str, object]:
    """Settings, task and scene by name; arrays by a short digest."""
    flat = identity_of_settings(settings)
    for field in dataclasses.fields(task):
        if field.name not in ("scene", "build", "source"):
            flat |= dict(_described(f"task.{field.name}", getattr(task, field.name)))
    flat["dtype"] = str(model.dtype)
    flat["scene"] = _digest(model)
    if task.source is not None:
        flat[SOURCE] = list(task.source)
    return flat | _formulation(model)


def identity_of_settings(settings: Settings) -> dict[str, object]:
    """The part of :func:`identity` that the settings alone decide."""
    flat: dict[str, object] = {}
    for group, values in dataclasses.asdict(settings).items():
        names = [n for n in values if not (group == "train" and n in MAY_CHANGE)]
        flat |= {f"{group}.{name}": values[name] for name in names}
    return flat


def check_same(theirs: dict, ours: dict) -> None:
    """Compare the identities of a checkpoint and of the run that would go on from it. A checkpoint older than a setting was made with
    its default, or with what :data:`OLDER` has for it.

    Raises:
        SettingsError: Task or settings are others; names each difference.
    """
    theirs, ours = identity_of_settings(Settings()) | OLDER | theirs, dict(ours)
    before, now = theirs.pop(SOURCE, None), ours.pop(SOURCE, None)
    changed = [name for name in sorted(ours.keys() | theirs.keys()) if theirs.get(name) != ours.get(name)]
    if changed and before and now and before[1] != now[1]:
        raise SettingsError(
            f"made with another robot: the file {now[0]} has changed since; restore it, or begin a new run with it."
        )
    if changed:
        both = "; ".join(f"{name}: {theirs.get(name)} then, {ours.get(name)} now" for name in changed)
        raise SettingsError(
            f"made with other settings: {both}; take those of the run, from its config.yaml or the program that began it."
        )


def _described(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, np.ndarray):
        digest = hashlib.sha256(repr((value.dtype.str, value.shape)).encode() + value.tobytes())
        yield name, digest.hexdigest()[:16]
    elif dataclasses.is_dataclass(value):
        yield name, type(value).__name__
        for field in dataclasses.fields(value):
            yield from _described(f"{name}.{field.name}", getattr(value, field.name))
    elif isinstance(value, dict):
        for key in value:
            yield from _described(f"{name}.{key}", value[key])
    elif isinstance(value, (list, tuple)):
        yield name, len(value)
        for k, item in enumerate(value):
            yield from _described(f"{name}[{k}]", item)
    elif isinstance(value, Enum) or value is None or isinstance(value, (str, bool)):
        yield name, getattr(value, "name", value)
    elif isinstance(value, (int, float, np.number)):
        yield name, value.item() if isinstance(value, np.number) else value
    else:
        raise TypeError(
            f"{name} must be made of numbers, texts, arrays and dataclasses, got {type(value).__name__}."
        )


def _formulation(model: Model) -> dict[str, object]:
    """Formulation and contact; nothing for the moving grid with contact at nodes, as in checkpoints from before there was another."""
    if model.formulation == "moving" and model.surface is None:
        return {}
    found = {"formulation": model.formulation, "contact": "nodes", "contact_width": model.contact_width}
    if model.surface is not None:
        surface = np.concatenate(
            [part.cpu().numpy().ravel() for part in (model.surface.points, model.surface.areas)]
        )
        found["contact"] = hashlib.sha256(surface.tobytes()).hexdigest()[:16]
    return found


def _digest(model: Model) -> str:
    """A short name of a scene: another one if any of its numbers is."""
    scene, digest = model.scene, hashlib.sha256()
    for tensor in (model.positions, model.volume, *model.params()):
        digest.update(tensor.cpu().numpy().tobytes())
    for muscle in scene.muscles:
        fibre = getattr(muscle, "direction", type(muscle).__name__)
        digest.update(muscle.particles.tobytes() + repr((fibre, muscle.strength)).encode())
    digest.update(repr([(len(body.particles), body.material) for body in scene.bodies]).encode())
    digest.update(np.asarray(scene.driven).tobytes())
    digest.update(repr((scene.grid, scene.walls, scene.gravity, scene.damping, scene.dt)).encode())
    return digest.hexdigest()[:16]
