"""One sentence for a wrong name: what was given, and the nearest right one."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def unknown_name(kind: str, name: object, known: Iterable[str]) -> str:
    """
    The message for an unknown name.

    :param kind: what was named, such as ``"environment"``
    :param name: the name that was given
    :param known: the names that exist
    :return: ``unknown environment "Graslnd-v0"; did you mean "Grassland-v0"?``, or the list of all known ones
    """
    known = sorted({*known})
    close = get_close_matches(str(name), known, n=1, cutoff=0.5)
    hint = f'did you mean "{close[0]}"?' if close else f"known: {', '.join(known)}"
    return f'unknown {kind} "{name}"; {hint}'
