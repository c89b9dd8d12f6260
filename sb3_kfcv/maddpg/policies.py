"""Centralised critics of all agents, as stacks, and the policy of MADDPG."""

from __future__ import annotations

import inspect
import pathlib
from collections.abc import Sequence
from typing import Any, ClassVar, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import ConstantSchedule, get_device
from torch import nn

from sb3_kfcv.common.actors import ActorPolicy, Block, StackedActors, by_agent, hidden_sizes, shared_members
from sb3_kfcv.common.adam import LeanAdam
from sb3_kfcv.common.backpropagation import Evaluation
from sb3_kfcv.common.checks import require_count
from sb3_kfcv.common.compiled_backpropagation import OwnInputs
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.stacked_networks import StackedMLP, at_most
from sb3_kfcv.saving.archive import open_archive, write_archive
from sb3_kfcv.saving.parameters import check_network
from sb3_kfcv.saving.saveable import refusals


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
    :param layer_norm: whether a layer norm stands before each activation
    """

    common_input: ClassVar[bool]  # whether the critics of a run read the same
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
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        self.layout = layout
        self.actions_start = layout.state_size if critic_input == "state" else sum(layout.obs_sizes)
        self.input_size = self.actions_start + sum(layout.action_sizes)
        self.blocks = Block.split(layout, agents)
        self.order = ego_order(layout, agents, critic_input) if share_parameters else None  # (agents, input)
        self.positions = self._runs()
        self.n_runs = len(self.positions)
        self.stacks = nn.ModuleList()
        for _ in range(n_critics):
            for run, positions in enumerate(self.positions):
                members = shared_members(layout, [agents[i] for i in positions]) if share_parameters else None
                n_networks = max(members) + 1 if members else len(positions)
                sizes = [self._width(run), *net_arch, 1]
                order = self.order if self.common_input else None
                stack = StackedMLP(n_networks, sizes, activation_fn, self.common_input, members, order, layer_norm)
                self.stacks.append(stack)
        self._places: list[tuple[int, list[int] | None]] = []  # of each block: its run, and its members there, None for all
        for i, block in enumerate(self.blocks):
            run = next(r for r, positions in enumerate(self.positions) if block.positions[0] in positions)
            self._places.append((run, None if block.positions == self.positions[run] else block.positions))
            self.register_buffer(f"_own_rows_{i}", self._own_rows(i, block), persistent=False)
        if self.common_input:
            starts = [(self.actions_start + block.action_columns.index[:, 0]).tolist() for block in self.blocks]
            own_actions = [(block.positions, own) for block, own in zip(self.blocks, starts, strict=True)]
            self._own_inputs = OwnInputs(own_actions, [block.action_size for block in self.blocks])
        self._inputs: list[th.Tensor] = []  # of the latest evaluation
        self._latest_reads: list[th.Tensor] = []  # what each stack reads of them
        # Of the latest evaluation of own actions: the stacks' evaluations, and per block the weights of the own action
        self._moved: list[Evaluation] = []
        self._own_weights: list[th.Tensor] = []

    def _runs(self) -> list[list[int]]:
        """Places among the learning agents of each run's agents."""
        raise NotImplementedError

    def _width(self, run: int) -> int:
        """How many numbers each critic of a run reads."""
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
        """As :meth:`forward`, and remembered for :meth:`ascend`; overwritten by the next evaluation."""
        self._remember(inputs)
        found = [stack.evaluate(read) for stack, read in zip(self.stacks, self._latest_reads, strict=True)]  # type: ignore[operator]
        return self._by_critic(found)

    def regress(self, inputs: th.Tensor, targets: th.Tensor, weights: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Eq. 5: write the gradients of each critic's loss Σ weights · (y − Q)², at inputs that are remembered as by
        :meth:`evaluate`.

        :param inputs: as for :meth:`forward`
        :param targets: y (agents, batch)
        :param weights: of each row in its agent's loss (agents, batch)
        :return: the errors y − Q (critics, agents, batch), and the losses (critics, agents)
        """
        self._remember(inputs)
        found = []
        for i, (stack, read) in enumerate(zip(self.stacks, self._latest_reads, strict=True)):
            own_targets, own_weights = (self._of_run(values, i % self.n_runs).unsqueeze(-1) for values in (targets, weights))
            found.append(stack.regress(read, own_targets, own_weights))  # type: ignore[operator]
        errors, losses = zip(*found, strict=True)
        return self._by_critic(errors), self._by_critic(losses)

    def ascend(self, own_actions: Sequence[th.Tensor], weights: th.Tensor) -> tuple[th.Tensor, list[th.Tensor]]:
        """
        Eq. 6: the losses −Σ weights · Q of each agent's first critic at the latest inputs, with the agent's own action
        replaced and all others as they are, and their gradients at these actions, through critics that stay as they are.

        :param own_actions: per block (agents, batch, action)
        :param weights: of each row in its agent's loss (agents, batch)
        :return: the losses (agents,), and the gradients per block (agents, batch, action)
        :raises RuntimeError: if there are no inputs
        """
        if not self._inputs:
            raise RuntimeError("evaluate the critics before going up their values")
        evaluation = self.stacks[0].evaluation(len(self._inputs[0]))  # type: ignore[operator]
        if self.common_input and evaluation.whole:
            return evaluation.ascend(self._latest_reads[0], self._own_inputs, own_actions, weights)
        losses = -(self.evaluate_own_actions(own_actions) * weights).sum(-1)
        return losses, self.own_action_gradients(-weights)

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
        first = [evaluation.first_layer(read) for evaluation, read in zip(self._moved, self._latest_reads, strict=False)]
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
        return {**self.__dict__, "_inputs": [], "_latest_reads": [], "_moved": [], "_own_weights": []}

    def _remember(self, inputs: th.Tensor) -> None:
        self._inputs[:], self._latest_reads[:] = [inputs], self._reads(inputs)

    def _reads(self, inputs: th.Tensor) -> list[th.Tensor]:
        """What each stack reads."""
        return self._read(inputs) * (len(self.stacks) // self.n_runs)

    def _by_critic(self, values: Sequence[th.Tensor]) -> th.Tensor:
        """Values of each stack (members, …, 1) → (critics, agents, …)."""
        n_runs = self.n_runs
        critics = [by_agent(self.positions, values[i : i + n_runs]).squeeze(-1) for i in range(0, len(values), n_runs)]
        return th.stack(critics) if len(critics) > 1 else critics[0].unsqueeze(0)

    def _of_run(self, values: th.Tensor, run: int) -> th.Tensor:
        """(agents, …) → those of a run."""
        return values if self.n_runs == 1 else values[self.positions[run]]

    def network(self, position: int, critic: int = 0) -> nn.Sequential:
        """One critic as separate layers (a copy); ``position`` counts the learning agents."""
        for run, positions in enumerate(self.positions):
            if position in positions:
                return self.stacks[critic * len(self.positions) + run].network(positions.index(position))  # type: ignore[operator]
        raise ValueError(f"there is no learning agent {position}")


class StackedCritics(CentralCritics):
    """
    Q_i(s, a_1 … a_N) with s the observations of all agents, or the world's state: all read the same joint input, and the
    first layers of all are one product.
    """

    common_input = True

    def _runs(self) -> list[list[int]]:
        return [sorted(position for block in self.blocks for position in block.positions)]

    def _width(self, run: int) -> int:
        return self.input_size

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

    common_input = False

    def _runs(self) -> list[list[int]]:
        for i, block in enumerate(self.blocks):
            order = (
                None if self.order is None else self.order[block.positions]
            )  # (agents, input): the input that takes each action
            self.register_buffer(f"_read_order_{i}", None if order is None else order.argsort(1).flatten(), persistent=False)
        return [block.positions for block in self.blocks]

    def _width(self, run: int) -> int:
        return self.blocks[run].obs_size + sum(self.layout.action_sizes)

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


class MADDPGPolicy(ActorPolicy):
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
    :param layer_norm: put a layer norm, as of ``torch.nn.LayerNorm``, before each activation of actors and critics
    :param optimizer_class: optimiser of actors and of critics
    :param optimizer_kwargs: its arguments, without the learning rate; Adam is fused (several times faster) unless they say
        otherwise
    """

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
        layer_norm: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        require_count("n_critics", n_critics)
        optimizer_kwargs = optimizer_kwargs or {}
        if optimizer_class is th.optim.Adam and not {"fused", "foreach", "differentiable"} & optimizer_kwargs.keys():
            optimizer_kwargs = {"fused": True, **optimizer_kwargs}
        actor_arch, critic_arch = hidden_sizes(net_arch)
        super().__init__(
            observation_space,
            action_space,
            layout,
            agents,
            actor_arch,
            activation_fn,
            share_parameters,
            layer_norm,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )
        self._own_parameters = {
            "layout": layout,
            "agents": list(agents),
            "critic_input": critic_input,
            "net_arch": net_arch,
            "activation_fn": activation_fn,
            "n_critics": n_critics,
            "share_parameters": share_parameters,
            "layer_norm": layer_norm,
            "optimizer_class": optimizer_class,
            "optimizer_kwargs": optimizer_kwargs,
        }

        def make_critic() -> CentralCritics:
            return CRITIC_INPUTS[critic_input](
                layout, agents, critic_input, critic_arch, activation_fn, n_critics, share_parameters, layer_norm
            )

        self.actor_target = self.make_actor()
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

    def learning_networks(self) -> list[StackedActors | CentralCritics]:
        return [self.actor, self.critic]

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


MlpPolicy = MADDPGPolicy
