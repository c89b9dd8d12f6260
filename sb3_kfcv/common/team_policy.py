"""Different players for the groups of one world, behind the ``predict`` of a single model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.envs.scripted import ScriptedPolicy, scripted_policy


class JointModel(Protocol):
    """Whatever acts on joint rows as an SB3 model does."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]: ...


Player = str | ScriptedPolicy | JointModel


class TeamPolicy:
    """
    Each group played by its own scripted policy or trained model; stands in for a model in ``evaluate_policy``.

    A model sees the whole joint observation and its actions for the other groups are dropped, so
    ``TeamPolicy(layout, {"wolf": model, "sheep": "graze"})`` sets trained wolves against grazing sheep.

    :param layout: who sits where in the joint rows
    :param players: for each group the name of a scripted policy, a scripted policy, or a model
    :param rng: for the scripted policies made by name; by default a fresh generator
    :param groups: whom it plays; by default all groups. If only some, :meth:`fill` is for it
    :param facts: for the scripted policies made by name, see :class:`~sb3_kfcv.envs.scripted.WorldFacts`
    :raises ValueError: if the players do not match the groups, or for an unknown policy name
    """

    def __init__(
        self,
        layout: AgentLayout,
        players: Mapping[str, Player],
        rng: np.random.Generator | None = None,
        groups: Sequence[str] | None = None,
        **facts: Any,
    ) -> None:
        wanted = layout.group_names if groups is None else tuple(groups)
        if set(players) != set(wanted):
            raise ValueError(f"players were given for {sorted(players)}; to be played are {sorted(wanted)}")
        for group, player in players.items():
            if getattr(player, "layout", layout) != layout:
                raise ValueError(f"the player of {group!r} is for another world: {player.layout}")  # type: ignore[union-attr]
        self.layout = layout
        self.players: dict[str, ScriptedPolicy | JointModel] = {
            group: scripted_policy(player, layout, group, rng, **facts) if isinstance(player, str) else player
            for group, player in players.items()
        }

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, None]:
        """
        The joint action, as SB3's models give it.

        :param observation: joint rows (B, joint), or one of them (joint,)
        :param state: ignored: no player has a memory
        :param episode_start: ignored likewise
        :param deterministic: passed on to the models
        :return: joint actions, float32 (B, action size) or, if the agents choose, int64 (B, agents); without the first
            axis for one row; and no state
        """
        layout = self.layout
        width, dtype = (layout.n_agents, np.int64) if layout.discrete else (sum(layout.action_sizes), np.float32)
        return self.fill(np.zeros((*np.shape(observation)[:-1], width), dtype), observation, deterministic), None

    def fill(self, actions: np.ndarray, observation: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """
        A joint action with the columns of the groups played here replaced.

        :param actions: joint actions (B, joint action), or one of them
        :param observation: joint rows (B, joint), or one of them
        :param deterministic: passed on to the models
        :return: joint actions of the same shape
        """
        rows = np.atleast_2d(observation)
        filled = np.array(np.atleast_2d(actions))
        for group, player in self.players.items():
            columns = self._action_columns(group)
            if isinstance(player, ScriptedPolicy):
                filled[:, columns] = self._scripted_actions(player, rows)
            else:
                filled[:, columns] = player.predict(rows, deterministic=deterministic)[0][:, columns]
        return filled.reshape(np.shape(actions))

    def get_state(self) -> dict[str, Any]:
        """The random generators of the scripted policies, by group."""
        scripted = {group: player for group, player in self.players.items() if isinstance(player, ScriptedPolicy)}
        return {group: player.rng.bit_generator.state for group, player in scripted.items()}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Inverse of :meth:`get_state`."""
        for group, state in saved.items():
            self.players[group].rng.bit_generator.state = state  # type: ignore[union-attr]

    def _scripted_actions(self, policy: ScriptedPolicy, rows: np.ndarray) -> np.ndarray:
        """The group's actions, side by side (B, columns of the group)."""
        own = np.stack([rows[:, self.layout.obs_slices[i]] for i in policy.members], axis=1)  # (B, m, obs_size)
        if self.layout.discrete:
            return policy.choose(own)
        return policy.act(own).reshape(len(rows), -1)

    def _action_columns(self, group: str) -> np.ndarray:
        """Where the group's actions stand in a joint action."""
        members = self.layout.members(group)
        if self.layout.discrete:
            return np.array(members)
        return np.concatenate([np.arange(s.start, s.stop) for s in (self.layout.action_slices[i] for i in members)])
