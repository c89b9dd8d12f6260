"""Curriculum replay: folds, teachers (eq. 9), difficulty (eq. 10–11), buckets and stages (eq. 12)."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from scipy.stats import spearmanr

from sb3_kfcv import KFCVReplayBuffer
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
from sb3_kfcv.curriculum.stages import BucketMembers, bucket_shares, stage_at, uniform_share
from sb3_kfcv.curriculum.teachers import Teachers

OBS, ACT = spaces.Box(-np.inf, np.inf, (3,), np.float32), spaces.Box(-1, 1, (1,), np.float32)


class Student:
    """
    A learner with one agent or more, whose target is the reward and whose Q-values are all 0.

    What critics read is the observation: (serial number / 1000, and two features).
    """

    teacher_input_size = 3

    def __init__(self, n_agents=1):
        self.n_learning_agents = n_agents

    def teacher_inputs(self, batch):
        return batch.observations

    def td_target(self, batch):
        return batch.rewards.T

    def q_values(self, batch):
        return th.zeros(self.n_learning_agents, len(batch.rows))

    def live(self, batch):
        return batch.alive.T


def make_buffer(size=60, n_envs=1, n_agents=1, filled=True, **kwargs):
    """A buffer whose next draw refreshes it."""
    few = {"teacher_batch_size": 8, "teacher_steps": 2, "first_teacher_steps": 2, "scored_per_update": 10**9}
    kwargs = {"n_folds": 3, "seed": 0, **few, **kwargs}
    buffer = KFCVReplayBuffer(size, OBS, ACT, device="cpu", n_envs=n_envs, n_agents=n_agents, **kwargs)
    th.manual_seed(0)
    buffer.attach(Student(n_agents))
    buffer.serial = 0
    buffer.maker = np.random.default_rng(1)
    if filled:
        add(buffer, buffer.buffer_size)
    return buffer


def add(buffer, steps, alive=True):
    """Transitions with serial numbers, random features and random rewards."""
    n_agents = buffer.rewards.shape[-1]
    for _ in range(steps):
        obs = buffer.maker.normal(size=(buffer.n_envs, 3)).astype(np.float32)
        obs[:, 0] = (buffer.serial + np.arange(buffer.n_envs)) / 1000
        buffer.serial += buffer.n_envs
        infos = [
            {
                "agent_rewards": buffer.maker.normal(size=n_agents).astype(np.float32),
                "agent_terminated": np.zeros(n_agents, bool),
                "agent_alive": np.full(n_agents, alive),
            }
            for _ in range(buffer.n_envs)
        ]
        zeros = np.zeros(buffer.n_envs)
        buffer.add(obs, obs, np.zeros((buffer.n_envs, 1)), zeros, zeros, infos)


def serials(observations):
    return (observations[..., 0] * 1000).round().int()


# ---- folds


@pytest.mark.parametrize("n_folds", [2, 3, 5, 7])
def test_folds_are_equal_to_within_one_at_every_fill(n_folds):
    """Any buffer size, and any number of transitions that it holds so far."""
    for n_rows in (n_folds, 11, 128, 1003):
        folds = assign_folds(n_rows, n_folds, np.random.default_rng(n_rows))
        assert len(folds) == n_rows
        counts = np.cumsum(folds[:, None] == np.arange(n_folds), axis=0)
        assert (np.ptp(counts, axis=1) <= 1).all()


def test_folds_are_drawn_not_dealt():
    folds = assign_folds(1000, 5, np.random.default_rng(0)).reshape(200, 5)
    assert len({tuple(run) for run in folds.tolist()}) > 50  # of 120 orders


def test_every_row_is_in_its_fold():
    members = rows_per_fold(np.array([0, 2, 1, 0, 2]), 3)
    assert [m.tolist() for m in members] == [[0, 3], [2], [1, 4]]


@pytest.mark.parametrize("n_envs", [1, 4])
def test_folds_are_permanent(n_envs):
    buffer = make_buffer(size=60, n_envs=n_envs, refresh_every=1)
    before = buffer.folds.copy()
    for _ in range(5):
        buffer.sample(8)
        add(buffer, 7)
    np.testing.assert_array_equal(buffer.folds, before)


# ---- teachers


def spy_on_teachers(buffer):
    """What each teacher may be trained on: fold → set of serial numbers, filled as the buffer refreshes."""
    fed = [set() for _ in range(buffer.n_folds)]
    fit = buffer.teachers.fit

    def spied(inputs, targets, live, members, *others):
        for seen, own in zip(fed, members, strict=True):
            seen.update(serials(inputs[own]).tolist())
        return fit(inputs, targets, live, members, *others)

    buffer.teachers.fit = spied
    return fed


def test_a_teacher_learns_from_its_own_rows_alone():
    """Other inputs and targets in the rows of fold 1 leave teachers 0 and 2 what they are, to the bit."""

    def fitted(disturbed):
        th.manual_seed(0)
        teachers = Teachers(3, 2, 4, [8], 0.01, "cpu")
        inputs, targets = th.randn(30, 4), th.randn(2, 30)
        inputs[disturbed], targets[:, disturbed] = 7.0, -7.0
        members = [np.arange(fold, 30, 3) for fold in range(3)]
        teachers.fit(inputs, targets, th.ones(2, 30), members, 20, 8, np.random.default_rng(0))
        return teachers.values(th.ones(1, 1, 4))

    before, after = fitted([]), fitted(list(range(1, 30, 3)))
    assert th.equal(before[[0, 2]], after[[0, 2]])
    assert not th.isclose(before[1], after[1]).any()


@pytest.mark.parametrize("n_envs", [1, 3])
def test_no_transition_ever_reaches_two_teachers(n_envs):
    """Over many refreshes, while the buffer is overwritten more than twice."""
    buffer = make_buffer(size=60, n_envs=n_envs, refresh_every=1, teacher_steps=20, filled=False)
    fed = spy_on_teachers(buffer)
    for _ in range(30):
        add(buffer, 5)
        buffer.sample(4)
    assert buffer.n_refreshes >= 20
    assert sum(len(seen) for seen in fed) == len(set.union(*fed))
    assert min(len(seen) for seen in fed) > 30


def test_teacher_k_is_fed_fold_k():
    buffer = make_buffer(teacher_steps=50, first_teacher_steps=50)
    fed = spy_on_teachers(buffer)
    buffer.sample(4)
    for fold, seen in enumerate(fed):
        assert seen == set(np.flatnonzero(buffer.folds == fold).tolist())  # serial numbers are row numbers here


def test_teachers_start_from_networks_of_their_own():
    """Not from one another, either."""
    buffer = make_buffer()
    values = buffer.teachers.values(th.randn(1, 4, 3))
    assert len({round(v, 6) for v in values[:, 0, 0].tolist()}) == 3


def test_teachers_persist_between_refreshes():
    buffer = make_buffer(refresh_every=1, teacher_steps=1, teacher_learning_rate=0.0)
    before = buffer.teachers.values(th.ones(1, 1, 3))
    for _ in range(3):
        buffer.sample(4)
    th.testing.assert_close(buffer.teachers.values(th.ones(1, 1, 3)), before)


def learnt_losses(first_teacher_steps):
    """Losses after one refresh on pure noise: the targets have nothing to do with the inputs."""
    buffer = make_buffer(size=150, first_teacher_steps=first_teacher_steps, teacher_batch_size=32)
    buffer.sample(4)
    stats = buffer.diagnostics()
    return stats["curriculum/teacher_loss_in_fold"], stats["curriculum/teacher_loss_held_out"]


def test_teachers_learn_their_own_fold():
    assert learnt_losses(600)[0] < 0.5 * learnt_losses(5)[0]


def test_teachers_err_more_on_what_they_have_not_seen():
    in_fold, held_out = learnt_losses(600)
    assert held_out > 1.5 * in_fold


def test_the_dead_teach_nothing():
    """With all agents dead no teacher gets a gradient."""
    buffer = make_buffer(filled=False)
    add(buffer, 30, alive=False)
    before = buffer.teachers.values(th.ones(1, 1, 3))
    buffer.sample(4)
    assert buffer.n_refreshes == 1
    th.testing.assert_close(buffer.teachers.values(th.ones(1, 1, 3)), before)


# ---- difficulty, K = 3 folds and 2 agents by hand

Y = th.tensor([[1.0, 2.0, 3.0], [10.0, 0.0, -10.0]])  # (agents, transitions)
# Teachers 1, 2, 3 say 0, 1, 3 for agent 0, and 10, 0, −10 for agent 1, whatever the transition: (folds, agents, transitions)
Q_TEACHER = th.tensor([[0.0, 10.0], [1.0, 0.0], [3.0, -10.0]]).unsqueeze(-1).expand(3, 2, 3)
FOLDS = th.tensor([0, 1, 2])
# Agent 0: (1−1)² + (1−3)² = 4;       (2−0)² + (2−3)² = 5;    (3−0)² + (3−1)² = 13
# Agent 1: (10−0)² + (10+10)² = 500;  (0−10)² + (0+10)² = 200; (−10−10)² + (−10−0)² = 500
ERRORS = [[4.0, 5.0, 13.0], [500.0, 200.0, 500.0]]


def test_eq_10_and_11_by_hand():
    assert cross_validated_errors(Y, Q_TEACHER, FOLDS).tolist() == ERRORS


def test_the_error_of_the_teacher_that_has_seen_it_by_hand():
    """Transition j is of fold j. Agent 0: (1−0)², (2−1)², (3−3)²; agent 1: (10−10)², (0−0)², (−10+10)²."""
    assert seen_errors(Y, Q_TEACHER, FOLDS).tolist() == [[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]


def test_scores_below_zero_are_in_units_of_other_errors():
    """Units 2 and 10: (−4/2 + 20/10) / 2, (2/2 − 10/10) / 2, (6/2 + 0) / 2; agent 1 is dead in the last one: 6/2."""
    errors, unit = th.tensor([[-4.0, 2.0, 6.0], [20.0, -10.0, 7.0]]), th.tensor([[1.0, 2.0, 3.0], [5.0, 15.0, 99.0]])
    scores = combine_agents(errors, th.tensor([[1.0, 1, 1], [1, 1, 0]]), unit=unit)
    assert scores.tolist() == [0.0, 0.0, 3.0]


def test_scores_are_relative_to_each_agents_mean():
    """Means 22/3 and 400. (4·3/22 + 500/400) / 2, (5·3/22 + 200/400) / 2, (13·3/22 + 500/400) / 2."""
    scores = combine_agents(th.tensor(ERRORS), th.ones(2, 3))
    np.testing.assert_allclose(scores, [0.897727, 0.590909, 1.511364], atol=1e-5)


def test_an_agents_reward_scale_does_not_matter():
    scaled = th.tensor(ERRORS) * th.tensor([[1.0], [1e4]])
    np.testing.assert_allclose(
        combine_agents(scaled, th.ones(2, 3)), combine_agents(th.tensor(ERRORS), th.ones(2, 3)), rtol=1e-5
    )


def test_scores_are_over_the_living():
    """Agent 1 is dead in transition 0: its mean is (200 + 500) / 2 = 350; transition 0 is agent 0's 4·3/22 alone."""
    scores = combine_agents(th.tensor(ERRORS), th.tensor([[1.0, 1, 1], [0, 1, 1]]))
    np.testing.assert_allclose(scores, [12 / 22, (15 / 22 + 200 / 350) / 2, (39 / 22 + 500 / 350) / 2], rtol=1e-5)


def test_the_buffer_scores_each_transition_by_the_teachers_that_have_not_seen_it():
    """
    Against a loop over transitions and teachers. Teachers regress on y in units of its spread (y − mean) / std, which
    each agent's division by its mean error takes out again.
    """
    buffer = make_buffer(size=40, n_agents=2)
    fed = spy_on_teachers(buffer)
    buffer.sample(4)
    y = th.as_tensor(buffer.rewards[:, 0].T)
    y = (y - y.mean(1, keepdim=True)) / y.std(1, keepdim=True, unbiased=False)
    errors = np.zeros((2, 40))
    for j in range(40):
        with th.no_grad():
            values = buffer.teachers.values(th.as_tensor(buffer.observations[j]).unsqueeze(0))
        for agent in range(2):
            for teacher in range(3):
                if j not in fed[teacher] and buffer.folds[j] != teacher:
                    errors[agent, j] += float(y[agent, j] - values[teacher, agent, 0]) ** 2
    expected = (errors / errors.mean(axis=1, keepdims=True)).mean(axis=0)
    np.testing.assert_allclose(buffer.scores, expected, rtol=1e-3)


@pytest.mark.parametrize("score", ["seen", "reducible"])
def test_the_controls_of_the_teachers_scores(score):
    """Against a loop over transitions and teachers. The student's Q is 0, so its δ² is the squared reward."""
    buffer = make_buffer(size=40, n_agents=2, score=score)
    buffer.sample(4)
    y = th.as_tensor(buffer.rewards[:, 0].T)
    spread = y.std(1, keepdim=True, unbiased=False)
    student, y = (y / spread).square().numpy(), (y - y.mean(1, keepdim=True)) / spread
    seen, unseen = np.zeros((2, 40)), np.zeros((2, 40))
    for j in range(40):
        with th.no_grad():
            values = buffer.teachers.values(th.as_tensor(buffer.observations[j]).unsqueeze(0))
        for agent in range(2):
            for teacher in range(3):
                error = float(y[agent, j] - values[teacher, agent, 0]) ** 2
                if buffer.folds[j] == teacher:
                    seen[agent, j] = error
                else:
                    unseen[agent, j] += error / 2
    errors, unit = {"seen": (seen, seen), "reducible": (student - unseen, student)}[score]
    expected = (errors / unit.mean(axis=1, keepdims=True)).mean(axis=0)
    np.testing.assert_allclose(buffer.scores, expected, rtol=1e-3, atol=1e-5)
    assert (buffer.scores < 0).any() == (score == "reducible")


def test_dead_agents_weigh_nothing_however_large_their_errors_are():
    """Agent 1 never lived: its mean is 0, and 3e38 over nearly nothing is infinite."""
    scores = combine_agents(th.tensor([[1.0, 3.0], [3e38, 3e38]]), th.tensor([[1.0, 1], [0, 0]]))
    assert scores.tolist() == [0.5, 1.5]


def test_student_scores_are_the_learners_own_squared_errors():
    """Q is 0, so δ² is the squared reward; over its mean."""
    buffer = make_buffer(score="student")
    buffer.sample(4)
    squared = buffer.rewards[:, 0, 0].astype(float) ** 2
    np.testing.assert_allclose(buffer.scores, squared / squared.mean(), rtol=1e-4)


# ---- buckets


def test_buckets_go_from_easy_to_hard():
    assert buckets_by_difficulty(np.array([0.5, 9.0, 0.1, 3.0, 2.0, 7.0]), 3).tolist() == [0, 2, 0, 1, 1, 2]


@pytest.mark.parametrize("n", [5, 6, 7, 99, 100, 1001])
def test_buckets_are_equal_to_within_one(n):
    counts = np.bincount(buckets_by_difficulty(np.random.default_rng(0).random(n), 5), minlength=5)
    assert np.ptp(counts) <= 1


def test_equal_scores_still_fill_equal_buckets():
    assert np.bincount(buckets_by_difficulty(np.ones(30), 5)).tolist() == [6] * 5


def slow_buckets(scores, n_buckets):
    """By ranks; of equal scores the first rank first."""
    by_rank = sorted(range(len(scores)), key=lambda j: (scores[j], j))
    return [by_rank.index(j) * n_buckets // len(scores) for j in range(len(scores))]


@pytest.mark.parametrize("n_values", [1, 2, 5, 1000])
@pytest.mark.parametrize("n", [1, 4, 5, 37, 100])
def test_buckets_are_those_of_the_ranks(n, n_values):
    """Also where many scores are equal, and where there are fewer transitions than buckets."""
    scores = np.random.default_rng(n).integers(n_values, size=n).astype(float)
    for n_buckets in (2, 5, 8):
        assert buckets_by_difficulty(scores, n_buckets).tolist() == slow_buckets(scores.tolist(), n_buckets)


@pytest.mark.parametrize("n_values", [3, 1000])
def test_rank_correlation_is_spearmans(n_values):
    rng = np.random.default_rng(0)
    first = rng.integers(n_values, size=50).astype(float)
    second = first + rng.integers(n_values, size=50)
    assert rank_correlation(first, second) == pytest.approx(spearmanr(first, second).statistic)


def test_nothing_correlates_with_a_constant():
    assert rank_correlation(np.ones(5), np.arange(5.0)) == 0


# ---- the transitions of a refresh


@pytest.mark.parametrize(
    ("at_most", "rows"),
    [
        (1, [3]),  # row 4 is the oldest, row 3 the newest, and 1, 3, 6 have no score: newest first 3, 1, 6
        (2, [1, 3]),
        (3, [1, 3, 6]),
        (4, [1, 3, 5, 6]),  # 5 has the oldest score
        (5, [0, 1, 3, 5, 6]),  # 0 and 4 come next: of equally old ones the first
        (6, [0, 1, 3, 4, 5, 6]),
        (7, [0, 1, 2, 3, 4, 5, 6]),
        (99, [0, 1, 2, 3, 4, 5, 6]),
    ],
)
def test_first_what_has_no_score_then_what_has_the_oldest(at_most, rows):
    scored = np.array([True, False, True, False, True, True, False])
    ages = np.array([20, 99, 10, 99, 20, 30, 99])
    assert rows_to_score(scored, ages, 4, at_most).tolist() == rows


def test_strata_stand_for_themselves():
    """Of 10 transitions 6 had a score, of which 2 are scored again: each counts 3. Of the 4 others 1: it counts 4."""
    scored = np.array([True] * 6 + [False] * 4)
    assert stratum_weights(scored, np.array([0, 3, 9])).tolist() == [3, 3, 4]
    assert stratum_weights(scored, np.arange(10)).tolist() == [1] * 10


def test_a_weighted_mean_is_over_the_living():
    """(3 · 2 + 1 · 5) / (3 + 1); agent 1 lived in the last alone."""
    values, live = th.tensor([[2.0, 9, 5], [1, 1, 8]]), th.tensor([[1.0, 0, 1], [0, 0, 1]])
    assert mean_of_the_living(values, live, th.tensor([3.0, 3, 1])).tolist() == [[11 / 4], [8]]


# ---- stages


def test_k_equal_stages_then_the_whole_buffer():
    """K = 4 over the first 40 % of training: a stage takes 10 %."""
    at = {0.0: 1, 0.05: 1, 0.11: 2, 0.19: 2, 0.21: 3, 0.31: 4, 0.399: 4, 0.4: 5, 0.7: 5, 1.0: 5}
    assert {progress: stage_at(progress, 0.4, 4) for progress in at} == at


def test_stages_that_begin_anew_with_every_refresh():
    """K = 3, a refresh every 6 updates: two updates a stage, over and over, until the curriculum's share is over."""
    buffer = make_buffer(stage_clock="refresh", refresh_every=6, refresh_fraction=10.0, curriculum_fraction=0.5)
    buffer.progress = 0.1
    stages = []
    for _ in range(13):
        buffer.sample(4)
        stages.append(buffer.stage)
    assert buffer.n_refreshes == 3
    assert stages == [1, 1, 2, 2, 3, 3, 1, 1, 2, 2, 3, 3, 1]
    buffer.progress = 0.5
    assert buffer.stage == 4


def test_no_curriculum_at_all():
    assert stage_at(0.0, 0.0, 5) == 6
    assert uniform_share(0.0, 0.0, 0.1) == 1


SHARES = {
    # Eq. 12: equal shares of C_1 … C_i
    "cumulative": {1: [1, 0, 0, 0], 2: [1 / 2, 1 / 2, 0, 0], 3: [1 / 3, 1 / 3, 1 / 3, 0], 4: [1 / 4] * 4},
    "random": {1: [1, 0, 0, 0], 2: [1 / 2, 1 / 2, 0, 0], 3: [1 / 3, 1 / 3, 1 / 3, 0], 4: [1 / 4] * 4},
    "bucket": {1: [1, 0, 0, 0], 2: [0, 1, 0, 0], 3: [0, 0, 1, 0], 4: [0, 0, 0, 1]},
    "anti": {1: [0, 0, 0, 1], 2: [0, 0, 1 / 2, 1 / 2], 3: [0, 1 / 3, 1 / 3, 1 / 3], 4: [1 / 4] * 4},
}


@pytest.mark.parametrize("rule", SHARES)
def test_shares_of_the_stages(rule):
    for stage, shares in SHARES[rule].items():
        np.testing.assert_allclose(bucket_shares(stage, 4, rule), shares)


def test_lambda_grows_to_one_as_the_curriculum_ends():
    """From 0.1 in a straight line: at half the curriculum 0.1 + 0.9 / 2 = 0.55."""
    values = [uniform_share(progress, 0.5, 0.1) for progress in (0.0, 0.25, 0.4, 0.5, 0.9)]
    np.testing.assert_allclose(values, [0.1, 0.55, 0.82, 1.0, 1.0])


def test_lambda_zero_stays_zero_until_the_curriculum_ends():
    assert [uniform_share(progress, 0.5, 0.0) for progress in (0.0, 0.49, 0.5)] == [0.0, 0.0, 1.0]


# ---- draws

N = 600


def scored_buffer(progress=0.0, **kwargs):
    """600 scored transitions: buckets of 200. Refreshed once, and not again."""
    once = {"refresh_every": 10**6, "refresh_fraction": 10.0}
    kwargs = {"score": "student", "lambda_init": 0.0, "curriculum_fraction": 0.5, **once, **kwargs}
    buffer = make_buffer(size=N, **kwargs)
    buffer.sample(1)
    assert buffer.n_refreshes == 1
    buffer.progress = progress
    return buffer


def true_buckets(buffer):
    """Buckets told from the squared rewards, not from the buffer's own books."""
    ranks = (buffer.rewards[:, 0, 0] ** 2).argsort(kind="stable").argsort(kind="stable")
    return ranks // (N // 3)


# Progress of the stages 1, 2, 3 of a curriculum over the first half of training
PROGRESS = {1: 0.05, 2: 0.2, 3: 0.45}


@pytest.mark.parametrize("stage", [1, 2, 3])
@pytest.mark.parametrize("rule", ["cumulative", "bucket", "anti"])
def test_minibatches_hold_the_shares_to_within_one_row(rule, stage):
    """λ = 0: nothing but the buckets of the stage."""
    buffer = scored_buffer(PROGRESS[stage], stage_rule=rule)
    buckets = true_buckets(buffer)
    for batch_size in (7, 32, 100):
        counts = np.bincount(buckets[buffer.sample(batch_size).rows], minlength=3)
        assert np.abs(counts - bucket_shares(stage, 3, rule) * batch_size).max() <= 1


def test_the_uniform_share_is_part_of_each_minibatch():
    """λ = 0.4 in stage 1: at least 0.6 · 100 − 1 rows from C_1, and a third of the other 40 on average: 73 in all."""
    buffer = scored_buffer(lambda_init=0.4)
    buckets = true_buckets(buffer)
    counts = [np.count_nonzero(buckets[buffer.sample(100).rows] == 0) for _ in range(300)]
    assert min(counts) >= 59
    assert np.mean(counts) == pytest.approx(60 + 40 / 3, abs=0.6)


def test_draws_within_a_bucket_are_uniform():
    buffer = scored_buffer()
    counts = np.bincount(buffer.sample(20_000).rows, minlength=N)[true_buckets(buffer) == 0]
    assert counts.sum() == 20_000
    assert counts.min() > 100 - 50
    assert counts.max() < 100 + 50  # five standard deviations around 20,000 / 200


@pytest.mark.parametrize("first_row", [0, 7, 19])
@pytest.mark.parametrize("step", [1, 4])
def test_members_are_what_a_search_of_the_whole_buffer_finds(first_row, step):
    """While the rows are overwritten from ``first_row`` on, once round and beyond; every third has no bucket at first."""
    buckets = np.random.default_rng(0).integers(3, size=20)
    buckets[::3] = UNSCORED
    members, left = BucketMembers(buckets, 3, first_row), buckets.copy()
    for n_written in range(0, 45, step):
        left[(first_row + np.arange(n_written)) % 20] = UNSCORED
        members.forget((first_row + n_written) % 20, n_written)
        for bucket in range(3):
            expected = np.flatnonzero(left == bucket)
            assert members.sizes[bucket] == len(expected)
            places = np.arange(len(expected))
            assert members.rows(np.full_like(places, bucket), places).tolist() == expected.tolist()


def test_draws_after_overwriting_are_uniform_over_what_is_left():
    """
    Rows 0 … 249 of 600 are overwritten, and each bucket has lost some. Stage 3, λ = 0: a third of the draws from
    what is left of each.
    """
    buffer = scored_buffer(PROGRESS[3])
    buckets = true_buckets(buffer)
    buckets[:250] = UNSCORED
    add(buffer, 250)
    counts = np.bincount(buffer.sample(60_000).rows, minlength=N)
    assert counts[:250].sum() == 0
    for bucket in range(3):
        left = counts[buckets == bucket]
        expected = 20_000 / len(left)
        assert left.sum() == 20_000
        assert np.abs(left - expected).max() < 5 * expected**0.5


def test_random_buckets_know_nothing_of_difficulty():
    buffer = scored_buffer(stage_rule="random")
    drawn = np.unique(buffer.sample(20_000).rows)
    assert len(drawn) == N // 3  # stage 1: one bucket of three
    assert np.bincount(true_buckets(buffer)[drawn], minlength=3).min() > 40  # about 67 of each


def test_the_random_control_trains_the_same_teachers():
    buffer = make_buffer(stage_rule="random")
    buffer.sample(4)
    assert "curriculum/teacher_loss_held_out" in buffer.diagnostics()


def test_draws_are_uniform_before_the_first_refresh():
    """Fewer transitions than folds: there is nothing to train each teacher on yet."""
    buffer = make_buffer(size=60, filled=False, lambda_init=0.0)
    add(buffer, 2)
    rows = buffer.sample(4000).rows
    assert buffer.n_refreshes == 0
    np.testing.assert_allclose(np.bincount(rows, minlength=2), 2000, atol=5 * 32)


def test_new_transitions_are_never_drawn_without_a_uniform_share():
    buffer = scored_buffer(PROGRESS[3])
    add(buffer, 100)  # rows 0 … 99
    assert buffer.sample(20_000).rows.min() >= 100


def test_new_transitions_come_through_the_uniform_share():
    """λ = 0.3 in stage 1: 100 of 600 are new and get 0.3 / 6 = 5 % of the draws."""
    buffer = scored_buffer(lambda_init=0.3)
    add(buffer, 100)
    assert np.mean(buffer.sample(20_000).rows < 100) == pytest.approx(0.05, abs=0.006)


def test_a_stage_whose_transitions_are_all_overwritten_draws_uniformly():
    buffer = scored_buffer()
    add(buffer, N)
    assert len(np.unique(buffer.sample(20_000).rows)) == N


def test_after_the_curriculum_draws_are_uniform():
    buffer = scored_buffer(progress=0.5)
    assert buffer.stage == 4
    counts = np.bincount(true_buckets(buffer)[buffer.sample(30_000).rows], minlength=3)
    np.testing.assert_allclose(counts, 10_000, atol=450)


def test_after_the_curriculum_nothing_is_refreshed():
    buffer = make_buffer(refresh_every=1, curriculum_fraction=0.5)
    buffer.progress = 0.5
    for _ in range(5):
        buffer.sample(4)
        add(buffer, 40)
    assert buffer.n_refreshes == 0


# ---- refreshes


def updates_until_refresh(buffer):
    """How many draws until the next refresh."""
    before = buffer.n_refreshes
    for update in range(1, 1000):
        buffer.sample(4)
        if buffer.n_refreshes > before:
            return update
    raise AssertionError("no refresh in 1000 updates")


def test_the_first_draw_refreshes_when_there_is_enough():
    assert updates_until_refresh(make_buffer()) == 1


def test_refreshes_come_every_so_many_updates():
    buffer = make_buffer(refresh_every=12)
    assert [updates_until_refresh(buffer) for _ in range(3)] == [1, 12, 12]


@pytest.mark.parametrize(("n_new", "updates"), [(14, 40), (15, 1)])
def test_a_quarter_of_new_transitions_refreshes_sooner(n_new, updates):
    """A quarter of 60 is 15."""
    buffer = make_buffer(size=60, refresh_every=40, refresh_fraction=0.25)
    updates_until_refresh(buffer)
    add(buffer, n_new)
    assert updates_until_refresh(buffer) == updates


def test_a_sooner_refresh_waits_until_all_can_be_scored():
    """60 transitions at 6 per update: not before 10 updates, though all are new."""
    buffer = make_buffer(size=60, refresh_every=40, scored_per_update=6)
    updates_until_refresh(buffer)
    add(buffer, 60)
    assert updates_until_refresh(buffer) == 10


def test_a_refresh_scores_what_is_new():
    buffer = make_buffer(refresh_every=3)
    updates_until_refresh(buffer)
    add(buffer, 20)
    assert buffer.diagnostics()["curriculum/unscored"] == pytest.approx(20 / 60)
    updates_until_refresh(buffer)
    assert buffer.diagnostics()["curriculum/unscored"] == 0


def test_the_first_refresh_takes_more_steps():
    buffer = make_buffer(refresh_every=1, first_teacher_steps=7, teacher_steps=3)
    steps = []
    buffer.teachers.fit = lambda inputs, targets, live, members, n_steps, *others: steps.append(n_steps) or 0.0
    for _ in range(3):
        buffer.sample(4)
    assert steps == [7, 3, 3]


def incremental(**kwargs):
    """200 transitions, of which a refresh after 4 updates may score 40; what each refresh worked on: serial numbers."""
    kwargs = {"size": 200, "refresh_every": 4, "scored_per_update": 10, **kwargs}
    buffer = make_buffer(**kwargs)
    worked_on = []
    read = buffer._assessed

    def spied(rows):
        found = read(rows)
        worked_on.append(set(serials(found[0]).tolist()))
        return found

    buffer._assessed = spied
    return buffer, worked_on


def test_refreshes_keep_to_their_budget():
    """The first as if it were not sooner; then 4 updates at 10 each. Every 4 updates, however large the buffer is."""
    buffer, worked_on = incremental()
    assert [updates_until_refresh(buffer) for _ in range(4)] == [1, 4, 4, 4]
    assert [len(work) for work in worked_on] == [40, 40, 40, 40]


def test_a_refresh_on_demand_works_on_all():
    buffer, worked_on = incremental()
    buffer.refresh()
    assert worked_on == [set(range(200))]


def test_nothing_is_scored_twice_before_all_have_been_scored():
    """200 at 40 each: five refreshes without a repetition, the newest first; then from the oldest scores on."""
    buffer, worked_on = incremental()
    for _ in range(10):
        updates_until_refresh(buffer)
    by_newest = [set(range(160 - 40 * i, 200 - 40 * i)) for i in range(5)]
    assert worked_on == by_newest * 2


def test_new_transitions_are_scored_before_old_ones_are_scored_again():
    """15 new ones before each refresh: with them 25 of those whose scores are the oldest."""
    buffer, worked_on = incremental()
    for _ in range(5):
        updates_until_refresh(buffer)
    ever = set.union(*worked_on)
    for refresh in range(8):
        add(buffer, 15)
        updates_until_refresh(buffer)
        new = set(range(200 + 15 * refresh, 215 + 15 * refresh))
        assert worked_on[-1] - ever == new
        assert len(worked_on[-1]) == 40
        ever |= new
    assert buffer.diagnostics()["curriculum/unscored"] == 0


def test_no_teacher_ever_scores_what_it_was_trained_on():
    """
    Over refreshes of parts of a buffer that is overwritten more than twice: each new score is that of a loop over the teachers
    that were never fed the transition, and what is not worked on keeps its score. Both strata stand for their part of the
    buffer in the means: of the targets, of their squares, of the errors.
    """
    buffer, worked_on = incremental(n_agents=2)
    fed = spy_on_teachers(buffer)
    for _ in range(30):
        add(buffer, 15)
        had_score, before = buffer.buckets != UNSCORED, buffer.scores.copy()
        updates_until_refresh(buffer)
        rows = [j for j in range(200) if int(serials(th.as_tensor(buffer.observations[j, 0]))) in worked_on[-1]]
        n_again = had_score[rows].sum()
        weights = np.where(had_score[rows], had_score.sum() / max(n_again, 1), (~had_score).sum() / max(40 - n_again, 1))
        y = buffer.rewards[rows, 0].T.astype(float)  # (agents, 40)
        y = y - np.average(y, axis=1, weights=weights)[:, None]
        y = y / np.sqrt(np.average(y**2, axis=1, weights=weights))[:, None]
        errors = np.zeros((2, 40))
        for place, j in enumerate(rows):
            seen = th.as_tensor(buffer.observations[j])
            with th.no_grad():
                values = buffer.teachers.values(seen.unsqueeze(0))[:, :, 0].numpy()  # (folds, agents)
            strangers = [fold for fold in range(3) if int(serials(seen)[0]) not in fed[fold]]
            assert len(strangers) == 2
            errors[:, place] = ((y[:, place] - values[strangers]) ** 2).sum(0)
        expected = before.copy()
        expected[rows] = (errors / np.average(errors, axis=1, weights=weights)[:, None]).mean(0)
        np.testing.assert_allclose(buffer.scores, expected, rtol=2e-3, atol=1e-5)
    assert sum(len(seen) for seen in fed) == len(set.union(*fed)) > 400


def test_all_that_have_a_score_are_ranked_together():
    """Half of the buffer after the first 100 of 200: buckets of 33 or 34, by scores of three refreshes."""
    buffer, _ = incremental()
    for _ in range(3):
        updates_until_refresh(buffer)
    scored = buffer.buckets != UNSCORED
    assert scored.sum() == 120
    assert buffer.buckets[scored].tolist() == slow_buckets(buffer.scores[scored].tolist(), 3)


def test_new_transitions_may_be_harder_than_those_scored_before():
    """
    Scores by δ² = r². New rewards are five times the others', and the others have scores already: in the unit of the whole
    buffer, of which the new are a tenth, and not of the transitions worked on, of which they are half.
    """
    buffer, _ = incremental(score="student")
    for _ in range(5):
        updates_until_refresh(buffer)
    buffer.rewards[:] = np.sign(buffer.rewards)
    buffer.refresh()
    add(buffer, 20)
    buffer.rewards[:20] = 5
    updates_until_refresh(buffer)
    # 20 of 200 without a score, of r² = 25; the 180 others have 1: the mean is 3.4
    np.testing.assert_allclose(buffer.scores[:20], 25 / 3.4, rtol=1e-5)
    again = buffer.score_ages == 0
    assert again.sum() == 40
    np.testing.assert_allclose(buffer.scores[20:][again[20:]], 1 / 3.4, rtol=1e-5)
    assert (buffer.buckets[:20] == 2).all()


def test_a_refresh_waits_until_each_fold_has_a_transition_in_it():
    """At one transition per update: three in a run of K would do; the newest two never do."""
    buffer, worked_on = incremental(size=30, refresh_every=1, scored_per_update=1)
    buffer.refresh(2)
    assert (buffer.n_refreshes, worked_on) == (0, [])
    waited = updates_until_refresh(buffer)
    assert waited >= 3
    assert [len(work) for work in worked_on] == [waited]


def test_the_random_control_keeps_the_ranks_of_what_is_not_scored_again():
    buffer, _ = incremental(stage_rule="random")
    for _ in range(6):
        before = buffer.scores.copy()
        updates_until_refresh(buffer)
        changed = buffer.scores != before
        assert changed.sum() == 40
        assert ((buffer.scores[changed] >= 0) & (buffer.scores[changed] < 1)).all()


def test_a_buffer_smaller_than_a_teachers_minibatch_still_gets_its_curriculum():
    """Full, it never grows any further: waiting for more would be waiting for ever."""
    buffer = make_buffer(size=60, teacher_batch_size=128)
    buffer.sample(4)
    assert buffer.n_refreshes == 1


# ---- what it shows


def test_diagnostics_of_section_6():
    buffer = make_buffer(refresh_every=1)
    for _ in range(2):
        buffer.sample(4)
    stats = buffer.diagnostics()
    expected = {
        "stage",
        "lambda",
        "share_bucket_1",
        "share_bucket_3",
        "score_bucket_1_q50",
        "rank_correlation_with_last",
        "rank_correlation_with_student",
        "teacher_loss_in_fold",
        "teacher_loss_held_out",
        "scores",
    }
    assert {f"curriculum/{name}" for name in expected} | {"time/refresh_seconds"} <= set(stats)


def test_score_quantiles_rise_from_bucket_to_bucket():
    stats = scored_buffer().diagnostics()
    medians = [stats[f"curriculum/score_bucket_{i}_q50"] for i in (1, 2, 3)]
    assert medians == sorted(medians)
    assert stats["curriculum/score_bucket_1_q90"] <= stats["curriculum/score_bucket_2_q10"]


def test_scores_by_the_student_correlate_fully_with_the_student():
    assert scored_buffer().diagnostics()["curriculum/rank_correlation_with_student"] == pytest.approx(1)


def test_the_mean_age_of_the_scores():
    """
    A refresh every 4 updates scores 40 of 200. After the fifth the scores are 0, 4, 8, 12, 16 updates old: 8 on average; three
    updates later 11.
    """
    buffer, _ = incremental()
    for _ in range(5):
        updates_until_refresh(buffer)
    assert buffer.diagnostics()["curriculum/score_age"] == 8
    for _ in range(3):
        buffer.sample(4)
    assert buffer.diagnostics()["curriculum/score_age"] == 11


def test_the_scores_shown_are_those_of_stored_transitions():
    buffer = scored_buffer()
    add(buffer, 100)
    np.testing.assert_array_equal(buffer.diagnostics()["curriculum/scores"], buffer.scores[100:])


# ---- what is kept


def test_scores_of_different_ages_come_back():
    """Refreshes, their choice of transitions, and draws go on to the bit."""
    saved, of_saved = incremental()
    restored, of_restored = incremental()
    for _ in range(7):
        add(saved, 15)
        updates_until_refresh(saved)
    saved.sample(4)
    restored.set_state(deepcopy(saved.state()), saved.transitions())
    restored.serial, restored.maker = saved.serial, np.random.default_rng(2)
    saved.maker = np.random.default_rng(2)
    del of_saved[:], of_restored[:]
    for _ in range(9):
        np.testing.assert_array_equal(saved.sample(32).rows, restored.sample(32).rows)
        for buffer in (saved, restored):
            add(buffer, 5)
    assert of_saved == of_restored
    assert len(of_saved) == 2
    np.testing.assert_array_equal(saved.score_ages, restored.score_ages)


def test_without_ages_all_were_scored_at_the_same_time():
    """As files of format version 1 are."""
    saved, _ = incremental()
    saved.refresh()
    state = saved.state()
    del state["score_ages"]
    restored, _ = incremental()
    restored.set_state(state, saved.transitions())
    assert restored.diagnostics()["curriculum/score_age"] == 0


@pytest.mark.parametrize(
    "wrong",
    [np.full(200, -1), np.zeros(199, np.int64), np.zeros(200), np.zeros((200, 1), np.int64)],
    ids=["negative", "fewer", "of floats", "in a table"],
)
def test_ages_that_are_none_are_refused(wrong):
    saved, _ = incremental()
    with pytest.raises(ValueError, match="not a replay buffer of this model: its score"):
        incremental()[0].set_state({**saved.state(), "score_ages": wrong}, saved.transitions())


# ---- settings


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_folds": 61}, r"n_folds.*60.*61"),
        ({"n_folds": 1}, r"n_folds.*got 1"),
        ({"stage_clock": "refreshes"}, r'unknown stage_clock "refreshes".*"refresh"'),
        ({"stage_rule": "cumulativ"}, r'unknown stage_rule "cumulativ".*"cumulative"'),
        ({"score": "teacher"}, r'unknown score "teacher".*"teachers"'),
        ({"lambda_init": 1.2}, r"lambda_init.*1\.2"),
        ({"curriculum_fraction": -0.1}, r"curriculum_fraction.*-0\.1"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_buffer(**kwargs)


@pytest.mark.parametrize(
    "kwargs", [{"n_folds": 2.5}, {"teacher_steps": 0}, {"first_teacher_steps": 0}, {"teacher_batch_size": 0}]
)
def test_counts_that_are_no_counts_are_refused_by_name(kwargs):
    """Before any time is spent: when the buffer is made."""
    (name,) = kwargs
    with pytest.raises((ValueError, TypeError), match=name):
        make_buffer(filled=False, **kwargs)
