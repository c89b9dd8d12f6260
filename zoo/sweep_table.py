"""How far a sweep is: a table that is kept up to date on a terminal, and lines where something changes elsewhere."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import timedelta
from typing import Any

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from zoo.series import evaluations
from zoo.sweep_plan import PlannedRun

WAITING, RUNNING, DONE, FAILED, STOPPED = "waiting", "running", "done", "failed", "stopped"

# From above: what one wants to see where not all runs fit on the screen.
ORDER = (FAILED, RUNNING, STOPPED, WAITING, DONE)
STYLES = {FAILED: "bold red", RUNNING: "bold", DONE: "green", STOPPED: "yellow", WAITING: "dim"}

READ_EVERY = 2.0  # seconds


class Watched:
    """
    A run of the sweep, and how far it is, read from its folder.

    :param run: the run
    """

    def __init__(self, run: PlannedRun) -> None:
        self.run = run
        self.begun = run.place.run()
        self.state = DONE if self.begun is not None and self.begun.has_ended else WAITING
        self.steps = 0
        self.of = run.hyperparams.n_timesteps
        self.speed: float | None = None
        self.evaluation: float | None = None  # mean reward of the last one
        self.evaluations = 0
        self._evaluated = 0  # when the file was last written
        self._before = self._note()
        if self.begun is not None:
            self._read_note(self._before)
            self._read_evaluation()
        if self.state == DONE:
            self.steps = self.of

    @property
    def seconds_left(self) -> float | None:
        """By its present speed."""
        return (self.of - self.steps) / self.speed if self.speed and self.state == RUNNING else None

    def read(self) -> None:
        """Look into the folder. It runs from its first note on: workers of a cluster begin when they can."""
        text = self._note()
        if text in ("", self._before):
            return
        if self.state == WAITING:
            self.state = RUNNING
        self._read_note(text)
        self._read_evaluation()

    def _note(self) -> str:
        try:
            return self.run.place.progress.read_text()
        except OSError:
            return ""

    def _read_note(self, text: str) -> None:
        try:
            note: dict[str, Any] = json.loads(text)
        except ValueError:  # it is just being written
            return
        self.steps, self.of, self.speed = note.get("steps", self.steps), note.get("of", self.of), note.get("speed")

    def _read_evaluation(self) -> None:
        self.begun = self.begun or self.run.place.run()
        if self.begun is None:
            return
        folder = self.begun.folder.path
        with suppress(OSError):  # there is none yet
            written = (folder / "evaluations.npz").stat().st_mtime_ns
            if written != self._evaluated:
                results = evaluations(folder)["results"]
                self._evaluated, self.evaluations, self.evaluation = written, len(results), float(np.mean(results[-1]))

    def line(self) -> str:
        """In words."""
        words = [f"{self.run.name}: {self.state}"]
        if self.steps:
            words.append(f"{self.steps:,} of {self.of:,} env steps")
        if self.speed and self.state == RUNNING:
            words += [f"{self.speed:,.0f} per second", f"{duration(self.seconds_left)} left"]
        if self.evaluation is not None:
            words.append(f"evaluation {self.evaluation:.2f}")
        return ", ".join(words)

    def cells(self) -> tuple[str, ...]:
        """A row of the table."""
        run = self.run
        return (
            *(run.setting, run.algo, run.env_id, str(run.seed), self.state),
            f"{self.steps:,} / {self.of:,}" if self.begun is not None or self.state != WAITING else "",
            f"{self.speed:,.0f}" if self.speed and self.state == RUNNING else "",
            duration(self.seconds_left),
            "" if self.evaluation is None else f"{self.evaluation:.2f}",
        )


def duration(seconds: float | None) -> str:
    """Such as ``"0:05:12"``."""
    return "" if seconds is None else str(timedelta(seconds=round(seconds)))


class ProgressTable:
    """
    Shows how far all runs are, between ``with`` and its end.

    :param runs: of the sweep
    :param console: where; by default the standard output
    """

    COLUMNS = ("setting", "algorithm", "world", "seed", "state", "env steps", "per second", "time left", "evaluation")
    NUMBERS = ("seed", "env steps", "per second", "time left", "evaluation")

    def __init__(self, runs: Sequence[PlannedRun], console: Console | None = None) -> None:
        self.runs = {run.name: Watched(run) for run in runs}
        self.console = console or Console()
        self._live = Live(console=self.console, auto_refresh=False) if self.console.is_terminal else None
        self._told: dict[str, tuple[str, int]] = {name: (run.state, run.evaluations) for name, run in self.runs.items()}
        self._read = 0.0

    def __enter__(self) -> ProgressTable:
        if self._live:
            self._live.start()
        self.refresh()
        return self

    def __exit__(self, *_: object) -> None:
        self.refresh(now=True)
        if self._live:
            self._live.stop()

    def ended(self, name: str, state: str) -> None:
        """
        Tell that a run has ended.

        :param name: of the run
        :param state: ``DONE``, ``FAILED`` or ``STOPPED``
        """
        self.runs[name].read()
        self.runs[name].state = state
        self.refresh(now=True)

    def refresh(self, now: bool = False) -> None:
        """
        Read how far the runs are, at most every few seconds, and show it.

        :param now: also if that was just done
        """
        if not now and time.monotonic() < self._read + READ_EVERY:
            return
        self._read = time.monotonic()
        for run in self.runs.values():
            if run.state in (WAITING, RUNNING):
                run.read()
        if self._live:
            self._live.update(self.render(), refresh=True)
            return
        for name, run in self.runs.items():
            news = (run.state, run.evaluations)
            if news != self._told[name]:
                self._told[name] = news
                self.console.print(run.line(), highlight=False, soft_wrap=True)

    def summary(self) -> str:
        """All runs in a line."""
        counts = Counter(run.state for run in self.runs.values())
        parts = [f"{len(self.runs)} runs", *(f"{counts[state]} {state}" for state in (*reversed(ORDER),) if counts[state])]
        running = [run for run in self.runs.values() if run.state == RUNNING and run.speed]
        left = sum(run.of - run.steps for run in self.runs.values() if run.state in (RUNNING, WAITING))
        if running and left:
            parts.append(f"about {duration(left / sum(run.speed or 0 for run in running))} left")
        return ", ".join(parts)

    def render(self) -> Group:
        """The table, as much of it as fits on the screen."""
        columns = [name for name in self.COLUMNS if name != "setting" or any(run.run.setting for run in self.runs.values())]
        table = Table(box=None, pad_edge=False)
        for name in columns:
            table.add_column(name, justify="right" if name in self.NUMBERS else "left", no_wrap=True)
        rows = sorted(self.runs.values(), key=lambda run: ORDER.index(run.state))
        fitting = max(1, self.console.height - 4)
        for run in rows[:fitting]:
            table.add_row(*run.cells()[len(self.COLUMNS) - len(columns) :], style=STYLES[run.state])
        more = [Text(f"and {len(rows) - fitting} more")] if len(rows) > fitting else []
        return Group(table, *more, Text(self.summary()))
