"""Compiled layers give the values and gradients of PyTorch, at all sizes, and nothing else is read or written."""

import copy
import gc
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch as th
from torch import nn
from torch.fx.experimental.proxy_tensor import make_fx

from sb3_kfcv.common.backpropagation import Evaluation
from sb3_kfcv.common.compiled_backpropagation import WIDEST, WIDEST_COMMON_INPUT, CompiledEvaluation
from sb3_kfcv.common.compiled_layers import add_product
from sb3_kfcv.common.stacked_networks import StackedLinear, StackedMLP


@pytest.fixture(autouse=True)
def seeded():
    th.manual_seed(0)


def assert_close(one, other):
    th.testing.assert_close(one.double(), other, atol=1e-5, rtol=1e-5)


def within(rows, columns, rng):
    """A matrix as a part of a larger one."""
    return rng.standard_normal((rows + 3, columns + 5), dtype=np.float32)[1 : rows + 1, 2 : columns + 2]


@pytest.mark.parametrize("transposed", [False, True], ids=["", "A transposed"])
@pytest.mark.parametrize("columns", [1, 2, 4, 5, 15, 16, 17, 37, 64])
@pytest.mark.parametrize("rows", [1, 3, 8, 13, 64])
@pytest.mark.parametrize("depth", [0, 1, 2, 31])
def test_products_are_added_to_what_is_there(depth, rows, columns, transposed):
    rng = np.random.default_rng(0)
    a = within(depth, rows, rng).T if transposed else within(rows, depth, rng)
    b, c = within(depth, columns, rng), within(rows, columns, rng)
    expected, around = c + a.astype(float) @ b, c.base.copy()
    strides = [stride // 4 for matrix in (a, b, c) for stride in matrix.strides]
    add_product(a.ctypes.data, *strides[:2], b.ctypes.data, strides[2], c.ctypes.data, strides[4], rows, depth, columns)
    np.testing.assert_allclose(c, expected, atol=1e-4)
    around[1 : rows + 1, 2 : columns + 2] = c
    assert np.array_equal(c.base, around)


def test_sums_run_over_their_terms_in_order():
    """Whatever the size of a matrix: the same numbers give the same bits wherever they stand."""
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((37, 50), dtype=np.float32), rng.standard_normal((50, 37), dtype=np.float32)
    b[:], a[:] = b[:, :1], a[:1]
    c = np.zeros((37, 37), np.float32)
    add_product(a.ctypes.data, 50, 1, b.ctypes.data, 37, c.ctypes.data, 37, 37, 50, 37)
    assert len(np.unique(c)) == 1


KINDS = {
    "own inputs": {},
    "a common input": {"common_input": True},
    "shared": {"members": [0, 3, 1, 0, 2]},
    "shared, a common input": {"members": [0, 3, 1, 0, 2], "common_input": True},
    "shared by equal runs": {"members": [i // 2 for i in range(8)]},
}


@pytest.mark.parametrize("batch", [1, 13, 128])
@pytest.mark.parametrize("sizes", [[5, 7, 6, 2], [24, 64, 64, 5], [3, 20, 1], [WIDEST_COMMON_INPUT // 4 + 1, 9, 2]], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_evaluation_and_backward_are_those_of_autograd(kind, sizes, batch):
    """Twice, with other inputs: nothing of the first evaluation is left in the tensors that the second uses again."""
    stack = StackedMLP(4, sizes, **KINDS[kind])
    exact = copy.deepcopy(stack).double()
    for _ in range(2):
        x = th.randn(1 if stack.common_input else stack.n_members, batch, sizes[0])
        gradient = th.randn(stack.n_members, batch, sizes[-1]) / batch
        values = exact(x.double())
        expected = th.autograd.grad(values, list(exact.parameters()), gradient.double())
        assert_close(stack.evaluate(x), values.detach())
        assert isinstance(stack.evaluation(batch), CompiledEvaluation)
        stack.backward(gradient)
        for parameter, theirs in zip(stack.parameters(), expected, strict=True):
            assert_close(parameter.grad, theirs)


@pytest.mark.parametrize("batch", [1, 128])
@pytest.mark.parametrize("sizes", [[5, 7, 6, 2], [WIDEST_COMMON_INPUT // 4 + 1, 9, 2]], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_least_squares_are_those_of_autograd(kind, sizes, batch):
    stack = StackedMLP(4, sizes, **KINDS[kind])
    exact = copy.deepcopy(stack).double()
    for _ in range(2):
        x = th.randn(1 if stack.common_input else stack.n_members, batch, sizes[0])
        # As the learner has them: columns of what lies by rows.
        targets, weights = (th.rand(batch, 2, stack.n_members).permute(2, 0, 1) for _ in range(2))
        errors, losses = stack.regress(x, targets, weights / batch)
        theirs = targets - exact(x.double())
        squares = (weights / batch * theirs.square()).sum(1)
        expected = th.autograd.grad(squares.sum(), list(exact.parameters()))
        assert_close(errors, theirs.detach())
        assert_close(losses, squares.detach())
        for parameter, gradient in zip(stack.parameters(), expected, strict=True):
            assert_close(parameter.grad, gradient)


@pytest.mark.parametrize("changed", ["targets", "weights"])
def test_targets_and_weights_of_another_shape_are_refused(changed):
    given = {"targets": th.zeros(3, 5, 2), "weights": th.ones(3, 5, 2), changed: th.zeros(3, 4, 2)}
    stack = StackedMLP(3, [4, 6, 2])
    with pytest.raises(ValueError, match=r"expected \(3, 5, 2\) on cpu, got \(3, 4, 2\) on cpu"):
        stack.regress(th.zeros(3, 5, 4), **given)
    assert all(parameter.grad is None for parameter in stack.parameters())


@pytest.mark.parametrize("kind", KINDS)
def test_the_gradient_before_the_first_layer_needs_no_gradients_of_parameters(kind):
    stack = StackedMLP(4, [5, 7, 6, 2], **KINDS[kind])
    exact = copy.deepcopy(stack).double()
    evaluation, theirs = stack.evaluation(9), Evaluation(exact, 9)
    x, gradient = th.randn(1 if stack.common_input else stack.n_members, 9, 5), th.randn(stack.n_members, 9, 2)
    for of, convert in ((evaluation, th.Tensor.float), (theirs, th.Tensor.double)):
        of.first_layer(convert(x)).add_(0.1)
        of.rest()
    assert_close(evaluation.backward(gradient, parameters=False), theirs.backward(gradient.double(), parameters=False))
    assert all(parameter.grad is None for parameter in stack.parameters())


def test_inputs_may_lie_apart():
    """Observations of agents are columns of joint rows; what all share is there once; other types are converted."""
    stack = StackedMLP(3, [4, 6, 2])
    rows = th.randn(10, 3 * 4)
    for x in (
        rows.view(10, 3, 4).transpose(0, 1),
        rows[:, :4].expand(3, -1, -1),
        rows[:, ::3].expand(3, -1, -1),
        rows[:, :4].double().expand(3, -1, -1),
    ):
        assert not x.is_contiguous()
        assert_close(stack.evaluate(x), copy.deepcopy(stack).double()(x.double()).detach())


@pytest.mark.parametrize("frozen", ["first", "rest.0", "rest.1"])
def test_frozen_parameters_get_no_gradient(frozen):
    stack = StackedMLP(3, [4, 6, 2, 2])
    stack.get_submodule(frozen).weight.requires_grad_(False)
    stack.evaluate(th.randn(3, 5, 4))
    stack.backward(th.randn(3, 5, 2))
    assert [name for name, parameter in stack.named_parameters() if parameter.grad is None] == [f"{frozen}.weight"]


def test_gradients_that_others_have_set_are_written_into():
    stack = StackedMLP(3, [4, 6, 2])
    x, gradient = th.randn(3, 5, 4), th.randn(3, 5, 2)
    expected = th.autograd.grad(stack(x), stack.rest[0].weight, gradient)[0]
    theirs = th.ones(3, 2, 6)
    stack.rest[0].weight.grad = theirs.transpose(1, 2)
    stack.evaluate(x)
    stack.backward(gradient)
    assert_close(theirs.transpose(1, 2), expected.double())


def test_gradients_that_others_have_turned_are_written_into():
    stack = StackedMLP(3, [4, 6, 6, 2])
    x, gradient = th.randn(3, 5, 4), th.randn(3, 5, 2)
    expected = th.autograd.grad(stack(x), stack.rest[0].weight, gradient)[0]
    for _ in range(2):
        stack.evaluate(x)
        stack.backward(gradient)
        assert_close(stack.rest[0].weight.grad, expected.double())
        stack.rest[0].weight.grad.transpose_(1, 2)


@pytest.mark.skipif(not hasattr(th.Tensor, "grad_dtype"), reason="this PyTorch has gradients of the parameters' type alone")
def test_gradients_may_be_of_another_type():
    stack = StackedMLP(3, [4, 6, 2])
    x, gradient = th.randn(3, 5, 4), th.randn(3, 5, 2)
    expected = th.autograd.grad(stack(x), stack.rest[0].weight, gradient)[0]
    stack.rest[0].weight.grad_dtype = th.float64
    stack.rest[0].weight.grad = th.ones(3, 6, 2, dtype=th.float64)
    stack.evaluate(x)
    stack.backward(gradient)
    assert_close(stack.rest[0].weight.grad, expected.double())


@pytest.mark.parametrize("change", [th.nn.Module.half, th.nn.Module.double], ids=["half", "double"])
def test_there_is_no_way_back_through_parameters_of_another_type(change):
    stack = StackedMLP(8, [64, 64, 64, 8])
    stack.evaluate(th.randn(8, 5, 64))
    change(stack)
    with pytest.raises(RuntimeError, match="evaluate 5 rows with these parameters before going back through them"):
        stack.backward(th.randn(8, 5, 8))


def test_there_is_no_way_back_without_an_evaluation():
    one, other = StackedMLP(3, [4, 6, 2]), StackedMLP(3, [4, 6, 2])
    other.borrow(one)
    with pytest.raises(RuntimeError, match="evaluate 5 rows"):
        one.backward(th.zeros(3, 5, 2))
    other.evaluate(th.randn(3, 5, 4))  # makes an evaluation of the one, too, which has seen no input
    with pytest.raises(ValueError, match=r"expected \(3, 5, 4\) on cpu, got"):
        one.backward(th.zeros(3, 5, 2))


@pytest.mark.parametrize(
    "lender", [{"sizes": [4, 4, 2]}, {"n_networks": 2}, {"common_input": True}, {"double": True}], ids=str
)
def test_tensors_of_another_kind_are_not_borrowed(lender):
    lender = {"n_networks": 3, "sizes": [4, 6, 2], **lender}
    double = lender.pop("double", False)
    other, stack = StackedMLP(**lender), StackedMLP(3, [4, 6, 2])
    stack.borrow(other.double() if double else other)
    x = th.randn(3, 50, 4)
    assert_close(stack.evaluate(x), copy.deepcopy(stack).double()(x.double()).detach())


def test_a_refused_input_leaves_the_latest_one():
    stack = StackedMLP(3, [4, 6, 2])
    x, gradient = th.randn(3, 5, 4), th.randn(3, 5, 2)
    stack.evaluate(x)
    with pytest.raises(ValueError, match="expected"):
        stack.evaluate(x[:, :, :3])
    stack.backward(gradient)
    assert_close(stack.first.weight.grad, th.autograd.grad(stack(x), stack.first.weight, gradient)[0].double())


def test_an_input_that_has_shrunk_is_refused():
    stack = StackedMLP(3, [4, 6, 2])
    x = th.randn(3, 5, 4)
    stack.evaluate(x)
    x.data = th.empty(0)
    with pytest.raises(ValueError, match=r"got \(0,\) on cpu"):
        stack.backward(th.randn(3, 5, 2))


def test_parameters_that_are_replaced_are_met_at_the_next_evaluation():
    stack, x = StackedMLP(3, [4, 6, 6, 2]), th.randn(3, 5, 4)
    stack.evaluate(x)
    stack.rest[0].weight = nn.Parameter(th.randn(3, 6, 6))
    assert_close(stack.evaluate(x), copy.deepcopy(stack).double()(x.double()).detach())
    stack.activation = nn.Tanh()
    assert_close(stack.evaluate(x), copy.deepcopy(stack).double()(x.double()).detach())


@pytest.mark.parametrize("members", [[0, 5], [0, -1]])
def test_members_without_a_network_are_refused(members):
    with pytest.raises(ValueError, match="members name networks from 0 to 1; got"):
        StackedMLP(2, [4, 6, 2], members=members)


def test_sums_of_many_rows_are_as_exact_as_pytorch_s():
    stack = StackedMLP(1, [1, 2, 1])
    gradient = th.full((1, 100_000, 1), 0.1)
    stack.evaluate(th.zeros(1, 100_000, 1))
    stack.backward(gradient)
    assert stack.rest[0].bias.grad.item() == pytest.approx(gradient.double().sum().item(), rel=1e-5)


def test_what_is_not_a_number_stays_so():
    stack = StackedMLP(2, [4, 6, 6, 1])
    x = th.randn(2, 5, 4)
    x[1, 3, 0] = th.nan
    values = stack.evaluate(x)
    assert values.isnan().squeeze(-1).tolist() == [[False] * 5, [False] * 3 + [True, False]]


@pytest.mark.parametrize("shape", [(2, 5, 4), (3, 6, 4), (3, 5, 3)], ids=str)
def test_other_shapes_are_refused(shape):
    stack = StackedMLP(3, [4, 6, 2])
    evaluation = stack.evaluation(5)
    with pytest.raises(ValueError, match=r"expected \(3, 5, 4\) on cpu, got \(\d, \d, \d\) on cpu"):
        evaluation.first_layer(th.zeros(shape))
    stack.evaluate(th.randn(3, 5, 4))
    with pytest.raises(ValueError, match=r"expected \(3, 5, 2\) on cpu, got \(3, 5, 1\) on cpu"):
        stack.backward(th.zeros(3, 5, 1))
    with pytest.raises(ValueError, match=r"on cpu, got .* on meta"):
        stack.evaluate(th.zeros(3, 5, 4, device="meta"))


@pytest.mark.parametrize(
    "change",
    [
        {"activation_fn": nn.Tanh},
        {"layer_norm": True},
        {"sizes": [4, 2]},
        {"sizes": [4, WIDEST + 1, 2]},
    ],
    ids=str,
)
def test_all_other_stacks_are_evaluated_by_pytorch(change):
    stack = StackedMLP(3, **{"sizes": [4, 6, 2], **change})
    assert type(stack.evaluation(5)) is Evaluation


def test_with_more_threads_pytorch_shares_the_work_among_them():
    stack = StackedMLP(3, [4, 6, 2])
    assert type(stack.evaluation(5)) is CompiledEvaluation
    th.set_num_threads(2)
    try:
        assert type(stack.evaluation(5)) is Evaluation
    finally:
        th.set_num_threads(1)
    assert type(stack.evaluation(5)) is CompiledEvaluation
    assert type(stack.double().evaluation(5)) is Evaluation


# Values alone: stacks whose members have inputs of their own, as actors have.
ACTING = {name: kind for name, kind in KINDS.items() if not kind.get("common_input")}


@pytest.fixture
def without_gradients():
    with th.no_grad():
        yield


@pytest.mark.usefixtures("without_gradients")
@pytest.mark.parametrize("batch", [0, 1, 13, 128])
@pytest.mark.parametrize("sizes", [[5, 7, 6, 2], [24, 64, 64, 5], [3, 20, 1]], ids=str)
@pytest.mark.parametrize("kind", ACTING)
def test_values_alone_are_those_of_the_plain_forward(kind, sizes, batch):
    stack = StackedMLP(4, sizes, **ACTING[kind])
    x = th.randn(batch, stack.n_members, sizes[0]).transpose(0, 1)  # as in joint rows
    before = x.clone()
    expected = copy.deepcopy(stack).double()(x.double())
    assert_close(stack.values(x), expected)
    assert not np.array_equal(stack.values(x), stack(x)) or batch <= 1  # they come from other code
    for member in range(stack.n_members):
        assert_close(stack.values(x[member], member), expected[member])
    assert th.equal(x, before)


@pytest.mark.usefixtures("without_gradients")
@pytest.mark.parametrize("kind", ACTING)
def test_a_row_has_the_same_values_among_others_and_alone(kind):
    stack = StackedMLP(4, [24, 64, 64, 5], **ACTING[kind])
    x = th.randn(stack.n_members, 37, 24)
    together = stack.values(x)
    for row in range(37):
        assert th.equal(stack.values(x[:, row : row + 1])[:, 0], together[:, row])
        assert th.equal(stack.values(x[2, row : row + 1], 2)[0], together[2, row])


@pytest.mark.usefixtures("without_gradients")
def test_values_follow_parameters_hooks_and_the_activation():
    stack, other = StackedMLP(3, [5, 8, 2]), StackedMLP(3, [5, 8, 2])
    x, called = th.randn(3, 7, 5), []
    stack.values(x)
    for parameter, new in zip(stack.parameters(), other.parameters(), strict=True):
        parameter.copy_(new)  # where it is
    assert_close(stack.values(x), other.double()(x.double()))
    stack.rest[0].weight = nn.Parameter(th.zeros(3, 8, 2))
    assert th.equal(stack.values(x), stack.rest[0].bias.expand(3, 7, 2))
    hook = stack.rest[0].register_forward_hook(lambda *_: called.append(1))
    stack.values(x)
    assert called
    hook.remove()
    stack.values(x)
    assert len(called) == 1
    stack.rest[0].weight.normal_()
    stack.activation = nn.Tanh()
    assert th.equal(stack.values(x), stack(x))


class Doubled(StackedLinear):
    def forward(self, x, members=None):
        return 2 * super().forward(x, members)


def replace(stack, name, value):
    setattr(stack.rest[0], name, value)


def give_a_plain_weight(stack):
    del stack.rest[0].weight
    stack.rest[0].weight = th.randn(3, 8, 2)


def give_a_buffer(stack):
    del stack.rest[0].weight
    stack.rest[0].register_buffer("weight", th.randn(3, 8, 2))


def give_another_layer(stack, kind):
    stack.rest[0] = kind(3, 8, 2)


def shrink_the_data(stack):
    for parameter in stack.rest[0].parameters():
        parameter.data = parameter.data[..., :1]


def narrow(stack):
    stack.first.weight, stack.first.bias = nn.Parameter(th.randn(3, 5, 4)), nn.Parameter(th.randn(3, 1, 4))
    stack.rest[0].weight = nn.Parameter(th.randn(3, 4, 2))


CHANGES = {
    "weight norm": lambda stack: th.nn.utils.parametrizations.weight_norm(stack.rest[0]),
    "a plain weight": give_a_plain_weight,
    "a layer of the same kind": lambda stack: give_another_layer(stack, StackedLinear),
    "a layer of another kind": lambda stack: give_another_layer(stack, Doubled),
    "data of another shape": shrink_the_data,
    "narrower layers": narrow,
    "a bias that is spread": lambda stack: replace(stack, "bias", nn.Parameter(th.randn(1, 1, 2))),
    "a buffer": give_a_buffer,
    "a subclass of a parameter": lambda stack: replace(stack, "weight", type("Odd", (nn.Parameter,), {})(th.randn(3, 8, 2))),
    "one more layer": lambda stack: stack.rest.append(StackedLinear(3, 2, 2)),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.usefixtures("without_gradients")
@pytest.mark.parametrize("asked_before", [True, False], ids=["asked before", ""])
@pytest.mark.parametrize("change", CHANGES)
def test_values_of_layers_that_others_have_put_there_are_theirs(change, asked_before):
    stack, x = StackedMLP(3, [5, 8, 2]), th.randn(3, 7, 5)
    before = stack.values(x) if asked_before else stack(x)
    CHANGES[change](stack)
    for _ in range(2):
        found, expected = stack.values(x), stack(x)
        th.testing.assert_close(found, expected, atol=1e-6, rtol=1e-5)
        if change == "a plain weight":
            stack.rest[0].weight = th.randn(3, 8, 2)
    assert change == "weight norm" or found.shape != before.shape or not th.allclose(found, before)


@pytest.mark.usefixtures("without_gradients")
def test_hooks_on_all_modules_are_called():
    stack, x, called = StackedMLP(3, [5, 8, 2]), th.randn(3, 7, 5), []
    stack.values(x)
    hook = nn.modules.module.register_module_forward_hook(lambda *_: called.append(1))
    try:
        stack.values(x)
    finally:
        hook.remove()
    assert called


@pytest.mark.usefixtures("without_gradients")
def test_transformations_of_functions_see_the_operations():
    stack, x = StackedMLP(3, [5, 8, 2]), th.randn(3, 7, 5)
    stack.values(x)
    traced = make_fx(lambda x: stack.values(x))(th.randn(3, 7, 5))
    th.testing.assert_close(traced(x), stack(x))
    several = th.randn(2, 3, 7, 5)
    th.testing.assert_close(th.vmap(stack.values)(several), th.stack([stack(x) for x in several]))


@pytest.mark.usefixtures("without_gradients")
def test_a_stack_that_has_acted_is_freed_at_once():
    stack = StackedMLP(3, [5, 8, 2])
    stack.values(th.randn(3, 7, 5))
    alive, collecting = weakref.ref(stack), gc.isenabled()
    gc.disable()
    try:
        del stack
        assert alive() is None
    finally:
        if collecting:
            gc.enable()


def test_values_have_a_gradient_where_one_is_wanted():
    stack = StackedMLP(3, [5, 8, 2])
    stack.values(th.randn(3, 7, 5)).sum().backward()
    assert all(parameter.grad is not None for parameter in stack.parameters())


@pytest.mark.usefixtures("without_gradients")
def test_values_of_other_inputs_are_left_to_pytorch():
    stack = StackedMLP(3, [5, 8, 2])
    for x in (th.randn(3, 7, 5).double(), th.randn(3, 7, 4), th.randn(2, 7, 5)):
        with pytest.raises(RuntimeError):
            stack.values(x)
    turned = th.randn(3, 5, 7).transpose(1, 2)
    assert th.equal(stack.values(turned), stack.values(turned.contiguous()))


class Acting(nn.Module):
    def __init__(self):
        super().__init__()
        self.stack = StackedMLP(3, [5, 8, 2])

    def forward(self, x):
        return self.stack.values(x)


@pytest.mark.filterwarnings("ignore:.*is deprecated:DeprecationWarning")
@pytest.mark.usefixtures("without_gradients")
@pytest.mark.parametrize(
    "taken", [th.jit.trace, lambda acting, x: th.export.export(acting, (x,)).module()], ids=["trace", "export"]
)
def test_what_is_exported_holds_the_networks_and_not_their_values(taken):
    acting = Acting()
    acting(th.randn(3, 7, 5))
    x, exported = th.randn(3, 7, 5), taken(acting, th.randn(3, 7, 5))
    assert_close(exported(x), copy.deepcopy(acting).double().stack(x.double()))


@pytest.mark.usefixtures("without_gradients")
def test_threads_may_ask_for_values_at_once():
    stack = StackedMLP(4, [24, 64, 64, 5])
    inputs = [th.randn(4, 1 + 7 * i, 24) for i in range(4)]
    expected = [stack.values(x) for x in inputs]

    def ask(i):
        with th.no_grad():
            return all(th.equal(stack.values(inputs[i]), expected[i]) for _ in range(300))

    with ThreadPoolExecutor(4) as threads:
        assert all(threads.map(ask, range(4)))


def test_values_leave_an_evaluation_as_it_is():
    stack = StackedMLP(4, [24, 64, 64, 5])
    x, gradient = th.randn(4, 16, 24), th.randn(4, 16, 5)
    stack.evaluate(x)
    stack.backward(gradient)
    expected = [parameter.grad.clone() for parameter in stack.parameters()]
    stack.evaluate(x)
    with th.no_grad():
        stack.values(th.randn(4, 16, 24))
    stack.backward(gradient)
    for parameter, theirs in zip(stack.parameters(), expected, strict=True):
        assert th.equal(parameter.grad, theirs)
