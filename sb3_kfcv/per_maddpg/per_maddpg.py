from typing import ClassVar

from sb3_kfcv.maddpg.maddpg import MADDPG
from sb3_kfcv.replay import JointReplayBuffer, PrioritizedReplayBuffer


class PERMADDPG(MADDPG):
    """
    MADDPG with rank-based prioritised experience replay (eq. 3–4 of Lin et al. 2022; Schaul et al. 2015).

    The one difference to :class:`~sb3_kfcv.maddpg.maddpg.MADDPG` is the replay buffer; its settings ``alpha`` and
    ``beta_init`` ride in ``replay_buffer_kwargs``, see :class:`~sb3_kfcv.replay.PrioritizedReplayBuffer`.
    """

    default_buffer_class: ClassVar[type[JointReplayBuffer]] = PrioritizedReplayBuffer
