"""The rules of rank-based prioritised replay (eq. 3–4), as pure functions."""

from __future__ import annotations

import numpy as np


def rank_probabilities(n: int, alpha: float) -> np.ndarray:
    """
    P of rank 1 … n: p = 1/rank (eq. 4), P = p^α / Σ p^α (eq. 3).

    :param n: number of transitions
    :param alpha: degree of prioritisation; 0 is uniform
    :return: (n,) probabilities, falling, all positive, of sum one
    """
    mass = np.arange(1, n + 1, dtype=np.float64) ** -alpha
    return mass / mass.sum()


def importance_weights(probabilities: np.ndarray, n: int, smallest: float, beta: float) -> np.ndarray:
    """
    (n·P)^−β, divided by the largest weight in the buffer.

    :param probabilities: (batch,) P of the drawn transitions
    :param n: number of transitions in the buffer
    :param smallest: smallest P in the buffer, whose weight is the largest
    :param beta: degree of correction; 1 is full
    :return: (batch,) weights in (0, 1]
    """
    return (n * probabilities) ** -beta / (n * smallest) ** -beta


def stratified(cumulative: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    """
    ``size`` draws, one from each of ``size`` segments of equal probability mass.

    :param cumulative: (n,) cumulative probabilities
    :param size: number of draws
    :param rng: generator
    :return: (size,) indices into ``cumulative``
    """
    points = (np.arange(size) + rng.random(size)) / size
    return np.minimum(np.searchsorted(cumulative, points, side="right"), len(cumulative) - 1)
