"""One update of MADDPG (eq. 5–6) against a slow version: one agent after the other, plain autograd, plain Adam."""

import copy

import numpy as np
import pytest
import torch as th
from references import fill, one_hot_networks, parameters_of, with_one_hot
from stable_baselines3 import DDPG
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn
from torch.nn import functional as F
from toy_envs import ToyParallelEnv

from sb3_kfcv import MADDPG, JointEnv

BATCH = 16


def make_model(toy=None, **kwargs):
    """A model of the toy world with a filled buffer."""
    kwargs.setdefault("policy_kwargs", {"net_arch": [8, 7]})
    model = MADDPG(
        "MlpPolicy", JointEnv(ToyParallelEnv(**(toy or {}))), buffer_size=64, batch_size=BATCH, seed=1, device="cpu", **kwargs
    )
    model.set_logger(configure(None, []))
    fill(model.replay_buffer, model.layout, 64, death_rate=0.1, alive_rate=0.8, join_rate=0.3)
    return model


def in_double(batch):
    return batch._replace(**{k: v.double() for k, v in batch._asdict().items() if isinstance(v, th.Tensor)})


def serve(model, batches):
    """Let the model draw the given minibatches, one per update."""
    queue = iter(batches)
    model.replay_buffer.sample = lambda *args, **kwargs: next(queue)


def draw(model, n):
    return [model.replay_buffer.sample(BATCH) for _ in range(n)]


class SlowMADDPG:
    """
    N agents, each with networks of its own and its own Adam, updated one after the other.

    :param model: whose networks and settings to start from
    """

    def __init__(self, model):
        self.model, self.layout = model, model.layout
        self.n_updates = 0
        n_critics = (model.policy_kwargs or {}).get("n_critics", 1)
        self.agents = model.agents  # those that learn; the others stand still
        self.nets = {
            "actor": {v: model.actor.network(v) for v in self.agents},
            "actor_target": {v: model.actor_target.network(v) for v in self.agents},
            "critic": {v: self.critics_in(model.critic, v, n_critics) for v in self.agents},
            "critic_target": {v: self.critics_in(model.critic_target, v, n_critics) for v in self.agents},
        }
        dtype = next(model.policy.parameters()).dtype
        for net in self.all_nets():
            net.to(dtype)
        lr = model.lr_schedule(1)
        self.actor_adams = {v: th.optim.Adam(net.parameters(), lr=lr) for v, net in self.nets["actor"].items()}
        self.critic_adams = {
            v: th.optim.Adam([p for net in nets for p in net.parameters()], lr=lr) for v, nets in self.nets["critic"].items()
        }

    def critics_in(self, critics, agent, n_critics):
        return [critics.network(self.agents.index(agent), c) for c in range(n_critics)]

    def all_nets(self):
        for kind in ("actor", "actor_target"):
            yield from self.nets[kind].values()
        for kind in ("critic", "critic_target"):
            for nets in self.nets[kind].values():
                yield from nets

    def encode(self, actions):
        if not self.layout.discrete:
            return actions
        return th.cat(
            [F.one_hot(actions[:, i].long(), n).to(actions.dtype) for i, n in enumerate(self.layout.action_sizes)], dim=1
        )

    def best_action(self, kind, agent, observations):
        if agent not in self.agents:
            return observations.new_zeros(len(observations), self.layout.action_sizes[agent])
        output = self.nets[kind][agent](observations[:, self.layout.obs_slices[agent]])
        if self.layout.discrete:
            return F.one_hot(output.argmax(-1), output.shape[-1]).to(output.dtype)
        return th.tanh(output)

    def without_the_dead(self, actions, alive):
        actions = actions.clone()
        for agent, columns in enumerate(self.layout.action_slices):
            actions[:, columns] = actions[:, columns] * alive[:, agent : agent + 1]
        return actions

    def update(self, batch):
        model, layout = self.model, self.layout
        self.n_updates += 1
        actions = self.without_the_dead(self.encode(batch.actions), batch.alive)
        # Before anything moves: the learner draws the discrete actors' Gumbel noise for all agents of a shape at once.
        noise = self.gumbel_noise(batch) if layout.discrete and self.n_updates % model.policy_delay == 0 else None
        for v in self.agents:
            seen = self.seen_by(v, batch.observations, batch.states)
            next_seen = self.seen_by(v, batch.next_observations, batch.next_states)
            alive, gone = batch.alive[:, v], batch.dones[:, v]
            n_alive = alive.sum().clamp(min=1)
            with th.no_grad():
                next_actions = th.cat(
                    [self.best_action("actor_target", i, batch.next_observations) for i in range(layout.n_agents)], dim=1
                )
                next_actions = self.without_the_dead(next_actions, 1 - batch.dones)
                next_input = th.cat([next_seen, next_actions], dim=1)
                next_q = th.cat([net(next_input) for net in self.nets["critic_target"][v]], dim=1).min(dim=1).values
                y = model.reward_scale * batch.rewards[:, v] + model.gamma * (1 - gone) * next_q
            loss = sum(
                (batch.weights * alive * (y - net(th.cat([seen, actions], dim=1)).squeeze(1)) ** 2).sum() / n_alive
                for net in self.nets["critic"][v]
            )
            self.minimise(loss, self.critic_adams[v], self.nets["critic"][v])
            if self.n_updates % model.policy_delay:
                continue
            output = self.nets["actor"][v](batch.observations[:, layout.obs_slices[v]])
            if layout.discrete:
                soft = ((output + noise[v]) / model.gumbel_temperature).softmax(-1)
                hard = F.one_hot(soft.argmax(-1), soft.shape[-1]).to(soft.dtype)
                own = hard - soft.detach() + soft
            else:
                own = th.tanh(output)
            columns = layout.action_slices[v]
            mixed = th.cat([seen, actions[:, : columns.start], own, actions[:, columns.stop :]], dim=1)
            gain = (alive * self.nets["critic"][v][0](mixed).squeeze(1)).sum() / n_alive
            self.minimise(-gain, self.actor_adams[v], [self.nets["actor"][v]])
        if self.n_updates % model.policy_delay == 0:
            self.move_targets()

    def seen_by(self, agent, observations, states):
        """What an agent's critic sees beside the actions."""
        own = observations[:, self.layout.obs_slices[agent]]
        return {"observations": observations, "state": states, "own_observation": own}[self.model.critic_input]

    def gumbel_noise(self, batch):
        """Per agent (batch, choices): the same draws as the learner's, given the same seed."""
        state = th.get_rng_state()
        dtype = batch.rewards.dtype
        noise = {}
        for block in self.model.actor.blocks:
            draws = -th.empty(len(block.agents), BATCH, block.action_size, dtype=dtype).exponential_().log()
            noise.update(zip(block.agents, draws, strict=True))
        th.set_rng_state(state)
        return noise

    def minimise(self, loss, adam, nets):
        adam.zero_grad()
        loss.backward()
        if self.model.max_grad_norm is not None:
            for net in nets:
                nn.utils.clip_grad_norm_(net.parameters(), self.model.max_grad_norm)
        adam.step()

    @th.no_grad()
    def move_targets(self):
        tau = self.model.tau
        for kind in ("actor", "critic"):
            for v in self.agents:
                nets, targets = self.nets[kind][v], self.nets[f"{kind}_target"][v]
                for net, target in zip(nets, targets, strict=True) if kind == "critic" else [(nets, targets)]:
                    for p, q in zip(net.parameters(), target.parameters(), strict=True):
                        q.copy_(tau * p + (1 - tau) * q)

    def assert_equal_to(self, model, atol):
        for v in self.agents:
            for kind in ("actor", "actor_target"):
                assert_same_network(getattr(model, kind).network(v), self.nets[kind][v], atol, f"{kind} {v}")
            for kind in ("critic", "critic_target"):
                nets = self.critics_in(getattr(model, kind), v, len(self.nets[kind][v]))
                for ours, theirs in zip(nets, self.nets[kind][v], strict=True):
                    assert_same_network(ours, theirs, atol, f"{kind} {v}")


def assert_same_network(ours, theirs, atol, name):
    for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        th.testing.assert_close(one.to(other.dtype), other, atol=atol, rtol=0, msg=lambda text: f"{name}: {text}")


class Still:
    """An opponent that never moves."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.zeros((len(observation), 5), np.float32), None


VARIANTS = {
    "defaults": {},
    "a team of two": {"team": "scout", "opponents": {"tank": Still()}},
    "a team of the last": {"team": "tank", "opponents": {"scout": Still()}, "critic_input": "state"},
    "twin critics, delayed actors": {"policy_delay": 2, "policy_kwargs": {"net_arch": [8, 7], "n_critics": 2}},
    "clipped gradients": {"max_grad_norm": 0.05},
    "critics of the state": {"critic_input": "state"},
    "critics of the own observation": {"critic_input": "own_observation"},
    "twin critics of the own observation": {
        "critic_input": "own_observation",
        "max_grad_norm": 0.05,
        "policy_kwargs": {"net_arch": [8, 7], "n_critics": 2},
    },
    "scaled rewards": {"reward_scale": 0.1, "gamma": 0.9, "tau": 0.3},
    "discrete": {"toy": {"discrete": True}},
    "discrete, twin, clipped": {
        "toy": {"discrete": True},
        "gumbel_temperature": 0.5,
        "max_grad_norm": 0.1,
        "policy_kwargs": {"net_arch": [8, 7], "n_critics": 2},
    },
    "layer norm": {"policy_kwargs": {"net_arch": [8, 7], "layer_norm": True}},
    "layer norm, twin critics of the own observation, clipped": {
        "critic_input": "own_observation",
        "max_grad_norm": 0.05,
        "policy_kwargs": {"net_arch": [8, 7], "layer_norm": True, "n_critics": 2},
    },
    "layer norm, discrete": {"toy": {"discrete": True}, "policy_kwargs": {"net_arch": [8, 7], "layer_norm": True}},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_updates_equal_the_slow_version(variant):
    """In double precision, so that only the arithmetic can differ; four updates in a row."""
    model = make_model(**copy.deepcopy(VARIANTS[variant]))
    batches = [in_double(batch) for batch in draw(model, 4)]
    model.policy.double()
    slow = SlowMADDPG(model)
    for batch in batches:
        serve(model, [batch])
        th.manual_seed(3)
        slow.update(batch)
        th.manual_seed(3)
        model.train(1, BATCH)
        slow.assert_equal_to(model, atol=1e-6)  # networks are taken out of a stack in single precision


@pytest.mark.parametrize("critic_input", ["observations", "state", "own_observation"])
def test_layer_norms_stand_in_actors_critics_and_their_targets(critic_input):
    model = make_model(critic_input=critic_input, policy_kwargs={"net_arch": [8, 7], "layer_norm": True})
    for networks in (model.actor, model.actor_target, model.critic, model.critic_target):
        assert sum(isinstance(layer, nn.LayerNorm) for layer in networks.network(2)) == 2


def test_one_update_equals_the_slow_version_to_1e_5():
    model = make_model()
    (batch,) = draw(model, 1)
    slow = SlowMADDPG(model)
    slow.update(batch)
    serve(model, [batch])
    model.train(1, BATCH)
    slow.assert_equal_to(model, atol=1e-5)


def test_importance_weights_scale_the_critic_loss_alone():
    """The slow version weighs each row's squared error, as Schaul et al. do, and nothing else."""
    model = make_model()
    (batch,) = draw(model, 1)
    batch = in_double(batch)._replace(weights=th.linspace(0.1, 1, BATCH, dtype=th.double))
    model.policy.double()
    slow = SlowMADDPG(model)
    slow.update(batch)
    serve(model, [batch])
    model.train(1, BATCH)
    slow.assert_equal_to(model, atol=1e-6)


@pytest.mark.parametrize("layer_norm", [False, True], ids=["", "layer norm"])
@pytest.mark.parametrize("max_grad_norm", [None, 0.05])
def test_shared_parameters_equal_one_network_per_group_with_one_hot_agents(max_grad_norm, layer_norm):
    """
    Two scouts share an actor and a critic, whose loss is the sum of theirs; the tank has its own. The shared critic reads
    the agent itself first: for the second scout the two scouts change places.
    """
    policy_kwargs = {"net_arch": [8, 7], "layer_norm": layer_norm}
    model = make_model(share_parameters=True, max_grad_norm=max_grad_norm, policy_kwargs=policy_kwargs)
    (batch,) = draw(model, 1)
    layout = model.layout
    group_of_agent = [0, 0, 1]
    in_block = [(0, 2), (1, 2), (0, 1)]  # place among the agents of the same shape, and their number
    seen = th.cat([batch.observations, batch.actions * batch.alive[:, model._agent_of_column]], dim=1)

    critics = one_hot_networks(model.critic.stacks[0])
    actors = [net for stack in model.actor.stacks for net in one_hot_networks(stack)]
    targets = model.td_target(batch)

    def minimise(nets, losses):
        adam = th.optim.Adam([p for net in nets for p in net.parameters()], lr=1e-3)
        sum(losses).backward()
        if max_grad_norm is not None:
            for net in nets:
                nn.utils.clip_grad_norm_(net.parameters(), max_grad_norm)
        adam.step()

    # Joint input: observations of the scouts 0–2, 3–5 and the tank 6–7; actions of the scouts 8–9, 10–11 and the tank 12
    swapped = [3, 4, 5, 0, 1, 2, 6, 7, 10, 11, 8, 9, 12]

    def q_value(v, inputs):
        inputs = inputs[:, swapped] if v == 1 else inputs
        return critics[group_of_agent[v]](with_one_hot(inputs, v, 3)).squeeze(1)

    def mean_alive(values, v):
        return (values * batch.alive[:, v]).sum() / batch.alive[:, v].sum()

    minimise(critics, [mean_alive((targets[v] - q_value(v, seen)) ** 2, v) for v in range(3)])

    def own_q_value(v):
        own = th.tanh(actors[group_of_agent[v]](with_one_hot(batch.observations[:, layout.obs_slices[v]], *in_block[v])))
        start = sum(layout.obs_sizes)
        columns = slice(start + layout.action_slices[v].start, start + layout.action_slices[v].stop)
        return q_value(v, th.cat([seen[:, : columns.start], own, seen[:, columns.stop :]], dim=1))

    minimise(actors, [-mean_alive(own_q_value(v), v) for v in range(3)])

    serve(model, [batch])
    model.train(1, BATCH)
    with th.no_grad():
        for v in range(3):
            ours = model.critic(seen)[0, v]
            th.testing.assert_close(ours, q_value(v, seen), atol=1e-5, rtol=0)
            rows = with_one_hot(batch.observations[:, layout.obs_slices[v]], *in_block[v])
            theirs = th.tanh(actors[group_of_agent[v]](rows))
            actions = model.policy.joint_actions(model.actor, batch.observations)[:, layout.action_slices[v]]
            th.testing.assert_close(actions, theirs, atol=1e-5, rtol=0)


# ---- the target of eq. 5, by hand


def target_by_hand(dones, **kwargs):
    """Rewards 1, 2, 3; target critics that always say 10, 20, 30; γ = 0.9."""
    model = make_model(gamma=0.9, **kwargs)
    with th.no_grad():
        for parameter in model.critic_target.parameters():
            parameter.zero_()
        for stack in model.critic_target.stacks:
            stack.rest[-1].bias.copy_(th.tensor([10.0, 20.0, 30.0]).view(3, 1, 1))
    (batch,) = draw(model, 1)
    batch = batch._replace(
        rewards=th.tensor([[1.0, 2.0, 3.0]]).expand(BATCH, 3),
        dones=th.tensor([dones]).float().expand(BATCH, 3),
        alive=th.ones(BATCH, 3),
    )
    return model.td_target(batch)[:, 0].tolist()


def test_target_by_hand():
    """1 + 0.9 · 10, 2 + 0.9 · 20, 3 + 0.9 · 30; a time limit is stored as no end and gives the same."""
    assert target_by_hand([0, 0, 0]) == pytest.approx([10, 20, 30])


def test_target_of_an_agent_that_dies_is_its_reward():
    assert target_by_hand([0, 1, 0]) == pytest.approx([10, 2, 30])


def test_target_at_the_worlds_end_is_the_rewards():
    assert target_by_hand([1, 1, 1]) == pytest.approx([1, 2, 3])


def test_target_scales_rewards_only():
    """0.5 · 1 + 0.9 · 10, 0.5 · 2 + 0.9 · 20, 0.5 · 3 + 0.9 · 30."""
    assert target_by_hand([0, 0, 0], reward_scale=0.5) == pytest.approx([9.5, 19, 28.5])


def test_target_takes_the_lower_of_two_critics():
    """Second critics that say 5, 25, 15: min(10, 5), min(20, 25), min(30, 15) = 5, 20, 15."""
    model = make_model(gamma=0.9, policy_kwargs={"net_arch": [8], "n_critics": 2})
    with th.no_grad():
        for parameter in model.critic_target.parameters():
            parameter.zero_()
        for stack, says in zip(model.critic_target.stacks, ([10.0, 20.0, 30.0], [5.0, 25.0, 15.0]), strict=True):
            stack.rest[-1].bias.copy_(th.tensor(says).view(3, 1, 1))
    (batch,) = draw(model, 1)
    batch = batch._replace(rewards=th.zeros(BATCH, 3), dones=th.zeros(BATCH, 3))
    assert model.td_target(batch)[:, 0].tolist() == pytest.approx([4.5, 18, 13.5])


def test_target_actions_are_smoothed_within_the_clip():
    """TD3: with noise far beyond the clip of 0.25, the target critics see every action moved by at most that, within ±1."""
    model = make_model(target_policy_noise=5.0, target_noise_clip=0.25)
    (batch,) = draw(model, 1)
    batch = batch._replace(alive=th.ones(BATCH, 3), dones=th.zeros(BATCH, 3))
    plain = model.policy.joint_actions(model.actor_target, batch.next_observations)
    seen, evaluate = [], model.critic_target.evaluate
    model.critic_target.evaluate = lambda inputs: seen.append(inputs[:, -5:]) or evaluate(inputs)
    model.td_target(batch)
    assert 0.2 < (seen[0] - plain).abs().max() <= 0.25 + 1e-6
    assert seen[0].abs().max() <= 1


# ---- the dead


def parameters_after_training(batch, **kwargs):
    model = make_model(**kwargs)
    serve(model, [batch])
    model.train(1, BATCH)
    return model, parameters_of(model)


def dead_batch(agent=1, row=3, **kwargs):
    """A minibatch in whose row 3 agent 1 is dead."""
    (batch,) = draw(make_model(**kwargs), 1)
    alive, dones = batch.alive.clone(), batch.dones.clone()
    alive[row, agent], dones[row, agent] = 0, 1
    return batch._replace(alive=alive, dones=dones)


def changed(batch, field, columns, row=3):
    values = getattr(batch, field).clone()
    values[row, columns] += 5.0
    return batch._replace(**{field: values})


# Agent 1 (scout_1): observation columns 3–5, action columns 2–3.
@pytest.mark.parametrize(("field", "columns"), [("rewards", 1), ("actions", slice(2, 4))])
def test_rewards_and_actions_of_the_dead_reach_no_loss(field, columns):
    batch = dead_batch()
    _, expected = parameters_after_training(batch)
    _, found = parameters_after_training(changed(batch, field, columns))
    for name, value in expected.items():
        assert th.equal(value, found[name]), name


@pytest.mark.parametrize("settings", [{}, {"actor_regularization": 0.1}], ids=["plain", "regularised"])
@pytest.mark.parametrize(
    ("field", "columns"), [("observations", slice(3, 6)), ("next_observations", slice(3, 6)), ("rewards", 1)]
)
def test_a_dead_agents_row_does_not_train_its_own_networks(field, columns, settings):
    batch = dead_batch(**settings)
    one, _ = parameters_after_training(batch, **settings)
    other, _ = parameters_after_training(changed(batch, field, columns), **settings)
    assert_same_network(one.actor.network(1), other.actor.network(1), 0, "actor of the dead agent")
    assert_same_network(one.critic.network(1), other.critic.network(1), 0, "critic of the dead agent")


def test_a_living_agents_row_trains_its_networks():
    """The tests above would pass if nothing ever trained anything."""
    batch = dead_batch()._replace(alive=th.ones(BATCH, 3))
    one, _ = parameters_after_training(batch)
    other, _ = parameters_after_training(changed(batch, "rewards", 1))
    assert not th.equal(one.critic.network(1)[0].weight, other.critic.network(1)[0].weight)


def test_the_action_of_who_dies_in_the_step_still_counts():
    """Alive at the start of the step: its action is part of what the critics judge."""
    batch = dead_batch()
    alive = batch.alive.clone()
    alive[3, 1] = 1
    batch = batch._replace(alive=alive)
    _, one = parameters_after_training(batch)
    _, other = parameters_after_training(changed(batch, "actions", slice(2, 4)))
    assert not th.equal(one["critic.stacks.0.first.weight"], other["critic.stacks.0.first.weight"])


def test_a_batch_of_the_dead_leaves_the_networks_as_they_are():
    batch = dead_batch()
    batch = batch._replace(alive=th.zeros(BATCH, 3), dones=th.ones(BATCH, 3))
    before = parameters_of(make_model())
    _, after = parameters_after_training(batch)
    for name, value in before.items():
        th.testing.assert_close(value, after[name], atol=1e-7, rtol=0)  # τθ + (1 − τ)θ is θ but for rounding


# ---- one agent


def test_a_world_of_one_agent_is_sb3s_ddpg():
    """Same weights, same minibatches: five updates of SB3's DDPG."""
    env = JointEnv(ToyParallelEnv(agents=("scout_0",)))
    ours = MADDPG("MlpPolicy", env, buffer_size=64, batch_size=BATCH, policy_kwargs={"net_arch": [8, 7]}, device="cpu")
    theirs = DDPG("MlpPolicy", env, policy_kwargs={"net_arch": [8, 7]}, tau=0.01, buffer_size=10, device="cpu")
    for model in (ours, theirs):
        model.set_logger(configure(None, []))
    pairs = {"actor": lambda m: m.mu, "critic": lambda m: m.q_networks[0]}
    for kind, their_network in pairs.items():
        for name in (kind, f"{kind}_target"):
            copy_linears(getattr(ours, name).network(0), their_network(getattr(theirs, name)))
    fill(ours.replay_buffer, ours.layout, 64, death_rate=0.2)
    batches = [ours.replay_buffer.sample(BATCH) for _ in range(5)]
    serve(ours, batches)
    serve(theirs, [ReplayBufferSamples(b.observations, b.actions, b.next_observations, b.dones, b.rewards) for b in batches])
    ours.train(5, BATCH)
    theirs.train(5, BATCH)
    for kind, their_network in pairs.items():
        for name in (kind, f"{kind}_target"):
            twin = their_network(getattr(theirs, name))
            assert_same_network(getattr(ours, name).network(0), nn.Sequential(*linears(twin)), 1e-5, name)


def linears(network):
    return [layer for layer in network if isinstance(layer, nn.Linear)]


def copy_linears(source, target):
    for ours, theirs in zip(linears(source), linears(target), strict=True):
        theirs.load_state_dict(ours.state_dict())


# ---- small options


def test_actor_regularisation_adds_the_mean_squared_raw_output():
    """With critics that are blind to actions only the penalty moves the actors: its gradient, worked by autograd."""
    model = make_model(actor_regularization=0.5)
    with th.no_grad():
        for parameter in model.critic.parameters():
            parameter.zero_()
    model.critic.optimizer = th.optim.SGD(model.critic.parameters(), lr=0.0)
    model.lr_schedule = lambda _: 0.0
    (batch,) = draw(model, 1)
    batch = batch._replace(alive=th.ones(BATCH, 3))
    serve(model, [batch])
    network = model.actor.network(2)
    (0.5 * network(batch.observations[:, model.layout.obs_slices[2]]).square().mean()).backward()
    model.train(1, BATCH)
    norm = th.cat([p.grad.flatten() for p in network.parameters()]).norm()
    stack = next(s for s, block in zip(model.actor.stacks, model.actor.blocks, strict=True) if 2 in block.agents)
    th.testing.assert_close(stack.gradient_norms()[0], norm)


def test_learning_rate_follows_its_schedule():
    model = make_model(learning_rate="lin_1e-2")
    model._current_progress_remaining = 0.5
    serve(model, draw(model, 1))
    model.train(1, BATCH)
    for networks in (model.actor, model.critic):
        assert networks.optimizer.param_groups[0]["lr"] == pytest.approx(0.005)


def test_priorities_are_the_mean_error_of_the_living():
    """|δ| of a row: mean over its living agents, by the slow way through separate critics."""
    model = make_model()
    (batch,) = draw(model, 1)
    serve(model, [batch])
    received = {}
    model.replay_buffer.uses_td_errors = True
    model.replay_buffer.update_priorities = lambda rows, errors: received.update(rows=rows, errors=errors)
    with th.no_grad():
        y, inputs = model.td_target(batch), model.teacher_inputs(batch)
        deltas = th.stack([(y[v] - model.critic.network(v)(inputs).squeeze(1)).abs() for v in range(3)], dim=1)
    model.train(1, BATCH)
    expected = [
        np.mean([float(d) for d, lives in zip(row, alive, strict=True) if lives]) if alive.any() else 0.0
        for row, alive in zip(deltas, batch.alive, strict=True)
    ]
    np.testing.assert_array_equal(received["rows"], batch.rows)
    np.testing.assert_allclose(received["errors"].numpy(), expected, rtol=1e-4, atol=1e-6)
