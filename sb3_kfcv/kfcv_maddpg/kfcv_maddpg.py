from typing import ClassVar

from sb3_kfcv.curriculum import KFCVReplayBuffer
from sb3_kfcv.maddpg.maddpg import MADDPG
from sb3_kfcv.replay import JointReplayBuffer


class KFCVMADDPG(MADDPG):
    """
    MADDPG with K-fold cross-validated curriculum replay: KFCV-CL, Algorithm 1 of Lin et al. 2022.

    The one difference to :class:`~sb3_kfcv.maddpg.maddpg.MADDPG` is the replay buffer; its settings (``n_folds``,
    ``refresh_every``, ``teacher_steps``, ``stage_rule``, ``lambda_init``, ``curriculum_fraction``, ``score``, …) ride
    in ``replay_buffer_kwargs``, see :class:`~sb3_kfcv.curriculum.KFCVReplayBuffer`.
    """

    default_buffer_class: ClassVar[type[JointReplayBuffer]] = KFCVReplayBuffer
