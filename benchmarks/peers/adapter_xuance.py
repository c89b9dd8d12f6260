"""
XuanCe: ``MADDPG_Agents`` with networks per agent (``use_parameter_sharing`` off).

- ``update``: built without envs from the spaces, its memory filled by ``store``; timed is ``train_epochs(1)``, which draws
  a minibatch and updates all agents.
- ``predict``: ``get_actions`` in test mode (no noise), on a list with a dict per joint observation.
- ``uniform``: ``store`` and ``sample`` of such a memory.
- ``train``: ``agents.train`` in PettingZoo's ``simple_spread`` (its vec env in one process, as many worlds as env steps per
  update, so that every round of steps is followed by one update). TensorBoard is its only logger without an account, and
  stays on.

``running_steps`` is far beyond the end: a run past it stops with an error, since the noise gets negative.
"""

from __future__ import annotations

import tempfile
from typing import Any

import numpy as np
from protocol import (
    BATCH_SIZE,
    BUFFER_SIZE,
    EPISODE_STEPS,
    GAMMA,
    HIDDEN,
    LEARNING_RATE,
    TAU,
    UPDATES,
    Work,
    cases,
    main,
)


def settings(n_envs: int) -> Any:
    """Its own settings for simple_spread, and ours over them."""
    import torch
    from xuance.common import get_arguments

    torch.set_num_threads(1)
    config = get_arguments("maddpg", "mpe", "simple_spread_v3")
    config.use_parameter_sharing = False
    config.actor_hidden_size = config.critic_hidden_size = list(HIDDEN)
    config.activation = "relu"
    config.batch_size, config.buffer_size = BATCH_SIZE, BUFFER_SIZE
    config.learning_rate_actor = config.learning_rate_critic = LEARNING_RATE
    config.gamma, config.tau = GAMMA, TAU
    config.parallels = n_envs
    config.start_training, config.running_steps = 2 * BATCH_SIZE, 100_000_000
    config.log_dir = config.model_dir = tempfile.mkdtemp()
    return config


def sized(n_agents: int, obs_size: int, action_size: int) -> Any:
    """A learner of the wanted sizes."""
    from gymnasium.spaces import Box
    from xuance.torch.agents import MADDPG_Agents

    names = [f"agent_{i}" for i in range(n_agents)]
    return MADDPG_Agents(
        settings(n_envs=1),
        num_agents=n_agents,
        agent_keys=names,
        observation_space={name: Box(-np.inf, np.inf, (obs_size,), np.float32) for name in names},
        action_space={name: Box(0.0, 1.0, (action_size,), np.float32) for name in names},
    )


def step(rng: np.random.Generator, n_agents: int, obs_size: int, action_size: int) -> dict[str, dict[str, np.ndarray]]:
    """A random transition of one world, as ``store`` takes it."""
    names = [f"agent_{i}" for i in range(n_agents)]

    def per_agent(*shape: int) -> dict[str, np.ndarray]:
        return {name: rng.random((1, *shape), dtype=np.float32) for name in names}

    return {
        "obs": per_agent(obs_size),
        "actions": per_agent(action_size),
        "obs_next": per_agent(obs_size),
        "rewards": per_agent(),
        "terminals": {name: np.zeros(1, dtype=bool) for name in names},
        "agent_mask": {name: np.ones(1, dtype=bool) for name in names},
    }


def full(*sizes: int) -> Any:
    """A learner whose memory is full."""
    agents, rng = sized(*sizes), np.random.default_rng(0)
    for _ in range(BUFFER_SIZE):
        agents.memory.store(**step(rng, *sizes))
    return agents


def update(*sizes: int) -> Work:
    agents = full(*sizes)
    return Work(lambda: agents.train_epochs(1), note="learning rates scheduled at each update")


def predict(n_agents: int, obs_size: int, action_size: int, n_rows: int) -> Work:
    agents, rng = sized(n_agents, obs_size, action_size), np.random.default_rng(0)
    seen = [{name: rng.random(obs_size, dtype=np.float32) for name in agents.agent_keys} for _ in range(n_rows)]
    return Work(lambda: agents.get_actions(obs_dict=seen, test_mode=True), note="NumPy to NumPy, a dict per joint observation")


def uniform_sample() -> Work:
    agents = full(*UPDATES["update-28"])
    return Work(agents.memory.sample, note="returns NumPy arrays per agent")


def uniform_add() -> Work:
    sizes = UPDATES["update-28"]
    agents, row = full(*sizes), step(np.random.default_rng(0), *sizes)
    return Work(lambda: agents.memory.store(**row), note="takes NumPy arrays per agent")


def train(steps_per_update: int) -> Work:
    from xuance.environment import make_envs
    from xuance.torch.agents import MADDPG_Agents

    config = settings(n_envs=steps_per_update)
    config.training_frequency = steps_per_update
    agents = MADDPG_Agents(config, make_envs(config))
    rounds = EPISODE_STEPS if steps_per_update > 10 else 2 * EPISODE_STEPS
    agents.train(rounds)
    return Work(
        lambda: agents.train(rounds),
        rounds * steps_per_update,
        f"PettingZoo's simple_spread, {steps_per_update} worlds in one process, actions of 5",
    )


if __name__ == "__main__":
    main(
        ["xuance", "torch", "pettingzoo", "numpy"],
        {
            **cases(update=update, predict=predict, train=train),
            "uniform-sample": uniform_sample,
            "uniform-add": uniform_add,
        },
    )
