"""Actors and centralised critics of all agents, as stacks."""

from __future__ import annotations

import inspect
import pathlib
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import ConstantSchedule, get_device
from torch import nn
from torch.nn import functional as F

from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.stacked_networks import StackedMLP, at_most
from sb3_kfcv.saving.archive import open_archive, write_archive
from sb3_kfcv.saving.parameters import check_network
from sb3_kfcv.saving.saveable import refusals


class Block:
    """
    Learning agents whose observations and actions have equal sizes, so that their actors stack.

    :param layout: who sits where in the joint rows
    :param agents: indices of the agents in the layout
    :param positions: their places among the learning agents
    """

    def __init__(self, layout: AgentLayout, agents: Sequence[int], positions: Sequence[int]) -> None:
        self.agents = list(agents)
        self.positions = th.tensor(list(positions))
        self.obs_size = layout.obs_sizes[agents[0]]
        self.action_size = layout.action_sizes[agents[0]]
        self.obs_columns = _Columns([layout.obs_slices[i] for i in agents])
        self.action_columns = _Columns([layout.action_slices[i] for i in agents])

    @staticmethod
    def split(layout: AgentLayout, agents: Sequence[int]) -> list[Block]:
        """The blocks of some agents, in order of first appearance."""
        shapes: dict[tuple[int, int], list[int]] = {}
        for i in agents:
            shapes.setdefault((layout.obs_sizes[i], layout.action_sizes[i]), []).append(i)
        return [Block(layout, members, [list(agents).index(i) for i in members]) for members in shapes.values()]


def by_agent(blocks: Sequence[Block], values: Sequence[th.Tensor]) -> th.Tensor:
    """Values per block, (agents of the block, …) each, in the order of the learning agents: (agents, …)."""
    if len(values) == 1:
        return values[0]
    return th.cat(list(values))[th.cat([block.positions for block in blocks]).argsort()]


class _Columns:
    """Equal-sized column ranges of a joint row, read and written as (agents, batch, size); a view where they adjoin."""

    def __init__(self, slices: Sequence[slice]) -> None:
        self.count = len(slices)
        self.index = th.tensor([list(range(s.start, s.stop)) for s in slices])  # (agents, size)
        flat = self.index.flatten()
        adjoin = bool((flat == th.arange(len(flat)) + flat[0]).all())
        self.range: slice | th.Tensor = slice(int(flat[0]), int(flat[-1]) + 1) if adjoin else flat

    def read(self, rows: th.Tensor) -> th.Tensor:
        """(batch, joint) → (agents, batch, size)."""
        return rows[:, self.range].unflatten(1, (self.count, -1)).transpose(0, 1)

    def write(self, rows: th.Tensor, values: th.Tensor) -> None:
        """Put (agents, batch, size) into (batch, joint)."""
        rows[:, self.range] = values.transpose(0, 1).flatten(1)


class StackedActors(nn.Module):
    """
    The learning agents' deterministic policies π_i(o_i), each seeing its own observation alone.

    Continuous agents end in a tanh (actions in [-1, 1]); discrete ones give logits.

    :param layout: who sits where in the joint rows
    :param agents: the learning agents
    :param net_arch: hidden sizes
    :param activation_fn: activation between layers
    :param share_parameters: one network per group of agents instead of one per agent
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self,
        layout: AgentLayout,
        agents: Sequence[int],
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        share_parameters: bool = False,
    ) -> None:
        super().__init__()
        self.layout = layout
        self.blocks = Block.split(layout, agents)
        self.stacks = nn.ModuleList()
        for block in self.blocks:
            members = shared_members(layout, block.agents) if share_parameters else None
            n_networks = max(members) + 1 if members else len(block.agents)
            sizes = [block.obs_size, *net_arch, block.action_size]
            self.stacks.append(StackedMLP(n_networks, sizes, activation_fn, members=members))

    def outputs(self, observations: th.Tensor) -> list[th.Tensor]:
        """
        :param observations: joint rows (batch, joint)
        :return: per block (agents, batch, action): what the last layers give, before the tanh or the choice
        """
        return [stack(block.obs_columns.read(observations)) for stack, block in zip(self.stacks, self.blocks, strict=True)]

    def forward(self, observations: th.Tensor, explore: bool = False) -> list[th.Tensor]:
        """
        The actions as a critic sees them; the choice of a discrete agent has no gradient.

        :param observations: joint rows (batch, joint)
        :param explore: discrete agents draw from their softmax instead of taking its maximum
        :return: per block (agents, batch, action)
        """
        outputs = self.outputs(observations)
        if not self.layout.discrete:
            return [th.tanh(output) for output in outputs]
        if explore:
            outputs = [gumbel_perturbed(logits) for logits in outputs]
        return [F.one_hot(logits.argmax(-1), logits.shape[-1]).to(logits.dtype) for logits in outputs]

    def relaxed(self, observations: th.Tensor, temperature: float) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """
        Actions that carry a gradient: as they are, or straight-through Gumbel-softmax for discrete agents.

        :param temperature: of the Gumbel-softmax
        :return: the actions, per block (agents, batch, action), and the raw outputs that they come from
        """
        outputs = self.outputs(observations)
        if not self.layout.discrete:
            return [th.tanh(output) for output in outputs], outputs
        return [F.gumbel_softmax(logits, tau=temperature, hard=True) for logits in outputs], outputs

    def network(self, agent: int) -> nn.Sequential:
        """The network of one agent, as separate ``nn.Linear`` layers (a copy; its last layer is linear)."""
        for stack, block in zip(self.stacks, self.blocks, strict=True):
            if agent in block.agents:
                return stack.network(block.agents.index(agent))  # type: ignore[operator]
        raise ValueError(f"{self.layout.agents[agent]!r} is not among the learning agents")


class StackedCritics(nn.Module):
    """
    The learning agents' centralised critics Q_i(s, a_1 … a_N), all reading the same joint input.

    :param layout: who sits where in the joint rows
    :param agents: the learning agents
    :param critic_input: ``"observations"`` (of all agents) or ``"state"`` (the world's); the joint action comes after it
    :param net_arch: hidden sizes
    :param activation_fn: activation between layers
    :param n_critics: critics per agent (2 for clipped double Q-learning)
    :param share_parameters: one critic per group of agents instead of one per agent
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self,
        layout: AgentLayout,
        agents: Sequence[int],
        critic_input: str,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 1,
        share_parameters: bool = False,
    ) -> None:
        super().__init__()
        self.actions_start = layout.state_size if critic_input == "state" else sum(layout.obs_sizes)
        self.input_size = self.actions_start + sum(layout.action_sizes)
        self.blocks = Block.split(layout, agents)
        members = shared_members(layout, agents) if share_parameters else None
        n_networks = max(members) + 1 if members else len(agents)
        order = ego_order(layout, agents, critic_input) if share_parameters else None
        sizes = [self.input_size, *net_arch, 1]
        self.stacks = nn.ModuleList(
            StackedMLP(n_networks, sizes, activation_fn, n_inputs=1, members=members, input_order=order)
            for _ in range(n_critics)
        )

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: (batch, observations or state, then joint action)
        :return: Q-values (critics, agents, batch)
        """
        return th.stack([stack(inputs.unsqueeze(0)).squeeze(-1) for stack in self.stacks])

    def with_own_actions(self, inputs: th.Tensor, own_actions: list[th.Tensor]) -> th.Tensor:
        """
        Q_i of each agent's first critic with the agent's own action replaced and all others as they are (eq. 6).

        The first layer of all critics is computed once; an agent's new action moves its pre-activation by
        (new − old) · (its own action columns). Gradients reach ``own_actions`` alone.

        :param inputs: (batch, observations or state, then joint action)
        :param own_actions: per block (agents, batch, action)
        :return: (agents, batch)
        """
        stack: StackedMLP = self.stacks[0]  # type: ignore[assignment]
        with th.no_grad():
            z = stack.first_layer(inputs.unsqueeze(0))  # (agents, batch, hidden)
        moved = []
        for block, new in zip(self.blocks, own_actions, strict=True):
            old = block.action_columns.read(inputs[:, self.actions_start :])
            own_columns = stack.input_columns(block.positions, self.actions_start + block.action_columns.index)
            moved.append(th.baddbmm(z[block.positions] if len(self.blocks) > 1 else z, new - old, own_columns))
        return stack.after_first_layer(by_agent(self.blocks, moved), frozen=True).squeeze(-1)

    def network(self, position: int, critic: int = 0) -> nn.Sequential:
        """One critic as separate ``nn.Linear`` layers (a copy); ``position`` counts the learning agents."""
        return self.stacks[critic].network(position)  # type: ignore[operator]


class OwnObservationCritics(nn.Module):
    """
    Critics Q_i(o_i, a_1 … a_N) that see their agent's own observation and all actions. Where the agent sees the whole
    world from its own place, nothing is lost, the input is many times smaller than all observations together, and what
    counts (how far is the nearest sheep?) need not be worked out from absolute positions.

    The parameters are those of :class:`StackedCritics`; inputs are all observations, then the joint action.
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self,
        layout: AgentLayout,
        agents: Sequence[int],
        critic_input: str,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 1,
        share_parameters: bool = False,
    ) -> None:
        super().__init__()
        n_actions = sum(layout.action_sizes)
        self.actions_start = sum(layout.obs_sizes)
        self.blocks = Block.split(layout, agents)
        order = ego_order(layout, agents, critic_input) if share_parameters else th.arange(n_actions).repeat(len(agents), 1)
        self.read_order = [order[block.positions].argsort(1) for block in self.blocks]  # (agents, joint action)
        self.own_slots = [  # (agents, action) in the input of the networks
            block.obs_size + order[block.positions].gather(1, block.action_columns.index) for block in self.blocks
        ]
        self.stacks = nn.ModuleList()  # critic after critic, block after block
        for _ in range(n_critics):
            for block in self.blocks:
                members = shared_members(layout, block.agents) if share_parameters else None
                n_networks = max(members) + 1 if members else len(block.agents)
                sizes = [block.obs_size + n_actions, *net_arch, 1]
                self.stacks.append(StackedMLP(n_networks, sizes, activation_fn, members=members))

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: (batch, all observations, then joint action)
        :return: Q-values (critics, agents, batch)
        """
        read = self._read(inputs)
        values = [stack(read[i % len(read)]).squeeze(-1) for i, stack in enumerate(self.stacks)]
        critics = [values[first : first + len(read)] for first in range(0, len(values), len(read))]
        return th.stack([by_agent(self.blocks, critic) for critic in critics])

    def with_own_actions(self, inputs: th.Tensor, own_actions: list[th.Tensor]) -> th.Tensor:
        """See :meth:`StackedCritics.with_own_actions`."""
        values = []
        for i, (block, read, new) in enumerate(zip(self.blocks, self._read(inputs), own_actions, strict=True)):
            stack: StackedMLP = self.stacks[i]  # type: ignore[assignment]
            with th.no_grad():
                z = stack.first_layer(read)
            old = block.action_columns.read(inputs[:, self.actions_start :])
            own_columns = stack.input_columns(th.arange(len(block.agents)), self.own_slots[i])
            values.append(stack.after_first_layer(th.baddbmm(z, new - old, own_columns), frozen=True).squeeze(-1))
        return by_agent(self.blocks, values)

    def network(self, position: int, critic: int = 0) -> nn.Sequential:
        """One critic as separate layers (a copy); it reads the own observation, then the actions in its ``read_order``."""
        for i, block in enumerate(self.blocks):
            if position in block.positions:
                stack = self.stacks[critic * len(self.blocks) + i]
                return stack.network(block.positions.tolist().index(position))  # type: ignore[operator]
        raise ValueError(f"there is no learning agent {position}")

    def _read(self, inputs: th.Tensor) -> list[th.Tensor]:
        """What the networks of each block read: (agents, batch, own observation and all actions)."""
        actions = inputs[:, self.actions_start :]
        return [
            th.cat([block.obs_columns.read(inputs[:, : self.actions_start]), actions[:, order].transpose(0, 1)], dim=-1)
            for block, order in zip(self.blocks, self.read_order, strict=True)
        ]


CRITIC_INPUTS: dict[str, type[StackedCritics] | type[OwnObservationCritics]] = {
    "observations": StackedCritics,
    "state": StackedCritics,
    "own_observation": OwnObservationCritics,
}


def shared_members(layout: AgentLayout, agents: Sequence[int]) -> list[int]:
    """Which network each agent uses when one network serves a group: 0 for the first group met, 1 for the next, …"""
    groups = list(dict.fromkeys(layout.groups[i] for i in agents))
    return [groups.index(layout.groups[i]) for i in agents]


def ego_order(layout: AgentLayout, agents: Sequence[int], critic_input: str) -> th.Tensor:
    """
    The order in which each agent's critic reads the joint input when a group shares one critic: the agent itself first,
    then the others of its group in turn; other groups, and a world state, as they are.

    :param layout: who sits where in the joint rows
    :param agents: the learning agents
    :param critic_input: what stands before the joint action; ``"own_observation"`` counts as nothing
    :return: (agents, input) which input of the shared network takes each column
    :raises ValueError: if agents of a group have different spaces
    """
    n_seen = {"observations": sum(layout.obs_sizes), "state": layout.state_size, "own_observation": 0}[critic_input]
    parts = [(n_seen, layout.action_slices)]
    if critic_input == "observations":
        parts.append((0, layout.obs_slices))
    order = th.arange(n_seen + sum(layout.action_sizes)).repeat(len(agents), 1)
    for row, agent in enumerate(agents):
        members = layout.members(layout.groups[agent])
        shapes = {(layout.obs_sizes[i], layout.action_sizes[i]) for i in members}
        if len(shapes) > 1:
            raise ValueError(f"share_parameters needs equal spaces within a group; {layout.groups[agent]!r} has {shapes}")
        turn = members.index(agent)
        for start, columns in parts:
            for place, other in enumerate(members):
                read, taken = columns[other], columns[members[place - turn]]
                order[row, start + read.start : start + read.stop] = th.arange(start + taken.start, start + taken.stop)
    return order


SelfMADDPGPolicy = TypeVar("SelfMADDPGPolicy", bound="MADDPGPolicy")


class MADDPGPolicy(BasePolicy):
    """
    Policy of MADDPG: actors, centralised critics, and the target networks of both.

    :param observation_space: joint observation space
    :param action_space: joint action space, ``Box`` or ``MultiDiscrete``
    :param lr_schedule: learning rate of actors and critics
    :param layout: who sits where in the joint rows; set by the algorithm
    :param agents: the learning agents; set by the algorithm
    :param critic_input: a key of ``CRITIC_INPUTS``; set by the algorithm
    :param net_arch: hidden sizes of both kinds, or ``dict(pi=[…], qf=[…])``; Table 1: 64 (two layers, as MADDPG has)
    :param activation_fn: activation between layers
    :param n_critics: critics per agent
    :param share_parameters: one actor and one critic per group instead of per agent
    :param optimizer_class: optimiser of actors and of critics
    :param optimizer_kwargs: its arguments, without the learning rate; Adam is fused by default (several times faster)
    """

    actor: StackedActors
    actor_target: StackedActors
    critic: StackedCritics | OwnObservationCritics
    critic_target: StackedCritics | OwnObservationCritics

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        layout: AgentLayout,
        agents: Sequence[int],
        critic_input: str = "observations",
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 1,
        share_parameters: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        require_count("n_critics", n_critics)
        if optimizer_kwargs is None:
            optimizer_kwargs = {"fused": True} if optimizer_class is th.optim.Adam else {}
        super().__init__(
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=not layout.discrete,
        )
        self.layout = layout
        self._own_parameters = {
            "layout": layout,
            "agents": list(agents),
            "critic_input": critic_input,
            "net_arch": net_arch,
            "activation_fn": activation_fn,
            "n_critics": n_critics,
            "share_parameters": share_parameters,
            "optimizer_class": optimizer_class,
            "optimizer_kwargs": optimizer_kwargs,
        }
        actor_arch, critic_arch = get_actor_critic_arch([64, 64] if net_arch is None else net_arch)

        def make_actor() -> StackedActors:
            return StackedActors(layout, agents, actor_arch, activation_fn, share_parameters)

        def make_critic() -> StackedCritics | OwnObservationCritics:
            return CRITIC_INPUTS[critic_input](
                layout, agents, critic_input, critic_arch, activation_fn, n_critics, share_parameters
            )

        self.actor, self.actor_target = make_actor(), make_actor()
        self.critic, self.critic_target = make_critic(), make_critic()
        for network, target in ((self.actor, self.actor_target), (self.critic, self.critic_target)):
            target.load_state_dict(network.state_dict())
            target.requires_grad_(False)
            network.optimizer = optimizer_class(network.parameters(), lr=lr_schedule(1), **optimizer_kwargs)  # type: ignore[call-arg]

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic=deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        rows = self.joint_actions(self.actor, observation, explore=not deterministic)
        return self.choices(rows) if self.layout.discrete else rows

    def joint_actions(self, actors: StackedActors, observations: th.Tensor, explore: bool = False) -> th.Tensor:
        """
        The joint action as a critic sees it; zeros for agents that do not learn.

        :param actors: the actors, or their targets
        :param observations: joint rows (batch, joint)
        :param explore: discrete agents draw from their softmax instead of taking its maximum
        :return: (batch, joint action)
        """
        rows = observations.new_zeros(len(observations), sum(self.layout.action_sizes))
        for block, actions in zip(actors.blocks, actors(observations, explore), strict=True):
            block.action_columns.write(rows, actions)
        return rows

    def choices(self, rows: th.Tensor) -> th.Tensor:
        """Joint one-hot rows → the chosen action of each agent, (batch, agents)."""
        return th.stack([rows[:, columns].argmax(-1) for columns in self.layout.action_slices], dim=1)

    def encode(self, actions: th.Tensor) -> th.Tensor:
        """Stored joint actions → what a critic sees: one-hot for discrete agents, unchanged otherwise."""
        if not self.layout.discrete:
            return actions
        choices = actions.long()
        return th.cat([F.one_hot(choices[:, i], n) for i, n in enumerate(self.layout.action_sizes)], dim=1).float()

    def to_env(self, rows: th.Tensor) -> np.ndarray:
        """Joint actions as a critic sees them → actions of the env."""
        if self.layout.discrete:
            return self.choices(rows).cpu().numpy()
        return self.unscale_action(rows.cpu().numpy())

    def from_env(self, actions: np.ndarray) -> np.ndarray:
        """Actions of the env → what the replay buffer stores: scaled to [-1, 1], or the choices as they are."""
        return actions if self.layout.discrete else self.scale_action(actions)

    def predict_agent(self, agent: str, observation: np.ndarray, deterministic: bool = True) -> np.ndarray:
        """
        Action of one agent from its own observation alone (decentralised execution).

        :param agent: name of a learning agent
        :param observation: its observation (obs,), or a batch (batch, obs)
        :param deterministic: no exploration (discrete agents draw from their softmax otherwise)
        :return: its action in its own action space, (action,) or (batch, action); choices for discrete agents
        """
        index = self.layout.agents.index(agent)
        place = next((i for i, block in enumerate(self.actor.blocks) if index in block.agents), None)
        if place is None:
            raise ValueError(f"{agent!r} is not among the learning agents")
        stack: StackedMLP = self.actor.stacks[place]  # type: ignore[assignment]
        member = self.actor.blocks[place].agents.index(index)
        size = self.layout.obs_sizes[index]
        if np.ndim(observation) not in (1, 2) or np.shape(observation)[-1] != size:
            raise ValueError(f"an observation of {agent!r} has {size} values; got an array of shape {np.shape(observation)}")
        rows = th.as_tensor(np.atleast_2d(observation), dtype=th.float32, device=self.device)
        with th.no_grad():
            number = member if stack.members is None else int(stack.members[member])
            network = slice(number, number + 1)  # of the stack, a view
            output = stack.first(rows.unsqueeze(0), network)  # (1, batch, hidden)
            if stack.member_bias is not None:
                output = output + stack.member_bias[member]
            for layer in stack.rest:
                output = layer(stack.activation(output), network)
            output = output.squeeze(0)
        if self.layout.discrete:
            actions = (output if deterministic else gumbel_perturbed(output)).argmax(-1).cpu().numpy()
        else:
            columns = self.layout.action_slices[index]
            assert isinstance(self.action_space, spaces.Box)
            low, high = self.action_space.low[columns], self.action_space.high[columns]
            actions = low + 0.5 * (np.tanh(output.cpu().numpy()) + 1) * (high - low)
        return actions if np.ndim(observation) > 1 else actions[0]

    def set_training_mode(self, mode: bool) -> None:
        self.actor.train(mode)
        self.critic.train(mode)
        self.training = mode

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(self._own_parameters, lr_schedule=ConstantSchedule(0.0))  # a policy alone does not learn
        return data

    def save(self, path: str | pathlib.Path) -> None:
        """
        Save the policy alone, without optimisers: actors, critics and targets.

        :param path: of the file
        """
        names = inspect.signature(type(self)).parameters
        constructor = {name: value for name, value in self._get_constructor_parameters().items() if name in names}
        write_archive(path, "policy", {"constructor": constructor, "parameters": self.state_dict()})

    @classmethod
    def load(cls: type[SelfMADDPGPolicy], path: str | pathlib.Path, device: th.device | str = "auto") -> SelfMADDPGPolicy:
        """
        Load a policy; nothing of the file is run.

        :param path: of a file of :meth:`save`
        :param device: where it goes
        :raises FileFormatError: if the file is damaged, or none of these
        """
        with open_archive(path, "policy") as archive:
            with refusals(archive, "parameters"):
                parameters = archive.read("parameters")
                n_weights = sum(tensor.numel() for tensor in parameters.values())
            with refusals(archive, "constructor"), at_most(n_weights):
                policy = cls(**archive.read("constructor"))
            with refusals(archive, "parameters"):
                check_network(policy, parameters, "parameters")
                policy.load_state_dict(parameters)
        return policy.to(get_device(device))


def gumbel_perturbed(logits: th.Tensor) -> th.Tensor:
    """Logits plus Gumbel noise, whose argmax is a draw from their softmax."""
    return logits - th.empty_like(logits).exponential_().log()


MlpPolicy = MADDPGPolicy
