"""Values of a stack of networks and their gradients, without autograd's graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch as th
from torch import nn

if TYPE_CHECKING:
    from sb3_kfcv.common.stacked_networks import StackedMLP

# Added to the variances of a layer norm, as ``nn.LayerNorm`` does.
NORM_EPS = 1e-5


class AsMade:
    """
    What is taken to be of a stack as it is now: its modules, where their parameters lie (a module's ``to`` replaces their
    data) and of what shape they are, the number of threads.
    """

    def __init__(self, stack: StackedMLP) -> None:
        self.threads = th.get_num_threads()
        holders: tuple[nn.Module, ...] = (stack, stack.rest, stack.norms)
        self.modules = [(holder._modules, dict(holder._modules)) for holder in holders]
        self.parameters = [
            (module._parameters, name, parameter, parameter.data_ptr(), parameter.stride(), parameter.shape)
            for module in stack.modules()
            for name, parameter in module._parameters.items()
            if parameter is not None
        ]

    def holds(self) -> bool:
        """Whether it is still so."""
        return (
            th.get_num_threads() == self.threads
            and all(now == then for now, then in self.modules)
            and all(
                own.get(name) is its and its.data_ptr() == pointer and its.stride() == strides and its.shape == shape
                for own, name, its, pointer, strides, shape in self.parameters
            )
        )


class Evaluation:
    """
    The values of a stack at minibatches of one size, and their gradients by the chain rule written out: without autograd's
    graph, whose making costs more than small networks do, and in tensors that the next evaluation uses again, since new
    memory costs more than the arithmetic on it.

    :param stack: the networks
    :param batch: rows
    :param lender: an evaluation whose tensors to use if it is of the same kind, for networks of the same shape and type
    """

    folding = True  # whether rows of members that share a network are one longer minibatch of it, where they can be
    whole = False  # whether the first layer, too, is done member by member, and not as one product for a common input

    def __init__(self, stack: StackedMLP, batch: int, lender: Evaluation | None = None) -> None:
        self.stack, self.batch = stack, batch
        self.relu = type(stack.activation) is nn.ReLU
        self.folds = stack.folds and self.folding
        self.members, self.wide_rows, self.width = None if self.folds else stack.members, stack.wide_rows, stack.sizes[1]
        self.shape = (stack.n_members, batch)
        if self.folds:
            self.shape = (stack.n_networks, stack.n_members // stack.n_networks * batch)
        self.parameters: list[tuple[nn.Parameter, nn.Parameter]] = [(layer.weight, layer.bias) for layer in stack.rest]  # type: ignore[misc]
        self.weights = [(weight.detach(), bias.detach()) for weight, bias in self.parameters]
        self.transposed = [weight.transpose(1, 2) for weight, _ in self.weights]
        self.first, self.first_bias = stack.first.weight.detach(), stack.first.bias.detach()
        self.activation, self.as_made = stack.activation, AsMade(stack)
        self.by_row = self.first.view(-1, self.width)
        self.common = None  # weight and bias of a common input, where they stand side by side
        if stack.common_input and self.wide_rows is None:
            self.common = stack.side_by_side(self.first, self.first_bias)
        self.member_bias = None if stack.member_bias is None else stack.member_bias.detach()
        self.x = self.first  # the input, once there is one
        self.norms: list[tuple[nn.Parameter, nn.Parameter]] = [(norm.weight, norm.bias) for norm in stack.norms]  # type: ignore[misc]
        self.normed: list[tuple[th.Tensor, th.Tensor]] = []  # by layer: rows before weight and bias; 1 / their deviations
        self.graphs: list[tuple[th.Tensor, th.Tensor]] = []  # of activations other than ReLU: what went in and what came out
        sizes = stack.sizes[1:]
        self.kind = (
            type(self),
            self.whole,
            self.shape,
            batch,
            stack.sizes,
            stack.common_input,
            self.first.dtype,
            self.first.device,
        )
        if lender is None or lender.kind != self.kind:
            self.wide, first = self._first_layer()
            self.layers = [first, *(self.first.new_empty(*self.shape, size) for size in sizes[1:])]
            self.wide_gradient, first = self._first_layer()
            self.gradients = [first, *(self.first.new_empty(*self.shape, size) for size in sizes[1:-1])]
        else:
            self.wide, self.layers = lender.wide, lender.layers
            self.wide_gradient, self.gradients = lender.wide_gradient, lender.gradients

    def _first_layer(self) -> tuple[th.Tensor, th.Tensor]:
        """For the first layer, and viewed as those of the others; with a common input its members stand side by side."""
        stack = self.stack
        if not stack.common_input or self.whole:
            z = self.first.new_empty(*self.shape, self.width)
            return z, z
        wide = self.first.new_empty(self.batch, stack.n_members * self.width)
        return wide, stack.spread(wide)

    def values(self, x: th.Tensor) -> th.Tensor:
        """
        All layers.

        :param x: as for :meth:`StackedMLP.forward`
        :return: (members, batch, out)
        """
        self.first_layer(x)
        return self.rest()

    def first_layer(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: as for :meth:`StackedMLP.forward`
        :return: (members, batch, hidden), pre-activations of the first layer, which may be changed before :meth:`rest`
        """
        x = self._folded(x)
        if self.stack.common_input:
            weight, bias = self.common or self.stack.side_by_side(self.first, self.first_bias)
            th.addmm(bias, x[0], weight, out=self.wide)
        else:
            self._layer(x, self.first, self.first_bias, self.wide)
        self.x = x
        z = self._unfolded(self.layers[0])
        if self.member_bias is not None:
            z.add_(self.member_bias)
        return z

    def first_weights(self, rows: th.Tensor) -> th.Tensor:
        """
        :param rows: (m, k), see :meth:`StackedMLP.first_layer_rows`
        :return: (m, k, hidden)
        """
        return self.by_row.index_select(0, rows.view(-1)).view(*rows.shape, self.width)

    def rest(self) -> th.Tensor:
        """
        The layers after the first.

        :return: (members, batch, out)
        """
        self.graphs.clear()
        self.normed.clear()
        for i, (weight, bias) in enumerate(self.weights):
            if self.norms:
                self._norm(i)
            self._layer(self._activate(self.layers[i]), weight, bias, self.layers[i + 1])
        return self._unfolded(self.layers[-1])

    def regress(self, x: th.Tensor, targets: th.Tensor, weights: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        The losses Σ weights · (targets − values)², summed over the rows, and their gradients into the parameters' ``grad``.

        :param x: as for :meth:`StackedMLP.forward`
        :param targets: (members, batch, out)
        :param weights: of each, (members, batch, out)
        :return: the errors, targets − values (members, batch, out); the losses (members, out)
        """
        errors = targets - self.values(x)
        weighted = errors * weights
        losses = (weighted * errors).sum(1)
        self.backward(weighted.mul_(-2))
        return errors, losses

    def backward(self, gradient: th.Tensor, parameters: bool = True) -> th.Tensor:
        """
        Backpropagation, once after each evaluation.

        :param gradient: of the loss, at the values (members, batch, out)
        :param parameters: write the gradients of the parameters into their ``grad``
        :return: the gradient at the pre-activations of the first layer (members, batch, hidden)
        """
        gradient = self._folded(gradient)
        if not self.weights:
            self.gradients[0].copy_(gradient)
        self._through_layers(gradient, parameters)
        if parameters:
            self._write_first_gradients()
        return self._unfolded(self.gradients[0])

    def _through_layers(self, gradient: th.Tensor, parameters: bool) -> None:
        """The layers after the first, the last one first."""
        for i in reversed(range(len(self.weights))):
            if parameters:
                self._write_gradients(self._hidden(i), gradient, *self.parameters[i])
            weight = self.transposed[i] if self.members is None else self.transposed[i][self.members]
            gradient = th.bmm(gradient, weight, out=self.gradients[i])
            self._through_activation(i, gradient, parameters)
            if self.norms:
                self._through_norm(i, gradient, parameters)

    def _folded(self, values: th.Tensor) -> th.Tensor:
        """(members, batch, …) → (networks, rows, …)."""
        return values.reshape(*self.shape, values.shape[2]) if self.folds else values

    def _unfolded(self, values: th.Tensor) -> th.Tensor:
        return values.view(self.stack.n_members, self.batch, values.shape[2]) if self.folds else values

    def _layer(self, x: th.Tensor, weight: th.Tensor, bias: th.Tensor, out: th.Tensor) -> None:
        if self.members is not None:
            weight, bias = weight[self.members], bias[self.members]
        th.baddbmm(bias, x, weight, out=out)

    def _write_gradients(self, x: th.Tensor, gradient: th.Tensor, weight: nn.Parameter, bias: nn.Parameter) -> None:
        """Of a layer with input ``x``, from the gradient at its output."""
        if (into := gradient_of(weight)) is not None:
            if self.members is None:
                th.bmm(x.transpose(1, 2), gradient, out=into)
            else:
                into.zero_().index_add_(0, self.members, th.bmm(x.transpose(1, 2), gradient))
        self._write_sum(gradient, bias)

    def _write_sum(self, gradient: th.Tensor, parameter: nn.Parameter) -> None:
        """Of a parameter that every row meets, (networks, 1, features), from the rows' gradients."""
        if (into := gradient_of(parameter)) is not None:
            if self.members is None:
                th.sum(gradient, dim=1, keepdim=True, out=into)
            else:
                into.zero_().index_add_(0, self.members, gradient.sum(1, keepdim=True))

    def _write_first_gradients(self) -> None:
        stack, gradient = self.stack, self.gradients[0]
        if not stack.common_input:
            self._write_gradients(self.x, gradient, stack.first.weight, stack.first.bias)  # type: ignore[arg-type]
        else:
            if (into := gradient_of(stack.first.weight)) is not None:
                if self.wide_rows is None:
                    th.mm(self.x[0].T, self.wide_gradient, out=into[0])
                else:
                    wide = th.mm(self.x[0].T, self.wide_gradient).view(-1, self.width)
                    into.zero_().view(-1, self.width).index_add_(0, self.wide_rows, wide)
            if (into := gradient_of(stack.first.bias)) is not None:
                if self.wide_rows is None:
                    th.sum(self.wide_gradient, dim=0, keepdim=True, out=into[0])
                else:
                    into.zero_().view(-1, self.width).index_add_(0, stack.members, gradient.sum(1))  # type: ignore[arg-type]
        if stack.member_bias is not None and (into := gradient_of(stack.member_bias)) is not None:
            th.sum(self._unfolded(gradient), dim=1, keepdim=True, out=into)

    def _scale(self, i: int) -> tuple[th.Tensor, th.Tensor]:
        """Weight and bias of the i-th norm, by row of its input."""
        weight, bias = (parameter.detach() for parameter in self.norms[i])
        return (weight, bias) if self.members is None else (weight[self.members], bias[self.members])

    def _norm(self, i: int) -> None:
        """Put the normed pre-activations in the place of the i-th ones."""
        z, (weight, bias) = self.layers[i], self._scale(i)
        normed, _, inverse = th.native_layer_norm(z, z.shape[-1:], None, None, NORM_EPS)
        self.normed.append((normed, inverse))
        th.addcmul(bias, normed, weight, out=z)

    def _through_norm(self, i: int, gradient: th.Tensor, parameters: bool) -> None:
        """Turn the gradient behind the i-th norm into the one before it; its outputs are not needed any more."""
        (normed, inverse), (weight, _) = self.normed[i], self._scale(i)
        product = th.mul(gradient, normed, out=self.layers[i])
        if parameters:
            self._write_sum(product, self.norms[i][0])
            self._write_sum(gradient, self.norms[i][1])
        gradient.mul_(weight)
        along = product.mul_(weight).mean(-1, keepdim=True)
        gradient.sub_(gradient.mean(-1, keepdim=True)).addcmul_(normed, along, value=-1).mul_(inverse)

    def _activate(self, z: th.Tensor) -> th.Tensor:
        if self.relu:
            return z.relu_()
        with th.enable_grad():
            leaf = z.detach().requires_grad_()
            hidden = self.stack.activation(leaf.clone())  # it may work in place
        self.graphs.append((leaf, hidden))
        return hidden.detach()

    def _hidden(self, i: int) -> th.Tensor:
        """What the i-th activation gave."""
        return self.layers[i] if self.relu else self.graphs[i][1].detach()

    def _through_activation(self, i: int, gradient: th.Tensor, parameters: bool) -> None:
        """Turn the gradient behind the i-th activation into the one before it."""
        if self.relu:
            _threshold_backward(gradient, self.layers[i], 0, grad_input=gradient)
            return
        leaf, hidden = self.graphs[i]
        if not hidden.requires_grad:  # a step, say
            gradient.zero_()
            return
        own = [p for p in self.stack.activation.parameters() if p.requires_grad] if parameters else []  # such as nn.PReLU's
        before, *found = th.autograd.grad(hidden, [leaf, *own], gradient, allow_unused=True)
        gradient.copy_(before)
        for parameter, part in zip(own, found, strict=True):
            first = i == len(self.weights) - 1  # backpropagation begins at the last activation
            if part is not None:
                parameter.grad = part if first or parameter.grad is None else parameter.grad + part


_threshold_backward = th.ops.aten.threshold_backward.grad_input


def gradient_of(parameter: nn.Parameter) -> th.Tensor | None:
    """The tensor of a parameter's gradient, to be written anew; ``None`` if the parameter is frozen."""
    if not parameter.requires_grad:
        parameter.grad = None
    elif parameter.grad is None:
        parameter.grad = th.empty_like(parameter)
    return parameter.grad
