"""Curriculum replay: K-fold cross-validated difficulty, drawn from easy to hard."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_kfcv.common.checks import require_between, require_count, require_finite
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.common.stacked_networks import at_most
from sb3_kfcv.curriculum.difficulty import (
    UNSCORED,
    buckets_by_difficulty,
    combine_agents,
    cross_validated_errors,
    mean_of_the_living,
    rank_correlation,
    rows_to_score,
    seen_errors,
    stratum_weights,
)
from sb3_kfcv.curriculum.folds import assign_folds, rows_per_fold
from sb3_kfcv.curriculum.stages import STAGE_RULES, BucketMembers, bucket_shares, stage_at, uniform_share
from sb3_kfcv.curriculum.teachers import Teachers
from sb3_kfcv.replay.joint_replay_buffer import JointReplayBuffer, Student

STAGE_CLOCKS = ("training", "refresh")
SCORES = ("teachers", "seen", "student", "reducible")

# Rows that pass through the networks at once during a refresh: bounds the memory of their activations.
CHUNK = 1024

# Rows whose student's δ² is compared with their scores at a refresh: a correlation is known to 0.03 from them.
COMPARED = 1000

# What is noted of each row.
OF_EACH_ROW = ("folds", "scores", "score_ages", "buckets")


class KFCVReplayBuffer(JointReplayBuffer):
    """
    K-Fold Cross Validation Curriculum Learning (KFCV-CL) over a replay buffer: section 4 and Algorithm 1 of Lin et al. 2022.

    Every transition has a permanent fold. At each *refresh* K teachers are trained on their folds (eq. 9), transitions
    are scored by the K − 1 teachers that have not seen them (eq. 10–11), and all that have a score are ranked into K
    buckets. The stages then draw from easy to hard (eq. 12), beside a share λ drawn uniformly from the whole buffer.
    Before the first refresh all draws are uniform; a transition without a score is drawn by the uniform share alone; after
    the curriculum's share of training all draws are uniform and refreshes stop.

    A refresh works on all transitions of a buffer of up to ``scored_per_update`` × ``refresh_every`` (8,750), and on so
    many of a larger one: on those that have no score yet, the newest first, then on those whose scores are the oldest.
    Targets, training and new scores are of these alone; a transition's fold is the same in each refresh, so no teacher
    ever scores what it was trained on. Scores of different refreshes are ranked together; what makes them comparable is
    :func:`~sb3_kfcv.curriculum.difficulty.stratum_weights`.

    It knows transitions and the TD target of the learner that it is attached to, no particular algorithm.

    :param n_folds: K: folds, teachers, buckets and stages
    :param refresh_every: updates between refreshes (Algorithm 1 as printed refreshes at every step, at many times the cost)
    :param refresh_fraction: refresh sooner when this share of the transitions is new and ``scored_per_update`` allows to work
        on all of the buffer; beyond 1: never sooner
    :param scored_per_update: bound of the cost: a refresh works on at most this many transitions per update since the last
        one, whatever the size of the buffer and the number of worlds that fill it
    :param teacher_steps: gradient steps of the teachers per refresh
    :param first_teacher_steps: the same at the first refresh, from random networks
    :param teacher_batch_size: transitions per teacher and step
    :param teacher_learning_rate: of the teachers' Adam
    :param teacher_net_arch: hidden sizes of the teachers; wider than the student's, since one network serves all agents
    :param stage_rule: ``"cumulative"``, ``"bucket"``, or the controls ``"anti"`` (hard to easy) and ``"random"``;
        see :func:`~sb3_kfcv.curriculum.stages.bucket_shares`
    :param stage_clock: ``"training"``: the K stages take the curriculum's share of training; ``"refresh"``, the other reading
        of section 4.2: they begin anew with every refresh, and take as long as there was between the last two
    :param lambda_init: Table 1's "initial curriculum factor λ": the uniform share at the start; 0 is section 4.2 to the letter
    :param curriculum_fraction: share of training that the curriculum takes
    :param score: ``"teachers"``, or a control: ``"seen"``, the error of the one teacher that was trained on the transition
        (no cross validation); ``"student"``, the learner's own squared TD error; ``"reducible"``, the learner's minus the mean
        of the teachers that have not seen it: what is still to be learnt, without what is noise to all

    The other parameters are those of :class:`~sb3_kfcv.replay.JointReplayBuffer`.
    """

    noted_bytes: ClassVar[int] = 3 * 8 + 4  # fold, score and its age, bucket

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
        n_folds: int = 5,
        refresh_every: int = 250,
        refresh_fraction: float = 0.25,
        scored_per_update: int = 35,
        teacher_steps: int = 25,
        first_teacher_steps: int = 300,
        teacher_batch_size: int = 128,
        teacher_learning_rate: float = 1e-3,
        teacher_net_arch: Sequence[int] = (128, 128),
        stage_rule: str = "cumulative",
        stage_clock: str = "training",
        lambda_init: float = 0.1,
        curriculum_fraction: float = 0.5,
        score: str = "teachers",
    ) -> None:
        super().__init__(
            buffer_size, observation_space, action_space, device, n_envs, optimize_memory_usage, n_agents, state_size, seed
        )
        n_rows = self.buffer_size * n_envs
        require_count("n_folds", n_folds, least=2)
        if n_folds > n_rows:
            raise ValueError(f"n_folds must lie between 2 and the buffer's {n_rows} transitions, got {n_folds}")
        if stage_rule not in STAGE_RULES:
            raise ValueError(unknown_name("stage_rule", stage_rule, STAGE_RULES))
        if stage_clock not in STAGE_CLOCKS:
            raise ValueError(unknown_name("stage_clock", stage_clock, STAGE_CLOCKS))
        if score not in SCORES:
            raise ValueError(unknown_name("score", score, SCORES))
        for name, count in (("refresh_every", refresh_every), ("scored_per_update", scored_per_update)):
            require_count(name, count)
        for name, count in (("teacher_steps", teacher_steps), ("first_teacher_steps", first_teacher_steps)):
            require_count(name, count)
        require_count("teacher_batch_size", teacher_batch_size)
        for name, share in (("lambda_init", lambda_init), ("curriculum_fraction", curriculum_fraction)):
            require_between(name, share, 0, 1)
        require_between("refresh_fraction", refresh_fraction, 0, above=True)
        require_between("teacher_learning_rate", teacher_learning_rate, 0)
        self.n_folds = n_folds
        self.refresh_every, self.refresh_fraction, self.scored_per_update = refresh_every, refresh_fraction, scored_per_update
        self.teacher_steps, self.first_teacher_steps = teacher_steps, first_teacher_steps
        self.teacher_batch_size = teacher_batch_size
        self.teacher_learning_rate, self.teacher_net_arch = teacher_learning_rate, tuple(teacher_net_arch)
        self.stage_rule, self.stage_clock, self.score = stage_rule, stage_clock, score
        self.lambda_init, self.curriculum_fraction = lambda_init, curriculum_fraction

        self.folds = assign_folds(n_rows, n_folds, self.rng)  # (rows,)
        self.scores = np.zeros(n_rows)  # (rows,) c_j when it was last scored
        self.score_ages = np.zeros(n_rows, dtype=np.int64)  # (rows,) updates from then to the last refresh
        self.buckets = np.full(n_rows, UNSCORED, dtype=np.int32)  # (rows,) 0 … K−1, or UNSCORED
        self._members: BucketMembers | None = None  # made at the first draw after a ranking, with n_added of that time
        self._ranked_at = 0
        self._updates_since_refresh = 0
        self._last_wait = refresh_every  # updates between the last two refreshes
        self._new_since_refresh = 0
        self.n_refreshes = 0
        self._warned = False
        self._stats: dict[str, Any] = {}
        self._refresh_seconds = 0.0

    @property
    def stage(self) -> int:
        """1 … K, and K + 1 when the curriculum is over."""
        stage = stage_at(self.progress, self.curriculum_fraction, self.n_folds)
        if self.stage_clock == "training" or stage > self.n_folds:
            return stage
        return min(1 + self.n_folds * self._updates_since_refresh // self._last_wait, self.n_folds)

    @property
    def lambda_now(self) -> float:
        """λ: the share of each minibatch drawn uniformly from the whole buffer."""
        return uniform_share(self.progress, self.curriculum_fraction, self.lambda_init)

    def attach(self, student: Student) -> None:
        """
        Meet the learner, and make its teachers.

        :param student: gives the teachers' inputs, TD targets and Q-values
        """
        self.student = student
        with at_most(math.inf):  # a model's file does not hold them
            self.teachers = Teachers(
                self.n_folds,
                student.n_learning_agents,
                student.teacher_input_size,
                self.teacher_net_arch,
                self.teacher_learning_rate,
                self.device,
            )

    def reset(self) -> None:
        super().reset()
        self.buckets[:] = UNSCORED
        self._members = None

    def add(self, *args: Any, **kwargs: Any) -> None:
        first = self.pos * self.n_envs
        self.buckets[first : first + self.n_envs] = UNSCORED
        self._new_since_refresh += self.n_envs
        super().add(*args, **kwargs)

    def _draw(self, batch_size: int) -> tuple[np.ndarray, None]:
        if self.stage <= self.n_folds:
            self._updates_since_refresh += 1
            if self._refresh_is_due():
                self.refresh(self._budget())
        elif self.n_refreshes == 0 and not self._warned:
            warnings.warn("the curriculum's share of training was over before learning began: all replay is uniform")
            self._warned = True
        return self.curriculum_rows(batch_size), None

    def curriculum_rows(self, batch_size: int) -> np.ndarray:
        """
        Draw rows by the mixture of now: λ uniform over the buffer, 1 − λ over the buckets of the stage.

        The shares hold in each minibatch to within one row (systematic sampling).

        :param batch_size: number of rows
        """
        rows = self._uniform_rows(batch_size)
        if self.stage > self.n_folds or self.n_refreshes == 0:
            return rows
        members = self._bucket_members()
        shares = bucket_shares(self.stage, self.n_folds, self.stage_rule) * (members.sizes > 0)
        if shares.sum() == 0:  # all of the stage's transitions have been overwritten since the last refresh
            return rows
        shares *= (1 - self.lambda_now) / shares.sum()
        points = (np.arange(batch_size) + self.rng.random()) / batch_size
        source = np.searchsorted(np.cumsum(shares), points, side="right")  # bucket, or K for the uniform share
        scored = source < self.n_folds
        bucket = source[scored]
        sizes = members.sizes[bucket]
        rows[scored] = members.rows(bucket, sizes - 1 - self.rng.integers(sizes))
        return rows

    def _bucket_members(self) -> BucketMembers:
        next_row = self.pos * self.n_envs
        if self._members is None:
            self._members, self._ranked_at = BucketMembers(self.buckets, self.n_folds, next_row), self.n_added
        self._members.forget(next_row, (self.n_added - self._ranked_at) * self.n_envs)
        return self._members

    def _refresh_is_due(self) -> bool:
        n, waited = self.n_rows, self._updates_since_refresh
        if self.n_refreshes == 0:
            return n >= self.n_folds
        many_new = self._new_since_refresh >= self.refresh_fraction * n
        return waited >= self.refresh_every or (many_new and waited * self.scored_per_update >= n)

    def _budget(self) -> int:
        """How many transitions a refresh may work on; the first one as if it were not sooner."""
        waited = self._updates_since_refresh
        return self.scored_per_update * (waited if self.n_refreshes else max(waited, self.refresh_every))

    def refresh(self, at_most: int | None = None) -> None:
        """
        Train the teachers, score transitions, rank all that have a score into buckets: the assessment of section 4.1.

        Waits for a larger ``at_most`` where these are so few that a fold has none of them.

        :param at_most: how many transitions to work on, see :func:`~sb3_kfcv.curriculum.difficulty.rows_to_score`; by
            default all
        """
        start = time.perf_counter()
        n = self.n_rows
        oldest = self.pos * self.n_envs if self.full else 0
        known = self.buckets[:n] != UNSCORED
        rows = rows_to_score(known, self.score_ages[:n], oldest, n if at_most is None else at_most)
        members = rows_per_fold(self.folds[rows], self.n_folds)
        if not all(len(places) for places in members):
            return
        weights = th.as_tensor(stratum_weights(known, rows), device=self.device)
        inputs, targets, live = self._assessed(rows)
        compared = slice(None, None, 1 if self.score in ("student", "reducible") else -(-len(rows) // COMPARED))
        student_errors = (targets[:, compared] - self._student_values(rows[compared])).square()
        if self.score == "student":
            scores = combine_agents(student_errors, live, weights)
        else:
            errors, variances = self._teacher_errors(inputs, targets, live, weights, self.folds[rows], members)
            if self.score == "reducible":
                of_student = student_errors / variances
                scores = combine_agents(of_student - errors / (self.n_folds - 1), live, weights, unit=of_student)
            else:
                scores = combine_agents(errors, live, weights)
        self._note_correlations(rows, scores, compared, combine_agents(student_errors, live[:, compared]))
        if self.stage_rule == "random":
            scores = self.rng.random(len(rows))
        self.scores[rows] = scores
        self.score_ages[:n] += self._updates_since_refresh
        self.score_ages[rows] = 0
        self.buckets[rows] = 0
        scored = np.flatnonzero(self.buckets[:n] != UNSCORED)
        self.buckets[scored] = buckets_by_difficulty(self.scores[scored], self.n_folds)
        self._members = None
        if self.n_refreshes:
            self._last_wait = max(self._updates_since_refresh, 1)
        self._updates_since_refresh = self._new_since_refresh = 0
        self.n_refreshes += 1
        self._refresh_seconds += time.perf_counter() - start

    def _assessed(self, rows: np.ndarray) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Teacher inputs (n, features); TD targets, and 1 where the agent lived, (agents, n)."""
        student = self.student
        inputs = th.empty(len(rows), student.teacher_input_size, device=self.device)
        targets, live = th.empty(2, student.n_learning_agents, len(rows), device=self.device)
        for part in slices(len(rows)):
            batch = self.rows(rows[part])
            inputs[part] = student.teacher_inputs(batch)
            targets[:, part], live[:, part] = student.td_target(batch), student.live(batch)
        return inputs, targets, live

    def _student_values(self, rows: np.ndarray) -> th.Tensor:
        """The student's Q, (agents, n)."""
        return th.cat([self.student.q_values(self.rows(rows[part])) for part in slices(len(rows))], dim=1)

    def _teacher_errors(
        self,
        inputs: th.Tensor,
        targets: th.Tensor,
        live: th.Tensor,
        weights: th.Tensor,
        folds: np.ndarray,
        members: list[np.ndarray],
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Train the teachers on their folds, and take the errors of those that have not seen each row (eq. 9–11): (agents, n) in
        units of the variance of each agent's targets, and these variances, (agents, 1).
        """
        # Targets in units of their own spread: eq. 9 has the same minimum, and few steps come near it.
        targets = targets - mean_of_the_living(targets, live, weights)
        spreads = mean_of_the_living(targets.square(), live, weights).sqrt().clamp(min=1e-6)
        targets = targets / spreads
        steps = self.teacher_steps if self.n_refreshes else self.first_teacher_steps
        in_fold_loss = self.teachers.fit(inputs, targets, live, members, steps, self.teacher_batch_size, self.rng)
        errors, fold = th.empty_like(targets), th.as_tensor(folds, device=self.device)
        rule = seen_errors if self.score == "seen" else cross_validated_errors
        with th.no_grad():
            for part in slices(len(folds)):
                values = self.teachers.values(inputs[part].unsqueeze(0))
                errors[:, part] = rule(targets[:, part], values, fold[part])
        self._stats["curriculum/teacher_loss_in_fold"] = in_fold_loss
        if self.score != "seen":
            held_out_loss = (errors * live).sum() / live.sum().clamp(min=1) / (self.n_folds - 1)
            self._stats["curriculum/teacher_loss_held_out"] = held_out_loss.item()
        return errors, spreads.square()

    def _note_correlations(self, rows: np.ndarray, scores: np.ndarray, compared: slice, student_scores: np.ndarray) -> None:
        """How the ranking agrees with the scores before, and with the student's own squared TD error."""
        known = self.buckets[rows] != UNSCORED
        if known.sum() > 1:
            self._stats["curriculum/rank_correlation_with_last"] = rank_correlation(self.scores[rows[known]], scores[known])
        self._stats["curriculum/rank_correlation_with_student"] = rank_correlation(scores[compared], student_scores)

    def diagnostics(self) -> dict[str, Any]:
        """
        Stage, λ, shares, score quantiles per bucket, the teachers' losses, rank correlations, the share of transitions
        without a score, and the scores themselves with their mean age in updates.
        """
        stats: dict[str, Any] = {
            **self._stats,
            "curriculum/stage": self.stage,
            "curriculum/lambda": self.lambda_now,
            "curriculum/refreshes": self.n_refreshes,
            "time/refresh_seconds": self._refresh_seconds,
        }
        if self.n_refreshes == 0 or self.stage > self.n_folds:
            return stats
        shares = bucket_shares(self.stage, self.n_folds, self.stage_rule) * (1 - self.lambda_now)
        scored = np.flatnonzero(self.buckets[: self.n_rows] != UNSCORED)
        scores, buckets = self.scores[scored], self.buckets[scored]
        for bucket in range(self.n_folds):
            of_bucket = scores[buckets == bucket]
            stats[f"curriculum/share_bucket_{bucket + 1}"] = shares[bucket]
            if len(of_bucket):
                low, median, high = np.quantile(of_bucket, [0.1, 0.5, 0.9])
                stats[f"curriculum/score_bucket_{bucket + 1}_q10"] = low
                stats[f"curriculum/score_bucket_{bucket + 1}_q50"] = median
                stats[f"curriculum/score_bucket_{bucket + 1}_q90"] = high
        stats["curriculum/unscored"] = 1 - len(scored) / self.n_rows
        if len(scored):
            stats["curriculum/score_age"] = float(self.score_ages[scored].mean()) + self._updates_since_refresh
            stats["curriculum/scores"] = th.as_tensor(scores)
        return stats

    def state(self) -> dict[str, Any]:
        return {
            **super().state(),
            **{name: getattr(self, name) for name in OF_EACH_ROW},
            "updates_since_refresh": self._updates_since_refresh,
            "last_wait": self._last_wait,
            "new_since_refresh": self._new_since_refresh,
            "n_refreshes": self.n_refreshes,
            "warned": self._warned,
            "teachers": self.teachers.state_dict(),
            "stats": self._stats,
            "refresh_seconds": self._refresh_seconds,
        }

    def set_state(self, state: dict[str, Any], transitions: dict[str, np.ndarray]) -> None:
        # A file without ages is of a time when each refresh scored all transitions.
        same_age = np.zeros(np.shape(state.get("scores", ())), dtype=np.int64)
        super().set_state({"score_ages": same_age, "last_wait": self.refresh_every, **state}, transitions)

    def _set_bookkeeping(self, state: dict[str, Any], rows: np.ndarray, own_rows: np.ndarray) -> None:
        size = state["n_steps"] * state["n_envs"]
        folds, scores, ages, buckets = (state[name] for name in OF_EACH_ROW)
        for name, values in zip(OF_EACH_ROW, (folds, scores, ages, buckets), strict=True):
            if values.shape != (size,) or values.dtype != getattr(self, name).dtype:
                raise ValueError(f"not a replay buffer of this model: its {name} are {values.shape} of {values.dtype}")
        require_finite("scores of the replay buffer", scores)
        n_rows = min(state["n_steps"], state["n_added"]) * state["n_envs"]
        some_empty = n_rows >= self.n_folds > len(np.unique(folds[:n_rows]))
        if some_empty or not ((folds >= 0) & (folds < self.n_folds)).all():
            raise ValueError(f"not a replay buffer of this model: its folds are not 0 to {self.n_folds - 1}")
        if not ((buckets >= UNSCORED) & (buckets < self.n_folds)).all() or (buckets[n_rows:] != UNSCORED).any():
            raise ValueError("not a replay buffer of this model: its buckets are not those of its transitions")
        if (ages < 0).any():
            raise ValueError("not a replay buffer of this model: its scores have negative ages")
        for name in ("updates_since_refresh", "new_since_refresh", "n_refreshes"):
            require_count(name, state[name], least=0)
        require_count("last_wait", state["last_wait"])
        require_between("refresh_seconds", state["refresh_seconds"], 0)
        stats = dict(state["stats"])
        for name, value in stats.items():
            require_between(str(name), value, -np.inf)
        self.teachers.load_state_dict(state["teachers"])
        self.buckets[:] = UNSCORED
        same = size == len(self.folds) and np.array_equal(rows, own_rows)
        for name in OF_EACH_ROW:
            values = getattr(self, name)
            values[slice(None) if same else own_rows] = state[name][slice(None) if same else rows]
        self._updates_since_refresh, self._last_wait = state["updates_since_refresh"], state["last_wait"]
        self._new_since_refresh = state["new_since_refresh"]
        self.n_refreshes, self._warned = state["n_refreshes"], bool(state["warned"])
        self._members = None
        self._stats, self._refresh_seconds = stats, float(state["refresh_seconds"])


def slices(n: int) -> list[slice]:
    """0 … n − 1 in runs of ``CHUNK``."""
    return [slice(first, min(first + CHUNK, n)) for first in range(0, n, CHUNK)]
