"""
Ours beside the peers: the same work, alternating process by process (ours, theirs, ours, theirs …), one thread each.

    python benchmarks/compare.py                                   # everything; `make benchmark-peers`
    python benchmarks/compare.py --peers benchmarl --cases update-28 --repeats 7
    python benchmarks/compare.py --quick                           # does everything run? one short process of each

Each peer has an environment of its own under ``.peers/``, built from ``benchmarks/peers/requirements/`` when it is not there;
one that cannot be built or run is told in the table and stops nothing. A process does the cases of one kind one after the
other: of each it warms up, times a few blocks and gives their median; the table has the median and the range of these over
the processes, and the ratio of the two medians. What was measured before of other cases or peers stays.
Writes ``docs/results/peers.md`` and, with every block, ``docs/results/peers.json``.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from peers.protocol import CASES, FAMILIES, N_WORLDS, cpu_model, in_units

from sb3_kfcv.saving.files import atomic_write

ROOT = Path(__file__).resolve().parents[1]
ADAPTERS = ROOT / "benchmarks" / "peers"
ENVIRONMENTS = ROOT / ".peers"
OUTPUT = ROOT / "docs" / "results" / "peers.md"

PEERS: dict[str, str] = {
    "benchmarl": "BenchMARL + VMAS",
    "agilerl": "AgileRL",
    "xuance": "XuanCe",
    "jaxmarl": "JaxMARL",
    "mpe2": "mpe2",
    "cpprb": "cpprb",
}
VARIANTS: dict[str, dict[str, str]] = {
    "update-28": {
        "update-28": "",
        "update-28-state": 'ours with critic_input="state" (150 values)',
        "update-28-own_observation": 'ours with critic_input="own_observation"',
    }
}
"""Cases that ours does in several ways: case of ours → what differs. The first is the same work as the peers'."""
GROUPS: list[list[str]] = [
    *([*FAMILIES[kind]] for kind in ("update", "predict", "spread", "tag")),
    [case for case in CASES if case.startswith(("uniform-", "per-"))],
    *([case] for case in FAMILIES["train"]),
]
"""Cases that one process does one after the other."""
ONE_THREAD = {
    name: "1"
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS")
}
QUIET = {"PYTHONWARNINGS": "ignore", "SDL_VIDEODRIVER": "dummy", "CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu"}
LONGEST = 600.0
"""Seconds after which a process is given up."""


class Failed(Exception):
    """A peer cannot be built or run; the message says why, in a line."""


@dataclass
class Side:
    """
    What the processes of one side measured.

    :param medians: seconds per operation, one of each process
    :param blocks: seconds per operation of every block of each process
    :param note: what is less or more work than elsewhere
    :param versions: package → version
    """

    medians: list[float] = field(default_factory=list)
    blocks: list[list[float]] = field(default_factory=list)
    note: str = ""
    versions: dict[str, str] = field(default_factory=dict)

    def take(self, result: dict[str, Any]) -> None:
        """
        Add what a process printed.

        :raises Failed: if that is an error
        """
        if "error" in result:
            raise Failed(f"stopped: {last_line(result['error'])}")
        self.medians.append(result["median"])
        self.blocks.append(result["seconds"])
        self.note, self.versions = result["note"], result["versions"]

    @property
    def median(self) -> float:
        return statistics.median(self.medians)

    def __str__(self) -> str:
        return f"{in_units(self.median)} [{in_units(min(self.medians))}–{in_units(max(self.medians))}]"


@dataclass
class Pair:
    """
    Ours beside one peer.

    :param case: the work
    :param peer: whose
    :param variant: what ours does in another way; empty for the same
    :param error: why there is no figure; empty if there is
    """

    case: str
    peer: str
    variant: str = ""
    ours: Side = field(default_factory=Side)
    theirs: Side = field(default_factory=Side)
    error: str = ""

    def line(self) -> str:
        """Its line of the table."""
        if self.error:
            return f"| {PEERS[self.peer]} | – | – | – | {self.error} |"
        notes = [f"theirs: {self.theirs.note}"] if self.theirs.note else []
        notes += [f"ours: {self.ours.note}"] if self.ours.note else []
        notes += [self.variant] if self.variant else []
        ratio = times(self.theirs.median / self.ours.median)
        return f"| {PEERS[self.peer]} | {self.theirs} | {self.ours} | **{ratio}** | {'. '.join(notes)} |"

    def in_brief(self) -> str:
        """Its cell in a table with a column per peer."""
        if self.error:
            return "no figure"
        return f"{in_units(self.theirs.median)} (**{times(self.theirs.median / self.ours.median)}**)"


def python_of(peer: str) -> Path:
    """The interpreter of a peer's environment."""
    return ENVIRONMENTS / peer / ("Scripts" if os.name == "nt" else "bin") / "python"


def build(peer: str) -> None:
    """
    Make a peer's environment, unless it is there as its requirements say.

    :raises Failed: if it cannot be made
    """
    requirements = ADAPTERS / "requirements" / f"{peer}.txt"
    wanted = requirements.read_text()
    built = ENVIRONMENTS / peer / "requirements.txt"
    if built.exists() and built.read_text() == wanted:
        return
    print(f"building .peers/{peer} …", file=sys.stderr, flush=True)
    pip = [str(python_of(peer)), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    commands = [[sys.executable, "-m", "venv", str(ENVIRONMENTS / peer)]]
    # torch first: other packages name ranges of it that would pull another build.
    commands += [[*pip, line] for line in wanted.splitlines() if line.startswith("torch==")]
    commands.append([*pip, "--requirement", str(requirements)])
    for command in commands:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise Failed(f"could not be installed: {last_line(done.stderr)}")
    built.write_text(wanted)


def last_line(text: str) -> str:
    """The last line that says something, fit for a table."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1].replace("|", "/")[:200] if lines else "no message"


def run(python: str | Path, adapter: Path, *arguments: str) -> str:
    """
    What an adapter prints.

    :raises Failed: if it stops with an error, or takes too long
    """
    command = [str(python), str(adapter), *arguments]
    environment = {**os.environ, **ONE_THREAD, **QUIET}
    with tempfile.TemporaryDirectory() as folder:  # peers leave logs where they run
        try:
            done = subprocess.run(
                command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LONGEST, check=False
            )
        except subprocess.TimeoutExpired:
            raise Failed(f"took longer than {LONGEST:.0f} s") from None
    if done.returncode:
        raise Failed(f"stopped: {last_line(done.stderr)}")
    return done.stdout


def measure(python: str | Path, adapter: Path, cases: Sequence[str], blocks: int, block_seconds: float) -> dict[str, Any]:
    """Case → the result of one process."""
    printed = run(python, adapter, *cases, "--repeats", str(blocks), "--block-seconds", str(block_seconds))
    results = [json.loads(line) for line in printed.splitlines() if line.startswith('{"case"')]
    return {result["case"]: result for result in results}


def compare(cases: Sequence[str], peer: str, repeats: int, blocks: int, block_seconds: float) -> list[Pair]:
    """Ours and a peer's processes in turn; a pair for each case, and for each way that ours does it."""
    pairs = {ours: Pair(case, peer, what) for case in cases for ours, what in VARIANTS.get(case, {case: ""}).items()}
    theirs = {case: Side() for case in cases}
    adapter = ADAPTERS / f"adapter_{peer}.py"
    try:
        for _ in range(repeats):
            measured = measure(sys.executable, ROOT / "benchmarks" / "ours.py", [*pairs], blocks, block_seconds)
            for case, pair in pairs.items():
                pair.ours.take(measured[case])
            measured = measure(python_of(peer), adapter, cases, blocks, block_seconds)
            for case, side in theirs.items():
                with noting(pairs, case):
                    side.take(measured[case])
    except Failed as failure:
        return [Pair(case, peer, error=str(failure)) for case in cases]
    for pair in pairs.values():
        pair.theirs = theirs[pair.case]
    return [*pairs.values()]


@contextlib.contextmanager
def noting(pairs: dict[str, Pair], case: str) -> Iterator[None]:
    """A case that fails is noted in its pairs, and stops no other."""
    try:
        yield
    except Failed as failure:
        for pair in pairs.values():
            if pair.case == case:
                pair.error = str(failure)


def best_batches(pairs: list[Pair]) -> list[str]:
    """A table of the simulations: each side at the number of worlds at which it is fastest."""
    lines = []
    for world in N_WORLDS:
        of_world = [pair for pair in pairs if pair.case in FAMILIES[world] and not pair.error]
        if not of_world:
            continue
        fastest = min(of_world, key=lambda pair: pair.ours.median)
        for peer in PEERS:
            of_peer = [pair for pair in of_world if pair.peer == peer]
            if of_peer:
                theirs = min(of_peer, key=lambda pair: pair.theirs.median)
                ours = next((pair for pair in of_peer if pair.case == fastest.case), fastest)  # in turn with theirs
                ratio = f"**{times(theirs.theirs.median / ours.ours.median)}**"
                sides = [f"{side}, worlds: {worlds_of(pair):,}" for side, pair in ((theirs.theirs, theirs), (ours.ours, ours))]
                lines.append(f"| {world} | {PEERS[peer]} | {sides[0]} | {sides[1]} | {ratio} |")
    if not lines:
        return []
    return ["| world | peer | theirs, per env step | ours | ratio |", "|---|---|---|---|---|", *lines]


def worlds_of(pair: Pair) -> int:
    """How many worlds a simulation steps together."""
    return int(pair.case.rsplit("-", 1)[1])


def times(ratio: float) -> str:
    """How many times as long."""
    return f"{ratio:,.0f}×" if ratio >= 100 else f"{ratio:.1f}×"


def conditions(facts: dict[str, Any]) -> str:
    """How and where it was measured."""
    return (
        f"{facts['processor']}, {facts['cores']} cores, {facts['date']}; load before and after: {facts['load']}. "
        f"Processes of each side, in turn: {facts['repeats']}, of 1 thread and {facts['blocks']} timed blocks of each case. "
        "Seconds per operation: median [min–max] over the processes; the ratio is theirs over ours. "
        "Updates: batch 128 of a buffer of 5,000, sampling included, networks 64-64 of each agent's own. "
        "Made by `make benchmark-peers`; how each peer is driven stands in its adapter in `benchmarks/peers/`."
    )


def report(pairs: list[Pair], broken: dict[str, str], facts: dict[str, Any]) -> str:
    """The page: a table per case, each side at its best batch, then the peers without figures and all versions."""
    lines = ["# Ours beside the peers", "", conditions(facts)]
    for case, title in CASES.items():
        of_case = [pair for pair in pairs if pair.case == case]
        if of_case:
            lines += ["", f"## {title[0].upper()}{title[1:]}", "", "| peer | theirs | ours | ratio | what differs |"]
            lines += ["|---|---|---|---|---|", *(pair.line() for pair in of_case)]
    if best := best_batches(pairs):
        lines += ["", "## Simulation, each side with as many worlds as it is fastest with", "", *best]
    if broken:
        lines += ["", "## Without figures", "", "| peer | why |", "|---|---|"]
        lines += [f"| {PEERS[peer]} | {reason} |" for peer, reason in broken.items()]
    sides = {"ours": [pair.ours for pair in pairs]} | {
        PEERS[peer]: [pair.theirs for pair in pairs if pair.peer == peer] for peer in PEERS
    }
    lines += ["", "## Versions", "", "| | |", "|---|---|"]
    for name, measured in sides.items():
        versions = {package: number for side in measured for package, number in side.versions.items()}
        if versions:
            lines.append(f"| {name} | {', '.join(f'{package} {number}' for package, number in versions.items())} |")
    return "\n".join(lines) + "\n"


def overview(results: dict[str, Any]) -> str:
    """
    One Markdown table of what was written: a line per case, and per way that ours does it.

    :param results: what was written as JSON
    """
    pairs = pairs_of(results)
    peers = [peer for peer in PEERS if any(pair.peer == peer for pair in pairs)]
    lines = ["| work | ours | " + " | ".join(PEERS[peer] for peer in peers) + " |", "|---" * (len(peers) + 2) + "|"]
    for case, variant in dict.fromkeys((pair.case, pair.variant) for pair in pairs):
        of_row = {pair.peer: pair for pair in pairs if (pair.case, pair.variant) == (case, variant)}
        medians = [median for pair in of_row.values() if not pair.error for median in pair.ours.medians]
        ours = in_units(statistics.median(medians)) if medians else "–"
        cells = [of_row[peer].in_brief() if peer in of_row else "" for peer in peers]
        lines.append(f"| {CASES[case]}{f'; {variant}' if variant else ''} | {ours} | {' | '.join(cells)} |")
    lines += ["", "What differs:", ""]
    for peer in peers:
        kinds: dict[str, list[str]] = {}  # note → kinds of work
        for pair in pairs:
            if pair.peer == peer and pair.theirs.note:
                kinds.setdefault(pair.theirs.note, []).append(pair.case.rstrip("0123456789").rstrip("-"))
        notes = [f"{', '.join(dict.fromkeys(cases))}: {note}" for note, cases in kinds.items()]
        lines += [f"- {PEERS[peer]}. {'. '.join(notes)}."] if notes else []
    return "\n".join(lines)


def with_others(pairs: list[Pair], written: Path) -> list[Pair]:
    """The pairs just measured, and those written before of other cases or peers, in the order of the cases."""
    measured = {(pair.case, pair.peer) for pair in pairs}
    before = pairs_of(json.loads(written.read_text())) if written.exists() else []
    kept = [pair for pair in before if pair.case in CASES and (pair.case, pair.peer) not in measured]
    places = [list(CASES), list(PEERS)]
    return sorted(kept + pairs, key=lambda pair: (places[0].index(pair.case), places[1].index(pair.peer)))


def pairs_of(results: dict[str, Any]) -> list[Pair]:
    """The pairs that were written as JSON."""
    return [Pair(**{**pair, "ours": Side(**pair["ours"]), "theirs": Side(**pair["theirs"])}) for pair in results["pairs"]]


def load_now() -> str:
    """Processes that wanted a core in the last minute."""
    return f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", nargs="+", choices=list(PEERS), default=list(PEERS), help="(default: all)")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES), help="(default: all)")
    parser.add_argument("--repeats", type=int, help="processes of each side (default: 5; quick: 1)")
    parser.add_argument("--quick", action="store_true", help="a smoke run, written among the temporary files")
    parser.add_argument(
        "--output", type=Path, help=f"the table; the JSON goes beside it (default: {OUTPUT.relative_to(ROOT)})"
    )
    args = parser.parse_args()
    repeats = args.repeats or (1 if args.quick else 5)
    blocks, block_seconds = (1, 0.1) if args.quick else (3, 0.5)
    output = args.output or (Path(tempfile.gettempdir()) / "peers.md" if args.quick else OUTPUT)

    start, load = time.perf_counter(), load_now()
    pairs: list[Pair] = []
    able: dict[str, list[str]] = {}
    broken: dict[str, str] = {}
    for peer in args.peers:
        try:
            build(peer)
            able[peer] = run(python_of(peer), ADAPTERS / f"adapter_{peer}.py", "--list").split()
        except Failed as failure:
            broken[peer] = str(failure)
    for group in GROUPS:
        for peer, cases in able.items():
            chosen = [case for case in group if case in cases and case in args.cases]
            compared = compare(chosen, peer, repeats, blocks, block_seconds) if chosen else []
            pairs += compared
            for pair in compared:
                print(f"{time.perf_counter() - start:5.0f} s  {pair.case}: {pair.line()}", file=sys.stderr, flush=True)
    facts = {
        "date": time.strftime("%Y-%m-%d"),
        "processor": cpu_model(),
        "cores": os.cpu_count(),
        "load": f"{load}, {load_now()}",
        "repeats": repeats,
        "blocks": blocks,
        "minutes": round((time.perf_counter() - start) / 60, 1),
    }
    pairs = with_others(pairs, output.with_suffix(".json"))
    text = report(pairs, broken, facts)
    print(text)
    with atomic_write(output) as file:
        file.write(text.encode())
    with atomic_write(output.with_suffix(".json")) as file:
        file.write(json.dumps({**facts, "broken": broken, "pairs": [asdict(pair) for pair in pairs]}, indent=1).encode())


if __name__ == "__main__":
    main()
