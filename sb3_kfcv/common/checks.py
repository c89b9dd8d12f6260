"""Settings are checked before time is spent: one sentence that names the setting and what it may be."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from numbers import Integral, Real
from typing import Any

from sb3_kfcv.common.naming import unknown_name


def require_count(name: str, value: object, least: int = 1) -> None:
    """
    :param name: of the setting
    :param value: must be a whole number of at least ``least``
    :param least: smallest value allowed
    :raises ValueError: if it is not
    """
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")


def require_between(name: str, value: float, low: float, high: float = float("inf"), above: bool = False) -> None:
    """
    :param name: of the setting
    :param value: must lie in [low, high]
    :param low: smallest value allowed
    :param high: largest value allowed
    :param above: whether ``low`` itself is not allowed
    :raises ValueError: if it does not
    """
    if not isinstance(value, Real) or isinstance(value, bool):
        raise ValueError(f"{name} must be a number, got {value!r}")
    if not low <= value <= high or (above and value == low):
        bounds = f"{'above' if above else 'at least'} {low:g}" + ("" if high == float("inf") else f" and at most {high:g}")
        raise ValueError(f"{name} must be {bounds}, got {value!r}")


def require_parameters(name: str, given: Iterable[str], function: Callable[..., Any]) -> None:
    """
    :param name: of the setting that holds arguments by name
    :param given: the names given
    :param function: whose arguments they are
    :raises ValueError: for a name that the function does not have, with the nearest one
    """
    known = set(inspect.signature(function).parameters)
    for argument in given:
        if argument not in known:
            raise ValueError(unknown_name(f"setting in {name}", argument, known))
