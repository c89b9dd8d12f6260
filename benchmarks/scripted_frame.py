"""
What the scripted policies reach: the frame in which the numbers of trained agents are read.

    python benchmarks/scripted_frame.py --episodes 1000 --world all --seed 0

prints a Markdown table per world: means over the episodes, each with the half-width of its 95 % interval.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

from sb3_kfcv.envs.grassland import GrasslandWorlds
from sb3_kfcv.envs.hard_spread import HardSpreadWorlds
from sb3_kfcv.envs.particle_worlds import ParticleWorlds
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.particle_vec_env import ParticleVecEnv

WORLDS: dict[str, Callable[[int], ParticleWorlds]] = {"HardSpread-v0": HardSpreadWorlds, "Grassland-v0": GrasslandWorlds}

LINE_UPS: dict[str, list[dict[str, str]]] = {
    "HardSpread-v0": [{"agent": name} for name in ("still", "random", "greedy-nearest", "greedy-assigned", "oracle")],
    "Grassland-v0": [{"wolf": wolf, "sheep": sheep} for wolf in ("random", "chase") for sheep in ("random", "flee", "graze")],
}

COLUMNS: dict[str, tuple[str, ...]] = {
    "HardSpread-v0": (
        "return_per_agent",
        "collisions",
        "closest_distance",
        "landmarks_covered",
        "landmarks_covered_last",
        "cover_rate",
    ),
    "Grassland-v0": (
        "return_per_wolf",
        "return_per_sheep",
        "wolf_capture_term",
        "wolf_boundary_term",
        "sheep_boundary_term",
        "sheep_grass_term",
        "sheep_eaten",
        "wolves_win",
    ),
}


def play(world: str, players: dict[str, str], episodes: int, seed: int) -> dict[str, np.ndarray]:
    """
    Play one episode in each of many worlds at once.

    :param world: id of the environment
    :param players: name of the scripted policy of each group
    :param episodes: number of worlds
    :param seed: the worlds' seeds are ``seed · episodes`` and the following ones, so that all line-ups start alike
    :return: each metric of each episode (episodes,)
    """
    worlds = WORLDS[world](episodes)
    worlds.seed(range(seed * episodes, (seed + 1) * episodes))
    worlds.reset()
    layout = ParticleVecEnv(worlds).layout
    team = TeamPolicy(layout, players, np.random.default_rng(seed), state_source=worlds.states)

    metrics = np.zeros((episodes, 1 + len(worlds.metric_names)))
    running = np.ones(episodes, dtype=bool)
    while running.any():
        forces, _ = team.predict(worlds.observations)
        worlds.step(forces.reshape(episodes, worlds.n_agents, 2))
        ended = running & (worlds.episode_terminated | worlds.episode_truncated)
        metrics[ended, 0] = worlds.returns[ended].mean(axis=1)
        metrics[ended, 1:] = worlds.episode_metrics()[ended]
        running &= ~ended
    return dict(zip(("return_per_agent", *worlds.metric_names), metrics.T, strict=True))


def mean_and_interval(values: np.ndarray) -> str:
    """Mean and the half-width of its 95 % interval by the normal law, as text."""
    half_width = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    return f"{values.mean():.3f} ± {half_width:.3f}"


def table(world: str, episodes: int, seed: int) -> str:
    """The Markdown table of one world."""
    groups = list(LINE_UPS[world][0])
    columns = COLUMNS[world]
    lines = ["| " + " | ".join([*groups, *columns]) + " |", "|---" * (len(groups) + len(columns)) + "|"]
    for players in LINE_UPS[world]:
        results = play(world, players, episodes, seed)
        lines.append("| " + " | ".join([*players.values(), *(mean_and_interval(results[name]) for name in columns)]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="What the scripted policies reach, as Markdown tables.")
    parser.add_argument("--episodes", type=int, default=1000, help="episodes per line-up, at least 2")
    parser.add_argument("--world", choices=[*WORLDS, "all"], default="all")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if arguments.episodes < 2:
        parser.error(f"--episodes is {arguments.episodes}; an interval needs at least 2")
    for world in WORLDS if arguments.world == "all" else [arguments.world]:
        print(f"{world}: {arguments.episodes} episodes per row, seed {arguments.seed}\n")
        print(table(world, arguments.episodes, arguments.seed), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
