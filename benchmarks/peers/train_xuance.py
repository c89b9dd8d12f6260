"""
XuanCe's MADDPG in ``simple_spread_v3``, trained from the beginning to the end by its own trainer, in its own environment:

    .peers/xuance/bin/python benchmarks/peers/train_xuance.py --steps 100000 --every 10000 --seed 0 --output actors.npz

Its settings are those of its own configuration for this world, but for what ``--set`` changes. Its noise and learning rates
fall over the given steps. The file holds its actors as they are every so many env steps (``<env steps>/<agent>/<layer>``,
weights and biases in turn), what they do at the end in a few observations (``observations/<agent>``, ``actions/<agent>``), and
the seconds that its trainer took (``seconds``, ``processor_seconds``).
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import numpy as np

WORLD = "simple_spread_v3"
N_CHECKED = 8
"""Observations of each agent in which the written actors can be compared with its own."""


def actors_of(agents: Any, steps: int) -> dict[str, np.ndarray]:
    """Weights and biases of all actors, by name."""
    return {
        f"{steps}/{agent}/{name}": tensor.detach().numpy().copy()
        for agent, actor in agents.policy.actor.items()
        for name, tensor in actor.model.state_dict().items()
    }


def train(steps: int, every: int, seed: int, settings: dict[str, Any]) -> dict[str, np.ndarray]:
    """Train once; what the file is to hold."""
    import torch
    from xuance.common import get_arguments
    from xuance.environment import make_envs
    from xuance.torch.agents import MADDPG_Agents

    torch.set_num_threads(1)
    config = get_arguments("maddpg", "mpe", WORLD)
    config.seed = config.env_seed = seed
    config.running_steps = steps
    for name, value in settings.items():
        setattr(config, name, value)
    agents = MADDPG_Agents(config, make_envs(config))
    arrays = actors_of(agents, 0)
    wall, processor = time.perf_counter(), time.process_time()
    while agents.current_step < steps:
        agents.train(every // config.parallels)
        arrays |= actors_of(agents, agents.current_step)
    seconds = time.perf_counter() - wall, time.process_time() - processor
    rng = np.random.default_rng(0)
    seen = {
        agent: rng.normal(size=(N_CHECKED, *space.shape)).astype("f4") for agent, space in agents.observation_space.items()
    }
    rows = [{agent: seen[agent][i] for agent in seen} for i in range(N_CHECKED)]
    acted = agents.get_actions(obs_dict=rows, test_mode=True)["actions"]
    return {
        **arrays,
        **{f"observations/{agent}": values for agent, values in seen.items()},
        **{f"actions/{agent}": np.array([row[agent] for row in acted]) for agent in seen},
        "seconds": np.array(seconds[0]),
        "processor_seconds": np.array(seconds[1]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, required=True, help="env steps")
    parser.add_argument("--every", type=int, required=True, help="env steps between the actors that are kept")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--set", type=json.loads, default={}, help="settings of XuanCe in place of its own, as JSON")
    parser.add_argument("--output", required=True, help="the file")
    args = parser.parse_args()
    np.savez(args.output, **train(args.steps, args.every, args.seed, args.set))


if __name__ == "__main__":
    main()
