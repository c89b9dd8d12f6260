"""A PettingZoo parallel env as one Gymnasium env: one slot is one whole world."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_kfcv.common.checks import require_finite, require_finite_columns
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.vec_env.agent_spaces import flat_action, flat_observation
from sb3_kfcv.vec_env.scalar_reward import scalar_weights


class JointEnv(gym.Env):
    """
    The agents' observations and actions laid side by side, one scalar reward, everything per agent in the info:

    ========================  =======================================================================================
    ``agent_rewards``         float32 (agents,)
    ``agent_terminated``      bool (agents,): not in the world after the step, by death, because the world ended, or since
                              it has not joined yet; an agent that a time limit cuts off in this step is not
    ``agent_alive``           bool (agents,): in the world at the start of the step
    ``state``, ``next_state`` float32 (state,): the world before and after the step, where the env has a ``state_space``
    ``episode_metrics``       dict of floats, at the episode's end: the world's own metrics and ``return_<group>``, the
                              mean over the group's agents; each stands in the info by its own name, too
    ``terminal_picture``      at the episode's end, in the mode ``"rgb_array"``: the world before its next reset
    ========================  =======================================================================================

    Agents may differ in their spaces, die, join late, come back, and be cut off one by one; whoever is not in the world has
    an observation of zeros. Observations are vectors or are flattened; actions are bounded vectors, or choices
    (see :mod:`~sb3_kfcv.vec_env.agent_spaces`). An observation, reward or state that is infinite or NaN raises
    :class:`~sb3_kfcv.common.checks.NonFiniteError` with the name of the agent, before anything learns from it.

    :param env: the parallel env
    :param reward: the scalar: ``"mean"`` or ``"sum"`` over all agents, the mean of a group by its name, or
        ``"default"``: what the env declares in ``scalar_reward``, else ``"mean"``
    :raises ValueError: if the env does not say who may take part, or for a space that cannot be joined; while it runs, for an
        agent that is not among ``possible_agents`` or whose spaces change
    """

    def __init__(self, env: ParallelEnv, reward: str = "default") -> None:
        self.parallel_env = env
        self.render_mode = getattr(env, "render_mode", None)
        self.metadata = {"render_modes": [], **getattr(env, "metadata", {})}
        self._agents = tuple(getattr(env, "possible_agents", ()))
        if not self._agents:
            raise ValueError(
                f"{env} lists no possible_agents: a joint world must know beforehand who may take part, and with what spaces"
            )
        names = {agent: str(agent) for agent in self._agents}  # PettingZoo allows any hashable
        self._spaces = {agent: (env.observation_space(agent), env.action_space(agent)) for agent in self._agents}
        seen = {name: flat_observation(name, self._spaces[agent][0]) for agent, name in names.items()}
        acting = {name: flat_action(name, self._spaces[agent][1]) for agent, name in names.items()}
        observation_spaces: dict[str, spaces.Space] = {name: space for name, (space, _) in seen.items()}
        action_spaces: dict[str, spaces.Space] = {name: space for name, (space, _) in acting.items()}
        self.layout = AgentLayout.from_spaces(list(names.values()), observation_spaces, action_spaces, state_size(env))
        self.observation_space = joint_box(list(observation_spaces.values()))
        self.action_space = (
            spaces.MultiDiscrete(list(self.layout.action_sizes))
            if self.layout.discrete
            else joint_box(list(action_spaces.values()))
        )
        self._known = frozenset(self._agents)
        self._innermost = env.unwrapped
        self._readings = [
            (columns, (size,), seen[name][1])
            for columns, size, name in zip(self.layout.obs_slices, self.layout.obs_sizes, names.values(), strict=True)
        ]
        self._own_actions = {agent: own for agent, name in names.items() if (own := acting[name][1]) is not None}
        self._columns = dict(zip(self.layout.agents, self.layout.obs_slices, strict=True))
        self._places = {name: slice(i, i + 1) for i, name in enumerate(self.layout.agents)}
        self.wins = dict(getattr(env, "wins", {}))
        self.facts = dict(getattr(env, "facts", {}))
        self._weights = scalar_weights(self.layout, getattr(env, "scalar_reward", "mean") if reward == "default" else reward)
        self._world_metrics = tuple(getattr(env, "metric_names", ()))
        self.metric_names = (*self._world_metrics, *(f"return_{group}" for group in self.layout.group_names))
        self._returns = np.zeros(len(self._agents))
        self._present = np.zeros(len(self._agents), dtype=bool)  # takes part in the next step
        self._gone = ~self._present
        self._state: np.ndarray | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        observations, _ = self.parallel_env.reset(seed=seed, options=options)
        self._returns[:] = 0
        self._present = self._find_present({}, {})
        self._gone = ~self._present
        self._check_spaces(self.parallel_env.agents)
        self._state = self._read_state()
        return self._join(observations), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        env, alive = self.parallel_env, self._present
        chosen = self._split(np.asarray(action))
        observations, rewards, terminations, truncations, _ = env.step({agent: chosen[agent] for agent in env.agents})
        agent_rewards = np.array([rewards.get(agent, 0.0) for agent in self._agents], dtype=np.float32)
        require_finite_columns("reward", agent_rewards, self._places)
        self._present = present = self._find_present(terminations, truncations)
        self._gone = ~present
        if self._gone.any():
            self._gone &= ~alive | [bool(terminations.get(agent, False)) for agent in self._agents]
        if not alive.all():
            self._check_spaces(self._agents[i] for i in np.flatnonzero(present & ~alive))
        self._returns += agent_rewards
        over = not present.any()
        truncated = over and not self._gone.all()
        info: dict[str, Any] = {"agent_rewards": agent_rewards, "agent_terminated": self._gone, "agent_alive": alive}
        if self.layout.state_size:
            info["state"], info["next_state"] = self._state, self._read_state()
            self._state = info["next_state"]
        if over:
            info["episode_metrics"] = self._metrics()
            info.update(info["episode_metrics"])
            if self.render_mode == "rgb_array":
                info["terminal_picture"] = self.render()
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
        self._returns[:], self._gone, self._state = saved["returns"], saved["gone"].copy(), saved["state"]
        self.parallel_env.set_state(saved["world"])  # type: ignore[attr-defined]
        self._present = self._find_present({}, {})

    def _find_present(self, terminations: dict[Any, bool], truncations: dict[Any, bool]) -> np.ndarray:
        """
        Who takes part in the next step.

        :param terminations: of the step that has just been made, as PettingZoo gives them
        :param truncations: likewise
        :return: bool (agents,)
        """
        present = set(self.parallel_env.agents)
        if not present <= self._known:
            strangers = ", ".join(repr(agent) for agent in present - self._known)
            raise ValueError(f"{strangers} joined the world, which has the possible_agents {', '.join(self.layout.agents)}")
        if present and not self._innermost.agents:
            raise ValueError(
                f"{self.parallel_env} goes on although its world has ended: a wrapper such as SuperSuit's black_death hides "
                "ends and deaths from learning; leave it out, agents that are gone have rows of zeros here"
            )
        if any(terminations.values()) or any(truncations.values()):
            ended = {agent for flags in (terminations, truncations) for agent, flag in flags.items() if flag}
            present -= ended  # some worlds leave this to the next reset
        return np.array([agent in present for agent in self._agents])

    def _check_spaces(self, agents: Iterable[Any]) -> None:
        """
        :param agents: who has just entered the world
        :raises ValueError: if a space is another one than at the start
        """
        for agent in agents:
            now = self.parallel_env.observation_space(agent), self.parallel_env.action_space(agent)
            for kind, space, known in zip(("observation", "action"), now, self._spaces[agent], strict=True):
                if space is not known and space != known:
                    raise ValueError(
                        f"the {kind} space of {str(agent)!r} was {known} and has become {space}; "
                        "agents of a joint world keep their spaces"
                    )

    def _join(self, observations: dict[Any, Any]) -> np.ndarray:
        row = np.zeros(sum(self.layout.obs_sizes), dtype=np.float32)
        for agent, (columns, shape, flatten), gone in zip(self._agents, self._readings, self._gone.tolist(), strict=True):
            if agent in observations and not gone:
                values = (
                    np.asarray(observations[agent]) if flatten is None else self._flat(agent, observations[agent], flatten)
                )
                if values.shape != shape:
                    raise ValueError(self._misfit(agent, observations[agent]))
                row[columns] = values
        require_finite_columns("observation", row, self._columns)
        return row

    def _flat(self, agent: Any, observation: Any, flatten: Any) -> np.ndarray:
        try:
            return flatten(observation)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError):
            raise ValueError(self._misfit(agent, observation)) from None

    def _misfit(self, agent: Any, observation: Any) -> str:
        space, now = self._spaces[agent][0], self.parallel_env.observation_space(agent)
        given = f"an array of shape {observation.shape}" if isinstance(observation, np.ndarray) else repr(observation)
        change = "" if now == space else f" and has become {now}"
        return (
            f"an observation of {str(agent)!r} is {given}, its observation space was {space}{change}; "
            "agents of a joint world keep their spaces"
        )

    def _split(self, action: np.ndarray) -> dict[Any, Any]:
        if action.shape != self.action_space.shape:
            raise ValueError(f"a joint action has the shape {self.action_space.shape}; got {action.shape}")
        if self.layout.discrete:
            chosen: dict[Any, Any] = {agent: int(choice) for agent, choice in zip(self._agents, action.tolist(), strict=True)}
        else:
            chosen = {agent: action[columns] for agent, columns in zip(self._agents, self.layout.action_slices, strict=True)}
        for agent, own in self._own_actions.items():
            chosen[agent] = own(chosen[agent])
        return chosen

    def _read_state(self) -> np.ndarray | None:
        if not self.layout.state_size:
            return None
        state = np.array(self.parallel_env.state(), dtype=np.float32).ravel()
        if state.size != self.layout.state_size:
            raise ValueError(f"the world's state has {state.size} numbers; its state_space says {self.layout.state_size}")
        require_finite("the world's state", state)
        return state

    def _metrics(self) -> dict[str, float]:
        own = self.parallel_env.episode_metrics() if self._world_metrics else {}  # type: ignore[attr-defined]
        returns = self.layout.group_means(self._returns)
        return {**own, **{f"return_{group}": float(value) for group, value in returns.items()}}


def joint_box(boxes: list[Any]) -> spaces.Box:
    """The boxes side by side, as float32."""
    with np.errstate(over="ignore"):  # a bound beyond float32 is none
        low, high = (np.concatenate([getattr(box, side) for box in boxes]).astype(np.float32) for side in ("low", "high"))
    return spaces.Box(low, high, dtype=np.float32)


def state_size(env: ParallelEnv) -> int:
    """Length of the env's ``state()``, an array; 0 if it declares no ``state_space`` with a shape."""
    shape = getattr(getattr(env, "state_space", None), "shape", None)
    return 0 if shape is None else int(np.prod(shape))
