"""The package as it is installed, away from the repository: the console script, and the presets."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("sb3_kfcv", "zoo", "hyperparams", "setup.py", "pyproject.toml", "README.md", "LICENSE")

# The unpacked wheel comes before whatever else of this package is installed.
RUN = """
import sys
sys.path.insert(0, {wheel!r})
from zoo.cli import main
print(sys.modules["zoo"].__file__)
sys.exit(main({words!r}))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, unpacked; built of a copy, since building leaves files behind."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("wheel")
    (folder / "copy").mkdir()
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / "copy" / name)
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", str(folder), "./copy"]
    subprocess.run(build, check=True, capture_output=True, cwd=folder)
    (file,) = folder.glob("*.whl")
    with zipfile.ZipFile(file) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


def run(wheel, folder, *words):
    program = RUN.format(wheel=str(wheel), words=list(words))
    env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run([sys.executable, "-c", program], cwd=folder, env=env, capture_output=True, text=True)


def test_the_wheel_has_the_presets_and_the_console_script(wheel):
    presets = {path.name for path in (ROOT / "hyperparams").glob("*.yml")}
    assert {path.name for path in (wheel / "zoo" / "presets").glob("*.yml")} == presets
    (entry_points,) = wheel.glob("*.dist-info/entry_points.txt")
    assert "sb3-kfcv = zoo.cli:main" in entry_points.read_text()


def test_an_installed_command_finds_its_presets_elsewhere(wheel, tmp_path):
    done = run(
        wheel, tmp_path, "train", "--algo", "maddpg", "--env", "HardSpread-v0", "--preset", "tuned", "-params", "gama:1"
    )
    assert done.stdout == f"{wheel / 'zoo' / '__init__.py'}\n"
    assert done.stderr == 'error: unknown hyperparameter "gama"; did you mean "gamma"?\n'
