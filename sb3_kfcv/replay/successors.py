"""What stored steps led to, without storing it twice."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from sb3_kfcv.common.kernels import kernel
from sb3_kfcv.common.memory import require_memory

# Numbers in a row from which on copying it takes longer than finding it.
LONG = 256

# How much larger the room for what is kept apart gets when it is full.
GROWTH = 1.5


class Successors:
    """
    What each row of a ring of steps led to: mostly what the row one step later starts from, of the same world, which is
    stored there. Kept apart is the rest: what the newest step led to, and where the next step starts from something else,
    to the bit, as after an episode's end. That is dropped with its row.

    :param observations: what the steps start from, (steps, worlds, observation); the owner writes it
    :param states: likewise, (steps, worlds, state)
    :param share_apart: share of the rows for which there is room apart at first
    """

    def __init__(self, observations: np.ndarray, states: np.ndarray, share_apart: float) -> None:
        self.n_steps, self.n_worlds = observations.shape[:2]
        self.n_rows = self.n_steps * self.n_worlds
        self._starts = {"next_observations": observations, "next_states": states}
        self._bits = [np.dtype(f"u{array.itemsize}") for array in (observations, states)] * 2  # in which 0.0 and −0.0 differ
        self._place = np.zeros(self.n_rows, dtype=np.int32)  # of what a row led to: a row, or n_rows + a place apart
        self._room = room_apart(self.n_steps, self.n_worlds, share_apart)
        # In the first places lies what the newest step led to; the others are for whichever row needs one.
        self._apart = {name: np.zeros((self._room, array.shape[2]), array.dtype) for name, array in self._starts.items()}
        self.reset()

    @property
    def n_bytes(self) -> int:
        """Memory that it takes."""
        return sum(array.nbytes for array in (*self._apart.values(), self._place, self._free))

    def reset(self) -> None:
        """There are no rows."""
        self._place[:] = 0
        self._free = np.arange(self._room - 1, self.n_worlds - 1, -1, dtype=np.int32)  # places where nothing lies, a stack
        self._n_free = len(self._free)

    def make_room(self) -> None:
        """
        For the next :meth:`add`; to be called before anything of that step is written.

        :raises MemoryError: if there is none
        """
        if self._n_free < self.n_worlds:
            self._grow(int(GROWTH * self._room) + self.n_worlds)

    def add(self, step: int, previous: int | None, following: Mapping[str, np.ndarray | list[np.ndarray]]) -> None:
        """
        Take in a step whose start has just been written in place of the oldest.

        :param step: where it lies
        :param previous: where the step before lies; ``None`` if it is not there (any more)
        :param following: what the step leads to: name → (worlds, …)
        """
        before = -1 if previous is None else previous
        arrays = (*self._starts.values(), *self._apart.values())
        starts, other_starts, apart, other_apart = (array.view(bits) for array, bits in zip(arrays, self._bits, strict=True))
        self._n_free = link(step, before, starts, other_starts, apart, other_apart, self._place, self._free, self._n_free)
        for name, rows in following.items():
            self._apart[name][: self.n_worlds] = rows

    def set(self, steps: np.ndarray, following: Mapping[str, np.ndarray]) -> None:
        """
        Take in consecutive steps whose starts have been written, in place of all.

        :param steps: (steps,) where they lie, the oldest first
        :param following: what they lead to: name → (steps, worlds, …)
        """
        self.reset()
        if not len(steps):
            return
        ends = np.zeros((len(steps) - 1, self.n_worlds), dtype=bool)
        for name, rows in following.items():
            starts = self._starts[name][steps[1:]]
            bits = f"u{starts.itemsize}"
            ends |= (starts.view(bits) != np.ascontiguousarray(rows[:-1]).view(bits)).any(-1)
        n_ends = int(ends.sum())
        if n_ends > self._n_free:
            self._grow(n_ends + 2 * self.n_worlds)
        self._n_free -= n_ends
        kept = self._free[self._n_free : self._n_free + n_ends]
        worlds = np.arange(self.n_worlds)
        places = np.concatenate([steps[1:, None] * self.n_worlds + worlds, [self.n_rows + worlds]])
        places[:-1][ends] = self.n_rows + kept
        self._place.reshape(self.n_steps, self.n_worlds)[steps] = places
        for name, rows in following.items():
            self._apart[name][kept] = rows[:-1][ends]
            self._apart[name][: self.n_worlds] = rows[-1]

    def read(self, name: str, rows: np.ndarray, into: np.ndarray) -> None:
        """
        :param name: ``"next_observations"`` or ``"next_states"``
        :param rows: (n,) rows
        :param into: (n, …) what they led to is written here
        """
        starts, apart = self._starts[name], self._apart[name]
        if not copies_are_long(starts, into):
            gather_following(starts, apart, self._place, rows, into)
            return
        place = self._place[rows]
        gather(starts, place, into)
        elsewhere = np.flatnonzero(place >= self.n_rows)
        into[elsewhere] = apart[place[elsewhere] - self.n_rows]

    def _grow(self, room: int) -> None:
        """Make more room apart; what lies there stays where it is."""
        room = min(room, room_apart(self.n_steps, self.n_worlds, 1))
        require_memory(f"what {room:,} ends of episodes led to", room * sum(a[:1].nbytes for a in self._apart.values()))
        more = room - self._room
        for name, array in self._apart.items():
            self._apart[name] = np.concatenate([array, np.zeros((more, array.shape[1]), array.dtype)])
        free = np.empty(room - self.n_worlds, dtype=np.int32)
        free[: self._n_free] = self._free[: self._n_free]
        free[self._n_free : self._n_free + more] = np.arange(self._room, room)
        self._room, self._free, self._n_free = room, free, self._n_free + more


def room_apart(n_steps: int, n_worlds: int, share_apart: float) -> int:
    """Places apart: for a share of the steps of each world, for the newest, and for the one that is being added."""
    return (min(math.ceil(share_apart * n_steps) + 1, n_steps) + 1) * n_worlds


@kernel
def link(step, previous, starts, other_starts, apart, other_apart, place, free, n_free):
    """
    Drop what the rows of the step led to until now, and say of the rows of the step before where it lies what they led to.

    :return: how many places are free
    """
    n_rows, n_worlds = place.size, starts.shape[1]
    for world in range(n_worlds):
        row = step * n_worlds + world
        if place[row] >= n_rows + n_worlds:
            free[n_free] = place[row] - n_rows
            n_free += 1
        place[row] = n_rows + world
    if previous < 0:
        return n_free
    for world in range(n_worlds):
        row = previous * n_worlds + world
        if same(starts[step, world], apart[world]) and same(other_starts[step, world], other_apart[world]):
            place[row] = step * n_worlds + world
        else:
            n_free -= 1
            apart[free[n_free]] = apart[world]
            other_apart[free[n_free]] = other_apart[world]
            place[row] = n_rows + free[n_free]
    return n_free


@kernel
def same(one, other):
    """Whether two rows of bits are alike. Mostly they are, so that nothing is gained by leaving early."""
    differ = 0
    for i in range(one.size):
        differ |= one[i] ^ other[i]
    return differ == 0


def gather(source: np.ndarray, rows: np.ndarray, into: np.ndarray) -> None:
    """
    Copy rows of a ring.

    :param source: (steps, worlds, …)
    :param rows: (n,) numbers, ``step * worlds + world``; beyond the last it is the last
    :param into: (n, …) is written
    """
    if copies_are_long(source, into):
        np.take(source.reshape(-1, source.shape[2]), rows, axis=0, out=into, mode="clip")
    else:
        gather_short(source, rows, into)


def copies_are_long(source: np.ndarray, into: np.ndarray) -> bool:
    """Whether numpy copies rows faster, which come from outside the cache, than compiled loops, which start at once."""
    return source.shape[2] >= LONG and source.dtype == into.dtype


@kernel
def gather_short(source, rows, into):
    """:func:`gather` for short rows of any kinds of numbers, none beyond the last."""
    n_worlds = source.shape[1]
    for i in range(rows.size):
        read, written = source[rows[i] // n_worlds, rows[i] % n_worlds], into[i]
        for j in range(read.size):
            written[j] = read[j]


@kernel
def gather_following(starts, apart, place, rows, into):
    """Copy what rows of a ring led to."""
    n_worlds = starts.shape[1]
    for i in range(rows.size):
        at, written = place[rows[i]], into[i]
        read = starts[at // n_worlds, at % n_worlds] if at < place.size else apart[at - place.size]
        for j in range(read.size):
            written[j] = read[j]
