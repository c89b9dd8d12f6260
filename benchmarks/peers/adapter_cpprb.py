"""
cpprb: ``ReplayBuffer`` and ``PrioritizedReplayBuffer``, driven as its documentation shows. They store joint transitions of
28 agents; priorities are proportional to the errors (a segment tree), where ours are by their rank.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from protocol import BATCH_SIZE, BUFFER_SIZE, UPDATES, Work, main

N_AGENTS, OBS_SIZE, ACTION_SIZE = UPDATES["update-28"]
NOTE = "proportional priorities (a segment tree), returns NumPy arrays"


def transition(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """One joint transition."""
    observations, next_observations = rng.standard_normal((2, N_AGENTS * OBS_SIZE), dtype=np.float32)
    return {
        "obs": observations,
        "next_obs": next_observations,
        "act": rng.standard_normal(N_AGENTS * ACTION_SIZE, dtype=np.float32),
        "rew": rng.standard_normal(N_AGENTS, dtype=np.float32),
        "done": np.zeros(N_AGENTS, dtype=np.float32),
    }


def filled() -> tuple[Any, np.random.Generator]:
    """A full buffer whose priorities differ."""
    from cpprb import PrioritizedReplayBuffer

    rng = np.random.default_rng(0)
    shapes = {name: {"shape": value.shape, "dtype": value.dtype} for name, value in transition(rng).items()}
    buffer = PrioritizedReplayBuffer(BUFFER_SIZE, shapes, alpha=0.7)
    for _ in range(BUFFER_SIZE):
        buffer.add(**transition(rng), priorities=float(rng.random()))
    return buffer, rng


def uniform() -> tuple[Any, np.random.Generator]:
    """A full buffer without priorities."""
    from cpprb import ReplayBuffer

    rng = np.random.default_rng(0)
    shapes = {name: {"shape": value.shape, "dtype": value.dtype} for name, value in transition(rng).items()}
    buffer = ReplayBuffer(BUFFER_SIZE, shapes)
    for _ in range(BUFFER_SIZE):
        buffer.add(**transition(rng))
    return buffer, rng


def uniform_sample() -> Work:
    buffer, _ = uniform()
    return Work(lambda: buffer.sample(BATCH_SIZE), note="returns NumPy arrays")


def uniform_add() -> Work:
    buffer, rng = uniform()
    row = transition(rng)
    return Work(lambda: buffer.add(**row), note="every value stored as given")


def sample() -> Work:
    buffer, _ = filled()
    return Work(lambda: buffer.sample(BATCH_SIZE, beta=0.5), note=NOTE)


def priorities() -> Work:
    buffer, rng = filled()
    rows, errors = rng.integers(BUFFER_SIZE, size=BATCH_SIZE), rng.random(BATCH_SIZE)
    return Work(lambda: buffer.update_priorities(rows, errors), note=NOTE)


def in_turn() -> Work:
    buffer, rng = filled()
    errors = rng.random(BATCH_SIZE)
    return Work(lambda: buffer.update_priorities(buffer.sample(BATCH_SIZE, beta=0.5)["indexes"], errors), note=NOTE)


def add() -> Work:
    buffer, rng = filled()
    row = transition(rng)
    return Work(lambda: buffer.add(**row), note=NOTE)


if __name__ == "__main__":
    main(
        ["cpprb", "numpy"],
        {
            "uniform-sample": uniform_sample,
            "uniform-add": uniform_add,
            "per-sample": sample,
            "per-priorities": priorities,
            "per-turn": in_turn,
            "per-add": add,
        },
    )
