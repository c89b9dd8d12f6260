"""The one file format: what it holds comes back as it was, and nothing that is damaged is ever taken for whole."""

import copy
import datetime
import hashlib
import io
import itertools
import json
import math
import os
import shutil
import sys
import zipfile
from collections import OrderedDict, deque

import numpy as np
import pytest
import torch as th
from crafted import assert_one_sentence, make, members_of, put, tampered, toy, write_run
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from stable_baselines3 import TD3
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from sb3_kfcv import KFCVMADDPG, MADDPG, FileFormatError, KFCVReplayBuffer, MlpPolicy, register
from sb3_kfcv.common.actors import ActorPolicy
from sb3_kfcv.common.layout import AgentLayout
from sb3_kfcv.saving import values
from sb3_kfcv.saving.archive import FORMAT_VERSION, MANIFEST, open_archive, write_archive
from sb3_kfcv.saving.checkpoints import Checkpoint
from sb3_kfcv.saving.transitions import packed, unpacked
from sb3_kfcv.saving.values import ARRAY_KINDS, UnwritableError
from sb3_kfcv.teams.players import Mixture

DTYPES = [np.dtype(name) for name in ("?", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")]
TENSOR_DTYPES = [dtype for dtype in DTYPES if dtype.str not in ("<u2", "<u4", "<u8")]
TINY = settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def round_trip(value):
    file = io.BytesIO()
    write_archive(file, "test", {"value": value})
    file.seek(0)
    with open_archive(file, "test") as archive:
        return archive.read("value")


def alike(one, other):
    """Equal in type and in every bit; objects of registered kinds in their fields."""
    if type(one) is not type(other):
        return type(one) is OrderedDict and alike(dict(one), other)
    if isinstance(one, dict):
        return all(map(alike, one, other)) and len(one) == len(other) and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple, deque)):
        same = len(one) == len(other) and getattr(one, "maxlen", None) == getattr(other, "maxlen", None)
        return same and all(itertools.starmap(alike, zip(one, other, strict=True)))
    if isinstance(one, th.Tensor):
        return one.dtype == other.dtype and alike(one.numpy(), other.numpy())
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    kind = next((kind for kind in values.KINDS.values() if type(one) is kind.type), None)
    return repr(one) == repr(other) if kind is None else alike(kind.fields(one), kind.fields(other))


# ---- what comes back

NUMBERS = st.none() | st.booleans() | st.integers() | st.integers(-(2**13_000), 2**13_000) | st.floats() | st.text(max_size=8)
ARRAYS = st.sampled_from(DTYPES).flatmap(
    lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3))
)
TENSORS = (
    st.sampled_from(TENSOR_DTYPES)
    .flatmap(lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3)))
    .map(th.from_numpy)
)
SCALARS = st.sampled_from(DTYPES).flatmap(hnp.from_dtype)
NAMED = st.sampled_from([nn.Tanh, th.optim.SGD, np.float64, MlpPolicy])
KEYS = st.text(max_size=4) | st.sampled_from(["$", "/", "..", "", "a/../b", "a.npy", "value"])
VALUES = st.recursive(
    NUMBERS | ARRAYS | TENSORS | SCALARS | NAMED,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.lists(inner, max_size=4).map(tuple),
        st.builds(deque, st.lists(inner, max_size=4), st.none() | st.integers(4, 9)),
        st.dictionaries(KEYS, inner, max_size=4),
        st.dictionaries(st.integers() | st.text(max_size=3) | st.tuples(st.booleans(), st.integers()), inner, max_size=4),
        st.dictionaries(KEYS, inner, max_size=4).map(OrderedDict),
    ),
    max_leaves=12,
)


@TINY
@given(value=VALUES)
def test_any_value_comes_back_as_it_was(value):
    assert alike(value, round_trip(value))


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("shape", [(), (0,), (3,), (2, 0, 3), (2, 3, 4)], ids=str)
def test_arrays_of_every_type_and_shape_come_back(dtype, shape):
    array = np.arange(math.prod(shape) or 1)[: math.prod(shape)].reshape(shape).astype(dtype)
    views = (array, np.asfortranarray(array), array[..., ::2] if array.ndim else array, array.astype(dtype.newbyteorder(">")))
    for view in views:
        found = round_trip(view)
        assert found.dtype == dtype
        assert found.shape == view.shape
        np.testing.assert_array_equal(found, view)


@pytest.mark.parametrize("n_digits", [1, 100, 4000])
def test_whole_numbers_come_back_however_large(n_digits):
    assert round_trip([10**n_digits, -(10**n_digits)]) == [10**n_digits, -(10**n_digits)]


def in_mid_course(noise, steps=5):
    for _ in range(steps):
        noise()
    return noise


SIZE = np.linspace(0.1, 0.5, 5)
OF_EVERY_KIND = {
    "Box": [
        spaces.Box(-np.inf, np.inf, (3,), np.float32),
        spaces.Box(np.zeros(2), np.array([1.0, np.inf]), dtype=np.float64),
        spaces.Box(0, 255, (4,), np.uint8),
    ],
    "MultiDiscrete": [spaces.MultiDiscrete([3, 4, 2]), spaces.MultiDiscrete([5], dtype=np.int32)],
    "AgentLayout": [
        AgentLayout(("a_0", "a_1"), ("a", "a"), (3, 3), (2, 2)),
        AgentLayout(("é", "$"), ("x", "y"), (1, 2), (3, 4), discrete=True, state_size=7),
    ],
    "TrainFreq": [TrainFreq(3, TrainFrequencyUnit.STEP), TrainFreq(1, TrainFrequencyUnit.EPISODE)],
    "ConstantSchedule": [ConstantSchedule(1e-3)],
    "LinearSchedule": [LinearSchedule(1e-3, 0.0, 1.0), LinearSchedule(1, 0.5, 0.25)],
    "NormalActionNoise": [NormalActionNoise(0 * SIZE, SIZE, np.float32), NormalActionNoise(0 * SIZE, 0.1, np.float64)],
    "OrnsteinUhlenbeckActionNoise": [
        OrnsteinUhlenbeckActionNoise(0 * SIZE, SIZE),
        in_mid_course(OrnsteinUhlenbeckActionNoise(SIZE, SIZE, theta=0.3, dt=0.1, initial_noise=2 * SIZE, dtype=np.float64)),
    ],
    "VectorizedActionNoise": [
        in_mid_course(VectorizedActionNoise(NormalActionNoise(0 * SIZE, SIZE), 3)),
        in_mid_course(VectorizedActionNoise(OrnsteinUhlenbeckActionNoise(0 * SIZE, SIZE, initial_noise=SIZE), 2)),
    ],
    "ActorPolicy": [
        ActorPolicy.of(MADDPG("MlpPolicy", toy()).policy),
        ActorPolicy.of(
            MADDPG("MlpPolicy", toy(discrete=True), share_parameters=True, policy_kwargs={"activation_fn": nn.Tanh}).policy
        ),
        ActorPolicy.of(MADDPG("MlpPolicy", toy(), policy_kwargs={"layer_norm": True}).policy),
    ],
    "Mixture": [Mixture(["flee", "graze"], [3, 1]), Mixture([ActorPolicy.of(MADDPG("MlpPolicy", toy()).policy), "random"])],
}


def test_the_list_of_kinds_is_whole():
    assert OF_EVERY_KIND.keys() == values.KINDS.keys()


@pytest.mark.parametrize("kind", OF_EVERY_KIND)
def test_objects_of_every_kind_come_back(kind):
    for one in OF_EVERY_KIND[kind]:
        other = round_trip({"of": [one]})["of"][0]
        assert alike(one, other)
        if isinstance(one, spaces.Space):
            assert one == other
        if isinstance(one, ActionNoise):
            for _ in range(3):
                drawn = []
                for noise in (one, other):
                    np.random.seed(7)
                    drawn.append(noise())
                np.testing.assert_array_equal(*drawn)


@pytest.mark.parametrize("name", values.NAMES)
def test_every_name_comes_back(name):
    assert round_trip((values.NAMES[name],)) == (values.NAMES[name],)


@pytest.mark.parametrize(
    ("cls", "more"),
    [
        *((cls, {}) for cls in (th.optim.SGD, th.optim.RMSprop, th.optim.AdamW, th.optim.Adam)),
        *((cls, {"momentum": 0.9}) for cls in (th.optim.SGD, th.optim.RMSprop)),
        *((cls, {"amsgrad": True}) for cls in (th.optim.AdamW, th.optim.Adam)),
        (th.optim.Adam, {"fused": False}),
    ],
)
def test_the_moments_of_every_optimiser_come_back(cls, more, tmp_path):
    kwargs = {"net_arch": [4], "optimizer_class": cls, "optimizer_kwargs": more}
    model = make("maddpg", policy_kwargs=kwargs).learn(20)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=toy())
    for one, other in ((model.actor.optimizer, loaded.actor.optimizer), (model.critic.optimizer, loaded.critic.optimizer)):
        assert isinstance(other, cls) and type(other) is type(one)
        assert alike(one.state_dict(), other.state_dict())
    loaded.learn(5, reset_num_timesteps=False)


def test_a_buffer_filled_beyond_the_planned_end_comes_back(tmp_path):
    """Three worlds take 33 steps when 32 were asked for."""
    model = make(env=DummyVecEnv([toy] * 3)).learn(32)
    assert model.num_timesteps == 33
    model.save_replay_buffer(tmp_path / "buffer")
    other = make(env=DummyVecEnv([toy] * 3))
    other.load_replay_buffer(tmp_path / "buffer")
    assert other.replay_buffer.progress == model.replay_buffer.progress == 1


# ---- what cannot be written

OWN_RELU = type("OwnRelu", (nn.ReLU,), {})
NESTED = []
for _ in range(100):
    NESTED = [NESTED]


class OwnNoise(ActionNoise):
    def __call__(self):
        return np.zeros(5)


def a_rate(remaining):
    return 1e-3 * remaining


@pytest.mark.parametrize(
    "value",
    [
        *(lambda: 0, sys.stderr, object(), OWN_RELU, OwnNoise(), (i for i in ()), {1, 2}, b"bytes"),
        *(np.zeros(2, complex), np.array([None]), np.array(["text"]), np.longdouble(1), np.zeros(1, np.longdouble)),
        *(np.ma.masked_array([1.0, 2.0], [True, False]), np.zeros(1, [("x", "f4")]), np.datetime64("2020-01-01")),
        *(th.zeros(2, dtype=th.bfloat16), th.zeros(2, dtype=th.complex64), th.eye(2).to_sparse()),
        *(datetime.timedelta(1), TrainFrequencyUnit.STEP, 10**5000, NESTED, 1j),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_no_file_can_hold_is_refused_by_its_name(value, tmp_path):
    model = make("maddpg")
    model.my_notes = {"deep": [0, value]}
    with pytest.raises(UnwritableError, match=r"^my_notes/deep/1.* cannot be saved: "):
        model.save(tmp_path / "model")
    assert list(tmp_path.iterdir()) == []


def test_what_holds_itself_is_refused(tmp_path):
    model = make("maddpg")
    model.loop = []
    model.loop.append(model.loop)
    with pytest.raises(UnwritableError, match="loop"):
        model.save(tmp_path / "model")


def test_containers_as_deep_as_can_be_written_can_be_read():
    value = 1.5
    for _ in range(200):
        try:
            found = round_trip(value)
        except UnwritableError:
            break
        assert alike(value, found)
        value = ({"in": [value]},)
    assert value != 1.5


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("learning_rate", {"learning_rate": lambda remaining: 1e-3}),
        ("learning_rate", {"learning_rate": a_rate}),
        ("policy_kwargs/activation_fn", {"policy_kwargs": {"net_arch": [4], "activation_fn": OWN_RELU}}),
        ("policy_kwargs/optimizer_class", {"policy_kwargs": {"optimizer_class": type("OwnAdam", (th.optim.Adam,), {})}}),
        ("action_noise", {"action_noise": OwnNoise()}),
        ("replay_buffer_class", {"replay_buffer_class": type("OwnBuffer", (KFCVReplayBuffer,), {})}),
    ],
    ids=["a lambda", "a function", "an activation", "an optimiser", "a noise", "a replay buffer"],
)
def test_settings_that_no_file_can_hold_are_refused_when_the_model_is_made(name, settings):
    with pytest.raises(UnwritableError, match=rf"^{name} cannot be saved: .*sb3_kfcv\.register\(\""):
        make("kfcv", **settings)


def test_a_policy_that_no_file_can_hold_is_refused_when_the_model_is_made():
    with pytest.raises(UnwritableError, match=r"^policy_class cannot be saved: it is OwnPolicy; .*register\(\"OwnPolicy\""):
        MADDPG(type("OwnPolicy", (MlpPolicy,), {}), toy())


# ---- names of one's own


@pytest.fixture
def names(monkeypatch):
    """The registry, put back afterwards."""
    monkeypatch.setattr(values, "NAMES", dict(values.NAMES))
    return values.NAMES


def own_settings():
    return {
        "learning_rate": register("a_rate", a_rate),
        "policy_kwargs": {"net_arch": [4], "activation_fn": register("own_relu", OWN_RELU)},
    }


def test_what_has_a_name_is_saved_and_loaded(names, tmp_path):
    model = make("maddpg", **own_settings()).learn(20)
    model.save(tmp_path / "model")
    loaded = MADDPG.load(tmp_path / "model", env=toy())
    assert loaded.learning_rate is a_rate
    assert loaded.policy_kwargs["activation_fn"] is OWN_RELU
    assert isinstance(loaded.actor.stacks[0].activation, OWN_RELU)
    loaded.learn(5)


def test_a_name_can_be_given_again_but_not_to_another_thing(names):
    register("own_relu", OWN_RELU)
    register("own_relu", OWN_RELU)
    with pytest.raises(ValueError, match=r'the name "own_relu" is taken by .*OwnRelu'):
        register("own_relu", nn.Tanh)
    with pytest.raises(ValueError, match='"relu" is taken'):
        register("relu", OWN_RELU)


def test_a_program_that_lacks_the_name_is_told_so(names, tmp_path):
    make("maddpg", **own_settings()).save(tmp_path / "model")
    del names["own_relu"]
    with pytest.raises(FileFormatError) as caught:
        MADDPG.load(tmp_path / "model")
    assert_one_sentence(caught.value, tmp_path / "model.zip")
    assert 'unknown name "own_relu"' in str(caught.value)
    assert "sb3_kfcv.register(" in str(caught.value)


# ---- what a file looks like


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Files of one tiny run."""
    folder = tmp_path_factory.mktemp("run")
    return dict(zip(("model", "buffer", "checkpoint"), write_run(folder), strict=True))


def read(path):
    """As a user does, by the kind of file."""
    if path.parent.name == "run":
        return Checkpoint(path)
    if path.name.startswith("buffer"):
        return make().load_replay_buffer(path)
    return KFCVMADDPG.load(path)


def test_equal_contents_make_equal_files(tmp_path):
    paths = [tmp_path / f"{i}.zip" for i in range(2)]
    for path in paths:
        make().save(path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    file = io.BytesIO()
    make().save(file)
    assert file.getvalue() == paths[0].read_bytes()


@pytest.mark.parametrize("kind", ["model", "buffer", "checkpoint"])
def test_any_zip_program_and_numpy_can_open_it(run, kind):
    with zipfile.ZipFile(run[kind]) as archive:
        assert archive.testzip() is None
        for info in archive.infolist():
            assert info.compress_type == zipfile.ZIP_STORED
            data = archive.read(info)
            if info.filename.endswith(".npy"):
                assert np.load(io.BytesIO(data)).dtype.kind in ARRAY_KINDS
            else:
                json.loads(data)


@pytest.mark.parametrize("kind", ["model", "buffer", "checkpoint"])
def test_the_manifest_says_what_the_file_holds(run, kind):
    members = members_of(run[kind])
    manifest = json.loads(members.pop(MANIFEST))
    assert (manifest["format"], manifest["format_version"]) == ("sb3-kfcv", FORMAT_VERSION)
    assert manifest["kind"] == {"buffer": "replay buffer"}.get(kind, kind)
    assert {"python", "sb3_kfcv", "torch", "numpy", "stable_baselines3"} <= manifest["libraries"].keys()
    assert manifest["members"] == {
        name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in members.items()
    }


@pytest.mark.parametrize("kind", ["model", "buffer", "checkpoint"])
def test_the_file_ends_with_the_checksum_of_all_before(run, kind):
    data = run[kind].read_bytes()
    assert data[-71:-64] == b"sha256:"
    assert data[-64:].decode() == hashlib.sha256(data[:-64]).hexdigest()


def test_writing_says_the_checksum(tmp_path):
    digest = write_archive(tmp_path / "file", "test", {"value": 1})
    assert (tmp_path / "file").read_bytes().endswith(digest.encode())


# ---- damage


def places(data, n, rng):
    """Bytes to damage: the first and the last ones, those that begin a zip's headers, and others anywhere."""
    chosen = [*range(16), *(len(data) - 1 - np.arange(0, 200, 4))]
    for mark in (b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06"):
        found = [i for i in range(len(data)) if data.startswith(mark, i)]
        starts = rng.choice(found, min(len(found), 24), replace=False)
        chosen += [start + rng.integers(46) for start in starts]  # a header of the zip directory has 46 bytes
    chosen += rng.integers(len(data), size=max(n - len(chosen), 0)).tolist()
    return [min(int(place), len(data) - 1) for place in chosen]


def damage_is_named(path, target, n, seed):
    """Flip bits of a file, one at a time; ``target`` is damaged and read: how many."""
    rng = np.random.default_rng(seed)
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        ends = sorted((info.header_offset, info.filename) for info in archive.infolist())
        names = archive.namelist()
    copied = bytearray(data)
    chosen = places(data, n, rng)
    for place in chosen:
        bit = 1 << rng.integers(8)
        copied[place] ^= bit
        target.write_bytes(copied)
        copied[place] ^= bit
        with pytest.raises(FileFormatError) as caught:
            read(target)
        assert_one_sentence(caught.value, target)
        said = str(caught.value)
        assert any(name in said for name in names) or "the zip directory" in said or "checksum" in said, (place, bit, said)
        owner = [name for offset, name in ends if offset + 30 + len(name) <= place][-1:]
        if owner and owner != [MANIFEST] and in_data(path, owner[0], place):
            assert f"is damaged: {owner[0]}" in said, (place, bit, said)
    target.write_bytes(data)
    return len(chosen)


def in_data(path, name, place):
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(name)
    return 0 <= place - info.header_offset - 30 - len(name) < info.file_size


@pytest.mark.parametrize("kind", ["model", "buffer", "checkpoint"])
def test_no_flipped_bit_goes_unseen(run, kind, tmp_path):
    if kind == "checkpoint":  # beside its transitions
        shutil.copytree(run[kind].parent, tmp_path / "run")
        target = tmp_path / "run" / run[kind].name
    else:
        target = tmp_path / run[kind].name
    assert damage_is_named(run[kind], target, 240, seed=3) >= 200
    read(target)


@pytest.mark.expensive
@pytest.mark.parametrize("kind", ["model", "buffer", "checkpoint"])
def test_no_flipped_bit_of_many_goes_unseen(run, kind, tmp_path):
    shutil.copytree(run["checkpoint"].parent, tmp_path / "run")
    target = tmp_path / ("run" if kind == "checkpoint" else ".") / run[kind].name
    for seed in range(10):
        damage_is_named(run[kind], target, 2000, seed)


@pytest.mark.parametrize("kind", ["model", "buffer", "checkpoint"])
def test_no_file_that_was_cut_off_is_read(run, kind, tmp_path):
    shutil.copytree(run["checkpoint"].parent, tmp_path / "run")
    target = tmp_path / ("run" if kind == "checkpoint" else ".") / run[kind].name
    data = run[kind].read_bytes()
    lengths = {0, 1, 3, 4, 22, 64, 71, 93, len(data) - 1, len(data) - 64, len(data) - 65, len(data) - 71, len(data) - 72}
    lengths |= set(np.random.default_rng(5).integers(len(data), size=60).tolist())
    for length in sorted(lengths):
        target.write_bytes(data[:length])
        with pytest.raises(FileFormatError) as caught:
            read(target)
        assert_one_sentence(caught.value, target)


def test_bytes_that_follow_the_end_are_refused(run, tmp_path):
    path = tmp_path / "model.zip"
    for more in (b"\0", b"x" * 100, run["model"].read_bytes()[-71:]):
        path.write_bytes(run["model"].read_bytes() + more)
        with pytest.raises(FileFormatError) as caught:
            read(path)
        assert_one_sentence(caught.value, path)


@pytest.fixture
def checkpoint(run, tmp_path):
    """A checkpoint beside its pieces, free to be damaged."""
    shutil.copytree(run["checkpoint"].parent, tmp_path / "run")
    return tmp_path / "run" / run["checkpoint"].name


def pieces_of(checkpoint):
    return sorted((checkpoint.parent / "transitions").glob("*.zip"), key=lambda path: int(path.name.split("_")[0]))


def test_damaged_transitions_of_a_checkpoint_are_named(checkpoint):
    rng = np.random.default_rng(0)
    piece = pieces_of(checkpoint)[1]
    data = piece.read_bytes()
    for place in [*range(0, 16, 4), *rng.integers(len(data), size=80), *(len(data) - 1 - np.arange(0, 100, 10))]:
        copied = bytearray(data)
        copied[place] ^= 1 << rng.integers(8)
        piece.write_bytes(copied)
        with pytest.raises(FileFormatError, match=r"transitions/12_24\.zip"):
            Checkpoint(checkpoint)
    for length in (0, 1, len(data) // 2, len(data) - 1):
        piece.write_bytes(data[:length])
        with pytest.raises(FileFormatError, match=r"transitions/12_24\.zip"):
            Checkpoint(checkpoint)
    piece.write_bytes(data)
    assert len(Checkpoint(checkpoint).transitions["rewards"]) == 24


def test_missing_transitions_of_a_checkpoint_are_named(checkpoint):
    pieces_of(checkpoint)[0].unlink()
    with pytest.raises(FileFormatError, match=r"rl_model_24_steps\.zip.*transitions/0_12\.zip"):
        Checkpoint(checkpoint)


def test_transitions_that_changed_places_are_named(checkpoint):
    one, other, *_ = pieces_of(checkpoint)
    data = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(data)
    with pytest.raises(FileFormatError, match=r"transitions/0_12\.zip"):
        Checkpoint(checkpoint)


def test_whole_transitions_of_another_run_are_not_taken(checkpoint):
    piece = pieces_of(checkpoint)[0]
    with open_archive(piece, "transitions") as archive:
        transitions = archive.read("transitions")
    write_archive(piece, "transitions", {"transitions": {**transitions, "rewards": transitions["rewards"] + 1}})
    with pytest.raises(FileFormatError, match=r"transitions/0_12\.zip"):
        Checkpoint(checkpoint)


# ---- files of other kinds


@pytest.fixture(scope="module")
def stock(tmp_path_factory):
    """A model file of Stable-Baselines3's own."""
    path = tmp_path_factory.mktemp("stock") / "td3.zip"
    TD3("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs={"net_arch": [4]}, device="cpu").save(path)
    return path


READERS = {
    "load": lambda path: KFCVMADDPG.load(path),
    "set_parameters": lambda path: make().set_parameters(path),
    "load_replay_buffer": lambda path: make().load_replay_buffer(path),
}
BY_EVERY_READER = pytest.mark.parametrize("reader", READERS)


@BY_EVERY_READER
def test_files_of_stable_baselines3_are_known_and_refused(stock, reader):
    with pytest.raises(FileFormatError, match=r"td3\.zip is a file of Stable-Baselines3's own save\(\).*set_parameters"):
        READERS[reader](stock)


@BY_EVERY_READER
@pytest.mark.parametrize("what", ["text", "nothing", "npz", "npy", "pickle"])
def test_files_that_are_something_else_are_refused(what, reader, tmp_path):
    path = tmp_path / "file.zip"
    with open(path, "wb") as file:
        if what == "text":
            file.write(b"reward: 1.0\n" * 50)
        elif what == "npz":
            np.savez(file, weights=np.zeros(100))
        elif what == "npy":
            np.save(file, np.zeros(100))
        elif what == "pickle":
            th.save({"weights": th.zeros(100)}, file, _use_new_zipfile_serialization=False)
    with pytest.raises(FileFormatError, match=r"file\.zip is no sb3-kfcv file") as caught:
        READERS[reader](path)
    assert_one_sentence(caught.value, path)


@BY_EVERY_READER
def test_a_folder_is_no_file(reader, tmp_path):
    (tmp_path / "folder.zip").mkdir()
    with pytest.raises(OSError, match=r"folder\.zip"):
        READERS[reader](tmp_path / "folder.zip")


@BY_EVERY_READER
def test_a_file_that_is_not_there_is_named(reader, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.zip"):
        READERS[reader](tmp_path / "nowhere")


@pytest.mark.parametrize(
    ("kind", "reader"), [("buffer", "load"), ("buffer", "set_parameters"), ("model", "load_replay_buffer")]
)
def test_a_file_of_another_kind_says_what_it_is(run, kind, reader):
    with pytest.raises(FileFormatError, match=rf"{kind}\.zip is a '(model|replay buffer)' file; wanted is "):
        READERS[reader](run[kind])


@pytest.mark.parametrize("version", [FORMAT_VERSION + 1, 10**6, 0, -1, 1.5, "1", None, True], ids=repr)
def test_a_file_of_a_version_to_come_says_to_update(run, version, tmp_path):
    path = tampered(run["model"], tmp_path / "model.zip", put("manifest", "format_version", to=version))
    with pytest.raises(FileFormatError, match=rf"has format version {version!r}; .*update it"):
        KFCVMADDPG.load(path)


def test_a_checkpoint_is_a_model_too(run):
    assert KFCVMADDPG.load(run["checkpoint"]).num_timesteps == 24


def test_nothing_is_left_of_a_file_that_could_not_be_written(tmp_path):
    """Neither half a file, nor a broken older one."""
    make().save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()
    broken = make()
    broken.notes = object()
    for _ in range(2):
        with pytest.raises(UnwritableError):
            broken.save(tmp_path / "model")
    assert os.listdir(tmp_path) == ["model.zip"]
    assert (tmp_path / "model.zip").read_bytes() == before


def test_saving_changes_nothing(tmp_path):
    model = make().learn(20)
    before = copy.deepcopy(model.get_parameters())
    model.save(tmp_path / "model")
    assert alike(before, model.get_parameters())


@pytest.mark.parametrize("name", ["maddpg", "per", "kfcv"])
def test_an_emptied_buffer_comes_back_empty(name, tmp_path):
    model = make(name).learn(30)
    model.replay_buffer.reset()
    model.save_replay_buffer(tmp_path / "buffer")
    other = make(name).learn(30)
    other.load_replay_buffer(tmp_path / "buffer")
    assert other.replay_buffer.n_rows == 0
    other.learn(30)


def test_a_smaller_buffer_leaves_nothing_of_the_one_before(tmp_path):
    """Scores of transitions that are no longer there would be drawn from."""
    make(buffer_size=20).learn(15).save_replay_buffer(tmp_path / "buffer")
    model = make(buffer_size=50).learn(45)
    model.load_replay_buffer(tmp_path / "buffer")
    buffer = model.replay_buffer
    buffer.progress = 0.1
    assert buffer.n_rows == 15
    assert buffer.n_refreshes > 0
    assert max(buffer.curriculum_rows(200)) < 15


@pytest.mark.parametrize("n_steps", [0, 1, 7])
@pytest.mark.parametrize("state_size", [0, 3])
def test_what_follows_a_step_is_written_once(n_steps, state_size):
    """And comes back to the bit: at an episode's end, where a zero changes its sign, and where nothing is stored."""
    rng = np.random.default_rng(0)
    observations, states = (rng.normal(size=(n_steps + 1, 2, width)).astype(np.float32) for width in (4, state_size))
    following = observations[1:].copy()
    if n_steps > 3:
        following[3, 1] = 5.0
        observations[3, 0, 0], following[2, 0, 0] = 0.0, -0.0
    transitions = {"observations": observations[:-1], "next_observations": following, "rewards": observations[:-1, :, 0]}
    transitions |= {"states": states[:-1], "next_states": states[1:]}
    stored = packed(transitions)
    assert len(stored["next_observations"]["rows"]) == {0: 0, 1: 2, 7: 4}[n_steps]
    for name, array in unpacked(stored).items():
        assert array.tobytes() == transitions[name].tobytes(), name
