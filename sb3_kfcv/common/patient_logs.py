"""Logs that outlive a full disk: the training goes on, and so do they when there is room again."""

from __future__ import annotations

import tempfile
import warnings
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.monitor import ResultsWriter

# Rows that wait for room at most: the disk must not fill the memory.
MOST_WAITING = 10_000

# Bytes that a log entry takes at most, histograms included.
ENTRY = 1 << 16


class PatientResultsWriter(ResultsWriter):
    """
    SB3's writer of a monitor file, for a disk that is full for a while: a warning, and the rows wait, the latest
    ``MOST_WAITING`` of them, to be written when there is room again. The parameters are SB3's.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._waiting: deque[dict[str, Any]] = deque(maxlen=MOST_WAITING)
        self._stuck = False

    def write_row(self, epinfo: dict[str, Any]) -> None:
        self._waiting.append(epinfo)
        try:
            self.file_handler.flush()  # the row at which it got stuck is still in the file's own buffer
            while self._waiting:
                self.logger.writerow(self._waiting.popleft())
                self.file_handler.flush()
            self._stuck = False
        except OSError as error:
            if not self._stuck:
                name = self.file_handler.name
                warnings.warn(f"{name} could not be written, the training goes on, and the rows wait: {error}")
            self._stuck = True


@contextmanager
def patience(logger: Logger) -> Iterator[None]:
    """
    Around the writing of a log entry. Where it cannot be written (the disk is full), it is lost: a warning says so, and the
    training goes on. TensorBoard's writer never recovers from a failure, so it is spared those that can be foreseen, and gets
    a fresh file after any other.

    :param logger: that writes
    """
    outputs = logger.output_formats
    boards = [output for output in outputs if isinstance(output, TensorBoardOutputFormat)]
    stuck = {board: reason for board in boards if (reason := obstacle(board.writer.log_dir))}
    for reason in stuck.values():
        _warn(reason)
    logger.output_formats = [output for output in outputs if output not in stuck]
    try:
        yield
    except OSError as error:
        _warn(error)
        for pending in (logger.name_to_value, logger.name_to_count, logger.name_to_excluded):
            pending.clear()
        for board in boards:
            try:
                board.writer.flush()
            except OSError:
                board.writer.file_writer = board.writer.all_writers = None  # as after close(), which would fail
    finally:
        logger.output_formats = outputs


def obstacle(folder: str) -> str | None:
    """Why a log entry cannot be written into a folder now; ``None`` if it can."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(ENTRY))
        return None
    except OSError as error:
        return f"{folder}: {error.strerror}"


def _warn(reason: object) -> None:
    warnings.warn(f"a log entry could not be written, the training goes on: {reason}", stacklevel=4)
