"""Who sits where in the joint rows: the one description that env, buffer, policy and saved model share."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces


def group_of(agent: str) -> str:
    """Group of an agent: its name without the trailing number (``"wolf_3"`` → ``"wolf"``)."""
    return re.sub(r"_?\d+$", "", agent) or agent


@dataclass(frozen=True)
class AgentLayout:
    """
    How N agents share one joint observation row and one joint action row.

    The joint observation is the agents' observations one after the other; the joint action likewise.
    ``action_sizes`` counts what a critic sees: the dimensions of a continuous action, or the number
    of choices of a discrete one (which enters the critic one-hot).

    :param agents: names of the agents, in the order of the joint rows
    :param groups: group of each agent, such as ``"wolf"`` or ``"sheep"``
    :param obs_sizes: length of each agent's observation
    :param action_sizes: length of each agent's action as a critic sees it
    :param discrete: whether the agents choose among ``action_sizes`` actions instead of giving a vector
    :param state_size: length of the world's ``state()``; 0 if it has none
    """

    agents: tuple[str, ...]
    groups: tuple[str, ...]
    obs_sizes: tuple[int, ...]
    action_sizes: tuple[int, ...]
    discrete: bool = False
    state_size: int = 0

    @classmethod
    def from_spaces(
        cls,
        agents: Sequence[str],
        observation_spaces: dict[str, spaces.Space],
        action_spaces: dict[str, spaces.Space],
        state_size: int = 0,
        groups: Sequence[str] | None = None,
    ) -> AgentLayout:
        """
        Read the layout off the agents' spaces.

        :param agents: names of the agents, in the order of the joint rows
        :param observation_spaces: a flat ``Box`` per agent
        :param action_spaces: a flat ``Box`` per agent, or a ``Discrete`` per agent; not both kinds
        :param state_size: length of the world's ``state()``; 0 if it has none
        :param groups: group of each agent; by default its name without the trailing number
        :raises ValueError: names the agent whose space cannot be joined
        """
        for agent in agents:
            space = observation_spaces[agent]
            if not isinstance(space, spaces.Box) or len(space.shape) != 1:
                raise ValueError(f"the observation space of {agent!r} is {space}; agents need a flat Box (one axis)")
        kinds = {type(action_spaces[agent]) for agent in agents}
        if kinds == {spaces.Discrete}:
            action_sizes = tuple(int(action_spaces[agent].n) for agent in agents)  # type: ignore[attr-defined]
        elif kinds == {spaces.Box} and all(len(action_spaces[agent].shape or ()) == 1 for agent in agents):
            action_sizes = tuple(int(action_spaces[agent].shape[0]) for agent in agents)  # type: ignore[index]
        else:
            listed = {agent: action_spaces[agent] for agent in agents}
            raise ValueError(f"agents need flat Box actions or Discrete actions, one kind for all; got {listed}")
        return cls(
            agents=tuple(agents),
            groups=tuple(groups) if groups is not None else tuple(group_of(agent) for agent in agents),
            obs_sizes=tuple(int(observation_spaces[agent].shape[0]) for agent in agents),  # type: ignore[index]
            action_sizes=action_sizes,
            discrete=kinds == {spaces.Discrete},
            state_size=int(state_size),
        )

    def __str__(self) -> str:
        """Such as ``2 wolf (23 observed, 2 acting), 1 sheep (23 observed, 2 acting)``."""
        parts = []
        for group in self.group_names:
            members = self.members(group)
            sizes = sorted({(self.obs_sizes[i], self.action_sizes[i]) for i in members})
            kind = "choices" if self.discrete else "acting"
            listed = "; ".join(f"{seen} observed, {acting} {kind}" for seen, acting in sizes)
            parts.append(f"{len(members)} {group} ({listed})")
        return ", ".join(parts)

    @property
    def n_agents(self) -> int:
        return len(self.agents)

    @cached_property
    def group_names(self) -> tuple[str, ...]:
        """The distinct groups, in order of first appearance."""
        return tuple(dict.fromkeys(self.groups))

    @cached_property
    def obs_slices(self) -> tuple[slice, ...]:
        """Where each agent's observation lies in the joint observation row."""
        return _slices(self.obs_sizes)

    @cached_property
    def action_slices(self) -> tuple[slice, ...]:
        """Where each agent's action lies in the joint action that a critic sees."""
        return _slices(self.action_sizes)

    def members(self, group: str) -> tuple[int, ...]:
        """
        Indices of the agents of a group.

        :raises ValueError: for an unknown group, with the known ones
        """
        if group not in self.group_names:
            raise ValueError(f"unknown group {group!r}; this world has {', '.join(self.group_names)}")
        return tuple(i for i, name in enumerate(self.groups) if name == group)

    def group_means(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """
        Mean over the agents of each group; ``values`` is (…, agents). ``take`` lays a row's values side by side, so that they
        are summed up in one order, however many rows there are.
        """
        return {group: np.take(values, self.members(group), axis=-1).mean(axis=-1) for group in self.group_names}

    def to_dict(self) -> dict[str, Any]:
        """The layout as plain JSON values."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> AgentLayout:
        """Inverse of :meth:`to_dict`."""
        values: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in data.items()}
        return cls(**values)


def _slices(sizes: Sequence[int]) -> tuple[slice, ...]:
    ends = np.cumsum(sizes)
    return tuple(slice(int(end - size), int(end)) for end, size in zip(ends, sizes, strict=True))
