"""Exploration noise of many worlds, drawn at once, is what SB3 draws world after world."""

import numpy as np
import pytest
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise

from sb3_kfcv.common.noise import OneDraw

MEAN, SPREAD = np.array([0.0, 1.0, -2.0]), np.array([0.1, 0.0, 3.0])
NOISES = {
    "one world": lambda: NormalActionNoise(MEAN, SPREAD),
    "two worlds": lambda: VectorizedActionNoise(NormalActionNoise(MEAN, SPREAD), 2),
    "five worlds, float64": lambda: VectorizedActionNoise(NormalActionNoise(MEAN, SPREAD, np.float64), 5),
    "one spread for all": lambda: VectorizedActionNoise(NormalActionNoise(MEAN, 0.2), 3),
    "drifting": lambda: VectorizedActionNoise(OrnsteinUhlenbeckActionNoise(MEAN, SPREAD), 3),
}


@pytest.mark.parametrize("make", NOISES.values(), ids=NOISES)
def test_the_numbers_are_those_of_sb3(make):
    noise, expected = OneDraw(make()), make()
    np.random.seed(0)
    drawn = [noise() for _ in range(3)]
    np.random.seed(0)
    for ours, theirs in zip(drawn, [expected() for _ in range(3)], strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_array_equal(ours, theirs)


def test_worlds_may_have_noises_of_their_own():
    noise = VectorizedActionNoise(NormalActionNoise(MEAN, SPREAD), 2)
    noise.noises[1]._sigma = np.zeros(3)
    drawn = OneDraw(noise)()
    np.testing.assert_array_equal(drawn[1], MEAN)
    assert not np.array_equal(drawn[0], MEAN)
