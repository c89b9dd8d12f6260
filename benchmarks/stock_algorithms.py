"""
Learning curves of SB3's own algorithms with uniform, prioritised and curriculum replay, on two classic tasks.

    python benchmarks/stock_algorithms.py

Writes ``docs/results/stock_algorithms.json`` after every run, so that an interrupted one goes on where it was, draws
``docs/images/stock_algorithms.png``, and prints a Markdown table.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from scipy.stats import trim_mean
from stable_baselines3 import DQN, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from sb3_kfcv.saving.files import atomic_write  # noqa: E402
from sb3_kfcv.stock import ReplayCallback, StockKFCVReplayBuffer, StockPrioritizedReplayBuffer  # noqa: E402
from zoo.plots import ALGO_COLOURS, new_figure, save_figure  # noqa: E402


class Task(NamedTuple):
    """An environment, the algorithm that learns it, and for how long."""

    algorithm: type[OffPolicyAlgorithm]
    steps: int
    settings: dict[str, Any]


TASKS = {
    "CartPole-v1": Task(
        DQN,
        50_000,
        {
            **{"learning_rate": 2.3e-3, "batch_size": 64, "buffer_size": 100_000, "learning_starts": 1000},
            **{"train_freq": 256, "gradient_steps": 128, "target_update_interval": 10},
            **{"exploration_fraction": 0.16, "exploration_final_eps": 0.04},
        },
    ),
    "Pendulum-v1": Task(
        TD3,
        10_000,
        {
            **{"learning_rate": 1e-3, "batch_size": 128, "buffer_size": 10_000, "learning_starts": 500, "gamma": 0.98},
            **{"train_freq": 1, "gradient_steps": 1, "action_noise": NormalActionNoise(np.zeros(1), np.full(1, 0.1))},
        },
    ),
}
REPLAYS: dict[str, dict[str, Any]] = {
    "uniform": {},
    "by rank": {"replay_buffer_class": StockPrioritizedReplayBuffer},
    "curriculum": {"replay_buffer_class": StockKFCVReplayBuffer},
}
COLOURS = dict(zip(REPLAYS, ALGO_COLOURS.values(), strict=True))
N_EVALUATIONS, EPISODES, EVAL_SEED = 20, 10, 1_000_000
LAST = 4  # evaluations that are averaged for what is reached at the end
RESAMPLES = 5000


class Curve(BaseCallback):
    """Evaluates greedily, at equal distances, the same starts each time."""

    def __init__(self, env_id: str, every: int) -> None:
        super().__init__()
        self.env, self.every = make_vec_env(env_id), every
        self.returns: list[float] = []
        self.seconds = 0.0  # that evaluations took

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            start = time.process_time()
            self.env.seed(EVAL_SEED)
            mean, _ = evaluate_policy(self.model, self.env, EPISODES)
            self.returns.append(float(np.mean(mean)))
            self.seconds += time.process_time() - start
        return True


def train(env_id: str, replay: str, seed: int, steps: int) -> dict[str, Any]:
    """One training: its curve, and the seconds of the processor that it took without evaluations."""
    task, curve = TASKS[env_id], Curve(env_id, steps // N_EVALUATIONS)
    settings = {"seed": seed, "device": "cpu", "policy_kwargs": {"net_arch": [64, 64]}, **task.settings, **REPLAYS[replay]}
    model = task.algorithm("MlpPolicy", make_vec_env(env_id, seed=seed), **settings)
    start = time.process_time()
    model.learn(steps, [curve] if replay == "uniform" else [ReplayCallback(), curve], log_interval=None)
    return {"returns": curve.returns, "seconds": time.process_time() - start - curve.seconds}


def interval(values: np.ndarray) -> tuple[float, float, float]:
    """
    Inter-quartile mean over the seeds, and its 95 % bootstrap interval.

    :param values: (seeds,)
    """
    rng = np.random.default_rng(0)
    resampled = trim_mean(rng.choice(values, (RESAMPLES, len(values))), 0.25, axis=1)
    return float(trim_mean(values, 0.25)), *np.quantile(resampled, [0.025, 0.975])  # type: ignore[return-value]


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """How often a run of ours is better than one of theirs, equal ones counting half."""
    differences = ours[:, None] - theirs
    return float(((differences > 0) + 0.5 * (differences == 0)).mean())


def gather(runs: list[dict[str, Any]], env_id: str, replay: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns (seeds, evaluations) and seconds (seeds,) of a task's runs."""
    same = [run for run in runs if (run["env"], run["replay"]) == (env_id, replay)]
    return np.array([run["returns"] for run in same]), np.array([run["seconds"] for run in same])


def table(runs: list[dict[str, Any]]) -> str:
    """A line per task and replay."""
    lines = [
        "| task | replay | at the end | over the whole training | P(better than uniform at the end) | time | seeds |",
        "|---|---|---|---|---|---|---|",
    ]
    for env_id, task in TASKS.items():
        uniform, uniform_seconds = gather(runs, env_id, "uniform")
        for replay in REPLAYS:
            returns, seconds = gather(runs, env_id, replay)
            cells = [f"{m:.0f} [{a:.0f}, {b:.0f}]" for m, a, b in map(interval, (last(returns), returns.mean(1)))]
            better = "" if replay == "uniform" else f"{probability_of_improvement(last(returns), last(uniform)):.2f}"
            ratio = np.median(seconds) / np.median(uniform_seconds)
            name = f"{task.algorithm.__name__} on {env_id}"
            lines.append(f"| {name} | {replay} | {cells[0]} | {cells[1]} | {better} | {ratio:.2f} | {len(returns)} |")
    return "\n".join(lines)


def last(returns: np.ndarray) -> np.ndarray:
    """What each seed reaches at the end: (seeds,)."""
    return returns[:, -LAST:].mean(1)


def draw(runs: list[dict[str, Any]], path: Path) -> None:
    """Curves of all tasks, inter-quartile means with their intervals."""
    figure, axes = new_figure(len(TASKS))
    for axis, (env_id, task) in zip(axes, TASKS.items(), strict=True):
        for replay, colour in COLOURS.items():
            returns, _ = gather(runs, env_id, replay)
            steps = next(run["steps"] for run in runs if run["env"] == env_id) * np.arange(1, returns.shape[1] + 1)
            means, low, high = np.array([interval(values) for values in returns.T]).T
            axis.plot(steps / returns.shape[1], means, color=colour, label=replay)
            axis.fill_between(steps / returns.shape[1], low, high, color=colour, alpha=0.25, linewidth=0)
        axis.set(title=f"{task.algorithm.__name__} on {env_id}", xlabel="env steps", ylabel="greedy return per episode")
        axis.legend(title="replay")
    save_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="seeds 0 … n − 1")
    parser.add_argument("--share", type=float, default=1.0, help="share of the env steps, for a quick look")
    parser.add_argument("--output", type=Path, default=ROOT / "docs" / "results" / "stock_algorithms.json")
    parser.add_argument("--image", type=Path, default=ROOT / "docs" / "images" / "stock_algorithms.png")
    args = parser.parse_args()
    th.set_num_threads(1)
    runs: list[dict[str, Any]] = json.loads(args.output.read_text()) if args.output.exists() else []
    for seed in range(args.seeds):
        for env_id, task in TASKS.items():
            for replay in REPLAYS:
                key = {"env": env_id, "replay": replay, "seed": seed, "steps": int(task.steps * args.share)}
                if any(key.items() <= done.items() for done in runs):
                    continue
                runs.append({**key, **train(env_id, replay, seed, key["steps"])})
                with atomic_write(args.output) as file:
                    file.write(json.dumps(runs).encode())
                shown = f"at the end {np.mean(runs[-1]['returns'][-LAST:]):.0f}, {runs[-1]['seconds']:.0f} s"
                print(f"{env_id} {replay} seed {seed}: {shown}", flush=True)
    draw(runs, args.image)
    print(table(runs))


if __name__ == "__main__":
    main()
