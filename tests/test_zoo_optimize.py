"""The search for hyperparameters: what it draws, how it goes on, what it writes, what it refuses."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from zoo import optimize, train
from zoo.hyperparams import flat, nested
from zoo.search_space import Range, SearchSpace, decoded, encoded

ROOT = Path(__file__).resolve().parents[1]

SPACE = {
    "all": {"gamma": [0.9, 0.99], "learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}},
    "maddpg": {"policy_kwargs.net_arch": [[8], [8, 8]], "batch_size": {"low": 4, "high": 9}},
}


@pytest.fixture
def space(tmp_path):
    path = tmp_path / "space.yml"
    path.write_text(yaml.safe_dump(SPACE))
    return path


def command(folder, space, *more, trials=4, steps=60):
    return [
        *("--algo", "maddpg", "--env", "HardSpread-v0", "--env-kwargs", "n_agents:2", "max_steps:5", "-n", str(steps)),
        *("-params", "n_envs:2", "learning_starts:10", "buffer_size:200", "--space", str(space), "-o", str(folder)),
        *("--n-trials", str(trials), "--n-startup-trials", "2", "--n-evaluations", "2", "--eval-episodes", "3", *more),
    ]


def trials_of(folder):
    told = json.loads((folder / "trials.json").read_text())["trials"]
    return [(trial["settings"], trial["value"], trial["evaluations"]) for trial in told]


def test_the_same_command_finds_the_same_and_goes_on(tmp_path, space, capsys):
    assert optimize.main(command(tmp_path / "whole", space)) == 0
    assert optimize.main(command(tmp_path / "parts", space, trials=1)) == 0
    assert len(trials_of(tmp_path / "parts")) == 1
    assert optimize.main(command(tmp_path / "parts", space)) == 0
    assert "which has 1" in capsys.readouterr().out
    assert trials_of(tmp_path / "parts") == trials_of(tmp_path / "whole")
    assert len({settings["learning_rate"] for settings, _, _ in trials_of(tmp_path / "whole")}) == 4  # none drawn twice


def test_a_trial_that_is_interrupted_is_tried_again(tmp_path, space, monkeypatch):
    assert optimize.main(command(tmp_path / "whole", space)) == 0

    values = optimize.Search.value

    def interrupted(search, trial):
        if trial.number == 2:
            raise KeyboardInterrupt
        return values(search, trial)

    monkeypatch.setattr(optimize.Search, "value", interrupted)
    with pytest.raises(KeyboardInterrupt):
        optimize.main(command(tmp_path / "parts", space))
    assert len(trials_of(tmp_path / "parts")) == 2  # what there is has been written
    monkeypatch.undo()
    assert optimize.main(command(tmp_path / "parts", space)) == 0
    assert trials_of(tmp_path / "parts") == trials_of(tmp_path / "whole")


def test_a_trial_whose_process_was_killed_is_tried_again(tmp_path, space):
    words = command(tmp_path / "killed", space, "--n-seeds", "50", trials=1, steps=2000)
    process = subprocess.Popen([sys.executable, str(ROOT / "zoo" / "optimize.py"), *words])
    until = time.monotonic() + 60
    while not list((tmp_path / "killed").glob(".*_trial_0.lock")):
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    search = optimize.build(optimize.make_parser().parse_all(words))
    (before,) = search.study.trials
    search.give_back()
    gone, again = search.study.trials
    assert (before.state.name, gone.state.name, again.state.name) == ("RUNNING", "FAIL", "WAITING")
    assert again.system_attrs["fixed_params"] == before.params


def test_the_best_settings_train(tmp_path, space, capsys):
    assert optimize.main(command(tmp_path / "out", space)) == 0
    shown = capsys.readouterr().out
    best_settings, best_value, _ = max(trials_of(tmp_path / "out"), key=lambda trial: trial[1] or -1e9)
    assert f"best {best_value:.3f}" in shown and f"learning_rate: {best_settings['learning_rate']}" in shown
    entry = yaml.safe_load((tmp_path / "out" / "best.yml").read_text())["HardSpread-v0"]
    assert entry["gamma"] == 0.99 and entry["n_timesteps"] == 14_000_000  # the default is as it was
    assert entry["tuned"]["learning_rate"] == best_settings["learning_rate"]
    assert entry["tuned"]["policy_kwargs"] == {"net_arch": best_settings["policy_kwargs.net_arch"]}
    assert "n_timesteps" not in entry["tuned"]
    words = ["--algo", "maddpg", "--env", "HardSpread-v0", "-conf", str(tmp_path / "out" / "best.yml"), "--preset", "tuned"]
    assert train.main([*words, "-n", "20", "-f", str(tmp_path / "logs"), "--verbose", "0", "--seed", "0"]) == 0
    assert (tmp_path / "out" / "optimize.png").stat().st_size > 10_000


def test_several_processes(tmp_path, space):
    assert optimize.main(command(tmp_path / "out", space, "--n-jobs", "2", trials=3)) == 0
    assert len(trials_of(tmp_path / "out")) == 3
    assert not list((tmp_path / "out").glob(".*_trial_*.lock"))


class FakeTrial:
    def __init__(self):
        self.reported = {}

    def report(self, value, step):
        self.reported[step] = value

    def should_prune(self):
        return False


def test_a_trial_reports_the_mean_over_its_seeds_so_far():
    import numpy as np

    trial, evaluations = FakeTrial(), []
    for before, values in (([], [1.0, 3.0]), ([3.0], [5.0, 9.0])):
        report = optimize.Report(trial, "reward", before, n_evaluations=2)
        report.parent = type("Parent", (), {"evaluations": evaluations})
        evaluations.clear()
        for value in values:
            evaluations.append({"reward": np.array([value - 1, value + 1])})
            assert report._on_step()
    assert trial.reported == {1: 1.0, 2: 3.0, 3: 4.0, 4: 6.0} and report.value == 9.0


def test_trials_that_fall_behind_are_cut_short(tmp_path, space):
    import optuna

    search = optimize.build(optimize.make_parser().parse_all(command(tmp_path / "out", space, "--n-startup-trials", "1")))

    def play(values):
        trial = search.study.ask(search.space.distributions())
        for step, value in enumerate(values, 1):
            trial.report(value, step)
            if trial.should_prune():
                search.study.tell(trial, state=optuna.trial.TrialState.PRUNED)
                return step
        search.study.tell(trial, values[-1])
        return None

    assert play([1.0, 2.0, 3.0, 4.0]) is None
    assert play([1.0, 1.5, 3.0, 4.0]) == 2
    assert play([1.0, 2.5, 3.5, 4.5]) is None
    assert [trial.value for trial in search.ranked()] == [4.5, 4.0]


def test_the_space_of_every_algorithm_is_one_of_its_settings(tmp_path):
    for algo in ("maddpg", "per_maddpg", "kfcv_maddpg"):
        words = ["--algo", algo, "--env", "HardSpread-v0", "-o", str(tmp_path / algo)]
        found = optimize.build(optimize.make_parser().parse_all(words)).space  # which builds a learner with every choice
        assert isinstance(found.settings["learning_rate"], Range) and found.settings["gamma"]
    assert found.settings["replay_buffer_kwargs.n_folds"].whole


def test_choices_come_back_as_they_were():
    choices = [[64, 64], [128], None, True, 0.5, "lin_1e-3", {"a": 1}]
    found = SearchSpace({"x": choices})
    assert [decoded({"x": encoded(choice)}, found)["x"] for choice in choices] == choices
    settings = {"a.b": 1, "a.c": 2, "d": 3}
    assert nested(settings) == {"a": {"b": 1, "c": 2}, "d": 3} and flat(nested(settings)) == settings


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"all": {"gama": [0.9]}}, 'unknown hyperparameter "gama"; did you mean "gamma"?'),
        ({"all": {"gamma": [0.9, "much"]}}, "hyperparameter gamma is 'much'; it must be a number"),
        ({"all": {"gamma": [0.9, 5]}}, "the search space has gamma: 5, but gamma must be at least 0 and at most 1"),
        ({"all": {"batch_size": [64, 9000]}}, "the search space has batch_size: 9000, but batch_size=9000 is larger than"),
        ({"all": {"n_timesteps": [100, 200]}}, "n_timesteps is no setting to search"),
        ({"all": {"gamma": 0.9}}, "it must be a list of choices, or a range"),
        ({"all": {"gamma": {"low": 0.9, "hihg": 1}}}, 'unknown key of gamma "hihg"; did you mean "high"?'),
        ({"all": {"gamma": {"low": 0.9, "high": 0.5}}}, "needs numbers low < high"),
        ({"all": {"gamma": {"low": 0, "high": 1, "log": True}}}, "low must be above 0"),
        ({"madpg": {"gamma": [0.9]}}, 'unknown algorithm "madpg"; did you mean "maddpg"?'),
        ({"per_maddpg": {"gamma": [0.9]}}, "has no settings for maddpg"),
        ({"all": ["gamma"]}, "all is ['gamma']; it must be a map of settings"),
    ],
)
def test_bad_spaces(tmp_path, space, capsys, content, message):
    space.write_text(yaml.safe_dump(content))
    assert optimize.main(command(tmp_path / "out", space)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--metric", "colisions"], 'unknown metric "colisions"; did you mean "collisions"?'),
        (["--sampler", "tpee"], 'unknown sampler "tpee"; did you mean "tpe"?'),
        (["--pruner", "mean"], 'unknown pruner "mean"; did you mean "median"?'),
        (["--n-trials", "0"], "--n-trials must be a whole number of at least 1, got 0"),
        (["--env", "HardSpred-v0"], 'unknown environment "HardSpred-v0"; did you mean "HardSpread-v0"?'),
        (["--seed", "-1"], "--seed must be a whole number of at least 0, got -1"),
        (["--study-name", "a/b"], "--study-name is part of file names"),
        (["--storage", "sqlite:////nope/x.db"], "the study cannot be kept in sqlite:////nope/x.db: "),
        (["--storage", "foo://x"], "the study cannot be kept in foo://x: "),
        (["--n-trial", "3"], 'unknown flag "--n-trial"; did you mean "--n-trials"?'),
    ],
)
def test_bad_input(tmp_path, space, capsys, more, message):
    assert optimize.main(command(tmp_path / "out", space, *more)) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_study_goes_on_as_it_was_begun(tmp_path, space, capsys):
    assert optimize.main(command(tmp_path / "out", space, trials=1)) == 0
    assert optimize.main(command(tmp_path / "out", space, "--n-seeds", "3")) == 2
    assert "was begun with n_seeds 2, not 3; give this one a --study-name of its own" in capsys.readouterr().err
