"""Failures in words: what a particle did, the rule that it broke, and a remedy.

Each remedy is tried in tests/softmpm/schemes/test_remedies.py.
"""

from dataclasses import dataclass

import torch

from softmpm.errors import Kind
from softmpm.model import Model
from softmpm.oracle import step_limit
from softmpm.schemes.inputs import Values
from softmpm.stability import running_limit
from softmpm.state import State

GRID = "Make the grid larger, add walls, or start further inside."
GENTLER = "Use a stiffer material, or a weaker activation or load"
FINER = "a smaller dt (about half of softmpm.stable_dt)"


@dataclass
class Case:
    """A particle that failed.

    Args:
        end: State in which its world stopped.
        values: Inputs of the call in one control step, if they are at hand.
    """

    model: Model
    kind: Kind
    world: int
    particle: int
    end: State
    values: Values | None = None

    def explain(self) -> tuple[str, str, str, str]:
        """Kind of the failure, the value found, the limit and the remedy."""
        if self.kind is Kind.START:
            return self._start()
        explanations = {
            Kind.LEFT_GRID: self._left_grid,
            Kind.COLLAPSED: self._collapsed,
            Kind.TORN: self._torn,
            Kind.STEP: self._step,
            Kind.NOT_FINITE: self._not_finite,
        }
        return explanations[self.kind]()

    def _start(self) -> tuple[str, str, str, str]:
        kind = "start"
        if self._away() > 0:
            return kind, self._left_grid()[1], self._box(), GRID
        if self._det() <= self._least():
            _, value, limit, _ = self._collapsed()
            return (
                kind,
                value,
                limit,
                "Start from a deformation gradient F that is not inverted and less compressed.",
            )
        if self._bad() or not self._neighbours():
            _, value, limit, _ = self._not_finite()
            return kind, value, limit, "Start from finite and smaller values."
        _, value, limit, _ = self._torn()
        return kind, value, limit, "Start from positions nearer to the rest shape."

    def _left_grid(self) -> tuple[str, str, str, str]:
        thrown = self._away() > self._spacing  # it was on the grid a substep before
        advice = f"It was thrown out. Use {FINER}. {GENTLER}." if thrown else GRID
        x = ", ".join(f"{c:.4g}" for c in self.end.x[self.world, self.particle].tolist())
        return "left_grid", f"is at ({x}) m, off the grid", self._box(), advice

    def _collapsed(self) -> tuple[str, str, str, str]:
        det, least = self._det(), self._least()
        inverted = det <= 0
        limit = f"det F must stay above {least:.4g}"
        law = type(self.model.scene.bodies[int(self.model.body[self.particle])].material).__name__
        if inverted:
            limit += f"; the stress of {law} {'is not meant for' if self._survives() else 'does not exist beyond'} 0"
        advice = (
            f"{GENTLER}, or {FINER}" if inverted else GENTLER
        )  # a body that collapses step by step does so at any dt
        if law != "BarrierCorotated":
            advice += "; softmpm.BarrierCorotated resists compression"
        if self._survives():
            advice += "; alarms=softmpm.Alarms(collapse=None) lets it invert"
        what = "is inverted" if inverted else "has collapsed"
        return "inverted" if inverted else "collapsed", f"{what}, det F = {det:.4g}", limit, advice + "."

    def _torn(self) -> tuple[str, str, str, str]:
        x = self.end.x[self.world].double()
        gap, other = max(
            ((x[q] - x[self.particle]).norm().item() / self._spacing, q) for q in self._neighbours()
        )
        most = self.model.alarms.gap
        value = f"is {gap:.4g} cells away from particle {other}, its neighbour at rest"
        limit = (
            f"neighbours must stay within {most:.4g} cells, since a body breaks beyond (numerical fracture)"
        )
        return "torn", value, limit, f"{GENTLER}."

    def _step(self) -> tuple[str, str, str, str]:
        scene, most = self.model.scene, self.model.alarms.step or 1.0
        largest, viscosity = self._running_limit(), self._viscosity()
        F = self.end.F[self.world, self.particle].detach().double()
        stretches = ", ".join(f"{s:.3g}" for s in torch.linalg.svdvals(F.cpu()).tolist())
        value = f"makes dt = {scene.dt:.4g} s {scene.dt / largest:.7g} times its running stable step of {largest:.4g} s"
        viscous = f", viscosity {viscosity:.4g} Pa s" if viscosity > 0 else ""
        value += f" (principal stretches {stretches}{viscous})"
        limit = f"that ratio must stay within {most:.7g}"
        other = "a softer, denser or less viscous" if viscosity > 0 else "a softer or denser"
        advice = f"Use a dt of at most {0.8 * most * largest:.2g} s, {other} material, or a weaker activation"
        return "step", value, limit, advice + "; alarms=softmpm.Alarms(step=None) runs it all the same."

    def _not_finite(self) -> tuple[str, str, str, str]:
        bad = self._bad()
        what = (
            f"has a value in {', '.join(bad)} that is not finite or too large to square"
            if bad
            else "has values too large to square"
        )
        return "not_finite", what, "every value must be finite, and its square", f"Use {FINER}. {GENTLER}."

    def _neighbours(self) -> list[int]:
        return [q for q in self.model.neighbours[self.particle].tolist() if q >= 0]

    @property
    def _spacing(self) -> float:
        return self.model.scene.grid.spacing

    def _det(self) -> float:
        return torch.linalg.det(self.end.F[self.world, self.particle].double()).item()

    def _survives(self) -> bool:
        return self.model.scene.bodies[int(self.model.body[self.particle])].material.survives_inversion

    def _least(self) -> float:
        return float(self.model.constants.collapse) + 1.0

    def _away(self) -> float:
        """Distance outside the grid [m]; at most 0 inside."""
        dx, x = self._spacing, self.end.x[self.world, self.particle].tolist()
        ends = ((0.5 * dx, (n - 1.5) * dx) for n in self.model.scene.grid.shape)
        outside = [max(low - c, c - high) for c, (low, high) in zip(x, ends, strict=True)]
        on_edge = any(c == (n - 1.5) * dx for c, n in zip(x, self.model.scene.grid.shape, strict=True))
        return max(*outside, 1e-300 if on_edge else max(outside))

    def _box(self) -> str:
        dx = self._spacing
        sides = (f"[{0.5 * dx:.4g}, {(n - 1.5) * dx:.4g})" for n in self.model.scene.grid.shape)
        return "a particle must stay in " + " x ".join(sides) + " m"

    def _bad(self) -> list[str]:
        fields = zip("xvCF", (self.end.x, self.end.v, self.end.C, self.end.F), strict=True)
        return [
            name
            for name, value in fields
            if not bool(torch.isfinite(value[self.world, self.particle].square().sum()))
        ]

    def _running_limit(self) -> float:
        model, values, p = self.model, self.values, self.particle
        if values is None:
            return float("nan")
        mu, lam, mass = (values[name][self.world, p].item() for name in ("mu", "lam", "mass"))
        active_stress = [0.0] * model.muscle_count
        if "active_stress" in values:
            active_stress = values["active_stress"][0, self.world].tolist()
        density = mass / model.specific_volume[p].item()
        F = self.end.F[self.world, p]
        about = (model.scene, p, mu, lam, density, F, active_stress, self._viscosity())
        if model.formulation == "reference":
            return step_limit.running_limit(*about)
        return running_limit(*about, directions=values["fibre"][self.world] if "fibre" in values else None)

    def _viscosity(self) -> float:
        """Viscosity of the particle in the call [Pa s]."""
        values = self.values or {}
        return values["viscosity"][self.world, self.particle].item() if "viscosity" in values else 0.0
