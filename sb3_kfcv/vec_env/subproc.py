"""SB3's worlds in other processes, with the traceback of one that fails."""

from __future__ import annotations

import json
import signal
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial, wraps
from inspect import ismethod
from multiprocessing import set_forkserver_preload
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from sb3_kfcv.common.checks import NonFiniteError

# What writing and reading raise when the process at the other end is gone.
LOST = (EOFError, ConnectionError)

# Errors that stay what they are, so that whoever handles them need not know where the worlds run.
KEPT = {error.__name__: error for error in (ValueError, NonFiniteError, gym.error.DependencyNotInstalled)}

PATIENCE = 5.0  # seconds that a failed process gets to end


class WorkerError(RuntimeError):
    """A world failed in its process; the message holds its traceback."""


class TracedSubprocVecEnv(SubprocVecEnv):
    """
    SB3's ``SubprocVecEnv`` where a world that fails is heard of: its traceback is raised here, as :class:`WorkerError`, in
    place of a bare ``EOFError``. A ``ValueError`` (settings that the world refuses), a missing package and a number that is
    not finite stay what they are, with the traceback as their cause. All processes end then. Ctrl-C is left to the process
    that trains.

    :param env_fns: make the worlds, each in its process
    :param start_method: ``"forkserver"`` or ``"spawn"``, by default the first where there is one; a program that starts
        processes so needs ``if __name__ == "__main__":``
    :raises ValueError: for ``"fork"``: processes would hold each other's pipes open, and a dead one would be waited for
    """

    def __init__(self, env_fns: list[Callable[[], gym.Env]], start_method: str | None = None) -> None:
        if start_method == "fork":
            raise ValueError('start_method is "fork", with which a dead process is waited for; give "forkserver" or "spawn"')
        # Processes forked off a server that has imported this start in milliseconds; it ignores this if it runs already.
        set_forkserver_preload(["__main__", __name__])
        self._folder = tempfile.TemporaryDirectory(prefix="sb3_kfcv_")
        self._reports = [Path(self._folder.name) / f"{i}.json" for i in range(len(env_fns))]
        makers: list[Callable[[], gym.Env]] = [
            partial(_make, make, report) for make, report in zip(env_fns, self._reports, strict=True)
        ]
        try:
            super().__init__(makers, start_method)
        except LOST:
            self._fail()
        self.remotes = tuple(_Remote(remote, partial(self._fail, i)) for i, remote in enumerate(self.remotes))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        self._require(attr_name)
        return super().get_attr(attr_name, indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        self._require(method_name)
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def close(self) -> None:
        with suppress(WorkerError, *KEPT.values()):  # what has failed is closed
            super().close()
        self._folder.cleanup()

    def _require(self, name: str) -> None:
        """As in one process, a missing attribute is an ``AttributeError`` and no end of the world."""
        if not self.has_attr(name):
            raise AttributeError(f"the worlds have no attribute {name!r}")

    def _fail(self, failed: int | None = None) -> NoReturn:
        """
        End all processes, and raise what the failed one has reported.

        :param failed: which; by default the first that has ended
        """
        sentinels = [process.sentinel for process in self.processes]
        ended = wait(sentinels if failed is None else [sentinels[failed]], PATIENCE)
        if failed is None:
            failed = min((sentinels.index(sentinel) for sentinel in ended), default=0)  # type: ignore[arg-type]
        status = self.processes[failed].exitcode
        for process in self.processes:
            process.terminate()
            process.join(PATIENCE)
        self.closed = True
        report = self._reports[failed]
        told = json.loads(report.read_text()) if report.exists() else None
        self._folder.cleanup()
        if told is None:
            raise WorkerError(f"the process of world {failed} has ended ({_in_words(status)})") from None
        error = WorkerError(f"world {failed} failed in its process:\n{told['traceback']}")
        if told["error"] in KEPT:
            raise KEPT[told["error"]](told["message"]) from error
        raise error from None


class _Remote:
    """
    The connection to a world.

    :param connection: to its process
    :param fail: raises what happened to the process
    """

    def __init__(self, connection: Connection, fail: Callable[[], NoReturn]) -> None:
        self._connection = connection
        self._fail = fail

    def send(self, message: Any) -> None:
        try:
            self._connection.send(message)
        except LOST:
            self._fail()

    def recv(self) -> Any:
        try:
            return self._connection.recv()
        except LOST:
            self._fail()

    def close(self) -> None:
        self._connection.close()


class _Reporting(gym.Wrapper):
    """
    A world whose errors are written to a file, with which its process ends.

    :param env: the world
    :param report: path of the file
    """

    def __init__(self, env: gym.Env, report: Path) -> None:
        super().__init__(env)
        self._report = report

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        with _reported(self._report):
            return self.env.reset(**kwargs)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        with _reported(self._report):
            return self.env.step(action)

    def render(self) -> Any:
        with _reported(self._report):
            return self.env.render()

    def get_wrapper_attr(self, name: str) -> Any:
        value = super().get_wrapper_attr(name)
        if not ismethod(value):
            return value

        @wraps(value)
        def method(*args: Any, **kwargs: Any) -> Any:
            with _reported(self._report):
                return value(*args, **kwargs)

        return method


def _make(make_env: Callable[[], gym.Env], report: Path) -> gym.Env:
    """What the process of a world begins with."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends it to all processes; the training decides
    np.random.seed()  # processes forked off one server would begin with the same global generator
    with _reported(report):
        return _Reporting(make_env(), report)


@contextmanager
def _reported(report: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        told = {"error": type(error).__name__, "message": str(error), "traceback": traceback.format_exc()}
        report.write_text(json.dumps(told))
        raise SystemExit(1) from None


def _in_words(status: int | None) -> str:
    """The exit status of a process that has left no report."""
    if status is None:
        return "it closed its pipe"
    if status < 0:
        return f"by {signal.Signals(-status).name}; out of memory, perhaps"
    return f'exit status {status}; programs that start processes need if __name__ == "__main__":'
