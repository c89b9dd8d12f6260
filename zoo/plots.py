"""Helpers of all plots: drawn without a display, one colour per algorithm everywhere, intervals shown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_kfcv.common.evaluation import with_interval
from sb3_kfcv.saving.files import atomic_write

# Okabe and Ito's colours, which stay apart for colour-blind readers.
ALGO_COLOURS = {"maddpg": "#0072B2", "per_maddpg": "#E69F00", "kfcv_maddpg": "#009E73"}
ALGO_LABELS = {"maddpg": "MADDPG", "per_maddpg": "PER-MADDPG", "kfcv_maddpg": "KFCV-MADDPG"}
REFERENCE_COLOUR = "#666666"
REFERENCE_DASHES = ("--", ":", "-.")

DPI = 150


def new_figure(n_panels: int, title: str | None = None) -> tuple[Figure, list[Axes]]:
    """
    A figure with panels side by side.

    :param n_panels: how many
    :param title: over all of them
    """
    figure = Figure(figsize=(5.2 * n_panels, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = list(figure.subplots(1, n_panels, squeeze=False)[0])
    for axis in axes:
        axis.grid(alpha=0.25)
        axis.spines[["top", "right"]].set_visible(False)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
    if title:
        figure.suptitle(title)
    return figure, axes


def draw_curve(axis: Axes, steps: np.ndarray, episodes: np.ndarray, colour: str, label: str) -> None:
    """
    Means over time, with their 95 % intervals as a band.

    :param axis: where to draw
    :param steps: env steps (evaluations,)
    :param episodes: a value of each episode of each evaluation (evaluations, episodes)
    :param colour: of the line
    :param label: for the legend
    """
    means, low, high = np.array([with_interval(values) for values in episodes]).T
    axis.plot(steps, means, color=colour, label=label, marker="o", markersize=3)
    axis.fill_between(steps, low, high, color=colour, alpha=0.25, linewidth=0)


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
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=DPI)
