"""The one place that writes files: whole, or not at all."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO


def with_suffix(path: str | pathlib.Path, suffix: str) -> pathlib.Path:
    """The path with an ending, added unless it is there (``"model"`` → ``model.zip``; ``"v1.0"`` → ``v1.0.zip``)."""
    path = pathlib.Path(path)
    return path if path.suffix == suffix else path.with_name(path.name + suffix)


@contextmanager
def atomic_write(path: str | pathlib.Path) -> Iterator[BinaryIO]:
    """
    Open a file for writing that appears under its name only when it is whole; an older one stays until then.

    :param path: of the file; missing folders are made
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
