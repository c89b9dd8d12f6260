from sb3_kfcv.co_training.co_training import CoTraining

__all__ = ["CoTraining"]
