"""The teachers: K critics, each trained on its own fold alone (eq. 9)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th

from sb3_kfcv.common.adam import LeanAdam
from sb3_kfcv.common.live import shares
from sb3_kfcv.common.stacked_networks import StackedMLP
from sb3_kfcv.saving.parameters import check_network, check_optimizer


class Teachers:
    """
    K teacher networks as one stack. A teacher gives the Q-value of every learning agent, one output each: it learns
    several times faster than one network per agent at the same cost, and the cost hardly grows with the agents.

    They start from their own random initialisation and live as long as the buffer; never from the student, which has
    seen every fold.

    :param n_folds: K
    :param n_agents: the learning agents
    :param input_size: length of a critic's input
    :param net_arch: hidden sizes
    :param learning_rate: of Adam
    :param device: where they live
    """

    def __init__(
        self,
        n_folds: int,
        n_agents: int,
        input_size: int,
        net_arch: Sequence[int],
        learning_rate: float,
        device: th.device | str,
    ) -> None:
        self.n_folds = n_folds
        self.stack = StackedMLP(n_folds, [input_size, *net_arch, n_agents]).to(device)
        self.optimizer = LeanAdam(self.stack.parameters(), lr=learning_rate, fused=True)

    @th.no_grad()
    def values(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: (folds, batch, features), one batch per teacher; or (1, batch, features), the same for all
        :return: Q (folds, agents, batch)
        """
        return self.stack.evaluate(inputs.expand(self.n_folds, -1, -1)).transpose(1, 2).clone()

    @th.no_grad()
    def fit(
        self,
        inputs: th.Tensor,
        targets: th.Tensor,
        live: th.Tensor,
        rows_per_fold: list[np.ndarray],
        steps: int,
        batch_size: int,
        rng: np.random.Generator,
    ) -> float:
        """
        Regress every teacher on the TD targets of its own fold (eq. 9).

        :param inputs: critic inputs of all transitions, (n, features)
        :param targets: y, (agents, n)
        :param live: 1 where the agent lived, (agents, n)
        :param rows_per_fold: which transitions are each fold's; none empty
        :param steps: gradient steps
        :param batch_size: transitions per teacher and step
        :param rng: generator of the draws
        :return: mean squared error over the last tenth of the steps, on the teachers' own folds
        """
        targets, live = targets.T.contiguous(), live.T.contiguous()  # (n, agents)
        losses = []
        for _ in range(steps):
            drawn = np.stack([rows[rng.integers(len(rows), size=batch_size)] for rows in rows_per_fold])  # (folds, batch)
            picked = th.as_tensor(drawn, device=inputs.device)
            _, loss = self.stack.regress(inputs[picked], targets[picked], shares(live[picked], dim=1))  # (folds, agents)
            losses.append(loss.mean())
            self.optimizer.step()
        return th.stack(losses[-max(steps // 10, 1) :]).mean().item()

    def state_dict(self) -> dict[str, Any]:
        """Networks and optimiser moments."""
        return {"network": self.stack.state_dict(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """
        Inverse of :meth:`state_dict`.

        :raises ValueError: if these are other networks, or not finite
        """
        check_network(self.stack, saved["network"], "teachers/network")
        moments = check_optimizer(self.optimizer, saved["optimizer"], "teachers/optimizer")
        self.stack.load_state_dict(saved["network"])
        self.optimizer.load_state_dict(moments)
