"""
Algorithms over worlds and seeds: ``python zoo/compare.py logs``.

Final performance with intervals, time, the probability that one algorithm is better than another, and performance profiles:
on the screen, and in a folder as Markdown, JSON, picture, and the JSON that marl-eval reads.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.saving.archive import library_versions
from zoo.command_line import (
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
from zoo.compare_results import Comparison, Outcome, as_markdown_page, as_report, as_screen, draw, marl_eval
from zoo.match_results import write_json, write_text
from zoo.run_folder import read_map
from zoo.run_groups import REWARD, Group, doubts, grouped, metrics_of, note, of_each, only, progress_of, too_few
from zoo.runs import Run, find_runs

DESCRIPTION = """\
Compare algorithms over worlds and seeds: the final performance of each run, its inter-quartile mean (IQM) over seeds with the
95 % stratified bootstrap interval, time, performance profiles, and the probability that one is better than another. A table
goes to the screen; compare.md, .json and .png, and marl_eval.json (for the package marl-eval) into a folder."""
EXAMPLES = (
    "logs",
    "logs/*/Grassland-v0_* --metric sheep_eaten",
    "logs --metric collisions --better lower --point best",
    "sweeps/gamma --group-by gamma -o gamma",
)

LAST, BEST = "last", "best"

FILES = ("compare.json", "compare.md", "marl_eval.json", "compare.png")


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("compare", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUNS", help="run folders, folders over them such as logs, and patterns of either")
    add("--metric", default=REWARD, help="of the evaluations; zoo/plot.py --list shows all (default: %(default)s)")
    add("--eval-name", default="eval", metavar="NAME", help="of a yardstick, such as wolf_vs_graze (default: %(default)s)")
    add("--better", choices=("higher", "lower"), default="higher", help="which values are good (default: %(default)s)")
    add(
        "--point",
        default=LAST,
        help="the evaluation that counts: the last one of each run, the best one (which flatters the algorithm that varies "
        "most), or the one nearest to so many env steps (default: %(default)s)",
    )
    add(
        "--scores",
        metavar="FILE",
        help="YAML, world → {low:, high:}: the values that count as 0 and as 1 over several worlds, such as of scripted "
        "policies (default: the worst and the best run of each world)",
    )
    add(
        "--group-by",
        **SEVERAL,
        metavar="SETTING",
        help="compare the values of it, too: a hyperparameter (gamma, policy_kwargs.n_critics), preset, or folder "
        "(over <algo>/<env>_<k>: a cell of a sweep)",
    )
    add("-o", "--output", default="compare", metavar="FOLDER", help="of the results (default: %(default)s)")
    return parser


def chosen(steps: np.ndarray, values: np.ndarray, point: str | int, sign: int) -> int:
    """
    Which evaluation counts.

    :param steps: env steps (evaluations,)
    :param values: (evaluations, episodes)
    :param point: ``"last"``, ``"best"``, or env steps
    :param sign: −1 where lower is better, else 1
    :return: its number
    :raises ValueError: if the run has not come so far
    """
    if point == LAST:
        return len(steps) - 1
    if point == BEST:
        return int(np.argmax(sign * values.mean(axis=1)))
    nearest = int(np.argmin(np.abs(steps - int(point))))
    apart = np.diff(steps, prepend=0).max()
    if abs(steps[nearest] - int(point)) > apart / 2:
        raise ValueError(f"evaluated between {steps[0]:,} and {steps[-1]:,} env steps, not at {point:,}")
    return nearest


def outcomes_of(run: Run, eval_name: str, point: str | int, sign: int) -> dict[str, Outcome]:
    """
    Metric → how a run came out.

    :param run: the run
    :param eval_name: which evaluation
    :param point: see :func:`chosen`
    :param sign: see :func:`chosen`
    :raises ValueError: if it has no such evaluation
    """
    found = {}
    for name, (steps, values) in metrics_of(run, eval_name).items():
        try:
            at = chosen(steps, values, point, sign)
        except ValueError as error:
            raise ValueError(f"{run.folder.path} was {error}") from None
        found[name] = Outcome(run, steps, values, at, seconds_at(run, steps[at]))
    return found


def seconds_at(run: Run, steps: int) -> float:
    """The wall-clock time of the training up to some env steps; NaN where it is not known."""
    try:
        return float(progress_of(run).seconds_at(np.array(steps)))
    except ValueError:
        return float("nan")


def parse_point(text: str) -> str | int:
    """
    :raises ValueError: for what is no point of a training
    """
    if text in (LAST, BEST):
        return text
    try:
        return whole_number(text)
    except argparse.ArgumentTypeError:
        raise ValueError(f"{unknown_name('--point', text, (LAST, BEST))} or a number of env steps") from None


def read_scores(path: str, worlds: Sequence[str], sign: int) -> dict[str, tuple[float, float]]:
    """
    World → the values that count as 0 and as 1, from a YAML file.

    :param path: of the file
    :param worlds: those that are needed
    :param sign: see :func:`chosen`
    :raises ValueError: if one is missing, or is no pair of different numbers, or the better one counts as 0
    """
    given, found = read_map(Path(path)), {}
    for world in worlds:
        if world not in given:
            raise ValueError(f"{path} says nothing about {world}; it has {', '.join(map(str, given))}")
        pair = given[world]
        try:
            low, high = float(pair["low"]), float(pair["high"])
        except (TypeError, KeyError, ValueError):
            low = high = 0.0
        if low == high:
            raise ValueError(f"{path}: {world} must be a map of two different numbers, low and high; it is {pair!r}")
        if sign * high < sign * low:
            better = "higher" if sign > 0 else "lower"
            raise ValueError(f"{path}: low of {world} counts as 0 and high as 1, and {better} is better; it is {pair!r}")
        found[world] = (low, high)
    return found


def build(args: argparse.Namespace) -> Comparison:
    """
    All that is compared, found and checked.

    :param args: the command line
    :raises ValueError: one sentence that says what is wrong
    """
    point, sign = parse_point(args.point), -1 if args.better == "lower" else 1
    runs = find_runs(args.runs)
    groups = grouped(runs, args.group_by)
    outcomes = of_each(runs, lambda run: outcomes_of(run, args.eval_name, point, sign), "metric", args.metric)
    groups = only(groups, outcomes)
    labels = list(dict.fromkeys(group.label for group in groups))
    if len(labels) < 2:
        raise ValueError(
            f"a comparison takes two, and there is only {labels[0]}: give more runs, tell settings apart with --group-by, "
            "or see it by zoo/plot.py"
        )
    worlds = list(dict.fromkeys(group.env_id for group in groups))
    shared = [world for world in worlds if len([group for group in groups if group.env_id == world]) == len(labels)]
    if not shared:
        raise ValueError(f"no world has runs of all of {'; '.join(labels)}: there is nothing to compare them in")
    limits = read_scores(args.scores, shared, sign) if args.scores else None
    warn(groups, outcomes, shared, point)
    return Comparison(groups, outcomes, shared, args.metric, args.eval_name, sign, args.point, limits)


def warn(groups: Sequence[Group], outcomes: Mapping[Run, Outcome], shared: Sequence[str], point: str | int) -> None:
    """Tell what makes the comparison doubtful."""
    for text in [*(doubt for group in groups for doubt in doubts(group)), *too_few(groups)]:
        note(text)
    worlds = dict.fromkeys(group.env_id for group in groups)
    for world in worlds:
        there = [group for group in groups if group.env_id == world]
        steps = [outcomes[run].step for group in there for run in group.runs]
        lengths = {len(outcomes[run].steps) for group in there for run in group.runs}
        if len(lengths) > 1 or len({frozenset(run.seed for run in group.runs) for group in there}) > 1:
            note(f"{world}: marl-eval wants the same seeds and as many evaluations of each, and will refuse marl_eval.json")
        if point == LAST and len(set(steps)) > 1:
            note(
                f"{world}: the runs are compared at different env steps, from {min(steps):,} to {max(steps):,}; "
                f"--point {min(steps)} compares all at the same"
            )
    apart = [world for world in worlds if world not in shared]
    if apart:
        note(f"left out of all that is over several worlds, since not every algorithm has runs there: {', '.join(apart)}")


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, or 2 for bad input
    """
    try:
        args = make_parser().parse_all(argv)
        comparison = build(args)
        folder = Path(args.output)
        require_writable(*(folder / name for name in FILES))
    except REFUSALS as error:
        return refused(error)
    about = {"command": as_it_was_typed("compare", argv), "versions": library_versions()}
    report, page, raw, picture = (folder / name for name in FILES)
    try:
        write_json(report, as_report(comparison, about))
        write_text(page, as_markdown_page(comparison, about))
        write_json(raw, marl_eval(comparison))
        draw(comparison, picture)
    except OSError as error:
        return refused(OSError(unwritable(folder, error)))
    print(as_screen(comparison))
    print(f"written: {folder / 'compare.md'}, .json and .png, and {folder / 'marl_eval.json'}")
    return 0


if __name__ == "__main__":
    start(main)
