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

from sb3_kfcv.common.adam import LeanAdam
from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.stacked_networks import Evaluation, StackedMLP, at_most
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
        self.positions = list(positions)
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


def by_agent(positions: Sequence[Sequence[int]], values: Sequence[th.Tensor]) -> th.Tensor:
    """
    Values of several runs of agents, (agents of the run, …) each, in the order of all learning agents: (agents, …).

    :param positions: places of each run's agents among the learning agents
    :param values: of each run
    """
    if len(values) == 1:
        return values[0]
    order = [position for run in positions for position in run]
    return th.cat(list(values))[th.tensor(order).argsort()]


class _Columns:
    """Equal-sized column ranges of a joint row, read and written as (agents, batch, size); a view where they adjoin."""

    def __init__(self, slices: Sequence[slice]) -> None:
        self.count, self.size = len(slices), slices[0].stop - slices[0].start
        self.index = th.tensor([list(range(s.start, s.stop)) for s in slices])  # (agents, size)
        flat = self.index.flatten()
        adjoin = bool((flat == th.arange(len(flat)) + flat[0]).all())
        self.range: slice | th.Tensor = slice(int(flat[0]), int(flat[-1]) + 1) if adjoin else flat

    def read(self, rows: th.Tensor) -> th.Tensor:
        """(batch, joint) → (agents, batch, size)."""
        return rows[:, self.range].view(len(rows), self.count, self.size).transpose(0, 1)

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
        self._latest: list[tuple[th.Tensor, th.Tensor]] = []  # per block: outputs and actions of the latest evaluation

    def forward(self, observations: th.Tensor, explore: bool = False, learning: bool = False) -> list[th.Tensor]:
        """
        The actions as a critic sees them; the choice of a discrete agent has no gradient.

        :param observations: joint rows (batch, joint)
        :param explore: discrete agents draw from their softmax instead of taking its maximum
        :param learning: within an update: work in tensors that are used again
        :return: per block (agents, batch, action)
        """
        outputs = self._outputs(observations, learning)
        if not self.layout.discrete:
            return [th.tanh(output) for output in outputs]
        if explore:
            outputs = [gumbel_perturbed(logits) for logits in outputs]
        return [F.one_hot(logits.argmax(-1), logits.shape[-1]).to(logits.dtype) for logits in outputs]

    def evaluate(self, observations: th.Tensor, temperature: float) -> list[th.Tensor]:
        """
        Actions that :meth:`backward` can follow: as they are, or by straight-through Gumbel-softmax for discrete agents.

        :param observations: joint rows (batch, joint)
        :param temperature: of the Gumbel-softmax
        :return: per block (agents, batch, action)
        """
        outputs = self._outputs(observations, learning=True)
        if not self.layout.discrete:
            actions = [th.tanh(output) for output in outputs]
        else:
            with th.enable_grad():
                outputs = [logits.detach().requires_grad_() for logits in outputs]
                actions = [F.gumbel_softmax(logits, tau=temperature, hard=True) for logits in outputs]
        self._latest[:] = zip(outputs, actions, strict=True)
        return [own.detach() for own in actions] if self.layout.discrete else actions

    def backward(self, gradients: Sequence[th.Tensor], penalties: th.Tensor | None = None) -> None:
        """
        Write the gradients of the parameters, from the latest :meth:`evaluate`.

        :param gradients: of the loss, at its actions; per block (agents, batch, action)
        :param penalties: weight in the loss of each row's mean squared output before the tanh or the choice, (agents, batch)
        """
        for stack, block, (output, actions), gradient in zip(self.stacks, self.blocks, self._latest, gradients, strict=True):
            if self.layout.discrete:
                (at_output,) = th.autograd.grad(actions, output, gradient)
                output = output.detach()
            else:
                at_output = th.ops.aten.tanh_backward(gradient, actions)
            if penalties is not None:
                at_output = at_output.addcmul_(output, penalties[block.positions].unsqueeze(-1), value=2 / output.shape[-1])
            stack.backward(at_output)  # type: ignore[operator]

    def __getstate__(self) -> dict[str, Any]:
        """What the latest evaluation left is not copied."""
        return {**self.__dict__, "_latest": []}

    def _outputs(self, observations: th.Tensor, learning: bool) -> list[th.Tensor]:
        """What the last layers give, per block (agents, batch, action)."""
        return [
            (stack.evaluate if learning else stack)(block.obs_columns.read(observations))  # type: ignore[operator]
            for stack, block in zip(self.stacks, self.blocks, strict=True)
        ]

    def network(self, agent: int) -> nn.Sequential:
        """The network of one agent, as separate ``nn.Linear`` layers (a copy; its last layer is linear)."""
        for stack, block in zip(self.stacks, self.blocks, strict=True):
            if agent in block.agents:
                return stack.network(block.agents.index(agent))  # type: ignore[operator]
        raise ValueError(f"{self.layout.agents[agent]!r} is not among the learning agents")


class CentralCritics(nn.Module):
    """
    The learning agents' critics Q_i, which see all actions a_1 … a_N beside what their kind sees of the world.

    Agents whose critics stack are a *run*; its critics are :attr:`stacks`, critic after critic, run after run.

    :param layout: who sits where in the joint rows
    :param agents: the learning agents
    :param critic_input: a key of ``CRITIC_INPUTS``; in the inputs the joint action comes after it
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
        self.layout = layout
        self.actions_start = layout.state_size if critic_input == "state" else sum(layout.obs_sizes)
        self.input_size = self.actions_start + sum(layout.action_sizes)
        self.blocks = Block.split(layout, agents)
        self.order = ego_order(layout, agents, critic_input) if share_parameters else None  # (agents, input)
        self.positions = self._runs()
        self.stacks = nn.ModuleList()
        for _ in range(n_critics):
            for run, positions in enumerate(self.positions):
                members = shared_members(layout, [agents[i] for i in positions]) if share_parameters else None
                n_networks = max(members) + 1 if members else len(positions)
                self.stacks.append(self._stack(run, n_networks, net_arch, activation_fn, members))
        self._places: list[tuple[int, list[int] | None]] = []  # of each block: its run, and its members there, None for all
        for i, block in enumerate(self.blocks):
            run = next(r for r, positions in enumerate(self.positions) if block.positions[0] in positions)
            self._places.append((run, None if block.positions == self.positions[run] else block.positions))
            self.register_buffer(f"_own_rows_{i}", self._own_rows(i, block), persistent=False)
        self._inputs: list[th.Tensor] = []  # of the latest evaluation
        # Of the latest evaluation of own actions: the stacks' evaluations, and per block the weights of the own action
        self._moved: list[Evaluation] = []
        self._own_weights: list[th.Tensor] = []

    def _runs(self) -> list[list[int]]:
        """Places among the learning agents of each run's agents."""
        raise NotImplementedError

    def _stack(
        self, run: int, n_networks: int, net_arch: list[int], activation_fn: type[nn.Module], members: list[int] | None
    ) -> StackedMLP:
        """The critics of a run."""
        raise NotImplementedError

    def _read(self, inputs: th.Tensor) -> list[th.Tensor]:
        """What the stacks of each run read."""
        raise NotImplementedError

    def _own_rows(self, i: int, block: Block) -> th.Tensor:
        """Where the weights of a block's own actions stand, see :meth:`StackedMLP.first_layer_rows`."""
        raise NotImplementedError

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        """
        :param inputs: (batch, observations or state, then joint action)
        :return: Q-values (critics, agents, batch)
        """
        return self._by_critic([stack(read) for stack, read in zip(self.stacks, self._reads(inputs), strict=True)])

    def evaluate(self, inputs: th.Tensor) -> th.Tensor:
        """As :meth:`forward`, and remembered for :meth:`backward`; overwritten by the next evaluation."""
        self._inputs[:] = [inputs]
        reads = self._reads(inputs)
        return self._by_critic([stack.evaluate(read) for stack, read in zip(self.stacks, reads, strict=True)])  # type: ignore[operator]

    def backward(self, gradients: th.Tensor) -> None:
        """
        Write the gradients of the parameters, from the latest :meth:`evaluate`.

        :param gradients: of the loss, at its Q-values (critics, agents, batch)
        """
        for i, stack in enumerate(self.stacks):
            critic, run = divmod(i, len(self.positions))
            stack.backward(self._of_run(gradients[critic], run).unsqueeze(-1))  # type: ignore[operator]

    def evaluate_own_actions(self, own_actions: Sequence[th.Tensor]) -> th.Tensor:
        """
        Q_i of each agent's first critic at the inputs of the latest :meth:`evaluate`, with the agent's own action replaced and
        all others as they are (eq. 6).

        The first layer is computed as for the minibatch; an agent's new action moves its pre-activation by
        (new − old) · (its own action's weights).

        :param own_actions: per block (agents, batch, action)
        :return: (agents, batch)
        """
        (inputs,) = self._inputs
        self._moved[:] = [stack.evaluation(len(inputs)) for stack, _ in zip(self.stacks, self.positions, strict=False)]  # type: ignore[operator]
        self._own_weights[:] = [
            self._moved[run].first_weights(getattr(self, f"_own_rows_{i}")) for i, (run, _) in enumerate(self._places)
        ]
        first = [evaluation.first_layer(evaluation.x) for evaluation in self._moved]
        actions = inputs[:, self.actions_start :]
        for (run, members), weights, block, new in zip(self._places, self._own_weights, self.blocks, own_actions, strict=True):
            moved = new - block.action_columns.read(actions)
            if members is None:
                first[run].baddbmm_(moved, weights)
            else:
                first[run][members] += th.bmm(moved, weights)
        return by_agent(self.positions, [evaluation.rest().squeeze(-1) for evaluation in self._moved])

    def own_action_gradients(self, gradients: th.Tensor) -> list[th.Tensor]:
        """
        ∇_a of a loss of the Q-values of the latest :meth:`evaluate_own_actions`, through critics that stay as they are.

        :param gradients: of the loss, at these Q-values (agents, batch)
        :return: per block (agents, batch, action)
        """
        first = [
            evaluation.backward(self._of_run(gradients, run).unsqueeze(-1), parameters=False)
            for run, evaluation in enumerate(self._moved)
        ]
        return [
            th.bmm(first[run] if members is None else first[run][members], weights.transpose(1, 2))
            for (run, members), weights in zip(self._places, self._own_weights, strict=True)
        ]

    def __getstate__(self) -> dict[str, Any]:
        """What the latest evaluation left is not copied."""
        return {**self.__dict__, "_inputs": [], "_moved": [], "_own_weights": []}

    def _reads(self, inputs: th.Tensor) -> list[th.Tensor]:
        """What each stack reads."""
        return self._read(inputs) * (len(self.stacks) // len(self.positions))

    def _by_critic(self, values: list[th.Tensor]) -> th.Tensor:
        """Values of each stack (members, batch, 1) → (critics, agents, batch)."""
        n_runs = len(self.positions)
        critics = [by_agent(self.positions, values[i : i + n_runs]) for i in range(0, len(values), n_runs)]
        return (th.stack(critics) if len(critics) > 1 else critics[0].unsqueeze(0)).squeeze(-1)

    def _of_run(self, values: th.Tensor, run: int) -> th.Tensor:
        """(agents, …) → those of a run."""
        return values if len(self.positions) == 1 else values[self.positions[run]]

    def network(self, position: int, critic: int = 0) -> nn.Sequential:
        """One critic as separate ``nn.Linear`` layers (a copy); ``position`` counts the learning agents."""
        for run, positions in enumerate(self.positions):
            if position in positions:
                return self.stacks[critic * len(self.positions) + run].network(positions.index(position))  # type: ignore[operator]
        raise ValueError(f"there is no learning agent {position}")


class StackedCritics(CentralCritics):
    """
    Q_i(s, a_1 … a_N) with s the observations of all agents, or the world's state: all read the same joint input, and the
    first layers of all are one product.
    """

    def _runs(self) -> list[list[int]]:
        return [sorted(position for block in self.blocks for position in block.positions)]

    def _stack(
        self, run: int, n_networks: int, net_arch: list[int], activation_fn: type[nn.Module], members: list[int] | None
    ) -> StackedMLP:
        sizes = [self.input_size, *net_arch, 1]
        return StackedMLP(n_networks, sizes, activation_fn, common_input=True, members=members, input_order=self.order)

    def _read(self, inputs: th.Tensor) -> list[th.Tensor]:
        return [inputs.unsqueeze(0)]

    def _own_rows(self, i: int, block: Block) -> th.Tensor:
        return self.stacks[0].first_layer_rows(block.positions, self.actions_start + block.action_columns.index)  # type: ignore[operator]


class OwnObservationCritics(CentralCritics):
    """
    Q_i(o_i, a_1 … a_N): the agent's own observation and all actions. Where the agent sees the whole world from its own
    place, nothing is lost, the input is many times smaller than all observations together, and what counts (how far is the
    nearest sheep?) need not be worked out from absolute positions. The inputs are all observations, then the joint action.
    """

    def _runs(self) -> list[list[int]]:
        for i, block in enumerate(self.blocks):
            order = (
                None if self.order is None else self.order[block.positions]
            )  # (agents, input): the input that takes each action
            self.register_buffer(f"_read_order_{i}", None if order is None else order.argsort(1).flatten(), persistent=False)
        return [block.positions for block in self.blocks]

    def _stack(
        self, run: int, n_networks: int, net_arch: list[int], activation_fn: type[nn.Module], members: list[int] | None
    ) -> StackedMLP:
        sizes = [self.blocks[run].obs_size + sum(self.layout.action_sizes), *net_arch, 1]
        return StackedMLP(n_networks, sizes, activation_fn, members=members)

    def _read(self, inputs: th.Tensor) -> list[th.Tensor]:
        """The own observation, then all actions in the order in which each agent reads them: (agents, batch, input)."""
        read = []
        for i, block in enumerate(self.blocks):
            actions, order = inputs[:, self.actions_start :], getattr(self, f"_read_order_{i}")
            if order is None:
                actions = actions.expand(len(block.agents), -1, -1)
            else:
                actions = actions.index_select(1, order).unflatten(1, (len(block.agents), -1)).transpose(0, 1)
            read.append(th.cat([block.obs_columns.read(inputs), actions], dim=-1))
        return read

    def _own_rows(self, i: int, block: Block) -> th.Tensor:
        own = block.action_columns.index
        if self.order is not None:
            own = self.order[block.positions].gather(1, own)
        return self.stacks[i].first_layer_rows(range(len(block.agents)), block.obs_size + own)  # type: ignore[operator]


CRITIC_INPUTS: dict[str, type[CentralCritics]] = {
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
    critic: CentralCritics
    critic_target: CentralCritics

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

        def make_critic() -> CentralCritics:
            return CRITIC_INPUTS[critic_input](
                layout, agents, critic_input, critic_arch, activation_fn, n_critics, share_parameters
            )

        self.actor, self.actor_target = make_actor(), make_actor()
        self.critic, self.critic_target = make_critic(), make_critic()
        for network, target in ((self.actor, self.actor_target), (self.critic, self.critic_target)):
            target.load_state_dict(network.state_dict())
            target.requires_grad_(False)
            target.train(False)
            for target_stack, stack in zip(target.stacks, network.stacks, strict=True):
                target_stack.borrow(stack)  # type: ignore[operator]
            fused = optimizer_class is th.optim.Adam and optimizer_kwargs.get("fused")
            fastest = LeanAdam if fused else optimizer_class
            network.optimizer = fastest(network.parameters(), lr=lr_schedule(1), **optimizer_kwargs)  # type: ignore[call-arg]

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic=deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        rows = self.joint_actions(self.actor, observation, explore=not deterministic)
        return self.choices(rows) if self.layout.discrete else rows

    def joint_actions(
        self, actors: StackedActors, observations: th.Tensor, explore: bool = False, learning: bool = False
    ) -> th.Tensor:
        """
        The joint action as a critic sees it; zeros for agents that do not learn.

        :param actors: the actors, or their targets
        :param observations: joint rows (batch, joint)
        :param explore: discrete agents draw from their softmax instead of taking its maximum
        :param learning: see :meth:`StackedActors.forward`
        :return: (batch, joint action)
        """
        chosen = actors(observations, explore, learning)
        if len(actors.blocks) == 1 and len(actors.blocks[0].agents) == self.layout.n_agents:
            return chosen[0].transpose(0, 1).flatten(1)
        rows = observations.new_zeros(len(observations), sum(self.layout.action_sizes))
        for block, actions in zip(actors.blocks, chosen, strict=True):
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
        self.set_training_mode(False)
        with th.no_grad():
            output = stack.one(member, rows)
        if self.layout.discrete:
            actions = (output if deterministic else gumbel_perturbed(output)).argmax(-1).cpu().numpy()
        else:
            columns = self.layout.action_slices[index]
            assert isinstance(self.action_space, spaces.Box)
            low, high = self.action_space.low[columns], self.action_space.high[columns]
            actions = low + 0.5 * (np.tanh(output.cpu().numpy()) + 1) * (high - low)
        return actions if np.ndim(observation) > 1 else actions[0]

    def set_training_mode(self, mode: bool) -> None:
        """Nothing in a stack but an activation (a dropout, say) can depend on it."""
        if mode != self.training:
            self.training = mode
            for network in (self.actor, self.critic):
                for stack in network.stacks:
                    stack.activation.train(mode)  # type: ignore[union-attr]

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
