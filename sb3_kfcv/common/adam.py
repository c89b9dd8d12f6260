"""Adam for networks of a few large tensors, stepped thousands of times a second."""

from __future__ import annotations

from typing import Any

import torch as th


class LeanAdam(th.optim.Adam):
    """
    ``torch.optim.Adam(fused=True)``, number for number and with the same state; but its tensors are found once instead of at
    every step, which for small networks takes as long as the step itself.

    Whatever the fused kernel is not asked for here (several groups, closures, AMSGrad, a learning rate in a tensor) goes
    through ``torch.optim.Adam``. All parameters are of one device and type, and all have gradients or none has.
    """

    # Parameters, first and second moments, step counts, and these in one tensor
    _found: tuple[list[th.Tensor], list[th.Tensor], list[th.Tensor], list[th.Tensor], th.Tensor] | None = None

    @th.no_grad()
    def step(self, closure: Any = None) -> Any:
        """
        One step along the gradients.

        :param closure: evaluates the loss anew
        :return: the closure's loss, if there is one
        """
        (group, *more) = self.param_groups
        if more or closure is not None or group["amsgrad"] or not group["fused"] or isinstance(group["lr"], th.Tensor):
            return super().step(closure)
        if self._found is None:
            loss = super().step()  # makes the state
            parameters = [parameter for parameter in group["params"] if parameter.grad is not None]
            states = [self.state[parameter] for parameter in parameters]
            all_steps = th.stack([state["step"] for state in states])
            for state, steps in zip(states, all_steps, strict=True):
                state["step"] = steps
            moments = ([state[name] for state in states] for name in ("exp_avg", "exp_avg_sq", "step"))
            self._found = parameters, *moments, all_steps  # type: ignore[assignment]
            return loss
        parameters, exp_avgs, exp_avg_sqs, steps, all_steps = self._found
        all_steps.add_(1)
        beta1, beta2 = group["betas"]
        th._fused_adam_(
            parameters,
            [parameter.grad for parameter in parameters],  # type: ignore[misc]
            exp_avgs,
            exp_avg_sqs,
            [],
            steps,
            lr=group["lr"],
            beta1=beta1,
            beta2=beta2,
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=group["maximize"],
        )
        return None

    step.hooked = True  # type: ignore[attr-defined]  # else Optimizer wraps it to record a profile at each call

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """As in PyTorch."""
        self._found = None
        super().load_state_dict(state_dict)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._found = None
