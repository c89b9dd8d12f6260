"""
Measure models and scripted policies: ``python zoo/evaluate.py logs/kfcv_maddpg/Grassland-v0_1 chase --team sheep=graze``.

All play the same episodes. The same command gives the same numbers, whatever ``--n-envs`` is.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.evaluation import Interval
from sb3_kfcv.matches.pay_off import interval_of, shares_of
from sb3_kfcv.saving.archive import library_versions
from zoo.command_line import REFUSALS, Parser, as_it_was_typed, refused, require_writable, start, unwritable, whole_number
from zoo.match import progress_line
from zoo.match_results import as_text, shown, write_json
from zoo.playing import Cast, Playing, add_players, check_metrics, check_players, in_words, main_quantities, playing
from zoo.plots import save_arrays

DESCRIPTION = """\
Measure models, checkpoints, runs and scripted policies, each over the same episodes: every metric of the world with its 95 %
interval (Student's t for means, Wilson's for shares won), as a table and as JSON. Each plays in the world of the first run
and against the opponents of its training, or those of --team. The same command gives the same numbers to the bit."""
EXAMPLES = (
    "-n 1000",
    "logs --env HardSpread-v0 oracle random -n 200",
    "logs/maddpg/Grassland-v0_1 logs/kfcv_maddpg/Grassland-v0_1 chase --team sheep=graze --json wolves.json",
    "model.zip --env mpe2/simple_spread_v3 --metrics return_agent length",
)


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("evaluate", DESCRIPTION, EXAMPLES)
    add_players(parser, "whom to measure, one or several")
    add = parser.add_argument
    add("-n", "--n-episodes", type=whole_number, default=100, help="of each player (default: %(default)s)")
    add(
        "--metrics", nargs="+", default=[], metavar="NAME", help="columns of the table (default: all but terms of the rewards)"
    )
    add("--json", metavar="FILE", help="where all numbers go")
    add("--episodes", metavar="FILE", help="where every episode's numbers go, as .npz")
    add("--n-envs", type=int, default=64, help="worlds side by side, for speed alone (default: %(default)s)")
    return parser


def build(args: argparse.Namespace) -> Playing:
    """
    Everything that can be refused, before anything is played.

    :param args: the command line
    :raises ValueError: one sentence that says what is wrong
    """
    check_players(args)
    require_count("-n", args.n_episodes)
    require_count("--n-envs", args.n_envs)
    for flag, name, ending in (("--json", args.json, ".json"), ("--episodes", args.episodes, ".npz")):
        if name is not None and Path(name).suffix != ending:
            raise ValueError(f"{flag} writes a file that ends in {ending}, not {name}")
    measured = playing(args, min(args.n_envs, args.n_episodes))
    check_metrics(args.metrics, measured.arena)
    return measured


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, or 2 for bad input
    """
    try:
        args = make_parser().parse_all(argv)
        measured = build(args)
        require_writable(*(name for name in (args.json, args.episodes) if name is not None))
    except REFUSALS as error:
        return refused(error)
    values = play(measured, args.n_episodes, args.seed)
    results = intervals(measured, values)
    tell(measured, results, args.metrics, in_words(args.n_episodes, args.seed))
    about = {
        "command": as_it_was_typed("evaluate", argv),
        "env": measured.world.env_id,
        "env_kwargs": measured.world.env_kwargs,
        "env_wrapper": measured.world.env_wrapper,
        "seed": args.seed,
        "n_episodes": args.n_episodes,
        "versions": library_versions(),
    }
    players = [{"player": cast.label, "plays": cast.sources, **results[cast.label]} for cast in measured.casts]
    writers = {
        args.json: lambda: write_json(Path(args.json), {**about, "players": players}),
        args.episodes: lambda: write_episodes(Path(args.episodes), values, args.seed),
    }
    for name, write in writers.items():
        if name is not None:
            try:
                write()
            except OSError as error:
                return refused(OSError(unwritable(name, error)))
            print(f"written: {name}")
    return 0


def play(measured: Playing, n_episodes: int, seed: int) -> dict[str, dict[str, np.ndarray]]:
    """
    Everybody's episodes, with a progress line.

    :param measured: who plays where
    :param n_episodes: of each
    :param seed: of the first
    :return: label → quantity → its value in every episode (episodes,)
    """
    values = {}
    with progress_line(len(measured.casts)) as bar:
        for cast in measured.casts:
            values[cast.label] = measured.arena.play(cast.players, n_episodes, seed).quantities()
            bar.update()
    return values


def intervals(measured: Playing, values: Mapping[str, Mapping[str, np.ndarray]]) -> dict[str, dict[str, Interval]]:
    """
    Means and their intervals.

    :param measured: who plays where
    :param values: as :func:`play` gave them
    :return: label → quantity → its interval
    """
    shares = shares_of(measured.arena)
    return {
        label: {name: interval_of(own, name in shares) for name, own in quantities.items()}
        for label, quantities in values.items()
    }


def tell(measured: Playing, results: Mapping[str, Mapping[str, Interval]], metrics: Sequence[str], episodes: str) -> None:
    """
    Print who was measured, and the table: players below each other, or, of a single one, its metrics.

    :param measured: who plays where
    :param results: label → quantity → its interval
    :param metrics: the columns; by default what is most telling
    :param episodes: how many, and which
    """
    print(f"{measured.world.env_id}, {episodes}; means with their 95 % intervals\n")
    casts = measured.casts
    if len(casts) == 1:
        (own,) = results.values()
        print(f"{casts[0]}\n\n{as_text([[name, shown(own[name])] for name in metrics or own])}\n")
        return
    same = same_in_all(casts)
    if same:
        print(", ".join(f"{group}: {name}" for group, name in same.items()) + "\n")
    names = list(metrics) or main_quantities(measured.arena)
    rows = {cast.label: others(cast, same) for cast in casts}
    for columns in side_by_side(names, results, max(map(len, rows.values()))):
        lines = [[row, *(shown(results[label][name]) for name in columns)] for label, row in rows.items()]
        print(as_text([["player", *columns], *lines]) + "\n")


def same_in_all(casts: Sequence[Cast]) -> dict[str, str]:
    """The groups that the same one plays whoever is measured, by what name."""
    return {group: name for group, name in casts[0].names.items() if all(cast.names[group] == name for cast in casts)}


def others(cast: Cast, same: Mapping[str, str]) -> str:
    """A player's row in the table: its label, and who else plays unless that is the same in all rows."""
    further = [f"{group}: {name}" for group, name in cast.names.items() if group not in same and name != cast.label]
    return f"{cast.label} ({', '.join(further)})" if further else cast.label


def side_by_side(names: Sequence[str], results: Mapping[str, Mapping[str, Any]], head: int) -> list[list[str]]:
    """
    The columns in tables that fit the screen, at least one column in each.

    :param names: of the columns
    :param results: label → quantity → its interval
    :param head: width of the first column, in letters
    """
    width = shutil.get_terminal_size((127, 24)).columns
    tables: list[list[str]] = [[]]
    used = head
    for name in names:
        own = 2 + max(len(name), *(len(shown(of_one[name])) for of_one in results.values()))
        if tables[-1] and used + own > width:
            tables.append([])
            used = head
        tables[-1].append(name)
        used += own
    return tables


def write_episodes(path: Path, values: Mapping[str, Mapping[str, np.ndarray]], seed: int) -> None:
    """
    Every episode of everybody: ``players``, ``seeds`` (episodes,), and each quantity (players, episodes).

    :param path: of the file
    :param values: label → quantity → (episodes,)
    :param seed: of the first episode
    """
    first = next(iter(values.values()))
    arrays = {name: np.stack([own[name] for own in values.values()]) for name in first}
    save_arrays(path, {"players": np.array(list(values)), "seeds": seed + np.arange(len(first["length"])), **arrays})


if __name__ == "__main__":
    start(main, "interrupted; nothing was written of what was not finished")
