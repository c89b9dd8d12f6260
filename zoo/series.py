"""What a run has logged over its training, as series."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

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


def evaluations(folder: str | Path, name: str = "eval") -> dict[str, np.ndarray]:
    """
    All episodes of all evaluations of a run.

    :param folder: of the run
    :param name: ``"eval"``, or of a yardstick, such as ``"wolf_vs_graze"``
    :return: ``timesteps`` (evaluations,), and each metric (evaluations, episodes); SB3's names (``results``, ``ep_lengths``)
    :raises ValueError: if there are none, with the nearest name
    """
    files = {path.stem.removeprefix("evaluations_"): path for path in Path(folder).glob("evaluations_*.npz")}
    if (own := Path(folder) / "evaluations.npz").is_file():
        files["eval"] = own
    if name not in files:
        raise ValueError(
            f"in {folder}: {unknown_name('evaluation', name, files)}" if files else f"{folder} has no evaluations"
        )
    with np.load(files[name], allow_pickle=False) as arrays:
        return {key: arrays[key] for key in arrays.files}
