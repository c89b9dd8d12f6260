"""
Scripted policies: fixed rules that frame every result.

A number means little until one knows what no policy, a simple rule and a nearly perfect player reach in the same world.
Each policy here acts for the agents of one group, in B worlds at once. :func:`scripted_policy` makes one by name.
"""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_kfcv.envs.grassland import SHEEP_ACCELERATION, WOLF_ACCELERATION
from sb3_kfcv.envs.hard_spread import AGENT_ACCELERATION, AGENT_RADIUS, HALF_SIZE
from sb3_kfcv.envs.oracle import Rooms, assign, oracle_forces
from sb3_kfcv.envs.particle_worlds import DISCRETE_DIRECTIONS
from sb3_kfcv.envs.steering import approach_velocity, force_for, nearest, pick, top_speed

if TYPE_CHECKING:
    from sb3_kfcv.common.layout import AgentLayout

# Grassland takes 200 · (max(|x|, |y|) - 0.9) from who goes beyond 0.9. Scripted wolves and sheep aim no farther out
# than this, since in a crowd they push each other.
_SAFE_HALF_WIDTH = 0.82
# How far ahead (seconds) a wolf aims at most, how far off the spots are that a fleeing sheep weighs, and how near a wolf
# may come to a grazing sheep. These three and the above were tuned on the world at its defaults.
_LONGEST_LEAD = 0.3
_FLIGHT = 0.3


@dataclass(frozen=True)
class WorldFacts:
    """
    What a scripted policy may know of the world beyond its observations.

    :param n_obstacles: Grassland's obstacles, which its observations end with
    :param wall_width: thickness of Hard Spread's inner walls
    :param door: height of their doors
    :param state_source: gives the states of the worlds that the observations come from (B, state size), such as
        ``vec_env.worlds.states``; only the oracle needs it
    """

    n_obstacles: int = 0
    wall_width: float = 0.4
    door: float = 0.4
    state_source: Callable[[], np.ndarray] | None = None


def nearest_choice(forces: np.ndarray) -> np.ndarray:
    """
    The discrete actions that come nearest to some forces.

    :param forces: (…, 2)
    :return: int64 choices among the five of ``DISCRETE_DIRECTIONS`` (…)
    """
    return np.linalg.norm(forces[..., None, :] - DISCRETE_DIRECTIONS, axis=-1).argmin(axis=-1)


class ScriptedPolicy(ABC):
    """
    A fixed rule for the agents of one group.

    :param layout: who sits where in the joint rows
    :param group: whom the policy plays
    :param rng: for policies that draw; by default a fresh generator
    :param facts: what the policy may know beyond its observations
    """

    def __init__(
        self,
        layout: AgentLayout,
        group: str,
        rng: np.random.Generator | None = None,
        facts: WorldFacts | None = None,
    ) -> None:
        self.layout = layout
        self.group = group
        self.members = layout.members(group)
        self.rng = rng or np.random.default_rng()
        self.facts = facts or WorldFacts()

    @abstractmethod
    def act(self, observations: np.ndarray) -> np.ndarray:
        """
        Forces of the group's agents.

        :param observations: of the group's m agents in B worlds, float32 (B, m, obs_size)
        :return: float32 forces in [-1, 1] (B, m, 2)
        """

    def choose(self, observations: np.ndarray) -> np.ndarray:
        """
        Discrete actions of the group's agents: the nearest ones to the forces of :meth:`act`.

        :param observations: (B, m, obs_size)
        :return: int64 choices (B, m)
        """
        return nearest_choice(self.act(observations))


class RandomPolicy(ScriptedPolicy):
    """Draws every force evenly from [-1, 1]², or every discrete action evenly from the five."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        return self.rng.uniform(-1, 1, (*observations.shape[:2], 2)).astype(np.float32)

    def choose(self, observations: np.ndarray) -> np.ndarray:
        return self.rng.integers(len(DISCRETE_DIRECTIONS), size=observations.shape[:2])


class StillPolicy(ScriptedPolicy):
    """Never pushes."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        return np.zeros((*observations.shape[:2], 2), dtype=np.float32)


@dataclass(frozen=True)
class SpreadView:
    """
    Hard Spread's observations by name: m agents in B worlds, n landmarks.

    :param velocity: (B, m, 2)
    :param position: (B, m, 2)
    :param landmarks: relative to the agent (B, m, n, 2)
    """

    velocity: np.ndarray
    position: np.ndarray
    landmarks: np.ndarray

    @classmethod
    def of(cls, observations: np.ndarray, n_agents: int) -> SpreadView:
        """Read observations (B, m, obs_size) of a world of ``n_agents`` agents and as many landmarks."""
        landmarks = observations[..., 4 : 4 + 2 * n_agents]
        return cls(
            velocity=observations[..., 0:2],
            position=observations[..., 2:4],
            landmarks=landmarks.reshape(*landmarks.shape[:2], n_agents, 2),
        )


class GreedyNearestPolicy(ScriptedPolicy):
    """Each agent goes straight to the landmark nearest to it, whoever else goes there and whatever wall is between."""

    def act(self, observations: np.ndarray) -> np.ndarray:
        view = SpreadView.of(observations, self.layout.n_agents)
        index, _ = nearest(view.landmarks)
        wanted = approach_velocity(pick(view.landmarks, index), AGENT_ACCELERATION)
        return force_for(wanted, view.velocity, AGENT_ACCELERATION).astype(np.float32)


class GreedyAssignedPolicy(ScriptedPolicy):
    """
    Each agent goes straight to a landmark of its own: the assignment with the smallest sum of distances.

    Every agent sees all others and all landmarks, so all come to the same assignment. Walls are not seen.
    """

    def act(self, observations: np.ndarray) -> np.ndarray:
        view = SpreadView.of(observations, self.layout.n_agents)
        choice = assign(np.linalg.norm(view.landmarks, axis=-1))
        wanted = approach_velocity(pick(view.landmarks, choice), AGENT_ACCELERATION)
        return force_for(wanted, view.velocity, AGENT_ACCELERATION).astype(np.float32)


class OraclePolicy(ScriptedPolicy):
    """
    Knows the walls: the assignment with the shortest ways through the doors, braking and giving way.

    It reads the worlds' states instead of the observations, so it needs ``state_source`` and can only play in
    the worlds that it reads.

    :raises ValueError: if the facts have no ``state_source``
    """

    def __init__(
        self,
        layout: AgentLayout,
        group: str,
        rng: np.random.Generator | None = None,
        facts: WorldFacts | None = None,
    ) -> None:
        super().__init__(layout, group, rng, facts)
        if self.facts.state_source is None:
            raise ValueError("the oracle sees the walls: give it state_source=, such as vec_env.worlds.states")
        self.state_source = self.facts.state_source

    def act(self, observations: np.ndarray) -> np.ndarray:
        states = np.atleast_2d(self.state_source()).astype(np.float64)
        if len(states) != len(observations):
            raise ValueError(f"the oracle got observations of {len(observations)} worlds and states of {len(states)}")
        n = self.layout.n_agents
        positions, velocities, landmarks = (states[:, 2 * n * i : 2 * n * (i + 1)].reshape(-1, n, 2) for i in range(3))
        rooms = Rooms(
            walls=states[:, 6 * n :].reshape(len(states), (states.shape[1] - 6 * n) // 2, 2),
            half_width=HALF_SIZE,
            wall_width=self.facts.wall_width,
            door=self.facts.door,
            radius=AGENT_RADIUS,
        )
        return oracle_forces(positions, velocities, landmarks, rooms, AGENT_ACCELERATION).astype(np.float32)


@dataclass(frozen=True)
class Others:
    """
    The agents of one group as others see them. The dead are zero throughout.

    :param position: relative to the observer (B, m, k, 2)
    :param velocity: (B, m, k, 2)
    :param alive: bool (B, m, k)
    """

    position: np.ndarray
    velocity: np.ndarray
    alive: np.ndarray


class GrasslandPolicy(ScriptedPolicy):
    """A rule of Grassland: reads the observations by name and leaves the dead alone."""

    accel: float

    def act(self, observations: np.ndarray) -> np.ndarray:
        wanted = self.wanted_velocity(observations)
        alive = observations[..., 4:5] > 0
        return np.where(alive, force_for(wanted, observations[..., 0:2], self.accel), 0).astype(np.float32)

    @abstractmethod
    def wanted_velocity(self, observations: np.ndarray) -> np.ndarray:
        """
        The velocities that the agents would like to have.

        :param observations: (B, m, obs_size)
        :return: (B, m, 2)
        """

    def grass(self, observations: np.ndarray) -> np.ndarray:
        """Where the grass is, relative to the observer (B, m, piles, 2)."""
        piles = observations[..., 5 : 5 + 2 * self._n_grass]
        return piles.reshape(*piles.shape[:2], self._n_grass, 2)

    def others(self, observations: np.ndarray, group: str) -> Others:
        """What the agents see of the other agents of a group."""
        start = 5 + 2 * self._n_grass
        everyone = observations[..., start : start + 5 * (self.layout.n_agents - 1)]
        everyone = everyone.reshape(*everyone.shape[:2], self.layout.n_agents - 1, 5)
        seen = np.take_along_axis(everyone, self._columns(group)[None, :, :, None], axis=2)
        return Others(position=seen[..., 0:2], velocity=seen[..., 2:4], alive=seen[..., 4] > 0)

    @cached_property
    def _n_grass(self) -> int:
        return (self.layout.obs_sizes[0] - 5 * self.layout.n_agents - 2 * self.facts.n_obstacles) // 2

    def _columns(self, group: str) -> np.ndarray:
        """Where each of our agents finds the others of a group: the global order with itself left out (m, k)."""
        columns = [[j - (j > i) for j in self.layout.members(group) if j != i] for i in self.members]
        return np.array(columns, dtype=np.intp)


class ChasePolicy(GrasslandPolicy):
    """A wolf goes for the nearest live sheep, aims where it will be, and stays off the costly border."""

    accel = WOLF_ACCELERATION

    def wanted_velocity(self, observations: np.ndarray) -> np.ndarray:
        sheep = self.others(observations, "sheep")
        index, distance = nearest(sheep.position, sheep.alive)
        lead = np.minimum(distance / top_speed(SHEEP_ACCELERATION), _LONGEST_LEAD)
        aim = pick(sheep.position, index) + lead[..., None] * pick(sheep.velocity, index)
        aim = np.where(np.isfinite(distance)[..., None], aim, 0)
        return approach_velocity(_kept_inside(aim, observations[..., 2:4]), self.accel)


class FleePolicy(GrasslandPolicy):
    """
    A sheep goes to the safest of the spots around it.

    The spots are where it stands and sixteen around it at a short distance, all off the costly border. A spot is as
    dangerous as the wolves are near to it and to the way there.
    """

    accel = SHEEP_ACCELERATION

    def wanted_velocity(self, observations: np.ndarray) -> np.ndarray:
        return approach_velocity(self.escape(observations), self.accel)

    def escape(self, observations: np.ndarray) -> np.ndarray:
        """The way to the safest spot (B, m, 2)."""
        wolves = self.others(observations, "wolf")
        angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        ring = _FLIGHT * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        steps = np.concatenate([np.zeros((1, 2)), ring])
        spots = _kept_inside(steps, observations[..., None, 2:4])  # (B, m, spots, 2)
        danger = np.zeros(spots.shape[:-1])
        for share in (0.5, 1.0):
            gaps = share * spots[..., :, None, :] - wolves.position[..., None, :, :]
            near = 1 / ((gaps**2).sum(axis=-1) + 1e-3)
            danger += np.where(wolves.alive[..., None, :], near**2, 0).sum(axis=-1)
        return pick(spots, danger.argmin(axis=-1))


class GrazePolicy(GrasslandPolicy):
    """A sheep goes to the nearest grass, blind to the wolves; without any grass it stays."""

    accel = SHEEP_ACCELERATION

    def wanted_velocity(self, observations: np.ndarray) -> np.ndarray:
        grass = self.grass(observations)
        if grass.shape[2] == 0:
            return approach_velocity(np.zeros_like(observations[..., :2]), self.accel)
        index, _ = nearest(grass)
        return approach_velocity(_kept_inside(pick(grass, index), observations[..., 2:4]), self.accel)


def _kept_inside(offset: np.ndarray, position: np.ndarray) -> np.ndarray:
    """An offset from a position, shortened so that it ends off Grassland's costly border."""
    return np.clip(position + offset, -_SAFE_HALF_WIDTH, _SAFE_HALF_WIDTH) - position


SCRIPTED_POLICIES: dict[str, dict[str, type[ScriptedPolicy]]] = {
    "agent": {
        "random": RandomPolicy,
        "still": StillPolicy,
        "greedy-nearest": GreedyNearestPolicy,
        "greedy-assigned": GreedyAssignedPolicy,
        "oracle": OraclePolicy,
    },
    "wolf": {"random": RandomPolicy, "chase": ChasePolicy},
    "sheep": {"random": RandomPolicy, "flee": FleePolicy, "graze": GrazePolicy},
}


def scripted_policy(
    name: str,
    layout: AgentLayout,
    group: str,
    rng: np.random.Generator | None = None,
    **facts: Any,
) -> ScriptedPolicy:
    """
    Make a scripted policy by its name.

    :param name: such as ``"chase"``; ``SCRIPTED_POLICIES`` lists the names of each group
    :param layout: who sits where in the joint rows
    :param group: whom the policy plays, such as ``"wolf"``
    :param rng: for policies that draw; by default a fresh generator
    :param facts: see :class:`WorldFacts`
    :raises ValueError: for an unknown name or group, with the nearest right one
    """
    if group not in SCRIPTED_POLICIES:
        raise ValueError(f"no scripted policy plays {group!r}{_did_you_mean(group, list(SCRIPTED_POLICIES))}")
    known = SCRIPTED_POLICIES[group]
    if name not in known:
        raise ValueError(f"unknown scripted policy {name!r} for {group!r}{_did_you_mean(name, list(known))}")
    return known[name](layout, group, rng, WorldFacts(**facts))


def _did_you_mean(given: str, known: list[str]) -> str:
    close = difflib.get_close_matches(given, known, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; there are {', '.join(known)}"
