"""
The curves of co-training, a picture for each pair of algorithms: returns of both sides and the wolves' win rate, against each
other and against the yardsticks: ``python benchmarks/draw_teams.py logs/co_training/Grassland-v0_1 …``.

Runs of the same teams are seeds of one another: a line is their mean, a band the 95 % interval of the mean over seeds (of a
single run, over its episodes). Writes ``docs/images/co_training_<algo>_<algo>.png`` and ``docs/results/co_training.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for ``zoo``

from sb3_kfcv.common.evaluation import Interval, with_interval
from sb3_kfcv.saving.files import atomic_write
from zoo.plots import ALGO_LABELS, REFERENCE_COLOUR, draw_intervals, new_figure, save_figure
from zoo.run_folder import RunFolder, read_map

DOCS = Path(__file__).parents[1] / "docs"
COLOURS = {"wolf": "#D55E00", "sheep": "#0072B2"}
YARDSTICKS = {"wolf_vs_graze": "#D55E00", "wolf_vs_flee": "#CC79A7", "sheep_vs_chase": "#0072B2"}


def teams_of(folder: RunFolder) -> str:
    """Such as ``KFCV-MADDPG wolves against PER-MADDPG sheep``."""
    teams = read_map(folder.config_file)["teams"]
    return " against ".join(f"{ALGO_LABELS[teams[team]['algo']]} {team}" for team in teams)


def over_seeds(runs: list[dict[str, np.ndarray]], metric: str) -> list[Interval]:
    """Mean and interval of each evaluation: over the runs, or over the episodes of a single one."""
    if len(runs) == 1:
        return [with_interval(values) for values in runs[0][metric]]
    means = np.array([run[metric].mean(axis=1) for run in runs])  # (runs, evaluations)
    return [with_interval(values) for values in means.T]


def load(folders: list[RunFolder], name: str) -> list[dict[str, np.ndarray]]:
    """The evaluations of some runs, as far as all have come."""
    loaded = [dict(np.load(folder.path / f"evaluations{name}.npz")) for folder in folders]
    length = min(len(run["timesteps"]) for run in loaded)
    return [{metric: values[:length] for metric, values in run.items()} for run in loaded]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description="Draw the curves of co-training.")
    parser.add_argument("runs", nargs="+", help="run folders")
    by_teams: dict[str, list[RunFolder]] = {}
    for path in parser.parse_args().runs:
        folder = RunFolder.existing(path)
        by_teams.setdefault(teams_of(folder), []).append(folder)
    report: dict[str, object] = {}
    for teams, folders in by_teams.items():
        seeds = f"{len(folders)} seed{'s' * (len(folders) > 1)}"
        figure, (returns, wins, measured) = new_figure(3, f"{teams} ({seeds})")
        own = load(folders, "")
        data: dict[str, object] = {"seeds": [read_map(folder.arguments_file)["seed"] for folder in folders]}
        steps = own[0]["timesteps"]
        for team, colour in COLOURS.items():
            curve = over_seeds(own, f"return_{team}")
            draw_intervals(returns, steps, curve, colour, team)
            data[f"return_{team}"] = curve
        data["wolves_win"] = over_seeds(own, "wolves_win")
        draw_intervals(wins, steps, data["wolves_win"], COLOURS["wolf"], "against each other")  # type: ignore[arg-type]
        for name, colour in YARDSTICKS.items():
            team = name.partition("_")[0]
            yardstick = load(folders, f"_{name}")
            data[name] = over_seeds(yardstick, f"return_{team}")
            draw_intervals(measured, steps, data[name], colour, name.replace("_", " "))  # type: ignore[arg-type]
            data[f"{name}_wolves_win"] = over_seeds(yardstick, "wolves_win")
            dashes = "--" if team == "wolf" else ":"
            shown = [interval.mean for interval in data[f"{name}_wolves_win"]]  # type: ignore[attr-defined]
            wins.plot(steps, shown, dashes, color=colour, label=name.replace("_", " "))
        wins.set_ylim(-0.03, 1.03)
        for axis, label in ((returns, "return per agent, against each other"), (wins, "win rate of the wolves")):
            axis.set_ylabel(label)
        measured.set_ylabel("return per agent, against the yardstick")
        for axis in (returns, wins, measured):
            axis.set_xlabel("env steps")
            axis.axhline(0, color=REFERENCE_COLOUR, linewidth=0.6)
            axis.legend(fontsize="small")
        returns.set_ylim(bottom=-15)
        measured.set_ylim(-15, 15)
        report[teams] = {"timesteps": steps.tolist(), **data}
        algos = [theirs["algo"] for theirs in read_map(folders[0].config_file)["teams"].values()]
        save_figure(figure, DOCS / "images" / f"co_training_{'_'.join(algos)}.png")
    with atomic_write(DOCS / "results" / "co_training.json") as file:
        file.write((json.dumps(report, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
