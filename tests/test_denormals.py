"""Updates do not leave numbers behind that processors are slow with."""

import sys

import torch as th
from references import fill
from stable_baselines3.common.logger import Logger
from toy_envs import ToyParallelEnv

from sb3_kfcv import MADDPG
from sb3_kfcv.common.denormals import without_denormals


def halved():
    """Half of the smallest normal number, in Python and in a tensor."""
    smallest = sys.float_info.min
    return smallest / 2, (th.full((64,), 1.2e-38) / 2).sum().item()


def test_they_are_flushed_inside_and_kept_outside():
    assert min(halved()) > 0
    with without_denormals():
        assert halved() == (0, 0)
        with without_denormals():
            assert halved() == (0, 0)
        assert halved() == (0, 0)
    assert min(halved()) > 0


def test_what_somebody_else_has_set_stays():
    th.set_flush_denormal(True)
    try:
        with without_denormals():
            pass
        assert halved() == (0, 0)
    finally:
        th.set_flush_denormal(False)


def test_moments_of_dead_units_become_nought():
    """Critics whose first layers are dead: the gradient is 0, and Adam's moments fall by a tenth at each step."""
    model = MADDPG("MlpPolicy", ToyParallelEnv(), buffer_size=64, batch_size=8, policy_kwargs={"net_arch": [4]}, device="cpu")
    model.set_logger(Logger(None, []))
    fill(model.replay_buffer, model.layout, 64)
    model.train(3, 8)
    with th.no_grad():
        model.critic.stacks[0].first.bias.fill_(-1e6)
    moments = model.critic.optimizer.state[model.critic.stacks[0].first.weight]["exp_avg"]
    assert (moments != 0).any()
    for _ in range(10):
        model.train(100, 8)
    assert not ((moments != 0) & (moments.abs() < th.finfo(th.float32).tiny)).any()
