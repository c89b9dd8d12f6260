"""What cannot work is refused before any time is spent, in one sentence that names the thing."""

from contextlib import contextmanager

import gymnasium as gym
import numpy as np
import pytest
from pettingzoo import ParallelEnv
from toy_envs import ToyParallelEnv

from sb3_kfcv import KFCVMADDPG, MADDPG, PERMADDPG, JointEnv, ParticleVecEnv, make_vec_env
from sb3_kfcv.envs import grassland_v0
from sb3_kfcv.vec_env.make import make_joint_env, make_worlds


def grassland():
    return grassland_v0.parallel_env(n_wolves=2, n_sheep=1)


@contextmanager
def refused(message, kinds=ValueError):
    """The block must fail with a message that matches, of one line."""
    with pytest.raises(kinds, match=message) as caught:
        yield
    assert "\n" not in str(caught.value).strip()


# ---- settings of the algorithms


@pytest.mark.parametrize("algo", [MADDPG, PERMADDPG, KFCVMADDPG])
def test_a_batch_larger_than_the_buffer(algo):
    with refused(r"batch_size=128.*buffer_size=100"):
        algo("MlpPolicy", JointEnv(ToyParallelEnv()), buffer_size=100)


def test_more_folds_than_transitions():
    with refused(r"n_folds.*300.*400"):
        KFCVMADDPG("MlpPolicy", JointEnv(ToyParallelEnv()), buffer_size=300, replay_buffer_kwargs={"n_folds": 400})


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"critic_input": "stat"}, r'unknown critic_input "stat"; did you mean "state"\?'),
        ({"critic_input": "everything"}, r'unknown critic_input "everything".*observations.*state'),
        ({"policy_delay": 0}, r"policy_delay.*0"),
        ({"batch_size": 12.5}, r"batch_size.*12\.5"),
        ({"buffer_size": "5000"}, r"buffer_size.*'5000'"),
        ({"batch_size": -1}, r"batch_size.*-1"),
    ],
    ids=str,
)
def test_settings_that_are_none(kwargs, message):
    with refused(message):
        MADDPG("MlpPolicy", JointEnv(ToyParallelEnv()), **kwargs)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"gamma": 1.5},
        {"tau": -0.1},
        {"exploration_noise": -0.1},
        {"max_grad_norm": 0.0},
        {"gumbel_temperature": 0.0},
        {"policy_kwargs": {"n_critics": 0}},
    ],
    ids=str,
)
def test_numbers_that_cannot_train_are_refused_by_name(kwargs):
    """Each of them would diverge, give NaN, fail at the first step, or silently never learn."""
    name = "n_critics" if "policy_kwargs" in kwargs else next(iter(kwargs))
    with refused(name):
        MADDPG("MlpPolicy", JointEnv(ToyParallelEnv()), **kwargs)


@pytest.mark.parametrize(
    "call",
    [
        lambda env: MADDPG("MlpPolicy", env, lerning_rate=1e-3),
        lambda env: MADDPG("MlpPolicy", env, policy_kwargs={"lerning_rate": 1e-3}),
        lambda env: KFCVMADDPG("MlpPolicy", env, replay_buffer_kwargs={"lerning_rate": 1e-3}),
    ],
    ids=["of the algorithm", "of the policy", "of the replay buffer"],
)
def test_an_unknown_setting_is_named(call):
    with refused("lerning_rate", (TypeError, ValueError)):
        call(JointEnv(ToyParallelEnv()))


def test_critics_of_a_state_that_the_world_lacks():
    with refused(r"critic_input.*state\(\)"):
        MADDPG("MlpPolicy", JointEnv(ToyParallelEnv(with_state=False)), critic_input="state")


def test_an_unknown_policy():
    with refused("MlpPolcy", (ValueError, KeyError)):
        MADDPG("MlpPolcy", JointEnv(ToyParallelEnv()))


# ---- teams


def test_an_unknown_team():
    with refused(r"unknown group 'wulf'.*wolf"):
        MADDPG("MlpPolicy", grassland(), team="wulf", opponents={"sheep": "flee"})


def test_a_team_without_opponents():
    with refused("sheep"):
        MADDPG("MlpPolicy", grassland(), team="wolf")


def test_opponents_without_a_team():
    with refused("team"):
        MADDPG("MlpPolicy", grassland(), opponents={"sheep": "flee"})


def test_opponents_for_the_wrong_group():
    with refused(r"goat.*sheep"):
        MADDPG("MlpPolicy", grassland(), team="wolf", opponents={"goat": "flee"})


def test_an_unknown_script():
    with refused(r"fle.*flee"):
        MADDPG("MlpPolicy", grassland(), team="wolf", opponents={"sheep": "fle"})


def test_an_opponent_of_another_world():
    """A model for other agents cannot play here: said when the team is made, not deep inside its network."""
    other = MADDPG("MlpPolicy", JointEnv(ToyParallelEnv()))
    with refused("sheep"):
        MADDPG("MlpPolicy", grassland(), team="wolf", opponents={"sheep": other})


# ---- agents


def test_an_unknown_agent():
    model = MADDPG("MlpPolicy", grassland())
    with refused(r'unknown agent "wolf_9".*"wolf_'):
        model.predict_agent("wolf_9", np.zeros(20, np.float32))


def test_an_agent_that_does_not_learn():
    model = MADDPG("MlpPolicy", grassland(), team="wolf", opponents={"sheep": "flee"})
    with refused("sheep_0"):
        model.predict_agent("sheep_0", np.zeros(28, np.float32))


def test_an_agents_observation_of_the_wrong_length():
    model = MADDPG("MlpPolicy", JointEnv(ToyParallelEnv()))
    with refused(r"tank_0.*\b2\b"):
        model.predict_agent("tank_0", np.zeros(3, np.float32))


# ---- worlds


def test_an_unknown_world():
    with refused(r'unknown environment "Graslnd-v0"; did you mean "Grassland-v0"\?'):
        make_vec_env("Graslnd-v0")


def test_an_unknown_world_given_to_an_algorithm():
    with refused("Grassland", (ValueError, gym.error.Error)):
        MADDPG("MlpPolicy", "Graslnd-v0")


def test_an_unknown_setting_of_a_world():
    with refused(r'"n_wolfs"; did you mean "n_wolves"\?'):
        make_vec_env("Grassland-v0", env_kwargs={"n_wolfs": 3})


def test_a_world_of_one_agent_of_gym():
    with refused("no agent layout.*JointEnv"):
        MADDPG("MlpPolicy", "Pendulum-v1")


class Pictures(ToyParallelEnv):
    """Agents that see pictures."""

    def observation_space(self, agent):
        return gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)


def test_a_world_of_pictures():
    with refused("scout_0.*a picture.*features"):
        MADDPG("MlpPolicy", Pictures())


def test_neither_an_env_nor_an_id():
    class NoEnv:
        pass

    assert not isinstance(NoEnv(), ParallelEnv)
    with refused("NoEnv", (ValueError, TypeError)):
        MADDPG("MlpPolicy", NoEnv())


# ---- actions

BAD = pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])


@BAD
def test_an_action_that_is_no_number_is_refused_by_the_joint_env(bad):
    env = make_joint_env("Grassland-v0", n_wolves=2, n_sheep=1)
    env.reset(seed=0)
    actions = np.zeros(6, np.float32)
    actions[3] = bad
    with refused(r"wolf_1.*finite"):
        env.step(actions)


@BAD
def test_an_action_that_is_no_number_is_refused_by_the_batch(bad):
    env = ParticleVecEnv(make_worlds("Grassland-v0", 3, {"n_wolves": 2, "n_sheep": 1}))
    env.reset()
    actions = np.zeros((3, 6), np.float32)
    actions[2, 5] = bad
    with refused(r"sheep_0 in world 2.*finite"):
        env.step(actions)


@pytest.mark.parametrize("choice", [5, -1])
def test_a_choice_that_does_not_exist(choice):
    env = make_joint_env("Grassland-v0", n_wolves=2, n_sheep=1, continuous_actions=False)
    env.reset(seed=0)
    with refused(r"wolf_1.*0 to 4"):
        env.step(np.array([0, choice, 0]))


@pytest.mark.parametrize("length", [4, 8])
def test_a_joint_action_of_the_wrong_length(length):
    env = make_joint_env("Grassland-v0", n_wolves=2, n_sheep=1)
    env.reset(seed=0)
    with refused("shape"):
        env.step(np.zeros(length, np.float32))


def test_a_batch_of_actions_of_the_wrong_shape():
    env = ParticleVecEnv(make_worlds("Grassland-v0", 3, {"n_wolves": 2, "n_sheep": 1}))
    env.reset()
    with refused(r"\(2, 6\).*3 worlds"):
        env.step(np.zeros((2, 6), np.float32))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"replay_buffer_kwargs": {"n_fold": 3}}, 'unknown setting in replay_buffer_kwargs "n_fold"; did you mean "n_folds"?'),
        (
            {"policy_kwargs": {"optimizer_kwargs": {"epss": 1}}},
            'unknown setting in optimizer_kwargs "epss"; did you mean "eps"?',
        ),
        ({"policy_kwargs": {"net_ach": [8]}}, 'unknown setting in policy_kwargs "net_ach"; did you mean "net_arch"?'),
        ({"gamma": "0.9"}, "gamma must be a number, got '0.9'"),
        ({"learning_starts": "a"}, "learning_starts must be a whole number"),
        ({"train_freq": 0}, "train_freq must be a whole number of at least 1"),
    ],
)
def test_settings_are_refused_by_name(settings, message):
    with pytest.raises(ValueError) as error:
        KFCVMADDPG("MlpPolicy", "HardSpread-v0", **settings)
    assert message in str(error.value)


def test_a_model_of_another_algorithm_is_refused(tmp_path):
    PERMADDPG("MlpPolicy", "HardSpread-v0").save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"was saved by PERMADDPG; load it with PERMADDPG\.load"):
        MADDPG.load(tmp_path / "model")
