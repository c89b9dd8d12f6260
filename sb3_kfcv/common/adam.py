"""Adam for networks of a few large tensors, stepped thousands of times a second."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch as th
from torch.optim.optimizer import Optimizer

# Settings of a group that the fused kernel is not asked for here.
UNUSUAL = ("amsgrad", "capturable", "differentiable", "decoupled_weight_decay")


class _Found(NamedTuple):
    """The tensors of a group, all of whose parameters have gradients."""

    parameters: list[th.Tensor]
    exp_avgs: list[th.Tensor]
    exp_avg_sqs: list[th.Tensor]
    steps: list[th.Tensor]
    all_steps: Any  # these are views of it; on the CPU as an array, which is quicker to count up


class LeanAdam(th.optim.Adam):
    """
    ``torch.optim.Adam(fused=True)``, number for number and with the same state; but its tensors are found once instead of at
    every step, which for small networks takes as long as the step itself.

    Whatever the fused kernel is not asked for here (several groups, closures, parameters without gradient, AMSGrad, hooks …)
    goes through ``torch.optim.Adam``.
    """

    _found: _Found | None = None

    @th.no_grad()
    def step(self, closure: Any = None) -> Any:
        """
        One step along the gradients.

        :param closure: evaluates the loss anew
        :return: the closure's loss, if there is one
        """
        group = self.param_groups[0]
        gradients = [parameter.grad for parameter in group["params"]]
        if closure is not None or self._is_unusual(group) or any(gradient is None for gradient in gradients):
            self._found = None
            return _plain_step(self, closure)
        if self._found is None or len(self.state) != len(gradients):
            _plain_step(self)  # makes the state
            self._found = self._find(group)
            return None
        beta1, beta2 = group["betas"]
        self._found.all_steps.__iadd__(1)  # in place, of an array as of a tensor
        th._fused_adam_(
            self._found.parameters,
            gradients,  # type: ignore[arg-type]
            self._found.exp_avgs,
            self._found.exp_avg_sqs,
            [],
            self._found.steps,
            lr=group["lr"],
            beta1=beta1,
            beta2=beta2,
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=group["maximize"],
        )
        return None

    step.hooked = True  # type: ignore[attr-defined]  # else Optimizer wraps it, which takes long; see _plain_step

    def _is_unusual(self, group: dict[str, Any]) -> bool:
        hooked = self._optimizer_step_pre_hooks or self._optimizer_step_post_hooks
        return bool(
            len(self.param_groups) > 1
            or not group["fused"]
            or isinstance(group["lr"], th.Tensor)
            or any(group.get(setting) for setting in UNUSUAL)
            or hooked
        )

    def _find(self, group: dict[str, Any]) -> _Found:
        states = [self.state[parameter] for parameter in group["params"]]
        all_steps = th.stack([state["step"] for state in states])
        for state, steps in zip(states, all_steps, strict=True):
            state["step"] = steps
        exp_avgs, exp_avg_sqs, steps = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step"))
        return _Found(group["params"], exp_avgs, exp_avg_sqs, steps, all_steps.numpy() if all_steps.is_cpu else all_steps)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As in PyTorch."""
        self._found = None
        super().load_state_dict(state_dict)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._found = None


def _plain_step(optimizer: th.optim.Adam, closure: Any = None) -> Any:
    """PyTorch's own step, with its hooks."""
    step: Any = th.optim.Adam.step
    step = step if getattr(step, "hooked", False) else Optimizer.profile_hook_step(step)
    return step(optimizer, closure)
