"""Who may play a group of agents: scripted policies by name, saved models by path, models, and mixtures of these."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces

from sb3_kfcv.common.actors import ActorPolicy, actor_settings, make_player, player_in
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.envs.scripted import SCRIPTED_POLICIES, ScriptedPolicy, scripted_policy
from sb3_kfcv.saving.archive import open_archive
from sb3_kfcv.saving.attributes import without_retired
from sb3_kfcv.saving.files import existing, is_path
from sb3_kfcv.saving.saveable import MODEL_KINDS, refusals
from sb3_kfcv.saving.values import UnwritableError, register_kind

PLAYER_KINDS = ("player", *MODEL_KINDS)


class JointModel(Protocol):
    """Whatever acts on joint rows as an SB3 model does."""

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]: ...


class RandomPlayer:
    """
    Draws every action evenly, in any world.

    :param action_space: joint action space
    :param rng: that draws
    """

    def __init__(self, action_space: spaces.Space, rng: np.random.Generator) -> None:
        self.action_space, self.rng = action_space, rng

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        """Joint actions for joint rows (B, joint), as SB3's models give them."""
        space, n_rows = self.action_space, len(observation)
        if isinstance(space, spaces.MultiDiscrete):
            return self.rng.integers(space.nvec, size=(n_rows, len(space.nvec))), None
        assert isinstance(space, spaces.Box)
        return self.rng.uniform(space.low, space.high, size=(n_rows, *space.shape)).astype(np.float32), None


class Mixture:
    """
    A player drawn anew for every episode.

    :param players: whoever may play, see :func:`find_player`
    :param weights: how often each plays, in proportion; by default all alike
    :raises ValueError: for no player, a mixture within a mixture, or weights that are none
    """

    def __init__(self, players: Sequence[Any], weights: Sequence[float] | np.ndarray | None = None) -> None:
        self.players = list(players)
        self.weights = _weights([1.0] * len(self.players) if weights is None else weights)
        if not self.players or self.weights.shape != (len(self.players),):
            raise ValueError(f"a mixture needs players, and a weight for each; got {len(self.players)} and {self.weights}")
        if not (np.isfinite(self.weights).all() and (self.weights >= 0).all() and self.weights.any()):
            raise ValueError(
                f"the weights of a mixture must be at least 0, and one of them above; got {self.weights.tolist()}"
            )
        if any(isinstance(player, Mixture | Mapping | list | tuple) for player in self.players):
            raise ValueError("a mixture cannot hold another mixture")

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Who plays: indices of players (n,)."""
        return rng.choice(len(self.players), size=n, p=self.weights / self.weights.sum())

    def note_results(self, playing: np.ndarray, won: np.ndarray) -> None:
        """
        Hear of episodes that ended; a mixture of fixed weights does not mind.

        :param playing: who played (episodes,)
        :param won: how far they won, in [0, 1] (episodes,)
        """


def _weights(given: Sequence[float] | np.ndarray) -> np.ndarray:
    """
    :raises ValueError: for what is no sequence of numbers
    """
    if isinstance(given, np.ndarray) and given.dtype.kind in "iuf":
        return given.astype(float)
    listed = given if isinstance(given, str) else list(given)
    if isinstance(listed, str) or not all(isinstance(one, Real) and not isinstance(one, bool) for one in listed):
        raise ValueError(f"the weights of a mixture must be numbers, got {listed!r}")
    return np.array(listed, dtype=float)


def _make_mixture(players: list[Any], weights: np.ndarray) -> Mixture:
    named = [player for player in players if not isinstance(player, ActorPolicy)]
    if any(type(name) is not str or is_path(name) for name in named):
        raise ValueError(f"the players of a mixture are names of scripted policies, or players; got {named}")
    return Mixture(players, weights)


register_kind(
    "Mixture",
    Mixture,
    lambda mixture: {"players": mixture.players, "weights": mixture.weights},
    _make_mixture,
)

Player = ScriptedPolicy | JointModel | Mixture


def find_player(
    given: Any,
    layout: AgentLayout,
    group: str,
    rng: np.random.Generator,
    action_space: spaces.Space | None = None,
    **facts: Any,
) -> Player:
    """
    Whoever is meant.

    :param given: the name of a scripted policy; the path of a model, checkpoint or player file; a scripted policy; a model
        (anything with ``predict`` on joint rows); or a mixture: a :class:`Mixture`, a list of the above, or a map of names and
        paths to their weights
    :param layout: who sits where in the joint rows
    :param group: whom it is to play
    :param rng: for those that draw
    :param action_space: joint action space; only ``"random"`` in worlds without scripted policies needs it
    :param facts: for scripted policies, see :class:`~sb3_kfcv.envs.scripted.WorldFacts`
    :raises ValueError: for an unknown name, with the nearest one; for a player of another world or another group
    :raises FileFormatError: for a file that is damaged, or of another kind
    """
    if isinstance(given, Mapping):
        given = Mixture(list(given), list(given.values()))
    elif isinstance(given, list | tuple):
        given = Mixture(given)
    if isinstance(given, Mixture):
        found = [find_player(player, layout, group, rng, action_space, **facts) for player in given.players]
        return Mixture(found, given.weights) if type(given) is Mixture else given
    if isinstance(given, os.PathLike) or (isinstance(given, str) and is_path(given)):
        player: Any = load_player(given, group)
        name = str(given)
    elif isinstance(given, str):
        return _scripted(given, layout, group, rng, action_space, **facts)
    else:
        player, name = given, f"the player of {group!r}"
        plays = isinstance(player, ScriptedPolicy) or callable(getattr(player, "predict", None))
        if isinstance(player, type) or not plays:
            raise ValueError(f"{group!r} cannot be played by {given!r}; give a name, a path, a model or a scripted policy")
    theirs = getattr(player, "layout", layout)
    if theirs != layout:
        raise ValueError(f"{name} is for another world: {_described(theirs)}; this one has {_described(layout)}")
    agents = player.agents if hasattr(player, "layout") and hasattr(player, "agents") else range(layout.n_agents)
    if not set(layout.members(group)) <= set(agents):
        groups = ", ".join(dict.fromkeys(layout.groups[i] for i in agents))
        raise ValueError(f"{name} plays {groups}; wanted is a player of {group}")
    return player


def _described(layout: AgentLayout) -> str:
    return f"{layout}, and a state of {layout.state_size}"


def scripted_for(layout: AgentLayout, group: str) -> tuple[str, ...]:
    """
    The names of the scripted policies that can play a group.

    :raises ValueError: for an unknown group
    """
    layout.members(group)
    return tuple(SCRIPTED_POLICIES[group]) if group in SCRIPTED_POLICIES and not _is_foreign(layout, group) else ("random",)


def _scripted(
    name: str,
    layout: AgentLayout,
    group: str,
    rng: np.random.Generator,
    action_space: spaces.Space | None,
    **facts: Any,
) -> ScriptedPolicy | RandomPlayer:
    layout.members(group)  # refuses an unknown group
    if group in SCRIPTED_POLICIES and not _is_foreign(layout, group):
        if name not in SCRIPTED_POLICIES[group]:
            known = SCRIPTED_POLICIES[group]
            raise ValueError(
                f"{unknown_name(f'scripted policy of {group!r}', name, known)} (a saved model is given by its path)"
            )
        return scripted_policy(name, layout, group, rng, **facts)
    if name != "random":
        raise ValueError(f"{group!r} has no scripted policy but random; got {name!r} (a saved model is given by its path)")
    if action_space is None:
        raise ValueError(f"a random player of {group!r} needs the world's action space: give action_space=")
    return RandomPlayer(action_space, rng)


def _is_foreign(layout: AgentLayout, group: str) -> bool:
    """
    Whether a group of a familiar name is of another world: in other company, not by two numbers or five choices, or (agents)
    not with as much to see as in Hard Spread: 4 numbers of their own, and 2 of each landmark and of each other agent.
    """
    at_home = {"agent"} if group == "agent" else {"wolf", "sheep"}
    members = layout.members(group)
    acting = {layout.action_sizes[i] for i in members}
    seeing = {layout.obs_sizes[i] for i in members}
    if group == "agent" and seeing != {4 * len(members) + 2}:
        return True
    return not set(layout.group_names) <= at_home or acting != ({5} if layout.discrete else {2})


def load_player(path: str | os.PathLike[str], group: str | None = None) -> ActorPolicy:
    """
    The actors of a saved model, alone, as a player. Nothing of the file is run.

    :param path: of a model, a checkpoint or a player file (the ending ``.zip`` may be missing)
    :param group: whom it is to play; of a file of several learners, whose actors are wanted
    :raises FileFormatError: if the file is damaged, or of another kind
    :raises ValueError: if there is no such file, or none of its learners plays the group
    """
    file: Path = existing(Path(path))
    if not file.is_file():
        raise ValueError(f"there is no file {path} to take a player of")
    with open_archive(file, *PLAYER_KINDS) as archive:
        if archive.kind == "player":
            return player_in(archive)
        with refusals(archive, "attributes"):
            attributes = without_retired(archive.read("attributes"))
            of_learner = "policy"
            if "teams" in archive:
                teams = archive.read("teams")
                if group not in teams:
                    raise ValueError(f"its learners play {', '.join(teams)}, not {group}")
                of_learner = f"policy.{list(teams).index(group)}"
                attributes = teams[group]
            parameters = archive.read("parameters")[of_learner]
        with refusals(archive, "parameters"):
            return _actors_of(attributes, parameters)


def roles_in(path: str | os.PathLike[str]) -> tuple[tuple[str, ...], dict[str, Any]]:
    """
    Whom a file can play, and who played the others in its training.

    :param path: as :func:`load_player` takes it
    :return: the groups that it plays; and by group the players of others, as :func:`written` gave them
    :raises FileFormatError: if the file is damaged, or of another kind
    :raises ValueError: if there is no such file
    """
    file: Path = existing(Path(path))
    if not file.is_file():
        raise ValueError(f"there is no file {path} to take a player of")
    with open_archive(file, *PLAYER_KINDS) as archive:
        if archive.kind == "player":
            player = player_in(archive)
            return tuple(dict.fromkeys(player.layout.groups[i] for i in player.agents)), {}
        with refusals(archive, "attributes"):
            attributes = without_retired(archive.read("attributes"))
            team = attributes.get("team")
            groups = archive.read("teams") if "teams" in archive else [team] if team else attributes["layout"].group_names
            return tuple(groups), dict(attributes.get("opponents") or {})


def _actors_of(attributes: Mapping[str, Any], parameters: Mapping[str, Any]) -> ActorPolicy:
    """The actors of a model, from its attributes and the parameters of its policy."""
    layout, team = attributes["layout"], attributes.get("team")
    return make_player(
        {name.removeprefix("actor."): tensor for name, tensor in parameters.items() if name.startswith("actor.")},
        agents=list(layout.members(team) if team else range(layout.n_agents)),
        **actor_settings(dict(attributes["policy_kwargs"]), attributes.get("share_parameters", False)),
        **{name: attributes[name] for name in ("observation_space", "action_space", "layout")},
    )


def require_players(players: Any, example: Mapping[str, Any]) -> None:
    """
    :param players: must be a map of groups to their players
    :param example: of such a map
    :raises ValueError: if it is something else
    """
    if not isinstance(players, Mapping):
        raise ValueError(f"players are given by their group, such as {dict(example)}; got {players!r}")


def written(player: Any) -> Any:
    """
    A player as a file can hold it: a scripted policy by its name, a model by its actors as they are now.

    :raises UnwritableError: for anything else
    """
    if isinstance(player, str):
        return player
    if isinstance(player, Mixture):
        return Mixture([written(one) for one in player.players], player.weights)
    if isinstance(player, ScriptedPolicy):
        for name, scripted in SCRIPTED_POLICIES.get(player.group, {}).items():
            if type(player) is scripted:
                return name
    if isinstance(player, RandomPlayer):
        return "random"
    policy = player if isinstance(player, ActorPolicy) else getattr(player, "policy", None)
    if isinstance(policy, ActorPolicy):
        return ActorPolicy.of(policy)
    raise UnwritableError(f"a player of type {type(player).__qualname__} cannot be saved")


def going_on(group: str, here: Any, then: Any) -> Any:
    """
    Who goes on playing where a training is resumed: an actor from a file as it was then, since the file may hold another one
    by now; all others as they are here.

    :param group: whom they play
    :param here: the player as it was found here
    :param then: what :func:`written` gave of it then
    :raises ValueError: if somebody else played then
    """
    if isinstance(here, Mixture) and isinstance(then, Mixture) and np.array_equal(here.weights, then.weights):
        return Mixture([going_on(group, *pair) for pair in zip(here.players, then.players, strict=True)], here.weights)
    now = written(here)
    if isinstance(now, ActorPolicy) and isinstance(then, ActorPolicy):
        if (now.layout, now.agents) != (then.layout, then.agents):
            raise ValueError(f"{group} was played by actors of another world or of other agents")
        return then.to(here.device) if type(here) is ActorPolicy else here
    if type(now) is not type(then) or now != then:
        raise ValueError(f"{group} was played by {_in_words(then)}; here it is played by {_in_words(now)}")
    return here


def _in_words(player: Any) -> str:
    if isinstance(player, Mixture):
        weights = ", ".join(f"{weight:g}" for weight in player.weights)
        return f"a mixture of {', '.join(map(_in_words, player.players))} (weights {weights})"
    return "a model" if isinstance(player, ActorPolicy) else str(player)
