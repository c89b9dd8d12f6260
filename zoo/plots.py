"""Helpers of all plots: drawn without a display, one colour per algorithm everywhere, intervals shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_kfcv.common.evaluation import Interval, rounded, with_interval
from sb3_kfcv.saving.files import atomic_write

# Okabe and Ito's colours, which stay apart for colour-blind readers.
ALGO_COLOURS = {"maddpg": "#0072B2", "per_maddpg": "#E69F00", "kfcv_maddpg": "#009E73"}
ALGO_LABELS = {"maddpg": "MADDPG", "per_maddpg": "PER-MADDPG", "kfcv_maddpg": "KFCV-MADDPG"}
OTHER_COLOUR = "#CC79A7"  # of algorithms that have none
REFERENCE_COLOUR = "#666666"
LINE_DASHES = ("-", "--", "-.", ":")  # of several lines of one algorithm
REFERENCE_DASHES = ("--", ":", "-.")
HEAT_MAP = "cividis"  # reads the same with every kind of colour vision

DPI = 150
PANELS_PER_ROW = 3
LABEL_WIDTH = 26  # characters
TITLE_WIDTH = 11  # characters per inch
MOST_WITHIN = 4  # lines of a legend that leave room for the picture
MOST_MARKERS = 60  # points of a line that are still told apart


def new_figure(
    n_panels: int, title: str | None = None, size: tuple[float, float] = (5.2, 3.8), columns: int = PANELS_PER_ROW
) -> tuple[Figure, list[Axes]]:
    """
    A figure with panels side by side, in rows.

    :param n_panels: how many
    :param title: over all of them
    :param size: width and height of each, in inches
    :param columns: so many in a row at most
    """
    columns, rows = min(n_panels, columns), -(-n_panels // columns)
    figure = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in axes[n_panels:]:
        axis.remove()
    for axis in axes[:n_panels]:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    if title:
        figure.suptitle(fill(title, int(TITLE_WIDTH * size[0] * columns)))
    return figure, axes[:n_panels]


def line_styles(algos: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """
    A colour and dashes for each line: the colour of its algorithm; several lines of one algorithm get shades of it, from dark
    to light, and dashes of their own.

    :param algos: label → algorithm
    :return: label → colour, dashes
    """
    styles = {}
    for algo in dict.fromkeys(algos.values()):
        labels = [label for label, own in algos.items() if own == algo]
        for i, label in enumerate(labels):
            lightness = 0.5 * i / max(len(labels) - 1, 1)
            styles[label] = (_lighter(ALGO_COLOURS.get(algo, OTHER_COLOUR), lightness), LINE_DASHES[i % len(LINE_DASHES)])
    return styles


def _lighter(colour: str, share: float) -> str:
    red, green, blue = (share + (1 - share) * part for part in to_rgb(colour))
    return to_hex((red, green, blue))


def draw_curve(axis: Axes, steps: np.ndarray, episodes: np.ndarray, colour: str, label: str) -> None:
    """
    Means over time, with their 95 % intervals as a band.

    :param axis: where to draw
    :param steps: env steps (evaluations,)
    :param episodes: a value of each episode of each evaluation (evaluations, episodes)
    :param colour: of the line
    :param label: for the legend
    """
    draw_intervals(axis, steps, [with_interval(values) for values in episodes], colour, label)


def draw_intervals(
    axis: Axes, steps: Sequence[int] | np.ndarray, intervals: Sequence[Interval], colour: str, label: str, dashes: str = "-"
) -> None:
    """
    Means over time, with a band of their intervals.

    :param axis: where to draw
    :param steps: env steps (evaluations,)
    :param intervals: of each evaluation
    :param colour: of the line
    :param label: for the legend
    :param dashes: style of the line
    """
    means, low, high = np.array(intervals).T
    marker = "o" if len(means) <= MOST_MARKERS else None
    axis.plot(steps, means, color=colour, label=label, marker=marker, markersize=3, linestyle=dashes)
    axis.fill_between(steps, low, high, color=colour, alpha=0.25, linewidth=0)


def draw_estimates(
    axis: Axes,
    intervals: Mapping[str, Interval],
    colours: Mapping[str, str],
    values: Mapping[str, np.ndarray] | None = None,
) -> None:
    """
    Estimates below each other, each with its interval as a bar.

    :param axis: where to draw
    :param intervals: label → estimate, from above
    :param colours: label → colour
    :param values: label → what was estimated from, drawn as small circles
    """
    for i, (label, own) in enumerate(intervals.items()):
        axis.plot([own.low, own.high], [i, i], color=colours[label], linewidth=7, alpha=0.35, solid_capstyle="butt")
        if values is not None:
            heights = np.full(len(values[label]), i + 0.28)
            axis.plot(values[label], heights, "o", markersize=4.5, markerfacecolor="none", color=colours[label])
        axis.plot(own.mean, i, marker="|", markersize=16, markeredgewidth=2.5, color=colours[label])
    axis.set_yticks(range(len(intervals)), map(wrapped, intervals))
    axis.set_ylim(len(intervals) - 0.4, -0.6)
    axis.grid(axis="y", visible=False)


def draw_legend(axis: Axes, below: bool = False) -> None:
    """
    The names of the lines: within the picture where they are few, else below it.

    :param axis: where to draw
    :param below: below it in any case, where lines take up the whole picture
    """
    labels = axis.get_legend_handles_labels()[1]
    if below or len(labels) > MOST_WITHIN:
        columns = 1 if max(map(len, labels), default=0) > LABEL_WIDTH else 2  # long ones would be wider than the picture
        axis.legend(fontsize="small", loc="upper center", bbox_to_anchor=(0.5, -0.24), ncols=columns)
    else:
        axis.legend(fontsize="small")


def wrapped(label: str) -> str:
    """A label in lines that leave room for the picture."""
    return "\n".join(fill(line, LABEL_WIDTH) for line in label.split("\n"))


def draw_heat_map(
    axis: Axes,
    intervals: Sequence[Sequence[Interval]],
    rows: Sequence[str],
    columns: Sequence[str],
    limits: tuple[float, float],
    label: str,
) -> None:
    """
    A table as colours, with each number and its interval written into its cell.

    :param axis: where to draw
    :param intervals: of each cell (rows, columns)
    :param rows: labels, from above
    :param columns: labels
    :param limits: values of the darkest and of the brightest colour
    :param label: what the colours mean
    """
    colours, scale = colormaps[HEAT_MAP], Normalize(*limits)
    image = axis.imshow([[cell.mean for cell in line] for line in intervals], cmap=colours, norm=scale, aspect="auto")
    for i, line in enumerate(intervals):
        for k, cell in enumerate(line):
            ink = "black" if scale(cell.mean) > 0.5 else "white"
            axis.text(k, i, f"{rounded(cell.mean):.2f}", ha="center", va="bottom", color=ink, fontsize=10)
            ends = f"{rounded(cell.low):.2f} … {rounded(cell.high):.2f}"
            axis.text(k, i + 0.06, ends, ha="center", va="top", color=ink, fontsize=7)
    axis.set_xticks(range(len(columns)), columns, rotation=30, ha="right", rotation_mode="anchor")
    axis.set_yticks(range(len(rows)), rows)
    axis.grid(False)
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    axis.figure.colorbar(image, ax=axis, label=label)


def draw_references(axis: Axes, values: dict[str, float]) -> None:
    """
    Horizontal lines, such as what scripted policies reach.

    :param axis: where to draw
    :param values: label → height; at most three
    """
    for (label, value), dashes in zip(values.items(), REFERENCE_DASHES, strict=False):
        axis.axhline(value, color=REFERENCE_COLOUR, linestyle=dashes, linewidth=1.2, label=label)


def save_figure(figure: Figure, path: str | Path) -> None:
    """
    Write a figure as PNG.

    :param figure: the figure
    :param path: of the file
    """
    figure.draw_without_rendering()  # the layout makes room for a legend below a picture when it sees it again
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=DPI)


def save_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Keep the data behind a picture beside it."""
    with atomic_write(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
