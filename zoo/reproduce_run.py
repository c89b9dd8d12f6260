"""
One run of the reproduction, as a process of its own: ``python zoo/reproduce_run.py ORDER.json``. It trains as a run of a sweep
does, plays the test on the way, and leaves a record; so it can be started again after anything.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from stable_baselines3.common.callbacks import BaseCallback

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.matches import Arena
from sb3_kfcv.saving.archive import library_versions
from sb3_kfcv.saving.checkpoints import checkpoints_in
from sb3_kfcv.saving.files import atomic_write
from zoo import sweep_run, train
from zoo.command_line import BAD_INPUT, REFUSALS, refused, start
from zoo.match_results import plain
from zoo.playing import Normalized
from zoo.reproduce_plan import CURRICULUM, OF_THE_CURRICULUM, LineUp
from zoo.reproduce_records import IN_A_RUN, measured_file, read_measured, record_in_the_run, require_same, tested
from zoo.run_groups import METRIC_NAMES
from zoo.runs import Run
from zoo.series import Progress, evaluation_files, evaluations, progress, tensorboard_series
from zoo.sweep_run import Place
from zoo.workers import end_with_parent, n_cores
from zoo.worlds import World

TEST_AT = 0.95
"""Of the training: the paper tests after 1.9 of 2 · 10⁵ episodes."""
TEST_SEED = 50_000_000
"""Of the first episode, far above the seeds of trainings and evaluations."""
TEST_ENVS = 256
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
N_RETURNS = 500
"""So many returns of the test are kept for a scatter diagram."""
DIGITS = 5
MONITOR_HEAD = 2
"""Lines of a log of all episodes before the first one."""


class Measure(BaseCallback):
    """
    Plays the test when ``TEST_AT`` of the training is over, and counts what the training takes. A run that goes on keeps both;
    what was lost by a kill does not count.

    :param world: where the test is
    :param line_ups: name of a test → who plays a group in place of the model
    :param n_episodes: of each test
    :param path: of the JSON file that is written at the end
    """

    model: Any

    def __init__(self, world: World, line_ups: Mapping[str, LineUp], n_episodes: int, path: Path) -> None:
        super().__init__()
        self.of = tested({"tests": line_ups, "test_episodes": n_episodes})
        self.world, self.line_ups, self.n_episodes, self.path = world, line_ups, n_episodes, path
        self.test: dict[str, Any] | None = None
        self._before = {"wall": 0.0, "processor": 0.0, "memory": 0}  # what earlier processes took
        self._start()

    def get_state(self) -> dict[str, Any]:
        """The test, if it was played, and what was taken so far."""
        return {"of": self.of, "test": self.test, "taken": self.taken()}

    def set_state(self, saved: dict[str, Any]) -> None:
        """
        Inverse of :meth:`get_state`.

        :raises ValueError: if another test was played
        """
        if saved["test"] is not None:
            require_same("this run", self.of, saved.get("of", {}), "its folder")
        self.test, self._before = saved["test"], saved["taken"]
        self._start()

    def taken(self) -> dict[str, float]:
        """Seconds of wall-clock and of processor time, and the most memory in bytes."""
        return {
            "wall": self._before["wall"] + time.monotonic() - self._began,
            "processor": self._before["processor"] + time.process_time() - self._began_processor,
            "memory": max(self._before["memory"], peak_memory()),
        }

    def _start(self) -> None:
        self._began, self._began_processor = time.monotonic(), time.process_time()

    def _on_training_start(self) -> None:
        self._start()

    def _on_step(self) -> bool:
        if self.test is None and self.num_timesteps >= TEST_AT * self.model._total_timesteps:
            player = as_trained(self.model)
            groups = {name: {**dict.fromkeys(_groups_of(self.model), player), **own} for name, own in self.line_ups.items()}
            self.test = {"after": self.num_timesteps, **played(self.world, groups, self.n_episodes)}
        return True

    def _on_training_end(self) -> None:
        with atomic_write(self.path) as file:
            file.write(json.dumps(self.get_state()).encode())


def as_trained(model: Any) -> Any:
    """A model as one that plays in worlds whose observations are as they are."""
    statistics = model.get_vec_normalize_env()
    return model if statistics is None else Normalized(model.policy, statistics)


def _groups_of(model: Any) -> Sequence[str]:
    return next(iter(model.learners.values())).policy.layout.group_names


def peak_memory() -> int:
    """The most bytes of memory that this process has had; where the system does not tell, those that it has now."""
    with suppress(OSError, StopIteration), open("/proc/self/status") as file:
        return 1024 * int(next(line for line in file if line.startswith("VmHWM:")).split()[1])
    return psutil.Process().memory_info().rss


def played(world: World, line_ups: Mapping[str, Mapping[str, Any]], n_episodes: int) -> dict[str, Any]:
    """
    Tests, all on the same episodes.

    :param world: where
    :param line_ups: name → who plays every group
    :param n_episodes: of each
    :return: of each test every metric's mean and standard error, and of the returns their quantiles and some of their values
    """
    arena = Arena(world.make(min(TEST_ENVS, n_episodes)))
    tests = {}
    for name, players in line_ups.items():
        values = arena.play(players, n_episodes, TEST_SEED).quantities()
        returns = [f"return_{group}" for group in arena.layout.group_names]
        tests[name] = {
            "mean": {metric: rounded(own.mean()) for metric, own in values.items()},
            "standard_error": {metric: rounded(own.std(ddof=1) / np.sqrt(len(own))) for metric, own in values.items()},
            "quantiles": {metric: [rounded(value) for value in np.quantile(values[metric], QUANTILES)] for metric in returns},
            "returns": {metric: [rounded(value) for value in values[metric][:N_RETURNS]] for metric in returns[:1]},
        }
    arena.env.close()
    return {"seeds": [TEST_SEED, TEST_SEED + n_episodes - 1], "quantiles": QUANTILES, "tests": tests}


def rounded(value: float) -> float:
    """A number with as many digits as records keep."""
    return float(f"{value:.{DIGITS}g}")


def curves_of(run: Run) -> dict[str, dict[str, list[float]]]:
    """
    Every evaluation of a run, by its name: env steps, episodes and seconds at each, and the mean of every metric over its
    episodes. Of a curriculum, while it lasts, the means since the evaluation before.
    """
    course = course_of(run)
    found = {}
    for name in evaluation_files(run.folder.path):
        arrays = evaluations(run.folder.path, name)
        steps = arrays.pop("timesteps")
        found[name] = curve(course, steps, {METRIC_NAMES.get(key, key): own.mean(axis=1) for key, own in arrays.items()})
        if name == "eval":
            during, values = curriculum_of(run, steps)
            if len(during) and values:
                found[CURRICULUM] = curve(course, during, values)
    return found


def curve(course: Progress, steps: np.ndarray, values: Mapping[str, np.ndarray]) -> dict[str, list[float]]:
    """
    Values over a training.

    :param course: of the training
    :param steps: env steps (times,)
    :param values: name → value at each (times,)
    """
    return {
        "steps": steps.tolist(),
        "episodes": course.episodes_at(steps).tolist(),
        "seconds": [rounded(value) for value in course.seconds_at(steps)],
        **{name: [rounded(value) for value in own] for name, own in values.items()},
    }


def curriculum_of(run: Run, at: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """
    What a run has logged of its curriculum while that lasted.

    :param run: the run
    :param at: env steps (times,)
    :return: those of these times since the last of which something was logged, and name → the mean of what was
    """
    logged = tensorboard_series(run.tensorboard_folder)
    if "curriculum/unscored" not in logged:
        return at[:0], {}
    during = logged["curriculum/unscored"].steps  # while transitions have scores, and draws go by them
    named = {name: logged.get(f"curriculum/{name}") for name in OF_THE_CURRICULUM}
    series = {name: own for name, own in named.items() if own is not None and np.isin(own.steps, during).any()}
    together = reduce(np.intersect1d, [during, *(own.steps for own in series.values())])
    until = np.searchsorted(at, together)
    times = np.unique(until[until < len(at)])
    means = {}
    for name, own in series.items():
        values = own.values[np.isin(own.steps, together)]
        means[name] = np.array([values[until == time].mean() for time in times])
    return at[times], means


def course_of(run: Run) -> Progress:
    """How far a run was at the end of each episode; of one that was too short for any, only its start."""
    with run.folder.monitor_file.open(encoding="utf-8") as file:
        n_lines = sum(1 for _ in file)
    return progress(run.folder.monitor_file) if n_lines > MONITOR_HEAD else Progress(np.zeros(1), np.zeros(1))


def processor_name() -> str:
    """Of this machine."""
    with suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def facts() -> dict[str, Any]:
    """When and on what a record was made."""
    machine = {"processor": processor_name(), "cores": n_cores()}
    return {"date": time.strftime("%Y-%m-%d"), "machine": machine, "versions": library_versions()}


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record, in one piece, as compact JSON."""
    with atomic_write(path) as file:
        file.write(json.dumps(plain(record), allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode() + b"\n")


def tidy_up(run: Run) -> None:
    """Remove what is large of a run that keeps its record: checkpoints, replay buffers, players, the log of all episodes."""
    folder = run.folder
    for path in [*checkpoints_in(folder.path).values(), folder.replay_buffer, folder.monitor_file]:
        path.unlink(missing_ok=True)
    for path in (folder.path / "transitions", folder.players):
        shutil.rmtree(path, ignore_errors=True)


def write_copy(run: Run, place: Place, order: Mapping[str, Any]) -> Path:
    """
    Write the record of a run that has ended into its folder.

    :param run: the run
    :param place: of it
    :param order: what was to be done
    :return: the file
    :raises ValueError: if what it is made of is gone, or of another test
    """
    found = read_measured(place, order["identity"])
    command = shlex.join(["python", "zoo/train.py", *order["words"]])
    about = {"identity": order["identity"], "command": command, **facts(), "taken": found["taken"]}
    copy = run.folder.path / IN_A_RUN
    write_record(copy, {**about, "test": found["test"], "curve": curves_of(run)})
    return copy


def main(argv: Sequence[str] | None = None) -> int:
    """
    Train, test, and leave the record; it comes at the very end, so that a run that has it is done with.

    :param argv: the file of the order, see :meth:`~zoo.reproduce_plan.PlannedRecord.begin`
    :return: exit status of the training; 0, too, if there is a record
    """
    (file,) = sys.argv[1:] if argv is None else argv
    try:
        order = json.loads(Path(file).read_text(encoding="utf-8"))
        path, identity = Path(order["record"]), order["identity"]
        if path.is_file():
            return 0
        args = train.make_parser().parse_all(order["words"])
        hyperparams = train.resolve(args)
        place = Place(Path(args.log_folder), args.algo, args.env)
        copy = record_in_the_run(place, identity)
        if copy is None:
            world = World(args.env, hyperparams.env_kwargs, hyperparams.env_wrapper)
            measure = Measure(world, identity["tests"], identity["test_episodes"], measured_file(place))
            status = sweep_run.main(order["words"], [measure])
            if status:
                return status
        run = place.run()
        if run is None:
            return BAD_INPUT
        copy = copy or write_copy(run, place, order)
        if not order["keep_runs"]:
            tidy_up(run)
        with atomic_write(path) as target:
            target.write(copy.read_bytes())
    except REFUSALS as error:
        return refused(error)
    except OSError as error:
        return refused(OSError(f"the record cannot be written: {error}"))
    print(f"the record is {os.path.relpath(path)}")
    return 0


if __name__ == "__main__":
    end_with_parent()
    start(main, "stopped before the training began")
