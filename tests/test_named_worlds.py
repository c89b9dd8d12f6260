"""PettingZoo's worlds and SuperSuit's wrappers by their names, and MPE's worlds trained on."""

import functools
import importlib.util
import sys

import gymnasium as gym
import numpy as np
import pettingzoo
import pytest
from toy_envs import ToyParallelEnv

from sb3_kfcv import MADDPG, make_vec_env
from sb3_kfcv.teams.players import scripted_for
from sb3_kfcv.vec_env.make import layout_of
from sb3_kfcv.vec_env.named_worlds import find_world, world_names
from sb3_kfcv.vec_env.named_wrappers import find_wrappers, listed_wrappers

QUICK = {"learning_starts": 20, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
REGISTRY = pytest.mark.skipif(not hasattr(pettingzoo, "register"), reason="this PettingZoo has no registry")


# ---- names

needs_mpe2 = pytest.mark.skipif(importlib.util.find_spec("mpe2") is None, reason="mpe2 is not installed")


@needs_mpe2
def test_the_names_of_a_package_are_its_modules():
    assert {"mpe2/simple_tag_v3", "mpe2/simple_speaker_listener_v4"} <= set(world_names())
    assert "mpe2/all_modules" not in world_names()


@needs_mpe2
def test_the_version_may_be_written_in_both_ways():
    assert layout_of(make_vec_env("mpe2/simple_tag-v3")) == layout_of(make_vec_env("mpe2/simple_tag_v3"))


@needs_mpe2
def test_a_world_has_its_groups():
    layout = layout_of(make_vec_env("mpe2/simple_tag_v3", env_kwargs={"num_good": 2}))
    assert layout.agents == ("adversary_0", "adversary_1", "adversary_2", "agent_0", "agent_1")
    assert layout.group_names == ("adversary", "agent")


@needs_mpe2
def test_the_scalar_reward_of_a_named_world_can_be_chosen():
    rewards = {}
    for reward in ("mean", "agent"):
        env = make_vec_env("mpe2/simple_tag_v3", 1, 3, reward=reward)
        env.reset()
        _, rewards[reward], _, infos = env.step(np.zeros((1, 4), int))
    each = infos[0]["agent_rewards"]
    np.testing.assert_allclose([rewards["mean"][0], rewards["agent"][0]], [each.mean(), each[3]], rtol=1e-6)


UNKNOWN = [
    ("mpe2/simple_tg_v3", 'unknown environment "mpe2/simple_tg_v3"; did you mean "mpe2/simple_tag_v3"?'),
    ("mpe2/simple_tag_v2", 'did you mean "mpe2/simple_tag_v3"?'),
    ("simple_tag_v3", 'did you mean "mpe2/simple_tag_v3"?'),
    ("mpe2/all_modules", 'unknown environment "mpe2/all_modules"'),
    ("mpe2/_mpe_utils.core", 'unknown environment "mpe2/_mpe_utils.core"'),
    ("os/path", 'unknown environment "os/path"'),
    ("json.tool", 'unknown environment "json.tool"'),
]


@needs_mpe2
@pytest.mark.parametrize(("name", "sentence"), UNKNOWN)
def test_an_unknown_name_is_refused_with_the_nearest(name, sentence):
    with pytest.raises(ValueError) as caught:
        make_vec_env(name)
    assert sentence in str(caught.value)


def test_a_name_imports_nothing_that_is_not_allowed(tmp_path, monkeypatch):
    (tmp_path / "stranger").mkdir()
    (tmp_path / "stranger" / "world_v0.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("stranger/world_v0", "stranger.world_v0", "../stranger/world_v0", "mpe2/../stranger/world_v0"):
        assert find_world(name) is None


@needs_mpe2
@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"num_god": 2}, 'unknown setting of mpe2/simple_tag_v3 "num_god"; did you mean "num_good"?'),
        ({"num_agent_neighbors": 0}, "must be a positive integer"),
        ({"num_good": "two"}, "mpe2/simple_tag_v3 cannot be made with {'num_good': 'two'}"),
    ],
)
def test_settings_that_the_world_does_not_take_are_refused(settings, sentence):
    with pytest.raises(ValueError) as caught:
        make_vec_env("mpe2/simple_tag_v3", env_kwargs=settings)
    assert sentence in str(caught.value)


def without(monkeypatch, package):
    """Let a package be missing, whether it is installed or not."""
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)


def test_a_missing_package_gives_its_command(monkeypatch):
    without(monkeypatch, "mpe2")
    with pytest.raises(gym.error.DependencyNotInstalled, match=r'mpe2/simple_v3 needs mpe2, .*: pip install "mpe2"'):
        make_vec_env("mpe2/simple_v3")


@REGISTRY
def test_a_missing_extra_gives_its_command(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("pettingzoo.sisl")]:
        monkeypatch.delitem(sys.modules, name)
    without(monkeypatch, "Box2D")
    with pytest.raises(gym.error.DependencyNotInstalled, match=r'needs Box2D, .*: pip install "pettingzoo\[sisl\]"'):
        make_vec_env("sisl/multiwalker_v9")


@REGISTRY
def test_a_game_in_turns_is_refused():
    with pytest.raises(ValueError, match=r"tictactoe.*act in turn"):
        make_vec_env("classic/tictactoe_v3")


@REGISTRY
def test_a_world_of_pettingzoos_registry():
    env = make_vec_env("classic/rps_v2", 2, 0, {"max_cycles": 3})
    env.reset()
    assert [env.step(np.array([[0, 1], [2, 2]]))[2].tolist() for _ in range(3)] == [[False] * 2, [False] * 2, [True] * 2]


@REGISTRY
def test_a_world_that_a_program_has_registered(monkeypatch):
    for registry in ("parallel_registry", "aec_registry"):
        monkeypatch.setattr(pettingzoo, registry, dict(getattr(pettingzoo, registry)))
    spec = type(pettingzoo.spec("parallel", "Grassland-v0"))("toys/line-v0", ToyParallelEnv, {"time_limit": 2})
    pettingzoo.parallel_registry["toys/line-v0"] = spec
    assert layout_of(make_vec_env("toys/line-v0")).agents == ("scout_0", "scout_1", "tank_0")
    with pytest.raises(ValueError, match=r'unknown setting of toys/line_v0 "time_limt"; did you mean "time_limit"'):
        make_vec_env("toys/line_v0", env_kwargs={"time_limt": 3})


# ---- training on MPE's worlds

MPE = ["simple_spread_v3", "simple_tag_v3", "simple_adversary_v3", "simple_speaker_listener_v4", "simple_reference_v3"]


@needs_mpe2
@pytest.mark.parametrize("continuous_actions", [True, False])
@pytest.mark.parametrize("world", MPE)
def test_mpe_trains_saves_and_loads(world, continuous_actions, tmp_path):
    env = make_vec_env(f"mpe2/{world}", 2, 0, {"continuous_actions": continuous_actions, "max_cycles": 10})
    model = MADDPG("MlpPolicy", env, seed=0, critic_input="state", **QUICK).learn(60)
    model.save(tmp_path / "model")
    rows = env.reset()
    actions = model.predict(rows, deterministic=True)[0]
    np.testing.assert_array_equal(MADDPG.load(tmp_path / "model", env).predict(rows, deterministic=True)[0], actions)
    assert env.action_space.contains(actions[0])
    assert model.replay_buffer.dones.max() == 0  # MPE's episodes end by their time limit


@needs_mpe2
@pytest.mark.parametrize("continuous_actions", [True, False])
def test_scripts_of_our_worlds_do_not_play_in_others(continuous_actions):
    """simple_spread has agents with five choices, as Hard Spread has, who see something else."""
    layout = layout_of(make_vec_env("mpe2/simple_spread_v3", 1, env_kwargs={"continuous_actions": continuous_actions}))
    assert list(scripted_for(layout, "agent")) == ["random"]


@needs_mpe2
def test_algorithms_take_names(tmp_path):
    model = MADDPG("MlpPolicy", "mpe2/simple_spread_v3", **QUICK).learn(30)
    assert model.layout.agents == ("agent_0", "agent_1", "agent_2")
    model.save(tmp_path / "model")
    again = MADDPG.load(tmp_path / "model", "mpe2/simple_spread_v3")
    again.set_env("mpe2/simple_spread_v3")
    with pytest.raises(ValueError, match=r'unknown environment "mpe2/simple_spred_v3"; did you mean "mpe2/simple_spread_v3"'):
        MADDPG("MlpPolicy", "mpe2/simple_spred_v3")


@REGISTRY
@pytest.mark.parametrize(
    ("name", "package", "settings"),
    [
        ("sisl/pursuit_v5", "pygame", {"n_pursuers": 2, "n_evaders": 2, "x_size": 5, "y_size": 5, "max_cycles": 10}),
        ("sisl/multiwalker_v9", "Box2D", {"max_cycles": 10}),
    ],
)
def test_sisl_trains(name, package, settings):
    pytest.importorskip(package)
    model = MADDPG("MlpPolicy", make_vec_env(name, 1, 0, settings), seed=0, **QUICK)
    before = [parameter.clone() for parameter in model.actor.parameters()]
    model.learn(40)
    assert any((now != then).any() for now, then in zip(model.actor.parameters(), before, strict=True))


# ---- wrappers


def stacked(**kwargs):
    return functools.partial(pytest.importorskip("supersuit").frame_stack_v2, **kwargs)


def test_frames_are_stacked_per_agent():
    """Each agent's last two observations stand together, the older first."""
    env = make_vec_env(lambda: ToyParallelEnv(time_limit=5), 1, 0, wrappers=[stacked(stack_size=2)])
    assert layout_of(env).obs_sizes == (6, 6, 4)
    env.reset()
    for _ in range(3):
        row = env.step(np.zeros((1, 5), np.float32))[0][0]
    assert row[[1, 4, 13, 15]].tolist() == [2, 3, 2, 3]  # the steps that the first scout and the tank have seen


def test_wrappers_are_put_around_one_after_the_other():
    supersuit = pytest.importorskip("supersuit")
    wrappers = [stacked(stack_size=2), supersuit.pad_observations_v0]
    assert layout_of(make_vec_env(ToyParallelEnv, wrappers=wrappers)).obs_sizes == (6, 6, 6)


def test_our_worlds_take_wrappers_and_keep_their_metrics():
    env = make_vec_env("Grassland-v0", 2, 0, {"n_wolves": 2, "n_sheep": 1, "max_steps": 3}, wrappers=[stacked(stack_size=2)])
    env.reset()
    for _ in range(3):
        *_, infos = env.step(np.zeros((2, 6), np.float32))
    assert {"wolves_win", "return_wolf"} <= set(infos[0]["episode_metrics"])
    assert infos[0]["agent_rewards"][:2].mean() == pytest.approx(infos[0]["episode_metrics"]["return_wolf"], abs=50)


def test_wrappers_around_a_gym_env_are_refused():
    with pytest.raises(ValueError, match="wrappers and reward are for PettingZoo envs"):
        make_vec_env("CartPole-v1", wrappers=[stacked()])


def test_a_wrapper_must_make_a_parallel_env():
    with pytest.raises(ValueError, match="it must make a PettingZoo parallel env"):
        make_vec_env(ToyParallelEnv, wrappers=[lambda env: None])


FORMS = [
    (None, []),
    ("supersuit.flatten_v0", [{"supersuit.flatten_v0": {}}]),
    ({"supersuit.frame_stack_v2": {"stack_size": 3}}, [{"supersuit.frame_stack_v2": {"stack_size": 3}}]),
    ({"a": None, "b": {}}, [{"a": {}}, {"b": {}}]),
    (["a", {"b": {"c": 1}}], [{"a": {}}, {"b": {"c": 1}}]),
]


@pytest.mark.parametrize(("given", "listed"), FORMS)
def test_every_form_of_an_env_wrapper(given, listed):
    assert listed_wrappers(given) == listed
    assert listed_wrappers(listed) == listed


REFUSED = [
    (3, "env_wrapper is 3; it must be a name"),
    ({"supersuit.frame_stack_v2": 3}, "supersuit.frame_stack_v2 has the arguments 3; give a map"),
    ("os.system", 'env_wrapper "os.system" is no wrapper of SuperSuit'),
    ("supersuit.frame_stak_v2", 'unknown env_wrapper "supersuit.frame_stak_v2"; did you mean "supersuit.frame_stack_v2"?'),
    ("supersuit.frame_stack_v0", 'unknown env_wrapper "supersuit.frame_stack_v0"; did you mean "supersuit.frame_stack_v'),
    ("supersuit.pettingzoo_env_to_vec_env_v1", "unknown env_wrapper"),
    ("supersuit.observation_lambda_v0", "unknown env_wrapper"),
    ("supersuit.utils", "unknown env_wrapper"),
    ("supersuit.black_death_v3", "hides deaths and ends from learning; leave it out"),
    (
        {"supersuit.frame_stack_v2": {"size": 3}},
        'unknown argument of env_wrapper supersuit.frame_stack_v2 "size"; did you mean',
    ),
]


@pytest.mark.parametrize(("given", "sentence"), REFUSED, ids=[str(given) for given, _ in REFUSED])
def test_a_wrong_env_wrapper_is_refused(given, sentence):
    pytest.importorskip("supersuit")
    with pytest.raises(ValueError) as caught:
        find_wrappers(listed_wrappers(given))
    assert sentence in str(caught.value)


def test_missing_supersuit_gives_its_command(monkeypatch):
    without(monkeypatch, "supersuit")
    with pytest.raises(gym.error.DependencyNotInstalled, match=r'flatten_v0 needs supersuit, .*: pip install "supersuit"'):
        find_wrappers([{"supersuit.flatten_v0": {}}])
