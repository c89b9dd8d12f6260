"""Curriculum and prioritised replay under SB3's own algorithms: uniform settings change nothing, the others what they say."""

from copy import deepcopy
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from references import assert_equal_trees
from stable_baselines3 import DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch.nn import functional as F

from sb3_kfcv import KFCVReplayBuffer
from sb3_kfcv.stock import ReplayCallback, StockKFCVReplayBuffer, StockPrioritizedReplayBuffer, StockStudent
from sb3_kfcv.stock.students import TQCStudent, own_draws, student_class

ALGORITHMS = {"DQN": DQN, "DDPG": DDPG, "TD3": TD3, "SAC": SAC}
UNIFORM = {
    "alpha=0": (StockPrioritizedReplayBuffer, {"alpha": 0}),
    "lambda_init=1": (StockKFCVReplayBuffer, {"lambda_init": 1, "refresh_every": 40, "first_teacher_steps": 2}),
    "curriculum_fraction=0": (StockKFCVReplayBuffer, {"curriculum_fraction": 0}),
}
CURRICULUM = {"refresh_every": 20, "first_teacher_steps": 3, "teacher_steps": 2, "teacher_net_arch": (8,)}


class Drift(gym.Env):
    """A point that drifts and is pushed; it terminates beyond 1.5, and the reward is its distance from 0."""

    def __init__(self, discrete, observations="box"):
        self.action_space = spaces.Discrete(3) if discrete else spaces.Box(-2, 2, (2,), np.float32)
        self.kind = observations
        self.observation_space = {
            "box": spaces.Box(-np.inf, np.inf, (3,), np.float32),
            "discrete": spaces.Discrete(5),
            "dict": spaces.Dict({"x": spaces.Box(-1, 1, (2,), np.float32)}),
            "image": spaces.Box(0, 255, (36, 36, 1), np.uint8),
        }[observations]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.normal(size=3) / 2
        return self._seen(), {}

    def step(self, action):
        push = (np.atleast_1d(action) - np.ones(1)) if isinstance(self.action_space, spaces.Discrete) else action
        self.x = self.x + self.np_random.normal(size=3) / 5 + 0.1 * push.sum()
        distance = float(np.abs(self.x).max())
        return self._seen(), -distance, distance > 1.5, False, {}

    def _seen(self):
        if self.kind == "discrete":
            return int(np.clip(self.x[0] + 2.5, 0, 4))
        return self.x.astype(np.float32)


def worlds(discrete, n=1, time_limit=7, **kwargs):
    return DummyVecEnv([lambda: gym.wrappers.TimeLimit(Drift(discrete, **kwargs), time_limit)] * n)


def make(name, kind=None, settings=None, env=None, **kwargs):
    env = worlds(name == "DQN") if env is None else env
    kwargs = {"learning_starts": 20, "batch_size": 16, "buffer_size": 150, "seed": 3, "device": "cpu", **kwargs}
    if name == "DQN":
        kwargs = {"train_freq": 1, "target_update_interval": 30, "exploration_fraction": 0.5, **kwargs}
    kwargs["policy_kwargs"] = {"net_arch": [16], **kwargs.get("policy_kwargs", {})}
    return ALGORITHMS[name]("MlpPolicy", env, replay_buffer_class=kind, replay_buffer_kwargs=settings, **kwargs)


def attached(name, kind, settings=None, steps=40, **kwargs):
    """A model whose buffer holds some steps and knows it, before any update."""
    model = make(name, kind, {"seed": 5, **(settings or {})}, learning_starts=10_000, **kwargs)
    model.learn(steps, ReplayCallback())
    model.replay_buffer.attach(student_class(model)(model, np.random.default_rng(11)))
    model.replay_buffer.progress = 0.0
    return model


# ---- uniform settings are SB3's own replay, to the bit


@pytest.fixture(scope="module")
def by_sb3():
    """Trained with SB3's own buffer: parameters and the draws that follow, name → (model, draws)."""
    trained = {}
    for name in ALGORITHMS:
        model = make(name, ReplayBuffer).learn(220)
        trained[name] = model, np.random.random(), th.rand(1).item()
    return trained


@pytest.mark.parametrize("name", ALGORITHMS)
@pytest.mark.parametrize("setting", UNIFORM)
def test_uniform_settings_train_as_sb3_does_to_the_bit(name, setting, by_sb3):
    kind, settings = UNIFORM[setting]
    model = make(name, kind, settings)
    if setting == "curriculum_fraction=0":
        with pytest.warns(UserWarning, match="all replay is uniform"):
            model.learn(220, ReplayCallback())
    else:
        model.learn(220, ReplayCallback())
    theirs, numpy_draw, torch_draw = by_sb3[name]
    assert model._n_updates == theirs._n_updates == 200
    assert_equal_trees(model.get_parameters(), theirs.get_parameters())
    assert (np.random.random(), th.rand(1).item()) == (numpy_draw, torch_draw)
    if setting == "lambda_init=1":
        assert model.replay_buffer.n_refreshes > 2


@pytest.mark.parametrize("name", ["DQN", "TD3"])
def test_uniform_settings_train_as_sb3_does_under_vec_normalize_with_several_worlds(name):
    def trained(kind, settings, callback):
        env = VecNormalize(worlds(name == "DQN", n=3), norm_obs=True, norm_reward=True)
        return make(name, kind, settings, env=env, gradient_steps=2).learn(240, callback)

    ours = trained(StockKFCVReplayBuffer, {"lambda_init": 1, **CURRICULUM}, ReplayCallback())
    assert_equal_trees(ours.get_parameters(), trained(ReplayBuffer, {}, None).get_parameters())


@pytest.mark.parametrize("observations", ["box", "discrete"])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_transitions_come_back_as_from_sb3s_buffer(observations, n_envs):
    """After the ring has come round, with terminations, time limits, choices and numbers as observations."""
    pairs = []
    for kind, callback in ((ReplayBuffer, None), (StockPrioritizedReplayBuffer, ReplayCallback())):
        env = worlds(True, n=n_envs, observations=observations)
        model = make("DQN", kind, {"alpha": 0} if callback else {}, env=env, learning_starts=999, buffer_size=40 * n_envs)
        model.learn(60 * n_envs, callback)
        if callback:
            model.replay_buffer.attach(student_class(model)(model, np.random.default_rng(0)))
        np.random.seed(8)
        pairs.append(model.replay_buffer.sample(200))
    theirs, ours = pairs
    assert 0 < theirs.dones.mean() < 0.5
    for field in ("observations", "actions", "next_observations", "dones", "rewards"):
        assert getattr(ours, field).shape == getattr(theirs, field).shape
        assert th.equal(getattr(ours, field).double(), getattr(theirs, field).double()), field


def test_time_limits_can_end_the_return_as_in_sb3():
    model = attached("DQN", StockKFCVReplayBuffer, {"handle_timeout_termination": False}, env=worlds(True, time_limit=1))
    assert model.replay_buffer.sample(16).dones.all()


# ---- TD targets and priorities


@pytest.mark.parametrize("name", ["DQN", "DDPG"])
def test_target_and_q_are_those_of_sb3s_loss(name):
    """Nothing is random in these two: the loss that SB3 logs is that of our errors."""
    model = attached(name, StockPrioritizedReplayBuffer, steps=80)
    student, drawn = model.replay_buffer.learner, []
    sample = model.replay_buffer.sample

    def seen(*args, **kwargs):
        batch = sample(*args, **kwargs)
        drawn.append((student.td_target(batch), student.q_values(batch)))
        return batch

    model.replay_buffer.sample = seen
    model.train(1, 16)
    (target, values), loss = drawn[0], F.smooth_l1_loss if name == "DQN" else F.mse_loss
    logged = model.logger.name_to_value["train/loss" if name == "DQN" else "train/critic_loss"]
    assert target.shape == (1, 16)
    assert loss(values, target).item() == pytest.approx(logged, rel=1e-6)


def test_target_of_td3_has_clipped_noise_of_its_own():
    model = attached("TD3", StockPrioritizedReplayBuffer, target_policy_noise=0.5, target_noise_clip=0.3)
    student, batch = model.replay_buffer.learner, model.replay_buffer.rows(np.arange(30))
    with own_draws(deepcopy(student.rng), th.device("cpu")), th.no_grad():
        noise = (0.5 * th.randn(30, 2)).clamp(-0.3, 0.3)
        actions = (model.actor_target(batch.next_observations) + noise).clamp(-1, 1)
        lower = th.minimum(*model.critic_target(batch.next_observations, actions))
    expected = batch.rewards + 0.99 * (1 - batch.dones) * lower
    assert th.allclose(student.td_target(batch), expected.T, rtol=1e-6)
    assert (noise.abs() == 0.3).any()


@pytest.mark.parametrize("ent_coef", ["auto_0.2", 0.2])
def test_target_of_sac_has_the_entropy_of_a_squashed_gaussian(ent_coef):
    model = attached("SAC", StockPrioritizedReplayBuffer, ent_coef=ent_coef)
    student, batch = model.replay_buffer.learner, model.replay_buffer.rows(np.arange(30))
    with own_draws(deepcopy(student.rng), th.device("cpu")), th.no_grad():
        mean, log_std, _ = model.actor.get_action_dist_params(batch.next_observations)
        normal = th.distributions.Normal(mean, log_std.exp())
        raw = normal.sample()
        log_probability = (normal.log_prob(raw) - th.log(1 - raw.tanh() ** 2 + 1e-6)).sum(1, keepdim=True)
        lower = th.minimum(*model.critic_target(batch.next_observations, raw.tanh()))
    expected = batch.rewards + 0.99 * (1 - batch.dones) * (lower - 0.2 * log_probability)
    assert th.allclose(student.td_target(batch), expected.T, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_asking_the_student_leaves_no_trace(name):
    model = attached(name, StockKFCVReplayBuffer)
    student, batch = model.replay_buffer.learner, model.replay_buffer.rows(np.arange(9))
    model.policy.set_training_mode(True)
    th.manual_seed(0)
    before = th.rand(1)
    th.manual_seed(0)
    assert not student.td_target(batch).requires_grad and not student.q_values(batch).requires_grad
    assert th.rand(1) == before
    assert model.policy.training and student.critic.training


@pytest.mark.parametrize("name", ["TD3", "SAC"])
def test_random_targets_are_drawn_anew(name):
    model = attached(name, StockKFCVReplayBuffer)
    student, batch = model.replay_buffer.learner, model.replay_buffer.rows(np.arange(9))
    assert not th.equal(student.td_target(batch), student.td_target(batch))


def test_the_student_answers_without_dropout():
    model = attached("DQN", StockKFCVReplayBuffer, policy_kwargs={"activation_fn": th.nn.Dropout})
    student, batch = model.replay_buffer.learner, model.replay_buffer.rows(np.arange(9))
    model.policy.set_training_mode(True)
    assert th.equal(student.q_values(batch), student.q_values(batch))


def test_target_of_tqc_drops_the_highest_quantiles():
    """Two critics of two quantiles, one dropped for each: 1 and 2 of 1, 4, 2, 3 are kept."""
    critic = SimpleNamespace(quantiles_total=4, n_critics=2)
    spaces_of_model = {"observation_space": spaces.Box(-1, 1, (3,)), "action_space": spaces.Box(-1, 1, (1,))}
    model = SimpleNamespace(critic=critic, top_quantiles_to_drop_per_net=1, **spaces_of_model)
    estimates = th.tensor([[[1.0, 4.0], [2.0, 3.0]]])
    assert TQCStudent(model, np.random.default_rng(0)).pessimistic(estimates).tolist() == [[1.5]]


@pytest.mark.parametrize("kind", [StockKFCVReplayBuffer, StockPrioritizedReplayBuffer])
def test_tqc_learns(kind):
    contrib = pytest.importorskip("sb3_contrib")
    kwargs = {
        "learning_starts": 20,
        "batch_size": 16,
        "buffer_size": 150,
        "policy_kwargs": {"net_arch": [16]},
        "device": "cpu",
    }
    model = contrib.TQC("MlpPolicy", worlds(False), replay_buffer_class=kind, **kwargs)
    model.learn(60, ReplayCallback())
    assert model._n_updates == 40


def test_teachers_read_choices_as_one_hot():
    model = attached("DQN", StockKFCVReplayBuffer, env=worlds(True, observations="discrete"))
    student, batch = model.replay_buffer.learner, model.replay_buffer.rows(np.arange(9))
    inputs = student.teacher_inputs(batch)
    assert inputs.shape == (9, student.teacher_input_size) == (9, 5 + 3)
    assert inputs[:, :5].argmax(1).tolist() == batch.observations[:, 0].tolist()
    assert inputs[:, 5:].argmax(1).tolist() == batch.actions[:, 0].tolist()
    assert inputs.sum(1).tolist() == [2] * 9


def test_priorities_are_the_errors_before_the_update():
    model = attached("DQN", StockPrioritizedReplayBuffer)
    buffer, student = model.replay_buffer, model.replay_buffer.learner
    assert np.isinf(buffer.td_errors[: buffer.n_rows]).all()
    rows = buffer.sample(16).rows
    batch = buffer.rows(rows)
    errors = (student.td_target(batch) - student.q_values(batch))[0].abs()
    assert th.equal(th.as_tensor(buffer.td_errors[rows], dtype=th.float32), errors)
    assert np.isfinite(buffer.td_errors).sum() == len(set(rows.tolist()))


def weighted_change(model, batch):
    """How a step of SGD on the weighted loss of the critics moves them, with γ = 0: y = r; name → change."""
    twin = deepcopy(model.q_net if isinstance(model, DQN) else model.critic)
    weights = batch.weights[:, None]
    if isinstance(model, DQN):
        values = [twin(batch.observations).gather(1, batch.actions.long())]
        loss = (weights * F.smooth_l1_loss(values[0], batch.rewards, reduction="none")).mean()
    else:
        share = 0.5 if isinstance(model, SAC) else 1
        values = twin(batch.observations, batch.actions)
        loss = share * sum((weights * (value - batch.rewards) ** 2).mean() for value in values)
    named = dict(twin.named_parameters())
    gradients = th.autograd.grad(loss, list(named.values()), allow_unused=True)
    return {name: -0.1 * gradient for name, gradient in zip(named, gradients, strict=True) if gradient is not None}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_importance_weights_reach_the_critics_gradient(name):
    model = attached(
        *(name, StockPrioritizedReplayBuffer, {"alpha": 1.0, "beta_init": 1.0}),
        gamma=0.0,
        learning_rate=0.1,
        policy_kwargs={"optimizer_class": th.optim.SGD},
        **({"max_grad_norm": 1e9} if name == "DQN" else {"action_noise": None}),
    )
    buffer, drawn = model.replay_buffer, []
    sample = buffer.sample

    def seen(*args, **kwargs):
        batch = sample(*args, **kwargs)
        drawn.append(weighted_change(model, batch))
        assert batch.weights.std() > 0.1
        return batch

    buffer.sample = seen
    critic = buffer.learner.critic
    before = {key: value.clone() for key, value in critic.named_parameters()}
    model.train(1, 16)
    assert drawn[0]
    for key, change in drawn[0].items():
        assert th.allclose(critic.state_dict()[key] - before[key], change, rtol=1e-3, atol=1e-6), key


def test_weights_touch_no_other_question_to_the_critic():
    model = attached("SAC", StockPrioritizedReplayBuffer, {"alpha": 1.0, "beta_init": 1.0})
    batch = model.replay_buffer.sample(16)
    other = batch.actions.clone().requires_grad_()

    def gradient():
        return th.autograd.grad(sum(value.sum() for value in model.critic(batch.observations, other)), other)[0]

    hooked = gradient()
    model.replay_buffer.detach()
    assert th.equal(hooked, gradient())


def test_training_again_weighs_once_and_leaves_no_hook():
    model = make("DQN", StockPrioritizedReplayBuffer)
    for _ in range(2):
        model.learn(30, ReplayCallback())
        assert not model.q_net._forward_hooks
    model.replay_buffer.attach(student_class(model)(model, np.random.default_rng(0)))
    model.replay_buffer.attach(student_class(model)(model, np.random.default_rng(0)))
    assert len(model.q_net._forward_hooks) == 1


# ---- the curriculum


class Lines(KVWriter):
    """Keeps what is logged."""

    def __init__(self):
        self.lines = []

    def write(self, key_values, key_excluded, step=0):
        self.lines.append(dict(key_values))

    def close(self):
        pass


@pytest.mark.parametrize(("name", "n_envs"), [("DQN", 1), ("DDPG", 3), ("TD3", 1), ("SAC", 3)])
def test_the_curriculum_runs_through_its_stages(name, n_envs):
    lines = Lines()
    env = worlds(name == "DQN", n=n_envs)
    model = make(name, StockKFCVReplayBuffer, {"n_folds": 3, **CURRICULUM}, env=env, gradient_steps=-1)
    model.set_logger(Logger(None, [lines]))
    model.learn(300, ReplayCallback(), log_interval=2)
    stages = [line["curriculum/stage"] for line in lines.lines if "curriculum/stage" in line]
    assert stages == sorted(stages) and {1, 2, 3, 4} == set(stages)
    shares = [line["curriculum/share_bucket_1"] for line in lines.lines if "curriculum/share_bucket_1" in line]
    assert max(shares) > 0.4
    assert model.replay_buffer.n_refreshes > 5
    assert model.replay_buffer.progress == 1


def test_early_draws_are_of_the_easiest_bucket():
    """With λ = 0 the first stage is C_1 alone: those whose scores are the lowest third."""
    model = attached("DQN", StockKFCVReplayBuffer, {"n_folds": 3, "lambda_init": 0, **CURRICULUM})
    buffer = model.replay_buffer
    rows = buffer.sample(64).rows
    rows = buffer.sample(64).rows
    assert buffer.n_refreshes == 1 and buffer.n_rows == 40
    assert buffer.scores[rows].max() <= np.sort(buffer.scores[:40])[40 // 3]


@pytest.mark.parametrize("kind", [StockKFCVReplayBuffer, StockPrioritizedReplayBuffer])
def test_the_models_seed_decides_everything(kind):
    settings = CURRICULUM if kind is StockKFCVReplayBuffer else {}
    one, same, other = (make("SAC", kind, settings, seed=seed).learn(60, ReplayCallback()) for seed in (1, 1, 2))
    assert_equal_trees(one.get_parameters(), same.get_parameters())
    assert not np.array_equal(one.replay_buffer.rng.random(9), other.replay_buffer.rng.random(9))


def test_the_log_has_the_diagnostics_of_each_line_and_no_histogram_as_text():
    lines = Lines()
    model = make("DQN", StockPrioritizedReplayBuffer)
    model.set_logger(Logger(None, [lines]))
    model.learn(60, ReplayCallback(), log_interval=1)
    assert lines.lines
    assert all("per/beta" in line for line in lines.lines)
    assert lines.lines[-1]["per/beta"] > lines.lines[0]["per/beta"]


# ---- saving


@pytest.mark.parametrize("kind", [StockKFCVReplayBuffer, StockPrioritizedReplayBuffer])
def test_model_and_buffer_are_saved_and_go_on(kind, tmp_path):
    settings = CURRICULUM if kind is StockKFCVReplayBuffer else {}
    model = make("TD3", kind, settings).learn(90, ReplayCallback())
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = TD3.load(tmp_path / "model", worlds(False))
    loaded.load_replay_buffer(tmp_path / "buffer")
    ours, theirs = model.replay_buffer, loaded.replay_buffer
    assert not {"student", "_hook", "_drawn"} & set(vars(theirs)), "a buffer's file holds no model"
    assert_equal_trees(ours.transitions(), theirs.transitions())
    assert ours.rng.bit_generator.state == theirs.rng.bit_generator.state
    if kind is StockPrioritizedReplayBuffer:
        assert_equal_trees(ours.td_errors, theirs.td_errors)
    else:
        n_refreshes = theirs.n_refreshes
        theirs.attach(student_class(loaded)(loaded, theirs.rng))
        assert_equal_trees(ours.teachers.state_dict(), theirs.teachers.state_dict())
    loaded.learn(90, ReplayCallback(), reset_num_timesteps=False)
    assert loaded.num_timesteps == 180
    if kind is StockKFCVReplayBuffer:
        assert theirs.n_refreshes >= n_refreshes > 0


# ---- what is refused


def test_replay_without_the_callback_is_refused():
    with pytest.raises(ValueError, match=r"callback=ReplayCallback\(\)"):
        make("DQN", StockKFCVReplayBuffer).learn(30)


def test_the_callback_wants_one_of_these_buffers():
    with pytest.raises(ValueError, match="the model has a ReplayBuffer"):
        make("DQN", ReplayBuffer).learn(30, ReplayCallback())
    with pytest.raises(ValueError, match="the model has none"):
        PPO("MlpPolicy", worlds(True), n_steps=8, batch_size=8, device="cpu").learn(30, ReplayCallback())


def test_a_joint_buffer_says_where_the_others_are():
    with pytest.raises(ValueError, match=r"replay buffers of sb3_kfcv\.stock"):
        make("DQN", KFCVReplayBuffer).learn(30)


class Strange(OffPolicyAlgorithm):
    """An algorithm that nobody knows."""

    def __init__(self):
        pass


def test_an_unknown_algorithm_needs_a_student():
    with pytest.raises(ValueError, match="no TD target is known of Strange; known are those of DDPG, DQN, SAC, TD3"):
        student_class(Strange())


def test_a_student_of_ones_own_is_taken():
    asked = []

    class Lazy(StockStudent):
        critic = None

        def next_values(self, next_observations):
            asked.append(len(next_observations))
            return next_observations.new_zeros(len(next_observations), 1)

        def values(self, batch):
            return batch.rewards * 0

    make("DQN", StockKFCVReplayBuffer, CURRICULUM).learn(60, ReplayCallback(student=Lazy))
    assert asked


@pytest.mark.parametrize("observations", ["dict", "image"])
def test_observations_of_several_axes_are_refused(observations):
    policy = "MultiInputPolicy" if observations == "dict" else "CnnPolicy"
    with pytest.raises(ValueError, match=r"observations of one axis.*FlattenObservation"):
        DQN(policy, worlds(True, observations=observations), replay_buffer_class=StockKFCVReplayBuffer, buffer_size=50)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"alpa": 0.5}, 'unknown setting in replay_buffer_kwargs "alpa"; did you mean "alpha"?'),
        ({"n_agents": 2}, "n_agents is a setting of many agents' replay"),
        ({"alpha": -1}, "alpha must be at least 0"),
        ({"beta_init": 2}, "beta_init must be at least 0 and at most 1"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message.replace("?", r"\?")):
        make("DQN", StockPrioritizedReplayBuffer, settings)


def test_optimize_memory_usage_is_refused():
    with pytest.raises(ValueError, match="no observation is stored twice anyway"):
        make("DQN", StockKFCVReplayBuffer, optimize_memory_usage=True)
