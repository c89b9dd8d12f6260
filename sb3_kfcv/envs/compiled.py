"""How Python meets the compiled worlds: all arrays in one handle, and a word while there is nothing to do but wait."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from numba import types
from numba.core import event
from numba.experimental import structref

from sb3_kfcv.common.kernels import kernel

NOTICE = "compiling kernels (once per machine, about 30 s)…"


def drop_stale_cache(source: Path) -> None:
    """
    Delete compiled code that is older than a file.

    numba's disk cache looks at the file of a compiled function alone, not at the files of what it calls, so that the
    worlds would go on with the physics that they were compiled with.

    :param source: a file that all compiled code beside it depends on
    """
    changed = source.stat().st_mtime
    for compiled in (source.parent / "__pycache__").glob("*.nb[ci]"):
        try:
            if compiled.stat().st_mtime < changed:
                compiled.unlink(missing_ok=True)
        except OSError:  # another process was faster, or the folder is read-only
            continue


drop_stale_cache(Path(__file__))


@structref.register
class _HandleType(types.StructRef):
    """What numba calls the type of a :class:`Handle`."""


class Handle(structref.StructRefProxy):
    """
    All arrays of a batch of worlds as one argument of a compiled function, which reads ``common`` and ``own`` of it.

    At each call numba looks at every array that it is given, which for a single world takes longer than the step. It
    looks at the arrays of a handle once, when :func:`handle_of` makes it.
    """


structref.define_proxy(Handle, _HandleType, ["common", "own"])


@kernel
def handle_of(common, own):
    """
    :param common: WorldArrays
    :param own: the named tuple of the arrays of one kind of world
    :return: a handle on the same arrays
    """
    return Handle(common, own)


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
