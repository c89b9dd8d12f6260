"""What a replay buffer asks of SB3's own algorithms: TD targets and Q-values, one small adapter per algorithm."""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium.spaces.utils import flatdim
from stable_baselines3 import DQN, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import preprocess_obs
from torch import nn

from sb3_kfcv.replay import JointReplayBufferSamples


@contextmanager
def own_draws(rng: np.random.Generator, device: th.device) -> Iterator[None]:
    """
    Inside, PyTorch draws from a stream of its own: what the learner draws is the same as without us.

    :param rng: gives the seed of that stream
    :param device: on which draws are made, beside the CPU
    """
    seed = int(rng.integers(2**63))
    on_gpu = device.type == "cuda"
    with th.random.fork_rng(devices=[device] if on_gpu else []):
        th.default_generator.manual_seed(seed)
        if on_gpu:
            with th.cuda.device(device):
                th.cuda.manual_seed(seed)
        yield


class StockStudent(ABC):
    """
    The :class:`~sb3_kfcv.replay.joint_replay_buffer.Student` that an algorithm of SB3 is: one learning agent. Nothing that is
    asked of it leaves a trace in the algorithm: no gradient, no random draw, no statistics of layers.

    :param model: the algorithm
    :param rng: for what is random in its TD targets
    """

    n_learning_agents = 1

    def __init__(self, model: OffPolicyAlgorithm, rng: np.random.Generator) -> None:
        self.model: Any = model
        self.rng = rng
        self.spaces = model.observation_space, model.action_space
        self.teacher_input_size = sum(flatdim(space) for space in self.spaces)

    @property
    @abstractmethod
    def critic(self) -> nn.Module:
        """The networks that the algorithm's loss of Q goes through."""

    @abstractmethod
    def next_values(self, next_observations: th.Tensor) -> th.Tensor:
        """What the TD target adds to the reward, before the discount, as the algorithm's ``train`` has it: (batch, 1)."""

    @abstractmethod
    def values(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """Q of the transitions by the first critic: (batch, 1)."""

    def td_target(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """y = r + γ V(s'), without the second term where the episode terminated: (1, batch)."""
        with self._aside():
            return (batch.rewards + (1 - batch.dones) * self.model.gamma * self.next_values(batch.next_observations)).T

    def q_values(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """(1, batch)"""
        with self._aside():
            return self.values(batch).T

    def teacher_inputs(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """Observation and action, choices as one-hot: (batch, features)."""
        given = zip((batch.observations, batch.actions), self.spaces, strict=True)
        seen: list[Any] = [preprocess_obs(values, space, normalize_images=False) for values, space in given]
        return th.cat([values.flatten(1) for values in seen], dim=1)

    def live(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """1 everywhere: (1, batch)."""
        return batch.alive.T

    @contextmanager
    def _aside(self) -> Iterator[None]:
        policy = self.model.policy
        training = policy.training
        policy.set_training_mode(False)
        try:
            with th.no_grad(), own_draws(self.rng, self.model.device):
                yield
        finally:
            policy.set_training_mode(training)


class DQNStudent(StockStudent):
    """DQN: the highest value of the target network."""

    @property
    def critic(self) -> nn.Module:
        return self.model.q_net

    def next_values(self, next_observations: th.Tensor) -> th.Tensor:
        return self.model.q_net_target(next_observations).amax(1, keepdim=True)

    def values(self, batch: JointReplayBufferSamples) -> th.Tensor:
        return self.model.q_net(batch.observations).gather(1, batch.actions.long())


class TD3Student(StockStudent):
    """TD3, and DDPG, which is TD3 without noise: the lowest target critic at the target actor's noisy action."""

    @property
    def critic(self) -> nn.Module:
        return self.model.critic

    def next_values(self, next_observations: th.Tensor) -> th.Tensor:
        model = self.model
        actions = model.actor_target(next_observations)
        noise, bound = model.target_policy_noise * th.randn_like(actions), model.target_noise_clip
        values = model.critic_target(next_observations, (actions + noise.clamp_(-bound, bound)).clamp_(-1, 1))
        return th.cat(values, dim=1).amin(1, keepdim=True)

    def values(self, batch: JointReplayBufferSamples) -> th.Tensor:
        return self.model.critic.q1_forward(batch.observations, batch.actions)


class SACStudent(StockStudent):
    """SAC: the lowest target critic at a draw of the actor, with its entropy."""

    @property
    def critic(self) -> nn.Module:
        return self.model.critic

    def next_values(self, next_observations: th.Tensor) -> th.Tensor:
        model = self.model
        actions, log_probabilities = model.actor.action_log_prob(next_observations)
        values = self.pessimistic(model.critic_target(next_observations, actions))
        learnt = model.ent_coef_optimizer is not None
        temperature = model.log_ent_coef.detach().exp() if learnt else model.ent_coef_tensor
        return values - temperature * log_probabilities.reshape(-1, 1)

    def pessimistic(self, estimates: Any) -> th.Tensor:
        """What the target critics say together: (batch, 1)."""
        return th.cat(estimates, dim=1).amin(1, keepdim=True)

    def values(self, batch: JointReplayBufferSamples) -> th.Tensor:
        return self.model.critic.q1_forward(batch.observations, batch.actions)


class TQCStudent(SACStudent):
    """sb3-contrib's TQC: SAC with quantiles, of which the target drops the highest; here their means, as Q-values are."""

    def pessimistic(self, estimates: th.Tensor) -> th.Tensor:
        model = self.model
        kept = model.critic.quantiles_total - model.top_quantiles_to_drop_per_net * model.critic.n_critics
        return estimates.flatten(1).sort(1).values[:, :kept].mean(1, keepdim=True)

    def values(self, batch: JointReplayBufferSamples) -> th.Tensor:
        return self.model.critic(batch.observations, batch.actions)[:, 0].mean(1, keepdim=True)


def students() -> dict[type[OffPolicyAlgorithm], type[StockStudent]]:
    """The algorithms that are known, and their adapters; a DDPG is a TD3."""
    known: dict[type[OffPolicyAlgorithm], type[StockStudent]] = {DQN: DQNStudent, TD3: TD3Student, SAC: SACStudent}
    contrib = sys.modules.get("sb3_contrib")  # without it there is no such model either
    return known if contrib is None else {**known, contrib.TQC: TQCStudent}


def student_class(model: OffPolicyAlgorithm) -> type[StockStudent]:
    """
    The adapter of an algorithm; a subclass of one that is known has its parent's.

    :raises ValueError: if there is none
    """
    for algorithm, student in students().items():
        if isinstance(model, algorithm):
            return student
    raise ValueError(
        f"no TD target is known of {type(model).__name__}; known are those of DDPG, DQN, SAC, TD3 and sb3-contrib's TQC, "
        "or write a StockStudent and give it as ReplayCallback(student=...)"
    )
