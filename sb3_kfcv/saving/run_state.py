"""
What a running training is made of beside its model and its buffer: random generators, worlds, callbacks, logs. Each can be
read as plain values and put back.
"""

from __future__ import annotations

import inspect
import os
import random
import time
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor, VecNormalize

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.envs.particle_worlds import ParticleWorlds
from sb3_kfcv.saving.normalization import normalization_state, set_normalization_state
from sb3_kfcv.saving.values import UnwritableError, check_writable
from sb3_kfcv.vec_env.joint_env import JointEnv
from sb3_kfcv.vec_env.particle_vec_env import ParticleVecEnv

# ---- random generators


def random_state(model: BaseAlgorithm) -> dict[str, Any]:
    """The generators that are not inside of a buffer or a world: Python's, NumPy's, PyTorch's, the warm-up's."""
    version, internal, gauss = random.getstate()
    return {
        "python": {"version": version, "internal": np.array(internal, dtype=np.uint64), "gauss": gauss},
        "numpy": np.random.get_state(legacy=False),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
        "action_space": model.action_space.np_random.bit_generator.state,
    }


def set_random_state(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """Inverse of :func:`random_state`."""
    python = state["python"]
    random.setstate((python["version"], tuple(python["internal"].tolist()), python["gauss"]))
    pos, key = state["numpy"]["state"]["pos"], state["numpy"]["state"]["key"]
    require_count("the place in NumPy's generator", pos, least=0)  # NumPy itself would read beyond its memory
    if pos > len(key) or key.shape != (624,):
        raise ValueError(f"NumPy's generator has 624 numbers; this one stands at {pos} of {key.shape}")
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if th.cuda.is_available() and state["cuda"]:
        th.cuda.set_rng_state_all(state["cuda"])
    model.action_space.np_random.bit_generator.state = state["action_space"]


# ---- worlds


class UnreadableEnvError(Exception):
    """Part of an env whose state cannot be read; the message is its type."""


def env_state(env: VecEnv) -> list[dict[str, Any]]:
    """
    Everything that a vec env is made of, layer by layer from the outermost.

    :raises UnreadableEnvError: if a layer's state cannot be read
    """
    layers: list[dict[str, Any]] = []
    while isinstance(env, VecEnvWrapper):
        layers.append({"layer": type(env).__name__, **_wrapper_state(env)})
        env = env.venv
    if isinstance(env, ParticleVecEnv):
        worlds = env.env_method("get_state")
    elif isinstance(env, DummyVecEnv):
        worlds = [_gym_state(world) for world in env.envs]
    else:
        raise UnreadableEnvError(type(env).__name__)
    settings = _settings(env.worlds) if isinstance(env, ParticleVecEnv) else {}
    return [*layers, {"layer": type(env).__name__, "worlds": worlds, "seeds": list(env._seeds), "settings": settings}]


def set_env_state(env: VecEnv, layers: list[dict[str, Any]]) -> None:
    """
    Inverse of :func:`env_state`.

    :raises ValueError: if the env is built of other layers
    """
    saved = [layer["layer"] for layer in layers]
    for layer in layers:
        if type(env).__name__ != layer["layer"]:
            raise ValueError(f"the worlds were wrapped as {' of '.join(saved)}; here is a {type(env).__name__}")
        if isinstance(env, VecEnvWrapper):
            _set_wrapper_state(env, layer)
            env = env.venv
            continue
        if len(layer["worlds"]) != env.num_envs:
            raise ValueError(f"the state is of {len(layer['worlds'])} worlds; here are {env.num_envs}")
        if isinstance(env, ParticleVecEnv):
            _check_settings(env.worlds, layer["settings"])
        env._seeds = list(layer["seeds"])  # which the next reset will take
        for i, world in enumerate(layer["worlds"]):
            if isinstance(env, DummyVecEnv):
                _set_gym_state(env.envs[i], world)
            else:
                env.env_method("set_state", world, indices=[i])


def _settings(worlds: ParticleWorlds) -> dict[str, Any]:
    """The arguments that worlds were made with, as far as they keep them."""
    names = [name for name in inspect.signature(type(worlds)).parameters if hasattr(worlds, name)]
    return {name: getattr(worlds, name) for name in names}


def _check_settings(worlds: ParticleWorlds, saved: dict[str, Any]) -> None:
    for name, value in _settings(worlds).items():
        if name in saved and saved[name] != value:
            raise ValueError(f"the worlds were made with {name}={saved[name]}; these have {name}={value}")


def _wrapper_state(env: VecEnvWrapper) -> dict[str, Any]:
    if type(env) is VecMonitor:
        return {
            "episode_returns": env.episode_returns.copy(),
            "episode_lengths": env.episode_lengths.copy(),
            "episode_count": env.episode_count,
            "elapsed": time.time() - env.t_start,
        }
    if type(env) is VecNormalize and env.norm_obs:
        rewards = env.ret_rms
        return {
            **normalization_state(env),
            "returns": env.returns.copy(),
            "ret_rms": [np.array(rewards.mean), np.array(rewards.var), float(rewards.count)],
        }
    raise UnreadableEnvError(type(env).__name__)


def _set_wrapper_state(env: VecEnvWrapper, state: dict[str, Any]) -> None:
    if isinstance(env, VecMonitor):
        env.episode_returns, env.episode_lengths = state["episode_returns"].copy(), state["episode_lengths"].copy()
        env.episode_count, env.t_start = state["episode_count"], time.time() - state["elapsed"]
    elif isinstance(env, VecNormalize):
        set_normalization_state(env, state)
        env.returns = state["returns"].copy()
        env.ret_rms.mean, env.ret_rms.var, env.ret_rms.count = state["ret_rms"]


def _gym_state(env: gym.Env) -> list[dict[str, Any]]:
    layers: list[dict[str, Any]] = []
    while isinstance(env, gym.Wrapper):
        state: dict[str, Any] = {"layer": type(env).__name__}
        if type(env) is Monitor:
            state |= {"rewards": list(env.rewards), "needs_reset": env.needs_reset, "total_steps": env.total_steps}
            state |= {name: np.array(getattr(env, name)) for name in MONITOR_HISTORY}
            state |= {"elapsed": time.time() - env.t_start, "current_reset_info": dict(env.current_reset_info)}
        elif type(env) is TimeLimit:
            state["elapsed_steps"] = env._elapsed_steps
        elif type(env) not in (OrderEnforcing, PassiveEnvChecker):
            raise UnreadableEnvError(type(env).__name__)
        layers.append(state)
        env = env.env
    world = getattr(env, "parallel_env", None)
    if not isinstance(env, JointEnv) or not (hasattr(type(world), "get_state") and hasattr(type(world), "set_state")):
        raise UnreadableEnvError(type(env if world is None else world).__name__)
    return [*layers, {"layer": "JointEnv", **env.get_state()}]


MONITOR_HISTORY = ("episode_returns", "episode_lengths", "episode_times")


def _set_gym_state(env: gym.Env, layers: list[dict[str, Any]]) -> None:
    for state in layers:
        if type(env).__name__ != state["layer"]:
            raise ValueError(f"a world was wrapped in {state['layer']}; here is a {type(env).__name__}")
        if isinstance(env, JointEnv):
            env.set_state({name: value for name, value in state.items() if name != "layer"})
            return
        if isinstance(env, Monitor):
            env.rewards, env.needs_reset, env.total_steps = list(state["rewards"]), state["needs_reset"], state["total_steps"]
            for name in MONITOR_HISTORY:
                setattr(env, name, state[name].tolist())
            env.t_start, env.current_reset_info = time.time() - state["elapsed"], dict(state["current_reset_info"])
        elif isinstance(env, TimeLimit):
            env._elapsed_steps = state["elapsed_steps"]
        env = env.env  # type: ignore[attr-defined]


# ---- callbacks

# What every callback has, and gets anew from the training that it is part of.
OF_THE_TRAINING = ("model", "locals", "globals", "parent", "verbose")


def callbacks_of(root: BaseCallback) -> Iterator[BaseCallback]:
    """A callback and all those below it."""
    yield root
    for name, value in vars(root).items():
        children = value if isinstance(value, list) else [value]
        for child in children:
            if isinstance(child, BaseCallback) and name != "parent":
                yield from callbacks_of(child)


def callback_states(root: BaseCallback) -> list[dict[str, Any]]:
    """
    The state of all callbacks: what their ``get_state()`` gives where they have one; else every attribute that is no
    parameter of their constructor and is made of numbers, text, arrays and containers of these, and the worlds of a vec env
    (an evaluation's), if they can be read.
    """
    return [{"callback": type(callback).__name__, **_callback_state(callback)} for callback in callbacks_of(root)]


def set_callback_states(root: BaseCallback, states: list[dict[str, Any]]) -> None:
    """Inverse of :func:`callback_states`; callbacks find their state by their class, those of one class in order."""
    left = list(states)
    for callback in callbacks_of(root):
        name = type(callback).__name__
        state = next((state for state in left if state["callback"] == name), None)
        if state is None:
            if set(_callback_state(callback)["values"]) - {"n_calls", "num_timesteps"}:
                warnings.warn(f"the checkpoint knows no {name}: it starts anew")
            continue
        left.remove(state)
        if hasattr(callback, "set_state"):
            callback.set_state(state["values"])
        else:
            vars(callback).update(state["values"])
        for attribute, layers in state["envs"].items():
            set_env_state(getattr(callback, attribute), layers)


def _callback_state(callback: BaseCallback) -> dict[str, Any]:
    attributes = vars(callback)
    envs = {}
    for name, env in envs_of(callback).items():
        with suppress(UnreadableEnvError):
            envs[name] = env_state(env)
    if hasattr(callback, "get_state"):
        return {"values": callback.get_state(), "envs": envs}
    given = set(inspect.signature(type(callback).__init__).parameters) | set(OF_THE_TRAINING) | set(envs)
    return {
        "values": {name: value for name, value in attributes.items() if name not in given and _is_plain(value)},
        "envs": envs,
    }


def envs_of(callback: BaseCallback) -> dict[str, VecEnv]:
    """The worlds that a callback holds, such as those of an evaluation, by their attribute."""
    return {name: value for name, value in vars(callback).items() if isinstance(value, VecEnv)}


def _is_plain(value: Any) -> bool:
    try:
        check_writable({"": value})
    except UnwritableError:
        return False
    return True


# ---- logs


def log_state(model: BaseAlgorithm, folder: Path) -> dict[str, Any]:
    """
    How far the logs are written, after everything was brought to the disk, and what waits for the next entry.

    :param model: the learner, its env and its logger
    :param folder: to which the paths are relative
    """
    logger = model.logger
    boards = {}
    for board in _tensorboards(model):
        with suppress(OSError):  # a log that cannot be written costs no checkpoint
            board.flush()
        log_dir = Path(board.log_dir)
        boards[os.path.relpath(log_dir, folder)] = {path.name: _synced_size(path) for path in _event_files(log_dir)}
    files = {}
    for handle in _text_logs(model):
        with suppress(OSError):
            handle.flush()
        files[os.path.relpath(handle.name, folder)] = _synced_size(Path(handle.name))
    pending = {
        name: float(value) for name, value in logger.name_to_value.items() if isinstance(value, (int, float, np.number))
    }
    return {
        "boards": boards,
        "files": files,
        "pending": pending,
        "counts": {name: logger.name_to_count[name] for name in pending},
        "excluded": {name: logger.name_to_excluded.get(name) for name in pending},
        "elapsed": (time.time_ns() - model.start_time) / 1e9,
    }


def set_log_state(model: BaseAlgorithm, state: dict[str, Any], folder: Path) -> None:
    """
    Cut the logs back to where they were when :func:`log_state` was called: what came after is logged again. TensorBoard goes
    on in the folder where it was, where ``learn`` has begun one beside it.
    """
    for board, (relative, sizes) in zip(_boards(model), state["boards"].items(), strict=False):
        log_dir, begun = (folder / relative).resolve(), Path(board.writer.log_dir).resolve()
        if begun.parent != log_dir.parent:  # now logged elsewhere
            continue
        board.writer.close()
        for path in _event_files(log_dir):
            if path.name in sizes:
                _cut(path, sizes[path.name])
            else:
                path.unlink()
        if begun != log_dir:
            for path in begun.glob(f"events.out.tfevents.*.{os.getpid()}.*"):
                path.unlink()
            with suppress(OSError):
                begun.rmdir()
        board.writer = type(board.writer)(log_dir=str(log_dir))
    for relative, size in state["files"].items():
        _cut(folder / relative, size)
    logger = model.logger
    for name, value in state["pending"].items():
        logger.name_to_value[name], logger.name_to_count[name] = value, state["counts"][name]
        logger.name_to_excluded[name] = state["excluded"][name]
    model.start_time = time.time_ns() - int(state["elapsed"] * 1e9)


def _boards(model: BaseAlgorithm) -> list[TensorBoardOutputFormat]:
    return [output for output in model.logger.output_formats if isinstance(output, TensorBoardOutputFormat)]


def _tensorboards(model: BaseAlgorithm) -> list[Any]:
    return [board.writer for board in _boards(model)]


def _event_files(log_dir: Path) -> list[Path]:
    return sorted(log_dir.glob("events.out.tfevents.*"))


def _text_logs(model: BaseAlgorithm) -> Iterator[Any]:
    """The open files of monitors and of SB3's CSV, JSON and text loggers."""
    for output in model.logger.output_formats:
        handle = getattr(output, "file", None)
        if isinstance(getattr(handle, "name", None), str) and os.path.isfile(handle.name):  # type: ignore[union-attr]
            yield handle
    env: Any = model.get_env()
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecMonitor) and env.results_writer is not None:
            yield env.results_writer.file_handler
        env = env.venv
    for world in env.envs if isinstance(env, DummyVecEnv) else []:
        while isinstance(world, gym.Wrapper):
            if isinstance(world, Monitor) and world.results_writer is not None:
                yield world.results_writer.file_handler
            world = world.env


def _synced_size(path: Path) -> int:
    with open(path, "rb") as file:
        os.fsync(file.fileno())
        return os.fstat(file.fileno()).st_size


def _cut(path: Path, size: int) -> None:
    """Shorten a file; one that is missing or shorter cannot be mended, and is named."""
    if not path.is_file() or path.stat().st_size < size:
        warnings.warn(f"{path} is shorter than when the checkpoint was written: entries before it are missing")
    else:
        os.truncate(path, size)
