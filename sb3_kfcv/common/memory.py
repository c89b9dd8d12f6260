"""Memory is asked for before it is taken: one sentence instead of a killed process."""

from __future__ import annotations

from pathlib import Path

import psutil

# Where Linux tells the limit and the use of a container.
CGROUP = Path("/sys/fs/cgroup")


def free_memory() -> int:
    """Bytes that may still be taken: what the machine has available, or the container is allowed, whichever is less."""
    free = psutil.virtual_memory().available
    try:
        limit, used = ((CGROUP / f"memory.{name}").read_text().strip() for name in ("max", "current"))
        cache = dict(line.split() for line in (CGROUP / "memory.stat").read_text().splitlines())["inactive_file"]
        return free if limit == "max" else min(free, int(limit) - int(used) + int(cache))
    except (OSError, ValueError, KeyError):
        return free


def require_memory(what: str, n_bytes: int) -> None:
    """
    :param what: that is about to be made, for the message
    :param n_bytes: that it takes
    :raises MemoryError: if so much is not free
    """
    free = free_memory()
    if n_bytes > free:
        raise MemoryError(f"{what} takes {in_words(n_bytes)}; {in_words(max(free, 0))} are free")


def in_words(n_bytes: float) -> str:
    """A number of bytes in words, such as ``83.2 MB``."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if n_bytes < 999.5:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} TB" if n_bytes < 99.5 else f"{n_bytes:,.0f} TB"
