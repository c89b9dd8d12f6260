"""What matches leave behind: tables as text, Markdown and JSON, every episode, and pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_kfcv.common.evaluation import Interval, rounded
from sb3_kfcv.matches import Elo, Equilibrium, PayOffTable, elo, equilibrium
from sb3_kfcv.saving.files import atomic_write
from zoo.plots import (
    ALGO_COLOURS,
    REFERENCE_COLOUR,
    draw_heat_map,
    draw_intervals,
    new_figure,
    save_arrays,
    save_figure,
)

CURVE_DASHES = ("-", "--", ":", "-.")


def cells_of(table: PayOffTable, quantity: str) -> list[list[Interval]]:
    """A quantity of every match with its interval (rows, columns)."""
    return [[table.interval(quantity, i, k) for k in range(len(table.columns))] for i in range(len(table.rows))]


def table_lines(table: PayOffTable, quantity: str) -> list[list[str]]:
    """A quantity of every match as a table of texts, its head first."""
    head = [f"{table.row_group} \\ {table.column_group}", *table.columns]
    cells = [[shown(cell) for cell in line] for line in cells_of(table, quantity)]
    return [head, *([label, *line] for label, line in zip(table.rows, cells, strict=True))]


def shown(cell: Interval, decimals: int = 2) -> str:
    """
    A mean and its interval, such as ``0.85 [0.79, 0.89]``. Intervals of means are Student's, which know no bounds: of what is
    never negative, such as a count, the lower end may be.
    """
    mean, low, high = (f"{rounded(value, decimals):.{decimals}f}" for value in cell)
    return mean + (f" [{low}, {high}]" if math.isfinite(cell.low) else "")


@dataclass
class Ratings:
    """
    Both sides' ratings.

    :param table: of the matches
    :param metric: the pay-off of the equilibrium
    """

    table: PayOffTable
    metric: str

    def __post_init__(self) -> None:
        wins = self.table.values.get(f"won_{self.table.row_group}")
        self.elo: Elo | None = None if wins is None else elo(wins.sum(axis=2), self.table.n_episodes)
        self.equilibrium: Equilibrium = equilibrium(self.table.pay_offs(self.metric))

    def by_group(self) -> dict[str, list[dict[str, Any]]]:
        """Group → of each of its players the label, Elo, share in the equilibrium, and pay-off against the other side's."""
        table, nash = self.table, self.equilibrium
        sides = {
            table.row_group: (table.rows, self.elo and self.elo.rows, nash.rows, nash.row_pay_offs),
            table.column_group: (table.columns, self.elo and self.elo.columns, nash.columns, nash.column_pay_offs),
        }
        return {
            group: [
                {
                    "player": label,
                    **({"elo": ratings[i]} if ratings else {}),
                    "share": float(shares[i]),
                    "pay_off": float(pay_offs[i]),
                }
                for i, label in enumerate(labels)
            ]
            for group, (labels, ratings, shares, pay_offs) in sides.items()
        }

    def lines(self) -> list[list[str]]:
        """As a table of texts, its head first; the best of each side first."""
        head = ["group", "player", *(["Elo"] if self.elo else []), "share in equilibrium", "pay-off against equilibrium"]
        lines = [head]
        for group, players in self.by_group().items():
            sign = -1 if group == self.table.row_group else 1
            for one in sorted(players, key=lambda player: sign * player["pay_off"]):
                rating = [f"{one['elo'].mean:.0f} ± {one['elo'].high - one['elo'].mean:.0f}"] if self.elo else []
                lines.append([group, one["player"], *rating, f"{one['share']:.2f}", f"{rounded(one['pay_off']):.2f}"])
        return lines


def as_text(lines: Sequence[Sequence[str]]) -> str:
    """A table of texts with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(map(str.ljust, line, widths)).rstrip() for line in lines)


def as_markdown(lines: Sequence[Sequence[str]]) -> str:
    """A table of texts in Markdown."""
    head, *body = lines
    return "\n".join(f"| {' | '.join(line)} |" for line in [head, ["---"] * len(head), *body])


def plain(value: Any) -> Any:
    """A value as JSON can hold it: intervals by name, what is not a number as null."""
    if isinstance(value, Interval):
        return {name: plain(bound) for name, bound in value._asdict().items()}
    if isinstance(value, Mapping):
        return {name: plain(own) for name, own in value.items()}
    if isinstance(value, list | tuple):
        return [plain(own) for own in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    with atomic_write(path) as file:
        file.write(text.encode("utf-8"))


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write a JSON file."""
    write_text(path, json.dumps(plain(values), indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_table(table: PayOffTable, ratings: Ratings, about: Mapping[str, Any], folder: Path) -> None:
    """
    ``match.json`` (all numbers), ``match.npz`` (every episode), ``match.md`` and ``match.png``.

    :param table: of the matches
    :param ratings: of the players
    :param about: the command, players, seeds and versions
    :param folder: where the files go
    """
    rows, columns = table.row_group, table.column_group
    every_cell = {quantity: cells_of(table, quantity) for quantity in table.values}
    played = [
        {rows: row, columns: column, **{quantity: cells[i][k] for quantity, cells in every_cell.items()}}
        for i, row in enumerate(table.rows)
        for k, column in enumerate(table.columns)
    ]
    write_json(
        folder / "match.json",
        {
            **about,
            "rows": rows,
            "columns": columns,
            "metric": ratings.metric,
            "matches": played,
            "value": ratings.equilibrium.value,
            "ratings": ratings.by_group(),
        },
    )
    save_arrays(folder / "match.npz", {"seeds": table.seed + np.arange(table.n_episodes), **table.values})
    parts = [
        f"# {about['env']}: {rows} against {columns}",
        f"{table.n_episodes} episodes per match, seeds {table.seed} to {table.seed + table.n_episodes - 1}; means with their "
        f"95 % intervals. Versions: {', '.join(f'{name} {number}' for name, number in about['versions'].items())}.",
        f"    {about['command']}",
        "## Ratings",
        f"Pay-off: {ratings.metric}; value of the equilibrium {ratings.equilibrium.value:.3f}.",
        as_markdown(ratings.lines()),
    ]
    for quantity in dict.fromkeys([ratings.metric, *table.values]):
        parts += [f"## {quantity}", as_markdown(table_lines(table, quantity))]
    write_text(folder / "match.md", "\n\n".join(parts) + "\n")
    draw_table(table, ratings.metric, about["env"], folder / "match.png")


def draw_table(table: PayOffTable, metric: str, env_id: str, path: Path) -> None:
    """
    The table as a heat map.

    :param table: of the matches
    :param metric: what is drawn
    :param env_id: of the world, for the title
    :param path: of the PNG
    """
    cells, means = cells_of(table, metric), table.means(metric)
    limits = (0.0, 1.0) if metric in table.shares else (float(means.min()), float(means.max()))
    size = (3.2 + 1.25 * len(table.columns), 1.9 + 0.6 * len(table.rows))
    title = f"{env_id}: {described(metric)}\nmean and 95 % interval over {table.n_episodes} episodes"
    figure, (axis,) = new_figure(1, None, size)
    draw_heat_map(axis, cells, table.rows, table.columns, limits, described(metric))
    axis.set_title(title, fontsize="medium")
    axis.set_ylabel(table.row_group)
    axis.set_xlabel(table.column_group)
    save_figure(figure, path)


def described(quantity: str) -> str:
    """What a quantity is, for axes."""
    kind, _, group = quantity.partition("_")
    if kind == "won":
        return f"win rate of {group}"
    if kind == "return":
        return f"return per {group.removeprefix('per_')} (reward per episode)"
    return quantity.replace("_", " ")


@dataclass(frozen=True)
class Curve:
    """
    A run over its training.

    :param label: of the run
    :param algo: the algorithm, which gives the line its colour
    :param run: the folder
    :param points: number of env steps → the metric with its interval
    """

    label: str
    algo: str
    run: str
    points: dict[int, Interval]


def write_curves(
    curves: Sequence[Curve], of: str, metric: str, is_share: bool, about: Mapping[str, Any], folder: Path
) -> None:
    """
    ``curve.json`` and ``curve.png``.

    :param curves: of the runs
    :param of: who meets whom, for the title
    :param metric: what was measured
    :param is_share: whether it says how far somebody won
    :param about: the command, players, seeds and versions
    :param folder: where the files go
    """
    runs = {own.label: {"run": own.run, "steps": list(own.points), "intervals": list(own.points.values())} for own in curves}
    write_json(folder / "curve.json", {**about, "metric": metric, "curves": runs})

    figure, (axis,) = new_figure(1)
    drawn: dict[str, int] = {}
    for own in curves:
        dashes = CURVE_DASHES[drawn.get(own.algo, 0) % len(CURVE_DASHES)]
        drawn[own.algo] = drawn.get(own.algo, 0) + 1
        colour = ALGO_COLOURS.get(own.algo, REFERENCE_COLOUR)
        draw_intervals(axis, list(own.points), list(own.points.values()), colour, own.label, dashes)
    axis.set_xlabel("training (env steps)")
    axis.set_ylabel(described(metric))
    axis.set_title(
        f"{about['env']}: {of}\nmean and 95 % interval over {about['n_episodes']} episodes per point", fontsize="medium"
    )
    if is_share:
        axis.set_ylim(-0.03, 1.03)
    axis.legend(fontsize="small")
    save_figure(figure, folder / "curve.png")
