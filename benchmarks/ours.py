"""
Our side of the benchmarks: learners of wanted sizes with a full buffer, worlds with random actions, trainings timed in blocks.

As a script it is an adapter like those of the peers (see ``peers/protocol.py``):

    python benchmarks/ours.py update-4 --repeats 5
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import cycle, islice, pairwise
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from peers.protocol import (
    BATCH_SIZE,
    BUFFER_SIZE,
    EPISODE_STEPS,
    GAMMA,
    HIDDEN,
    LEARNING_RATE,
    SPREAD_AGENTS,
    TAG_SHEEP,
    TAG_WOLVES,
    TAU,
    TRAINING_AGENTS,
    UPDATES,
    Work,
    cases,
    main,
)
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_kfcv import MADDPG, PERMADDPG, make_vec_env
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.envs.grassland import GrasslandWorlds
from sb3_kfcv.envs.hard_spread import HardSpreadWorlds
from sb3_kfcv.envs.particle_worlds import ParticleWorlds
from sb3_kfcv.vec_env.joint_env import joint_box

PACKAGES = ["sb3-kfcv", "stable_baselines3", "torch", "numpy", "numba"]
STATE_SIZE = 150
"""Of the world's state in the case of 28 agents."""
REFRESHED = 250 * 35
"""Transitions that a refresh works on at most, at the defaults: ``refresh_every`` times ``scored_per_update``."""


class RandomWorld(gym.Env):
    """A world of wanted sizes, for learners that are timed without one; it cannot be stepped."""

    def __init__(self, n_agents: int, obs_size: int, action_size: int, state_size: int) -> None:
        names = [f"agent_{i}" for i in range(n_agents)]
        observations: dict[str, spaces.Space] = {name: spaces.Box(-np.inf, np.inf, (obs_size,), np.float32) for name in names}
        actions: dict[str, spaces.Space] = {name: spaces.Box(-1.0, 1.0, (action_size,), np.float32) for name in names}
        self.layout = AgentLayout.from_spaces(names, observations, actions, state_size)
        self.observation_space, self.action_space = joint_box(list(observations.values())), joint_box(list(actions.values()))


def learner(
    n_agents: int,
    obs_size: int,
    action_size: int,
    algorithm: type[MADDPG] = MADDPG,
    buffer_size: int = BUFFER_SIZE,
    n_envs: int = 1,
    state_size: int = STATE_SIZE,
    hidden: Sequence[int] = HIDDEN,
    **settings: Any,
) -> MADDPG:
    """
    A learner whose buffer is full of random transitions.

    :param n_agents: number of agents
    :param obs_size: observations of each
    :param action_size: actions of each
    :param algorithm: MADDPG or one with another replay
    :param buffer_size: transitions held
    :param n_envs: worlds that fill the buffer
    :param state_size: of the world's state
    :param hidden: sizes of the hidden layers
    :param settings: of the algorithm
    """
    th.set_num_threads(1)
    env = DummyVecEnv([partial(RandomWorld, n_agents, obs_size, action_size, state_size)] * n_envs)
    model = algorithm(
        "MlpPolicy",
        env,
        learning_rate=LEARNING_RATE,
        buffer_size=buffer_size,
        batch_size=BATCH_SIZE,
        tau=TAU,
        gamma=GAMMA,
        policy_kwargs={"net_arch": list(hidden)},
        seed=0,
        device="cpu",
        **settings,
    )
    model.set_logger(configure(None, []))
    for step in islice(cycle(random_steps(model)), model.replay_buffer.buffer_size):
        model.replay_buffer.add(*step)
    return model


def random_steps(model: MADDPG, n_steps: int = 10 * EPISODE_STEPS) -> list[tuple[Any, ...]]:
    """
    Steps of all worlds as a buffer's ``add`` takes them, one after the other: what one step ends with, the next begins with,
    but where an episode reaches its time limit.
    """
    layout, n_envs, rng = model.layout, model.n_envs, np.random.default_rng(0)
    observations = rng.standard_normal((n_steps + 1, n_envs, sum(layout.obs_sizes)), dtype=np.float32)
    states = rng.standard_normal((n_steps + 1, n_envs, layout.state_size), dtype=np.float32)
    steps = []
    for t in range(n_steps):
        ends = (t + 1) % EPISODE_STEPS == 0
        last, last_states = (-observations[t], -states[t]) if ends else (observations[t + 1], states[t + 1])
        infos = [
            {
                "agent_rewards": rng.standard_normal(layout.n_agents, dtype=np.float32),
                "agent_terminated": np.zeros(layout.n_agents, dtype=bool),
                "agent_alive": np.ones(layout.n_agents, dtype=bool),
                "state": states[t, world],
                "next_state": last_states[world],
                "TimeLimit.truncated": ends,
            }
            for world in range(n_envs)
        ]
        actions = rng.random((n_envs, sum(layout.action_sizes)), dtype=np.float32)
        steps.append((observations[t], last, actions, np.zeros(n_envs), np.full(n_envs, ends), infos))
    return steps


def update(n_agents: int, obs_size: int, action_size: int, critic_input: str = "observations") -> Work:
    """``train(1)``: draw a minibatch, update all critics, actors and targets."""
    model = learner(n_agents, obs_size, action_size, critic_input=critic_input)
    return Work(lambda: model.train(1, BATCH_SIZE))


def predict(n_agents: int, obs_size: int, action_size: int, n_rows: int) -> Work:
    """``predict``: what all agents do, given joint observations."""
    model = learner(n_agents, obs_size, action_size, buffer_size=BATCH_SIZE)
    rows = np.random.default_rng(0).standard_normal((n_rows, n_agents * obs_size), dtype=np.float32)
    return Work(lambda: model.predict(rows, deterministic=True), note="NumPy to NumPy")


def simulate(worlds: ParticleWorlds) -> Work:
    """Steps of all worlds with random actions that were drawn before; worlds whose episode is over start anew."""
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (EPISODE_STEPS, worlds.n_worlds, worlds.n_agents, 2))
    worlds.seed(range(worlds.n_worlds))
    worlds.reset()

    def steps() -> None:
        for forces in actions:
            if worlds.step(forces):
                worlds.reset(np.flatnonzero(worlds.episode_terminated | worlds.episode_truncated))

    return Work(steps, EPISODE_STEPS * worlds.n_worlds)


def spread(n_worlds: int) -> Work:
    """As simple_spread: no walls."""
    work = simulate(HardSpreadWorlds(n_worlds, SPREAD_AGENTS, walls="none", max_steps=EPISODE_STEPS))
    work.note = "without walls, continuous actions, observations 18, starts anew by itself"
    return work


def tag(n_worlds: int) -> Work:
    """Grassland, the nearest to simple_tag with many agents."""
    worlds = GrasslandWorlds(n_worlds, TAG_WOLVES, TAG_SHEEP, max_steps=EPISODE_STEPS)
    work = simulate(worlds)
    work.note = (
        f"Grassland, continuous actions, observations {worlds.obs_sizes[0]}; food, obstacles, deaths; starts anew by itself"
    )
    return work


def sample(algorithm: type[MADDPG], note: str) -> Work:
    """Draw a minibatch from a full buffer of 28 agents."""
    model = learner(*UPDATES["update-28"], algorithm)
    model.replay_buffer.update_priorities(np.arange(BUFFER_SIZE), th.rand(BUFFER_SIZE, dtype=th.float64))
    return Work(lambda: model.replay_buffer.sample(BATCH_SIZE), note=note)


def add(algorithm: type[MADDPG]) -> Work:
    """Store one joint transition of 28 agents."""
    model = learner(*UPDATES["update-28"], algorithm)
    steps = cycle(random_steps(model))
    return Work(lambda: model.replay_buffer.add(*next(steps)), note="per-agent values from the infos of the env")


def priorities() -> Work:
    model, rng = learner(*UPDATES["update-28"], PERMADDPG), np.random.default_rng(0)
    rows, errors = rng.integers(BUFFER_SIZE, size=BATCH_SIZE), th.as_tensor(rng.random(BATCH_SIZE))
    return Work(lambda: model.replay_buffer.update_priorities(rows, errors), note="by rank (ranked at the next draw)")


def in_turn() -> Work:
    """A draw, and the priorities of what was drawn."""
    buffer, rng = learner(*UPDATES["update-28"], PERMADDPG).replay_buffer, np.random.default_rng(0)
    errors = th.as_tensor(rng.random(BATCH_SIZE))
    return Work(lambda: buffer.update_priorities(buffer.sample(BATCH_SIZE).rows, errors), note="by rank, returns tensors")


def end_to_end(
    algorithm: type[MADDPG],
    world: str,
    steps_per_update: int,
    block_steps: int,
    repeats: int,
    env_kwargs: dict[str, Any] | None = None,
    **settings: Any,
) -> list[float]:
    """
    Train, as many worlds as env steps per update, so that every round of steps is followed by one update.

    :param algorithm: with its default replay
    :param world: id of the environment
    :param steps_per_update: env steps per update
    :param block_steps: env steps of a block
    :param repeats: number of blocks, after the buffer has been filled and one more has warmed up
    :param env_kwargs: settings of the world
    :param settings: of the algorithm
    :return: seconds per env step of each block
    """
    th.set_num_threads(1)
    model = algorithm(
        "MlpPolicy",
        make_vec_env(world, steps_per_update, 0, env_kwargs),
        buffer_size=BUFFER_SIZE,
        batch_size=BATCH_SIZE,
        learning_starts=BUFFER_SIZE,
        seed=0,
        device="cpu",
        **settings,
    )
    rounds = max(block_steps // steps_per_update, 1)
    clock = Clock()
    warm_up = BUFFER_SIZE // steps_per_update + rounds
    model.learn((warm_up + repeats * rounds + 1) * steps_per_update, clock, log_interval=None)
    marks = clock.marks[warm_up::rounds]
    return [(end - start) / (rounds * steps_per_update) for start, end in pairwise(marks)][:repeats]


class Clock(BaseCallback):
    """Notes the time of every round of steps."""

    def __init__(self) -> None:
        super().__init__()
        self.marks: list[float] = []

    def _on_step(self) -> bool:
        self.marks.append(time.perf_counter())
        return True


def train(steps_per_update: int) -> Work:
    """Cooperative navigation without walls, as simple_spread."""
    env_kwargs = {"n_agents": TRAINING_AGENTS, "walls": "none", "max_steps": EPISODE_STEPS}

    def timed(repeats: int) -> list[float]:
        return end_to_end(MADDPG, "HardSpread-v0", steps_per_update, 50 * steps_per_update, repeats, env_kwargs)

    return Work(timed=timed, note=f"HardSpread without walls, {steps_per_update} worlds, actions of 2")


CASES: dict[str, Callable[[], Work]] = {
    **cases(update=update, predict=predict, spread=spread, tag=tag, train=train),
    "update-28-state": partial(update, *UPDATES["update-28"], "state"),
    "update-28-own_observation": partial(update, *UPDATES["update-28"], "own_observation"),
    "uniform-sample": partial(sample, MADDPG, "returns tensors"),
    "uniform-add": partial(add, MADDPG),
    "per-sample": partial(sample, PERMADDPG, "by rank, returns tensors"),
    "per-priorities": priorities,
    "per-turn": in_turn,
    "per-add": partial(add, PERMADDPG),
}

if __name__ == "__main__":
    main(PACKAGES, CASES)
