"""The evaluation of stacks of small networks by compiled loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from torch import nn

from sb3_kfcv.common.backpropagation import Evaluation, gradient_of
from sb3_kfcv.common.compiled_layers import FUSED, LAYER, backward, forward

if TYPE_CHECKING:
    from sb3_kfcv.common.stacked_networks import StackedMLP

# Units, and inputs of an own first layer, up to which compiled loops are faster, see docs/performance.md.
WIDEST = 64
WIDEST_INPUT = 512


class CompiledEvaluation(Evaluation):
    """
    The same by the loops of :mod:`~sb3_kfcv.common.compiled_layers`, on one thread; only the first layer on a common input,
    which is one large product, stays PyTorch's.

    :param stack: the networks, which :meth:`serves` takes
    :param batch: rows
    :param lender: an evaluation whose tensors to use if they are of the same shape and type
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
        for before, after, z, gradient in zip(self.plan[:-1], self.plan[1:], self.layers[:-1], self.gradients, strict=True):
            self._lie(before, "z_gradient", gradient)  # that of the last layer is given each time
            self._lie(after, "x", z)
            after["x_gradient"] = gradient.data_ptr()
        room = [layer["n_in"] * layer["n_out"] for layer in self.plan[1:]]
        self.scratch = np.ones(max(*room, *self.plan["n_out"]) + 1, np.float32)
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
            and (stack.common_input or stack.sizes[0] <= WIDEST_INPUT)
            and all(p.dtype == th.float32 and p.device.type == "cpu" and p.is_contiguous() for p in stack.parameters())
        )

    @staticmethod
    def _lie(layer: np.void, name: str, tensor: th.Tensor) -> None:
        """Note where a tensor (members, rows, features) lies."""
        layer[name], layer[f"{name}_member"], layer[f"{name}_row"] = tensor.data_ptr(), tensor.stride(0), tensor.stride(1)

    def _readable(self, values: th.Tensor, size: int) -> th.Tensor:
        """
        Values in rows that lie in one piece: what is not where it is taken to be would be read all the same.

        :raises ValueError: if they are not (members, rows, size) in the processor's memory
        """
        if values.shape != (*self.shape, size) or not values.is_cpu:
            expected, got = f"{(*self.shape, size)} on cpu", f"{tuple(values.shape)} on {values.device}"
            raise ValueError(f"expected (networks, rows, features) = {expected}, got {got}")
        return values if values.dtype == th.float32 and values.stride(2) == 1 else values.float().contiguous()

    def _first_of_own_inputs(self, x: th.Tensor) -> th.Tensor:
        x = self._readable(x, self.stack.sizes[0])
        self._lie(self.plan[0], "x", x)
        forward(self.plan[:1], self.numbers, self.shape[1], False)
        return x

    def rest(self) -> th.Tensor:
        forward(self.after_first, self.numbers, self.shape[1], True)
        return self._unfolded(self.layers[-1])

    def _through_layers(self, gradient: th.Tensor, parameters: bool) -> None:
        gradient = self._readable(gradient, self.stack.sizes[-1])
        self._lie(self.plan[-1], "z_gradient", gradient)
        self._backward(self.after_first, self.parameters if parameters else [])

    def _write_first_of_own_inputs(self, gradient: th.Tensor) -> None:
        x = self._readable(self.x, self.stack.sizes[0])  # it may have been given another place since
        self._lie(self.plan[0], "x", x)
        self._backward(self.plan[:1], [(self.stack.first.weight, self.stack.first.bias)])

    def _backward(self, layers: np.ndarray, parameters: Sequence[tuple[nn.Parameter, nn.Parameter]]) -> None:
        """Through some layers; ``parameters``: theirs, or none if their gradients are not wanted."""
        apart = []
        layers["weight_gradient"] = layers["bias_gradient"] = 0
        for layer, own in zip(layers, parameters, strict=False):
            for name, parameter in zip(("weight_gradient", "bias_gradient"), own, strict=True):
                if (into := gradient_of(parameter)) is None:
                    continue
                written = into
                if into.dtype != th.float32 or not (into.is_cpu and into.is_contiguous()):  # set by somebody else
                    written = th.empty(parameter.shape)
                    apart.append((into, written))
                layer[name] = written.data_ptr()
        backward(layers, self.numbers, self.stack.n_networks, self.shape[1], self.scratch)
        for into, written in apart:
            into.copy_(written)
