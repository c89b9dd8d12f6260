"""
mpe2: the worlds of Lowe et al. in NumPy, as PettingZoo ``parallel_env``, one world at a time. Its public ``reset`` and
``step`` alone; an episode is started anew when it is over.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from protocol import EPISODE_STEPS, SPREAD_AGENTS, TAG_SHEEP, TAG_WOLVES, Work, main

N_STEPS = 50


def simulate(env: Any, note: str) -> Work:
    """Steps with random actions that were drawn before."""
    env.reset(seed=0)
    agents = list(env.possible_agents)
    rng = np.random.default_rng(0)
    actions = [{agent: rng.random(5, dtype=np.float32) for agent in agents} for _ in range(N_STEPS)]

    def steps() -> None:
        for chosen in actions:
            env.step(chosen)
            if not env.agents:
                env.reset()

    return Work(steps, N_STEPS, note)


def spread() -> Work:
    from mpe2 import simple_spread_v3

    env = simple_spread_v3.parallel_env(N=SPREAD_AGENTS, max_cycles=EPISODE_STEPS, continuous_actions=True)
    return simulate(env, "simple_spread, observations 24 with silent messages")


def tag() -> Work:
    from mpe2 import simple_tag_v3

    env = simple_tag_v3.parallel_env(
        num_good=TAG_SHEEP, num_adversaries=TAG_WOLVES, num_obstacles=2, max_cycles=EPISODE_STEPS, continuous_actions=True
    )
    return simulate(env, "simple_tag, observations 84–86; no food, nobody dies")


if __name__ == "__main__":
    main(["mpe2", "pettingzoo", "numpy"], {"spread-1": spread, "tag-1": tag})
