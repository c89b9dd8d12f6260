"""The gate: a few hundred steps of each algorithm end in the parameters that are written down here, to the bit."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
import torch as th

from sb3_kfcv import ALGOS, make_vec_env

GATE = Path(__file__).parent / "golden" / "determinism.json"
KFCV = {"first_teacher_steps": 20, "teacher_steps": 5, "refresh_every": 40, "teacher_net_arch": [16]}
RUNS = {
    "HardSpread-v0": {"env_kwargs": {"n_agents": 2, "max_steps": 20}, "n_envs": 1, "n_timesteps": 400},
    "Grassland-v0": {"env_kwargs": {"n_wolves": 2, "n_sheep": 2}, "n_envs": 4, "n_timesteps": 1200},
}


def machine():
    """Versions and processor on which floating-point results are the same to the bit."""
    try:
        lines = dict(
            line.split(":", 1) for line in Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines() if ":" in line
        )
        cpu = {key.strip(): value.strip() for key, value in lines.items()}
        processor = "/".join(cpu.get(key, "?") for key in ("vendor_id", "cpu family", "model"))
    except OSError:
        processor = "unknown"
    return f"torch {th.__version__.partition('+')[0]}, {processor}, {th.backends.cpu.get_cpu_capability()}"


def trained(algo, env_id):
    settings = RUNS[env_id]
    env = make_vec_env(env_id, settings["n_envs"], seed=3, env_kwargs=settings["env_kwargs"])
    kwargs = {"replay_buffer_kwargs": KFCV} if algo == "kfcv_maddpg" else {}
    model = ALGOS[algo](
        "MlpPolicy", env, seed=3, learning_starts=100, batch_size=32, policy_kwargs={"net_arch": [16]}, device="cpu", **kwargs
    )
    model.learn(settings["n_timesteps"])
    return {f"policy/{name}": tensor for name, tensor in model.policy.state_dict().items()}


def digest(parameters):
    sha256 = hashlib.sha256()
    for name, tensor in sorted(parameters.items()):
        sha256.update(name.encode() + tensor.numpy().tobytes())
    return sha256.hexdigest()


def norms(parameters):
    return {name: float(tensor.norm()) for name, tensor in sorted(parameters.items())}


def measure():
    """What ``golden/determinism.json`` holds, for this machine; for a change that means to change the learning."""
    runs = {f"{algo} {env_id}": trained(algo, env_id) for algo in ALGOS for env_id in RUNS}
    digests = {machine(): {name: digest(parameters) for name, parameters in runs.items()}}
    return {"digests": digests, "norms": {name: norms(parameters) for name, parameters in runs.items()}}


@pytest.mark.parametrize("env_id", RUNS)
@pytest.mark.parametrize("algo", ALGOS)
def test_training_ends_in_the_parameters_written_down(algo, env_id):
    """To the bit where the digest of this machine is known, else closely: rounding differs between processors."""
    gate, name = json.loads(GATE.read_text()), f"{algo} {env_id}"
    parameters = trained(algo, env_id)
    found, expected = norms(parameters), gate["norms"][name]
    assert found.keys() == expected.keys()
    np.testing.assert_allclose(list(found.values()), list(expected.values()), rtol=1e-3)
    if machine() in gate["digests"]:
        assert digest(parameters) == gate["digests"][machine()][name]


if __name__ == "__main__":
    th.set_num_threads(1)  # as in all tests
    GATE.parent.mkdir(exist_ok=True)
    known = json.loads(GATE.read_text()) if GATE.exists() else {"digests": {}}
    measured = measure()
    same = known.get("norms") == measured["norms"]
    digests = {**(known["digests"] if same else {}), **measured["digests"]}
    GATE.write_text(json.dumps({**measured, "digests": digests}, indent=1) + "\n")
    print(f"wrote {GATE}")
