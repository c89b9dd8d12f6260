"""What is to be reproduced: experiments of a YAML file as runs of sweeps, each with the place of its record."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.naming import unknown_name
from zoo.hyperparams import CO_TRAINING, HYPERPARAMS
from zoo.pages import NAME
from zoo.run_folder import read_map
from zoo.sweep_plan import KEYS, PlannedRun, in_one_line, plan
from zoo.train import make_parser
from zoo.typed_settings import checked
from zoo.worlds import World

EXPERIMENTS = HYPERPARAMS / "reproduce.yml"
ALL = "all"

N_EVALUATIONS = 40
EVAL_EPISODES = 100
TEST_EPISODES = 10_000
N_SEEDS = 5

# The test of a model as it was trained; others replace some of its groups.
OWN = "own"

# Flags of zoo/train.py, beside the settings, that decide on what a record holds.
FLAGS = ("eval_freq", "eval_episodes", "n_eval_envs", "eval_env_kwargs", "yardstick")

# What runs with a curriculum log of it, as a curve of this name.
CURRICULUM = "curriculum"
OF_THE_CURRICULUM = (
    "rank_correlation_with_last",
    "rank_correlation_with_student",
    "teacher_loss_in_fold",
    "teacher_loss_held_out",
)

LineUp = dict[str, str]

EXPERIMENT_KEYS = {
    "title": str,
    "targets": list[str],
    "seeds": int,
    "sweeps": list[dict[str, Any]],
    "scripted": list[dict[str, str]],
    "tests": dict[str, dict[str, str]],
    "test_episodes": int,
    "columns": dict[str, Any],
    "better": dict[str, str],
    "source": str,
    "published": dict[str, dict[str, float | list[float]]],
    "effects": dict[str, str],
    "contrasts": list[dict[str, Any]],
    "pictures": dict[str, list[dict[str, Any]]],
}
EFFECTS_KEYS = ("default", "quantity", "course")
CONTRAST_KEYS = {"says": str, "of": list[str], "than": list[str]}
SIDES = ("lower", "higher")
TABLES = ("claims", "runs")  # of the page, beside those of the experiments
PANELS = ("curve", "scatter", "estimates", "rivals")
CLAIM_KEYS = {
    "says": str,
    "experiment": str,
    "quantity": str,
    "from": float,
    "higher": str,
    "lower": str,
    "than": float | str,
}


@dataclass(frozen=True)
class Experiment:
    """
    A part of the reproduction, as the YAML file has it (its head tells what each key is).

    :param name: its key there
    """

    name: str
    title: str
    sweeps: Sequence[dict[str, Any]]
    targets: Sequence[str] = ()
    seeds: int = N_SEEDS
    scripted: Sequence[LineUp] = ()
    tests: Mapping[str, LineUp] = field(default_factory=dict)
    test_episodes: int = TEST_EPISODES
    columns: Mapping[str, Any] = field(default_factory=dict)
    better: Mapping[str, str] = field(default_factory=dict)
    source: str = ""
    published: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    effects: Mapping[str, str] = field(default_factory=dict)
    contrasts: Sequence[Mapping[str, Any]] = ()
    pictures: Mapping[str, Sequence[Mapping[str, Any]]] = field(default_factory=dict)

    @property
    def cells(self) -> list[str]:
        """Its cells, in the order of the file."""
        return [
            cell_name(setting, algo)
            for sweep in self.sweeps
            for setting in sweep.get("settings") or [""]
            for algo in sweep.get("algos", ())
        ]

    @property
    def quantities(self) -> list[str]:
        """Every quantity that its table and its pictures show."""
        return list(dict.fromkeys(of for cell in [None, *self.cells] for of in self.quantities_of(cell)))

    def quantities_of(self, cell: str | None) -> list[str]:
        """Every quantity of a cell that its table and its pictures show; of ``None`` those of all cells."""
        weighed = [[of] if isinstance(of, str) else [*of["weights"]] for of in self.columns.values()]
        panels = [panel for own in self.pictures.values() for panel in own if "cells" not in panel or cell in panel["cells"]]
        drawn = [panel[kind] for panel in panels for kind in PANELS if kind in panel]
        effects = [of for key, of in self.effects.items() if key != "default"]
        return [*(name for names in weighed for name in names), *drawn, *effects]

    @property
    def line_ups(self) -> dict[str, LineUp]:
        """Every test: name → who plays a group in place of the model."""
        return {OWN: {}, **self.tests}

    @property
    def env_ids(self) -> set[str]:
        """Its worlds."""
        return {env_id for sweep in self.sweeps for env_id in sweep.get("envs", ())}

    def records(self, folder: Path, scale: float) -> Path:
        """Where its records lie, apart from those of other scales."""
        return folder / self.name / f"scale_{scale:g}"

    def scripted_record(self, folder: Path, line_up: LineUp, n_episodes: int) -> Path:
        """Where it is kept what scripted policies reach, apart by the length of the test."""
        return folder / self.name / "scripted" / f"{n_episodes}_episodes" / f"{'_'.join(line_up.values())}.json"


@dataclass(frozen=True)
class Claim:
    """
    Something that the paper says.

    :param says: in words
    :param experiment: whose runs tell
    :param quantity: by which number of a run
    :param lower: whether lower is what is said, else higher
    :param cell: of whom it is said
    :param than: another cell, or a number
    :param since: mean of a curve from this share of the training on
    """

    says: str
    experiment: str
    quantity: str
    lower: bool
    cell: str
    than: str | float
    since: float = 0.0


@dataclass(frozen=True)
class PlannedRecord:
    """
    A run, and what is kept of it.

    :param experiment: of which it is a part
    :param scale: share of the experiment's env steps
    :param run: the training; its setting says the experiment, too, so that names differ
    :param cell: what runs that differ by their seeds alone are called here
    :param path: of the record
    :param n_test_episodes: of each test
    """

    experiment: Experiment
    scale: float
    run: PlannedRun
    cell: str
    path: Path
    n_test_episodes: int

    @property
    def world(self) -> World:
        """Where the run trains, and is tested."""
        hyperparams = self.run.hyperparams
        return World(self.run.env_id, hyperparams.env_kwargs, hyperparams.env_wrapper)

    @property
    def identity(self) -> dict[str, Any]:
        """What the record is of, as JSON holds it: a run with another one is another run."""
        run = self.run
        flags = {name: getattr(run.args, name) for name in FLAGS}
        tests = {"tests": self.experiment.line_ups, "test_episodes": self.n_test_episodes}
        about = {"experiment": self.experiment.name, "cell": self.cell, "scale": self.scale, "seed": run.seed}
        learner = {"algo": run.algo, "env": run.env_id}
        return json.loads(json.dumps({**about, **learner, **tests, **flags, "settings": run.hyperparams.to_dict()}))

    def begin(self, keep_runs: bool) -> Path:
        """
        Write the order for ``zoo/reproduce_run.py``, beside the run.

        :param keep_runs: whether its checkpoints and logs are kept when it has ended
        :return: the file
        """
        order = {"words": self.run.words, "record": str(self.path.resolve()), "keep_runs": keep_runs}
        path = self.run.place.log.with_suffix(".order.json")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({**order, "identity": self.identity}))
        return path


def cell_name(setting: str, algo: str) -> str:
    """What runs that differ by their seeds alone are called; of teams that learn apart the setting tells the algorithms."""
    return setting if setting and algo == CO_TRAINING else "/".join(filter(None, (setting, algo)))


def read_experiments(file: str | Path = EXPERIMENTS) -> tuple[dict[str, Experiment], list[Claim]]:
    """
    All experiments, and the claims that they tell about.

    :param file: YAML
    :raises ValueError: one sentence about what is wrong with the file
    """
    given = read_map(Path(file))
    try:
        parts = checked("key", given, {"experiments": dict[str, dict[str, Any]], "claims": list[dict[str, Any]]})
        experiments = {name: _experiment(name, own) for name, own in parts.get("experiments", {}).items()}
        if not experiments:
            raise ValueError("experiments is missing")
        return experiments, [_claim(own, experiments) for own in parts.get("claims", [])]
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def _experiment(name: str, given: Mapping[str, Any]) -> Experiment:
    own = checked(f"key of the experiment {name}", given, EXPERIMENT_KEYS)
    for key in ("title", "sweeps"):
        if not own.get(key):
            raise ValueError(f"the experiment {name} lacks {key}")
    for what, called in (("an experiment", name), *(("a picture", picture) for picture in own.get("pictures", {}))):
        if not re.fullmatch(NAME, called) or called in (ALL, *TABLES):
            raise ValueError(
                f'{what} is called "{called}"; give it a name of a-z, 0-9, _ and -, other than {ALL}, {_listed(TABLES)}'
            )
    own["columns"] = {heading: _column(name, heading, of) for heading, of in own.get("columns", {}).items()}
    own["sweeps"] = [checked(f"key of a sweep of {name}", sweep, KEYS) for sweep in own["sweeps"]]
    experiment = Experiment(name, **own)
    require_count(f"{name}: seeds", experiment.seeds)
    require_count(f"{name}: test_episodes", experiment.test_episodes, least=2)
    _check_worlds(experiment)
    _check_columns(experiment)
    panels = [panel for panels in experiment.pictures.values() for panel in panels]
    for panel in panels:
        _check_panel(name, panel)
    _check_effects(experiment)
    default = [experiment.effects["default"]] if experiment.effects else []
    contrasted = [cell for contrast in experiment.contrasts for cell in [*contrast["of"], *contrast["than"]]]
    for cell in [*experiment.published, *default, *contrasted, *(cell for panel in panels for cell in panel.get("cells", ()))]:
        require_cell(experiment, cell)
    for of in experiment.quantities:
        require_quantity(experiment, of)
    return experiment


def _listed(names: Sequence[Any]) -> str:
    return " and ".join(map(str, names))


def _column(name: str, heading: str, of: Any) -> Any:
    """
    A column of a table, its numbers as numbers.

    :raises ValueError: if it is neither a quantity nor weights of some
    """
    if isinstance(of, str):
        return of
    if not isinstance(of, dict) or not of.get("weights"):
        raise ValueError(
            f'{name}: the column "{heading}" is {in_one_line(of)}; it must be a quantity, or have weights of some'
        )
    return checked(f'key of the column "{heading}" of {name}', of, {"weights": dict[str, float], "plus": float})


def _check_worlds(experiment: Experiment) -> None:
    """
    :raises ValueError: if its runs cannot be told apart by their cells, or its tests and scripted policies cannot be played
    """
    name = experiment.name
    for sweep in experiment.sweeps:
        worlds = sweep.get("envs", ())
        if len(worlds) > 1:
            raise ValueError(
                f"{name}: a sweep has the worlds {_listed(worlds)}; give each a sweep or an experiment of its own"
            )
    if OWN in experiment.tests:
        raise ValueError(f"{name}: a test is called {OWN}, which is the name of the model's own; call it otherwise")
    if experiment.scripted and len(experiment.env_ids) != 1:
        raise ValueError(f"the experiment {name} has scripted policies and {len(experiment.env_ids)} worlds; it must have one")


def _check_columns(experiment: Experiment) -> None:
    """
    :raises ValueError: if something is said of a column that there is not, or what cannot be said
    """
    said = [*experiment.better, *(column for own in experiment.published.values() for column in own)]
    for column in said:
        if column not in experiment.columns:
            raise ValueError(unknown_name(f"column of {experiment.name}", column, experiment.columns))
    for column, side in experiment.better.items():
        if side not in SIDES:
            raise ValueError(f'{experiment.name}: better: {column} is "{side}"; it must be {" or ".join(SIDES)}')


def _check_effects(experiment: Experiment) -> None:
    """
    :raises ValueError: if effects cannot be told
    """
    name, effects = experiment.name, experiment.effects
    for key in effects:
        if key not in EFFECTS_KEYS:
            raise ValueError(unknown_name(f"key of the effects of {name}", key, EFFECTS_KEYS))
    if effects and effects.keys() - {"course"} != {"default", "quantity"}:
        raise ValueError(f"{name}: effects needs default and quantity, not {in_one_line(effects)}")
    course = effects.get("course", "curve/")
    if not course.startswith("curve/"):
        raise ValueError(f"{name}: course of effects is {course}; it must be of curve/…")
    for contrast in experiment.contrasts:
        own = checked(f"key of a contrast of {name}", contrast, CONTRAST_KEYS)
        if not all(own.get(key) for key in CONTRAST_KEYS):
            raise ValueError(f"{name}: a contrast needs says, of and than, not {in_one_line(contrast)}")
        if both := set(own["of"]) & set(own["than"]):
            raise ValueError(f"{name}: the contrast {own['says']} has {_listed(sorted(both))} on both sides")
    if experiment.contrasts and not effects:
        raise ValueError(f"{name}: contrasts are by the quantities of effects, and there are none")


def _check_panel(name: str, panel: Mapping[str, Any]) -> None:
    """
    :raises ValueError: for a panel that cannot be drawn, as far as the file tells
    """
    kinds = [kind for kind in PANELS if kind in panel]
    own = checked(f"key of a panel of {name}", panel, {"title": str, "cells": list[str], **dict.fromkeys(PANELS, str)})
    if len(kinds) != 1 or not own.get("title") or own.get("cells") == []:
        raise ValueError(f"{name}: a panel needs a title and one of {', '.join(PANELS)}, not {in_one_line(panel)}")
    (kind,) = kinds
    for drawn, start in (("curve", "curve/"), ("rivals", "curve/"), ("scatter", "test/")):
        if kind == drawn and not own[kind].startswith(start):
            raise ValueError(f"{name}: the panel {own['title']} is a {kind} of {own[kind]}; it must be of {start}…")


def require_cell(experiment: Experiment, cell: str) -> None:
    """
    :raises ValueError: if the experiment has no such cell, with the nearest one
    """
    if cell not in experiment.cells:
        raise ValueError(unknown_name(f"cell of {experiment.name}", cell, experiment.cells))


def require_quantity(experiment: Experiment, of: str) -> None:
    """
    :raises ValueError: for a quantity that no record of the experiment can have, as far as its name tells
    """
    kind, _, rest = str(of).partition("/")
    name, _, metric = rest.partition("/")
    if kind not in ("test", "curve") or not name or not metric:
        raise ValueError(f"{experiment.name}: a quantity is test/<test>/<metric> or curve/<evaluation>/<metric>, not {of}")
    if kind == "test" and name not in experiment.line_ups:
        raise ValueError(unknown_name(f"test of {experiment.name}", name, experiment.line_ups))


def _claim(given: Mapping[str, Any], experiments: Mapping[str, Experiment]) -> Claim:
    own = checked("key of a claim", given, CLAIM_KEYS)
    directions = [key for key in ("higher", "lower") if key in own]
    if len(directions) != 1 or not {"says", "experiment", "quantity", "than"} <= own.keys():
        raise ValueError(
            f"a claim needs says, experiment, quantity, than, and one of higher and lower, not {in_one_line(own)}"
        )
    if own["experiment"] not in experiments:
        raise ValueError(unknown_name("experiment", own["experiment"], experiments))
    if not 0 <= own.get("from", 0.0) < 1:
        raise ValueError(f"from of a claim is {own['from']:g}; it must be at least 0 and below 1 ({own['says']})")
    (direction,) = directions
    experiment = experiments[own["experiment"]]
    require_quantity(experiment, own["quantity"])
    for cell in (own[direction], own["than"]):
        if isinstance(cell, str):
            require_cell(experiment, cell)
    return Claim(
        own["says"],
        own["experiment"],
        own["quantity"],
        direction == "lower",
        own[direction],
        own["than"],
        own.get("from", 0.0),
    )


def chosen(experiments: Mapping[str, Experiment], targets: Sequence[str]) -> list[Experiment]:
    """
    The experiments that show some targets, each once, in the order of the file.

    :param experiments: all of them
    :param targets: names of experiments, of tables and figures, or ``"all"``
    :raises ValueError: for one that there is not, with the nearest one
    """
    known = {*experiments, *(target for own in experiments.values() for target in own.targets), ALL}
    for target in targets:
        if target not in known:
            raise ValueError(unknown_name("target", target, known))
    if not targets:
        raise ValueError(f"say what to reproduce: {', '.join(sorted(known))}")
    return [own for own in experiments.values() if {own.name, ALL, *own.targets} & {*targets}]


def planned(
    experiment: Experiment,
    scale: float,
    folder: Path,
    records: Path,
    n_seeds: int | None = None,
    n_test_episodes: int | None = None,
    threads: int = 1,
) -> list[PlannedRecord]:
    """
    The runs of an experiment.

    :param experiment: the experiment
    :param scale: share of its env steps
    :param folder: of the runs
    :param records: folder of all records
    :param n_seeds: from 0 on; by default the experiment's
    :param n_test_episodes: by default the experiment's
    :param threads: of PyTorch, in each run
    :raises ValueError: one sentence about what is wrong
    """
    found: dict[Path, PlannedRecord] = {}
    try:
        for sweep in experiment.sweeps:
            for run in _runs_of(sweep, scale, experiment.records(folder, scale), n_seeds or experiment.seeds, threads):
                cell = cell_name(run.setting, run.algo)
                path = experiment.records(records, scale) / cell / f"seed_{run.seed}.json"
                if path in found:
                    raise ValueError(f"two sweeps have the cell {cell}; give one of them settings with another name")
                named = replace(run, setting="/".join(filter(None, (experiment.name, run.setting))))
                n_episodes = n_test_episodes or experiment.test_episodes
                found[path] = PlannedRecord(experiment, scale, named, cell, path, n_episodes)
    except ValueError as error:
        raise ValueError(f"{experiment.name}: {error}") from None
    return list(found.values())


def _runs_of(sweep: Mapping[str, Any], scale: float, folder: Path, n_seeds: int, threads: int) -> list[PlannedRun]:
    """
    :param sweep: as the file has it, without seeds
    :param scale: see :func:`planned`
    :param folder: where the runs lie
    :param n_seeds: from 0 on
    :param threads: see :func:`planned`
    :raises ValueError: see :func:`planned`
    """
    if "seeds" in sweep:
        raise ValueError("seeds of a sweep are not for the file to give; use --seeds")
    lengths = {run.hyperparams.n_timesteps for run in plan({**sweep, "seeds": 1}, folder, threads)}
    if len(lengths) > 1:
        raise ValueError(f"a sweep has runs of {' and '.join(map(str, sorted(lengths)))} env steps; make it several sweeps")
    flags = {str(name).replace("_", "-"): value for name, value in sweep.get("train", {}).items()}
    n_timesteps = max(1, round(scale * lengths.pop()))
    every = max(1, n_timesteps // N_EVALUATIONS)
    own = {
        "eval-freq": every,
        "eval-episodes": EVAL_EPISODES,
        "n-eval-envs": EVAL_EPISODES,
        "save-freq": max(every, make_parser().get_default("save_freq")),
        "keep-checkpoints": 1,
        "player-freq": -1,
        "verbose": 0,
    }
    train = {**own, **flags, "n-timesteps": n_timesteps}
    return plan({**sweep, "seeds": n_seeds, "train": train}, folder, threads)
