"""Released models: they play as those of the run, are small, can only play, and their cards tell what is measured."""

import hashlib
import json
import re
import shlex
import shutil

import numpy as np
import pytest
import yaml
from filelock import FileLock

from sb3_kfcv import ALGOS, MADDPG, CoTraining, FileFormatError, load_normalization, make_vec_env
from sb3_kfcv.common.evaluation import Interval
from sb3_kfcv.envs import grassland_v0
from sb3_kfcv.saving.releases import release_model
from sb3_kfcv.teams.players import Mixture, load_player
from tests.toy_runs import toy_run
from zoo import enjoy, evaluate, match, plot, release, train
from zoo.match_results import shown
from zoo.run_folder import RunFolder
from zoo.runs import Run, runs_below

SIZES = {"n_wolves": 2, "n_sheep": 2, "n_grass": 1, "max_steps": 5}
PARAMS = ["n_envs:2", "learning_starts:20", "batch_size:8", "buffer_size:200"]
SENTENCE = "the model was released for playing only, without critics and optimisers; to train, start a new run"


def train_run(folder, env, *more, algo="maddpg", seed=1, params=(), settings=()):
    words = ["--algo", algo, "--env", env, "-n", "80", "--seed", str(seed), "-f", str(folder), "--verbose", "0"]
    words += ["--eval-freq", "40", "--eval-episodes", "2", "-params", *PARAMS, *params, "--env-kwargs", *settings, *more]
    assert train.main(words) == 0


def grassland(folder, *more, **settings):
    train_run(folder, "Grassland-v0", *more, settings=[f"{name}:{value}" for name, value in SIZES.items()], **settings)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """
    Grassland by maddpg: of all agents (1), of wolves that met grazing sheep (2), of wolves that met the sheep of a file (3); a
    co-training. Hard Spread: two seeds of kfcv_maddpg; and per_maddpg on normalised observations.
    """
    folder = tmp_path_factory.mktemp("here") / "logs"
    grassland(folder)
    grassland(folder, "--team", "wolf", "sheep=graze,flee")
    grassland(folder, "--team", "wolf", f"sheep={folder / 'maddpg' / 'Grassland-v0_1'}")
    grassland(folder, "--team", "wolf=maddpg", "sheep=per_maddpg")
    spread = {"env": "HardSpread-v0", "settings": ["n_agents:2", "max_steps:5"]}
    for seed in (1, 2):
        train_run(folder, algo="kfcv_maddpg", seed=seed, **spread)
    train_run(folder, algo="per_maddpg", params=["normalize:true"], **spread)
    return folder


def run(logs, env="Grassland-v0", algo="maddpg", number=1):
    return logs / algo / f"{env}_{number}"


def released(tmp_path, *words, n=3):
    """The folder of the only release that is made."""
    assert release.main([*map(str, words), "-n", str(n), "-f", str(tmp_path / "trained_agents")]) == 0
    (card,) = tmp_path.glob("trained_agents/*/*/README.md")
    return card.parent


@pytest.fixture(scope="module")
def spread(logs, tmp_path_factory):
    """The release of two seeds."""
    return released(tmp_path_factory.mktemp("spread"), f"{logs}/kfcv_maddpg/*")


@pytest.fixture(scope="module")
def wolves(logs, tmp_path_factory):
    """The release of wolves that met sheep of a file."""
    return released(tmp_path_factory.mktemp("wolves"), run(logs, number=3))


def header(folder):
    return yaml.safe_load((folder / "README.md").read_text().split("---\n")[1])


# ---- the file


@pytest.mark.parametrize(("number", "algo"), [(1, "maddpg"), (2, "maddpg"), (3, "maddpg"), (1, "co_training")])
def test_it_plays_to_the_bit_as_the_whole_model(number, algo, logs, tmp_path):
    """With everybody who plays: the opponents of its training act from the file, too."""
    path = run(logs, algo=algo, number=number) / "Grassland-v0.zip"
    release_model(path, tmp_path / "small.zip")
    cls = CoTraining if algo == "co_training" else MADDPG
    whole, small = cls.load(path), cls.load(tmp_path / "small")
    rows = np.random.default_rng(0).normal(size=(5, *whole.observation_space.shape)).astype(np.float32)
    for n in (1, 5):
        expected, found = (model.predict(rows[:n], deterministic=True)[0] for model in (whole, small))
        assert np.array_equal(expected, found) and expected.any()
    own = rows[:, whole.layout.obs_slices[0]]
    assert np.array_equal(whole.predict_agent("wolf_0", own), small.predict_agent("wolf_0", own))
    assert small.num_timesteps == whole.num_timesteps == 80


@pytest.mark.parametrize("algo", ALGOS)
def test_agents_that_choose_play_to_the_bit_too(algo, tmp_path):
    env = grassland_v0.parallel_env(**SIZES, continuous_actions=False)
    model = ALGOS[algo]("MlpPolicy", env, seed=0, share_parameters=True, policy_kwargs={"net_arch": [8], "layer_norm": True})
    model.save(tmp_path / "model")
    release_model(tmp_path / "model", tmp_path / "small.zip")
    small = ALGOS[algo].load(tmp_path / "small.zip")
    rows = np.random.default_rng(0).normal(size=(9, *model.observation_space.shape)).astype(np.float32)
    assert np.array_equal(model.predict(rows, deterministic=True)[0], small.predict(rows, deterministic=True)[0])


@pytest.mark.parametrize(("env", "most"), [("Grassland-v0", 1_600_000), ("HardSpread-v0", 100_000)])
def test_it_is_small(env, most, tmp_path):
    """Of the paper's worlds and networks: four bytes for each weight of the actors, and little more."""
    model = MADDPG("MlpPolicy", env, buffer_size=200, batch_size=8)
    model.save(tmp_path / "model.zip")
    release_model(tmp_path / "model.zip", tmp_path / "small.zip")
    n_weights = sum(parameter.numel() for parameter in model.actor.parameters())
    assert 4 * n_weights < (tmp_path / "small.zip").stat().st_size < most


def test_it_says_that_it_only_plays(spread, logs, tmp_path, capsys):
    model = ALGOS["kfcv_maddpg"].load(
        spread / "HardSpread-v0.zip", make_vec_env("HardSpread-v0", 2, env_kwargs={"n_agents": 2})
    )
    calls = (lambda: model.learn(10), lambda: model.save_replay_buffer(tmp_path / "buffer"))
    for call in (*calls, lambda: model.load_replay_buffer(tmp_path / "buffer")):
        with pytest.raises(ValueError, match=SENTENCE):
            call()
    words = ["--algo", "kfcv_maddpg", "--env", "HardSpread-v0", "-i", str(spread), "-n", "10", "-f", str(tmp_path / "logs")]
    assert train.main(words) == 2
    assert SENTENCE in capsys.readouterr().err and not (tmp_path / "logs").exists()


def test_it_can_be_saved_again_and_plays_in_matches(wolves, tmp_path):
    model = MADDPG.load(wolves / "Grassland-v0.zip")
    model.save(tmp_path / "again.zip")
    again = MADDPG.load(tmp_path / "again.zip")
    rows = np.ones((2, *model.observation_space.shape), dtype=np.float32)
    expected = model.predict(rows, deterministic=True)[0]
    assert np.array_equal(again.predict(rows, deterministic=True)[0], expected)
    columns = slice(0, 4)  # two wolves, two numbers each
    player = load_player(wolves / "Grassland-v0.zip", "wolf")
    assert np.array_equal(player.predict(rows, deterministic=True)[0][:, columns], expected[:, columns])


def test_a_damaged_one_is_refused_by_its_name(spread, tmp_path, capsys):
    copy = tmp_path / "kfcv_maddpg" / "HardSpread-v0_1"
    shutil.copytree(spread, copy)
    file = copy / "HardSpread-v0.zip"
    content = bytearray(file.read_bytes())
    content[content.rindex(b"\x93NUMPY") + 130] ^= 1
    file.write_bytes(content)
    with pytest.raises(FileFormatError, match=rf"{re.escape(str(file))} is damaged: parameters/policy/actor"):
        ALGOS["kfcv_maddpg"].load(file)
    assert enjoy.main([str(copy), "--no-render", "-n", "1"]) == 2
    assert f"error: {file} is damaged" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("claim", "message"), [("yes", "plays_only is yes or no"), (True, "other parameters than the network")]
)
def test_a_file_that_claims_to_be_released_and_is_not_is_refused(claim, message, logs, tmp_path):
    model = MADDPG.load(run(logs) / "Grassland-v0.zip")
    model.plays_only = claim
    model.save(tmp_path / "odd.zip")
    with pytest.raises(FileFormatError, match=message):
        MADDPG.load(tmp_path / "odd.zip")


# ---- the folder


def test_the_commands_take_it(spread, wolves, tmp_path, capsys):
    at = ["-f", str(spread.parents[1])]
    assert enjoy.main(["--algo", "kfcv_maddpg", "--env", "HardSpread-v0", "--no-render", "-n", "2", *at]) == 0
    assert "HardSpread-v0: kfcv_maddpg_1" in capsys.readouterr().out
    assert evaluate.main(["-n", "2", "--json", str(tmp_path / "own.json"), *at]) == 0
    assert json.loads((tmp_path / "own.json").read_text())["env_kwargs"]["max_steps"] == 5
    words = ["--team", f"wolf={wolves}", "wolf=chase", "sheep=graze", "-n", "2", "-o", str(tmp_path / "match")]
    assert match.main(words) == 0
    assert plot.main([at[1], "-o", str(tmp_path / "curves.png")]) == 0


def test_normalised_observations_stay_so(logs, tmp_path):
    """The statistics are in the released file."""
    folder = released(tmp_path, run(logs, "HardSpread-v0", "per_maddpg"))
    found = []
    for path in (folder, run(logs, "HardSpread-v0", "per_maddpg")):
        file, cls = path / "HardSpread-v0.zip", ALGOS["per_maddpg"]
        env = load_normalization(file, make_vec_env("HardSpread-v0", 2, 0, {"n_agents": 2}), training=False)
        found.append(cls.load(file, env).predict(env.reset(), deterministic=True)[0])
    assert np.array_equal(*found)
    assert "env = load_normalization(" in (folder / "README.md").read_text()


def test_nothing_names_a_place_of_this_machine(wolves, tmp_path):
    """Its opponents came from a file that was named by an absolute path; all else from logs in a temporary folder."""
    for file in filter(lambda path: path.is_file(), wolves.rglob("*")):
        assert str(tmp_path.parent).encode() not in file.read_bytes(), file
    texts = [(wolves / "Grassland-v0" / name).read_text() for name in ("args.yml", "config.yml", "command.txt")]
    for text in (*texts, (wolves / "README.md").read_text()):
        assert not re.search(r"(?<![\w.)\]])/\w+/", text), text
    assert "Against the opponents of its training" in (wolves / "README.md").read_text()
    assert Run.at(wolves).hyperparams.model["opponents"] == {"sheep": "Grassland-v0.zip"}
    assert Run.at(wolves).folder.command.startswith(
        "python zoo/train.py --algo maddpg --env Grassland-v0 -n 80 --seed 1 -f logs"
    )


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("/data/runs/logs", "logs"),
        ("C:\\runs\\logs", "logs"),
        ("sheep=/data/a.zip,/data/b.zip", "sheep=a.zip,b.zip"),
        ("--log-folder=/data/logs", "--log-folder=logs"),
        ("-f/data/logs", "-flogs"),
        (
            {"opponents": {"sheep": ["/data/a.zip", "graze"]}, "gamma": 0.9},
            {"opponents": {"sheep": ["a.zip", "graze"]}, "gamma": 0.9},
        ),
        ("logs/maddpg", "logs/maddpg"),
        ("mpe2/simple_spread_v3", "mpe2/simple_spread_v3"),
        ("gamma:0.9", "gamma:0.9"),
    ],
)
def test_places_are_left_out(value, expected):
    assert release.portable(value) == expected


def test_a_path_below_here_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert release.portable(f"sheep={tmp_path}/logs/maddpg/a.zip") == "sheep=logs/maddpg/a.zip"


@pytest.mark.parametrize(
    "typed", ["/opt/x/bin/python /opt/x/zoo/train.py --env A", "sb3-kfcv train --env A", "python zoo/train.py --env A"]
)
def test_the_command_has_the_seed_that_was_drawn(typed):
    first = "sb3-kfcv train" if typed.startswith("sb3") else "python zoo/train.py"
    assert release.portable_command(typed, 7) == f"{first} --env A --seed 7"
    assert release.portable_command(f"{typed} --seed 5", 5) == f"{first} --env A --seed 5"


# ---- the card


def test_the_numbers_on_the_card_are_those_of_evaluate(spread, tmp_path, monkeypatch):
    """The command on the card is typed where it can be: beside the folder."""
    monkeypatch.chdir(spread.parents[2])
    card = (spread / "README.md").read_text()
    (typed,) = re.findall(r"    python zoo/evaluate.py (.*)", card)
    assert evaluate.main([*shlex.split(typed), "--json", str(tmp_path / "measured.json")]) == 0
    own, *others = json.loads((tmp_path / "measured.json").read_text())["players"]
    assert own["player"] == "kfcv_maddpg_1" and {"oracle", "random"} <= {other["player"] for other in others}
    ((result,), name) = header(spread)["model-index"][0]["results"], header(spread)["model-index"][0]["name"]
    assert name == "KFCV-MADDPG" and result["dataset"]["type"] == "HardSpread-v0"
    for metric in result["metrics"]:
        assert metric["value"] == own[metric["type"]]["mean"]
    cells = [shown(Interval(**player["return_agent"])) for player in (own, *others)]
    assert f"| return_agent | {' | '.join(cells)} |" in card


def test_the_card_says_from_how_many_it_was_chosen(spread, logs):
    rewards = {}
    for number, seed in ((1, 1), (2, 2)):
        with np.load(run(logs, "HardSpread-v0", "kfcv_maddpg", number) / "evaluations.npz") as arrays:
            rewards[seed] = arrays["results"][-1].mean()
    best = max(rewards, key=rewards.get)
    card = (spread / "README.md").read_text()
    listed = ", ".join(f"seed {seed}: {reward:.2f}" for seed, reward in rewards.items())
    assert f"chosen from 2 runs of these settings by the mean reward of their last evaluation ({listed})" in card
    assert f"| seed | {best} |" in card and Run.at(spread).seed == best
    whole, small = (
        ALGOS["kfcv_maddpg"].load(path / "HardSpread-v0.zip")
        for path in (run(logs, "HardSpread-v0", "kfcv_maddpg", best), spread)
    )
    assert all(
        np.array_equal(one, other)
        for one, other in zip(whole.actor.state_dict().values(), small.actor.state_dict().values(), strict=True)
    )


def test_the_card_has_the_checksum_and_what_the_hub_reads(spread):
    head, card = header(spread), (spread / "README.md").read_text()
    assert head["library_name"] == "sb3-kfcv" and {"HardSpread-v0", "reinforcement-learning", "kfcv_maddpg"} <= set(
        head["tags"]
    )
    assert hashlib.sha256((spread / "HardSpread-v0.zip").read_bytes()).hexdigest() in card
    assert "80 env steps" in card and "gamma: 0.99" in card and "`HardSpread-v0` (agent × 2)" in card


@pytest.mark.parametrize("which", ["spread", "wolves"])
def test_the_lines_of_python_run(which, request, monkeypatch):
    folder = request.getfixturevalue(which)
    monkeypatch.chdir(folder.parents[2])
    (lines,) = re.findall(r"```python\n(.*?)\n```", (folder / "README.md").read_text(), re.DOTALL)
    names = {}
    exec(lines, names)
    assert names["actions"].shape == (1, *names["env"].action_space.shape)


def test_whom_a_model_is_measured_beside(logs, tmp_path):
    def words(number, algo="maddpg"):
        path = run(logs, algo=algo, number=number) / "Grassland-v0.zip"
        model = (CoTraining if algo == "co_training" else MADDPG).load(path)
        return release.comparisons(model.layout, path)

    wolf, sheep = ["random", "chase"], ["random", "flee", "graze"]
    everybody = [
        ["random"],
        [*wolf, "--team", "sheep=flee"],
        [*wolf, "--team", "sheep=graze"],
        [*sheep, "--team", "wolf=chase"],
    ]
    assert words(1) == words(1, "co_training") == everybody
    assert words(2) == [[*wolf, "--team", "sheep=graze,flee"]]
    assert words(3) == [[]]  # its sheep are in its own file alone
    assert release._as_word(Mixture(["graze", "flee"], [3, 1])) == ""


def test_a_co_training_is_released_with_both_teams(logs, tmp_path, capsys):
    folder = released(tmp_path, run(logs, algo="co_training"))
    card = (folder / "README.md").read_text()
    for line in ("MADDPG wolf against PER-MADDPG sheep", "Each playing all of wolf and sheep:", "Against sheep: graze:"):
        assert line in card
    assert enjoy.main([str(folder), "--no-render", "-n", "1"]) == 0


@pytest.mark.parametrize(("typed", "shown"), [("out", "out"), ("a/out", "a/out"), ("../out", "out"), ("{tmp}/b/out", "out")])
def test_the_folder_as_the_card_names_it(typed, shown, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert release.shown_place(typed.format(tmp=tmp_path)) == shown


def test_a_run_that_is_not_at_its_end(logs, tmp_path, capsys):
    """By itself it is released, and its card says at which step; beside others it is left out."""
    for number in (1, 2):
        shutil.copytree(run(logs, "HardSpread-v0", "kfcv_maddpg", number), tmp_path / "logs" / "a" / f"HardSpread-v0_{number}")
    going_on = tmp_path / "logs" / "a" / "HardSpread-v0_1"
    (going_on / "HardSpread-v0.zip").unlink()
    shutil.copyfile(going_on / "best_model.zip", going_on / "rl_model_40_steps.zip")
    steps = ALGOS["kfcv_maddpg"].load(going_on / "best_model.zip").num_timesteps
    card = (released(tmp_path / "alone", going_on) / "README.md").read_text()
    assert f"The run was not at its end: the model is of {steps} of 80 env steps." in card
    assert "not at its end" not in (released(tmp_path / "both", tmp_path / "logs") / "README.md").read_text()
    assert f"note: left out, since not at the end of the training: {going_on}" in capsys.readouterr().err
    assert Run.at(tmp_path / "both" / "trained_agents" / "kfcv_maddpg" / "HardSpread-v0_1").seed == 2


def test_the_worlds_that_measure_are_none_of_a_training():
    """Of any seed that is drawn, of ten thousand worlds that evaluate."""
    assert 2**31 + train.EVAL_SEED_OFFSET + 10_000 < release.FRESH_SEED < 2**32 - 10_000_000


# ---- what is refused


def test_a_release_is_replaced_only_by_force(logs, tmp_path, capsys):
    folder = released(tmp_path, run(logs))
    words = [str(run(logs)), "-n", "3", "-f", str(tmp_path / "trained_agents")]
    (folder / "README.md").write_text("mine")
    assert release.main(words) == 2
    assert f"error: {folder} is released already; --force replaces it" in capsys.readouterr().err
    assert (folder / "README.md").read_text() == "mine"
    assert release.main([*words, "--force"]) == 0
    assert (folder / "README.md").read_text() != "mine"
    assert release.main([*words, "--exp-id", "2"]) == 0
    assert sorted(path.name for path in folder.parent.iterdir()) == ["Grassland-v0_1", "Grassland-v0_2"]
    assert [path.name for path in (tmp_path / "trained_agents").iterdir()] == ["maddpg"]
    for number in (1, 2):  # without it the latest of both would play
        text = (folder.parent / f"Grassland-v0_{number}" / "README.md").read_text()
        assert text.count(f"-f trained_agents --exp-id {number}") == 3


@pytest.mark.parametrize("moment", ["measure", "swap"])
def test_a_kill_costs_no_release_and_leaves_no_run(moment, logs, tmp_path, monkeypatch, capsys):
    """While it is measured, and between the two renames of the swap. What is left is no run; the next command removes it."""
    releases = tmp_path / "trained_agents"
    folder = released(tmp_path, run(logs))
    (folder / "README.md").write_text("mine")
    words = [str(run(logs)), "-n", "3", "-f", str(releases)]
    swap = release.swap

    def stop(new, *more):
        if moment == "swap":
            swap(new.with_name("missing"), *more)
        raise FileNotFoundError

    with monkeypatch.context() as patch:
        patch.setattr(release, moment, stop)
        patch.setattr(release, "clear", lambda made: None)  # a killed command puts nothing in order
        assert release.main([*words, "--force"]) == 2
    capsys.readouterr()
    (left,) = releases.glob(".*")
    assert folder.exists() == (moment == "measure")
    assert len(runs_below(releases)) == (moment == "measure")
    assert release.main(words) == 2 and "is released already" in capsys.readouterr().err
    assert (folder / "README.md").read_text() == "mine" and not left.exists()
    assert release.main([*words, "--force"]) == 0
    assert (folder / "README.md").read_text() != "mine" and not [*releases.glob(".*")]


def test_the_folder_of_a_release_at_work_stays(tmp_path):
    (tmp_path / ".release-a").mkdir()
    with FileLock(tmp_path / ".release-a" / ".lock"):
        assert release.main(["nothing", "-f", str(tmp_path)]) == 2
        assert (tmp_path / ".release-a").is_dir()
    assert release.main(["nothing", "-f", str(tmp_path)]) == 2
    assert not (tmp_path / ".release-a").exists()


def test_a_run_is_never_replaced(logs, capsys):
    assert release.main([str(run(logs)), "-n", "3", "-f", str(logs), "--force"]) == 2
    assert "is there and is no release" in capsys.readouterr().err
    assert (run(logs) / "evaluations.npz").is_file()


def test_the_best_model_of_a_run(logs, tmp_path):
    folder = released(tmp_path, run(logs), "--load-best")
    best = MADDPG.load(run(logs) / "best_model.zip")
    assert np.array_equal(
        *(model.actor.state_dict()["stacks.0.first.weight"] for model in (best, MADDPG.load(folder / "Grassland-v0")))
    )
    assert "the model of the run's best evaluation" in (folder / "README.md").read_text()


def at_its_end(folder):
    (folder / "Grassland-v0.zip").touch()
    return folder


@pytest.mark.parametrize(("content", "message"), [("[1]", "holds no map of versions"), ("{", "is no valid JSON")])
def test_damaged_versions_are_refused_by_name(content, message, logs, tmp_path, capsys):
    damaged = shutil.copytree(run(logs), tmp_path / "Grassland-v0_1")
    file = damaged / "Grassland-v0" / "versions.json"
    file.write_text(content)
    assert release.main([str(damaged), "-f", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith(f"error: {file} {message}")


def test_a_release_is_not_resumed(spread, capsys):
    assert train.main(["--resume", str(spread)]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"error: {spread} was released for playing only") and "-i" not in printed.split(str(spread))[1]


def test_bad_input(logs, spread, tmp_path, capsys):
    toys = tmp_path / "toys"
    for gamma in (0.9, 0.95):
        at_its_end(toy_run(toys / "differing", config={"gamma": gamma}))
    for seed, steps in ((1, (100, 200)), (2, ())):
        at_its_end(toy_run(toys / "silent", seed=seed, steps=steps))
    for n_timesteps in (200, 400):
        at_its_end(toy_run(toys / "lengths", seed=n_timesteps, config={"n_timesteps": n_timesteps}))
    twice = [at_its_end(toy_run(toys / "twice", seed=7)) for _ in range(2)]
    damaged = at_its_end(toy_run(toys / "damaged"))
    (damaged / "evaluations.npz").write_bytes((damaged / "evaluations.npz").read_bytes()[:-30])
    toy_run(toys / "begun")
    for seed in (1, 2):
        toy_run(toys / "all_begun", seed=seed)
    files = shutil.copytree(run(logs), toys / "maddpg" / "Grassland-v0_1")
    RunFolder.at(files).best_model.unlink()
    for words, message in (
        (["nothing"], "there is no run of zoo/train.py in nothing"),
        ([toys / "differing"], "MADDPG on Grassland-v0: the runs differ in gamma (0.9, 0.95); name only those"),
        ([toys / "silent"], "has no evaluations to choose by; name the run that is to be released"),
        ([toys / "lengths"], f"n_timesteps (200 in {toys}/lengths/maddpg/Grassland-v0_1, 400 in {toys}/lengths/maddpg/Grass"),
        ([toys / "twice"], f"{twice[0]} and {twice[1]} have the same seed, 7; name one of them alone"),
        ([damaged], f"{damaged}/evaluations.npz cannot be read"),
        ([toys / "all_begun"], "has come to its end; name the one that is to be released"),
        ([toys / "begun"], "has no model and no checkpoint yet"),
        ([files, "--load-best"], "has no best_model.zip; leave out --load-best"),
        ([spread], "HardSpread-v0.zip is a release already"),
        ([run(logs, number=i) for i in (1, 2)], "would both be"),
        ([run(logs), "-n", "1"], "-n must be a whole number of at least 2, got 1"),
        ([run(logs), "--forse"], 'unknown flag "--forse"; did you mean "--force"?'),
    ):
        assert release.main([*map(str, words), "-f", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_nothing_is_left_of_one_that_was_stopped(logs, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(release, "measure", stop)
    with pytest.raises(KeyboardInterrupt):
        release.main([str(run(logs)), "-f", str(tmp_path)])
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
