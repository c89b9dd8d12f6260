"""Settings are checked before time is spent: one sentence that names the setting and what it may be."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping
from numbers import Integral, Real
from typing import Any

import numpy as np

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


class NonFiniteError(ValueError):
    """A number that ought to be finite is infinite or NaN; the message names it."""


def require_finite(name: str, values: np.ndarray) -> None:
    """
    :param name: of the values
    :param values: must be neither infinite nor NaN
    :raises NonFiniteError: if one is
    """
    if values.dtype.kind == "f" and not (np.isfinite(values.min(initial=0)) and np.isfinite(values.max(initial=0))):
        raise NonFiniteError(f"{name} must be finite, and holds {values[~np.isfinite(values)][0]}")


def require_finite_columns(quantity: str, rows: np.ndarray, columns: Mapping[str, slice]) -> None:
    """
    The quick check of what passes at every step.

    :param quantity: what the numbers are, such as ``"observation"``
    :param rows: (…, columns)
    :param columns: whose they are: name → where they stand
    :raises NonFiniteError: names the owner and the quantity if a number is infinite or NaN
    """
    with np.errstate(over="ignore", invalid="ignore"):
        if math.isfinite(rows.sum()):  # a sum may also overflow: look closer
            return
    for name, where in columns.items():
        require_finite(f"the {quantity} of {name}", rows[..., where])


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
