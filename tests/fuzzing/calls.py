"""Random calls on a scene: start, material and activation, and faults of every kind that a caller can make."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st

import softmpm
from fuzzing.scenes import Plan, scenes, seeds, unit


@dataclasses.dataclass
class Call:
    """Arguments of ``softmpm.simulate``, right or wrong."""

    model: Any
    state: Any
    params: Any
    activation: Any
    substeps: Any

    def put(self, name: str, change: Callable[[Any], Any]) -> None:
        """Replace one tensor: ``x`` to ``F`` of the state, ``young`` to ``density`` of the material, or the activation."""
        if name == "activation":
            self.activation = change(self.activation)
        elif name in softmpm.Params._fields:
            self.params = self.params._replace(**{name: change(getattr(self.params, name))})
        else:
            self.state = self.state._replace(**{name: change(getattr(self.state, name))})


NAMES = ("x", "v", "C", "F", "young", "poisson", "density", "activation")
_NUMBERS = {"nan": torch.nan, "inf": torch.inf, "-inf": -torch.inf}
FAULTY_TENSORS: dict[str, Callable[[torch.Tensor], Any]] = {
    **{name: lambda t, number=number: _one(t, number) for name, number in _NUMBERS.items()},
    "dtype": lambda t: t.to(torch.float64 if t.dtype == torch.float32 else torch.float32),
    "integers": lambda t: t.long(),
    "half": lambda t: t.half(),
    "device": lambda t: t.to("meta"),
    "array": lambda t: t.detach().numpy(),
    "list": lambda t: t.tolist(),
    "nothing": lambda t: "0.5",
    "one more": lambda t: torch.cat([t, t[-1:]]) if t.ndim > 1 else t.reshape(-1).repeat(10_007),
    "one axis more": lambda t: t[None, None, None],
    "transposed": lambda t: t.transpose(0, 1)[None] if t.ndim > 1 else t[None, None, None],
    "complex": lambda t: t.to(torch.complex64),
    "sparse": lambda t: t.to_sparse(),
}
"""Values that every call must refuse for each of its tensors."""
_FAULTY_MATERIAL = {"young": (0.0, -80.0), "poisson": (0.5, -1.0, 0.7), "density": (0.0, -1.0)}
_FAULTY_SUBSTEPS = (0, -3, 2.5, True, None, "5", torch.nan)
_FAULTY_RECORDS: dict[str, Callable[[Any], Any]] = {
    "none": lambda r: None,
    "tuple": tuple,
    "dict": lambda r: {"x": r},
}
_ODD_VALUES = (1e-30, -1e20, 1e30, 3e38, 1e200, -1.0, 0.0)
"""Finite values that a call may accept: it must raise an error that names the cause, or return finite numbers."""


def _one(tensor: torch.Tensor, number: float) -> torch.Tensor:
    changed = tensor.detach().clone()
    changed.reshape(-1)[changed.numel() // 2] = (
        number if math.isnan(number) else _nearest(number, tensor.dtype)
    )
    return changed


def _nearest(number: float, dtype: torch.dtype) -> float:
    most = torch.finfo(dtype).max
    return number if math.isinf(number) else min(max(number, -most), most)


_SCENE_NUMBERS = (
    "young",
    "poisson",
    "density",
    "friction",
    "strength",
    "gravity",
    "damping",
    "dt",
    "spacing",
)
_EXTREMES = (0.0, -1.0, torch.nan, torch.inf, 1e-310, 1e-50, 1e-20, 1e20, 1e39, 1e308)
_faulty = st.one_of(
    st.tuples(st.just("scene"), st.sampled_from(_SCENE_NUMBERS), st.sampled_from(_EXTREMES)),
    st.tuples(st.just("tensor"), st.sampled_from(NAMES), st.sampled_from(list(FAULTY_TENSORS))),
    st.sampled_from(
        [("material", name, value) for name, values in _FAULTY_MATERIAL.items() for value in values]
    ),
    st.tuples(st.just("substeps"), st.sampled_from(range(len(_FAULTY_SUBSTEPS)))),
    st.tuples(
        st.just("record"),
        st.sampled_from(["state", "params", "model"]),
        st.sampled_from(list(_FAULTY_RECORDS)),
    ),
    st.tuples(st.just("odd"), st.sampled_from(NAMES), st.sampled_from(_ODD_VALUES)),
)
faults = st.booleans().flatmap(lambda legal: st.none() if legal else _faulty)
calls = st.fixed_dictionaries(
    dict(
        worlds=st.integers(1, 3),
        substeps=st.integers(1, 8),
        rows=st.sampled_from([None, 1, 3]),
        activation=st.sampled_from([0.0, 0.3, 1.0, 3.0]),
        noise=st.tuples(*4 * (st.one_of(st.just(0.0), unit),)),
        material=st.sampled_from(["scene", "scalar", "worlds", "all"]),
        layout=st.sampled_from(["contiguous", "strided", "expanded"]),
        alarms=st.sampled_from(["all", "all", "none"]),
        policy=st.sampled_from([None, None, "freeze", "reset"]),
        seed=seeds,
    )
)
simulations = st.fixed_dictionaries(
    dict(way=st.sampled_from(["simulate", "simulate", "rasterize"]), scene=scenes, call=calls, fault=faults)
)


def with_fault_in_scene(scene: Plan, fault: list | None) -> Plan:
    """The plan of a scene with the extreme number of a fault, if that is one of the scene."""
    if fault is None or fault[0] != "scene":
        return scene
    _, name, value = fault
    if name in ("young", "poisson", "density"):
        return scene | {"bodies": [body | {name: value} for body in scene["bodies"]]}
    if name == "friction":
        return scene | {"walls": [wall | {name: value} for wall in scene["walls"]]}
    if name == "strength":
        return scene | {"muscles": [muscle | {name: value} for muscle in scene["muscles"]]}
    if name == "spacing":
        value = min(value, 1e100)  # its cube is a volume
    return scene | {name: [0.0, value, 0.0] if name == "gravity" else value}


def call_of(plan: Plan, model: softmpm.Model) -> Call:
    """The legal call of a plan, from a start that is perturbed; ``noise`` is in units of the grid and of the stable step."""
    call = plan["call"]
    random = np.random.default_rng(call["seed"])

    def noise(tensor, size):
        return torch.as_tensor(size * random.uniform(-1, 1, tensor.shape), dtype=model.dtype)

    dx, dt = model.scene.grid.spacing, model.scene.dt
    sizes = (0.1 * dx, 0.1 * dx / dt, 0.1 / dt, 0.5)
    rest = model.rest()
    state = softmpm.State(
        *(t + noise(t, n * s) for t, n, s in zip(rest[:4], call["noise"], sizes, strict=True))
    )
    shape = {
        "scene": None,
        "scalar": (),
        "worlds": (model.worlds, 1),
        "all": (model.worlds, model.particle_count),
    }
    params, lead = model.params(), shape[call["material"]]
    if lead is not None:
        params = softmpm.Params(*(p[0].expand(lead).clone() for p in params))
    activation = None
    if call["rows"]:
        activation = noise(torch.empty(call["rows"], model.worlds, model.muscle_count), call["activation"])
    layout = _LAYOUTS[call["layout"]]
    return Call(model, softmpm.State(*map(layout, state[:4])), params, activation, call["substeps"])


_LAYOUTS: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "contiguous": lambda t: t,
    "strided": lambda t: torch.stack([t, t], -1)[..., 0],
    "expanded": lambda t: t[:1].expand_as(t),  # every world starts alike, in the same memory
}


def spoil(call: Call, fault: list | None) -> tuple[str, ...] | None:
    """Put the fault of a plan into a call. Names that the error must give; nothing if the call may also run, None without fault."""
    if fault is None or fault[0] == "scene":
        return None
    kind, *about = fault
    if kind == "substeps":
        call.substeps = _FAULTY_SUBSTEPS[about[0]]
        return ("substeps",)
    name, how = about
    if kind == "record":
        setattr(call, name, _FAULTY_RECORDS[how](getattr(call, name)) if name != "model" else how)
        return (name,)
    if name == "activation" and (call.activation is None or not call.activation.numel()):
        return None
    change = {"tensor": FAULTY_TENSORS, "material": {}}.get(kind, {}).get(how) or (lambda t: _one(t, how))
    call.put(name, change)
    return () if kind == "odd" else (name,)
