"""The joint replay buffer, and prioritised replay by rank (eq. 3–4)."""

from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from references import assert_equal_trees, fill
from scipy.stats import chisquare

from sb3_kfcv import PERMADDPG, Checkpoints, KFCVReplayBuffer, make_vec_env
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.replay import JointReplayBuffer, PrioritizedReplayBuffer
from sb3_kfcv.replay.ranks import cumulative_masses, importance_weights
from sb3_kfcv.saving.values import check_writable

LAYOUT = AgentLayout(("a_0", "a_1"), ("a", "a"), (2, 2), (1, 1), state_size=3)
OBS, ACT = spaces.Box(-np.inf, np.inf, (4,), np.float32), spaces.Box(-1, 1, (2,), np.float32)

# 1^−0.7, 2^−0.7, 3^−0.7, 4^−0.7 = 1, 0.61557, 0.46347, 0.37893, of sum 2.45797
P_OF_RANKS = [0.40684, 0.25044, 0.18856, 0.15416]


def make_buffer(kind=JointReplayBuffer, size=6, n_envs=1, **kwargs):
    kwargs = {"n_agents": 2, "state_size": 3, "seed": 0, "device": "cpu", **kwargs}
    return kind(size, OBS, ACT, n_envs=n_envs, **kwargs)


def add(buffer, number):
    """Step ``number``: every value of world e is number + e / 10."""
    worlds = number + np.arange(buffer.n_envs, dtype=np.float32) / 10
    infos = [
        {
            "agent_rewards": np.float32([w, -w]),
            "agent_terminated": np.array([False, number % 2 == 1]),
            "agent_alive": np.array([True, number % 3 == 0]),
            "state": np.full(3, w, np.float32),
            "next_state": np.full(3, w + 1, np.float32),
        }
        for w in worlds
    ]
    obs = np.repeat(worlds[:, None], 4, axis=1)
    buffer.add(obs, obs + 1, np.repeat(worlds[:, None], 2, axis=1), worlds, np.zeros(buffer.n_envs), infos)


def numbers(batch):
    """Which steps a minibatch holds, as told by its observations."""
    return batch.observations[:, 0].tolist()


# ---- uniform


def test_a_transition_comes_back_whole():
    buffer = make_buffer()
    add(buffer, 3)
    batch = buffer.sample(1)
    assert batch.observations.tolist() == [[3] * 4]
    assert batch.next_observations.tolist() == [[4] * 4]
    assert batch.actions.tolist() == [[3, 3]]
    assert batch.rewards.tolist() == [[3, -3]]
    assert batch.dones.tolist() == [[0, 1]]
    assert batch.alive.tolist() == [[1, 1]]
    assert batch.states.tolist() == [[3] * 3]
    assert batch.next_states.tolist() == [[4] * 3]
    assert batch.weights.tolist() == [1]


def test_choices_come_back_as_they_are():
    buffer = JointReplayBuffer(3, OBS, spaces.MultiDiscrete([4, 3]), n_agents=2, seed=0)
    infos = [{"agent_rewards": [0, 0], "agent_terminated": [False] * 2, "agent_alive": [True] * 2}]
    buffer.add(np.zeros((1, 4)), np.zeros((1, 4)), np.array([[3, 1]]), np.zeros(1), np.zeros(1), infos)
    assert buffer.sample(1).actions.tolist() == [[3, 1]]


def test_rows_are_numbered_in_the_order_they_fill():
    """Two worlds: row 0 is step 0 of world 0, row 1 is step 0 of world 1, row 2 is step 1 of world 0."""
    buffer = make_buffer(n_envs=2)
    for number in range(3):
        add(buffer, number)
    assert numbers(buffer.rows(np.arange(6))) == pytest.approx([0, 0.1, 1, 1.1, 2, 2.1])


def test_the_buffer_size_counts_transitions_of_all_worlds():
    assert make_buffer(size=6, n_envs=2).buffer_size * 2 == 6


def test_sampled_rows_say_where_they_lie():
    buffer = make_buffer(size=12, n_envs=2)
    for number in range(5):
        add(buffer, number)
    batch = buffer.sample(32)
    assert numbers(buffer.rows(batch.rows)) == numbers(batch)


def test_the_oldest_are_overwritten():
    buffer = make_buffer(size=4)
    for number in range(6):
        add(buffer, number)
    assert buffer.full
    assert sorted(set(numbers(buffer.sample(200)))) == [2, 3, 4, 5]


def test_nothing_unwritten_is_sampled():
    buffer = make_buffer(size=100)
    for number in range(1, 4):
        add(buffer, number)
    assert set(numbers(buffer.sample(200))) == {1, 2, 3}


def test_uniform_draws_are_uniform():
    buffer = make_buffer(size=10)
    for number in range(10):
        add(buffer, number)
    assert chisquare(np.bincount(buffer.sample(5000).rows, minlength=10)).pvalue > 1e-3


def test_same_seed_same_draws():
    draws = []
    for _ in range(2):
        buffer = make_buffer(size=50)
        fill(buffer, LAYOUT, 50)
        draws.append(buffer.sample(20).rows)
    np.testing.assert_array_equal(*draws)


def test_an_env_without_per_agent_values_is_told_what_to_do():
    with pytest.raises(ValueError, match=r"agent_rewards.*JointEnv"):
        make_buffer().add(np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((1, 2)), np.zeros(1), np.zeros(1), [{}])


def test_nothing_depends_on_optimize_memory_usage():
    """No observation is stored twice, with or without."""
    buffers = [make_buffer(optimize_memory_usage=wanted) for wanted in (False, True)]
    for buffer in buffers:
        fill(buffer, LAYOUT, 10)
    assert buffers[0].n_bytes == buffers[1].n_bytes
    assert_equal_trees(buffers[0].transitions(), buffers[1].transitions())


# ---- prioritised


def ranked_buffer(td_errors=(0.1, 4.0, 2.0, 0.5), **kwargs):
    """Four transitions, all replayed; by |δ| the order is rows 1, 2, 3, 0."""
    buffer = make_buffer(PrioritizedReplayBuffer, size=4, **kwargs)
    for number in range(4):
        add(buffer, number)
    buffer.update_priorities(np.arange(4), th.tensor(td_errors))
    return buffer


def probabilities(n, alpha):
    """P of each rank."""
    masses = cumulative_masses(n, alpha)
    return np.diff(masses, prepend=0) / masses[-1]


def test_probabilities_of_ranks_by_hand():
    np.testing.assert_allclose(probabilities(4, 0.7), P_OF_RANKS, atol=1e-5)


def test_alpha_zero_is_uniform():
    np.testing.assert_allclose(probabilities(4, 0.0), [0.25] * 4)


def test_the_last_rank_of_many_is_still_drawn():
    assert probabilities(5000, 0.7)[-1] > 0
    assert (np.diff(probabilities(5000, 0.7)) < 0).all()


def test_masses_of_fewer_ranks_are_the_first():
    np.testing.assert_array_equal(cumulative_masses(50, 0.7), cumulative_masses(5000, 0.7)[:50])


@pytest.mark.parametrize("batch_size", [1, 4])
def test_draws_follow_the_ranks(batch_size):
    buffer = ranked_buffer()
    drawn = np.concatenate([buffer.sample(batch_size).rows for _ in range(4000 // batch_size)])
    counts = np.bincount(drawn, minlength=4)[[1, 2, 3, 0]]
    assert chisquare(counts, np.array(P_OF_RANKS) / sum(P_OF_RANKS) * len(drawn)).pvalue > 1e-3


def weights_by_rank(buffer):
    """{rank: weight} as drawn; ranks 0 … 3 are rows 1, 2, 3, 0."""
    found = {}
    for _ in range(40):
        batch = buffer.sample(8)
        found.update(zip([[1, 2, 3, 0].index(row) for row in batch.rows], batch.weights.tolist(), strict=True))
    return [found[rank] for rank in range(4)]


def test_importance_weights_by_hand():
    """(4·P)^−β over the largest of them: (rank / 4)^(0.7 β). At β = 0.5: (1/4)^0.35, (2/4)^0.35, (3/4)^0.35, 1."""
    assert weights_by_rank(ranked_buffer()) == pytest.approx([0.61557, 0.78458, 0.90422, 1.0], abs=1e-5)


def test_importance_weights_are_full_at_the_end():
    """β = 1: (rank / 4)^0.7."""
    buffer = ranked_buffer()
    buffer.progress = 1.0
    assert weights_by_rank(buffer) == pytest.approx([0.37893, 0.61557, 0.81760, 1.0], abs=1e-5)


def test_weights_without_correction_are_one():
    assert importance_weights(np.arange(1, 5), 4, 0.7, beta=0.0).tolist() == [1] * 4


@pytest.mark.parametrize("beta", [0.5, 1.0])
def test_weights_are_those_of_the_probabilities(beta):
    """(n·P)^−β over the largest."""
    weights = (5000 * probabilities(5000, 0.7)) ** -beta
    np.testing.assert_allclose(importance_weights(np.arange(1, 5001), 5000, 0.7, beta), weights / weights.max(), rtol=1e-6)


@pytest.mark.parametrize(("progress", "beta"), [(0.0, 0.5), (0.5, 0.75), (1.0, 1.0)])
def test_beta_grows_from_a_half_to_one(progress, beta):
    buffer = ranked_buffer()
    buffer.progress = progress
    assert buffer.beta == pytest.approx(beta)


def shares(buffer, draws=2000):
    return np.bincount(buffer.sample(draws).rows, minlength=4) / draws


def test_a_new_transition_ranks_first():
    buffer = ranked_buffer()
    add(buffer, 9)  # overwrites row 0, the least of all
    assert shares(buffer)[0] == pytest.approx(P_OF_RANKS[0], abs=0.005)


def test_a_replayed_transition_takes_the_rank_of_its_error():
    buffer = ranked_buffer()
    buffer.update_priorities(np.array([1]), th.tensor([0.01]))  # the first becomes the last
    np.testing.assert_allclose(shares(buffer)[[2, 3, 0, 1]], P_OF_RANKS, atol=0.005)


def test_every_transition_keeps_a_chance():
    assert (shares(ranked_buffer(td_errors=(0.0, 1e9, 1e9, 1e9))) > 0.1).all()


def test_a_large_buffer_is_ranked_exactly_at_each_draw():
    """By the rows drawn, which are those of a stable sort of all |δ|, new transitions first."""
    buffer, rng = make_buffer(PrioritizedReplayBuffer, size=3000, n_envs=2), np.random.default_rng(0)
    fill(buffer, LAYOUT, 1400)
    masses = cumulative_masses(3000, 0.7)
    for i in range(40):
        n = buffer.n_rows
        batch = buffer.sample(64)
        points = (np.arange(64) + rng.random(64)) / 64 * masses[n - 1]
        places = np.searchsorted(masses[:n], points)
        np.testing.assert_array_equal(batch.rows, np.argsort(-buffer.td_errors[:n], kind="stable")[places])
        buffer.update_priorities(batch.rows, batch.rewards.abs().mean(1).round(decimals=1))
        fill(buffer, LAYOUT, 7, seed=i)


@pytest.mark.parametrize("kwargs", [{"alpha": -0.1}, {"beta_init": 1.5}, {"beta_init": -0.1}])
def test_settings_out_of_range_are_refused_by_name(kwargs):
    (name,) = kwargs
    with pytest.raises(ValueError, match=name):
        make_buffer(PrioritizedReplayBuffer, **kwargs)


# ---- saving


class MeanStudent:
    """Knows nothing: all targets are the rewards, all Q-values 0."""

    n_learning_agents = 2
    teacher_input_size = 6

    def teacher_inputs(self, batch):
        return th.cat([batch.observations, batch.actions], dim=1)

    def td_target(self, batch):
        return batch.rewards.T

    def q_values(self, batch):
        return th.zeros(2, len(batch.rows))

    def live(self, batch):
        return batch.alive.T


KFCV = {"n_folds": 3, "teacher_batch_size": 8, "teacher_steps": 3, "first_teacher_steps": 3, "refresh_every": 4}
BUFFERS = {
    "uniform": (JointReplayBuffer, {}),
    "prioritised": (PrioritizedReplayBuffer, {}),
    "curriculum": (KFCVReplayBuffer, KFCV),
}


def used_buffer(name, size, seed=0, steps=25):
    kind, kwargs = BUFFERS[name]
    buffer = make_buffer(kind, size=size, n_envs=2, seed=seed, **kwargs)
    th.manual_seed(seed)
    buffer.attach(MeanStudent())
    fill(buffer, LAYOUT, steps, seed=seed, death_rate=0.1)
    use(buffer)
    return buffer


def by_row(buffer):
    return buffer.rewards.reshape(-1, buffer.rewards.shape[-1])[: buffer.n_rows]


def use(buffer, times=10):
    """Draw and re-rank, add something new in between; the rows drawn."""
    drawn = []
    for i in range(times):
        batch = buffer.sample(8)
        drawn.append(batch.rows)
        buffer.update_priorities(batch.rows, batch.rewards.abs().mean(1))
        fill(buffer, LAYOUT, 1, seed=100 + i)
    return np.concatenate(drawn)


@pytest.mark.parametrize("size", [40, 200], ids=["full", "part full"])
@pytest.mark.parametrize("name", BUFFERS)
def test_a_restored_buffer_goes_on_as_the_saved_one(name, size):
    """Rows drawn, refreshes and re-rankings included, to the bit."""
    saved = used_buffer(name, size)
    state, transitions = deepcopy((saved.state(), saved.transitions()))
    restored = used_buffer(name, size, seed=7, steps=5)
    restored.set_state(state, transitions)
    assert_equal_trees(restored.state(), state)
    assert_equal_trees(restored.transitions(), transitions)
    np.testing.assert_array_equal(use(saved), use(restored))


@pytest.mark.parametrize("name", BUFFERS)
def test_a_buffer_is_made_of_plain_values(name):
    check_writable(used_buffer(name, 40).state())


@pytest.mark.parametrize("n_envs", [1, 2, 3])
@pytest.mark.parametrize("size", [12, 40, 90])
@pytest.mark.parametrize("name", BUFFERS)
def test_the_latest_transitions_move_to_a_buffer_of_another_shape(name, size, n_envs):
    """With what is noted of each: seen by looking up the rewards, which tell the transitions apart."""
    saved = used_buffer(name, 40)
    kind, kwargs = BUFFERS[name]
    moved = make_buffer(kind, size=size, n_envs=n_envs, **kwargs)
    moved.attach(MeanStudent())
    moved.set_state(*deepcopy((saved.state(), saved.transitions())))
    latest = saved.transitions()["rewards"].reshape(saved.n_rows, -1)
    held = moved.transitions()["rewards"].reshape(moved.n_rows, -1)
    assert moved.n_rows == min(saved.n_rows, size) // n_envs * n_envs
    np.testing.assert_array_equal(held, latest[len(latest) - len(held) :])
    for noted in ("td_errors", "folds", "scores", "buckets"):
        if hasattr(saved, noted):
            of = {row.tobytes(): value for row, value in zip(by_row(saved), getattr(saved, noted), strict=False)}
            for row, value in zip(by_row(moved), getattr(moved, noted), strict=False):
                assert of[row.tobytes()] == value, noted
    use(moved)


def test_an_order_of_the_priorities_in_a_file_is_not_needed():
    """It follows from |δ|: files may hold it."""
    saved, restored = used_buffer("prioritised", 40), used_buffer("prioritised", 40, seed=7)
    state = deepcopy({**saved.state(), "by_rank": np.arange(40)[::-1], "draws_since_sort": 3})
    restored.set_state(state, saved.transitions())
    np.testing.assert_array_equal(use(saved), use(restored))


def test_models_and_checkpoints_may_name_settings_that_are_no_more(tmp_path):
    """Files of format 1 may say how often the ranks were refreshed."""

    def make():
        env = make_vec_env("HardSpread-v0", 2, seed=0, env_kwargs={"n_agents": 2, "max_steps": 8})
        small = {"learning_starts": 10, "batch_size": 8, "buffer_size": 24, "policy_kwargs": {"net_arch": [4]}}
        return PERMADDPG("MlpPolicy", env, seed=0, device="cpu", replay_buffer_kwargs={"alpha": 0.5}, **small)

    model = make()
    model.replay_buffer_kwargs = {"alpha": 0.5, "sort_above": 10, "sort_every": 7}
    model.learn(40, Checkpoints(tmp_path, save_freq=40))
    loaded = PERMADDPG.load(tmp_path / "rl_model_40_steps.zip", make().get_env())
    assert (loaded.replay_buffer_kwargs, loaded.replay_buffer.alpha) == ({"alpha": 0.5}, 0.5)
    assert make().learn(60, Checkpoints(tmp_path, save_freq=40, resume=True)).num_timesteps == 60


def test_transitions_are_given_from_a_step_on():
    buffer = used_buffer("uniform", 40)
    whole, part = buffer.transitions(), buffer.transitions(buffer.n_added - 7)
    for name, values in whole.items():
        np.testing.assert_array_equal(part[name], values[-7:])
    assert len(buffer.transitions(buffer.n_added)["rewards"]) == 0


def test_a_buffer_that_was_emptied_counts_anew():
    buffer = used_buffer("uniform", 40)
    buffer.reset()
    assert (buffer.n_added, buffer.n_rows) == (0, 0)


def test_transitions_of_another_world_are_refused():
    saved = used_buffer("uniform", 40)
    with pytest.raises(ValueError, match=r"not a replay buffer of this model.*rewards"):
        make_buffer(size=40, n_envs=2, n_agents=3).set_state(saved.state(), saved.transitions())
