"""The match script, run in-process: what it finds, plays, writes, refuses."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from sb3_kfcv import MADDPG, make_vec_env
from zoo import match, train

WORLD = ["n_wolves:2", "n_sheep:2", "n_grass:1", "max_steps:5"]
PARAMS = ["n_envs:2", "learning_starts:20", "batch_size:8", "buffer_size:200"]


def train_run(folder, *more):
    words = ["--algo", "maddpg", "-n", "80", "--seed", "1", "-f", str(folder), "--verbose", "0", "--eval-freq", "40"]
    words += ["--eval-episodes", "2", "--save-freq", "40", "-params", *PARAMS, "--env-kwargs", *WORLD, *more]
    assert train.main(words) == 0


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of all agents, with checkpoints after 40 and 80 env steps; and one of wolves alone, with saved players."""
    folder = tmp_path_factory.mktemp("logs")
    train_run(folder)
    train_run(folder)
    train_run(folder, "--team", "wolf", "--opponents", "sheep:graze", "--player-freq", "20")
    return folder / "maddpg"


def play(out, *words, n=6, status=0):
    assert match.main([*words, "-n", str(n), "--env-kwargs", *WORLD, "-o", str(out)]) == status
    return json.loads((out / "match.json").read_text()) if (out / "match.json").exists() else None


def test_everybody_meets_everybody(tmp_path, runs, capsys):
    results = play(tmp_path, "--team", f"wolf={runs / 'Grassland-v0_1'}", "wolf=chase", "--team", "sheep=graze", "sheep=flee")
    assert {path.name for path in tmp_path.iterdir()} == {"match.json", "match.md", "match.npz", "match.png"}
    pairs = [(one["wolf"], one["sheep"]) for one in results["matches"]]
    assert pairs == [(wolf, sheep) for wolf in ("maddpg_1", "chase") for sheep in ("graze", "flee")]
    assert results["players"]["wolf"]["maddpg_1"].endswith("maddpg/Grassland-v0_1/Grassland-v0.zip")
    assert (results["metric"], results["seed"], results["n_episodes"]) == ("won_wolf", 0, 6)
    assert "zoo/match.py --team" in results["command"] and "torch" in results["versions"]

    with np.load(tmp_path / "match.npz", allow_pickle=False) as episodes:
        assert episodes["seeds"].tolist() == list(range(6))
        assert episodes["sheep_eaten"].shape == (2, 2, 6)
        assert results["matches"][3]["return_wolf"]["mean"] == pytest.approx(episodes["return_wolf"][1, 1].mean())
    printed, written = capsys.readouterr().out, (tmp_path / "match.md").read_text()
    for text in (printed, written):
        assert "maddpg_1" in text and "share in equilibrium" in text and "Elo" in text
    assert "## sheep_eaten" in written
    assert Image.open(tmp_path / "match.png").size[0] > 500


def test_the_world_is_that_of_the_runs(tmp_path, runs):
    players = ["--team", f"wolf={runs / 'Grassland-v0_1'}", "--team", "sheep=graze"]
    told = play(tmp_path / "told", *players)
    assert match.main([*players, "-n", "6", "-o", str(tmp_path / "found")]) == 0
    found = json.loads((tmp_path / "found" / "match.json").read_text())
    assert found["matches"] == told["matches"] and found["env_kwargs"] == told["env_kwargs"]
    assert (found["env"], found["env_kwargs"]["n_wolves"]) == ("Grassland-v0", 2)


def test_results_do_not_depend_on_the_number_of_worlds(tmp_path, runs):
    words = ["--team", f"wolf={runs / 'Grassland-v0_1'}", "wolf=random", "--team", f"sheep={runs / 'Grassland-v0_2'}"]
    one, many = (play(tmp_path / n, *words, "--n-envs", n) for n in ("1", "64"))
    assert one["matches"] == many["matches"]
    assert one["ratings"] == many["ratings"]


def test_patterns_checkpoints_and_best_models_are_found(tmp_path, runs):
    run = runs / "Grassland-v0_1"
    best = play(tmp_path, "--load-best", "--team", f"sheep={run}", "wolf=chase")
    assert list(best["players"]["sheep"]) == ["maddpg_1 best"]
    assert (best["rows"], best["metric"]) == ("sheep", "won_sheep")

    below = play(tmp_path, "--team", f"wolf={runs}", "sheep=graze")
    assert {"maddpg_1", "maddpg_2"} <= {*below["players"]["wolf"]}

    found = play(tmp_path, "--team", f"wolf={runs / '*_[12]'}", f"wolf={run / 'rl_model_*.zip'}", "sheep=graze,flee")
    assert list(found["players"]["wolf"]) == ["maddpg_1", "maddpg_2", "maddpg_1@40", "maddpg_1@80"]
    assert list(found["players"]["sheep"]) == ["graze+flee"]

    saved = play(tmp_path, "--team", f"wolf={runs / 'Grassland-v0_3' / 'players' / '*'}", "sheep=graze")
    assert list(saved["players"]["wolf"]) == [f"maddpg_3@{steps}" for steps in (0, 20, 40, 60, 80)]


def test_files_of_one_name_are_told_apart(tmp_path, runs):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        shutil.copy(runs / "Grassland-v0_1" / "best_model.zip", tmp_path / name / "wolves.zip")
    words = [f"wolf={tmp_path / name / 'wolves.zip'}" for name in ("first", "second", "first/../first")]
    assert list(play(tmp_path, "--team", *words)["players"]["wolf"]) == ["first/wolves.zip", "second/wolves.zip"]


def test_a_run_that_has_not_ended_plays_by_its_latest_checkpoint(tmp_path, runs):
    run = shutil.copytree(runs / "Grassland-v0_1", tmp_path / "maddpg" / "Grassland-v0_1")
    (run / "Grassland-v0.zip").unlink()
    results = play(tmp_path, "--team", f"wolf={run}", "sheep=graze")
    assert list(results["players"]["wolf"]) == ["maddpg_1@80"]


def test_who_is_not_named_is_every_scripted_policy(tmp_path):
    results = play(tmp_path, "--metric", "sheep_eaten")
    assert {group: list(own) for group, own in results["players"].items()} == {
        "wolf": ["random", "chase"],
        "sheep": ["random", "flee", "graze"],
    }
    assert results["metric"] == "sheep_eaten"


def test_win_rates_over_training(tmp_path, runs, capsys):
    words = ["--curve", str(runs / "Grassland-v0_1"), "--curve", str(runs / "Grassland-v0_3"), "--against", "sheep=graze"]
    assert play(tmp_path, *words) is None  # no table was asked for
    assert {path.name for path in tmp_path.iterdir()} == {"curve.json", "curve.png"}
    results = json.loads((tmp_path / "curve.json").read_text())
    assert (results["group"], results["against"], results["metric"]) == ("wolf", "sheep=graze", "won_wolf")
    curves = results["curves"]
    assert {label: own["steps"] for label, own in curves.items()} == {"maddpg_1": [40, 80], "maddpg_3": [0, 20, 40, 60, 80]}
    assert "maddpg_3: wolf against sheep=graze" in capsys.readouterr().out

    last = play(tmp_path, "--team", f"wolf={runs / 'Grassland-v0_3'}", "sheep=graze")
    assert last["matches"][0]["won_wolf"] == curves["maddpg_3"]["intervals"][-1]


def test_the_last_model_and_the_last_player_are_the_same(tmp_path, runs):
    run = runs / "Grassland-v0_3"
    results = play(tmp_path, "--team", f"wolf={run}", f"wolf={run / 'players' / 'wolf_80_steps.zip'}", "sheep=flee")
    model, player = results["matches"]
    assert {**model, "wolf": ""} == {**player, "wolf": ""}


def test_each_team_of_a_co_training_plays_for_its_group(tmp_path):
    train_run(tmp_path, "--team", "wolf=maddpg", "--team", "sheep=per_maddpg", "--player-freq", "40")
    (run,) = tmp_path.glob("*/Grassland-v0_1")
    last = [f"{group}={run / 'players' / f'{group}_80_steps.zip'}" for group in ("wolf", "sheep")]
    from_run = play(tmp_path / "a", "--team", f"wolf={run}", f"sheep={run}")["matches"]
    from_players = play(tmp_path / "b", "--team", *last)["matches"]
    assert [{**one, "wolf": "", "sheep": ""} for one in from_run] == [{**one, "wolf": "", "sheep": ""} for one in from_players]


REFUSED = [
    ("--env Graslnd-v0", 'unknown environment "Graslnd-v0"; did you mean "Grassland-v0"?'),
    ("--env HardSpread-v0", "HardSpread-v0 has one group, agent; a match is between two"),
    ("--tam wolf=chase", 'unknown flag "--tam"; did you mean "--team"?'),
    ("--team wolf", '--team takes GROUP=PLAYER, such as wolf=random; got "wolf"'),
    ("--team wolves=chase", 'unknown group "wolves"; did you mean "wolf"?'),
    ("--team wolf=chaise", 'unknown scripted policy of \'wolf\' "chaise"; did you mean "chase"?'),
    ("--team wolf=nowhere.zip", "there is no file nowhere.zip to take a player of"),
    ("--team wolf=no*.zip", 'no file and no folder matches "no*.zip"'),
    ("--team wolf={runs}/nothing/", "there is no file {runs}/nothing/ to take a player of"),
    ("--team wolf={tmp}/damaged.zip", "damaged"),
    ("--team wolf={tmp}/other.zip", "is for another world: 1 wolf"),
    ("--team sheep={runs}/Grassland-v0_3", "plays wolf; wanted is a player of sheep"),
    ("--load-best --team wolf={tmp}/begun/Grassland-v0_1", "has no best_wolf.zip and no best_model.zip yet"),
    ("--team wolf={tmp}/begun/Grassland-v0_1", "has no model and no checkpoint yet"),
    ("--curve {tmp}/begun/Grassland-v0_1 --against sheep=graze", "has no checkpoint and no saved player of wolf yet"),
    ("--metric won_wolves", 'unknown metric "won_wolves"; did you mean "won_wolf"?'),
    ("--curve {runs}/Grassland-v0_1", "--curve RUN_DIR and --against GROUP=PLAYER go together"),
    ("--against sheep=graze", "--curve RUN_DIR and --against GROUP=PLAYER go together"),
    ("--curve {runs}/Grassland-v0_9 --against sheep=graze", 'unknown run folder "{runs}/Grassland-v0_9"; did you mean'),
    ("--curve {runs}/Grassland-v0_1 --against {runs}", '--against takes GROUP=PLAYER, such as wolf=random; got "{runs}"'),
    ("--curve {runs}/Grassland-v0_1 --against sheep={runs}/*_[12]", "means 2 players; give one"),
    ("-n 0", "-n must be a whole number of at least 1, got 0"),
    ("-n many", '"many" is no whole number'),
    ("--seed -1", "--seed must be a whole number of at least 0, got -1"),
    ("--env-kwargs n_wolfs:2", 'unknown setting of Grassland-v0 "n_wolfs"; did you mean "n_wolves"?'),
    ("-o {tmp}/damaged.zip", "File exists"),
]


@pytest.fixture(scope="module")
def bad(tmp_path_factory, runs):
    """A damaged model, one of another world, and a run that has nothing yet."""
    folder = tmp_path_factory.mktemp("bad")
    content = bytearray((runs / "Grassland-v0_1" / "Grassland-v0.zip").read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "damaged.zip").write_bytes(content)
    other = make_vec_env("Grassland-v0", env_kwargs={"n_wolves": 1, "n_sheep": 1})
    MADDPG("MlpPolicy", other, buffer_size=100, learning_starts=1, batch_size=2).save(folder / "other.zip")
    shutil.copytree(runs / "Grassland-v0_1" / "Grassland-v0", folder / "begun" / "Grassland-v0_1" / "Grassland-v0")
    return folder


@pytest.mark.parametrize(("words", "message"), REFUSED, ids=[words for words, _ in REFUSED])
def test_refused_in_one_sentence_before_anything_is_played(tmp_path, runs, bad, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(match.Arena, "play", None)
    given = words.format(runs=runs, tmp=bad).split()
    own = ["--env-kwargs", *WORLD] if "Grassland-v0" in words or "--env" not in words else []
    assert match.main([*own, *given]) == 2
    error = capsys.readouterr().err
    assert message.format(runs=runs, tmp=bad) in error
    assert error.startswith("error: ") and error.count("\n") == 1
    assert not list(tmp_path.rglob("*"))


def test_who_plays_a_further_group_is_one(capsys, tmp_path):
    """In a world of three groups, two make the table."""
    world = ["--env", "mpe2/simple_world_comm_v3", "--env-kwargs", "max_cycles:3"]
    words = [*world, "-n", "3", "-o", str(tmp_path), "--team", "adversary=random", "agent=random"]
    assert match.main([*words, "leadadversary=random", "leadadversary=random,random"]) == 2
    assert (
        "adversary and agent make the table; give leadadversary one player, not random, random+random"
        in capsys.readouterr().err
    )
    assert match.main(words) == 0
    results = json.loads((tmp_path / "match.json").read_text())
    assert (results["rows"], results["columns"], results["metric"]) == ("adversary", "agent", "return_adversary")
    assert results["players"]["leadadversary"] == {"random": "random"}
    assert "elo" not in results["ratings"]["agent"][0]
