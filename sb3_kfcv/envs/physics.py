"""
Motion of round bodies on a plane, after OpenAI's multiagent-particle-envs: forces, contacts, integration.

Every function treats one world, in place, and is compiled by numba. The constants and laws are those of
``multiagent/core.py`` in https://github.com/openai/multiagent-particle-envs; lengths are in world units, the mass
of a body is 1. Three things are ours, since the original leaves them undefined or open:

- bodies with the same centre are pushed apart along x (the original divides by zero);
- a centre stays inside the plane (:func:`clip_to_plane`);
- a centre stops at the middle line of a wall (:func:`stop_at_mid_line`). The contact law alone stops one agent at
  top speed at walls of width 0.2 or more, but not an agent that others push.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from sb3_kfcv.common.kernels import drop_stale_cache, kernel

drop_stale_cache(Path(__file__))

DT = 0.1
"""Time of one step."""
DAMPING = 0.25
"""Share of the velocity that is lost in one step."""
CONTACT_FORCE = 100.0
"""Force of a contact per unit of overlap."""
CONTACT_MARGIN = 1e-3
"""Softness of a contact: the force sets in over about this distance."""
CONTACT_RANGE = 40 * CONTACT_MARGIN
"""Gap beyond which a contact is not computed: its force is below 1e-18, nothing in float64."""
MID_LINE_GAP = 1e-6
"""Distance from a wall's middle line at which a centre is stopped, so that it keeps its side."""

# splitmix64 (Steele, Lea, Flood: Fast splittable pseudorandom number generators, 2014)
_SPLITMIX_STEP = np.uint64(0x9E3779B97F4A7C15)
_SPLITMIX_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_SPLITMIX_MIX_2 = np.uint64(0x94D049BB133111EB)
_2_TO_MINUS_53 = 2.0**-53


def rng_state(seed: int | None) -> np.uint64:
    """
    State of a world's random generator from a seed.

    :param seed: non-negative; None draws fresh entropy from the operating system
    """
    return np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]


@kernel
def uniform(rng, world, low, high):
    """
    Draw the next random number of a world, uniform in [low, high).

    :param rng: generator states, one uint64 per world; the state of ``world`` advances
    :param world: index of the world
    """
    rng[world] += _SPLITMIX_STEP
    bits = rng[world]
    bits = (bits ^ (bits >> np.uint64(30))) * _SPLITMIX_MIX_1
    bits = (bits ^ (bits >> np.uint64(27))) * _SPLITMIX_MIX_2
    bits = bits ^ (bits >> np.uint64(31))
    return low + (high - low) * ((bits >> np.uint64(11)) * _2_TO_MINUS_53)


@kernel
def clipped(value, limit):
    """``value`` limited to [−limit, limit]."""
    return min(max(value, -limit), limit)


@kernel
def all_finite(actions):
    """
    Whether no force is infinite or NaN.

    :param actions: (E, n, 2)
    """
    finite = True
    for value in actions.ravel():
        finite &= math.isfinite(value)
    return finite


@kernel
def contact_force(overlap):
    """
    Size of the force between two touching things: 100 · softplus(overlap / margin) · margin.

    :param overlap: how deep they overlap; negative for a gap
    """
    z = overlap / CONTACT_MARGIN
    return CONTACT_FORCE * CONTACT_MARGIN * (max(z, 0.0) + math.log1p(math.exp(-abs(z))))


@kernel
def out_of_reach(dx, dy, reach):
    """
    Whether two bodies are too far apart to push each other.

    :param dx: x of the one less x of the other
    :param dy: y of the one less y of the other
    :param reach: sum of the two radii
    """
    return dx * dx + dy * dy > (reach + CONTACT_RANGE) ** 2


@kernel
def push_apart(dx, dy, reach):
    """
    Force on a body at (dx, dy) from another one.

    :param dx: x of the body less x of the other
    :param dy: y of the body less y of the other
    :param reach: sum of the two radii
    :return: force along x and y
    """
    distance = math.sqrt(dx * dx + dy * dy)
    force = contact_force(reach - distance)
    if distance == 0.0:
        return force, 0.0
    return force * dx / distance, force * dy / distance


@kernel
def add_body_contacts(forces, positions, radii, alive):
    """
    Add the forces between all pairs of living bodies.

    :param forces: (n, 2), added to
    :param positions: (n, 2)
    :param radii: (n,)
    :param alive: (n,), the dead touch nobody
    """
    n = positions.shape[0]
    for i in range(n):
        if not alive[i]:
            continue
        for j in range(i + 1, n):
            dx, dy = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1]
            reach = radii[i] + radii[j]
            if out_of_reach(dx, dy, reach) or not alive[j]:
                continue
            force_x, force_y = push_apart(dx, dy, reach)
            forces[i, 0] += force_x
            forces[i, 1] += force_y
            forces[j, 0] -= force_x
            forces[j, 1] -= force_y


@kernel
def add_obstacle_contacts(forces, positions, radii, alive, obstacles, obstacle_radius):
    """
    Add the forces of immovable discs on the living bodies.

    :param forces: (n, 2), added to
    :param positions: (n, 2)
    :param radii: (n,)
    :param alive: (n,)
    :param obstacles: centres of the discs, (obstacles, 2)
    :param obstacle_radius: radius of every disc
    """
    for i in range(positions.shape[0]):
        if not alive[i]:
            continue
        for k in range(obstacles.shape[0]):
            dx, dy = positions[i, 0] - obstacles[k, 0], positions[i, 1] - obstacles[k, 1]
            reach = radii[i] + obstacle_radius
            if out_of_reach(dx, dy, reach):
                continue
            force_x, force_y = push_apart(dx, dy, reach)
            forces[i, 0] += force_x
            forces[i, 1] += force_y


@kernel
def wall_force(across, along, start, end, radius, width):
    """
    Force of a straight wall on a body.

    Beside the wall the contact law holds with the distance from the wall's middle line. Where the centre is past an
    end by less than the radius, the end is rounded: with sin θ = past / radius, the reach shrinks to
    radius · cos θ + width / 2, and the force is split into cos θ across and sin θ along the wall.

    :param across: signed distance of the centre from the wall's middle line
    :param along: coordinate of the centre in the wall's direction
    :param start: where the wall starts, in that direction
    :param end: where it ends
    :param radius: radius of the body
    :param width: width of the wall
    :return: force across the wall and force along it
    """
    gap = abs(across) - radius - width / 2
    if gap > CONTACT_RANGE or along < start - radius or along > end + radius:
        return 0.0, 0.0
    past = 0.0
    if along < start:
        past = along - start
    elif along > end:
        past = along - end
    sine = clipped(past / radius, 1.0)
    cosine = math.sqrt(1.0 - sine * sine)
    force = contact_force(radius * cosine + width / 2 - abs(across))
    side = 1.0 if across >= 0.0 else -1.0
    return side * cosine * force, sine * force


@kernel
def integrate(positions, velocities, forces, max_speeds, alive):
    """
    Move the living bodies by one step: v ← 0.75 v + F·dt, limit the speed, x ← x + v·dt with the new v.

    :param positions: (n, 2), moved
    :param velocities: (n, 2), updated
    :param forces: (n, 2)
    :param max_speeds: (n,), infinite where the speed has no limit
    :param alive: (n,)
    """
    for i in range(positions.shape[0]):
        if not alive[i]:
            continue
        velocity_x = (1 - DAMPING) * velocities[i, 0] + forces[i, 0] * DT
        velocity_y = (1 - DAMPING) * velocities[i, 1] + forces[i, 1] * DT
        speed = math.sqrt(velocity_x * velocity_x + velocity_y * velocity_y)
        if speed > max_speeds[i]:
            velocity_x *= max_speeds[i] / speed
            velocity_y *= max_speeds[i] / speed
        velocities[i, 0] = velocity_x
        velocities[i, 1] = velocity_y
        positions[i, 0] += velocity_x * DT
        positions[i, 1] += velocity_y * DT


@kernel
def clip_to_plane(positions, half_size):
    """
    Put centres that left the plane back on its edge; velocities stay.

    :param positions: (n, 2), clipped
    :param half_size: the plane is [−half_size, half_size]²
    """
    for i in range(positions.shape[0]):
        positions[i, 0] = clipped(positions[i, 0], half_size)
        positions[i, 1] = clipped(positions[i, 1], half_size)


@kernel
def stop_at_mid_line(previous, position, wall_x, door_low, door_high):
    """
    Stop a body whose centre would cross a vertical wall's middle line anywhere but in its door.

    The body stays where its path meets the line, on its own side; its velocity stays.

    :param previous: where the centre was, (2,)
    :param position: where it would go, (2,); changed if the wall is in the way
    :param wall_x: x of the wall's middle line
    :param door_low: y at which the door starts
    :param door_high: y at which it ends
    """
    before = previous[0] - wall_x
    after = position[0] - wall_x
    if (before >= 0.0) == (after >= 0.0):
        return
    crossing = before / (before - after)
    crossing_y = previous[1] + crossing * (position[1] - previous[1])
    if door_low < crossing_y < door_high:
        return
    position[0] = wall_x + (MID_LINE_GAP if before >= 0.0 else -MID_LINE_GAP)
    position[1] = crossing_y


@kernel
def squared_distance(a, b):
    """Square of the distance between two points, (2,) each."""
    dx = a[0] - b[0]
    dy = a[1] - b[1]
    return dx * dx + dy * dy


@kernel
def distance(a, b):
    """Distance between two points, (2,) each."""
    return math.sqrt(squared_distance(a, b))
