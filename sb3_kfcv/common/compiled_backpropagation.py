"""The evaluation of stacks of small networks by compiled loops."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch as th
from torch import nn

from sb3_kfcv.common.backpropagation import Evaluation, gradient_of
from sb3_kfcv.common.compiled_layers import FUSED, LAYER, backward, forward

if TYPE_CHECKING:
    from sb3_kfcv.common.stacked_networks import StackedMLP

# Hidden units up to which compiled loops are faster than PyTorch's products, see docs/performance.md.
WIDEST = 64


class CompiledEvaluation(Evaluation):
    """
    The same by the loops of :mod:`~sb3_kfcv.common.compiled_layers`, on one thread; only the first layer on a common input,
    which is one large product, stays PyTorch's.

    :param stack: the networks, which :meth:`serves` takes
    :param batch: rows
    :param lender: an evaluation of the same shape, whose tensors to use
    """

    def __init__(self, stack: StackedMLP, batch: int, lender: Evaluation | None = None) -> None:
        super().__init__(stack, batch, lender)
        numbers = range(self.shape[0]) if self.members is None else self.members.tolist()
        self.numbers = np.array(numbers)  # network of each member
        self.plan = np.zeros(1 + len(self.weights), LAYER)
        weights = [(self.first, self.first_bias), *self.weights]
        for i, (layer, (weight, bias)) in enumerate(zip(self.plan, weights, strict=True)):
            layer["weight"], layer["bias"] = weight.data_ptr(), bias.data_ptr()
            layer["n_in"], layer["n_out"] = stack.sizes[i : i + 2]
            self._lie(layer, "z", self.layers[i])
        for layer, x, gradient in zip(self.plan[1:], self.layers, self.gradients, strict=False):
            self._lie(layer, "x", x)
            layer["x_gradient"] = gradient.data_ptr()
        for layer, gradient in zip(self.plan, self.gradients, strict=False):
            self._lie(layer, "z_gradient", gradient)
        self.scratch = np.ones(max(layer["n_in"] * layer["n_out"] for layer in self.plan[1:]) + 1, np.float32)
        self.after_first = self.plan[1:]

    @staticmethod
    def serves(stack: StackedMLP) -> bool:
        """Whether it is for such a stack, as things are."""
        return (
            FUSED
            and th.get_num_threads() == 1
            and type(stack.activation) is nn.ReLU
            and not stack.norms
            and len(stack.rest) > 0
            and max(stack.sizes[1:]) <= WIDEST
            and all(p.dtype == th.float32 and p.device.type == "cpu" and p.is_contiguous() for p in stack.parameters())
        )

    @staticmethod
    def _lie(layer: np.void, name: str, tensor: th.Tensor) -> None:
        """Note where a tensor (members, rows, features) lies."""
        layer[name], layer[f"{name}_member"], layer[f"{name}_row"] = tensor.data_ptr(), tensor.stride(0), tensor.stride(1)

    def _readable(self, values: th.Tensor, size: int) -> th.Tensor:
        """
        Values in rows that lie in one piece.

        :raises ValueError: if they are not (members, rows, size): the compiled loops would read beyond them
        """
        if values.shape != (*self.shape, size):
            raise ValueError(f"expected (networks, rows, features) = {(*self.shape, size)}, got {tuple(values.shape)}")
        return values if values.dtype == th.float32 and values.stride(2) == 1 else values.float().contiguous()

    def _first_of_own_inputs(self, x: th.Tensor) -> None:
        self.x = x = self._readable(x, self.stack.sizes[0])
        self._lie(self.plan[0], "x", x)
        forward(self.plan[:1], self.numbers, self.shape[1], False)

    def rest(self) -> th.Tensor:
        forward(self.after_first, self.numbers, self.shape[1], True)
        return self._unfolded(self.layers[-1])

    def _through_layers(self, gradient: th.Tensor, parameters: bool) -> None:
        gradient = self._readable(gradient, self.stack.sizes[-1])
        self._lie(self.plan[-1], "z_gradient", gradient)
        for layer, (weight, bias) in zip(self.after_first, self.parameters, strict=True):
            self._want(layer, weight if parameters else None, bias if parameters else None)
        self._backward(self.after_first)

    def _write_first_of_own_inputs(self, gradient: th.Tensor) -> None:
        self._want(self.plan[0], self.stack.first.weight, self.stack.first.bias)
        self._backward(self.plan[:1])

    def _backward(self, layers: np.ndarray) -> None:
        backward(layers, self.numbers, self.stack.n_networks, self.shape[1], self.scratch)

    @staticmethod
    def _want(layer: np.void, weight: nn.Parameter | None, bias: nn.Parameter | None) -> None:
        """Say whose gradients are to be written."""
        for name, parameter in (("weight_gradient", weight), ("bias_gradient", bias)):
            into = None if parameter is None else gradient_of(parameter)
            if parameter is not None and into is not None and not into.is_contiguous():
                into = parameter.grad = into.contiguous()
            layer[name] = 0 if into is None else into.data_ptr()
