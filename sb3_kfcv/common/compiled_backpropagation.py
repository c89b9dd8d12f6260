"""The evaluation of stacks of small networks by compiled loops."""

from __future__ import annotations

from collections.abc import Sequence
from operator import is_
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from torch import nn

from sb3_kfcv.common.backpropagation import AsMade, Evaluation, gradient_of
from sb3_kfcv.common.compiled_layers import FUSED, LAYER, OWN_INPUTS, ascend, backward, forward, forward_alone, regress

if TYPE_CHECKING:
    from sb3_kfcv.common.stacked_networks import StackedMLP

# Up to which compiled loops are faster, see docs/performance.md: units, inputs of an own first layer, and inputs of all
# members together that read a common input.
WIDEST = 64
WIDEST_INPUT = 512
WIDEST_COMMON_INPUT = 1024


def serves(stack: StackedMLP) -> bool:
    """Whether compiled loops are for such a stack, as things are."""
    return (
        FUSED
        and th.get_num_threads() == 1
        and stack.layers_are_usual()
        and type(stack.activation) is nn.ReLU
        and not stack.norms
        and len(stack.rest) > 0
        and max(stack.sizes[1:]) <= WIDEST
        and (stack.common_input or stack.sizes[0] <= WIDEST_INPUT)
        and all(p.dtype == th.float32 and p.device.type == "cpu" and p.is_contiguous() for p in stack.parameters())
    )


def plan_of(stack: StackedMLP) -> tuple[np.ndarray, np.ndarray]:
    """
    Where the parameters of a stack lie.

    :return: array of ``LAYER``; network of each member
    """
    plan = np.zeros(1 + len(stack.rest), LAYER)
    for i, (place, layer) in enumerate(zip(plan, [stack.first, *stack.rest], strict=True)):
        place["weight"], place["bias"] = layer.weight.data_ptr(), layer.bias.data_ptr()  # type: ignore[operator, union-attr]
        place["n_in"], place["n_out"] = stack.sizes[i : i + 2]
    if stack.member_bias is not None:
        plan[0]["member_bias"] = stack.member_bias.data_ptr()
    return plan, np.array(range(stack.n_members) if stack.members is None else stack.members.tolist())


# Hooks on all modules; those of single modules are the modules' own.
GLOBAL_HOOKS = (nn.modules.module._global_forward_pre_hooks, nn.modules.module._global_forward_hooks)


class CompiledValues:
    """
    The values of a stack whose members have inputs of their own, without a way back: of any number of rows, and in tensors
    of their own, so that several threads may ask at once. For other stacks there are none.

    :param stack: the networks
    """

    def __init__(self, stack: StackedMLP) -> None:
        self.as_made = AsMade(stack)
        self.served = not stack.common_input and serves(stack)
        if not self.served:
            return
        self.plan, self.networks = plan_of(stack)
        self.kept = [parameter.detach() for parameter in stack.parameters()]  # their memory, if others take their place
        self.n_in, self.n_out, self.widest = stack.sizes[0], stack.sizes[-1], max(stack.sizes[1:])
        self.everybody = np.arange(stack.n_members)
        own_hooks = (hooks for module in stack.modules() for hooks in (module._forward_pre_hooks, module._forward_hooks))
        self.hooks = [*GLOBAL_HOOKS, *own_hooks]

    def of(self, x: th.Tensor, member: int | None = None) -> th.Tensor | None:
        """
        :param x: (members, batch, in); of one member (1, batch, in)
        :param member: its number; by default all
        :return: (members, batch, out) or (1, batch, out); ``None`` if they are for the plain forward
        """
        if not self.served or any(self.hooks) or type(x) is not th.Tensor or not (x.is_cpu and x.dtype == th.float32):
            return None
        members = self.everybody if member is None else self.everybody[member : member + 1]
        if x.ndim != 3 or (len(x), x.shape[2]) != (len(members), self.n_in):
            return None
        x, batch = x if x.stride(2) == 1 else x.contiguous(), x.shape[1]
        out, scratch = x.new_empty(len(x), batch, self.n_out), np.empty((1 + 2 * batch) * self.widest, np.float32)
        where = x.data_ptr(), x.stride(0), x.stride(1)
        forward_alone(self.plan, members, self.networks, batch, where, out.data_ptr(), scratch)
        return out


class CompiledEvaluation(Evaluation):
    """
    The same by the loops of :mod:`~sb3_kfcv.common.compiled_layers`, on one thread. Only a large first layer on a common
    input, which is one product for all members, stays PyTorch's.

    :param stack: the networks, which :func:`serves` takes
    :param batch: rows
    :param lender: an evaluation whose tensors to use if it is of the same kind, for networks of the same shape and type
    """

    folding = False

    def __init__(self, stack: StackedMLP, batch: int, lender: Evaluation | None = None) -> None:
        self.whole = not stack.common_input or stack.n_members * stack.sizes[0] <= WIDEST_COMMON_INPUT
        super().__init__(stack, batch, lender)
        self.plan, self.numbers = plan_of(stack)
        for layer, z in zip(self.plan, self.layers, strict=True):
            self._lie(layer, "z", z)
        self.value_gradient = self.layers[-1].new_empty(self.layers[-1].shape)
        for layer, gradient in zip(self.plan, [*self.gradients, self.value_gradient], strict=True):
            self._lie(layer, "z_gradient", gradient)
        for layer, z, gradient in zip(self.plan[1:], self.layers, self.gradients, strict=False):
            self._lie(layer, "x", z)
            layer["x_gradient"] = gradient.data_ptr()
        self.after_first = self.plan[1:]
        self.passed = self.after_first.copy()  # the same, where no gradients of parameters are wanted
        self.learnt, learnt = self.after_first, self.parameters  # layers and parameters where they are
        if self.whole:
            self.learnt, learnt = self.plan, [(stack.first.weight, stack.first.bias), *self.parameters]  # type: ignore[list-item]
            self._describe_first(self.plan[0])
        names = ("weight_gradient", "bias_gradient")
        self.learnt_parameters = [
            (layer, name, parameter)
            for layer, own in zip(self.learnt, learnt, strict=True)
            for name, parameter in zip(names, own, strict=True)
        ]
        if self.whole and stack.member_bias is not None:
            self.learnt_parameters.append((self.plan[0], "member_bias_gradient", stack.member_bias))
        self.placed: list[th.Tensor | None] = []  # gradients whose places are in the plan
        self.pointers: list[int] = []
        room = [layer["n_in"] * layer["n_out"] for layer in self.learnt]
        self.scratch = np.ones(max(*room, *self.plan["n_out"]) + 1, np.float32)

    def _describe_first(self, first: np.void) -> None:
        """What a first layer has that others have not."""
        stack, numbers = self.stack, self.plan.view(np.int64)
        self.at_x = numbers[: LAYER.names.index("x_row") + 1]  # type: ignore[union-attr]  # its first fields
        if stack.common_input:
            columns = th.arange(stack.sizes[0]).expand(stack.n_members, -1)
            self.rows = stack.first_layer_rows(range(stack.n_members), columns).contiguous()
            first["weight_rows"] = self.rows.data_ptr()

    @staticmethod
    def _lie(layer: np.void, name: str, tensor: th.Tensor) -> None:
        """Note where a tensor (members, rows, features) lies."""
        layer[name], layer[f"{name}_member"], layer[f"{name}_row"] = tensor.data_ptr(), tensor.stride(0), tensor.stride(1)

    def values(self, x: th.Tensor) -> th.Tensor:
        if not self.whole:
            return super().values(x)
        self._given(x)
        self._forward(self.plan, False)
        return self.layers[-1]

    def first_layer(self, x: th.Tensor) -> th.Tensor:
        if not self.whole:
            return super().first_layer(x)
        self._given(x)
        self._forward(self.plan[:1], False)
        return self.layers[0]

    def rest(self) -> th.Tensor:
        self._forward(self.after_first, True)
        return self.layers[-1]

    def regress(self, x: th.Tensor, targets: th.Tensor, weights: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        if not self.whole:
            return super().regress(x, targets, weights)
        self._given(x)
        errors = th.empty_like(self.value_gradient)
        losses = errors.new_empty(errors.shape[0], errors.shape[2])
        fit = (self._numbers(targets, errors.shape), self._numbers(weights, errors.shape), errors.numpy(), losses.numpy())
        apart = self._place_gradients()
        regress(self.plan, self.numbers, self.stack.n_networks, self.batch, fit, self.scratch)
        for into, written in apart:
            into.copy_(written)
        return errors, losses

    def ascend(
        self, x: th.Tensor, own: OwnInputs, values: Sequence[th.Tensor], weights: th.Tensor
    ) -> tuple[th.Tensor, list[th.Tensor]]:
        """
        Of a common input whose first layer is compiled, and networks of one value: the losses −Σ weights · values, summed over
        the rows, where some inputs are the member's own, and their gradients at these.

        :param x: (1, batch, in)
        :param own: which inputs
        :param values: what stands there, by block (members, batch, own)
        :param weights: of each value (members, batch)
        :return: the losses (members,), and the gradients by block (members, batch, own)
        """
        self._given(x)
        shapes = [(n_members, self.batch, size) for n_members, size in own.blocks]
        read = [self._numbers(new, shape) for new, shape in zip(values, shapes, strict=True)]
        gradients = [x.new_empty(shape) for shape in shapes]
        addresses = np.array([[new.ctypes.data for new in read], [gradient.data_ptr() for gradient in gradients]])
        losses = x.new_empty(self.shape[0])
        room = np.empty((2 * self.width + self.batch) * own.widest, np.float32)
        climb = (own.places, addresses, self._numbers(weights, self.shape), losses.numpy(), room)
        ascend(self.plan[:1], self.passed, self.numbers, self.stack.n_networks, self.batch, climb, self.scratch)
        return losses, gradients

    def _given(self, x: th.Tensor) -> None:
        """
        Note where the input lies: what is not where it is taken to be would be read all the same.

        :raises ValueError: if it is not (members, rows, features) in the processor's memory
        """
        common = self.stack.common_input
        self._require_shape(x, (1 if common else self.shape[0], self.batch, self.stack.sizes[0]))
        self.x = x if x.dtype == th.float32 and x.stride(2) == 1 else x.float().contiguous()
        self.at_x[:] = self.x.data_ptr(), 0 if common else self.x.stride(0), self.x.stride(1)

    def _numbers(self, values: th.Tensor, shape: tuple[int, ...]) -> np.ndarray:
        """
        Values as an array in one piece.

        :raises ValueError: if they are not of the shape, in the processor's memory
        """
        self._require_shape(values, shape)
        return values.detach().float().contiguous().numpy()

    @staticmethod
    def _require_shape(values: th.Tensor, shape: tuple[int, ...]) -> None:
        if values.shape != shape or not values.is_cpu:
            raise ValueError(f"expected {tuple(shape)} on cpu, got {tuple(values.shape)} on {values.device}")

    def _forward(self, layers: np.ndarray, rectify_first: bool) -> None:
        forward(layers, self.numbers, self.batch, rectify_first, self.scratch)

    def _through_layers(self, gradient: th.Tensor, parameters: bool) -> None:
        """With the first one where it is compiled and parameters' gradients are wanted."""
        self._require_shape(gradient, (self.shape[0], self.batch, self.stack.sizes[-1]))
        self.value_gradient.copy_(gradient.detach())
        layers = self.learnt if parameters else self.passed
        if layers is self.plan:
            self._given(self.x)  # it may have been given another place since
        apart = self._place_gradients() if parameters else []
        backward(layers, self.numbers, self.stack.n_networks, self.batch, self.scratch)
        for into, written in apart:
            into.copy_(written)

    def _write_first_gradients(self) -> None:
        if not self.whole:
            super()._write_first_gradients()

    def _place_gradients(self) -> list[tuple[th.Tensor, th.Tensor]]:
        """Note where the parameters' gradients are to be written; those that cannot be, with what is to be copied there."""
        gradients = [gradient_of(parameter) for _, _, parameter in self.learnt_parameters]
        pointers = [0 if gradient is None else gradient.data_ptr() for gradient in gradients]
        as_they_were = pointers == self.pointers and all(map(is_, gradients, self.placed))
        if as_they_were and all(gradient is None or gradient.is_contiguous() for gradient in gradients):
            return []
        apart = []
        for i, (into, (layer, name, parameter)) in enumerate(zip(gradients, self.learnt_parameters, strict=True)):
            if into is not None and (into.dtype != th.float32 or not (into.is_cpu and into.is_contiguous())):
                apart.append((into, th.empty(parameter.shape)))  # set by somebody else
                pointers[i] = apart[-1][1].data_ptr()
            layer[name] = pointers[i]
        self.placed, self.pointers = ([], []) if apart else (gradients, pointers)
        return apart


class OwnInputs:
    """
    Inputs that are each member's own, in place of some of a common input.

    :param blocks: of members with as many own inputs each: which, and in which column of the input the own ones of each begin
    :param sizes: of each block, how many own inputs
    """

    def __init__(self, blocks: Sequence[tuple[Sequence[int], Sequence[int]]], sizes: Sequence[int]) -> None:
        self.blocks = [(len(members), size) for (members, _), size in zip(blocks, sizes, strict=True)]
        self.widest = max(sizes)
        self.places = np.zeros(sum(len(members) for members, _ in blocks), OWN_INPUTS)
        for number, ((members, columns), size) in enumerate(zip(blocks, sizes, strict=True)):
            for i, (member, column) in enumerate(zip(members, columns, strict=True)):
                self.places[member] = (number, i, column, size)
