"""A small world whose every number can be told in advance, for tests of what is built around worlds."""

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

OBS_SIZES = {"scout_0": 3, "scout_1": 3, "tank_0": 2}
ACTION_SIZES = {"scout_0": 2, "scout_1": 2, "tank_0": 1}
N_CHOICES = {"scout_0": 4, "scout_1": 4, "tank_0": 3}
HIGHEST_ACTION = {"scout_0": 1.0, "scout_1": 1.0, "tank_0": 2.0}


class ToyParallelEnv(ParallelEnv):
    """
    Two scouts and a tank on a line; agent i (from 0) gets the reward (i + 1) · t in step t (from 1).

    An agent's observation is its place, the step, and zeros up to its size. The state is the step and all places.

    :param agents: who takes part
    :param time_limit: the step in which the episode is truncated
    :param deaths: the step in which an agent dies
    :param cuts: the step in which an agent alone is truncated
    :param joins: the step in which an agent joins the world; all others are there from the start
    :param end: the step in which the world ends for all
    :param discrete: agents choose instead of giving a vector
    :param with_state: whether the world declares a ``state()``
    """

    metadata = {"name": "toy_v0", "render_modes": []}  # noqa: RUF012
    render_mode = None

    def __init__(
        self,
        agents=tuple(OBS_SIZES),
        time_limit=None,
        deaths=None,
        end=None,
        discrete=False,
        with_state=True,
        cuts=None,
        joins=None,
    ):
        self.possible_agents = list(agents)
        self.agents = []
        self.time_limit, self.deaths, self.end, self.discrete = time_limit, deaths or {}, end, discrete
        self.cuts, self.joins = cuts or {}, joins or {}
        self.rng = np.random.default_rng(0)
        self.places = dict.fromkeys(agents, 0.0)
        self.received = []
        self._observation_spaces = {a: spaces.Box(-np.inf, np.inf, (OBS_SIZES[a],), np.float32) for a in agents}
        self._action_spaces = {
            a: spaces.Discrete(N_CHOICES[a])
            if discrete
            else spaces.Box(-HIGHEST_ACTION[a], HIGHEST_ACTION[a], (ACTION_SIZES[a],), np.float32)
            for a in agents
        }
        if with_state:
            self.state_space = spaces.Box(-np.inf, np.inf, (1 + len(self.possible_agents),), np.float32)

    def observation_space(self, agent):
        return self._observation_spaces[agent]

    def action_space(self, agent):
        return self._action_spaces[agent]

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.agents = [agent for agent in self.possible_agents if agent not in self.joins]
        self.t = 0
        self.places = {agent: self.rng.uniform(-1, 1) for agent in self.possible_agents}
        return self._observations(self.agents), {agent: {} for agent in self.agents}

    def step(self, actions):
        assert set(actions) == set(self.agents), f"actions of {sorted(actions)} while {self.agents} live"
        self.received.append(actions)
        self.t += 1
        acting = list(self.agents)
        for agent in acting:
            self.places[agent] += 0.1 * float(np.ravel(actions[agent])[0])
        ended = self.end == self.t
        terminations = {agent: ended or self.deaths.get(agent) == self.t for agent in acting}
        truncations = {agent: self.t in (self.time_limit, self.cuts.get(agent)) for agent in acting}
        rewards = {agent: float((self.possible_agents.index(agent) + 1) * self.t) for agent in acting}
        self.agents = [agent for agent in acting if not (terminations[agent] or truncations[agent])]
        joined = [agent for agent, step in self.joins.items() if step == self.t]
        self.agents += joined
        return self._observations(acting + joined), rewards, terminations, truncations, {agent: {} for agent in acting}

    def state(self):
        return np.array([self.t, *self.places.values()], dtype=np.float32)

    def _observations(self, agents):
        rows = {}
        for agent in agents:
            rows[agent] = np.zeros(OBS_SIZES[agent], dtype=np.float32)
            rows[agent][:2] = self.places[agent], self.t
        return rows

    def render(self):
        return None

    def close(self):
        pass


class SpacesEnv(ToyParallelEnv):
    """
    A scout and a tank with any spaces; it keeps the actions that it is given, and refuses those that are none of its own.

    :param observation_spaces: agent → space
    :param action_spaces: agent → space
    :param observations: agent → what it observes; by default drawn from its space
    :param kwargs: of the toy world
    """

    def __init__(self, observation_spaces, action_spaces, observations=None, **kwargs):
        super().__init__(("scout_0", "tank_0"), with_state=False, **kwargs)
        self._observation_spaces, self._action_spaces, self.observations = (
            observation_spaces,
            action_spaces,
            observations or {},
        )
        self.given = None

    def step(self, actions):
        for agent, action in actions.items():
            assert self.action_space(agent).contains(action), f"{agent} got {action!r}"
        self.given = actions
        return super().step(dict.fromkeys(actions, 0.0))

    def _observations(self, agents):
        drawn = {agent: self._observation_spaces[agent].sample() for agent in agents}
        return {agent: self.observations.get(agent, observation) for agent, observation in drawn.items()}
