"""Moving pictures of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from stable_baselines3.common.vec_env import VecEnv

from sb3_kfcv.saving.files import atomic_write
from sb3_kfcv.teams.players import JointModel

PAUSE = 5  # frames for which the last picture of an episode stands still


def record(policy: JointModel, env: VecEnv, n_episodes: int) -> list[np.ndarray]:
    """
    Pictures of greedy episodes; each starts after its reset and ends with the last picture before the next one.

    :param policy: whatever acts on joint rows
    :param env: one world, with ``render_mode="rgb_array"``
    :param n_episodes: number of episodes
    :return: frames, uint8 (height, width, 3)
    """
    observations, dones, memory = env.reset(), np.ones(1, dtype=bool), None
    frames = [_picture(env)]
    while n_episodes > 0:
        actions, memory = policy.predict(observations, state=memory, episode_start=dones, deterministic=True)
        observations, _, dones, _ = env.step(actions)
        if dones[0]:
            n_episodes -= 1
            frames += [frames[-1]] * PAUSE
        if n_episodes > 0:
            frames.append(_picture(env))
    return frames


def _picture(env: VecEnv) -> np.ndarray:
    picture = env.get_images()[0]
    if picture is None:
        raise ValueError('the env draws nothing; make it with render_mode="rgb_array"')
    return picture


def save_gif(frames: Sequence[np.ndarray], path: str | Path, fps: int) -> None:
    """
    Write frames as an endless GIF.

    :param frames: uint8 (height, width, 3)
    :param path: of the file
    :param fps: frames per second
    """
    # One palette for all frames: flat colours stay the same from frame to frame, and the file small.
    palette = Image.fromarray(np.concatenate(list(frames[:: max(1, len(frames) // 8)]))).quantize(128)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    with atomic_write(path) as file:
        images[0].save(file, format="GIF", save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
