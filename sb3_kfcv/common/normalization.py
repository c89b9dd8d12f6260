"""Statistics of ``VecNormalize``, kept beside the model that was trained with them; plain arrays, no pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_kfcv.common.files import atomic_write


def normalization_file(model_path: str | Path) -> Path:
    """Where the statistics of a saved model lie: ``best_model.zip`` → ``best_model_vecnormalize.npz``."""
    path = Path(model_path)
    return path.with_name(f"{path.name.removesuffix('.zip')}_vecnormalize.npz")


def save_model(model: BaseAlgorithm, path: str | Path) -> None:
    """
    Save a model, and beside it the statistics of its env if that is normalised.

    :param model: the model
    :param path: of the zip file
    """
    model.save(path)
    env = model.get_vec_normalize_env()
    if env is not None:
        statistics: Any = env.obs_rms
        with atomic_write(normalization_file(path)) as file:
            np.savez(
                file,
                mean=statistics.mean,
                var=statistics.var,
                count=statistics.count,
                clip_obs=env.clip_obs,
                epsilon=env.epsilon,
            )


def load_normalization(model_path: str | Path, env: VecEnv, training: bool) -> VecNormalize:
    """
    Normalise the observations of an env as they were when a model was saved.

    :param model_path: of the model
    :param env: the worlds
    :param training: whether the statistics go on changing
    :raises ValueError: if there are no statistics beside the model, or those of other observations
    """
    path = normalization_file(model_path)
    if not path.exists():
        raise ValueError(f"{model_path} was trained with normalised observations, but {path} is missing")
    with np.load(path, allow_pickle=False) as saved:
        normalized = VecNormalize(
            env,
            training=training,
            norm_reward=False,
            clip_obs=float(saved["clip_obs"]),
            epsilon=float(saved["epsilon"]),
        )
        if saved["mean"].shape != env.observation_space.shape:
            raise ValueError(f"{path} is for observations {saved['mean'].shape}; the env has {env.observation_space.shape}")
        statistics: Any = normalized.obs_rms
        statistics.mean, statistics.var, statistics.count = saved["mean"], saved["var"], float(saved["count"])
    return normalized
