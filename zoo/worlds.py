"""The world that is played in: that of a training, with its settings, or the one that the command line names."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_kfcv.vec_env.make import make_vec_env
from sb3_kfcv.vec_env.named_wrappers import NamedWrapper, find_wrappers
from zoo.hyperparams import check_env_kwargs, merged, parse_pairs
from zoo.runs import Run


@dataclass
class World:
    """
    Where is played.

    :param env_id: id of the world
    :param env_kwargs: its settings
    :param env_wrapper: SuperSuit's wrappers around it
    """

    env_id: str
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    env_wrapper: list[NamedWrapper] = field(default_factory=list)

    @classmethod
    def of(cls, run: Run) -> World:
        """The world of a training."""
        hyperparams = run.hyperparams
        return cls(run.env_id, hyperparams.env_kwargs, hyperparams.env_wrapper)

    def make(self, n_envs: int, drawn: bool = False) -> VecEnv:
        """
        :param n_envs: how many worlds
        :param drawn: whether they are to be drawn
        :raises ValueError: for a setting that they do not take
        """
        kwargs = {**self.env_kwargs, **({"render_mode": "rgb_array"} if drawn else {})}
        return make_vec_env(self.env_id, n_envs, env_kwargs=kwargs, wrappers=find_wrappers(self.env_wrapper))


def find_world(args: argparse.Namespace, runs: Sequence[Run], words: Sequence[str] = ()) -> World:
    """
    The world of the first run, or that of ``--env``, with the settings of ``--env-kwargs``.

    :param args: the command line
    :param runs: those that play
    :param words: who else does, for the message
    :raises ValueError: if nothing says which world, if the runs are of several, and for settings that it does not have
    """
    of_it = [run for run in runs if args.env in (None, run.env_id)]
    if not of_it and args.env is None:
        raise ValueError(f"say with --env in which world {words[0]} is to play")
    worlds = list(dict.fromkeys(run.env_id for run in of_it))
    if len(worlds) > 1:
        raise ValueError(f"the runs are of several worlds; say with --env in which to play: {', '.join(worlds)}")
    trained_in = [World.of(run) for run in of_it]
    world = trained_in[0] if trained_in else World(args.env)
    for run, other in zip(of_it, trained_in, strict=True):
        if other != world:
            print(f"note: {run.folder.path} was trained in another {world.env_id}; all play as in the first", file=sys.stderr)
    world.env_kwargs = merged(world.env_kwargs, check_env_kwargs(world.env_id, parse_pairs("--env-kwargs", args.env_kwargs)))
    return world
