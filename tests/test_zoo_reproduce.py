"""
The reproduction: what the command trains and refuses, that nothing is measured twice and a killed run leaves the same record,
and that tables, verdicts and pictures say what the records hold.
"""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from test_zoo import ROOT

from sb3_kfcv.common.evaluation import Interval
from sb3_kfcv.matches.arena import BLOCK
from zoo import pages, reproduce, reproduce_report, reproduce_run, train
from zoo.reproduce_plan import EXPERIMENTS, OF_THE_CURRICULUM, Claim, Experiment, planned, read_experiments
from zoo.reproduce_records import is_there, read_record
from zoo.reproduce_report import CANNOT_BE_TOLD, HOLDS, HOLDS_NOT, NOT_A_NUMBER, Results, judged
from zoo.reproduce_run import as_trained
from zoo.series import Series, tensorboard_series
from zoo.statistics import difference_with_interval, smallest_difference

SMALL = {"n_envs": 2, "learning_starts": 20, "batch_size": 8, "buffer_size": 200}
TINY = {
    "experiments": {
        "spread": {
            "title": "Tiny",
            "targets": ["table2"],
            "sweeps": [
                {
                    "algos": ["maddpg", "kfcv_maddpg"],
                    "envs": ["HardSpread-v0"],
                    "settings": {"": SMALL},
                    "train": {
                        "n-timesteps": 400,
                        "save-freq": 40,
                        "env-kwargs": {"n_agents": 2, "walls": "none", "max_steps": 5},
                    },
                }
            ],
            "scripted": [{"agent": "random"}],
            "columns": {"collisions": "test/own/collisions", "return": {"weights": {"test/own/return_agent": 6}, "plus": -75}},
            "better": {"collisions": "lower"},
            "source": "paper",
            "published": {"kfcv_maddpg": {"collisions": 0.687}},
            "pictures": {
                "fig6": [
                    {"title": "cover rate", "curve": "curve/eval/cover_rate"},
                    {"title": "returns", "scatter": "test/own/return_agent"},
                    {"title": "collisions", "estimates": "test/own/collisions"},
                ]
            },
        }
    },
    "claims": [
        {
            "says": "fewer collisions",
            "experiment": "spread",
            "quantity": "test/own/collisions",
            "lower": "kfcv_maddpg",
            "than": "maddpg",
        }
    ],
}


def changed(**changes):
    """The tiny experiment with other keys, and no claim; nothing is said of columns that it has no more."""
    about_columns = {"better": {}, "published": {}} if "columns" in changes else {}
    return {"experiments": {"spread": {**TINY["experiments"]["spread"], **about_columns, **changes}}}


def write(folder, given=TINY):
    file = folder / "experiments.yml"
    file.write_text(yaml.safe_dump(given))
    return file


def command(folder, *words, target="table2"):
    places = ["-conf", str(folder / "experiments.yml"), "-f", str(folder / "runs"), "-o", str(folder / "docs")]
    targets = [target] if target else []
    return [*targets, *places, "--scale", "0.5", "--seeds", "1", "--test-episodes", "40", "--local", *words]


def wanted(folder, n_test_episodes=40, scale=0.5, n_seeds=1):
    (experiment,) = read_experiments(folder / "experiments.yml")[0].values()
    return planned(experiment, scale, folder / "runs", reproduce.records_folder(folder / "docs"), n_seeds, n_test_episodes)


def report(folder, *words):
    return ["--report", "-conf", str(folder / "experiments.yml"), "-o", str(folder / "docs"), *words]


def without_clocks(record):
    """What must be the same whenever and however often it is measured."""
    curve = {name: {key: own for key, own in values.items() if key != "seconds"} for name, values in record["curve"].items()}
    return {**{name: record[name] for name in ("identity", "test")}, "curve": curve}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two runs, one in this process and one by the command, their records, and the page."""
    folder = tmp_path_factory.mktemp("made")
    write(folder)
    first, second = wanted(folder)
    assert reproduce_run.main([str(first.begin(keep_runs=False))]) == 0
    assert first.path.exists() and not second.path.exists()
    assert reproduce.main(command(folder)) == 0
    return folder


# ---- the whole


def test_every_run_leaves_a_record_and_the_page_says_what_they_hold(made):
    _, second = wanted(made)
    record = read_record(second.path)
    assert record["identity"] == second.identity
    assert record["identity"]["settings"]["n_timesteps"] == 200  # half of 400
    assert record["test"]["after"] == 190  # 95 %
    curve = record["curve"]["eval"]
    assert len(curve["steps"]) == len(curve["cover_rate"]) == 40
    assert (curve["steps"][-1], curve["episodes"][-1]) == (200, 40)
    own = record["test"]["tests"]["own"]
    returns = own["returns"]["return_agent"]
    assert len(returns) == 40
    assert own["mean"]["return_agent"] == pytest.approx(np.mean(returns), rel=1e-3)
    assert own["standard_error"]["return_agent"] == pytest.approx(np.std(returns, ddof=1) / np.sqrt(40), rel=1e-3)
    assert own["quantiles"]["return_agent"][2] == pytest.approx(np.median(returns), rel=1e-3)
    assert record["taken"]["wall"] > 0 and record["taken"]["memory"] > 1e7
    assert record["command"].startswith("python zoo/train.py --algo kfcv_maddpg")

    page = (made / "docs" / "reproduction.md").read_text()
    (ours,) = [line.split(" | ") for line in page.splitlines() if line.startswith("| KFCV-MADDPG |")]
    assert float(ours[1]) == pytest.approx(own["mean"]["collisions"], abs=5e-3)
    assert float(ours[2]) == pytest.approx(6 * own["mean"]["return_agent"] - 75, abs=5e-3)
    assert "| · paper | 0.687 |" in page and "| `random` |" in page
    assert "| fewer collisions |" in page and CANNOT_BE_TOLD in page
    assert "](images/reproduce_fig6.png)" in page
    assert (made / "docs" / "images" / "reproduce_fig6.png").stat().st_size > 10_000


def test_what_is_large_goes_when_the_record_is_there(made):
    for own in wanted(made):
        folder = own.run.place.run().folder
        assert folder.last_model.is_file() and folder.config_file.is_file()
        assert not [*folder.path.glob("rl_model_*")] and not folder.monitor_file.exists()


def test_a_run_that_has_its_record_is_never_run_again(made, capsys, monkeypatch):
    monkeypatch.setattr(reproduce, "make_workers", None)  # cannot be called
    before = {own.path: own.path.read_bytes() for own in wanted(made)}
    assert reproduce.main(command(made)) == 0
    assert {path: path.read_bytes() for path in before} == before
    capsys.readouterr()
    assert reproduce.main(command(made, "--dry-run")) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[0] == "done   spread maddpg seed 0, 200 env steps"
    assert out.splitlines()[-1] == "2 runs: 0 to begin, 0 to go on with, 2 done"
    assert reproduce.main(command(made, "--dry-run", "--seeds", "2")) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[2].startswith("begin  spread maddpg seed 1, 200 env steps, about 0:00:")
    assert out[-2] == "4 runs: 2 to begin, 0 to go on with, 2 done" and out[-1].startswith("about 0:00:")
    assert reproduce.main(command(made, "--dry-run", "--scale", "1", "--cells", "maddpg")) == 0
    out = capsys.readouterr().out.splitlines()  # by the records of the other scale
    assert out[0].startswith("begin  spread maddpg seed 0, 400 env steps, about 0:00:")
    assert out[1] == "1 run: 1 to begin, 0 to go on with, 0 done"


def test_the_page_is_made_of_the_records_alone(made):
    page = made / "docs" / "reproduction.md"
    before = page.read_text()
    page.write_text(f"words by hand\n\n{before}")
    assert reproduce.main(report(made)) == 0
    assert page.read_text() == f"words by hand\n\n{before}"


def test_a_killed_run_goes_on_to_the_same_record(made, tmp_path, monkeypatch, capsys):
    """Killed once before and once after the test."""
    write(tmp_path)
    _, own = wanted(tmp_path)
    order = str(own.begin(keep_runs=False))
    original, moments = train.main, [130, 196]

    class Kill(train.BaseCallback):
        def _on_step(self):
            if moments and self.num_timesteps >= moments[0]:
                moments.pop(0)
                raise RuntimeError
            return True

        def get_state(self):
            return {}

        def set_state(self, saved):
            pass

    monkeypatch.setattr(train, "main", lambda words, callbacks: original(words, [*callbacks, Kill()]))
    for _ in range(2):
        with pytest.raises(RuntimeError):
            reproduce_run.main([order])
        assert not own.path.exists()
    assert reproduce_run.main([order]) == 0
    assert without_clocks(read_record(own.path)) == without_clocks(read_record(wanted(made)[1].path))
    assert reproduce_run.main([order]) == 0  # nothing is left to do


def test_the_test_is_not_played_again_from_a_checkpoint_behind_it(tmp_path):
    measure = reproduce_run.Measure(None, {"own": {}}, 2, tmp_path / "measured.json")
    taken = {"wall": 5.0, "processor": 4.0, "memory": 7e12}
    measure.set_state({"of": {"tests": {"own": {}}, "test_episodes": 2}, "test": {"after": 190}, "taken": taken})
    measure.num_timesteps = 200
    assert measure._on_step()  # without a model it could not play
    assert measure.test == {"after": 190}
    taken = measure.taken()
    assert 5.0 <= taken["wall"] < 6.0 and 4.0 <= taken["processor"] < 5.0 and taken["memory"] == 7e12


def test_tests_are_on_episodes_that_no_training_and_no_evaluation_sees():
    seeds, worlds = 1000, 1000
    assert reproduce_run.TEST_SEED > train.EVAL_SEED_OFFSET + seeds + worlds


# ---- what is refused


def test_a_record_of_other_settings_is_refused(made, capsys):
    other = changed()
    other["experiments"]["spread"]["sweeps"] = [
        {**TINY["experiments"]["spread"]["sweeps"][0], "settings": {"": {**SMALL, "gamma": 0.5}}}
    ]
    file = made / "other.yml"
    file.write_text(yaml.safe_dump(other))
    assert reproduce.main(command(made, "-conf", str(file))) == 2
    path = wanted(made)[0].path
    assert capsys.readouterr().err == (
        f"error: the record {path} was measured with settings.gamma 0.99, and is now to have 0.5; choose another scale, or "
        "other settings by another name, or remove the record and its run to measure anew\n"
    )
    assert reproduce.main(command(made, "--test-episodes", "30")) == 2
    assert "was measured with test_episodes 40, and is now to have 30" in capsys.readouterr().err
    (second,) = (own for own in wanted(made, 30, n_seeds=2) if own.cell == "maddpg" and own.run.seed == 1)
    with pytest.raises(ValueError, match=f"the record {path} was measured with test_episodes 40, and is now to have 30"):
        reproduce.check_records([second])  # could not be shown beside the first
    assert reproduce.main(command(made, "--scale", "0.25", "--dry-run")) == 0  # lies apart


def test_a_damaged_record_is_told(made, tmp_path):
    path = tmp_path / "seed_0.json"
    good = wanted(made)[0].path.read_text()

    def with_other(change):
        record = json.loads(good)
        change(record)
        return json.dumps(record)

    for text, sentence in (
        ("{", "cannot be read: "),
        ("[]", "is no record of zoo/reproduce.py"),
        ('{"identity": 3}', "is no record of zoo/reproduce.py"),
        (with_other(lambda record: record.pop("taken")), "seed_0.json is damaged: its taken is missing, or of another type"),
        (
            with_other(lambda record: record["taken"].update(processor=0)),
            "its taken.processor is 0; it must be above 0",
        ),
        (with_other(lambda record: record["identity"].pop("cell")), "is damaged: its identity.cell is missing, or of"),
        (with_other(lambda record: record["test"]["tests"].update(own=[])), "is damaged: its test.tests is missing, or of"),
        (
            with_other(lambda record: record["test"]["tests"]["own"]["mean"].update(collisions="many")),
            "its test.tests.own.mean is",
        ),
        (with_other(lambda record: record["curve"]["eval"]["cover_rate"].pop()), "its curve eval has not one value of every"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=sentence):
            is_there(path, {})


def copied(made, folder):
    """The runs and records of the fixture again, the first with no record, its run to be found at a place of its own."""
    shutil.copytree(made, folder, dirs_exist_ok=True)
    first = wanted(folder)[0]
    first.path.unlink()
    return first


def test_a_lost_record_is_put_back_from_its_run(made, tmp_path, monkeypatch):
    first = copied(made, tmp_path)
    monkeypatch.setattr(reproduce_run.sweep_run, "main", None)  # cannot be called
    assert reproduce.main(command(tmp_path, "--dry-run")) == 0
    assert reproduce_run.main([str(first.begin(keep_runs=False))]) == 0
    assert first.path.read_bytes() == wanted(made)[0].path.read_bytes()


def test_a_run_that_cannot_leave_the_record_any_more_is_refused_before_anything_is_begun(made, tmp_path, capsys):
    first = copied(made, tmp_path)
    folder = first.run.place.run().folder
    for path in [*reproduce.records_folder(tmp_path / "docs").rglob("seed_*.json")]:
        path.unlink()
    assert reproduce.main(command(tmp_path, "--dry-run", "--test-episodes", "30")) == 2
    told = f"the run {folder.path} was measured with test_episodes 40, and is now to have 30; choose another scale, or other "
    assert told in capsys.readouterr().err
    (folder.path / "record.json").unlink()
    assert reproduce.main(command(tmp_path, "--dry-run")) == 2
    assert capsys.readouterr().err == (
        f"error: the run {folder.path} has ended, and its record is gone, as is 0.monitor.csv; "
        "remove this folder, too, to measure anew\n"
    )
    folder.monitor_file.write_text("")  # as if it had been killed before its record was written
    assert reproduce.main(command(tmp_path, "--dry-run", "--test-episodes", "30")) == 2
    assert told in capsys.readouterr().err
    assert not first.path.exists()


def test_a_run_does_not_go_on_with_another_test(tmp_path):
    measure = reproduce_run.Measure(None, {"own": {}}, 3, tmp_path / "measured.json")
    then = {"of": {"tests": {"own": {}}, "test_episodes": 2}, "taken": measure.taken()}
    measure.set_state({**then, "test": None})  # was not played yet
    with pytest.raises(
        ValueError, match=r"this run was measured with test_episodes 2, and is now to have 3; .* remove its folder"
    ):
        measure.set_state({**then, "test": {"after": 190}})


def test_models_of_normalised_observations_normalise_what_they_see_in_the_test(tmp_path, monkeypatch):
    sweep = TINY["experiments"]["spread"]["sweeps"][0]
    write(
        tmp_path,
        changed(published={}, sweeps=[{**sweep, "algos": ["maddpg"], "settings": {"": {**SMALL, "normalize": True}}}]),
    )
    (own,) = wanted(tmp_path)
    models = []
    monkeypatch.setattr(reproduce_run, "as_trained", lambda model: models.append(model) or as_trained(model))
    assert reproduce_run.main([str(own.begin(keep_runs=False))]) == 0
    assert read_record(own.path)["test"]["tests"]["own"]["mean"]["return_agent"] < 0

    (model,) = models
    rows = np.random.default_rng(0).normal(size=(BLOCK, model.observation_space.shape[0])).astype(np.float32)
    seen = model.get_vec_normalize_env().obs_rms
    assert np.ptp(seen.var) > 0.1
    by_hand = np.clip((rows - seen.mean) / np.sqrt(seen.var + 1e-8), -10, 10).astype(np.float32)
    expected = model.predict(by_hand, deterministic=True)[0]
    np.testing.assert_allclose(as_trained(model).predict(rows)[0], expected, atol=1e-6)
    assert not np.allclose(model.predict(rows, deterministic=True)[0], expected, atol=1e-3)


def test_a_training_that_is_too_short_for_an_episode_has_none_in_its_curve(tmp_path):
    write(tmp_path)
    own = wanted(tmp_path, scale=0.02)[0]  # 8 env steps in 2 worlds, and an episode takes 5
    assert reproduce_run.main([str(own.begin(keep_runs=False))]) == 0
    curve = read_record(own.path)["curve"]["eval"]
    assert set(curve["episodes"]) == {0.0} and len(curve["cover_rate"]) == len(curve["steps"])


def test_records_hold_what_the_curriculum_logged_while_it_lasted(made):
    plain, kfcv = wanted(made)
    told = json.loads(kfcv.path.read_text())["curve"]
    during, at = told["curriculum"], told["eval"]["steps"]
    logged = tensorboard_series(kfcv.run.place.run().tensorboard_folder)
    last = logged["curriculum/unscored"].steps[-1]
    assert 0 < last < at[-1] and set(during["steps"]) <= {*at} and during["steps"][-1] >= last
    for name in OF_THE_CURRICULUM:
        series = logged[f"curriculum/{name}"]
        for step, value in zip(during["steps"], during[name], strict=True):
            before = max([0, *(other for other in at if other < step)])
            both = np.isin(series.steps, logged["curriculum/rank_correlation_with_last"].steps) & (series.steps <= last)
            own = series.values[both & (before < series.steps) & (series.steps <= step)]
            assert value == pytest.approx(own.mean(), rel=1e-4, abs=1e-9)
    assert "curriculum" not in json.loads(plain.path.read_text())["curve"]


def test_scripted_policies_play_in_the_world_of_the_runs(made):
    told = json.loads((reproduce.records_folder(made / "docs") / "spread/scripted/40_episodes/random.json").read_text())
    assert told["identity"]["world"]["env_kwargs"] == {"n_agents": 2, "walls": "none", "max_steps": 5}
    assert told["test"]["tests"]["own"]["mean"]["length"] == 5


def test_scripted_records_of_other_tests_lie_apart_and_are_checked_before_anything_is_begun(made, tmp_path, capsys):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    path = reproduce.records_folder(tmp_path / "docs") / "spread" / "scripted" / "40_episodes" / "random.json"
    record = json.loads(path.read_text())
    record["identity"]["test_episodes"] = 50
    path.write_text(json.dumps(record))
    assert reproduce.main(command(tmp_path, "--dry-run")) == 2
    assert f"the record {path} was measured with test_episodes 50, and is now to have 40" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["tabel2"], 'unknown target "tabel2"; did you mean "table2"?'),
        ([], "say what to reproduce: all, spread, table2"),
        (["table2", "--scale", "0"], "--scale is 0.0; it must be above 0 and at most 1"),
        (["table2", "--seeds", "0"], "--seeds must be a whole number of at least 1, got 0"),
        (["table2", "--test-episodes", "1"], "--test-episodes must be a whole number of at least 2, got 1"),
        (["table2", "--cells", "madpg"], "there is no cell madpg among these; there are kfcv_maddpg, maddpg"),
        (["table2", "--report"], "--report writes the whole page, of all records; leave out table2"),
        (["--report", "--seeds", "2", "--dry-run"], "--report writes the whole page, of all records; leave out"),
        (["table2", "--local", "--address", "auto"], "--local goes without Ray, and --address names a Ray cluster"),
    ],
)
def test_bad_words(tmp_path, capsys, words, sentence):
    file = write(tmp_path)
    assert reproduce.main([*words, "-conf", str(file), "-f", str(tmp_path / "runs"), "-o", str(tmp_path / "docs")]) == 2
    assert capsys.readouterr().err.startswith(f"error: {sentence}")
    assert [*tmp_path.iterdir()] == [file]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"titel": "x"}, 'unknown key of the experiment spread "titel"; did you mean "title"?'),
        ({"title": ""}, "the experiment spread lacks title"),
        ({"seeds": 0}, "spread: seeds must be a whole number of at least 1, got 0"),
        (
            {"columns": {"x": "own/collisions"}},
            "spread: a quantity is test/<test>/<metric> or curve/<evaluation>/<metric>, not own/c",
        ),
        ({"columns": {"x": "test/graze/collisions"}}, 'unknown test of spread "graze"; known: own'),
        ({"columns": {"x": "test/own/colisions"}}, 'spread: unknown metric "colisions"; did you mean "collisions"?'),
        ({"published": {"madpg": {}}}, 'unknown cell of spread "madpg"; did you mean "maddpg"?'),
        (
            {"pictures": {"a": [{"title": "a"}]}},
            "spread: a panel needs a title and one of curve, scatter, estimates, rivals, not",
        ),
        ({"pictures": {"a": [{"curve": "curve/eval/cover_rate"}]}}, "spread: a panel needs a title and one of curve, "),
        ({"pictures": {"a": [{"titel": "a"}]}}, 'unknown key of a panel of spread "titel"; did you mean "title"?'),
        ({"pictures": {"a": [{"title": "a", "rivals": "test/own/x"}]}}, "is a rivals of test/own/x; it must be of curve/…"),
        (
            {"pictures": {"a": [{"title": "a", "scatter": "test/own/collisions"}]}},
            "spread: a: of single episodes tests keep return_agent, not test/own/collisions",
        ),
        (
            {"pictures": {"a": [{"title": "a", "curve": "curve/curriculum/teacher_loss_in_fold"}]}},
            'spread: unknown evaluation of maddpg "curriculum"; known: eval',
        ),
        (
            {"pictures": {"a": [{"title": "a", "curve": "curve/curriculum/cover_rate", "cells": ["kfcv_maddpg"]}]}},
            'spread: unknown metric "cover_rate"; known: rank_correlation_with_last',
        ),
        (
            {"pictures": {"a": [{"title": "a", "curve": "curve/evel/cover_rate"}]}},
            'spread: unknown evaluation of maddpg "evel"; did you mean "eval"?',
        ),
        ({"pictures": {"Fig 6": []}}, 'a picture is called "Fig 6"; give it a name of a-z, 0-9, _ and -'),
        ({"tests": {"alone": {"agnt": "random"}}}, 'spread: unknown group "agnt"; did you mean "agent"?'),
        (
            {"scripted": [{"agent": "greedy-nearst"}]},
            'spread: unknown scripted policy of \'agent\' "greedy-nearst"; did you mean "greedy-nearest"?',
        ),
        ({"tests": {"own": {"agent": "random"}}}, "spread: a test is called own, which is the name of the model's own"),
        (
            {"sweeps": [*TINY["experiments"]["spread"]["sweeps"], {"algos": ["per_maddpg"], "envs": ["HardSpread-v0"]}]},
            "spread has scripted policies, and runs of worlds with different settings",
        ),
        ({"columns": {"x": 3}}, 'spread: the column "x" is 3; it must be a quantity, or have weights of some'),
        (
            {"columns": {"x": {"weights": {"test/own/length": 1}, "pluss": 2}}},
            'unknown key of the column "x" of spread "pluss"; did you mean "plus"?',
        ),
        (
            {"columns": {"x": {"weights": {"test/own/length": "much"}}}},
            "key of the column \"x\" of spread weights is {'test/own/length': 'much'}; it must be a map",
        ),
        ({"better": {"colisions": "lower"}}, 'unknown column of spread "colisions"; did you mean "collisions"?'),
        ({"better": {"collisions": "less"}}, 'spread: better: collisions is "less"; it must be lower or higher'),
        ({"published": {"maddpg": {"returns": 1}}}, 'unknown column of spread "returns"; did you mean "return"?'),
        (
            {"sweeps": [{"algos": ["maddpg"], "envs": ["HardSpread-v0", "Grassland-v0"]}], "published": {}, "scripted": []},
            "spread: a sweep has the worlds HardSpread-v0 and Grassland-v0; give each",
        ),
        ({"effects": {"default": "maddpg"}}, "spread: effects needs default and quantity, not"),
        ({"effects": {"defualt": "maddpg"}}, 'unknown key of the effects of spread "defualt"; did you mean "default"?'),
        (
            {"contrasts": [{"says": "a", "of": ["maddpg"], "than": ["per_maddpg"]}]},
            "spread: contrasts are by the quantities of effects, and there are none",
        ),
        ({"contrasts": [{"says": "a", "off": ["maddpg"]}]}, 'unknown key of a contrast of spread "off"; did you mean "of"?'),
        ({"contrasts": [{"says": "a", "of": ["maddpg"]}]}, "spread: a contrast needs says, of and than, not"),
        (
            {"contrasts": [{"says": "a", "of": ["maddpg"], "than": ["maddpg"]}]},
            "spread: the contrast a has maddpg on both sides",
        ),
        (
            {
                "contrasts": [{"says": "a", "of": ["maddpg"], "than": ["mapdg"]}],
                "effects": {"default": "maddpg", "quantity": "test/own/length"},
            },
            'unknown cell of spread "mapdg"; did you mean "maddpg"?',
        ),
        (
            {"sweeps": [{"algos": ["maddpg"], "envs": ["HardSpread-v0"], "train": {"eval-freq": -1}}], "published": {}},
            "spread: maddpg is never evaluated (eval-freq -1), and curve/eval/cover_rate is to be shown",
        ),
        (
            {"effects": {"default": "maddpg", "quantity": "test/own/x", "course": "test/own/x"}},
            "spread: course of effects is test/own/x; it must be of curve/",
        ),
        (
            {"sweeps": [{"algos": ["maddpg"], "envs": ["HardSpread-v0"], "seeds": 3}], "published": {}},
            "spread: seeds of a sweep are not for the file",
        ),
        (
            {"sweeps": [{"algos": ["maddpg"], "envs": ["HardSpred-v0"]}], "published": {}},
            'unknown environment "HardSpred-v0"; did you mean "HardSpread-v0"?',
        ),
        ({"sweeps": 2 * TINY["experiments"]["spread"]["sweeps"]}, "spread: two sweeps have the cell maddpg; give one of them"),
    ],
)
def test_bad_experiments(tmp_path, capsys, changes, sentence):
    file = write(tmp_path, changed(**changes))
    assert reproduce.main(command(tmp_path, "--dry-run")) == 2
    assert sentence in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == [file]


def test_bad_claims(tmp_path):
    good = TINY["claims"][0]
    for changes, sentence in (
        ({"higher": "maddpg"}, "a claim needs says, experiment, quantity, than, and one of higher and lower, not"),
        ({"experiment": "spred"}, 'unknown experiment "spred"; did you mean "spread"?'),
        ({"lower": "kfcv"}, 'unknown cell of spread "kfcv"; did you mean "kfcv_maddpg"?'),
        ({"from": 1.0}, r"from of a claim is 1; it must be at least 0 and below 1 \(fewer collisions\)"),
    ):
        with pytest.raises(ValueError, match=sentence.replace("?", r"\?")):
            read_experiments(write(tmp_path, {**TINY, "claims": [{**good, **changes}]}))


# ---- the paper's experiments


def test_the_papers_experiments_are_what_the_paper_says(tmp_path):
    experiments, claims = read_experiments()
    all_of_them = {name: planned(own, 1.0, tmp_path, tmp_path) for name, own in experiments.items()}
    table_1 = all_of_them["hard_spread"]
    assert {own.cell for own in table_1} == {"maddpg", "per_maddpg", "kfcv_maddpg"}
    for own in table_1:
        settings, env = own.run.hyperparams, own.run.hyperparams.env_kwargs
        assert settings.n_timesteps == 200_000 * env["max_steps"] and env["n_agents"] == 4
        assert (settings.model["buffer_size"], settings.model["gamma"], own.n_test_episodes) == (5000, 0.99, 10_000)
    teams = {own.cell: own.run.hyperparams.model["teams"] for own in all_of_them["grassland"]}
    assert {cell: [theirs["algo"] for theirs in own.values()] for cell, own in teams.items()} == {
        "kfcv_maddpg_against_maddpg": ["kfcv_maddpg", "maddpg"],
        "per_maddpg_against_maddpg": ["per_maddpg", "maddpg"],
        "maddpg_against_maddpg": ["maddpg", "maddpg"],
        "kfcv_maddpg_against_per_maddpg": ["kfcv_maddpg", "per_maddpg"],
    }
    assert {own.run.hyperparams.n_timesteps for own in all_of_them["grassland"]} == {100_000 * 25}
    assert {own.run.hyperparams.n_timesteps for own in planned(experiments["grassland"], 0.1, tmp_path, tmp_path)} == {250_000}
    names = [own.run.name for runs in all_of_them.values() for own in runs]
    assert len(set(names)) == len(names)
    pytest.importorskip("mpe2")
    for name, own in experiments.items():
        reproduce.check_worlds(own, all_of_them[name], [claim for claim in claims if claim.experiment == name])


def test_the_page_has_a_place_for_everything():
    experiments, _ = read_experiments()
    names = [name for _, name, _ in pages.PLACE.findall((ROOT / "docs" / "reproduction.md").read_text())]
    assert sorted(names) == sorted([*experiments, "claims", "runs"])
    assert EXPERIMENTS == ROOT / "hyperparams" / "reproduce.yml"


# ---- what records say


def record(cell, seed, mean=0.0, curve=(0.0,), algo="maddpg", scale=1.0):
    """A record by hand: `x` of its test, and of the evaluations after 10, 20, … env steps."""
    steps = [10 * (i + 1) for i in range(len(curve))]
    about = {"experiment": "e", "cell": cell, "scale": scale, "seed": seed, "algo": algo, "env": "W"}
    test = {"tests": {"own": {}}, "test_episodes": 2}
    return {
        "identity": {**about, **test, "settings": {"n_timesteps": 10 * len(curve)}},
        "command": "",
        "date": "2022-12-06",
        "machine": {"processor": "P", "cores": 2},
        "versions": {"torch": "2"},
        "taken": {"wall": 1.0, "processor": 1.0, "memory": 1e6},
        "test": {"seeds": [7, 8], "tests": {"own": {"mean": {"x": mean}, "returns": {}}}},
        "curve": {"eval": {"steps": steps, "episodes": steps, "x": list(curve)}},
    }


def results(**means):
    cells = {cell: [record(cell, seed, mean) for seed, mean in enumerate(own)] for cell, own in means.items()}
    effects = {"default": "default", "quantity": "test/own/x"}
    experiment = Experiment("e", "E", [{"algos": [*means], "envs": ["W"]}], effects=effects)
    return Results(experiment, 1.0, cells, {})


def test_the_rule_for_a_cell_and_a_number():
    for interval, n_seeds, so in (
        (Interval(0.9, 0.51, 1.0), 5, True),
        (Interval(0.9, 0.51, 1.0), 4, None),
        (Interval(0.9, 0.5, 1.0), 5, None),
        (Interval(0.1, 0.0, 0.49), 5, False),
        (Interval(0.4, 0.1, 0.6), 10, None),
    ):
        assert reproduce_report.above(interval, 0.5, n_seeds) is so


def test_claims_about_two_cells():
    told = results(a=[1, 2, 3, 4, 5], b=[6, 7, 8, 9, 10])
    claim = {"says": "", "experiment": "e", "quantity": "test/own/x"}
    assert judged(Claim(**claim, lower=True, cell="a", than="b"), told).word == HOLDS
    assert judged(Claim(**claim, lower=False, cell="a", than="b"), told).word == HOLDS_NOT
    assert judged(Claim(**claim, lower=False, cell="b", than="a"), told).numbers.endswith("P 1.00 [1.00, 1.00]")
    mixed = judged(Claim(**claim, lower=False, cell="a", than="b"), results(a=[1, 9, 3, 7, 5], b=[6, 2, 8, 4, 5]))
    assert (mixed.word, mixed.n_seeds) == (CANNOT_BE_TOLD, 5)
    missing = judged(Claim(**claim, lower=False, cell="a", than="b"), results(a=[1, 2, 3, 4, 5]))
    assert (missing.word, missing.n_seeds, missing.numbers) == (CANNOT_BE_TOLD, 0, "")


def test_claims_about_a_number_take_the_mean_of_the_late_curve():
    curve = [0.0, 0.2, 0.8, 1.0]  # from half of the training on: after 20, 30 and 40 of 40 env steps, 2/3
    told = Results(Experiment("e", "E", []), 1.0, {"a": [record("a", seed, curve=curve) for seed in range(5)]}, {})
    claim = {"says": "", "experiment": "e", "quantity": "curve/eval/x", "cell": "a", "since": 0.5}
    assert told.values("a", "curve/eval/x", 0.5) == pytest.approx(2 / 3)
    assert judged(Claim(**claim, lower=False, than=0.6), told).word == HOLDS
    assert judged(Claim(**claim, lower=False, than=0.7), told).word == HOLDS_NOT
    assert judged(Claim(**claim, lower=True, than=0.7), told).word == HOLDS


def test_the_page_shows_the_largest_scale_that_a_verdict_can_be_given_of():
    assert reproduce_report.scale_shown({0.1: [5, 6], 1.0: [5, 5]}, 2) == 1.0
    assert reproduce_report.scale_shown({0.1: [5, 6], 1.0: [9, 4]}, 2) == 0.1
    assert reproduce_report.scale_shown({0.1: [10, 10], 0.2: [5, 5], 1.0: [5]}, 2) == 0.2
    assert reproduce_report.scale_shown({0.1: [2, 2], 1.0: [3]}, 2) == 0.1
    assert reproduce_report.scale_shown({0.1: [], 1.0: [1]}, 2) == 1.0
    assert reproduce_report.scale_shown({}, 2) == 0.0


def test_effects_stand_beside_the_default_the_largest_first():
    told = results(default=[1.0, 1.1, 0.9, 1.0, 1.0], small=[1.2, 1.1, 1.3, 1.2, 1.2], large=[0.1, 0.2, 0.0, 0.1, 0.1])
    lines = [line.split(" | ") for line in reproduce_report.effects_table(told).splitlines()[2:]]
    assert [(line[0], line[4]) for line in lines] == [("| MADDPG", ""), ("| MADDPG", "worse"), ("| MADDPG", "better")]
    # the middle three of each: 1.0, 1.2 and 0.1
    assert [float(line[2].split(" [")[0]) for line in lines[1:]] == pytest.approx([-0.9, 0.2])


def contrasted(than, **means):
    told = results(default=[0.0] * 5, **means)
    contrast = {"says": "a and b / the rest", "of": ["a", "b"], "than": than}
    experiment = replace(told.experiment, contrasts=[contrast])
    head, _, line = reproduce_report.contrasts_table(replace(told, experiment=experiment)).splitlines()
    assert head == "|  | difference of x | so | runs | seeds |"
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_contrasts_are_of_means_over_cells_seed_by_seed():
    """What the runs of a seed have in common, here 0, 10, 20, 30 and 40, counts for nothing."""
    a, b, c = [1, 11, 21, 31, 41], [3, 13, 23, 33, 43], [1, 11.1, 20.9, 31, 41]
    # means of a and b less c: 1, 0.9, 1.1, 1, 1: a standard error of 0.0316, times t of 4 degrees of freedom, 2.776
    assert contrasted(["c"], a=a, b=b, c=c) == ["a and b / the rest", "1.000 [0.912, 1.088]", "better", "10 / 5", "5"]
    assert contrasted(["c"], a=a, b=b, c=[8, 8, 8, 8, 8])[1:3] == ["14.00 [-5.63, 33.63]", CANNOT_BE_TOLD]


def test_contrasts_take_seeds_that_all_have():
    assert contrasted(["c"], a=[1, 2, 3], b=[1, 2, 3], c=[2, 3.1, 4, 5])[2:] == [CANNOT_BE_TOLD, "6 / 4", "3"]
    assert contrasted(["d"], a=[1, 2, 3], b=[1, 2, 3])[1:] == ["not a number", CANNOT_BE_TOLD, "6 / 0", "0"]


def test_effects_at_equal_time():
    """The twice as slow cell after half of its training, beside the default at its end: a tenth of the curve up to there."""
    curve = [float(step) for step in range(1, 21)]  # one evaluation per twentieth
    cells = {cell: [record(cell, seed, curve=curve) for seed in range(5)] for cell in ("default", "slow")}
    for own in cells["slow"]:
        own["taken"]["processor"] = 2.0
    effects = {"default": "default", "quantity": "test/own/x", "course": "curve/eval/x"}
    experiment = Experiment("e", "E", [{"algos": [*cells], "envs": ["W"]}], effects=effects)
    head, _, _, line = reproduce_report.effects_table(Results(experiment, 1.0, cells, {})).splitlines()
    headings = ["difference over the training", "so", "time", "difference at equal time"]
    assert [part.strip() for part in head.split("|")[6:10]] == headings
    # evaluations 8 to 10 of 20 beside 18 to 20
    numbers = ["0.00 [0.00, 0.00]", CANNOT_BE_TOLD, "× 2.00", "-10.00 [-10.00, -10.00]"]
    assert [part.strip() for part in line.split("|")[6:10]] == numbers


def test_a_curve_between_two_shares_of_the_training():
    told = record("a", 0, curve=[1.0, 2.0, 3.0, 4.0])  # after 10, 20, 30 and 40 of 40 env steps
    for since, until, mean in ((0, 1, 2.5), (0, 0.5, 1.5), (0.5, 0.75, 2.5), (0.6, 0.74, 3), (0.9, 1, 4)):
        assert reproduce_report.quantity(told, "curve/eval/x", since, until) == mean
    assert np.isnan(reproduce_report.quantity(told, "curve/eval/x", 0.8, 0.5))


def test_the_smallest_difference_by_hand():
    """Two groups of five whose standard deviation is 1: (t 0.975 + t 0.8 of 8 degrees of freedom) · √(2/5)."""
    values = np.array([-1.0, 1.0, -1.0, 1.0, 0.0])
    assert values.std(ddof=1) == 1.0
    assert smallest_difference(values, values + 7) == pytest.approx((2.306004 + 0.888890) * np.sqrt(0.4), rel=1e-5)
    assert np.isnan(smallest_difference(values, values[:1]))


def test_the_smallest_difference_is_shown_that_often():
    """By simulation, beside the t-test of scipy."""
    from scipy.stats import ttest_ind

    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 4000, 5))
    least = smallest_difference(np.array([-1.0, 1.0, -1.0, 1.0, 0.0]), np.array([-1.0, 1.0, -1.0, 1.0, 0.0]))
    assert np.mean(ttest_ind(a + least, b, axis=1).pvalue < 0.05) == pytest.approx(0.8, abs=0.02)


def test_a_difference_has_an_interval_of_both_sides_draws():
    rng = np.random.default_rng(0)
    one = difference_with_interval(np.array([2.0, 2.0, 2.0]), np.array([1.0, 1.0, 1.0]), rng)
    assert tuple(one) == (1.0, 1.0, 1.0)
    wide = difference_with_interval(np.arange(5.0), np.arange(5.0) + 1, rng)
    assert wide.mean == -1.0 and wide.low < -2 and wide.high > 0


ONE = Experiment("e", "E", [{"algos": ["maddpg"], "envs": ["W"]}], scripted=[{"agent": "random"}])


def written(folder, given, path=None):
    """A record, where it belongs or elsewhere."""
    identity = given["identity"]
    if path is None:
        path = ONE.records(folder, identity["scale"]) / identity["cell"] / f"seed_{identity['seed']}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(given))
    return path


def test_records_of_different_scales_never_mix(tmp_path):
    for scale, means in ((0.1, [1.0, 2.0, 3.0]), (0.5, [7.0])):
        for seed, mean in enumerate(means):
            written(tmp_path, record("maddpg", seed, mean, scale=scale))
    told = reproduce_report.read_results(ONE, tmp_path)
    assert told.scale == 0.1 and told.values("maddpg", "test/own/x").tolist() == [1.0, 2.0, 3.0]  # of 0.5 there is one seed


def test_records_that_differ_are_not_shown_together(tmp_path):
    written(tmp_path, record("maddpg", 0))
    other = record("maddpg", 1)
    other["identity"]["settings"]["gamma"] = 0.5
    path = written(tmp_path, other)
    with pytest.raises(ValueError, match=f"the record {path} was measured with settings.gamma 0.5, and seed_0.json beside"):
        reproduce_report.read_results(ONE, tmp_path)
    path = written(tmp_path, record("maddpg", 2), path)
    with pytest.raises(ValueError, match=f"the record {path} is of the seed 2; its path says 1"):
        reproduce_report.read_results(ONE, tmp_path)
    other = record("maddpg", 1)
    other["test"]["seeds"] = [9, 10]
    written(tmp_path, other, path)
    with pytest.raises(
        ValueError, match=rf"the record {path} is of a test with the seeds 9 to 10, and .*seed_0.json of 7 to 8"
    ):
        reproduce_report.read_results(ONE, tmp_path)


def test_scripted_policies_are_shown_that_met_the_same_episodes(tmp_path):
    written(tmp_path, record("maddpg", 0))
    scripted = record("maddpg", 0, mean=5.0)
    world = {"env_id": "W", "env_kwargs": None, "env_wrapper": None}
    scripted["identity"] = {"experiment": "e", "world": world, "players": {"agent": "random"}, "test_episodes": 2}
    written(tmp_path, scripted, ONE.scripted_record(tmp_path, {"agent": "random"}, 3))
    assert reproduce_report.read_results(ONE, tmp_path).scripted == {}
    path = written(tmp_path, scripted, ONE.scripted_record(tmp_path, {"agent": "random"}, 2))
    assert [*reproduce_report.read_results(ONE, tmp_path).scripted] == ["random"]
    scripted["test"]["seeds"] = [8, 9]
    written(tmp_path, scripted, path)
    with pytest.raises(ValueError, match=f"the record {path} is of a test with the seeds 8 to 9, and"):
        reproduce_report.read_results(ONE, tmp_path)
    world["env_kwargs"] = {"max_steps": 5}
    written(tmp_path, scripted, path)
    with pytest.raises(ValueError, match=rf"the record {path} is of the world \{{env_id: W, env_kwargs: \{{max_steps: 5\}}"):
        reproduce_report.read_results(ONE, tmp_path)


def test_runs_whose_curriculum_logged_nothing_cost_the_page_nothing(tmp_path):
    of = "curve/curriculum/teacher_loss_in_fold"
    for seed in range(5):
        told = record("a", seed)
        if seed:
            told["curve"]["curriculum"] = {"steps": [10], "episodes": [1], "teacher_loss_in_fold": [0.5]}
        written(tmp_path, told)
        written(tmp_path, record("b", seed, 1.0))
    panels = [{"title": "", "estimates": "test/own/x"}, {"title": "", "estimates": of}]
    experiment = Experiment("e", "E", [{"algos": ["a", "b"], "envs": ["W"]}], columns={"of": of}, pictures={"p": panels})
    told = reproduce_report.read_results(experiment, tmp_path)
    assert np.isnan(told.values("a", of)[0]) and told.values("a", of)[1] == 0.5
    assert f"| MADDPG | {NOT_A_NUMBER} | 5 |" in reproduce_report.results_table(told)
    assert reproduce_report.cells_of_pictures(told) == {}
    with pytest.raises(ValueError, match="have no curve/eval/y"):
        told.values("a", "curve/eval/y")


def test_what_a_short_curriculum_has_logged(monkeypatch):
    def series(*steps):
        return Series(np.array(steps), np.arange(len(steps), dtype=float), np.zeros(len(steps)))

    logged = {
        "curriculum/unscored": series(10, 20),
        "curriculum/teacher_loss_in_fold": series(10, 20, 30),
        "curriculum/rank_correlation_with_last": series(30),
    }
    monkeypatch.setattr(reproduce_run, "tensorboard_series", lambda _: logged)
    at = np.array([15, 40])
    during, values = reproduce_run.curriculum_of(SimpleNamespace(tensorboard_folder=""), at)
    assert during.tolist() == [15, 40] and {name: own.tolist() for name, own in values.items()} == {
        "teacher_loss_in_fold": [0, 1]
    }
    for name in ("unscored", "teacher_loss_in_fold"):
        del logged[f"curriculum/{name}"]
        assert reproduce_run.curriculum_of(SimpleNamespace(tensorboard_folder=""), at)[1] == {}
        logged["curriculum/unscored"] = series(10)


def test_cells_that_the_experiment_has_no_more_are_left_out(tmp_path, capsys):
    written(tmp_path, record("maddpg", 0, scale=0.1))
    for seed in range(5):
        written(tmp_path, record("gone/maddpg", seed, scale=0.5))
    told = reproduce_report.read_results(ONE, tmp_path)
    assert told.scale == 0.1 and [*told.cells] == ["maddpg"]
    assert capsys.readouterr().err.startswith("note: e has no cell gone/maddpg; ")


def test_what_is_no_number_is_told_and_left_out_of_nothing(tmp_path):
    for seed in range(5):
        mean, late = (None, None) if seed == 4 else (1.0, 1.0)
        written(tmp_path, record("maddpg", seed, mean, curve=(1.0, late)))
    experiment = Experiment(
        "e", "E", ONE.sweeps, columns={"x": "test/own/x"}, pictures={"p": [{"title": "", "curve": "curve/eval/x"}]}
    )
    told = reproduce_report.read_results(experiment, tmp_path)
    assert f"| MADDPG | {NOT_A_NUMBER} | 5 |" in reproduce_report.results_table(told)
    claim = Claim("", "e", "test/own/x", lower=True, cell="maddpg", than=9.0)
    assert (judged(claim, told).word, judged(claim, told).numbers) == (CANNOT_BE_TOLD, NOT_A_NUMBER)
    _, values = reproduce_report.curves(told.cells["maddpg"], "curve/eval/x")
    assert [own.mean for own in reproduce_report.iqm_curve_of(values)] == [1.0, pytest.approx(np.nan, nan_ok=True)]
    effects = Experiment("e", "E", ONE.sweeps, effects={"default": "a", "quantity": "test/own/x"})
    cells = {"a": told.cells["maddpg"][:4], "b": told.cells["maddpg"]}
    (line,) = reproduce_report.effects_table(Results(effects, 1.0, cells, {})).splitlines()[3:]
    assert line.split(" | ")[1:5] == [NOT_A_NUMBER, NOT_A_NUMBER, "", CANNOT_BE_TOLD]
    assert reproduce_report.draw_pictures(told, tmp_path)
