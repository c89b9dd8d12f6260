"""
A training that was killed and resumed equals the one that was never stopped: every array, every counter, every log entry.
And whatever stands in the way of that is said in one sentence.
"""

import csv
import gc
import json
import multiprocessing
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from contextlib import contextmanager
from pathlib import Path

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch as th
import yaml
from mpe2 import simple_spread_v3
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_zoo import ROOT, SignalAt, command, run_folder
from toy_envs import ToyParallelEnv

from sb3_kfcv import ALGOS, KFCVMADDPG, MADDPG, PERMADDPG, CoTraining, make_vec_env
from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.callbacks import MultiAgentEvalCallback, SavePlayers, StopOnSignal
from sb3_kfcv.envs import grassland_v0
from sb3_kfcv.saving import checkpoints
from sb3_kfcv.saving.checkpoints import Checkpoint, Checkpoints, checkpoints_in
from sb3_kfcv.teams.players import Mixture, RandomPlayer
from sb3_kfcv.vec_env.make import make_joint_env
from zoo import train
from zoo.run_folder import RunFolder

# ---- what is compared

WALL_CLOCK = ("time/fps", "time/time_elapsed", "time/update_seconds", "time/refresh_seconds")

# What of a checkpoint may differ: the wall clock, the lengths of logs, in which pieces the transitions lie.
FREE = ("t", "elapsed", "update_seconds", "refresh_seconds", "boards", "files", "transitions")


def without_free(value):
    if isinstance(value, dict):
        return {key: without_free(item) for key, item in value.items() if key not in FREE}
    return [without_free(item) for item in value] if isinstance(value, list) else value


def contents(path):
    """Every member of a file, as JSON or bytes."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist() if name != "manifest.json"}
    clock = [name for name in members if name.endswith("/episode_times.npy")]
    read = {name: without_free(json.loads(data)) if name.endswith(".json") else data for name, data in members.items()}
    return {name: value for name, value in read.items() if name not in clock}


def assert_same_contents(one, other):
    ours, theirs = contents(one), contents(other)
    assert ours.keys() == theirs.keys()
    assert [name for name, value in ours.items() if value != theirs[name]] == []


def assert_equal_checkpoints(one, other):
    """All checkpoints that two folders have in common, the latest of each among them, and the buffers of the latest."""
    ours, theirs = checkpoints_in(one), checkpoints_in(other)
    assert max(ours) == max(theirs)
    for steps in ours.keys() & theirs.keys():
        assert_same_contents(ours[steps], theirs[steps])
    a, b = (Checkpoint(found[max(found)]).transitions for found in (ours, theirs))
    np.testing.assert_equal(a, b)


def series(path):
    """
    Every scalar entry of all event files, and the sum of every histogram; sorted, since files of one process and second need
    not sort by age.
    """
    events = EventAccumulator(str(path), size_guidance={"scalars": 0, "histograms": 0}, purge_orphaned_data=False)
    events.Reload()
    tags = events.Tags()
    entries = {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in tags["scalars"]}
    for tag in tags["histograms"]:
        entries[tag] = [(event.step, event.histogram_value.sum) for event in events.Histograms(tag)]
    return {tag: sorted(values) for tag, values in entries.items() if re.sub(r"_\w+/", "/", tag) not in WALL_CLOCK}


def episodes(path):
    header, *rows = path.read_text().splitlines()
    assert header.startswith("#")
    return [{key: value for key, value in row.items() if key != "t"} for row in csv.DictReader(rows)]


def assert_equal_arrays(one, other):
    np.testing.assert_equal(dict(np.load(one)), dict(np.load(other)))


def assert_equal_runs(one, other):
    """Models, checkpoints, evaluations, monitor files and TensorBoard series."""
    for name in (f"{one.env_id}.zip", "best_model.zip"):
        assert_same_contents(one.path / name, other.path / name)
    assert_equal_checkpoints(one.path, other.path)
    assert episodes(one.monitor_file) == episodes(other.monitor_file)
    assert_equal_arrays(one.path / "evaluations.npz", other.path / "evaluations.npz")
    np.testing.assert_equal(series(one.path), series(other.path))


# ---- runs of the script, and trainings from Python, that are killed


class Killed(Exception):
    """Stands for SIGKILL: nothing after it is run."""


class KillAt(BaseCallback):
    def __init__(self, steps):
        super().__init__()
        self.steps = steps

    def _on_step(self):
        if self.num_timesteps >= self.steps:
            raise Killed
        return True


NEVER = 10**9


@pytest.fixture(autouse=True, scope="module")
def quick_collections():
    """What is imported need not be looked through at each kill."""
    gc.freeze()
    yield
    gc.unfreeze()


@contextmanager
def killed():
    try:
        yield
    except Killed:
        pass
    else:
        pytest.fail("it came to its end")


def run(folder, algo, *more, env="Grassland-v0", params=(), steps=240, callbacks=(), save_freq=40):
    words = command(folder, env, algo, "--save-freq", str(save_freq), *more, params=params, steps=steps)
    return train.main(words, callbacks)


def resume(folder, callbacks=()):
    gc.collect()  # the logs of who was killed are closed now, not while this one writes them
    return train.main(["--resume", str(folder.path), "--verbose", "0"], callbacks)


def killed_run(folder, algo="kfcv_maddpg", at=150, **settings):
    """The folder of a run that was killed."""
    with killed():
        run(folder, algo, callbacks=[KillAt(at)], **settings)
    return run_folder(folder, settings.get("env", "Grassland-v0"), algo)


def whole_run(folder, algo="kfcv_maddpg", **settings):
    assert run(folder, algo, callbacks=[KillAt(NEVER)], **settings) == 0
    return run_folder(folder, settings.get("env", "Grassland-v0"), algo)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run of KFCVMADDPG in Grassland that was never stopped."""
    return whole_run(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def killed_once(tmp_path_factory):
    return killed_run(tmp_path_factory.mktemp("cut"), at=170)


@pytest.fixture
def cut(tmp_path, killed_once):
    """The same run, killed after the checkpoint of 160 env steps; its folder has moved since."""
    folder = run_folder(tmp_path, algo="kfcv_maddpg")
    shutil.copytree(killed_once.path, folder.path)
    return folder


def learn(model, folder, steps=120, kill=NEVER, callbacks=(), save_freq=40, keep=-1, **settings):
    """What a user writes to start a training, and to go on with it."""
    if checkpoints_in(folder):  # a process does not share the generators of the one before
        for generator in (random, np.random):
            generator.seed(kill)
        th.manual_seed(kill)
        model.action_space.seed(kill)
    return model.learn(steps, [Checkpoints(folder, save_freq, keep, resume=True), *callbacks, KillAt(kill)], **settings)


def assert_exact(tmp_path, make, kills=(90,), callbacks=lambda folder: (), **settings):
    """``make`` gives the model, and ``callbacks`` those of a folder, anew for each process."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    learn(make(), whole, callbacks=callbacks(whole), **settings)
    for kill in kills:
        with killed():
            learn(make(), cut, kill=kill, callbacks=callbacks(cut), **settings)
    learn(make(), cut, callbacks=callbacks(cut), **settings)
    assert list(checkpoints_in(whole)) == list(checkpoints_in(cut))
    assert_equal_checkpoints(whole, cut)


GRASSLAND = {"n_wolves": 2, "n_sheep": 2, "n_grass": 1, "max_steps": 5}
SPREAD = {"n_agents": 2, "max_steps": 5}
CURRICULUM = {"teacher_batch_size": 8, "first_teacher_steps": 3, "teacher_steps": 2, "refresh_every": 20}


def grassland(n=2, seed=None, **kwargs):
    return make_vec_env("Grassland-v0", n, seed, {**GRASSLAND, **kwargs})


def small(algo, env, **settings):
    """A small model that learns from step 20 on."""
    settings = {"learning_starts": 20, "batch_size": 8, "buffer_size": 200, "policy_kwargs": {"net_arch": [8]}, **settings}
    if algo is KFCVMADDPG:
        settings["replay_buffer_kwargs"] = {**CURRICULUM, **settings.get("replay_buffer_kwargs", {})}
    return algo("MlpPolicy", env, device="cpu", seed=1, **settings)


def drifting_noise():
    return OrnsteinUhlenbeckActionNoise(np.zeros(8), np.full(8, 0.2), dtype=np.float32)


def teams(wolf=MADDPG, sheep=MADDPG, env=None, of_wolf=(), of_sheep=(), **settings):
    """Co-training of small learners, of which the second one starts later."""
    own = {"wolf": {"algo": wolf, **dict(of_wolf)}, "sheep": {"algo": sheep, "learning_starts": 40, **dict(of_sheep)}}
    of_all = {"learning_starts": 20, "batch_size": 8, "buffer_size": 200, "policy_kwargs": {"net_arch": [8]}}
    for theirs in own.values():
        theirs.update({"replay_buffer_kwargs": CURRICULUM} if theirs["algo"] is KFCVMADDPG else {}, **{**of_all, **theirs})
    return CoTraining("MlpPolicy", env or grassland(), own, seed=1, device="cpu", **settings)


def three_teams(**settings):
    """A group that learns, one that acts at random, and one that plays a mixture."""
    own = {"alpha": {"algo": MADDPG, "learning_starts": 20, "batch_size": 8, "buffer_size": 200}}
    env = make_vec_env(ThreeToys, 2)
    opponents = {"beta": "random", "gamma": Mixture([RandomPlayer(env.action_space, np.random.default_rng(8)), "random"])}
    return CoTraining("MlpPolicy", env, own, opponents, seed=1, device="cpu", **settings)


def saved_sheep(seed=7):
    return ActorPolicy.of(MADDPG("MlpPolicy", grassland(), seed=seed, device="cpu", policy_kwargs={"net_arch": [8]}).policy)


class SavedToy(ToyParallelEnv):
    def get_state(self):
        rng = self.rng.bit_generator.state
        return {"step": self.t, "places": dict(self.places), "agents": list(self.agents), "rng": rng}

    def set_state(self, saved):
        self.t, self.places, self.agents = saved["step"], dict(saved["places"]), list(saved["agents"])
        self.rng.bit_generator.state = saved["rng"]


class ThreeToys(SavedToy):
    """Each agent is a group of its own."""

    NAMES = {"alpha": "scout_0", "beta": "scout_1", "gamma": "tank_0"}  # noqa: RUF012

    def __init__(self):
        super().__init__(time_limit=6)
        self.possible_agents = list(self.NAMES)
        self.places = dict.fromkeys(self.NAMES, 0.0)

    def observation_space(self, agent):
        return super().observation_space(self.NAMES[agent])

    def action_space(self, agent):
        return super().action_space(self.NAMES[agent])

    def _observations(self, agents):
        rows = {agent: np.zeros(self.observation_space(agent).shape, np.float32) for agent in agents}
        for agent, row in rows.items():
            row[:2] = self.places[agent], self.t
        return rows


def toy(**kwargs):
    return SavedToy(time_limit=8, deaths={"scout_0": 3}, **kwargs)


# ---- the same bits


@pytest.mark.parametrize(
    ("env", "algo"), [*(("Grassland-v0", algo) for algo in ALGOS), ("HardSpread-v0", "kfcv_maddpg")], ids=str
)
def test_a_run_that_was_killed_equals_the_whole_one(tmp_path, algo, env):
    whole = whole_run(tmp_path / "whole", algo, env=env)
    cut = killed_run(tmp_path / "cut", algo, at=30, env=env)
    for at in (62, 234):
        with killed():
            resume(cut, [KillAt(at)])
    assert resume(cut, [KillAt(NEVER)]) == 0
    assert list(checkpoints_in(whole.path)) == list(checkpoints_in(cut.path))
    assert_equal_runs(whole, cut)


SETUPS = {
    "one world": lambda: small(MADDPG, grassland(1)),
    "no noise": lambda: small(MADDPG, grassland(), exploration_noise=0.0),
    "drifting noise of one world": lambda: small(MADDPG, grassland(1), action_noise=drifting_noise()),
    "drifting noise of many worlds": lambda: small(MADDPG, grassland(3), action_noise=drifting_noise()),
    "vectorised noise": lambda: small(MADDPG, grassland(3), action_noise=VectorizedActionNoise(drifting_noise(), 3)),
    "discrete": lambda: small(KFCVMADDPG, grassland(continuous_actions=False)),
    "random opponents": lambda: small(MADDPG, grassland(), team="wolf", opponents={"sheep": "random"}),
    "random opponents, discrete": lambda: small(
        PERMADDPG, grassland(continuous_actions=False), team="wolf", opponents={"sheep": "random"}
    ),
    "as TD3": lambda: small(
        *(MADDPG, grassland()),
        **{"policy_delay": 2, "target_policy_noise": 0.2, "policy_kwargs": {"net_arch": [8], "n_critics": 2}},
        **{"max_grad_norm": 0.5, "actor_regularization": 1e-3},
    ),
    "shared parameters, state": lambda: small(KFCVMADDPG, grassland(), share_parameters=True, critic_input="state"),
    "own observations": lambda: small(MADDPG, grassland(), critic_input="own_observation"),
    "another optimiser": lambda: small(
        MADDPG, grassland(), policy_kwargs={"optimizer_class": th.optim.RMSprop, "optimizer_kwargs": {"momentum": 0.1}}
    ),
    "falling learning rate": lambda: small(MADDPG, grassland(), learning_rate="lin_1e-3"),
    "normalised": lambda: small(KFCVMADDPG, VecNormalize(grassland(), norm_reward=False)),
    "trained every two episodes": lambda: small(MADDPG, grassland(1), train_freq=(2, "episode"), gradient_steps=-1),
    "trained every seven steps": lambda: small(PERMADDPG, grassland(), train_freq=(7, "step"), gradient_steps=-1),
    "stages per refresh": lambda: small(KFCVMADDPG, grassland(), replay_buffer_kwargs={"stage_clock": "refresh"}),
    "random stages": lambda: small(KFCVMADDPG, grassland(), replay_buffer_kwargs={"stage_rule": "random"}),
    "the student's scores": lambda: small(KFCVMADDPG, grassland(), replay_buffer_kwargs={"score": "student"}),
    "buffer smaller than the way between checkpoints": lambda: small(PERMADDPG, grassland(), buffer_size=24),
    "buffer that wraps": lambda: small(KFCVMADDPG, grassland(), buffer_size=50),
    "ParallelEnv": lambda: small(MADDPG, grassland_v0.parallel_env(**GRASSLAND)),
    "DummyVecEnv": lambda: small(KFCVMADDPG, DummyVecEnv([lambda: make_joint_env("HardSpread-v0", **SPREAD)] * 2)),
    "gym env": lambda: small(MADDPG, gym.make("HardSpread-v0", **SPREAD)),
    "gym id": lambda: small(MADDPG, "HardSpread-v0"),
    "own ParallelEnv": lambda: small(PERMADDPG, toy()),
    "a saved opponent": lambda: small(MADDPG, grassland(), team="wolf", opponents={"sheep": saved_sheep()}),
    "a mixture of opponents": lambda: small(
        KFCVMADDPG, grassland(), team="wolf", opponents={"sheep": Mixture([saved_sheep(), "random", "flee"], [2, 1, 1])}
    ),
    "teams": lambda: teams(KFCVMADDPG, PERMADDPG),
    "teams, discrete": lambda: teams(PERMADDPG, KFCVMADDPG, grassland(continuous_actions=False)),
    "teams and their past": lambda: teams(MADDPG, PERMADDPG, pool_share=0.5, pool_freq=20, pool_size=2),
    "teams and their past by wins": lambda: teams(
        KFCVMADDPG, MADDPG, pool_share=0.5, pool_freq=20, pool_size=3, pool_sampling="win_rate"
    ),
    "teams with drifting noise": lambda: teams(of_wolf={"action_noise": drifting_noise(), "gradient_steps": -1}),
    "teams in one world": lambda: teams(
        MADDPG, PERMADDPG, grassland(1), *[{"train_freq": (2, "episode"), "gradient_steps": -1}] * 2
    ),
    "teams of other buffers": lambda: teams(of_wolf={"buffer_size": 30}, of_sheep={"critic_input": "state"}),
    "a team among random ones": three_teams,
    "own ParallelEnvs, discrete": lambda: small(KFCVMADDPG, make_vec_env(lambda: toy(discrete=True), 2)),
}


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
@pytest.mark.parametrize("setup", SETUPS)
def test_every_setting_is_exact(tmp_path, setup):
    assert_exact(tmp_path, SETUPS[setup])


def stock_callbacks(folder):
    """SB3's own callbacks, our evaluation among them as a child."""
    return [
        EvalCallback(
            *(grassland(2, seed=70), None, StopTrainingOnNoModelImprovement(100, 1)),
            **{"n_eval_episodes": 3, "eval_freq": 9, "log_path": str(folder / "sb3"), "verbose": 0},
            best_model_save_path=str(folder / "best"),
        ),
        CheckpointCallback(10, str(folder / "models")),
        EveryNTimesteps(24, MultiAgentEvalCallback(grassland(2, seed=80), 10, 2, folder / "own", folder / "own", verbose=0)),
        LogEveryNTimesteps(16),
        StopTrainingOnMaxEpisodes(1000),
    ]


@pytest.mark.parametrize("progress_bar", [False, True])
def test_sb3s_callbacks_go_on_exactly(tmp_path, progress_bar):
    assert_exact(
        *(tmp_path, lambda: small(MADDPG, grassland())),
        **{"kills": (90, 110), "callbacks": stock_callbacks, "progress_bar": progress_bar},
    )
    for name in ("sb3/evaluations.npz", "own/evaluations.npz"):
        assert_equal_arrays(tmp_path / "whole" / name, tmp_path / "cut" / name)
    for name in ("best/best_model.zip", "own/best_model.zip", "models/rl_model_120_steps.zip"):
        assert_same_contents(tmp_path / "whole" / name, tmp_path / "cut" / name)


def yardsticks(folder):
    """Evaluations against players that draw."""
    return [
        *(
            MultiAgentEvalCallback(
                *(grassland(2, seed=70), 30, 4, folder, folder),
                **{"team": team, "opponents": {other: opponent}, "name": f"{team}_vs_{i}", "verbose": 0},
            )
            for i, (team, other, opponent) in enumerate(
                [("wolf", "sheep", "random"), ("wolf", "sheep", [saved_sheep(), "flee"]), ("sheep", "wolf", {"chase": 1})]
            )
        ),
        MultiAgentEvalCallback(grassland(2, seed=80), 30, 2, folder, verbose=0),
        SavePlayers(folder / "players", 30),
    ]


def test_evaluations_of_teams_go_on_exactly(tmp_path):
    assert_exact(tmp_path, lambda: teams(pool_share=0.5, pool_freq=20), kills=(75, 110), callbacks=yardsticks)
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    written = sorted(path.name for path in whole.glob("evaluations*.npz"))
    assert written == ["evaluations.npz", *(f"evaluations_{name}.npz" for name in ("sheep_vs_2", "wolf_vs_0", "wolf_vs_1"))]
    for name in written:
        assert_equal_arrays(whole / name, cut / name)
    players = {f"{team}_{steps}_steps.zip" for team in ("wolf", "sheep") for steps in (0, 30, 60, 90, 120)}
    for folder in (whole, cut):
        assert {path.name for path in (folder / "players").iterdir()} == players
    for name in (*(f"players/{player}" for player in players), "best_wolf.zip", "best_sheep.zip"):
        assert_same_contents(whole / name, cut / name)


@pytest.mark.parametrize("kind", ["a team", "teams"])
def test_a_training_goes_on_against_its_opponents_as_they_were(tmp_path, kind):
    """Whatever their files hold by now."""
    file = tmp_path / "opponent.zip"

    def make():
        mixture = {"sheep": {str(file): 2, "random": 1}}
        if kind == "a team":
            return small(MADDPG, grassland(), team="wolf", opponents=mixture)
        learner = {"algo": "maddpg", "learning_starts": 20, "batch_size": 8, "buffer_size": 200}
        return CoTraining("MlpPolicy", grassland(), {"wolf": learner}, mixture, seed=1, device="cpu")

    saved_sheep(7).save(file)
    learn(make(), tmp_path / "whole")
    with killed():
        learn(make(), tmp_path / "cut", kill=90)
    saved_sheep(8).save(file)
    learn(make(), tmp_path / "cut")
    learn(make(), tmp_path / "another")
    assert_equal_checkpoints(tmp_path / "whole", tmp_path / "cut")
    with pytest.raises(AssertionError):
        assert_equal_checkpoints(tmp_path / "whole", tmp_path / "another")


def test_a_live_opponent_is_the_programs(tmp_path):
    """It may have learnt on: that is for whoever trains it to restore."""

    def make(opponent):
        return small(MADDPG, grassland(), team="wolf", opponents={"sheep": opponent})

    live = small(MADDPG, grassland())
    with killed():
        learn(make(live), tmp_path, kill=90)
    model = learn(make(live.learn(60)), tmp_path)
    assert model._opponent_policy.players["sheep"] is live


OTHER_OPPONENTS = {
    "sheep was played by flee; here it is played by graze": ("flee", "graze"),
    "sheep was played by flee; here it is played by a model": ("flee", saved_sheep()),
    "sheep was played by a model; here it is played by random": (saved_sheep(), "random"),
    r"sheep was played by a mixture of flee, graze \(weights 1, 2\); here it is played by flee": (
        *({"flee": 1, "graze": 2}, "flee"),
    ),
    r"played by a mixture of flee, graze \(weights 1, 2\); here it is played by a mixture of flee, graze \(weights 2, 1\)": (
        *({"flee": 1, "graze": 2}, {"flee": 2, "graze": 1}),
    ),
    "sheep was played by graze; here it is played by random": ({"flee": 1, "graze": 2}, {"flee": 1, "random": 2}),
}


@pytest.mark.parametrize("sentence", OTHER_OPPONENTS)
def test_a_training_does_not_go_on_against_others(tmp_path, sentence):
    then, now = OTHER_OPPONENTS[sentence]
    learn(small(MADDPG, grassland(), team="wolf", opponents={"sheep": then}), tmp_path, steps=40)
    with pytest.raises(checkpoints.ResumeError, match=f"rl_model_40_steps.zip is of a training against others: .*{sentence}"):
        learn(small(MADDPG, grassland(), team="wolf", opponents={"sheep": now}), tmp_path)


def test_a_callback_that_ends_the_training_ends_it_at_the_same_step(tmp_path):
    def callbacks(folder):
        stop = StopTrainingOnNoModelImprovement(0, 1)
        return [EvalCallback(grassland(2, seed=70), callback_after_eval=stop, n_eval_episodes=2, eval_freq=20, verbose=0)]

    ends = []
    for kill in (None, 90):
        folder, model = tmp_path / str(kill), small(MADDPG, grassland())
        if kill is not None:
            with killed():
                learn(model, folder, 4000, kill, callbacks(folder))
        model = learn(small(MADDPG, grassland()), folder, 4000, callbacks=callbacks(folder))
        ends.append(model.num_timesteps)
    assert ends[0] == ends[1] < 4000


def test_evaluations_of_normalised_worlds_go_on_exactly(tmp_path):
    def callbacks(folder):
        env = VecNormalize(grassland(2, seed=70), training=False, norm_reward=False)
        return [MultiAgentEvalCallback(env, 30, 2, folder, folder, verbose=0)]

    assert_exact(tmp_path, lambda: small(KFCVMADDPG, VecNormalize(grassland(), norm_reward=False)), callbacks=callbacks)
    assert_equal_arrays(tmp_path / "whole/evaluations.npz", tmp_path / "cut/evaluations.npz")
    assert_same_contents(tmp_path / "whole/best_model.zip", tmp_path / "cut/best_model.zip")


def test_tensorboard_goes_on_in_its_folder(tmp_path):
    def make(name):
        return small(KFCVMADDPG, grassland(), tensorboard_log=str(tmp_path / name / "tb"))

    learn(make("whole"), tmp_path / "whole")
    with killed():
        learn(make("cut"), tmp_path / "cut", kill=90)
    gc.collect()
    learn(make("cut"), tmp_path / "cut")
    gc.collect()
    for name in ("whole", "cut"):
        assert [path.name for path in (tmp_path / name / "tb").iterdir()] == ["KFCVMADDPG_1"]
    np.testing.assert_equal(*(series(tmp_path / name / "tb/KFCVMADDPG_1") for name in ("whole", "cut")))


@pytest.mark.parametrize("at", [20, 98])
def test_a_run_that_trains_a_model_on_goes_on_likewise(tmp_path, at):
    first = whole_run(tmp_path / "first", steps=60)
    words = ["--algo", "kfcv_maddpg", "-i", str(first.last_model), "-n", "120", "--save-freq", "40", "--verbose", "0"]
    words += ["--eval-freq", "60", "--eval-episodes", "3", "--log-interval", "8"]
    assert train.main([*words, "-f", str(tmp_path / "whole")], [KillAt(NEVER)]) == 0
    with killed():
        train.main([*words, "-f", str(tmp_path / "cut")], [KillAt(60 + at)])
    whole, cut = (run_folder(tmp_path / name, algo="kfcv_maddpg") for name in ("whole", "cut"))
    assert resume(cut, [KillAt(NEVER)]) == 0
    assert_equal_runs(whole, cut)


def test_a_longer_training_goes_on_with_its_own_schedule(tmp_path):
    for steps in (60, 120):
        model = learn(small(KFCVMADDPG, grassland(), learning_rate="lin_1e-3"), tmp_path, steps)
        assert model.num_timesteps == steps
    assert (model._current_progress_remaining, model.replay_buffer.progress) == (0, 1)
    assert 0 <= model.actor.optimizer.param_groups[0]["lr"] < 1e-3 / 10


def test_a_training_that_is_over_stays_as_it_is(tmp_path):
    learn(small(KFCVMADDPG, grassland()), tmp_path / "once")
    for _ in range(2):
        learn(small(KFCVMADDPG, grassland()), tmp_path / "twice")
    assert_equal_checkpoints(tmp_path / "once", tmp_path / "twice")


def test_a_stop_before_the_first_step_can_be_gone_on_with(tmp_path):
    learn(small(KFCVMADDPG, grassland()), tmp_path / "whole")
    with StopOnSignal() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        small(KFCVMADDPG, grassland()).learn(120, [stop, Checkpoints(tmp_path / "cut", 40, -1, True, stop), KillAt(NEVER)])
    assert list(checkpoints_in(tmp_path / "cut")) == [0]
    learn(small(KFCVMADDPG, grassland()), tmp_path / "cut")
    assert_equal_checkpoints(tmp_path / "whole", tmp_path / "cut")


def test_a_signal_in_the_last_step_stops_nothing(tmp_path):
    late = SignalAt(120, signal.SIGTERM)
    assert run(tmp_path, "maddpg", steps=120, save_freq=-1, callbacks=[late]) == 0
    assert MADDPG.load(run_folder(tmp_path).last_model).num_timesteps == 120


def test_a_buffer_that_was_filled_anew_is_saved_anew(tmp_path):
    model, saver = small(MADDPG, grassland()), Checkpoints(tmp_path, 40)
    model.learn(40, saver)
    model.replay_buffer.reset()
    model.learn(60, saver, reset_num_timesteps=False)
    held = Checkpoint(tmp_path / "rl_model_100_steps.zip").transitions
    np.testing.assert_equal(held, model.replay_buffer.transitions())


def test_the_comparison_sees_whatever_is_not_restored(tmp_path, monkeypatch, whole, killed_once):
    parts = {
        **dict.fromkeys(("set_random_state", "set_env_state", "set_callback_states", "set_log_state"), checkpoints),
        **dict.fromkeys(("set_training_state", "set_replay_buffer_state", "set_parameters"), KFCVMADDPG),
    }
    for forgotten, owner in parts.items():
        cut = run_folder(tmp_path / forgotten, algo="kfcv_maddpg")
        shutil.copytree(killed_once.path, cut.path)
        with monkeypatch.context() as patch:
            patch.setattr(owner, forgotten, lambda *_, **__: None)
            resume(cut, [KillAt(NEVER)])
        with pytest.raises(AssertionError):
            assert_equal_runs(whole, cut)


# ---- worlds whose state nobody can read


class Inspect(BaseCallback):
    """Looks at a training before its first step, and ends it."""

    def __init__(self, look=None):
        super().__init__()
        self.look = look

    def _on_rollout_start(self):
        if self.look is not None:
            self.look()
            raise Killed

    def _on_step(self):
        return True


def spread_of_mpe2():
    return simple_spread_v3.parallel_env(N=2, max_cycles=6, continuous_actions=True)


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
@pytest.mark.parametrize("world", [lambda: ToyParallelEnv(time_limit=8), spread_of_mpe2], ids=["toy", "mpe2"])
def test_all_is_exact_but_worlds_that_cannot_be_read(tmp_path, world):
    def make():
        return small(KFCVMADDPG, make_vec_env(world, 2))

    with pytest.warns(UserWarning, match="cannot be read: a resumed training starts new episodes; everything else is exact"):
        with killed():
            learn(make(), tmp_path / "cut", kill=90, callbacks=[Inspect()])
    model, saver = make(), Checkpoints(tmp_path / "cut", 40, resume=True)

    def look():
        held = Checkpoint(tmp_path / "cut/rl_model_80_steps.zip").transitions
        np.testing.assert_equal(model.replay_buffer.transitions(), held)
        saver.folder = tmp_path / "resumed"
        saver.save()

    with killed(), pytest.warns(UserWarning, match="starts new episodes"):
        model.learn(120, [saver, Inspect(look), KillAt(NEVER)])
    before, after = (contents(tmp_path / name / "rl_model_80_steps.zip") for name in ("cut", "resumed"))
    different = {name for name in before if before[name] != after.get(name)}
    assert different <= {"attributes/_last_obs.npy", "attributes/_last_episode_starts.npy"}
    with pytest.warns(UserWarning, match="starts new episodes"):
        assert learn(make(), tmp_path / "cut").num_timesteps == 120


def test_a_warning_names_evaluation_worlds_that_cannot_be_read(tmp_path):
    unreadable = make_vec_env(lambda: ToyParallelEnv(time_limit=8), 1)
    evaluation = EvalCallback(unreadable, eval_freq=10, n_eval_episodes=1, verbose=0)
    with pytest.warns(UserWarning, match="the state of ToyParallelEnv cannot be read"):
        learn(small(MADDPG, toy()), tmp_path, steps=20, callbacks=[evaluation])


# ---- damage


def flip_a_bit(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 4
    path.write_bytes(data)


def cut_in_half(path):
    os.truncate(path, path.stat().st_size // 2)


def lose_its_transitions(path):
    """Those that no older checkpoint needs."""
    max((path.parent / "transitions").iterdir(), key=lambda piece: int(piece.stem.partition("_")[2])).unlink()


@pytest.mark.parametrize("harm", [flip_a_bit, cut_in_half, lose_its_transitions])
def test_a_damaged_checkpoint_is_set_aside_and_the_one_before_taken(whole, cut, harm):
    assert list(checkpoints_in(cut.path)) == [160, 120, 80]
    harm(cut.path / "rl_model_160_steps.zip")
    with pytest.warns(UserWarning, match="160 env steps is of no use, and set aside as rl_model_160_steps.zip.damaged: "):
        assert resume(cut, [KillAt(NEVER)]) == 0
    assert (cut.path / "rl_model_160_steps.zip.damaged").exists()
    assert_equal_runs(whole, cut)


def test_an_older_damaged_checkpoint_harms_nobody(whole, cut):
    flip_a_bit(cut.path / "rl_model_120_steps.zip")
    assert resume(cut, [KillAt(NEVER)]) == 0
    assert_equal_runs(whole, cut)


def test_without_a_whole_checkpoint_nothing_is_touched(cut, capsys):
    """A lost folder hits all checkpoints at once, and may come back."""
    (cut.path / "transitions").rename(cut.path / "elsewhere")
    before = {path: path.read_bytes() for path in cut.path.rglob("*") if path.is_file()}
    assert resume(cut) == 2
    assert re.match(
        r"error: no checkpoint in .* is whole, so nothing can be gone on with: .*, which is missing\n", capsys.readouterr().err
    )
    assert {path: path.read_bytes() for path in cut.path.rglob("*") if path.is_file()} == before


def test_a_run_without_a_checkpoint_begins_again_with_empty_logs(whole, cut):
    for path in checkpoints_in(cut.path).values():
        path.unlink()
    assert series(cut.path)
    assert resume(cut, [KillAt(NEVER)]) == 0
    assert_equal_runs(whole, cut)


# ---- what is kept


def transitions_of(folder):
    return {path.name for path in (folder / "transitions").iterdir()}


@pytest.mark.parametrize(("keep", "kept"), [(1, [240]), (2, [240, 200]), (-1, [240, 200, 160, 120, 80, 40])])
def test_so_many_checkpoints_stay_and_only_their_transitions(tmp_path, keep, kept):
    learn(small(PERMADDPG, grassland(), buffer_size=50), tmp_path, steps=240, keep=keep)
    assert list(checkpoints_in(tmp_path)) == kept
    needed = {
        f"{piece.first}_{piece.last}.zip" for path in checkpoints_in(tmp_path).values() for piece in Checkpoint(path).pieces
    }
    assert transitions_of(tmp_path) == needed
    assert len(needed) == (2 if keep == 1 else 3 if keep == 2 else 6)  # 25 steps of the two worlds, 20 to a file
    whole = [Checkpoint(path).transitions for path in checkpoints_in(tmp_path).values()]
    assert all(len(held["rewards"]) == min(25, steps // 2) for held, steps in zip(whole, kept, strict=True))


def test_no_checkpoint_at_all_cannot_be_asked_for(tmp_path):
    with pytest.raises(ValueError, match="keep=0 would keep no checkpoint"):
        Checkpoints(tmp_path, keep=0)


def test_other_files_are_neither_taken_for_checkpoints_nor_removed(whole, cut):
    half = (cut.path / "rl_model_120_steps.zip").read_bytes()[:1000]
    leftovers = [".rl_model_500_steps.zip.17.partial", "transitions/.60_70.zip.17.partial"]
    own = [
        "rl_model_500_steps.zip.part",
        "my_rl_model_500_steps.zip",
        "rl_model_500_steps.zip.damaged",
        "rl_model_x_steps.zip",
    ]
    for name in (*leftovers, *own):
        (cut.path / name).write_bytes(half)
    assert resume(cut, [KillAt(NEVER)]) == 0
    assert_equal_runs(whole, cut)
    assert [name for name in own if not (cut.path / name).exists()] == []
    assert [name for name in leftovers if (cut.path / name).exists()] == []


def test_a_checkpoint_is_a_model(tmp_path):
    rows, then = np.random.default_rng(0).normal(size=(7, grassland().observation_space.shape[0])).astype(np.float32), {}

    class Note(BaseCallback):
        def _on_rollout_start(self):
            then[self.num_timesteps] = self.model.predict(rows, deterministic=True)[0]

        def _on_step(self):
            return True

    learn(small(MADDPG, grassland()), tmp_path, callbacks=[Note()])
    for steps in (40, 80):
        loaded = MADDPG.load(tmp_path / f"rl_model_{steps}_steps.zip")
        np.testing.assert_array_equal(loaded.predict(rows, deterministic=True)[0], then[steps])
    assert not np.array_equal(then[40], then[80])


# ---- refusals


def refusal(capsys, *words):
    """The one sentence with which a command is refused."""
    capsys.readouterr()
    assert train.main(words) == 2
    printed = capsys.readouterr()
    assert (printed.out, printed.err.count("\n"), printed.err[:7]) == ("", 1, "error: ")
    return printed.err


def test_what_is_no_run_cannot_be_resumed(tmp_path, capsys, cut):
    assert refusal(capsys, "--resume", str(tmp_path)) == f"error: {tmp_path} is no folder of a run of zoo/train.py\n"
    beside = refusal(capsys, "--resume", f"{cut.path}1")
    assert beside == f'error: unknown run folder "{cut.path}1"; did you mean "{cut.path}"?\n'


def test_a_run_that_has_ended_cannot_be_resumed(capsys, whole):
    printed = refusal(capsys, "--resume", str(whole.path))
    assert printed == (f"error: the run in {whole.path} has ended; to train its model on: -i {whole.last_model} -n STEPS\n")


@pytest.mark.parametrize("words", ["-params gamma:0.5", "--seed 3", "-n 500", "--algo maddpg", "--save-freq 7"])
def test_a_resumed_run_keeps_its_settings(capsys, cut, words):
    before = sorted(path.stat().st_mtime_ns for path in cut.path.rglob("*"))
    printed = refusal(capsys, "--resume", str(cut.path), *words.split())
    flag = {"-params": "--hyperparams", "-n": "--n-timesteps"}.get(words.split()[0], words.split()[0])
    assert f"a resumed run keeps its settings: leave out {flag}, or train its model on with -i in a new run" in printed
    assert sorted(path.stat().st_mtime_ns for path in cut.path.rglob("*")) == before


def test_settings_that_were_edited_are_refused(capsys, cut):
    config = yaml.safe_load(cut.config_file.read_text())
    cut.config_file.write_text(yaml.safe_dump({**config, "gamma": 0.5}))
    assert resume(cut) == 2
    assert capsys.readouterr().err.endswith("was written with gamma=0.99; this model has gamma=0.5\n")


def test_two_processes_do_not_train_in_one_folder(capsys, cut):
    with cut.locked():
        assert refusal(capsys, "--resume", str(cut.path)) == f"error: another process is training in {cut.path}\n"
    assert resume(cut) == 0


OTHERS = {
    "is of MADDPG; this model is a PERMADDPG": lambda: small(PERMADDPG, grassland()),
    "was written with gamma=0.99; this model has gamma=0.5": lambda: small(MADDPG, grassland(), gamma=0.5),
    "was written with n_envs=2; this model has n_envs=3": lambda: small(MADDPG, grassland(3)),
    "was written with learning_rate=0.001; this model has learning_rate=lin_1e-3": lambda: small(
        MADDPG, grassland(), learning_rate="lin_1e-3"
    ),
    "is of another world: 2 wolf (22 observed, 2 acting), 2 sheep": lambda: small(MADDPG, grassland(n_wolves=3)),
    "is of MADDPG; this model is a CoTraining": teams,
    "is of another world: 2 wolf": lambda: small(MADDPG, make_vec_env("HardSpread-v0", 2, env_kwargs=SPREAD)),
    "the worlds were wrapped as VecMonitor of ParticleVecEnv; here is a DummyVecEnv": lambda: small(
        MADDPG, DummyVecEnv([lambda: make_joint_env("Grassland-v0", **GRASSLAND)] * 2)
    ),
}


@pytest.mark.parametrize("sentence", OTHERS)
def test_a_checkpoint_of_something_else_is_refused_and_stays(tmp_path, sentence):
    learn(small(MADDPG, grassland()), tmp_path, steps=40)
    with pytest.raises(ValueError, match=re.escape(sentence)) as refused:
        learn(OTHERS[sentence](), tmp_path)
    assert "rl_model_40_steps.zip" in str(refused.value) and "\n" not in str(refused.value)
    assert Checkpoint(tmp_path / "rl_model_40_steps.zip")


def test_a_folder_holds_the_checkpoints_of_one_training(tmp_path):
    learn(small(MADDPG, grassland()), tmp_path, steps=40)
    with pytest.raises(ValueError, match="holds a checkpoint of 40 env steps, of another training: go on with it by resume"):
        small(MADDPG, grassland()).learn(40, Checkpoints(tmp_path))
    with pytest.raises(ValueError, match="CheckpointCallback writes files of the same names into"):
        learn(small(MADDPG, grassland()), tmp_path, callbacks=[CheckpointCallback(10, str(tmp_path))])


# ---- real processes


def start(*words):
    """The script in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "zoo/train.py", *words],
        **{"cwd": ROOT, "env": {**os.environ, "OMP_NUM_THREADS": "1"}, "text": True},
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE},
    )


def wait_until(process, condition, timeout=120):
    """Whether it became true while the process ran."""
    end = time.monotonic() + timeout
    while process.poll() is None:
        if condition():
            return True
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.001)
    return False


def has_begun(process, folder):
    """Whether it has opened its log, which is the last thing before the first step."""
    return any(folder.glob(f"*/*/events.out.tfevents.*.{process.pid}.*"))


def partial_files(process, folder):
    return [path for pattern in ("*/*", "*/*/transitions") for path in folder.glob(f"{pattern}/.*.{process.pid}.partial")]


class Killer:
    """
    Starts the script again and again, and kills it at random moments.

    :param folder: the log folder
    :param words: the command line of the first start
    :param seed: of the moments
    :param start_up: seconds from a start to the first step
    :param steps: env steps that a process makes before it is killed, on average
    """

    def __init__(self, folder, words, seed, start_up, steps):
        self.folder, self.words, self.rng = folder, words, np.random.default_rng(seed)
        self.start_up, self.steps = start_up, steps
        self.counts = dict.fromkeys(("start-up", "training", "writing"), 0)

    def next_words(self):
        begun = [path.parent.parent for path in self.folder.glob("*/*/*/args.yml")]
        return ["--resume", str(begun[0]), "--verbose", "0"] if begun else self.words

    def reached(self):
        return max((max(checkpoints_in(run), default=0) for run in self.folder.glob("*/*")), default=0)

    def kill(self, when):
        """
        Kill at a moment of this kind: "start-up", "training", or "writing".

        :return: whether it came to that
        """
        goal = self.reached() + self.rng.uniform(0, 2 * self.steps)
        process = start(*self.next_words())
        if when == "start-up":
            time.sleep(self.rng.uniform(0, self.start_up))
        else:
            wait_until(process, lambda: has_begun(process, self.folder) and self.reached() >= goal)
            time.sleep(self.rng.uniform(0, 0.1))  # some steps, and the writing of a checkpoint
            if when == "writing":
                wait_until(process, lambda: partial_files(process, self.folder))
        process.kill()
        _, errors = process.communicate()
        if process.returncode != -signal.SIGKILL:
            assert process.returncode == 0, errors
            return False
        begun, writing = has_begun(process, self.folder), partial_files(process, self.folder)
        self.counts["writing" if writing else "training" if begun else "start-up"] += 1
        return True


@pytest.mark.expensive
@pytest.mark.parametrize("algo", ALGOS)
def test_twenty_kills_at_random_moments_change_nothing(tmp_path, algo):
    steps, kills = 3000, 20
    words = {
        name: [*command(tmp_path / name, algo=algo, steps=steps, params=["buffer_size:500"]), "--save-freq", "8"]
        for name in ("whole", "cut")
    }
    began = time.monotonic()
    process = start(*words["whole"])
    wait_until(process, lambda: has_begun(process, tmp_path / "whole"))
    start_up = time.monotonic() - began
    assert process.wait() == 0

    killer = Killer(tmp_path / "cut", words["cut"], list(ALGOS).index(algo), start_up, 0.8 * steps / kills)
    moments = killer.rng.choice(["start-up", "training", "writing"], size=kills, p=[0.2, 0.5, 0.3])
    moments[:2] = "start-up", "training"
    assert all(killer.kill(when) for when in moments)
    finished = start(*killer.next_words())
    assert finished.wait() == 0
    whole, cut = (run_folder(tmp_path / name, algo=algo) for name in ("whole", "cut"))
    assert_equal_runs(whole, cut)
    assert list(checkpoints_in(whole.path)) == list(checkpoints_in(cut.path))
    assert not list(cut.path.rglob(".*.partial"))
    print(f"{algo}: {killer.counts}")


def has_stepped(run):
    """Whether an episode has ended."""
    return run.monitor_file.exists() and len(run.monitor_file.read_text().splitlines()) > 2


SAID = "{}: the training stops after the step in hand; once more stops at once\n"


def test_a_process_that_was_told_to_stop_and_then_killed_goes_on_exactly(tmp_path):
    words = {name: [*command(tmp_path / name, steps=400), "--save-freq", "20"] for name in ("whole", "cut")}
    whole, cut = (run_folder(tmp_path / name) for name in ("whole", "cut"))
    assert train.main(words["whole"]) == 0
    process = start(*words["cut"])
    wait_until(process, lambda: has_stepped(cut))
    process.send_signal(signal.SIGTERM)
    printed, errors = process.communicate()
    assert (process.returncode, errors) == (143, SAID.format("SIGTERM"))
    stopped = max(checkpoints_in(cut.path))
    assert f"stopped: the last checkpoint is of {stopped:,} env steps; to go on: " in printed
    killer = Killer(tmp_path / "cut", words["cut"], seed=0, start_up=2, steps=60)
    assert all(killer.kill(when) for when in ("training", "writing"))
    _, script, *again = shlex.split(printed.rpartition("to go on: ")[2])
    assert (Path(script).resolve(), train.main(again)) == (Path(train.__file__).resolve(), 0)
    assert_equal_runs(whole, cut)
    print(killer.counts)


def test_a_second_interrupt_stops_a_long_evaluation_at_once(tmp_path):
    process = start(*command(tmp_path), "--eval-freq", "20", "--eval-episodes", "10000000")
    wait_until(process, lambda: has_stepped(run_folder(tmp_path)))
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.5)
    process.send_signal(signal.SIGINT)
    printed, errors = process.communicate(timeout=60)  # of an evaluation that would take hours
    assert (process.returncode, errors) == (130, SAID.format("SIGINT"))
    assert "stopped: no checkpoint was saved yet; to start again: " in printed


def test_twenty_starts_at_once_get_twenty_folders(tmp_path):
    forking = multiprocessing.get_context("fork")
    gate, made = forking.Barrier(20), forking.SimpleQueue()

    def begin():
        gate.wait()
        made.put(RunFolder.create(tmp_path, "maddpg", "Grassland-v0").number)

    processes = [forking.Process(target=begin) for _ in range(20)]
    for process in processes:
        process.start()
    assert sorted(made.get() for _ in processes) == list(range(1, 21))
    for process in processes:
        process.join()


@pytest.mark.expensive
def test_a_long_run_takes_no_more_memory(tmp_path):
    used = {}

    class Weigh(BaseCallback):
        def _on_step(self):
            if self.num_timesteps in (20_000, 100_000):
                gc.collect()
                used[self.num_timesteps] = psutil.Process().memory_info().rss
            return True

    words = command(tmp_path, "Grassland-v0", "kfcv_maddpg", params=["n_envs:10"], steps=100_000)
    assert train.main([*words, "--save-freq", "1000", "--eval-freq", "5000"], [Weigh()]) == 0
    grown = (used[100_000] - used[20_000]) / 2**20
    print(f"{used[20_000] / 2**20:.1f} MB after 20,000 env steps, {grown:+.2f} MB after 80,000 more")
    assert grown < 5


def test_worlds_of_other_settings_are_refused(tmp_path):
    """Even where the agents are the same: the training would mix two worlds."""

    def learn(steps, **settings):
        env = make_vec_env("HardSpread-v0", 2, seed=0, env_kwargs={"n_agents": 2, "max_steps": 5, **settings})
        model = MADDPG("MlpPolicy", env, learning_starts=10, buffer_size=50, batch_size=8, seed=1)
        model.learn(steps, Checkpoints(tmp_path / "run", save_freq=20, resume=True))

    learn(20)
    with pytest.raises(ValueError, match=r"made with max_steps=5; these have max_steps=6"):
        learn(60, max_steps=6)
    learn(60)
