"""The upper bound of Hard Spread: who goes to which landmark, by which way, without touching anybody."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sb3_kfcv.envs.physics import DT
from sb3_kfcv.envs.steering import KEPT, approach_velocity, force_for

# How far a body stays off the walls.
_CLEARANCE = 0.02
# Giving way: bodies look this far ahead (seconds), and like to stay this much farther apart than a touch.
_HORIZON = 0.3
_ELBOW_ROOM = 0.02
# What a body weighs against the wish to go straight (squared speed differences): coming too near to another, per unit
# of distance, and walking into a wall.
_TOUCH_COST = 100.0
_WALL_COST = 1000.0


def assign(costs: np.ndarray) -> np.ndarray:
    """
    Hand out the goals so that the costs add up to the least.

    :param costs: cost of each goal for each agent (B, n, n)
    :return: goal of each agent (B, n)
    """
    from scipy.optimize import linear_sum_assignment  # slow to import, and few need it

    return np.stack([linear_sum_assignment(cost)[1] for cost in costs])


@dataclass(frozen=True)
class Rooms:
    """
    A square plane cut into rooms by vertical walls of full height with one door each, for B worlds at once.

    :param walls: x of the wall's centre line and y of the door's centre (B, walls, 2)
    :param half_width: the plane is [-half_width, half_width]²
    :param wall_width: thickness of a wall
    :param door: height of a door
    :param radius: of the bodies that walk here
    """

    walls: np.ndarray
    half_width: float
    wall_width: float
    door: float
    radius: float

    @property
    def reach(self) -> float:
        """A centre nearer than this to a wall's centre line is in the wall or in its door."""
        return self.wall_width / 2 + self.radius

    @property
    def play(self) -> float:
        """How far a centre in a door may be off the door's middle."""
        return self.door / 2 - self.radius

    def standing_places(self, points: np.ndarray) -> np.ndarray:
        """
        The places nearest to some points where a body touches no wall.

        :param points: outside the walls, but maybe nearer to one than a body's radius (B, n, 2)
        :return: (B, n, 2)
        """
        limit = self.half_width - self.radius - _CLEARANCE
        x, y = np.moveaxis(np.clip(points, -limit, limit), -1, 0)
        for wall_x, door_y in self._left_to_right(axes=2):
            close = np.abs(x - wall_x) < self.reach + _CLEARANCE
            in_door = close & (np.abs(y - door_y) < self.door / 2)
            beside = wall_x + np.where(x < wall_x, -1, 1) * (self.reach + _CLEARANCE)
            in_play = np.clip(y, door_y - self.play + _CLEARANCE, door_y + self.play - _CLEARANCE)
            x, y = np.where(close & ~in_door, beside, x), np.where(in_door, in_play, y)
        return np.stack([x, y], axis=-1)

    def path_lengths(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """
        Lengths of the ways from every start to every end, straight from door to door.

        :param starts: (B, n, 2)
        :param ends: (B, k, 2)
        :return: (B, n, k)
        """
        a, b = np.broadcast_arrays(starts[:, :, None], ends[:, None])
        a_is_left = (a[..., 0] < b[..., 0])[..., None]
        here, goal = np.where(a_is_left, a, b), np.where(a_is_left, b, a)
        left, right = here[..., 0], goal[..., 0]
        length = np.zeros(left.shape)
        for x, door_y in self._left_to_right():
            crossed = (left < x) & (x < right)
            entry = np.stack(np.broadcast_arrays(x - self.reach, door_y), axis=-1)
            leg = np.linalg.norm(entry - here, axis=-1) + 2 * self.reach
            length += np.where(crossed, leg, 0)
            leaving = np.stack(np.broadcast_arrays(x + self.reach, door_y), axis=-1)
            here = np.where(crossed[..., None], leaving, here)
        return length + np.linalg.norm(goal - here, axis=-1)

    def waypoints(self, positions: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """
        Where to head now so as to reach the goal: the goal itself, or the next door's near side until the body is
        in line with the door and its far side from then on.

        :param positions: (B, n, 2)
        :param goals: (B, n, 2)
        :return: (B, n, 2)
        """
        x, y = positions[..., 0], positions[..., 1]
        goal_x, goal_y = goals[..., 0], goals[..., 1]
        heading = np.where(goal_x >= x, 1.0, -1.0)
        waypoint = goals
        first = np.full(x.shape, np.inf)
        for wall_x, door_y in self._left_to_right(axes=2):
            in_the_way = (np.minimum(x, goal_x) < wall_x + self.reach) & (np.maximum(x, goal_x) > wall_x - self.reach)
            order = heading * wall_x
            in_line = (np.abs(y - door_y) < self.play - _CLEARANCE) | (np.abs(x - wall_x) < self.reach)
            goal_in_door = np.abs(goal_x - wall_x) < self.reach
            near_x = wall_x - heading * (self.reach + 2 * _CLEARANCE)
            far_x = np.where(goal_in_door, goal_x, wall_x + heading * (self.reach + 1))
            far_y = np.where(goal_in_door, goal_y, door_y)
            via_door = np.stack([np.where(in_line, far_x, near_x), np.where(in_line, far_y, door_y)], axis=-1)
            waypoint = np.where((in_the_way & (order < first))[..., None], via_door, waypoint)
            first = np.where(in_the_way, np.minimum(first, order), first)
        return waypoint

    def blocked(self, positions: np.ndarray) -> np.ndarray:
        """
        Whether a body would touch a wall.

        :param positions: (B, n, candidates, 2)
        :return: (B, n, candidates)
        """
        x, y = positions[..., 0], positions[..., 1]
        hit = np.abs(positions).max(axis=-1) > self.half_width - self.radius
        for wall_x, door_y in self._left_to_right():
            hit |= (np.abs(x - wall_x) < self.reach) & (np.abs(y - door_y) > self.play)
        return hit

    def _left_to_right(self, axes: int = 3) -> list[tuple[np.ndarray, np.ndarray]]:
        """The walls' x and door y by x, each shaped (B, 1, …) to go with arrays of so many axes."""
        order = np.argsort(self.walls[..., 0], axis=-1)[..., None]
        walls = np.take_along_axis(self.walls, order, axis=1)
        shape = (-1,) + (1,) * (axes - 1)
        return [(walls[:, w, 0].reshape(shape), walls[:, w, 1].reshape(shape)) for w in range(walls.shape[1])]


def oracle_forces(
    positions: np.ndarray, velocities: np.ndarray, landmarks: np.ndarray, rooms: Rooms, accel: float
) -> np.ndarray:
    """
    Forces that cover the landmarks: the assignment with the shortest ways in all, each agent on its way through the
    doors, braking and giving way where it would touch a wall or another agent.

    :param positions: (B, n, 2)
    :param velocities: (B, n, 2)
    :param landmarks: (B, n, 2)
    :param rooms: the walls and doors
    :param accel: acceleration under full force
    :return: (B, n, 2)
    """
    landmarks = rooms.standing_places(landmarks)
    lengths = rooms.path_lengths(positions, landmarks)
    choice = assign(lengths)
    goals = np.take_along_axis(landmarks, choice[..., None], axis=1)
    left_to_go = np.take_along_axis(lengths, choice[..., None], axis=2)[..., 0]
    wanted = approach_velocity(rooms.waypoints(positions, goals) - positions, accel)
    return _give_way(wanted, positions, velocities, left_to_go, rooms, accel)


def _give_way(
    wanted: np.ndarray,
    positions: np.ndarray,
    velocities: np.ndarray,
    left_to_go: np.ndarray,
    rooms: Rooms,
    accel: float,
) -> np.ndarray:
    """
    Of the wished-for force and a grid of others, the one with the best balance of progress and safety.

    Of two agents the one that is nearer to its goal gives way.

    :param wanted: velocities that the agents would like to have (B, n, 2)
    :param left_to_go: lengths of the ways to the goals (B, n)
    :return: forces (B, n, 2)
    """
    wished = force_for(wanted, velocities, accel)
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 2), axis=-1).reshape(-1, 2)
    others = np.broadcast_to(grid, (*wished.shape[:2], *grid.shape))
    forces = np.concatenate([wished[:, :, None], others], axis=2)  # (B, n, candidates, 2)
    after = KEPT * velocities[:, :, None] + accel * DT * forces
    detour = ((after - wanted[:, :, None]) ** 2).sum(axis=-1)
    hits_wall = rooms.blocked(positions[:, :, None] + 1.5 * DT * after)

    # (B, n, candidates, n others): closest approach within the horizon if all keep their speed
    expected = KEPT * velocities + accel * DT * wished
    offset = (positions[:, None] - positions[:, :, None])[:, :, None]
    drift = expected[:, None, None] - after[:, :, :, None]
    speed2 = (drift**2).sum(axis=-1)
    when = np.clip(-(offset * drift).sum(axis=-1) / np.maximum(speed2, 1e-9), 0, _HORIZON)
    gap = np.linalg.norm(offset + when[..., None] * drift, axis=-1)
    intrusion = np.maximum(2 * rooms.radius + _ELBOW_ROOM - gap, 0)
    yields = (left_to_go[:, :, None] <= left_to_go[:, None]) & ~np.eye(positions.shape[1], dtype=bool)  # (B, n, n)
    touch = (intrusion * yields[:, :, None]).sum(axis=-1)

    cost = detour + _TOUCH_COST * touch + _WALL_COST * hits_wall
    return np.take_along_axis(forces, cost.argmin(axis=-1)[..., None, None], axis=2)[:, :, 0]
