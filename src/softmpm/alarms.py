"""Limits beyond which a simulation is stopped by name, and the failures of single worlds that a caller tolerates."""

import math
from dataclasses import dataclass, fields
from typing import Literal, get_args

from softmpm.errors import UnstableError
from softmpm.summary import counted
from softmpm.validate import need

Policy = Literal["freeze", "reset"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Alarms:
    """Limits of a healthy simulation. Each is checked on the device; None switches one off.

    Example:
        >>> softmpm.build(scene, alarms=softmpm.Alarms(step=None))  # any dt, at the caller's risk
    """

    collapse: float | None = 0.05
    """Least det F [-] of a particle, checked in every substep. Bodies that recover stay above 0.1 (docs/limits.md); below 0.05
    fixed corotated bodies collapse for good. None leaves det F > 0 to the laws that are undefined beyond."""
    gap: float | None = 1.4
    """Largest distance of two particles that are neighbours at rest [cells], checked after each chunk of the moving formulation. Bodies
    that were stretched to 4/3 cells spring back, those at 3/2 do not: they break for numerical reasons alone (numerical fracture). In
    the reference formulation nothing breaks."""
    step: float | None = 1.0
    """Largest ratio of dt and the stable step of a particle alone on the grid with its present deformation, material and activation
    [-], checked at the start of a call and after each chunk, in the reference formulation at every eighth substep of a chunk as well.
    Particles that share nodes bear 1.1 to 1.6 of it. ``build`` refuses a dt above this ratio at rest."""
    depth: float | None = 1.0
    """Largest depth of a surface point under a separating wall, over the way of a pressure wave of the scene's material in a substep
    [-], checked in every substep. Contact pushes a point out within one substep, beyond 1 faster than sound. Impacts at half of the
    wave speed reach 0.3 (docs/math/contact.md)."""
    overlap: float | None = 1.0
    """Particles more than three cells apart at rest must stay out of each other's volume: width of that volume, in units of the
    particle's own [-]. Checked after each chunk in the reference formulation, in which bodies pass through themselves and each other.
    With 1 two flat faces may overlap by half the distance of the particles (docs/limits.md)."""

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise TypeError(f"alarm {field.name} must be a number or None, got {value!r}.")
            need(
                0.0 < value < math.inf,
                f"alarm {field.name} must be finite and > 0, got {value}; None switches it off.",
            )
            object.__setattr__(self, field.name, float(value))
        need(
            self.collapse is None or self.collapse < 1.0,
            f"alarm collapse must be below 1, the det F at rest, got {self.collapse}.",
        )


class Failures:
    """Failures of single worlds that are counted instead of raised; give it to :func:`softmpm.simulate`.

    A world that fails stops at the start of the chunk in which it failed, at most 128 substeps before the failure, and takes no part
    in the rest of the call. It returns in that state (``freeze``) or in the rest state (``reset``), and contributes no gradient. The
    other worlds are the same as without it, to the last bit where sums have a fixed order. A loss must leave out
    ``worlds`` (docs/quantities.md); it would take these states for results.

    It works inside a :class:`softmpm.Graph` too: after each replay ``errors`` has the first failure of each world that is not in it
    yet, so clear it before the next. There a world stops where it failed, and one that is frozen stays there.

    Attributes:
        policy: ``freeze`` or ``reset``.
        errors: What would have been raised, in the order in which it was found; ``world`` and ``substep`` say where and when.
    """

    def __init__(self, policy: Policy):
        need(
            policy in get_args(Policy),
            f"policy must be one of {', '.join(get_args(Policy))}, got {policy!r}; without an object of Failures the call raises.",
        )
        self.policy: Policy = policy
        self.errors: list[UnstableError] = []

    def __len__(self) -> int:
        return len(self.errors)

    def __repr__(self) -> str:
        return f"Failures({self.policy}: {counted(len(self), 'failure')} in worlds {self.worlds})"

    @property
    def worlds(self) -> list[int]:
        """Worlds that failed, in ascending order, each once."""
        return sorted({error.world for error in self.errors})
