"""Means over the agents or rows that live."""

from __future__ import annotations

import torch as th


def shares(live: th.Tensor, dim: int = -1) -> th.Tensor:
    """Weights that make the mean over the living a sum: ``live`` (1 or 0) over its sum along an axis; 0 where none lives."""
    return live / live.sum(dim, keepdim=True).clamp_(min=1.0)
