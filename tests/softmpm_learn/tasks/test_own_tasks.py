"""Robots from pictures, arrays of voxels and meshes: the right parts in the right places, one command to train, and errors by name."""

import csv
import dataclasses
import json
import logging
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from PIL import Image, ImageDraw
from scipy.spatial import KDTree

import softmpm
from softmpm_learn import plugins
from softmpm_learn.command import app
from softmpm_learn.command.experiment import finer
from softmpm_learn.objective import Tilt
from softmpm_learn.tasks import ImageConf, MeshConf, Resolution, VoxelsConf, make_task
from softmpm_learn.tasks.own import longer_axis
from softmpm_learn.tasks.thinness import thinnest

trimesh = pytest.importorskip("trimesh")
WALKER = np.array([[3, 3, 3], [2, 1, 2], [4, 0, 4]])
TINY = [
    *("experiment=smoke", "task.seconds=0.05", "task.control_period=0.025", "device=cpu"),
    *("learning.epochs=1", "learning.batches=1", "train.iterations=2"),
]


def table() -> Image.Image:
    """A grey board of 200 x 60 pixels on two legs of 30 x 40, red and green, with a dark bar on top, all on a margin of 20."""
    picture = Image.new("RGB", (240, 140), "white")
    draw = ImageDraw.Draw(picture)
    draw.rectangle((20, 20, 219, 79), fill="#808080")
    draw.rectangle((100, 20, 139, 29), fill="#101010")
    draw.rectangle((40, 80, 69, 119), fill="#f01010")
    draw.rectangle((170, 80, 199, 119), fill="#00c000")
    return picture


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    table().save("robot.png")
    np.save("robot.npy", WALKER)
    trimesh.creation.box((0.2, 0.08, 0.06)).export("robot.stl")  # x, y, z
    return tmp_path


def places(task) -> np.ndarray:
    """Rest positions from the lower corner of the robot."""
    found = np.concatenate([body.particles.positions for body in task.scene.bodies])
    corner = np.min([body.particles.outline.points.min(axis=0) for body in task.scene.bodies], axis=0)
    return found - corner


def volumes(task) -> np.ndarray:
    return np.concatenate([body.particles.volume for body in task.scene.bodies])


@pytest.fixture
def fresh_hydra(monkeypatch):
    monkeypatch.setattr(logging.getLogger(), "handlers", logging.getLogger().handlers[:])
    GlobalHydra.instance().clear()
    yield
    GlobalHydra.instance().clear()


@pytest.mark.usefixtures("fresh_hydra")
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("image", ("task.file=robot.png", "observer=centroids", "task.cells=50", "policy=linear")),
        ("voxels", ("task.file=robot.npy", "task.cells=40", "design=region")),
        ("mesh", ("task.file=robot.stl", "task.size=0.2", "task.track=1.5", "task.slabs=2")),
    ],
)
def test_one_command_trains(folder, monkeypatch, name, words):
    """Two iterations, with pictures, a recording and an examination on a finer grid."""
    command(monkeypatch, f"task={name}", *words, *TINY, "hydra.run.dir=run")
    with open("run/metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["loss"] != "" for row in rows] == [True, True, False]  # the last is the examination
    assert rows[0]["loss"] != rows[1]["loss"] and np.isfinite([float(row["loss"]) for row in rows[:2]]).all()
    for left in ("robot.png", "run.h5", "checkpoint.pt"):
        assert (folder / "run" / left).exists()


def command(monkeypatch, *words) -> None:
    """``python -m softmpm_learn`` in this process."""
    quiet = ("hydra/job_logging=none", "hydra/hydra_logging=none")
    monkeypatch.setattr(sys, "argv", ["softmpm_learn", *words, *quiet])
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)  # which the program sets
    app.main()


def refusal(monkeypatch, capsys, *words) -> str:
    """Message with which the command ends."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        command(monkeypatch, *words)
    assert stop.value.code == 1
    said = capsys.readouterr().err
    assert said.startswith("softmpm_learn: ") and said.count("\n") == 1, said
    return said


@pytest.mark.usefixtures("fresh_hydra")
def test_a_run_goes_on_from_another_folder(folder, monkeypatch, capsys):
    """The path of the picture is saved whole. Other bytes with the same pixels are the same robot; a picture that shows another one is
    named, and so is one that is gone.
    """
    words = ("task=image", "task.file=robot.png", "observer=centroids", "task.cells=50", "policy=linear")
    command(monkeypatch, *words, *TINY, "train.examine=false", "train.pictures=false", "hydra.run.dir=run")
    file, elsewhere = folder / "robot.png", folder / "elsewhere"
    assert f"file: {file}\n" in (folder / "run" / "config.yaml").read_text()
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    table().save(file, compress_level=0)
    command(monkeypatch, "resume=../run", "train.iterations=3")
    with open("../run/metrics.csv", newline="") as table_file:
        assert len(list(csv.DictReader(table_file))) == 3
    painted(c0000ff=(100, 40, 139, 60))
    Image.open("wrong.png").save(file)
    said = refusal(monkeypatch, capsys, "resume=../run")
    assert f"another robot: the file {file} has changed since; restore it" in said and len(said) < 300
    file.unlink()
    said = refusal(monkeypatch, capsys, "resume=../run")
    assert f"task.file = {file}: there is no such file; put it there, or correct the path" in said
    said = refusal(monkeypatch, capsys, "resume=../run", f"task.file={file}")
    assert "may change, not task.file." in said
    table().save("moved.png")
    config = folder / "run" / "config.yaml"
    config.write_text(config.read_text().replace(str(file), str(elsewhere / "moved.png")))
    command(monkeypatch, "resume=../run", "train.iterations=3")


def test_a_picture_is_a_robot(folder):
    """Areas, places, stiffness, fibres and regions are those of the drawing; the soles stand on the floor."""
    task = make_task(ImageConf(file="robot.png", size=0.4, cells=100))
    pixel = 0.4 / 200
    soft, stiff = task.scene.bodies
    assert stiff.material.young == 10 * soft.material.young
    assert stiff.particles.volume.sum() == pytest.approx(40 * 10 * pixel**2, rel=0.02)
    assert soft.particles.volume.sum() == pytest.approx((200 * 60 - 400 + 2 * 1200) * pixel**2, rel=0.01)
    assert list(task.regions) == ["red", "green", "body"] and task.scene.muscle_names == ("red", "green")
    x = places(task)
    for name, middle in (("red", 35), ("green", 165)):
        leg = x[task.regions[name]]
        np.testing.assert_allclose(leg.mean(axis=0), (middle * pixel, 20 * pixel), atol=1.5 * pixel)
        assert len(leg) == pytest.approx(1200 * pixel**2 / 0.005**2, rel=0.1)
    assert all(muscle.direction == pytest.approx((0.0, 1.0), abs=1e-9) for muscle in task.scene.muscles)
    assert len(np.concatenate(list(task.regions.values()))) == len(x)
    lowest = min(body.particles.outline.points[:, 1].min() for body in task.scene.bodies)
    assert lowest == pytest.approx(task.scene.walls[0].offset, abs=1e-9)


def test_two_settings_of_the_grid_are_refused(folder):
    """A mesh has cells of its own, and task.resolution would change nothing. A picture takes it, and has finer grids."""
    with pytest.raises(
        ValueError, match=r"task\.resolution=fine and task\.cells=40 both .* task\.cells=null"
    ):
        MeshConf(file="robot.stl", resolution=Resolution.fine)
    assert MeshConf(file="robot.stl", resolution=Resolution.fine, cells=None).cells_per_metre == 192
    conf = dataclasses.replace(ImageConf(file="robot.png"), resolution=Resolution.standard)
    assert conf.cells_per_metre == 128 and conf.refined().cells_per_metre == 192


@pytest.mark.parametrize("contact", ["surface", "nodes"])
def test_a_column_on_the_edge_of_two_slabs_belongs_to_one(folder, contact):
    """Every other one of eleven lies on an edge of the five slabs: as a whole it belongs to the one further along the axis."""
    trimesh.creation.box((0.275, 0.12, 0.12)).export("robot.stl")
    task = make_task(MeshConf(file="robot.stl", size=0.275, cells=20, slabs=5, contact=contact))
    column = (places(task)[:, 0] / 0.025).astype(int)
    slabs = [sorted(set(column[task.regions[f"slab{k}"]].tolist())) for k in range(5)]
    assert slabs == [[0, 1], [2, 3], [4, 5], [6, 7], [8, 9, 10]]


def test_the_torso_of_a_mesh_has_whole_rows(folder):
    """Of five rows the third has the median height, up to rounding: all of it belongs to the upper half of the robot."""
    trimesh.creation.box((0.3, 0.12, 0.12)).export("robot.stl")
    task = make_task(MeshConf(file="robot.stl", cells=20, slabs=3))
    (tilt,) = (term for term in task.objective.terms if isinstance(term, Tilt))
    rows = (places(task)[tilt.front, 1] / 0.025).astype(int)
    assert set(np.bincount(rows)[2:]) == {3 * 5} and not (rows < 2).any()


@pytest.mark.parametrize("size", [0.23, 0.25])
@pytest.mark.parametrize(
    "kind, file", [(ImageConf, "robot.png"), (VoxelsConf, "robot.npy"), (MeshConf, "robot.stl")]
)
def test_the_grid_is_symmetric_about_a_symmetric_robot(folder, kind, file, size):
    """Its particles mirror themselves, back to front, about a plane at a multiple of half a cell."""
    scene = make_task(kind(file=file, size=size, cells=35)).scene
    x = np.concatenate([body.particles.positions for body in scene.bodies])
    middle = (x[:, 0].min() + x[:, 0].max()) / 2
    assert 2 * middle / scene.grid.spacing == pytest.approx(round(2 * middle / scene.grid.spacing), abs=1e-9)
    mirrored = x.copy()
    mirrored[:, 0] = 2 * middle - x[:, 0]
    assert KDTree(x).query(mirrored)[0].max() < 1e-7


@pytest.mark.parametrize("rows", [[[4, 2, 2, 4]] * 2, [[3, 2, 2, 2, 3], [4, 0, 0, 0, 4], [4, 0, 0, 0, 4]]])
def test_muscles_of_symmetric_voxels_are_symmetric(folder, rows):
    """Also with particles on the edge of two voxels, or in an empty one as near to the one beside it as to the one above."""
    np.save("robot.npy", np.array(rows))
    task = make_task(VoxelsConf(file="robot.npy", size=0.275, cells=40, contact="nodes"))
    x = places(task)
    mirrored = x * (-1, 1) + (x[:, 0].min() + x[:, 0].max(), 0)
    other = KDTree(x).query(mirrored)[1]
    for row, column in np.argwhere(np.array(rows) >= 3):
        left = task.regions[f"voxel_{row}_{column}"]
        right = task.regions[f"voxel_{row}_{len(rows[0]) - 1 - column}"]
        assert sorted(other[left].tolist()) == sorted(right.tolist())


def test_a_symmetric_robot_at_rest_stays_in_its_place(folder):
    """Within 0.1 s on the floor it drifts by less than 0.1 µm in float32; by 93 µm a quarter of a cell further on."""
    task = make_task(VoxelsConf(file="robot.npy", size=0.25, cells=50))
    model = softmpm.build(task.scene, device="cpu", **task.build)
    still = torch.zeros(8, 1, len(task.scene.muscles))
    end = softmpm.simulate(model, model.rest(), still, model.params(), substeps=task.substeps)
    moved = (end.x[0] - model.positions).double().numpy()
    drift, sinking = volumes(task) @ moved / volumes(task).sum()
    assert abs(drift) < 1e-7 and sinking < -1e-3


@pytest.mark.parametrize("contact", ["surface", "nodes"])
def test_a_mesh_walks_in_the_middle_of_its_track(folder, contact):
    """Walls, grid and particles are symmetric about one plane of nodes, so nothing turns a symmetric robot to one side."""
    scene = make_task(MeshConf(file="robot.stl", cells=50, contact=contact)).scene
    middle, across = (scene.grid.shape[2] - 1) / 2, scene.bodies[0].particles.positions[:, 2]
    assert middle == round(middle)
    left, right = (wall.offset / scene.grid.spacing for wall in scene.walls[2:])
    assert left - right == pytest.approx(2 * middle)
    np.testing.assert_allclose(np.sort(across), np.sort(2 * middle * scene.grid.spacing - across), atol=1e-6)


def test_a_cell_that_two_bodies_share_by_halves_is_one_particle(folder):
    """Stiff voxels of 10.5 particles across fill the lattice as soft ones do, where nodes meet the floor and cells are not cut."""
    np.save("robot.npy", np.array([[1, 2, 1, 2], [3, 1, 2, 4]]))
    stiff, soft = (
        make_task(VoxelsConf(file="robot.npy", size=0.2625, contact="nodes", stiffness=stiffness))
        for stiffness in (10.0, 1.0)
    )
    found = [sorted(places(task).round(9).tolist()) for task in (stiff, soft)]
    assert len(stiff.scene.bodies) == 2 and found[0] == found[1]


def test_a_cell_that_three_bodies_share_by_thirds_is_one_particle(folder):
    """Of the first of them, where nodes meet the floor; a hole was there. Cells have three pixels, the band between the stiff half and
    the soft one is one pixel wide in its lower part."""
    pixels = np.full((30, 60, 3), (255, 0, 0), dtype=np.uint8)
    pixels[:, 31:] = (32, 32, 32)
    pixels[:15, 30:33] = pixels[15:, 31] = (128, 128, 128)
    Image.fromarray(pixels).save("bands.png")
    legend = dict(red=dict(colour="#ff0000", muscle=True), stiff=dict(colour="#202020", stiffness=10.0))
    legend["band"] = dict(colour="#808080", stiffness=3.0)
    task = make_task(ImageConf(file="bands.png", size=0.25, cells=40, contact="nodes", legend=legend))
    x, y = places(task).T
    assert len(x) == 200 and len(task.scene.bodies) == 3
    soft = len(task.scene.bodies[0].particles)
    assert (
        soft == 105
        and x[:soft].max() == pytest.approx(10.5 * 0.0125)
        and y[:soft][x[:soft] > 0.128].max() < 0.0625
    )


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_a_stiff_part_smaller_than_a_particle_is_named(folder, rows):
    """Where nodes meet the floor: one with half of its only cell or less has no particle; with more than half it has that one."""
    pixels = np.full((16, 40, 3), (255, 0, 0), dtype=np.uint8)
    pixels[4 : 4 + rows, 8:12] = (32, 32, 32)
    Image.fromarray(pixels).save("dot.png")
    legend = dict(red=dict(colour="#ff0000", muscle=True), dot=dict(colour="#202020", stiffness=10.0))
    conf = ImageConf(file="dot.png", size=0.2, cells=25, contact="nodes", legend=legend)
    if rows < 3:
        with pytest.raises(
            ValueError, match=r"dot of .*dot.png: no cell of 0.02 m .* increase task.size or task.cells"
        ):
            make_task(conf)
    else:
        assert [len(body.particles) for body in make_task(conf).scene.bodies] == [39, 1]


def test_a_limb_thinner_than_two_cells_is_named(folder, caplog):
    """Legs of 30 mm on cells of 12.5 mm are not; others are, with their width and the cells of which it has four."""
    for conf in (ImageConf(file="robot.png", size=0.2), VoxelsConf(file="robot.npy")):
        make_task(conf)
    assert not caplog.records
    painted(cffffff=(50, 80, 189, 119))  # leaves 10 mm of each leg
    make_task(ImageConf(file="wrong.png", size=0.2))
    np.save("long.npy", np.concatenate([WALKER, WALKER[-1:]]))
    make_task(VoxelsConf(file="long.npy", size=0.08))
    for record, width, cells in zip(caplog.records, ("0.01", "0.02"), ("0.8", "1.6"), strict=True):
        assert f"at most {width} m thick, {cells} cells of" in record.getMessage()
    assert "such as task.cells=400." in caplog.records[0].getMessage()


@pytest.mark.parametrize("surface", [False, True])
def test_a_thin_limb_of_a_mesh_is_named(folder, caplog, surface):
    """A body of six cells on plates of one cell, with particles at the centres of cells or of their parts inside; one of four is
    thick enough."""
    for thickness in (0.025, 0.1):
        parts = [trimesh.creation.box((0.4, 0.2, 0.16))]
        for x in (-0.1, 0.1):
            place = trimesh.transformations.translation_matrix((x, 0.0, -0.1))
            parts.append(trimesh.creation.box((thickness, 0.2, 0.2), place))
        trimesh.util.concatenate(parts).export("table.stl")
        make_task(MeshConf(file="table.stl", size=0.4, contact="surface" if surface else "nodes"))
    (record,) = caplog.records
    assert "table.stl is at most 0.025 m thick, 1.0 cells of 0.025 m;" in record.getMessage()


@pytest.mark.parametrize("width", [2, 4, 8, 12])
def test_the_thinnest_limb_is_found(width):
    """Below 16 pixels: a leg, and a neck between two discs; what is wider has none, whatever its corners."""
    body = np.zeros((140, 200), dtype=bool)
    body[:60] = True
    leg = body.copy()
    leg[:, 20 : 20 + width] = leg[:, 150:180] = True
    y, x = np.mgrid[:200, :200]
    discs = np.hypot(x - 40, y - 100) < 30
    discs |= np.hypot(x - 160, y - 100) < 30
    neck = discs | ((abs(y - 99.5) < width / 2) & (abs(x - 100) < 60))
    for mask in (leg, neck):
        assert thinnest(mask, 0.001, 0.016) == pytest.approx(0.001 * width)
    for mask in (body, discs, np.tri(200, dtype=bool)):
        assert thinnest(mask, 0.001, 0.016) is None


def pictures(neck: float) -> dict[str, np.ndarray]:
    """Squares of 16 cells, of 8 pixels each, with necks of this width [cells]: beside holes, between two, between notches or slits."""
    x, y = (np.mgrid[:128, :128] - 63.5) / 8
    found = {f"hole {r}": np.hypot(x, y - 8 + neck + r) > r for r in (1.25, 2.0, 5.0)}
    found["holes"] = np.hypot(abs(x) - 2 - neck / 2, y) > 2
    found["notches"] = abs(y) > abs(x) - neck / 2
    found["slits"] = (abs(y) > 0.6) | (abs(x) < neck / 2)
    found["slit"] = (abs(y) > 0.6) | (x > 8 - neck)
    return found


@pytest.mark.parametrize("neck", [0.5, 1.0, 1.5])
def test_necks_beside_holes_and_notches_are_found(neck):
    """Each is short, and at most as wide as said, to an eighth of two cells and the pixels; discs as wide as it pass through."""
    for name, mask in pictures(neck).items():
        assert neck <= thinnest(mask, 0.125, 2.0) <= neck + 0.5, name
        assert thinnest(mask, 0.125, neck) is None, name
    for name, mask in pictures(2.0).items():
        assert thinnest(mask, 0.125, 2.0) is None, name


@pytest.mark.parametrize("neck", [0.5, 1.0, 1.5, 2.0])
def test_thin_walls_beside_holes_are_found(neck):
    """In 3D: beside a hole through a block and a cavity in it, and in a tube that is thicker elsewhere. Voxels are half a cell."""
    x, y, z = (np.mgrid[:24, :24, :24] - 11.5) / 2
    hole = np.hypot(x, y - 4 + neck) > 2
    cavity = np.hypot(np.hypot(x, y - 4 + neck), z) > 2
    tube = (np.hypot(x, y) < 6) & (np.hypot(x, y - 3 + neck) > 3)
    for mask in (hole, cavity, tube):
        found = thinnest(mask, 0.5, 2.0)
        assert found is None if neck == 2.0 else found == pytest.approx(neck, abs=0.25)


def test_edges_and_notches_are_no_necks():
    """Cones and narrow notches at any place and angle to the pixels, of which some at tips and edges share a corner alone."""
    rng = np.random.default_rng(0)
    grid, flat = (np.mgrid[:40, :40, :40] - 19.5) / 2, (np.mgrid[:96, :96] - 47.5) / 4
    for angle in np.radians([60, 60, 75, 75, 75]):
        x, y, z = np.tensordot(np.linalg.qr(rng.normal(size=(3, 3)))[0], grid, 1) + rng.random((3, 1, 1, 1))
        assert thinnest((abs(z) < 4) & (np.hypot(x, y) < (4 - z) * np.tan(angle / 2)), 0.5, 2.0) is None
    for angle in np.radians([2, 5, 20, 60]):
        x, y = np.tensordot(np.linalg.qr(rng.normal(size=(2, 2)))[0], flat, 1) + rng.random((2, 1, 1))
        whole = (abs(x) < 7) & (abs(y) < 7)
        assert thinnest(whole & (abs(y) > x * np.tan(angle / 2)), 0.25, 2.0) is None


def test_blurred_edges_belong_to_the_nearest_part(folder):
    """A smaller copy with blended edges, transparent around, and a JPEG give the same areas to 6 %."""
    want = make_task(ImageConf(file="robot.png"))
    clear = table().convert("RGBA")
    clear.putalpha(
        Image.fromarray(np.where(np.asarray(table().convert("L")) == 255, 0, 255).astype(np.uint8))
    )
    clear.resize((150, 88), Image.Resampling.BILINEAR).save("clear.png")
    table().save("robot.jpg", quality=80)
    for file in ("clear.png", "robot.jpg"):
        got = make_task(ImageConf(file=file))
        for one, other in zip(got.scene.bodies, want.scene.bodies, strict=True):
            assert one.particles.volume.sum() == pytest.approx(other.particles.volume.sum(), rel=0.06)
        for name in ("red", "green"):
            area = [volumes(task)[task.regions[name]].sum() for task in (got, want)]
            assert area[0] == pytest.approx(area[1], rel=0.1)


def test_the_legend_decides(folder):
    """Angle and stiffness of a colour; the legend of conf/task/image.yaml is that of the settings."""
    app.register()
    from hydra import compose, initialize_config_dir

    from softmpm_learn.config import conf_dir, to_run

    with initialize_config_dir(conf_dir(), version_base="1.3"):
        words = ["task=image", "task.legend.red.angle=30", "task.legend.green.stiffness=2"]
        words.append('+task.legend.brown={colour:"#8b4513",muscle:true}')
        conf = to_run(compose("config", [*words, "task.file=robot.png"])).task
        plain = to_run(compose("config", ["task=image"])).task
    GlobalHydra.instance().clear()
    assert plain == ImageConf() and conf.legend["brown"].muscle
    task = make_task(conf)
    assert task.scene.muscles[0].direction == pytest.approx((np.sqrt(3) / 2, 0.5))
    assert [body.material.young / conf.young for body in task.scene.bodies] == [1.0, 2.0, 10.0]
    assert len(places(task)[task.scene.muscles[1].particles]) == len(task.scene.bodies[1].particles)


@pytest.mark.usefixtures("fresh_hydra")
@pytest.mark.parametrize(
    "word, says",
    [
        ("task.legend.rot.angle=90", "task.legend has no rot; known are passive, stiff, red, "),
        ("+task.legend.rot.angle=90", """purple. Add one with "+task.legend.rot={colour:'#rrggbb',muscle:true}"."""),
        ("+task.legend.rot=90", "task.legend has no rot; known are passive, stiff, red, "),
        ('+task.legend.brown={color:"#8b4513"}', "task.legend.brown has no color; known are colour, muscle, angle, stiffness."),
        ("+task.legend.brown={colour:5}", "a colour of task.legend must be #rrggbb, got 5."),
        ('+task.legend.brown={colour:"#8b 4513"}', "a colour of task.legend must be #rrggbb, got '#8b 4513'."),
        ('+task.legend.brown={colour:"#8b4513",muscle:9}', "muscle in task.legend must be true or false, got 9."),
        ('+task.legend.brown={colour:"#8b4513",angle:up}', "angle in task.legend must be a number of degrees or null, got 'up'."),
        ('+task.legend.brown={colour:"#8b4513",stiffness:x}', "stiffness in task.legend must be a number > 0, got 'x'."),
        ("+task.legend.red.angel=90", "there is no setting task.legend.red.angel; did you mean task.legend.red.angle?"),
        ("task.legend.red.angel=90", "there is no setting task.legend.red.angel; did you mean task.legend.red.angle?"),
    ],
)  # fmt: skip
def test_what_is_no_colour_of_the_legend_is_refused(folder, monkeypatch, capsys, word, says):
    """Misspelt names and fields, and values of other types; the sentence names what is known."""
    assert says in refusal(monkeypatch, capsys, "task=image", "task.file=robot.png", word)


def test_voxels_are_those_of_evolution_gym(folder):
    """Each voxel has its material, each actuator its own muscle and direction; lists are read as well."""
    (folder / "robot.json").write_text(json.dumps(WALKER.tolist()))
    for file in ("robot.npy", "robot.json"):
        task = make_task(VoxelsConf(file=file))
        soft, rigid = task.scene.bodies
        assert rigid.material.young == 10 * soft.material.young
        assert rigid.particles.volume.sum() == pytest.approx(
            0.01
        ) and soft.particles.volume.sum() == pytest.approx(0.07)
        x, middles = places(task), {}
        for name, muscle in zip(task.regions, task.scene.muscles, strict=False):
            middles[name] = (x[muscle.particles].mean(axis=0) / 0.1).round(2).tolist(), muscle.direction
        across, up = (1.0, 0.0), (0.0, 1.0)
        assert middles == {
            "voxel_0_0": ([0.5, 2.5], across),
            "voxel_0_1": ([1.5, 2.5], across),
            "voxel_0_2": ([2.5, 2.5], across),
            "voxel_2_0": ([0.5, 0.5], up),
            "voxel_2_2": ([2.5, 0.5], up),
        }
        assert task.scene.muscle_names[2:4] == ("horizontal actuator [0, 2]", "vertical actuator [2, 0]")


def test_a_picture_is_read_as_viewers_show_it(folder):
    """Turned by its EXIF orientation; colours of 16 bits, which would be cut, are refused by name."""
    with Image.open("robot.png") as picture:
        about = picture.getexif()
        about[0x0112] = 3  # upside down
        picture.transpose(Image.Transpose.ROTATE_180).save("turned.png", exif=about)
    want, got = (places(make_task(ImageConf(file=name))) for name in ("robot.png", "turned.png"))
    np.testing.assert_allclose(got, want, atol=1e-12)
    Image.fromarray(np.full((40, 60), 30_000, dtype=np.uint16)).save("deep.png")
    with pytest.raises(
        ValueError, match="deep.png cannot be read as a picture .*more than 8 bits for a colour"
    ):
        make_task(ImageConf(file="deep.png"))


def test_a_mesh_stands_on_the_floor_in_3d(folder):
    """Its z axis is up unless told otherwise; slabs and boxes are muscles; its volume is that of the mesh."""
    task = make_task(MeshConf(file="robot.stl", size=0.4, slabs=4))
    particles = task.scene.bodies[0].particles
    assert particles.volume.sum() == pytest.approx(8 * 0.2 * 0.08 * 0.06, rel=1e-3)
    assert np.ptp(particles.outline.points, axis=0) == pytest.approx((0.4, 0.12, 0.16), abs=0.03)
    assert particles.outline.points[:, 1].min() == pytest.approx(task.scene.walls[0].offset, abs=1e-6)
    x = places(task)
    assert task.scene.muscle_names == ("slab0", "slab1", "slab2", "slab3")
    for k in range(4):
        slab = x[task.regions[f"slab{k}"]]
        assert len(slab) == len(x) / 4 and 0.1 * k < slab[:, 0].min() < slab[:, 0].max() < 0.1 * (k + 1)
    boxes = {"left": [0, 0, 0.5, 1, 1, 1], "right": [0, 0, 0, 1, 0.4, 0.5]}
    task = make_task(MeshConf(file="robot.stl", up="y", boxes=boxes))
    x, muscle = places(task), task.scene.muscles[0]
    assert task.scene.muscle_names == ("left", "right")
    assert np.ptp(x[:, 1]) > np.ptp(x[:, 2]) and x[muscle.particles, 2].min() > x[:, 2].mean() - 0.01
    assert muscle.direction == pytest.approx((1, 0, 0), abs=1e-3) and list(task.regions) == [
        "left",
        "right",
        "body",
    ]


def test_a_finer_grid_has_half_as_many_cells_more(folder):
    """For the examination; without ``cells`` those of the resolution are taken."""
    conf = ImageConf(file="robot.png", cells=50)
    assert finer(conf).scene.grid.spacing == pytest.approx(1 / 75)
    assert ImageConf(resolution=Resolution.standard).spacing == 1 / 128


def test_the_longer_axis_is_that_of_the_pieces():
    """Two upright legs side by side have upright fibres; what is round has none and takes x."""
    x, y = np.meshgrid(np.arange(3.0), np.arange(9.0))
    leg = np.stack([x.ravel(), y.ravel()], axis=1)
    legs, piece = np.concatenate([leg, leg + (50, 0)]), np.repeat([1, 2], len(leg))
    assert longer_axis(legs, piece) == pytest.approx((0, 1)) and longer_axis(legs) == pytest.approx((1, 0))
    assert longer_axis(leg @ [[1, 0], [1, 1]]) == pytest.approx((0.72, 0.69), abs=0.05)
    assert longer_axis(leg[leg[:, 1] < 3]) == (1.0, 0.0)


def painted(**boxes: tuple) -> None:
    picture = table()
    for colour, box in boxes.items():
        ImageDraw.Draw(picture).rectangle(box, fill=f"#{colour[1:]}")
    picture.save("wrong.png")


def squeezed(kind: str) -> None:
    """The robot in a small picture of a lossy format, whatever the name of the file says."""
    table().resize((60, 35)).save("wrong.png", format=kind, quality=5)


@pytest.mark.parametrize(
    "make, kind, settings, says",
    [
        (lambda: None, ImageConf, dict(), "task image reads a picture of the robot: task.file=FILE"),
        (lambda: None, ImageConf, dict(file="none.png"), "task.file = .*/none.png: there is no such file"),
        (lambda: Path("robots").mkdir(), ImageConf, dict(file="robots"), "task.file = .*robots is a folder; name the file in it"),
        (lambda: None, ImageConf, dict(file="robot.npy"), "robot.npy cannot be read as a picture"),
        (
            lambda: painted(c8b4513=(30, 30, 49, 44)),
            ImageConf, dict(file="wrong.png"),
            r"has 2[0-9]{2} pixels of the colour #8b4513, which the legend lacks.*\"\+task.legend.NAME=\{colour:'#8b4513'",
        ),
        (lambda: painted(c8b4513=(50, 50, 52, 52)), ImageConf, dict(file="wrong.png"), "has 1 pixel of the colour"),
        (lambda: squeezed("JPEG"), ImageConf, dict(file="wrong.png"), "lacks; JPEG changes colours .*: save the drawing itself as PNG"),
        (lambda: squeezed("WEBP"), ImageConf, dict(file="wrong.png"), "lacks; WEBP changes colours .*: save the drawing itself as PNG"),
        (lambda: Image.new("RGB", (30, 30), "white").save("wrong.png"), ImageConf, dict(file="wrong.png"), "is empty"),
        (lambda: painted(cffffff=(0, 78, 239, 84)), ImageConf, dict(file="wrong.png"), "in 3 pieces.*fall apart"),
        (lambda: painted(cffffff=(0, 80, 239, 139)), ImageConf, dict(file="wrong.png"), "no muscle.*such as red #ff0000, or"),
        (lambda: None, ImageConf, dict(file="robot.png", size=2.0), "is 2 m long and 1 m high; the track of 7 m has room for"),
        (lambda: None, ImageConf, dict(file="robot.png", size=0.02), "too small for cells of 0.0125 m"),
        (lambda: painted(c0000ff=(30, 30, 33, 33)), ImageConf, dict(file="wrong.png", cells=20), "blue .* is smaller than a particle"),
        (lambda: np.save("wrong.npy", WALKER + 3), VoxelsConf, dict(file="wrong.npy"), "7 voxels other than 0 empty.*the first is 6"),
        (lambda: np.save("wrong.npy", np.zeros((2, 2))), VoxelsConf, dict(file="wrong.npy"), "is empty"),
        (lambda: np.save("wrong.npy", np.zeros(3)), VoxelsConf, dict(file="wrong.npy"), "of shape .row, column"),
        (lambda: None, VoxelsConf, dict(file="robot.png"), "robot.png must be an array .* .npy file.*task=image reads pictures.$"),
        (lambda: Path("wrong.json").write_text("[[1"), VoxelsConf, dict(file="wrong.json"), "cannot be read as lists.*line 1 column 4"),
        (lambda: Path("wrong.npy").write_bytes(b"PK\3\4"), VoxelsConf, dict(file="wrong.npy"), "wrong.npy must be an array"),
        (lambda: None, MeshConf, dict(file="robot.png"), "cannot be read as a mesh"),
        (lambda: trimesh.Trimesh(np.eye(3), [[0, 1, 2]]).export("open.stl"), MeshConf, dict(file="open.stl"), "the mesh is not closed"),
    ],
)  # fmt: skip
def test_what_is_no_robot_is_refused(folder, make, kind, settings, says):
    """Files that cannot be read, unknown colours and their count; what is empty, in pieces, without muscles, too large or small."""
    make()
    with pytest.raises(ValueError, match=says):
        make_task(kind(**settings))


@pytest.mark.parametrize(
    "kind, change, says",
    [
        (ImageConf, {"size": 0.0}, "task.size must be > 0"),
        (ImageConf, {"cells": 5}, "task.cells must be at least 20"),
        (ImageConf, {"tolerance": -1.0}, "task.tolerance must be ≥ 0"),
        (VoxelsConf, {"stiffness": 0.0}, "task.stiffness must be > 0"),
        (MeshConf, {"up": "x"}, "task.up must be one of z, y"),
        (MeshConf, {"slabs": 0}, "task.slabs must be at least 1"),
        (MeshConf, {"boxes": {"a": [0, 0, 0, 1, 1, 0]}}, "task.boxes.a must be six numbers"),
    ],
)
def test_a_wrong_setting_says_what_must_hold(kind, change, says):
    """Settings are checked where they are made."""
    with pytest.raises(ValueError, match=says):
        kind(**change)


def test_files_end_in_py():
    """A setting whose value is such a file is no file to import."""
    assert plugins.split(["a.py", "task.file=b.py", "x=1"]) == (["a.py"], ["task.file=b.py", "x=1"])
