"""Scenes that a sensible user could write, run close to the stable step, and their energy.

Bodies that fit their grid and fall, fly or turn at a fraction of their wave speed; muscles up to a fifth as strong as these are stiff;
a floor and a wall beside. Whatever stops such a scene must be there when it is looked for by other means.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np
import torch

import softmpm
from fuzzing.scenes import LAWS, SPECIALS, Special
from fuzzing.verdict import Verdict
from softmpm.oracle import stress

ROWS, SUBSTEPS = 8, 40
GAIN = 1.05
"""Energy at the end over energy at the start plus work, at most."""


@dataclasses.dataclass
class Legal:
    """A scene, its start, the activation of each control step [-], shape (ROWS, 1, muscle), and the time of all of them [s]."""

    special: Special
    scene: softmpm.Scene
    v: np.ndarray
    activation: torch.Tensor
    time: float

    def run(self, model: softmpm.Model) -> Iterator[tuple[list[float], softmpm.State, softmpm.State]]:
        """Activation and states before and after each control step."""
        state = model.rest()
        state.v.copy_(torch.as_tensor(self.v)[None])
        for row in self.activation:
            substeps = round(self.time / len(self.activation) / model.scene.dt)
            end = softmpm.simulate(model, state, row[None], model.params(), substeps=substeps)
            yield row[0].tolist(), state, end
            state = end

    def model(self) -> softmpm.Model:
        special = self.special
        return softmpm.build(self.scene, device="cpu", dtype=special.dtype, scheme=special.scheme)

    def at(self, share: float) -> "Legal":
        """The same at a ``share`` of the running limit: the smallest one met at two fifths of the limit at rest."""
        found = [
            softmpm.stable_dt(self.scene, stretch=end.F[0]).dt
            for _, _, end in dataclasses.replace(
                self, activation=self.activation.repeat_interleave(4, 0)
            ).run(self.model())
        ]
        return dataclasses.replace(self, scene=dataclasses.replace(self.scene, dt=share * min(found)))


def legal(seed: int) -> Legal:
    """The scene of a seed, at two fifths of the stable step at rest."""
    random = np.random.default_rng(seed)
    special = list(SPECIALS.values())[random.integers(len(SPECIALS))]
    dim, dx = special.dim, 10 ** random.uniform(-2.5, -0.5)
    nodes = (44, 64, 14)[:dim]  # room to jump
    bodies = _bodies(random, special, dx)
    particles = np.concatenate([body.particles.positions for body in bodies])
    scene = softmpm.Scene(
        grid=softmpm.Grid(shape=nodes, spacing=dx),
        bodies=bodies,
        muscles=_muscles(random, special, bodies),
        walls=_walls(random, special, particles, dx),
        damping=random.uniform(0.1, 2.0) if special.damping else 0.0,
        dt=1.0,
    )
    stable = softmpm.stable_dt(scene).dt
    time, speed = ROWS * SUBSTEPS * stable, 0.03 * dx / stable
    fall = 0.5 if special.contacts else 3.0  # cells in all that time
    fall *= random.uniform(0.1, 1.0) * 2 * dx / time**2
    away = np.minimum(speed, 2 * dx / time) * random.uniform(-1, 1, dim)
    away[1] = -abs(away[1])
    v = away + np.concatenate([_turning(random, body.particles.positions, speed) for body in bodies])
    rows = torch.as_tensor(random.uniform(-1, 1, (ROWS, 1, len(scene.muscles))), dtype=special.dtype)
    scene = dataclasses.replace(scene, gravity=(0.0, -fall, 0.0)[:dim], dt=0.4 * stable)
    return Legal(special, scene, v, rows, time)


def _bodies(random, special: Special, dx: float) -> list[softmpm.Body]:
    """One of each law, side by side, alike within a factor of ten."""
    count, dim = len(special.laws), special.dim
    apart, young, density = (
        random.uniform(0.45, 0.6) * dx,
        10 ** random.uniform(1, 7),
        10 ** random.uniform(0, 3.5),
    )
    middle = np.array((22, 14, 7))[:dim] * dx
    bodies = []
    for k, law in enumerate(special.laws):
        half = random.uniform(1.0, 1.8 if dim == 2 else 1.3, dim) * dx
        at = middle.copy()
        at[0] += (k - (count - 1) / 2) * 5.5 * dx  # no shared node
        shape = random.choice(["box", "ball"])
        particles = (
            softmpm.box(at - half, at + half, apart)
            if shape == "box"
            else softmpm.ball(at, float(half.max()), apart)
        )
        material = LAWS[law](
            young=young * random.uniform(1, 10),
            poisson=random.uniform(0, 0.45),
            density=density * random.uniform(1, 10),
        )
        bodies.append(softmpm.Body(particles, material))
    return bodies


def _muscles(random, special: Special, bodies: list[softmpm.Body]) -> list[softmpm.Muscle]:
    count, weakest = sum(len(body.particles) for body in bodies), min(body.material.young for body in bodies)
    return [
        softmpm.Muscle(
            particles=np.arange(count)[k * count // 4 : count - (special.slots - 1 - k) * count // 4],
            direction=random.normal(size=special.dim),
            strength=0.2 * weakest * random.uniform(0.1, 1),
        )
        for k in range(special.slots)
    ]


def _walls(random, special: Special, particles: np.ndarray, dx: float) -> list[softmpm.Wall]:
    """A floor half a cell below, and a wall half a cell beside."""
    lowest, dim = particles.min(axis=0) - 0.5 * dx, special.dim
    normals = [(0.0, 1.0, 0.0)[:dim], (1.0, 0.0, 0.0)[:dim]]
    return [
        softmpm.Wall(
            normal=normal,
            offset=float(np.dot(normal, lowest)),
            contact=kind,
            friction=random.uniform(0.1, 1) if kind == "separate" else 0.0,
        )
        for normal, kind in zip(normals, special.contacts, strict=False)
    ]


def _turning(random, particles: np.ndarray, speed: float) -> np.ndarray:
    """Velocity of a rotation about the middle."""
    arm = particles - particles.mean(axis=0)
    rate = random.uniform(-1, 1) * speed / np.abs(arm).max()
    v = np.zeros_like(arm)
    v[:, 0], v[:, 1] = -rate * arm[:, 1], rate * arm[:, 0]
    return v


def judged(seed: int, share: float = 0.95) -> Verdict:
    """Run it at a share of the running limit. Good if it ends, finite, with no more energy than it had and was given."""
    case = legal(seed)
    model = case.model()
    start = model.rest()
    start.v.copy_(torch.as_tensor(case.v)[None])
    had, given, taken, end = energy(case.scene, start), 0.0, 0.0, start
    try:
        case = case.at(share)
        model = case.model()
        for row, before, end in case.run(model):
            work = _work(case.scene, before, end, row)
            given, taken = given + max(work, 0.0), taken - min(work, 0.0)
    except softmpm.UnstableError as error:
        return Verdict("stopped" if confirmed(model, error) else "false alarm", f"{error.kind}: {error}")
    if not all(bool(torch.isfinite(tensor).all()) for tensor in end[:4]):
        return Verdict("not finite")
    ratio = (energy(case.scene, end) + taken) / (had + given)
    return Verdict("ran" if ratio <= GAIN else "energy", f"{ratio:.4f}")


def _mass(scene: softmpm.Scene) -> np.ndarray:
    return np.concatenate([body.material.density * body.particles.volume for body in scene.bodies])


def _volume(scene: softmpm.Scene) -> np.ndarray:
    return np.concatenate([body.particles.volume for body in scene.bodies])


def energy(scene: softmpm.Scene, state: softmpm.State) -> float:
    """Kinetic energy, that of the affine velocity included, and elastic energy [J]."""
    v, C, F = (tensor.detach()[0].double() for tensor in state[1:4])
    mass = torch.tensor(_mass(scene))
    kinetic = 0.5 * mass * ((v**2).sum(-1) + scene.grid.spacing**2 / 4 * (C**2).sum((-1, -2)))
    total, start = float(kinetic.sum()), 0
    for body in scene.bodies:
        part = slice(start, start + len(body.particles))
        total += float((torch.tensor(body.particles.volume) * stored(body.material, F[part])).sum())
        start = part.stop
    return total


def stored(material: softmpm.NeoHookean | softmpm.FixedCorotated, F: torch.Tensor) -> torch.Tensor:
    """Elastic energy of a law per rest volume [J/m³]."""
    mu, lam = stress.lame(
        *(torch.tensor(value, dtype=F.dtype) for value in (material.young, material.poisson))
    )
    J = torch.linalg.det(F)
    if isinstance(material, softmpm.NeoHookean):
        log = torch.log(J)
        return mu / 2 * ((F**2).sum((-1, -2)) - F.shape[-1]) - mu * log + lam / 2 * log**2
    if isinstance(material, softmpm.FixedCorotated):
        return mu * ((F - stress.polar(F)) ** 2).sum((-1, -2)) + lam / 2 * (J - 1) ** 2
    raise TypeError(f"no energy is written down for {type(material).__name__}.")


def _work(scene: softmpm.Scene, start: softmpm.State, end: softmpm.State, activation: list[float]) -> float:
    """Work of gravity, and of muscles under a constant activation: what ½ V a s |F d|² falls by [J]."""
    moved = (end.x - start.x)[0].double().numpy()
    total = float((_mass(scene)[:, None] * moved * np.array(scene.gravity)).sum())
    volume = torch.tensor(_volume(scene))
    for muscle, a in zip(scene.muscles, activation, strict=True):
        index, d = torch.tensor(muscle.particles), torch.tensor(muscle.direction, dtype=torch.float64)
        before, after = (((state.F[0, index].double() @ d) ** 2).sum(-1) for state in (start, end))
        total += 0.5 * a * muscle.strength * float((volume[index] * (before - after)).sum())
    return total


def confirmed(model: softmpm.Model, error: softmpm.UnstableError) -> bool:
    """True if the state of the error shows the failure that it names."""
    state, dx = error.state, model.scene.grid.spacing
    x, F = state.x[error.world].double(), state.F[error.world].double()
    if error.kind in ("inverted", "collapsed"):
        return float(torch.linalg.det(F[error.particle])) < 0.2
    if error.kind == "left_grid":
        high = (torch.tensor(model.scene.grid.shape) - 1.5) * dx
        return bool(((x[error.particle] < 0.6 * dx) | (x[error.particle] > high - 0.1 * dx)).any())
    if error.kind == "torn":
        return _farthest(model, x) > 1.4 * dx
    if error.kind == "step":
        return float(torch.linalg.svdvals(F).max()) > 1.05  # at rest dt is below the limit
    return error.kind == "not_finite" and not all(bool(torch.isfinite(t).all()) for t in state[:4])


def _farthest(model: softmpm.Model, x: torch.Tensor) -> float:
    """Largest distance of particles of one body that were neighbours at rest [m]."""
    rest, body = model.positions.double(), model.body
    apart = torch.cdist(rest, rest)
    apart[body[:, None] != body[None]] = torch.inf
    apart.fill_diagonal_(torch.inf)
    near = apart <= 1.5 * apart.min(dim=1, keepdim=True).values
    return float(torch.cdist(x, x)[near].max()) if bool(near.any()) else 0.0
