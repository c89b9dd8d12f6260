"""Watching, filming and measuring, run in-process: whom the words mean, what is told and written, what is refused."""

import json
import shutil
import sys

import numpy as np
import pytest
from PIL import Image, ImageSequence
from scipy import stats
from toy_envs import ToyParallelEnv

from sb3_kfcv import MADDPG, load_normalization, make_vec_env
from sb3_kfcv.common.evaluation import Interval
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import layout_of
from tests.toy_runs import toy_run
from zoo import enjoy, evaluate, record_video, recording, train
from zoo.match_results import shown
from zoo.playing import require_pictures
from zoo.worlds import World

SIZES = {"n_wolves": 2, "n_sheep": 2, "n_grass": 1, "max_steps": 5}
WORLD = [f"{name}:{value}" for name, value in SIZES.items()]
PARAMS = ["n_envs:2", "learning_starts:20", "batch_size:8", "buffer_size:200"]


def train_run(folder, *more, params=()):
    words = ["--algo", "maddpg", "-n", "80", "--seed", "1", "-f", str(folder), "--verbose", "0", "--eval-freq", "40"]
    words += ["--eval-episodes", "2", "--save-freq", "40", "-params", *PARAMS, *params, "--env-kwargs", *WORLD, *more]
    assert train.main(words) == 0


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """maddpg: of all agents (1), of wolves that met grazing sheep (2), on normalised observations (3); and a co-training."""
    folder = tmp_path_factory.mktemp("here") / "logs"
    train_run(folder)
    train_run(folder, "--team", "wolf", "--opponents", "sheep:graze", "--player-freq", "40")
    train_run(folder, params=["normalize:true"])
    train_run(folder, "--team", "wolf=maddpg", "--team", "sheep=per_maddpg")
    return folder


def run(logs, number, algo="maddpg"):
    return logs / algo / f"Grassland-v0_{number}"


def measure(tmp_path, *words, n=4):
    """What the command writes as JSON: label → its entry."""
    file = tmp_path / "deep" / "measured.json"
    assert evaluate.main([*map(str, words), "-n", str(n), "--json", str(file)]) == 0
    content = json.loads(file.read_text())
    return {entry["player"]: entry for entry in content["players"]}


def played_by_hand(model, seeds, players=None):
    """Returns of wolves, one world and one episode after the other."""
    returns = []
    for seed in seeds:
        env = make_vec_env("Grassland-v0", 1, seed, SIZES)
        policy = model if players is None else TeamPolicy(layout_of(env), players, np.random.default_rng(0))
        rows, done = env.reset(), [False]
        while not done[0]:
            rows, _, done, infos = env.step(policy.predict(rows, deterministic=True)[0])
        returns.append(infos[0]["return_wolf"])
    return np.array(returns)


def test_numbers_are_those_of_episodes_played_by_hand(tmp_path, logs):
    entry = measure(tmp_path, run(logs, 1), "--seed", 7)["maddpg_1"]
    returns = played_by_hand(MADDPG.load(run(logs, 1) / "Grassland-v0.zip"), range(7, 11))
    half = stats.t.ppf(0.975, 3) * returns.std(ddof=1) / 2
    expected = {"mean": returns.mean(), "low": returns.mean() - half, "high": returns.mean() + half}
    assert entry["return_wolf"] == pytest.approx(expected, rel=1e-4)
    assert entry["length"]["mean"] <= 5
    assert 0 <= entry["won_wolf"]["low"] <= entry["won_wolf"]["high"] <= 1


def test_a_model_of_normalised_observations_sees_them_as_in_its_training(tmp_path, logs):
    path = run(logs, 3) / "Grassland-v0.zip"
    env = load_normalization(path, make_vec_env("Grassland-v0", env_kwargs=SIZES), training=False)
    model = MADDPG.load(path, env)
    returns = []
    for seed in range(4):
        env.seed(seed)
        rows, done = env.reset(), [False]
        while not done[0]:
            rows, _, done, infos = env.step(model.predict(rows, deterministic=True)[0])
        returns.append(infos[0]["return_wolf"])
    entry = measure(tmp_path, run(logs, 3))["maddpg_3"]
    assert entry["return_wolf"]["mean"] == pytest.approx(np.mean(returns), rel=1e-4)


def test_several_players_in_one_table_whatever_the_number_of_worlds(tmp_path, logs, capsys):
    words = [run(logs, 1), run(logs, 3), "random", run(logs, 1) / "Grassland-v0.zip", "--team", "sheep=flee"]
    one = measure(tmp_path, *words, "--n-envs", 1)
    printed = capsys.readouterr().out
    many = measure(tmp_path, *words, "--episodes", tmp_path / "all.npz")
    assert one == many
    assert list(many) == ["maddpg_1", "maddpg_3", "random"]  # the first one is named twice
    assert many["random"]["plays"] == {"wolf": "random", "sheep": "flee"}
    assert "player" in printed and "sheep: flee" in printed and "won_wolf" in printed
    with np.load(tmp_path / "all.npz", allow_pickle=False) as episodes:
        assert episodes["players"].tolist() == list(many)
        assert episodes["seeds"].tolist() == [0, 1, 2, 3]
        assert episodes["sheep_eaten"].shape == (3, 4)
        assert many["maddpg_3"]["return_sheep"]["mean"] == pytest.approx(episodes["return_sheep"][1].mean())


def test_opponents_are_those_of_the_training_unless_others_are_named(tmp_path, logs):
    wolves = MADDPG.load(run(logs, 2) / "Grassland-v0.zip")
    for flags, sheep in (([], "graze"), (["--team", "sheep=flee"], "flee")):
        entry = measure(tmp_path, run(logs, 2), *flags)["maddpg_2"]
        assert entry["return_wolf"]["mean"] == pytest.approx(
            played_by_hand(None, range(4), {"wolf": wolves, "sheep": sheep}).mean(), rel=1e-4
        )
    player = run(logs, 2) / "players" / "wolf_80_steps.zip"  # holds no opponents; its run knows them
    assert (
        measure(tmp_path, player)["maddpg_2@80"]["return_wolf"] == measure(tmp_path, run(logs, 2))["maddpg_2"]["return_wolf"]
    )


def test_all_teams_of_a_co_training_play(tmp_path, logs):
    both = run(logs, 1, "co_training")
    entry = measure(tmp_path, both)["co_training_1"]
    against_itself = measure(tmp_path, "--team", f"wolf={both}", f"sheep={both}")["co_training_1, co_training_1"]
    assert entry["return_wolf"] == against_itself["return_wolf"]
    best = measure(tmp_path, both, "--load-best")["co_training_1 best"]["plays"]
    assert {group: path.rpartition("/")[2] for group, path in best.items()} == {
        "wolf": "best_wolf.zip",
        "sheep": "best_sheep.zip",
    }


def test_which_model_of_a_run(tmp_path, logs):
    def file(*flags):
        (entry,) = measure(tmp_path, "-f", logs, *flags, "--algo", "maddpg", "--exp-id", 1, n=1).values()
        return entry["plays"]["wolf"].rpartition("/")[2]

    assert file() == "Grassland-v0.zip"
    assert file("--load-best") == "best_model.zip"
    assert file("--load-checkpoint", "40") == "rl_model_40_steps.zip"
    assert file("--load-last-checkpoint") == "rl_model_80_steps.zip"


def test_settings_of_the_world_come_from_the_run_and_can_be_changed(tmp_path, logs, capsys):
    assert measure(tmp_path, run(logs, 1), "--env-kwargs", "max_steps:3")["maddpg_1"]["length"]["high"] <= 3
    capsys.readouterr()
    assert list(measure(tmp_path, logs / "maddpg", "--metrics", "sheep_eaten", n=2)) == ["maddpg_1", "maddpg_2", "maddpg_3"]
    head = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("player"))
    assert head.split() == ["player", "sheep_eaten"]


def test_scripted_players_of_every_kind_of_world(tmp_path):
    spread = measure(tmp_path, "oracle", "random", "--env", "HardSpread-v0", "--env-kwargs", "max_steps:30", n=3)
    assert spread["oracle"]["return_agent"]["mean"] > spread["random"]["return_agent"]["mean"]
    tag = measure(tmp_path, "random", "--env", "mpe2/simple_tag_v3", "--env-kwargs", "max_cycles:4", n=2)
    assert tag["random"]["length"]["mean"] == 4
    assert {"return_adversary", "return_agent"} < set(tag["random"])


def test_enjoy_tells_what_evaluate_counts(tmp_path, logs, monkeypatch, capsys):
    monkeypatch.chdir(logs.parent)
    words = ["--algo", "maddpg", "--exp-id", "1", "--seed", "3", "-n", "3"]
    assert enjoy.main([*words, "--no-render", "--metrics", "return_wolf", "length"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "Grassland-v0: maddpg_1"
    assert lines[1].split() == ["episode", "seed", "return_wolf", "length"]
    told = [float(line.split()[2]) for line in lines[2:5]]
    assert [line.split()[1] for line in lines[2:5]] == ["3", "4", "5"]
    counted = measure(tmp_path, *words, n=3)["maddpg_1"]["return_wolf"]
    assert np.mean(told) == pytest.approx(counted["mean"], abs=0.01)
    assert any(line.startswith("return_wolf") and f"{counted['low']:.2f}" in line for line in lines[5:])


class FakeWindow:
    """
    Stands in for a window.

    :param closes_after: pictures, after which somebody closes it
    """

    def __init__(self, is_visible=True, closes_after=10**6, error=None):
        self.is_visible, self.closes_after, self.error = is_visible, closes_after, error
        self.pictures, self.was_closed = [], False

    def __call__(self, title, fps):
        self.title, self.fps = title, fps
        return self

    def show(self, picture):
        self.pictures.append(picture)
        if self.error is not None:
            raise self.error

    @property
    def is_closed(self):
        return len(self.pictures) >= self.closes_after

    def close(self):
        self.was_closed = True


def watch_in(window, monkeypatch, logs, *words):
    monkeypatch.setattr(enjoy, "Window", window)
    return enjoy.main([str(run(logs, 1)), "-n", "3", *words])


def test_a_window_shows_every_step(monkeypatch, logs, capsys):
    window = FakeWindow()
    assert watch_in(window, monkeypatch, logs, "--fps", "4", "--metrics", "length") == 0
    lengths = [int(float(line.split()[2])) for line in capsys.readouterr().out.splitlines()[2:5]]
    assert len(window.pictures) == sum(lengths) + 3  # and what each starts from
    assert window.title == "Grassland-v0: maddpg_1"
    assert (window.fps, window.was_closed) == (4, True)


def test_closing_the_window_ends_it(monkeypatch, logs, capsys):
    window = FakeWindow(closes_after=8)  # in the second episode
    assert watch_in(window, monkeypatch, logs) == 0
    assert "the window was closed" in (printed := capsys.readouterr().out)
    assert "means over 1 episode, seed 0" in printed


def test_ctrl_c_ends_it(monkeypatch, logs, capsys):
    window = FakeWindow(error=KeyboardInterrupt())
    assert watch_in(window, monkeypatch, logs) == 130
    assert window.was_closed
    assert capsys.readouterr().err == "interrupted\n"


def test_without_a_display_it_says_so_and_plays_on(monkeypatch, logs, capsys):
    window = FakeWindow(is_visible=False)
    assert watch_in(window, monkeypatch, logs) == 0
    printed = capsys.readouterr()
    assert "there is no display" in printed.err
    assert not window.pictures and "means over 3 episodes" in printed.out


def frames_of(path):
    with Image.open(path) as image:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]


def test_a_film_of_a_grid(tmp_path, logs, capsys):
    file = tmp_path / "films" / "wolves.gif"
    assert record_video.main([str(run(logs, 1)), "--grid", "2x3", "-o", str(file)]) == 0
    frames = frames_of(file)
    tile = recording.WIDTH // 3
    assert frames[0].shape[1] == 3 * (tile + recording.GAP) + recording.GAP
    assert len(frames) == 6  # of five steps and what they start from; the last one stands still
    assert "6 episodes, seeds 0 to 5" in capsys.readouterr().out


def test_a_film_by_default_lies_in_the_folder_of_the_run(tmp_path, logs):
    here = shutil.copytree(run(logs, 2), tmp_path / "maddpg" / "Grassland-v0_2")
    assert record_video.main([str(here), "-n", "2", "--seed", "4"]) == 0
    name = "Grassland-v0-wolf-maddpg_2-sheep-graze-seed-4"
    assert {path.name for path in (here / "videos").iterdir()} == {f"{name}.gif", f"{name}.mp4"}
    assert (here / "videos" / f"{name}.mp4").read_bytes()[4:8] == b"ftyp"


def test_worlds_that_are_over_stand_still_with_their_final_score():
    """Chasing wolves eat these grazing sheep in different numbers of steps."""
    env = make_vec_env("Grassland-v0", 4, env_kwargs={**SIZES, "max_steps": 25, "render_mode": "rgb_array"})
    arena, still = recording.Arena(env), [[] for _ in range(4)]

    def note(picture):
        for tile, score, seen in zip(camera._tiles, camera._scores, still, strict=True):
            if score.is_over:
                seen.append(np.asarray(tile))

    camera = recording.Camera(arena, ["title"], note)
    episodes = arena.play({"wolf": "chase", "sheep": "graze"}, 4, 2, watch=camera)
    assert len(set(episodes.lengths.tolist())) > 1
    for i, score in enumerate(camera._scores):
        assert score.steps == episodes.lengths[i]
        assert score.returns[:2].mean() == pytest.approx(episodes.returns["wolf"][i], abs=1e-4)
        assert score.metrics["sheep_eaten"] == episodes.metrics["sheep_eaten"][i]
        assert len(still[i]) == episodes.lengths.max() - episodes.lengths[i] + 1
        for tile in still[i][1:]:
            np.testing.assert_array_equal(tile, still[i][0])
    assert camera._verdict({"wolves_win": 1.0}) == "wolf wins"
    assert camera._verdict({"wolves_win": 0.0}) == "sheep wins"


def test_a_film_is_as_long_as_its_longest_episode():
    env = make_vec_env("Grassland-v0", 3, env_kwargs={**SIZES, "max_steps": 25, "render_mode": "rgb_array"})
    frames, episodes = recording.film(recording.Arena(env), {"wolf": "chase", "sheep": "graze"}, ["title"], seed=2)
    assert len(frames) == episodes.lengths.max() + 1 + recording.PAUSE
    assert len({frame.shape for frame in frames}) == 1
    assert all(side % 2 == 0 for side in frames[0].shape[:2])  # or there is no MP4


def test_worlds_that_draw_themselves(tmp_path):
    """One of mpe2, whose last picture is that of the end, not of the next beginning."""
    words = ["random", "--env", "mpe2/simple_spread_v3", "--env-kwargs", "max_cycles:3", "-n", "2"]
    assert record_video.main([*words, "-o", str(tmp_path / "spread.gif")]) == 0
    assert len(frames_of(tmp_path / "spread.gif")) == 4
    env = make_vec_env("mpe2/simple_spread_v3", env_kwargs={"max_cycles": 1, "render_mode": "rgb_array"}, seed=0)
    env.reset()
    _, _, _, (info,) = env.step(np.array([env.action_space.sample()]))
    assert (info["terminal_picture"] != env.get_images()[0]).any()


@pytest.mark.parametrize(("fps", "own", "milliseconds"), [(10, 10, 100), (30, 100 / 3, 30), (50, 50, 20), (1000, 50, 20)])
def test_a_gif_is_as_fast_as_gifs_can_be(tmp_path, fps, own, milliseconds):
    assert recording.gif_fps(fps) == pytest.approx(own)
    recording.save_gif([np.full((4, 4, 3), 60 * i, dtype=np.uint8) for i in range(3)], tmp_path / "x.gif", fps)
    with Image.open(tmp_path / "x.gif") as film:
        assert [frame.info["duration"] for frame in ImageSequence.Iterator(film)] == [milliseconds] * 3


def test_the_length_that_is_told_is_that_of_the_file(tmp_path, logs, capsys):
    file = tmp_path / "x.gif"
    assert record_video.main([str(run(logs, 1)), "-n", "1", "-o", str(file), "--fps", "200"]) == 0
    told = capsys.readouterr()
    with Image.open(file) as film:
        seconds = sum(frame.info["duration"] for frame in ImageSequence.Iterator(film)) / 1000
    assert f", {seconds:.1f} s, " in told.out and seconds >= 0.2
    assert told.err == f"note: {file}: a GIF shows 50 frames per second at most, not 200\n"


def test_a_disk_that_is_full_in_the_end_is_told_in_one_sentence(tmp_path, logs, monkeypatch, capsys):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(evaluate, "write_json", full)
    assert evaluate.main([str(run(logs, 1)), "-n", "1", "--json", str(tmp_path / "x.json")]) == 2
    told = capsys.readouterr()
    assert told.err == f"error: {tmp_path / 'x.json'} cannot be written: No space left on device\n"
    assert "return_wolf" in told.out


def test_nothing_is_shown_as_minus_zero():
    assert shown(Interval(-0.001, -0.004, 0.002)) == "0.00 [0.00, 0.00]"
    assert shown(Interval(-0.04, -0.06, -0.02), 1) == "0.0 [-0.1, 0.0]"
    assert str(Interval(-0.001, -0.011, 0.009)) == "0.00 ± 0.01"


def test_a_world_that_draws_nothing_is_refused():
    arena = recording.Arena(make_vec_env(ToyParallelEnv))
    with pytest.raises(ValueError, match=r"toy draws no pictures; zoo/enjoy\.py --no-render tells its numbers"):
        require_pictures(World("toy"), arena)


def test_runs_of_different_settings_are_noted(tmp_path, logs, capsys):
    train_run(tmp_path, "max_steps:4")
    measure(tmp_path, run(logs, 1), run(tmp_path, 1))
    assert f"note: {run(tmp_path, 1)} was trained in another Grassland-v0; all play as in the first" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("n", "grid"), [(1, (1, 1)), (2, (1, 2)), (3, (1, 3)), (4, (2, 2)), (5, (2, 3)), (7, (3, 3)), (12, (3, 4))]
)
def test_grids_hold_their_tiles(n, grid):
    assert recording.grid_for(n) == grid


@pytest.fixture(scope="module")
def bad(tmp_path_factory, logs):
    """A damaged model, one of another world, one outside of any run, and a run that has nothing yet."""
    folder = tmp_path_factory.mktemp("bad")
    content = bytearray((run(logs, 1) / "Grassland-v0.zip").read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "damaged.zip").write_bytes(content)
    shutil.copy(run(logs, 2) / "players" / "wolf_80_steps.zip", folder / "alone.zip")
    other = make_vec_env("Grassland-v0", env_kwargs={"n_wolves": 1, "n_sheep": 1})
    MADDPG("MlpPolicy", other, buffer_size=100, learning_starts=1, batch_size=2).save(folder / "other.zip")
    (folder / "folder.json").mkdir()
    for world in ("Grassland-v0", "HardSpread-v0"):
        toy_run(folder / "worlds", env=world)
    shutil.copytree(run(logs, 1) / "Grassland-v0", folder / "begun" / "maddpg" / "Grassland-v0_1" / "Grassland-v0")
    return folder


REFUSED = [
    (evaluate, "-f {tmp}/nothing", "there is no run in {tmp}/nothing; train one with zoo/train.py"),
    (
        evaluate,
        "-f {logs} --algo madpg",
        'there is no run of it: unknown algorithm of the runs "madpg"; did you mean "maddpg"?',
    ),
    (evaluate, "-f {logs} --env Graslnd-v0", 'there is no run of it: unknown environment of the runs "Graslnd-v0"'),
    (evaluate, "-f {logs} --exp-id 9", "no run in {logs} fits; there are"),
    (evaluate, "chase --env Graslnd-v0", 'unknown environment "Graslnd-v0"; did you mean "Grassland-v0"?'),
    (evaluate, "chase", "say with --env in which world chase is to play"),
    (evaluate, "{tmp}/alone.zip", "say with --env in which world {tmp}/alone.zip is to play"),
    (evaluate, "{tmp}/alone.zip --env Grassland-v0 {world}", "nobody plays sheep beside alone: add --team sheep=random"),
    (evaluate, "chase --env Grassland-v0", "nobody plays sheep beside chase: add --team sheep=random"),
    (evaluate, "chaise --env Grassland-v0", 'unknown scripted policy of \'wolf\' "chaise"; did you mean "chase"?'),
    (evaluate, "{one} --exp-id 2", "--exp-id picks a run of -f, and {one} is named; leave out the one or the other"),
    (evaluate, "{logs} --algo ddpg", "there is no run of ddpg below {logs}; there is "),
    (
        evaluate,
        "{logs} --env mpe2/simple_spread_v3",
        "there is no run in mpe2/simple_spread_v3 below {logs}; there is ",
    ),
    (evaluate, "{one} --algo kfcv_maddpg", "there is no run of kfcv_maddpg below {one}; there is maddpg in Grassland-v0"),
    (evaluate, "{one}/transitions", "there is no run of zoo/train.py in {one}/transitions"),
    (evaluate, "{tmp}/nothing.zip", "there is no file {tmp}/nothing.zip to take a player of"),
    (evaluate, "{logs}/maddpg/Grassland-v0_9", 'unknown run folder "{logs}/maddpg/Grassland-v0_9"; did you mean'),
    (evaluate, "{tmp}/no*.zip", 'no file and no folder matches "{tmp}/no*.zip"'),
    (evaluate, "{tmp}/begun", "has no model and no checkpoint yet"),
    (evaluate, "{tmp}/begun --load-best", "has no best_wolf.zip and no best_model.zip yet"),
    (evaluate, "{tmp}/begun --load-last-checkpoint", "has no checkpoint yet"),
    (evaluate, "{one} --load-checkpoint 50", "has no checkpoint of 50 env steps; there are 40, 80"),
    (evaluate, "{one} --load-best --load-last-checkpoint", "--load-best and --load-last-checkpoint exclude each other"),
    (evaluate, "{tmp}/damaged.zip --env Grassland-v0 {world}", "damaged"),
    (evaluate, "{one} {tmp}/other.zip", "is for another world: 1 wolf"),
    (evaluate, "{one} --env HardSpread-v0", "is for another world: 2 wolf"),
    (evaluate, "{one} --team sheep", 'Grassland-v0: --team takes GROUP=PLAYER, such as wolf=random; got "sheep"'),
    (evaluate, "{one} --team sheap=graze", 'Grassland-v0: unknown group "sheap"; did you mean "sheep"?'),
    (evaluate, "{one} --team sheep=graze sheep=flee", "--team says twice who plays sheep"),
    (evaluate, "{one} --team sheep=graze wolf=chase", "--team says who plays every group; leave out {one}"),
    (evaluate, "{two} --team wolf=chase", "plays wolf, whom --team gives to others; wanted is a player of sheep"),
    (evaluate, "{one} --metrics won_wolves", 'unknown metric "won_wolves"; did you mean "won_wolf"?'),
    (evaluate, "{one} --env-kwargs max_step:3", 'unknown setting of Grassland-v0 "max_step"; did you mean "max_steps"?'),
    (evaluate, "{one} -n 0", "-n must be a whole number of at least 1, got 0"),
    (evaluate, "{one} --seed -1", "--seed must be a whole number of at least 0, got -1"),
    (evaluate, "{one} --jsn x", 'unknown flag "--jsn"; did you mean "--json"?'),
    (evaluate, "{one} --json table.txt", "--json writes a file that ends in .json, not table.txt"),
    (evaluate, "{one} --json {tmp}/damaged.zip/x.json", "{tmp}/damaged.zip/x.json cannot be written: "),
    (evaluate, "{one} --json {tmp}/folder.json", "{tmp}/folder.json cannot be written: Is a directory"),
    (evaluate, "{one} --json /proc/x.json", "/proc/x.json cannot be written: "),
    (evaluate, "{tmp}/worlds", "the runs are of several worlds; say with --env in which to play: Grassland-v0, HardSpread-v0"),
    (evaluate, "{tmp}/alone.zop", 'there is no file {tmp}/alone.zop to take a player of; did you mean "{tmp}/alone.zip"?'),
    (evaluate, "alone.zop", "there is no file alone.zop to take a player of"),
    (evaluate, "{one} --team wolf=alone.zop", "there is no file alone.zop to take a player of"),
    (enjoy, "{one} {two}", "name one player to watch, not maddpg_1, maddpg_2; against each other they play by --team"),
    (enjoy, "{one} -n 0", "-n must be a whole number of at least 1, got 0"),
    (enjoy, "{one} --fps 0", "--fps must be above 0, got 0.0"),
    (enjoy, "{one} --stochastic --deterministic", "--deterministic and --stochastic exclude each other"),
    (enjoy, "{one} --metrics eaten", 'unknown metric "eaten"; did you mean "sheep_eaten"?'),
    (record_video, "{one} -o wolves.giv", "wolves.giv: a film ends in .mp4 or .gif"),
    (record_video, "{one} -o {tmp}/damaged.zip/x.gif", "{tmp}/damaged.zip/x.gif cannot be written: "),
    (record_video, "{one} -o wolves.avi", "wolves.avi: a film ends in .mp4 or .gif"),
    (record_video, "{one} -o /proc/x.gif", "/proc/x.gif cannot be written: "),
    (record_video, "{one} --fps inf", "--fps must be above 0 and at most 1000, got inf"),
    (record_video, "{one} --grid 2+3", '--grid takes ROWSxCOLUMNS, such as 2x3; got "2+3"'),
    (record_video, "{one} --grid 2x2 -n 5", "--grid 2x2 holds 4 episodes, not 5"),
    (record_video, "{one} -n 0", "-n must be a whole number of at least 1, got 0"),
    (record_video, "{logs}", "name one player to watch, not"),
]


@pytest.mark.parametrize(("command", "words", "message"), REFUSED, ids=[words for _, words, _ in REFUSED])
def test_refused_in_one_sentence_before_anything_is_played(tmp_path, logs, bad, monkeypatch, capsys, command, words, message):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(recording.Arena, "play", None)
    names = {"logs": logs, "tmp": bad, "one": run(logs, 1), "two": run(logs, 2)}
    given = words.format(**names, world=" ".join(["--env-kwargs", *WORLD])).split()
    assert command.main(given) == 2
    *notes, error = capsys.readouterr().err.splitlines()
    assert error.startswith("error: ")
    assert message.format(**names) in error
    assert all(line.startswith("note: ") for line in notes)
    assert not list(tmp_path.rglob("*"))


def test_without_moviepy_there_is_a_gif(tmp_path, logs, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "moviepy", None)
    one = str(run(logs, 1))
    assert record_video.main([one, "-o", str(tmp_path / "x.mp4")]) == 2
    assert 'MP4 needs moviepy: pip install "sb3-kfcv[video]"' in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    here = shutil.copytree(one, tmp_path / "maddpg" / "Grassland-v0_1")
    assert record_video.main([str(here), "-n", "1"]) == 0
    assert [path.suffix for path in (here / "videos").iterdir()] == [".gif"]
    assert capsys.readouterr().err.startswith("note: no MP4: MP4 needs moviepy")
