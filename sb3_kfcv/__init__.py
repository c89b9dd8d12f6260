"""Multi-agent reinforcement learning that feels like Stable-Baselines3."""

from pathlib import Path

import gymnasium as gym

from sb3_kfcv.curriculum import KFCVReplayBuffer
from sb3_kfcv.envs.registration import register as register_pettingzoo_ids
from sb3_kfcv.kfcv_maddpg import KFCVMADDPG
from sb3_kfcv.maddpg import MADDPG
from sb3_kfcv.per_maddpg import PERMADDPG
from sb3_kfcv.vec_env import JointEnv, ParticleVecEnv, make_vec_env
from sb3_kfcv.vec_env.make import WORLDS

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()

ALGOS: dict[str, type[MADDPG]] = {"maddpg": MADDPG, "per_maddpg": PERMADDPG, "kfcv_maddpg": KFCVMADDPG}

register_pettingzoo_ids()
for _world in WORLDS:
    if _world not in gym.registry:
        gym.register(_world, entry_point="sb3_kfcv.vec_env.make:make_joint_env", kwargs={"world": _world})

__all__ = [
    "ALGOS",
    "KFCVMADDPG",
    "MADDPG",
    "PERMADDPG",
    "JointEnv",
    "KFCVReplayBuffer",
    "ParticleVecEnv",
    "make_vec_env",
]
