"""Who plays in which world: what the commands that watch and measure make of the words of their users."""

from __future__ import annotations

import argparse
import glob
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.matches import Arena, Side
from sb3_kfcv.matches.arena import FrozenActors
from sb3_kfcv.saving.archive import open_archive
from sb3_kfcv.saving.checkpoints import checkpoints_in
from sb3_kfcv.saving.files import existing, is_path
from sb3_kfcv.saving.normalization import load_normalization
from sb3_kfcv.teams.players import PLAYER_KINDS, Mixture, load_player, roles_in, scripted_for
from sb3_kfcv.vec_env.make import layout_of
from zoo.command_line import PAIRS, SEVERAL, Parser, whole_number
from zoo.named_players import found, is_file, is_named, label_of, labelled, parse_team, run_of
from zoo.run_folder import RunFolder, file_to_play
from zoo.runs import Run, natural, pick_run, runs_below
from zoo.worlds import World, find_world

AS_TRAINED = "as in its training"


def add_players(parser: Parser, which: str) -> None:
    """
    The flags that say who plays in which world.

    :param parser: of the command
    :param which: what the words without a flag are for, for the help
    """
    add = parser.add_argument
    add(
        "players",
        nargs="*",
        metavar="PLAYER",
        help=f"{which}: a run folder, a file (model, checkpoint, saved player), or the name of a scripted policy "
        "(default: the latest run)",
    )
    add("-f", "--folder", default="logs", help="where the latest run is looked for (default: %(default)s)")
    add("--algo", help="the latest run of this algorithm")
    add("--env", help="the latest run in this world; with files and scripted policies, the world that they play in")
    add("--exp-id", type=int, default=0, help="number of the run, the k of <env>_<k>; 0: the latest (default: %(default)s)")
    add("--load-best", action="store_true", help="of run folders take the model of the best evaluation")
    add(
        "--load-checkpoint", type=whole_number, metavar="STEPS", help="of run folders take the checkpoint of so many env steps"
    )
    add("--load-last-checkpoint", action="store_true", help="of run folders take the latest checkpoint")
    add(
        "--team",
        **SEVERAL,
        metavar="GROUP=PLAYER",
        help="who plays a group whoever else plays, such as sheep=graze wolf=logs/maddpg/Grassland-v0_1 "
        "(default: the opponents of the training)",
    )
    add("--env-kwargs", **PAIRS, help="settings of the world where they differ from those of the run")
    add("--seed", type=int, default=0, help="of the first episode; the others follow: seed + 1, … (default: %(default)s)")
    add("--num-threads", type=int, default=1, help="threads of PyTorch (default: %(default)s)")


def check_players(args: argparse.Namespace) -> None:
    """
    Check the flags of :func:`add_players` that need no file, and set the number of threads.

    :raises ValueError: for a number out of range, and for two flags that exclude each other
    """
    require_count("--seed", args.seed, least=0)
    require_count("--num-threads", args.num_threads)
    require_count("--exp-id", args.exp_id, least=0)
    chosen = {
        "--load-best": args.load_best,
        "--load-checkpoint": args.load_checkpoint is not None,
        "--load-last-checkpoint": args.load_last_checkpoint,
    }
    if sum(chosen.values()) > 1:
        raise ValueError(f"{' and '.join(flag for flag, given in chosen.items() if given)} exclude each other")
    th.set_num_threads(args.num_threads)


@dataclass
class Cast:
    """
    Who plays every group of a world.

    :param label: short name of the one that this is about
    :param players: group → whoever :meth:`Arena.side` takes
    :param names: group → short name
    :param sources: group → name of a scripted policy, or path of a file
    :param run: the run that the player is of, if it is of one
    """

    label: str
    players: dict[str, Any]
    names: dict[str, str]
    sources: dict[str, str]
    run: Run | None = None

    def __str__(self) -> str:
        if len(set(self.names.values())) == 1:
            return self.label
        return ", ".join(f"{group}: {name}" for group, name in self.names.items())


class Normalized:
    """
    A model that learns from normalised observations: it normalises what it sees as in its training.

    :param policy: its actors
    :param statistics: what normalises
    """

    def __init__(self, policy: ActorPolicy, statistics: VecNormalize) -> None:
        self.layout, self.agents = policy.layout, policy.agents
        self._actors = FrozenActors(policy)
        self._statistics = statistics

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """Joint actions for a block of joint rows, as :meth:`FrozenActors.predict`."""
        normalized: Any = self._statistics.normalize_obs(observation)
        return self._actors.predict(normalized, deterministic=deterministic)


@dataclass
class Playing:
    """
    Who plays where, found and checked.

    :param world: where
    :param arena: worlds of it
    :param casts: who; several where several are measured one after the other
    """

    world: World
    arena: Arena
    casts: list[Cast]

    @property
    def cast(self) -> Cast:
        """
        The only one.

        :raises ValueError: if there are several
        """
        if len(self.casts) != 1:
            named = ", ".join(cast.label for cast in self.casts)
            raise ValueError(f"name one player to watch, not {named}; against each other they play by --team GROUP=PLAYER")
        return self.casts[0]


def playing(args: argparse.Namespace, n_envs: int, drawn: bool = False) -> Playing:
    """
    What the flags of :func:`add_players` say.

    :param args: the command line
    :param n_envs: worlds side by side
    :param drawn: whether they are to be drawn
    :raises ValueError: one sentence that says what is wrong
    """
    if args.players and args.exp_id:
        raise ValueError(f"--exp-id picks a run of -f, and {args.players[0]} is named; leave out the one or the other")
    words = [path for word in args.players for path in _expanded(word, args)]
    in_team = [word.partition("=")[2] for word in args.team]
    runs = [run for word in [*words, *in_team] if (run := run_of(word)) is not None]
    if not words and not _is_complete(args, runs):
        picked = pick_run(args.folder, args.algo, args.env, args.exp_id, to_play=True)
        words, runs = [str(picked.folder.path)], [picked, *runs]
    world = find_world(args, runs, words)
    arena = Arena(world.make(n_envs, drawn))
    if drawn:
        require_pictures(world, arena)
    return Playing(world, arena, _casts(args, world, arena, words))


def require_pictures(world: World, arena: Arena) -> None:
    """
    :raises ValueError: if a world draws nothing
    """
    arena.env.reset()
    if not arena.env.has_attr("scene") and arena.env.get_images()[0] is None:
        raise ValueError(f"{world.env_id} draws no pictures; zoo/enjoy.py --no-render tells its numbers")


def _expanded(word: str, args: argparse.Namespace) -> list[str]:
    """
    The paths that a word means: those that match a pattern, and the runs below a folder, of ``--algo`` and in ``--env`` alone
    where these are given.

    :raises ValueError: if it means none
    """
    paths = sorted(glob.glob(word), key=natural) if glob.has_magic(word) else [word]
    if not paths:
        raise ValueError(f'no file and no folder matches "{word}"')
    expanded: list[str] = []
    for path in paths:
        runs = runs_below(path) if Path(path).is_dir() else []
        if Path(path).is_dir() and not runs:
            raise ValueError(f"there is no run of zoo/train.py in {path}")
        runs = _fitting(path, runs, args)
        if "," not in path and is_named(path) and not Path(path).is_dir() and not existing(Path(path)).is_file():
            (file_to_play if Path(path).suffix else RunFolder.existing)(path)  # say what there is instead
        expanded += [str(run.folder.path) for run in runs] or [path]
    return expanded


def _fitting(path: str, runs: Sequence[Run], args: argparse.Namespace) -> list[Run]:
    """
    The runs of ``--algo`` and in ``--env``, where these are given; a run that is named itself may play in another world.

    :param path: that means them
    :param runs: below it
    :raises ValueError: if there are runs, but none such
    """
    of_it = [run for run in runs if args.algo in (None, run.algo)]
    fitting = (
        of_it if [run.folder.path for run in runs] == [Path(path)] else [r for r in of_it if args.env in (None, r.env_id)]
    )
    if runs and not fitting:
        wanted = " ".join([f"of {args.algo}"] * bool(args.algo) + [f"in {args.env}"] * bool(args.env))
        there = ", ".join(dict.fromkeys(f"{run.algo} in {run.env_id}" for run in runs))
        raise ValueError(f"there is no run {wanted} below {path}; there is {there}")
    return fitting


def _is_complete(args: argparse.Namespace, runs: Sequence[Run]) -> bool:
    """Whether ``--team`` alone says who plays every group."""
    if not args.team or (args.env is None and not runs):
        return False
    world = find_world(args, runs)
    layout = layout_of(world.make(1))
    return set(_named(args, world, layout.group_names)) == set(layout.group_names)


def _named(args: argparse.Namespace, world: World, groups: Sequence[str]) -> dict[str, list[str]]:
    """Group → players that ``--team`` names."""
    try:
        return parse_team(args.team, groups)
    except ValueError as error:
        raise ValueError(f"{world.env_id}: {error}") from None


def _casts(args: argparse.Namespace, world: World, arena: Arena, words: Sequence[str]) -> list[Cast]:
    groups = arena.layout.group_names
    fixed = {}
    for group, named in _named(args, world, groups).items():
        if len(named) > 1:
            raise ValueError(f"--team says twice who plays {group}")
        run = run_of(named[0])
        of_run = run is not None and Path(named[0]).is_dir()
        (source,) = [_file_of(run, group, args)] if run and of_run else found(named[0], group)
        fixed[group] = str(source)
    if not words:
        return [_cast(arena, ", ".join(map(label_of, fixed.values())), fixed, {}, {})]
    own = [_sources(word, arena.layout, fixed, args) for word in words]
    labels = {source: label for label, source in labelled([next(iter(sources.values())) for sources, _ in own]).items()}
    casts = {}
    for word, (sources, opponents) in zip(words, own, strict=True):
        label = labels.get(next(iter(sources.values())))
        if label is not None:  # else it was named before, by another path
            if len(sources) > 1:  # best_wolf and best_sheep
                label = label.removesuffix(f"_{next(iter(sources))}")
            casts[label] = _cast(arena, label, fixed, sources, opponents, run_of(word))
    return list(casts.values())


def _sources(
    word: str, layout: AgentLayout, fixed: Mapping[str, str], args: argparse.Namespace
) -> tuple[dict[str, str], dict[str, Any]]:
    """
    What one word stands for.

    :param word: a run folder, a file, or the name of a scripted policy
    :param layout: of the world
    :param fixed: the groups that are played by others
    :param args: the command line
    :return: group → name or file; and the opponents of its training
    """
    free = [group for group in layout.group_names if group not in fixed]
    if not free:
        raise ValueError(f"--team says who plays every group; leave out {word}")
    if not is_file(word):
        able = [group for group in free if set(word.split(",")) <= set(scripted_for(layout, group))]
        return dict.fromkeys(able or free[:1], word), {}
    run = run_of(word)
    if run is None or not Path(word).is_dir():
        (file,) = found(word, free[0])
        groups = roles_in(file)[0]
        files = dict.fromkeys(groups, file)
    else:
        groups = tuple(run.config.get("teams") or [])
        groups = groups or ((run.config["team"],) if run.config.get("team") else layout.group_names)
        files = {group: str(_file_of(run, group, args)) for group in groups}
    opponents = roles_in(next(iter(files.values())))[1] or (run.config.get("opponents") if run else None) or {}
    playing_here = {group: file for group, file in files.items() if group not in fixed}
    if not playing_here:
        raise ValueError(f"{word} plays {', '.join(groups)}, whom --team gives to others; wanted is a player of {free[0]}")
    return playing_here, opponents


def _file_of(run: Run, group: str, args: argparse.Namespace) -> Path:
    """
    The file of a run that is to play.

    :param run: the run
    :param group: whom it is to play
    :param args: the command line, which says which one
    :raises ValueError: if there is none such
    """
    folder = run.folder
    if args.load_checkpoint is not None:
        saved = folder.snapshots(group)
        if args.load_checkpoint not in saved:
            there = f"there are {', '.join(map(str, saved))}" if saved else "there is none yet"
            raise ValueError(f"the run in {folder.path} has no checkpoint of {args.load_checkpoint} env steps; {there}")
        return saved[args.load_checkpoint]
    if args.load_last_checkpoint:
        checkpoints = [*checkpoints_in(folder.path).values()]
        if not checkpoints:
            raise ValueError(f"the run in {folder.path} has no checkpoint yet")
        return checkpoints[0]
    return file_to_play(folder.path, group if args.load_best else None)


def _cast(
    arena: Arena,
    label: str,
    fixed: Mapping[str, str],
    own: Mapping[str, str],
    opponents: Mapping[str, Any],
    run: Run | None = None,
) -> Cast:
    """
    :raises ValueError: for a group that nobody plays, and for who cannot play
    """
    given = {**opponents, **own, **fixed}
    players: dict[str, Side] = {}
    for group in arena.layout.group_names:
        if group not in given:
            raise ValueError(f"nobody plays {group} beside {label}: add --team {group}=random, or another player")
        players[group] = _side(arena, group, given[group])
    names = {group: label if group in own else _name_of(given[group]) for group in players}
    sources = {group: given[group] if isinstance(given[group], str) else AS_TRAINED for group in players}
    return Cast(label, players, names, sources, run)


def _side(arena: Arena, group: str, player: Any) -> Side:
    if isinstance(player, str) and "," in player:
        return arena.side(group, player.split(","))
    if isinstance(player, str) and is_path(player):
        with open_archive(player, *PLAYER_KINDS) as archive:
            normalized = "normalization" in archive
        if normalized:
            own = Normalized(load_player(player, group), load_normalization(player, arena.env, training=False))
            return arena.side(group, own)
    return arena.side(group, player)


def _name_of(player: Any) -> str:
    if isinstance(player, str):
        return label_of(player)
    if isinstance(player, Mixture | list):
        return "+".join(map(_name_of, player if isinstance(player, list) else player.players))
    return AS_TRAINED


def in_words(n_episodes: int, seed: int) -> str:
    """How many episodes, and which."""
    return f"{n_episodes} episodes, seeds {seed} to {seed + n_episodes - 1}" if n_episodes > 1 else f"1 episode, seed {seed}"


def own_fps(arena: Arena) -> float:
    """Steps per second that a world is made to be seen at; 10 if it does not say."""
    metadata: dict[str, Any] = arena.env.metadata
    return float(metadata.get("render_fps") or 10)


def main_quantities(arena: Arena) -> list[str]:
    """What is told of episodes by default, the most telling first: all but what says the same again, and terms of rewards."""
    same = {*arena.wins.values(), *(f"return_per_{group}" for group in arena.layout.group_names)}
    return [name for name in arena.quantities() if name not in same and not name.endswith("_term")]


def check_metrics(names: Sequence[str], arena: Arena) -> None:
    """
    :param names: of metrics
    :param arena: whose they are to be
    :raises ValueError: for one that there is not, with the nearest one
    """
    for name in names:
        if name not in arena.quantities():
            raise ValueError(unknown_name("metric", name, arena.quantities()))
