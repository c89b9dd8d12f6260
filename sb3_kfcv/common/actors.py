"""What acts: the actors of agents, stacked, and the policy that plays them, of a learner or of a saved model."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import get_device
from torch import nn
from torch.nn import functional as F

from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.common.stacked_networks import StackedMLP, at_most
from sb3_kfcv.saving.archive import Archive, open_archive, write_archive
from sb3_kfcv.saving.attributes import check_spaces
from sb3_kfcv.saving.parameters import check_network
from sb3_kfcv.saving.values import register_kind


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
        return rows[:, self.range].view(rows.shape[0], self.count, self.size).transpose(0, 1)

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
    :param layer_norm: whether a layer norm stands before each activation
    """

    optimizer: th.optim.Optimizer

    def __init__(
        self,
        layout: AgentLayout,
        agents: Sequence[int],
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        share_parameters: bool = False,
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        self.layout = layout
        self.blocks = Block.split(layout, agents)
        self.stacks = nn.ModuleList()
        for block in self.blocks:
            members = shared_members(layout, block.agents) if share_parameters else None
            n_networks = max(members) + 1 if members else len(block.agents)
            sizes = [block.obs_size, *net_arch, block.action_size]
            self.stacks.append(StackedMLP(n_networks, sizes, activation_fn, members=members, layer_norm=layer_norm))
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
                at_output = _tanh_backward(gradient, actions)
            if penalties is not None:
                at_output = at_output.addcmul_(output, penalties[block.positions].unsqueeze(-1), value=2 / output.shape[-1])
            stack.backward(at_output)  # type: ignore[operator]

    def __getstate__(self) -> dict[str, Any]:
        """What the latest evaluation left is not copied."""
        return {**self.__dict__, "_latest": []}

    def _outputs(self, observations: th.Tensor, learning: bool) -> list[th.Tensor]:
        """What the last layers give, per block (agents, batch, action)."""
        return [
            (stack.evaluate if learning else stack.values)(block.obs_columns.read(observations))  # type: ignore[operator]
            for stack, block in zip(self.stacks, self.blocks, strict=True)
        ]

    def network(self, agent: int) -> nn.Sequential:
        """The network of one agent, as separate layers (a copy; its last layer is linear)."""
        for stack, block in zip(self.stacks, self.blocks, strict=True):
            if agent in block.agents:
                return stack.network(block.agents.index(agent))  # type: ignore[operator]
        raise ValueError(f"{self.layout.agents[agent]!r} is not among the learning agents")


_tanh_backward = th.ops.aten.tanh_backward.default


def shared_members(layout: AgentLayout, agents: Sequence[int]) -> list[int]:
    """Which network each agent uses when one network serves a group: 0 for the first group met, 1 for the next, …"""
    groups = list(dict.fromkeys(layout.groups[i] for i in agents))
    return [groups.index(layout.groups[i]) for i in agents]


def gumbel_perturbed(logits: th.Tensor) -> th.Tensor:
    """Logits plus Gumbel noise, whose argmax is a draw from their softmax."""
    return logits - th.empty_like(logits).exponential_().log()


def hidden_sizes(net_arch: list[int] | dict[str, list[int]] | None) -> tuple[list[int], list[int]]:
    """
    Hidden sizes of actors and of critics.

    :param net_arch: of both, or ``dict(pi=[…], qf=[…])``; by default two layers of 64 (Table 1)
    """
    return get_actor_critic_arch([64, 64] if net_arch is None else net_arch)


def actor_settings(policy_kwargs: Mapping[str, Any], share_parameters: bool) -> dict[str, Any]:
    """
    What the actors of a model are made of, as arguments of :class:`ActorPolicy`.

    :param policy_kwargs: of the model
    :param share_parameters: one network per group of agents instead of one per agent
    """
    return {
        "net_arch": list(hidden_sizes(policy_kwargs.get("net_arch"))[0]),
        "activation_fn": policy_kwargs.get("activation_fn", nn.ReLU),
        "share_parameters": share_parameters,
        "layer_norm": policy_kwargs.get("layer_norm", False),
    }


class ActorPolicy(BasePolicy):
    """
    The actors of some agents, ready to play: ``predict`` takes joint rows and gives joint actions, in which the columns of
    all other agents are 0. This is what is left of a model where it does not learn, see :meth:`of`.

    :param observation_space: joint observation space
    :param action_space: joint action space, ``Box`` or ``MultiDiscrete``
    :param layout: who sits where in the joint rows
    :param agents: the agents that it plays
    :param net_arch: hidden sizes
    :param activation_fn: activation between layers
    :param share_parameters: one network per group of agents instead of one per agent
    :param layer_norm: whether a layer norm stands before each activation
    :param kwargs: for SB3's ``BasePolicy``
    """

    actor: StackedActors

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        layout: AgentLayout,
        agents: Sequence[int],
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        share_parameters: bool = False,
        layer_norm: bool = False,
        **kwargs: Any,
    ) -> None:
        super().__init__(observation_space, action_space, squash_output=not layout.discrete, **kwargs)
        self.layout = layout
        self.agents = list(agents)
        self._actor_parameters: dict[str, Any] = {
            "net_arch": list(net_arch),
            "activation_fn": activation_fn,
            "share_parameters": share_parameters,
            "layer_norm": layer_norm,
        }
        self.actor = self.make_actor()

    def make_actor(self) -> StackedActors:
        """New actors of these shapes."""
        return StackedActors(self.layout, self.agents, **self._actor_parameters)

    @staticmethod
    def of(policy: ActorPolicy) -> ActorPolicy:
        """A policy's actors as they are now, alone: a copy that no training moves."""
        fields = _fields(policy)
        parameters = fields.pop("parameters")
        return _frozen(_without_drawing(fields), parameters).to(policy.device)

    def learning_networks(self) -> list[Any]:
        """Those that a training mode is for; targets have none."""
        return [self.actor]

    def set_training_mode(self, mode: bool) -> None:
        """Nothing in a stack but an activation (a dropout, say) can depend on it."""
        if mode != self.training:
            self.training = mode
            for network in self.learning_networks():
                for stack in network.stacks:
                    stack.activation.train(mode)

    def save(self, path: str | pathlib.Path) -> None:
        """
        Save the actors alone: a small part of the model, and enough to play.

        :param path: of the file
        """
        write_archive(path, "player", {"player": ActorPolicy.of(self)})

    @classmethod
    def load(cls, path: str | pathlib.Path, device: th.device | str = "auto") -> Any:
        """
        Load actors; nothing of the file is run.

        :param path: of a file of :meth:`save`
        :param device: where they go
        :raises FileFormatError: if the file is damaged, or none of these
        """
        with open_archive(path, "player") as archive:
            return player_in(archive).to(get_device(device))

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
            output = stack.values(rows, member)
        if self.layout.discrete:
            actions = (output if deterministic else gumbel_perturbed(output)).argmax(-1).cpu().numpy()
        else:
            columns = self.layout.action_slices[index]
            assert isinstance(self.action_space, spaces.Box)
            low, high = self.action_space.low[columns], self.action_space.high[columns]
            actions = low + 0.5 * (np.tanh(output.cpu().numpy()) + 1) * (high - low)
        return actions if np.ndim(observation) > 1 else actions[0]

    def greedy_rows(self, observations: th.Tensor) -> th.Tensor:
        """Greedy actions as a critic sees them; zeros for agents that it does not play: (batch, joint action)."""
        with th.no_grad():
            return self.joint_actions(self.actor, observations.to(self.device)).to(observations.device)


def _fields(policy: ActorPolicy) -> dict[str, Any]:
    names = ("observation_space", "action_space", "layout", "agents")
    return {
        **{name: getattr(policy, name) for name in names},
        **policy._actor_parameters,
        "parameters": dict(policy.actor.state_dict()),
    }


def make_player(parameters: dict[str, th.Tensor], **fields: Any) -> ActorPolicy:
    """
    Actors from a file, checked.

    :param parameters: of the actors
    :param fields: arguments of :class:`ActorPolicy`
    :raises ValueError: names what is not as it must be
    """
    layout, agents, net_arch = fields["layout"], fields["agents"], fields["net_arch"]
    check_spaces(layout, fields["observation_space"], fields["action_space"])
    if not agents or agents != sorted(set(agents) & set(range(layout.n_agents))):
        raise ValueError(f"a player of the agents {agents!r} of {layout.n_agents}")
    if type(net_arch) is not list or any(type(size) is not int or size < 1 for size in net_arch):
        raise ValueError(f"net_arch is {net_arch!r}")
    if not (isinstance(fields["activation_fn"], type) and issubclass(fields["activation_fn"], nn.Module)):
        raise ValueError(f"activation_fn is {fields['activation_fn']!r}")
    if type(fields["share_parameters"]) is not bool:
        raise ValueError(f"share_parameters is yes or no, not {fields['share_parameters']!r}")
    if type(parameters) is not dict or not all(isinstance(tensor, th.Tensor) for tensor in parameters.values()):
        raise ValueError("the parameters of a player are tensors by name")
    with at_most(sum(tensor.numel() for tensor in parameters.values())):
        policy = _without_drawing(fields)
    check_network(policy.actor, parameters, "parameters")
    return _frozen(policy, parameters)


def _without_drawing(fields: dict[str, Any]) -> ActorPolicy:
    """Actors whose first parameters are of no use: the program's random generator, which a training goes on with, stays."""
    with th.random.fork_rng(devices=[]):
        return ActorPolicy(**fields)


def _frozen(policy: ActorPolicy, parameters: Mapping[str, th.Tensor]) -> ActorPolicy:
    """The policy with these parameters, which no training moves."""
    policy.actor.load_state_dict(parameters)
    policy.actor.requires_grad_(False)
    policy.set_training_mode(False)
    return policy


def player_in(archive: Archive) -> ActorPolicy:
    """
    The actors in an open player file.

    :raises FileFormatError: if there are none
    """
    player = archive.read("player")
    if not isinstance(player, ActorPolicy):
        archive.refuse("holds no player")
    return player


register_kind("ActorPolicy", ActorPolicy, _fields, make_player)
