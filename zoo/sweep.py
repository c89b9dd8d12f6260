"""
Many runs from one file: ``python zoo/sweep.py my_sweep.yml``. Every run is one of ``zoo/train.py``; they are carried out side
by side on this machine, or on a Ray cluster. The same command again goes on with what is missing.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.saving.files import atomic_write
from zoo import train
from zoo.command_line import REFUSALS, SIGNALLED, Parser, as_it_was_typed, refused, start, whole_number
from zoo.runs import runs_below
from zoo.sweep_plan import PlannedRun, check_begun, check_buildable, read_plan
from zoo.sweep_table import DONE, FAILED, RUNNING, STOPPED, ProgressTable
from zoo.workers import Task, Workers, make_workers, was_killed

EXAMPLE = """\
algos: [maddpg, per_maddpg, kfcv_maddpg]
envs: [Grassland-v0, HardSpread-v0]
seeds: 5                     # 0 to 4; or a list, such as [3, 7]
settings:                    # optional: hyperparameters of each cell, as after -params
  as_tuned: {}
  far_sighted: {gamma: 0.99}
train:                       # optional: flags of zoo/train.py for all runs
  preset: tuned
  n-timesteps: 100000
"""

DESCRIPTION = f"""\
Train many runs: every algorithm in every world, with every seed and every setting of a YAML file such as

{textwrap.indent(EXAMPLE, "  ")}
Runs lie in <folder>/<setting>/seed_<seed>/<algo>/<env>_1, each as zoo/train.py makes it, for plot and compare. All are checked
before the first one begins. The same command again goes on: runs that have ended are left alone, others go on from their last
checkpoint, and what was added to the file begins. Runs use Ray where it is installed, else processes of this machine."""
EXAMPLES = (
    "my_sweep.yml --dry-run",
    "my_sweep.yml -f sweeps/gammas --workers 8",
    "my_sweep.yml --address 10.0.0.1:6379 --threads 2",
)

FAILURES = {
    2: "was refused",
    train.NOT_FINITE: "met a number that is not finite",
    train.NOT_WRITTEN: "could not write its model",
}


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("sweep", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("file", help="YAML file of the sweep, as above")
    add("-f", "--log-folder", help="where all runs lie (default: sweeps/<name of the file>)")
    add_workers(parser)
    add("--dry-run", action="store_true", help="check everything and list the runs, but begin none")
    return parser


def add_workers(parser: Parser) -> None:
    """The flags that say who carries out the runs."""
    add = parser.add_argument
    add("--workers", type=whole_number, help="runs at a time (default: as many as there are cores for)")
    add("--threads", type=whole_number, default=1, help="cores that each run takes (default: %(default)s)")
    add("--address", help="of a Ray cluster, such as 10.0.0.1:6379, or auto for the one that this machine is part of")
    add("--local", action="store_true", help="processes of this machine, without Ray")


def check_workers(args: argparse.Namespace) -> None:
    """
    :param args: the command line
    :raises ValueError: for a flag of :func:`add_workers` that cannot be
    """
    for name in ("threads", "workers"):
        if getattr(args, name) is not None:
            require_count(f"--{name}", getattr(args, name))
    if args.local and args.address:
        raise ValueError("--local goes without Ray, and --address names a Ray cluster; give one of them")


@contextmanager
def interrupted_by_signals() -> Iterator[list[int]]:
    """Ctrl-C and SIGTERM both raise KeyboardInterrupt; the list holds their numbers, since Ray raises one of its own."""
    received: list[int] = []

    def receive(number: int, _: object) -> None:
        received.append(number)
        raise KeyboardInterrupt

    before = {number: signal.signal(number, receive) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """
    Keep a second sweep out of a folder.

    :raises ValueError: if one is at it
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / ".lock", timeout=0):
            yield
    except Timeout:
        raise ValueError(f"another sweep is at work in {folder}") from None
    except OSError as error:
        raise ValueError(f"the sweep cannot write its files: {error}") from None


def check_runs(runs: Sequence[PlannedRun]) -> None:
    """
    Hold runs that were begun against what they are now to be, and build one of each kind of those that were not.

    :param runs: of the sweep
    :raises ValueError: one sentence about what is wrong
    """
    kinds: dict[tuple[str, ...], PlannedRun] = {}
    for run in runs:
        begun = run.place.run()
        if begun is not None:
            check_begun(run, begun)
        else:
            kinds.setdefault((run.setting, run.algo, run.env_id), run)
    for run in kinds.values():
        check_buildable(run)


def task_of(run: PlannedRun, plan: Path) -> Task:
    """
    What the workers are given.

    :param run: of the sweep
    :param plan: the copy of the YAML file, which they must see
    """
    program = Path(__file__).resolve().with_name("sweep_run.py")
    return Task(run.name, (str(program), *run.words), str(run.place.log.resolve()), os.getcwd(), (str(plan.resolve()),))


def what_happened(run: PlannedRun, status: int) -> str:
    """
    Why a run has failed.

    :param run: the run
    :param status: its exit status
    """
    if was_killed(status):
        return f"{run.name} was killed again and again (exit status {status}; {run.place.log})"
    how = FAILURES.get(status, "failed")
    lines = run.place.log.read_text(errors="replace").splitlines() if run.place.log.exists() else []
    errors = [line for line in lines if re.match(r"error: |[\w.]*(Error|Exception)\b", line)]
    return f"{run.name} {how} (exit status {status}; {run.place.log}){': ' + errors[-1] if errors else ''}"


def carry_out(runs: Sequence[PlannedRun], tasks: Sequence[Task], workers: Workers, table: ProgressTable) -> list[str]:
    """
    Have runs carried out.

    :param runs: of the sweep
    :param tasks: by the names of those runs that have not ended
    :param workers: who does it
    :param table: shows how far they are
    :return: what went wrong, a sentence for each run
    :raises KeyboardInterrupt: after a signal, when all runs have saved themselves
    :raises ValueError: if a machine cannot do its part
    """
    by_name = {run.name: run for run in runs}
    failures = []
    for task in tasks:
        workers.submit(task)
    try:
        while not workers.idle:
            for task, status in workers.ended(0.5):
                table.ended(task.name, FAILED if status else DONE)
                if status:
                    failures.append(what_happened(by_name[task.name], status))
            table.refresh()
    except BaseException:  # whatever it is, nothing is lost
        table.console.print("the runs are told to save themselves and to end; once more stops at once", highlight=False)
        workers.stop()
        for name, watched in table.runs.items():
            if watched.state == RUNNING:
                table.ended(name, STOPPED)
        raise
    return failures


def sweep(runs: Sequence[PlannedRun], tasks: Sequence[Task], workers: Workers, folder: Path, again: str) -> int:
    """
    Carry out a sweep that was found to be right, and say what came of it.

    :param runs: of the sweep
    :param tasks: see :func:`carry_out`
    :param workers: who does it
    :param folder: of all runs
    :param again: the command
    :return: exit status
    """
    with interrupted_by_signals() as signals, ProgressTable(runs) as table:
        try:
            failures = carry_out(runs, tasks, workers, table)
        except KeyboardInterrupt:
            failures = []
    if signals:
        print(f"{table.summary()}; to go on: {again}")
        return SIGNALLED + signals[0]
    for failure in failures:
        print(f"error: {failure}", file=sys.stderr)
    print(f"{table.summary()}; they lie in {folder}")
    if failures:
        print(f"to try again what failed: {again}")
    return 1 if failures else 0


def list_runs(runs: Sequence[PlannedRun]) -> None:
    """Print the runs, each with what is to be done."""
    counts = {"begin": 0, "go on": 0, "done": 0}
    for run in runs:
        begun = run.place.run()
        todo = "begin" if begun is None else "done" if begun.has_ended else "go on"
        counts[todo] += 1
        print(f"{todo:5}  {run.name}, {run.hyperparams.n_timesteps:,} env steps")
    print(f"{len(runs)} runs: {counts['begin']} to begin, {counts['go on']} to go on with, {counts['done']} done")


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0; 1 if a run has failed; 2 for bad input; 130 after Ctrl-C, 143 after SIGTERM
    """
    try:
        args = make_parser().parse_all(argv)
        check_workers(args)
        folder = Path(args.log_folder or Path("sweeps", Path(args.file).stem))
        runs = read_plan(args.file, folder, args.threads)
        check_runs(runs)
        if args.dry_run:
            list_runs(runs)
            return 0
        with locked(folder):
            begun = [found for run in runs if (found := run.place.run()) is not None]
            others = {str(run.folder.path) for run in runs_below(folder)} - {str(run.folder.path) for run in begun}
            if others:
                known = f"not in {args.file}, and stay as they are"
                print(f"note: of the runs in {folder} some are {known}: {', '.join(sorted(others))}", file=sys.stderr)
            plan, text = folder / "sweep.yml", Path(args.file).read_bytes()
            with atomic_write(plan) as file:
                file.write(text)
            tasks = [task_of(run, plan) for run in runs if (found := run.place.run()) is None or not found.has_ended]
            local = args.local or not tasks  # nothing to do needs no Ray
            with closing(make_workers(args.address, args.workers, args.threads, local)) as workers:
                return sweep(runs, tasks, workers, folder, as_it_was_typed("sweep", argv))
    except REFUSALS as error:
        return refused(error)


if __name__ == "__main__":
    start(main)
