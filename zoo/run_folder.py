"""The folder of a training run: the one place that knows what lies where, laid out as in rl-baselines3-zoo."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml

from sb3_kfcv import __version__
from sb3_kfcv.common.files import atomic_write

LIBRARIES = ("stable_baselines3", "torch", "numpy", "gymnasium", "pettingzoo", "numba", "scipy")


@dataclass(frozen=True)
class RunFolder:
    """
    ``<log folder>/<algo>/<env>_<k>``::

        <env>.zip                  the model at the end of training
        best_model.zip             the model of the best evaluation
        rl_model_<N>_steps.zip     checkpoints
        replay_buffer.npz          the replay buffer at the end, if it was to be saved
        *_vecnormalize.npz         beside each model: its observation statistics, if it has any
        evaluations.npz            every episode of every evaluation
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

    @property
    def number(self) -> int:
        """k: the how-manieth run of this algorithm in this world it is."""
        return int(self.path.name.rpartition("_")[2])

    @property
    def last_model(self) -> Path:
        return self.path / f"{file_name(self.env_id)}.zip"

    @property
    def replay_buffer(self) -> Path:
        return self.path / "replay_buffer.npz"

    @property
    def monitor_file(self) -> Path:
        return self.path / "0.monitor.csv"

    @property
    def config_file(self) -> Path:
        return self.path / file_name(self.env_id) / "config.yml"

    def describe(self, settings: Mapping[str, Any], arguments: Mapping[str, Any], command: str) -> None:
        """
        Write down how the run was started.

        :param settings: the resolved hyperparameters
        :param arguments: the resolved command line
        :param command: as it was typed
        """
        versions = {"python": platform.python_version(), "sb3_kfcv": __version__} | {name: version(name) for name in LIBRARIES}
        texts = {
            "config.yml": _as_yaml(settings),
            "args.yml": _as_yaml(arguments),
            "command.txt": command + "\n",
            "versions.json": json.dumps({**versions, "platform": platform.platform()}, indent=2) + "\n",
        }
        for name, text in texts.items():
            with atomic_write(self.config_file.with_name(name)) as file:
                file.write(text.encode("utf-8"))


def file_name(env_id: str) -> str:
    """An env id as part of a path (gym ids may have a namespace, ``ns/Name-v0``)."""
    return env_id.replace("/", "-")


def _as_yaml(values: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(values), sort_keys=False, allow_unicode=True)
