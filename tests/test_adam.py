"""Our Adam is PyTorch's, number for number."""

import copy

import pytest
import torch as th

from sb3_kfcv import MADDPG
from sb3_kfcv.common.adam import LeanAdam
from sb3_kfcv.envs import hard_spread_v0

SETTINGS = {
    "defaults": {},
    "weight decay": {"weight_decay": 0.1},
    "betas and eps": {"betas": (0.5, 0.9), "eps": 1e-3},
    "maximise": {"maximize": True},
    "AMSGrad": {"amsgrad": True},
    "not fused": {"fused": False},
    "decoupled weight decay": {"weight_decay": 0.1, "decoupled_weight_decay": True},
}


def parameters():
    th.manual_seed(0)
    return [th.nn.Parameter(th.randn(*shape)) for shape in ((3, 4, 5), (3, 1, 5), (1,))]


def optimiser(cls, **kwargs):
    return cls(parameters(), **{"lr": 1e-2, "fused": True, **kwargs})


def step(optimizer, seed):
    th.manual_seed(seed)
    for parameter in optimizer.param_groups[0]["params"]:
        parameter.grad = th.randn_like(parameter)
    optimizer.step()


def equal(one, other):
    ours, theirs = one.state_dict(), other.state_dict()
    assert ours["param_groups"] == theirs["param_groups"]
    for mine, its in zip(one.param_groups[0]["params"], other.param_groups[0]["params"], strict=True):
        assert th.equal(mine, its)
    for key, state in theirs["state"].items():
        assert all(th.equal(ours["state"][key][name], value) for name, value in state.items())


@pytest.mark.parametrize("settings", SETTINGS)
def test_steps_and_state_are_those_of_pytorch(settings):
    ours, theirs = (optimiser(cls, **SETTINGS[settings]) for cls in (LeanAdam, th.optim.Adam))
    for seed in range(5):
        for optimizer in (ours, theirs):
            optimizer.param_groups[0]["lr"] = 0.01 * (seed + 1)
            step(optimizer, seed)
        equal(ours, theirs)


def test_a_loaded_state_goes_on():
    """The tensors that were found before are not those of the state that was loaded."""
    ours, theirs = optimiser(LeanAdam), optimiser(th.optim.Adam)
    for seed in range(3):
        step(theirs, seed)
    step(ours, 9)
    step(ours, 9)
    ours.load_state_dict(copy.deepcopy(theirs.state_dict()))
    with th.no_grad():
        for mine, its in zip(ours.param_groups[0]["params"], theirs.param_groups[0]["params"], strict=True):
            mine.copy_(its)
    for seed in range(3, 6):
        step(ours, seed)
        step(theirs, seed)
        equal(ours, theirs)


def test_a_closure_is_evaluated():
    optimizer = optimiser(LeanAdam)

    def closure():
        optimizer.zero_grad()
        loss = sum(parameter.square().sum() for parameter in optimizer.param_groups[0]["params"])
        loss.backward()
        return loss

    losses = [optimizer.step(closure).item() for _ in range(20)]
    assert losses[-1] < losses[0]


@pytest.mark.parametrize("which", [[0], [], [1, 2]], ids=["one", "none", "two"])
def test_parameters_without_gradient_stand_still_and_go_on_later(which):
    ours, theirs = optimiser(LeanAdam), optimiser(th.optim.Adam)
    for seed in range(6):
        for optimizer in (ours, theirs):
            th.manual_seed(seed)
            for i, parameter in enumerate(optimizer.param_groups[0]["params"]):
                parameter.grad = th.randn_like(parameter) if seed % 3 or i in which else None
            optimizer.step()
        equal(ours, theirs)


def test_hooks_are_called():
    optimizer, calls = optimiser(LeanAdam), []
    optimizer.register_step_post_hook(lambda *args: calls.append("after"))
    optimizer.register_step_pre_hook(lambda *args: calls.append("before"))
    for seed in range(3):
        step(optimizer, seed)
    assert calls == ["before", "after"] * 3


def test_a_cleared_state_begins_anew():
    ours, theirs = optimiser(LeanAdam), optimiser(th.optim.Adam)
    for seed in range(4):
        for optimizer in (ours, theirs):
            if seed == 2:
                optimizer.state.clear()
            step(optimizer, seed)
        equal(ours, theirs)


@pytest.mark.parametrize(
    ("optimizer_kwargs", "fused"), [(None, True), ({"eps": 1e-5}, True), ({"fused": False}, False), ({"foreach": True}, False)]
)
def test_adam_is_fused_unless_it_is_to_be_otherwise(optimizer_kwargs, fused):
    kwargs = {"net_arch": [4], "optimizer_kwargs": optimizer_kwargs}
    model = MADDPG("MlpPolicy", hard_spread_v0.parallel_env(n_agents=2), policy_kwargs=kwargs, device="cpu")
    for network in (model.actor, model.critic):
        assert isinstance(network.optimizer, LeanAdam) == fused
        assert network.optimizer.defaults["eps"] == (optimizer_kwargs or {}).get("eps", 1e-8)
