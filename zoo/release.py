"""
Make small models for playing of training runs, each with a model card: ``python zoo/release.py "logs/*/HardSpread-v0_*"``.

Runs that differ by their seeds alone make one release, of the best of them. What is on the card is measured with the released
file.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path, PurePosixPath, PureWindowsPath
from tempfile import mkdtemp
from typing import Any

from filelock import FileLock, Timeout

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.saving.archive import open_archive
from sb3_kfcv.saving.releases import is_released, release_model
from sb3_kfcv.saving.saveable import MODEL_KINDS
from sb3_kfcv.teams.players import Mixture, roles_in, scripted_for
from zoo import evaluate
from zoo.command_line import CONSOLE_SCRIPT, REFUSALS, Parser, as_typed, refused, start, unwritable, whole_number
from zoo.match_results import write_text
from zoo.playing import main_quantities
from zoo.release_card import Candidate, Card, Measured
from zoo.run_folder import RunFolder, file_name, file_to_play
from zoo.run_groups import Group, differences, first_of, grouped, note, only, rewards
from zoo.runs import Run, find_runs
from zoo.series import evaluation_files, evaluations
from zoo.teams import with_some_sense

DESCRIPTION = """\
Make small models for playing of training runs, each with its model card (README.md), in <folder>/<algo>/<env>_<k>, where
enjoy, record_video and evaluate find them with -f. Of runs that differ by their seeds alone the best is taken, by its last
evaluation. A released model has its actors alone: it plays to the bit as the model of the run, and cannot be trained on."""
EXAMPLES = (
    "logs/kfcv_maddpg/HardSpread-v0_1",
    '"logs/kfcv_maddpg/HardSpread-v0_*" --load-best',
    "logs -f my_agents -n 200 --force",
)

FOLDER = "trained_agents"

# Of the first episode: above all that trainings draw (below 2**31) and derive (a million and some more), yet of 32 bits.
FRESH_SEED = 4_000_000_000

# Folders in which releases are made, and within them what a new one replaces.
BESIDE = ".release-"
REPLACED = "replaced"

# Flags that say nothing of how a run learnt: where its logs went, and to whom.
OF_THE_PLACE = ("log_folder", "tensorboard_log", "track", "wandb_project_name", "wandb_entity", "wandb_tags", "run_name")

# Between the parts of a word of a command line of which each may be a path: --folder=/a, sheep=/a.zip,/b.zip, key:/a, -f/a.
PARTS = re.compile(r"([=,]|(?<=\w\w):|^-\w(?=[\\/]))")


def make_parser() -> Parser:
    """The command line."""
    parser = Parser("release", DESCRIPTION, EXAMPLES)
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN", help="run folders, folders over them, quoted patterns")
    add("-f", "--folder", default=FOLDER, help="where released models lie (default: %(default)s)")
    add("--exp-id", type=int, default=1, help="number of the release, the k of <env>_<k> (default: %(default)s)")
    add("--load-best", action="store_true", help="take the model of the best evaluation, not the last one")
    add("-n", "--n-episodes", type=whole_number, default=1000, help="of each evaluation (default: %(default)s)")
    add("--seed", type=int, default=FRESH_SEED, help="of the first episode (default: %(default)s)")
    add("--force", action="store_true", help="replace a release that is there")
    return parser


@dataclass(frozen=True)
class Release:
    """
    What is to be released, found and checked.

    :param group: the runs that it is chosen from
    :param chosen: one of them
    :param model: the file of its that is released
    :param candidates: every run of the group with the reward that it was chosen by
    :param target: the folder that is made
    """

    group: Group
    chosen: Run
    model: Path
    candidates: list[Candidate]
    target: RunFolder


def build(args: argparse.Namespace) -> list[Release]:
    """
    Everything that can be refused, before anything is written.

    :param args: the command line
    :raises ValueError: one sentence that says what is wrong
    """
    require_count("-n", args.n_episodes, least=2)
    require_count("--seed", args.seed, least=0)
    require_count("--exp-id", args.exp_id)
    releases: dict[Path, Release] = {}
    for group in grouped(find_runs(args.runs)):
        release = plan(group, args)
        other = releases.setdefault(release.target.path, release)
        if other is not release:
            raise ValueError(
                f"{other.group} and {group} would both be {release.target.path}; release them one by one, with --exp-id"
            )
    return list(releases.values())


def plan(group: Group, args: argparse.Namespace) -> Release:
    """
    What is released of a group, and where it goes.

    :param group: runs that are seeds of one another
    :param args: the command line
    :raises ValueError: if they are not, if the best is not known, or if something else is where it goes
    """
    group = ended(group)
    require_seeds(group)
    scores = {run: _score(run, args.load_best) for run in group.runs}
    for run, score in scores.items():
        if score is None and len(scores) > 1:
            raise ValueError(f"{run.folder.path} has no evaluations to choose by; name the run that is to be released")
    chosen = max(scores, key=lambda run: scores[run] or 0.0)
    folder = chosen.folder
    model = folder.best_model if args.load_best else file_to_play(folder.path)
    if not model.is_file():
        raise ValueError(f"the run in {folder.path} has no best_model.zip; leave out --load-best to release its last model")
    if is_released(model):
        raise ValueError(f"{model} is a release already; release the run that it was made of")
    try:
        _ = folder.command, folder.versions
    except OSError as error:
        raise ValueError(f"cannot read {error.filename}: {error.strerror}") from None
    target = RunFolder(Path(args.folder) / group.algo / f"{file_name(group.env_id)}_{args.exp_id}", group.env_id)
    if target.path.exists():
        if not (target.last_model.is_file() and is_released(target.last_model)):
            raise ValueError(f"{target.path} is there and is no release; say another folder with -f, or another --exp-id")
        if not args.force:
            raise ValueError(f"{target.path} is released already; --force replaces it, --exp-id puts another one beside it")
    return Release(group, chosen, model, [Candidate(run.seed, score) for run, score in scores.items()], target)


def ended(group: Group) -> Group:
    """
    Of several runs those that came to their end; a note names the others. One that is alone may be at any step.

    :param group: runs that are seeds of one another
    :raises ValueError: if none did
    """
    going_on = [str(run.folder.path) for run in group.runs if not run.has_ended]
    if not going_on or len(group.runs) == 1:
        return group
    if len(going_on) == len(group.runs):
        raise ValueError(f"{group}: none of {first_of(going_on)} has come to its end; name the one that is to be released")
    note(f"left out, since not at the end of the training: {first_of(going_on)}")
    return only([group], [run for run in group.runs if run.has_ended])[0]


def require_seeds(group: Group) -> None:
    """
    :param group: runs that are to be seeds of one another
    :raises ValueError: if they differ in more than that, or if one seed is there twice
    """
    differing = differences(group)
    lengths = {run.config.get("n_timesteps"): run.folder.path for run in group.runs}
    if len(lengths) > 1:
        differing.append(f"n_timesteps ({', '.join(f'{steps} in {path}' for steps, path in lengths.items())})")
    if differing:
        raise ValueError(f"{group}: the runs differ in {', '.join(differing)}; name only those that are to be chosen from")
    seeds: dict[int, Run] = {}
    for run in group.runs:
        other = seeds.setdefault(run.seed, run)
        if other is not run:
            raise ValueError(
                f"{other.folder.path} and {run.folder.path} have the same seed, {run.seed}; name one of them alone"
            )


def _score(run: Run, best: bool) -> float | None:
    """
    The mean reward of the evaluation that a run is chosen by: the last, or the best; ``None`` without evaluations.

    :raises ValueError: if one of its files of evaluations is damaged
    """
    for name in evaluation_files(run.folder.path):
        evaluations(run.folder.path, name)  # refuses a damaged one
    means = rewards(run)
    return float(means.max() if best else means[-1]) if len(means) else None


def portable(value: Any) -> Any:
    """
    Settings without places on this machine: of absolute paths what is below the working directory, else their last part.

    :param value: of YAML: a text, or a map or list in which there are some
    """
    if isinstance(value, Mapping):
        return {name: portable(own) for name, own in value.items()}
    if isinstance(value, list | tuple):
        return [portable(own) for own in value]
    if not isinstance(value, str):
        return value
    return _from_here(value) if _is_place(value) else "".join(map(_from_here, PARTS.split(value)))


def _is_place(text: str) -> bool:
    """Whether a text is an absolute path, of this or another system."""
    return PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute()


def _from_here(text: str) -> str:
    """An absolute path from the working directory if it lies below it, else its last part; any other text as it is."""
    if not _is_place(text):
        return text
    below = as_typed(Path(text))
    return below if below != text else PureWindowsPath(text).name  # which splits at both kinds of slashes


def portable_command(command: str, seed: int) -> str:
    """
    The command of a run as one types it elsewhere, with the seed where it was drawn.

    :param command: as it was typed
    :param seed: of the run
    """
    words = shlex.split(command)
    if len(words) > 1 and words[0] != CONSOLE_SCRIPT:
        words[:2] = ["python", f"zoo/{PureWindowsPath(words[1]).name}"]
    words = portable(words)
    if not any(word.partition("=")[0] == "--seed" for word in words):
        words += ["--seed", str(seed)]
    return shlex.join(words)


def write_run(release: Release, folder: RunFolder) -> None:
    """
    Write all but the card: the model, what the commands ask a run for, and its evaluations.

    :param release: what is released
    :param folder: where
    """
    run = release.chosen
    release_model(release.model, folder.last_model)
    for file in evaluation_files(run.folder.path).values():
        shutil.copyfile(file, folder.path / file.name)
    arguments = {name: value for name, value in run.args.items() if name not in OF_THE_PLACE}
    command = portable_command(run.folder.command, run.seed)
    versions = {name: number for name, number in run.folder.versions.items() if name != "platform"}
    folder.describe(portable(run.config), portable(arguments), command, versions)


def comparisons(layout: AgentLayout, model: Path) -> list[list[str]]:
    """
    Whom a model is measured beside, and against whom: the words of zoo/evaluate.py after the run. A model of all groups is
    measured as a whole, and each of its groups against scripted ones; a model of a team against those of its training.

    :param layout: of its world
    :param model: the file
    """
    groups, opponents = roles_in(model)
    able = {group: scripted_for(layout, group) for group in layout.group_names}
    of_all = [name for name in able[groups[0]] if all(name in able[group] for group in groups)]
    if set(groups) < set(layout.group_names):
        teams = [f"{group}={_as_word(player)}" for group, player in opponents.items()]
        return [[] if any(team.endswith("=") for team in teams) else [*of_all, "--team", *teams]]
    words = [of_all]
    for group in groups if len(groups) > 1 else ():
        others = [[f"{other}={player}" for player in with_some_sense(able[other])] for other in groups if other != group]
        words += [[*able[group], "--team", *teams] for teams in product(*others)]
    return words


def _as_word(player: Any) -> str:
    """A player as the command line names it; nothing if only a file holds it."""
    if isinstance(player, Mixture) and len(set(player.weights)) == 1:
        named = [_as_word(one) for one in player.players]
        return ",".join(named) if all(named) else ""
    return player if isinstance(player, str) else ""


def measure(words: Sequence[str], run: Path, shown_run: str, args: argparse.Namespace) -> Measured:
    """
    Measure a released model beside others, as zoo/evaluate.py does.

    :param words: of its command line, after the run
    :param run: folder of the released model
    :param shown_run: the folder as the card names it
    :param args: the command line
    """
    more = [*words, "-n", str(args.n_episodes), "--seed", str(args.seed)]
    measured = evaluate.build(evaluate.make_parser().parse_all([str(run), *more]))
    results = evaluate.intervals(measured, evaluate.play(measured, args.n_episodes, args.seed))
    return Measured(
        f"python zoo/evaluate.py {shlex.join([shown_run, *more])}",
        evaluate.same_in_all(measured.casts) if len(measured.casts) > 1 else {},
        results,
        main_quantities(measured.arena),
    )


def shown_place(folder: str) -> str:
    """The folder of all releases as cards name it: from the working directory if it lies below it, else its last part."""
    return portable(os.path.abspath(folder))


@contextmanager
def beside(folder: Path) -> Iterator[Path]:
    """
    A hidden folder to make a release in, gone at the end.

    :param folder: where releases lie
    """
    made = Path(mkdtemp(prefix=BESIDE, dir=folder))
    with FileLock(made / ".lock"):
        try:
            yield made
        finally:
            clear(made)


def clear(made: Path) -> None:
    """
    Remove a folder in which a release was made; what it was to replace goes back to its place if that is empty.

    :param made: the folder
    """
    for replaced in (made / REPLACED).glob("*/*"):
        place = made.parent / replaced.relative_to(made / REPLACED)
        if not place.exists():
            replaced.rename(place)
    shutil.rmtree(made)


def clear_stale(folder: Path) -> None:
    """
    Remove what killed commands left; folders of those that are at work are locked.

    :param folder: where releases lie
    """
    for made in folder.glob(f"{BESIDE}*"):
        with suppress(Timeout), FileLock(made / ".lock", timeout=0):
            clear(made)


def swap(new: Path, target: Path, aside: Path) -> None:
    """
    Put a release in its place; an older one is set aside before.

    :param new: the release
    :param target: its place
    :param aside: where to
    """
    if target.exists():
        aside.parent.mkdir(parents=True)
        target.rename(aside)
    new.rename(target)


def make(release: Release, args: argparse.Namespace) -> None:
    """
    Write a release, whole or not at all: it is made and measured beside its place.

    :param release: what is released
    :param args: the command line
    """
    target, run = release.target, release.chosen
    within = target.path.relative_to(args.folder)
    shown_folder = shown_place(args.folder)
    target.path.parent.mkdir(parents=True, exist_ok=True)
    with beside(Path(args.folder)) as made:
        folder = RunFolder(made / within, target.env_id)
        write_run(release, folder)
        with open_archive(folder.last_model, *MODEL_KINDS) as archive:
            attributes, normalized = archive.read("attributes"), "normalization" in archive
        shown_run = (PurePosixPath(shown_folder) / within.as_posix()).as_posix()
        layout = attributes["layout"]
        card = Card(
            Run(folder),
            folder=shown_folder,
            path=shown_run,
            layout=layout,
            n_timesteps=attributes["num_timesteps"],
            normalized=normalized,
            candidates=release.candidates,
            best=args.load_best,
            ended=run.has_ended,
            measured=[measure(words, folder.path, shown_run, args) for words in comparisons(layout, folder.last_model)],
            n_episodes=args.n_episodes,
            seed=args.seed,
        )
        write_text(folder.path / "README.md", card.text())
        swap(folder.path, target.path, made / REPLACED / within)
    of = f"seed {run.seed}, the best of {release.group.size}" if len(release.group.runs) > 1 else f"seed {run.seed}"
    size = sum(file.stat().st_size for file in target.path.rglob("*") if file.is_file())
    print(f"{release.group}: {of}; written: {target.path}, {size / 1e6:.2f} MB", flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status: 0, or 2 for bad input
    """
    try:
        args = make_parser().parse_all(argv)
        clear_stale(Path(args.folder))
        for release in build(args):
            make(release, args)
    except REFUSALS as error:
        return refused(error)
    except OSError as error:
        return refused(OSError(unwritable(args.folder, error)))
    return 0


if __name__ == "__main__":
    start(main, "interrupted; nothing was written of what was not finished")
