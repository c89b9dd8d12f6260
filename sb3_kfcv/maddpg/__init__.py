from sb3_kfcv.maddpg.maddpg import MADDPG
from sb3_kfcv.maddpg.policies import MlpPolicy

__all__ = ["MADDPG", "MlpPolicy"]
