"""
Every table and figure of the paper from one command: ``python zoo/reproduce.py table2 fig8``.

What each finished run leaves is kept at once, in a small record; a run that has its record is never run again.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.matches import Arena
from sb3_kfcv.saving.checkpoints import checkpoints_in
from zoo.command_line import REFUSALS, SEVERAL, Parser, as_it_was_typed, refused, start, whole_number
from zoo.hyperparams import CO_TRAINING
from zoo.reproduce_plan import (
    CURRICULUM,
    EXPERIMENTS,
    OF_THE_CURRICULUM,
    OWN,
    Claim,
    Experiment,
    LineUp,
    PlannedRecord,
    chosen,
    planned,
    read_experiments,
)
from zoo.reproduce_records import is_there, read_record, record_in_the_run
from zoo.reproduce_report import n_runs, write_report
from zoo.reproduce_run import facts, played, write_record
from zoo.run_groups import REWARD
from zoo.runs import Run
from zoo.sweep import add_workers, check_runs, check_workers, locked, sweep
from zoo.sweep_table import duration
from zoo.teams import yardsticks
from zoo.workers import Task, make_workers, n_cores
from zoo.worlds import World

DESCRIPTION = """\
Train what the paper shows, measure it as the paper does, and write the page that compares them. Targets: table2, fig6, fig8,
fig9, tuned, ablations, controls, readings, levers, yardstick, any experiment of hyperparams/reproduce.yml by its name, or
all. Each run that has ended leaves a record of some kilobytes below <docs>/results/reproduce, and is never run again; the same
command goes on with what is missing. Pictures and the tables of <docs>/reproduction.md are made of the records alone."""
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
        check_report(args)
        return experiments, claims, []
    folders = Path(args.log_folder), records_folder(args.docs)
    wanted = []
    for experiment in chosen(experiments, args.targets):
        own = planned(experiment, args.scale, *folders, args.seeds, args.test_episodes, args.threads)
        check_worlds(experiment, own, [claim for claim in claims if claim.experiment == experiment.name])
        wanted += own
    cells = {record.cell for record in wanted}
    for cell in args.cells:
        if cell not in cells:
            raise ValueError(f"there is no cell {cell} among these; there are {', '.join(sorted(cells))}")
    wanted = [record for record in wanted if not args.cells or record.cell in args.cells]
    return experiments, claims, sorted(wanted, key=lambda record: record.run.seed)


def check_report(args: argparse.Namespace) -> None:
    """
    :param args: the command line, with ``--report``
    :raises ValueError: for words that it has no use for
    """
    parser = make_parser()
    unused = [
        action.option_strings[-1]
        for action in parser._actions
        if action.option_strings
        and action.dest not in ("help", "report", "docs", "conf_file")
        and getattr(args, action.dest) != action.default
    ]
    if args.targets or unused:
        raise ValueError(f"--report writes the whole page, of all records; leave out {' '.join([*args.targets, *unused])}")


def check_worlds(experiment: Experiment, wanted: Sequence[PlannedRecord], claims: Sequence[Claim]) -> None:
    """
    :param experiment: the experiment
    :param wanted: its runs
    :param claims: about it
    :raises ValueError: for a metric, a group, a policy or an evaluation that a world or a run of it does not have
    """
    worlds = {record.run.env_id: record.world for record in wanted}
    if experiment.scripted and any(record.world != worlds[record.run.env_id] for record in wanted):
        raise ValueError(f"{experiment.name} has scripted policies, and runs of worlds with different settings")
    arenas = {env_id: Arena(world.make(1)) for env_id, world in worlds.items()}
    try:
        for arena in arenas.values():
            _check_names(experiment, arena, [claim.quantity for claim in claims])
        for record in {record.cell: record for record in wanted}.values():
            _check_evaluations(record, arenas[record.run.env_id], claims)
    except ValueError as error:
        raise ValueError(f"{experiment.name}: {error}") from None
    finally:
        for arena in arenas.values():
            arena.env.close()


def _check_names(experiment: Experiment, arena: Arena, further: Sequence[str]) -> None:
    """
    :param experiment: the experiment
    :param arena: its world
    :param further: quantities beside its own
    :raises ValueError: see :func:`check_worlds`
    """
    groups = arena.layout.group_names
    for line_up in [*experiment.tests.values(), *experiment.scripted]:
        for group, player in line_up.items():
            if group not in groups:
                raise ValueError(unknown_name("group", group, groups))
            arena.side(group, player)  # refuses who cannot play
    for line_up in experiment.scripted:
        if set(line_up) != set(groups):
            raise ValueError(f"scripted names {', '.join(line_up) or 'nobody'}; to be played are {', '.join(groups)}")
    known = {REWARD, *arena.quantities()}
    for of in [*experiment.quantities, *further]:
        _, name, metric = of.split("/", 2)
        metrics = OF_THE_CURRICULUM if name == CURRICULUM else known
        if metric not in metrics:
            raise ValueError(unknown_name("metric", metric, metrics))
    kept = f"return_{groups[0]}"
    for panel in [panel for panels in experiment.pictures.values() for panel in panels if "scatter" in panel]:
        if panel["scatter"].split("/", 2)[2] != kept:
            raise ValueError(f"{panel['title']}: of single episodes tests keep {kept}, not {panel['scatter']}")


def _check_evaluations(record: PlannedRecord, arena: Arena, claims: Sequence[Claim]) -> None:
    """
    :param record: of any seed of a cell
    :param arena: its world
    :param claims: about the experiment
    :raises ValueError: see :func:`check_worlds`
    """
    run, cell = record.run, record.cell
    team = run.hyperparams.model.get("team")
    learners = list(run.hyperparams.model.get("teams", [team] if team else []))
    found = yardsticks(run.args.yardstick, arena.layout, learners, run.algo == CO_TRAINING)
    known = ["eval", *(yardstick.name for yardstick in found)]
    if run.algo == "kfcv_maddpg":
        known.append(CURRICULUM)
    claimed = [claim.quantity for claim in claims if cell in (claim.cell, claim.than)]
    never = not 0 < run.args.eval_freq <= run.hyperparams.n_timesteps
    for of in [*record.experiment.quantities_of(cell), *claimed]:
        kind, name, _ = of.split("/", 2)
        if kind == "curve" and never:
            raise ValueError(f"{cell} is never evaluated (eval-freq {run.args.eval_freq}), and {of} is to be shown")
        if kind == "curve" and name not in known:
            raise ValueError(unknown_name(f"evaluation of {cell}", name, known))


def check_records(missing: Sequence[PlannedRecord]) -> None:
    """
    :param missing: runs that have no record
    :raises ValueError: for a run that has ended and cannot leave its record any more, and for a record that one of these could
        not be shown with
    """
    for record in missing:
        record_in_the_run(record.run.place, record.identity)
    for folder, record in {record.path.parent: record for record in missing}.items():
        for path in sorted(folder.glob("seed_*.json")):
            is_there(path, {**record.identity, "seed": read_record(path)["identity"]["seed"]})


@dataclass(frozen=True)
class Scripted:
    """
    Scripted policies that an experiment is read beside.

    :param experiment: the experiment
    :param world: of its runs
    :param line_up: who plays every group
    :param n_episodes: of the test
    :param path: of the record
    """

    experiment: Experiment
    world: World
    line_up: LineUp
    n_episodes: int
    path: Path

    @property
    def identity(self) -> dict[str, object]:
        """What the record is of."""
        about = {"experiment": self.experiment.name, "world": asdict(self.world)}
        return json.loads(json.dumps({**about, "players": self.line_up, "test_episodes": self.n_episodes}))


def scripted_beside(wanted: Sequence[PlannedRecord], records: Path) -> list[Scripted]:
    """
    The scripted policies that runs are read beside and that have no record yet, each once.

    :param wanted: the runs
    :param records: folder of all records
    :raises ValueError: for a record of something else, or a damaged one
    """
    found = {}
    for record in wanted:
        for line_up in record.experiment.scripted:
            path = record.experiment.scripted_record(records, line_up, record.n_test_episodes)
            found[path] = Scripted(record.experiment, record.world, line_up, record.n_test_episodes, path)
    return [own for own in found.values() if not is_there(own.path, own.identity)]


def play_scripted(scripted: Sequence[Scripted]) -> None:
    """
    Measure scripted policies.

    :param scripted: those that have no record
    """
    for own in scripted:
        print(f"{own.experiment.name}: {', '.join(own.line_up.values())} …", flush=True)
        test = played(own.world, {OWN: own.line_up}, own.n_episodes)
        write_record(own.path, {"identity": own.identity, **facts(), "test": test})


def seconds_per_step(records: Path, record: PlannedRecord) -> float | None:
    """
    How long an env step of a cell takes, by the runs of it that have ended, of any scale.

    :param records: folder of all records
    :param record: of the cell
    :return: ``None`` if there is none
    """
    ended = [read_record(path) for path in (records / record.experiment.name).glob(f"scale_*/{record.cell}/seed_*.json")]
    speeds = [own["taken"]["wall"] / own["identity"]["settings"]["n_timesteps"] for own in ended]
    return float(np.mean(speeds)) if speeds else None


def list_records(wanted: Sequence[PlannedRecord], records: Path, n_workers: int) -> None:
    """
    Print what is to be done.

    :param wanted: everything
    :param records: folder of all records
    :param n_workers: so many at a time
    """
    counts = {"begin": 0, "go on": 0, "done": 0}
    total, unknown = 0.0, 0
    speeds: dict[Path, float | None] = {}
    for record in wanted:
        run = record.run.place.run()
        todo = "done" if record.path.is_file() else "begin" if run is None else "go on"
        counts[todo] += 1
        n_timesteps = record.run.hyperparams.n_timesteps
        line = f"{todo:5}  {record.experiment.name} {record.cell} seed {record.run.seed}, {n_timesteps:,} env steps"
        if todo != "done":
            if record.path.parent not in speeds:
                speeds[record.path.parent] = seconds_per_step(records, record)
            speed = speeds[record.path.parent]
            if speed is None:
                unknown += 1
            else:
                seconds = speed * (n_timesteps - (0 if run is None else steps_of(run, n_timesteps)))
                total += seconds
                line += f", about {duration(seconds)}"
        print(line)
    print(f"{n_runs(len(wanted))}: {counts['begin']} to begin, {counts['go on']} to go on with, {counts['done']} done")
    if total:
        rest = f", and {n_runs(unknown)} of which nothing is known yet" if unknown else ""
        print(f"about {duration(total / n_workers)} with {n_workers} at a time{rest}")


def steps_of(run: Run, n_timesteps: int) -> int:
    """The env steps that a run of so many need not do again."""
    return n_timesteps if run.has_ended else min(n_timesteps, max(checkpoints_in(run.folder.path), default=0))


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
        play_scripted(scripted_beside(wanted, records_folder(args.docs)))
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
        records = records_folder(args.docs)
        missing = [record for record in wanted if not is_there(record.path, record.identity)]
        check_records(missing)
        scripted_beside(wanted, records)  # refuses records of something else
        check_runs([record.run for record in missing])
        if args.dry_run:
            list_records(wanted, records, args.workers or max(1, n_cores() // args.threads))
            return 0
        status = reproduce(args, wanted, as_it_was_typed("reproduce", argv)) if wanted else 0
        for path in write_report(experiments, claims, Path(args.docs), records):
            print(f"written: {path}")
        return status
    except REFUSALS as error:
        return refused(error)
    except OSError as error:
        return refused(OSError(f"the records or the page cannot be written: {error}"))


if __name__ == "__main__":
    start(main)
