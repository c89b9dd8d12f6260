"""SB3's loop on joint worlds: what every algorithm here shares, whatever it learns."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_kfcv.common.checks import require_finite_columns
from sb3_kfcv.common.patient_logs import patience
from sb3_kfcv.saving.saveable import SaveableAlgorithm
from sb3_kfcv.vec_env.make import env_named, facts_of, layout_of, wrap_env

SelfJoint = TypeVar("SelfJoint", bound="JointAlgorithm")

# Log formats that cannot show a histogram.
NOT_TENSORBOARD = ("stdout", "log", "json", "csv")


class JointAlgorithm(SaveableAlgorithm):
    """
    An off-policy algorithm whose env is a joint world: PettingZoo envs are wrapped, transitions are checked before anything
    learns from them, and the worlds' metrics are logged beside SB3's series.

    :param policy: as of SB3's ``OffPolicyAlgorithm``
    :param env: likewise; also the name of a PettingZoo world, such as ``mpe2/simple_tag_v3``
    :param args: likewise
    :param kwargs: likewise
    """

    def __init__(self, policy: Any, env: Any, *args: Any, **kwargs: Any) -> None:
        super().__init__(  # type: ignore[misc]
            policy,
            env_named(env),
            *args,
            sde_support=False,
            supported_action_spaces=(spaces.Box, spaces.MultiDiscrete),
            support_multi_env=True,
            **kwargs,
        )
        self._episode_metrics: deque[dict[str, float]] = deque(maxlen=self._stats_window_size)
        self.world_facts: dict[str, float] = {} if self.env is None else facts_of(self.env)  # for scripted opponents
        if self.env is not None:
            self.layout = layout_of(self.env)

    def check_settings(self) -> None:
        """
        Refuse what cannot train, before anything is built.

        :raises ValueError: one sentence that says what is wrong
        """
        raise NotImplementedError

    def series(self) -> dict[str, Any]:
        """Diagnostics of the learning, for the log: numbers and, for histograms, tensors."""
        raise NotImplementedError

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        return OffPolicyAlgorithm._wrap_env(wrap_env(env, monitor_wrapper), verbose, monitor_wrapper)

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """
        Go on in another env, as in SB3.

        :param env: whatever the constructor takes
        :param force_reset: reset it before the next step
        :raises ValueError: if its agents are not those that the model was made for
        """
        env = self._wrap_env(maybe_make_env(env_named(env), self.verbose), self.verbose)
        if layout_of(env) != self.layout:
            raise ValueError(f"the model is for {self.layout}; the env has {layout_of(env)}")
        super().set_env(env, force_reset)
        self._vec_normalize_env = unwrap_vec_normalize(env)
        self.check_settings()

    def learn(
        self: SelfJoint,
        total_timesteps: int = 100_000,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfJoint:
        """
        Learn; as in SB3, with a default length.

        :param total_timesteps: env steps, summed over the worlds of the vec env
        :param callback: called at every step
        :param log_interval: episodes between log entries; ``None`` logs nothing
        :param tb_log_name: name of the run in the TensorBoard folder; by default the algorithm's
        :param reset_num_timesteps: start counting anew
        :param progress_bar: show progress and time left
        :raises ValueError: if the model was released for playing only
        """
        self.require_learner()
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name or type(self).__name__,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        As in SB3, after a look at what came from the worlds.

        :raises NonFiniteError: names the agent whose observation or reward is not finite
        """
        columns = self.columns_of(self.layout.obs_slices)
        require_finite_columns("observation", np.asarray(new_obs), columns)
        for world in np.flatnonzero(dones):
            require_finite_columns("last observation", np.asarray(infos[world]["terminal_observation"]), columns)
        if not math.isfinite(reward.sum()):
            rewards = np.array([info["agent_rewards"] for info in infos])
            require_finite_columns("reward", rewards, {name: slice(i, i + 1) for i, name in enumerate(self.layout.agents)})
        if dones.any() or self._vec_normalize_env is not None:
            super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)  # type: ignore[arg-type]
        else:  # the same without a copy of all observations, in which the last ones of ended episodes would be put
            replay_buffer.add(self._last_obs, new_obs, buffer_action, reward, dones, infos)  # type: ignore[arg-type]
            self._last_original_obs, self._last_obs = self._last_obs, new_obs  # type: ignore[assignment]
        if dones.any():
            self.episodes_ended(dones, infos)

    def episodes_ended(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """
        Called when episodes have ended and their last transitions are stored.

        :param dones: bool (worlds,): where
        :param infos: of all worlds
        """

    def columns_of(self, slices: Sequence[slice]) -> dict[str, slice]:
        """Slices of the agents by their names."""
        return dict(zip(self.layout.agents, slices, strict=True))

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        super()._update_info_buffer(infos, dones)
        for info in infos:
            if "episode_metrics" in info:
                self._episode_metrics.append(info["episode_metrics"])

    def dump_logs(self) -> None:
        """Write the log: SB3's series, every episode metric of the world, the learner's and the replay's diagnostics."""
        for key in self._episode_metrics[0] if self._episode_metrics else ():
            self.logger.record(f"rollout/{key}", safe_mean([episode[key] for episode in self._episode_metrics]))
        for key, value in self.series().items():
            self.logger.record(key, value, exclude=NOT_TENSORBOARD if isinstance(value, th.Tensor) else None)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        with patience(self.logger):
            super().dump_logs()
