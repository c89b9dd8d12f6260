"""How Python meets the compiled worlds: all their arrays in one handle."""

from __future__ import annotations

from pathlib import Path

from numba import types
from numba.experimental import structref

from sb3_kfcv.common.kernels import drop_stale_cache, kernel

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
