"""Run a plan and judge the outcome: a result that is finite and right, or a refusal that names the fault."""

import dataclasses
import math
import re
import warnings

import torch

import softmpm
from fuzzing.calls import Call, call_of, spoil, with_fault_in_scene
from fuzzing.scenes import SPECIALS, Plan, scene_of
from fuzzing.verdict import Verdict
from fuzzing.warp_way import stepped

NAMED = re.compile(
    r"state|params|activation|substep|model|grid|bod(y|ies)|particle|wall|muscle|gravity|damping|\bdt\b|spacing|volume|density|"
    r"young|poisson|friction|radius|box|shape|worlds|solid|tape|positions|strength|lower|upper|center"
)


ALARMS = {"all": None, "none": softmpm.Alarms(collapse=None, gap=None, step=None)}


def judge(plan: Plan) -> Verdict:
    """Verdict of a plan; whatever is not an error of softmpm's documented kinds counts against it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            verdict = perform(plan)
        except softmpm.UnstableError as error:
            clear = {"world", "particle"} <= set(re.findall(r"\w+", str(error))) and bool(error.limit)
            verdict = Verdict("named" if clear else "unclear", f"{error.kind}: {error}")
        except (ValueError, TypeError, MemoryError, torch.OutOfMemoryError) as error:
            verdict = Verdict("refused" if NAMED.search(str(error)) else "unclear", _about(error))
        except dataclasses.FrozenInstanceError as error:
            verdict = Verdict("refused", _about(error))
        except (ArithmeticError, AttributeError, AssertionError, LookupError, RuntimeError, OSError) as error:
            verdict = Verdict("unclear", _about(error))
    other = [w for w in caught if not issubclass(w.category, softmpm.StabilityWarning)]
    if other and verdict.good:
        return Verdict("warned", f"{other[0].category.__name__}: {other[0].message}")
    return verdict


def _about(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def model_of(plan: Plan, worlds: int) -> softmpm.Model:
    special = SPECIALS[plan["scene"]["special"]]
    return softmpm.build(
        scene_of(with_fault_in_scene(plan["scene"], plan["fault"])),
        device="cpu",
        dtype=special.dtype,
        scheme=special.scheme,
        worlds=worlds,
        alarms=ALARMS[plan["call"]["alarms"]],
    )


def perform(plan: Plan) -> Verdict:
    """Build, call, and look at what came back."""
    if plan["way"] == "step":
        return stepped(plan)
    model = model_of(plan, plan["call"]["worlds"])
    call = call_of(plan, model)
    names = spoil(call, plan["fault"])
    try:
        verdict = {"simulate": simulated, "rasterize": rasterized}[plan["way"]](plan, call)
    except (ValueError, TypeError) as error:
        if names and not any(name in str(error) for name in names):
            return Verdict("unclear", f"{plan['fault']}: {_about(error)}")
        raise
    if names and verdict.good and _enters(plan):
        return Verdict("silent", f"took {plan['fault']}")
    return verdict


def _enters(plan: Plan) -> bool:
    """True if the faulty value is an argument of the call."""
    return plan["way"] == "simulate" or plan["fault"][1] in ("x", "v", "C", "state", "model")


def simulated(plan: Plan, call: Call) -> Verdict:
    leaves = _leaves(call)
    policy = plan["call"]["policy"]
    failures = softmpm.Failures(policy) if policy else None
    end = softmpm.simulate(
        call.model, call.state, call.activation, call.params, substeps=call.substeps, failures=failures
    )
    for name, tensor, start in zip("xvCF", end[:4], call.state[:4], strict=True):
        if tensor.shape != start.shape or tensor.dtype != start.dtype:
            return Verdict("silent", f"{name} came back as {tensor.dtype} {tuple(tensor.shape)}")
        if not bool(torch.isfinite(tensor).all()):
            return Verdict("not finite", name)
    wrong = "" if failures else _momentum(call, end)
    if wrong := wrong or _worlds(plan, call, end):
        return Verdict("silent", wrong)
    return _differentiated(end[:4], leaves)


def rasterized(plan: Plan, call: Call) -> Verdict:
    leaves = {name: leaf for name, leaf in _leaves(call).items() if name in "xvC"}
    field = softmpm.rasterize(call.model, call.state)
    mass, want = field.mass.double().sum(), call.model.mass.double().sum() * call.model.worlds
    if not all(bool(torch.isfinite(tensor).all()) for tensor in field):
        return Verdict("not finite", "grid")
    if abs(mass - want) > 1e-4 * want:
        return Verdict("silent", f"mass {mass:g} of {want:g} kg")
    return _differentiated(field, leaves)


def _leaves(call: Call) -> dict[str, torch.Tensor]:
    """Every tensor of a call that can carry a gradient, which it does from now on."""
    leaves = {}
    for record in (call.state, call.params):
        if isinstance(record, (softmpm.State, softmpm.Params)):
            leaves |= dict(zip(record._fields, record, strict=True))
    leaves["activation"] = call.activation
    leaves = {n: t for n, t in leaves.items() if isinstance(t, torch.Tensor) and t.is_floating_point()}
    for name, tensor in leaves.items():
        leaves[name] = tensor.detach().requires_grad_()
        call.put(name, lambda _, leaf=leaves[name]: leaf)
    return leaves


def _differentiated(results, leaves: dict[str, torch.Tensor]) -> Verdict:
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(t.shape, generator=generator, dtype=t.dtype) for t in results]
    loss = sum((w * t).sum() for w, t in zip(weights, results, strict=True))
    found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    for name, adj in zip(leaves, found, strict=True):
        if adj is not None and not bool(torch.isfinite(adj).all()):
            return Verdict("not finite", f"gradient of {name}")
    return Verdict("ran")


def _momentum(call: Call, end: softmpm.State) -> str:
    """The centre of mass of a body that meets no wall obeys gravity and damping."""
    scene, dtype = call.model.scene, call.model.dtype
    if scene.walls:
        return ""
    mass = (call.params.density.detach() * call.model.volume).expand(call.state.x.shape[:2]).double()
    share = (mass / mass.sum(1, keepdim=True))[..., None]
    x, v = ((share * t.detach().double()).sum(1) for t in (call.state.x, call.state.v))
    gravity, decay = torch.tensor(scene.gravity, dtype=torch.float64), math.exp(-scene.damping * scene.dt)
    steps = call.substeps * (1 if call.activation is None else len(call.activation))
    for _ in range(steps):
        v = (v + scene.dt * gravity) * decay
        x = x + scene.dt * v
    got_x, got_v = ((share * t.detach().double()).sum(1) for t in (end.x, end.v))
    dx, states = scene.grid.spacing, (call.state, end)
    fastest = max(float((s.v.abs().max() + dx * s.C.abs().max()).detach()) for s in states)
    fastest += dx / scene.dt * max(1.0, float(call.state.F.detach().abs().max()) ** 4)
    digits = steps * (1e-10 if dtype == torch.float64 else 1e-4)
    for name, got, want in (("velocity", got_v, v), ("position", got_x, x)):
        limit = digits * (
            fastest if name == "velocity" else fastest * scene.dt * steps + float(x.abs().max())
        )
        if (error := float((got - want).abs().max())) > limit:
            return f"{name} of the centre of mass is off by {error:.3g}, limit {limit:.3g}"
    return ""


def _worlds(plan: Plan, call: Call, end: softmpm.State) -> str:
    """The last world alone is the same to the last bit."""
    if call.model.worlds == 1:
        return ""

    def alone(tensor, leading):
        return tensor.detach()[leading].contiguous()

    state = softmpm.State(*(alone(t, slice(-1, None)) for t in call.state[:4]))
    params = softmpm.Params(
        *(p[-1:].detach() if p.ndim == 2 and len(p) > 1 else p.detach() for p in call.params)
    )
    activation = None if call.activation is None else alone(call.activation, (slice(None), slice(-1, None)))
    failures = softmpm.Failures(plan["call"]["policy"]) if plan["call"]["policy"] else None
    single = softmpm.simulate(
        model_of(plan, 1), state, activation, params, substeps=call.substeps, failures=failures
    )
    same = all(torch.equal(a, b[-1:].detach()) for a, b in zip(single[:4], end[:4], strict=True))
    return "" if same else "the last world alone gives other numbers"
