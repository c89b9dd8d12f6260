"""Runs that are seeds of one another, and what they have in common: how plots and comparisons see a folder of runs."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from sb3_kfcv.common.naming import unknown_name
from zoo.hyperparams import flat
from zoo.match_results import described
from zoo.plots import ALGO_LABELS
from zoo.runs import Run
from zoo.series import Progress, evaluation_files, evaluations, progress
from zoo.statistics import ENOUGH_RUNS

# The metric of whoever asks for none.
REWARD = "reward"

# Arrays of evaluations.npz that have SB3's names there.
METRIC_NAMES = {"results": REWARD, "ep_lengths": "length"}

# What --group-by knows beside the settings: the seed, the preset, and the folder over <algo>/<env>_<k>, a cell of a sweep.
FURTHER_SETTINGS = ("seed", "preset", "folder")

SEED_FOLDER = re.compile(r"seed_\d+")

Data = TypeVar("Data")


@dataclass(frozen=True)
class Group:
    """
    Runs that differ by their seeds.

    :param label: of what they have in common, such as ``KFCV-MADDPG, gamma 0.9``
    :param algo: their algorithm
    :param env_id: their world
    :param runs: at least one
    """

    label: str
    algo: str
    env_id: str
    runs: tuple[Run, ...]

    def __str__(self) -> str:
        return f"{self.label} on {self.env_id}"

    @property
    def size(self) -> str:
        """Such as ``5 seeds``."""
        return f"{len(self.runs)} seeds" if len(self.runs) > 1 else "1 run"


def grouped(runs: Iterable[Run], by: Sequence[str] = ()) -> list[Group]:
    """
    Runs in groups, by algorithm, by world, and by settings that are named; worlds in the order in which they come, within each
    the algorithms in that of the method's paper.

    :param runs: in any order
    :param by: settings with dots (``policy_kwargs.n_critics``), or ``seed``, ``preset``, ``folder``
    :raises ValueError: for a setting that no run has, with the nearest one
    """
    found: dict[tuple[str, str, str], list[Run]] = {}
    settings = {run: settings_of_run(run) for run in runs}
    known = {name for own in settings.values() for name in own}
    for name in by:
        if name not in known:
            raise ValueError(unknown_name("setting", name, known))
    for run, own in settings.items():
        label = ", ".join([learner(run), *(f"{name} {own[name]}" for name in by if name in own)])
        found.setdefault((run.env_id, run.algo, label), []).append(run)
    groups = [Group(label, algo, env_id, tuple(own)) for (env_id, algo, label), own in found.items()]
    worlds, algos = list(dict.fromkeys(group.env_id for group in groups)), list(ALGO_LABELS)
    return sorted(
        groups,
        key=lambda group: (worlds.index(group.env_id), algos.index(group.algo) if group.algo in algos else len(algos)),
    )


def learner(run: Run) -> str:
    """Who learns, and by which algorithm, for people to read."""
    teams = run.config.get("teams")
    if teams:
        return " against ".join(f"{algo_label(theirs['algo'])} {team}" for team, theirs in teams.items())
    team = run.config.get("team")
    return f"{algo_label(run.algo)} {team}" if team else algo_label(run.algo)


def algo_label(algo: str) -> str:
    """The name of an algorithm, for people to read."""
    return ALGO_LABELS.get(algo, algo)


def settings_of_run(run: Run) -> dict[str, str]:
    """All settings of a run, those of nested maps with dots, and ``FURTHER_SETTINGS``; as text."""
    folder = run.folder.path.resolve().parents[1]
    if SEED_FOLDER.fullmatch(folder.name):  # of a sweep: the setting is above it
        folder = folder.parent
    further = {"seed": run.seed, "preset": run.args.get("preset") or "default", "folder": folder.name}
    return {name: str(value) for name, value in {**flat(run.config), **further}.items()}


def differences(group: Group) -> list[str]:
    """The settings in which the runs of a group differ beside their seeds, each as ``gamma (0.9, 0.95)``."""
    settings = [settings_of_run(run) for run in group.runs]
    return [
        f"{name} ({', '.join(sorted(values))})"
        for name in dict.fromkeys(name for own in settings for name in own)
        if name not in ("n_timesteps", *FURTHER_SETTINGS) and len(values := {own.get(name, "none") for own in settings}) > 1
    ]


def doubts(group: Group) -> list[str]:
    """What may make the runs of a group something else than seeds of one another."""
    found = []
    differing = differences(group)
    if differing:
        found.append(f"{group}: the runs differ in {', '.join(differing)}; --group-by tells them apart")
    seeds = [run.seed for run in group.runs]
    twice = sorted({seed for seed in seeds if seeds.count(seed) > 1})
    if twice:
        found.append(
            f"{group}: more than one run has the seed {', '.join(map(str, twice))}; the same run again is no evidence"
        )
    return found


def too_few(groups: Iterable[Group]) -> list[str]:
    """Which groups have too few runs for their intervals to mean much: in one sentence, or none."""
    few = [f"{group} has {len(group.runs)}" for group in groups if len(group.runs) < ENOUGH_RUNS]
    return [f"fewer than {ENOUGH_RUNS} seeds are too few to tell much: {first_of(few)}"] if few else []


def first_of(texts: Sequence[str], most: int = 3) -> str:
    """The first of some texts, and how many more there are."""
    more = f", and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def note(text: str) -> None:
    """Tell what is worth knowing, and no error."""
    print(f"note: {text}", file=sys.stderr)


def metrics_of(run: Run, eval_name: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """
    Metric → env steps (evaluations,) and its values (evaluations, episodes).

    :param run: the run
    :param eval_name: which evaluation, as of :func:`zoo.series.evaluations`
    :raises ValueError: if it has none of this name
    """
    arrays = evaluations(run.folder.path, eval_name)
    steps = arrays.pop("timesteps")
    return {METRIC_NAMES.get(name, name): (steps, values.astype(float)) for name, values in arrays.items()}


def rewards(run: Run) -> np.ndarray:
    """
    The mean reward of each evaluation of a run (evaluations,); empty where there is none.

    :raises ValueError: for a file of evaluations that is damaged
    """
    file = evaluation_files(run.folder.path).get("eval")
    if file is None:
        return np.empty(0)
    found = evaluations(run.folder.path)
    if "results" not in found:
        raise ValueError(f"{file} holds no rewards of evaluations")
    return np.mean(found["results"], axis=1)


def metric_label(metric: str, eval_name: str) -> str:
    """What a metric is, for axes."""
    own = {REWARD: "reward per episode", "length": "episode length (env steps)"}
    return own.get(metric, described(metric)) + ("" if eval_name == "eval" else f", {eval_name.replace('_', ' ')}")


def of_each(runs: Sequence[Run], load: Callable[[Run], Mapping[str, Data]], kind: str, name: str) -> dict[Run, Data]:
    """
    One thing of many runs. Runs that lack it are left out, which a note tells.

    :param runs: where to look
    :param load: name → data of a run; its ``ValueError`` says why there is nothing
    :param kind: what is asked for, such as ``"metric"``
    :param name: its name
    :raises ValueError: if no run has it, with the nearest name
    """
    tables: dict[Run, Mapping[str, Data]] = {}
    reasons: dict[Run, str] = {}
    for run in runs:
        try:
            tables[run] = load(run)
        except ValueError as error:
            reasons[run] = str(error)
    if not tables:
        every = f"of {len(runs)} runs none will do: " if len(runs) > 1 else ""
        raise ValueError(every + next(iter(reasons.values())))
    known = {own for table in tables.values() for own in table}
    if name not in known:
        raise ValueError(unknown_name(kind, name, known))
    lacking = [run for run, table in tables.items() if name not in table]
    if lacking:
        note(f"left out, since there is no {kind} {name}: {first_of([str(run.folder.path) for run in lacking])}")
    if reasons:
        note(f"left out: {first_of([*reasons.values()])}")
    return {run: table[name] for run, table in tables.items() if name in table}


def only(groups: Iterable[Group], runs: Iterable[Run]) -> list[Group]:
    """The groups without the runs that are not among these; without runs there is no group."""
    kept = set(runs)
    rest = [Group(group.label, group.algo, group.env_id, tuple(run for run in group.runs if run in kept)) for group in groups]
    return [group for group in rest if group.runs]


def progress_of(run: Run) -> Progress:
    """
    How far a run was, and when.

    :raises ValueError: if that is not known
    """
    before = 0
    if run.args.get("trained_agent"):
        if run.args["n_timesteps"] < 1:
            raise ValueError(f"{run.folder.path} trained on without -n: at how many env steps it began is not known")
        before = run.config["n_timesteps"] - run.args["n_timesteps"]
    return progress(run.folder.monitor_file, before)
