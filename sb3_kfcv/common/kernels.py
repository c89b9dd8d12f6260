"""Compiled functions, kept on the disk where several processes may need them at once."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from filelock import FileLock
from numba import njit
from numba.core.caching import IndexDataCacheFile


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """
    ``numba.njit(cache=True)`` whose files several processes can share.

    :param function: to be compiled at its first call
    :param options: of ``numba.njit``
    """
    if function is None:
        return partial(kernel, **options)
    compiled = njit(cache=True, **options)(function)
    files = getattr(getattr(compiled, "_cache", None), "_cache_file", None)
    if type(files) is IndexDataCacheFile:
        files.__class__ = SharedCacheFile
    return compiled


class SharedCacheFile(IndexDataCacheFile):
    """
    What numba keeps of a function on the disk: an index of the types that it was compiled for, and a file for each.

    numba reads and writes these in several steps. Of two processes that compile a function at once, as two trainings do that
    begin together on a new machine, each could take the same file for other types; whoever found it later would run code that
    takes numbers for addresses. Here one process at a time reads or writes.
    """

    def load(self, key: Any) -> Any:
        with self._alone():
            return super().load(key)

    def save(self, key: Any, data: Any) -> None:
        with self._alone():
            super().save(key, data)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        lock = FileLock(os.path.join(self._cache_path, "kernels.lock"))
        try:
            lock.acquire()
        except (OSError, NotImplementedError):  # a folder that can only be read, or that knows no locks
            yield
            return
        try:
            yield
        finally:
            lock.release()
