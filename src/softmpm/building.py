"""``build``: a scene checked, a scheme chosen, and the model of both."""

import dataclasses
import math
from collections.abc import Iterable

import numpy as np
import torch

from softmpm.alarms import Alarms
from softmpm.checks import check_whole
from softmpm.devices import device_of
from softmpm.inputs import QUANTITIES, Inputs
from softmpm.model import Model
from softmpm.scene.check_scene import check_precision, check_scene
from softmpm.scene.scene import MIRRORS, Scene
from softmpm.schemes.registry import SCHEMES
from softmpm.stability import need_stable, warn_sparse


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
            and leaves ``scheme`` out; ``describe`` gives the reason.
        contact: Part of the bodies that meets the separating walls: "nodes", "surface" (the points of the outlines,
            :class:`softmpm.Outline`), or "auto": the surface if every body has an outline.
        contact_width: Distance over which surface contact sets in [cells]: 0 to evaluate, 0.01 to learn, so that gradients are smooth.
        inputs: Names of fields of :class:`softmpm.Inputs` that calls will give, such as ("friction", "gravity"): the kernels then read
            them from memory, for each world. Others are compiled as the scene has them, or left out.
        deterministic: The same bits from run to run, results and gradients, on one kind of GPU; slower, and in the plain scheme
            and ``step`` much slower: float32 and the fast scheme are best. The CPU adds in one order anyway. See docs/conventions.md.
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
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}.")
    check_whole("worlds", worlds)
    check_whole("calls", calls)
    if threads is not None:
        check_whole("threads", threads)
    if memory_budget is not None:
        if isinstance(memory_budget, float) and memory_budget.is_integer():
            memory_budget = int(memory_budget)
        check_whole("memory_budget, in bytes,", memory_budget)
        memory_budget = int(memory_budget)
    if scheme not in ("auto", "fast", "plain"):
        raise ValueError(f"scheme must be 'auto', 'fast' or 'plain', got {scheme!r}.")
    given = check_given(scene, inputs)
    formulation, why = choose_formulation(scene, scheme, formulation)
    if not isinstance(deterministic, (bool, np.bool_)):
        raise TypeError(f"deterministic must be True or False, got {deterministic!r}.")
    alarms = Alarms() if alarms is None else alarms
    if not isinstance(alarms, Alarms):
        raise TypeError(f"alarms must be a softmpm.Alarms or None, got {type(alarms).__name__}.")
    check_precision(scene, dtype)
    if alarms.step is not None:
        need_stable(scene, alarms.step)
    warn_sparse(scene)
    if not 0.0 <= contact_width < 1.0:
        raise ValueError(f"contact_width must be in [0, 1) cells, got {contact_width!r}.")
    surface = on_surface(scene, formulation, contact, contact_width)
    if formulation == "reference":
        check_reference(scheme)
        scheme, reason = "lagrangian", "formulation='reference'"
        alarms = dataclasses.replace(alarms, gap=None)
    else:
        check_moving(scene, surface)
        scheme, reason = choose_scheme(scene, dtype, int(worlds), scheme, surface and bool(deterministic))
    if not surface:
        alarms = dataclasses.replace(alarms, depth=None)
    if formulation != "reference":
        alarms = dataclasses.replace(alarms, overlap=None)
    place = device_of(device)
    if surface and deterministic and formulation == "moving" and place.type == "cuda":
        raise ValueError(
            "deterministic=True has no contact at surface points on a GPU with formulation='moving'; take formulation='reference', "
            "whose sums have a fixed order, or contact='nodes'."
        )
    return Model(
        scene,
        place,
        dtype,
        scheme,
        reason,
        SCHEMES[scheme].footprint,
        alarms,
        formulation=formulation,
        formulation_reason=why,
        surface=surface,
        contact_width=float(contact_width),
        given=given,
        deterministic=bool(deterministic),
        fixed_point=bool(deterministic) and in_fixed_point(place, dtype, scheme),
        worlds=int(worlds),
        memory_budget=memory_budget,
        calls=int(calls),
        threads=None if threads is None else int(threads),
    )


def choose_formulation(scene: Scene, scheme: str, wanted: str) -> tuple[str, str]:
    """Formulation for ``wanted``, which may be "auto", and the reason.

    Raises:
        ValueError: There is no such formulation.
    """
    if wanted not in ("auto", "moving", "reference"):
        raise ValueError(f"formulation must be 'auto', 'moving' or 'reference', got {wanted!r}.")
    if wanted != "auto":
        return wanted, "as asked for"
    if scene.body_contact:
        return "moving", "the scene does not state body_contact=False"
    try:
        check_reference(scheme)
    except ValueError as obstacle:
        return "moving", str(obstacle).partition(";")[0]
    return "reference", "bodies meet walls only"


def on_surface(scene: Scene, formulation: str, contact: str, width: float) -> bool:
    """True if the separating walls act on surface points.

    Raises:
        ValueError: That was asked for and cannot be, or a width was given in vain.
    """
    if contact not in ("auto", "nodes", "surface"):
        raise ValueError(f"contact must be 'auto', 'nodes' or 'surface', got {contact!r}.")
    outlined = all(body.particles.outline is not None for body in scene.bodies)
    separating = any(wall.contact == "separate" for wall in scene.walls)
    if contact == "surface":
        if not outlined:
            raise ValueError(
                "contact='surface' needs an outline of every body (softmpm.Outline), which the shapes have and plain Particles have "
                "if they are given one; take contact='nodes'."
            )
        if not separating:
            raise ValueError(
                "contact='surface' needs a wall of the kind 'separate', and the scene has none; leave contact out."
            )
    chosen = contact != "nodes" and outlined and separating
    if chosen and formulation == "reference":
        check_reach(scene)
    if not chosen and width > 0:
        raise ValueError(
            f"contact_width is for contact at surface points, but nodes meet the walls here; got {width!r}, leave it out."
        )
    return chosen


def check_reach(scene: Scene) -> None:
    """Raise ValueError unless all 3^dim nodes around each surface point are nodes of the grid."""
    grid = scene.grid
    points = np.concatenate(
        [b.particles.outline.points for b in scene.bodies if b.particles.outline is not None]
    )
    base = np.floor(points / grid.spacing - 0.5)
    outside = ((base < 0) | (base > np.array(grid.shape) - 3)).any(axis=1)
    if outside.any():
        raise ValueError(
            f"surface points need the nodes around them, from half a cell to one and a half cells inside the grid, but one is at "
            f"{points[outside][0].tolist()} m; move the body, enlarge the grid, or take contact='nodes'."
        )


def check_moving(scene: Scene, surface: bool) -> None:
    """Raise ValueError for what the moving formulation cannot do; ``surface`` is contact at surface points."""
    points = sum(len(body.particles.outline) for body in scene.bodies if surface and body.particles.outline)
    nodes = math.prod(scene.grid.shape)
    if points > nodes:
        raise ValueError(
            f"formulation='moving' has contact at no more surface points than nodes of the grid, {nodes:,}, but the outlines have "
            f"{points:,}; take outlines with fewer points, a larger grid, or contact='nodes'."
        )
    for k, wall in enumerate(scene.walls):
        if wall.contact in MIRRORS:
            other = {"clamp": "stick", "symmetry": "slip"}[wall.contact]
            raise ValueError(
                f"wall {k} is a {wall.contact}, which reflects the nodes at rest and needs formulation='reference'; take that, or "
                f"contact='{other}' and a body that reaches three cells into the wall."
            )


def check_reference(scheme: str) -> None:
    """Raise ValueError for what the reference formulation cannot do."""
    if scheme != "auto":
        raise ValueError(f"formulation='reference' has one scheme, got scheme={scheme!r}; leave scheme out.")


def check_given(scene: Scene, inputs: Iterable[str]) -> tuple[str, ...]:
    """Names of the inputs that calls give, in their order.

    Raises:
        TypeError, ValueError: One is no field of :class:`softmpm.Inputs`, or the scene has nothing that it could be given to.
    """
    if isinstance(inputs, str):
        raise TypeError(f"inputs must be a sequence of names, such as ({inputs!r},), got one text.")
    names = tuple(inputs)
    unknown = [name for name in names if name not in Inputs._fields]
    if unknown:
        raise ValueError(f"inputs must be among {', '.join(Inputs._fields)}, got {unknown[0]!r}.")
    owners = {"wall": scene.walls, "muscle": scene.muscles, "driven": scene.driven}
    if "direction" in names and not any(hasattr(muscle, "direction") for muscle in scene.muscles):
        raise ValueError("inputs has 'direction', but the scene has no muscles with fibres; leave it out.")
    for name in names:
        for axis in set(QUANTITIES[name].axes) & set(owners):
            if len(owners[axis]) == 0:
                raise ValueError(f"inputs has {name!r}, but the scene has no {OWNED[axis]}; leave it out.")
    # What kernels take in any case is not compiled in another way:
    return tuple(
        name for name in Inputs._fields if name in names and name not in ("strength", "velocity", "position")
    )


OWNED = {"wall": "walls", "muscle": "muscles", "driven": "driven particles"}


def choose_scheme(
    scene: Scene, dtype: torch.dtype, worlds: int, wanted: str, points_in_order: bool
) -> tuple[str, str]:
    """Name of the scheme for ``wanted``, which may be "auto", and the reason.

    Args:
        points_in_order: Whether a deterministic model has contact at surface points, whose sums are not in fixed point.

    Raises:
        ValueError: The scheme that is asked for cannot hold the scene.
    """
    if points_in_order:
        if wanted == "fast":
            raise ValueError(
                "deterministic=True has no contact at surface points in the fast scheme, got scheme='fast'; take scheme='auto', on a "
                "CPU the plain one, or formulation='reference', whose sums have a fixed order."
            )
        return "plain", "deterministic contact at surface points"
    particles = worlds * sum(len(body.particles) for body in scene.bodies)
    if wanted != "auto":
        obstacle = SCHEMES[wanted].footprint.obstacle(scene.grid.shape, particles)
        if obstacle:
            raise ValueError(
                f"scheme {wanted!r} cannot hold this scene: {obstacle}; use scheme='plain' or 'auto'."
            )
        return wanted, "as asked for"
    obstacle = SCHEMES["fast"].footprint.obstacle(scene.grid.shape, particles)
    if obstacle:
        return "plain", obstacle
    if dtype == torch.float64:
        return "plain", "double precision gains nothing from 16-byte reductions"
    return "fast", "single precision"


def in_fixed_point(device: torch.device, dtype: torch.dtype, scheme: str) -> bool:
    """True if a deterministic model sums in fixed point, as the fast scheme does; the others sum in a fixed order.

    Raises:
        ValueError: It would have to, and cannot.
    """
    if scheme != "fast":
        return False
    if dtype == torch.float32:
        return True
    if device.type == "cpu":
        return False
    raise ValueError(
        f"deterministic=True and scheme='fast' need torch.float32 on a GPU, because its fixed point has fewer digits than {dtype}; use "
        "scheme='auto' or 'plain', which sums in the order of the particles."
    )
