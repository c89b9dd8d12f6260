"""One replay buffer for all agents of a world: a row is a joint transition."""

from __future__ import annotations

import json
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize


class JointReplayBufferSamples(NamedTuple):
    """
    A minibatch of joint transitions. The first fields are those of SB3's ``ReplayBufferSamples``; where SB3 has one
    column (batch, 1), these have one per agent (batch, agents).
    """

    observations: th.Tensor  # (batch, joint observation)
    actions: th.Tensor  # (batch, joint action)
    next_observations: th.Tensor  # (batch, joint observation)
    dones: th.Tensor  # (batch, agents): 1 where the agent died or the world ended; a time limit is 0
    rewards: th.Tensor  # (batch, agents)
    alive: th.Tensor  # (batch, agents): 1 where the agent lived at the start of the step
    states: th.Tensor  # (batch, state); no columns unless states are stored
    next_states: th.Tensor  # (batch, state)
    weights: th.Tensor  # (batch,): importance weights of the critic loss
    rows: np.ndarray  # (batch,): where the transitions lie in the buffer
    discounts: th.Tensor | None = None


class Student(Protocol):
    """What a buffer may ask of the learner that it serves; every result is without gradient."""

    n_learning_agents: int
    teacher_input_size: int

    def teacher_inputs(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """What a critic of all agents reads, the world and all actions: (batch, features)."""

    def td_target(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """The TD target y: (agents, batch)."""

    def q_values(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """Its critics' estimates: (agents, batch)."""

    def live(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """1 where the learning agent lived: (agents, batch)."""


class JointReplayBuffer(ReplayBuffer):
    """
    Uniform replay of joint transitions.

    Per-agent values come from the infos of the env (``agent_rewards``, ``agent_terminated``, ``agent_alive``, and
    ``state``/``next_state`` where states are stored). A row of the buffer is one (time, env) pair, numbered
    ``time * n_envs + env``: the order in which rows fill.

    :param buffer_size: number of joint transitions in all
    :param observation_space: joint observation space
    :param action_space: joint action space
    :param device: where samples go
    :param n_envs: number of worlds that fill it
    :param optimize_memory_usage: not supported (next observations are stored, so that time limits bootstrap)
    :param n_agents: number of agents of the world
    :param state_size: length of the world states to store; 0 stores none
    :param seed: of the sampling; ``None`` takes fresh entropy
    """

    alive: np.ndarray
    states: np.ndarray
    next_states: np.ndarray

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        n_agents: int = 1,
        state_size: int = 0,
        seed: int | None = None,
    ) -> None:
        if optimize_memory_usage:
            raise ValueError("optimize_memory_usage=True is not supported: time limits need the stored next observation")
        super().__init__(buffer_size, observation_space, action_space, device, n_envs)
        del self.timeouts  # time limits are told from deaths per agent, see ``agent_terminated``
        shape = (self.buffer_size, self.n_envs)
        self.rewards = np.zeros((*shape, n_agents), dtype=np.float32)
        self.dones = np.zeros((*shape, n_agents), dtype=np.float32)
        self.alive = np.zeros((*shape, n_agents), dtype=np.float32)
        self.states = np.zeros((*shape, state_size), dtype=np.float32)
        self.next_states = np.zeros((*shape, state_size), dtype=np.float32)
        self.rng = np.random.default_rng(seed)
        self.progress = 0.0  # share of training done, in [0, 1]; set by the learner
        self.normalizer: VecNormalize | None = None

    @property
    def n_rows(self) -> int:
        """Number of joint transitions held."""
        return self.size() * self.n_envs

    def attach(self, student: Student) -> None:
        """Meet the learner. Uniform replay asks nothing of it."""

    def add(
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one step of all worlds; per-agent values come from the infos, not from the scalars ``reward`` and ``done``.

        :raises ValueError: if the env does not give per-agent values
        """
        pos = self.pos
        try:
            self.rewards[pos] = [info["agent_rewards"] for info in infos]
            self.dones[pos] = [info["agent_terminated"] for info in infos]
            self.alive[pos] = [info["agent_alive"] for info in infos]
            if self.states.shape[-1]:
                self.states[pos] = [info["state"] for info in infos]
                self.next_states[pos] = [info["next_state"] for info in infos]
        except KeyError as missing:
            raise ValueError(f"the env's infos lack {missing}; wrap a PettingZoo parallel env in JointEnv") from None
        self.observations[pos] = obs
        self.next_observations[pos] = next_obs
        self.actions[pos] = np.reshape(action, (self.n_envs, self.action_dim))
        self.pos = (pos + 1) % self.buffer_size
        self.full = self.full or self.pos == 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> JointReplayBufferSamples:  # type: ignore[override]
        """
        Draw a minibatch.

        :param batch_size: number of joint transitions
        :param env: normalises the observations when given
        """
        self.normalizer = env
        rows, weights = self._draw(batch_size)
        return self.rows(rows, weights)

    def _draw(self, batch_size: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Which rows to draw, and their importance weights (``None``: all one)."""
        return self.rng.integers(self.n_rows, size=batch_size), None

    def rows(self, rows: np.ndarray, weights: np.ndarray | None = None) -> JointReplayBufferSamples:
        """
        Given rows as a minibatch, its observations normalised as in the latest draw.

        :param rows: (batch,) row numbers
        :param weights: (batch,) importance weights
        """

        def take(array: np.ndarray) -> np.ndarray:
            return np.take(array.reshape(self.buffer_size * self.n_envs, array.shape[-1]), rows, axis=0)

        return JointReplayBufferSamples(
            observations=self._tensor(self._normalize_obs(take(self.observations), self.normalizer)),
            actions=self._tensor(take(self.actions)),
            next_observations=self._tensor(self._normalize_obs(take(self.next_observations), self.normalizer)),
            dones=self._tensor(take(self.dones)),
            rewards=self._tensor(take(self.rewards)),
            alive=self._tensor(take(self.alive)),
            states=self._tensor(take(self.states)),
            next_states=self._tensor(take(self.next_states)),
            weights=self._tensor(np.ones(len(rows)) if weights is None else weights),
            rows=rows,
        )

    def _tensor(self, array: Any) -> th.Tensor:
        return th.as_tensor(np.asarray(array, dtype=np.float32), device=self.device)

    def update_priorities(self, rows: np.ndarray, td_errors: th.Tensor) -> None:
        """
        Learn the TD errors of the rows just replayed. Uniform replay has no use for them.

        :param rows: (batch,) row numbers
        :param td_errors: (batch,) |δ|, mean over the learning agents
        """

    def diagnostics(self) -> dict[str, Any]:
        """What to log: name → scalar, or a tensor for a histogram."""
        return {}

    def state_arrays(self) -> dict[str, np.ndarray]:
        """Everything that the buffer holds, as plain arrays."""
        size = self.size()
        return {
            **{name: getattr(self, name)[:size] for name in self._row_arrays()},
            "position": np.array([self.pos, self.full]),
            "rng": np.array(json.dumps(self.rng.bit_generator.state)),
        }

    def load_state_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """
        Inverse of :meth:`state_arrays`.

        :raises ValueError: if the arrays are those of another buffer
        """
        missing = [name for name in (*self._row_arrays(), *self._other_arrays()) if name not in arrays]
        if missing:
            raise ValueError(f"not a replay buffer of this model: it lacks {', '.join(missing)}")
        for name in self._row_arrays():
            given, own = arrays[name].shape, getattr(self, name).shape
            if given[1] != self.n_envs:
                raise ValueError(f"not a replay buffer of this model: it is of {given[1]} worlds, here {self.n_envs}")
            if given[2:] != own[2:] or given[0] > own[0]:
                raise ValueError(f"not a replay buffer of this model: {name!r} is {given}, here at most {own}")
        for name in self._row_arrays():
            getattr(self, name)[: len(arrays[name])] = arrays[name]
        position, full = (int(value) for value in arrays["position"])
        held = len(arrays["rewards"])
        self.full = bool(full) and held == self.buffer_size
        self.pos = position if self.full or not full else held % self.buffer_size
        self.rng.bit_generator.state = json.loads(str(arrays["rng"]))

    def _row_arrays(self) -> tuple[str, ...]:
        """Names of the arrays whose first axis is time."""
        return ("observations", "next_observations", "actions", "rewards", "dones", "alive", "states", "next_states")

    def _other_arrays(self) -> tuple[str, ...]:
        """Names of the other arrays that a saved buffer must have."""
        return ("position", "rng")
