"""
Where players meet: episodes whose results depend on the players and the seed alone, to the bit.

Three things could let in more than that, and each is shut out:

- The last bit of a matrix product depends on how many rows it has and on a row's place among them. So players always see
  blocks of ``BLOCK`` rows, and the episode of seed s sits in row s % ``BLOCK``, however many worlds step side by side.
- Players that draw would share one stream of numbers. So every episode has a generator for each group, made of its seed.
- Worlds that go on with their own generators would depend on the episodes before. So every episode is reset with its own seed.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.envs.scripted import OraclePolicy, ScriptedPolicy
from sb3_kfcv.saving.archive import open_archive
from sb3_kfcv.saving.files import existing, is_path
from sb3_kfcv.teams.players import PLAYER_KINDS, Mixture, RandomPlayer, find_player
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import facts_of, layout_of, metric_names_of, wins_of

BLOCK = 32
"""Rows that a player sees at once."""

# Hears of every reset and every step: which worlds' episodes are over (worlds,), and their infos, none after a reset.
Watch = Callable[[np.ndarray, Sequence[dict[str, Any]]], Any]


@dataclass(frozen=True)
class Episodes:
    """
    What came of some episodes, in the order of their seeds.

    :param seeds: int64 (episodes,)
    :param lengths: env steps, int64 (episodes,)
    :param returns: of each group, the mean over its agents (episodes,)
    :param won: of each group, how far it won, in [0, 1] (episodes,); empty where the world does not say
    :param metrics: the world's other metrics (episodes,)
    """

    seeds: np.ndarray
    lengths: np.ndarray
    returns: dict[str, np.ndarray]
    won: dict[str, np.ndarray]
    metrics: dict[str, np.ndarray]

    def quantities(self) -> dict[str, np.ndarray]:
        """All of it by name, each (episodes,): ``won_<group>``, ``return_<group>``, ``length`` and the metrics."""
        return {
            **{f"won_{group}": values for group, values in self.won.items()},
            **{f"return_{group}": values for group, values in self.returns.items()},
            "length": self.lengths.astype(float),
            **self.metrics,
        }


class EpisodeGenerators:
    """
    Answers players that draw as a :class:`numpy.random.Generator` does, every row from the generator of its own episode.
    """

    def __init__(self) -> None:
        self._rows: Sequence[np.random.Generator] = ()

    def seat(self, rows: Sequence[np.random.Generator]) -> None:
        """
        :param rows: the generator of each row of the block that is acted on next
        """
        self._rows = rows

    def uniform(self, low: Any, high: Any, size: Any) -> np.ndarray:
        """Evenly from [low, high): ``size``, whose first axis is the rows."""
        return self._by_row(size, lambda rng, shape: rng.uniform(low, high, shape))

    def integers(self, low: Any, high: Any = None, *, size: Any) -> np.ndarray:
        """Whole numbers from [0, low), or from [low, high): ``size``, whose first axis is the rows."""
        return self._by_row(size, lambda rng, shape: rng.integers(low, high, shape))

    def choice(self, a: Any, size: Any, p: Any = None) -> np.ndarray:
        """One of several with replacement: ``size``, whose first axis is the rows."""
        return self._by_row(size, lambda rng, shape: rng.choice(a, shape, p=p))

    def _by_row(self, size: Any, draw: Callable[[np.random.Generator, tuple[int, ...]], Any]) -> np.ndarray:
        n_rows, *shape = np.atleast_1d(size).tolist()
        if n_rows != len(self._rows):
            raise ValueError(f"{n_rows} rows are to be drawn for the episodes of {len(self._rows)}")
        return np.stack([draw(rng, tuple(shape)) for rng in self._rows])


class FrozenActors:
    """
    The actors of a model as they are now, on the CPU: they read the rows from one tensor of their own, so that a bit cannot
    depend on where the rows happen to lie in memory.

    :param policy: the actors
    """

    def __init__(self, policy: ActorPolicy) -> None:
        self.policy = ActorPolicy.of(policy).to("cpu")
        self.layout, self.agents = policy.layout, policy.agents
        self._rows = th.empty(BLOCK, sum(policy.layout.obs_sizes))

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """Joint actions for a block of joint rows (``BLOCK``, joint); discrete agents draw if they are not to be greedy."""
        self._rows.copy_(th.from_numpy(observation))
        with th.no_grad():
            actions = self.policy.joint_actions(self.policy.actor, self._rows, explore=not deterministic)
        return self.policy.to_env(actions), None


class Side:
    """
    Whoever plays a group, found and loaded once, for any number of matches.

    :param layout: who sits where in the joint rows
    :param group: whom it plays
    :param player: see :func:`~sb3_kfcv.teams.players.find_player`, and found by it
    """

    def __init__(self, layout: AgentLayout, group: str, player: Any) -> None:
        self.layout, self.group = layout, group
        self.mixture = player if isinstance(player, Mixture) else None
        self._draws = EpisodeGenerators()
        self._unheard = np.random.default_rng(0)  # for the rows that another one of a mixture plays
        self._members = [
            TeamPolicy(layout, {group: self._steady(member)}, groups=(group,))
            for member in (player.players if isinstance(player, Mixture) else [player])
        ]
        members = [member.players[group] for member in self._members]
        self.sees_states = any(isinstance(member, OraclePolicy) for member in members)

    def line_up(self, generators: Sequence[np.random.Generator]) -> np.ndarray:
        """
        Which of its players plays each episode of a block, int64 (``BLOCK``,).

        :param generators: of the episodes
        """
        if self.mixture is None:
            return np.zeros(len(generators), dtype=np.int64)
        self._draws.seat(generators)
        return self.mixture.draw(len(generators), cast(np.random.Generator, self._draws))

    def fill(
        self,
        actions: np.ndarray,
        rows: np.ndarray,
        playing: np.ndarray,
        generators: Sequence[np.random.Generator],
        deterministic: bool = True,
    ) -> None:
        """
        Write its actions into a block of joint actions.

        :param actions: (``BLOCK``, joint action)
        :param rows: joint observations, float32 (``BLOCK``, joint)
        :param playing: as :meth:`line_up` gave it
        :param generators: of the episodes
        :param deterministic: passed on to the players
        """
        for i in np.unique(playing):
            own = playing == i
            self._draws.seat([rng if mine else self._unheard for rng, mine in zip(generators, own, strict=True)])
            actions[own] = self._members[i].fill(actions, rows, deterministic)[own]

    def _steady(self, player: Any) -> Any:
        """The player, its draws and its arithmetic kept within each episode."""
        if isinstance(player, ScriptedPolicy | RandomPlayer):
            player = copy.copy(player)
            player.rng = cast(np.random.Generator, self._draws)
            return player
        learner = getattr(player, "learners", {}).get(self.group, player)
        policy = learner if isinstance(learner, ActorPolicy) else getattr(learner, "policy", None)
        return FrozenActors(policy) if isinstance(policy, ActorPolicy) else player


class Arena:
    """
    Worlds in which players meet. Results do not depend on the number of worlds, nor on what was played before.

    Exact on one machine with one number of threads of PyTorch. A model that is not of this package is exact as far as its
    ``predict`` gives the same for the same block of rows.

    :param env: vec env of joint worlds; an episode must be determined by the seed of its reset
    :param facts: for scripted policies, see :class:`~sb3_kfcv.envs.scripted.WorldFacts`; by default what the world says
    """

    def __init__(self, env: VecEnv, **facts: Any) -> None:
        self.env = env
        self.layout = layout_of(env)
        self.wins = wins_of(env)
        self._states: np.ndarray | None = None  # of the worlds in the block that is acted on, for players that see them
        if env.has_attr("state"):
            facts = {"state_source": lambda: self._states, **facts}
        self.facts = {**facts_of(env), **facts}

    def quantities(self) -> tuple[str, ...]:
        """Names of what is measured in every episode, see :meth:`Episodes.quantities`."""
        groups, winners = self.layout.group_names, self.winners()
        names = [f"won_{group}" for group in winners] + [f"return_{group}" for group in groups] + ["length"]
        return tuple(dict.fromkeys([*names, *metric_names_of(self.env)]))

    def winners(self) -> tuple[str, ...]:
        """The groups of whom the world says how far they win."""
        groups = self.layout.group_names
        return groups if len(self.wins) == 1 and len(groups) == 2 else tuple(self.wins)

    def default_quantity(self, group: str) -> str:
        """What a group's success is measured by: how far it won where the world says so, else its return."""
        return f"won_{group}" if group in self.winners() else f"return_{group}"

    def side(self, group: str, given: Any) -> Side:
        """
        Find a player.

        :param group: whom it is to play
        :param given: see :func:`~sb3_kfcv.teams.players.find_player`; a :class:`Side` as it is
        :raises ValueError: for an unknown group or name, a player of another world or group, or one that was trained on
            normalised observations
        :raises FileFormatError: for a file that is damaged, or of another kind
        """
        self.layout.members(group)
        if isinstance(given, Side):
            if (given.layout, given.group) != (self.layout, group):
                raise ValueError(f"a player of {given.group} of another match cannot play {group} here")
            return given
        for path in _paths_in(given):
            _refuse_normalized(path)
        rng = np.random.default_rng()  # gives way to those of the episodes
        return Side(self.layout, group, find_player(given, self.layout, group, rng, self.env.action_space, **self.facts))

    def play(
        self,
        players: Mapping[str, Any],
        n_episodes: int,
        seed: int = 0,
        deterministic: bool = True,
        watch: Watch = lambda dones, infos: None,
    ) -> Episodes:
        """
        Play a match.

        :param players: of every group its player, see :meth:`side`
        :param n_episodes: number of episodes
        :param seed: of the first episode; the others follow: seed + 1, …
        :param deterministic: greedily; else models draw by PyTorch's own generator, and nothing is exact
        :param watch: hears of every reset and every step
        :raises ValueError: if a group has no player, for no episode, or a negative seed
        """
        require_count("n_episodes", n_episodes)
        require_count("seed", seed, least=0)
        if set(players) != set(self.layout.group_names):
            raise ValueError(
                f"players were given for {', '.join(players) or 'nobody'}; to be played are "
                f"{', '.join(self.layout.group_names)}"
            )
        sides = [self.side(group, players[group]) for group in self.layout.group_names]
        ended: list[dict[str, float]] = []
        for first in range(0, n_episodes, self.env.num_envs):
            n_counted = min(self.env.num_envs, n_episodes - first)
            ended += self._round(sides, seed + first, n_counted, deterministic, watch)
        columns = {name: np.array([episode[name] for episode in ended]) for name in ended[0]}
        returns = {group: columns.pop(f"return_{group}") for group in self.layout.group_names}
        seeds = seed + np.arange(n_episodes)
        return Episodes(seeds, columns.pop("length").astype(np.int64), returns, self._won(columns), columns)

    def _won(self, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """How far each group won (episodes,), where the world says so."""
        won = {group: columns[metric] for group, metric in self.wins.items()}
        return {group: won[group] if group in won else 1.0 - next(iter(won.values())) for group in self.winners()}

    def _round(
        self, sides: Sequence[Side], first: int, n_counted: int, deterministic: bool, watch: Watch
    ) -> list[dict[str, float]]:
        """
        One episode in each world; worlds whose episode is over, or that have none, go on uncounted.

        :param sides: of each group
        :param first: seed of the first world's episode
        :param n_counted: so many of the worlds have an episode that counts
        :param deterministic: see :meth:`play`
        :param watch: likewise
        :return: metrics, returns and length of each episode
        """
        env, offset = self.env, first % BLOCK
        n_blocks = -(-(offset + env.num_envs) // BLOCK)
        rows = np.zeros((n_blocks * BLOCK, sum(self.layout.obs_sizes)), dtype=np.float32)
        actions = np.zeros((len(rows), *(env.action_space.shape or ())), dtype=env.action_space.dtype)
        blocks = [slice(i * BLOCK, (i + 1) * BLOCK) for i in range(n_blocks)]
        worlds = slice(offset, offset + env.num_envs)
        seeds = [first - offset + i for i in range(len(rows))]  # before the first and after the last world nobody plays
        generators = {side.group: [np.random.default_rng([seed, place]) for seed in seeds] for place, side in enumerate(sides)}
        playing = {
            side.group: np.concatenate([side.line_up(generators[side.group][block]) for block in blocks]) for side in sides
        }

        env.seed(first)
        rows[worlds] = np.asarray(env.reset())
        watch(np.zeros(env.num_envs, dtype=bool), ())
        ended: dict[int, dict[str, float]] = {}
        steps = 0
        while len(ended) < n_counted:
            states = self._seen_states(sides, len(rows), worlds)
            for i, block in enumerate(blocks):
                numbers = range(max(i * BLOCK - offset, 0), min((i + 1) * BLOCK - offset, n_counted))
                if all(number in ended for number in numbers):
                    continue
                self._states = None if states is None else states[block]
                for side in sides:
                    playing_here, drawing_here = playing[side.group][block], generators[side.group][block]
                    side.fill(actions[block], rows[block], playing_here, drawing_here, deterministic)
            observations, _, dones, infos = env.step(actions[worlds].copy())
            rows[worlds] = np.asarray(observations)
            steps += 1
            watch(dones, infos)
            for i in np.flatnonzero(dones[:n_counted]).tolist():
                if i not in ended:
                    ended[i] = {**infos[i]["episode_metrics"], "length": steps}
        return [ended[i] for i in range(n_counted)]

    def _seen_states(self, sides: Sequence[Side], n_rows: int, worlds: slice) -> np.ndarray | None:
        """The worlds' states in their rows, those of the first world where there is none (rows, state); for who sees them."""
        if not any(side.sees_states for side in sides):
            return None
        states = np.stack(self.env.env_method("state"))
        seen = np.repeat(states[:1], n_rows, axis=0)
        seen[worlds] = states
        return seen


def _paths_in(given: Any) -> Iterator[Any]:
    """The paths among what may be given for a player."""
    if isinstance(given, PathLike) or (isinstance(given, str) and is_path(given)):
        yield existing(given)
    elif isinstance(given, Mapping | list | tuple | Mixture):
        for player in given.players if isinstance(given, Mixture) else given:
            yield from _paths_in(player)


def _refuse_normalized(path: Any) -> None:
    """
    :raises ValueError: if a model saw other observations than worlds give
    """
    try:
        with open_archive(path, *PLAYER_KINDS) as archive:
            normalized = "normalization" in archive
    except FileNotFoundError:
        return  # told by whoever loads it
    if normalized:
        raise ValueError(f"{path} was trained on normalised observations, and players see them as they are")
