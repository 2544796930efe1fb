"""Draw the best evaluations of all seeds of the comparison: `python docs/results/draw.py` writes images/comparison_ROBOT.png."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from comparison import WALKS, read

IMAGES = Path(__file__).parent.parent / "images"
LABELS = {
    "elephant": "best evaluation [m], lower is better",
    "biped": "best evaluation [m], lower is better",
    "arm": "best evaluation [10⁻⁵], lower is better",
}


def draw(robot: str) -> None:
    """A panel for each design and clock: a dot for each seed, a line at the median."""
    jobs, arm = read(robot), robot == "arm"
    kinds = list(dict.fromkeys(job[:2] for job in jobs))
    observers = list(dict.fromkeys(job[2] for job in jobs))
    figure, panels = plt.subplots(1, len(kinds), figsize=(11, 3.6), sharey=True, layout="constrained")
    for (design, clock), panel in zip(kinds, panels, strict=True):
        panel.set_title(
            f"{'co-design' if design == 'particle' else 'control only'}, {'clock' if clock == 'true' else 'no clock'}",
            fontsize=10,
        )
        for k, observer in enumerate(observers):
            best = np.sort(
                [(1e5 if arm else 1.0) * float(row["best"]) for row in jobs[design, clock, observer]]
            )
            panel.plot(k + np.linspace(-0.22, 0.22, len(best)), best, "o", ms=4, alpha=0.7, color=f"C{k}")
            panel.plot([k - 0.35, k + 0.35], [np.median(best)] * 2, color="black", lw=1.5)
        panel.set_xticks(
            range(len(observers)),
            [name.replace("kmeans", "k-means") for name in observers],
            rotation=35,
            ha="right",
        )
        panel.grid(axis="y", alpha=0.3)
        if arm:
            panel.set_yscale("log")
        else:
            panel.axhline(WALKS, color="grey", ls=":", lw=1)
    panels[0].set_ylabel(LABELS[robot])
    figure.savefig(IMAGES / f"comparison_{robot}.png", dpi=100)


if __name__ == "__main__":
    for name in LABELS:
        draw(name)
