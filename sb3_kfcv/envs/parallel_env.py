"""One of our worlds as a PettingZoo parallel env."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from sb3_kfcv.envs.drawing import draw
from sb3_kfcv.envs.particle_worlds import ParticleWorlds

RENDER_MODES = ("human", "rgb_array")


class ParticleParallelEnv(ParallelEnv):
    """
    A single world behind PettingZoo's parallel API.

    An agent that dies gets its last reward and an observation of zeros in that step, and leaves ``agents``.
    ``reset(seed=…)`` seeds the world's generator; without a seed the generator goes on, at first from fresh entropy.

    :param worlds: a batch of one world
    :param name: name in the metadata, such as ``"grassland_v0"``
    :param render_mode: ``"rgb_array"``: :meth:`render` returns a picture; ``"human"``: a window follows each step;
        None draws nothing
    """

    def __init__(self, worlds: ParticleWorlds, name: str, render_mode: str | None = None):
        if worlds.n_worlds != 1:
            raise ValueError(f"a parallel env is one world; got a batch of {worlds.n_worlds}")
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"unknown render_mode {render_mode!r}; possible are None, {', '.join(map(repr, RENDER_MODES))}")
        self.worlds = worlds
        self.render_mode = render_mode
        self.metadata: dict[str, Any] = {
            "name": name,
            "render_modes": list(RENDER_MODES),
            "render_fps": worlds.render_fps,
            "is_parallelizable": True,
        }
        self.metric_names = worlds.metric_names
        self.scalar_reward = worlds.scalar_reward
        self.wins = worlds.wins
        self.facts = worlds.facts
        self.possible_agents = list(worlds.agents)
        self._index = {agent: i for i, agent in enumerate(worlds.agents)}
        ends = np.cumsum(worlds.obs_sizes).tolist()
        self._obs_slices = [slice(end - size, end) for end, size in zip(ends, worlds.obs_sizes, strict=True)]
        self.agents: list[str] = []
        self.state_space = spaces.Box(-np.inf, np.inf, (worlds.state_size,), np.float32)
        self._window: Window | None = None

    def observation_space(self, agent: str) -> spaces.Box:
        return self.worlds.observation_space(agent)

    def action_space(self, agent: str) -> spaces.Space:
        return self.worlds.action_space(agent)

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, dict[str, Any]]]:
        """
        Start an episode.

        :param seed: seeds the world's generator
        :param options: not used
        :return: observations and empty infos of all agents
        """
        if seed is not None:
            self.worlds.seed([seed])
        self.worlds.reset()
        self._find_living()
        if self.render_mode == "human":
            self.render()
        return self._observations(self.agents), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, np.ndarray], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """
        Move all living agents. After the end a step without actions does nothing, as in PettingZoo's own worlds: wrappers that
        keep the dead in their list step once more.

        :param actions: one for each agent in ``agents``
        :return: observations, rewards, terminations, truncations, infos of the agents that lived before the step
        :raises ValueError: for an agent without an action, or an action that is none
        """
        worlds, acting = self.worlds, self.agents
        if not actions and self._is_over():
            return {}, {}, {}, {}, {}
        worlds.step(self._joined(actions)[np.newaxis])
        rows = [self._index[agent] for agent in acting]
        rewards, terminated = worlds.rewards[0].tolist(), worlds.terminated[0].tolist()
        truncated = bool(worlds.episode_truncated[0])
        self._find_living()
        if self.render_mode == "human":
            self.render()
        return (
            self._observations(acting),
            {agent: rewards[i] for agent, i in zip(acting, rows, strict=True)},
            {agent: terminated[i] for agent, i in zip(acting, rows, strict=True)},
            {agent: truncated and not terminated[i] for agent, i in zip(acting, rows, strict=True)},
            {agent: {} for agent in acting},
        )

    def state(self) -> np.ndarray:
        """The world's true state, float32 (state_size,)."""
        return self.worlds.states()[0]

    def episode_metrics(self) -> dict[str, float]:
        """Metrics of the episode so far, by name."""
        return dict(zip(self.metric_names, self.worlds.episode_metrics()[0].tolist(), strict=True))

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that the world is made of, random generator and metrics included; see :meth:`set_state`."""
        return self.worlds.get_world(0)

    def set_state(self, saved: dict[str, np.ndarray]) -> None:
        """Continue exactly where :meth:`get_state` was called."""
        self.worlds.set_world(0, saved)
        self._find_living()

    def render(self) -> np.ndarray | None:
        """
        Draw the world.

        :return: uint8 (height, width, 3) in the mode ``"rgb_array"``, else None
        """
        if self.render_mode is None:
            return None
        picture = draw(self.worlds.scene(0))
        if self.render_mode == "rgb_array":
            return picture
        if self._window is None:
            self._window = Window(self.metadata["name"], self.worlds.render_fps)
        self._window.show(picture)
        return None

    def close(self) -> None:
        if self._window is not None:
            self._window.close()
            self._window = None

    def _find_living(self) -> None:
        """Set ``agents`` to those that take part in the next step: none once the episode has ended."""
        alive = self.worlds.alive[0].tolist()
        self.agents = (
            [] if self._is_over() else [agent for agent, lives in zip(self.possible_agents, alive, strict=True) if lives]
        )

    def _is_over(self) -> bool:
        return bool(self.worlds.episode_truncated[0] or self.worlds.episode_terminated[0])

    def _observations(self, agents: list[str]) -> dict[str, np.ndarray]:
        row = self.worlds.observations[0].copy()
        return {agent: row[self._obs_slices[self._index[agent]]] for agent in agents}

    def _joined(self, actions: dict[str, Any]) -> np.ndarray:
        """
        The actions of all agents in one array; the dead stay.

        :return: (agents, 2) forces, or (agents,) integers
        """
        missing = [agent for agent in self.agents if agent not in actions]
        if missing:
            raise ValueError(f"no action given for {', '.join(missing)}")
        if not self.agents:
            raise ValueError("the episode has not begun or is over; call reset()")
        shape = self.action_space(self.agents[0]).shape
        joined = np.zeros((len(self.possible_agents), *(shape or ())))
        for agent in self.agents:
            if np.shape(actions[agent]) != shape:
                raise ValueError(f"the action of {agent} has shape {np.shape(actions[agent])}; it must have shape {shape}")
            joined[self._index[agent]] = actions[agent]
        return joined


class Window:
    """
    A matplotlib window that shows one picture after the other; without a display it shows nothing.

    :param title: title of the window
    :param fps: pictures per second
    """

    def __init__(self, title: str, fps: float):
        import matplotlib.pyplot as plt  # only a window needs it, and it is slow to import

        self._plt = plt
        self._pause = 1 / fps
        self._next = 0.0  # when the next picture may take the place of the last one
        self._figure, axes = plt.subplots(num=title, frameon=False, figsize=(6, 6))
        self._figure.subplots_adjust(0, 0, 1, 1)
        axes.set_axis_off()
        self._image = axes.imshow(np.zeros((1, 1, 3), dtype=np.uint8))
        self.is_visible = self._figure.canvas.required_interactive_framework is not None

    @property
    def is_closed(self) -> bool:
        """Whether somebody has closed it."""
        return not self._plt.fignum_exists(self._figure.number)

    def show(self, picture: np.ndarray) -> None:
        """Show a picture, uint8 (height, width, 3), and wait for the next one's turn."""
        if self.is_visible and not self.is_closed:
            height, width, _ = picture.shape
            self._image.set(data=picture, extent=(0, width, height, 0))
            left = self._next - time.perf_counter()
            with self._plt.rc_context({"figure.raise_window": False}):  # it would come to the front at every picture
                self._plt.pause(max(left, 0.001))
            self._next = time.perf_counter() + self._pause

    def close(self) -> None:
        self._plt.close(self._figure)
