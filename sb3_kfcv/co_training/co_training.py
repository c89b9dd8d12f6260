from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_kfcv.algorithms import ALGOS
from sb3_kfcv.co_training.opponents import CoLearner, Pool
from sb3_kfcv.co_training.team_buffers import TeamBuffers
from sb3_kfcv.common.checks import require_between, require_count, require_finite_columns, require_parameters
from sb3_kfcv.common.joint_algorithm import JointAlgorithm
from sb3_kfcv.common.memory import free_memory, in_words
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.maddpg import MADDPG, MlpPolicy
from sb3_kfcv.maddpg.policies import MADDPGPolicy
from sb3_kfcv.replay import JointReplayBuffer
from sb3_kfcv.saving.attributes import check_attributes, require_own
from sb3_kfcv.saving.values import UnwritableError, check_writable
from sb3_kfcv.teams.players import require_players
from sb3_kfcv.teams.team_policy import LineUp, TeamPolicy
from sb3_kfcv.vec_env.make import wins_of

# Settings of a learner that belong to the whole.
OF_THE_WHOLE = ("policy", "env", "team", "opponents", "stats_window_size", "tensorboard_log", "verbose", "seed", "device")

EXAMPLE = {"wolf": "kfcv_maddpg", "sheep": "maddpg"}  # of teams

# Of a learner's attributes, those that its networks and its buffer are made of: no file can change them in a model.
BUILT_OF = (
    *("layout", "observation_space", "action_space", "team", "critic_input", "stores_state", "share_parameters"),
    *("policy_class", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs", "buffer_size"),
)

# Of a learner's attributes, those that come from the whole, or of other sections of its file.
NOT_OF_A_TEAM = (
    *("plays_only", "opponents", "_last_obs", "_last_original_obs", "_last_episode_starts"),
    *("ep_info_buffer", "ep_success_buffer"),
)


class Policies(nn.ModuleList):
    """The policies of all teams, in their order."""

    def set_training_mode(self, mode: bool) -> None:
        """As SB3's policies."""
        for policy in self:
            policy.set_training_mode(mode)  # type: ignore[operator]


class CoTraining(JointAlgorithm):
    """
    Teams that learn apart, at the same time, in one world: each with its own algorithm, its own settings and its own replay
    buffer::

        model = CoTraining("MlpPolicy", env, {"wolf": "kfcv_maddpg", "sheep": {"algo": "per_maddpg", "gamma": 0.95}}, seed=1)
        model.learn(1_000_000)
        model.learners["wolf"].save("wolves.zip")

    Every learner is an ordinary model with ``team=``; they meet in SB3's loop, which is this model's. A critic sees everybody,
    and its target expects the other teams to do what their target actors do (eq. 5), as in one model that learns all agents.
    In each training step the teams are updated in their order.

    With ``pool_share``, some episodes are played by what a team once was (fictitious self-play), so that the others do not
    learn to beat its latest whim alone. What happens in them is learnt from by all, as all experience that is off-policy.

    :param policy: ``"MlpPolicy"`` or a subclass of :class:`MADDPGPolicy`
    :param env: whatever :class:`~sb3_kfcv.maddpg.maddpg.MADDPG` takes
    :param teams: group → its algorithm, by name or class, or a map with the algorithm as ``algo`` and settings of its
        constructor. ``train_freq`` must be the same for all; a team with more ``gradient_steps`` learns more
    :param opponents: who plays the groups that no team learns, see :func:`~sb3_kfcv.teams.players.find_player`
    :param pool_share: share of the episodes that a team's past selves play, in [0, 1], drawn for each team
    :param pool_freq: env steps between the selves that are kept
    :param pool_size: past selves kept of a team, spread over the whole training
    :param pool_sampling: ``"uniform"``, or ``"win_rate"``: those that win come more often; needs a world that says who wins
    :param stats_window_size: episodes over which the logged rollout statistics are averaged
    :param tensorboard_log: folder of the TensorBoard log
    :param verbose: 0 none, 1 info, 2 debug
    :param seed: of the first team; the others follow
    :param device: ``"auto"``, ``"cpu"``, ``"cuda"``
    :param _init_setup_model: whether to build the learners at once
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}
    checked_settings: ClassVar[tuple[str, ...]] = ("policy_class", "teams")
    policy: Policies  # type: ignore[assignment]
    replay_buffer: TeamBuffers  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[MADDPGPolicy],
        env: gym.Env | VecEnv | str | Any,
        teams: dict[str, Any] | None = None,
        opponents: dict[str, Any] | None = None,
        pool_share: float = 0.0,
        pool_freq: int = 25_000,
        pool_size: int = 20,
        pool_sampling: str = "uniform",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=0.0,
            gradient_steps=-1,
            replay_buffer_class=JointReplayBuffer,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
        )
        require_players(teams or {}, EXAMPLE)
        self.teams = {team: _settings_of(given) for team, given in (teams or {}).items()}
        self.opponents = opponents
        self.pool_share = pool_share
        self.pool_freq = pool_freq
        self.pool_size = pool_size
        self.pool_sampling = pool_sampling
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        check_writable({name: getattr(self, name) for name in self.checked_settings})
        self.check_settings()
        self.set_random_seed(self.seed)
        self._players = {team: CoLearner() for team in self.teams}
        self._pools = {
            team: Pool(player, np.random.default_rng(self.seed), self.pool_share, self.pool_size, self.pool_sampling)
            for team, player in self._players.items()
        }
        self.learners: dict[str, MADDPG] = {team: self._make_learner(team, i) for i, team in enumerate(self.teams)}
        for team, learner in self.learners.items():
            self._players[team].model = learner
        self.policy = Policies([learner.policy for learner in self.learners.values()])
        if not self.plays_only:
            self.replay_buffer = TeamBuffers({team: learner.replay_buffer for team, learner in self.learners.items()})
        self.train_freq = next(iter(self.learners.values())).train_freq
        self.learning_starts = min(learner.learning_starts for learner in self.learners.values())
        meeting: Mapping[str, Any] = self._pools if self.pool_share > 0 else self._players
        self._acting = self._team_policy(meeting)  # while learning
        self._playing = self._team_policy(self._players)  # as the teams are now
        self._line_up: LineUp | None = None  # who of pools and mixtures plays in each world
        self._next_selves = 0  # env steps after which the pools take up the teams as they are
        self._wins = wins_of(self.env) if self.env is not None else {}
        if self.verbose > 0 and not self.plays_only:
            print(f"Replay buffers: {in_words(self.replay_buffer.n_bytes)} ({in_words(free_memory())} of memory are free)")

    def check_settings(self) -> None:
        """
        Refuse what cannot train, before anything is built.

        :raises ValueError: one sentence that says what is wrong
        """
        if not self.teams:
            raise ValueError(f"co-training needs teams, such as teams={EXAMPLE}")
        for team, settings in self.teams.items():
            self.layout.members(team)
            algo = _settings_of(settings)["algo"]
            if isinstance(algo, str) and algo not in ALGOS:
                raise ValueError(unknown_name(f"algorithm of {team!r}", algo, ALGOS))
            taken = [name for name in OF_THE_WHOLE if name in settings]
            if taken:
                raise ValueError(f"{taken[0]} of {team!r} belongs to the whole: give it to CoTraining itself")
            own = {name: value for name, value in settings.items() if name != "algo"}
            require_parameters(f"settings of {team!r}", own, _class_of(algo))
        frequencies = {team: settings.get("train_freq", 1) for team, settings in self.teams.items()}
        if len(set(frequencies.values())) > 1:
            raise ValueError(f"train_freq must be the same for all teams, got {frequencies}; gradient_steps may differ")
        left = [group for group in self.layout.group_names if group not in self.teams]
        require_players(self.opponents or {}, dict.fromkeys(left, "random"))
        given = list(self.opponents or {})
        if set(given) != set(left):
            raise ValueError(f"opponents were given for {given}; the groups that no team learns are {left}")
        require_count("pool_freq", self.pool_freq)
        require_between("pool_share", self.pool_share, 0, 1)
        by_wins = self.pool_share > 0 and self.pool_sampling == "win_rate"
        if by_wins and self.env is not None and (len(self.teams) != 2 or not wins_of(self.env)):
            raise ValueError('pool_sampling="win_rate" needs two teams and a world that says who wins (an attribute wins)')
        if self._vec_normalize_env is not None:
            raise ValueError("teams do not learn under VecNormalize: opponents need the observations as they are")

    def _make_learner(self, team: str, place: int) -> MADDPG:
        settings = dict(self.teams[team])
        algorithm = _class_of(settings.pop("algo"))
        meeting: Mapping[str, Any] = self._pools if self.pool_share > 0 else self._players
        others = {other: player for other, player in meeting.items() if other != team}
        learner = algorithm(
            self.policy_class,  # type: ignore[arg-type]
            None,
            team=team,
            opponents={**others, **(self.opponents or {})},
            seed=None if self.seed is None else self.seed + place,
            device=self.device,
            _init_setup_model=False,
            **settings,
        )
        learner.layout, learner.n_envs, learner.world_facts = self.layout, self.n_envs, self.world_facts
        learner.observation_space, learner.action_space = self.observation_space, self.action_space
        learner.plays_only = self.plays_only
        learner.stores_state = any(own.get("critic_input", "observations") != "observations" for own in self.teams.values())
        learner._setup_model()
        learner.set_logger(Logger(None, []))  # what it logs is logged here, by its team's name
        return learner

    # ---- SB3's loop

    def set_env(self, env: Any, force_reset: bool = True) -> None:
        """As of every model, see :meth:`JointAlgorithm.set_env`."""
        super().set_env(env, force_reset)
        self._wins = wins_of(self.get_env())  # type: ignore[arg-type]

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        for learner in self.learners.values():
            noise = learner.action_noise
            if isinstance(noise, VectorizedActionNoise) and noise.n_envs != self.n_envs:  # of a file
                learner.action_noise = noise.base_noise
            if learner.action_noise is not None:
                if self.n_envs > 1 and not isinstance(learner.action_noise, VectorizedActionNoise):
                    learner.action_noise = VectorizedActionNoise(learner.action_noise, self.n_envs)
                learner.action_noise.reset()
        return super()._setup_learn(*args, **kwargs)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Every team explores as it would alone; groups that nobody learns, and past selves, act as they do."""
        tried = []
        for learner in self.learners.values():
            learner.num_timesteps, learner._last_obs = self.num_timesteps, self._last_obs
            tried.append(learner.sample_own_action(learner.learning_starts, learner.action_noise, n_envs))
            learner.num_timesteps += n_envs  # as this model's will be when callbacks see this step
        buffer_action = tried[0]
        for team, own in zip(self.learners, tried, strict=True):
            columns = self._acting.columns[team]
            buffer_action[:, columns] = own[:, columns]
        policy = self.policy[0]
        action = buffer_action if self.layout.discrete else policy.unscale_action(buffer_action)  # type: ignore[operator]
        self._line_up = self._acting.line_up(n_envs, self._line_up)
        themselves = list(self._players.values())
        action = self._acting.fill(action, np.asarray(self._last_obs), False, self._line_up, without=themselves)
        buffer_action = policy.from_env(action)  # type: ignore[operator]
        if not self.layout.discrete:
            require_finite_columns("action", action, self.columns_of(self.layout.action_slices))
        return action, buffer_action

    def episodes_ended(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        ended = np.flatnonzero(dones)
        for learner in self.learners.values():
            if isinstance(learner.action_noise, VectorizedActionNoise):
                learner.action_noise.reset(ended.tolist())
            elif learner.action_noise is not None:
                learner.action_noise.reset()
        self._note_results(ended, [infos[world] for world in ended])
        self._line_up = self._acting.line_up(len(dones), self._line_up, dones)

    def _note_results(self, ended: np.ndarray, infos: list[dict[str, Any]]) -> None:
        """Tell the pools who won against teams that played as they are now."""
        if self.pool_share == 0 or self._line_up is None or len(self.teams) != 2:
            return
        for team, metric in self._wins.items():
            if team not in self.teams or not all(metric in info for info in infos):
                continue
            won = np.array([info[metric] for info in infos])
            (other,) = (name for name in self.teams if name != team)
            playing = {name: self._acting.playing(self._line_up)[name][ended] for name in self.teams}
            for one, against, share in ((team, other, won), (other, team, 1 - won)):
                met = playing[against] == 0
                self._pools[one].note_results(playing[one][met], share[met])

    def train(self, gradient_steps: int, batch_size: int = 0) -> None:
        """
        Update every team whose warm-up is over, by its own settings.

        :param gradient_steps: updates of a team whose ``gradient_steps`` is −1
        :param batch_size: not used, every team has its own
        """
        for learner in self.learners.values():
            if self.num_timesteps > learner.learning_starts:
                learner.num_timesteps = self.num_timesteps
                learner._current_progress_remaining = self._current_progress_remaining
                learner.train(learner.gradient_steps if learner.gradient_steps >= 0 else gradient_steps, learner.batch_size)
        self._n_updates = max(learner._n_updates for learner in self.learners.values())
        if self.pool_share > 0 and self.num_timesteps >= self._next_selves:
            self._next_selves = (self.num_timesteps // self.pool_freq + 1) * self.pool_freq
            for pool in self._pools.values():
                pool.offer()

    def series(self) -> dict[str, Any]:
        """The learners' series; the team is named in the first part of the key: ``train_wolf/critic_loss``."""
        series = {}
        for team, learner in self.learners.items():
            for key, value in {**learner.series(), **learner.logger.name_to_value}.items():
                first, _, rest = key.partition("/")
                series[f"{first}_{team}/{rest}"] = value
            if self.pool_share > 0:
                series[f"pool_{team}/past_selves"] = len(self._pools[team].players) - 1
        return series

    # ---- playing

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The joint action row of all teams as they are now.

        :param observation: joint row (joint,) or rows (batch, joint)
        :param state: who of mixed opponents plays in each row: what the last call gave; ``None`` draws anew
        :param episode_start: bool (batch,): where mixed opponents draw anew
        :param deterministic: discrete agents take their best action instead of a draw
        :return: joint actions; and the state for the next call, ``None`` without mixed opponents
        """
        return self._playing.predict(np.asarray(observation), state, episode_start, deterministic)

    def predict_agent(self, agent: str, observation: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """One agent's action from its own observation alone, see :meth:`MADDPG.predict_agent`."""
        if agent not in self.layout.agents:
            raise ValueError(unknown_name("agent", agent, self.layout.agents))
        group = self.layout.groups[self.layout.agents.index(agent)]
        if group not in self.learners:
            raise ValueError(f"{agent!r} is not among the learning agents")
        return self.learners[group].predict_agent(agent, observation, deterministic)

    def _team_policy(self, players: Mapping[str, Any]) -> TeamPolicy:
        everyone = {**players, **(self.opponents or {})}
        rng = np.random.default_rng(self.seed)
        return TeamPolicy(self.layout, everyone, rng, None, self.action_space, **self.world_facts)

    # ---- files

    def attributes(self, exclude: Collection[str] = (), include: Collection[str] = ()) -> dict[str, Any]:
        """As of every model; opponents are written as they play now, see :meth:`MADDPG.attributes`."""
        attributes = super().attributes(exclude, include)
        if self.opponents and "opponents" in attributes:
            try:
                attributes["opponents"] = self._playing.written(self.opponents)
            except UnwritableError:
                del attributes["opponents"]
        return attributes

    def sections(self, exclude: Collection[str] = (), include: Collection[str] = ()) -> dict[str, Any]:
        teams = {
            team: {"algorithm": type(learner).__name__, **learner.attributes(NOT_OF_A_TEAM)}
            for team, learner in self.learners.items()
        }
        return {**super().sections(exclude, include), "teams": teams}

    def take_sections(self, sections: Mapping[str, Any]) -> None:
        """
        Take over the learners' counters and clocks.

        :raises ValueError: if they are of other learners
        """
        teams = sections["teams"]
        if list(teams) != list(self.learners):
            raise ValueError(f"its teams are {', '.join(teams)}; this model has {', '.join(self.learners)}")
        for team, learner in self.learners.items():
            attributes = dict(teams[team])
            if attributes.pop("algorithm") != type(learner).__name__:
                raise ValueError(f"{team} was learnt by {teams[team]['algorithm']}; this model has {type(learner).__name__}")
            check_attributes(attributes, type(learner))
            require_own(attributes, learner)
            for name in BUILT_OF:
                if attributes.get(name) != getattr(learner, name):
                    raise ValueError(f"{name} of {team} is {attributes.get(name)}; this model has {getattr(learner, name)}")
            vars(learner).update({name: value for name, value in attributes.items() if name not in ("n_envs", "plays_only")})
            learner.check_settings()

    def training_state(self) -> dict[str, Any]:
        return {
            "learners": {team: learner.training_state() for team, learner in self.learners.items()},
            "pools": {team: pool.get_state() for team, pool in self._pools.items()},
            "players": [policy.get_state() for policy in (self._acting, self._playing)],
            "line_up": self._line_up,
            "next_selves": self._next_selves,
        }

    def set_training_state(self, saved: dict[str, Any]) -> None:
        for team, pool in self._pools.items():
            pool.set_state(saved["pools"][team])
        for team, learner in self.learners.items():
            learner.set_training_state(saved["learners"][team])
        for policy, state in zip((self._acting, self._playing), saved["players"], strict=True):
            policy.set_state(state)
        self._line_up, self._next_selves = saved["line_up"], saved["next_selves"]

    def take_opponents(self, then: Mapping[str, Any]) -> None:
        for policy in (self._acting, self._playing):
            policy.go_on(then)
        for learner in self.learners.values():
            learner.take_opponents(then)

    def replay_buffer_state(self) -> dict[str, Any]:
        return self.replay_buffer.state()

    def set_replay_buffer_state(self, state: dict[str, Any], transitions: dict[str, np.ndarray]) -> None:
        self.replay_buffer.set_state(state, transitions)

    def _excluded_save_params(self) -> list[str]:
        made = ["learners", "_players", "_pools", "_acting", "_playing", "_wins", "_line_up", "_next_selves"]
        return [*super()._excluded_save_params(), *made, "lr_schedule", "start_time"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        parts = ("",) if self.plays_only else ("", ".actor.optimizer", ".critic.optimizer")
        return [f"policy.{i}{part}" for i in range(len(self.teams)) for part in parts], []


def _settings_of(given: Any) -> dict[str, Any]:
    """
    :param given: an algorithm, or a map with one as ``algo``
    :raises ValueError: for anything else
    """
    settings = dict(given) if isinstance(given, Mapping) else {"algo": given}
    algo = settings.get("algo")
    settings["algo"] = algo = next((name for name, known in ALGOS.items() if known is algo), algo)  # files know it by its name
    if not isinstance(algo, str) and not (isinstance(algo, type) and issubclass(algo, MADDPG)):
        raise ValueError(f"a team learns by an algorithm, such as one of {', '.join(ALGOS)}; got {given!r}")
    return settings


def _class_of(algo: str | type[MADDPG]) -> type[MADDPG]:
    return ALGOS[algo] if isinstance(algo, str) else algo
