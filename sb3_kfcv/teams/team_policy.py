"""Different players for the groups of one world, behind the ``predict`` of a single model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.envs.scripted import ScriptedPolicy
from sb3_kfcv.teams.players import Mixture, Player, find_player, going_on, require_players, written

# Who of each mixture plays in each row (rows,), mixture after mixture.
LineUp = tuple[np.ndarray, ...]


class TeamPolicy:
    """
    Each group played by its own player; stands in for a model in ``evaluate_policy``.

    A model sees the whole joint observation and its actions for the other groups are dropped, so
    ``TeamPolicy(layout, {"wolf": model, "sheep": "graze"})`` sets trained wolves against grazing sheep, and
    ``{"wolf": "wolves.zip", "sheep": {"graze": 4, "flee": 1}}`` saved wolves against sheep that flee in every fifth episode.

    :param layout: who sits where in the joint rows
    :param players: for each group a player, or what :func:`~sb3_kfcv.teams.players.find_player` takes for one
    :param rng: for the players made here, and for who of a mixture plays; by default a fresh generator
    :param groups: whom it plays; by default all groups. If only some, :meth:`fill` is for it
    :param action_space: joint action space, see :func:`~sb3_kfcv.teams.players.find_player`
    :param facts: for the scripted policies made by name, see :class:`~sb3_kfcv.envs.scripted.WorldFacts`
    :raises ValueError: if the players do not match the groups, or for an unknown policy name
    """

    def __init__(
        self,
        layout: AgentLayout,
        players: Mapping[str, Any],
        rng: np.random.Generator | None = None,
        groups: Sequence[str] | None = None,
        action_space: spaces.Space | None = None,
        **facts: Any,
    ) -> None:
        wanted = layout.group_names if groups is None else tuple(groups)
        require_players(players, dict.fromkeys(wanted, "random"))
        if set(players) != set(wanted):
            raise ValueError(f"players were given for {sorted(players)}; to be played are {sorted(wanted)}")
        self.layout = layout
        self.rng = rng or np.random.default_rng()
        self.players: dict[str, Player] = {
            group: find_player(player, layout, group, self.rng, action_space, **facts) for group, player in players.items()
        }
        self.width = layout.n_agents if layout.discrete else sum(layout.action_sizes)
        self.columns = {group: self._action_columns(group) for group in wanted}
        self._critic_columns = {group: _columns(layout, group) for group in wanted}

    @property
    def _mixtures(self) -> dict[str, Mixture]:
        return {group: player for group, player in self.players.items() if isinstance(player, Mixture)}

    def predict(
        self,
        observation: np.ndarray,
        state: LineUp | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, LineUp | None]:
        """
        The joint action, as SB3's models give it.

        :param observation: joint rows (B, joint), or one of them (joint,)
        :param state: who of each mixture plays: what the last call gave. ``None`` draws anew
        :param episode_start: bool (B,): where a mixture draws anew
        :param deterministic: passed on to the models
        :return: joint actions, float32 (B, action size) or, if the agents choose, int64 (B, agents); without the first
            axis for one row; and the state for the next call, ``None`` without mixtures
        """
        dtype = np.int64 if self.layout.discrete else np.float32
        actions = np.zeros((*np.shape(observation)[:-1], self.width), dtype)
        line_up = self.line_up(len(np.atleast_2d(observation)), state, episode_start)
        return self.fill(actions, observation, deterministic, line_up), line_up

    def line_up(self, n_rows: int, before: LineUp | None = None, starts: np.ndarray | None = None) -> LineUp | None:
        """
        Who of each mixture plays in each row.

        :param n_rows: number of rows
        :param before: who has played so far; ``None`` if all episodes begin
        :param starts: bool (rows,): whose episodes begin
        :return: ``None`` without mixtures
        """
        if not self._mixtures:
            return None
        if before is None or any(len(playing) != n_rows for playing in before):
            before, starts = tuple(np.zeros(n_rows, dtype=np.int64) for _ in self._mixtures), np.ones(n_rows, dtype=bool)
        if starts is None or not starts.any():
            return before
        drawn = [playing.copy() for playing in before]
        for playing, mixture in zip(drawn, self._mixtures.values(), strict=True):
            playing[starts] = mixture.draw(int(np.count_nonzero(starts)), self.rng)
        return tuple(drawn)

    def fill(
        self,
        actions: np.ndarray,
        observation: np.ndarray,
        deterministic: bool = True,
        line_up: LineUp | None = None,
        without: Sequence[Any] = (),
    ) -> np.ndarray:
        """
        A joint action with the columns of the groups played here replaced.

        :param actions: joint actions (B, joint action), or one of them
        :param observation: joint rows (B, joint), or one of them
        :param deterministic: passed on to the models
        :param line_up: who of each mixture plays; by default drawn anew
        :param without: players whose actions are left as they are
        :return: joint actions of the same shape
        """
        rows = np.atleast_2d(observation)
        filled = np.array(np.atleast_2d(actions))
        playing = self.playing(line_up or self.line_up(len(rows)))
        for group, player in self.players.items():
            columns = self.columns[group]
            if isinstance(player, Mixture):
                for i in np.unique(playing[group]):
                    if player.players[i] not in without:
                        own = np.flatnonzero(playing[group] == i)
                        filled[np.ix_(own, columns)] = self._actions(player.players[i], columns, rows[own], deterministic)
            elif player not in without:
                filled[:, columns] = self._actions(player, columns, rows, deterministic)
        return filled.reshape(np.shape(actions))

    def playing(self, line_up: LineUp | None) -> dict[str, np.ndarray]:
        """Who plays in each row, by group, of the groups that mixtures play."""
        return dict(zip(self._mixtures, line_up or (), strict=True))

    def expected_rows(self, actions: th.Tensor, observations: th.Tensor, policy: ActorPolicy) -> th.Tensor:
        """
        What a critic expects of the groups played here: the greedy actions of their players, in whose networks nothing goes
        by way of the env's actions. Of a mixture, every row draws its player.

        :param actions: joint actions as a critic sees them (batch, joint action)
        :param observations: joint rows (batch, joint)
        :param policy: translates actions
        :return: the actions with the columns of these groups replaced
        """
        for group, player in self.players.items():
            columns = th.as_tensor(self._critic_columns[group], device=actions.device)
            if isinstance(player, Mixture):
                playing = player.draw(len(actions), self.rng)
                for i in np.unique(playing):
                    own = th.as_tensor(np.flatnonzero(playing == i), device=actions.device)
                    theirs = self._greedy_rows(group, player.players[i], actions[own], observations[own], policy)
                    actions[own.unsqueeze(1), columns] = theirs[:, columns]
            else:
                actions[:, columns] = self._greedy_rows(group, player, actions, observations, policy)[:, columns]
        return actions

    def _greedy_rows(
        self, group: str, player: Any, actions: th.Tensor, observations: th.Tensor, policy: ActorPolicy
    ) -> th.Tensor:
        """What one player does, as a critic sees it, in its columns of (batch, joint action)."""
        if hasattr(player, "greedy_rows"):
            return player.greedy_rows(observations)
        taken, columns = policy.to_env(actions), self.columns[group]
        taken[:, columns] = self._actions(player, columns, observations.cpu().numpy(), deterministic=True)
        return policy.encode(th.as_tensor(policy.from_env(taken), device=actions.device))

    def written(self, groups: Iterable[str]) -> dict[str, Any]:
        """
        The players of some groups as a file can hold them.

        :raises UnwritableError: if one is of a kind that no file holds
        """
        return {group: written(self.players[group]) for group in groups}

    def go_on(self, then: Mapping[str, Any]) -> None:
        """
        Let those play that have played where a training is resumed, see :func:`~sb3_kfcv.teams.players.going_on`.

        :param then: what :meth:`written` gave
        :raises ValueError: if others played then
        """
        for group, player in then.items():
            if group in self.players:
                self.players[group] = going_on(group, self.players[group], player)

    def get_state(self) -> dict[str, Any]:
        """The random generators of all that draw, by their places."""
        return {place: owner.rng.bit_generator.state for place, owner in self._drawing().items()}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Inverse of :meth:`get_state`."""
        drawing = self._drawing()
        for place, state in saved.items():
            drawing[place].rng.bit_generator.state = state

    def _drawing(self) -> dict[str, Any]:
        """What draws: players by their group, ``""`` of the mixtures, and whoever brought a generator into one of them."""
        found: dict[str, Any] = {"": self} if self._mixtures else {}
        found.update({group: player for group, player in self.players.items() if hasattr(player, "rng")})
        for group, mixture in self._mixtures.items():
            for i, player in enumerate(mixture.players):
                if getattr(player, "rng", self.rng) is not self.rng:
                    found[f"{group}/{i}"] = player
        return found

    def _actions(self, player: Any, columns: np.ndarray, rows: np.ndarray, deterministic: bool) -> np.ndarray:
        """What one player does: (B, columns)."""
        if isinstance(player, ScriptedPolicy):
            return self._scripted_actions(player, rows)
        actions = np.asarray(player.predict(rows, deterministic=deterministic)[0])
        if actions.shape != (len(rows), self.width):
            raise ValueError(
                f"a player's predict gives joint actions of all agents, {(len(rows), self.width)}; "
                f"that of {type(player).__name__} gave {actions.shape}"
            )
        return actions[:, columns]

    def _scripted_actions(self, policy: ScriptedPolicy, rows: np.ndarray) -> np.ndarray:
        """The group's actions, side by side (B, columns of the group)."""
        own = np.stack([rows[:, self.layout.obs_slices[i]] for i in policy.members], axis=1)  # (B, m, obs_size)
        if self.layout.discrete:
            return policy.choose(own)
        return policy.act(own).reshape(len(rows), -1)

    def _action_columns(self, group: str) -> np.ndarray:
        """Where the group's actions stand in a joint action."""
        return np.array(self.layout.members(group)) if self.layout.discrete else _columns(self.layout, group)


def _columns(layout: AgentLayout, group: str) -> np.ndarray:
    """Where the group's actions stand in a joint action as a critic sees it."""
    slices = (layout.action_slices[i] for i in layout.members(group))
    return np.concatenate([np.arange(s.start, s.stop) for s in slices])
