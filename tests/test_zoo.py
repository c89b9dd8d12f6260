"""The training script, run in-process: what it writes, what it refuses, how it stops and goes on."""

import csv
import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_kfcv import ALGOS, KFCVMADDPG, make_vec_env
from sb3_kfcv.common.callbacks import StopOnSignal, TrainByTheClock
from sb3_kfcv.common.evaluation import evaluate, with_interval
from sb3_kfcv.saving.checkpoints import checkpoints_in
from sb3_kfcv.saving.normalization import load_normalization
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import WORLDS, layout_of
from sb3_kfcv.vec_env.subproc import TracedSubprocVecEnv
from zoo import demo, train
from zoo.hyperparams import check, load_entry, merged, parse_pairs
from zoo.run_folder import RunFolder
from zoo.runs import find_runs

ROOT = Path(__file__).resolve().parents[1]

SMALL = {
    "Grassland-v0": ["n_wolves:2", "n_sheep:2", "n_grass:1", "max_steps:5"],
    "HardSpread-v0": ["n_agents:2", "max_steps:5"],
}
TINY = ["n_envs:2", "learning_starts:20", "batch_size:8", "buffer_size:200"]
TINY_KFCV = ["replay_buffer_kwargs.first_teacher_steps:2", "replay_buffer_kwargs.teacher_batch_size:8"]


def command(folder, env="Grassland-v0", algo="maddpg", *more, params=(), steps=120):
    """A tiny run."""
    kfcv = TINY_KFCV if algo == "kfcv_maddpg" else []
    return [
        *("--algo", algo, "--env", env, "-n", str(steps), "--seed", "1", "-f", str(folder), "--verbose", "0"),
        *("--eval-freq", "60", "--eval-episodes", "3", "--log-interval", "8"),
        *("-params", *TINY, *kfcv, *params, "--env-kwargs", *SMALL[env], *more),
    ]


def run_folder(folder, env="Grassland-v0", algo="maddpg", number=1):
    return RunFolder(folder / algo / f"{env}_{number}", env)


def tags(path):
    events = EventAccumulator(str(path))
    events.Reload()
    return events.Tags()


class InterruptAt(BaseCallback):
    """What a second Ctrl-C does."""

    def __init__(self, steps):
        super().__init__()
        self.steps = steps

    def _on_step(self):
        if self.num_timesteps >= self.steps:
            raise KeyboardInterrupt
        return True


class SignalAt(InterruptAt):
    """What Ctrl-C or ``kill`` do."""

    def __init__(self, steps, number):
        super().__init__(steps)
        self.number = number

    def _on_step(self):
        if self.num_timesteps == self.steps:
            os.kill(os.getpid(), self.number)
        return True


@pytest.mark.parametrize("algo", ALGOS)
@pytest.mark.parametrize("env", WORLDS)
def test_a_run_leaves_everything_in_its_folder(tmp_path, algo, env):
    assert train.main(command(tmp_path, env, algo, "--save-freq", "60", "--save-replay-buffer")) == 0

    run = run_folder(tmp_path, env, algo)
    files = {path.name for path in run.path.iterdir() if not path.name.startswith("events.out")}
    expected = {f"{env}.zip", env, "best_model.zip", "transitions", "replay_buffer.zip"}
    expected |= {"rl_model_60_steps.zip", "rl_model_120_steps.zip"}
    assert files == expected | {"evaluations.npz", "0.monitor.csv", ".lock"}

    settings = {path.name for path in run.config_file.parent.iterdir()}
    assert settings == {"config.yml", "args.yml", "command.txt", "versions.json"}
    config = yaml.safe_load(run.config_file.read_text())
    assert (config["n_timesteps"], config["n_envs"], config["batch_size"], config["tau"]) == (120, 2, 8, 0.01)
    assert yaml.safe_load(run.config_file.with_name("args.yml").read_text())["seed"] == 1
    assert f"--algo {algo}" in run.config_file.with_name("command.txt").read_text()
    assert "torch" in json.loads(run.config_file.with_name("versions.json").read_text())

    model = ALGOS[algo].load(run.last_model)
    assert model.num_timesteps == 120


@pytest.mark.parametrize("env", WORLDS)
def test_evaluations_and_monitor_hold_every_metric(tmp_path, env):
    train.main(command(tmp_path, env))
    run = run_folder(tmp_path, env)
    metrics = make_vec_env(env).get_attr("metric_names")[0]

    with np.load(run.path / "evaluations.npz", allow_pickle=False) as evaluations:
        assert evaluations["timesteps"].tolist() == [60, 120]
        for name in ("results", "ep_lengths", *metrics):
            assert evaluations[name].shape == (2, 3), name
        group = "wolf" if env == "Grassland-v0" else "agent"
        np.testing.assert_allclose(evaluations["results"], evaluations[f"return_{group}"], rtol=1e-4)

    lines = run.monitor_file.read_text().splitlines()
    assert json.loads(lines[0].removeprefix("#"))["env_id"] == env
    rows = list(csv.DictReader(lines[1:]))
    assert set(rows[0]) == {"r", "l", "t", *metrics}
    assert len(rows) >= 24  # 120 env steps in episodes of at most 5


@pytest.mark.parametrize("env", WORLDS)
def test_tensorboard_holds_every_series(tmp_path, env):
    train.main(command(tmp_path, env, "kfcv_maddpg"))
    seen = tags(run_folder(tmp_path, env, "kfcv_maddpg").path)
    layout, metrics = (make_vec_env(env).get_attr(name)[0] for name in ("layout", "metric_names"))
    promised = {"eval/mean_reward", "eval/mean_ep_length", "rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps"}
    promised |= {f"{part}/return_{group}" for part in ("rollout", "eval") for group in layout.group_names}
    promised |= {f"{part}/{metric}" for part in ("rollout", "eval") for metric in metrics}
    promised |= {f"train/{name}" for name in ("critic_loss", "actor_loss", "q_target", "action_saturation", "learning_rate")}
    promised |= {f"train/{name}" for name in ("critic_grad_norm", "actor_grad_norm")}
    promised |= {f"curriculum/{name}" for name in ("stage", "lambda", "refreshes", "unscored", "teacher_loss_held_out")}
    promised |= {f"curriculum/{name}" for name in ("teacher_loss_in_fold", "rank_correlation_with_student")}
    promised |= {f"curriculum/{name}_bucket_{k}" for name in ("share",) for k in range(1, 6)}
    promised |= {"time/update_seconds", "time/refresh_seconds"}
    assert promised - set(seen["scalars"]) == set()
    assert "curriculum/scores" in seen["histograms"]


def test_prioritised_replay_is_logged(tmp_path):
    train.main(command(tmp_path, algo="per_maddpg"))
    seen = tags(run_folder(tmp_path, algo="per_maddpg").path)
    assert {"per/beta", "per/not_yet_replayed", "per/td_error_median"} <= set(seen["scalars"])


def test_tensorboard_goes_elsewhere_or_nowhere(tmp_path):
    train.main(command(tmp_path, "Grassland-v0", "maddpg", "-tb", str(tmp_path / "tb")))
    train.main(command(tmp_path, "Grassland-v0", "maddpg", "-tb", ""))
    assert "rollout/return_wolf" in tags(tmp_path / "tb" / "Grassland-v0" / "maddpg_1")["scalars"]
    assert not list(tmp_path.glob("maddpg/*/events*"))


def test_two_starts_get_two_folders(tmp_path):
    folders = [RunFolder.create(tmp_path, "maddpg", "Grassland-v0") for _ in range(2)]
    assert [folder.number for folder in folders] == [1, 2]
    assert RunFolder.create(tmp_path, "maddpg", "space/World-v0").path.name == "space-World-v0_1"


def test_a_stopped_run_prints_how_it_goes_on(tmp_path, capsys):
    stopped = train.main(command(tmp_path, steps=200), [SignalAt(100, signal.SIGINT)])
    assert stopped == 130
    printed = capsys.readouterr().out
    assert "the last checkpoint is of 100 env steps" in printed
    python, script, *words = shlex.split(printed.rpartition("to go on: ")[2])
    assert (Path(python).absolute(), Path(script).resolve()) == (Path(sys.executable), Path(train.__file__).resolve())
    assert not run_folder(tmp_path).last_model.exists()

    assert train.main(words) == 0
    assert "trained 200 env steps" in capsys.readouterr().out
    assert ALGOS["maddpg"].load(run_folder(tmp_path).last_model).num_timesteps == 200


def test_a_finished_run_asks_how_many_more(tmp_path, capsys):
    train.main(command(tmp_path, steps=20))
    again = ["--algo", "maddpg", "-i", str(run_folder(tmp_path).last_model), "-f", str(tmp_path)]
    assert train.main(again) == 2
    assert "has its 20 env steps already; say with -n how many more" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_with_a_checkpoint_and_its_number(tmp_path, number):
    handlers = [signal.getsignal(number) for number in StopOnSignal.SIGNALS]
    words = command(tmp_path, "Grassland-v0", "maddpg", "--save-freq", "-1")
    assert train.main(words, [SignalAt(60, number)]) == 128 + number
    assert list(checkpoints_in(run_folder(tmp_path).path)) == [60]
    assert [signal.getsignal(number) for number in StopOnSignal.SIGNALS] == handlers


def test_a_second_signal_stops_at_once(tmp_path, capsys):
    assert train.main(command(tmp_path), [InterruptAt(60)]) == 130
    assert "no checkpoint was saved yet; to start again: " in capsys.readouterr().out


BAD_INPUT = [
    ("--env Graslnd-v0", 'unknown environment "Graslnd-v0"; did you mean "Grassland-v0"?'),
    ("--env CartPole-v1", "has no entry for CartPole-v1, only Grassland-v0, HardSpread-v0"),
    ("--algo madpg", 'unknown algorithm "madpg"; did you mean "maddpg"?'),
    ("--sed 3", 'unknown flag "--sed"; did you mean "--seed"?'),
    ("-n many", '"many" is no whole number'),
    ("--device gpu", '"gpu" is no device'),
    ("--preset tunned", 'unknown preset "tunned"; did you mean "tuned"?'),
    ("--conf-file nope.yml", "cannot read nope.yml: No such file or directory"),
    ("-i nope.zip", "there is no model nope.zip"),
    ("-params gama:0.9", 'unknown hyperparameter "gama"; did you mean "gamma"?'),
    ("-params gamma", '-params takes key:value, such as gamma:0.95; got "gamma"'),
    ("-params gamma:high", "hyperparameter gamma is 'high'; it must be a number"),
    ("-params gamma:true", "hyperparameter gamma is True; it must be a number"),
    ("-params batch_size:12.5", "hyperparameter batch_size is 12.5; it must be a whole number"),
    ("-params batch_size:10000", "batch_size=10000 is larger than buffer_size=5000"),
    ("-params n_envs:0", "hyperparameter n_envs is 0; it must be at least 1"),
    ("-params seed:3", "seed is no hyperparameter: give it with --seed"),
    ("-params policy:CnnPolicy", 'unknown policy "CnnPolicy"; did you mean "MlpPolicy"?'),
    ("-params learning_rate:lin_x", 'learning_rate is "lin_x"; it must be a number, or a linear schedule such as lin_1e-3'),
    ("-params policy_kwargs.n_critic:2", 'unknown setting of policy_kwargs "n_critic"; did you mean "n_critics"?'),
    ("-params policy_kwargs.activation_fn:relux", "activation_fn is 'relux'; it must be one of relu, tanh"),
    ("-params replay_buffer_kwargs.n_fold:3", 'unknown setting of replay_buffer_kwargs (KFCVReplayBuffer) "n_fold"'),
    ("-params replay_buffer_kwargs.n_folds:x", "n_folds is 'x'; it must be a whole number"),
    ("-params replay_buffer_kwargs.n_folds:6000", "n_folds must lie between 2 and the buffer's"),
    ("--algo maddpg -params replay_buffer_kwargs.alpha:0.7", "unknown setting of replay_buffer_kwargs (JointReplayBuffer)"),
    ("-params normalize.norm_reward:true", "norm_reward: true cannot reach the agents' own rewards"),
    ("--env-kwargs n_wolfs:3", 'unknown setting of Grassland-v0 "n_wolfs"; did you mean "n_wolves"?'),
    ("--env-kwargs n_wolves:many", "setting of Grassland-v0 n_wolves is 'many'; it must be a whole number"),
    ("--env-kwargs n_wolves:0", "n_wolves is 0; it must be at least 1"),
    ("--env HardSpread-v0 --env-kwargs walls:3", "walls is 3; it must be text or a list of lists of numbers"),
    ("--eval-env-kwargs n_wolves:3", "make a world whose agents are not those of the training"),
    ("--team wolf --opponents sheep:fle", 'did you mean "flee"?'),
    ("--eval-episodes 0", "--eval-episodes is 0; it must be at least 1"),
    ("--env mpe2/simple_tg_v3", 'unknown environment "mpe2/simple_tg_v3"; did you mean "mpe2/simple_tag_v3"?'),
    ("--env classic/rps_v2", "has no entry for classic/rps_v2, only Grassland-v0, HardSpread-v0"),
    ("--vec-env many", "argument --vec-env: invalid choice: 'many'"),
    ("-params env_wrapper:os.system", 'env_wrapper "os.system" is no wrapper of SuperSuit'),
    ("-params env_wrapper:supersuit.frame_stak_v2", 'did you mean "supersuit.frame_stack_v2"?'),
    ("-params env_wrapper:3", "hyperparameter env_wrapper is 3; it must be text or a map or a list or null"),
]


@pytest.mark.parametrize(("words", "sentence"), BAD_INPUT, ids=[words for words, _ in BAD_INPUT])
def test_bad_input_gets_one_sentence_and_leaves_nothing(tmp_path, capsys, words, sentence):
    assert train.main(["-f", str(tmp_path / "logs"), *words.split()]) == 2
    printed = capsys.readouterr().err
    assert sentence in printed
    assert printed.startswith("error: ") and printed.count("\n") == 1
    assert not (tmp_path / "logs").exists()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("Grassland-v0: [1", "is no valid YAML"),
        ("- 1", "holds no map of settings"),
        ("Grassland-v0: 3", "it must be a map"),
        ("Grassland-v0: {n_timesteps: 10, n_envs: 1, bufer_size: 3}", 'did you mean "buffer_size"?'),
        ("Grassland-v0: {n_envs: 1}", "hyperparameter n_timesteps is missing"),
        ("Grassland-v0: !!python/object/apply:os.getcwd []", "is no valid YAML"),
        ("Grassland-v0: {gamma: 0.9}\nGrassland-v0: {gamma: 0.99}", 'is no valid YAML: "Grassland-v0" stands there twice in'),
        ("Grassland-v0: {gamma: 0.9, tau: 0.1, gamma: 0.99}", '"gamma" stands there twice in'),
    ],
)
def test_bad_yaml_gets_one_sentence(tmp_path, capsys, text, sentence):
    (tmp_path / "my.yml").write_text(text)
    assert train.main(["-f", str(tmp_path / "logs"), "-conf", str(tmp_path / "my.yml")]) == 2
    printed = capsys.readouterr().err
    assert sentence in printed and printed.count("\n") == 1


def test_the_script_runs_from_the_repository_root(tmp_path):
    words = [sys.executable, "zoo/train.py", "-f", str(tmp_path), "--algo", "madpg"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == 'error: unknown algorithm "madpg"; did you mean "maddpg"?\n'


@pytest.mark.parametrize("preset", ["default", "tuned"])
@pytest.mark.parametrize("algo", ALGOS)
@pytest.mark.parametrize("env", WORLDS)
def test_shipped_settings_are_valid(algo, env, preset):
    settings = check(algo, env, load_entry(algo, env, preset=preset))
    assert check(algo, env, settings.to_dict()) == settings


@pytest.mark.parametrize("algo", ALGOS)
@pytest.mark.parametrize("env", WORLDS)
def test_default_settings_are_those_of_table_1(algo, env):
    settings = check(algo, env, load_entry(algo, env))
    table_1 = {"gamma": 0.99, "learning_rate": 1e-3, "buffer_size": 5000, "batch_size": 128, "tau": 0.01}
    assert {name: settings.model[name] for name in table_1} == table_1
    assert settings.model["exploration_noise"] == 0.1
    assert settings.n_timesteps == (25 * 100_000 if env == "Grassland-v0" else 70 * 200_000)
    if algo == "kfcv_maddpg":
        assert settings.model["replay_buffer_kwargs"]["lambda_init"] == 0.1


def test_pairs_nest_and_override():
    pairs = parse_pairs("-params", ["gamma:0.9", "policy_kwargs.n_critics:2", "policy_kwargs.net_arch:[32, 32]", "tau:1e-2"])
    assert pairs == {"gamma": 0.9, "policy_kwargs": {"n_critics": 2, "net_arch": [32, 32]}, "tau": "1e-2"}
    entry = merged({"n_timesteps": 1, "n_envs": 1, "policy_kwargs": {"net_arch": [64], "n_critics": 1}}, pairs)
    settings = check("maddpg", "Grassland-v0", entry)
    assert settings.model == {"gamma": 0.9, "tau": 0.01, "replay_buffer_kwargs": {}, "policy_kwargs": pairs["policy_kwargs"]}


def test_linear_schedule_and_classes_by_name(tmp_path):
    params = ["learning_rate:lin_1e-3", "policy_kwargs.activation_fn:tanh"]
    train.main(command(tmp_path, params=params))
    run = run_folder(tmp_path)
    events = EventAccumulator(str(run.path))
    events.Reload()
    rates = [event.value for event in events.Scalars("train/learning_rate")]
    assert 0 < rates[-1] < rates[0] < 1e-3
    assert yaml.safe_load(run.config_file.read_text())["learning_rate"] == "lin_1e-3"
    assert "Tanh" in str(ALGOS["maddpg"].load(run.last_model).policy)


def test_normalisation_is_saved_with_the_models(tmp_path):
    train.main(command(tmp_path, params=["normalize:true"]))
    run = run_folder(tmp_path)
    env = make_vec_env("Grassland-v0", 2, env_kwargs=yaml.safe_load(run.config_file.read_text())["env_kwargs"])
    loaded = load_normalization(run.last_model, env, training=False)
    assert loaded.obs_rms.count > 120 and not loaded.norm_reward

    again = ["--algo", "maddpg", "-i", str(run.last_model), "-f", str(tmp_path), "-n", "20", "--verbose", "0"]
    assert train.main(again) == 0
    continued = load_normalization(run_folder(tmp_path, number=2).last_model, env, training=False)
    assert continued.obs_rms.count > loaded.obs_rms.count + 20


def test_one_team_learns_against_a_script(tmp_path):
    assert train.main(command(tmp_path, "Grassland-v0", "maddpg", "--team", "wolf", "--opponents", "sheep:flee")) == 0
    config = yaml.safe_load(run_folder(tmp_path).config_file.read_text())
    assert (config["team"], config["opponents"]) == ("wolf", {"sheep": "flee"})


def test_evaluation_shares_the_episodes_evenly():
    env = make_vec_env("Grassland-v0", 4, 0, {"n_wolves": 3, "n_sheep": 1})
    policy = TeamPolicy(layout_of(env), {"wolf": "chase", "sheep": "random"}, np.random.default_rng(0))
    results = evaluate(policy, env, 10)
    assert {len(values) for values in results.values()} == {10}
    assert len(np.unique(results["length"])) > 1  # episodes that end early and late
    np.testing.assert_allclose(results["reward"], results["return_wolf"], rtol=1e-4)
    np.testing.assert_allclose(results["return_sheep"], results["return_per_sheep"], rtol=1e-6)


def test_interval_of_a_mean():
    # Student's t for 4 degrees of freedom: 2.776; standard deviation √2.5; standard error √0.5
    mean, low, high = with_interval(np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    np.testing.assert_allclose([mean, low, high], [3, 3 - 2.7764 * 0.5**0.5, 3 + 2.7764 * 0.5**0.5], atol=1e-4)
    assert np.isnan(with_interval(np.array([1.0])).low)


def test_training_by_the_clock_ends_with_its_progress():
    env = make_vec_env("Grassland-v0", 2, 0, {"n_wolves": 1, "n_sheep": 1})
    model = KFCVMADDPG("MlpPolicy", env, seed=0, learning_starts=10_000_000)
    model.learn(10_000_000, TrainByTheClock(0.2))
    assert model.num_timesteps < 10_000_000
    assert model._current_progress_remaining < 0.1


def test_the_demo_makes_what_it_promises(tmp_path, capsys):
    assert demo.main(["--minutes", "0.02", "--episodes", "4", "--folder", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "All line-ups, 4 episodes each" in printed and "trained" in printed
    assert {"learning_curve.png", "learning_curve.npz", "grassland.gif"} <= {path.name for path in tmp_path.iterdir()}
    with np.load(tmp_path / "learning_curve.npz") as measured:
        assert measured["return_wolf"].shape == (len(measured["timesteps"]), demo.EPISODES_PER_MEASUREMENT)
    (run,) = find_runs([str(tmp_path)])
    assert (run.algo, run.env_id, run.seed, run.has_ended) == ("kfcv_maddpg", "Grassland-v0", 1, True)


def test_a_continued_run_takes_the_next_seed_and_keeps_to_its_algorithm_and_world(tmp_path, capsys):
    train.main(command(tmp_path, "HardSpread-v0", "maddpg"))
    (model,) = tmp_path.glob("maddpg/*/HardSpread-v0.zip")
    for words in (["--algo", "maddpg", "--env", "Grassland-v0"], ["--algo", "kfcv_maddpg", "--env", "HardSpread-v0"]):
        assert train.main([*words, "-i", str(model)]) == 2
        assert "continue it with --algo maddpg --env HardSpread-v0" in capsys.readouterr().err
    words = [
        "--algo",
        "maddpg",
        "--env",
        "HardSpread-v0",
        "-i",
        str(model),
        "-n",
        "10",
        "-f",
        str(tmp_path),
        "--eval-freq",
        "-1",
    ]
    assert train.main(words) == 0
    begun, continued = (yaml.safe_load(file.read_text())["seed"] for file in sorted(tmp_path.glob("maddpg/*/*/args.yml")))
    assert continued == begun + 1


def test_a_log_folder_that_is_a_file_is_refused_in_a_sentence(tmp_path, capsys):
    (tmp_path / "file").touch()
    words = command(tmp_path, "HardSpread-v0", "maddpg")
    assert train.main([*words, "-f", str(tmp_path / "file")]) == 2
    assert capsys.readouterr().err.startswith("error: the run cannot write its files")


MPE_YAML = """
mpe2/simple_tag_v3:
  n_timesteps: 120
  n_envs: 2
  learning_starts: 20
  batch_size: 8
  buffer_size: 200
  normalize: true
  env_kwargs: {max_cycles: 5, continuous_actions: true}
  env_wrapper:
    - supersuit.frame_stack_v2: {stack_size: 3}
    - supersuit.pad_observations_v0
"""


def mpe_command(folder, *more):
    pytest.importorskip("mpe2")
    pytest.importorskip("supersuit")
    (folder / "mpe.yml").write_text(MPE_YAML)
    words = ["--algo", "maddpg", "--env", "mpe2/simple_tag_v3", "-conf", str(folder / "mpe.yml"), "-f", str(folder / "logs")]
    return [*words, "--seed", "1", "--eval-freq", "60", "--eval-episodes", "3", "--verbose", "0", *more]


def test_a_world_of_pettingzoo_trains_with_its_wrappers(tmp_path):
    """Training and evaluation alike: three frames of 16 numbers for each of the four, the agent's 14 padded."""
    assert train.main(mpe_command(tmp_path)) == 0
    run = RunFolder(tmp_path / "logs" / "maddpg" / "mpe2-simple_tag_v3_1", "mpe2/simple_tag_v3")
    model = ALGOS["maddpg"].load(run.last_model)
    assert (model.num_timesteps, model.layout.obs_sizes) == (120, (48,) * 4)
    with np.load(run.path / "evaluations.npz") as evaluations:
        assert evaluations["return_adversary"].shape == (2, 3)
    config = yaml.safe_load(run.config_file.read_text())
    assert config["env_wrapper"] == [{"supersuit.frame_stack_v2": {"stack_size": 3}}, {"supersuit.pad_observations_v0": {}}]


@pytest.mark.filterwarnings("ignore:the state of .* cannot be read")
@pytest.mark.parametrize("vec_env", ["dummy", "subproc"])
def test_a_run_in_a_world_of_pettingzoo_is_resumed(tmp_path, vec_env):
    """In new episodes, since the worlds' state cannot be read."""
    words = mpe_command(tmp_path, "--vec-env", vec_env)
    assert train.main(words, [SignalAt(100, signal.SIGTERM)]) == 143
    assert train.main(["--resume", str(tmp_path / "logs" / "maddpg" / "mpe2-simple_tag_v3_1")]) == 0
    run = RunFolder(tmp_path / "logs" / "maddpg" / "mpe2-simple_tag_v3_1", "mpe2/simple_tag_v3")
    assert ALGOS["maddpg"].load(run.last_model).num_timesteps == 120


def test_our_worlds_train_in_processes(tmp_path):
    used = []

    class Watch(BaseCallback):
        def _on_step(self):
            used.append(type(self.training_env.unwrapped))
            return True

    words = command(tmp_path, "Grassland-v0", "maddpg", "--vec-env", "subproc", steps=40)
    assert train.main(words, [Watch()]) == 0
    assert set(used) == {TracedSubprocVecEnv}
    assert ALGOS["maddpg"].load(run_folder(tmp_path).last_model).num_timesteps == 40


MPE_REFUSALS = [
    ("--env-kwargs num_god:3", 'unknown setting of mpe2/simple_tag_v3 "num_god"; did you mean "num_good"?'),
    ("--env-kwargs num_good:many", "setting of mpe2/simple_tag_v3 num_good is 'many'; it must be a whole number"),
    ("--env-kwargs num_agent_neighbors:0", "num_agent_neighbors must be a positive integer"),
    ("--eval-env-kwargs num_good:2", "make a world whose agents are not those of the training"),
]


@pytest.mark.parametrize(("words", "sentence"), MPE_REFUSALS, ids=[words for words, _ in MPE_REFUSALS])
def test_bad_settings_of_a_world_of_pettingzoo_get_one_sentence(tmp_path, capsys, words, sentence):
    assert train.main(mpe_command(tmp_path, *words.split())) == 2
    printed = capsys.readouterr().err
    assert sentence in printed and printed.count("\n") == 1
    assert not (tmp_path / "logs").exists()
