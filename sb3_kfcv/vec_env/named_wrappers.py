"""SuperSuit's pre-processing wrappers by their names, as ``env_wrapper:`` of a YAML file gives them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.vec_env.named_worlds import missing

# What it has besides: vec envs, and wrappers that take functions.
OTHERS = re.compile(r"vec_env|lambda")
HIDES_DEATHS = re.compile(r"black_death_v\d+$")

NamedWrapper = dict[str, dict[str, Any]]


def listed_wrappers(given: Any) -> list[NamedWrapper]:
    """
    The wrappers of an ``env_wrapper:`` in one form.

    :param given: a name, a map name → arguments, or a list of these; None for none
    :return: maps of one name each, in the order in which they are put around the env
    :raises ValueError: for anything else
    """
    if given is None:
        return []
    if isinstance(given, str):
        return [{given: {}}]
    if isinstance(given, Mapping):
        for name, arguments in given.items():
            if not isinstance(name, str) or not (arguments is None or isinstance(arguments, Mapping)):
                raise ValueError(f"env_wrapper: {name} has the arguments {arguments!r}; give a map, such as stack_size: 3")
        return [{name: dict(arguments or {})} for name, arguments in given.items()]
    if isinstance(given, Sequence):
        return [wrapper for item in given for wrapper in listed_wrappers(item)]
    raise ValueError(f"env_wrapper is {given!r}; it must be a name such as supersuit.frame_stack_v2, or a list of names")


def find_wrappers(listed: Sequence[NamedWrapper]) -> list[Callable[[Any], Any]]:
    """
    The functions that the names stand for.

    :param listed: as :func:`listed_wrappers` gives them
    :return: each takes a parallel env and gives one
    :raises ValueError: for a name or an argument that there is not, with the nearest one
    :raises gymnasium.error.DependencyNotInstalled: if SuperSuit is missing, with the command that installs it
    """
    return [partial(_find(name, arguments), **arguments) for wrapper in listed for name, arguments in wrapper.items()]


def _find(name: str, arguments: Mapping[str, Any]) -> Callable[..., Any]:
    package, _, attribute = name.partition(".")
    if package != "supersuit":  # a file names functions that are run: only those of this package
        raise ValueError(f'env_wrapper "{name}" is no wrapper of SuperSuit, such as supersuit.frame_stack_v2')
    try:
        import supersuit
    except ImportError as error:
        raise missing(f"env_wrapper {name}", error, "supersuit") from error
    if HIDES_DEATHS.match(attribute):
        raise ValueError(
            f"env_wrapper {name} hides deaths and ends from learning; leave it out: whoever is gone has a row of zeros here"
        )
    known = {f"supersuit.{other}" for other in vars(supersuit) if re.search(r"_v\d+$", other) and not OTHERS.search(other)}
    if name not in known:
        raise ValueError(unknown_name("env_wrapper", name, known))
    function = getattr(supersuit, attribute)
    parameters = list(inspect.signature(function).parameters)[1:]  # without the env
    for argument in arguments:
        if argument not in parameters:
            raise ValueError(unknown_name(f"argument of env_wrapper {name}", argument, parameters))
    return function
