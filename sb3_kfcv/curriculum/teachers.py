"""The teachers: K critics, each trained on its own fold alone (eq. 9)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch as th

from sb3_kfcv.common.stacked_networks import StackedMLP


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
        self.optimizer = th.optim.Adam(self.stack.parameters(), lr=learning_rate, fused=True)

    def values(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: (folds, batch, features), one batch per teacher; or (1, batch, features), the same for all
        :return: Q (folds, agents, batch)
        """
        return self.stack(inputs.expand(self.n_folds, -1, -1)).transpose(1, 2)

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
        losses = []
        for _ in range(steps):
            drawn = np.stack([rows[rng.integers(len(rows), size=batch_size)] for rows in rows_per_fold])  # (folds, batch)
            picked = th.as_tensor(drawn, device=inputs.device)
            errors = (targets[:, picked].transpose(0, 1) - self.values(inputs[picked])).square()  # (folds, agents, batch)
            lived = live[:, picked].transpose(0, 1)
            per_teacher = (errors * lived).sum(-1) / lived.sum(-1).clamp(min=1)  # (folds, agents)
            self.optimizer.zero_grad()
            per_teacher.sum().backward()
            self.optimizer.step()
            losses.append(per_teacher.detach().mean())
        return th.stack(losses[-max(steps // 10, 1) :]).mean().item()

    def state_dict(self) -> dict[str, th.Tensor]:
        """Networks and optimiser moments, by flat names."""
        moments = self.optimizer.state_dict()["state"]
        return {
            **{f"network.{name}": value for name, value in self.stack.state_dict().items()},
            **{f"adam.{i}.{name}": value for i, state in moments.items() for name, value in state.items()},
        }

    def load_state_dict(self, saved: dict[str, th.Tensor]) -> None:
        """Inverse of :meth:`state_dict`."""
        self.stack.load_state_dict({n.removeprefix("network."): v for n, v in saved.items() if n.startswith("network.")})
        moments: dict[int, dict[str, th.Tensor]] = {}
        for key, value in saved.items():
            if key.startswith("adam."):
                _, index, name = key.split(".")
                moments.setdefault(int(index), {})[name] = value
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
