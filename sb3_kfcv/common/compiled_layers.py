"""
Layers of many small networks, forward and backward, as compiled loops: network after network, so that what one layer writes
the next one finds in the processor's cache, and without handing each step of each layer to PyTorch.

The arithmetic is that of :class:`~sb3_kfcv.common.backpropagation.Evaluation`. Every sum of products runs over its terms in
their order, one fused multiplication and addition each, on every processor.
"""

from __future__ import annotations

import platform
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from sb3_kfcv.common.kernels import kernel

FLOAT, INTEGER = 4, 8
"""Bytes of a number."""

LAYER = np.dtype(
    [
        (name, np.int64)
        for name in (
            # Addresses, and strides counted in numbers, of float32 tensors whose rows are contiguous; address 0: nothing.
            *("x", "x_member", "x_row", "x_gradient"),  # what it reads, (members, rows, in), and its gradient
            *("z", "z_member", "z_row"),  # what it gives, (members, rows, out)
            *("z_gradient", "z_gradient_member", "z_gradient_row"),
            *("weight", "bias", "weight_gradient", "bias_gradient"),  # (networks, in, out) and (networks, 1, out)
            "weight_rows",  # int64 (members, in): where in the weights, seen as rows (…, out), those of each input stand
            *("member_bias", "member_bias_gradient"),  # (members, 1, out), beside the network's
            *("n_in", "n_out"),
        )
    ]
)
"""A layer of a stack. The gradient of what it reads lies as that itself does."""

OWN_INPUTS = np.dtype([(name, np.int64) for name in ("block", "number", "column", "size")])
"""
Of a member: where its own inputs are, a block (members of the block, rows, size) and its number there; from which column on
they stand in place of those in the common input, and how many.
"""

_FEATURES = llvm.get_host_cpu_features()

FUSED = platform.machine().lower() in ("aarch64", "arm64") or bool(_FEATURES.get("fma"))
"""Whether the processor multiplies and adds in one; where it does not, these loops are slow."""

# Rows of a tile: eight vectors of sums keep the processor busy, and a row of 16 numbers is one vector or two.
ROWS = 8 if _FEATURES.get("avx512f") else 4

# Rows whose sum is one running sum.
BLOCK = 128


def _tile(n_rows: int, n_columns: int) -> Any:
    """
    The function C += A B for a tile of C that stays in registers.

    Its arguments are integers: of A the address and the strides from row to row and from column to column, of B the address
    and the stride from row to row, the number of A's columns, of C the address and the stride from row to row.
    """

    @intrinsic
    def add_to_tile(typing_context, a, a_row, a_column, b, b_row, depth, c, c_row):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            a, a_row, a_column, b, b_row, depth, c, c_row = arguments
            integer, number = ir.IntType(64), ir.FloatType()
            vector = ir.VectorType(number, n_columns)
            name = f"llvm.fma.v{n_columns}f32"
            fma = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector] * 3), name)
            nothing, first = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), n_columns), None)

            def address(start, *steps):  # type: ignore[no-untyped-def]
                for count, stride in steps:
                    start = builder.add(start, builder.mul(builder.mul(count, stride), ir.Constant(integer, FLOAT)))
                return start

            def pointer(kind, start, *steps):  # type: ignore[no-untyped-def]
                return builder.inttoptr(address(start, *steps), kind.as_pointer())

            rows = [ir.Constant(integer, row) for row in range(n_rows)]
            places = [pointer(vector, c, (row, c_row)) for row in rows]
            before = [builder.load(place, align=FLOAT) for place in places]

            entry = builder.block
            loop, done = builder.append_basic_block("depth"), builder.append_basic_block("done")
            builder.branch(loop)
            builder.position_at_end(loop)
            k = builder.phi(integer)
            k.add_incoming(ir.Constant(integer, 0), entry)
            sums = [builder.phi(vector) for _ in rows]
            read = builder.load(pointer(vector, b, (k, b_row)), align=FLOAT)
            after = []
            for row, total in zip(rows, sums, strict=True):
                factor = builder.load(pointer(number, a, (row, a_row), (k, a_column)), align=FLOAT)
                one = builder.insert_element(nothing, factor, ir.Constant(ir.IntType(32), 0))
                after.append(builder.call(fma, [builder.shuffle_vector(one, nothing, first), read, total]))
            following = builder.add(k, ir.Constant(integer, 1))
            k.add_incoming(following, loop)
            for total, start, end in zip(sums, before, after, strict=True):
                total.add_incoming(start, entry)
                total.add_incoming(end, loop)
            builder.cbranch(builder.icmp_signed("<", following, depth), loop, done)
            builder.position_at_end(done)
            for place, end in zip(places, after, strict=True):
                builder.store(end, place, align=FLOAT)
            return context.get_dummy_value()

        return types.void(*[types.int64] * 8), generate

    return add_to_tile


def _strip(n_columns: int) -> Any:
    """The same for all rows of C, tile by tile and then row by row."""
    tile, row = _tile(ROWS, n_columns), _tile(1, n_columns)

    def add_to_strip(a, a_row, a_column, b, b_row, c, c_row, n_rows, depth):  # type: ignore[no-untyped-def]
        i = 0
        while i + ROWS <= n_rows:
            tile(a + FLOAT * i * a_row, a_row, a_column, b, b_row, depth, c + FLOAT * i * c_row, c_row)
            i += ROWS
        while i < n_rows:
            row(a + FLOAT * i * a_row, a_row, a_column, b, b_row, depth, c + FLOAT * i * c_row, c_row)
            i += 1

    # Compiled code knows a function by its name and a number that every process gives anew: where several have one name, code
    # from the disk would be taken for that of another one.
    add_to_strip.__name__ = add_to_strip.__qualname__ = f"add_to_strip_of_{n_columns}"
    return njit(add_to_strip)  # on the disk as a part of what calls it


_strip_of_16, _strip_of_4, _strip_of_1 = (_strip(columns) for columns in (16, 4, 1))


def _reader(kind: types.Type) -> Any:
    """The function that gives the numbers at an address, to be indexed."""

    @intrinsic
    def numbers_at(typing_context, address):  # type: ignore[no-untyped-def]
        signature = types.CPointer(kind)(types.int64)

        def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

        return signature, generate

    return numbers_at


_numbers_at, _integers_at = _reader(types.float32), _reader(types.int64)


@kernel
def add_product(a, a_row, a_column, b, b_row, c, c_row, n_rows, depth, n_columns):
    """
    C += A B of matrices at addresses, their strides counted in numbers; the rows of B and C are contiguous.

    :param a: of A (n_rows, depth); ``a_row``, ``a_column``: from row to row, from column to column
    :param b: of B (depth, n_columns); ``b_row``: from row to row
    :param c: of C (n_rows, n_columns); ``c_row``: from row to row
    """
    if depth == 0:
        return
    j = 0
    while j < n_columns:
        left, b_j, c_j = n_columns - j, b + FLOAT * j, c + FLOAT * j
        if left >= 16:
            _strip_of_16(a, a_row, a_column, b_j, b_row, c_j, c_row, n_rows, depth)
            j += 16
        elif left >= 4:
            _strip_of_4(a, a_row, a_column, b_j, b_row, c_j, c_row, n_rows, depth)
            j += 4
        else:
            _strip_of_1(a, a_row, a_column, b_j, b_row, c_j, c_row, n_rows, depth)
            j += 1


@kernel
def _fill(address, row, n_rows, n_columns, values):
    """Set every row to the numbers at ``values``, or to 0 where that is 0."""
    source = _numbers_at(values)
    for i in range(n_rows):
        into = _numbers_at(address + FLOAT * i * row)
        if values == 0:
            for j in range(n_columns):
                into[j] = np.float32(0)
        else:
            for j in range(n_columns):
                into[j] = source[j]


@kernel
def _rectify(address, row, n_rows, n_columns):
    """ReLU in place; what is not a number stays so, and -inf becomes one."""
    for i in range(n_rows):
        z = _numbers_at(address + FLOAT * i * row)
        for j in range(n_columns):
            z[j] *= np.float32(not z[j] < 0)  # a product, since choices are not compiled to vectors


@kernel
def _through_rectifier(gradient, hidden, row, n_rows, n_columns):
    """Turn the gradient behind a ReLU, whose outputs are given and lie alike, into the one before it; it should be finite."""
    for i in range(n_rows):
        g, h = _numbers_at(gradient + FLOAT * i * row), _numbers_at(hidden + FLOAT * i * row)
        for j in range(n_columns):
            g[j] *= np.float32(not h[j] <= 0)


@kernel
def _add_sums(rows, row, n_rows, n_columns, into, one, scratch):
    """
    Add the sums of columns; of many rows in blocks, so that a long sum does not swallow its last terms.

    :param rows: of the matrix; ``row``: from row to row
    :param into: added to, (n_columns,)
    :param one: address of a one
    :param scratch: of room for a row
    """
    sums, block = _numbers_at(into), _numbers_at(scratch)
    for start in range(0, n_rows, BLOCK):
        _fill(scratch, n_columns, 1, n_columns, 0)
        first, length = rows + FLOAT * start * row, min(BLOCK, n_rows - start)
        add_product(one, 0, 0, first, row, scratch, n_columns, 1, length, n_columns)
        for j in range(n_columns):
            sums[j] += block[j]


@kernel
def _transpose(matrix, n_rows, n_columns, into):
    """Of a contiguous matrix."""
    read, written = _numbers_at(matrix), _numbers_at(into)
    for i in range(n_rows):
        for j in range(n_columns):
            written[j * n_rows + i] = read[i * n_columns + j]


@kernel
def _gather_rows(matrix, rows, n_rows, n_columns, into):
    """Some rows of a contiguous matrix, by their numbers."""
    read, written, numbers = _numbers_at(matrix), _numbers_at(into), _integers_at(rows)
    for i in range(n_rows):
        start = numbers[i] * n_columns
        for j in range(n_columns):
            written[i * n_columns + j] = read[start + j]


@kernel
def _add_to_rows(matrix, rows, n_rows, n_columns, added):
    """Add a contiguous matrix to some rows of another one, by their numbers."""
    written, read, numbers = _numbers_at(matrix), _numbers_at(added), _integers_at(rows)
    for i in range(n_rows):
        start = numbers[i] * n_columns
        for j in range(n_columns):
            written[start + j] += read[i * n_columns + j]


@kernel
def _add(numbers, added, n):
    """Add numbers to others."""
    written, read = _numbers_at(numbers), _numbers_at(added)
    for i in range(n):
        written[i] += read[i]


@kernel
def forward(layers, members, n_rows, rectify_first, scratch):
    """
    Evaluate consecutive layers.

    :param layers: array of ``LAYER``
    :param members: network of each member
    :param n_rows: rows of each member
    :param rectify_first: whether what the first layer reads is to go through a ReLU, as what all others read
    :param scratch: room for the longest row, and for the weights of a layer with ``weight_rows``
    """
    room = scratch.ctypes.data
    for member, network in enumerate(members):
        for i in range(len(layers)):
            layer = layers[i]
            x, z = layer.x + FLOAT * member * layer.x_member, layer.z + FLOAT * member * layer.z_member
            if i > 0 or rectify_first:
                _rectify(x, layer.x_row, n_rows, layer.n_in)
            _through_layer(layer, member, network, x, layer.x_row, z, layer.z_row, n_rows, room)


@kernel
def _through_layer(layer, member, network, x, x_row, z, z_row, n_rows, room):
    """
    One layer of a member.

    :param x: what it reads; ``x_row``: from row to row
    :param z: where it writes; ``z_row``: from row to row
    :param room: as the scratch of :func:`forward`
    """
    size = FLOAT * layer.n_out
    bias = layer.bias + network * size
    if layer.member_bias:
        _fill(room, layer.n_out, 1, layer.n_out, bias)
        _add(room, layer.member_bias + member * size, layer.n_out)
        bias = room
    _fill(z, z_row, n_rows, layer.n_out, bias)
    weight = layer.weight + network * layer.n_in * size
    if layer.weight_rows:
        _gather_rows(layer.weight, layer.weight_rows + INTEGER * member * layer.n_in, layer.n_in, layer.n_out, room)
        weight = room
    add_product(x, x_row, 1, weight, layer.n_out, z, z_row, n_rows, layer.n_in, layer.n_out)


@kernel(nogil=True)
def forward_alone(layers, members, networks, n_rows, x, out, scratch):
    """
    The values of some members, and nothing else.

    :param layers: array of ``LAYER``, all of a stack with inputs of its members' own; its parameters are read, no places
    :param members: numbers of the members (m,)
    :param networks: network of each member of the stack
    :param n_rows: rows of each
    :param x: address of the inputs (m, rows, in), and the strides from member to member and from row to row
    :param out: address of the values (m, rows, out)
    :param scratch: room for the widest layer: for one row, and twice for all rows of a member
    """
    x, x_member, x_row = x
    room = scratch.ctypes.data
    widest = len(scratch) // (1 + 2 * n_rows)
    hidden = room + FLOAT * widest
    for place, member in enumerate(members):
        read, row = x + FLOAT * place * x_member, x_row
        for i in range(len(layers)):
            layer = layers[i]
            if i > 0:
                _rectify(read, row, n_rows, layer.n_in)
            into = hidden + FLOAT * (i % 2) * n_rows * widest
            if i == len(layers) - 1:
                into = out + FLOAT * place * n_rows * layer.n_out
            _through_layer(layer, member, networks[member], read, row, into, layer.n_out, n_rows, room)
            read, row = into, layer.n_out


@kernel
def backward(layers, members, n_networks, n_rows, scratch):
    """
    Backpropagation from the last layer's ``z_gradient``: write the gradients of weights, biases and inputs where they have an
    address. What a layer reads is taken to have come out of a ReLU if its gradient has an address, and that becomes the
    gradient before the ReLU.

    :param layers: array of ``LAYER``, evaluated
    :param members: network of each member
    :param n_networks: number of networks
    :param n_rows: rows of each member
    :param scratch: room for the largest ``n_out``, and for ``n_in * n_out`` where there is an ``x_gradient`` or
        ``weight_rows``, and behind it a one
    """
    room = scratch.ctypes.data
    one = room + FLOAT * (len(scratch) - 1)
    for layer in layers:
        if layer.weight_gradient:
            _fill(layer.weight_gradient, layer.n_out, n_networks * layer.n_in, layer.n_out, 0)
        if layer.bias_gradient:
            _fill(layer.bias_gradient, layer.n_out, n_networks, layer.n_out, 0)
    for member, network in enumerate(members):
        for i in range(len(layers) - 1, -1, -1):
            layer = layers[i]
            n_in, n_out, size = layer.n_in, layer.n_out, FLOAT * layer.n_out
            x = layer.x + FLOAT * member * layer.x_member
            gradient, row = layer.z_gradient + FLOAT * member * layer.z_gradient_member, layer.z_gradient_row
            if layer.weight_gradient:
                into = layer.weight_gradient + network * n_in * size
                if layer.weight_rows:
                    _fill(room, n_out, n_in, n_out, 0)
                    into = room
                add_product(x, 1, layer.x_row, gradient, row, into, n_out, n_in, n_rows, n_out)
                if layer.weight_rows:
                    _add_to_rows(layer.weight_gradient, layer.weight_rows + INTEGER * member * n_in, n_in, n_out, room)
            if layer.bias_gradient:
                _add_sums(gradient, row, n_rows, n_out, layer.bias_gradient + network * size, one, room)
            if layer.member_bias_gradient:
                into = layer.member_bias_gradient + member * size
                _fill(into, n_out, 1, n_out, 0)
                _add_sums(gradient, row, n_rows, n_out, into, one, room)
            if layer.x_gradient:
                into = layer.x_gradient + FLOAT * member * layer.x_member
                _transpose(layer.weight + network * n_in * size, n_in, n_out, room)
                _fill(into, layer.x_row, n_rows, n_in, 0)
                add_product(gradient, row, 1, room, n_in, into, layer.x_row, n_rows, n_out, n_in)
                _through_rectifier(into, x, layer.x_row, n_rows, n_in)


@kernel
def regress(layers, members, n_networks, n_rows, fit, scratch):
    """
    Evaluate, and go back from the losses Σ weights · (targets − values)², summed over the rows.

    :param layers: array of ``LAYER``, all of a stack; the last one's ``z_gradient`` is written
    :param members: network of each member
    :param n_networks: number of networks
    :param n_rows: rows of each member
    :param fit: targets and their weights (members, rows, out); where the errors, targets − values, are written (members, rows,
        out), and where the losses (members, out)
    :param scratch: as for :func:`forward` and :func:`backward`
    """
    targets, weights, errors, losses = fit
    forward(layers, members, n_rows, False, scratch)
    last = layers[len(layers) - 1]
    for member in range(len(members)):
        for k in range(last.n_out):
            loss = 0.0
            for i in range(n_rows):
                value = _numbers_at(last.z + FLOAT * (member * last.z_member + i * last.z_row))[k]
                gradient = _numbers_at(last.z_gradient + FLOAT * (member * last.z_gradient_member + i * last.z_gradient_row))
                error = targets[member, i, k] - value
                weighted = error * weights[member, i, k]
                errors[member, i, k] = error
                gradient[k] = np.float32(-2) * weighted
                loss += weighted * error
            losses[member, k] = loss
    backward(layers, members, n_networks, n_rows, scratch)


@kernel
def ascend(firsts, rest, members, n_networks, n_rows, climb, scratch):
    """
    Evaluate with own inputs, and go back to them from the losses −Σ weights · values, summed over the rows, of one value each.

    The first layer is computed as for the common input; own inputs move it by (new − old) · (their weights).

    :param firsts: array of ``LAYER``: the first one of a stack, with ``weight_rows``
    :param rest: array of ``LAYER``: the others, without gradients of parameters; the last one's ``z_gradient`` is written
    :param members: network of each member
    :param n_networks: number of networks
    :param n_rows: rows of each member
    :param climb: array of ``OWN_INPUTS`` (members,); addresses of the blocks of own inputs and of those of their gradients
        (2, blocks); weight of each value (members, rows); where the losses are written (members,); room for the most own
        inputs of a member times (2 hidden + rows)
    :param scratch: as for :func:`forward` and :func:`backward`
    """
    own_inputs, blocks, weights, losses, room = climb
    first, last = firsts[0], rest[len(rest) - 1]
    hidden = first.n_out
    own_weights = room.ctypes.data
    transposed = own_weights + FLOAT * hidden * (room.size // (2 * hidden + n_rows))
    moved = transposed + transposed - own_weights

    forward(firsts, members, n_rows, False, scratch)
    for member in range(len(members)):
        own = own_inputs[member]
        rows = first.weight_rows + INTEGER * (member * first.n_in + own.column)
        _gather_rows(first.weight, rows, own.size, hidden, own_weights)
        new, difference = _numbers_at(blocks[0, own.block] + FLOAT * own.number * n_rows * own.size), _numbers_at(moved)
        for i in range(n_rows):
            old = _numbers_at(first.x + FLOAT * (member * first.x_member + i * first.x_row + own.column))
            for j in range(own.size):
                difference[i * own.size + j] = new[i * own.size + j] - old[j]
        z = first.z + FLOAT * member * first.z_member
        add_product(moved, own.size, 1, own_weights, hidden, z, first.z_row, n_rows, own.size, hidden)
    forward(rest, members, n_rows, True, scratch)

    for member in range(len(members)):
        loss = 0.0
        for i in range(n_rows):
            value = _numbers_at(last.z + FLOAT * (member * last.z_member + i * last.z_row))[0]
            gradient = _numbers_at(last.z_gradient + FLOAT * (member * last.z_gradient_member + i * last.z_gradient_row))
            loss -= weights[member, i] * value
            gradient[0] = -weights[member, i]
        losses[member] = loss
    backward(rest, members, n_networks, n_rows, scratch)

    for member in range(len(members)):
        own = own_inputs[member]
        rows = first.weight_rows + INTEGER * (member * first.n_in + own.column)
        _gather_rows(first.weight, rows, own.size, hidden, own_weights)
        _transpose(own_weights, own.size, hidden, transposed)
        into = blocks[1, own.block] + FLOAT * own.number * n_rows * own.size
        _fill(into, own.size, n_rows, own.size, 0)
        at_first, row = first.z_gradient + FLOAT * member * first.z_gradient_member, first.z_gradient_row
        add_product(at_first, row, 1, transposed, own.size, into, own.size, n_rows, hidden, own.size)
