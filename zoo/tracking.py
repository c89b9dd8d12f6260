"""Where a run is told of beside its own folder: TensorBoard's HParams page, and Weights & Biases."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any
from uuid import uuid4

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import HParam, KVWriter

from zoo.hyperparams import flat
from zoo.run_folder import RunFolder

# The other log formats cannot show a table of settings.
NOT_ELSEWHERE = ("stdout", "log", "json", "csv")

# What the runs are compared by on the HParams page.
COMPARED = ("eval/mean_reward", "rollout/ep_rew_mean")

# Flags that only mean something beside --track.
OF_TRACKING = ("wandb_project_name", "wandb_entity", "wandb_tags", "run_name")

STEPS = "env_steps"


def as_cells(settings: Mapping[str, Any]) -> dict[str, bool | int | float | str]:
    """
    Nested settings in one map, as tables can show them.

    :param settings: as YAML holds them
    :return: such as ``{"policy_kwargs.n_critics": 2}``; what is no number and no truth value as text
    """
    return {name: own if isinstance(own, bool | int | float) else str(own) for name, own in flat(settings).items()}


class HyperparamsPage(BaseCallback):
    """
    Puts the run on TensorBoard's HParams page.

    :param settings: of the run, as YAML holds them
    """

    def __init__(self, settings: Mapping[str, Any]) -> None:
        super().__init__()
        self.settings = settings

    def _on_training_start(self) -> None:
        page = HParam(as_cells(self.settings), dict.fromkeys(COMPARED, 0.0))
        self.logger.record("hparams", page, exclude=NOT_ELSEWHERE)

    def _on_step(self) -> bool:
        return True


class WandbWriter(KVWriter):
    """
    Sends the numbers of SB3's logger to a run of Weights & Biases, over env steps.

    :param run: of ``wandb.init``
    """

    def __init__(self, run: Any) -> None:
        self.run = run
        run.define_metric(STEPS)
        run.define_metric("*", step_metric=STEPS)  # not wandb's own count, which could not go back at a resume

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        numbers = {name: float(value) for name, value in key_values.items() if isinstance(value, int | float | np.number)}
        self.run.log({**numbers, STEPS: step})

    def close(self) -> None:
        """The run is finished by :func:`tracked`."""


def prepare_tracking(args: argparse.Namespace, defaults: argparse.Namespace) -> None:
    """
    Check the flags, and draw the id by which a resumed run is known again.

    :param args: the command line; the id is set
    :param defaults: the command line without flags
    :raises ValueError: for flags that mean nothing, and without wandb
    """
    if not args.track:
        for name in OF_TRACKING:
            if getattr(args, name) != getattr(defaults, name):
                raise ValueError(f"--{name.replace('_', '-')} is for runs that are tracked: add --track")
        return
    if importlib.util.find_spec("wandb") is None:
        raise ValueError('--track needs Weights & Biases: pip install "sb3-kfcv[track]"')
    args.wandb_id = uuid4().hex[:12]


@contextmanager
def tracked(args: argparse.Namespace, folder: RunFolder, settings: Mapping[str, Any]) -> Iterator[list[KVWriter]]:
    """
    While it trains, the run is one of Weights & Biases, too, where the command line wants it; a resumed one is the same there.

    :param args: the command line
    :param folder: of the run
    :param settings: of the run, as YAML holds them
    :return: log formats beside those of every run
    :raises ValueError: if Weights & Biases will not have it
    """
    if not args.track:
        yield []
        return
    import wandb

    try:
        run = wandb.init(
            project=args.wandb_project_name,
            entity=args.wandb_entity,
            name=args.run_name or f"{folder.path.parent.name}/{folder.path.name}",
            tags=args.wandb_tags,
            group=f"{args.algo} {args.env}",
            id=args.wandb_id,
            resume="allow",
            dir=str(folder.path),
            config={**settings, "algo": args.algo, "env": args.env, "seed": args.seed},
            settings=wandb.Settings(console="off", silent=args.verbose < 1),
        )
    except (wandb.Error, ValueError) as error:  # its settings are checked by pydantic, whose errors have many lines
        why = error.errors()[0]["msg"] if hasattr(error, "errors") else " ".join(str(error).split())
        hint = (
            "log in with `wandb login`, or keep the records here with WANDB_MODE=offline" if "API key" in why else "see --help"
        )
        raise ValueError(f"Weights & Biases does not take the run: {why} ({hint})") from None
    try:
        yield [WandbWriter(run)]
    finally:
        run.finish()
