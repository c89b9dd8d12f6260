"""Rows in the order of a value of each, kept by moving the few whose value changed."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from sb3_kfcv.common.kernels import kernel

# Beyond this share of changed rows, sorting anew is faster than moving them.
SORT_BEYOND = 0.25


class RankOrder:
    """
    Rows from the largest value to the smallest, equal ones by their number: ``argsort(-values, kind="stable")``, in one
    pass over the rows that copies the stretches between those that moved.

    :param size: number of rows at most
    """

    bytes_per_row: ClassVar[int] = 4 + 4 + 8

    def __init__(self, size: int) -> None:
        self._order = np.empty(size, dtype=np.int32)
        self._other = np.empty(size, dtype=np.int32)  # the next order is written here
        self._values = np.empty(size)  # by which the rows are ordered
        self._n = 0  # number of rows in order
        self._changed: list[np.ndarray] = []  # rows whose value is another since
        self._n_changed = 0

    @property
    def n_bytes(self) -> int:
        """Memory that it takes."""
        return len(self._order) * self.bytes_per_row

    def forget(self) -> None:
        """There is no order: the next one is sorted anew."""
        self._n = 0
        self._changed, self._n_changed = [], 0

    def note(self, rows: np.ndarray) -> None:
        """
        :param rows: whose values have changed
        """
        if not self._n:
            return
        self._changed.append(rows)
        self._n_changed += len(rows)
        if self._n_changed > SORT_BEYOND * len(self._order):
            self.forget()

    def by_rank(self, values: np.ndarray) -> np.ndarray:
        """
        The order now; it is overwritten by the next call but one.

        :param values: (n,) of the rows 0 … n − 1, at least as many as at the last call; those of rows not noted are the
            same as then
        :return: (n,) rows
        """
        n = len(values)
        few = self._n_changed + n - self._n <= SORT_BEYOND * n
        if not (few and self._move(values)):
            self._order[:n] = np.argsort(-values, kind="stable")
            self._values[:n] = values
        order = self._order[:n]
        self.forget()
        if not np.isnan(values[order[-1:]]).any():  # NaN comes last, and is found by no search
            self._n = n
        return order

    def _move(self, values: np.ndarray) -> bool:
        """Take the changed rows out of the order, and put them in anew; ``False`` if some have no number or no value."""
        order, changed = self._order[: self._n], np.concatenate([*self._changed, np.arange(self._n, len(values))])
        if not len(changed):
            return True
        changed.sort()
        if changed[0] < 0 or changed[-1] >= len(values):
            return False
        known = changed[: changed.searchsorted(self._n)]
        leaving = places(order, self._values, known, self._values[known])
        leaving.sort()
        new_values = values[changed]
        falling = np.argsort(-new_values, kind="stable")
        coming = changed[falling]
        if np.isnan(new_values[falling[-1]]):
            return False
        merge(order, leaving, coming, places(order, self._values, coming, new_values[falling]), self._other)
        self._values[changed] = new_values
        self._order, self._other = self._other, self._order
        return True


@kernel
def places(order, values, rows, rows_values):
    """
    How many rows of an order come before each of some rows: a binary search for all of them together, so that one need not
    wait for the memory that another asked for, and without branches that the processor would guess wrongly.

    :param order: (n,) the order
    :param values: of each row, by which it goes
    :param rows: (m,) rows
    :param rows_values: (m,) their values
    :return: (m,) numbers
    """
    found = np.zeros(rows.size, dtype=np.int64)
    left = order.size
    while left > 0:
        half = (left + 1) // 2
        for i in range(rows.size):
            other = order[found[i] + half - 1]
            value = values[other]
            before = (value > rows_values[i]) | ((value == rows_values[i]) & (other < rows[i]))
            found[i] += half * before
        left -= half
    return found


@kernel
def merge(order, leaving, coming, here, into):
    """
    Take rows out of an order, and put rows in.

    :param order: (n,) the order
    :param leaving: places in it, rising, some maybe twice
    :param coming: rows, in the order that they shall have, some maybe twice
    :param here: the places before which they come
    :param into: the new order is written here
    """
    read = written = i = 0  # how much of the order is read, how much of the new one written; the next that leaves
    for j in range(coming.size):
        if j and coming[j] == coming[j - 1]:
            continue
        while i < leaving.size and leaving[i] < here[j]:
            written = copy(order, read, leaving[i], into, written)
            read = leaving[i] + 1
            i += 1
        written = copy(order, read, here[j], into, written)
        read = here[j]
        into[written] = coming[j]
        written += 1
    for end in leaving[i:]:
        written = copy(order, read, end, into, written)
        read = end + 1
    copy(order, read, order.size, into, written)


@kernel
def copy(order, first, end, into, target):
    """
    Copy the places from ``first`` to before ``end``, if these are any, to those from ``target`` on.

    :return: the place after them
    """
    length = max(end - first, 0)
    read, written = order[first : first + length], into[target : target + length]
    for i in range(length):
        written[i] = read[i]
    return target + length
