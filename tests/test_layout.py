"""The agent layout: who sits where in the joint rows."""

import json

import numpy as np
import pytest
from gymnasium import spaces

from sb3_kfcv.common.layout import AgentLayout, group_of

# Joint observation: wolf_0 0-1 | wolf_1 2-3 | sheep_0 4-6. Joint action: wolf_0 0-1 | wolf_1 2-3 | sheep_0 4.
PACK = AgentLayout(("wolf_0", "wolf_1", "sheep_0"), ("wolf", "wolf", "sheep"), (2, 2, 3), (2, 2, 1), state_size=9)


@pytest.mark.parametrize(
    ("agent", "group"), [("wolf_3", "wolf"), ("agent_0", "agent"), ("red2", "red"), ("alice", "alice"), ("7", "7")]
)
def test_group_is_the_name_without_its_number(agent, group):
    assert group_of(agent) == group


def test_slices_follow_one_another():
    assert PACK.obs_slices == (slice(0, 2), slice(2, 4), slice(4, 7))
    assert PACK.action_slices == (slice(0, 2), slice(2, 4), slice(4, 5))


def test_groups_and_their_members():
    assert PACK.group_names == ("wolf", "sheep")
    assert PACK.members("wolf") == (0, 1)
    assert PACK.members("sheep") == (2,)


def test_group_means():
    # (1 + 3) / 2 = 2 and 7; (0 + 4) / 2 = 2 and −1
    means = PACK.group_means(np.array([[1.0, 3.0, 7.0], [0.0, 4.0, -1.0]]))
    assert means["wolf"].tolist() == [2, 2]
    assert means["sheep"].tolist() == [7, -1]


def test_unknown_group_names_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown group .?wulf.*wolf.*sheep"):
        PACK.members("wulf")


def test_layout_survives_json():
    assert AgentLayout.from_dict(json.loads(json.dumps(PACK.to_dict()))) == PACK


def box(*shape):
    return spaces.Box(-1, 1, shape, np.float32)


def test_layout_from_continuous_spaces():
    layout = AgentLayout.from_spaces(
        ["wolf_0", "sheep_0"], {"wolf_0": box(4), "sheep_0": box(3)}, {"wolf_0": box(2), "sheep_0": box(1)}, state_size=5
    )
    assert layout == AgentLayout(("wolf_0", "sheep_0"), ("wolf", "sheep"), (4, 3), (2, 1), False, 5)


def test_discrete_actions_count_their_choices():
    actions = {"a_0": spaces.Discrete(5), "a_1": spaces.Discrete(3)}
    layout = AgentLayout.from_spaces(["a_0", "a_1"], {"a_0": box(2), "a_1": box(2)}, actions)
    assert layout.discrete
    assert layout.action_sizes == (5, 3)


def test_an_image_observation_is_refused_by_the_agents_name():
    with pytest.raises(ValueError, match="'b_0'"):
        AgentLayout.from_spaces(["a_0", "b_0"], {"a_0": box(2), "b_0": box(2, 2)}, {"a_0": box(1), "b_0": box(1)})


def test_mixed_action_kinds_are_refused():
    with pytest.raises(ValueError, match="one kind for all"):
        AgentLayout.from_spaces(["a_0", "b_0"], {"a_0": box(2), "b_0": box(2)}, {"a_0": box(1), "b_0": spaces.Discrete(2)})


def test_group_means_do_not_depend_on_the_number_of_rows():
    agents = tuple(f"{group}_{i}" for group in ("wolf", "sheep") for i in range(16))
    layout = AgentLayout(agents, tuple(agent.partition("_")[0] for agent in agents), (1,) * 32, (1,) * 32)
    values = np.random.default_rng(0).normal(size=(64, 32))
    together = layout.group_means(values)
    for i, row in enumerate(values):
        assert {group: mean[i] for group, mean in together.items()} == layout.group_means(row)
