"""The page "use with rl_zoo3": its files are written and its commands run, as its reader would."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from sb3_kfcv import KFCVMADDPG

PAGE = Path(__file__).parents[1] / "docs" / "rl_zoo3.md"


@pytest.mark.expensive
def test_the_commands_of_the_page_train(tmp_path):
    pytest.importorskip("rl_zoo3")
    commands = []
    for text in re.findall(r"^```\w*\n(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE):
        if file := re.match(r"# (\w+\.\w+)\n", text):
            (tmp_path / file[1]).write_text(text)
        commands += [line for line in text.splitlines() if line.startswith("python ")]
    assert len(commands) == 2
    for command in commands:
        subprocess.run([sys.executable, *shlex.split(command)[1:]], cwd=tmp_path, check=True)
    first, second = (tmp_path / "logs" / "kfcv_maddpg" / f"HardSpread-v0_{run}" for run in (1, 2))
    assert {"best_model.zip", "evaluations.npz", "rl_model_200_steps.zip", "HardSpread-v0.zip"} <= {
        p.name for p in first.iterdir()
    }
    assert (first / "HardSpread-v0" / "vecnormalize.pkl").exists()
    loaded = KFCVMADDPG.load(second / "HardSpread-v0.zip")
    assert loaded.num_timesteps == 400
    assert loaded.layout.n_agents == 2
