"""The runs of a sweep, read from its YAML file and checked, every one, before any is begun."""

from __future__ import annotations

import argparse
import copy
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sb3_kfcv.common.naming import unknown_name
from zoo import train
from zoo.hyperparams import Hyperparams
from zoo.run_folder import read_map
from zoo.runs import Run
from zoo.sweep_run import Place
from zoo.typed_settings import checked

KEYS = {
    "algos": list[str],
    "envs": list[str],
    "seeds": int | list[int],
    "settings": dict[str, dict[str, Any]],
    "train": dict[str, Any],
}
NEEDED = ("algos", "envs", "seeds")

# Flags of zoo/train.py that the sweep gives itself, each with what to write instead.
OWN_FLAGS = {
    "algo": "algos",
    "env": "envs",
    "seed": "seeds",
    "hyperparams": "settings",
    "log-folder": "-f on the command line",
    "num-threads": "--threads on the command line",
    "progress": "nothing, the sweep shows it",
    "resume": "nothing, the sweep does it by itself",
}

# Of a run's command line: what may be another one when the sweep goes on, and what the resolved settings hold.
FREE = ("log_folder", "num_threads", "verbose", "progress", "resume")
IN_THE_SETTINGS = ("hyperparams", "env_kwargs", "team", "opponents", "conf_file", "preset")

SETTING = re.compile(r"[\w.+-]*\w")  # a name that can be a folder's


@dataclass(frozen=True)
class PlannedRun:
    """
    One run of a sweep.

    :param setting: name of its settings; empty if the sweep has none
    :param seed: of the run
    :param args: the command line, resolved
    :param words: the command line, as words
    :param hyperparams: the settings
    """

    setting: str
    seed: int
    args: argparse.Namespace
    words: tuple[str, ...]
    hyperparams: Hyperparams

    @property
    def algo(self) -> str:
        return self.args.algo

    @property
    def env_id(self) -> str:
        return self.args.env

    @property
    def name(self) -> str:
        """Such as ``"maddpg Grassland-v0 low_gamma seed 1"``."""
        return f"{title(self.algo, self.env_id, self.setting)} seed {self.seed}"

    @property
    def place(self) -> Place:
        """``<sweep>/<setting>/seed_<seed>/<algo>/<env>_1``, and what lies beside it."""
        return Place(Path(self.args.log_folder), self.algo, self.env_id)


def title(algo: str, env_id: str, setting: str) -> str:
    """What runs that differ by their seeds alone are called."""
    return " ".join(filter(None, (algo, env_id, setting)))


def read_plan(file: str | Path, folder: str | Path, threads: int = 1) -> list[PlannedRun]:
    """
    The runs of a sweep, those of the first seed first, so that one cut short can be compared.

    :param file: YAML
    :param folder: of the sweep
    :param threads: of PyTorch, in each run
    :raises ValueError: one sentence about whatever is wrong with the file, or with any run
    """
    given = read_map(Path(file))
    try:
        return plan(given, Path(folder), threads)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def plan(given: Mapping[str, Any], folder: Path, threads: int) -> list[PlannedRun]:
    """
    :param given: content of the YAML file
    :param folder: see :func:`read_plan`
    :param threads: see :func:`read_plan`
    :raises ValueError: see :func:`read_plan`
    """
    sweep = checked("key of a sweep", given, KEYS)
    for key in NEEDED:
        if not sweep.get(key):
            raise ValueError(f"{key} is missing; a sweep needs {', '.join(NEEDED)}")
    seeds = list(range(sweep["seeds"])) if isinstance(sweep["seeds"], int) else sweep["seeds"]
    if not seeds or min(seeds) < 0:
        raise ValueError(f"seeds is {sweep['seeds']}; it must be a number of seeds, or a list of seeds from 0 on")
    settings = sweep.get("settings") or {"": {}}
    for name in settings:
        if name and not SETTING.fullmatch(name):
            raise ValueError(f'a setting is called "{name}"; give it a name of letters, digits and . + - _')
    common = words_of(sweep.get("train", {}))

    runs: dict[Place, PlannedRun] = {}
    cells = list(itertools.product(settings.items(), sweep["envs"], sweep["algos"]))
    resolved = []
    for (setting, own), env_id, algo in cells:
        try:
            resolved.append(resolve(algo, env_id, [*common, *pairs(own)], threads))
        except ValueError as error:
            raise ValueError(f"{title(algo, env_id, setting)}: {error}") from None
    for seed in seeds:
        for ((setting, _), _, _), (args, words, hyperparams) in zip(cells, resolved, strict=True):
            of_its_own = copy.copy(args)
            of_its_own.seed, of_its_own.log_folder = seed, str(folder / setting / f"seed_{seed}")
            words = (*words, "--seed", str(seed), "-f", of_its_own.log_folder)
            run = PlannedRun(setting, seed, of_its_own, words, hyperparams)
            if run.place in runs:
                raise ValueError(
                    f"{run.name} is there twice: name no algorithm, world or seed again, nor one that team decides"
                )
            runs[run.place] = run
    return list(runs.values())


def resolve(
    algo: str, env_id: str, flags: Sequence[str], threads: int
) -> tuple[argparse.Namespace, tuple[str, ...], Hyperparams]:
    """
    :param algo: name of the algorithm
    :param env_id: id of the world
    :param flags: further words of the command line
    :param threads: of PyTorch
    :return: the command line resolved, as words, and the settings
    :raises ValueError: for whatever ``zoo/train.py`` would refuse, as far as it can be told without building anything
    """
    words = ("--algo", algo, "--env", env_id, "--num-threads", str(threads), *flags)
    args = train.make_parser().parse_all(words)
    return args, words, train.resolve(args)


def words_of(flags: Mapping[str, Any]) -> list[str]:
    """
    Flags of ``zoo/train.py`` as words of its command line.

    :param flags: their names, with - or _, and their values: maps for those that take KEY:VALUE, lists for those that take
        several words, true for those that take none
    :raises ValueError: for an unknown flag, with the nearest one, and for one that is not the YAML file's to give
    """
    parser = train.make_parser()
    known = {
        option.removeprefix("--"): action
        for action in parser._actions
        for option in action.option_strings
        if option.startswith("--") and action.dest != "help"
    }
    words = []
    for given, value in flags.items():
        name = str(given).replace("_", "-")
        if name in OWN_FLAGS:
            raise ValueError(f"train: {given} is not for the file to give; use {OWN_FLAGS[name]}")
        if name not in known:
            raise ValueError(f"train: {unknown_name('flag of zoo/train.py', given, set(known) - set(OWN_FLAGS))}")
        if known[name].nargs == 0:
            words += [f"--{name}"] if value else []
        elif isinstance(value, dict):
            words += [f"--{name}", *pairs(value)[1:]] if value else []
        elif isinstance(value, list):
            words += [f"--{name}", *map(str, value)] if value else []
        elif value is not None:
            words.append(f"--{name}={value}")
    return words


def pairs(settings: Mapping[str, Any]) -> list[str]:
    """
    Hyperparameters as words of the command line.

    :param settings: name → value, as YAML holds it
    """
    if not settings:
        return []
    return ["-params", *(f"{name}:{in_one_line(value)}" for name, value in settings.items())]


def in_one_line(value: Any) -> str:
    """A value as YAML, in one line."""
    text = yaml.safe_dump(value, default_flow_style=True, width=float("inf"), allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def check_begun(run: PlannedRun, begun: Run) -> None:
    """
    Settings of a run stay what they were.

    :param run: as the sweep wants it
    :param begun: as it was begun
    :raises ValueError: names the first difference
    """
    wanted = yaml.safe_load(yaml.safe_dump(run.hyperparams.to_dict()))
    then = {**vars(train.make_parser().parse_all([])), **begun.args}
    flags = {name: value for name, value in vars(run.args).items() if name not in (*FREE, *IN_THE_SETTINGS)}
    for ours, theirs in ((wanted, begun.config), (flags, then)):
        for name in {**ours, **theirs} if ours is wanted else ours:
            if ours.get(name) != theirs.get(name):
                raise ValueError(
                    f"{begun.folder.path} was begun with {name} {in_one_line(theirs.get(name))}, and is now to have "
                    f"{in_one_line(ours.get(name))}; a run keeps its settings: give the sweep another folder with -f, or "
                    "these settings another name"
                )


def check_buildable(run: PlannedRun) -> None:
    """
    Build what a run would, as ``zoo/train.py`` does before it writes anything.

    :param run: the run
    :raises ValueError: one sentence that says what is wrong
    """
    args = copy.deepcopy(run.args)
    args.verbose, args.device = 0, "cpu"  # it may be trained on another machine
    try:
        training = train.build(args)
    except ValueError as error:
        raise ValueError(f"{title(run.algo, run.env_id, run.setting)}: {error}") from None
    for env in (training.model.get_env(), training.eval_env):
        if env is not None:
            env.close()
