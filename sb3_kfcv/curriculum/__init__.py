from sb3_kfcv.curriculum.kfcv_replay_buffer import KFCVReplayBuffer

__all__ = ["KFCVReplayBuffer"]
