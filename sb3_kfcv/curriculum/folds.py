"""Folds: which teacher a transition belongs to."""

from __future__ import annotations

import numpy as np


def assign_folds(n_rows: int, n_folds: int, rng: np.random.Generator) -> np.ndarray:
    """
    The permanent fold of every row of a buffer: each run of ``n_folds`` rows holds every fold once, in random order.

    So any first n rows are split equally to within one, whatever n is; and neighbours in time, which are near
    duplicates, fall into different folds.

    :param n_rows: capacity of the buffer
    :param n_folds: K
    :param rng: generator
    :return: (n_rows,) fold of each row, 0 … K−1
    """
    n_runs = -(-n_rows // n_folds)
    runs = rng.permuted(np.tile(np.arange(n_folds, dtype=np.int64), (n_runs, 1)), axis=1)
    return runs.ravel()[:n_rows]


def rows_per_fold(folds: np.ndarray, n_folds: int) -> list[np.ndarray]:
    """
    The rows of each fold, ascending.

    :param folds: (n,) fold of each row
    :param n_folds: K
    """
    return [np.flatnonzero(folds == fold) for fold in range(n_folds)]
