"""The chart of docs/gait.md from bench/results: `python bench/gait_chart.py`."""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
GAITS = {"viscous": "gait learned with η/μ = 1 ms", "elastic": "gait learned without viscosity"}
STYLES = {
    ("reference", 1): ("#1f5f9e", "-", "reference, 1 ms"),
    ("moving", 1): ("#c8553d", "-", "moving, 1 ms"),
    ("reference", 4): ("#1f5f9e", "--", "reference, 4 ms"),
    ("moving", 4): ("#c8553d", "--", "moving, 4 ms"),
}


def main():
    rows = json.loads((HERE / "results" / "gait.walk.cpu.json").read_text())["rows"]
    figure, grid = plt.subplots(2, 2, figsize=(8, 5.6), sharex=True, layout="constrained")
    for line, when in zip(grid, ("0.5 s", "1 s"), strict=True):
        for axes, (gait, title) in zip(line, GAITS.items(), strict=True):
            for (formulation, retardation), (colour, dashes, label) in STYLES.items():
                found = [
                    row
                    for row in rows
                    if (row["gait"], row["formulation"], round(row["η/μ ms"]))
                    == (gait, formulation, retardation)
                ]
                found = [row for row in found if row[f"{when} mm"] is not None]
                cells, mean, std = (
                    [row[name] for row in found] for name in ("cells/m", f"{when} mm", f"{when} std")
                )
                axes.errorbar(cells, mean, std, color=colour, linestyle=dashes, capsize=2, label=label)
            axes.set(xscale="log", ylim=(0, None), ylabel=f"mm after {when}")
            axes.set_xticks([40, 56, 80, 112, 160, 224], ["40", "56", "80", "112", "160", "224"], minor=False)
            axes.minorticks_off()
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_title(title if when == "0.5 s" else "", fontsize=10)
    for axes in grid[1]:
        axes.set_xlabel("cells per metre")
    grid[0, 0].legend(frameon=False, fontsize=8)
    figure.savefig(HERE.parent / "docs" / "images" / "gait.png", dpi=120)


if __name__ == "__main__":
    main()
