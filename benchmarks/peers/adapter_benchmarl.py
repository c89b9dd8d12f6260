"""
BenchMARL, and VMAS, the simulator of its authors that comes with it.

- ``update``: an ``Experiment`` on a task of the wanted sizes, whose replay buffer is filled with random transitions;
  timed is ``Experiment._optimizer_loop``, the method that its own training loop calls for one update (there is no public
  one). Networks and critics per agent (``share_policy_params`` and ``share_param_critic`` off), evaluated by ``vmap``.
- ``predict``: its policy for collection, without noise, on a tensordict of all agents' observations.
- ``uniform``: the replay buffer of such an experiment (TorchRL's), by ``sample`` and, a transition at a time, ``extend``.
- ``train``: ``Experiment.run`` on the VMAS task ``simple_spread``, as many worlds as env steps per update, so that every
  round of steps is followed by one update; timed between the callbacks of its iterations; evaluation off, CSV logger.
- ``spread`` and ``tag``: VMAS alone by ``make_env`` and ``step``, all worlds reset when the episode is over; with very many
  worlds steps alone.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

from protocol import (
    BATCH_SIZE,
    BUFFER_SIZE,
    EPISODE_STEPS,
    GAMMA,
    HIDDEN,
    LEARNING_RATE,
    SPREAD_AGENTS,
    TAG_SHEEP,
    TAG_WOLVES,
    TAU,
    TRAINING_AGENTS,
    UPDATES,
    Work,
    cases,
    main,
)

SCENARIOS: dict[str, tuple[str, dict[str, int], str]] = {
    "spread": ("simple_spread", {"n_agents": SPREAD_AGENTS}, "VMAS simple_spread, continuous actions"),
    "tag": (
        "simple_tag",
        {"num_good_agents": TAG_SHEEP, "num_adversaries": TAG_WOLVES, "num_landmarks": 2},
        "VMAS simple_tag, observations 84–86, continuous actions; no food, nobody dies",
    ),
}

MOST_AGENTS: dict[str, int] = {"spread": 2**16, "tag": 28 * 32}
"""In all worlds, for a whole episode to be timed; with more, a step takes seconds, and steps alone are."""


def experiment(task: Any, callbacks: list[Any] | None = None, **settings: Any) -> Any:
    """An experiment with networks per agent and the common settings."""
    import torch
    from benchmarl.algorithms import MaddpgConfig
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig

    torch.set_num_threads(1)
    config = ExperimentConfig.get_from_yaml()
    config.share_policy_params = False
    config.lr, config.gamma, config.polyak_tau = LEARNING_RATE, GAMMA, TAU
    config.clip_grad_val = None
    config.off_policy_train_batch_size, config.off_policy_memory_size = BATCH_SIZE, BUFFER_SIZE
    config.off_policy_n_optimizer_steps = 1
    config.off_policy_n_envs_per_worker = 1
    config.evaluation, config.render, config.create_json, config.loggers = False, False, False, ["csv"]
    config.save_folder = tempfile.mkdtemp()
    for name, value in settings.items():
        setattr(config, name, value)
    algorithm = MaddpgConfig.get_from_yaml()
    algorithm.share_param_critic = False
    model = MlpConfig(num_cells=list(HIDDEN), layer_class=torch.nn.Linear, activation_class=torch.nn.ReLU)
    return Experiment(task, algorithm, model, seed=0, config=config, callbacks=callbacks)


def random_env(n_agents: int, obs_size: int, action_size: int) -> Any:
    """A TorchRL env of the wanted sizes."""
    import torch
    from tensordict import TensorDict
    from torchrl.data import Bounded, Categorical, Composite, Unbounded
    from torchrl.envs import EnvBase

    def group(**specs: Any) -> Any:
        return Composite({"agents": Composite(specs, shape=(n_agents,))})

    class RandomEnv(EnvBase):
        def __init__(self) -> None:
            super().__init__(device="cpu", batch_size=[])
            self.observation_spec = group(observation=Unbounded((n_agents, obs_size)))
            self.action_spec = group(action=Bounded(-1.0, 1.0, (n_agents, action_size)))
            self.reward_spec = group(reward=Unbounded((n_agents, 1)))
            flag = Categorical(2, shape=(1,), dtype=torch.bool)
            self.done_spec = Composite({"done": flag, "terminated": flag.clone()})

        def _reset(self, tensordict: Any = None, **kwargs: Any) -> Any:
            return TensorDict({**self.observation_spec.rand(), **self.done_spec.zero()}, [])

        def _step(self, tensordict: Any) -> Any:
            return TensorDict({**self.observation_spec.rand(), **self.full_reward_spec.rand(), **self.done_spec.zero()}, [])

        def _set_seed(self, seed: int | None) -> None:
            """Asked for by TorchRL; what is drawn here decides nothing."""

    return RandomEnv()


def random_task(*sizes: int) -> Any:
    """A task of the wanted numbers of agents, observations and actions."""
    from benchmarl.environments.common import TaskClass

    def no(*args: Any) -> bool:
        return False

    def none(*args: Any) -> None:
        return None

    class RandomTask(TaskClass):
        supports_discrete_actions = has_render = no
        info_spec = state_spec = action_mask_spec = none

        def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Callable[[], Any]:
            return partial(random_env, *sizes)

        def supports_continuous_actions(self) -> bool:
            return True

        def max_steps(self, env: Any) -> int:
            return EPISODE_STEPS

        def group_map(self, env: Any) -> dict[str, list[str]]:
            return {"agents": [f"agent_{i}" for i in range(sizes[0])]}

        def observation_spec(self, env: Any) -> Any:
            return env.full_observation_spec.clone()

        def action_spec(self, env: Any) -> Any:
            return env.full_action_spec.clone()

        @staticmethod
        def env_name() -> str:
            return "random"

        def __reduce__(self) -> Any:  # an experiment notes its task in a file
            return str, ("random task",)

    return RandomTask("sizes", {})


def learner_with_rows(n_agents: int, obs_size: int, action_size: int) -> tuple[Any, Any]:
    """An experiment whose replay buffer is full, and the random transitions that it holds."""
    import torch
    from tensordict import TensorDict

    learner = experiment(random_task(n_agents, obs_size, action_size))
    shape = (BUFFER_SIZE, n_agents)
    rows = TensorDict(
        {
            "agents": {"observation": torch.randn(*shape, obs_size), "action": 2 * torch.rand(*shape, action_size) - 1},
            "next": {
                "agents": {"observation": torch.randn(*shape, obs_size), "reward": torch.randn(*shape, 1)},
                "done": torch.zeros(BUFFER_SIZE, 1, dtype=torch.bool),
                "terminated": torch.zeros(BUFFER_SIZE, 1, dtype=torch.bool),
            },
        },
        batch_size=[BUFFER_SIZE],
    )
    rows["agents"].batch_size = rows["next", "agents"].batch_size = shape
    rows = learner.algorithm.process_batch("agents", rows)
    learner.replay_buffers["agents"].extend(rows)
    return learner, rows


def update(n_agents: int, obs_size: int, action_size: int) -> Work:
    learner, _ = learner_with_rows(n_agents, obs_size, action_size)
    return Work(lambda: learner._optimizer_loop("agents"), note="no target actors")


def predict(n_agents: int, obs_size: int, action_size: int, n_rows: int) -> Work:
    import torch
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    learner = experiment(random_task(n_agents, obs_size, action_size))
    seen = torch.randn(n_rows, n_agents, obs_size)

    def act() -> None:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            agents = TensorDict({"observation": seen}, batch_size=[n_rows, n_agents])
            learner.policy(TensorDict({"agents": agents}, batch_size=[n_rows]))

    return Work(act, note="tensors to tensors")


def uniform_sample() -> Work:
    learner, _ = learner_with_rows(*UPDATES["update-28"])
    buffer = learner.replay_buffers["agents"]
    return Work(buffer.sample, note="TorchRL's buffer, returns a tensordict; rewards and ends per agent and per world")


def uniform_add() -> Work:
    learner, rows = learner_with_rows(*UPDATES["update-28"])
    buffer, row = learner.replay_buffers["agents"], rows[:1]
    return Work(lambda: buffer.extend(row), note="TorchRL's buffer, takes a tensordict; it adds a batch at a time in training")


def train(steps_per_update: int) -> Work:
    from benchmarl.environments import VmasTask
    from benchmarl.experiment import Callback

    iterations = 1000 // steps_per_update if steps_per_update > 10 else 50  # of a block
    marks: list[float] = []

    class Clock(Callback):
        def on_batch_collected(self, batch: Any) -> None:
            marks.append(time.perf_counter())

        def __reduce__(self) -> Any:
            return str, ("clock",)

    def timed(repeats: int) -> list[float]:
        task = VmasTask.SIMPLE_SPREAD.get_task({"max_steps": EPISODE_STEPS, "n_agents": TRAINING_AGENTS, "obs_agents": True})
        experiment(
            task,
            [Clock()],
            off_policy_collected_frames_per_batch=steps_per_update,
            off_policy_n_envs_per_worker=steps_per_update,
            max_n_frames=None,
            max_n_iters=(repeats + 1) * iterations + 1,
            exploration_anneal_frames=10_000,
        ).run()
        starts = marks[iterations::iterations]  # the first block warms up
        return [(end - start) / (iterations * steps_per_update) for start, end in pairwise(starts)]

    return Work(timed=timed, note=f"VMAS, {steps_per_update} worlds, actions of 2; no target actors")


def simulate(scenario: str, n_worlds: int) -> Work:
    import torch
    import vmas

    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    name, settings, note = SCENARIOS[scenario]
    env = vmas.make_env(name, num_envs=n_worlds, device="cpu", continuous_actions=True, seed=0, **settings)
    actions = [2 * torch.rand(EPISODE_STEPS, n_worlds, env.get_agent_action_size(agent)) - 1 for agent in env.agents]
    if n_worlds * len(env.agents) <= MOST_AGENTS[scenario]:

        def episode() -> None:
            for t in range(EPISODE_STEPS):
                env.step([chosen[t] for chosen in actions])
            env.reset()

        return Work(episode, EPISODE_STEPS * n_worlds, note)
    first = [chosen[0] for chosen in actions]
    return Work(lambda: env.step(first), n_worlds, f"{note}; steps alone, without resets")


if __name__ == "__main__":
    main(
        ["benchmarl", "torchrl", "tensordict", "vmas", "torch", "numpy"],
        {
            **cases(update=update, predict=predict, train=train),
            **cases(spread=partial(simulate, "spread"), tag=partial(simulate, "tag")),
            "uniform-sample": uniform_sample,
            "uniform-add": uniform_add,
        },
    )
