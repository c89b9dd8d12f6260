"""Statistics of ``VecNormalize``, kept in the file of the model that was trained with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_kfcv.common.checks import require_between, require_finite
from sb3_kfcv.saving.archive import open_archive
from sb3_kfcv.saving.files import with_suffix

SETTINGS = ("clip_obs", "epsilon")


def normalization_state(env: VecNormalize) -> dict[str, Any]:
    """What normalises the observations: mean, variance and count, and the settings."""
    statistics: Any = env.obs_rms
    for name in ("mean", "var"):
        require_finite(f"the {name} of the observations", getattr(statistics, name))
    return {
        **{"mean": statistics.mean, "var": statistics.var, "count": float(statistics.count)},
        **{name: float(getattr(env, name)) for name in SETTINGS},
    }


def set_normalization_state(env: VecNormalize, state: dict[str, Any]) -> None:
    """
    :param env: that is to normalise so
    :param state: as :func:`normalization_state` gave it
    :raises ValueError: if it is of other observations
    """
    statistics: Any = env.obs_rms
    for name in ("mean", "var"):
        if state[name].shape != env.observation_space.shape:
            raise ValueError(f"it is for observations {state[name].shape}; the env has {env.observation_space.shape}")
        require_finite(f"the {name} of the observations", state[name])
    if (state["var"] < 0).any():
        raise ValueError("the var of the observations must not be negative")
    for name in ("count", *SETTINGS):
        require_between(name, state[name], 0)
    statistics.mean, statistics.var = (np.array(state[name]) for name in ("mean", "var"))
    statistics.count = state["count"]
    for name in SETTINGS:
        setattr(env, name, state[name])


def load_normalization(model_path: str | Path, env: VecEnv, training: bool) -> VecNormalize:
    """
    Normalise the observations of an env as they were when a model was saved.

    :param model_path: of the model or checkpoint
    :param env: the worlds
    :param training: whether the statistics go on changing
    :raises ValueError: if the model knows no such statistics, or those of other observations
    """
    path = Path(model_path)
    with open_archive(path if path.is_file() else with_suffix(path, ".zip"), "model", "checkpoint") as archive:
        if "normalization" not in archive:
            raise ValueError(f"{model_path} was not trained with normalised observations")
        state = archive.read("normalization")
        normalized = VecNormalize(env, training=training, norm_reward=False)
        try:
            set_normalization_state(normalized, state)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            archive.refuse(f"does not fit: normalization: {error}")
    return normalized
