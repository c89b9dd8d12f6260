"""
A few minutes of KFCV-MADDPG in Grassland, from nothing to a table, a learning curve and a GIF: ``python zoo/demo.py``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # scripts import each other as the package ``zoo``

from sb3_kfcv.common.callbacks import TrainByTheClock
from sb3_kfcv.common.evaluation import evaluate, with_interval
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.matches import Arena
from sb3_kfcv.teams.players import JointModel
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env import make_vec_env
from sb3_kfcv.vec_env.make import layout_of
from zoo.command_line import as_it_was_typed
from zoo.plots import ALGO_COLOURS, ALGO_LABELS, draw_curve, draw_references, new_figure, save_arrays, save_figure
from zoo.recording import film, save_gif
from zoo.run_folder import RunFolder
from zoo.train import build, make_parser, start_logs, train

ALGO, WORLD = "kfcv_maddpg", "Grassland-v0"
WOLVES = ("trained", "random", "chase")
SHEEP = ("trained", "random", "flee", "graze")

# Each side is measured against the same scripted players throughout: in self-play a return says little of one side's
# skill, since the other side changes, too.
YARDSTICKS = {"wolf": {"sheep": "flee"}, "sheep": {"wolf": "chase"}}
REFERENCES = {"wolf": ("chase", "random"), "sheep": ("flee", "graze", "random")}

# Seeds of the worlds of the measurements during the training, and of the table after it; the training has its own.
MEASUREMENT_SEED, TABLE_SEED, GIF_SEED = 2_000_000, 3_000_000, 4_000_000
MEASUREMENTS = 12
EPISODES_PER_MEASUREMENT = 64

EXPLANATION = """\
Grassland: 16 wolves hunt 12 sheep that are twice as fast and graze. Nobody is scripted: all 28 learn at the same time, each
with a network of its own, by {label} (settings: hyperparams/{algo}.yml, preset "tuned").
Training takes {minutes:g} minutes by the clock, which is far less than the paper's 100,000 episodes. At first returns fall:
all run into the border, which costs up to 20 a step, and learn to keep off it before they learn to hunt. The wolves are
measured against scripted fleeing sheep, and the sheep against scripted chasing wolves: mean return per agent over
{episodes} new episodes, with its 95 % interval. Ctrl-C saves and stops.
"""


class Measure(BaseCallback):
    """
    Measures each side against its yardstick at even intervals of time, and prints how far the training is.

    :param clock: of the training
    :param n_measurements: how many, beside the one at the start
    :param env: worlds of the measurements
    """

    def __init__(self, clock: TrainByTheClock, n_measurements: int, env: VecEnv) -> None:
        super().__init__()
        self.clock = clock
        self.every = clock.seconds / n_measurements
        self.env = env
        self.next = 0.0
        self.steps: list[int] = []
        self.returns: dict[str, list[np.ndarray]] = {group: [] for group in YARDSTICKS}  # each (episodes,)

    def _on_training_start(self) -> None:
        self.measure()

    def _on_step(self) -> bool:
        if self.clock.elapsed >= self.next:
            self.measure()
        return True

    def _on_training_end(self) -> None:
        if self.num_timesteps > self.steps[-1]:
            self.measure()

    def measure(self) -> None:
        """Measure both sides now."""
        self.next = self.clock.elapsed + self.every
        self.steps.append(self.num_timesteps)
        for group in YARDSTICKS:
            results = evaluate(yardstick(group, self.model, layout_of(self.env)), self.env, EPISODES_PER_MEASUREMENT)
            self.returns[group].append(results[f"return_{group}"])
            self.logger.record(f"demo/return_{group}_against_script", float(results[f"return_{group}"].mean()))
        self.logger.dump(self.num_timesteps)
        wolf, sheep = (with_interval(self.returns[group][-1]) for group in YARDSTICKS)
        spent, left = self.clock.elapsed, max(self.clock.seconds - self.clock.elapsed, 0)
        print(
            f"{clock_time(spent)} trained, {clock_time(left)} left | {self.num_timesteps:>9,} env steps | "
            f"per wolf {wolf!s:>15} | per sheep {sheep!s:>15}",
            flush=True,
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """All measurements: ``timesteps`` (measurements,), ``return_<group>`` (measurements, episodes)."""
        returns = {f"return_{group}": np.stack(values) for group, values in self.returns.items()}
        return {"timesteps": np.array(self.steps), **returns}


def clock_time(seconds: float) -> str:
    """Minutes and seconds."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


def yardstick(group: str, player: str | JointModel, layout: AgentLayout) -> TeamPolicy:
    """
    One side against the script that it is measured by.

    :param group: the side
    :param player: who plays it
    :param layout: of the world
    """
    return TeamPolicy(layout, {group: player, **YARDSTICKS[group]}, np.random.default_rng(0))


def plot_learning_curve(measured: Mapping[str, np.ndarray], env: VecEnv, path: Path) -> None:
    """
    Both sides' returns over the training, between those of scripted players.

    :param measured: as :meth:`Measure.arrays` gives them
    :param env: worlds in which the scripted players are measured
    :param path: of the PNG
    """
    figure, axes = new_figure(2, "Grassland-v0: mean and 95 % interval over the episodes of one training run")
    for axis, group in zip(axes, YARDSTICKS, strict=True):
        (rival,) = YARDSTICKS[group].values()
        draw_curve(
            axis, measured["timesteps"], measured[f"return_{group}"], ALGO_COLOURS[ALGO], f"{ALGO_LABELS[ALGO]} {group}"
        )
        scripted = {
            f"scripted: {name}": float(evaluate(yardstick(group, name, layout_of(env)), env, 256)[f"return_{group}"].mean())
            for name in REFERENCES[group]
        }
        draw_references(axis, scripted)
        axis.set_xlabel("training (env steps)")
        axis.set_ylabel(f"return per {group} (reward per episode)")
        axis.set_title(f"learned {group} against scripted {rival!r}")
        axis.legend(fontsize="small")
    save_figure(figure, path)


def match_table(model: JointModel, n_episodes: int, seed: int) -> tuple[str, dict[tuple[str, str], dict[str, np.ndarray]]]:
    """
    All line-ups of wolves and sheep, in the same fresh worlds.

    :param model: the trained one
    :param n_episodes: per line-up
    :param seed: of the first world
    :return: the table as text, and all metrics of all episodes by line-up
    """
    env = make_vec_env(WORLD, n_episodes, seed)
    results = {}
    lines = [f"{'wolves':>8} {'sheep':>8} {'return per wolf':>17} {'return per sheep':>17} {'eaten':>7} {'wolves win':>11}"]
    for wolf in WOLVES:
        for sheep in SHEEP:
            players = {"wolf": model if wolf == "trained" else wolf, "sheep": model if sheep == "trained" else sheep}
            env.seed(seed)
            played = evaluate(TeamPolicy(layout_of(env), players, np.random.default_rng(seed)), env, n_episodes)
            results[wolf, sheep] = played
            per_wolf, per_sheep = with_interval(played["return_per_wolf"]), with_interval(played["return_per_sheep"])
            eaten, wins = played["sheep_eaten"].mean(), int(played["wolves_win"].sum())
            lines.append(f"{wolf:>8} {sheep:>8} {per_wolf!s:>17} {per_sheep!s:>17} {eaten:>7.1%} {wins:>5}/{n_episodes}")
    return "\n".join(lines), results


def verdict(results: Mapping[tuple[str, str], Mapping[str, np.ndarray]]) -> str:
    """How the trained ones compare with the scripted ones against the yardsticks, by the intervals of the returns."""
    sentences = []
    for group, scripts in REFERENCES.items():
        (rival,) = YARDSTICKS[group].values()

        def returns(player: str, group: str = group, rival: str = rival) -> np.ndarray:
            return results[(player, rival) if group == "wolf" else (rival, player)][f"return_per_{group}"]

        comparisons = []
        for script in scripts:
            # Both played in the same worlds, so episodes pair up.
            difference = with_interval(returns("trained") - returns(script))
            word = "more than" if difference.low > 0 else "less than" if difference.high < 0 else "not clearly different from"
            comparisons.append(
                f"{word} {script!r} ({difference.mean:+.2f}, 95 % {difference.low:+.2f} … {difference.high:+.2f})"
            )
        sentences.append(f"Against {rival!r} a trained {group} gets " + "; ".join(comparisons) + ".")
    return "\n".join(sentences)


def main(argv: Sequence[str] | None = None) -> int:
    """
    The command.

    :param argv: the command line; by default that of the process
    :return: exit status
    """
    parser = argparse.ArgumentParser(description="Train, evaluate and show KFCV-MADDPG in Grassland.")
    parser.add_argument("--minutes", type=float, default=3.0, help="of training (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="(default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=200, help="per row of the table (default: %(default)s)")
    parser.add_argument("--folder", default="demo", help="where everything goes (default: %(default)s)")
    args = parser.parse_args(argv)
    if args.minutes <= 0 or args.episodes < 2:
        parser.error("--minutes must be above 0 and --episodes at least 2")
    folder = Path(args.folder)

    print(EXPLANATION.format(label=ALGO_LABELS[ALGO], algo=ALGO, minutes=args.minutes, episodes=EPISODES_PER_MEASUREMENT))
    command = ["--algo", ALGO, "--env", WORLD, "--preset", "tuned", "--seed", str(args.seed), "-f", str(folder)]
    training = build(make_parser().parse_all([*command, "--eval-freq", "-1", "--save-freq", "-1", "--verbose", "0"]))
    run = RunFolder.create(folder, ALGO, WORLD)
    run.describe(training.hyperparams.to_dict(), vars(training.args), as_it_was_typed("demo", argv))
    start_logs(training, run)
    env = make_vec_env(WORLD, EPISODES_PER_MEASUREMENT, args.seed + MEASUREMENT_SEED)
    clock = TrainByTheClock(60 * args.minutes)
    measure = Measure(clock, MEASUREMENTS, env)
    status = train(training, run, [clock, measure])
    if status:
        print("the demo was stopped")
        return status

    save_arrays(folder / "learning_curve.npz", measure.arrays())
    plot_learning_curve(measure.arrays(), env, folder / "learning_curve.png")
    table, results = match_table(training.model, args.episodes, args.seed + TABLE_SEED)
    print(f"\nAll line-ups, {args.episodes} episodes each in the same fresh worlds (±: 95 % interval of the mean):\n\n{table}")
    print(f"\n{verdict(results)}")
    arena = Arena(make_vec_env(WORLD, 4, env_kwargs={"render_mode": "rgb_array"}))
    players = dict.fromkeys(arena.layout.group_names, training.model)
    title = f"{WORLD}: {ALGO_LABELS[ALGO]} after {args.minutes:g} minutes; return per agent so far"
    frames, _ = film(arena, players, [title], args.seed + GIF_SEED)
    save_gif(frames, folder / "grassland.gif", fps=8)
    print(f"\nLearning curve: {folder / 'learning_curve.png'}\nTrained wolves and sheep: {folder / 'grassland.gif'}")
    print(f"TensorBoard: .venv/bin/tensorboard --logdir {folder}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
