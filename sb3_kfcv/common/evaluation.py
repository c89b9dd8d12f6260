"""What a policy reaches: greedy episodes in parallel worlds, every metric of each episode, and intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit
from stable_baselines3.common.vec_env import VecEnv

from sb3_kfcv.teams.players import JointModel

CONFIDENCE = 0.95


def rounded(value: float, decimals: int = 2) -> float:
    """A number as it is to be shown with so many decimals: nothing becomes ``-0.00``."""
    return round(float(value), decimals) + 0.0


class Interval(NamedTuple):
    """A mean and its 95 % confidence interval."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{rounded(self.mean):.2f} ± {(self.high - self.low) / 2:.2f}"


def evaluate(policy: JointModel, env: VecEnv, n_episodes: int, deterministic: bool = True) -> dict[str, np.ndarray]:
    """
    Play episodes to their end.

    Each world plays its share of the episodes, fixed beforehand: worlds with short episodes count no more than others.
    The worlds are reset first and go on with their own random generators, so every call sees fresh ones.

    :param policy: a model, a :class:`~sb3_kfcv.teams.team_policy.TeamPolicy`, or whatever acts on joint rows
    :param env: vec env of joint worlds, monitored or not; a ``VecNormalize`` should have ``training=False``
    :param n_episodes: number of episodes
    :param deterministic: without exploration
    :return: ``reward`` (the sum of the scalar rewards), ``length`` (steps) and each of the worlds' episode metrics,
        every one (episodes,), in the order in which the episodes ended
    :raises ValueError: for less than one episode
    """
    if n_episodes < 1:
        raise ValueError(f"n_episodes is {n_episodes}; it must be at least 1")
    shares = (n_episodes + np.arange(env.num_envs)) // env.num_envs
    played = np.zeros(env.num_envs, dtype=int)
    rewards_so_far, steps_so_far = np.zeros(env.num_envs), np.zeros(env.num_envs, dtype=int)
    episodes: list[dict[str, float]] = []

    observations, starts, memory = env.reset(), np.ones(env.num_envs, dtype=bool), None
    while len(episodes) < n_episodes:
        actions, memory = policy.predict(observations, state=memory, episode_start=starts, deterministic=deterministic)
        observations, rewards, dones, infos = env.step(actions)
        starts = dones
        rewards_so_far += rewards
        steps_so_far += 1
        for i in np.flatnonzero(dones):
            if played[i] < shares[i]:
                metrics = infos[i].get("episode_metrics", {})
                episodes.append({"reward": rewards_so_far[i], "length": steps_so_far[i], **metrics})
                played[i] += 1
            rewards_so_far[i], steps_so_far[i] = 0.0, 0
    return {name: np.array([episode[name] for episode in episodes]) for name in episodes[0]}


def with_interval(values: np.ndarray) -> Interval:
    """
    Mean over episodes and its 95 % confidence interval, by Student's t.

    :param values: (episodes,); a single one has no interval, its bounds are NaN
    """
    values = np.asarray(values, dtype=float)
    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, np.nan, np.nan)
    half_width = float(stdtrit(len(values) - 1, (1 + CONFIDENCE) / 2) * values.std(ddof=1) / np.sqrt(len(values)))
    return Interval(mean, mean - half_width, mean + half_width)


def share_with_interval(values: np.ndarray) -> Interval:
    """
    Mean over episodes of a share, such as of the episodes won, and its 95 % confidence interval by Wilson's score, which stays
    within [0, 1] and says something for 0 and 1, too.

    :param values: in [0, 1] (episodes,)
    """
    values = np.asarray(values, dtype=float)
    n, share = len(values), float(values.mean())
    z = float(ndtri((1 + CONFIDENCE) / 2))
    centre = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half_width = z / (1 + z**2 / n) * float(np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2)))
    return Interval(share, max(centre - half_width, 0.0), min(centre + half_width, 1.0))
