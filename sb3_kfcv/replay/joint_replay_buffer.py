"""One replay buffer for all agents of a world: a row is a joint transition."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_action_dim, get_flattened_obs_dim
from stable_baselines3.common.vec_env import VecNormalize

from sb3_kfcv.common.checks import require_between, require_count, require_finite
from sb3_kfcv.common.memory import require_memory
from sb3_kfcv.replay.successors import Successors, gather, room_apart

# What a transition is made of: arrays (steps, n_envs, …).
TRANSITION_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "alive", "states", "next_states")

# Those that are mostly what the next step starts from, and what that is.
FOLLOWING = {"next_observations": "observations", "next_states": "states"}

# Share of the transitions for whose ends of episodes there is room at first: of episodes of 20 steps or more.
SHARE_OF_ENDS = 0.05


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
    discounts: th.Tensor | None = None  # SB3's field for n-step returns, which are not made here


class Minibatch:
    """
    Tensors for a minibatch, (batch, …) each, and their memory as arrays.

    :param size: batch
    :param widths: name → columns
    """

    def __init__(self, size: int, widths: dict[str, int]) -> None:
        self.size, self.widths = size, widths
        self.tensors = {name: th.empty(size, width) for name, width in widths.items()}
        self.arrays = {name: self.tensors[name].numpy() for name, width in widths.items() if width}
        self.tensors["weights"] = th.ones(size)
        self.weights = self.tensors["weights"].numpy()

    def __reduce__(self) -> tuple[type[Minibatch], tuple[int, dict[str, int]]]:
        """A copy is another empty one: its arrays must be the memory of its own tensors."""
        return Minibatch, (self.size, self.widths)


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

    What a step leads to is what the next step of its world starts from, and stored once; only the ends of episodes are kept
    apart. :meth:`estimate_bytes` tells what a buffer will take, :attr:`n_bytes` what it takes.

    :param buffer_size: number of joint transitions in all
    :param observation_space: joint observation space
    :param action_space: joint action space
    :param device: where samples go
    :param n_envs: number of worlds that fill it
    :param optimize_memory_usage: nothing depends on it: no observation is ever stored twice, and time limits bootstrap
    :param n_agents: number of agents of the world
    :param state_size: length of the world states to store; 0 stores none
    :param seed: of the sampling; ``None`` takes fresh entropy
    """

    uses_td_errors: ClassVar[bool] = False  # whether update_priorities() wants to be called
    noted_bytes: ClassVar[int] = 0  # per transition, of what a kind of replay notes of each

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
        n_bytes = self.estimate_bytes(buffer_size, observation_space, action_space, n_envs, n_agents, state_size)
        require_memory(f"a replay buffer of {buffer_size:,} joint transitions", n_bytes)
        super().__init__(
            *(buffer_size, observation_space, action_space, device, n_envs),
            optimize_memory_usage=True,
            handle_timeout_termination=False,
        )
        del self.timeouts  # time limits are told from deaths per agent, see ``agent_terminated``
        shape = (self.buffer_size, self.n_envs)
        self.rewards = np.zeros((*shape, n_agents), dtype=np.float32)
        self.dones = np.zeros((*shape, n_agents), dtype=np.float32)
        self.alive = np.zeros((*shape, n_agents), dtype=np.float32)
        self.states = np.zeros((*shape, state_size), dtype=np.float32)
        self._successors = Successors(self.observations, self.states, SHARE_OF_ENDS)
        self.rng = np.random.default_rng(seed)
        self.n_added = 0  # steps (of all worlds) ever stored
        self.progress = 0.0  # share of training done, in [0, 1]; set by the learner
        self.normalizer: VecNormalize | None = None
        self._minibatch = self._empty(0)

    @classmethod
    def estimate_bytes(
        cls,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        n_envs: int = 1,
        n_agents: int = 1,
        state_size: int = 0,
        share_of_ends: float = SHARE_OF_ENDS,
    ) -> int:
        """
        Memory that the arrays of such a buffer take, beside its minibatch.

        :param share_of_ends: share of the transitions that an episode ends with, 1 / its length; up to the default there
            is room from the start, beyond it the buffer grows while it fills (1: as if every next observation were stored)

        The other parameters are those of the buffer.
        """
        n_steps = max(buffer_size // n_envs, 1)
        seen = get_flattened_obs_dim(observation_space) * np.dtype(observation_space.dtype).itemsize + 4 * state_size
        action = get_action_dim(action_space) * np.dtype(action_space.dtype).itemsize
        place = 4
        apart = room_apart(n_steps, n_envs, max(share_of_ends, SHARE_OF_ENDS))
        per_row = seen + action + 3 * 4 * n_agents + place + cls.noted_bytes
        return n_steps * n_envs * per_row + apart * seen + (apart - n_envs) * place

    @property
    def n_bytes(self) -> int:
        """Memory that its arrays take, beside the minibatch."""
        return sum(array.nbytes for array in vars(self).values() if isinstance(array, np.ndarray)) + self._successors.n_bytes

    @property
    def next_observations(self) -> np.ndarray:  # type: ignore[override]
        """What the steps led to, (steps, n_envs, …), put together anew at each call."""
        return self._following("next_observations")

    @property
    def next_states(self) -> np.ndarray:
        """The states that the steps led to, (steps, n_envs, …), put together anew at each call."""
        return self._following("next_states")

    def _following(self, name: str) -> np.ndarray:
        starts = getattr(self, FOLLOWING[name])
        found = np.zeros_like(starts)
        rows = np.arange(self.n_rows)
        self._successors.read(name, rows, found.reshape(-1, starts.shape[2])[: len(rows)])
        return found

    @property
    def n_rows(self) -> int:
        """Number of joint transitions held."""
        return self.size() * self.n_envs

    def reset(self) -> None:
        """Forget all transitions."""
        super().reset()
        self.n_added = 0
        self._successors.reset()

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
        self._successors.make_room()
        pos = self.pos
        try:
            self.rewards[pos] = [info["agent_rewards"] for info in infos]
            self.dones[pos] = [info["agent_terminated"] for info in infos]
            self.alive[pos] = [info["agent_alive"] for info in infos]
            following: dict[str, Any] = {"next_observations": next_obs}
            if self.states.shape[2]:
                self.states[pos] = [info["state"] for info in infos]
                following["next_states"] = [info["next_state"] for info in infos]
        except KeyError as missing:
            raise ValueError(
                f"the env's infos lack {missing}; wrap a PettingZoo parallel env in JointEnv "
                "(for one agent and the algorithms of SB3 there are the replay buffers of sb3_kfcv.stock)"
            ) from None
        self.observations[pos] = obs
        previous = (pos - 1) % self.buffer_size if self.n_added and self.buffer_size > 1 else None
        self._successors.add(pos, previous, following)
        self.actions[pos] = np.reshape(action, (self.n_envs, self.action_dim))
        self.n_added += 1
        self.pos = self.n_added % self.buffer_size
        self.full = self.full or self.pos == 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> JointReplayBufferSamples:  # type: ignore[override]
        """
        Draw a minibatch. Its tensors are written anew by the next call; clone what is to be kept, or use :meth:`rows`.

        :param batch_size: number of joint transitions
        :param env: normalises the observations when given
        """
        self.normalizer = env
        rows, weights = self._draw(batch_size)
        if self._minibatch.size != batch_size:
            self._minibatch = self._empty(batch_size)
        return self._gather(rows, weights, self._minibatch)

    def _draw(self, batch_size: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Which rows to draw, and their importance weights (``None``: all one)."""
        return self._uniform_rows(batch_size), None

    def _uniform_rows(self, batch_size: int) -> np.ndarray:
        """Draw rows, all alike."""
        return self.rng.integers(self.n_rows, size=batch_size)

    def rows(self, rows: np.ndarray, weights: np.ndarray | None = None) -> JointReplayBufferSamples:
        """
        Given rows as a minibatch, its observations normalised as in the latest draw.

        :param rows: (batch,) row numbers
        :param weights: (batch,) importance weights
        :raises IndexError: if there is no such row
        """
        rows = np.asarray(rows)
        if not (0 <= rows.min(initial=0) and rows.max(initial=0) < max(self.n_rows, 1)):
            raise IndexError(f"rows {rows.min()} to {rows.max()} of a buffer that holds {self.n_rows}")
        return self._gather(rows, weights, self._empty(len(rows)))

    def _empty(self, batch_size: int) -> Minibatch:
        return Minibatch(batch_size, {name: self._stored(name).shape[2] for name in TRANSITION_ARRAYS})

    def _gather(self, rows: np.ndarray, weights: np.ndarray | None, into: Minibatch) -> JointReplayBufferSamples:
        """The rows, written into a minibatch."""
        for name, array in into.arrays.items():
            self._read(name, rows, array)
        if self.normalizer is not None:
            for name in ("observations", "next_observations"):
                into.arrays[name][:] = self.normalizer.normalize_obs(into.arrays[name])
        if weights is not None:
            into.weights[:] = weights
        tensors = into.tensors
        if self.device.type != "cpu":
            tensors = {name: tensor.to(self.device) for name, tensor in tensors.items()}
        return JointReplayBufferSamples(**tensors, rows=rows)

    def _stored(self, name: str) -> np.ndarray:
        """The array, (steps, n_envs, …), of a transition's part; of what follows, that of what it mostly is."""
        return getattr(self, FOLLOWING.get(name, name))

    def _read(self, name: str, rows: np.ndarray, into: np.ndarray) -> None:
        """Write one part of the rows' transitions into an array (rows, …)."""
        if name in FOLLOWING:
            self._successors.read(name, rows, into)
        else:
            gather(getattr(self, name), rows, into)

    def update_priorities(self, rows: np.ndarray, td_errors: th.Tensor) -> None:
        """
        Learn the TD errors of the rows just replayed. Uniform replay has no use for them.

        :param rows: (batch,) row numbers
        :param td_errors: (batch,) |δ|, mean over the learning agents
        """

    def diagnostics(self) -> dict[str, Any]:
        """What to log: name → scalar, or a tensor for a histogram."""
        return {}

    def state(self) -> dict[str, Any]:
        """Everything but the transitions themselves, see :meth:`transitions`: what changes after a transition was stored."""
        return {
            "n_steps": self.buffer_size,
            "n_envs": self.n_envs,
            "n_added": self.n_added,
            "rng": self.rng.bit_generator.state,
            "progress": self.progress,
        }

    def transitions(self, first: int = 0) -> dict[str, np.ndarray]:
        """
        The stored transitions from a step on, the oldest first; they never change while they are held.

        :param first: number of the step, counted from the first ever added; those no longer held are left out
        :return: name → (steps, n_envs, …)
        """
        slots = np.arange(max(first, self.n_added - self.size()), self.n_added) % self.buffer_size
        rows = (slots[:, None] * self.n_envs + np.arange(self.n_envs)).ravel()
        given = {}
        for name in TRANSITION_ARRAYS:
            stored = self._stored(name)
            read = np.empty((len(rows), stored.shape[2]), dtype=stored.dtype)
            self._read(name, rows, read)
            given[name] = read.reshape(len(slots), *stored.shape[1:])
        return given

    def set_state(self, state: dict[str, Any], transitions: dict[str, np.ndarray]) -> None:
        """
        Go on exactly where :meth:`state` and :meth:`transitions` were called. With another size or another number of
        worlds the latest transitions are kept, as many as fill whole steps, and the order of the draws is another.

        :raises ValueError: if they are those of another buffer
        """
        expected = set(self.state())
        if set(state) != expected:
            odd = ", ".join(sorted(set(state) ^ expected))
            raise ValueError(f"not a replay buffer of this model: {odd} differ")
        for name, least in (("n_steps", 1), ("n_envs", 1), ("n_added", 0)):
            require_count(name, state[name], least)
        n_steps, n_envs, n_added = (int(state[name]) for name in ("n_steps", "n_envs", "n_added"))
        if max(n_steps, n_added) * n_envs >= 2**62:
            raise ValueError(f"not a replay buffer of this model: it claims {n_added} of {n_steps} steps of {n_envs} worlds")
        held = min(n_added, n_steps)
        n_rows = held * n_envs
        self._check_transitions(transitions, held, n_envs)
        require_between("progress", state["progress"], 0, 1)
        type(self.rng.bit_generator)().state = state["rng"]  # refused here or nowhere: nothing has changed yet
        rows = np.arange((n_added - held) * n_envs, n_added * n_envs) % (n_steps * n_envs)  # the oldest first
        if (n_steps, n_envs) != (self.buffer_size, self.n_envs):
            n_added = held = min(held * n_envs // self.n_envs, self.buffer_size)
            rows = rows[len(rows) - held * self.n_envs :]
        slots = np.arange(n_added - held, n_added) % self.buffer_size
        self._set_bookkeeping(state, rows, (slots[:, None] * self.n_envs + np.arange(self.n_envs)).ravel())
        self.rng.bit_generator.state = state["rng"]
        self.progress = state["progress"]
        latest = {
            name: array.reshape(n_rows, array.shape[2])[n_rows - len(rows) :].reshape(held, self.n_envs, array.shape[2])
            for name, array in transitions.items()
        }
        for name in TRANSITION_ARRAYS:
            if name not in FOLLOWING:
                getattr(self, name)[slots] = latest[name]
        self._successors.set(slots, {name: latest[name] for name in FOLLOWING})
        self.n_added, self.pos, self.full = n_added, n_added % self.buffer_size, n_added >= self.buffer_size

    def _set_bookkeeping(self, state: dict[str, Any], rows: np.ndarray, own_rows: np.ndarray) -> None:
        """
        Take over what a kind of replay notes of each row; the last thing that can be refused, and then nothing is taken over.

        :param state: as :meth:`state` gave it
        :param rows: its rows, the oldest first
        :param own_rows: where they lie now
        :raises ValueError: if the notes are not of these transitions
        """

    def _check_transitions(self, transitions: dict[str, np.ndarray], held: int, n_envs: int) -> None:
        """
        :raises ValueError: unless they are ``held`` steps of ``n_envs`` worlds like this one's, all finite
        """
        if set(transitions) != set(TRANSITION_ARRAYS):
            raise ValueError(f"not a replay buffer of this model: it has {', '.join(transitions)}")
        for name, array in transitions.items():
            own = self._stored(name)
            expected = (held, n_envs, *own.shape[2:])
            if array.shape != expected or array.dtype != own.dtype:
                raise ValueError(
                    f"not a replay buffer of this model: {name} is {array.shape} of {array.dtype}, wanted is {expected} "
                    f"of {own.dtype}"
                )
            require_finite(f"{name} of the replay buffer", array)
        for name in ("dones", "alive"):
            if not np.isin(transitions[name], (0, 1)).all():
                raise ValueError(f"not a replay buffer of this model: {name} must be 0 or 1")
        if isinstance(self.action_space, spaces.MultiDiscrete):
            choices = transitions["actions"]
            if not ((choices >= 0) & (choices < self.action_space.nvec)).all():
                raise ValueError(f"not a replay buffer of this model: actions are choices among {self.action_space.nvec}")
