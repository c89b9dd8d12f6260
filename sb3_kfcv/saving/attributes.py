"""A model's settings and counters from a file: checked before anything is made of them."""

from __future__ import annotations

import math
from collections import deque
from numbers import Real
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from torch import nn

from sb3_kfcv.common.checks import require_between, require_count
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.replay.joint_replay_buffer import JointReplayBuffer
from sb3_kfcv.saving.files import is_path

NEEDED = {"algorithm", "layout", "policy_class", "policy_kwargs", "observation_space", "action_space", "n_envs"}

# What the program that loads a model gives it; never in a file.
OF_THE_PROGRAM = ("env", "_vec_normalize_env", "replay_buffer", "device", "_logger")

# Settings of policy and replay buffer that follow from the model's own.
OF_THE_ALGORITHM = ("layout", "agents", "n_agents", "state_size")

# Settings of the replay buffer that a file may name and that nothing depends on.
RETIRED_SETTINGS = ("sort_above", "sort_every")

COUNTERS = ("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_episode_num", "_n_updates", "_stats_window_size")


def check_attributes(attributes: dict[str, Any], algorithm: type) -> None:
    """
    Settings themselves are checked by the algorithm, when it takes them; here is what it relies on.

    :param attributes: of a model
    :param algorithm: its class
    :raises ValueError: names the attribute that is none of such a model
    """
    for name in attributes:
        if callable(getattr(algorithm, name, None)):
            raise ValueError(f"{name} is a method, no attribute")
        if name in OF_THE_PROGRAM:
            raise ValueError(f"{name} is nothing that a file can hold")
    check_spaces(attributes["layout"], attributes["observation_space"], attributes["action_space"])
    _check_classes(attributes)
    _check_opponents(attributes.get("opponents"))
    _check_facts(attributes.get("world_facts", {}))
    _check_noise(attributes.get("action_noise"), attributes["action_space"].shape)
    if type(attributes.get("plays_only", False)) is not bool:
        raise ValueError(f"plays_only is yes or no, not {attributes['plays_only']!r}")
    require_count("n_envs", attributes["n_envs"])
    for name in COUNTERS:
        require_count(name, attributes.get(name, 0), least=0)
    require_between("_current_progress_remaining", attributes.get("_current_progress_remaining", 1.0), -math.inf, 1)
    rows = (attributes["n_envs"], *attributes["observation_space"].shape)
    for name, shape in (("_last_obs", rows), ("_last_original_obs", rows), ("_last_episode_starts", rows[:1])):
        value = attributes.get(name)
        if value is not None and (not isinstance(value, np.ndarray) or value.shape != shape):
            raise ValueError(f"{name} must be an array of {shape}, or nothing")
    for name in ("ep_info_buffer", "ep_success_buffer", "_episode_metrics"):
        _check_episodes(name, deque() if attributes.get(name) is None else attributes[name])


def require_own(attributes: dict[str, Any], model: Any) -> None:
    """
    :param attributes: that a model which is set up is to take over
    :param model: the model
    :raises ValueError: names one that the model makes itself, such as its networks
    """
    networks = {name.split(".")[0] for name in model._get_torch_save_params()[0]}
    for name in attributes:
        if name in networks or name in model._excluded_save_params():
            raise ValueError(f"{name} is made by the model itself, no file gives it")


def without_retired(attributes: dict[str, Any]) -> dict[str, Any]:
    """
    :param attributes: of a model, from a file
    :return: the same without the settings of the replay buffer that are no more
    """
    settings = attributes.get("replay_buffer_kwargs") if isinstance(attributes, dict) else None
    if not isinstance(settings, dict):
        return attributes
    kept = {name: value for name, value in settings.items() if name not in RETIRED_SETTINGS}
    return {**attributes, "replay_buffer_kwargs": kept}


def check_spaces(layout: Any, observations: Any, actions: Any) -> None:
    """
    :param layout: who sits where in the joint rows
    :param observations: joint observation space
    :param actions: joint action space
    :raises ValueError: unless they belong together
    """
    if not isinstance(layout, AgentLayout):
        raise ValueError(f"the layout of the agents is {layout!r}")
    if layout.discrete:
        fits = isinstance(actions, spaces.MultiDiscrete) and np.array_equal(actions.nvec, layout.action_sizes)
    else:
        fits = isinstance(actions, spaces.Box) and actions.shape == (sum(layout.action_sizes),)
        with np.errstate(over="ignore", invalid="ignore"):
            fits = fits and ((actions.high > actions.low) & np.isfinite(actions.high - actions.low)).all()
    if not fits or not isinstance(observations, spaces.Box) or observations.shape != (sum(layout.obs_sizes),):
        raise ValueError(f"its spaces do not fit its agents, {layout}: {observations}, {actions}")


def _check_classes(attributes: dict[str, Any]) -> None:
    for name in ("policy_kwargs", "replay_buffer_kwargs"):
        given = attributes.get(name, {})
        if not isinstance(given, dict) or not given.keys().isdisjoint(OF_THE_ALGORITHM):
            raise ValueError(f"{name} are {given!r}")
    given = attributes["policy_kwargs"]
    for name, thing, base in (
        ("policy_class", attributes["policy_class"], BasePolicy),
        ("replay_buffer_class", attributes.get("replay_buffer_class", JointReplayBuffer), JointReplayBuffer),
        ("activation_fn", given.get("activation_fn", nn.Module), nn.Module),
        ("optimizer_class", given.get("optimizer_class", th.optim.Optimizer), th.optim.Optimizer),
    ):
        if not (issubclass(thing, base) if isinstance(thing, type) else callable(thing)):
            raise ValueError(f"{name} is {thing!r}, which is no {base.__name__}")


def _check_opponents(opponents: Any) -> None:
    """Names of scripted policies, or what was made of the file itself: it has no say about other files."""
    for player in (opponents or {}).values():
        if isinstance(player, list | tuple | dict):
            raise ValueError(f"an opponent is {player!r}; a mixture is no plain list or map in a file")
        if isinstance(player, str) and is_path(player):
            raise ValueError(f"an opponent is the file {player!r}, which is nothing that a file can say")


def _check_facts(facts: Any) -> None:
    if not isinstance(facts, dict) or any(type(fact) not in (int, float) for fact in facts.values()):
        raise ValueError(f"world_facts must be numbers by name, got {facts!r}")


def _check_noise(noise: Any, shape: tuple[int, ...]) -> None:
    if noise is None:
        return
    if not isinstance(noise, ActionNoise):
        raise ValueError(f"action_noise is {noise!r}")
    one = getattr(noise, "base_noise", noise)
    shapes = [np.shape(getattr(one, name, ())) for name in ("_mu", "_sigma")]
    if np.broadcast_shapes(*shapes, shape) != shape:
        raise ValueError(f"action_noise is of {shapes} for actions of {shape}")


def _check_episodes(name: str, noted: Any) -> None:
    """What is noted of the latest episodes: numbers, or numbers by name."""
    if not isinstance(noted, deque):
        raise ValueError(f"{name} must be a deque, or nothing")
    for item in noted:
        keys = {"ep_info_buffer": ("r", "l"), "_episode_metrics": noted[0]}.get(name)
        numbers = [item] if keys is None else [item[key] for key in keys]
        if not all(isinstance(number, (Real, np.generic)) for number in numbers):
            raise ValueError(f"{name} holds {item!r}")
