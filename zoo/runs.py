"""Which runs there are: found by their folders, by patterns, or as the latest of an algorithm in a world."""

from __future__ import annotations

import glob
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from sb3_kfcv.common.naming import unknown_name
from zoo.hyperparams import Hyperparams, check
from zoo.run_folder import RunFolder, file_name, read_map

# How deep below a folder runs may lie: <experiment>/<scale>/<setting>/<seed>/<algo>/<env>_<k>/<env> of a reproduction.
DEPTH = 7


@dataclass(frozen=True)
class Run:
    """
    A training run, as it was begun.

    :param folder: where it lies
    """

    folder: RunFolder

    @classmethod
    def at(cls, path: str | Path) -> Run:
        """
        The run in a folder.

        :raises ValueError: if there is none
        """
        return cls(RunFolder.existing(path))

    @cached_property
    def args(self) -> dict[str, Any]:
        """The command line, resolved."""
        return read_map(self.folder.arguments_file)

    @cached_property
    def config(self) -> dict[str, Any]:
        """The settings, resolved, as :attr:`RunFolder.config_file` holds them."""
        return read_map(self.folder.config_file)

    @property
    def hyperparams(self) -> Hyperparams:
        """
        The settings, checked.

        :raises ValueError: if they are none of this version
        """
        return check(self.algo, self.env_id, self.config)

    @property
    def algo(self) -> str:
        return self.args["algo"]

    @property
    def env_id(self) -> str:
        return self.folder.env_id

    @property
    def seed(self) -> int:
        return self.args["seed"]

    @property
    def tensorboard_folder(self) -> Path:
        """Where its event files are; it holds none if they were turned off."""
        elsewhere = self.args.get("tensorboard_log")
        if not elsewhere:
            return self.folder.path
        return Path(elsewhere) / file_name(self.env_id) / f"{self.algo}_{self.folder.number}"

    @property
    def has_ended(self) -> bool:
        """Whether it came to its end."""
        return self.folder.last_model.is_file()

    @property
    def begun(self) -> float:
        """When, in seconds since 1970."""
        return self.folder.arguments_file.stat().st_mtime


def runs_below(path: str | Path) -> list[Run]:
    """
    The runs in a folder: the folder itself if it is one, else all that lie in it, such as in a log folder or in a sweep, in
    the natural order of their paths. Hidden folders hold what is not finished, and are left out. Damaged runs among many are
    left out, too, which a note tells.

    :raises ValueError: if the folder itself is a damaged run
    """
    path = Path(path)
    own = _run_in(path)
    if own:
        return own
    patterns = ("*/" * depth + "args.yml" for depth in range(2, DEPTH + 1))
    found = {(path / file).parent.parent for pattern in patterns for file in glob.glob(pattern, root_dir=path)}
    return [run for folder in sorted(found, key=lambda folder: natural(str(folder))) for run in _or_note(_run_in, folder)]


def _run_in(path: Path) -> list[Run]:
    """
    The run that a folder is, if it is one.

    :raises ValueError: if it is damaged
    """
    folder = RunFolder.at(path)
    if folder is None:
        return []
    run = Run(folder)
    _ = run.config  # is read here, so that a damaged one is refused or left out before anything is done with it
    return [run]


def _or_note(find: Callable[[Path], list[Run]], path: Path) -> list[Run]:
    """What is found in a folder that nobody named by itself: nothing if it is damaged, and a note."""
    try:
        return find(path)
    except ValueError as error:
        print(f"note: {path} is left out: {error}", file=sys.stderr)
        return []


def find_runs(words: Iterable[str]) -> list[Run]:
    """
    The runs that words of a command line mean, each once.

    :param words: run folders, folders over them, and patterns of either
    :raises ValueError: for a word that means none, and for a damaged run that is named by itself
    """
    runs: dict[Path, Run] = {}
    for word in words:
        if glob.has_magic(word):
            found = [run for path in sorted(glob.glob(word), key=natural) for run in _or_note(runs_below, Path(path))]
        else:
            found = runs_below(word)
        if not found:
            raise ValueError(f"there is no run of zoo/train.py in {word}")
        runs.update((run.folder.path.resolve(), run) for run in found)
    return list(runs.values())


def pick_run(
    log_folder: str | Path,
    algo: str | None = None,
    env_id: str | None = None,
    exp_id: int = 0,
    to_play: bool = False,
) -> Run:
    """
    A run of a log folder.

    :param log_folder: where runs lie
    :param algo: only of this algorithm
    :param env_id: only in this world
    :param exp_id: its number (the k of ``<env>_<k>``); 0 takes the one that was begun last
    :param to_play: take the last one that has a model or a checkpoint, if any has; a note tells if a later one has none
    :raises ValueError: if there is none, with what there is
    """
    runs = runs_below(log_folder)
    if not runs:
        raise ValueError(f"there is no run in {log_folder}; train one with zoo/train.py, or say with -f where runs lie")
    _require("algorithm", algo, [run.algo for run in runs])
    _require("environment", env_id, [run.env_id for run in runs])
    fitting = [run for run in runs if algo in (None, run.algo) and env_id in (None, run.env_id)]
    numbered = [run for run in fitting if exp_id in (0, run.folder.number)]
    if not numbered:
        raise ValueError(
            f"no run in {log_folder} fits; there are {', '.join(str(run.folder.path) for run in fitting or runs)}"
        )
    latest = max(numbered, key=lambda run: run.begun)
    if to_play and not latest.folder.can_play:
        able = [run for run in numbered if run.folder.can_play]
        if able:
            chosen = max(able, key=lambda run: run.begun)
            print(f"note: {latest.folder.path} has nothing to play yet; {chosen.folder.path} plays", file=sys.stderr)
            return chosen
    return latest


def natural(text: str) -> list[tuple[int, str]]:
    """A key by which ``model_9`` comes before ``model_10``."""
    parts: Sequence[str] = re.split(r"(\d+)", text)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _require(kind: str, name: str | None, known: Sequence[str]) -> None:
    if name is not None and name not in known:
        raise ValueError(f"there is no run of it: {unknown_name(f'{kind} of the runs', name, set(known))}")
