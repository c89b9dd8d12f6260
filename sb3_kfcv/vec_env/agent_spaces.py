"""The spaces of single agents as vectors: what a joint row can hold, and what is refused in one sentence."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces

Conversion = Callable[[Any], Any]


def flat_observation(agent: str, space: spaces.Space) -> tuple[spaces.Box, Conversion | None]:
    """
    An agent's observations as vectors: a flat ``Box`` stays as it is, all else is flattened as Gymnasium does it (choices
    become one-hot).

    :param agent: whose they are, for the message
    :param space: any space of fixed size without pictures
    :return: the flat space, and what turns an observation into a vector; None where it is one
    :raises ValueError: for pictures, and for spaces whose observations differ in size
    """
    if holds_pictures(space):
        raise ValueError(
            f"the observation space of {agent!r} is {space}, a picture, and networks here read vectors: let the world give "
            "features, or turn the picture into a vector yourself (SuperSuit: resize_v1, flatten_v0)"
        )
    if isinstance(space, spaces.Box) and len(space.shape) == 1:
        return space, None
    try:
        flat = spaces.flatten_space(space)
    except NotImplementedError:  # a space that Gymnasium does not know
        flat = None
    if not isinstance(flat, spaces.Box):
        raise ValueError(f"the observation space of {agent!r} is {space}, which makes no vector of fixed length")
    return flat, partial(_flattened, space=space)


def holds_pictures(space: spaces.Space | None) -> bool:
    """Whether a space is one of pixels (bytes in two or more axes), or holds one."""
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        parts = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return any(holds_pictures(part) for part in parts)
    return isinstance(space, spaces.Box) and space.dtype == np.uint8 and len(space.shape) > 1


def flat_action(agent: str, space: spaces.Space) -> tuple[spaces.Box | spaces.Discrete, Conversion | None]:
    """
    An agent's actions as the joint action holds them: a float32 vector, or a choice counted from 0.

    :param agent: whose they are, for the message
    :param space: a bounded ``Box`` of floats, or a ``Discrete``
    :return: the space in the joint action, and what turns its part of a joint action into the agent's own action; None where
        that is the same
    :raises ValueError: for any other space
    """
    if isinstance(space, spaces.Discrete):
        start = int(space.start)
        return spaces.Discrete(int(space.n)), (partial(_shifted, start=start) if start else None)
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"the action space of {agent!r} is {space}; an agent takes a Box of floats or one Discrete choice "
            "(several choices at once: number their combinations as one Discrete)"
        )
    if space.dtype is None or space.dtype.kind != "f":
        raise ValueError(
            f"the action space of {agent!r} is {space}; a Box of actions holds floats, whole numbers are Discrete"
        )
    with np.errstate(over="ignore"):  # a bound beyond float32 is none
        low, high = space.low.ravel().astype(np.float32), space.high.ravel().astype(np.float32)
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise ValueError(
            f"the action space of {agent!r} is {space}; every action needs a finite lower bound below a finite upper one"
        )
    flat = spaces.Box(low, high, dtype=np.float32)
    same = space.dtype == np.float32 and len(space.shape) == 1
    return flat, None if same else partial(_reshaped, space=space)


def _flattened(observation: Any, space: spaces.Space) -> np.ndarray:
    if isinstance(space, spaces.Discrete) and not space.contains(observation):  # Gymnasium would count from the end
        raise ValueError
    return spaces.flatten(space, observation)  # type: ignore[return-value]


def _shifted(choice: int, start: int) -> int:
    return choice + start


def _reshaped(values: np.ndarray, space: spaces.Box) -> np.ndarray:
    """The values in the space's shape and precision; rounding leads out of no bound."""
    return np.asarray(np.clip(values.reshape(space.shape).astype(space.dtype), space.low, space.high))
