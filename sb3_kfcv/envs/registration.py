"""Our worlds under their ids in PettingZoo's registry."""

from __future__ import annotations

import pettingzoo

ENTRY_POINTS = {
    "HardSpread-v0": "sb3_kfcv.envs.hard_spread_v0",
    "Grassland-v0": "sb3_kfcv.envs.grassland_v0",
}
"""Module of each id; it has ``parallel_env`` and ``env``."""


def register() -> None:
    """
    Make ``pettingzoo.make("parallel", "Grassland-v0")`` and its likes work; calling it again does nothing.

    PettingZoo has a registry since 1.27; with an older one this does nothing.
    """
    if not hasattr(pettingzoo, "register"):
        return
    for env_id, module in ENTRY_POINTS.items():
        if env_id not in pettingzoo.parallel_registry:
            pettingzoo.register("parallel", env_id, entry_point=f"{module}:parallel_env")
        if env_id not in pettingzoo.aec_registry:
            pettingzoo.register("aec", env_id, entry_point=f"{module}:env")
