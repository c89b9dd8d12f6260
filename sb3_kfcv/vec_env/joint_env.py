"""A PettingZoo parallel env as one Gymnasium env: one slot is one whole world."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_kfcv.common.checks import require_finite, require_finite_columns
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.vec_env.scalar_reward import scalar_weights


class JointEnv(gym.Env):
    """
    The agents' observations and actions laid side by side, one scalar reward, everything per agent in the info:

    ========================  =======================================================================================
    ``agent_rewards``         float32 (agents,)
    ``agent_terminated``      bool (agents,): gone, by death or because the world ended; a time limit is not a death
    ``agent_alive``           bool (agents,): alive at the start of the step
    ``state``, ``next_state`` float32 (state,): the world before and after the step, where the env has a ``state()``
    ``episode_metrics``       dict of floats, at the episode's end: the world's own metrics and ``return_<group>``, the
                              mean over the group's agents; each stands in the info by its own name, too
    ========================  =======================================================================================

    The observation of an agent that is gone is zeros. An observation, reward or state that is infinite or NaN raises
    :class:`~sb3_kfcv.common.checks.NonFiniteError` with the name of the agent, before anything learns from it.

    :param env: the parallel env
    :param reward: the scalar: ``"mean"`` or ``"sum"`` over all agents, the mean of a group by its name, or
        ``"default"``: what the env declares in ``scalar_reward``, else ``"mean"``
    """

    def __init__(self, env: ParallelEnv, reward: str = "default") -> None:
        self.parallel_env = env
        self.render_mode = getattr(env, "render_mode", None)
        self.metadata = {"render_modes": [], **getattr(env, "metadata", {})}
        agents = list(env.possible_agents)
        observation_spaces = {agent: env.observation_space(agent) for agent in agents}
        action_spaces = {agent: env.action_space(agent) for agent in agents}
        self.layout = AgentLayout.from_spaces(agents, observation_spaces, action_spaces, state_size(env))
        self.observation_space = joint_box([observation_spaces[agent] for agent in agents])
        self.action_space = (
            spaces.MultiDiscrete(list(self.layout.action_sizes))
            if self.layout.discrete
            else joint_box([action_spaces[agent] for agent in agents])
        )
        self._columns = dict(zip(agents, self.layout.obs_slices, strict=True))
        self._places = {agent: slice(i, i + 1) for i, agent in enumerate(agents)}
        self.wins = dict(getattr(env, "wins", {}))
        self._weights = scalar_weights(self.layout, getattr(env, "scalar_reward", "mean") if reward == "default" else reward)
        self._world_metrics = tuple(getattr(env, "metric_names", ()))
        self.metric_names = (*self._world_metrics, *(f"return_{group}" for group in self.layout.group_names))
        self._returns = np.zeros(len(agents))
        self._gone = np.zeros(len(agents), dtype=bool)
        self._state: np.ndarray | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        observations, _ = self.parallel_env.reset(seed=seed, options=options)
        self._returns[:] = 0
        self._gone[:] = [agent not in self.parallel_env.agents for agent in self.layout.agents]
        self._state = self._read_state()
        return self._join(observations), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        env, names = self.parallel_env, self.layout.agents
        alive = np.array([agent in env.agents for agent in names])
        chosen = self._split(np.asarray(action))
        observations, rewards, terminations, _, _ = env.step({agent: chosen[agent] for agent in env.agents})
        agent_rewards = np.array([rewards.get(agent, 0.0) for agent in names], dtype=np.float32)
        require_finite_columns("reward", agent_rewards, self._places)
        present = np.array([agent in env.agents for agent in names])
        self._gone = (self._gone | [bool(terminations.get(agent, False)) for agent in names]) & ~present
        self._returns += agent_rewards
        over = not env.agents
        truncated = over and not self._gone.all()
        info: dict[str, Any] = {
            "agent_rewards": agent_rewards,
            "agent_terminated": self._gone.copy(),
            "agent_alive": alive,
        }
        if self.layout.state_size:
            info["state"], info["next_state"] = self._state, self._read_state()
            self._state = info["next_state"]
        if over:
            info["episode_metrics"] = self._metrics()
            info.update(info["episode_metrics"])
        return self._join(observations), float(self._weights @ agent_rewards), over and not truncated, truncated, info

    def render(self) -> Any:
        return self.parallel_env.render()

    def close(self) -> None:
        self.parallel_env.close()

    def get_state(self) -> dict[str, Any]:
        """
        Everything that the world and its episode are made of, as plain values; see :meth:`set_state`.

        :raises AttributeError: if the parallel env has no ``get_state()``
        """
        state = {"returns": self._returns.copy(), "gone": self._gone.copy(), "state": self._state}
        return {**state, "world": self.parallel_env.get_state()}  # type: ignore[attr-defined]

    def set_state(self, saved: dict[str, Any]) -> None:
        """Continue exactly where :meth:`get_state` was called."""
        self._returns[:], self._gone[:], self._state = saved["returns"], saved["gone"], saved["state"]
        self.parallel_env.set_state(saved["world"])  # type: ignore[attr-defined]

    def _join(self, observations: dict[str, np.ndarray]) -> np.ndarray:
        row = np.zeros(sum(self.layout.obs_sizes), dtype=np.float32)
        for agent, columns, gone in zip(self.layout.agents, self.layout.obs_slices, self._gone, strict=True):
            if agent in observations and not gone:
                row[columns] = observations[agent]
        require_finite_columns("observation", row, self._columns)
        return row

    def _split(self, action: np.ndarray) -> dict[str, Any]:
        if action.shape != self.action_space.shape:
            raise ValueError(f"a joint action has the shape {self.action_space.shape}; got {action.shape}")
        if self.layout.discrete:
            return {agent: int(choice) for agent, choice in zip(self.layout.agents, action, strict=True)}
        return {agent: action[columns] for agent, columns in zip(self.layout.agents, self.layout.action_slices, strict=True)}

    def _read_state(self) -> np.ndarray | None:
        if not self.layout.state_size:
            return None
        state = np.array(self.parallel_env.state(), dtype=np.float32).ravel()
        require_finite("the world's state", state)
        return state

    def _metrics(self) -> dict[str, float]:
        own = self.parallel_env.episode_metrics() if self._world_metrics else {}
        returns = self.layout.group_means(self._returns)
        return {**own, **{f"return_{group}": float(value) for group, value in returns.items()}}


def joint_box(boxes: list[Any]) -> spaces.Box:
    """The boxes side by side, as float32."""
    low, high = (np.concatenate([getattr(box, side) for box in boxes]).astype(np.float32) for side in ("low", "high"))
    return spaces.Box(low, high, dtype=np.float32)


def state_size(env: ParallelEnv) -> int:
    """Length of the env's ``state()``; 0 if it declares no ``state_space``."""
    space = getattr(env, "state_space", None)
    return 0 if space is None else int(np.prod(space.shape))
