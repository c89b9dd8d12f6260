"""A run that was killed and resumed equals the run that was never stopped: every array, every counter, every log entry."""

import csv
import json
import zipfile

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_zoo import command, run_folder

from sb3_kfcv import ALGOS
from sb3_kfcv.saving.checkpoints import Checkpoint, checkpoints_in
from zoo import train

WALL_CLOCK = ("time/fps", "time/time_elapsed", "time/update_seconds", "time/refresh_seconds")


class Killed(Exception):
    """Stands for SIGKILL: nothing after it is run."""


class KillAt(BaseCallback):
    def __init__(self, steps):
        super().__init__()
        self.steps = steps

    def _on_step(self):
        if self.num_timesteps >= self.steps:
            raise Killed
        return True


CLOCK = ("t", "elapsed", "update_seconds", "refresh_seconds", "boards", "files", "sha256")  # and lengths of logs


def without_clock(value):
    """Plain JSON without what the wall clock says."""
    if isinstance(value, dict):
        return {key: without_clock(item) for key, item in value.items() if key not in CLOCK}
    return [without_clock(item) for item in value] if isinstance(value, list) else value


def contents(path):
    """Every member of a file, as JSON or bytes."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist() if name != "manifest.json"}
    clock = [name for name in members if name.endswith("/episode_times.npy")]
    read = {name: without_clock(json.loads(data)) if name.endswith(".json") else data for name, data in members.items()}
    return {name: value for name, value in read.items() if name not in clock}


def assert_same_contents(one, other):
    ours, theirs = contents(one), contents(other)
    assert ours.keys() == theirs.keys()
    assert [name for name, value in ours.items() if value != theirs[name]] == []


def series(path):
    """Every scalar entry of all event files; sorted, since files of one process and second need not sort by age."""
    events = EventAccumulator(str(path), size_guidance={"scalars": 0}, purge_orphaned_data=False)
    events.Reload()
    tags = [tag for tag in events.Tags()["scalars"] if tag not in WALL_CLOCK]
    return {tag: sorted((event.step, event.value) for event in events.Scalars(tag)) for tag in tags}


def episodes(path):
    header, *rows = path.read_text().splitlines()
    assert header.startswith("#")
    return [{key: value for key, value in row.items() if key != "t"} for row in csv.DictReader(rows)]


def assert_equal_runs(one, other):
    """Models, latest checkpoints, evaluations, monitor files and TensorBoard series."""
    for name in (f"{one.env_id}.zip", "best_model.zip"):
        assert_same_contents(one.path / name, other.path / name)
    ours, theirs = checkpoints_in(one.path), checkpoints_in(other.path)
    assert list(ours) == list(theirs)
    for steps in ours:
        assert_same_contents(ours[steps], theirs[steps])
    a, b = (Checkpoint(next(iter(found.values()))).transitions for found in (ours, theirs))
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
    assert episodes(one.monitor_file) == episodes(other.monitor_file)
    np.testing.assert_equal(dict(np.load(one.path / "evaluations.npz")), dict(np.load(other.path / "evaluations.npz")))
    ours, theirs = series(one.path), series(other.path)
    assert ours.keys() == theirs.keys()
    for tag in ours:
        np.testing.assert_equal(ours[tag], theirs[tag], err_msg=tag)


def run(folder, algo, *more, env="Grassland-v0", params=(), steps=240, callbacks=(), save_freq=40):
    words = command(folder, env, algo, "--save-freq", str(save_freq), *more, params=params, steps=steps)
    return train.main(words, callbacks)


def resume(folder, callbacks=()):
    return train.main(["--resume", str(folder.path), "--verbose", "0"], callbacks)


@pytest.mark.parametrize("algo", ALGOS)
@pytest.mark.parametrize("env", ["Grassland-v0", "HardSpread-v0"])
def test_killed_and_resumed_equals_never_stopped(tmp_path, algo, env):
    assert run(tmp_path / "whole", algo, env=env, callbacks=[KillAt(10**9)]) == 0
    whole = run_folder(tmp_path / "whole", env, algo)
    for kills in (30, 62, 150, 170, 234):
        if kills == 30:
            with pytest.raises(Killed):
                run(tmp_path / "killed", algo, env=env, callbacks=[KillAt(30)])
            killed = run_folder(tmp_path / "killed", env, algo)
        else:
            with pytest.raises(Killed):
                resume(killed, [KillAt(kills)])
    assert resume(killed, [KillAt(10**9)]) == 0
    assert_equal_runs(whole, killed)
