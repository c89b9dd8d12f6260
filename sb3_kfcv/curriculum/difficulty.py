"""How hard a transition is: the error of the teachers that have not seen it (eq. 10–11)."""

from __future__ import annotations

import numpy as np
import torch as th

UNSCORED = -1
"""Bucket of a transition that has no score."""


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


def seen_errors(targets: th.Tensor, teacher_values: th.Tensor, folds: th.Tensor) -> th.Tensor:
    """
    ``(y_j − Q_fold(j))²``: the error of the one teacher that was trained on the transition, the control for cross validation.

    The parameters and what is returned are those of :func:`cross_validated_errors`.
    """
    own = teacher_values.gather(0, folds.expand(1, *targets.shape)).squeeze(0)
    return (targets - own).square()


def mean_of_the_living(values: th.Tensor, live: th.Tensor, weights: th.Tensor | None = None) -> th.Tensor:
    """
    Mean over the transitions in which each agent lived.

    :param values: (agents, n)
    :param live: 1 where the agent lived, (agents, n)
    :param weights: how much each transition counts, at least 1; by default all the same, (n,)
    :return: (agents, 1); 0 for agents that never lived
    """
    counted = live if weights is None else live * weights
    return (values * counted).sum(1, keepdim=True) / counted.sum(1, keepdim=True).clamp(min=1)


def combine_agents(
    errors: th.Tensor, live: th.Tensor, weights: th.Tensor | None = None, unit: th.Tensor | None = None
) -> np.ndarray:
    """
    One score per transition: each agent's errors over their mean, so that no agent's reward scale rules, averaged over
    the agents alive in the transition.

    :param errors: (agents, n)
    :param live: 1 where the agent lived, (agents, n)
    :param weights: how much each transition counts in the mean, at least 1; by default all the same, (n,)
    :param unit: errors whose mean takes the place of their own, where these may be below 0, (agents, n)
    :return: (n,) scores; 0 where nobody lived
    """
    mean = mean_of_the_living(errors if unit is None else unit, live, weights)
    relative = errors * live / mean.clamp(min=th.finfo(errors.dtype).tiny)
    return (relative.sum(0) / live.sum(0).clamp(min=1)).cpu().numpy()


def stratum_weights(scored: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """
    How much each of a refresh's transitions counts in means that stand for the whole buffer.

    Scores of different refreshes are comparable if each is relative to the mean error over the whole buffer when it was
    measured. A refresh measures a part, by choice and not by chance: all that is new, and few of what had a score. So the
    mean is a stratified one: those without a score until now stand for all of these, those that had one for all of
    those. It follows the teachers at once as they learn, where a running mean lags; and new transitions may be
    harder than the others, which in units of the part's own mean they could not be.

    :param scored: which transitions of the buffer had a score, (buffer,)
    :param rows: those that the refresh works on, (n,)
    :return: (n,) float32; all 1 if the refresh works on all
    """
    again = scored[rows]
    n_again, n_scored = int(again.sum()), int(scored.sum())
    of_old = n_scored / max(n_again, 1)
    of_new = (len(scored) - n_scored) / max(len(rows) - n_again, 1)
    return np.where(again, of_old, of_new).astype(np.float32)


def rows_to_score(scored: np.ndarray, ages: np.ndarray, oldest: int, at_most: int) -> np.ndarray:
    """
    Which transitions a refresh works on: those without a score, the newest first, then those with the oldest scores, of
    equally old ones the first.

    :param scored: which rows have a score, (n,)
    :param ages: how old the scores are, (n,)
    :param oldest: the row that was stored first; the later ones follow it, round and round
    :param at_most: how many
    :return: rows, ascending
    """
    if at_most >= len(scored):
        return np.arange(len(scored))
    rows = np.flatnonzero(~scored)
    if len(rows) >= at_most:
        by_time = np.roll(rows, -np.searchsorted(rows, oldest))
        return np.sort(by_time[len(rows) - at_most :])
    n_more, candidates = at_most - len(rows), np.flatnonzero(scored)
    age = np.sort(ages[candidates])[-n_more]  # of the youngest score to be renewed
    older, as_old = candidates[ages[candidates] > age], candidates[ages[candidates] == age]
    return np.sort(np.concatenate([rows, older, as_old[: n_more - len(older)]]))


def buckets_by_difficulty(scores: np.ndarray, n_buckets: int) -> np.ndarray:
    """
    Bucket of each transition when ranked from easy to hard into equal buckets C_1 … C_K (section 4.2).

    :param scores: (n,)
    :param n_buckets: K
    :return: (n,) buckets 0 (easy) … K−1 (hard), equal in size to within one; of equal scores the first are the easier
    """
    n = len(scores)
    first_ranks = -(-np.arange(n_buckets + 1) * n // n_buckets)  # of each bucket, rounded up
    sizes = np.diff(first_ranks)
    buckets = np.zeros(n, dtype=np.int64)
    if n >= n_buckets:
        for easiest in np.sort(scores)[first_ranks[1:-1]]:
            buckets += scores >= easiest
    if not np.array_equal(np.bincount(buckets, minlength=n_buckets), sizes):  # equal scores on both sides of a border
        buckets[np.argsort(scores, kind="stable")] = np.repeat(np.arange(n_buckets), sizes)
    return buckets


def rank_correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Spearman's ρ, equal values sharing their mean rank; 0 where one of them is constant."""
    if np.ptp(first) == 0 or np.ptp(second) == 0:
        return 0.0
    return float(np.corrcoef(_mean_ranks(first), _mean_ranks(second))[0, 1])


def _mean_ranks(values: np.ndarray) -> np.ndarray:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[inverse]
