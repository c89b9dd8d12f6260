"""What a comparison finds: the statistics, tables as text and Markdown, JSON, a picture, and the JSON of marl-eval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import ScalarFormatter

from sb3_kfcv.common.evaluation import Interval
from zoo.match_results import as_markdown, as_text, shown
from zoo.plots import draw_estimates, draw_intervals, draw_legend, line_styles, new_figure, save_figure, wrapped
from zoo.run_groups import Group, metric_label
from zoo.runs import Run
from zoo.statistics import (
    ENOUGH_RUNS,
    Scores,
    ahead,
    fewest,
    improvement_with_interval,
    iqm_with_interval,
    profile_with_intervals,
)

# Every statistic draws from a generator of this seed: the same runs give the same numbers.
BOOTSTRAP_SEED = 0

# At how many scores a performance profile is drawn.
N_THRESHOLDS = 101

HEIGHT_OF_LABEL = 0.55  # inches

# Of more pairs the picture shows those with the first algorithm alone.
MOST_PAIRS = 10


@dataclass(frozen=True)
class Outcome:
    """
    How a run came out.

    :param run: the run
    :param steps: env steps of its evaluations (evaluations,)
    :param values: of the metric (evaluations, episodes)
    :param at: the number of the evaluation that counts
    :param seconds: wall-clock time of the training up to it; NaN where it is not known
    """

    run: Run
    steps: np.ndarray
    values: np.ndarray
    at: int
    seconds: float

    @property
    def step(self) -> int:
        """Env steps at which it counts."""
        return int(self.steps[self.at])

    @property
    def score(self) -> float:
        """The mean over the episodes that count."""
        return float(self.values[self.at].mean())


@dataclass(frozen=True)
class Improvement:
    """
    Whether one algorithm is better than another.

    :param better: X
    :param than: Y
    :param probability: P(X > Y)
    :param so: whether it is, see :func:`~zoo.statistics.ahead`
    :param n_seeds: of whoever has fewest, in the world where they have fewest
    """

    better: str
    than: str
    probability: Interval
    so: bool | None
    n_seeds: int

    @property
    def verdict(self) -> str:
        """In words."""
        if self.n_seeds < ENOUGH_RUNS:
            return f"cannot be told from fewer than {ENOUGH_RUNS} seeds"
        if self.so is None:
            return "cannot be told"
        return f"{self.better if self.so else self.than} is better"


@dataclass(frozen=True)
class Comparison:
    """
    All that is compared.

    :param groups: runs that are seeds of one another, ordered by world and algorithm
    :param outcomes: of each run
    :param shared: the worlds in which every algorithm has runs; statistics over several worlds are over these
    :param metric: what is compared
    :param eval_name: of which evaluation
    :param sign: −1 where lower is better, else 1
    :param point: which evaluation counts, as it was asked for
    :param limits: world → values that count as 0 and as 1; ``None`` takes the worst and the best run
    """

    groups: Sequence[Group]
    outcomes: Mapping[Run, Outcome]
    shared: Sequence[str]
    metric: str
    eval_name: str
    sign: int
    point: str
    limits: Mapping[str, tuple[float, float]] | None

    @property
    def labels(self) -> list[str]:
        """Of the algorithms."""
        return list(dict.fromkeys(group.label for group in self.groups))

    @property
    def worlds(self) -> dict[str, list[Group]]:
        """World → its groups."""
        return {
            world: [own for own in self.groups if own.env_id == world] for world in dict.fromkeys(map(_world, self.groups))
        }

    def values(self, group: Group) -> np.ndarray:
        """The metric of each run (runs,)."""
        return np.array([self.outcomes[run].score for run in group.runs])

    def interval(self, group: Group) -> Interval:
        """The IQM of the metric over the runs."""
        return iqm_with_interval({group.env_id: self.values(group)}, _generator())

    @property
    def range(self) -> dict[str, tuple[float, float]]:
        """Shared world → the values that count as 0 and as 1."""
        if self.limits is not None:
            return dict(self.limits)
        ranges = {}
        for world in self.shared:
            every = np.concatenate([self.values(group) for group in self.worlds[world]])
            worst, best = (every.min(), every.max()) if self.sign > 0 else (every.max(), every.min())
            ranges[world] = (float(worst), float(best))
        return ranges

    @cached_property
    def scores(self) -> Mapping[str, Scores]:
        """Label → shared world → normalised scores (runs,), of which more is better."""
        found: dict[str, dict[str, np.ndarray]] = {label: {} for label in self.labels}
        for world in self.shared:
            zero, one = self.range[world]
            for group in self.worlds[world]:
                found[group.label][world] = (self.values(group) - zero) / ((one - zero) or 1.0)
        return found

    @cached_property
    def overall(self) -> dict[str, Interval]:
        """Label → IQM of the normalised scores over all shared worlds."""
        return {label: iqm_with_interval(scores, _generator()) for label, scores in self.scores.items()}

    @cached_property
    def thresholds(self) -> np.ndarray:
        """The scores at which performance profiles are drawn: from 0 to 1, and further where there are such runs."""
        every = np.concatenate([values for scores in self.scores.values() for values in scores.values()])
        return np.linspace(min(0.0, every.min()), max(1.0, every.max()), N_THRESHOLDS)

    @cached_property
    def profiles(self) -> dict[str, list[Interval]]:
        """Label → share of the runs above each of the thresholds."""
        return {label: profile_with_intervals(own, self.thresholds, _generator()) for label, own in self.scores.items()}

    @cached_property
    def improvements(self) -> list[Improvement]:
        """Of every pair, the later algorithm over the earlier one."""
        return [
            Improvement(
                better,
                than,
                improvement_with_interval(self.scores[better], self.scores[than], _generator()),
                ahead(self.scores[better], self.scores[than], _generator()),
                min(fewest(self.scores[better]), fewest(self.scores[than])),
            )
            for than, better in combinations(self.labels, 2)
        ]

    @property
    def of_what(self) -> str:
        """The metric and the evaluation, in words."""
        at = {"last": "the last evaluation", "best": "the best evaluation"}
        when = at.get(self.point, f"the evaluation nearest to {self.point} env steps")
        return f"{metric_label(self.metric, self.eval_name)}, mean over the episodes of {when} of each run"

    @property
    def of_scores(self) -> str:
        """How scores are normalised, in words."""
        source = "given" if self.limits is not None else "worst and best run"
        ranges = ", ".join(f"{world} {zero:.4g} to {one:.4g}" for world, (zero, one) in self.range.items())
        return f"0 to 1 are {ranges} ({source})"


def _world(group: Group) -> str:
    return group.env_id


def _generator() -> np.random.Generator:
    return np.random.default_rng(BOOTSTRAP_SEED)


def world_lines(comparison: Comparison, groups: Sequence[Group]) -> list[list[str]]:
    """One world as a table of texts, its head first."""
    lines = [["algorithm", "IQM", "mean ± standard error", "min … max", "seeds", "env steps", "time", "time, relative"]]
    seconds = [float(np.median([comparison.outcomes[run].seconds for run in group.runs])) for group in groups]
    places = decimals(np.concatenate([comparison.values(group) for group in groups]))
    for group, own in zip(groups, seconds, strict=True):
        values = comparison.values(group)
        steps = sorted({comparison.outcomes[run].step for run in group.runs})
        spread = f" ± {values.std(ddof=1) / np.sqrt(len(values)):.{places}f}" if len(values) > 1 else ""
        lines.append(
            [
                group.label,
                shown(comparison.interval(group), places),
                f"{values.mean():.{places}f}{spread}",
                f"{values.min():.{places}f} … {values.max():.{places}f}",
                str(len(values)),
                f"{steps[0]:,}" + (f" … {steps[-1]:,}" if len(steps) > 1 else ""),
                "unknown" if np.isnan(own) else clock_time(own),
                "unknown" if np.isnan(own / seconds[0]) else f"{own / seconds[0]:.2f}",
            ]
        )
    return lines


def decimals(values: np.ndarray) -> int:
    """How many decimals show three digits of what some values differ by; at least one, at most four."""
    apart = float(np.ptp(values))
    return int(np.clip(2 - np.floor(np.log10(apart)), 1, 4)) if apart > 0 else 2


def clock_time(seconds: float) -> str:
    """Hours and minutes, minutes and seconds, or seconds."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min {rest:02d} s"


def overall_lines(comparison: Comparison) -> list[list[str]]:
    """All worlds together as a table of texts, its head first."""
    head = ["algorithm", "IQM of normalised scores", "runs"]
    sizes = {label: sum(map(len, scores.values())) for label, scores in comparison.scores.items()}
    return [head, *([label, shown(own), str(sizes[label])] for label, own in comparison.overall.items())]


def improvement_lines(comparison: Comparison) -> list[list[str]]:
    """Who is better than whom, as a table of texts, its head first."""
    lines = [["X", "Y", "P(X better than Y)", "so"]]
    return lines + [[own.better, own.than, shown(own.probability), own.verdict] for own in comparison.improvements]


def parts_of(comparison: Comparison) -> dict[str, list[list[str]]]:
    """Title → table, of all that is shown."""
    parts = {world: world_lines(comparison, groups) for world, groups in comparison.worlds.items()}
    over = ", ".join(comparison.shared)
    if len(comparison.shared) > 1:
        parts[f"Normalised scores over {over}; {comparison.of_scores}"] = overall_lines(comparison)
    parts[f"Probability of improvement, over {over}"] = improvement_lines(comparison)
    return parts


def as_screen(comparison: Comparison) -> str:
    """All tables as text."""
    tables = "\n".join(f"{title}\n\n{as_text(lines)}\n" for title, lines in parts_of(comparison).items())
    return f"{comparison.of_what}; 95 % intervals over seeds\n\n{tables}"


def as_markdown_page(comparison: Comparison, about: Mapping[str, Any]) -> str:
    """
    All tables as a page.

    :param comparison: what was found
    :param about: the command and versions
    """
    versions = ", ".join(f"{name} {number}" for name, number in about["versions"].items())
    parts = [
        f"# {metric_label(comparison.metric, comparison.eval_name)}",
        f"Compared: {comparison.of_what}; {'lower' if comparison.sign < 0 else 'higher'} is better. Intervals: 95 %, "
        f"stratified bootstrap over seeds. Times: median, relative to the first. Versions: {versions}.",
        f"    {about['command']}",
        *(f"## {title}\n\n{as_markdown(lines)}" for title, lines in parts_of(comparison).items()),
    ]
    return "\n\n".join(parts) + "\n"


def as_report(comparison: Comparison, about: Mapping[str, Any]) -> dict[str, Any]:
    """
    All numbers.

    :param comparison: what was found
    :param about: the command and versions
    """
    names = ("metric", "eval_name", "point")
    worlds = {
        world: {group.label: _numbers(comparison, group) for group in groups} for world, groups in comparison.worlds.items()
    }
    return {
        **about,
        **{name: getattr(comparison, name) for name in names},
        "better": "lower" if comparison.sign < 0 else "higher",
        "worlds": worlds,
        "scores_0_and_1": comparison.range,
        "normalised_iqm": comparison.overall,
        "improvement": [{**vars(own), "verdict": own.verdict} for own in comparison.improvements],
        "profiles": {"thresholds": comparison.thresholds.tolist(), **comparison.profiles},
    }


def _numbers(comparison: Comparison, group: Group) -> dict[str, Any]:
    outcomes = [comparison.outcomes[run] for run in group.runs]
    return {
        "iqm": comparison.interval(group),
        "runs": [
            {
                "run": str(own.run.folder.path),
                "seed": own.run.seed,
                "step": own.step,
                "value": own.score,
                "seconds": own.seconds,
            }
            for own in outcomes
        ],
    }


def draw(comparison: Comparison, path: Path) -> None:
    """
    A panel for each world, one for all, one with performance profiles, one with who is better than whom.

    :param comparison: what was found
    :param path: of the PNG
    """
    several = len(comparison.shared) > 1
    styles = line_styles({group.label: group.algo for group in comparison.groups})
    colours = {label: colour for label, (colour, _) in styles.items()}
    pairs = comparison.improvements
    if len(pairs) > MOST_PAIRS:
        pairs = [own for own in pairs if own.than == comparison.labels[0]]
    title = "IQM over seeds (circles), 95 % bootstrap intervals"
    height = max(3.8, HEIGHT_OF_LABEL * max(len(comparison.labels), len(pairs)))
    figure, axes = new_figure(len(comparison.worlds) + several + 2, title, (5.2, height))
    measured = metric_label(comparison.metric, comparison.eval_name) + (" (lower is better)" if comparison.sign < 0 else "")
    for axis, (world, groups) in zip(axes, comparison.worlds.items(), strict=False):
        intervals = {group.label: comparison.interval(group) for group in groups}
        draw_estimates(axis, intervals, colours, {group.label: comparison.values(group) for group in groups})
        axis.set_title(world)
        axis.set_xlabel(measured)
    if several:
        every = {label: np.concatenate([*own.values()]) for label, own in comparison.scores.items()}
        draw_estimates(axes[-3], comparison.overall, colours, every)
        axes[-3].set_title("all worlds")
        axes[-3].set_xlabel("normalised score (higher is better)")
    for label, shares in comparison.profiles.items():
        draw_intervals(axes[-2], comparison.thresholds, shares, colours[label], wrapped(label), styles[label][1])
    axes[-2].set_title("performance profile")
    axes[-2].set_xlabel("normalised score τ")
    axes[-2].set_ylabel("share of runs above τ")
    draw_legend(axes[-2], below=True)
    labelled = {f"{own.better}\n> {own.than}": own for own in pairs}
    intervals = {label: own.probability for label, own in labelled.items()}
    draw_estimates(axes[-1], intervals, {label: colours[own.better] for label, own in labelled.items()})
    axes[-1].axvline(0.5, color="black", linewidth=0.8, linestyle="--")
    axes[-1].set_xlim(-0.03, 1.03)
    axes[-1].set_title("who is better")
    axes[-1].set_xlabel("probability that a run of the first is better")
    for axis in axes:
        axis.xaxis.set_major_formatter(ScalarFormatter())
    save_figure(figure, path)


def marl_eval(comparison: Comparison) -> dict[str, Any]:
    """
    The episodes of all evaluations, as marl-eval reads them: environment → task → algorithm → run → ``step_<i>``, each with
    its ``step_count`` and the metric of each episode, and ``absolute_metrics``: the episodes that count here. Names are in
    lower case, as marl-eval looks them up, and those of algorithms without the commas that it refuses.

    The tasks of one environment must have the same number of evaluations there. Worlds that have are tasks of ``sb3_kfcv``;
    else each is an environment of its own.
    """
    lengths = {len(own.steps) for own in comparison.outcomes.values()}
    found: dict[str, Any] = {}
    for world, groups in comparison.worlds.items():
        task = world.lower()
        tasks = found.setdefault("sb3_kfcv" if len(lengths) == 1 else task, {})
        tasks[task] = {group.label.lower().replace(",", ""): _runs(comparison, group) for group in groups}
    return found


def _runs(comparison: Comparison, group: Group) -> dict[str, Any]:
    runs: dict[str, Any] = {}
    for own in (comparison.outcomes[run] for run in group.runs):
        name = f"seed_{own.run.seed}"
        if name in runs:
            name = f"{name}_{own.run.folder.number}"
        steps = {
            f"step_{i}": {"step_count": int(step), comparison.metric: values.tolist()}
            for i, (step, values) in enumerate(zip(own.steps, own.values, strict=True))
        }
        runs[name] = {**steps, "absolute_metrics": {comparison.metric: own.values[own.at].tolist()}}
    return runs
