"""Exploration noise of many worlds."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, VectorizedActionNoise


class OneDraw(ActionNoise):
    """
    The noise of all worlds, where it is Gaussian in one draw: the same numbers as SB3's, which draws world after world,
    and at 100 worlds a tenth of its time. What the noise is made of is read at each draw, since callbacks may change it.

    :param noise: of one world, or vectorised
    """

    def __init__(self, noise: ActionNoise) -> None:
        self.noise = noise
        super().__init__()

    def __call__(self) -> np.ndarray:
        noises = self.noise.noises if isinstance(self.noise, VectorizedActionNoise) else []
        if {type(noise) for noise in noises} != {NormalActionNoise}:
            return self.noise()
        means, spreads = [noise._mu for noise in noises], [noise._sigma for noise in noises]  # type: ignore[attr-defined]
        if np.ndim(means[0]) != 1 or np.shape(means[0]) != np.shape(spreads[0]):
            return self.noise()
        drawn = np.random.normal(np.concatenate(means), np.concatenate(spreads))
        return drawn.reshape(len(noises), -1).astype(noises[0]._dtype)  # type: ignore[attr-defined]

    def reset(self) -> None:
        self.noise.reset()
