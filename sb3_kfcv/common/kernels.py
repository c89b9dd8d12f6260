"""
Compiled functions: kept on the disk, where several processes may need them at once, and a word while there is nothing to do
but wait for them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock
from numba import njit
from numba.core import event
from numba.core.caching import IndexDataCacheFile

NOTICE = "compiling kernels (once per machine, about 30 s)…"


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


def drop_stale_cache(source: Path) -> None:
    """
    Delete compiled code that is older than a file.

    numba's disk cache looks at the file of a compiled function alone, not at the files of what it calls, so that
    worlds, for one, would go on with the physics that they were compiled with.

    :param source: a file that all compiled code beside it depends on
    """
    changed = source.stat().st_mtime
    for compiled in (source.parent / "__pycache__").glob("*.nb[ci]"):
        try:
            if compiled.stat().st_mtime < changed:
                compiled.unlink(missing_ok=True)
        except OSError:  # another process was faster, or the folder is read-only
            continue


class _Notice(event.Listener):
    """Says once what the first step is waiting for; what was compiled before is read from the disk, in silence."""

    said = False

    def on_start(self, event: Any) -> None:
        if not self.said and event.data["dispatcher"].py_func.__module__.startswith("sb3_kfcv."):
            self.said = True
            print(NOTICE, file=sys.stderr, flush=True)

    def on_end(self, event: Any) -> None:
        """The start was told, that is enough."""


event.register("numba:compile", _Notice())
