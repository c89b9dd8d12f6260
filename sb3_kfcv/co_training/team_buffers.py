"""The replay buffers of all teams as one: filled together, written once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_kfcv.replay import JointReplayBuffer


class TeamBuffers:
    """
    The teams' own buffers, each of its kind and size. All are given the same transitions, so the largest holds what the
    others hold, and alone is written.

    :param buffers: of each team
    """

    def __init__(self, buffers: Mapping[str, JointReplayBuffer]) -> None:
        self.buffers = dict(buffers)
        self.largest = max(self.buffers.values(), key=lambda buffer: buffer.buffer_size)

    @property
    def n_added(self) -> int:
        """Steps (of all worlds) ever stored."""
        return self.largest.n_added

    @property
    def n_bytes(self) -> int:
        """Memory that they take."""
        return sum(buffer.n_bytes for buffer in self.buffers.values())

    def size(self) -> int:
        """Steps held."""
        return self.largest.size()

    def add(self, *transition: Any) -> None:
        """Store a step in all of them, see :meth:`JointReplayBuffer.add`."""
        for buffer in self.buffers.values():
            buffer.add(*transition)

    def transitions(self, first: int = 0) -> dict[str, np.ndarray]:
        """What is held since a step, see :meth:`JointReplayBuffer.transitions`."""
        return self.largest.transitions(first)

    def state(self) -> dict[str, Any]:
        """What each keeps beside the transitions; and how many there are."""
        states = {team: {"class": type(buffer), **buffer.state()} for team, buffer in self.buffers.items()}
        largest = self.largest.state()
        return {"teams": states, "n_added": largest["n_added"], "n_steps": largest["n_steps"]}

    def set_state(self, state: dict[str, Any], transitions: dict[str, np.ndarray]) -> None:
        """
        Inverse of :meth:`state`; every buffer takes the latest transitions that it has room for.

        :raises ValueError: if it is of other buffers
        """
        if set(state["teams"]) != set(self.buffers):
            raise ValueError(f"the replay buffers are of {', '.join(state['teams'])}; here are {', '.join(self.buffers)}")
        for team, buffer in self.buffers.items():
            own = dict(state["teams"][team])
            found = own.pop("class", None)
            if found is not type(buffer):
                theirs = getattr(found, "__name__", found)
                raise ValueError(f"the replay buffer of {team} is a {theirs}; here it is a {type(buffer).__name__}")
            held = min(own["n_added"], own["n_steps"])
            buffer.set_state(own, {name: array[len(array) - held :] for name, array in transitions.items()})
