"""Transitions as files hold them: what follows a step is mostly what the next step starts from, and is written once."""

from __future__ import annotations

from typing import Any

import numpy as np

# What a step starts from, and what it leads to.
FOLLOWED_BY = {"observations": "next_observations", "states": "next_states"}


def packed(transitions: dict[str, np.ndarray]) -> dict[str, Any]:
    """
    :param transitions: name → (steps, worlds, …), consecutive steps
    :return: the same with ``next_…`` reduced to the rows that the following step does not start from (an episode's last, and
        the last step), and which these are
    """
    result: dict[str, Any] = dict(transitions)
    for name, following in FOLLOWED_BY.items():
        starts, leads_to = transitions[name], transitions[following]
        differs = np.ones(leads_to.shape[:2], dtype=bool)
        differs[:-1] = (_bits(leads_to[:-1]) != _bits(starts[1:])).any(-1)
        result[following] = {"differs": differs, "rows": leads_to[differs]}
    return result


def unpacked(stored: dict[str, Any]) -> dict[str, np.ndarray]:
    """
    Inverse of :func:`packed`.

    :raises ValueError: if these are no packed transitions
    """
    result: dict[str, np.ndarray] = dict(stored)
    for name, following in FOLLOWED_BY.items():
        starts, differs, rows = stored[name], stored[following]["differs"], stored[following]["rows"]
        fits = differs.shape == starts.shape[:2] and differs.dtype == bool and rows.dtype == starts.dtype
        if not fits or rows.shape != (differs.sum(), *starts.shape[2:]) or not differs[-1:].all():
            raise ValueError(f"{following} do not fit {name}")
        result[following] = np.concatenate([starts[1:], starts[:1]])
        result[following][differs] = rows
    return result


def _bits(array: np.ndarray) -> np.ndarray:
    """Numbers as they are stored: 0.0 and −0.0 differ."""
    return np.ascontiguousarray(array).view(np.uint32)
