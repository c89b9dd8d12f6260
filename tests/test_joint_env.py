"""One slot of a vec env is one whole world: the data contract, through every wrapper of SB3."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecMonitor, VecNormalize
from toy_envs import ToyParallelEnv

from sb3_kfcv import MADDPG, JointEnv, ParticleVecEnv, make_vec_env
from sb3_kfcv.vec_env.make import layout_of, make_joint_env, make_worlds

SMALL_GRASSLAND = {"n_wolves": 3, "n_sheep": 2, "max_steps": 12}
SMALL_SPREAD = {"n_agents": 2, "max_steps": 9}
QUICK = {"learning_starts": 20, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}


def joint(**kwargs):
    return JointEnv(ToyParallelEnv(**kwargs))


def zeros(env):
    return np.zeros(env.action_space.shape, env.action_space.dtype)


def play(env, steps, seed=0):
    """Infos and flags of some steps in which nobody moves: [(reward, terminated, truncated, info)], and observations."""
    observations = [env.reset(seed=seed)[0]]
    results = []
    for _ in range(steps):
        observation, *result = env.step(zeros(env))
        observations.append(observation)
        results.append(tuple(result))
    return observations, results


# ---- as a gym env


@pytest.mark.parametrize("continuous_actions", [True, False])
@pytest.mark.parametrize(("world", "kwargs"), [("HardSpread-v0", {}), ("Grassland-v0", {})])
def test_gym_ids_pass_sb3s_check(world, kwargs, continuous_actions):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        check_env(gym.make(world, continuous_actions=continuous_actions, **kwargs).unwrapped, skip_render_check=False)


@pytest.mark.parametrize("discrete", [False, True])
def test_any_parallel_env_passes_sb3s_check(discrete):
    check_env(joint(discrete=discrete, time_limit=5))


def test_observations_stand_side_by_side():
    env = joint()
    observation, _ = env.reset(seed=4)
    x, y, z = env.parallel_env.places.values()
    np.testing.assert_allclose(observation, [x, 0, 0, y, 0, 0, z, 0], rtol=1e-6)


def test_action_row_is_cut_into_the_agents_actions():
    env = joint()
    env.reset(seed=0)
    env.step(np.array([0.1, 0.2, 0.3, 0.4, 2.0], np.float32))
    received = env.parallel_env.received[0]
    np.testing.assert_allclose(received["scout_0"], [0.1, 0.2])
    np.testing.assert_allclose(received["scout_1"], [0.3, 0.4])
    np.testing.assert_allclose(received["tank_0"], [2.0])


def test_choices_are_handed_to_their_agents():
    env = joint(discrete=True)
    assert env.action_space.nvec.tolist() == [4, 4, 3]
    env.reset(seed=0)
    env.step(np.array([3, 0, 2]))
    assert env.parallel_env.received[0] == {"scout_0": 3, "scout_1": 0, "tank_0": 2}


def test_action_bounds_are_the_agents_own():
    assert joint().action_space.high.tolist() == [1, 1, 1, 1, 2]


# ---- infos


def test_every_info_carries_the_agents_rewards():
    _, results = play(joint(), 2)
    for t, (_, _, _, info) in enumerate(results, start=1):
        assert info["agent_rewards"].dtype == np.float32
        assert info["agent_rewards"].tolist() == [t, 2 * t, 3 * t]


def test_a_death_is_seen_in_its_step_and_stays():
    _, results = play(joint(deaths={"scout_1": 2}), 3)
    assert [info["agent_alive"].tolist() for *_, info in results] == [[True] * 3, [True] * 3, [True, False, True]]
    assert [info["agent_terminated"].tolist() for *_, info in results] == [
        [False] * 3,
        [False, True, False],
        [False, True, False],
    ]
    assert all(info[key].dtype == bool for *_, info in results for key in ("agent_alive", "agent_terminated"))


def test_a_death_does_not_end_the_world():
    _, results = play(joint(deaths={"scout_1": 2}), 3)
    assert not any(terminated or truncated for _, terminated, truncated, _ in results)


def test_the_dead_get_no_rewards():
    _, results = play(joint(deaths={"scout_1": 2}), 3)
    assert results[1][3]["agent_rewards"].tolist() == [2, 4, 6]  # the last one, in the step of the death
    assert results[2][3]["agent_rewards"].tolist() == [3, 0, 9]


def test_the_dead_are_seen_as_zeros():
    observations, _ = play(joint(deaths={"scout_1": 2}), 3)
    assert observations[1][3:6].any()
    assert not observations[2][3:6].any()
    assert not observations[3][3:6].any()


def test_a_new_episode_raises_the_dead():
    env = joint(deaths={"scout_1": 1}, time_limit=2)
    play(env, 2)
    _, results = play(env, 1)
    assert results[0][3]["agent_alive"].tolist() == [True] * 3


def test_states_before_and_after_the_step():
    env = joint()
    _, results = play(env, 2)
    places = np.float32(list(env.parallel_env.places.values()))
    for t, (*_, info) in enumerate(results):
        np.testing.assert_array_equal(info["state"], [t, *places])
        np.testing.assert_array_equal(info["next_state"], [t + 1, *places])


def test_a_world_without_state_gives_none():
    env = joint(with_state=False)
    _, results = play(env, 1)
    assert env.layout.state_size == 0
    assert "state" not in results[0][3]


# ---- agents that come late, and that are cut off alone


def test_who_joins_late_is_absent_until_then():
    _, results = play(joint(joins={"tank_0": 2}), 3)
    assert [info["agent_alive"].tolist() for *_, info in results] == [[True, True, False]] * 2 + [[True] * 3]
    assert [info["agent_terminated"].tolist() for *_, info in results] == [[False, False, True]] + [[False] * 3] * 2
    assert [info["agent_rewards"][2] for *_, info in results] == [0, 0, 9]


def test_who_joins_late_is_seen_from_then_on():
    observations, _ = play(joint(joins={"tank_0": 2}), 3)
    assert [bool(row[6:].any()) for row in observations] == [False, False, True, True]


def test_who_is_cut_off_alone_is_no_death_in_its_step_and_absent_later():
    observations, results = play(joint(cuts={"scout_1": 2}), 3)
    assert [info["agent_terminated"].tolist()[1] for *_, info in results] == [False, False, True]
    assert [info["agent_alive"].tolist()[1] for *_, info in results] == [True, True, False]
    assert observations[2][4] == 2  # its last observation, from which its return goes on
    assert not observations[3][3:6].any()


def test_a_world_in_which_the_last_agents_are_cut_off_one_by_one_is_truncated():
    _, results = play(joint(cuts={"scout_0": 1, "scout_1": 2, "tank_0": 3}), 3)
    assert [(terminated, truncated) for _, terminated, truncated, _ in results] == [(False, False)] * 2 + [(False, True)]


def test_a_world_whose_last_agents_die_after_one_was_cut_off_has_ended():
    _, results = play(joint(cuts={"scout_0": 1}, deaths={"scout_1": 2, "tank_0": 2}), 2)
    assert results[-1][1:3] == (True, False)


class Lingering(ToyParallelEnv):
    """Leaves it to the next reset to empty the list of agents, as many worlds do."""

    def step(self, actions):
        result = super().step(actions)
        self.agents = list(self.possible_agents)
        return result


def test_an_episode_is_over_when_all_agents_are_flagged():
    _, results = play(JointEnv(Lingering(time_limit=2)), 2)
    assert [truncated for _, _, truncated, _ in results] == [False, True]
    assert "episode_metrics" in results[1][3]


def test_joiners_and_cuts_are_trained_on():
    env = joint(joins={"tank_0": 2}, cuts={"scout_1": 3}, time_limit=5)
    model = MADDPG("MlpPolicy", env, seed=0, **QUICK).learn(40)
    assert model.replay_buffer.alive[:5, 0].tolist() == [[1, 1, 0], [1, 1, 0], [1, 1, 1], [1, 0, 1], [1, 0, 1]]
    assert model.replay_buffer.dones[:5, 0].tolist() == [[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 1, 0], [0, 1, 0]]


# ---- worlds that break the rules


def test_a_stranger_is_named():
    env = joint()
    env.reset(seed=0)
    env.parallel_env.agents.append("ghost_0")
    env.parallel_env._observations = lambda agents: {}
    with pytest.raises(
        ValueError, match=r"'ghost_0' joined the world, which has the possible_agents scout_0, scout_1, tank_0"
    ):
        env._find_present({}, {})


def test_a_world_that_does_not_say_who_may_take_part_is_refused():
    with pytest.raises(ValueError, match="lists no possible_agents"):
        JointEnv(ToyParallelEnv(agents=()))


def grown(env, agent):
    """Let an agent observe one number more."""
    env.parallel_env._observation_spaces[agent] = gym.spaces.Box(-np.inf, np.inf, (4,), np.float32)


def test_spaces_that_change_between_episodes_are_named():
    env = joint()
    env.reset(seed=0)
    grown(env, "scout_1")
    with pytest.raises(ValueError, match=r"observation space of 'scout_1' was Box\(.*\(3,\).* and has become Box\(.*\(4,\)"):
        env.reset()


def test_spaces_of_a_joiner_that_have_changed_are_named():
    env = joint(joins={"tank_0": 1})
    env.reset(seed=0)
    env.parallel_env._action_spaces["tank_0"] = gym.spaces.Box(-1, 1, (3,), np.float32)
    with pytest.raises(ValueError, match=r"action space of 'tank_0' was .* and has become"):
        env.step(zeros(env))


def test_observations_that_change_within_an_episode_are_named():
    env = joint()
    env.reset(seed=0)
    grown(env, "scout_1")
    env.parallel_env._observations = lambda agents: {agent: np.zeros(4, np.float32) for agent in ["scout_1"]}
    with pytest.raises(ValueError, match=r"observation of 'scout_1' is an array of shape \(4,\).*\(3,\).*become.*\(4,\)"):
        env.step(zeros(env))


def test_a_single_number_does_not_pass_for_a_vector():
    env = joint()
    env.reset(seed=0)
    env.parallel_env._observations = lambda agents: {"scout_1": np.zeros(1, np.float32)}
    with pytest.raises(ValueError, match=r"observation of 'scout_1' is an array of shape \(1,\)"):
        env.step(zeros(env))


def test_a_state_of_another_length_is_refused():
    env = joint()
    env.parallel_env.state = lambda: np.zeros(3, np.float32)
    with pytest.raises(ValueError, match="state has 3 numbers; its state_space says 4"):
        env.reset(seed=0)


def test_a_wrapper_that_hides_the_end_is_found_out():
    env = JointEnv(pytest.importorskip("supersuit").black_death_v3(ToyParallelEnv(time_limit=2)))
    with pytest.raises(ValueError, match=r"goes on although its world has ended.*black_death"):
        play(env, 2)


# ---- the end of an episode


def test_a_time_limit_truncates_and_nobody_dies():
    _, results = play(joint(time_limit=2), 2)
    _, terminated, truncated, info = results[-1]
    assert (terminated, truncated) == (False, True)
    assert not info["agent_terminated"].any()


def test_the_worlds_end_terminates_all():
    _, results = play(joint(end=2), 2)
    _, terminated, truncated, info = results[-1]
    assert (terminated, truncated) == (True, False)
    assert info["agent_terminated"].all()


def test_the_last_death_terminates_the_world():
    _, results = play(joint(deaths={"scout_0": 1, "scout_1": 2, "tank_0": 3}), 3)
    assert [(terminated, truncated) for _, terminated, truncated, _ in results] == [
        (False, False),
        (False, False),
        (True, False),
    ]


def test_at_the_time_limit_only_who_died_is_gone():
    _, results = play(joint(deaths={"scout_0": 2}, time_limit=2), 2)
    _, terminated, truncated, info = results[-1]
    assert (terminated, truncated) == (False, True)
    assert info["agent_terminated"].tolist() == [True, False, False]


def test_a_world_that_ends_just_at_its_time_limit_has_ended():
    """SB3 and Gymnasium: ``TimeLimit.truncated`` is for episodes that did not terminate."""
    vec_env = DummyVecEnv([lambda: joint(end=2, time_limit=2)])
    vec_env.reset()
    for _ in range(2):
        _, _, _, infos = vec_env.step(np.zeros((1, 5), np.float32))
    assert infos[0]["agent_terminated"].all()
    assert not infos[0]["TimeLimit.truncated"]


def test_group_returns_at_the_end():
    """Rewards (i + 1) · t over t = 1, 2: 3, 6, 9. Scouts: (3 + 6) / 2 = 4.5; tank: 9."""
    _, results = play(joint(time_limit=2), 2)
    assert "episode_metrics" not in results[0][3]
    info = results[1][3]
    assert info["episode_metrics"] == {"return_scout": 4.5, "return_tank": 9.0}
    assert (info["return_scout"], info["return_tank"]) == (4.5, 9.0)


def test_group_returns_start_anew_in_each_episode():
    env = joint(time_limit=2)
    play(env, 2)
    _, results = play(env, 2)
    assert results[1][3]["return_tank"] == 9.0


@pytest.mark.parametrize(("reward", "first"), [("default", 2.0), ("mean", 2.0), ("sum", 6.0), ("scout", 1.5), ("tank", 3.0)])
def test_the_scalar_reward_can_be_chosen(reward, first):
    """The first step's rewards are 1, 2 and 3."""
    env = JointEnv(ToyParallelEnv(), reward=reward)
    env.reset(seed=0)
    assert env.step(zeros(env))[1] == first


def test_an_unknown_scalar_reward_is_refused():
    with pytest.raises(ValueError, match="tank"):
        JointEnv(ToyParallelEnv(), reward="tnk")


@pytest.mark.parametrize(
    ("world", "kwargs", "members"), [("HardSpread-v0", SMALL_SPREAD, [0, 1]), ("Grassland-v0", SMALL_GRASSLAND, [0, 1, 2])]
)
def test_the_declared_scalar_of_our_worlds(world, kwargs, members):
    """HardSpread: mean over agents; Grassland: mean over wolves."""
    env = make_joint_env(world, **kwargs)
    env.reset(seed=0)
    _, reward, *_, info = env.step(env.action_space.sample())
    assert reward == pytest.approx(info["agent_rewards"][members].mean(), rel=1e-5)


# ---- in SB3's vec envs and wrappers


def terminal_steps(vec_env, steps):
    vec_env.reset()
    found = []
    for _ in range(steps):
        _, _, dones, infos = vec_env.step(np.stack([zeros(vec_env)] * vec_env.num_envs))
        found += [info for done, info in zip(dones, infos, strict=True) if done]
    return found


@pytest.mark.parametrize("wrap", [DummyVecEnv, lambda fs: VecMonitor(DummyVecEnv(fs)), lambda fs: DummyVecEnv([monitored])])
def test_time_limit_and_last_observation_reach_sb3(wrap):
    (info,) = terminal_steps(wrap([lambda: joint(time_limit=3)]), 3)
    assert info["TimeLimit.truncated"]
    assert info["terminal_observation"][1] == 3  # the step, which a reset sets back to 0


def monitored():
    return Monitor(joint(time_limit=3), info_keywords=("return_scout",))


def test_monitor_writes_the_episode_metrics(tmp_path):
    env = Monitor(joint(time_limit=3), str(tmp_path / "m"), info_keywords=("return_scout", "return_tank"))
    play(env, 3)
    header, values = (tmp_path / "m.monitor.csv").read_text().splitlines()[1:3]
    assert header.split(",") == ["r", "l", "t", "return_scout", "return_tank"]
    row = dict(zip(header.split(","), values.split(","), strict=True))
    # rewards 1, 2, 3 times t = 1, 2, 3: 6, 12, 18; their mean 12; scouts 9, tank 18
    assert (float(row["r"]), int(row["l"]), float(row["return_scout"]), float(row["return_tank"])) == (12, 3, 9, 18)


def test_vec_monitor_counts_whole_worlds():
    (first, second) = terminal_steps(VecMonitor(DummyVecEnv([lambda: joint(time_limit=3)] * 2)), 3)
    assert first["episode"]["r"] == second["episode"]["r"] == 12
    assert first["episode"]["l"] == 3


def test_the_layout_is_found_through_wrappers():
    vec_env = VecMonitor(DummyVecEnv([monitored]))
    assert layout_of(vec_env).agents == ("scout_0", "scout_1", "tank_0")


def test_a_vec_env_without_layout_is_refused():
    with pytest.raises(ValueError, match="no agent layout"):
        layout_of(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))


def spread():
    return make_joint_env("HardSpread-v0", **SMALL_SPREAD)


def test_worlds_in_other_processes_step_as_here():
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 2, 4)).astype(np.float32)
    runs = []
    away = SubprocVecEnv([spread] * 2, start_method="spawn")
    try:
        for vec_env in (away, DummyVecEnv([spread] * 2)):
            vec_env.seed(5)
            runs.append([vec_env.reset(), *(vec_env.step(a) for a in actions)])
    finally:
        away.close()
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    for ours, theirs in zip(runs[0][1:], runs[1][1:], strict=True):
        assert_same_step(ours, theirs)


def assert_same_step(ours, theirs):
    """Bit for bit; an episode's ``return_…`` apart. A key that SB3 adds to every info only counts where it is true."""
    for one, other, dtype in zip(ours[:3], theirs[:3], (np.float32, np.float32, bool), strict=True):
        np.testing.assert_array_equal(one.astype(dtype), other.astype(dtype))  # SubprocVecEnv gives rewards in float64
    for one, other in zip(ours[3], theirs[3], strict=True):
        assert {key for key in one if one[key] is not False} == {key for key in other if other[key] is not False}
        for key in one.keys() - {"episode_metrics"}:
            if key.startswith("return_"):
                assert one[key] == pytest.approx(other[key], rel=1e-6)
            else:
                np.testing.assert_equal(one[key], other.get(key, False), err_msg=key)


@pytest.mark.parametrize("continuous", [True, False])
@pytest.mark.parametrize(("world", "kwargs"), [("HardSpread-v0", SMALL_SPREAD), ("Grassland-v0", SMALL_GRASSLAND)])
def test_a_batch_of_worlds_is_slot_for_slot_the_single_ones(world, kwargs, continuous):
    """Several episodes, the ends included: observations, rewards, ends, and every entry of every info."""
    kwargs = {**kwargs, "continuous_actions": continuous}
    batch = ParticleVecEnv(make_worlds(world, 3, kwargs))
    single = DummyVecEnv([lambda: make_joint_env(world, **kwargs)] * 3)
    assert batch.observation_space == single.observation_space
    assert batch.action_space == single.action_space
    assert layout_of(batch) == layout_of(single)
    for vec_env in (batch, single):
        vec_env.seed(11)
        vec_env.action_space.seed(3)
    np.testing.assert_array_equal(batch.reset(), single.reset())
    ends = 0
    for _ in range(60):
        actions = np.stack([batch.action_space.sample() for _ in range(3)])
        ours, theirs = batch.step(actions), single.step(actions)
        assert_same_step(ours, theirs)
        ends += int(ours[2].sum())
    assert ends >= 12  # three worlds, episodes of at most 12 steps


def test_the_returns_of_a_batch_are_those_of_single_worlds_to_the_bit():
    returns = []
    for vec_env in (ParticleVecEnv(make_worlds("HardSpread-v0", 1, SMALL_SPREAD)), DummyVecEnv([spread])):
        vec_env.seed(0)
        returns.append([info["return_agent"] for info in terminal_steps(vec_env, 18)])
    assert returns[0] == returns[1]


def test_observations_can_be_normalised():
    env = VecNormalize(make_vec_env("HardSpread-v0", 2, seed=0, env_kwargs=SMALL_SPREAD), norm_reward=False)
    model = MADDPG("MlpPolicy", env, seed=0, **QUICK).learn(120)
    assert model.replay_buffer.sample(64, env=env).observations.abs().max() <= env.clip_obs
    raw = model.replay_buffer.observations[: model.replay_buffer.pos]
    np.testing.assert_allclose(
        model.replay_buffer.rows(np.arange(5)).observations.numpy(), env.normalize_obs(raw.reshape(-1, raw.shape[-1])[:5])
    )


def test_stacked_frames_of_whole_worlds_are_refused():
    """They would stand side by side over all agents: nobody could tell whose they are."""
    env = VecFrameStack(DummyVecEnv([joint]), n_stack=2)
    with pytest.raises(ValueError, match=r"observe 8 numbers.*\(16,\).*VecFrameStack.*wrappers=\[supersuit.frame_stack_v2\]"):
        MADDPG("MlpPolicy", env, **QUICK)


def test_gymnasium_makes_a_vec_env_of_our_worlds():
    envs = gym.make_vec("HardSpread-v0", num_envs=2, vectorization_mode="sync", **SMALL_SPREAD)
    envs.reset(seed=0)
    for _ in range(SMALL_SPREAD["max_steps"]):
        _, _, _, truncated, infos = envs.step(envs.action_space.sample())
    assert truncated.tolist() == [True, True]
    assert infos["agent_rewards"].shape == (2, 2)


def test_normalised_rewards_are_refused():
    """They could not reach the agents' own rewards."""
    env = VecNormalize(make_vec_env("HardSpread-v0", 1, env_kwargs=SMALL_SPREAD), norm_reward=True)
    with pytest.raises(ValueError, match="norm_reward"):
        MADDPG("MlpPolicy", env, **QUICK)


def test_evaluation_and_checkpoints(tmp_path):
    env = make_vec_env("HardSpread-v0", 1, seed=0, env_kwargs=SMALL_SPREAD)
    evaluation = EvalCallback(
        make_vec_env("HardSpread-v0", 1, seed=1, env_kwargs=SMALL_SPREAD),
        n_eval_episodes=2,
        eval_freq=40,
        log_path=str(tmp_path),
        best_model_save_path=str(tmp_path),
        verbose=0,
    )
    checkpoints = CheckpointCallback(40, str(tmp_path), save_replay_buffer=True)
    MADDPG("MlpPolicy", env, seed=0, **QUICK).learn(80, callback=[evaluation, checkpoints])
    assert np.load(tmp_path / "evaluations.npz")["results"].shape == (2, 2)
    assert {"best_model.zip", "rl_model_40_steps.zip", "rl_model_80_steps.zip"} <= {p.name for p in tmp_path.iterdir()}


def test_evaluate_policy_gives_the_scalar_return():
    """Mean reward 2 · t over three steps: 2 + 4 + 6 = 12."""
    env = DummyVecEnv([monitored])
    model = MADDPG("MlpPolicy", env, **QUICK)
    assert evaluate_policy(model, env, n_eval_episodes=2) == (12.0, 0.0)


# ---- what the replay buffer gets through each way of building a vec env


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize(
    "build",
    [
        lambda n: DummyVecEnv([lambda: joint(time_limit=4)] * n),
        lambda n: DummyVecEnv([lambda: Monitor(joint(time_limit=4))] * n),
        lambda n: VecNormalize(DummyVecEnv([lambda: joint(time_limit=4)] * n), norm_obs=False, norm_reward=False),
    ],
    ids=["DummyVecEnv", "Monitor", "VecNormalize"],
)
def test_a_time_limit_is_stored_as_no_end(build, n_envs):
    model = MADDPG("MlpPolicy", build(n_envs), learning_starts=100, batch_size=8, policy_kwargs={"net_arch": [8]})
    model.learn(12 * n_envs)
    buffer = model.replay_buffer
    assert not buffer.dones.any()
    assert buffer.next_observations[:12, 0, 1].tolist() == [1, 2, 3, 4] * 3  # never the step 0 of the next episode
    assert buffer.observations[:12, 0, 1].tolist() == [0, 1, 2, 3] * 3
    np.testing.assert_array_equal(buffer.states.shape[-1], 0)  # only stored where the critics read them


def test_time_limit_of_the_compiled_worlds_is_stored_as_no_end():
    env = ParticleVecEnv(make_worlds("HardSpread-v0", 2, SMALL_SPREAD))
    model = MADDPG("MlpPolicy", env, learning_starts=100, batch_size=8).learn(2 * 27)
    assert model.replay_buffer.pos == 27
    assert not model.replay_buffer.dones.any()
    # Landmarks stay where they are within an episode, so (own place + landmark offset) is the same before and after a step.
    before, after = model.replay_buffer.observations[:27], model.replay_buffer.next_observations[:27]
    np.testing.assert_allclose(before[..., 2:4] + before[..., 4:6], after[..., 2:4] + after[..., 4:6], atol=1e-5)


def test_deaths_are_stored_per_agent():
    model = MADDPG("MlpPolicy", joint(deaths={"scout_1": 2}, time_limit=4), learning_starts=100, batch_size=8).learn(4)
    assert model.replay_buffer.dones[:4, 0].tolist() == [[0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 1, 0]]
    assert model.replay_buffer.alive[:4, 0].tolist() == [[1, 1, 1], [1, 1, 1], [1, 0, 1], [1, 0, 1]]
    assert model.replay_buffer.rewards[:4, 0].tolist() == [[1, 2, 3], [2, 4, 6], [3, 0, 9], [4, 0, 12]]


def test_actions_are_stored_in_the_unit_range():
    """The tank's actions reach from −2 to 2."""
    env = joint()
    model = MADDPG("MlpPolicy", env, learning_starts=100, batch_size=8, seed=0).learn(30)
    given = [float(action["tank_0"][0]) for action in env.parallel_env.received[-30:]]
    np.testing.assert_allclose(model.replay_buffer.actions[:30, 0, 4], np.array(given) / 2, atol=1e-6)
    assert max(np.abs(given)) > 1
