"""Rewards, metrics, deaths and bookkeeping of the batched worlds."""

import copy
import pickle

import numpy as np
import pytest

from sb3_kfcv.envs import GrasslandWorlds, HardSpreadWorlds, hard_spread

WORLDS = {
    "hard_spread": lambda n_worlds: HardSpreadWorlds(n_worlds, max_steps=20),
    "hard_spread_discrete": lambda n_worlds: HardSpreadWorlds(n_worlds, n_agents=3, walls="fixed", continuous_actions=False),
    "grassland": lambda n_worlds: GrasslandWorlds(n_worlds, n_wolves=6, n_sheep=3, n_obstacles=2),
}
every_world = pytest.mark.parametrize("make", WORLDS.values(), ids=WORLDS)


def random_actions(worlds, rng):
    shape = (worlds.n_worlds, worlds.n_agents)
    return rng.uniform(-1, 1, (*shape, 2)) if worlds.continuous_actions else rng.integers(5, size=shape)


def placed(worlds, positions, velocities=None, **others):
    """A single world with everything at a given place and at rest, before the first step."""
    worlds.reset()
    saved = worlds.get_world(0)
    saved["positions"] = np.array(positions, dtype=float)
    saved["velocities"] = np.zeros_like(saved["positions"]) if velocities is None else np.array(velocities, dtype=float)
    for name, value in others.items():
        saved[name] = np.array(value, dtype=float)
    worlds.set_world(0, saved)
    return worlds


def step_still(worlds):
    worlds.step(np.zeros((worlds.n_worlds, worlds.n_agents, 2)))
    return worlds


def metrics_of(worlds, world=0):
    return dict(zip(worlds.metric_names, worlds.episode_metrics()[world].tolist(), strict=True))


# Every world


@every_world
def test_a_batch_equals_single_worlds_bit_for_bit(make):
    n_worlds = 5
    batch, singles = make(n_worlds), [make(1) for _ in range(n_worlds)]
    batch.seed(range(n_worlds))
    batch.reset()
    for i, single in enumerate(singles):
        single.seed([i])
        single.reset()
    rng = np.random.default_rng(0)
    for _ in range(150):
        actions = random_actions(batch, rng)
        batch.step(actions)
        for i, single in enumerate(singles):
            single.step(actions[i : i + 1])
            if single.episode_terminated[0] or single.episode_truncated[0]:
                single.reset()
        ended = np.flatnonzero(batch.episode_terminated | batch.episode_truncated)
        batch.reset(ended)
        for i, single in enumerate(singles):
            for name, value in batch.get_world(i).items():
                np.testing.assert_array_equal(value, single.get_world(0)[name], err_msg=name)


@every_world
def test_set_world_continues_exactly_where_get_world_was_called(make):
    worlds, other = make(3), make(2)
    worlds.seed([1, 2, 3])
    worlds.reset()
    other.reset()
    rng = np.random.default_rng(0)
    for _ in range(7):
        worlds.step(random_actions(worlds, rng))
    other.set_world(1, worlds.get_world(2))
    for step in range(30):
        actions = random_actions(worlds, rng)
        worlds.step(actions)
        other.step(actions[1:])
        if step == 15:
            worlds.reset([2])
            other.reset([1])
        for name, value in worlds.get_world(2).items():
            np.testing.assert_array_equal(value, other.get_world(1)[name], err_msg=name)


@every_world
def test_get_world_is_a_copy(make):
    worlds = make(1)
    worlds.seed([0])
    worlds.reset()
    saved = worlds.get_world(0)
    kept = copy.deepcopy(saved)
    worlds.step(random_actions(worlds, np.random.default_rng(0)))
    for name, value in kept.items():
        np.testing.assert_array_equal(saved[name], value)


@every_world
def test_worlds_can_be_pickled(make):
    worlds = make(2)
    worlds.reset()
    again = pickle.loads(pickle.dumps(worlds))
    actions = random_actions(worlds, np.random.default_rng(0))
    worlds.step(actions)
    again.step(actions)
    np.testing.assert_array_equal(worlds.observations, again.observations)


@every_world
def test_a_copy_goes_its_own_way(make):
    worlds = make(2)
    worlds.reset()
    actions = random_actions(worlds, np.random.default_rng(0))
    worlds.step(actions)
    other = copy.deepcopy(worlds)
    before = worlds.get_world(1)
    other.step(actions)
    assert other.steps.tolist() == [2, 2]
    for name, value in worlds.get_world(1).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@every_world
def test_a_step_tells_how_many_episodes_are_over(make):
    worlds = make(3)
    worlds.max_steps = 2
    worlds.seed(range(3))
    worlds.reset()
    rng = np.random.default_rng(0)
    assert worlds.step(random_actions(worlds, rng)) == 0
    worlds.reset([1])
    assert worlds.step(random_actions(worlds, rng)) == 2
    assert (worlds.episode_terminated | worlds.episode_truncated).tolist() == [True, False, True]


@every_world
def test_reset_leaves_the_other_worlds_alone(make):
    worlds = make(3)
    worlds.reset()
    worlds.step(random_actions(worlds, np.random.default_rng(0)))
    before = worlds.get_world(1)
    worlds.reset([0, 2])
    for name, value in worlds.get_world(1).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)


@every_world
def test_shapes_are_as_declared(make):
    worlds = make(4)
    worlds.reset()
    worlds.step(random_actions(worlds, np.random.default_rng(0)))
    assert worlds.observations.shape == (4, sum(worlds.obs_sizes))
    assert worlds.states().shape == (4, worlds.state_size)
    assert worlds.episode_metrics().shape == (4, len(worlds.metric_names))


@every_world
def test_metrics_of_an_episode_without_steps_are_finite(make):
    worlds = make(1)
    worlds.reset()
    assert np.isfinite(worlds.episode_metrics()).all()


@every_world
def test_returns_are_the_summed_rewards(make):
    worlds = make(2)
    worlds.reset()
    rng, total = np.random.default_rng(0), 0.0
    for _ in range(10):
        worlds.step(random_actions(worlds, rng))
        total = total + worlds.rewards
    np.testing.assert_allclose(worlds.returns, total, rtol=1e-5)


@every_world
def test_scenes_hold_every_agent(make):
    worlds = make(2)
    worlds.reset()
    scene = worlds.scene(1)
    drawn = {(disc.x, disc.y) for disc in scene.discs}
    assert {tuple(position) for position in worlds.positions[1]} <= drawn


def test_set_world_of_another_size_is_refused():
    small, large = HardSpreadWorlds(n_agents=2), HardSpreadWorlds(n_agents=3)
    with pytest.raises(ValueError, match=r"'positions' of this world has shape \(3, 2\); got \(2, 2\)"):
        large.set_world(0, small.get_world(0))


def test_set_world_of_another_kind_is_refused():
    with pytest.raises(ValueError, match="this world is made of"):
        HardSpreadWorlds().set_world(0, GrasslandWorlds().get_world(0))


def test_discrete_actions_push_in_their_direction():
    worlds = HardSpreadWorlds(n_agents=5, walls="none", continuous_actions=False)
    placed(worlds, [[-2, 0], [-1, 0], [0, 0], [1, 0], [2, 0]])
    worlds.step(np.array([[0, 1, 2, 3, 4]]))
    np.testing.assert_allclose(worlds.velocities[0], [[0, 0], [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]], atol=1e-12)


def test_forces_beyond_the_box_are_clipped():
    worlds = placed(HardSpreadWorlds(n_agents=1, walls="none"), [[0, 0]])
    worlds.step(np.array([[[3.0, -7.0]]]))
    np.testing.assert_allclose(worlds.velocities[0], [[0.5, -0.5]])


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_is_not_finite_is_named(bad):
    worlds = HardSpreadWorlds(3, n_agents=2)
    worlds.reset()
    actions = np.zeros((3, 2, 2))
    actions[2, 1, 0] = bad
    with pytest.raises(ValueError, match=r"agent_1 in world 2 is .*; it must be finite"):
        worlds.step(actions)
    assert worlds.steps.tolist() == [0, 0, 0]  # nothing has moved


def test_forces_may_be_of_any_type_and_in_any_order():
    worlds, other = HardSpreadWorlds(3, n_agents=2), HardSpreadWorlds(3, n_agents=2)
    forces = np.random.default_rng(0).integers(-1, 2, (3, 2, 2))
    for batch, given in ((worlds, forces.astype(np.float64)), (other, np.asfortranarray(forces, dtype=np.float32))):
        batch.seed(range(3))
        batch.reset()
        batch.step(given)
    np.testing.assert_array_equal(worlds.positions, other.positions)


@pytest.mark.parametrize("bad", [-1, 5, 1.5, np.nan])
def test_a_discrete_action_that_does_not_exist_is_named(bad):
    worlds = GrasslandWorlds(2, n_wolves=1, n_sheep=1, continuous_actions=False)
    worlds.reset()
    with pytest.raises(ValueError, match=r"sheep_0 in world 1 is .*; it must be an integer from 0 to 4"):
        worlds.step(np.array([[0, 0], [0, bad]]))


def test_actions_of_a_wrong_shape_are_refused():
    worlds = HardSpreadWorlds(2, n_agents=3)
    with pytest.raises(ValueError, match=r"shape \(2, 6\); this world takes forces of shape \(2, 3, 2\)"):
        worlds.step(np.zeros((2, 6)))


def test_a_wrong_number_of_seeds_is_refused():
    with pytest.raises(ValueError, match="got 1 seeds for 2 worlds"):
        HardSpreadWorlds(2).seed([0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HardSpreadWorlds(0), "n_worlds is 0"),
        (lambda: HardSpreadWorlds(n_agents=0), "n_agents is 0"),
        (lambda: HardSpreadWorlds(max_steps=0), "max_steps is 0"),
        (lambda: HardSpreadWorlds(phi=float("nan")), "phi is nan"),
        (lambda: HardSpreadWorlds(wall_width=0.1), "wall_width is 0.1; it must be at least 0.2"),
        (lambda: HardSpreadWorlds(wall_width=1.6), "wall_width is 1.6; two walls leave three rooms"),
        (lambda: HardSpreadWorlds(door=0.2), "door is 0.2; it must be wider than an agent"),
        (lambda: HardSpreadWorlds(walls="randm"), "unknown walls 'randm'; did you mean 'random'"),
        (lambda: HardSpreadWorlds(walls=[(0.0, 2.9)]), "the door at y = 2.9 reaches beyond the plane"),
        (lambda: HardSpreadWorlds(walls=[(0.0, 0.0), (0.5, 0.0)]), "the wall at x = 0.5 leaves no room to its left"),
        (lambda: HardSpreadWorlds(walls=[(2.9, 0.0)]), "the wall at x = 2.9 leaves no room to its right"),
        (lambda: HardSpreadWorlds(walls=[1.0, 2.0]), "it must be a list of"),
        (lambda: GrasslandWorlds(n_wolves=0), "n_wolves is 0"),
        (lambda: GrasslandWorlds(n_sheep=0), "n_sheep is 0"),
        (lambda: GrasslandWorlds(n_obstacles=21), "n_obstacles is 21; it must be from 0 to 20"),
    ],
)
def test_a_bad_setting_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# HardSpread


def test_hard_spread_reward_of_an_agent_far_from_everything_is_its_distance():
    worlds = placed(HardSpreadWorlds(n_agents=2, walls="none", phi=2.0), [[0, 0], [2, 2]], landmarks=[[0.3, 0.4], [0, 2]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.rewards[0], [-2.0 * 0.5, -2.0 * 2.0], rtol=1e-6)


def test_hard_spread_pays_every_agent_on_a_landmark():
    worlds = placed(HardSpreadWorlds(n_agents=2, walls="none"), [[-0.14, 0], [0.12, 0]], landmarks=[[0, 0], [2, 2]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.rewards[0], [4 - 0.14, 4 - 0.12], rtol=1e-6)


def test_hard_spread_exclusive_cover_pays_the_closest_agent():
    worlds = HardSpreadWorlds(n_agents=2, walls="none", exclusive_cover=True)
    placed(worlds, [[-0.14, 0], [0.12, 0]], landmarks=[[0, 0], [2, 2]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.rewards[0], [-0.14, 4 - 0.12], rtol=1e-6)


def test_hard_spread_charges_agents_that_run_into_each_other_once():
    # two agents run into a third one: it touches both and pays 1
    worlds = HardSpreadWorlds(n_agents=3, walls="none")
    placed(worlds, [[-0.26, 0], [0, 0], [0.26, 0]], [[2, 0], [0, 0], [-2, 0]], landmarks=[[0, 2], [0, 2], [0, 2]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.positions[0], [[-0.11, 0], [0, 0], [0.11, 0]], atol=1e-9)
    np.testing.assert_allclose(worlds.rewards[0], [-1 - np.hypot(0.11, 2), -3, -1 - np.hypot(0.11, 2)], rtol=1e-6)


@pytest.mark.parametrize(
    ("position", "touches"),
    [
        ((2.91, 0.0), True),
        ((2.89, 0.0), False),
        ((0.0, -2.91), True),
        ((0.29, 1.0), True),  # the face is at 0.2
        ((0.31, 1.0), False),
        ((0.0, 0.0), False),  # in the middle of the door
        ((0.28, 0.21), True),  # at the door's corner (0.2, 0.2): distance 0.081
        ((0.28, 0.13), False),  # distance 0.106
    ],
)
def test_hard_spread_touching_a_wall_is_to_be_closer_than_the_radius(position, touches):
    walls = np.array([[0.0, 0.0]])
    assert hard_spread.touches_wall(np.array(position), walls, wall_width=0.4, door=0.4) == touches


def test_hard_spread_metrics_by_hand():
    worlds = HardSpreadWorlds(n_agents=3, walls="none", phi=0.5)
    # agents 0 and 1 meet on landmark 0, agent 2 stands 0.3 from landmark 1; landmark 2 is far
    positions = [[-0.26, 0], [0.07, 0], [2, 0]]
    velocities = [[2, 0], [0, 0], [0, 0]]
    placed(worlds, positions, velocities, landmarks=[[0, 0], [2, 0.3], [2, -1.0]])
    step_still(worlds)  # agent 0 is at −0.11 now: 0.18 from agent 1
    expected = {
        "collisions": 2 / 3,
        "pair_collisions": 1,
        "wall_collisions": 0,
        "closest_distance": 0.11 + 0.07 + 0.3,
        "closest_distance_landmarks": 0.07 + 0.3 + 1.0,
        "closest_distance_mean": 0.48 / 3,
        "landmarks_covered": 1,
        "landmarks_covered_last": 1,
        "cover_rate": 1 / 3,
        "cover_rate_last": 1 / 3,
        "distance_term": -0.5 * 0.48 / 3,
        "collision_term": -2 / 3,
        "cover_term": 8 / 3,
    }
    assert metrics_of(worlds) == pytest.approx(expected, rel=1e-6)


def test_hard_spread_metrics_are_means_over_steps_and_sums_of_terms():
    worlds = HardSpreadWorlds(n_agents=1, walls="none")
    placed(worlds, [[0, 0]], landmarks=[[0.1, 0]])
    step_still(worlds)
    saved = worlds.get_world(0)
    saved["positions"][:] = [[2.1, 0]]
    worlds.set_world(0, saved)
    step_still(worlds)
    metrics = metrics_of(worlds)
    assert metrics["landmarks_covered"] == 0.5
    assert metrics["landmarks_covered_last"] == 0.0
    assert metrics["closest_distance"] == pytest.approx((0.1 + 2.0) / 2)
    assert metrics["distance_term"] == pytest.approx(-2.1)
    assert metrics["cover_term"] == 4.0


def test_hard_spread_counts_the_agents_at_walls():
    worlds = placed(HardSpreadWorlds(n_agents=3, walls="none"), [[2.85, 0], [0, -2.85], [0, 0]], [[2, 0], [0, -2], [0, 0]])
    metrics = metrics_of(step_still(worlds))
    assert metrics["wall_collisions"] == 2
    assert metrics["pair_collisions"] == 0
    assert metrics["collisions"] == pytest.approx(2 / 3)


def test_hard_spread_observation_by_hand():
    worlds = HardSpreadWorlds(n_agents=2, walls="none")
    placed(worlds, [[0, 0], [1, 2]], [[0.4, 0], [0, 0]], landmarks=[[0.5, 1], [-1, -1]])
    step_still(worlds)  # agent 0 slows down to 0.3 and moves by 0.03
    expected = [0.3, 0, 0.03, 0, 0.47, 1, -1.03, -1, 0.97, 2]
    expected += [0, 0, 1, 2, -0.5, -1, -2, -3, -0.97, -2]
    np.testing.assert_allclose(worlds.observations[0], expected, atol=1e-6)


def test_hard_spread_state_ends_with_the_walls():
    worlds = HardSpreadWorlds(n_agents=1, walls=[(-1.0, 0.5), (1.0, -0.5)])
    placed(worlds, [[0, 0.1]], landmarks=[[0.2, 0.3]])
    np.testing.assert_allclose(worlds.states()[0], [0, 0.1, 0, 0, 0.2, 0.3, -1, 0.5, 1, -0.5], rtol=1e-6)


def test_hard_spread_is_truncated_and_never_terminated():
    worlds = HardSpreadWorlds(2, max_steps=3)
    worlds.reset()
    ends = [step_still(worlds).episode_truncated.tolist() for _ in range(3)]
    assert ends == [[False, False], [False, False], [True, True]]
    assert not worlds.episode_terminated.any() and not worlds.terminated.any()


@pytest.mark.parametrize("walls", ["random", [(-2.0, 2.5), (0.0, -2.5), (2.0, 0.0)]], ids=["random", "listed"])
def test_hard_spread_spawns_in_free_space(walls):
    worlds = HardSpreadWorlds(500, walls=walls, door=0.5)
    worlds.reset()
    for bodies, radius in ((worlds.positions, 0.1), (worlds.landmarks, 0.05)):
        assert np.abs(bodies).max() <= 3 - radius
        offset = bodies[:, :, np.newaxis] - worlds.inner_walls[:, np.newaxis]  # (worlds, bodies, walls, 2)
        across = np.maximum(np.abs(offset[..., 0]) - 0.2, 0)
        along = np.maximum(0.25 - np.abs(offset[..., 1]), 0)
        assert np.hypot(across, along).min() >= radius


def test_hard_spread_random_walls_leave_three_rooms():
    worlds = HardSpreadWorlds(500)
    worlds.reset()
    faces = worlds.inner_walls[:, :, 0]
    rooms = np.stack([faces[:, 0] - 0.2 + 3, faces[:, 1] - faces[:, 0] - 0.4, 3 - faces[:, 1] - 0.2])
    assert rooms.min() >= 1.0 - 1e-12
    assert np.abs(worlds.inner_walls[:, :, 1]).max() <= 3 - 0.4


def test_hard_spread_random_walls_change_at_every_reset():
    worlds = HardSpreadWorlds()
    worlds.reset()
    first = worlds.inner_walls.copy()
    worlds.reset()
    assert not np.array_equal(worlds.inner_walls, first)


def test_hard_spread_fixed_walls_stay():
    worlds = HardSpreadWorlds(walls="fixed")
    worlds.reset()
    first = worlds.inner_walls.copy()
    worlds.reset()
    np.testing.assert_array_equal(worlds.inner_walls, first)


def test_hard_spread_walls_can_be_an_array():
    worlds = HardSpreadWorlds(walls=np.array([[-1.0, 0.5], [1.5, -0.5]]))
    worlds.reset()
    np.testing.assert_array_equal(worlds.inner_walls, [[[-1.0, 0.5], [1.5, -0.5]]])


def test_hard_spread_fixed_walls_come_from_the_seed():
    worlds = HardSpreadWorlds(3, walls="fixed")
    worlds.seed([5, 5, 6])
    worlds.reset()
    same, again, other = worlds.inner_walls
    np.testing.assert_array_equal(same, again)
    assert not np.array_equal(same, other)


@pytest.mark.parametrize("n_steps", [1000, pytest.param(7000, marks=pytest.mark.expensive)])
@pytest.mark.parametrize("behaviour", ["gather at a wall", "ram together", "random"])
def test_hard_spread_agents_never_pass_a_wall_nor_leave_the_plane(behaviour, n_steps):
    """50 worlds of 8 agents; the long form makes a million world steps in all."""
    n_worlds = 50
    worlds = HardSpreadWorlds(n_worlds, n_agents=8, wall_width=0.2, max_steps=10**6)
    worlds.seed(range(n_worlds))
    worlds.reset()
    walls = worlds.inner_walls
    rng = np.random.default_rng(0)
    for step in range(n_steps):
        if step % 25 == 0:
            chosen = walls[np.arange(n_worlds), rng.integers(2, size=n_worlds)]
            goal = (chosen + rng.normal(0, 0.4, (n_worlds, 2)))[:, np.newaxis]
            direction = rng.choice([-1.0, 1.0], (n_worlds, 1, 2))
        before = worlds.positions.copy()
        if behaviour == "gather at a wall":
            worlds.step(np.sign(goal - before))
        elif behaviour == "ram together":
            worlds.step(np.broadcast_to(direction, before.shape))
        else:
            worlds.step(rng.uniform(-1, 1, before.shape))
        assert np.abs(worlds.positions).max() <= 3.0
        old, new = (at[:, :, np.newaxis] - walls[:, np.newaxis] for at in (before, worlds.positions))
        crosses = (old[..., 0] >= 0) != (new[..., 0] >= 0)
        old, new = old[crosses], new[crosses]
        share = old[:, 0] / (old[:, 0] - new[:, 0])
        y = old[:, 1] + share * (new[:, 1] - old[:, 1])
        assert (np.abs(y) < 0.2 + 1e-9).all(), "an agent crossed a wall outside its door"


# Grassland


def grassland(n_wolves, n_sheep, **kwargs):
    return GrasslandWorlds(n_wolves=n_wolves, n_sheep=n_sheep, **{"n_grass": 0, **kwargs})


CAUGHT = {"positions": [[0, 0], [0.2, 0]], "velocities": [[0, 0], [-2, 0]]}
"""A wolf and a sheep that runs into it: 0.05 apart after a step."""


def test_grassland_distance_terms():
    worlds = placed(grassland(2, 2, phi=0.2), [[0, 0], [0.8, 0], [0.3, 0.4], [0.8, 0.5]])
    step_still(worlds)
    between = [[0.5, np.hypot(0.8, 0.5)], [np.hypot(0.5, 0.4), 0.5]]  # (wolves, sheep)
    expected = [-0.2 * 0.5, -0.2 * 0.5, *(0.2 * np.sum(between, axis=0))]
    np.testing.assert_allclose(worlds.rewards[0], expected, rtol=1e-6)


def test_grassland_capture_pays_the_wolf_and_charges_the_sheep():
    worlds = placed(grassland(1, 1), **CAUGHT)
    step_still(worlds)
    np.testing.assert_allclose(worlds.rewards[0], [5 - 0.1 * 0.05, -5 + 0.1 * 0.05], rtol=1e-6)


@pytest.mark.parametrize(("sheep_pays_each", "price"), [(False, 5.0), (True, 10.0)])
def test_grassland_two_wolves_on_one_sheep(sheep_pays_each, price):
    worlds = grassland(2, 1, sheep_pays_each=sheep_pays_each, phi=0.0)
    # the wolves close in on the sheep from both sides, to 0.1
    placed(worlds, [[-0.2, 0], [0.2, 0], [0, 0]], [[4 / 3, 0], [-4 / 3, 0], [0, 0]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.rewards[0], [5, 5, -price], rtol=1e-6)


def test_grassland_a_wolf_is_paid_for_each_sheep():
    worlds = grassland(1, 2, phi=0.0)
    placed(worlds, [[0, 0], [0.2, 0], [-0.2, 0]], [[0, 0], [-4 / 3, 0], [4 / 3, 0]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.rewards[0], [10, -5, -5], rtol=1e-6)


def test_grassland_boundary_penalty_of_wolves_and_sheep():
    worlds = placed(grassland(2, 1, phi=0.0), [[0.95, 0.0], [-0.5, -0.9], [-0.2, -1.0]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.rewards[0], [-10, 0, -20], rtol=1e-6, atol=1e-9)


def test_grassland_pays_every_sheep_on_a_grass_which_then_grows_elsewhere():
    worlds = grassland(1, 2, n_grass=2, phi=0.0)
    placed(worlds, [[0.8, 0.8], [-0.06, 0], [0.06, 0]], grass=[[0, 0], [0.5, -0.5]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.rewards[0], [0, 2, 2])
    assert not np.array_equal(worlds.grass[0, 0], [0, 0])
    np.testing.assert_array_equal(worlds.grass[0, 1], [0.5, -0.5])


def test_grassland_metrics_by_hand():
    worlds = grassland(1, 2, n_grass=1)
    # sheep 0 is eaten at 0.05, sheep 1 grazes in the boundary strip
    placed(worlds, [[0, 0], [0.2, 0], [0, 0.95]], [[0, 0], [-2, 0], [0, 0]], grass=[[0, 0.9]])
    step_still(worlds)
    expected = {
        "return_per_wolf": 5 - 0.005,
        "return_per_sheep": (-5 + 0.005 + 0.095 - 10 + 2) / 2,
        "wolf_distance_term": -0.005,
        "wolf_capture_term": 5,
        "wolf_boundary_term": 0,
        "sheep_distance_term": 0.1 / 2,
        "sheep_capture_term": -5 / 2,
        "sheep_boundary_term": -10 / 2,
        "sheep_grass_term": 2 / 2,
        "sheep_eaten": 0.5,
        "wolves_win": 0,
    }
    assert metrics_of(worlds) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_grassland_wolves_win_when_all_sheep_are_eaten():
    worlds = step_still(placed(grassland(1, 1), **CAUGHT))
    assert metrics_of(worlds)["wolves_win"] == 1.0


def test_grassland_terminates_with_the_last_sheep():
    worlds = step_still(placed(grassland(1, 1, max_steps=1), **CAUGHT))
    assert worlds.episode_terminated.tolist() == [True]
    assert worlds.episode_truncated.tolist() == [False]  # although the time is up, too
    assert worlds.terminated.tolist() == [[True, True]]


def eaten_and_left():
    """After a step in which sheep 0 of two was eaten."""
    worlds = grassland(1, 2, n_grass=1)
    placed(worlds, [[0, 0], [0.2, 0], [0.5, 0.5]], [[0, 0], [-2, 0], [0, 0]], grass=[[-0.8, -0.8]])
    return step_still(worlds)


def test_grassland_an_eaten_sheep_is_marked_in_the_step_of_its_death():
    worlds = eaten_and_left()
    assert worlds.alive_before.tolist() == [[True, True, True]]
    assert worlds.alive.tolist() == [[True, False, True]]
    assert worlds.terminated.tolist() == [[False, True, False]]
    assert worlds.died_at.tolist() == [[-1, 1, -1]]


def test_grassland_an_eaten_sheep_is_all_zeros():
    worlds = eaten_and_left()
    wolf, eaten, _ = worlds.observations.reshape(3, -1)
    assert not eaten.any()
    assert not wolf[7:12].any()  # what the wolf sees of it, after 5 + 2 of its own and the grass
    positions, velocities, alive, _ = np.split(worlds.states()[0], [6, 12, 15])
    assert not positions[2:4].any() and not velocities[2:4].any() and alive[1] == 0


def test_grassland_an_eaten_sheep_gets_no_more_rewards():
    worlds = step_still(eaten_and_left())
    assert worlds.rewards[0, 1] == 0
    assert worlds.alive_before.tolist() == [[True, False, True]]


def test_grassland_an_eaten_sheep_stays_where_it_died_and_pushes_nobody():
    worlds = eaten_and_left()
    wolf, dead = worlds.positions[0, 0].copy(), worlds.positions[0, 1].copy()
    step_still(worlds)
    np.testing.assert_array_equal(worlds.positions[0, 0], wolf)
    np.testing.assert_array_equal(worlds.positions[0, 1], dead)


def test_grassland_an_eaten_sheep_fades():
    worlds = eaten_and_left()
    opacities = []
    for _ in range(7):
        opacities.append([disc.opacity for disc in worlds.scene(0).discs if 0 < disc.opacity < 1])
        step_still(worlds)
    assert [len(found) for found in opacities] == [1] * 5 + [0] * 2
    assert opacities[:5] == sorted(opacities[:5], reverse=True)


def test_grassland_observation_by_hand():
    worlds = grassland(1, 1, n_grass=1, n_obstacles=1)
    placed(worlds, [[0, 0], [0.5, 0.4]], [[0, 0], [0.4, 0]], grass=[[-0.5, 0.2]], obstacles=[[0.7, -0.7]])
    step_still(worlds)  # the sheep slows down to 0.3 and moves to 0.53
    wolf = [0, 0, 0, 0, 1, -0.5, 0.2, 0.53, 0.4, 0.3, 0, 1, 0.7, -0.7]
    sheep = [0.3, 0, 0.53, 0.4, 1, -1.03, -0.2, -0.53, -0.4, 0, 0, 1, 0.17, -1.1]
    np.testing.assert_allclose(worlds.observations[0], wolf + sheep, atol=1e-6)


def test_grassland_obstacles_push_agents_out():
    worlds = placed(grassland(1, 1, n_obstacles=1), [[0.1, 0], [0.8, 0.8]], obstacles=[[0, 0]])
    step_still(worlds)
    np.testing.assert_allclose(worlds.positions[0, 0], [0.175, 0], atol=1e-6)


def test_grassland_spawns_inside_the_plane_and_beside_obstacles():
    worlds = GrasslandWorlds(200, n_obstacles=5)
    worlds.reset()
    assert np.abs(worlds.positions).max() <= 1.0
    assert np.abs(worlds.grass).max() <= 0.9
    gap = np.linalg.norm(worlds.positions[:, :, np.newaxis] - worlds.obstacles[:, np.newaxis], axis=-1)
    assert gap[:, :16].min() >= 0.175
    assert gap[:, 16:].min() >= 0.15
    assert np.linalg.norm(worlds.grass[:, :, np.newaxis] - worlds.obstacles[:, np.newaxis], axis=-1).min() >= 0.13


def test_grassland_positions_are_clipped_to_the_plane():
    worlds = GrasslandWorlds(20, max_steps=10**6)
    worlds.reset()
    for _ in range(50):
        worlds.step(np.ones((20, 28, 2)))
    assert worlds.positions.max() == 1.0
