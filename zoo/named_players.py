"""Players as command lines name them: scripted policies, files, run folders, patterns of these; and their short names."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Sequence
from pathlib import Path

from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.saving.files import is_path
from zoo.run_folder import RunFolder, file_to_play
from zoo.runs import Run, natural, runs_below


def parse_team(words: Sequence[str], known: Sequence[str], flag: str = "--team") -> dict[str, list[str]]:
    """
    Group → players, as named on the command line, in the order in which the groups are named first.

    :param words: such as ``["wolf=chase", "wolf=wolves.zip"]``
    :param known: the groups of the world
    :param flag: for the message
    :raises ValueError: for a text that is no pair, and for an unknown group, with the nearest one
    """
    named: dict[str, list[str]] = {}
    for word in words:
        group, equals, player = word.partition("=")
        if not equals or not group or not player:
            raise ValueError(f'{flag} takes GROUP=PLAYER, such as {known[0]}=random; got "{word}"')
        if group not in known:
            raise ValueError(unknown_name("group", group, known))
        named.setdefault(group, []).append(player)
    return named


def found(player: str, group: str, best: bool = False) -> list[str]:
    """
    The players that a word of the command line stands for: names of scripted policies, and paths of files; a mixture is
    several of these between commas.

    :param player: a name, a file, a run folder, a pattern of paths, or a mixture
    :param group: whom it is to play
    :param best: of run folders take the model of the best evaluation
    :raises ValueError: if a pattern matches nothing, there is no such file, or a folder is no run, or has no model
    """
    if "," in player:
        return [",".join(one for part in player.split(",") for one in found(part, group, best))]
    paths = [player]
    if glob.has_magic(player):
        paths = sorted(glob.glob(player), key=natural)
        if not paths:
            raise ValueError(f'no file and no folder matches "{player}"')
    below = [str(run.folder.path) for path in paths for run in runs_below(path)] if all(map(os.path.isdir, paths)) else []
    return [str(file_to_play(path, group if best else None)) if is_named(path) else path for path in below or paths]


def run_of(word: str) -> Run | None:
    """The run that a folder or file belongs to, if it does to one."""
    path = Path(word)
    for place in (path, path.parent, path.parent.parent) if is_file(word) else ():
        folder = RunFolder.at(place)
        if folder is not None:
            return Run(folder)
    return None


def is_file(word: str) -> bool:
    """Whether a word means a file or folder, not a scripted policy."""
    return "," not in word and (is_path(word) or Path(word).is_dir())


def is_named(word: str) -> bool:
    """Whether a word means a file or folder, even if there is none: no scripted policy has an ending."""
    return is_path(word) or Path(word).suffix != ""


def label_of(player: str) -> str:
    """
    A short name: that of a scripted policy, ``kfcv_maddpg_1`` for the model of a run, with ``best`` or the number of env steps
    where it is not the last one, else that of the file.

    :param player: name of a scripted policy, or path of a file
    """
    if "," in player:
        return "+".join(map(label_of, player.split(",")))
    if not is_path(player):
        return player
    path = Path(player).resolve()
    place = path.parent.parent if path.parent.name == "players" else path.parent
    folder = RunFolder.at(place)
    if folder is None:
        return path.stem
    run = f"{place.parent.name}_{place.name.rpartition('_')[2]}"
    steps = re.search(r"_(\d+)(_steps)?\.zip$", path.name)
    if path == folder.last_model.resolve():
        return run
    return f"{run}@{steps.group(1)}" if steps else f"{run} {path.stem.removesuffix('_model')}"


def labelled(players: Sequence[str]) -> dict[str, str]:
    """
    Label → player, each once; those of one short name are told apart by as much of their paths as it takes.

    :param players: names of scripted policies, and paths of files
    """
    own = list({player if not is_path(player) else Path(player).resolve(): player for player in players}.values())
    labels = [label_of(player) for player in own]
    for i, player in enumerate(own):
        rivals = [other for k, other in enumerate(own) if label_of(other) == label_of(player) and k != i]
        if rivals and is_path(player):
            parts, *others = [Path(one).resolve().parts for one in (player, *rivals)]
            depth = next(n for n in range(1, 1 + len(parts)) if parts[-n:] not in [rival[-n:] for rival in others])
            labels[i] = "/".join(parts[-depth:])
    return dict(zip(labels, own, strict=True))
