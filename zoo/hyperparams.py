"""Hyperparameters of a run: the YAML entry, its preset and the command line, merged and checked before anything is built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.vec_env import VecNormalize

from sb3_kfcv import ALGOS, CoTraining
from sb3_kfcv.common.joint_algorithm import JointAlgorithm
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.common.schedules import schedule_of
from sb3_kfcv.maddpg import MADDPG
from sb3_kfcv.vec_env.make import WORLDS, unknown_environment
from sb3_kfcv.vec_env.named_worlds import find_world
from sb3_kfcv.vec_env.named_wrappers import NamedWrapper, find_wrappers, listed_wrappers
from zoo.run_folder import read_map
from zoo.typed_settings import checked, resolve_classes, settings_of

# Installed, they lie within the zoo (see setup.py); in a clone, beside it.
INSTALLED = Path(__file__).with_name("presets")
HYPERPARAMS = INSTALLED if INSTALLED.is_dir() else Path(__file__).parents[1] / "hyperparams"
PRESETS = ("default", "tuned")

# Several teams, each with an algorithm of its own.
CO_TRAINING = "co_training"
ALGORITHMS: dict[str, type[MADDPG] | type[CoTraining]] = {**ALGOS, CO_TRAINING: CoTraining}

# Constructor arguments that are flags of the command line, or not for a file to say.
FLAGS = ("seed", "device", "verbose", "tensorboard_log")
NOT_SETTABLE = (
    *("self", "policy", "env", "action_noise", "replay_buffer_class", "optimize_memory_usage", "_init_setup_model"),
    *FLAGS,
)
# What the algorithm itself tells its buffer and its policy.
GIVEN_TO_BUFFER = (
    *("self", "buffer_size", "observation_space", "action_space", "device", "n_envs", "optimize_memory_usage"),
    *("n_agents", "state_size", "seed"),
)
GIVEN_TO_POLICY = (
    *("self", "observation_space", "action_space", "lr_schedule", "layout", "agents", "critic_input"),
    "share_parameters",
)
OF_THE_RUN = {
    "n_timesteps": int,
    "n_envs": int,
    "policy": str,
    "normalize": bool | dict[str, Any],
    "env_kwargs": dict[str, Any],
    "env_wrapper": str | dict[str, Any] | list | None,
}


@dataclass
class Hyperparams:
    """
    The checked settings of a run.

    :param algo: name of the algorithm
    :param env_id: id of the world
    :param n_timesteps: env steps to train
    :param n_envs: worlds that train side by side
    :param policy: name of the policy class
    :param normalize: arguments of ``VecNormalize``; ``None`` goes without
    :param env_kwargs: settings of the world
    :param env_wrapper: SuperSuit's wrappers around the world, maps name → arguments
    :param model: arguments of the algorithm's constructor, as YAML holds them
    """

    algo: str
    env_id: str
    n_timesteps: int
    n_envs: int = 1
    policy: str = "MlpPolicy"
    normalize: dict[str, Any] | None = None
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    env_wrapper: list[NamedWrapper] = field(default_factory=list)
    model: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The settings as an entry of a YAML file."""
        run = {name: getattr(self, name) for name in ("n_timesteps", "n_envs", "policy", "env_kwargs", "env_wrapper")}
        return {**run, "normalize": self.normalize or False, **self.model}

    def model_kwargs(self, names: Sequence[str] | None = None) -> dict[str, Any]:
        """
        Arguments for the algorithm's constructor: schedules and classes in place of their names.

        :param names: only these; all by default
        """
        kwargs = deepcopy({name: self.model[name] for name in (self.model if names is None else names)})
        if self.algo != CO_TRAINING:
            return _constructor_kwargs(self.algo, self.policy, kwargs)
        teams = {team: _constructor_kwargs(theirs["algo"], self.policy, theirs) for team, theirs in kwargs["teams"].items()}
        return {**kwargs, "teams": teams}


def _constructor_kwargs(algo: str, policy: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    kwargs = dict(settings)
    if isinstance(kwargs.get("train_freq"), list):
        kwargs["train_freq"] = tuple(kwargs["train_freq"])
    if "policy_kwargs" in kwargs:
        kwargs["policy_kwargs"] = resolve_classes(kwargs["policy_kwargs"], _policy_settings(algo, policy))
    return kwargs


def find_algorithm(name: str) -> Any:
    """
    :return: a class of :class:`MADDPG`, or :class:`CoTraining`
    :raises ValueError: for an unknown algorithm, with the nearest one
    """
    if name not in ALGORITHMS:
        raise ValueError(unknown_name("algorithm", name, ALGORITHMS))
    return ALGORITHMS[name]


def co_training_entry(entries: Mapping[str, Mapping[str, Any]], algos: Mapping[str, str]) -> dict[str, Any]:
    """
    The entry of several teams, of those of their algorithms.

    :param entries: team → the entry of a world in the YAML file of its algorithm
    :param algos: team → its algorithm
    :raises ValueError: if they do not agree about what is the run's
    """
    of_the_run: dict[str, Any] = {}
    for team, entry in entries.items():
        for name in OF_THE_RUN:
            if name in entry and of_the_run.setdefault(name, entry[name]) != entry[name]:
                raise ValueError(f"{name} is {of_the_run[name]} for {next(iter(entries))} and {entry[name]} for {team}")
    own = {team: {name: value for name, value in entry.items() if name not in OF_THE_RUN} for team, entry in entries.items()}
    return {**of_the_run, "teams": {team: {"algo": algos[team], **own[team]} for team in entries}}


def load_entry(algo: str, env_id: str, conf_file: str | Path | None = None, preset: str = "default") -> dict[str, Any]:
    """
    The entry of a world in a YAML file, unchecked.

    :param algo: name of the algorithm, whose file is read unless another one is given
    :param env_id: id of the world
    :param conf_file: another file
    :param preset: ``"default"``, or ``"tuned"``: with the values of the entry's ``tuned`` map in place of the defaults
    :raises ValueError: if there is no such entry
    """
    path = Path(conf_file) if conf_file else HYPERPARAMS / f"{algo}.yml"
    entries = read_map(path)
    if env_id not in entries:
        if env_id in gym.registry or find_world(env_id) is not None:
            listed = ", ".join(map(str, entries))
            raise ValueError(f"{path} has no entry for {env_id}, only {listed}; give a YAML file that has one with -conf")
        raise ValueError(unknown_environment(env_id))
    entry = entries[env_id]
    if not isinstance(entry, dict):
        raise ValueError(f"the entry of {env_id} in {path} is {entry!r}; it must be a map")
    tuned = entry.pop("tuned", None)
    if preset not in PRESETS:
        raise ValueError(unknown_name("preset", preset, PRESETS))
    if preset == "default":
        return entry
    if not isinstance(tuned, dict):
        raise ValueError(f"the entry of {env_id} in {path} has no map {preset!r}")
    return merged(entry, tuned)


def parse_pairs(flag: str, pairs: Sequence[str]) -> dict[str, Any]:
    """
    ``key:value`` pairs of the command line; a dot in the key goes into a nested map.

    :param flag: for the message
    :param pairs: such as ``["gamma:0.95", "policy_kwargs.n_critics:2"]``
    :raises ValueError: for a text that is no pair
    """
    result: dict[str, Any] = {}
    for pair in pairs:
        key, colon, text = pair.partition(":")
        if not colon or not key:
            raise ValueError(f'{flag} takes key:value, such as gamma:0.95; got "{pair}"')
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise ValueError(f'{flag} {key}: "{text}" is no valid YAML value') from None
        result = merged(result, nested({key: value}))
    return result


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings with dots in their names as nested maps."""
    result: dict[str, Any] = {}
    for name, value in settings.items():
        for part in reversed(name.split(".")):
            value = {part: value}
        result = merged(result, value)
    return result


def flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested maps as one, their names joined by dots: the inverse of :func:`nested`."""
    result: dict[str, Any] = {}
    for name, value in settings.items():
        result.update(flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value})
    return result


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with the values of ``over``, nested maps merged likewise."""
    result = dict(base)
    for key, value in over.items():
        both_maps = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = merged(result[key], value) if both_maps else value
    return result


def check(algo: str, env_id: str, entry: Mapping[str, Any]) -> Hyperparams:
    """
    Check every name and type of an entry.

    :param algo: name of the algorithm
    :param env_id: id of the world
    :param entry: name → value
    :raises ValueError: names what is wrong and the nearest right name
    """
    algorithm = find_algorithm(algo)
    for flag in FLAGS:
        if flag in entry:
            raise ValueError(f"{flag} is no hyperparameter: give it with --{flag.replace('_', '-')}")
    if "norm_reward" in entry:
        raise ValueError(_norm_reward_refusal())
    settings = checked("hyperparameter", entry, {**OF_THE_RUN, **_model_settings(algorithm)})
    run = {name: settings.pop(name) for name in OF_THE_RUN if name in settings}
    for name in ("n_timesteps", "n_envs"):
        if name not in run:
            raise ValueError(f"hyperparameter {name} is missing")
        if run[name] < 1:
            raise ValueError(f"hyperparameter {name} is {run[name]}; it must be at least 1")
    run["normalize"] = _checked_normalize(run.get("normalize", False))
    run["env_kwargs"] = check_env_kwargs(env_id, run.get("env_kwargs", {}))
    run["env_wrapper"] = listed_wrappers(run.get("env_wrapper"))
    find_wrappers(run["env_wrapper"])  # refuses what there is not
    if run.setdefault("policy", "MlpPolicy") not in algorithm.policy_aliases:
        raise ValueError(unknown_name("policy", run["policy"], algorithm.policy_aliases))
    if algo != CO_TRAINING:
        return Hyperparams(algo, env_id, model=_checked_model(algo, run["policy"], settings), **run)
    teams = {}
    for team, theirs in settings.get("teams", {}).items():
        if not isinstance(theirs, dict) or theirs.get("algo") not in ALGOS:
            known = ", ".join(ALGOS)
            raise ValueError(f"hyperparameter teams: {team} is {theirs!r}; it must be a map with an algo, one of {known}")
        known_settings = _model_settings(ALGOS[theirs["algo"]], (*NOT_SETTABLE, "team", "opponents", "stats_window_size"))
        own = checked(f"hyperparameter of {team},", theirs, {"algo": str, **known_settings})
        teams[team] = {"algo": own.pop("algo"), **_checked_model(theirs["algo"], run["policy"], own)}
    return Hyperparams(algo, env_id, model={**settings, "teams": teams}, **run)


def _model_settings(algorithm: type[JointAlgorithm], without: Sequence[str] = NOT_SETTABLE) -> dict[str, Any]:
    known = settings_of(algorithm, without)
    return {**known, "learning_rate": float | str} if "learning_rate" in known else known  # text for a schedule


def _checked_model(algo: str, policy: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of one learner, with those of its policy and its replay buffer checked."""
    algorithm, checked_settings = ALGOS[algo], dict(settings)
    if isinstance(settings.get("learning_rate"), str):
        schedule_of(settings["learning_rate"])
    checked_settings["policy_kwargs"] = checked(
        "setting of policy_kwargs", settings.get("policy_kwargs") or {}, _policy_settings(algo, policy)
    )
    checked_settings["replay_buffer_kwargs"] = checked(
        f"setting of replay_buffer_kwargs ({algorithm.default_buffer_class.__name__})",
        settings.get("replay_buffer_kwargs") or {},
        settings_of(algorithm.default_buffer_class, GIVEN_TO_BUFFER),
    )
    return checked_settings


def check_env_kwargs(env_id: str, env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """
    Check the settings of a world; those of a world that does not name them cannot be known and pass.

    :raises ValueError: for an unknown one, with the nearest one, and for a value of another type
    """
    constructor: Any = WORLDS.get(env_id)
    if constructor is None and env_id not in gym.registry and (world := find_world(env_id)) is not None:
        constructor = world.constructor
    if constructor is None:
        return dict(env_kwargs)
    return checked(f"setting of {env_id}", env_kwargs, settings_of(constructor, ("self", "n_worlds")))


def _checked_normalize(normalize: bool | dict[str, Any]) -> dict[str, Any] | None:
    if normalize is False:
        return None
    given = {} if normalize is True else normalize
    if given.get("norm_reward"):
        raise ValueError(_norm_reward_refusal())
    known = settings_of(VecNormalize, ("self", "venv", "training", "norm_obs_keys", "clip_reward", "gamma"))
    return {"norm_obs": True, **checked("setting of normalize", given, known), "norm_reward": False}


def _norm_reward_refusal() -> str:
    return "norm_reward: true cannot reach the agents' own rewards, which the critics learn; use reward_scale instead"


def _policy_settings(algo: str, policy: str) -> dict[str, Any]:
    return settings_of(ALGOS[algo].policy_aliases[policy], GIVEN_TO_POLICY)
