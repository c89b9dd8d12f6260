"""What each stage of the curriculum draws from (section 4.2 and eq. 12)."""

from __future__ import annotations

import numpy as np

STAGE_RULES = ("cumulative", "bucket", "anti", "random")


def stage_at(progress: float, curriculum_fraction: float, n_stages: int) -> int:
    """
    The stage: K equal ones over the curriculum's share of training, then stage K + 1, the whole buffer, to the end.

    :param progress: share of training done, in [0, 1]
    :param curriculum_fraction: share of training that the curriculum takes
    :param n_stages: K
    :return: 1 … K + 1
    """
    if progress >= curriculum_fraction:
        return n_stages + 1
    return 1 + int(progress / curriculum_fraction * n_stages)


def uniform_share(progress: float, curriculum_fraction: float, lambda_init: float) -> float:
    """
    λ, the share of each minibatch drawn uniformly from the whole buffer: from ``lambda_init`` to 1 as the curriculum ends.

    :param progress: share of training done, in [0, 1]
    :param curriculum_fraction: share of training that the curriculum takes
    :param lambda_init: λ at the start; 0 keeps it 0 until the curriculum ends (section 4.2 to the letter)
    """
    if progress >= curriculum_fraction:
        return 1.0
    if lambda_init == 0:
        return 0.0
    return lambda_init + (1 - lambda_init) * progress / curriculum_fraction


def bucket_shares(stage: int, n_buckets: int, rule: str) -> np.ndarray:
    """
    How much of the curriculum's share of a minibatch comes from each bucket.

    ``"cumulative"``: equal shares of C_1 … C_i in stage i (eq. 12); ``"bucket"``: C_i alone; ``"anti"``: equal shares of
    C_K … C_{K−i+1}, hard to easy; ``"random"``: as cumulative, over buckets that are filled at random.

    :param stage: i, 1 … K; beyond K all buckets have equal shares
    :param n_buckets: K
    :param rule: one of ``STAGE_RULES``
    :return: (K,) shares of sum one
    """
    shares = np.zeros(n_buckets)
    reached = min(stage, n_buckets)
    if rule == "bucket" and stage <= n_buckets:
        shares[stage - 1] = 1
    elif rule == "anti":
        shares[n_buckets - reached :] = 1
    else:
        shares[:reached] = 1
    return shares / shares.sum()


class BucketMembers:
    """
    The transitions of each bucket that have not been overwritten since they were ranked. What a draw costs depends on the
    minibatch, hardly on the size of the buffer.

    A buffer is overwritten in the order of its rows, round and round. So of its rows in ascending order a bucket has lost
    one run (two, where the writing went on from the buffer's start), and a binary search finds where it ends.

    :param buckets: bucket of each row, negative for none, (rows,)
    :param n_buckets: K
    :param next_row: the row that is written next
    """

    def __init__(self, buckets: np.ndarray, n_buckets: int, next_row: int) -> None:
        self.n_rows = len(buckets)
        scored = np.flatnonzero(buckets >= 0)
        self._offsets = np.arange(n_buckets) * self.n_rows
        self._keys = np.sort(self._offsets[buckets[scored]] + scored)  # bucket by bucket the rows, ascending
        self._starts = np.searchsorted(self._keys, self._offsets)  # of each bucket
        self._ends = np.searchsorted(self._keys, self._offsets + self.n_rows)
        self._next_row, self._cuts = next_row, np.searchsorted(self._keys, self._offsets + next_row)
        self.sizes = self._ends - self._starts  # (K,) number of transitions still held
        self._lost_from, self._n_lost = self._cuts, np.zeros_like(self.sizes)

    def forget(self, next_row: int, n_written: int) -> None:
        """
        Leave out what has been overwritten.

        :param next_row: the row that is written next
        :param n_written: number of rows written since they were ranked
        """
        cuts = np.searchsorted(self._keys, self._offsets + next_row)
        if n_written >= self.n_rows:
            self.sizes = np.zeros_like(self.sizes)
        elif next_row >= self._next_row:
            self._lost_from, self._n_lost = self._cuts, cuts - self._cuts
            self.sizes = self._ends - self._starts - self._n_lost
        else:
            self._lost_from, self._n_lost = self._starts, cuts - self._starts
            self.sizes = self._cuts - cuts

    def rows(self, buckets: np.ndarray, places: np.ndarray) -> np.ndarray:
        """
        :param buckets: which buckets, (n,)
        :param places: which of each bucket's transitions that are still held, in ascending order, 0 … size − 1, (n,)
        :return: their rows, (n,)
        """
        positions = self._starts[buckets] + places
        positions += (positions >= self._lost_from[buckets]) * self._n_lost[buckets]
        return self._keys[positions] - self._offsets[buckets]
