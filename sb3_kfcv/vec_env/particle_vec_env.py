"""Our compiled worlds as an SB3 vec env: one slot is one whole world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvStepReturn

from sb3_kfcv.common.kernels import kernel
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.envs.drawing import Scene, draw
from sb3_kfcv.envs.particle_worlds import ParticleWorlds
from sb3_kfcv.vec_env.joint_env import joint_box
from sb3_kfcv.vec_env.scalar_reward import scalar_weights


class ParticleVecEnv(VecEnv):
    """
    A batch of worlds, stepped by one compiled call, that gives what as many
    :class:`~sb3_kfcv.vec_env.joint_env.JointEnv` over single worlds give, in the same infos:

    =========================== ====================================================================================
    ``agent_rewards``           float32 (agents,)
    ``agent_terminated``        bool (agents,): gone, by death or because the world ended; a time limit is no death
    ``agent_alive``             bool (agents,): alive at the start of the step
    ``state``, ``next_state``   float32 (state,): the world before and after the step
    =========================== ====================================================================================

    and at the episode's end ``terminal_observation``, ``TimeLimit.truncated``, each of ``metric_names`` as a float, and
    all of these in the dict ``episode_metrics``; with a ``render_mode``, ``terminal_scene``. Arrays that were returned are
    never overwritten.

    As in SB3's ``DummyVecEnv``, ``seed(seed)`` gives world i the seed ``seed + i`` at the next reset.

    :param worlds: the worlds
    :param reward: the scalar: ``"mean"`` or ``"sum"`` over all agents, the mean of a group by its name, or
        ``"default"``: what the worlds declare in ``scalar_reward``
    :param render_mode: ``"rgb_array"`` or None
    """

    def __init__(self, worlds: ParticleWorlds, reward: str = "default", render_mode: str | None = None):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"unknown render_mode {render_mode!r}; a batch of worlds has 'rgb_array' and None")
        self.worlds = worlds
        self.render_mode = render_mode
        observation_spaces: dict[str, spaces.Space] = {agent: worlds.observation_space(agent) for agent in worlds.agents}
        action_spaces = {agent: worlds.action_space(agent) for agent in worlds.agents}
        self.layout = AgentLayout.from_spaces(worlds.agents, observation_spaces, action_spaces, worlds.state_size)
        self.metric_names = (*worlds.metric_names, *(f"return_{group}" for group in self.layout.group_names))
        self._weights = scalar_weights(self.layout, worlds.scalar_reward if reward == "default" else reward)
        self._actions = np.empty(0)
        self._views = [_OneWorld(self, i) for i in range(worlds.n_worlds)]
        super().__init__(
            worlds.n_worlds,
            joint_box(list(observation_spaces.values())),
            spaces.MultiDiscrete(list(self.layout.action_sizes))
            if self.layout.discrete
            else joint_box(list(action_spaces.values())),
        )
        self.metadata = {**self.metadata, "render_fps": worlds.render_fps}  # type: ignore[dict-item]

    def reset(self) -> np.ndarray:
        """
        Start an episode in every world, after seeding the worlds if :meth:`seed` was called.

        :return: joint observations, float32 (worlds, observation)
        """
        if self._seeds[0] is not None:
            self.worlds.seed(self._seeds)
        self._reset_seeds()
        self._reset_options()
        self.worlds.reset()
        return self.worlds.observations.copy()

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        worlds = self.worlds
        states = worlds.states()
        worlds.step(self._split(self._actions))
        rewards = _weighted_sums(worlds.rewards, self._weights)
        dones = worlds.episode_terminated | worlds.episode_truncated
        infos: list[dict[str, Any]] = [
            {
                "agent_rewards": agent_rewards,
                "agent_terminated": agent_terminated,
                "agent_alive": agent_alive,
                "state": state,
                "next_state": next_state,
            }
            for agent_rewards, agent_terminated, agent_alive, state, next_state in zip(
                worlds.rewards.copy(),
                worlds.terminated.copy(),
                worlds.alive_before.copy(),
                states,
                worlds.states(),
                strict=True,
            )
        ]
        observations = worlds.observations.copy()
        if dones.any():
            ended = np.flatnonzero(dones)
            self._describe_ends(infos, observations, ended)
            worlds.reset(ended)
            observations[ended] = worlds.observations[ended]
        return observations, rewards, dones, infos

    def _split(self, actions: np.ndarray) -> np.ndarray:
        """Joint actions, (worlds, action), as the worlds take them: per agent."""
        shape = (self.num_envs, *(self.action_space.shape or ()))
        if np.shape(actions) != shape:
            raise ValueError(
                f"actions have shape {np.shape(actions)}; {self.num_envs} worlds take joint rows of shape {shape}"
            )
        return actions if self.layout.discrete else np.reshape(actions, (self.num_envs, self.layout.n_agents, 2))

    def _describe_ends(self, infos: list[dict[str, Any]], observations: np.ndarray, ended: np.ndarray) -> None:
        """
        Add what belongs to an episode's end.

        :param infos: one per world, those of the ended ones are added to
        :param observations: joint observations before the auto-reset, (worlds, observation)
        :param ended: indices of the worlds whose episode ended
        """
        group_returns = self.layout.group_means(self.worlds.returns[ended])
        columns = np.column_stack([self.worlds.episode_metrics()[ended], *group_returns.values()])
        truncated = self.worlds.episode_truncated[ended].tolist()
        for world, values, cut, last in zip(ended, columns.tolist(), truncated, observations[ended], strict=True):
            metrics = dict(zip(self.metric_names, values, strict=True))
            infos[world].update(metrics, episode_metrics=metrics, terminal_observation=last)
            infos[world]["TimeLimit.truncated"] = cut
            if self.render_mode is not None:
                infos[world]["terminal_scene"] = self.worlds.scene(world)

    def close(self) -> None:
        """There is nothing to release."""

    def get_images(self) -> Sequence[np.ndarray | None]:
        return [view.render() for view in self._views]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Attribute of each world's view, of the vec env, or of ``worlds``, whichever has it first."""
        return [self._views[i].find(attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of ``worlds``, or of the vec env where that has it.

        :raises ValueError: for some of the worlds only, since settings belong to the batch
        """
        if set(self._get_indices(indices)) != set(range(self.num_envs)):
            raise ValueError(f"the worlds of a batch share {attr_name!r}; set it for all of them")
        setattr(self if hasattr(self, attr_name) else self.worlds, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call ``state``, ``get_state``, ``set_state``, ``episode_metrics``, ``render`` or ``scene`` of single worlds."""
        return [getattr(self._views[i], method_name)(*method_args, **method_kwargs) for i in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


class _OneWorld:
    """
    One world of the batch, with the methods of :class:`~sb3_kfcv.envs.parallel_env.ParticleParallelEnv` that need no step.

    :param vec_env: the batch
    :param index: which world
    """

    def __init__(self, vec_env: ParticleVecEnv, index: int):
        self._vec_env = vec_env
        self._index = index

    def state(self) -> np.ndarray:
        """The true state, float32 (state_size,)."""
        return self._vec_env.worlds.states()[self._index]

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the world is made of; see :meth:`set_state`."""
        return self._vec_env.worlds.get_world(self._index)

    def set_state(self, saved: dict[str, np.ndarray]) -> None:
        """Continue exactly where :meth:`get_state` was called."""
        self._vec_env.worlds.set_world(self._index, saved)

    def episode_metrics(self) -> dict[str, float]:
        """Metrics of the episode so far, by name."""
        worlds = self._vec_env.worlds
        return dict(zip(worlds.metric_names, worlds.episode_metrics()[self._index].tolist(), strict=True))

    def scene(self) -> Scene:
        """What there is to draw."""
        return self._vec_env.worlds.scene(self._index)

    def render(self) -> np.ndarray | None:
        """Picture of the world, uint8 (height, width, 3), in the mode ``"rgb_array"``."""
        return draw(self.scene()) if self._vec_env.render_mode == "rgb_array" else None

    def find(self, name: str) -> Any:
        """
        :raises AttributeError: if neither the world, nor the vec env, nor the batch has an attribute of this name
        """
        for owner in (self, self._vec_env):
            if hasattr(owner, name):
                return getattr(owner, name)
        return getattr(self._vec_env.worlds, name)


@kernel
def _weighted_sums(values, weights):
    """
    Weighted sum of each row, added up in order: a row's sum does not depend on how many rows there are.

    :param values: (worlds, agents)
    :param weights: (agents,)
    :return: (worlds,) float32
    """
    sums = np.empty(values.shape[0], dtype=np.float32)
    for row in range(values.shape[0]):
        total = 0.0
        for column in range(values.shape[1]):
            total += values[row, column] * weights[column]
        sums[row] = total
    return sums
