"""Cut cells: volumes and centroids of the parts that a shape cuts, and slivers that join a neighbour."""

import math

import numpy as np
import pytest

from softmpm.scene.cut_cells import SLIVER, inner_parts, merge_slivers, sample_points, share_inside
from softmpm.scene.shapes import ball, image


def test_sample_points():
    """Four samples along each axis at the middles of quarters, the last axis fastest, with the cell's own centroid."""
    points = sample_points(np.array([(1.0, 2.0), (3.0, 4.0)]), 0.8)
    assert points.shape == (2, 16, 2)
    np.testing.assert_allclose(points[0, :5], [(0.7, 1.7), (0.7, 1.9), (0.7, 2.1), (0.7, 2.3), (0.9, 1.7)])
    np.testing.assert_allclose(points.mean(axis=1), [(1.0, 2.0), (3.0, 4.0)])


@pytest.mark.parametrize("dim", [2, 3])
def test_plane_along_an_axis_is_exact(dim):
    """A plane across a cell cuts the share below it, wherever it is; the centroid is that of the samples' parts."""
    middles, spacing = np.zeros((1, dim)), 0.2
    for level in np.linspace(-0.12, 0.12, 25):
        samples = sample_points(middles, spacing)
        share, centroid = inner_parts(middles, share_inside(samples[..., 1] - level, 0.05), spacing)
        want = np.clip(level / spacing + 0.5, 0.0, 1.0)
        assert share == pytest.approx(want, abs=1e-12)
        if want > 0:
            assert centroid[0, 1] == pytest.approx((max(min(level, 0.1), -0.1) - 0.1) / 2, abs=0.5 * 0.05)
            assert np.delete(centroid[0], 1) == pytest.approx(0.0, abs=1e-15)


def test_a_sheet_within_a_sample_is_exact():
    """Its share of the cube around the sample is its thickness, as far as it lies in it, on whichever side the sample's middle is."""
    width, lower = 0.05, np.linspace(-0.06, 0.06, 49)
    for thickness in (0.002, 0.02, 0.049, 0.2):
        upper = lower + thickness
        distance, nearer = np.maximum(lower, -upper), np.minimum(np.abs(lower), np.abs(upper))
        assert np.abs(distance) == pytest.approx(nearer, abs=1e-15)
        want = np.clip(upper, -width / 2, width / 2) - np.clip(lower, -width / 2, width / 2)
        assert share_inside(distance, width, thickness) == pytest.approx(want / width, abs=1e-12)


def test_slivers_join_their_fullest_neighbour():
    """A sliver above two cells joins the full one, moves its centroid and leaves the volume as it is; a sliver alone stays."""
    share = np.zeros((5, 3))
    share[0, 0], share[1, 0], share[0, 1], share[1, 1] = 0.5, 1.0, 0.2, 0.5
    share[4, 2] = 0.1
    centroid = np.stack(np.meshgrid(np.arange(5.0), np.arange(3.0), indexing="ij"), axis=-1).reshape(-1, 2)
    positions, volume = merge_slivers(share.ravel(), centroid, np.array((5, 3)), 2.0)
    np.testing.assert_allclose(volume, [2.0, 4.8, 2.0, 0.4])
    np.testing.assert_allclose(positions, [(0, 0), (1.0 / 1.2, 0.2 / 1.2), (1, 1), (4, 2)], atol=1e-15)


def test_nearest_of_equal_neighbours():
    """Above a row of full cells a sliver joins the one below it, not one beside that."""
    share, count = np.array([[1.0, 0.2]] * 3), np.array((3, 2))
    centroid = np.array([(i, j) for i in range(3) for j in range(2)], dtype=float)
    positions, volume = merge_slivers(share.ravel(), centroid, count, 1.0)
    np.testing.assert_allclose(volume, 1.2)
    np.testing.assert_allclose(positions[:, 0], [0, 1, 2], atol=1e-15)


def test_equal_neighbours_share_a_sliver():
    """Between two full cells a sliver joins each by halves; one at the limit is none on either side, whatever its rounding."""
    share = np.array([1.0, 0.2, 1.0, 0.0, SLIVER - 1e-15, 1.0, SLIVER + 1e-15])
    centroid = np.stack([np.arange(7.0), np.zeros(7)], axis=1)
    positions, volume = merge_slivers(share, centroid, np.array((7, 1)), 1.0)
    np.testing.assert_allclose(volume, [1.1, 1.1, SLIVER, 1.0, SLIVER])
    np.testing.assert_allclose(positions[:, 0], [0.1 / 1.1, 2 - 0.1 / 1.1, 4, 5, 6])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("stretch", [(1.0, 1.0, 1.0), (1.0, 0.5, 0.7)])
def test_ball(dim, stretch):
    """Volume within 1e-3 from ten cells across, and converging; exact centre; no slivers; second moments converge."""
    radii = 0.2 * np.array(stretch[:dim])
    volume = (math.pi if dim == 2 else 4 / 3 * math.pi) * radii.prod()
    for spacing, tolerance in ((0.02, 5e-4), (0.01, 1e-4)):
        particles = ball((0.5,) * dim, radii, spacing, cut_cells=True)
        assert particles.volume.sum() == pytest.approx(volume, rel=tolerance)
        assert particles.volume.min() >= SLIVER * spacing**dim * (1 - 1e-12)
        assert particles.volume.max() < 2 * spacing**dim
        center = particles.volume @ particles.positions / particles.volume.sum()
        assert center == pytest.approx((0.5,) * dim, abs=1e-12)
        assert ((((particles.positions - 0.5) / radii) ** 2).sum(axis=1) < 1.0).all()
        second = particles.volume @ (particles.positions - 0.5) ** 2
        want = volume * radii**2 / (dim + 2)
        assert second == pytest.approx(want, rel=2 * (spacing / radii.min()) ** 2)
        outline = particles.outline
        assert outline is not None
        assert particles.volume.sum() == pytest.approx(outline.enclosed_volume, rel=tolerance)


def test_small_ball():
    """A ball between the particles of a lattice is four cut cells, with its volume to a few per cent."""
    particles = ball((0.0, 0.0), 0.06, 0.1, cut_cells=True)
    assert len(particles) == 4 and particles.volume.sum() == pytest.approx(math.pi * 0.06**2, rel=0.06)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("thickness", [0.05, 0.2, 0.9])
def test_flat_ball(dim, thickness):
    """An ellipsoid thinner than the samples of a cell has its volume; it was 1.4 times as large at 0.1 spacings."""
    radii = (*(0.1,) * (dim - 1), thickness * 0.01)
    particles = ball((0.5,) * dim, radii, 0.01, cut_cells=True)
    volume = (math.pi if dim == 2 else 4 / 3 * math.pi) * math.prod(radii)
    assert particles.volume.sum() == pytest.approx(volume, rel=1e-12)


def test_image_volume_is_exact():
    """The particles' volume and centre of mass are those of the pixels, whatever the spacing; also at the picture's edges."""
    rng = np.random.default_rng(0)
    mask = np.kron(rng.random((6, 8)) < 0.6, np.ones((9, 9))).astype(bool)
    y, x = (np.argwhere(mask) + 0.5).T * 0.01
    center = (1.0 + x.mean(), 2.0 + 0.54 - y.mean())
    for spacing in (0.04, 0.031, 0.0123):
        particles = image(mask, (1.0, 2.0), height=0.54, spacing=spacing, cut_cells=True)
        assert particles.volume.sum() == pytest.approx(mask.sum() * 1e-4, rel=1e-5)
        got = particles.volume @ particles.positions / particles.volume.sum()
        assert got == pytest.approx(center, abs=0.02 * spacing)


def test_image_agrees_with_its_outline():
    """A disc drawn in fine pixels: volume within 1e-3 of π r², of its outline within the sampling, no slivers."""
    middle = (np.arange(400) + 0.5) / 200 - 1
    mask = np.hypot(middle[:, None], middle) < 0.8
    particles = image(mask, (-1.0, -1.0), height=2.0, spacing=0.05, cut_cells=True)
    assert particles.volume.sum() == pytest.approx(0.64 * math.pi, rel=1e-3)
    assert particles.volume.min() >= SLIVER * 0.05**2
    assert particles.outline is not None
    assert particles.volume.sum() == pytest.approx(particles.outline.enclosed_volume, rel=2e-3)
