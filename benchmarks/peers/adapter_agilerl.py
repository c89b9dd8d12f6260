"""
AgileRL: ``MADDPG``, its ``ReplayBuffer`` and its trainer.

- ``update``: the buffer is filled with ``MultiAgentTransition``; timed are ``ReplayBuffer.sample`` and ``MADDPG.learn``,
  as its trainer calls them.
- ``predict``: ``MADDPG.get_action`` in evaluation mode (no noise).
- ``uniform``: ``ReplayBuffer.sample`` and ``add``, the latter with a transition that was made before.
- ``train``: ``train_multi_agent_off_policy`` in mpe2's ``simple_spread``, one world (its vectorised env needs a process per
  world), a call per block. Each call ends with one test episode, which is part of its loop, and is counted as time.

It gives agents whose names differ in the number alone one common network (``agent_0``, ``agent_1`` …); here the names differ,
so that each has its own. Encoder, latent layer and head make 64-64-64 the smallest actor;
its critics are 64-64 and see the actions after the first layer.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from protocol import (
    BATCH_SIZE,
    BUFFER_SIZE,
    EPISODE_STEPS,
    GAMMA,
    LEARNING_RATE,
    TAU,
    TRAINING_AGENTS,
    UPDATES,
    Work,
    cases,
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


def sized(n_agents: int, obs_size: int, action_size: int) -> Any:
    """A learner of the wanted sizes."""
    from gymnasium.spaces import Box

    return learner(
        [Box(-np.inf, np.inf, (obs_size,), np.float32)] * n_agents,
        [Box(-1.0, 1.0, (action_size,), np.float32)] * n_agents,
        [distinct(i) for i in range(n_agents)],
    )


def per_agent(n_agents: int, *shape: int) -> dict[str, np.ndarray]:
    """Agent → random numbers."""
    rng = np.random.default_rng(0)
    return {distinct(i): rng.random(shape, dtype=np.float32) for i in range(n_agents)}


def transitions(n_rows: int, n_agents: int, obs_size: int, action_size: int) -> Any:
    """Random transitions, as its trainer makes them of what an env gives."""
    import torch
    from agilerl.components.data import MultiAgentTransition, transition_to_tensordict

    rows = transition_to_tensordict(
        MultiAgentTransition(
            obs=per_agent(n_agents, n_rows, obs_size),
            action=per_agent(n_agents, n_rows, action_size),
            reward=per_agent(n_agents, n_rows),
            next_obs=per_agent(n_agents, n_rows, obs_size),
            done={distinct(i): np.zeros(n_rows, dtype=np.float32) for i in range(n_agents)},
        )
    )
    rows.batch_size = torch.Size([n_rows])
    return rows


def full_memory(*sizes: int) -> Any:
    import torch
    from agilerl.components.replay_buffer import ReplayBuffer

    torch.set_num_threads(1)
    memory = ReplayBuffer(BUFFER_SIZE)
    memory.add(transitions(BUFFER_SIZE, *sizes))
    return memory


def update(*sizes: int) -> Work:
    agents, memory = sized(*sizes), full_memory(*sizes)
    return Work(lambda: agents.learn(memory.sample(BATCH_SIZE)), note=NOTE)


def predict(n_agents: int, obs_size: int, action_size: int, n_rows: int) -> Work:
    agents, seen = sized(n_agents, obs_size, action_size), per_agent(n_agents, n_rows, obs_size)
    agents.set_training_mode(False)
    return Work(lambda: agents.get_action(seen), note="NumPy to NumPy; actors 64-64-64")


def uniform_sample() -> Work:
    memory = full_memory(*UPDATES["update-28"])
    return Work(lambda: memory.sample(BATCH_SIZE), note="returns a tensordict with an entry per agent")


def uniform_add() -> Work:
    sizes = UPDATES["update-28"]
    memory, row = full_memory(*sizes), transitions(1, *sizes)
    return Work(lambda: memory.add(row), note="takes a tensordict with an entry per agent, made before")


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
            **cases(update=update, predict=predict, train=train),
            "uniform-sample": uniform_sample,
            "uniform-add": uniform_add,
        },
    )
