"""
Who carries out programs: processes of this machine, or the machines of a Ray cluster. Each program is a process of its own, so
a crash costs no other one, and none outlives whoever started it.
"""

from __future__ import annotations

import logging
import os
import platform
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LOOK = 0.1  # seconds between two looks at the processes
LIVES = 4  # a process that is killed is started again, so often in all
PATIENCE = 30.0  # seconds until a file that was just written is seen by all machines
CONNECT = 10.0  # seconds until a cluster that does not answer is taken for absent
OBJECT_STORE = 100 << 20  # bytes of Ray's memory for shared objects, of which there are none here

NO_RAY = 'clusters need Ray: pip install "sb3-kfcv[cluster]"'


@dataclass(frozen=True)
class Task:
    """
    A Python program to be run. It calls :func:`end_with_parent`, and goes on by itself when it is started again.

    :param name: of the task, unique
    :param words: file of the program, and its command line
    :param log: file that takes what it prints, behind what is there
    :param folder: working directory
    :param needs: files that must be seen where it runs
    """

    name: str
    words: tuple[str, ...]
    log: str
    folder: str
    needs: tuple[str, ...] = ()


def end_with_parent() -> None:
    """
    Have this process sent SIGTERM when the one that started it by :class:`Attempt` is gone, or wants it to stop: then the
    standard input ends.
    """

    def watch() -> None:
        while os.read(0, 1):
            pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def was_killed(status: int) -> bool:
    """Whether an exit status tells of a signal, rather than of what the program wanted to say."""
    return status < 0 or status > 128


class Attempt:
    """
    A task that is carried out on this machine. If its process is killed, it is started again, a few times.

    :param task: the task
    :param threads: of each of its numerical libraries
    """

    def __init__(self, task: Task, threads: int) -> None:
        self.task, self.threads = task, threads
        self._stopped = False
        self._lives = LIVES
        self._start()

    def _start(self) -> None:
        self._lives -= 1
        Path(self.task.log).parent.mkdir(parents=True, exist_ok=True)
        with open(self.task.log, "ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, *self.task.words],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=self.task.folder,
                env={**os.environ, "OMP_NUM_THREADS": str(self.threads), "PYTHONUNBUFFERED": "1"},
                start_new_session=True,  # Ctrl-C is for whoever started it
            )

    def poll(self) -> int | None:
        """Exit status; ``None`` while it is carried out."""
        status = self._process.poll()
        if status is not None and was_killed(status) and self._lives and not self._stopped:
            self._start()
            return None
        return status

    def stop(self) -> None:
        """Ask the program to end; it is given the time to save what it has."""
        self._stopped = True
        if self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()

    def wait(self) -> int:
        """Exit status, when it has ended."""
        return self._process.wait()


class Workers(ABC):
    """
    Carry out tasks, some at a time, in the order in which they come.

    :param n_workers: how many at a time; ``None`` leaves it to the workers
    :param threads: processor cores that each task takes
    """

    def __init__(self, n_workers: int | None, threads: int) -> None:
        self.n_workers, self.threads = n_workers, threads
        self._waiting: deque[Task] = deque()
        self._running: dict[Any, Task] = {}

    def submit(self, task: Task) -> None:
        """Take on a task."""
        self._waiting.append(task)

    @property
    def idle(self) -> bool:
        """Whether all is done."""
        return not self._waiting and not self._running

    def ended(self, seconds: float) -> list[tuple[Task, int]]:
        """
        The tasks that have ended since the last call, each with its exit status; negative is the number of a signal.

        :param seconds: how long to wait for one
        :raises ValueError: if a machine cannot do its part
        """
        while self._waiting and (self.n_workers is None or len(self._running) < self.n_workers):
            task = self._waiting.popleft()
            self._running[self._start(task)] = task
        return [(self._running.pop(key), status) for key, status in self._ended(seconds)]

    def stop(self) -> None:
        """Give up what waits, and have what runs save itself and end."""
        self._waiting.clear()
        self._stop()
        self._running.clear()

    @abstractmethod
    def _start(self, task: Task) -> Any:
        """Have it begun; returns what it is known by."""

    @abstractmethod
    def _ended(self, seconds: float) -> list[tuple[Any, int]]:
        """What has ended, and its exit status."""

    @abstractmethod
    def _stop(self) -> None:
        """Stop what runs, and wait for it."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the workers."""


class LocalWorkers(Workers):
    """Processes of this machine."""

    def _start(self, task: Task) -> Attempt:
        return Attempt(task, self.threads)

    def _ended(self, seconds: float) -> list[tuple[Attempt, int]]:
        until = time.monotonic() + seconds
        while True:
            ended = [(attempt, status) for attempt in self._running if (status := attempt.poll()) is not None]
            if ended or time.monotonic() >= until:
                return ended
            time.sleep(LOOK)

    def _stop(self) -> None:
        for attempt in self._running:
            attempt.stop()
        for attempt in self._running:
            attempt.wait()

    def close(self) -> None:
        """Nothing is held."""


class RayWorkers(Workers):
    """
    The machines of a Ray cluster. A task whose worker or machine is lost is carried out anew, on another one.

    :param address: of a cluster, such as ``"10.0.0.1:6379"`` or ``"auto"``; ``None`` starts Ray on this machine alone
    :param n_workers: see :class:`Workers`
    :param threads: see :class:`Workers`
    :raises ValueError: if Ray is missing, or there is no such cluster
    """

    def __init__(self, address: str | None, n_workers: int | None, threads: int) -> None:
        super().__init__(n_workers, threads)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        if address and has_token():  # which Ray itself presents to a cluster that it has found, not to one that is named
            os.environ.setdefault("RAY_AUTH_MODE", "token")
        try:
            import ray
        except ImportError:
            raise ValueError(NO_RAY) from None
        alone: dict[str, Any] = {
            "num_cpus": (n_workers or 1) * threads,
            "object_store_memory": OBJECT_STORE,
            "include_dashboard": False,
        }
        try:
            named = known_address() if address == "auto" else address
            if named and ":" in named:
                socket.create_connection(host_and_port(named), timeout=CONNECT).close()  # Ray itself would try for minutes
            ray.init(address or "local", log_to_driver=False, logging_level=logging.ERROR, **({} if address else alone))
        except (OSError, RuntimeError, ValueError, ray.exceptions.AuthenticationError) as error:
            where = address or "this machine"
            why = " ".join(str(error).split())
            raise ValueError(f"no Ray cluster answers at {where}, or it wants another token: {why}") from None
        ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # the machines need not find this package for it
        self._ray = ray
        self._carry_out = ray.remote(num_cpus=threads, max_retries=-1)(carry_out)
        if not any(node["Resources"].get("CPU", 0) >= threads for node in ray.nodes() if node["Alive"]):
            print(f"note: no machine of the cluster has {threads} cores for a task yet; they wait for one", file=sys.stderr)

    def _start(self, task: Task) -> Any:
        return self._carry_out.remote(task, self.threads)

    def _ended(self, seconds: float) -> list[tuple[Any, int]]:
        refs = [*self._running]
        if not refs:
            return []
        ready, _ = self._ray.wait(refs, num_returns=1, timeout=seconds)
        return [(ref, self._status(ref)) for ref in ready]

    def _status(self, ref: Any) -> int:
        try:
            status = self._ray.get(ref)
        except self._ray.exceptions.RayError as error:
            raise ValueError(f"Ray could not carry out {self._running[ref].name}: {' '.join(str(error).split())}") from None
        if isinstance(status, str):
            raise ValueError(status)
        return status

    def _stop(self) -> None:
        for ref in self._running:
            self._ray.cancel(ref)
        for ref in self._running:
            with suppress(self._ray.exceptions.RayError):
                self._ray.get(ref)

    def close(self) -> None:
        self._ray.shutdown()


def host_and_port(address: str) -> tuple[str, int]:
    """
    :param address: such as ``"10.0.0.1:6379"``
    :raises ValueError: if it is none
    """
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not port.isdecimal():
        raise ValueError("an address is HOST:PORT, or auto")
    return host, int(port)


def has_token() -> bool:
    """Whether the user has a token that Ray's clusters may ask for (https://docs.ray.io/en/latest/ray-security/token-auth.html)."""
    own_file = Path(os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")
    return bool(os.environ.get("RAY_AUTH_TOKEN")) or own_file.is_file()


def known_address() -> str | None:
    """The address that ``auto`` means: of the environment, else of the cluster that was begun on this machine, if any."""
    if os.environ.get("RAY_ADDRESS"):
        return os.environ["RAY_ADDRESS"]
    noted = Path(os.environ.get("RAY_TMPDIR") or tempfile.gettempdir(), "ray", "ray_current_cluster")
    return noted.read_text().strip() if noted.is_file() else None


def carry_out(task: Task, threads: int) -> int | str:
    """
    A task of Ray: runs where Ray wants it.

    :param task: the task
    :param threads: see :class:`Attempt`
    :return: exit status, or what is wrong with this machine
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # Ray cancels by it; what a script begins may ignore it
    for path in (*task.needs, task.folder, task.words[0]):
        if not appears(Path(path)):
            return (
                f"{platform.node()} does not see {path}: all machines must find the sweep's folder, the working directory "
                "and the package under the same paths, such as on a shared disk"
            )
    attempt = Attempt(task, threads)
    try:
        while (status := attempt.poll()) is None:
            time.sleep(LOOK)
        return status
    finally:  # Ray cancels by a KeyboardInterrupt
        attempt.stop()
        attempt.wait()


def appears(path: Path) -> bool:
    """Whether a file is there, perhaps after a while, as on a network's disk."""
    until = time.monotonic() + PATIENCE
    while not path.exists():
        if time.monotonic() >= until:
            return False
        time.sleep(LOOK)
    return True


def make_workers(address: str | None, n_workers: int | None, threads: int, local: bool = False) -> Workers:
    """
    Ray, where it is installed and wanted, else processes of this machine.

    :param address: of a Ray cluster, if it is to be one
    :param n_workers: tasks at a time; by default as many as there are cores for
    :param threads: processor cores of each task
    :param local: without Ray
    :raises ValueError: if the cluster cannot be reached
    """
    if address is None:
        n_workers = n_workers or max(1, n_cores() // threads)
    if local:
        return LocalWorkers(n_workers, threads)
    try:
        return RayWorkers(address, n_workers, threads)
    except ValueError as error:
        if address is not None or str(error) != NO_RAY:
            raise
        print(f"note: {NO_RAY}; the tasks run as processes of this machine", file=sys.stderr)
        return LocalWorkers(n_workers, threads)


def n_cores() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
