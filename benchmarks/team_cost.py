"""
What a second learner costs: Grassland trained by one learner for all agents and by one for each team, in turn, in the same
process: ``python benchmarks/team_cost.py``. Writes ``docs/results/team_cost.json`` and prints a table.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from pathlib import Path
from typing import Any

import torch as th

from sb3_kfcv import ALGOS, CoTraining, make_vec_env
from sb3_kfcv.common.joint_algorithm import JointAlgorithm
from sb3_kfcv.saving.archive import library_versions
from sb3_kfcv.saving.files import atomic_write

RESULTS = Path(__file__).parents[1] / "docs" / "results" / "team_cost.json"
N_ENVS = 32
SETTINGS: dict[str, dict[str, Any]] = {
    "critics of own observations": {"critic_input": "own_observation"},
    "critics of the state": {"critic_input": "state"},
    "joint critics": {},
}


def make(algo: str, settings: dict[str, Any], teams: bool) -> JointAlgorithm:
    """A learner for all, or one for each team, past its warm-up."""
    env = make_vec_env("Grassland-v0", N_ENVS, seed=0)
    settings = {"learning_starts": 1000, **settings}
    if teams:
        model: JointAlgorithm = CoTraining(
            "MlpPolicy", env, {group: {"algo": algo, **settings} for group in ("wolf", "sheep")}, seed=0, device="cpu"
        )
    else:
        model = ALGOS[algo]("MlpPolicy", env, seed=0, device="cpu", **settings)
    return model.learn(3200, log_interval=None)  # type: ignore[arg-type]


def seconds(model: JointAlgorithm, steps: int) -> tuple[float, float]:
    """Wall-clock and processor time of some more training."""
    wall, processor = time.perf_counter(), time.process_time()
    model.learn(steps, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
    return time.perf_counter() - wall, time.process_time() - processor


def compare(algo: str, settings: dict[str, Any], steps: int, rounds: int) -> dict[str, Any]:
    """Both in turn; ratios of each round."""
    one, two = (make(algo, settings, teams) for teams in (False, True))
    taken = [(seconds(one, steps), seconds(two, steps)) for _ in range(rounds)]
    ratios = [second[1] / first[1] for first, second in taken]
    return {
        "algo": algo,
        "settings": settings,
        "steps": steps,
        "one_us_per_step": [1e6 * first[1] / steps for first, _ in taken],
        "two_us_per_step": [1e6 * second[1] / steps for _, second in taken],
        "wall_ratio": [second[0] / first[0] for first, second in taken],
        "ratio": ratios,
        "median_ratio": statistics.median(ratios),
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Measure what a second learner costs.")
    parser.add_argument("--steps", type=int, default=6400, help="env steps of each round (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=7, help="rounds (default: %(default)s)")
    args = parser.parse_args()
    th.set_num_threads(1)
    rows = []
    print(
        "| algorithm | critics | one learner, µs per env step | two, µs | ratio (median) | range |\n|---|---|---|---|---|---|"
    )
    for name, settings in SETTINGS.items():
        for algo in ALGOS if name == "critics of own observations" else ("maddpg",):
            row = {"critics": name, **compare(algo, settings, args.steps, args.rounds)}
            rows.append(row)
            one, two = (statistics.median(row[key]) for key in ("one_us_per_step", "two_us_per_step"))
            spread = f"{min(row['ratio']):.2f}–{max(row['ratio']):.2f}"
            print(f"| {algo} | {name} | {one:.0f} | {two:.0f} | {row['median_ratio']:.2f} | {spread} |", flush=True)
    report = {
        "machine": platform.processor() or platform.machine(),
        "versions": library_versions(),
        "threads": 1,
        "rows": rows,
    }
    with atomic_write(RESULTS) as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
