"""
Many small networks as one: the networks of agents (or teachers) with equal shapes are stacked along a leading axis,
so that evaluating all of them is a handful of batched matrix products instead of a Python loop.

One order everywhere: (networks, batch, features). A stack of n networks computes what n separate ``nn.Sequential``
of ``nn.Linear`` layers would, and is initialised as they are; :meth:`StackedMLP.network` takes one out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise

import torch as th
from torch import nn

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.memory import require_memory

_weights_left: ContextVar[float] = ContextVar("weights_left", default=math.inf)


@contextmanager
def at_most(n_weights: float) -> Iterator[None]:
    """
    Inside, stacks of no more weights than these may be made, all in all: a file cannot ask for networks that it does not hold.

    :raises MemoryError: instead of making more
    """
    token = _weights_left.set(n_weights)
    try:
        yield
    finally:
        _weights_left.reset(token)


class StackedLinear(nn.Module):
    """
    ``n`` linear layers side by side: (n, batch, in) → (n, batch, out).

    :param n: number of layers
    :param in_features: input size of each
    :param out_features: output size of each
    """

    def __init__(self, n: int, in_features: int, out_features: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(in_features)  # the distribution of nn.Linear's own initialisation
        self.weight = nn.Parameter(th.empty(n, in_features, out_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(n, 1, out_features).uniform_(-bound, bound))

    def forward(self, x: th.Tensor, members: th.Tensor | None = None, frozen: bool = False) -> th.Tensor:
        """
        :param x: (n, batch, in)
        :param members: which layer serves each row of ``x``'s first axis; by default layer i serves row i
        :param frozen: give no gradient to the parameters (and spend no time on it)
        """
        weight, bias = (self.weight.detach(), self.bias.detach()) if frozen else (self.weight, self.bias)
        if members is not None:
            weight, bias = weight[members], bias[members]
        return th.baddbmm(bias, x, weight)


class _Chain(th.autograd.Function):
    """
    The layers of a plain ReLU stack as one step of the graph: what autograd would do, in fewer and larger strides.

    Gradients of the parameters are written into the tensors of the last update instead of new ones, which for large networks
    costs more than computing them. A second backward pass through the same stack before an optimiser step therefore replaces
    the first one's gradients; nobody here makes one.
    """

    @staticmethod
    def forward(ctx, x, stack, from_first, *parameters):  # type: ignore[no-untyped-def, override]
        """
        :param x: input of the stack (inputs, batch, in); or with ``from_first=False`` the first layer's pre-activations
        :param stack: the networks
        :param from_first: whether the first layer is part of it
        :param parameters: those that get a gradient; none for frozen networks
        """
        hidden: list[th.Tensor] = []
        z = stack._spread(stack.first(x)) if from_first else x
        for layer in stack.rest:
            hidden.append(z.relu_() if hidden or from_first else z.relu())
            z = th.baddbmm(layer.bias, hidden[-1], layer.weight)
        ctx.stack, ctx.x, ctx.hidden, ctx.frozen = stack, x if from_first else None, hidden, not parameters
        ctx.n_parameters = len(parameters)
        return z

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def, override]
        stack, x = ctx.stack, ctx.x
        for layer, hidden in zip(reversed(stack.rest), reversed(ctx.hidden), strict=True):
            if not ctx.frozen:
                th.bmm(hidden.transpose(1, 2), gradient, out=_gradient_of(layer.weight))
                th.sum(gradient, dim=1, keepdim=True, out=_gradient_of(layer.bias))
            gradient = th.ops.aten.threshold_backward(th.bmm(gradient, layer.weight.transpose(1, 2)), hidden, 0)
        if x is not None and not ctx.frozen:
            wide = stack._gather_up(gradient)  # (inputs, batch, networks per input · hidden)
            th.bmm(x.transpose(1, 2), wide, out=_gradient_of(stack.first.weight))
            th.sum(wide, dim=1, keepdim=True, out=_gradient_of(stack.first.bias))
        needs_input = ctx.needs_input_grad[0]
        if needs_input and x is not None:
            gradient = th.bmm(stack._gather_up(gradient), stack.first.weight.transpose(1, 2))
        return (gradient if needs_input else None, None, None, *([None] * ctx.n_parameters))


def _gradient_of(parameter: nn.Parameter) -> th.Tensor:
    """The tensor of a parameter's gradient, to be written anew."""
    if parameter.grad is None:
        parameter.grad = th.empty_like(parameter)
    return parameter.grad


class StackedMLP(nn.Module):
    """
    A stack of multi-layer perceptrons of one shape.

    Networks may read the same input: with ``n_inputs=1`` all of them do, and their first layers are one matrix
    product; with ``n_inputs=K`` consecutive runs of ``n_networks / K`` networks share one of K inputs. By default
    each network has an input of its own.

    Members may share a network: ``members[i]`` is the network that member i uses. Then every member has a
    first-layer bias of its own, which is what appending its one-hot index to the input amounts to; and it may read a
    common input in an order of its own: ``input_order[i][c]`` is the input of its network that takes column c.

    :param n_networks: number of networks
    :param sizes: width of the input, of each hidden layer, and of the output
    :param activation_fn: activation between layers
    :param n_inputs: number of distinct inputs; a divisor of ``n_networks``
    :param members: network of each member; by default member i uses network i
    :param input_order: (members, in) order in which each member reads a common input; only with ``members`` and
        ``n_inputs=1``
    """

    members: th.Tensor | None
    input_order: th.Tensor | None

    def __init__(
        self,
        n_networks: int,
        sizes: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        n_inputs: int | None = None,
        members: Sequence[int] | None = None,
        input_order: th.Tensor | None = None,
    ) -> None:
        super().__init__()
        self.n_networks = n_networks
        self.input_per_member = n_inputs is None
        self.n_inputs = n_networks if n_inputs is None else n_inputs
        self.sizes = list(sizes)
        for size in sizes:
            require_count("the width of a layer", size)
        n_weights = n_networks * sum(n_in * n_out for n_in, n_out in pairwise(sizes))
        _weights_left.set(_weights_left.get() - n_weights)
        if _weights_left.get() < 0:
            raise MemoryError(f"a stack of {n_networks} networks {self.sizes} is more than the file holds")
        require_memory(f"a stack of {n_networks} networks {self.sizes}", 16 * n_weights)  # float32; gradient, two moments
        self.activation = activation_fn()
        self.is_plain = members is None and activation_fn is nn.ReLU
        self.first = StackedLinear(self.n_inputs, sizes[0], n_networks // self.n_inputs * sizes[1])
        self.rest = nn.ModuleList(StackedLinear(n_networks, n_in, n_out) for n_in, n_out in pairwise(sizes[1:]))
        self.member_bias: nn.Parameter | None = None
        self.register_buffer("members", None if members is None else th.tensor(list(members)), persistent=False)
        self.register_buffer("input_order", input_order, persistent=False)
        if members is not None:
            bound = 1 / math.sqrt(sizes[0] + len(members))
            self.member_bias = nn.Parameter(th.empty(len(members), 1, sizes[1]).uniform_(-bound, bound))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: (inputs, batch, in); with own inputs per network: (members, batch, in)
        :return: (members, batch, out)
        """
        if self.is_plain and th.is_grad_enabled():
            return _Chain.apply(x, self, True, *self.parameters())
        return self.after_first_layer(self.first_layer(x))

    def _spread(self, z: th.Tensor) -> th.Tensor:
        """(inputs, batch, networks per input · hidden) → (networks, batch, hidden), a view."""
        if self.n_inputs == self.n_networks:
            return z
        return z.unflatten(-1, (-1, self.sizes[1])).transpose(1, 2).flatten(0, 1)

    def _gather_up(self, z: th.Tensor) -> th.Tensor:
        """Inverse of :meth:`_spread`."""
        if self.n_inputs == self.n_networks:
            return z
        return z.unflatten(0, (self.n_inputs, -1)).transpose(1, 2).flatten(2)

    def first_layer(self, x: th.Tensor) -> th.Tensor:
        """
        Pre-activations of the first layer.

        :param x: as for :meth:`forward`
        :return: (members, batch, hidden)
        """
        width = self.sizes[1]
        if self.input_per_member:
            z = self.first(x, self.members)
        elif self.input_order is not None:
            weight = self._columns(self.first.weight, slice(None), self.input_order)  # (members, in, hidden)
            weight = weight.transpose(0, 1).flatten(1)  # (in, members · hidden): still one product
            z = (x[0] @ weight).unflatten(-1, (-1, width)).transpose(0, 1)
            z = z + self.first.bias.unflatten(-1, (-1, width))[0, 0, self.members].unsqueeze(1)
        else:
            z = self.first(x).unflatten(-1, (-1, width)).transpose(1, 2).flatten(0, 1)  # (networks, batch, hidden)
            z = z if self.members is None else z[self.members]
        return z if self.member_bias is None else z + self.member_bias

    def after_first_layer(self, z: th.Tensor, frozen: bool = False) -> th.Tensor:
        """
        The rest of the networks.

        :param z: (members, batch, hidden), pre-activations of the first layer
        :param frozen: give no gradient to the parameters
        :return: (members, batch, out)
        """
        if self.is_plain and frozen and z.requires_grad:
            return _Chain.apply(z, self, False)
        for layer in self.rest:
            z = layer(self.activation(z), self.members, frozen)
        return z

    def input_columns(self, members: th.Tensor, columns: th.Tensor) -> th.Tensor:
        """
        First-layer weights of some inputs of some members.

        :param members: (m,) numbers of the members
        :param columns: (m, k) positions in the input
        :return: (m, k, hidden), without gradient
        """
        if self.input_order is not None:
            columns = self.input_order[members].gather(1, columns.to(self.input_order.device))
        return self._columns(self.first.weight.detach(), members, columns)

    def _columns(self, weight: th.Tensor, members: th.Tensor | slice, columns: th.Tensor) -> th.Tensor:
        """Rows of the first layer's weight for some members, (members, columns, hidden)."""
        everyone = th.arange(self.n_networks, device=weight.device) if self.members is None else self.members
        networks = everyone[members][:, None]
        if self.input_per_member:
            return weight[networks, columns]
        return weight[0].unflatten(-1, (self.n_networks, self.sizes[1]))[columns, networks]

    def gradient_norms(self) -> th.Tensor:
        """Euclidean norm of each network's gradient: (networks,)."""
        squares = self.first.weight.new_zeros(self.n_networks)
        for layer in [self.first, *self.rest]:
            for parameter in (layer.weight, layer.bias):
                squares += self._network_view(parameter.grad, layer).square().sum((1, 3)).flatten()
        if self.members is not None and self.member_bias is not None and self.member_bias.grad is not None:
            squares.index_add_(0, self.members, self.member_bias.grad.square().sum((1, 2)))
        return squares.sqrt()

    def clip_gradients(self, max_norm: float) -> None:
        """Scale the gradient of each network down to ``max_norm``, as ``clip_grad_norm_`` does for a separate one."""
        scale = (max_norm / (self.gradient_norms() + 1e-6)).clamp(max=1.0)
        for layer in [self.first, *self.rest]:
            for parameter in (layer.weight, layer.bias):
                view = self._network_view(parameter.grad, layer)
                view.mul_(scale.view(view.shape[0], 1, view.shape[2], 1))
        if self.member_bias is not None and self.member_bias.grad is not None:
            self.member_bias.grad.mul_(scale[self.members].view(-1, 1, 1))

    def _network_view(self, tensor: th.Tensor | None, layer: StackedLinear) -> th.Tensor:
        """A parameter, or its gradient, viewed as (inputs, rows, networks per input, columns)."""
        assert tensor is not None, "no gradient yet"
        if layer is self.first:
            return tensor.unflatten(-1, (self.n_networks // self.n_inputs, self.sizes[1]))
        return tensor.unsqueeze(2)

    @th.no_grad()
    def network(self, index: int) -> nn.Sequential:
        """
        One network of the stack as separate ``nn.Linear`` layers (a copy).

        :param index: number of the member
        """
        net = index if self.members is None else int(self.members[index])
        per_input = self.n_networks // self.n_inputs
        columns = slice(net % per_input * self.sizes[1], (net % per_input + 1) * self.sizes[1])
        first_weight = self.first.weight[net // per_input][:, columns]
        if self.input_order is not None:
            first_weight = first_weight[self.input_order[index]]
        weights = [(first_weight, self.first.bias[net // per_input, 0, columns].clone())]
        if self.member_bias is not None:
            weights[0][1].add_(self.member_bias[index, 0])
        weights += [(layer.weight[net], layer.bias[net, 0]) for layer in self.rest]  # type: ignore[index]
        layers: list[nn.Module] = []
        for weight, bias in weights:
            linear = nn.Linear(weight.shape[0], weight.shape[1])
            linear.weight.copy_(weight.T)
            linear.bias.copy_(bias)
            layers += [linear, type(self.activation)()]
        return nn.Sequential(*layers[:-1])
