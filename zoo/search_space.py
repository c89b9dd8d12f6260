"""The settings among which a search chooses: read from YAML, checked before anything is trained."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import yaml

from sb3_kfcv.common.naming import unknown_name
from zoo.hyperparams import ALGORITHMS, HYPERPARAMS
from zoo.run_folder import read_map

FOR_ALL = "all"
RANGE_KEYS = ("low", "high", "log")


@dataclass(frozen=True)
class Range:
    """
    From ``low`` to ``high``, both included.

    :param low: whole numbers give whole numbers
    :param high: above it
    :param log: whether to draw evenly over the orders of magnitude
    """

    low: float
    high: float
    log: bool = False

    @property
    def whole(self) -> bool:
        """Whether it is of whole numbers."""
        return isinstance(self.low, int) and isinstance(self.high, int)


@dataclass(frozen=True)
class SearchSpace:
    """
    Setting, a dot in its name going into a nested map → its choices, or its range.

    :param settings: of each
    """

    settings: dict[str, list[Any] | Range]

    @classmethod
    def read(cls, algo: str, path: str | Path | None = None) -> SearchSpace:
        """
        Those of an algorithm in a YAML file.

        :param algo: name of the algorithm
        :param path: of the file; by default ``search.yml`` beside the presets
        :raises ValueError: for what is no search space
        """
        path = Path(path) if path else HYPERPARAMS / "search.yml"
        content = read_map(path)
        for name, settings in content.items():
            if name not in (FOR_ALL, *ALGORITHMS):
                raise ValueError(f"{path}: {unknown_name('algorithm', name, (FOR_ALL, *ALGORITHMS))}")
            if not isinstance(settings, dict):
                raise ValueError(f"{path}: {name} is {settings!r}; it must be a map of settings")
        given = {**content.get(FOR_ALL, {}), **content.get(algo, {})}
        if "n_timesteps" in given:
            raise ValueError(f"{path}: n_timesteps is no setting to search: more is always better")
        if not given:
            raise ValueError(f"{path} has no settings for {algo}")
        return cls({name: _domain(name, domain, path) for name, domain in given.items()})

    def to_dict(self) -> dict[str, Any]:
        """As YAML holds it."""
        return {name: vars(own) if isinstance(own, Range) else own for name, own in self.settings.items()}

    def ends(self) -> dict[str, list[Any]]:
        """Of each setting the choices, or the ends of the range."""
        return {name: [own.low, own.high] if isinstance(own, Range) else own for name, own in self.settings.items()}

    def distributions(self) -> dict[str, Any]:
        """As Optuna takes them; choices that are no plain values as text, see :func:`decoded`."""
        from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

        found: dict[str, Any] = {}
        for name, domain in self.settings.items():
            if not isinstance(domain, Range):
                found[name] = CategoricalDistribution([encoded(choice) for choice in domain])
            elif domain.whole:
                found[name] = IntDistribution(int(domain.low), int(domain.high), log=domain.log)
            else:
                found[name] = FloatDistribution(domain.low, domain.high, log=domain.log)
        return found


def _domain(name: str, given: Any, path: Path) -> list[Any] | Range:
    if isinstance(given, list) and given:
        return given
    if not isinstance(given, dict):
        raise ValueError(
            f"{path}: {name} is {given!r}; it must be a list of choices, or a range such as {{low: 0.1, high: 0.9}}"
        )
    for key in given:
        if key not in RANGE_KEYS:
            raise ValueError(f"{path}: {unknown_name(f'key of {name}', key, RANGE_KEYS)}")
    low, high, log = given.get("low"), given.get("high"), given.get("log", False)
    if not _is_number(low) or not _is_number(high) or not low < high or not isinstance(log, bool):
        raise ValueError(f"{path}: the range of {name} needs numbers low < high, got {given}")
    if log and low <= 0:
        raise ValueError(f"{path}: the range of {name} is over orders of magnitude: low must be above 0")
    return Range(low, high, log)


def _is_number(value: Any) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def encoded(choice: Any) -> Any:
    """A choice as Optuna can store it: plain values as they are, others as YAML text."""
    if choice is None or isinstance(choice, bool | int | float | str):
        return choice
    return yaml.safe_dump(choice, default_flow_style=True).strip()


def decoded(params: Mapping[str, Any], space: SearchSpace) -> dict[str, Any]:
    """
    Inverse of :func:`encoded`, of a whole trial.

    :param params: setting → value, as Optuna gives them
    :param space: from which they were drawn
    """
    result = {}
    for name, value in params.items():
        domain = space.settings[name]
        choices: Sequence[Any] = () if isinstance(domain, Range) else domain
        result[name] = next((choice for choice in choices if encoded(choice) == value), value)
    return result
