"""
Many small networks as one: the networks of agents (or teachers) with equal shapes are stacked along a leading axis,
so that evaluating all of them is a handful of batched matrix products instead of a Python loop.

One order everywhere: (networks, batch, features). A stack of n networks computes what n separate ``nn.Sequential``
of ``nn.Linear`` layers would, and is initialised as they are; :meth:`StackedMLP.network` takes one out.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from typing import Any

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_kfcv.common.backpropagation import NORM_EPS, Evaluation
from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.compiled_backpropagation import CompiledEvaluation, CompiledValues, serves
from sb3_kfcv.common.memory import require_memory

# Minibatch sizes whose tensors a stack keeps: that of a learner, and those of a refresh's chunks (the last one is shorter).
SIZES_KEPT = 3

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


def _is_watched() -> bool:
    """Whether somebody follows each of PyTorch's operations: an export, a counter, a transformation of functions."""
    return bool(
        th.jit.is_tracing()
        or th.compiler.is_compiling()
        or th._C._len_torch_dispatch_stack()
        or th._C._functorch.peek_interpreter_stack()
    )


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

    def forward(self, x: th.Tensor, members: th.Tensor | None = None) -> th.Tensor:
        """
        :param x: (n, batch, in)
        :param members: which layer serves each row of ``x``'s first axis; by default layer i serves row i
        """
        if members is None:
            return th.baddbmm(self.bias, x, self.weight)
        return th.baddbmm(self.bias[members], x, self.weight[members])


class StackedLayerNorm(nn.Module):
    """
    ``n`` layer norms side by side: (n, batch, size) → (n, batch, size), initialised as ``nn.LayerNorm``.

    :param n: number of norms
    :param size: features of each
    """

    def __init__(self, n: int, size: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(th.ones(n, 1, size))
        self.bias = nn.Parameter(th.zeros(n, 1, size))

    def forward(self, z: th.Tensor, members: th.Tensor | None = None) -> th.Tensor:
        """
        :param z: (n, batch, size)
        :param members: as for :meth:`StackedLinear.forward`
        """
        normed = F.layer_norm(z, z.shape[-1:], eps=NORM_EPS)
        if members is None:
            return th.addcmul(self.bias, normed, self.weight)
        return th.addcmul(self.bias[members], normed, self.weight[members])

    @th.no_grad()
    def network(self, index: int) -> nn.LayerNorm:
        """
        One norm as a separate ``nn.LayerNorm`` (a copy).

        :param index: its number
        """
        norm = nn.LayerNorm(self.weight.shape[-1], eps=NORM_EPS)
        norm.weight.copy_(self.weight[index, 0])
        norm.bias.copy_(self.bias[index, 0])
        return norm


class StackedMLP(nn.Module):
    """
    A stack of multi-layer perceptrons of one shape.

    Each network has an input of its own, or all read the same (``common_input``); then their first layers are one matrix
    product.

    Members may share a network: ``members[i]`` is the network that member i uses. Then every member has a
    first-layer bias of its own, which is what appending its one-hot index to the input amounts to; and it may read a
    common input in an order of its own: ``input_order[i][c]`` is the input of its network that takes column c.

    :meth:`forward` is plain PyTorch; :meth:`evaluate` and :meth:`backward` give the same values and gradients faster, see
    :class:`Evaluation`, and :meth:`values` the values alone.

    :param n_networks: number of networks
    :param sizes: width of the input, of each hidden layer, and of the output
    :param activation_fn: activation between layers
    :param common_input: whether all read the same input
    :param members: network of each member; by default member i uses network i
    :param input_order: (members, in) order in which each member reads a common input; only with ``members``
    :param layer_norm: whether a layer norm stands before each activation
    :raises ValueError: if ``layer_norm`` is neither yes nor no, or a member uses a network that there is not
    """

    members: th.Tensor | None
    wide_rows: th.Tensor | None

    def __init__(
        self,
        n_networks: int,
        sizes: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        common_input: bool = False,
        members: Sequence[int] | None = None,
        input_order: th.Tensor | None = None,
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        if type(layer_norm) is not bool:
            raise ValueError(f"layer_norm is yes or no (True or False), not {layer_norm!r}")
        self.n_networks = n_networks
        self.n_members = n_networks if members is None else len(members)
        if members is not None and not set(members) <= set(range(n_networks)):
            raise ValueError(f"members name networks from 0 to {n_networks - 1}; got {list(members)}")
        self.common_input = common_input
        self.sizes = list(sizes)
        for size in sizes:
            require_count("the width of a layer", size)
        n_weights = n_networks * sum(n_in * n_out for n_in, n_out in pairwise(sizes))
        _weights_left.set(_weights_left.get() - n_weights)
        if _weights_left.get() < 0:
            raise MemoryError(f"a stack of {n_networks} networks {self.sizes} is more than the file holds")
        require_memory(f"a stack of {n_networks} networks {self.sizes}", 16 * n_weights)  # float32; gradient, two moments
        self.activation = activation_fn()
        self.first = StackedLinear(1 if common_input else n_networks, sizes[0], sizes[1] * (n_networks if common_input else 1))
        self.rest = nn.ModuleList(StackedLinear(n_networks, n_in, n_out) for n_in, n_out in pairwise(sizes[1:]))
        self.norms = nn.ModuleList(StackedLayerNorm(n_networks, size) for size in sizes[1:-1] if layer_norm)
        self.member_bias: nn.Parameter | None = None
        self._evaluations: dict[int, Evaluation] = {}  # by batch size
        self._values: CompiledValues | None = None
        self._lender: tuple[StackedMLP, ...] = ()
        self.register_buffer("members", None if members is None else th.tensor(list(members)), persistent=False)
        # Where as many consecutive members share each network, their rows are one longer minibatch of the network.
        per_network, rest = divmod(self.n_members, n_networks)
        runs = [i for i in range(n_networks) for _ in range(per_network)]
        self.folds = members is not None and list(members) == runs and rest == 0 and not common_input
        wide_rows = None
        if members is not None:
            bound = 1 / math.sqrt(sizes[0] + len(members))
            self.member_bias = nn.Parameter(th.empty(len(members), 1, sizes[1]).uniform_(-bound, bound))
            if common_input:
                order = th.arange(sizes[0]).repeat(len(members), 1) if input_order is None else input_order
                wide_rows = self._rows(self.members, order).T.flatten()  # type: ignore[arg-type]
        self.register_buffer("wide_rows", wide_rows, persistent=False)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: (members, batch, in); the common input (1, batch, in)
        :return: (members, batch, out)
        """
        if self.common_input:
            weight, bias = self.side_by_side(self.first.weight, self.first.bias)
            z = self.spread(th.addmm(bias, x[0], weight))
        else:
            z = self.first(x, self.members)
        if self.member_bias is not None:
            z = z + self.member_bias
        return self._after_first(z, self.members)

    def one(self, member: int, x: th.Tensor) -> th.Tensor:
        """
        The values of one member alone, of a stack whose members have inputs of their own.

        :param member: its number
        :param x: (batch, in)
        :return: (batch, out)
        """
        number = member if self.members is None else int(self.members[member])
        network: Any = slice(number, number + 1)  # a view of the stack
        z = self.first(x.unsqueeze(0), network)
        if self.member_bias is not None:
            z = z + self.member_bias[member]
        return self._after_first(z, network)[0]

    def values(self, x: th.Tensor, member: int | None = None) -> th.Tensor:
        """
        As :meth:`forward`, or as :meth:`one`, for where no derivative is wanted: by compiled loops if the networks are small
        (where what goes into a ReLU is infinite, they may give what is not a number).

        :param x: (members, batch, in); of one member (batch, in)
        :param member: its number; by default all
        :return: (members, batch, out); of one member (batch, out)
        """
        if not (th.is_grad_enabled() or _is_watched()):
            compiled = self._values
            if compiled is None or not compiled.as_made.holds():
                compiled = self._values = CompiledValues(self)
            found = compiled.of(x) if member is None else compiled.of(x.unsqueeze(0), member)
            if found is not None:
                return found if member is None else found[0]
        return self(x) if member is None else self.one(member, x)

    def layers_are_usual(self) -> bool:
        """Whether its layers and parameters are such as it was made with; what others have put there goes its own way."""
        layers, sizes = [self.first, *self.rest], list(pairwise(self.sizes))
        if type(self) is not StackedMLP or len(layers) != len(sizes) or {type(layer) for layer in layers} != {StackedLinear}:
            return False
        shapes = [(self.n_networks, n_in, n_out) for n_in, n_out in sizes]
        if self.common_input:
            shapes[0] = (1, sizes[0][0], self.n_networks * sizes[0][1])
        wanted: list[tuple[nn.Module, str, tuple[int, ...]]] = []
        for layer, (n, n_in, n_out) in zip(layers, shapes, strict=True):
            wanted += [(layer, "weight", (n, n_in, n_out)), (layer, "bias", (n, 1, n_out))]
        if self.member_bias is not None:
            wanted.append((self, "member_bias", (self.n_members, 1, self.sizes[1])))
        found = [(layer._parameters.get(name), shape) for layer, name, shape in wanted]
        return all(type(parameter) is nn.Parameter and parameter.shape == shape for parameter, shape in found)

    def _after_first(self, z: th.Tensor, members: Any) -> th.Tensor:
        """Outputs, from the pre-activations of the first layer."""
        for i, layer in enumerate(self.rest):
            if self.norms:
                z = self.norms[i](z, members)
            z = layer(self.activation(z), members)
        return z

    def side_by_side(self, weight: th.Tensor, bias: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """First layer of all members on a common input: weight (in, members · hidden), bias (1, members · hidden)."""
        if self.wide_rows is None:
            return weight[0], bias[0]
        width = self.sizes[1]
        wide = weight.view(-1, width).index_select(0, self.wide_rows)
        return wide.view(self.sizes[0], -1), bias.view(-1, width)[self.members].view(1, -1)

    def spread(self, z: th.Tensor) -> th.Tensor:
        """(batch, members · hidden) → (members, batch, hidden), a view."""
        return z.view(len(z), -1, self.sizes[1]).transpose(0, 1)

    def evaluate(self, x: th.Tensor) -> th.Tensor:
        """
        As :meth:`forward`, and remembered for :meth:`backward`.

        :param x: as for :meth:`forward`
        :return: (members, batch, out), overwritten by the next evaluation
        """
        return self.evaluation(x.shape[1]).values(x)

    def backward(self, gradient: th.Tensor) -> None:
        """
        Write the gradients of the parameters into their ``grad``, from the latest :meth:`evaluate` of this batch size, once.

        :param gradient: of the loss, at its values (members, batch, out)
        :raises RuntimeError: if there is none, or the parameters are no longer those of then
        """
        evaluation = self._evaluations.get(gradient.shape[1])
        if evaluation is None or not evaluation.as_made.holds():
            raise RuntimeError(f"evaluate {gradient.shape[1]} rows with these parameters before going back through them")
        evaluation.backward(gradient)

    def regress(self, x: th.Tensor, targets: th.Tensor, weights: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Least squares: write the gradients of Σ weights · (targets − values)² into the parameters' ``grad``, as
        :meth:`evaluate` and :meth:`backward` would.

        :param x: as for :meth:`forward`
        :param targets: (members, batch, out)
        :param weights: of each, (members, batch, out)
        :return: the errors, targets − values (members, batch, out), and the losses, summed over the rows (members, out)
        """
        return self.evaluation(x.shape[1]).regress(x, targets, weights)

    def evaluation(self, batch: int) -> Evaluation:
        """
        The place of evaluations of this size; its tensors are those of the latest one.

        :param batch: rows
        """
        found = self._evaluations.get(batch)
        if found is None or not found.as_made.holds():
            if len(self._evaluations) >= SIZES_KEPT:
                self._evaluations.clear()
            lent = [stack.evaluation(batch) for stack in self._lender]
            kind = CompiledEvaluation if serves(self) else Evaluation
            found = self._evaluations[batch] = kind(self, batch, *lent)
        return found

    def __getstate__(self) -> dict[str, Any]:
        """A copy evaluates in tensors of its own."""
        return {**self.__dict__, "_evaluations": {}, "_values": None}

    def borrow(self, lender: StackedMLP) -> None:
        """
        Evaluate in the tensors of another stack, as a target network can: what is in use stays in the processor's cache.

        :param lender: the other stack; if it is of the same shape and type, each one's evaluation overwrites the other's
        """
        self._lender = (lender,)

    def first_layer_rows(self, members: Sequence[int], columns: th.Tensor) -> th.Tensor:
        """
        Where some inputs' weights stand in the first layer seen as rows, ``first.weight.view(-1, hidden)``.

        :param members: numbers of the members
        :param columns: (len(members), k) positions in the input
        :return: (len(members), k)
        """
        numbers, device = th.tensor(list(members)), self.first.weight.device
        if self.wide_rows is not None:
            return self.wide_rows.view(self.sizes[0], self.n_members)[columns, numbers[:, None]]
        networks = numbers.to(device) if self.members is None else self.members[numbers]
        return self._rows(networks, columns.to(device))

    def _rows(self, networks: th.Tensor, columns: th.Tensor) -> th.Tensor:
        """The same by network (m,) instead of member."""
        if self.common_input:
            return columns * self.n_networks + networks[:, None]
        return networks[:, None] * self.sizes[0] + columns

    def gradient_norms(self) -> th.Tensor:
        """Euclidean norm of each network's gradient: (networks,)."""
        squares = self.first.weight.new_zeros(self.n_networks)
        for gradient in self._gradients():
            squares += gradient.square().sum((1, 3)).flatten()
        if self.members is not None and self.member_bias is not None and self.member_bias.grad is not None:
            squares.index_add_(0, self.members, self.member_bias.grad.square().sum((1, 2)))
        return squares.sqrt()

    def clip_gradients(self, max_norm: float) -> None:
        """Scale the gradient of each network down to ``max_norm``, as ``clip_grad_norm_`` does for a separate one."""
        scale = (max_norm / (self.gradient_norms() + 1e-6)).clamp(max=1.0)
        for gradient in self._gradients():
            gradient.mul_(scale.view(gradient.shape[0], 1, gradient.shape[2], 1))
        if self.member_bias is not None and self.member_bias.grad is not None:
            self.member_bias.grad.mul_(scale[self.members].view(-1, 1, 1))

    def _gradients(self) -> Iterator[th.Tensor]:
        """Of weights and biases that have one, each viewed as (inputs, rows, networks per input, columns)."""
        for layer in [self.first, *self.rest, *self.norms]:
            for parameter in (layer.weight, layer.bias):
                if parameter.grad is not None:
                    yield (
                        parameter.grad.unflatten(-1, (-1, self.sizes[1]))
                        if layer is self.first
                        else parameter.grad.unsqueeze(2)
                    )  # type: ignore[operator]

    @th.no_grad()
    def network(self, index: int) -> nn.Sequential:
        """
        One network of the stack as separate ``nn.Linear`` and ``nn.LayerNorm`` layers (a copy).

        :param index: number of the member
        """
        net = index if self.members is None else int(self.members[index])
        everything = self.first_layer_rows([index], th.arange(self.sizes[0])[None])
        first_bias = self.first.bias.view(-1, self.sizes[1])[net]
        if self.member_bias is not None:
            first_bias = first_bias + self.member_bias[index, 0]
        weights = [(self.first.weight.view(-1, self.sizes[1])[everything[0]], first_bias)]
        weights += [(layer.weight[net], layer.bias[net, 0]) for layer in self.rest]  # type: ignore[index]
        layers: list[nn.Module] = []
        for i, (weight, bias) in enumerate(weights):
            linear = nn.Linear(weight.shape[0], weight.shape[1])
            linear.weight.copy_(weight.T)
            linear.bias.copy_(bias)
            norms = [norm.network(net) for norm in self.norms[i : i + 1]]  # type: ignore[operator]
            layers += [linear, *norms, copy.deepcopy(self.activation)]
        return nn.Sequential(*layers[:-1])
