"""
AgileRL: ``MADDPG``, its ``ReplayBuffer`` and its trainer.

- ``update``: the buffer is filled with ``MultiAgentTransition``; timed are ``ReplayBuffer.sample`` and ``MADDPG.learn``,
  as its trainer calls them.
- ``train``: ``train_multi_agent_off_policy`` in mpe2's ``simple_spread``, one world (its vectorised env needs a process per
  world), a call per block. Each call ends with one test episode, which is part of its loop, and is counted as time.

It gives agents whose names differ in the number alone one common network (``agent_0``, ``agent_1`` …); here the names differ,
so that each has its own. Encoder, latent layer and head make 64-64-64 the smallest actor;
its critics are 64-64 and see the actions after the first layer.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from protocol import (
    BATCH_SIZE,
    BUFFER_SIZE,
    EPISODE_STEPS,
    GAMMA,
    LEARNING_RATE,
    TAU,
    TRAINING,
    TRAINING_AGENTS,
    UPDATES,
    Work,
    main,
)

NOTE = "actors 64-64-64; critics 64-64 that see the actions after the first layer"
NETWORKS = {
    "encoder_config": {"hidden_size": [64], "layer_norm": False},
    "latent_dim": 64,
    "head_config": {"hidden_size": [64], "layer_norm": False},
}


def distinct(i: int) -> str:
    """A name that shares its beginning with no other agent's."""
    return f"player{i}"


def learner(observation_spaces: list[Any], action_spaces: list[Any], names: list[str], learn_step: int = 1) -> Any:
    import torch
    from agilerl.algorithms import MADDPG

    torch.set_num_threads(1)
    return MADDPG(
        observation_spaces,
        action_spaces,
        agent_ids=names,
        net_config=NETWORKS,
        batch_size=BATCH_SIZE,
        lr_actor=LEARNING_RATE,
        lr_critic=LEARNING_RATE,
        gamma=GAMMA,
        tau=TAU,
        learn_step=learn_step,
        O_U_noise=False,
    )


def update(n_agents: int, obs_size: int, action_size: int) -> Work:
    import torch
    from agilerl.components.data import MultiAgentTransition, transition_to_tensordict
    from agilerl.components.replay_buffer import ReplayBuffer
    from gymnasium.spaces import Box

    names = [distinct(i) for i in range(n_agents)]
    agents = learner(
        [Box(-np.inf, np.inf, (obs_size,), np.float32)] * n_agents,
        [Box(-1.0, 1.0, (action_size,), np.float32)] * n_agents,
        names,
    )
    rng = np.random.default_rng(0)

    def per_agent(*shape: int) -> dict[str, np.ndarray]:
        return {name: rng.random((BUFFER_SIZE, *shape), dtype=np.float32) for name in names}

    rows = transition_to_tensordict(
        MultiAgentTransition(
            obs=per_agent(obs_size),
            action=per_agent(action_size),
            reward=per_agent(),
            next_obs=per_agent(obs_size),
            done={name: np.zeros(BUFFER_SIZE, dtype=np.float32) for name in names},
        )
    )
    rows.batch_size = torch.Size([BUFFER_SIZE])
    memory = ReplayBuffer(BUFFER_SIZE)
    memory.add(rows)
    return Work(lambda: agents.learn(memory.sample(BATCH_SIZE)), note=NOTE)


def renamed_spread() -> Any:
    """mpe2's simple_spread with names that share no beginning."""
    from mpe2 import simple_spread_v3
    from pettingzoo import ParallelEnv

    env = simple_spread_v3.parallel_env(N=TRAINING_AGENTS, max_cycles=EPISODE_STEPS, continuous_actions=True)
    new = {agent: distinct(i) for i, agent in enumerate(env.possible_agents)}
    old = {name: agent for agent, name in new.items()}

    class Renamed(ParallelEnv):
        def __init__(self) -> None:
            self.metadata, self.render_mode, self.possible_agents = env.metadata, None, list(old)

        @property
        def agents(self) -> list[str]:
            return [new[agent] for agent in env.agents]

        def observation_space(self, agent: str) -> Any:
            return env.observation_space(old[agent])

        def action_space(self, agent: str) -> Any:
            return env.action_space(old[agent])

        def reset(self, seed: int | None = None, options: dict | None = None) -> Any:
            return tuple({new[agent]: value for agent, value in part.items()} for part in env.reset(seed, options))

        def step(self, actions: dict[str, Any]) -> Any:
            parts = env.step({old[name]: action for name, action in actions.items()})
            return tuple({new[agent]: value for agent, value in part.items()} for part in parts)

        def close(self) -> None:
            env.close()

    return Renamed()


def train(steps_per_update: int) -> Work:
    from agilerl.components.replay_buffer import ReplayBuffer
    from agilerl.training.train_multi_agent_off_policy import train_multi_agent_off_policy

    env = renamed_spread()
    names = env.possible_agents
    agents = learner(
        [env.observation_space(name) for name in names], [env.action_space(name) for name in names], names, steps_per_update
    )
    memory = ReplayBuffer(BUFFER_SIZE)
    block = 500
    done = 0

    def steps() -> None:
        nonlocal done
        done += block
        train_multi_agent_off_policy(
            env, "simple_spread", "MADDPG", [agents], memory, max_steps=done, evo_steps=block, verbose=False
        )

    return Work(steps, block, f"mpe2, one world, actions of 5; {NOTE}; a test episode per {block} steps")


if __name__ == "__main__":
    main(
        ["agilerl", "torch", "tensordict", "mpe2", "pettingzoo", "numpy"],
        {
            **{case: partial(update, *sizes) for case, sizes in UPDATES.items()},
            **{case: partial(train, steps) for case, steps in TRAINING.items()},
        },
    )
