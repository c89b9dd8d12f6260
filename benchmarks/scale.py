"""
How time and memory grow: with agents, hidden units, transitions, folds and worlds, on one core.

    python benchmarks/scale.py                # `make benchmark-scale`
    python benchmarks/scale.py --quick        # some seconds, written among the temporary files: does it run?
    python benchmarks/scale.py --draw-only    # the tables and pictures from the JSON

Each curve is measured at several sizes, everything warmed up, the median of 5 blocks or more at each. The exponent beside a
curve is the slope of a straight line through the larger half of its points, in logarithms: 1.0 grows in proportion, 0.0 does
not grow. Prints Markdown tables, writes every block to ``docs/results/scale.json`` and the pictures to
``docs/images/scale_*.png``. A point whose buffer would take more than 4 GB is left out, and the table says so.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import torch as th
from matplotlib.ticker import EngFormatter, FuncFormatter
from ours import PACKAGES, REFRESHED, RandomWorld, learner, random_steps, simulate
from peers.protocol import BATCH_SIZE, BUFFER_SIZE, Work, cpu_model, in_units, seconds_per_operation, versions_of

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for ``zoo``

from sb3_kfcv import KFCVMADDPG, MADDPG, PERMADDPG, make_vec_env
from sb3_kfcv.maddpg.policies import CRITIC_INPUTS
from sb3_kfcv.saving.files import atomic_write
from sb3_kfcv.vec_env.make import WORLDS, make_worlds
from zoo.plots import new_figure, save_figure

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results" / "scale.json"
IMAGES = ROOT / "docs" / "images"

# Okabe and Ito's colours, and a marker for each: curves stay apart without colour, too.
STYLES = [("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "^"), ("#CC79A7", "D"), ("#E69F00", "v"), ("#56B4E9", "P")]
ALGORITHMS: dict[str, type[MADDPG]] = {"uniform": MADDPG, "by rank": PERMADDPG, "curriculum": KFCVMADDPG}
BETWEEN_REFRESHES = {"refresh_every": 10**9, "refresh_fraction": 2.0, "first_teacher_steps": 1}
SMALL = (4, 8, 2)
"""Agents, observations and actions where transitions are many."""
MEDIUM = (4, 24, 2)
LARGEST = 4 * 10**9
"""Bytes of a buffer; points beyond are left out."""
N_ENVS = 32
"""Worlds that fill the buffers."""


@dataclass
class Effort:
    """How much is measured."""

    repeats: int
    processes: int  # that fill a buffer, for its memory
    block_seconds: float
    agents: tuple[int, ...]
    hidden: tuple[int, ...]
    folds: tuple[int, ...]
    refreshed: tuple[int, ...]  # transitions
    stored: tuple[int, ...]  # transitions
    weighed: tuple[int, ...]  # transitions; smaller buffers are lost in what a process holds anyway
    worlds: tuple[int, ...]


FULL = Effort(
    repeats=5,
    processes=5,
    block_seconds=0.2,
    agents=(2, 4, 8, 16, 28, 64),
    hidden=(64, 128, 256, 512),
    folds=(2, 5, 10, 20),
    refreshed=(1000, 5000, 20_000, 50_000, 200_000, 1_000_000),
    stored=(5000, 50_000, 200_000, 1_000_000),
    weighed=(50_000, 200_000, 500_000, 1_000_000),
    worlds=(1, 4, 16, 64, 256, 1024, 4096),
)
QUICK = Effort(
    repeats=2,
    processes=1,
    block_seconds=0.005,
    agents=(2, 4),
    hidden=(64, 128),
    folds=(2, 5),
    refreshed=(500, 1000),
    stored=(500, 1000),
    weighed=(50_000, 100_000),
    worlds=(1, 16),
)


@dataclass
class Curve:
    """
    One measurement at several sizes.

    :param picture: the picture that it is in
    :param panel: the panel of that picture
    :param name: beside the other curves of the panel
    :param size: what the sizes are of
    :param unit: what is measured: ``"s"`` or ``"B"``
    :param per: what the seconds or bytes are of
    :param sizes: where it was measured
    :param values: of every block at each size
    :param left_out: sizes without a measurement, and why
    """

    picture: str
    panel: str
    name: str
    size: str
    unit: str
    per: str
    sizes: list[int] = field(default_factory=list)
    values: list[list[float]] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)

    def add(self, size: int, values: list[float]) -> None:
        """A point."""
        self.sizes.append(size)
        self.values.append(values)

    @property
    def medians(self) -> list[float]:
        return [statistics.median(values) for values in self.values]

    @property
    def exponent(self) -> float:
        """Slope of the line through the larger half of the points, in logarithms."""
        if len(self.sizes) < 2:
            return math.nan
        n = max(2, math.ceil(len(self.sizes) / 2))
        return float(np.polyfit(np.log(self.sizes[-n:]), np.log(self.medians[-n:]), 1)[0])

    @property
    def growth(self) -> str:
        """How it grows, for a legend or a table."""
        return "–" if math.isnan(self.exponent) else f"n^{self.exponent:.2f}"

    def cell(self, size: int) -> str:
        """Its cell in the table's column of a size."""
        if size in self.sizes:
            values = self.values[self.sizes.index(size)]
            return f"{self._quantity(statistics.median(values))} [{self._quantity(min(values))}–{self._quantity(max(values))}]"
        return self.left_out.get(str(size), "–")

    def _quantity(self, value: float) -> str:
        return in_units(value) if self.unit == "s" else f"{value / 1e6:,.1f} MB"


def blocks(operation: Callable[[], object], effort: Effort, size: int = 1) -> list[float]:
    """Seconds of one operation, of each block."""
    return seconds_per_operation(Work(operation, size), effort.repeats, effort.block_seconds)


def state_size(n_agents: int) -> int:
    """As in Grassland with 4 pieces of grass."""
    return 5 * n_agents + 8


def updates(effort: Effort) -> Iterator[Curve]:
    """One update of all agents: over agents, and over hidden units."""
    panels: dict[str, Callable[[int], int]] = {
        "observations 24 per agent": lambda n: 24,
        "observations as in Grassland, 13 + 5(N − 1)": lambda n: 13 + 5 * (n - 1),
    }
    for panel, obs_size in panels.items():
        for critic_input in CRITIC_INPUTS:
            curve = Curve("update", panel, f'critic_input="{critic_input}"', "agents N", "s", "update")
            for n in effort.agents:
                sizes = (n, obs_size(n), 2)
                model = learner(*sizes, buffer_size=1000, state_size=state_size(n), critic_input=critic_input)
                curve.add(n, blocks(partial(model.train, 1, BATCH_SIZE), effort))
            yield curve
    for critic_input in CRITIC_INPUTS:
        curve = Curve("update", "N = 4, observations 24", f'critic_input="{critic_input}"', "hidden units", "s", "update")
        for hidden in effort.hidden:
            settings: dict[str, Any] = {"hidden": (hidden, hidden), "state_size": state_size(4), "critic_input": critic_input}
            model = learner(*MEDIUM, buffer_size=1000, **settings)
            curve.add(hidden, blocks(partial(model.train, 1, BATCH_SIZE), effort))
        yield curve


def refreshes(effort: Effort) -> Iterator[Curve]:
    """A refresh of the curriculum after the first: teachers trained for 25 steps, transitions scored and ranked."""
    curve = Curve("refresh", "K = 5", "4 agents, observations 24", "transitions held", "s", "refresh")
    for size in effort.refreshed:
        if (n_bytes := bytes_of(*MEDIUM, size)) > LARGEST:
            curve.left_out[str(size)] = too_large(n_bytes)
        else:
            curve.add(size, refresh_seconds(effort, size, 5))
    yield curve
    n_rows = min(BUFFER_SIZE, max(effort.refreshed))
    curve = Curve("refresh", f"{n_rows:,} transitions", "4 agents, observations 24", "folds K", "s", "refresh")
    for k in effort.folds:
        curve.add(k, refresh_seconds(effort, n_rows, k))
    yield curve


def refresh_seconds(effort: Effort, n_rows: int, k: int) -> list[float]:
    """Seconds of a refresh, of each block of one."""
    settings = {"n_folds": k, "first_teacher_steps": 25}
    model: Any = learner(*MEDIUM, KFCVMADDPG, n_rows, min(N_ENVS, n_rows // 32), 0, replay_buffer_kwargs=settings)
    return seconds_per_operation(Work(partial(model.replay_buffer.refresh, REFRESHED)), effort.repeats, 0.0)


def replay(effort: Effort) -> Iterator[Curve]:
    """Drawing a minibatch, with what its TD errors then change, and storing a step of all worlds."""
    for name, algorithm in ALGORITHMS.items():
        draws = Curve("replay", f"sample {BATCH_SIZE}, update priorities", name, "transitions held", "s", "minibatch")
        adds = Curve("replay", f"add a step of {N_ENVS} worlds", name, "transitions held", "s", "step")
        for size in effort.stored:
            if (n_bytes := bytes_of(*SMALL, size)) > LARGEST:
                draws.left_out[str(size)] = adds.left_out[str(size)] = too_large(n_bytes)
                continue
            settings = {"replay_buffer_kwargs": BETWEEN_REFRESHES} if algorithm is KFCVMADDPG else {}
            n_envs = min(N_ENVS, size // 32)
            model = learner(*SMALL, algorithm, size, n_envs, 0, **settings)
            buffer, steps = model.replay_buffer, cycle(random_steps(model))
            errors = th.as_tensor(np.random.default_rng(0).random(buffer.n_rows))
            buffer.progress = 0.25  # the curriculum is at work
            buffer.update_priorities(np.arange(buffer.n_rows), errors)

            def draw(buffer: Any = buffer, errors: th.Tensor = errors[:BATCH_SIZE]) -> None:
                buffer.update_priorities(buffer.sample(BATCH_SIZE).rows, errors)

            def add(buffer: Any = buffer, steps: Any = steps) -> None:
                buffer.add(*next(steps))

            draws.add(size, blocks(draw, effort))
            adds.add(size, blocks(add, effort))
        yield draws
        yield adds


def simulation(effort: Effort) -> Iterator[Curve]:
    """Simulated steps of one world: over worlds stepped together, and over agents."""
    for world in WORLDS:
        core = Curve("simulate", "over worlds", f"{world}, core", "worlds stepped together", "s", "step of one world")
        vec_env = Curve("simulate", "over worlds", f"{world}, ParticleVecEnv", core.size, "s", core.per)
        for n in effort.worlds:
            core.add(n, core_seconds(effort, world, n, {}))
            vec_env.add(n, vec_env_seconds(effort, world, n))
        yield core
        yield vec_env
    settings: dict[str, Callable[[int], dict[str, Any]]] = {
        "HardSpread-v0": lambda n: {"n_agents": n, "walls": "none"},
        "Grassland-v0": lambda n: {"n_wolves": n // 2, "n_sheep": n // 2},
    }
    titles = {"HardSpread-v0": "HardSpread-v0 without walls", "Grassland-v0": "Grassland-v0, N/2 wolves, N/2 sheep"}
    for world, kwargs in settings.items():
        curve = Curve("simulate", "over agents, 64 worlds, core", titles[world], "agents N", "s", "step of one world")
        for n in effort.agents:
            curve.add(n, core_seconds(effort, world, 64, kwargs(n)))
        yield curve


def core_seconds(effort: Effort, world: str, n_worlds: int, env_kwargs: dict[str, Any]) -> list[float]:
    return seconds_per_operation(simulate(make_worlds(world, n_worlds, env_kwargs)), effort.repeats, effort.block_seconds)


def vec_env_seconds(effort: Effort, world: str, n_worlds: int) -> list[float]:
    env: Any = make_vec_env(world, n_worlds, 0).unwrapped
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (25, n_worlds, *env.action_space.shape)).astype(np.float32)

    def steps() -> None:
        for action in actions:
            env.step(action)

    return blocks(steps, effort, len(actions) * n_worlds)


def memory(effort: Effort) -> Iterator[Curve]:
    """A full buffer: what the library says before it makes one, and what a process grows by as one is filled."""
    panel = "4 agents, observations 8"
    estimated = {name: Curve("memory", panel, f"{name}, estimated", "transitions held", "B", "buffer") for name in ALGORITHMS}
    curves = {name: Curve("memory", panel, f"{name}, measured", "transitions held", "B", "buffer") for name in ALGORITHMS}
    sizes = [size for size in effort.weighed if bytes_of(*SMALL, size) <= LARGEST]
    for curve in (*estimated.values(), *curves.values()):
        curve.left_out = {str(size): too_large(bytes_of(*SMALL, size)) for size in effort.weighed if size not in sizes}
    command = [sys.executable, __file__, "--grow", *map(str, sizes)]
    printed = [subprocess.check_output(command, text=True) for _ in range(effort.processes if sizes else 0)]
    grown = [json.loads(text.splitlines()[-1]) for text in printed]
    for name, algorithm in ALGORITHMS.items():
        for i, size in enumerate(sizes):
            estimated[name].add(size, [float(bytes_of(*SMALL, size, algorithm))])
            curves[name].add(size, [float(growth[name][i]) for growth in grown])
    for name in ALGORITHMS:
        yield estimated[name]
        yield curves[name]


def grow(sizes: Sequence[int]) -> dict[str, list[int]]:
    """
    Bytes that this process grows by as it fills buffers.

    :param sizes: transitions of each
    :return: kind of replay → bytes of each size
    """
    grown: dict[str, list[int]] = {name: [] for name in ALGORITHMS}
    held = []  # what is given back could be taken again without growth
    learner(*SMALL, buffer_size=1000, state_size=0)  # whatever a first learner takes
    for name, algorithm in ALGORITHMS.items():
        for size in sizes:
            model = learner(*SMALL, algorithm, 32 * N_ENVS, N_ENVS, 0)
            steps, empty = cycle(random_steps(model)), model.replay_buffer
            before = psutil.Process().memory_info().rss
            settings = {"n_envs": N_ENVS, "n_agents": model.layout.n_agents, "state_size": 0}
            buffer: Any = type(empty)(size, empty.observation_space, empty.action_space, "cpu", **settings)
            for _ in range(buffer.buffer_size):
                buffer.add(*next(steps))
            grown[name].append(max(psutil.Process().memory_info().rss - before, 1))
            held += [model, buffer]
    return grown


def bytes_of(n_agents: int, obs_size: int, action_size: int, n_rows: int, algorithm: type[MADDPG] = MADDPG) -> int:
    """What the library says a buffer will take."""
    world = RandomWorld(n_agents, obs_size, action_size, 0)
    estimate = algorithm.default_buffer_class.estimate_bytes
    return estimate(n_rows, world.observation_space, world.action_space, N_ENVS, n_agents)


def too_large(n_bytes: int) -> str:
    """Why a point is left out."""
    return f"left out: {n_bytes / 1e9:.1f} GB"


GROUPS: dict[str, Callable[[Effort], Iterator[Curve]]] = {
    "update": updates,
    "refresh": refreshes,
    "replay": replay,
    "simulate": simulation,
    "memory": memory,
}


def panels_of(curves: Sequence[Curve]) -> dict[tuple[str, str], list[Curve]]:
    """(Picture, panel) → its curves."""
    panels: dict[tuple[str, str], list[Curve]] = {}
    for curve in curves:
        panels.setdefault((curve.picture, curve.panel), []).append(curve)
    return panels


def tables(results: dict[str, Any], pictures: Sequence[str] | None = None) -> str:
    """
    Markdown: a table per panel.

    :param results: what was written
    :param pictures: only the panels of these
    """
    lines = []
    for (picture, panel), curves in panels_of([Curve(**curve) for curve in results["curves"]]).items():
        if pictures is not None and picture not in pictures:
            continue
        first = curves[0]
        sizes = sorted({size for curve in curves for size in [*curve.sizes, *map(int, curve.left_out)]})
        what = "seconds" if first.unit == "s" else "bytes"
        lines += [f"**{panel}**: {what} per {first.per}, median [min–max]", ""]
        lines += [f"| {first.size} | " + " | ".join(f"{size:,}" for size in sizes) + " | grows as |"]
        lines += ["|---" * (len(sizes) + 2) + "|"]
        lines += [f"| {curve.name} | {' | '.join(map(curve.cell, sizes))} | {curve.growth} |" for curve in curves]
        lines += [""]
    return "\n".join(lines).rstrip()


def in_brief(size: float, position: int | None = None) -> str:
    """A size at its tick; called by Matplotlib."""
    for scale, letter in ((1_000_000, "M"), (1000, "k")):
        if size >= scale and size % scale == 0:
            return f"{size / scale:.0f}{letter}"
    return f"{size:,.0f}"


def draw(results: dict[str, Any], folder: Path) -> None:
    """One picture per kind, a panel per table; bars from the fastest to the slowest block."""
    panels = panels_of([Curve(**curve) for curve in results["curves"]])
    for picture in dict.fromkeys(picture for picture, _ in panels):
        of_picture = {panel: curves for (of, panel), curves in panels.items() if of == picture}
        figure, axes = new_figure(len(of_picture))
        for axis, (panel, curves) in zip(axes, of_picture.items(), strict=True):
            for (colour, marker), curve in zip(STYLES, curves, strict=False):
                medians = np.array(curve.medians)
                low = medians - [min(values) for values in curve.values]
                high = [max(values) for values in curve.values] - medians
                axis.errorbar(
                    curve.sizes,
                    medians,
                    (low, high),
                    color=colour,
                    marker=marker,
                    markersize=5,
                    capsize=3,
                    label=f"{curve.name}: {curve.growth}",
                )
            first = curves[0]
            axis.set(
                xscale="log",
                yscale="log",
                xlabel=first.size,
                ylabel=f"{'time' if first.unit == 's' else 'memory'} per {first.per}",
            )
            axis.set_title(panel, fontsize="medium")
            axis.set_xticks(sorted({size for curve in curves for size in curve.sizes}), minor=False)
            axis.set_xticks([], minor=True)
            axis.xaxis.set_major_formatter(FuncFormatter(in_brief))
            values = [value for curve in curves for of_size in curve.values for value in of_size]
            axis.set_ylim(*(10.0 ** bound(math.log10(edge(values))) for bound, edge in ((math.floor, min), (math.ceil, max))))
            axis.yaxis.set_major_formatter(EngFormatter(unit=first.unit))
            axis.yaxis.set_minor_formatter("")
            axis.legend(fontsize="small", frameon=False)
        save_figure(figure, folder / f"scale_{picture}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--groups", nargs="+", choices=list(GROUPS), default=list(GROUPS), help="(default: all)")
    parser.add_argument("--quick", action="store_true", help="a smoke run, written among the temporary files")
    parser.add_argument("--draw-only", action="store_true", help="measure nothing: tables and pictures from the JSON")
    parser.add_argument(
        "--output", type=Path, help=f"JSON file (default: {RESULTS.relative_to(ROOT)}; quick: a temporary one)"
    )
    parser.add_argument("--images", type=Path, help=f"folder of the pictures (default: {IMAGES.relative_to(ROOT)})")
    parser.add_argument("--grow", type=int, metavar="TRANSITIONS", nargs="+", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.grow:
        print(json.dumps(grow(args.grow)))
        return
    whole = not args.quick and args.groups == list(GROUPS)
    elsewhere = Path(tempfile.gettempdir())
    output = args.output or (RESULTS if whole else elsewhere / RESULTS.name)
    if args.draw_only:
        results = json.loads(output.read_text())
    else:
        th.set_num_threads(1)
        start, curves = time.perf_counter(), []
        for group in args.groups:
            for curve in GROUPS[group](QUICK if args.quick else FULL):
                curves.append(asdict(curve))
                print(
                    f"{time.perf_counter() - start:5.0f} s  {curve.panel}: {curve.name}: {curve.growth}",
                    file=sys.stderr,
                    flush=True,
                )
        facts = {"date": time.strftime("%Y-%m-%d"), "processor": cpu_model(), "threads": 1, "versions": versions_of(PACKAGES)}
        results = {**facts, "minutes": round((time.perf_counter() - start) / 60, 1), "curves": curves}
        with atomic_write(output) as file:
            file.write(json.dumps(results, indent=1).encode())
    draw(results, args.images or (IMAGES if output == RESULTS else elsewhere))
    print(tables(results))


if __name__ == "__main__":
    main()
