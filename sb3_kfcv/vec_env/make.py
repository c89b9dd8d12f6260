"""The one place that builds envs: from a name, a parallel env, or whatever the user holds."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import aec_to_parallel
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecMonitor, is_vecenv_wrapped

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.envs.grassland import GrasslandWorlds
from sb3_kfcv.envs.hard_spread import HardSpreadWorlds
from sb3_kfcv.envs.parallel_env import ParticleParallelEnv
from sb3_kfcv.envs.particle_worlds import ParticleWorlds
from sb3_kfcv.vec_env.joint_env import JointEnv
from sb3_kfcv.vec_env.named_worlds import find_world, world_names
from sb3_kfcv.vec_env.particle_vec_env import ParticleVecEnv
from sb3_kfcv.vec_env.subproc import TracedSubprocVecEnv

WORLDS: dict[str, type[ParticleWorlds]] = {"Grassland-v0": GrasslandWorlds, "HardSpread-v0": HardSpreadWorlds}


def make_joint_env(world: str, reward: str = "default", **kwargs: Any) -> JointEnv:
    """
    One world as a Gymnasium env; the entry point of the gym ids.

    :param world: ``"Grassland-v0"`` or ``"HardSpread-v0"``
    :param reward: see :class:`JointEnv`
    :param kwargs: settings of the world
    """
    return JointEnv(make_parallel_env(world, **kwargs), reward)


def make_parallel_env(world: str, render_mode: str | None = None, **kwargs: Any) -> ParticleParallelEnv:
    """
    One of the project's worlds for PettingZoo.

    :param world: its id
    :param render_mode: see :class:`~sb3_kfcv.envs.parallel_env.ParticleParallelEnv`
    :param kwargs: settings of the world
    """
    return ParticleParallelEnv(make_worlds(world, 1, kwargs), world, render_mode)


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
    env_id: str | Callable[..., Any],
    n_envs: int = 1,
    seed: int | None = None,
    env_kwargs: dict[str, Any] | None = None,
    monitor_file: str | None = None,
    reward: str = "default",
    wrappers: Sequence[Callable[[Any], ParallelEnv]] = (),
    vec_env_cls: type[DummyVecEnv | SubprocVecEnv] | None = None,
    vec_env_kwargs: dict[str, Any] | None = None,
) -> VecEnv:
    """
    ``n_envs`` worlds behind one ``VecEnv``, monitored. Without ``wrappers`` and ``vec_env_cls`` the project's own worlds step
    together, compiled; all others one after the other.

    :param env_id: one of the project's worlds, a world of PettingZoo such as ``"mpe2/simple_tag_v3"`` or ``"sisl/pursuit_v5"``
        (see :func:`~sb3_kfcv.vec_env.named_worlds.find_world`), a gym id, or a function that makes a gym env or a PettingZoo
        env
    :param n_envs: number of worlds
    :param seed: world i is seeded with ``seed + i``, whatever vec env they are in
    :param env_kwargs: settings of the world
    :param monitor_file: where the episodes' returns, lengths and metrics are written as CSV
    :param reward: the world's scalar reward, see :class:`JointEnv`
    :param wrappers: put around the parallel env, the first one innermost, before its agents are joined: SuperSuit's
        pre-processing, for instance ``functools.partial(supersuit.frame_stack_v2, stack_size=3)``
    :param vec_env_cls: ``SubprocVecEnv`` steps each world in a process of its own (as
        :class:`~sb3_kfcv.vec_env.subproc.TracedSubprocVecEnv`); ``DummyVecEnv`` steps them here
    :param vec_env_kwargs: arguments of ``vec_env_cls``, such as ``start_method``
    :raises ValueError: for an unknown id, with the nearest one; for an unknown setting; for what cannot be joined
    :raises gymnasium.error.DependencyNotInstalled: if the world's package is missing, with the command that installs it
    """
    if vec_env_kwargs and vec_env_cls is None:
        raise ValueError(f"vec_env_kwargs are for a vec_env_cls, and there is none: {vec_env_kwargs}")
    env_kwargs = dict(env_kwargs or {})
    if env_id in WORLDS and not wrappers and vec_env_cls is None:
        render_mode = env_kwargs.pop("render_mode", None)
        venv: VecEnv = ParticleVecEnv(make_worlds(str(env_id), n_envs, env_kwargs), reward, render_mode)
    else:
        make = env_id if callable(env_id) else maker_of(env_id)
        make_world = partial(make_wrapped, make, env_kwargs, tuple(wrappers), reward)
        vec_env_class = TracedSubprocVecEnv if vec_env_cls is SubprocVecEnv else vec_env_cls or DummyVecEnv
        venv = vec_env_class([make_world] * n_envs, **(vec_env_kwargs or {}))
    if seed is not None:
        venv.seed(seed)
    return VecMonitor(venv, monitor_file, info_keywords=metric_names_of(venv))


def maker_of(env_id: str) -> Callable[..., Any]:
    """
    What makes one env of an id.

    :param env_id: see :func:`make_vec_env`
    :return: takes the settings by name
    :raises ValueError: for an unknown id, with the nearest one
    :raises gymnasium.error.DependencyNotInstalled: if the world's package is missing, with the command that installs it
    """
    if env_id in WORLDS:
        return partial(make_parallel_env, env_id)
    if env_id in gym.registry:
        return partial(gym.make, gym.registry[env_id])
    world = find_world(env_id)
    if world is None:
        raise ValueError(unknown_environment(env_id))
    return world.make


def env_named(env: Any) -> Any:
    """
    The world that a name means, where gymnasium does not know it (it makes those that it does); whatever else is given stays.

    :param env: a name, or an env
    :raises ValueError: for an unknown name, with the nearest one
    """
    if not isinstance(env, str) or env in gym.registry or ":" in env:  # gymnasium imports module:id
        return env
    return maker_of(env)()


def unknown_environment(env_id: str) -> str:
    """The message for an id that stands for no env."""
    return unknown_name("environment", env_id, [*WORLDS, *gym.registry, *world_names()])


def make_wrapped(
    make: Callable[..., Any], env_kwargs: dict[str, Any], wrappers: Sequence[Callable[[Any], ParallelEnv]], reward: str
) -> gym.Env:
    """
    One world as a Gymnasium env.

    :param make: makes a PettingZoo env, or a gym env
    :param env_kwargs: its settings
    :param wrappers: put around the parallel env
    :param reward: see :class:`JointEnv`
    :raises ValueError: for wrappers or a reward that the env cannot have
    """
    env = as_parallel_env(make(**env_kwargs))
    if not isinstance(env, ParallelEnv) and (wrappers or reward != "default"):
        raise ValueError(f"wrappers and reward are for PettingZoo envs; {env} is none")
    for wrapper in wrappers:
        env = wrapper(env)
        if not isinstance(env, ParallelEnv):
            raise ValueError(f"the wrapper {wrapper} made {env}; it must make a PettingZoo parallel env")
    return JointEnv(env, reward) if isinstance(env, ParallelEnv) else env


def as_parallel_env(env: Any) -> Any:
    """
    A PettingZoo env whose agents act in turn as one in which they act at once; anything else unchanged.

    :raises ValueError: for a game in which turns matter
    """
    if not isinstance(env, AECEnv):
        return env
    if not env.metadata.get("is_parallelizable", False):
        raise ValueError(
            f"the agents of {env} act in turn (its metadata do not say is_parallelizable); in a joint world all act at once"
        )
    return aec_to_parallel(env)


def as_gym_env(env: Any) -> Any:
    """A PettingZoo env as a :class:`JointEnv`; anything else unchanged."""
    env = as_parallel_env(env)
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

    :raises ValueError: if it carries none, or one for other observations
    """
    if not env.has_attr("layout"):
        raise ValueError(
            f"the env ({env.observation_space}, {env.action_space}) is no multi-agent world: it has no agent layout. "
            "Give a PettingZoo parallel env or a JointEnv"
        )
    layout: AgentLayout = env.get_attr("layout", [0])[0]
    if env.observation_space.shape != (sum(layout.obs_sizes),):
        raise ValueError(
            f"the agents observe {sum(layout.obs_sizes)} numbers, and the env's observations have the shape "
            f"{env.observation_space.shape}: a wrapper such as VecFrameStack has changed them. Wrap the parallel env instead: "
            "make_vec_env(..., wrappers=[supersuit.frame_stack_v2])"
        )
    return layout


def wins_of(env: VecEnv) -> dict[str, str]:
    """
    Who can win, and the episode metric that tells how far: group → name of a metric in [0, 1]. Where two groups meet and one
    of them is named, the other one wins the rest. Empty if the world does not say; it says so by an attribute ``wins``.
    """
    return dict(env.get_attr("wins", [0])[0]) if env.has_attr("wins") else {}


def facts_of(env: VecEnv) -> dict[str, float]:
    """What scripted policies must know of a world beyond its observations; nothing if it does not say."""
    return dict(env.get_attr("facts", [0])[0]) if env.has_attr("facts") else {}


def metric_names_of(env: VecEnv) -> tuple[str, ...]:
    """Names of the episode metrics of a vec env; none if it declares none."""
    return tuple(env.get_attr("metric_names", [0])[0]) if env.has_attr("metric_names") else ()
