"""Learning to a threshold, minutes long: ``make test-expensive``."""

import numpy as np
import pytest

from sb3_kfcv import KFCVMADDPG, MADDPG, PERMADDPG, make_vec_env
from sb3_kfcv.common.evaluation import evaluate
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import layout_of

ALGOS = [MADDPG, PERMADDPG, KFCVMADDPG]
EVAL_SEED = 1_000_000


def mean_of(metric, world, players, env_kwargs, episodes=512):
    env = make_vec_env(world, 64, EVAL_SEED, env_kwargs)
    played = evaluate(TeamPolicy(layout_of(env), players, np.random.default_rng(0)), env, episodes)
    return played[metric].mean()


@pytest.mark.expensive
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("algo", ALGOS)
def test_two_agents_learn_to_cover_landmarks_in_the_open(algo, seed):
    """At least 80 % of the way from random to greedy-assigned, in a minute or so."""
    world, env_kwargs = "HardSpread-v0", {"n_agents": 2, "walls": "none"}
    model = algo("MlpPolicy", make_vec_env(world, 32, seed, env_kwargs), seed=seed, device="cpu", **OPEN_SPREAD)
    model.learn(150_000, log_interval=None)
    low, high, learnt = (
        mean_of("return_agent", world, {"agent": player}, env_kwargs) for player in ("random", "greedy-assigned", model)
    )
    assert (learnt - low) / (high - low) >= 0.8


@pytest.mark.expensive
@pytest.mark.parametrize("algo", ALGOS)
def test_wolves_learn_to_hunt_grazing_sheep(algo):
    """Four wolves that learn eat clearly more of three grazing sheep than random wolves do."""
    world, env_kwargs, seed = "Grassland-v0", {"n_wolves": 4, "n_sheep": 3}, 1
    env = make_vec_env(world, 32, seed, env_kwargs)
    model = algo("MlpPolicy", env, team="wolf", opponents={"sheep": "graze"}, seed=seed, device="cpu", **HUNT)
    model.learn(100_000, log_interval=None)
    random, learnt = (
        mean_of("sheep_eaten", world, {"wolf": player, "sheep": "graze"}, env_kwargs) for player in ("random", model)
    )
    assert learnt > random + 0.1


OPEN_SPREAD = {"gamma": 0.95, "buffer_size": 50_000, "learning_starts": 2000}
HUNT = {
    "gamma": 0.95,
    "buffer_size": 50_000,
    "learning_starts": 5000,
    "critic_input": "own_observation",
    "batch_size": 256,
    "max_grad_norm": 0.5,
}
