"""
A page of films, curves, tables and commands, made of runs: ``python zoo/gallery.py logs -o docs``.

Everything on the page is what the other commands of the zoo make of the runs; the page names each command beside its result.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import shlex
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.saving.checkpoints import checkpoints_in
from sb3_kfcv.teams.players import scripted_for
from sb3_kfcv.vec_env.make import layout_of
from zoo import compare, evaluate, plot, record_video
from zoo.command_line import REFUSALS, Parser, as_it_was_typed, refused, start, this_command, whole_number
from zoo.match_results import write_text
from zoo.plots import ALGO_LABELS
from zoo.run_folder import file_name
from zoo.run_groups import rewards
from zoo.runs import Run, find_runs
from zoo.worlds import World

DESCRIPTION = """\
Make a page of runs: per world the learning curves of all of them, and of each algorithm its best run, filmed, measured beside
the scripted policies, and with the command that trained it. Every result stands beside the command that made it. Writes
gallery.md and the pictures in gallery/ into the folder of -o."""
EXAMPLES = ("logs", "my_sweep -o docs -n 1000", "'logs/*/Grassland-v0_*' --films 0")

PAGE = """\
# Gallery

Made by

    {command}

of {runs}. Of each algorithm the run with the best last evaluation is filmed and measured. That is a choice by the
evaluation, so the numbers of single runs flatter; the comparison over all seeds does not.
"""


@dataclass(frozen=True)
class Command:
    """
    A command of the zoo.

    :param name: such as ``"plot"``
    :param main: what carries it out
    """

    name: str
    main: Callable[[Sequence[str]], int]

    def run(self, words: Sequence[str]) -> str:
        """
        Carry it out.

        :param words: its command line
        :return: what it prints
        :raises ValueError: what it says if it refuses
        """
        printed, complained = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(complained):
            status = self.main(words)
        if status:
            *_, last = complained.getvalue().strip().splitlines()
            raise ValueError(last.removeprefix("error: "))
        shown = [line for line in printed.getvalue().strip().splitlines() if not line.startswith("written: ")]
        return "\n".join(shown).strip()

    def typed(self, words: Sequence[str]) -> str:
        """As one types it."""
        return shlex.join([*this_command(self.name), *words])


RECORD = Command("record_video", record_video.main)
EVALUATE = Command("evaluate", evaluate.main)
PLOT = Command("plot", plot.main)
COMPARE = Command("compare", compare.main)


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("gallery", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN", help="run folders, folders over them, quoted patterns")
    add("-n", "--n-episodes", type=whole_number, default=200, help="of each evaluation (default: %(default)s)")
    add("--films", type=int, default=4, help="episodes in each film, 0: no films (default: %(default)s)")
    add("--seed", type=int, default=0, help="of the first episode (default: %(default)s)")
    add("-o", "--output", default="gallery", help="folder of the page (default: %(default)s)")
    return parser


def plays(run: Run) -> bool:
    """Whether a run has something to play yet."""
    return run.has_ended or bool(checkpoints_in(run.folder.path))


def last_reward(run: Run) -> float:
    """Mean reward of the last evaluation; −∞ where there is none."""
    means = rewards(run)
    return float(means[-1]) if len(means) else -np.inf


def best_of_each(runs: Sequence[Run]) -> dict[str, Run]:
    """Algorithm → its run with the best last evaluation of those that can play, in the order of ``ALGO_LABELS``."""
    found: dict[str, Run] = {}
    for run in filter(plays, runs):
        if run.algo not in found or last_reward(run) > last_reward(found[run.algo]):
            found[run.algo] = run
    order = list(ALGO_LABELS)
    return dict(sorted(found.items(), key=lambda item: order.index(item[0]) if item[0] in order else len(order)))


def scripted(layout: AgentLayout) -> list[str]:
    """What stands beside the trained ones: the scripted policies that can play all groups."""
    names = [scripted_for(layout, group) for group in layout.group_names]
    return [name for name in names[0] if all(name in others for others in names)]


def block(command: str, result: str) -> str:
    """A command, and what it printed."""
    return f"```\n$ {command}\n\n{result}\n```"


def section(env_id: str, runs: Sequence[Run], args: argparse.Namespace, folder: Path) -> str:
    """
    All about one world. What cannot be made of its runs (curves without evaluations, films without models) is left out, and
    the page says so.

    :param env_id: id of the world
    :param runs: in it
    :param args: the command line
    :param folder: where pictures go
    :return: Markdown
    """
    name, best = file_name(env_id), best_of_each(runs)
    paths = [str(run.folder.path) for run in runs]
    measured = [run for run in runs if last_reward(run) > -np.inf]
    parts = [f"## {env_id}"]
    if measured:
        own = [str(run.folder.path) for run in measured]
        words = [*own, "-o", str(folder / f"{name}_curves.png")]
        PLOT.run(words)
        parts += [f"![Learning curves in {env_id}](gallery/{name}_curves.png)", f"    {PLOT.typed(words)}"]
    else:
        parts.append(f"None of the runs has evaluations: no curves, and no comparison ({', '.join(paths)}).")
    if len({run.algo for run in measured}) > 1:
        with TemporaryDirectory() as made:  # of which the page shows the table and the picture
            parts += ["### All seeds", block(COMPARE.typed(own), COMPARE.run([*own, "-o", made]))]
            shutil.copyfile(Path(made) / "compare.png", folder / f"{name}_comparison.png")
        parts.append(f"![All seeds in {env_id}](gallery/{name}_comparison.png)")
    if not best:
        return "\n\n".join([*parts, "None of the runs has a model or a checkpoint yet: nothing to measure, and no films."])
    layout = layout_of(World.of(runs[0]).make(1))
    words = [*(str(run.folder.path) for run in best.values()), *scripted(layout)]
    words += ["-n", str(args.n_episodes), "--seed", str(args.seed)]
    parts += ["### The best run of each algorithm"]
    if len(layout.group_names) > 1:
        parts.append(
            f"Each run plays all of {' and '.join(layout.group_names)}: what a group reaches depends on how good the others "
            "are. Who beats whom is for zoo/match.py to tell."
        )
    parts.append(block(EVALUATE.typed(words), EVALUATE.run(words)))
    for algo, run in best.items():
        label = ALGO_LABELS.get(algo, algo)
        parts.append(f"### {label}\n\nTrained by\n\n    {run.folder.command}")
        if args.films:
            film = f"{name}_{algo}.gif"
            words = [str(run.folder.path), "-n", str(args.films), "--seed", str(args.seed), "-o", str(folder / film)]
            RECORD.run(words)
            parts += [f"![{label} in {env_id}](gallery/{film})", f"    {RECORD.typed(words)}"]
    return "\n\n".join(parts)


def build(args: argparse.Namespace) -> dict[str, list[Run]]:
    """
    The runs of each world.

    :param args: the command line
    :raises ValueError: one sentence that says what is wrong, with a damaged file of evaluations, too
    """
    require_count("-n", args.n_episodes, least=2)
    require_count("--films", args.films, least=0)
    require_count("--seed", args.seed, least=0)
    worlds: dict[str, list[Run]] = {}
    for run in find_runs(args.runs):
        rewards(run)  # refuses damaged ones
        worlds.setdefault(run.env_id, []).append(run)
    return worlds


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, or 2 for bad input
    """
    try:
        args = make_parser().parse_all(argv)
        worlds = build(args)
        folder = Path(args.output) / "gallery"
        folder.mkdir(parents=True, exist_ok=True)
        n_runs = sum(map(len, worlds.values()))
        head = PAGE.format(command=as_it_was_typed("gallery", argv), runs="1 run" if n_runs == 1 else f"{n_runs} runs")
        sections = []
        for env_id, runs in worlds.items():
            print(f"{env_id}: {len(runs)} {'run' if len(runs) == 1 else 'runs'} …", flush=True)
            sections.append(section(env_id, runs, args, folder))
        page = Path(args.output) / "gallery.md"
        write_text(page, "\n\n".join([head.strip(), *sections]) + "\n")
    except REFUSALS as error:
        return refused(error)
    except OSError as error:
        return refused(OSError(f"the page cannot be written to {args.output}: {error.strerror}"))
    print(f"written: {page}")
    return 0


if __name__ == "__main__":
    start(main, "interrupted; the page was not written")
