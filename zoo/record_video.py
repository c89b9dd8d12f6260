"""
Film episodes, several in a grid, as MP4 or GIF: ``python zoo/record_video.py -o wolves.gif``.

No display is needed. The same command films the same episodes, which zoo/evaluate.py counts and zoo/enjoy.py shows.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch as th

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_between, require_count
from sb3_kfcv.common.evaluation import rounded
from zoo.command_line import REFUSALS, Parser, refused, require_writable, start, unwritable, whole_number
from zoo.playing import Playing, add_players, check_players, in_words, own_fps, playing
from zoo.recording import FASTEST_GIF, film, gif_fps, grid_for, require_moviepy, save_gif, save_mp4

DESCRIPTION = """\
Film episodes side by side, one world each, with the score drawn in: the latest run, a run folder, a file, or a scripted
policy, in the world of its training and against the opponents of its training. Worlds whose episode is over stand still,
faded, until all are. Episode i has the seed --seed + i, so the same command films the same episodes."""
EXAMPLES = (
    "-n 9",
    "--algo kfcv_maddpg --env Grassland-v0 --load-best -n 6 -o wolves.gif -o wolves.mp4",
    "logs/maddpg/HardSpread-v0_1 --grid 1x3 -o spread.gif",
    "--env Grassland-v0 --team wolf=chase sheep=flee -o scripted.gif",
)

SAVERS: dict[str, Callable[..., None]] = {".mp4": save_mp4, ".gif": save_gif}
N_EPISODES = 4
FASTEST = 1000  # frames per second


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("record_video", DESCRIPTION, EXAMPLES)
    add_players(parser, "whom to film")
    add = parser.add_argument
    add(
        "-n",
        "--n-episodes",
        type=whole_number,
        help=f"how many, side by side (default: as many as --grid holds, or {N_EPISODES})",
    )
    add("--grid", metavar="ROWSxCOLUMNS", help="how they lie, such as 2x3 (default: as square as can be)")
    add(
        "-o",
        "--output",
        action="append",
        default=[],
        metavar="FILE",
        help="an .mp4 or a .gif; may be repeated (default: both, in the run's folder videos/, else in ./videos/)",
    )
    add("--fps", type=float, help="steps per second (default: the world's own)")
    add("--deterministic", action="store_true", help="act greedily, which is the default")
    add("--stochastic", action="store_true", help="agents that choose draw from what their networks give; forces stay greedy")
    return parser


def parse_grid(text: str) -> tuple[int, int]:
    """
    Rows and columns of a text such as ``2x3``.

    :raises ValueError: if it is none
    """
    match = re.fullmatch(r"([1-9]\d?)[x×]([1-9]\d?)", text)
    if match is None:
        raise ValueError(f'--grid takes ROWSxCOLUMNS, such as 2x3; got "{text}"')
    return int(match.group(1)), int(match.group(2))


def outputs(args: argparse.Namespace) -> list[Path]:
    """
    The files of ``-o``.

    :raises ValueError: for an ending that is neither, and if what writes an MP4 is missing
    """
    files = [Path(name) for name in args.output]
    for file in files:
        if file.suffix not in SAVERS:
            raise ValueError(f"{file}: a film ends in {' or '.join(SAVERS)}")
        if file.suffix == ".mp4":
            require_moviepy()
    return files


def default_outputs(filmed: Playing, seed: int) -> list[Path]:
    """A GIF, and an MP4 if it can be written, in the folder of the run, or where we are."""
    run = filmed.cast.run
    name = re.sub(r"[^\w@.+-]+", "-", f"{filmed.world.env_id} {filmed.cast} seed {seed}")
    folder = (run.folder.path if run else Path()) / "videos"
    try:
        require_moviepy()
    except ValueError as error:
        print(f"note: no MP4: {error}", file=sys.stderr)
        return [folder / f"{name}.gif"]
    return [folder / f"{name}.mp4", folder / f"{name}.gif"]


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, or 2 for bad input
    """
    try:
        args = make_parser().parse_all(argv)
        check_players(args)
        grid = parse_grid(args.grid) if args.grid else None
        n_episodes = args.n_episodes if args.n_episodes is not None else grid[0] * grid[1] if grid else N_EPISODES
        require_count("-n", n_episodes)
        grid = grid or grid_for(n_episodes)
        if grid[0] * grid[1] < n_episodes:
            raise ValueError(f"--grid {args.grid} holds {grid[0] * grid[1]} episodes, not {n_episodes}")
        if args.fps is not None:
            require_between("--fps", args.fps, 0, FASTEST, above=True)
        if args.deterministic and args.stochastic:
            raise ValueError("--deterministic and --stochastic exclude each other")
        files = outputs(args)
        filmed = playing(args, n_episodes, drawn=True)
        files = files or default_outputs(filmed, args.seed)
        require_writable(*files)
    except REFUSALS as error:
        return refused(error)
    try:
        record(filmed, args.seed, grid, not args.stochastic, files, args.fps)
    except OSError as error:
        return refused(OSError(unwritable("the film", error)))
    return 0


def record(
    filmed: Playing, seed: int, grid: tuple[int, int], deterministic: bool, files: Sequence[Path], fps: float | None
) -> None:
    """
    Play, film, write, and tell.

    :param filmed: who plays where
    :param seed: of the first episode
    :param grid: rows and columns
    :param deterministic: greedily
    :param files: where the film goes
    :param fps: steps per second; by default the world's own
    """
    arena, cast = filmed.arena, filmed.cast
    episodes_played = in_words(arena.env.num_envs, seed)
    score = "return" if len(arena.layout.group_names) == 1 else "numbers: return"
    th.manual_seed(seed)
    title = [f"{filmed.world.env_id}: {cast}", f"{score} per agent so far; {episodes_played}"]
    frames, episodes = film(arena, cast.players, title, seed, grid, deterministic)
    fps = fps or own_fps(arena)
    print(f"{filmed.world.env_id}: {cast}; {episodes_played}")
    for group, returns in episodes.returns.items():
        print(f"return per {group}: {'  '.join(f'{rounded(value):.2f}' for value in returns)}")
    height, width, _ = frames[0].shape
    for file in files:
        own = gif_fps(fps) if file.suffix == ".gif" else fps
        if file.suffix == ".gif" and fps > FASTEST_GIF:
            print(f"note: {file}: a GIF shows {FASTEST_GIF:g} frames per second at most, not {fps:g}", file=sys.stderr)
        SAVERS[file.suffix](frames, file, own)
        seconds = len(frames) / own
        print(f"{file}: {width} × {height}, {len(frames)} frames, {seconds:.1f} s, {file.stat().st_size / 1000:,.0f} kB")


if __name__ == "__main__":
    start(main, "interrupted; nothing was written of what was not finished")
