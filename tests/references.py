"""Slow and plain versions of what the library does in stacks, and made-up transitions to feed both."""

import numpy as np
import torch as th
from torch import nn


def one_hot_networks(stack):
    """
    The distinct networks of a stack whose members share them, each as a plain network that reads (input, one-hot member).
    """
    n_members = len(stack.members)
    networks = []
    for net in range(stack.n_networks):
        member = stack.members.tolist().index(net)
        plain = stack.network(member)
        without_number = plain[0]
        plain[0] = nn.Linear(stack.sizes[0] + n_members, stack.sizes[1])
        with th.no_grad():
            own_bias = stack.member_bias[:, 0]  # (members, hidden)
            plain[0].weight.copy_(th.cat([without_number.weight, own_bias.T], dim=1))
            plain[0].bias.copy_(without_number.bias - own_bias[member])
        networks.append(plain.to(stack.member_bias.dtype))
    return networks


def with_one_hot(inputs, member, n_members):
    """(batch, features) with the member's one-hot number appended."""
    one_hot = inputs.new_zeros(len(inputs), n_members)
    one_hot[:, member] = 1
    return th.cat([inputs, one_hot], dim=1)


def parameters_of(model):
    """Every tensor of a model's policy, copied."""
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def random_infos(rng, layout, n_envs, death_rate=0.0, alive_rate=1.0, join_rate=0.0):
    """Infos as an env gives them, of made-up steps."""
    infos = []
    for _ in range(n_envs):
        alive = rng.random(layout.n_agents) < alive_rate
        absent = ~alive & (rng.random(layout.n_agents) >= join_rate) if join_rate else ~alive
        infos.append(
            {
                "agent_rewards": (rng.normal(size=layout.n_agents) * alive).astype(np.float32),
                "agent_terminated": absent | (alive & (rng.random(layout.n_agents) < death_rate)),
                "agent_alive": alive,
                "state": rng.normal(size=layout.state_size).astype(np.float32),
                "next_state": rng.normal(size=layout.state_size).astype(np.float32),
            }
        )
    return infos


def random_actions(rng, layout, n_envs):
    """Joint actions as the buffer stores them: in [-1, 1], or choices."""
    if layout.discrete:
        return np.stack([rng.integers(n, size=n_envs) for n in layout.action_sizes], axis=1)
    return rng.uniform(-1, 1, (n_envs, sum(layout.action_sizes))).astype(np.float32)


def fill(buffer, layout, steps, seed=0, **rates):
    """Put made-up transitions into a buffer."""
    rng = np.random.default_rng(seed)
    for _ in range(steps):
        obs, next_obs = rng.normal(size=(2, buffer.n_envs, sum(layout.obs_sizes))).astype(np.float32)
        infos = random_infos(rng, layout, buffer.n_envs, **rates)
        actions = random_actions(rng, layout, buffer.n_envs)
        buffer.add(obs, next_obs, actions, np.zeros(buffer.n_envs), np.zeros(buffer.n_envs), infos)


def assert_equal_trees(one, other, place="value"):
    """Nested values alike: same types, same numbers."""
    assert type(one) is type(other), place
    if isinstance(one, dict):
        assert one.keys() == other.keys(), place
        for key in one:
            assert_equal_trees(one[key], other[key], f"{place}/{key}")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other), place
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_equal_trees(a, b, f"{place}/{i}")
    else:
        np.testing.assert_array_equal(one, other, err_msg=place)
