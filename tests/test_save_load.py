"""Saving and loading, as SB3 tests it: every parameter, optimisers, buffers; with and without an env."""

import io
import pathlib

import numpy as np
import pytest
import torch as th
from crafted import drop, tampered
from references import assert_equal_trees, parameters_of
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn
from toy_envs import ToyParallelEnv

from sb3_kfcv import KFCVMADDPG, MADDPG, PERMADDPG, JointEnv, make_vec_env
from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.envs import grassland_v0, hard_spread_v0
from sb3_kfcv.teams.players import load_player

CURRICULUM = {"teacher_batch_size": 8, "first_teacher_steps": 3, "teacher_steps": 2, "refresh_every": 5}
EVERY_ALGO = pytest.mark.parametrize("algo", [MADDPG, PERMADDPG, KFCVMADDPG])


def toy(**kwargs):
    return JointEnv(ToyParallelEnv(**{"time_limit": 8, "deaths": {"scout_1": 5}, **kwargs}))


def make(algo=MADDPG, env=None, **kwargs):
    settings = {"learning_starts": 20, "batch_size": 8, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    if algo is KFCVMADDPG:
        settings["replay_buffer_kwargs"] = CURRICULUM
    return algo("MlpPolicy", env if env is not None else toy(), device="cpu", **{**settings, **kwargs})


ROWS = np.random.default_rng(0).normal(size=(5, 8)).astype(np.float32)


def assert_same_parameters(one, other):
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert th.equal(value, other[name]), name


def assert_same_optimisers(one, other):
    for name in ("actor", "critic"):
        ours, theirs = (getattr(model, name).optimizer.state_dict()["state"] for model in (one, other))
        assert ours.keys() == theirs.keys() != set()
        for i, state in ours.items():
            for key, value in state.items():
                assert th.equal(value, theirs[i][key]), (name, i, key)


@EVERY_ALGO
@pytest.mark.parametrize("kind", ["str", "path", "bytes"])
def test_a_model_comes_back_whole(algo, kind, tmp_path):
    """After every parameter was changed, so that none can come from a fresh initialisation."""
    model = make(algo).learn(60)
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(th.randn_like(parameter))
    target = {"str": str(tmp_path / "model"), "path": tmp_path / "model.zip", "bytes": io.BytesIO()}[kind]
    model.save(target)
    if kind == "bytes":
        target.seek(0)
    loaded = algo.load(target, env=toy())
    assert_same_parameters(parameters_of(model), parameters_of(loaded))
    assert_same_optimisers(model, loaded)
    np.testing.assert_array_equal(model.predict(ROWS, deterministic=True)[0], loaded.predict(ROWS, deterministic=True)[0])
    assert (loaded.num_timesteps, loaded._n_updates) == (60, model._n_updates)


@EVERY_ALGO
def test_a_model_learns_on_after_loading(algo, tmp_path):
    make(algo).learn(60).save(tmp_path / "model")
    loaded = algo.load(tmp_path / "model", env=toy())
    before = parameters_of(loaded)
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.num_timesteps == 100
    after = parameters_of(loaded)
    assert not [name for name, value in before.items() if th.equal(value, after[name])]


def test_predictions_need_no_env(tmp_path):
    model = make().learn(30)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    assert loaded.env is None
    assert loaded.layout == model.layout
    np.testing.assert_array_equal(model.predict(ROWS, deterministic=True)[0], loaded.predict(ROWS, deterministic=True)[0])
    np.testing.assert_array_equal(model.predict_agent("tank_0", ROWS[:, 6:]), loaded.predict_agent("tank_0", ROWS[:, 6:]))


def test_an_env_can_be_set_after_loading(tmp_path):
    make().learn(30).save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    loaded.set_env(DummyVecEnv([toy]))
    assert loaded.learn(30)._n_updates > 10


@EVERY_ALGO
def test_a_model_goes_on_with_another_number_of_worlds(algo, tmp_path):
    make(algo).learn(30).save(tmp_path / "model")
    loaded = algo.load(tmp_path / "model", env=DummyVecEnv([toy] * 3))
    loaded.learn(90)
    assert loaded.replay_buffer.n_envs == 3


@pytest.mark.parametrize("build", [lambda: "HardSpread-v0", lambda: hard_spread_v0.parallel_env()], ids=["id", "ParallelEnv"])
def test_load_takes_what_the_constructor_takes(build, tmp_path):
    make(env=build()).save(tmp_path / "model")
    MADDPG.load(tmp_path / "model", env=build()).learn(25)


@pytest.mark.parametrize(
    "settings",
    [
        {"critic_input": "state", "share_parameters": True},
        {"policy_kwargs": {"net_arch": [8], "n_critics": 2}, "policy_delay": 2, "max_grad_norm": 0.5},
        {"policy_kwargs": {"net_arch": {"pi": [8], "qf": [12, 6]}, "layer_norm": True}},
        {"learning_rate": 3e-4, "gamma": 0.9, "tau": 0.5, "reward_scale": 0.1, "train_freq": (2, "step")},
    ],
    ids=["state, shared", "stabilised", "layer norm", "numbers"],
)
def test_settings_come_back(settings, tmp_path):
    model = make(**settings)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=toy())
    for name in (*settings, "layout", "agents", "exploration_noise", "replay_buffer_class"):
        assert getattr(loaded, name) == getattr(model, name), name
    assert_same_parameters(parameters_of(model), parameters_of(loaded))
    loaded.learn(40)


def test_replay_settings_come_back(tmp_path):
    make(KFCVMADDPG, replay_buffer_kwargs={"n_folds": 3, "stage_rule": "anti", "lambda_init": 0.0}).save(tmp_path / "model")
    buffer = KFCVMADDPG.load(tmp_path / "model", env=toy()).replay_buffer
    assert (buffer.n_folds, buffer.stage_rule, buffer.lambda_init) == (3, "anti", 0.0)


def taught_with_norms():
    """A model whose layer norms are no longer what they were at first."""
    return make(learning_rate=0.1, policy_kwargs={"net_arch": [8], "layer_norm": True}).learn(40)


@pytest.mark.parametrize("saved", [lambda model: model, lambda model: ActorPolicy.of(model.policy)], ids=["model", "player"])
def test_players_carry_their_layer_norms(saved, tmp_path):
    """Taken out of a model's file, or of a file of the actors alone."""
    model = taught_with_norms()
    saved(model).save(tmp_path / "file.zip")
    player = load_player(tmp_path / "file.zip")
    assert isinstance(player.actor.network(0)[1], nn.LayerNorm)
    np.testing.assert_array_equal(model.predict(ROWS, deterministic=True)[0], player.predict(ROWS, deterministic=True)[0])
    np.testing.assert_array_equal(model.predict_agent("tank_0", ROWS[:, 6:]), player.predict_agent("tank_0", ROWS[:, 6:]))


def test_a_policy_alone_carries_its_layer_norms(tmp_path):
    model = taught_with_norms()
    model.policy.save(tmp_path / "policy.zip")
    loaded = type(model.policy).load(tmp_path / "policy.zip")
    assert_same_parameters(parameters_of(model), loaded.state_dict())


def test_a_player_of_a_file_that_says_nothing_of_layer_norms_has_none(tmp_path):
    ActorPolicy.of(make().policy).save(tmp_path / "new.zip")
    tampered(tmp_path / "new.zip", tmp_path / "old.zip", drop("player", "layer_norm"))
    assert [type(layer) for layer in load_player(tmp_path / "old.zip").actor.network(0)] == [nn.Linear, nn.ReLU, nn.Linear]


def test_a_discrete_model_comes_back(tmp_path):
    model = make(env=toy(discrete=True)).learn(40)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model")
    np.testing.assert_array_equal(model.predict(ROWS, deterministic=True)[0], loaded.predict(ROWS, deterministic=True)[0])


def test_a_scripted_opponent_comes_back_with_its_team(tmp_path):
    env = grassland_v0.parallel_env(n_wolves=2, n_sheep=1, max_steps=10)
    make(env=env, team="wolf", opponents={"sheep": "flee"}).learn(30).save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=env)
    assert (loaded.team, loaded.opponents) == ("wolf", {"sheep": "flee"})
    loaded.learn(30)


def test_an_opponent_model_is_given_again(tmp_path):
    env = grassland_v0.parallel_env(n_wolves=2, n_sheep=1, max_steps=10)
    sheep = make(env=env)
    make(env=env, team="wolf", opponents={"sheep": sheep}).save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=env, opponents={"sheep": sheep})
    loaded.learn(30)


def test_a_model_of_normalised_worlds_goes_on(tmp_path):
    env = VecNormalize(make_vec_env("HardSpread-v0", 2, env_kwargs={"n_agents": 2}), norm_reward=False)
    make(env=env).learn(40).save(tmp_path / "model")
    MADDPG.load(tmp_path / "model", env=env).learn(40)


# ---- parameters by hand


def test_parameters_can_be_carried_over():
    one, other = make(seed=1).learn(30), make(seed=2).learn(30)
    other.set_parameters(one.get_parameters())
    assert_same_parameters(parameters_of(one), parameters_of(other))
    assert_same_optimisers(one, other)


def test_part_of_the_parameters_can_be_carried_over():
    one, other = make(seed=1), make(seed=2)
    other.set_parameters({"policy": one.get_parameters()["policy"]}, exact_match=False)
    assert_same_parameters(parameters_of(one), parameters_of(other))


def test_missing_parameters_are_named():
    model = make()
    with pytest.raises(ValueError, match=r"actor\.optimizer"):
        model.set_parameters({"policy": model.get_parameters()["policy"]})


# ---- the replay buffer's file


@EVERY_ALGO
@pytest.mark.parametrize("kind", ["str", "path", "bytes"])
def test_the_replay_buffer_comes_back(algo, kind, tmp_path):
    model = make(algo).learn(150)
    target = {"str": str(tmp_path / "buffer"), "path": tmp_path / "buffer.zip", "bytes": io.BytesIO()}[kind]
    model.save_replay_buffer(target)
    if kind == "bytes":
        target.seek(0)
    other = make(algo, seed=9)
    other.load_replay_buffer(target)
    assert_equal_trees(model.replay_buffer.state(), other.replay_buffer.state())
    assert_equal_trees(model.replay_buffer.transitions(), other.replay_buffer.transitions())
    other.learn(30)


@EVERY_ALGO
def test_a_replay_buffer_moves_to_another_number_of_worlds(algo, tmp_path):
    model = make(algo).learn(70)
    model.save_replay_buffer(tmp_path / "buffer")
    other = make(algo, env=DummyVecEnv([toy] * 3))
    other.load_replay_buffer(tmp_path / "buffer")
    assert other.replay_buffer.n_rows == 69
    np.testing.assert_array_equal(
        other.replay_buffer.transitions()["rewards"].reshape(69, -1), model.replay_buffer.transitions()["rewards"][1:, 0]
    )
    other.learn(30, reset_num_timesteps=False)


@pytest.mark.parametrize("algo", [MADDPG, KFCVMADDPG])
def test_a_replay_buffer_of_another_world_is_refused(algo, tmp_path):
    make(algo).learn(30).save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match="not a replay buffer of this model"):
        make(algo, env=JointEnv(ToyParallelEnv(agents=("scout_0", "tank_0")))).load_replay_buffer(tmp_path / "buffer")


def test_a_replay_buffer_of_another_algorithm_is_refused_in_a_sentence(tmp_path):
    make(MADDPG).learn(30).save_replay_buffer(tmp_path / "buffer")
    for algo in (PERMADDPG, KFCVMADDPG):
        with pytest.raises(ValueError, match="not a replay buffer of this model"):
            make(algo).load_replay_buffer(tmp_path / "buffer")


def test_a_truncated_replay_buffer_is_refused_by_the_files_name(tmp_path):
    make().learn(30).save_replay_buffer(tmp_path / "buffer")
    whole = (tmp_path / "buffer.zip").read_bytes()
    (tmp_path / "buffer.zip").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="buffer"):
        make().load_replay_buffer(tmp_path / "buffer")


# ---- what must not happen


@pytest.mark.parametrize("name", ["model", "model.zip", "v1.0"])
def test_the_ending_is_added_where_it_lacks(name, tmp_path):
    make().save(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name.removesuffix(".zip") + ".zip"]
    MADDPG.load(tmp_path / name)


def test_folders_are_made(tmp_path):
    make().save(tmp_path / "runs" / "1" / "model")
    assert pathlib.Path(tmp_path / "runs" / "1" / "model.zip").is_file()


def test_a_model_of_another_world_is_refused_in_a_sentence(tmp_path):
    make().save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"model.*another world"):
        MADDPG.load(tmp_path / "model", env=JointEnv(ToyParallelEnv(agents=("scout_0", "tank_0"))))


class Renamed(ToyParallelEnv):
    """The same spaces, other agents."""

    def __init__(self):
        super().__init__(time_limit=8)
        names = {"scout_0": "spy_0", "scout_1": "spy_1", "tank_0": "truck_0"}
        self.possible_agents = [names[agent] for agent in self.possible_agents]
        self._observation_spaces = {names[a]: s for a, s in self._observation_spaces.items()}
        self._action_spaces = {names[a]: s for a, s in self._action_spaces.items()}


def test_a_world_of_equal_spaces_but_other_agents_is_refused(tmp_path):
    make().save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"2 scout.*2 spy"):
        MADDPG.load(tmp_path / "model", env=JointEnv(Renamed()))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        MADDPG.load(tmp_path / "nowhere")


def test_a_truncated_model_is_refused_by_the_files_name(tmp_path):
    make().save(tmp_path / "model")
    whole = (tmp_path / "model.zip").read_bytes()
    (tmp_path / "model.zip").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="model"):
        MADDPG.load(tmp_path / "model", env=toy())


@pytest.mark.parametrize(
    "settings", [{}, {"critic_input": "state", "policy_kwargs": {"net_arch": [8], "n_critics": 2}}], ids=["plain", "twin"]
)
def test_a_policy_alone_comes_back(settings, tmp_path):
    model = make(**settings).learn(40)
    model.policy.save(tmp_path / "policy.zip")
    policy = type(model.policy).load(tmp_path / "policy.zip", device="cpu")
    assert_same_parameters(model.policy.state_dict(), policy.state_dict())
    np.testing.assert_array_equal(model.predict(ROWS, deterministic=True)[0], policy.predict(ROWS, deterministic=True)[0])
