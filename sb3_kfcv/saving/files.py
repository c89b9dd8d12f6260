"""The one place that writes files: whole, or not at all."""

from __future__ import annotations

import os
import pathlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, BinaryIO


def with_suffix(path: str | pathlib.Path, suffix: str) -> pathlib.Path:
    """The path with an ending, added unless it is there (``"model"`` → ``model.zip``; ``"v1.0"`` → ``v1.0.zip``)."""
    path = pathlib.Path(path)
    return path if path.suffix == suffix else path.with_name(path.name + suffix)


def existing(path: Any) -> Any:
    """The path, or that with the ending ``.zip`` if there is no such file; anything else than a path as it is."""
    if isinstance(path, (str, pathlib.Path)) and not pathlib.Path(path).is_file():
        return with_suffix(path, ".zip")
    return path


def is_path(text: str) -> bool:
    """Whether a text that may also be a name means a file: it ends in ``.zip``, or has a slash."""
    return text.endswith(".zip") or "/" in text or os.sep in text


@contextmanager
def atomic_write(path: str | pathlib.Path) -> Iterator[BinaryIO]:
    """
    Open a file for writing (and reading) that appears under its name only when it is whole and on the disk; an older one
    stays until then.

    :param path: of the file; missing folders are made
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "w+b") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        _sync_folder(path.parent)
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


@contextmanager
def going_on(what: str) -> Iterator[None]:
    """A file that cannot be written (disk or memory are full) costs no training: a warning, and the older file stays."""
    try:
        yield
    except (OSError, MemoryError) as error:
        warnings.warn(f"{what} could not be written, the training goes on: {str(error) or type(error).__name__}", stacklevel=3)


def _sync_folder(folder: pathlib.Path) -> None:
    """Bring the folder's list of names to the disk, where the system can."""
    with suppress(OSError):  # Windows opens no folders
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
