"""Worlds in processes of their own: the same numbers as in one process, and an error is heard of."""

import functools
import os
import signal
import time

import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from toy_envs import ToyParallelEnv

from sb3_kfcv import MADDPG, JointEnv, make_vec_env
from sb3_kfcv.common.checks import NonFiniteError
from sb3_kfcv.saving.checkpoints import Checkpoints
from sb3_kfcv.vec_env.make import layout_of
from sb3_kfcv.vec_env.subproc import TracedSubprocVecEnv, WorkerError

SOON = 10.0  # seconds in which an error must be here; waiting would last for ever
QUICK = {"learning_starts": 10, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}


class Failing(ToyParallelEnv):
    """Fails where it is told to: in ``make``, ``reset``, ``step`` (the second one) or ``state``."""

    def __init__(self, where, error=RuntimeError, **kwargs):
        super().__init__(**kwargs)
        self.where, self.error = where, error
        self.fail("make")

    def fail(self, where):
        if self.where == where:
            raise self.error(f"the {where} of this world is broken")

    def reset(self, seed=None, options=None):
        self.fail("reset")
        return super().reset(seed, options)

    def step(self, actions):
        if self.t == 1:
            self.fail("step")
            if self.where == "number":
                self.places["scout_1"] = np.nan
            if self.where == "death":
                os.kill(os.getpid(), signal.SIGKILL)
        return super().step(actions)

    def get_state(self):
        self.fail("state")


def away(make, n_envs=2, seed=0, **kwargs):
    return make_vec_env(make, n_envs, seed, vec_env_cls=SubprocVecEnv, **kwargs)


def zeros(env):
    return np.zeros((env.num_envs, *env.action_space.shape), env.action_space.dtype)


WORLDS = {
    "HardSpread-v0": {"n_agents": 2, "max_steps": 9},
    "Grassland-v0": {"n_wolves": 3, "n_sheep": 2, "max_steps": 12, "continuous_actions": False},
    "mpe2/simple_tag_v3": {"continuous_actions": True, "max_cycles": 8},
}


@pytest.mark.parametrize("world", WORLDS)
def test_worlds_step_alike_in_one_process_and_in_many(world):
    """Observations, rewards, ends and infos of several episodes, world i seeded with seed + i."""
    if "/" in world:
        pytest.importorskip(world.partition("/")[0])
    runs = []
    for vec_env_cls in (SubprocVecEnv, DummyVecEnv):
        env = make_vec_env(world, 2, 5, WORLDS[world], vec_env_cls=vec_env_cls)
        env.action_space.seed(1)
        run = [env.reset()]
        for _ in range(20):
            *arrays, infos = env.step(np.stack([env.action_space.sample() for _ in range(2)]))
            run += [*arrays, *(value for info in infos for _, value in sorted(info.items()) if isinstance(value, np.ndarray))]
        env.close()
        runs.append(run)
    assert len(runs[0]) == len(runs[1]) > 100
    for ours, theirs in zip(*runs, strict=True):
        np.testing.assert_array_equal(ours, np.asarray(theirs, ours.dtype))


def test_our_worlds_are_seeded_alike_in_every_vec_env():
    envs = [make_vec_env("HardSpread-v0", 2, 5, WORLDS["HardSpread-v0"], vec_env_cls=cls) for cls in (None, SubprocVecEnv)]
    rows = [env.reset() for env in envs]
    envs[1].close()
    np.testing.assert_array_equal(*rows)
    assert not np.array_equal(rows[0][0], rows[0][1])


def fail(where, **kwargs):
    """Let a world fail; the seconds since all worlds ran are in ``fail.seconds``."""
    env = away(functools.partial(Failing, where, **kwargs))
    start = time.monotonic()
    try:
        env.reset()
        env.step(zeros(env))
        env.step(zeros(env))
        env.env_method("get_state")
    finally:
        fail.seconds = time.monotonic() - start


@pytest.mark.parametrize("where", ["make", "reset", "step", "state"])
def test_an_error_comes_with_its_traceback(where):
    with pytest.raises(WorkerError) as caught:
        fail(where)
    lines = str(caught.value).splitlines()
    assert lines[0] in ("world 0 failed in its process:", "world 1 failed in its process:")  # both do
    assert lines[1] == "Traceback (most recent call last):"
    assert lines[-1] == f"RuntimeError: the {where} of this world is broken"
    assert any("test_subproc.py" in line for line in lines)
    if where != "make":
        assert fail.seconds < SOON


def test_the_world_that_failed_is_named():
    env = TracedSubprocVecEnv([_fine, functools.partial(_joint, "reset")])
    with pytest.raises(WorkerError, match="world 1 failed"):
        env.reset()


def test_a_world_that_cannot_be_made_is_named():
    with pytest.raises(WorkerError, match=r"world 1 failed(.|\n)*the make of this world"):
        TracedSubprocVecEnv([_fine, functools.partial(_joint, "make")])


def _joint(where):
    return JointEnv(Failing(where))


def _fine():
    return _joint("nowhere")


def test_bad_settings_are_refused_as_in_one_process():
    with pytest.raises(ValueError, match='unknown setting of HardSpread-v0 "n_agnts"; did you mean "n_agents"') as caught:
        away("HardSpread-v0", env_kwargs={"n_agnts": 2})
    assert isinstance(caught.value.__cause__, WorkerError)


def test_a_number_that_is_not_finite_is_refused_as_in_one_process():
    with pytest.raises(NonFiniteError, match="observation of scout_1"):
        fail("number", with_state=False)


def test_a_process_that_is_killed_is_not_waited_for():
    with pytest.raises(WorkerError, match=r"process of world [01] has ended \(by SIGKILL"):
        fail("death")
    assert fail.seconds < SOON


def test_no_process_is_left_after_a_failure():
    env = TracedSubprocVecEnv([_fine, functools.partial(_joint, "reset")])
    with pytest.raises(WorkerError):
        env.reset()
    assert not any(process.is_alive() for process in env.processes)
    env.close()


def test_a_missing_attribute_is_no_end_of_the_world():
    env = away(_toy)
    with pytest.raises(AttributeError, match="no attribute 'colour'"):
        env.get_attr("colour")
    with pytest.raises(AttributeError, match="no attribute 'paint'"):
        env.env_method("paint")
    assert env.reset().shape == (2, 8)
    env.close()


def test_a_process_outlives_ctrl_c():
    """The terminal sends it to all; the process that trains finishes its step and writes a checkpoint."""
    env = away(_toy)
    env.reset()
    for process in env.unwrapped.processes:
        os.kill(process.pid, signal.SIGINT)
    env.step(zeros(env))
    env.close()


def test_forked_processes_are_refused():
    with pytest.raises(ValueError, match=r'start_method is "fork".*give "forkserver" or "spawn"'):
        away(_toy, vec_env_kwargs={"start_method": "fork"})


def test_arguments_of_no_vec_env_are_refused():
    with pytest.raises(ValueError, match="vec_env_kwargs are for a vec_env_cls"):
        make_vec_env("HardSpread-v0", vec_env_kwargs={"start_method": "spawn"})


def _toy(**kwargs):
    return ToyParallelEnv(time_limit=3, **kwargs)


def test_training_saving_and_evaluating(tmp_path):
    env = VecNormalize(away(_toy), norm_reward=False)
    model = MADDPG("MlpPolicy", env, seed=0, **QUICK).learn(40)
    assert layout_of(env).agents == ("scout_0", "scout_1", "tank_0")
    assert evaluate_policy(model, env, n_eval_episodes=2) == (12.0, 0.0)  # mean rewards 2, 4, 6
    model.save(tmp_path / "model")
    MADDPG.load(tmp_path / "model", env).learn(20)
    env.close()


def test_a_training_goes_on_in_new_episodes(tmp_path):
    """The worlds' state lies in other processes: the checkpoint goes without it, and says so."""
    env = away(_toy)
    model = MADDPG("MlpPolicy", env, seed=0, **QUICK)
    with pytest.warns(UserWarning, match="state of TracedSubprocVecEnv cannot be read"):
        model.learn(20, Checkpoints(tmp_path, save_freq=10))
    with pytest.warns(UserWarning, match="state of TracedSubprocVecEnv cannot be read"):
        model.learn(40, Checkpoints(tmp_path, save_freq=10, resume=True))
    assert model.num_timesteps == 40
    env.close()
