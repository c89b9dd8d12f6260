"""
Ratings of the players of two sides from the table of their matches: Elo, for where somebody wins, and the maximum-entropy Nash
equilibrium of Balduzzi et al. 2018 ("Re-evaluating evaluation"), for any pay-off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog, minimize
from scipy.special import expit, log_expit, logsumexp, ndtri, softmax

from sb3_kfcv.common.evaluation import CONFIDENCE, Interval

POINTS = 400 / np.log(10)
"""Elo points per unit of log-odds: 400 points are odds of 10 to 1."""

# Whoever has a positive share in some best strategy, beyond what rounding in the linear programs may give.
LEAST_SHARE = 1e-6
# How far, on the scale of the pay-offs, a best strategy may miss the value of the game: rounding of the linear programs.
SLACK = 1e-9


@dataclass(frozen=True)
class Elo:
    """
    Ratings in Elo points, with 95 % intervals.

    :param rows: of each player of the rows
    :param columns: of each player of the columns
    """

    rows: list[Interval]
    columns: list[Interval]


def elo(wins: np.ndarray, n_games: int) -> Elo:
    """
    Ratings by maximum likelihood (Bradley and Terry): row i beats column j with probability 1 / (1 + 10^((c_j − r_i) / 400)).

    All matches enter at once, so their order does not matter. One game more is counted for every player, a draw against
    somebody rated 0: it keeps the ratings of those who win or lose every game finite, and weighs the less the more games there
    are. Only differences mean something, so the mean of all ratings is put at 0; the intervals, from the curvature of the
    likelihood at its maximum, are of the distances from it.

    :param wins: games that each row won against each column, draws counted as halves (rows, columns)
    :param n_games: games of each match
    """
    n_rows, n_columns = wins.shape
    losses = n_games - wins

    def minus_log_likelihood(ratings: np.ndarray) -> float:
        gap = ratings[:n_rows, None] - ratings[n_rows:]
        games = (wins * log_expit(gap)).sum() + (losses * log_expit(-gap)).sum()
        return -(games + 0.5 * (log_expit(ratings) + log_expit(-ratings)).sum())

    def gradient(ratings: np.ndarray) -> np.ndarray:
        surplus = n_games * expit(ratings[:n_rows, None] - ratings[n_rows:]) - wins  # expected wins beyond those won
        return np.concatenate([surplus.sum(axis=1), -surplus.sum(axis=0)]) + expit(ratings) - 0.5

    def curvature(ratings: np.ndarray) -> np.ndarray:
        chance = expit(ratings[:n_rows, None] - ratings[n_rows:])
        spread, own = n_games * chance * (1 - chance), expit(ratings) * expit(-ratings)
        diagonal = np.diag(np.concatenate([spread.sum(axis=1), spread.sum(axis=0)]) + own)
        cross = np.block([[np.zeros((n_rows, n_rows)), spread], [spread.T, np.zeros((n_columns, n_columns))]])
        return diagonal - cross

    start = np.zeros(n_rows + n_columns)
    found = minimize(minus_log_likelihood, start, jac=gradient, hess=curvature, method="trust-exact", options={"gtol": 1e-9}).x
    centring = np.eye(len(found)) - 1 / len(found)
    variances = np.diag(centring @ np.linalg.inv(curvature(found)) @ centring)
    half_widths = POINTS * ndtri((1 + CONFIDENCE) / 2) * np.sqrt(variances)
    ratings = [
        Interval(float(mean), float(mean - half), float(mean + half))
        for mean, half in zip(POINTS * centring @ found, half_widths, strict=True)
    ]
    return Elo(ratings[:n_rows], ratings[n_rows:])


@dataclass(frozen=True)
class Equilibrium:
    """
    The maximum-entropy Nash equilibrium of a zero-sum game.

    :param value: what the rows get when both sides play it
    :param rows: how often the rows' side plays each of its players (rows,)
    :param columns: how often the columns' side plays each of its players (columns,)
    :param row_pay_offs: what each row gets against the columns' equilibrium (rows,); at most the value
    :param column_pay_offs: what the rows' equilibrium gets against each column (columns,); at least the value
    """

    value: float
    rows: np.ndarray
    columns: np.ndarray
    row_pay_offs: np.ndarray
    column_pay_offs: np.ndarray


def equilibrium(pay_offs: np.ndarray) -> Equilibrium:
    """
    Of all Nash equilibria of the zero-sum game between rows and columns, that of the most even strategies. It is unique,
    copies of a player share its part and change nothing else, and a player who loses to an equilibrium has no part in any.

    :param pay_offs: what the rows get and the columns lose (rows, columns)
    """
    scale = float(np.ptp(pay_offs)) or 1.0
    game = (pay_offs - pay_offs.mean()) / scale
    value = _value(game)
    rows, columns = _most_even(game - value), _most_even(value - game.T)
    return Equilibrium(
        value=float(rows @ pay_offs @ columns),
        rows=rows,
        columns=columns,
        row_pay_offs=pay_offs @ columns,
        column_pay_offs=rows @ pay_offs,
    )


def _value(game: np.ndarray) -> float:
    """What the rows can make sure of, by linear programming; ``game`` is (rows, columns)."""
    n_rows, n_columns = game.shape
    solved = linprog(
        c=[0.0] * n_rows + [-1.0],
        A_ub=np.column_stack([-game.T, np.ones(n_columns)]),
        b_ub=np.zeros(n_columns),
        A_eq=[[1.0] * n_rows + [0.0]],
        b_eq=[1.0],
        bounds=[(0, None)] * n_rows + [(None, None)],
    )
    return float(solved.x[-1])


def _most_even(game: np.ndarray) -> np.ndarray:
    """
    Of the rows' strategies that lose to no column, the one of the greatest entropy.

    The rows that have a share in any such strategy all have one in it. Among them it is p ∝ exp(game · w) with a weight w ≥ 0
    for each column, which minimise log Σ exp(game · w) (the dual problem).

    :param game: pay-offs of the rows (rows, columns), of value 0
    :return: strategy of the rows (rows,)
    """
    n_rows, n_columns = game.shape
    safe = {"A_ub": -game.T, "b_ub": np.full(n_columns, SLACK), "A_eq": np.ones((1, n_rows)), "b_eq": [1.0]}
    most = [-linprog(c=-np.eye(n_rows)[i], bounds=(0, 1), **safe).fun for i in range(n_rows)]
    own = np.flatnonzero(np.array(most) > LEAST_SHARE)

    def dual(weights: np.ndarray) -> tuple[float, np.ndarray]:
        scores = game[own] @ weights
        return float(logsumexp(scores)), softmax(scores) @ game[own]

    solved = minimize(
        dual,
        np.zeros(n_columns),
        jac=True,
        method="L-BFGS-B",
        bounds=[(0, None)] * n_columns,
        options={"ftol": 0.0, "gtol": 1e-10, "maxiter": 10_000, "maxfun": 100_000, "maxcor": 50},
    )
    strategy = np.zeros(n_rows)
    strategy[own] = softmax(game[own] @ solved.x)
    return strategy
