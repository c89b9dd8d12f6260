"""Numbers that are not finite stop a training and are named; what was saved before stays; and memory is asked for first."""

import shlex
import tracemalloc
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from gymnasium.envs.registration import register
from references import parameters_of
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from test_zoo import command, run_folder
from toy_envs import ToyParallelEnv

from sb3_kfcv import ALGOS, KFCVMADDPG, MADDPG, JointEnv
from sb3_kfcv.common import memory
from sb3_kfcv.common.checks import NonFiniteError, require_finite, require_finite_columns
from sb3_kfcv.common.memory import free_memory, in_words, require_memory
from sb3_kfcv.saving.checkpoints import Checkpoints, checkpoints_in, latest_checkpoint
from zoo import train

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of NumPy, about the numbers in question

EVERY_ALGO = pytest.mark.parametrize("algo", ALGOS.values())


class PoisonedParallelEnv(ToyParallelEnv):
    """
    The toy world, of which a number is not what it should be from some step on.

    :param quantity: "reward", "observation" (but the last), "last observation", "first observation", "state" or "nothing"
    :param agent: whose
    :param value: the number
    :param at: the step, counted over all episodes
    """

    def __init__(self, quantity="nothing", agent="scout_1", value=np.nan, at=30, **kwargs):
        super().__init__(**{"time_limit": 8, **kwargs})
        self.quantity, self.agent, self.value, self.at, self.steps = quantity, agent, value, at, 0

    def reset(self, seed=None, options=None):
        observations, infos = super().reset(seed, options)
        self._poison(observations, "first observation")
        return observations, infos

    def step(self, actions):
        self.steps += 1
        observations, rewards, *rest = super().step(actions)
        self._poison(observations, "observation" if self.agents else "last observation")
        if self.quantity == "reward" and self.steps >= self.at:
            rewards[self.agent] = self.value
        return observations, rewards, *rest

    def state(self):
        state = super().state()
        if self.quantity == "state" and self.steps >= self.at:
            state[0] = self.value
        return state

    def _poison(self, observations, quantity):
        if self.quantity == quantity and self.steps >= self.at and self.agent in observations:
            observations[self.agent][-1] = self.value


def worlds(*args, n_envs=1, discrete=False, **kwargs):
    """Several toy worlds, the last of them poisoned."""
    sound = [lambda: JointEnv(PoisonedParallelEnv(discrete=discrete))] * (n_envs - 1)
    return DummyVecEnv([*sound, lambda: JointEnv(PoisonedParallelEnv(*args, discrete=discrete, **kwargs))])


def make(env, algo=MADDPG, **kwargs):
    settings = {"learning_starts": 16, "batch_size": 8, "buffer_size": 300, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    if algo is KFCVMADDPG:
        settings["replay_buffer_kwargs"] = {"teacher_batch_size": 8, "first_teacher_steps": 3, "teacher_steps": 2}
    return algo("MlpPolicy", env, device="cpu", **{**settings, **kwargs})


def learn(model, steps=300, callback=None):
    return model.learn(steps, callback, log_interval=None)


def assert_sound(model):
    """All parameters, moments and transitions are finite."""
    for name, value in parameters_of(model).items():
        assert th.isfinite(value).all(), name
    for network in (model.actor, model.critic):
        for moments in network.optimizer.state_dict()["state"].values():
            assert all(th.isfinite(moment).all() for moment in moments.values())
    for name, array in model.replay_buffer.transitions().items():
        assert np.isfinite(array).all(), name


# ---- what comes from the world

WORLDS = {
    "1 world": {},
    "3 worlds": {"n_envs": 3},
    "discrete": {"discrete": True},
    "normalised": {"normalized": True},
    "3 normalised": {"n_envs": 3, "normalized": True},
}


@pytest.mark.parametrize("kind", WORLDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("quantity", ["reward", "observation", "last observation"])
def test_a_number_from_the_world_stops_the_training_by_agent_and_quantity(quantity, value, kind):
    """Before it reaches the buffer, a normalisation or a network."""
    settings = dict(WORLDS[kind])
    normalized = settings.pop("normalized", False)
    env = worlds(quantity, "scout_1", value, **settings)
    model = make(VecNormalize(env, norm_reward=False) if normalized else env)
    with pytest.raises(
        NonFiniteError, match=f"^the {quantity.removeprefix('last ')} of scout_1 must be finite, and holds {value}$"
    ):
        learn(model)
    n_envs = settings.get("n_envs", 1)
    assert model.num_timesteps == (31 if quantity == "last observation" else 29) * n_envs
    assert model.replay_buffer.n_added == model.num_timesteps // n_envs
    assert_sound(model)


@pytest.mark.parametrize("agent", ["scout_0", "scout_1", "tank_0"])
@pytest.mark.parametrize("quantity", ["reward", "observation", "last observation"])
def test_the_agent_is_the_right_one(quantity, agent):
    with pytest.raises(NonFiniteError, match=f"^the {quantity.removeprefix('last ')} of {agent} "):
        learn(make(worlds(quantity, agent)))


def test_a_dead_agents_numbers_are_no_concern():
    """It is gone at step 5 of each episode; from then on the env is not asked for it."""
    model = make(worlds("last observation", "tank_0", deaths={"tank_0": 5}))
    assert learn(model, 100).num_timesteps == 100


@EVERY_ALGO
def test_every_algorithm_looks(algo):
    model = make(worlds("reward", "tank_0"), algo)
    with pytest.raises(NonFiniteError, match=r"^the reward of tank_0 "):
        learn(model)
    assert_sound(model)


@pytest.mark.parametrize("learning_starts", [0, 1000])
def test_the_very_first_observation_is_looked_at(learning_starts):
    model = make(worlds("first observation", at=0), learning_starts=learning_starts)
    with pytest.raises(NonFiniteError, match="scout_1"):
        learn(model, 6)


@pytest.mark.parametrize("quantity", ["observation", "first observation"])
def test_an_infinite_observation_is_seen_under_a_normalisation_that_stands_still(quantity):
    model = make(VecNormalize(worlds(quantity, value=np.inf), training=False, norm_reward=False))
    with pytest.raises(NonFiniteError, match="scout_1"):
        learn(model)


def test_a_state_stops_the_training():
    """Critics that read it would name the loss of the first agent, and the buffer could not be loaded."""
    model = make(worlds("state"), critic_input="state")
    with pytest.raises(NonFiniteError, match="state"):
        learn(model)
    assert_sound(model)


@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("quantity", ["reward", "observation", "last observation", "first observation"])
def test_large_numbers_are_no_error(quantity, normalized):
    """Their sum overflows."""
    env = worlds(quantity, value=3e38, n_envs=3)
    model = make(VecNormalize(env, norm_reward=False) if normalized else env, learning_starts=1000)
    assert learn(model, 120).num_timesteps == 120


def test_the_quick_check_is_silent_about_overflow():
    columns = {"scout_0": slice(0, 2), "tank_0": slice(2, 3)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        require_finite_columns("observation", np.full((4, 3), 3e38, dtype=np.float32), columns)
        require_finite_columns("action", np.zeros((0, 3), dtype=np.float32), columns)
        require_finite_columns("action", np.full((4, 3), np.iinfo(np.int64).max), columns)
        for rows in (np.float32([[0, 0, np.nan]]), np.float32([[np.inf, 0, -np.inf]])[:, ::-1]):
            with pytest.raises(NonFiniteError, match=r"the observation of (tank_0|scout_0) must be finite"):
                require_finite_columns("observation", rows, columns)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_number_among_many_is_found(value):
    values = np.zeros((7, 11))
    values[3, 4] = value
    with pytest.raises(NonFiniteError, match=f"^it must be finite, and holds {value}$"):
        require_finite("it", values)
    require_finite("it", np.zeros(0))
    require_finite("it", np.array([True, False]))


# ---- what comes from the networks


class Poison(BaseCallback):
    """Puts a number into an agent's network, between a training step and the next rollout, from some env step on."""

    def __init__(self, network, agent, at, value=float("nan")):
        super().__init__()
        self.network, self.agent, self.at, self.value = network, agent, at, value

    def _on_rollout_start(self):
        if self.model.num_timesteps >= self.at:
            poison(self.model, self.network, self.agent, self.value)

    def _on_step(self):
        return True


class PoisonAtTheEnd(Poison):
    """After the last training step."""

    def _on_training_end(self):
        self._on_rollout_start()


def poison(model, network, agent, value=float("nan")):
    """Into the last layer of the agent's network."""
    networks, place = getattr(model, network), model.layout.agents.index(agent)
    if network.startswith("critic"):
        stack, own = networks.stacks[0], place
    else:
        index = next(i for i, block in enumerate(networks.blocks) if place in block.agents)
        stack, own = networks.stacks[index], networks.blocks[index].agents.index(place)
    with th.no_grad():
        stack.rest[-1].bias[own] = value


@pytest.mark.parametrize("agent", ["scout_0", "scout_1", "tank_0"])
@pytest.mark.parametrize(
    ("network", "discrete", "sentence"),
    [
        ("actor", False, "the action of {}"),
        ("actor", True, "the actor loss in update [0-9]+ of {}"),
        ("critic", False, "the critic loss in update [0-9]+ of {}"),
        ("critic", True, "the critic loss in update [0-9]+ of {}"),
        ("critic_target", False, "the critic loss in update [0-9]+ of {}"),
    ],
)
def test_a_network_that_gives_no_number_stops_the_training(network, discrete, sentence, agent):
    """At once: the world never sees the action, no other network learns from the loss."""
    model = make(worlds(discrete=discrete))
    with pytest.raises(NonFiniteError, match=f"^{sentence.format(agent)} must be finite, and holds nan$"):
        learn(model, callback=Poison(network, agent, at=40))
    assert model.num_timesteps in (40, 41)
    others = [name for name, value in parameters_of(model).items() if not th.isfinite(value).all()]
    assert others and all(name.startswith(f"{network}.") for name in others)
    for name, array in model.replay_buffer.transitions().items():
        assert np.isfinite(array).all(), name


@EVERY_ALGO
@pytest.mark.parametrize("agent", ["scout_0", "scout_1", "tank_0"])
def test_a_loss_that_explodes_stops_the_training_before_the_networks_change(algo, agent):
    """A reward that is finite, and whose square is not."""
    model = make(worlds("reward", agent, 1e30), algo)
    with pytest.raises(NonFiniteError, match=f"^the critic loss in update [0-9]+ of {agent} must be finite, and holds inf$"):
        learn(model)
    assert_sound(model)


@pytest.mark.parametrize("power", [6, 12, 17, 18, 19, 20, 25, 38])
def test_rewards_of_any_size_end_in_finite_networks_or_in_a_sentence(power, tmp_path):
    model = make(worlds("reward", value=10.0**power))
    try:
        learn(model, 100)
    except NonFiniteError as error:
        assert "the critic loss" in str(error)
    assert_sound(model)
    model.save(tmp_path / "model")
    MADDPG.load(tmp_path / "model")


def test_noise_that_is_no_number_stops_the_training():
    noise = NormalActionNoise(np.zeros(5), np.array([0.1, 0.1, 0.1, np.nan, 0.1]), dtype=np.float32)
    model = make(worlds(), action_noise=noise)
    with pytest.raises(NonFiniteError, match=r"^the action of scout_1 "):
        learn(model, 30)


# ---- what was saved before stays


@pytest.mark.parametrize("network", ["actor", "critic", "actor_target", "critic_target"])
def test_a_parameter_that_is_no_number_is_refused_by_its_name_and_the_old_file_stays(network, tmp_path):
    model = learn(make(worlds()), 40)
    model.save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()
    poison(model, network, "tank_0", float("inf"))
    with pytest.raises(NonFiniteError, match=rf"^parameters/policy/{network}\.\S*bias must be finite, and holds inf$"):
        model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").read_bytes() == before
    assert MADDPG.load(tmp_path / "model").num_timesteps == 40
    assert [path.name for path in tmp_path.iterdir()] == ["model.zip"]


@pytest.mark.parametrize("network", ["actor", "critic"])
def test_a_moment_that_is_no_number_is_refused_by_its_name(network, tmp_path):
    model = learn(make(worlds()), 40)
    state = getattr(model, network).optimizer.state_dict()["state"]
    state[1]["exp_avg_sq"].fill_(float("inf"))
    with pytest.raises(NonFiniteError, match=rf"^parameters/{network}\.optimizer/1/exp_avg_sq must be finite"):
        model.save(tmp_path / "model")
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("ignore:the state of ToyParallelEnv", "ignore:the state of PoisonedParallelEnv")
@pytest.mark.parametrize("network", ["actor_target", "critic"])
def test_a_checkpoint_of_such_a_network_is_not_written_and_the_last_one_stays(network, tmp_path):
    model = make(worlds(), learning_starts=1000)
    with pytest.raises(NonFiniteError, match=rf"parameters/policy/{network}\."):
        learn(model, 200, [Checkpoints(tmp_path, 20), Poison(network, "scout_0", at=50)])
    assert model.num_timesteps == 60
    assert list(checkpoints_in(tmp_path)) == [40, 20]
    assert not list(tmp_path.rglob("*.partial"))
    found = latest_checkpoint(tmp_path)
    assert found.steps == 40 and len(found.transitions["rewards"]) == 40
    again = learn(make(worlds(), learning_starts=1000), 80, Checkpoints(tmp_path, 20, resume=True))
    assert again.num_timesteps == 80


def test_statistics_that_are_no_number_are_refused_at_save(tmp_path):
    env = VecNormalize(worlds("nothing"), norm_reward=False)
    model = make(env)
    env.obs_rms.mean[0] = np.nan
    with pytest.raises(NonFiniteError, match="the mean of the observations"):
        model.save(tmp_path / "model")
    assert not list(tmp_path.iterdir())


# ---- from the command line


@pytest.fixture
def conf(tmp_path):
    """The toy world as ``zoo/train.py`` finds it."""
    register("Poisoned-v0", entry_point=lambda **kwargs: JointEnv(PoisonedParallelEnv(**kwargs)))
    entry = {"n_timesteps": 200, "n_envs": 2, "policy_kwargs": {"net_arch": [8]}, "learning_starts": 20}
    path = tmp_path / "conf.yml"
    path.write_text(yaml.safe_dump({"Poisoned-v0": {**entry, "batch_size": 8, "buffer_size": 200}}))
    yield str(path)
    del gym.registry["Poisoned-v0"]


def toy_command(folder, conf, algo, *more):
    where = ["--algo", algo, "--env", "Poisoned-v0", "-conf", conf, "-f", str(folder)]
    return [*where, "--seed", "1", "--verbose", "0", "--eval-freq", "-1", "--save-freq", "20", *more]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("algo", "env_kwargs", "sentence", "last"),
    [
        ("maddpg", ["quantity:reward", "value:.nan"], "the reward of scout_1 must be finite, and holds nan", 40),
        ("per_maddpg", ["quantity:observation", "value:.inf"], "the observation of scout_1 must be finite, and holds inf", 40),
        ("kfcv_maddpg", ["quantity:last observation", "value:.nan"], "the observation of scout_1 must be finite", 60),
        *[(algo, ["quantity:reward", "value:1.0e+30"], "of scout_1 must be finite, and holds inf", 40) for algo in ALGOS],
    ],
    ids=["reward", "observation", "last observation", *(f"loss of {algo}" for algo in ALGOS)],
)
def test_a_run_stops_in_a_sentence_and_says_how_it_goes_on(algo, env_kwargs, sentence, last, tmp_path, conf, capsys):
    assert train.main(toy_command(tmp_path, conf, algo, "--env-kwargs", "at:26", *env_kwargs)) == 3
    printed = capsys.readouterr()
    assert printed.err.startswith("error: the ") and printed.err.count("\n") == 1
    assert sentence in printed.err and "the training has stopped after" in printed.err
    folder = run_folder(tmp_path, "Poisoned-v0", algo)
    assert max(checkpoints_in(folder.path)) == latest_checkpoint(folder.path).steps >= last
    assert f"the last checkpoint is of {max(checkpoints_in(folder.path))} env steps; to train it on with " in printed.out
    words = shlex.split(printed.out.rpartition("other settings: ")[2])  # the same ones would end alike
    assert words[-6:] == ["-i", str(latest_checkpoint(folder.path).path), "-n", "STEPS", "-params", "NAME:VALUE"]
    assert not folder.last_model.exists()


@pytest.mark.parametrize(("network", "quantity"), [("actor", "action"), ("critic", "critic loss in update")])
def test_a_run_whose_networks_broke_goes_on_from_its_last_checkpoint(tmp_path, capsys, network, quantity):
    words = command(tmp_path, "Grassland-v0", "maddpg", "--save-freq", "20", params=["policy_kwargs.net_arch:[8]"])
    assert train.main(words, [Poison(network, "wolf_1", at=70)]) == 3
    printed = capsys.readouterr()
    assert f"error: the {quantity}" in printed.err and "of wolf_1 must be finite, and holds nan" in printed.err
    folder = run_folder(tmp_path)
    assert max(checkpoints_in(folder.path)) == 60
    assert train.main(["--resume", str(folder.path), "--verbose", "0"]) == 0
    assert MADDPG.load(folder.last_model).num_timesteps == 120


def test_a_network_that_broke_in_the_last_step_ends_in_a_sentence(tmp_path, capsys):
    assert train.main(command(tmp_path, "Grassland-v0", "maddpg"), [PoisonAtTheEnd("critic", "wolf_1", at=120)]) == 3
    assert capsys.readouterr().err.count("\n") == 1


# ---- memory


def cgroup(folder, monkeypatch, limit, used, cache):
    (folder / "memory.max").write_text(f"{limit}\n")
    (folder / "memory.current").write_text(f"{used}\n")
    (folder / "memory.stat").write_text(f"anon 5\ninactive_file {cache}\nactive_file 7\n")
    monkeypatch.setattr(memory, "CGROUP", folder)


def test_free_memory_keeps_to_what_the_container_may_use(tmp_path, monkeypatch):
    """Files that the system has read and can forget again are no use of it."""
    cgroup(tmp_path, monkeypatch, 10_000_000, 9_500_000, 200_000)
    assert free_memory() == 700_000
    with pytest.raises(MemoryError, match=r"^a cake takes 800 kB; 700 kB are free$"):
        require_memory("a cake", 800_000)
    require_memory("a cake", 700_000)


def test_free_memory_is_the_machines_where_no_limit_is_set(tmp_path, monkeypatch):
    monkeypatch.setattr(memory.psutil, "virtual_memory", lambda: type("Memory", (), {"available": 123_456}))
    cgroup(tmp_path, monkeypatch, "max", 9_500_000, 200_000)
    assert free_memory() == 123_456
    cgroup(tmp_path, monkeypatch, 10**15, 9_500_000, 200_000)
    assert free_memory() == 123_456
    (tmp_path / "memory.stat").write_text("nonsense\n")
    assert free_memory() == 123_456
    monkeypatch.setattr(memory, "CGROUP", tmp_path / "nowhere")
    assert free_memory() == 123_456


def test_a_container_that_is_over_its_limit_has_no_memory_left(tmp_path, monkeypatch):
    cgroup(tmp_path, monkeypatch, 10_000_000, 12_000_000, 0)
    with pytest.raises(MemoryError, match=r"0 bytes are free$"):
        require_memory("a cake", 1)


@pytest.mark.parametrize(
    ("n_bytes", "text"),
    [
        (0, "0 bytes"),
        (999, "999 bytes"),
        (1000, "1 kB"),
        (83_240_000, "83.2 MB"),
        (4e9, "4 GB"),
        (2e12, "2 TB"),
        (16e14, "1,600 TB"),
    ],
)
def test_bytes_in_words(n_bytes, text):
    assert in_words(n_bytes) == text


def test_the_size_of_the_buffer_is_printed_before_the_training(capsys):
    buffer = make(worlds(), verbose=1).replay_buffer
    printed = capsys.readouterr().out
    assert f"Replay buffer: 300 joint transitions, {in_words(buffer.n_bytes)} (" in printed
    assert "of memory are free)" in printed
    make(worlds())
    assert "Replay buffer" not in capsys.readouterr().out


@EVERY_ALGO
def test_a_buffer_that_does_not_fit_is_refused_before_it_is_made(algo, monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 50_000_000)
    buffer = make(worlds(), algo).replay_buffer
    n_bytes = buffer.estimate_bytes(1_000_000, buffer.observation_space, buffer.action_space, n_agents=3)
    assert n_bytes > 1_000_000 * 4 * (8 + 5 + 3 * 3)
    tracemalloc.start()
    try:
        sentence = rf"^a replay buffer of 1,000,000 joint transitions takes {in_words(n_bytes)}; 50 MB are free$"
        with pytest.raises(MemoryError, match=sentence):
            make(worlds(), algo, buffer_size=1_000_000)
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


def test_networks_that_do_not_fit_are_refused_before_they_are_made():
    tracemalloc.start()
    try:
        with pytest.raises(MemoryError, match=r"10000000.* takes .* TB; .* are free$"):
            make(worlds(), policy_kwargs={"net_arch": [10**7, 10**7]})
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("params", "sentence"),
    [
        (["buffer_size:1000000000000"], "a replay buffer of 1,000,000,000,000 joint transitions takes "),
        (["policy_kwargs.net_arch:[10000000,10000000]"], "networks"),
    ],
    ids=["buffer", "networks"],
)
@pytest.mark.parametrize("algo", ALGOS)
def test_a_run_that_does_not_fit_is_refused_in_a_sentence_and_leaves_nothing(tmp_path, capsys, algo, params, sentence):
    assert train.main(command(tmp_path / "logs", "HardSpread-v0", algo, params=params)) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: ") and printed.count("\n") == 1
    assert sentence in printed and " TB; " in printed and printed.endswith(" are free\n")
    assert not (tmp_path / "logs").exists()
