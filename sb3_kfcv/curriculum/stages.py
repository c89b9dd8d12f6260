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
