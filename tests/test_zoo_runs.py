"""Runs that are found again, and what they have logged."""

import os
import time

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback

from tests.toy_runs import toy_run
from zoo import train
from zoo.named_players import label_of, run_of
from zoo.run_folder import file_to_play
from zoo.runs import Run, find_runs, natural, pick_run, runs_below
from zoo.series import evaluation_files, evaluations, progress, tensorboard_series


@pytest.fixture
def logs(tmp_path):
    """Eleven runs of one algorithm, one of another in another world."""
    for seed in range(11):
        toy_run(tmp_path / "logs", seed=seed)
    toy_run(tmp_path / "logs", "kfcv_maddpg", "HardSpread-v0", seed=7)
    return tmp_path / "logs"


def names(runs):
    return [f"{run.algo}/{run.folder.path.name}" for run in runs]


def test_runs_are_found_by_folder_by_the_folder_over_them_and_by_pattern(logs):
    one = str(logs / "maddpg" / "Grassland-v0_2")
    assert names(find_runs([one])) == ["maddpg/Grassland-v0_2"]
    assert names(find_runs([str(logs)])) == ["kfcv_maddpg/HardSpread-v0_1"] + [
        f"maddpg/Grassland-v0_{k}" for k in range(1, 12)
    ]
    assert names(find_runs([str(logs / "*" / "*_1*")])) == [
        "kfcv_maddpg/HardSpread-v0_1",
        *(f"maddpg/Grassland-v0_{k}" for k in (1, 10, 11)),
    ]
    assert names(find_runs([one, str(logs / "maddpg" / ".." / "maddpg" / "Grassland-v0_[12]")])) == [
        "maddpg/Grassland-v0_2",
        "maddpg/Grassland-v0_1",
    ]


def test_runs_of_a_sweep_lie_deeper(tmp_path):
    toy_run(tmp_path / "sweep" / "gamma_0.9")
    toy_run(tmp_path / "sweep" / "gamma_0.99")
    assert len(runs_below(tmp_path)) == 2


def test_runs_of_a_reproduction_lie_deepest(tmp_path):
    toy_run(tmp_path / "experiment" / "scale_1" / "gamma_0.9" / "seed_0")
    assert len(runs_below(tmp_path)) == 1


def test_hidden_folders_hold_no_runs(tmp_path):
    toy_run(tmp_path / ".release-a")
    assert runs_below(tmp_path) == []
    assert len(runs_below(tmp_path / ".release-a")) == 1


@pytest.mark.parametrize("word", ["", "logs/nothing", "logs/no*"])
def test_a_word_that_means_no_run_is_refused(tmp_path, word):
    (tmp_path / "logs").mkdir()
    with pytest.raises(ValueError, match="there is no run of"):
        find_runs([str(tmp_path / word)])


def test_a_run_knows_how_it_was_begun(logs):
    run = Run.at(logs / "kfcv_maddpg" / "HardSpread-v0_1")
    assert (run.algo, run.env_id, run.seed, run.has_ended) == ("kfcv_maddpg", "HardSpread-v0", 7, False)
    assert run.config["policy_kwargs"] == {"n_critics": 1}
    run.folder.last_model.touch()
    assert run.has_ended


def test_tensorboard_may_lie_elsewhere(tmp_path):
    here, there = (Run.at(toy_run(tmp_path, args={"tensorboard_log": folder})) for folder in (None, "boards"))
    assert here.tensorboard_folder == here.folder.path
    assert str(there.tensorboard_folder) == os.path.join("boards", "Grassland-v0", "maddpg_2")


def test_the_latest_run_is_picked_unless_its_number_is_given(logs):
    os.utime(logs / "maddpg" / "Grassland-v0_4" / "Grassland-v0" / "args.yml", (2e9, 2e9))
    assert pick_run(logs).folder.path.name == "Grassland-v0_4"
    assert pick_run(logs, env_id="HardSpread-v0").algo == "kfcv_maddpg"
    assert pick_run(logs, "maddpg", "Grassland-v0", 10).folder.number == 10


PICKED_WRONGLY = [
    ({"algo": "madpg"}, 'unknown algorithm of the runs "madpg"; did you mean "maddpg"?'),
    ({"env_id": "Graslnd-v0"}, 'unknown environment of the runs "Graslnd-v0"; did you mean "Grassland-v0"?'),
    ({"algo": "kfcv_maddpg", "exp_id": 9}, "fits; there are .*HardSpread-v0_1$"),
    ({"algo": "kfcv_maddpg", "env_id": "Grassland-v0"}, "fits; there are"),
]


@pytest.mark.parametrize(("wanted", "message"), PICKED_WRONGLY)
def test_what_cannot_be_picked_is_told_with_what_there_is(logs, wanted, message):
    with pytest.raises(ValueError, match=message):
        pick_run(logs, **wanted)


def test_an_empty_log_folder_has_nothing_to_pick(tmp_path):
    with pytest.raises(ValueError, match="there is no run in"):
        pick_run(tmp_path)


@pytest.mark.parametrize(
    ("file", "content"), [("config.yml", None), ("args.yml", "{"), ("args.yml", "algo: maddpg\nseed: 0\n"), ("args.yml", "1")]
)
def test_a_damaged_run_among_many_is_left_out_and_refused_by_its_own_name(tmp_path, capsys, file, content):
    toy_run(tmp_path)
    damaged = toy_run(tmp_path, seed=1)
    if content is None:
        (damaged / "Grassland-v0" / file).unlink()
    else:
        (damaged / "Grassland-v0" / file).write_text(content)
    for word in (tmp_path, tmp_path / "maddpg" / "*"):
        assert names(find_runs([str(word)])) == ["maddpg/Grassland-v0_1"]
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"note: {damaged} is left out: ") and file in line
    with pytest.raises(ValueError, match=rf"Grassland-v0/{file}"):
        find_runs([str(damaged)])


@pytest.mark.parametrize("content", ["{", "lr: 1\n", "algo: maddpg\nenv: HardSpread-v0\nseed: 0\n"])
def test_a_foreign_folder_is_no_run(tmp_path, capsys, content):
    run = toy_run(tmp_path)
    for folder in (tmp_path, run):
        (folder / "cfg").mkdir()
        (folder / "cfg" / "args.yml").write_text(content)
    assert names(find_runs([str(tmp_path)])) == names(find_runs([str(run)])) == ["maddpg/Grassland-v0_1"]
    (tmp_path / "m.zip").touch()
    assert run_of(str(tmp_path / "m.zip")) is None
    assert label_of(str(tmp_path / "m.zip")) == "m"
    assert capsys.readouterr().err == ""
    with pytest.raises(ValueError, match="is no folder of a run"):
        Run.at(tmp_path)


def test_what_can_play_is_picked_to_play(tmp_path, capsys):
    able, latest = toy_run(tmp_path), toy_run(tmp_path, seed=1)
    for when, run in enumerate((able, latest)):
        os.utime(run / "Grassland-v0" / "args.yml", (when, when))
    assert pick_run(tmp_path, to_play=True).folder.path == latest  # for want of any
    (able / "rl_model_40_steps.zip").touch()
    assert pick_run(tmp_path).folder.path == latest
    assert capsys.readouterr().err == ""
    assert pick_run(tmp_path, to_play=True).folder.path == able
    assert capsys.readouterr().err == f"note: {latest} has nothing to play yet; {able} plays\n"


@pytest.mark.parametrize(
    ("given", "nearest"),
    [
        ("madpg/Grassland-v0_1", "maddpg/Grassland-v0_1"),
        ("maddpg/Graslnd-v0_1", "maddpg/Grassland-v0_1"),
        ("maddpg/Grassland-v0_1/modle.zip", "maddpg/Grassland-v0_1/model.zip"),
        ("maddpg/Graslnd-v0_1/model.zip", "maddpg/Grassland-v0_1/model.zip"),
        ("maddpg/Grassland-v0_1/model.zop", "maddpg/Grassland-v0_1/model.zip"),
        ("maddpg/Grassland-v0_1/unlike.zip", None),
    ],
)
def test_a_misspelt_path_gets_the_nearest_one(tmp_path, given, nearest):
    (toy_run(tmp_path) / "model.zip").touch()
    find = [file_to_play] if given.endswith(("zip", "zop")) else [file_to_play, Run.at]
    for own in find:
        with pytest.raises(ValueError) as error:
            own(tmp_path / given)
        assert str(error.value).endswith(f'did you mean "{tmp_path / nearest}"?' if nearest else "to take a player of")


def test_natural_order():
    assert sorted(["a_10", "a_9", "b_1", "a"], key=natural) == ["a", "a_9", "a_10", "b_1"]


def test_evaluations_by_name(tmp_path):
    run = toy_run(tmp_path, steps=(10, 20), reward=((1, 2, 3), (4, 5, 6)), sheep_eaten=((0, 1, 1), (1, 1, 1)))
    found = evaluations(run)
    assert found["timesteps"].tolist() == [10, 20]
    assert found["results"].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert found["sheep_eaten"].shape == (2, 3)

    np.savez(run / "evaluations_wolf_vs_graze.npz", timesteps=[10], results=[[7.0]])
    assert [*evaluation_files(run)] == ["eval", "wolf_vs_graze"]
    assert evaluations(run, "wolf_vs_graze")["results"].tolist() == [[7.0]]
    with pytest.raises(ValueError, match='"wolf_vs_grase"; did you mean "wolf_vs_graze"'):
        evaluations(run, "wolf_vs_grase")


def test_evaluations_that_are_missing_or_damaged(tmp_path):
    with pytest.raises(ValueError, match="has no evaluations"):
        evaluations(toy_run(tmp_path, steps=()))
    damaged = toy_run(tmp_path) / "evaluations.npz"
    for content in (damaged.read_bytes()[:100], b"no archive"):
        damaged.write_bytes(content)
        with pytest.raises(ValueError, match=r"evaluations\.npz cannot be read"):
            evaluations(damaged.parent)


def test_tensorboard_series_keep_the_last_of_what_was_logged_twice(tmp_path):
    run = toy_run(tmp_path, scalars={"train/loss": {10: 4.0, 20: 3.0}})
    time.sleep(1.1)  # event files are ordered by the second in their names
    other = toy_run(tmp_path, scalars={"train/loss": {20: 2.0, 30: 1.0}})
    (events,) = other.glob("events.out.tfevents.*")
    events.rename(run / events.name)
    series = tensorboard_series(run)["train/loss"]
    assert series.steps.tolist() == [10, 20, 30]
    assert series.values.tolist() == [4.0, 2.0, 1.0]
    assert (np.diff(series.seconds) >= 0).all()
    assert tensorboard_series(tmp_path / "nothing") == {}


def test_progress_by_hand(tmp_path):
    run = toy_run(tmp_path, episodes=((10, 1.0), (30, 2.0), (20, 4.0)))
    so_far = progress(run / "0.monitor.csv")
    assert so_far.steps.tolist() == [0, 10, 40, 60]
    steps = np.array([0, 9, 10, 25, 50, 60, 99])
    assert so_far.episodes_at(steps).tolist() == [0, 0, 1, 1, 2, 3, 3]
    assert so_far.seconds_at(steps) == pytest.approx([0, 0.9, 1, 1.5, 3, 4, 4])
    assert progress(run / "0.monitor.csv", 1000).episodes_at(np.array([1000, 1040])).tolist() == [0, 2]


def test_a_clock_that_starts_again_goes_on(tmp_path):
    run = toy_run(tmp_path, episodes=((10, 5.0), (10, 6.0), (10, 2.0), (10, 3.0)))
    assert progress(run / "0.monitor.csv").seconds.tolist() == [0, 5, 6, 8, 9]


def test_the_line_that_is_being_written_does_not_count(tmp_path):
    file = toy_run(tmp_path, episodes=((10, 1.0), (10, 2.0))) / "0.monitor.csv"
    file.write_text(file.read_text() + "0.0,1")
    assert progress(file).steps.tolist() == [0, 10, 20]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot read"),
        ("#{}\nr,l,t\n", "has no episode yet"),
        ("#{}\nr,l\n0,1\n", "is no monitor file"),
        ("#{}\nr,l,t\n0,a,b\n", "is no monitor file"),
    ],
)
def test_what_is_no_monitor_file_is_told(tmp_path, text, message):
    if text is not None:
        (tmp_path / "0.monitor.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        progress(tmp_path / "0.monitor.csv")


class Stop(BaseCallback):
    """As Ctrl-C twice, after some env steps."""

    def _on_step(self):
        if self.num_timesteps >= 150:
            raise KeyboardInterrupt
        return True


def test_the_pause_before_a_resume_and_lost_work_do_not_count(tmp_path, monkeypatch):
    words = ["--algo", "maddpg", "-n", "300", "--seed", "1", "-f", str(tmp_path), "--verbose", "0", "--eval-freq", "100"]
    words += [
        "--eval-episodes",
        "2",
        "--save-freq",
        "100",
        "--env-kwargs",
        "n_wolves:2",
        "n_sheep:2",
        "n_grass:1",
        "max_steps:5",
    ]
    words += ["-params", "n_envs:2", "learning_starts:20", "batch_size:8", "buffer_size:400"]
    assert train.main(words, [Stop()]) == 130
    clock, pause = time.time, 1e6
    monkeypatch.setattr(time, "time", lambda: clock() + pause)
    assert train.main(["--resume", str(tmp_path / "maddpg" / "Grassland-v0_1"), "--verbose", "0"]) == 0

    run = Run.at(tmp_path / "maddpg" / "Grassland-v0_1")
    so_far = progress(run.folder.monitor_file)
    assert 290 <= so_far.steps[-1] <= 300
    assert (np.diff(so_far.seconds) >= 0).all() and so_far.seconds[-1] < pause / 2
    assert evaluations(run.folder.path)["timesteps"].tolist() == [100, 200, 300]
    series = tensorboard_series(run.tensorboard_folder)["eval/mean_reward"]
    assert series.steps.tolist() == [100, 200, 300]
    assert series.seconds[-1] - series.seconds[0] > pause / 2  # which is why times are read from the monitor file
