"""A stack of networks is what as many separate networks are: outputs, gradients, Adam steps, clipping."""

import copy
import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from references import one_hot_networks, with_one_hot
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.td3.policies import Actor, ContinuousCritic
from torch import nn

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.stacked_networks import StackedLayerNorm, StackedMLP
from sb3_kfcv.maddpg.policies import OwnObservationCritics, StackedActors, StackedCritics

SIZES = [5, 7, 6, 2]


@pytest.fixture(autouse=True)
def seeded():
    th.manual_seed(0)


def assert_close(one, other, atol=1e-6):
    th.testing.assert_close(one, other, atol=atol, rtol=1e-5)


def separate(stack):
    return [stack.network(i) for i in range(stack.n_networks)]


def spread_inputs(stack, x):
    """What each member reads, from the stack's inputs."""
    return x.expand(stack.n_members, -1, -1)


def scatter_norms(module):
    """Give the layer norms weights and biases that tell them apart; without norms nothing is drawn."""
    for layer in module.modules():
        if isinstance(layer, StackedLayerNorm):
            nn.init.normal_(layer.weight, 1.0, 0.5)
            nn.init.normal_(layer.bias, 0.0, 0.5)
    return module


NORMS = pytest.mark.parametrize("layer_norm", [False, True], ids=["", "layer norm"])
INPUTS = pytest.mark.parametrize("common_input", [False, True], ids=["own inputs", "a common input"])


def stack_and_input(common_input, batch=4, **kwargs):
    stack = scatter_norms(StackedMLP(6, SIZES, common_input=common_input, **kwargs))
    return stack, th.randn(1 if common_input else stack.n_members, batch, SIZES[0])


@NORMS
@INPUTS
def test_outputs_are_those_of_separate_networks(common_input, layer_norm):
    stack, x = stack_and_input(common_input, layer_norm=layer_norm)
    expected = th.stack([net(own) for net, own in zip(separate(stack), spread_inputs(stack, x), strict=True)])
    assert_close(stack(x), expected)
    assert_close(stack.evaluate(x), expected)


@NORMS
@pytest.mark.parametrize("members", [None, [0, 3, 1, 0]])
def test_one_member_alone(members, layer_norm):
    stack, x = stack_and_input(False, members=members, layer_norm=layer_norm)
    for member in range(stack.n_members):
        assert_close(stack.one(member, x[member]), stack(x)[member])


class Leaky(nn.Module):
    """An activation with a parameter of its own."""

    def __init__(self):
        super().__init__()
        self.slope = nn.Parameter(th.tensor(0.3))

    def forward(self, x):
        return th.where(x > 0, x, self.slope * x)


KINDS = {
    "plain": {},
    "tanh": {"activation_fn": nn.Tanh},
    "gelu": {"activation_fn": nn.GELU},
    "parameters in the activation": {"activation_fn": Leaky},
    "shared": {"members": [0, 3, 1, 0, 2, 4, 5, 0]},
    "shared by equal runs": {"members": [i // 2 for i in range(12)]},
    "shared by equal runs, tanh": {"members": [i // 2 for i in range(12)], "activation_fn": nn.Tanh},
    "shared, tanh": {"members": [0, 0, 1, 2, 3, 4, 5, 0], "activation_fn": nn.Tanh},
    "layer norm": {"layer_norm": True},
    "layer norm, tanh": {"layer_norm": True, "activation_fn": nn.Tanh},
    "layer norm, shared": {"layer_norm": True, "members": [0, 3, 1, 0, 2, 4, 5, 0]},
    "layer norm, shared by equal runs": {"layer_norm": True, "members": [i // 2 for i in range(12)]},
}


@pytest.mark.parametrize("hidden", [[7, 6], [7], []], ids=["two hidden layers", "one", "none"])
@pytest.mark.parametrize("kind", KINDS)
@INPUTS
def test_evaluation_and_backward_are_those_of_autograd(common_input, kind, hidden):
    """Twice, with other inputs: nothing of the first evaluation is left in the tensors that the second uses again."""
    stack = scatter_norms(StackedMLP(6, [5, *hidden, 2], common_input=common_input, **KINDS[kind])).double()
    for _ in range(2):
        x = th.randn(1 if common_input else stack.n_members, 4, 5, dtype=th.double)
        gradient = th.randn(stack.n_members, 4, 2, dtype=th.double)
        values = stack(x)
        expected = th.autograd.grad(values, list(stack.parameters()), gradient, allow_unused=True)
        assert_close(stack.evaluate(x), values)
        stack.backward(gradient)
        for (name, parameter), theirs in zip(stack.named_parameters(), expected, strict=True):
            if theirs is not None:  # an activation that nothing passes through
                th.testing.assert_close(parameter.grad, theirs, atol=1e-12, rtol=1e-12, msg=name)


def test_evaluations_of_several_sizes_stand_side_by_side():
    """Those of one size use the same tensors again; another size has its own, up to a bound."""
    stack, x = stack_and_input(False, batch=6)
    first = stack.evaluate(x[:, :4])
    kept = first.clone()
    stack.evaluate(x[:, :3])
    assert th.equal(first, kept)
    assert stack.evaluate(x[:, 2:]).data_ptr() == first.data_ptr()
    for size in range(1, 7):
        assert_close(stack.evaluate(x[:, :size]), stack(x[:, :size]))
    assert len(stack._evaluations) <= 3


def test_evaluations_follow_a_change_of_type():
    stack, x = stack_and_input(True)
    stack.evaluate(x)
    stack.double()
    assert stack.evaluate(x.double()).dtype == th.double


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda stack: pickle.loads(pickle.dumps(stack))], ids=["copy", "pickle"])
@pytest.mark.parametrize("activation_fn", [nn.ReLU, nn.Tanh])
def test_a_copy_evaluates_with_its_own_parameters(copied, activation_fn):
    stack, x = stack_and_input(False, activation_fn=activation_fn)
    stack.evaluate(x)
    other = copied(stack)
    assert not other._evaluations
    nn.init.ones_(other.rest[-1].bias)
    assert_close(other.evaluate(x), other(x))
    assert_close(stack.evaluate(x), stack(x))


@pytest.mark.parametrize("layer", ["first", "rest.0", "rest.1", "norms.0"])
def test_evaluations_see_new_data_of_any_parameter(layer):
    stack, x = stack_and_input(False, layer_norm=True)
    before = stack.evaluate(x).clone()
    weight = stack.get_parameter(f"{layer}.weight")
    weight.data = th.zeros_like(weight)
    assert_close(stack.evaluate(x), stack(x))
    assert not th.equal(stack.evaluate(x), before)


@pytest.mark.parametrize("members", [None, [0, 3, 1, 0]])
@INPUTS
def test_frozen_parameters_get_no_gradient(common_input, members):
    stack, x = stack_and_input(common_input, members=members, layer_norm=True)
    for frozen in (False, True):
        stack.first.requires_grad_(not frozen)
        stack.rest[0].bias.requires_grad_(not frozen)
        stack.norms[1].weight.requires_grad_(not frozen)
        stack.evaluate(x)
        stack.backward(th.ones(stack.n_members, 4, SIZES[-1]))
    assert {name for name, parameter in stack.named_parameters() if parameter.grad is None} == {
        "first.weight",
        "first.bias",
        "rest.0.bias",
        "norms.1.weight",
    }
    stack.clip_gradients(1e-3)
    assert stack.gradient_norms().max() < 1.1e-3


class Unused(nn.Module):
    """An activation of which a part is not used, a part is frozen."""

    def __init__(self):
        super().__init__()
        self.unused = nn.Parameter(th.ones(1))
        self.frozen = nn.Parameter(th.full((1,), 0.3), requires_grad=False)

    def forward(self, x):
        return x.sigmoid() * self.frozen


class Step(nn.Module):
    """An activation without a gradient."""

    def forward(self, x):
        return (x > 0).to(x.dtype)


@pytest.mark.parametrize("activation_fn", [lambda: nn.ELU(inplace=True), Unused, Step], ids=["in place", "unused", "step"])
def test_odd_activations_are_followed_too(activation_fn):
    stack, x = stack_and_input(False, activation_fn=activation_fn)
    gradient = th.randn(6, 4, SIZES[-1])
    expected = th.autograd.grad(stack(x), list(stack.rest[-1].parameters()), gradient)
    stack.evaluate(x)
    stack.backward(gradient)
    for parameter, theirs in zip(stack.rest[-1].parameters(), expected, strict=True):
        assert_close(parameter.grad, theirs)


@NORMS
def test_a_borrower_evaluates_in_the_tensors_of_its_lender(layer_norm):
    one, x = stack_and_input(False, layer_norm=layer_norm)
    other = StackedMLP(6, SIZES, layer_norm=layer_norm)
    other.borrow(one)
    values = one.evaluate(x)
    expected = other(x)
    assert_close(other.evaluate(x), expected)
    assert_close(values, expected)
    assert_close(one.evaluate(x), one(x))


def test_network_is_made_of_linear_layers_and_activations():
    layers = list(StackedMLP(2, SIZES, nn.Tanh).network(1))
    assert [type(layer) for layer in layers] == [nn.Linear, nn.Tanh, nn.Linear, nn.Tanh, nn.Linear]
    assert [tuple(layer.weight.shape) for layer in layers[::2]] == [(7, 5), (6, 7), (2, 6)]


def test_layer_norms_stand_between_hidden_layers_and_activations():
    layers = list(StackedMLP(2, SIZES, nn.Tanh, layer_norm=True).network(1))
    norm, tanh = nn.LayerNorm, nn.Tanh
    assert [type(layer) for layer in layers] == [nn.Linear, norm, tanh, nn.Linear, norm, tanh, nn.Linear]
    assert [(layer.normalized_shape, layer.eps) for layer in layers[1::3]] == [((7,), 1e-5), ((6,), 1e-5)]
    assert all(layer.weight.eq(1).all() and layer.bias.eq(0).all() for layer in layers[1::3])


@pytest.mark.parametrize("given", ["yes", 1, None])
def test_a_layer_norm_that_is_neither_yes_nor_no_is_refused(given):
    with pytest.raises(ValueError, match=r"layer_norm is yes or no \(True or False\), not"):
        StackedMLP(2, SIZES, layer_norm=given)


def test_network_is_a_copy():
    stack, x = stack_and_input(None)
    before = stack(x)
    nn.init.zeros_(stack.network(0)[0].weight)
    assert_close(stack(x), before)


@NORMS
@INPUTS
def test_adam_steps_are_those_of_separate_networks(common_input, layer_norm):
    stack, x = stack_and_input(common_input, layer_norm=layer_norm)
    plain = separate(stack)
    stacked_adam = th.optim.Adam(stack.parameters(), lr=1e-2)
    plain_adams = [th.optim.Adam(net.parameters(), lr=1e-2) for net in plain]
    target = th.randn(6, 4, SIZES[-1])
    for _ in range(5):
        stacked_adam.zero_grad()
        (stack(x) - target).square().mean((1, 2)).sum().backward()
        stacked_adam.step()
        for net, adam, own, y in zip(plain, plain_adams, spread_inputs(stack, x), target, strict=True):
            adam.zero_grad()
            (net(own) - y).square().mean().backward()
            adam.step()
    for i, net in enumerate(plain):
        for ours, theirs in zip(stack.network(i).parameters(), net.parameters(), strict=True):
            assert_close(ours, theirs, atol=1e-5)


def as_separate_gradients(stack):
    """The gradient of each network of a stack: a plain gradient-descent step of size 1 moves by minus the gradient."""
    before = separate(stack)
    with th.no_grad():
        for parameter in stack.parameters():
            parameter.sub_(parameter.grad)
    after = separate(stack)
    return [
        [a - b for a, b in zip(old.parameters(), new.parameters(), strict=True)]
        for old, new in zip(before, after, strict=True)
    ]


@NORMS
@INPUTS
def test_gradients_are_clipped_network_by_network(common_input, layer_norm):
    """Losses of very different sizes, so that some networks are clipped and some are not."""
    stack, x = stack_and_input(common_input, layer_norm=layer_norm)
    plain = separate(stack)
    scales = th.tensor([1e-3, 1.0, 10.0, 1e-2, 100.0, 0.3])
    (stack(x).square().mean((1, 2)) * scales).sum().backward()
    norms = []
    for net, own, scale in zip(plain, spread_inputs(stack, x), scales, strict=True):
        (net(own).square().mean() * scale).backward()
        norms.append(nn.utils.clip_grad_norm_(net.parameters(), 0.05))
    assert min(norms) < 0.05 < max(norms)
    assert_close(stack.gradient_norms(), th.stack(norms))
    stack.clip_gradients(0.05)
    for ours, net in zip(as_separate_gradients(stack), plain, strict=True):
        for one, other in zip(ours, net.parameters(), strict=True):
            assert_close(one, other.grad, atol=2e-6)


def test_new_networks_are_drawn_as_nn_linear_draws():
    """nn.Linear draws weights and biases evenly from ±1/√inputs: standard deviation 1/√(3·inputs)."""
    stack = StackedMLP(40, [16, 50, 1], common_input=True)
    assert stack.network(39)[0].weight.abs().max() <= 0.25
    for layer, inputs in ((0, 16), (2, 50)):
        drawn = th.cat([net[layer].weight.flatten() for net in separate(stack)])
        assert drawn.std().item() == pytest.approx((3 * inputs) ** -0.5, rel=0.05)


# ---- members that share a network

MEMBERS = [0, 0, 1, 0, 1]


@NORMS
@INPUTS
def test_sharing_is_a_one_hot_number_in_the_input(common_input, layer_norm):
    stack = scatter_norms(StackedMLP(2, SIZES, common_input=common_input, members=MEMBERS, layer_norm=layer_norm))
    x = th.randn(1 if common_input else 5, 4, SIZES[0])
    nets = one_hot_networks(stack)
    outputs = stack(x)
    for member, net in enumerate(MEMBERS):
        own = x[0 if common_input else member]
        assert_close(outputs[member], nets[net](with_one_hot(own, member, 5)))
        assert_close(outputs[member], stack.network(member)(own))


@NORMS
@INPUTS
def test_shared_networks_learn_as_networks_with_a_one_hot_number(common_input, layer_norm):
    stack = scatter_norms(StackedMLP(2, SIZES, common_input=common_input, members=MEMBERS, layer_norm=layer_norm))
    x = th.randn(1 if common_input else 5, 4, SIZES[0])
    inputs = x.expand(5, -1, -1)
    nets = one_hot_networks(stack)
    target = th.randn(5, 4, SIZES[-1])
    adam = th.optim.Adam(stack.parameters(), lr=1e-2)
    plain_adam = th.optim.Adam([p for net in nets for p in net.parameters()], lr=1e-2)

    def clip_and_step():
        stack.clip_gradients(0.1)
        adam.step()
        for net in nets:
            nn.utils.clip_grad_norm_(net.parameters(), 0.1)
        plain_adam.step()

    for _ in range(3):
        adam.zero_grad()
        plain_adam.zero_grad()
        (stack(x) - target).square().mean((1, 2)).sum().backward()
        for member, net in enumerate(MEMBERS):
            (nets[net](with_one_hot(inputs[member], member, 5)) - target[member]).square().mean().backward()
        clip_and_step()
    outputs = stack(x)
    for member, net in enumerate(MEMBERS):
        assert_close(outputs[member], nets[net](with_one_hot(inputs[member], member, 5)), atol=1e-5)


# ---- actors and critics of a world

LAYOUTS = {
    "one block": AgentLayout(("a_0", "a_1", "a_2"), ("a",) * 3, (3, 3, 3), (2, 2, 2)),
    # blocks: agents 0, 2 and 3; agent 1
    "several blocks": AgentLayout(("a_0", "b_0", "a_1", "a_2"), ("a", "b", "a", "a"), (3, 4, 3, 3), (2, 1, 2, 2)),
}


@pytest.fixture(params=LAYOUTS)
def layout(request):
    return LAYOUTS[request.param]


def critics_of(layout, agents=None, **kwargs):
    agents = range(layout.n_agents) if agents is None else agents
    return scatter_norms(StackedCritics(layout, agents, "observations", [8, 6], **kwargs))


def in_blocks(critics, per_agent):
    """Per-agent actions {agent: (batch, action)} as the per-block tensors that the stacks speak in."""
    return [th.stack([per_agent[i] for i in block.agents]) for block in critics.blocks]


@NORMS
@pytest.mark.parametrize("share", [False, True])
def test_critics_of_own_observations_equal_separate_networks(share, layer_norm):
    """Each reads its agent's observation and all actions, with shared parameters the agent's own action first."""
    layout = AgentLayout(("a_0", "a_1", "b_0", "b_1"), ("a", "a", "b", "b"), (3, 3, 2, 2), (2, 2, 1, 1))
    settings = {"n_critics": 2, "share_parameters": share, "layer_norm": layer_norm}
    critics = scatter_norms(OwnObservationCritics(layout, range(4), "own_observation", [8, 6], **settings))
    inputs = th.randn(5, sum(layout.obs_sizes) + 6)
    observations, actions = inputs[:, :-6], inputs[:, -6:]
    orders = [[0, 1, 2, 3, 4, 5], [2, 3, 0, 1, 4, 5], [0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 5, 4]]
    own = [th.randn(2, 5, 2), th.randn(2, 5, 1)]  # per block
    for agent in range(4):
        seen = observations[:, layout.obs_slices[agent]]
        order = orders[agent] if share else list(range(6))
        for critic in range(2):
            theirs = critics.network(agent, critic)(th.cat([seen, actions[:, order]], dim=1)).squeeze(1)
            assert_close(critics(inputs)[critic, agent], theirs)
        moved = actions.clone()
        moved[:, layout.action_slices[agent]] = own[agent // 2][agent % 2]
        theirs = critics.network(agent)(th.cat([seen, moved[:, order]], dim=1)).squeeze(1)
        critics.evaluate(inputs)
        assert_close(critics.evaluate_own_actions(own)[agent], theirs)


def test_actors_equal_separate_sb3_actors(layout):
    actors = StackedActors(layout, range(layout.n_agents), [8, 6])
    observations = th.randn(5, sum(layout.obs_sizes))
    joint = actors(observations)
    for block, actions in zip(actors.blocks, joint, strict=True):
        for agent, own in zip(block.agents, actions, strict=True):
            theirs = sb3_actor(layout.obs_sizes[agent], layout.action_sizes[agent])
            load_linears(theirs.mu, actors.network(agent))
            assert_close(own, theirs(observations[:, layout.obs_slices[agent]]))


def test_critics_equal_separate_sb3_critics(layout):
    critics = critics_of(layout, n_critics=2)
    n_obs, n_actions = sum(layout.obs_sizes), sum(layout.action_sizes)
    observations, actions = th.randn(5, n_obs), th.rand(5, n_actions) * 2 - 1
    q_values = critics(th.cat([observations, actions], dim=1))
    assert q_values.shape == (2, layout.n_agents, 5)
    for agent in range(layout.n_agents):
        theirs = sb3_critic(n_obs, n_actions)
        for number, network in enumerate(theirs.q_networks):
            load_linears(network, critics.network(agent, number))
        for ours, value in zip(q_values[:, agent], theirs(observations, actions), strict=True):
            assert_close(ours, value.squeeze(1))


def box(size):
    return spaces.Box(-1, 1, (size,), np.float32)


def sb3_actor(n_obs, n_actions):
    space = box(n_obs)
    return Actor(space, box(n_actions), [8, 6], FlattenExtractor(space), n_obs)


def sb3_critic(n_obs, n_actions):
    space = box(n_obs)
    return ContinuousCritic(space, box(n_actions), [8, 6], FlattenExtractor(space), n_obs, n_critics=2)


def load_linears(target, source):
    linears = [layer for layer in target if isinstance(layer, nn.Linear)]
    for ours, theirs in zip(linears, [layer for layer in source if isinstance(layer, nn.Linear)], strict=True):
        ours.load_state_dict(theirs.state_dict())


@NORMS
@pytest.mark.parametrize("share", [False, True])
def test_own_action_replaced_equals_a_plain_evaluation_and_its_gradient(layout, share, layer_norm):
    """Eq. 6: Q_i(s, a_1 … π_i(o_i) … a_N), and ∇_a of it, agent by agent through the whole critic."""
    critics = critics_of(layout, share_parameters=share, layer_norm=layer_norm)
    n_obs = sum(layout.obs_sizes)
    inputs = th.randn(5, n_obs + sum(layout.action_sizes))
    new = {i: th.randn(5, layout.action_sizes[i], requires_grad=True) for i in range(layout.n_agents)}

    critics.evaluate(inputs)
    q_values = critics.evaluate_own_actions([own.detach() for own in in_blocks(critics, new)])
    weights = th.randn_like(q_values)
    gradients = {
        agent: gradient
        for block, found in zip(critics.blocks, critics.own_action_gradients(weights), strict=True)
        for agent, gradient in zip(block.agents, found, strict=True)
    }
    for i in range(layout.n_agents):
        columns = layout.action_slices[i]
        before, after = inputs[:, : n_obs + columns.start], inputs[:, n_obs + columns.stop :]
        plain = critics.network(i)(th.cat([before, new[i], after], dim=1)).squeeze(1)
        assert_close(q_values[i], plain, atol=1e-5)
        (plain * weights[i]).sum().backward()
        assert_close(gradients[i], new[i].grad, atol=1e-5)


@NORMS
@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize("agents", [None, [1, 3]], ids=["", "a team"])
def test_both_steps_are_those_of_autograd(layout, agents, share, layer_norm):
    """Eq. 5 of two critics per agent, and eq. 6 at the same inputs, whether compiled or not."""
    agents = list(range(layout.n_agents)) if agents is None else [agent for agent in agents if agent < layout.n_agents]
    critics = critics_of(layout, agents=agents, n_critics=2, share_parameters=share, layer_norm=layer_norm)
    exact = copy.deepcopy(critics).double()
    inputs = th.randn(7, sum(layout.obs_sizes) + sum(layout.action_sizes))
    targets, weights = th.randn(7, len(agents)).T, th.rand(7, len(agents)).T
    errors, losses = critics.regress(inputs, targets, weights)
    theirs = targets - exact(inputs.double())
    squares = (weights * theirs.square()).sum(-1)
    assert_close(errors, theirs.detach().float(), atol=1e-5)
    assert_close(losses, squares.detach().float(), atol=1e-4)
    for parameter, gradient in zip(
        critics.parameters(), th.autograd.grad(squares.sum(), list(exact.parameters())), strict=True
    ):
        assert_close(parameter.grad, gradient.float(), atol=1e-4)

    own = [th.randn(len(block.agents), 7, block.action_size) for block in critics.blocks]
    exact.evaluate(inputs.double())
    q_values = exact.evaluate_own_actions([actions.double() for actions in own])
    losses, gradients = critics.ascend(own, weights)
    assert_close(losses, -(q_values * weights).sum(-1).float(), atol=1e-4)
    for gradient, expected in zip(gradients, exact.own_action_gradients(-weights.double()), strict=True):
        assert_close(gradient, expected.float(), atol=1e-5)


@pytest.mark.parametrize("kind", [StackedCritics, OwnObservationCritics])
def test_the_second_step_is_at_the_inputs_of_the_first_whatever_comes_between(kind):
    """With more threads networks are evaluated in other tensors, which have seen no input."""
    layout = LAYOUTS["one block"]
    critics = kind(layout, range(layout.n_agents), "observations", [8, 6])
    own, weights = [th.randn(3, 5, 2)], th.rand(3, 5)
    with pytest.raises(RuntimeError, match="evaluate the critics before"):
        critics.ascend(own, weights)
    inputs = th.randn(5, sum(layout.obs_sizes) + sum(layout.action_sizes))
    critics.evaluate(inputs)
    losses, (gradient,) = critics.ascend(own, weights)
    th.set_num_threads(2)
    try:
        again, (gradient_again,) = critics.ascend(own, weights)
    finally:
        th.set_num_threads(1)
    assert_close(again, losses, atol=1e-5)
    assert_close(gradient_again, gradient, atol=1e-5)


def test_own_action_replaced_for_some_of_the_agents():
    """A team: agents 1 and 3 learn; the critics still read everyone's actions."""
    layout = LAYOUTS["several blocks"]
    critics = critics_of(layout, agents=[1, 3])
    n_obs = sum(layout.obs_sizes)
    inputs = th.randn(5, n_obs + sum(layout.action_sizes))
    new = {i: th.randn(5, layout.action_sizes[i]) for i in (1, 3)}
    critics.evaluate(inputs)
    q_values = critics.evaluate_own_actions(in_blocks(critics, new))
    for position, i in enumerate((1, 3)):
        moved = inputs.clone()
        moved[:, n_obs:][:, layout.action_slices[i]] = new[i]
        assert_close(q_values[position], critics.network(position)(moved).squeeze(1), atol=1e-5)


def test_the_actors_step_gives_the_critics_no_gradient(layout):
    critics = critics_of(layout, layer_norm=True)
    inputs = th.randn(5, sum(layout.obs_sizes) + sum(layout.action_sizes))
    new = {i: th.randn(5, layout.action_sizes[i]) for i in range(layout.n_agents)}
    critics.evaluate(inputs)
    critics.own_action_gradients(th.ones_like(critics.evaluate_own_actions(in_blocks(critics, new))))
    assert all(parameter.grad is None for parameter in critics.parameters())


def test_each_actor_reads_its_own_observation_alone(layout):
    actors = StackedActors(layout, range(layout.n_agents), [8, 6])
    observations = th.randn(1, sum(layout.obs_sizes))
    changed = observations.clone()
    changed[:, layout.obs_slices[1]] += 1
    before, after = actors(observations), actors(changed)
    moved = {
        agent
        for block, old, new in zip(actors.blocks, before, after, strict=True)
        for agent, one, other in zip(block.agents, old, new, strict=True)
        if not th.equal(one, other)
    }
    assert moved == {1}


@pytest.mark.parametrize("state_size", [0, 5, 9], ids=["no state", "a state", "a state as long as all observations"])
def test_a_shared_critic_reads_the_agent_itself_first(state_size):
    """
    Three agents, one critic, told apart by nothing: agent 1 sees (1, 2, 0) as agent 0 sees (0, 1, 2). The critic reads
    the observations, whatever the length of the world's state.
    """
    layout = AgentLayout(("a_0", "a_1", "a_2"), ("a",) * 3, (3, 3, 3), (2, 2, 2), state_size=state_size)
    critics = critics_of(layout, share_parameters=True)
    nn.init.zeros_(critics.stacks[0].member_bias)
    observations, actions = th.randn(4, 3, 3), th.randn(4, 3, 2)  # (batch, agents, size)

    def q_values(order):
        return critics(th.cat([observations[:, order].flatten(1), actions[:, order].flatten(1)], dim=1))[0]

    assert_close(q_values([0, 1, 2])[1], q_values([1, 2, 0])[0])
    assert_close(q_values([0, 1, 2])[2], q_values([2, 0, 1])[0])
