"""
Watch a trained model play: ``python zoo/enjoy.py``.

By default the latest run, in a window where there is a display. The same command shows the same episodes.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_between, require_count
from sb3_kfcv.common.evaluation import Interval, rounded
from sb3_kfcv.envs.parallel_env import Window
from sb3_kfcv.matches.pay_off import interval_of, shares_of
from zoo.command_line import INTERRUPTED, REFUSALS, Parser, refused, start, whole_number
from zoo.match_results import as_text, shown
from zoo.playing import Playing, add_players, check_metrics, check_players, in_words, main_quantities, own_fps, playing
from zoo.recording import Camera

DESCRIPTION = """\
Watch somebody play: the latest run, a run folder, a file, or a scripted policy, in the world of its training and against the
opponents of its training. In a window where there is a display; the results of every episode and their means on the screen.
Episode i has the seed --seed + i, so the same command shows the same episodes, and zoo/evaluate.py counts the same ones."""
EXAMPLES = (
    "-n 5",
    "--algo kfcv_maddpg --env Grassland-v0 --load-best --seed 7",
    "logs/kfcv_maddpg/Grassland-v0_1 --team sheep=graze",
    "oracle --env HardSpread-v0 --fps 5",
)


class WindowClosed(Exception):
    """Somebody has seen enough."""


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("enjoy", DESCRIPTION, EXAMPLES)
    add_players(parser, "whom to watch")
    add = parser.add_argument
    add("-n", "--n-episodes", type=whole_number, default=10, help="how many (default: %(default)s)")
    add("--deterministic", action="store_true", help="act greedily, which is the default")
    add("--stochastic", action="store_true", help="agents that choose draw from what their networks give; forces stay greedy")
    add("--no-render", action="store_true", help="no window")
    add("--fps", type=float, help="steps per second in the window (default: the world's own)")
    add("--metrics", nargs="+", default=[], metavar="NAME", help="what is told of every episode (default: what fits)")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, 2 for bad input, 130 after Ctrl-C
    """
    try:
        args = make_parser().parse_all(argv)
        check_players(args)
        require_count("-n", args.n_episodes)
        if args.fps is not None:
            require_between("--fps", args.fps, 0, above=True)
        if args.deterministic and args.stochastic:
            raise ValueError("--deterministic and --stochastic exclude each other")
        shown_here = playing(args, 1, drawn=not args.no_render)
        cast = shown_here.cast
        check_metrics(args.metrics, shown_here.arena)
    except REFUSALS as error:
        return refused(error)
    world, arena = shown_here.world.env_id, shown_here.arena
    print(f"{world}: {cast}")
    window = None if args.no_render else Window(f"{world}: {cast}", args.fps or own_fps(arena))
    if window is not None and not window.is_visible:
        print("note: there is no display, so no window; zoo/record_video.py films without one", file=sys.stderr)
        window = None
    return watch(shown_here, args.n_episodes, args.seed, not args.stochastic, args.metrics, window)


def watch(
    shown_here: Playing, n_episodes: int, seed: int, deterministic: bool, metrics: Sequence[str], window: Window | None
) -> int:
    """
    Play and tell, until the end, Ctrl-C, or the closing of the window.

    :param shown_here: who plays where
    :param n_episodes: how many episodes
    :param seed: of the first one
    :param deterministic: greedily
    :param metrics: what is told of every episode
    :param window: where they are shown; ``None`` for nowhere
    :return: exit status
    """
    arena, cast, status = shown_here.arena, shown_here.cast, 0
    names = list(metrics) or fitting(main_quantities(arena))
    camera: Any = lambda dones, infos: None  # noqa: E731
    if window is not None:
        camera = Camera(arena, [f"{shown_here.world.env_id}: {cast}"], lambda picture: show(window, picture))
    print("  ".join(["episode", "seed", *(f"{name:>6}" for name in names)]))
    episodes: list[dict[str, float]] = []
    th.manual_seed(seed)
    try:
        for i in range(n_episodes):
            played = arena.play(cast.players, 1, seed + i, deterministic, camera).quantities()
            episodes.append({name: float(values[0]) for name, values in played.items()})
            cells = [f"{rounded(episodes[-1][name]):{max(len(name), 6)}.2f}" for name in names]
            print("  ".join([f"{i + 1:7}", f"{seed + i:4}", *cells]), flush=True)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        status = INTERRUPTED
    except WindowClosed:
        print("the window was closed")
    finally:
        if window is not None:
            window.close()
    if episodes:
        print(
            f"\nmeans over {in_words(len(episodes), seed)}, with their 95 % intervals\n\n{means(episodes, shares_of(arena))}"
        )
    return status


def show(window: Window, picture: np.ndarray) -> None:
    """
    Show a picture.

    :raises WindowClosed: if there is no window any more
    """
    window.show(picture)
    if window.is_closed:
        raise WindowClosed


def fitting(names: Sequence[str]) -> list[str]:
    """As many of the names, from the first, as fit beside each other as the heads of columns; at least one."""
    left = shutil.get_terminal_size((127, 24)).columns - len("episode  seed")
    taken: list[str] = []
    for name in names:
        left -= max(len(name), 6) + 2
        if left < 0 and taken:
            break
        taken.append(name)
    return taken


def means(episodes: Sequence[dict[str, float]], shares: frozenset[str]) -> str:
    """Every quantity with its interval, one a line."""
    intervals: dict[str, Interval] = {
        name: interval_of(np.array([episode[name] for episode in episodes]), name in shares) for name in episodes[0]
    }
    return as_text([[name, shown(interval)] for name, interval in intervals.items()])


if __name__ == "__main__":
    start(main)
