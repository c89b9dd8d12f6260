"""
Search for better hyperparameters: ``python zoo/optimize.py --algo kfcv_maddpg --env HardSpread-v0 -n 1e5 --n-trials 50``.

A trial draws settings from the search space and trains them with several seeds; its value is the mean of their last
evaluations. Trials that fall behind are cut short. The study lies in a file: any number of processes may work on it at once,
and the same command goes on with it.
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from filelock import FileLock, Timeout
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from stable_baselines3.common.callbacks import BaseCallback

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.callbacks import MultiAgentEvalCallback
from sb3_kfcv.common.checks import NonFiniteError, require_count
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.saving.archive import library_versions
from sb3_kfcv.vec_env.make import layout_of, metric_names_of
from zoo import train
from zoo.command_line import PAIRS, REFUSALS, SEVERAL, Parser, as_it_was_typed, refused, start, whole_number
from zoo.hyperparams import check, flat, load_entry, merged, nested
from zoo.match_results import as_text, write_json, write_text
from zoo.plots import ALGO_COLOURS, ALGO_LABELS, REFERENCE_COLOUR, new_figure, save_figure
from zoo.run_folder import file_name
from zoo.search_space import Range, SearchSpace, decoded, encoded
from zoo.workers import Task, Workers, end_with_parent, make_workers

DESCRIPTION = """\
Search for better hyperparameters with Optuna. Each trial trains settings drawn from the search space (hyperparams/search.yml,
or a file of the same form) with several seeds; its value is the mean over the seeds of the last evaluation. Trials that are
behind the median are cut short. The study is a file in the output folder: the same command goes on with it until it has
--n-trials trials, several commands may work on it at once, and the trial of one that was killed is tried again. The best
settings are printed and written to best.yml, in the form of hyperparams/*.yml. The best of many trials is a lucky one, too:
measure it anew, with other seeds, before you believe it."""
EXAMPLES = (
    "--algo maddpg --env HardSpread-v0 -n 1e5 --n-trials 50 --n-jobs 2",
    "--algo kfcv_maddpg --env Grassland-v0 --preset tuned --team wolf --opponents sheep:graze -n 1e5 --metric sheep_eaten",
    "--env HardSpread-v0 -n 2e4 --n-trials 20 --space my_space.yml --sampler random --pruner none -o my_search",
)

SAMPLERS = ("tpe", "random")
PRUNERS = ("median", "halving", "none")
LOOK = 1.0  # seconds between two looks at a study on which others work
SHOWN = 5  # trials in the table at the end


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("optimize", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("--algo", default="kfcv_maddpg", help="algorithm (default: %(default)s)")
    add("--env", default="Grassland-v0", help="id of the world (default: %(default)s)")
    add("-n", "--n-timesteps", type=whole_number, default=-1, help="env steps of each training (default: the YAML's)")
    add("--n-trials", type=whole_number, default=50, help="trials of the study in all (default: %(default)s)")
    add("--n-seeds", type=int, default=2, help="trainings of each trial, with seeds of their own (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the sampler, and of each trial's first training (default: %(default)s)")
    add("--n-evaluations", type=int, default=5, help="evaluations of each training (default: %(default)s)")
    add("--eval-episodes", type=int, default=100, help="episodes of each evaluation (default: %(default)s)")
    add("--metric", default="reward", help="of the evaluation, such as landmarks_covered (default: %(default)s)")
    add("--minimize", action="store_true", help="where less is better, as of collisions")
    add("--space", metavar="FILE", help="YAML file of the search space (default: hyperparams/search.yml)")
    add("--sampler", default="tpe", help=f"{' or '.join(SAMPLERS)} (default: %(default)s)")
    add("--pruner", default="median", help=f"{', '.join(PRUNERS)} (default: %(default)s)")
    add(
        "--n-startup-trials",
        type=int,
        default=10,
        help="drawn at random; the median pruner cuts none of them short (default: %(default)s)",
    )
    add("-conf", "--conf-file", help="YAML file of the settings that are not searched (default: hyperparams/<algo>.yml)")
    add("--preset", help="default or tuned: these settings, likewise")
    add("-params", "--hyperparams", **PAIRS, help="overwrite them; what is searched wins over them")
    add("--env-kwargs", **PAIRS, help="settings of the world")
    add("--team", **SEVERAL, metavar="GROUP=WHO", help="who learns and who plays, as of zoo/train.py; one team learns")
    add("--opponents", **{**PAIRS, "metavar": "GROUP:NAME"}, help="the same as GROUP=NAME after --team")
    add("--n-jobs", type=int, default=1, help="trials at a time, each in a process (default: %(default)s)")
    add("--address", help="of a Ray cluster whose machines work on the trials; they share the output folder")
    add("--num-threads", type=int, default=1, help="threads of PyTorch in each process (default: %(default)s)")
    add("--study-name", help="default: <algo>_<env>")
    add("--storage", help="an Optuna database, such as sqlite:///studies.db (default: a journal in the output folder)")
    add("-o", "--output", default="optimize", help="folder of the results (default: %(default)s)")
    add("--worker", action="store_true", help="work on a study that another process began (what --n-jobs starts)")
    return parser


class Report(BaseCallback):
    """
    Tells the study how a training is doing, after each evaluation.

    :param trial: of the study
    :param metric: of the evaluation
    :param before: the last values of the trial's trainings with other seeds
    :param n_evaluations: of each training
    """

    parent: MultiAgentEvalCallback

    def __init__(self, trial: Any, metric: str, before: Sequence[float], n_evaluations: int) -> None:
        super().__init__()
        self.trial, self.metric = trial, metric
        self.before, self.n_evaluations = list(before), n_evaluations
        self.value = np.nan

    def _on_step(self) -> bool:
        import optuna

        evaluations = self.parent.evaluations
        self.value = float(evaluations[-1][self.metric].mean())
        step = len(self.before) * self.n_evaluations + len(evaluations)
        self.trial.report(float(np.mean([*self.before, self.value])), step)
        if self.trial.should_prune():
            raise optuna.TrialPruned
        return True


@dataclass
class Search:
    """
    A study, and all that its trials need.

    :param args: the command line
    :param space: the settings to choose
    :param entry: the settings that are not chosen, as YAML holds them
    :param study: of Optuna
    """

    args: argparse.Namespace
    space: SearchSpace
    entry: dict[str, Any]
    study: Any

    @property
    def folder(self) -> Path:
        return Path(self.args.output)

    @property
    def name(self) -> str:
        return self.study.study_name

    def training(self, params: dict[str, Any], seed: int) -> train.Training:
        """
        Everything for one training.

        :param params: what was chosen
        :param seed: of the training
        :raises ValueError: if the settings do not go together
        """
        args = train.make_parser().parse_all([])
        for flag in ("algo", "env", "team", "opponents", "eval_episodes", "num_threads"):
            setattr(args, flag, getattr(self.args, flag))
        args.n_eval_envs, args.eval_freq, args.seed, args.verbose = self.args.eval_episodes, 1, seed, 0
        settings = check(args.algo, args.env, merged(self.entry, nested(decoded(params, self.space))))
        return train.build(args, hyperparams=settings)

    def check_space(self) -> None:
        """
        Build a learner with every choice and both ends of every range, beside the first of every other setting.

        :raises ValueError: for what it does not take
        """
        ends = self.space.ends()
        first = {name: values[0] for name, values in ends.items()}
        for name, values in ends.items():
            for value in values:
                try:
                    self.training({key: encoded(own) for key, own in {**first, name: value}.items()}, self.args.seed)
                except ValueError as error:
                    raise ValueError(f"the search space has {name}: {value}, but {error}") from None

    def value(self, trial: Any) -> float:
        """
        Train with each seed.

        :param trial: of the study
        :return: mean over the seeds of the last evaluation
        """
        values: list[float] = []
        for k in range(self.args.n_seeds):
            training = self.training(trial.params, self.args.seed + k)
            report = Report(trial, self.args.metric, values, self.args.n_evaluations)
            evaluation = MultiAgentEvalCallback(
                training.eval_env,  # type: ignore[arg-type]
                max(1, training.n_timesteps // self.args.n_evaluations),
                self.args.eval_episodes,
                callback_after_eval=report,
                verbose=0,
            )
            training.model.learn(training.n_timesteps, evaluation, log_interval=None)  # type: ignore[arg-type]
            values.append(report.value)
        return float(np.mean(values))

    def work(self) -> Iterator[Any]:
        """Try one trial after the other, until there are enough; each is given when it has ended."""
        from optuna import TrialPruned
        from optuna.trial import TrialState

        self.give_back()
        while (asked := self._ask()) is not None:
            trial, lock = asked
            with lock:
                try:
                    self.study.tell(trial, self.value(trial))
                except TrialPruned:
                    self.study.tell(trial, state=TrialState.PRUNED)
                except (NonFiniteError, ValueError) as error:
                    trial.set_user_attr("stopped", str(error))
                    self.study.tell(trial, state=TrialState.PRUNED)
                except BaseException:
                    self.study.tell(trial, state=TrialState.FAIL)
                    self.study.enqueue_trial(trial.params)
                    raise
            Path(lock.lock_file).unlink(missing_ok=True)
            yield trial

    def _ask(self) -> tuple[Any, FileLock] | None:
        """The next trial, and the lock that is held while a process is at it; ``None`` when there are enough."""
        from optuna.trial import TrialState

        with self._lock("ask"):
            states = [trial.state for trial in self.study.get_trials(deepcopy=False)]
            begun = len(states) - states.count(TrialState.FAIL) - states.count(TrialState.WAITING)
            if begun >= self.args.n_trials:
                return None
            self.study.sampler = make_sampler(self.args, begun)
            trial = self.study.ask(self.space.distributions())
            lock = self._lock(f"trial_{trial.number}")
            lock.acquire()
            return trial, lock

    def _lock(self, name: str, seconds: float = -1) -> FileLock:
        return FileLock(self.folder / f".{self.name}_{name}.lock", timeout=seconds)

    def give_back(self) -> None:
        """Have trials whose process was killed tried again."""
        from optuna.trial import TrialState

        with self._lock("ask"):
            for trial in self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
                with suppress(Timeout), self._lock(f"trial_{trial.number}", seconds=0):  # else another process is at it
                    self.study.tell(trial.number, state=TrialState.FAIL)
                    self.study.enqueue_trial(trial.params)

    def ended(self) -> list[Any]:
        """The trials that have come to an end, in the order of their numbers."""
        import optuna

        states = (optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED)
        return self.study.get_trials(deepcopy=False, states=states)

    def ranked(self) -> list[Any]:
        """The trials that were not cut short, the best first."""
        from optuna.trial import TrialState

        complete = [trial for trial in self.ended() if trial.state == TrialState.COMPLETE and np.isfinite(trial.value)]
        return sorted(complete, key=lambda trial: trial.value, reverse=not self.args.minimize)


def make_sampler(args: argparse.Namespace, begun: int) -> Any:
    """
    What draws a trial. It depends on the seed and the trials before it alone, so that a study that was interrupted draws what
    it would have drawn.

    :param args: the command line
    :param begun: how many trials were begun
    """
    import optuna

    seed = int(np.random.SeedSequence([args.seed, begun]).generate_state(1)[0])
    if args.sampler == "random" or begun < args.n_startup_trials:
        return optuna.samplers.RandomSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed, n_startup_trials=args.n_startup_trials, multivariate=True)


def make_pruner(args: argparse.Namespace) -> Any:
    """What cuts trials short."""
    import optuna

    if args.pruner == "none":
        return optuna.pruners.NopPruner()
    if args.pruner == "halving":
        return optuna.pruners.SuccessiveHalvingPruner()
    return optuna.pruners.MedianPruner(n_startup_trials=args.n_startup_trials, n_warmup_steps=args.n_evaluations // 3)


def make_storage(args: argparse.Namespace) -> Any:
    """Where the study lies."""
    import optuna
    import sqlalchemy
    from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

    path = args.storage or str(Path(args.output) / "journal.log")
    try:
        if "://" in path:
            return optuna.storages.get_storage(path)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        return optuna.storages.JournalStorage(JournalFileBackend(path, lock_obj=JournalFileOpenLock(path)))
    except (ImportError, OSError, ValueError, sqlalchemy.exc.SQLAlchemyError) as error:
        why = next(iter(str(error).splitlines()), type(error).__name__)
        raise ValueError(f"the study cannot be kept in {path}: {why}") from None


def build(args: argparse.Namespace) -> Search:
    """
    Everything that can be refused, before anything is written.

    :param args: the command line
    :raises ValueError: one sentence that says what is wrong
    """
    try:
        import optuna
    except ImportError:
        raise ValueError('the search needs Optuna: pip install "sb3-kfcv[optimize]"') from None
    optuna.logging.set_verbosity(logging.WARNING)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    for flag in ("n_trials", "n_seeds", "n_evaluations", "eval_episodes", "n_jobs", "num_threads"):
        require_count(f"--{flag.replace('_', '-')}", getattr(args, flag))
    require_count("--seed", args.seed, least=0)
    if args.study_name is not None and not re.fullmatch(r"[\w.-]+", args.study_name):
        raise ValueError(f"--study-name is part of file names: letters, digits, _, . and - only, not {args.study_name!r}")
    for flag, known in (("sampler", SAMPLERS), ("pruner", PRUNERS)):
        if getattr(args, flag) not in known:
            raise ValueError(unknown_name(flag, getattr(args, flag), known))
    of_train = train.make_parser().parse_all([])
    for flag in ("algo", "env", "n_timesteps", "preset", "conf_file", "hyperparams", "env_kwargs", "team", "opponents"):
        setattr(of_train, flag, getattr(args, flag))
    hyperparams = train.resolve(of_train)
    if hyperparams.algo == train.CO_TRAINING:
        raise ValueError("a search is for one learner; let the other teams be played, such as --team wolf sheep=graze")
    args.algo = hyperparams.algo
    space = SearchSpace.read(args.algo, args.space)
    search = Search(args, space, hyperparams.to_dict(), None)
    if not args.worker:  # else the one that began the study has done it
        search.check_space()
    env = train.make_env(hyperparams, 1, args.seed, hyperparams.env_kwargs, training=False)
    train.require_everybody(hyperparams, layout_of(env))
    metrics = ["reward", "length", *metric_names_of(env)]
    if args.metric not in metrics:
        raise ValueError(unknown_name("metric", args.metric, metrics))
    storage = make_storage(args)
    search.folder.mkdir(parents=True, exist_ok=True)
    search.study = optuna.create_study(
        storage=storage,
        pruner=make_pruner(args),
        study_name=args.study_name or f"{args.algo}_{file_name(args.env)}",
        direction="minimize" if args.minimize else "maximize",
        load_if_exists=True,
    )
    require_same(search)
    return search


def require_same(search: Search) -> None:
    """
    A study goes on as it was begun.

    :param search: whose study may be a new one
    :raises ValueError: if its trials were of something else
    """
    args = search.args
    names = ("algo", "env", "n_seeds", "seed", "n_evaluations", "eval_episodes", "metric", "minimize", "sampler", "pruner")
    flags = {name: getattr(args, name) for name in names}
    own = json.loads(json.dumps({**flags, "settings": search.entry, "space": search.space.to_dict()}))
    then = search.study.user_attrs.get("search")
    if then is None:
        search.study.set_user_attr("search", own)
        return
    before, now = flat(then), flat(own)
    for name in [*now, *before]:
        if before.get(name) != now.get(name):
            raise ValueError(
                f"the study {search.name} was begun with {name} {before.get(name)}, not {now.get(name)}; "
                "give this one a --study-name of its own, or another -o"
            )


def tell_news(search: Search, known: int) -> int:
    """
    Print the trials that have ended.

    :param search: whose trials
    :param known: how many of them were printed before
    :return: how many there are
    """
    ended = search.ended()
    best = search.ranked()
    for place, trial in enumerate(sorted(ended, key=lambda trial: trial.datetime_complete)[known:], known + 1):
        cut = trial.user_attrs.get("stopped", "cut short")
        result = f"{trial.value:.3f}" if trial in best else f"{cut} after {len(trial.intermediate_values)} evaluations"
        of_best = f" | best {best[0].value:.3f}" if best else ""
        print(f"{place}/{search.args.n_trials} | trial {trial.number}: {result}{of_best}", flush=True)
    return len(ended)


def write_results(search: Search) -> None:
    """``best.yml``, ``trials.json`` and ``optimize.png``."""
    args, best = search.args, search.ranked()
    trials = [
        {
            "number": trial.number,
            "state": trial.state.name,
            "value": trial.value if trial in best else None,
            "evaluations": list(trial.intermediate_values.values()),
            "settings": decoded(trial.params, search.space),
            "seconds": (trial.datetime_complete - trial.datetime_start).total_seconds(),
            **trial.user_attrs,
        }
        for trial in search.ended()
    ]
    about = {"metric": args.metric, "search": search.study.user_attrs["search"], "versions": library_versions()}
    write_json(search.folder / "trials.json", {**about, "trials": trials})
    if best:
        write_text(search.folder / "best.yml", best_entry(search))
        draw(search, search.folder / "optimize.png")


def best_entry(search: Search) -> str:
    """The best settings as an entry of a YAML file: ``--preset tuned`` takes them, the default what they were put into."""
    args, best = search.args, search.ranked()[0]
    base = load_entry(args.algo, args.env, args.conf_file, "default")
    chosen = nested(decoded(best.params, search.space))
    found = merged(search.entry, chosen)
    del found["n_timesteps"]  # that of a search may be far from enough
    tuned = {
        name: value for name, value in found.items() if value != base.get(name) and (value or name in base or name in chosen)
    }
    head = (
        f"# Trial {best.number}, the best of {len(search.ended())}: {args.metric} {best.value:.4g}, mean over {args.n_seeds} "
        f"seeds of the last of {args.n_evaluations} evaluations.\n"
        "# It was chosen for that value: measure it anew, with other seeds.\n"
    )
    return head + yaml.safe_dump({args.env: {**base, "tuned": tuned}}, sort_keys=False, allow_unicode=True)


def draw(search: Search, path: Path) -> None:
    """
    The values in the order of the trials, and against each setting.

    :param search: whose trials
    :param path: of the PNG
    """
    args, trials = search.args, sorted(search.ranked(), key=lambda trial: trial.number)
    values = np.array([trial.value for trial in trials])
    cut = [trial for trial in search.ended() if trial not in trials]
    colour = ALGO_COLOURS.get(args.algo, REFERENCE_COLOUR)
    figure, axes = new_figure(1 + len(search.space.settings), columns=4, size=(4.0, 3.0))
    figure.suptitle(f"{ALGO_LABELS.get(args.algo, args.algo)} in {args.env}: {len(trials)} trials, and {len(cut)} cut short")
    best_so_far = np.minimum.accumulate(values) if args.minimize else np.maximum.accumulate(values)
    numbers = [trial.number for trial in trials]
    axes[0].scatter(numbers, values, color=colour, s=12)
    for trial in cut:
        axes[0].axvline(
            trial.number, color=REFERENCE_COLOUR, alpha=0.2, linewidth=1, label="cut short" if trial is cut[0] else ""
        )
    axes[0].xaxis.set_major_locator(MaxNLocator(integer=True))
    axes[0].xaxis.set_major_formatter(ScalarFormatter())
    axes[0].step(numbers, best_so_far, where="post", color=REFERENCE_COLOUR, label="best so far")
    axes[0].set_xlabel("trial")
    axes[0].set_ylabel(args.metric.replace("_", " "))
    axes[0].legend(fontsize="x-small")
    for axis, (name, domain) in zip(axes[1:], search.space.settings.items(), strict=True):
        chosen = [trial.params[name] for trial in trials]
        if isinstance(domain, Range):
            axis.set_xscale("log" if domain.log else "linear")
        else:
            labels = [str(choice) for choice in domain]
            chosen = [labels.index(str(decoded({name: value}, search.space)[name])) for value in chosen]
            axis.set_xticks(range(len(labels)), labels, fontsize="x-small")
            axis.set_xlim(-0.5, len(labels) - 0.5)
        axis.scatter(chosen, values, color=colour, s=12, alpha=0.7)
        axis.set_xlabel(name.removeprefix("policy_kwargs.").removeprefix("replay_buffer_kwargs."))
        axis.set_ylabel(args.metric.replace("_", " "))
    save_figure(figure, path)


def workers_of(args: argparse.Namespace) -> Workers | None:
    """
    Who works on the study; ``None`` for this process alone.

    :param args: the command line
    :raises ValueError: if the cluster cannot be reached
    """
    if args.worker or (args.n_jobs == 1 and args.address is None):
        return None
    return make_workers(args.address, args.n_jobs, args.num_threads, local=args.address is None)


def carry_out(search: Search, workers: Workers | None, words: Sequence[str]) -> int:
    """
    Work on the study in this process, or have others do it.

    :param search: what was built
    :param workers: these others
    :param words: the command line, for them
    :return: exit status
    """
    args, known = search.args, len(search.ended())
    if workers is None:
        for _ in search.work():
            known = tell_news(search, known)
        return 0
    logs = search.folder.resolve()
    program = (str(Path(__file__).resolve()), *words, "--worker")
    for k in range(args.n_jobs):
        workers.submit(Task(f"worker {k}", program, str(logs / f"worker_{k}.log"), str(Path.cwd()), (str(logs),)))
    worst = 0
    try:
        while not workers.idle:
            for task, status in workers.ended(LOOK):
                worst = max(worst, abs(status))
                if status:
                    print(f"error: {task.name} has stopped with status {status}; see {task.log}", file=sys.stderr)
            known = tell_news(search, known)
    except KeyboardInterrupt:
        workers.stop()
        raise
    finally:
        workers.close()
    return min(worst, 1)


def interrupt(*_: Any) -> None:
    """SIGTERM as Ctrl-C: a trial is given back."""
    raise KeyboardInterrupt


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0; 1 if a worker failed; 2 for bad input
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        args = make_parser().parse_all(words)
        if args.worker:
            signal.signal(signal.SIGTERM, interrupt)
            end_with_parent()
        th.set_num_threads(max(1, args.num_threads))
        search = build(args)
        workers = workers_of(args)
    except REFUSALS as error:
        return refused(error)
    except OSError as error:
        return refused(OSError(f"the study cannot be written to {args.output}: {error.strerror}"))
    if args.worker:
        for _ in search.work():
            pass
        return 0
    known = len(search.ended())
    goes_on = f", which has {known}" if known else ""
    print(f"{args.n_trials} trials of {args.algo} on {args.env}, study {search.name} in {search.folder}{goes_on}")
    status = 0
    try:
        status = carry_out(search, workers, words)
    finally:
        write_results(search)
    show(search, as_it_was_typed("optimize", argv))
    return status or int(not search.ranked())


def show(search: Search, command: str) -> None:
    """Print the best trials, and where everything lies."""
    best, n_ended = search.ranked(), len(search.ended())
    if n_ended < search.args.n_trials:
        print(f"{n_ended} of {search.args.n_trials} trials have ended; others are at work, or to go on: {command}")
    if not best:
        why = next((trial.user_attrs["stopped"] for trial in search.ended() if "stopped" in trial.user_attrs), None)
        print(f"no trial came to its end{f': {why}' if why else ''}")
        return
    names = list(search.space.settings)
    table = [["trial", search.args.metric, *names]]
    for trial in best[:SHOWN]:
        settings = decoded(trial.params, search.space)
        table.append([str(trial.number), f"{trial.value:.3f}", *(_short(settings[name]) for name in names)])
    columns = list(zip(*table, strict=True))
    print("\n" + as_text(columns))
    print(f"\nthe best:\n\n{yaml.safe_dump(nested(decoded(best[0].params, search.space)), sort_keys=False)}")
    written = ", ".join(str(search.folder / name) for name in ("best.yml", "trials.json", "optimize.png"))
    print(f"written: {written}")


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    start(main, "interrupted; the same command goes on with the study")
