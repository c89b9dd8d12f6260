"""Next observations that are not stored twice: minibatches and files as if they were."""

from copy import deepcopy
from itertools import pairwise

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_kfcv import KFCVReplayBuffer
from sb3_kfcv.replay import JointReplayBuffer, PrioritizedReplayBuffer
from sb3_kfcv.replay.joint_replay_buffer import TRANSITION_ARRAYS

OBS, ACT, STATE_SIZE = spaces.Box(-np.inf, np.inf, (5,), np.float32), spaces.Box(-1, 1, (2,), np.float32), 3
KINDS = {"uniform": JointReplayBuffer, "prioritised": PrioritizedReplayBuffer, "curriculum": KFCVReplayBuffer}


def make_buffer(size, n_envs=1, kind=JointReplayBuffer, state_size=STATE_SIZE, seed=0):
    return kind(size, OBS, ACT, n_envs=n_envs, n_agents=2, state_size=state_size, seed=seed, device="cpu")


class Worlds:
    """
    Random walks: joint observations and states, of which a step's end is the next one's start but for an episode's end,
    a reset in between, another state alone, and a zero that changes its sign.
    """

    def __init__(self, n_envs, seed=0, end_rate=0.1):
        self.rng, self.n_envs, self.end_rate = np.random.default_rng(seed), n_envs, end_rate
        self.obs, self.state = self.draw(5), self.draw(STATE_SIZE)

    def draw(self, width):
        return self.rng.integers(-1, 2, (self.n_envs, width)).astype(np.float32)

    def step(self):
        """One step of all worlds: name → (worlds, …)."""
        rng, n = self.rng, self.n_envs
        step = {
            "observations": self.obs,
            "next_observations": self.draw(5),
            "actions": rng.uniform(-1, 1, (n, 2)).astype(np.float32),
            "rewards": rng.normal(size=(n, 2)).astype(np.float32),
            "dones": rng.integers(2, size=(n, 2)).astype(np.float32),
            "alive": rng.integers(2, size=(n, 2)).astype(np.float32),
            "states": self.state,
            "next_states": self.draw(STATE_SIZE),
        }
        self.obs, self.state = step["next_observations"].copy(), step["next_states"].copy()
        ended = rng.random(n) < self.end_rate
        self.obs[ended], self.state[ended] = self.draw(5)[ended], self.draw(STATE_SIZE)[ended]
        if rng.random() < self.end_rate:
            self.state[-1, 0] += 1
        if rng.random() < self.end_rate:
            self.obs[0, 1] = np.negative(0.0) if np.signbit(step["next_observations"][0, 1]) == 0 else 0.0
        return step


class Both:
    """The reference: keeps every step whole."""

    def __init__(self, size, n_envs):
        self.n_steps, self.n_envs, self.steps = max(size // n_envs, 1), n_envs, []

    def add(self, step):
        self.steps.append({name: array.copy() for name, array in step.items()})

    def rows(self, rows):
        held = range(max(len(self.steps) - self.n_steps, 0), len(self.steps))
        step_at = {number % self.n_steps: self.steps[number] for number in held}
        return {
            name: np.stack([step_at[row // self.n_envs][name][row % self.n_envs] for row in rows])
            for name in TRANSITION_ARRAYS
        }


def add(buffer, step):
    infos = [
        {
            "agent_rewards": step["rewards"][world],
            "agent_terminated": step["dones"][world],
            "agent_alive": step["alive"][world],
            "state": step["states"][world],
            "next_state": step["next_states"][world],
        }
        for world in range(buffer.n_envs)
    ]
    zeros = np.zeros(buffer.n_envs)
    buffer.add(step["observations"], step["next_observations"], step["actions"], zeros, zeros, infos)


def assert_same_bits(batch, expected):
    for name, array in expected.items():
        assert getattr(batch, name).numpy().tobytes() == array.tobytes(), name


@pytest.mark.parametrize("kind", [JointReplayBuffer, PrioritizedReplayBuffer])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("size", [1, 2, 6, 60])
@pytest.mark.parametrize("end_rate", [0.0, 0.1, 1.0])
def test_minibatches_are_those_of_a_buffer_that_stores_both(end_rate, size, n_envs, kind):
    buffer, both, worlds = make_buffer(size, n_envs, kind), Both(size, n_envs), Worlds(n_envs, end_rate=end_rate)
    for _ in range(3 * buffer.buffer_size + 2):
        step = worlds.step()
        add(buffer, step)
        both.add(step)
        rows = np.arange(buffer.n_rows)
        assert_same_bits(buffer.rows(rows), both.rows(rows))
        batch = buffer.sample(16)
        assert_same_bits(batch, both.rows(batch.rows))


@pytest.mark.parametrize("width", [255, 256, 400])
def test_long_observations_come_back_to_the_bit(width):
    """They are copied in another way."""
    space, rng = spaces.Box(-np.inf, np.inf, (width,), np.float32), np.random.default_rng(0)
    buffer = JointReplayBuffer(20, space, ACT, n_envs=2, n_agents=2, device="cpu")
    walk = rng.normal(size=(15, 2, width)).astype(np.float32)
    infos = [{name: [0, 0] for name in ("agent_rewards", "agent_terminated", "agent_alive")}] * 2
    for number in range(14):
        following = walk[number + 1] if number % 4 else -walk[number]
        buffer.add(walk[number], following, np.zeros((2, 2)), np.zeros(2), np.zeros(2), infos)
    batch = buffer.rows(np.arange(20))
    for row, (step, world) in enumerate((step, world) for step in (10, 11, 12, 13, 4, 5, 6, 7, 8, 9) for world in (0, 1)):
        assert batch.observations[row].numpy().tobytes() == walk[step, world].tobytes()
        following = walk[step + 1, world] if step % 4 else -walk[step, world]
        assert batch.next_observations[row].numpy().tobytes() == following.tobytes()


@pytest.mark.parametrize("rows", [[0, 3], [-1]])
def test_rows_that_are_not_there_are_refused(rows):
    buffer, worlds = make_buffer(40), Worlds(1)
    for _ in range(3):
        add(buffer, worlds.step())
    with pytest.raises(IndexError, match="holds 3"):
        buffer.rows(np.array(rows))


def test_uniform_draws_are_those_of_the_generator():
    buffer, worlds = make_buffer(40, n_envs=2), Worlds(2)
    for _ in range(25):
        add(buffer, worlds.step())
    rng = np.random.default_rng(0)
    for _ in range(3):
        np.testing.assert_array_equal(buffer.sample(16).rows, rng.integers(40, size=16))


def test_a_minibatch_is_written_into_the_same_tensors():
    buffer, worlds = make_buffer(40), Worlds(1)
    for _ in range(25):
        add(buffer, worlds.step())
    first, second = buffer.sample(16), buffer.sample(16)
    for name in (*TRANSITION_ARRAYS, "weights"):
        assert getattr(first, name) is getattr(second, name), name


@pytest.mark.parametrize("end_rate", [0.1, 1.0])
@pytest.mark.parametrize("n_envs", [1, 2, 3])
@pytest.mark.parametrize("size", [1, 2, 13, 40, 200])
def test_transitions_move_to_a_buffer_of_another_shape_and_it_goes_on(size, n_envs, end_rate):
    """From 20 steps of two worlds, the latest of 25, to fewer or more, in as many or other worlds."""
    saved, worlds = make_buffer(40, n_envs=2), Worlds(2, end_rate=end_rate)
    for _ in range(25):
        add(saved, worlds.step())
    transitions = saved.transitions()
    moved = make_buffer(size, n_envs)
    add(moved, Worlds(n_envs, seed=5).step())
    moved.set_state(*deepcopy((saved.state(), transitions)))
    given = moved.transitions()
    for name, array in transitions.items():
        rows = array.reshape(-1, array.shape[2])
        kept = given[name].reshape(-1, array.shape[2])
        assert moved.n_rows == len(kept) == min(40, max(size // n_envs, 1) * n_envs) // n_envs * n_envs
        assert kept.tobytes() == rows[len(rows) - len(kept) :].tobytes(), name
    both, worlds = Both(size, n_envs), Worlds(n_envs, seed=9, end_rate=end_rate)
    for i in range(len(given["rewards"])):
        both.add({name: array[i] for name, array in given.items()})
    both.steps = [None] * (moved.n_added - len(both.steps)) + both.steps
    for _ in range(moved.buffer_size + 2):
        step = worlds.step()
        add(moved, step)
        both.add(step)
        assert_same_bits(moved.rows(np.arange(moved.n_rows)), both.rows(np.arange(moved.n_rows)))


def test_a_restored_buffer_knows_what_the_next_step_follows():
    """The newest step's end is known after loading: the step that goes on from it takes no room apart."""
    saved, worlds = make_buffer(40), Worlds(1, end_rate=0)
    for _ in range(10):
        add(saved, worlds.step())
    moved = make_buffer(40)
    moved.set_state(*deepcopy((saved.state(), saved.transitions())))
    for buffer in (saved, moved):
        free = buffer._successors._n_free
        add(buffer, deepcopy(worlds).step())
        assert buffer._successors._n_free == free


def test_the_whole_arrays_can_be_read():
    buffer, worlds = make_buffer(40, n_envs=2), Worlds(2)
    for _ in range(5):
        add(buffer, worlds.step())
    given = buffer.transitions()
    for name in ("next_observations", "next_states"):
        whole = getattr(buffer, name)
        np.testing.assert_array_equal(whole[:5], given[name])
        assert whole.shape[:2] == (20, 2)
        assert not whole[5:].any()


def test_choices_states_and_doubles_are_kept_as_they_are():
    double = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    buffer = JointReplayBuffer(3, double, spaces.MultiDiscrete([4, 3]), n_agents=2, seed=0)
    infos = [{"agent_rewards": [0, 0], "agent_terminated": [False] * 2, "agent_alive": [True] * 2}]
    seen = [np.array([[0.1, number]]) for number in range(4)]
    for before, after in pairwise(seen):
        buffer.add(before, after, np.array([[3, 1]]), np.zeros(1), np.zeros(1), infos)
    given = buffer.transitions()
    assert given["next_observations"][:, 0].tolist() == [[0.1, 1], [0.1, 2], [0.1, 3]]
    assert (given["observations"].dtype, given["actions"].dtype) == (np.float64, np.int64)
    assert buffer.rows(np.arange(3)).next_observations.tolist() == np.float32([[0.1, 1], [0.1, 2], [0.1, 3]]).tolist()


def test_an_emptied_buffer_does_not_go_on_from_what_it_held():
    buffer, worlds, both = make_buffer(40), Worlds(1), Both(40, 1)
    for _ in range(25):
        add(buffer, worlds.step())
    buffer.reset()
    for _ in range(5):
        step = worlds.step()
        add(buffer, step)
        both.add(step)
    assert_same_bits(buffer.rows(np.arange(5)), both.rows(np.arange(5)))


def test_a_copied_buffer_is_one_of_its_own():
    buffer, worlds = make_buffer(40), Worlds(1)
    for _ in range(25):
        add(buffer, worlds.step())
    buffer.sample(16)
    other = deepcopy(buffer)
    step = worlds.step()
    add(other, step)
    add(buffer, step)
    np.testing.assert_array_equal(buffer.sample(16).next_observations, other.sample(16).next_observations)
    add(other, worlds.step())
    assert not np.array_equal(buffer.observations, other.observations)


def test_sampling_for_another_device_copies():
    buffer = make_buffer(4)
    add(buffer, Worlds(1).step())
    buffer.device = th.device("meta")
    assert buffer.sample(2).observations.device.type == "meta"


# ---- memory


def arrays_of(value):
    """All arrays of an object and of the objects of this package in it."""
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, dict):
        return [array for item in value.values() for array in arrays_of(item)]
    if type(value).__module__.startswith("sb3_kfcv.") and hasattr(value, "__dict__"):
        return arrays_of({name: item for name, item in vars(value).items() if name != "_minibatch"})
    return []


def real_bytes(buffer):
    """Of the distinct arrays."""
    return sum({id(array): array.nbytes for array in arrays_of(buffer)}.values())


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("state_size", [0, 7])
@pytest.mark.parametrize(("size", "n_envs"), [(2, 1), (2, 4), (1000, 1), (1000, 32)])
@pytest.mark.parametrize("kind", KINDS)
def test_the_memory_of_a_buffer_is_told_before_and_after(kind, size, n_envs, state_size, discrete):
    action_space = spaces.MultiDiscrete([5, 3]) if discrete else ACT
    settings = {"n_envs": n_envs, "n_agents": 2, "state_size": state_size}
    kwargs = {"n_folds": 2} if kind == "curriculum" else {}
    buffer = KINDS[kind](size, OBS, action_space, device="cpu", **settings, **kwargs)
    assert buffer.n_bytes == real_bytes(buffer)
    assert buffer.n_bytes == KINDS[kind].estimate_bytes(size, OBS, action_space, **settings)


def test_episodes_of_twenty_steps_need_no_more_room():
    buffer, worlds = make_buffer(1000, n_envs=4), Worlds(4, end_rate=0)
    estimate = buffer.n_bytes
    for number in range(1000):
        if number % 20 == 0:
            worlds = Worlds(4, seed=number, end_rate=0)
        add(buffer, worlds.step())
    assert buffer.n_bytes == real_bytes(buffer) == estimate


def test_when_every_step_is_an_end_the_room_grows_to_the_bound():
    settings = {"n_envs": 4, "n_agents": 2, "state_size": STATE_SIZE}
    buffer = make_buffer(1000, n_envs=4)
    for number in range(1000):
        add(buffer, Worlds(4, seed=number).step())
    estimates = [JointReplayBuffer.estimate_bytes(1000, OBS, ACT, **settings, share_of_ends=share) for share in (0, 0.5, 1)]
    assert estimates[1] < buffer.n_bytes == real_bytes(buffer) <= estimates[2]
    assert estimates[0] == JointReplayBuffer.estimate_bytes(1000, OBS, ACT, **settings)


def test_what_was_apart_is_dropped_with_its_row():
    buffer, worlds = make_buffer(100), Worlds(1, end_rate=0)
    for number in range(100):
        add(buffer, Worlds(1, seed=number).step())
    grown = buffer.n_bytes
    successors = buffer._successors
    assert len(successors._free) - successors._n_free > 90
    for _ in range(101):
        add(buffer, worlds.step())
    assert successors._n_free == len(successors._free)
    for number in range(100):
        add(buffer, Worlds(1, seed=number).step())
    assert buffer.n_bytes == grown


def test_long_episodes_take_half_the_memory():
    """Of 10,000 transitions with 100 numbers seen, next observations would take 4 MB."""
    wide = spaces.Box(-np.inf, np.inf, (100,), np.float32)
    buffer = JointReplayBuffer(10_000, wide, ACT, device="cpu")
    assert buffer.n_bytes < 4e6 * 1.05 + 10_000 * 4 * (2 + 3 + 1) + 10_000
