"""Curriculum and prioritised replay for SB3's own algorithms of one agent."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_obs_shape
from stable_baselines3.common.vec_env import VecNormalize
from torch.utils.hooks import RemovableHandle

from sb3_kfcv.common.checks import require_parameters
from sb3_kfcv.curriculum import KFCVReplayBuffer
from sb3_kfcv.replay import JointReplayBuffer, JointReplayBufferSamples, PrioritizedReplayBuffer
from sb3_kfcv.replay.joint_replay_buffer import Minibatch
from sb3_kfcv.stock.students import StockStudent, own_draws

# What a pickled buffer leaves out: the algorithm that it serves, and what is made anew when it meets one.
NOT_PICKLED = ("student", "_learner", "_hook", "_drawn", "normalizer")


class StockReplay(JointReplayBuffer):
    """
    A joint buffer as SB3's own algorithms use one: a single agent, whose reward and end are the world's.

    What it draws uniformly it draws as SB3's ``ReplayBuffer`` does and from the same stream, NumPy's global one. So replay
    that is set to be uniform gives the very training that SB3's own buffer gives. All else comes from its own generator.

    :param buffer_size: number of transitions in all
    :param observation_space: of one axis, or ``Discrete``
    :param action_space: of the algorithm
    :param device: where samples go
    :param n_envs: number of worlds that fill it
    :param optimize_memory_usage: must be ``False``: no observation is stored twice anyway
    :param handle_timeout_termination: bootstrap where the time limit ended an episode, as in SB3
    :param seed: of its own generator; by default it follows from the algorithm's seed
    :param settings: of the kind of replay
    :raises ValueError: if the observations have several axes, or a setting does not exist
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        seed: int | None = None,
        **settings: Any,
    ) -> None:
        if isinstance(observation_space, spaces.Dict) or len(get_obs_shape(observation_space)) != 1:
            raise ValueError(
                f"the replay buffers of sb3_kfcv.stock hold observations of one axis, got {observation_space}; "
                "wrap the env in gymnasium.wrappers.FlattenObservation"
            )
        if optimize_memory_usage:
            raise ValueError(
                "optimize_memory_usage must be False: no observation is stored twice anyway, and SB3 would make the last "
                "transition terminal when learn() is called again"
            )
        require_parameters("replay_buffer_kwargs", settings, super().__init__)
        for name in {"n_agents", "state_size"} & set(settings):
            raise ValueError(f"{name} is a setting of many agents' replay; an algorithm of SB3 has one agent")
        own_seed = seed_by_global_stream() if seed is None else seed
        super().__init__(buffer_size, observation_space, action_space, device, n_envs, seed=own_seed, **settings)
        self.handle_timeout_termination = handle_timeout_termination
        self._learner: StockStudent | None = None

    def attach(self, student: StockStudent) -> None:  # type: ignore[override]
        super().attach(student)
        self._learner = student

    def detach(self) -> None:
        """Leave the learner, when its training ends."""
        self._learner = None

    @property
    def learner(self) -> StockStudent:
        """
        Who learns from it.

        :raises ValueError: if nobody does
        """
        if self._learner is None:
            raise ValueError(
                f"a {type(self).__name__} must know its learner; train by model.learn(..., callback=ReplayCallback())"
            )
        return self._learner

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store one step of all worlds, as in SB3."""
        cut = [self.handle_timeout_termination and info.get("TimeLimit.truncated", False) for info in infos]
        of_agent = [
            {"agent_rewards": (r,), "agent_terminated": (d and not c,), "agent_alive": (True,)}
            for r, d, c in zip(reward, done, cut, strict=True)
        ]
        shape = (self.n_envs, -1)
        super().add(obs.reshape(shape), next_obs.reshape(shape), action, reward, done, of_agent)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> JointReplayBufferSamples:  # type: ignore[override]
        """
        Draw a minibatch; its first fields are those of SB3. Its tensors are written anew by the next call.

        :param batch_size: number of transitions
        :param env: normalises observations and rewards when given
        :raises ValueError: if nobody learns from it
        """
        _ = self.learner
        return super().sample(batch_size, env)

    def _uniform_rows(self, batch_size: int) -> np.ndarray:
        steps = np.random.randint(0, self.size(), size=batch_size)
        return steps * self.n_envs + np.random.randint(0, self.n_envs, size=batch_size)

    def _gather(self, rows: np.ndarray, weights: np.ndarray | None, into: Minibatch) -> JointReplayBufferSamples:
        batch = super()._gather(rows, weights, into)
        if self.normalizer is None:
            return batch
        rewards = self.normalizer.normalize_reward(into.arrays["rewards"]).astype(np.float32)
        return batch._replace(rewards=th.as_tensor(rewards, device=self.device))

    def __getstate__(self) -> dict[str, Any]:
        """For SB3's ``save_replay_buffer``: without the learner, who is met again when a training starts."""
        return {name: value for name, value in vars(self).items() if name not in NOT_PICKLED}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _learner=None, normalizer=None)


class StockPrioritizedReplayBuffer(StockReplay, PrioritizedReplayBuffer):
    """
    Rank-based prioritised replay for SB3's algorithms.

    The |δ| of a minibatch is computed when it is drawn, by the networks that are about to be updated with it (those with
    which Schaul et al. compute it, too), at the cost of a forward pass: SB3 does not give the errors of its losses away.
    Importance weights multiply the gradient of the critic's loss, transition by transition, which is what weights in the
    loss do; the loss that SB3 logs is without them. ``alpha=0`` is SB3's uniform replay.

    Its settings are ``alpha`` and ``beta_init`` of :class:`~sb3_kfcv.replay.PrioritizedReplayBuffer` and those of
    :class:`StockReplay`.
    """

    _hook: RemovableHandle | None = None
    _drawn: JointReplayBufferSamples | None = None

    def attach(self, student: StockStudent) -> None:  # type: ignore[override]
        self.detach()
        super().attach(student)
        if self.alpha > 0:
            self._hook = student.critic.register_forward_hook(self._weigh)

    def detach(self) -> None:
        super().detach()
        if self._hook is not None:
            self._hook.remove()
        self._hook = self._drawn = None

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> JointReplayBufferSamples:  # type: ignore[override]
        batch = super().sample(batch_size, env)
        if self.alpha > 0:
            errors = self.learner.td_target(batch) - self.learner.q_values(batch)  # (1, batch)
            self.update_priorities(batch.rows, errors[0].abs())
            self._drawn = batch
        return batch

    def _draw(self, batch_size: int) -> tuple[np.ndarray, np.ndarray | None]:
        return super()._draw(batch_size) if self.alpha > 0 else (self._uniform_rows(batch_size), None)

    def _weigh(self, critic: th.nn.Module, inputs: tuple[th.Tensor, ...], values: Any) -> None:
        """
        Let the gradient of the critic's loss pass by the importance weights. Where the critic is asked about anything else
        than the minibatch itself, such as an actor's actions, nothing happens.
        """
        drawn = self._drawn
        if drawn is None or not th.is_grad_enabled() or not inputs:
            return
        if any(given is not own for given, own in zip(inputs, (drawn.observations, drawn.actions), strict=False)):
            return
        for estimate in values if isinstance(values, tuple) else (values,):
            estimate.register_hook(lambda gradient: gradient * drawn.weights.reshape(-1, *[1] * (gradient.dim() - 1)))


class StockKFCVReplayBuffer(StockReplay, KFCVReplayBuffer):
    """
    Curriculum replay for SB3's algorithms: the same folds, teachers, scores and stages as for many agents.

    The teachers stay over several calls of ``learn``. With ``lambda_init=1`` or ``curriculum_fraction=0`` it is SB3's uniform
    replay.

    Its settings are those of :class:`~sb3_kfcv.curriculum.KFCVReplayBuffer` (``n_folds``, ``stage_rule``, ``lambda_init``, …)
    and of :class:`StockReplay`.
    """

    def attach(self, student: StockStudent) -> None:  # type: ignore[override]
        before = vars(self).get("teachers")
        with own_draws(self.rng, self.device):
            super().attach(student)
        if before is not None:
            self.teachers.load_state_dict(before.state_dict())


def seed_by_global_stream() -> int:
    """A seed that follows from where NumPy's global stream stands, on which the algorithm's seed was set; it draws nothing."""
    state: Any = np.random.get_state(legacy=False)
    words = np.append(state["state"]["key"], np.uint32(state["state"]["pos"]))
    return int(np.random.SeedSequence(words.tolist()).generate_state(1, np.uint64)[0])
