from sb3_kfcv.envs import grassland_v0, hard_spread_v0
from sb3_kfcv.envs.grassland import GrasslandWorlds
from sb3_kfcv.envs.hard_spread import HardSpreadWorlds
from sb3_kfcv.envs.parallel_env import ParticleParallelEnv
from sb3_kfcv.envs.particle_worlds import ParticleWorlds
from sb3_kfcv.envs.registration import register

__all__ = [
    "GrasslandWorlds",
    "HardSpreadWorlds",
    "ParticleParallelEnv",
    "ParticleWorlds",
    "grassland_v0",
    "hard_spread_v0",
    "register",
]
