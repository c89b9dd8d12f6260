"""Saving and loading as in SB3, in the one file format: nothing is run on loading, nothing half-written is left behind."""

from __future__ import annotations

import io
import pathlib
import warnings
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar, NoReturn, Protocol, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.stacked_networks import at_most
from sb3_kfcv.replay.joint_replay_buffer import JointReplayBuffer
from sb3_kfcv.saving.archive import Archive, FileFormatError, open_archive, write_archive
from sb3_kfcv.saving.attributes import NEEDED, check_attributes, without_retired
from sb3_kfcv.saving.files import existing, with_suffix
from sb3_kfcv.saving.normalization import normalization_state
from sb3_kfcv.saving.parameters import check_network, check_optimizer
from sb3_kfcv.saving.transitions import packed, unpacked
from sb3_kfcv.saving.values import check_writable
from sb3_kfcv.vec_env.make import env_named, layout_of

SelfSaveable = TypeVar("SelfSaveable", bound="SaveableAlgorithm")

MODEL_KINDS = ("model", "checkpoint")

# Sections that only the files of some algorithms have: the attributes of several learners.
FURTHER_SECTIONS = ("teams",)

# What comes of values that do not fit where they are put.
WRONG_VALUES = (
    *(ValueError, TypeError, KeyError, AttributeError, IndexError, RuntimeError),
    *(ArithmeticError, AssertionError, MemoryError),
)


class SaveableAlgorithm(OffPolicyAlgorithm):
    """
    An off-policy algorithm of many agents whose files hold data only, see :mod:`sb3_kfcv.saving.archive`.

    A model file has the sections ``attributes`` (settings and counters), ``parameters`` (networks and optimisers) and, of
    normalised worlds, ``normalization``.
    """

    # Settings of the constructor that may hold what no file can: checked when the model is made.
    checked_settings: ClassVar[tuple[str, ...]] = (
        *("policy_class", "learning_rate", "action_noise", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs"),
    )

    # Whether it was released for playing only, see :func:`sb3_kfcv.saving.releases.release_model`.
    plays_only: bool = False

    layout: AgentLayout
    replay_buffer: JointReplayBuffer

    def _setup_model(self) -> None:
        check_writable({name: getattr(self, name) for name in self.checked_settings})
        super()._setup_model()

    # ---- what a file holds

    def attributes(self, exclude: Collection[str] = (), include: Collection[str] = ()) -> dict[str, Any]:
        """
        Settings and counters: what is neither a network nor made anew by the constructor.

        :param exclude: names to leave out beside those that are left out by default
        :param include: names to keep that are left out by default
        """
        networks = {name.split(".")[0] for name in self._get_torch_save_params()[0]}
        left_out = (set(exclude) | set(self._excluded_save_params()) | networks) - set(include)
        return {name: value for name, value in vars(self).items() if name not in left_out}

    def sections(self, exclude: Collection[str] = (), include: Collection[str] = ()) -> dict[str, Any]:
        """The sections of a model file; the parameters are those of :meth:`attributes`."""
        env = self.get_vec_normalize_env()
        return {
            "attributes": {"algorithm": type(self).__name__, **self.attributes(exclude, include)},
            "parameters": self.checked_parameters(self.get_parameters()),
            **({} if env is None else {"normalization": normalization_state(env)}),
        }

    def checked_parameters(self, parameters: dict[str, Any], place: str = "parameters") -> dict[str, Any]:
        """
        Parameters, if they are this model's and finite, for :meth:`set_parameters`.

        :raises ValueError: names the parameter that is not
        """
        names = self._get_torch_save_params()[0]
        if set(parameters) != set(names):
            raise ValueError(f"the parameters are of {', '.join(parameters)}; this model has {', '.join(names)}")
        checked = dict(parameters)
        for name, saved in parameters.items():
            owner: Any = self
            for part in name.split("."):
                owner = getattr(owner, part)
            if isinstance(owner, th.optim.Optimizer):
                checked[name] = check_optimizer(owner, saved, f"{place}/{name}")
            else:
                check_network(owner, saved, f"{place}/{name}")
        return checked

    def training_state(self) -> dict[str, Any]:
        """What an exact resume needs beside all this."""
        return {}

    def set_training_state(self, saved: dict[str, Any]) -> None:
        """Inverse of :meth:`training_state`."""

    def take_opponents(self, then: Mapping[str, Any]) -> None:
        """
        Go on against those that a training was against, whatever their files hold by now.

        :param then: the players as a checkpoint holds them, by the group that they play
        :raises ValueError: if others are to play here
        """

    def take_sections(self, sections: Mapping[str, Any]) -> None:
        """
        Take over what an algorithm's file has beside attributes, parameters and what every kind of file has.

        :param sections: those of ``FURTHER_SECTIONS`` that the file has, by name
        :raises ValueError: if they do not fit
        """

    def require_learner(self) -> None:
        """
        :raises ValueError: if it was released for playing only
        """
        if self.plays_only:
            raise ValueError(
                "the model was released for playing only, without critics and optimisers; to train, start a new run, with the "
                "command in the README.md beside the released file"
            )

    # ---- models

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save the model, as in SB3, but never half: the file appears when it is whole, and an older one stays until then.

        :param path: of the zip file (the ending is added), or an open file
        :param exclude: names of attributes to leave out
        :param include: names of attributes to keep that are left out by default
        :raises ValueError: names an attribute that cannot be saved, or a parameter that is not finite
        """
        target = with_suffix(path, ".zip") if isinstance(path, (str, pathlib.Path)) else path
        write_archive(target, "model", self.sections(set(exclude or ()), set(include or ())))

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfSaveable],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: Any = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfSaveable:
        """
        Load a model or a checkpoint, as in SB3. Nothing of the file is run.

        :param path: of the zip file, or an open file
        :param env: the world to go on in, whatever the constructor takes; ``None`` if only predictions are wanted
        :param device: where the model goes
        :param custom_objects: attributes to take instead of the file's, which are then not read
        :param print_system_info: print the versions with which the file was made, and those of here
        :param force_reset: reset the env before training goes on
        :param kwargs: settings that replace saved ones, such as ``opponents``
        :raises FileFormatError: if the file is damaged, crafted, or none of these
        :raises ValueError: if the env's agents are not those that the model was trained for
        """
        env = None if env is None else cls._wrap_env(maybe_make_env(env_named(env), 0), 0)
        with open_archive(existing(path), *MODEL_KINDS) as archive:
            if print_system_info:
                get_system_info()
                print("saved with:", archive.manifest.get("libraries"))
            with refusals(archive, "attributes"):
                own = without_retired(archive.read("attributes", without=tuple(custom_objects or ())))
                attributes = {**own, **(custom_objects or {})}
                if not attributes.keys() >= NEEDED:
                    raise ValueError("they are not those of a model")
                algorithm = attributes.pop("algorithm")
                if algorithm != cls.__name__:
                    archive.refuse(f"was saved by {algorithm}; load it with {algorithm}.load")
                check_attributes(attributes, cls)
            with refusals(archive, "parameters"):
                parameters = archive.read("parameters")
                networks = [saved for name, saved in parameters.items() if not name.endswith("optimizer")]
                n_weights = sum(tensor.numel() for saved in networks for tensor in saved.values())
            if env is not None and "normalization" in archive and unwrap_vec_normalize(env) is None:
                warnings.warn(f"{archive.name} was trained with normalised observations; wrap its env by load_normalization()")
            if env is not None:
                _check_env(env, attributes, archive)
                attributes["n_envs"] = env.num_envs
                if force_reset:
                    attributes["_last_obs"] = None
            if "policy_kwargs" in kwargs and kwargs["policy_kwargs"] != attributes["policy_kwargs"]:
                saved = attributes["policy_kwargs"]
                raise ValueError(
                    f"policy_kwargs are {saved} in {archive.name}; {kwargs['policy_kwargs']} do not fit its networks"
                )
            own_settings = not kwargs  # what is wrong with settings from outside is not the file's fault
            with refusals(archive, "attributes", own_settings), at_most(n_weights):
                model = cls(attributes["policy_class"], env, device=device, _init_setup_model=False)  # type: ignore[call-arg]
                vars(model).update(attributes)
                vars(model).update(kwargs)
                if isinstance(model.action_noise, VectorizedActionNoise):  # made by learn() for the env's number of worlds
                    model.action_noise = model.action_noise.base_noise
                model._setup_model()
                model.take_sections(further_sections(archive))
            with refusals(archive, "parameters"):
                OffPolicyAlgorithm.set_parameters(model, model.checked_parameters(parameters), device=device)
        return model

    # ---- parameters

    def set_parameters(
        self,
        load_path_or_dict: Any,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        Take over networks and optimisers, as in SB3.

        :param load_path_or_dict: a model file (path or open file), or what ``get_parameters`` gave
        :param exact_match: refuse a dict that lacks some
        :param device: where they go
        """
        if isinstance(load_path_or_dict, dict):
            super().set_parameters(load_path_or_dict, exact_match, device)
            return
        with open_archive(existing(load_path_or_dict), *MODEL_KINDS) as archive, refusals(archive, "parameters"):
            super().set_parameters(self.checked_parameters(archive.read("parameters")), exact_match, device)

    # ---- replay buffers

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer, with all that its kind of replay keeps: priorities, folds, teachers.

        :param path: of the zip file (the ending is added), or an open file
        """
        self.require_learner()
        target = with_suffix(path, ".zip") if isinstance(path, (str, pathlib.Path)) else path
        buffer = self.replay_buffer
        sections = {"replay_buffer": self.replay_buffer_state(), "transitions": packed(buffer.transitions())}
        write_archive(target, "replay buffer", sections)

    def replay_buffer_state(self) -> dict[str, Any]:
        """The replay buffer without its transitions."""
        return {"class": type(self.replay_buffer), **self.replay_buffer.state()}

    def load_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True) -> None:
        """
        Fill the replay buffer from a file of :meth:`save_replay_buffer`. With another ``buffer_size`` or another number of
        worlds the latest transitions are kept.

        :param path: of the zip file (the ending is added), or an open file
        :param truncate_last_traj: not used
        :raises ValueError: if the file is damaged, or of another buffer
        """
        self.require_learner()
        source = with_suffix(path, ".zip") if isinstance(path, (str, pathlib.Path)) else path
        with open_archive(source, "replay buffer") as archive, refusals(archive, "replay_buffer"):
            self.set_replay_buffer_state(archive.read("replay_buffer"), unpacked(archive.read("transitions")))

    def set_replay_buffer_state(self, state: dict[str, Any], transitions: dict[str, np.ndarray]) -> None:
        """
        :param state: as :meth:`replay_buffer_state` gave it
        :param transitions: of the buffer
        :raises ValueError: if they are of another buffer
        """
        state = dict(state)
        found = state.pop("class", None)
        if found is not type(self.replay_buffer):
            wanted = type(self.replay_buffer).__name__
            raise ValueError(
                f"not a replay buffer of this model: it is a {getattr(found, '__name__', found)}, wanted is a {wanted}"
            )
        self.replay_buffer.set_state(state, transitions)


def further_sections(archive: Archive) -> dict[str, Any]:
    """Those of ``FURTHER_SECTIONS`` that a file has, by name."""
    return {name: archive.read(name) for name in FURTHER_SECTIONS if name in archive}


def _check_env(env: VecEnv, attributes: dict[str, Any], archive: Archive) -> None:
    """
    :raises ValueError: if the env is not of the world that the model was made for
    """
    found = layout_of(env)
    if found != attributes["layout"]:
        theirs, ours = (f"{layout} and a state of {layout.state_size}" for layout in (attributes["layout"], found))
        raise ValueError(f"the model in {archive.name} is for another world: {theirs}; the env has {ours}")
    for name in ("observation_space", "action_space"):
        if getattr(env, name) != attributes[name]:
            raise ValueError(
                f"the model in {archive.name} is for another world: its {name} is {attributes[name]}; "
                f"the env has {getattr(env, name)}"
            )


class Refusing(Protocol):
    """A file that can say what is wrong with it."""

    def refuse(self, what: str) -> NoReturn: ...


@contextmanager
def refusals(archive: Refusing, section: str, active: bool = True) -> Iterator[None]:
    """
    Whatever is wrong with the values of a section is told with the names of file and section.

    :param archive: the file
    :param section: that is being taken over
    :param active: whether to do so
    """
    try:
        yield
    except FileFormatError:
        raise
    except WRONG_VALUES as error:
        if not active:
            raise
        what = f"{type(error).__name__}: {error}" if not isinstance(error, ValueError) else str(error)
        archive.refuse(f"does not fit: {section}: {what}")
