"""
What all adapters share: the cases, the timing, and one line of JSON for each.

An adapter is a script that runs in the environment of its peer alone:

    .peers/cpprb/bin/python benchmarks/peers/adapter_cpprb.py per-sample per-add --repeats 5

For each case it prepares the work, warms up, times blocks of it, and prints the seconds per operation of each block as one
line of JSON. Nothing here needs more than the standard library, and nothing of a peer is imported before it is needed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import platform
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version

UPDATES: dict[str, tuple[int, int, int]] = {"update-3": (3, 18, 5), "update-4": (4, 24, 5), "update-28": (28, 70, 2)}
"""Agents, observations and actions of each: as simple_spread (3 and 4 agents) and as a world of 28."""
BATCH_SIZE, BUFFER_SIZE, HIDDEN = 128, 5000, (64, 64)
LEARNING_RATE, TAU, GAMMA = 1e-3, 0.01, 0.99

PREDICT_ROWS = (1, 64)
"""Joint observations that all agents act on in one call."""

N_WORLDS: dict[str, tuple[int, ...]] = {"spread": (1, 32, 1024, 4096, 16_384), "tag": (1, 32, 256, 1024, 4096)}
"""Of each simulation: up to where the peers no longer get faster."""
SPREAD_AGENTS = 4
TAG_WOLVES, TAG_SHEEP = 16, 12
EPISODE_STEPS = 25
"""Of the worlds of all peers, and of ours here."""

TRAINING: dict[str, int] = {"train-100": 100, "train-10": 10}
"""Env steps per update, end to end: cooperative navigation with 3 agents."""
TRAINING_AGENTS = 3

FAMILIES: dict[str, dict[str, tuple[int, ...]]] = {
    "update": dict(UPDATES),
    "predict": {f"predict-{n}-{rows}": (*UPDATES[f"update-{n}"], rows) for n in (4, 28) for rows in PREDICT_ROWS},
    **{world: {f"{world}-{n}": (n,) for n in numbers} for world, numbers in N_WORLDS.items()},
    "train": {name: (steps,) for name, steps in TRAINING.items()},
}
"""Cases that differ in their numbers alone: family → case → the numbers."""

CASES: dict[str, str] = {
    **{
        name: f"one update of all agents, N = {n}, observations {obs}, actions {action}"
        for name, (n, obs, action) in UPDATES.items()
    },
    **{
        name: f"actions of all agents, N = {n}, observations {obs}, joint observations: {rows}"
        for name, (n, obs, _, rows) in FAMILIES["predict"].items()
    },
    **{f"spread-{n}": f"simulate spread, N = {SPREAD_AGENTS}, worlds: {n:,}" for n in N_WORLDS["spread"]},
    **{f"tag-{n}": f"simulate {TAG_WOLVES} + {TAG_SHEEP} agents, worlds: {n:,}" for n in N_WORLDS["tag"]},
    "uniform-sample": "uniform replay, sample 128 of 5,000 (28 × 70 observations)",
    "uniform-add": "uniform replay, add one joint transition",
    "per-sample": "prioritised replay, sample 128 of 5,000 (28 × 70 observations)",
    "per-priorities": "prioritised replay, update 128 priorities",
    "per-turn": "prioritised replay, sample 128 and update their priorities",
    "per-add": "prioritised replay, add one joint transition",
    **{name: f"cooperative navigation, N = 3, end to end, 1 update per {steps} env steps" for name, steps in TRAINING.items()},
}


@dataclass
class Work:
    """
    Something to time.

    :param operation: does it, ``size`` times
    :param size: how many updates, env steps or draws one call is
    :param note: what is less or more work than elsewhere
    :param timed: instead of ``operation``, for a loop that cannot be called piece by piece: takes the number of blocks, and
        gives the seconds per operation of each, warmed up
    """

    operation: Callable[[], object] = lambda: None
    size: int = 1
    note: str = ""
    timed: Callable[[int], list[float]] | None = None


def seconds_per_operation(work: Work, repeats: int, block_seconds: float) -> list[float]:
    """
    Warm up for a block, then time ``repeats`` blocks of the same number of calls.

    :param work: what to time
    :param repeats: number of blocks
    :param block_seconds: about how long one is, and one call at least
    :return: seconds per operation of each block
    """
    if work.timed is not None:
        return work.timed(repeats)
    work.operation()  # compiles, allocates
    calls, start = 0, time.perf_counter()
    while calls == 0 or time.perf_counter() - start < block_seconds:
        work.operation()
        calls += 1
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        for _ in range(calls):
            work.operation()
        seconds.append((time.perf_counter() - start) / (calls * work.size))
    return seconds


def in_units(seconds: float) -> str:
    """Seconds with three digits, in the unit that suits."""
    for scale, unit in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def cpu_model() -> str:
    """Name of the processor."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo") as file:
        for line in file:
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def versions_of(packages: Sequence[str]) -> dict[str, str]:
    """Package → version, and that of Python."""
    found = {"python": platform.python_version()}
    for package in packages:
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def cases(**prepare: Callable[..., Work]) -> dict[str, Callable[[], Work]]:
    """
    Case → what prepares it, for whole families.

    :param prepare: family → a function of its numbers
    """
    return {
        case: partial(function, *numbers) for family, function in prepare.items() for case, numbers in FAMILIES[family].items()
    }


def main(packages: Sequence[str], works: dict[str, Callable[[], Work]]) -> None:
    """
    The command line of an adapter.

    :param packages: whose versions are told
    :param works: case → what prepares it
    """
    parser = argparse.ArgumentParser(description="Time cases; prints one line of JSON for each.")
    parser.add_argument("cases", nargs="*", choices=[*works, []], metavar="case")
    parser.add_argument("--list", action="store_true", help="print the cases and stop")
    parser.add_argument("--repeats", type=int, default=3, help="timed blocks")
    parser.add_argument("--block-seconds", type=float, default=0.5, help="length of a block")
    args = parser.parse_args()
    if args.list or not args.cases:
        print("\n".join(works))
        return
    for case in args.cases:
        result: dict[str, object] = {"case": case}
        with contextlib.redirect_stdout(sys.stderr):  # the JSON stands alone
            try:
                work = works[case]()
                seconds = seconds_per_operation(work, args.repeats, args.block_seconds)
                result |= {"seconds": seconds, "median": statistics.median(seconds), "note": work.note}
            except Exception as failure:  # told in the table; the other cases go on
                result["error"] = f"{type(failure).__name__}: {failure}"
        print(json.dumps({**result, "versions": versions_of(packages)}), flush=True)
