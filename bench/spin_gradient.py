"""Gradients through a spinning body in float32 against float64: `python bench/spin_gradient.py [--device cpu] [--json FILE]`

The bodies of spin.py turn freely at π/2 rad/s for 10,000 substeps in the reference formulation. Cubes turn about an axis of the grid,
or about one that is inclined to it. ``x`` and ``v`` are the largest relative differences of the gradients with respect to initial
positions and velocities, over random cotangents of the end.
"""

import math

import torch
from common import Table, arguments
from spin import SUBSTEPS, scene

import softmpm

COTANGENTS = 6
AXES = {"grid": (0.0, 0.0, 1.0), "inclined": (0.48, 0.6, 0.64)}
CASES = [(2, 1e4, "grid"), (2, 1e8, "grid"), (3, 1e4, "grid"), (3, 1e4, "inclined"), (3, 1e8, "grid")]


def main():
    args = arguments(__doc__)
    table = Table(
        "Gradient of a spinning body, float32 against float64", torch.device(args.device), args.json
    )
    for law in (softmpm.NeoHookean, softmpm.StableNeoHookean, softmpm.FixedCorotated):
        for dim, young, axis in CASES:
            case = scene(law, dim, young)
            got, want = (
                gradients(case, axis, dtype, args.device) for dtype in (torch.float32, torch.float64)
            )
            row = {"law": law.__name__, "dim": dim, "young": young, "axis": axis}
            for k, name in enumerate("xv"):
                pairs = [(mine[k], exact[k]) for mine, exact in zip(got, want, strict=True)]
                row[name] = max(((mine - exact).norm() / exact.norm()).item() for mine, exact in pairs)
            table.add(row)


def gradients(
    case: softmpm.Scene, axis: str, dtype: torch.dtype, device: str
) -> list[tuple[torch.Tensor, ...]]:
    """With respect to initial positions and velocities, for each cotangent."""
    model = softmpm.build(case, device=device, dtype=dtype, formulation="reference")
    start, (x, y, z) = model.rest(), AXES[axis]
    spin = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])[: model.dim, : model.dim]
    start.C[:] = (math.pi / 2 * spin).to(start.C)
    arm = start.x - start.x.mean(dim=1, keepdim=True)
    start.v[:] = (start.C @ arm[..., None])[..., 0]
    leaves = start.x.requires_grad_(), start.v.requires_grad_()
    end, found = softmpm.simulate(model, start, None, model.params(), substeps=SUBSTEPS), []
    for seed in range(COTANGENTS):
        weights = torch.randn(end.x.shape, generator=torch.Generator().manual_seed(seed)).to(end.x)
        value = (weights * (0.01 * end.x + end.v)).sum()
        found.append(tuple(g.double() for g in torch.autograd.grad(value, leaves, retain_graph=True)))
    return found


if __name__ == "__main__":
    main()
