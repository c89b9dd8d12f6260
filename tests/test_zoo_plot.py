"""Plots and comparisons of many runs: the statistics, and both scripts, run in-process on runs of the test's own numbers."""

import itertools
import json

import numpy as np
import pytest
import yaml
from PIL import Image

from sb3_kfcv.common.evaluation import with_interval
from tests.toy_runs import toy_run
from zoo import compare, plot, train
from zoo.plots import ALGO_COLOURS, line_styles
from zoo.statistics import (
    LEVEL,
    ahead,
    improvement,
    improvement_with_interval,
    iqm,
    iqm_curve,
    iqm_with_interval,
    permutation_test,
    profile,
    profile_with_intervals,
)

FEW = 300  # draws of a bootstrap that a slow reference repeats


def generator():
    return np.random.default_rng(3)


def slow_iqm(values):
    ordered, cut = sorted(values), len(values) // 4
    middle = ordered[cut : len(ordered) - cut]
    return sum(middle) / len(middle)


def slow_improvement(better, than):
    return sum((x > y) + (x == y) / 2 for x in better for y in than) / (len(better) * len(than))


def slow_interval(draws):
    """Percentiles by linear interpolation between ordered draws."""
    ordered, bounds = sorted(draws), []
    for share in (0.025, 0.975):
        place = share * (len(ordered) - 1)
        below, rest = int(place), place % 1
        bounds.append(ordered[below] + rest * (ordered[min(below + 1, len(ordered) - 1)] - ordered[below]))
    return bounds


def slow_draws(values, rng):
    """Runs drawn with replacement, ``FEW`` times."""
    picks = rng.integers(len(values), size=(FEW, len(values)))
    return [[values[pick] for pick in own] for own in picks]


SCORES = {"a": np.array([0.3, 0.9, 0.1, 0.4, 0.7]), "b": np.array([2.0, 5.0, 3.0])}
OTHERS = {"a": np.array([0.4, 0.2, 0.8]), "b": np.array([3.0, 4.0, 1.0, 2.5])}


def test_iqm_by_hand():
    assert iqm(np.array([100, 0, 1, 2, 3, 4, 5, 6.0])) == 3.5  # of 8 two go at either end
    assert iqm(np.array([1, 2, 3, 4, 100.0])) == 3  # of 5 one
    assert iqm(np.array([1, 2, 6.0])) == 3  # of 3 none
    assert iqm(np.array([[1.0], [2.0]])).tolist() == [1, 2]


def test_improvement_by_hand():
    # 1 beats none of 2, 2, 3; 3 beats both 2 and ties with 3: 2.5 of 6.
    one = {"a": np.array([1, 3.0])}
    other = {"a": np.array([2, 2, 3.0])}
    assert improvement(one, other) == pytest.approx(2.5 / 6)
    assert improvement(other, one) == pytest.approx(3.5 / 6)
    # Worlds count the same, whatever their number of runs.
    assert improvement({**one, "b": np.ones(50)}, {**other, "b": np.zeros(40)}) == pytest.approx((2.5 / 6 + 1) / 2)


def test_profile_by_hand():
    scores = {"a": np.array([0.0, 0.5]), "b": np.array([0.5, 1.0])}
    assert profile(scores, np.array([-1, 0, 0.25, 0.5, 1])).tolist() == [1, 0.75, 0.75, 0.25, 0]


def test_iqm_interval_is_that_of_a_slow_loop():
    rng = generator()
    drawn = [slow_draws(values, rng) for values in SCORES.values()]
    slow = [slow_iqm([*first, *second]) for first, second in zip(*drawn, strict=True)]
    found = iqm_with_interval(SCORES, generator(), FEW)
    assert found.mean == pytest.approx(slow_iqm([0.3, 0.9, 0.1, 0.4, 0.7, 2, 5, 3]))
    assert found[1:] == pytest.approx(slow_interval(slow))


def test_improvement_interval_is_that_of_a_slow_loop():
    rng = generator()
    by_world = []
    for world in SCORES:
        drawn = slow_draws(SCORES[world], rng), slow_draws(OTHERS[world], rng)
        by_world.append([slow_improvement(better, than) for better, than in zip(*drawn, strict=True)])
    slow = [sum(worlds) / 2 for worlds in zip(*by_world, strict=True)]
    found = improvement_with_interval(SCORES, OTHERS, generator(), FEW)
    assert found.mean == pytest.approx(sum(slow_improvement(SCORES[world], OTHERS[world]) for world in "ab") / 2)
    assert found[1:] == pytest.approx(slow_interval(slow))


def test_profile_interval_is_that_of_a_slow_loop():
    rng = generator()
    drawn = [slow_draws(values, rng) for values in SCORES.values()]
    slow = [sum(score > 0.5 for score in [*first, *second]) / 8 for first, second in zip(*drawn, strict=True)]
    (found,) = profile_with_intervals(SCORES, np.array([0.5]), generator(), FEW)
    assert found.mean == 5 / 8
    assert found[1:] == pytest.approx(slow_interval(slow))


def test_curve_interval_is_that_of_a_slow_loop():
    values = np.array([[1.0, 2, 4, 8], [0, 0, 3, 1]])  # (times, runs)
    drawn = slow_draws(range(4), generator())
    for found, own in zip(iqm_curve(values, generator(), FEW), values, strict=True):
        assert found.mean == slow_iqm(own)
        assert found[1:] == pytest.approx(slow_interval([slow_iqm([own[run] for run in runs]) for runs in drawn]))


def test_the_bootstrap_draws_every_sample_equally_often():
    """Against all 27 × 4 samples that can be drawn."""
    scores = {"a": np.array([0.0, 1.0, 5.0]), "b": np.array([0.2, 3.0])}
    every = [
        slow_iqm([*a, *b]) for a in itertools.product(scores["a"], repeat=3) for b in itertools.product(scores["b"], repeat=2)
    ]
    found = iqm_with_interval(scores, generator(), 50_000)
    for bound, share in ((found.low, 0.025), (found.high, 0.975)):
        assert np.mean(np.array(every) < bound - 1e-9) < share + 0.003
        assert np.mean(np.array(every) <= bound + 1e-9) > share - 0.003


def test_runs_are_drawn_within_their_world():
    same = {"a": np.zeros(3), "b": np.ones(3)}
    assert iqm_with_interval(same, generator()) == (0.5, 0.5, 0.5)
    assert improvement_with_interval(same, same, generator()) == (0.5, 0.5, 0.5)


def splits(values, n):
    """All ways to deal values out to two, n to the first."""
    for first in itertools.combinations(range(len(values)), n):
        yield [values[i] for i in first], [value for i, value in enumerate(values) if i not in first]


@pytest.mark.parametrize("moved", [2.5, 3.5, 1.0])
def test_the_permutation_test_is_the_rank_test_in_one_world(moved):
    values, others = np.arange(5.0), np.arange(5.0) + moved  # 3 of 25 pairs the other way round, 1, and some equal
    far = abs(slow_improvement(values, others) - 0.5)
    every = [abs(slow_improvement(*dealt) - 0.5) >= far - 1e-9 for dealt in splits([*values, *others], 5)]
    assert len(every) == 252
    exact = len({*values, *others}) == 10
    found = permutation_test({"": values}, {"": others}, generator())
    assert found == pytest.approx(sum(every) / 252, abs=1e-9 if exact else 0.006)


def test_the_permutation_test_deals_within_each_world():
    by_world = [
        [slow_improvement(*dealt) for dealt in splits([*SCORES[world], *OTHERS[world]], len(SCORES[world]))] for world in "ab"
    ]
    far = abs(improvement(SCORES, OTHERS) - 0.5)
    every = [abs(sum(both) / 2 - 0.5) >= far - 1e-9 for both in itertools.product(*by_world)]
    assert permutation_test(SCORES, OTHERS, generator()) == pytest.approx(sum(every) / len(every), abs=0.015)


def test_the_permutation_test_errs_no_oftener_than_it_says():
    rng = np.random.default_rng(0)
    runs = [[{"": own} for own in rng.normal(size=(2, 5))] for _ in range(500)]
    found = np.mean([permutation_test(*two, rng, 1000) < LEVEL for two in runs])
    assert 0.01 < found < LEVEL  # of the 252 ways to deal ten runs out, 8 are told


def test_who_is_ahead():
    five, others = np.arange(5.0), np.arange(5.0) + 2.5
    for values, than, so in (
        (five, others, None),  # 14 of 252
        (five, others + 1, False),  # 4 of 252
        (others + 1, five, True),
        (others[:4] + 9, five, None),  # too few
        (np.ones(5), np.zeros(5), True),
        (np.ones(5), np.ones(5), None),
        (others + 9, np.array([*five[:4], np.nan]), None),
    ):
        assert ahead({"a": values}, {"a": than}, generator()) is so
    two = {"a": five, "b": five}
    assert ahead(two, {"a": others, "b": others}, generator()) is False  # together they tell what neither tells
    assert ahead(two, {"a": others, "b": others[:4]}, generator()) is None


def test_values_that_are_infinite_are_ranked():
    found = improvement({"": np.array([np.inf, np.inf])}, {"": np.array([np.inf, -np.inf])})
    assert found == 0.75  # ties count half


def test_the_same_generator_gives_the_same_interval():
    assert iqm_with_interval(SCORES, generator()) == iqm_with_interval(SCORES, generator())


def test_a_single_run_has_no_interval():
    single = {"a": np.array([1.0, 2.0]), "b": np.array([3.0])}
    assert iqm_with_interval(single, generator()).mean == 2
    both = {world: np.arange(2.0) for world in "ab"}
    for found in (
        iqm_with_interval(single, generator()),
        improvement_with_interval(both, single, generator()),
        improvement_with_interval(single, both, generator()),
        *profile_with_intervals(single, np.zeros(1), generator()),
        *iqm_curve(np.ones((1, 1)), generator()),
    ):
        assert np.isnan(found[1:]).all()


def test_lines_of_one_algorithm_have_shades_of_its_colour():
    styles = line_styles({"one": "maddpg", "first": "kfcv_maddpg", "second": "kfcv_maddpg", "other": "unheard_of"})
    assert styles["one"] == (ALGO_COLOURS["maddpg"].lower(), "-")
    assert styles["first"][0] == ALGO_COLOURS["kfcv_maddpg"].lower()
    assert len(set(styles.values())) == 4 and styles["second"][1] != styles["first"][1]


# ---- plot


@pytest.fixture
def logs(tmp_path):
    """Three seeds of one algorithm, one of another, in two worlds."""
    for world, scale in (("Grassland-v0", 1), ("HardSpread-v0", 10)):
        for seed, last in enumerate((3.0, 6.0, 30.0)):
            reward = scale * np.array([[0.0, 2.0], [last - 1, last + 1]])
            toy_run(tmp_path / "logs", env=world, seed=seed, reward=reward, episodes=((100, 10.0 + seed), (100, 30.0 + seed)))
        eaten = {"sheep_eaten": ((0, 0), (0.5, 1)), "episodes": ((40, 7.0), (50, 8.0), (110, 9.0))}
        toy_run(tmp_path / "logs", "kfcv_maddpg", world, reward=np.ones((2, 2)) * scale, **eaten)
    return tmp_path / "logs"


def draw(out, *words, status=0):
    assert plot.main([*map(str, words), "-o", str(out / "curve")]) == status
    return json.loads((out / "curve.json").read_text()) if status == 0 else None


def test_a_line_is_the_iqm_over_the_seeds(tmp_path, logs, capsys):
    drawn = draw(tmp_path, logs)
    lines = {(line["env"], line["label"]): line for line in drawn["lines"]}
    assert list(lines) == [
        (world, label) for world in ("Grassland-v0", "HardSpread-v0") for label in ("MADDPG", "KFCV-MADDPG")
    ]
    line = lines["HardSpread-v0", "MADDPG"]
    assert (line["seeds"], line["steps"], line["x"]) == ([0, 1, 2], [100, 200], [100, 200])
    assert line["values"] == [[10, 10, 10], [30, 60, 300]]
    assert [point["mean"] for point in line["intervals"]] == [10, 130]
    assert line["intervals"][1]["low"] == 30 and line["intervals"][1]["high"] == 300
    assert "zoo/plot.py" in drawn["command"]
    assert Image.open(tmp_path / "curve.png").size[0] > 1000
    printed = capsys.readouterr()
    assert "HardSpread-v0: MADDPG, 3 seeds: 130.00 [30.00, 300.00] after 200 env steps" in printed.out
    assert (
        "fewer than 5 seeds are too few to tell much: MADDPG on Grassland-v0 has 3, KFCV-MADDPG on Grassland-v0 has 1, "
        in printed.err
    )


def test_of_a_single_run_the_interval_is_over_episodes(tmp_path):
    values = np.array([[0.0, 1, 2], [3, 5, 10]])
    toy_run(tmp_path, reward=values)
    (line,) = draw(tmp_path, tmp_path / "maddpg")["lines"]
    for found, own in zip(line["intervals"], values, strict=True):
        assert [found[name] for name in ("mean", "low", "high")] == pytest.approx(with_interval(own))


def test_episodes_and_time_are_the_median_over_the_runs(tmp_path, logs):
    episodes = draw(tmp_path, logs, "-x", "episodes")["lines"]
    assert [line["x"] for line in episodes[:2]] == [[1, 2], [2, 3]]
    seconds = draw(tmp_path, logs / "maddpg", "-x", "time")["lines"][0]
    assert seconds["x"] == [11, 31]


def test_a_run_that_was_trained_on_counts_from_where_it_began(tmp_path):
    begun = {"args": {"trained_agent": "model.zip", "n_timesteps": 200}, "config": {"n_timesteps": 1200}}
    toy_run(tmp_path, steps=(1100, 1200), episodes=((100, 5.0), (100, 9.0)), **begun)
    assert draw(tmp_path, tmp_path / "maddpg", "-x", "time")["lines"][0]["x"] == [5, 9]


def test_smoothing_is_the_mean_over_the_latest_entries(tmp_path):
    for seed in range(2):
        toy_run(tmp_path, seed=seed, steps=(1, 2, 3), reward=[[seed + value] for value in (0, 3, 9)])
    line = draw(tmp_path, tmp_path / "maddpg", "--smooth", 2)["lines"][0]
    assert line["values"] == [[0, 1], [1.5, 2.5], [6, 7]]


def test_only_common_evaluations_are_drawn_and_that_is_told(tmp_path, capsys):
    toy_run(tmp_path, steps=(100, 200, 300), reward=[[1], [2], [3]])
    toy_run(tmp_path, seed=1, steps=(100, 150, 200), reward=[[5], [6], [7]])
    line = draw(tmp_path, tmp_path / "maddpg")["lines"][0]
    assert (line["steps"], line["values"]) == ([100, 200], [[1, 5], [2, 7]])
    error = capsys.readouterr().err
    assert "drawn are the 2 of 4 evaluations that all 2 runs have, up to 200 of 300 env steps" in error
    assert "Grassland-v0_2)" in error


def test_logs_of_other_steps_are_read_between_entries(tmp_path):
    toy_run(tmp_path, scalars={"train/loss": {0: 0.0, 100: 10.0, 200: 20.0}})
    toy_run(tmp_path, seed=1, scalars={"train/loss": {50: 10.0, 150: 30.0}})
    line = draw(tmp_path, tmp_path / "maddpg", "-y", "train/loss")["lines"][0]
    assert line["steps"] == [50, 150]
    assert np.array(line["values"]) == pytest.approx(np.array([[5, 10], [15, 30]]))


def test_a_yardstick_is_an_evaluation_of_its_own(tmp_path):
    run = toy_run(tmp_path)
    np.savez(run / "evaluations_wolf_vs_graze.npz", timesteps=[100], results=[[7.0, 9.0]], ep_lengths=[[1, 1]])
    line = draw(tmp_path, run, "--eval-name", "wolf_vs_graze")["lines"][0]
    assert (line["steps"], line["values"]) == ([100], [[8]])


def test_settings_make_lines_of_their_own(tmp_path, capsys):
    for gamma, seed in itertools.product((0.9, 0.99), range(2)):
        toy_run(tmp_path / f"cell_{gamma}", seed=seed, config={"gamma": gamma, "policy_kwargs": {"n_critics": 1 + seed}})
    words = (tmp_path, "--group-by")
    assert [line["label"] for line in draw(tmp_path, *words, "gamma")["lines"]] == ["MADDPG, gamma 0.9", "MADDPG, gamma 0.99"]
    by_folder = draw(tmp_path, *words, "folder")["lines"]
    assert [line["label"] for line in by_folder] == ["MADDPG, folder cell_0.9", "MADDPG, folder cell_0.99"]
    assert len(draw(tmp_path, *words, "gamma", "policy_kwargs.n_critics")["lines"]) == 4
    for setting, seed in itertools.product(("plain", "far"), range(2)):
        toy_run(tmp_path / "sweep" / setting / f"seed_{seed}", seed=seed)
    of_a_sweep = draw(tmp_path, tmp_path / "sweep", "--group-by", "folder")["lines"]
    sizes = {line["label"]: len(line["runs"]) for line in of_a_sweep}
    assert sizes == {"MADDPG, folder far": 2, "MADDPG, folder plain": 2}
    capsys.readouterr()

    draw(tmp_path, tmp_path / "cell_*")
    error = capsys.readouterr().err
    assert "the runs differ in gamma (0.9, 0.99), policy_kwargs.n_critics (1, 2); --group-by tells them apart" in error
    assert "more than one run has the seed 0, 1" in error


def test_teams_are_told_apart(tmp_path):
    teams = {"teams": {"wolf": {"algo": "maddpg"}, "sheep": {"algo": "kfcv_maddpg"}}}
    toy_run(tmp_path, "co_training", config=teams)
    toy_run(tmp_path, config={"team": "wolf"})
    labels = [line["label"] for line in draw(tmp_path, tmp_path)["lines"]]
    assert labels == ["MADDPG wolf", "MADDPG wolf against KFCV-MADDPG sheep"]


def test_what_can_be_drawn_is_listed(tmp_path, capsys):
    toy_run(tmp_path, scalars={"train/loss": {1: 1.0}}, sheep_eaten=((1, 1), (1, 1)))
    toy_run(tmp_path)
    assert plot.main([str(tmp_path), "--list"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "2 runs; what -y takes:",
        "evaluations, --eval-name eval:",
        "  reward",
        "  length",
        "  sheep_eaten  (1 of 2 runs)",
        "TensorBoard:",
        "  train/loss  (1 of 2 runs)",
    ]


def test_runs_that_lack_a_metric_are_left_out_and_that_is_told(tmp_path, logs, capsys):
    lines = draw(tmp_path, logs, "-y", "sheep_eaten")["lines"]
    assert [line["label"] for line in lines] == ["KFCV-MADDPG", "KFCV-MADDPG"]
    assert "left out, since there is no metric sheep_eaten: " in capsys.readouterr().err


REFUSED = [
    ("plot {tmp}/nothing", "there is no run of zoo/train.py in {tmp}/nothing"),
    ("plot {tmp}/none", "of 2 runs none will do: {tmp}/none/maddpg/Grassland-v0_1 has no evaluations"),
    ("plot {tmp}/none", "has no evaluations; try -y rollout/ep_rew_mean (rewards of the training), or --list"),
    ("plot {logs} -o curve.jpg", "-o writes a file that ends in .png, not curve.jpg"),
    ("plot {logs} -o {tmp}/folder", "{tmp}/folder.png cannot be written: Is a directory"),
    ("plot {logs} -y sheep_eatn", 'unknown series "sheep_eatn"; did you mean "sheep_eaten"?'),
    ("plot {tmp}/logged -y critic_loss", 'unknown series "critic_loss"; did you mean "train/critic_loss"?'),
    ("plot {tmp}/logged -y train/critic_los", 'unknown TensorBoard tag "train/critic_los"; did you mean "train/critic_loss"?'),
    ("plot {logs} -y train/loss", "of 8 runs none will do: {logs}/kfcv_maddpg/Grassland-v0_1 has no TensorBoard log yet"),
    ("plot {logs} --eval-name wolf", 'unknown evaluation "wolf"; known: eval'),
    ("plot {logs} --group-by gama", 'unknown setting "gama"; did you mean "gamma"?'),
    ("plot {logs} --seris reward", 'unknown flag "--seris"; did you mean "--series"?'),
    ("plot {logs} -x hours", "invalid choice: 'hours'"),
    ("plot {logs} --smooth 0", "--smooth must be a whole number of at least 1, got 0"),
    ("plot {tmp}/apart", "MADDPG on Grassland-v0: no evaluation of its 2 runs was at the same env step"),
    ("plot {tmp}/apart -y train/loss", "MADDPG on Grassland-v0: its 2 runs have logged at no time in common"),
    ("plot {tmp}/logged -x time", "0.monitor.csv has no episode yet"),
    ("plot {logs} -o {tmp}/file/curve", "{tmp}/file/curve.png cannot be written: "),
    ("compare {logs} --metric sheep_eatn", 'unknown metric "sheep_eatn"; did you mean "sheep_eaten"?'),
    ("compare {logs}/maddpg", "a comparison takes two, and there is only MADDPG"),
    ("compare {logs} --metric sheep_eaten", "a comparison takes two, and there is only KFCV-MADDPG"),
    ("compare {logs}/maddpg/Gr* {logs}/kfcv_maddpg/H*", "no world has runs of all of MADDPG; KFCV-MADDPG"),
    ("compare {logs} --point lst", 'unknown --point "lst"; did you mean "last"? or a number of env steps'),
    ("compare {logs} --point 900", "was evaluated between 100 and 200 env steps, not at 900"),
    ("compare {logs} --better more", "invalid choice: 'more'"),
    ("compare {logs} --scores {tmp}/none.yml", "cannot read {tmp}/none.yml"),
    ("compare {logs} --scores {tmp}/scores.yml", "{tmp}/scores.yml says nothing about HardSpread-v0; it has Grassland-v0"),
    ("compare {logs} --scores {tmp}/same.yml", "Grassland-v0 must be a map of two different numbers, low and high; it is "),
    ("compare {logs} -o {tmp}/file", "{tmp}/file/compare.json cannot be written: "),
]


@pytest.fixture
def bad(tmp_path, logs):
    """Runs without evaluations, with logs only, with nothing in common; and files that are no use."""
    for seed in range(2):
        toy_run(tmp_path / "none", seed=seed, steps=())
        toy_run(tmp_path / "apart", seed=seed, steps=(100 + seed, 200 + seed), scalars={"train/loss": {seed: 1.0}})
    toy_run(tmp_path / "logged", scalars={"train/critic_loss": {1: 1.0}})
    (tmp_path / "file").touch()
    (tmp_path / "folder.png").mkdir()
    for name, high in (("scores", 1), ("same", 0)):
        (tmp_path / f"{name}.yml").write_text(yaml.safe_dump({"Grassland-v0": {"low": 0, "high": high}}))
    return tmp_path


@pytest.mark.parametrize(("words", "message"), REFUSED, ids=[words for words, _ in REFUSED])
def test_refused_in_one_sentence(bad, logs, monkeypatch, capsys, words, message):
    elsewhere = bad / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    name, *given = words.format(tmp=bad, logs=logs).split()
    assert {"plot": plot, "compare": compare}[name].main(given) == 2
    *notes, error = capsys.readouterr().err.splitlines()
    assert error.startswith("error: ") and message.format(tmp=bad, logs=logs) in error
    assert all(line.startswith("note: ") for line in notes)
    assert not [*elsewhere.iterdir()]


# ---- compare


def compared(out, *words):
    assert compare.main([*map(str, words), "-o", str(out / "compare")]) == 0
    return json.loads((out / "compare" / "compare.json").read_text())


def runs_of(logs, algo, world, last, steps=(100, 200), **further):
    """A run of each seed: its reward ends at one of ``last`` after having been one more."""
    for seed, value in enumerate(last):
        reward = [[value + 1, value + 1], [value - 0.5, value + 0.5]]
        toy_run(logs, algo, world, seed, steps, reward, episodes=((100, 50.0), (100, 100.0 + seed)), **further)


def test_a_comparison_by_hand(tmp_path, capsys):
    logs = tmp_path / "logs"
    runs_of(logs, "maddpg", "Grassland-v0", (0, 1, 2, 3, 4))
    runs_of(logs, "kfcv_maddpg", "Grassland-v0", (2, 10, 10, 10, 10))
    runs_of(logs, "maddpg", "HardSpread-v0", (0, 0, 50, 50, 50))
    runs_of(logs, "kfcv_maddpg", "HardSpread-v0", (40, 60, 70, 80, 100))
    found = compared(tmp_path, logs)
    names = {path.name for path in (tmp_path / "compare").iterdir()}
    assert names == {"compare.json", "compare.md", "compare.png", "marl_eval.json"}

    cell = found["worlds"]["Grassland-v0"]["KFCV-MADDPG"]
    assert cell["iqm"]["mean"] == 10
    assert [run["value"] for run in cell["runs"]] == [2, 10, 10, 10, 10]
    assert [run["step"] for run in cell["runs"]] == [200] * 5
    assert [run["seconds"] for run in cell["runs"]] == [100, 101, 102, 103, 104]
    assert found["scores_0_and_1"] == {"Grassland-v0": [0, 10], "HardSpread-v0": [0, 100]}
    # Scores of MADDPG: 0 .1 .2 .3 .4 and 0 0 .5 .5 .5; without two at either end 0, .1, .2, .3, .4, .5.
    assert found["normalised_iqm"]["MADDPG"]["mean"] == pytest.approx(1.5 / 6)
    # Grassland: of 25 pairs all but those of 2 with 2, 3 and 4 (half, none, none): 22.5. HardSpread: 40 beats two of five.
    (pair,) = found["improvement"]
    assert (pair["better"], pair["than"]) == ("KFCV-MADDPG", "MADDPG")
    assert pair["probability"]["mean"] == pytest.approx((22.5 / 25 + 22 / 25) / 2)
    assert pair["verdict"] == "KFCV-MADDPG is better" and pair["probability"]["low"] > 0.5
    at = found["profiles"]["thresholds"].index(0.45)
    assert found["profiles"]["MADDPG"][at]["mean"] == pytest.approx(0.3)

    printed, page = capsys.readouterr().out, (tmp_path / "compare" / "compare.md").read_text()
    for text in (printed, page):
        assert "2.0 ± 0.7" in text  # mean and standard error of 0 … 4: √(2.5 / 5)
        assert "0.0 … 50.0" in text and "1 min 42 s" in text and "KFCV-MADDPG is better" in text
    assert "zoo/compare.py" in page and "torch" in page
    assert Image.open(tmp_path / "compare" / "compare.png").size[0] > 1000


def test_lower_may_be_better(tmp_path):
    runs_of(tmp_path / "logs", "maddpg", "Grassland-v0", range(5))
    runs_of(tmp_path / "logs", "per_maddpg", "Grassland-v0", range(10, 15))
    (pair,) = compared(tmp_path, tmp_path / "logs")["improvement"]
    assert (pair["probability"]["mean"], pair["verdict"]) == (1, "PER-MADDPG is better")
    lower = compared(tmp_path, tmp_path / "logs", "--better", "lower")
    (pair,) = lower["improvement"]
    assert (pair["probability"]["mean"], pair["verdict"]) == (0, "MADDPG is better")
    assert lower["scores_0_and_1"] == {"Grassland-v0": [14, 0]}


def test_what_cannot_be_told_is_not_told(tmp_path, capsys):
    runs_of(tmp_path / "logs", "maddpg", "Grassland-v0", range(5))
    runs_of(tmp_path / "logs", "per_maddpg", "Grassland-v0", range(5))
    assert compared(tmp_path, tmp_path / "logs")["improvement"][0]["verdict"] == "cannot be told"
    runs_of(tmp_path / "few", "maddpg", "Grassland-v0", (0, 1))
    runs_of(tmp_path / "few", "per_maddpg", "Grassland-v0", (7, 8, 9))
    assert compared(tmp_path, tmp_path / "few")["improvement"][0]["verdict"] == "cannot be told from fewer than 5 seeds"
    assert "fewer than 5 seeds are too few to tell much: MADDPG on Grassland-v0 has 2" in capsys.readouterr().err


@pytest.mark.parametrize(("point", "value", "step"), [("last", 0, 200), ("best", 1, 100), ("130", 1, 100), ("2e2", 0, 200)])
def test_the_evaluation_that_counts_can_be_chosen(tmp_path, point, value, step):
    for algo in ("maddpg", "per_maddpg"):
        runs_of(tmp_path / "logs", algo, "Grassland-v0", (0, 1))
    run = compared(tmp_path, tmp_path / "logs", "--point", point)["worlds"]["Grassland-v0"]["MADDPG"]["runs"][0]
    assert (run["value"], run["step"]) == (value, step)
    assert run["seconds"] == step / 2


def test_the_best_is_the_lowest_where_lower_is_better(tmp_path):
    for algo in ("maddpg", "per_maddpg"):
        runs_of(tmp_path / "logs", algo, "Grassland-v0", (0, 1))
    found = compared(tmp_path, tmp_path / "logs", "--point", "best", "--better", "lower")
    assert found["worlds"]["Grassland-v0"]["MADDPG"]["runs"][0]["step"] == 200


def test_scores_may_be_given(tmp_path, capsys):
    runs_of(tmp_path / "logs", "maddpg", "Grassland-v0", (0, 10))
    runs_of(tmp_path / "logs", "per_maddpg", "Grassland-v0", (20, 30))
    (tmp_path / "scores.yml").write_text("Grassland-v0: {low: -10, high: 10}")
    found = compared(tmp_path, tmp_path / "logs", "--scores", tmp_path / "scores.yml")
    assert found["scores_0_and_1"] == {"Grassland-v0": [-10, 10]}
    assert found["normalised_iqm"]["MADDPG"]["mean"] == 0.75
    assert found["profiles"]["thresholds"][-1] == 2  # as far as the best run
    words = [str(tmp_path / "logs"), "--scores", str(tmp_path / "scores.yml"), "--better", "lower"]
    assert compare.main(words) == 2
    assert capsys.readouterr().err.endswith(
        "low of Grassland-v0 counts as 0 and high as 1, and lower is better; it is {'low': -10, 'high': 10}\n"
    )


def test_runs_of_other_lengths_are_told_of(tmp_path, capsys):
    runs_of(tmp_path / "logs", "maddpg", "Grassland-v0", (0, 1))
    runs_of(tmp_path / "logs", "per_maddpg", "Grassland-v0", (0, 1), steps=(100, 400))
    compared(tmp_path, tmp_path / "logs")
    assert "at different env steps, from 200 to 400; --point 200 compares all at the same" in capsys.readouterr().err


def test_a_world_that_not_all_have_counts_alone(tmp_path, capsys):
    for algo in ("maddpg", "per_maddpg"):
        runs_of(tmp_path / "logs", algo, "Grassland-v0", (0, 1))
    runs_of(tmp_path / "logs", "maddpg", "HardSpread-v0", (0, 1))
    found = compared(tmp_path, tmp_path / "logs")
    assert list(found["worlds"]) == ["Grassland-v0", "HardSpread-v0"] and list(found["scores_0_and_1"]) == ["Grassland-v0"]
    assert "since not every algorithm has runs there: HardSpread-v0" in capsys.readouterr().err


def test_runs_whose_time_is_not_known_are_compared_all_the_same(tmp_path):
    for algo in ("maddpg", "per_maddpg"):
        toy_run(tmp_path / "logs", algo)
    assert compared(tmp_path, tmp_path / "logs")["worlds"]["Grassland-v0"]["MADDPG"]["runs"][0]["seconds"] is None
    assert "unknown" in (tmp_path / "compare" / "compare.md").read_text()


def test_marl_eval_reads_it(tmp_path, capsys):
    for algo, world in itertools.product(("maddpg", "per_maddpg"), ("Grassland-v0", "HardSpread-v0")):
        runs_of(tmp_path / "logs", algo, world, (0, 1))
    compared(tmp_path, tmp_path / "logs", "--point", "best")
    raw = json.loads((tmp_path / "compare" / "marl_eval.json").read_text())
    assert list(raw) == ["sb3_kfcv"] and list(raw["sb3_kfcv"]) == ["grassland-v0", "hardspread-v0"]
    assert raw["sb3_kfcv"]["grassland-v0"]["per-maddpg"]["seed_1"] == {
        "step_0": {"step_count": 100, "reward": [2, 2]},
        "step_1": {"step_count": 200, "reward": [0.5, 1.5]},
        "absolute_metrics": {"reward": [2, 2]},
    }
    assert "marl-eval" not in capsys.readouterr().err
    runs_of(tmp_path / "logs", "per_maddpg", "HardSpread-v0", (9,), steps=(50, 100))
    toy_run(tmp_path / "logs", "maddpg", "HardSpread-v0", 5, steps=(100,), reward=[[1]])
    compared(tmp_path, tmp_path / "logs")
    raw = json.loads((tmp_path / "compare" / "marl_eval.json").read_text())
    assert list(raw) == ["grassland-v0", "hardspread-v0"]  # of other lengths, so no tasks of one environment
    assert list(raw["hardspread-v0"]["hardspread-v0"]["per-maddpg"]) == ["seed_0", "seed_1", "seed_0_3"]
    assert "note: HardSpread-v0: marl-eval wants the same seeds and as many evaluations of each" in capsys.readouterr().err


def test_marl_eval_refuses_commas_in_names_of_algorithms(tmp_path):
    for gamma in (0.9, 0.99):
        toy_run(tmp_path / "logs", config={"gamma": gamma})
    compared(tmp_path, tmp_path / "logs", "--group-by", "gamma")
    raw = json.loads((tmp_path / "compare" / "marl_eval.json").read_text())
    assert list(raw["sb3_kfcv"]["grassland-v0"]) == ["maddpg gamma 0.9", "maddpg gamma 0.99"]


def test_real_runs_are_drawn_and_compared(tmp_path, capsys):
    for algo, seed in itertools.product(("maddpg", "per_maddpg"), ("1", "2")):
        words = [
            "--algo",
            algo,
            "-n",
            "80",
            "--seed",
            seed,
            "-f",
            str(tmp_path / "logs"),
            "--verbose",
            "0",
            "--eval-freq",
            "40",
        ]
        words += ["--eval-episodes", "2", "--env-kwargs", "n_wolves:2", "n_sheep:2", "n_grass:1", "max_steps:5"]
        words += ["-params", "n_envs:2", "learning_starts:20", "batch_size:8", "buffer_size:200"]
        assert train.main([*words, "--log-interval", "8"]) == 0
    for words in (
        (),
        ("-y", "return_sheep", "-x", "time"),
        ("-y", "train/critic_loss", "-x", "episodes", "--group-by", "seed"),
    ):
        lines = draw(tmp_path, tmp_path / "logs", *words)["lines"]
        assert [len(line["runs"]) for line in lines] == ([1] * 4 if "seed" in words else [2, 2])
    found = compared(tmp_path, tmp_path / "logs", "--metric", "sheep_eaten")
    assert all(run["seconds"] > 0 for cell in found["worlds"]["Grassland-v0"].values() for run in cell["runs"])
    assert "differ in" not in capsys.readouterr().err
