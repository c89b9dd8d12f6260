"""Scripted policies: each does what it says, on observations made by hand."""

import numpy as np
import pytest

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.envs.grassland import GrasslandWorlds
from sb3_kfcv.envs.hard_spread import HardSpreadWorlds
from sb3_kfcv.envs.scripted import SCRIPTED_POLICIES, nearest_choice, scripted_policy
from sb3_kfcv.teams.team_policy import TeamPolicy


def spread_layout(n: int = 2, discrete: bool = False) -> AgentLayout:
    agents = tuple(f"agent_{i}" for i in range(n))
    obs_size = 4 + 2 * n + 2 * (n - 1)
    return AgentLayout(agents, ("agent",) * n, (obs_size,) * n, (5 if discrete else 2,) * n, discrete)


def grassland_layout(wolves: int = 1, sheep: int = 1, grass: int = 1, discrete: bool = False) -> AgentLayout:
    n = wolves + sheep
    agents = tuple(f"wolf_{i}" for i in range(wolves)) + tuple(f"sheep_{i}" for i in range(sheep))
    groups = ("wolf",) * wolves + ("sheep",) * sheep
    return AgentLayout(agents, groups, (5 + 2 * grass + 5 * (n - 1),) * n, (5 if discrete else 2,) * n, discrete)


def spread_rows(positions, landmarks) -> np.ndarray:
    """Observations of agents at rest: (1, n, obs_size)."""
    positions, landmarks = np.asarray(positions, float), np.asarray(landmarks, float)
    rows = [
        np.concatenate([np.zeros(2), own, (landmarks - own).ravel(), np.delete(positions - own, i, axis=0).ravel()])
        for i, own in enumerate(positions)
    ]
    return np.array([rows], dtype=np.float32)


def grassland_rows(positions, grass, alive=None, velocities=None, obstacles=()) -> np.ndarray:
    """Observations of all agents: (1, n, obs_size)."""
    positions, grass = np.asarray(positions, float), np.asarray(grass, float).reshape(-1, 2)
    alive = np.ones(len(positions)) if alive is None else np.asarray(alive, float)
    velocities = np.zeros_like(positions) if velocities is None else np.asarray(velocities, float)
    rows = []
    for i, own in enumerate(positions):
        others = np.concatenate([positions - own, velocities, np.ones((len(positions), 1))], axis=1) * alive[:, None]
        parts = [velocities[i], own, [1.0], (grass - own).ravel(), np.delete(others, i, axis=0).ravel()]
        parts += [np.asarray(obstacle, float) - own for obstacle in obstacles]
        rows.append(np.concatenate(parts) * alive[i])
    return np.array([rows], dtype=np.float32)


def direction(force: np.ndarray) -> np.ndarray:
    return force / np.linalg.norm(force)


class TestHardSpread:
    def test_still_never_pushes(self):
        policy = scripted_policy("still", spread_layout(), "agent")
        assert not policy.act(spread_rows([[0, 0], [1, 1]], [[2, 2], [-1, 0]])).any()

    def test_greedy_nearest_lets_two_go_to_one_landmark(self):
        policy = scripted_policy("greedy-nearest", spread_layout(), "agent")
        forces = policy.act(spread_rows([[0, 0], [0.5, 0]], [[2, 0], [0, -2.5]]))
        np.testing.assert_allclose(forces[0], [[1, 0], [1, 0]])

    def test_greedy_assigned_shares_the_landmarks_out(self):
        policy = scripted_policy("greedy-assigned", spread_layout(), "agent")
        forces = policy.act(spread_rows([[0, 0], [0.5, 0]], [[2, 0], [0, -2.5]]))
        np.testing.assert_allclose(forces[0], [[0, -1], [1, 0]])

    def test_greedy_policies_stop_on_their_landmark(self):
        rows = spread_rows([[0, 0], [1, 1]], [[0, 0], [1, 1]])
        for name in ("greedy-nearest", "greedy-assigned"):
            np.testing.assert_allclose(scripted_policy(name, spread_layout(), "agent").act(rows), 0)

    def test_batches_equal_single_rows(self):
        rng = np.random.default_rng(0)
        rows = np.concatenate([spread_rows(rng.uniform(-3, 3, (4, 2)), rng.uniform(-3, 3, (4, 2))) for _ in range(6)])
        for name in ("greedy-nearest", "greedy-assigned"):
            policy = scripted_policy(name, spread_layout(4), "agent")
            np.testing.assert_array_equal(policy.act(rows), np.concatenate([policy.act(row[None]) for row in rows]))


class TestOracle:
    @staticmethod
    def forces(positions, landmarks, walls, velocities=None) -> np.ndarray:
        positions = np.asarray(positions, float)
        velocities = np.zeros_like(positions) if velocities is None else np.asarray(velocities, float)
        state = np.concatenate([np.ravel(part) for part in (positions, velocities, landmarks, walls)])
        policy = scripted_policy("oracle", spread_layout(len(positions)), "agent", state_source=lambda: state[None])
        return policy.act(spread_rows(positions, landmarks))[0]

    def test_goes_to_the_door_and_not_at_the_wall(self):
        force = self.forces([[-0.34, -2], [2, 2]], [[1, -2], [2, 2]], [[0, 1]])
        np.testing.assert_allclose(force[0], [0, 1], atol=1e-6)

    def test_goes_through_once_in_line_with_the_door(self):
        force = self.forces([[-0.5, 1], [2, 2]], [[1, -2], [2, 2]], [[0, 1]])
        np.testing.assert_allclose(force[0], [1, 0], atol=1e-6)

    def test_goes_straight_where_there_is_no_wall(self):
        force = self.forces([[-0.5, 1], [2, 2]], [[1, 1], [2, 2]], np.empty((0, 2)))
        np.testing.assert_allclose(force[0], [1, 0], atol=1e-6)

    def test_takes_the_landmark_that_is_nearer_on_foot(self):
        """The landmark behind the wall is nearer to the first agent as the crow flies, not through the door."""
        force = self.forces([[-0.5, -2], [2, 0]], [[0.5, -2], [-2, -2]], [[0, 2.5]])
        assert force[0, 0] < 0
        assert force[1, 1] < 0

    def test_the_one_nearer_to_its_goal_gives_way(self):
        """Two run into each other; the first has less left to go, so it turns back and the second one may go on."""
        goals, velocities = [[0.6, 0], [-2.9, 0]], [[1.5, 0], [-1.5, 0]]
        forces = self.forces([[0, 0], [0.5, 0]], goals, np.empty((0, 2)), velocities)
        assert forces[0, 0] == -1 or abs(forces[0, 1]) == 1

    def test_covers_nearly_all_landmarks_and_hardly_touches_anything(self):
        worlds = HardSpreadWorlds(50)
        worlds.seed(range(50))
        worlds.reset()
        oracle = scripted_policy("oracle", spread_layout(4), "agent", state_source=worlds.states)
        for _ in range(worlds.max_steps):
            worlds.step(oracle.act(worlds.observations.reshape(50, 4, -1)))
        metrics = dict(zip(worlds.metric_names, worlds.episode_metrics().mean(axis=0), strict=True))
        assert metrics["landmarks_covered_last"] > 3.9
        assert metrics["collisions"] < 0.005

    def test_needs_the_state(self):
        with pytest.raises(ValueError, match="state_source"):
            scripted_policy("oracle", spread_layout(), "agent")

    def test_notices_states_of_other_worlds(self):
        policy = scripted_policy("oracle", spread_layout(), "agent", state_source=lambda: np.zeros((3, 16)))
        with pytest.raises(ValueError, match="observations of 1 worlds and states of 3"):
            policy.act(spread_rows([[0, 0], [1, 1]], [[0, 0], [1, 1]]))


class TestGrassland:
    def test_chase_goes_for_the_nearest_live_sheep(self):
        layout = grassland_layout(wolves=2, sheep=3)
        positions = [[0, 0], [0.5, 0.5], [0.1, 0], [0, -0.5], [-0.8, 0]]
        rows = grassland_rows(positions, [[0.3, 0.3]], alive=[1, 1, 0, 1, 1])
        force = scripted_policy("chase", layout, "wolf").act(rows[:, :2])[0, 0]
        np.testing.assert_allclose(direction(force), [0, -1], atol=1e-6)

    def test_chase_aims_ahead_of_a_running_sheep(self):
        rows = grassland_rows([[0, 0], [0.2, 0]], [[0.5, 0.5]], velocities=[[0, 0], [0, 1.6]])
        force = scripted_policy("chase", grassland_layout(), "wolf").act(rows[:, :1])[0, 0]
        assert force[1] > 0

    def test_chase_rests_when_all_sheep_are_eaten(self):
        rows = grassland_rows([[0, 0], [0.2, 0]], [[0.5, 0.5]], alive=[1, 0])
        assert not scripted_policy("chase", grassland_layout(), "wolf").act(rows[:, :1]).any()

    def test_chase_stays_off_the_border(self):
        rows = grassland_rows([[0.88, 0], [0.99, 0]], [[0.5, 0.5]])
        force = scripted_policy("chase", grassland_layout(), "wolf").act(rows[:, :1])[0, 0]
        assert force[0] <= 1e-6

    def test_flee_runs_from_the_wolf(self):
        rows = grassland_rows([[0.2, 0], [0, 0]], [[0.5, 0]])
        force = scripted_policy("flee", grassland_layout(), "sheep").act(rows[:, 1:])[0, 0]
        assert force[0] == -1

    def test_flee_does_not_run_over_the_border(self):
        rows = grassland_rows([[0.6, 0], [0.88, 0]], [[0.5, 0]])
        force = scripted_policy("flee", grassland_layout(), "sheep").act(rows[:, 1:])[0, 0]
        assert force[0] <= 1e-6
        assert abs(force[1]) == 1

    def test_flee_returns_from_the_border(self):
        rows = grassland_rows([[-0.9, -0.9], [0.99, 0.5]], [[0.5, 0]])
        force = scripted_policy("flee", grassland_layout(), "sheep").act(rows[:, 1:])[0, 0]
        assert force[0] == -1

    def test_graze_goes_to_the_nearest_grass(self):
        rows = grassland_rows([[0.9, 0], [0, 0]], [[0.5, 0], [0, 0.3]])
        force = scripted_policy("graze", grassland_layout(grass=2), "sheep").act(rows[:, 1:])[0, 0]
        np.testing.assert_allclose(force, [0, 1], atol=1e-6)

    def test_graze_is_blind_to_wolves(self):
        rows = grassland_rows([[0, 0.15], [0, 0]], [[0, 0.3]])
        force = scripted_policy("graze", grassland_layout(), "sheep").act(rows[:, 1:])[0, 0]
        assert force[1] == 1

    def test_the_dead_do_not_act(self):
        rows = grassland_rows([[0, 0], [0.2, 0], [0.5, 0.5]], [[0.5, 0]], alive=[1, 0, 1])
        layout = grassland_layout(sheep=2)
        for name in ("flee", "graze"):
            forces = scripted_policy(name, layout, "sheep").act(rows[:, 1:])[0]
            assert not forces[0].any()
            assert forces[1].any()

    def test_obstacles_at_the_end_are_no_grass(self):
        plain = grassland_rows([[0.9, 0], [0, 0]], [[0.5, 0]])
        layout = grassland_layout()
        cluttered = grassland_rows([[0.9, 0], [0, 0]], [[0.5, 0]], obstacles=[[0, 0.1]])
        with_obstacle = AgentLayout(layout.agents, layout.groups, (cluttered.shape[-1],) * 2, (2, 2))
        for name, group, rows in [("chase", "wolf", slice(0, 1)), ("graze", "sheep", slice(1, 2))]:
            np.testing.assert_array_equal(
                scripted_policy(name, layout, group).act(plain[:, rows]),
                scripted_policy(name, with_obstacle, group, n_obstacles=1).act(cluttered[:, rows]),
            )


class TestInTheRealGrassland:
    @staticmethod
    def eaten_and_grazed(wolf: str, sheep: str) -> tuple[float, float]:
        worlds = GrasslandWorlds(50)
        worlds.seed(range(50))
        worlds.reset()
        team = TeamPolicy(grassland_layout(16, 12, 4), {"wolf": wolf, "sheep": sheep}, np.random.default_rng(0))
        for _ in range(worlds.max_steps):
            worlds.step(team.predict(worlds.observations)[0].reshape(50, 28, 2))
        metrics = dict(zip(worlds.metric_names, worlds.episode_metrics().mean(axis=0), strict=True))
        return metrics["sheep_eaten"], metrics["sheep_grass_term"]

    def test_chase_catches_more_than_random(self):
        assert self.eaten_and_grazed("chase", "random")[0] > 0.9 > self.eaten_and_grazed("random", "random")[0]

    def test_flee_survives_and_graze_eats(self):
        random_eaten, random_grass = self.eaten_and_grazed("random", "random")
        assert self.eaten_and_grazed("random", "flee")[0] < 0.2 * random_eaten
        assert self.eaten_and_grazed("random", "graze")[1] > 5 * random_grass


class TestDiscrete:
    def test_each_direction_is_nearest_to_itself(self):
        forces = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], float)
        np.testing.assert_array_equal(nearest_choice(forces), [0, 1, 2, 3, 4])

    def test_between_directions_the_nearer_one_counts(self):
        forces = np.array([[0.4, 0.1], [0.6, 0.1], [-1, 0.9], [0.9, -1]])
        np.testing.assert_array_equal(nearest_choice(forces), [0, 1, 2, 4])

    def test_random_choices_are_even(self):
        policy = scripted_policy("random", spread_layout(discrete=True), "agent", np.random.default_rng(0))
        counts = np.bincount(policy.choose(np.zeros((5000, 2, 10))).ravel(), minlength=5)
        np.testing.assert_allclose(counts / counts.sum(), 0.2, atol=0.02)


class TestByName:
    def test_random_draws_from_the_generator_it_is_given(self):
        observations = np.zeros((3, 2, 10), np.float32)
        first, again = (
            scripted_policy("random", spread_layout(), "agent", np.random.default_rng(7)).act(observations) for _ in range(2)
        )
        np.testing.assert_array_equal(first, again)
        assert np.abs(first).max() <= 1
        assert len(np.unique(first)) == first.size

    def test_unknown_name_gets_the_nearest_right_one(self):
        with pytest.raises(ValueError, match="unknown scripted policy 'graise' for 'sheep'; did you mean 'graze'"):
            scripted_policy("graise", grassland_layout(), "sheep")

    def test_name_like_no_other_gets_the_list(self):
        with pytest.raises(ValueError, match="there are random, chase"):
            scripted_policy("xyz", grassland_layout(), "wolf")

    def test_unknown_group_is_named(self):
        with pytest.raises(ValueError, match="no scripted policy plays 'wolves'; did you mean 'wolf'"):
            scripted_policy("chase", grassland_layout(), "wolves")

    @pytest.mark.parametrize("group", SCRIPTED_POLICIES)
    def test_all_give_float32_forces_for_the_group(self, group):
        layout = spread_layout(3) if group == "agent" else grassland_layout(wolves=2, sheep=3)
        state = np.zeros((4, 18 + 4)) + np.linspace(-2, 2, 22)
        members = len(layout.members(group))
        observations = np.random.default_rng(0).uniform(-1, 1, (4, members, layout.obs_sizes[0])).astype(np.float32)
        for name in SCRIPTED_POLICIES[group]:
            forces = scripted_policy(name, layout, group, state_source=lambda: state).act(observations)
            assert forces.shape == (4, members, 2)
            assert forces.dtype == np.float32
            assert np.abs(forces).max() <= 1


class ConstantModel:
    """Stands in for a trained model: every column of the joint action has the value that it is told."""

    def __init__(self, value: float, columns: int):
        self.action = np.full(columns, value, np.float32)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.tile(self.action, (len(observation), 1)), None


class TestTeamPolicy:
    layout = grassland_layout(wolves=2, sheep=1)
    rows = grassland_rows([[0, 0], [0.3, 0.3], [0.2, 0]], [[0.5, 0]]).reshape(1, -1)

    def test_each_group_is_played_by_its_own_policy(self):
        team = TeamPolicy(self.layout, {"wolf": "chase", "sheep": "flee"})
        action, state = team.predict(self.rows)
        own = self.rows.reshape(1, 3, -1)
        np.testing.assert_array_equal(action[0, :4], scripted_policy("chase", self.layout, "wolf").act(own[:, :2]).ravel())
        np.testing.assert_array_equal(action[0, 4:], scripted_policy("flee", self.layout, "sheep").act(own[:, 2:]).ravel())
        assert state is None

    def test_a_model_plays_its_group_only(self):
        team = TeamPolicy(self.layout, {"wolf": ConstantModel(0.5, 6), "sheep": ConstantModel(-0.25, 6)})
        np.testing.assert_array_equal(team.predict(self.rows)[0], [[0.5] * 4 + [-0.25] * 2])

    def test_one_row_gives_one_action(self):
        action, _ = TeamPolicy(self.layout, {"wolf": "chase", "sheep": "graze"}).predict(self.rows[0])
        assert action.shape == (6,)

    def test_discrete_layouts_get_one_integer_per_agent(self):
        layout = grassland_layout(wolves=2, sheep=1, discrete=True)
        team = TeamPolicy(layout, {"wolf": ConstantModel(3, 3), "sheep": "flee"})
        action, _ = team.predict(self.rows)
        assert action.dtype == np.int64
        np.testing.assert_array_equal(action[0, :2], [3, 3])
        assert action.shape == (1, 3)

    def test_every_group_needs_a_player(self):
        with pytest.raises(ValueError, match=r"players were given for \['wolf'\].*\['sheep', 'wolf'\]"):
            TeamPolicy(self.layout, {"wolf": "chase"})

    def test_filling_in_one_group_keeps_the_actions_of_the_other(self):
        team = TeamPolicy(self.layout, {"sheep": ConstantModel(-0.25, 6)}, groups=["sheep"])
        actions = np.full((1, 6), 0.75, np.float32)
        np.testing.assert_array_equal(team.fill(actions, self.rows), [[0.75] * 4 + [-0.25] * 2])
        assert (actions == 0.75).all()
