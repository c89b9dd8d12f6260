from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_kfcv.common.actors import ActorPolicy, actor_settings
from sb3_kfcv.common.checks import require_between, require_count, require_finite_columns, require_parameters
from sb3_kfcv.common.denormals import without_denormals
from sb3_kfcv.common.joint_algorithm import JointAlgorithm
from sb3_kfcv.common.live import shares
from sb3_kfcv.common.memory import free_memory, in_words
from sb3_kfcv.common.naming import unknown_name
from sb3_kfcv.common.noise import OneDraw
from sb3_kfcv.common.schedules import schedule_of
from sb3_kfcv.maddpg.diagnostics import Diagnostics
from sb3_kfcv.maddpg.joint_rows import critic_inputs, loss_shares, td_targets
from sb3_kfcv.maddpg.policies import (
    CRITIC_INPUTS,
    CentralCritics,
    MADDPGPolicy,
    MlpPolicy,
    StackedActors,
)
from sb3_kfcv.replay import JointReplayBuffer, JointReplayBufferSamples
from sb3_kfcv.saving.attributes import RETIRED_SETTINGS
from sb3_kfcv.saving.values import UnwritableError
from sb3_kfcv.teams.team_policy import LineUp, TeamPolicy


class MADDPG(JointAlgorithm):
    """
    Multi-Agent Deep Deterministic Policy Gradient (Lowe et al. 2017; eq. 5–6 and Algorithm 1 of Lin et al. 2022).

    Every agent has an actor that sees its own observation and a critic that sees all observations and actions.
    One joint minibatch serves all agents of an update. Defaults are Table 1 of Lin et al.

    The world is one slot of the env: a joint observation row, a joint action row, per-agent rewards in the infos
    (see :class:`~sb3_kfcv.vec_env.joint_env.JointEnv`). A PettingZoo parallel env is wrapped by itself.

    :param policy: ``"MlpPolicy"`` or a subclass of :class:`MADDPGPolicy`
    :param env: a gym id such as ``"Grassland-v0"``, the name of a PettingZoo world such as ``"mpe2/simple_tag_v3"``, a
        PettingZoo ``ParallelEnv``, a joint env, or a ``VecEnv`` of such
    :param learning_rate: of actors and critics; a number, ``"lin_1e-3"`` (falls linearly to 0), an SB3 schedule, or a
        registered function of the remaining progress (see :func:`sb3_kfcv.register`)
    :param buffer_size: joint transitions held
    :param learning_starts: env steps with random actions before learning (Table 1 is silent; a fifth of its buffer)
    :param batch_size: joint transitions per update
    :param tau: update rate of the target networks
    :param gamma: discount factor
    :param train_freq: steps of the vec env between trainings, or ``(n, "episode")``; Algorithm 1 trains every step
    :param gradient_steps: updates per training; −1 makes as many as env steps were taken
    :param action_noise: exploration noise on the joint action in [-1, 1]; by default Gaussian with ``exploration_noise``
    :param exploration_noise: standard deviation of the default noise; discrete agents draw from their softmax instead
    :param replay_buffer_class: by default the one of the algorithm
    :param replay_buffer_kwargs: settings of the replay buffer
    :param optimize_memory_usage: nothing depends on it: the replay buffer never stores an observation twice
    :param critic_input: what critics see beside all actions: ``"observations"`` (all agents', as in the paper), ``"state"``
        (the world's ``state()``) or ``"own_observation"`` (the agent's own); the latter two make the critics' first layer
        many times smaller, and lose no information where every agent sees the whole world
    :param share_parameters: one actor and one critic per group of agents instead of per agent. The critic reads the joint
        input with the agent itself first; both tell the agents apart by a learnt bias, as by a one-hot index in the input
    :param team: learn only the agents of this group; the others act by ``opponents``
    :param opponents: with ``team``: for each other group its player: the name of a scripted policy, the path of a saved model,
        a model, or a mixture drawn anew for every episode, see :func:`~sb3_kfcv.teams.players.find_player`
    :param policy_delay: updates of the critics per update of actors and targets (TD3: 2, against chasing a poor critic)
    :param target_policy_noise: noise on the target actions (TD3: 0.2, smooths sharp peaks of the critics)
    :param target_noise_clip: bound of that noise
    :param max_grad_norm: clip each network's gradient to this norm (MADDPG's own code: 0.5; large rewards spike)
    :param reward_scale: factor on the rewards that the critics learn (large returns make large critic gradients)
    :param actor_regularization: weight of the mean squared actor output before its tanh, or of the logits (MADDPG's own
        code: 1e-3; keeps actions from saturating where their gradient vanishes)
    :param gumbel_temperature: of the Gumbel-softmax of discrete agents
    :param stats_window_size: episodes over which the logged rollout statistics are averaged
    :param tensorboard_log: folder of the TensorBoard log
    :param policy_kwargs: ``net_arch``, ``activation_fn``, ``n_critics`` (2: the lower of two target critics counts, as in
        TD3, against over-estimation), ``layer_norm`` (before each activation, keeps values from diverging),
        ``optimizer_class``, ``optimizer_kwargs``
    :param verbose: 0 none, 1 info, 2 debug
    :param seed: of networks, noise, replay and env
    :param device: ``"auto"``, ``"cpu"``, ``"cuda"``
    :param _init_setup_model: whether to build the networks at once
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}
    default_buffer_class: ClassVar[type[JointReplayBuffer]] = JointReplayBuffer
    stores_state = False  # whether the replay buffer keeps the worlds' states although this learner needs none
    policy: MADDPGPolicy
    replay_buffer: JointReplayBuffer
    actor: StackedActors
    actor_target: StackedActors
    critic: CentralCritics
    critic_target: CentralCritics

    def __init__(
        self,
        policy: str | type[MADDPGPolicy],
        env: gym.Env | VecEnv | str | Any,
        learning_rate: float | str | Schedule = 1e-3,
        buffer_size: int = 5000,
        learning_starts: int = 1000,
        batch_size: int = 128,
        tau: float = 0.01,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        exploration_noise: float = 0.1,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        critic_input: str = "observations",
        share_parameters: bool = False,
        team: str | None = None,
        opponents: dict[str, Any] | None = None,
        policy_delay: int = 1,
        target_policy_noise: float = 0.0,
        target_noise_clip: float = 0.5,
        max_grad_norm: float | None = None,
        reward_scale: float = 1.0,
        actor_regularization: float = 0.0,
        gumbel_temperature: float = 1.0,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate,  # type: ignore[arg-type]
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class or self.default_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
        )
        self.exploration_noise = exploration_noise
        self.critic_input = critic_input
        self.share_parameters = share_parameters
        self.team = team
        self.opponents = opponents
        self.policy_delay = policy_delay
        self.target_policy_noise = target_policy_noise
        self.target_noise_clip = target_noise_clip
        self.max_grad_norm = max_grad_norm
        self.reward_scale = reward_scale
        self.actor_regularization = actor_regularization
        self.gumbel_temperature = gumbel_temperature
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self.check_settings()
        layout = self.layout
        self.agents = list(layout.members(self.team) if self.team else range(layout.n_agents))
        self.n_learning_agents = len(self.agents)
        agent_of_column = [i for i, size in enumerate(layout.action_sizes) for _ in range(size)]
        self._agent_of_column = th.tensor(agent_of_column, device=self.device)
        self._learning_agents = th.tensor(self.agents, device=self.device)
        self._opponent_policy = self._make_opponent_policy()
        self._line_up: LineUp | None = None  # who of the opponents plays in each world
        if self.plays_only:
            self._setup_actors_alone()
            return
        needs_state = self.critic_input != "observations" or self.stores_state
        state_size = layout.state_size if needs_state else 0
        if self.action_noise is None and not layout.discrete and self.exploration_noise > 0:
            size = sum(layout.action_sizes)
            self.action_noise = NormalActionNoise(np.zeros(size), np.full(size, self.exploration_noise), dtype=np.float32)

        users_kwargs = self.policy_kwargs, self.replay_buffer_kwargs
        self.policy_kwargs = {
            "layout": layout,
            "agents": self.agents,
            "critic_input": self.critic_input,
            "share_parameters": self.share_parameters,
            **self.policy_kwargs,
        }
        self.replay_buffer_kwargs = {
            "n_agents": layout.n_agents,
            "state_size": state_size,
            "seed": self.seed,
            **self.replay_buffer_kwargs,
        }
        super()._setup_model()
        self.policy_kwargs, self.replay_buffer_kwargs = users_kwargs
        self._create_aliases()
        seen = layout.state_size if self._teachers_see_state else sum(layout.obs_sizes)
        self.teacher_input_size = seen + sum(layout.action_sizes)
        self._watch = Diagnostics(layout, self.agents)
        self.replay_buffer.attach(self)
        if self.verbose > 0:
            held = (
                f"{self.replay_buffer.buffer_size * self.n_envs:,} joint transitions, {in_words(self.replay_buffer.n_bytes)}"
            )
            print(f"Replay buffer: {held} ({in_words(free_memory())} of memory are free)")

    def _setup_actors_alone(self) -> None:
        """All that a model which was released for playing only is set up with."""
        self.set_random_seed(self.seed)
        settings = actor_settings(self.policy_kwargs, self.share_parameters)
        actors = ActorPolicy(self.observation_space, self.action_space, self.layout, self.agents, **settings)
        self.policy = actors.to(self.device)  # type: ignore[assignment]
        self.actor = self.policy.actor.requires_grad_(False)

    def _setup_lr_schedule(self) -> None:
        rate: Any = self.learning_rate
        self.lr_schedule = FloatSchedule(schedule_of(rate) if isinstance(rate, str) else rate)

    def check_settings(self) -> None:
        """Refuse what cannot train, before anything is built."""
        layout = self.layout
        if self.critic_input not in CRITIC_INPUTS:
            raise ValueError(unknown_name("critic_input", self.critic_input, CRITIC_INPUTS))
        if self.critic_input == "state" and not layout.state_size:
            raise ValueError('critic_input="state" needs a world that has a state(); this one has none')
        for name in ("buffer_size", "batch_size", "policy_delay"):
            require_count(name, getattr(self, name))
        require_count("learning_starts", self.learning_starts, least=0)
        require_count("gradient_steps", self.gradient_steps, least=-1)
        require_count("train_freq", self.train_freq[0] if isinstance(self.train_freq, tuple) else self.train_freq)
        for name in set(RETIRED_SETTINGS) & set(self.replay_buffer_kwargs):
            raise ValueError(f"{name} is no setting any more: ranks are exact for every size of buffer")
        activation = self.policy_kwargs.get("activation_fn", nn.ReLU)
        if isinstance(activation, str | nn.Module):
            raise ValueError(f"activation_fn must be a class, such as torch.nn.Tanh; got {activation!r}")
        require_parameters("policy_kwargs", self.policy_kwargs, self.policy_class)
        optimizer = self.policy_kwargs.get("optimizer_class", th.optim.Adam)
        require_parameters("optimizer_kwargs", self.policy_kwargs.get("optimizer_kwargs") or {}, optimizer)
        require_parameters("replay_buffer_kwargs", self.replay_buffer_kwargs, self.replay_buffer_class)  # type: ignore[arg-type]
        if isinstance(self.learning_rate, str):
            schedule_of(self.learning_rate)
        require_between("reward_scale", self.reward_scale, 0, above=True)
        require_between("gamma", self.gamma, 0, 1)
        require_between("tau", self.tau, 0, 1)
        for name in ("exploration_noise", "target_policy_noise", "target_noise_clip", "actor_regularization"):
            require_between(name, getattr(self, name), 0)
        require_between("gumbel_temperature", self.gumbel_temperature, 0, above=True)
        if self.max_grad_norm is not None:
            require_between("max_grad_norm", self.max_grad_norm, 0, above=True)
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size={self.batch_size} is larger than buffer_size={self.buffer_size}")
        if self.opponents and not self.team:
            raise ValueError("opponents are for a model that learns one group; say which with team=")
        if self._vec_normalize_env is not None and self._vec_normalize_env.norm_reward:
            raise ValueError("norm_reward=True cannot reach the per-agent rewards; use VecNormalize(env, norm_reward=False)")
        if self.team and self._vec_normalize_env is not None:
            raise ValueError("team= does not work under VecNormalize: the opponents need the observations as they are")

    def _make_opponent_policy(self) -> TeamPolicy | None:
        others = [group for group in self.layout.group_names if self.team and group != self.team]
        if not others:
            if self.opponents:
                raise ValueError(f"opponents were given, but team={self.team!r} is everybody in this world")
            return None
        if not self.opponents:
            example = {group: "random" for group in others}
            of_a_file = " (what only has predict is in no file: give it again)" if self.num_timesteps else ""
            raise ValueError(f"team={self.team!r} needs players for the other groups, such as opponents={example}{of_a_file}")
        rng = np.random.default_rng(self.seed)
        return TeamPolicy(self.layout, self.opponents, rng, others, self.action_space, **self.world_facts)

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target
        # Asked for at every update, and slow to gather.
        self._parameters: list[th.Tensor] = [*self.critic.parameters(), *self.actor.parameters()]
        self._target_parameters: list[th.Tensor] = [*self.critic_target.parameters(), *self.actor_target.parameters()]

    @without_denormals()
    @th.no_grad()
    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """
        Update all agents, as the inner loop of Algorithm 1.

        :param gradient_steps: number of updates
        :param batch_size: joint transitions of each
        """
        start = time.perf_counter()
        self.policy.set_training_mode(True)
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])  # type: ignore[list-item]
        self.replay_buffer.progress = min(1 - self._current_progress_remaining, 1.0)  # several worlds may overshoot the end

        for _ in range(gradient_steps):
            self._n_updates += 1
            # Algorithm 1: "Sampling a minibatch of experience quadruples from D". The buffer decides what is drawn: all alike,
            # by priority, or by the curriculum, whose folds, teachers, scores and stages it refreshes when due.
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            share = loss_shares(batch.alive, self._learning_agents)  # (agents, batch): a dead agent's rows enter no loss

            # Eq. 5: minimise (y − Q)², y = r + γ Q'(s', a'_1 … a'_N)
            inputs = self._critic_inputs(batch.observations, batch.states, self.policy.encode(batch.actions), batch.alive)
            targets = self.td_target(batch)  # (agents, batch)
            errors, critic_losses = self.critic.regress(inputs, targets, share * batch.weights)
            self._check_losses("critic loss", critic_losses)
            self._step(self.critic)

            # Eq. 6: ascend Q(s, a_1 … π_i(o_i) … a_N)
            if self._n_updates % self.policy_delay == 0:
                own_actions = self.actor.evaluate(batch.observations, self.gumbel_temperature)
                actor_losses, gradients = self.critic.ascend(own_actions, share)
                self._check_losses("actor loss", actor_losses)
                penalties = self.actor_regularization * share if self.actor_regularization > 0 else None
                self.actor.backward(gradients, penalties)
                self._step(self.actor)
                self._watch.actors(actor_losses, own_actions)

                # θ' ← τθ + (1 − τ)θ'
                th._foreach_lerp_(self._target_parameters, self._parameters, self.tau)

            if self.replay_buffer.uses_td_errors:
                self.replay_buffer.update_priorities(batch.rows, (errors[0].abs() * shares(self.live(batch), dim=0)).sum(0))
            self._watch.critics(critic_losses, targets)

        self._watch.update_seconds += time.perf_counter() - start

    @th.no_grad()
    def td_target(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """
        y = r + γ Q'(s', a'_1 … a'_N) with a'_i = π'_i(o'_i) (eq. 5 and 10); without the second term for an agent that died
        or whose world ended, with it at a time limit.

        :return: (agents, batch), the learning agents
        """
        continues = 1 - batch.dones  # (batch, agents): also of one that has joined in this step
        next_actions = self._target_actions(batch.next_observations)
        next_inputs = self._critic_inputs(batch.next_observations, batch.next_states, next_actions, continues)
        next_q_values = self.critic_target.evaluate(next_inputs)  # (critics, agents, batch)
        rewards = batch.rewards if self.reward_scale == 1 else self.reward_scale * batch.rewards
        return td_targets(rewards, continues, next_q_values, self._learning_agents, self.gamma)

    def teacher_inputs(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """
        What a teacher reads: as the critics, all observations, or the world's state, and then all actions; a dead agent's
        action is 0. Critics of own observations have no input in common: there it is the state, if the world has one.

        :return: (batch, features)
        """
        seen = batch.states if self._teachers_see_state else batch.observations
        return critic_inputs(seen, self.policy.encode(batch.actions), batch.alive, self._agent_of_column)

    @th.no_grad()
    def q_values(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """(agents, batch): each learning agent's first critic."""
        inputs = self._critic_inputs(batch.observations, batch.states, self.policy.encode(batch.actions), batch.alive)
        return self.critic.evaluate(inputs)[0].clone()

    @property
    def _teachers_see_state(self) -> bool:
        return self.critic_input != "observations" and self.layout.state_size > 0

    def live(self, batch: JointReplayBufferSamples) -> th.Tensor:
        """(agents, batch): 1 where the learning agent lived at the start of the step."""
        return batch.alive.T[self._learning_agents]

    def _critic_inputs(self, observations: th.Tensor, states: th.Tensor, actions: th.Tensor, alive: th.Tensor) -> th.Tensor:
        seen = states if self.critic_input == "state" else observations
        return critic_inputs(seen, actions, alive, self._agent_of_column)

    def _target_actions(self, observations: th.Tensor) -> th.Tensor:
        """(batch, joint action): a' of all agents, the learning ones by their target actors, the others as they play."""
        actions = self.policy.joint_actions(self.actor_target, observations, learning=True)
        if self.target_policy_noise > 0 and not self.layout.discrete:
            noise = th.randn_like(actions).mul_(self.target_policy_noise)
            actions = (actions + noise.clamp_(-self.target_noise_clip, self.target_noise_clip)).clamp_(-1, 1)
        if self._opponent_policy is not None:
            actions = self._opponent_policy.expected_rows(actions, observations, self.policy)
        return actions

    def _check_losses(self, quantity: str, losses: th.Tensor) -> None:
        """
        :param losses: (agents,) or (critics, agents)
        :raises NonFiniteError: names the learning agent whose loss is not finite; no network has changed
        """
        if not math.isfinite(sum(losses.flatten().tolist())):
            columns = {self.layout.agents[agent]: slice(i, i + 1) for i, agent in enumerate(self.agents)}
            rows = losses.cpu().numpy().reshape(-1, len(columns))
            require_finite_columns(f"{quantity} in update {self._n_updates:,}", rows, columns)

    def _step(self, networks: StackedActors | CentralCritics) -> None:
        """Move the networks along their gradients."""
        if self.max_grad_norm is not None:
            for stack in networks.stacks:
                stack.clip_gradients(self.max_grad_norm)  # type: ignore[operator]
        networks.optimizer.step()

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        The joint action row, as in SB3; with ``team``, the other groups' part comes from their opponents.

        :param observation: joint row (joint,) or rows (batch, joint)
        :param state: who of mixed opponents plays in each row: what the last call gave; ``None`` draws anew
        :param episode_start: bool (batch,): where mixed opponents draw anew
        :param deterministic: discrete agents take their best action instead of a draw
        :return: joint actions; and the state for the next call, ``None`` without mixed opponents
        """
        actions, _ = super().predict(observation, None, None, deterministic)
        if self._opponent_policy is None:
            return actions, None
        rows = np.asarray(observation)
        line_up = self._opponent_policy.line_up(len(np.atleast_2d(rows)), state, episode_start)
        return self._opponent_policy.fill(actions, rows, deterministic, line_up), line_up

    def greedy_rows(self, observations: th.Tensor) -> th.Tensor:
        """Greedy actions as a critic sees them; zeros for agents that do not learn: (batch, joint action)."""
        return self.policy.greedy_rows(observations)

    def predict_agent(self, agent: str, observation: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """
        One agent's action from its own observation alone: decentralised execution.

        :param agent: name of a learning agent, such as ``"wolf_0"``
        :param observation: (obs,) or (batch, obs)
        :param deterministic: a discrete agent takes its best action instead of a draw
        :return: its action in its own action space
        :raises ValueError: for an agent that the world lacks or that this model does not learn
        """
        if agent not in self.layout.agents:
            raise ValueError(unknown_name("agent", agent, self.layout.agents))
        return self.policy.predict_agent(agent, observation, deterministic)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        buffer_action = self.sample_own_action(learning_starts, action_noise, n_envs)
        action = buffer_action if self.layout.discrete else self.policy.unscale_action(buffer_action)
        if self._opponent_policy is not None:  # neither the warm-up nor the noise is for the opponents
            self._line_up = self._opponent_policy.line_up(n_envs, self._line_up)
            action = self._opponent_policy.fill(action, np.asarray(self._last_obs), False, self._line_up)
            buffer_action = self.policy.from_env(action)
        if not self.layout.discrete:
            require_finite_columns("action", action, self.columns_of(self.layout.action_slices))
        return action, buffer_action

    def sample_own_action(self, learning_starts: int, action_noise: ActionNoise | None, n_envs: int) -> np.ndarray:
        """
        What the learning agents try, as SB3 samples it, without asking any opponent.

        :param learning_starts: env steps with random actions
        :param action_noise: on continuous actions
        :param n_envs: number of worlds
        :return: joint actions as the replay buffer stores them (worlds, joint); the columns of all other agents mean nothing
        """
        if self.num_timesteps < learning_starts:
            action = np.array([self.action_space.sample() for _ in range(n_envs)])
        else:
            assert self._last_obs is not None
            action, _ = self.policy.predict(self._last_obs, deterministic=False)
        if self.layout.discrete:
            return action
        scaled = self.policy.scale_action(action)
        return scaled if action_noise is None else np.clip(scaled + OneDraw(action_noise)(), -1, 1)

    def episodes_ended(self, dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
        if self._opponent_policy is not None:
            self._line_up = self._opponent_policy.line_up(len(dones), self._line_up, dones)

    @property
    def learners(self) -> dict[str, MADDPG]:
        """Itself by the team that it learns, ``all`` if that is everybody; see :class:`CoTraining`, which has several."""
        return {self.team or "all": self}

    def series(self) -> dict[str, Any]:
        return {**self._watch.series(self.actor, self.critic), **self.replay_buffer.diagnostics()}

    def training_state(self) -> dict[str, Any]:
        opponents = self._opponent_policy.get_state() if self._opponent_policy is not None else {}
        watch = self._watch.get_state(self.actor, self.critic)
        return {"watch": watch, "opponents": opponents, "line_up": self._line_up}

    def set_training_state(self, saved: dict[str, Any]) -> None:
        self._watch.set_state(saved["watch"], self.device)
        if self._opponent_policy is not None:
            self._opponent_policy.set_state(saved["opponents"])
            self._line_up = saved.get("line_up")

    def attributes(self, exclude: Collection[str] = (), include: Collection[str] = ()) -> dict[str, Any]:
        """
        As of every model; opponents are written as they play now, so that the file needs no other one. What no file can hold
        (an opponent that only has ``predict``) is left out, and must be given to ``load`` again.
        """
        attributes = super().attributes(exclude, include)
        if self._opponent_policy is not None and "opponents" in attributes:
            try:
                attributes["opponents"] = self._opponent_policy.written(self._opponent_policy.players)
            except UnwritableError:
                del attributes["opponents"]
        return attributes

    def take_opponents(self, then: Mapping[str, Any]) -> None:
        if self._opponent_policy is not None:
            self._opponent_policy.go_on(then)

    def _excluded_save_params(self) -> list[str]:
        excluded = [
            "actor",
            "actor_target",
            "critic",
            "critic_target",
            "_watch",
            "_opponent_policy",
            "_line_up",
            "lr_schedule",
            "start_time",
        ]
        excluded += [
            "agents",
            "n_learning_agents",
            "_agent_of_column",
            "_learning_agents",
            "_parameters",
            "_target_parameters",
            "teacher_input_size",
        ]  # made anew of the settings
        return super()._excluded_save_params() + excluded

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"] if self.plays_only else ["policy", "actor.optimizer", "critic.optimizer"], []
