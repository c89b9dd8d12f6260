"""Networks and optimisers from a file: every name, shape and number is checked before anything is taken over."""

from __future__ import annotations

from typing import Any

import torch as th
from torch import nn

from sb3_kfcv.common.checks import require_finite


def check_network(network: nn.Module, saved: dict[str, th.Tensor], place: str) -> None:
    """
    :param network: that is to take the parameters
    :param saved: as ``state_dict`` gave them
    :param place: their name, for messages
    :raises ValueError: unless they have its names, shapes and types, and are finite
    """
    own = network.state_dict()
    if set(saved) != set(own):
        raise ValueError(f"{place} has other parameters than the network: {', '.join(sorted(set(saved) ^ set(own)))}")
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
    for i, state in saved["state"].items():
        for name, moment in state.items():
            like = parameters[i] if th.is_tensor(moment) and moment.dim() else th.zeros(())
            _check_tensor(moment, like, f"{place}/{i}/{name}")
    return {"state": saved["state"], "param_groups": optimizer.state_dict()["param_groups"]}


def _check_tensor(tensor: Any, like: th.Tensor, place: str) -> None:
    if not isinstance(tensor, th.Tensor) or tensor.shape != like.shape or tensor.dtype != like.dtype:
        found = f"{tuple(tensor.shape)} of {tensor.dtype}" if isinstance(tensor, th.Tensor) else repr(tensor)
        raise ValueError(f"{place} is {found}; the model has {tuple(like.shape)} of {like.dtype}")
    require_finite(place, tensor.detach().cpu().numpy())
