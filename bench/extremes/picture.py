"""The maps as pictures, one a page: a line for each law and dimension, a column for each value, a colour for each outcome.

Colours are those of Okabe and Ito (2008), which are distinguishable with any colour vision; the text repeats the information.
"""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Patch, Rectangle

from .cells import Outcome
from .laws import LAWS
from .rows import Row

COLOURS = {
    Outcome.RIGHT: "#bfe3d5",
    Outcome.REFUSED: "#cfe3f5",
    Outcome.STOPPED: "#f7e3b0",
    Outcome.SILENT: "#c4453a",
}
MEANINGS = {
    Outcome.RIGHT: "right (least det F)",
    Outcome.REFUSED: "refused by name",
    Outcome.STOPPED: "stopped by name (UnstableError, its kind; * right without alarms)",
    Outcome.SILENT: "silently wrong",
}
SHORT = {
    "NeoHookean": "neo-Hookean",
    "FixedCorotated": "fixed corotated",
    "BarrierCorotated": "barrier corot.",
    "StableNeoHookean": "stable neo-H.",
}
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#F0E442", "#000000")
LINE, HEAD = 0.235, 0.62
"""Heights of a line of cells and of a row's title [inch]."""
WIDTH, MARGIN = 10.5, 1.25


def draw(pages: dict[str, list[Row]], cells: list[dict], folder: Path) -> None:
    for page, rows in pages.items():
        shown = [row for row in rows if any(cell["row"] == row.name for cell in cells)]
        if shown:
            draw_page(page, shown, cells, folder / f"limits_{page}.png")


def draw_page(page: str, rows: list[Row], cells: list[dict], path: Path) -> None:
    lines = [len(_lines(row, cells)) for row in rows]
    height = sum(HEAD + LINE * n for n in lines) + 0.75
    figure = plt.figure(figsize=(WIDTH, height), facecolor="white")
    top = height - 0.55
    figure.text(MARGIN / WIDTH, 1 - 0.22 / height, TITLES[page], fontsize=13, weight="bold", va="center")
    for row, count in zip(rows, lines, strict=True):
        top -= HEAD
        size = LINE * count
        box = (MARGIN / WIDTH, (top - size) / height, (WIDTH - MARGIN - 0.15) / WIDTH, size / height)
        draw_row(figure.add_axes(box), row, cells)
        top -= size
    handles = [Patch(facecolor=COLOURS[o], edgecolor="white", label=MEANINGS[o]) for o in Outcome]
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=((MARGIN - 0.12) / WIDTH, 1 - 0.38 / height),
        ncols=4,
        frameon=False,
        fontsize=8.5,
        handlelength=1.4,
        columnspacing=1.6,
    )
    figure.savefig(path, dpi=130)
    plt.close(figure)


TITLES = {
    "material": "Extremes of the material",
    "viscosity": "Extremes of the viscosity",
    "loads": "Extremes of the load",
    "actuators": "Extremes of the actuators",
    "walls": "Extremes of moving walls",
    "starts": "Extremes of the start",
    "numerics": "Extremes of the method",
}


def draw_row(axes: Axes, row: Row, cells: list[dict]) -> None:
    own = [cell for cell in cells if cell["row"] == row.name]
    values = [value for value in row.values if any(cell["value"] == value for cell in own)]
    lines = _lines(row, cells)
    for cell in own:
        column, line = values.index(cell["value"]), lines.index((cell["law"], cell["dim"]))
        outcome = Outcome(cell["outcome"])
        axes.add_patch(
            Rectangle((column, line), 1, 1, facecolor=COLOURS[outcome], edgecolor="white", linewidth=1.2)
        )
        silent = outcome is Outcome.SILENT
        axes.text(
            column + 0.5,
            line + 0.52,
            NOTES.get(cell["note"], cell["note"]) + "*" * (cell.get("without alarms") == Outcome.RIGHT),
            ha="center",
            va="center",
            fontsize=7.5,
            color="white" if silent else "#333333",
            weight="bold" if silent else "normal",
        )
    axes.set_xlim(0, max(len(values), 10))
    axes.set_ylim(len(lines), 0)
    axes.set_xticks(
        [k + 0.5 for k in range(len(values))], [row.label(value) for value in values], fontsize=8.5
    )
    axes.set_yticks(
        [k + 0.5 for k in range(len(lines))],
        [f"{SHORT.get(law, law)} {dim}D" for law, dim in lines],
        fontsize=8,
    )
    axes.xaxis.tick_top()
    axes.tick_params(length=0, pad=2)
    axes.spines[:].set_visible(False)
    axes.set_title(row.title, loc="left", fontsize=9.5, pad=5, weight="bold")


def draw_limit(rows: list[dict], folder: Path) -> None:
    """Ratio of the measured to the reported step limit, and the reported limit, against the stretch."""
    figure, three = plt.subplots(1, 3, figsize=(WIDTH, 3.5), layout="constrained", facecolor="white")
    panels = {
        "lone": "20 lone particles: measured / reported",
        "strip": "clamped strip: measured / reported",
        "strip reported / rest": "clamped strip: reported / that at rest",
    }
    for axes, (column, title) in zip(three, panels.items(), strict=True):
        for law, colour, marker in zip(LAWS, LINES, "osD^vP*X", strict=False):
            for dim, style in ((2, "-"), (3, "--")):
                own = [row for row in rows if row["law"] == law.__name__ and row["dim"] == dim]
                axes.plot(
                    [row["stretch"] for row in own],
                    [row[column] for row in own],
                    style,
                    color=colour,
                    marker=marker,
                    markersize=4,
                    label=f"{SHORT[law.__name__]} {dim}D",
                )
        axes.set_title(title, fontsize=9.5)
        axes.set_xlabel("stretch", fontsize=9)
        axes.set_xscale("log")
        axes.set_xticks([0.3, 0.5, 1, 2, 4], ["0.3", "0.5", "1", "2", "4"])
        axes.minorticks_off()
        axes.set_ylim(0, 2 if column != "strip reported / rest" else None)
        axes.grid(color="#e6e6e6", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8.5)
    three[0].legend(frameon=False, fontsize=8, ncols=2, loc="lower left")
    figure.savefig(folder / "limits_step.png", dpi=130)
    plt.close(figure)


NOTES = {"left_grid": "left grid", "not_finite": "not finite"}


def _lines(row: Row, cells: list[dict]) -> list[tuple[str, int]]:
    found = {(cell["law"], cell["dim"]) for cell in cells if cell["row"] == row.name}
    laws = [law.__name__ for law in LAWS]
    return sorted(found, key=lambda line: (laws.index(line[0]), line[1]))
