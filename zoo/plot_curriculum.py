"""
What the curriculum did, and what it finds easy and hard: ``python zoo/plot_curriculum.py logs/kfcv_maddpg/HardSpread-v0_1``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.ticker import ScalarFormatter

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.evaluation import Interval, with_interval
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.curriculum.difficulty import UNSCORED, rank_correlation
from sb3_kfcv.curriculum.kfcv_replay_buffer import KFCVReplayBuffer
from sb3_kfcv.saving.archive import library_versions
from sb3_kfcv.saving.checkpoints import Checkpoint, checkpoints_in
from sb3_kfcv.saving.normalization import load_normalization
from sb3_kfcv.saving.saveable import refusals
from zoo.command_line import REFUSALS, Parser, as_it_was_typed, refused, start, whole_number
from zoo.hyperparams import find_algorithm
from zoo.match_results import as_text, write_json
from zoo.plots import ALGO_COLOURS, HEAT_MAP, REFERENCE_COLOUR, new_figure, save_figure
from zoo.run_groups import doubts, grouped
from zoo.runs import Run, find_runs, pick_run
from zoo.series import Series, tensorboard_series
from zoo.train import make_env
from zoo.transition_facts import PLACES, facts_of, places_of

DESCRIPTION = """\
Show what the curriculum of KFCV runs did over the training (stages, what minibatches were drawn from, scores per bucket, how
stable the ranking is, how good the teachers are; a line for each run), and what easy and hard transitions are: their scores
against distances, rewards and their terms, and age, with intervals over the runs, and a map of the plane coloured by
difficulty. The second part needs a checkpoint, best one of the time when the curriculum ran: train with
--keep-checkpoints -1 to have some."""
EXAMPLES = (
    "",
    "logs/kfcv_maddpg/HardSpread-v0_1 --checkpoint 100000",
    "'logs/kfcv_maddpg/Grassland-v0_*' --rescore -o grassland_curriculum",
)

ALGO = "kfcv_maddpg"
STABILITY = {
    "curriculum/rank_correlation_with_last": "with the ranking of the refresh before",
    "curriculum/rank_correlation_with_student": "with the student's own squared TD error",
}
TEACHERS = {
    "curriculum/teacher_loss_in_fold": "on the fold that they learn from",
    "curriculum/teacher_loss_held_out": "on the other folds",
}
BINS = 20
MAP_CELLS = 40
CROWDED = 10
WRITTEN = ("training.png", "easy_and_hard.png", "map.png", "curriculum.json")
_SPREAD = "; mean and 95 % interval over the runs"
FEWEST_IN_A_CELL = 10  # cells of the map with fewer agents stay empty
THOUSAND = 1000
MEAN_DIFFICULTY = 0.5  # of all transitions
EASY, HARD = 0.2, 0.8  # difficulty below and above which a transition is of the easiest and hardest fifth


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("plot_curriculum", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add(
        "runs", nargs="*", metavar="RUN", help="run folders, folders over them, quoted patterns (default: the latest KFCV run)"
    )
    add("-f", "--folder", default="logs", help="where the latest run is looked for (default: %(default)s)")
    add(
        "--checkpoint",
        type=whole_number,
        metavar="STEPS",
        help="whose transitions are looked at: the one nearest to so many env steps (default: the last one of the curriculum)",
    )
    add("--rescore", action="store_true", help="score all transitions of the checkpoint anew, by its teachers and its student")
    add("-o", "--output", default="curriculum", help="folder of the results (default: %(default)s)")
    return parser


@dataclass(frozen=True)
class Assessed:
    """
    The transitions of a checkpoint that have a score.

    :param run: whose they are
    :param steps: env steps of the checkpoint
    :param buffer: that holds them
    :param layout: of the world
    :param rows: where they lie in the buffer (n,)
    """

    run: Run
    steps: int
    buffer: KFCVReplayBuffer
    layout: AgentLayout
    rows: np.ndarray

    @cached_property
    def difficulty(self) -> np.ndarray:
        """Place in the ranking, 0 the easiest, 1 the hardest (n,)."""
        order = self.buffer.scores[self.rows].argsort(kind="stable")
        places = np.empty(len(order))
        places[order] = np.arange(len(order)) / max(len(order) - 1, 1)
        return places

    @cached_property
    def facts(self) -> dict[str, np.ndarray]:
        """What can be said of them, see :func:`facts_of`."""
        phi = (self.run.config.get("env_kwargs") or {}).get("phi")
        return facts_of(self.buffer, self.layout, self.run.env_id, self.rows, phi)


def curriculum_ends(run: Run) -> float:
    """Env steps after which the curriculum of a run is over."""
    share = (run.config.get("replay_buffer_kwargs") or {}).get("curriculum_fraction", 0.5)
    return share * run.config["n_timesteps"]


def pick_checkpoint(run: Run, steps: int | None) -> Path:
    """
    :param run: whose checkpoint
    :param steps: near which it is to be; ``None`` for the last one before the curriculum ended, else the first one
    :raises ValueError: if the run has none
    """
    saved = checkpoints_in(run.folder.path)
    if not saved:
        raise ValueError(f"the run in {run.folder.path} has no checkpoint, so none of its transitions")
    if steps is None:
        return next((path for n, path in saved.items() if n < curriculum_ends(run)), saved[min(saved)])
    return saved[min(saved, key=lambda n: abs(n - steps))]


def assess(run: Run, steps: int | None, rescore: bool) -> Assessed:
    """
    Take the scored transitions out of a checkpoint.

    :param run: of ``kfcv_maddpg``
    :param steps: see :func:`pick_checkpoint`
    :param rescore: score all of them now, as it is done anyway if none has a score
    :raises ValueError: if there is no checkpoint, it is damaged, or it has too few transitions
    """
    checkpoint = Checkpoint(pick_checkpoint(run, steps))
    if checkpoint.steps >= curriculum_ends(run) and not rescore:
        print(f"note: {checkpoint.path} is of the time after the curriculum: its scores are old", file=sys.stderr)
    hyperparams = run.hyperparams
    env = make_env(hyperparams, hyperparams.n_envs, run.seed, hyperparams.env_kwargs, training=False)
    if hyperparams.normalize is not None:
        env = load_normalization(checkpoint.path, env.venv, training=False)  # type: ignore[attr-defined]
    model = find_algorithm(run.algo).load(checkpoint.path, env, device="cpu")
    with refusals(checkpoint, "replay_buffer"):
        model.set_replay_buffer_state(checkpoint.replay_buffer, checkpoint.transitions)
    buffer = model.replay_buffer
    buffer.normalizer = model.get_vec_normalize_env()
    if not rescore and (buffer.buckets == UNSCORED).all():
        print(f"note: no transition of {checkpoint.path} has a score: all are scored anew", file=sys.stderr)
        rescore = True
    if rescore:
        buffer.refresh()
    buffer.normalizer = None  # what is told of transitions is in the world's own units
    rows = np.flatnonzero(buffer.buckets[: buffer.n_rows] != UNSCORED)
    if not len(rows):
        raise ValueError(f"{checkpoint.path} has too few transitions for {buffer.n_folds} folds")
    return Assessed(run, checkpoint.steps, buffer, model.layout, rows)


def correlation(difficulty: np.ndarray, values: np.ndarray) -> float:
    """Spearman's ρ where there is a value; NaN where there is none, or only one."""
    there = np.isfinite(values)
    return rank_correlation(difficulty[there], values[there]) if len(np.unique(values[there])) > 1 else np.nan


def study(assessed: Sequence[Assessed]) -> dict[str, dict[str, Any]]:
    """
    How each fact goes with difficulty.

    :param assessed: of one run or several
    :return: fact → ``correlation`` (Spearman's ρ), and ``easy`` and ``hard`` (the mean of the fact over the easiest and over
        the hardest fifth), each as mean and 95 % interval over the runs
    """
    found = {}
    for name in assessed[0].facts:
        rho, easy, hard = [], [], []
        for one in assessed:
            values = one.facts.get(name, np.full(len(one.rows), np.nan))
            there = np.isfinite(values)
            rho.append(correlation(one.difficulty, values))
            easy.append(values[there & (one.difficulty <= EASY)].mean() if there.any() else np.nan)
            hard.append(values[there & (one.difficulty >= HARD)].mean() if there.any() else np.nan)
        of_each_run = {"correlation": rho, "easy": easy, "hard": hard}
        found[name] = {key: with_interval(np.array(own)) for key, own in of_each_run.items()}
    return found


def in_words(name: str, rho: Interval) -> str:
    """What a correlation says, to whoever asks whether what is near its goal is easy."""
    certain = np.isnan(rho.low) or rho.low > 0 or rho.high < 0
    if not certain or abs(rho.mean) < 0.05:
        return f"{name}: no clear relation with difficulty (ρ = {_with_bounds(rho)})"
    return f"{name}: the larger, the {'harder' if rho.mean > 0 else 'easier'} (ρ = {_with_bounds(rho)})"


def _with_bounds(value: Interval) -> str:
    half = (value.high - value.low) / 2
    size = max(abs(value.mean), abs(half) if np.isfinite(half) else 0)
    decimals = 0 if size >= 100 else 1 if size >= 10 else 2 if size >= 0.1 else 3
    return f"{value.mean:.{decimals}f}" if np.isnan(half) else f"{value.mean:.{decimals}f} ± {half:.{decimals}f}"


def draw_training(series: Sequence[Mapping[str, Series]], runs: Sequence[Run], path: Path) -> None:
    """
    The curriculum over the training, a line for each run.

    :param series: of each run
    :param runs: the runs
    :param path: of the PNG
    """
    figure, axes = new_figure(4, columns=2)
    figure.suptitle(f"{runs[0].env_id}: the curriculum of {_counted(len(runs))}")
    drawn, scored, stable, taught = axes
    n_folds = sum(f"curriculum/share_bucket_{k}" in series[0] for k in range(1, 100))
    colours = [colormaps[HEAT_MAP](x) for x in np.linspace(0, 0.95, n_folds)]
    _draw_shares(drawn, series[0], n_folds, colours)
    _draw_scores(scored, series, n_folds, colours)
    ends = curriculum_ends(runs[0])
    _draw_lines(stable, series, STABILITY, ends)
    stable.set_ylabel("rank correlation of the scores (Spearman's ρ)")
    stable.set_ylim(-0.25, 1.02)
    _draw_lines(taught, series, TEACHERS, ends)
    taught.set_ylabel("teachers' squared error (targets of spread 1)")
    taught.set_ylim(bottom=0)
    for axis in axes:
        axis.set_xlabel("training (env steps)")
        axis.axvline(ends, color=REFERENCE_COLOUR, linestyle=":", linewidth=1)
        axis.set_xlim(0, 1.1 * ends)
    drawn.annotate("the curriculum ends", (ends, 0.5), rotation=90, ha="right", va="center", fontsize="x-small")
    save_figure(figure, path)


def _counted(n_runs: int) -> str:
    return "1 run" if n_runs == 1 else f"{n_runs} runs"


def _draw_scores(axis: Axes, series: Sequence[Mapping[str, Series]], n_folds: int, colours: Sequence[Any]) -> None:
    """How scores are spread in each bucket."""
    for k, colour in enumerate(colours, 1):
        label = f"bucket {k}{' (easy)' if k == 1 else ' (hard)' if k == n_folds else ''}"
        for own in series:
            low, median, high = (own[f"curriculum/score_bucket_{k}_q{q}"] for q in (10, 50, 90))
            axis.plot(median.steps, median.values, color=colour, label=label)
            axis.fill_between(median.steps, low.values, high.values, color=colour, alpha=0.2 / len(series), linewidth=0)
            label = ""
    if axis.dataLim.y0 > 0:
        axis.set_yscale("log")
    else:  # reducible errors
        axis.set_yscale("symlog", linthresh=0.1)
    axis.set_ylabel("difficulty score (mean = 1)\nmedian, 10 % to 90 %")
    axis.legend(fontsize="x-small")


def _draw_lines(axis: Axes, series: Sequence[Mapping[str, Series]], labels: Mapping[str, str], ends: float) -> None:
    """Some of what was logged, until the curriculum ends: from then on the last refresh is told again and again."""
    for (tag, label), colour in zip(labels.items(), (ALGO_COLOURS[ALGO], REFERENCE_COLOUR), strict=True):
        for line in (own[tag] for own in series if tag in own):
            there = line.steps <= ends
            axis.plot(line.steps[there], line.values[there], color=colour, label=label)
            label = ""
    axis.legend(fontsize="x-small")


def _draw_shares(axis: Axes, own: Mapping[str, Series], n_folds: int, colours: Sequence[Any]) -> None:
    """Where minibatches are drawn from: a uniform share, and the buckets of the stage."""
    uniform = own["curriculum/lambda"]
    shares = [np.interp(uniform.steps, own[tag].steps, own[tag].values) for tag in _tags("share_bucket_", n_folds)]
    over = uniform.values >= 1
    stack = [uniform.values, *(np.where(over, 0, share) for share in shares)]
    labels = ["whole buffer (λ)", *(f"bucket {k}" for k in range(1, n_folds + 1))]
    axis.stackplot(uniform.steps, *stack, labels=labels, colors=["#DDDDDD", *colours], step="post")
    stages = own["curriculum/stage"]
    for stage in range(1, n_folds + 1):
        inside = stages.steps[stages.values == stage]
        if len(inside):
            axis.annotate(f"stage {stage}", (inside[0], 1.01), annotation_clip=False, fontsize="x-small")
    axis.set_ylabel("share of each minibatch")
    axis.set_ylim(0, 1)
    axis.legend(fontsize="x-small", loc="lower right")


def _tags(name: str, n_folds: int) -> list[str]:
    return [f"curriculum/{name}{k}" for k in range(1, n_folds + 1)]


def draw_facts(assessed: Sequence[Assessed], found: Mapping[str, Mapping[str, Interval]], path: Path) -> None:
    """
    Difficulty against each fact: the mean of the runs, and the middle half of the transitions.

    :param assessed: of each run
    :param found: of :func:`study`
    :param path: of the PNG
    """
    figure, axes = new_figure(len(found), columns=3)
    figure.suptitle(
        f"{_title(assessed, 'what is easy and what is hard')}\nline: mean, band: the middle half of the transitions"
    )
    for axis, (name, own) in zip(axes, found.items(), strict=True):
        values = np.concatenate([one.facts[name] for one in assessed if name in one.facts])
        difficulty = np.concatenate([one.difficulty for one in assessed if name in one.facts])
        there = np.isfinite(values)
        middles, means, low, high = binned(values[there], difficulty[there])
        axis.plot(middles, means, color=ALGO_COLOURS[ALGO], marker="o", markersize=3)
        axis.fill_between(middles, low, high, color=ALGO_COLOURS[ALGO], alpha=0.2, linewidth=0)
        axis.set_xlabel(name)
        axis.set_ylabel("difficulty (0 easiest, 1 hardest)")
        axis.set_ylim(0, 1)
        if np.abs(middles).max() < THOUSAND:
            axis.xaxis.set_major_formatter(ScalarFormatter())
        half = float(np.subtract(*np.quantile(values[there], [0.75, 0.25])))
        if 0 < half < np.ptp(middles) / CROWDED:  # most values are crowded into a small part of the axis
            axis.set_xscale("symlog", linthresh=half)
            axis.tick_params("x", labelsize="x-small")
        axis.set_title(f"Spearman's ρ = {_with_bounds(own['correlation'])}", fontsize="small")
    save_figure(figure, path)


def _title(assessed: Sequence[Assessed], what: str) -> str:
    steps = sorted({one.steps for one in assessed})
    after = f"{steps[0]:,}" if len(steps) == 1 else f"{steps[0]:,} to {steps[-1]:,}"
    return f"{assessed[0].run.env_id}: {what} after {after} env steps ({_counted(len(assessed))})"


def binned(values: np.ndarray, difficulty: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Difficulty by a fact: bins of as many transitions each, or one per value where these are few.

    :param values: of the fact (n,)
    :param difficulty: (n,)
    :return: of each bin its mean value, and mean, lower and upper quartile of the difficulty
    """
    edges = np.unique(np.quantile(values, np.linspace(0, 1, BINS + 1)))
    few = np.unique(values)
    bins = np.searchsorted(few, values) if len(few) <= BINS else np.searchsorted(edges[1:-1], values, side="right")
    members = [bins == k for k in np.unique(bins)]
    quartiles = [np.quantile(difficulty[own], [0.25, 0.75]) for own in members]
    low, high = np.array(quartiles).T
    return np.array([values[own].mean() for own in members]), np.array([difficulty[own].mean() for own in members]), low, high


def draw_map(assessed: Sequence[Assessed], path: Path) -> None:
    """
    The plane coloured by difficulty: by where an agent is, and by where it is from its nearest goal.

    :param assessed: of each run, of a world in ``PLACES``
    :param path: of the PNG
    """
    where, from_goal, hard_where, hard_from_goal = [], [], [], []
    for one in assessed:
        places = places_of(one.buffer, one.layout, one.run.env_id, one.rows)
        seekers = list(places.seekers)
        alive = places.alive[:, seekers]
        of_each = np.broadcast_to(one.difficulty[:, None], alive.shape)
        where.append(places.positions[:, seekers][alive])
        hard_where.append(of_each[alive])
        offsets = places.to_goal()
        there = np.isfinite(offsets).all(-1)
        from_goal.append(offsets[there])
        hard_from_goal.append(of_each[there])
    seeker = assessed[0].layout.groups[places.seekers[0]]
    figure, axes = new_figure(2, _title(assessed, "the plane by difficulty"), size=(5.4, 4.6))
    maps = [
        (where, hard_where, f"where the {seeker} is"),
        (from_goal, hard_from_goal, f"where the {seeker} is, from its nearest {places.goal}"),
    ]
    for axis, (points, difficulty, label) in zip(axes, maps, strict=True):
        _draw_cells(axis, np.concatenate(points), np.concatenate(difficulty), label)
    save_figure(figure, path)


def _draw_cells(axis: Axes, points: np.ndarray, difficulty: np.ndarray, label: str) -> None:
    reach = float(np.quantile(np.abs(points), 0.995))
    edges = np.linspace(-reach, reach, MAP_CELLS + 1)
    x, y = points.T
    counts, *_ = np.histogram2d(x, y, bins=(edges, edges))
    sums, *_ = np.histogram2d(x, y, bins=(edges, edges), weights=difficulty)
    means = np.where(counts >= FEWEST_IN_A_CELL, sums / np.maximum(counts, 1), np.nan)
    filled = means[np.isfinite(means)]
    spread = max(float(np.quantile(np.abs(filled - MEAN_DIFFICULTY), 0.99)), 0.01) if len(filled) else MEAN_DIFFICULTY
    scale = Normalize(MEAN_DIFFICULTY - spread, MEAN_DIFFICULTY + spread)
    image = axis.pcolormesh(edges, edges, means.T, cmap=HEAT_MAP, norm=scale)
    axis.set_aspect("equal")
    axis.set_xlabel("x (world units)")
    axis.set_ylabel("y (world units)")
    axis.set_title(label, fontsize="medium")
    for of_axis in (axis.xaxis, axis.yaxis):
        of_axis.set_major_formatter(ScalarFormatter())
    axis.grid(False)
    axis.figure.colorbar(image, ax=axis, label="mean difficulty (0 easiest, 1 hardest)")


def build(args: argparse.Namespace) -> list[Run]:
    """
    The runs.

    :param args: the command line
    :raises ValueError: one sentence that says what is wrong
    """
    if args.checkpoint is not None:
        require_count("--checkpoint", args.checkpoint)
    runs = find_runs(args.runs) if args.runs else [pick_run(args.folder, ALGO)]
    for run in runs:
        if run.algo != ALGO:
            raise ValueError(f"{run.folder.path} is a run of {run.algo}; only {ALGO} has a curriculum")
        if run.env_id != runs[0].env_id:
            raise ValueError(
                f"{runs[0].folder.path} is of {runs[0].env_id} and {run.folder.path} of {run.env_id}; take one world"
            )
    for doubt in doubts(grouped(runs)[0]):
        print(f"note: {doubt}", file=sys.stderr)
    return runs


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, or 2 for bad input
    """
    th.set_num_threads(1)
    try:
        args = make_parser().parse_all(argv)
        runs = build(args)
        series = [tensorboard_series(run.tensorboard_folder) for run in runs]
        for run, own in zip(runs, series, strict=True):
            if "curriculum/share_bucket_1" not in own:
                raise ValueError(f"the run in {run.folder.path} has logged nothing of a curriculum (yet)")
        kept = [run for run in runs if checkpoints_in(run.folder.path)]
        for run in runs:
            if run not in kept:
                print(f"note: {run.folder.path} has no checkpoint, so none of its transitions are looked at", file=sys.stderr)
        assessed = [assess(run, args.checkpoint, args.rescore) for run in kept]
        folder = Path(args.output)
        folder.mkdir(parents=True, exist_ok=True)
        draw_training(series, runs, folder / "training.png")
        if assessed:
            tell(assessed, as_it_was_typed("plot_curriculum", argv), args.rescore, folder)
    except REFUSALS as error:
        return refused(error)
    except OSError as error:
        return refused(OSError(f"the results cannot be written to {args.output}: {error.strerror}"))
    print(f"written: {', '.join(sorted(str(path) for path in folder.iterdir() if path.name in WRITTEN))}")
    return 0


def tell(assessed: Sequence[Assessed], command: str, rescored: bool, folder: Path) -> None:
    """
    Draw, write and print what is easy and what is hard.

    :param assessed: of each run
    :param command: that made it
    :param rescored: whether all transitions were scored anew
    :param folder: where the files go
    """
    found, env_id = study(assessed), assessed[0].run.env_id
    draw_facts(assessed, found, folder / "easy_and_hard.png")
    if env_id in PLACES:
        draw_map(assessed, folder / "map.png")
    about = {
        "command": command,
        "env": env_id,
        "runs": {str(one.run.folder.path): {"checkpoint": one.steps, "transitions": len(one.rows)} for one in assessed},
        "rescored": rescored,
        "versions": library_versions(),
    }
    write_json(folder / "curriculum.json", {**about, "facts": found})
    table = [["of a transition", "ρ with difficulty", "mean of the easiest fifth", "of the hardest fifth"]]
    table += [[name, *(_with_bounds(own[key]) for key in ("correlation", "easy", "hard"))] for name, own in found.items()]
    print(f"{_title(assessed, 'what is easy and what is hard')}{_SPREAD if len(assessed) > 1 else ''}\n\n{as_text(table)}\n")
    if env_id in PLACES:  # the first fact is the distance to the goal, of which the paper speaks
        print(in_words(*next((name, own["correlation"]) for name, own in found.items())))


if __name__ == "__main__":
    start(main)
