"""``build``: a scene checked, a scheme chosen, and the model of both."""

import warnings
from collections.abc import Iterable

import numpy as np
import torch

from softmpm.alarms import Alarms
from softmpm.checks import check_whole
from softmpm.choices import (
    check_given,
    check_moving,
    check_reference,
    choose_formulation,
    choose_scheme,
    in_fixed_point,
    on_surface,
    relevant,
)
from softmpm.devices import device_of
from softmpm.model import Model
from softmpm.scene.check_scene import check_precision, check_scene
from softmpm.scene.scene import Scene
from softmpm.schemes.registry import SCHEMES
from softmpm.stability import need_stable

APART = 1.4
"""Cells between particles beyond which they share too few nodes: at 4/3 a body that was stretched springs back, at 3/2 it does not."""


class StabilityWarning(UserWarning):
    """The particles of a body are so far apart that numerical fracture occurs."""


def build(
    scene: Scene,
    device: str | torch.device | None = None,
    dtype: torch.dtype = torch.float32,
    worlds: int = 1,
    memory_budget: int | None = None,
    scheme: str = "auto",
    formulation: str = "moving",
    contact: str = "auto",
    contact_width: float = 0.0,
    inputs: Iterable[str] = (),
    deterministic: bool = False,
    calls: int = 1,
    threads: int | None = None,
    alarms: Alarms | None = None,
) -> Model:
    """Compile a scene into a model.

    Args:
        scene: The scene to simulate.
        device: Device of the simulation; None selects CUDA if there is one, and logs the choice.
        dtype: ``torch.float32`` or ``torch.float64``.
        worlds: Number of independent copies of the scene that run in one launch.
        memory_budget: Upper bound of the states that ``simulate`` may retain for a backward pass, or recompute at a time [bytes].
            None takes a share of the device's memory; ``describe`` estimates the whole of a call. See docs/memory.md.
        scheme: "fast", "plain", or "auto": fast in float32 wherever it can hold the scene. Both do the same; see
            docs/performance.md.
        formulation: "moving": material point method, whose grid is reset in each substep. "reference": total Lagrangian, with weights
            taken once at rest; see docs/formulations.md. "auto": the reference formulation if the scene states ``body_contact=False``
            and ``scheme`` is left at "auto"; ``describe`` gives the reason.
        contact: Part of the bodies that meets the separating walls: "nodes", "surface" (the points of the outlines,
            :class:`softmpm.Outline`), or "auto": the surface if every body has an outline and a wall separates.
        contact_width: Distance over which surface contact sets in [cells], in [0, 1): 0 to evaluate, 0.01 to learn, so that gradients
            are smooth. Only with contact at the surface.
        inputs: Names of fields of :class:`softmpm.Inputs` that calls will give, such as ("friction", "gravity"): the kernels then read
            them from memory, for each world. Others are compiled as the scene has them, or left out.
        deterministic: The same bits from run to run, results and gradients, on one kind of GPU; slower, and in the plain scheme
            and ``step`` much slower: float32 and the fast scheme are best. The CPU adds in one order anyway. With contact at the
            surface the moving formulation takes the plain scheme on a CPU and raises on a GPU; the reference formulation does not. See
            docs/conventions.md.
        calls: Number of calls of ``simulate`` in one backward pass, the control steps of a closed loop, which share the budget. More
            calls than stated exceed it. With eight or more, the first iterations of small scenes on a GPU are faster.
        threads: CPU threads that share a simulation; None takes those of PyTorch (``torch.get_num_threads()``) at each call. Results
            have the same bits with any number of them. It has no effect on a GPU, nor in the plain scheme, which has one.
        alarms: Limits beyond which a simulation is stopped by name; None takes those of :class:`softmpm.Alarms`.

    Returns:
        The model: immutable, shared by any number of simulations.

    Raises:
        TypeError: ``scene`` is no :class:`softmpm.Scene`, or an argument has another type than stated.
        ValueError: The scene or an argument breaks a rule, or dt is above :func:`softmpm.stable_dt`; the message names the rule, the
            value received and a remedy.
        RuntimeError: There is no such device.

    Warns:
        StabilityWarning: The particles of a body are so far apart that numerical fracture occurs.
    """
    check_scene(scene)
    _check_settings(dtype, scheme, deterministic, contact_width)
    for name, count in {
        "worlds": worlds,
        "calls": calls,
        "threads": 1 if threads is None else threads,
    }.items():
        check_whole(name, count)
    alarms = Alarms() if alarms is None else alarms
    if not isinstance(alarms, Alarms):
        raise TypeError(f"alarms must be a softmpm.Alarms or None, got {type(alarms).__name__}.")
    given, place = check_given(scene, inputs), device_of(device)
    check_precision(scene, dtype)
    if alarms.step is not None:
        need_stable(scene, alarms.step)
    _warn_sparse(scene)
    formulation, why = choose_formulation(scene, scheme, formulation)
    surface = on_surface(scene, formulation, contact, contact_width)
    if formulation == "reference":
        check_reference(scheme)
        scheme, reason = "lagrangian", "formulation='reference'"
    else:
        check_moving(scene, surface, place, deterministic)
        scheme, reason = choose_scheme(scene, dtype, int(worlds), scheme, surface and bool(deterministic))
    with torch.inference_mode(False):  # else the model could not take part in a gradient later
        return Model(
            scene,
            place,
            dtype,
            scheme,
            reason,
            SCHEMES[scheme].footprint,
            relevant(alarms, formulation, surface),
            formulation=formulation,
            formulation_reason=why,
            surface=surface,
            contact_width=float(contact_width),
            given=given,
            deterministic=bool(deterministic),
            fixed_point=bool(deterministic) and in_fixed_point(place, dtype, scheme),
            worlds=int(worlds),
            memory_budget=_whole_bytes(memory_budget),
            calls=int(calls),
            threads=None if threads is None else int(threads),
        )


def _check_settings(dtype: torch.dtype, scheme: str, deterministic: bool, contact_width: float) -> None:
    """Raise TypeError or ValueError for a setting that no scene could have."""
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype!r}.")
    if scheme not in ("auto", "fast", "plain"):
        raise ValueError(f"scheme must be 'auto', 'fast' or 'plain', got {scheme!r}.")
    if not isinstance(deterministic, (bool, np.bool_)):
        raise TypeError(f"deterministic must be True or False, got {deterministic!r}.")
    if not 0.0 <= contact_width < 1.0:
        raise ValueError(f"contact_width must be in [0, 1) cells, got {contact_width!r}.")


def _warn_sparse(scene: Scene) -> None:
    """Warn of bodies whose particles are so far apart that numerical fracture occurs."""
    for b, body in enumerate(scene.bodies):
        apart = body.particles.spacing
        if len(body.particles) > 1 and apart > APART * scene.grid.spacing:
            warnings.warn(
                f"body {b}: the mean particle spacing is {apart / scene.grid.spacing:.3g} cells (from particle volumes). Above {APART} "
                f"cells numerical fracture occurs; use a spacing of about half a cell, {0.5 * scene.grid.spacing:.3g} m.",
                StabilityWarning,
                stacklevel=3,
            )


def _whole_bytes(budget: float | None) -> int | None:
    """A budget such as 2e9 as a whole number [bytes]."""
    if budget is None:
        return None
    if isinstance(budget, float) and budget.is_integer():
        budget = int(budget)
    check_whole("memory_budget, in bytes,", budget)
    return int(budget)
