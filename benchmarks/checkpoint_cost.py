"""
What checkpoints cost: bytes and seconds, beside the seconds of training between them.

    python benchmarks/checkpoint_cost.py --algo kfcv_maddpg

fills the replay buffer with steps of random actions, measures the training itself over some thousand steps, and then saves
checkpoints: the first, which writes the whole buffer, one after 25,000 further env steps (the default of ``zoo/train.py``),
and one after 2,500. It prints a Markdown table; every second is one of the wall clock, the syncing of the disk included.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for ``zoo``

from sb3_kfcv import ALGOS, make_vec_env
from sb3_kfcv.maddpg import MADDPG
from sb3_kfcv.saving.checkpoints import Checkpoints
from zoo.hyperparams import PRESETS, check, load_entry

WORLDS = ("Grassland-v0", "HardSpread-v0")
GAPS = (25_000, 2_500)  # env steps before the second and the third checkpoint
WARM_UP = 20  # updates before the training is timed: the curriculum's first refresh takes longer than the later ones
NEVER = 10**12

COLUMNS = (
    *("world", "preset", "buffer", "first checkpoint"),
    *(f"after {gap:,} env steps" for gap in GAPS),
    *(f"training of {gap:,} env steps" for gap in GAPS),
    *("share of the time", "loading"),
)


class Measure(BaseCallback):
    """
    Fills the buffer, times the training, and saves the checkpoints, one after the other.

    :param saver: saves the checkpoints
    :param updates: number of updates that are timed
    """

    def __init__(self, saver: Checkpoints, updates: int) -> None:
        super().__init__()
        self.saver = saver
        self.updates = updates
        self.seconds_per_step = 0.0
        self.checkpoints: list[tuple[int, float]] = []  # bytes, seconds
        self._plan: list[tuple[int, Any]] = []

    def _on_training_start(self) -> None:
        model = self.model
        steps = model.replay_buffer.buffer_size * model.n_envs
        self._plan.append((steps, self._train))
        steps += WARM_UP * model.n_envs
        self._plan.append((steps, self._start_clock))
        steps += self.updates * model.n_envs
        self._plan.append((steps, self._stop_clock))
        for gap in (0, *GAPS):
            steps += -(-gap // model.n_envs) * model.n_envs
            self._plan.append((steps, self._save))
        self.model.learning_starts = NEVER

    def _on_rollout_start(self) -> None:
        while self._plan and self.model.num_timesteps >= self._plan[0][0]:
            self._plan.pop(0)[1]()

    def _on_step(self) -> bool:
        return bool(self._plan)

    def _train(self) -> None:
        self.model.learning_starts = 0

    def _start_clock(self) -> None:
        self._start = time.perf_counter()

    def _stop_clock(self) -> None:
        self.seconds_per_step = (time.perf_counter() - self._start) / (self.updates * self.model.n_envs)
        self.model.learning_starts = NEVER

    def _save(self) -> None:
        before = sizes(self.saver.folder)
        start = time.perf_counter()
        self.saver.save()
        seconds = time.perf_counter() - start
        new = sum(size for path, size in sizes(self.saver.folder).items() if path not in before)
        self.checkpoints.append((new, seconds))


class StopAtOnce(BaseCallback):
    """Ends the training with its first step."""

    def _on_step(self) -> bool:
        return False


def sizes(folder: Path) -> dict[Path, int]:
    """Bytes of every file below a folder."""
    return {path: path.stat().st_size for path in folder.rglob("*") if path.is_file()}


def make_model(world: str, algo: str, preset: str) -> MADDPG:
    """A learner with the settings of the YAML file."""
    settings = check(algo, world, load_entry(algo, world, preset=preset))
    env = make_vec_env(world, settings.n_envs, 0, settings.env_kwargs)
    return ALGOS[algo](settings.policy, env, seed=0, device="cpu", **settings.model_kwargs())


def row(world: str, algo: str, preset: str, updates: int) -> str:
    """Measure one world with one preset: a line of the table."""
    model = make_model(world, algo, preset)
    with tempfile.TemporaryDirectory() as folder:
        measured = Measure(Checkpoints(folder, save_freq=-1), updates)
        model.learn(NEVER, [measured.saver, measured], log_interval=None)
        other = make_model(world, algo, preset)
        other.learning_starts = NEVER
        start = time.perf_counter()
        other.learn(NEVER, [Checkpoints(folder, save_freq=-1, resume=True), StopAtOnce()], log_interval=None)
        loading = time.perf_counter() - start
    training = [gap * measured.seconds_per_step for gap in GAPS]
    shares = [saved / (saved + trained) for (_, saved), trained in zip(measured.checkpoints[1:], training, strict=True)]
    cells = [
        *(world, preset, f"{model.replay_buffer.buffer_size * model.n_envs:,}"),
        *(f"{n_bytes / 1e6:.1f} MB, {seconds:.2f} s" for n_bytes, seconds in measured.checkpoints),
        *(f"{seconds:.1f} s" for seconds in training),
        " / ".join(f"{share:.1%}" for share in shares),
        f"{loading:.2f} s",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", choices=list(ALGOS), default="kfcv_maddpg", help="(default: %(default)s)")
    parser.add_argument("--world", choices=[*WORLDS, "all"], default="all", help="(default: %(default)s)")
    parser.add_argument("--updates", type=int, default=250, help="that are timed (default: %(default)s)")
    args = parser.parse_args()
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    print(f"{args.algo}\n\n| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for world in WORLDS if args.world == "all" else [args.world]:
        for preset in PRESETS:
            print(row(world, args.algo, preset, args.updates), flush=True)


if __name__ == "__main__":
    main()
