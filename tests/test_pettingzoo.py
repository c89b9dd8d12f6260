"""Our worlds keep PettingZoo's rules."""

import warnings

import numpy as np
import pettingzoo
import pytest
from matplotlib import pyplot
from pettingzoo.test import api_test, parallel_api_test, seed_test
from pettingzoo.test.seed_test import parallel_seed_test
from pettingzoo.test.state_test import state_test
from pettingzoo.utils.conversions import parallel_to_aec
from stable_baselines3 import PPO

from sb3_kfcv.envs import grassland_v0, hard_spread_v0, register
from sb3_kfcv.envs.parallel_env import Window

SMALL_GRASSLAND = {"n_wolves": 3, "n_sheep": 2, "n_obstacles": 1}
VARIANTS = [
    (hard_spread_v0, {}),
    (hard_spread_v0, {"walls": "none", "continuous_actions": False}),
    (grassland_v0, {}),
    (grassland_v0, {**SMALL_GRASSLAND, "continuous_actions": False, "max_steps": 200}),
]
MODULES = [hard_spread_v0, grassland_v0]


def name(value):
    return value.__name__.rsplit(".", 1)[-1] if hasattr(value, "__name__") else ",".join(value) or "defaults"


@pytest.mark.parametrize(("module", "kwargs"), VARIANTS, ids=name)
def test_parallel_api(module, kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        parallel_api_test(module.parallel_env(**kwargs), num_cycles=300)


@pytest.mark.parametrize(("module", "kwargs"), VARIANTS, ids=name)
def test_aec_api(module, kwargs):
    api_test(module.env(**kwargs), num_cycles=300)


@pytest.mark.parametrize(("module", "kwargs"), VARIANTS, ids=name)
def test_same_seed_same_episode_through_aec(module, kwargs):
    seed_test(lambda: parallel_to_aec(module.parallel_env(**kwargs)), num_cycles=50)


@pytest.mark.parametrize(("module", "kwargs"), VARIANTS, ids=name)
def test_same_seed_same_episode(module, kwargs):
    parallel_seed_test(lambda: module.parallel_env(**kwargs), num_cycles=50)


@pytest.mark.parametrize("module", MODULES, ids=name)
def test_state_lies_in_its_space(module):
    state_test(module.env(), module.parallel_env())


@pytest.mark.parametrize("module", MODULES, ids=name)
def test_reset_without_seed_goes_on_with_the_generator(module):
    one, other = module.parallel_env(), module.parallel_env()
    one.reset(seed=3)
    other.reset(seed=3)
    first = one.state()
    one.reset()
    other.reset()
    assert not np.array_equal(one.state(), first)
    np.testing.assert_array_equal(one.state(), other.state())


@pytest.mark.parametrize("module", MODULES, ids=name)
def test_first_reset_without_seed_draws_entropy(module):
    one, other = module.parallel_env(), module.parallel_env()
    one.reset()
    other.reset()
    assert not np.array_equal(one.state(), other.state())


@pytest.mark.parametrize("module", MODULES, ids=name)
def test_set_state_continues_exactly(module):
    env, copy = module.parallel_env(), module.parallel_env()
    env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step({agent: rng.uniform(-1, 1, 2) for agent in env.agents})
    copy.set_state(env.get_state())
    while env.agents:
        actions = {agent: rng.uniform(-1, 1, 2) for agent in env.agents}
        observations, continued = env.step(actions)[0], copy.step(actions)[0]
        for agent in actions:
            np.testing.assert_array_equal(observations[agent], continued[agent])


def test_an_eaten_sheep_leaves_with_zeros():
    env = grassland_v0.parallel_env(n_wolves=1, n_sheep=2, n_grass=0)
    env.reset(seed=0)
    saved = env.get_state()
    saved["positions"] = np.array([[0.0, 0.0], [0.2, 0.0], [0.8, 0.8]])
    saved["velocities"] = np.array([[0.0, 0.0], [-2.0, 0.0], [0.0, 0.0]])  # runs into the wolf
    env.set_state(saved)
    observations, _, terminations, truncations, _ = env.step({agent: np.zeros(2) for agent in env.agents})
    assert terminations == {"wolf_0": False, "sheep_0": True, "sheep_1": False}
    assert not any(truncations.values())
    assert env.agents == ["wolf_0", "sheep_1"]
    assert not observations["sheep_0"].any()


def test_the_time_limit_truncates_and_does_not_terminate():
    env = hard_spread_v0.parallel_env(max_steps=1)
    env.reset(seed=0)
    _, _, terminations, truncations, _ = env.step({agent: np.zeros(2) for agent in env.agents})
    assert not any(terminations.values())
    assert all(truncations.values())
    assert env.agents == []


def test_a_missing_action_is_named():
    env = hard_spread_v0.parallel_env()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="no action given for agent_1"):
        env.step({agent: np.zeros(2) for agent in env.agents if agent != "agent_1"})


def test_an_action_of_wrong_shape_is_named():
    env = hard_spread_v0.parallel_env(n_agents=2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"agent_1 has shape \(3,\)"):
        env.step({"agent_0": np.zeros(2), "agent_1": np.zeros(3)})


def test_step_before_reset_is_refused():
    with pytest.raises(ValueError, match=r"call reset\(\)"):
        hard_spread_v0.parallel_env().step({})


@pytest.mark.parametrize("module", MODULES, ids=name)
def test_rgb_array_is_a_picture(module):
    env = module.parallel_env(render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.ndim == 3 and picture.shape[2] == 3
    assert picture.std() > 0


def test_human_mode_runs_without_a_display():
    env = hard_spread_v0.parallel_env(render_mode="human")
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    assert env.render() is None
    env.close()


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(ValueError, match="unknown render_mode 'rgb'"):
        grassland_v0.parallel_env(render_mode="rgb")


def test_a_step_of_nobody_after_the_end_does_nothing():
    env = hard_spread_v0.parallel_env(max_steps=1)
    env.reset(seed=0)
    env.step({agent: np.zeros(2) for agent in env.agents})
    state = env.state()
    assert env.step({}) == ({}, {}, {}, {}, {})
    np.testing.assert_array_equal(env.state(), state)


@pytest.mark.parametrize("module", MODULES, ids=name)
def test_stock_ppo_trains_with_one_slot_per_agent(module):
    """SuperSuit's way to SB3, which keeps the dead in their slots and knows no seeds."""
    supersuit = pytest.importorskip("supersuit")
    env = supersuit.black_death_v3(module.parallel_env(max_steps=10))
    n_agents = len(env.possible_agents)
    slots = supersuit.concat_vec_envs_v1(supersuit.pettingzoo_env_to_vec_env_v1(env), 2, base_class="stable_baselines3")
    assert slots.num_envs == 2 * n_agents
    model = PPO("MlpPolicy", slots, n_steps=16, batch_size=64, n_epochs=1, device="cpu")
    assert model.learn(2 * n_agents * 16).num_timesteps == 2 * n_agents * 16


@pytest.mark.skipif(not hasattr(pettingzoo, "register"), reason="this PettingZoo has no registry")
@pytest.mark.parametrize("env_id", ["HardSpread-v0", "Grassland-v0"])
def test_ids_are_registered_once(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register()
        register()
    assert pettingzoo.make("parallel", env_id, max_steps=7).worlds.max_steps == 7


def test_a_window_without_a_display_shows_nothing_until_it_is_closed():
    pyplot.switch_backend("agg")  # also where there is a display
    window = Window("world", fps=1000.0)
    assert not window.is_visible and not window.is_closed
    window.show(np.zeros((4, 4, 3), dtype=np.uint8))
    window.close()
    assert window.is_closed
