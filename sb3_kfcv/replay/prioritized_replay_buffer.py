"""Rank-based prioritised replay (Schaul et al. 2015; eq. 3–4 of the paper)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_kfcv.common.checks import require_between, require_count
from sb3_kfcv.replay.joint_replay_buffer import JointReplayBuffer
from sb3_kfcv.replay.ranks import importance_weights, rank_probabilities, stratified


class PrioritizedReplayBuffer(JointReplayBuffer):
    """
    Replay by the rank of |δ|: ``P ∝ (1 / rank)^α``. Every transition keeps a positive probability; a new one ranks first
    until it has been replayed.

    :param alpha: degree of prioritisation (Schaul et al.: 0.7 for ranks)
    :param beta_init: importance correction at the start (Schaul et al.: 0.5); grows linearly to 1 over training
    :param sort_above: up to this many transitions the ranks are exact at each draw; above, they are refreshed every
        ``sort_every`` draws, since sorting would cost as much as the update; new transitions wait until then
    :param sort_every: see ``sort_above``

    The other parameters are those of :class:`JointReplayBuffer`.
    """

    uses_td_errors: ClassVar[bool] = True

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        n_agents: int = 1,
        state_size: int = 0,
        seed: int | None = None,
        alpha: float = 0.7,
        beta_init: float = 0.5,
        sort_above: int = 20_000,
        sort_every: int = 10,
    ) -> None:
        super().__init__(
            buffer_size, observation_space, action_space, device, n_envs, optimize_memory_usage, n_agents, state_size, seed
        )
        require_between("alpha", alpha, 0)
        require_between("beta_init", beta_init, 0, 1)
        require_count("sort_above", sort_above, least=0)
        require_count("sort_every", sort_every)
        self.alpha, self.beta_init = alpha, beta_init
        self.sort_above, self.sort_every = sort_above, sort_every
        self.td_errors = np.full(self.buffer_size * n_envs, np.inf)  # |δ| of each row; infinite until replayed
        self._by_rank = np.empty(0, dtype=np.int64)  # rows from the largest |δ| to the smallest
        self._draws_since_sort = 0
        self._probabilities = np.empty(0)
        self._cumulative = np.empty(0)

    @property
    def beta(self) -> float:
        """Importance correction now: from ``beta_init`` to 1 as training progresses."""
        return self.beta_init + (1 - self.beta_init) * self.progress

    def reset(self) -> None:
        super().reset()
        self._by_rank = np.empty(0, dtype=np.int64)

    def add(self, *args: Any, **kwargs: Any) -> None:
        first = self.pos * self.n_envs
        self.td_errors[first : first + self.n_envs] = np.inf
        super().add(*args, **kwargs)

    def _draw(self, batch_size: int) -> tuple[np.ndarray, np.ndarray | None]:
        n = self.n_rows
        self._draws_since_sort += 1
        exact = n <= self.sort_above
        if exact or len(self._by_rank) == 0 or self._draws_since_sort >= self.sort_every:
            self._by_rank = np.argsort(-self.td_errors[:n], kind="stable" if exact else "quicksort")
            self._draws_since_sort = 0
        n = len(self._by_rank)
        if len(self._probabilities) != n:
            self._probabilities = rank_probabilities(n, self.alpha)
            self._cumulative = np.cumsum(self._probabilities)
        ranks = stratified(self._cumulative, batch_size, self.rng)
        weights = importance_weights(self._probabilities[ranks], n, self._probabilities[-1], self.beta)
        return self._by_rank[ranks], weights

    def update_priorities(self, rows: np.ndarray, td_errors: th.Tensor) -> None:
        self.td_errors[rows] = td_errors.cpu().numpy()

    def diagnostics(self) -> dict[str, Any]:
        known = self.td_errors[: self.n_rows]
        known = known[np.isfinite(known)]
        stats: dict[str, Any] = {"per/beta": self.beta, "per/not_yet_replayed": 1 - len(known) / max(self.n_rows, 1)}
        if len(known):
            stats["per/td_error_median"] = float(np.median(known))
            stats["per/td_errors"] = th.as_tensor(known)
        return stats

    def state(self) -> dict[str, Any]:
        replayed = self.td_errors[: self.n_rows]
        return {
            **super().state(),
            "td_errors": replayed,
            "by_rank": self._by_rank,
            "draws_since_sort": self._draws_since_sort,
        }

    def _set_bookkeeping(self, state: dict[str, Any], rows: np.ndarray, own_rows: np.ndarray) -> None:
        td_errors, by_rank = state["td_errors"], state["by_rank"]
        n_rows = state["n_envs"] * min(state["n_steps"], state["n_added"])
        if td_errors.shape != (n_rows,) or td_errors.dtype != self.td_errors.dtype or not (td_errors >= 0).all():
            raise ValueError("not a replay buffer of this model: its td_errors are no |δ| of its transitions")
        is_order = by_rank.dtype == np.int64 and np.array_equal(np.sort(by_rank), np.arange(len(by_rank)))
        if not is_order or len(by_rank) > len(td_errors):
            raise ValueError("not a replay buffer of this model: its by_rank is no order of its transitions")
        require_count("draws_since_sort", state["draws_since_sort"], least=0)
        self.td_errors[:] = np.inf
        self.td_errors[own_rows] = td_errors[rows]
        self._by_rank = by_rank if np.array_equal(rows, own_rows) else np.empty(0, dtype=np.int64)
        self._draws_since_sort = state["draws_since_sort"]
