"""Angular momentum and energy of a spinning body in float32: `python bench/spin.py [--formulation reference] [--json FILE]`

A disc (2D) and a cube (3D) turn freely at π/2 rad/s for 10,000 substeps at half the largest stable step, in each law of
bench/extremes/laws.py and in both schemes. ``momentum`` is the relative change of the angular momentum since the start, ``energy`` the
relative difference of the total energy from a run in float64 (which loses a little to the dissipation of the transfers, as expected);
``float64`` is the change of the momentum in that run. The last line is the maximum over all rows.

With ``--formulation reference`` momentum and energy are those of the nodes, and a column ``travel`` says by how many cells the body
flies meanwhile: 0 or 1,000. ``strain`` is then the largest difference of F from the run in float64.
"""

import dataclasses
import math

import numpy as np
import torch
from common import Table, arguments
from extremes.judges import DENSITIES, Exact, Matter, exact, stretches
from extremes.laws import LAWS

import softmpm
from softmpm.oracle.lagrangian import quadrature
from softmpm.schemes.lagrangian.nodal import nodes_of, particles_of

SUBSTEPS = 10_000
SPACING = 0.04
YOUNGS = (1e4, 1e5, 1e6, 1e7, 1e8)


def main():
    args = arguments(__doc__, formulations=True)
    if args.formulation == "reference":
        of_nodes(args)
        return
    table = Table("Spin in float32 against float64", torch.device(args.device), args.json)
    worst = {"momentum": 0.0, "energy": 0.0}
    for law in LAWS:
        for dim in (2, 3):
            for young in YOUNGS:
                case = scene(law, dim, young)
                matter = Matter(case)
                start, precise = turn(case, "plain", torch.float64, args.device)
                for scheme in ("plain", "fast"):
                    _, end = turn(case, scheme, torch.float32, args.device)
                    want, got = matter.energy(precise).total, matter.energy(end).total
                    change = {"momentum": spun(matter, start, end), "energy": abs(got - want) / want}
                    row = {"law": law.__name__, "dim": dim, "particles": len(start.x), "young": young}
                    table.add(row | {"scheme": scheme} | change | {"float64": spun(matter, start, precise)})
                    worst = {name: max(worst[name], change[name]) for name in worst}
    print(f"worst: angular momentum {worst['momentum']:.2g}, energy {worst['energy']:.2g}")


def of_nodes(args) -> None:
    """The same in the reference formulation, for a law without and one with a rotation."""
    table = Table("Spin of nodes in float32 against float64", torch.device(args.device), args.json)
    worst = {"momentum": 0.0, "energy": 0.0}
    for law in LAWS[:2]:
        for dim, youngs in ((2, YOUNGS[::2]), (3, YOUNGS[::4])):
            for young in youngs:
                for travel in (0, 1000) if young == 1e4 else (0,):
                    case, found = scene(law, dim, young), []
                    for dtype in (torch.float32, torch.float64):
                        settings = dict(device=args.device, dtype=dtype, formulation="reference")
                        model = softmpm.build(case, **settings)
                        start = turning(model)
                        start.v[..., 0] += travel * SPACING / (SUBSTEPS * case.dt)
                        mass = model.mass.expand(1, -1)
                        start = particles_of(model, nodes_of(model, start, mass))
                        end = softmpm.simulate(model, start, None, model.params(), substeps=SUBSTEPS)
                        found.append((*(turned(model, state) for state in (start, end)), end.F.double()))
                    (before, after, F), (precise_before, precise, wanted) = found
                    change = {
                        "momentum": after[0] / before[0] - 1,
                        "energy": after[1] / precise[1] - 1,
                    }
                    row = {"law": law.__name__, "dim": dim, "particles": model.particle_count, "young": young}
                    row |= {"travel": travel} | {name: abs(value) for name, value in change.items()}
                    row |= {"float64": abs(precise[0] / precise_before[0] - 1)}
                    table.add(row | {"strain": (F - wanted).abs().max().item()})
                    if travel == 0:
                        worst = {name: max(worst[name], abs(change[name])) for name in worst}
    print(f"worst: angular momentum {worst['momentum']:.2g}, energy {worst['energy']:.2g}")


def turned(model: softmpm.Model, state: softmpm.State) -> tuple[float, float]:
    """Angular momentum about the centre of mass in the plane of x and y, and energy in the frame of the centre of mass."""
    grid, matter, nodes = model.rest_grid, Matter(model.scene), state.nodes
    assert nodes is not None
    u, v = (field[0].double().cpu().numpy() for field in nodes[:2])
    points, number = quadrature(model.scene), np.full(math.prod(model.scene.grid.shape), -1)
    number[grid.index.cpu().numpy()] = np.arange(grid.count)
    stencil, weights, slopes = number[points.node.numpy()], points.N.numpy(), points.slope.numpy()
    mass = np.zeros(grid.count)
    np.add.at(mass, stencil, matter.mass[:, None] * weights)
    half = u - 0.5 * model.scene.dt * v  # at the time of the velocities
    x = grid.nodes.cpu().numpy() * model.scene.grid.spacing + u
    x, v = (field - mass @ field / mass.sum() for field in (x, v))
    F = np.eye(model.dim) + np.einsum("pnd,pne->pde", half[stencil], slopes)
    s = stretches(F)
    density = DENSITIES[matter.laws[0]](s, s.prod(-1), matter.mu, matter.lam)
    spin = mass @ (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])
    return spin, 0.5 * mass @ (v**2).sum(1) + matter.volume @ density


def scene(law: type, dim: int, young: float) -> softmpm.Scene:
    """A free disc of 316 or cube of 512 particles, two a cell along each axis."""
    middle = np.full(dim, 6.5 * SPACING)
    if dim == 2:
        particles = softmpm.ball(middle, 5 * SPACING, SPACING / 2)
    else:
        particles = softmpm.box(middle - 2 * SPACING, middle + 2 * SPACING, SPACING / 2)
    body = softmpm.Body(particles, law(density=1000.0, young=young))
    free = softmpm.Scene(grid=softmpm.Grid(shape=(14,) * dim, spacing=SPACING), bodies=[body], dt=1.0)
    return dataclasses.replace(free, dt=0.5 * softmpm.stable_dt(free))


def turn(case: softmpm.Scene, scheme: str, dtype: torch.dtype, device: str) -> tuple[Exact, Exact]:
    """The start, turning rigidly, and the end."""
    model = softmpm.build(case, device=device, dtype=dtype, scheme=scheme)
    start = turning(model)
    end = softmpm.simulate(model, start, None, model.params(), substeps=SUBSTEPS)
    return exact(start), exact(end)


def turning(model: softmpm.Model) -> softmpm.State:
    """The start, turning rigidly."""
    start = model.rest()
    start.C[..., 0, 1], start.C[..., 1, 0] = -math.pi / 2, math.pi / 2
    arm = start.x - start.x.mean(dim=1, keepdim=True)
    start.v[:] = (start.C @ arm[..., None])[..., 0]
    return start


def spun(matter: Matter, start: Exact, end: Exact) -> float:
    """Relative change of the angular momentum."""
    before, after = matter.angular_momentum(start), matter.angular_momentum(end)
    return float(np.linalg.norm(after - before) / np.linalg.norm(before))


if __name__ == "__main__":
    main()
