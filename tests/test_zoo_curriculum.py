"""What the curriculum finds easy and hard: facts of transitions against the worlds' own state, and the command."""

import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th

from sb3_kfcv import make_vec_env
from sb3_kfcv.common.evaluation import Interval
from sb3_kfcv.curriculum.difficulty import UNSCORED
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import layout_of
from zoo import plot_curriculum, train
from zoo.plot_curriculum import assess, binned, correlation, in_words, pick_checkpoint
from zoo.runs import Run
from zoo.transition_facts import PLACES, Places, facts_of

TERMS = ("distance", "collision", "cover")
WOLF_TERMS, WORDS = ("distance", "capture", "boundary"), ("distance", "capture", "border")
SMALL = {
    "Grassland-v0": ["n_wolves:2", "n_sheep:2", "n_grass:1", "max_steps:8"],
    "HardSpread-v0": ["n_agents:2", "max_steps:8"],
}


def command(folder, env="HardSpread-v0", algo="kfcv_maddpg", *more):
    kfcv = ["first_teacher_steps:2", "teacher_batch_size:8", "refresh_every:5"] if algo == "kfcv_maddpg" else []
    return [
        *("--algo", algo, "--env", env, "-n", "400", "--seed", "1", "-f", str(folder), "--verbose", "0", "--eval-freq", "-1"),
        *("--save-freq", "50", "--keep-checkpoints", "-1", "--log-interval", "4", "--env-kwargs", *SMALL[env]),
        *("-params", "n_envs:2", "learning_starts:20", "batch_size:8", "buffer_size:400"),
        *(f"replay_buffer_kwargs.{setting}" for setting in kfcv),
        *more,
    ]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """World → the folder of a tiny run."""
    folder = tmp_path_factory.mktemp("logs")
    for env in SMALL:
        assert train.main(command(folder, env)) == 0
    return {env: folder / "kfcv_maddpg" / f"{env}_1" for env in SMALL}


def played(env_id, n_steps=6, **env_kwargs):
    """Observations and state of worlds after random steps, side by side, and their layout."""
    env = make_vec_env(env_id, 5, seed=3, env_kwargs=env_kwargs)
    env.action_space.seed(0)
    observations, states, alive = env.reset(), None, None
    for _ in range(n_steps):
        observations, _, _, infos = env.step(np.stack([env.action_space.sample() for _ in range(5)]))
        states = np.stack([info["next_state"] for info in infos])
        alive = np.stack([info["agent_alive"] & ~info["agent_terminated"] for info in infos])
    return observations, states, alive, layout_of(env)


def test_places_of_hard_spread_are_those_of_the_state():
    observations, states, alive, layout = played("HardSpread-v0", n_agents=3)
    places = PLACES["HardSpread-v0"](observations, alive, layout)
    assert places.positions == pytest.approx(states[:, :6].reshape(5, 3, 2), abs=1e-6)
    assert places.goals == pytest.approx(states[:, 12:18].reshape(5, 3, 2), abs=1e-6)
    assert places.seekers == (0, 1, 2) and places.open.all()


def test_places_of_grassland_are_those_of_the_state():
    observations, states, alive, layout = played("Grassland-v0", n_wolves=3, n_sheep=3)
    places = PLACES["Grassland-v0"](observations, alive, layout)
    positions = states[:, :12].reshape(5, 6, 2)
    assert not alive.all()  # some sheep have been eaten
    assert places.positions[alive] == pytest.approx(positions[alive], abs=1e-6)
    assert (places.open == alive[:, 3:]).all() and places.seekers == (0, 1, 2)
    for world in range(5):
        for wolf in range(3):
            distances = [
                np.hypot(*(positions[world, wolf] - positions[world, sheep])) for sheep in range(3, 6) if alive[world, sheep]
            ]
            found = np.hypot(*places.to_goal()[world, wolf])
            assert found == pytest.approx(min(distances), abs=1e-6) if distances else np.isnan(found)


def test_neighbours_by_hand():
    positions = np.array([[[0, 0], [3, 4], [0, 1]], [[0, 0], [3, 4], [0, 1]]], dtype=float)
    alive = np.array([[True, True, True], [True, True, False]])
    places = Places(positions, alive, (0,), positions, alive, "landmark")
    assert places.to_neighbour() == pytest.approx(np.array([[1, np.sqrt(18), 1], [5, 5, np.nan]]), nan_ok=True)


class Stored:
    """As much of a replay buffer as facts are taken of."""

    def __init__(self, pos, n_envs=1, **arrays):
        self.arrays, self.pos, self.n_envs = {name: th.as_tensor(own) for name, own in arrays.items()}, pos, n_envs
        self.n_rows = len(arrays["rewards"])

    def rows(self, rows):
        return SimpleNamespace(**{name: own[rows] for name, own in self.arrays.items()})


def test_facts_of_rewards_ends_and_age_of_any_world():
    layout = SimpleNamespace(group_names=("cat", "dog"), members=lambda group: {"cat": (0,), "dog": (1, 2)}[group])
    stored = Stored(
        pos=1,  # row 0 is the newest, row 1 the oldest
        rewards=np.array([[1.0, 2, 4], [5, 6, 8], [0, 0, 0]]),
        alive=np.array([[1.0, 1, 1], [1, 0, 1], [1, 1, 1]]),
        dones=np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 0]]),
    )
    facts = facts_of(stored, layout, "mpe2/simple_tag_v3", np.array([0, 1, 2]))
    assert facts["reward per cat"].tolist() == [1, 5, 0]
    assert facts["reward per dog"].tolist() == [3, 8, 0]
    assert facts["agents whose episode ends (share)"].tolist() == [0, 0.5, 0]
    assert facts["age in the buffer (env steps)"].tolist() == [0, 2, 1]


@pytest.mark.parametrize(
    ("env_id", "env_kwargs", "terms"),
    [
        ("HardSpread-v0", {"phi": 0.5}, {f"{term}_term": f"{term} term of the reward" for term in TERMS}),
        ("HardSpread-v0", {"exclusive_cover": True}, {f"{term}_term": f"{term} term of the reward" for term in TERMS}),
        (
            "Grassland-v0",
            {},
            {f"wolf_{name}_term": f"wolves' {word} term of the reward" for name, word in zip(WOLF_TERMS, WORDS, strict=True)},
        ),
    ],
)
def test_terms_of_the_reward_are_those_that_the_world_sums_up(env_id, env_kwargs, terms):
    env = make_vec_env(env_id, 1, seed=5, env_kwargs={**env_kwargs, "max_steps": 20})
    layout, script = layout_of(env), {"HardSpread-v0": "greedy-nearest", "Grassland-v0": None}[env_id]
    names = {"HardSpread-v0": {"agent": script}, "Grassland-v0": {"wolf": "chase", "sheep": "random"}}[env_id]
    policy = TeamPolicy(layout, names, np.random.default_rng(0))
    steps, observations, done = [], env.reset(), False
    while not done:
        following, _, dones, infos = env.step(policy.predict(observations)[0])
        done, info = dones[0], infos[0]
        after = info["terminal_observation"] if done else following[0]
        steps.append((observations[0], after, info["agent_rewards"], info["agent_alive"], info["agent_terminated"]))
        observations = following
    parts = ("observations", "next_observations", "rewards", "alive", "dones")
    stored = Stored(
        0, **{name: np.stack(own).astype(np.float32) for name, own in zip(parts, zip(*steps, strict=True), strict=True)}
    )
    facts = facts_of(stored, layout, env_id, np.arange(len(steps)), env_kwargs.get("phi"))
    for metric, fact in terms.items():
        assert facts[fact].sum() == pytest.approx(info["episode_metrics"][metric], abs=1e-3), metric


def test_binned_by_hand():
    few = binned(np.array([1.0, 1, 2, 2]), np.array([0.0, 1, 0.25, 0.75]))
    assert [part.tolist() for part in few] == [[1, 2], [0.5, 0.5], [0.25, 0.375], [0.75, 0.625]]
    values = np.arange(1000.0)
    middles, means, low, high = binned(values, values / 999)
    assert len(middles) == plot_curriculum.BINS and means == pytest.approx(middles / 999)
    assert (low < means).all() and (means < high).all()


def test_correlation_leaves_out_what_does_not_apply():
    assert correlation(np.array([0, 0.5, 1, 0.2]), np.array([3, 2, 1, np.nan])) == pytest.approx(-1)
    assert np.isnan(correlation(np.array([0, 1.0]), np.array([np.nan, 1.0])))


def test_words():
    assert in_words("distance", Interval(0.4, 0.3, 0.5)) == "distance: the larger, the harder (ρ = 0.40 ± 0.10)"
    assert in_words("distance", Interval(-0.4, np.nan, np.nan)) == "distance: the larger, the easier (ρ = -0.40)"
    assert "no clear relation" in in_words("distance", Interval(0.4, -0.1, 0.9))
    assert "no clear relation" in in_words("distance", Interval(0.02, 0.01, 0.03))


def test_by_default_the_last_checkpoint_of_the_curriculum(runs):
    run = Run.at(runs["HardSpread-v0"])
    assert pick_checkpoint(run, None).name == "rl_model_150_steps.zip"  # it ends after 200 of the 400
    assert pick_checkpoint(run, 330).name == "rl_model_350_steps.zip"


def test_difficulty_is_the_place_in_the_ranking(runs):
    assessed = assess(Run.at(runs["HardSpread-v0"]), None, rescore=False)
    scores = assessed.buffer.scores[assessed.rows]
    assert (assessed.buffer.buckets[assessed.rows] != UNSCORED).all()
    assert (np.diff(assessed.difficulty[scores.argsort()]) > 0).all()
    assert (assessed.difficulty.min(), assessed.difficulty.max()) == (0, 1)
    again = assess(Run.at(runs["HardSpread-v0"]), None, rescore=True)
    assert len(again.rows) == 150 >= len(assessed.rows)


@pytest.mark.parametrize("env", SMALL)
def test_the_command(runs, env, tmp_path, capsys):
    assert plot_curriculum.main([str(runs[env]), "-o", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    goal = {"HardSpread-v0": "landmark", "Grassland-v0": "sheep"}[env]
    assert f"distance to the nearest {goal} (world units)" in shown and "written:" in shown
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("training.png", "easy_and_hard.png", "map.png", "curriculum.json")
    }
    told = json.loads((tmp_path / "out" / "curriculum.json").read_text())
    assert -1 <= told["facts"][f"distance to the nearest {goal} (world units)"]["correlation"]["mean"] <= 1
    assert told["runs"][str(runs[env])]["checkpoint"] == 150


def test_without_checkpoints_the_training_is_shown(runs, tmp_path, capsys):
    copy = tmp_path / "kfcv_maddpg" / "HardSpread-v0_1"
    shutil.copytree(runs["HardSpread-v0"], copy, ignore=shutil.ignore_patterns("rl_model_*"))
    assert plot_curriculum.main([str(copy), "-o", str(tmp_path / "out")]) == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["training.png"]
    assert "has no checkpoint, so none of its transitions are looked at" in capsys.readouterr().err


def test_runs_that_differ_are_told(runs, tmp_path, capsys):
    other = command(tmp_path, "HardSpread-v0", "kfcv_maddpg", "gamma:0.9")
    assert train.main(other) == 0
    capsys.readouterr()
    both = [str(runs["HardSpread-v0"]), str(tmp_path / "kfcv_maddpg"), "--checkpoint", "350"]
    assert plot_curriculum.main([*both, "-o", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().err
    assert "the runs differ in gamma (0.9, 0.99)" in told and "is of the time after the curriculum: its scores are old" in told


def test_bad_input(runs, tmp_path, capsys):
    def refused(*words):
        assert plot_curriculum.main([*words, "-o", str(tmp_path / "out")]) == 2
        assert not (tmp_path / "out").exists()
        return capsys.readouterr().err

    assert train.main(command(tmp_path, "HardSpread-v0", "maddpg")) == 0
    capsys.readouterr()
    assert "is a run of maddpg; only kfcv_maddpg has a curriculum" in refused(str(tmp_path / "maddpg"))
    assert "take one world\n" in refused(str(runs["HardSpread-v0"]), str(runs["Grassland-v0"]))
    assert "there is no run of zoo/train.py in" in refused(str(tmp_path / "nothing"))
    assert "--checkpoint must be a whole number of at least 1, got -5" in refused("--checkpoint", "-5")
    assert 'unknown flag "--checkpoints"; did you mean "--checkpoint"?' in refused("--checkpoints", "3")
