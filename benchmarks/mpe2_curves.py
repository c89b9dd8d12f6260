"""
Learning curves of the ``tuned`` entries in mpe2's worlds, beside random agents and beside XuanCe's MADDPG.

    python benchmarks/mpe2_curves.py                       # everything, hours; goes on where it was stopped
    python benchmarks/mpe2_curves.py --tasks tag --seeds 5
    python benchmarks/mpe2_curves.py --draw-only           # pictures and tables of what was measured

Trains with ``zoo/train.py --preset tuned``, XuanCe with ``benchmarks/peers/train_xuance.py`` in an environment of its own (see
``benchmarks/compare.py``). Whoever learns, its actors of every sixth of the training play the same episodes, greedily, and
those of the end more of them. Writes ``docs/results/mpe2_curves.json`` after every run, draws ``docs/images/mpe2_*.png``, and
prints Markdown tables.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from compare import ONE_THREAD, QUIET, build, python_of
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from peers.protocol import cpu_model, versions_of
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from sb3_kfcv import ALGOS, make_vec_env  # noqa: E402
from sb3_kfcv.common.evaluation import Interval, evaluate, with_interval  # noqa: E402
from sb3_kfcv.common.layout import AgentLayout  # noqa: E402
from sb3_kfcv.saving.files import atomic_write  # noqa: E402
from sb3_kfcv.teams.team_policy import TeamPolicy  # noqa: E402
from sb3_kfcv.vec_env.make import layout_of  # noqa: E402
from zoo.hyperparams import load_entry  # noqa: E402
from zoo.plots import ALGO_COLOURS, ALGO_LABELS, draw_curve, draw_references, new_figure, save_figure  # noqa: E402
from zoo.run_folder import RunFolder, file_name  # noqa: E402
from zoo.train import main as zoo_train  # noqa: E402

RESULTS = ROOT / "docs" / "results" / "mpe2_curves.json"
IMAGES = ROOT / "docs" / "images"
N_CURVE = 6
"""Evaluations of a training, beside the one before it."""
CURVE_EPISODES, FINAL_EPISODES = 100, 500
N_EVAL_ENVS, EVAL_SEED = 50, 1_000_000
LEARNT, RANDOM = "learnt", "random"
SILENT = "to the middle, silent"
"""Who goes to the middle of the landmarks and says nothing: what can be reached without a message."""
PEER = "xuance"
PEER_COLOURS = {PEER: "#D55E00", f"{PEER}_ours": "#CC79A7"}  # two further ones of Okabe and Ito
DISCRETE_COLOUR = "#56B4E9"  # another one
LABELS = {**ALGO_LABELS, PEER: "XuanCe, its settings", f"{PEER}_ours": "XuanCe, our settings"}


@dataclass(frozen=True)
class Task:
    """
    A world and who learns it.

    :param world: id of the world
    :param groups: its groups; the first one is measured where all want the same
    :param algos: that learn it
    :param continuous: whether its actions are
    :param rivals: whether its groups want different things; each is then measured against random others
    :param talks: whether it is learnt by messages
    """

    world: str
    groups: tuple[str, ...]
    algos: tuple[str, ...] = ("maddpg",)
    continuous: bool = True
    rivals: bool = False
    talks: bool = False

    @property
    def env_kwargs(self) -> dict[str, Any]:
        return {"continuous_actions": self.continuous}

    @property
    def line_ups(self) -> list[dict[str, str]]:
        """Who plays in the evaluations: group → learnt or random."""
        together = dict.fromkeys(self.groups, LEARNT)
        alone = [{group: LEARNT if group == one else RANDOM for group in self.groups} for one in self.groups]
        return [*(alone if self.rivals else []), together]

    def others(self, line_up: Mapping[str, str], group: str) -> dict[str, str]:
        """Who plays against a group; nobody where all want the same."""
        return {other: how for other, how in line_up.items() if self.rivals and other != group}

    def title(self) -> str:
        return f"{self.world.removeprefix('mpe2/')}{'' if self.continuous else ', discrete'}"


TASKS = {
    "spread": Task("mpe2/simple_spread_v3", ("agent",), (*ALGOS, PEER, f"{PEER}_ours")),
    "speaker_listener": Task("mpe2/simple_speaker_listener_v4", ("listener", "speaker"), talks=True),
    "reference": Task("mpe2/simple_reference_v3", ("agent",), talks=True),
    "tag": Task("mpe2/simple_tag_v3", ("adversary", "agent"), rivals=True),
    "adversary": Task("mpe2/simple_adversary_v3", ("adversary", "agent"), rivals=True),
    "spread_discrete": Task("mpe2/simple_spread_v3", ("agent",), continuous=False),
    "speaker_listener_discrete": Task("mpe2/simple_speaker_listener_v4", ("listener", "speaker"), continuous=False),
}


def in_words(line_up: Mapping[str, str]) -> str:
    """Who plays, such as ``adversary learnt, agent random``."""
    return ", ".join(f"{group} {how}" for group, how in line_up.items())


@dataclass
class Trained:
    """
    A training.

    :param players: env steps → what plays all groups, as it was then
    :param seconds: of the clock that it took, without evaluations
    :param processor_seconds: of the processor
    """

    players: dict[int, Any]
    seconds: float
    processor_seconds: float


class Clock(BaseCallback):
    """Seconds from the first step of a training to its last update."""

    def _on_training_start(self) -> None:
        self.begun = time.perf_counter(), time.process_time()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.seconds = time.perf_counter() - self.begun[0]
        self.processor_seconds = time.process_time() - self.begun[1]


def train(task: Task, algo: str, seed: int, steps: int, folder: str) -> Trained:
    """
    One training by ``zoo/train.py``.

    :param task: what is learnt
    :param algo: by what
    :param seed: of the training
    :param steps: env steps
    :param folder: where the run may lie
    :raises RuntimeError: if it does not come to its end
    """
    words = ["--algo", algo, "--env", task.world, "--preset", "tuned", "--seed", str(seed), "-n", str(steps), "-f", folder]
    words += ["--env-kwargs", *(f"{name}:{value}" for name, value in task.env_kwargs.items())]
    words += ["--eval-freq", "-1", "--save-freq", "-1", "--player-freq", str(steps // N_CURVE)]
    words += ["--device", "cpu", "--verbose", "0"]
    clock = Clock()
    with contextlib.redirect_stdout(io.StringIO()):
        status = zoo_train(words, [clock])
    if status:
        raise RuntimeError(f"zoo/train.py {' '.join(words)} stopped with status {status}")
    run = RunFolder(Path(folder) / algo / f"{file_name(task.world)}_1", task.world)
    return Trained({n: str(path) for n, path in run.snapshots("all").items()}, clock.seconds, clock.processor_seconds)


class XuanCeActors:
    """
    XuanCe's actors, one for each agent or one for all, which then sees the agent's number as a one-hot vector.

    :param layout: who sits where in the joint rows
    :param layers: agent → weight and bias of each layer in turn
    """

    def __init__(self, layout: AgentLayout, layers: Mapping[str, list[np.ndarray]]) -> None:
        self.layout = layout
        self.agents = range(layout.n_agents)
        self.layers = layers
        self.shared = len(layers) < layout.n_agents

    def act(self, i: int, seen: np.ndarray) -> np.ndarray:
        """
        Actions of an agent.

        :param i: its number
        :param seen: its observations (B, obs)
        """
        own = self.layers[self.layout.agents[0 if self.shared else i]]
        numbers = np.broadcast_to(np.eye(self.layout.n_agents)[i], (len(seen), self.layout.n_agents))
        x = np.hstack([seen, numbers]) if self.shared else seen
        for k in range(0, len(own) - 2, 2):
            x = x @ own[k].T + own[k + 1]
            x = np.where(x > 0, x, LEAK * x)
        return 1 / (1 + np.exp(-(x @ own[-2].T + own[-1])))

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """Joint actions for joint rows, as SB3's models give them."""
        rows = [self.act(i, observation[:, columns]) for i, columns in enumerate(self.layout.obs_slices)]
        return np.hstack(rows).astype(np.float32), None


LEAK = 0.01
"""Slope of XuanCe's activation below zero."""


def peer_settings(task: Task) -> dict[str, Any]:
    """The settings of our entry that XuanCe has, too, by its names."""
    entry = load_entry("maddpg", task.world, preset="tuned")
    return {
        "parallels": entry["n_envs"],
        "n_epochs": entry["gradient_steps"],
        "training_frequency": entry["n_envs"],
        "start_training": entry["learning_starts"],
        **dict.fromkeys(("start_noise", "end_noise"), entry["exploration_noise"] / 2),  # its actions lie in [0, 1]
        "use_parameter_sharing": entry.get("share_parameters", False),
        "learning_rate_actor": entry["learning_rate"],
        "learning_rate_critic": entry["learning_rate"],
        **{name: entry[name] for name in ("buffer_size", "batch_size", "gamma", "tau")},
    }


def train_peer(task: Task, algo: str, seed: int, steps: int, folder: str) -> Trained:
    """One training by XuanCe, in a process of its own; see :func:`train`."""
    build(PEER)
    settings = {} if algo == PEER else peer_settings(task)
    output, script = Path(folder) / "actors.npz", ROOT / "benchmarks" / "peers" / "train_xuance.py"
    command = [str(python_of(PEER)), str(script), "--steps", str(steps), "--every", str(steps // N_CURVE)]
    command += ["--seed", str(seed), "--set", json.dumps(settings), "--output", str(output)]
    environment = {**os.environ, **ONE_THREAD, **QUIET}
    subprocess.run(command, cwd=folder, env=environment, check=True, stderr=subprocess.DEVNULL)
    with np.load(output) as arrays:
        return peer_players(layout_of(make_vec_env(task.world, env_kwargs=task.env_kwargs)), dict(arrays))


def peer_players(layout: AgentLayout, arrays: Mapping[str, np.ndarray]) -> Trained:
    """
    The actors in a file of ``train_xuance.py``.

    :param layout: who sits where in the joint rows
    :param arrays: of the file
    :raises ValueError: if the last of them do not do what they did there
    """
    layers: dict[int, dict[str, list[np.ndarray]]] = {}
    for name, values in arrays.items():
        steps, _, rest = name.partition("/")
        if steps.isdecimal():
            layers.setdefault(int(steps), {}).setdefault(rest.partition("/")[0], []).append(values)
    players = {steps: XuanCeActors(layout, of_agents) for steps, of_agents in layers.items()}
    for i, agent in enumerate(layout.agents):
        there, here = arrays[f"actions/{agent}"], players[max(players)].act(i, arrays[f"observations/{agent}"])
        if not np.allclose(there, here, atol=1e-4):
            raise ValueError(f"{agent} of XuanCe does {there[0]}, and its actor as it is read here {here[0]}")
    return Trained(players, float(arrays["seconds"]), float(arrays["processor_seconds"]))


def play(env: VecEnv, line_up: Mapping[str, str], player: Any, n_episodes: int) -> dict[str, float]:
    """
    Returns of the groups, means over the same episodes each time.

    :param env: worlds of the evaluation
    :param line_up: group → learnt or random
    :param player: plays the learnt ones
    :param n_episodes: how many
    """
    env.seed(EVAL_SEED)
    players = {group: player if how == LEARNT else RANDOM for group, how in line_up.items()}
    policy = TeamPolicy(layout_of(env), players, np.random.default_rng(EVAL_SEED), action_space=env.action_space)
    return {name: float(values.mean()) for name, values in evaluate(policy, env, n_episodes).items() if "return_" in name}


def measure(task: Task, trained: Trained) -> dict[str, Any]:
    """What the players of a training reach, along the way and at the end."""
    env = make_vec_env(task.world, N_EVAL_ENVS, env_kwargs=task.env_kwargs)
    last = trained.players[max(trained.players)]
    curve, final = {}, {}
    for line_up in task.line_ups:
        name = in_words(line_up)
        if not task.rivals or RANDOM in line_up.values():  # against each other the returns of a training say little
            curve[name] = [play(env, line_up, player, CURVE_EPISODES) for player in trained.players.values()]
        final[name] = play(env, line_up, last, FINAL_EPISODES)
    times = {"seconds": trained.seconds, "processor_seconds": trained.processor_seconds}
    return {**times, "curve_steps": list(trained.players), "curve": curve, "final": final}


class Silent:
    """
    Agents that go to the middle of the landmarks and say nothing, in the two worlds of messages: an observation begins there
    with the agent's velocity and the places of the three landmarks from it, an action with the five forces.

    :param layout: who sits where in the joint rows
    """

    def __init__(self, layout: AgentLayout) -> None:
        self.layout = layout

    def predict(
        self, observation: np.ndarray, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """Joint actions for joint rows, as SB3's models give them."""
        actions = np.zeros((len(observation), sum(self.layout.action_sizes)), np.float32)
        for seen, acts in zip(self.layout.obs_slices, self.layout.action_slices, strict=True):
            own = observation[:, seen]
            if own.shape[1] > N_BEFORE_MESSAGES:  # the speaker sees no place
                middle = own[:, 2:N_BEFORE_MESSAGES].reshape(-1, 3, 2).mean(1)
                left, down = -np.clip(2 * middle - own[:, :2], -1, 1).T
                moves = actions[:, acts]  # a view
                for k, force in enumerate((left, -left, down, -down), start=1):
                    moves[:, k] = np.maximum(force, 0)
        return actions, None


N_BEFORE_MESSAGES = 8
"""Numbers of an observation up to the last landmark."""


def measure_fixed(task: Task, who: str, folder: str) -> dict[str, Any]:
    """
    What agents reach that learn nothing, episode by episode.

    :param task: where
    :param who: :data:`RANDOM` or :data:`SILENT`
    :param folder: for files; there are none
    """
    env = make_vec_env(task.world, N_EVAL_ENVS, EVAL_SEED, env_kwargs=task.env_kwargs)
    layout = layout_of(env)
    players = dict.fromkeys(layout.group_names, Silent(layout) if who == SILENT else RANDOM)
    policy = TeamPolicy(layout, players, np.random.default_rng(EVAL_SEED), action_space=env.action_space)
    played = evaluate(policy, env, FINAL_EPISODES)
    return {"episodes": {name: values.tolist() for name, values in played.items() if "return_" in name}}


def teach_and_measure(task: Task, algo: str, seed: int, steps: int, folder: str) -> dict[str, Any]:
    """One training, see :func:`train`, and what it reaches."""
    return measure(task, (train if algo in ALGOS else train_peer)(task, algo, seed, steps, folder))


@dataclass
class Results:
    """
    All that was measured.

    :param runs: each with its task, algorithm and seed
    """

    runs: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> Results:
        """What a file holds; nothing if there is none."""
        return cls(json.loads(path.read_text())["runs"] if path.exists() else [])

    def write(self, path: Path) -> None:
        packages = ["torch", "stable-baselines3", "mpe2", "pettingzoo", "numpy"]
        facts = {"date": time.strftime("%Y-%m-%d"), "processor": cpu_model(), "threads": 1, "versions": versions_of(packages)}
        facts |= {"evaluation": {"curve_episodes": CURVE_EPISODES, "final_episodes": FINAL_EPISODES, "seed": EVAL_SEED}}
        with atomic_write(path) as file:
            file.write(json.dumps({**facts, "runs": self.runs}).encode())

    def of(self, task: str, algo: str) -> list[dict[str, Any]]:
        """The runs of an algorithm in a task."""
        return [run for run in self.runs if (run["task"], run["algo"]) == (task, algo)]

    def final(self, task: str, algo: str, line_up: str, group: str) -> np.ndarray:
        """What each seed reaches at the end: (seeds,)."""
        return np.array([run["final"][line_up][f"return_{group}"] for run in self.of(task, algo)])

    def curve(self, task: str, algo: str, line_up: str, group: str) -> tuple[np.ndarray, np.ndarray]:
        """Env steps (evaluations,) and what each seed reaches (evaluations, seeds)."""
        runs = self.of(task, algo)
        values = [[evaluation[f"return_{group}"] for evaluation in run["curve"][line_up]] for run in runs]
        return np.array(runs[0]["curve_steps"]), np.array(values).T

    def fixed(self, task: str, who: str, group: str) -> Interval:
        """The return of a group where nobody learns, and its interval over episodes."""
        return with_interval(np.array(self.of(task, who)[0]["episodes"][f"return_{group}"]))

    def processor_seconds(self, task: str, algo: str) -> np.ndarray:
        """Of each seed: (seeds,)."""
        return np.array([run["processor_seconds"] for run in self.of(task, algo)])


def steps_of(task: Task) -> int:
    """Env steps of the task's entry."""
    return int(load_entry("maddpg", task.world)["n_timesteps"])


def wanted(tasks: Iterable[str], seeds: int, share: float) -> list[tuple[dict[str, Any], Callable[[str], dict[str, Any]]]]:
    """
    What is to be measured: what tells a run from others, and what measures it, given a folder for its files. Every task comes
    once before the next seed.

    :param tasks: their names
    :param seeds: of each
    :param share: of the env steps
    """
    jobs: list[tuple[dict[str, Any], Callable[[str], dict[str, Any]]]] = []
    for name in tasks:
        for who in (RANDOM, SILENT) if TASKS[name].talks else (RANDOM,):
            jobs.append(({"task": name, "algo": who}, partial(measure_fixed, TASKS[name], who)))
    for seed in range(seeds):
        for name in tasks:
            for algo in TASKS[name].algos:
                steps = int(steps_of(TASKS[name]) * share)
                key = {"task": name, "algo": algo, "seed": seed, "steps": steps}
                jobs.append((key, partial(teach_and_measure, TASKS[name], algo, seed, steps)))
    return jobs


def table(results: Results) -> str:
    """A line for each task, algorithm of ours and opponent: what is reached, and what random agents reach there."""
    lines = ["| world | return of | against | learnt | random | by | seeds |", "|---" * 7 + "|"]
    for name, task in TASKS.items():
        for algo in task.algos:
            if algo not in ALGOS or not results.of(name, algo):
                continue
            for group in task.groups if task.rivals else task.groups[:1]:
                for line_up in task.line_ups:
                    if line_up[group] == LEARNT:
                        learnt = results.final(name, algo, in_words(line_up), group)
                        cells: list[object] = [
                            task.title(),
                            group,
                            in_words(task.others(line_up, group)),
                            with_interval(learnt),
                        ]
                        cells += [in_its_place(results, name, algo, line_up, group), LABELS[algo], len(learnt)]
                        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def in_its_place(results: Results, name: str, algo: str, line_up: Mapping[str, str], group: str) -> Interval:
    """
    What random agents of a group reach beside the same others: over episodes, or over the seeds of the others where these have
    learnt.

    :param results: all that was measured
    :param name: of the task
    :param algo: by which the others have learnt
    :param line_up: who plays
    :param group: whose return it is
    """
    others = TASKS[name].others(line_up, group)
    if LEARNT in others.values():
        return with_interval(results.final(name, algo, in_words({**line_up, group: RANDOM}), group))
    return results.fixed(name, RANDOM, group)


def peer_table(results: Results) -> str:
    """Ours beside XuanCe: what is reached at the end, and the time of the processor."""
    name, task = "spread", TASKS["spread"]
    ours = results.processor_seconds(name, "maddpg")
    lines = ["| | return per agent | processor time, s | of ours | seeds |", "|---|---|---|---|---|"]
    for algo in ("maddpg", PEER, f"{PEER}_ours"):
        values, seconds = results.final(name, algo, in_words(task.line_ups[0]), "agent"), results.processor_seconds(name, algo)
        if len(values):
            ratio = f"{np.median(seconds) / np.median(ours):.1f}×"
            shown = f"{np.median(seconds):.0f} [{seconds.min():.0f}–{seconds.max():.0f}]"
            lines.append(f"| {LABELS[algo]} | {with_interval(values)} | {shown} | {ratio} | {len(values)} |")
    if results.of(name, RANDOM):
        lines.append(f"| random | {results.fixed(name, RANDOM, 'agent')} | | | |")
    return "\n".join(lines)


def draw_cooperative(results: Results) -> Figure | None:
    """Worlds in which all want the same: a panel each. None of these drawings without anything to draw."""
    worlds = [name for name in ("spread", "speaker_listener", "reference") if results.of(name, "maddpg")]
    if not worlds:
        return None
    figure, axes = new_figure(len(worlds), size=(4.4, 3.7))
    for axis, name in zip(axes, worlds, strict=True):
        task = TASKS[name]
        group, line_up = task.groups[0], in_words(task.line_ups[0])
        for algo in ALGO_LABELS:
            if results.of(name, algo):
                draw_curve(axis, *results.curve(name, algo, line_up, group), ALGO_COLOURS[algo], ALGO_LABELS[algo])
        if results.of(f"{name}_discrete", "maddpg"):
            curve = results.curve(f"{name}_discrete", "maddpg", line_up, group)
            draw_curve(axis, *curve, DISCRETE_COLOUR, "MADDPG, discrete actions")
        fixed = [who for who in (RANDOM, SILENT) if results.of(name, who)]
        draw_references(axis, {who: results.fixed(name, who, group).mean for who in fixed})
        axis.set(title=task.title(), xlabel="env steps", ylabel="return per agent and episode")
        enlarge(axis, results.fixed(name, RANDOM, group).mean)
        axis.legend(fontsize=8)
    return figure


def enlarge(axis: Axes, random: float) -> None:
    """Leave out what lies far below random agents, such as discrete ones before they learn, who always choose the same."""
    low, high = axis.get_ylim()
    axis.set_ylim(max(low, random - 0.3 * (high - random)), high)


def draw_rivals(results: Results) -> Figure | None:
    """Worlds in which two groups learn against each other: a panel for each group, against random others."""
    worlds = [name for name, task in TASKS.items() if task.rivals and results.of(name, "maddpg")]
    panels = [(name, group) for name in worlds for group in TASKS[name].groups]
    if not panels:
        return None
    figure, axes = new_figure(len(panels), size=(3.5, 3.6))
    for axis, (name, group) in zip(axes, panels, strict=True):
        task = TASKS[name]
        line_up = next(line_up for line_up in task.line_ups if line_up[group] == LEARNT and RANDOM in line_up.values())
        curve = results.curve(name, "maddpg", in_words(line_up), group)
        draw_curve(axis, *curve, ALGO_COLOURS["maddpg"], f"MADDPG {group}")
        draw_references(axis, {f"random {group}": results.fixed(name, RANDOM, group).mean})
        other = next(other for other in task.groups if other != group)
        axis.set(title=f"{task.title()}\n{group} against random {other}", xlabel="env steps")
        axis.set_ylabel(f"return per {group} and episode")
        axis.legend(fontsize=8)
    return figure


def draw_peer(results: Results) -> Figure | None:
    """Ours beside XuanCe, by env steps and by the time of the processor."""
    task = TASKS["spread"]
    if not (results.of("spread", "maddpg") and any(results.of("spread", peer) for peer in PEER_COLOURS)):
        return None
    figure, axes = new_figure(2)
    for algo, colour in {"maddpg": ALGO_COLOURS["maddpg"], **PEER_COLOURS}.items():
        if results.of("spread", algo):
            steps, values = results.curve("spread", algo, in_words(task.line_ups[0]), "agent")
            label = f"sb3-kfcv, {LABELS[algo]}" if algo in ALGOS else LABELS[algo]
            draw_curve(axes[0], steps, values, colour, label)
            seconds = steps / steps[-1] * np.median(results.processor_seconds("spread", algo))
            draw_curve(axes[1], seconds, values, colour, label)
    for axis, unit in zip(axes, ("env steps", "processor time, s"), strict=True):
        draw_references(axis, {"random": results.fixed("spread", RANDOM, "agent").mean})
        axis.set(xlabel=unit, ylabel="return per agent and episode")
        axis.legend(fontsize=8, loc="lower right")
    enlarge(axes[1], results.fixed("spread", RANDOM, "agent").mean)
    figure.suptitle("simple_spread_v3, MADDPG, continuous actions (the scale on the right is enlarged)")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS), help="(default: all)")
    parser.add_argument("--algos", nargs="+", choices=list(LABELS), default=list(LABELS), help="(default: all)")
    parser.add_argument("--seeds", type=int, default=5, help="seeds 0 … n − 1 (default: %(default)s)")
    parser.add_argument("--share", type=float, default=1.0, help="of the env steps, for a quick look (default: %(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS, help="(default: docs/results/mpe2_curves.json)")
    parser.add_argument("--images", type=Path, default=IMAGES, help="folder of the pictures (default: docs/images)")
    parser.add_argument("--draw-only", action="store_true", help="measure nothing")
    args = parser.parse_args()
    results = Results.read(args.output)
    for key, run in [] if args.draw_only else wanted(args.tasks, args.seeds, args.share):
        if key["algo"] not in (*args.algos, RANDOM, SILENT) or any(key.items() <= done.items() for done in results.runs):
            continue
        with tempfile.TemporaryDirectory() as folder:
            results.runs.append({**key, **run(folder)})
        results.write(args.output)
        print(key, results.runs[-1].get("final", ""), round(results.runs[-1].get("processor_seconds", 0)), "s", flush=True)
    pictures = {"mpe2_curves.png": draw_cooperative, "mpe2_rivals.png": draw_rivals, "mpe2_peer.png": draw_peer}
    for name, draw in pictures.items():
        if figure := draw(results):
            save_figure(figure, args.images / name)
    print(table(results), peer_table(results), sep="\n\n")


if __name__ == "__main__":
    main()
