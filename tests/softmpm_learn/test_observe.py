import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers import busy_scene

import softmpm
from softmpm_learn.observe import Centroids, Latent, Nothing, VelocityImage, clusters


@pytest.fixture(scope="module")
def exact(make_block):
    """The block in float64, two worlds."""
    return softmpm.build(make_block(), device="cpu", dtype=torch.float64, worlds=2)


def moving(model, seed=0) -> softmpm.State:
    generator = torch.Generator().manual_seed(seed)
    rest = model.rest()
    noise = [torch.randn(t.shape, generator=generator, dtype=t.dtype) for t in rest[:4]]
    return softmpm.State(rest.x + 0.01 * noise[0], 0.3 * noise[1], 0.5 * noise[2], rest.F)


def test_centroids_at_rest_and_in_translation(exact):
    """At rest all features are zero; a translation at 0.2 m/s shows as velocity alone, in body lengths per second."""
    observer = Centroids(exact, [np.arange(12), np.arange(16, 32)], body_length=0.4)
    rest = exact.rest()
    torch.testing.assert_close(observer(exact, rest), torch.zeros(2, observer.size, dtype=torch.float64))
    moved = rest._replace(x=rest.x + 0.1, v=rest.v + torch.tensor([0.2, 0.0], dtype=torch.float64))
    want = torch.tensor([0.0, 0.0, 0.5, 0.0], dtype=torch.float64).repeat(2, 2)
    torch.testing.assert_close(observer(exact, moved), want)


def test_nothing_is_seen(exact):
    """Whatever the robot does, in each world the one feature is 0, in the precision of the model."""
    found = Nothing()(exact, moving(exact))
    assert found.shape == (2, Nothing.size) and found.dtype == torch.float64 and not found.any()


def test_clusters_split_the_particles_evenly_the_same_way_each_time():
    """Four groups of points far apart are found; every particle is in exactly one cluster; no randomness."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(c, 0.01, (10, 2)) for c in ((0, 0), (0, 1), (1, 0), (1, 1))])
    found = clusters(points, 4)
    assert sorted(set(map(tuple, (c // 10 for c in found)))) == [(k,) * 10 for k in range(4)]
    assert all((a == b).all() for a, b in zip(found, clusters(points, 4), strict=True))
    with pytest.raises(ValueError, match="clusters must not be above the 40"):
        clusters(points, 41)


def test_picture_averages_blocks_of_the_grid_velocity(exact):
    """A uniform motion shows as its velocity in blocks full of particles and as nothing far away; pooling is a plain mean."""
    state = exact.rest()._replace(v=torch.ones_like(exact.rest().v) * torch.tensor([0.3, -0.2]).double())
    fine = VelocityImage(exact, nodes=13, follow=False)(exact, state)
    coarse = VelocityImage(exact, nodes=7, follow=False)(exact, state)
    assert fine.shape == (2, 2, 13, 9) and coarse.shape == (2, 2, 7, 5)
    torch.testing.assert_close(fine[:, :, 5, 3], torch.tensor([[0.3, -0.2]] * 2).double(), rtol=0.02, atol=0)
    assert (fine[:, :, 12] == 0).all()
    torch.testing.assert_close(coarse[:, :, 2, 1], fine[:, :, 4:6, 2:4].mean(dim=(-2, -1)))
    torch.testing.assert_close(coarse[:, :, 6, 4], fine[:, :, 12, 8] / 4)  # the border is padded with nothing


def test_picture_follows_the_robot(exact):
    """With follow, the image does not depend on the robot's position; without, it does. At the rim it is no error."""
    state = moving(exact)
    away = state._replace(x=state.x + torch.tensor([0.13, 0.07], dtype=torch.float64))
    follow, fixed = VelocityImage(exact), VelocityImage(exact, follow=False)
    torch.testing.assert_close(follow(exact, away), follow(exact, state))
    assert (fixed(exact, away) - fixed(exact, state)).abs().max() > 0.05
    wide = state._replace(
        x=state.x + 0.4 * torch.randn(state.x.shape, generator=torch.Generator().manual_seed(1)).double()
    )
    assert follow(exact, wide).isfinite().all()


def build(make_block, shape, away=(0.0, 0.0)):
    """The block on a grid of another shape, at another place, in float64."""
    scene = make_block()
    block = scene.bodies[0]
    body = dataclasses.replace(block, particles=block.particles.moved(away))
    grid = dataclasses.replace(scene.grid, shape=shape)
    scene = dataclasses.replace(scene, grid=grid, bodies=[body])
    return softmpm.build(scene, device="cpu", dtype=torch.float64)


@pytest.mark.parametrize(
    "shape, away", [((13, 9), (0.3, 0.0)), ((40, 9), (2.5, 0.0)), ((14, 22), (0.03, 1.12))]
)
def test_a_track_of_any_size_gives_the_same_picture(make_block, shape, away):
    """Longer, higher, with odd and even nodes: the same motion elsewhere is the same picture, for the same encoder."""
    here, there = build(make_block, (13, 9)), build(make_block, shape, away)
    state = moving(here)
    moved = state._replace(x=state.x + torch.tensor(away, dtype=torch.float64))
    near, far = VelocityImage(here), VelocityImage(there)
    assert near.shape == far.shape
    seen = near(here, state)
    for picture in (near, far):
        torch.testing.assert_close(picture(there, moved), seen, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(picture(here, state), seen, rtol=1e-9, atol=1e-12)
    assert seen.abs().max() > 0.1


def test_a_picture_of_another_grid_is_refused(make_block):
    """Cells of another size have another window; the whole of another grid has another shape."""
    here, there = build(make_block, (13, 9)), build(make_block, (40, 9))
    scene = dataclasses.replace(here.scene, grid=dataclasses.replace(here.scene.grid, spacing=0.08))
    larger = softmpm.build(scene, device="cpu", dtype=torch.float64)
    with pytest.raises(
        ValueError, match=r"cells of 0\.1 m.*got a model with cells of 0\.08 m.*Build the observer again"
    ):
        VelocityImage(here)(larger, moving(larger))
    with pytest.raises(ValueError, match=r"of \(13, 9\) nodes; got a model with \(40, 9\).*Take follow=True"):
        VelocityImage(here, follow=False)(there, moving(there))


@pytest.mark.parametrize("nodes", [5, None])
def test_the_window_holds_the_robot_in_any_direction(make_block, nodes):
    """Turned and stretched, it shows all of the velocity on a grid that is large enough; three times as long, it does not."""
    model = build(make_block, (31, 31), (0.9, 1.0))
    picture, full = VelocityImage(model, nodes), VelocityImage(model, nodes=31, follow=False)
    middle = torch.tensor([1.5, 1.5]).double()  # a node, as in the window

    def share(angle: float, stretch: float) -> float:
        turn = torch.tensor(
            [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        ).double()
        rest = model.rest()
        x = middle + stretch * (model.positions - model.positions.mean(dim=0)) @ turn.T
        state = rest._replace(x=x[None], v=torch.ones_like(rest.v))
        return (picture.block**2 * picture(model, state).sum() / full(model, state).sum()).item()

    for angle in np.linspace(0, np.pi, 7):
        assert share(angle, 1.0) == pytest.approx(1.0, rel=1e-9), angle
    assert share(0.0, 1.2) == pytest.approx(1.0, rel=1e-9) and share(0.0, 3.0) < 0.8


def test_picture_shows_the_posture(exact):
    """None at rest, wherever the robot is; sheared, the velocity that would shear it in the given time; beside it the same velocity."""
    picture, velocity = VelocityImage(exact, posture=True), VelocityImage(exact)
    away = exact.rest()._replace(x=exact.rest().x + torch.tensor([0.13, 0.07]).double())
    assert picture.channels == 4 and picture(exact, away).abs().max() < 1e-12
    shear = torch.tensor([[0.0, 0.3], [0.0, 0.0]]).double()
    shift = (exact.positions - exact.positions.mean(dim=0)) @ shear.T
    state = moving(exact)._replace(x=(exact.positions + shift).expand(2, -1, -1))
    seen = picture(exact, state)
    torch.testing.assert_close(seen[:, :2], velocity(exact, state))
    state = exact.rest()._replace(x=state.x, v=(shift / 0.1).expand(2, -1, -1))
    torch.testing.assert_close(seen[:, 2:], velocity(exact, state))
    assert seen[:, 2].abs().max() > 0.1 and (seen[:, 3] == 0).all()


def test_picture_in_three_dimensions():
    """A 3D grid gives a 3D picture, components first, with the velocity of a uniform motion where the robot is."""
    model = softmpm.build(busy_scene(3), device="cpu", worlds=2)
    rest = model.rest()
    velocity = torch.tensor([0.3, -0.2, 0.1])
    picture = VelocityImage(model, nodes=6, follow=False)(model, rest._replace(v=rest.v + velocity))
    assert picture.shape == (2, 3, 6, 6, 5)
    brightest = picture[0].flatten(1)[:, picture[0, 0].argmax()]
    torch.testing.assert_close(brightest / brightest.norm(), velocity / velocity.norm(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["centroids", "latent", "latent with posture"])
def test_features_are_differentiable(exact, kind):
    """A central difference of the features along a random direction of x, v and C agrees with autograd."""
    torch.manual_seed(0)
    if kind == "centroids":
        observer = Centroids(exact, [np.arange(12)], body_length=0.4)
    else:
        picture = VelocityImage(exact, posture=kind == "latent with posture")
        linear = torch.nn.Linear(picture.channels * math.prod(picture.shape), 3)
        net = torch.nn.Sequential(torch.nn.Flatten(), linear, torch.nn.Tanh()).double()
        observer = Latent(picture, net, size=3)
    state, direction = moving(exact), [torch.randn_like(t) for t in exact.rest()[:4]]
    leaves = [t.clone().requires_grad_() for t in state[:4]]
    weight = torch.randn(2, observer.size, dtype=torch.float64)

    def value(h):
        return (
            weight
            * observer(exact, softmpm.State(*(t + h * d for t, d in zip(state[:4], direction, strict=True))))
        ).sum()

    gradient = torch.autograd.grad(
        (weight * observer(exact, softmpm.State(*leaves))).sum(), leaves, allow_unused=True
    )
    got = sum((g * d).sum() for g, d in zip(gradient, direction, strict=True) if g is not None)
    torch.testing.assert_close((value(1e-5) - value(-1e-5)) / 2e-5, got, rtol=1e-6, atol=1e-9)
