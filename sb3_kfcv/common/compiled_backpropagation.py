"""The evaluation of stacks of small networks by compiled loops."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from torch import nn

from sb3_kfcv.common.backpropagation import Evaluation, gradient_of
from sb3_kfcv.common.compiled_layers import FLOAT, FUSED, LAYER, OWN_INPUTS, ascend, backward, forward, regress

if TYPE_CHECKING:
    from sb3_kfcv.common.stacked_networks import StackedMLP

# Up to which compiled loops are faster, see docs/performance.md: units, inputs of an own first layer, and inputs of all
# members together that read a common input.
WIDEST = 64
WIDEST_INPUT = 512
WIDEST_COMMON_INPUT = 1024


class CompiledEvaluation(Evaluation):
    """
    The same by the loops of :mod:`~sb3_kfcv.common.compiled_layers`, on one thread. Only a large first layer on a common
    input, which is one product for all members, stays PyTorch's.

    :param stack: the networks, which :meth:`serves` takes
    :param batch: rows
    :param lender: an evaluation whose tensors to use if it is of the same kind, for networks of the same shape and type
    """

    folding = False

    def __init__(self, stack: StackedMLP, batch: int, lender: Evaluation | None = None) -> None:
        self.whole = not stack.common_input or stack.n_members * stack.sizes[0] <= WIDEST_COMMON_INPUT
        super().__init__(stack, batch, lender)
        numbers = range(stack.n_members) if self.members is None else self.members.tolist()
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
        self.value_gradient = self.layers[-1].new_empty(self.layers[-1].shape)
        self.after_first = self.plan[1:]
        self.passed = self.plan.copy()  # the same, where no gradients of parameters are wanted
        self.learnt, learnt = self.after_first, [*zip(self.after_first, self.parameters, strict=True)]  # where they are
        self.learnt_parameters = [
            (layer, name, parameter)
            for layer, own in learnt
            for name, parameter in zip(("weight_gradient", "bias_gradient"), own, strict=True)
        ]
        if self.whole:
            self._include_first()
        room = [layer["n_in"] * layer["n_out"] for layer in self.learnt]
        self.scratch = np.ones(max(*room, *self.plan["n_out"]) + 1, np.float32)

    def _include_first(self) -> None:
        """Let the first layer be one of those that are compiled."""
        stack, first = self.stack, self.plan[0]
        self.learnt = self.plan
        own = {"weight_gradient": stack.first.weight, "bias_gradient": stack.first.bias}
        if stack.common_input:
            columns = th.arange(stack.sizes[0]).expand(stack.n_members, -1)
            self.rows = stack.first_layer_rows(range(stack.n_members), columns).contiguous()
            first["weight_rows"] = self.rows.data_ptr()
        if stack.member_bias is not None:
            first["member_bias"], own["member_bias_gradient"] = stack.member_bias.data_ptr(), stack.member_bias
        self.passed[0] = first
        self.learnt_parameters += [(first, name, parameter) for name, parameter in own.items()]

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

    def _readable(self, values: th.Tensor, members: int, size: int) -> th.Tensor:
        """
        Values in rows that lie in one piece: what is not where it is taken to be would be read all the same.

        :raises ValueError: if they are not (members, rows, size) in the processor's memory
        """
        if values.shape != (members, self.batch, size) or not values.is_cpu:
            expected, got = f"{(members, self.batch, size)} on cpu", f"{tuple(values.shape)} on {values.device}"
            raise ValueError(f"expected (networks, rows, features) = {expected}, got {got}")
        return values if values.dtype == th.float32 and values.stride(2) == 1 else values.float().contiguous()

    def values(self, x: th.Tensor) -> th.Tensor:
        if not self.whole:
            return super().values(x)
        self._given(x, self.plan[0])
        self._forward(self.plan, False)
        return self.layers[-1]

    def first_layer(self, x: th.Tensor) -> th.Tensor:
        if not self.whole:
            return super().first_layer(x)
        self._given(x, self.plan[0])
        self._forward(self.plan[:1], False)
        return self.layers[0]

    def rest(self) -> th.Tensor:
        self._forward(self.after_first, True)
        return self.layers[-1]

    def regress(self, x: th.Tensor, targets: th.Tensor, weights: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        if not self.whole:
            return super().regress(x, targets, weights)
        self._given(x, self.plan[0])
        self._lie(self.plan[-1], "z_gradient", self.value_gradient)
        apart = self._place_gradients()
        errors = th.empty_like(self.value_gradient)
        losses = errors.new_empty(errors.shape[0], errors.shape[2])
        fit = (self._numbers(targets, errors.shape), self._numbers(weights, errors.shape), errors.numpy(), losses.numpy())
        regress(self.plan, self.numbers, self.stack.n_networks, self.batch, fit, self.scratch)
        for into, written in apart:
            into.copy_(written)
        return errors, losses

    def ascend(
        self,
        x: th.Tensor,
        places: Sequence[tuple[Sequence[int], Sequence[int]]],
        own_inputs: Sequence[th.Tensor],
        weights: th.Tensor,
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """
        Of a common input whose first layer is compiled, and networks of one value: the losses −Σ weights · values, summed over
        the rows, where some inputs are the member's own, and their gradients at these.

        :param x: (batch, in)
        :param places: by block of members, each once: which, and in which column of the input the own ones of each begin
        :param own_inputs: by block (members, batch, own)
        :param weights: of each value (members, batch)
        :return: the losses (members,), and the gradients by block (members, batch, own)
        """
        self._given(x.unsqueeze(0), self.passed[0])
        self._lie(self.passed[-1], "z_gradient", self.value_gradient)
        own_inputs = [
            self._readable(own, len(members), own.shape[2]).contiguous()
            for (members, _), own in zip(places, own_inputs, strict=True)
        ]
        gradients = [th.empty_like(own) for own in own_inputs]
        places_of = np.zeros(self.shape[0], OWN_INPUTS)
        for (members, columns), own, gradient in zip(places, own_inputs, gradients, strict=True):
            size = own.shape[2]
            for i, (member, column) in enumerate(zip(members, columns, strict=True)):
                start = FLOAT * i * self.batch * size
                places_of[member] = (own.data_ptr() + start, gradient.data_ptr() + start, column, size)
        losses = x.new_empty(self.shape[0])
        room = np.empty((2 * self.width + self.batch) * int(places_of["size"].max()), np.float32)
        climb = (places_of, self._numbers(weights, self.shape), losses.numpy(), room)
        ascend(self.passed, self.numbers, self.stack.n_networks, self.batch, climb, self.scratch)
        return losses, gradients

    def _numbers(self, values: th.Tensor, shape: Sequence[int]) -> np.ndarray:
        """
        Values as an array in one piece.

        :raises ValueError: if they are not of the shape, in the processor's memory
        """
        if values.shape != shape or not values.is_cpu:
            raise ValueError(f"expected {tuple(shape)} on cpu, got {tuple(values.shape)} on {values.device}")
        return values.detach().float().contiguous().numpy()

    def _given(self, x: th.Tensor, first: np.void) -> None:
        """Note for the first layer where the input lies."""
        common = self.stack.common_input
        self.x = self._readable(x, 1 if common else self.shape[0], self.stack.sizes[0])
        self._lie(first, "x", self.x)
        if common:
            first["x_member"] = 0

    def _forward(self, layers: np.ndarray, rectify_first: bool) -> None:
        forward(layers, self.numbers, self.batch, rectify_first, self.scratch)

    def _through_layers(self, gradient: th.Tensor, parameters: bool) -> None:
        """With the first one where it is compiled and parameters' gradients are wanted."""
        gradient = self._readable(gradient, self.shape[0], self.stack.sizes[-1])
        layers = self.learnt if parameters else self.passed[1:]
        self._lie(layers[-1], "z_gradient", gradient)
        if layers is self.plan:
            self._given(self.x, self.plan[0])  # it may have been given another place since
        apart = self._place_gradients() if parameters else []
        backward(layers, self.numbers, self.stack.n_networks, self.batch, self.scratch)
        for into, written in apart:
            into.copy_(written)

    def _write_first_gradients(self) -> None:
        if not self.whole:
            super()._write_first_gradients()

    def _place_gradients(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """Note where the parameters' gradients are to be written; those that cannot be, with what is to be copied there."""
        apart = []
        for layer, name, parameter in self.learnt_parameters:
            if (into := gradient_of(parameter)) is None:
                layer[name] = 0
                continue
            written = into
            if into.dtype != th.float32 or not (into.is_cpu and into.is_contiguous()):  # set by somebody else
                written = th.empty(parameter.shape)
                apart.append((into, written))
            layer[name] = written.data_ptr()
        return apart
