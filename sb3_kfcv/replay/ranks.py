"""The rules of rank-based prioritised replay (eq. 3–4), as pure functions."""

from __future__ import annotations

import numpy as np


def cumulative_masses(n: int, alpha: float) -> np.ndarray:
    """
    p^α of rank 1 … n with p = 1/rank (eq. 4), added up. Of n transitions the rank k is drawn with P(k) = k^−α / Σ p^α (eq. 3),
    and the sum over the first n ranks is the n-th of these, however many follow.

    :param n: number of ranks
    :param alpha: degree of prioritisation; 0 is uniform
    :return: (n,) rising
    """
    return np.cumsum(np.arange(1, n + 1, dtype=np.float64) ** -alpha)


def importance_weights(ranks: np.ndarray, n: int, alpha: float, beta: float) -> np.ndarray:
    """
    (n·P)^−β, divided by the largest weight in the buffer, that of the last rank: (P(rank) / P(n))^−β = (rank / n)^(α β).

    :param ranks: (batch,) ranks of the drawn transitions, 1 … n
    :param n: number of transitions in the buffer
    :param alpha: degree of prioritisation
    :param beta: degree of correction; 1 is full
    :return: (batch,) weights in (0, 1]
    """
    return (ranks / n) ** (alpha * beta)


def stratified(cumulative: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    """
    ``size`` draws, one from each of ``size`` segments of equal probability mass.

    :param cumulative: (n,) cumulative masses
    :param size: number of draws
    :param rng: generator
    :return: (size,) indices into ``cumulative``, rising
    """
    points = (np.arange(size) + rng.random(size)) * (cumulative[-1] / size)
    return np.minimum(np.searchsorted(cumulative, points, side="right"), len(cumulative) - 1)
