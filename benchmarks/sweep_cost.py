"""
What a sweep costs beside the same runs of ``zoo/train.py`` as plain processes, with one and with two workers:
``python benchmarks/sweep_cost.py``. Writes ``docs/results/sweep_cost.json`` and prints a table.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for ``zoo``

from sb3_kfcv.saving.archive import library_versions
from sb3_kfcv.saving.files import atomic_write
from zoo.sweep_plan import plan

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results" / "sweep_cost.json"
PLAIN, LOCAL, RAY = "plain processes", "sweep, processes", "sweep, Ray"
WORKERS = (1, 2)


def sweep_of(n_runs: int, steps: int) -> dict[str, Any]:
    """Content of the YAML file: runs that differ by their seeds."""
    train = {"preset": "tuned", "n-timesteps": steps, "env-kwargs": {"n_agents": 2}, "eval-freq": steps}
    return {"algos": ["maddpg"], "envs": ["HardSpread-v0"], "seeds": n_runs, "train": train}


def plain(given: dict[str, Any], folder: Path, n_workers: int) -> None:
    """The runs as processes of ``zoo/train.py``, so many at a time, as ``xargs -P`` would start them."""
    waiting = [[sys.executable, str(ROOT / "zoo" / "train.py"), *run.words] for run in plan(given, folder, 1)]
    running: list[subprocess.Popen[bytes]] = []
    with open(folder / "log", "wb") as log:
        while waiting or running:
            while waiting and len(running) < n_workers:
                environment = {**os.environ, "OMP_NUM_THREADS": "1"}
                running.append(subprocess.Popen(waiting.pop(0), stdout=log, stderr=log, env=environment))
            time.sleep(0.01)
            for process in [process for process in running if process.poll() is not None]:
                if process.returncode:
                    raise RuntimeError(f"a run has failed: {(folder / 'log').read_text()}")
                running.remove(process)


def sweep(given: dict[str, Any], folder: Path, n_workers: int, *flags: str) -> None:
    """The runs as a sweep."""
    (folder / "runs.yml").write_text(yaml.safe_dump(given))
    words = [sys.executable, str(ROOT / "zoo" / "sweep.py"), str(folder / "runs.yml"), "-f", str(folder / "runs")]
    subprocess.run([*words, "--workers", str(n_workers), *flags], check=True, stdout=subprocess.DEVNULL)


def seconds(way: str, given: dict[str, Any], n_workers: int) -> float:
    """Wall-clock time of all runs, the start and the end of every process included."""
    with tempfile.TemporaryDirectory() as name:
        start = time.perf_counter()
        if way == PLAIN:
            plain(given, Path(name), n_workers)
        else:
            sweep(given, Path(name), n_workers, *(["--local"] if way == LOCAL else []))
        return time.perf_counter() - start


def table(report: dict[str, Any]) -> str:
    """The medians as Markdown; ratios are medians of those of each round."""
    lines = ["| workers | carried out by | seconds | to plain processes | to one worker |", "|---|---|---|---|---|"]
    for row in report["rows"]:
        low, high = min(row["seconds"]), max(row["seconds"])
        lines.append(
            f"| {row['workers']} | {row['way']} | {statistics.median(row['seconds']):.1f} ({low:.1f}–{high:.1f}) "
            f"| {row['to_plain']:.2f} | {row['to_one_worker']:.2f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Measure what a sweep costs.")
    parser.add_argument("--runs", type=int, default=4, help="of the sweep (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=20_000, help="env steps of each run (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=3, help="rounds, each way once in each (default: %(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="file of the results (default: %(default)s)")
    args = parser.parse_args()
    given = sweep_of(args.runs, args.steps)
    keys = [(n_workers, way) for n_workers in WORKERS for way in (PLAIN, LOCAL, RAY)]
    taken: dict[tuple[int, str], list[float]] = {key: [] for key in keys}
    for _ in range(args.rounds):
        for n_workers, way in keys:
            taken[n_workers, way].append(seconds(way, given, n_workers))
    rows = []
    for n_workers, way in keys:
        ours, beside, alone = taken[n_workers, way], taken[n_workers, PLAIN], taken[1, way]
        ratios = [[a / b for a, b in zip(ours, others, strict=True)] for others in (beside, alone)]
        to_plain, to_one_worker = map(statistics.median, ratios)
        row = {"workers": n_workers, "way": way, "seconds": ours, "to_plain": to_plain, "to_one_worker": to_one_worker}
        rows.append(row)
    report = {
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "versions": library_versions(),
        "date": str(date.today()),
        "sweep": given,
        "rows": rows,
    }
    print(table(report))
    with atomic_write(args.output) as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
