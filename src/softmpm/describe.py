"""A model in words: what was compiled for its scene, what was left out, and the memory of a call."""

import textwrap

from softmpm.checks import check_whole
from softmpm.inputs import groups
from softmpm.planning.chunks import Horizon
from softmpm.planning.memory import memory
from softmpm.scene.scene import CONTACTS
from softmpm.stability import stable_dt

RIGID = 0.2
"""Way of a pressure wave in a substep below which surface points of a curved body in 3D share its load unevenly [cells]: at half of the
stable step of an elastic one with ν = 0.3 the way is 0.37 (docs/accuracy.md)."""
NO_BREAK = "\N{NO-BREAK SPACE}"


def describe(model, substeps: int) -> str:
    """See :meth:`softmpm.Model.describe`."""
    spec, limit = model.spec, stable_dt(model.scene)
    check_whole("substeps", substeps)

    def has(flag: bool) -> str:
        return "compiled" if flag else "left out"

    muscles = f"{model.muscle_count}, at most {spec.muscle_slots} on one particle{_names(model)}"
    counts = {kind: spec.contacts.count(kind) for kind in CONTACTS if kind in spec.contacts}
    contacts = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    lines = [
        f"softmpm model: {spec.dim}D, {spec.dtype}, on {model.device}, {model.worlds} world(s) of "
        f"{model.particle_count} particles on {' x '.join(map(str, model.scene.grid.shape))} nodes",
        f"  laws       {', '.join(spec.laws)}{'' if len(spec.laws) > 1 else '; others left out'}",
        f"  muscles    {muscles if spec.muscle_slots else 'left out'}",
        f"  driven     {_driven(model)}",
        f"  walls      {contacts or 'left out'}",
        f"  contact    {_contact(model)}",
        f"  friction   {has(spec.friction)}",
        f"  gravity    {has(spec.gravity)}",
        f"  damping    {has(spec.damping)}",
        f"  viscosity  {has(spec.viscosity)}",
        f"  inputs     {', '.join(spec.given) or 'none'} read from memory, for each world",
        f"  gradients  of the start always; of {', '.join(groups(spec))} only in a backward pass that asks for them",
        f"  alarms     {_alarms(model)}",
        f"  dt         {model.scene.dt:.3g} s, stable up to {limit.dt:.3g} s; set by {limit.limit}",
        f"  form       {model.formulation} formulation: {model.formulation_reason}",
        f"  scheme     {model.scheme}: {model.scheme_reason}; {model.held_nodes} nodes of each world in memory",
        f"  sums       {_sums(model)}",
        f"  memory     {_memory(model, substeps)}",
    ]
    return "\n".join(lines)


def _names(model) -> str:
    """Labels of the actuators in their order, on lines of their own; none if no actuator has a name."""
    if not any(actuator.name for actuator in model.scene.muscles):
        return ""
    text = "; ".join(name.replace(" ", NO_BREAK) for name in model.scene.muscle_names)
    return "\n" + textwrap.indent(textwrap.fill(text, 120), 13 * " ").replace(NO_BREAK, " ")


def _driven(model) -> str:
    if not model.driven_count:
        return "left out"
    nodes = "" if model.driven_grid is None else f", which hold {model.driven_grid.count} nodes"
    return f"{model.driven_count} particles{nodes}"


def _contact(model) -> str:
    text = "at nodes"
    if model.surface is not None:
        text = f"{model.surface.count} surface points with separating walls, nodes with others"
        way = (model.surface.waves.min() * model.scene.dt / model.scene.grid.spacing).item()
        if model.dim == 3 and way < RIGID:
            text += f"; a pressure wave passes {way:.2g} cells in a substep"
            text += ": points of curved bodies share loads unevenly, see docs/accuracy.md"
    held = "" if model.mirror is None else f"; {model.mirror.count} groups of nodes held or reflected"
    return text + held


def _memory(model, substeps: int) -> str:
    try:
        found = memory(model, Horizon(1, substeps))
    except ValueError as error:
        return str(error)
    forward, kept, backward = (f"{size / 2**20:.1f} MiB" for size in found[:3])
    often = "once" if found.runs == 1 else f"{found.runs:.3g} times"
    steps = f"{model.calls} calls of {substeps} substeps" if model.calls > 1 else f"{substeps} substeps"
    return f"{forward} to run; {steps} with gradient: {kept} kept, {backward} at the peak, each runs forward {often}"


def _alarms(model) -> str:
    alarms = model.alarms
    texts = {
        "det F below": alarms.collapse,
        "neighbours at rest farther apart than, in cells,": alarms.gap,
        "dt over its running limit above": alarms.step,
        "points deeper in walls than, in ways of a pressure wave in a substep,": alarms.depth,
        "another particle within, in sizes of a particle,": alarms.overlap,
    }
    return "; ".join(f"{what} {limit:g}" for what, limit in texts.items() if limit is not None) or "off"


def _sums(model) -> str:
    if model.formulation == "reference":
        return "in floating point, in a fixed order: the same bits from run to run"
    if model.spec.deterministic:
        return "in fixed point: deterministic, the same bits from run to run"
    if model.device.type == "cpu":
        return "in floating point, in one order: the same bits from run to run"
    if model.deterministic:
        return "in the order of the particles: deterministic, the same bits from run to run"
    return "in floating point, in any order: the last bits vary; deterministic=True makes them repeat"
