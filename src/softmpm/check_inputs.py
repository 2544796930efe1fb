"""Rules of the inputs that a call gives, :class:`softmpm.Inputs`.

Each message names the rule, the value received and a remedy.
"""

import math
from typing import Any

import torch
from torch import Tensor

from softmpm.checks import ModelLike, check_tensor, demand, fields
from softmpm.inputs import QUANTITIES, Inputs
from softmpm.scene.check_scene import SAME, least_damping
from softmpm.validate import need


def check_inputs(model: ModelLike, inputs: Inputs | None) -> dict[str, Tensor]:
    """Inputs that are given, by name: such as the model was built for, with shapes that broadcast, its dtype and its device."""
    if inputs is None:
        return {}
    given = {name: value for name, value in fields("inputs", inputs, Inputs._fields) if value is not None}
    for name, value in given.items():
        need(
            name in (*model.spec.given, *model.defaults, "strength")
            or (name == "position" and "velocity" in model.defaults),
            f"inputs.{name} was given, but the model's kernels do not take it; build the model with inputs=({name!r},).",
        )
        dtype = torch.float64 if QUANTITIES[name].double else model.dtype
        check_tensor(model, f"inputs.{name}", value, dtype=dtype)
        axes, steps = QUANTITIES[name].axes, steps_of(name, value)
        want = model.shape_of(name, 1 if steps is None else steps)
        shape = tuple(value.shape)
        pairs = list(zip(reversed(shape), reversed(want), reversed(axes), strict=False))
        fits = all(n in (1, full) or axis in ("pose", "control_step") for n, full, axis in pairs)
        # With one axis less nobody can tell whether it is that of the rows or of the worlds:
        in_doubt = axes[0] in ("pose", "control_step") and len(shape) == len(want) - 1
        if not fits or in_doubt or len(shape) > len(want):
            full = ", ".join(
                axis if axis in ("pose", "control_step") else str(n)
                for axis, n in zip(axes, want, strict=True)
            )
            raise ValueError(
                f"inputs.{name} must broadcast to ({', '.join(axes)}) = ({full}), got shape {shape}"
                + (
                    "; give the first two axes both or neither, of size 1 where all share it."
                    if in_doubt
                    else f"; one value for each world has shape {_one_each(axes, want)}."
                )
            )
    need(
        not {"position", "velocity"} <= given.keys(),
        "inputs.position and inputs.velocity were both given; give the driven particles one of them.",
    )
    return given


def steps_of(name: str, value: Tensor) -> int | None:
    """Control steps that an input tells; None if it serves any number."""
    axes = QUANTITIES[name].axes
    if value.ndim < len(axes) or len(value) == 1 or axes[0] not in ("pose", "control_step"):
        return None
    return len(value) - (axes[0] == "pose")


def control_steps(activation: Tensor | None, given: dict[str, Tensor]) -> int:
    """Of a call: those of the activation or, without one, of the inputs, which must agree."""
    if activation is not None and not given:
        return activation.shape[0]
    told = {} if activation is None else {"activation": len(activation)}
    for name, value in given.items():
        if (steps := steps_of(name, value)) is not None:
            told[f"inputs.{name}"] = steps
    need(
        len(set(told.values())) <= 1,
        "activation and inputs must have as many control steps (poses are one more), got "
        + ", ".join(f"{steps} in {name}" for name, steps in told.items())
        + "; one row serves all of them but in activation.",
    )
    return next(iter(told.values()), 1)


def _one_each(axes: tuple[str, ...], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Shape of an input that differs between worlds and along no other axis."""
    return tuple(n if axis in ("world", "dim") else 1 for axis, n in zip(axes, shape, strict=True))


def check_inputs_bounds(model: ModelLike, given: dict[str, Tensor]) -> None:
    """All inputs are finite and within their bounds. Reads back, so that a GPU has to wait."""
    if not given:
        return
    given = {name: value.detach() for name, value in given.items()}
    for name, value in given.items():
        need(value.numel() > 0, f"inputs.{name} is empty, got shape {tuple(value.shape)}; leave it out.")
    ends = [end.double() for value in given.values() for end in torch.aminmax(value)]
    ends = torch.stack(ends).tolist()
    for (name, value), low, high in zip(given.items(), ends[::2], ends[1::2], strict=True):
        known = QUANTITIES[name]
        least, most = known.low, known.high
        if known.closed:
            least, most = math.nextafter(least, -math.inf), math.nextafter(most, math.inf)
        if not (least < low and high < most):
            demand(f"inputs.{name}", value, (value > least) & (value < most), known.rule)
    for name in {"wall_normal", "direction"} & given.keys():
        length = given[name].norm(dim=-1)
        demand(f"the length of inputs.{name}", length, length > 0, "> 0")
    if (damping := given.get("damping")) is not None:
        least = least_damping(model.scene.dt, model.dtype)
        rule = f"0 or at least {least:.3g} 1/s, for less is lost in the rounding of {model.dtype}"
        demand("inputs.damping", damping, (damping == 0) | (damping >= least), rule)
    if (normal := given.get("wall_normal")) is not None and steps_of("wall_normal", normal):
        onward = (normal[1:] * normal[:-1]).sum(dim=-1)
        rule = "> 0: a wall turns by less than 90° in a control step; give the poses between"
        demand("the product of each two successive inputs.wall_normal", onward, onward > 0, rule)
    for k in model.spec.mirrors:
        _check_stays(model, given, k)


def _check_stays(model: ModelLike, given: dict[str, Tensor], k: int) -> None:
    """Clamps and planes of symmetry stay where the scene has them: wall ``k`` is one."""
    wall = model.scene.walls[k]

    def of_wall(name: str, axes: int, otherwise: Any) -> Tensor:
        """Its part of an input with so many axes from that of the walls on."""
        value = given.get(name)
        if value is None:
            return torch.tensor(otherwise, dtype=torch.float64)
        value = value.double().cpu()[(None,) * (axes - value.ndim)]
        value = value.expand(*value.shape[:-1], model.dim) if axes == 2 else value
        return value.select(-axes, k if value.shape[-axes] > 1 else 0)

    normal, velocity = of_wall("wall_normal", 2, wall.normal), of_wall("wall_velocity", 2, 0.0)
    length = normal.norm(dim=-1)
    offset = of_wall("wall_offset", 1, wall.offset) / (length if "wall_offset" in given else 1.0)
    turned = (normal / length[..., None] - torch.tensor(wall.normal, dtype=torch.float64)).abs().max()
    moved = (offset - wall.offset).abs().max()
    for name, apart, limit in (
        ("wall_normal", turned, SAME),
        ("wall_offset", moved, SAME * model.scene.grid.spacing),
        ("wall_velocity", velocity.abs().max(), 0.0),
    ):
        need(
            name not in given or bool(apart <= limit),
            f"inputs.{name} must leave wall {k} where the scene has it, because it is a {wall.contact}, which stays where its body "
            f"began; it differs by {apart:.3g}. Give that wall the scene's values, and move the end of a body by Scene.driven.",
        )
