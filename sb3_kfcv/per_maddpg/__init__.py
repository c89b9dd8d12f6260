from sb3_kfcv.per_maddpg.per_maddpg import PERMADDPG

__all__ = ["PERMADDPG"]
