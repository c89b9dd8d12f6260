"""The three algorithms run on every kind of world, as SB3's do."""

import copy
import inspect

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from mpe2 import simple_tag_v3
from references import fill, parameters_of
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from torch import nn
from toy_envs import ToyParallelEnv

from sb3_kfcv import ALGOS, KFCVMADDPG, MADDPG, PERMADDPG, JointEnv, ParticleVecEnv, make_vec_env, register
from sb3_kfcv.envs import grassland_v0, hard_spread_v0
from sb3_kfcv.maddpg.policies import MADDPGPolicy
from sb3_kfcv.vec_env.make import make_joint_env, make_worlds

SPREAD = {"n_agents": 2, "max_steps": 10}
GRASSLAND = {"n_wolves": 2, "n_sheep": 2, "n_grass": 1, "max_steps": 10}
CURRICULUM = {"teacher_batch_size": 8, "first_teacher_steps": 3, "teacher_steps": 2, "refresh_every": 20}
EVERY_ALGO = pytest.mark.parametrize("algo", [MADDPG, PERMADDPG, KFCVMADDPG])


def make(algo, env, **kwargs):
    """A small model that learns from step 30 on."""
    settings = {"learning_starts": 30, "batch_size": 8, "buffer_size": 200, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    if algo is KFCVMADDPG:
        settings["replay_buffer_kwargs"] = CURRICULUM
    return algo("MlpPolicy", env, device="cpu", **{**settings, **kwargs})


def toy(**kwargs):
    return ToyParallelEnv(time_limit=8, **kwargs)


def spread():
    return make_joint_env("HardSpread-v0", **SPREAD)


WORLDS = {
    "gym id": lambda: "HardSpread-v0",
    "gym env": lambda: gym.make("Grassland-v0", **GRASSLAND),
    "ParallelEnv": lambda: hard_spread_v0.parallel_env(**SPREAD),
    "AECEnv": lambda: hard_spread_v0.env(**SPREAD),
    "dying agents, unequal sizes": lambda: toy(deaths={"scout_0": 3}),
    "ParticleVecEnv": lambda: ParticleVecEnv(make_worlds("Grassland-v0", 3, GRASSLAND)),
    "make_vec_env": lambda: make_vec_env("HardSpread-v0", 2, env_kwargs=SPREAD),
    "DummyVecEnv": lambda: DummyVecEnv([spread] * 2),
    "discrete": lambda: grassland_v0.parallel_env(continuous_actions=False, **GRASSLAND),
    "discrete, unequal sizes": lambda: toy(discrete=True, deaths={"scout_0": 3}),
    "mpe2 simple_tag": lambda: simple_tag_v3.parallel_env(max_cycles=10, continuous_actions=True),
    "mpe2 simple_tag, discrete": lambda: simple_tag_v3.parallel_env(max_cycles=10, continuous_actions=False),
}


@EVERY_ALGO
@pytest.mark.parametrize("world", WORLDS)
def test_learns_on_every_kind_of_world(algo, world):
    model = make(algo, WORLDS[world]())
    before = parameters_of(model)
    model.learn(90)
    assert model.num_timesteps >= 90
    after = parameters_of(model)
    assert all(value.isfinite().all() for value in after.values())
    unmoved = [name for name, value in before.items() if th.equal(value, after[name])]
    assert not unmoved


@pytest.fixture(scope="module")
def away():
    vec_env = SubprocVecEnv([spread] * 2, start_method="spawn")
    yield vec_env
    vec_env.close()


@EVERY_ALGO
def test_learns_on_worlds_in_other_processes(algo, away):
    assert make(algo, away).learn(60)._n_updates > 0


@EVERY_ALGO
@pytest.mark.parametrize("world", ["HardSpread-v0", "Grassland-v0"])
def test_the_main_job_needs_no_settings(algo, world):
    """As the README writes it, but for the length."""
    model = algo("MlpPolicy", world, learning_starts=130, seed=0).learn(140)
    assert model._n_updates == 10


def test_learn_has_a_default_length():
    assert isinstance(inspect.signature(MADDPG.learn).parameters["total_timesteps"].default, int)


TABLE_1 = {
    "gamma": 0.99,
    "buffer_size": 5000,
    "exploration_noise": 0.1,
    "batch_size": 128,
    "learning_rate": 0.001,
    "tau": 0.01,
}


@EVERY_ALGO
def test_defaults_are_table_1(algo):
    parameters = inspect.signature(algo.__init__).parameters
    assert {name: parameters[name].default for name in TABLE_1} == TABLE_1
    model = algo("MlpPolicy", toy())
    assert [layer.out_features for layer in model.actor.network(0)[:-1:2]] == [64, 64]
    if algo is KFCVMADDPG:
        assert model.replay_buffer.lambda_init == 0.1
        assert model.replay_buffer.n_folds == 5


def test_a_variant_changes_the_replay_buffer_alone():
    for algo in (PERMADDPG, KFCVMADDPG):
        own = {name for name in vars(algo) if not name.startswith("__")} - {"_abc_impl"}
        assert own == {"default_buffer_class"}


def test_algorithms_are_listed_by_name():
    assert ALGOS == {"maddpg": MADDPG, "per_maddpg": PERMADDPG, "kfcv_maddpg": KFCVMADDPG}


OPTIONS = {
    "state": {"critic_input": "state"},
    "shared": {"share_parameters": True},
    "shared, state": {"critic_input": "state", "share_parameters": True},
    "stabilised": {
        "policy_delay": 2,
        "target_policy_noise": 0.2,
        "max_grad_norm": 0.5,
        "reward_scale": 0.1,
        "actor_regularization": 1e-3,
        "policy_kwargs": {"net_arch": {"pi": [8], "qf": [8, 8]}, "n_critics": 2},
    },
    "several updates": {"train_freq": 5, "gradient_steps": 3},
    "one update per step": {"train_freq": 4, "gradient_steps": -1},
    "by episode": {"train_freq": (1, "episode")},
    "own noise": {"action_noise": NormalActionNoise(np.zeros(5), np.full(5, 0.3))},
    "no noise": {"exploration_noise": 0.0},
    "other activation": {"policy_kwargs": {"net_arch": [8], "activation_fn": th.nn.Tanh}},
    "other optimiser": {"policy_kwargs": {"net_arch": [8], "optimizer_class": th.optim.SGD}},
    "policy class": {"policy": MADDPGPolicy},
}


@pytest.mark.parametrize("option", OPTIONS)
def test_learns_with_every_option(option):
    settings = dict(OPTIONS[option])
    policy = settings.pop("policy", "MlpPolicy")
    base = {"learning_starts": 30, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    model = MADDPG(policy, toy(deaths={"tank_0": 3}), **{**base, **settings}).learn(80)
    assert model._n_updates > 0
    assert all(value.isfinite().all() for value in model.policy.state_dict().values())


def test_gradient_steps_of_minus_one_follow_the_env_steps():
    """train_freq 4 with 2 worlds: 8 updates per training; trainings after steps 40, 48, … 80: six of them."""
    env = DummyVecEnv([lambda: JointEnv(toy())] * 2)
    assert make(MADDPG, env, train_freq=4, gradient_steps=-1, learning_starts=32).learn(80)._n_updates == 6 * 8


# ---- predict


@pytest.mark.parametrize("discrete", [False, True])
def test_predict_gives_joint_rows(discrete):
    model = make(MADDPG, toy(discrete=discrete))
    width = 3 if discrete else 5
    row = np.zeros(8, np.float32)
    assert model.predict(row)[0].shape == (width,)
    assert model.predict(np.stack([row] * 4))[0].shape == (4, width)
    assert model.action_space.contains(model.predict(row, deterministic=True)[0])


@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize("discrete", [False, True])
def test_an_agent_acts_alone_as_in_the_joint_row(discrete, share):
    """The tank's actions reach from −2 to 2."""
    model = make(MADDPG, toy(discrete=discrete), share_parameters=share).learn(60)
    rows = np.random.default_rng(0).normal(size=(6, 8)).astype(np.float32)
    joint, _ = model.predict(rows, deterministic=True)
    for i, agent in enumerate(model.layout.agents):
        columns = i if discrete else model.layout.action_slices[i]
        own = rows[:, model.layout.obs_slices[i]]
        np.testing.assert_allclose(model.predict_agent(agent, own), joint[:, columns], atol=1e-5)
        np.testing.assert_allclose(model.predict_agent(agent, own[0]), joint[0, columns], atol=1e-5)


def test_discrete_exploration_draws_from_the_softmax():
    """Logits log 1, log 2, log 4, log 1: shares 1/8, 2/8, 4/8, 1/8."""
    model = make(MADDPG, toy(discrete=True))
    with th.no_grad():
        for parameter in model.actor.parameters():
            parameter.zero_()
        model.actor.stacks[0].rest[-1].bias.copy_(th.tensor([1.0, 2.0, 4.0, 1.0]).log())
    actions, _ = model.predict(np.zeros((8000, 8), np.float32), deterministic=False)
    np.testing.assert_allclose(np.bincount(actions[:, 0]) / 8000, [1 / 8, 2 / 8, 4 / 8, 1 / 8], atol=0.025)
    assert (model.predict(np.zeros((50, 8), np.float32), deterministic=True)[0][:, 0] == 2).all()


# ---- one team

WOLVES = {"team": "wolf", "opponents": {"sheep": "flee"}}


def grassland(**kwargs):
    return grassland_v0.parallel_env(**{**GRASSLAND, **kwargs})


@EVERY_ALGO
def test_a_team_learns_against_a_script(algo):
    model = make(algo, grassland(), **WOLVES).learn(80)
    assert model.actor(th.zeros(1, model.observation_space.shape[0]))[0].shape[0] == 2  # the two wolves alone


@pytest.mark.parametrize("continuous", [True, False])
def test_a_team_learns_against_a_model(continuous):
    sheep = make(MADDPG, grassland(continuous_actions=continuous), seed=5)
    wolves = make(MADDPG, grassland(continuous_actions=continuous), team="wolf", opponents={"sheep": sheep})
    wolves.learn(80)
    rows = np.random.default_rng(0).normal(size=(4, wolves.observation_space.shape[0])).astype(np.float32)
    half = 4 if continuous else 2  # the wolves' part of the joint action
    np.testing.assert_array_equal(
        wolves.predict(rows, deterministic=True)[0][:, half:], sheep.predict(rows, deterministic=True)[0][:, half:]
    )


class Still:
    """Anything with ``predict`` on joint rows can play: this one never moves, in a world of 8 action columns."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros((len(observation), 8), np.float32), None


def test_opponents_act_by_their_own_policy_from_the_first_step():
    """Neither the random warm-up nor the noise is for them: still sheep stay still."""
    model = make(MADDPG, grassland(), team="wolf", opponents={"sheep": Still()}, learning_starts=40).learn(80)
    wolves, sheep = np.split(model.replay_buffer.actions[:80, 0], 2, axis=1)
    assert np.abs(wolves).max() > 0.5
    assert not sheep.any()


def test_the_critics_of_a_team_expect_the_opponents_to_play_their_policy():
    model = make(MADDPG, grassland(), team="wolf", opponents={"sheep": Still()}).learn(40)
    seen, evaluate = [], model.critic_target.evaluate
    model.critic_target.evaluate = lambda inputs: seen.append(inputs[:, -8:]) or evaluate(inputs)
    model.td_target(model.replay_buffer.sample(16))
    assert not seen[0][:, 4:].any()


# ---- learning, again and again


@EVERY_ALGO
def test_same_seed_same_run(algo):
    models = [make(algo, hard_spread_v0.parallel_env(**SPREAD), seed=3).learn(100) for _ in range(2)]
    one, other = (parameters_of(model) for model in models)
    for name, value in one.items():
        assert th.equal(value, other[name]), name


def test_another_seed_another_run():
    one, other = (parameters_of(make(MADDPG, toy(), seed=seed)) for seed in (1, 2))
    assert not th.equal(one["actor.stacks.0.first.weight"], other["actor.stacks.0.first.weight"])


@pytest.mark.parametrize("discrete", [False, True])
def test_learning_in_two_parts_equals_learning_at_once(discrete):
    """Uniform replay and a constant learning rate: nothing depends on the progress."""
    parts = make(MADDPG, toy(discrete=discrete)).learn(50).learn(40, reset_num_timesteps=False)
    whole = make(MADDPG, toy(discrete=discrete)).learn(90)
    assert parts.num_timesteps == whole.num_timesteps == 90
    for name, value in parameters_of(whole).items():
        assert th.equal(value, parameters_of(parts)[name]), name


def test_the_curriculum_follows_the_progress_of_training():
    """Half of 200 steps in 5 stages: 20 steps each; then the whole buffer."""
    stages = {}

    class Watch(BaseCallback):
        def _on_step(self):
            stages[self.num_timesteps] = self.model.replay_buffer.stage
            return True

    make(KFCVMADDPG, toy(), learning_starts=10).learn(200, callback=Watch())
    # A callback sees the stage of the latest update, made after the step before.
    assert [stages[step] for step in (15, 35, 55, 75, 95, 115, 200)] == [1, 2, 3, 4, 5, 6, 6]


def test_beta_of_prioritised_replay_follows_the_progress():
    model = make(PERMADDPG, toy()).learn(80)
    assert model.replay_buffer.beta == pytest.approx(1.0, abs=0.01)


def test_a_callback_can_stop_learning():
    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < 42

    assert make(MADDPG, toy()).learn(80, callback=Stop()).num_timesteps == 42


class Recorder(KVWriter):
    """A log format that keeps everything."""

    def __init__(self):
        self.written = {}

    def write(self, key_values, key_excluded, step=0):
        self.written.update(key_values)

    def close(self):
        pass


def logged(model, steps=120):
    recorder = Recorder()
    model.set_logger(Logger(None, [recorder]))
    model.learn(steps, log_interval=1)
    return recorder.written


def test_the_log_holds_what_the_learner_shows():
    """Losses and Q of each group, gradient norms, saturation, returns of each group, every metric of the world, seconds."""
    written = logged(make(MADDPG, grassland()))
    expected = {"train/critic_loss", "train/actor_loss", "train/critic_grad_norm", "train/actor_grad_norm"}
    expected |= {"train/critic_loss_wolf", "train/q_target_sheep", "train/action_saturation", "time/update_seconds"}
    expected |= {"rollout/ep_rew_mean", "rollout/return_wolf", "rollout/return_sheep"}
    expected |= {f"rollout/{name}" for name in grassland().metric_names}
    assert expected <= set(written)
    assert all(np.isfinite(written[name]) for name in expected)


def test_the_logged_returns_are_those_of_the_episodes():
    """Rewards (i + 1) · t over 8 steps: 36, 72 and 108; scouts 54 on average, tank 108, all 72."""
    written = logged(make(MADDPG, toy()), steps=40)
    assert written["rollout/return_scout"] == 54
    assert written["rollout/return_tank"] == 108
    assert written["rollout/ep_rew_mean"] == 72


def test_the_log_of_the_curriculum():
    written = logged(make(KFCVMADDPG, toy(), learning_starts=10), steps=60)
    for name in ("stage", "lambda", "share_bucket_1", "teacher_loss_held_out", "rank_correlation_with_student", "scores"):
        assert f"curriculum/{name}" in written


def test_the_log_of_prioritised_replay():
    assert "per/beta" in logged(make(PERMADDPG, toy()), steps=60)


@EVERY_ALGO
def test_tensorboard_and_text_logs_are_written(algo, tmp_path, capsys):
    make(algo, toy(), tensorboard_log=str(tmp_path), verbose=1).learn(60, log_interval=1)
    assert list(tmp_path.glob(f"{algo.__name__}_1/events*"))
    assert "return_scout" in capsys.readouterr().out


def test_a_monitored_env_is_not_monitored_twice():
    model = make(MADDPG, Monitor(JointEnv(toy()))).learn(40)
    assert model.ep_info_buffer[-1]["r"] == 72


# ---- what an update uses again is the learner's alone


def test_predictions_leave_the_learners_tensors_alone():
    """So that a model may be asked by several threads, and while it learns."""
    model = make(MADDPG, grassland()).learn(40)
    kept = [stack._evaluations[model.batch_size].layers[-1] for stack in model.actor.stacks]
    before = [values.clone() for values in kept]
    model.predict(np.zeros((model.batch_size, model.observation_space.shape[0]), np.float32))
    for values, as_before in zip(kept, before, strict=True):
        assert th.equal(values, as_before)


def test_a_policy_that_has_learnt_can_be_copied():
    model = make(MADDPG, grassland(), policy_kwargs={"activation_fn": nn.Tanh}).learn(40)
    row = np.ones(model.observation_space.shape, np.float32)
    expected = model.predict(row, deterministic=True)[0]
    np.testing.assert_array_equal(copy.deepcopy(model.policy).predict(row, deterministic=True)[0], expected)


class Drop(nn.Module):
    def __init__(self):
        super().__init__()
        self.drop = nn.Dropout(0.5)

    def forward(self, x):
        return self.drop(x.relu())


register("Drop in test_algorithms", Drop)


def test_targets_and_single_agents_act_without_dropout():
    model = make(MADDPG, grassland(), policy_kwargs={"activation_fn": Drop})
    model.set_logger(Logger(None, []))
    fill(model.replay_buffer, model.layout, 64)
    model.train(1, 16)
    assert not any(module.training for module in model.actor_target.modules())
    own = np.ones(model.layout.obs_sizes[0], np.float32)
    agent = model.layout.agents[0]
    np.testing.assert_array_equal(model.predict_agent(agent, own), model.predict_agent(agent, own))


@pytest.mark.parametrize("activation_fn", ["tanh", nn.Tanh()])
def test_an_activation_that_is_no_class_is_refused(activation_fn):
    with pytest.raises(ValueError, match=r"activation_fn must be a class, such as torch\.nn\.Tanh"):
        make(MADDPG, grassland(), policy_kwargs={"activation_fn": activation_fn})


def test_a_retired_setting_says_that_nothing_depends_on_it():
    with pytest.raises(ValueError, match="sort_above is no setting any more: ranks are exact"):
        make(PERMADDPG, grassland(), replay_buffer_kwargs={"sort_above": 10})
