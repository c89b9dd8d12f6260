"""Files that were tampered with: members changed, then sealed as if nothing had happened; and the runs they come from."""

import hashlib
import io
import json
import warnings
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from toy_envs import ToyParallelEnv

from sb3_kfcv import KFCVMADDPG, MADDPG, PERMADDPG, JointEnv
from sb3_kfcv.saving.archive import MANIFEST, SEAL
from sb3_kfcv.saving.checkpoints import Checkpoints

ALGORITHMS = {"maddpg": MADDPG, "per": PERMADDPG, "kfcv": KFCVMADDPG, "discrete": MADDPG}
CURRICULUM = {
    **{"n_folds": 2, "curriculum_fraction": 0.9, "refresh_every": 5},
    **{"teacher_net_arch": [4], "teacher_batch_size": 8, "first_teacher_steps": 2, "teacher_steps": 1},
}


def toy(**kwargs):
    return JointEnv(ToyParallelEnv(**{"time_limit": 8, "deaths": {"scout_1": 5}, **kwargs}))


def make(name="kfcv", **kwargs):
    """A model of a few dozen weights."""
    settings = {"learning_starts": 10, "batch_size": 8, "buffer_size": 50, "policy_kwargs": {"net_arch": [4]}, "seed": 0}
    if name == "kfcv":
        settings["replay_buffer_kwargs"] = CURRICULUM
    settings |= {"env": toy(discrete=name == "discrete"), "device": "cpu"}
    return ALGORITHMS[name]("MlpPolicy", **{**settings, **kwargs})


def write_run(folder, name="kfcv"):
    """A model, its replay buffer, and a checkpoint whose transitions lie in two pieces: ``(model, buffer, checkpoint)``."""
    model = make(name).learn(30, Checkpoints(folder / "run", save_freq=12))
    model.save(folder / "model.zip")
    model.save_replay_buffer(folder / "buffer.zip")
    return folder / "model.zip", folder / "buffer.zip", folder / "run" / "rl_model_24_steps.zip"


def members_of(path):
    """Name → bytes of every member."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def with_manifest(members):
    """The members, and a manifest that fits them."""
    members = dict(members)
    manifest = json.loads(members.pop(MANIFEST))
    manifest["members"] = {
        name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in members.items()
    }
    return {**members, MANIFEST: json.dumps(manifest).encode()}


def write_members(path, members, compression=zipfile.ZIP_STORED):
    """
    A sealed zip of members, which may be given as pairs to hold a name twice.

    :return: the path
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a name that stands twice
        for name, data in members.items() if isinstance(members, dict) else members:
            archive.writestr(zipfile.ZipInfo(name), data, compress_type=compression)
        archive.comment = SEAL + b"0" * 64
    return write_sealed(path, buffer.getvalue())


def write_sealed(path, data):
    """The bytes, whose last 64 become the checksum of those before."""
    path.write_bytes(data[:-64] + hashlib.sha256(data[:-64]).hexdigest().encode())
    return path


def npy(array):
    """An array as the bytes of a ``.npy`` file, pickles included."""
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def npy_header(descr="<f4", shape="(3,)", fortran="False"):
    """The start of a ``.npy`` file that says anything."""
    text = f"{{'descr': {descr!r}, 'fortran_order': {fortran}, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def put(*place, to):
    """An edit that puts a value into a JSON document: section, then the keys."""

    def edit(members):
        name = f"{place[0]}.json"
        document = json.loads(members[name])
        inner = document
        for key in place[1:-1]:
            inner = inner[key]
        inner[place[-1]] = to
        members[name] = json.dumps(document).encode()

    return edit


def drop(*place):
    """An edit that takes a key out of a JSON document."""

    def edit(members):
        document = inner = json.loads(members[f"{place[0]}.json"])
        for key in place[1:-1]:
            inner = inner[key]
        del inner[place[-1]]
        members[f"{place[0]}.json"] = json.dumps(document).encode()

    return edit


def array(name, change):
    """An edit that changes an array; ``change`` works in place, or gives another one."""

    def edit(members):
        values = np.load(io.BytesIO(members[f"{name}.npy"]))
        changed = change(values)
        members[f"{name}.npy"] = npy(values if changed is None else changed)

    return edit


def raw(name, data):
    """An edit that puts the bytes of a member."""

    def edit(members):
        members[name] = data

    return edit


def tampered(source, target, *edits):
    """A copy of a file with some edits, its manifest and seal made to fit: the path."""
    members = members_of(source)
    for edit in edits:
        edit(members)
    return write_members(target, with_manifest(members))


def assert_one_sentence(error, path):
    """It begins with the name of the file, and stays short whatever the file says of itself."""
    text = str(error)
    assert text.startswith(f"{path} "), text
    assert "\n" not in text
    assert len(text) - len(str(path)) < 420, text


# Linux tells the most memory that a process has held, and forgets it when asked to.
PEAK, FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@contextmanager
def within_memory(n_bytes):
    """The block must not hold more memory than this, beside what was held before, at any time."""
    if not FORGET.exists():
        yield
        return
    FORGET.write_text("5")
    before = peak_memory()
    yield
    taken = peak_memory() - before
    assert taken < n_bytes, f"{taken / 1e6:.0f} MB were taken"


def peak_memory():
    """Bytes."""
    return 1024 * int(PEAK.read_text().split("VmHWM:")[1].split()[0])
