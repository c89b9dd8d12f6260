from sb3_kfcv.kfcv_maddpg.kfcv_maddpg import KFCVMADDPG

__all__ = ["KFCVMADDPG"]
