"""Grassland: wolves hunt sheep, sheep flee and graze."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np

from sb3_kfcv.common.kernels import kernel
from sb3_kfcv.envs import physics
from sb3_kfcv.envs.drawing import PALETTE, Disc, Scene
from sb3_kfcv.envs.particle_worlds import REFUSED, ParticleWorlds, require_at_least

# Section 5.2 of the paper, with the bodies of Grassland in https://github.com/qian18long/epciclr2020
HALF_SIZE = 1.0
"""The plane is [−1, 1]²; positions are clipped to it."""
GRASS_HALF_SIZE = 0.9
"""Grass and obstacles lie in [−0.9, 0.9]²."""
WOLF_RADIUS = 0.075
WOLF_ACCELERATION = 2.0
WOLF_MAX_SPEED = 2.0
"""Never reached by own force (0.8 per axis): it limits the push of a contact."""
SHEEP_RADIUS = 0.05
SHEEP_ACCELERATION = 4.0
"""Twice the wolf's, and so is the speed that it reaches (1.6 per axis)."""
SHEEP_MAX_SPEED = 3.0
GRASS_RADIUS = 0.03
OBSTACLE_RADIUS = 0.1
MAX_OBSTACLES = 20
"""So many leave more than half of the plane free."""

CAPTURE_DISTANCE = WOLF_RADIUS + SHEEP_RADIUS
GRAZE_DISTANCE = SHEEP_RADIUS + GRASS_RADIUS
CAPTURE_REWARD = 5.0
"""C1 of eq. 17: for a wolf that touches a sheep; the sheep pays it."""
BOUNDARY_START = 0.9
BOUNDARY_SLOPE = -200.0
"""C2 of eq. 18: reward per unit of max(|x|, |y|) beyond 0.9."""
GRASS_REWARD = 2.0
"""C3 of eq. 19: for a sheep that touches grass."""

FADE_STEPS = 5
"""For so many steps a picture shows a sheep that was eaten."""

BODY = 5
"""What an agent sees of each body: position, velocity, and that it lives."""

# Columns of GrasslandArrays.totals: sums over the episode, and over all wolves or all sheep
WOLF_DISTANCE, WOLF_CAPTURE, WOLF_BOUNDARY = 0, 1, 2
SHEEP_DISTANCE, SHEEP_CAPTURE, SHEEP_BOUNDARY, SHEEP_GRASS = 3, 4, 5, 6
N_TOTALS = 7


class GrasslandArrays(NamedTuple):
    """What Grassland adds to :class:`WorldArrays`; E worlds."""

    grass: np.ndarray  # (E, n_grass, 2)
    obstacles: np.ndarray  # (E, n_obstacles, 2)
    totals: np.ndarray  # (E, N_TOTALS)


class GrasslandWorlds(ParticleWorlds):
    """
    Section 5.2 of the paper: wolves eat the sheep that they touch, sheep eat grass; sheep are twice as fast.

    A sheep that is eaten gets the reward of that step and leaves the world: nothing touches it, and it is all zeros
    in every observation and in the state. The episode terminates with the last sheep. Grass grows again at once,
    somewhere else.

    An agent's observation is its velocity (2), position (2) and 1 for being alive; the positions relative to its own
    of the grass (2 each); for each other agent its relative position (2), velocity (2) and whether it lives (1), zeros
    for the dead; last the relative positions of the obstacles (2 each). The own observation of a dead agent is zeros.
    The state is positions, velocities (2 per agent), alive (1 per agent), grass and obstacles (2 each).

    Rewards (eq. 16–21): a wolf gets −φ · distance to its nearest sheep (among those that lived at the start of the
    step), +5 for each sheep that it touches, and −200 per unit of max(|x|, |y|) beyond 0.9. A sheep gets
    φ · sum of its distances to the wolves, −5 if it is eaten, the same −200, and +2 for each grass that it touches.

    :param n_worlds: number of worlds
    :param n_wolves: number of wolves
    :param n_sheep: number of sheep
    :param n_grass: number of pieces of grass
    :param n_obstacles: number of discs of radius 0.1 in the way, placed anew in each episode; at most 20
    :param phi: weight φ of the distances
    :param sheep_pays_each: a sheep pays 5 to each wolf that touches it, not 5 in all
    :param max_steps: steps after which an episode is truncated
    :param continuous_actions: forces in [−1, 1]², or one of five directions
    """

    metric_names = (
        "return_per_wolf",
        "return_per_sheep",
        "wolf_distance_term",
        "wolf_capture_term",
        "wolf_boundary_term",
        "sheep_distance_term",
        "sheep_capture_term",
        "sheep_boundary_term",
        "sheep_grass_term",
        "sheep_eaten",
        "wolves_win",
    )
    scalar_reward = "wolf"
    wins: ClassVar[Mapping[str, str]] = {"wolf": "wolves_win"}

    def __init__(
        self,
        n_worlds: int = 1,
        n_wolves: int = 16,
        n_sheep: int = 12,
        n_grass: int = 4,
        n_obstacles: int = 0,
        phi: float = 0.1,
        sheep_pays_each: bool = False,
        max_steps: int = 25,
        continuous_actions: bool = True,
    ):
        require_at_least("n_wolves", n_wolves, 1)
        require_at_least("n_sheep", n_sheep, 1)
        require_at_least("n_grass", n_grass, 0)
        require_at_least("phi", phi, 0.0)
        if not 0 <= n_obstacles <= MAX_OBSTACLES:
            raise ValueError(f"n_obstacles is {n_obstacles}; it must be from 0 to {MAX_OBSTACLES}")
        n = n_wolves + n_sheep
        super().__init__(
            n_worlds=n_worlds,
            agents=[f"wolf_{i}" for i in range(n_wolves)] + [f"sheep_{i}" for i in range(n_sheep)],
            obs_sizes=[5 + 2 * n_grass + 5 * (n - 1) + 2 * n_obstacles] * n,
            state_size=5 * n + 2 * n_grass + 2 * n_obstacles,
            max_steps=max_steps,
            continuous_actions=continuous_actions,
        )
        self.n_wolves = n_wolves
        self.n_sheep = n_sheep
        self.phi = float(phi)
        self.sheep_pays_each = bool(sheep_pays_each)
        self._arrays_of_grassland = GrasslandArrays(
            grass=np.zeros((n_worlds, n_grass, 2)),
            obstacles=np.zeros((n_worlds, n_obstacles, 2)),
            totals=np.zeros((n_worlds, N_TOTALS)),
        )
        self.grass = self._own.grass
        self.obstacles = self._own.obstacles

    @property
    def facts(self) -> dict[str, float]:
        return {"n_obstacles": self.obstacles.shape[1]}

    @property
    def _own(self) -> GrasslandArrays:
        return self._arrays_of_grassland

    def _reset(self, worlds: np.ndarray) -> None:
        _reset(worlds, self._handle, self.n_wolves)

    def _step(self, actions: np.ndarray) -> int:
        return _step(actions, self._handle, self.n_wolves, self.phi, self.sheep_pays_each, self.max_steps)

    def states(self) -> np.ndarray:
        rows = (self.n_worlds, -1)
        alive = np.repeat(self.alive, 2, axis=1)  # (E, 2n), for x and y
        positions, velocities = self.positions.reshape(rows) * alive, self.velocities.reshape(rows) * alive
        parts = (positions, velocities, self.alive, self.grass.reshape(rows), self.obstacles.reshape(rows))
        return np.concatenate(parts, axis=1, dtype=np.float32)

    def episode_metrics(self) -> np.ndarray:
        totals = self._own.totals
        eaten = 1.0 - self.alive[:, self.n_wolves :].mean(axis=1)
        columns = (
            self.returns[:, : self.n_wolves].mean(axis=1),
            self.returns[:, self.n_wolves :].mean(axis=1),
            totals[:, WOLF_DISTANCE] / self.n_wolves,
            totals[:, WOLF_CAPTURE] / self.n_wolves,
            totals[:, WOLF_BOUNDARY] / self.n_wolves,
            totals[:, SHEEP_DISTANCE] / self.n_sheep,
            totals[:, SHEEP_CAPTURE] / self.n_sheep,
            totals[:, SHEEP_BOUNDARY] / self.n_sheep,
            totals[:, SHEEP_GRASS] / self.n_sheep,
            eaten,
            eaten == 1.0,
        )
        return np.stack(columns, axis=1)

    def scene(self, world: int) -> Scene:
        discs = [Disc(x, y, OBSTACLE_RADIUS, PALETTE["obstacle"]) for x, y in self.obstacles[world]]
        discs += [Disc(x, y, GRASS_RADIUS, PALETTE["grass"]) for x, y in self.grass[world]]
        for i, (x, y) in enumerate(self.positions[world]):
            wolf = i < self.n_wolves
            radius, colour = (WOLF_RADIUS, PALETTE["wolf"]) if wolf else (SHEEP_RADIUS, PALETTE["sheep"])
            opacity = 1.0
            if not self.alive[world, i]:
                opacity -= (self.steps[world] - self.died_at[world, i] + 1) / (FADE_STEPS + 1)
            if opacity > 0.0:
                discs.append(Disc(x, y, radius, colour, opacity))
        eaten = self.n_sheep - int(self.alive[world, self.n_wolves :].sum())
        caption = f"step {self.steps[world]}/{self.max_steps}  eaten {eaten}/{self.n_sheep}"
        return Scene(HALF_SIZE, discs, caption=caption)


@kernel(nogil=True)
def _reset(worlds, handle, n_wolves):
    """
    Start new episodes.

    :param worlds: indices of the worlds
    :param handle: on WorldArrays and GrasslandArrays
    :param n_wolves: the agents after so many are sheep
    """
    common, own = handle.common, handle.own
    for world in worlds:
        obstacles = own.obstacles[world]
        for k in range(obstacles.shape[0]):
            _draw_free_position(common.rng, world, obstacles[k], GRASS_HALF_SIZE, obstacles[:0], 0.0)
        for i in range(common.positions.shape[1]):
            reach = OBSTACLE_RADIUS + (WOLF_RADIUS if i < n_wolves else SHEEP_RADIUS)
            _draw_free_position(common.rng, world, common.positions[world, i], HALF_SIZE, obstacles, reach)
        for k in range(own.grass.shape[1]):
            _draw_grass(common.rng, world, own.grass[world, k], obstacles)
        common.velocities[world] = 0.0
        common.alive_before[world] = True
        common.alive[world] = True
        common.died_at[world] = -1
        common.terminated[world] = False
        common.rewards[world] = 0.0
        common.returns[world] = 0.0
        common.steps[world] = 0
        common.episode_terminated[world] = False
        common.episode_truncated[world] = False
        own.totals[world] = 0.0
        _observe(
            common.observations[world],
            common.positions[world],
            common.velocities[world],
            common.alive[world],
            own.grass[world],
            obstacles,
        )


@kernel
def _draw_free_position(rng, world, position, half_size, obstacles, reach):
    """
    Draw a position uniformly among those that keep their distance from the obstacles.

    :param position: (2,), filled
    :param half_size: the position lies in [−half_size, half_size]²
    :param obstacles: (obstacles, 2)
    :param reach: least distance from the centre of an obstacle
    """
    free = False
    while not free:
        position[0] = physics.uniform(rng, world, -half_size, half_size)
        position[1] = physics.uniform(rng, world, -half_size, half_size)
        free = True
        for k in range(obstacles.shape[0]):
            if physics.distance(position, obstacles[k]) < reach:
                free = False


@kernel
def _draw_grass(rng, world, position, obstacles):
    """Let a piece of grass grow; ``position`` (2,) is filled."""
    _draw_free_position(rng, world, position, GRASS_HALF_SIZE, obstacles, OBSTACLE_RADIUS + GRASS_RADIUS)


@kernel(nogil=True)
def _step(actions, handle, n_wolves, phi, sheep_pays_each, max_steps):
    """
    Step all worlds: forces, motion, rewards, deaths, metrics, observations.

    :param actions: (E, n, 2)
    :param handle: on WorldArrays and GrasslandArrays
    :return: number of worlds whose episode is over; REFUSED, and nothing was done, if an action is not finite
    """
    if not physics.all_finite(actions):
        return REFUSED
    common, own = handle.common, handle.own
    n_worlds, n, _ = actions.shape
    n_over = 0
    radii = np.full(n, SHEEP_RADIUS)
    radii[:n_wolves] = WOLF_RADIUS
    accelerations = np.full(n, SHEEP_ACCELERATION)
    accelerations[:n_wolves] = WOLF_ACCELERATION
    max_speeds = np.full(n, SHEEP_MAX_SPEED)
    max_speeds[:n_wolves] = WOLF_MAX_SPEED
    forces = np.empty((n, 2))
    rewards = np.empty(n)
    for world in range(n_worlds):
        positions = common.positions[world]
        velocities = common.velocities[world]
        alive = common.alive[world]
        alive_before = common.alive_before[world]
        grass = own.grass[world]
        obstacles = own.obstacles[world]

        for i in range(n):
            forces[i, 0] = accelerations[i] * physics.clipped(actions[world, i, 0], 1.0)
            forces[i, 1] = accelerations[i] * physics.clipped(actions[world, i, 1], 1.0)
        physics.add_body_contacts(forces, positions, radii, alive)
        physics.add_obstacle_contacts(forces, positions, radii, alive, obstacles, OBSTACLE_RADIUS)
        physics.integrate(positions, velocities, forces, max_speeds, alive)
        physics.clip_to_plane(positions, HALF_SIZE)

        common.steps[world] += 1
        alive_before[:] = alive
        rewards[:] = 0.0
        _hunt(rewards, alive, positions, alive_before, n_wolves, phi, sheep_pays_each, own.totals[world])
        _penalise_boundary(rewards, positions, alive_before, n_wolves, own.totals[world])
        _graze(rewards, grass, positions, alive_before, n_wolves, obstacles, common.rng, world, own.totals[world])

        sheep_left = False
        for i in range(n):
            common.rewards[world, i] = rewards[i]
            common.returns[world, i] += common.rewards[world, i]
            if alive_before[i] and not alive[i]:
                common.died_at[world, i] = common.steps[world]
                velocities[i] = 0.0
            sheep_left |= i >= n_wolves and alive[i]
        common.episode_terminated[world] = not sheep_left
        common.episode_truncated[world] = sheep_left and common.steps[world] >= max_steps
        for i in range(n):
            common.terminated[world, i] = not (alive[i] and sheep_left)
        n_over += common.episode_terminated[world] or common.episode_truncated[world]
        _observe(common.observations[world], positions, velocities, alive, grass, obstacles)
    return n_over


@kernel
def _hunt(rewards, alive, positions, alive_before, n_wolves, phi, sheep_pays_each, totals):
    """
    Pay wolves and sheep for their distances and captures, and mark the sheep that are eaten.

    :param rewards: (n,), added to
    :param alive: (n,), False for the sheep that are touched
    """
    n = positions.shape[0]
    nearest = np.full(n_wolves, np.inf)
    for sheep in range(n_wolves, n):
        if not alive_before[sheep]:
            continue
        distances = 0.0
        bites = 0
        for wolf in range(n_wolves):
            distance = physics.distance(positions[wolf], positions[sheep])
            distances += distance
            nearest[wolf] = min(nearest[wolf], distance)
            if distance < CAPTURE_DISTANCE:
                rewards[wolf] += CAPTURE_REWARD
                totals[WOLF_CAPTURE] += CAPTURE_REWARD
                bites += 1
        if bites > 0:
            alive[sheep] = False
            price = CAPTURE_REWARD * (bites if sheep_pays_each else 1)
            rewards[sheep] -= price
            totals[SHEEP_CAPTURE] -= price
        rewards[sheep] += phi * distances
        totals[SHEEP_DISTANCE] += phi * distances
    for wolf in range(n_wolves):
        if nearest[wolf] < np.inf:
            rewards[wolf] -= phi * nearest[wolf]
            totals[WOLF_DISTANCE] -= phi * nearest[wolf]


@kernel
def _penalise_boundary(rewards, positions, alive_before, n_wolves, totals):
    """
    Charge agents near the edge of the plane.

    :param rewards: (n,), added to
    """
    for i in range(positions.shape[0]):
        beyond = max(abs(positions[i, 0]), abs(positions[i, 1])) - BOUNDARY_START
        if alive_before[i] and beyond > 0.0:
            rewards[i] += BOUNDARY_SLOPE * beyond
            totals[WOLF_BOUNDARY if i < n_wolves else SHEEP_BOUNDARY] += BOUNDARY_SLOPE * beyond


@kernel
def _graze(rewards, grass, positions, alive_before, n_wolves, obstacles, rng, world, totals):
    """
    Pay the sheep for the grass that they touch, and let what was eaten grow elsewhere.

    :param rewards: (n,), added to
    :param grass: (n_grass, 2), changed where eaten
    """
    for k in range(grass.shape[0]):
        eaten = False
        for sheep in range(n_wolves, positions.shape[0]):
            if alive_before[sheep] and physics.distance(positions[sheep], grass[k]) < GRAZE_DISTANCE:
                rewards[sheep] += GRASS_REWARD
                totals[SHEEP_GRASS] += GRASS_REWARD
                eaten = True
        if eaten:
            _draw_grass(rng, world, grass[k], obstacles)


@kernel
def _observe(observations, positions, velocities, alive, grass, obstacles):
    """
    Write the agents' observations, one after the other.

    :param observations: joint row, filled; zeros for dead agents and where others are dead
    """
    n = positions.shape[0]
    size = observations.shape[0] // n
    first_other = BODY + 2 * grass.shape[0]
    first_obstacle = first_other + BODY * (n - 1)
    bodies = np.zeros(BODY * n)  # what there is to see of everybody, side by side; zeros for the dead
    origin = np.zeros(BODY * n)  # where it is seen from: added to the position of each of the living, zeros elsewhere
    for j in range(n):
        if alive[j]:
            bodies[BODY * j] = positions[j, 0]
            bodies[BODY * j + 1] = positions[j, 1]
            bodies[BODY * j + 2] = velocities[j, 0]
            bodies[BODY * j + 3] = velocities[j, 1]
            bodies[BODY * j + 4] = 1.0
    for i in range(n):
        own = observations[i * size : (i + 1) * size]
        if not alive[i]:
            own[:] = 0.0
            continue
        x, y = positions[i, 0], positions[i, 1]
        own[0] = velocities[i, 0]
        own[1] = velocities[i, 1]
        own[2] = x
        own[3] = y
        own[4] = 1.0
        for k in range(grass.shape[0]):
            own[BODY + 2 * k] = grass[k, 0] - x
            own[BODY + 2 * k + 1] = grass[k, 1] - y
        for j in range(n):
            if alive[j]:
                origin[BODY * j] = x
                origin[BODY * j + 1] = y
        before = BODY * i
        _subtract(own[first_other : first_other + before], bodies[:before], origin[:before])
        _subtract(own[first_other + before : first_obstacle], bodies[before + BODY :], origin[before + BODY :])
        for k in range(obstacles.shape[0]):
            own[first_obstacle + 2 * k] = obstacles[k, 0] - x
            own[first_obstacle + 2 * k + 1] = obstacles[k, 1] - y


@kernel
def _subtract(difference, these, those):
    """Fill ``difference`` with ``these`` less ``those``."""
    for column in range(difference.shape[0]):
        difference[column] = these[column] - those[column]
