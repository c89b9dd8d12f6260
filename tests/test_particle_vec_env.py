"""The batched vec env keeps SB3's rules, and gives what single joint envs give."""

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_kfcv.envs import GrasslandWorlds, HardSpreadWorlds, grassland_v0, hard_spread_v0
from sb3_kfcv.vec_env.joint_env import JointEnv
from sb3_kfcv.vec_env.particle_vec_env import ParticleVecEnv

N_ENVS = 3
SMALL_GRASSLAND = {"n_wolves": 4, "n_sheep": 2, "max_steps": 15}
VARIANTS = {
    "hard_spread": (HardSpreadWorlds, hard_spread_v0, {"max_steps": 9}),
    "hard_spread_discrete": (HardSpreadWorlds, hard_spread_v0, {"max_steps": 9, "continuous_actions": False}),
    "grassland": (GrasslandWorlds, grassland_v0, SMALL_GRASSLAND),
}
every_variant = pytest.mark.parametrize(("worlds", "module", "kwargs"), VARIANTS.values(), ids=VARIANTS)


def hard_spread(reward="default", render_mode=None, **kwargs):
    return ParticleVecEnv(HardSpreadWorlds(N_ENVS, **{"max_steps": 5, **kwargs}), reward, render_mode)


def sampled(venv):
    return np.stack([venv.action_space.sample() for _ in range(venv.num_envs)])


@every_variant
def test_equals_single_joint_envs_seeded_alike(worlds, module, kwargs):
    batch = ParticleVecEnv(worlds(N_ENVS, **kwargs))
    singles = DummyVecEnv([lambda: JointEnv(module.parallel_env(**kwargs))] * N_ENVS)
    for venv in (batch, singles):
        venv.seed(7)
    np.testing.assert_array_equal(batch.reset(), singles.reset())
    batch.action_space.seed(0)
    for _ in range(40):
        actions = sampled(batch)
        observations, rewards, dones, infos = batch.step(actions)
        expected_observations, expected_rewards, expected_dones, expected_infos = singles.step(actions)
        np.testing.assert_array_equal(observations, expected_observations)
        np.testing.assert_allclose(rewards, expected_rewards, rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(dones, expected_dones)
        for info, expected in zip(infos, expected_infos, strict=True):
            expected.setdefault("TimeLimit.truncated", False)
            info.setdefault("TimeLimit.truncated", False)
            assert info.keys() == expected.keys()
            for key in info.keys() - {"episode_metrics"}:
                np.testing.assert_allclose(info[key], expected[key], rtol=1e-5, atol=1e-5, err_msg=key)


@every_variant
def test_spaces_are_joint(worlds, module, kwargs):
    venv = ParticleVecEnv(worlds(N_ENVS, **kwargs))
    assert venv.observation_space.shape == (sum(venv.layout.obs_sizes),)
    if kwargs.get("continuous_actions", True):
        assert venv.action_space == spaces.Box(-1, 1, (2 * venv.layout.n_agents,), np.float32)
    else:
        assert venv.action_space == spaces.MultiDiscrete([5] * venv.layout.n_agents)


@every_variant
def test_returned_arrays_are_never_overwritten(worlds, module, kwargs):
    venv = ParticleVecEnv(worlds(N_ENVS, **kwargs))
    first = venv.reset()
    observations, rewards, dones, infos = venv.step(sampled(venv))
    held = [first, observations, rewards, dones, *(value for info in infos for value in info.values())]
    kept = [np.copy(value) for value in held]
    for _ in range(20):
        venv.step(sampled(venv))
    venv.reset()
    for value, copy in zip(held, kept, strict=True):
        np.testing.assert_array_equal(value, copy)


def test_the_end_of_an_episode_carries_the_last_observation_and_the_metrics():
    venv = hard_spread()
    venv.reset()
    for _ in range(4):
        assert not venv.step(sampled(venv))[2].any()
    observations, _, dones, infos = venv.step(sampled(venv))
    assert dones.all()
    for i, info in enumerate(infos):
        assert info["TimeLimit.truncated"] is True
        assert not np.array_equal(info["terminal_observation"], observations[i])
        assert all(type(info[name]) is float for name in venv.metric_names)
        assert info["return_agent"] == pytest.approx(info["distance_term"] + info["collision_term"] + info["cover_term"])


def test_next_state_is_of_before_the_reset():
    venv = hard_spread(max_steps=1)
    venv.reset()
    _, _, _, infos = venv.step(sampled(venv))
    _, _, _, following = venv.step(sampled(venv))
    assert not np.array_equal(infos[0]["next_state"], following[0]["state"])


def test_state_is_the_next_state_of_the_step_before():
    venv = hard_spread()
    venv.reset()
    _, _, _, infos = venv.step(sampled(venv))
    _, _, _, following = venv.step(sampled(venv))
    np.testing.assert_array_equal(infos[1]["next_state"], following[1]["state"])


def test_the_scalar_is_the_mean_over_the_wolves_by_default():
    venv = ParticleVecEnv(GrasslandWorlds(N_ENVS, **SMALL_GRASSLAND))
    venv.reset()
    _, rewards, _, infos = venv.step(sampled(venv))
    np.testing.assert_allclose(rewards, [info["agent_rewards"][:4].mean() for info in infos], rtol=1e-5)


def test_the_scalar_can_be_chosen():
    venv = hard_spread(reward="sum")
    venv.reset()
    _, rewards, _, infos = venv.step(sampled(venv))
    np.testing.assert_allclose(rewards, [info["agent_rewards"].sum() for info in infos], rtol=1e-5)


def test_an_unknown_scalar_is_refused():
    with pytest.raises(ValueError, match='unknown group or scalar reward "wolves"; did you mean "wolf"'):
        ParticleVecEnv(GrasslandWorlds(1), reward="wolves")


def test_seeds_apply_at_the_next_reset():
    venv = hard_spread()
    venv.seed(3)
    first = venv.reset()
    assert not np.array_equal(venv.reset(), first)
    venv.seed(3)
    np.testing.assert_array_equal(venv.reset(), first)


def test_states_of_worlds_can_be_read_and_put_back():
    venv, other = hard_spread(), hard_spread()
    venv.reset()
    other.reset()
    for i, saved in enumerate(venv.env_method("get_state")):
        other.env_method("set_state", saved, indices=i)
    for _ in range(12):
        actions = sampled(venv)
        np.testing.assert_array_equal(venv.step(actions)[0], other.step(actions)[0])


def test_attributes_of_the_worlds_are_found():
    venv = hard_spread()
    assert venv.get_attr("max_steps") == [5] * N_ENVS
    assert venv.get_attr("layout", [0])[0] is venv.layout
    assert not venv.has_attr("no_such_thing")


def test_attributes_are_set_for_all_worlds():
    venv = hard_spread()
    venv.set_attr("max_steps", 9)
    assert venv.worlds.max_steps == 9


def test_attributes_cannot_be_set_for_some_worlds():
    with pytest.raises(ValueError, match="the worlds of a batch share 'max_steps'"):
        hard_spread().set_attr("max_steps", 9, indices=[0])


def test_joint_actions_of_a_wrong_shape_are_refused():
    venv = hard_spread()
    venv.reset()
    with pytest.raises(ValueError, match=r"shape \(3, 4, 2\); 3 worlds take joint rows of shape \(3, 8\)"):
        venv.step(np.zeros((3, 4, 2)))


def test_rgb_array_tiles_the_worlds():
    venv = hard_spread(render_mode="rgb_array")
    venv.reset()
    picture = venv.render()
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3


def test_works_under_monitor_normalisation_and_evaluation():
    class Still:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return np.zeros((len(observation), 8), dtype=np.float32), state

    venv = hard_spread()
    wrapped = VecNormalize(VecMonitor(venv, info_keywords=venv.metric_names), norm_reward=False)
    returns, lengths = evaluate_policy(Still(), wrapped, n_eval_episodes=6, return_episode_rewards=True)
    assert lengths == [5] * 6
    assert np.isfinite(returns).all()


def test_worlds_that_are_drawn_tell_how_they_ended():
    """Not how they begin again, which is what there is to draw after the step."""
    venv = hard_spread(render_mode="rgb_array")
    venv.reset()
    for _ in range(5):
        _, _, dones, infos = venv.step(np.ones((3, 8), dtype=np.float32))
    assert dones.all()
    assert [info["terminal_scene"].caption.split()[1] for info in infos] == ["5/5"] * 3
    assert venv.env_method("scene", indices=[0])[0].caption.split()[1] == "0/5"
