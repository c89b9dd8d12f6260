"""Formulas on minibatches: the compiled loops against PyTorch's operations, which other types and devices take."""

import numpy as np
import pytest
import torch as th

from sb3_kfcv.maddpg.joint_rows import critic_inputs, loss_shares, td_targets

AGENT_OF_COLUMN = th.tensor([0, 0, 1, 2, 2, 2])


@pytest.fixture(autouse=True)
def seeded():
    th.manual_seed(0)


def test_critics_read_what_is_seen_and_the_actions_of_those_who_are_there():
    seen, actions = th.tensor([[1.0, 2.0], [3.0, 4.0]]), th.arange(12.0).view(2, 6)
    present = th.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    expected = [[1, 2, 0, 1, 0, 3, 4, 5], [3, 4, 0, 0, 8, 9, 10, 11]]
    assert critic_inputs(seen, actions, present, AGENT_OF_COLUMN).tolist() == expected
    assert critic_inputs(seen.double(), actions, present, AGENT_OF_COLUMN).tolist() == expected


def test_rows_may_lie_apart():
    seen, actions, present = th.randn(4, 7).T, th.randn(6, 7).T, th.ones(3, 7).T
    inputs = critic_inputs(seen, actions, present, AGENT_OF_COLUMN)
    assert th.equal(inputs, th.cat([seen, actions], dim=1))


def test_rows_of_the_living_share_their_agent_s_loss():
    alive = th.tensor([[1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    expected = [[0.5, 0, 0.5, 0], [0.25] * 4, [0] * 4]
    for rows in (alive, alive.double()):
        assert loss_shares(rows, th.tensor([2, 0, 1])).tolist() == expected


def test_td_targets_by_hand():
    """One agent that goes on, one that does not; two critics, of which the lower counts."""
    rewards, continues = th.tensor([[1.0, 2.0]]), th.tensor([[1.0, 0.0]])
    next_q_values = th.tensor([[[10.0], [10.0]], [[8.0], [12.0]]])
    for convert in (th.Tensor.float, th.Tensor.double):
        given = [convert(values) for values in (rewards, continues, next_q_values)]
        assert td_targets(*given, th.tensor([0, 1]), 0.5).tolist() == [[5.0], [2.0]]


@pytest.mark.parametrize("agents", [[0, 1, 2, 3], [1, 2], [3, 0]], ids=str)
@pytest.mark.parametrize("n_critics", [1, 2, 3])
def test_td_targets_are_those_of_pytorch(n_critics, agents):
    rewards, continues = th.randn(9, 4), th.randint(2, (9, 4)).float()
    next_q_values = th.randn(n_critics, len(agents), 9)
    given = rewards, continues, next_q_values
    exact = td_targets(*(values.double() for values in given), th.tensor(agents), 0.95)
    found = td_targets(*given, th.tensor(agents), 0.95)
    assert found.is_contiguous()
    np.testing.assert_allclose(found, exact, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("critic", [0, 1])
def test_a_target_that_is_not_a_number_is_not_hidden_by_the_lower_one(critic):
    next_q_values = th.zeros(2, 1, 3)
    next_q_values[critic, 0, 1] = th.nan
    found = td_targets(th.zeros(3, 1), th.ones(3, 1), next_q_values, th.tensor([0]), 0.9)
    assert found.isnan().tolist() == [[False, True, False]]


def test_one_reward_for_all_agents_is_refused():
    with pytest.raises(IndexError, match="out of bounds"):
        td_targets(th.ones(3, 1), th.ones(3, 2), th.ones(1, 2, 3), th.tensor([0, 1]), 0.5)


@pytest.mark.parametrize(
    "formula",
    [
        lambda: td_targets(th.ones(3, 4), th.ones(3, 4), th.ones(1, 2, 3), th.arange(4), 0.9),
        lambda: td_targets(th.ones(300, 4), th.ones(300, 4), th.ones(1, 4, 3), th.arange(4), 0.9),
        lambda: critic_inputs(th.zeros(2, 2), th.ones(2, 8), th.ones(2, 3), AGENT_OF_COLUMN),
        lambda: critic_inputs(th.zeros(4, 2), th.ones(2, 6), th.ones(2, 3), AGENT_OF_COLUMN),
    ],
)
def test_rows_that_do_not_fit_are_refused(formula):
    with pytest.raises(RuntimeError, match="size"):
        formula()


@pytest.mark.parametrize(
    "formula",
    [
        lambda: td_targets(th.ones(3, 4), th.ones(3, 4), th.ones(1, 1, 3), th.tensor([9]), 0.9),
        lambda: loss_shares(th.ones(3, 4), th.tensor([-1])),
        lambda: critic_inputs(th.zeros(2, 2), th.ones(2, 6), th.ones(2, 1), AGENT_OF_COLUMN),
    ],
)
def test_agents_that_there_are_not_are_refused(formula):
    with pytest.raises(IndexError, match="there is no such agent in these rows"):
        formula()
