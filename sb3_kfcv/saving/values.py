"""
Values as JSON and plain arrays, and back: the registry of everything that a file may name.

A file holds data only. Classes and functions are written by their registered name, objects by the fields of a registered
kind; a value that is neither is refused with its place, never dropped.
"""

from __future__ import annotations

import math
import pathlib
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule
from torch import nn

from sb3_kfcv.common.checks import require_between, require_count, require_finite
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.naming import unknown_name

# The key that marks a JSON object as something else than a plain map.
TAG = "$"

# Element types that arrays in a file may have: numbers and booleans, of at most 8 bytes.
ARRAY_KINDS = "biuf"

# Containers within containers: what is written can be read again, within Python's limit of calls.
DEEPEST = 64

# Bits of the largest whole number: Python reads no longer ones from text.
LONGEST_INT = 14_000

# Classes and functions by the name under which files and YAML know them.
NAMES: dict[str, Any] = {
    **{"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU, "leaky_relu": nn.LeakyReLU, "gelu": nn.GELU, "silu": nn.SiLU},
    **{"adam": th.optim.Adam, "adamw": th.optim.AdamW, "rmsprop": th.optim.RMSprop, "sgd": th.optim.SGD},
    **{"float32": np.float32, "float64": np.float64},
}


class Kind(NamedTuple):
    """How objects of a class are written: as fields, and made of them again."""

    type: type
    fields: Callable[[Any], dict[str, Any]]
    make: Callable[..., Any]


KINDS: dict[str, Kind] = {}


def register(name: str, thing: Any) -> Any:
    """
    Give a class or function a name, so that a model that was built with it can be saved and loaded: an own policy class,
    replay buffer class, activation, optimiser or learning-rate schedule. The program that loads the file must register it,
    too; the file holds no code.

    :param name: under which files know it
    :param thing: the class or function
    :return: the thing, so that ``register`` can be used in an expression
    :raises ValueError: if another thing has the name
    """
    if not isinstance(name, str) or not name or not callable(thing):
        raise ValueError(f"register takes a name and a class or function, got {name!r} and {thing!r}")
    if NAMES.setdefault(name, thing) is not thing:
        raise ValueError(f'the name "{name}" is taken by {NAMES[name]}')
    return thing


def classes_of(base: type) -> dict[str, type]:
    """The registered classes below a base, by name."""
    return {name: thing for name, thing in NAMES.items() if isinstance(thing, type) and issubclass(thing, base)}


def register_kind(name: str, type_: type, fields: Callable[[Any], dict[str, Any]], make: Callable[..., Any]) -> None:
    """
    Say how objects of a class (exactly that class) are written.

    :param name: under which files know it
    :param type_: the class
    :param fields: object → its fields, themselves writable values
    :param make: makes an object of the fields; it must check them
    """
    KINDS[name] = Kind(type_, fields, make)


class UnwritableError(ValueError):
    """A value that no file can hold; the message names it."""


def encode(value: Any, place: str, store: Callable[[str, np.ndarray], str]) -> Any:  # noqa: C901 (a case per kind of value)
    """
    A value as JSON.

    :param value: numbers, text, arrays, tensors, registered things, and containers of them
    :param place: its name, for messages and for naming arrays
    :param store: takes an array and gives back the name by which :func:`decode` will ask for it
    :raises UnwritableError: for anything else
    """

    def inner(item: Any, name: object) -> Any:
        return encode(item, f"{place}/{name}", store)

    if value is None or type(value) in (bool, str) or (type(value) is int and value.bit_length() < LONGEST_INT):
        return value
    if place.count("/") > DEEPEST:
        raise UnwritableError(f"{_inside(place)[:100]}… cannot be saved: containers within containers, too deeply")
    if type(value) is float:
        return value if math.isfinite(value) else {TAG: "float", "value": str(value)}
    if isinstance(value, pathlib.PurePath):
        return str(value)
    if type(value) in (dict, OrderedDict):
        if all(type(key) is str for key in value) and TAG not in value:
            return {key: inner(item, key) for key, item in value.items()}
        return {TAG: "map", "items": [[inner(key, "key"), inner(item, key)] for key, item in value.items()]}
    if type(value) is list:
        return [inner(item, i) for i, item in enumerate(value)]
    if type(value) is tuple:
        return {TAG: "tuple", "items": [inner(item, i) for i, item in enumerate(value)]}
    if type(value) is deque:
        return {TAG: "deque", "items": [inner(item, i) for i, item in enumerate(value)], "maxlen": value.maxlen}
    if isinstance(value, np.generic) and _is_plain(value.dtype):
        return {TAG: "scalar", "dtype": value.dtype.str, "value": inner(value.item(), "value")}
    if type(value) in (np.ndarray, np.memmap) and _is_plain(value.dtype):
        return {TAG: "array", "name": store(place, value)}
    if isinstance(value, th.Tensor) and value.dtype in _NUMPY_TENSORS and value.layout is th.strided:
        return {TAG: "tensor", "name": store(place, value.detach().cpu().numpy())}
    for name, thing in NAMES.items():
        if value is thing:
            return {TAG: "name", "of": name}
    for name, kind in KINDS.items():
        if type(value) is kind.type:
            return {TAG: name, **{key: inner(item, key) for key, item in kind.fields(value).items()}}
    what = getattr(value, "__qualname__", None) or f"an object of {type(value).__qualname__}"
    can_be_named = isinstance(value, type) or callable(value)
    name = getattr(value, "__name__", "").strip("<>") or "my_own"
    hint = f'; give it a name of your own: sb3_kfcv.register("{name}", ...)' if can_be_named else ""
    raise UnwritableError(f"{_inside(place)} cannot be saved: it is {what}{hint}")


def _inside(place: str) -> str:
    """A place without the name of the section."""
    return place.rpartition("attributes/")[2]


def _is_plain(dtype: np.dtype) -> bool:
    return dtype.kind in ARRAY_KINDS and dtype.itemsize <= 8


def decode(plain: Any, place: str, fetch: Callable[[str], np.ndarray]) -> Any:
    """
    Inverse of :func:`encode`. Runs nothing but the registered makers on checked fields.

    :param plain: what :func:`encode` gave
    :param place: its name, for messages
    :param fetch: gives the array of a name
    :raises ValueError: for anything that :func:`encode` does not write
    """

    def inner(item: Any, name: object) -> Any:
        return decode(item, f"{place}/{name}", fetch)

    if type(plain) not in (list, dict):
        return plain
    if place.count("/") > DEEPEST:
        raise ValueError("containers within containers, too deeply")
    if type(plain) is list:
        return [inner(item, i) for i, item in enumerate(plain)]
    if TAG not in plain:
        return {key: inner(item, key) for key, item in plain.items()}
    try:
        fields = dict(plain)
        tag = fields.pop(TAG)
        if tag in BUILT_IN:
            return BUILT_IN[tag](inner, fetch, **fields)
        if tag in KINDS:
            return KINDS[tag].make(**{key: inner(item, key) for key, item in fields.items()})
        raise ValueError(unknown_name("kind of value", tag, [*BUILT_IN, *KINDS]))
    except (TypeError, KeyError, AttributeError, AssertionError, ArithmeticError, IndexError) as error:
        raise ValueError(f"{place} is no value of the kind that it claims: {error}") from None


def _decode_map(inner: Callable[..., Any], _: Any, items: list[list[Any]]) -> dict[Any, Any]:
    return {inner(key, "key"): inner(item, key) for key, item in items}


def _decode_number(inner: Callable[..., Any], _: Any, dtype: str, value: Any) -> np.generic:
    kind, number = np.dtype(str(dtype)), inner(value, "value")
    if not _is_plain(kind) or type(number) not in (bool, int, float):
        raise ValueError(f"{number!r} is no number of type {dtype!r}")
    return kind.type(number)


def _decode_deque(inner: Callable[..., Any], _: Any, items: list[Any], maxlen: int | None) -> deque[Any]:
    return deque([inner(item, i) for i, item in enumerate(items)], maxlen=maxlen)


def _decode_float(_: Any, __: Any, value: str) -> float:
    if value not in ("inf", "-inf", "nan"):
        raise ValueError(f"{value!r} is no float")
    return float(value)


def _decode_name(_: Any, __: Any, of: str) -> Any:
    if of not in NAMES:
        hint = 'a class or function of one\'s own must be registered before loading: sb3_kfcv.register("name", it)'
        raise ValueError(f"{unknown_name('name', of, NAMES)} ({hint})")
    return NAMES[of]


BUILT_IN: dict[str, Callable[..., Any]] = {
    "map": _decode_map,
    "tuple": lambda inner, _, items: tuple(inner(item, i) for i, item in enumerate(items)),
    "deque": _decode_deque,
    "float": _decode_float,
    "scalar": _decode_number,
    "array": lambda _, fetch, name: fetch(name),
    "tensor": lambda _, fetch, name: th.from_numpy(fetch(name)),
    "name": _decode_name,
}

_NUMPY_TENSORS = (th.bool, th.float32, th.float64, th.float16, th.uint8, th.int8, th.int16, th.int32, th.int64)


def _make_box(low: np.ndarray, high: np.ndarray) -> spaces.Box:
    if low.dtype != high.dtype or low.shape != high.shape or not (low <= high).all():  # NaN is not <= either
        raise ValueError("the bounds of a Box must be as many, of one type, and the lower below the higher")
    return spaces.Box(low, high, dtype=low.dtype.type)


def _make_multi_discrete(nvec: np.ndarray) -> spaces.MultiDiscrete:
    if nvec.dtype.kind != "i":
        raise ValueError(f"numbers of choices are whole, not {nvec.dtype}")
    return spaces.MultiDiscrete(nvec, dtype=nvec.dtype.type)


def _make_layout(**fields: Any) -> AgentLayout:
    layout = AgentLayout.from_dict(fields)
    agents, groups = layout.agents, layout.groups
    columns = (agents, groups, layout.obs_sizes, layout.action_sizes)
    if any(type(column) is not tuple or len(column) != len(agents) for column in columns) or not agents:
        raise ValueError("a layout needs a name, a group, and sizes for each agent")
    if not all(type(name) is str for name in (*agents, *groups)) or len(set(agents)) < len(agents):
        raise ValueError(f"names of agents must be texts, each another: {agents}, {groups}")
    for size in (*layout.obs_sizes, *layout.action_sizes):
        require_count("a size in the layout", size, least=0)
    require_count("state_size", layout.state_size, least=0)
    if type(layout.discrete) is not bool:
        raise ValueError(f"discrete is yes or no, not {layout.discrete!r}")
    return layout


def _make_train_freq(frequency: int, unit: str) -> TrainFreq:
    require_count("frequency", frequency)
    return TrainFreq(frequency, TrainFrequencyUnit(unit))


def _make_constant(val: float) -> ConstantSchedule:
    _require_numbers(val=val)
    return ConstantSchedule(val)


def _make_linear(start: float, end: float, end_fraction: float) -> LinearSchedule:
    _require_numbers(start=start, end=end)
    require_between("end_fraction", end_fraction, 0, 1, above=True)
    return LinearSchedule(start, end, end_fraction)


def _make_noise(mean: np.ndarray, sigma: np.ndarray, dtype: type) -> NormalActionNoise:
    _require_numbers(mean=mean, sigma=sigma)
    if not (np.asarray(sigma) >= 0).all() or np.dtype(dtype).kind != "f":
        raise ValueError(f"no noise has a spread of {sigma} and the type {dtype}")
    return NormalActionNoise(mean, sigma, dtype)


def _make_ornstein_uhlenbeck(noise_prev: np.ndarray, mean: np.ndarray, **fields: Any) -> OrnsteinUhlenbeckActionNoise:
    numbers = {name: value for name, value in fields.items() if name != "dtype" and value is not None}
    _require_numbers(mean=mean, noise_prev=noise_prev, **numbers)
    noise = OrnsteinUhlenbeckActionNoise(mean, **fields)
    if np.shape(noise_prev) != np.shape(noise.noise_prev) or np.dtype(noise._dtype).kind != "f":
        raise ValueError(f"a noise of {np.shape(noise.noise_prev)} numbers cannot stand at {np.shape(noise_prev)}")
    noise.noise_prev = noise_prev
    return noise


def _make_vectorized(base_noise: Any, noises: list[Any]) -> VectorizedActionNoise:
    made = VectorizedActionNoise(base_noise, 1)  # would copy it as often as it is told
    if not noises or any(type(noise) is not type(base_noise) for noise in noises):
        raise ValueError("the noises of the worlds must be of one kind")
    made.n_envs, made._noises = len(noises), list(noises)  # the setter would reset them
    return made


def _require_numbers(**values: Any) -> None:
    """
    :raises ValueError: unless they are finite numbers, or arrays of such
    """
    for name, value in values.items():
        if type(value) not in (int, float, np.ndarray) and not isinstance(value, np.generic):
            raise ValueError(f"{name} must be numbers, got {value!r}")
        require_finite(name, np.asarray(value, dtype=float))


register_kind("Box", spaces.Box, lambda box: {"low": box.low, "high": box.high}, _make_box)
register_kind(
    "MultiDiscrete",
    spaces.MultiDiscrete,
    lambda space: {"nvec": space.nvec},
    _make_multi_discrete,
)
register_kind("AgentLayout", AgentLayout, AgentLayout.to_dict, _make_layout)
register_kind(
    "TrainFreq",
    TrainFreq,
    lambda f: {"frequency": f.frequency, "unit": f.unit.value},
    _make_train_freq,
)
register_kind("ConstantSchedule", ConstantSchedule, vars, _make_constant)
register_kind("LinearSchedule", LinearSchedule, vars, _make_linear)
register_kind(
    "NormalActionNoise",
    NormalActionNoise,
    lambda noise: {"mean": noise._mu, "sigma": noise._sigma, "dtype": noise._dtype},
    _make_noise,
)
register_kind(
    "OrnsteinUhlenbeckActionNoise",
    OrnsteinUhlenbeckActionNoise,
    lambda noise: {
        **{"mean": noise._mu, "sigma": noise._sigma, "theta": noise._theta, "dt": noise._dt, "dtype": noise._dtype},
        **{"initial_noise": noise.initial_noise, "noise_prev": noise.noise_prev},
    },
    _make_ornstein_uhlenbeck,
)
register_kind(
    "VectorizedActionNoise",
    VectorizedActionNoise,
    lambda noise: {"base_noise": noise.base_noise, "noises": noise.noises},
    _make_vectorized,
)


def check_writable(settings: Mapping[str, Any]) -> None:
    """
    Refuse settings that could not be saved, before time is spent on training with them.

    :param settings: name → value
    :raises UnwritableError: names the setting
    """
    for name, value in settings.items():
        encode(value, name, lambda place, array: place)
