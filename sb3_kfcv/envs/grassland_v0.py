"""Grassland-v0 for PettingZoo: ``grassland_v0.parallel_env()`` and ``grassland_v0.env()``, as PettingZoo's own worlds."""

from __future__ import annotations

from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec

from sb3_kfcv.envs.grassland import GrasslandWorlds
from sb3_kfcv.envs.parallel_env import ParticleParallelEnv


def parallel_env(render_mode: str | None = None, **kwargs: Any) -> ParticleParallelEnv:
    """
    All agents act at once.

    :param render_mode: ``"rgb_array"``, ``"human"`` or None
    :param kwargs: settings of :class:`~sb3_kfcv.envs.grassland.GrasslandWorlds`, all but ``n_worlds``
    """
    return ParticleParallelEnv(GrasslandWorlds(n_worlds=1, **kwargs), "grassland_v0", render_mode)


def env(render_mode: str | None = None, **kwargs: Any) -> AECEnv:
    """The agents act in turn; the world moves after the last one. The parameters are those of :func:`parallel_env`."""
    return parallel_to_aec(parallel_env(render_mode, **kwargs))
