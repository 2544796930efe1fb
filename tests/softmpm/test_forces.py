"""Forces of walls on surface points: laws of mechanics, and their gradient."""

import pytest
import torch
from surface_scenes import G, block, build, made, settled, slab, velocity

import softmpm
from softmpm import Inputs


def test_the_force_of_a_floor_is_the_weight():
    """Of a block at rest to 1e-6, without a part along the floor; each point bears a share, at its place on the floor."""
    model = made(slab())
    forces = softmpm.contact_forces(model, settled(model, 5000))
    weight = (model.mass.sum() * G).item()
    assert forces.total.shape == (1, 1, 2)
    assert forces.total[0, 0, 1].item() == pytest.approx(weight, rel=1e-6)
    assert forces.total[0, 0, 0].abs() <= 1e-6 * weight
    surface = model.surface
    assert surface is not None and forces.traction.shape == (1, 1, surface.count, 2)
    torch.testing.assert_close((forces.traction * surface.areas[:, None]).sum(2), forces.total)
    sole = surface.points[:, 1] < model.scene.walls[0].offset + 1e-9
    assert (forces.traction[0, 0, ~sole] == 0).all() and (forces.traction[0, 0, sole, 1] >= 0).all()
    height = forces.points[0, sole, 1] - model.scene.walls[0].offset
    assert height.abs().max() <= 1e-4 * model.scene.grid.spacing


@pytest.mark.parametrize("dim", [2, 3])
def test_impulses_are_the_change_of_momentum(dim):
    """T times the forces of two rough walls that move, and T m g, are what a thrown block gains: ≤ 1e-12; |F_t| ≤ μ F_n."""
    scene = block(dim, walls=block(dim).walls[:2], muscles=[], damping=0.0)
    model = build(scene, dtype=torch.float64, inputs=("wall_offset", "wall_velocity"))
    start = model.rest()
    start.v[..., 1] = -1.0
    points = model.surface.points  # pyright: ignore[reportOptionalMemberAccess]
    normal = torch.tensor([wall.normal for wall in scene.walls], dtype=torch.float64)
    near = (points @ normal.T).amin(0)[None, None]
    slide = torch.tensor([0.3, 0.1, -0.2][:dim], dtype=torch.float64)
    inputs = Inputs(wall_offset=torch.cat([near, near + 0.01]), wall_velocity=slide)
    end = softmpm.simulate(model, start, None, model.params(), substeps=20, inputs=inputs)
    forces, mass = softmpm.contact_forces(model, end), model.mass.sum()
    T, before = 20 * scene.dt, velocity(model, start)
    gained = mass * (velocity(model, end) - before - T * torch.tensor(scene.gravity, dtype=torch.float64))
    torch.testing.assert_close(T * forces.total[0].sum(0), gained, rtol=0, atol=1e-12)
    assert (forces.total.norm(dim=-1) > 1e-3).all()
    for k, wall in enumerate(scene.walls):
        traction = forces.traction[0, k]
        pressure = traction @ normal[k]
        shear = (traction - pressure[:, None] * normal[k]).norm(dim=-1)
        assert (pressure >= 0).all() and (shear <= wall.friction * pressure * (1 + 1e-12) + 1e-12).all()


def test_the_force_has_a_gradient():
    """Of a block that rests: the force of a control step is the weight, so its derivative is the mass and does not see E."""
    model = made(slab(), inputs=("gravity",))
    gravity = torch.tensor([0.0, -G], dtype=torch.float64, requires_grad=True)
    params = softmpm.Params(*(p.clone().requires_grad_() for p in model.params()))
    start = settled(model, 5000).detach()
    state = softmpm.simulate(model, start, None, params, substeps=4000, inputs=Inputs(gravity=gravity))
    total = softmpm.contact_forces(model, state).total[0, 0, 1]
    slopes = torch.autograd.grad(total, [gravity, *params])
    assert slopes[0][1].item() == pytest.approx(-model.mass.sum().item(), rel=1e-2)
    assert slopes[3].sum().item() == pytest.approx((model.volume.sum() * G).item(), rel=1e-2)
    assert (slopes[1] * params.young).sum().abs() < 1e-2 * total


def test_what_has_no_contact_forces_is_refused():
    """A model with contact at nodes, and a state that simulate did not return."""
    model = made(slab())
    with pytest.raises(ValueError, match="got one without nodes or surface points; simulate from it first"):
        softmpm.contact_forces(model, model.rest())
    for other in (made(slab(), contact="nodes"), softmpm.build(slab(), device="cpu", contact="nodes")):
        with pytest.raises(ValueError, match="build it with contact='surface'"):
            softmpm.contact_forces(other, other.rest())
