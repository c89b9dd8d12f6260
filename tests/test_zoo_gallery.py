"""The gallery: every result on the page is what the command beside it gives."""

import re
import shlex
import shutil

import pytest

from zoo import evaluate, gallery, train


def command(folder, algo, seed=1):
    return [
        *("--algo", algo, "--env", "HardSpread-v0", "-n", "80", "--seed", str(seed), "-f", str(folder), "--verbose", "0"),
        *("--eval-freq", "40", "--eval-episodes", "2", "--env-kwargs", "n_agents:2", "max_steps:5"),
        *("-params", "n_envs:2", "learning_starts:20", "batch_size:8"),
    ]


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    for algo in ("maddpg", "per_maddpg"):
        assert train.main(command(folder, algo)) == 0
    return folder


def test_the_page(logs, tmp_path, capsys):
    assert gallery.main([str(logs), "-o", str(tmp_path), "-n", "3", "--films", "1"]) == 0
    page = (tmp_path / "gallery.md").read_text()
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", page)
    assert len(pictures) == 4 and all((tmp_path / picture).stat().st_size > 1000 for picture in pictures)
    assert "PER-MADDPG" in page and (logs / "maddpg/HardSpread-v0_1/HardSpread-v0/command.txt").read_text().strip() in page

    words, result = re.search(r"\$ \S+ \S*zoo/evaluate.py (.*?)\n\n(.*?)\n```", page, re.DOTALL).groups()
    assert {"random", "oracle"} <= set(shlex.split(words))
    capsys.readouterr()
    assert evaluate.main(shlex.split(words)) == 0
    assert capsys.readouterr().out.strip() == result


def test_runs_that_cannot_do_all_of_it_are_left_out_of_that(logs, tmp_path):
    """An algorithm without evaluations, and a better run that has no model yet."""
    copy = tmp_path / "logs"
    shutil.copytree(logs / "maddpg" / "HardSpread-v0_1", copy / "maddpg" / "HardSpread-v0_1")
    begun = copy / "maddpg" / "HardSpread-v0_2"
    shutil.copytree(logs / "maddpg" / "HardSpread-v0_1", begun, ignore=shutil.ignore_patterns("*.zip"))
    per = copy / "per_maddpg" / "HardSpread-v0_1"
    shutil.copytree(logs / "per_maddpg" / "HardSpread-v0_1", per, ignore=shutil.ignore_patterns("evaluations.npz"))
    assert gallery.main([str(copy), "-o", str(tmp_path), "-n", "3", "--films", "0"]) == 0
    page = (tmp_path / "gallery.md").read_text()
    assert "### MADDPG" in page and "### PER-MADDPG" in page and "### All seeds" not in page
    (copy / "maddpg" / "HardSpread-v0_1" / "HardSpread-v0.zip").unlink()
    for path in [*copy.glob("*/*/evaluations.npz"), *copy.glob("*/*/*.zip")]:
        path.unlink()
    assert gallery.main([str(copy), "-o", str(tmp_path), "-n", "3", "--films", "0"]) == 0
    page = (tmp_path / "gallery.md").read_text()
    assert "None of the runs has evaluations" in page and "None of the runs has a model or a checkpoint yet" in page


def test_best_of_each(logs, monkeypatch):
    assert train.main(command(logs, "maddpg", seed=2)) == 0
    runs = gallery.find_runs([str(logs)])
    rewards = {"HardSpread-v0_1": 1.0, "HardSpread-v0_2": 2.0}
    monkeypatch.setattr(gallery, "last_reward", lambda run: rewards[run.folder.path.name])
    best = gallery.best_of_each(runs)
    assert [(algo, run.seed) for algo, run in best.items()] == [("maddpg", 2), ("per_maddpg", 1)]


def test_bad_input(logs, tmp_path, capsys):
    for words, message in (
        (["nothing"], "there is no run of zoo/train.py in nothing"),
        ([str(logs), "-n", "1"], "-n must be a whole number of at least 2, got 1"),
        ([str(logs), "--film", "1"], 'unknown flag "--film"; did you mean "--films"?'),
    ):
        assert gallery.main([*words, "-o", str(tmp_path / "out")]) == 2
        assert message in capsys.readouterr().err
    run = tmp_path / "logs" / "maddpg" / "HardSpread-v0_1"
    shutil.copytree(logs / "maddpg" / "HardSpread-v0_1", run)
    (run / "evaluations.npz").write_bytes((run / "evaluations.npz").read_bytes()[:-30])
    assert gallery.main([str(tmp_path / "logs"), "-o", str(tmp_path / "out")]) == 2
    assert f"{run}/evaluations.npz cannot be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
