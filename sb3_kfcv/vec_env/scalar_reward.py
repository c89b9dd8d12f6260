"""The one number that SB3's tools rank a world by."""

from __future__ import annotations

import numpy as np

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.naming import unknown_name


def scalar_weights(layout: AgentLayout, reward: str) -> np.ndarray:
    """
    Weights whose product with the agents' rewards is the world's scalar reward.

    :param layout: who sits where
    :param reward: ``"mean"`` or ``"sum"`` over all agents, or the name of a group, for the mean over it
    :return: (agents,) float32
    :raises ValueError: for another name
    """
    weights = np.zeros(layout.n_agents, dtype=np.float32)
    if reward == "sum":
        weights[:] = 1
    elif reward == "mean":
        weights[:] = 1 / layout.n_agents
    elif reward in layout.group_names:
        members = list(layout.members(reward))
        weights[members] = 1 / len(members)
    else:
        raise ValueError(unknown_name("group or scalar reward", reward, ["mean", "sum", *layout.group_names]))
    return weights
