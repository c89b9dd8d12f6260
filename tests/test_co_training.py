"""Teams that learn at once: what one learner of all agents would do, each by its own settings, against the past of others."""

import itertools

import numpy as np
import pytest
import torch as th
from references import fill, parameters_of
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecNormalize
from toy_envs import ToyParallelEnv

from sb3_kfcv import KFCVMADDPG, MADDPG, PERMADDPG, CoTraining, JointEnv, KFCVReplayBuffer, make_vec_env
from sb3_kfcv.co_training.opponents import CoLearner, Pool
from sb3_kfcv.co_training.team_buffers import TeamBuffers
from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.replay import JointReplayBuffer, PrioritizedReplayBuffer

SMALL = {"learning_starts": 20, "batch_size": 8, "buffer_size": 200, "policy_kwargs": {"net_arch": [8]}}
CURRICULUM = {"teacher_batch_size": 8, "first_teacher_steps": 3, "teacher_steps": 2, "refresh_every": 20}
GRASSLAND = {"n_wolves": 2, "n_sheep": 2, "n_grass": 1, "max_steps": 5}


def grassland(n=2, seed=0, **kwargs):
    return make_vec_env("Grassland-v0", n, seed, {**GRASSLAND, **kwargs})


def small(env=None, wolf=None, sheep=None, **settings):
    teams = {"wolf": {"algo": "maddpg", **SMALL, **(wolf or {})}, "sheep": {"algo": "maddpg", **SMALL, **(sheep or {})}}
    return CoTraining("MlpPolicy", env or grassland(), teams, **{"seed": 1, "device": "cpu", **settings})


class ThreeGroups(ToyParallelEnv):
    """Each agent is a group of its own."""

    def __init__(self, **kwargs):
        super().__init__(time_limit=6, **kwargs)
        names = {"scout_0": "red", "scout_1": "green", "tank_0": "blue"}
        self.possible_agents = list(names.values())
        self.places = dict.fromkeys(self.possible_agents, 0.0)
        self.own = {new: old for old, new in names.items()}

    def observation_space(self, agent):
        return super().observation_space(self.own[agent])

    def action_space(self, agent):
        return super().action_space(self.own[agent])

    def _observations(self, agents):
        rows = {agent: np.zeros(self.observation_space(agent).shape, np.float32) for agent in agents}
        for agent, row in rows.items():
            row[:2] = self.places[agent], self.t
        return rows


# ---- the equations: two teams of MADDPG are one MADDPG of all agents

HIDDEN = 4
TEAMS = {"scout": (slice(0, 2), 0), "tank": (slice(2, 3), 1)}  # of the toy world: their agents, and their stack of actors


def part_of(one, team):
    """The parameters of a team, out of those of one learner for all agents."""
    members, place = TEAMS[team]
    hidden = slice(members.start * HIDDEN, members.stop * HIDDEN)
    parts = {}
    for name, values in one.policy.state_dict().items():
        network, _, stack, rest = name.split(".", 3)
        if network.startswith("actor") or one.critic_input == "own_observation":  # a stack for each shape
            if int(stack) == place:
                parts[f"{network}.stacks.0.{rest}"] = values
        else:  # one stack of all critics, whose first layers lie side by side
            parts[name] = values[..., hidden] if rest.startswith("first") else values[members]
    return parts


def pair(critic_input, discrete, **settings):
    """One learner of all agents, co-training with the same networks, and a minibatch that all of them draw."""
    settings = {
        **{"critic_input": critic_input, "policy_kwargs": {"net_arch": [HIDDEN]}, "buffer_size": 64, "batch_size": 16},
        **settings,
    }
    one = MADDPG("MlpPolicy", JointEnv(ToyParallelEnv(discrete=discrete)), seed=1, device="cpu", **settings)
    one.set_logger(Logger(None, []))
    teams = {team: {"algo": "maddpg", **settings} for team in TEAMS}
    two = CoTraining("MlpPolicy", JointEnv(ToyParallelEnv(discrete=discrete)), teams, seed=7, device="cpu")
    with th.no_grad():
        for values in one.policy.state_dict().values():
            values += 0.1 * th.randn_like(values)  # targets unlike what they follow
    for team, learner in two.learners.items():
        learner.policy.load_state_dict(part_of(one, team))
    fill(one.replay_buffer, one.layout, 64, death_rate=0.1, alive_rate=0.8)
    batch = one.replay_buffer.sample(16)
    for learner in (one, *two.learners.values()):
        learner.replay_buffer.sample = lambda *_, **__: batch
    return one, two, batch


EVERY_CRITIC = pytest.mark.parametrize("critic_input", ["observations", "state", "own_observation"])
BOTH_KINDS = pytest.mark.parametrize("discrete", [False, True], ids=["continuous", "discrete"])


@EVERY_CRITIC
@BOTH_KINDS
def test_td_targets_are_those_of_one_learner(critic_input, discrete):
    one, two, batch = pair(critic_input, discrete)
    targets = one.td_target(batch).clone()
    for team, learner in two.learners.items():
        th.testing.assert_close(learner.td_target(batch), targets[TEAMS[team][0]], atol=1e-6, rtol=0)


@EVERY_CRITIC
@BOTH_KINDS
def test_an_update_is_that_of_one_learner(critic_input, discrete):
    """With τ = 0, so that the order of the teams does not count."""
    one, two, _ = pair(critic_input, discrete, tau=0.0)
    before = {team: parameters_of(learner) for team, learner in two.learners.items()}
    th.manual_seed(3)  # of the Gumbel noise, which is drawn team after team
    one.train(2, 16)
    th.manual_seed(3)
    for _ in range(2):
        for learner in two.learners.values():
            learner.train(1, 16)
    for team, learner in two.learners.items():
        wanted = part_of(one, team)
        moved = 0
        for name, values in learner.policy.state_dict().items():
            th.testing.assert_close(values, wanted[name], atol=2e-6, rtol=0, msg=lambda text, name=name: f"{name}: {text}")
            moved += not th.equal(values, before[team][name])
        assert moved == sum("target" not in name for name in wanted)


@BOTH_KINDS
def test_the_later_team_meets_the_target_actors_that_the_first_has_moved(discrete):
    one, two, batch = pair("observations", discrete, tau=0.5)
    tank = TEAMS["tank"][0]
    before, unmoved = one.td_target(batch)[tank].clone(), parameters_of(one)
    th.manual_seed(3)
    one.train(1, 16)
    th.manual_seed(3)
    two.learners["scout"].train(1, 16)
    for name, values in two.learners["scout"].policy.state_dict().items():
        th.testing.assert_close(values, part_of(one, "scout")[name], atol=2e-6, rtol=0)
    moved = {name: values for name, values in parameters_of(one).items() if name.startswith("actor_target.stacks.0.")}
    one.policy.load_state_dict({**unmoved, **moved})
    wanted = one.td_target(batch)[tank]
    th.testing.assert_close(two.learners["tank"].td_target(batch), wanted, atol=2e-6, rtol=0)
    assert discrete or not th.allclose(wanted, before, atol=1e-4)


# ---- each team by its own settings


def test_each_team_learns_by_its_own_algorithm_and_settings():
    model = small(
        wolf={"algo": "kfcv_maddpg", "replay_buffer_kwargs": CURRICULUM, "gamma": 0.9, "buffer_size": 60},
        sheep={"algo": PERMADDPG, "gradient_steps": 3, "learning_starts": 50, "policy_kwargs": {"net_arch": [5]}},
    )
    wolf, sheep = model.learners.values()
    assert (type(wolf), type(sheep)) == (KFCVMADDPG, PERMADDPG)
    assert (type(wolf.replay_buffer), type(sheep.replay_buffer)) == (KFCVReplayBuffer, PrioritizedReplayBuffer)
    before = parameters_of(sheep)
    model.learn(50)
    assert all(map(th.equal, before.values(), parameters_of(sheep).values()))  # still in its warm-up
    assert (wolf._n_updates, sheep._n_updates) == (15, 0)  # after 22, 24, … 50 steps
    model.learn(30, reset_num_timesteps=False)
    assert (wolf._n_updates, sheep._n_updates) == (30, 45)
    assert (wolf.gamma, sheep.gamma) == (0.9, 0.99)
    assert (wolf.replay_buffer.size(), sheep.replay_buffer.size()) == (30, 40)  # steps of two worlds
    np.testing.assert_array_equal(wolf.replay_buffer.transitions()["actions"], sheep.replay_buffer.transitions(10)["actions"])


def test_a_team_whose_gradient_steps_are_minus_one_follows_the_env_steps():
    model = small(wolf={"gradient_steps": -1}, sheep={"gradient_steps": 0}).learn(60)
    assert [learner._n_updates for learner in model.learners.values()] == [40, 0]


def test_a_team_in_its_warm_up_acts_at_random_while_the_other_acts_as_it_learnt():
    quiet = {"exploration_noise": 0.0}
    model = small(wolf={"learning_starts": 0, **quiet}, sheep={"learning_starts": 10_000, **quiet}).learn(60)
    stored = model.replay_buffer.largest.transitions()
    actions = stored["actions"].reshape(-1, 8)
    greedy = small(wolf={"learning_starts": 0, **quiet}, sheep={"learning_starts": 10_000, **quiet})
    first = greedy.predict(stored["observations"].reshape(60, -1)[:2], deterministic=True)[0]
    np.testing.assert_allclose(actions[:2, :4], first[:, :4], atol=1e-6)
    assert abs(actions[:, 4:].std() - 1 / np.sqrt(3)) < 0.05  # even draws from [-1, 1]


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
@BOTH_KINDS
def test_groups_that_nobody_learns_are_played_by_their_opponents(discrete):
    env = make_vec_env(lambda: ThreeGroups(discrete=discrete), 2, 0)
    teams = {"red": {"algo": "maddpg", **SMALL}, "blue": {"algo": "kfcv_maddpg", **SMALL, "replay_buffer_kwargs": CURRICULUM}}

    class Sure:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            shape = (len(observation), 3) if discrete else (len(observation), 5)
            return np.full(shape, 1, np.int64 if discrete else np.float32), None

    model = CoTraining("MlpPolicy", env, teams, opponents={"green": Sure()}, seed=1, device="cpu").learn(80)
    actions = model.replay_buffer.largest.transitions()["actions"].reshape(80, -1)
    green = slice(1, 2) if discrete else slice(2, 4)
    assert (actions[:, green] == 1).all()
    assert len(np.unique(actions[:, 0])) > 1 and len(np.unique(actions[:, -1])) > 1
    joint = model.predict(np.zeros((3, 8), np.float32))[0]
    assert (joint[:, green] == 1).all()
    with pytest.raises(ValueError, match="'green' is not among the learning agents"):
        model.predict_agent("green", np.zeros(3, np.float32))


def test_a_world_of_one_group_is_one_team():
    env = make_vec_env("HardSpread-v0", 2, 0, {"n_agents": 2, "max_steps": 5})
    model = CoTraining("MlpPolicy", env, {"agent": {"algo": "maddpg", **SMALL}}, seed=1, device="cpu").learn(40)
    alone = MADDPG("MlpPolicy", make_vec_env("HardSpread-v0", 2, 0, {"n_agents": 2, "max_steps": 5}), seed=1, **SMALL)
    alone.learn(40)
    ours, theirs = parameters_of(model.learners["agent"]), parameters_of(alone)
    for name in theirs:  # actions are scaled to the world and back, which rounds
        th.testing.assert_close(ours[name], theirs[name], atol=1e-5, rtol=0)


# ---- SB3's loop around it


@pytest.mark.parametrize("setting", ["one world", "by episodes", "discrete", "drifting noise", "other sizes"])
def test_learns_with(setting):
    every = {"train_freq": (1, "episode"), "gradient_steps": -1}
    noise = {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(8), np.full(8, 0.2), dtype=np.float32)}
    model = {
        "one world": lambda: small(grassland(1)),
        "by episodes": lambda: small(grassland(1), every, every),
        "discrete": lambda: small(grassland(continuous_actions=False)),
        "drifting noise": lambda: small(wolf=noise),
        "other sizes": lambda: small(sheep={"policy_kwargs": {"net_arch": [3, 3]}, "critic_input": "state"}),
    }[setting]()
    before = [parameters_of(learner) for learner in model.learners.values()]
    model.learn(60)
    for learner, parameters in zip(model.learners.values(), before, strict=True):
        after = parameters_of(learner)
        assert [name for name in after if th.equal(after[name], parameters[name])] == []
        assert all(values.isfinite().all() for values in after.values())


def test_the_same_seed_gives_the_same_teams():
    first, second = (small(pool_share=0.5, pool_freq=20).learn(60) for _ in range(2))
    other = small(seed=2).learn(60)
    assert all(map(th.equal, first.policy.state_dict().values(), second.policy.state_dict().values()))
    assert not th.equal(*(next(iter(model.policy.state_dict().values())) for model in (first, other)))


class Notes(KVWriter):
    def __init__(self):
        self.entries = []

    def write(self, key_values, key_excluded, step=0):
        self.entries.append(dict(key_values))

    def close(self):
        pass


def test_the_log_names_the_team_of_each_series():
    model, notes = small(wolf={"algo": "per_maddpg"}, pool_share=0.5, pool_freq=20), Notes()
    model.set_logger(Logger(None, [notes]))
    model.learn(60, log_interval=4)
    entry = notes.entries[-1]
    for team in ("wolf", "sheep"):
        losses = [key for key in entry if key.startswith(f"train_{team}/") and "critic_loss" in key]
        assert losses and all(np.isfinite(entry[key]) for key in losses)
        assert entry[f"pool_{team}/past_selves"] >= 2
    assert {"rollout/ep_rew_mean", "rollout/return_wolf", "time/total_timesteps", "train/n_updates"} <= entry.keys()
    assert not [key for key in entry if key.startswith("train/") and key != "train/n_updates"]
    of_replay = [key.split("/") for key in model.learners["wolf"].replay_buffer.diagnostics()]
    assert of_replay and {f"{first}_wolf/{rest}" for first, rest in of_replay} <= entry.keys()
    assert not {f"{first}_sheep/{rest}" for first, rest in of_replay} & entry.keys()


def test_sb3s_callbacks_and_progress_bar_work(tmp_path):
    threshold = StopTrainingOnRewardThreshold(-1e9, verbose=0)
    evaluation = EvalCallback(
        *(grassland(2, seed=5), threshold),
        **{"eval_freq": 15, "n_eval_episodes": 2, "verbose": 0},
        **{"best_model_save_path": str(tmp_path), "log_path": str(tmp_path)},
    )
    model = small()
    model.learn(1000, [evaluation, CheckpointCallback(10, str(tmp_path))], log_interval=None, progress_bar=True)
    assert model.num_timesteps == 30
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [30]
    best = CoTraining.load(tmp_path / "best_model.zip", env=grassland())
    assert np.isfinite(evaluate_policy(best, grassland(), 3)[0])
    assert CoTraining.load(tmp_path / "rl_model_20_steps.zip").num_timesteps == 20


# ---- files

ROWS = np.random.default_rng(5).normal(size=(6, grassland().observation_space.shape[0])).astype(np.float32)


def assert_same_models(one, other):
    for ours, theirs in zip(one.learners.values(), other.learners.values(), strict=True):
        assert type(ours) is type(theirs)
        assert all(map(th.equal, ours.policy.state_dict().values(), theirs.policy.state_dict().values()))
        for name in ("_n_updates", "num_timesteps", "gamma", "learning_starts", "gradient_steps", "buffer_size"):
            assert getattr(ours, name) == getattr(theirs, name), name
        for part in ("actor", "critic"):
            moments = [getattr(model, part).optimizer.state_dict()["state"] for model in (ours, theirs)]
            assert all(th.equal(moments[0][i]["exp_avg"], moments[1][i]["exp_avg"]) for i in moments[0])
    np.testing.assert_array_equal(one.predict(ROWS, deterministic=True)[0], other.predict(ROWS, deterministic=True)[0])


def test_a_co_training_comes_back_whole(tmp_path):
    model = small(
        wolf={"algo": KFCVMADDPG, "replay_buffer_kwargs": CURRICULUM, "gamma": 0.9},
        sheep={"algo": "per_maddpg"},
        pool_share=0.5,
    ).learn(60)
    model.save(tmp_path / "both")
    loaded = CoTraining.load(tmp_path / "both", device="cpu")
    assert_same_models(model, loaded)
    assert (loaded.num_timesteps, loaded.pool_share, loaded.teams) == (60, 0.5, model.teams)
    loaded.set_env(grassland())
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.num_timesteps == 100


def test_the_settings_of_a_learner_that_were_changed_come_back(tmp_path):
    model = small()
    model.learners["wolf"].gamma = 0.5
    model.save(tmp_path / "both")
    assert CoTraining.load(tmp_path / "both").learners["wolf"].gamma == 0.5


@pytest.mark.parametrize("n", [1, 3])
def test_a_co_training_goes_on_with_another_number_of_worlds(tmp_path, n):
    """The noise of each world is made anew."""
    small().learn(40).save(tmp_path / "both")
    loaded = CoTraining.load(tmp_path / "both", env=grassland(n))
    before = parameters_of(loaded.learners["wolf"])
    loaded.learn(60)
    after = parameters_of(loaded.learners["wolf"])
    assert [name for name in after if th.equal(before[name], after[name])] == []


def test_who_wins_is_known_in_an_env_that_is_set_later(tmp_path):
    small(pool_share=0.5, pool_freq=10, pool_sampling="win_rate").save(tmp_path / "both")
    loaded = CoTraining.load(tmp_path / "both")
    loaded.set_env(grassland())
    loaded.learn(150)
    assert sum(pool.games.sum() for pool in loaded._pools.values()) > 0


def test_a_saved_learner_is_an_ordinary_model(tmp_path):
    model = small(sheep={"algo": "per_maddpg"}, pool_share=0.5, pool_freq=20).learn(60)
    model.learners["sheep"].save(tmp_path / "sheep")
    loaded = PERMADDPG.load(tmp_path / "sheep", env=grassland(), device="cpu")
    np.testing.assert_array_equal(
        loaded.predict(ROWS, deterministic=True)[0][:, 4:], model.predict(ROWS, deterministic=True)[0][:, 4:]
    )
    assert loaded.team == "sheep"
    assert loaded.learn(40).num_timesteps == 40


def test_parameters_can_be_carried_over(tmp_path):
    model, by_dict, by_file = small().learn(60), small(seed=4), small(seed=5)
    model.save(tmp_path / "both")
    by_dict.set_parameters(model.get_parameters())
    by_file.set_parameters(tmp_path / "both")
    for other in (by_dict, by_file):
        np.testing.assert_array_equal(*(one.predict(ROWS, deterministic=True)[0] for one in (model, other)))
    with pytest.raises(ValueError, match="Names of parameters do not match"):
        by_dict.set_parameters({"policy.0": model.get_parameters()["policy.0"]})


def test_the_replay_buffers_come_back(tmp_path):
    settings = {"wolf": {"buffer_size": 60}, "sheep": {"algo": "per_maddpg"}}
    model = small(**settings).learn(80)
    model.save_replay_buffer(tmp_path / "buffers")
    other = small(**settings)
    other.load_replay_buffer(tmp_path / "buffers")
    for team in ("wolf", "sheep"):
        ours, theirs = (one.replay_buffer.buffers[team] for one in (model, other))
        np.testing.assert_equal(ours.transitions(), theirs.transitions())
    with pytest.raises(
        ValueError, match="the replay buffer of sheep is a PrioritizedReplayBuffer; here it is a JointReplayBuffer"
    ):
        small().load_replay_buffer(tmp_path / "buffers")


def test_the_memory_of_all_buffers_is_told(capsys):
    model = small(wolf={"buffer_size": 100}, verbose=1)
    assert isinstance(model.replay_buffer, TeamBuffers)
    assert model.replay_buffer.n_bytes == sum(learner.replay_buffer.n_bytes for learner in model.learners.values())
    assert model.replay_buffer.largest is model.learners["sheep"].replay_buffer
    assert isinstance(model.learners["wolf"].replay_buffer, JointReplayBuffer)
    assert "Replay buffers: " in capsys.readouterr().out


# ---- pools


class Team:
    """Stands for a learner: each of its selves is told apart by a number."""

    def __init__(self):
        layout = JointEnv(ToyParallelEnv()).layout
        self.policy = ActorPolicy(
            JointEnv(ToyParallelEnv()).observation_space, JointEnv(ToyParallelEnv()).action_space, layout, [2], [1]
        )
        self.age = 0

    def grow(self):
        self.age += 1
        with th.no_grad():
            self.policy.actor.stacks[0].first.bias.fill_(self.age)


def pool_of(seed=0, **settings):
    team, player = Team(), CoLearner()
    player.model = team
    return team, Pool(player, np.random.default_rng(seed), **settings)


def ages(pool):
    return [int(past.actor.stacks[0].first.bias.flatten()[0]) for past in pool.players[1:]]


def test_a_pool_keeps_its_first_selves_until_it_is_full():
    team, pool = pool_of(share=0.5, size=4)
    for _ in range(4):
        team.grow()
        pool.offer()
    assert ages(pool) == [1, 2, 3, 4]
    np.testing.assert_allclose(pool.weights, [0.5, *[0.125] * 4])


def test_a_full_pool_is_an_even_sample_of_all_selves(monkeypatch):
    """Vitter's reservoir: each of 30 selves stays in a pool of 6 with probability 1/5."""
    kept, runs = np.zeros(30), 400
    numbers = itertools.cycle(range(30))
    monkeypatch.setattr("sb3_kfcv.co_training.opponents.written", lambda _: next(numbers))
    for seed in range(runs):
        pool = Pool(CoLearner(), np.random.default_rng(seed), share=0.5, size=6)
        for _ in range(30):
            pool.offer()
        assert len(pool.players) == 7 and pool.offered == 30
        kept[pool.players[1:]] += 1
    expected = runs / 5
    assert (np.abs(kept - expected) < 4.5 * np.sqrt(runs * 0.2 * 0.8)).all()
    assert ((kept - expected) ** 2 / (expected * 0.8)).sum() < 29 + 5 * np.sqrt(2 * 29)  # χ² of 29 degrees


def test_past_selves_that_win_come_more_often():
    """Worked by hand: (won + 1) / (games + 2) is 3/4, 1/4 and 1/2; of their sum 1.5 they are 1/2, 1/6 and 1/3."""
    team, pool = pool_of(share=0.6, size=5, sampling="win_rate")
    for _ in range(3):
        team.grow()
        pool.offer()
    pool.note_results(np.array([1, 1, 2, 2, 0]), np.array([1.0, 1.0, 0.0, 0.0, 1.0]))
    np.testing.assert_allclose(pool.weights, [0.4, 0.6 / 2, 0.6 / 6, 0.6 / 3])
    assert (pool.games.tolist(), pool.won.tolist()) == ([2, 2, 0], [2, 0, 0])


def test_a_self_that_replaces_another_begins_its_record_anew():
    team, pool = pool_of(share=0.5, size=1, sampling="win_rate")
    team.grow()
    pool.offer()
    pool.note_results(np.array([1]), np.array([1.0]))
    while ages(pool) == [1]:
        team.grow()
        pool.offer()
    assert (pool.games.tolist(), pool.won.tolist()) == ([0], [0])


def test_a_pool_without_past_selves_is_the_team_as_it_is():
    _, pool = pool_of(share=1.0)
    assert pool.draw(50, np.random.default_rng(0)).tolist() == [0] * 50


def test_past_selves_play_in_their_share_of_the_episodes():
    played = {"wolf": [], "sheep": []}

    class Watched(CoTraining):
        def _note_results(self, ended, infos):
            for team, playing in self._acting.playing(self._line_up).items():
                played[team] += playing[ended].tolist()
            super()._note_results(ended, infos)

    teams = {team: {"algo": "maddpg", **SMALL, "gradient_steps": 0} for team in played}
    Watched("MlpPolicy", grassland(8), teams, pool_share=0.3, pool_freq=200, seed=1, device="cpu").learn(8 * 5 * 80)
    for numbers in played.values():
        later = np.array(numbers[100:]) > 0
        assert abs(later.mean() - 0.3) < 4 * np.sqrt(0.3 * 0.7 / len(later))
    apart = np.mean((np.array(played["wolf"]) > 0) & (np.array(played["sheep"]) > 0)[: len(played["wolf"])])
    assert abs(apart - 0.09) < 0.05  # drawn for each team by itself


def test_what_a_past_self_does_is_what_it_did():
    """The actions that are stored of a world in which a past self plays are its own, without noise."""
    model = small(pool_share=1.0, pool_freq=10, wolf={"gradient_steps": 5}).learn(60)
    pool = model._pools["wolf"]
    rows = ROWS[:2]
    model._last_obs, model._line_up = rows, tuple(np.array([1, 0]) for _ in model._pools)
    _, stored = model._sample_action(0, None, 2)
    past = pool.players[1].predict(rows, deterministic=True)[0]
    np.testing.assert_allclose(stored[0, :4], past[0, :4], atol=1e-6)
    now = model.learners["wolf"].policy.predict(rows, deterministic=True)[0]
    assert not np.allclose(stored[1, :4], past[1, :4], atol=1e-3)
    assert np.abs(stored[1, :4] - now[1, :4]).max() < 0.6  # the team as it is explores around its own action


def test_games_count_against_the_other_team_as_it_is_alone():
    model = small(pool_share=0.5, pool_freq=10, pool_sampling="win_rate").learn(60)
    for pool in model._pools.values():
        pool.games[:], pool.won[:] = 0, 0
    model._line_up = (np.array([1, 1, 0, 2]), np.array([0, 2, 1, 0]))  # of wolves, of sheep: the third is the first past sheep
    infos = [{"wolves_win": won} for won in (1.0, 1.0, 0.0, 0.0)]
    model._note_results(np.arange(4), infos)
    wolves, sheep = model._pools.values()
    assert (wolves.games[:2].tolist(), wolves.won[:2].tolist()) == ([1, 1], [1, 0])
    assert (sheep.games[:2].tolist(), sheep.won[:2].tolist()) == ([1, 0], [1, 0])


# ---- refusals


class Subclass(MADDPG):
    """Of no name that a file knows."""


BAD = [
    ({"teams": None}, "co-training needs teams, such as teams="),
    ({"teams": {}}, "co-training needs teams, such as teams="),
    ({"teams": ["wolf"]}, r"players are given by their group, such as .*; got \['wolf'\]"),
    ({"teams": "wolf"}, "players are given by their group, such as .*; got 'wolf'"),
    ({"teams": {"wulf": "maddpg", "sheep": "maddpg"}}, "unknown group 'wulf'; this world has wolf, sheep"),
    ({"teams": {"wolf": "madpg", "sheep": "maddpg"}}, 'unknown algorithm of \'wolf\' "madpg"; did you mean "maddpg"?'),
    ({"teams": {"wolf": 3, "sheep": "maddpg"}}, "a team learns by an algorithm, such as one of maddpg, .*; got 3"),
    ({"teams": {"wolf": {"gamma": 0.9}, "sheep": "maddpg"}}, "a team learns by an algorithm, .*; got {'gamma': 0.9}"),
    ({"teams": {"wolf": Subclass, "sheep": "maddpg"}}, r"it is Subclass; give it a name of your own: sb3_kfcv.register"),
    ({"teams": {"wolf": "maddpg"}}, r"opponents were given for \[\]; the groups that no team learns are \['sheep'\]"),
    ({"opponents": {"sheep": "flee"}}, r"opponents were given for \['sheep'\]; the groups that no team learns are \[\]"),
    ({"teams": {"wolf": "maddpg"}, "opponents": "flee"}, "players are given by their group, such as {'sheep': 'random'}; got"),
    ({"teams": {"wolf": "maddpg"}, "opponents": {"sheep": "fle"}}, 'did you mean "flee"?'),
    ({"wolf": {"gama": 1}}, 'unknown setting in settings of \'wolf\' "gama"; did you mean "gamma"?'),
    ({"wolf": {"gamma": 2}}, "gamma must be at least 0 and at most 1, got 2"),
    ({"wolf": {"train_freq": 2}}, "train_freq must be the same for all teams, got .*; gradient_steps may differ"),
    ({"pool_share": 2}, "pool_share must be at least 0 and at most 1, got 2"),
    ({"pool_share": "half"}, "pool_share must be a number, got 'half'"),
    ({"pool_freq": 0}, "pool_freq must be a whole number of at least 1, got 0"),
    ({"pool_size": 0}, "pool_size must be a whole number of at least 1, got 0"),
    ({"pool_sampling": "win"}, 'unknown pool_sampling "win"; did you mean "win_rate"?'),
    *(({"wolf": {name: value}}, f"{name} of 'wolf' belongs to the whole") for name, value in (("seed", 1), ("verbose", 1))),
    *(({"wolf": {name: value}}, f"{name} of 'wolf' belongs to the whole") for name, value in (("team", "wolf"), ("env", 1))),
]


@pytest.mark.parametrize(("settings", "message"), BAD, ids=[str(settings) for settings, _ in BAD])
def test_what_cannot_train_is_refused_in_a_sentence(settings, message):
    settings = dict(settings)
    with pytest.raises(ValueError, match=message.replace("?", r"\?")) as caught:
        if "teams" in settings:
            CoTraining("MlpPolicy", grassland(), settings.pop("teams"), device="cpu", **settings)
        else:
            small(**settings)
    assert "\n" not in str(caught.value)


def test_teams_do_not_learn_under_normalisation():
    env = VecNormalize(grassland(), norm_reward=False)
    with pytest.raises(ValueError, match="teams do not learn under VecNormalize: opponents need the observations as they are"):
        small(env)
    with pytest.raises(ValueError, match="team= does not work under VecNormalize"):
        MADDPG("MlpPolicy", env, team="wolf", opponents={"sheep": "flee"})


@pytest.mark.filterwarnings("ignore:The environment is already wrapped")
def test_sampling_by_wins_needs_a_world_that_says_who_wins():
    env = make_vec_env(lambda: ToyParallelEnv(time_limit=6), 2, 0)
    teams = {"scout": {"algo": "maddpg", **SMALL}, "tank": {"algo": "maddpg", **SMALL}}
    with pytest.raises(ValueError, match='pool_sampling="win_rate" needs two teams and a world that says who wins'):
        CoTraining("MlpPolicy", env, teams, pool_share=0.5, pool_sampling="win_rate")


def test_a_file_of_another_algorithm_is_refused(tmp_path):
    model = small()
    model.save(tmp_path / "both")
    model.learners["wolf"].save(tmp_path / "wolves")
    with pytest.raises(ValueError, match=r"was saved by CoTraining; load it with CoTraining\.load"):
        MADDPG.load(tmp_path / "both")
    with pytest.raises(ValueError, match=r"was saved by MADDPG; load it with MADDPG\.load"):
        CoTraining.load(tmp_path / "wolves")
    with pytest.raises(ValueError, match="is for another world: 2 wolf"):
        CoTraining.load(tmp_path / "both", env=grassland(n_wolves=3))
