"""The teachers: K critics per learning agent, each trained on its own fold alone (eq. 9)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch as th

from sb3_kfcv.common.stacked_networks import StackedMLP


class Teachers:
    """
    All K·N teacher critics as one stack. They start from their own random initialisation and live as long as the
    buffer; never from the student, which has seen every fold.

    :param n_folds: K
    :param n_agents: N, the learning agents
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
        self.n_folds, self.n_agents = n_folds, n_agents
        self.stack = StackedMLP(n_folds * n_agents, [input_size, *net_arch, 1], n_inputs=n_folds).to(device)
        self.optimizer = th.optim.Adam(self.stack.parameters(), lr=learning_rate, fused=True)

    def values(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: (folds, batch, features), one batch per teacher; or (1, batch, features), the same for all
        :return: Q (folds, agents, batch)
        """
        q_values = self.stack(inputs.expand(self.n_folds, -1, -1)).squeeze(-1)
        return q_values.unflatten(0, (self.n_folds, self.n_agents))

    def fit(
        self,
        rows_per_fold: list[np.ndarray],
        read: Callable[[np.ndarray], tuple[th.Tensor, th.Tensor, th.Tensor]],
        steps: int,
        batch_size: int,
        rng: np.random.Generator,
    ) -> float:
        """
        Regress every teacher on the TD targets of its own fold (eq. 9).

        :param rows_per_fold: the rows of each fold; none empty
        :param read: rows → inputs (batch, features), targets (agents, batch), and 1 where the agent lived (agents, batch)
        :param steps: gradient steps
        :param batch_size: transitions per teacher and step
        :param rng: generator of the draws
        :return: mean squared error over the last tenth of the steps, on the teachers' own folds
        """
        losses = []
        for _ in range(steps):
            drawn = np.concatenate([rows[rng.integers(len(rows), size=batch_size)] for rows in rows_per_fold])
            inputs, targets, live = read(drawn)  # (folds · batch, …), fold after fold
            values = self.values(inputs.unflatten(0, (self.n_folds, batch_size)))  # (folds, agents, batch)
            errors = (targets.unflatten(1, (self.n_folds, batch_size)).transpose(0, 1) - values).square()
            live = live.unflatten(1, (self.n_folds, batch_size)).transpose(0, 1)
            per_teacher = (errors * live).sum(-1) / live.sum(-1).clamp(min=1)  # (folds, agents)
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
