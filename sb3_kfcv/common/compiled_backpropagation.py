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
        self.passed = self.after_first.copy()  # the same, where no gradients of parameters are wanted
        self.learnt, self.learnt_parameters = self.after_first, self.parameters  # where they are
        if not stack.common_input:
            self.learnt, self.learnt_parameters = self.plan, [(stack.first.weight, stack.first.bias), *self.parameters]

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

    def values(self, x: th.Tensor) -> th.Tensor:
        if self.stack.common_input or self.member_bias is not None:
            return super().values(x)
        self.x = self._given(self._folded(x))
        forward(self.plan, self.numbers, self.shape[1], False)
        return self._unfolded(self.layers[-1])

    def _given(self, x: th.Tensor) -> th.Tensor:
        """Note where the own inputs lie; returns them as they are read."""
        x = self._readable(x, self.stack.sizes[0])
        self._lie(self.plan[0], "x", x)
        return x

    def _first_of_own_inputs(self, x: th.Tensor) -> th.Tensor:
        x = self._given(x)
        forward(self.plan[:1], self.numbers, self.shape[1], False)
        return x

    def rest(self) -> th.Tensor:
        forward(self.after_first, self.numbers, self.shape[1], True)
        return self._unfolded(self.layers[-1])

    def _through_layers(self, gradient: th.Tensor, parameters: bool) -> None:
        """Where the parameters' gradients are wanted, a first layer of own inputs is gone through with the others."""
        gradient = self._readable(gradient, self.stack.sizes[-1])
        layers = self.learnt if parameters else self.passed
        self._lie(layers[-1], "z_gradient", gradient)
        apart = self._place_gradients() if parameters else []
        if layers is self.plan:
            self.x = self._given(self.x)  # it may have been given another place since
        backward(layers, self.numbers, self.stack.n_networks, self.shape[1], self.scratch)
        for into, written in apart:
            into.copy_(written)

    def _write_first_of_own_inputs(self, gradient: th.Tensor) -> None:
        """Done with the others."""

    def _place_gradients(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """Note where the parameters' gradients are to be written; those that cannot be, with what is to be copied there."""
        apart = []
        for layer, own in zip(self.learnt, self.learnt_parameters, strict=True):
            for name, parameter in zip(("weight_gradient", "bias_gradient"), own, strict=True):
                if (into := gradient_of(parameter)) is None:
                    layer[name] = 0
                    continue
                written = into
                if into.dtype != th.float32 or not (into.is_cpu and into.is_contiguous()):  # set by somebody else
                    written = th.empty(parameter.shape)
                    apart.append((into, written))
                layer[name] = written.data_ptr()
        return apart
