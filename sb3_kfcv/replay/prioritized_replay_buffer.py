"""Rank-based prioritised replay (Schaul et al. 2015; eq. 3–4 of the paper)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_kfcv.common.checks import require_between
from sb3_kfcv.replay.joint_replay_buffer import JointReplayBuffer
from sb3_kfcv.replay.rank_order import RankOrder
from sb3_kfcv.replay.ranks import cumulative_masses, importance_weights, stratified

# What the state of a buffer may also hold: an order of the rows, which follows from their |δ|.
NOT_READ = ("by_rank", "draws_since_sort")


class PrioritizedReplayBuffer(JointReplayBuffer):
    """
    Replay by the rank of |δ|: ``P ∝ (1 / rank)^α``. Every transition keeps a positive probability; a new one ranks first
    until it has been replayed. The ranks are exact at each draw.

    :param alpha: degree of prioritisation (Schaul et al.: 0.7 for ranks)
    :param beta_init: importance correction at the start (Schaul et al.: 0.5); grows linearly to 1 over training

    The other parameters are those of :class:`JointReplayBuffer`.
    """

    uses_td_errors: ClassVar[bool] = True
    noted_bytes: ClassVar[int] = RankOrder.bytes_per_row + 2 * 8  # |δ| and the masses

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
    ) -> None:
        super().__init__(
            buffer_size, observation_space, action_space, device, n_envs, optimize_memory_usage, n_agents, state_size, seed
        )
        require_between("alpha", alpha, 0)
        require_between("beta_init", beta_init, 0, 1)
        self.alpha, self.beta_init = alpha, beta_init
        self.td_errors = np.full(self.buffer_size * n_envs, np.inf)  # |δ| of each row; infinite until replayed
        self._ranks = RankOrder(len(self.td_errors))
        self._masses = cumulative_masses(len(self.td_errors), alpha)

    @property
    def beta(self) -> float:
        """Importance correction now: from ``beta_init`` to 1 as training progresses."""
        return self.beta_init + (1 - self.beta_init) * self.progress

    @property
    def n_bytes(self) -> int:
        return super().n_bytes + self._ranks.n_bytes

    def reset(self) -> None:
        super().reset()
        self._ranks.forget()

    def add(self, *args: Any, **kwargs: Any) -> None:
        first = self.pos * self.n_envs
        self.td_errors[first : first + self.n_envs] = np.inf
        self._ranks.note(np.arange(first, first + self.n_envs))
        super().add(*args, **kwargs)

    def _draw(self, batch_size: int) -> tuple[np.ndarray, np.ndarray | None]:
        n = self.n_rows
        by_rank = self._ranks.by_rank(self.td_errors[:n])
        places = stratified(self._masses[:n], batch_size, self.rng)
        weights = importance_weights(places + 1, n, self.alpha, self.beta)
        return by_rank[places].astype(np.int64), weights

    def update_priorities(self, rows: np.ndarray, td_errors: th.Tensor) -> None:
        self.td_errors[rows] = td_errors.cpu().numpy()
        self._ranks.note(np.array(rows, dtype=np.int64))

    def diagnostics(self) -> dict[str, Any]:
        known = self.td_errors[: self.n_rows]
        known = known[np.isfinite(known)]
        stats: dict[str, Any] = {"per/beta": self.beta, "per/not_yet_replayed": 1 - len(known) / max(self.n_rows, 1)}
        if len(known):
            stats["per/td_error_median"] = float(np.median(known))
            stats["per/td_errors"] = th.as_tensor(known)
        return stats

    def state(self) -> dict[str, Any]:
        return {**super().state(), "td_errors": self.td_errors[: self.n_rows]}

    def set_state(self, state: dict[str, Any], transitions: dict[str, np.ndarray]) -> None:
        super().set_state({name: value for name, value in state.items() if name not in NOT_READ}, transitions)

    def _set_bookkeeping(self, state: dict[str, Any], rows: np.ndarray, own_rows: np.ndarray) -> None:
        td_errors = state["td_errors"]
        n_rows = state["n_envs"] * min(state["n_steps"], state["n_added"])
        if td_errors.shape != (n_rows,) or td_errors.dtype != self.td_errors.dtype or not (td_errors >= 0).all():
            raise ValueError("not a replay buffer of this model: its td_errors are no |δ| of its transitions")
        self.td_errors[:] = np.inf
        self.td_errors[own_rows] = td_errors[rows]
        self._ranks.forget()
