"""Files of every format version that was ever released load in this one. They lie in golden/v<version> and never change."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_kfcv import ALGOS, Checkpoints, make_vec_env
from sb3_kfcv.maddpg import MlpPolicy
from sb3_kfcv.saving.archive import FORMAT_VERSION

GOLDEN = Path(__file__).parent / "golden"
VERSIONS = sorted(path.name for path in GOLDEN.glob("v*"))
KFCV = {"n_folds": 3, "first_teacher_steps": 3, "teacher_steps": 2, "refresh_every": 5, "teacher_net_arch": [4]}


def make(algo, folder=None):
    env = make_vec_env("HardSpread-v0", 2, seed=0, env_kwargs={"n_agents": 2, "max_steps": 8})
    settings = {"learning_starts": 10, "batch_size": 8, "buffer_size": 24, "policy_kwargs": {"net_arch": [4]}}
    if algo == "kfcv_maddpg":
        settings["replay_buffer_kwargs"] = KFCV
    model = ALGOS[algo]("MlpPolicy", env, seed=0, device="cpu", learning_rate="lin_1e-2", **settings)
    return model


def observations():
    return np.linspace(-1, 1, 3 * 20, dtype=np.float32).reshape(3, 20)


def write(folder):
    """The files of this format version; for the day when it is released, and never again."""
    folder.mkdir()
    actions = {}
    for algo in ALGOS:
        model = make(algo)
        model.learn(60, Checkpoints(folder / algo, save_freq=40, keep=1))
        model.save(folder / f"{algo}.zip")
        model.save_replay_buffer(folder / f"{algo}_replay_buffer.zip")
        actions[algo] = model.predict(observations(), deterministic=True)[0].tolist()
    model.policy.save(folder / "policy.zip")
    (folder / "actions.json").write_text(json.dumps(actions, indent=1) + "\n")


def test_there_are_files_of_this_version():
    assert f"v{FORMAT_VERSION}" in VERSIONS


@pytest.mark.parametrize("algo", ALGOS)
@pytest.mark.parametrize("version", VERSIONS)
def test_models_buffers_and_checkpoints_of_this_version_load(version, algo, tmp_path):
    actions = json.loads((GOLDEN / version / "actions.json").read_text())[algo]
    model = ALGOS[algo].load(GOLDEN / version / f"{algo}.zip", env=make(algo).get_env())
    np.testing.assert_allclose(model.predict(observations(), deterministic=True)[0], actions, rtol=1e-5)
    assert (model.num_timesteps, model.learning_rate, model.buffer_size) == (60, "lin_1e-2", 24)

    model.load_replay_buffer(GOLDEN / version / f"{algo}_replay_buffer.zip")
    assert model.replay_buffer.n_rows == 24
    model.learn(20, reset_num_timesteps=False)

    shutil.copytree(GOLDEN / version / algo, tmp_path / "run")
    going_on = make(algo)
    going_on.learn(80, Checkpoints(tmp_path / "run", save_freq=40, resume=True))
    assert (going_on.num_timesteps, going_on._n_updates) == (80, 35)


@pytest.mark.parametrize("version", VERSIONS)
def test_policies_of_this_version_load(version):
    actions = json.loads((GOLDEN / version / "actions.json").read_text())["kfcv_maddpg"]
    policy = MlpPolicy.load(GOLDEN / version / "policy.zip")
    np.testing.assert_allclose(policy.predict(observations(), deterministic=True)[0], actions, rtol=1e-5)


if __name__ == "__main__":
    write(GOLDEN / f"v{FORMAT_VERSION}")
    print(f"wrote {GOLDEN / f'v{FORMAT_VERSION}'}", file=sys.stderr)
