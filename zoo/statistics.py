"""
What can be said of few training runs: inter-quartile means, stratified bootstrap intervals, probability of improvement and
performance profiles, as in Agarwal et al. 2021, *Deep Reinforcement Learning at the Edge of the Statistical Precipice*.

Scores are one number per run, in strata: world → (runs,). A bootstrap draws runs with replacement within each world.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.special import stdtrit
from scipy.stats import mannwhitneyu, rankdata, trim_mean

from sb3_kfcv.common.evaluation import CONFIDENCE, Interval

Scores = Mapping[str, np.ndarray]

# Draws of the bootstrap.
N_RESAMPLES = 5_000

# Of fewer runs an interval says little: too few different samples can be drawn from them.
ENOUGH_RUNS = 5

# Runs of two that are alike are taken for unlike with this probability, at most.
LEVEL = 1 - CONFIDENCE

# Draws of the permutation test, where it is not exact.
N_PERMUTATIONS = 20_000

# A difference that is there should be shown with this probability.
POWER = 0.8


def iqm(values: np.ndarray) -> np.ndarray:
    """
    The mean of the middle half: a quarter of the values, rounded down, is left out at either end.

    :param values: (..., runs)
    :return: (...)
    """
    return trim_mean(values, 0.25, axis=-1)


def resampled(values: np.ndarray, rng: np.random.Generator, n_resamples: int = N_RESAMPLES) -> np.ndarray:
    """
    Runs drawn with replacement.

    :param values: (runs,)
    :param rng: draws them
    :param n_resamples: how often
    :return: (resamples, runs)
    """
    return values[rng.integers(len(values), size=(n_resamples, len(values)))]


def iqm_curve(values: np.ndarray, rng: np.random.Generator, n_resamples: int = N_RESAMPLES) -> list[Interval]:
    """
    The IQM over runs at each of several times, and its 95 % bootstrap interval. A run is drawn with all its times.

    :param values: (times, runs)
    :param rng: of the bootstrap
    :param n_resamples: its draws
    :return: (times,); the bounds are NaN for a single run
    """
    n_runs = values.shape[1]
    drawn = resampled(np.arange(n_runs), rng, n_resamples)
    return [with_percentiles(float(iqm(own)), iqm(own[drawn]), n_runs) for own in values]


def iqm_with_interval(scores: Scores, rng: np.random.Generator, n_resamples: int = N_RESAMPLES) -> Interval:
    """
    The IQM over all runs of all worlds, and its 95 % stratified bootstrap interval.

    :param scores: world → (runs,)
    :param rng: of the bootstrap
    :param n_resamples: its draws
    :return: the bounds are NaN where a world has a single run
    """
    estimate = iqm(np.concatenate([*scores.values()]))
    draws = np.concatenate([resampled(values, rng, n_resamples) for values in scores.values()], axis=-1)
    return with_percentiles(float(estimate), iqm(draws), fewest(scores))


def improvement(better: Scores, than: Scores) -> float:
    """
    The probability that a run of the one has a higher score than a run of the other, P(X > Y); ties count half. The mean over
    worlds, each of which counts the same.

    :param better: X: world → (runs,)
    :param than: Y, in the same worlds
    """
    return float(np.mean([_improvement(better[world], than[world]) for world in better]))


def improvement_with_interval(
    better: Scores, than: Scores, rng: np.random.Generator, n_resamples: int = N_RESAMPLES
) -> Interval:
    """
    :func:`improvement` and its 95 % stratified bootstrap interval.

    :param better: X: world → (runs,)
    :param than: Y, in the same worlds
    :param rng: of the bootstrap
    :param n_resamples: its draws
    :return: the bounds are NaN where a world has a single run of either
    """
    draws = np.mean(
        [
            _improvement(resampled(better[world], rng, n_resamples), resampled(than[world], rng, n_resamples))
            for world in better
        ],
        axis=0,
    )
    return with_percentiles(improvement(better, than), draws, min(fewest(better), fewest(than)))


def ahead(better: Scores, than: Scores, rng: np.random.Generator) -> bool | None:
    """
    The rule of all verdicts on two: whether runs of the one have higher scores than runs of the other, by
    :func:`permutation_test`.

    :param better: X: world → (runs,)
    :param than: Y, in the same worlds
    :param rng: of the test
    :return: ``None`` if it cannot be told: also of fewer than ``ENOUGH_RUNS`` runs of either in any world, and where a score
        is no number
    """
    scores = [*better.values(), *than.values()]
    if min(fewest(better), fewest(than)) < ENOUGH_RUNS or np.isnan(np.concatenate(scores)).any():
        return None
    return improvement(better, than) > 0.5 if permutation_test(better, than, rng) < LEVEL else None


def permutation_test(better: Scores, than: Scores, rng: np.random.Generator, n_permutations: int = N_PERMUTATIONS) -> float:
    """
    How probable an :func:`improvement` so far from one half is if the runs of both are drawn alike: how often it is as far
    from it with the runs of each world dealt out anew. In one world this is the two-sided rank test of Mann and Whitney, and
    exact unless some scores are equal.

    :param better: X: world → (runs,), numbers
    :param than: Y, in the same worlds
    :param rng: deals
    :param n_permutations: how often, where all ways are too many to count
    :return: p
    """
    ranks = {world: rankdata(np.concatenate([better[world], than[world]])) for world in better}
    if len(ranks) == 1 and all(len(np.unique(own)) == len(own) for own in ranks.values()):
        (world,) = ranks
        return float(mannwhitneyu(better[world], than[world], method="exact").pvalue)
    dealt = []
    for world, own in ranks.items():
        n, m = len(better[world]), len(than[world])
        of_better = rng.permuted(np.tile(own, (n_permutations, 1)), axis=1)[:, :n].sum(axis=1)
        dealt.append((of_better - n * (n + 1) / 2) / (n * m))  # the share of pairs in which X is higher
    far = abs(improvement(better, than) - 0.5) - 1e-9  # the same by another order of sums
    return float((1 + (np.abs(np.mean(dealt, axis=0) - 0.5) >= far).sum()) / (1 + n_permutations))


def _improvement(better: np.ndarray, than: np.ndarray) -> np.ndarray:
    """P(X > Y) of each draw: (..., runs) and (..., runs) → (...)."""
    better, than = better[..., :, None], than[..., None, :]
    return ((better > than) + 0.5 * (better == than)).mean(axis=(-2, -1))


def difference_with_interval(
    values: np.ndarray, others: np.ndarray, rng: np.random.Generator, n_resamples: int = N_RESAMPLES
) -> Interval:
    """
    The difference of two IQMs and its 95 % bootstrap interval.

    :param values: (runs,)
    :param others: what is taken from them (runs,)
    :param rng: of the bootstrap
    :param n_resamples: its draws
    :return: the bounds are NaN for a single run of either
    """
    draws = iqm(resampled(values, rng, n_resamples)) - iqm(resampled(others, rng, n_resamples))
    return with_percentiles(float(iqm(values) - iqm(others)), draws, min(len(values), len(others)))


def smallest_difference(values: np.ndarray, others: np.ndarray) -> float:
    """
    The difference of two means that so many runs, which vary so much, show with probability ``POWER``: by a two-sided t-test
    of 5 %, its power approximated by a central t distribution.

    :param values: (runs,)
    :param others: (runs,)
    :return: NaN for less than two runs of either
    """
    n, m = len(values), len(others)
    if min(n, m) < 2:
        return float("nan")
    freedom = n + m - 2
    variance = ((n - 1) * values.var(ddof=1) + (m - 1) * others.var(ddof=1)) / freedom
    quantiles = stdtrit(freedom, (1 + CONFIDENCE) / 2) + stdtrit(freedom, POWER)
    return float(quantiles * np.sqrt(variance * (1 / n + 1 / m)))


def profile(scores: Scores, thresholds: np.ndarray) -> np.ndarray:
    """
    The performance profile: the share of all runs whose score is above a threshold.

    :param scores: world → (runs,)
    :param thresholds: (thresholds,)
    :return: (thresholds,)
    """
    return _above(np.concatenate([*scores.values()]), thresholds)


def profile_with_intervals(
    scores: Scores, thresholds: np.ndarray, rng: np.random.Generator, n_resamples: int = N_RESAMPLES
) -> list[Interval]:
    """
    :func:`profile` and its 95 % stratified bootstrap intervals, one for each threshold.

    :param scores: world → (runs,)
    :param thresholds: (thresholds,)
    :param rng: of the bootstrap
    :param n_resamples: its draws
    """
    draws = np.concatenate([resampled(values, rng, n_resamples) for values in scores.values()], axis=-1)
    return [
        with_percentiles(float(share), _above(draws, threshold)[..., 0], fewest(scores))
        for share, threshold in zip(profile(scores, thresholds), thresholds[:, None], strict=True)
    ]


def _above(values: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """(..., runs) and (thresholds,) → (..., thresholds)."""
    return (values[..., None, :] > thresholds[:, None]).mean(axis=-1)


def fewest(scores: Scores) -> int:
    """The number of runs in the world that has the fewest."""
    return min(map(len, scores.values()))


def with_percentiles(estimate: float, draws: np.ndarray, n_runs: int) -> Interval:
    """
    An estimate and the interval that holds the middle 95 % of its bootstrap draws.

    :param estimate: takes the place of the mean
    :param draws: (resamples,)
    :param n_runs: from how many they were drawn; a single one does not vary, and has no interval: its bounds are NaN
    """
    if n_runs < 2:
        return Interval(estimate, np.nan, np.nan)
    low, high = np.quantile(draws, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(estimate, float(low), float(high))
