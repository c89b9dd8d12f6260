"""Brings a replay buffer and an algorithm of SB3 together for the time of a training."""

from __future__ import annotations

from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_kfcv.common.joint_algorithm import NOT_TENSORBOARD
from sb3_kfcv.stock.buffers import StockReplay
from sb3_kfcv.stock.students import StockStudent, student_class


class ReplayCallback(BaseCallback):
    """
    Lets a replay buffer of :mod:`sb3_kfcv.stock` meet the algorithm that learns from it, tells it how far the training is,
    and puts its diagnostics into SB3's log, whenever SB3 writes one.

    :param student: adapter of the algorithm; by default the one of DQN, DDPG, TD3 or SAC
    :param verbose: as in SB3
    """

    def __init__(self, student: type[StockStudent] | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.student = student

    @property
    def buffer(self) -> StockReplay:
        """
        The model's replay buffer.

        :raises ValueError: if it is of another kind
        """
        buffer: Any = getattr(self.model, "replay_buffer", None)
        if not isinstance(buffer, StockReplay):
            found = "none" if buffer is None else f"a {type(buffer).__name__}"
            raise ValueError(
                f"ReplayCallback is for a replay buffer of sb3_kfcv.stock, the model has {found}; "
                "give it replay_buffer_class=StockKFCVReplayBuffer or StockPrioritizedReplayBuffer"
            )
        return buffer

    def _on_training_start(self) -> None:
        buffer, model = self.buffer, self.model
        student = self.student or student_class(model)  # type: ignore[arg-type]
        buffer.attach(student(model, buffer.rng))  # type: ignore[arg-type]

    def _on_rollout_end(self) -> None:
        remaining = self.model._current_progress_remaining
        self.buffer.progress = min(1 - remaining, 1.0)  # several worlds may overshoot the end

    def _on_step(self) -> bool:
        interval, before = self.locals["log_interval"], self.model._episode_num  # type: ignore[attr-defined]
        after = before + int(self.locals["dones"].sum())
        if interval is not None and after // interval > before // interval:  # SB3 is about to write its log
            for key, value in self.buffer.diagnostics().items():
                self.logger.record(key, value, exclude=NOT_TENSORBOARD if isinstance(value, th.Tensor) else None)
        return True

    def _on_training_end(self) -> None:
        self.buffer.detach()
