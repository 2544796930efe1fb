"""Random calls of ``step``, ``warp_state``, ``warp_solid`` and ``torch_state``, mixing what does not belong together."""

import dataclasses
from typing import Any

import torch
import warp as wp
from hypothesis import strategies as st

import softmpm
from fuzzing.calls import FAULTY_TENSORS, Call, call_of, calls
from fuzzing.scenes import SPECIALS, Plan, scene_of, scenes
from fuzzing.verdict import Verdict

_FIELDS = ("base", "fx", "v", "C", "H")
_ARRAYS = ("mass", "mu", "lam", "active_stress")
_TENSORS = ("x", "v", "C", "F", "young", "poisson", "density", "activation")
_faulty = st.one_of(
    st.tuples(
        st.just("foreign"),
        st.sampled_from(["model", "state_in", "state_out", "solid", "torch_state", "raise_failure"]),
        st.sampled_from(["fewer worlds", "more worlds", *SPECIALS]),
    ),
    st.tuples(st.just("tensor"), st.sampled_from(_TENSORS), st.sampled_from(list(FAULTY_TENSORS))),
    st.tuples(
        st.just("array"),
        st.sampled_from([*(("state_in", f) for f in _FIELDS), *(("solid", f) for f in _ARRAYS)]),
        st.sampled_from(["none", "short", "dtype", "tensor"]),
    ),
    st.tuples(
        st.just("type"),
        st.sampled_from(["model", "state_in", "state_out", "solid"]),
        st.sampled_from(["none", "text"]),
    ),
    st.tuples(st.just("gradient"), st.sampled_from(["state_in", "state_out", "solid"])),
    st.just(("same",)),
)
faults = st.booleans().flatmap(lambda legal: st.none() if legal else _faulty)
steps = st.fixed_dictionaries(
    dict(way=st.just("step"), scene=scenes, call=calls, fault=faults, tape=st.booleans())
)


@dataclasses.dataclass
class Stepping:
    """Arguments of ``softmpm.step``, right or wrong."""

    model: Any
    state_in: Any
    state_out: Any
    solid: Any


def stepped(plan: Plan) -> Verdict:
    """Steps equal ``simulate`` to the last bit; whatever does not belong together is refused."""
    fault = plan["fault"] or ["none"]
    model = _model(plan, plan["scene"]["special"], plan["call"]["worlds"])
    call = call_of(plan, model)
    if call.activation is not None:
        call.activation = call.activation[0]
    if fault[0] == "tensor":
        call = _with_faulty_tensor(call, *fault[1:])
        if call is None:
            return Verdict("ran", "no such tensor")
    given = _arguments(plan, call, fault[1] if fault[0] == "gradient" else "")
    unlike = _spoil(plan, given, fault)
    if fault[0] == "none" or (not unlike and fault[0] != "tensor"):
        return _compared(plan, call, given)
    tape = wp.Tape() if plan["tape"] or fault[0] == "gradient" else None
    softmpm.step(given.model, given.state_in, given.state_out, given.solid, tape=tape)
    return Verdict("silent", f"step took {plan['fault']}")


def _model(plan: Plan, name: str, worlds: int) -> softmpm.Model:
    scene = scene_of(plan["scene"] | {"special": name})
    return softmpm.build(scene, device="cpu", dtype=SPECIALS[name].dtype, scheme="plain", worlds=worlds)


def _arguments(plan: Plan, call: Call, without: str = "") -> Stepping:
    """Legal ones, all but ``without`` with a gradient."""

    def wants(name: str) -> bool:
        return (plan["tape"] or without != "") and name != without

    state_in = softmpm.warp_state(call.model, call.state, requires_grad=wants("state_in"))
    state_out = softmpm.warp_state(call.model, requires_grad=wants("state_out"))
    solid = softmpm.warp_solid(call.model, call.params, call.activation, requires_grad=wants("solid"))
    return Stepping(call.model, state_in, state_out, solid)


def _with_faulty_tensor(call: Call, name: str, how: str) -> Call | None:
    if name == "activation" and (call.activation is None or not call.activation.numel()):
        return None
    call.put(name, FAULTY_TENSORS[how])
    return call


def _spoil(plan: Plan, given: Stepping, fault: list) -> bool:
    """Put the fault into the arguments; whether they differ from legal ones."""
    kind, *about = fault
    if kind == "foreign":
        return _foreign(plan, given, *about)
    if kind == "array":
        (where, name), how = about
        return _array(getattr(given, where), name, how)
    if kind == "type":
        setattr(given, about[0], {"none": None, "text": "rest"}[about[1]])
    if kind == "same":
        given.state_out = given.state_in
    return kind in ("type", "same", "gradient")


def _foreign(plan: Plan, given: Stepping, where: str, whose: str) -> bool:
    """Pass an object of another model, built from the same plan, in one place."""
    worlds = given.model.worlds + {"fewer worlds": -1, "more worlds": 1}.get(whose, 0)
    special = plan["scene"]["special"] if whose not in SPECIALS else whose
    if worlds == 0 or (special == plan["scene"]["special"] and worlds == given.model.worlds):
        return False
    other = _model(plan, special, worlds)
    if where not in ("model", "solid") and _sizes(other) == _sizes(given.model):
        return False  # a state has no other relation to its model
    if where == "torch_state":
        softmpm.torch_state(other, given.state_in)
    elif where == "raise_failure":
        given.solid.raise_failure(other, given.state_in)
    elif where == "model":
        given.model = other
    elif where == "solid":
        given.solid = softmpm.warp_solid(other, requires_grad=plan["tape"])
    else:
        setattr(given, where, softmpm.warp_state(other, requires_grad=plan["tape"]))
    return True


def _sizes(model: softmpm.Model) -> tuple:
    return model.dim, model.dtype, model.worlds, model.particle_count


def _array(owner: Any, name: str, how: str) -> bool:
    """Another array in the place of one that ``warp_state`` or ``warp_solid`` made."""
    array = getattr(owner, name)
    if array is None:
        return False
    small = wp.zeros((1, 1), dtype=wp.float16 if how == "dtype" else array.dtype, device="cpu")
    if how == "dtype":
        small = wp.zeros(array.shape, dtype=wp.float16, device="cpu")
    setattr(owner, name, {"none": None, "tensor": wp.to_torch(array)}.get(how, small))
    return how in ("none", "tensor", "dtype") or array.shape != (1, 1)


def _compared(plan: Plan, call: Call, given: Stepping) -> Verdict:
    """Against ``simulate``, which raises what the steps have to raise as well."""
    count, model, tape = call.substeps, call.model, wp.Tape() if plan["tape"] else None
    states = [given.state_in, given.state_out]
    states += [softmpm.warp_state(model, requires_grad=plan["tape"]) for _ in range(count - 1)]
    for k in range(count):
        softmpm.step(model, states[k], states[k + 1], given.solid, substep=k, tape=tape)
    activation = None if call.activation is None else call.activation[None]
    leaves = [t.detach().clone().requires_grad_() for t in call.state[:4]]
    # The anchors of surface points are of their own there; a state without them has those that follow from x.
    surface = softmpm.torch_state(model, states[0]).surface
    start = softmpm.State(*leaves, surface=None if surface is None else surface.detach())
    try:
        end = softmpm.simulate(model, start, activation, call.params, substeps=count)
    except softmpm.UnstableError as error:
        if error.kind in ("torn", "step"):
            raise  # found between chunks, which steps have not
        given.solid.raise_failure(model, states[count])
        return Verdict("silent", "simulate raises, raise_failure does not")
    given.solid.raise_failure(model, states[count])
    for name, got, want in zip("xvCF", softmpm.torch_state(model, states[count])[:4], end[:4], strict=True):
        if not torch.equal(got, want.detach()):
            return Verdict("silent", f"{name} is not that of simulate")
    if tape is None:
        return Verdict("ran")
    weights = [torch.ones_like(t) for t in end[:4]]
    want = torch.autograd.grad(sum(t.sum() for t in end[:4]), leaves)
    last = states[count]
    seeds = dict(zip((last.fx, last.v, last.C, last.H), weights, strict=True))
    seeds[last.fx] = weights[0] * model.scene.grid.spacing
    tape.backward(grads={a: wp.from_torch(t.contiguous(), dtype=a.dtype) for a, t in seeds.items()})
    got = [wp.to_torch(a.grad) for a in states[0].differentiable()]
    got[0] = got[0] / model.scene.grid.spacing
    for name, one, other in zip("xvCF", got[:4], want, strict=True):
        if not bool(torch.isfinite(one).all()):
            return Verdict("not finite", f"gradient of {name}")
        digits = 1e-9 if model.dtype == torch.float64 else 1e-3
        if float((one - other).abs().max()) > digits * float(other.abs().max()):
            return Verdict("silent", f"gradient of {name} is not that of simulate")
    return Verdict("ran")
