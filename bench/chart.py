"""The charts of docs/performance.md and docs/accuracy.md from bench/results: `python bench/chart.py`."""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
IMAGES = HERE.parent / "docs" / "images"
SIZES = {
    "2D\n6,400": (2, 6_400),
    "3D\n8,000": (3, 8_000),
    "3D\n64,000": (3, 64_000),
    "3D\n1,000,000": (3, 1_000_000),
}
BARS = {
    "plain, forward": ("step.plain", "falling us", "#c9c9c9"),
    "plain, backward": ("gradient.plain", "backward, kept", "#8f8f8f"),
    "fast, forward": ("step", "falling us", "#7fb3e0"),
    "fast, backward": ("gradient", "backward, kept", "#1f5f9e"),
}


KINDS = {
    "reference": ("reference, clamp", "#1f5f9e"),
    "reference, stick": ("reference, sticking wall", "#7fb3e0"),
    "moving": ("moving, sticking wall", "#8f8f8f"),
}


CONTENDERS = {"softmpm": "#1f5f9e", "Warp, generated": "#8f8f8f", "Taichi": "#d9a441"}


def rows(file: str) -> list[dict]:
    return json.loads((HERE / "results" / f"{file}.h200.json").read_text())["rows"]


def value(file: str, column: str, dim: int, particles: int) -> float:
    found = [r for r in rows(file) if r["dim"] == dim and r["scene"] == "neo-Hookean"]
    return min(found, key=lambda r: abs(r["particles"] - particles))[column]


def bars(axes, heights: dict[str, list[float]], colours: list[str]) -> None:
    """Groups of bars with their heights, one group for each of SIZES."""
    width = 0.8 / len(heights)
    for k, ((label, values), colour) in enumerate(zip(heights.items(), colours, strict=True)):
        places = [i + (k - (len(heights) - 1) / 2) * width for i in range(len(SIZES))]
        axes.bar_label(axes.bar(places, values, width, label=label, color=colour), fmt="%.0f", fontsize=8)
    axes.set_yscale("log")
    axes.set_xticks(range(len(SIZES)), list(SIZES))
    axes.set_xlabel("particles")
    axes.spines[["top", "right"]].set_visible(False)


def schemes() -> None:
    figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
    heights = {
        label: [value(*where, *size) for size in SIZES.values()] for label, (*where, _) in BARS.items()
    }
    bars(axes, heights, [colour for *_, colour in BARS.values()])
    axes.set_ylabel("µs per substep")
    axes.set_title("Falling elastic cube, neo-Hookean, float32, one H200", fontsize=10)
    axes.legend(frameon=False, ncols=2, fontsize=9)
    figure.savefig(IMAGES / "performance.png", dpi=150)


def peers() -> None:
    figure, both = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained", sharey=True)
    for axes, way in zip(both, ("forward", "backward"), strict=True):
        found = [r for r in rows("peers") if r["order"] == "random"]
        heights = {name: [r[way] for r in found if r["contender"] == name] for name in CONTENDERS}
        bars(axes, heights, list(CONTENDERS.values()))
        axes.set_title(way, fontsize=10)
    both[0].set_ylabel("µs per substep")
    both[0].legend(frameon=False, fontsize=9)
    figure.suptitle("Swirling elastic cube, particles in random order, one H200", fontsize=10)
    figure.savefig(IMAGES / "peers.png", dpi=150)


def accuracy() -> None:
    found = json.loads((HERE / "results" / "accuracy.cpu.json").read_text())["rows"]
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for kind, (label, colour) in KINDS.items():
        of_kind = [row for row in found if row["formulation"] == kind]
        beams = [row for row in of_kind if row["problem"].startswith("beam, tip sinks by 0.2")]
        costs, errors = ([abs(row[name]) for row in beams] for name in ("cost M", "error %"))
        left.loglog(costs, errors, "o", color=colour, label=label)
        for row, cost, error in zip(beams, costs, errors, strict=True):
            beside = (6, -8) if row["cells"] == 3 else (6, 3)
            place = dict(xytext=beside, textcoords="offset points", fontsize=8, color=colour)
            left.annotate(f"{row['cells']}, {row['per cell']}", (cost, error), **place)
        for problem, mark in (("clamped bar", "o-"), ("column", "s--")):
            if kind == "reference, stick":
                continue  # on those of the moving formulation
            rows = [row for row in of_kind if row["problem"].startswith(problem)]
            values = [abs(row["error %"]) for row in rows]
            right.loglog(
                [row["cells"] for row in rows], values, mark, color=colour, label=f"{problem}, {label}"
            )
    left.set_title("Cantilever, tip sinks by a fifth (cells across, particles per axis)", fontsize=10)
    left.axhline(0.5, color="#c9c9c9", linewidth=1, zorder=0)
    left.annotate("error of the theory of beams, about", (0.5, 0.36), fontsize=8, color="#8f8f8f")
    left.set_xlabel("million particle-substeps")
    left.set_xticks([0.2, 0.4, 0.8, 1.6], ["0.2", "0.4", "0.8", "1.6"])
    left.set_xlim(0.13, 2.0)
    left.minorticks_off()
    left.set_ylabel("error in %")
    right.set_title("Frequency of a clamped bar, sinking of a column", fontsize=10)
    right.set_xlabel("cells along the body")
    right.set_ylim(2e-5, 10)
    right.set_xticks([8, 16, 32], ["8", "16", "32"])
    right.minorticks_off()
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=8)
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(IMAGES / "accuracy.png", dpi=150)


if __name__ == "__main__":
    schemes()
    peers()
    accuracy()
