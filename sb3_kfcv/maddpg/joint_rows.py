"""
What an update computes of its minibatch beside the networks. On the CPU each formula is one compiled loop over the rows: as
several operations of PyTorch it takes longer to begin than to do. Other shapes than those that are asked for are PyTorch's to
spread or to refuse.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_kfcv.common.kernels import kernel
from sb3_kfcv.common.live import shares


def critic_inputs(seen: th.Tensor, actions: th.Tensor, present: th.Tensor, agent_of_column: th.Tensor) -> th.Tensor:
    """
    What critics of all agents read: what there is to see, then the actions, 0 where the agent is not there.

    :param seen: all observations, or the world's state (batch, features)
    :param actions: (batch, joint action)
    :param present: 1 where the agent is there, or 0 (batch, agents)
    :param agent_of_column: whose each column of the joint action is (joint action,)
    :return: (batch, features + joint action)
    """
    fits = len(seen) == len(actions) == len(present) and actions.shape[1:] == agent_of_column.shape
    if not (fits and _compiled(seen, actions, present)):
        return th.cat([seen, actions * present.index_select(1, agent_of_column)], dim=1)
    inputs = seen.new_empty(len(seen), seen.shape[1] + actions.shape[1])
    _fill_inputs(_arrays(seen, actions, present, agent_of_column), inputs.numpy())
    return inputs


def loss_shares(alive: th.Tensor, agents: th.Tensor) -> th.Tensor:
    """
    The share of each row in its agent's loss: equal ones of those in which it lives, see :func:`shares`.

    :param alive: 1 where the agent lives, or 0 (batch, all agents)
    :param agents: which agents (agents,)
    :return: (agents, batch)
    """
    if not _compiled(alive):
        return shares(alive.T[agents])
    found = alive.new_empty(len(agents), len(alive))
    _fill_shares(_arrays(alive, agents), found.numpy())
    return found


def td_targets(
    rewards: th.Tensor, continues: th.Tensor, next_q_values: th.Tensor, agents: th.Tensor, gamma: float
) -> th.Tensor:
    """
    y = r + γ Q' (eq. 5), with the lowest of the critics' Q', and without it where the agent does not go on.

    :param rewards: (batch, all agents)
    :param continues: 1 where the agent goes on, or 0 (batch, all agents)
    :param next_q_values: Q' (critics, agents, batch)
    :param agents: which agents (agents,)
    :param gamma: discount factor
    :return: (agents, batch)
    """
    fits = rewards.shape == continues.shape and next_q_values.shape[1:] == (len(agents), len(rewards))
    if not (fits and _compiled(rewards, continues, next_q_values)):
        rewards, continues = rewards.T[agents], continues.T[agents]
        return th.addcmul(rewards, continues, next_q_values.amin(0), value=gamma)
    targets = th.empty_like(next_q_values[0])
    _fill_targets(_arrays(rewards, continues, next_q_values, agents), gamma, targets.numpy())
    return targets


def _compiled(*tensors: th.Tensor) -> bool:
    return all(tensor.is_cpu and tensor.dtype == th.float32 for tensor in tensors)


def _arrays(*tensors: th.Tensor) -> tuple[Any, ...]:
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)


@kernel
def _require_agents(agents, values):
    """There is no look at bounds in compiled code."""
    for agent in agents:
        if not 0 <= agent < values.shape[1]:
            raise IndexError("there is no such agent in these rows")


@kernel
def _fill_inputs(given, inputs):
    seen, actions, present, agent_of_column = given
    n_seen = seen.shape[1]
    _require_agents(agent_of_column, present)
    for row in range(seen.shape[0]):
        for column in range(n_seen):
            inputs[row, column] = seen[row, column]
        for column, agent in enumerate(agent_of_column):
            inputs[row, n_seen + column] = actions[row, column] * present[row, agent]


@kernel
def _fill_shares(given, found):
    alive, agents = given
    _require_agents(agents, alive)
    for position, agent in enumerate(agents):
        living = np.float32(0)
        for row in range(alive.shape[0]):
            living += alive[row, agent]
        for row in range(alive.shape[0]):
            found[position, row] = alive[row, agent] / max(living, np.float32(1))


@kernel
def _fill_targets(given, gamma, targets):
    rewards, continues, next_q_values, agents = given
    _require_agents(agents, rewards)
    for position, agent in enumerate(agents):
        for row in range(rewards.shape[0]):
            lowest = next_q_values[0, position, row]
            for critic in range(1, next_q_values.shape[0]):
                value = next_q_values[critic, position, row]
                if value < lowest or np.isnan(value):
                    lowest = value
            targets[position, row] = rewards[row, agent] + np.float32(gamma) * continues[row, agent] * lowest
