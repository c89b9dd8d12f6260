"""Who plays a group: a saved player acts as its model did, a mixture is drawn per episode, and targets know who plays."""

import numpy as np
import pytest
import torch as th
from crafted import make as make_toy
from crafted import toy
from mpe2 import simple_adversary_v3, simple_tag_v3
from references import fill
from stable_baselines3.common.evaluation import evaluate_policy
from torch import nn

from sb3_kfcv import MADDPG, PERMADDPG, CoTraining, FileFormatError, make_vec_env
from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.callbacks import MultiAgentEvalCallback, SavePlayers
from sb3_kfcv.common.evaluation import evaluate
from sb3_kfcv.envs import grassland_v0
from sb3_kfcv.saving.checkpoints import Checkpoints
from sb3_kfcv.teams.players import Mixture, find_player, load_player, written
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import layout_of

SMALL = {"learning_starts": 20, "batch_size": 8, "buffer_size": 200, "policy_kwargs": {"net_arch": [8]}}
GRASSLAND = {"n_wolves": 2, "n_sheep": 2, "n_grass": 1, "max_steps": 5}
RNG = np.random.default_rng(0)


def grassland(n=2, seed=0, **kwargs):
    return make_vec_env("Grassland-v0", n, seed, {**GRASSLAND, **kwargs})


def small(env=None, algo=MADDPG, **settings):
    return algo("MlpPolicy", env or grassland(), device="cpu", **{"seed": 1, **SMALL, **settings})


def rows_of(layout, n=6):
    return np.random.default_rng(5).normal(size=(n, sum(layout.obs_sizes))).astype(np.float32)


LAYOUT = layout_of(grassland())
ROWS = rows_of(LAYOUT)
WOLVES, SHEEP = slice(0, 4), slice(4, 8)


class Pushes:
    """Plays one number: what it did can be read off the actions."""

    def __init__(self, value, layout=LAYOUT):
        self.value, self.size = value, sum(layout.action_sizes)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.full((len(observation), self.size), self.value, np.float32), None


# ---- a saved player acts as its model

KINDS_OF_MODELS = {
    "observations": {},
    "state": {"critic_input": "state"},
    "own observation": {"critic_input": "own_observation"},
    "shared parameters": {"share_parameters": True},
    "discrete": {"env": toy(discrete=True)},
    "discrete, shared": {"env": toy(discrete=True), "share_parameters": True},
    "layers of its own": {"policy_kwargs": {"net_arch": {"pi": [5, 3], "qf": [7]}}},
    "another activation": {"policy_kwargs": {"net_arch": [4], "activation_fn": nn.Tanh}},
    "twin critics": {"policy_kwargs": {"net_arch": [4], "n_critics": 2}},
    "a team": {"team": "scout", "opponents": {"tank": "random"}},
    "the last team": {"team": "tank", "opponents": {"scout": "random"}},
}


@pytest.mark.filterwarnings("ignore:the state of ToyParallelEnv cannot be read")
@pytest.mark.parametrize("kind", KINDS_OF_MODELS)
def test_a_player_from_any_file_plays_what_its_model_plays(kind, tmp_path):
    model = make_toy("maddpg", **KINDS_OF_MODELS[kind])
    model.learn(24, [Checkpoints(tmp_path), SavePlayers(tmp_path, 1000)])
    model.save(tmp_path / "model")
    ActorPolicy.of(model.policy).save(tmp_path / "alone.zip")
    rows = rows_of(model.layout)
    wanted = model.policy.predict(rows, deterministic=True)[0]
    team = model.team or "all"
    files = ["model", "model.zip", "alone.zip", "rl_model_24_steps.zip", f"{team}_24_steps.zip"]
    for name in files:
        player = load_player(tmp_path / name, model.team)
        np.testing.assert_array_equal(player.predict(rows, deterministic=True)[0], wanted, err_msg=name)
    for agent in player.agents:
        own = rows[0, model.layout.obs_slices[agent]]
        name = model.layout.agents[agent]
        np.testing.assert_array_equal(player.predict_agent(name, own), model.predict_agent(name, own))


def test_a_player_loaded_alone_is_frozen(tmp_path):
    model = small().learn(30)
    ActorPolicy.of(model.policy).save(tmp_path / "player.zip")
    player = ActorPolicy.load(tmp_path / "player.zip", device="cpu")
    before = player.predict(ROWS, deterministic=True)[0]
    model.learn(30)
    np.testing.assert_array_equal(player.predict(ROWS, deterministic=True)[0], before)
    assert not np.array_equal(model.predict(ROWS, deterministic=True)[0], before)
    assert not any(parameter.requires_grad for parameter in player.actor.parameters())


def test_players_are_made_without_drawing_from_the_programs_generator(tmp_path):
    """Else a training that saves its opponents would go on otherwise than one that loads them."""
    model = small(team="wolf", opponents={"sheep": ActorPolicy.of(small(seed=7).policy)})
    for act in (
        lambda: ActorPolicy.of(model.policy),
        lambda: model.save(tmp_path / "model"),
        lambda: load_player(tmp_path / "model"),
    ):
        before = th.get_rng_state()
        act()
        assert th.equal(th.get_rng_state(), before)


def test_a_discrete_player_explores_as_its_model_does(tmp_path):
    model = make_toy("discrete").learn(20)
    ActorPolicy.of(model.policy).save(tmp_path / "player.zip")
    player, rows = load_player(tmp_path / "player"), rows_of(model.layout, 500)
    drawn = []
    for policy in (model.policy, player):
        th.manual_seed(3)
        drawn.append(policy.predict(rows, deterministic=False)[0])
    np.testing.assert_array_equal(*drawn)
    assert len(np.unique(drawn[0][:, 0])) > 1


def test_players_are_saved_from_the_start_to_the_end(tmp_path):
    model = small(team="wolf", opponents={"sheep": "flee"})
    model.learn(50, SavePlayers(tmp_path, 20))
    assert {path.name for path in tmp_path.iterdir()} == {f"wolf_{n}_steps.zip" for n in (0, 20, 40, 50)}
    last = load_player(tmp_path / "wolf_50_steps.zip")
    np.testing.assert_array_equal(
        last.predict(ROWS, deterministic=True)[0][:, WOLVES], model.predict(ROWS, deterministic=True)[0][:, WOLVES]
    )


# ---- opponents in every form


@pytest.fixture(scope="module")
def sheep(tmp_path_factory):
    """A model of all agents, and its file."""
    model = small(seed=7).learn(40)
    path = tmp_path_factory.mktemp("sheep") / "sheep.zip"
    model.save(path)
    return model, path


FORMS = {
    "path": lambda model, path: path,
    "text": lambda model, path: str(path),
    "path without its ending": lambda model, path: path.with_suffix(""),
    "model": lambda model, path: model,
    "policy": lambda model, path: model.policy,
    "player": lambda model, path: ActorPolicy.of(model.policy),
    "list of one": lambda model, path: [str(path)],
    "map to weights": lambda model, path: {str(path): 3, "flee": 0},
    "mixture": lambda model, path: Mixture([model], [2]),
}


@pytest.mark.parametrize("form", FORMS)
def test_opponents_may_be_given_in_any_form(sheep, form):
    model, path = sheep
    wolves = small(team="wolf", opponents={"sheep": FORMS[form](model, path)}).learn(30)
    ours, theirs = (one.predict(ROWS, deterministic=True)[0] for one in (wolves, model))
    np.testing.assert_array_equal(ours[:, SHEEP], theirs[:, SHEEP])
    assert not np.array_equal(ours[:, WOLVES], theirs[:, WOLVES])


def test_the_players_of_a_team_policy_may_be_files(sheep):
    model, path = sheep
    players = {"wolf": small(), "sheep": path}
    joined = TeamPolicy(LAYOUT, players).predict(ROWS)[0]
    np.testing.assert_array_equal(joined[:, SHEEP], model.predict(ROWS, deterministic=True)[0][:, SHEEP])
    np.testing.assert_array_equal(joined[:, WOLVES], players["wolf"].predict(ROWS, deterministic=True)[0][:, WOLVES])


# ---- targets know who plays


def target_of(opponent, **settings):
    """A model of the wolves with made-up transitions, and the TD targets of one minibatch by its current opponents."""
    model = small(team="wolf", opponents={"sheep": opponent}, **settings)
    fill(model.replay_buffer, model.layout, 60)
    batch = model.replay_buffer.sample(16)
    return lambda: model.td_target(batch).clone()


def test_targets_follow_a_live_opponent():
    live = small(seed=7)
    target = target_of(live)
    before = target()
    assert th.equal(target(), before)
    live.learn(60)
    assert not th.allclose(target(), before)


def test_targets_stay_with_a_frozen_opponent(tmp_path):
    live = small(seed=7)
    ActorPolicy.of(live.policy).save(tmp_path / "frozen.zip")
    target = target_of(tmp_path / "frozen.zip")
    before = target()
    live.learn(60)
    assert th.equal(target(), before)


@pytest.mark.parametrize("continuous", [True, False])
def test_the_critics_expect_of_a_saved_opponent_what_it_plays(continuous):
    env = grassland(continuous_actions=continuous)
    opponent = small(env, seed=7)
    model = small(env, team="wolf", opponents={"sheep": ActorPolicy.of(opponent.policy)})
    observations = th.as_tensor(ROWS)
    expected = model._target_actions(observations)
    played = th.as_tensor(model.policy.from_env(opponent.predict(ROWS, deterministic=True)[0]))
    half = sum(model.layout.action_sizes) // 2
    th.testing.assert_close(expected[:, half:], model.policy.encode(played)[:, half:])


def test_targets_draw_the_players_of_a_mixture_by_their_weights():
    model = small(team="wolf", opponents={"sheep": Mixture([Pushes(-0.5), Pushes(0.5)], [1, 3])})
    expected = model._target_actions(th.zeros(4000, ROWS.shape[1]))[:, SHEEP]
    assert set(expected.unique().tolist()) == {-0.5, 0.5}
    assert (expected == expected[:, :1]).all()  # all sheep by one player
    share = (expected[:, 0] > 0).float().mean().item()
    assert abs(share - 0.75) < 4 * np.sqrt(0.75 * 0.25 / 4000)


# ---- mixtures


def mixed(weights, seed=0):
    players = [Pushes(value) for value in np.linspace(-1, 1, len(weights))]
    return TeamPolicy(LAYOUT, {"wolf": Pushes(0), "sheep": Mixture(players, weights)}, np.random.default_rng(seed))


def test_a_mixture_draws_by_its_weights():
    drawn = Mixture(["flee", "graze", "random"], [1, 2, 5]).draw(8000, np.random.default_rng(0))
    expected = np.array([1, 2, 5]) / 8
    assert (np.abs(np.bincount(drawn) / 8000 - expected) < 4 * np.sqrt(expected * (1 - expected) / 8000)).all()


def test_a_player_of_weight_0_never_plays():
    assert set(Mixture(["flee", "graze"], [0, 1]).draw(1000, np.random.default_rng(0))) == {1}


def test_a_mixture_keeps_its_player_to_the_end_of_the_episode_of_each_world():
    """Episodes of 5 steps; those of half of the worlds end two steps before the others'."""
    policy, n = mixed([1, 1, 1]), 200
    starts, state, before = np.ones(n, dtype=bool), None, None
    changed = []
    for step in range(20):
        actions, state = policy.predict(np.zeros((n, ROWS.shape[1]), np.float32), state, starts)
        who = actions[:, 4]
        if before is not None:
            assert (who == before)[~starts].all()
            changed += (who != before)[starts].tolist()
        before = who
        starts = np.where(np.arange(n) % 2 == 0, (step + 1) % 5 == 0, (step + 3) % 5 == 0)
    assert abs(np.mean(changed) - 2 / 3) < 0.06  # of three players, two are others than the last one


@pytest.mark.parametrize("by", ["evaluate_policy", "evaluate", "learn"])
def test_one_player_of_a_mixture_plays_a_whole_episode(by):
    """Whoever calls: SB3's evaluation, ours, and the training; players come in the shares of their weights."""
    env, seen = grassland(4, seed=3), []
    step = env.venv.step_async

    def note(actions):
        seen.append(np.array(actions)[:, 4])
        step(actions)

    env.venv.step_async = note
    opponents = {"sheep": Mixture([Pushes(-1), Pushes(1)], [1, 2])}
    model = small(env, team="wolf", opponents=opponents, learning_starts=10_000)
    if by == "learn":
        model.learn(4 * 5 * 60)
    elif by == "evaluate":
        evaluate(model, env, 240)
    else:
        evaluate_policy(model, env, 240)
    lengths = np.array(seen[: len(seen) // 5 * 5]).reshape(-1, 5, 4)  # episodes end by the time limit: nobody is eaten so soon
    whole = (lengths == lengths[:, :1]).all(axis=1)
    assert whole.mean() > 0.9, "episodes of one player"
    share = (lengths[:, 0] > 0).mean()
    assert abs(share - 2 / 3) < 0.12


def test_single_rows_and_batches_of_another_size_draw_anew():
    policy = mixed([1, 1])
    _, state = policy.predict(ROWS, None, np.ones(6, dtype=bool))
    actions, again = policy.predict(ROWS[:2], state, np.zeros(2, dtype=bool))
    assert (len(actions), len(again[0])) == (2, 2)
    assert policy.predict(ROWS[0])[0].shape == (8,)


def test_a_mixture_of_one_sure_player_is_that_player(sheep):
    _, path = sheep
    one, other = (small(team="wolf", opponents={"sheep": who}, seed=2).learn(60) for who in (path, [path]))
    assert all(map(th.equal, one.policy.state_dict().values(), other.policy.state_dict().values()))


# ---- files need no other file


@pytest.mark.parametrize("form", ["path", "mixture"])
def test_a_model_needs_no_file_of_its_opponents(tmp_path, form):
    small(seed=7).learn(30).save(tmp_path / "sheep")
    file = tmp_path / "sheep.zip"
    model = small(team="wolf", opponents={"sheep": file if form == "path" else {str(file): 2, "flee": 0}}).learn(30)
    model.save(tmp_path / "wolves")
    file.unlink()
    loaded = MADDPG.load(tmp_path / "wolves", env=grassland(), device="cpu")
    np.testing.assert_array_equal(*(one.predict(ROWS, deterministic=True)[0] for one in (model, loaded)))
    loaded.learn(30)
    loaded.save(tmp_path / "again")
    assert MADDPG.load(tmp_path / "again").predict(ROWS)[0].shape == (6, 8)


def test_an_opponent_that_no_file_holds_is_given_again(tmp_path):
    small(team="wolf", opponents={"sheep": Pushes(0.5)}).save(tmp_path / "wolves")
    with pytest.raises(ValueError, match="needs players for the other groups"):
        MADDPG.load(tmp_path / "wolves")
    loaded = MADDPG.load(tmp_path / "wolves", opponents={"sheep": Pushes(0.5)})
    assert (loaded.predict(ROWS)[0][:, SHEEP] == 0.5).all()


def test_what_is_written_of_a_player():
    model = small()
    assert written("flee") == "flee"
    assert written(find_player("flee", LAYOUT, "sheep", RNG)) == "flee"
    assert written(find_player("random", toy().layout, "tank", RNG, toy().action_space)) == "random"
    assert type(written(model)) is ActorPolicy
    assert written(Mixture(["flee", model])).players[0] == "flee"


# ---- refusals


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "a mixture needs players"),
        ({}, "a mixture needs players"),
        ([["flee"], "graze"], "a mixture cannot hold another mixture"),
        ({"flee": 0}, r"at least 0, and one of them above; got \[0.0\]"),
        ({"flee": -1, "graze": 2}, r"at least 0, and one of them above; got \[-1.0, 2.0\]"),
        ({"flee": float("nan")}, r"got \[nan\]"),
        ({"flee": float("inf")}, r"got \[inf\]"),
        ({"flee": "often"}, r"weights of a mixture must be numbers, got \['often'\]"),
        ({"flee": [1, 2], "graze": 1}, r"weights of a mixture must be numbers"),
        ({"flee": None}, r"weights of a mixture must be numbers, got \[None\]"),
        ({"flee": True}, r"weights of a mixture must be numbers, got \[True\]"),
        (["flee", "graz"], 'unknown scripted policy of \'sheep\' "graz"; did you mean "graze"?'),
        ("chase", "unknown scripted policy of 'sheep' \"chase\".*known: flee, graze"),
        ("none.zip", "there is no file none.zip to take a player of"),
        (3, "'sheep' cannot be played by 3"),
        (MADDPG, "'sheep' cannot be played by <class"),
    ],
    ids=str,
)
def test_who_cannot_play_is_refused_in_a_sentence(given, message):
    with pytest.raises(ValueError, match=message) as caught:
        small(team="wolf", opponents={"sheep": given})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", ["flee", ["flee"], 3, Mixture(["flee"])], ids=["a text", "a list", "a number", "a mixture"])
def test_players_are_given_by_their_group(given):
    with pytest.raises(ValueError, match=r"players are given by their group, such as \{'sheep': 'random'\}; got"):
        small(team="wolf", opponents=given)


def test_opponents_of_nobody_are_refused():
    env = make_vec_env("HardSpread-v0", 1, env_kwargs={"n_agents": 2})
    with pytest.raises(ValueError, match="team='agent' is everybody in this world"):
        small(env, team="agent", opponents={"wall": "random"})


def test_weights_without_a_player_for_each_are_refused():
    with pytest.raises(ValueError, match="a mixture needs players, and a weight for each; got 2 and"):
        Mixture(["flee", "graze"], [1])


def test_a_player_of_another_world_or_group_is_refused(tmp_path, sheep):
    small(grassland(n_wolves=3)).save(tmp_path / "three")
    small(team="wolf", opponents={"sheep": "flee"}).save(tmp_path / "wolves")
    for name, message in (
        ("three", r"three.zip is for another world: 3 wolf .*; this one has 2 wolf"),
        ("wolves", r"wolves.zip plays wolf; wanted is a player of sheep"),
    ):
        with pytest.raises(ValueError, match=message):
            small(team="wolf", opponents={"sheep": tmp_path / f"{name}.zip"})
    with pytest.raises(ValueError, match="there is no file"):
        small(team="wolf", opponents={"sheep": tmp_path})


def test_a_damaged_player_is_refused_by_its_name(tmp_path, sheep):
    data = sheep[1].read_bytes()
    for name, damaged in {"half": data[: len(data) // 2], "bit": data[:900] + b"\x00\x01" + data[902:], "none": b""}.items():
        (tmp_path / f"{name}.zip").write_bytes(damaged)
        with pytest.raises(FileFormatError, match=f"{name}.zip") as caught:
            small(team="wolf", opponents={"sheep": tmp_path / f"{name}.zip"})
        assert "\n" not in str(caught.value)


def test_a_file_that_is_no_player_is_refused(tmp_path, sheep):
    sheep[0].save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(FileFormatError, match="is a 'replay buffer' file; wanted is player or model or checkpoint"):
        load_player(tmp_path / "buffer.zip")
    with pytest.raises(FileFormatError, match="is a 'model' file; wanted is player"):
        ActorPolicy.load(sheep[1])


def test_a_group_that_no_learner_of_a_file_plays_is_refused(tmp_path):
    small(algo=co_training).save(tmp_path / "both")
    for group in ("wolf", "sheep"):
        assert [LAYOUT.groups[i] for i in load_player(tmp_path / "both", group).agents] == [group] * 2
    with pytest.raises(FileFormatError, match="its learners play wolf, sheep, not goat"):
        load_player(tmp_path / "both", "goat")


# ---- other people's worlds


def co_training(policy, env, device, seed, **settings):
    groups = layout_of(env).group_names
    return CoTraining(policy, env, {group: {"algo": "maddpg", **settings} for group in groups}, seed=seed, device=device)


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
@pytest.mark.parametrize("continuous", [True, False], ids=["continuous", "discrete"])
@pytest.mark.parametrize("world", [simple_tag_v3, simple_adversary_v3], ids=["tag", "adversary"])
def test_teams_of_mpe2(world, continuous, tmp_path):
    def env(seed=0):
        return make_vec_env(lambda: world.parallel_env(max_cycles=5, continuous_actions=continuous), 2, seed)

    layout = layout_of(env())
    team, other = layout.group_names
    rows = rows_of(layout)
    alone = small(env(), PERMADDPG, team=team, opponents={other: "random"}).learn(40)
    alone.save(tmp_path / "alone")
    against = small(env(), team=other, opponents={team: tmp_path / "alone.zip"}).learn(40)
    assert against.num_timesteps == 40
    both = small(env(), co_training)
    yardstick = MultiAgentEvalCallback(env(9), 20, 2, tmp_path, tmp_path, team=team, opponents={other: "random"}, verbose=0)
    both.learn(40, yardstick)
    assert yardstick.arrays()[f"return_{team}"].shape == (2, 2)
    both.save(tmp_path / "both")
    loaded = CoTraining.load(tmp_path / "both", env=env())
    np.testing.assert_array_equal(*(one.predict(rows, deterministic=True)[0] for one in (both, loaded)))
    assert np.isfinite(evaluate_policy(loaded, env(), 2)[0])
    assert loaded.learn(40).num_timesteps == 40


@pytest.mark.parametrize(
    "maker", [lambda **kwargs: make_vec_env("Grassland-v0", 2, env_kwargs=kwargs), grassland_v0.parallel_env]
)
def test_scripted_opponents_know_of_the_obstacles(maker):
    """Obstacles end the observation: who does not know of them takes them for grass, and everybody for somebody else."""
    model = MADDPG(
        "MlpPolicy", maker(n_wolves=2, n_sheep=1, n_grass=1, n_obstacles=3), team="wolf", opponents={"sheep": "graze"}
    )
    assert model._opponent_policy.players["sheep"].grass(np.zeros((1, 1, model.layout.obs_sizes[2]))).shape == (1, 1, 1, 2)
