"""
One run of a sweep, as a process of its own: ``python zoo/sweep_run.py FLAGS_OF_TRAIN``. What lies in its folder tells whether
it begins, goes on, or is done; so it can be started again after anything. It ends when its standard input does.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from stable_baselines3.common.callbacks import BaseCallback

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from zoo import train
from zoo.command_line import REFUSALS, refused, start
from zoo.run_folder import file_name
from zoo.runs import Run
from zoo.workers import end_with_parent

NOTE_EVERY = 2.0  # seconds between notes of the progress
NOTES = 15  # over so many of them the speed is measured
PATIENCE = 120.0  # seconds until a process that was told to end has saved its checkpoint


@dataclass(frozen=True)
class Place:
    """
    Where a run of a sweep lies: the only one of its algorithm and world in a log folder. Beside it::

        <env>.log             what it printed, all its starts one behind the other
        <env>.progress.json   how far it is
        .<env>.lock           held by the process that trains

    :param log_folder: as the flag ``-f`` of ``zoo/train.py`` has it
    :param algo: name of the algorithm
    :param env_id: id of the world
    """

    log_folder: Path
    algo: str
    env_id: str

    def _beside(self, name: str) -> Path:
        return self.log_folder / self.algo / name.format(file_name(self.env_id))

    @property
    def log(self) -> Path:
        return self._beside("{}.log")

    @property
    def progress(self) -> Path:
        return self._beside("{}.progress.json")

    @property
    def lock(self) -> Path:
        return self._beside(".{}.lock")

    def run(self) -> Run | None:
        """The run, if it was begun."""
        name = file_name(self.env_id)
        found = sorted(self._beside("").glob(f"{name}_*/{name}/args.yml"))
        return Run.at(found[0].parent.parent) if found else None


class Progress(BaseCallback):
    """
    Notes how far the training is, for whoever watches.

    :param path: of the file
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._notes: deque[tuple[float, int]] = deque(maxlen=NOTES)

    def get_state(self) -> dict[str, Any]:
        """Nothing: it is of this process."""
        return {}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Inverse of :meth:`get_state`."""

    def _on_training_start(self) -> None:
        self._note()

    def _on_step(self) -> bool:
        if time.monotonic() >= self._notes[-1][0] + NOTE_EVERY:
            self._note()
        return True

    def _on_training_end(self) -> None:
        self._note()

    def _note(self) -> None:
        steps = self.model.num_timesteps
        self._notes.append((time.monotonic(), steps))
        (then, steps_then), (now, _) = self._notes[0], self._notes[-1]
        speed = (steps - steps_then) / (now - then) if now > then else None
        note(self.path, steps=steps, of=self.model._total_timesteps, speed=speed)


def note(path: Path, **values: Any) -> None:
    """
    Write down how far a run is. Not synced to the disk, and no harm is done if it cannot be written.

    :param path: of the file
    :param values: ``steps``, ``of`` all env steps, and the ``speed`` in env steps per second
    """
    with suppress(OSError):
        path.write_text(json.dumps({**values, "host": platform.node(), "pid": os.getpid()}))


def main(argv: Sequence[str] | None = None, extra_callbacks: Sequence[BaseCallback] = ()) -> int:
    """
    Begin the run, or go on with it.

    :param argv: flags of ``zoo/train.py``, for a log folder that holds no other run of this algorithm and world
    :param extra_callbacks: see :func:`zoo.train.main`
    :return: its exit status; 0, too, if the run has ended
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        args = train.make_parser().parse_all(words)
        train.resolve(args)  # teams decide on the algorithm
        place = Place(Path(args.log_folder), args.algo, args.env)
        place.lock.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(place.lock, timeout=PATIENCE):
            note(place.progress)
            callbacks = [Progress(place.progress), *extra_callbacks]
            run = place.run()
            if run is None:
                return train.main(words, callbacks)
            if run.has_ended:
                return 0
            going_on = ["--resume", str(run.folder.path), "--verbose", str(args.verbose)]
            return train.main(going_on, callbacks)
    except Timeout:
        return refused(ValueError(f"another process is training in {place.log_folder / place.algo}"))
    except REFUSALS as error:
        return refused(error)


if __name__ == "__main__":
    end_with_parent()
    start(main, "stopped before the training began")
