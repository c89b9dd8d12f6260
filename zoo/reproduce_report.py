"""What the records of a reproduction say: tables, pictures, and a verdict on each claim of the paper."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import ScalarFormatter

from sb3_kfcv.common.evaluation import Interval, with_interval
from sb3_kfcv.common.memory import in_words
from zoo.compare_results import BOOTSTRAP_SEED, clock_time, decimals
from zoo.hyperparams import CO_TRAINING
from zoo.match_results import as_markdown, described, shown, write_text
from zoo.pages import filled
from zoo.plots import draw_estimates, draw_intervals, draw_legend, draw_references, line_styles, new_figure, save_figure
from zoo.reproduce_plan import CURRICULUM, Claim, Experiment
from zoo.reproduce_records import Record, differences, read_record
from zoo.run_groups import algo_label, note
from zoo.runs import natural
from zoo.statistics import (
    ENOUGH_RUNS,
    ahead,
    difference_with_interval,
    improvement_with_interval,
    iqm_curve,
    iqm_with_interval,
    smallest_difference,
)
from zoo.sweep_plan import in_one_line

PAGE = "reproduction.md"
HOLDS, HOLDS_NOT, CANNOT_BE_TOLD = "holds", "does not hold", "cannot be told"

SIDES = ("#D55E00", "#0072B2")  # of two teams, as everywhere

EQUAL_TIME = 0.1  # share of the training whose mean is compared when both have had the same time

NOT_A_NUMBER = "not a number"
NO_NUMBER = Interval(np.nan, np.nan, np.nan)

Quantity = str | Mapping[str, Any]


@dataclass(frozen=True)
class Results:
    """
    The records of an experiment, all of one scale.

    :param experiment: the experiment
    :param scale: share of its env steps, see :func:`scale_shown`
    :param cells: cell → the records of its seeds, in the order of the experiment
    :param scripted: who plays every group → record
    """

    experiment: Experiment
    scale: float
    cells: Mapping[str, Sequence[Record]]
    scripted: Mapping[str, Record]

    @property
    def algos(self) -> dict[str, str]:
        """Cell → the algorithm that gives it its colour: of the first team, where teams learn by several."""
        return {cell: _algo_of(records[0]) for cell, records in self.cells.items()}

    def values(self, cell: str, of: Quantity, since: float = 0.0, until: float = 1.0) -> np.ndarray:
        """A quantity of each run of a cell (runs,)."""
        return np.array([quantity(record, of, since, until) for record in self.cells.get(cell, ())])

    def processor_time(self, cell: str) -> float:
        """Seconds that a run of a cell took of the processor, its evaluations and its test with it: the median."""
        return float(np.median([record["taken"]["processor"] for record in self.cells[cell]]))


def read_results(experiment: Experiment, folder: Path) -> Results:
    """
    What there is of an experiment. Records of cells that it has no more are left out, which a note tells.

    :param experiment: the experiment
    :param folder: of all records
    :raises ValueError: for a damaged record, and for one that differs from those that it would be shown with
    """
    scales: dict[float, dict[str, list[Path]]] = {}
    for place in sorted((folder / experiment.name).glob("scale_*")):
        found: dict[str, list[Path]] = {}
        for path in sorted(place.rglob("seed_*.json"), key=lambda path: natural(str(path))):
            found.setdefault(path.parent.relative_to(place).as_posix(), []).append(path)
        for cell in sorted(found.keys() - {*experiment.cells}):
            note(f"{experiment.name} has no cell {cell}; {place / cell} is left out")
        scales[_scale_of(place)] = {cell: found[cell] for cell in experiment.cells if cell in found}
    scale = scale_shown({scale: [*map(len, cells.values())] for scale, cells in scales.items()}, len(experiment.cells))
    paths = scales.get(scale, {})
    cells = {cell: _read_cell(experiment, scale, cell, own) for cell, own in paths.items()}
    return Results(experiment, scale, cells, _read_scripted(experiment, folder, cells, paths))


def _scale_of(place: Path) -> float:
    try:
        return float(place.name.removeprefix("scale_"))
    except ValueError:
        raise ValueError(f"{place} holds no records: its name must be scale_ and a number") from None


def _read_cell(experiment: Experiment, scale: float, cell: str, paths: Sequence[Path]) -> list[Record]:
    """
    The records of a cell, which differ by their seeds alone.

    :param experiment: to which they belong
    :param scale: by their paths
    :param cell: by their paths
    :param paths: by seed
    :raises ValueError: for a record of something else
    """
    records = [read_record(path) for path in paths]
    for path, record in zip(paths, records, strict=True):
        place = {"experiment": experiment.name, "scale": scale, "cell": cell, "seed": path.stem.removeprefix("seed_")}
        for name, told in place.items():
            theirs = record["identity"][name]
            if told not in (theirs, str(theirs)):
                raise ValueError(f"the record {path} is of the {name} {theirs}; its path says {told}")
        first = {**records[0]["identity"], "seed": record["identity"]["seed"]}
        for name, ours, theirs in differences(first, record["identity"]):
            raise ValueError(
                f"the record {path} was measured with {name} {in_one_line(theirs)}, and {paths[0].name} beside it with "
                f"{in_one_line(ours)}; remove the one that is not wanted"
            )
        for of in filter(is_measured, experiment.quantities_of(cell)):
            try:
                quantity(record, of)
            except ValueError:
                raise ValueError(f"the record {path} has no {of}") from None
    return records


def _read_scripted(
    experiment: Experiment, folder: Path, cells: Mapping[str, Sequence[Record]], paths: Mapping[str, Sequence[Path]]
) -> dict[str, Record]:
    """
    The records of scripted policies on the episodes on which all runs were tested.

    :param experiment: the experiment
    :param folder: of all records
    :param cells: what is shown
    :param paths: where it lies
    :return: who plays every group → record
    :raises ValueError: if not all were tested on the same episodes
    """
    tested = [(path, record) for cell, own in cells.items() for path, record in zip(paths[cell], own, strict=True)]
    if not tested:
        return {}
    n_episodes = tested[0][1]["identity"]["test_episodes"]
    names = {
        " against ".join(own.values()): experiment.scripted_record(folder, own, n_episodes) for own in experiment.scripted
    }
    scripted = {label: read_record(path) for label, path in names.items() if path.is_file()}
    tested += [(names[label], record) for label, record in scripted.items()]
    (first, shown_first), *others = tested
    for label, record in scripted.items():
        ours, theirs = world_of(shown_first), world_of(record)
        if ours != theirs:
            raise ValueError(
                f"the record {names[label]} is of the world {in_one_line(theirs)}, and {first} of {in_one_line(ours)}"
            )
    for path, record in others:
        ours, theirs = shown_first["test"]["seeds"], record["test"]["seeds"]
        if ours != theirs:
            raise ValueError(f"the record {path} is of a test with the seeds {_span(theirs)}, and {first} of {_span(ours)}")
    return scripted


def world_of(record: Record) -> dict[str, Any]:
    """Where a run was tested, or scripted policies played."""
    identity = record["identity"]
    if "players" in identity:
        return identity.get("world", {})
    settings = identity["settings"]
    return {"env_id": identity["env"], **{name: settings.get(name) for name in ("env_kwargs", "env_wrapper")}}


def _span(seeds: Sequence[int]) -> str:
    return " to ".join(map(str, seeds))


def scale_shown(n_seeds: Mapping[float, Sequence[int]], n_cells: int) -> float:
    """
    The largest scale at which every cell has the seeds for a verdict; while there is none, the one that comes nearest to it.

    :param n_seeds: scale → of each cell that has records how many
    :param n_cells: of the experiment
    :return: 0 if there is no record
    """

    def rank(scale: float) -> tuple[int, float]:
        every_cell_has = min(n_seeds[scale]) if len(n_seeds[scale]) >= n_cells else 0
        return min(every_cell_has, ENOUGH_RUNS), scale

    return max((scale for scale, counts in n_seeds.items() if counts), key=rank, default=0.0)


def quantity(record: Record, of: Quantity, since: float = 0.0, until: float = 1.0) -> float:
    """
    A number of a run.

    :param record: of the run
    :param of: ``test/<test>/<metric>``, ``curve/<evaluation>/<metric>``, or weights of these and what is added
    :param since: mean of a curve from this share of the training on
    :param until: up to this share of the training; of a time between two evaluations the later one counts
    :raises ValueError: if the record has no such number
    """
    if not isinstance(of, str):
        parts = [weight * quantity(record, name, since, until) for name, weight in of["weights"].items()]
        return sum(parts) + of.get("plus", 0.0)
    kind, name, metric = of.split("/", 2)
    try:
        if kind == "test":
            return _number(record["test"]["tests"][name]["mean"][metric])
        curve = record["curve"][name]
        steps, n_timesteps = np.array(curve["steps"]), record["identity"]["settings"]["n_timesteps"]
        last = min(np.searchsorted(steps, until * n_timesteps), len(steps) - 1)
        values = np.array(curve[metric], dtype=float)[: last + 1][steps[: last + 1] >= since * n_timesteps]
        return float(np.mean(values)) if len(values) else np.nan
    except KeyError:
        if not is_measured(of):
            return np.nan
        raise ValueError(f"the records of {record['identity']['experiment']} have no {of}") from None


def is_measured(of: str) -> bool:
    """Whether every run has a quantity: a short one may end before its curriculum has logged all."""
    return not of.startswith(f"curve/{CURRICULUM}/")


def has(record: Record, of: str) -> bool:
    """Whether a run has a quantity that may not be there."""
    _, name, metric = of.split("/", 2)
    return is_measured(of) or metric in record["curve"].get(name, {})


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def label_of(record: Record) -> str:
    """What a cell is called, for people."""
    identity = record["identity"]
    teams = identity["settings"].get("teams")
    if teams:
        return " against ".join(f"{algo_label(theirs['algo'])} {team}" for team, theirs in teams.items())
    setting = identity["cell"].rpartition("/")[0]
    return ", ".join(filter(None, (algo_label(identity["algo"]), setting.replace("_", " "))))


def _algo_of(record: Record) -> str:
    identity = record["identity"]
    if identity["algo"] != CO_TRAINING:
        return identity["algo"]
    return next(iter(identity["settings"]["teams"].values()))["algo"]


def _rng() -> np.random.Generator:
    return np.random.default_rng(BOOTSTRAP_SEED)


def iqm_of(values: np.ndarray) -> Interval:
    """The IQM over runs with its interval; no number if one of them is none."""
    return NO_NUMBER if np.isnan(values).any() else iqm_with_interval({"": values}, _rng())


def iqm_curve_of(values: np.ndarray) -> list[Interval]:
    """The IQM over runs at each of several times (times, runs); no number where one of them is none."""
    lacking = np.isnan(values).any(axis=1)
    found = iqm_curve(np.where(lacking[:, None], 0.0, values), _rng())
    return [NO_NUMBER if none else own for none, own in zip(lacking, found, strict=True)]


def in_words_or_none(interval: Interval, places: int) -> str:
    """An interval as tables show it."""
    return NOT_A_NUMBER if np.isnan(interval.mean) else shown(interval, places)


# ---- verdicts


@dataclass(frozen=True)
class Verdict:
    """
    What runs say of a claim.

    :param claim: what is claimed
    :param numbers: what was found, in words
    :param n_seeds: of whoever has fewest
    :param word: holds, does not hold, cannot be told
    """

    claim: Claim
    numbers: str
    n_seeds: int
    word: str


def judged(claim: Claim, results: Results) -> Verdict:
    """
    Hold a claim against the records: by :func:`~zoo.statistics.ahead` for two cells, by :func:`above` for a cell and a number.

    :param claim: what is claimed
    :param results: of its experiment
    """
    values = results.values(claim.cell, claim.quantity, claim.since)
    sign = -1 if claim.lower else 1
    if isinstance(claim.than, str):
        others = results.values(claim.than, claim.quantity, claim.since)
        n_seeds = min(len(values), len(others))
        if not n_seeds:
            return Verdict(claim, "", 0, CANNOT_BE_TOLD)
        if np.isnan([*values, *others]).any():
            return Verdict(claim, NOT_A_NUMBER, n_seeds, CANNOT_BE_TOLD)
        own, theirs = {"": sign * values}, {"": sign * others}
        interval = improvement_with_interval(own, theirs, _rng())
        places = decimals(np.concatenate([values, others]))
        sides = f"{shown(iqm_of(values), places)} against {shown(iqm_of(others), places)}"
        numbers, so = f"{sides}; P {shown(interval)}", ahead(own, theirs, _rng())
    else:
        n_seeds = len(values)
        if not n_seeds:
            return Verdict(claim, "", 0, CANNOT_BE_TOLD)
        interval = iqm_of(values)
        numbers, so = in_words_or_none(interval, 2), above(iqm_of(sign * values), sign * claim.than, n_seeds)
    return Verdict(claim, numbers, n_seeds, {True: HOLDS, False: HOLDS_NOT, None: CANNOT_BE_TOLD}[so])


def above(interval: Interval, border: float, n_seeds: int) -> bool | None:
    """
    The rule for a cell and a number: whether the whole interval is on one side of the number.

    :param interval: of what should be high
    :param border: that it should be above
    :param n_seeds: from which it was found
    :return: ``None`` if it cannot be told: also from fewer than ``ENOUGH_RUNS`` seeds
    """
    if n_seeds < ENOUGH_RUNS or not (interval.low > border or interval.high < border):
        return None
    return interval.low > border


# ---- tables: lines of texts, the head first


def results_table(results: Results) -> str:
    """The columns of an experiment: each cell, what was published of it, and the scripted policies."""
    columns = results.experiment.columns
    found = {cell: {name: results.values(cell, of) for name, of in columns.items()} for cell in results.cells}
    every = {name: np.concatenate([own[name] for own in found.values()]) for name in columns}
    places = {name: places_of(values) for name, values in every.items()}
    lower = {name for name, side in results.experiment.better.items() if side == "lower"}
    lines = [["", *(f"{name} {'↓' if name in lower else '↑'}" for name in columns), "seeds"]]
    for cell, records in results.cells.items():
        numbers = [in_words_or_none(iqm_of(values), places[name]) for name, values in found[cell].items()]
        lines.append([label_of(records[0]), *numbers, str(len(records))])
        published = results.experiment.published.get(cell)
        if published:
            lines.append([f"· {results.experiment.source}", *(_published(published.get(name)) for name in columns), ""])
    for label, record in results.scripted.items():
        lines.append([f"`{label}`", *(_scripted(record, of, places[name]) for name, of in columns.items()), ""])
    return as_markdown(lines)


def places_of(values: np.ndarray) -> int:
    """How many decimals a table shows of some values."""
    numbers = values[~np.isnan(values)]
    return max(2, decimals(numbers)) if len(numbers) else 2


def _published(value: Any) -> str:
    if value is None:
        return ""
    return " ± ".join(map(str, value)) if isinstance(value, list) else str(value)


def _scripted(record: Record, of: Quantity, places: int) -> str:
    try:
        value = quantity(record, of)
    except (KeyError, ValueError):
        return ""
    return NOT_A_NUMBER if np.isnan(value) else f"{value:.{places}f}"


def effects_table(results: Results) -> str:
    """Every cell beside the default one, the largest effect first."""
    default, of = results.experiment.effects["default"], results.experiment.effects["quantity"]
    base = results.values(default, of)
    if not len(base):
        return f"*The default, {default}, has not been measured yet.*"
    head = ["", described(of.rpartition("/")[2]), "difference to the default", "smallest that could be shown", "so"]
    course = results.experiment.effects.get("course")
    rows = []
    for cell, records in results.cells.items():
        values = results.values(cell, of)
        places = places_of(np.concatenate([values, base]))
        difference = difference_between(values, base)
        line = [label_of(records[0]), in_words_or_none(iqm_of(values), places)]
        line += [""] * 3 if cell == default else _effect(values, base, difference, places)
        if course:
            line += [""] * 4 if cell == default else _over_the_training(results, cell, default, course, places)
        rows.append((np.inf if cell == default else abs(np.nan_to_num(difference.mean)), [*line, str(len(values))]))
    if course:
        head += ["difference over the training", "so", "time", "difference at equal time"]
    return as_markdown([[*head, "seeds"], *(line for _, line in sorted(rows, key=lambda row: -row[0]))])


def difference_between(values: np.ndarray, base: np.ndarray) -> Interval:
    """The difference of two IQMs with its interval; no number if one of the values is none."""
    return NO_NUMBER if np.isnan([*values, *base]).any() else difference_with_interval(values, base, _rng())


def _effect(values: np.ndarray, base: np.ndarray, difference: Interval, places: int) -> list[str]:
    """The difference, the smallest one that could be shown, and what follows."""
    if np.isnan(difference.mean):
        return [NOT_A_NUMBER, "", CANNOT_BE_TOLD]
    least = smallest_difference(values, base)
    so = better_or_worse(values, base)
    return [shown(difference, places), "" if np.isnan(least) else f"{least:.{places}f}", so]


def better_or_worse(values: np.ndarray, base: np.ndarray) -> str:
    """Whether runs of a cell are better than those of the default, in a word."""
    return {True: "better", False: "worse", None: CANNOT_BE_TOLD}[ahead({"": values}, {"": base}, _rng())]


def _over_the_training(results: Results, cell: str, default: str, of: str, places: int) -> list[str]:
    """
    The difference of the means over the training and what follows, how many times the default's time a cell takes, and the
    difference when the slower one has had the other one's time.
    """
    whole, base = (results.values(name, of) for name in (cell, default))
    difference = difference_between(whole, base)
    so = better_or_worse(whole, base)
    times = {name: results.processor_time(name) for name in (cell, default)}
    until = {name: min(times.values()) / time for name, time in times.items()}
    late = difference_between(*(results.values(name, of, until[name] - EQUAL_TIME, until[name]) for name in (cell, default)))
    time = f"× {times[cell] / times[default]:.2f}"
    return [in_words_or_none(difference, places), so, time, in_words_or_none(late, places)]


def contrasts_table(results: Results) -> str:
    """Cells taken together beside other cells taken together, by the quantities of the effects."""
    effects = results.experiment.effects
    head = ["", f"difference of {described(effects['quantity'].rpartition('/')[2])}", "so"]
    head += ["difference over the training", "so"] if "course" in effects else []
    lines = [[*head, "runs", "seeds"]]
    for contrast in results.experiment.contrasts:
        line, sides = [contrast["says"]], (contrast["of"], contrast["than"])
        for of in (effects[key] for key in ("quantity", "course") if key in effects):
            differences = contrast_of(results, *sides, of)
            interval = with_interval(differences) if len(differences) else NO_NUMBER
            so = {True: "better", False: "worse", None: CANNOT_BE_TOLD}[above(interval, 0.0, len(differences))]
            line += [in_words_or_none(interval, places_of(differences)), so]
        n_runs_of = " / ".join(str(sum(len(results.cells.get(cell, ())) for cell in side)) for side in sides)
        lines.append([*line, n_runs_of, str(len(differences))])
    return as_markdown(lines)


def contrast_of(results: Results, cells: Sequence[str], than: Sequence[str], of: Quantity) -> np.ndarray:
    """
    The mean over some cells less that over others, for each seed that all of them have: runs of one seed have their worlds and
    their first networks in common, which can make them alike.

    :return: (seeds,)
    """
    by_seed: list[dict[int, float]] = [
        {record["identity"]["seed"]: quantity(record, of) for record in results.cells.get(cell, ())}
        for cell in [*cells, *than]
    ]
    seeds = sorted(set.intersection(*map(set, by_seed)))
    values = np.array([[own[seed] for seed in seeds] for own in by_seed])
    return values[: len(cells)].mean(axis=0) - values[len(cells) :].mean(axis=0)


def claims_table(claims: Sequence[Claim], results: Mapping[str, Results]) -> str:
    """A verdict on each claim."""
    lines = [["the paper", "here", "seeds", "scale", "so"]]
    for claim in claims:
        of_it = results[claim.experiment]
        own, scale = judged(claim, of_it), f"{of_it.scale:g}"
        lines.append([claim.says, own.numbers or "not measured yet", str(own.n_seeds), scale if own.numbers else "", own.word])
    return as_markdown(lines)


def runs_table(results: Mapping[str, Results]) -> str:
    """What the runs took, on what."""
    lines = [["experiment", "cell", "seeds", "scale", "env steps", "episodes", "time", "processor", "memory"]]
    machines: Counter[str] = Counter()
    for own in results.values():
        for cell, records in own.cells.items():
            taken = {name: float(np.median([record["taken"][name] for record in records])) for name in records[0]["taken"]}
            identity, curve = records[0]["identity"], records[0]["curve"].get("eval")
            lines.append(
                [
                    *(own.experiment.name, cell, str(len(records)), f"{own.scale:g}"),
                    f"{identity['settings']['n_timesteps']:,}",
                    f"{curve['episodes'][-1]:,.0f}" if curve else "",
                    *(clock_time(taken["wall"]), clock_time(taken["processor"]), in_words(taken["memory"])),
                ]
            )
            for record in records:
                versions = ", ".join(f"{name} {number}" for name, number in record["versions"].items())
                machines[f"{record['machine']['processor']}, {record['machine']['cores']} cores; {versions}"] += 1
    if len(lines) == 1:
        return "*No run has its record yet.*"
    told = "\n".join(f"- {n_runs(count)} on {machine}" for machine, count in machines.items())
    return f"{as_markdown(lines)}\n\nMedians over seeds.\n\n{told}"


def n_runs(count: int) -> str:
    """So many runs, in words."""
    return f"{count} run{'' if count == 1 else 's'}"


def table_of(name: str, claims: Sequence[Claim], results: Mapping[str, Results]) -> str:
    """
    What stands in a marked place of the page.

    :param name: of an experiment, ``"claims"`` or ``"runs"``
    :param claims: all of them
    :param results: experiment → what there is of it
    :raises ValueError: for a place that nobody fills
    """
    if name == "claims":
        return claims_table(claims, results)
    if name == "runs":
        return runs_table(results)
    if name not in results:
        raise ValueError(f"there is no table {name}; there are claims, runs, {', '.join(results)}")
    own = results[name]
    tables: dict[Callable[[Results], str], Any] = {
        results_table: own.experiment.columns,
        effects_table: own.experiment.effects,
        contrasts_table: own.experiment.contrasts,
    }
    if not own.cells:
        return f"*Not measured yet: `python zoo/reproduce.py {name}`.*"
    parts = [table(own) for table, wanted in tables.items() if wanted]
    if own.scale != 1:
        parts.append(f"At scale {own.scale:g}.")
    for picture in cells_of_pictures(own):
        titles = ", ".join(panel["title"] for panel in own.experiment.pictures[picture])
        parts.append(f"![{own.experiment.title}: {titles}](images/{picture_name(picture)})")
    return "\n\n".join(parts)


# ---- pictures


def draw_curves(axis: Axes, results: Results, cells: Sequence[str], of: str) -> None:
    """A curve of each cell over the env steps: the IQM over seeds; beside it, what scripted policies reach."""
    styles = line_styles({cell: results.algos[cell] for cell in cells})
    for cell in cells:
        steps, values = curves(results.cells[cell], of)
        draw_intervals(axis, steps, iqm_curve_of(values), styles[cell][0], label_of(results.cells[cell][0]), styles[cell][1])
    metric = of.rpartition("/")[2]
    heights = {label: record["test"]["tests"]["own"]["mean"].get(metric) for label, record in results.scripted.items()}
    if len(results.experiment.env_ids) == 1 and len(next(iter(results.experiment.scripted), {})) == 1:
        chosen = ("oracle", "greedy-nearest", "random")
        draw_references(axis, {label: heights[label] for label in chosen if heights.get(label) is not None})
    axis.set_xlabel("training (env steps)")
    axis.set_ylabel(described(metric))
    draw_legend(axis, below=True)


def curves(records: Sequence[Record], of: str) -> tuple[np.ndarray, np.ndarray]:
    """
    A curve of each run, as far as all have come.

    :param records: seeds of one cell
    :param of: ``curve/<evaluation>/<metric>``
    :return: env steps (evaluations,), and values (evaluations, runs)
    """
    _, name, metric = of.split("/", 2)
    own = [record["curve"][name] for record in records]
    length = min(len(curve["steps"]) for curve in own)
    return np.array(own[0]["steps"][:length]), np.array([curve[metric][:length] for curve in own], dtype=float).T


def draw_scatter(axis: Axes, results: Results, cells: Sequence[str], of: str) -> None:
    """Returns of single episodes of the test, of the first seed of each cell."""
    _, test, metric = of.split("/", 2)
    styles = line_styles({cell: results.algos[cell] for cell in cells})
    for cell in cells:
        first = results.cells[cell][0]
        kept = first["test"]["tests"][test]["returns"]
        if metric not in kept:
            raise ValueError(f"the records of {results.experiment.name} have no {metric} of single episodes")
        returns = np.array(kept[metric], dtype=float)
        axis.plot(
            np.arange(len(returns)), returns, "o", markersize=2.5, alpha=0.5, color=styles[cell][0], label=label_of(first)
        )
    axis.set_xlabel(f"episode of the test (seed {results.cells[cells[0]][0]['identity']['seed']})")
    axis.set_ylabel(described(metric))
    draw_legend(axis, below=True)


def draw_bars(axis: Axes, results: Results, cells: Sequence[str], of: str) -> None:
    """The IQM of each cell with its interval and its seeds."""
    styles = line_styles({label_of(results.cells[cell][0]): results.algos[cell] for cell in cells})
    values = {label_of(results.cells[cell][0]): results.values(cell, of) for cell in cells}
    draw_estimates(
        axis, {label: iqm_of(own) for label, own in values.items()}, {label: styles[label][0] for label in values}, values
    )
    axis.set_xlabel(described(of.rpartition("/")[2]))
    axis.xaxis.set_major_formatter(ScalarFormatter())


def draw_rivals(axis: Axes, results: Results, cells: Sequence[str], of: str) -> None:
    """How often the one side wins, and the other."""
    for cell in cells:
        teams = results.cells[cell][0]["identity"]["settings"]["teams"]
        steps, won = curves(results.cells[cell], of)
        for (team, theirs), values, colour in zip(teams.items(), (won, 1 - won), SIDES, strict=True):
            draw_intervals(axis, steps, iqm_curve_of(values), colour, f"{algo_label(theirs['algo'])} {team}")
    axis.set_ylim(-0.03, 1.03)
    axis.set_xlabel("training (env steps)")
    axis.set_ylabel("win rate")
    draw_legend(axis, below=True)


PANELS: dict[str, Callable[[Axes, Results, Sequence[str], str], None]] = {
    "curve": draw_curves,
    "scatter": draw_scatter,
    "estimates": draw_bars,
    "rivals": draw_rivals,
}
"""Kind of a panel → what draws it."""


def picture_name(name: str) -> str:
    """File of a picture."""
    return f"reproduce_{name}.png"


def cells_of_pictures(results: Results) -> dict[str, list[list[str]]]:
    """The pictures of which each panel has something to show: name → the cells in each panel."""
    found = {}
    for name, panels in results.experiment.pictures.items():
        shown = [(panel[kind], panel.get("cells", results.cells)) for panel in panels for kind in PANELS if kind in panel]
        found[name] = [
            [
                cell
                for cell in cells
                if all(has(record, of) for record in results.cells.get(cell, ())) and cell in results.cells
            ]
            for of, cells in shown
        ]
    return {name: cells for name, cells in found.items() if all(cells)}


def draw_pictures(results: Results, folder: Path) -> list[Path]:
    """
    All pictures of an experiment, as far as there are records.

    :param results: of the experiment
    :param folder: where they go
    :return: the files
    """
    made = []
    for name, wanted in cells_of_pictures(results).items():
        panels = results.experiment.pictures[name]
        seeds = sorted({len(results.cells[cell]) for cells in wanted for cell in cells})
        told = " to ".join(map(str, dict.fromkeys((seeds[0], seeds[-1]))))
        title = f"{results.experiment.title}; seeds: {told}, scale: {results.scale:g}"
        tallest = max(len(cells) if "estimates" in panel else 0 for panel, cells in zip(panels, wanted, strict=True))
        figure, axes = new_figure(len(panels), title, (5.8, max(4.2, 0.42 * tallest)))
        for axis, panel, cells in zip(axes, panels, wanted, strict=True):
            (kind,) = panel.keys() & PANELS.keys()
            PANELS[kind](axis, results, cells, panel[kind])
            axis.set_title(panel["title"])
        made.append(folder / picture_name(name))
        save_figure(figure, made[-1])
    return made


def write_report(experiments: Mapping[str, Experiment], claims: Sequence[Claim], docs: Path, folder: Path) -> list[Path]:
    """
    Fill the page and draw the pictures, of the records alone.

    :param experiments: all of them
    :param claims: of the paper
    :param docs: folder of the page and the pictures
    :param folder: of the records
    :return: the files
    :raises ValueError: for a damaged record, and for a place of the page that nobody fills
    """
    results = {name: read_results(experiment, folder) for name, experiment in experiments.items()}
    page = docs / PAGE
    text = page.read_text(encoding="utf-8") if page.is_file() else blank_page(experiments)
    written = filled(text, partial(table_of, claims=claims, results=results))
    pictures = [path for own in results.values() for path in draw_pictures(own, docs / "images")]
    write_text(page, written)
    return [page, *pictures]


def blank_page(experiments: Mapping[str, Experiment]) -> str:
    """A page with all tables and no words."""
    places = {"claims": "What the paper says", **{name: own.title for name, own in experiments.items()}, "runs": "Runs"}
    parts = [f"## {title}\n\n<!-- table: {name} -->\n<!-- end -->" for name, title in places.items()]
    return "\n\n".join(["# Reproduction", *parts]) + "\n"
