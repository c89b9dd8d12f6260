"""What `import sb3_kfcv` does not load, so that it starts quickly."""

import subprocess
import sys

import pytest

LATE = ["scipy.stats", "scipy.optimize", "matplotlib.pyplot", "tensorboard", "pandas.plotting", "imageio", "rich.progress"]


@pytest.fixture(scope="module")
def loaded():
    """Modules that an import of this package loads beyond those of Stable-Baselines3."""
    code = (
        "import sys, stable_baselines3; before = set(sys.modules); import sb3_kfcv; print(*sorted(set(sys.modules) - before))"
    )
    return set(subprocess.check_output([sys.executable, "-c", code], text=True).split())


def test_the_package_is_loaded(loaded):
    assert "sb3_kfcv.maddpg.maddpg" in loaded


@pytest.mark.parametrize("module", LATE)
def test_what_few_need_is_loaded_late(loaded, module):
    assert module not in loaded
