"""Files made to do harm, sealed as if they were whole: refused in a sentence; nothing is run, nothing is taken over."""

import ast
import base64
import copy
import inspect
import io
import json
import os
import pickle
import shutil
import struct
import subprocess
import sys
import time
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch as th
from crafted import (
    ALGORITHMS,
    CURRICULUM,
    array,
    assert_one_sentence,
    drop,
    make,
    members_of,
    npy,
    npy_header,
    put,
    raw,
    tampered,
    toy,
    with_manifest,
    within_memory,
    write_members,
    write_run,
    write_sealed,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_kfcv import KFCVMADDPG, CoTraining, FileFormatError, KFCVReplayBuffer, MlpPolicy
from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.checks import NonFiniteError
from sb3_kfcv.saving import values
from sb3_kfcv.saving.archive import MANIFEST
from sb3_kfcv.saving.checkpoints import Checkpoint, Checkpoints
from sb3_kfcv.saving.normalization import load_normalization
from sb3_kfcv.saving.run_state import random_state, set_random_state
from sb3_kfcv.teams.players import Mixture, load_player

ROOT = Path(__file__).resolve().parents[1]
MODEL_FILES = ("model", "buffer", "checkpoint")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Files of a tiny run of every algorithm: name → kind of file → path."""
    folder = tmp_path_factory.mktemp("runs")
    for name in ALGORITHMS:
        (folder / name).mkdir()
    return {name: dict(zip(MODEL_FILES, write_run(folder / name, name), strict=True)) for name in ALGORITHMS}


class Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def refused(path, read):
    """Reading the file is refused by its name: what is said."""
    with pytest.raises(FileFormatError) as caught:
        read(path)
    assert_one_sentence(caught.value, path)
    return str(caught.value)


def parametrized(cases):
    return pytest.mark.parametrize("edits", list(cases.values()), ids=list(cases))


def named(name):
    return {"$": "name", "of": name}


def snapshot(model):
    """Everything of a model that a file could change."""
    buffer = model.replay_buffer
    return copy.deepcopy([model.get_parameters(), buffer.state(), buffer.transitions()])


def assert_unchanged(model, before):
    assert same(before, snapshot(model))


def same(one, other):
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(value, other[key]) for key, value in one.items())
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=True)
    return th.equal(one, other) if isinstance(one, th.Tensor) else one == other


# ---- a model's settings and counters

A = "attributes"
HUGE = 10**12
SERIALIZED = {":type:": "<class 'type'>", ":serialized:": base64.b64encode(pickle.dumps(Evil("x"))).decode()}
DEEP_LIST = b"[" * 100_000 + b"]" * 100_000
DEEP_MAP = b'{"a":' * 100_000 + b"1" + b"}" * 100_000
NOT_JSON = {
    "100,000 brackets": DEEP_LIST,
    "100,000 maps": DEEP_MAP,
    "brackets that do not close": b"[" * 100_000,
    "a number of a million digits": b'{"algorithm": 1' + b"0" * 10**6 + b"}",
    "NaN": b'{"gamma": NaN}',
    "Infinity": b'{"gamma": Infinity}',
    "-Infinity": b'{"gamma": -Infinity}',
    "no UTF-8": b'{"gamma": "\xff\xfe"}',
    "UTF-16": '{"gamma": 1}'.encode("utf-16"),
    "nothing": b"",
    "half": b'{"gamma": ',
    "more behind": b"{} {}",
    "Python": b"{'gamma': __import__('os').getpid()}",
    "a pickle": pickle.dumps({"gamma": 1}),
}


def named_by_numbers(members):
    items = [*json.loads(members["attributes.json"]).items(), (1, 2)]
    members["attributes.json"] = json.dumps({"$": "map", "items": items}).encode()


ATTRIBUTES = {
    **{f"lacks {name}": [drop(A, name)] for name in ("algorithm", "layout", "policy_class", "action_space", "n_envs")},
    "nothing at all": [raw("attributes.json", b"{}")],
    "a list": [raw("attributes.json", b"[]")],
    "null": [raw("attributes.json", b"null")],
    "names that are no text": [named_by_numbers],
    **{f"{name} shadows a method": [put(A, name, to=1)] for name in ("predict", "learn", "save", "_setup_model", "__class__")},
    **{f"{name} is the program's": [put(A, name, to=[1])] for name in ("env", "replay_buffer", "device", "_logger")},
    # classes
    "a class that no one knows": [put(A, "policy_class", to=named("os.system"))],
    "a class that is a path": [put(A, "policy_class", to=named("sb3_kfcv.maddpg.policies.MlpPolicy"))],
    "a name that is a list": [put(A, "policy_class", to=named(["relu"]))],
    "a kind that no one knows": [put(A, "gamma", to={"$": "pickle", "data": "gASVJ"})],
    "a kind that is a list": [put(A, "gamma", to={"$": ["list"]})],
    "a kind that is null": [put(A, "gamma", to={"$": None})],
    "a kind without its fields": [put(A, "layout", to={"$": "AgentLayout"})],
    "a kind with more fields": [put(A, "train_freq", "run", to="rm")],
    "serialized as in SB3": [put(A, "policy_class", to=SERIALIZED)],
    "a schedule serialized as in SB3": [put(A, "learning_rate", to=SERIALIZED)],
    "policy_class is an activation": [put(A, "policy_class", to=named("relu"))],
    "policy_class is a text": [put(A, "policy_class", to="relu")],
    "policy_class is a buffer": [put(A, "policy_class", to=named("KFCVReplayBuffer"))],
    "replay_buffer_class is an activation": [put(A, "replay_buffer_class", to=named("tanh"))],
    "replay_buffer_class is a policy": [put(A, "replay_buffer_class", to=named("MlpPolicy"))],
    "replay_buffer_class is null": [put(A, "replay_buffer_class", to=None)],
    "activation_fn is a number type": [put(A, "policy_kwargs", "activation_fn", to=named("float32"))],
    "activation_fn is an optimiser": [put(A, "policy_kwargs", "activation_fn", to=named("adam"))],
    "optimizer_class is an activation": [put(A, "policy_kwargs", "optimizer_class", to=named("relu"))],
    "optimizer_kwargs are none": [put(A, "policy_kwargs", "optimizer_kwargs", to={"betas": 1})],
    "optimizer_kwargs hold the parameters": [put(A, "policy_kwargs", "optimizer_kwargs", to={"params": []})],
    "policy_kwargs are a list": [put(A, "policy_kwargs", to=[1])],
    "policy_kwargs with a layout": [put(A, "policy_kwargs", "agents", to=[0])],
    "policy_kwargs that no policy has": [put(A, "policy_kwargs", "run", to="rm")],
    "replay_buffer_kwargs that no buffer has": [put(A, "replay_buffer_kwargs", "run", to="rm")],
    "replay_buffer_kwargs with other agents": [put(A, "replay_buffer_kwargs", "n_agents", to=1)],
    # sizes
    "net_arch of minus": [put(A, "policy_kwargs", "net_arch", to=[-4])],
    "net_arch of zero": [put(A, "policy_kwargs", "net_arch", to=[0])],
    "net_arch of halves": [put(A, "policy_kwargs", "net_arch", to=[4.5])],
    "net_arch of texts": [put(A, "policy_kwargs", "net_arch", to=["4"])],
    "net_arch of a map": [put(A, "policy_kwargs", "net_arch", to={"pi": {"a": 1}})],
    "net_arch other than the parameters": [put(A, "policy_kwargs", "net_arch", to=[3])],
    "n_critics other than the parameters": [put(A, "policy_kwargs", "n_critics", to=2)],
    "n_critics a text": [put(A, "policy_kwargs", "n_critics", to="2")],
    "buffer_size 0": [put(A, "buffer_size", to=0)],
    "buffer_size a list": [put(A, "buffer_size", to=[50])],
    "n_envs 0": [put(A, "n_envs", to=0)],
    "n_envs a text": [put(A, "n_envs", to="1")],
    "n_folds 1": [put(A, "replay_buffer_kwargs", "n_folds", to=1)],
    # who sits where
    "a layout of other sizes": [put(A, "layout", "obs_sizes", to=[3, 3, 3])],
    "a layout of other actions": [put(A, "layout", "action_sizes", to=[2, 2, 2])],
    "a layout of negative sizes": [put(A, "layout", "obs_sizes", to=[-3, 9, 2])],
    "a layout of halves": [put(A, "layout", "obs_sizes", to=[2.5, 3.5, 2])],
    "a layout of few groups": [put(A, "layout", "groups", to=["scout"])],
    "a layout of one name": [put(A, "layout", "agents", to=["scout_0"] * 3)],
    "a layout of numbers as names": [put(A, "layout", "agents", to=[1, 2, 3])],
    "a layout of a text": [put(A, "layout", "agents", to="abc")],
    "a layout of nobody": [put(A, "layout", name, to=[]) for name in ("agents", "groups", "obs_sizes", "action_sizes")],
    "a layout that is maybe discrete": [put(A, "layout", "discrete", to="no")],
    "a layout that is discrete": [put(A, "layout", "discrete", to=True)],
    "a layout of a negative state": [put(A, "layout", "state_size", to=-1)],
    "a layout that is a box": [put(A, "layout", to={"$": "deque", "items": [], "maxlen": None})],
    "a space with NaN": [array("attributes/observation_space/low", lambda low: low * np.nan)],
    "a space upside down": [array("attributes/action_space/low", lambda low: -3 * low)],
    "a space of one action": [array("attributes/action_space/low", lambda low: -low)],
    "a space of another type": [array("attributes/action_space/low", lambda low: low.astype(np.float64))],
    "a space of other sizes": [array(f"attributes/observation_space/{bound}", lambda x: x[:3]) for bound in ("low", "high")],
    "a space of choices": [put(A, "observation_space", to={"$": "MultiDiscrete", "nvec": named("relu")})],
    "actions without bound": [array("attributes/action_space/high", lambda high: high * np.inf)],
    "actions of a range beyond all numbers": [
        array("attributes/action_space/low", lambda low: low * 0 - 3e38),
        array("attributes/action_space/high", lambda high: high * 0 + 3e38),
    ],
    # numbers
    "num_timesteps negative": [put(A, "num_timesteps", to=-1)],
    "num_timesteps a text": [put(A, "num_timesteps", to="60")],
    "_n_updates a half": [put(A, "_n_updates", to=1.5)],
    "_current_progress_remaining a text": [put(A, "_current_progress_remaining", to="all")],
    "gamma beyond 1": [put(A, "gamma", to=2)],
    "gamma NaN": [put(A, "gamma", to={"$": "float", "value": "nan"})],
    "gamma of a crafted float": [put(A, "gamma", to={"$": "float", "value": "__import__('os')"})],
    "tau a list": [put(A, "tau", to=[0.1])],
    "a number of an object": [put(A, "gamma", to={"$": "scalar", "dtype": "O", "value": 0.9})],
    "a number of a structure": [put(A, "gamma", to={"$": "scalar", "dtype": "f8,f8", "value": 0.9})],
    "a number of a list": [put(A, "seed", to={"$": "scalar", "dtype": "<i8", "value": [1, 2]})],
    "a number out of its type": [put(A, "seed", to={"$": "scalar", "dtype": "|i1", "value": 300})],
    "a map whose keys cannot be": [put(A, "gamma", to={"$": "map", "items": [[[1], 2]]})],
    "a map of no pairs": [put(A, "gamma", to={"$": "map", "items": [1]})],
    "a queue that is too long": [put(A, "ep_info_buffer", "maxlen", to=10**30)],
    "seed negative": [put(A, "seed", to=-1)],
    "seed a text": [put(A, "seed", to="one")],
    "train_freq negative": [put(A, "train_freq", "frequency", to=-1)],
    "train_freq per year": [put(A, "train_freq", "unit", to="year")],
    "train_freq nothing": [put(A, "train_freq", to={"$": "tuple", "items": []})],
    "learning_rate a list": [put(A, "learning_rate", to=[1e-3])],
    "learning_rate negative": [put(A, "learning_rate", to=-1.0)],
    "learning_rate of a text": [put(A, "learning_rate", to="lin_inf")],
    "learning_rate an activation": [put(A, "learning_rate", to=named("relu"))],
    "a schedule of a text": [put(A, "learning_rate", to={"$": "ConstantSchedule", "val": "x"})],
    "a schedule that divides by 0": [
        put(A, "learning_rate", to={"$": "LinearSchedule", "start": 1, "end": 0, "end_fraction": 0})
    ],
    "noise with NaN": [array("attributes/action_noise/sigma", lambda sigma: sigma * np.nan)],
    "noise of negative spread": [array("attributes/action_noise/sigma", lambda sigma: -sigma)],
    "noise of an object": [put(A, "action_noise", "dtype", to=named("relu"))],
    "noise that is none": [put(A, "action_noise", to=0.1)],
    "noise of noises of noises": [put(A, "action_noise", to={"$": "VectorizedActionNoise", "base_noise": 1, "noises": [1]})],
    "critic_input that is none": [put(A, "critic_input", to="everything")],
    "a team that is none": [put(A, "team", to="nobody")],
    "opponents that are none": [put(A, "team", to="tank"), put(A, "opponents", to={"scout": "os.system"})],
    "opponents of nobody": [put(A, "opponents", to={"wall": "random"})],
    "_last_obs of another world": [array("attributes/_last_obs", lambda rows: rows[:, :3])],
    "_last_obs a text": [put(A, "_last_obs", to="x")],
    "ep_info_buffer a list": [put(A, "ep_info_buffer", to=[])],
    "ep_info_buffer of texts": [put(A, "ep_info_buffer", to={"$": "deque", "items": ["x"], "maxlen": None})],
    # arrays by name
    "an array that is not there": [put(A, "_last_obs", to={"$": "array", "name": "attributes/none.npy"})],
    "an array outside": [put(A, "_last_obs", to={"$": "array", "name": "../../etc/passwd.npy"})],
    "an array that is JSON": [put(A, "_last_obs", to={"$": "array", "name": "attributes.json"})],
    "an array of a list": [put(A, "_last_obs", to={"$": "array", "name": ["attributes/_last_obs.npy"]})],
    "an array that stands twice": [put(A, "more", to={"$": "array", "name": "attributes/_last_obs.npy"})],
    **{f"JSON: {name}": [raw("attributes.json", data)] for name, data in NOT_JSON.items()},
}


@parametrized(ATTRIBUTES)
def test_crafted_settings_are_refused(runs, edits, tmp_path):
    said = refused(tampered(runs["kfcv"]["model"], tmp_path / "model.zip", *edits), KFCVMADDPG.load)
    assert "attributes" in said or "parameters" in said or "was saved by" in said
    refused(tampered(runs["kfcv"]["checkpoint"], tmp_path / "checkpoint.zip", *edits), KFCVMADDPG.load)


LARGE = {
    "layers": [put(A, "policy_kwargs", "net_arch", to=[30_000, 30_000])],
    "layers beyond any memory": [put(A, "policy_kwargs", "net_arch", to=[HUGE] * 3)],
    "layers of critics": [put(A, "policy_kwargs", "net_arch", to={"pi": [4], "qf": [4, 10_000, 10_000, 10_000]})],
    "layers whose sizes cancel out": [put(A, "policy_kwargs", "net_arch", to=[10**8, -(10**3)])],
    "100,000 layers": [put(A, "policy_kwargs", "net_arch", to=[1] * 100_000)],
    "critics": [put(A, "policy_kwargs", "n_critics", to=10**7)],
    "buffer_size": [put(A, "buffer_size", to=HUGE)],
    "buffer_size beyond any number": [put(A, "buffer_size", to=10**400)],
    "n_envs": [
        put(A, "n_envs", to=HUGE),
        drop(A, "_last_obs"),
        drop(A, "_last_original_obs"),
        drop(A, "_last_episode_starts"),
    ],
    "folds": [put(A, "replay_buffer_kwargs", "n_folds", to=10**9)],
    "folds of a large buffer": [
        put(A, "buffer_size", to=40_000),
        put(A, "replay_buffer_kwargs", to={"n_folds": 40_000, "teacher_net_arch": [999, 999]}),
    ],
    "teachers": [put(A, "replay_buffer_kwargs", "teacher_net_arch", to=[10**6] * 3)],
    "state": [put(A, "layout", "state_size", to=HUGE), put(A, "critic_input", to="state")],
    "observations": [put(A, "layout", "obs_sizes", to=[HUGE, 3, 2])],
    "a shared array": [
        put(A, "many", to=[{"$": "array", "name": "parameters/policy/critic.stacks.0.first.weight.npy"}] * 100_000)
    ],
}


@parametrized(LARGE)
def test_what_is_too_large_is_refused_before_memory_is_taken(runs, edits, tmp_path):
    """Some of these ask for less memory than there is, yet for networks that the file does not hold."""
    path = tampered(runs["kfcv"]["model"], tmp_path / "model.zip", *edits)
    with within_memory(150e6):
        refused(path, KFCVMADDPG.load)


def test_what_a_file_asks_for_is_never_run(runs, tmp_path):
    """An entry as SB3 writes it is a plain map, here."""
    marker = tmp_path / "marker"
    payload = pickle.dumps(Evil(marker))
    serialized = {":type:": "<class 'function'>", ":serialized:": base64.b64encode(payload).decode()}
    path = tampered(
        runs["kfcv"]["model"],
        tmp_path / "model.zip",
        put(A, "notes", to=serialized),
        raw("data.pkl", payload),
        raw("archive/data.pkl", payload),
        raw("policy.pth", payload),
    )
    assert KFCVMADDPG.load(path).notes == serialized
    assert not marker.exists()
    pickle.loads(payload)
    assert marker.exists()  # which it would have done


def test_attributes_of_discrete_agents_must_fit_their_choices(runs, tmp_path):
    for change in (lambda nvec: nvec + 1, lambda nvec: nvec[:2], lambda nvec: nvec.astype(float), lambda nvec: -nvec):
        path = tampered(runs["discrete"]["model"], tmp_path / "model.zip", array("attributes/action_space/nvec", change))
        refused(path, ALGORITHMS["discrete"].load)


# ---- parameters

P = "parameters"
POLICY = "parameters/policy"
WEIGHT = f"{POLICY}/actor.stacks.0.first.weight"
MOMENTS = "parameters/critic.optimizer/state/0"
STATE = (P, "critic.optimizer", "state", "items")


def number(value):
    """An edit of an array: one number of it."""

    def change(numbers):
        numbers.flat[0] = value

    return change


PARAMETERS = {
    "no parameters": [raw("parameters.json", b"{}")],
    "a list": [raw("parameters.json", b"[]")],
    "one is missing": [drop(P, "policy", "actor.stacks.0.first.weight")],
    "one too many": [
        put(P, "policy", "more.weight", to={"$": "tensor", "name": "more.npy"}),
        raw("more.npy", npy(np.zeros(3))),
    ],
    "a network is missing": [drop(P, "actor.optimizer")],
    "a network too many": [put(P, "more", to={})],
    "a network is a method": [put(P, "learn", to={})],
    "null": [put(P, "policy", "actor.stacks.0.first.weight", to=None)],
    "no tensor": [put(P, "policy", "actor.stacks.0.first.weight", "$", to="array")],
    "of doubles": [array(WEIGHT, lambda weight: weight.astype(np.float64))],
    "of halves": [array(WEIGHT, lambda weight: weight.astype(np.float16))],
    "of whole numbers": [array(WEIGHT, lambda weight: weight.astype(np.int32))],
    "transposed": [array(WEIGHT, lambda weight: weight.transpose(0, 2, 1).copy())],
    "flat": [array(WEIGHT, lambda weight: weight.ravel())],
    "one number": [array(WEIGHT, lambda weight: weight.ravel()[0])],
    "empty": [array(WEIGHT, lambda weight: weight[:0])],
    "NaN": [array(WEIGHT, number(np.nan))],
    "infinite": [array(WEIGHT, number(-np.inf))],
    "moments with NaN": [array(f"{MOMENTS}/exp_avg", number(np.nan))],
    "moments infinite": [array(f"{MOMENTS}/exp_avg_sq", number(np.inf))],
    "moments negative": [array(f"{MOMENTS}/exp_avg_sq", number(-1))],
    "moments of another shape": [array(f"{MOMENTS}/exp_avg", lambda moment: moment.ravel())],
    "moments of one number": [array(f"{MOMENTS}/exp_avg", lambda moment: moment.ravel()[0])],
    "moments of doubles": [array(f"{MOMENTS}/exp_avg", lambda moment: moment.astype(float))],
    "steps negative": [array(f"{MOMENTS}/step", lambda step: -step)],
    "steps of many": [array(f"{MOMENTS}/step", lambda step: np.zeros(3, np.float32))],
    "a moment is missing": [drop(*STATE, 0, 1, "exp_avg")],
    "a moment too many": [put(*STATE, 0, 1, "lr", to=1.0)],
    "a moment is null": [put(*STATE, 0, 1, "exp_avg", to=None)],
    "moments of a parameter that is none": [put(*STATE, 0, 0, to=99)],
    "moments of a text": [put(*STATE, 0, 0, to="0")],
    "a state that is a list": [put(P, "critic.optimizer", "state", to=[])],
    "no state": [drop(P, "critic.optimizer", "state")],
    **{f"JSON: {name}": [raw("parameters.json", data)] for name, data in NOT_JSON.items()},
}


@parametrized(PARAMETERS)
def test_crafted_parameters_are_refused(runs, edits, tmp_path):
    path = tampered(runs["kfcv"]["model"], tmp_path / "model.zip", *edits)
    assert "parameters" in refused(path, KFCVMADDPG.load)
    model = make(seed=1).learn(20)
    before = snapshot(model)
    refused(path, model.set_parameters)
    assert_unchanged(model, before)


def test_the_optimisers_own_settings_are_not_the_files_to_set(runs, tmp_path):
    groups = ("parameters", "critic.optimizer", "param_groups", 0)
    path = tampered(runs["kfcv"]["model"], tmp_path / "model.zip", put(*groups, "lr", to=1e9), put(*groups, "params", to=[7]))
    assert KFCVMADDPG.load(path).critic.optimizer.param_groups[0]["lr"] == 1e-3


# ---- replay buffers

R, T = "replay_buffer", "transitions"


def every(change):
    """An edit of all transitions, but those that follow the last of an episode."""
    names = (
        "observations",
        "actions",
        "rewards",
        "dones",
        "alive",
        "states",
        "next_observations/differs",
        "next_states/differs",
    )
    return [array(f"{T}/{name}", change) for name in names]


BUFFER = {
    "no state": [raw("replay_buffer.json", b"{}")],
    "a list": [raw("replay_buffer.json", b"[]")],
    "no transitions": [raw("transitions.json", b"{}")],
    "transitions of null": [raw("transitions.json", b"null")],
    "of no class": [drop(R, "class")],
    "of a class that is none": [put(R, "class", to=named("tanh"))],
    "of a class that is a text": [put(R, "class", to="JointReplayBuffer")],
    "of a class that no one knows": [put(R, "class", to=named("collections.OrderedDict"))],
    "one thing too many": [put(R, "more", to=1)],
    "n_added negative": [put(R, "n_added", to=-1)],
    "n_added a text": [put(R, "n_added", to="30")],
    "n_added a half": [put(R, "n_added", to=29.5)],
    "n_added yes": [put(R, "n_added", to=True)],
    "n_added fewer": [put(R, "n_added", to=29)],
    "n_added more": [put(R, "n_added", to=31)],
    "n_added beyond all numbers": [put(R, "n_added", to=10**30)],
    "n_steps 0": [put(R, "n_steps", to=0)],
    "n_steps beyond all numbers": [put(R, "n_steps", to=10**30)],
    "n_envs 0": [put(R, "n_envs", to=0)],
    "n_envs 2": [put(R, "n_envs", to=2)],
    "progress beyond the end": [put(R, "progress", to=2)],
    "progress a text": [put(R, "progress", to="half")],
    "progress NaN": [put(R, "progress", to={"$": "float", "value": "nan"})],
    "a generator that is none": [put(R, "rng", to=1)],
    "a generator of another kind": [put(R, "rng", "bit_generator", to="MT19937")],
    "a generator without its state": [drop(R, "rng", "state")],
    "a generator of texts": [put(R, "rng", "state", "state", to="1")],
    "a generator beyond all numbers": [put(R, "rng", "state", "inc", to=2**200)],
    "a generator beyond its numbers": [put(R, "rng", "has_uint32", to=2**70)],
    **{f"{name} with NaN": [array(f"{T}/{name}", number(np.nan))] for name in ("observations", "actions", "rewards", "alive")},
    "rewards infinite": [array(f"{T}/rewards", number(-np.inf))],
    "rewards of doubles": [array(f"{T}/rewards", lambda rewards: rewards.astype(float))],
    "rewards fewer": [array(f"{T}/rewards", lambda rewards: rewards[1:])],
    "rewards of fewer agents": [array(f"{T}/rewards", lambda rewards: rewards[..., :1].copy())],
    "rewards missing": [drop(T, "rewards")],
    "rewards null": [put(T, "rewards", to=None)],
    "dones of 2": [array(f"{T}/dones", number(2))],
    "next observations with NaN": [array(f"{T}/next_observations/rows", number(np.nan))],
    "next observations fewer": [array(f"{T}/next_observations/rows", lambda rows: rows[1:].copy())],
    "next observations of doubles": [array(f"{T}/next_observations/rows", lambda rows: rows.astype(float))],
    "next observations unmarked": [array(f"{T}/next_observations/differs", lambda differs: differs * False)],
    "next observations marked by numbers": [array(f"{T}/next_observations/differs", lambda differs: differs.astype(int))],
    "next observations missing": [drop(T, "next_observations", "rows")],
    "half alive": [array(f"{T}/alive", number(0.5))],
    "observations of others": [put(T, "observations", "name", to="transitions/rewards.npy"), drop(T, "rewards")],
    **{f"JSON: {name}": [raw("replay_buffer.json", data)] for name, data in NOT_JSON.items()},
}
KFCV = {
    "folds beyond the last": [array(f"{R}/folds", number(2))],
    "folds negative": [array(f"{R}/folds", number(-1))],
    "folds of floats": [array(f"{R}/folds", lambda folds: folds.astype(float))],
    "folds fewer": [array(f"{R}/folds", lambda folds: folds[1:])],
    "folds of which one is empty": [array(f"{R}/folds", lambda folds: folds * 0)],
    "folds null": [put(R, "folds", to=None)],
    "buckets beyond the last": [array(f"{R}/buckets", number(2))],
    "buckets below the first": [array(f"{R}/buckets", number(-2))],
    "buckets of other numbers": [array(f"{R}/buckets", lambda buckets: buckets.astype(np.int64))],
    "buckets of what is not stored": [array(f"{R}/buckets", lambda buckets: buckets * 0)],
    "scores with NaN": [array(f"{R}/scores", number(np.nan))],
    "scores of minus infinity": [array(f"{R}/scores", number(-np.inf))],
    "refreshes negative": [put(R, "n_refreshes", to=-1)],
    "refreshes a text": [put(R, "updates_since_refresh", to="1")],
    "stats of texts": [put(R, "stats", to={"curriculum/teacher_loss_in_fold": "low"})],
    "stats of lists": [put(R, "stats", to={"a": [1]})],
    "stats that are none": [put(R, "stats", to=5)],
    "seconds of NaN": [put(R, "refresh_seconds", to={"$": "float", "value": "nan"})],
    "seconds of a text": [put(R, "refresh_seconds", to="1")],
    "teachers missing": [put(R, "teachers", to={})],
    "teachers with NaN": [array(f"{R}/teachers/network/first.weight", number(np.nan))],
    "teachers of other sizes": [array(f"{R}/teachers/network/first.weight", lambda weight: weight[:, :1])],
    "teachers whose moments have NaN": [array(f"{R}/teachers/optimizer/state/1/exp_avg", number(np.nan))],
    "teachers whose moments are negative": [array(f"{R}/teachers/optimizer/state/1/exp_avg_sq", number(-1e-9))],
}
PER = {
    "td_errors with NaN": [array(f"{R}/td_errors", number(np.nan))],
    "td_errors negative": [array(f"{R}/td_errors", number(-1))],
    "td_errors fewer": [array(f"{R}/td_errors", lambda errors: errors[1:])],
    "td_errors of floats": [array(f"{R}/td_errors", lambda errors: errors.astype(np.float32))],
    "td_errors a list": [put(R, "td_errors", to=[1.0] * 30)],
}
DISCRETE = {
    "choices beyond the last": [array(f"{T}/actions", number(4))],
    "choices negative": [array(f"{T}/actions", number(-1))],
    "choices of floats": [array(f"{T}/actions", lambda actions: actions.astype(np.float32))],
}
OF_EVERY_BUFFER = [
    *(pytest.param(name, edits, id=f"{name}: {what}") for name in ("maddpg", "kfcv") for what, edits in BUFFER.items()),
    *(pytest.param("kfcv", edits, id=what) for what, edits in KFCV.items()),
    *(pytest.param("per", edits, id=what) for what, edits in PER.items()),
    *(pytest.param("discrete", edits, id=what) for what, edits in DISCRETE.items()),
]


@pytest.fixture(scope="module")
def trained():
    """A model of every algorithm whose buffer holds something."""
    return {name: make(name, seed=1).learn(20) for name in ALGORITHMS}


@pytest.mark.parametrize(("name", "edits"), OF_EVERY_BUFFER)
def test_crafted_replay_buffers_are_refused_and_change_nothing(runs, trained, name, edits, tmp_path):
    path = tampered(runs[name]["buffer"], tmp_path / "buffer.zip", *edits)
    model = trained[name]
    before = snapshot(model)
    said = refused(path, model.load_replay_buffer)
    assert "replay_buffer" in said or "transitions" in said
    assert_unchanged(model, before)


@pytest.mark.parametrize("name", ["maddpg", "kfcv", "per"])
def test_a_buffer_of_many_worlds_that_holds_nothing_takes_no_memory(runs, trained, name, tmp_path):
    """Arrays of no steps may claim any number of worlds."""
    none = every(lambda rows: np.zeros((0, 10**9, *rows.shape[2:]), rows.dtype))
    none += [array(f"{T}/{name}/rows", lambda rows: rows[:0].copy()) for name in ("next_observations", "next_states")]
    edits = [put(R, "n_added", to=0), put(R, "n_envs", to=10**9), *none]
    path = tampered(runs[name]["buffer"], tmp_path / "buffer.zip", *edits)
    before = snapshot(trained[name])
    with within_memory(150e6):
        try:
            trained[name].load_replay_buffer(path)
        except FileFormatError as error:
            assert_one_sentence(error, path)
            assert_unchanged(trained[name], before)
        else:
            assert trained[name].replay_buffer.n_rows == 0
            trained[name].load_replay_buffer(runs[name]["buffer"])


# ---- checkpoints

PIECES = ("training", "transitions")
CHECKPOINT = {
    "a piece outside": [put(*PIECES, 0, "first", to="../../x")],
    "a piece of another checksum": [put(*PIECES, 0, "sha256", to="0" * 64)],
    "a piece without a checksum": [drop(*PIECES, 0, "sha256")],
    "a piece with more": [put(*PIECES, 0, "path", to="/etc/passwd")],
    "a piece that is not there": [put(*PIECES, 0, "first", to=5)],
    "pieces that are none": [put(*PIECES, to=5)],
    "no training": [raw("training.json", b"{}")],
    "steps of a text": [put(A, "num_timesteps", to="many")],
    **{f"JSON: {name}": [raw("training.json", data)] for name, data in NOT_JSON.items()},
}


@parametrized(CHECKPOINT)
def test_crafted_checkpoints_are_refused(runs, edits):
    source = runs["kfcv"]["checkpoint"]
    path = tampered(source, source.with_name("rl_model_99_steps.zip"), *edits)
    with pytest.raises(FileFormatError) as caught:
        Checkpoint(path)
    assert str(caught.value).startswith(str(path.parent))
    path.unlink()


@pytest.mark.parametrize("pos", [2**31 - 1, 625, -1, "1"])
def test_a_generator_beyond_its_numbers_is_refused(trained, pos):
    """NumPy would read on behind them."""
    state = random_state(trained["kfcv"])
    state["numpy"]["state"]["pos"] = pos
    with pytest.raises(ValueError, match="NumPy's generator"):
        set_random_state(trained["kfcv"], state)


# ---- teams and players

OPPONENT = (A, "opponents", "tank")
OPPONENT_ARRAYS = "attributes/opponents/tank"


def make_teams(**settings):
    """Co-training of a few dozen weights against its own past."""
    own = {"learning_starts": 10, "batch_size": 8, "buffer_size": 50, "policy_kwargs": {"net_arch": [4]}}
    teams = {"scout": {"algo": "kfcv_maddpg", **own, "replay_buffer_kwargs": CURRICULUM}, "tank": {"algo": "maddpg", **own}}
    return CoTraining("MlpPolicy", toy(), teams, seed=0, device="cpu", pool_share=0.5, pool_freq=10, **settings)


@pytest.fixture(scope="module")
def players(tmp_path_factory):
    """Files of a team against a saved opponent, of a mixture of such, of a co-training, and of a player alone."""
    folder = tmp_path_factory.mktemp("players")
    saved = ActorPolicy.of(make("maddpg").policy)
    saved.save(folder / "player.zip")
    for name, opponent in (("saved", saved), ("mixed", Mixture([saved, "random"], [2, 1]))):
        make("maddpg", team="scout", opponents={"tank": opponent}).save(folder / name)
    teams = make_teams()
    teams.learn(30, Checkpoints(folder / "run", save_freq=12))
    teams.save(folder / "teams")
    return folder


SOMEBODY = "PLAYER.zip"  # stands for the path of a file that would do
OPPONENTS = {
    **{"a path": SOMEBODY, "no file": "other.zip", "a number": 3, "nobody": None, "a class": named("MlpPolicy")},
    **{"a map of paths": {SOMEBODY: 1}, "a list of paths": [SOMEBODY], "a list": ["random", "random"]},
    **{"a tuple": {"$": "tuple", "items": [SOMEBODY]}, "a space": {"$": "MultiDiscrete", "nvec": named("relu")}},
    **{"a queue": {"$": "deque", "items": ["random"], "maxlen": None}, "a schedule": {"$": "ConstantSchedule", "val": 1}},
    **{
        f"a mixture of {what}": {"$": "Mixture", "players": players, "weights": weights}
        for what, players, weights in (
            *(("a path", [SOMEBODY], [1]), ("nobody", [], []), ("numbers", [3], [1]), ("a text", "random", [1])),
            *(("few weights", ["random"], []), ("no weight", ["random"], [0]), ("less", ["random"], [-1])),
            *(("weights of texts", ["random"], ["1"]), ("weights of lists", ["random"], [[1]])),
            *(("a mixture", [{"$": "Mixture", "players": ["random"], "weights": [1]}], [1]), ("maps", [{}], [1])),
            *(("lists", [[SOMEBODY]], [1]), ("unknown scripts", ["chase"], [1])),
        )
    },
    "a mixture of more": {"$": "Mixture", "players": ["random"], "weights": [1], "rng": 1},
}


@pytest.mark.parametrize("what", OPPONENTS)
def test_crafted_opponents_are_none(players, what, tmp_path):
    """A file has no say about other files, even where they would do."""
    text = json.dumps(OPPONENTS[what]).replace(SOMEBODY, str(players / "player.zip"))
    edit = put(*OPPONENT, to=json.loads(text))
    assert "attributes" in refused(tampered(players / "saved.zip", tmp_path / "model.zip", edit), ALGORITHMS["maddpg"].load)


def of_every_player(section, *place, arrays):
    """What can be wrong with actors in a file, at their place in it."""

    def whole(value):
        return put(section, *place, to=value) if place else raw(f"{section}.json", json.dumps(value).encode())

    weight = f"{arrays}/parameters/stacks.0.first.weight"
    return {
        **{f"without {name}": [drop(section, *place, name)] for name in ("layout", "agents", "net_arch", "parameters")},
        "more": [put(section, *place, "run", to="rm")],
        "nothing": [whole(None)],
        "a map": [whole({})],
        "a text": [whole("x.zip")],
        "a layout": [put(section, *place, "$", to="AgentLayout")],
        "weights with NaN": [array(weight, number(np.nan))],
        "weights beyond all numbers": [array(weight, number(np.inf))],
        "weights of another shape": [array(weight, lambda values: values[:, :1].copy())],
        "weights of another type": [array(weight, lambda values: values.astype(np.float64))],
        "weights of nothing": [array(weight, lambda values: values[:0].copy())],
        "weights of another name": [put(section, *place, "parameters", "other", to={"$": "tensor", "name": f"{weight}.npy"})],
        "parameters that are none": [put(section, *place, "parameters", to=[1])],
        "parameters of a text": [put(section, *place, "parameters", "stacks.0.first.weight", to="1")],
        "no parameters": [put(section, *place, "parameters", to={})],
        "nobody": [put(section, *place, "agents", to=[])],
        "an agent beyond": [put(section, *place, "agents", to=[0, 1, 2, 3])],
        "an agent before": [put(section, *place, "agents", to=[-1, 0, 1])],
        "an agent twice": [put(section, *place, "agents", to=[0, 0, 1, 2])],
        "an agent of a text": [put(section, *place, "agents", to=["0"])],
        "agents that are a number": [put(section, *place, "agents", to=3)],
        "agents in another order": [put(section, *place, "agents", to=[2, 1, 0])],
        "fewer agents": [put(section, *place, "agents", to=[0, 1])],
        "another layout": [put(section, *place, "layout", "obs_sizes", to=[3, 2, 3])],
        "a huge layout": [put(section, *place, "layout", "obs_sizes", to=[HUGE, 3, 2])],
        "huge layers": [put(section, *place, "net_arch", to=[10**9, 10**9])],
        "large layers": [put(section, *place, "net_arch", to=[30_000])],
        "100,000 layers": [put(section, *place, "net_arch", to=[1] * 100_000)],
        "layers of nothing": [put(section, *place, "net_arch", to=[0])],
        "layers of a text": [put(section, *place, "net_arch", to="4")],
        "layers of halves": [put(section, *place, "net_arch", to=[4.5])],
        "an activation that is a loss": [put(section, *place, "activation_fn", to=named("adam"))],
        "an activation that is a text": [put(section, *place, "activation_fn", to="relu")],
        "an activation that no one knows": [put(section, *place, "activation_fn", to=named("os.system"))],
        "sharing perhaps": [put(section, *place, "share_parameters", to="no")],
        "sharing": [put(section, *place, "share_parameters", to=True)],
        "spaces upside down": [array(f"{arrays}/action_space/low", lambda low: 3 - low)],
    }


@parametrized(of_every_player("player", arrays="player") | {"JSON": [raw("player.json", b"[")]})
def test_crafted_players_are_refused(players, edits, tmp_path):
    path = tampered(players / "player.zip", tmp_path / "player.zip", *edits)
    with within_memory(150e6):
        refused(path, load_player)
        refused(path, ActorPolicy.load)


@parametrized(of_every_player(*OPPONENT, arrays=OPPONENT_ARRAYS))
def test_crafted_opponents_are_refused(players, edits, tmp_path):
    with within_memory(150e6):
        refused(tampered(players / "saved.zip", tmp_path / "model.zip", *edits), ALGORITHMS["maddpg"].load)


MIXED = (*OPPONENT, "players", 0)


@parametrized(of_every_player(*MIXED, arrays=f"{OPPONENT_ARRAYS}/players/0"))
def test_crafted_players_of_mixtures_are_refused(players, edits, tmp_path):
    refused(tampered(players / "mixed.zip", tmp_path / "model.zip", *edits), ALGORITHMS["maddpg"].load)


S = "teams"
TEAM_SECTIONS = {
    "nothing": [raw("teams.json", b"{}")],
    "no section": [lambda members: members.pop("teams.json")],
    "a list": [raw("teams.json", b'["scout", "tank"]')],
    "a text": [raw("teams.json", b'"scout"')],
    "null": [raw("teams.json", b"null")],
    "one team": [drop(S, "tank")],
    "more teams": [put(S, "wall", to={})],
    "the teams in another order": [lambda members: put_first(members, "tank")],
    "a team of nothing": [put(S, "tank", to={})],
    "a team of null": [put(S, "tank", to=None)],
    "a team of a list": [put(S, "tank", to=[["algorithm", "MADDPG"]])],
    "a team of a player": [put(S, "tank", to={"$": "Mixture", "players": ["random"], "weights": [1]})],
    "another algorithm": [put(S, "tank", "algorithm", to="PERMADDPG")],
    "an algorithm of a list": [put(S, "tank", "algorithm", to=["MADDPG"])],
    **{
        f"without {name}": [drop(S, "tank", name)] for name in ("algorithm", "layout", "action_space", "n_envs", "buffer_size")
    },
    **{
        f"{name} shadows what the model makes": [put(S, "tank", name, to=1)]
        for name in (
            "policy",
            "actor",
            "critic_target",
            "_watch",
            "_opponent_policy",
            "agents",
            "_parameters",
            "replay_buffer",
        )
    },
    **{f"{name} shadows a method": [put(S, "tank", name, to=1)] for name in ("predict", "train", "__class__")},
    **{
        f"another {name}": [put(S, "tank", name, to=value)]
        for name, value in {
            **{"team": "scout", "critic_input": "state", "share_parameters": True, "stores_state": True, "buffer_size": 49},
            **{"policy_kwargs": {"net_arch": [5]}, "policy_class": named("relu"), "replay_buffer_kwargs": {"seed": 3}},
            **{"gamma": 2, "tau": "x", "n_envs": 0, "num_timesteps": -1, "action_noise": 3, "batch_size": 0},
            **{"learning_rate": "lin_x", "opponents": {"scout": "x.zip"}, "_last_obs": [1], "_episode_metrics": 3},
        }.items()
    },
    "another layout": [put(S, "tank", "layout", "groups", to=["scout", "tank", "tank"])],
    "another space": [array("teams/tank/action_space/high", lambda high: 2 * high)],
    "a team that is no group": [put(A, "teams", to={"wall": {"algo": "maddpg"}})],
    "an algorithm that is a path": [put(A, "teams", "tank", "algo", to="x.zip")],
    "an algorithm that is a class": [put(A, "teams", "tank", "algo", to=named("relu"))],
    "settings that are none": [put(A, "teams", "tank", to=[1])],
    "settings of the whole": [put(A, "teams", "tank", "opponents", to={"scout": "x.zip"})],
    "opponents of a team": [put(A, "opponents", to={"tank": "x.zip"})],
    "past selves in half": [put(A, "pool_share", to=1.5)],
    **{f"JSON: {name}": [raw("teams.json", data)] for name, data in NOT_JSON.items()},
}


def put_first(members, team):
    teams = json.loads(members["teams.json"])
    members["teams.json"] = json.dumps({team: teams.pop(team), **teams}).encode()


@parametrized(TEAM_SECTIONS)
def test_crafted_sections_of_teams_are_refused(players, edits, tmp_path):
    refused(tampered(players / "teams.zip", tmp_path / "teams.zip", *edits), CoTraining.load)


@pytest.mark.parametrize("what", ["layers", "a buffer", "a pool of junk", "a pool of others", "a pool of minus", "opponents"])
def test_crafted_checkpoints_of_teams_are_refused(players, what, tmp_path):
    pool = ("training", "learner", "pools", "tank")
    edits = {
        "layers": [put(A, "teams", "tank", "policy_kwargs", "net_arch", to=[10**6] * 3)],
        "a buffer": [put("replay_buffer", "teams", to={})],
        "a pool of junk": [put(*pool, "past", to=["random"] * 3)],
        "a pool of others": [lambda members: exchange(members, "scout", "tank")],
        "a pool of minus": [array("/".join((*pool, "games")), lambda games: games - 9)],
        "opponents": [put(A, "opponents", to={"wall": "other.zip"})],
    }
    shutil.copytree(players / "run", tmp_path / "run")
    path = tmp_path / "run" / "rl_model_30_steps.zip"
    tampered(path, path, *edits[what])
    with within_memory(150e6), pytest.raises(ValueError) as caught:
        make_teams().learn(60, Checkpoints(tmp_path / "run", 12, resume=True))
    assert "rl_model_30_steps.zip" in str(caught.value) and "\n" not in str(caught.value)


def exchange(members, one, other):
    """The pools of two teams, each in the other's place."""
    training = json.loads(members["training.json"])
    pools = training["learner"]["pools"]
    pools[one], pools[other] = pools[other], pools[one]
    members["training.json"] = json.dumps(training).encode()


def test_a_file_of_several_learners_gives_no_player_of_junk(players, tmp_path):
    for edit in (raw("teams.json", b"[1]"), put(S, "tank", to={}), put(S, "tank", "layout", to=3), drop(P, "policy.1")):
        refused(tampered(players / "teams.zip", tmp_path / "teams.zip", edit), lambda path: load_player(path, "tank"))


# ---- statistics of normalised worlds

N = "normalization"
NORMALIZATION = {
    "a negative variance": [array(f"{N}/var", number(-1))],
    "a variance with NaN": [array(f"{N}/var", number(np.nan))],
    "a mean of other observations": [array(f"{N}/mean", lambda mean: mean[1:])],
    "a mean of null": [put(N, "mean", to=None)],
    "a negative count": [put(N, "count", to=-1)],
    "a count of a text": [put(N, "count", to="1")],
    "no count": [drop(N, "count")],
    "a list": [raw("normalization.json", b"[]")],
    "NaN": [raw("normalization.json", NOT_JSON["NaN"])],
}


@parametrized(NORMALIZATION)
def test_crafted_statistics_are_refused(normalized, edits, tmp_path):
    path = tampered(normalized, tmp_path / "model.zip", *edits)
    said = refused(path, lambda path: load_normalization(path, DummyVecEnv([toy]), training=False))
    assert N in said


@pytest.fixture(scope="module")
def normalized(tmp_path_factory):
    """A model of worlds whose observations are normalised."""
    path = tmp_path_factory.mktemp("normalized") / "model.zip"
    make("maddpg", env=VecNormalize(DummyVecEnv([toy]), norm_reward=False)).save(path)
    load_normalization(path, DummyVecEnv([toy]), training=False)
    return path


# ---- members and arrays

ARRAYS = {
    "an object": lambda _: npy(np.array([None])),
    "an object without its pickle": lambda _: npy_header("|O", "(1,)") + b"\0" * 8,
    "a structure": lambda _: npy(np.zeros(2, [("a", "<f4"), ("b", "<i4")])),
    "texts": lambda _: npy(np.array(["abc"])),
    "bytes": lambda _: npy(np.array([b"abc"])),
    "dates": lambda _: npy(np.array(["2020-01-01"], dtype="M8[s]")),
    "complex numbers": lambda _: npy(np.zeros(2, complex)),
    "long doubles": lambda _: npy(np.zeros(2, np.longdouble)),
    "big-endian": lambda _: npy(np.zeros(2, ">f4")),
    "floats of one byte": lambda _: npy_header("<f1", "(3,)") + bytes(3),
    "booleans of four bytes": lambda _: npy_header("<b4", "(3,)") + bytes(12),
    "in Fortran's order": lambda _: npy(np.asfortranarray(np.zeros((2, 3)))),
    "a negative axis": lambda _: npy_header("<f4", "(-3,)") + bytes(12),
    "two negative axes": lambda _: npy_header("<f4", "(-3, -1)") + bytes(12),
    "10**12 numbers": lambda _: npy_header("<f4", f"({HUGE},)") + bytes(12),
    "10**12 numbers as a product": lambda _: npy_header("<f4", "(1000000, 1000000)") + bytes(12),
    "2**64 numbers": lambda _: npy_header("<f4", f"({2**64},)") + bytes(12),
    "sizes that overflow to what is there": lambda _: npy_header("<f4", f"({2**62}, 4)") + bytes(12),
    "a huge axis beside an empty one": lambda _: npy_header("<f4", f"(0, {10**17}, {10**17})"),
    "a thousand axes": lambda _: npy_header("<f4", f"({'1, ' * 1000})") + bytes(4),
    "an axis that is computed": lambda _: npy_header("<f4", "(10**12,)") + bytes(12),
    "an axis of a float": lambda _: npy_header("<f4", "(3.0,)") + bytes(12),
    "an axis that is yes": lambda _: npy_header("<f4", "(True,)") + bytes(4),
    "a call": lambda marker: npy_header("<f4", f"(__import__('os').mkdir({str(marker)!r}),)") + bytes(12),
    "brackets": lambda _: npy_header("<f4", "(" * 5000),
    "digits": lambda _: npy_header("<f4", f"({'1' * 60_000}x,)"),
    "a header that is longer than all": lambda _: b"\x93NUMPY\x01\x00\xff\xff{'descr'",
    "version 2 of its header": lambda _: npy_header().replace(b"\x01\x00", b"\x02\x00\x00\x00", 1) + bytes(12),
    "version 9 of its header": lambda _: npy_header().replace(b"\x01\x00", b"\x09\x00", 1) + bytes(12),
    "numbers missing": lambda _: npy_header("<f4", "(4,)") + bytes(12),
    "numbers too many": lambda _: npy_header("<f4", "(2,)") + bytes(12),
    "nothing": lambda _: b"",
    "JSON": lambda _: b"[1, 2, 3]",
    "a pickle": lambda marker: pickle.dumps(Evil(marker)),
    "a pickle in an array": lambda marker: npy(np.array([Evil(marker)], dtype=object)),
}


@pytest.mark.parametrize("what", ARRAYS)
def test_crafted_arrays_are_refused(runs, trained, what, tmp_path):
    marker = tmp_path / "marker"
    data = ARRAYS[what](marker)
    for name, member, read in (
        ("model", "attributes/_last_obs.npy", KFCVMADDPG.load),
        ("model", f"{WEIGHT}.npy", trained["kfcv"].set_parameters),
        ("buffer", "transitions/rewards.npy", trained["kfcv"].load_replay_buffer),
    ):
        path = tampered(runs["kfcv"][name], tmp_path / "file.zip", raw(member, data))
        with within_memory(150e6):
            said = refused(path, read)
        assert member.removesuffix(".npy").split("/")[-1] in said
    assert not marker.exists()


NAMES = (
    "../x",
    "/etc/x",
    "..",
    "a/../../x",
    "a\\b",
    "C:x",
    "C:/x",
    "a//b",
    "a/",
    "./a",
    ".a",
    "~x",
    "a b",
    "ä",
    "",
    "a\nb",
    "-x",
)


@pytest.mark.parametrize("name", NAMES, ids=repr)
def test_members_of_other_names_are_refused(runs, name, tmp_path):
    members = [*with_manifest({**members_of(runs["kfcv"]["model"]), name: b"x"}).items()]
    path = write_members(tmp_path / "model.zip", members)
    assert f"holds a member that is not allowed: {name!r}" in refused(path, KFCVMADDPG.load)


def test_a_member_that_stands_twice_is_refused(runs, tmp_path):
    members = members_of(runs["kfcv"]["model"])
    for name in ("attributes.json", MANIFEST, f"{WEIGHT}.npy"):
        path = write_members(tmp_path / "model.zip", [*members.items(), (name, members[name])])
        assert "twice" in refused(path, KFCVMADDPG.load)


@pytest.mark.parametrize("compression", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_what_is_compressed_is_never_unfolded(runs, compression, tmp_path):
    """Zeros unfold a thousandfold; neither are they while it is asked what of a damaged file is damaged."""
    path = write_members(tmp_path / "model.zip", members_of(runs["kfcv"]["model"]), compression)
    assert "not allowed" in refused(path, KFCVMADDPG.load)
    path = write_members(tmp_path / "bomb.zip", {MANIFEST: bytes(5 * 10**7)}, compression)
    with within_memory(30e6):
        assert "not allowed" in refused(path, KFCVMADDPG.load)
        path.write_bytes(path.read_bytes()[:-1] + b"x")
        refused(path, KFCVMADDPG.load)


def directory_entries(data):
    """Where the entries of the zip directory begin."""
    start = struct.unpack("<I", data[-22 - 71 :][16:20])[0]
    found = []
    while data.startswith(b"PK\x01\x02", start):
        found.append(start)
        start += 46 + sum(struct.unpack("<HHH", data[start + 28 : start + 34]))
    return found


DIRECTORY = {
    "a size beyond the file": [(20, struct.pack("<II", 2**31, 2**31))],
    "a size of one more": [(20, lambda size: size + 1), (24, lambda size: size + 1)],
    "another size unfolded": [(24, struct.pack("<I", 2**31))],
    "at the place of another": [(42, lambda offset: 0 if offset else 3700)],
    "beside its place": [(42, lambda offset: offset + 1)],
    "outside of the file": [(42, struct.pack("<I", 2**31))],
    "inside of another": [(42, lambda offset: offset - 40)],
    "encrypted": [(8, b"\x01\x00")],
    "strongly encrypted": [(8, b"\x41\x00")],
    "patched": [(8, b"\x20\x00")],
    "compressed": [(10, b"\x08\x00")],
    "compressed by no one knows what": [(10, b"\x63\x00")],
    "of a version to come": [(6, b"\xff\x00")],
    "of another name": [(46, b"b")],
    "of a name that ends early": [(50, b"\x00")],
    "of another checksum": [(16, b"\x00\x00\x00\x00")],
}


@pytest.mark.parametrize("change", DIRECTORY)
@pytest.mark.parametrize("which", [0, 5, -1], ids=["first", "inner", "last"])
def test_a_crafted_zip_directory_is_refused(runs, change, which, tmp_path):
    data = bytearray(runs["kfcv"]["model"].read_bytes())
    entry = directory_entries(data)[which]
    for offset, value in DIRECTORY[change]:
        if callable(value):
            value = struct.pack("<I", value(struct.unpack("<I", data[entry + offset :][:4])[0]) % 2**32)
        data[entry + offset : entry + offset + len(value)] = value
    path = write_sealed(tmp_path / "model.zip", bytes(data))
    with within_memory(100e6):
        refused(path, KFCVMADDPG.load)


def test_a_zip_directory_that_ends_early_is_refused(runs, tmp_path):
    data = bytearray(runs["kfcv"]["model"].read_bytes())
    end = len(data) - 71 - 22
    for offset, value in (
        (8, b"\x00\x00"),
        (10, b"\xff\xff"),
        (12, bytes(4)),
        (12, b"\xff" * 4),
        (16, bytes(4)),
        (16, b"\xff" * 4),
    ):
        changed = bytearray(data)
        changed[end + offset : end + offset + len(value)] = value
        path = write_sealed(tmp_path / "model.zip", bytes(changed))
        try:
            KFCVMADDPG.load(path)
        except FileFormatError as error:
            assert_one_sentence(error, path)
        else:
            assert offset in (8, 10)  # the number of members, which no one reads


MANIFESTS = {
    "a list": lambda manifest: [],
    "null": lambda manifest: None,
    "of another format": lambda manifest: {**manifest, "format": "sb3"},
    "of no format": lambda manifest: {**manifest, "format": None},
    "of another kind": lambda manifest: {**manifest, "kind": "policy"},
    "of a kind that is a list": lambda manifest: {**manifest, "kind": ["model"]},
    "without members": lambda manifest: {**manifest, "members": {}},
    "of members that are a list": lambda manifest: {**manifest, "members": list(manifest["members"])},
    "of one member more": lambda manifest: {**manifest, "members": manifest["members"] | {"x": {"bytes": 1}}},
    "of one member less": lambda manifest: {**manifest, "members": dict([*manifest["members"].items()][1:])},
    "of other sizes": lambda manifest: {**manifest, "members": {name: {"bytes": 7} for name in manifest["members"]}},
    "of no sizes": lambda manifest: {**manifest, "members": dict.fromkeys(manifest["members"])},
}


@pytest.mark.parametrize("what", [*MANIFESTS, *NOT_JSON])
def test_a_crafted_manifest_is_refused(runs, what, tmp_path):
    members = with_manifest(members_of(runs["kfcv"]["model"]))
    if what in NOT_JSON:
        members[MANIFEST] = NOT_JSON[what]
    else:
        members[MANIFEST] = json.dumps(MANIFESTS[what](json.loads(members[MANIFEST]))).encode()
    path = write_members(tmp_path / "model.zip", members)
    refused(path, KFCVMADDPG.load)
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))  # nor does it matter where the seal does not fit
    refused(path, KFCVMADDPG.load)


def test_a_file_without_a_manifest_is_refused(runs, tmp_path):
    members = members_of(runs["kfcv"]["model"])
    members.pop(MANIFEST)
    assert f"lacks {MANIFEST}" in refused(write_members(tmp_path / "model.zip", members), KFCVMADDPG.load)


def test_a_message_stays_short_whatever_the_file_says(runs, tmp_path):
    for edit in (put(A, "algorithm", to="x" * 10**5), put(A, "gamma", to="\n" * 10**5), put(A, "x" * 10**5, to={"$": 1})):
        refused(tampered(runs["kfcv"]["model"], tmp_path / "model.zip", edit), KFCVMADDPG.load)


# ---- whatever a file says

WORDS = sorted(
    {
        *(name for thing in (KFCVMADDPG, KFCVReplayBuffer, MlpPolicy) for name in inspect.signature(thing).parameters),
        *dir(KFCVMADDPG),
        *vars(make()),
        *values.NAMES,
        *("$", "", "state", "items", "optimizer_class", "epsilon", "train", "PCG64", "step", "episode", "lin_1e-3"),
    }
)
NUMBERS = st.sampled_from([0, 1, -1, 2, 3, 7, 255, 2**31, 2**63, HUGE, 10**30, 0.5, -0.0, 1e-300, 1e30, 1e300, -1e300, True])
TAGS = sorted([*values.BUILT_IN, *values.KINDS])
FIELDS = [
    "name",
    "of",
    "value",
    "dtype",
    "items",
    "maxlen",
    "low",
    "high",
    "nvec",
    "mean",
    "sigma",
    "val",
    "base_noise",
    "noises",
]
JUNK = st.recursive(
    st.none()
    | st.booleans()
    | NUMBERS
    | st.sampled_from(WORDS)
    | st.text(max_size=3)
    | st.sampled_from(sorted(values.NAMES)).map(named)
    | st.sampled_from(["nan", "inf", "-inf"]).map(lambda value: {"$": "float", "value": value}),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from(WORDS), inner, max_size=3),
        st.builds(
            lambda tag, fields: {"$": tag, **fields}, st.sampled_from(TAGS), st.dictionaries(st.sampled_from(FIELDS), inner)
        ),
    ),
    max_leaves=5,
)


def places_in(document):
    """Every value of a JSON document, as the container that holds it and its key there."""
    for key in document if isinstance(document, dict) else range(len(document)):
        yield document, key
        if isinstance(document[key], (dict, list)):
            yield from places_in(document[key])


def edit_json(draw, members, name):
    try:
        document = [json.loads(members[name])]  # in a list, so that it can be replaced itself
    except ValueError:  # where an edit before has spoiled it
        return
    places = [*places_in(document)]
    where, key = draw(st.sampled_from(places))
    what = draw(st.sampled_from(["replace", "replace", "nudge", "delete", "insert", "swap"]))
    value = where[key]
    if what == "nudge" and type(value) in (int, float):
        where[key] = draw(st.sampled_from([value + 1, value - 1, -value, value * 2, value / 2, str(value), [value]]))
    elif what == "delete" and len(places) > 1:
        del where[key]
    elif what == "insert" and isinstance(value, dict):
        value[draw(st.sampled_from(WORDS))] = draw(JUNK)
    elif what == "insert" and isinstance(value, list):
        value.insert(draw(st.integers(0, len(value))), draw(JUNK))
    elif what == "swap":
        other, place = draw(st.sampled_from(places))
        where[key] = copy.deepcopy(other[place])
    else:
        where[key] = draw(JUNK)
    members[name] = json.dumps(document[0] if document else None).encode()


def edit_array(draw, members, name):
    data = bytearray(members[name])
    what = draw(st.sampled_from(["number", "number", "type", "shape", "bytes", "header", "cut", "more", "swap"]))
    if what in ("number", "type", "shape"):
        with suppress(Exception), np.errstate(all="ignore"):  # numpy raises anything where it is spoiled already
            data = npy(change_of(draw, what, np.load(io.BytesIO(data))))
    elif what == "bytes":
        for place in draw(st.lists(st.integers(0, len(data) - 1), min_size=1, max_size=4)):
            data[place] = draw(st.integers(0, 255))
    elif what == "header":
        texts = ["(3,)", "()", "(-1,)", f"({HUGE},)", "(0,)", "(1, 1)", "None", "(2**9,)", "('3',)"]
        descr = draw(st.sampled_from(["<f4", "<f8", "|O", ">f4", "<i8", "|b1", "<f2", "<c8", "<M8[s]", "<V4"]))
        data = npy_header(descr, draw(st.sampled_from(texts)), draw(st.sampled_from(["False", "True", "0"]))) + data[128:]
    elif what == "cut":
        data = data[: draw(st.integers(0, len(data) - 1))]
    elif what == "more":
        data += bytes(draw(st.integers(1, 9)))
    elif what == "swap":
        data = members[draw(st.sampled_from(sorted(members)))]
    members[name] = bytes(data)


def change_of(draw, what, numbers):
    if what == "type":
        return numbers.astype(draw(st.sampled_from(["?", "i1", "i4", "i8", "u8", "f2", "f4", "f8", ">f4", "O", "U3"])))
    if what == "shape":
        table = np.atleast_1d(numbers)
        changes = [table.ravel(), table[None], table[..., None], table.T, table[:0], np.tile(table, 2), table.sum()]
        return changes[draw(st.integers(0, len(changes) - 1))]
    if numbers.size:
        one = draw(st.sampled_from([np.nan, np.inf, -np.inf, -1.0, 0.0, 1.0, 2.0, 1e30, -1e30, 1e-40, 100.0]))
        numbers.flat[draw(st.integers(0, numbers.size - 1))] = np.array(one).astype(numbers.dtype)
    return numbers


def edited(draw, source):
    """The members of a real file after one to three edits."""
    members = members_of(source)
    for _ in range(draw(st.integers(1, 3))):
        name = draw(st.sampled_from([name for name in members if name.endswith(".json")] * 8 + sorted(members)))
        what = draw(st.sampled_from(["edit"] * 18 + ["drop", "add"]))
        if what == "drop" and name != MANIFEST:
            members.pop(name)
        elif what == "add":
            members[draw(st.sampled_from(["more.json", "more.npy", "attributes/more.npy", "data.pkl"]))] = members[name]
        elif name.endswith(".json"):
            edit_json(draw, members, name)
        elif name.endswith(".npy") and members[name]:
            edit_array(draw, members, name)
    try:
        return with_manifest(members)
    except (TypeError, ValueError, AttributeError):  # the manifest itself is none any more
        return members


def refused_or_read(read, path):
    """What reading gives, or ``None`` if the file is refused as it should be; within a gigabyte and five seconds."""
    start = time.process_time()
    try:
        with within_memory(1e9):
            return read(path)
    except FileFormatError as error:
        assert_one_sentence(error, path)
        return None
    finally:
        assert time.process_time() - start < 5


def check_any_model(draw, runs):
    name = draw(st.sampled_from(sorted(runs)))
    source = runs[name][draw(st.sampled_from(["model", "checkpoint"]))]
    path = write_members(source.parents[1] / "fuzzed.zip", edited(draw, source))
    model = refused_or_read(ALGORITHMS[name].load, path)
    if model is not None:
        rows = np.random.default_rng(0).normal(size=(3, model.observation_space.shape[0])).astype(np.float32)
        for deterministic in (True, False):
            actions, _ = model.predict(rows, deterministic=deterministic)
            assert actions.shape == (3, *model.action_space.shape)
            weights = th.cat([parameter.flatten() for parameter in model.actor.parameters()])
            if weights.abs().max() < 1e6:  # beyond, sums of finite numbers are not finite
                assert np.isfinite(actions).all()
                assert all(model.action_space.contains(action) for action in actions)


def check_any_buffer(draw, runs):
    name = draw(st.sampled_from(sorted(runs)))
    source = runs[name]["buffer"]
    path = write_members(source.with_name("fuzzed.zip"), edited(draw, source))
    model = make(name)
    before = snapshot(model)

    def load(path):
        model.load_replay_buffer(path)
        return True

    if not refused_or_read(load, path):
        assert_unchanged(model, before)
    elif model.replay_buffer.n_rows:
        batch = model.replay_buffer.sample(8)
        assert all(th.isfinite(part).all() for part in batch if th.is_tensor(part))
        model.set_logger(Logger(None, []))
        with suppress(NonFiniteError):  # of finite numbers whose squares are not
            model.train(1, 8)
        model.replay_buffer.diagnostics()


def check_any_bytes(draw, runs):
    """The zip itself: its headers, its directory, its end."""
    source = runs["kfcv"][draw(st.sampled_from(["model", "buffer"]))]
    whole = source.read_bytes()
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 3))):
        last = len(data) - 72  # before the seal
        directory = max(data.find(b"PK\x01\x02"), 0)
        place = draw(st.integers(0, 200) | st.integers(min(directory, last), last) | st.integers(last - 40, last))
        what = draw(st.sampled_from(["put", "put", "cut", "more", "copy"]))
        n = draw(st.integers(1, 4) | st.integers(1, 3000))
        if what == "put":
            data[place : place + min(n, 4)] = draw(st.binary(min_size=min(n, 4), max_size=min(n, 4)))
        elif what == "cut":
            del data[place : min(place + n, last)]
        elif what == "more":
            data[place:place] = bytes(n)
        else:
            other = draw(st.integers(0, last))
            data[place:place] = data[other : min(other + n, last)]
        if len(data) < 400:
            break
    path = write_sealed(source.with_name("fuzzed.zip"), bytes(data))
    refused_or_read(KFCVMADDPG.load, path)
    refused_or_read(make().load_replay_buffer, path)
    if data != whole:
        path.write_bytes(data)  # not sealed anew
        refused(path, KFCVMADDPG.load)


FEW = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}


@settings(max_examples=100, derandomize=True, **FEW)
@given(data=st.data())
def test_a_model_of_any_edits_is_refused_or_acts(runs, data):
    check_any_model(data.draw, runs)


@settings(max_examples=60, derandomize=True, **FEW)
@given(data=st.data())
def test_a_replay_buffer_of_any_edits_is_refused_or_serves(runs, data):
    check_any_buffer(data.draw, runs)


@settings(max_examples=60, derandomize=True, **FEW)
@given(data=st.data())
def test_a_zip_of_any_edits_is_refused_or_read(runs, data):
    check_any_bytes(data.draw, runs)


@pytest.mark.expensive
@settings(max_examples=4000, **FEW)
@given(data=st.data())
def test_models_of_many_edits_are_refused_or_act(runs, data):
    check_any_model(data.draw, runs)


@pytest.mark.expensive
@settings(max_examples=3000, **FEW)
@given(data=st.data())
def test_replay_buffers_of_many_edits_are_refused_or_serve(runs, data):
    check_any_buffer(data.draw, runs)


@pytest.mark.expensive
@settings(max_examples=4000, **FEW)
@given(data=st.data())
def test_zips_of_many_edits_are_refused_or_read(runs, data):
    check_any_bytes(data.draw, runs)


# ---- nothing is run

WATCHED = """
import sys
from pathlib import Path
import torch as th
from crafted import ALGORITHMS, make
from sb3_kfcv.saving.checkpoints import Checkpoint

th.set_num_threads(1)
folder = Path(sys.argv[1])
models = {name: make(name) for name in ALGORITHMS}
files = {name: sorted((folder / name).glob("**/*.zip")) for name in ALGORITHMS}


def read_all():
    n_read = 0
    for name, model in models.items():
        for file in files[name]:
            for read in (ALGORITHMS[name].load, model.set_parameters, Checkpoint, model.load_replay_buffer):
                try:
                    read(file)
                    n_read += 1
                except ValueError:
                    pass
    return n_read


read_all()
seen = set()


def note(event, args):
    if event == "open" and isinstance(args[1], str) and set(args[1]) <= set("rb"):
        event = "reading"
    seen.add(event)


sys.addaudithook(note)
n_read = read_all()
print(n_read, *sorted(seen), sep="\\n")
eval("1")
assert "compile" in seen  # the hook does see such a thing
"""

# What reading may do beside; the last are Python's own book-keeping.
HARMLESS = {"reading", "builtins.id", "object.__getattr__", "sys._getframe"}


def test_reading_runs_imports_writes_and_starts_nothing(runs, tmp_path):
    """Seen by the interpreter's own audit, in a process of its own since its hooks stay for good."""
    folder = runs["kfcv"]["model"].parents[1]
    payload = npy(np.array([Evil(tmp_path / "marker")], dtype=object))
    for name in ALGORITHMS:
        for kind, edit in (("model", raw("attributes/_last_obs.npy", payload)), ("buffer", raw(f"{T}/rewards.npy", payload))):
            tampered(runs[name][kind], folder / name / f"crafted_{kind}.zip", edit, raw("data.pkl", payload))
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", WATCHED, str(folder)],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=True,
    )
    n_read, *seen = done.stdout.split()
    assert int(n_read) >= len(ALGORITHMS) * 4  # beside those that were refused
    assert set(seen) <= HARMLESS
    assert not (tmp_path / "marker").exists()


FORBIDDEN_IMPORTS = {"pickle", "cPickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "save_util"}
FORBIDDEN_NAMES = {
    "eval",
    "exec",
    "compile",
    "__import__",
    "UnsafeLoader",
    "FullLoader",
    "load_from_pkl",
    "load_from_zip_file",
}
FORBIDDEN_CALLS = {
    "torch.load",
    "th.load",
    "yaml.load",
    "yaml.unsafe_load",
    "yaml.full_load",
    "np.fromfile",
    "importlib.import_module",
}


def what_could_run_code(source):
    """Names, imports and calls by which a file's content could be run; prose does not count."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            words = {word for alias in node.names for word in alias.name.split(".")}
            module = getattr(node, "module", None) or ""
            yield from (words | set(module.split("."))) & (FORBIDDEN_IMPORTS | FORBIDDEN_NAMES)
            yield from {f"{module}.{word}" for word in words} & FORBIDDEN_CALLS
        elif isinstance(node, ast.Name):
            yield from {node.id} & FORBIDDEN_NAMES
        elif isinstance(node, ast.Attribute):
            yield from {ast.unparse(node)} & FORBIDDEN_CALLS or {node.attr} & (FORBIDDEN_NAMES - {"compile", "eval"})
        elif isinstance(node, ast.keyword) and node.arg in ("allow_pickle", "weights_only"):
            if not (isinstance(node.value, ast.Constant) and node.value.value is (node.arg == "weights_only")):
                yield node.arg


@pytest.mark.parametrize(
    "path", sorted([*ROOT.glob("sb3_kfcv/**/*.py"), *ROOT.glob("zoo/**/*.py")]), ids=lambda path: str(path.relative_to(ROOT))
)
def test_no_source_could_run_what_a_file_holds(path):
    assert [*what_could_run_code(path.read_text(encoding="utf-8"))] == []


@pytest.mark.parametrize(
    "source",
    [
        *("eval(text)", "exec(text)", "import pickle", "from pickle import loads", "import cloudpickle as cp"),
        *("import torch\ntorch.load(path)", "yaml.load(file, yaml.UnsafeLoader)", "yaml.load(file, Loader=yaml.SafeLoader)"),
        *("np.load(path, allow_pickle=True)", "th.load", "__import__(name)", "from yaml import UnsafeLoader"),
        *("from torch import load", "from yaml import dump, load as read", "import torch as t\nt.load(p, weights_only=False)"),
        "from stable_baselines3.common.save_util import load_from_zip_file",
    ],
)
def test_the_search_finds(source):
    assert [*what_could_run_code(source)]


@pytest.mark.parametrize(
    "source", ['"""No pickle, no eval(x)."""', "model.eval()", "re.compile(x)", "yaml.safe_load(x)", "np.load(x)"]
)
def test_the_search_leaves_alone(source):
    assert not [*what_could_run_code(source)]
