"""The chart of docs/performance.md from bench/results: `python bench/chart.py`."""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
SIZES = {
    "2D\n6,400": (2, 6_400),
    "3D\n8,000": (3, 8_000),
    "3D\n64,000": (3, 64_000),
    "3D\n1,000,000": (3, 1_000_000),
}
BARS = {
    "plain, forward": ("step.plain", "us/substep", "#c9c9c9"),
    "plain, backward": ("gradient.plain", "backward us/substep", "#8f8f8f"),
    "fast, forward": ("step", "falling us", "#7fb3e0"),
    "fast, backward": ("gradient", "backward, kept", "#1f5f9e"),
}


def value(file: str, column: str, dim: int, particles: int) -> float:
    rows = json.loads((HERE / "results" / f"{file}.h200.json").read_text())["rows"]
    found = [r for r in rows if r["dim"] == dim and r["scene"] == "neo-Hookean"]
    return min(found, key=lambda r: abs(r["particles"] - particles))[column]


def main():
    figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
    width = 0.8 / len(BARS)
    for k, (label, (file, column, colour)) in enumerate(BARS.items()):
        heights = [value(file, column, *size) for size in SIZES.values()]
        bars = axes.bar(
            [i + (k - 1.5) * width for i in range(len(SIZES))], heights, width, label=label, color=colour
        )
        axes.bar_label(bars, fmt="%.0f", fontsize=8)
    axes.set_yscale("log")
    axes.set_xticks(range(len(SIZES)), list(SIZES))
    axes.set_ylabel("µs per substep")
    axes.set_title("Falling elastic cube, neo-Hookean, float32, one H200", fontsize=10)
    axes.legend(frameon=False, ncols=2, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(HERE.parent / "docs" / "images" / "performance.png", dpi=150)


if __name__ == "__main__":
    main()
