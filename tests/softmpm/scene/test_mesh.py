"""Closed meshes to particles, against boxes, balls and solid angles."""

import builtins
import sys
import warnings

import numpy as np
import pytest

from softmpm.scene.mesh import closed_surface, mesh_coverage, winding_inside
from softmpm.scene.shapes import box, mesh

trimesh = pytest.importorskip("trimesh")


def test_box_mesh_is_a_box():
    """The mesh of a box whose sides are multiples of the spacing gives the box's own particles."""
    got = mesh(trimesh.creation.box(bounds=[(1.0, 2.0, 3.0), (1.5, 2.25, 4.0)]), 0.0625)
    want = box((1.0, 2.0, 3.0), (1.5, 2.25, 4.0), 0.0625)
    np.testing.assert_allclose(got.positions, want.positions, atol=1e-14)
    np.testing.assert_allclose(got.volume, want.volume, rtol=1e-14)


@pytest.mark.parametrize("cut_cells", [False, True])
def test_sides_may_be_multiples_of_the_spacing_in_single_precision(cut_cells):
    """As in STL files: a box of 12 x 4 x 4 cells, larger by rounding, has no layer of cells that begins or ends on its faces."""
    solid = trimesh.creation.box((0.3, 0.1, 0.1))
    solid.vertices = solid.vertices * (1 + 1e-7)
    particles = mesh(solid, 0.025, cut_cells=cut_cells)
    assert len(particles) == 12 * 4 * 4
    np.testing.assert_allclose(particles.volume, 0.025**3, rtol=1e-4)


@pytest.mark.parametrize("spacing, tolerance", [(0.2, 0.08), (0.07, 0.005)])
def test_volume_converges(spacing, tolerance):
    """The lattice's volume tends to the mesh's own."""
    solid = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    assert mesh(solid, spacing).volume.sum() == pytest.approx(solid.volume, rel=tolerance)


@pytest.mark.parametrize("spacing", [0.3, 0.05])
def test_outline_is_exact(spacing):
    """Whatever the spacing, the outline has the mesh's own area and volume, and unit normals; points are at most spacing² apart."""
    capsule, box_mesh = (
        trimesh.creation.capsule(height=1.0, radius=0.3),
        trimesh.creation.box((1.0, 0.5, 0.2)),
    )
    for solid in (capsule, box_mesh, trimesh.creation.torus(1.0, 0.4)):
        outline = mesh(solid, spacing).outline
        assert outline is not None
        assert outline.areas.sum() == pytest.approx(solid.area, rel=1e-12)
        assert outline.enclosed_volume == pytest.approx(solid.volume, rel=1e-12)
        assert outline.areas.max() <= spacing**2 * (1 + 1e-9)
        assert np.linalg.norm(outline.normals, axis=1) == pytest.approx(1.0, abs=1e-14)
        assert np.linalg.norm(outline.areas @ outline.normals) < 1e-12 * solid.area


def test_outline_of_parts():
    """Of parts that overlap only the free surface counts; that of a cavity does, with normals into it."""
    part = trimesh.creation.box(extents=(1, 1, 1))
    both = trimesh.util.concatenate(part, part.copy().apply_translation((0.5, 0.25, 0.25)))
    common = np.array((0.5, 0.75, 0.75))
    for spacing, tolerance in ((0.1, 0.05), (0.03, 0.015)):
        outline = mesh(both, spacing).outline
        assert outline is not None
        area = 12 - 2 * (common.prod() / common).sum()
        assert outline.areas.sum() == pytest.approx(area, rel=tolerance)
        assert outline.enclosed_volume == pytest.approx(2 - common.prod(), rel=tolerance)
    shell = trimesh.util.concatenate(part, trimesh.creation.box(extents=(0.5, 0.5, 0.5)))
    shell.faces[len(part.faces) :] = shell.faces[len(part.faces) :, ::-1]
    outline = mesh(shell, 0.1).outline
    assert outline is not None
    assert outline.areas.sum() == pytest.approx(7.5, rel=1e-12)
    assert outline.enclosed_volume == pytest.approx(0.875, rel=1e-12)


@pytest.mark.parametrize("spacing, tolerance", [(0.2, 2e-3), (0.1, 5e-4)])
def test_cut_cells(spacing, tolerance):
    """Volume and centre of mass of cut cells are those of the mesh, without slivers."""
    for solid in (trimesh.creation.icosphere(subdivisions=3), trimesh.creation.torus(1.0, 0.4)):
        solid.apply_translation((0.03, 0.01, 0.02))
        particles = mesh(solid, spacing, cut_cells=True)
        assert particles.volume.sum() == pytest.approx(solid.volume, rel=tolerance)
        assert particles.volume.min() >= 0.35 * spacing**3
        center = particles.volume @ particles.positions / particles.volume.sum()
        assert center == pytest.approx(solid.center_mass, abs=1e-3 * spacing)


def test_cut_cells_of_boxes():
    """Sides that end between the cells cost no more than the samples at the edges, also where a part ends within another one."""
    part = trimesh.creation.box(extents=(1, 1, 1))
    both = trimesh.util.concatenate(part, part.copy().apply_translation((0.5, 0.13, 0.2)))
    for solid, volume in ((part, 1.0), (both, 2 - 0.5 * 0.87 * 0.8)):
        for spacing in (0.25, 0.13):
            particles = mesh(solid, spacing, cut_cells=True)
            assert particles.volume.sum() == pytest.approx(volume, rel=4e-3)
    np.testing.assert_allclose(
        mesh(part, 0.25, cut_cells=True).positions, mesh(part, 0.25).positions, atol=1e-5
    )


@pytest.mark.parametrize("thickness, tolerance", [(0.02, 0.06), (0.1, 0.03), (0.3, 0.01)])
def test_thin_sheets_have_their_volume(thickness, tolerance):
    """Also where both faces cross the same sample of a cell, to the samples along its edges: it was 3.7 times as large at 0.02."""
    sheet = trimesh.creation.box(extents=(0.1, 0.1, 0.01 * thickness))
    sheet.apply_transform(trimesh.transformations.rotation_matrix(0.3, (1.0, 0.3, 0.0)))
    assert mesh(sheet, 0.01, cut_cells=True).volume.sum() == pytest.approx(1e-4 * thickness, rel=tolerance)


def test_a_sheet_ends_where_the_outside_begins():
    """A cube of four units around a point above a sheet of one: a quarter is full; with another sheet below, all below the face."""
    sheet = trimesh.creation.box(extents=(100.0, 100.0, 1.0))
    both = trimesh.util.concatenate(sheet, sheet.copy().apply_translation((0.0, 0.0, -0.9)))
    for solid, share in ((sheet, 0.25), (both, 0.425), (trimesh.creation.box(extents=(100.0,) * 3), 0.425)):
        above = np.array([(3.0, 1.0, solid.bounds[1, 2] + 0.3)])
        assert mesh_coverage(*closed_surface(solid), above, 4.0) == pytest.approx(share, abs=1e-5)


def test_inside_is_the_winding_number():
    """A ring and a capsule: each point is inside where the faces' solid angles add up to 4π."""
    rng = np.random.default_rng(0)
    for solid in (trimesh.creation.torus(1.0, 0.4), trimesh.creation.capsule(height=1.0, radius=0.3)):
        points = rng.uniform(*solid.bounds, (400, 3))
        corner = solid.triangles[None] - points[:, None, None]  # (point, face, corner, axis)
        a, b, c = np.moveaxis(corner, 2, 0)
        la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
        over = np.einsum("pfi,pfi->pf", a, np.cross(b, c))
        dots = [np.einsum("pfi,pfi->pf", u, w) for u, w in ((a, b), (b, c), (c, a))]
        angle = 2 * np.arctan2(over, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb)
        winding = angle.sum(axis=1) / (4 * np.pi)
        got = winding_inside(*closed_surface(solid), points)
        np.testing.assert_array_equal(got, winding > 0.5)
        assert 0.1 < got.mean() < 0.9


def test_place_and_size_do_not_matter():
    """A thousandth of the size, far from the origin, the same are inside: the query is scaled to one."""
    solid = trimesh.creation.icosphere(subdivisions=2)
    small = solid.copy().apply_scale(1e-3).apply_translation((10.0, 20.0, 30.0))
    want = mesh(solid, 0.25).positions
    got = (mesh(small, 0.25e-3).positions - (10.0, 20.0, 30.0)) * 1e3
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_inside_out_and_overlap():
    """A mesh whose faces all turn inwards holds the same particles; parts that overlap count once."""
    solid = trimesh.creation.box(extents=(1, 1, 1))
    inside_out = trimesh.Trimesh(solid.vertices, solid.faces[:, ::-1], process=False)
    np.testing.assert_array_equal(mesh(inside_out, 0.25).positions, mesh(solid, 0.25).positions)
    both = trimesh.util.concatenate(solid, solid.copy().apply_translation((0.5, 0, 0)))
    assert mesh(both, 0.25).volume.sum() == pytest.approx(1.5, rel=1e-12)


def cube(side, x=0.0, inverted=False):
    solid = trimesh.creation.box(extents=(side, side, side)).apply_translation((x, 0, 0))
    if inverted:
        solid.invert()
    return solid


@pytest.mark.parametrize(
    "parts, said",
    [
        ([(1, 0), (0.4, 1.5, True)], "1 of the mesh's 2 parts is"),  # apart
        ([(1, 0), (0.8, 0.7, True)], "1 of the mesh's 2 parts is"),  # it would carve a notch
        ([(1, 0), (0.4, 0.3, True)], "1 of the mesh's 2 parts is"),  # flush with the other
        ([(1, 0), (1, 1.5, True)], "1 of the mesh's 2 parts is"),  # together without volume
        ([(2, 0), (1, 0, True), (0.5, 0, True)], "1 of the mesh's 3 parts is"),  # the core of a cavity
        ([(2, 0), (1, 2, True), (1, -2, True), (1, 0, True)], "2 of the mesh's 4 parts are"),
        ([(2, 0, True), (1, 3)], "1 of the mesh's 2 parts is"),  # the larger one
    ],
)
def test_parts_turned_inside_out(parts, said):
    """A part that is inverted and no cavity is refused, not left out; turned as the message says, all parts are filled."""
    joined = trimesh.util.concatenate([cube(*part) for part in parts])
    with pytest.raises(ValueError, match=rf"^{said} turned inside out .*multibody=True.*part\.invert\(\)"):
        mesh(joined, 0.1)
    upright = mesh(trimesh.util.concatenate([cube(*part[:2]) for part in parts]), 0.1)
    trimesh.repair.fix_normals(joined, multibody=True)
    np.testing.assert_array_equal(mesh(joined, 0.1).positions, upright.positions)


@pytest.mark.parametrize("far", [0.0, 100.0])
@pytest.mark.parametrize(
    "parts, volume",
    [
        ([(2, 0), (1, 0, True)], 7),
        ([(2, 0, True), (1, 0)], 7),  # all turned the other way
        ([(2, 0), (1, 0, True), (0.6, 0)], 7 + 0.6**3),  # a core in the cavity
        ([(2, 0), (1, 0, True), (0.8, 0), (0.4, 0, True)], 7 + 0.8**3 - 0.4**3),
        ([(2, 0), (1, 0, True), (1, 1.3), (1, 2.3)], 7 + 1.8),  # others overlap and touch
        ([(2, 0), (0.4, 0.5, True), (0.4, -0.5, True)], 8 - 2 * 0.4**3),
        (
            [(1, 0), (1, 0.5), (0.4, 0.6, True)],
            1.5 - 0.4 * 0.4 * 0.4 + 0.4 * 0.4 * 0.1,
        ),  # where one part ends
    ],
)
def test_cavities(parts, volume, far):
    """A part turned inwards with material all around it is a cavity, within a cavity there may be a part, and so on."""
    joined = trimesh.util.concatenate([cube(*part) for part in parts])
    joined.apply_translation((far, 0, 0))
    assert mesh(joined, 0.05).volume.sum() == pytest.approx(volume, rel=2e-3)


def test_parts_within_a_part():
    """Small boxes that hide the way out along x, y and z from a point leave it inside: no ray is asked."""
    parts = [trimesh.creation.box(extents=(4, 4, 4))]
    for way in np.concatenate([np.eye(3), -np.eye(3)]):
        parts.append(trimesh.creation.box(extents=(0.5, 0.5, 0.5)).apply_translation(way))
    surface = closed_surface(trimesh.util.concatenate(parts))
    got = winding_inside(*surface, np.array([(0, 0, 0), (1, 0, 0), (1.5, 0, 0), (2.5, 0, 0)], dtype=float))
    assert got.tolist() == [True, True, True, False]


def test_file(tmp_path):
    """An STL file on disk gives what the mesh in memory gives."""
    solid = trimesh.creation.box(extents=(0.5, 0.25, 1.0))
    solid.export(tmp_path / "robot.stl")
    for path in (tmp_path / "robot.stl", str(tmp_path / "robot.stl")):
        np.testing.assert_array_equal(mesh(path, 0.125).positions, mesh(solid, 0.125).positions)


def broken(kind: str):
    solid = trimesh.creation.box()
    if kind == "open":
        return trimesh.Trimesh(solid.vertices, solid.faces[2:], process=False)
    if kind == "turned":
        faces = solid.faces.copy()
        faces[0] = faces[0, ::-1]
        return trimesh.Trimesh(solid.vertices, faces, process=False)
    return {"cloud": trimesh.PointCloud(solid.vertices), "empty": trimesh.Trimesh(), "array": solid.vertices}[
        kind
    ]


@pytest.mark.parametrize(
    "kind, message",
    [
        ("open", r"not closed: 4 of its 17 edges do not join two faces.*merge_vertices"),
        ("turned", "do not all turn the same way.*fix_normals"),
        ("cloud", "path or a trimesh.Trimesh with faces, got PointCloud"),
        ("empty", "path or a trimesh.Trimesh with faces, got Trimesh"),
        ("array", "path or a trimesh.Trimesh with faces, got"),
    ],
)
def test_refuses(kind, message):
    """A mesh that has no inside is refused, with what to try."""
    with pytest.raises(ValueError, match=message):
        mesh(broken(kind), 0.1)


def test_refuses_size():
    """Millimetres read as metres are caught before memory is taken; a mesh between the particles is named."""
    with pytest.raises(ValueError, match="lattice cells.*metres"):
        mesh(trimesh.creation.box(extents=(100, 100, 100)), 0.01)
    with pytest.raises(ValueError, match="spacing must be > 0"):
        mesh(trimesh.creation.box(), -1.0)
    corner = trimesh.Trimesh(
        [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    )
    with pytest.raises(ValueError, match="lies between its particles"):
        mesh(corner, 1.0)


def test_missing_file_and_library(monkeypatch, tmp_path):
    """A path without a file says so; a file without trimesh says what to install."""
    with pytest.raises(FileNotFoundError, match="nothing.stl"):
        mesh(tmp_path / "nothing.stl", 0.1)
    found = builtins.__import__

    def without(name, *rest, **named):
        if name == "trimesh":
            raise ImportError(name)
        return found(name, *rest, **named)

    path = tmp_path / "robot.stl"
    path.write_bytes(b"")
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r'pip install "softmpm\[mesh\]"'):
        mesh(path, 0.1)


@pytest.mark.parametrize(
    "spoil, said",
    [
        (lambda v: np.where(v > 0.4, np.nan, v), "vertices must be finite .* got nan m"),
        (lambda v: v * 1e30, "lattice cells along an axis, .* all lengths are in metres"),
        (
            lambda v: v + 1e30,
            "million times its smallest side, got 1e.30 m and 0 m: .* move it to the origin",
        ),
    ],
)
def test_places_that_numbers_do_not_hold(spoil, said):
    """A mesh with NaN, too large or too far away is refused for what it is."""
    solid = trimesh.creation.box(bounds=[(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
    with pytest.raises(ValueError, match=said):
        mesh(trimesh.Trimesh(spoil(solid.vertices), solid.faces, process=False), 0.1)


def test_a_mesh_moved_to_the_origin_is_taken():
    """As the message recommends."""
    solid = trimesh.creation.box(bounds=[(1e7, 0, 0), (1e7 + 1, 1, 1)])
    with pytest.raises(ValueError, match="apply_translation"):
        mesh(solid, 0.25)
    assert len(mesh(solid.apply_translation(-solid.centroid), 0.25)) == 64


@pytest.mark.parametrize("kind", ["stl", "obj", "glb", "ply", "off"])
def test_damaged_files_are_named(tmp_path, kind):
    """Random bytes, cuts and flipped bits: the file is read, or refused in a sentence; never the error of a parser."""
    path, chance = tmp_path / f"robot.{kind}", np.random.default_rng(0)
    trimesh.creation.box().export(path)
    whole, refused = path.read_bytes(), []
    assert len(closed_surface(path)[1]) == 12
    for place in np.linspace(0, len(whole) - 1, 25).astype(int):
        flipped = whole[:place] + bytes([whole[place] ^ 128]) + whole[place + 1 :]
        for data in (whole[:place], flipped, chance.bytes(place)):
            path.write_bytes(data)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    closed_surface(path)
                except (ValueError, ImportError) as error:
                    refused.append(str(error))
    assert len(refused) > 30, len(refused)


def test_a_missing_part_of_trimesh_is_named(tmp_path, monkeypatch):
    """Some files need more than trimesh itself: the error says which file, which package, and what installs it."""
    path = tmp_path / "robot.obj"
    path.write_bytes(b"\xff\xfe v")
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)
    with pytest.raises(
        ImportError,
        match=r'''robot\.obj' needs the package charset_normalizer: pip install "softmpm\[mesh\]"''',
    ):
        closed_surface(path)
