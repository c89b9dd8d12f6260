"""Everybody against everybody: pay-off tables of two groups' players, and one side's results over its training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_kfcv.common.evaluation import Interval, share_with_interval, with_interval
from sb3_kfcv.matches.arena import Arena, Episodes


@dataclass(frozen=True)
class PayOffTable:
    """
    Matches of each player of one group against each of another, on the same seeds.

    :param row_group: the group of the rows
    :param column_group: the group of the columns
    :param rows: labels of the row group's players
    :param columns: labels of the column group's players
    :param seed: of the first episode of every match
    :param values: of each quantity (see :meth:`~sb3_kfcv.matches.arena.Episodes.quantities`) every episode
        (rows, columns, episodes)
    :param shares: the quantities in [0, 1] that say how far somebody won
    """

    row_group: str
    column_group: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    seed: int
    values: dict[str, np.ndarray]
    shares: frozenset[str]

    @property
    def n_episodes(self) -> int:
        return self.values["length"].shape[2]

    def means(self, quantity: str) -> np.ndarray:
        """Means of a quantity (rows, columns)."""
        return self.values[quantity].mean(axis=2)

    def interval(self, quantity: str, row: int, column: int) -> Interval:
        """A quantity in one match; Wilson's interval for how far somebody won, Student's else."""
        return interval_of(self.values[quantity][row, column], quantity in self.shares)

    def pay_offs(self, quantity: str) -> np.ndarray:
        """
        What the rows want much of and the columns little (rows, columns): the means of a quantity, with the other sign if it
        is the columns' own win or return.
        """
        of_columns = quantity in (f"won_{self.column_group}", f"return_{self.column_group}")
        return -self.means(quantity) if of_columns else self.means(quantity)


def interval_of(values: np.ndarray, is_share: bool) -> Interval:
    """
    A mean over episodes with its 95 % interval.

    :param values: (episodes,)
    :param is_share: whether they say how far somebody won, in [0, 1]
    """
    return share_with_interval(values) if is_share else with_interval(values)


def shares_of(arena: Arena) -> frozenset[str]:
    """The quantities of a world that say how far somebody won."""
    return frozenset({*arena.wins.values(), *(f"won_{group}" for group in arena.layout.group_names)})


def pay_off_table(
    arena: Arena,
    rows: Mapping[str, Any],
    columns: Mapping[str, Any],
    groups: tuple[str, str],
    n_episodes: int,
    seed: int = 0,
    others: Mapping[str, Any] | None = None,
    progress: Callable[[], Any] = lambda: None,
) -> PayOffTable:
    """
    Play everybody of one group against everybody of another.

    :param arena: where
    :param rows: label → player of the first group, see :meth:`~sb3_kfcv.matches.arena.Arena.side`
    :param columns: label → player of the second group
    :param groups: the two groups
    :param n_episodes: of each match
    :param seed: of the first episode of every match; the others follow
    :param others: the player of each further group
    :param progress: called after each match
    :raises ValueError: for no player on a side, and as :meth:`~sb3_kfcv.matches.arena.Arena.side` and
        :meth:`~sb3_kfcv.matches.arena.Arena.play` do
    """
    row_group, column_group = groups
    for group, players in zip(groups, (rows, columns), strict=True):
        if not players:
            raise ValueError(f"there is nobody to play {group}")
    sides = {group: arena.side(group, player) for group, player in (others or {}).items()}
    row_sides = [arena.side(row_group, player) for player in rows.values()]
    column_sides = [arena.side(column_group, player) for player in columns.values()]
    cells: list[list[dict[str, np.ndarray]]] = []
    for row in row_sides:
        cells.append([])
        for column in column_sides:
            players = {**sides, row_group: row, column_group: column}
            cells[-1].append(arena.play(players, n_episodes, seed).quantities())
            progress()
    values = {name: np.array([[cell[name] for cell in line] for line in cells]) for name in cells[0][0]}
    return PayOffTable(row_group, column_group, tuple(rows), tuple(columns), seed, values, shares_of(arena))


def curve(
    arena: Arena,
    group: str,
    snapshots: Mapping[int, Any],
    opponents: Mapping[str, Any],
    n_episodes: int,
    seed: int = 0,
    progress: Callable[[], Any] = lambda: None,
) -> dict[int, Episodes]:
    """
    How well a group does over its training, against opponents that stay the same.

    :param arena: where
    :param group: that was trained
    :param snapshots: number of env steps → its player then, see :meth:`~sb3_kfcv.matches.arena.Arena.side`
    :param opponents: the player of each other group
    :param n_episodes: of each match
    :param seed: of the first episode of every match; the others follow
    :param progress: called after each match
    :return: number of env steps → episodes, in order of steps
    """
    fixed = {other: arena.side(other, player) for other, player in opponents.items()}
    sides = {steps: arena.side(group, snapshots[steps]) for steps in sorted(snapshots)}
    played = {}
    for steps, side in sides.items():
        played[steps] = arena.play({**fixed, group: side}, n_episodes, seed)
        progress()
    return played
