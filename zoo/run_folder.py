"""The folder of a training run: the one place that knows what lies where, laid out as in rl-baselines3-zoo."""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout

from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.saving.archive import library_versions
from sb3_kfcv.saving.checkpoints import checkpoints_in
from sb3_kfcv.saving.files import atomic_write, existing


@dataclass(frozen=True)
class RunFolder:
    """
    ``<log folder>/<algo>/<env>_<k>``::

        <env>.zip                  the model at the end of training
        best_model.zip             the model of the best evaluation
        best_<team>.zip            of a team that is measured by a yardstick: its learner at its best
        players/                   <team>_<N>_steps.zip: the actors alone, for matches
        rl_model_<N>_steps.zip     the latest checkpoints, from which the run can be resumed; models, too
        transitions/               what their replay buffers hold
        replay_buffer.zip          the replay buffer at the end, if it was to be saved
        evaluations.npz            every episode of every evaluation
        evaluations_<name>.npz     the same against a yardstick, such as wolf_vs_graze
        0.monitor.csv              every training episode
        events.out.tfevents.*      TensorBoard
        <env>/config.yml           the settings, resolved
        <env>/args.yml             the command line, resolved, with the seed
        <env>/command.txt          the command as it was typed
        <env>/versions.json        versions of Python and the libraries

    :param path: the folder
    :param env_id: id of the world
    """

    path: Path
    env_id: str

    @classmethod
    def create(cls, log_folder: str | Path, algo: str, env_id: str) -> RunFolder:
        """
        Make the next free folder; of several starts at once, each gets its own.

        :param log_folder: where all runs lie
        :param algo: name of the algorithm
        :param env_id: id of the world
        """
        parent = Path(log_folder) / algo
        parent.mkdir(parents=True, exist_ok=True)
        name = file_name(env_id)
        taken = (path.name.removeprefix(f"{name}_") for path in parent.glob(f"{name}_*"))
        number = max((int(suffix) for suffix in taken if suffix.isdecimal()), default=0)
        while True:
            number += 1
            try:
                (parent / f"{name}_{number}").mkdir()
            except FileExistsError:
                continue
            return cls(parent / f"{name}_{number}", env_id)

    @classmethod
    def of_model(cls, model_path: str | Path, env_id: str) -> RunFolder:
        """The folder in which a saved model lies."""
        return cls(Path(model_path).parent, env_id)

    @classmethod
    def existing(cls, path: str | Path) -> RunFolder:
        """
        The folder of a run that was begun.

        :raises ValueError: if it is none
        """
        path = Path(path)
        folder = cls.at(path)
        if folder is None:
            near = _runs_near(path)
            raise ValueError(
                unknown_name("run folder", path, near) if near else f"{path} is no folder of a run of zoo/train.py"
            )
        return folder

    @classmethod
    def at(cls, path: str | Path) -> RunFolder | None:
        """
        The folder of a run that was begun, if it is one: its ``<env>/args.yml`` is of that world.

        :raises ValueError: if it has the name of a run, and this file is damaged
        """
        path = Path(path)
        for file in sorted(path.glob("*/args.yml")):
            try:
                return cls(path, _env_of(file))
            except ValueError:
                if path.resolve().name.startswith(f"{file.parent.name}_"):
                    raise
        return None

    @contextmanager
    def locked(self) -> Iterator[None]:
        """
        Keep other processes out while this one trains here; the system lets go of the lock when the process ends.

        :raises ValueError: if one is at it
        """
        try:
            with FileLock(self.path / ".lock", timeout=0):
                yield
        except Timeout:
            raise ValueError(f"another process is training in {self.path}") from None

    @property
    def number(self) -> int:
        """k: the how-manieth run of this algorithm in this world it is."""
        return int(self.path.name.rpartition("_")[2])

    @property
    def can_play(self) -> bool:
        """Whether it has a model or a checkpoint yet."""
        return self.last_model.is_file() or bool(checkpoints_in(self.path))

    @property
    def last_model(self) -> Path:
        return self.path / f"{file_name(self.env_id)}.zip"

    @property
    def players(self) -> Path:
        return self.path / "players"

    def snapshots(self, group: str) -> dict[int, Path]:
        """The files that can play a group, by number of env steps, the earliest first: saved players, and the checkpoints."""
        name = re.compile(rf"({re.escape(group)}|all)_(\d+)_steps\.zip")
        saved = {int(match.group(2)): path for path in self.players.glob("*") if (match := name.fullmatch(path.name))}
        return dict(sorted({**checkpoints_in(self.path), **saved}.items()))

    @property
    def replay_buffer(self) -> Path:
        return self.path / "replay_buffer.zip"

    @property
    def monitor_file(self) -> Path:
        return self.path / "0.monitor.csv"

    @property
    def arguments_file(self) -> Path:
        return self.config_file.with_name("args.yml")

    @property
    def config_file(self) -> Path:
        return self.path / file_name(self.env_id) / "config.yml"

    @property
    def best_model(self) -> Path:
        return self.path / "best_model.zip"

    @property
    def command(self) -> str:
        """The command line as it was typed."""
        return self.config_file.with_name("command.txt").read_text(encoding="utf-8").strip()

    @property
    def versions(self) -> dict[str, str]:
        """
        Versions of Python and the libraries with which it was begun.

        :raises ValueError: if the file holds something else
        """
        file = self.config_file.with_name("versions.json")
        try:
            versions = json.loads(file.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{file} is no valid JSON: {error}") from None
        if not isinstance(versions, dict):
            raise ValueError(f"{file} holds no map of versions")
        return versions

    def describe(
        self,
        settings: Mapping[str, Any],
        arguments: Mapping[str, Any],
        command: str,
        versions: Mapping[str, str] | None = None,
    ) -> None:
        """
        Write down how the run was started; the command line last, which makes it a run that can be resumed.

        :param settings: the resolved hyperparameters
        :param arguments: the resolved command line
        :param command: as it was typed
        :param versions: of Python and the libraries; by default those of here
        """
        versions = versions or {**library_versions(), "platform": platform.platform()}
        texts = {
            "config.yml": _as_yaml(settings),
            "command.txt": command + "\n",
            "versions.json": json.dumps(versions, indent=2) + "\n",
            "args.yml": _as_yaml(arguments),
        }
        for name, text in texts.items():
            with atomic_write(self.config_file.with_name(name)) as file:
                file.write(text.encode("utf-8"))

    def versions_changed(self) -> list[str]:
        """Libraries that have another version than when the run was begun, each as ``torch 2.12.0 → 2.13.0``."""
        then, now = self.versions, library_versions()
        return [f"{name} {then.get(name)} → {found}" for name, found in now.items() if then.get(name) != found]


def file_to_play(path: str | Path, best_of: str | None = None) -> Path:
    """
    The file that a path means as a player: the file itself; of a run folder the last model, else the latest checkpoint.

    :param path: of a file or a run folder
    :param best_of: of a run folder the model of the best evaluation instead, of this group where it was measured by itself
    :raises ValueError: if there is none
    """
    file: Path = existing(Path(path))
    if file.is_file():
        return file
    if not Path(path).is_dir():
        raise ValueError(f"there is no file {path} to take a player of{_or_else(Path(path))}")
    folder = RunFolder.existing(path)
    if best_of is not None:
        for best in (folder.path / f"best_{best_of}.zip", folder.path / "best_model.zip"):
            if best.is_file():
                return best
        raise ValueError(f"the run in {folder.path} has no best_{best_of}.zip and no best_model.zip yet")
    if folder.last_model.is_file():
        return folder.last_model
    checkpoints = [*checkpoints_in(folder.path).values()]
    if not checkpoints:
        raise ValueError(f"the run in {folder.path} has no model and no checkpoint yet")
    return checkpoints[0]


def _env_of(arguments_file: Path) -> str:
    """
    The world of a run.

    :param arguments_file: ``<env>/args.yml``
    :raises ValueError: if it is none of zoo/train.py
    """
    arguments = read_map(arguments_file)
    env_id = arguments.get("env")
    if isinstance(env_id, str) and file_name(env_id) == arguments_file.parent.name and {"algo", "seed"} <= arguments.keys():
        return env_id
    raise ValueError(f"{arguments_file} is no command line of zoo/train.py: it needs algo, env and seed, env as its folder")


def _beside(path: Path, pattern: str) -> list[Path]:
    """What there is beside a path that is none, or, where its folder is none either, in the folders beside that."""
    return list(path.parent.glob(pattern) if path.parent.is_dir() else path.parent.parent.glob(f"*/{pattern}"))


def _runs_near(path: Path) -> list[str]:
    near = []
    for file in _beside(path, "*/*/args.yml"):
        with suppress(ValueError):
            _env_of(file)
            near.append(str(file.parent.parent))
    return near


def _or_else(path: Path) -> str:
    """What may be meant by a path that is none: the nearest file or run, if one is near, by the names that differ."""
    depth = 1 if path.parent.is_dir() else 2
    near = [*map(str, _beside(path, "*.zip")), *_runs_near(path)]
    names = {"/".join(Path(other).parts[-depth:]): other for other in near}
    close = get_close_matches("/".join(path.parts[-depth:]), names, n=1)
    return f'; did you mean "{names[close[0]]}"?' if close else ""


def file_name(env_id: str) -> str:
    """An env id as part of a path (gym ids may have a namespace, ``ns/Name-v0``)."""
    return env_id.replace("/", "-")


def _as_yaml(values: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(values), sort_keys=False, allow_unicode=True)


class UniqueKeys(yaml.SafeLoader):
    """PyYAML lets the last of equal keys win without a word; here they are an error, as YAML itself has it."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in seen:
                    raise yaml.constructor.ConstructorError(None, None, f'"{key.value}" stands there twice', key.start_mark)
                seen.add((key.tag, key.value))
        return node


def read_map(path: Path) -> dict[str, Any]:
    """
    A YAML file that holds a map.

    :raises ValueError: if it is missing, no YAML, has equal keys, or is something else
    """
    try:
        loader = UniqueKeys(path.read_text(encoding="utf-8"))
        loader.name = path.name  # for messages
        content = loader.get_single_data()
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} holds no map of settings")
    return content
