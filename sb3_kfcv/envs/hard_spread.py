"""HardSpread: agents find landmarks in three rooms, between walls that they cannot see."""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_kfcv.common.kernels import kernel
from sb3_kfcv.envs import physics
from sb3_kfcv.envs.drawing import PALETTE, Disc, Rectangle, Scene
from sb3_kfcv.envs.particle_worlds import REFUSED, ParticleWorlds, require_at_least

# Sizes of section 5.1 of the paper, with the bodies of Hard Spread in
# https://github.com/jiayu-ch15/Variational-Automatic-Curriculum-Learning
HALF_SIZE = 3.0
"""The plane is [−3, 3]²."""
AGENT_RADIUS = 0.1
AGENT_ACCELERATION = 5.0
LANDMARK_RADIUS = 0.05
COVER_DISTANCE = AGENT_RADIUS + LANDMARK_RADIUS
"""An agent covers a landmark from here on."""
COLLISION_PENALTY = -1.0
"""C of eq. 13: once per step for an agent that touches other agents or walls."""
COVER_REWARD = 4.0
"""D of eq. 14: per step for an agent on a landmark."""

N_RANDOM_WALLS = 2
MIN_WALL_WIDTH = 0.2
"""An agent at top speed covers 0.2 in a step: the contact law does not stop it at thinner walls."""
MIN_ROOM_WIDTH = 1.0
"""Width that random walls leave to each room, ten times the radius of an agent."""
WALL_LAYOUTS = ("random", "fixed", "none")

# Columns of HardSpreadArrays.totals: sums over the steps of the episode
AGENTS_IN_CONTACT, PAIRS_IN_CONTACT, AGENTS_AT_WALLS = 0, 1, 2
AGENT_DISTANCES, LANDMARK_DISTANCES = 3, 4
COVERED, COVERED_LAST = 5, 6  # the second one is of the last step alone
DISTANCE_TERM, COLLISION_TERM, COVER_TERM = 7, 8, 9
N_TOTALS = 10


class HardSpreadArrays(NamedTuple):
    """What HardSpread adds to :class:`WorldArrays`; E worlds, n landmarks, W walls."""

    landmarks: np.ndarray  # (E, n, 2)
    inner_walls: np.ndarray  # (E, W, 2): x of the middle line and y of the door's centre
    walls_drawn: np.ndarray  # (E,) bool: whether the walls stay at the next reset
    totals: np.ndarray  # (E, N_TOTALS)


class HardSpreadWorlds(ParticleWorlds):
    """
    Section 5.1 of the paper: n agents should stand on n landmarks, without touching each other or a wall.

    The plane has outer walls, and inner vertical ones of full height with one door each. Agents do not see walls.
    An agent's observation is its velocity (2) and position (2), then the positions relative to its own of the
    landmarks (2n) and of the other agents (2(n − 1)). The state is positions, velocities, landmarks (2n each) and
    (x, y of the door) of each inner wall. Episodes are truncated, never terminated.

    The reward of an agent (eq. 13–15) is −φ · distance to its nearest landmark, −1 if it touches at least one agent
    or wall, +4 if it covers a landmark.

    :param n_worlds: number of worlds
    :param n_agents: number of agents and of landmarks, n
    :param walls: ``"random"``: two walls drawn at every reset, so that three rooms of at least 1.0 are left;
        ``"fixed"``: two walls drawn once from the world's seed; ``"none"``; or a list of (x, y of the door's centre)
    :param wall_width: width of the inner and outer walls, at least 0.2
    :param door: height of the doors, wider than an agent
    :param phi: weight φ of the distance
    :param exclusive_cover: pay only the agent closest to a landmark, not every one that covers it
    :param max_steps: steps of an episode
    :param continuous_actions: forces in [−1, 1]², or one of five directions
    """

    metric_names = (
        "collisions",
        "pair_collisions",
        "wall_collisions",
        "closest_distance",
        "closest_distance_landmarks",
        "closest_distance_mean",
        "landmarks_covered",
        "landmarks_covered_last",
        "cover_rate",
        "cover_rate_last",
        "distance_term",
        "collision_term",
        "cover_term",
    )
    scalar_reward = "mean"

    def __init__(
        self,
        n_worlds: int = 1,
        n_agents: int = 4,
        walls: str | Sequence[tuple[float, float]] = "random",
        wall_width: float = 0.4,
        door: float = 0.4,
        phi: float = 1.0,
        exclusive_cover: bool = False,
        max_steps: int = 70,
        continuous_actions: bool = True,
    ):
        require_at_least("n_agents", n_agents, 1)
        require_at_least("phi", phi, 0.0)
        listed = _listed_walls(walls, wall_width, door)
        n_walls = N_RANDOM_WALLS if listed is None else len(listed)
        super().__init__(
            n_worlds=n_worlds,
            agents=[f"agent_{i}" for i in range(n_agents)],
            obs_sizes=[4 + 2 * n_agents + 2 * (n_agents - 1)] * n_agents,
            state_size=6 * n_agents + 2 * n_walls,
            max_steps=max_steps,
            continuous_actions=continuous_actions,
        )
        self.walls = walls if isinstance(walls, str) else listed
        self.wall_width = float(wall_width)
        self.door = float(door)
        self.phi = float(phi)
        self.exclusive_cover = bool(exclusive_cover)
        self._arrays_of_hard_spread = HardSpreadArrays(
            landmarks=np.zeros((n_worlds, n_agents, 2)),
            inner_walls=np.zeros((n_worlds, n_walls, 2)),
            walls_drawn=np.full(n_worlds, listed is not None, dtype=np.bool_),
            totals=np.zeros((n_worlds, N_TOTALS)),
        )
        if listed:
            self._own.inner_walls[:] = listed
        self.landmarks = self._own.landmarks
        self.inner_walls = self._own.inner_walls

    @property
    def facts(self) -> dict[str, float]:
        return {"wall_width": self.wall_width, "door": self.door}

    @property
    def _own(self) -> HardSpreadArrays:
        return self._arrays_of_hard_spread

    def seed(self, seeds: Sequence[int | None]) -> None:
        super().seed(seeds)
        if self.walls == "fixed":
            self._own.walls_drawn[:] = False

    def _reset(self, worlds: np.ndarray) -> None:
        _reset(worlds, self._handle, self.wall_width, self.door, self.walls == "fixed")

    def _step(self, actions: np.ndarray) -> int:
        return _step(
            actions,
            self._handle,
            self.wall_width,
            self.door,
            self.phi,
            self.exclusive_cover,
            self.max_steps,
        )

    def states(self) -> np.ndarray:
        parts = (self.positions, self.velocities, self._own.landmarks, self._own.inner_walls)
        return np.concatenate([part.reshape(self.n_worlds, -1) for part in parts], axis=1, dtype=np.float32)

    def episode_metrics(self) -> np.ndarray:
        n = self.n_agents
        totals = self._own.totals
        means = totals / np.maximum(self.steps, 1)[:, np.newaxis]
        columns = (
            means[:, AGENTS_IN_CONTACT] / n,
            means[:, PAIRS_IN_CONTACT],
            means[:, AGENTS_AT_WALLS],
            means[:, AGENT_DISTANCES],
            means[:, LANDMARK_DISTANCES],
            means[:, AGENT_DISTANCES] / n,
            means[:, COVERED],
            totals[:, COVERED_LAST],
            means[:, COVERED] / n,
            totals[:, COVERED_LAST] / n,
            totals[:, DISTANCE_TERM] / n,
            totals[:, COLLISION_TERM] / n,
            totals[:, COVER_TERM] / n,
        )
        return np.stack(columns, axis=1)

    def scene(self, world: int) -> Scene:
        landmarks = [Disc(x, y, LANDMARK_RADIUS, PALETTE["landmark"]) for x, y in self._own.landmarks[world]]
        agents = [Disc(x, y, AGENT_RADIUS, PALETTE["agent"], label=str(i)) for i, (x, y) in enumerate(self.positions[world])]
        half = self.wall_width / 2
        pieces = []
        for x, door_y in self._own.inner_walls[world]:
            pieces.append(Rectangle(x - half, -HALF_SIZE, x + half, door_y - self.door / 2, PALETTE["wall"]))
            pieces.append(Rectangle(x - half, door_y + self.door / 2, x + half, HALF_SIZE, PALETTE["wall"]))
        covered = int(self._own.totals[world, COVERED_LAST])
        caption = f"step {self.steps[world]}/{self.max_steps}  covered {covered}/{self.n_agents}"
        return Scene(HALF_SIZE, agents + landmarks, pieces, caption)  # a covered landmark shows on its agent


def _listed_walls(
    walls: str | Sequence[tuple[float, float]], wall_width: float, door: float
) -> list[tuple[float, float]] | None:
    """
    Check the settings of the walls.

    :return: the walls as (x, y of the door's centre), None if they are to be drawn
    :raises ValueError: if an agent could not pass a door, could run through a wall, or had no room
    """
    require_at_least("wall_width", wall_width, MIN_WALL_WIDTH)
    if not 2 * AGENT_RADIUS < door < HALF_SIZE:
        raise ValueError(f"door is {door}; it must be wider than an agent, {2 * AGENT_RADIUS}, and less than {HALF_SIZE}")
    if isinstance(walls, str):
        if walls not in WALL_LAYOUTS:
            near = difflib.get_close_matches(walls, WALL_LAYOUTS, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else f"; give a list, or one of {', '.join(WALL_LAYOUTS)}"
            raise ValueError(f"unknown walls {walls!r}{hint}")
        widest = (2 * HALF_SIZE - (N_RANDOM_WALLS + 1) * MIN_ROOM_WIDTH) / N_RANDOM_WALLS
        if walls != "none" and wall_width > widest:
            raise ValueError(f"wall_width is {wall_width}; two walls leave three rooms of {MIN_ROOM_WIDTH} up to {widest}")
        return [] if walls == "none" else None
    try:
        listed = [(float(x), float(door_y)) for x, door_y in walls]
    except (TypeError, ValueError):
        raise ValueError(f"walls is {walls}; it must be a list of (x, y of the door's centre)") from None
    _check_rooms(listed, wall_width, door)
    return listed


def _check_rooms(walls: list[tuple[float, float]], wall_width: float, door: float) -> None:
    """
    :param walls: (x, y of the door's centre) of each
    :raises ValueError: if a room is narrower than an agent, or a door reaches beyond the plane
    """
    least = 2 * AGENT_RADIUS
    face = -HALF_SIZE
    for x, door_y in sorted(walls):
        if not x - wall_width / 2 >= face + least:
            raise ValueError(f"the wall at x = {x} leaves no room to its left; an agent needs {least}")
        if not x + wall_width / 2 <= HALF_SIZE - least:
            raise ValueError(f"the wall at x = {x} leaves no room to its right; an agent needs {least}")
        if not abs(door_y) <= HALF_SIZE - door / 2:
            raise ValueError(f"the door at y = {door_y} reaches beyond the plane; possible is ±{HALF_SIZE - door / 2}")
        face = x + wall_width / 2


@kernel(nogil=True)
def _reset(worlds, handle, wall_width, door, keep_walls):
    """
    Start new episodes.

    :param worlds: indices of the worlds
    :param handle: on WorldArrays and HardSpreadArrays
    :param wall_width: width of the walls
    :param door: height of the doors
    :param keep_walls: whether walls that are drawn now stay for later episodes
    """
    common, own = handle.common, handle.own
    for world in worlds:
        if not own.walls_drawn[world]:
            _draw_walls(common.rng, world, own.inner_walls[world], wall_width, door)
            own.walls_drawn[world] = keep_walls
        for i in range(common.positions.shape[1]):
            _draw_free_position(
                common.rng, world, common.positions[world, i], AGENT_RADIUS, own.inner_walls[world], wall_width, door
            )
            _draw_free_position(
                common.rng, world, own.landmarks[world, i], LANDMARK_RADIUS, own.inner_walls[world], wall_width, door
            )
        common.velocities[world] = 0.0
        common.terminated[world] = False
        common.rewards[world] = 0.0
        common.returns[world] = 0.0
        common.steps[world] = 0
        common.episode_terminated[world] = False
        common.episode_truncated[world] = False
        own.totals[world] = 0.0
        _observe(common.observations[world], common.positions[world], common.velocities[world], own.landmarks[world])


@kernel
def _draw_walls(rng, world, walls, wall_width, door):
    """
    Draw two walls: room widths uniform among those of at least MIN_ROOM_WIDTH, and per wall a door that is uniform
    in y with at least half a door of wall above and below.

    :param walls: (2, 2), filled
    """
    spare = 2 * HALF_SIZE - 2 * wall_width - 3 * MIN_ROOM_WIDTH
    one = physics.uniform(rng, world, 0.0, spare)
    other = physics.uniform(rng, world, 0.0, spare)
    walls[0, 0] = -HALF_SIZE + MIN_ROOM_WIDTH + min(one, other) + wall_width / 2
    walls[1, 0] = HALF_SIZE - MIN_ROOM_WIDTH - (spare - max(one, other)) - wall_width / 2
    for k in range(2):
        walls[k, 1] = physics.uniform(rng, world, door - HALF_SIZE, HALF_SIZE - door)


@kernel
def _draw_free_position(rng, world, position, radius, walls, wall_width, door):
    """
    Draw a position uniformly among those where a disc touches no wall.

    :param position: (2,), filled
    """
    free = False
    while not free:
        position[0] = physics.uniform(rng, world, radius - HALF_SIZE, HALF_SIZE - radius)
        position[1] = physics.uniform(rng, world, radius - HALF_SIZE, HALF_SIZE - radius)
        free = True
        for k in range(walls.shape[0]):
            if _distance_to_wall(position, walls[k], wall_width, door) < radius:
                free = False


@kernel
def _distance_to_wall(position, wall, wall_width, door):
    """Distance of a point from the faces of a wall with a door, 0 inside the wall."""
    across = max(abs(position[0] - wall[0]) - wall_width / 2, 0.0)
    along = max(door / 2 - abs(position[1] - wall[1]), 0.0)
    return math.sqrt(across * across + along * along)


@kernel
def touches_wall(position, walls, wall_width, door):
    """Whether an agent's centre is closer than its radius to the face of an inner or outer wall."""
    if max(abs(position[0]), abs(position[1])) > HALF_SIZE - AGENT_RADIUS:
        return True
    for k in range(walls.shape[0]):
        if _distance_to_wall(position, walls[k], wall_width, door) < AGENT_RADIUS:
            return True
    return False


@kernel(nogil=True)
def _step(actions, handle, wall_width, door, phi, exclusive_cover, max_steps):
    """
    Step all worlds: forces, motion, rewards, metrics, observations.

    :param actions: (E, n, 2)
    :param handle: on WorldArrays and HardSpreadArrays
    :return: number of worlds whose episode is over; REFUSED, and nothing was done, if an action is not finite
    """
    if not physics.all_finite(actions):
        return REFUSED
    common, own = handle.common, handle.own
    n_worlds, n, _ = actions.shape
    n_over = 0
    radii = np.full(n, AGENT_RADIUS)
    max_speeds = np.full(n, np.inf)
    forces = np.empty((n, 2))
    previous = np.empty((n, 2))
    collided = np.empty(n, dtype=np.bool_)
    covers = np.empty(n, dtype=np.bool_)
    nearest = np.empty(n)
    for world in range(n_worlds):
        positions = common.positions[world]
        velocities = common.velocities[world]
        landmarks = own.landmarks[world]
        walls = own.inner_walls[world]
        totals = own.totals[world]
        alive = common.alive[world]

        for i in range(n):
            forces[i, 0] = AGENT_ACCELERATION * physics.clipped(actions[world, i, 0], 1.0)
            forces[i, 1] = AGENT_ACCELERATION * physics.clipped(actions[world, i, 1], 1.0)
        physics.add_body_contacts(forces, positions, radii, alive)
        _add_wall_contacts(forces, positions, walls, wall_width, door)

        previous[:] = positions
        physics.integrate(positions, velocities, forces, max_speeds, alive)
        physics.clip_to_plane(positions, HALF_SIZE)
        for i in range(n):
            for k in range(walls.shape[0]):
                door_y = walls[k, 1]
                physics.stop_at_mid_line(previous[i], positions[i], walls[k, 0], door_y - door / 2, door_y + door / 2)

        _find_contacts(collided, positions, walls, wall_width, door, totals)
        _find_covered(covers, nearest, positions, landmarks, exclusive_cover, totals)
        for i in range(n):
            distance_term = -phi * nearest[i]
            collision_term = COLLISION_PENALTY if collided[i] else 0.0
            cover_term = COVER_REWARD if covers[i] else 0.0
            reward = distance_term + collision_term + cover_term
            common.rewards[world, i] = reward
            common.returns[world, i] += common.rewards[world, i]
            totals[DISTANCE_TERM] += distance_term
            totals[COLLISION_TERM] += collision_term
            totals[COVER_TERM] += cover_term

        common.steps[world] += 1
        common.episode_truncated[world] = common.steps[world] >= max_steps
        n_over += common.episode_truncated[world]
        _observe(common.observations[world], positions, velocities, landmarks)
    return n_over


@kernel
def _add_wall_contacts(forces, positions, walls, wall_width, door):
    """
    Add the forces of the outer walls, whose faces are the edges of the plane, and of both pieces of each inner wall.

    :param forces: (n, 2), added to
    """
    edge = HALF_SIZE + wall_width / 2
    for i in range(positions.shape[0]):
        x, y = positions[i, 0], positions[i, 1]
        for middle in (-edge, edge):
            forces[i, 0] += physics.wall_force(x - middle, y, -edge, edge, AGENT_RADIUS, wall_width)[0]
            forces[i, 1] += physics.wall_force(y - middle, x, -edge, edge, AGENT_RADIUS, wall_width)[0]
        for k in range(walls.shape[0]):
            across = x - walls[k, 0]
            for start, end in ((-edge, walls[k, 1] - door / 2), (walls[k, 1] + door / 2, edge)):
                force_x, force_y = physics.wall_force(across, y, start, end, AGENT_RADIUS, wall_width)
                forces[i, 0] += force_x
                forces[i, 1] += force_y


@kernel
def _find_contacts(collided, positions, walls, wall_width, door, totals):
    """
    Find the agents that touch another one or a wall, and count them.

    :param collided: (n,), filled
    :param totals: AGENTS_IN_CONTACT, PAIRS_IN_CONTACT, AGENTS_AT_WALLS are added to
    """
    n = positions.shape[0]
    for i in range(n):
        collided[i] = touches_wall(positions[i], walls, wall_width, door)
        totals[AGENTS_AT_WALLS] += collided[i]
    for i in range(n):
        for j in range(i + 1, n):
            if physics.distance(positions[i], positions[j]) < 2 * AGENT_RADIUS:
                totals[PAIRS_IN_CONTACT] += 1
                collided[i] = True
                collided[j] = True
    for i in range(n):
        totals[AGENTS_IN_CONTACT] += collided[i]


@kernel
def _find_covered(covers, nearest, positions, landmarks, exclusive_cover, totals):
    """
    Find the agents that stand on a landmark, and how far each is from its nearest one.

    :param covers: (n,), filled: whether the agent is paid for a landmark
    :param nearest: (n,), filled: distance to the nearest landmark
    :param exclusive_cover: of several agents on a landmark pay the closest one, the first among equals
    :param totals: AGENT_DISTANCES, LANDMARK_DISTANCES, COVERED are added to, COVERED_LAST is set
    """
    n = positions.shape[0]
    covered = 0
    covers[:] = False
    nearest[:] = np.inf  # squares, until all are known
    for j in range(n):
        closest = 0
        closest_square = np.inf
        for i in range(n):
            square = physics.squared_distance(positions[i], landmarks[j])
            nearest[i] = min(nearest[i], square)
            if square < closest_square:
                closest, closest_square = i, square
        closest_distance = math.sqrt(closest_square)
        if closest_distance <= COVER_DISTANCE:
            covers[closest] = True
            covered += 1
        totals[LANDMARK_DISTANCES] += closest_distance
    for i in range(n):
        nearest[i] = math.sqrt(nearest[i])
        if not exclusive_cover:
            covers[i] = nearest[i] <= COVER_DISTANCE
        totals[AGENT_DISTANCES] += nearest[i]
    totals[COVERED] += covered
    totals[COVERED_LAST] = covered


@kernel
def _observe(observations, positions, velocities, landmarks):
    """
    Write the agents' observations, one after the other.

    :param observations: joint row, filled
    """
    n = positions.shape[0]
    column = 0
    for i in range(n):
        x, y = positions[i, 0], positions[i, 1]
        observations[column] = velocities[i, 0]
        observations[column + 1] = velocities[i, 1]
        observations[column + 2] = x
        observations[column + 3] = y
        column += 4
        for j in range(n):
            observations[column] = landmarks[j, 0] - x
            observations[column + 1] = landmarks[j, 1] - y
            column += 2
        for j in range(n):
            if j != i:
                observations[column] = positions[j, 0] - x
                observations[column + 1] = positions[j, 1] - y
                column += 2
