from sb3_kfcv.vec_env.joint_env import JointEnv
from sb3_kfcv.vec_env.make import make_vec_env
from sb3_kfcv.vec_env.particle_vec_env import ParticleVecEnv

__all__ = ["JointEnv", "ParticleVecEnv", "make_vec_env"]
