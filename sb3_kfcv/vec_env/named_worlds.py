"""PettingZoo's worlds by their names, such as ``mpe2/simple_tag_v3``: which there are, and what makes them."""

from __future__ import annotations

import inspect
import pkgutil
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import pettingzoo

from sb3_kfcv.common.naming import unknown_name

NAMED = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)


@dataclass
class NamedWorld:
    """
    A world that has a name.

    :param name: its name
    :param create: makes a PettingZoo env of the world's settings, a parallel one where there is one
    :param constructor: its parameters are the settings; None where they have no names
    :param requirement: what to install for it; None where that is not known
    """

    name: str
    create: Callable[..., Any]
    constructor: Callable[..., Any] | None = None
    requirement: str | None = None

    def make(self, **settings: Any) -> Any:
        """
        :param settings: of the world
        :raises ValueError: if there is no such setting, with the nearest one, or if the world refuses a value
        :raises gymnasium.error.DependencyNotInstalled: if a package is missing, with the command that installs it
        """
        if self.constructor is not None:
            for setting in settings:
                if setting not in (known := inspect.signature(self.constructor).parameters):
                    raise ValueError(unknown_name(f"setting of {self.name}", setting, known))
        try:
            return self.create(**settings)
        except (TypeError, AssertionError) as error:  # PettingZoo's worlds assert what they are given
            raise ValueError(f"{self.name} cannot be made with {settings}: {error}") from error
        except ImportError as error:
            raise missing(self.name, error, self.requirement) from error


def missing(name: str, error: ImportError, requirement: str | None) -> gym.error.Error:
    """
    What to raise where a package is missing.

    :param name: of what needs it
    :param error: of its import
    :param requirement: what to install; None where that is not known
    """
    command = f': pip install "{requirement}"' if requirement else ""
    return gym.error.DependencyNotInstalled(f"{name} needs {error.name}, which is not installed{command}")


def world_names() -> list[str]:
    """All names: the modules of mpe2, if it is installed, and the ids of PettingZoo's registry."""
    spec = find_spec("mpe2")
    modules = pkgutil.iter_modules(spec.submodule_search_locations) if spec is not None else []
    return [*(f"mpe2/{module.name}" for module in modules if re.search(r"_v\d+$", module.name)), *_registered()]


def find_world(name: str) -> NamedWorld | None:
    """
    A world of PettingZoo. A name may come from a file of settings, so it imports nothing by itself: it is looked up among the
    modules of mpe2 and in PettingZoo's registry, which holds PettingZoo's worlds and those that the program has registered.

    :param name: ``mpe2/<module>`` such as ``"mpe2/simple_tag_v3"``, or an id of PettingZoo's registry such as
        ``"sisl/pursuit_v5"``; the version may be written ``_v5`` or ``-v5``
    :return: None if no world has this name
    :raises gymnasium.error.DependencyNotInstalled: if mpe2 is missing, with the command that installs it
    """
    if name.startswith("mpe2/"):
        module = _mpe2_modules(name).get(_canonical(name).removeprefix("mpe2/"))
        return None if module is None else NamedWorld(name, module.parallel_env, _with_named_parameters(module.raw_env))
    spec = {_canonical(env_id): spec for env_id, spec in _registered().items()}.get(_canonical(name))
    if spec is None:
        return None
    if callable(spec.entry_point):
        return NamedWorld(name, spec.make, _with_named_parameters(spec.entry_point))
    own = spec.entry_point.startswith("pettingzoo.")
    return NamedWorld(name, spec.make, requirement=f"pettingzoo[{spec.namespace}]" if own else None)


def _mpe2_modules(name: str) -> dict[str, Any]:
    try:
        from mpe2 import all_modules
    except ImportError as error:
        raise missing(name, error, "mpe2") from error
    return {module: value for module, value in vars(all_modules).items() if hasattr(value, "parallel_env")}


def _canonical(name: str) -> str:
    return re.sub(r"-v(?=\d+$)", "_v", name)


def _registered() -> dict[str, Any]:
    """PettingZoo's registry, id → spec, parallel envs before others; it has one since 1.27."""
    return {**getattr(pettingzoo, "aec_registry", {}), **getattr(pettingzoo, "parallel_registry", {})}


def _with_named_parameters(function: Callable[..., Any]) -> Callable[..., Any] | None:
    kinds = [parameter.kind for parameter in inspect.signature(function).parameters.values()]
    return function if all(kind in NAMED for kind in kinds) else None
