"""The compiled worlds against the equations of motion in plain Python."""

import math

import numpy as np
import pytest

from sb3_kfcv.envs import GrasslandWorlds, HardSpreadWorlds, physics

N_STEPS = 200
TOLERANCE = 1e-6
HARD_SPREAD_RADIUS = 0.1
WALL_WIDTH = 0.4
DOOR = 0.4
FIXED_WALLS = [(-1.0, 0.5), (1.0, -0.5)]


def contact(overlap):
    """Force of a contact: 100 · log(1 + exp(overlap / 1e-3)) · 1e-3."""
    return 100.0 * float(np.logaddexp(0.0, overlap / 1e-3)) * 1e-3


def body_forces(positions, radii, alive):
    forces = [[0.0, 0.0] for _ in positions]
    for a, (xa, ya) in enumerate(positions):
        for b, (xb, yb) in enumerate(positions):
            if a != b and alive[a] and alive[b]:
                distance = math.hypot(xa - xb, ya - yb)
                force = contact(radii[a] + radii[b] - distance)
                forces[a][0] += force * (xa - xb) / distance
                forces[a][1] += force * (ya - yb) / distance
    return forces


def wall_forces(position, orientation, middle, start, end):
    """Force of one wall on a body: ``orientation`` is "V" or "H", ``middle`` the coordinate of its centre line."""
    x, y = position
    across, along = (x - middle, y) if orientation == "V" else (y - middle, x)
    if along < start - HARD_SPREAD_RADIUS or along > end + HARD_SPREAD_RADIUS:
        return 0.0, 0.0
    past_end = min(along - start, 0.0) + max(along - end, 0.0)
    theta = math.asin(past_end / HARD_SPREAD_RADIUS)
    reach = math.cos(theta) * HARD_SPREAD_RADIUS + WALL_WIDTH / 2
    force = contact(reach - abs(across))
    normal = math.cos(theta) * math.copysign(force, across)
    parallel = math.sin(theta) * force
    return (normal, parallel) if orientation == "V" else (parallel, normal)


def all_walls(inner):
    walls = [("V", -3.2, -9, 9), ("V", 3.2, -9, 9), ("H", -3.2, -9, 9), ("H", 3.2, -9, 9)]
    for x, door_y in inner:
        walls += [("V", x, -9, door_y - DOOR / 2), ("V", x, door_y + DOOR / 2, 9)]
    return walls


def moved(position, velocity, force, max_speed, half_size):
    """Position and velocity after one step."""
    velocity = [0.75 * v + 0.1 * f for v, f in zip(velocity, force, strict=True)]
    speed = math.hypot(*velocity)
    if speed > max_speed:
        velocity = [v * max_speed / speed for v in velocity]
    return [min(max(p + 0.1 * v, -half_size), half_size) for p, v in zip(position, velocity, strict=True)], velocity


def held_actions(n_agents, seed):
    """Random actions that are kept for ten steps each, so that agents gather speed and run into things."""
    return np.repeat(np.random.default_rng(seed).uniform(-1, 1, (N_STEPS // 10, n_agents, 2)), 10, axis=0)


@pytest.mark.parametrize("seed", range(3))
def test_hard_spread_moves_by_the_equations(seed):
    n = 6
    worlds = HardSpreadWorlds(n_agents=n, walls=FIXED_WALLS, max_steps=N_STEPS)
    worlds.seed([seed])
    worlds.reset()
    positions, velocities = worlds.positions[0].tolist(), worlds.velocities[0].tolist()
    contacts = 0
    for actions in held_actions(n, seed):
        forces = body_forces(positions, [HARD_SPREAD_RADIUS] * n, [True] * n)
        for i in range(n):
            pushes = [wall_forces(positions[i], *wall) for wall in all_walls(FIXED_WALLS)]
            contacts += any(math.hypot(*push) > 0.1 for push in pushes)
            for axis in range(2):
                forces[i][axis] += 5.0 * actions[i, axis] + sum(push[axis] for push in pushes)
        for i in range(n):
            positions[i], velocities[i] = moved(positions[i], velocities[i], forces[i], math.inf, 3.0)
        worlds.step(actions[np.newaxis])
        np.testing.assert_allclose(worlds.positions[0], positions, atol=TOLERANCE)
        np.testing.assert_allclose(worlds.velocities[0], velocities, atol=TOLERANCE)
    assert contacts > 0, "the walls were never touched: the episode tests nothing"


@pytest.mark.parametrize("seed", range(3))
def test_grassland_moves_by_the_equations(seed):
    n_wolves, n_sheep = 5, 8
    n = n_wolves + n_sheep
    worlds = GrasslandWorlds(n_wolves=n_wolves, n_sheep=n_sheep, max_steps=N_STEPS)
    worlds.seed([seed])
    worlds.reset()
    radii = [0.075] * n_wolves + [0.05] * n_sheep
    accelerations = [2.0] * n_wolves + [4.0] * n_sheep
    max_speeds = [2.0] * n_wolves + [3.0] * n_sheep
    positions, velocities, alive = worlds.positions[0].tolist(), worlds.velocities[0].tolist(), [True] * n
    for actions in held_actions(n, seed):
        forces = body_forces(positions, radii, alive)
        for i in range(n):
            if alive[i]:
                force = [forces[i][axis] + accelerations[i] * actions[i, axis] for axis in range(2)]
                positions[i], velocities[i] = moved(positions[i], velocities[i], force, max_speeds[i], 1.0)
        for sheep in range(n_wolves, n):
            touched = any(math.dist(positions[sheep], positions[wolf]) < 0.125 for wolf in range(n_wolves))
            if alive[sheep] and touched:
                alive[sheep], velocities[sheep] = False, [0.0, 0.0]
        worlds.step(actions[np.newaxis])
        np.testing.assert_allclose(worlds.positions[0], positions, atol=TOLERANCE)
        np.testing.assert_allclose(worlds.velocities[0], velocities, atol=TOLERANCE)
        np.testing.assert_array_equal(worlds.alive[0], alive)
    assert not all(alive[n_wolves:]), "no sheep was eaten: the episode tests nothing"


def test_contact_force_of_a_deep_overlap_is_its_depth_times_100():
    assert physics.contact_force(5.0) == pytest.approx(500.0)


def test_contact_force_of_touching_bodies_is_log_2_margins():
    assert physics.contact_force(0.0) == pytest.approx(100 * 1e-3 * math.log(2))


def test_contact_force_of_distant_bodies_vanishes():
    assert physics.contact_force(-1e6) == 0.0


def test_coincident_bodies_are_pushed_apart():
    forces = np.zeros((2, 2))
    physics.add_body_contacts(forces, np.zeros((2, 2)), np.full(2, 0.1), np.ones(2, dtype=bool))
    np.testing.assert_allclose(forces, [[20.0, 0.0], [-20.0, 0.0]])


def test_the_dead_push_nobody():
    forces = np.zeros((2, 2))
    physics.add_body_contacts(forces, np.array([[0.0, 0.0], [0.1, 0.0]]), np.full(2, 0.1), np.array([True, False]))
    assert not forces.any()


def test_a_wall_pushes_along_its_normal():
    force = physics.wall_force(across=-0.25, along=0.0, start=-1.0, end=1.0, radius=0.1, width=0.4)
    np.testing.assert_allclose(force, [-5.0, 0.0], atol=1e-9)  # overlap 0.1 + 0.2 − 0.25


def test_a_wall_end_splits_the_force_by_its_angle():
    force = physics.wall_force(across=0.1, along=1.06, start=-1.0, end=1.0, radius=0.1, width=0.4)
    # sin θ = 0.06 / 0.1, cos θ = 0.8, reach 0.08 + 0.2, overlap 0.18, force 18
    np.testing.assert_allclose(force, [0.8 * 18.0, 0.6 * 18.0], atol=1e-9)


def test_a_wall_end_does_not_reach_beyond_the_radius():
    assert physics.wall_force(across=0.0, along=1.1001, start=-1.0, end=1.0, radius=0.1, width=0.4) == (0.0, 0.0)


def test_a_centre_on_the_middle_line_is_pushed_out():
    force = physics.wall_force(across=0.0, along=0.0, start=-1.0, end=1.0, radius=0.1, width=0.4)
    np.testing.assert_allclose(force, [30.0, 0.0])


def test_a_path_through_the_wall_stops_at_its_middle_line():
    position = np.array([1.0, 2.0])
    physics.stop_at_mid_line(np.array([-1.0, 0.0]), position, wall_x=0.0, door_low=-0.5, door_high=0.5)
    np.testing.assert_allclose(position, [0.0, 1.0], atol=2 * physics.MID_LINE_GAP)
    assert position[0] < 0


def test_a_path_through_the_door_goes_on():
    position = np.array([1.0, 0.4])
    physics.stop_at_mid_line(np.array([-1.0, 0.0]), position, wall_x=0.0, door_low=-0.5, door_high=0.5)
    np.testing.assert_array_equal(position, [1.0, 0.4])


def test_the_speed_limit_keeps_the_direction():
    positions, velocities = np.zeros((1, 2)), np.zeros((1, 2))
    physics.integrate(positions, velocities, np.array([[30.0, 40.0]]), np.array([2.0]), np.ones(1, dtype=bool))
    np.testing.assert_allclose(velocities, [[1.2, 1.6]])
    np.testing.assert_allclose(positions, [[0.12, 0.16]])


def test_top_speed_of_sheep_is_twice_that_of_wolves():
    worlds = GrasslandWorlds(n_wolves=1, n_sheep=1, max_steps=1000)
    worlds.reset()
    push = np.array([[[1.0, 0.0], [1.0, 0.0]]])
    for _ in range(100):
        worlds.positions[:] = [[0.0, 0.5], [0.0, -0.5]]
        worlds.step(push)
    np.testing.assert_allclose(worlds.velocities[0, :, 0], [0.8, 1.6])


def test_random_numbers_are_uniform():
    rng = np.array([physics.rng_state(0)])
    draws = np.array([physics.uniform(rng, 0, -1.0, 3.0) for _ in range(20_000)])
    counts, _ = np.histogram(draws, bins=20, range=(-1.0, 3.0))
    assert counts.sum() == 20_000
    chi_squared = ((counts - 1000.0) ** 2 / 1000.0).sum()
    assert chi_squared < 43.8  # exceeded once in 1000 for 19 degrees of freedom


def test_random_numbers_follow_splitmix64():
    """Reference values of Vigna's splitmix64.c for the seed 1234567."""
    rng = np.array([1234567], dtype=np.uint64)
    expected = [6457827717110365317, 3203168211198807973, 9817491932198370423]
    draws = [physics.uniform(rng, 0, 0.0, 1.0) for _ in expected]
    assert draws == [(value >> 11) / 2**53 for value in expected]
