"""What stored transitions are like, in terms that a person can check: distances, rewards, age."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from inspect import signature

import numpy as np

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.envs.grassland import BOUNDARY_SLOPE, BOUNDARY_START, CAPTURE_DISTANCE, CAPTURE_REWARD
from sb3_kfcv.envs.hard_spread import COVER_DISTANCE, COVER_REWARD, HardSpreadWorlds
from sb3_kfcv.replay.joint_replay_buffer import JointReplayBuffer, JointReplayBufferSamples

# Rows whose distances are computed at once: bounds the memory.
CHUNK = 10_000

ENDS = "agents whose episode ends (share)"
OWN_BODY = 4  # both worlds' observations begin with the own velocity and position


@dataclass(frozen=True)
class Places:
    """
    Where everybody is, for n transitions.

    :param positions: at the start of the step (n, agents, 2)
    :param alive: bool (n, agents)
    :param seekers: the agents that have goals
    :param goals: where these are (n, goals, 2)
    :param open: whether a goal is there to be reached, bool (n, goals)
    :param goal: what a goal is, such as ``"landmark"``
    """

    positions: np.ndarray
    alive: np.ndarray
    seekers: tuple[int, ...]
    goals: np.ndarray
    open: np.ndarray
    goal: str

    def to_goal(self) -> np.ndarray:
        """From the nearest open goal to each seeker (n, seekers, 2); NaN for the dead, and where no goal is open."""
        positions = self.positions[:, self.seekers]
        offsets = positions[:, :, None] - self.goals[:, None]  # (n, seekers, goals, 2)
        distances = np.where(self.open[:, None], np.linalg.norm(offsets, axis=-1), np.inf)
        nearest = distances.argmin(-1)
        found = np.take_along_axis(offsets, nearest[:, :, None, None], axis=2)[:, :, 0]
        there = np.isfinite(distances.min(-1)) & self.alive[:, self.seekers]
        return np.where(there[..., None], found, np.nan)

    def to_neighbour(self) -> np.ndarray:
        """Distance of each agent to the nearest other one (n, agents); NaN for the dead, and for who is alone."""
        offsets = self.positions[:, :, None] - self.positions[:, None]
        distances = np.linalg.norm(offsets, axis=-1)
        pairs = self.alive[:, :, None] & self.alive[:, None] & ~np.eye(self.alive.shape[1], dtype=bool)
        nearest = np.where(pairs, distances, np.inf).min(-1)
        return np.where(np.isfinite(nearest), nearest, np.nan)


def _own_positions(observations: np.ndarray, layout: AgentLayout) -> np.ndarray:
    return np.stack([observations[:, part.start + 2 : part.start + OWN_BODY] for part in layout.obs_slices], axis=1)


def _hard_spread(observations: np.ndarray, alive: np.ndarray, layout: AgentLayout) -> Places:
    """Agents and landmarks, as the first agent sees the latter."""
    positions, n = _own_positions(observations, layout), layout.n_agents
    first = layout.obs_slices[0].start + OWN_BODY
    landmarks = positions[:, :1] + observations[:, first : first + 2 * n].reshape(-1, n, 2)
    return Places(positions, alive, tuple(range(n)), landmarks, np.ones((len(observations), n), dtype=bool), "landmark")


def _grassland(observations: np.ndarray, alive: np.ndarray, layout: AgentLayout) -> Places:
    """Wolves seek sheep that live."""
    positions, sheep = _own_positions(observations, layout), list(layout.members("sheep"))
    return Places(positions, alive, layout.members("wolf"), positions[:, sheep], alive[:, sheep], "sheep")


PLACES: dict[str, Callable[[np.ndarray, np.ndarray, AgentLayout], Places]] = {
    "HardSpread-v0": _hard_spread,
    "Grassland-v0": _grassland,
}
"""World → how its observations tell who is where."""


def _mean(values: np.ndarray) -> np.ndarray:
    """Mean over the last axis without NaN; NaN where there is nothing else."""
    there = np.isfinite(values)
    counts = there.sum(-1)
    return np.where(counts > 0, np.where(there, values, 0).sum(-1) / np.maximum(counts, 1), np.nan)


def facts_of(
    buffer: JointReplayBuffer, layout: AgentLayout, env_id: str, rows: np.ndarray, phi: float | None = None
) -> dict[str, np.ndarray]:
    """
    What can be said of stored transitions: places at the start of the step, rewards and their terms at its end.

    :param buffer: that holds them, and does not normalise
    :param layout: of the world
    :param env_id: id of the world; of one that is not this package's only rewards, ends and age are told
    :param rows: which of them (n,)
    :param phi: weight φ of the distance in Hard Spread's reward, by default the world's
    :return: what, with its unit → (n,); NaN where it does not apply
    """
    parts = [_facts(buffer.rows(rows[i : i + CHUNK]), layout, env_id, phi) for i in range(0, len(rows), CHUNK)]
    facts = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if not facts[ENDS].any():
        del facts[ENDS]
    newest = buffer.pos * buffer.n_envs - 1
    facts["age in the buffer (env steps)"] = ((newest - rows) % max(buffer.n_rows, 1)).astype(float)
    return facts


def places_of(buffer: JointReplayBuffer, layout: AgentLayout, env_id: str, rows: np.ndarray) -> Places:
    """
    Who is where in stored transitions of a world in :data:`PLACES`.

    The parameters are those of :func:`facts_of`.
    """
    batch = buffer.rows(rows)
    return PLACES[env_id](batch.observations.numpy(), batch.alive.numpy() > 0, layout)


def _facts(batch: JointReplayBufferSamples, layout: AgentLayout, env_id: str, phi: float | None) -> dict[str, np.ndarray]:
    alive, rewards, dones = batch.alive.numpy() > 0, batch.rewards.numpy(), batch.dones.numpy()
    facts = {}
    if env_id in PLACES:
        places = PLACES[env_id](batch.observations.numpy(), alive, layout)
        after = PLACES[env_id](batch.next_observations.numpy(), alive & (dones == 0), layout)
        to_goal = np.linalg.norm(places.to_goal(), axis=-1)
        facts = {
            f"distance to the nearest {places.goal} (world units)": _mean(to_goal),
            "distance to the nearest other agent (world units)": _mean(places.to_neighbour()),
            **OWN_FACTS[env_id](places, to_goal, after, rewards, phi),
        }
    for group in layout.group_names:
        members = list(layout.members(group))
        facts[f"reward per {group}"] = _mean(np.where(alive[:, members], rewards[:, members], np.nan))
    return {**facts, ENDS: _mean(np.where(alive, dones, np.nan))}


def _hard_spread_facts(
    places: Places, to_goal: np.ndarray, after: Places, rewards: np.ndarray, phi: float | None
) -> dict[str, np.ndarray]:
    """Beside agents on landmarks the terms of the reward (eq. 13 to 15): what the distance leaves is 0, −1, +4 or +3."""
    weight = signature(HardSpreadWorlds).parameters["phi"].default if phi is None else phi
    distance = -weight * np.linalg.norm(after.to_goal(), axis=-1)
    rest = rewards - distance
    cover = np.where(rest > COVER_REWARD / 2, COVER_REWARD, 0.0)
    return {
        "agents on a landmark (share)": (to_goal <= COVER_DISTANCE).mean(-1),
        "distance term of the reward": distance.mean(-1),
        "cover term of the reward": cover.mean(-1),
        "collision term of the reward": np.round(rest - cover).mean(-1),
    }


def _grassland_facts(
    places: Places, to_goal: np.ndarray, after: Places, rewards: np.ndarray, phi: float | None
) -> dict[str, np.ndarray]:
    """Beside who touches whom the terms of the wolves' reward (eq. 16 to 18); captures come in fives."""
    wolves = list(places.seekers)
    beyond = np.abs(places.positions).max(-1) >= BOUNDARY_START
    boundary = BOUNDARY_SLOPE * np.maximum(np.abs(after.positions[:, wolves]).max(-1) - BOUNDARY_START, 0)
    rest = rewards[:, wolves] - boundary
    capture = CAPTURE_REWARD * np.round(rest / CAPTURE_REWARD)
    return {
        "wolves that touch a sheep (share)": _mean(np.where(np.isfinite(to_goal), to_goal < CAPTURE_DISTANCE, np.nan)),
        "agents at the border (share)": _mean(np.where(places.alive, beyond, np.nan)),
        "sheep alive": places.open.sum(-1).astype(float),
        "wolves' capture term of the reward": capture.mean(-1),
        "wolves' border term of the reward": boundary.mean(-1),
        "wolves' distance term of the reward": (rest - capture).mean(-1),
    }


OWN_FACTS: dict[str, Callable[[Places, np.ndarray, Places, np.ndarray, float | None], dict[str, np.ndarray]]] = {
    "HardSpread-v0": _hard_spread_facts,
    "Grassland-v0": _grassland_facts,
}
"""World → facts of its own: of places, the seekers' distances to their goals, places after the step, rewards, φ."""
