"""Packaging of sb3-kfcv: wide ranges for users; ``constraints.txt`` holds the exact versions that are tested."""

from pathlib import Path

from setuptools import find_packages, setup

HERE = Path(__file__).parent

setup(
    name="sb3-kfcv",
    version=(HERE / "sb3_kfcv" / "version.txt").read_text().strip(),
    description="Multi-agent reinforcement learning that feels like Stable-Baselines3: MADDPG, curriculum replay",
    long_description=(HERE / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="MIT",
    packages=[*find_packages(include=["sb3_kfcv", "sb3_kfcv.*", "zoo"]), "zoo.presets"],
    package_dir={"zoo.presets": "hyperparams"},  # installed, the YAML files lie within the package that reads them
    package_data={"sb3_kfcv": ["py.typed", "version.txt"], "zoo.presets": ["*.yml"]},
    entry_points={"console_scripts": ["sb3-kfcv = zoo.cli:main"]},
    python_requires=">=3.10",
    install_requires=[
        "stable-baselines3>=2.9,<3",
        "torch>=2.4,<3",
        "gymnasium>=1.0,<2",
        "pettingzoo>=1.26,<2",
        "numpy>=1.26,<3",
        "numba>=0.60",
        "scipy>=1.11",
        "psutil>=5.9",
        "filelock>=3.12",
        "pillow>=10",
        "matplotlib>=3.8",
        "tensorboard>=2.15",
        "pyyaml>=6",
        "tqdm>=4.66",
        "rich>=13",
    ],
    extras_require={
        "tests": [
            "pytest>=8",
            "pytest-xdist>=3.5",
            "hypothesis>=6.100",
            "ruff>=0.8",
            "mypy>=1.13",
            "types-PyYAML",
            "supersuit>=3.9",
            "mpe2>=1.0",
            "optuna>=4.2",
            "wandb>=0.18",
        ],
        "optimize": ["optuna>=4.2"],
        "cluster": ["ray>=2.40"],
        "track": ["wandb>=0.18"],
        "contrib": ["sb3-contrib>=2.9"],
        "zoo3": ["rl_zoo3>=2.9", "requests"],
        "video": ["moviepy>=2.0"],
        "docs": ["mkdocs>=1.6", "mkdocstrings[python]>=0.26"],
    },
)
