"""Multi-agent reinforcement learning that feels like Stable-Baselines3."""

import gymnasium as gym

from sb3_kfcv.algorithms import ALGOS
from sb3_kfcv.co_training import CoTraining
from sb3_kfcv.curriculum import KFCVReplayBuffer
from sb3_kfcv.envs.registration import register as register_pettingzoo_ids
from sb3_kfcv.kfcv_maddpg import KFCVMADDPG
from sb3_kfcv.maddpg import MADDPG, MlpPolicy
from sb3_kfcv.per_maddpg import PERMADDPG
from sb3_kfcv.replay import JointReplayBuffer, PrioritizedReplayBuffer
from sb3_kfcv.saving import FileFormatError, register
from sb3_kfcv.saving.checkpoints import Checkpoints
from sb3_kfcv.saving.normalization import load_normalization
from sb3_kfcv.vec_env import JointEnv, ParticleVecEnv, make_vec_env
from sb3_kfcv.vec_env.make import WORLDS
from sb3_kfcv.version import __version__

register("MlpPolicy", MlpPolicy)
for _buffer in (JointReplayBuffer, PrioritizedReplayBuffer, KFCVReplayBuffer):
    register(_buffer.__name__, _buffer)
register_pettingzoo_ids()
for _world in WORLDS:
    if _world not in gym.registry:
        gym.register(_world, entry_point="sb3_kfcv.vec_env.make:make_joint_env", kwargs={"world": _world})

__all__ = [
    "ALGOS",
    "KFCVMADDPG",
    "MADDPG",
    "PERMADDPG",
    "Checkpoints",
    "CoTraining",
    "FileFormatError",
    "JointEnv",
    "KFCVReplayBuffer",
    "ParticleVecEnv",
    "__version__",
    "load_normalization",
    "make_vec_env",
    "register",
]
