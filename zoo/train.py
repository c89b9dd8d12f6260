"""
Train an agent team: ``python zoo/train.py --algo kfcv_maddpg --env Grassland-v0``.

Flags and the layout of the run folder are those of rl-baselines3-zoo. Hyperparameters come from ``hyperparams/<algo>.yml``,
its preset, and the command line, the later ones winning.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, configure
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv, VecMonitor, VecNormalize

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv import CoTraining
from sb3_kfcv.common.callbacks import MultiAgentEvalCallback, SavePlayers, StopOnSignal
from sb3_kfcv.common.checks import NonFiniteError
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.patient_logs import PatientResultsWriter
from sb3_kfcv.maddpg import MADDPG
from sb3_kfcv.saving import FileFormatError
from sb3_kfcv.saving.checkpoints import Checkpoint, Checkpoints, ResumeError, checkpoints_in, latest_checkpoint
from sb3_kfcv.saving.normalization import load_normalization
from sb3_kfcv.saving.releases import is_released
from sb3_kfcv.saving.saveable import refusals
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import facts_of, layout_of, make_vec_env, metric_names_of
from sb3_kfcv.vec_env.named_wrappers import find_wrappers
from zoo.command_line import (
    BAD_INPUT,
    PAIRS,
    REFUSALS,
    SEVERAL,
    SIGNALLED,
    Parser,
    as_it_was_typed,
    device,
    refused,
    start,
    this_command,
    whole_number,
)
from zoo.hyperparams import (
    ALGORITHMS,
    CO_TRAINING,
    OF_THE_RUN,
    PRESETS,
    Hyperparams,
    check,
    check_env_kwargs,
    co_training_entry,
    find_algorithm,
    load_entry,
    merged,
    parse_pairs,
)
from zoo.run_folder import RunFolder, file_name, file_to_play, read_map
from zoo.teams import Teams, Yardstick, parse_teams, with_teams, yardsticks
from zoo.tracking import HyperparamsPage, prepare_tracking, tracked
from zoo.typed_settings import settings_of

# Exit statuses beside those of every command.
NOT_FINITE = 3  # a loss, reward, observation or action was infinite or NaN
NOT_WRITTEN = 4  # the training came to its end, but its model could not be written

DESCRIPTION = """\
Train an algorithm in a world. Hyperparameters come from hyperparams/<algo>.yml, its preset and the command line, the later
ones winning. All that a run makes lies in <log folder>/<algo>/<env>_<k>: models, checkpoints, evaluations, TensorBoard, the
settings. A run that was stopped or killed goes on with --resume."""
EXAMPLES = (
    "--env Grassland-v0 --preset tuned -n 1e5 -P",
    "--algo maddpg --env HardSpread-v0 -params gamma:0.95 --env-kwargs n_agents:2 walls:none",
    "--team wolf=kfcv_maddpg sheep=graze --preset tuned -n 1e5",
    "--resume logs/kfcv_maddpg/Grassland-v0_1",
)

# Worlds of the evaluation are seeded this far above those of the training, which are seed, seed + 1, …
EVAL_SEED_OFFSET = 1_000_000

# Without --log-interval: log once per so many episodes of each world.
EPISODES_PER_LOG = 4

# What only co-training knows.
POOL_SETTINGS = ("pool_share", "pool_freq", "pool_size", "pool_sampling")

# Without --player-freq: a team's players are saved every so many env steps.
PLAYER_FREQ = 25_000

# Flags that may stand beside --resume; all else is as the run was begun.
FREE_WHEN_RESUMED = ("resume", "progress", "verbose")


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("train", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("--algo", default="kfcv_maddpg", help=f"{', '.join(ALGORITHMS)}; default: %(default)s")
    add("--env", default="Grassland-v0", help="id of the world (default: %(default)s)")
    add("-n", "--n-timesteps", type=whole_number, default=-1, help="env steps; with -i so many more (default: the YAML's)")
    add(
        "--seed",
        type=int,
        default=-1,
        help="-1 draws one at random and prints it; with -i the next one (default: %(default)s)",
    )
    add("-f", "--log-folder", default="logs", help="where run folders are made (default: %(default)s)")
    add("-tb", "--tensorboard-log", help='TensorBoard folder (default: the run folder); "" turns it off')
    add("-P", "--progress", action="store_true", help="show a progress bar with the time left")
    add(
        "--eval-freq", type=whole_number, default=25_000, help="env steps between evaluations, -1: none (default: %(default)s)"
    )
    add("--eval-episodes", type=int, default=20, help="episodes per evaluation (default: %(default)s)")
    add("--n-eval-envs", type=int, default=20, help="worlds that evaluate side by side (default: %(default)s)")
    add(
        "--resume",
        metavar="RUN_DIR",
        help="go on with a stopped or killed run from its last checkpoint, bit for bit",
    )
    add(
        "--save-freq",
        type=whole_number,
        default=25_000,
        help="env steps between checkpoints, -1: only when stopped by a signal (default: %(default)s)",
    )
    add("--keep-checkpoints", type=int, default=3, help="how many of the latest are kept, -1: all (default: %(default)s)")
    add("--save-replay-buffer", action="store_true", help="save the replay buffer at the end, for -i")
    add("--log-interval", type=int, default=-1, help=f"episodes between logs; -1: {EPISODES_PER_LOG} per world, -2: off")
    add("-params", "--hyperparams", **PAIRS, help="overwrite hyperparameters, such as gamma:0.95 policy_kwargs.n_critics:2")
    add("--env-kwargs", **PAIRS, help="settings of the world, such as n_wolves:4")
    add("--vec-env", choices=("dummy", "subproc"), default="dummy", help="subproc: each world in a process of its own")
    add("--eval-env-kwargs", **PAIRS, help="settings of the evaluation's worlds where they differ")
    add("-conf", "--conf-file", help="YAML file of hyperparameters (default: hyperparams/<algo>.yml)")
    add("--preset", help=f"{' or '.join(PRESETS)}: what learns better in place of the paper's values")
    add("-i", "--trained-agent", help="a saved model to train on in a new run, with the replay_buffer.zip beside it if any")
    add(
        "--team",
        **SEVERAL,
        metavar="GROUP=WHO",
        help="who learns a group (wolf=kfcv_maddpg) or plays it (sheep=graze, sheep=MODEL.zip, a mixture sheep=graze,flee);"
        " several that learn train at once, against each other",
    )
    add("--opponents", **{**PAIRS, "metavar": "GROUP:NAME"}, help="the same as GROUP=NAME after --team")
    add(
        "--yardstick",
        **SEVERAL,
        metavar="GROUP=WHO",
        help="fixed opponents that evaluations are against, beside those of the training "
        "(default: the scripted policies, where teams learn against each other)",
    )
    add(
        "--player-freq",
        type=whole_number,
        help="env steps between the players saved for matches, -1: none (default: 25000 with --team, else none)",
    )
    add("--track", action="store_true", help="follow the run with Weights & Biases; WANDB_MODE=offline keeps the records here")
    add("--wandb-project-name", default="sb3-kfcv", help="project there (default: %(default)s)")
    add("--wandb-entity", help="team or user there (default: your own)")
    add("-tags", "--wandb-tags", **SEVERAL, metavar="TAG", help="tags of the run there")
    add("--run-name", help="its name there (default: <algo>/<env>_<k>)")
    add("--num-threads", type=int, default=1, help="threads of PyTorch (default: %(default)s)")
    add("--device", type=device, default="auto", help="auto, cpu, cuda (default: %(default)s)")
    add("--verbose", type=int, default=1, help="0: quiet, 1: info (default: %(default)s)")
    return parser


@dataclass
class Training:
    """
    All that a run needs, built and checked.

    :param args: the command line, its seed resolved
    :param hyperparams: the settings
    :param model: the learner
    :param eval_env: worlds of the evaluation; ``None`` without evaluations
    :param n_timesteps: env steps to go, from the start or from the model of ``-i``
    :param yardsticks: fixed opponents of the evaluation
    """

    args: argparse.Namespace
    hyperparams: Hyperparams
    model: MADDPG | CoTraining
    eval_env: VecEnv | None
    n_timesteps: int
    yardsticks: list[Yardstick] = field(default_factory=list)

    @property
    def player_freq(self) -> int:
        """Env steps between saved players; −1 for none."""
        if self.args.player_freq is not None:
            return self.args.player_freq
        return PLAYER_FREQ if self.args.team else -1


def resolve(args: argparse.Namespace) -> Hyperparams:
    """
    The settings of a run: YAML or the continued run's, then the command line.

    :raises ValueError: for whatever is unknown or of another type
    """
    teams = parse_teams(args.team)
    teams.players.update(parse_pairs("--opponents", args.opponents))
    if len(teams.learners) > 1:
        args.algo = CO_TRAINING
    elif teams.learners:
        args.algo = next(iter(teams.learners.values())) or args.algo
    find_algorithm(args.algo)
    entry = {} if args.trained_agent else begun_entry(args, teams)
    if args.trained_agent:
        model_path = Path(args.trained_agent)
        if model_path.is_dir():
            model_path = file_to_play(model_path)
        if not model_path.is_file():
            raise ValueError(f"there is no model {model_path}")
        args.trained_agent = str(model_path.resolve())  # the run may be resumed from elsewhere
        continue_as_begun(args, model_path)
        config = RunFolder.of_model(model_path, args.env).config_file
        if config.exists():
            if args.preset or args.conf_file:
                raise ValueError(f"a continued run keeps its settings ({config}); change single ones with -params")
            entry = read_map(config)
            if "teams" in entry and args.algo != CO_TRAINING:
                args.algo, entry = of_one_team(entry, next(iter(teams.learners), model_path.stem.removeprefix("best_")))
        else:
            entry = begun_entry(args, teams)
    pairs = parse_pairs("-params", args.hyperparams)
    for name in pairs if args.algo != CO_TRAINING else ():
        if name in POOL_SETTINGS:
            raise ValueError(f"{name} is for teams that learn against each other, such as --team wolf=maddpg sheep=maddpg")
    if args.algo == CO_TRAINING:
        entry = with_teams(entry, pairs, [*OF_THE_RUN, *settings_of(CoTraining)])
    else:
        entry = merged(entry, pairs)
        entry.update([("team", team) for team in teams.learners])
    entry = merged(entry, {"env_kwargs": parse_pairs("--env-kwargs", args.env_kwargs)})
    if teams.players:
        entry["opponents"] = {**(entry.get("opponents") or {}), **teams.players}
    if args.n_timesteps != -1 and not args.trained_agent:
        entry["n_timesteps"] = args.n_timesteps
    return check(args.algo, args.env, entry)


def of_one_team(config: Mapping[str, Any], team: str) -> tuple[str, dict[str, Any]]:
    """
    The algorithm of a team that learnt beside others, and its settings, to train it on alone.

    :param config: of the run
    :param team: the team
    :raises ValueError: if the run had no such team
    """
    if team not in config["teams"]:
        known = ", ".join(config["teams"])
        raise ValueError(f"the run taught {known}: train on all of them with --algo {CO_TRAINING}, or one with --team")
    own = dict(config["teams"][team])
    of_the_run = {name: value for name, value in config.items() if name in OF_THE_RUN}
    return own.pop("algo"), {**of_the_run, **own, "team": team}


def begun_entry(args: argparse.Namespace, teams: Teams) -> dict[str, Any]:
    """
    The entry of the YAML file: of the algorithm, or of each team's.

    :param args: the command line
    :param teams: what it says of teams
    :raises ValueError: if there is none, or if those of the teams do not go together
    """
    preset = args.preset or "default"
    if args.algo != CO_TRAINING or (args.conf_file and not teams.learners):
        return load_entry(args.algo, args.env, args.conf_file, preset)
    if not teams.learners:
        raise ValueError(f"--algo {CO_TRAINING} needs teams, such as --team wolf=kfcv_maddpg sheep=maddpg")
    algos = {team: algo or make_parser().get_default("algo") for team, algo in teams.learners.items()}
    entries = {team: load_entry(algo, args.env, args.conf_file, preset) for team, algo in algos.items()}
    return co_training_entry(entries, algos)


def continue_as_begun(args: argparse.Namespace, model_path: Path) -> None:
    """
    Check a continued run against the one that made its model, and give it the next seed unless one is given.

    :param args: the command line; its seed is set
    :param model_path: the model, in the run folder of the first run
    :raises ValueError: if the model is of another algorithm or world
    """
    for file in model_path.parent.glob("*/args.yml"):
        begun = read_map(file)
        one_of_several = begun["algo"] == CO_TRAINING != args.algo  # whose algorithm the file itself tells
        if begun["env"] != args.env or (begun["algo"] != args.algo and not one_of_several):
            raise ValueError(
                f"{model_path} was trained by {begun['algo']} on {begun['env']}; "
                f"continue it with --algo {begun['algo']} --env {begun['env']}"
            )
        if args.seed < 0:
            args.seed = begun["seed"] + 1


def as_begun(args: argparse.Namespace, given: Sequence[str]) -> tuple[argparse.Namespace, RunFolder]:
    """
    The command line with which a run was begun.

    :param args: the command line that resumes it
    :param given: the names of the flags that are on it
    :return: its command line, and its folder
    :raises ValueError: if there is nothing to resume, or if the command line wants something else than that
    """
    for name in given:
        if name not in FREE_WHEN_RESUMED:
            flag = f"--{name.replace('_', '-')}"
            raise ValueError(f"a resumed run keeps its settings: leave out {flag}, or train its model on with -i in a new run")
    folder = RunFolder.existing(args.resume)
    if folder.last_model.exists():
        if is_released(folder.last_model):
            raise ValueError(
                f"{folder.path} was released for playing only, and cannot be trained on; to train one, start a new run"
            )
        raise ValueError(f"the run in {folder.path} has ended; to train its model on: -i {folder.last_model} -n STEPS")
    begun = argparse.Namespace(**{**vars(make_parser().parse_all([])), **read_map(folder.arguments_file)})
    for name in ("resume", *(name for name in given if name in FREE_WHEN_RESUMED)):
        setattr(begun, name, getattr(args, name))
    return begun, folder


def make_env(
    hyperparams: Hyperparams,
    n_envs: int,
    seed: int,
    env_kwargs: dict[str, Any],
    training: bool,
    processes: bool = False,
) -> VecEnv:
    """
    Worlds to train or to evaluate in. Where one team learns, their reward is the mean over that team.

    :param hyperparams: the settings
    :param n_envs: number of worlds
    :param seed: of the first world; the others follow
    :param env_kwargs: settings of the worlds
    :param training: whether observation statistics are gathered, if observations are normalised
    :param processes: each world in a process of its own
    """
    env = make_vec_env(
        hyperparams.env_id,
        n_envs,
        seed,
        env_kwargs,
        reward=hyperparams.model.get("team") or "default",
        wrappers=find_wrappers(hyperparams.env_wrapper),
        vec_env_cls=SubprocVecEnv if processes else None,
    )
    return env if hyperparams.normalize is None else VecNormalize(env, training=training, **hyperparams.normalize)


def make_eval_env(args: argparse.Namespace, hyperparams: Hyperparams, env: VecEnv) -> VecEnv | None:
    """
    Worlds of the evaluation.

    :param args: the command line
    :param hyperparams: the settings
    :param env: the worlds of the training, to whose agents these must be alike
    """
    different = check_env_kwargs(args.env, parse_pairs("--eval-env-kwargs", args.eval_env_kwargs))
    if args.eval_freq <= 0:
        return None
    for flag in ("eval_episodes", "n_eval_envs"):
        if getattr(args, flag) < 1:
            raise ValueError(f"--{flag.replace('_', '-')} is {getattr(args, flag)}; it must be at least 1")
    n_envs = min(args.n_eval_envs, args.eval_episodes)
    kwargs = merged(hyperparams.env_kwargs, different)
    eval_env = make_env(hyperparams, n_envs, args.seed + EVAL_SEED_OFFSET, kwargs, training=False)
    if layout_of(eval_env) != layout_of(env):
        raise ValueError(f"--eval-env-kwargs {different} make a world whose agents are not those of the training")
    return eval_env


def require_everybody(hyperparams: Hyperparams, layout: AgentLayout) -> None:
    """
    :param hyperparams: the settings
    :param layout: who sits where
    :raises ValueError: for a group that the world lacks, and for one that neither learns nor is played
    """
    model = hyperparams.model
    learners = list(model.get("teams") or ([model["team"]] if model.get("team") else []))
    for group in [*learners, *(model.get("opponents") or {})]:
        layout.members(group)
    for group in layout.group_names if learners else ():
        if group not in learners and group not in (model.get("opponents") or {}):
            raise ValueError(f"nobody plays {group}: add it to --team, such as {group}=random")


def make_yardsticks(
    args: argparse.Namespace, hyperparams: Hyperparams, eval_env: VecEnv | None, then: Mapping[str, dict[str, Any]]
) -> list[Yardstick]:
    """
    Fixed opponents of the evaluation.

    :param args: the command line
    :param hyperparams: the settings
    :param eval_env: its worlds, if there are any
    :param then: those of a run that is resumed, by name
    :raises ValueError: for one that cannot play
    """
    team = hyperparams.model.get("team")
    learners = list(hyperparams.model.get("teams", [team] if team else []))
    if not learners and args.yardstick:
        raise ValueError("--yardstick measures a team; say which one learns with --team")
    if eval_env is None or not learners:
        return []
    layout = layout_of(eval_env)
    found = yardsticks(args.yardstick, layout, learners, args.algo == CO_TRAINING, then)
    for team, _, opponents in found:
        others = [group for group in layout.group_names if group != team]
        facts = facts_of(eval_env)
        TeamPolicy(layout, opponents, None, others, eval_env.action_space, **facts)  # refuses who cannot play
    return found


@dataclass
class Opponents:
    """
    Who played in a run that is resumed: the files from which they came may be others by now, or gone.

    :param training: of the training, by group
    :param yardsticks: of the evaluations, by name and group
    """

    training: dict[str, Any] = field(default_factory=dict)
    yardsticks: dict[str, dict[str, Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, checkpoint: Checkpoint | None) -> Opponents:
        """Those that a checkpoint holds."""
        if checkpoint is None:
            return cls()
        with refusals(checkpoint, "training"):
            states = [state["values"] for state in checkpoint.training["callbacks"]]
            measured = {values["name"]: values["players"] for values in states if values.get("players")}
            return cls(dict(checkpoint.attributes.get("opponents") or {}), measured)


def build(
    args: argparse.Namespace,
    resumed: RunFolder | None = None,
    then: Opponents | None = None,
    hyperparams: Hyperparams | None = None,
) -> Training:
    """
    Everything that can be refused, before anything is written.

    :param args: the command line
    :param resumed: the folder of the run, if it goes on
    :param then: who has played in it
    :param hyperparams: the settings, where the command line does not tell them
    :raises ValueError: one sentence that says what is wrong
    """
    if args.num_threads < 1:
        raise ValueError(f"--num-threads is {args.num_threads}; it must be at least 1")
    if args.save_freq < 1 and args.save_freq != -1:
        raise ValueError(f"--save-freq is {args.save_freq}; it must be at least 1, or -1")
    if args.keep_checkpoints == 0:
        raise ValueError("--keep-checkpoints is 0; it must be at least 1, or -1 to keep all")
    if args.player_freq is not None and args.player_freq < 1 and args.player_freq != -1:
        raise ValueError(f"--player-freq is {args.player_freq}; it must be at least 1, or -1")
    if resumed is None:
        prepare_tracking(args, make_parser().parse_all([]))
    if hyperparams is None:
        hyperparams = check(args.algo, args.env, read_map(resumed.config_file)) if resumed else resolve(args)
    then = then or Opponents()
    th.set_num_threads(args.num_threads)
    if args.seed < 0:
        args.seed = int(np.random.default_rng().integers(2**31))
    processes = args.vec_env == "subproc"
    env = make_env(hyperparams, hyperparams.n_envs, args.seed, hyperparams.env_kwargs, training=True, processes=processes)
    require_everybody(hyperparams, layout_of(env))
    eval_env = make_eval_env(args, hyperparams, env)
    measured = make_yardsticks(args, hyperparams, eval_env, then.yardsticks)
    algorithm = find_algorithm(args.algo)
    settings = {**hyperparams.model_kwargs(), "seed": args.seed, "device": args.device, "verbose": args.verbose}
    if then.training:
        settings["opponents"] = then.training
    if not args.trained_agent or (resumed and checkpoints_in(resumed.path)):
        model = algorithm(hyperparams.policy, env, **settings)
        return Training(args, hyperparams, model, eval_env, hyperparams.n_timesteps, measured)

    if isinstance(env, VecNormalize):
        env = load_normalization(args.trained_agent, env.venv, training=True)
    if args.algo != CO_TRAINING:
        settings["replay_buffer_class"] = algorithm.default_buffer_class
    model = algorithm.load(args.trained_agent, env, **settings)
    model.require_learner()
    buffer_file = RunFolder.of_model(args.trained_agent, args.env).replay_buffer
    if buffer_file.exists():
        model.load_replay_buffer(buffer_file)
    if resumed:
        to_go = hyperparams.n_timesteps - model.num_timesteps
    else:
        to_go = args.n_timesteps if args.n_timesteps > 0 else hyperparams.n_timesteps - model.num_timesteps
    if to_go <= 0:
        raise ValueError(f"{args.trained_agent} has its {model.num_timesteps} env steps already; say with -n how many more")
    hyperparams.n_timesteps = model.num_timesteps + to_go
    return Training(args, hyperparams, model, eval_env, to_go, measured)


def make_callbacks(training: Training, folder: RunFolder, stop: StopOnSignal) -> list[BaseCallback]:
    """The stop, checkpoints and evaluations, as the command line wants them."""
    args = training.args
    resume = args.resume is not None
    callbacks: list[BaseCallback] = [
        stop,
        Checkpoints(folder.path, args.save_freq, args.keep_checkpoints, resume, stop, verbose=args.verbose),
        HyperparamsPage({"algo": args.algo, "env": args.env, "seed": args.seed, **training.hyperparams.to_dict()}),
    ]
    if training.eval_env is not None:
        callbacks.append(
            MultiAgentEvalCallback(
                training.eval_env,
                args.eval_freq,
                args.eval_episodes,
                log_path=folder.path,
                best_model_save_path=folder.path if args.algo != CO_TRAINING else None,
                verbose=args.verbose,
            )
        )
        callbacks += [
            MultiAgentEvalCallback(
                training.eval_env,
                args.eval_freq,
                args.eval_episodes,
                log_path=folder.path,
                best_model_save_path=folder.path if is_first_of_its_team(yardstick, training.yardsticks) else None,
                team=yardstick.team,
                opponents=yardstick.opponents,
                name=yardstick.name,
                verbose=args.verbose,
            )
            for yardstick in training.yardsticks
        ]
    if training.player_freq > 0:
        callbacks.append(SavePlayers(folder.players, training.player_freq))
    return callbacks


def is_first_of_its_team(yardstick: Yardstick, all_of_them: Sequence[Yardstick]) -> bool:
    """Whether it is the one that tells a team's best model."""
    return next(other for other in all_of_them if other.team == yardstick.team) is yardstick


def start_logs(training: Training, folder: RunFolder, further: Sequence[KVWriter] = ()) -> None:
    """
    Open the run's logs: the monitor file, TensorBoard, the screen.

    :param training: what was built
    :param folder: of the run
    :param further: log formats beside these
    """
    env: Any = training.model.get_env()
    while not isinstance(env, VecMonitor):
        env = env.venv
    env.info_keywords = metric_names_of(env)
    args = training.args
    header: dict[str, float | str] = {"t_start": env.t_start, "env_id": folder.env_id}
    going_on = args.resume is not None and bool(checkpoints_in(folder.path))
    env.results_writer = PatientResultsWriter(
        str(folder.monitor_file), header, env.info_keywords, override_existing=not going_on
    )
    log_path = folder.path
    if args.tensorboard_log:
        log_path = Path(args.tensorboard_log) / file_name(args.env) / f"{args.algo}_{folder.number}"
    formats = ["stdout"] if args.verbose > 0 else []
    formats += ["tensorboard"] if args.tensorboard_log != "" else []
    if args.resume is not None and not going_on:  # it begins again: nothing may stay of what it logged before
        for path in log_path.glob("events.out.tfevents.*"):
            path.unlink()
    logger = configure(str(log_path), formats)
    logger.output_formats += further
    training.model.set_logger(logger)


def log_interval(args: argparse.Namespace, n_envs: int) -> int | None:
    """Episodes between log entries; ``None`` for none."""
    if args.log_interval == -2:
        return None
    return args.log_interval if args.log_interval > 0 else EPISODES_PER_LOG * n_envs


def train(training: Training, folder: RunFolder, extra_callbacks: Sequence[BaseCallback] = ()) -> int:
    """
    Train to the end, to a signal, or to a number that is not finite.

    :param training: what was built
    :param folder: where everything goes
    :param extra_callbacks: beside those of the command line
    :return: exit status
    """
    args, model = training.args, training.model
    with StopOnSignal() as stop:
        callbacks = make_callbacks(training, folder, stop)
        try:
            model.learn(
                training.n_timesteps,
                [*callbacks, *extra_callbacks],
                log_interval(args, training.hyperparams.n_envs),  # type: ignore[arg-type]
                reset_num_timesteps=model.num_timesteps == 0,
                progress_bar=args.progress,
            )
        except KeyboardInterrupt:
            return SIGNALLED + (stop.received or StopOnSignal.SIGNALS[0])
        except (ResumeError, FileFormatError) as error:
            return refused(error)
        except NonFiniteError as error:
            print(f"error: {error}; the training has stopped after {model.num_timesteps:,} env steps", file=sys.stderr)
            return NOT_FINITE
    if stop.ending and stop.received is not None:
        return SIGNALLED + stop.received
    try:
        if args.save_replay_buffer:
            model.save_replay_buffer(folder.replay_buffer)
        model.save(folder.last_model)  # the last file: with it the run has ended
    except (NonFiniteError, OSError) as error:
        print(f"error: the model could not be written: {error}", file=sys.stderr)
        return NOT_FINITE if isinstance(error, NonFiniteError) else NOT_WRITTEN
    print(f"trained {model.num_timesteps:,} env steps; the model is {folder.last_model}")
    return 0


def what_is_left(training: Training, folder: RunFolder, status: int) -> str:
    """What a run that did not come to its end leaves behind, and how it goes on."""
    checkpoints = checkpoints_in(folder.path)
    resume = shlex.join([*this_command("train"), "--resume", str(folder.path)])
    if not checkpoints:
        return f"no checkpoint was saved yet; to start again: {resume}"
    steps, path = next(iter(checkpoints.items()))
    if status == NOT_FINITE:  # the same would come again
        of = ["--algo", training.args.algo, "--env", training.args.env]
        other = shlex.join([*this_command("train"), *of, "-i", str(path), "-n", "STEPS", "-params", "NAME:VALUE"])
        return f"the last checkpoint is of {steps:,} env steps; to train it on with other settings: {other}"
    return f"the last checkpoint is of {steps:,} env steps; to go on: {resume}"


def main(argv: Sequence[str] | None = None, extra_callbacks: Sequence[BaseCallback] = ()) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :param extra_callbacks: for whoever starts a run from Python
    :return: exit status: 0; 2 for bad input; 3 for a number that is not finite; 4 if the model could not be written at the
        end; 130 after Ctrl-C, 143 after SIGTERM
    """
    try:
        args = make_parser().parse_all(argv)
        training = build(args) if args.resume is None else None
    except REFUSALS as error:
        return refused(error)
    if training is None:
        return resume_run(args, extra_callbacks)
    try:
        folder = RunFolder.create(args.log_folder, args.algo, args.env)
        folder.describe(training.hyperparams.to_dict(), vars(args), as_it_was_typed("train", argv))
    except OSError as error:
        print(f"error: the run cannot write its files: {error}", file=sys.stderr)
        return BAD_INPUT
    print(f"{args.algo} on {args.env}, seed {args.seed}, in {folder.path}")
    if args.verbose > 0:
        print(yaml.safe_dump(training.hyperparams.to_dict(), sort_keys=False))
    with folder.locked():
        return run(training, folder, extra_callbacks)


def resume_run(args: argparse.Namespace, extra_callbacks: Sequence[BaseCallback]) -> int:
    """
    Go on with a run.

    :param args: the command line
    :param extra_callbacks: see :func:`main`
    :return: exit status
    """
    parser = make_parser()
    given = [name for name, value in vars(args).items() if value != parser.get_default(name)]
    with ExitStack() as stack:
        try:
            begun, folder = as_begun(args, given)
            stack.enter_context(folder.locked())
            changed = folder.versions_changed()
            then = Opponents.of(latest_checkpoint(folder.path))  # which sets aside what is damaged
            training = build(begun, folder, then)
        except REFUSALS as error:
            return refused(error)
        if changed:
            print(f"note: {', '.join(changed)} since the run was begun: perhaps not bit for bit", file=sys.stderr)
        print(f"{begun.algo} on {begun.env}, seed {begun.seed}, goes on in {folder.path}")
        return run(training, folder, extra_callbacks)


def run(training: Training, folder: RunFolder, extra_callbacks: Sequence[BaseCallback]) -> int:
    """Train, and say what is left if that did not come to its end."""
    with ExitStack() as stack:
        try:
            writers = stack.enter_context(tracked(training.args, folder, training.hyperparams.to_dict()))
            start_logs(training, folder, writers)
        except ValueError as error:
            if training.args.resume is None:  # nothing has happened yet
                shutil.rmtree(folder.path)
            return refused(error)
        except OSError as error:
            return refused(OSError(f"the run cannot write its logs: {error}"))
        status = train(training, folder, extra_callbacks)
    if status:
        print(f"stopped: {what_is_left(training, folder, status)}")
    return status


if __name__ == "__main__":
    start(main, "interrupted before the training began")
