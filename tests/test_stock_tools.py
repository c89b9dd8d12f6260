"""Tools of Stable-Baselines3, as its users know them, around one learner of all agents and around teams that learn at once."""

import csv
import json

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecMonitor, VecVideoRecorder
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_kfcv import KFCVMADDPG, MADDPG, CoTraining, make_vec_env

SMALL = {"n_wolves": 2, "n_sheep": 2, "n_grass": 1, "max_steps": 10}
QUICK = {"learning_starts": 20, "batch_size": 8, "buffer_size": 100, "policy_kwargs": {"net_arch": [8]}}
CURRICULUM = {"teacher_net_arch": [4], "first_teacher_steps": 2, "teacher_steps": 1, "refresh_every": 10}


def grassland(seed=0, n_envs=2, **kwargs):
    return make_vec_env("Grassland-v0", n_envs, seed=seed, env_kwargs=SMALL, **kwargs)


def one_learner(env):
    return MADDPG("MlpPolicy", env, seed=0, device="cpu", **QUICK)


def two_teams(env):
    teams = {
        "wolf": {"algo": "kfcv_maddpg", "replay_buffer_kwargs": CURRICULUM, **QUICK},
        "sheep": {"algo": "maddpg", **QUICK},
    }
    return CoTraining("MlpPolicy", env, teams, seed=0, device="cpu")


BOTH = pytest.mark.parametrize("make", [one_learner, two_teams])


@BOTH
def test_evaluate_policy_gives_the_wolves_mean_return(make):
    """The scalar of the world is the mean over its wolves, as is the metric."""
    env = grassland(seed=1)
    metrics = []

    def note(local, _):
        if local["done"]:
            metrics.append(local["info"]["return_wolf"])

    returns, lengths = evaluate_policy(make(env), env, 5, callback=note, return_episode_rewards=True)
    assert len(lengths) == 5
    assert max(lengths) <= SMALL["max_steps"]
    np.testing.assert_allclose(returns, metrics, rtol=1e-5)


@BOTH
@pytest.mark.parametrize(("threshold", "steps"), [(-1e9, 20), (1e9, 60)], ids=["reached", "never reached"])
def test_training_stops_at_a_reward_threshold(make, threshold, steps):
    stop = StopTrainingOnRewardThreshold(threshold, verbose=0)
    evaluation = EvalCallback(grassland(seed=1), callback_on_new_best=stop, n_eval_episodes=2, eval_freq=10, verbose=0)
    assert make(grassland()).learn(60, evaluation).num_timesteps == steps


@BOTH
def test_training_goes_on_from_a_checkpoint_and_its_replay_buffer(make, tmp_path):
    model = make(grassland()).learn(40, CheckpointCallback(10, str(tmp_path), save_replay_buffer=True))
    loaded = type(model).load(tmp_path / "rl_model_20_steps", env=grassland())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_20_steps.pkl.zip")
    assert loaded.replay_buffer.size() == 9  # steps of two worlds; SB3 stores the tenth after its callbacks
    assert loaded.learn(20, reset_num_timesteps=False).num_timesteps == 40
    assert loaded.replay_buffer.size() == 19


def test_teams_refuse_frames_stacked_over_whole_worlds():
    with pytest.raises(ValueError, match=r"VecFrameStack.*wrappers=\[supersuit.frame_stack_v2\]"):
        two_teams(VecFrameStack(grassland(), n_stack=2))


def test_teams_learn_in_worlds_of_other_processes():
    env = grassland(vec_env_cls=SubprocVecEnv)
    try:
        assert two_teams(env).learn(40).num_timesteps == 40
    finally:
        env.close()


@pytest.mark.parametrize("world", ["Grassland-v0", "HardSpread-v0"])
def test_a_video_is_recorded_while_a_model_plays(world, tmp_path):
    pytest.importorskip("moviepy")
    env = make_vec_env(world, 2, seed=0, env_kwargs={"render_mode": "rgb_array"})
    model = one_learner(env)
    recorder = VecVideoRecorder(env, str(tmp_path), lambda step: step == 0, video_length=3)
    observations = recorder.reset()
    for _ in range(4):
        observations, *_ = recorder.step(model.predict(observations, deterministic=True)[0])
    recorder.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


FORMATS = ["stdout", "log", "csv", "json", "tensorboard"]


@pytest.fixture(scope="module", params=["one learner", "two teams"])
def logged(request, tmp_path_factory):
    """``(folder, what is behind the first part of a learner's series)`` of a run that logs in every format."""
    folder = tmp_path_factory.mktemp("logs")
    env = VecMonitor(grassland())
    if request.param == "two teams":
        model, team = two_teams(env), "_wolf"
    else:
        model, team = KFCVMADDPG("MlpPolicy", env, seed=0, replay_buffer_kwargs=CURRICULUM, device="cpu", **QUICK), ""
    model.set_logger(configure(str(folder), FORMATS))
    model.learn(120, log_interval=2)
    model.logger.close()
    return folder, team


def some_series(team):
    """SB3's own, of the world, of the learning and of the replay."""
    return {"rollout/ep_rew_mean", "rollout/return_wolf", f"train{team}/critic_loss", f"curriculum{team}/stage"}


@pytest.mark.parametrize("format_", ["csv", "json"])
def test_files_of_numbers_hold_the_series(logged, format_):
    folder, team = logged
    if format_ == "csv":
        with open(folder / "progress.csv") as file:
            rows = list(csv.DictReader(file))
    else:
        rows = [json.loads(line) for line in (folder / "progress.json").read_text().splitlines()]
    assert len(rows) >= 3
    assert some_series(team) <= set(rows[-1])
    assert all(np.isfinite(float(rows[-1][column])) for column in some_series(team))


def test_tensorboard_holds_the_series_and_the_scores_as_a_histogram(logged):
    folder, team = logged
    events = EventAccumulator(str(folder)).Reload()
    assert some_series(team) <= set(events.Tags()["scalars"])
    assert f"curriculum{team}/scores" in events.Tags()["histograms"]


def test_tables_for_people_name_the_series(logged):
    text = (logged[0] / "log.txt").read_text()
    for name in ("return_wolf", "critic_loss", "ep_rew_mean"):
        assert name in text


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasium_makes_a_vec_env_of_grassland(mode):
    envs = gym.make_vec("Grassland-v0", num_envs=2, vectorization_mode=mode, **SMALL)
    try:
        observations, _ = envs.reset(seed=0)
        assert observations.shape == (2, *envs.single_observation_space.shape)
        assert envs.step(envs.action_space.sample())[4]["agent_rewards"].shape == (2, 4)
    finally:
        envs.close()
