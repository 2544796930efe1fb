"""Pictures to particles, from arrays, files and Pillow images alike."""

import builtins
import warnings

import numpy as np
import PIL.Image
import pytest
from scipy.spatial import KDTree

from softmpm.scene.image import MOST_PIXELS
from softmpm.scene.shapes import box, image

L_SHAPE = np.array([[1, 0, 0], [1, 0, 0], [1, 1, 1]], dtype=bool)  # the top row first


def test_one_particle_for_each_pixel():
    """With spacing = height / rows every pixel inside gives one particle at its middle, y up."""
    particles = image(L_SHAPE, (1.0, 2.0), height=3.0, spacing=1.0)
    want = [(1.5, 2.5), (1.5, 3.5), (1.5, 4.5), (2.5, 2.5), (3.5, 2.5)]
    np.testing.assert_allclose(particles.positions, want, atol=1e-14)
    assert (particles.volume == 1.0).all()


@pytest.mark.parametrize("fine", [2, 3, 5])
def test_finer_lattice_keeps_the_area(fine):
    """A lattice that divides the pixels keeps the silhouette's area exactly, whatever the rounding."""
    rng = np.random.default_rng(0)
    mask = rng.random((17, 23)) < 0.4
    particles = image(mask, (0.1, 0.2), height=0.7, spacing=0.7 / 17 / fine)
    assert particles.volume.sum() == pytest.approx(mask.sum() * (0.7 / 17) ** 2, rel=1e-12)


def test_coarser_lattice_converges():
    """A disc drawn in pixels finer than the lattice has the disc's area to about one cell in fifty."""
    y, x = np.mgrid[-1:1:400j, -1:1:400j]
    particles = image(x**2 + y**2 < 0.8**2, (-1.0, -1.0), height=2.0, spacing=0.043)
    assert particles.volume.sum() == pytest.approx(np.pi * 0.64, rel=0.02)
    assert particles.positions.mean(axis=0) == pytest.approx((0.0, 0.0), abs=0.01)


@pytest.mark.parametrize("height", [0.6, 0.7, 1.3])
def test_half_covered_cells_count(height):
    """Of cells six pixels wide, those with three rows inside make a particle, those with two none."""
    half, third = (np.repeat([[True], [False]], [n, 6 - n], axis=0) & np.ones((6, 6), bool) for n in (3, 2))
    mask = np.tile(np.hstack([half, third]), (3, 3))
    particles = image(mask, (0.0, 0.0), height=height, spacing=height / 3)
    columns = np.round(particles.positions[:, 0] * 3 / height - 0.5).astype(int)
    assert len(particles) == 9 and (columns % 2 == 0).all()


@pytest.mark.parametrize("cut_cells", [False, True])
@pytest.mark.parametrize("spacing", [0.01, 0.023, 0.031])
def test_symmetric_pictures_have_symmetric_particles(spacing, cut_cells):
    """Places, volumes and outline mirror themselves, left to right, also where the width is no multiple of the spacing; upwards the
    lattice begins at the bottom."""
    half = np.random.default_rng(3).random((7, 9)) < 0.7
    mask = np.kron(np.hstack([half, half[:, ::-1]]), np.ones((5, 5))).astype(bool)  # a pixel is 0.01
    particles = image(mask, (1.0, 2.0), height=0.35, spacing=spacing, cut_cells=cut_cells)
    outline = particles.outline
    assert outline is not None
    for points, sizes in ((particles.positions, particles.volume), (outline.points, outline.areas)):
        apart, other = KDTree(points).query(points * (-1, 1) + (2 * 1.45, 0))
        assert apart.max() < 1e-12
        np.testing.assert_allclose(np.asarray(sizes)[other], sizes, rtol=1e-9)
    rows = (particles.positions[:, 1] - 2.0) / spacing - 0.5
    assert cut_cells or rows == pytest.approx(rows.round(), abs=1e-9)


def test_full_picture_is_a_box():
    """A picture that is inside everywhere is the box of its height and width."""
    particles = image(np.ones((4, 6), dtype=bool), (0.5, 0.25), height=1.0, spacing=0.125)
    want = box((0.5, 0.25), (2.0, 1.25), 0.125)
    np.testing.assert_allclose(particles.positions, want.positions, atol=1e-14)
    np.testing.assert_allclose(particles.volume, want.volume, rtol=1e-14)


def disc(pixels: int) -> np.ndarray:
    """A disc of radius 0.8 in a picture of height 2, sampled at the pixels' middles."""
    middle = (np.arange(pixels) + 0.5) * 2 / pixels - 1
    return np.hypot(middle[:, None], middle) < 0.8


def test_outline_of_a_disc_converges():
    """Perimeter and area of a disc whose pixels are a fifth of the spacing or finer, radial normals."""
    for spacing, tolerance in ((0.1, 0.006), (0.05, 0.002), (0.025, 0.001)):
        outline = image(disc(int(10 / spacing)), (-1.0, -1.0), height=2.0, spacing=spacing).outline
        assert outline is not None
        assert outline.areas.sum() == pytest.approx(1.6 * np.pi, rel=tolerance)
        assert outline.enclosed_volume == pytest.approx(0.64 * np.pi, rel=tolerance)
        assert np.linalg.norm(outline.areas @ outline.normals) < 1e-13
        radius = np.linalg.norm(outline.points, axis=1, keepdims=True)
        assert radius == pytest.approx(0.8, abs=0.1 * spacing)
        assert (outline.normals * outline.points / radius).sum(axis=1).min() > 0.97
        assert np.ptp(outline.areas) < 0.05 * spacing


def test_straight_sides_of_an_outline_are_exact():
    """Sides of a rectangle with a hole lie where its pixels end, wherever the lattice has its cells."""
    mask = np.zeros((60, 80), bool)
    mask[7:52, 11:71] = True
    mask[20:40, 30:50] = False
    for spacing in (0.03, 0.0415, 0.05):  # a pixel is 0.01
        outline = image(mask, (1.0, 2.0), height=0.6, spacing=spacing).outline
        assert outline is not None
        for n, offset in (((-1, 0), -1.11), ((1, 0), 1.71), ((0, -1), -2.08), ((0, 1), 2.53)):
            level = outline.normals @ n > 1 - 1e-12
            outer = level & (outline.points @ n > offset - 0.05)
            assert outer.sum() * spacing > 0.3
            assert outline.points[outer] @ n == pytest.approx(offset, abs=1e-12)
        corners = 8 * 0.25 * spacing**2  # each is cut by less than a quarter of a cell
        assert outline.enclosed_volume == pytest.approx(0.45 * 0.6 - 0.04, abs=corners)


def test_outline_of_the_l():
    """The outline of an L of pixels, upright and of its size; none for a silhouette that covers nowhere more than half a cell."""
    outline = image(L_SHAPE, (1.0, 2.0), height=3.0, spacing=0.1).outline
    assert outline is not None
    assert outline.enclosed_volume == pytest.approx(5.0, abs=6 * 0.0025)
    assert outline.areas.sum() == pytest.approx(12.0, rel=0.03)
    assert outline.points.max(axis=0) == pytest.approx((4.0, 5.0), abs=1e-12)
    assert outline.points[outline.points[:, 0] > 2.2][:, 1].max() == pytest.approx(3.0, abs=1e-12)
    half = np.array([[True, True], [False, False]])
    assert image(half, (0, 0), height=2.0, spacing=2.0).outline is None


def picture(mode: str) -> PIL.Image.Image:
    """The L in several ways to say it: ink on paper, chalk on slate, on nothing, 16 bits, floats."""
    ink = np.where(L_SHAPE, 30, 220).astype(np.uint8)
    if mode == "RGBA":  # mid-grey on transparent black: only opacity tells
        return PIL.Image.fromarray(np.dstack([np.full((3, 3, 3), 128, np.uint8), L_SHAPE * np.uint8(255)]))
    if mode == "I;16":
        return PIL.Image.fromarray(ink.astype(np.uint16) * 257)
    if mode == "F":
        return PIL.Image.fromarray((ink / 255).astype(np.float32))
    return PIL.Image.fromarray(ink).convert(mode)


@pytest.mark.parametrize("mode", ["L", "RGB", "P", "1", "I;16", "F"])
def test_dark_on_paper(mode):
    """Grey, colour, palette, one-bit, 16-bit and float pictures say the same."""
    want = image(L_SHAPE, (0, 0), height=3.0, spacing=1.0)
    got = image(picture(mode), (0, 0), height=3.0, spacing=1.0)
    np.testing.assert_array_equal(got.positions, want.positions)


def test_light_and_opaque():
    """Chalk on slate is ink on paper turned round; a transparent background is outside."""
    want = image(L_SHAPE, (0, 0), height=3.0, spacing=1.0).positions
    chalk = PIL.Image.fromarray(255 - np.asarray(picture("L")))
    for source, inside in ((chalk, "light"), (picture("RGBA"), "opaque"), (picture("RGBA"), "light")):
        got = image(source, (0, 0), height=3.0, spacing=1.0, inside=inside)
        np.testing.assert_array_equal(got.positions, want)


def test_transparent_is_paper():
    """Black ink on a transparent page, stored as black there too, leaves the page outside."""
    rgba = np.zeros((3, 3, 4), dtype=np.uint8)
    rgba[..., 3] = L_SHAPE * 255
    assert len(image(PIL.Image.fromarray(rgba), (0, 0), height=3.0, spacing=1.0)) == L_SHAPE.sum()


@pytest.mark.parametrize("mode", ["L", "RGBA", "I;16"])
def test_file(tmp_path, mode):
    """A PNG on disk gives what the picture in memory gives."""
    inside = "opaque" if mode == "RGBA" else "dark"
    picture(mode).save(tmp_path / "robot.png")
    want = image(picture(mode), (0, 0), height=3.0, spacing=0.5, inside=inside)
    for path in (tmp_path / "robot.png", str(tmp_path / "robot.png")):
        got = image(path, (0, 0), height=3.0, spacing=0.5, inside=inside)
        np.testing.assert_array_equal(got.positions, want.positions)


def test_grey_arrays_and_threshold():
    """uint8, uint16 and unit floats mean the same, and the threshold parts them."""
    ramp = np.tile(np.linspace(0, 1, 11), (2, 1))
    for array in (ramp, (ramp * 255).round().astype(np.uint8), (ramp * 65535).round().astype(np.uint16)):
        for threshold, count in ((0.05, 1), (0.35, 4), (0.95, 10)):
            assert len(image(array, (0, 0), height=2.0, spacing=1.0, threshold=threshold)) == 2 * count


@pytest.mark.parametrize(
    "source, changes, message",
    [
        (L_SHAPE, dict(inside="black"), "inside must be one of dark, light, opaque, got 'black'"),
        (L_SHAPE, dict(inside="opaque"), "an array has no transparency"),
        (L_SHAPE, dict(threshold=127), "threshold must lie between 0 and 1, got 127"),
        (L_SHAPE, dict(height=0.0), "height must be > 0 m"),
        (L_SHAPE, dict(height=np.nan), "height must be > 0 m"),
        (L_SHAPE, dict(lower=(0, 0, 0)), "a picture is flat"),
        (L_SHAPE, dict(height=1e7), "lattice cells"),
        (L_SHAPE, dict(spacing=100.0), "a particle is 100 pixels wide"),
        (np.zeros((3, 3), bool), {}, "leaves no particle: 0.0% of its pixels"),
        (np.zeros((3, 3, 3)), {}, r"shape \(row, column\), got \(3, 3, 3\)"),
        (np.zeros((0, 3)), {}, r"shape \(row, column\), got \(0, 3\)"),
        (np.full((3, 3), 200.0), {}, "floats from 0, black, to 1, white, got float64 from 200"),
        (np.full((3, 3), np.nan), {}, "floats from 0"),
        (np.full((3, 3), 200), {}, "got int64"),
        (picture("L"), dict(inside="opaque"), "the picture has no transparency"),
        (picture("I;16"), dict(inside="opaque"), "the picture has no transparency"),
    ],
)
def test_refuses(source, changes, message):
    """An image that is no silhouette is refused, with a remedy."""
    settings = dict(lower=(0, 0), height=3.0, spacing=0.05) | changes
    with pytest.raises(ValueError, match=message):
        image(source, **settings)


def test_missing_file(tmp_path):
    """A path without a file says so, also a folder."""
    for path in (tmp_path / "nothing.png", tmp_path):
        with pytest.raises(FileNotFoundError, match=rf"there is no picture file '{path}'\."):
            image(path, (0, 0), height=1.0, spacing=0.1)


def test_only_formats_of_pictures_are_opened(tmp_path, monkeypatch):
    """PostScript by the name of a PNG would start another program; here it is refused, as is a file of random bytes."""
    path = tmp_path / "robot.png"
    monkeypatch.setattr("subprocess.Popen", lambda *_, **__: pytest.fail("a program was started"))
    for data in (POSTSCRIPT, bytes(range(256))):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"robot\.png' cannot be read as a picture.* PNG, JPEG"):
            image(path, (0, 0), height=1.0, spacing=0.1)


POSTSCRIPT = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 10 10
%%EndComments
showpage
%%EOF
"""


def test_a_large_picture_is_refused_before_it_is_decoded(tmp_path):
    """A small file that unpacks to more pixels than the limit: named with its size and the limit, in no time."""
    path = tmp_path / "large.png"
    for width in (MOST_PIXELS // 1000 + 1, 10**5, 2 * 10**5):  # the last two are beyond Pillow's own limits
        PIL.Image.new("1", (width, 1000)).save(path)
        assert path.stat().st_size < 40_000
        with pytest.raises(
            ValueError, match=r"large\.png' (must have at most 33554432 pixels, got \d+ x 1000|is too large)"
        ):
            image(path, (0, 0), height=1.0, spacing=0.1)


@pytest.mark.parametrize("kind", ["png", "jpeg", "bmp", "gif", "tiff", "webp"])
def test_damaged_pictures_are_named(tmp_path, kind):
    """Cut anywhere or with a flipped bit: it is read, or refused with the name of the file."""
    path = tmp_path / f"robot.{kind}"
    PIL.Image.fromarray(np.kron(~L_SHAPE, np.ones((9, 9))).astype(np.uint8) * 255).save(path)
    whole = path.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 60).astype(int):
        for data in (whole[:place], whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :]):
            path.write_bytes(data)
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "ignore"
                )  # Pillow warns of notes beside the picture that it cannot read
                said = refusal(path)
            assert not said or "leaves no particle" in said or f"robot.{kind}" in said, said


def refusal(path) -> str:
    try:
        image(path, (0, 0), height=1.0, spacing=0.1)
    except ValueError as error:
        return str(error)
    return ""


def test_without_pillow(monkeypatch, tmp_path):
    """Arrays need no Pillow; a path without it says what to install."""
    found = builtins.__import__

    def without(name, *rest, **named):
        if name.startswith("PIL"):
            raise ImportError(name)
        return found(name, *rest, **named)

    monkeypatch.setattr(builtins, "__import__", without)
    assert len(image(L_SHAPE, (0, 0), height=3.0, spacing=1.0)) == 5
    with pytest.raises(ImportError, match="pip install pillow"):
        image(tmp_path / "robot.png", (0, 0), height=1.0, spacing=0.1)
