"""Matches: the same to the bit however they are played, tables, ratings, curves."""

import numpy as np
import pytest
from mpe2 import simple_tag_v3, simple_world_comm_v3
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn
from toy_envs import ToyParallelEnv

from sb3_kfcv import MADDPG, CoTraining, FileFormatError, make_vec_env
from sb3_kfcv.common.evaluation import evaluate, share_with_interval
from sb3_kfcv.envs.scripted import RandomPolicy, scripted_policy
from sb3_kfcv.matches import Arena, curve, elo, equilibrium, pay_off_table
from sb3_kfcv.matches.arena import BLOCK, EpisodeGenerators
from sb3_kfcv.teams.players import Mixture
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import layout_of

SHORT = {"max_steps": 5}  # else at the paper's size
SMALL = {"n_wolves": 3, "n_sheep": 2, "n_grass": 2, "max_steps": 8}
TINY = {"learning_starts": 8, "batch_size": 8, "buffer_size": 200, "critic_input": "own_observation", "seed": 3}


def short_arena(n_envs):
    return Arena(make_vec_env("Grassland-v0", n_envs, env_kwargs=SHORT))


def small_arena(n_envs=5):
    return Arena(make_vec_env("Grassland-v0", n_envs, env_kwargs=SMALL))


@pytest.fixture(scope="module")
def both_sides(tmp_path_factory):
    """
    A model of all agents at the paper's size, trained for a moment; and its file. PyTorch's products act, not compiled loops,
    with which a row has the same actions whatever stands beside it.
    """
    env = make_vec_env("Grassland-v0", 4, seed=1, env_kwargs=SHORT)
    model = MADDPG("MlpPolicy", env, policy_kwargs={"activation_fn": nn.Tanh}, **TINY)
    model.learn(40)
    path = tmp_path_factory.mktemp("players") / "both.zip"
    model.save(path)
    return model, path


@pytest.fixture(scope="module")
def wolves():
    """Small wolves, trained for a moment."""
    env = make_vec_env("Grassland-v0", 4, seed=2, env_kwargs=SMALL)
    return MADDPG("MlpPolicy", env, team="wolf", opponents={"sheep": "graze"}, **TINY).learn(40)


@pytest.fixture(scope="module")
def line_ups(both_sides):
    """Wolves and sheep of every kind."""
    model, path = both_sides
    return {
        "networks against networks": {"wolf": path, "sheep": model},
        "networks against random": {"wolf": model, "sheep": "random"},
        "mixtures": {"wolf": ["random", model, "chase"], "sheep": {"random": 2, path: 1}},
    }


@pytest.fixture(scope="module")
def one_by_one(line_ups):
    """What they come to in a single world."""
    return {name: short_arena(1).play(players, 40, seed=5).quantities() for name, players in line_ups.items()}


def assert_same(played, expected):
    assert played.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(played[name], values, err_msg=name, strict=True)


@pytest.mark.parametrize("n_envs", [7, 32, 64])
@pytest.mark.parametrize("name", ["networks against networks", "networks against random", "mixtures"])
def test_results_do_not_depend_on_the_number_of_worlds(line_ups, one_by_one, name, n_envs):
    assert_same(short_arena(n_envs).play(line_ups[name], 40, seed=5).quantities(), one_by_one[name])


def test_the_test_above_could_fail(both_sides):
    """Networks of this size do give other bits for other numbers of rows."""
    model, _ = both_sides
    rows = np.random.default_rng(0).normal(size=(32, model.observation_space.shape[0])).astype(np.float32)
    together = model.predict(rows, deterministic=True)[0]
    alone = np.concatenate([model.predict(row[None], deterministic=True)[0] for row in rows])
    if np.array_equal(together, alone):
        pytest.skip("this machine's matrix products give the same bits for every number of rows")
    np.testing.assert_allclose(together, alone, atol=1e-5)


def test_an_episode_is_the_same_in_every_match_that_it_is_part_of(line_ups):
    arena, players = short_arena(8), line_ups["mixtures"]
    long, part = arena.play(players, 40, seed=0), arena.play(players, 7, seed=30)
    assert_same(part.quantities(), {name: values[30:37] for name, values in long.quantities().items()})
    assert part.seeds.tolist() == list(range(30, 37))


def test_tables_do_not_depend_on_the_order_of_players(both_sides):
    model, path = both_sides
    rows = {"model": model, "random": "random", "mixed": ["chase", "random"]}
    columns = {"random": "random", "file": path, "graze": "graze"}
    table = pay_off_table(short_arena(8), rows, columns, ("wolf", "sheep"), 12, seed=3)
    shuffled = pay_off_table(
        short_arena(5), dict(reversed(rows.items())), dict(reversed(columns.items())), ("wolf", "sheep"), 12, seed=3
    )
    assert (shuffled.rows, shuffled.columns) == (table.rows[::-1], table.columns[::-1])
    assert_same({name: values[::-1, ::-1] for name, values in shuffled.values.items()}, table.values)


def test_a_match_is_what_single_episodes_come_to():
    players = {"wolf": "chase", "sheep": "flee"}
    played = small_arena().play(players, 7, seed=11).quantities()
    for i in range(7):
        env = make_vec_env("Grassland-v0", 1, seed=11 + i, env_kwargs=SMALL)
        alone = evaluate(TeamPolicy(layout_of(env), players), env, 1)
        for name in ("return_wolf", "return_sheep", "sheep_eaten", "wolves_win", "length"):
            np.testing.assert_allclose(played[name][i], alone[name][0], rtol=1e-6, err_msg=name)


def test_who_wins_is_what_the_world_says():
    played = small_arena().play({"wolf": "chase", "sheep": "random"}, 40)
    assert 0 < played.won["wolf"].mean() < 1
    np.testing.assert_array_equal(played.won["wolf"], played.metrics["sheep_eaten"] == 1)
    np.testing.assert_array_equal(played.won["sheep"], 1 - played.won["wolf"])


def test_every_row_is_drawn_by_its_own_generator():
    drawn = EpisodeGenerators()
    drawn.seat([np.random.default_rng([7, 0]), np.random.default_rng([8, 0]), np.random.default_rng([7, 0])])
    forces = drawn.uniform(-1, 1, (3, 2, 2))
    np.testing.assert_array_equal(forces[0], forces[2])
    assert not (forces[0] == forces[1]).any()
    with pytest.raises(ValueError, match="4 rows are to be drawn for the episodes of 3"):
        drawn.integers(5, size=4)


def test_a_mixture_plays_as_often_as_its_weights_say():
    arena = small_arena(50)
    side = arena.side("sheep", {"graze": 3, "flee": 1})
    playing = side.line_up([np.random.default_rng([seed, 1]) for seed in range(3000)])
    assert abs(playing.mean() - 0.25) < 0.03


def test_who_plays_the_other_episodes_of_a_mixture_does_not_matter():
    arena = small_arena(BLOCK)
    side = arena.side("sheep", ["random", "random"])
    drawn = {}
    for others in (0, 1):
        playing = np.full(BLOCK, others)
        playing[3] = 0
        actions = np.zeros((BLOCK, 10), dtype=np.float32)
        rows = np.zeros((BLOCK, sum(arena.layout.obs_sizes)), dtype=np.float32)
        generators = [np.random.default_rng(i) for i in range(BLOCK)]
        for _ in range(2):
            side.fill(actions, rows, playing, generators)
        drawn[others] = actions[3].copy()
    np.testing.assert_array_equal(drawn[0], drawn[1])


def test_a_players_own_generator_is_left_alone():
    layout = layout_of(make_vec_env("Grassland-v0", env_kwargs=SMALL))
    player = scripted_policy("random", layout, "wolf", np.random.default_rng(0))
    arena = small_arena()
    by_name = arena.play({"wolf": "random", "sheep": "graze"}, 6).quantities()
    assert_same(arena.play({"wolf": player, "sheep": "graze"}, 6).quantities(), by_name)
    assert player.rng.random() == np.random.default_rng(0).random()


def test_a_side_plays_as_the_model_was_when_it_was_found(wolves):
    arena = small_arena()
    side = arena.side("wolf", wolves)
    before = arena.play({"wolf": side, "sheep": "graze"}, 3).quantities()
    saved = {name: tensor.clone() for name, tensor in wolves.policy.actor.state_dict().items()}
    for parameter in wolves.policy.actor.parameters():
        parameter.data.mul_(-2)
    after = arena.play({"wolf": side, "sheep": "graze"}, 3).quantities()
    wolves.policy.actor.load_state_dict(saved)
    assert_same(after, before)


@pytest.mark.parametrize("continuous", [True, False])
def test_any_world_with_groups(continuous):
    def world():
        return simple_tag_v3.parallel_env(max_cycles=6, continuous_actions=continuous)

    env = make_vec_env(world, 2, seed=0)
    model = MADDPG("MlpPolicy", env, team="adversary", opponents={"agent": "random"}, **TINY).learn(20)
    players = {"adversary": [model, "random"], "agent": "random"}
    played, alone = (Arena(make_vec_env(world, n)).play(players, 5, seed=1) for n in (3, 1))
    assert played.won == {}
    assert played.lengths.tolist() == [6] * 5
    assert_same(played.quantities(), alone.quantities())


def test_co_training_plays_by_its_learners():
    env = make_vec_env("Grassland-v0", 2, seed=0, env_kwargs=SMALL)
    model = CoTraining("MlpPolicy", env, {"wolf": "maddpg", "sheep": "maddpg"}, seed=1)
    learners = {group: learner.policy for group, learner in model.learners.items()}
    arena = small_arena()
    together = arena.play({"wolf": model, "sheep": model}, 3).quantities()
    assert_same(together, arena.play(learners, 3).quantities())


def test_more_than_two_groups():
    arena = Arena(make_vec_env(lambda: simple_world_comm_v3.parallel_env(max_cycles=4), 2))
    players = {"random": "random"}
    groups, others = ("adversary", "agent"), {"leadadversary": "random"}
    table = pay_off_table(arena, players, players, groups, 3, others=others)
    everyone = {group: "random" for group in arena.layout.group_names}
    assert_same({name: values[0, 0] for name, values in table.values.items()}, arena.play(everyone, 3).quantities())


def test_a_table_knows_its_intervals():
    calls = []
    sheep = {"graze": "graze", "flee": "flee"}
    table = pay_off_table(small_arena(), {"chase": "chase"}, sheep, ("wolf", "sheep"), 20, progress=lambda: calls.append(1))
    assert len(calls) == 2
    wins = table.values["won_wolf"][0, 1]
    assert table.interval("won_wolf", 0, 1) == share_with_interval(wins)
    assert table.interval("wolves_win", 0, 1) == share_with_interval(wins)
    returns = table.values["return_sheep"][0, 1]
    half = 2.093024 * returns.std(ddof=1) / np.sqrt(20)  # Student's t at 19 degrees of freedom
    np.testing.assert_allclose(table.interval("return_sheep", 0, 1)[1:], [returns.mean() - half, returns.mean() + half])
    np.testing.assert_array_equal(table.pay_offs("return_sheep"), -table.means("return_sheep"))
    np.testing.assert_array_equal(table.pay_offs("sheep_eaten"), table.means("sheep_eaten"))


def test_a_curve_is_one_match_per_snapshot_in_order_of_steps(wolves):
    arena = small_arena()
    played = curve(arena, "wolf", {200: wolves, 0: "random", 100: "chase"}, {"sheep": "graze"}, 6, seed=2)
    assert list(played) == [0, 100, 200]
    assert_same(played[100].quantities(), arena.play({"wolf": "chase", "sheep": "graze"}, 6, seed=2).quantities())
    assert_same(played[200].quantities(), arena.play({"wolf": wolves, "sheep": "graze"}, 6, seed=2).quantities())


@pytest.mark.parametrize(
    ("players", "settings", "message"),
    [
        ({"wolf": "chase"}, {}, "players were given for wolf; to be played are wolf, sheep"),
        ({"wolf": "chase", "ship": "graze"}, {}, "players were given for wolf, ship; to be played are wolf, sheep"),
        ({"wolf": "chaise", "sheep": "graze"}, {}, 'unknown scripted policy of \'wolf\' "chaise"; did you mean "chase"'),
        ({"wolf": "chase", "sheep": "nowhere/sheep.zip"}, {}, "there is no file nowhere/sheep.zip"),
        ({"wolf": "chase", "sheep": "graze"}, {"n_episodes": 0}, "n_episodes must be a whole number of at least 1, got 0"),
        ({"wolf": "chase", "sheep": "graze"}, {"seed": -1}, "seed must be a whole number of at least 0, got -1"),
    ],
)
def test_what_cannot_be_played_is_refused(players, settings, message):
    with pytest.raises(ValueError, match=message):
        small_arena().play(players, **{"n_episodes": 1, **settings})


def test_players_of_another_world_or_group_are_refused(both_sides, wolves):
    with pytest.raises(ValueError, match="is for another world: 16 wolf"):
        small_arena().side("wolf", both_sides[1])
    with pytest.raises(ValueError, match="plays wolf; wanted is a player of sheep"):
        small_arena().side("sheep", wolves)
    with pytest.raises(ValueError, match="a player of wolf of another match cannot play sheep here"):
        small_arena().side("sheep", small_arena().side("wolf", "chase"))
    with pytest.raises(ValueError, match="there is nobody to play sheep"):
        pay_off_table(small_arena(), {"chase": "chase"}, {}, ("wolf", "sheep"), 1)


def test_damaged_files_are_refused(tmp_path, both_sides):
    content = bytearray(both_sides[1].read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "damaged.zip").write_bytes(content)
    with pytest.raises(FileFormatError, match="damaged"):
        short_arena(1).side("wolf", tmp_path / "damaged.zip")


@pytest.mark.parametrize("wrapped", [lambda path: path, lambda path: [path, "chase"], lambda path: Mixture([str(path)])])
def test_models_that_saw_normalised_observations_are_refused(tmp_path, wrapped):
    env = VecNormalize(make_vec_env("Grassland-v0", 2, env_kwargs=SMALL), norm_reward=False)
    MADDPG("MlpPolicy", env, **TINY).save(tmp_path / "normalised.zip")
    with pytest.raises(ValueError, match=r"normalised\.zip was trained on normalised observations"):
        small_arena().side("wolf", wrapped(tmp_path / "normalised.zip"))


def test_wilson():
    z = 1.959963984540054
    assert share_with_interval(np.zeros(10)) == pytest.approx((0, 0, z**2 / (10 + z**2)))
    assert share_with_interval(np.ones(10)) == pytest.approx((1, 10 / (10 + z**2), 1))
    assert share_with_interval(np.array([1] * 8 + [0] * 2)) == pytest.approx((0.8, 0.49016, 0.94331), abs=1e-5)


def test_elo_by_hand():
    """
    Row at ln 3, column at −ln 3 (in log-odds): the row should win 0.9 of the games, and 0.75 of its draw against 0. The
    likelihood has its maximum there if 10 · 0.9 + 0.75 = wins + 0.5.
    """
    ratings = elo(np.array([[9.25]]), 10)
    assert ratings.rows[0].mean == pytest.approx(400 * np.log10(3), abs=1e-5)
    assert ratings.columns[0].mean == pytest.approx(-400 * np.log10(3), abs=1e-5)
    # Curvature at (a, −a): 10 · 0.09 between them, 3/16 with 0 each; the distance from the mean is half of their gap.
    error = np.sqrt(1 / (2 * (2 * 10 * 0.09 + 3 / 16))) * 400 / np.log(10)
    assert ratings.rows[0].high - ratings.rows[0].mean == pytest.approx(1.959964 * error, rel=1e-5)


def test_elo_recovers_the_strengths_that_made_the_wins():
    rows, columns = np.array([300.0, 0.0, -100.0]), np.array([50.0, -250.0])
    wins = 1e6 / (1 + 10 ** ((columns - rows[:, None]) / 400))
    ratings = elo(wins, 10**6)
    np.testing.assert_allclose([rating.mean for rating in (*ratings.rows, *ratings.columns)], [*rows, *columns], atol=0.01)


def test_elo_does_not_depend_on_order_and_stays_finite():
    wins = np.array([[200.0, 120.0, 3.0], [0.0, 0.0, 0.0]])
    ratings, turned = elo(wins, 200), elo(wins[::-1, ::-1], 200)
    np.testing.assert_allclose(np.array(turned.rows[::-1]), np.array(ratings.rows), atol=1e-4)
    np.testing.assert_allclose(np.array(turned.columns[::-1]), np.array(ratings.columns), atol=1e-4)
    assert np.isfinite(np.array(ratings.rows + ratings.columns)).all()
    assert sum(rating.mean for rating in (*ratings.rows, *ratings.columns)) == pytest.approx(0, abs=1e-6)


ROCK_PAPER_SCISSORS = [[0, -1, 1], [1, 0, -1], [-1, 1, 0]]
TWO_PAPERS = [[0, -1, -1, 1], [1, 0, 0, -1], [1, 0, 0, -1], [-1, 1, 1, 0]]


@pytest.mark.parametrize(
    ("game", "value", "rows", "columns"),
    [
        (ROCK_PAPER_SCISSORS, 0, [1 / 3] * 3, [1 / 3] * 3),
        (TWO_PAPERS, 0, [1 / 3, 1 / 6, 1 / 6, 1 / 3], [1 / 3, 1 / 6, 1 / 6, 1 / 3]),
        # Two by two: (d − c) / (a − b − c + d), (d − b) / (a − b − c + d), (ad − bc) / (a − b − c + d).
        ([[3, 1], [0, 2]], 1.5, [0.5, 0.5], [0.25, 0.75]),
        # The last row gets less than the first against every column.
        ([[3, 1], [0, 2], [2, 0.5]], 1.5, [0.5, 0.5, 0], [0.25, 0.75]),
        # A saddle point.
        ([[4, 5], [1, 9]], 4, [1, 0], [1, 0]),
        # Every (t, t, 1 − 2t) is as good.
        ([[1, 0], [0, 1], [0.5, 0.5]], 0.5, [1 / 3] * 3, [0.5, 0.5]),
        ([[7, 7, 7]], 7, [1], [1 / 3] * 3),
    ],
)
def test_equilibria_by_hand(game, value, rows, columns):
    found = equilibrium(np.array(game, dtype=float))
    assert found.value == pytest.approx(value, abs=1e-6)
    np.testing.assert_allclose(found.rows, rows, atol=1e-5)
    np.testing.assert_allclose(found.columns, columns, atol=1e-5)
    np.testing.assert_allclose(found.row_pay_offs, np.array(game) @ found.columns)
    np.testing.assert_allclose(found.column_pay_offs, found.rows @ np.array(game))


def test_equilibria_cannot_be_exploited_and_follow_the_scale():
    rng = np.random.default_rng(0)
    for shape in [(12, 9), (20, 20), (1, 6)]:
        game = np.round(rng.random(shape) * 200) / 200  # win rates of 200 episodes
        found, scaled = equilibrium(game), equilibrium(1000 * game - 300)
        assert found.row_pay_offs.max() <= found.value + 1e-6
        assert found.column_pay_offs.min() >= found.value - 1e-6
        assert found.rows.sum() == pytest.approx(1)
        np.testing.assert_allclose(scaled.rows, found.rows, atol=1e-4)
        assert scaled.value == pytest.approx(1000 * found.value - 300, abs=1e-3)


def test_worlds_that_do_not_say_who_wins_are_measured_by_return():
    arena = Arena(make_vec_env(lambda: ToyParallelEnv(time_limit=3), 2))
    assert arena.default_quantity("tank") == "return_tank"
    assert set(arena.quantities()) == {"return_scout", "return_tank", "length"}
    played = arena.play({"scout": "random", "tank": "random"}, 3)
    np.testing.assert_allclose(played.returns["scout"], 1.5 * (1 + 2 + 3))
    np.testing.assert_allclose(played.returns["tank"], 3 * (1 + 2 + 3))


class PlaceMatters:
    """A model that is none of ours, and acts by where a row sits among the others, and by how many they are."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        places = np.linspace(-1, 1, len(observation), dtype=np.float32)
        return np.repeat(places[:, None], 10, axis=1), None


@pytest.mark.parametrize("n_envs", [7, 32, 50])
def test_an_episode_sits_in_the_same_place_however_many_worlds_there_are(n_envs):
    players = {"wolf": PlaceMatters(), "sheep": ["graze", PlaceMatters()]}
    expected = small_arena(1).play(players, 40, seed=20).quantities()
    assert len(np.unique(expected["wolf_boundary_term"])) > 10
    assert_same(small_arena(n_envs).play(players, 40, seed=20).quantities(), expected)


def test_episodes_of_unequal_length_count_once_and_to_their_end():
    def played(n_envs):
        env = make_vec_env("Grassland-v0", n_envs, env_kwargs={"n_wolves": 6, "n_sheep": 1, "n_grass": 1})
        return Arena(env).play({"wolf": "chase", "sheep": "random"}, 20)

    alone = played(1)
    assert alone.lengths.min() * 2 < alone.lengths.max()
    assert_same(played(20).quantities(), alone.quantities())


def test_every_episode_and_every_group_draws_its_own_numbers():
    drawn = {"wolf": [], "sheep": []}

    class Spy(RandomPolicy):
        def act(self, observations):
            forces = super().act(observations)
            drawn[self.group].append(forces[:, 0])
            return forces

    arena = small_arena(BLOCK)
    arena.play({group: Spy(arena.layout, group) for group in drawn}, BLOCK)
    first = np.concatenate([drawn["wolf"][0], drawn["sheep"][0]])
    assert len(np.unique(first, axis=0)) == 2 * BLOCK


def test_whoever_sees_the_states_sees_those_of_its_own_world():
    """The oracle, whatever worlds step beside, and beside blocks of rows that have no world."""

    def played(n_envs):
        env = make_vec_env("HardSpread-v0", n_envs, env_kwargs={"max_steps": 12})
        return Arena(env).play({"agent": "oracle"}, 5, seed=30).quantities()

    alone = [
        evaluate(TeamPolicy(layout_of(env), {"agent": "oracle"}, state_source=env.get_attr("worlds")[0].states), env, 1)
        for env in (make_vec_env("HardSpread-v0", 1, seed, {"max_steps": 12}) for seed in range(30, 35))
    ]
    for n_envs in (1, 5):
        own = played(n_envs)
        for name in ("return_agent", "cover_rate"):
            np.testing.assert_allclose(own[name], [episode[name][0] for episode in alone], rtol=1e-6, err_msg=name)
    assert_same(played(1), played(5))


def test_agents_that_choose_draw_only_where_they_are_not_to_be_greedy():
    env = make_vec_env("HardSpread-v0", 4, env_kwargs={"max_steps": 12, "continuous_actions": False})
    model, arena = MADDPG("MlpPolicy", env, **TINY), Arena(env)
    greedy = [arena.play({"agent": model}, 4).quantities() for _ in range(2)]
    assert_same(*greedy)
    drawn = [arena.play({"agent": model}, 4, deterministic=False).returns["agent"] for _ in range(2)]
    assert not np.array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], greedy[0]["return_agent"])


def test_who_watches_hears_of_every_reset_and_step():
    heard = []
    played = small_arena(2).play(
        {"wolf": "chase", "sheep": "graze"}, 3, watch=lambda dones, infos: heard.append((len(dones), len(infos)))
    )
    steps = [max(played.lengths[:2]), played.lengths[2]]
    assert heard == [entry for n in steps for entry in [(2, 0), *[(2, 2)] * n]]
