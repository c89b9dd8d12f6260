"""
Matches of everybody against everybody: ``python zoo/match.py --team wolf=logs/maddpg/Grassland-v0_1 wolf=chase sheep=graze``.

Players are saved models of any algorithm, checkpoints, runs, and scripted policies. The pay-off table, ratings and pictures
are written into a folder. The same command gives the same numbers, whatever ``--n-envs`` is.
"""

from __future__ import annotations

import argparse
import glob
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.matches import Arena, PayOffTable, Side, curve, pay_off_table
from sb3_kfcv.matches.pay_off import interval_of, shares_of
from sb3_kfcv.saving.archive import FileFormatError, library_versions
from sb3_kfcv.teams.players import scripted_for
from zoo.command_line import (
    PAIRS,
    REFUSALS,
    SEVERAL,
    Parser,
    as_it_was_typed,
    refused,
    require_writable,
    start,
    unwritable,
    whole_number,
)
from zoo.match_results import Curve, Ratings, as_text, described, shown, table_lines, write_curves, write_table
from zoo.named_players import found, label_of, labelled, parse_team, run_of
from zoo.run_folder import RunFolder
from zoo.runs import Run, natural
from zoo.worlds import World, find_world

DESCRIPTION = """\
Play everybody of one group against everybody of another: saved models of any algorithm, checkpoints, runs, and scripted
policies. Pay-off tables, win rates with intervals, Elo and equilibrium ratings go to the screen and into a folder. The same
command gives the same numbers to the bit."""
EXAMPLES = (
    "--env Grassland-v0 -n 200",
    "--team wolf=logs/kfcv_maddpg/Grassland-v0_1 wolf=chase --team sheep=graze sheep=flee",
    "--curve logs/kfcv_maddpg/Grassland-v0_1 --against sheep=graze",
)

DEFAULT_WORLD = "Grassland-v0"
RANDOM = "random"  # plays the groups that no row and no column is for


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("match", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("--env", help=f"id of the world (default: that of the runs, else {DEFAULT_WORLD})")
    add(
        "--team",
        **SEVERAL,
        metavar="GROUP=PLAYER",
        help="who plays a group: a scripted policy, a file, a run folder, or a quoted pattern of paths, such as wolf=chase "
        "sheep=logs/maddpg/Grassland-v0_1 (default: every scripted policy). The group named first makes the rows",
    )
    add("-n", "--n-episodes", type=whole_number, default=200, help="of each match (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the first episode of every match (default: %(default)s)")
    add("--load-best", action="store_true", help="of run folders take best_model.zip, not the last model")
    add("--metric", help="what the table shows (default: win rate of the rows where the world says who wins, else return)")
    add(
        "--curve", action="append", default=[], metavar="RUN_DIR", help="measure a run over its training, too; may be repeated"
    )
    add("--against", metavar="GROUP=PLAYER", help="the opponent of --curve")
    add("--env-kwargs", **PAIRS, help="settings of the world where they differ from those of the runs")
    add("--n-envs", type=int, default=64, help="worlds side by side, for speed alone (default: %(default)s)")
    add("--num-threads", type=int, default=1, help="threads of PyTorch (default: %(default)s)")
    add("-o", "--output", default="match", help="folder of the results (default: %(default)s)")
    return parser


@dataclass
class Matches:
    """
    All that is to be played, found and checked.

    :param world: where
    :param arena: worlds of it
    :param groups: of the rows, and of the columns
    :param players: group → label → side; of further groups the one that plays all along
    :param sources: group → label → name of a scripted policy, or path of a file
    :param metric: what the table and the curves show
    :param runs: label → folder of each run to be measured over its training
    :param snapshots: label → number of env steps → side, of each such run
    :param trained: the group that the runs are measured in
    :param opponents: whom they meet there: group → side
    """

    world: World
    arena: Arena
    groups: tuple[str, str]
    players: dict[str, dict[str, Side]]
    sources: dict[str, dict[str, str]]
    metric: str
    runs: dict[str, RunFolder]
    snapshots: dict[str, dict[int, Side]]
    trained: str
    opponents: dict[str, Side]

    @property
    def others(self) -> dict[str, Side]:
        """Who plays the groups that are neither rows nor columns."""
        return {group: one for group, own in self.players.items() if group not in self.groups for one in own.values()}


def fit(arena: Arena, group: str, player: str, best: bool) -> list[str]:
    """
    As :func:`found`; of what a pattern or a folder of runs means, only those that can play the group here. A note names
    the others.

    :raises FileFormatError: for a damaged file
    """
    players = found(player, group, best)
    if not glob.has_magic(player) and len(players) == 1:
        return players
    fitting = []
    for path in players:
        try:
            arena.side(group, path)
        except FileFormatError:
            raise
        except ValueError as error:
            print(f"note: left out: {error}", file=sys.stderr)
        else:
            fitting.append(path)
    if not fitting:
        raise ValueError(f'nothing that matches "{player}" can play {group} here')
    return fitting


def side(arena: Arena, group: str, player: str) -> Side:
    """
    Load a player.

    :param arena: where it is to play
    :param group: whom
    :param player: as :func:`found` gave it
    """
    return arena.side(group, player.split(",") if "," in player else player)


def runs_of(team: Sequence[str], curves: Sequence[str]) -> list[Run]:
    """
    The runs among those that the command line names.

    :param team: pairs GROUP=PLAYER
    :param curves: run folders
    """
    words = [*(player for pair in team for player in pair.partition("=")[2].split(",")), *curves]
    paths = [path for word in words for path in (sorted(glob.glob(word), key=natural) if glob.has_magic(word) else [word])]
    return [run for path in paths if (run := run_of(path)) is not None]


def build(args: argparse.Namespace) -> Matches:
    """
    Everything that can be refused, before anything is played.

    :param args: the command line
    :raises ValueError: one sentence that says what is wrong
    """
    for flag, value in (("-n", args.n_episodes), ("--n-envs", args.n_envs), ("--num-threads", args.num_threads)):
        require_count(flag, value)
    require_count("--seed", args.seed, least=0)
    th.set_num_threads(args.num_threads)
    runs_named = runs_of([*args.team, *([args.against] if args.against else [])], args.curve)
    if args.env is None and not runs_named:
        args.env = DEFAULT_WORLD
    world = find_world(args, runs_named)
    arena = Arena(world.make(min(args.n_envs, args.n_episodes)))
    known = arena.layout.group_names
    if len(known) < 2:
        raise ValueError(f"{world.env_id} has one group, {known[0]}; a match is between two")
    if bool(args.curve) != bool(args.against):
        raise ValueError("--curve RUN_DIR and --against GROUP=PLAYER go together: who is measured, and against whom")

    named = parse_team(args.team, known)
    order = [*named, *(group for group in known if group not in named)]
    groups = (order[0], order[1])
    sources, players = {}, {}
    for group in order:
        default = scripted_for(arena.layout, group) if group in groups else [RANDOM]
        sources[group] = labelled(
            [one for word in named.get(group, default) for one in fit(arena, group, word, args.load_best)]
        )
        if group not in groups and len(sources[group]) > 1:
            raise ValueError(
                f"{' and '.join(groups)} make the table; give {group} one player, not {', '.join(sources[group])}"
            )
        players[group] = {label: side(arena, group, player) for label, player in sources[group].items()}

    against = parse_team([args.against] if args.against else [], known, "--against")
    opponents = {group: arena.side(group, RANDOM) for group in known}
    opponents |= {group: one for group, own in players.items() if group not in groups for one in own.values()}
    for group, (word,) in against.items():
        files = found(word, group, args.load_best)
        if len(files) > 1:
            raise ValueError(f"--against {args.against} means {len(files)} players; give one")
        opponents[group] = side(arena, group, files[0])
    trained = next(group for group in order if group not in against)
    del opponents[trained]
    runs = {label_of(str(folder.last_model)): folder for folder in map(RunFolder.existing, args.curve)}
    snapshots = {}
    for label, folder in runs.items():
        saved = folder.snapshots(trained)
        if not saved:
            raise ValueError(f"the run in {folder.path} has no checkpoint and no saved player of {trained} yet")
        snapshots[label] = {steps: arena.side(trained, path) for steps, path in saved.items()}
    metric = args.metric or arena.default_quantity(trained if args.curve and not args.team else groups[0])
    if metric not in arena.quantities():
        raise ValueError(unknown_name("metric", metric, arena.quantities()))
    return Matches(world, arena, groups, players, sources, metric, runs, snapshots, trained, opponents)


def play_table(matches: Matches, n_episodes: int, seed: int) -> PayOffTable:
    """Everybody against everybody, with a progress line."""
    rows, columns = (matches.players[group] for group in matches.groups)
    with progress_line(len(rows) * len(columns)) as bar:
        return pay_off_table(
            matches.arena, rows, columns, matches.groups, n_episodes, seed, matches.others, progress=bar.update
        )


def progress_line(n_matches: int) -> Any:
    """A bar that counts matches, on a terminal."""
    return tqdm(total=n_matches, unit="match", disable=None, leave=False)


def play_curves(matches: Matches, n_episodes: int, seed: int) -> list[Curve]:
    """The metric of each run over its training, with a progress line."""
    curves = []
    with progress_line(sum(map(len, matches.snapshots.values()))) as bar:
        for label, sides in matches.snapshots.items():
            played = curve(matches.arena, matches.trained, sides, matches.opponents, n_episodes, seed, bar.update)
            is_share = matches.metric in shares_of(matches.arena)
            points = {steps: interval_of(own.quantities()[matches.metric], is_share) for steps, own in played.items()}
            run = matches.runs[label].path
            curves.append(Curve(label, run.resolve().parent.name, str(run), points))
    return curves


def show(title: str, lines: Sequence[Sequence[str]]) -> None:
    """Print a table."""
    print(f"{title}\n\n{as_text(lines)}\n")


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, or 2 for bad input
    """
    try:
        args = make_parser().parse_all(argv)
        matches = build(args)
        folder = Path(args.output)
        require_writable(folder / "match.json", folder / "curve.json")
    except REFUSALS as error:
        return refused(error)
    about = {
        "command": as_it_was_typed("match", argv),
        "env": matches.world.env_id,
        "env_kwargs": matches.world.env_kwargs,
        "seed": args.seed,
        "n_episodes": args.n_episodes,
        "players": matches.sources,
        "versions": library_versions(),
    }
    try:
        if args.team or not args.curve:
            make_table(matches, about, folder)
        if args.curve:
            make_curves(matches, {**about, "group": matches.trained, "against": args.against}, folder)
    except OSError as error:
        return refused(OSError(unwritable(folder, error)))
    return 0


def make_table(matches: Matches, about: Mapping[str, Any], folder: Path) -> None:
    """Play the table, write it, print it."""
    start = time.perf_counter()
    table = play_table(matches, about["n_episodes"], about["seed"])
    seconds = (time.perf_counter() - start) / (len(table.rows) * len(table.columns))
    ratings = Ratings(table, matches.metric)
    write_table(table, ratings, about, folder)
    for quantity in dict.fromkeys([matches.metric, *(f"return_{group}" for group in matches.groups)]):
        title = f"{described(quantity)}, mean and 95 % interval over {table.n_episodes} episodes"
        show(title, table_lines(table, quantity))
    show(f"ratings, by {described(matches.metric)}; value {ratings.equilibrium.value:.3f}", ratings.lines())
    print(f"{seconds:.2f} s per match; written: {folder / 'match.json'}, .md, .npz and .png")


def make_curves(matches: Matches, about: Mapping[str, Any], folder: Path) -> None:
    """Play the curves, write them, print them."""
    curves = play_curves(matches, about["n_episodes"], about["seed"])
    of = f"{matches.trained} against {about['against']}"
    write_curves(curves, of, matches.metric, matches.metric in shares_of(matches.arena), about, folder)
    for own in curves:
        points = [[f"{steps:,}", shown(point)] for steps, point in own.points.items()]
        show(f"{own.label}: {of}", [["env steps", described(matches.metric)], *points])
    print(f"written: {folder / 'curve.json'} and .png")


if __name__ == "__main__":
    start(main, "interrupted; nothing was written of what was not finished")
