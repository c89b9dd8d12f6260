"""The order of the priorities, kept by moving what changed: against sorting all of them anew."""

import numpy as np
import pytest

from sb3_kfcv.replay.rank_order import RankOrder


def assert_sorted(order, values):
    np.testing.assert_array_equal(order.by_rank(values), np.argsort(-values, kind="stable"))


@pytest.mark.parametrize("few_values", [False, True], ids=["all different", "many ties"])
@pytest.mark.parametrize("size", [1, 2, 50, 400])
def test_the_order_is_that_of_a_stable_sort(size, few_values):
    """While rows come, are given infinite values anew, and change in batches with repeated rows."""
    rng = np.random.default_rng(0)
    values, order, n = np.full(size, np.inf), RankOrder(size), 1
    for step in range(300):
        if rng.random() < 0.7:
            first = rng.integers(n)
            new = np.arange(first, min(first + 3, n))
            values[new] = np.inf
            order.note(new)
            n = min(n + rng.integers(4), size)
        for _ in range(rng.integers(3)):
            rows = rng.integers(n, size=rng.integers(1, 2 + n // 8))
            values[rows] = rng.integers(3, size=len(rows)) if few_values else rng.random(len(rows))
            order.note(rows)
        if step % 3:
            assert_sorted(order, values[:n])


def test_nothing_has_changed():
    values, order = np.array([1.0, 3.0, 2.0]), RankOrder(3)
    for _ in range(3):
        assert order.by_rank(values).tolist() == [1, 2, 0]


def test_rows_that_change_back_stay_where_they_are():
    values, order = np.array([1.0, 3.0, 2.0, *[0.0] * 20]), RankOrder(23)
    assert_sorted(order, values)
    order.note(np.array([1, 2]))
    assert_sorted(order, values)


@pytest.mark.parametrize("row", [0, 19], ids=["from first to last", "from last to first"])
def test_one_row_moves_all_the_way(row):
    values, order = np.arange(20, 0, -1.0), RankOrder(20)
    assert_sorted(order, values)
    values[row] = 10 - 2 * values[row]
    order.note(np.array([row]))
    assert_sorted(order, values)


def test_rows_numbered_from_the_end_are_found():
    values, order = np.arange(20.0), RankOrder(20)
    assert_sorted(order, values)
    values[-1] = 0.5
    order.note(np.array([-1]))
    assert_sorted(order, values)


def test_no_number_comes_last():
    values, order = np.arange(20.0), RankOrder(20)
    for row, value in ((3, np.nan), (5, np.nan), (3, 7.0), (6, np.inf), (5, 0.0), (7, 1.0)):
        values[row] = value
        order.note(np.array([row]))
        assert_sorted(order, values)


def test_what_is_forgotten_is_sorted_anew():
    values, order = np.arange(20.0), RankOrder(20)
    assert_sorted(order, values)
    order.forget()
    assert_sorted(order, -values[:5])


def test_its_memory_is_that_of_its_arrays():
    order = RankOrder(1000)
    assert order.n_bytes == sum(array.nbytes for array in vars(order).values() if isinstance(array, np.ndarray))
