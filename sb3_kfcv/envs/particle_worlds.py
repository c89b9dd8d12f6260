"""The base of our worlds: many copies of one world, stepped together."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_kfcv.envs import physics
from sb3_kfcv.envs.drawing import Scene
from sb3_kfcv.envs.handles import Handle, handle_of

DISCRETE_DIRECTIONS = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""Force of each discrete action: stay, +x, −x, +y, −y."""
REFUSED = -1
"""What a compiled step gives instead of the number of episodes that are over, if an action is not finite."""


class WorldArrays(NamedTuple):
    """What every world is made of; E worlds of n agents, everything in place."""

    rng: np.ndarray  # (E,) uint64: state of each world's random generator
    steps: np.ndarray  # (E,) int64: steps of the episode so far
    positions: np.ndarray  # (E, n, 2)
    velocities: np.ndarray  # (E, n, 2)
    alive_before: np.ndarray  # (E, n) bool: alive at the start of the last step
    alive: np.ndarray  # (E, n) bool: alive now
    died_at: np.ndarray  # (E, n) int64: step of the agent's death, −1 for the living
    terminated: np.ndarray  # (E, n) bool: dead, or in a world that terminated
    observations: np.ndarray  # (E, sum of observation sizes) float32: the agents' observations one after the other
    rewards: np.ndarray  # (E, n) float32: rewards of the last step
    returns: np.ndarray  # (E, n): rewards of the episode, summed
    episode_terminated: np.ndarray  # (E,) bool
    episode_truncated: np.ndarray  # (E,) bool: ended by the time limit, and by nothing else


class ParticleWorlds(ABC):
    """
    ``n_worlds`` copies of one world, stepped together by one compiled call.

    A world draws from its own generator alone, so a batch of worlds gives bit for bit what single ones give.
    The arrays below are read-only views for others, and the next :meth:`step` or :meth:`reset` overwrites them.
    A world whose episode has ended goes on until it is reset.

    :param n_worlds: number of worlds, E
    :param agents: names of the agents
    :param obs_sizes: length of each agent's observation
    :param state_size: length of a row of :meth:`states`
    :param max_steps: steps after which an episode is truncated
    :param continuous_actions: whether actions are forces in [−1, 1]², or one of five directions
    """

    metric_names: tuple[str, ...]
    """Names of the columns of :meth:`episode_metrics`."""
    scalar_reward: str
    """What a single reward for the whole world stands for: ``"mean"`` over all agents, or over the group named."""
    wins: ClassVar[Mapping[str, str]] = {}
    """Which group can win, and the metric in [0, 1] that tells how far; of two groups, the other one wins the rest."""
    render_fps = round(1 / physics.DT)

    @property
    def facts(self) -> dict[str, float]:
        """What scripted policies must know beyond their observations, see :class:`~sb3_kfcv.envs.scripted.WorldFacts`."""
        return {}

    def __init__(
        self,
        n_worlds: int,
        agents: Sequence[str],
        obs_sizes: Sequence[int],
        state_size: int,
        max_steps: int,
        continuous_actions: bool,
    ):
        require_at_least("n_worlds", n_worlds, 1)
        require_at_least("max_steps", max_steps, 1)
        self.n_worlds = n_worlds
        self.agents = tuple(agents)
        self.n_agents = len(self.agents)
        self.obs_sizes = tuple(obs_sizes)
        self.state_size = state_size
        self.max_steps = max_steps
        self.continuous_actions = continuous_actions

        E, n = n_worlds, self.n_agents
        self._common = WorldArrays(
            rng=np.array([physics.rng_state(None) for _ in range(E)]),
            steps=np.zeros(E, dtype=np.int64),
            positions=np.zeros((E, n, 2)),
            velocities=np.zeros((E, n, 2)),
            alive_before=np.ones((E, n), dtype=np.bool_),
            alive=np.ones((E, n), dtype=np.bool_),
            died_at=np.full((E, n), -1, dtype=np.int64),
            terminated=np.zeros((E, n), dtype=np.bool_),
            observations=np.zeros((E, sum(obs_sizes)), dtype=np.float32),
            rewards=np.zeros((E, n), dtype=np.float32),
            returns=np.zeros((E, n)),
            episode_terminated=np.zeros(E, dtype=np.bool_),
            episode_truncated=np.zeros(E, dtype=np.bool_),
        )
        self.steps = self._common.steps
        self.positions = self._common.positions
        self.velocities = self._common.velocities
        self.alive_before = self._common.alive_before
        self.alive = self._common.alive
        self.died_at = self._common.died_at
        self.terminated = self._common.terminated
        self.observations = self._common.observations
        self.rewards = self._common.rewards
        self.returns = self._common.returns
        self.episode_terminated = self._common.episode_terminated
        self.episode_truncated = self._common.episode_truncated

        self._observation_spaces = {
            agent: spaces.Box(-np.inf, np.inf, (size,), np.float32)
            for agent, size in zip(self.agents, self.obs_sizes, strict=True)
        }
        self._action_spaces: dict[str, spaces.Space] = {
            agent: spaces.Box(-1.0, 1.0, (2,), np.float32) if continuous_actions else spaces.Discrete(len(DISCRETE_DIRECTIONS))
            for agent in self.agents
        }

    @property
    @abstractmethod
    def _own(self) -> Any:
        """The arrays of this kind of world, beside the common ones: a named tuple, worlds first in each."""

    @abstractmethod
    def _reset(self, worlds: np.ndarray) -> None:
        """Start new episodes in the worlds of these indices."""

    @abstractmethod
    def _step(self, actions: np.ndarray) -> int:
        """
        Step all worlds.

        :param actions: float64 (E, n, 2)
        :return: number of worlds whose episode is over; ``REFUSED``, and nothing was done, if an action is not finite
        """

    @cached_property
    def _handle(self) -> Handle:
        """The arrays, as compiled functions take them."""
        return handle_of(self._common, self._own)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_handle"}  # a copy has arrays of its own

    @abstractmethod
    def states(self) -> np.ndarray:
        """
        The true state of each world, for central critics.

        :return: (E, state_size) float32, a new array
        """

    @abstractmethod
    def episode_metrics(self) -> np.ndarray:
        """
        Metrics of each world's episode so far.

        :return: (E, number of metrics), columns as in ``metric_names``
        """

    @abstractmethod
    def scene(self, world: int) -> Scene:
        """What there is to draw of a world."""

    def observation_space(self, agent: str) -> spaces.Box:
        """Observation space of an agent, the same object at each call."""
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Action space of an agent, the same object at each call."""
        return self._action_spaces[agent]

    def seed(self, seeds: Sequence[int | None]) -> None:
        """
        Seed the generator of each world; the episodes under way go on.

        :param seeds: one per world; None draws fresh entropy
        """
        if len(seeds) != self.n_worlds:
            raise ValueError(f"got {len(seeds)} seeds for {self.n_worlds} worlds; give one per world")
        self._common.rng[:] = [physics.rng_state(seed) for seed in seeds]

    def reset(self, worlds: Sequence[int] | np.ndarray | None = None) -> None:
        """
        Start new episodes.

        :param worlds: indices of the worlds to reset, all by default; the others are left alone
        """
        self._reset(np.arange(self.n_worlds) if worlds is None else np.asarray(worlds, dtype=np.int64))

    def step(self, actions: np.ndarray) -> int:
        """
        Step all worlds at once; the result is read from the arrays.

        :param actions: forces (E, n, 2), of which what lies outside [−1, 1] is clipped; or (E, n) integers in 0…4
        :return: number of worlds whose episode is over
        :raises ValueError: for a wrong shape, and for values that are no actions, naming the first world and agent
        """
        actions = np.asarray(actions)
        if self.continuous_actions:
            self._check_shape(actions, (self.n_worlds, self.n_agents, 2))
            n_over = self._step(np.asarray(actions, dtype=np.float64, order="C"))
            if n_over == REFUSED:
                self._refuse(actions, ~np.isfinite(actions).all(axis=-1), "finite numbers")
            return n_over
        self._check_shape(actions, (self.n_worlds, self.n_agents))
        valid = (actions >= 0) & (actions < len(DISCRETE_DIRECTIONS)) & (actions % 1 == 0)
        if not valid.all():
            self._refuse(actions, ~valid, f"an integer from 0 to {len(DISCRETE_DIRECTIONS) - 1}")
        return self._step(DISCRETE_DIRECTIONS[actions.astype(np.int64, copy=False)])

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        """The whole state of a world, from which it continues exactly: random generator, episode, metrics."""
        return {name: np.array(array[world]) for name, array in self._arrays().items()}

    def set_world(self, world: int, saved: dict[str, np.ndarray]) -> None:
        """
        Put back what :meth:`get_world` gave.

        :raises ValueError: if it comes from another kind of world, or one of another size
        """
        arrays = self._arrays()
        if saved.keys() != arrays.keys():
            raise ValueError(f"this world is made of {', '.join(arrays)}; got {', '.join(saved)}")
        for name, array in arrays.items():
            if np.shape(saved[name]) != array.shape[1:]:
                raise ValueError(f"{name!r} of this world has shape {array.shape[1:]}; got {np.shape(saved[name])}")
        for name, array in arrays.items():
            array[world] = saved[name]

    def _arrays(self) -> dict[str, np.ndarray]:
        return {**self._common._asdict(), **self._own._asdict()}

    def _check_shape(self, actions: np.ndarray, shape: tuple[int, ...]) -> None:
        if actions.shape != shape:
            kind = "forces" if self.continuous_actions else "integers"
            raise ValueError(f"actions have shape {actions.shape}; this world takes {kind} of shape {shape}")

    def _refuse(self, actions: np.ndarray, wrong: np.ndarray, wanted: str) -> None:
        world, agent = np.argwhere(wrong)[0]
        raise ValueError(
            f"the action of {self.agents[agent]} in world {world} is {actions[world, agent]}; it must be {wanted}"
        )


def require_at_least(name: str, value: float, least: float) -> None:
    """
    :raises ValueError: if a setting is below its least value, or not a number
    """
    if not value >= least:
        raise ValueError(f"{name} is {value}; it must be at least {least}")
