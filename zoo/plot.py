"""
Learning curves of many runs: ``python zoo/plot.py logs``.

A panel for each world, a line for each algorithm: the inter-quartile mean over its seeds with a 95 % bootstrap band, of any
metric of the evaluations or anything else that was logged, by env steps, episodes, or wall-clock time.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import ScalarFormatter

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.evaluation import Interval, with_interval
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.saving.files import with_suffix
from zoo.command_line import REFUSALS, SEVERAL, Parser, as_it_was_typed, refused, require_writable, start, unwritable
from zoo.match_results import shown, write_json
from zoo.plots import draw_intervals, draw_legend, line_styles, new_figure, save_figure
from zoo.run_groups import (
    REWARD,
    Group,
    doubts,
    grouped,
    metric_label,
    metrics_of,
    note,
    of_each,
    only,
    progress_of,
    too_few,
)
from zoo.runs import Run, find_runs
from zoo.series import Series, evaluation_files, tensorboard_series
from zoo.statistics import iqm_curve

DESCRIPTION = """\
Learning curves of many runs, with intervals: a panel for each world, a line for each algorithm. A line is the inter-quartile
mean (IQM) over the seeds, its band the 95 % bootstrap interval; of a single run, the mean over the episodes of each evaluation
with its 95 % interval. The numbers are written beside the picture, as JSON. Runs that are still training can be drawn."""
EXAMPLES = (
    "logs",
    "logs --list",
    "logs/*/Grassland-v0_* -y return_sheep -x time -o sheep.png",
    "logs/kfcv_maddpg -y train/critic_loss --smooth 10",
    "sweeps/gamma --group-by gamma",
)

# What -x may be: the label of the axis.
AXES = {"steps": "training (env steps)", "episodes": "training (episodes)", "time": "training time"}
TIME_UNITS = {"hours": 3600.0, "minutes": 60.0, "seconds": 1.0}  # in seconds; the largest that is worth two of them is shown

# Entries of logs come at other steps in each run: their lines are read at so many common steps, at most.
MOST_POINTS = 200

BOOTSTRAP_SEED = 0

LOGGED_REWARD = "rollout/ep_rew_mean"


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("plot", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUNS", help="run folders, folders over them such as logs, and patterns of either")
    add("-x", "--x-axis", choices=AXES, default="steps", help="(default: %(default)s)")
    add(
        "-y",
        "--series",
        default=REWARD,
        metavar="NAME",
        help="a metric of the evaluations (return_wolf, length, …) or a TensorBoard tag (train/critic_loss); "
        "--list shows all (default: %(default)s)",
    )
    add("--eval-name", default="eval", metavar="NAME", help="of a yardstick, such as wolf_vs_graze (default: %(default)s)")
    add("--list", action="store_true", help="print what series there are, and draw nothing")
    add(
        "--group-by",
        **SEVERAL,
        metavar="SETTING",
        help="a line for each value of it, too: a hyperparameter (gamma, policy_kwargs.n_critics), seed, preset, or folder "
        "(over <algo>/<env>_<k>: a cell of a sweep)",
    )
    add("--smooth", type=int, default=1, metavar="N", help="mean over the latest N entries of each run (default: %(default)s)")
    add("-o", "--output", default="plot.png", metavar="FILE", help="PNG; the numbers go to FILE.json (default: %(default)s)")
    return parser


@dataclass(frozen=True)
class Line:
    """
    What is drawn of a group.

    :param group: the runs
    :param steps: env steps (points,)
    :param x: where the points are, in the unit of the axis (points,)
    :param values: of each run, smoothed (points, runs)
    :param intervals: over the runs, or over the episodes of a single one (points,)
    """

    group: Group
    steps: np.ndarray
    x: np.ndarray
    values: np.ndarray
    intervals: list[Interval]

    @property
    def label(self) -> str:
        """For the legend."""
        return f"{self.group.label}, {self.group.size}"


def load(runs: Sequence[Run], name: str, eval_name: str) -> dict[Run, tuple[np.ndarray, np.ndarray]]:
    """
    A series of each run that has it.

    :param runs: where to look
    :param name: of a metric of the evaluations, or a TensorBoard tag
    :param eval_name: which evaluation
    :return: run → env steps (entries,) and values: of evaluations (entries, episodes), of logs (entries, 1)
    :raises ValueError: if no run has it, with the nearest name
    """
    if not is_metric(name):
        found = of_each(runs, logged, "TensorBoard tag", name)
        return {run: (series.steps, series.values[:, None]) for run, series in found.items()}
    metrics = available(runs, lambda run: metrics_of(run, eval_name))
    if metrics and name not in metrics:
        raise ValueError(unknown_name("series", name, {*metrics, *available(runs, logged)}))
    try:
        return of_each(runs, lambda run: metrics_of(run, eval_name), "metric", name)
    except ValueError as error:
        if any(evaluation_files(run.folder.path) for run in runs):
            raise
        raise ValueError(f"{error}; try -y {LOGGED_REWARD} (rewards of the training), or --list") from None


def is_metric(series: str) -> bool:
    """Whether a series is a metric of the evaluations; TensorBoard tags have a slash."""
    return "/" not in series


def logged(run: Run) -> dict[str, Series]:
    """
    What a run has logged to TensorBoard.

    :raises ValueError: if that is nothing
    """
    found = tensorboard_series(run.tensorboard_folder)
    if not found:
        raise ValueError(f"{run.tensorboard_folder} has no TensorBoard log yet")
    return found


def available(runs: Sequence[Run], series_of: Callable[[Run], Mapping[str, Any]]) -> dict[str, int]:
    """Name → how many of the runs have it."""
    counts: Counter[str] = Counter()
    for run in runs:
        with suppress(ValueError):
            counts.update(series_of(run).keys())
    return dict(counts)


def list_series(runs: Sequence[Run]) -> str:
    """What there is to draw, and how many runs have it where that is not all."""
    names = dict.fromkeys(name for run in runs for name in evaluation_files(run.folder.path))
    parts = {f"evaluations, --eval-name {name}": available(runs, partial(metrics_of, eval_name=name)) for name in names}
    parts["TensorBoard"] = available(runs, logged)
    lines = [f"{len(runs)} run{'s' * (len(runs) > 1)}; what -y takes:"]
    for part, counts in parts.items():
        lines.append(f"{part}:" if counts else f"{part}: nothing")
        lines += [f"  {name}" + (f"  ({n} of {len(runs)} runs)" if n < len(runs) else "") for name, n in counts.items()]
    return "\n".join(lines)


def smoothed(values: np.ndarray, n: int) -> list[np.ndarray]:
    """
    All values of the latest ``n`` entries, fewer at the start, at each entry.

    :param values: (entries, values of each)
    :return: of each entry (values,)
    """
    return [values[max(0, i + 1 - n) : i + 1].ravel() for i in range(len(values))]


def make_line(
    group: Group,
    data: Mapping[Run, tuple[np.ndarray, np.ndarray]],
    args: argparse.Namespace,
    rng: np.random.Generator,
) -> Line:
    """
    What to draw of a group.

    :param group: of runs that have the series
    :param data: run → env steps (entries,) and values (entries, values of each)
    :param args: the command line
    :param rng: of the bootstrap
    :raises ValueError: if evaluations have no step in common
    """
    steps = [data[run][0] for run in group.runs]
    pooled = [smoothed(data[run][1], args.smooth) for run in group.runs]
    means = [np.array([entry.mean() for entry in own]) for own in pooled]
    same = all(np.array_equal(steps[0], own) for own in steps[1:])
    evaluated = is_metric(args.series)
    if same:
        common = steps[0]
    elif evaluated:
        common = common_steps(group, steps)
        means = [own[np.isin(at, common)] for at, own in zip(steps, means, strict=True)]
    else:
        first, last = max(own[0] for own in steps), min(own[-1] for own in steps)
        if last < first:
            raise ValueError(f"{group}: its {len(group.runs)} runs have logged at no time in common; draw them apart")
        common = np.linspace(first, last, min(MOST_POINTS, *map(len, steps)))
        means = [np.interp(common, at, own) for at, own in zip(steps, means, strict=True)]
    values = np.array(means).T
    if len(group.runs) == 1:
        intervals = [with_interval(entry) if evaluated else Interval(entry.mean(), np.nan, np.nan) for entry in pooled[0]]
    else:
        intervals = iqm_curve(values, rng)
    return Line(group, common, positions(group, common, args.x_axis), values, intervals)


def common_steps(group: Group, steps: Sequence[np.ndarray]) -> np.ndarray:
    """
    The env steps at which all runs were evaluated. A note tells what is not drawn.

    :param group: the runs
    :param steps: of each
    :raises ValueError: if there are none
    """
    common = reduce(np.intersect1d, steps)
    if not len(common):
        raise ValueError(f"{group}: no evaluation of its {len(group.runs)} runs was at the same env step; draw them apart")
    every = reduce(np.union1d, steps)
    first = min(zip(group.runs, steps, strict=True), key=lambda own: own[1][-1])[0]
    ends = f", up to {common[-1]:,} of {every[-1]:,} env steps ({first.folder.path})" if common[-1] < every[-1] else ""
    note(f"{group}: drawn are the {len(common)} of {len(every)} evaluations that all {len(group.runs)} runs have{ends}")
    return common


def positions(group: Group, steps: np.ndarray, x_axis: str) -> np.ndarray:
    """
    Where points lie on the axis: episodes and seconds are the median over the runs, at the same env steps.

    :param group: the runs
    :param steps: env steps (points,)
    :param x_axis: one of ``AXES``
    :raises ValueError: if they are not known
    """
    if x_axis == "steps":
        return steps
    known = [progress_of(run) for run in group.runs]
    return np.median([own.episodes_at(steps) if x_axis == "episodes" else own.seconds_at(steps) for own in known], axis=0)


def make_lines(args: argparse.Namespace) -> list[Line]:
    """
    Everything that is to be drawn.

    :param args: the command line
    :raises ValueError: one sentence that says what is wrong
    """
    runs = find_runs(args.runs)
    groups = grouped(runs, args.group_by)
    data = load(runs, args.series, args.eval_name)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    groups = only(groups, data)
    lines = [make_line(group, data, args, rng) for group in groups]
    few = [] if "seed" in args.group_by else too_few(groups)
    for text in [*(doubt for group in groups for doubt in doubts(group)), *few]:
        note(text)
    return lines


def draw(lines: Sequence[Line], args: argparse.Namespace, path: Path) -> None:
    """
    A panel for each world.

    :param lines: of all worlds
    :param args: the command line
    :param path: of the PNG
    """
    worlds = list(dict.fromkeys(line.group.env_id for line in lines))
    styles = line_styles({line.group.label: line.group.algo for line in lines})
    unit, x_label = 1.0, AXES[args.x_axis]
    if args.x_axis == "time":
        longest = max(line.x[-1] for line in lines)
        name, unit = next((name, unit) for name, unit in TIME_UNITS.items() if longest >= 2 * unit or unit == 1.0)
        x_label += f" ({name} of wall-clock)"
    figure, axes = new_figure(len(worlds), caption(lines, args.series, args.smooth))
    for world, axis in zip(worlds, axes, strict=True):
        for line in lines:
            if line.group.env_id == world:
                colour, dashes = styles[line.group.label]
                draw_intervals(axis, line.x / unit, line.intervals, colour, line.label, dashes)
        if args.x_axis == "time":
            axis.xaxis.set_major_formatter(ScalarFormatter())
        axis.set_title(world)
        axis.set_xlabel(x_label)
        axis.set_ylabel(metric_label(args.series, args.eval_name) if is_metric(args.series) else args.series)
        draw_legend(axis)
    save_figure(figure, path)


def caption(lines: Sequence[Line], series: str, n_smoothed: int) -> str:
    """What lines and bands are."""
    alone = "single run: " + ("mean, 95 % interval over episodes" if is_metric(series) else "as logged")
    over = {False: "IQM over seeds, 95 % bootstrap interval", True: alone}
    parts = [over[single] for single in sorted({len(line.group.runs) == 1 for line in lines})]
    return "; ".join([*parts, *([f"mean of the latest {n_smoothed} entries"] if n_smoothed > 1 else [])])


def as_json(lines: Sequence[Line], args: argparse.Namespace, command: str) -> dict[str, Any]:
    """The numbers behind the picture: x in env steps, episodes, or seconds; values as points × runs."""
    drawn = [
        {
            "label": line.group.label,
            "algo": line.group.algo,
            "env": line.group.env_id,
            "runs": [str(run.folder.path) for run in line.group.runs],
            "seeds": [run.seed for run in line.group.runs],
            "steps": line.steps.tolist(),
            "x": line.x.tolist(),
            "values": line.values.tolist(),
            "intervals": line.intervals,
        }
        for line in lines
    ]
    about = {name: getattr(args, name) for name in ("series", "eval_name", "x_axis", "smooth")}
    return {"command": command, **about, "lines": drawn}


def output(name: str) -> Path:
    """
    The file of ``-o``.

    :raises ValueError: for an ending of another kind of picture
    """
    if Path(name).suffix not in ("", ".png"):
        raise ValueError(f"-o writes a file that ends in .png, not {name}")
    return with_suffix(name, ".png")


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, or 2 for bad input
    """
    try:
        args = make_parser().parse_all(argv)
        require_count("--smooth", args.smooth)
        if args.list:
            print(list_series(find_runs(args.runs)))
            return 0
        path = output(args.output)
        lines = make_lines(args)
        require_writable(path, path.with_suffix(".json"))
    except REFUSALS as error:
        return refused(error)
    try:
        draw(lines, args, path)
        write_json(path.with_suffix(".json"), as_json(lines, args, as_it_was_typed("plot", argv)))
    except OSError as error:
        return refused(OSError(unwritable(path, error)))
    for line in lines:
        steps, last = line.steps[-1], line.intervals[-1]
        print(f"{line.group.env_id}: {line.label}: {shown(last)} after {steps:,.0f} env steps")
    print(f"written: {path} and .json")
    return 0


if __name__ == "__main__":
    start(main)
