"""
The picture of the two worlds in the README: ``python benchmarks/draw_worlds.py``.

Wolves chase fleeing sheep in Grassland; the oracle leads agents through the doors of Hard Spread.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from sb3_kfcv import make_vec_env
from sb3_kfcv.teams.team_policy import TeamPolicy
from sb3_kfcv.vec_env.make import layout_of

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "worlds.png"
SCENES: list[tuple[str, dict[str, str], int]] = [
    ("Grassland-v0", {"wolf": "chase", "sheep": "flee"}, 12),
    ("HardSpread-v0", {"agent": "oracle"}, 24),
]


def scene(world: str, players: dict[str, str], steps: int, seed: int = 4) -> np.ndarray:
    """One world after some steps: (height, width, 3)."""
    env = make_vec_env(world, 1, seed, {"render_mode": "rgb_array"})
    facts = {"state_source": lambda: np.stack(env.env_method("state"))} if "oracle" in players.values() else {}
    policy = TeamPolicy(layout_of(env), players, np.random.default_rng(seed), **facts)
    observations = env.reset()
    for _ in range(steps):
        observations, *_ = env.step(policy.predict(observations)[0])
    (picture,) = env.get_images()
    assert picture is not None
    return picture


def main() -> None:
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.hstack([scene(*settings) for settings in SCENES])).save(PICTURE, optimize=True)
    print(PICTURE)


if __name__ == "__main__":
    main()
