"""Failure of bodies that pass through themselves or each other, in words; as those of particles in failure_messages.py."""

from softmpm.model import Model
from softmpm.oracle.overlap import intrusion
from softmpm.overlap_grid import FAR
from softmpm.state import State

REMEDY = (
    "Bodies pass through themselves and each other in the reference formulation: formulation='moving' has contact between them. Use "
    "that, or keep them apart; alarms=softmpm.Alarms(overlap=None) lets them pass."
)


class Overlap:
    """A particle in the volume of another.

    Args:
        particle: The one that was found.
        end: State in which its world stopped.

    Attributes:
        other: The particle in whose volume it is.
    """

    def __init__(self, model: Model, world: int, particle: int, end: State):
        self.model, self.particle = model, particle
        self._x, F = end.x[world].detach().double(), end.F[world]
        self.other = int(intrusion(model.scene, self._x, F, particle).argmin())

    def explain(self) -> tuple[str, str, str, str]:
        """Kind of the failure, the value found, the limit and the remedy."""
        model, p, q = self.model, self.particle, self.other
        assert model.alarms.overlap is not None
        dx, body = model.scene.grid.spacing, int(model.body[q])
        apart = (self._x[p] - self._x[q]).norm().item()
        at_rest = (model.positions[p] - model.positions[q]).double().norm().item()
        volume = model.volume[q].item() ** (1.0 / model.dim)
        value = (
            f"is in the volume of particle {q} (body {body}), {apart:.4g} m ({apart / dx:.4g} cells) from it"
        )
        limit = (
            f"at rest they are {at_rest / dx:.4g} cells apart, and particles more than {FAR:g} cells apart must stay out of each "
            f"other's volume, at rest {model.alarms.overlap * volume / dx:.4g} cells wide"
        )
        return "overlap", value, limit, REMEDY
