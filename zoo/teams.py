"""Which team learns what, and who plays the others: the words of ``--team`` and ``--yardstick``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from sb3_kfcv import ALGOS, MADDPG
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.saving.files import is_path
from sb3_kfcv.teams.players import scripted_for
from zoo.hyperparams import merged
from zoo.run_folder import file_to_play
from zoo.typed_settings import settings_of


@dataclass
class Teams:
    """
    :param learners: group → algorithm; ``None`` is that of ``--algo``
    :param players: group → who plays it and does not learn: the name of a scripted policy, a path, or a list of these
    """

    learners: dict[str, str | None]
    players: dict[str, Any]


def parse_teams(words: Sequence[str] | str | None) -> Teams:
    """
    The words of ``--team``: ``wolf`` or ``wolf=kfcv_maddpg`` learns; ``sheep=graze``, ``sheep=logs/…/model.zip`` or a mixture
    ``sheep=graze,flee`` plays.

    :param words: as they were typed
    :raises ValueError: for a word that is neither, and for two of one group
    """
    teams = Teams({}, {})
    for word in [words] if isinstance(words, str) else words or ():
        group, equals, player = word.partition("=")
        if not group or (equals and not player):
            raise ValueError(f'--team takes GROUP=ALGORITHM or GROUP=PLAYER, such as sheep=graze; got "{word}"')
        if group in teams.learners or group in teams.players:
            raise ValueError(f"--team says twice who plays {group}")
        if not equals or player in ALGOS:
            teams.learners[group] = player or None
        else:
            teams.players[group] = parse_player(player)
    if teams.players and not teams.learners:
        group, player = next(iter(teams.players.items()))
        raise ValueError(f"no team learns: {group} is played by {player}, and the algorithms are {', '.join(ALGOS)}")
    return teams


def parse_player(text: str) -> Any:
    """
    A player's name, or the file of a path (of a run folder its last model, else its latest checkpoint); a list of several,
    which stand between commas, is a mixture.

    :raises ValueError: if there is no such file
    """
    players = [str(file_to_play(part).resolve()) if is_path(part) else part for part in text.split(",")]
    return players[0] if len(players) == 1 else players


class Yardstick(NamedTuple):
    """A fixed opponent that a learning team is measured by."""

    team: str
    name: str
    opponents: dict[str, Any]


def yardsticks(
    words: Sequence[str],
    layout: AgentLayout,
    learners: Sequence[str],
    default: bool,
    then: Mapping[str, dict[str, Any]] | None = None,
) -> list[Yardstick]:
    """
    What every learning team is measured by: each player of ``--yardstick``; where the other groups are several, the further
    ones are played by their first.

    :param words: of ``--yardstick``, such as ``sheep=graze``
    :param layout: who sits where
    :param learners: the groups that learn
    :param default: without words, take every scripted policy of the world
    :param then: yardsticks by name as they were when a run was begun that is now resumed: their files may be gone
    :raises ValueError: for a word that is none, or an unknown group
    """
    given: dict[str, list[str]] = {}
    for word in words:
        group, equals, player = word.partition("=")
        if not equals or not player:
            raise ValueError(f'--yardstick takes GROUP=PLAYER, such as sheep=graze; got "{word}"')
        if group not in layout.group_names:
            raise ValueError(unknown_name("group", group, layout.group_names))
        given.setdefault(group, []).append(player)
    if not given and not default:
        return []
    players = {group: given.get(group) or with_some_sense(scripted_for(layout, group)) for group in layout.group_names}
    found: list[Yardstick] = []
    for team in learners:
        others = [group for group in layout.group_names if group != team]
        for group in others:
            for player in players[group] if not given or group in given else ():
                name = _unlike(f"{team}_vs_{label(player)}", [yardstick.name for yardstick in found])
                opponents = (then or {}).get(name)
                if opponents is None:
                    playing = {**{other: players[other][0] for other in others}, group: player}
                    opponents = {other: parse_player(who) for other, who in playing.items()}
                found.append(Yardstick(team, name, opponents))
    return found


def _unlike(name: str, taken: Sequence[str]) -> str:
    """The name, with a number where it is taken: files of several runs have the same one."""
    numbered = (f"{name}_{i}" for i in count(2))
    return name if name not in taken else next(other for other in numbered if other not in taken)


def with_some_sense(names: Sequence[str]) -> list[str]:
    """Those scripted policies that a team can be measured by, or the random one if there is none such."""
    return [name for name in names if name not in ("random", "still", "oracle")] or ["random"]


def label(player: str) -> str:
    """A player's name as part of a file's name and of a log's key."""
    return Path(player).stem.replace(" ", "-") if is_path(player) else player.replace(",", "+")


def with_teams(settings: Mapping[str, Any], pairs: Mapping[str, Any], own: Sequence[str]) -> dict[str, Any]:
    """
    Settings of co-training changed by the command line: ``wolf.gamma:0.9`` of one team, ``gamma:0.9`` of all.

    :param settings: with a map of ``teams``
    :param pairs: name → value
    :param own: names of settings that are not a team's
    :raises ValueError: for the settings of a team that there is not
    """
    teams: dict[str, Any] = dict(settings["teams"])
    changed = dict(settings)
    for name, value in pairs.items():
        if name in teams:
            teams[name] = merged(teams[name], value) if isinstance(value, dict) else value  # which is refused by its name
        elif isinstance(value, dict) and name not in own and name not in settings_of(MADDPG):
            raise ValueError(unknown_name("team", name, teams))
        elif name in own:
            changed = merged(changed, {name: value})
        else:
            maps = {team: theirs for team, theirs in teams.items() if isinstance(theirs, dict)}
            teams = {**teams, **{team: merged(theirs, {name: value}) for team, theirs in maps.items()}}
    return {**changed, "teams": teams}
