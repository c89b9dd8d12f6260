"""
Matches of everybody against everybody: ``python zoo/match.py --team wolf=logs/maddpg/Grassland-v0_1 wolf=chase sheep=graze``.

Players are saved models of any algorithm, checkpoints, runs, and scripted policies. The pay-off table, ratings and pictures
are written into a folder. The same command gives the same numbers, whatever ``--n-envs`` is.
"""

from __future__ import annotations

import argparse
import glob
import re
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
from sb3_kfcv.saving.files import is_path
from sb3_kfcv.teams.players import scripted_for
from sb3_kfcv.vec_env.make import make_vec_env
from zoo.command_line import PAIRS, REFUSALS, SEVERAL, Parser, as_it_was_typed, refused, start, whole_number
from zoo.hyperparams import check_env_kwargs, parse_pairs
from zoo.match_results import Curve, Ratings, as_text, described, shown, table_lines, write_curves, write_table
from zoo.run_folder import RunFolder, file_to_play
from zoo.runs import natural

DESCRIPTION = """\
Play everybody of one group against everybody of another: saved models of any algorithm, checkpoints, runs, and scripted
policies. Pay-off tables, win rates with intervals, Elo and equilibrium ratings go to the screen and into a folder. The same
command gives the same numbers to the bit."""
EXAMPLES = (
    "--env Grassland-v0 -n 200",
    "--team wolf=logs/kfcv_maddpg/Grassland-v0_1 wolf=chase --team sheep=graze sheep=flee",
    "--curve logs/kfcv_maddpg/Grassland-v0_1 --against sheep=graze",
)

RANDOM = "random"  # plays the groups that no row and no column is for


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("match", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("--env", default="Grassland-v0", help="id of the world (default: %(default)s)")
    add(
        "--team",
        **SEVERAL,
        metavar="GROUP=PLAYER",
        help="who plays a group: a scripted policy, a file, a run folder, or a quoted pattern of paths, such as wolf=chase "
        "sheep=logs/maddpg/Grassland-v0_1 (default: every scripted policy). The group named first makes the rows",
    )
    add("-n", "--n-episodes", type=whole_number, default=200, help="of each match (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the first episode of every match (default: %(default)s)")
    add("--best", action="store_true", help="of run folders take best_model.zip, not the last model")
    add("--metric", help="what the table shows (default: win rate of the rows where the world says who wins, else return)")
    add(
        "--curve", action="append", default=[], metavar="RUN_DIR", help="measure a run over its training, too; may be repeated"
    )
    add("--against", metavar="GROUP=PLAYER", help="the opponent of --curve")
    add("--env-kwargs", **PAIRS, help="settings of the world")
    add("--n-envs", type=int, default=64, help="worlds side by side, for speed alone (default: %(default)s)")
    add("--num-threads", type=int, default=1, help="threads of PyTorch (default: %(default)s)")
    add("-o", "--output", default="match", help="folder of the results (default: %(default)s)")
    return parser


@dataclass
class Matches:
    """
    All that is to be played, found and checked.

    :param arena: where
    :param groups: of the rows, and of the columns
    :param players: group → label → side; of further groups the one that plays all along
    :param sources: group → label → name of a scripted policy, or path of a file
    :param metric: what the table and the curves show
    :param runs: label → folder of each run to be measured over its training
    :param snapshots: label → number of env steps → side, of each such run
    :param trained: the group that the runs are measured in
    :param opponents: whom they meet there: group → side
    """

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


def parse_team(words: Sequence[str], known: Sequence[str], flag: str = "--team") -> dict[str, list[str]]:
    """
    Group → players, as named on the command line, in the order in which the groups are named first.

    :param words: such as ``["wolf=chase", "wolf=wolves.zip"]``
    :param known: the groups of the world
    :param flag: for the message
    :raises ValueError: for a text that is no pair, and for an unknown group, with the nearest one
    """
    named: dict[str, list[str]] = {}
    for word in words:
        group, equals, player = word.partition("=")
        if not equals or not group or not player:
            raise ValueError(f'{flag} takes GROUP=PLAYER, such as {known[0]}=random; got "{word}"')
        if group not in known:
            raise ValueError(unknown_name("group", group, known))
        named.setdefault(group, []).append(player)
    return named


def found(player: str, group: str, best: bool = False) -> list[str]:
    """
    The players that a word of the command line stands for: names of scripted policies, and paths of files; a mixture is
    several of these between commas.

    :param player: a name, a file, a run folder, a pattern of paths, or a mixture
    :param group: whom it is to play
    :param best: of run folders take the model of the best evaluation
    :raises ValueError: if a pattern matches nothing, there is no such file, or a folder is no run, or has no model
    """
    if "," in player:
        return [",".join(one for part in player.split(",") for one in found(part, group, best))]
    paths = [player]
    if glob.has_magic(player):
        paths = sorted(glob.glob(player), key=natural)
        if not paths:
            raise ValueError(f'no file and no folder matches "{player}"')
    return [str(file_to_play(path, group if best else None)) if is_path(path) else path for path in paths]


def fit(arena: Arena, group: str, player: str, best: bool) -> list[str]:
    """
    As :func:`found`; of what a pattern matches, only those that can play the group here. A note names the others.

    :raises FileFormatError: for a damaged file
    """
    players = found(player, group, best)
    if not glob.has_magic(player):
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


def label_of(player: str) -> str:
    """
    A short name: that of a scripted policy, ``kfcv_maddpg_1`` for the model of a run, with ``best`` or the number of env steps
    where it is not the last one, else that of the file.

    :param player: name of a scripted policy, or path of a file
    """
    if "," in player:
        return "+".join(map(label_of, player.split(",")))
    if not is_path(player):
        return player
    path = Path(player).resolve()
    folder = path.parent.parent if path.parent.name == "players" else path.parent
    if not list(folder.glob("*/args.yml")):
        return path.stem
    run = f"{folder.parent.name}_{folder.name.rpartition('_')[2]}"
    steps = re.search(r"_(\d+)(_steps)?\.zip$", path.name)
    if path == RunFolder.existing(folder).last_model.resolve():
        return run
    return f"{run}@{steps.group(1)}" if steps else f"{run} {path.stem.removesuffix('_model')}"


def labelled(players: Sequence[str]) -> dict[str, str]:
    """
    Label → player, each once; those of one short name are told apart by as much of their paths as it takes.

    :param players: names of scripted policies, and paths of files
    """
    own = list({player if not is_path(player) else Path(player).resolve(): player for player in players}.values())
    labels = [label_of(player) for player in own]
    for i, player in enumerate(own):
        rivals = [other for k, other in enumerate(own) if label_of(other) == label_of(player) and k != i]
        if rivals and is_path(player):
            parts, *others = [Path(one).resolve().parts for one in (player, *rivals)]
            depth = next(n for n in range(1, 1 + len(parts)) if parts[-n:] not in [rival[-n:] for rival in others])
            labels[i] = "/".join(parts[-depth:])
    return dict(zip(labels, own, strict=True))


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
    env_kwargs = check_env_kwargs(args.env, parse_pairs("--env-kwargs", args.env_kwargs))
    env = make_vec_env(args.env, min(args.n_envs, args.n_episodes), env_kwargs=env_kwargs)
    arena = Arena(env)
    known = arena.layout.group_names
    if len(known) < 2:
        raise ValueError(f"{args.env} has one group, {known[0]}; a match is between two")
    if bool(args.curve) != bool(args.against):
        raise ValueError("--curve RUN_DIR and --against GROUP=PLAYER go together: who is measured, and against whom")

    named = parse_team(args.team, known)
    order = [*named, *(group for group in known if group not in named)]
    groups = (order[0], order[1])
    sources, players = {}, {}
    for group in order:
        default = scripted_for(arena.layout, group) if group in groups else [RANDOM]
        sources[group] = labelled([one for word in named.get(group, default) for one in fit(arena, group, word, args.best)])
        if group not in groups and len(sources[group]) > 1:
            raise ValueError(
                f"{' and '.join(groups)} make the table; give {group} one player, not {', '.join(sources[group])}"
            )
        players[group] = {label: side(arena, group, player) for label, player in sources[group].items()}

    against = parse_team([args.against] if args.against else [], known, "--against")
    opponents = {group: arena.side(group, RANDOM) for group in known}
    opponents |= {group: one for group, own in players.items() if group not in groups for one in own.values()}
    for group, (word,) in against.items():
        files = found(word, group, args.best)
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
    return Matches(arena, groups, players, sources, metric, runs, snapshots, trained, opponents)


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
        folder.mkdir(parents=True, exist_ok=True)
    except REFUSALS as error:
        return refused(error)
    except OSError as error:
        return refused(OSError(f"the results cannot be written to {args.output}: {error.strerror}"))
    about = {
        "command": as_it_was_typed("match", argv),
        "env": args.env,
        "env_kwargs": parse_pairs("--env-kwargs", args.env_kwargs),
        "seed": args.seed,
        "n_episodes": args.n_episodes,
        "players": matches.sources,
        "versions": library_versions(),
    }
    if args.team or not args.curve:
        make_table(matches, about, folder)
    if args.curve:
        make_curves(matches, {**about, "group": matches.trained, "against": args.against}, folder)
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
