"""The benchmarks: do they run, and do their tables, exponents and projections say what was measured?"""

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def script(monkeypatch):
    """Imports a benchmark by its name, as a script sees it."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    threads = th.get_num_threads()
    yield importlib.import_module
    th.set_num_threads(threads)


def test_exponent_is_that_of_the_larger_half(script):
    curve = script("scale").Curve("update", "panel", "name", "agents N", "s", "update")
    for size, seconds in ((1, 7.0), (2, 7.0), (4, 16.0), (8, 64.0)):
        curve.add(size, [seconds, seconds / 2, seconds * 2])
    assert curve.exponent == pytest.approx(2.0)
    assert curve.growth == "n^2.00"


def test_scale_measures_and_draws_again_from_its_file(script, tmp_path, monkeypatch, capsys):
    scale, output = script("scale"), tmp_path / "scale.json"
    common = ["scale.py", "--output", str(output), "--images", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*common, "--quick", "--groups", "replay"])
    scale.main()
    first = capsys.readouterr().out
    assert "| by rank |" in first and "n^" in first
    picture = tmp_path / "scale_replay.png"
    picture.unlink()
    monkeypatch.setattr(sys, "argv", [*common, "--draw-only"])
    scale.main()
    assert capsys.readouterr().out == first
    assert picture.stat().st_size > 10_000


def test_a_buffer_that_is_too_large_is_left_out_and_the_table_says_so(script, monkeypatch):
    scale = script("scale")
    monkeypatch.setattr(scale, "LARGEST", 0)
    curves = list(scale.replay(scale.QUICK))
    assert all(not curve.sizes for curve in curves)
    assert curves[0].cell(500).startswith("left out: ")


@pytest.mark.parametrize("algo", ["maddpg", "kfcv_maddpg"])
def test_a_training_is_measured_in_sections_of_both_halves(script, algo):
    full_training = script("full_training")
    training = full_training.measure("HardSpread-v0", algo, 0.0005, ["n_timesteps:200000", "batch_size:16"])
    # (200,000 − 1000) / 32 updates; each section is 9968 steps, of which one round of 32 is run
    assert (training.episodes, training.env_steps, training.updates) == (2857, 200_000, 6218)
    assert len(training.sections) == full_training.N_SECTIONS
    assert training.share == pytest.approx(20 * 32 / (200_000 - 1000 - 20 * 32))
    assert training.projected == pytest.approx(training.start + sum(training.sections) / training.share)
    parts = training.update_minutes + training.refresh_minutes + training.other_minutes
    assert parts == pytest.approx(sum(training.sections) / training.share)
    assert "200,000" in full_training.table({"trainings": [vars(training)]})


def test_tables_are_filled_in_place_and_stay_as_they_are(script, tmp_path):
    report = script("report")
    page = "before\n<!-- table: scale-update -->\nold\n<!-- end -->\nafter\n<!-- table: training -->\n<!-- end -->\n"
    curve = script("scale").Curve("update", "over agents", "a curve", "agents N", "s", "update")
    curve.add(2, [0.001])
    curve.add(4, [0.002])
    facts = {"processor": "a processor", "threads": 1, "date": "a day", "versions": {"torch": "2"}}
    (tmp_path / "scale.json").write_text(json.dumps({**facts, "curves": [vars(curve)]}))
    filled = report.filled(page, tmp_path)
    assert "| a curve | 1 ms [1 ms–1 ms] | 2 ms [2 ms–2 ms] | n^1.00 |" in filled
    assert "old" not in filled and filled.startswith("before\n") and "\nafter\n" in filled
    assert "make benchmark-training" in filled
    assert report.filled(filled, tmp_path) == filled


def test_every_table_of_the_page_has_a_maker(script):
    report = script("report")
    names = [name for _, name, _ in report.pages.PLACE.findall(report.PAGE.read_text())]
    assert sorted(names) == sorted(report.TABLES)


def test_peers_in_one_table(script):
    compare = script("compare")
    side = {"blocks": [], "note": "", "versions": {}}
    of_ours, of_theirs = {**side, "medians": [0.001, 0.003, 0.002]}, {**side, "medians": [0.008]}
    pair = {"variant": "", "ours": of_ours, "theirs": of_theirs, "error": ""}
    pairs = [
        {**pair, "case": "spread-1", "peer": "mpe2"},
        {**pair, "case": "spread-32", "peer": "jaxmarl", "ours": {**side, "medians": [0.001]}},
        {**pair, "case": "tag-1", "peer": "mpe2", "error": "stopped"},
    ]
    table = compare.overview({"pairs": pairs})
    assert "| simulate spread, N = 4, worlds: 1 | 2 ms |  | 8 ms (**4.0×**) |" in table
    assert "no figure" in table
    best = compare.best_batches(compare.pairs_of({"pairs": pairs}))
    assert [line.split("|")[-2].strip() for line in best[2:]] == ["**8.0×**", "**8.0×**"]  # ours at its best: 1 ms


def test_stock_algorithms_go_on_from_their_file_and_say_what_was_measured(script, tmp_path, monkeypatch, capsys):
    """All trainings but one are in the file; of by rank and uniform, 2 and 4 against 1 and 2, one pair of four is equal."""
    stock, output, image = script("stock_algorithms"), tmp_path / "stock.json", tmp_path / "stock.png"
    reached = {"uniform": [1.0, 2.0], "by rank": [2.0, 4.0], "curriculum": [1.0, 1.0]}
    runs = [
        {"env": env, "replay": replay, "seed": seed, "steps": task.steps // 100, "returns": [value] * 20, "seconds": 2.0}
        for env, task in stock.TASKS.items()
        for replay, values in reached.items()
        for seed, value in enumerate(values)
    ]
    left_out = runs.pop(5)
    output.write_text(json.dumps(runs))
    monkeypatch.setattr(stock, "EPISODES", 1)
    arguments = ["--seeds", "2", "--share", "0.01", "--output", str(output), "--image", str(image)]
    monkeypatch.setattr(sys, "argv", ["stock_algorithms.py", *arguments])
    stock.main()
    assert "| DQN on CartPole-v1 | by rank | 3 [2, 4] | 3 [2, 4] | 0.88 | 1.00 | 2 |" in capsys.readouterr().out
    assert image.stat().st_size > 10_000
    *others, trained = json.loads(output.read_text())
    assert others == runs
    assert {name: trained[name] for name in ("env", "replay", "seed", "steps")}.items() <= left_out.items()
    assert len(trained["returns"]) == 20


def test_mean_between_the_quartiles_leaves_out_the_outer_seeds(script):
    mean, low, high = script("stock_algorithms").interval(np.array([0.0, 1.0, 2.0, 99.0]))
    assert mean == 1.5
    assert low < 1.5 < high
