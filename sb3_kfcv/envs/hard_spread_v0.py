"""HardSpread-v0 for PettingZoo: ``hard_spread_v0.parallel_env()`` and ``hard_spread_v0.env()``, as PettingZoo's own worlds."""

from __future__ import annotations

from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec

from sb3_kfcv.envs.hard_spread import HardSpreadWorlds
from sb3_kfcv.envs.parallel_env import ParticleParallelEnv


def parallel_env(render_mode: str | None = None, **kwargs: Any) -> ParticleParallelEnv:
    """
    All agents act at once.

    :param render_mode: ``"rgb_array"``, ``"human"`` or None
    :param kwargs: settings of :class:`~sb3_kfcv.envs.hard_spread.HardSpreadWorlds`, all but ``n_worlds``
    """
    return ParticleParallelEnv(HardSpreadWorlds(n_worlds=1, **kwargs), "hard_spread_v0", render_mode)


def env(render_mode: str | None = None, **kwargs: Any) -> AECEnv:
    """The agents act in turn; the world moves after the last one. The parameters are those of :func:`parallel_env`."""
    return parallel_to_aec(parallel_env(render_mode, **kwargs))
