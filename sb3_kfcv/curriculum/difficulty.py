"""How hard a transition is: the error of the teachers that have not seen it (eq. 10–11)."""

from __future__ import annotations

import numpy as np
import torch as th


def cross_validated_errors(targets: th.Tensor, teacher_values: th.Tensor, folds: th.Tensor) -> th.Tensor:
    """
    ``c_j = Σ_{i ≠ fold(j)} (y_j − Q_i)²`` (eq. 10–11), for each agent.

    :param targets: y, (agents, n)
    :param teacher_values: Q of each teacher, (folds, agents, n)
    :param folds: fold of each transition, (n,)
    :return: (agents, n)
    """
    squared = (targets - teacher_values).square()
    own = squared.gather(0, folds.expand(1, *targets.shape)).squeeze(0)
    return squared.sum(0) - own


def combine_agents(errors: th.Tensor, live: th.Tensor) -> np.ndarray:
    """
    One score per transition: each agent's errors over their mean, so that no agent's reward scale rules, averaged over
    the agents alive in the transition.

    :param errors: (agents, n)
    :param live: 1 where the agent lived, (agents, n)
    :return: (n,) scores; 0 where nobody lived
    """
    mean = (errors * live).sum(1, keepdim=True) / live.sum(1, keepdim=True).clamp(min=1)
    relative = errors / mean.clamp(min=th.finfo(errors.dtype).tiny)
    return ((relative * live).sum(0) / live.sum(0).clamp(min=1)).cpu().numpy()


def buckets_by_difficulty(scores: np.ndarray, n_buckets: int) -> np.ndarray:
    """
    Bucket of each transition when ranked from easy to hard into equal buckets C_1 … C_K (section 4.2).

    :param scores: (n,)
    :param n_buckets: K
    :return: (n,) buckets 0 (easy) … K−1 (hard), equal in size to within one
    """
    ranks = np.empty(len(scores), dtype=np.int64)
    ranks[np.argsort(scores, kind="stable")] = np.arange(len(scores))
    return ranks * n_buckets // max(len(scores), 1)
