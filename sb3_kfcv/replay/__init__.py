from sb3_kfcv.replay.joint_replay_buffer import JointReplayBuffer, JointReplayBufferSamples, Student
from sb3_kfcv.replay.prioritized_replay_buffer import PrioritizedReplayBuffer

__all__ = ["JointReplayBuffer", "JointReplayBufferSamples", "PrioritizedReplayBuffer", "Student"]
