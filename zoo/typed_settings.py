"""Values from YAML and the command line, checked against the type hints of the code that will take them."""

from __future__ import annotations

import inspect
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.saving.values import classes_of


def settings_of(callable_: Callable[..., Any], without: Sequence[str] = ()) -> dict[str, Any]:
    """
    What a class or function takes by keyword: name → type hint.

    :param callable_: the class or function
    :param without: parameters that are not for the user to set
    """
    function = callable_.__init__ if isinstance(callable_, type) else callable_  # type: ignore[misc]
    hints = typing.get_type_hints(function)
    names = [name for name in inspect.signature(callable_).parameters if name not in without]
    return {name: hints.get(name, Any) for name in names}


def checked(kind: str, given: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """
    The settings, with numbers in the type that is asked for (YAML reads ``1e-3`` as text).

    :param kind: what they are, for the message, such as ``"hyperparameter"``
    :param given: name → value
    :param known: name → type hint
    :raises ValueError: for an unknown name, with the nearest one, and for a value of another type
    """
    result = {}
    for name, value in given.items():
        if name not in known:
            raise ValueError(unknown_name(kind, name, known))
        try:
            result[name] = convert(value, known[name])
        except TypeError:
            raise ValueError(f"{kind} {name} is {value!r}; it must be {describe(known[name])}") from None
    return result


def convert(value: Any, hint: Any) -> Any:
    """
    A value as its type hint asks for; it stays one that YAML can hold.

    :raises TypeError: if it is of another type
    """
    origin, arguments = typing.get_origin(hint) or hint, typing.get_args(hint)
    if hint is Any:
        return value
    if origin in (typing.Union, types.UnionType):
        return _convert_to_any_of(value, arguments)
    if origin in (int, float):
        return _number(value, origin)
    if origin in (bool, str) and isinstance(value, origin):
        return value
    if origin is types.NoneType and value is None:
        return None
    if origin is dict and isinstance(value, dict):
        return {convert(key, arguments[0]): convert(item, arguments[1]) for key, item in value.items()} if arguments else value
    if inspect.isclass(origin) and issubclass(origin, (Sequence, tuple)) and isinstance(value, (list, tuple)):
        return _sequence(value, origin, arguments)
    if origin is type and isinstance(value, str) and value in classes_of(arguments[0]):
        return value
    raise TypeError


def _convert_to_any_of(value: Any, hints: Sequence[Any]) -> Any:
    for hint in hints:
        try:
            return convert(value, hint)
        except TypeError:
            continue
    raise TypeError


def _number(value: Any, kind: type) -> int | float:
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise TypeError
    try:
        number = float(value)
    except ValueError:
        raise TypeError from None
    if not math.isfinite(number) or (kind is int and number != int(number)):
        raise TypeError
    return int(number) if kind is int else number


def _sequence(values: Sequence[Any], origin: type, hints: tuple[Any, ...]) -> list[Any]:
    if issubclass(origin, str):
        raise TypeError
    if origin is tuple and hints and hints[-1] is not Ellipsis:
        if len(values) != len(hints):
            raise TypeError
        return [convert(value, hint) for value, hint in zip(values, hints, strict=True)]
    return [convert(value, hints[0] if hints else Any) for value in values]


def describe(hint: Any) -> str:
    """A type hint in words, of what YAML can give."""
    origin, arguments = typing.get_origin(hint) or hint, typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        parts = dict.fromkeys(describe(argument) for argument in arguments)
        return " or ".join(part for part in parts if part)
    plain = {
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        str: "text",
        types.NoneType: "null",
        dict: "a map",
    }
    if origin in plain:
        return plain[origin]
    if origin is type:
        return f"one of {', '.join(classes_of(arguments[0]))}"
    if inspect.isclass(origin) and issubclass(origin, (Sequence, tuple)):
        inner = dict.fromkeys(_plural(describe(argument)) for argument in arguments if argument is not Ellipsis)
        return f"a list of {' and '.join(inner)}" if inner else "a list"
    return ""


def _plural(words: str) -> str:
    noun = words.removeprefix("a ")
    return noun.replace("list of", "lists of") if noun.startswith("list of") else f"{noun}s"


def resolve_classes(settings: Mapping[str, Any], hints: Mapping[str, Any]) -> dict[str, Any]:
    """
    The settings with classes in place of their names.

    :param settings: as :func:`checked` gave them
    :param hints: name → type hint
    """
    result = dict(settings)
    for name, value in settings.items():
        if typing.get_origin(hints[name]) is type:
            result[name] = classes_of(typing.get_args(hints[name])[0])[value]
    return result
