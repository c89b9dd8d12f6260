"""
Checkpoints from which a training goes on bit for bit: written between a training step and the next rollout, where model,
buffer and worlds belong together.

A checkpoint is a model file with further sections. The transitions of the replay buffer never change once they are stored, so
each checkpoint writes only those that came since the last one, into a file of their own, and names all the files that its
buffer is made of::

    rl_model_<N>_steps.zip             checkpoint after N env steps; a model file, too
    transitions/<first>_<last>.zip     the transitions of these steps of the vec env
"""

from __future__ import annotations

import inspect
import re
import warnings
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.saving.archive import Archive, FileFormatError, open_archive, write_archive
from sb3_kfcv.saving.attributes import check_attributes, require_own, without_retired
from sb3_kfcv.saving.files import going_on
from sb3_kfcv.saving.run_state import (
    UnreadableEnvError,
    callback_states,
    callbacks_of,
    env_state,
    envs_of,
    log_state,
    random_state,
    set_callback_states,
    set_env_state,
    set_log_state,
    set_random_state,
)
from sb3_kfcv.saving.saveable import SaveableAlgorithm, further_sections, refusals
from sb3_kfcv.saving.transitions import packed, unpacked
from sb3_kfcv.saving.values import check_writable, encode

NAME = re.compile(r"rl_model_(\d+)_steps\.zip")

# Settings of an algorithm that may differ when a training goes on.
FREE_SETTINGS = (
    "self",
    "env",
    "policy",
    "action_noise",
    "verbose",
    "tensorboard_log",
    "device",
    "_init_setup_model",
    "opponents",
)


class ResumeError(ValueError):
    """A checkpoint is of another training than the one that is to go on."""


def checkpoints_in(folder: str | Path) -> dict[int, Path]:
    """The checkpoints of a folder by their number of env steps, the latest first; whole or not."""
    found = {int(match.group(1)): path for path in Path(folder).glob("*") if (match := NAME.fullmatch(path.name))}
    return dict(sorted(found.items(), reverse=True))


def latest_checkpoint(folder: str | Path) -> Checkpoint | None:
    """
    The latest checkpoint of a folder that is whole. Damaged later ones are named in a warning and set aside as ``*.damaged``.

    :param folder: of a training
    :return: ``None`` if there is no checkpoint
    :raises FileFormatError: if there are some and none is whole; they stay as they are
    """
    damaged: list[tuple[int, Path, FileFormatError]] = []
    for steps, path in checkpoints_in(folder).items():
        try:
            checkpoint = Checkpoint(path)
        except FileFormatError as error:
            damaged.append((steps, path, error))
            continue
        for later, its_path, reason in damaged:
            aside = its_path.replace(its_path.with_name(f"{its_path.name}.damaged"))
            warnings.warn(f"the checkpoint after {later:,} env steps is of no use, and set aside as {aside.name}: {reason}")
        return checkpoint
    if damaged:
        raise FileFormatError(f"no checkpoint in {folder} is whole, so nothing can be gone on with: {damaged[0][2]}")
    return None


class Checkpoint:
    """
    A checkpoint file, read and found whole.

    :param path: of the file
    :raises FileFormatError: if it, or a file of its transitions, is damaged or missing
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_archive(path, "checkpoint") as archive:
            self.attributes: dict[str, Any] = without_retired(archive.read("attributes"))
            self.parameters: dict[str, Any] = archive.read("parameters")
            self.replay_buffer: dict[str, Any] = archive.read("replay_buffer")
            self.training: dict[str, Any] = archive.read("training")
            self.further = further_sections(archive)
            with refusals(archive, "training"):
                self.pieces = [Piece(**piece) for piece in self.training["transitions"]]
                self.steps = int(self.attributes["num_timesteps"])
            self.transitions = self._read_transitions(archive)

    def refuse(self, what: str) -> NoReturn:
        """
        :raises FileFormatError: always, with the name of the file
        """
        raise FileFormatError(f"{self.path} {what}")

    def _read_transitions(self, archive: Archive) -> dict[str, np.ndarray]:
        read = []
        for piece in self.pieces:
            try:
                read.append(piece.read(self.path.parent))
            except FileNotFoundError:
                archive.refuse(f"needs {piece.path(self.path.parent)}, which is missing")
        with refusals(archive, "training"):
            held = min(self.replay_buffer["n_added"], self.replay_buffer["n_steps"])
            joined = {name: np.concatenate([part[name] for part in read]) for name in (read[0] if read else ())}
            return {name: array[len(array) - held :] for name, array in joined.items()}


class Piece:
    """
    A file of transitions.

    :param first: number of its first step
    :param last: number of the step after its last one
    :param sha256: of the file
    """

    def __init__(self, first: int, last: int, sha256: str) -> None:
        self.first, self.last, self.sha256 = int(first), int(last), str(sha256)

    def path(self, folder: Path) -> Path:
        """Where it lies."""
        return folder / "transitions" / f"{self.first}_{self.last}.zip"

    def read(self, folder: Path) -> dict[str, np.ndarray]:
        """
        :raises FileFormatError: if it is damaged, or another one than when the checkpoint was written
        """
        with open_archive(self.path(folder), "transitions") as archive:
            if archive.digest != self.sha256:
                archive.refuse("is another file than the one that the checkpoint was written with")
            with refusals(archive, "transitions"):
                return unpacked(archive.read("transitions"))


class Checkpoints(BaseCallback):
    """
    Saves a checkpoint every so many env steps, and goes on from the latest one when asked to, bit for bit::

        model = KFCVMADDPG("MlpPolicy", env, seed=1)
        model.learn(1_000_000, Checkpoints("run", save_freq=50_000, resume=True))

    The same lines start the training, and continue it after whatever ended it: parameters, optimisers, buffer, priorities,
    folds, teachers, random generators, noise, worlds, counters, callbacks and logs are as they were. Worlds go on where
    their state can be read (this package's; any parallel env with ``get_state()`` and ``set_state()``); others restart, which
    a warning says, and everything else is exact.

    Put it first among the callbacks, after a :class:`~sb3_kfcv.common.callbacks.StopOnSignal`.

    :param folder: where the checkpoints lie
    :param save_freq: env steps between checkpoints, the end of the training being one, too; −1: only when the training is
        stopped by ``stop``
    :param keep: how many of the latest checkpoints are kept; −1: all
    :param resume: go on from the latest checkpoint in the folder, if there is one
    :param stop: stops the training when a signal comes; a checkpoint is saved before
    :param verbose: 1 says from where the training goes on
    """

    model: SaveableAlgorithm

    def __init__(
        self,
        folder: str | Path,
        save_freq: int = 25_000,
        keep: int = 3,
        resume: bool = False,
        stop: Any = None,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if save_freq != -1:
            require_count("save_freq", save_freq)
        if keep == 0:
            raise ValueError("keep=0 would keep no checkpoint; give -1 to keep all")
        self.folder = Path(folder)
        self.save_freq, self.keep, self.resume, self.stop = save_freq, keep, resume, stop
        self.last_path: Path | None = None
        self._pieces: list[Piece] = []
        self._pieces_of: dict[Path, list[Piece]] = {}  # of checkpoints known to be whole
        self._resumed: Checkpoint | None = None
        self._mid_rollout = False

    def get_state(self) -> dict[str, Any]:
        """What must not be lost: when the next checkpoint is due."""
        return {"n_calls": self.n_calls, "next": self._next}

    def set_state(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`get_state`."""
        self.n_calls = state["n_calls"]
        if self.save_freq == self._saved_freq:
            self._next = state["next"]

    def _on_training_start(self) -> None:
        self._check_surroundings()
        self._pieces = []
        for path in (*self.folder.glob(".*.partial"), *self.folder.glob("transitions/.*.partial")):
            path.unlink(missing_ok=True)  # of a process that was killed while it wrote
        self._resumed = latest_checkpoint(self.folder) if self.resume else None
        if self._resumed is not None:
            self._restore_model(self._resumed)
            self.num_timesteps = self.model.num_timesteps
            if self.verbose:
                print(f"going on after {self.num_timesteps:,} env steps, from {self._resumed.path}")
        steps = max(checkpoints_in(self.folder), default=0)
        if steps > self.num_timesteps:
            raise ValueError(
                f"{self.folder} holds a checkpoint of {steps:,} env steps, of another training: go on with it by resume=True, "
                "or give a folder of its own"
            )
        self._next = self._after(self.num_timesteps)

    def _check_surroundings(self) -> None:
        """
        Say which worlds cannot go on.

        :raises ValueError: if another callback would write files of the same names
        """
        envs = [self.training_env]
        for callback in callbacks_of(self.locals["callback"]):
            envs += envs_of(callback).values()
            if isinstance(callback, CheckpointCallback) and callback.name_prefix == "rl_model":
                if Path(callback.save_path).resolve() == self.folder.resolve():
                    raise ValueError(
                        f"CheckpointCallback writes files of the same names into {self.folder}: give it another name_prefix"
                    )
        for env in envs:
            try:
                check_writable({"the state of the worlds": env_state(env)})
            except UnreadableEnvError as unreadable:
                warnings.warn(
                    f"the state of {unreadable} cannot be read: a resumed training starts new episodes; "
                    "everything else is exact"
                )

    def _after(self, steps: int) -> int:
        return (steps // self.save_freq + 1) * self.save_freq if self.save_freq > 0 else 0

    def _on_rollout_start(self) -> None:
        if self._resumed is not None:
            self._restore_training(self._resumed)
            self._resumed = None
        elif (self.save_freq > 0 and self.model.num_timesteps >= self._next) or (self.stop is not None and self.stop.ending):
            self._next = self._after(self.model.num_timesteps)
            with going_on(f"the checkpoint after {self.model.num_timesteps:,} env steps"):
                self.save()

    def _on_step(self) -> bool:
        self._mid_rollout = True
        return True

    def _on_rollout_end(self) -> None:
        self._mid_rollout = False

    def _on_training_end(self) -> None:
        """The end is a checkpoint, too, unless a callback ended the training before its last step was stored."""
        if self._resumed is not None:  # there was nothing left to do
            self._restore_training(self._resumed)
            self._resumed = None
        elif self.save_freq > 0 and not self._mid_rollout:
            with going_on(f"the checkpoint after {self.model.num_timesteps:,} env steps"):
                self.save()

    # ---- writing

    def save(self) -> Path:
        """
        Write a checkpoint of now, and remove those that are not to be kept.

        :return: its path
        :raises OSError: if it cannot be written; the older ones stay
        """
        model = self.model
        path = self.folder / f"rl_model_{model.num_timesteps}_steps.zip"
        pieces = self._write_transitions()
        training = {
            "random": random_state(model),
            "env": self._env_state(),
            "callbacks": callback_states(self.locals["callback"]),
            "logs": log_state(model, self.folder),
            "learner": model.training_state(),
            "transitions": [vars(piece) for piece in pieces],
            "save_freq": self.save_freq,
        }
        sections = {**model.sections(), "replay_buffer": model.replay_buffer_state(), "training": training}
        write_archive(path, "checkpoint", sections)
        self._pieces = self._pieces_of[path] = pieces
        self.last_path = path
        self._remove_old()
        return path

    def _env_state(self) -> list[dict[str, Any]] | None:
        try:
            return env_state(self.training_env)
        except UnreadableEnvError:
            return None

    def _write_transitions(self) -> list[Piece]:
        """Write those since the last checkpoint: all files that the buffer is now made of."""
        buffer = self.model.replay_buffer
        oldest = buffer.n_added - buffer.size()
        first = max([oldest, *(piece.last for piece in self._pieces)])
        if first > buffer.n_added:  # the buffer was emptied meanwhile
            self._pieces, first = [], oldest
        pieces = [piece for piece in self._pieces if piece.last > oldest]
        if first < buffer.n_added:
            new = Piece(first, buffer.n_added, "")
            new.sha256 = write_archive(
                new.path(self.folder), "transitions", {"transitions": packed(buffer.transitions(first))}
            )
            pieces.append(new)
        return pieces

    def _remove_old(self) -> None:
        paths = [*checkpoints_in(self.folder).values()]
        kept = paths if self.keep < 0 else paths[: self.keep]
        for path in paths[len(kept) :]:
            path.unlink()
        needed = {piece.path(self.folder) for path in kept for piece in self._pieces_known(path)}
        for path in (self.folder / "transitions").glob("*.zip"):
            if path not in needed:
                path.unlink()

    def _pieces_known(self, path: Path) -> list[Piece]:
        if path not in self._pieces_of:
            try:
                with open_archive(path, "checkpoint") as archive:
                    self._pieces_of[path] = [Piece(**piece) for piece in archive.read("training")["transitions"]]
            except FileFormatError:  # of no use, see latest_checkpoint()
                self._pieces_of[path] = []
        return self._pieces_of[path]

    # ---- going on

    def _restore_model(self, checkpoint: Checkpoint) -> None:
        """
        :raises ResumeError: if the model is not the one that the checkpoint was written by
        """
        self._check_settings(checkpoint)
        model, attributes = self.model, dict(checkpoint.attributes)
        attributes.setdefault("action_noise", None)
        with refusals(checkpoint, "attributes"):
            check_attributes(attributes, type(model))
            require_own(attributes, model)
        self._take_opponents(checkpoint)
        for name in ("algorithm", "verbose", "tensorboard_log", "opponents", "_total_timesteps"):
            attributes.pop(name, None)
        with refusals(checkpoint, "parameters"):
            model.set_parameters(model.checked_parameters(checkpoint.parameters))
        with refusals(checkpoint, "replay_buffer"):
            none_yet = model.replay_buffer.transitions(model.replay_buffer.n_added)
            model.set_replay_buffer_state(checkpoint.replay_buffer, checkpoint.transitions or none_yet)
        vars(model).update(attributes)
        with refusals(checkpoint, "attributes"):
            model.take_sections(checkpoint.further)
        self._pieces = self._pieces_of[checkpoint.path] = checkpoint.pieces
        self.last_path = checkpoint.path

    def _take_opponents(self, checkpoint: Checkpoint) -> None:
        try:
            self.model.take_opponents(checkpoint.attributes.get("opponents") or {})
        except ValueError as error:
            raise ResumeError(f"{checkpoint.path} is of a training against others: {error}") from None

    def _check_settings(self, checkpoint: Checkpoint) -> None:
        model, saved = self.model, checkpoint.attributes
        algorithm = type(model).__name__
        if saved["algorithm"] != algorithm:
            raise ResumeError(f"{checkpoint.path} is of {saved['algorithm']}; this model is a {algorithm}")
        if saved["layout"] != model.layout:
            ours, theirs = (f"{layout} and a state of {layout.state_size}" for layout in (model.layout, saved["layout"]))
            raise ResumeError(f"{checkpoint.path} is of another world: {theirs}; this model's has {ours}")
        names = [name for name in inspect.signature(type(model)).parameters if name not in FREE_SETTINGS]
        for name in ("n_envs", *names):
            if name in saved and _comparable(saved[name]) != _comparable(getattr(model, name)):
                ours = getattr(model, name)
                raise ResumeError(f"{checkpoint.path} was written with {name}={saved[name]}; this model has {name}={ours}")

    def _restore_training(self, checkpoint: Checkpoint) -> None:
        """Everything beside the model, as late as can be: nothing is drawn between here and the next step."""
        model, training = self.model, checkpoint.training
        with refusals(checkpoint, "training"):
            if training["env"] is not None:
                set_env_state(self.training_env, training["env"])
            else:
                self.training_env.seed((model.seed or 0) + model.num_timesteps)
                model._last_obs = self.training_env.reset()  # type: ignore[assignment]
                model._last_episode_starts = np.ones(model.n_envs, dtype=bool)
                if model.get_vec_normalize_env() is not None:
                    model._last_original_obs = model.get_vec_normalize_env().get_original_obs()  # type: ignore[union-attr]
            model.set_training_state(training["learner"])
            self._saved_freq = training["save_freq"]
            set_callback_states(self.locals["callback"], training["callbacks"])
            set_log_state(model, training["logs"], self.folder)
            set_random_state(model, training["random"])
        for name in ("_num_timesteps_at_start", "action_noise"):  # learn() has just set them anew
            setattr(model, name, checkpoint.attributes[name])


def _comparable(value: Any) -> Any:
    """A value as plain data that ``==`` can compare."""
    arrays: list[Any] = []

    def store(_: str, array: np.ndarray) -> str:
        arrays.append((array.shape, str(array.dtype), array.tobytes()))
        return str(len(arrays))

    return encode(value, "setting", store), arrays
