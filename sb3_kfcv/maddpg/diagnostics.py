"""What the learner shows of itself, at no cost to the updates: tensors are kept as they fall and read when logged."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

import torch as th

from sb3_kfcv.common.layout import AgentLayout

if TYPE_CHECKING:
    from sb3_kfcv.maddpg.policies import CentralCritics, StackedActors

# Logged values are means over this many of the latest updates.
WINDOW = 100

# A continuous action beyond this share of its range counts as saturated.
SATURATED = 0.95


class Diagnostics:
    """
    The latest losses, Q-values and actions of a MADDPG learner.

    :param layout: who sits where
    :param agents: the learning agents
    """

    def __init__(self, layout: AgentLayout, agents: list[int]) -> None:
        self._continuous = not layout.discrete
        groups = [layout.groups[i] for i in agents]
        self._positions = {group: [p for p, g in enumerate(groups) if g == group] for group in dict.fromkeys(groups)}
        self._critic_losses: deque[th.Tensor] = deque(maxlen=WINDOW)  # each (critics, agents), or their mean (agents,)
        self._targets: deque[th.Tensor] = deque(maxlen=WINDOW)  # each (agents,)
        self._actor_losses: deque[th.Tensor] = deque(maxlen=WINDOW)  # each (agents,)
        self._own_actions: list[th.Tensor] = []
        self._norms: dict[str, float] = {}  # of networks whose gradients did not come along, see set_state
        self.update_seconds = 0.0

    def critics(self, losses: th.Tensor, targets: th.Tensor) -> None:
        """Note an update of the critics: losses (critics, agents), TD targets (agents, batch)."""
        self._critic_losses.append(losses)
        self._targets.append(targets.mean(-1))
        self._norms.pop("critic", None)

    def actors(self, losses: th.Tensor, own_actions: list[th.Tensor]) -> None:
        """Note an update of the actors: losses (agents,), their actions per block (agents, batch, action)."""
        self._actor_losses.append(losses)
        self._own_actions = own_actions
        self._norms.pop("actor", None)

    def series(self, actor: StackedActors, critic: CentralCritics) -> dict[str, float]:
        """
        Name → value of everything to log; losses and Q-values per group, gradient norms of the latest update.

        :param actor: the actors, with the gradients of their latest update
        :param critic: the critics, likewise
        """
        values: dict[str, float] = {"time/update_seconds": self.update_seconds}
        if self._critic_losses:
            self._per_group(values, "train/critic_loss", _stacked(self._critic_losses))
            self._per_group(values, "train/q_target", _stacked(self._targets))
            values["train/critic_grad_norm"] = self._norms.get("critic") or _mean_norm(critic)
        if self._actor_losses:
            self._per_group(values, "train/actor_loss", _stacked(self._actor_losses))
            values["train/actor_grad_norm"] = self._norms.get("actor") or _mean_norm(actor)
            if self._continuous:
                saturated = th.cat([(actions.abs() > SATURATED).float().flatten() for actions in self._own_actions])
                values["train/action_saturation"] = saturated.mean().item()
        return values

    def get_state(self, actor: StackedActors, critic: CentralCritics) -> dict[str, Any]:
        """Everything that :meth:`series` will show, as plain values; the networks are those of :meth:`series`."""
        logged = self.series(actor, critic)
        return {
            **{name: _stacked(noted) if noted else None for name, noted in self._noted().items()},
            "own_actions": self._own_actions,
            "norms": {n: logged[f"train/{n}_grad_norm"] for n in ("actor", "critic") if f"train/{n}_grad_norm" in logged},
            "update_seconds": self.update_seconds,
        }

    def set_state(self, saved: dict[str, Any], device: th.device) -> None:
        """Inverse of :meth:`get_state`; what is noted goes to the device of the learner."""
        for name, noted in self._noted().items():
            noted.clear()
            noted.extend(() if saved[name] is None else saved[name].to(device).unbind())
        self._own_actions, self._norms = [actions.to(device) for actions in saved["own_actions"]], dict(saved["norms"])
        self.update_seconds = float(saved["update_seconds"])

    def _noted(self) -> dict[str, deque[th.Tensor]]:
        return {"critic_losses": self._critic_losses, "targets": self._targets, "actor_losses": self._actor_losses}

    def _per_group(self, values: dict[str, float], key: str, stacked: th.Tensor) -> None:
        """Add the mean of ``stacked`` (time, agents) over all learning agents, and over each group where there are several."""
        values[key] = stacked.mean().item()
        if len(self._positions) > 1:
            for group, positions in self._positions.items():
                values[f"{key}_{group}"] = stacked[:, positions].mean().item()


def _stacked(noted: deque[th.Tensor]) -> th.Tensor:
    """What was noted of each update, of several critics the mean: (updates, agents)."""
    means = [values for values in noted if values.ndim == 1]  # those of a file come first
    of_critics = [values for values in noted if values.ndim == 2]
    return th.cat([*([th.stack(means)] if means else ()), *([th.stack(of_critics).mean(1)] if of_critics else ())])


def _mean_norm(networks: StackedActors | CentralCritics) -> float:
    return th.cat([stack.gradient_norms() for stack in networks.stacks]).mean().item()  # type: ignore[operator]
