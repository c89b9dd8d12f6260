"""Teams by the training script: who learns, who plays, what is measured, what is kept, and what goes on after a kill."""

import shutil

import numpy as np
import pytest
import yaml
from test_resume import (
    NEVER,
    KillAt,
    Killer,
    assert_equal_arrays,
    assert_equal_checkpoints,
    assert_same_contents,
    episodes,
    has_begun,
    killed,
    resume,
    series,
    start,
    wait_until,
)
from test_zoo import SMALL, TINY, TINY_KFCV, run_folder

from sb3_kfcv import MADDPG, PERMADDPG, CoTraining
from sb3_kfcv.saving.checkpoints import checkpoints_in
from sb3_kfcv.teams.players import load_player
from zoo import train
from zoo.teams import label, parse_teams

BOTH = ("--team", "wolf=maddpg", "sheep=per_maddpg")


def command(folder, *more, steps=120, params=(), yardsticks=("sheep=graze", "wolf=random")):
    """A tiny run with a yardstick for each side."""
    return [
        *("--env", "Grassland-v0", "-n", str(steps), "--seed", "1", "-f", str(folder), "--verbose", "0"),
        *("--eval-freq", "60", "--eval-episodes", "3", "--log-interval", "8", "--save-freq", "40"),
        *("-params", *TINY, *params, "--env-kwargs", *SMALL["Grassland-v0"], "--player-freq", "50"),
        *(("--yardstick", *yardsticks) if yardsticks else ()),
        *more,
    ]


def folder_of(folder, algo="co_training", number=1):
    return run_folder(folder, algo=algo, number=number)


def whole_run(folder, *more, algo="co_training", **settings):
    assert train.main(command(folder, *more, **settings)) == 0
    return folder_of(folder, algo)


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """A run of two teams."""
    return whole_run(tmp_path_factory.mktemp("both"), *BOTH, params=["sheep.gamma:0.9"])


@pytest.fixture(scope="module")
def sheep(tmp_path_factory):
    """The model of a run of sheep."""
    words = ["--algo", "maddpg", "--team", "sheep", "wolf=chase"]
    return whole_run(tmp_path_factory.mktemp("sheep"), *words, algo="maddpg", yardsticks=()).last_model


def assert_equal_team_runs(one, other):
    """Models, players, checkpoints, evaluations, monitor files and TensorBoard series."""
    assert sorted(path.name for path in one.players.iterdir()) == sorted(path.name for path in other.players.iterdir())
    names = [path.relative_to(one.path) for path in (one.last_model, *one.path.glob("best_*.zip"), *one.players.iterdir())]
    for name in names:
        assert_same_contents(one.path / name, other.path / name)
    assert_equal_checkpoints(one.path, other.path)
    assert episodes(one.monitor_file) == episodes(other.monitor_file)
    written = sorted(path.name for path in one.path.glob("evaluations*.npz"))
    assert written == sorted(path.name for path in other.path.glob("evaluations*.npz"))
    for name in written:
        assert_equal_arrays(one.path / name, other.path / name)
    np.testing.assert_equal(series(one.path), series(other.path))


# ---- what a run leaves


def test_two_teams_leave_everything_in_their_folder(both):
    model = CoTraining.load(both.last_model)
    assert {team: type(learner) for team, learner in model.learners.items()} == {"wolf": MADDPG, "sheep": PERMADDPG}
    assert (model.num_timesteps, model.learners["wolf"].gamma, model.learners["sheep"].gamma) == (120, 0.99, 0.9)
    config = yaml.safe_load(both.config_file.read_text())
    assert {team: own["algo"] for team, own in config["teams"].items()} == {"wolf": "maddpg", "sheep": "per_maddpg"}
    assert config["teams"]["wolf"]["batch_size"] == 8
    players = {f"{team}_{steps}_steps.zip" for team in ("wolf", "sheep") for steps in (0, 50, 100, 120)}
    assert {path.name for path in both.players.iterdir()} == players
    assert {path.name for path in both.path.glob("best*")} == {"best_wolf.zip", "best_sheep.zip"}
    assert MADDPG.load(both.path / "best_wolf.zip").team == "wolf"


def test_evaluations_are_against_each_yardstick(both):
    names = ["evaluations.npz", "evaluations_sheep_vs_random.npz", "evaluations_wolf_vs_graze.npz"]
    assert sorted(path.name for path in both.path.glob("evaluations*.npz")) == names
    for name in names:
        with np.load(both.path / name) as arrays:
            assert arrays["timesteps"].tolist() == [60, 120]
            assert arrays["return_wolf"].shape == (2, 3)
    logged = series(both.path)
    for name in ("eval", "wolf_vs_graze", "sheep_vs_random"):
        assert [step for step, _ in logged[f"{name}/return_wolf"]] == [60, 120]
    assert any(tag.startswith("train_wolf/") for tag in logged) and any(tag.startswith("train_sheep/") for tag in logged)


def test_teams_that_learn_at_once_are_measured_by_every_script(tmp_path):
    run = whole_run(tmp_path, *BOTH, yardsticks=(), steps=60)
    names = {path.stem.removeprefix("evaluations_") for path in run.path.glob("evaluations_*.npz")}
    assert names == {"wolf_vs_flee", "wolf_vs_graze", "sheep_vs_chase"}


def test_one_team_learns_against_a_mixture_of_files_and_scripts(tmp_path, sheep):
    run = whole_run(tmp_path, "--team", "wolf=per_maddpg", f"sheep={sheep},graze", algo="per_maddpg")
    config = yaml.safe_load(run.config_file.read_text())
    assert (config["team"], config["opponents"]) == ("wolf", {"sheep": [str(sheep), "graze"]})
    assert {path.name for path in run.players.iterdir()} == {f"wolf_{steps}_steps.zip" for steps in (0, 50, 100, 120)}
    assert load_player(run.last_model, "wolf").agents == [0, 1]


def test_an_opponent_may_be_a_run_folder(tmp_path, sheep):
    run = whole_run(tmp_path, "--team", "wolf=maddpg", f"sheep={sheep.parent}", algo="maddpg", yardsticks=())
    assert yaml.safe_load(run.config_file.read_text())["opponents"] == {"sheep": str(sheep)}


def test_two_files_of_one_name_are_two_yardsticks(tmp_path, sheep):
    other = tmp_path / "other" / sheep.name
    other.parent.mkdir()
    shutil.copy(sheep, other)
    given = (f"sheep={sheep}", f"sheep={other}")
    run = whole_run(tmp_path, "--team", "wolf=maddpg", "sheep=graze", algo="maddpg", yardsticks=given, steps=60)
    names = {path.stem.removeprefix("evaluations_") for path in run.path.glob("evaluations_*.npz")}
    assert names == {"wolf_vs_Grassland-v0", "wolf_vs_Grassland-v0_2"}


def test_a_co_training_can_be_trained_on(tmp_path, both):
    words = ["--algo", "co_training", "-i", str(both.last_model), "-n", "40", "--verbose", "0", "-f", str(tmp_path)]
    assert train.main([*words, "--eval-freq", "-1"]) == 0
    model = CoTraining.load(folder_of(tmp_path).last_model)
    assert (model.num_timesteps, model.learners["sheep"].gamma) == (160, 0.9)


@pytest.mark.parametrize(
    ("words", "learners", "players"),
    [
        (["wolf", "sheep=graze"], {"wolf": None}, {"sheep": "graze"}),
        (["wolf=maddpg", "sheep=per_maddpg"], {"wolf": "maddpg", "sheep": "per_maddpg"}, {}),
        (["wolf", "sheep=graze,flee"], {"wolf": None}, {"sheep": ["graze", "flee"]}),
        (None, {}, {}),
    ],
)
def test_the_words_of_teams(words, learners, players):
    teams = parse_teams(words)
    assert (teams.learners, teams.players) == (learners, players)


@pytest.mark.parametrize(
    ("player", "name"),
    [("graze", "graze"), ("graze,flee", "graze+flee"), ("logs/run_1/my model.zip", "my-model"), ("logs/run_1/", "run_1")],
)
def test_the_labels_of_players(player, name):
    assert label(player) == name


# ---- refusals

REFUSED = [
    ("--team wolf=maddpg wolf=per_maddpg", "--team says twice who plays wolf"),
    ("--team wolf=maddpg wolf=chase", "--team says twice who plays wolf"),
    ("--team sheep=graze", "no team learns: sheep is played by graze, and the algorithms are maddpg"),
    ("--team =maddpg", '--team takes GROUP=ALGORITHM or GROUP=PLAYER, such as sheep=graze; got "=maddpg"'),
    ("--team wolf=", '--team takes GROUP=ALGORITHM or GROUP=PLAYER, such as sheep=graze; got "wolf="'),
    ("--team wulf=maddpg sheep=graze", 'unknown group or scalar reward "wulf"; did you mean "wolf"?'),
    ("--team wolf=maddpg goat=maddpg", "unknown group 'goat'; this world has wolf, sheep"),
    ("--team wolf=maddpg", "nobody plays sheep: add it to --team, such as sheep=random"),
    ("--team wolf=foo", "no team learns: wolf is played by foo, and the algorithms are maddpg, per_maddpg, kfcv_maddpg"),
    ("--team wolf=maddpg sheep=graze -params pool_share:0.5", "pool_share is for teams that learn against each other"),
    ("--team wolf=maddpg goat=graze", "unknown group 'goat'; this world has wolf, sheep"),
    ("--team wolf=maddpg sheep=graz", 'unknown scripted policy of \'sheep\' "graz"; did you mean "graze"?'),
    ("--team wolf=maddpg sheep=madpg", "unknown scripted policy of 'sheep' \"madpg\""),
    ("--team wolf=maddpg sheep=graze,graz", 'did you mean "graze"?'),
    ("--team wolf=maddpg sheep=none.zip", "there is no file none.zip to take a player of"),
    ("--team wolf=maddpg sheep=zoo/", "zoo is no folder of a run of zoo/train.py"),
    ("--team wolf=maddpg sheep=setup.py.zip", "there is no file setup.py.zip to take a player of"),
    ("--team wolf=maddpg sheep=./setup.py", "setup.py is no sb3-kfcv file"),
    ("--team wolf=maddpg sheep=MODEL --env-kwargs n_wolves:3 n_sheep:2", "is for another world: 2 wolf"),
    ("--team sheep=maddpg wolf=MODEL --env-kwargs n_wolves:2 n_sheep:2 n_grass:1", "plays sheep; wanted is a player of wolf"),
    ("--team wolf=maddpg sheep=DAMAGED", "damaged.zip"),
    ("--algo co_training", "--algo co_training needs teams, such as --team wolf=kfcv_maddpg sheep=maddpg"),
    ("--env HardSpread-v0 --team wolf=maddpg", 'unknown group or scalar reward "wolf"; known: agent'),
    ("--env HardSpread-v0 --team agent=maddpg wall=maddpg", "unknown group 'wall'; this world has agent"),
    ("--env HardSpread-v0 --team agent=maddpg wall=random", "unknown group 'wall'; this world has agent"),
    ("--yardstick sheep=graze", "--yardstick measures a team; say which one learns with --team"),
    ("--team wolf=maddpg sheep=graze --yardstick sheep", '--yardstick takes GROUP=PLAYER, such as sheep=graze; got "sheep"'),
    ("--team wolf=maddpg sheep=graze --yardstick goat=graze", 'unknown group "goat"'),
    ("--team wolf=maddpg sheep=graze --yardstick sheep=graz", 'did you mean "graze"?'),
    ("--team wolf=maddpg sheep=graze --yardstick sheep=none.zip", "there is no file none.zip to take a player of"),
    ("--team wolf=maddpg sheep=graze --player-freq 0", "--player-freq is 0; it must be at least 1, or -1"),
    ("--player-freq -5", "--player-freq is -5; it must be at least 1, or -1"),
    ("--team wolf=maddpg sheep=maddpg -params goat.gamma:0.9", 'unknown team "goat"; known: sheep, wolf'),
    ("--team wolf=maddpg sheep=maddpg -params wolf.gama:0.9", 'unknown hyperparameter of wolf, "gama"; did you mean "gamma"?'),
    ("--team wolf=maddpg sheep=maddpg -params gama:0.9", 'unknown hyperparameter of wolf, "gama"; did you mean "gamma"?'),
    ("--team wolf=maddpg sheep=maddpg -params wolf.gamma:high", "gamma is 'high'; it must be a number"),
    ("--team wolf=maddpg sheep=maddpg -params wolf:3", "hyperparameter teams: wolf is 3; it must be a map with an algo"),
    ("--team wolf=maddpg sheep=maddpg -params wolf.train_freq:2", "train_freq must be the same for all teams"),
    ("--team wolf=maddpg sheep=maddpg -params wolf.team:sheep", 'unknown hyperparameter of wolf, "team"'),
    ("--team wolf=maddpg sheep=maddpg -params pool_share:2", "pool_share must be at least 0 and at most 1, got 2"),
    ("--team wolf=maddpg sheep=maddpg -params pool_sampling:wins", 'unknown pool_sampling "wins"; did you mean "win_rate"?'),
    ("--team wolf=maddpg sheep=maddpg -params normalize:true", "teams do not learn under VecNormalize"),
    ("--team wolf=maddpg sheep=graze -params normalize:true", "team= does not work under VecNormalize"),
    ("--team wolf=maddpg sheep=maddpg --opponents sheep:flee", "opponents were given for ['sheep']"),
]


@pytest.mark.parametrize(("words", "sentence"), REFUSED, ids=[words for words, _ in REFUSED])
def test_bad_teams_get_one_sentence_and_leave_nothing(tmp_path, capsys, sheep, words, sentence):
    (tmp_path / "damaged.zip").write_bytes(sheep.read_bytes()[:-100])
    words = words.replace("MODEL", str(sheep)).replace("DAMAGED", str(tmp_path / "damaged.zip"))
    assert train.main(["-f", str(tmp_path / "logs"), *words.split()]) == 2
    printed = capsys.readouterr().err
    assert sentence in printed
    assert printed.startswith("error: ") and printed.count("\n") == 1
    assert not (tmp_path / "logs").exists()


# ---- what goes on

SETTINGS = {
    "teams": [*BOTH, "-params", "pool_share:0.5", "pool_freq:30"],
    "mixture": ["--team", "wolf=kfcv_maddpg", "sheep=OTHER,random", "-params", *TINY_KFCV],
}


@pytest.mark.parametrize("setting", SETTINGS)
def test_a_killed_run_of_teams_goes_on_without_the_files_of_others(tmp_path, sheep, setting):
    """Opponents and yardsticks are those of the beginning, although their files change or are lost."""
    words = [word.replace("OTHER", str(tmp_path / "other.zip")) for word in SETTINGS[setting]]
    words += ["--eval-freq", "40"]  # before the first checkpoint: worlds take their seeds at their first reset
    settings = {"yardsticks": (f"sheep={tmp_path / 'yard.zip'},graze", "wolf=random")}
    algo = "co_training" if setting == "teams" else "kfcv_maddpg"
    for name in ("other.zip", "yard.zip"):
        shutil.copy(sheep, tmp_path / name)
    assert train.main(command(tmp_path / "whole", *words, **settings), [KillAt(NEVER)]) == 0
    with killed():
        train.main(command(tmp_path / "cut", *words, **settings), [KillAt(50)])
    whole, cut = (folder_of(tmp_path / name, algo) for name in ("whole", "cut"))
    model = MADDPG.load(sheep)
    model.policy.load_state_dict({name: 0 * values for name, values in model.policy.state_dict().items()})
    for name in ("other.zip", "yard.zip"):
        model.save(tmp_path / name)
    with killed():
        resume(cut, [KillAt(90)])
    for name in ("other.zip", "yard.zip"):
        (tmp_path / name).unlink()
    assert resume(cut, [KillAt(NEVER)]) == 0
    assert_equal_team_runs(whole, cut)


def test_a_run_without_a_checkpoint_begins_again_only_with_its_files(tmp_path, capsys, sheep):
    shutil.copy(sheep, tmp_path / "other.zip")
    with killed():
        train.main(command(tmp_path, "--team", "wolf=maddpg", f"sheep={tmp_path / 'other.zip'}"), [KillAt(20)])
    (tmp_path / "other.zip").unlink()
    assert resume(folder_of(tmp_path, "maddpg")) == 2
    assert f"there is no file {tmp_path / 'other.zip'} to take a player of" in capsys.readouterr().err


def kill_and_go_on(tmp_path, words, algo, steps, kills, seed):
    """A run that was killed at random moments equals the one that was not."""
    words = [*words, "--save-freq", "8"]
    runs = {name: command(tmp_path / name, *words, steps=steps) for name in ("whole", "cut")}
    assert train.main(runs["whole"]) == 0
    killer = Killer(tmp_path / "cut", runs["cut"], seed, start_up=3, steps=0.8 * steps / kills)
    moments = killer.rng.choice(["training", "writing"], size=kills)
    assert all(killer.kill(when) for when in moments)
    finished = start(*killer.next_words())
    wait_until(finished, lambda: has_begun(finished, tmp_path / "cut"))
    assert finished.wait() == 0
    whole, cut = (folder_of(tmp_path / name, algo) for name in ("whole", "cut"))
    assert_equal_team_runs(whole, cut)
    assert list(checkpoints_in(whole.path)) == list(checkpoints_in(cut.path))
    assert not list(cut.path.rglob(".*.partial"))
    print(killer.counts)


@pytest.mark.expensive
def test_a_process_of_two_teams_that_is_killed_goes_on_exactly(tmp_path):
    kill_and_go_on(tmp_path, SETTINGS["teams"], "co_training", steps=400, kills=1, seed=0)


@pytest.mark.expensive
@pytest.mark.parametrize("algos", [("kfcv_maddpg", "per_maddpg"), ("per_maddpg", "maddpg")], ids="-".join)
def test_twelve_kills_at_random_moments_change_nothing(tmp_path, algos):
    pools = ["pool_share:0.4", "pool_freq:100", "pool_size:3", "pool_sampling:win_rate"]
    words = ["--team", f"wolf={algos[0]}", f"sheep={algos[1]}", "-params", *pools, "buffer_size:500"]
    kill_and_go_on(tmp_path, words, "co_training", steps=2000, kills=12, seed=len(algos[0]))


def test_the_best_model_of_a_team_is_that_of_its_own_return(sheep):
    """Grassland's own reward is the wolves'; where the sheep learn, it is theirs."""
    evaluations = np.load(sheep.parent / "evaluations.npz")
    np.testing.assert_allclose(evaluations["results"], evaluations["return_sheep"], rtol=1e-5)


def test_a_yardstick_counts_what_its_team_gets(both):
    measured = np.load(both.path / "evaluations_sheep_vs_random.npz")
    np.testing.assert_array_equal(measured["results"], measured["return_sheep"])


def test_one_team_of_a_co_training_is_trained_on_alone(tmp_path, both):
    words = ["-f", str(tmp_path), "-i", str(both.path / "best_sheep.zip"), "-n", "40", "--eval-freq", "-1", "--verbose", "0"]
    assert train.main([*words, "--env-kwargs", *SMALL["Grassland-v0"], "--team", "sheep", "wolf=chase"]) == 0
    (config,) = tmp_path.glob("*/*/*/config.yml")
    settings = yaml.safe_load(config.read_text())
    assert (config.parts[-4], settings["team"], settings["gamma"]) == ("per_maddpg", "sheep", 0.9)


def test_a_learner_of_a_co_training_knows_its_age(both):
    """What an evaluation saves has counted the step that it comes after."""
    assert PERMADDPG.load(both.path / "best_sheep.zip").num_timesteps in (60, 120)
