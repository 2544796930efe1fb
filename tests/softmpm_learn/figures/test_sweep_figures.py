"""Tables and figures of sweeps: made by hand, with medians, differences and intervals known from elsewhere."""

import csv
import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from hydra.core.override_parser.overrides_parser import OverridesParser
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softmpm_learn.figures import __main__ as program
from softmpm_learn.figures.canvas import COLOURS
from softmpm_learn.figures.intervals import interval, pairs, stands_out
from softmpm_learn.figures.summary import passes
from softmpm_learn.figures.sweeps import EXAMINED, parse

LATENT, KMEANS = (-1.0, -2.0, -4.0), (-0.5, -2.5, -1.0)
"""Losses of three seeds at the last iteration of each setting: medians -2 and -1, mean of the paired differences -1."""
COLUMNS = ["job", "status", "loss", "iteration", "iterations", *EXAMINED, "settings", "folder", "error"]


def table(path: Path, columns, rows) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def metrics(folder: Path, losses, **examination) -> None:
    """A row for each loss, with a best so far that is lower, and one of the examination."""
    rows = [
        {"iteration": k, "loss": v, "progress": v - 0.25, "effort": 0.25, "best": -9.0}
        for k, v in enumerate(losses)
    ]
    rows += [{"iteration": len(losses), **examination}] if examination else []
    table(folder / "metrics.csv", ["iteration", "loss", "progress", "effort", "best", *EXAMINED], rows)


def make_sweep(folder: Path, groups, *, failing=(), **more) -> Path:
    """A sweep of jobs that take three iterations: loss 1, 0.5, and that of the group."""
    rows = []
    for (name, losses), seed in itertools.product(groups.items(), range(3)):
        job = len(rows)
        settings = f"task=elephant {name} train.seed={seed}"
        row = {"job": job, "status": "finished", "settings": settings, "folder": f"/elsewhere/{job}"}
        row |= {"later": 0.9 + 0.01 * job, "largest_tilt": 5.0 + job, "loss": -9.0, "iterations": 3, **more}
        last = [1.0, 0.5, losses[seed]]
        if job in failing:
            row |= {"status": "failed", "loss": "inf", "later": "", "largest_tilt": "", "error": "it broke"}
            last = [1.0]
        metrics(folder / str(job), last, **({} if job in failing else {"later": 0.9}))
        rows.append(row)
    table(folder / "sweep.csv", COLUMNS, rows)
    return folder


@pytest.fixture
def swept(tmp_path) -> Path:
    return make_sweep(tmp_path / "sweep", {"observer=latent": LATENT, "observer=kmeans": KMEANS})


@pytest.fixture
def drawn(monkeypatch) -> dict[str, Figure]:
    """Figures by the name of their file."""
    found, real = {}, Figure.savefig

    def save(self, *args, **kwargs):
        found[len(found)] = self
        return real(self, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", save)
    return found


def test_a_row_for_each_run_and_iteration(swept, tmp_path):
    """With what differs between the jobs, and nothing that does not; moved folders are found."""
    program.make([swept], tmp_path / "out")
    rows, jobs = read(tmp_path / "out" / "runs.csv"), read(tmp_path / "out" / "jobs.csv")
    assert len(rows) == 18 and len(jobs) == 6
    assert list(rows[0]) == [
        *("run", "sweep", "job", "seed", "observer", "iteration", "loss", "progress", "effort", "best")
    ]
    last = [row for row in rows if row["iteration"] == "2"]
    assert [(row["observer"], row["seed"], float(row["loss"])) for row in last] == [
        *(("latent", str(k), LATENT[k]) for k in range(3)),
        *(("kmeans", str(k), KMEANS[k]) for k in range(3)),
    ]
    assert [(float(row["final"]), float(row["best"]), float(row["later"]), row["at"]) for row in jobs] == [
        (loss, min(loss, 0.5), pytest.approx(0.9 + 0.01 * k), "2") for k, loss in enumerate(LATENT + KMEANS)
    ]
    assert {row["term"] for row in jobs} == {"progress"} and jobs[0]["kicked"] == ""


def test_a_spike_does_not_flatten_the_curves(swept, tmp_path, drawn):
    """Of two seeds of one setting, at one iteration: the axis has the other values, and marks the place and the value in its colour."""
    for job in range(6):
        losses = np.linspace(0.0, -1.0, 100)
        losses[60] += 5e4 * (job < 2)
        metrics(swept / str(job), losses)
    program.make([swept], tmp_path)
    axes = drawn[0].axes[0]
    assert axes.get_ylim() == pytest.approx((-1.0, 0.0), abs=0.2)
    marks = [(*line.get_xdata(), line.get_color()) for line in axes.lines if line.get_marker() == "^"]
    assert set(marks) == {(60, COLOURS[0])} and axes.get_title(loc="right") == "▲ up to 5e+04"


def test_settings_are_compared_seed_by_seed(swept, tmp_path):
    """Mean differences by hand; the interval of three pairs lies between the extremes."""
    program.make([swept], tmp_path)
    final, later, tilt = read(tmp_path / "pairs.csv")
    differences = [a - b for a, b in zip(LATENT, KMEANS, strict=True)]
    assert (final["first"], final["second"]) == ("observer=latent", "observer=kmeans")
    assert float(final["difference"]) == pytest.approx(np.mean(differences))
    assert (final["pairs"], final["first_lower"]) == ("3", "2")
    assert min(differences) <= float(final["low"]) < float(final["high"]) <= max(differences)
    assert (later["quantity"], tilt["quantity"]) == ("later", "largest_tilt")
    assert float(tilt["difference"]) == float(tilt["low"]) == float(tilt["high"]) == -3.0


def test_the_interval_is_that_of_scipy_and_of_enumeration():
    """Paired by scipy from other random numbers, within their scatter; of three values from all 27 samples."""
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=10), rng.normal(1.0, size=10)
    (row,) = pairs({"a": dict(enumerate(a)), "b": dict(enumerate(b))}, "final")
    other = scipy.stats.bootstrap(
        *((a, b), lambda x, y, axis: np.mean(x - y, axis=axis)),
        paired=True,
        n_resamples=100_000,
        method="percentile",
        rng=np.random.default_rng(1),
    )
    scatter = 0.03 * np.std(a - b)  # of a quantile of 10,000 means of ten: about 0.008
    assert (row["low"], row["high"]) == pytest.approx(tuple(other.confidence_interval), abs=scatter)
    medians = [np.median(sample) for sample in itertools.product(LATENT, repeat=3)]
    expected = np.quantile(np.repeat(medians, 1000), [0.025, 0.975])
    assert interval(LATENT, np.median) == pytest.approx(tuple(expected))
    assert all(map(math.isnan, interval([1.0])))


def test_answers_are_compared_by_medians(tmp_path, drawn):
    """One quotient out of bounds neither carries the difference away nor squeezes the others in the picture, which counts it."""
    folder = make_sweep(tmp_path, {"observer=latent": LATENT, "observer=kmeans": KMEANS})
    rows = read(folder / "sweep.csv")
    for row, later in zip(rows, (0.9, 0.8, 900.0, 0.6, 0.6, 0.6), strict=True):
        row |= {"later": later}
    table(folder / "sweep.csv", COLUMNS, rows)
    program.make([folder], tmp_path / "out")
    found = {row["quantity"]: row for row in read(tmp_path / "out" / "pairs.csv")}
    assert float(found["later"]["difference"]) == pytest.approx(0.3)
    assert float(found["final"]["difference"]) == pytest.approx(-7 / 3 + 4 / 3)
    assert drawn[1].axes[1].get_xlim()[1] == drawn[2].axes[1].get_xlim()[1] == 3.0
    assert drawn[1].axes[2].get_xlim()[1] > 10.0  # degrees are no quotients
    assert [axes.get_title(loc="right") for axes in drawn[1].axes[:3]] == ["", "1 outside", ""]


def test_settings_without_a_common_seed_have_no_picture_of_differences(tmp_path, drawn):
    """All seeds of one have failed; of the other one is left, whose median has no interval."""
    folder = make_sweep(tmp_path, {"observer=latent": LATENT, "observer=kmeans": KMEANS}, failing=range(5))
    text = program.make([folder], tmp_path / "out")
    assert len(drawn) == 2 and not (tmp_path / "out" / "pairs.png").exists()
    assert "latent: none, 0 of 3 seeds" in text and "kmeans: -1, 1 of 3 seeds" in text and "nan" not in text


def test_pairs_take_only_seeds_that_both_have():
    """A seed that failed in one setting counts in neither; without a common seed there is no difference."""
    groups = {"a": {0: 1.0, 1: 2.0, 3: math.nan}, "b": {1: 5.0, 2: 7.0, 3: 1.0}, "c": {9: 0.0}}
    rows = pairs(groups, "final")
    assert [(row["first"], row["second"], row["pairs"]) for row in rows] == [
        ("a", "b", 1),
        ("a", "c", 0),
        ("b", "c", 0),
    ]
    assert rows[0]["difference"] == -3.0 and math.isnan(rows[0]["low"]) and math.isnan(rows[1]["difference"])


def line(axes: Axes, label: str):
    (found,) = [one for one in axes.lines if str(one.get_label()).startswith(label)]
    return found


def test_curves_are_medians_at_each_iteration(tmp_path, drawn):
    """Not best so far; a run that failed is counted in the legend and has no part in the curve."""
    groups = {"observer=latent": (-1.0, -2.0, -4.0), "observer=kmeans": (-1.0, -3.0, 5.0)}
    folder = make_sweep(tmp_path, groups, failing=[4])
    said = program.make([folder], tmp_path / "out")
    (axes,) = drawn[0].axes
    latent, kmeans = line(axes, "observer=latent"), line(axes, "observer=kmeans")
    assert list(latent.get_xdata()) == [0, 1, 2] and list(latent.get_ydata()) == [1.0, 0.5, -2.0]
    assert list(kmeans.get_ydata()) == [1.0, 0.5, 2.0]
    assert latent.get_label() == "observer=latent (3 seeds)"
    assert kmeans.get_label() == "observer=kmeans (2 of 3 seeds, 1 failed)"
    low, high = axes.collections[0].get_datalim(axes.transData).intervaly
    assert low == pytest.approx(-3.0) and high == pytest.approx(1.0)  # quartile of -4, -2, -1
    assert "observer=kmeans: 2 [-1, 5], 2 of 3 seeds" in said
    failed = read(tmp_path / "out" / "jobs.csv")[4]
    assert (failed["status"], failed["final"], failed["error"]) == ("failed", "", "it broke")


def test_the_legend_leaves_the_name_of_the_axis_free(swept, tmp_path, drawn):
    """Below the curves there are both, one below the other."""
    program.make([swept], tmp_path)
    figure = drawn[0]
    figure.draw_without_rendering()
    label, renderer = figure.axes[0].xaxis.label, figure._get_renderer()
    assert label.get_text() == "iteration"
    assert label.get_window_extent(renderer).y0 > figure.legends[0].get_window_extent(renderer).y1


def test_every_seed_is_a_point(swept, tmp_path, drawn):
    """In a panel for each quantity that has numbers, with a label that has the unit."""
    program.make([swept], tmp_path)
    final, later, tilt = [axes for axes in drawn[1].axes if axes.axison]
    assert [axes.get_xlabel() for axes in (final, later, tilt)] == [
        "loss at iteration 2",
        "speed over that in the episode [1]",
        "largest tilt [degrees]",
    ]
    assert [tuple(dots.get_offsets()[:, 0]) for dots in final.collections] == [LATENT, KMEANS]
    assert [one.get_xdata()[0] for one in final.lines if len(one.get_xdata()) == 1] == [-2.0, -1.0]
    assert [text.get_text() for text in final.get_yticklabels()] == [
        "observer=latent (3 seeds)",
        "observer=kmeans (3 seeds)",
    ]
    assert len(drawn) == 3 and drawn[2].axes[0].get_xlabel() == "difference of loss at iteration 2"


def test_another_column_at_another_iteration(swept, tmp_path):
    """Chosen on the command line."""
    program.main([str(swept), "--value", "progress", "--at", "1", "--out", str(tmp_path)])
    assert {row["final"] for row in read(tmp_path / "jobs.csv")} == {"0.25"}


def test_settings_that_change_no_number_make_no_other_runs(tmp_path):
    """Runs of two sweeps are compared although one wrote fewer checkpoints; the seed of a run may stand in its configuration only."""
    one, other = (make_sweep(tmp_path / name, {"observer=latent": LATENT}) for name in ("one", "other"))
    rows = read(other / "sweep.csv")
    for row in rows:
        seed = 900 + int(row["job"])
        row["settings"] = (
            "task=elephant observer=latent train.save_every=10 train.pictures=false device.threads=1"
        )
        (other / row["job"] / "config.yaml").write_text(f"train:\n  seed: {seed}\n")
    table(other / "sweep.csv", COLUMNS, rows)
    program.main([str(one), str(other), "--out", str(tmp_path / "out")])
    found = read(tmp_path / "out" / "jobs.csv")
    assert sorted(int(row["seed"]) for row in found) == [0, 1, 2, 900, 901, 902]
    assert "train.save_every" not in found[0] and "device.threads" not in found[0]


def test_each_robot_has_a_folder(tmp_path):
    """Losses of different tasks are not compared; a task of which nothing has finished does no harm to the others."""
    groups = {
        f"task={task} observer={name}": LATENT for task in ("arm", "biped") for name in ("latent", "none")
    }
    folder = make_sweep(tmp_path / "sweep", groups, failing=range(6))
    said = program.make([folder], tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["biped"]
    assert "arm:\nNone of 6 runs has finished." in said and "biped:\nMedian of loss" in said
    assert {row["observer"] for row in read(tmp_path / "out" / "biped" / "jobs.csv")} == {"latent", "none"}
    assert (tmp_path / "out" / "biped" / "summary.md").exists()


def summaries(folder: Path) -> list[list[list[str]]]:
    """Cells of the tables of summary.md."""
    found = [[]]
    for text in (folder / "summary.md").read_text().splitlines():
        if text.startswith("| ") and "---" not in text:
            found[-1].append([cell.strip() for cell in text.strip("|").split("|")])
        elif not text.startswith("|") and found[-1]:
            found.append([])
    return [table for table in found if table]


def test_an_objective_without_a_rule_neither_passes_nor_fails(tmp_path):
    """Whose first term is neither progress nor reach."""
    folder = make_sweep(tmp_path, {"observer=latent": LATENT})
    for job in range(3):
        path = folder / str(job) / "metrics.csv"
        path.write_text(path.read_text().replace("progress", "jump"))
    program.make([folder], tmp_path / "out")
    ((_, row),) = summaries(tmp_path / "out")
    assert row[-1] == "–"


def test_the_summary_has_a_row_for_each_setting(tmp_path):
    """Medians, failures and runs that stood the examination; differences from the first setting."""
    folder = make_sweep(tmp_path, {"observer=latent": LATENT, "observer=kmeans": KMEANS}, failing=[4])
    rows = read(folder / "sweep.csv")
    for row, later, tilt in zip(rows, (0.7, 0.69, 0.8, 0.9, 0.9, ""), (5, 5, 30, 5, 5, 5), strict=True):
        row |= {"end": -0.2, "later": later, "largest_tilt": tilt}
    table(folder / "sweep.csv", COLUMNS, rows)
    program.make([folder], tmp_path / "out")
    medians, differences = summaries(tmp_path / "out")
    assert medians == [
        ["observer", "loss at 2", "end", "later", "largest_tilt", "failed", "passed"],
        ["latent", "-2 [-4, -1]", "-0.2", "0.7", "5", "0 of 3", "1 of 3"],
        ["kmeans", "-0.75 [-1, -0.5]", "-0.2", "0.9 (1)", "5", "1 of 3", "1 of 3"],
    ]
    (row,) = differences[1:]
    assert differences[0] == medians[0][:-2] and row[:2] == ["kmeans", "-1.75 [-3, -0.5] (2)"]


def test_without_an_examination_there_is_no_verdict(tmp_path):
    """With ``train.examine=false`` nothing passes, and nothing fails to."""
    folder = make_sweep(
        tmp_path, {"observer=latent": LATENT, "observer=kmeans": KMEANS}, later="", largest_tilt=""
    )
    program.make([folder], tmp_path / "out")
    assert [row[-2:] for row in summaries(tmp_path / "out")[0][1:]] == [["0 of 3", "–"]] * 2


def test_notes_of_the_panels_are_whole(tmp_path, drawn):
    """Also below a single narrow panel, as without an examination; that of pairs.png was cut off on both sides."""
    short = {"design.enabled=true": LATENT, "design.enabled=false": KMEANS}
    program.make([make_sweep(tmp_path, short, later="", largest_tilt="")], tmp_path / "out")
    notes = [figure for figure in drawn.values() if figure.get_supxlabel()]
    assert [len(figure.axes) for figure in notes] == [1, 1]
    for figure in notes:
        box = figure._supxlabel.get_window_extent()
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1


@pytest.mark.parametrize(
    "changes, passed",
    [
        ({}, True),
        ({"status": "failed"}, False),
        ({"later": 0.69}, False),
        ({"later": math.nan}, False),
        ({"largest_tilt": 30.0}, False),
        ({"largest_tilt": math.nan}, False),
        ({"end": 0.01}, False),  # it went backwards, whatever an episode had
        ({"term": "reach"}, False),
        (
            {
                "term": "reach",
                "end": 0.01,
                "largest_tilt": math.nan,
                "largest_miss": 0.005,
                "largest_speed": 0.05,
            },
            True,
        ),
        (
            {"term": "reach", "largest_miss": 0.005, "largest_speed": math.nan},
            True,
        ),  # it need not come to rest
        ({"term": "reach", "largest_miss": 0.005, "largest_speed": 0.051}, False),
        ({"term": "reach", "largest_miss": 0.0051, "largest_speed": 0.0}, False),
        ({"term": "reach", "largest_miss": math.nan, "largest_speed": 0.0}, False),
        ({"term": "own"}, False),
    ],
)
def test_what_passes_the_examination(changes, passed):
    """Walkers go on forward and level, what reaches stays at its goal; without an answer nothing passes."""
    row = {"status": "finished", "term": "progress", "later": 0.7, "largest_tilt": 29.0, "end": -0.5}
    row["best"] = -0.6
    row |= {"largest_miss": math.nan, "largest_speed": math.nan}
    assert passes(row | changes) == passed


def test_earlier_iterations_are_compared_too(tmp_path):
    """Values after a while and the last, each with its paired differences; figures show the last."""
    folder = make_sweep(tmp_path, {"observer=latent": LATENT, "observer=kmeans": KMEANS})
    for job in range(6):
        metrics(folder / str(job), [job + 0.5 * k for k in range(22)])
    program.make([folder], tmp_path / "out")
    jobs, pairs = (read(tmp_path / "out" / f"{name}.csv") for name in ("jobs", "pairs"))
    assert [(row["at_10"], row["at_20"], row["final"]) for row in jobs[:2]] == [
        ("5.0", "10.0", "10.5"),
        ("6.0", "11.0", "11.5"),
    ]
    assert [row["quantity"] for row in pairs] == ["at_10", "at_20", "final", "later", "largest_tilt"]
    assert [row["difference"] for row in pairs[:3]] == ["-3.0"] * 3
    assert summaries(tmp_path / "out")[0][0][1:4] == ["loss at 10", "loss at 20", "loss at 21"]


def test_many_settings_have_panels(tmp_path, drawn):
    """A panel for each combination but of what has most values, with the same colours, also in the picture of all values; differences
    from the first setting alone."""
    clocks, observers = ("true", "false"), ("latent", "centroids", "kmeans", "none")
    groups = {
        f"policy.clock={c} design={d} observer={o}": LATENT for c in clocks for d in clocks for o in observers
    }
    program.make([make_sweep(tmp_path, groups, failing=[3])], tmp_path / "out")
    curves, seeds, differences = drawn.values()
    assert [axes.get_title(loc="left") for axes in curves.axes] == [
        f"clock={c}, design={d}" for c in clocks for d in clocks
    ]
    colours = [[one.get_color() for one in axes.lines] for axes in curves.axes]
    assert all(found == COLOURS[:4] for found in colours)
    diamonds = [one.get_color() for one in seeds.axes[0].lines if one.get_marker() == "D"]
    assert diamonds == 4 * COLOURS[:4]
    assert line(curves.axes[0], "observer=centroids").get_label().endswith("(2 of 3 seeds, 1 failed)")
    names = [text.get_text() for text in differences.axes[0].get_yticklabels()]
    assert len(names) == 15 and all(
        name.startswith("clock=true, design=true, observer=latent  −") for name in names
    )


def test_sweeps_together(swept, tmp_path):
    """A setting that one of them leaves at its default; and two of the same command, told apart by their folders."""
    other = make_sweep(tmp_path / "b", {"": (-1.0, -1.0, -1.0)})
    program.make([swept, other], tmp_path / "out")
    firsts = {(row["first"], row["second"]) for row in read(tmp_path / "out" / "pairs.csv")}
    assert ("observer=latent", "observer by default") in firsts and len(firsts) == 3
    again = make_sweep(tmp_path / "again", {"observer=latent": KMEANS, "observer=kmeans": LATENT})
    program.make([swept, again], tmp_path / "out")
    (row, *_) = read(tmp_path / "out" / "pairs.csv")
    assert (row["first"], row["second"]) == ("sweep=sweep, observer=latent", "sweep=sweep, observer=kmeans")
    assert len(read(tmp_path / "out" / "jobs.csv")) == 12


@pytest.mark.parametrize("listed", ["in the sweep", "in the job", "nowhere"])
def test_seeds_side_by_side_are_runs(tmp_path, listed):
    """A job whose seeds have folders of their own; one that failed is known if a table has them, of the sweep or of the job."""
    rows = []
    for job, observer in enumerate(("latent", "kmeans")):
        place, settings = tmp_path / str(job), f"observer={observer} train.seeds=3"
        for seed in (7, 8, 10):
            metrics(place / f"seed_{seed}", [1.0, -1.0 * seed], later=0.1 * seed)
        own = [
            {"job": 0, "status": "finished" if seed < 10 else "failed", "later": 0.1 * seed}
            | {"settings": settings, "seed": seed, "folder": f"/elsewhere/{job}/seed_{seed}"}
            for seed in (7, 8, 10)
        ]
        if listed == "in the job":
            table(place / "sweep.csv", [*COLUMNS, "seed"], own)
        of_job = {"job": job, "status": "finished", "settings": settings, "folder": str(place)}
        rows += [row | {"job": job} for row in own] if listed == "in the sweep" else [of_job]
    table(tmp_path / "sweep.csv", [*COLUMNS, "seed"], rows)
    program.make([tmp_path], tmp_path / "out")
    jobs = read(tmp_path / "out" / "jobs.csv")
    assert [(row["job"], row["seed"], row["observer"]) for row in jobs] == [
        (str(job), str(seed), name) for job, name in enumerate(("latent", "kmeans")) for seed in (7, 8, 10)
    ]
    assert [float(row["later"]) for row in jobs[:2]] == pytest.approx([0.7, 0.8])
    assert jobs[2]["status"] == ("finished" if listed == "nowhere" else "failed")
    (row, *_) = read(tmp_path / "out" / "pairs.csv")
    assert row["pairs"] == ("3" if listed == "nowhere" else "2")


def test_what_is_no_sweep_is_said_in_a_sentence(swept, tmp_path, capsys):
    """Also columns and iterations that are not there, and jobs that lost their files."""

    def refused(*words) -> str:
        with pytest.raises(SystemExit) as stop:
            program.main([str(word) for word in words])
        said = capsys.readouterr().err.strip().splitlines()
        assert stop.value.code == 1 and len(said) == 1
        return said[0]

    assert "is no sweep: it has no sweep.csv" in refused(tmp_path)
    assert "is no sweep: it has no sweep.csv" in refused(swept / "0")
    assert "metrics.csv has no column speed; it has loss, progress" in refused(swept, "--value", "speed")
    assert "no run has a value of loss at iteration 3" in refused(swept, "--at", "3")
    assert "have the same settings and the same seed, 0" in refused(swept, swept)
    whole = (swept / "sweep.csv").read_text()
    (swept / "sweep.csv").write_text(whole + "1,0\n")
    assert "sweep.csv, line 8, is damaged; the command of the sweep" in refused(swept)
    (swept / "sweep.csv").write_text(whole)
    (swept / "0" / "metrics.csv").write_text("iteration,loss\n0,much\n")
    assert "0/metrics.csv, line 2: could not convert" in refused(swept)
    (swept / "0" / "metrics.csv").unlink()
    assert "job 0" in (said := refused(swept)) and "metrics.csv is missing" in said
    none = make_sweep(tmp_path / "none", {"observer=latent": LATENT}, failing=[0, 1, 2])
    assert "none of 3 runs has finished" in refused(none)
    (none / "sweep.csv").write_text("a,b\n1,2\n")
    assert "must have the columns folder, job, settings, status" in refused(none)


def test_command_lines_are_read_with_their_brackets():
    """White space in lists and quotes does not separate; the last value of a key counts."""
    assert parse("task=arm +task.goal=[0.5, 0.3] task.note='a b' train.seed=1 train.seed=2") == {
        "task": "arm",
        "task.goal": "[0.5, 0.3]",
        "task.note": "'a b'",
        "train.seed": "2",
    }
    assert parse("") == {}


def test_escaped_characters_are_read_as_hydra_reads_them():
    """Quotes within quotes, brackets and white space outside of them; the value stays as it was written."""
    written = [
        r"'robot\'s 1.png'",
        r'"a \"b\" \\"',
        r"a\(b",
        r"a\ b",
        r"'\\'",
        r"{a: 'it\'s ]', b: [1, 2]}",
        "''",
    ]
    for value in written:
        assert parse(f"task.file={value} train.seed=1") == {"task.file": value, "train.seed": "1"}
        assert OverridesParser.create().parse_override(f"task.file={value}").get_value_string() == value
    assert parse("train.seed=1 task.file=C:\\robots\\") == {"train.seed": "1", "task.file": "C:\\robots\\"}


@pytest.mark.parametrize("count, marked", [(4, False), (5, True)])
def test_few_pairs_mark_no_difference(count, marked):
    """The interval of two equal differences has no width at all."""
    groups = {"a": dict.fromkeys(range(count), 1.0), "b": dict.fromkeys(range(count), 2.0)}
    (row,) = pairs(groups, "loss")
    assert row["high"] < 0 and stands_out(row) is marked
