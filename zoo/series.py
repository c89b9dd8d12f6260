"""What a run has logged over its training, as series."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

from sb3_kfcv.common.naming import unknown_name


@dataclass(frozen=True)
class Series:
    """
    One quantity over the training.

    :param steps: env steps, ascending, int64 (entries,)
    :param values: float64 (entries,)
    :param seconds: when each was logged, in seconds since 1970, float64 (entries,)
    """

    steps: np.ndarray
    values: np.ndarray
    seconds: np.ndarray


def tensorboard_series(folder: str | Path) -> dict[str, Series]:
    """
    Everything that a run has logged to TensorBoard; of a step that was logged twice (as after a resume) the last entry.

    :param folder: with the event files
    :return: tag, such as ``train/critic_loss`` → series; empty without event files
    """
    if not Path(folder).is_dir():
        return {}
    accumulator = EventAccumulator(str(folder), size_guidance={SCALARS: 0})
    accumulator.Reload()
    found = {}
    for tag in sorted(accumulator.Tags()["scalars"]):
        entries = {event.step: event for event in accumulator.Scalars(tag)}
        kept = [entries[step] for step in sorted(entries)]
        found[tag] = Series(
            np.array([event.step for event in kept], dtype=np.int64),
            np.array([event.value for event in kept], dtype=np.float64),
            np.array([event.wall_time for event in kept], dtype=np.float64),
        )
    return found


def evaluation_files(folder: str | Path) -> dict[str, Path]:
    """The files with the evaluations of a run, by their names: ``"eval"``, and those of yardsticks."""
    files = {path.stem.removeprefix("evaluations_"): path for path in sorted(Path(folder).glob("evaluations_*.npz"))}
    own = Path(folder) / "evaluations.npz"
    return {"eval": own, **files} if own.is_file() else files


def evaluations(folder: str | Path, name: str = "eval") -> dict[str, np.ndarray]:
    """
    All episodes of all evaluations of a run.

    :param folder: of the run
    :param name: ``"eval"``, or of a yardstick, such as ``"wolf_vs_graze"``
    :return: ``timesteps`` (evaluations,), and each metric (evaluations, episodes); SB3's names (``results``, ``ep_lengths``)
    :raises ValueError: if there are none, with the nearest name
    """
    files = evaluation_files(folder)
    if name not in files:
        raise ValueError(
            f"in {folder}: {unknown_name('evaluation', name, files)}" if files else f"{folder} has no evaluations"
        )
    try:
        with np.load(files[name], allow_pickle=False) as arrays:
            found = {key: arrays[key] for key in arrays.files}
    except (OSError, EOFError, ValueError, TypeError, RuntimeError, BadZipFile) as error:
        raise ValueError(f"{files[name]} cannot be read: {error}") from None
    steps = found.get("timesteps", np.empty(0))
    if steps.ndim != 1 or steps.dtype.kind not in "iu" or (np.diff(steps) <= 0).any():
        raise ValueError(f"{files[name]} is damaged: its timesteps are no ascending whole numbers")
    for key, values in found.items():
        if key != "timesteps" and (values.ndim != 2 or values.dtype.kind not in "iufb" or len(values) != len(steps)):
            raise ValueError(f"{files[name]} is damaged: its {key} are not the numbers of {len(steps)} evaluations")
    return found


@dataclass(frozen=True)
class Progress:
    """
    How far a training was at its start and at the end of each of its episodes.

    :param steps: env steps, ascending; those of episodes in hand are left out (1 + episodes,)
    :param seconds: of wall-clock time; evaluations count, pauses before a resume do not (1 + episodes,)
    """

    steps: np.ndarray
    seconds: np.ndarray

    def episodes_at(self, steps: np.ndarray) -> np.ndarray:
        """How many episodes had ended after so many env steps."""
        return np.searchsorted(self.steps, steps, side="right") - 1

    def seconds_at(self, steps: np.ndarray) -> np.ndarray:
        """The wall-clock time that so many env steps took."""
        return np.interp(steps, self.steps, self.seconds)


def progress(monitor_file: Path, n_steps_before: int = 0) -> Progress:
    """
    The progress of a run, by its episodes.

    :param monitor_file: of the run
    :param n_steps_before: env steps that its model had when the run began
    :raises ValueError: if there is no such file, or no episode in it
    """
    try:
        lines = monitor_file.read_text(encoding="utf-8").split("\n")[1:-1]  # without the line that is being written
        rows = list(csv.DictReader(lines))
        lengths = np.array([float(row["l"]) for row in rows])
        clock = np.array([float(row["t"]) for row in rows])
    except OSError as error:
        raise ValueError(f"cannot read {monitor_file}: {error.strerror}") from None
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"{monitor_file} is no monitor file of a training") from None
    if not rows:
        raise ValueError(f"{monitor_file} has no episode yet")
    passed = np.diff(clock, prepend=0.0)
    passed = np.where(passed < 0, clock, passed)  # worlds that cannot be resumed start their clock again
    return Progress(n_steps_before + np.cumsum([0, *lengths]), np.cumsum([0.0, *passed]))
