"""Faults while files are written: at every call of a save, on a disk that is full, and when the process dies at once."""

import errno
import io
import os
import pathlib
import resource
import shutil
import subprocess
import sys
import warnings
from contextlib import contextmanager, suppress

import numpy as np
import pytest
from references import assert_equal_trees, parameters_of
from stable_baselines3.common import monitor
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.compat.tensorflow_stub.io.gfile import LocalFileSystem
from test_resume import KillAt, Killed, assert_same_contents, episodes, resume, series
from test_zoo import command, run_folder
from toy_envs import ToyParallelEnv

from sb3_kfcv import MADDPG, JointEnv
from sb3_kfcv.common import callbacks, patient_logs
from sb3_kfcv.common.callbacks import MultiAgentEvalCallback
from sb3_kfcv.common.patient_logs import PatientResultsWriter, patience
from sb3_kfcv.maddpg import diagnostics
from sb3_kfcv.saving import files
from sb3_kfcv.saving.archive import open_archive
from sb3_kfcv.saving.checkpoints import Checkpoint, Checkpoints, checkpoints_in, latest_checkpoint
from zoo import train


def no_space():
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class Died(BaseException):
    """Stands for SIGKILL or a power cut: no clean-up is run."""


class Broken(Exception):
    """A fault that is no OSError."""


KINDS = {"full": no_space, "half": no_space, "broken": Broken, "death": Died}


class FaultyFile:
    """A file whose every call first asks the disk."""

    def __init__(self, file, disk):
        self.file, self.disk = file, disk

    def write(self, data):
        self.disk.ask(lambda: self.file.write(bytes(data)[: len(data) // 2]))
        return self.file.write(data)

    def seek(self, *args):
        self.disk.ask()
        return self.file.seek(*args)

    def flush(self):
        self.disk.ask()
        self.file.flush()

    def __getattr__(self, name):
        return getattr(self.file, name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.file.close()


class FaultyDisk:
    """
    Counts what ``atomic_write`` asks for (write, seek, flush, fsync, rename), and fails.

    :param at: the call that fails, from 1
    :param kind: "full": no space, nor for all that follows; "half": no space for the other half of the bytes, this once;
        "broken": another exception; "death": no clean-up is run
    """

    def __init__(self, at, kind):
        self.at, self.kind, self.calls = at, kind, 0

    @property
    def failed(self):
        return self.calls >= self.at

    def ask(self, half=lambda: None):
        self.calls += 1
        if self.calls == self.at or (self.kind == "full" and self.failed):
            if self.kind == "half":
                half()
            raise KINDS[self.kind]()


@contextmanager
def faulty(at, kind):
    """Whatever is saved inside meets a fault; those that are to be expected end here."""
    disk, fsync, replace = FaultyDisk(at, kind), os.fsync, os.replace
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files, "open", lambda *args: FaultyFile(open(*args), disk), raising=False)
        patch.setattr(os, "fsync", lambda descriptor: (disk.ask(), fsync(descriptor)))
        patch.setattr(os, "replace", lambda *args: (disk.ask(), replace(*args)))
        if kind == "death":
            unlink = pathlib.Path.unlink
            patch.setattr(pathlib.Path, "unlink", lambda *args, **kwargs: None if disk.failed else unlink(*args, **kwargs))
            patch.setattr(os, "getpid", lambda: -at)  # another process than the next
        disk.error = None
        try:
            yield disk
        except (OSError, Broken, Died) as error:
            disk.error = error


def partial_files(folder):
    return [path for path in folder.rglob("*") if path.name.endswith(".partial")]


def faults_of(save, thorough):
    """
    Pairs of a call of ``save`` and a kind of fault.

    :param thorough: each kind at every call; else one kind at every eighth and at the last ones, which sync and rename
    """
    with faulty(10**9, "full") as disk:
        save()
    for at in range(1, disk.calls + 1):
        if thorough or at % 8 == 1 or at > disk.calls - 6:
            for kind in KINDS if thorough else [list(KINDS)[(at // 8 + at) % len(KINDS)]]:
                yield at, kind
    with faulty(10**9, "full") as disk:
        save()
    assert disk.calls == at


def every_fault(folder, change, save, read, content, thorough, look_every=1):
    """
    One save after the other, each with its fault: after each the file is the one before or the new one, whole.

    :param change: makes what is to be saved another thing than before
    :param save: saves it
    :param read: what the files hold, as ``content`` would give it
    :param content: what is to be saved
    :param thorough: see :func:`faults_of`
    :param look_every: how often the files are loaded; otherwise their bytes are compared, if the fault left nothing new
    """
    for _ in range(12):  # until every kind of array is there
        change()
    save()
    previous, n_faults = content(), 0
    for at, kind in faults_of(save, thorough):
        before = bytes_of(folder)
        change()
        new = content()
        with faulty(at, kind) as disk:
            save()
        assert disk.failed
        n_faults += 1
        if kind != "death":
            assert not partial_files(folder), f"fault {at} ({kind}) left part of a file"
        if disk.error is None or n_faults % look_every == 0 or any(bytes_of(folder).get(p) != b for p, b in before.items()):
            found = read()
            whole = (new,) if disk.error is None else (previous,) if isinstance(disk.error, OSError) else (previous, new)
            assert found in whole, f"after fault {at} ({kind})"
            save()
            assert read() == new, f"the save after fault {at} ({kind})"
            previous = new
        for path in partial_files(folder):
            path.unlink()
    assert read() == content()
    print(f"{n_faults} faults in a save of {at} calls")


def bytes_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and not path.name.endswith(".partial")}


def tiny(**kwargs):
    settings = {"learning_starts": 3, "batch_size": 2, "buffer_size": 6, "policy_kwargs": {"net_arch": [2]}, "seed": 0}
    settings["stats_window_size"] = 2
    env = DummyVecEnv([lambda: JointEnv(ToyParallelEnv(agents=("tank_0",), time_limit=4))])
    return MADDPG("MlpPolicy", env, device="cpu", **{**settings, **kwargs})


def learn_one_step(model, callback=None):
    model.learn(1, callback, log_interval=None, reset_num_timesteps=False)


def content_of(model):
    return model.num_timesteps, {name: value.tolist() for name, value in parameters_of(model).items()}


def transitions_of(buffer):
    return {name: array.tolist() for name, array in buffer.transitions().items()}


THOROUGH = pytest.mark.parametrize(
    "thorough", [False, pytest.param(True, marks=pytest.mark.expensive)], ids=["an eighth", "all"]
)


@THOROUGH
def test_a_model_outlives_a_fault_at_any_call_of_its_save(tmp_path, thorough):
    model = tiny()
    every_fault(
        tmp_path,
        change=lambda: learn_one_step(model),
        save=lambda: model.save(tmp_path / "model"),
        read=lambda: content_of(MADDPG.load(tmp_path / "model")),
        content=lambda: content_of(model),
        thorough=thorough,
        look_every=10,
    )


@THOROUGH
def test_a_replay_buffer_outlives_a_fault_at_any_call_of_its_save(tmp_path, thorough):
    model, other = tiny(), tiny()

    def read():
        other.load_replay_buffer(tmp_path / "buffer")
        return transitions_of(other.replay_buffer)

    every_fault(
        tmp_path,
        change=lambda: learn_one_step(model),
        save=lambda: model.save_replay_buffer(tmp_path / "buffer"),
        read=read,
        content=lambda: transitions_of(model.replay_buffer),
        thorough=thorough,
        look_every=10,
    )


@THOROUGH
def test_a_checkpoint_outlives_a_fault_at_any_call_of_its_save(tmp_path, thorough, monkeypatch):
    """Transitions and checkpoint are two files; old ones are removed only when the new ones are there."""
    monkeypatch.setattr(diagnostics, "WINDOW", 2)
    model, saver = tiny(), Checkpoints(tmp_path, save_freq=-1, keep=2)

    def content():
        parameters = {name: value.tolist() for name, value in model.policy.state_dict().items()}
        return model.num_timesteps, parameters, transitions_of(model.replay_buffer)

    def read():
        found = latest_checkpoint(tmp_path)
        parameters = {name: value.tolist() for name, value in found.parameters["policy"].items()}
        return found.steps, parameters, {name: array.tolist() for name, array in found.transitions.items()}

    with warnings.catch_warnings():
        warnings.simplefilter("error")  # no checkpoint is set aside as damaged
        warnings.filterwarnings("ignore", message="the state of ToyParallelEnv cannot be read")
        every_fault(tmp_path, lambda: learn_one_step(model, saver), saver.save, read, content, thorough)
    assert len(checkpoints_in(tmp_path)) == 2
    assert not list(tmp_path.rglob("*.damaged"))


@THOROUGH
def test_evaluations_and_the_best_model_outlive_a_fault_at_any_call(tmp_path, monkeypatch, thorough):
    """A full disk or half a write is a warning; the next evaluation writes all that is missing."""
    model = tiny()
    model.set_logger(configure(None, []))
    rewards = iter(range(100_000))
    monkeypatch.setattr(callbacks, "evaluate", lambda *_: {"reward": np.array([next(rewards)]), "length": np.array([4])})
    evaluation = MultiAgentEvalCallback(model.env, log_path=tmp_path, best_model_save_path=tmp_path, verbose=0)
    evaluation.init_callback(model)

    def change():
        learn_one_step(model)
        evaluation.num_timesteps = model.num_timesteps
        del evaluation.timesteps[:-3], evaluation.evaluations[:-3]  # a file of one size

    def written():
        evaluations = np.load(tmp_path / "evaluations.npz")["timesteps"].tolist()
        return evaluations, MADDPG.load(tmp_path / "best_model").num_timesteps

    for _ in range(12):
        change()
        evaluation.evaluate()
    n_faults = 0
    for at, kind in faults_of(evaluation.evaluate, thorough):
        steps, best = written()
        change()
        with warnings.catch_warnings(record=True) as caught, faulty(at, kind) as disk:
            warnings.simplefilter("always")
            evaluation.evaluate()
        assert disk.failed
        n_faults += 1
        found_steps, found_best = written()
        assert found_steps in (steps, evaluation.timesteps)
        assert found_best in (best, model.num_timesteps)
        if kind in ("full", "half"):
            assert disk.error is None
            told = [str(warning.message) for warning in caught]
            assert all("could not be written, the training goes on" in sentence for sentence in told)
            assert len(told) == (found_steps == steps) + (found_best == best)
        if kind != "death":
            assert not partial_files(tmp_path)
        for path in partial_files(tmp_path):
            path.unlink()
    assert written() == (evaluation.timesteps, model.num_timesteps)
    print(f"{n_faults} faults in an evaluation of {at} calls")


# ---- a disk that is full for a while


class SmallDisk:
    """A file system of a few megabytes, filled and emptied at will."""

    def __init__(self, path):
        self.path = path

    def fill(self):
        with open(self.path / "filler", "wb", buffering=0) as file, suppress(OSError):
            while True:
                file.write(bytes(4096))

    def empty(self):
        (self.path / "filler").unlink()


class PretendedDisk:
    """The same by files that refuse to be written: those of ``atomic_write``, of the monitor and of TensorBoard."""

    def __init__(self, path, patch):
        self.path, self.full = path, False
        patch.setattr(files, "open", lambda *args: FaultyFile(open(*args), self), raising=False)
        patch.setattr(monitor, "open", lambda *args, **kwargs: FullFile(open(*args, **kwargs), self), raising=False)
        write, obstacle = LocalFileSystem._write, patient_logs.obstacle
        patch.setattr(LocalFileSystem, "_write", lambda *args: (self.ask(), write(*args)))
        patch.setattr(patient_logs, "obstacle", lambda folder: no_space().strerror if self.full else obstacle(folder))

    def ask(self, half=None):
        if self.full:
            raise no_space()

    def fill(self):
        self.full = True

    def empty(self):
        self.full = False


class FullFile(FaultyFile):
    """A text file: what is written waits in its buffer until it is flushed."""

    def write(self, text):
        return self.file.write(text)

    def seek(self, *args):
        return self.file.seek(*args)


@pytest.fixture(params=["mounted", "pretended"])
def disk(request, tmp_path, monkeypatch):
    path = tmp_path / "disk"
    path.mkdir()
    if request.param == "pretended":
        yield PretendedDisk(path, monkeypatch)
        return
    try:
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(path)], capture_output=True, text=True)
    except OSError as error:
        pytest.skip(f"there is no mount here: {error}")
    if done.returncode:
        pytest.skip(f"a file system cannot be mounted here: {done.stderr.strip()}")
    try:
        yield SmallDisk(path)
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)


class FullFromTo(BaseCallback):
    """Fills the disk at one step and empties it at another."""

    def __init__(self, disk, first, last=None, look=lambda: None):
        super().__init__()
        self.disk, self.first, self.last, self.look = disk, first, last, look

    def _on_step(self):
        if self.num_timesteps == self.first:
            self.disk.fill()
        if self.num_timesteps == self.last:
            self.look()
            self.disk.empty()
        return True


SHORT = ["n_wolves:2", "n_sheep:2", "n_grass:1", "max_steps:2", "--save-freq", "20", "--keep-checkpoints", "-1"]


def run(folder, *callbacks, steps=400):
    """Episodes of two steps, so that the monitor's file fills more than one page."""
    words = command(folder, "Grassland-v0", "maddpg", *SHORT, params=["policy_kwargs.net_arch:[4]"], steps=steps)
    return train.main(words, callbacks)


def assert_same_runs(one, other):
    """All but the log entries of the time in which the disk of the other one was full."""
    assert_same_contents(one.last_model, other.last_model)
    ours, theirs = (Checkpoint(checkpoints_in(run.path)[400]) for run in (one, other))
    assert_equal_trees(ours.parameters, theirs.parameters)
    assert_equal_trees(ours.replay_buffer, theirs.replay_buffer)
    assert_equal_trees(ours.transitions, theirs.transitions)
    assert episodes(one.monitor_file) == episodes(other.monitor_file)
    np.testing.assert_equal(dict(np.load(one.path / "evaluations.npz")), dict(np.load(other.path / "evaluations.npz")))
    ours, theirs = series(one.path), series(other.path)
    assert ours.keys() == theirs.keys()
    for tag, entries in ours.items():
        assert [entry for entry in entries if not 100 <= entry[0] <= 300] == [
            e for e in theirs[tag] if not 100 <= e[0] <= 300
        ], tag


def test_a_run_outlives_a_full_disk(tmp_path, disk):
    """It goes on, tells what it could not write, and lacks nothing in the end but log entries and checkpoints of that time."""
    assert run(tmp_path) == 0
    whole = run_folder(tmp_path)
    folder = run_folder(disk.path)
    found = []

    def look():
        with open_archive(folder.path / "best_model.zip", "model") as best:
            found.append((latest_checkpoint(folder.path).steps, best.read("attributes")["num_timesteps"]))
        assert not partial_files(folder.path)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert run(disk.path, FullFromTo(disk, 100, 300, look)) == 0
    assert found[0][0] == 80 and found[0][1] <= 60
    told = [str(warning.message) for warning in caught if warning.category is UserWarning]
    for steps in range(100, 300, 20):
        assert [sentence for sentence in told if sentence.startswith(f"the checkpoint after {steps} env steps could not be")]
    for what in ("evaluations.npz", "a log entry"):
        assert [sentence for sentence in told if sentence.startswith(f"{what} could not be written, the training goes on")]
    assert len([sentence for sentence in told if "0.monitor.csv could not be written" in sentence]) == 1
    assert [sentence for sentence in told if "No space left on device" not in sentence] == []
    assert list(checkpoints_in(folder.path)) == [400, 380, 360, 340, 320, 300, 80, 60, 40, 20]
    assert_same_runs(whole, folder)


def test_a_run_whose_disk_was_full_is_resumed_exactly(tmp_path, disk):
    assert run(tmp_path) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(Killed):
            run(disk.path, FullFromTo(disk, 100, 300), KillAt(350))
        assert resume(run_folder(disk.path)) == 0
    assert_same_runs(run_folder(tmp_path), run_folder(disk.path))


def test_a_run_whose_disk_is_full_at_the_end_says_so(tmp_path, disk, capsys):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert run(disk.path, FullFromTo(disk, 100), steps=140) not in (0, 2, 3)
    printed = capsys.readouterr()
    assert "could not be written" in printed.err and printed.err.count("\n") == 1
    assert "the last checkpoint is of 80 env steps" in printed.out


def test_the_best_model_is_the_best_of_those_that_could_be_saved(tmp_path, monkeypatch):
    """The best of all came when the disk was full; a lesser one replaces an older, lesser still."""
    model, disk = tiny(), PretendedDisk(tmp_path, monkeypatch)
    model.set_logger(configure(None, []))
    rewards = iter([1, 9, 5, 3])
    monkeypatch.setattr(callbacks, "evaluate", lambda *_: {"reward": np.array([next(rewards)]), "length": np.array([4])})
    evaluation = MultiAgentEvalCallback(model.env, best_model_save_path=tmp_path, verbose=0)
    evaluation.init_callback(model)
    saved = []
    for full in (False, True, False, False):
        learn_one_step(model)
        disk.full = full
        with warnings.catch_warnings(record=True):
            evaluation.evaluate()
        saved.append(MADDPG.load(tmp_path / "best_model").num_timesteps)
    assert saved == [1, 1, 3, 3]
    assert evaluation.best_mean_reward == 5


@pytest.mark.filterwarnings("ignore:the state of ToyParallelEnv")
def test_a_checkpoint_that_cannot_be_removed_costs_no_training(tmp_path, monkeypatch):
    unlink = pathlib.Path.unlink

    def stuck(path, missing_ok=False):
        if path.name == "rl_model_10_steps.zip":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        unlink(path, missing_ok)

    monkeypatch.setattr(pathlib.Path, "unlink", stuck)
    with pytest.warns(UserWarning, match=r"rl_model_10_steps\.zip"):
        tiny().learn(50, Checkpoints(tmp_path, 10, keep=2), log_interval=None)
    assert {40, 50} <= set(checkpoints_in(tmp_path))
    assert Checkpoint(checkpoints_in(tmp_path)[10]).steps == 10


@pytest.mark.filterwarnings("ignore:the state of ToyParallelEnv")
def test_a_checkpoint_that_does_not_fit_into_memory_costs_no_training(tmp_path, monkeypatch):
    """The transitions are copied before they are written."""
    model = tiny()
    transitions = model.replay_buffer.transitions

    def too_large(first=0):
        if model.num_timesteps == 20:
            raise MemoryError
        return transitions(first)

    monkeypatch.setattr(model.replay_buffer, "transitions", too_large)
    with pytest.warns(UserWarning, match=r"the checkpoint after 20 env steps could not be written, .* goes on: MemoryError"):
        model.learn(40, Checkpoints(tmp_path, 10, keep=-1), log_interval=None)
    assert list(checkpoints_in(tmp_path)) == [40, 30, 10]
    assert latest_checkpoint(tmp_path).steps == 40


# ---- the logs


@contextmanager
def room_for(path, n_bytes):
    """The system itself ends every file so many bytes after the end that this one has now."""
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + n_bytes, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))


def rows_of(path):
    return [row["l"] for row in episodes(path)]


def test_rows_of_the_monitor_wait_for_room(tmp_path):
    """The first of them is cut in the middle; more follow than a file's buffer takes."""
    path = tmp_path / "0.monitor.csv"
    writer = PatientResultsWriter(str(path), {"t_start": 0.0})
    writer.write_row({"r": 0.5, "l": 0, "t": 0.0})
    for first in (1, 2001):
        with room_for(path, 5), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            for row in range(first, first + 1999):
                writer.write_row({"r": 0.5, "l": row, "t": 0.0})
        assert len(caught) == 1 and "0.monitor.csv could not be written, the training goes on" in str(caught[0].message)
        assert rows_of(path)[:-1] == [str(row) for row in range(first)]  # the last one is in pieces
        writer.write_row({"r": 0.5, "l": first + 1999, "t": 0.0})
        assert rows_of(path) == [str(row) for row in range(first + 2000)]


def test_rows_that_wait_do_not_fill_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(patient_logs, "MOST_WAITING", 10)
    path = tmp_path / "0.monitor.csv"
    writer = PatientResultsWriter(str(path))
    with room_for(path, 0), warnings.catch_warnings(record=True):
        for row in range(100):
            writer.write_row({"r": 0.5, "l": row, "t": 0.0})
    writer.write_row({"r": 0.5, "l": 100, "t": 0.0})
    assert rows_of(path) == [str(row) for row in (0, *range(91, 101))]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_tensorboard_goes_on_after_a_failure_that_could_not_be_foreseen(tmp_path, monkeypatch, capsys):
    """Its writer dies with half an entry on the disk; the entries after it are in a new file."""
    logger = configure(str(tmp_path), ["stdout", "tensorboard"])
    write, at = LocalFileSystem._write, iter(range(100))

    def break_once(system, name, content, mode):
        if next(at) == 3:
            write(system, name, content[: len(content) // 2], mode)
            raise no_space()
        write(system, name, content, mode)

    monkeypatch.setattr(LocalFileSystem, "_write", break_once)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for step in range(10):
            logger.record("rollout/one", float(step))
            logger.record_mean("rollout/two", float(step))
            with patience(logger):
                logger.dump(step)
    told = [str(warning.message) for warning in caught if warning.category is UserWarning]
    assert told == [f"a log entry could not be written, the training goes on: {no_space()}"]
    assert len(list(tmp_path.glob("events.out.tfevents.*"))) == 2
    seen = series(tmp_path)
    assert seen["rollout/two"] in (
        [(step, float(step)) for step in steps] for steps in ([0, *range(2, 10)], [0, *range(3, 10)])
    )
    assert capsys.readouterr().out.count("rollout/") == 10


def test_one_log_without_room_leaves_the_others_alone(tmp_path, monkeypatch, capsys):
    logger = configure(str(tmp_path), ["stdout", "tensorboard"])
    capsys.readouterr()
    for step in range(6):
        monkeypatch.setattr(patient_logs, "obstacle", lambda _, step=step: "no room" if step in (2, 3) else None)
        logger.record("rollout/one", float(step))
        with warnings.catch_warnings(record=True) as caught, patience(logger):
            logger.dump(step)
        assert len(caught) == (step in (2, 3))
    assert series(tmp_path)["rollout/one"] == [(step, float(step)) for step in (0, 1, 4, 5)]
    assert capsys.readouterr().out.count("one") == 6


def test_a_screen_that_is_gone_costs_no_training(monkeypatch, tmp_path):
    """Output goes into a file on the full disk, or its reader has ended."""

    class Gone(io.StringIO):
        def flush(self):
            raise no_space()

    with monkeypatch.context() as patch, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        patch.setattr(sys, "stdout", Gone())
        model = tiny(verbose=0)
        model.set_logger(configure(None, ["stdout"]))
        evaluation = MultiAgentEvalCallback(tiny().env, eval_freq=5, n_eval_episodes=1)
        model.learn(40, evaluation, log_interval=1)
    assert model.num_timesteps == 40
    assert any("a log entry could not be written" in str(warning.message) for warning in caught)


@pytest.mark.filterwarnings("ignore")
def test_a_log_on_another_disk_that_is_full_costs_no_checkpoint(tmp_path, monkeypatch):
    model, disk = tiny(), PretendedDisk(tmp_path / "logs", monkeypatch)
    model.set_logger(configure(str(disk.path), ["csv"]))
    (output,) = model.logger.output_formats
    output.file = FullFile(output.file, disk)
    disk.full = True
    monkeypatch.undo()
    model.learn(40, Checkpoints(tmp_path, 10, keep=-1), log_interval=1)
    assert list(checkpoints_in(tmp_path)) == [40, 30, 20, 10]


def test_a_log_folder_that_is_gone_costs_no_training(tmp_path):
    logger = configure(str(tmp_path / "logs"), ["tensorboard"])
    shutil.rmtree(tmp_path / "logs")
    logger.record("rollout/one", 1.0)
    with (
        pytest.warns(UserWarning, match=r"a log entry could not be written.*logs: No such file or directory"),
        patience(logger),
    ):
        logger.dump(1)
