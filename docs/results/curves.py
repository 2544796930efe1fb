"""Draw the curves of docs/results.md from the metrics.csv files beside this script: `python docs/results/curves.py`."""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

HERE = Path(__file__).parent
KINDS = {"co": ("controller and body", "#1f6f8b"), "ctrl": ("controller only", "#c8553d")}


def best_so_far(path: Path) -> list[float]:
    """Minus the smallest final loss up to each iteration: for a walker the distance travelled [m]."""
    best, curve = float("-inf"), []
    with path.open() as file:
        for row in csv.DictReader(file):
            best = max(best, -float(row["final"]))
            curve.append(best)
    return curve


def others() -> None:
    """Arm and biped, a curve for each observer."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.5, 3.2))
    for observer, colour in (("latent", "#1f6f8b"), ("centroids", "#c8553d")):
        left.plot(best_so_far(HERE / f"biped_{observer}.csv"), color=colour, label=observer)
        miss = [1e3 * (-squared) ** 0.5 for squared in best_so_far(HERE / f"arm_{observer}.csv")]
        right.semilogy(miss, color=colour, label=observer)
    left.set(title="biped", xlabel="iteration", ylabel="best distance so far [m]", ylim=(0, None))
    right.set(title="arm", xlabel="iteration", ylabel="best miss so far [mm]")
    for axes in (left, right):
        axes.legend(frameon=False)
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(HERE.parent / "images" / "arm_biped_curves.png", dpi=120)


def main() -> None:
    figure, axes = plt.subplots(figsize=(6.5, 3.6))
    for kind, (label, colour) in KINDS.items():
        curves = [best_so_far(path) for path in sorted(HERE.glob(f"elephant_standard_{kind}_seed*.csv"))]
        for curve in curves:
            axes.plot(curve, color=colour, alpha=0.35, linewidth=1)
        mean = [sum(values) / len(values) for values in zip(*curves, strict=True)]
        axes.plot(mean, color=colour, linewidth=2.2, label=f"{label}, mean of {len(curves)} seeds")
    axes.axhline(0.44 / 3, color="0.6", linewidth=0.8, linestyle=":")
    axes.text(99, 0.44 / 3, "a third of a body length", ha="right", va="bottom", fontsize=8, color="0.4")
    axes.set(xlabel="iteration", ylabel="distance of the best walk so far [m]", ylim=(0, None))
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(HERE.parent / "images" / "elephant_curves.png", dpi=120)


if __name__ == "__main__":
    main()
    others()
