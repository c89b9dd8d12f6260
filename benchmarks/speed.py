"""
How fast we are: updates, replay, curriculum, worlds, predictions and whole trainings, on one core.

    python benchmarks/speed.py            # some minutes; `make benchmark`
    python benchmarks/speed.py --quick    # some seconds: does it run?

Prints a Markdown table, and writes every timed block to ``docs/results/speed.json``. Everything is warmed up; medians of at
least 5 blocks. Updates stand beside their floor: the same matrix products alone, forward and backward, as plain products of
tensors allocated before, without activations, losses, optimisers, targets or sampling. Floor and update alternate.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from ours import PACKAGES, REFRESHED, STATE_SIZE, end_to_end, learner, random_steps, simulate
from peers.protocol import (
    BATCH_SIZE,
    BUFFER_SIZE,
    HIDDEN,
    UPDATES,
    Work,
    cpu_model,
    in_units,
    seconds_per_operation,
    versions_of,
)

from sb3_kfcv import KFCVMADDPG, MADDPG, PERMADDPG, make_vec_env
from sb3_kfcv.saving.files import atomic_write
from sb3_kfcv.vec_env.make import WORLDS, make_worlds

RESULTS = Path(__file__).resolve().parents[1] / "docs" / "results" / "speed.json"
COLUMNS = ["", "work", "median", "min–max", "per second", "floor (ratio)"]
ALGORITHMS: dict[str, type[MADDPG]] = {"uniform": MADDPG, "by rank": PERMADDPG, "curriculum": KFCVMADDPG}
NEVER: dict[str, Any] = {"replay_buffer_kwargs": {"refresh_every": 10**9, "refresh_fraction": 2.0, "first_teacher_steps": 1}}
"""No refresh but the first: what the curriculum costs between refreshes."""
REFRESH_PERIOD = -(-BUFFER_SIZE // 35)
"""Updates between two refreshes of a full buffer at the defaults (``scored_per_update``)."""


@dataclass
class Effort:
    """How much is measured."""

    repeats: int
    block_seconds: float
    buffer_sizes: tuple[int, ...]
    refreshes: tuple[tuple[int, int], ...]  # (transitions, K)
    n_worlds: tuple[int, ...]
    end_to_end_updates: int  # of a block


FULL = Effort(
    repeats=5,
    block_seconds=0.2,
    buffer_sizes=(5000, 200_000),
    refreshes=((1000, 5), (5000, 2), (5000, 5), (5000, 10), (20_000, 5), (200_000, 5)),
    n_worlds=(1, 32, 64, 1024),
    end_to_end_updates=50,
)
QUICK = Effort(
    repeats=2,
    block_seconds=0.01,
    buffer_sizes=(1000,),
    refreshes=((1000, 5),),
    n_worlds=(1, 64),
    end_to_end_updates=3,
)


@dataclass
class Row:
    """
    A line of the table.

    :param group: kind of work
    :param work: what was done
    :param unit: what the seconds are of
    :param seconds: seconds per unit of each block
    :param floor: the same of the matrix products alone
    """

    group: str
    work: str
    unit: str
    seconds: list[float]
    floor: list[float] = field(default_factory=list)

    def cells(self) -> list[str]:
        """The cells of its line."""
        median = statistics.median(self.seconds)
        spread = f"{in_units(min(self.seconds))}–{in_units(max(self.seconds))}"
        ratio = (
            f"{in_units(statistics.median(self.floor))} ({median / statistics.median(self.floor):.2f}×)" if self.floor else ""
        )
        return [self.group, self.work, f"{in_units(median)} / {self.unit}", spread, f"{1 / median:,.0f}", ratio]


class Floor:
    """
    The matrix products of one update of all agents, each on tensors of its own, and nothing else.

    Products of many networks on inputs of their own are one batched product; the first layer of critics that read the same
    input is one plain product. Backward: gradients of the weights where they are learnt, and of the inputs where a gradient
    goes on from there. The first layer of the critics is counted once per pass: in the actors' pass only the columns of the
    agent's own action change.

    :param n_agents: number of agents
    :param obs_size: observations of each
    :param action_size: actions of each
    :param critic_input: what critics see beside all actions
    """

    def __init__(self, n_agents: int, obs_size: int, action_size: int, critic_input: str) -> None:
        joint_action = n_agents * action_size
        seen = {"observations": n_agents * obs_size, "state": STATE_SIZE, "own_observation": obs_size}[critic_input]
        width, *_ = HIDDEN
        actor_sizes = [obs_size, *HIDDEN, action_size]
        tail_sizes = [*HIDDEN, 1]
        networks, members = (n_agents, 1) if critic_input == "own_observation" else (1, n_agents)
        first_layer = (networks, seen + joint_action, members * width)  # of all critics: products, inputs, outputs
        self.products: list[tuple[th.Tensor, th.Tensor, th.Tensor]] = []

        # y: target actors, target critics
        self._forward(n_agents, actor_sizes)
        self._product(first_layer[0], BATCH_SIZE, *first_layer[1:])
        self._forward(n_agents, tail_sizes)
        # critics
        self._product(first_layer[0], BATCH_SIZE, *first_layer[1:])
        self._forward(n_agents, tail_sizes)
        self._input_gradients(n_agents, tail_sizes)
        self._weight_gradients(n_agents, tail_sizes)
        self._product(first_layer[0], first_layer[1], BATCH_SIZE, first_layer[2])
        # actors, through their critics
        self._forward(n_agents, actor_sizes)
        self._product(first_layer[0], BATCH_SIZE, *first_layer[1:])
        self._product(n_agents, BATCH_SIZE, action_size, width)
        self._forward(n_agents, tail_sizes)
        self._input_gradients(n_agents, [action_size, *tail_sizes])
        self._input_gradients(n_agents, actor_sizes[1:])
        self._weight_gradients(n_agents, actor_sizes)

    def _product(self, n: int, rows: int, inner: int, columns: int) -> None:
        left, right = th.rand(n, rows, inner) - 0.5, th.rand(n, inner, columns) - 0.5
        self.products.append((left, right, th.empty(n, rows, columns)))

    def _forward(self, n: int, sizes: list[int]) -> None:
        for n_in, n_out in pairwise(sizes):
            self._product(n, BATCH_SIZE, n_in, n_out)

    def _input_gradients(self, n: int, sizes: list[int]) -> None:
        for n_in, n_out in pairwise(sizes):
            self._product(n, BATCH_SIZE, n_out, n_in)

    def _weight_gradients(self, n: int, sizes: list[int]) -> None:
        for n_in, n_out in pairwise(sizes):
            self._product(n, n_in, BATCH_SIZE, n_out)

    def run(self) -> None:
        """All products once."""
        for left, right, out in self.products:
            th.bmm(left, right, out=out)


def updates(effort: Effort) -> Iterator[Row]:
    cases = [(sizes, "observations") for sizes in UPDATES.values()]
    cases += [((4, 24, 2), "observations"), (UPDATES["update-28"], "state"), (UPDATES["update-28"], "own_observation")]
    for sizes, critic_input in cases:
        model, floor = learner(*sizes, critic_input=critic_input), Floor(*sizes, critic_input)
        seconds, floor_seconds = [], []
        for _ in range(effort.repeats):  # alternating
            seconds += seconds_per_operation(Work(partial(model.train, 1, BATCH_SIZE)), 1, effort.block_seconds)
            floor_seconds += seconds_per_operation(Work(floor.run), 1, effort.block_seconds)
        n_agents, obs_size, action_size = sizes
        work = f'N = {n_agents}, observations {obs_size}, actions {action_size}, critic_input="{critic_input}"'
        yield Row("update", work, "update", seconds, floor_seconds)


def replay(effort: Effort) -> Iterator[Row]:
    sizes = UPDATES["update-4"]
    for size in effort.buffer_sizes:
        n_envs = 1 if size <= BUFFER_SIZE else 32
        for name, algorithm in ALGORITHMS.items():
            model = learner(*sizes, algorithm, size, n_envs, **(NEVER if algorithm is KFCVMADDPG else {}))
            buffer, rng = model.replay_buffer, np.random.default_rng(0)
            buffer.progress = 0.25  # the curriculum is at work
            buffer.update_priorities(np.arange(buffer.n_rows), th.as_tensor(rng.random(buffer.n_rows)))
            steps, by_rank = cycle(random_steps(model)), algorithm is PERMADDPG
            rows, errors = rng.integers(buffer.n_rows, size=BATCH_SIZE), th.as_tensor(rng.random(BATCH_SIZE))

            def add(buffer: Any = buffer, steps: Any = steps) -> None:
                buffer.add(*next(steps))

            def all_three(buffer: Any = buffer, steps: Any = steps, errors: th.Tensor = errors) -> None:
                buffer.add(*next(steps))
                buffer.update_priorities(buffer.sample(BATCH_SIZE).rows, errors)

            works: dict[str, Callable[[], object]] = {
                f"sample {BATCH_SIZE}": partial(buffer.sample, BATCH_SIZE),
                **({f"update {BATCH_SIZE} priorities": partial(buffer.update_priorities, rows, errors)} if by_rank else {}),
                f"add a step of {n_envs} world{'s' if n_envs > 1 else ''}": add,
                "add, sample, update priorities in turn": all_three,
            }
            for work, operation in works.items():
                seconds = seconds_per_operation(Work(operation), effort.repeats, effort.block_seconds)
                yield Row("replay", f"{name}, {size:,} transitions of 4 × 24: {work}", "call", seconds)


def refreshes(effort: Effort) -> Iterator[Row]:
    cases = [(UPDATES["update-4"], "observations", size, k) for size, k in effort.refreshes]
    if effort is FULL:
        cases += [(UPDATES["update-28"], critic_input, 5000, 5) for critic_input in ("observations", "state")]
    for sizes, critic_input, size, k in cases:
        model = learner(
            *sizes, KFCVMADDPG, size, critic_input=critic_input, replay_buffer_kwargs={"n_folds": k, "first_teacher_steps": 25}
        )
        assert isinstance(model, KFCVMADDPG)
        work = Work(partial(model.replay_buffer.refresh, REFRESHED))  # type: ignore[attr-defined]
        seconds = seconds_per_operation(work, effort.repeats, 0.0)
        work_text = f'N = {sizes[0]}, critic_input="{critic_input}", {size:,} transitions, K = {k}, 25 teacher steps'
        yield Row("refresh", work_text, "refresh", seconds)


def simulation(effort: Effort) -> Iterator[Row]:
    for world in WORLDS:
        for n_worlds in effort.n_worlds:
            work = simulate(make_worlds(world, n_worlds))
            seconds = seconds_per_operation(work, effort.repeats, effort.block_seconds)
            yield Row("simulate", f"{world}, worlds: {n_worlds}, the compiled core", "env step", seconds)
            env = make_vec_env(world, n_worlds, 0).unwrapped
            env.reset()
            rng = np.random.default_rng(0)
            actions = rng.uniform(-1, 1, (50, n_worlds, *(env.action_space.shape or ()))).astype(np.float32)

            def steps(env: Any = env, actions: np.ndarray = actions) -> None:
                for action in actions:
                    env.step(action)

            seconds = seconds_per_operation(Work(steps, 50 * n_worlds), effort.repeats, effort.block_seconds)
            yield Row("simulate", f"{world}, worlds: {n_worlds}, ParticleVecEnv", "env step", seconds)


def predictions(effort: Effort) -> Iterator[Row]:
    for case in ("update-4", "update-28"):
        model = learner(*UPDATES[case], buffer_size=BATCH_SIZE)
        n_agents, obs_size, _ = UPDATES[case]
        rng = np.random.default_rng(0)
        for n_worlds in (1, 64):
            rows = rng.standard_normal((n_worlds, n_agents * obs_size), dtype=np.float32)
            work = Work(partial(model.predict, rows, deterministic=True))
            seconds = seconds_per_operation(work, effort.repeats, effort.block_seconds)
            yield Row("predict", f"N = {n_agents}, all agents, rows: {n_worlds}", "call", seconds)
        work = Work(partial(model.predict_agent, "agent_0", rows[0, :obs_size]))
        seconds = seconds_per_operation(work, effort.repeats, effort.block_seconds)
        yield Row("predict", f"N = {n_agents}, predict_agent, one row", "call", seconds)


def trainings(effort: Effort) -> Iterator[Row]:
    """A block with the curriculum lasts from one refresh to the next, and the curriculum takes the whole training."""
    state, whole = {"critic_input": "state"}, {"replay_buffer_kwargs": {"curriculum_fraction": 1.0}}
    cases: list[tuple[str, str, int, dict[str, Any]]] = [("uniform", "HardSpread-v0", ratio, {}) for ratio in (10, 32, 100)]
    cases += [("by rank", "HardSpread-v0", 32, {}), ("curriculum", "HardSpread-v0", 32, whole)]
    cases += [("uniform", "Grassland-v0", 32, state), ("curriculum", "Grassland-v0", 32, {**state, **whole})]
    cases += [("uniform", "Grassland-v0", 100, state)]
    for name, world, ratio, settings in cases:
        n_updates = REFRESH_PERIOD if name == "curriculum" and effort is FULL else effort.end_to_end_updates
        seconds = end_to_end(ALGORITHMS[name], world, ratio, n_updates * ratio, effort.repeats, **settings)
        critics = ', critic_input="state"' if "critic_input" in settings else ""
        refreshes = ", a refresh per block" if name == "curriculum" else ""
        work = f"{world}, replay {name}{refreshes}, 1 update per {ratio} env steps, worlds: {ratio}{critics}"
        yield Row("end to end", work, "env step", seconds)


GROUPS: dict[str, Callable[[Effort], Iterator[Row]]] = {
    "update": updates,
    "replay": replay,
    "refresh": refreshes,
    "simulate": simulation,
    "predict": predictions,
    "end to end": trainings,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=RESULTS, help="JSON file (default: %(default)s)")
    parser.add_argument("--groups", nargs="+", choices=list(GROUPS), default=list(GROUPS), help="(default: all)")
    parser.add_argument("--quick", action="store_true", help="a smoke run: little is measured, nothing is written by default")
    args = parser.parse_args()
    th.set_num_threads(1)
    effort = QUICK if args.quick else FULL
    facts = {
        "date": time.strftime("%Y-%m-%d"),
        "processor": cpu_model(),
        "threads": th.get_num_threads(),
        "versions": versions_of(PACKAGES),
    }
    print(f"{facts['processor']}, {facts['threads']} thread, {facts['date']}; ", end="")
    print(", ".join(f"{package} {number}" for package, number in facts["versions"].items()))
    print("\nBatch 128, networks 64-64 of each agent's own, medians of", effort.repeats, "blocks.\n")
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    start, rows = time.perf_counter(), []
    for group in args.groups:
        for row in GROUPS[group](effort):
            rows.append(row)
            print("| " + " | ".join(row.cells()) + " |", flush=True)
    print(f"\n{time.perf_counter() - start:.0f} s")
    if not args.quick or args.output != RESULTS:
        with atomic_write(args.output) as file:
            file.write(json.dumps({**facts, "rows": [asdict(row) for row in rows]}, indent=1).encode())


if __name__ == "__main__":
    main()
