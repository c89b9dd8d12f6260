"""
Fills the tables of ``docs/performance.md`` with what the benchmarks have written to ``docs/results/``.

    python benchmarks/report.py    # `make benchmark-report`

A table stands between ``<!-- table: NAME -->`` and ``<!-- end -->``; what is between them is replaced, and all else is left
as it is. A table whose benchmark has not been run yet names the command that measures it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import compare
import full_training
import scale
import speed

from sb3_kfcv.saving.files import atomic_write
from zoo import pages

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "performance.md"
RESULTS = ROOT / "docs" / "results"


def measured_on(results: dict[str, Any]) -> str:
    """The machine, the day and the versions, in a line."""
    versions = ", ".join(f"{package} {number}" for package, number in results["versions"].items())
    return f"*{results['processor']}, {results['threads']} thread, {results['date']}; {versions}.*"


def speeds(results: dict[str, Any], group: str) -> str:
    """The lines of a group of ``speed.py``."""
    rows = [speed.Row(**row) for row in results["rows"] if row["group"] == group]
    columns = speed.COLUMNS[1:] if any(row.floor for row in rows) else speed.COLUMNS[1:-1]
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    lines += ["| " + " | ".join(row.cells()[1 : len(columns) + 1]) + " |" for row in rows]
    return "\n".join([measured_on(results), "", *lines])


def growth(results: dict[str, Any], picture: str) -> str:
    """The tables of a picture of ``scale.py``."""
    return f"{measured_on(results)}\n\n{scale.tables(results, [picture])}"


def trainings(results: dict[str, Any]) -> str:
    """The table of ``full_training.py``."""
    return f"{measured_on(results)}\n\n{full_training.table(results)}"


def peers(results: dict[str, Any]) -> str:
    """The table of ``compare.py``, a column per peer."""
    return f"*{compare.conditions(results)}*\n\n{compare.overview(results)}"


def best_batches(results: dict[str, Any]) -> str:
    """The simulations of ``compare.py``, each side at its best."""
    return "\n".join(compare.best_batches(compare.pairs_of(results)))


TABLES: dict[str, tuple[str, str, Callable[[dict[str, Any]], str]]] = {
    "peers": ("peers", "benchmark-peers", peers),
    "best-batches": ("peers", "benchmark-peers", best_batches),
    "training": ("full_training", "benchmark-training", trainings),
    **{f"speed-{group.replace(' ', '-')}": ("speed", "benchmark", partial(speeds, group=group)) for group in speed.GROUPS},
    **{
        f"scale-{picture}": ("scale", "benchmark-scale", partial(growth, picture=picture))
        for picture in ("update", "refresh", "replay", "simulate", "memory")
    },
}
"""Name of a table → the JSON that it is made of, the target that measures it, and what makes it."""


def table(name: str, results: Path) -> str:
    """
    A table, or a sentence that names the command where there is nothing to show yet.

    :param name: its name on the page
    :param results: folder of the JSON files
    :raises ValueError: for a table that nobody makes
    """
    if name not in TABLES:
        raise ValueError(f"there is no table {name!r}; there are {', '.join(TABLES)}")
    source, target, make = TABLES[name]
    path = results / f"{source}.json"
    return make(json.loads(path.read_text())) if path.exists() else f"*Not measured yet: `make {target}`.*"


def filled(page: str, results: Path) -> str:
    """
    A page with its tables filled in.

    :param page: Markdown
    :param results: folder of the JSON files
    """
    return pages.filled(page, partial(table, results=results))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--page", type=Path, default=PAGE, help="(default: %(default)s)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON files (default: %(default)s)")
    args = parser.parse_args()
    text = filled(args.page.read_text(), args.results)
    with atomic_write(args.page) as file:
        file.write(text.encode())


if __name__ == "__main__":
    main()
