"""Numbers too small to matter, which processors compute with a hundred times more slowly."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

_smallest = sys.float_info.min


@contextmanager
def without_denormals() -> Iterator[None]:
    """
    Inside, results below the smallest normal number (1e-38 in single precision) are 0, in this thread.

    The gradient of a unit that has died is 0, and Adam's mean of it falls by a tenth at each step until it is such a number,
    which it then stays: some hundred updates after the start every fifth moment is one, and an update takes twice as long.
    """
    if _smallest / 2 == 0.0:  # it is so already
        yield
        return
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(False)
