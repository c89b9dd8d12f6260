"""
The search behind the ``tuned`` presets: the same candidates for all three algorithms, by greedy evaluation on fresh seeds.

    python benchmarks/tuned_search.py --world HardSpread-v0 --steps 250000 --seeds 1
    python benchmarks/tuned_search.py --world mpe2/simple_spread_v3 --algos maddpg --steps 50000 --seeds 1001

Writes ``docs/results/tuned_search_<world>.json`` after every run, so that an interrupted search goes on where it was,
and prints a Markdown table.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from sb3_kfcv import ALGOS, make_vec_env  # noqa: E402
from sb3_kfcv.common.evaluation import evaluate  # noqa: E402
from sb3_kfcv.saving.files import atomic_write  # noqa: E402
from sb3_kfcv.teams.team_policy import TeamPolicy  # noqa: E402
from sb3_kfcv.vec_env.make import WORLDS, layout_of  # noqa: E402
from zoo.run_folder import file_name  # noqa: E402

RESULTS = ROOT / "docs" / "results"

MPE2_BASE: dict[str, Any] = {"gamma": 0.95, "buffer_size": 100_000, "actor_regularization": 0.001}
BASE: dict[str, dict[str, Any]] = {
    "HardSpread-v0": {"gamma": 0.95, "buffer_size": 200_000, "learning_starts": 5000, "actor_regularization": 0.01},
    "Grassland-v0": {"gamma": 0.95, "buffer_size": 20_000, "learning_starts": 2000, "critic_input": "own_observation"},
    "mpe2/simple_spread_v3": MPE2_BASE,
    "mpe2/simple_speaker_listener_v4": MPE2_BASE,
    "mpe2/simple_reference_v3": MPE2_BASE,
}
TWIN: dict[str, Any] = {"policy_kwargs": {"n_critics": 2}}
EXPLORING = TWIN | {"gradient_steps": 2, "exploration_noise": 0.3}
MPE2: dict[str, dict[str, Any]] = {
    "Table 1": {"gamma": 0.99, "buffer_size": 5000, "actor_regularization": 0.0},
    "base": {},
    "twin": TWIN,
    "twin, noise 0.3": TWIN | {"exploration_noise": 0.3},
    "twin, two updates": TWIN | {"gradient_steps": 2},
    "twin, batch 256, clipped": TWIN | {"batch_size": 256, "max_grad_norm": 0.5},
    "twin, learning rate 3e-3": TWIN | {"learning_rate": 3e-3},
}
CANDIDATES: dict[str, dict[str, dict[str, Any]]] = {
    "HardSpread-v0": {
        "Table 1": {"gamma": 0.99, "buffer_size": 5000, "learning_starts": 1000, "actor_regularization": 0.0},
        "base": {},
        "shared": {"share_parameters": True},
        "shared, twin": {"share_parameters": True, "policy_kwargs": {"n_critics": 2}},
        "shared, twin, gamma 0.99": {"share_parameters": True, "policy_kwargs": {"n_critics": 2}, "gamma": 0.99},
        "shared, twin, clipped": {"share_parameters": True, "policy_kwargs": {"n_critics": 2}, "max_grad_norm": 0.5},
    },
    "Grassland-v0": {
        "base": {},
        "state": {"critic_input": "state"},
        "batch 256, clipped": {"batch_size": 256, "max_grad_norm": 0.5},
        "shared, batch 256, clipped": {"share_parameters": True, "batch_size": 256, "max_grad_norm": 0.5},
    },
    "mpe2/simple_spread_v3": {
        **MPE2,
        "twin, shared": TWIN | {"share_parameters": True},
        "twin, two updates, noise 0.3": EXPLORING,
        "twin, two updates, noise 0.3, shared": EXPLORING | {"share_parameters": True},
    },
    "mpe2/simple_speaker_listener_v4": MPE2,
    "mpe2/simple_reference_v3": {
        "twin, two updates, noise 0.3": EXPLORING,
        "twin, two updates, noise 0.3, shared": EXPLORING | {"share_parameters": True},
        "twin, two updates, noise 0.1, shared": EXPLORING | {"share_parameters": True, "exploration_noise": 0.1},
        "twin, four updates, noise 0.3, shared": EXPLORING | {"share_parameters": True, "gradient_steps": 4},
    },
}
# Who plays whom in the evaluation, and what is noted of it; "model" is the trained one.
MATCHES: dict[str, dict[str, tuple[dict[str, str], tuple[str, ...]]]] = {
    "HardSpread-v0": {"": ({"agent": "model"}, ("return_agent", "landmarks_covered", "closest_distance", "collisions"))},
    "Grassland-v0": {
        "wolves against graze: ": ({"wolf": "model", "sheep": "graze"}, ("return_wolf", "sheep_eaten")),
        "wolves against flee: ": ({"wolf": "model", "sheep": "flee"}, ("return_wolf", "sheep_eaten")),
        "sheep against chase: ": ({"wolf": "chase", "sheep": "model"}, ("return_sheep",)),
    },
    "mpe2/simple_spread_v3": {"": ({"agent": "model"}, ("return_agent",))},
    "mpe2/simple_speaker_listener_v4": {"": ({"speaker": "model", "listener": "model"}, ("return_listener",))},
    "mpe2/simple_reference_v3": {"": ({"agent": "model"}, ("return_agent",))},
}
EPISODES, EVAL_SEED = 256, 1_000_000


def make_worlds(world: str, n_envs: int, seed: int) -> VecEnv:
    """Worlds with continuous actions, side by side."""
    return make_vec_env(world, n_envs, seed, {} if world in WORLDS else {"continuous_actions": True})


def run(world: str, algo: str, settings: dict[str, Any], steps: int, seed: int) -> dict[str, float]:
    """Train once and evaluate; name → mean over the episodes, and the seconds of the training."""
    n_envs = 32 if world in WORLDS else 8  # our own worlds are compiled: many step as fast as few
    model = ALGOS[algo]("MlpPolicy", make_worlds(world, n_envs, seed), seed=seed, device="cpu", **settings)
    start = time.perf_counter()
    model.learn(steps, log_interval=None)
    results = {"seconds": time.perf_counter() - start}
    for prefix, (players, metrics) in MATCHES[world].items():
        env = make_worlds(world, 64, EVAL_SEED)
        line_up = {group: model if player == "model" else player for group, player in players.items()}
        played = evaluate(TeamPolicy(layout_of(env), line_up, np.random.default_rng(0)), env, EPISODES)
        results |= {prefix + metric: float(played[metric].mean()) for metric in metrics}
    return results


def table(runs: list[dict[str, Any]]) -> str:
    """Means over the seeds, a line per candidate and algorithm."""
    metrics = list(runs[0]["results"])
    lines = ["| candidate | algorithm | " + " | ".join(metrics) + " | seeds |", "|" + "---|" * (len(metrics) + 3)]
    for candidate, algo in dict.fromkeys((done["candidate"], done["algo"]) for done in runs):
        same = [done["results"] for done in runs if (done["candidate"], done["algo"]) == (candidate, algo)]
        means = [np.mean([results[metric] for results in same]) for metric in metrics]
        lines.append(f"| {candidate} | {algo} | " + " | ".join(f"{mean:.2f}" for mean in means) + f" | {len(same)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", choices=list(CANDIDATES), required=True)
    parser.add_argument("--steps", type=int, required=True, help="env steps of each run")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--candidates", nargs="+", help="(default: all)")
    parser.add_argument("--algos", nargs="+", choices=list(ALGOS), default=list(ALGOS), help="(default: all)")
    args = parser.parse_args()
    th.set_num_threads(1)
    path = RESULTS / f"tuned_search_{file_name(args.world)}.json"
    runs: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    for seed in args.seeds:
        for candidate in args.candidates or CANDIDATES[args.world]:
            settings = BASE[args.world] | CANDIDATES[args.world][candidate]
            for algo in args.algos:
                key = {"candidate": candidate, "algo": algo, "seed": seed, "steps": args.steps}
                if any(key.items() <= done.items() for done in runs):
                    continue
                runs.append({**key, "settings": settings, "results": run(args.world, algo, settings, args.steps, seed)})
                with atomic_write(path) as file:
                    file.write(json.dumps(runs, indent=1).encode())
                print(key, {name: round(value, 2) for name, value in runs[-1]["results"].items()}, flush=True)
    print(table(runs))


if __name__ == "__main__":
    main()
