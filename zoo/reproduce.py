"""
Every table and figure of the paper from one command: ``python zoo/reproduce.py table2 fig8``.

What each finished run leaves is kept at once, in a small record; a run that has its record is never run again.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.matches import Arena
from zoo.command_line import REFUSALS, SEVERAL, Parser, as_it_was_typed, refused, start, whole_number
from zoo.reproduce_plan import (
    EXPERIMENTS,
    Claim,
    Experiment,
    LineUp,
    PlannedRecord,
    chosen,
    is_there,
    planned,
    read_experiments,
    read_record,
)
from zoo.reproduce_report import write_report
from zoo.reproduce_run import facts, played, write_record
from zoo.run_groups import REWARD
from zoo.sweep import add_workers, check_runs, check_workers, locked, sweep
from zoo.sweep_table import duration
from zoo.workers import Task, make_workers, n_cores
from zoo.worlds import World

DESCRIPTION = """\
Train what the paper shows, measure it as the paper does, and write the page that compares them. Targets: table2, fig6, fig8,
fig9, ablations, yardstick, tuned, single experiments of hyperparams/reproduce.yml, or all. Each run that has ended leaves a
record of some kilobytes below <docs>/results/reproduce, and is never run again; the same command goes on with what is missing.
Pictures and the tables of <docs>/reproduction.md are made of the records alone."""
EXAMPLES = ("table2 --dry-run", "all --scale 0.1 --seeds 5 --workers 2", "fig8 fig9", "--report")


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("reproduce", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("targets", nargs="*", metavar="TARGET", help="what to reproduce")
    add("--scale", type=float, default=1.0, help="share of the paper's episodes (default: %(default)s)")
    add("--seeds", type=whole_number, help="of each cell, from 0 on (default: the experiment's, 5 or 10)")
    add("--test-episodes", type=whole_number, help="of each test (default: the experiment's, 10,000 as in the paper)")
    add("--cells", **{**SEVERAL, "metavar": "NAME"}, help="only these cells, as --dry-run lists them")
    add("-f", "--log-folder", default="reproductions", help="where runs lie while they train (default: %(default)s)")
    add("-o", "--docs", default="docs", help="folder of the page, the records and the pictures (default: %(default)s)")
    add("-conf", "--conf-file", default=str(EXPERIMENTS), help="another YAML file of experiments and claims")
    add_workers(parser)
    add("--keep-runs", action="store_true", help="keep checkpoints and logs of runs that have ended")
    add("--dry-run", action="store_true", help="check everything and list the runs, but begin none")
    add("--report", action="store_true", help="only write the page, of the records that there are")
    return parser


def records_folder(docs: str | Path) -> Path:
    """Where all records lie."""
    return Path(docs, "results", "reproduce")


def build(args: argparse.Namespace) -> tuple[dict[str, Experiment], list[Claim], list[PlannedRecord]]:
    """
    Everything that can be refused, before anything is begun.

    :param args: the command line
    :return: all experiments, the claims, and what is to be measured, the first seed of everything first
    :raises ValueError: one sentence that says what is wrong
    """
    check_workers(args)
    for name, least in (("seeds", 1), ("test_episodes", 2)):
        if getattr(args, name) is not None:
            require_count(f"--{name.replace('_', '-')}", getattr(args, name), least)
    if not 0 < args.scale <= 1:
        raise ValueError(f"--scale is {args.scale}; it must be above 0 and at most 1")
    experiments, claims = read_experiments(args.conf_file)
    if args.report:
        if args.targets:
            raise ValueError(f"--report writes the whole page, of all records; leave out {' '.join(args.targets)}")
        return experiments, claims, []
    folders = Path(args.log_folder), records_folder(args.docs)
    these = chosen(experiments, args.targets)
    for experiment in these:
        check_metrics(experiment, [claim.quantity for claim in claims if claim.experiment == experiment.name])
    wanted = [
        record
        for experiment in these
        for record in planned(experiment, args.scale, *folders, args.seeds, args.test_episodes, args.threads)
    ]
    cells = {record.cell for record in wanted}
    for cell in args.cells:
        if cell not in cells:
            raise ValueError(f"there is no cell {cell} among these; there are {', '.join(sorted(cells))}")
    wanted = [record for record in wanted if not args.cells or record.cell in args.cells]
    return experiments, claims, sorted(wanted, key=lambda record: record.run.seed)


def check_metrics(experiment: Experiment, further: Sequence[str]) -> None:
    """
    :param experiment: whose quantities are to be measured
    :param further: quantities beside its own
    :raises ValueError: for a metric that a world of it does not have, with the nearest one
    """
    for env_id in sorted(experiment.env_ids):
        arena = Arena(World(env_id).make(1))
        known = {REWARD, *arena.quantities()}
        arena.env.close()
        for of in [*experiment.quantities, *further]:
            metric = of.split("/", 2)[2]
            if metric not in known:
                raise ValueError(f"{experiment.name}: {unknown_name('metric', metric, known)}")


def play_scripted(experiments: Sequence[Experiment], records: Path, n_test_episodes: int | None) -> None:
    """
    Measure the scripted policies that experiments are read beside, each once.

    :param experiments: whose
    :param records: folder of all records
    :param n_test_episodes: by default those of the experiment
    """
    for experiment in experiments:
        for line_up in experiment.scripted:
            n_episodes = n_test_episodes or experiment.test_episodes
            identity = scripted_identity(experiment, line_up, n_episodes)
            path = experiment.scripted_record(records, line_up)
            if not is_there(path, identity):
                print(f"{experiment.name}: {', '.join(line_up.values())} …", flush=True)
                (env_id,) = experiment.env_ids
                test = played(World(env_id), {"own": line_up}, n_episodes)
                write_record(path, {"identity": identity, **facts(), "test": test})


def scripted_identity(experiment: Experiment, line_up: LineUp, n_episodes: int) -> dict[str, object]:
    """What the record of scripted policies is of."""
    return {"experiment": experiment.name, "players": line_up, "test_episodes": n_episodes}


def seconds_of(record: PlannedRecord, wanted: Sequence[PlannedRecord]) -> float | None:
    """How long a run will take, by those of its cell that have ended."""
    ended = [own.path for own in wanted if (own.path.parent == record.path.parent) and own.path.is_file()]
    return float(np.mean([read_record(path)["taken"]["wall"] for path in ended])) if ended else None


def list_records(wanted: Sequence[PlannedRecord], n_workers: int) -> None:
    """
    Print what is to be done.

    :param wanted: everything
    :param n_workers: so many at a time
    """
    counts = {"begin": 0, "go on": 0, "done": 0}
    total, unknown = 0.0, 0
    for record in wanted:
        todo = "done" if record.path.is_file() else "begin" if record.run.place.run() is None else "go on"
        counts[todo] += 1
        line = f"{todo:5}  {record.experiment.name} {record.cell} seed {record.run.seed}"
        line += f", {record.run.hyperparams.n_timesteps:,} env steps"
        seconds = seconds_of(record, wanted) if todo != "done" else None
        if seconds is not None:
            total += seconds
            line += f", about {duration(seconds)}"
        elif todo != "done":
            unknown += 1
        print(line)
    print(f"{len(wanted)} runs: {counts['begin']} to begin, {counts['go on']} to go on with, {counts['done']} done")
    if total:
        rest = f", and {unknown} runs of which nothing is known yet" if unknown else ""
        print(f"about {duration(total / n_workers)} with {n_workers} at a time{rest}")


def task_of(record: PlannedRecord, keep_runs: bool) -> Task:
    """What the workers are given: the run as one of ``zoo/reproduce_run.py``."""
    program = Path(__file__).resolve().with_name("reproduce_run.py")
    order = str(record.begin(keep_runs).resolve())
    return Task(record.run.name, (str(program), order), str(record.run.place.log.resolve()), os.getcwd(), (order,))


def reproduce(args: argparse.Namespace, wanted: Sequence[PlannedRecord], again: str) -> int:
    """
    Carry out the runs that have no record yet.

    :param args: the command line
    :param wanted: everything
    :param again: the command
    :return: exit status
    """
    missing = [record for record in wanted if not record.path.is_file()]
    folder = Path(args.log_folder)
    with locked(folder):
        experiments = {record.experiment.name: record.experiment for record in wanted}
        play_scripted([*experiments.values()], records_folder(args.docs), args.test_episodes)
        if not missing:
            return 0
        tasks = [task_of(record, args.keep_runs) for record in missing]
        with closing(make_workers(args.address, args.workers, args.threads, args.local)) as workers:
            return sweep([record.run for record in missing], tasks, workers, folder, again)


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0; 1 if a run has failed; 2 for bad input; 130 after Ctrl-C, 143 after SIGTERM
    """
    try:
        args = make_parser().parse_all(argv)
        experiments, claims, wanted = build(args)
        missing = [record for record in wanted if not is_there(record.path, record.identity)]
        check_runs([record.run for record in missing])
        if args.dry_run:
            list_records(wanted, args.workers or max(1, n_cores() // args.threads))
            return 0
        status = reproduce(args, wanted, as_it_was_typed("reproduce", argv)) if wanted else 0
        for path in write_report(experiments, claims, Path(args.docs), records_folder(args.docs)):
            print(f"written: {path}")
        return status
    except REFUSALS as error:
        return refused(error)
    except OSError as error:
        return refused(OSError(f"the records or the page cannot be written: {error}"))


if __name__ == "__main__":
    start(main)
