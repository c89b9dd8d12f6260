"""Networks and optimisers from a file: every name, shape and number is checked before anything is taken over."""

from __future__ import annotations

from typing import Any

import torch as th
from torch import nn

from sb3_kfcv.common.checks import require_finite

# Moments of squares, and counts.
NOT_NEGATIVE = ("step", "exp_avg_sq", "max_exp_avg_sq", "square_avg")


def check_network(network: nn.Module, saved: dict[str, th.Tensor], place: str) -> None:
    """
    :param network: that is to take the parameters
    :param saved: as ``state_dict`` gave them
    :param place: their name, for messages
    :raises ValueError: unless they have its names, shapes and types, and are finite
    """
    own = network.state_dict()
    if set(saved) != set(own):
        odd = ", ".join(sorted(map(str, set(saved) ^ set(own))))
        raise ValueError(f"{place} has other parameters than the network: {odd}")
    for name, tensor in saved.items():
        _check_tensor(tensor, own[name], f"{place}/{name}")


def check_optimizer(optimizer: th.optim.Optimizer, saved: dict[str, Any], place: str) -> dict[str, Any]:
    """
    :param optimizer: that is to take the moments
    :param saved: as ``state_dict`` gave it
    :param place: its name, for messages
    :return: the moments with the optimiser's own settings, for ``load_state_dict``
    :raises ValueError: unless they are moments of its parameters, finite
    """
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    if set(saved) != {"state", "param_groups"} or not set(saved["state"]) <= set(range(len(parameters))):
        raise ValueError(f"{place} is not of an optimiser of {len(parameters)} parameters")
    expected = _kept_by(optimizer)
    for i, state in saved["state"].items():
        if set(state) != set(expected):
            raise ValueError(f"{place}/{i} has {', '.join(map(str, state))}; wanted are {', '.join(expected)}")
        for name, moment in state.items():
            like = expected[name]
            if like is None and moment is None:
                continue
            _check_tensor(moment, parameters[i] if th.is_tensor(like) and like.dim() else th.zeros(()), f"{place}/{i}/{name}")
            if name in NOT_NEGATIVE and (moment < 0).any():
                raise ValueError(f"{place}/{i}/{name} must not be negative")
    return {"state": saved["state"], "param_groups": optimizer.state_dict()["param_groups"]}


def _kept_by(optimizer: th.optim.Optimizer) -> dict[str, th.Tensor | None]:
    """What an optimiser keeps of each parameter, shown by a step of its like with two numbers."""
    settings = optimizer.param_groups[0]
    parameter = settings["params"][0].new_zeros(2)
    parameter.grad = parameter.clone()
    like: Any = type(optimizer)([{**settings, "params": [parameter]}])  # type: ignore[call-arg]
    like.step()
    return like.state[parameter]


def _check_tensor(tensor: Any, like: th.Tensor, place: str) -> None:
    if not isinstance(tensor, th.Tensor) or tensor.shape != like.shape or tensor.dtype != like.dtype:
        found = f"{tuple(tensor.shape)} of {tensor.dtype}" if isinstance(tensor, th.Tensor) else repr(tensor)
        raise ValueError(f"{place} is {found}; the model has {tuple(like.shape)} of {like.dtype}")
    require_finite(place, tensor.detach().cpu().numpy())
