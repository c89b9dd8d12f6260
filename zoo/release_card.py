"""The card of a released model, laid out as Hugging Face's model cards of Stable-Baselines3 models."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import yaml

from sb3_kfcv.common.evaluation import Interval
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.saving.archive import library_versions
from zoo.hyperparams import find_algorithm
from zoo.match_results import as_markdown, shown
from zoo.playing import in_words
from zoo.run_groups import learner
from zoo.runs import Run


class Candidate(NamedTuple):
    """A run that might have been released."""

    seed: int
    reward: float | None


@dataclass(frozen=True)
class Measured:
    """
    What the released model reached, and others beside it.

    :param command: that gives the same numbers
    :param against: the groups that the same one plays whoever is measured: group → name
    :param results: label → quantity → its interval; the released model first
    :param quantities: those that are told
    """

    command: str
    against: Mapping[str, str]
    results: Mapping[str, Mapping[str, Interval]]
    quantities: Sequence[str]

    @property
    def opponents(self) -> str:
        """Such as ``sheep: graze``."""
        return ", ".join(f"{group}: {name}" for group, name in self.against.items())

    def lines(self) -> list[list[str]]:
        """A table of texts, its head first: quantities below each other, players side by side."""
        labels = list(self.results)
        return [
            ["", "this model", *labels[1:]],
            *([name, *(shown(self.results[label][name]) for label in labels)] for name in self.quantities),
        ]


@dataclass(frozen=True)
class Card:
    """
    All that the card of a released model tells.

    :param run: the release, as a run
    :param folder: where releases lie, as the card names it
    :param path: the folder of this one, likewise
    :param layout: of its world
    :param n_timesteps: env steps that it was trained for
    :param normalized: whether it sees normalised observations
    :param candidates: the runs that it was chosen from
    :param best: whether it is the model of the best evaluation
    :param ended: whether the run came to its end
    :param measured: what it reached
    :param n_episodes: of each evaluation
    :param seed: of the first episode
    """

    run: Run
    folder: str
    path: str
    layout: AgentLayout
    n_timesteps: int
    normalized: bool
    candidates: Sequence[Candidate]
    best: bool
    ended: bool
    measured: Sequence[Measured]
    n_episodes: int
    seed: int

    def text(self) -> str:
        """The card, in Markdown."""
        head = yaml.safe_dump(self.header(), sort_keys=False, allow_unicode=True, width=1000)
        parts = [f"---\n{head}---", f"# {learner(self.run)} in {self.run.env_id}", self._summary()]
        parts += ["## How to use it", self._usage(), "## What it reaches", self._results()]
        parts += ["## How it was trained", self._training(), "## Its limits", self._limits(), "## The file", self._file()]
        return "\n\n".join(parts) + "\n"

    def header(self) -> dict[str, Any]:
        """What the Hub reads."""
        run = self.run
        tags = [run.env_id, "deep-reinforcement-learning", "reinforcement-learning", "multi-agent-reinforcement-learning"]
        results = [
            {
                "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
                "dataset": {"name": ", ".join(filter(None, [run.env_id, measured.opponents])), "type": run.env_id},
                "metrics": [
                    {"type": name, "value": own[name].mean, "name": f"{name}, 95 % interval {self._bounds(own[name])}"}
                    for name in measured.quantities
                ],
            }
            for measured in self.measured
            for own in [next(iter(measured.results.values()))]
        ]
        return {
            "library_name": "sb3-kfcv",
            "tags": [*tags, "stable-baselines3", run.algo],
            "model-index": [{"name": learner(run), "results": results}],
        }

    @staticmethod
    def _bounds(interval: Interval) -> str:
        return f"{interval.low:.4g} to {interval.high:.4g}"

    def _summary(self) -> str:
        return (
            f"A trained model of sb3-kfcv: {learner(self.run)} (`{self.run.algo}`) in `{self.run.env_id}` ({self._agents()}), "
            f"after {self.n_timesteps:,} env steps. It is for playing: the actors alone, as JSON and plain arrays, no pickle."
        )

    def _agents(self) -> str:
        """Such as ``wolf × 16, sheep × 12``."""
        return ", ".join(f"{group} × {len(self.layout.members(group))}" for group in self.layout.group_names)

    def _usage(self) -> str:
        run, folder = self.run, shlex.quote(self.folder)
        words = f"--algo {run.algo} --env {run.env_id} -f {folder} --exp-id {run.folder.number}"
        shell = f"python zoo/enjoy.py {words}\npython zoo/record_video.py {words} -o film.gif\npython zoo/evaluate.py {words}"
        return f"```\n{shell}\n```\n\n```python\n{self._python()}\n```"

    def _python(self) -> str:
        algorithm, hyperparams = find_algorithm(self.run.algo).__name__, self.run.hyperparams
        file = f'"{self.path}/{self.run.folder.last_model.name}"'
        names = sorted([algorithm, *(["load_normalization"] if self.normalized else []), "make_vec_env"])
        given = [f'"{self.run.env_id}"']
        given += [f"env_kwargs={hyperparams.env_kwargs}"] if hyperparams.env_kwargs else []
        given += [f"wrappers=find_wrappers({hyperparams.env_wrapper})"] if hyperparams.env_wrapper else []
        lines = [f"from sb3_kfcv import {', '.join(names)}"]
        if hyperparams.env_wrapper:
            lines.append("from sb3_kfcv.vec_env.named_wrappers import find_wrappers")
        lines += ["", f"model = {algorithm}.load({file})", f"env = make_vec_env({', '.join(given)})"]
        if self.normalized:
            lines.append(f"env = load_normalization({file}, env, training=False)")
        return "\n".join([*lines, "actions, _ = model.predict(env.reset(), deterministic=True)"])

    def _results(self) -> str:
        episodes = in_words(self.n_episodes, self.seed)
        parts = [f"Means over {episodes}, with their 95 % intervals; all act greedily, in the same episodes."]
        for measured in self.measured:
            if measured.against:
                parts.append(f"Against {measured.opponents}:")
            elif self.run.config.get("opponents"):
                parts.append("Against the opponents of its training, whom its file holds:")
            elif len(self.layout.group_names) > 1:
                parts.append(f"Each playing all of {' and '.join(self.layout.group_names)}:")
            parts += [as_markdown(measured.lines()), f"    {measured.command}"]
        versions = ", ".join(f"{name} {number}" for name, number in library_versions().items())
        return "\n\n".join([*parts, f"Measured with {versions}."])

    def _training(self) -> str:
        run = self.run
        facts = [
            ["", ""],
            ["algorithm", f"`{run.algo}`"],
            ["world", f"`{run.env_id}`"],
            ["env steps", f"{self.n_timesteps:,}"],
            ["seed", str(run.seed)],
            *([["trained on from", f"`{run.args['trained_agent']}`"]] if run.args.get("trained_agent") else []),
            ["preset", run.args.get("preset") or "default"],
            ["versions", ", ".join(f"{name} {number}" for name, number in run.folder.versions.items())],
        ]
        settings = yaml.safe_dump(run.config, sort_keys=False, allow_unicode=True).strip()
        parts = [as_markdown(facts), self._choice(), f"    {run.folder.command}", f"All settings:\n\n```yaml\n{settings}\n```"]
        return "\n\n".join(parts)

    def _choice(self) -> str:
        which = "best" if self.best else "last"
        model = "It is the model of the run's best evaluation. " if self.best else ""
        if not self.ended:
            planned = self.run.config["n_timesteps"]
            model += f"The run was not at its end: the model is of {self.n_timesteps:,} of {planned:,} env steps. "
        if len(self.candidates) == 1:
            return f"{model}It was the only run to choose from. The command that trained it:"
        rewards = ", ".join(f"seed {seed}: {reward:.2f}" for seed, reward in self.candidates)
        return (
            f"{model}It was chosen from {len(self.candidates)} runs of these settings by the mean reward of their {which} "
            f"evaluation ({rewards}). The command that trained it:"
        )

    def _limits(self) -> str:
        limits = [
            "It cannot be trained on: critics, target networks and optimisers are left out.",
            f"It plays in worlds of the same agents ({self._agents()}) with the same observations and actions, and refuses "
            "others. It was measured in the world of its training alone.",
            "The intervals are over episodes, of this one training. With another seed the same command ends elsewhere.",
        ]
        if len(self.candidates) > 1:
            of = len(self.candidates)
            limits.append(f"It is the best of {of} trainings by their evaluations: expect less of a single one.")
        if len(self.layout.group_names) > 1:
            limits.append("What a group reaches depends on who plays the others: against other opponents it may do worse.")
        limits.append("It is for research and teaching, in a simulated world. Nothing is known of it outside.")
        return "\n".join(f"- {limit}" for limit in limits)

    def _file(self) -> str:
        model = self.run.folder.last_model
        content = model.read_bytes()
        return f"`{model.name}`, {len(content):,} bytes, SHA-256\n\n    {hashlib.sha256(content).hexdigest()}"
