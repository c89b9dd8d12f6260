"""The one place that builds envs: from a name, a parallel env, or whatever the user holds."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import aec_to_parallel
from stable_baselines3.common.env_util import make_vec_env as sb3_make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, is_vecenv_wrapped

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.envs.grassland import GrasslandWorlds
from sb3_kfcv.envs.hard_spread import HardSpreadWorlds
from sb3_kfcv.envs.parallel_env import ParticleParallelEnv
from sb3_kfcv.envs.particle_worlds import ParticleWorlds
from sb3_kfcv.vec_env.joint_env import JointEnv
from sb3_kfcv.vec_env.particle_vec_env import ParticleVecEnv

WORLDS: dict[str, type[ParticleWorlds]] = {"Grassland-v0": GrasslandWorlds, "HardSpread-v0": HardSpreadWorlds}


def make_joint_env(world: str, reward: str = "default", **kwargs: Any) -> JointEnv:
    """
    One world as a Gymnasium env; the entry point of the gym ids.

    :param world: ``"Grassland-v0"`` or ``"HardSpread-v0"``
    :param reward: see :class:`JointEnv`
    :param kwargs: settings of the world
    """
    render_mode = kwargs.pop("render_mode", None)
    return JointEnv(ParticleParallelEnv(make_worlds(world, 1, kwargs), world, render_mode), reward)


def make_worlds(world: str, n_worlds: int, env_kwargs: dict[str, Any] | None = None) -> ParticleWorlds:
    """
    The compiled core of one of the project's worlds.

    :param world: its id
    :param n_worlds: how many of them step together
    :param env_kwargs: settings of the world
    :raises ValueError: for a setting that the world does not have, with the nearest one
    """
    worlds_class = WORLDS[world]
    settings = set(inspect.signature(worlds_class).parameters) - {"n_worlds"}
    for name in env_kwargs or {}:
        if name not in settings:
            raise ValueError(unknown_name(f"setting of {world}", name, settings))
    return worlds_class(n_worlds=n_worlds, **(env_kwargs or {}))


def make_vec_env(
    env_id: str | Callable[[], Any],
    n_envs: int = 1,
    seed: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    monitor_file: str | None = None,
    reward: str = "default",
) -> VecEnv:
    """
    ``n_envs`` worlds behind one ``VecEnv``, monitored: compiled together for the project's worlds, a ``DummyVecEnv`` else.

    :param env_id: a gym id, or a function that makes a gym env or a PettingZoo env
    :param n_envs: number of worlds
    :param seed: world i is seeded with ``seed + i``
    :param env_kwargs: settings of the world
    :param monitor_file: where the episodes' returns, lengths and metrics are written as CSV
    :param reward: the world's scalar reward, see :class:`JointEnv`
    :raises ValueError: for an unknown id, with the nearest one
    """
    if isinstance(env_id, str) and env_id not in gym.registry:
        raise ValueError(unknown_name("environment", env_id, [*WORLDS, *gym.registry]))
    env_kwargs = dict(env_kwargs or {})
    if env_id in WORLDS:
        render_mode = env_kwargs.pop("render_mode", None)
        venv: VecEnv = ParticleVecEnv(make_worlds(str(env_id), n_envs, env_kwargs), reward, render_mode)
        if seed is not None:
            venv.seed(seed)
    else:
        make = env_id if callable(env_id) else lambda **kwargs: gym.make(env_id, **kwargs)
        venv = sb3_make_vec_env(lambda **kwargs: as_gym_env(make(**kwargs)), n_envs, seed, env_kwargs=env_kwargs)
    return VecMonitor(venv, monitor_file, info_keywords=metric_names_of(venv))


def as_gym_env(env: Any) -> Any:
    """A PettingZoo env as a :class:`JointEnv`; anything else unchanged."""
    if isinstance(env, AECEnv):
        env = aec_to_parallel(env)
    return JointEnv(env) if isinstance(env, ParallelEnv) else env


def wrap_env(env: Any, monitor: bool = True) -> Any:
    """
    What the user hands to an algorithm, as SB3 takes it: PettingZoo envs joined, episodes monitored.

    :param env: a gym env, a PettingZoo env or a ``VecEnv``
    :param monitor: whether episodes are to be monitored
    """
    env = as_gym_env(env)
    if isinstance(env, VecEnv):
        monitored = is_vecenv_wrapped(env, VecMonitor) or any(env.env_is_wrapped(Monitor))
        return env if monitored or not monitor else VecMonitor(env)
    return env


def layout_of(env: VecEnv) -> AgentLayout:
    """
    The agent layout that a vec env carries.

    :raises ValueError: if it carries none
    """
    try:
        return env.get_attr("layout", [0])[0]
    except AttributeError:
        raise ValueError(
            f"the env ({env.observation_space}, {env.action_space}) is no multi-agent world: it has no agent layout. "
            "Give a PettingZoo parallel env or a JointEnv"
        ) from None


def wins_of(env: VecEnv) -> dict[str, str]:
    """
    Who can win, and the episode metric that tells how far: group → name of a metric in [0, 1]. Where two groups meet and one
    of them is named, the other one wins the rest. Empty if the world does not say; it says so by an attribute ``wins``.
    """
    try:
        return dict(env.get_attr("wins", [0])[0])
    except AttributeError:
        return {}


def metric_names_of(env: VecEnv) -> tuple[str, ...]:
    """Names of the episode metrics of a vec env; none if it declares none."""
    try:
        return tuple(env.get_attr("metric_names", [0])[0])
    except AttributeError:
        return ()
