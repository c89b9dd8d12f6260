"""
The paper's whole training, projected from a measured part of it, on one core.

    python benchmarks/full_training.py                  # a tenth of all six trainings; `make benchmark-training`
    python benchmarks/full_training.py --share 0.005    # a quick look, written among the temporary files

Runs ``zoo/train.py`` with the settings of ``hyperparams/`` as they are (Table 1), to their own number of env steps, and jumps:
the training is divided into 20 sections of equal length, the first part of each is run (``--share`` of it), and the clock of
the training is then put forward to the next. So the stages of the curriculum, its end, the exponents of the priorities and
all schedules stand where they stand in the whole training, and the sections with refreshes and those without are measured
in their true shares.

The warm-up, the first updates and the curriculum's first refresh, which is longer than the others, come before the first
section and count once. The rest is divided by the share. Evaluations and checkpoints are left out of the run, timed one by
one at its end, and added as often as ``zoo/train.py`` makes them by default.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import statistics
import sys
import tempfile
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch as th
from ours import PACKAGES
from peers.protocol import cpu_model, versions_of
from stable_baselines3.common.callbacks import BaseCallback

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for ``zoo``

from sb3_kfcv import ALGOS, make_vec_env
from sb3_kfcv.common.evaluation import evaluate
from sb3_kfcv.saving.checkpoints import Checkpoints
from sb3_kfcv.saving.files import atomic_write
from zoo.hyperparams import Hyperparams, check, load_entry, merged, parse_pairs
from zoo.train import EVAL_SEED_OFFSET, make_parser
from zoo.train import main as zoo_train

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results" / "full_training.json"
WORLDS = ("HardSpread-v0", "Grassland-v0")
N_SECTIONS = 20
"""Two for each of the curriculum's five stages, and ten after it."""
FIRST_UPDATES = 20
"""Count once: the first ones allocate, and the curriculum's first refresh is longer than the others."""
COLUMNS = ["world", "algorithm", "episodes", "env steps", "updates", "measured", "one core, projected", "processor time"]
COLUMNS += ["of these: updates", "refreshes", "worlds, acting, storing", "evaluations and checkpoints beside it"]


class Sections(BaseCallback):
    """
    Runs the first part of each section of a training, and jumps to the next.

    :param total: env steps of the whole training
    :param start: env steps that count once, at the beginning
    :param share: of each section that is run
    :param saver: saves a checkpoint at the end
    """

    def __init__(self, total: int, start: int, share: float, saver: Checkpoints) -> None:
        super().__init__()
        length = (total - start) / N_SECTIONS
        self.begins = [start + i * length for i in range(N_SECTIONS)]
        self.part = share * length
        self.saver = saver
        self.section = -1  # the steps that count once
        self.marks: list[float] = []
        self.processor_marks: list[float] = []
        self.steps: list[int] = []  # of each section
        self.update_seconds = self.refresh_seconds = self.checkpoint_seconds = 0.0
        self._first_step = 0
        self._trained = 0.0  # since when the learner has been training
        self._refreshed_before = 0.0

    def _on_training_start(self) -> None:
        self._mark()

    def _mark(self) -> None:
        self.marks.append(time.perf_counter())
        self.processor_marks.append(time.process_time())

    def _on_rollout_start(self) -> None:
        now = time.perf_counter()
        if self.section >= 0 and self._trained:
            self.update_seconds += now - self._trained
        self._trained = 0.0
        ends = self.begins[0] if self.section < 0 else self.begins[self.section] + self.part
        if self.model.num_timesteps < ends or self.section == N_SECTIONS:
            return
        self._mark()
        if self.section < 0:
            self._refreshed_before = self._refreshes()
        else:
            self.steps.append(self.model.num_timesteps - self._first_step)
        self.section += 1
        if self.section < N_SECTIONS:
            self.model.num_timesteps = max(self.model.num_timesteps, round(self.begins[self.section]))
            self._first_step = self.model.num_timesteps

    def _on_rollout_end(self) -> None:
        self._trained = time.perf_counter()

    def _on_step(self) -> bool:
        if self.section < N_SECTIONS:
            return True
        self.refresh_seconds = self._refreshes() - self._refreshed_before
        start = time.perf_counter()
        self.saver.save()
        self.checkpoint_seconds = time.perf_counter() - start
        return False

    def _refreshes(self) -> float:
        return float(self.model.replay_buffer.diagnostics().get("time/refresh_seconds", 0.0))


@dataclass
class Training:
    """
    A training, measured and projected; minutes of one core.

    :param world: id of the world
    :param algo: name of the algorithm
    :param params: what is set otherwise than in ``hyperparams/``
    :param episodes: of the whole training, if none ends early
    :param env_steps: of the whole training
    :param updates: of the whole training
    :param share: of the training that was run
    :param start: the beginning, which counts once
    :param sections: the measured part of each section
    :param processor_minutes: of the whole training, projected: without what other processes took
    :param update_minutes: of the whole training, projected, refreshes not included
    :param refresh_minutes: the same of the refreshes
    :param other_minutes: the same of the worlds, of acting and of storing, logs included
    :param evaluation_minutes: of all evaluations that ``zoo/train.py`` makes by default
    :param checkpoint_minutes: the same of the checkpoints
    """

    world: str
    algo: str
    params: list[str]
    episodes: int
    env_steps: int
    updates: int
    share: float
    start: float
    sections: list[float]
    processor_minutes: float
    update_minutes: float
    refresh_minutes: float
    other_minutes: float
    evaluation_minutes: float
    checkpoint_minutes: float

    @property
    def measured(self) -> float:
        return self.start + sum(self.sections)

    @property
    def projected(self) -> float:
        """Minutes of the whole training alone."""
        return self.start + sum(self.sections) / self.share

    @property
    def uncertainty(self) -> float:
        """Standard error of the projection, by how the sections of each half of the training differ."""
        halves = self.sections[: N_SECTIONS // 2], self.sections[N_SECTIONS // 2 :]
        return sum(statistics.variance(half) * len(half) for half in halves) ** 0.5 / self.share

    def cells(self) -> list[str]:
        """The cells of its line."""
        parts = (self.processor_minutes, self.update_minutes, self.refresh_minutes, self.other_minutes)
        return [
            *(
                self.world,
                ", ".join([self.algo, *self.params]),
                f"{self.episodes:,}",
                f"{self.env_steps:,}",
                f"{self.updates:,}",
            ),
            f"{self.measured:.1f} min ({self.share:.0%})",
            f"**{self.projected:.1f} ± {self.uncertainty:.1f} min**",
            *(f"{minutes:.1f} min" for minutes in parts),
            f"{self.evaluation_minutes + self.checkpoint_minutes:.1f} min",
        ]


def n_updates(settings: Hyperparams) -> int:
    """Updates of a whole training."""
    starts, every, each = (settings.model[name] for name in ("learning_starts", "train_freq", "gradient_steps"))
    return (settings.n_timesteps - starts) // (every * settings.n_envs) * each


def measure(world: str, algo: str, share: float, params: list[str]) -> Training:
    """Run the sections of a training, then an evaluation and a checkpoint."""
    settings = check(algo, world, merged(load_entry(algo, world), parse_pairs("--params", params)))
    flags = make_parser()
    total = settings.n_timesteps
    start = settings.model["learning_starts"] + FIRST_UPDATES * settings.n_envs
    with tempfile.TemporaryDirectory() as folder:
        saver = Checkpoints(Path(folder) / "checkpoints", save_freq=-1)
        sections = Sections(total, start, share, saver)
        command = ["--algo", algo, "--env", world, "--seed", "0", "-f", folder, "--verbose", "0"]
        command += ["--device", "cpu", "--eval-freq", "-1", "--save-freq", "-1", *(["-params", *params] if params else [])]
        with contextlib.redirect_stdout(io.StringIO()):
            status = zoo_train(command, [saver, sections])
        if status:
            raise RuntimeError(f"the training of {algo} on {world} stopped with status {status}")
        n_envs, episodes = flags.get_default("n_eval_envs"), flags.get_default("eval_episodes")
        eval_env = make_vec_env(world, n_envs, EVAL_SEED_OFFSET, settings.env_kwargs)
        seconds = []
        for _ in range(3):
            begin = time.perf_counter()
            evaluate(sections.model, eval_env, episodes)
            seconds.append(time.perf_counter() - begin)
    # What is run of each section is a whole number of rounds: the share that was run, to the step.
    run = sum(sections.steps) / (total - start)
    minutes = [(end - begin) / 60 for begin, end in zip(sections.marks, sections.marks[1:], strict=False)]
    began, started, *_, ended = sections.processor_marks
    refreshing = sections.refresh_seconds / 60 / run
    updating = sections.update_seconds / 60 / run - refreshing
    return Training(
        world,
        algo,
        params,
        episodes=total // settings.env_kwargs["max_steps"],
        env_steps=total,
        updates=n_updates(settings),
        share=run,
        start=minutes[0],
        sections=minutes[1:],
        processor_minutes=(started - began + (ended - started) / run) / 60,
        update_minutes=updating,
        refresh_minutes=refreshing,
        other_minutes=sum(minutes[1:]) / run - updating - refreshing,
        evaluation_minutes=statistics.median(seconds) / 60 * (total // flags.get_default("eval_freq")),
        checkpoint_minutes=sections.checkpoint_seconds / 60 * (total // flags.get_default("save_freq")),
    )


def table(results: dict[str, Any]) -> str:
    """The Markdown table of what was written."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    lines += ["| " + " | ".join(Training(**training).cells()) + " |" for training in results["trainings"]]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", choices=WORLDS, default=WORLDS, help="(default: both)")
    parser.add_argument("--algos", nargs="+", choices=list(ALGOS), default=list(ALGOS), help="(default: all)")
    parser.add_argument("--share", type=float, default=0.1, help="of each training that is run (default: %(default)s)")
    parser.add_argument("--params", nargs="+", default=[], metavar="KEY:VALUE", help="such as critic_input:state")
    parser.add_argument("--output", type=Path, help="JSON file (default: in docs/results/, unless less is measured)")
    args = parser.parse_args()
    if not 0 < args.share <= 1:
        parser.error(f"--share is {args.share}; it must be above 0 and at most 1")
    quick = Path(tempfile.gettempdir()) / RESULTS.name
    output = args.output or (RESULTS if args.share >= parser.get_default("share") else quick)
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    facts = {"date": time.strftime("%Y-%m-%d"), "processor": cpu_model(), "threads": 1, "versions": versions_of(PACKAGES)}
    trainings = {} if not output.exists() else {key(known): known for known in json.loads(output.read_text())["trainings"]}
    for world in args.worlds:
        for algo in args.algos:
            training = measure(world, algo, args.share, args.params)
            print(" | ".join(training.cells()), file=sys.stderr, flush=True)
            trainings[key(asdict(training))] = asdict(training)
            results = {**facts, "trainings": list(trainings.values())}
            with atomic_write(output) as file:
                file.write(json.dumps(results, indent=1).encode())
    print(table(results))


def key(training: dict[str, Any]) -> tuple[Any, ...]:
    """What a training is told from others by; measured again, it takes the place of what was written before."""
    return training["world"], training["algo"], *training["params"]


if __name__ == "__main__":
    main()
