"""Choices that ``build`` makes for a scene, or checks where the user made them: formulation, contact, scheme, inputs and alarms."""

import dataclasses
import math
from collections.abc import Iterable

import numpy as np
import torch

from softmpm.alarms import Alarms
from softmpm.inputs import QUANTITIES, Inputs
from softmpm.scene.check_scene import lacks_nodes
from softmpm.scene.scene import MIRRORS, Scene
from softmpm.schemes.registry import SCHEMES


def choose_formulation(scene: Scene, scheme: str, wanted: str) -> tuple[str, str]:
    """Formulation for ``wanted``, which may be "auto", and the reason.

    Raises:
        ValueError: There is no such formulation.
    """
    if wanted not in ("auto", "moving", "reference"):
        raise ValueError(f"formulation must be 'auto', 'moving' or 'reference', got {wanted!r}.")
    if wanted != "auto":
        return wanted, f"formulation={wanted!r}" + (", the default" if wanted == "moving" else "")
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
    outside = lacks_nodes(points, grid)
    if outside.any():
        raise ValueError(
            f"surface points need the nodes around them, from half a cell to one and a half cells inside the grid, but one is at "
            f"{points[outside][0].tolist()} m; move the body, enlarge the grid, or take contact='nodes'."
        )


def check_moving(scene: Scene, surface: bool, device: torch.device, deterministic: bool) -> None:
    """Raise ValueError for what the moving formulation cannot do; ``surface`` is contact at surface points."""
    points = sum(len(body.particles.outline) for body in scene.bodies if surface and body.particles.outline)
    nodes = math.prod(scene.grid.shape)
    if points > nodes:
        raise ValueError(
            f"formulation='moving' has contact at no more surface points than nodes of the grid, {nodes:,}, but the outlines have "
            f"{points:,}; take outlines with fewer points, a larger grid, or contact='nodes'."
        )
    if surface and deterministic and device.type == "cuda":
        raise ValueError(
            "deterministic=True has no contact at surface points on a GPU with formulation='moving'; take formulation='reference', "
            "whose sums have a fixed order, or contact='nodes'."
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
    particles = worlds * scene.particle_count
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


def relevant(alarms: Alarms, formulation: str, surface: bool) -> Alarms:
    """The alarms of a model: without those whose failure it cannot have."""
    absent = {
        "gap": formulation == "reference",
        "overlap": formulation != "reference",
        "depth": not surface,
    }
    return dataclasses.replace(alarms, **{name: None for name, never in absent.items() if never})
