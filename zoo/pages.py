"""Pages with marked places: tables of measurements between ``<!-- table: NAME -->`` and ``<!-- end -->``, all else by hand."""

from __future__ import annotations

import re
from collections.abc import Callable

NAME = r"[a-z0-9_-]+"  # of a table
PLACE = re.compile(rf"(<!-- table: ({NAME}) -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(page: str, table: Callable[[str], str]) -> str:
    """
    A page with its tables filled in; all else is left as it is.

    :param page: Markdown
    :param table: makes a table, by its name
    """
    return PLACE.sub(lambda place: f"{place[1]}\n{table(place[2])}\n\n{place[3]}", page)
