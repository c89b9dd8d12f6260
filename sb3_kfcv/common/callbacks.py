"""What happens beside the training: evaluation, checkpoints, and stopping when told to."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EventCallback
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.evaluation import evaluate, with_interval
from sb3_kfcv.common.patient_logs import patience
from sb3_kfcv.saving.files import atomic_write, going_on
from sb3_kfcv.saving.values import UnwritableError
from sb3_kfcv.teams.players import JointModel
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import facts_of, layout_of


class MultiAgentEvalCallback(EventCallback):
    """
    SB3's ``EvalCallback`` with every metric of the worlds: logs ``eval/mean_reward``, ``eval/mean_ep_length`` and
    ``eval/<metric>``, keeps the best model, and writes all episodes of all evaluations to ``evaluations.npz``.

    That file has SB3's arrays ``timesteps`` (evaluations,), ``results`` and ``ep_lengths`` (evaluations, episodes), and
    one more of this shape for each metric.

    :param eval_env: the worlds, with seeds of their own
    :param eval_freq: env steps between evaluations
    :param n_eval_episodes: episodes per evaluation
    :param log_path: folder of ``evaluations.npz``; ``None`` writes none
    :param best_model_save_path: folder of ``best_model.zip``, the model with the highest mean reward; ``None`` keeps none
    :param deterministic: evaluate without exploration
    :param eval_at_start: evaluate also before the first step
    :param team: evaluate only what the model learns for this group, against ``opponents``: a yardstick that does not move,
        while the reward against others that learn says little. The reward is then the return of the group, and the best model
        is kept as ``best_<team>.zip``: the team's own learner, where several learn
    :param opponents: with ``team``: who plays each other group, see :func:`~sb3_kfcv.teams.players.find_player`
    :param name: what it logs under, in place of ``eval``; another one also writes to ``evaluations_<name>.npz``
    :param callback_after_eval: called after each evaluation
    :param verbose: 1 prints the results
    """

    model: Any
    KEPT = ("n_calls", "best_mean_reward", "last_mean_reward", "timesteps", "_next")

    def __init__(
        self,
        eval_env: VecEnv,
        eval_freq: int = 25_000,
        n_eval_episodes: int = 20,
        log_path: str | Path | None = None,
        best_model_save_path: str | Path | None = None,
        deterministic: bool = True,
        eval_at_start: bool = False,
        team: str | None = None,
        opponents: Mapping[str, Any] | None = None,
        name: str = "eval",
        callback_after_eval: BaseCallback | None = None,
        verbose: int = 1,
    ) -> None:
        super().__init__(callback_after_eval, verbose)
        self.team, self.name = team, name
        self.yardstick = self._yardstick(eval_env, opponents or {}) if team is not None else None
        self.eval_env = eval_env
        self.eval_freq = eval_freq
        self.n_eval_episodes = n_eval_episodes
        self.log_path = Path(log_path) if log_path else None
        self.best_model_save_path = Path(best_model_save_path) if best_model_save_path else None
        self.deterministic = deterministic
        self.eval_at_start = eval_at_start
        self.best_mean_reward = -np.inf
        self.last_mean_reward = -np.inf
        self.timesteps: list[int] = []
        self.evaluations: list[dict[str, np.ndarray]] = []

    def _yardstick(self, eval_env: VecEnv, opponents: Mapping[str, Any]) -> TeamPolicy:
        """The players of the other groups, and a place for the model's."""
        layout = layout_of(eval_env)
        layout.members(str(self.team))
        others = [group for group in layout.group_names if group != self.team]
        return TeamPolicy(layout, opponents, np.random.default_rng(0), others, eval_env.action_space, **facts_of(eval_env))

    def _on_training_start(self) -> None:
        self._next = _next_multiple(self.eval_freq, self.num_timesteps)
        if self.eval_at_start and self.num_timesteps == 0:
            self.evaluate()

    def _on_step(self) -> bool:
        if self.num_timesteps < self._next:
            return True
        self._next = _next_multiple(self.eval_freq, self.num_timesteps)
        self.evaluate()
        return self._on_event() if self.callback is not None else True

    def evaluate(self) -> None:
        """Evaluate the model as it is now: log, write, and keep it if it is the best."""
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        episodes = evaluate(self._player(), self.eval_env, self.n_eval_episodes, self.deterministic)
        if self.team is not None:
            episodes["reward"] = episodes[f"return_{self.team}"]
        self.timesteps.append(self.num_timesteps)
        self.evaluations.append(episodes)
        self._write()
        self._log(episodes)
        self.last_mean_reward = float(episodes["reward"].mean())
        if self.last_mean_reward > self.best_mean_reward:
            with going_on("the best model"):
                if self.best_model_save_path is not None:
                    learner = self.model if self.team is None else self.model.learners[self.team]
                    learner.save(self.best_model_save_path / f"best_{self.team or 'model'}.zip")
                self.best_mean_reward = self.last_mean_reward  # of the model in the file

    def _player(self) -> JointModel:
        if self.yardstick is None:
            return self.model
        player = self.model.learners[str(self.team)].policy
        return TeamPolicy(self.yardstick.layout, {**self.yardstick.players, str(self.team): player}, self.yardstick.rng)

    def arrays(self) -> dict[str, np.ndarray]:
        """All evaluations so far, as in ``evaluations.npz``."""
        names = {"reward": "results", "length": "ep_lengths"}
        return {
            "timesteps": np.array(self.timesteps),
            **{names.get(name, name): values for name, values in self._stacked().items()},
        }

    def _stacked(self) -> dict[str, np.ndarray]:
        """Every metric of all evaluations: (evaluations, episodes)."""
        names = self.evaluations[0] if self.evaluations else ()
        return {name: np.stack([episodes[name] for episodes in self.evaluations]) for name in names}

    def get_state(self) -> dict[str, Any]:
        """All results so far, when the next evaluation is due, and the players of a yardstick."""
        kept = {name: getattr(self, name) for name in (*self.KEPT, "name")}
        return {**kept, "evaluations": self._stacked(), **self._yardstick_state()}

    def _yardstick_state(self) -> dict[str, Any]:
        if self.yardstick is None:
            return {}
        try:
            players = self.yardstick.written(self.yardstick.players)
        except UnwritableError:  # found again where the training is resumed
            players = {}
        return {"yardstick": self.yardstick.get_state(), "players": players}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Inverse of :meth:`get_state`."""
        for name in self.KEPT:
            setattr(self, name, saved[name])
        if self.yardstick is not None:
            self.yardstick.go_on(saved["players"])
            self.yardstick.set_state(saved["yardstick"])
        by_name = saved["evaluations"]
        self.evaluations = [{name: values[i] for name, values in by_name.items()} for i in range(len(self.timesteps))]

    def _write(self) -> None:
        if self.log_path is not None:
            with going_on(self._file_name()), atomic_write(self.log_path / self._file_name()) as file:
                np.savez(file, **self.arrays())  # type: ignore[arg-type]

    def _file_name(self) -> str:
        return "evaluations.npz" if self.name == "eval" else f"evaluations_{self.name}.npz"

    def _log(self, episodes: dict[str, np.ndarray]) -> None:
        names = {"reward": "mean_reward", "length": "mean_ep_length"}
        for name, values in episodes.items():
            self.logger.record(f"{self.name}/{names.get(name, name)}", float(values.mean()))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        with patience(self.logger):
            self.logger.dump(self.num_timesteps)
        if self.verbose:
            groups = layout_of(self.eval_env).group_names
            parts = ", ".join(f"{group} {with_interval(episodes[f'return_{group}'])}" for group in groups)
            reward = with_interval(episodes["reward"])
            with going_on("the evaluation's result"):
                what = "evaluation" if self.name == "eval" else self.name
                print(f"{what} at {self.num_timesteps:,} env steps: reward {reward} (returns: {parts})")


class SavePlayers(BaseCallback):
    """
    Saves the actors alone every so many env steps, from the start on, as ``<team>_<N>_steps.zip``: players for matches, for
    curves of win rates, and for other trainings, many times smaller than checkpoints. A model that learns all agents is the
    team ``all``.

    :param folder: where they go
    :param save_freq: env steps between them; the end of the training is one, too
    """

    model: Any

    def __init__(self, folder: str | Path, save_freq: int) -> None:
        super().__init__()
        self.folder, self.save_freq = Path(folder), save_freq

    def _on_training_start(self) -> None:
        if self.model.get_vec_normalize_env() is not None:
            raise ValueError("players are saved without the statistics of VecNormalize, and would not play as they learnt")
        if self.num_timesteps == 0:
            self._save()
        self._next = _next_multiple(self.save_freq, self.num_timesteps)

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next = _next_multiple(self.save_freq, self.num_timesteps)
            self._save()
        return True

    def _on_training_end(self) -> None:
        self._save()

    def _save(self) -> None:
        for team, learner in self.model.learners.items():
            with going_on(f"the player of {team}"):
                ActorPolicy.of(learner.policy).save(self.folder / f"{team}_{self.num_timesteps}_steps.zip")

    def get_state(self) -> dict[str, Any]:
        """When the next ones are due."""
        return {"n_calls": self.n_calls, "next": self._next}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Inverse of :meth:`get_state`."""
        self.n_calls, self._next = saved["n_calls"], saved["next"]


class StopOnSignal(BaseCallback):
    """
    Ends the training when the process is told to (Ctrl-C, SIGTERM): the step in hand is finished, and the callbacks after
    this one see ``ending`` at the start of a rollout, where a checkpoint can be saved. A second signal interrupts at once.
    Signals are caught between ``with`` and its end.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        super().__init__()
        self.received: int | None = None
        self.ending = False

    def get_state(self) -> dict[str, Any]:
        """Nothing: a stop is not gone on with."""
        return {}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Inverse of :meth:`get_state`."""

    def __enter__(self) -> StopOnSignal:
        self._before = {number: signal.signal(number, self._receive) for number in self.SIGNALS}
        return self

    def __exit__(self, *_: Any) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _receive(self, number: int, _: FrameType | None) -> None:
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number
        name = signal.Signals(number).name
        print(f"{name}: the training stops after the step in hand; once more stops at once", file=sys.stderr, flush=True)

    def _on_rollout_start(self) -> None:
        self.ending = self.received is not None

    def _on_step(self) -> bool:
        return not self.ending


class TrainByTheClock(BaseCallback):
    """
    Ends the training after some time. Its progress, which schedules and the curriculum follow, is the share of the time
    that has passed, so ``total_timesteps`` only has to be larger than what the time allows.

    :param seconds: wall-clock time of the training, evaluations included
    """

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds = seconds

    @property
    def elapsed(self) -> float:
        """Seconds since the training started."""
        return time.monotonic() - self._start

    def get_state(self) -> dict[str, Any]:
        """The time that has passed."""
        return {"elapsed": self.elapsed}

    def set_state(self, saved: dict[str, Any]) -> None:
        """Inverse of :meth:`get_state`."""
        self._start = time.monotonic() - saved["elapsed"]

    def _on_training_start(self) -> None:
        self._start = time.monotonic()

    def _on_step(self) -> bool:
        # SB3 computes the remaining progress as 1 − num_timesteps / _total_timesteps.
        share = min(max(self.elapsed / self.seconds, 1e-6), 1.0)
        self.model._total_timesteps = int(np.ceil(self.num_timesteps / share))
        return self.elapsed < self.seconds


def _next_multiple(period: int, steps: int) -> int:
    """The first multiple of ``period`` above ``steps``."""
    return (steps // period + 1) * period
