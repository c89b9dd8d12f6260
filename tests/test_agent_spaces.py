"""Agents with any spaces: what becomes a vector, what reaches the world, and what is refused."""

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Sequence, Tuple
from toy_envs import SpacesEnv

from sb3_kfcv import MADDPG, JointEnv

NUMBER = Box(-1, 1, (1,), np.float32)
QUICK = {"learning_starts": 10, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}


def world(observation=NUMBER, action=NUMBER, seen=None, **kwargs):
    """A joint world whose scout has the given spaces; the tank observes and does one number, or chooses if the scout does."""
    tank = Discrete(2) if isinstance(action, Discrete) else NUMBER
    seen = {"tank_0": np.full(1, 0.25, np.float32)} | ({} if seen is None else {"scout_0": seen})
    return JointEnv(SpacesEnv({"scout_0": observation, "tank_0": NUMBER}, {"scout_0": action, "tank_0": tank}, seen, **kwargs))


OBSERVATIONS = {
    "flat": (Box(-1, 1, (2,), np.float32), np.float32([0.5, -1]), [0.5, -1]),
    "double precision": (Box(-1, 1, (2,), np.float64), np.array([0.5, -1]), [0.5, -1]),
    "no bounds in single precision": (Box(-1e300, 1e300, (1,), np.float64), np.array([3.0]), [3]),
    "whole numbers": (Box(0, 9, (3,), np.int64), np.array([4, 0, 9]), [4, 0, 9]),
    "bytes in one row": (Box(0, 255, (2,), np.uint8), np.uint8([255, 1]), [255, 1]),
    "yes and no": (Box(0, 1, (2,), bool), np.array([True, False]), [1, 0]),
    "a matrix": (Box(-9, 9, (2, 2), np.float32), np.float32([[1, 2], [3, 4]]), [1, 2, 3, 4]),
    "a list": (Box(-1, 1, (2,), np.float32), [0.5, -1.0], [0.5, -1]),
    "one of three": (Discrete(3), 1, [0, 1, 0]),
    "one of three from 5": (Discrete(3, start=5), np.int64(7), [0, 0, 1]),
    "switches": (MultiBinary(3), np.int8([1, 0, 1]), [1, 0, 1]),
    "several choices": (MultiDiscrete([2, 3]), np.array([1, 2]), [0, 1, 0, 0, 1]),
    "a map": (Dict(a=Discrete(2), b=NUMBER), {"a": 1, "b": np.float32([-0.5])}, [0, 1, -0.5]),
    "a tuple of a map": (Tuple([NUMBER, Dict(a=Discrete(2))]), (np.float32([-0.5]), {"a": 0}), [-0.5, 1, 0]),
}


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_an_observation_becomes_a_vector(kind):
    space, seen, vector = OBSERVATIONS[kind]
    env = world(space, seen=seen)
    row, _ = env.reset(seed=0)
    assert row.dtype == np.float32
    assert row.tolist() == [*vector, 0.25]
    assert env.observation_space.contains(row)
    assert env.layout.obs_sizes == (len(vector), 1)


ACTIONS = {
    "a choice": (Discrete(3), 1, 1),
    "a choice from 2": (Discrete(3, start=2), 1, 3),
    "other bounds": (Box(np.float32([-2, 0]), np.float32([5, 1]), dtype=np.float32), [-2, 1], [-2, 1]),
    "double precision": (Box(0, 3, (2,), np.float64), [0.5, 3], [0.5, 3]),
    "a matrix": (Box(0, 3, (2, 2), np.float32), [0, 1, 2, 3], [[0, 1], [2, 3]]),
    "one number without axes": (Box(-1, 1, (), np.float32), [0.5], 0.5),
}


@pytest.mark.parametrize("kind", ACTIONS)
def test_an_action_reaches_the_agent_in_its_own_space(kind):
    space, part, own = ACTIONS[kind]
    env = world(action=space)
    env.reset(seed=0)
    env.step(np.append(part, 1).astype(env.action_space.dtype))
    np.testing.assert_array_equal(env.parallel_env.given["scout_0"], own)


def test_rounding_leads_out_of_no_bound():
    """The nearest float32 to 0.1 is larger than the float64."""
    env = world(action=Box(0.0, 0.1, (1,), np.float64))
    env.reset(seed=0)
    env.step(env.action_space.high)
    assert env.parallel_env.given["scout_0"] == [0.1]


@pytest.mark.parametrize(
    ("observation", "action"),
    [
        (OBSERVATIONS["a map"][0], Discrete(3, start=2)),
        (MultiDiscrete([2, 3]), Box(0, 5, (2,), np.float64)),
        (Box(0, 9, (2, 2), np.int64), Box(np.float32([-2, 0]), np.float32([5, 1]), dtype=np.float32)),
    ],
    ids=["map, choice", "choices, double", "matrix, other bounds"],
)
def test_training_and_saving(observation, action, tmp_path):
    model = MADDPG("MlpPolicy", world(observation, action, time_limit=4), seed=0, **QUICK).learn(30)
    model.save(tmp_path / "model")
    row = model.get_env().reset()
    expected = model.predict(row, deterministic=True)[0]
    np.testing.assert_array_equal(MADDPG.load(tmp_path / "model").predict(row, deterministic=True)[0], expected)
    assert np.abs(model.replay_buffer.actions[:30]).max() <= (4 if isinstance(action, Discrete) else 1)


REFUSED = {
    "pictures": ({"observation": Box(0, 255, (8, 8, 3), np.uint8)}, "observation space of 'scout_0'.*a picture"),
    "a map with a picture": ({"observation": Dict(eye=Box(0, 255, (8, 8), np.uint8))}, "'scout_0'.*a picture"),
    "lists of any length": ({"observation": Sequence(NUMBER)}, "'scout_0' is Sequence.*no vector of fixed length"),
    "several choices": ({"action": MultiDiscrete([2, 3])}, "action space of 'scout_0' is MultiDiscrete.*number their combin"),
    "switches": ({"action": MultiBinary(3)}, "action space of 'scout_0' is MultiBinary"),
    "actions of whole numbers": ({"action": Box(0, 9, (2,), np.int64)}, "'scout_0'.*holds floats"),
    "actions without bounds": ({"action": Box(-np.inf, np.inf, (2,))}, "'scout_0'.*finite lower bound below"),
    "actions of one value": ({"action": Box(1, 1, (2,))}, "'scout_0'.*finite lower bound below"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_space_that_cannot_be_joined_is_refused(kind):
    given, sentence = REFUSED[kind]
    with pytest.raises(ValueError, match=sentence):
        world(**given)


def test_a_world_that_mixes_choices_and_vectors_is_refused():
    action_spaces = {"scout_0": Discrete(2), "tank_0": NUMBER}
    with pytest.raises(ValueError, match=r"one kind for all; got \{'scout_0': Discrete\(2\), 'tank_0': Box"):
        JointEnv(SpacesEnv({"scout_0": NUMBER, "tank_0": NUMBER}, action_spaces))


@pytest.mark.parametrize("seen", [3, -1, "left", None, np.array([1, 2])])
def test_an_observation_that_is_none_of_its_space_is_named(seen):
    env = world(Discrete(3), seen=1)
    env.parallel_env.observations["scout_0"] = seen
    with pytest.raises(ValueError, match=r"observation of 'scout_0'.*Discrete"):
        env.reset(seed=0)


def test_agents_may_be_numbered():
    """PettingZoo allows any name."""

    class Numbered(SpacesEnv):
        possible_agents = (0, 1)

        def __init__(self):
            super().__init__({0: NUMBER, 1: NUMBER}, {0: NUMBER, 1: NUMBER})
            self.possible_agents = [0, 1]

    env = JointEnv(Numbered())
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.layout.agents == ("0", "1")
    assert set(env.parallel_env.given) == {0, 1}


def test_spaces_of_gymnasium_that_it_cannot_flatten_are_refused():
    class Odd(spaces.Space):
        pass

    with pytest.raises(ValueError, match=r"'scout_0'.*no vector"):
        world(Odd())
